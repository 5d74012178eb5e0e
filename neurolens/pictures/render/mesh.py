"""Triangle meshes of OBJ and PLY files, or of tables of the scene, placed in it; nothing is merged or repaired.

Files are checked so that no vertex and no face is lost silently. Where an OBJ file has materials, texture coordinates
and normals count for each face that has them; where the scene gives one material, only if all faces have them. Of the
MTL files that an OBJ file names, diffuse colours and pictures (Kd, map_Kd) are read and nothing else. A material of the
scene with the name that `usemtl` says comes before theirs.

PLY files are ASCII, or binary of either byte order. Each face may have its own number of corners. What else a file
holds (colours, edges, flags of faces) is passed over. Source: G. Turk, The PLY Polygon File Format (1994).
"""

import math
import os
import re
import warnings
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, warn
from neurolens.base.files import read_bytes
from neurolens.pictures.render.scenetables import FARTHEST_M, SMALLEST_M, Material, MeshSettings, Texture, Vector

_LARGEST, _LARGEST_UV = 1e60, 1e6  # so that areas are finite, and texture coordinates tell pixels apart in float32
_LARGEST_HEADER, _LONGEST = 100_000, 60  # characters of PLY's header, and of a number or a corner
_KINDS = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64".split()
_TYPES = dict(zip(_KINDS, ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8") * 2, strict=True))
_COUNTS = {name for name, kind in _TYPES.items() if kind[0] != "f"}  # types that the length of a list may have
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_COORDINATES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))
LARGEST_FILE = 500_000_000  # bytes
_INDEX = r"-?[1-9][0-9]{0,9}"
_CORNER = re.compile(rf"{_INDEX}(?:/(?:{_INDEX})?(?:/{_INDEX})?)?")
# Of each kind of line: the fewest and most words after it, how many are used, what is expected.
_OBJ_LINES = {"v": (3, 7, 3, "v X Y Z"), "vt": (2, 3, 2, "vt U V"), "vn": (3, 3, 3, "vn X Y Z")}
_LARGEST_MTL, _MOST = 4_000_000, 1000  # bytes of an MTL file, materials
_GREY: Vector = (0.8, 0.8, 0.8)  # colour of a material that states none


@dataclass(frozen=True)
class TriangleSet:
    """A mesh as it was read.

    Attributes:
        vertices: [V, 3] float64, m. faces: [T, 3], counted from 0. uv: [V, 2] texture coordinates, from the lower left
            corner of a picture, or None. normals: [V, 3] unit vectors to interpolate, or None.
        libraries: MTL files that an OBJ file names. materials, objects: for each of its triangles, their names.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    normals: NDArray[np.float64] | None = None
    libraries: Sequence[str] = ()
    materials: Sequence[str] = ()
    objects: Sequence[str] = ()


def whole_values(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return values of vertices, or None where some vertex has none (NaN)."""
    return None if values is None or np.isnan(values).any() else values


def read_file(scene: Path, field: str, path: Path, whole: bool = True) -> TriangleSet:
    """Read the triangles of an OBJ or PLY file (ASCII or binary) in its own units; polygons are cut into triangles.

    Without `whole`, texture coordinates and normals of an OBJ file are NaN at corners that have none. With it, they are
    read only where all corners have them. Errors are those of `read_mesh`.
    """
    kind = path.suffix.lower()
    try:
        if kind not in (".obj", ".ply"):
            raise InputError(scene, field, str(path), "a mesh file that ends in .obj or .ply")
        content = read_bytes(path, LARGEST_FILE, "a mesh file", (scene, field))
        mesh = _read_obj(scene, field, path, content) if kind == ".obj" else read_polygons(content)
    except ValueError as error:
        raise InputError(scene, field, str(path), f"a whole PLY file ({error})") from None
    return replace(mesh, uv=whole_values(mesh.uv), normals=whole_values(mesh.normals)) if whole else mesh


