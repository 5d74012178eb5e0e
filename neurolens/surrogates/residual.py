"""A polynomial and a small network on what the polynomial leaves, both on the same invariants, added.

The polynomial takes the bulk, which is smooth and of low degree; the network the fine structure. Stop crossing,
transmittance and gates are fitted on the polynomial's terms too, so that the network corrects every output.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from neurolens.surrogates.cores import Basis, InvariantPolynomial, Network
from neurolens.surrogates.lightfield import LightField


@dataclass(frozen=True, eq=False)
class Residual:
    """The sum of a polynomial and a network.

    Attributes:
        parts: the two.
    """

    parts: tuple[InvariantPolynomial, Network]

    basis: Basis = "invariants"

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        (vectors, scalars), (more_vectors, more_scalars) = (part(field) for part in self.parts)
        return vectors + more_vectors, scalars + more_scalars

    def to(self, dtype: torch.dtype) -> Residual:
        polynomial, network = self.parts
        return Residual((polynomial.to(dtype), network.to(dtype)))

    @cached_property
    def coefficients_per_vector(self) -> int:
        """Of both: the polynomial's per vector and all of the network's."""
        return sum(part.coefficients_per_vector for part in self.parts)

    @cached_property
    def coefficients(self) -> int:
        return sum(part.coefficients for part in self.parts)
