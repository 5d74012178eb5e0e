"""Reads triangle meshes: OBJ and PLY files, or tables of the scene itself; nothing is merged or repaired.

Files are checked so that no vertex and no face is lost silently. Texture coordinates and normals of an OBJ file with
materials count face by face, of one that has a material of the scene where every face has them. Of the MTL files
that it names, diffuse colours and pictures are read (Kd, map_Kd) and nothing else; a material of the scene with the
name that `usemtl` says comes before theirs.

PLY files are ASCII, or binary of either byte order, and their faces may have any number of corners, each another; what
else a file holds (colours, edges, flags of faces) is passed over. Source: G. Turk, The PLY Polygon File Format (1994).
"""

from __future__ import annotations

import math
import os
import re
import warnings
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import read_bytes
from neurolens.render.scenetables import FARTHEST_M, SMALLEST_M, Material, MeshSettings, Texture, Vector

_LARGEST_HEADER = 100_000
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
    "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_COORDINATES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))


class Property(NamedTuple):
    """A value of each element of a kind, or a list of values, whose length is of type `length`."""

    name: str
    kind: str
    length: str = ""


@dataclass(frozen=True)
class Element:
    """A kind of element, how many the header promises, and what each has."""

    name: str
    count: int
    properties: list[Property]


@dataclass(frozen=True)
class Polygons:
    """What a file holds.

    Attributes:
        vertices: [V, 3]. faces: [T, 3] triangles of vertices counted from 0, polygons cut into fans. uv: [V, 2], or
            None. normals: [V, 3], or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None
    normals: NDArray[np.float64] | None


def read_polygons(content: bytes) -> Polygons:
    """What the bytes of a file hold.

    Raises:
        ValueError: no PLY file, or one that ends early; says what is wrong.
    """
    head, end, _ = content[:_LARGEST_HEADER].partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise ValueError("expected a PLY file, which begins with ply and a header")
    order, elements = _header(head.decode("ascii", "replace"))
    for element in elements:
        if element.count > len(content):
            raise ValueError(f"{element.count} elements {element.name} in {len(content)} bytes")
    body = memoryview(content)[content.index(b"\n", len(head)) + 1 :]
    columns: dict[str, NDArray[np.float64]] = {}
    faces = np.empty((0, 3), np.int64)
    try:
        numbers = None if order else _numbers(bytes(body))
        at = 0
        for element in elements:
            corners = next((p for p in element.properties if p.name in _CORNERS and p.length), None)
            if element.name == "vertex":
                columns, at = _columns(element, body, at, order, numbers)
            elif element.name == "face" and corners is not None:
                faces, at = _triangles(element, corners, body, at, order, numbers)
            else:
                at = _skipped(element, body, at, order, numbers)
    except (IndexError, OverflowError):
        raise ValueError("the file ends before its last element") from None
    uv = next((pair for pair in _COORDINATES if columns.keys() >= set(pair)), None)
    normals = ("nx", "ny", "nz")
    return Polygons(
        np.stack([columns[axis] for axis in "xyz"], 1),
        faces,
        None if uv is None else np.stack([columns[axis] for axis in uv], 1),
        np.stack([columns[axis] for axis in normals], 1) if columns.keys() >= set(normals) else None,
    )


def _header(text: str) -> tuple[str, list[Element]]:
    """The byte order, "" of ASCII, and the kinds of elements in their order."""
    order, elements = None, list[Element]()
    for line in text.splitlines()[1:]:
        match line.split():
            case ["format", form, _] if form in _FORMATS:
                order = _FORMATS[form]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,12}", count):
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name] if {length, kind} <= _TYPES.keys() and elements:
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].properties.append(Property(name, _TYPES[kind]))
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise ValueError(f"{line[:60]!r} in its header")
    vertex = next((e for e in elements if e.name == "vertex"), None)
    if order is None or vertex is None or any(p.length for p in vertex.properties):
        raise ValueError("its header names no format, or no vertices of plain numbers")
    if not {p.name for p in vertex.properties} >= set("xyz"):
        raise ValueError("its vertices have no x, y and z")
    return order, elements


Numbers = NDArray[np.float64] | None


def _numbers(text: bytes) -> NDArray[np.float64]:
    """The numbers of an ASCII file, without a Python object for each."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):  # by version
            raise ValueError("it holds words that are no numbers") from None


