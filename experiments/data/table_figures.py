"""Curves of many tables of one lens at once, by a few rays each: distortion, blur, fields of focus, colour, lengths.

No ray is aimed: chief rays start in the middle of the stop and are followed both ways, to the scene and to the film.
The tables differ in numbers alone, which are arrays [T, 1] here beside rays [T, R]; the surface step is the tracer's.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.optics.lens.glass import LINE_C_NM, LINE_F_NM, index_of
from neurolens.optics.lens.paraxial import System
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import Profile
from neurolens.optics.photographs.verify import heights_of, ideal_heights, shapes
from neurolens.optics.trace.arithmetic import NUMPY
from neurolens.optics.trace.shapes import Curve, without_rim
from neurolens.optics.trace.surfaces import Medium, Rays, cross, medium

Array = NDArray[np.float64]

_SLOPES, SHARES = 25, (0.25, 0.4, 0.55, 0.7)  # chief rays; those with neighbours, as shares of the largest slope
_FARTHER, _STEEPEST = 1.4, 2.0  # than the paraxial slope of the greatest height; the steepest slope in the stop
_NEAR = 1e-6  # mm and slope by which a neighbouring ray differs
_ZONES = np.sqrt((np.arange(8) + 0.5) / 8)  # of the pupil, of equal areas


@dataclass(frozen=True)
class Tables:
    """Tables of one lens as arrays: [S] lists of [T, 1] curvatures, conics, gaps; [S + 1] media; terms of aspheres."""

    lenses: tuple[Lens, ...]
    figures: tuple[Curve, ...]
    gap_mm: tuple[Array, ...]
    media: tuple[Medium, ...]

    @classmethod
    def of(cls, lenses: Sequence[Lens]) -> Tables:
        """The tables of lenses that have the same rows."""
        rows = list(zip(*(lens.surfaces for lens in lenses), strict=True))
        nm = lenses[0].reference_nm
        gaps = tuple(_column(s.thickness_mm for s in row) for row in rows)
        return cls(tuple(lenses), tuple(map(_figure, rows)), gaps, tuple(map(medium, _indices(lenses, nm))))

    @property
    def stop(self) -> int:
        """The index of the stop's row."""
        return self.lenses[0].stop_index

    def at(self, nm: float) -> Tables:
        """The tables at another wavelength than that of reference."""
        return replace(self, media=tuple(map(medium, _indices(self.lenses, nm))))

    @property
    def system(self) -> System:
        """The tables to first order."""
        curvature = [f.curvature + 2 * f.terms[0] if f.terms else f.curvature for f in self.figures]
        return System(curvature, list(self.gap_mm[:-1]), [m.n for m in self.media], [0.0] * len(self.figures))

    def through(self, rays: Rays, order: Sequence[int], sense: int, gap_mm: Any = 0.0) -> Rays:
        """Rays [T, R] with unit directions, their z from the vertex `gap_mm` before the first surface of `order`,
        behind the last one with z from its vertex. NaN where they do not get there.
        """
        if not order:
            return rays
        start = self.media[order[0] if sense > 0 else order[0] + 1]
        rays = Rays(*rays[:3], *(d * start.n for d in rays[3:]))
        passed: Any = True
        for k in order:
            before, after = self.media[k : k + 2][::sense]
            rays = rays._replace(z=rays.z - sense * gap_mm)
            surface = self.lenses[0].surfaces[k]
            crossed = cross(NUMPY, surface, self.figures[k], rays, sense, before, after, rim=lambda _: [])
            for tests, _ in crossed.tests:
                for low, high in tests:
                    passed = passed & (low <= high)
            rays = crossed.bent.rays
            gap_mm = self.gap_mm[k] if sense > 0 else self.gap_mm[k - 1] if k else 0.0
        end = self.media[order[-1] + 1 if sense > 0 else order[-1]]
        return Rays(*(np.where(passed, v, math.nan) for v in (*rays[:3], *(d / end.n for d in rays[3:]))))


def _column(values: Any) -> Array:
    return np.array([[float(v)] for v in values])


def _indices(lenses: Sequence[Lens], nm: float) -> list[Array]:
    return [_column(index_of(m, nm) for m in row) for row in zip(*(lens.media for lens in lenses), strict=True)]


