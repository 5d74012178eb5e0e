"""First guesses of inverse maps: polynomials in the invariants of the inputs of the inverse, fitted directly.

The inverse of an equivariant map is equivariant, so it has the same form as the map itself: every output vector is
A a + B b of the two input vectors a and b, with A and B polynomials in a.a, a.b, b.b, w and one more variable z (or in
the invariants of two mirrors).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neurolens.graph.interpret import monomials
from neurolens.surrogates.bases import Exponents, solve
from neurolens.surrogates.fits.selection import Sweep, forward
from neurolens.surrogates.lightfield import LightField

# Rays of a fit: the Gram matrix of all candidates takes a second.
_MOST_RAYS = 12_000


@dataclass(frozen=True, eq=False)
class Guess:
    """K vectors from two.

    Attributes:
        exponents: [M, 5 or 8] int64: the invariants of `LightField`, then z.
        ab: [K, 2, 1 or 2, M]: A and B of each vector, for both components or for x and y by themselves.
    """

    exponents: Exponents
    ab: Tensor

    @property
    def mirror(self) -> bool:
        return self.ab.shape[2] == 2

    @property
    def coefficients(self) -> int:
        return int((self.ab != 0).sum())

    def __call__(self, field: LightField, z: Tensor) -> Tensor:
        """[K, 2, N] vectors for inputs a, b (the p and u of `field`), w, and z [N]."""
        m = monomials(_variables(field, z, self.mirror), self.exponents)
        out = (self.ab.flatten(0, 2) @ m).reshape(*self.ab.shape[:3], -1)
        return out[:, 0] * field.p + out[:, 1] * field.u

    def to(self, dtype: torch.dtype) -> Guess:
        return replace(self, ab=self.ab.to(dtype))


def _variables(field: LightField, z: Tensor, mirror: bool) -> Tensor:
    return torch.cat([field.mirror_invariants() if mirror else field.invariants(), z[None]])


def fit_guess(
    field: LightField, z: Tensor, outputs: Tensor, weight: Tensor, *, mirror: bool, terms: int, degree: int
) -> Guess:
    """Choose terms by orthogonal least squares and fit them.

    Args:
        field, z: inputs as of `Guess`, [.., N]. outputs: [K, 2, N], of unit order. weight: [N].
        terms: columns (of A and B together) that the K vectors share. degree: largest total degree of the invariants.
    """
    exponents = _candidates(degree, mirror, bool(field.w.any()), bool(z.any()))
    part = slice(0, _MOST_RAYS)
    columns = _columns(field, z, exponents, mirror, part) * weight[part]  # [2 M, 2, n]
    count = len(exponents)
    wanted = outputs[..., part] * weight[part]
    supports = []
    for axes in ([0], [1]) if mirror else ([0, 1],):
        d, o = columns[:, axes].flatten(1), wanted[:, axes].flatten(1)
        sweep = Sweep((d @ d.T).numpy(), (d @ o.T).numpy(), (o * o).sum(1).numpy())
        forward(sweep, min(terms, 2 * count))
        supports.append(sorted(sweep.chosen))
    kept = sorted({k % count for support in supports for k in support})
    place = {k: i for i, k in enumerate(kept)}
    all_columns = _columns(field, z, exponents[kept], mirror, slice(None)) * weight
    ab = torch.zeros((len(outputs), 2, len(supports), len(kept)), dtype=torch.float64)
    for i, support in enumerate(supports):
        axes = [i] if mirror else [0, 1]
        rows = [place[k % count] + (k >= count) * len(kept) for k in support]
        found = solve(all_columns[rows][:, axes].flatten(1), (outputs * weight)[:, axes].flatten(1))
        for column, k in enumerate(support):
            ab[:, int(k >= count), i, place[k % count]] = found[:, column]
    return Guess(exponents[kept], ab)


def _candidates(degree: int, mirror: bool, dispersive: bool, moves: bool) -> Exponents:
    """Exponents up to a total degree; w and z multiply lower degrees only."""
    variables = 6 if mirror else 3
    most = min(degree, 3) if mirror else degree
    rows = [
        (*powers, w, z)
        for w in range(3 if dispersive else 1)
        for z in range(3 if moves else 1)
        for powers in itertools.product(range(most + 1), repeat=variables)
        if sum(powers) + 2 * w + z + w * z <= most or (sum(powers) == 0 and w + z <= 2)
    ]
    return np.array(sorted(rows, key=lambda r: (sum(r), r)), dtype=np.int64)


def _columns(field: LightField, z: Tensor, exponents: Exponents, mirror: bool, part: slice) -> Tensor:
    """[2 M, 2, n] candidate columns m a and m b."""
    f = LightField(field.p[:, part], field.u[:, part], field.w[part])
    m = monomials(_variables(f, z[part], mirror), exponents)[:, None]
    return torch.cat([m * f.p, m * f.u])
