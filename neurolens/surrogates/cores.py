"""The cores of surrogates: a polynomial in the invariants, a polynomial in the raw coordinates, a small network.

Each maps a light field to vectors [3, 2, N] (position, direction, stop; scaled) and scalars [1 + G, N]
(transmittance, gates), and is plain data: what the ONNX graph needs is in its fields.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.surrogates.lightfield import LightField

if TYPE_CHECKING:
    from neurolens.surrogates.residual import Residual

Basis = Literal["invariants", "raw"]


def monomials(variables: Tensor, exponents: NDArray[np.int64]) -> Tensor:
    """[M, N] products of powers of `variables` [V, N], for exponents [M, V]."""
    powers = [torch.ones_like(variables)]
    for _ in range(int(exponents.max(initial=0))):
        powers.append(powers[-1] * variables)
    out = torch.ones((len(exponents), variables.shape[1]), dtype=variables.dtype, device=variables.device)
    for row, exponent in enumerate(exponents):
        for v, e in enumerate(exponent):
            if e:
                out[row] *= powers[e][v]
    return out


@dataclass(frozen=True, eq=False)
class InvariantPolynomial:
    """out = A p + B u, with A, B and the scalars polynomials in rho, sigma, tau, w.

    Attributes:
        exponents: [M, 4] int64 of rho, sigma, tau, w; rows are unique.
        ab: [3, 2, M]: for each vector, the coefficients of A and of B.
        scalars: [S, M].
    """

    exponents: NDArray[np.int64]
    ab: Tensor
    scalars: Tensor

    basis: Basis = "invariants"

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        m = monomials(field.invariants(), self.exponents)
        a, b = self.ab[:, 0] @ m, self.ab[:, 1] @ m  # [3, N]
        return a[:, None] * field.p + b[:, None] * field.u, self.scalars @ m

    def to(self, dtype: torch.dtype) -> InvariantPolynomial:
        return replace(self, ab=self.ab.to(dtype), scalars=self.scalars.to(dtype))

    @cached_property
    def coefficients_per_vector(self) -> int:
        return int((self.ab[:2] != 0).any(0).sum())

    @cached_property
    def coefficients(self) -> int:
        return int((self.ab != 0).sum() + (self.scalars != 0).sum())


@dataclass(frozen=True, eq=False)
class MirrorPolynomial:
    """Of a lens with two planes of symmetry: out_x = A_x p_x + B_x u_x, and y likewise.

    Attributes:
        exponents: [M, 7] int64 of `LightField.mirror_invariants`; rows are unique.
        ab: [3, 2, 2, M]: for each vector, A and B, of x and of y.
        scalars: [S, M].
    """

    exponents: NDArray[np.int64]
    ab: Tensor
    scalars: Tensor

    basis: str = "mirror"

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        m = monomials(field.mirror_invariants(), self.exponents)
        a, b = (self.ab[:, i] @ m for i in (0, 1))  # [3, 2, N]
        return a * field.p + b * field.u, self.scalars @ m

    def to(self, dtype: torch.dtype) -> MirrorPolynomial:
        return replace(self, ab=self.ab.to(dtype), scalars=self.scalars.to(dtype))

    @cached_property
    def coefficients_per_vector(self) -> int:
        """Of one vector's two components together, the larger of position and direction."""
        return int((self.ab[:2] != 0).sum((1, 2, 3)).max())

    @cached_property
    def coefficients(self) -> int:
        return int((self.ab != 0).sum() + (self.scalars != 0).sum())