def _figure(row: Sequence[Any]) -> Curve:
    curvature, conic = _column(s.curvature for s in row), _column(s.figure.conic for s in row)
    powers = sorted({int(p) for s in row for p, _ in s.figure.asphere})
    if not powers and not conic.any():
        return Curve(curvature, plain=True)
    even = all(p % 2 == 0 for p in powers)
    each = [dict(s.figure.asphere) for s in row]
    terms = [_column(a.get(p, 0.0) for a in each) for p in range(2, max(powers, default=0) + 1, 2 if even else 1)]
    return without_rim(Curve(curvature, 1 + conic, terms=terms, even=even))


class ChiefRays(NamedTuple):
    """[T, R] field angles (rad), image heights (mm), and at `SHARES` the places of the foci behind the film, mm:
    tangential and sagittal, NaN where there is no ray."""

    angle: Array
    height_mm: Array
    tangential_mm: Array
    sagittal_mm: Array


def chief_rays(tables: Tables, film_mm: Array, slope: Array) -> ChiefRays:
    """Chief rays of slopes [T, R] in the stop, and the foci of narrow beams about some of them.

    `film_mm`: [T, 1] from the last vertex. A neighbour of a chief ray starts beside it, another turned; together they
    make the pair that is parallel in the scene.
    """
    some = slope[:, -1:] * np.array(SHARES)
    zero, near = np.zeros_like(some), np.full_like(some, _NEAR)
    starts = [(0 * slope, 0 * slope, slope, 0 * slope), (zero, zero, some, zero), (zero, near, some, zero)]
    starts += [(zero, zero, some + near, zero), (near, zero, some, zero), (zero, zero, some, near)]
    x, y, up, across = (np.concatenate(part, axis=1) for part in zip(*starts, strict=True))
    scale = 1 / np.sqrt(1 + up * up + across * across)
    k, count = tables.stop, len(tables.figures)
    start = Rays(x, y, np.zeros_like(x), across * scale, up * scale, scale)
    gap = tables.gap_mm[k - 1] if k else 0.0
    back = Rays(*start[:3], *(-d for d in start[3:]))
    scene = tables.through(back, range(k - 1, -1, -1), -1, gap)
    film = tables.through(start, range(k, count), 1)
    way = (film_mm - film.z) / film.dz
    px, py = film.x + way * film.dx, film.y + way * film.dy
    angle = np.arctan2(-scene.dy, -scene.dz)
    m, f = slope.shape[1], len(SHARES)

    def foci(beside: int, turned: int, values: tuple[Array, Array, Array]) -> Array:
        seen, place, tilt = (
            [v[:, m + f * n : m + f * (n + 1)] - v[:, m : m + f] for n in (beside, turned)] for v in values
        )
        mix = -seen[0] / seen[1]  # of the turned neighbour, so that both are parallel in the scene
        return -(place[0] + mix * place[1]) / (tilt[0] + mix * tilt[1])

    tangential = foci(1, 2, (angle, py, film.dy / film.dz))
    sagittal = foci(3, 4, (scene.dx, px, film.dx / film.dz))
    return ChiefRays(angle[:, :m], py[:, :m], tangential, sagittal)


def _slopes(reach_mm: Array, height_mm: float) -> Array:
    """Slopes in the stop [T, R] of chief rays to beyond an image height, by that of the paraxial one of slope 1."""
    return np.minimum(_FARTHER * height_mm / np.abs(reach_mm), _STEEPEST) * np.linspace(0.02, 1, _SLOPES)


class Measures(NamedTuple):
    """What tells a sound table from a broken one, [T] each, and not below 0; infinite where rays do not get through.

    Attributes:
        distortion: residual of its shape beside the profile, percent of the image height.
        blur: of the axis at its best focus, um root mean square, as on full frame, times the f-number.
        focus: root mean square distance of the foci of narrow beams over the field from their mean, percent of the
            focal length; of those that exist, half of all at least.
        colour: distance of the foci of F and C, and lateral: difference of image height, percent.
        focal: how much the focal length differs from the profile's, percent. back: the distance of the film from the
            paraxial focus, as the table states it, percent of the focal length.
    """

    distortion: Array
    blur: Array
    focus: Array
    colour: Array
    lateral: Array
    focal: Array
    back: Array


