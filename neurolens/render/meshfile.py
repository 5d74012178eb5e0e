"""Triangle meshes of OBJ and PLY files, or of tables of the scene itself; nothing is merged or repaired.

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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import read_bytes
from neurolens.render.scenetables import Vector

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


LARGEST_FILE = 500_000_000  # bytes
_LONGEST = 60  # characters of a number or a corner
_INDEX = r"-?[1-9][0-9]{0,9}"
_CORNER = re.compile(rf"{_INDEX}(?:/(?:{_INDEX})?(?:/{_INDEX})?)?")
# Of each kind of line: the fewest and most words after it, how many are used, what is expected.
_OBJ_LINES = {"v": (3, 7, 3, "v X Y Z"), "vt": (2, 3, 2, "vt U V"), "vn": (3, 3, 3, "vn X Y Z")}
_LARGEST_MTL, _MOST = 4_000_000, 1000  # bytes of an MTL file, materials
_GREY: Vector = (0.8, 0.8, 0.8)  # of a material that says nothing


@dataclass(frozen=True)
class TriangleSet:
    """A mesh as read.

    Attributes:
        vertices: [V, 3] float64 m. faces: [T, 3] counted from 0. uv: [V, 2] texture coordinates, from the lower left
            corner of a picture, or None. normals: [V, 3] unit vectors to interpolate, or None.
        libraries: MTL files that an OBJ file names. materials, objects: of each of its triangles, by name.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None = None
    normals: NDArray[np.float64] | None = None
    libraries: Sequence[str] = ()
    materials: Sequence[str] = ()
    objects: Sequence[str] = ()


def whole_values(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Values of vertices, None where some have none (NaN)."""
    return None if values is None or np.isnan(values).any() else values


def read_file(scene: Path, field: str, path: Path, whole: bool = True) -> TriangleSet:
    """The triangles of an OBJ or PLY file (ASCII or binary) in its own units, polygons cut into triangles.

    Without `whole`, texture coordinates and normals of an OBJ file are NaN at corners that have none; with it they
    count where all corners have them. Errors as of `read_mesh`.
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
    """The triangles of an OBJ file. A vertex of the mesh is a corner as its faces write it; polygons become fans."""
    if b"\0" in content:
        raise InputError(scene, field, str(path), "a text file, without zero bytes")
    # Only comments and names can hold more than ASCII, in any encoding. A line may go on after a backslash.
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


def read_library(scene: Path, mesh: Path, libraries: list[str]) -> dict[str, tuple[Vector, Path | None]]:
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
    """A value of each element of a kind in a PLY file, or a list of values, whose length is of type `length`."""

    name: str
    kind: str
    length: str = ""


@dataclass(frozen=True)
class Element:
    """A kind of element in a PLY file, how many the header promises, and what each has."""

    name: str
    count: int
    properties: list[Property]

    @property
    def plain(self) -> bool:
        """Whether it has no lists."""
        return not any(p.length for p in self.properties)


def read_polygons(content: bytes) -> TriangleSet:
    """Read the bytes of a PLY file; polygons are cut into fans.

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
    columns, faces = dict[str, NDArray[np.float64]](), np.empty((0, 3), np.int64)
    try:
        body = _Body(content[content.index(b"\n", len(head)) + 1 :], order)
        for element in elements:
            found, fans = (body.columns(element), faces) if element.plain else ({}, body.fans(element))
            columns = found if element.name == "vertex" else columns
            faces = fans if element.name == "face" else faces
    except (IndexError, OverflowError):
        raise ValueError("the file ends before its last element") from None

    def stacked(*names: str) -> NDArray[np.float64] | None:
        return np.stack([columns[name] for name in names], 1) if columns.keys() >= set(names) else None

    vertices, uvs = stacked(*"xyz"), (stacked(*pair) for pair in _COORDINATES)
    assert vertices is not None  # the header has them
    return TriangleSet(vertices, faces, next((uv for uv in uvs if uv is not None), None), stacked("nx", "ny", "nz"))


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
                if _TYPES[length][0] == "f" or (name in _CORNERS and _TYPES[kind][0] == "f"):
                    raise ValueError("lists whose length is a fraction, or faces that name vertices by fractions")
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].properties.append(Property(name, _TYPES[kind]))
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise ValueError(f"{line[:60]!r} in its header")
    vertex = next((e for e in elements if e.name == "vertex"), None)
    if order is None or vertex is None or not vertex.plain:
        raise ValueError("its header names no format, or no vertices of plain numbers")
    if not {p.name for p in vertex.properties} >= set("xyz"):
        raise ValueError("its vertices have no x, y and z")
    return order, elements


def _numbers(text: bytes) -> NDArray[np.float64]:
    """The numbers of an ASCII file, without a Python object for each."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, np.float64, sep=" ")
        except (ValueError, DeprecationWarning):  # by version
            raise ValueError("it holds words that are no numbers") from None


class _Body:
    """The part of a PLY file after its header: bytes in an order ("<", ">"), or the numbers of an ASCII file ("").

    It is read from the place `at` on, which counts bytes, or numbers. IndexError: it ends too early.
    """

    def __init__(self, content: bytes, order: str) -> None:
        self._content, self._order, self._at = content, order, 0
        self._values: NDArray[Any] = np.frombuffer(content, np.uint8) if order else _numbers(content)

    def _size(self, kind: str) -> int:
        return int(kind[1]) if self._order else 1

    def columns(self, element: Element) -> dict[str, NDArray[np.float64]]:
        """The values by name of the next elements, which have no lists."""
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
        with np.errstate(invalid="ignore"):  # NaN, which the mesh is refused for
            return {p.name: v.astype(np.float64) for p, v in zip(element.properties, values, strict=True)}

    def fans(self, element: Element) -> NDArray[np.int64]:
        """The polygons of the next elements, in their order, as fans of triangles [T, 3]; none without corners."""
        big: Literal["big", "little"] = "big" if self._order == ">" else "little"
        starts, counts, form = array("q"), array("q"), ""  # where the corners of each begin, and how many there are
        at, end = self._at, self._values.size
        for _ in range(element.count):
            for name, kind, length in element.properties:
                count = 1
                if length:
                    first, at = at, at + self._size(length)
                    number = self._content[first:at] if self._order else self._values[first]
                    count = int.from_bytes(number, big) if isinstance(number, bytes) else int(number)
                    if name in _CORNERS:
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
