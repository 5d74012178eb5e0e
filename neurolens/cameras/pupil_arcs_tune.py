"""Moves the arcs of `pupil_arcs` to where they hold the rays that pass a lens, and as few others as they can.

Rays near the arcs either pass, and should lie inside every arc, or are blocked, and should lie outside the arc of what
blocks them: arcs are lines between two kinds of points. Newton's rule takes their numbers to the least sum of how
far rays lie on the wrong side; those that pass weigh more, zone by zone of the film, until few enough are lost there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.progress import Report
from neurolens.cameras.arcs_passing import passing
from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_fold import NUMBERS, fold_margins
from neurolens.cameras.pupil_sight import Sight, Truths, turned
from neurolens.graph.interpret import evaluate

Array = NDArray[np.float64]
_RAYS = 90_000  # random ones, of an anamorphic lens twice as many, to fit a stop that folds three times
# Of the root of the film radius (exposure is of the axis), stop and azimuth; rays that tell of one.
_ZONES, _FEW = (8, 3, 3), 400
_ALL = int(np.prod(_ZONES)) + _ZONES[0]  # and of film radius alone, for the others
_BAND, _ALL_OVER = (0.75, 1.2), 0.15  # of arcs, from their middle, where rays are told apart; share of rays anywhere
_WITHIN = 0.45  # of the light of a pupil lies in that band
_ROUNDS, _MOST = 7, 4  # of Newton's rule with the same rays, and draws of rays
_WIDTHS = (0.02, 0.01, 0.005, 0.003)  # of an arc's step, in half widths of the pupil, by rays drawn
_HOPELESS = 0.9  # of points that pass after the first draw: arcs of so few terms do not fit the lens
_GOAL, _ENOUGH = 2e-4, 4e-4  # of rays that pass, in a zone, that may be lost; of others, where it is done
_HEAVY, _HEAVIER, _LIGHTEST, _HEAVIEST = 10.0, 1.6, 2.0, 3e4  # weight of rays that pass: at first, its step, ends
_LIGHTEST_OF_FOLD = 8.0  # of more numbers, which bend more where few rays tell
_DEEP = 0.08  # half widths of the pupil: blocked rays deeper inside are given up
_FLOOR, _CALM, _CALM_SHARE = 0.05, 0.002, 0.05  # of curvature: near an arc, far from it; share of those rays that count
_HALVINGS, _MORE, _MORE_OF_FOLD = 6, 2e-3, 4e-4  # of a step by which arcs would lose so many more rays of a zone
_LOST, _LOST_OF_MANY = 7e-4, 1e-3  # of random rays that check, where a margin is enough; of many states, or of a fold
_CHECK_SEED, _DRAWS, _TELLING = 20, 3, 2500  # fewer rays of a zone do not tell
_MARGINS, _RIMS = (0.0, 0.001, 0.002, 0.003, 0.005, 0.008), 4.0  # that widen arcs which lose light; rims by more
_SMALLEST = 0.05  # stop, of the widest, that pupils are scaled by
_RIDGE = 1e-6


@dataclass(frozen=True)
class _Rays:
    """Random rays [N] of a lens.

    Attributes:
        monomials: [M, N] of `PupilArcs.exponents`. x, y: in the frame of the film point.
        passed, of_stop: what becomes of them: the stop blocks them. zone: see `zones_of`. unit: half the
            pupil's width. size: of the stop, in its widest radii.
    """

    monomials: Array
    x: Array
    y: Array
    passed: Truths
    of_stop: Truths
    zone: NDArray[np.intp]
    unit: Array
    size: Array

    def shares(self, these: Truths) -> Array:
        """[Z] of rays that pass in each zone."""
        count, found = (np.bincount(self.zone[own], minlength=_ALL) for own in (self.passed, self.passed & these))
        return np.asarray(_WITHIN * found / np.maximum(count, 1))

    def within(self, numbers: Array, sides: Sequence[int]) -> Array:
        """[A, N] the margins in every arc."""
        return np.stack([self.margins(own, side)[0] for own, side in zip(numbers, sides, strict=True)])

    def margins(self, numbers: Array, side: int) -> tuple[Array, list[Array | None], Array]:
        """How far rays lie within an arc [4 or 8, M], in half widths of the pupil; its slopes by these, times a scale;
        the scale."""
        if side == 0 and len(numbers) == NUMBERS:
            return fold_margins(numbers @ self.monomials, self.x, self.y, self.size)
        low, high, first, change = numbers[:4] @ self.monomials
        left, right, by_low, by_high = self.x - low, high - self.x, None, None
        if side == 0:
            away, wide = left, first + change * left
            height, reach, ends = left * right * wide, right * left, np.minimum(left, right)
            by_low, by_high = -right * (wide + left * change), left * wide
        else:
            away = ends = reach = right if side > 0 else left
            height, slope = away * (first + change * away), first + 2 * change * away
            by_low, by_high = (None, slope) if side > 0 else (-slope, None)
        along = sum(-row for row in (by_low, by_high) if row is not None)
        scale = (np.hypot(along, 2 * self.y) + 1e-9) * self.unit
        by = [by_low, by_high, reach, reach * away] + [None] * (len(numbers) - 4)
        return np.minimum((height - self.y**2) / scale, ends / self.unit), by, scale


def moved(
    nodes: Sequence[PupilArcs], half_mm: float, sights: Sequence[Sight], report: Report,
    between: Sequence[tuple[Array, Sight]] = (), seed: int = 0,
) -> tuple[list[PupilArcs], float]:  # fmt: skip
    """The arcs of a lens in each of its states, moved, and the share of the rays of the worst zone that they lose.

    Args:
        half_mm: half the width of the pupil. between: weights of these states and the lens there, see `fit_arcs`.
        seed: of the rays that tell how.
    """
    parts = [partial(_within, report, k / len(nodes), 1 / len(nodes)) for k in range(len(nodes))]
    alone = len(nodes) == 1
    nodes = [_tuned(*of_one, alone, seed) for of_one in zip(nodes, sights, parts, strict=True)]
    seen = [*zip(np.eye(len(nodes)), sights, strict=True), *between]
    checks = [_checks(nodes[0].mixed(nodes[1:], weights), sight) for weights, sight in seen]
    for margin in _MARGINS:
        wider = [_wider(a, rays, margin, half_mm) for a, (rays, _) in zip(nodes, checks, strict=False)]
        lost = max(
            _lost(wider[0].mixed(wider[1:], weights), *check) for (weights, _), check in zip(seen, checks, strict=True)
        )
        if lost <= (_LOST if len(seen) == 1 and not nodes[0].folds else _LOST_OF_MANY):
            break
    return wider, lost


def _within(report: Report, begun: float, part: float, share: float) -> None:
    report(begun + part * share)


def _checks(arcs: PupilArcs, sight: Sight) -> tuple[dict[str, Array], NDArray[np.intp]]:
    """Random rays that pass, and their zones."""
    rays, stop, codes = random_rays(sight, arcs, np.random.default_rng(_CHECK_SEED), _DRAWS * _RAYS)
    passed = codes == st.PASSED
    rays, stop = {name: row[:, passed] for name, row in rays.items()}, stop[passed]
    return rays, zones_of(arcs, rays, scaled_of(arcs, rays, stop), np.ones(stop.size, bool))


def _lost(arcs: PupilArcs, rays: dict[str, Array], zone: NDArray[np.intp]) -> float:
    """Share of rays of the worst zone that lie beyond arcs."""
    found = evaluate(arcs.checked, rays)
    inside = (found["left"] >= 0) & (found["right"] >= 0) & (found["height"] >= rays["pupil_mm"][1] ** 2)
    counts, missed = (np.bincount(zone, own, _ALL) for own in (None, ~inside.all(0)))
    return float((missed / np.maximum(counts, _TELLING)).max())


def _wider(arcs: PupilArcs, rays: dict[str, Array], margin: float, half_mm: float) -> PupilArcs:
    """The arcs, moved outwards by a share of half the pupil's width."""
    numbers, changes = arcs.numbers.copy(), evaluate(arcs.checked, rays)["change"].min(1)
    for own, side, change in zip(numbers, arcs.sides, changes, strict=True):
        if not side and arcs.folds:
            own[:3], own[5:] = own[:3] * (1 - margin), own[5:] * (1 - margin) ** 2
            continue
        step = margin * half_mm * (_RIMS if side else 1.0)
        still, along = ((arcs.exponents == (0, power, 0, 0, 0)).all(1) for power in (0, int(side == 0)))
        own[0] -= step * along * (side <= 0)
        own[1] += step * along * (side >= 0)
        own[2] += (step * (1 + 2 * max(-float(change), 0.0)) if side else margin) * still  # the far end of a rim, too
    return replace(arcs, numbers=numbers)


