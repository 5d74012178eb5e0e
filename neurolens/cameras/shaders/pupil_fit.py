"""The fit of a shader's pupil to the rays that pass a lens: circles in the stop, or one wide disc.

In points of the stop, how far a ray lies within a rim's circle is linear in the circle's numbers, so least squares put
the circle through rays that this rim all but stops. Rays beyond the circle get more weight, and new rays widen it,
until few enough of those that pass are lost in any zone of film and stop. Where the stop's image folds, or circles lose
too much, one disc holds all rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.progress import Report
from neurolens.cameras.shaders.pupil import PupilCircles, passing_share
from neurolens.cameras.shaders.shader_lens import ShaderLens, StopImage, draw_rays, fit_stop_images
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents

Array = NDArray[np.float64]
Truths = NDArray[np.bool_]
_RAYS = 6_000  # random rays of a zone
_STOPS = (0.08, 0.16, 0.25, 0.35, 0.5, 0.7, 0.85, 1.0, 1.0, 1.0)  # shares of the widest stop at which rays are drawn
_AROUND = 1.1  # radius, in stop radii, within which rays are drawn
# share of the pupil's size that a ray may lie from the image, and share of the rays that may lie farther
_BESIDE, _FOLDED = 0.25, 0.01
# Highest powers of the film point, for round lenses and anamorphic ones; and of terms with the film position and its
# square.
_DEGREE, _MOVING = (8, 4), (3, 1)
# rays between which edges are sought, halvings, edges of a rim that are kept, and edges with which a rim counts
_EDGES, _HALVINGS, _CODES, _RARE = 20_000, 12, 4000, 300
_ZONES, _FEW = (8, 3, 3), 2500  # zones of film radius squared, azimuth and stop; rays with which a zone counts
_ALL = int(np.prod(_ZONES))
_SQUEEZES = (1.0, 0.7, 0.5, 0.35, 1.4, 2.0)  # those that are tried
_ROUNDS, _HEAVIER = 20, 20.0  # rounds of least squares; how many times the weight that rays beyond a circle then have
# share of the equations' diagonal; rays with whose force numbers are held at those of all states
_RIDGE, _CALM = 1e-9, 1e-3
# Shares of a zone's new rays that all circles may lose, tried in turn until they lose at most `_SURE`. If they still
# lose more than `LOST`, they give way to a wide disc.
_ALLOWED = (8e-4, 8e-4, 4e-4, 2e-4, 2e-4, 1e-4)
LOST, _SURE = 1e-3, 6e-4
_NEIGHBOUR = 0.3  # share of the greatest weight that nodes next to a state have
_DRAWN, _DISC_LOST = 24, 6e-4  # draws of rays that tell how wide a disc has to be, and the share that it may lose
_INNER = 0.1  # zones count as the axis where what `PupilCircles.wide` grows by is less than this share


@dataclass(frozen=True)
class _Rays:
    """Random rays [N] through points of the stop: inputs of `PupilCircles.checked`, status and zone."""

    inputs: dict[str, Array]
    codes: NDArray[np.int32]
    zone: NDArray[np.intp]

    @property
    def passed(self) -> Truths:
        return np.asarray(self.codes == st.PASSED)

    def at(self, rows: NDArray[np.intp]) -> _Rays:
        """Return some of the rays."""
        return _Rays({name: row[:, rows] for name, row in self.inputs.items()}, self.codes[rows], self.zone[rows])


def fit_pupil(
    lenses: Sequence[ShaderLens], report: Report, between: Sequence[tuple[Array, ShaderLens]] = ()
) -> list[PupilCircles]:
    """Fit the pupil of a lens in each of its states, so that at most 1 in 1000 passing rays of any zone lies outside.

    Args:
        lenses: the lens at each node of its states.
        report: is told what is done.
        between: the lens in states between the nodes, each with their weights; mixtures of the pupils hold its rays
            too.

    Raises:
        InputError: no ray passes.
    """
    images = fit_stop_images(lenses)
    if images is None:
        raise InputError("export", "pupil", "(no ray passes)", "a lens that light can pass")
    if max(_beside(*pair) for pair in zip(lenses, images, strict=True)) <= _FOLDED:
        pupils, lost = _fit_circles(lenses, images, report, between)
        if lost <= LOST:
            return pupils
    return _wide_discs(lenses, between)


def _fit_circles(
    lenses: Sequence[ShaderLens], images: Sequence[StopImage], report: Report,
    between: Sequence[tuple[Array, ShaderLens]],
) -> tuple[list[PupilCircles], float]:  # fmt: skip
    """Fit circles; return them and the share of the rays that they lose in the worst zone."""
    exponents, pairs = _exponents(lenses[0].anamorphic), list(zip(lenses, images, strict=True))
    pupils = [PupilCircles(lens.end_of_light_mm(), image, (1.0, 0.0, 0.0), exponents[:0, :3], np.zeros((0, 3, 0)))
              for lens, image in pairs]  # fmt: skip
    rays = [_drawn(lens, pupil, 0) for lens, pupil in zip(lenses, pupils, strict=True)]
    edges = [_edges(*each) for each in zip(lenses, pupils, rays, strict=True)]
    counts = np.max([np.bincount(e.codes, minlength=_CODES) for e in edges], axis=0)
    counts[: st.NO_SOLUTION + 1] = counts[st.blocked(lenses[0].stop_surface, st.RIM)] = 0
    rims = np.flatnonzero(counts > _RARE)
    lit = [r.at(np.flatnonzero(r.passed)[:_EDGES]) for r in rays]
    fits = [_fit_rims(edges, lit, pupils, exponents, int(code)) for code in rims]
    for k, (pupil, drawn) in enumerate(zip(pupils, rays, strict=True)):
        numbers = np.array([fit[k] for fit in fits]).reshape(len(rims), len(exponents) + 1)
        pupils[k] = _with_circles(replace(pupil, wide=_disc(pupil, drawn, len(rims))), exponents, numbers)
        report((k + 1) / (len(pupils) + 1))
    pupils, lost = _widened(pupils, lenses, between)
    if lenses[0].anamorphic and len(rims):
        squeezed = [[replace(p, squeeze=s) for p in pupils] for s in _SQUEEZES]
        pupils = max(squeezed, key=lambda states: passing_share(lenses[0], states[0], (1.0,))[1.0])
    return pupils, lost


def _widened(
    pupils: list[PupilCircles], lenses: Sequence[ShaderLens], between: Sequence[tuple[Array, ShaderLens]]
) -> tuple[list[PupilCircles], float]:
    """Widen circles as much as new random rays need; return them and the share of other new rays that they lose."""
    states = [*zip(np.eye(len(pupils)), lenses, strict=True), *between]
    lost = np.ones(len(states))
    for seed, allowed in enumerate((*_ALLOWED, 0.0)):
        for k in np.flatnonzero(lost > _SURE):
            weights, lens = states[k]
            mixed = pupils[0].mixed(pupils[1:], weights)
            rays = _drawn(lens, mixed, 1 + seed)
            within = evaluate(mixed.checked, rays.inputs)["within"]
            lost[k] = _lost(rays, within) if seed > 1 else 1.0
            if allowed and lost[k] > _SURE:
                needs = [[n for _, n in _needs(rays, margin, allowed / len(within))] for margin in within[1:]]
                more = np.array([max([0.0, *need]) for need in needs])
                near = weights > _NEIGHBOUR * weights.max()  # the nodes on both sides of a state between them
                more /= weights[near].sum()
                wide = _disc(mixed, rays, len(more))
                pupils = [_wider(p, more, wide) if w else p for p, w in zip(pupils, near, strict=True)]
                # what widens a node loses rays in states that subtract that node
                for other, (mix, _) in enumerate(states):
                    lost[other] = 1.0 if (mix[near] < 0).any() else lost[other]
    return pupils, float(lost.max())


def _wider(pupil: PupilCircles, more: Array, wide: tuple[float, float, float]) -> PupilCircles:
    numbers, (first, second, _) = pupil.numbers.copy(), pupil.wide
    numbers[:, 0, (pupil.exponents == 0).all(1)] += more[:, None]
    return replace(pupil, numbers=numbers, wide=(max(first, wide[0]), max(second, wide[1]), 0.0))


def _edges(lens: ShaderLens, pupil: PupilCircles, rays: _Rays) -> _Rays:
    """Find rays that rims all but stop, each with the code of its rim.

    They lie between a ray that a rim stops and the point of one that passes, from about the same film point, by
    halving.
    """
    inputs, size = rays.inputs, rays.inputs["stop_radius_mm"][0]
    place = inputs["film_mm"][0] ** 2 + inputs["film_mm"][1] ** 2 / 3
    blocked = np.flatnonzero(~rays.passed & (np.hypot(*inputs["point_mm"]) < size))[:_EDGES]
    lit = np.flatnonzero(rays.passed)
    lit = lit[np.argsort(place[lit])]
    near = lit[np.searchsorted(place[lit], place[blocked]).clip(max=lit.size - 1)] if lit.size else lit
    edges = rays.at(blocked[: near.size])
    inside, outside, codes = inputs["point_mm"][:, near], edges.inputs["point_mm"], edges.codes
    sound = passed = _codes(lens, pupil, edges, inside) == st.PASSED
    for _ in range(_HALVINGS):
        point = (inside + outside) / 2
        found = _codes(lens, pupil, edges, point)
        passed = found == st.PASSED
        inside, outside = np.where(passed, point, inside), np.where(passed, outside, point)
        codes = np.where(passed, codes, found)
    edges = replace(edges, inputs=edges.inputs | {"point_mm": (inside + outside) / 2}, codes=codes)
    return edges.at(np.flatnonzero(sound))


def _codes(lens: ShaderLens, pupil: PupilCircles, rays: _Rays, point: Array) -> NDArray[np.int32]:
    """Return the status [N] of the rays through other points of the widest stop."""
    film, z, nm = (rays.inputs[name] for name in ("film_mm", "film_z_mm", "wavelength_nm"))
    through = replace(lens, graph=pupil.image.through_stop(lens.graph))
    return through.status(film, point, nm[0], z[0], lens.stop_radius_mm)


def _fit_rims(
    edges: Sequence[_Rays], lit: Sequence[_Rays], pupils: Sequence[PupilCircles], exponents: Exponents, code: int
) -> list[Array]:
    """Fit the numbers [M + 1] of a rim's circle in every state, by least squares.

    Where no ray tells otherwise, they stay near the numbers for all states together.

    Args:
        edges: from `_edges`.
        lit: rays that pass.
    """
    rows, on_edge = [], []
    for at_rims, inside, pupil in zip(edges, lit, pupils, strict=True):
        parts = (at_rims.at(np.flatnonzero(at_rims.codes == code)), inside)
        features = [_features(part, pupil, exponents) for part in parts]
        rows.append(np.concatenate(features, 1))
        on_edge.append(np.repeat([1.0, 0.0], [f.shape[1] for f in features]))
    together = _least(np.concatenate(rows, 1), np.concatenate(on_edge), np.zeros(len(exponents)))
    return [np.append(_least(*row, together), 1.0) for row in zip(rows, on_edge, strict=True)]


def _least(features: Array, on_edge: Array, near: Array) -> Array:
    """Find numbers [M] for which a margin, with 1 as the last number, is nearly 0 on the edge.

    On the edge the margin is rather above 0 than below, and for rays inside it must not be below 0. The numbers stay
    near given ones. `on_edge` [N] is 1 or 0.
    """
    size = np.sqrt(np.square(features).mean(1))
    matrix, numbers, weight = features[:-1] / size[:-1, None], near, on_edge
    lacks = -features[-1] - near @ features[:-1]
    calm = np.eye(len(matrix)) * (_CALM + _RIDGE * len(weight))
    for _ in range(_ROUNDS):
        numbers = near + np.linalg.solve((matrix * weight) @ matrix.T + calm, matrix @ (weight * lacks)) / size[:-1]
        weight = np.where(numbers @ features[:-1] + features[-1] < 0, _HEAVIER, on_edge)
    return numbers


def _with_circles(pupil: PupilCircles, exponents: Exponents, numbers: Array) -> PupilCircles:
    """Return the pupil with circles of these numbers [K, M + 1]."""
    monomials = np.unique(exponents[:, :3], axis=0)
    rows = np.zeros((len(numbers), 3, len(monomials)))
    for powers, values in zip(exponents, (numbers[:, :-1] / numbers[:, -1:]).T, strict=True):
        kind = int(powers[3] + 2 * powers[4])
        rows[:, kind, (monomials == powers[:3]).all(1)] = values[:, None] / (2 if kind else 1)
    return replace(pupil, exponents=monomials, numbers=rows)


def _exponents(anamorphic: bool) -> Exponents:
    """Return exponents [M, 5] of film x, y, film position, stop x, y: even under mirrors, linear in the stop point."""
    terms, degree = [], _DEGREE[anamorphic]
    for i in range(degree + 1):
        for j in range(degree + 1 if anamorphic else 1):
            for u, v in ((0, 0), (1, 0), (0, 1)):
                if i + j <= degree and (i + u) % 2 == 0 and (j + v) % 2 == 0:
                    terms += [(i, j, k, u, v) for k in range(3) if k == 0 or i + j + u + v <= _MOVING[k - 1]]
    return np.array(terms, np.int64)


def _drawn(lens: ShaderLens, pupil: PupilCircles, seed: int) -> _Rays:
    """Draw random rays through points of all stops, and a little beyond."""
    rng, count = np.random.default_rng(seed), _RAYS * (_ALL if lens.anamorphic else _ALL // _ZONES[1])
    radius = pupil.film_radius_mm * 0.9999 * rng.random(count) ** 0.5
    angle = 2 * np.pi * rng.random(count) if lens.anamorphic else np.zeros(count)
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    z, nm = (rng.uniform(*span, count) for span in (lens.film_z_mm, lens.wavelength_nm))
    share = rng.choice(_STOPS, count)
    size, turn = _AROUND * share * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    point = size * lens.stop_radius_mm * np.stack([np.cos(turn), np.sin(turn)])
    through = replace(lens, graph=pupil.image.through_stop(lens.graph))
    codes = through.status(film, point, nm, z, share * lens.stop_radius_mm)
    inputs = {"film_mm": film, "point_mm": point, "film_z_mm": z[None]}
    inputs["wavelength_nm"], inputs["stop_radius_mm"] = nm[None], share[None] * lens.stop_radius_mm
    aside = np.abs(np.arctan2(np.abs(film[1]), np.abs(film[0]))) / (np.pi / 2)
    shares = (radius / pupil.film_radius_mm) ** 2, aside, share * 0.7501  # the widest stop is a zone of its own
    zones = [np.minimum(s * n, n - 1).astype(np.intp) for s, n in zip(shares, _ZONES, strict=True)]
    return _Rays(inputs, codes, np.ravel_multi_index(zones, _ZONES))


def _disc(pupil: PupilCircles, rays: _Rays, rims: int) -> tuple[float, float, float]:
    """Return `PupilCircles.wide`; an image errs most where the film ends."""
    size = rays.inputs["stop_radius_mm"][0] / pupil.image.stop_mm
    beyond = np.hypot(*rays.inputs["point_mm"]) / pupil.image.stop_mm / size - 1
    growth = (np.square(rays.inputs["film_mm"]).sum(0) / pupil.image.film_mm**2 * size) ** 2
    needs = [(float(growth[zone].mean()), need) for zone, need in _needs(rays, -beyond, _ALLOWED[0] / (rims + 1))]
    inner = max(0.0, *(need for at, need in needs if at < _INNER))
    return 1 + inner, max(0.0, *((need - inner) / at for at, need in needs if at >= _INNER)), 0.0


def _needs(rays: _Rays, within: Array, share: float) -> list[tuple[NDArray[np.intp], float]]:
    """Return, by zone, the rays that pass, and the margin that circles lack to lose at most this share of them."""
    passed = np.flatnonzero(rays.passed)
    zones = rays.zone[passed]
    ends = np.searchsorted(zones, np.arange(_ALL + 1), sorter=(order := np.argsort(zones, kind="stable")))
    needs = []
    for rows in (passed[order[low:high]] for low, high in pairwise(ends)):
        margin, spare = within[rows], round(share * max(rows.size, _FEW))
        if margin.size > spare:
            needs.append((rows, -float(np.partition(margin, spare)[spare])))
    return needs


def _features(rays: _Rays, pupil: PupilCircles, exponents: Exponents) -> Array:
    """Return [M + 1, N], in which a circle's margin is linear."""
    inputs, image = rays.inputs, pupil.image
    point = inputs["point_mm"] / image.stop_mm
    position = (inputs["film_z_mm"] - image.film_z_mm[0]) / image.film_z_mm[1]
    variables = np.concatenate([inputs["film_mm"] / image.film_mm, position, point])
    features = np.ones((len(exponents) + 1, point.shape[1]))
    for feature, powers in zip(features, exponents, strict=False):
        for value, power in zip(variables, powers, strict=True):
            if power:
                feature *= value**power
    features[-1] = -np.sum(point**2, axis=0)
    return features


