"""Cheap replacements for a surrogate's clipping tests, for cameras that sample their rays near the pupil.

A surrogate spends as many terms on whether a ray passes as on where it goes, all over its domain. A camera that samples
the pupil needs to know only where the pupil ends: a few polynomial terms, fitted to its own rays in the variables that
the surrogate computes anyway, decide whether such a ray is vignetted, and give stop point and transmittance. The
directions of rays stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations_with_replacement, product

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Node, Value, live_rows, pruned
from neurolens.graph.loworder import pursue

Array = NDArray[np.float64]
Truths = NDArray[np.bool_]
_DEGREE, _MOST_TERMS = 3, 20
_NEAR = 0.03  # of a test's value: what lies nearer to 0 decides
_GATE, _SMOOTH = 1.5e-3, 1e-3  # weighted RMS error of a test, and of others relative to their size
_CHANGED, _LOST = 5e-3, 3e-3  # of the rays that pass, that new tests may tell otherwise, and by how much fewer or more
_ZONES = 4  # of the film, as many rays in each, in which they may be so few, with the stop open and with any
_IDLE = 5e-4  # of the rays, that tests which are left out stop alone
_UNIT = 1e-4  # by which squared lengths of directions may differ from 1


@dataclass(frozen=True)
class _GateSamples:
    """Samples of one graph: values [R, N] of the node whose rows are fitted, monomials [M, N] of its variables, weights
    [R, N] of errors, and which rays pass."""

    graph: Graph
    values: Array
    products: Array
    weights: Array
    passed: Truths


def low_tests(graphs: Sequence[Graph], samples: Sequence[Mapping[str, NDArray[np.float32]]]) -> list[Graph] | None:
    """Graphs of a lens, in one state or in several, with tests, stop point and transmittance of few terms.

    Their status says whether a ray passes, but no longer which rim stops it. They test no domain, for rays are those
    that the camera samples.

    Args:
        samples: inputs of the rays of a camera, as of `low_orders`.

    Returns None where the lens is no surrogate of a few variables, where its directions may not be of unit length, or
    where so few terms change the answer for too many rays.
    """
    number = _shared(graphs[0])
    variables = None if number is None else _variables(graphs[0], number)
    if number is None or variables is None or [n.kind for n in graphs[0].nodes].count("first_failure") != 1:
        return None
    kept = live_rows(graphs[0], {"scene_ray": graphs[0].outputs["scene_ray"]})[number]
    gates, exponents = _gates(graphs[0], number), _exponents(graphs[0].nodes[variables].rows)
    seen = [_gate_samples(g, number, variables, gates, exponents, s) for g, s in zip(graphs, samples, strict=True)]
    if any(s is None for s in seen):
        return None
    known = [s for s in seen if s is not None]
    idle = _idle(known, gates)
    told = live_rows(graphs[0], {"status": graphs[0].outputs["status"]})[number]
    fitted = dict[int, list[Array]]()
    for row in (r for r in range(graphs[0].nodes[number].rows) if r not in kept):
        own, enough = _low_row(known, row, 0 if row in idle else _MOST_TERMS, _GATE if row in gates else _SMOOTH)
        if enough or row in told:  # rays that pass are counted below; transmittance is not
            fitted[row] = own
    rows, weights = list(fitted), np.array(list(fitted.values())).swapaxes(0, 1)
    used = weights.any((0, 1))
    made = []
    for state, w, given in zip(known, weights, samples, strict=True):
        made.append(_written(state.graph, number, variables, rows, idle, (exponents[used], w[:, used])))
        if not _same(_passed(made[-1], given), state.passed, given):
            return None
    return made


def _low_row(seen: Sequence[_GateSamples], row: int, most: int, good: float) -> tuple[list[Array], bool]:
    """Weights [M] of at most so many monomials in each state, and whether they come as near as `good`."""
    columns, wanted = [s.products * s.weights[row] for s in seen], [s.values[row] * s.weights[row] for s in seen]
    chosen, own = pursue(columns, wanted, [good] * len(seen), most)
    weights = [np.zeros(len(c)) for c in columns]
    for w, values in zip(weights, own, strict=True):
        w[chosen] = values
    left = [float(np.sqrt(np.mean((v - w @ c) ** 2))) for v, w, c in zip(wanted, weights, columns, strict=True)]
    return weights, max(left) <= good


def _same(found: Truths, wanted: Truths, samples: Mapping[str, NDArray[np.float32]]) -> bool:
    """Check that two tests agree on nearly all rays, and pass as many in every zone."""
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
    """The node that gives rows to where rays go, and other rows to the rest."""
    kept = live_rows(graph, {"scene_ray": graph.outputs["scene_ray"]})
    every = live_rows(graph, graph.outputs)
    shared = [
        k for k, node in enumerate(graph.nodes)
        if node.kind in ("polynomial", "affine") and kept.get(k) and every[k] > kept[k]
    ]  # fmt: skip
    return shared[-1] if shared else None


def _variables(graph: Graph, number: int) -> int | None:
    """The node of the forms that a polynomial or a network is a function of."""
    while graph.nodes[number].kind in ("polynomial", "affine", "tanh"):
        number = graph.nodes[number].inputs[0]
    return number if graph.nodes[number].kind == "quadratic" else None


def _gates(graph: Graph, number: int) -> dict[int, int]:
    """The rows that are tested to be at most 0, and the places of their tests."""
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
    """Rows whose tests alone stop next to no ray."""
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


def _exponents(count: int) -> NDArray[np.int64]:
    chosen = [m for n in range(_DEGREE + 1) for m in combinations_with_replacement(range(count), n)]
    return np.array([np.bincount(m, minlength=count) if m else np.zeros(count) for m in chosen], np.int64)


def _gate_samples(
    graph: Graph, number: int, variables: int, gates: Collection[int], exponents: NDArray[np.int64],
    samples: Mapping[str, NDArray[np.float32]],
) -> _GateSamples | None:  # fmt: skip
    """None where a direction is not of unit length."""
    wanted = {"values": Value(graph, number), "variables": Value(graph, variables), "ray": graph.outputs["scene_ray"]}
    given = evaluate(pruned(graph, wanted), samples)
    if not (np.abs(np.square(given["ray"][3:], dtype=np.float64).sum(0) - 1) <= _UNIT).all():
        return None
    values, x = (given[name].astype(np.float64) for name in ("values", "variables"))
    weights = np.repeat(1 / np.sqrt(np.mean(values**2, axis=1, keepdims=True)), values.shape[1], 1)
    for g in gates:  # what others stop need not be told exactly
        far = [values[g], *(values[other].clip(0) for other in gates if other != g)]
        weights[g] = np.prod([1 / np.hypot(1, v / _NEAR) for v in far], axis=0)
    return _GateSamples(graph, values, np.prod(x ** exponents[:, :, None], axis=1), weights, _passed(graph, samples))


def _passed(graph: Graph, samples: Mapping[str, NDArray[np.float32]]) -> Truths:
    status = evaluate(pruned(graph, {"status": graph.outputs["status"]}), samples)["status"][0]
    return np.broadcast_to(status == st.PASSED, samples["rays"].shape[1:])


def _written(
    graph: Graph, number: int, variables: int, rows: Sequence[int], idle: Collection[int],
    polynomial: tuple[NDArray[np.int64], Array],
) -> Graph:  # fmt: skip
    """The graph with these rows of a node as polynomials, and without idle tests."""
    g, place = Graph(), list[Value]()
    for k, node in enumerate(graph.nodes):
        value = g.like(node, [place[i] for i in node.inputs])
        if k == number:
            own = g.polynomial(*polynomial, place[variables])
            value = g.concat(*(own[rows.index(r)] if r in rows else value[r] for r in range(node.rows)))
        place.append(value)
    tests, gates = _tests(graph), _gates(graph, number)
    pairs = zip(tests.inputs[::2], tests.inputs[1::2], strict=True)
    without = {gates[r] for r in idle} | {n for n, code in enumerate(tests.static) if code == st.OUTSIDE_DOMAIN}
    worst = reduce(Value.maximum, (place[a] - place[b] for n, (a, b) in enumerate(pairs) if n not in without))
    g.outputs = {name: place[v.number] for name, v in graph.outputs.items()}
    g.outputs["status"] = g.select(worst <= 0.0, float(st.PASSED), float(tests.static[0])).whole()
    return g