def _tuned(arcs: PupilArcs, sight: Sight, report: Report, alone: bool, seed: int) -> PupilArcs:
    """The arcs, moved; only the terms that they have."""
    numbers, weight = arcs.numbers.copy(), np.full(_ALL, _HEAVY)
    used, least = arcs.numbers != 0, _LIGHTEST_OF_FOLD if arcs.folds else _LIGHTEST
    for draw in range(_MOST):
        rays = _drawn(sight, replace(arcs, numbers=numbers), draw + seed * _MOST)
        for k in range(_ROUNDS + 1):
            report((draw + k / _ROUNDS) / _MOST)
            within = rays.within(numbers, arcs.sides)
            lost = rays.shares(np.any(within < 0, axis=0))
            if k == 0 and draw == _MOST - 1 and lost.max() < _ENOUGH:  # of rays that it has not been fitted to
                return replace(arcs, numbers=numbers)
            change = ((lost + _GOAL / 5) / (_GOAL * 1.2)).clip(1 / _HEAVIER, _HEAVIER)
            weight = (weight * change).clip(least, _HEAVIEST)
            if k < _ROUNDS:
                blame = _blame(rays, within, arcs.sides)
                for arc, side in enumerate(arcs.sides):
                    beside = rays.passed | (blame == arc)
                    numbers[arc] = _stepped(numbers[arc], side, used[arc], rays, beside, weight, _WIDTHS[draw])
        if alone and draw == 0 and min(passing(sight, replace(arcs, numbers=numbers)).values()) < _HOPELESS:
            break
    return replace(arcs, numbers=numbers)