def _read_obj(scene: Path, field: str, path: Path, content: bytes) -> TriangleSet:
    """Read the triangles of an OBJ file. Each corner, as its faces write it, is a vertex; polygons become fans."""
    if b"\0" in content:
        raise InputError(scene, field, str(path), "a text file, without zero bytes")
    # Only comments and names can hold more than ASCII, in any encoding. After a backslash a line goes on.
    text = content.decode("utf-8-sig", "replace").replace("\\\r\n", " ").replace("\\\n", " ")
    values: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    corners: dict[tuple[int, ...], int] = {}
    faces, libraries, materials, objects = list[tuple[int, ...]](), list[str](), list[str](), list[str]()
    names = {"usemtl": "", "o": ""}  # of the material and of the object
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.partition("#")[0].strip()
        kind, *words = bare.split() or [""]
        place = f"{field} {path.name}, line {number}"
        if kind == "mtllib":
            libraries.append(bare[len(kind) :].strip())  # names may hold blanks
        elif kind in names:
            names[kind] = bare[len(kind) :].strip()
        elif kind == "f":
            if len(words) < 3 or not all(len(word) <= _LONGEST and _CORNER.fullmatch(word) for word in words):
                raise InputError(scene, place, line[:60], "f I J K, counted from 1, or back from -1")
            first, *rest = (corners.setdefault(c, len(corners)) for c in _corners(scene, place, words, values))
            faces += [(first, *edge) for edge in pairwise(rest)]
            materials += [names["usemtl"]] * (len(rest) - 1)
            objects += [names["o"]] * (len(rest) - 1)
        elif kind in _OBJ_LINES:
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
    triangles = np.array(faces, np.int64).reshape(-1, 3)
    return TriangleSet(vertices, triangles, uv, normals, libraries, materials, objects)


def _is_number(word: str) -> bool:
    """Return whether a word is a decimal number; infinity, NaN and forms that only Python reads are not."""
    try:
        return len(word) <= _LONGEST and not word.strip("0123456789+-.eE") and math.isfinite(float(word))
    except ValueError:
        return False