class Found(NamedTuple):
    """The figures of tables, and what three of them are root mean squares of: [T, N] of distortion, blur and focus."""

    figures: Measures
    off: tuple[Array, Array, Array]


def measure(lenses: Sequence[Lens], profile: Profile, focal_mm: float) -> Found:
    """The figures of tables that have the same rows, placed at a focal length of the profile."""
    tables, height, f_number = Tables.of(lenses), heights_of(profile, lenses[0]), lenses[0].f_number
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of tables whose foci are all unknown
        efl, film, reach, _ = _first_order(tables)
        chief = chief_rays(tables, film, _slopes(reach, height.max()))
        foci = 100 / focal_mm * np.concatenate([chief.tangential_mm, chief.sagittal_mm], axis=1)
        foci -= np.nanmean(foci, axis=1, keepdims=True)
        shape = np.zeros((len(lenses), len(height)))
        for radial in (r for r in profile.distortion if r.focal_mm == focal_mm):
            measured = profile.stretch(radial, height)
            rows = zip(chief.height_mm, chief.height_mm / ideal_heights(profile, chief.angle), strict=True)
            each = (shapes(height, measured, real, values)[:2] for real, values in rows)
            shape = np.array([theirs - ours for theirs, ours in each])
        axis = 1000 * profile.crop * f_number * _on_axis_mm(tables, film, focal_mm / (2 * f_number))
        blue, red = (_first_order(tables.at(nm), film) for nm in (LINE_F_NM, LINE_C_NM))
        film_mm = _column(lens.surfaces[-1].thickness_mm for lens in lenses)
        found = Measures(
            distortion=np.sqrt(np.nanmean(shape**2, axis=1)),
            blur=np.sqrt(np.mean(axis**2, axis=1)),
            focus=np.where(2 * np.isfinite(foci).sum(axis=1) >= foci.shape[1], np.nanstd(foci, axis=1), math.nan),
            colour=100 * np.abs((blue[1] - red[1]) / efl)[:, 0],
            lateral=100 * np.abs(blue[2] / blue[3] / (red[2] / red[3]) - 1)[:, 0],
            focal=100 * np.abs(efl / focal_mm - 1)[:, 0],
            back=100 * np.abs((film_mm - film) / efl)[:, 0],
        )
    return Found(Measures(*(np.where(np.isfinite(v), v, math.inf) for v in found)), (shape, axis, foci))


def _first_order(tables: Tables, film_mm: Array | None = None) -> tuple[Array, ...]:
    """Focal length, back focus, image height (by default there), and slope in the scene, of the chief ray whose slope
    in the stop is 1; [T, 1] each."""
    system, k = tables.system, tables.stop
    one, curvature, gap = np.ones_like(tables.gap_mm[0]), system.curvature, system.gap_mm
    level = system.march(one, 0.0)
    efl, film = -1 / level.after[-1], -level.y[-1] / level.after[-1]
    rear = System(curvature[k:], gap[k:], system.index[k:], system.ideal[k:]).march(0 * one, one)
    front = System(curvature[:k], gap[: max(k - 1, 0)], system.index[: k + 1], system.ideal[:k]).turned()
    scene = front.march(gap[k - 1] * one, one).after[-1] if k else one
    return efl, film, rear.y[-1] + rear.after[-1] * (film if film_mm is None else film_mm), scene


def _on_axis_mm(tables: Tables, film_mm: Array, radius_mm: float) -> Array:
    """Heights of rays [T, R] from a distant point of the axis, over the pupil, where the film is best."""
    y = np.broadcast_to(radius_mm * _ZONES, (len(film_mm), len(_ZONES)))
    zero = np.zeros_like(y)
    start = Rays(zero, y, zero - 2 * radius_mm, zero, zero, zero + 1)
    out = tables.through(start, range(len(tables.figures)), 1)
    tilt = out.dy / out.dz
    height = out.y + (film_mm - out.z) * tilt
    best = -(height * tilt).sum(axis=1, keepdims=True) / (tilt * tilt).sum(axis=1, keepdims=True)
    return np.asarray(height + best * tilt)