def _blame(rays: _Rays, within: Array, sides: Sequence[int]) -> NDArray[np.intp]:
    """[N] the arc beyond which a blocked ray should lie: the stop's, or the nearest of the rims'."""
    rims = np.flatnonzero(sides)
    if not rims.size:
        return np.zeros(rays.x.size, np.intp)
    return np.where(rays.of_stop, 0, rims[within[rims].argmin(0)])


def _stepped(
    numbers: Array, side: int, used: Truths, rays: _Rays, told: Truths, weight: Array, width: float
) -> Array:  # fmt: skip
    """An arc's numbers [4 or 8, M] after a step of Newton's rule. `told`: rays that pass, and those this arc blocks."""
    within, by, scale = rays.margins(numbers, side)
    beside = told & np.where(rays.passed, within < 8 * width, (within > -6 * width) & (within < 4 * _DEEP))
    calm = np.random.default_rng(1).random(within.size) < _CALM_SHARE
    chosen = np.flatnonzero(beside | (rays.passed & calm))
    parts = [(row[chosen] / scale[chosen], own) for row, own in zip(by, used, strict=True) if row is not None]
    rows = np.concatenate([rays.monomials[np.ix_(own, chosen)] * row for row, own in parts])
    own, passed = within[chosen], rays.passed[chosen]
    near = np.abs(own) < 8 * width
    if not len(rows) or not near.any():
        return numbers
    in_it = 1 / (1 + np.exp(-np.clip(own / width, -40, 40)))
    force = np.where(passed, weight[rays.zone[chosen]], 1.0)
    pull = np.where(passed, -force * (1 - in_it), in_it * np.exp(-np.maximum(own, 0) / _DEEP))
    least = np.where(near, _FLOOR, _CALM / (1 + np.abs(own)) ** 2)
    matrix = (rows * (np.maximum(force * in_it * (1 - in_it), least) / width)) @ rows.T
    size = np.sqrt(np.diag(matrix)) + 1e-30
    matrix = matrix / size / size[:, None] + _RIDGE * np.eye(size.size)
    step = -np.linalg.solve(matrix, rows @ pull / size) / size
    step *= min(1.0, 2 * width / float(np.quantile(np.abs(step @ rows[:, near]), 0.98)))
    moves = np.array([row is not None for row in by])[:, None] & used
    lost, more = rays.shares(within < 0), _MORE_OF_FOLD if len(numbers) == NUMBERS else _MORE
    for _ in range(_HALVINGS):
        after = numbers.copy()
        after[moves] += step
        if (rays.shares(rays.margins(after, side)[0] < 0) - lost).max() < more:
            return after
        step = step / 2
    return numbers