def _corners(scene: Path, field: str, words: list[str], values: dict[str, list[list[float]]]) -> list[tuple[int, ...]]:
    """Return the corners of a face as rows of `values`, -1 for what they leave out; files may count back from the last.

    A corner is refused if it refers to something that does not come before it, or differs in form from the others.
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


def read_library(scene: Path, mesh: Path, libraries: list[str]) -> dict[str, tuple[Vector, Path | None]]:
    """Read the colour, and the picture beside the scene if there is one, of every material of the MTL files."""
    found: dict[str, tuple[Vector, Path | None]] = {}
    for listed in libraries:
        whole = (scene.parent / mesh).parent / PurePosixPath(listed)
        for name in [listed] if os.path.isfile(whole) else listed.split():  # several names, or one with blanks in it
            file = mesh.parent / PurePosixPath(name.replace("\\", "/"))
            found |= _read_mtl(scene.parent / file, file.parent)
            if len(found) > _MOST:
                raise InputError(file, "newmtl", f"({len(found)} materials)", f"at most {_MOST}")
    return found


def _read_mtl(path: Path, folder: Path) -> dict[str, tuple[Vector, Path | None]]:
    """Read the materials of an MTL file; `folder` is where it lies, seen from the scene.

    Raises:
        InputError: as of `read_bytes`; a colour or picture that is none.
    """
    content = read_bytes(path, _LARGEST_MTL, "an MTL file beside the OBJ file")
    found: dict[str, tuple[Vector, Path | None]] = {}
    name = ""
    for number, line in enumerate(content.decode("utf-8-sig", "replace").splitlines(), 1):
        word, _, rest = line.partition("#")[0].strip().partition(" ")
        place, rest = f"line {number}, {word}", rest.strip()
        if word == "newmtl":
            name = rest
            found[name] = (_GREY, None)
        elif word in ("Kd", "map_Kd") and name not in found:
            raise InputError(path, place, rest[:60], "newmtl before it")
        elif word == "Kd":  # linear RGB; one number stands for three
            words = rest.split()
            values = [float(w) for w in words if _is_number(w) and 0 <= float(w) <= 1]
            if len(words) not in (1, 3) or len(values) != len(words):
                raise InputError(path, place, rest[:60], "three numbers from 0 to 1")
            red, green, blue = (values * 3)[:3]
            found[name] = ((red, green, blue), found[name][1])
        elif word == "map_Kd":
            if not rest or rest.startswith("-"):
                raise InputError(path, place, rest[:60], "the name of a picture, without options")
            found[name] = (found[name][0], folder / PurePosixPath(rest.replace("\\", "/")))
    return found


class Property(NamedTuple):
    """What each element of a kind in a PLY file has: a value, or a list of values whose length is of type `length`."""

    name: str
    kind: str
    length: str = ""


@dataclass(frozen=True)
class Element:
    """A kind of element in a PLY file: how many the header promises, and what each has."""

    name: str
    count: int
    properties: list[Property]


def read_polygons(content: bytes) -> TriangleSet:
    """Read the bytes of a PLY file; polygons are cut into fans.

    Raises:
        ValueError: no PLY file, or one that ends early; says what is wrong.
    """
    head, end, _ = content[:_LARGEST_HEADER].partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise ValueError("expected a PLY file, which begins with ply and a header")
    order, elements = _header(head.decode("ascii", "replace"))
    if (most := max(elements, key=lambda e: e.count)).count > len(content):
        raise ValueError(f"{most.count} elements {most.name} in {len(content)} bytes")
    columns, faces = dict[str, NDArray[np.float64]](), np.empty((0, 3), np.int64)
    try:
        body = _Body(content[content.index(b"\n", len(head)) + 1 :], order)
        for element in elements:
            if any(p.length for p in element.properties):
                faces = np.concatenate([faces, body.fans(element)])
            elif (found := body.columns(element)) and element.name == "vertex":
                columns = found
    except (IndexError, OverflowError):
        raise ValueError("the file ends before its last element") from None

    def stacked(*names: str) -> NDArray[np.float64] | None:
        return np.stack([columns[name] for name in names], 1) if columns.keys() >= set(names) else None

    vertices, uvs = stacked(*"xyz"), (stacked(*pair) for pair in _COORDINATES)
    assert vertices is not None  # the header has them
    return TriangleSet(vertices, faces, next((uv for uv in uvs if uv is not None), None), stacked("nx", "ny", "nz"))


def _header(text: str) -> tuple[str, list[Element]]:
    """Return the byte order ("" for ASCII) and the kinds of elements in their order."""
    order, elements = None, list[Element]()
    for line in text.splitlines()[1:]:
        match line.split():
            case ["format", form, _] if form in _FORMATS:
                order = _FORMATS[form]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,12}", count):
                elements.append(Element(name, int(count), []))
            case ["property", "list", many, kind, name] if many in _COUNTS and kind in _TYPES and elements:
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[many]))
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


def _numbers(text: bytes) -> NDArray[np.float64]:
    """Read the numbers of an ASCII file, without a Python object for each."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):  # by version
            raise ValueError("it holds words that are no numbers") from None