def _lost(rays: _Rays, within: Array) -> float:
    """Return the largest share, over zones, of passing rays that lie outside."""
    passed, missed = _missed(rays, within)
    return float((missed / np.maximum(passed, _FEW)).max())


def _missed(rays: _Rays, within: Array) -> Array:
    """Return two counts by zone [2, zones]: rays that pass, and those of them that lie outside."""
    out = rays.passed & (within < 0).any(0)
    return np.stack([np.bincount(rays.zone[rows], minlength=_ALL) for rows in (rays.passed, out)])


def light_lost(lens: ShaderLens, pupil: PupilCircles) -> float:
    """Return the largest share, over zones of film and stop, of passing new rays that no sample reaches."""
    if pupil.wide[2]:
        return max(float(np.mean(rows > pupil.wide[2])) for rows in _beyond_discs(lens, pupil, 100))
    counts = np.zeros((2, _ALL))
    for seed in range(4):
        rays = _drawn(lens, pupil, 100 + seed)
        counts += _missed(rays, evaluate(pupil.checked, rays.inputs)["within"])
    return float((counts[1] / np.maximum(counts[0], _FEW)).max())


def _beside(lens: ShaderLens, image: StopImage) -> float:
    """Return the share of passing rays far from the image of their point of the stop, in the worst part of the film.

    Where an image folds, two pupil points show one point of the stop.
    """
    rays = draw_rays(lens, None, 5)
    inputs = {
        "film_mm": rays.film_mm,
        "point_mm": rays.point_mm,
        "film_z_mm": rays.film_z_mm[None],
        "wavelength_nm": rays.wavelength_nm[None],
    }
    away = np.hypot(*(evaluate(image.graph, inputs)["pupil_mm"] - rays.pupil_mm)) > _BESIDE * rays.pupil_mm.std()
    part = (np.square(rays.film_mm).sum(0) / lens.film_radius_mm**2 * _ZONES[0]).astype(np.intp)
    return float((np.bincount(part, away) / np.maximum(np.bincount(part), _FEW)).max())


