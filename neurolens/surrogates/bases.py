"""Candidate terms of polynomials, their columns, and least squares.

Terms are monomials of the invariants (times p or u), or of the raw coordinates.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.graph.interpret import monomials as monomials
from neurolens.surrogates.lightfield import LightField

Exponents = NDArray[np.int64]

ROUNDING = 2.0**-24  # of float32


def invariant_exponents(degree: int, *, dispersive: bool = True) -> Exponents:
    """[M, 4] exponents of rho, sigma, tau, w up to a total `degree` in the first three.

    The wavelength multiplies lower degrees only: the index is nearly linear in w, and dispersion is small beside
    refraction. w^1 goes with degrees up to degree - 2, w^2 with degree - 4, w^3 with degree - 5.
    """
    reach = [degree, degree - 2, degree - 4, degree - 5] if dispersive else [degree]
    rows = [
        (*powers, w)
        for w, most in enumerate(reach)
        for powers in itertools.product(range(max(most, 0) + 1), repeat=3)
        if sum(powers) <= most
    ]
    return ordered(rows)


def raw_exponents(degree: int, *, dispersive: bool = True) -> Exponents:
    """[M, 5] exponents of p_x, p_y, u_x, u_y, w up to a total `degree`: the basis of the published lens polynomials."""
    variables = 5 if dispersive else 4
    rows = [r for r in itertools.product(range(degree + 1), repeat=variables) if sum(r) <= degree]
    return ordered([(*r, 0) for r in rows] if not dispersive else rows)


def ordered(rows: Sequence[tuple[int, ...]]) -> Exponents:
    """[M, V] exponents, the lowest degree first."""
    return np.array(sorted(rows, key=lambda r: (sum(r), r)), dtype=np.int64)


def united(supports: Sequence[Exponents]) -> tuple[Exponents, list[list[int]]]:
    """Every exponent of several supports once, in the order in which they come, and the places of each support's."""
    place: dict[tuple[int, ...], int] = {}
    columns = [[place.setdefault(tuple(map(int, e)), len(place)) for e in support] for support in supports]
    return np.array(list(place), dtype=np.int64), columns


def kept(exponents: Exponents, chosen: Sequence[int]) -> tuple[Exponents, list[int]]:
    """Exponents that chosen columns of `vector_columns` need, and where those columns are among these exponents'."""
    count = len(exponents)
    rows = sorted({k % count for k in chosen})
    place = {k: i for i, k in enumerate(rows)}
    return exponents[rows], [place[k % count] + (k >= count) * len(rows) for k in chosen]


def raw_variables(field: LightField) -> Tensor:
    """[5, N]: p_x, p_y, u_x, u_y, w."""
    return torch.cat([field.p, field.u, field.w[None]])


def vector_columns(features: Tensor, field: LightField) -> Tensor:
    """[2 M, 2 N] columns m p and m u of features m [M, N]; both components of a ray stand in one row of 2 N entries."""
    halves = [torch.cat([features * v[0], features * v[1]], 1) for v in (field.p, field.u)]
    return torch.cat(halves)


def vector_gram(
    features: Tensor, field: LightField, outputs: Tensor
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gram matrix [2 M, 2 M] of the columns of `vector_columns`, and their products [2 M, R] with outputs [R, 2, N].

    Formed from rho, sigma and tau, since (m p).(m' u) = m m' sigma: the long columns are never stored.
    """
    rho, sigma, tau, _ = field.invariants()
    pp, pu, uu = (_products(features, s) for s in (rho, sigma, tau))
    gram = torch.cat([torch.cat([pp, pu], 1), torch.cat([pu, uu], 1)])
    along_p, along_u = ((outputs * v).sum(1) for v in (field.p, field.u))
    moments = torch.cat([features @ along_p.T, features @ along_u.T])
    return gram.numpy(), moments.numpy()


def _products(features: Tensor, weights: Tensor) -> Tensor:
    """[M, M] sums over rays of features [M, N] times each other, weighted by [N]: symmetric, a third is not summed."""
    found = features.new_empty((len(features), len(features)))
    size = -(-len(features) // 3)
    for start in range(0, len(features), max(size, 1)):
        rows = slice(start, start + size)
        part = (features[rows] * weights) @ features[start:].T
        found[rows, start:], found[start:, rows] = part, part.T
    return found


def solve(columns: Tensor, outputs: Tensor, weights: Tensor | None = None) -> Tensor:
    """Least squares: coefficients [R, C] with coefficients @ columns [C, N] near outputs [R, N], rows weighted by [N].

    A ridge stands for the rounding of float32, in which models are evaluated: each term then errs by about `ROUNDING`
    of its own size, and the sum of these squares is part of what is minimised. So dependent columns share their effect
    instead of blowing up, and columns that are 0 get 0.
    """
    if weights is not None:
        columns, outputs = columns * weights, outputs * weights
    norms = columns.norm(dim=1)
    norms = torch.where(norms > 0, norms, 1.0)
    scaled = (columns / norms[:, None]).T
    # The Gram matrix would square the condition; QR first, then the small factor by singular values.
    q, r = torch.linalg.qr(scaled)
    ridge = ROUNDING * torch.eye(len(columns), dtype=r.dtype)
    rows, wanted = torch.cat([r, ridge]), q.T @ outputs.T
    padded = torch.cat([wanted, wanted.new_zeros((len(columns), wanted.shape[1]))])
    found = torch.linalg.lstsq(rows, padded, rcond=1e-13, driver="gelsd").solution
    return (found / norms[:, None]).T


@contextmanager
def pinned_threads() -> Iterator[None]:
    """Give torch one thread inside the block: the same bits anywhere, and no crawling on a shared machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
