"""Fits the circles of `pupil_circles` to what passes a lens.

In points of the stop whether a ray lies within a rim's circle is linear in the circle's numbers: Newton's rule parts
rays that pass from those that this rim blocks. Those that pass weigh more, zone by zone, until few enough are lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.progress import Report
from neurolens.cameras.arcs_passing import passing
from neurolens.cameras.pupil_boxes import asking, end_of_light
from neurolens.cameras.pupil_circles import PupilCircles
from neurolens.cameras.pupil_sight import Sight
from neurolens.cameras.stop_image import StopImage, draw_rays, stop_image
from neurolens.graph.interpret import evaluate

Array = NDArray[np.float64]
Truths = NDArray[np.bool_]
_RAYS, _CHECKED = 60_000, 600_000
_STOPS = (0.08, 0.16, 0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.0, 1.0)  # of the widest
_AROUND, _FOLD = 1.1, 0.25  # stops: where rays are drawn; of the pupil's size: beside it are others
# Most powers of the film point, of anamorphic lenses and round ones; of terms with the film position and its square.
_DEGREE, _MOVING = (4, 8), (3, 1)
_FOLDED = 0.01  # of rays, that are beside it, from which on circles cannot hold a pupil
_RARE = 0.006  # of rays, that a rim blocks, from which on it has a circle
_ZONES, _FEW = (8, 3, 3), 2500  # of film radius squared, azimuth and stop; rays that tell of one
_ALL = int(np.prod(_ZONES))
_SQUEEZES = (1.0, 0.7, 0.5, 0.35, 1.4, 2.0)  # that are tried
_WITHIN = 0.97  # stops: rays that lie so far within one are blocked by others
_PARTS, _NEAR = 16, 12.0  # of many rays; margins of those that lie near a circle
_ROUNDS, _HEAVY, _HEAVIER, _LIGHTEST, _HEAVIEST = 25, 5.0, 1.6, 2.0, 3e4
_STRIDE = 30.0  # longest change of a margin in a step
_GOAL = 2e-4  # of rays that pass, in a zone, that a circle may lose
_RIDGE, _LEAST = 1e-9, 1e-4
_FLATTEST = 0.02  # of the size of a circle's other numbers: curvature
_HELD = (4e-4, 4e-4, 3e-4, 2e-4)  # of rays that pass in a zone, that a circle or the disc may lose, in turn until
_LOST = 1e-3  # of others at most are lost in all
_INNER = 0.1  # of what the disc grows by, where it is as on the axis


@dataclass(frozen=True)
class _Rays:
    """Random rays through points of the stop (in its widest radius): film points scaled to 1, film positions."""

    given: dict[str, Array]
    codes: NDArray[np.int32]
    zone: NDArray[np.intp]

    @property
    def passed(self) -> Truths:
        return np.asarray(self.codes == st.PASSED)


def fit_circles(sight: Sight, report: Report) -> tuple[PupilCircles, float] | None:
    """The circles of a lens, and the share of rays of the worst zone that they lose; None where too few rays pass, or
    where the pupil folds."""
    image = stop_image(sight)
    if image is None or (folded := _folded(sight, image)) > _FOLDED:
        return None
    seen = replace(sight, graph=image.before(sight.graph, sight.anamorphic))
    exponents, numbers = _exponents(sight.anamorphic), np.zeros((0, 3, 0))
    circles = PupilCircles(_film_radius(sight), image, sight.anamorphic, (1.0, 0.0), exponents[:0, :3], numbers)
    few, many = _drawn(seen, circles, 1, _RAYS), _drawn(seen, circles, 3, _CHECKED)
    circles = replace(circles, wide=_disc(circles, many))
    circles = _written(circles, exponents, _rims(sight, few, many, circles, exponents, report))
    for seed, held in enumerate(_HELD):
        circles = _held(circles, _drawn(seen, circles, 4 + seed, _CHECKED), held)
        if (lost := max(_lost(seen, circles), folded)) <= _LOST:
            break
    ways = [replace(circles, squeeze=s) for s in (_SQUEEZES if sight.anamorphic and len(circles.numbers) else (1.0,))]
    return max(ways, key=lambda way: passing(sight, way)[1.0]) if len(ways) > 1 else circles, lost


def _rims(
    sight: Sight, few: _Rays, many: _Rays, circles: PupilCircles, exponents: NDArray[np.int64], report: Report
) -> Array:
    """Numbers [K, M + 1] of the circles of rims that block more than a few rays: from rays all over, then from many
    that lie near them or on their wrong side."""
    stop = st.blocked(sight.stop_surface, st.RIM)
    codes, counts = np.unique(few.codes[few.codes > st.NO_SOLUTION], return_counts=True)
    rims = [int(c) for c, n in zip(codes, counts, strict=True) if c != stop and n > _RARE * few.codes.size]
    numbers = np.zeros((len(rims), len(exponents) + 1))
    for k, code in enumerate(rims):
        told = np.flatnonzero(few.passed | (few.codes == code))
        numbers[k] = _parted(few, told, circles, exponents, numbers[k])
    blame = _blame(many, circles, exponents, rims, numbers)
    for k in range(len(rims)):
        report((k + 1) / (len(rims) + 1))
        told = np.flatnonzero(many.passed | (blame == k))
        parts = [numbers[k] @ _features(many, circles, exponents, part) for part in np.array_split(told, _PARTS)]
        margin = np.concatenate(parts)
        told = told[np.where(many.passed[told], margin, -margin) < _NEAR]
        numbers[k] = _parted(many, told, circles, exponents, numbers[k])
    return numbers


def _blame(
    rays: _Rays, circles: PupilCircles, exponents: NDArray[np.int64], rims: list[int], numbers: Array
) -> NDArray[np.intp]:
    """[N] of rays that do not pass the circle that should stop them: that of their rim, or the nearest; -1: none."""
    found = np.full(rays.codes.size, -1)
    for k, code in enumerate(rims):
        found[rays.codes == code] = k
    size = rays.given["stop_radius_mm"][0]
    others = ~rays.passed & (found < 0) & (np.hypot(*rays.given["point_mm"]) < _WITHIN * size)
    for part in np.array_split(np.flatnonzero(others), _PARTS) if rims else ():
        found[part] = (numbers @ _features(rays, circles, exponents, part)).argmin(0)
    return found


def _written(circles: PupilCircles, exponents: NDArray[np.int64], numbers: Array) -> PupilCircles:
    """With circles of these numbers [K, M + 1]."""
    moved = np.unique(exponents[:, :3], axis=0)
    found = np.zeros((len(numbers), 3, len(moved)))
    for e, values in zip(exponents, (numbers[:, :-1] / numbers[:, -1:]).T, strict=True):
        kind = int(e[3] + 2 * e[4])
        found[:, kind, (moved == e[:3]).all(1)] = values[:, None] / (2 if kind else 1)
    return replace(circles, exponents=moved, numbers=found)


def _film_radius(sight: Sight) -> float:
    """Where light ends on the film."""
    low, high = sight.film_z_mm
    found = [0.0]
    for z in {low, (low + high) / 2, high}:
        for azimuth in np.linspace(0, np.pi / 2, 4) if sight.anamorphic else [0.0]:
            passes = partial(sight.passes, film_z=z, stop=sight.stop_radius_mm, azimuth=azimuth)
            found.append(end_of_light(sight.table, asking(passes, sight.wavelength_nm)) or 0.0)
    return min(max(found), sight.film_radius_mm)


def _exponents(anamorphic: bool) -> NDArray[np.int64]:
    """[M, 5] of film x, y, film position, stop x, y: of what mirrors leave alone, linear in the stop point."""
    found, degree = [], _DEGREE[not anamorphic]
    for i in range(degree + 1):
        for j in range(degree + 1 if anamorphic else 1):
            for u, v in ((0, 0), (1, 0), (0, 1)):
                if i + j <= degree and (i + u) % 2 == 0 and (j + v) % 2 == 0:
                    found += [(i, j, k, u, v) for k in range(3) if k == 0 or i + j + u + v <= _MOVING[k - 1]]
    return np.array(found, np.int64)


def _drawn(seen: Sight, circles: PupilCircles, seed: int, count: int) -> _Rays:
    rng = np.random.default_rng(seed)
    radius = circles.film_radius_mm * 0.9999 * rng.random(count) ** 0.5
    angle = 2 * np.pi * rng.random(count) if circles.anamorphic else np.zeros(count)
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    z, nm = (rng.uniform(*span, count) for span in (seen.film_z_mm, seen.wavelength_nm))
    share = rng.choice(_STOPS, count)
    size, turn = _AROUND * share * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    point = size * seen.stop_radius_mm * np.stack([np.cos(turn), np.sin(turn)])
    codes = seen.status(film, point, nm, z, share * seen.stop_radius_mm)
    given = {
        "film_mm": film,
        "point_mm": point,
        "film_z_mm": z[None],
        "stop_radius_mm": share[None] * seen.stop_radius_mm,
    }
    aside = np.abs(np.arctan2(np.abs(film[1]), np.abs(film[0]))) / (np.pi / 2)
    places = [np.minimum(s * n, n - 1).astype(np.intp) for s, n in zip(
        ((radius / circles.film_radius_mm) ** 2, aside, share * 0.7501), _ZONES, strict=True)]  # fmt: skip
    return _Rays(given, codes, np.ravel_multi_index(places, _ZONES))


def _disc(circles: PupilCircles, rays: _Rays) -> tuple[float, float]:
    """How wide the disc must be, see `PupilCircles.wide`: images err most where the film ends."""
    size = rays.given["stop_radius_mm"][0] / circles.image.stop_mm
    beyond = np.hypot(*rays.given["point_mm"]) / circles.image.stop_mm / size - 1
    place = (np.square(rays.given["film_mm"]).sum(0) / circles.image.unit_mm**2 * size) ** 2
    found = [(float(place[own].mean()), need) for own, need in _need(rays, -beyond, _HELD[0])]
    inner = max(0.0, *(need for at, need in found if at < _INNER))
    return 1 + inner, max(0.0, *((need - inner) / at for at, need in found if at >= _INNER))


def _need(rays: _Rays, within: Array, held: float) -> list[tuple[Truths, float]]:
    """Rays that pass in each zone, and by how much more rays should lie within, so that few enough of them do not."""
    found = []
    for zone in np.unique(rays.zone):
        own = rays.passed & (rays.zone == zone)
        given, spare = within[own], round(held * max(own.sum(), _FEW))
        if given.size > spare:
            found.append((own, -float(np.partition(given, spare)[spare])))
    return found


def _held(circles: PupilCircles, rays: _Rays, held: float) -> PupilCircles:
    """With circles as much wider as random rays need."""
    within, numbers = evaluate(circles.checked, rays.given)["within"][1:], circles.numbers.copy()
    constant = (circles.exponents == 0).all(1)
    for own, margin in zip(numbers, within, strict=True):
        own[0, constant] += max([0.0, *(need for _, need in _need(rays, margin, held))])
    return replace(circles, numbers=numbers)


def _parted(
    rays: _Rays, told: NDArray[np.intp], circles: PupilCircles, exponents: NDArray[np.int64], numbers: Array
) -> Array:
    """Numbers [M + 1] of a circle by `exponents` and its curvature, that part the rays `told` which pass from others;
    `numbers` are where it begins."""
    lit, weight = np.bincount(rays.zone[rays.passed], minlength=_ALL), np.full(_ALL, _HEAVY)
    rows, inside, zone = _features(rays, circles, exponents, told), rays.passed[told], rays.zone[told]
    for _ in range(_ROUNDS):
        chance = 1 / (1 + np.exp(-np.clip(numbers @ rows, -40, 40)))
        force = np.where(inside, weight[zone], 1.0)
        matrix = (rows * (force * np.maximum(chance * (1 - chance), _LEAST))) @ rows.T
        matrix += _RIDGE * np.diag(np.diag(matrix))
        step = -np.linalg.solve(matrix, rows @ (force * (chance - inside)))
        numbers = numbers + step * min(1.0, _STRIDE / float(np.abs(step @ rows).max()))
        numbers[-1] = max(numbers[-1], _FLATTEST * float(np.abs(numbers[:-1]).max()))
        if rays.codes.size < _CHECKED:  # too few tell
            continue
        lost = np.bincount(zone[inside & (numbers @ rows < 0)], minlength=_ALL) / np.maximum(lit, _FEW / 3)
        change = ((lost + _GOAL / 5) / (_GOAL * 1.2)).clip(1 / _HEAVIER, _HEAVIER)
        weight = (weight * change).clip(_LIGHTEST, _HEAVIEST)
    return numbers


def _features(rays: _Rays, circles: PupilCircles, exponents: NDArray[np.int64], own: NDArray[np.intp]) -> Array:
    """[M + 1, N] what a circle's numbers are of, of some of the rays."""
    given, image = rays.given, circles.image
    point = given["point_mm"][:, own] / image.stop_mm
    place = (given["film_z_mm"][:, own] - image.film_z_mm[0]) / image.film_z_mm[1]
    variables = np.concatenate([given["film_mm"][:, own] / image.unit_mm, place, point])
    rows = np.ones((len(exponents) + 1, own.size))
    for row, powers in zip(rows, exponents, strict=False):
        for value, power in zip(variables, powers, strict=True):
            if power:
                row *= value**power
    rows[-1] = -np.sum(point**2, axis=0)
    return rows


def _lost(seen: Sight, circles: PupilCircles) -> float:
    """Share of random rays that pass beyond the circles, in the worst zone."""
    rays = _drawn(seen, circles, 2, _CHECKED)
    out = rays.passed & (evaluate(circles.checked, rays.given)["within"] < 0).any(0)
    counts, missed = (np.bincount(rays.zone[own], minlength=_ALL) for own in (rays.passed, out))
    return float((missed / np.maximum(counts, _FEW)).max())


def _folded(sight: Sight, image: StopImage) -> float:
    """Share of random rays that pass through pupil points which the image does not have, in the worst part of the film:
    where a pupil folds, two of its points show one point of the stop."""
    film, z, nm, pupil, point = draw_rays(sight, None, np.random.default_rng(5))
    given = {"film_mm": film, "point_mm": point, "film_z_mm": z[None], "wavelength_nm": nm[None]}
    away = np.hypot(*(evaluate(image.graph, given)["pupil_mm"] - pupil)) > _FOLD * pupil.std()
    part = (np.square(film).sum(0) / sight.film_radius_mm**2 * _ZONES[0]).astype(np.intp)
    return float((np.bincount(part, away) / np.maximum(np.bincount(part), _FEW)).max())
