"""Shapes: where rays of a batch meet them, analytic ones by numpy, triangles by Embree.

Each shape improves, in place, the nearest hit known so far: `best` [N] float32 distances in metres and `found` [N]
int32 surface numbers. A shape owns surface numbers from `first` on. Arithmetic stays in a few arrays the size
of the batch, which live in the cache; tests are ordered so that the cheap rejection of a whole batch comes first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import NeurolensError
from neurolens.cameras.contract import FloatArray

IntArray = NDArray[np.int32]
Array = NDArray[np.float64]
_TINY = np.float32(1e-20)
NEAREST = np.float32(1e-6)  # a nearer hit, in metres, is on the surface that a ray leaves


@dataclass(frozen=True)
class Rays:
    """A batch of rays: origin and direction [3, N] float32 in metres, and 1 / direction, which is always finite."""

    origin: FloatArray
    direction: FloatArray
    inverse: FloatArray

    @classmethod
    def of(cls, origin: FloatArray, direction: FloatArray) -> Rays:
        """Make rays with their inverse directions."""
        inverse = direction + _TINY
        np.divide(np.float32(1), inverse, out=inverse)
        return cls(origin, direction, inverse)


class Primitive(Protocol):
    """A shape that rays can hit."""

    first: int

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        """Write distance and surface number of the hits that are nearer than `best`."""


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return dot products [N] of vectors [3, N], or of one vector [3] with vectors [3, N]."""
    out: FloatArray = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out


def _parts(vector: Array) -> list[tuple[int, np.float32]]:
    """Return the components that are not 0, with their axes: most walls have one."""
    return [(k, np.float32(v)) for k, v in enumerate(vector) if v]


def _sum(parts: list[tuple[int, np.float32]], rows: FloatArray) -> FloatArray:
    """Return dot products [N] of a vector, given by its parts, with vectors [3, N]."""
    axis, value = parts[0]
    out: FloatArray = rows[axis] * value
    for axis, value in parts[1:]:
        out += rows[axis] * value
    return out


def _keep(ok: NDArray[np.bool_], distance: FloatArray, surface: int, best: FloatArray, found: IntArray) -> None:
    """Write hits where `ok`, unless there are none."""
    if ok.any():
        np.copyto(best, distance, where=ok)
        np.copyto(found, np.int32(surface), where=ok)


class Plane:
    """An infinite plane through `point` with unit `normal`."""

    def __init__(self, first: int, point: Array, normal: Array) -> None:
        self.first = first
        self._normal, self._offset = _parts(normal), np.float32(point @ normal)
        self._edges: list[tuple[list[tuple[int, np.float32]], np.float32]] = []

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        distance = self._offset - _sum(self._normal, rays.origin)
        distance /= _sum(self._normal, rays.direction) + _TINY
        ok = distance > NEAREST
        ok &= distance < best
        if not ok.any():
            return
        for across, start in self._edges:
            along = _sum(across, rays.direction)
            along *= distance
            along += _sum(across, rays.origin)
            along -= start
            ok &= along > 0
            ok &= along < 1
        _keep(ok, distance, self.first, best, found)


class Quad(Plane):
    """A rectangle of any orientation: `corner` and two perpendicular edges."""

    def __init__(self, first: int, corner: Array, edge_u: Array, edge_v: Array) -> None:
        normal = np.cross(edge_u, edge_v)
        super().__init__(first, corner, normal / np.linalg.norm(normal))
        self._offset = np.float32(corner @ normal / np.linalg.norm(normal))  # rounded once less than the plane's
        self._edges = [(_parts(e / (e @ e)), np.float32(corner @ e / (e @ e))) for e in (edge_u, edge_v)]


class AxisQuad:
    """A rectangle perpendicular to an axis: the common case, at half the cost of `Quad`."""

    def __init__(self, first: int, corner: Array, far_corner: Array, axis: int) -> None:
        self.first = first
        self._axis = axis
        self._others = [k for k in range(3) if k != axis]
        self._centre = (0.5 * (corner + far_corner)).astype(np.float32)
        self._half = (0.5 * np.abs(far_corner - corner)).astype(np.float32)

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        distance = self._centre[self._axis] - rays.origin[self._axis]
        distance *= rays.inverse[self._axis]
        ok = distance > NEAREST
        ok &= distance < best
        for k in self._others:
            across = distance * rays.direction[k]
            across += rays.origin[k]
            across -= self._centre[k]
            np.abs(across, out=across)
            ok &= across < self._half[k]
        _keep(ok, distance, self.first, best, found)


