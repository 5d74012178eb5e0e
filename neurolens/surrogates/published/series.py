"""Truncated polynomial arithmetic: power series in several variables, cut beyond a total degree.

A series is an array [M] of the coefficients of `Truncated.exponents`. Hullin et al. 2012, "Polynomial Optics".
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Series = NDArray[np.float64]


class Truncated:
    """Arithmetic of series in `variables` variables to a total `degree`.

    Attributes:
        exponents: [M, variables] int64, the constant first.
    """

    def __init__(self, variables: int, degree: int) -> None:
        rows = [e for e in itertools.product(range(degree + 1), repeat=variables) if sum(e) <= degree]
        self.exponents: NDArray[np.int64] = np.array(sorted(rows, key=lambda e: (sum(e), e)), dtype=np.int64)
        self.degree = degree
        total = self.exponents.sum(1)
        left, right = np.nonzero(total[:, None] + total[None, :] <= degree)
        place = {tuple(map(int, e)): k for k, e in enumerate(self.exponents)}
        made = self.exponents[left] + self.exponents[right]
        self._left, self._right = left, right
        self._product = np.array([place[tuple(map(int, e))] for e in made])

    def variable(self, k: int, scale: float = 1.0) -> Series:
        """`scale` times variable k."""
        wanted = np.zeros(self.exponents.shape[1], dtype=np.int64)
        wanted[k] = 1
        return scale * (self.exponents == wanted).all(1).astype(np.float64)

    def constant(self, value: float) -> Series:
        return value * (self.exponents == 0).all(1).astype(np.float64)

    def times(self, a: Series, b: Series) -> Series:
        """The product, cut."""
        found = np.bincount(self._product, a[self._left] * b[self._right], len(self.exponents))
        return np.asarray(found, dtype=np.float64)

    def of(self, taylor: Sequence[float], a: Series) -> Series:
        """f(a) from the Taylor coefficients of f about a's constant, `degree` + 1 of them."""
        small = a.copy()
        small[0] = 0.0
        out = self.constant(taylor[-1])
        for coefficient in reversed(taylor[:-1]):
            out = self.times(out, small)
            out[0] += coefficient
        return out

    def power(self, a: Series, exponent: float) -> Series:
        """a to any power; the constant of `a` must be positive unless the exponent is a natural number.

        Raises:
            ValueError: no such series.
        """
        if exponent == int(exponent) and exponent >= 0:
            out = self.constant(1.0)
            for _ in range(int(exponent)):
                out = self.times(out, a)
            return out
        if not a[0] > 0:
            raise ValueError(f"no power series of a^{exponent} about {a[0]}")
        taylor = [a[0] ** exponent]
        for k in range(self.degree):
            taylor.append(taylor[-1] * (exponent - k) / ((k + 1) * a[0]))
        return self.of(taylor, a)


@lru_cache(maxsize=8)
def truncated(variables: int, degree: int) -> Truncated:
    """The arithmetic of a degree; made once."""
    return Truncated(variables, degree)
