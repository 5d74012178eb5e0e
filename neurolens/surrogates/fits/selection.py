"""Which terms of a basis to keep: orthogonal matching pursuit, orthogonal least squares, replacement.

All work on the Gram matrix of the candidate columns, so that their cost does not grow with the number of rays. The
sweep operator (Goodnight 1979, "A Tutorial on the SWEEP Operator") moves a column into or out of the fit in one
rank-one update; afterwards the diagonal holds what every candidate has left after orthogonalisation, and the
right-hand side its correlation with the residual.
"""

from __future__ import annotations

import warnings
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rule = Literal["omp", "ols"]

# A candidate of which less than this share is left after orthogonalisation is a combination of the chosen ones.
DEPENDENT = 1e-11
# Nor may a candidate leave less than this share of any chosen column. The test above looks at a column as it comes in;
# later ones take from it too, and together may leave nothing but rounding (Berk 1977, "Tolerance and Condition in
# Regression Computations"; Frane 1977, "A Note on Checking Tolerance in Matrix Inversion and Regression").
SPANNED = 1e-12
# A share of this size is rounding of the Gram matrix, about fifty units in the last place.
_NOTHING = 1e-14


class Sweep:
    """Normal equations of M unit-length candidate columns and R outputs, with some columns swept in."""

    def __init__(self, gram: Floats, moments: Floats, squares: Floats) -> None:
        """Take the Gram matrix [M, M], column-output products [M, R] and squared norms of the outputs [R]."""
        self.count, outputs = moments.shape
        norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        table = np.zeros((self.count + outputs, self.count + outputs))
        table[: self.count, : self.count] = gram / np.outer(norms, norms)
        table[: self.count, self.count :] = moments / norms[:, None]
        table[self.count :, : self.count] = table[: self.count, self.count :].T
        table[self.count :, self.count :] = np.diag(squares)
        self._start = table
        self.chosen: list[int] = []
        self._table = table.copy()

    @property
    def residual(self) -> float:
        """Sum over outputs of the squared residual."""
        return float(np.trace(self._table[self.count :, self.count :]))

    def add(self, k: int) -> None:
        """Take a column in, unless nothing but rounding is left of it."""
        if self._table[k, k] > _NOTHING:
            self._sweep(k, 1.0)
            self.chosen.append(k)

    def drop(self, k: int) -> None:
        """Take a column out, if it is in."""
        if k not in self.chosen:
            return
        self.chosen.remove(k)
        if self._table[k, k] < -0.999:
            self._sweep(k, -1.0)
        else:  # more than all of it would be left: rounding has spoilt the pivot
            self.refresh()

    def refresh(self) -> None:
        """Sweep the chosen columns again from the start, which clears the rounding of many updates."""
        self.restart(self.chosen)

    def restart(self, chosen: list[int]) -> None:
        """Sweep these columns into the table as it was at the start."""
        self.chosen, self._table = [], self._start.copy()
        for k in chosen:
            self.add(k)

    def scores(self, rule: Rule) -> Floats:
        """[M] gain of every candidate: squared correlation with the residual ("omp") or its true fall ("ols")."""
        left = np.diag(self._table)[: self.count]
        correlation = (self._table[: self.count, self.count :] ** 2).sum(1)
        usable = left > np.maximum(DEPENDENT, self._needed())
        usable[self.chosen] = False
        gain = correlation / np.where(usable, left, 1.0) if rule == "ols" else correlation
        return np.where(usable, gain, -1.0)

    def _needed(self) -> Floats | float:
        """[M] what must be left of each candidate for every chosen column to keep a share of `SPANNED` beside it."""
        if not self.chosen:
            return 0.0
        # Sweeping k in adds table[j, k]^2 / left[k] to the inverse of what is left of j, which is -table[j, j].
        spare = np.maximum(1 / SPANNED + np.diag(self._table)[self.chosen], 1e-30)
        across = self._table[self.chosen, : self.count]
        across *= across
        across /= spare[:, None]
        return np.asarray(across.max(0))

    def costs(self) -> Floats:
        """[len(chosen)] how much the residual would grow without each chosen column."""
        t, chosen = self._table, self.chosen
        # The pivot of a column swept in is -1 / (what is left of it beside the others), which is at most all of it.
        return (t[chosen, self.count :] ** 2).sum(1) / np.maximum(-t[chosen, chosen], 0.999)

    def _sweep(self, k: int, sign: float) -> None:
        t = self._table
        pivot, row = t[k, k], t[k].copy()
        t -= np.outer(t[:, k], row) / pivot
        t[k] = row / pivot * sign
        t[:, k] = t[k]
        t[k, k] = -1.0 / pivot


def matching_pursuit(gram: Floats, moments: Floats, terms: int) -> list[int]:
    """Support of plain orthogonal matching pursuit (scikit-learn's) for one output with products `moments` [M]."""
    from sklearn.linear_model import orthogonal_mp_gram

    norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    with warnings.catch_warnings():
        # Dependent candidates end the pursuit early, with a warning: the terms found so far are the answer.
        warnings.simplefilter("ignore", RuntimeWarning)
        found = orthogonal_mp_gram(
            gram / np.outer(norms, norms), moments / norms, n_nonzero_coefs=min(terms, len(gram))
        )
    return [int(k) for k in np.flatnonzero(found)]


def forward(sweep: Sweep, terms: int, rule: Rule = "ols", among: list[int] | None = None) -> None:
    """Add the best-scored candidate until `terms` are chosen or none helps. `among` restricts the candidates."""
    allowed = np.full(sweep.count, among is None)
    if among is not None:
        allowed[among] = True
    while len(sweep.chosen) < terms:
        scores = np.where(allowed, sweep.scores(rule), -1.0)
        best = int(scores.argmax())
        if scores[best] <= 0:
            return
        sweep.add(best)


def backward(sweep: Sweep, terms: int) -> None:
    """Drop the chosen term that costs least until `terms` are left.

    After a forward selection of more than `terms`, this drops what later terms made superfluous (Efroymson 1960).
    """
    while len(sweep.chosen) > terms:
        sweep.drop(sweep.chosen[int(sweep.costs().argmin())])
    sweep.refresh()


def replace_terms(sweep: Sweep, passes: int = 10, among: list[int] | None = None) -> int:
    """Take each chosen term out and put the best candidate in (Schrade et al. 2016), until a pass changes nothing.

    Returns the number of terms exchanged. The residual never grows.
    """
    allowed = np.full(sweep.count, among is None)
    if among is not None:
        allowed[among] = True
    exchanged = 0
    for _ in range(passes):
        before, known, residual = exchanged, list(sweep.chosen), sweep.residual
        for k in list(sweep.chosen):
            with_k = sweep.residual
            sweep.drop(k)
            # Its true gain, because the score of a term that the later ones nearly span counts as none.
            gain = max(sweep.residual - with_k, 0.0)
            scores = np.where(allowed, sweep.scores("ols"), -1.0)
            best = int(scores.argmax())
            # The old term wins ties, so that rounding cannot cycle.
            if scores[best] <= gain * (1 + 1e-9):
                best = k
            sweep.add(best)
            exchanged += best != k
        sweep.refresh()
        # Exchanges for gains within the rounding may add up to a loss.
        if sweep.residual > residual:
            sweep.restart(known)
            return before
        if exchanged == before:
            break
    return exchanged
