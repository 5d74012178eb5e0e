"""Which terms of a basis to keep: orthogonal matching pursuit, orthogonal least squares, replacement, growth.

All work on the Gram matrix of the candidate columns, so that their cost does not grow with the number of rays. The
sweep operator (Goodnight 1979, "A Tutorial on the SWEEP Operator") moves a column into or out of the fit in one
rank-one update; afterwards the diagonal holds what every candidate has left after orthogonalisation, and the
right-hand side its correlation with the residual.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.surrogates.bases import Exponents, monomials, vector_columns, vector_gram
from neurolens.surrogates.lightfield import LightField

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
# Rays that decide the choice of terms; the coefficients are fitted on all of them afterwards.
SELECTION_RAYS = 6000


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

    @staticmethod
    def of_columns(columns: Tensor, outputs: Tensor) -> Sweep:
        """Make the problem from columns [M, N] and outputs [R, N]."""
        own = columns.numpy()
        return Sweep(own @ own.T, (columns @ outputs.T).numpy(), (outputs**2).sum(1).numpy())  # numpy sums half of it

    @staticmethod
    def of_vectors(features: Tensor, field: LightField, outputs: Tensor) -> Sweep:
        """Make the problem from the `vector_columns` of features [M, N] and vector outputs [R, 2, N]."""
        gram, moments = vector_gram(features, field, outputs)
        return Sweep(gram, moments, (outputs.flatten(1) ** 2).sum(1).numpy())

    @property
    def residuals(self) -> Floats:
        """[R] the squared residual of every output."""
        return np.diag(self._table)[self.count :]

    @property
    def residual(self) -> float:
        """Sum over outputs of the squared residual."""
        return float(self.residuals.sum())

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
        pivot, row, column = t[k, k], t[k].copy(), t[:, k].copy()
        torch.from_numpy(t).addr_(torch.from_numpy(column), torch.from_numpy(row), alpha=-1.0 / pivot)  # in place
        t[k] = row / pivot * sign
        t[:, k] = t[k]
        t[k, k] = -1.0 / pivot


class JointSweep:
    """Several sweeps with the same candidates, of which all choose the same: the sum of their residuals decides."""

    def __init__(self, sweeps: Sequence[Sweep]) -> None:
        self.sweeps = sweeps

    @property
    def chosen(self) -> list[int]:
        return self.sweeps[0].chosen

    @property
    def residual(self) -> float:
        return sum(s.residual for s in self.sweeps)

    def add(self, k: int) -> None:
        for s in self.sweeps:
            s.add(k)

    def drop(self, k: int) -> None:
        for s in self.sweeps:
            s.drop(k)

    def refresh(self) -> None:
        for s in self.sweeps:
            s.refresh()

    def restart(self, chosen: list[int]) -> None:
        for s in self.sweeps:
            s.restart(chosen)

    def scores(self, rule: Rule) -> Floats:
        """[M] gain of all together; -1 where any sweep's other terms span the candidate."""
        scores = np.stack([s.scores(rule) for s in self.sweeps])
        return np.where((scores >= 0).all(0), scores.sum(0), -1.0)


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


def forward(sweep: Sweep | JointSweep, terms: int, rule: Rule = "ols") -> None:
    """Add the best-scored candidate until `terms` are chosen or none helps."""
    while len(sweep.chosen) < terms:
        scores = sweep.scores(rule)
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


def replace_terms(sweep: Sweep | JointSweep, passes: int = 10) -> int:
    """Take each chosen term out and put the best candidate in (Schrade et al. 2016), until a pass changes nothing.

    Returns the number of terms exchanged. The residual never grows.
    """
    exchanged = 0
    for _ in range(passes):
        before, known, residual = exchanged, list(sweep.chosen), sweep.residual
        for k in list(sweep.chosen):
            with_k = sweep.residual
            sweep.drop(k)
            # Its true gain, because the score of a term that the later ones nearly span counts as none.
            gain = max(sweep.residual - with_k, 0.0)
            scores = sweep.scores("ols")
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


