"""Sparse polynomials by pursuit with the exact least-squares error after every addition, then replacement.

Schrade, Hanika and Dachsbacher 2016. For each candidate the error that least squares would leave with it is known
exactly from an incomplete Cholesky factorisation of the candidates' Gram matrix, of which only the rows of chosen terms
are ever formed: thousands of candidates cost no more than their products with the rays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# A candidate of which less than this share is left after orthogonalisation is a combination of the chosen ones.
_DEPENDENT = 1e-10


class Pursuit:
    """Candidate columns [M, N], one target [N], and the terms chosen so far."""

    def __init__(self, columns: Floats, target: Floats) -> None:
        self._unit = columns / np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
        self._moments = self._unit @ target
        self._square = float(target @ target)
        self._gram: dict[int, Floats] = {}
        self.chosen: list[int] = []

    def run(self, terms: int, passes: int = 10) -> list[int]:
        """Choose up to `terms`, exchange while any exchange helps, and return them."""
        self._add_until(terms)
        for _ in range(passes):
            if not self._replace():
                break
        return sorted(self.chosen)

    def error(self) -> float:
        """Sum of squares that least squares on the chosen terms leaves."""
        return self._state(self.chosen)[2]

    def _state(self, chosen: list[int]) -> tuple[Floats, Floats, float]:
        """What each candidate has left [M], its product with the residual [M], and the residual's square."""
        count = len(self._unit)
        left, residual, square = np.ones(count), self._moments.copy(), self._square
        factor = np.empty((len(chosen), count))
        for i, k in enumerate(chosen):
            row = self._row(k) - factor[:i, k] @ factor[:i]
            pivot = np.sqrt(max(row[k], _DEPENDENT))
            factor[i] = row / pivot
            gain = residual[k] / pivot
            left -= factor[i] ** 2
            residual -= gain * factor[i]
            square -= gain * gain
        return left, residual, square

    def _row(self, k: int) -> Floats:
        if k not in self._gram:
            self._gram[k] = self._unit @ self._unit[k]
        return self._gram[k]

    def _best(self, chosen: list[int]) -> tuple[int, float, float]:
        """The candidate that leaves least, its gain, and the square before."""
        left, residual, square = self._state(chosen)
        usable = left > _DEPENDENT
        usable[chosen] = False
        gains = np.where(usable, residual**2 / np.where(usable, left, 1.0), -1.0)
        best = int(gains.argmax())
        return best, float(gains[best]), square

    def _add_until(self, terms: int) -> None:
        while len(self.chosen) < min(terms, len(self._unit)):
            best, gain, _ = self._best(self.chosen)
            if gain <= 0:
                return
            self.chosen.append(best)

    def _replace(self) -> bool:
        """Take each term out and put the best candidate in; True where the error fell."""
        before = now = self.error()
        for k in list(self.chosen):
            rest = [c for c in self.chosen if c != k]
            best, gain, square = self._best(rest)
            # The old term stays unless the new one is better by more than rounding.
            if gain > 0 and best != k and square - gain < now * (1 - 1e-9):
                self.chosen, now = [*rest, best], square - gain
        return now < before * (1 - 1e-6)
