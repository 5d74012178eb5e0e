"""Cores of the published methods: their coordinates and their tests of who passes round plain polynomials.

What comes out is what every core gives (`neurolens.surrogates.model.Core`), so that one code measures all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurolens.surrogates.cores import RawPolynomial
from neurolens.surrogates.lightfield import LightField, angle_vector
from neurolens.surrogates.model import DIRECTION, POSITION

Three = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Cells:
    """A partition of the light field into two halves, each with a polynomial of its own or divided again.

    Attributes:
        variable: 0, 1 or 2: which invariant decides (rho, sigma, tau of the light field).
        threshold: rays above it are those of `high`.
        low, high: the halves.
    """

    variable: int
    threshold: float
    low: RawPolynomial | Cells
    high: RawPolynomial | Cells

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        beyond = field.invariants()[self.variable] > self.threshold
        low, high = self.low(field), self.high(field)
        return torch.where(beyond, high[0], low[0]), torch.where(beyond, high[1], low[1])

    def to(self, dtype: torch.dtype) -> Cells:
        return replace(self, low=self.low.to(dtype), high=self.high.to(dtype))

    @property
    def coefficients_per_vector(self) -> int:
        """Of all cells together."""
        return self.low.coefficients_per_vector + self.high.coefficients_per_vector

    @property
    def coefficients(self) -> int:
        return self.low.coefficients + self.high.coefficients


@dataclass(frozen=True, eq=False)
class OuterPupil:
    """A polynomial that gives the ray on the outer pupil: the position on a sphere, the direction in its tangent frame.

    Hanika and Dachsbacher 2014: the direction's components along the sphere's two tangents, which stay small where the
    front surface of a wide angle turns towards the ray. Two tests besides the stop's, as in the public lens code
    (crop by the inward and by the outward facing pupil): each is left out where its surface is the stop.

    Attributes:
        polynomial: vectors are position, tangent components and stop crossing; the one scalar is the transmittance.
        curvature: of the outer pupil in units of 1 / position unit, positive towards the film; 0: tangents are x and y.
        outer: position unit over the outer pupil's radius; None: no test. The second of the tests.
        inner: the crossing with the rear vertex's plane in rear radii is inner[0] p + inner[1] u; None: no test.
    """

    polynomial: RawPolynomial | Cells
    curvature: float
    outer: float | None
    inner: tuple[float, float] | None

    basis: str = "raw"

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        vectors, scalars = self.polynomial(field)
        position, tangents = vectors[POSITION], vectors[DIRECTION]
        direction = angle_vector(*from_tangents(position, tangents, self.curvature))
        tests = [] if self.inner is None else [_square(self.inner[0] * field.p + self.inner[1] * field.u) - 1]
        if self.outer is not None:
            tests.append(_square(self.outer * position) - 1)
        return torch.stack([position, direction, vectors[2]]), torch.cat([scalars, *(t[None] for t in tests)])

    def to(self, dtype: torch.dtype) -> OuterPupil:
        return replace(self, polynomial=self.polynomial.to(dtype))

    @property
    def coefficients_per_vector(self) -> int:
        return self.polynomial.coefficients_per_vector

    @property
    def coefficients(self) -> int:
        return self.polynomial.coefficients


def _square(v: Tensor) -> Tensor:
    return v[0] * v[0] + v[1] * v[1]


def tangent_frame(position: Tensor, curvature: float) -> tuple[Three, Three, Three]:
    """Unit vectors ex, ey and the normal towards the scene at points [2, N] of the sphere of the outer pupil.

    ex has no y component; on the axis ex and ey are x and y, and the normal is -z. Beyond the sphere's equator: there.
    """
    cx, cy = curvature * position[0], curvature * position[1]
    s = torch.sqrt((1 - cx * cx - cy * cy).clamp_min(0.0))
    inverse = torch.rsqrt((s * s + cx * cx).clamp_min(1e-30))
    zero = torch.zeros_like(s)
    ex = (s * inverse, zero, cx * inverse)
    ey = (-cx * cy * inverse, (cx * cx + s * s) * inverse, s * cy * inverse)
    return ex, ey, (cx, cy, -s)


def to_tangents(position: Tensor, direction: Three, curvature: float) -> Tensor:
    """[2, N] components of unit directions along the tangents at points [2, N]."""
    ex, ey, _ = tangent_frame(position, curvature)
    return torch.stack([sum(a * d for a, d in zip(e, direction, strict=True)) for e in (ex, ey)])  # type: ignore[misc]


def from_tangents(position: Tensor, tangents: Tensor, curvature: float) -> Three:
    """Unit directions of `to_tangents`; components beyond the unit circle give a ray along the surface."""
    a, b = tangents
    square = a * a + b * b
    along = torch.sqrt((1 - square).clamp_min(0.0))
    if curvature == 0:
        scale = torch.rsqrt(square.clamp_min(1.0))
        return a * scale, b * scale, -along
    ex, ey, n = tangent_frame(position, curvature)
    scale = torch.rsqrt(square.clamp_min(1.0))
    x, y, z = (scale * (a * p + b * q) + along * r for p, q, r in zip(ex, ey, n, strict=True))
    return x, y, z
