"""The lights of a scene that can be sampled: rectangles, discs, spheres, points and spots.

A light is chosen partly by how much it lights the point that the camera looks at, partly at random. Its group then
gives a direction towards it: a rectangle and a disc are sampled uniformly over their area, a sphere over the cone that
it fills. (The sky and the sun are groups of `neurolens.render.environment`.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.primitives import dot
from neurolens.render.sampler import TWO_PI, in_cone, one_less_cosine, orthonormal
from neurolens.render.scenetables import BLACK, Disc, PointLight, Quad, Sphere, SpotLight, Vector

Numbers = NDArray[np.intp]
Aimed = tuple[FloatArray, FloatArray, FloatArray]  # direction [3, N], distance [N] m, inverse density [N]


@dataclass(frozen=True)
class LightSamples:
    """Directions to points on lights.

    Attributes:
        direction: [3, N] unit vectors. distance: [N] m, to the light's surface, inf to the sky. light: [N] its number.
        inverse_pdf: [N] 1 / density per solid angle, choice of the light included; 0 where the light shows its back,
            and for lights without size, which no scattered ray finds.
        scale: [N] factor of the light's emission: the same, and for lights without size the irradiance of
            intensity 1 over the probability of the choice.
    """

    direction: FloatArray
    distance: FloatArray
    light: Numbers
    inverse_pdf: FloatArray
    scale: FloatArray


class LightGroup:
    """Lights of one kind: `count` of them, numbered from 0.

    Of `sizeless` ones `sample` gives the irradiance of intensity 1 in place of inverse densities.
    """

    count: int
    sizeless = False

    def round(self, number: int) -> bool:
        """Whether samples are of a disc: their first number is the square of the radius, their second the angle."""
        return False

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """About the irradiance [count] at a point, its three colours added up."""
        raise NotImplementedError

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        """Directions from points [3, N] to the lights of some numbers [N], for samples [2, N] in [0, 1)."""
        raise NotImplementedError

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes a direction that hits lights [N]; 0 without surface."""
        return np.zeros_like(distance)


