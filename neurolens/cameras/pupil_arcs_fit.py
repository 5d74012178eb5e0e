"""Fits the arcs of `pupil_arcs` to what passes a lens, from nothing but its graph, and measures how much passes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.pupil_arcs import RADIUS, PupilArcs
from neurolens.cameras.pupil_boxes import Passes, PupilTable
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.cameras.pupil_search import Detail, outline_of
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph

Array = NDArray[np.float64]
Truths = NDArray[np.bool_]
Rows = NDArray[np.floating[Any]]
# Searches for the outline: stops as shares of the widest, how closely; powers of film radius, stop and film position.
_STOPS, _DETAIL = (1.0, 0.75, 0.5, 0.25, 0.1), Detail(17, 16, (0.0, 0.5, 1.0), 20, 4, 8)
_POWERS = [(i, j, k, 0) for i in range(RADIUS + 1) for j in range(3) for k in range(2) if j + k <= 2]
_POWERS += [(i, j, 0, 1) for i in range(4) for j in range(2)]  # the stop's image moves with the wavelength
_SLACK = 1.01, 1.03, 1.08, 1.2  # of an outline, at which a ray is asked what blocks it
_ROUNDS, _PUSH, _LOOSE = 40, 30.0, 1e-4  # of asymmetric least squares: weight of what lies outside, and of slack
_MARGIN = 0.003  # of half the pupil
_RIDGE = 1e-10
_AZIMUTHS = 4  # of a quadrant, of anamorphic lenses
_FEWEST = 12  # vertices that rims of a side block
_HELD = 0.9998  # of random rays that pass
_ASKED = 20_000
_RAYS = 60_000  # random ones that must lie inside


@dataclass(frozen=True)
class Sight:
    """A lens whose pupil is sought.

    Attributes:
        graph: of the lens; see `fused.LensGraph`. table: boxes that hold what passes.
        film_z_mm, wavelength_nm: ranges. stop_radius_mm: the widest. stop_surface: for the status of its rays.
        anamorphic: whether it matters on which side of the film a point lies: the arcs then hold what passes of any.
    """

    graph: Graph
    table: PupilTable
    film_z_mm: tuple[float, float]
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    stop_surface: int
    anamorphic: bool = False

    def turned(self, film: Rows, pupil: Rows) -> list[tuple[Rows, Rows]]:
        """Points [2, N] at the azimuths asked about, of a lens symmetric about x and y, pupils mirrored too."""
        if not self.anamorphic:
            return [(film, pupil)]
        found: list[tuple[Rows, Rows]] = []
        for angle in np.linspace(0, np.pi / 2, _AZIMUTHS):
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            found += [(turn @ film, turn @ (pupil * [[1.0], [side]])) for side in (1.0, -1.0)]
        return found

    def status(
        self, film: Rows, pupil: Rows, nanometres: ArrayLike, film_z: ArrayLike, stop: ArrayLike
    ) -> NDArray[Any]:
        """[N] of film points [2, N] and pupil points [2, N]; the others [N], or one number."""
        count = film.shape[1]
        wide = np.broadcast_to(nanometres, (1, count))
        given = {"rays": np.concatenate([film, pupil, wide]).astype(np.float32)}
        given |= {"film_z_mm": _call(film_z), "stop_radius_mm": _call(stop)}
        return np.broadcast_to(evaluate(self._asked, given)["status"][0], count)

    @cached_property
    def _asked(self) -> Graph:
        """The graph of the status alone."""
        return replace(self.graph, outputs={"status": self.graph.outputs["status"]})


@dataclass(frozen=True)
class _Edge:
    """Vertices [N] of outlines: place in the frame of the film point, radius, stop and film position scaled to 1.

    `kind`: 0 where the stop blocks, 1 and 2 rims on the film point's side and on the other. `first`, `last`:
    the ends of every outline.
    """

    x: Array
    y: Array
    scaled: Array
    kind: NDArray[np.int64]
    first: Truths
    last: Truths


def fit_arcs(sight: Sight, report: Callable[[float], object] = lambda share: None) -> PupilArcs:
    """The arcs of a lens: at least every ray found to pass lies inside.

    Raises:
        InputError: no ray passes.
    """
    low, high = sight.film_z_mm
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-6)
    places = (low, middle, high) if high > low else (middle,)
    outlines = []
    for k, (z, share) in enumerate(product(places, _STOPS)):
        report(0.8 * k / len(places) / len(_STOPS))
        stop = share * sight.stop_radius_mm
        found = outline_of(sight.table, _passes(sight, z, stop), sight.wavelength_nm, _DETAIL)
        if found is not None:
            outlines.append((found, z, stop))
    if not outlines:
        raise InputError("export", "pupil", "(no ray passes)", "a lens that light can pass")
    radius = max(o.film_radius_mm for o, _, _ in outlines)
    long, short = ((1000 / w) ** 2 for w in reversed(sight.wavelength_nm))
    wave = (long + short) / 2, max((short - long) / 2, 1e-9)
    arcs = PupilArcs(
        radius,
        (middle, half),
        sight.stop_radius_mm,
        wave,
        np.zeros((3, 4, len(_POWERS))),
        np.array(_POWERS),
        (True,) * 3,
    )
    edge = _edges(sight, arcs, outlines)
    arcs = replace(arcs, used=tuple(bool(n >= _FEWEST) for n in np.bincount(edge.kind, minlength=3)))
    if not arcs.used[0]:
        raise InputError("export", "stop", "(blocks nothing)", "a lens whose stop blocks light")
    for kind in np.flatnonzero(arcs.used):
        arcs.numbers[kind] = _arc(arcs, edge, int(kind))
    return _widened(sight, arcs, report)


def _passes(sight: Sight, film_z: float, stop: float) -> Passes:
    def passes(film: Rows, pupil: Rows, nanometres: float) -> Truths:
        passed = np.zeros(film.shape[1], bool)
        for f, p in sight.turned(film, pupil):
            passed |= sight.status(f, p, nanometres, film_z, stop) == st.PASSED
        return passed

    return passes


def _edges(sight: Sight, arcs: PupilArcs, outlines: list[tuple[PupilOutline, float, float]]) -> _Edge:
    """Vertices of outlines, and what blocks the rays beyond them."""
    parts: list[list[NDArray[Any]]] = []
    for outline, z, stop in outlines:
        shape = outline.x.shape  # wavelengths, rows, vertices
        centre = np.broadcast_to(outline.centre[:, None].astype(np.float64), shape)
        radius = np.broadcast_to(outline.radii(np.arange(shape[1], dtype=np.float64))[:, None], shape)
        nm = np.broadcast_to(np.array(outline.wavelength_nm)[:, None, None], shape)
        first, last = np.zeros(shape, bool), np.zeros(shape, bool)
        first[..., 0] = last[..., -1] = True
        lit = np.broadcast_to(np.ptp(outline.x, axis=-1, keepdims=True) > 0, shape)
        x, y, centre, radius, nm, first, last = (
            a[lit] for a in (outline.x, outline.y, centre, radius, nm, first, last)
        )
        code = np.zeros(x.size)
        for slack in _SLACK:
            found = sight.status(np.stack([radius, 0 * radius]), np.stack([centre + slack * x, slack * y]), nm, z, stop)
            code = np.where(code == 0, found, code)
        kind = np.where(code == st.blocked(sight.stop_surface, st.RIM), 0, np.where(x > 0, 1, 2))
        parts.append([centre + x, y, arcs.scaled(radius, stop, z, nm), kind, first, last])
    return _Edge(*(np.concatenate(p, axis=-1) for p in zip(*parts, strict=True)))


def _arc(arcs: PupilArcs, edge: _Edge, kind: int) -> Array:
    """[4, M]: the numbers of an arc."""
    monomials = np.prod(edge.scaled[:, None] ** arcs.exponents.T[:, :, None], axis=0)  # [M, N]
    if kind:  # rims do not move with the stop, and little with the wavelength
        still = arcs.exponents[:, [1, 3]].sum(1) == 0
        monomials = monomials * still[:, None]
    size = np.maximum(edge.scaled[1], 0.05)
    own = edge.kind == kind
    numbers = np.zeros((4, len(monomials)))
    high, low = edge.first, edge.last
    numbers[1] = _above(monomials[:, high], edge.x[high], own[high], size[high])
    numbers[0] = -_above(monomials[:, low], -edge.x[low], own[low], size[low])
    scale = float(np.ptp(edge.x)) / 2
    if kind == 1:  # the other end is far away
        numbers[0] = 0.0
        numbers[0, 0] = edge.x.min() - 2 * scale
    if kind == 2:
        numbers[1] = 0.0
        numbers[1, 0] = edge.x.max() + 2 * scale
    numbers[0] -= _MARGIN * scale * _unit(arcs, kind)
    numbers[1] += _MARGIN * scale * _unit(arcs, kind)
    left, right = edge.x - numbers[0] @ monomials, numbers[1] @ monomials - edge.x
    both = np.maximum(left, 1e-6) * np.maximum(right, 1e-6)
    white = monomials * (arcs.exponents[:, 3] == 0)[:, None]
    rows = np.concatenate([white * both, white * both * left])
    factors = _above(rows, edge.y**2, own, size**2)
    numbers[2:] = factors.reshape(2, -1)
    return numbers


def _call(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, np.float32).reshape(1, -1)


def _unit(arcs: PupilArcs, kind: int) -> Array:
    """A margin that grows with the stop, for its own arc."""
    return np.all(arcs.exponents == (0, 0 if kind else 1, 0, 0), axis=1).astype(np.float64)


def _above(rows: Array, wanted: Array, own: Truths, size: Array) -> Array:
    """Weights [M] of rows [M, N] whose sum comes near `wanted` where `own`, and lies above it elsewhere."""
    used = rows.any(1)
    a, b = (rows[used] / size).T, wanted / size
    scale = np.maximum(np.sqrt((a**2).mean(0)), 1e-30)
    a = a / scale
    weight = np.where(own, 1.0, _LOOSE)
    found = np.zeros(a.shape[1])
    for _ in range(_ROUNDS):
        heavy = a * weight[:, None]
        found = np.linalg.solve(heavy.T @ a + _RIDGE * len(a) * np.eye(a.shape[1]), heavy.T @ b)
        over = a @ found - b
        weight = np.where(over < 0, _PUSH, np.where(own, 1.0, _LOOSE))
    out = np.zeros(len(rows))
    out[used] = found / scale
    return out


def _random(sight: Sight, arcs: PupilArcs, seed: int) -> tuple[dict[str, Array], Array]:
    """Random rays that pass, from film points on +x, as inputs of `PupilArcs.checked`, and stops."""
    rng = np.random.default_rng(seed)
    count = _RAYS
    radius = arcs.film_radius_mm * np.sqrt(rng.random(count)) * 0.9999
    stop = sight.stop_radius_mm * rng.choice(np.linspace(0.08, 1, 12), count)
    film_z = rng.uniform(*sight.film_z_mm, count)
    nm = rng.uniform(*sight.wavelength_nm, count)
    low, high, half = (
        np.interp(radius, np.linspace(0, sight.table.film_radius_mm, sight.table.rows.shape[1]), a)
        for a in sight.table.rows
    )
    # Narrow stops are seldom met by rays all over the table: half of them go to the middle of the arcs.
    film = np.stack([radius, np.zeros(count)])
    pupil = np.stack([low + (high - low) * rng.random(count), half * rng.random(count)])
    given = {
        "film_mm": film,
        "square": rng.random((2, count)),
        "stop_radius_mm": stop[None],
        "film_z_mm": film_z[None],
        "wavelength_nm": nm[None],
    }
    near = evaluate(arcs.graph, given)["pupil_mm"]
    middle = evaluate(arcs.graph, given | {"square": np.full((2, count), 0.5)})["pupil_mm"]
    pupil = np.where(rng.random(count) < 0.7, middle + 1.25 * (near - middle), pupil)
    places = sight.turned(film, pupil)
    passed = np.any([sight.status(f, p, nm, film_z, stop) == st.PASSED for f, p in places], axis=0)
    return {name: rows[:, passed] for name, rows in (given | {"pupil_mm": pupil}).items()}, stop[passed]


def _widened(sight: Sight, arcs: PupilArcs, report: Callable[[float], object]) -> PupilArcs:
    """The arcs, wide enough for random rays."""
    for seed in range(2):
        report(0.8 + 0.1 * seed)
        rays, stop = _random(sight, arcs, seed)
        share = stop / sight.stop_radius_mm
        kinds, numbers = np.flatnonzero(arcs.used), arcs.numbers.copy()
        for by in ("left", "right"):
            found = evaluate(arcs.checked, rays)[by]
            for row, kind in zip(found, kinds, strict=True):
                lack = -row / (share if kind == 0 else 1.0)
                push = max(float(np.quantile(lack, _HELD)), 0.0)
                numbers[kind, by == "right"] += (push if by == "right" else -push) * _unit(arcs, int(kind))
        arcs = replace(arcs, numbers=numbers)
        height = evaluate(arcs.checked, rays)["height"]
        for row, kind in zip(height, kinds, strict=True):
            ratio = rays["pupil_mm"][1] ** 2 / np.maximum(row, 1e-9)
            numbers[kind, 2:] *= max(float(np.quantile(ratio, _HELD)), 1.0)
        arcs = replace(arcs, numbers=numbers)
    return arcs


def passing(sight: Sight, arcs: PupilArcs) -> dict[float, float]:
    """Share of the points of the arcs through which rays pass, all over the film, by shares of the widest stop."""
    rng, found = np.random.default_rng(3), {}
    for share in (1.0, 0.5, 0.25):
        angle, radius = 2 * np.pi * rng.random(_ASKED), 0.98 * arcs.film_radius_mm * np.sqrt(rng.random(_ASKED))
        film = radius * np.stack([np.cos(angle), np.sin(angle)])
        rows = {
            "film_z_mm": rng.uniform(*sight.film_z_mm, _ASKED),
            "wavelength_nm": rng.uniform(*sight.wavelength_nm, _ASKED),
        }
        rows |= {"stop_radius_mm": np.full(_ASKED, share * sight.stop_radius_mm)}
        given = {"film_mm": film, "square": rng.random((2, _ASKED))} | {name: row[None] for name, row in rows.items()}
        pupil = evaluate(arcs.graph, given)["pupil_mm"]
        status = sight.status(film, pupil, rows["wavelength_nm"], rows["film_z_mm"], rows["stop_radius_mm"])
        found[share] = float(np.mean(status == st.PASSED))
    return found
