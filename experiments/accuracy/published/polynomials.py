"""The fitted polynomials of Hanika and Dachsbacher 2014 (dense) and of Schrade et al. 2016 (sparse, high degree).

Both give, as polynomials of the film position, the slope and the wavelength: the position on the outer pupil, the
direction in its tangent frame (`OuterPupil`), the crossing with the stop, and the transmittance, each scalar by itself.
Rays pass where they cross the stop, the outer and the inner pupil within their radii: no other rim is tested.

Left open by the papers and chosen here: the wavelength enters as 1 / lambda^2, scaled (they take lambda in micrometres;
the index is closer to linear so); terms that mirror symmetry forbids are no candidates; the crossing with the stop is
fitted on rays on both sides of the rims; each scalar's error is its own sum of squares, rays uniform over the domain.

The greedy choice of single terms can end among nearly dependent ones (slope and position of a ray go together), which
no single exchange leaves: one output of a lens may be several times worse than its mirror image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiments.accuracy.published.data import PARITY, Outputs, RawData, RawPolynomial, parity_exponents, solve_outputs
from neurolens.models.terms import monomials

# Rays that decide the choice of terms; the coefficients are fitted on all of them afterwards.
SELECTION_RAYS = 6000
# A candidate of which less than this share is left after orthogonalisation is a combination of the chosen ones.
_DEPENDENT = 1e-10

Floats = NDArray[np.float64]


def fit_dense(data: RawData, degree: int) -> RawPolynomial:
    """All terms to a total degree (Hanika and Dachsbacher 2014), counting the wavelength as a variable."""
    supports = [parity_exponents(degree, odd, dispersive=data.dispersive) for odd in PARITY]
    return solve_outputs(data.outputs, supports)


def fit_sparse(data: RawData, terms: int, degree: int) -> RawPolynomial:
    """`terms` terms of each scalar output among all to a total degree (Schrade et al. 2016: 28 of degree 11)."""
    supports = []
    for output, odd in zip(data.outputs, PARITY, strict=True):
        candidates = parity_exponents(degree, odd, dispersive=data.dispersive)
        chosen = _thinned(output)
        columns = monomials(chosen.variables, candidates)
        target = chosen.values[0]
        if chosen.weights is not None:
            columns, target = columns * chosen.weights, target * chosen.weights
        supports.append(candidates[Pursuit(columns.numpy(), target.numpy()).run(terms)])
    return solve_outputs(data.outputs, supports)


def _thinned(output: Outputs) -> Outputs:
    step = max(1, output.values.shape[1] // SELECTION_RAYS)
    weights = None if output.weights is None else output.weights[::step]
    return Outputs(output.variables[:, ::step], output.values[:, ::step], weights)


class Pursuit:
    """Candidate columns [M, N], one target [N], and the terms chosen so far (Schrade et al. 2016).

    For each candidate the error that least squares would leave with it is known exactly from an incomplete Cholesky
    factorisation of the candidates' Gram matrix, of which only the rows of chosen terms are ever formed: thousands of
    candidates cost no more than their products with the rays.
    """

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
        """The part of each candidate that is left [M], its product with the residual [M], and the residual's square."""
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