class Lights:
    """Lights of several kinds, numbered group after group (some may be empty); at `target_m` light matters most."""

    def __init__(self, groups: Sequence[LightGroup], target_m: Vector = BLACK) -> None:
        self._groups: list[tuple[int, LightGroup]] = []
        self.count = 0
        for group in groups:
            if group.count:
                self._groups.append((self.count, group))
                self.count += group.count
        self.black = self.count == 0
        if not self.black:
            self._choose_by(np.concatenate([group.importance(target_m) for _, group in self._groups]))

    def _choose_by(self, importance: NDArray[np.float64]) -> None:
        """Make the table by which lights are chosen: half of it in equal parts, half by importance.

        Each light has a whole number of the table's entries, at least one, and their share is its exact probability.
        """
        parts = importance / max(importance.sum(), 1e-300) + 1 / self.count
        entries = np.maximum(1, np.rint(parts / parts.sum() * max(1024, 16 * self.count))).astype(np.intp)
        self._table = np.repeat(np.arange(self.count), entries)
        self.probability = (entries / entries.sum()).astype(np.float32)

    def sample(self, point: FloatArray, choice: FloatArray, square: FloatArray) -> LightSamples:
        """A direction from each point [3, N] to one of the lights, for numbers [N] and [2, N] in [0, 1)."""
        light = self._table.take((choice * np.float32(len(self._table))).astype(np.intp), mode="clip")
        direction, distance, scale = np.empty_like(point), np.empty_like(choice), np.empty_like(choice)
        inverse_pdf = np.empty_like(choice)
        for group, rows, number in self._by_group(light):
            aimed = group.sample(number, point.take(rows, axis=1), square.take(rows, axis=1))
            direction[:, rows], distance[rows], scale[rows] = aimed
            scale[rows] /= self.probability.take(light[rows])
            inverse_pdf[rows] = 0 if group.sizeless else scale[rows]
        return LightSamples(direction, distance, light, inverse_pdf, scale)

    def pdf(self, light: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes a direction that hits lights [N].

        Args:
            point: [3, N] from where. distance: [N] to the hit. cosine: [N] at the light, above 0.
        """
        density = np.zeros_like(distance)
        for group, rows, number in self._by_group(light):
            density[rows] = group.pdf(number, point.take(rows, axis=1), distance[rows], cosine[rows])
        density *= self.probability.take(light)
        return density

    def each(
        self, numbers: Iterable[int], point: FloatArray, place: NDArray[np.float64]
    ) -> Iterator[tuple[bool, Aimed]]:
        """Sample lights one after another from points [3, N]; yields whether each is round, and the group's samples.

        Args:
            place: [2, N] from -1 to 1 in the light's own square, or in the one about it.
        """
        square = ((place + 1) / 2).astype(np.float32)
        disc = np.stack([(place**2).sum(0), np.arctan2(place[1], place[0]) / TWO_PI % 1]).astype(np.float32)
        for number in numbers:
            first, group = next(part for part in reversed(self._groups) if part[0] <= number)
            is_round = group.round(number - first)
            some = np.full(point.shape[1], number - first)
            yield is_round, group.sample(some, point, disc if is_round else square)

    def strongest(self, target_m: Vector, most: int) -> list[int]:
        """The numbers of the `most` lights that bring a point the most light if nothing is between, in rising order."""
        importance = [group.importance(target_m) for _, group in self._groups]
        order = np.argsort(-np.concatenate([np.zeros(0), *importance]), kind="stable")
        return sorted(order[:most].tolist())

    def _by_group(self, light: Numbers) -> Iterator[tuple[LightGroup, Numbers, Numbers]]:
        """The groups that lights [N] belong to, the places of theirs, and their numbers in the group."""
        for first, group in self._groups:
            rows = np.flatnonzero((light >= first) & (light < first + group.count))
            if rows.size:
                yield group, rows, light[rows] - first


def _irradiance(
    area: NDArray[np.floating], middle: NDArray[np.floating], emission: Sequence[Vector], target_m: Vector
) -> NDArray[np.float64]:
    """About the irradiance at a point from lights [n] of a visible area, the three colours added up."""
    away2 = np.sum((middle - np.array(target_m)) ** 2, axis=1)
    return area * np.array([sum(rgb) for rgb in emission]) / np.maximum(away2, 1e-6)


class FlatLights(LightGroup):
    """Rectangles, then discs: each a corner and two edges, of a disc its centre and two radii."""

    def __init__(self, quads: Sequence[Quad], discs: Sequence[Disc]) -> None:
        self.count, self._quads = len(quads) + len(discs), len(quads)
        self._emission = [light.emission for light in (*quads, *discs)]
        corner = np.array([q.corner_m for q in quads] + [d.centre_m for d in discs], np.float64).reshape(-1, 3)
        normal = np.array([d.normal for d in discs], np.float64).reshape(-1, 3).T
        radius = np.array([d.radius_m for d in discs])
        tangent, bitangent = orthonormal(normal / np.linalg.norm(normal, axis=0))
        edge_u = np.concatenate([np.array([q.edge_u_m for q in quads]).reshape(-1, 3), (tangent * radius).T])
        edge_v = np.concatenate([np.array([q.edge_v_m for q in quads]).reshape(-1, 3), (bitangent * radius).T])
        normal = np.cross(edge_u, edge_v)
        area = np.linalg.norm(normal, axis=1)
        self._corner, self._edge_u, self._edge_v = (a.T.astype(np.float32) for a in (corner, edge_u, edge_v))
        self._normal = (normal / area[:, None]).T.astype(np.float32)
        area[self._quads :] *= math.pi
        self._area = area.astype(np.float32)
        self._middle = corner + 0.5 * (edge_u + edge_v)
        self._middle[self._quads :] = corner[self._quads :]

    def round(self, number: int) -> bool:
        return number >= self._quads

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        return _irradiance(self._area, self._middle, self._emission, target_m)

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        if self._quads < self.count:
            radius, angle = np.sqrt(square[0]), square[1] * TWO_PI
            disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
            square = np.where(number < self._quads, square, disc)
        direction = self._corner.take(number, axis=1)
        direction += self._edge_u.take(number, axis=1) * square[0]
        direction += self._edge_v.take(number, axis=1) * square[1]
        direction -= point
        distance2 = dot(direction, direction)
        distance = np.sqrt(distance2)
        direction /= distance
        inverse_pdf = dot(self._normal.take(number, axis=1), direction)
        inverse_pdf *= -self._area.take(number)
        inverse_pdf /= distance2
        return direction, distance, np.maximum(inverse_pdf, np.float32(0), out=inverse_pdf)

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        return distance * distance / (self._area.take(number) * cosine)


class SphereLights(LightGroup):
    """Spheres that emit outwards."""

    def __init__(self, spheres: Sequence[Sphere]) -> None:
        self.count, self._emission = len(spheres), [s.emission for s in spheres]
        self._centre = np.array([s.centre_m for s in spheres], np.float32).reshape(-1, 3).T
        self._radius2 = np.array([s.radius_m**2 for s in spheres], np.float32)

    def round(self, number: int) -> bool:
        return True

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        return _irradiance(np.pi * self._radius2, self._centre.T, self._emission, target_m)

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        axis = self._centre.take(number, axis=1) - point
        away2 = dot(axis, axis)
        away = np.sqrt(away2)
        axis /= away
        radius2 = self._radius2.take(number)
        one_less_cos: FloatArray = one_less_cosine(radius2 / away2)
        direction, lost = in_cone(axis, one_less_cos, square)
        distance: FloatArray = away * (1 - lost) - np.sqrt(np.maximum(radius2 - away2 * (lost * (2 - lost)), 0))
        inverse_pdf: FloatArray = one_less_cos * TWO_PI
        inverse_pdf[away2 <= radius2] = 0  # inside the light
        return direction, distance, inverse_pdf

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        away = self._centre.take(number, axis=1) - point
        return np.float32(1) / (TWO_PI * one_less_cosine(self._radius2.take(number) / dot(away, away)))


class PointLights(LightGroup):
    """Points, then spots, found only by sampling lights; a point is a spot that emits in all directions."""

    sizeless = True

    def __init__(self, points: Sequence[PointLight], spots: Sequence[SpotLight]) -> None:
        lights = [*points, *spots]
        self.count = len(lights)
        self._position = np.array([light.position_m for light in lights], np.float32).reshape(-1, 3).T
        self._intensity = np.array([sum(light.intensity) for light in lights])
        axis = np.zeros((3, self.count))
        axis[:, len(points) :] = np.array([np.subtract(s.look_at_m, s.position_m) for s in spots]).reshape(-1, 3).T
        length = np.linalg.norm(axis, axis=0)
        self._axis = (axis / np.where(length > 0, length, 1)).astype(np.float32)
        # Falloff is the smoothstep of (cos - start) / width. A point's axis is 0, and so are its cosines.
        outer, inner = (
            np.array([math.cos(math.radians(getattr(s, name))) for s in spots]) for name in ("outer_deg", "inner_deg")
        )
        self._start = np.concatenate([np.full(len(points), -1.0), outer]).astype(np.float32)
        self._per_width = np.concatenate([np.ones(len(points)), 1 / (inner - outer)]).astype(np.float32)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        to = np.array(target_m)[:, None] - self._position
        distance2 = np.maximum(np.sum(to**2, axis=0), 1e-6)
        return self._intensity * self._falloff(np.arange(self.count), to / np.sqrt(distance2)) / distance2

    def _falloff(self, number: Numbers, away: NDArray[np.floating]) -> FloatArray:
        """Share [N] of the intensity that leaves in unit directions [3, N]."""
        cosine = dot(self._axis.take(number, axis=1), away)
        t = np.clip((cosine - self._start.take(number)) * self._per_width.take(number), 0, 1)
        return t * t * (3 - 2 * t)

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        direction = self._position.take(number, axis=1) - point
        distance2 = dot(direction, direction)
        distance = np.sqrt(distance2)
        direction /= distance
        return direction, distance, self._falloff(number, -direction) / distance2
