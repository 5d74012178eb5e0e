"""A lens as its pupil is sought: whether rays pass, and how film points and its stop's image are scaled first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.cameras.stop_image import StopImage, stop_image
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph

Truths = NDArray[np.bool_]
Rows = NDArray[np.floating[Any]]
_PART = 1 << 15  # rays evaluated together
_SEEN, _FEW = 4000, 400  # rays that tell of a film point, and how many must pass
_SQUEEZES = np.log(1 / 6), np.log(6)  # the least and the most
_LIMIT = 1.6  # stop radii: points in the image of the stop lie within


@dataclass(frozen=True)
class Sight:
    """A lens whose pupil is sought.

    Attributes:
        graph: of the lens; see `fused.LensGraph`. table: boxes that hold what passes.
        film_z_mm, wavelength_nm: ranges. stop_radius_mm: the widest. stop_surface: for the status of its rays.
        anamorphic: whether it matters on which side of the film a point lies. squeeze: see `PupilArcs`.
        image: of the stop, that `graph` takes points of in place of pupil points.
    """

    graph: Graph
    table: PupilTable
    film_z_mm: tuple[float, float]
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    stop_surface: int
    anamorphic: bool = False
    squeeze: float = 1.0
    image: StopImage | None = None

    def passes(
        self, film: Rows, pupil: Rows, nanometres: ArrayLike, film_z: ArrayLike, stop: ArrayLike,
        azimuth: ArrayLike = 0.0,
    ) -> Truths:  # fmt: skip
        """[...] whether rays pass of squeezed film points, turned by an azimuth about the axis; points [2, ...].

        Of an anamorphic lens also of rays mirrored, which arcs hold too.
        """
        shape = film.shape[1:]
        codes = self.sides(film.reshape(2, -1), pupil.reshape(2, -1), np.broadcast_to(nanometres, shape).ravel(),
                           film_z, stop, azimuth)  # fmt: skip
        known = np.hypot(*self.film_of(film.reshape(2, -1), azimuth)) <= self.film_radius_mm
        return ((codes == st.PASSED).any(0) & known).reshape(shape)

    def sides(self, film: Rows, pupil: Rows, *call: ArrayLike) -> NDArray[Any]:
        """[1 or 2, N] codes of rays from points [2, N], turned by an azimuth, and of an anamorphic lens mirrored."""
        *others, azimuth = call
        placed, ways = self.film_of(film, azimuth), (1.0, -1.0) if self.anamorphic else (1.0,)
        return np.stack([self.status(placed, turned(pupil * [[1.0], [way]], azimuth), *others) for way in ways])

    def film_of(self, film: Rows, azimuth: ArrayLike) -> Rows:
        """Film points of squeezed ones, turned by an azimuth."""
        return turned(film, azimuth) * np.array([[1.0], [1 / self.squeeze]])

    @property
    def film_radius_mm(self) -> float:
        """Beyond it nothing is known."""
        return self.table.film_radius_mm / max(1.0, self.squeeze)

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


def imaged(sight: Sight) -> Sight:
    """The lens from points in the image of its stop; itself where that is not found."""
    radius, (low, high) = sight.table.film_radius_mm, sight.wavelength_nm
    image = stop_image(sight.graph, radius, sight.film_z_mm, (low, high), sight.stop_radius_mm, sight.anamorphic)
    if image is None:
        return sight
    reach = _LIMIT * sight.stop_radius_mm * np.array([[-1], [1], [1]], np.float32)
    table = replace(sight.table, rows=np.repeat(reach, sight.table.rows.shape[1], axis=1))
    seen = replace(sight, graph=image.before(sight.graph), table=table, image=image)
    if not sight.anamorphic:
        return seen
    squeeze = _squeeze(seen)
    wide = replace(table, film_radius_mm=radius * max(1.0, squeeze))
    return replace(seen, squeeze=squeeze, table=wide)


def _squeeze(sight: Sight) -> float:
    """By which y of film points is scaled, so that rims cut the image of the stop from the side of the film point.

    Light is longest along the rims.
    """
    rng, grid = np.random.default_rng(0), np.meshgrid((0.7, 0.8, 0.9), np.pi / 2 * np.arange(1, 8) / 8)
    radius, azimuth = sight.film_radius_mm * grid[0].ravel(), grid[1].ravel()
    pupil = _LIMIT * sight.stop_radius_mm * (2 * rng.random((2, azimuth.size, _SEEN)) - 1)
    film = np.repeat((radius * np.stack([np.cos(azimuth), np.sin(azimuth)]))[..., None], _SEEN, axis=2)
    call = float(np.mean(sight.wavelength_nm)), float(np.mean(sight.film_z_mm)), sight.stop_radius_mm
    lit = sight.status(film.reshape(2, -1), pupil.reshape(2, -1), *call).reshape(azimuth.size, _SEEN) == st.PASSED
    ratios, weights = [], []
    for own, passed, angle in zip(pupil.transpose(1, 0, 2), lit, azimuth, strict=True):
        if passed.sum() < _FEW:
            continue
        lengths, ways = np.linalg.eigh(np.cov(own[:, passed]))
        x, y = np.abs(ways[:, 0])  # the short one
        ratios.append(np.log(max(y, 1e-3) / max(x, 1e-3) / np.tan(angle)))
        weights.append((1 - lengths[0] / lengths[1]) ** 2)
    return float(np.exp(np.clip(np.average(ratios, weights=weights), *_SQUEEZES))) if sum(weights) > 0 else 1.0


def turned(points: Rows, angle: ArrayLike) -> Rows:
    """Points [2, N] about the axis, by angles [N] or one."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * points[0] - sin * points[1], sin * points[0] + cos * points[1]])


def _call(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, np.float32).reshape(1, -1)
