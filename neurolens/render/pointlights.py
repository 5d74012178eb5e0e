"""Lights without size: points and spots. Only aiming at them finds them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import Vector
from neurolens.render.lights import Numbers
from neurolens.render.lightsettings import PointLight, SpotLight
from neurolens.render.primitives import dot


class PointLights:
    """Points, then spots; a point is a spot that shines everywhere."""

    sizeless = True

    def __init__(self, points: Sequence[PointLight], spots: Sequence[SpotLight]) -> None:
        lights: list[PointLight | SpotLight] = [*points, *spots]
        self.count = len(lights)
        self._position = np.array([light.position_m for light in lights], np.float32).reshape(-1, 3).T
        self._intensity = np.array([sum(light.intensity) for light in lights])
        axis = np.zeros((3, self.count))
        axis[:, len(points) :] = np.array([np.subtract(s.look_at_m, s.position_m) for s in spots]).reshape(-1, 3).T
        length = np.linalg.norm(axis, axis=0)
        self._axis = (axis / np.where(length > 0, length, 1)).astype(np.float32)
        # Falloff is the smoothstep of (cos - start) / width. A point's axis is 0, and so are its cosines.
        outer = np.array([math.cos(math.radians(s.outer_deg)) for s in spots])
        inner = np.array([math.cos(math.radians(s.inner_deg)) for s in spots])
        self._start = np.concatenate([np.full(len(points), -1.0), outer]).astype(np.float32)
        self._per_width = np.concatenate([np.ones(len(points)), 1 / (inner - outer)]).astype(np.float32)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """See `LightGroup`."""
        to = np.array(target_m)[:, None] - self._position
        distance2 = np.maximum(np.sum(to**2, axis=0), 1e-6)
        return self._intensity * self._falloff(np.arange(self.count), to / np.sqrt(distance2)) / distance2

    def _falloff(self, number: Numbers, away: NDArray[np.floating]) -> FloatArray:
        """Share [N] of the intensity that leaves in unit directions [3, N]."""
        cosine = dot(self._axis.take(number, axis=1), away)
        t = np.clip((cosine - self._start.take(number)) * self._per_width.take(number), 0, 1)
        result: FloatArray = t * t * (3 - 2 * t)
        return result

    def sample(
        self, number: Numbers, point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `LightGroup`; the irradiance of intensity 1 in place of the inverse density."""
        direction = self._position.take(number, axis=1) - point
        distance2 = dot(direction, direction)
        distance = np.sqrt(distance2)
        direction /= distance
        return direction, distance, self._falloff(number, -direction) / distance2

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """See `LightGroup`; nothing hits a light without size."""
        return np.zeros_like(distance)
