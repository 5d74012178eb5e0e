"""A lens as its pupil is sought: whether rays pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph

Truths = NDArray[np.bool_]
Rows = NDArray[np.floating[Any]]
_PART = 1 << 15  # rays evaluated together


@dataclass(frozen=True)
class Sight:
    """A lens whose pupil is sought.

    Attributes:
        graph: of the lens; see `fused.LensGraph`. table: boxes that hold what passes.
        film_z_mm, wavelength_nm: ranges. stop_radius_mm: the widest. stop_surface: for the status of its rays.
        anamorphic: whether it matters on which side of the film a point lies.
    """

    graph: Graph
    table: PupilTable
    film_z_mm: tuple[float, float]
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    stop_surface: int
    anamorphic: bool = False

    def passes(
        self, film: Rows, pupil: Rows, nanometres: ArrayLike, film_z: ArrayLike, stop: ArrayLike,
        azimuth: ArrayLike = 0.0,
    ) -> Truths:  # fmt: skip
        """[...] whether rays pass of film points, turned by an azimuth about the axis; points [2, ...].

        Of an anamorphic lens also of rays mirrored, which arcs hold too.
        """
        shape = film.shape[1:]
        codes = self.sides(film.reshape(2, -1), pupil.reshape(2, -1), np.broadcast_to(nanometres, shape).ravel(),
                           film_z, stop, azimuth)  # fmt: skip
        known = np.hypot(*film.reshape(2, -1)) <= self.film_radius_mm
        return ((codes == st.PASSED).any(0) & known).reshape(shape)

    def sides(self, film: Rows, pupil: Rows, *call: ArrayLike) -> NDArray[Any]:
        """[1 or 2, N] codes of rays from points [2, N], turned by an azimuth, and of an anamorphic lens mirrored."""
        *others, azimuth = call
        placed, ways = turned(film, azimuth), (1.0, -1.0) if self.anamorphic else (1.0,)
        return np.stack([self.status(placed, turned(pupil * [[1.0], [way]], azimuth), *others) for way in ways])

    @property
    def film_radius_mm(self) -> float:
        """Beyond it nothing is known."""
        return self.table.film_radius_mm

    def status(
        self, film: Rows, pupil: Rows, nanometres: ArrayLike, film_z: ArrayLike, stop: ArrayLike
    ) -> NDArray[Any]:
        """[N] of film points [2, N] and pupil points [2, N]; the others [N], or one number."""
        rays = np.concatenate([film, pupil, np.broadcast_to(nanometres, (1, film.shape[1]))]).astype(np.float32)
        call = {"film_z_mm": _call(film_z), "stop_radius_mm": _call(stop)}
        found = []
        for start in range(0, rays.shape[1], _PART):
            part = np.s_[:, start : start + _PART]
            given = {"rays": rays[part]} | {name: v[part] if v.size > 1 else v for name, v in call.items()}
            codes = evaluate(self._status, given)["status"][0]
            found.append(np.broadcast_to(codes, given["rays"].shape[1]))
        return np.concatenate(found) if found else np.zeros(0)

    @cached_property
    def _status(self) -> Graph:
        """The graph of the status alone."""
        return replace(self.graph, outputs={"status": self.graph.outputs["status"]})


def turned(points: Rows, angle: ArrayLike) -> Rows:
    """Points [2, N] about the axis, by angles [N] or one."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * points[0] - sin * points[1], sin * points[0] + cos * points[1]])


def _call(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, np.float32).reshape(1, -1)
