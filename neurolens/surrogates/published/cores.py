"""Cores of the published methods: their coordinates and their tests of who passes round plain polynomials.

What comes out is what every core gives (`neurolens.surrogates.cores.Core`), so that one code measures and writes all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurolens.graph.ir import Graph, Value
from neurolens.surrogates.cores import DIRECTION, POSITION, ROUND, Core, CoreValues, Field, RawPolynomial, Units

Three = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Cells(Core):
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

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        low, high = (half.build(g, field, units) for half in (self.low, self.high))
        return low.chosen(field.products(ROUND[self.variable : self.variable + 1], w=False) <= self.threshold, high)

    @property
    def coefficients_per_vector(self) -> int:
        """Of all cells together."""
        return self.low.coefficients_per_vector + self.high.coefficients_per_vector

    @property
    def coefficients(self) -> int:
        return self.low.coefficients + self.high.coefficients


@dataclass(frozen=True, eq=False)
class OuterPupil(Core):
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
    basis = "raw"

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        unit, _, stop = units.vectors
        values = self.polynomial.build(g, field, Units((unit, 1.0, stop), units.gates))
        position, gates = values.vectors[POSITION], []
        if self.inner is not None:
            gates.append(g.square(field.p * self.inner[0] + field.u * self.inner[1]))
        if self.outer is not None:
            gates.append(g.square(position * (self.outer / unit)))
        tests = g.concat(*((r2 - 1.0) * units.gates for r2 in gates)) if gates else None
        direction = from_tangents(position, values.vectors[DIRECTION], self.curvature / unit)
        return replace(values, unit=direction, gates=tests)

    @property
    def coefficients_per_vector(self) -> int:
        return self.polynomial.coefficients_per_vector

    @property
    def coefficients(self) -> int:
        return self.polynomial.coefficients


def to_tangents(position: Tensor, direction: Sequence[Tensor], curvature: float) -> Tensor:
    """[2, N] components of unit directions along the tangents of the outer pupil's sphere at points [2, N].

    ex = (s, 0, cx) / l has no y component, ey = (-cx cy, l^2, s cy) / l, with c the curvature, s^2 = 1 - |c (x, y)|^2
    and l^2 = s^2 + cx^2; the normal towards the scene is (cx, cy, -s). On the axis ex and ey are x and y. Beyond the
    sphere's equator: there.
    """
    cx, cy = curvature * position[0], curvature * position[1]
    s = torch.sqrt((1 - cx * cx - cy * cy).clamp_min(0.0))
    inverse = torch.rsqrt((s * s + cx * cx).clamp_min(1e-30))
    ex = (s * inverse, torch.zeros_like(s), cx * inverse)
    ey = (-cx * cy * inverse, (cx * cx + s * s) * inverse, s * cy * inverse)
    return torch.stack([sum(a * d for a, d in zip(e, direction, strict=True)) for e in (ex, ey)])  # type: ignore[misc]


def from_tangents(position: Value, tangents: Value, curvature: float) -> Value:
    """Unit directions (3 rows) of `to_tangents`; components beyond the unit circle give a ray along the surface."""
    g = position.graph
    square = g.square(tangents)
    along = (1.0 - square).maximum(0.0).sqrt()
    tangents = tangents * (1.0 / square.maximum(1.0).sqrt())
    if curvature == 0:
        return g.concat(tangents, -along)
    normal = position * curvature
    s2 = (1.0 - g.square(normal)).maximum(0.0)
    s, (a, b), (cx, cy) = s2.sqrt(), g.split(tangents, [1, 1]), g.split(normal, [1, 1])
    length2 = s2 + cx * cx
    inverse = 1.0 / length2.maximum(1e-30).sqrt()
    a, b = a * inverse, b * inverse
    x = a * s - b * cx * cy + along * cx
    y = b * length2 + along * cy
    return g.concat(x, y, a * cx + b * cy * s - along * s)