class _Candidates:
    """Terms (a monomial, times p or u for vectors), their columns and the Gram matrix, all of which only grow."""

    def __init__(self, variables: Tensor, field: LightField | None, outputs: Tensor) -> None:
        step = max(1, variables.shape[1] // SELECTION_RAYS)
        self.variables = variables[:, ::step]
        self.field = None if field is None else LightField(*(c[..., ::step] for c in field))
        self.target = outputs[..., ::step].flatten(1)
        self.terms: list[tuple[tuple[int, ...], int]] = []
        self.columns = torch.empty((0, self.target.shape[1]), dtype=variables.dtype)
        self.gram = np.empty((0, 0))

    def extend(self, terms: list[tuple[tuple[int, ...], int]]) -> None:
        known = set(self.terms)
        new = [t for t in dict.fromkeys(terms) if t not in known]
        if not new:
            return
        features = monomials(self.variables, np.array([t[0] for t in new], dtype=np.int64))
        if self.field is None:
            columns = features
        else:
            both = vector_columns(features, self.field)
            columns = both[[i + side * len(new) for i, (_, side) in enumerate(new)]]
        self.terms += new
        old = len(self.columns)
        self.columns = torch.cat([self.columns, columns])
        products = (self.columns @ columns.T).numpy()
        gram = np.zeros((len(self.terms), len(self.terms)))
        gram[:old, :old] = self.gram
        gram[:, old:], gram[old:, :] = products, products.T
        self.gram = gram

    def sweep(self, chosen: list[int]) -> Sweep:
        moments = (self.columns @ self.target.T).numpy()
        sweep = Sweep(self.gram, moments, (self.target**2).sum(1).numpy())
        for k in chosen:
            sweep.add(k)
        return sweep


def grow(
    variables: Tensor, field: LightField | None, outputs: Tensor, terms: int, *, dispersive: bool
) -> tuple[Exponents, list[int]]:
    """Choose `terms` terms by growth, which knows no limit of degree: each brings its products into the candidates.

    Zheng and Zheng 2017, "Adaptive sparse polynomial regression for camera lens simulation".

    Args:
        variables: [V, N]: the invariants with `field`, or the raw coordinates without.
        field: where given, every monomial offers two columns, times p and times u, and outputs are vectors.
        outputs: [R, 2, N] with a field, [R, 1, N] without.
        dispersive: False leaves the last variable (the wavelength) out.

    Returns:
        Exponents [M, V] of all monomials offered, and the chosen columns as in `vector_columns` (k, or M + k for u).
    """
    count = variables.shape[0] if dispersive else variables.shape[0] - 1
    unit = np.eye(variables.shape[0], dtype=np.int64)
    sides = (0,) if field is None else (0, 1)
    steps = list(unit[:count])
    if field is None:
        # A component of a vector is odd in the four coordinates: a single factor leads to terms that never help.
        steps = [unit[a] + unit[b] for a in range(4) for b in range(a, 4)] + list(unit[4:count])
    seed = (0,) * variables.shape[0]
    candidates = _Candidates(variables, field, outputs)
    lowest = [seed, *(tuple(int(e) for e in unit[v]) for v in range(count))]
    candidates.extend([(e, side) for e in lowest for side in sides])
    chosen: list[int] = []
    stride = max(1, terms // 16)
    while len(chosen) < terms:
        sweep = candidates.sweep(chosen)
        forward(sweep, min(terms, len(sweep.chosen) + stride))
        if len(sweep.chosen) == len(chosen):
            break
        replace_terms(sweep, passes=2)
        chosen = sweep.chosen
        for k in chosen:
            exponent, _ = candidates.terms[k]
            children = [tuple(int(e) for e in np.array(exponent) + step) for step in steps]
            candidates.extend([(child, side) for child in children for side in sides])
    offered = list(dict.fromkeys(e for e, _ in candidates.terms))
    place = {e: i for i, e in enumerate(offered)}
    columns = [place[candidates.terms[k][0]] + candidates.terms[k][1] * len(offered) for k in chosen]
    return np.array(offered, dtype=np.int64), columns
