"""All lights of a scene that can be aimed at, as one.

A light is chosen partly by how much it lights the point that the camera looks at, partly at random. Its group (see
`neurolens.render.arealights`, `pointlights` and `environment`) then gives a direction towards it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import BLACK, Vector

Numbers = NDArray[np.intp]


@dataclass(frozen=True)
class LightSamples:
    """Directions to points on lights.

    Attributes:
        direction: [3, N] unit vectors. distance: [N] m, to the light's surface, inf to the sky. light: [N] its number.
        inverse_pdf: [N] 1 / density per solid angle, choice of the light included; 0 where the light shows its back,
            and for lights without size, which no scattered ray finds.
        scale: [N] what the light's emission is multiplied by: the same, and for lights without size the irradiance of
            intensity 1 over the probability of the choice.
    """

    direction: FloatArray
    distance: FloatArray
    light: Numbers
    inverse_pdf: FloatArray
    scale: FloatArray


class LightGroup(Protocol):
    """Lights of one kind, numbered from 0.

    Attributes:
        count: how many. sizeless: whether `sample` gives irradiances in place of inverse densities.
    """

    count: int
    sizeless: bool

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """About the irradiance [count] at a point, its three colours added up."""
        ...

    def sample(
        self, number: Numbers, point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Direction [3, N], distance [N], inverse density [N] from points [3, N] for numbers [2, N] in [0, 1)."""
        ...

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes a direction that hits lights [N]."""
        ...


class Lights:
    """Lights of several kinds, numbered one group after the other.

    Args:
        groups: some may be empty.
        target_m: the point whose light matters most.
    """

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
        if len(self._groups) == 1:
            ((_, group),) = self._groups
            direction, distance, scale = group.sample(light, point, square)
            scale /= self.probability.take(light)
            return LightSamples(direction, distance, light, np.zeros_like(scale) if group.sizeless else scale, scale)
        direction, distance, scale = np.empty_like(point), np.empty_like(choice), np.empty_like(choice)
        inverse_pdf = np.empty_like(choice)
        for first, group in self._groups:
            rows = np.flatnonzero((light >= first) & (light < first + group.count))
            if not rows.size:
                continue
            aimed = group.sample(light[rows] - first, point.take(rows, axis=1), square.take(rows, axis=1))
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
        for first, group in self._groups:
            rows = np.flatnonzero((light >= first) & (light < first + group.count))
            if rows.size:
                hit = (point.take(rows, axis=1), distance[rows], cosine[rows])
                density[rows] = group.pdf(light[rows] - first, *hit)
        density *= self.probability.take(light)
        return density
