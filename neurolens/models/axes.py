"""State axes of a lens (focal length of a zoom, vergence of internal focus) and interpolation between their nodes.

A quantity of a zoom lens is smooth in the state, except at the positions that the source states: cams are interpolated
piece by piece between those. So every quantity is interpolated piece by piece, too, by polynomials through
Chebyshev-Lobatto nodes (the ends of a piece among them), in a coordinate in which lens quantities are nearly straight.
`weights` does it with numbers, `state_graph` in a graph.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.graph.ir import Graph, Value
from neurolens.graph.program import Mixture
from neurolens.graph.scalars import lower

Array = NDArray[np.float64]
STATE = "state"  # name of a graph's input
_SLACK = 1e-5  # of a state's range, relative to its largest magnitude: the rounding of float32 inputs, and no more
_MOST_NODES = 64


@dataclass(frozen=True)
class Axis:
    """One state variable and its nodes.

    Attributes:
        name: "zoom" or "focus".
        unit: of its values: "mm" of focal length at infinity focus; "1/m" of distance from the film to the object.
        knots: ascending values between which the lens is smooth; the first and the last are the range.
        degree: of the polynomial of each piece; K = pieces * degree + 1 nodes.
        reciprocal: whether the coordinate is 1 / value.
        stated: name and value of the positions that the source states.
    """

    name: str
    unit: str
    knots: tuple[float, ...]
    degree: int
    reciprocal: bool = False
    stated: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.knots, self.knots[1:], strict=False))
        if len(self.knots) < 2 or not rising or not all(map(math.isfinite, self.knots)):
            raise InputError("state", "knots", self.knots, "two or more finite numbers, rising")
        if self.reciprocal and not self.knots[0] > 0:
            raise InputError("state", "knots", self.knots, "numbers above 0, of which there is a reciprocal")
        if not (self.degree >= 1 and (len(self.knots) - 1) * self.degree < _MOST_NODES):
            raise InputError("state", "degree", self.degree, f"at least 1, and fewer than {_MOST_NODES} nodes in all")

    @property
    def range(self) -> tuple[float, float]:
        """Return the least and the largest value."""
        return self.knots[0], self.knots[-1]

    @property
    def limits(self) -> tuple[float, float]:
        """Return the least and the largest value accepted: the range with its slack."""
        slack = _SLACK * max(abs(v) for v in self.range)
        return self.range[0] - slack, self.range[1] + slack

    @cached_property
    def nodes(self) -> tuple[float, ...]:
        """Return the nodes [K], rising; the knots are among them bit for bit."""
        cosines = [math.cos(math.pi * (1 - j / self.degree)) for j in range(1, self.degree)]
        values = [self.knots[0]]
        for low, high in zip(self.knots, self.knots[1:], strict=False):
            a, b = (self._coordinate(v) for v in (low, high))
            inner = [(a + b) / 2 + (b - a) / 2 * t for t in cosines]
            values += [1 / v if self.reciprocal else v for v in inner]
            values.append(high)
        return tuple(values)

    @property
    def pieces(self) -> tuple[Array, Array]:
        """Return factor and offset [P]: the coordinate of each piece is clip(factor * coordinate + offset, -1, 1)."""
        ends = np.array([self._coordinate(v) for v in self.knots])
        factor = 2 / np.diff(ends)
        return factor, -factor * (ends[:-1] + ends[1:]) / 2

    def _coordinate(self, value: float) -> float:
        return 1 / value if self.reciprocal else value

    def features(self, value: float) -> Array:
        """Return the basis of the interpolation [K]: 1, then T_1(t) - T_1(-1) of each piece, then T_2(t) - T_2(-1) ...

        T_j are Chebyshev polynomials, t is the coordinate of the piece. Every continuous function that is a polynomial
        on each piece is a sum of these.
        """
        factor, offset = self.pieces
        t = np.clip(factor * self._coordinate(value) + offset, -1, 1)
        rows = [np.ones(1), *(np.cos(j * np.arccos(t)) - (-1) ** j for j in range(1, self.degree + 1))]
        return np.concatenate(rows)

    @cached_property
    def to_features(self) -> Array:
        """Return the matrix [K, K] from values at the nodes to factors of the features."""
        return np.asarray(np.linalg.inv(np.stack([self.features(v) for v in self.nodes])), dtype=np.float64)

    def weights(self, value: float) -> Array:
        """Return the weights [K] of the nodes at a value. Raises InputError: a value out of range."""
        low, high = self.limits
        if not low <= value <= high:
            expected = f"{self.range[0]:.6g} to {self.range[1]:.6g} {self.unit}"
            raise InputError("state", self.name, value, expected)
        if value in self.nodes:
            return np.eye(len(self.nodes))[self.nodes.index(value)]
        return np.asarray(self.features(min(max(value, self.range[0]), self.range[1])) @ self.to_features)

    def to_dict(self) -> dict[str, Any]:
        """Return the axis as data for JSON."""
        return {
            "name": self.name,
            "unit": self.unit,
            "range": list(self.range),
            "knots": list(self.knots),
            "degree": self.degree,
            "reciprocal": self.reciprocal,
            "nodes": list(self.nodes),
            "stated": dict(self.stated),
        }

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Axis:
        """Make an axis of what `to_dict` gives; else raise InputError, KeyError, TypeError or ValueError."""
        stated = tuple((str(k), float(v)) for k, v in dict(data["stated"]).items())
        knots = tuple(float(v) for v in data["knots"])
        return Axis(str(data["name"]), str(data["unit"]), knots, int(data["degree"]), bool(data["reciprocal"]), stated)


def product(axes: Sequence[Axis]) -> list[tuple[float, ...]]:
    """List the nodes of all axes together, the last axis fastest."""
    return list(itertools.product(*(axis.nodes for axis in axes)))


def weights(axes: Sequence[Axis], state: Sequence[float]) -> Array:
    """Return [K] weights of the nodes of `product`.

    Raises:
        InputError: another number of values than axes, or one out of range.
    """
    if len(state) != len(axes):
        raise InputError("state", "state", tuple(state), f"{len(axes)} numbers: {', '.join(a.name for a in axes)}")
    return _kron(axis.weights(value) for axis, value in zip(axes, state, strict=True))


def _kron(arrays: Iterable[Array]) -> Array:
    """Return Kronecker's product of all arrays."""
    total: Array = np.ones(1)
    for array in arrays:
        total = np.asarray(np.kron(total, array), np.float64)
    return total