class _Body:
    """The part of a PLY file after its header: bytes in an order ("<", ">"), or the numbers of an ASCII file ("").

    It is read from the place `at` on, which counts bytes or numbers. Raises IndexError where it ends too early.
    """

    def __init__(self, content: bytes, order: str) -> None:
        self._content, self._order, self._at = content, order, 0
        self._values: NDArray[Any] = np.frombuffer(content, np.uint8) if order else _numbers(content)

    def _size(self, kind: str) -> int:
        return int(kind[1]) if self._order else 1

    def columns(self, element: Element) -> dict[str, NDArray[np.float64]]:
        """Read the next elements, which have no lists; returns their values by name."""
        kinds = [p.kind for p in element.properties]
        start, self._at = self._at, self._at + element.count * sum(map(self._size, kinds))
        if self._at > self._values.size:
            raise IndexError
        values: Any = self._values[start : self._at]
        if self._order:
            rows = values.view(np.dtype([(f"{k}", self._order + kind) for k, kind in enumerate(kinds)]))
            values = [rows[f"{k}"] for k in range(len(kinds))]
        else:
            values = values.reshape(element.count, len(kinds)).T
        with np.errstate(invalid="ignore"):  # a mesh with NaN is refused later
            return {p.name: v.astype(np.float64) for p, v in zip(element.properties, values, strict=True)}

    def fans(self, element: Element) -> NDArray[np.int64]:
        """Read the next elements; if they are faces, return their polygons, in order, as fans of triangles [T, 3]."""
        names = [p.name for p in element.properties if p.name in _CORNERS and p.length and element.name == "face"]
        big: Literal["big", "little"] = "big" if self._order == ">" else "little"
        # where the corners of each polygon begin, and how many it has
        starts, counts, form = array("q"), array("q"), ""
        at, end = self._at, self._values.size
        for _ in range(element.count):
            for name, kind, length in element.properties:
                count = 1
                if length:
                    first, at = at, at + self._size(length)
                    number = self._content[first:at] if self._order else self._values[first]
                    count = int.from_bytes(number, big) if isinstance(number, bytes) else int(number)
                    if name in names[:1] and kind[0] == "f":
                        raise ValueError("its faces name vertices by fractions")
                    if name in names[:1]:
                        starts.append(at)
                        counts.append(count)
                        form = kind
                at += count * self._size(kind)
                if count < 0 or at > end:
                    raise IndexError
        self._at = at
        start, many = np.frombuffer(starts, np.int64), np.frombuffer(counts, np.int64)
        if (few := many[many < 3]).size:
            raise ValueError(f"a face of {few[0]} corners")
        fans, face = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
        for count in np.unique(many).tolist():
            rows = np.flatnonzero(many == count)
            taken = self._values[start[rows][:, None] + np.arange(count * self._size(form))]
            index = (taken.view(self._order + form) if self._order else taken).astype(np.int64)
            corner = np.broadcast_to(index[:, :1], (len(rows), count - 2))
            fans.append(np.stack([corner, index[:, 1:-1], index[:, 2:]], 2).reshape(-1, 3))
            face.append(np.repeat(rows, count - 2))
        return np.concatenate(fans)[np.argsort(np.concatenate(face), kind="stable")]


