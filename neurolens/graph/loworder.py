"""Derivatives of a lens's graph as sparse polynomials of low order, for ray differentials.

A ray differential says how wide a pixel's footprint is, to choose the texels that it averages: an error of a few
percent does no harm. Derivatives of the graph itself double its work; polynomials of some ten terms each are a few
products.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value, live_rows
from neurolens.graph.program import FILM_X_Y

Array = NDArray[np.float64]
_DEGREE, _DEGREE_WAVE = 4, 2  # in film and pupil point, alone and times the wavelength's variable
_STOP, _MOST_TERMS = 0.005, 16  # of an output: the error that is good enough, as a share of its group's; terms
WORST = 0.03  # RMS error, as a share of a derivative, above which there is no such graph
_FEWEST, _ENOUGH = 500, 8_000  # rays that pass, to fit to, and rays of which every second, third ... is taken
_STEP_MM = 1e-4  # of differences, in double precision
_ONE_WAVELENGTH = 1e-3  # relative spread of 1 / wavelength^2 below which it is one
_GROUPS = (slice(0, 3), slice(3, 6))  # rows of point and direction: each has one scale
_NAMES = [derivative("scene_ray", by) for by in FILM_X_Y]
Monomial = tuple[int, ...]  # numbers of the variables in it, ascending


@dataclass(frozen=True)
class LowOrder:
    """A graph with the derivatives of `scene_ray` by the film point (`derive.derivative`).

    Attributes:
        error: RMS over the fitted rays of the error of a derivative (the point's or the direction's 3 x 2 matrix,
            Frobenius norm) over its size, the larger of the two. terms: of all outputs.
    """

    graph: Graph
    error: float
    terms: int


def with_film_derivatives(graph: Graph) -> Graph:
    """The graph of a lens with the derivatives of `scene_ray` by the film point: the graph's own, not fitted ones."""
    return with_derivatives(graph, ["scene_ray"], [("rays", row) for row in range(len(FILM_X_Y))])


def with_low_order_derivatives(
    graph: Graph, samples: Mapping[str, NDArray[np.float32]], enough: float = _STOP, worst: float = WORST
) -> LowOrder | None:
    """Fit the derivatives of a lens's graph by orthogonal matching pursuit, each until it is good enough.

    Args:
        samples: inputs of rays that cover those of later calls, [rows, N] or, of the call, [rows, 1].
        enough, worst: see `_STOP` and `WORST`.

    Returns None where low orders are not enough, as for a strong lens, or too few rays pass.
    """
    fitted = low_orders([graph], [samples], enough, worst)
    return None if fitted is None else fitted[0]


def low_orders(
    graphs: Sequence[Graph],
    samples: Sequence[Mapping[str, NDArray[np.float32]]],
    enough: float = _STOP,
    worst: float = WORST,
    reach_mm: float = 0.0,
) -> list[LowOrder] | None:
    """`with_low_order_derivatives` of a lens in several states, which share the terms and have their own weights.

    Args:
        reach_mm: distance of the nearest object: errors of the point's derivatives are shares of those that the
            direction's make of them there, where that is more.
    """
    states = [_Fitted.of(graph, given) for graph, given in zip(graphs, samples, strict=True)]
    if any(state is None for state in states):
        return None
    known = [state for state in states if state is not None]
    for group, least in zip(_GROUPS, (reach_mm, 0.0), strict=True):
        good = [enough * max(_rms(s.wanted[group]), least * _rms(s.wanted[_GROUPS[1]])) for s in known]
        for row in range(group.start, group.stop):
            for by in range(2):
                chosen, values = pursue([s.products for s in known], [s.wanted[row, by] for s in known], good)
                for state, own in zip(known, values, strict=True):
                    state.weights[row, by, chosen] = own
    used = np.any([s.weights.any((0, 1)) for s in known], axis=0)
    found = [s.finished(used, reach_mm) for s in known]
    return found if max(f.error for f in found) <= worst else None


