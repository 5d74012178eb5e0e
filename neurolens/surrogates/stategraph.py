"""How a state (zoom, internal focus) becomes numbers in a graph: the features of `axes`, and what is mixed by them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.ir import Graph, Value
from neurolens.graph.program import Mixture
from neurolens.graph.scalars import lower
from neurolens.surrogates.axes import Axis
from neurolens.surrogates.cardstates import STATE

Array = NDArray[np.float64]


def state_names(axes: Sequence[Axis]) -> tuple[str, ...]:
    """Names of the state's numbers as arguments of functions: `zoom_mm`, `focus_per_m`."""
    return tuple(f"{a.name}_{a.unit.replace('1/', 'per_')}" for a in axes)


def state_graph(axes: Sequence[Axis]) -> tuple[Graph, Array]:
    """The graph of a state, and the matrix [K, nodes] by which its features become the weights of the nodes.

    Input `state` [A] of the call. Outputs: `features` [K], the products of the axes' features, those of the last axis
    fastest; `inside`, whether the state lies in its range.
    """
    g = Graph()
    state = g.input(STATE, len(axes), per_call=True)
    low, high = zip(*(a.limits for a in axes), strict=True)
    within = state.between(low, high)
    inside = within[0]
    found = _axis_features(axes[0], state[0])
    transform: Array = axes[0].to_features
    for k, axis in enumerate(axes[1:], 1):
        inside = inside & within[k]
        own = _axis_features(axis, state[k])
        count = own.rows
        # Kronecker's product: every feature so far times every one of this axis.
        found = g.take(found, np.repeat(np.arange(found.rows), count).tolist()) * g.take(
            own, np.tile(np.arange(count), found.rows).tolist()
        )
        transform = np.asarray(np.kron(transform, axis.to_features), np.float64)
    g.outputs = {"features": found, "inside": inside}
    return g, transform


def mixture_of(axes: Sequence[Axis]) -> Mixture:
    """How a program, a table for each node, follows the state: its numbers are arguments of `state_names`."""
    graph, transform = state_graph(axes)
    g = Graph()
    g.outputs = g.inline(graph, {STATE: g.concat(*(g.input(name, per_call=True) for name in state_names(axes)))})
    return Mixture(lower(g), transform)


def _axis_features(axis: Axis, value: Value) -> Value:
    """[K rows] as `Axis.features`, T_j by their recurrence."""
    g, (factor, offset) = value.graph, axis.pieces
    coordinate = 1.0 / value if axis.reciprocal else value
    t = (coordinate * factor + offset).clip(-1.0, 1.0)
    chebyshev = [g.constant(np.ones_like(factor)), t]
    for _ in range(2, axis.degree + 1):
        chebyshev.append((t + t) * chebyshev[-1] - chebyshev[-2])
    return g.concat(g.constant(1.0), *(c + -((-1.0) ** j) for j, c in enumerate(chebyshev) if j))