def _columns(
    element: Element, body: memoryview, at: int, order: str, numbers: Numbers
) -> tuple[dict[str, NDArray[np.float64]], int]:
    """The plain values of all elements of a kind by name, and where the next kind begins."""
    names = [p.name for p in element.properties]
    if numbers is not None:
        end = at + element.count * len(names)
        if end > numbers.size:
            raise IndexError
        return dict(zip(names, numbers[at:end].reshape(-1, len(names)).T, strict=True)), end
    row = np.dtype([(f"{k}", order + p.kind) for k, p in enumerate(element.properties)])
    end = at + element.count * row.itemsize
    if end > len(body):
        raise IndexError
    rows = np.frombuffer(body[at:end], row)
    with np.errstate(invalid="ignore"):  # NaN, which the mesh is refused for
        return {name: rows[f"{k}"].astype(np.float64) for k, name in enumerate(names)}, end


def _triangles(
    element: Element, corners: Property, body: memoryview, at: int, order: str, numbers: Numbers
) -> tuple[NDArray[np.int64], int]:
    """Fans [T, 3] of polygons, in their order, and where the next kind begins."""
    if corners.kind[0] == "f":
        raise ValueError("its faces name vertices by fractions")
    places, counts = array("q"), array("q")
    for name, place, count, after in _walk(element, body, at, order, numbers):
        at = after
        if name == corners.name:
            if count < 3:
                raise ValueError(f"a face of {count} corners")
            places.append(place)
            counts.append(count)
    start, many = np.frombuffer(places, np.int64), np.frombuffer(counts, np.int64)
    size = 1 if numbers is not None else int(corners.kind[1])
    source = np.frombuffer(body, np.uint8) if numbers is None else numbers
    found, face = [], []
    for count in np.unique(many):
        rows = np.flatnonzero(many == count)
        taken = source[start[rows, None] + np.arange(count * size)]
        index = (taken if numbers is not None else taken.view(order + corners.kind)).astype(np.int64)
        fans = np.stack([np.broadcast_to(index[:, :1], index[:, 2:].shape), index[:, 1:-1], index[:, 2:]], 2)
        found.append(fans.reshape(-1, 3))
        face.append(np.repeat(rows, count - 2))
    if not found:
        return np.empty((0, 3), np.int64), at
    return np.concatenate(found)[np.argsort(np.concatenate(face), kind="stable")], at


def _skipped(element: Element, body: memoryview, at: int, order: str, numbers: Numbers) -> int:
    """Where the kind after this one begins."""
    if not any(p.length for p in element.properties):
        return _columns(element, body, at, order, numbers)[1]
    for *_, after in _walk(element, body, at, order, numbers):
        at = after
    return at


def _walk(
    element: Element, body: memoryview, at: int, order: str, numbers: Numbers
) -> Iterator[tuple[str, int, int, int]]:
    """Yield, for each list of each element, its name, where its values begin, how many there are, and where they end.

    Places are bytes, or numbers of an ASCII file. Plain values after the last list of an element count to the next.
    """
    end = len(body) if numbers is None else numbers.size
    lists: list[tuple[int, str, int, int]] = []  # plain bytes before a list, its name, sizes of its length and values
    before = 0
    for p in element.properties:
        if p.length:
            lists.append((before, p.name, int(p.length[1]), int(p.kind[1])))
            before = 0
        else:
            before += int(p.kind[1]) if numbers is None else 1
    if any(p.length[0] == "f" for p in element.properties if p.length):
        raise ValueError("lists whose length is a fraction")
    end_first: Literal["big", "little"] = "big" if order == ">" else "little"
    for _ in range(element.count):
        for skip, name, width, size in lists:
            at += skip
            if numbers is not None:
                count, at, size = int(numbers[at]), at + 1, 1
            elif width == 1:
                count, at = body[at], at + 1
            else:
                count, at = int.from_bytes(body[at : at + width], end_first), at + width
            after = at + count * size
            if not at <= after <= end:
                raise IndexError
            yield name, at, count, after
            at = after
        at += before
    if element.count and before:
        yield "", at, 0, at


