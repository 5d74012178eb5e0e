"""Triangle meshes: from the tables of a scene, or its files, to what rays hit, by Embree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensError, warn
from neurolens.cameras.contract import FloatArray
from neurolens.render.meshfile import TriangleSet, read_file, read_library, whole_values
from neurolens.render.primitives import NEAREST, FloatArray64, IntArray, Rays, slabs
from neurolens.render.scenetables import FARTHEST_M, SMALLEST_M, Material, MeshSettings, Texture, Vector

_LARGEST, _LARGEST_UV = 1e60, 1e6  # areas are finite; texture coordinates have pixels left in float32
_STEP = np.float32(1e-5)  # m by which a ray that met its own start surface is moved on


def has_embree() -> bool:
    """Whether Embree is installed, which has no wheel for some machines."""
    return find_spec("embreex") is not None


class Mesh:
    """Triangles [T, 3 corners, 3] in m, for Embree; `each` of them in a row are one surface, from `first` on.

    Raises:
        NeurolensError: Embree is not installed.
    """

    def __init__(self, first: int, triangles: FloatArray64, each: int = 1) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise NeurolensError("meshes need Embree, which is not installed: pip install embreex") from None
        self.first, self._each = first, each
        corners = np.ascontiguousarray(triangles, np.float32)
        # Robust: watertight at the edges that triangles share.
        self._scene = EmbreeScene(robust=True)
        self._triangles = TriangleMesh(self._scene, corners)
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

    @classmethod
    def of_rectangles(cls, first: int, corners: FloatArray64) -> Mesh:
        """Rectangles [T, 3 corners, 3], whose corner 0 lies between the other two: two triangles each."""
        far = corners[:, 1] + corners[:, 2] - corners[:, 0]
        others = np.stack([far, corners[:, 2], corners[:, 1]], axis=1)
        return cls(first, np.stack([corners, others], axis=1).reshape(-1, 3, 3), each=2)

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        entry, exit_ = slabs(rays, self._low, self._high)
        np.minimum(exit_, best, out=exit_)
        np.maximum(entry, NEAREST, out=entry)
        # The box of a flat mesh is flat: a small margin keeps its triangles inside.
        ray = np.flatnonzero(entry * np.float32(1 - 1e-5) <= exit_)
        start = rays.origin.take(ray, axis=1)
        moved = np.zeros(len(ray), np.float32)
        while ray.size:
            direction = rays.direction.take(ray, axis=1)
            reach = np.minimum(best.take(ray) - moved, np.float32(1e30))
            origin, towards = np.ascontiguousarray(start.T), np.ascontiguousarray(direction.T)
            hit = self._scene.run(origin, towards, dists=reach, output=True)
            met = np.flatnonzero(hit["primID"] >= 0)
            distance = hit["tfar"][met] + moved[met]
            ok = (distance > NEAREST) & (distance < best[ray[met]])
            best[ray[met[ok]]] = distance[ok]
            found[ray[met[ok]]] = self.first + hit["primID"][met[ok]] // self._each
            again = met[distance <= NEAREST]
            ray, moved = ray[again], moved[again] + _STEP
            start = start.take(again, axis=1) + direction.take(again, axis=1) * _STEP


def triangle_planes(corners: FloatArray64) -> FloatArray64:
    """Plane and barycentric coordinates of triangles [T, 3, 3] as affine functions of a point, [T, 3, 4].

    Row 0 is the distance from the plane, rows 1 and 2 the weights of corners 1 and 2.
    """
    a, edge_b, edge_c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_b, edge_c)
    area2 = np.maximum(np.sum(normal**2, axis=1, keepdims=True), 1e-300)  # a triangle of less is never hit
    unit = normal / np.sqrt(area2)
    across_b, across_c = np.cross(edge_c, normal) / area2, np.cross(normal, edge_b) / area2
    rows = [np.column_stack([n, -np.sum(n * a, axis=1)]) for n in (unit, across_b, across_c)]
    return np.stack(rows, axis=1)


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
    warn(f"{file}: {flat.sum()} of {len(flat)} triangles have no area and are left out")
    return replace(mesh, faces=faces[~flat])


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
    """Whether each edge of triangles [T, 3, 3], by position, runs as often forwards as backwards."""
    _, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = number.reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (np.unique(pair, axis=0, return_counts=True) for pair in (edges, edges[:, ::-1]))
    return forth[0].shape == back[0].shape and all(np.array_equal(x, y) for x, y in zip(forth, back, strict=True))


class Parts:
    """The meshes of a scene in parts of one material each, and the materials and textures that come with them.

    A mesh that has a material is one part, another is cut by the materials of its file. `known`: those of the scene.

    Raises:
        InputError: as of `read_mesh`; a file without materials, or with some that are defined nowhere.
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
        # Faces of a material that have texture coordinates or normals are apart from those that have none.
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
        """The name of a material of an MTL file, for faces with texture coordinates or without, once it is defined."""
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
    """Some triangles of a mesh, with the vertices that they need."""
    rows, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    uv, normals = (None if values is None else whole_values(values[rows]) for values in (mesh.uv, mesh.normals))
    return TriangleSet(mesh.vertices[rows], faces.reshape(-1, 3).astype(np.int64), uv, normals)
