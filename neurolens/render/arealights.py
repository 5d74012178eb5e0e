"""Lights with a surface: rectangles, discs and spheres that emit.

A rectangle and a disc are sampled uniformly over their area, a sphere over the cone that it fills.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import Vector
from neurolens.render.lights import Numbers
from neurolens.render.primitives import dot
from neurolens.render.shapes import Disc, Quad, Sphere

_TWO_PI = np.float32(2 * math.pi)


def orthonormal(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors [3, N] that make a right-handed frame with each unit normal [3, N] (Duff et al. 2017)."""
    x, y, z = normal
    sign = np.copysign(np.float32(1), z)
    a = np.float32(-1) / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    bitangent = np.stack([b, sign + y * y * a, -y])
    return tangent, bitangent


def one_less_cosine(sin2: FloatArray) -> FloatArray:
    """1 - cos of the half angle of a cone, from its squared sine, without loss for narrow cones."""
    sin2 = np.minimum(sin2, np.float32(1))
    result: FloatArray = sin2 / (1 + np.sqrt(1 - sin2))
    return result


def in_cone(axis: FloatArray, one_less_cos: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions [3, N] uniform within cones about unit axes [3, N], and their cosines' distance from 1, [N].

    1 - cos directly, not cos: a distant sphere's cone is narrower than float32 resolves near 1.
    """
    lost = square[0] * one_less_cos
    sin = np.sqrt(lost * (2 - lost))
    angle = square[1] * _TWO_PI
    tangent, bitangent = orthonormal(axis)
    return axis * (1 - lost) + tangent * (sin * np.cos(angle)) + bitangent * (sin * np.sin(angle)), lost


def _irradiance(
    area: NDArray[np.floating], middle: NDArray[np.floating], emission: Sequence[Vector], target_m: Vector
) -> NDArray[np.float64]:
    """About that at a point, of lights [n] of some area that they show it, the three colours added up."""
    away2 = np.sum((middle - np.array(target_m)) ** 2, axis=1)
    return area * np.array([sum(rgb) for rgb in emission]) / np.maximum(away2, 1e-6)


class FlatLights:
    """Rectangles, then discs: each a corner and two edges, of a disc its centre and two radii."""

    sizeless = False

    def __init__(self, quads: Sequence[Quad], discs: Sequence[Disc]) -> None:
        self.count, self._quads = len(quads) + len(discs), len(quads)
        self._emission = [light.emission for light in quads] + [light.emission for light in discs]
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
        middle = corner + 0.5 * (edge_u + edge_v)
        middle[self._quads :] = corner[self._quads :]
        self._middle = middle

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """See `LightGroup`."""
        return _irradiance(self._area, self._middle, self._emission, target_m)

    def sample(
        self, number: Numbers, point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `LightGroup`."""
        if self._quads < self.count:
            radius, angle = np.sqrt(square[0]), square[1] * _TWO_PI
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
        """See `LightGroup`."""
        result: FloatArray = distance * distance / (self._area.take(number) * cosine)
        return result


class SphereLights:
    """Spheres that emit outwards."""

    sizeless = False

    def __init__(self, spheres: Sequence[Sphere]) -> None:
        self.count, self._emission = len(spheres), [s.emission for s in spheres]
        self._centre = np.array([s.centre_m for s in spheres], np.float32).reshape(-1, 3).T
        self._radius2 = np.array([s.radius_m**2 for s in spheres], np.float32)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """See `LightGroup`."""
        return _irradiance(np.pi * self._radius2, self._centre.T, self._emission, target_m)

    def sample(
        self, number: Numbers, point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `LightGroup`."""
        axis = self._centre.take(number, axis=1) - point
        away2 = dot(axis, axis)
        away = np.sqrt(away2)
        axis /= away
        radius2 = self._radius2.take(number)
        one_less_cos: FloatArray = one_less_cosine(radius2 / away2)
        direction, lost = in_cone(axis, one_less_cos, square)
        distance: FloatArray = away * (1 - lost) - np.sqrt(np.maximum(radius2 - away2 * (lost * (2 - lost)), 0))
        inverse_pdf: FloatArray = one_less_cos * _TWO_PI
        inverse_pdf[away2 <= radius2] = 0  # inside the light
        return direction, distance, inverse_pdf

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """See `LightGroup`."""
        away = self._centre.take(number, axis=1) - point
        result: FloatArray = np.float32(1) / (_TWO_PI * one_less_cosine(self._radius2.take(number) / dot(away, away)))
        return result
