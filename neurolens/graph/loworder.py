"""Replaces a lens's derivatives, and its tests of whether a ray passes, by polynomials of few terms.

A ray differential says how wide a pixel's footprint is, to choose the texels that it averages: an error of a few
percent does no harm. Derivatives of the graph itself double its work; polynomials of some ten terms each are a few
products.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations_with_replacement, product

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Node, Value, live_rows, pruned
from neurolens.graph.program import FILM_X_Y

Array = NDArray[np.float64]
_DEGREE, _DEGREE_WAVE = 4, 2  # in film and pupil point: of terms without and with the wavelength's variable
# for each output: the error that is good enough, as a share of its group's size; the most terms
_STOP, _MOST_TERMS = 0.005, 16
WORST = 0.03  # RMS error, as a share of a derivative, above which there is no such graph
# passing rays: the fewest for a fit; of more than `_ENOUGH` only every second, third ... is taken
_FEWEST, _ENOUGH = 500, 8_000
_STEP_MM = 1e-4  # the step of differences, in double precision
_ONE_WAVELENGTH = 1e-3  # below this relative spread of 1 / wavelength^2 all wavelengths count as one
_GROUPS = (slice(0, 3), slice(3, 6))  # rows of point and direction: each has one scale
_NAMES = [derivative("scene_ray", by) for by in FILM_X_Y]


@dataclass(frozen=True)
class LowOrder:
    """A graph with the derivatives of `scene_ray` by the film point (`derive.derivative`).

    Attributes:
        error: relative RMS error over the fitted rays of the point's or the direction's derivatives (a 3 x 2 matrix,
            Frobenius norm), the larger of the two. terms: how many all outputs have together.
    """

    graph: Graph
    error: float
    terms: int


def with_film_derivatives(graph: Graph) -> Graph:
    """Add the exact derivatives of `scene_ray` by the film point to a lens's graph."""
    return with_derivatives(graph, ["scene_ray"], [("rays", row) for row in range(len(FILM_X_Y))])


def with_low_order_derivatives(
    graph: Graph, samples: Mapping[str, NDArray[np.float32]], enough: float = _STOP, worst: float = WORST
) -> LowOrder | None:
    """Fit the derivatives of a lens's graph by orthogonal matching pursuit, each until it is good enough.

    Args:
        samples: inputs of rays that cover those of later calls, [rows, N], or [rows, 1] for inputs of the call.
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
    """Fit as `with_low_order_derivatives`, for several states of a lens, which share terms but not weights.

    Args:
        reach_mm: distance of the nearest object. Errors of the point's derivatives are taken relative to how far the
            direction's derivatives move the ray there, where that is more.
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
    """A lens in one state while it is fitted.

    Attributes:
        products: [M, N] monomials of `exponents`, of the rays that pass.
        wanted: [6, 2, N] derivatives. weights: [6, 2, M] of the fit.
    """

    graph: Graph
    samples: Mapping[str, NDArray[np.float32]]
    passed: NDArray[np.bool_]
    variables: Value
    exponents: NDArray[np.int64]
    products: Array
    wanted: Array
    weights: Array

    @staticmethod
    def of(graph: Graph, samples: Mapping[str, NDArray[np.float32]]) -> _Fitted | None:
        """Start a fit; None where too few rays pass."""
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
        exponents = np.pad(_exponents(_DEGREE, 4), ((0, 0), (0, len(columns) - 4)))
        if len(columns) > 4:
            by_wave = exponents[exponents.sum(1) <= _DEGREE_WAVE] + np.eye(5, dtype=np.int64)[4]
            exponents = np.concatenate([exponents, by_wave])
        products = np.prod(columns ** exponents[:, :, None], axis=1)
        weights = np.zeros((6, 2, len(exponents)))
        wanted = np.broadcast_to(wanted, (6, 2, len(passed)))[..., passed]
        # in the precision in which it will be used
        samples = {name: rows.astype(np.float32) for name, rows in doubles.items()}
        return _Fitted(found, samples, passed, variables, exponents, products, wanted, weights)

    def finished(self, used: NDArray[np.bool_], reach_mm: float) -> LowOrder:
        """Return the graph with its derivatives, written in the monomials that any state uses."""
        weights = self.weights[..., used].transpose(1, 0, 2).reshape(12, -1)
        rows = self.graph.polynomial(self.exponents[used], weights, self.variables)
        self.graph.outputs |= dict(zip(_NAMES, self.graph.split(rows, (6, 6)), strict=True))
        fitted = _matrices(evaluate(self.graph, self.samples), self.passed)  # in float32, as it will be used
        point, direction = (np.linalg.norm(self.wanted[group], axis=(0, 1)) for group in _GROUPS)
        sizes = np.maximum(point, reach_mm * direction), direction
        error = max(_error(fitted[g], self.wanted[g], size) for g, size in zip(_GROUPS, sizes, strict=True))
        return LowOrder(self.graph, error, int(np.count_nonzero(self.weights)))