LARGEST_FILE = 500_000_000  # bytes
_LONGEST = 60  # characters of a number or a corner
_INDEX = r"-?[1-9][0-9]{0,9}"
_CORNER = re.compile(rf"{_INDEX}(?:/(?:{_INDEX})?(?:/{_INDEX})?)?")
# Of each kind of line: the fewest and most words after it, how many are used, what is expected.
_OBJ_LINES = {"v": (3, 7, 3, "v X Y Z"), "vt": (2, 3, 2, "vt U V"), "vn": (3, 3, 3, "vn X Y Z")}
_FACE = "f I J K, counted from 1, or back from -1"
_LARGEST_MTL, _MOST = 4_000_000, 1000  # bytes of an MTL file, materials
_LARGEST, _LARGEST_UV = 1e60, 1e6  # areas are finite; texture coordinates have pixels left in float32
_GREY: Vector = (0.8, 0.8, 0.8)  # of a material that says nothing


@dataclass(frozen=True)
class TriangleSet:
    """A mesh as read.

    Attributes:
        vertices: [V, 3] float64 m. faces: [T, 3] counted from 0. uv: [V, 2] texture coordinates, from the lower left
            corner of a picture, or None. normals: [V, 3] unit vectors to interpolate, or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    normals: NDArray[np.float64] | None = None


class Used(NamedTuple):
    """Materials of an OBJ file: the MTL files that it names, and the material and the object of each triangle."""

    libraries: list[str]
    names: list[str]
    objects: list[str]


def read_mesh(scene: Path, field: str, settings: MeshSettings, part: TriangleSet | None = None) -> TriangleSet:
    """Triangles in scene coordinates, none degenerate; `part`: those of a file that has been read.

    Warns:
        NeurolensWarning: triangles of a file without area, which are left out.

    Raises:
        InputError: names the scene file, the field and what is wrong: a file that is missing, too large or broken,
            numbers that are not finite, a face with a vertex that does not exist or without an area.
    """
    if part is not None:
        mesh = part
    elif settings.file is not None:
        mesh = read_file(scene, f"{field}.file", scene.parent / settings.file)
    else:
        vertices = np.array(settings.vertices_m, np.float64).reshape(-1, 3)
        mesh = TriangleSet(vertices, np.array(settings.faces, np.int64).reshape(-1, 3))
    if settings.matrix is not None:
        mesh = _mapped(mesh, np.array(settings.matrix, np.float64))
    mesh = _checked(scene, field, mesh, None if settings.file is None else scene.parent / settings.file)
    angle = math.radians(settings.rotate_y_deg)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    placed = np.array(settings.scale) * mesh.vertices @ turn.T + np.array(settings.translate_m)
    if not np.all(np.abs(placed) <= FARTHEST_M):
        raise InputError(scene, f"{field}.vertices_m", "(too far)", f"points within {FARTHEST_M:g} m in the scene")
    if np.ptp(placed, axis=0).max() < SMALLEST_M:
        raise InputError(scene, f"{field}.scale", "(too small)", f"a mesh at least {SMALLEST_M:g} m wide in the scene")
    normals = mesh.normals
    if settings.smooth and normals is None:
        normals = vertex_normals(mesh.vertices, mesh.faces)
    if settings.smooth is False or normals is None:
        return TriangleSet(placed, mesh.faces, mesh.uv)
    if isinstance(settings.scale, tuple):
        normals = normals / np.array(settings.scale)
    turned = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30) @ turn.T
    return TriangleSet(placed, mesh.faces, mesh.uv, turned)


def _mapped(mesh: TriangleSet, matrix: NDArray[np.float64]) -> TriangleSet:
    """A mesh mapped by [3, 4]; a mirroring one turns its triangles, so that their fronts stay outside."""
    linear = matrix[:, :3]
    normals = None if mesh.normals is None else mesh.normals @ np.linalg.inv(linear)
    faces = mesh.faces if np.linalg.det(linear) > 0 else mesh.faces[:, ::-1]
    return TriangleSet(mesh.vertices @ linear.T + matrix[:, 3], faces, mesh.uv, normals)


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit normals [V, 3]: the area-weighted mean of the triangles around each vertex."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def _checked(scene: Path, field: str, mesh: TriangleSet, file: Path | None) -> TriangleSet:
    """The mesh, of a file without the triangles that have no area; a scene's own must have one."""
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces):
        raise InputError(scene, f"{field}.faces", "(none)", "at least one triangle")
    for name, values in (("vertices_m", vertices), ("texture coordinates", mesh.uv), ("normals", mesh.normals)):
        most = _LARGEST_UV if name == "texture coordinates" else _LARGEST
        if values is not None and not np.all(np.abs(values) <= most):
            raise InputError(scene, f"{field}.{name}", "(not finite, or too large)", f"finite numbers up to {most:g}")
    for k in np.flatnonzero(np.any((faces < 0) | (faces >= len(vertices)), axis=1))[:1]:
        raise InputError(scene, f"{field}.faces[{k}]", faces[k].tolist(), f"vertices from 0 to {len(vertices) - 1}")
    corners = vertices[faces]
    edges = corners[:, [1, 2, 0]] - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # Height over the longest side: a needle this thin has no normal in float32.
    flat = ~(area > 1e-6 * np.max(np.sum(edges**2, axis=2), axis=1))
    if not flat.any():
        return mesh
    if file is None or flat.all():
        k = int(np.flatnonzero(flat)[0])
        expected = "a triangle with an area, not a degenerate one"
        raise InputError(scene, f"{field}.faces[{k}]", faces[k].tolist(), expected)
    told = f"{file}: {flat.sum()} of {len(flat)} triangles have no area and are left out"
    warnings.warn(told, NeurolensWarning, stacklevel=2)
    return replace(mesh, faces=faces[~flat])


