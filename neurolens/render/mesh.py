"""Triangle meshes: from the tables of a scene to what rays hit; and trees over many spheres or rectangles.

A bounding-volume tree is traversed by whole batches of rays. Nodes have 16 children and leaves 8 shapes: few levels,
and at each level one dense test of every (ray, node) pair against 16 boxes or 8 shapes, which suits numpy. Triangles
carry the three planes of Havel and Herout 2010, "Yet faster ray-triangle intersection".

Where the Python binding of Embree is installed (`pip install neurolens[embree]`), Embree takes the place of the tree.
Hits agree within the rounding of float32.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.cameras.contract import FloatArray
from neurolens.render.meshfile import TriangleSet, read_file, read_library, read_triangles, whole_values
from neurolens.render.primitives import NEAREST, FloatArray64, IntArray, Primitive, Rays, Spheres, slabs
from neurolens.render.scenetables import FARTHEST_M, SMALLEST_M, Material, MeshSettings, Texture, Vector

_BRANCHES, _LEAF = 16, 8
_LARGEST, _LARGEST_UV = 1e60, 1e6  # areas are finite; texture coordinates have pixels left in float32
_PAIRS_AT_ONCE = 4096  # keeps the [pairs, 8] temporaries inside the L2 cache
_STEP = np.float32(1e-5)  # m by which a ray that met its own start surface is moved on


def _split(rows: NDArray[np.intp], centres: FloatArray64) -> list[NDArray[np.intp]]:
    """Up to 16 groups of triangles: the largest group is halved at the median of its longest side, again and again."""
    groups = [rows]
    while len(groups) < _BRANCHES:
        groups.sort(key=len)
        group = groups.pop()
        if len(group) <= _LEAF:
            groups.append(group)
            break
        axis = int(np.argmax(np.ptp(centres[group], axis=0)))
        order = group[np.argsort(centres[group, axis], kind="stable")]
        # A left half of whole leaves keeps the leaves full.
        half = max(_LEAF, len(order) // 2 // _LEAF * _LEAF)
        groups += [order[:half], order[half:]]
    return groups


def _tree(centres: FloatArray64, low: FloatArray64, high: FloatArray64) -> tuple[list, list, list]:
    """A tree over triangles of some middles and bounds [T, 3]: of each node boxes [16, 6] and children [16]; leaves.

    A child is a node number, or -1 - leaf number.
    """
    boxes: list[FloatArray64] = []
    children: list[NDArray[np.int32]] = []
    leaves: list[NDArray[np.intp]] = []

    def build(rows: NDArray[np.intp]) -> int:
        """Append the node over triangles `rows` and everything below; return its number."""
        number = len(boxes)
        box = np.full((_BRANCHES, 6), np.nan)  # no ray meets an empty child, as NaN fails every comparison
        child = np.zeros(_BRANCHES, np.int32)
        boxes.append(box)
        children.append(child)
        for k, group in enumerate(_split(rows, centres)):
            box[k] = np.concatenate([low[group].min(axis=0), high[group].max(axis=0)])
            if len(group) <= _LEAF:
                child[k] = -1 - len(leaves)
                leaves.append(np.resize(group, _LEAF))  # short leaves repeat their triangles
            else:
                child[k] = build(group)
        return number

    build(np.arange(len(centres)))
    return boxes, children, leaves


class Tree:
    """Shapes within boxes, from `low` to `high` [T, 3] m, with a tree over them; shape k is surface `first` + k."""

    def __init__(self, first: int, centres: FloatArray64, low: FloatArray64, high: FloatArray64) -> None:
        self.first = first
        boxes, children, leaves = _tree(centres, low, high)
        self._low, self._high = low.min(axis=0).astype(np.float32), high.max(axis=0).astype(np.float32)
        bounds = np.array(boxes)  # [nodes, 16, 6]
        # Slightly wider, so that rounding to float32 never cuts a shape off.
        grow = 1e-6 * max(1.0, float(np.abs(low).max()), float(np.abs(high).max()))
        self._node_low = np.ascontiguousarray((bounds[..., :3] - grow).transpose(2, 0, 1), np.float32)
        self._node_high = np.ascontiguousarray((bounds[..., 3:] + grow).transpose(2, 0, 1), np.float32)
        self._children = np.array(children)
        self._leaf_rows = np.array(leaves, np.int32)  # [L, 8]

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        entry, exit_ = slabs(rays, self._low, self._high)
        np.minimum(exit_, best, out=exit_)
        np.maximum(entry, NEAREST, out=entry)
        ray = np.flatnonzero(entry <= exit_)
        node = np.zeros(len(ray), np.intp)
        while ray.size:
            pair, slot = np.divmod(np.flatnonzero(self._meets_children(rays, best, ray, node)), _BRANCHES)
            child = self._children[node[pair], slot]
            ray = ray[pair]
            is_leaf = child < 0
            leaf_ray, leaf = ray[is_leaf], -1 - child[is_leaf]
            for start in range(0, len(leaf), _PAIRS_AT_ONCE):
                part = slice(start, start + _PAIRS_AT_ONCE)
                self._meet_leaves(rays, best, found, leaf_ray[part], leaf[part])
            ray, node = ray[~is_leaf], child[~is_leaf].astype(np.intp)

    def _meets_children(
        self, rays: Rays, best: FloatArray, ray: NDArray[np.intp], node: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """Which of the 16 children [pairs, 16] each ray enters before its nearest hit."""
        entry = np.full((len(ray), _BRANCHES), NEAREST)
        exit_ = np.repeat(best[ray][:, None], _BRANCHES, axis=1)
        for k in range(3):
            origin, inverse = rays.origin[k].take(ray)[:, None], rays.inverse[k].take(ray)[:, None]
            to_low = self._node_low[k].take(node, axis=0)
            to_low -= origin
            to_low *= inverse
            to_high = self._node_high[k].take(node, axis=0)
            to_high -= origin
            to_high *= inverse
            np.maximum(entry, np.minimum(to_low, to_high), out=entry)
            np.minimum(exit_, np.maximum(to_low, to_high), out=exit_)
        return entry <= exit_

    def _meet_leaves(
        self, rays: Rays, best: FloatArray, found: IntArray, ray: NDArray[np.intp], leaf: IntArray
    ) -> None:
        """Test pairs of rays and leaves, and keep the nearest shape of each ray."""
        raise NotImplementedError


class SphereTree(Tree):
    """Many spheres: a tree of boxes, and the exact test of `Spheres` for the pairs that it leaves over."""

    def __init__(self, first: int, centres: FloatArray64, radii: FloatArray64) -> None:
        super().__init__(first, centres, centres - radii[:, None], centres + radii[:, None])
        self._spheres = Spheres(first, centres, radii)

    def _meet_leaves(
        self, rays: Rays, best: FloatArray, found: IntArray, ray: NDArray[np.intp], leaf: IntArray
    ) -> None:
        number = self._leaf_rows[leaf].astype(np.intp).ravel()
        self._spheres.meet(rays, best, found, number, np.repeat(ray, _LEAF))


class Mesh(Tree):
    """Triangles of corners [T, 3, 3] in m, or rectangles, whose corner 0 lies between the other two."""

    def __init__(self, first: int, corners: FloatArray64, rectangles: bool = False) -> None:
        far = corners[:, 1:2] + corners[:, 2:] - corners[:, :1]
        outline = np.concatenate([corners, far], axis=1) if rectangles else corners
        super().__init__(first, outline.mean(axis=1), outline.min(axis=1), outline.max(axis=1))
        self._rectangles = rectangles
        planes = triangle_planes(corners).astype(np.float32)[self._leaf_rows]
        self._leaf_planes = np.ascontiguousarray(planes.transpose(2, 3, 0, 1))  # [3, 4, leaves, 8]

    def _meet_leaves(
        self, rays: Rays, best: FloatArray, found: IntArray, ray: NDArray[np.intp], leaf: IntArray
    ) -> None:
        """Test pairs of rays and leaves, and keep the nearest triangle of each ray."""
        origin = [rays.origin[k].take(ray)[:, None] for k in range(3)]
        direction = [rays.direction[k].take(ray)[:, None] for k in range(3)]

        def plane(index: int, vector: list[FloatArray], offset: bool) -> FloatArray:
            a, b, c, d = self._leaf_planes[index]
            value: FloatArray = a.take(leaf, axis=0)
            value *= vector[0]
            value += b.take(leaf, axis=0) * vector[1]
            value += c.take(leaf, axis=0) * vector[2]
            if offset:
                value += d.take(leaf, axis=0)
            return value

        distance = plane(0, origin, True)
        distance /= -(plane(0, direction, False) + np.float32(1e-30))
        point = [origin[k] + distance * direction[k] for k in range(3)]
        u, v = plane(1, point, True), plane(2, point, True)
        # A sliver of overlap closes the seams that rounding opens between neighbours; NaN fails every comparison.
        edge = np.float32(-5e-5)
        most = np.maximum(u, v) if self._rectangles else u + v
        ok = (distance > NEAREST) & (u >= edge) & (v >= edge) & (most <= 1 - edge)
        distance[~ok] = np.inf
        column = np.argmin(distance, axis=1)
        nearest = distance[np.arange(len(ray)), column]
        np.minimum.at(best, ray, nearest)
        won = (nearest == best[ray]) & np.isfinite(nearest)
        found[ray[won]] = self.first + self._leaf_rows[leaf[won], column[won]]


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


def make_mesh(first: int, vertices: FloatArray64, faces: NDArray[np.int64]) -> Primitive:
    """Triangles [T, 3] of vertices [V, 3] in m to hit, through Embree if it is installed."""
    try:
        return EmbreeMesh(first, vertices, faces)
    except ImportError:
        return Mesh(first, vertices[faces])


def tracer() -> str:
    """Name of the tracer that `make_mesh` uses: hits of tracers differ by rounding."""
    try:
        _library()
    except ImportError:
        return "the built-in tree"
    return "Embree"


def _library() -> tuple[Any, Any]:
    """The modules of embreex, imported by name as they are untyped."""
    return import_module("embreex.mesh_construction"), import_module("embreex.rtcore_scene")


class EmbreeMesh:
    """Triangles in an Embree scene, arguments as for `make_mesh`; ImportError where embreex is not installed."""

    def __init__(self, first: int, vertices: FloatArray64, faces: NDArray[np.int64]) -> None:
        mesh_construction, rtcore_scene = _library()
        self.first = first
        corners = np.ascontiguousarray(vertices[faces], np.float32)
        # Robust: watertight at the edges that triangles share.
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        self._triangles = mesh_construction.TriangleMesh(self._scene, corners)
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

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
            found[ray[met[ok]]] = self.first + hit["primID"][met[ok]]
            again = met[distance <= NEAREST]
            ray, moved = ray[again], moved[again] + _STEP
            start = start.take(again, axis=1) + direction.take(again, axis=1) * _STEP


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
    text = f"{file}: {flat.sum()} of {len(flat)} triangles have no area and are left out"
    warnings.warn(text, NeurolensWarning, stacklevel=2)
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
        whole, used = read_triangles(scene, f"{place}.file", scene.parent / mesh.file)
        libraries = list(dict.fromkeys(used.libraries))
        found = read_library(scene, mesh.file, libraries)
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

    def _defined(self, name: str, look: tuple[Vector, Path | None], coordinates: bool, which: str) -> str:
        """The name of a material of an MTL file, for faces with texture coordinates or without, once it is defined."""
        colour, picture = look
        if picture is not None and coordinates:
            self.textures[name] = Texture("image", file=picture)
            self.materials[name] = Material("diffuse", texture=name)
            return name
        if picture is not None:
            text = f"{which[:300]}: no texture coordinates: {picture.name} is left out there"
            warnings.warn(text, NeurolensWarning, stacklevel=2)
            name += " without coordinates" if name in self.materials else ""
        self.materials[name] = Material("diffuse", reflectance=colour)
        return name


def _part(mesh: TriangleSet, chosen: NDArray[np.bool_]) -> TriangleSet:
    """Some triangles of a mesh, with the vertices that they need."""
    rows, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    uv, normals = (None if values is None else whole_values(values[rows]) for values in (mesh.uv, mesh.normals))
    return TriangleSet(mesh.vertices[rows], faces.reshape(-1, 3).astype(np.int64), uv, normals)