def _drawn(sight: Sight, arcs: PupilArcs, seed: int) -> _Rays:
    rng = np.random.default_rng(100 + seed)
    given, stop, codes = random_rays(sight, arcs, rng, _RAYS * (1 + 2 * arcs.folds), near=True)
    scaled = scaled_of(arcs, given, stop)
    monomials = np.ones((len(arcs.exponents), stop.size))
    for row, powers in zip(monomials, arcs.exponents, strict=True):
        for value, power in zip(scaled, powers, strict=True):
            if power:
                row *= value**power
    passed, of_stop = codes == st.PASSED, codes == st.blocked(sight.stop_surface, st.RIM)
    x, y = given["pupil_mm"]
    if not passed.any():
        passed[0] = True
    unit = np.maximum(scaled[1], _SMALLEST) * float(np.abs(y[passed]).max())
    return _Rays(monomials, x, y, passed, of_stop, zones_of(arcs, given, scaled, passed), unit, scaled[1])


def scaled_of(arcs: PupilArcs, rays: dict[str, Array], stop: Array) -> Array:
    """`PupilArcs.scaled` of rays of `random_rays`."""
    azimuth = np.arccos(rays["twice"][0]) / 2
    return arcs.scaled(rays["film_mm"][0], stop, rays["film_z_mm"][0], rays["wavelength_nm"][0], azimuth)


def zones_of(arcs: PupilArcs, rays: dict[str, Array], scaled: Array, passed: Truths) -> NDArray[np.intp]:
    """[N] zones of rays of `random_rays` by film radius, stop and azimuth; few rays by film radius alone."""
    radius = np.sqrt(rays["film_mm"][0] / rays["film_mm"][0].max())
    shares = radius, scaled[1] * 0.7501, (1 + scaled[4]) / 2  # the widest stop is a zone of its own
    places = [np.minimum(share * n, n - 1).astype(np.intp) for share, n in zip(shares, _ZONES, strict=True)]
    own = np.ravel_multi_index(places, _ZONES)
    few = np.bincount(own[passed], minlength=np.prod(_ZONES))[own] < _FEW
    return np.where(few, np.prod(_ZONES) + places[0], own).astype(np.intp)


def random_rays(
    sight: Sight, arcs: PupilArcs, rng: np.random.Generator, count: int, near: bool = False
) -> tuple[dict[str, Array], Array, NDArray[np.int32]]:
    """Random rays from film points on +x, as inputs of `PupilArcs.checked`, stops, and what becomes of them.

    Narrow stops are seldom met by rays all over the table: most go to the middle of the arcs, or `near` to their edge.
    """
    count *= 1 + sight.anamorphic
    radius = arcs.film_radius_mm * rng.random(count) * 0.9999
    stop = sight.stop_radius_mm * rng.choice(np.append(np.linspace(0.08, 1, 12), [1.0] * 4), count)
    film_z, nm = (rng.uniform(*span, count) for span in (sight.film_z_mm, sight.wavelength_nm))
    azimuth = np.pi / 2 * rng.random(count) * sight.anamorphic
    place: Array = turned(np.stack([radius, 0 * radius]), azimuth).astype(np.float64)
    radii = np.linspace(0, sight.table.film_radius_mm, sight.table.rows.shape[1])
    low, high, half = (np.interp(radius, radii, a) for a in sight.table.rows)
    pupil = np.stack([low + (high - low) * rng.random(count), half * rng.random(count)])
    pupil[1] *= rng.choice([-1.0, 1.0], count) if sight.anamorphic else 1.0
    square, wide = rng.random((2, count)), np.full(count, 1.25)
    if near:  # points on the edge of the square are those on the edge of the arcs
        square[0], wide = np.round(square[0]), np.sqrt(rng.uniform(_BAND[0] ** 2, _BAND[1] ** 2, count))
        square = np.where(rng.random(count) < 0.5, square, square[::-1])
    given = {"square": square, "stop_radius_mm": stop[None], "film_mm": place}
    given |= {"film_z_mm": film_z[None], "wavelength_nm": nm[None]}
    edge = turned(evaluate(arcs.graph, given)["pupil_mm"], -azimuth)
    middle = turned(evaluate(arcs.graph, given | {"square": np.full((2, count), 0.5)})["pupil_mm"], -azimuth)
    all_over = rng.random(count) < (_ALL_OVER if near else 0.3)
    pupil = np.where(all_over, pupil, middle + wide * (edge - middle))
    codes = sight.status(place, turned(pupil, azimuth), nm, film_z, stop)
    given |= {"film_mm": np.stack([radius, 0 * radius]), "pupil_mm": pupil, "twice": np.cos(2 * azimuth)[None]}
    return given, stop, codes