def _slopes(graph: Graph, samples: Mapping[str, Array]) -> Array:
    """Return derivatives [6, 2, N] of `scene_ray` by the film point, as differences, which is quicker than a graph."""
    found = []
    for row in range(2):
        step = np.zeros((5, 1))
        step[row] = _STEP_MM
        up, down = (evaluate(graph, {**samples, "rays": samples["rays"] + s})["scene_ray"] for s in (step, -step))
        found.append((up - down) / (2 * _STEP_MM))
    return np.stack(found, axis=1)


def _matrices(results: Mapping[str, NDArray[np.float32]], passed: NDArray[np.bool_]) -> Array:
    """Return the derivatives [6, 2, M] of the rays that pass."""
    rows = [np.broadcast_to(results[name], (6, len(passed)))[:, passed] for name in _NAMES]
    return np.stack(rows, axis=1).astype(np.float64)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _error(found: Array, wanted: Array, size: Array) -> float:
    """Return the RMS over rays of the error (Frobenius norm) over a size [N]."""
    return _rms(np.linalg.norm(found - wanted, axis=(0, 1)) / np.maximum(size, 1e-30))


def _variables(g: Graph, rays: Array) -> tuple[Array, Value]:
    """Return the variables of the monomials as numbers [V, N] and as a value of the graph.

    They are film and pupil point and, if the lens disperses, 1 / wavelength^2 less its mean.
    """
    inputs = g.input("rays", 5)
    if 4 in live_rows(g, g.outputs).get(inputs.number, ()):
        wave = (1000 / rays[4]) ** 2
        # a single wavelength adds only a constant, which there is already
        if np.ptp(wave) > _ONE_WAVELENGTH * wave.mean():
            inverse = 1000.0 / inputs[4]
            varying = inverse * inverse + -float(wave.mean())
            return np.stack([*rays[:4], wave - wave.mean()]), g.concat(inputs[0:4], varying)
    return rays[:4], inputs[0:4]


def _exponents(degree: int, count: int) -> NDArray[np.int64]:
    """Return exponents [M, count] of the monomials of so many variables up to a degree."""
    chosen = [m for n in range(degree + 1) for m in combinations_with_replacement(range(count), n)]
    return np.array([np.bincount(np.array(m, np.int64), minlength=count) for m in chosen])


