"""Fits the arcs of `pupil_arcs` to what passes a lens, from nothing but its graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.progress import Report
from neurolens.cameras.arcs_passing import passing
from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_arcs_tune import moved
from neurolens.cameras.pupil_boxes import asking, end_of_light, frame_of
from neurolens.cameras.pupil_circles import PupilCircles
from neurolens.cameras.pupil_circles_fit import fit_circles
from neurolens.cameras.pupil_fold_fit import folded
from neurolens.cameras.pupil_sight import Sight, Truths, turned
from neurolens.graph.interpret import evaluate

Array = NDArray[np.float64]
# Where light ends is sought: ways, and of anamorphic lenses azimuths of a quadrant.
_ANGLES, _QUADRANT = np.linspace(0, np.pi, 17), np.linspace(0, np.pi / 2, 4)
_HALVINGS, _WIDER = 14, 1.15  # that place the end of the light; boxes of a stop over the last one's pupil
_ROUNDS, _LOOSE = 40, 1e-4  # of asymmetric least squares: weight of slack
_MARGIN = 0.001  # of half the pupil
_RIDGE = 1e-10
_ENOUGH = 0.97  # of points, at the widest stop, that pass
_FEWEST = 12  # vertices that rims of a side block
_PLENTY, _GOAL = 0.96, 0.952  # of points, that no other way to fit needs to pass: by arcs, zone by zone
_REFIT_SEED, _CHECK_SEED, _NO_SIDE = 10, 20, 2  # such rays lie on no arc
_STARTS = 5  # of a fold, by other rays: some end hundredths worse
_LOST = 1e-3  # of rays that pass in any zone, that a way may miss
_HELD = 0.9998  # of random rays that pass
_RISE, _STEP, _STEPS = 1.03, 0.004, 12  # of arcs that do not hold them: in y^2, and of half the pupil along x
# Of the stop's and of rims' ends and two factors: highest power of the film radius, and how many move with the film.
_LEAN = (((4, 3), (4, 2), (2, 0)), ((3, 2), (2, 1), (1, 0)))
_RAYS = 60_000  # random ones that must lie inside, of an anamorphic lens three times as many


@dataclass(frozen=True)
class Way:
    """How arcs are fitted.

    Attributes:
        rows: film radii, and stops: as shares of the widest, where the end of the light is sought.
        powers: of the film radius. film: how many of the film radius and the stop move with the film's position.
        push: weight of what lies outside. refits: fits again to random rays that are missed: arcs that are moved as a
            whole until they hold those are wide everywhere for the sake of one place. lean: see `_LEAN`.
    """

    rows: int
    stops: tuple[float, ...]
    powers: int
    film: tuple[int, int]
    push: float
    refits: int
    lean: bool = False

    def exponents(self, anamorphic: bool) -> NDArray[np.int64]:
        """Of film radius, stop, film position, wavelength and azimuth, see `PupilArcs`."""
        found = [(i, j, 0, 0, 0) for i in range(self.powers + 1) for j in range(3)]
        found += [(i, j, 1, 0, 0) for i, j in np.ndindex(*self.film)]  # few: renderers may learn the focus late
        found += [(i, j, 0, 1, 0) for i in range(4) for j in range(2)]  # the stop's image moves with the wavelength
        if anamorphic:
            found += [(i, 0, 0, 0, k) for k in (1, 2) for i in range(k, self.powers + 1)]
        return np.array(found)


# In turn until enough passes: the best is kept.
_WAYS = (
    Way(17, (1.0, 0.75, 0.5, 0.25, 0.1), 4, (3, 2), 300.0, 0, True),
    Way(25, (1.0, 0.85, 0.7, 0.55, 0.4, 0.28, 0.18, 0.08), 4, (3, 2), 3000.0, 3),
    Way(25, (1.0, 0.85, 0.7, 0.55, 0.4, 0.28, 0.18, 0.08), 4, (5, 3), 3000.0, 3),
)


@dataclass(frozen=True)
class _Places:
    """Ways [N] from the middle of a pupil (centre, 0) to (centre + x, y) beyond it, at `angle` from the film point's
    side; film radius, film position, stop, wavelength and azimuth."""

    film_mm: Array
    centre: Array
    x: Array
    y: Array
    film_z: Array
    stop: Array
    nm: Array
    angle: Array
    azimuth: Array


@dataclass(frozen=True)
class _Edge:
    """Vertices [N] of outlines: place in the frame of the film point, radius, stop and film position scaled to 1.

    `side`: 0 where the stop blocks, 1 and -1 rims on the film point's side and on the other; of rays within, none.
    `first`, `last`: the ends of every outline.
    """

    x: Array
    y: Array
    scaled: Array
    side: NDArray[np.int64]
    first: Truths
    last: Truths


def fit_arcs(
    sights: Sequence[Sight], report: Report, between: Sequence[tuple[Array, Sight]] = ()
) -> list[PupilArcs | PupilCircles]:
    """The pupil of a lens, in each of its states, by arcs or, of one state that these do not fit, by circles: all but
    the fewest rays found to pass lie inside.

    Args:
        sights: the lens at each node of its state; one of a lens without. between: weights of these nodes and the lens
            there: their mixture holds its rays, too.

    Raises:
        InputError: no ray passes.
    """
    if len(sights) > 1:
        return _of_states(sights, report, between)
    sight, kept, best, lost = sights[0], list[PupilArcs | PupilCircles](), -1.0, 1.0
    if not sight.anamorphic:
        (begun,), half = _begun(_WAYS[0], sights, report)
        (arcs,), lost = moved([begun], half, sights, report)
        if lost <= _LOST and min(passing(sight, arcs).values()) >= _GOAL:
            return [arcs]
        lost = 1.0
    if (made := fit_circles(sight, report)) is not None:
        kept, best, lost = [made[0]], min(passing(sight, made[0]).values()), made[1]
        if sight.anamorphic or (best >= _GOAL and lost <= _LOST):  # arcs of anamorphic lenses are wide
            return kept
    elif not sight.anamorphic and 1 in begun.sides:
        start = folded(begun, sight)
        for seed in range(_STARTS):
            (arcs,), beyond = moved([start], half, sights, report, seed=seed)
            share = min(passing(sight, arcs).values())
            if beyond <= _LOST and share > best:
                kept, lost, best = [arcs], beyond, share
            if best >= _GOAL:
                return kept
    for part, way in enumerate(_WAYS):
        arcs, beyond = _by(way, sight, partial(_within, report, part / len(_WAYS), 1 / len(_WAYS)))
        least = min(passing(sight, arcs).values())
        if beyond <= _LOST < lost or (least > best and beyond <= max(lost, _LOST)):
            kept, best, lost = [arcs], least, beyond
        if best >= _PLENTY:
            break
    return kept


def _of_states(
    sights: Sequence[Sight], report: Report, between: Sequence[tuple[Array, Sight]]
) -> list[PupilArcs | PupilCircles]:
    """Of a lens in several states: refitted by themselves, nodes hold less of what lies between them, moved as much."""
    begun, half = _begun(_WAYS[0], sights, partial(_within, report, 0.0, 0.2))
    seen = [*zip(np.eye(len(begun)), sights, strict=True), *between]
    wide = _widened(begun, seen, partial(_within, report, 0.2, 0.1))
    if min(passing(*of_one, (1.0,))[1.0] for of_one in zip(sights, wide, strict=True)) >= _GOAL:
        return list(wide)
    arcs, lost = moved(begun, half, sights, partial(_within, report, 0.3, 0.7), between)
    return list(arcs if lost <= _LOST else wide)


def _by(way: Way, sight: Sight, report: Report) -> tuple[PupilArcs, float]:
    """Arcs with numbers, and `_lost`."""
    nodes, _ = _begun(way, [sight], partial(_within, report, 0.0, 0.6))
    (arcs,) = _widened(nodes, [(np.ones(1), sight)], partial(_within, report, 0.6, 0.4))
    return arcs, _lost(sight, arcs)


def _begun(way: Way, sights: Sequence[Sight], report: Report) -> tuple[list[PupilArcs], float]:
    """Arcs through the ends of the light, and half the width of the pupil (mm)."""
    parts = [partial(_within, report, k / len(sights), 1 / len(sights)) for k in range(len(sights))]
    places = [_places(way, *of_one) for of_one in zip(sights, parts, strict=True)]
    nodes = _empty(way, sights, places)
    edges = [_edge(*of_one) for of_one in zip(sights, nodes, places, strict=True)]
    blocked = {side: max(int((edge.side == side).sum()) for edge in edges) for side in (0, 1, -1)}
    if blocked[0] < _FEWEST:
        raise InputError("export", "stop", "(blocks nothing)", "a lens whose stop blocks light")
    sides = tuple(side for side, vertices in blocked.items() if vertices >= _FEWEST)
    return _fitted(way, sights, nodes, edges, sides), float(np.ptp(edges[0].x)) / 2


def _lost(sight: Sight, arcs: PupilArcs) -> float:
    """Share of random rays that pass beyond the arcs."""
    return float(_beyond(sight, arcs, _CHECK_SEED)[-1].mean())


def _fitted(
    way: Way, sights: Sequence[Sight], nodes: list[PupilArcs], edges: Sequence[_Edge], sides: tuple[int, ...]
) -> list[PupilArcs]:
    """Arcs with numbers."""
    for coloured in (True,) if sights[0].anamorphic else (False, True):
        held = edges
        for seed in range(way.refits + 1):
            if seed:
                held = [_with_missed(*of_one, seed) for of_one in zip(sights, nodes, held, strict=True)]
            nodes = [
                replace(a, sides=sides, numbers=_arcs(a, edge, sides, coloured, way))
                for a, edge in zip(nodes, held, strict=True)
            ]
        # Rims that move with the wavelength, as those of fisheyes do, cost time in a shader: only where it pays.
        if min(passing(sight, a)[1.0] for sight, a in zip(sights, nodes, strict=True)) >= _ENOUGH:
            break
    return nodes


def _empty(way: Way, sights: Sequence[Sight], places: Sequence[_Places]) -> list[PupilArcs]:
    """What numbers of arcs are scaled by."""
    exponents = way.exponents(sights[0].anamorphic)
    long, short = ((1000 / w) ** 2 for w in reversed(sights[0].wavelength_nm))
    wave = (long + short) / 2, max((short - long) / 2, 1e-9)
    radii = [float(p.film_mm.max()) for p in places]
    unit, stop, nothing = max(radii), max(s.stop_radius_mm for s in sights), np.zeros((0, 4, len(exponents)))
    found = []
    for radius, sight in zip(radii, sights, strict=True):
        low, high = sight.film_z_mm
        radius = min(radius, sight.film_radius_mm)
        place = (low + high) / 2, max((high - low) / 2, 1e-6)
        found.append(PupilArcs(radius, unit, place, stop, wave, nothing, exponents, ()))
    return found


def _within(report: Report, begun: float, part: float, share: float) -> None:
    report(begun + part * share)


def _places(way: Way, sight: Sight, report: Report) -> _Places:
    """Where light ends, is sought: all over the film, at its ends and in its middle, from the widest stop down.

    Raises:
        InputError: no ray passes.
    """
    low, high = sight.film_z_mm
    ends = sight.wavelength_nm
    found: list[list[Array]] = []
    planes = (low, (low + high) / 2, high) if high > low else (low,)
    azimuths = _QUADRANT if sight.anamorphic else [0.0]
    for k, (z, azimuth) in enumerate(product(planes, azimuths)):
        report(k / len(planes) / len(azimuths))
        table, film_radius = sight.table, None
        for stop in np.array(way.stops) * sight.stop_radius_mm:
            ask = asking(partial(sight.passes, film_z=z, stop=stop, azimuth=azimuth), ends)
            film_radius = end_of_light(table, ask) if film_radius is None else film_radius
            if film_radius is None:
                break
            radius = film_radius * (1 - 1e-6) * (1 - (1 - np.arange(way.rows) / (way.rows - 1)) ** 2)
            frame = frame_of(table, radius, ask)
            across = (frame.reach[:, None] * v[:, None] for v in frame.stretch)
            x, y = (way * side for way, side in zip(across, (np.cos(_ANGLES), np.sin(_ANGLES)), strict=True))
            shape = (len(ends), *x.shape)
            lengths = np.reshape(ends, (-1, 1, 1))
            rows = radius[:, None], frame.centre[:, None], x, y, z, stop, lengths, _ANGLES, azimuth
            found.append([np.broadcast_to(row, shape).ravel() for row in rows])
            # The next stop's pupil lies within this one's.
            around = frame.centre - _WIDER * frame.stretch[0], frame.centre + _WIDER * frame.stretch[0]
            even = np.linspace(0, film_radius, way.rows)
            boxes = [np.interp(even, radius, row) for row in (*around, _WIDER * frame.stretch[1])]
            table = replace(table, film_radius_mm=film_radius, rows=np.array(boxes, np.float32))
    if not found:
        raise InputError("export", "pupil", "(no ray passes)", "a lens that light can pass")
    return _Places(*(np.concatenate(row) for row in zip(*found, strict=True)))


def _edge(sight: Sight, arcs: PupilArcs, p: _Places) -> _Edge:
    """Where light ends on the way from a centre, and what blocks the rays beyond."""

    film, call = np.stack([p.film_mm, 0 * p.film_mm]), (p.nm, p.film_z, p.stop, p.azimuth)

    def passes(t: Array) -> Truths:
        return sight.passes(film, np.stack([p.centre + t * p.x, t * p.y]), *call)

    low, high = np.zeros(p.x.size), np.ones(p.x.size)
    lit = passes(low)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        inside = passes(middle)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    x, y, first, last = p.centre + low * p.x, low * p.y, p.angle == 0, p.angle == np.pi
    blocked = sight.sides(film, np.stack([p.centre + high * p.x, high * p.y]), *call)
    of_stop = (blocked == st.blocked(sight.stop_surface, st.RIM)).all(0)  # of an anamorphic lens also mirrored
    side = np.where(of_stop, 0, np.where(p.x > 0, 1, -1))
    scaled = arcs.scaled(p.film_mm, p.stop, p.film_z, p.nm, p.azimuth)
    return _Edge(x[lit], y[lit], scaled[:, lit], side[lit], first[lit], last[lit])


def _with_missed(sight: Sight, arcs: PupilArcs, edge: _Edge, seed: int) -> _Edge:
    """With random rays that pass beyond the arcs as vertices that they must hold."""
    rays, stop, left, right, out = _beyond(sight, arcs, _REFIT_SEED + seed)
    missed = *rays["pupil_mm"], _scaled(arcs, rays, stop), np.full(out.size, _NO_SIDE), right, left
    return _Edge(*(np.concatenate([a, b[..., out]], -1) for a, b in zip(astuple(edge), missed, strict=True)))


def _scaled(arcs: PupilArcs, rays: dict[str, Array], stop: Array) -> Array:
    """`PupilArcs.scaled` of rays of `_random`."""
    azimuth = np.arccos(rays["twice"][0]) / 2
    return arcs.scaled(rays["film_mm"][0], stop, rays["film_z_mm"][0], rays["wavelength_nm"][0], azimuth)


def _beyond(sight: Sight, arcs: PupilArcs, seed: int) -> tuple[dict[str, Array], Array, Truths, Truths, Truths]:
    """Rays and stops of `_random`, and which of them lie beyond a low end, a high end, any arc."""
    rays, stop = _random(sight, arcs, seed)
    found = evaluate(arcs.checked, rays)
    left, right = ((found[name] < 0).any(0) for name in ("left", "right"))
    return rays, stop, left, right, left | right | (found["height"] < rays["pupil_mm"][1] ** 2).any(0)


def _arcs(arcs: PupilArcs, edge: _Edge, sides: Sequence[int], coloured: bool, way: Way) -> Array:
    """[A, 4, M]: the numbers of arcs of these sides; `coloured`: whether rims move with the wavelength."""
    monomials = np.prod(edge.scaled[:, None] ** arcs.exponents.T[:, :, None], axis=0)  # [M, N]
    still = arcs.exponents[:, [1] if coloured else [1, 3]].sum(1) == 0  # rims do not move with the stop
    return np.stack([_arc(arcs, edge, monomials * still[:, None] if side else monomials, side, way) for side in sides])


def _arc(arcs: PupilArcs, edge: _Edge, monomials: Array, side: int, way: Way) -> Array:
    """[4, M]: the numbers of an arc."""
    own, push, (radius, _, film, wave, _) = edge.side == side, way.push, arcs.exponents.T
    kept = [(radius <= most) & ((film == 0) | (radius < moving)) | (not way.lean) for most, moving in _LEAN[side != 0]]
    ends, first, change = (monomials * rows[:, None] for rows in kept)
    size = np.maximum(edge.scaled[1], 0.05)
    numbers, high, low = np.zeros((4, len(monomials))), edge.first, edge.last
    margin = _MARGIN * float(np.ptp(edge.x)) / 2 * _unit(arcs, side == 0)
    both = np.ones_like(edge.x)
    if side <= 0:
        numbers[0] = -_above(ends[:, low], -edge.x[low], own[low], size[low], push) - margin
        both *= (away := np.maximum(edge.x - numbers[0] @ monomials, 1e-6))
    if side >= 0:
        numbers[1] = _above(ends[:, high], edge.x[high], own[high], size[high], push) + margin
        both *= (right := np.maximum(numbers[1] @ monomials - edge.x, 1e-6))
        away = right if side else away
    white = both * (wave == 0)[:, None]
    factors = _above(np.concatenate([first * white, change * white * away]), edge.y**2, own, size**2, push)
    numbers[2:] = factors.reshape(2, -1)
    return numbers


def _unit(arcs: PupilArcs, of_stop: bool) -> Array:
    """A margin that grows with the stop, for its own arc."""
    return np.all(arcs.exponents == (0, int(of_stop), 0, 0, 0), axis=1).astype(np.float64)


def _above(rows: Array, wanted: Array, own: Truths, size: Array, push: float) -> Array:
    """Weights [M] of rows [M, N] whose sum comes near `wanted` where `own`, and lies above it elsewhere."""
    used = rows.any(1)
    a, b = (rows[used] / size).T, wanted / size
    scale = np.maximum(np.sqrt((a**2).mean(0)), 1e-30)
    a = a / scale
    weight = plain = np.where(own, 1.0, _LOOSE)
    found, products = np.zeros(a.shape[1]), (a * weight[:, None]).T @ a + _RIDGE * len(a) * np.eye(a.shape[1])
    for _ in range(_ROUNDS):
        found = np.linalg.solve(products, (weight * b) @ a)
        last, weight = weight, np.where(a @ found < b, push, plain)
        changed = np.flatnonzero(weight != last)
        if not changed.size:
            break
        part = a[changed]  # few
        products += (part * (weight - last)[changed, None]).T @ part
    out = np.zeros(len(rows))
    out[used] = found / scale
    return out


def _random(sight: Sight, arcs: PupilArcs, seed: int) -> tuple[dict[str, Array], Array]:
    """Random rays that pass, from film points on +x, as inputs of `PupilArcs.checked`, and stops."""
    rng, count = np.random.default_rng(seed), _RAYS * (1 + 2 * sight.anamorphic)
    radius = arcs.film_radius_mm * rng.random(count) ** (0.75 if sight.anamorphic else 0.5) * 0.9999
    stop = sight.stop_radius_mm * rng.choice(np.linspace(0.08, 1, 12), count)
    film_z, nm = (rng.uniform(*span, count) for span in (sight.film_z_mm, sight.wavelength_nm))
    radii = np.linspace(0, sight.table.film_radius_mm, sight.table.rows.shape[1])
    low, high, half = (np.interp(radius, radii, a) for a in sight.table.rows)
    # Narrow stops are seldom met by rays all over the table: most of them go to the middle of the arcs.
    pupil = np.stack([low + (high - low) * rng.random(count), half * rng.random(count)])
    given = {"square": rng.random((2, count)), "stop_radius_mm": stop[None]}
    azimuth = np.zeros(count)
    if sight.anamorphic:
        azimuth, pupil[1] = np.pi / 2 * rng.random(count), pupil[1] * rng.choice([-1.0, 1.0], count)
    place: Array = turned(np.stack([radius, 0 * radius]), azimuth).astype(np.float64)
    given |= {"film_mm": place, "film_z_mm": film_z[None], "wavelength_nm": nm[None]}
    near = turned(evaluate(arcs.graph, given)["pupil_mm"], -azimuth)
    middle = turned(evaluate(arcs.graph, given | {"square": np.full((2, count), 0.5)})["pupil_mm"], -azimuth)
    pupil = np.where(rng.random(count) < 0.7, middle + 1.25 * (near - middle), pupil)
    passed = sight.status(place, turned(pupil, azimuth), nm, film_z, stop) == st.PASSED
    given |= {"film_mm": np.stack([radius, 0 * radius]), "pupil_mm": pupil, "twice": np.cos(2 * azimuth)[None]}
    return {name: rows[:, passed] for name, rows in given.items()}, stop[passed]


def _widened(nodes: list[PupilArcs], seen: Sequence[tuple[Array, Sight]], report: Report) -> list[PupilArcs]:
    """The arcs, wide enough for random rays of the lens seen in states of these weights of nodes."""
    numbers = np.stack([a.numbers for a in nodes])
    for seed, (k, (weights, sight)) in product(range(2), enumerate(seen)):
        report((seed + k / len(seen)) / 2)
        own = weights == 1 if weights.max() == 1 else weights < np.inf  # between nodes, all are widened
        mixed = nodes[0].mixed(nodes[1:], weights)
        arcs = replace(mixed, numbers=np.tensordot(weights, numbers, 1))
        rays, stop = _random(sight, arcs, seed)
        found, step = evaluate(arcs.checked, rays), _STEP * float(np.abs(rays["pupil_mm"][1]).max())
        for end, name in enumerate(("left", "right")):
            for arc, row in enumerate(found[name]):
                lack = -row / (1.0 if arc else stop / arcs.stop_radius_mm)
                push = max(np.quantile(lack, _HELD), 0.0)
                numbers[own, arc] += push * _longer(arcs, arc, end, found["change"][arc])
        for _ in range(_STEPS):
            height = evaluate(replace(mixed, numbers=np.tensordot(weights, numbers, 1)).checked, rays)["height"]
            ratio = np.quantile(rays["pupil_mm"][1] ** 2 / np.maximum(height, 1e-9), _HELD, axis=1)
            if ratio.max() <= _RISE:
                break
            # Near the ends of an arc no factor helps: it is made longer.
            for arc, end in product(np.flatnonzero(ratio > _RISE).tolist(), (0, 1)):
                if arcs.sides[arc] != 1 - 2 * end:
                    numbers[own, arc] += step * _longer(arcs, arc, end, found["change"][arc])
        numbers[own, :, 2:] *= ratio.clip(1.0, _RISE)[:, None, None]
    return [replace(a, numbers=own) for a, own in zip(nodes, numbers, strict=True)]


def _longer(arcs: PupilArcs, arc: int, end: int, change: Array) -> Array:
    """[4, M] what is added to numbers of an arc for a millimetre more at its low end, 0, or its high end, 1."""
    return np.outer([end - 1, end, _bend(change) if arc else 0.0, 0.0], _unit(arcs, arc == 0))


def _bend(change: Array) -> float:
    """By how much a rim's first factor grows with its length (mm), so that it holds whatever it has held."""
    return 1 + 2 * max(-float(change.min()), 0.0)
