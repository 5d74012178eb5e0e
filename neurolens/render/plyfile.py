"""PLY files, ASCII or binary of either byte order: vertices with normals and texture coordinates, and polygons.

Faces may have any number of corners, each another; what else a file holds (colours, edges, flags of faces) is passed
over. Source: G. Turk, The PLY Polygon File Format (1994).
"""

from __future__ import annotations

import re
import warnings
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