def pursue(
    columns: Sequence[Array], wanted: Sequence[Array], good: Sequence[float], most: int = _MOST_TERMS
) -> tuple[list[int], list[Array]]:
    """Choose columns, the same for several states, by orthogonal matching pursuit.

    It chooses rows of `columns` [M, N] of each state until their weighted sum is within `good` (RMS) of `wanted` [N] in
    every state. The pursuits of `models.terms` need torch, which a render with a model does not have.

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


# ---- tests of few terms ----
#
# A surrogate spends as many terms on whether a ray passes as on where it goes, all over its domain. A camera that
# samples the pupil needs to know only where the pupil ends: a few polynomial terms, fitted to its own rays in the
# variables that the surrogate computes anyway, decide whether such a ray is vignetted, and give stop point and
# transmittance. The directions of rays stay as they are.

Truths = NDArray[np.bool_]
_TEST_DEGREE, _TEST_TERMS = 3, 20
_NEAR = 0.03  # A value of a test this near to 0 decides about its ray.
_GATE, _SMOOTH = 1.5e-3, 1e-3  # weighted RMS errors: of a test; of other rows, relative to their size
# of the rays that pass: how many new tests may judge otherwise; by how much their number may change
_CHANGED, _LOST = 5e-3, 3e-3
# of the film, with as many rays in each; `_LOST` holds in each of them, with the stop open and with any stop
_ZONES = 4
_IDLE = 5e-4  # of the rays: a test that alone stops no more than these is left out
_UNIT = 1e-4  # by which squared lengths of directions may differ from 1


@dataclass(frozen=True)
class _GateSamples:
    """Samples of one graph.

    Attributes:
        values: [R, N] of the node whose rows are fitted. products: [M, N] monomials of its variables.
        weights: [R, N] of errors. passed: [N] which rays pass.
    """

    graph: Graph
    values: Array
    products: Array
    weights: Array
    passed: Truths


def low_tests(graphs: Sequence[Graph], samples: Sequence[Mapping[str, NDArray[np.float32]]]) -> list[Graph] | None:
    """Return graphs of a lens, in one state or several, whose tests, stop point and transmittance have few terms.

    Their status says whether a ray passes, but no longer which rim stops it. They test no domain, for rays are those
    that the camera samples.

    Args:
        samples: inputs of the rays of a camera, as for `low_orders`.

    Returns None where the lens is no surrogate of a few variables, where its directions may not be of unit length, or
    where the few terms change the answer for too many rays.
    """
    number = _shared(graphs[0])
    variables = None if number is None else _forms(graphs[0], number)
    if number is None or variables is None or [n.kind for n in graphs[0].nodes].count("first_failure") != 1:
        return None
    kept = live_rows(graphs[0], {"scene_ray": graphs[0].outputs["scene_ray"]})[number]
    gates, exponents = _gates(graphs[0], number), _exponents(_TEST_DEGREE, graphs[0].nodes[variables].rows)
    seen = [_gate_samples(g, number, variables, gates, exponents, s) for g, s in zip(graphs, samples, strict=True)]
    if any(s is None for s in seen):
        return None
    known = [s for s in seen if s is not None]
    idle = _idle(known, gates)
    told = live_rows(graphs[0], {"status": graphs[0].outputs["status"]})[number]
    fitted = dict[int, list[Array]]()
    for row in (r for r in range(graphs[0].nodes[number].rows) if r not in kept and r not in idle):
        own, enough = _low_row(known, row, _GATE if row in gates else _SMOOTH)
        if enough or row in told:  # rays that pass are counted below; transmittance is not
            fitted[row] = own
    for weights in (
        fitted,
        dict[int, list[Array]](),
    ):  # where few terms are not enough, idle tests are left out all the same
        made = [_written(s, number, variables, exponents, idle, {r: w[k] for r, w in weights.items()})
                for k, s in enumerate(known)]  # fmt: skip
        if all(_same(_passed(g, given), s.passed, given) for g, s, given in zip(made, known, samples, strict=True)):
            return made
    return None


def _low_row(seen: Sequence[_GateSamples], row: int, good: float) -> tuple[list[Array], bool]:
    """Fit a row by few monomials: weights [M] in each state, and whether their error is at most `good`."""
    columns, wanted = [s.products * s.weights[row] for s in seen], [s.values[row] * s.weights[row] for s in seen]
    chosen, own = pursue(columns, wanted, [good] * len(seen), _TEST_TERMS)
    weights = [np.zeros(len(c)) for c in columns]
    for w, values in zip(weights, own, strict=True):
        w[chosen] = values
    left = [float(np.sqrt(np.mean((v - w @ c) ** 2))) for v, w, c in zip(wanted, weights, columns, strict=True)]
    return weights, max(left) <= good


def _same(found: Truths, wanted: Truths, samples: Mapping[str, NDArray[np.float32]]) -> bool:
    """Return whether two tests agree on nearly all rays, and pass nearly as many in every zone."""
    order = np.argsort(np.hypot(*samples["rays"][:2]))
    stop = np.broadcast_to(samples["stop_radius_mm"][0], wanted.shape)
    good = np.sum(found != wanted) <= _CHANGED * wanted.sum()
    for zone in np.array_split(order, _ZONES):
        for part in (zone, zone[stop[zone] >= stop.max()]):
            more = found[part].astype(int) - wanted[part]
            chance = 2 * np.sqrt(np.abs(more).sum())
            good &= abs(more.sum()) <= _LOST * wanted[part].sum() + chance
    return bool(good)


def _shared(graph: Graph) -> int | None:
    """Return the node some of whose rows decide where rays go, while others serve the other outputs alone."""
    kept = live_rows(graph, {"scene_ray": graph.outputs["scene_ray"]})
    every = live_rows(graph, graph.outputs)
    shared = [
        k for k, node in enumerate(graph.nodes)
        if node.kind in ("polynomial", "affine") and kept.get(k) and every[k] > kept[k]
    ]  # fmt: skip
    return shared[-1] if shared else None


def _forms(graph: Graph, number: int) -> int | None:
    """Return the node of the quadratic forms that a polynomial or a network is a function of."""
    while graph.nodes[number].kind in ("polynomial", "affine", "tanh"):
        number = graph.nodes[number].inputs[0]
    return number if graph.nodes[number].kind == "quadratic" else None


def _gates(graph: Graph, number: int) -> dict[int, int]:
    """Return the rows that are tested to be at most 0, each with the place of its test."""
    found = {}
    for place, k in enumerate(_tests(graph).inputs[::2]):
        test = graph.nodes[k]
        if test.kind == "take" and test.inputs[0] == number:
            found[test.static[0]] = place
    return found


def _tests(graph: Graph) -> Node:
    (node,) = (n for n in graph.nodes if n.kind == "first_failure")
    return node


def _idle(seen: Sequence[_GateSamples], gates: Mapping[int, int]) -> set[int]:
    """Return the rows whose tests stop hardly a ray that the others pass."""
    idle: set[int] = set()
    while left := [g for g in gates if g not in idle]:
        lost = dict.fromkeys(left, 0.0)
        for g, s in product(left, seen):
            others = (s.values[[k for k in left if k != g]] <= 0).all(0)
            lost[g] = max(lost[g], float(np.mean((s.values[[*idle, g]] > 0).any(0) & others)))
        least = min(left, key=lost.__getitem__)
        if lost[least] > _IDLE:
            break
        idle.add(least)
    return idle


def _gate_samples(
    graph: Graph, number: int, variables: int, gates: Collection[int], exponents: NDArray[np.int64],
    samples: Mapping[str, NDArray[np.float32]],
) -> _GateSamples | None:  # fmt: skip
    """Take the samples of one graph; None where a direction is not of unit length."""
    wanted = {"values": Value(graph, number), "variables": Value(graph, variables), "ray": graph.outputs["scene_ray"]}
    given = evaluate(pruned(graph, wanted), samples)
    if not (np.abs(np.square(given["ray"][3:], dtype=np.float64).sum(0) - 1) <= _UNIT).all():
        return None
    values, x = (given[name].astype(np.float64) for name in ("values", "variables"))
    weights = np.repeat(1 / np.sqrt(np.mean(values**2, axis=1, keepdims=True)), values.shape[1], 1)
    for g in gates:  # rays that other tests stop need not be judged exactly
        far = [values[g], *(values[other].clip(0) for other in gates if other != g)]
        weights[g] = np.prod([1 / np.hypot(1, v / _NEAR) for v in far], axis=0)
    return _GateSamples(graph, values, np.prod(x ** exponents[:, :, None], axis=1), weights, _passed(graph, samples))


def _passed(graph: Graph, samples: Mapping[str, NDArray[np.float32]]) -> Truths:
    status = evaluate(pruned(graph, {"status": graph.outputs["status"]}), samples)["status"][0]
    return np.broadcast_to(status == st.PASSED, samples["rays"].shape[1:])


def _written(
    state: _GateSamples, number: int, variables: int, exponents: NDArray[np.int64], idle: Collection[int],
    weights: Mapping[int, Array],
) -> Graph:  # fmt: skip
    """Write rows of a node as polynomials with these weights [M], by row, and leave out idle tests."""
    graph, g, place, rows = state.graph, Graph(), list[Value](), list(weights)
    for k, node in enumerate(graph.nodes):
        value = g.like(node, [place[i] for i in node.inputs])
        if k == number and rows:
            own = g.polynomial(exponents, np.stack([*weights.values()]), place[variables])
            value = g.concat(*(own[rows.index(r)] if r in rows else value[r] for r in range(node.rows)))
        place.append(value)
    tests, gates = _tests(graph), _gates(graph, number)
    pairs = zip(tests.inputs[::2], tests.inputs[1::2], strict=True)
    without = {gates[r] for r in idle} | {n for n, code in enumerate(tests.static) if code == st.OUTSIDE_DOMAIN}
    worst = reduce(Value.maximum, (place[a] - place[b] for n, (a, b) in enumerate(pairs) if n not in without))
    g.outputs = {name: place[v.number] for name, v in graph.outputs.items()}
    g.outputs["status"] = g.select(worst <= 0.0, float(st.PASSED), float(tests.static[0])).whole()
    return g
