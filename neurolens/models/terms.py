"""Terms of polynomials: candidates, their columns, least squares, and which terms to keep.

Terms are monomials of the invariants (times p or u). They are chosen by orthogonal matching pursuit, orthogonal least
squares, elimination or replacement. All of these work on the Gram matrix of the
candidate columns, so that their cost does not grow with the number of rays. The sweep operator (Goodnight 1979, "A
Tutorial on the SWEEP Operator") moves a column into or out of the fit in one rank-one update; afterwards the diagonal
holds what every candidate has left after orthogonalisation, and the right-hand side its correlation with the residual.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.graph.interpret import monomials as monomials
from neurolens.models.cores import LightField

Exponents = NDArray[np.int64]
Array = NDArray[np.float64]
Rule = Literal["omp", "ols"]
# A candidate of which less than this share is left after orthogonalisation is a combination of the chosen ones.
DEPENDENT = 1e-11
# Nor may a candidate leave less than this share of any chosen column. The test above looks at a column as it comes in;
# later ones take from it too, and together may leave nothing but rounding (Berk 1977, "Tolerance and Condition in
# Regression Computations"; Frane 1977, "A Note on Checking Tolerance in Matrix Inversion and Regression").
SPANNED = 1e-12
# A share of this size is rounding of the Gram matrix, about fifty units in the last place.
_NOTHING = 1e-14
ROUNDING = 2.0**-24  # of float32


def powers(variables: int, degree: int) -> list[tuple[int, ...]]:
    """Return the exponents of all monomials up to a total degree."""
    if not variables:
        return [()]
    return [(k, *rest) for k in range(degree + 1) for rest in powers(variables - 1, degree - k)]


def invariant_exponents(degree: int, *, dispersive: bool = True) -> Exponents:
    """Return [M, 4] exponents of rho, sigma, tau, w up to a total `degree` in the first three.

    The wavelength multiplies lower degrees only: the index is nearly linear in w, and dispersion is small beside
    refraction. w^1 goes with degrees up to degree - 2, w^2 with degree - 4, w^3 with degree - 5.
    """
    reach = [degree, degree - 2, degree - 4, degree - 5] if dispersive else [degree]
    return ordered([(*p, w) for w, most in enumerate(reach) for p in powers(3, most)])


def ordered(rows: Sequence[tuple[int, ...]]) -> Exponents:
    """Return [M, V] exponents, the lowest degree first."""
    return np.array(sorted(rows, key=lambda r: (sum(r), r)), dtype=np.int64)


def united(supports: Sequence[Exponents]) -> tuple[Exponents, list[list[int]]]:
    """Join supports: every exponent once, in order of first appearance, and the places of each support's own."""
    number: dict[tuple[int, ...], int] = {}
    columns = [[number.setdefault(tuple(map(int, e)), len(number)) for e in support] for support in supports]
    return np.array(list(number), dtype=np.int64), columns


def further(candidates: Exponents, known: Exponents) -> Exponents:
    """Return the candidates [K, V] that are not among the known exponents [M, V]; repeated rows are left out."""
    there = {tuple(e) for e in known.tolist()}
    new = [e for e in dict.fromkeys(map(tuple, candidates.tolist())) if e not in there]
    return np.array(new, dtype=np.int64).reshape(-1, known.shape[1])


def kept(exponents: Exponents, chosen: Sequence[int]) -> tuple[Exponents, list[int]]:
    """Return the exponents that chosen columns of `vector_columns` need, and where those columns are among them."""
    count = len(exponents)
    rows = sorted({k % count for k in chosen})
    number = {k: i for i, k in enumerate(rows)}
    return exponents[rows], [number[k % count] + (k >= count) * len(rows) for k in chosen]


def vector_columns(features: Tensor, field: LightField) -> Tensor:
    """Columns m p and m u [2 M, 2 N] of features m [M, N]; a row of 2 N entries has both components of each ray."""
    return torch.cat([torch.cat([features * v[0], features * v[1]], 1) for v in (field.p, field.u)])


