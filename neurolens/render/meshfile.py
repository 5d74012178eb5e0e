"""Reads triangle meshes: OBJ and PLY files through trimesh, or tables of the scene itself.

trimesh passes over what it does not understand. Files are therefore looked through first, so that no vertex and no face
of one is lost without a word; its own loaders then do the reading, without merging or mending anything.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.errors import InputError
from neurolens.render.mesh import vertex_normals
from neurolens.render.shapes import MeshSettings

LARGEST_FILE = 500_000_000  # bytes
_LARGEST_HEADER = 100_000
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_OBJ_LINES = {
    "v": (re.compile(rf"v(?:\s+{_NUMBER}){{3,7}}\s*"), "v X Y Z"),
    "vt": (re.compile(rf"vt(?:\s+{_NUMBER}){{2,3}}\s*"), "vt U V"),
    "vn": (re.compile(rf"vn(?:\s+{_NUMBER}){{3}}\s*"), "vn X Y Z"),
    "f": (re.compile(r"f(?:\s+[1-9]\d*(?:/(?:[1-9]\d*)?(?:/(?:[1-9]\d*)?)?)?){3,}\s*"), "f I J K, counted from 1"),
}


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


def read_mesh(scene: Path, field: str, settings: MeshSettings) -> TriangleSet:
    """Triangles in scene coordinates, none degenerate.

    Raises:
        InputError: names the scene file, the field and what is wrong: a file that is missing, too large or broken,
            numbers that are not finite, a face with a vertex that does not exist or without an area.
    """
    if settings.file is not None:
        mesh = read_file(scene, f"{field}.file", scene.parent / settings.file)
    else:
        vertices = np.array(settings.vertices_m, np.float64).reshape(-1, 3)
        mesh = TriangleSet(vertices, np.array(settings.faces, np.int64).reshape(-1, 3))
    _check(scene, field, mesh)
    angle = math.radians(settings.rotate_y_deg)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    placed = settings.scale * mesh.vertices @ turn.T + np.array(settings.translate_m)
    return TriangleSet(placed, mesh.faces, mesh.uv, _normals(mesh, settings.smooth, turn))


def _normals(mesh: TriangleSet, smooth: bool | None, turn: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The normals to interpolate: those of the file, else those of the triangles around, or none."""
    if smooth is False or (smooth is None and mesh.normals is None):
        return None
    own = vertex_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals
    return own / np.linalg.norm(own, axis=1, keepdims=True).clip(1e-30) @ turn.T


def _check(scene: Path, field: str, mesh: TriangleSet) -> None:
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces):
        raise InputError(scene, f"{field}.faces", "(none)", "at least one triangle")
    for name, values in (("vertices_m", vertices), ("texture coordinates", mesh.uv), ("normals", mesh.normals)):
        if values is not None and not np.all(np.isfinite(values)):
            raise InputError(scene, f"{field}.{name}", "(not finite)", "finite numbers")
    for k in np.flatnonzero(np.any((faces < 0) | (faces >= len(vertices)), axis=1))[:1]:
        raise InputError(scene, f"{field}.faces[{k}]", faces[k].tolist(), f"vertices from 0 to {len(vertices) - 1}")
    corners = vertices[faces]
    edges = corners[:, [1, 2, 0]] - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # Height over the longest side: a needle this thin has no normal in float32.
    for k in np.flatnonzero(~(area > 1e-6 * np.max(np.sum(edges**2, axis=2), axis=1)))[:1]:
        expected = "a triangle with an area, not a degenerate one"
        raise InputError(scene, f"{field}.faces[{k}]", faces[k].tolist(), expected)