@dataclass(frozen=True)
class _Fitted:
    """A lens in one state while it is fitted: `products` [M, N], the monomials of the rays that pass, the derivatives
    `wanted` [6, 2, N], and the weights [6, 2, M]."""

    graph: Graph
    samples: Mapping[str, NDArray[np.float32]]
    passed: NDArray[np.bool_]
    variables: Value
    monomials: list[Monomial]
    products: Array
    wanted: Array
    weights: Array

    @staticmethod
    def of(graph: Graph, samples: Mapping[str, NDArray[np.float32]]) -> _Fitted | None:
        """The start of a fit; None where too few rays pass."""
        thinner = slice(None, None, max(1, samples["rays"].shape[1] // _ENOUGH))
        doubles = {name: rows[:, thinner].astype(np.float64) for name, rows in samples.items()}
        status = evaluate(graph, doubles)["status"][0]
        wanted = _slopes(graph, doubles)
        passed = np.broadcast_to(status == st.PASSED, doubles["rays"].shape[1:]) & np.isfinite(wanted).all((0, 1))
        if passed.sum() < _FEWEST:
            return None
        found = Graph()
        found.outputs = found.inline(graph, {})
        columns, variables = _variables(found, doubles["rays"][:, passed])
        monomials = _monomials(len(columns))
        one = np.ones(int(passed.sum()))
        products = np.stack([np.prod([one, *(columns[k] for k in m)], axis=0) for m in monomials])
        weights = np.zeros((6, 2, len(monomials)))
        wanted = np.broadcast_to(wanted, (6, 2, len(passed)))[..., passed]
        samples = {name: rows.astype(np.float32) for name, rows in doubles.items()}  # as it will be used
        return _Fitted(found, samples, passed, variables, monomials, products, wanted, weights)

    def finished(self, used: NDArray[np.bool_], reach_mm: float) -> LowOrder:
        """The graph with its derivatives, by the monomials that any state uses."""
        count = self.variables.rows
        exponents = np.array([np.bincount(m, minlength=count) for m in self.monomials], np.int64)[used]
        weights = self.weights[..., used].transpose(1, 0, 2).reshape(12, -1)
        rows = self.graph.polynomial(exponents, weights, self.variables)
        self.graph.outputs |= dict(zip(_NAMES, self.graph.split(rows, (6, 6)), strict=True))
        fitted = _matrices(evaluate(self.graph, self.samples), self.passed)  # in float32, as it will be used
        point, direction = (np.linalg.norm(self.wanted[group], axis=(0, 1)) for group in _GROUPS)
        sizes = np.maximum(point, reach_mm * direction), direction
        error = max(_error(fitted[g], self.wanted[g], size) for g, size in zip(_GROUPS, sizes, strict=True))
        return LowOrder(self.graph, error, int(np.count_nonzero(self.weights)))


def _slopes(graph: Graph, samples: Mapping[str, Array]) -> Array:
    """Derivatives [6, 2, N] of `scene_ray` by the film point, as differences: quicker than to write their graph."""
    found = []
    for row in range(2):
        step = np.zeros((5, 1))
        step[row] = _STEP_MM
        up, down = (evaluate(graph, {**samples, "rays": samples["rays"] + s})["scene_ray"] for s in (step, -step))
        found.append((up - down) / (2 * _STEP_MM))
    return np.stack(found, axis=1)


def _matrices(results: Mapping[str, NDArray[np.float32]], passed: NDArray[np.bool_]) -> Array:
    """Derivatives [6, 2, M] of the rays that pass."""
    rows = [np.broadcast_to(results[name], (6, len(passed)))[:, passed] for name in _NAMES]
    return np.stack(rows, axis=1).astype(np.float64)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _error(found: Array, wanted: Array, size: Array) -> float:
    """The RMS over rays of the error (Frobenius norm) over a size [N]."""
    return _rms(np.linalg.norm(found - wanted, axis=(0, 1)) / np.maximum(size, 1e-30))


def _variables(g: Graph, rays: Array) -> tuple[Array, Value]:
    """Film and pupil point and, if the lens disperses, 1 / wavelength^2 less its mean: as numbers [V, N] and value."""
    inputs = g.input("rays", 5)
    if 4 in live_rows(g, g.outputs).get(inputs.number, ()):
        wave = (1000 / rays[4]) ** 2
        if np.ptp(wave) > _ONE_WAVELENGTH * wave.mean():  # else a constant, which there is already
            inverse = 1000.0 / inputs[4]
            varying = inverse * inverse + -float(wave.mean())
            return np.stack([*rays[:4], wave - wave.mean()]), g.concat(inputs[0:4], varying)
    return rays[:4], inputs[0:4]


def _monomials(count: int) -> list[Monomial]:
    points = [m for n in range(_DEGREE + 1) for m in combinations_with_replacement(range(4), n)]
    return points + [(*m, 4) for m in points if len(m) <= _DEGREE_WAVE and count > 4]


def pursue(
    columns: Sequence[Array], wanted: Sequence[Array], good: Sequence[float], most: int = _MOST_TERMS
) -> tuple[list[int], list[Array]]:
    """Orthogonal matching pursuit for several states at once, with the same columns for all.

    It chooses rows of `columns` [M, N] of each state until their weighted sum is within `good` (RMS) of `wanted` [N] in
    every state. The pursuits of `surrogates.terms` need torch, which a render with a model does not have.

    Returns the numbers of the rows, and their weights in each state.
    """
    sizes = [np.maximum(np.linalg.norm(c, axis=1), 1e-30) for c in columns]
    scales = [max(float(np.linalg.norm(w)), 1e-30) for w in wanted]
    chosen: list[int] = []
    weights, left = [np.zeros(0) for _ in columns], list(wanted)
    while len(chosen) < most and any(np.sqrt(np.mean(v**2)) > g for v, g in zip(left, good, strict=True)):
        gain = sum((c @ v / size / scale) ** 2 for c, v, size, scale in zip(columns, left, sizes, scales, strict=True))
        gain = np.asarray(gain)
        gain[chosen] = 0
        chosen.append(int(gain.argmax()))
        parts = [c[chosen] / size[chosen, None] for c, size in zip(columns, sizes, strict=True)]
        weights = [
            np.linalg.lstsq(part.T, w, rcond=None)[0] / size[chosen]
            for part, w, size in zip(parts, wanted, sizes, strict=True)
        ]
        left = [w - own @ c[chosen] for w, own, c in zip(wanted, weights, columns, strict=True)]
    return chosen, weights
