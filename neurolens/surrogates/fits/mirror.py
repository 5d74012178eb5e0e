"""Polynomials of lenses with cylinders, which keep two planes of symmetry: fitted component by component.

The x of a vector is odd in (p_x, u_x) and even in (p_y, u_y), the y the other way about. Terms of x are p_x or u_x
times a monomial of `LightField.invariants` without p_x u_x (p_x (p_x u_x) is p_x^2 u_x, which is there), and
with p_y u_y at most once (its square is p_y^2 u_y^2): so every term stands once.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.surrogates.bases import Exponents, monomials, ordered, solve, united
from neurolens.surrogates.cores import STOP, MirrorPolynomial
from neurolens.surrogates.fits.boundaries import solve_scalars, stop_crossing
from neurolens.surrogates.fits.selection import Sweep, forward, replace_terms
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.targets import Prepared, film_equivalent

METHODS = ("omp", "ols")  # and networks (`mlp`)
# Gram matrices are made of so many rays at a time; more candidates than this would take too long to choose from.
_CHUNK, _MOST_CANDIDATES = 4096, 2500


def _columns(exponents: Exponents, axis: int, field: LightField) -> Tensor:
    """[2 M, N] terms of one component: monomials [M, 7], each times p (first M columns) and times u (M more)."""
    m = monomials(field.invariants(mirror=True), exponents)
    return torch.cat([m * field.p[axis], m * field.u[axis]])


def mirror_exponents(degree: int, axis: int, *, dispersive: bool = True) -> Exponents:
    """[M, 7] exponents of the monomials that multiply p and u of one axis, up to a total `degree` in the invariants.

    The wavelength multiplies lower degrees only, as in `bases.invariant_exponents`.
    """
    own, other = (0, 3) if axis == 0 else (3, 0)
    rows = []
    for w, most in enumerate([degree, degree - 2, degree - 3] if dispersive else [degree]):
        reach = range(max(most, 0) + 1)
        for rho, tau, rho_other, tau_other, sigma_other in itertools.product(reach, reach, reach, reach, (0, 1)):
            if rho + tau + rho_other + tau_other + sigma_other <= most:
                row = [0, 0, 0, 0, 0, 0, w]
                row[own], row[own + 2] = rho, tau
                row[other : other + 3] = rho_other, sigma_other, tau_other
                rows.append(tuple(row))
    return ordered(rows)


def fit_mirror(data: Prepared, method: str, terms: int, degree: int) -> MirrorPolynomial:
    """Choose and fit terms; position and direction share them, x and y have their own.

    Args:
        method: "ols" (orthogonal least squares with replacement) or "omp" (matching pursuit).
        terms: coefficients per vector output, half of them of x and half of y.
        degree: of the candidates in the invariants, twice that in the raw coordinates; lowered where there
            would be more than 2500 candidates.

    Raises:
        InputError: another method, fewer than four terms, or too few rays.
    """
    if method not in METHODS:
        raise InputError("fit", "method", method, f"{', '.join(METHODS)} or mlp, the fits of lenses with cylinders")
    if terms < 4:
        raise InputError("fit", "terms", terms, "at least 4 coefficients per vector output")
    pairs, train = data.pairs, data.train
    if len(pairs.train) <= terms:
        raise InputError("fit", "train", len(pairs.train), f"more training rays than the {terms} terms")
    dispersive = data.encoding.dispersive
    outputs = film_equivalent(pairs.lens, pairs.domain, train.vectors)
    supports: list[Exponents] = []
    sides = []  # of every column chosen, whether it is one of u
    for axis in (0, 1):
        candidates = _candidates(degree, axis, dispersive=dispersive)
        sweep = Sweep(*_normal_equations(candidates, axis, train.field, outputs[:, axis]))
        forward(sweep, terms // 2, "ols" if method == "ols" else "omp")
        if method == "ols":
            replace_terms(sweep)
        chosen, count = np.array(sorted(sweep.chosen)), len(candidates)
        supports.append(candidates[chosen % count])
        sides.append((chosen >= count).astype(int))
    exponents, places = united([*supports, _scalar_terms(dispersive=dispersive)])
    features = monomials(train.field.invariants(mirror=True), exponents)
    ab = torch.zeros((3, 2, 2, len(exponents)), dtype=torch.float64)
    for axis, (side, place) in enumerate(zip(sides, places, strict=False)):
        vectors = torch.stack([train.field.p[axis], train.field.u[axis]])
        ab[:2, side, axis, place] = solve(features[place] * vectors[side], train.vectors[:2, axis])
    ab[STOP] = _fit_stop(data, exponents)
    scalars = solve_scalars(data, lambda field: monomials(field.invariants(mirror=True), exponents))
    return MirrorPolynomial(exponents, ab.numpy(), scalars.numpy())


def _scalar_terms(*, dispersive: bool) -> Exponents:
    """What transmittance and gates need besides: every invariant, and high powers of w, for glass that absorbs blue."""
    units = np.eye(7, dtype=np.int64)
    w = units[6]
    plain = [w * k for k in range(8 if dispersive else 1)]
    return np.array([*plain, *(e + w * k for e in units[:6] for k in range(3 if dispersive else 1))])


def _candidates(degree: int, axis: int, *, dispersive: bool) -> Exponents:
    while True:
        exponents = mirror_exponents(degree, axis, dispersive=dispersive)
        if 2 * len(exponents) <= _MOST_CANDIDATES or degree == 0:
            return exponents
        degree -= 1


def _normal_equations(
    exponents: Exponents, axis: int, field: LightField, outputs: Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gram matrix [2 M, 2 M], products with the outputs [R, N], and the outputs' squared norms [R]."""
    size = 2 * len(exponents)
    gram, moments = (torch.zeros((size, count), dtype=torch.float64) for count in (size, len(outputs)))
    for start in range(0, outputs.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        columns = _columns(exponents, axis, LightField(*(c[..., part] for c in field)))
        gram += columns @ columns.T
        moments += columns @ outputs[:, part].T
    return gram.numpy(), moments.numpy(), (outputs**2).sum(1).numpy()


def _fit_stop(data: Prepared, exponents: Exponents) -> Tensor:
    """[2, 2, M]: A and B, of x and y, of the stop crossing in stop radii, from rays on both sides of rims."""
    crossing, weight = stop_crossing(data)
    field = data.boundary_field
    found = [solve(_columns(exponents, axis, field), crossing[axis][None], weight)[0] for axis in (0, 1)]
    return torch.stack([row.reshape(2, -1) for row in found], 1)