def read_file(scene: Path, field: str, path: Path) -> TriangleSet:
    """The triangles of an OBJ or PLY file (ASCII or binary) in its own units; polygons are cut into triangles.

    Raises:
        InputError: see `read_mesh`.
    """
    kind = path.suffix.lower()
    if kind not in (".obj", ".ply"):
        raise InputError(scene, field, str(path), "a mesh file that ends in .obj or .ply")
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise InputError(scene, field, str(path), f"a file of at most {LARGEST_FILE} bytes")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(scene, field, str(path), f"a mesh file that can be read ({error.strerror})") from None
    least = _check_obj(scene, field, path, content) if kind == ".obj" else _check_ply(scene, field, path, content)
    try:
        parts = _load_obj(content) if kind == ".obj" else _load_ply(content)
        mesh = _joined(parts)
    except MemoryError:
        raise
    except Exception as error:  # trimesh raises whatever its parsing runs into
        raise InputError(scene, field, str(path), f"a mesh file that trimesh can read ({error})") from None
    if len(mesh.faces) < least:
        raise InputError(scene, field, str(path), f"{least} faces, as the file says, not {len(mesh.faces)}")
    return mesh


def _check_obj(scene: Path, field: str, path: Path, content: bytes) -> int:
    """Refuse lines that the loader would misread or pass over; returns the number of triangles."""
    try:
        # A line may go on after a backslash.
        text = content.decode("utf-8").replace("\\\r\n", " ").replace("\\\n", " ")
    except UnicodeDecodeError as error:
        raise InputError(scene, field, str(path), f"a text file ({error})") from None
    triangles = 0
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].strip()
        known = _OBJ_LINES.get(words.split(maxsplit=1)[0]) if words else None
        if known is None:
            continue
        pattern, form = known
        if not pattern.fullmatch(words):
            raise InputError(scene, f"{field} {path.name}, line {number}", line[:60], form)
        if words[0] == "f":
            triangles += len(words.split()) - 3
    return triangles


def _check_ply(scene: Path, field: str, path: Path, content: bytes) -> int:
    """The number of faces that the header of a PLY file promises, which also bounds the file."""
    head, end, _ = content[:_LARGEST_HEADER].partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise InputError(scene, field, str(path), "a PLY file, which begins with ply and a header")
    promised = {name: int(count) for name, count in re.findall(rb"^element (\w+) (\d+)\s*$", head, re.MULTILINE)}
    for name, count in promised.items():
        if count > len(content):
            found = f"({count} elements {name.decode()} in {len(content)} bytes)"
            raise InputError(scene, f"{field} {path.name}, header", found, "no more elements than bytes")
    return promised.get(b"face", 0)


def _load_obj(content: bytes) -> list[dict[str, Any]]:
    from trimesh.exchange.obj import load_obj

    # A loader of text; what it calls geometry is one part for each material.
    loaded = load_obj(io.StringIO(content.decode("utf-8")), skip_materials=True)
    return list(loaded.get("geometry", {}).values())


def _load_ply(content: bytes) -> list[dict[str, Any]]:
    from trimesh.exchange.ply import load_ply

    return [load_ply(io.BytesIO(content), skip_materials=True)]


def _joined(parts: list[dict[str, Any]]) -> TriangleSet:
    """Parts as one mesh; texture coordinates and normals are kept where every part has them."""
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    uv: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    first = 0
    for part in parts:
        if not len(part.get("faces", ())):
            continue
        own = np.asarray(part["vertices"], np.float64).reshape(-1, 3)
        triangles = np.asarray(part["faces"], np.int64)
        if triangles.ndim == 2 and triangles.shape[1] > 3:
            fan = [triangles[:, [0, k, k + 1]] for k in range(1, triangles.shape[1] - 1)]
            triangles = np.stack(fan, axis=1)
        vertices.append(own)
        faces.append(triangles.reshape(-1, 3) + first)
        first += len(own)
        for found, lists in ((getattr(part.get("visual"), "uv", None), uv), (part.get("vertex_normals"), normals)):
            if found is not None and len(found) == len(own):
                lists.append(np.asarray(found, np.float64))
    if not faces:
        return TriangleSet(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    extra = [np.concatenate(lists) if len(lists) == len(faces) else None for lists in (uv, normals)]
    return TriangleSet(np.concatenate(vertices), np.concatenate(faces), *extra)