def state_numbers(axes: Sequence[Axis], state: ArrayLike) -> tuple[float, ...]:
    """Return the numbers of a state, in range or not.

    Raises:
        InputError: another number of values than axes, or no numbers.
    """
    try:
        values = tuple(float(v) for v in np.atleast_1d(np.asarray(state, np.float64)))
    except (TypeError, ValueError):
        values = ()
    if not axes or len(values) != len(axes):
        expected = f"{len(axes)} numbers ({', '.join(a.name for a in axes) or 'a model of one state'})"
        raise InputError("OnnxLens.rays", "state", state, expected)
    return values


def state_names(axes: Sequence[Axis]) -> tuple[str, ...]:
    """Return the names of the state's numbers as arguments of functions: `zoom_mm`, `focus_per_m`."""
    return tuple(f"{a.name}_{a.unit.replace('1/', 'per_')}" for a in axes)


def state_graph(axes: Sequence[Axis]) -> tuple[Graph, Array]:
    """Return the graph of a state, and the matrix [K, nodes] by which its features become the weights of the nodes.

    Input `state` [A] of the call. Outputs: `features` [K], the products of the axes' features, those of the last axis
    fastest; `inside`, whether the state lies in its range.
    """
    g = Graph()
    state = g.input(STATE, len(axes), per_call=True)
    low, high = zip(*(a.limits for a in axes), strict=True)
    within = state.between(low, high)
    inside, features = within[0], _axis_features(axes[0], state[0])
    for k, axis in enumerate(axes[1:], 1):
        inside, further = inside & within[k], _axis_features(axis, state[k])
        # Kronecker's product: every feature so far times every one of this axis.
        firsts = np.repeat(np.arange(features.rows), further.rows).tolist()
        seconds = np.tile(np.arange(further.rows), features.rows).tolist()
        features = g.take(features, firsts) * g.take(further, seconds)
    g.outputs = {"features": features, "inside": inside}
    return g, _kron(axis.to_features for axis in axes)


def mixture_of(axes: Sequence[Axis]) -> Mixture:
    """Return how a program with a table for each node follows the state; its numbers are arguments (`state_names`)."""
    return mixture(*state_graph(axes), state_names(axes))


def mixture(graph: Graph, transform: Array, names: Iterable[str]) -> Mixture:
    """Return the mixture of the graph of a state, whose numbers are arguments of these names."""
    g = Graph()
    g.outputs = g.inline(graph, {STATE: g.concat(*(g.input(name, per_call=True) for name in names))})
    return Mixture(lower(g), transform)


def _axis_features(axis: Axis, value: Value) -> Value:
    """Append `Axis.features` [K rows] to a graph; T_j by their recurrence."""
    g, (factor, offset) = value.graph, axis.pieces
    coordinate = 1.0 / value if axis.reciprocal else value
    t = (coordinate * factor + offset).clip(-1.0, 1.0)
    chebyshev = [g.constant(np.ones_like(factor)), t]
    for _ in range(2, axis.degree + 1):
        chebyshev.append((t + t) * chebyshev[-1] - chebyshev[-2])
    return g.concat(g.constant(1.0), *(c + -((-1.0) ** j) for j, c in enumerate(chebyshev) if j))