class Disc:
    """A flat disc about `centre` with unit `normal`."""

    def __init__(self, first: int, centre: Array, normal: Array, radius: float) -> None:
        self.first = first
        self._centre, self._normal = centre.astype(np.float32)[:, None], normal.astype(np.float32)
        self._radius2 = np.float32(radius**2)

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        to_centre = self._centre - rays.origin
        distance = dot(self._normal, to_centre)
        distance /= dot(self._normal, rays.direction) + _TINY
        ok = distance > NEAREST
        ok &= distance < best
        if not ok.any():
            return
        to_centre -= rays.direction * distance
        ok &= dot(to_centre, to_centre) < self._radius2
        _keep(ok, distance, self.first, best, found)


class Box:
    """An axis-aligned box: six surfaces, in the order x-, x+, y-, y+, z-, z+.

    With `room`, only the inner sides of its walls exist: rays from outside pass in, so that a camera may stand behind
    a wall of the room that it photographs.
    """

    def __init__(self, first: int, low: Array, high: Array, room: bool) -> None:
        self.first = first
        self.room = room
        self.low, self.high = low.astype(np.float32), high.astype(np.float32)
        self._centre = (0.5 * (low + high)).astype(np.float32)
        self._scale = (2.0 / (high - low)).astype(np.float32)

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        # The number of the first face; `face` tells which.
        entry, exit_ = slabs(rays, self.low, self.high)
        ok = entry < exit_
        distance = exit_ if self.room else np.where(entry > NEAREST, entry, exit_)
        ok &= distance > NEAREST
        ok &= distance < best
        _keep(ok, distance, self.first, best, found)

    def face(self, point: FloatArray) -> IntArray:
        """Return the surface numbers [N] of points [3, N] on the box: the faces to which they are nearest."""
        relative = point - self._centre[:, None]
        relative *= self._scale[:, None]
        axis = np.argmax(np.abs(relative), axis=0)
        positive = np.take_along_axis(relative, axis[None], axis=0)[0] > 0
        return (self.first + 2 * axis + positive).astype(np.int32)


