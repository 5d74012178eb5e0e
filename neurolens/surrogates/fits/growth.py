"""Adaptive growth: candidate terms are products of terms already chosen, with no limit of degree.

After Zheng and Zheng 2017, "Adaptive sparse polynomial regression for camera lens simulation": start from the lowest
terms, choose by the residual, and let every chosen term bring its products with each variable into the candidates.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neurolens.surrogates.bases import Exponents, monomials, vector_columns
from neurolens.surrogates.fits.selection import Sweep, forward, replace_terms
from neurolens.surrogates.lightfield import LightField

# Rays that decide the choice of terms; the coefficients are fitted on all of them afterwards.
SELECTION_RAYS = 6000


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
    """Choose `terms` terms by growth.

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