def read_file(scene: Path, field: str, path: Path) -> TriangleSet:
    """The triangles of an OBJ or PLY file (ASCII or binary) in its own units, polygons cut into triangles.

    Errors as of `read_mesh`.
    """
    mesh = _read(scene, field, path)[0]
    return replace(mesh, uv=_whole(mesh.uv), normals=_whole(mesh.normals))


def _whole(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Values of vertices, None where some have none (NaN)."""
    return None if values is None or np.isnan(values).any() else values


def _read(scene: Path, field: str, path: Path) -> tuple[TriangleSet, Used]:
    kind = path.suffix.lower()
    try:
        if kind not in (".obj", ".ply"):
            raise InputError(scene, field, str(path), "a mesh file that ends in .obj or .ply")
        content = read_bytes(path, LARGEST_FILE, "a mesh file", (scene, field))
        if kind == ".obj":
            return _read_obj(scene, field, path, content)
        found = read_polygons(content)
        return TriangleSet(found.vertices, found.faces, found.uv, found.normals), Used([], [], [])
    except ValueError as error:
        raise InputError(scene, field, str(path), f"a whole PLY file ({error})") from None


def _read_obj(scene: Path, field: str, path: Path, content: bytes) -> tuple[TriangleSet, Used]:
    """The triangles of an OBJ file. A vertex of the mesh is a corner as its faces write it; polygons become fans.

    Texture coordinates and normals are NaN at corners that have none.
    """
    if b"\0" in content:
        raise InputError(scene, field, str(path), "a text file, without zero bytes")
    # Only comments and names can hold more than ASCII, in any encoding. A line may go on after a backslash.
    text = content.decode("utf-8-sig", "replace").replace("\\\r\n", " ").replace("\\\n", " ")
    values: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    corners: dict[tuple[int, ...], int] = {}
    faces, name, thing, materials = [], "", "", Used([], [], [])
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.partition("#")[0].strip()
        kind, *words = bare.split() or [""]
        if kind == "mtllib":
            materials.libraries.append(bare[len(kind) :].strip())  # names may hold blanks
        elif kind == "usemtl":
            name = bare[len(kind) :].strip()
        elif kind == "o":
            thing = bare[len(kind) :].strip()
        if kind not in ("f", *_OBJ_LINES):
            continue
        place = f"{field} {path.name}, line {number}"
        if kind == "f":
            if len(words) < 3 or not all(len(word) <= _LONGEST and _CORNER.fullmatch(word) for word in words):
                raise InputError(scene, place, line[:60], _FACE)
            first, *rest = (corners.setdefault(c, len(corners)) for c in _corners(scene, place, words, values))
            faces += [(first, *edge) for edge in pairwise(rest)]
            materials.names.extend([name] * (len(rest) - 1))
            materials.objects.extend([thing] * (len(rest) - 1))
            continue
        least, most, used, form = _OBJ_LINES[kind]
        if not least <= len(words) <= most or not all(map(_is_number, words)):
            raise InputError(scene, place, line[:60], form)
        values[kind].append([float(word) for word in words[:used]])
    rows = np.array(list(corners), np.intp).reshape(-1, 3).T
    vertices, uv, normals = (
        None
        if row.size and (row < 0).all()
        else np.array([*values[kind], [math.nan] * _OBJ_LINES[kind][2]], np.float64)[row]
        for kind, row in zip(values, rows, strict=True)
    )
    assert vertices is not None  # every corner has one
    return TriangleSet(vertices, np.array(faces, np.int64).reshape(-1, 3), uv, normals), materials


def _is_number(word: str) -> bool:
    """Whether a word is a decimal number; infinity, NaN and what only Python takes for one are not."""
    try:
        return len(word) <= _LONGEST and not word.strip("0123456789+-.eE") and math.isfinite(float(word))
    except ValueError:
        return False


def _corners(scene: Path, field: str, words: list[str], values: dict[str, list[list[float]]]) -> list[tuple[int, ...]]:
    """Corners of a face as rows of `values`, -1 for what they leave out; the file may count back from the last one.

    Refused are corners that refer to something that does not come before them, and corners of unlike forms.
    """
    if len({tuple(map(bool, word.split("/"))) for word in words}) > 1:
        raise InputError(scene, field, " ".join(words)[:60], "corners of the same form, as in 1/1 2/2 3/3")
    corners = []
    for word in words:
        corner = [-1, -1, -1]
        for k, (kind, index) in enumerate(zip(values, word.split("/"), strict=False)):
            if index:
                count = len(values[kind])
                corner[k] = int(index) + (count if index.startswith("-") else -1)
                if not 0 <= corner[k] < count:
                    raise InputError(scene, field, word, f"{kind} from 1 to {count}, the lines before")
        corners.append(tuple(corner))
    return corners


def encloses(mesh: TriangleSet, point: NDArray[np.float64]) -> bool:
    """Whether a point [3] lies inside a closed mesh whose triangles face outwards.

    By the winding number, the sum of the solid angles of the triangles over 4 pi (van Oosterom and Strackee 1983): 1
    inside, 0 outside. A room, whose triangles face inwards, has -1; for an open mesh it means nothing.
    """
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    if not np.all((point > low) & (point < high)) or not _is_closed(corners):
        return False
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    volume = np.sum(a * np.cross(b, c), axis=1)
    ab, bc, ca = (np.sum(x * y, axis=1) for x, y in ((a, b), (b, c), (c, a)))
    solid = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return bool(solid.sum() / (4 * np.pi) > 0.5)


def _is_closed(corners: NDArray[np.float64]) -> bool:
    """Whether each edge of triangles [T, 3, 3] runs as often one way as the other, by position."""
    _, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = number.reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (np.unique(pair, axis=0, return_counts=True) for pair in (edges, edges[:, ::-1]))
    return forth[0].shape == back[0].shape and all(np.array_equal(x, y) for x, y in zip(forth, back, strict=True))


@dataclass
class Parts:
    """Meshes of one material each, and the materials and textures that come with them."""

    meshes: list[MeshSettings] = field(default_factory=list)
    triangles: list[TriangleSet] = field(default_factory=list)
    materials: dict[str, Material] = field(default_factory=dict)
    textures: dict[str, Texture] = field(default_factory=dict)

    def add(self, scene: Path, place: str, mesh: MeshSettings, known: Mapping[str, Material]) -> None:
        """Add a mesh: as it is where it has a material, else cut by the materials of its file.

        Raises:
            InputError: as of `read_mesh`; a file without materials, or with some that are defined nowhere.
        """
        if mesh.material is not None:
            self.meshes.append(mesh)
            self.triangles.append(read_mesh(scene, place, mesh))
            return
        if mesh.file is None or mesh.file.suffix.lower() != ".obj":
            expected = "the name of a material; only an OBJ file with usemtl brings its own"
            raise InputError(scene, f"{place}.material", "(missing)", expected)
        whole, used = _read(scene, f"{place}.file", scene.parent / mesh.file)
        libraries = list(dict.fromkeys(used.libraries))
        found = _library(scene, mesh.file, libraries)
        # Faces of a material that have texture coordinates or normals are apart from those that have none.
        has_uv, has_normals = (
            np.zeros(len(whole.faces), np.bool_) if v is None else np.isfinite(v[whole.faces[:, 0]]).all(1)
            for v in (whole.uv, whole.normals)
        )
        numbers = {name: k for k, name in enumerate(dict.fromkeys(used.names))}
        number = np.array([4 * numbers[name] for name in used.names], np.int64) + 2 * ~has_uv + ~has_normals
        names = list(numbers)
        for form in np.unique(number):
            name, chosen = names[form // 4], number == form
            material = name
            if name not in known:
                if name not in found:
                    expected = f"a material of the scene or of {', '.join(libraries) or 'an MTL file'}"
                    raise InputError(scene, f"{place}.file, usemtl", name or "(none before a face)", expected)
                objects = dict.fromkeys(used.objects[k] for k in np.flatnonzero(chosen))
                which = f"{scene.parent / mesh.file}, {', '.join(filter(None, objects)) or name}"
                material = self._defined(f"{mesh.file.stem}:{name}", found[name], not form & 2, which)
            part = replace(mesh, material=material)
            self.meshes.append(part)
            self.triangles.append(read_mesh(scene, place, part, _part(whole, chosen)))

    def _defined(self, name: str, given: tuple[Vector, Path | None], coordinates: bool, which: str) -> str:
        """The name of a material of an MTL file, for faces with texture coordinates or without, once it is defined."""
        colour, picture = given
        if picture is not None and coordinates:
            self.textures[name] = Texture("image", file=picture)
            self.materials[name] = Material("diffuse", texture=name)
            return name
        if picture is not None:
            told = f"{which[:300]}: no texture coordinates: {picture.name} is left out there"
            warnings.warn(told, NeurolensWarning, stacklevel=2)
            name += " without coordinates" if name in self.materials else ""
        self.materials[name] = Material("diffuse", reflectance=colour)
        return name


def _part(mesh: TriangleSet, chosen: NDArray[np.bool_]) -> TriangleSet:
    """Some triangles of a mesh, with the vertices that they need."""
    rows, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    uv, normals = (None if values is None else _whole(values[rows]) for values in (mesh.uv, mesh.normals))
    return TriangleSet(mesh.vertices[rows], faces.reshape(-1, 3).astype(np.int64), uv, normals)


def _library(scene: Path, mesh: Path, libraries: list[str]) -> dict[str, tuple[Vector, Path | None]]:
    """Colour, and picture beside the scene if there is one, of every material of the MTL files."""
    found: dict[str, tuple[Vector, Path | None]] = {}
    for listed in libraries:
        whole = (scene.parent / mesh).parent / PurePosixPath(listed)
        for name in [listed] if os.path.isfile(whole) else listed.split():  # several names, or one with blanks
            file = mesh.parent / PurePosixPath(name.replace("\\", "/"))
            found |= _read_mtl(scene.parent / file, file.parent)
            if len(found) > _MOST:
                raise InputError(file, "newmtl", f"({len(found)} materials)", f"at most {_MOST}")
    return found


def _read_mtl(path: Path, folder: Path) -> dict[str, tuple[Vector, Path | None]]:
    """Materials of an MTL file; `folder`: where it lies, seen from the scene.

    Raises:
        InputError: as of `read_bytes`; a colour or picture that is none.
    """
    content = read_bytes(path, _LARGEST_MTL, "an MTL file beside the OBJ file")
    found: dict[str, tuple[Vector, Path | None]] = {}
    name = ""
    for number, line in enumerate(content.decode("utf-8-sig", "replace").splitlines(), 1):
        word, _, rest = line.partition("#")[0].strip().partition(" ")
        rest = rest.strip()
        if word == "newmtl":
            name = rest
            found[name] = (_GREY, None)
        elif word in ("Kd", "map_Kd") and name not in found:
            raise InputError(path, f"line {number}, {word}", rest[:60], "newmtl before it")
        elif word == "Kd":
            found[name] = (_colour(path, number, rest), found[name][1])
        elif word == "map_Kd":
            if not rest or rest.startswith("-"):
                raise InputError(path, f"line {number}, map_Kd", rest[:60], "the name of a picture, without options")
            found[name] = (found[name][0], folder / PurePosixPath(rest.replace("\\", "/")))
    return found


def _colour(path: Path, number: int, text: str) -> Vector:
    """Linear RGB; one number stands for three."""
    words = text.split()
    try:
        values = [float(word) for word in words * (3 if len(words) == 1 else 1)] if len(text) < 100 else []
    except ValueError:
        values = []
    if len(values) != 3 or not all(0 <= v <= 1 for v in values):
        raise InputError(path, f"line {number}, Kd", text[:60], "three numbers from 0 to 1")
    return values[0], values[1], values[2]
