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

from neurolens.graph.interpret import monomials
from neurolens.surrogates.cores import RawPolynomial
from neurolens.surrogates.published.data import PARITY, Outputs, RawData, parity_exponents, solve_outputs
from neurolens.surrogates.published.pursuit import Pursuit

# Rays that decide the choice of terms; the coefficients are fitted on all of them afterwards.
SELECTION_RAYS = 6000


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
