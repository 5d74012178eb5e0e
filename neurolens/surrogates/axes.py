"""States of a lens as numbers (focal length of a zoom, vergence of internal focus) and interpolation between nodes.

A quantity of a lens with cams is smooth in its state but where the source states a position: cams are interpolated
between those, piece by piece. So it is interpolated piece by piece too, by polynomials through Chebyshev-Lobatto
nodes (the ends of a piece among them) in a coordinate in which lens quantities are nearly straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError

Array = NDArray[np.float64]

# Relative slack of a state's range, of its largest magnitude: the rounding of float32 inputs, and no more.
STATE_SLACK = 1e-5
MOST_NODES = 64


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
        if not (self.degree >= 1 and (len(self.knots) - 1) * self.degree < MOST_NODES):
            raise InputError("state", "degree", self.degree, f"at least 1, and fewer than {MOST_NODES} nodes in all")

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest value."""
        return self.knots[0], self.knots[-1]

    @property
    def limits(self) -> tuple[float, float]:
        """Least and largest value accepted: the range with its slack."""
        slack = STATE_SLACK * max(abs(v) for v in self.range)
        return self.range[0] - slack, self.range[1] + slack

    @cached_property
    def nodes(self) -> tuple[float, ...]:
        """[K] ascending values, the knots among them bit for bit."""
        places = [math.cos(math.pi * (1 - j / self.degree)) for j in range(1, self.degree)]
        values = [self.knots[0]]
        for low, high in zip(self.knots, self.knots[1:], strict=False):
            a, b = (self._coordinate(v) for v in (low, high))
            inner = [(a + b) / 2 + (b - a) / 2 * t for t in places]
            values += [1 / v if self.reciprocal else v for v in inner]
            values.append(high)
        return tuple(values)

    @property
    def pieces(self) -> tuple[Array, Array]:
        """[P] factor and offset of each piece: its own coordinate is clip(factor * coordinate + offset, -1, 1)."""
        ends = np.array([self._coordinate(v) for v in self.knots])
        factor = 2 / np.diff(ends)
        return factor, -factor * (ends[:-1] + ends[1:]) / 2

    def _coordinate(self, value: float) -> float:
        return 1 / value if self.reciprocal else value

    def features(self, value: float) -> Array:
        """[K] basis of the interpolation: 1, then T_j(t) - T_j(-1), j = 1 to the degree, of each piece in turn.

        T_j are Chebyshev polynomials, t is the piece's own coordinate. Whole degrees of all pieces stand together:
        degree 1 of every piece, then degree 2. Every function that is a polynomial on each piece and continuous is a
        sum of these.
        """
        factor, offset = self.pieces
        t = np.clip(factor * self._coordinate(value) + offset, -1, 1)
        rows = [np.ones(1)]
        rows += [np.cos(j * np.arccos(t)) - (-1) ** j for j in range(1, self.degree + 1)]
        return np.concatenate(rows)

    @cached_property
    def to_features(self) -> Array:
        """[K, K] matrix from values at the nodes to factors of the features."""
        return np.asarray(np.linalg.inv(np.stack([self.features(v) for v in self.nodes])), dtype=np.float64)

    def weights(self, value: float) -> Array:
        """[K] weights of the nodes at a value: 1 at a node itself. Raises InputError: a value out of range."""
        low, high = self.limits
        if not low <= value <= high:
            expected = f"{self.range[0]:.6g} to {self.range[1]:.6g} {self.unit}"
            raise InputError("state", self.name, value, expected)
        if value in self.nodes:
            return np.eye(len(self.nodes))[self.nodes.index(value)]
        return np.asarray(self.features(min(max(value, self.range[0]), self.range[1])) @ self.to_features)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
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
        """The inverse of `to_dict`. Raises InputError, KeyError, TypeError, ValueError: what is no such table."""
        stated = tuple((str(k), float(v)) for k, v in dict(data["stated"]).items())
        knots = tuple(float(v) for v in data["knots"])
        return Axis(str(data["name"]), str(data["unit"]), knots, int(data["degree"]), bool(data["reciprocal"]), stated)


def product(axes: Sequence[Axis]) -> list[tuple[float, ...]]:
    """The nodes of all axes together, the last axis fastest."""
    found: list[tuple[float, ...]] = [()]
    for axis in axes:
        found = [(*state, v) for state in found for v in axis.nodes]
    return found


def weights(axes: Sequence[Axis], state: Sequence[float]) -> Array:
    """[K] weights of the nodes of `product`.

    Raises:
        InputError: another number of values than axes, or one out of range.
    """
    if len(state) != len(axes):
        raise InputError("state", "state", tuple(state), f"{len(axes)} numbers: {', '.join(a.name for a in axes)}")
    found: Array = np.ones(1)
    for axis, value in zip(axes, state, strict=True):
        found = np.asarray(np.kron(found, axis.weights(value)), dtype=np.float64)
    return found