def vector_gram(
    features: Tensor, field: LightField, outputs: Tensor
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Gram matrix [2 M, 2 M] of `vector_columns`, and the columns' products [2 M, R] with outputs [R, 2, N].

    Formed from rho, sigma and tau, since (m p).(m' u) = m m' sigma: the long columns are never stored.
    """
    rho, sigma, tau, _ = field.invariants()
    pp, pu, uu = (_products(features, s) for s in (rho, sigma, tau))
    gram = torch.cat([torch.cat([pp, pu], 1), torch.cat([pu, uu], 1)])
    along_p, along_u = ((outputs * v).sum(1) for v in (field.p, field.u))
    return gram.numpy(), torch.cat([features @ along_p.T, features @ along_u.T]).numpy()


def _products(features: Tensor, weights: Tensor) -> Tensor:
    """Return weighted sums over rays of products of features [M, N]: [M, M], of which symmetry saves a third."""
    gram = features.new_empty((len(features), len(features)))
    size = -(-len(features) // 3)
    for start in range(0, len(features), max(size, 1)):
        rows = slice(start, start + size)
        part = (features[rows] * weights) @ features[start:].T
        gram[rows, start:], gram[start:, rows] = part, part.T
    return gram


def solve(columns: Tensor, outputs: Tensor, weights: Tensor | None = None) -> Tensor:
    """Solve least squares: coefficients [R, C] for which coefficients @ columns [C, N] is near outputs [R, N].

    `weights` [N] are those of the rays. A ridge stands for the rounding of float32, in which models are evaluated: each
    term then errs by about `ROUNDING` of its own size, and the sum of these squares is part of what is minimised. So
    dependent columns share their effect instead of blowing up, and columns that are 0 get 0.
    """
    if weights is not None:
        columns, outputs = columns * weights, outputs * weights
    norms = columns.norm(dim=1)
    norms = torch.where(norms > 0, norms, 1.0)
    # The Gram matrix would square the condition; QR first, then the small factor by singular values.
    q, r = torch.linalg.qr((columns / norms[:, None]).T)
    ridge = ROUNDING * torch.eye(len(columns), dtype=r.dtype)
    rows, wanted = torch.cat([r, ridge]), q.T @ outputs.T
    padded = torch.cat([wanted, wanted.new_zeros((len(columns), wanted.shape[1]))])
    return (torch.linalg.lstsq(rows, padded, rcond=1e-13, driver="gelsd").solution / norms[:, None]).T


@contextmanager
def pinned_threads() -> Iterator[None]:
    """Give torch one thread inside the block: the same bits anywhere, and no crawling on a shared machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# ---- which terms to keep ----


class Sweep:
    """Normal equations of M unit-length candidate columns and R outputs, with some columns swept in.

    Several problems with the same candidates may be `joined`: all choose the same, by the sum of their residuals.
    """

    def __init__(self, gram: Array, moments: Array, squares: Array) -> None:
        """Take the Gram matrix [M, M], column-output products [M, R] and squared norms of the outputs [R]."""
        self.count, outputs = moments.shape
        norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        table = np.zeros((self.count + outputs, self.count + outputs))
        table[: self.count, : self.count] = gram / np.outer(norms, norms)
        table[: self.count, self.count :] = moments / norms[:, None]
        table[self.count :, : self.count] = table[: self.count, self.count :].T
        table[self.count :, self.count :] = np.diag(squares)
        self._starts = [table]
        self.restart([])

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

    @staticmethod
    def joined(sweeps: Sequence[Sweep]) -> Sweep:
        """Join several problems with the same candidates into one sweep."""
        whole = copy(sweeps[0])
        whole._starts = [start for sweep in sweeps for start in sweep._starts]
        whole.restart([])
        return whole

    @property
    def residuals(self) -> Array:
        """Return the squared residual [R] of every output, of the first problem."""
        return np.diag(self._tables[0])[self.count :]

    @property
    def residual(self) -> float:
        """Return the squared residual, summed over problems and outputs."""
        return sum(float(np.diag(table)[self.count :].sum()) for table in self._tables)

    def add(self, k: int) -> None:
        """Take a column in, unless nothing but rounding is left of it."""
        if all(table[k, k] > _NOTHING for table in self._tables):
            for table in self._tables:
                _sweep(table, k, 1.0)
            self.chosen.append(k)

    def drop(self, k: int) -> None:
        """Take a column out, if it is in."""
        if k not in self.chosen:
            return
        self.chosen.remove(k)
        if all(table[k, k] < -0.999 for table in self._tables):
            for table in self._tables:
                _sweep(table, k, -1.0)
        else:  # more than all of it would be left: rounding has spoilt the pivot
            self.refresh()

    def refresh(self) -> None:
        """Sweep the chosen columns again from the start, which clears the rounding of many updates."""
        self.restart(self.chosen)

    def restart(self, chosen: list[int]) -> None:
        """Sweep these columns into the tables as they were at the start."""
        self.chosen: list[int] = []
        self._tables = [start.copy() for start in self._starts]
        for k in chosen:
            self.add(k)

    def scores(self, rule: Rule) -> Array:
        """Return the gain [M] of every candidate: how far it reduces the squared residual.

        The gain is exact by the rule "ols"; by "omp" it is the squared correlation with the residual.

        It is -1 for chosen candidates, and for those that the chosen ones span in any problem.
        """
        scores = np.stack([self._scores(table, rule) for table in self._tables])
        return np.where((scores >= 0).all(0), scores.sum(0), -1.0)

    def _scores(self, table: Array, rule: Rule) -> Array:
        left = np.diag(table)[: self.count]
        correlation = (table[: self.count, self.count :] ** 2).sum(1)
        usable = left > np.maximum(DEPENDENT, self._needed(table))
        usable[self.chosen] = False
        gain = correlation / np.where(usable, left, 1.0) if rule == "ols" else correlation
        return np.where(usable, gain, -1.0)

    def _needed(self, table: Array) -> Array | float:
        """Return how independent each candidate [M] must be, so that with it every chosen column keeps `SPANNED`."""
        if not self.chosen:
            return 0.0
        # Sweeping k in adds table[j, k]^2 / left[k] to the inverse of what is left of j, which is -table[j, j].
        spare = np.maximum(1 / SPANNED + np.diag(table)[self.chosen], 1e-30)
        across = table[self.chosen, : self.count]
        across *= across
        across /= spare[:, None]
        return np.asarray(across.max(0))

    def costs(self) -> Array:
        """Return how much the residual would grow without each chosen column [len(chosen)], of the first problem."""
        t, chosen = self._tables[0], self.chosen
        # The pivot of a column swept in is -1 / (what is left of it beside the others), which is at most all of it.
        return (t[chosen, self.count :] ** 2).sum(1) / np.maximum(-t[chosen, chosen], 0.999)


def _sweep(table: Array, k: int, sign: float) -> None:
    """Move a column into (1) or out of (-1) a table, in place."""
    pivot, row, column = table[k, k], table[k].copy(), table[:, k].copy()
    torch.from_numpy(table).addr_(torch.from_numpy(column), torch.from_numpy(row), alpha=-1.0 / pivot)
    table[k] = row / pivot * sign
    table[:, k] = table[k]
    table[k, k] = -1.0 / pivot


def forward(sweep: Sweep, terms: int, rule: Rule = "ols") -> None:
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


def replace_terms(sweep: Sweep, passes: int = 10) -> int:
    """Take each chosen term out and put the best candidate in (Schrade et al. 2016), until a pass changes nothing.

    Returns the number of terms exchanged. The residual never grows.
    """
    exchanged = 0
    for _ in range(passes):
        before, start, residual = exchanged, list(sweep.chosen), sweep.residual
        for k in list(sweep.chosen):
            with_k = sweep.residual
            sweep.drop(k)
            # Its true gain: the score of a term that later ones nearly span is no measure, for it counts as none.
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
            sweep.restart(start)
            return before
        if exchanged == before:
            break
    return exchanged