def slabs(rays: Rays, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distances [N] at which rays enter and leave an axis-aligned box; entry < exit where they meet it."""
    entry: FloatArray | None = None
    exit_: FloatArray | None = None
    for k in range(3):
        to_low = low[k] - rays.origin[k]
        to_low *= rays.inverse[k]
        to_high = high[k] - rays.origin[k]
        to_high *= rays.inverse[k]
        if entry is None or exit_ is None:
            entry, exit_ = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
        else:
            np.maximum(entry, np.minimum(to_low, to_high), out=entry)
            np.minimum(exit_, np.maximum(to_low, to_high, out=to_high), out=exit_)
    assert entry is not None and exit_ is not None
    return entry, exit_


MANY_SPHERES = 1024  # above this number, clusters are faster than testing all
_STEP = np.float32(1e-5)  # m by which a ray is moved on that met the triangle on which it starts
_LARGE_M = 1000.0  # in float32 the surface of a larger sphere would lie behind the rays that leave it


class Spheres:
    """All spheres of a scene, hit from outside and inside.

    Most rays miss most spheres, so a cheap test rejects them: the discriminant r^2 - |f|^2 + (f . d)^2, with f from ray
    origin o to centre c, is a polynomial in products of (c, 1) with (d, o.d) and (o, |o|^2), that is, two small matrix
    products. It is loose by its rounding error; what it lets through is tested exactly, pair by pair.

    Args:
        first: surface number of the first sphere.
        centres: [S, 3] m. radii: [S] m.
        rows: [S] numbers of these spheres among all, where they are only some.
    """

    def __init__(self, first: int, centres: Array, radii: Array, rows: NDArray[np.intp] | None = None) -> None:
        self.first = first
        self._surfaces = first + (np.arange(len(radii)) if rows is None else rows)
        self._kind: type[np.floating[Any]] = np.float64 if radii.max() > _LARGE_M else np.float32
        self._centre: Any = centres.T.astype(self._kind)
        self._radius: Any = radii.astype(self._kind)
        # A margin of 2e-6 of the squared distances covers the rounding of the products.
        slack, ones = 2e-6, np.ones(len(radii))
        constant = radii**2 - (1 - slack) * np.sum(centres**2, axis=1)
        self._along = np.column_stack([centres, -ones]).astype(np.float32)
        self._rest = np.column_stack([2 * centres, constant, (slack - 1) * ones]).astype(np.float32)
        # So few rays that BLAS does not start threads of its own for the product.
        self._rays_at_once = int(np.clip(200_000 // (5 * len(radii)), 64, 4096))

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        origin, direction = rays.origin, rays.direction
        right = np.empty((9, origin.shape[1]), np.float32)
        right[:3], right[3], right[4:7], right[7] = direction, dot(origin, direction), origin, 1
        right[8] = dot(origin, origin)
        for start in range(0, origin.shape[1], self._rays_at_once):
            part = slice(start, start + self._rays_at_once)
            loose = self._along @ right[:4, part]
            loose *= loose
            loose += self._rest @ right[4:, part]
            near = np.flatnonzero(loose > 0)
            if near.size:
                number, ray = np.divmod(near, loose.shape[1])
                ray += start
                self.meet(rays, best, found, number, ray)

    def meet(
        self, rays: Rays, best: FloatArray, found: IntArray, number: NDArray[np.intp], ray: NDArray[np.intp]
    ) -> None:
        """Test pairs of spheres and rays.

        The discriminant comes from the distance between centre and ray: exact in float32 for a small sphere far away
        (Haines et al. 2019, "Precision improvements for ray/sphere intersection").
        """
        direction: Any = rays.direction.take(ray, axis=1).astype(self._kind, copy=False)
        if self._kind is np.float64:
            direction /= np.sqrt(dot(direction, direction))
        to_centre = self._centre.take(number, axis=1) - rays.origin.take(ray, axis=1)
        radius = self._radius.take(number)
        middle = dot(to_centre, direction)
        direction *= middle
        direction -= to_centre
        half2 = radius * radius - dot(direction, direction)
        half = np.sqrt(np.maximum(half2, 0))
        distance = middle - half
        np.copyto(distance, middle + half, where=distance < NEAREST)
        hit = np.flatnonzero((half2 > 0) & (distance > NEAREST) & (distance < best.take(ray)))
        ray, distance = ray[hit], distance[hit].astype(np.float32, copy=False)
        np.minimum.at(best, ray, distance)
        won = distance == best.take(ray)
        found[ray[won]] = self._surfaces[number[hit[won]]]


class SphereClusters:
    """Very many spheres, in clusters of neighbours: a ray is tested against the spheres whose box it enters.

    Arguments are those of `Spheres`.
    """

    def __init__(self, first: int, centres: Array, radii: Array) -> None:
        self.first = first
        low, high = centres - radii[:, None], centres + radii[:, None]
        # Boxes are slightly wider, so that rounding to float32 cuts off no sphere that rays near the scene meet.
        margin = 1e-6 * max(1.0, float(np.abs(low).max()), float(np.abs(high).max()))
        self._clusters = [
            (
                (low[rows].min(axis=0) - margin).astype(np.float32),
                (high[rows].max(axis=0) + margin).astype(np.float32),
                Spheres(first, centres[rows], radii[rows], rows),
            )
            for rows in _clusters(np.arange(len(radii)), centres)
        ]

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        for low, high, spheres in self._clusters:
            entry, exit_ = slabs(rays, low, high)
            near = np.flatnonzero(np.maximum(entry, NEAREST) <= np.minimum(exit_, best))
            if near.size:
                some = Rays(*(rows.take(near, axis=1) for rows in (rays.origin, rays.direction, rays.inverse)))
                nearest, surface = best[near], found[near]
                spheres.nearer(some, nearest, surface)
                best[near], found[near] = nearest, surface


def _clusters(rows: NDArray[np.intp], centres: Array) -> list[NDArray[np.intp]]:
    """Group rows of neighbours: they are halved at the median of their longest side until they are few enough."""
    if len(rows) <= MANY_SPHERES:
        return [rows]
    axis = int(np.argmax(np.ptp(centres[rows], axis=0)))
    halves = np.array_split(rows[np.argsort(centres[rows, axis], kind="stable")], 2)
    return [group for half in halves for group in _clusters(half, centres)]


class Mesh:
    """Triangles [T, 3 corners, 3] in m, for Embree; each `each` of them in a row are a surface, numbered from `first`.

    Raises:
        NeurolensError: Embree is not installed.
    """

    def __init__(self, first: int, triangles: Array, each: int = 1) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise NeurolensError("meshes need Embree, which is not installed: pip install embreex") from None
        self.first, self._each = first, each
        corners = np.ascontiguousarray(triangles, np.float32)
        # Robust means watertight at the edges that triangles share.
        self._scene = EmbreeScene(robust=True)
        self._triangles = TriangleMesh(self._scene, corners)
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

    @classmethod
    def of_rectangles(cls, first: int, corners: Array) -> Mesh:
        """Make a mesh of rectangles [T, 3 corners, 3], two triangles each; corner 0 lies between the other two."""
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


def triangle_planes(corners: Array) -> Array:
    """Return plane and barycentric coordinates of triangles [T, 3, 3] as affine functions of a point, [T, 3, 4].

    Row 0 is the distance from the plane, rows 1 and 2 the weights of corners 1 and 2.
    """
    a, edge_b, edge_c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_b, edge_c)
    area2 = np.maximum(np.sum(normal**2, axis=1, keepdims=True), 1e-300)  # a smaller triangle is never hit
    unit = normal / np.sqrt(area2)
    across_b, across_c = np.cross(edge_c, normal) / area2, np.cross(normal, edge_b) / area2
    rows = [np.column_stack([n, -np.sum(n * a, axis=1)]) for n in (unit, across_b, across_c)]
    return np.stack(rows, axis=1)
