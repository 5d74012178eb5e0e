"""The operations in which a surface step is written, so that one text serves tensors, numpy arrays and graphs.

Operators (+ - * / and comparisons) mean the same in all three; `Arithmetic` names the other operations. Its own methods
serve numpy arrays, `Graphs` overrides them for the values of a graph, and `tensors` for torch, in fused and guarded
forms.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from neurolens.graph.ir import Graph, Value

# The least number that a root is taken of. What must be positive is tested to be at least this.
TINY = 1e-30


def is_number(value: Any) -> bool:
    """Test whether a value is a plain number, which can be folded into the operations around it."""
    return isinstance(value, (int, float))  # asked a million times; a union takes twice as long


def times(a: Any, k: Any) -> Any:
    """Return a k, without an operation where k is the number 1 or -1."""
    if is_number(k) and k in (1, -1):
        return a if k == 1 else -a
    return a * k


class Arithmetic:
    """Numpy's arithmetic: the root of a negative number is NaN, and NaN fails every test.

    Attributes:
        guard: whether lost rays stay finite, which derivatives and recorded crossings need.
        finite: whether totally reflected rays stay finite; where `guard` is set, they do anyway.
        polish: how many steps an iteration takes after the one that decides whether it has converged; 0 in float32.
    """

    guard = finite = False
    polish = 2

    def fma(self, a: Any, b: Any, c: Any, k: Any = 1) -> Any:
        """Return a b k + c, where b and k may be numbers."""
        if is_number(b):
            b, k = k, b
        if is_number(k) and k == 0:
            return c
        if is_number(b):
            return c - a if b * k == -1 else times(a, b * k) + c
        return times(times(a, k), b) + c

    def add_to(self, c: Any, a: Any, b: Any, k: Any = 1) -> Any:
        """Return a b k + c, which may overwrite c."""
        return self.fma(a, b, c, k)

    def dot(self, a: Sequence[Any], b: Sequence[Any]) -> Any:
        """Return the scalar product of two vectors."""
        total = a[0] * b[0]
        for p, q in zip(a[1:], b[1:], strict=True):
            total = self.fma(p, q, total)
        return total

    def root(self, square: Any, finite: bool = False) -> Any:
        """Return the square root; NaN for a negative number, unless it shall be `finite` or lost rays are guarded."""
        return np.sqrt(square)

    def held_root(self, square: Any, least: float = TINY) -> Any:
        """Return the square root of a number, or that of `least` where the number is less."""
        return np.sqrt(np.maximum(square, least))

    def inverse_root(self, square: Any) -> Any:
        """Return 1 / square root."""
        return 1.0 / np.sqrt(square)

    def positive(self, value: Any) -> Any:
        """Return a value as a divisor: with guards, 1 where it is not positive."""
        return value

    def nonzero(self, value: Any) -> Any:
        """Return a value as a divisor of either sign: with guards, 1 where its square is 0."""
        return value

    def least(self, a: Any, b: Any) -> Any:
        """Return the smaller of two values."""
        return np.minimum(a, b)

    def exp(self, value: Any) -> Any:
        """Return the exponential function, of arrays and tensors alone: no graph has it."""
        return np.exp(value)

    def abs(self, value: Any) -> Any:
        """Return the absolute value."""
        return np.abs(value)

    def select(self, low: Any, high: Any, then: Any, otherwise: Any) -> Any:
        """Return `then` where low <= high, else `otherwise`, which NaN gives too."""
        return np.where(low <= high, then, otherwise)

    def fixed(self, value: Any) -> Any:
        """Return the value as a constant, through which no derivative is taken."""
        return value

    def constant(self) -> AbstractContextManager[Any]:
        """Return a context in which no derivatives are followed."""
        return nullcontext()

    def like(self, value: Any, number: Any) -> Any:
        """Return a number in the form that a value has."""
        return np.full_like(value, number)

    def horner(self, x: Any, coefficients: Sequence[Any]) -> Any:
        """Return the polynomial in x with these coefficients, lowest power first."""
        total: Any = coefficients[-1]
        for c in coefficients[-2::-1]:
            total = total * x + c
        return total + x * 0.0 if is_number(total) else total

    def chebyshev(self, x: Any, coefficients: Sequence[Any]) -> Any:
        """Return the sum of Chebyshev's polynomials with these coefficients, lowest first, by Clenshaw's recurrence."""
        total, later = coefficients[-1], None
        for k in range(len(coefficients) - 2, -1, -1):
            c = coefficients[k] if later is None else coefficients[k] - later
            total, later = self.fma(x, total, c, 2.0 if k else 1), total
        return total + x * 0.0 if is_number(total) else total


class Graphs(Arithmetic):
    """The arithmetic that adds operations to a graph.

    Args:
        graph: the graph whose values these are.
        double: whether the graph will run in double precision, for which iterations are polished.
        guard, finite: as in `Arithmetic`.
    """

    def __init__(self, graph: Graph, *, double: bool = False, guard: bool = False, finite: bool = False) -> None:
        self.graph, self.polish, self.guard, self.finite = graph, 2 if double else 0, guard, guard or finite

    def root(self, square: Value, finite: bool = False) -> Value:
        if self.guard:
            return self.select(TINY, square, square, 1.0).sqrt()
        return self.held_root(square) if finite else square.sqrt()

    def held_root(self, square: Value, least: float = TINY) -> Value:
        return square.maximum(least).sqrt()

    def inverse_root(self, square: Value) -> Value:
        return 1.0 / square.sqrt()

    def positive(self, value: Value) -> Value:
        return self.select(TINY, value, value, 1.0) if self.guard else value

    def nonzero(self, value: Value) -> Value:
        return self.select(TINY, value * value, value, 1.0) if self.guard else value

    def least(self, a: Value, b: Value) -> Value:
        return a.minimum(b)

    def abs(self, value: Value) -> Value:
        return value.abs()

    def select(self, low: Any, high: Any, then: Any, otherwise: Any) -> Value:
        return self.graph.select(self.graph.value(low) <= high, then, otherwise)

    def like(self, value: Value, number: Any) -> Value:
        return self.graph.value(number)

    def horner(self, x: Value, coefficients: Sequence[Any]) -> Value:
        if all(is_number(c) for c in coefficients):
            return self.graph.series(x, coefficients)
        return self.graph.value(super().horner(x, coefficients))


NUMPY = Arithmetic()