def _wide_discs(lenses: Sequence[ShaderLens], between: Sequence[tuple[Array, ShaderLens]] = ()) -> list[PupilCircles]:
    """Return one wide disc for each state; arguments are those of `fit_pupil`."""
    images = fit_stop_images(lenses, folded=True)
    if images is None:
        raise InputError("export", "pupil", "(hardly a ray passes)", "a lens that light can pass")
    nothing = np.zeros((0, 3), np.int64), np.zeros((0, 3, 0))
    pupils = [
        PupilCircles(lens.end_of_light_mm(), image, (1.0, 0.0, 1.0), *nothing)
        for lens, image in zip(lenses, images, strict=True)
    ]
    states = [*zip(np.eye(len(pupils)), lenses, strict=True), *between]
    rows = [r for weights, lens in states for r in _beyond_discs(lens, pupils[0].mixed(pupils[1:], weights), 6)]
    more = max(float(np.quantile(r, 1 - _DISC_LOST)) for r in rows)
    return [replace(p, wide=(1.0, 0.0, more)) for p in pupils]


def _beyond_discs(lens: ShaderLens, pupil: PupilCircles, seed: int) -> list[Array]:
    """Return how far passing random rays lie beyond the image of the smallest stop that they pass.

    The unit is `StopImage.stop_mm`; there is one array for each zone of the film and that stop with enough rays.
    """
    beyond, zones = [], []
    for k in range(_DRAWN):
        rays = draw_rays(lens, None, seed + k)
        inputs = {
            "film_mm": rays.film_mm,
            "point_mm": 0 * rays.point_mm,
            "film_z_mm": rays.film_z_mm[None],
            "wavelength_nm": rays.wavelength_nm[None],
        }
        middle, by_x, by_y = evaluate(pupil.image.graph, inputs).values()
        way, area = rays.pupil_mm - middle, by_x[0] * by_y[1] - by_x[1] * by_y[0]
        x, y = (way[0] * by_y[1] - way[1] * by_y[0]) / area, (by_x[0] * way[1] - by_x[1] * way[0]) / area
        size = np.hypot(*rays.point_mm)
        beyond.append((np.hypot(x, y) - size) / pupil.image.stop_mm)
        part = np.square(rays.film_mm).sum(0) / lens.film_radius_mm**2 * 8
        zones.append(part.astype(np.intp) * 3 + np.digitize(size / lens.stop_radius_mm, (0.3, 0.6)))
    lacks, zone = np.concatenate(beyond), np.concatenate(zones)
    return [lacks[zone == z] for z in np.flatnonzero(np.bincount(zone) >= _FEW)]