def read_mesh(scene: Path, field: str, settings: MeshSettings, part: TriangleSet | None = None) -> TriangleSet:
    """Return triangles in scene coordinates, none degenerate; `part` has them where their file has been read.

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
    """Map a mesh by a matrix [3, 4]; where that mirrors, triangles are turned, so that their fronts stay outside."""
    linear = matrix[:, :3]
    normals = None if mesh.normals is None else mesh.normals @ np.linalg.inv(linear)
    faces = mesh.faces if np.linalg.det(linear) > 0 else mesh.faces[:, ::-1]
    return TriangleSet(mesh.vertices @ linear.T + matrix[:, 3], faces, mesh.uv, normals)


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return unit normals [V, 3]: the area-weighted mean of the triangles around each vertex."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def _checked(scene: Path, field: str, mesh: TriangleSet, file: Path | None) -> TriangleSet:
    """Return the mesh. A file's triangles without area are left out; those of the scene's own must have one."""
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
    # By the height over the longest side: a needle this thin has no normal in float32.
    flat = ~(area > 1e-6 * np.max(np.sum(edges**2, axis=2), axis=1))
    if not flat.any():
        return mesh
    if file is None or flat.all():
        k = int(np.flatnonzero(flat)[0])
        expected = "a triangle with an area, not a degenerate one"
        raise InputError(scene, f"{field}.faces[{k}]", faces[k].tolist(), expected)
    warn(f"{file}: {flat.sum()} of {len(flat)} triangles have no area and are left out")
    return replace(mesh, faces=faces[~flat])


class Parts:
    """The meshes of a scene in parts of one material each, with the materials and textures that come with them.

    A mesh that has a material is one part; any other is cut by the materials of its file. `known` are the scene's.

    Raises:
        InputError: as `read_mesh`; also for a file without materials, or with some that are defined nowhere.
    """

    def __init__(self, scene: Path, meshes: Sequence[MeshSettings], known: Mapping[str, Material]) -> None:
        self.meshes, self.triangles = list[MeshSettings](), list[TriangleSet]()
        self.materials, self.textures = dict[str, Material](), dict[str, Texture]()
        for k, mesh in enumerate(meshes):
            self._add(scene, f"meshes[{k}]", mesh, known)

    def _add(self, scene: Path, place: str, mesh: MeshSettings, known: Mapping[str, Material]) -> None:
        if mesh.material is not None:
            self.meshes.append(mesh)
            self.triangles.append(read_mesh(scene, place, mesh))
            return
        if mesh.file is None or mesh.file.suffix.lower() != ".obj":
            expected = "the name of a material; only an OBJ file with usemtl brings its own"
            raise InputError(scene, f"{place}.material", "(missing)", expected)
        whole = read_file(scene, f"{place}.file", scene.parent / mesh.file, whole=False)
        libraries = list(dict.fromkeys(whole.libraries))
        found = read_library(scene, mesh.file, libraries)
        # Faces of a material are apart where only some have texture coordinates, or normals.
        has_uv, has_normals = (
            np.zeros(len(whole.faces), np.bool_) if v is None else np.isfinite(v[whole.faces[:, 0]]).all(1)
            for v in (whole.uv, whole.normals)
        )
        numbers = {name: k for k, name in enumerate(dict.fromkeys(whole.materials))}
        number = np.array([4 * numbers[name] for name in whole.materials], np.int64) + 2 * ~has_uv + ~has_normals
        names = list(numbers)
        for form in np.unique(number):
            name, chosen = names[form // 4], number == form
            material = name
            if name not in known:
                if name not in found:
                    expected = f"a material of the scene or of {', '.join(libraries) or 'an MTL file'}"
                    raise InputError(scene, f"{place}.file, usemtl", name or "(none before a face)", expected)
                objects = dict.fromkeys(whole.objects[k] for k in np.flatnonzero(chosen).tolist())
                which = f"{scene.parent / mesh.file}, {', '.join(filter(None, objects)) or name}"
                material = self._defined(f"{mesh.file.stem}:{name}", found[name], not form & 2, which)
            part = replace(mesh, material=material)
            self.meshes.append(part)
            self.triangles.append(read_mesh(scene, place, part, _part(whole, chosen)))

    def _defined(self, name: str, look: tuple[Vector, Path | None], coordinates: bool, which: str) -> str:
        """Define a material of an MTL file, for faces with texture coordinates or without, and return its name."""
        colour, picture = look
        if picture is not None and coordinates:
            self.textures[name] = Texture("image", file=picture)
            self.materials[name] = Material("diffuse", texture=name)
            return name
        if picture is not None:
            warn(f"{which[:300]}: no texture coordinates: {picture.name} is left out there")
            name += " without coordinates" if name in self.materials else ""
        self.materials[name] = Material("diffuse", reflectance=colour)
        return name


def _part(mesh: TriangleSet, chosen: NDArray[np.bool_]) -> TriangleSet:
    """Return some triangles of a mesh, with the vertices that they need."""
    rows, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    uv, normals = (None if values is None else whole_values(values[rows]) for values in (mesh.uv, mesh.normals))
    return TriangleSet(mesh.vertices[rows], faces.reshape(-1, 3).astype(np.int64), uv, normals)
