"""Lights that can be aimed at: rectangles and spheres that emit.

A light is chosen partly by how much it lights the point that the camera looks at, partly at random. A rectangle is
sampled uniformly over its area, a sphere over the cone that it fills. The environment is no such light: only scattered
rays find it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import BLACK, Vector
from neurolens.render.primitives import dot
from neurolens.render.shapes import Quad, Sphere


@dataclass(frozen=True)
class LightSamples:
    """Directions to points on lights.

    Attributes:
        direction: [3, N] unit vectors. distance: [N] m, to the light's surface. light: [N] number of the light.
        inverse_pdf: [N] 1 / density per solid angle, choice of the light included; 0 where the light shows its back.
    """

    direction: FloatArray
    distance: FloatArray
    light: NDArray[np.intp]
    inverse_pdf: FloatArray


def orthonormal(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors [3, N] that make a right-handed frame with each unit normal [3, N] (Duff et al. 2017)."""
    x, y, z = normal
    sign = np.copysign(np.float32(1), z)
    a = np.float32(-1) / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    bitangent = np.stack([b, sign + y * y * a, -y])
    return tangent, bitangent


class Lights:
    """All lights of a scene, rectangles first.

    Args:
        quads, spheres: those that emit.
        target_m: the point whose light matters most.
    """

    def __init__(self, quads: list[Quad], spheres: list[Sphere], target_m: Vector = BLACK) -> None:
        self.count, self._quads = len(quads) + len(spheres), len(quads)
        self.black = self.count == 0
        corner = np.array([q.corner_m for q in quads], np.float64).reshape(-1, 3)
        edge_u = np.array([q.edge_u_m for q in quads], np.float64).reshape(-1, 3)
        edge_v = np.array([q.edge_v_m for q in quads], np.float64).reshape(-1, 3)
        normal = np.cross(edge_u, edge_v)
        area = np.linalg.norm(normal, axis=1)
        self._corner, self._edge_u, self._edge_v = (a.T.astype(np.float32) for a in (corner, edge_u, edge_v))
        self._normal = (normal / area[:, None]).T.astype(np.float32)
        # 0 for spheres, so that one table serves both kinds.
        self._area = np.concatenate([area, np.zeros(len(spheres))]).astype(np.float32)
        self._centre = np.array([s.centre_m for s in spheres], np.float32).reshape(-1, 3).T
        self._radius2 = np.array([s.radius_m**2 for s in spheres], np.float32)
        middle = np.concatenate([corner + 0.5 * (edge_u + edge_v), self._centre.T])
        emissions = [q.emission for q in quads] + [s.emission for s in spheres]
        shone = np.concatenate([area, np.pi * self._radius2]) * [sum(emission) for emission in emissions]
        self._choose_by(shone / np.maximum(np.sum((middle - target_m) ** 2, axis=1), 1e-6))

    def _choose_by(self, importance: NDArray[np.float64]) -> None:
        """Make the table by which lights are chosen: half of it in equal parts, half by importance.

        Each light has a whole number of the table's entries, at least one, and their share is its exact probability.
        """
        if self.black:
            return
        parts = importance / importance.sum() + 1 / self.count
        entries = np.maximum(1, np.rint(parts / parts.sum() * max(1024, 16 * self.count))).astype(np.intp)
        self._table = np.repeat(np.arange(self.count), entries)
        self._probability = (entries / entries.sum()).astype(np.float32)

    def sample(self, point: FloatArray, choice: FloatArray, square: FloatArray) -> LightSamples:
        """A direction from each point [3, N] to one of the lights, for numbers [N] and [2, N] in [0, 1)."""
        light = self._table.take((choice * np.float32(len(self._table))).astype(np.intp), mode="clip")
        if self._quads == self.count:
            direction, distance, inverse_pdf = self._sample_quads(light, point, square)
        elif self._quads == 0:
            direction, distance, inverse_pdf = self._sample_spheres(light, point, square)
        else:
            direction, distance = np.empty_like(point), np.empty_like(choice)
            inverse_pdf = np.empty_like(choice)
            is_quad = light < self._quads
            for rows, sampled in ((is_quad, self._sample_quads), (~is_quad, self._sample_spheres)):
                number = light[rows] - (0 if rows is is_quad else self._quads)
                direction[:, rows], distance[rows], inverse_pdf[rows] = sampled(number, point[:, rows], square[:, rows])
        inverse_pdf /= self._probability.take(light)
        return LightSamples(direction, distance, light, inverse_pdf)

    def _sample_quads(
        self, number: NDArray[np.intp], point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
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

    def _sample_spheres(
        self, number: NDArray[np.intp], point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        axis = self._centre.take(number, axis=1) - point
        away2 = dot(axis, axis)
        away = np.sqrt(away2)
        axis /= away
        radius2 = self._radius2.take(number)
        one_less_cos = _cone(radius2 / away2)
        # 1 - cos directly, not cos: a distant sphere's cone is narrower than float32 resolves near 1.
        lost = square[0] * one_less_cos
        cos = 1 - lost
        sin2 = lost * (1 + cos)
        angle = square[1] * np.float32(2 * math.pi)
        sin = np.sqrt(sin2)
        tangent, bitangent = orthonormal(axis)
        direction = axis * cos + tangent * (sin * np.cos(angle)) + bitangent * (sin * np.sin(angle))
        distance = away * cos - np.sqrt(np.maximum(radius2 - away2 * sin2, 0))
        inverse_pdf = one_less_cos * np.float32(2 * math.pi)
        inverse_pdf[away2 <= radius2] = 0  # inside the light
        return direction, distance, inverse_pdf

    def pdf(self, light: NDArray[np.intp], point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes a direction that hits lights [N].

        Args:
            point: [3, N] from where. distance: [N] to the hit. cosine: [N] at the light, above 0.
        """
        area = self._area.take(light)
        with np.errstate(divide="ignore", invalid="ignore"):
            density = distance * distance / (area * cosine)
        rows = np.flatnonzero(light >= self._quads)
        if rows.size:
            number = light[rows] - self._quads
            away = self._centre.take(number, axis=1) - point[:, rows]
            one_less_cos = _cone(self._radius2.take(number) / dot(away, away))
            density[rows] = np.float32(0.5 / math.pi) / one_less_cos
        density *= self._probability.take(light)
        return density


def _cone(sin2: FloatArray) -> FloatArray:
    """1 - cos of the half angle of a cone, from its squared sine, without loss for narrow cones."""
    sin2 = np.minimum(sin2, np.float32(1))
    result: FloatArray = sin2 / (1 + np.sqrt(1 - sin2))
    return result