@dataclass(frozen=True, eq=False)
class RawPolynomial:
    """Every component of every vector, and every scalar, is a polynomial in p_x, p_y, u_x, u_y, w: the published form.

    Attributes:
        exponents: [M, 5] int64.
        components: [3, 2, M].
        scalars: [S, M].
    """

    exponents: NDArray[np.int64]
    components: Tensor
    scalars: Tensor

    basis: Basis = "raw"

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        m = monomials(torch.cat([field.p, field.u, field.w[None]]), self.exponents)
        return self.components @ m, self.scalars @ m

    def to(self, dtype: torch.dtype) -> RawPolynomial:
        return replace(self, components=self.components.to(dtype), scalars=self.scalars.to(dtype))

    @cached_property
    def coefficients_per_vector(self) -> int:
        """Coefficients of both components of a vector, the larger of position and direction."""
        return int((self.components[:2] != 0).sum((1, 2)).max())

    @cached_property
    def coefficients(self) -> int:
        return int((self.components != 0).sum() + (self.scalars != 0).sum())


@dataclass(frozen=True, eq=False)
class Network:
    """A multilayer perceptron from the four invariants to the coefficients A and B of each vector and to the scalars.

    Attributes:
        hidden: weight [units, inputs] and bias [units] of each tanh layer; the first takes scaled invariants.
        output: weight [6 + S, units] and bias [6 + S]; rows 2 v and 2 v + 1 are A and B of vector v, then the scalars.
            The bias of those rows is the constant part of A and B. Of a lens with cylinders 12 + S rows: A and B of x,
            then of y, of each vector.
        shift, scale: [4] each: the network sees (invariants - shift) * scale; [7] of a lens with cylinders.
    """

    hidden: tuple[tuple[Tensor, Tensor], ...]
    output: tuple[Tensor, Tensor]
    shift: Tensor
    scale: Tensor

    basis: Basis = "invariants"

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        invariants = field.mirror_invariants() if self.mirror else field.invariants()
        h = (invariants - self.shift[:, None]) * self.scale[:, None]
        for weight, bias in self.hidden:
            h = torch.tanh(weight @ h + bias[:, None])
        out = self.output[0] @ h + self.output[1][:, None]
        ab = out[: self.ab_rows].reshape(3, -1, 2, out.shape[1])  # [3, 1 or 2, 2, N]
        return ab[:, :, 0] * field.p + ab[:, :, 1] * field.u, out[self.ab_rows :]

    @property
    def mirror(self) -> bool:
        """Whether it is of a lens with cylinders."""
        return len(self.shift) == 7

    @property
    def ab_rows(self) -> int:
        """Outputs before the scalars."""
        return 12 if self.mirror else 6

    def to(self, dtype: torch.dtype) -> Network:
        return replace(
            self,
            hidden=tuple((w.to(dtype), b.to(dtype)) for w, b in self.hidden),
            output=(self.output[0].to(dtype), self.output[1].to(dtype)),
            shift=self.shift.to(dtype),
            scale=self.scale.to(dtype),
        )

    @cached_property
    def coefficients_per_vector(self) -> int:
        return self.coefficients

    @cached_property
    def coefficients(self) -> int:
        return sum(w.numel() + b.numel() for w, b in (*self.hidden, self.output))


@dataclass(frozen=True, eq=False)
class Partitioned:
    """Cores of zones of the light field, split by rho (the squared film radius): the published light-field partition.

    Attributes:
        edges: rising values of rho between zones.
        parts: one core a zone, one more than edges.
    """

    edges: tuple[float, ...]
    parts: tuple[InvariantPolynomial | RawPolynomial | Network | Residual, ...]

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        vectors, scalars = self.parts[0](field)
        rho = field.invariants()[0]
        for edge, part in zip(self.edges, self.parts[1:], strict=True):
            beyond = rho > edge
            outer = part(field)
            vectors, scalars = torch.where(beyond, outer[0], vectors), torch.where(beyond, outer[1], scalars)
        return vectors, scalars

    def to(self, dtype: torch.dtype) -> Partitioned:
        return replace(self, parts=tuple(part.to(dtype) for part in self.parts))

    @property
    def coefficients_per_vector(self) -> int:
        """Of all zones together."""
        return sum(part.coefficients_per_vector for part in self.parts)

    @property
    def coefficients(self) -> int:
        return sum(part.coefficients for part in self.parts)
