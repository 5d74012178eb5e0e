"""The common part of the published fits: raw coordinates, targets on the outer pupil, and the tests of who passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.ir import Graph, Value
from neurolens.models.cores import DIRECTION, POSITION, Array, Core, CoreValues, Field, Units, stored_as
from neurolens.models.fitted import Encoding, Gate
from neurolens.models.pairs import PairSet, RayPairs
from neurolens.models.targets import ModelSettings, Prepared, gate_reach, scales_of
from neurolens.models.terms import Exponents, monomials, ordered, powers, united

# Outputs of the published polynomials, with the parity in x and in y that mirror symmetry gives each.
OUTPUTS = ("position x", "position y", "tangent x", "tangent y", "stop x", "stop y", "transmittance")
PARITY = ((1, 0), (0, 1), (1, 0), (0, 1), (1, 0), (0, 1), (0, 0))


def raw_exponents(degree: int, *, dispersive: bool = True) -> Exponents:
    """[M, 5] exponents of p_x, p_y, u_x, u_y, w up to a total `degree`: the basis of the published lens polynomials."""
    return ordered(powers(5, degree) if dispersive else [(*p, 0) for p in powers(4, degree)])


@dataclass(frozen=True)
class PublishedSettings(ModelSettings):
    """The settings of a published method, whose names are those of `PUBLISHED`."""

    method: str = ""  # type: ignore[assignment]
    partitions: int = 1  # zones or cells with a fit of their own


def raw_rows(field: Field) -> Value:
    """p, u and, where it varies, w."""
    return field.planes.graph.concat(field.planes[0:4], field.colour()) if field.dispersive else field.planes


@stored_as("raw")
@dataclass(frozen=True, eq=False)
class RawPolynomial(Core):
    """Every component of every vector, and every scalar, is a polynomial in p_x, p_y, u_x, u_y, w: the published form.

    Attributes:
        exponents: [M, 5] int64.
        components: [3, 2, M].
        scalars: [S, M].
    """

    exponents: Exponents
    components: Array
    scalars: Array
    basis = "raw"

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        components = self.components * np.array(units.vectors)[:, None, None]
        scalars = self.scalars * units.scalars(len(self.scalars))[:, None]
        weight = np.concatenate([components.reshape(6, -1), scalars])
        x = raw_rows(field)
        used = np.ones(len(self.exponents), bool) if field.dispersive else self.exponents[:, -1] == 0
        rows = g.polynomial(self.exponents[used][:, : x.rows], weight[:, used], x)
        *vectors, transmittance, gates = g.split(rows, [2, 2, 2, 1, len(scalars) - 1])
        return CoreValues(tuple(vectors), transmittance, gates if len(scalars) > 1 else None)  # type: ignore[arg-type]

    @property
    def coefficients_per_vector(self) -> int:
        """Coefficients of both components of a vector, the larger of position and direction."""
        return int((self.components[:2] != 0).sum((1, 2)).max())

    @property
    def coefficients(self) -> int:
        return int((self.components != 0).sum() + (self.scalars != 0).sum())


@stored_as("outer-pupil")
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

    polynomial: Core
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


def outer_pupil(data: RawData, polynomial: Core, curvature: float | None = None) -> tuple[OuterPupil, tuple[Gate, ...]]:
    """The core about a polynomial, with its tests of the inner and the outer pupil, as rays meet them."""
    lens, e = data.pairs.lens, data.encoding
    last = len(lens.surfaces) - 1
    rear = float(lens.vertices_mm[last])
    # The share of the way from the film's plane to that of the pupil points.
    along = (rear - e.film_plane_z_mm) / (e.pupil_plane_z_mm - e.film_plane_z_mm)
    radius = lens.surfaces[last].semi_diameter_mm
    by_p = e.film_scale_mm * (1 + along * (e.chief - 1))
    inner = (by_p / radius, along * e.pupil_scale_mm / radius) if lens.stop_index != last else None
    outer = 1.0 if lens.stop_index != 0 else None
    core = OuterPupil(polynomial, data.curvature if curvature is None else curvature, outer, inner)
    gates = ([] if inner is None else [Gate(last, st.RIM)]) + ([] if outer is None else [Gate(0, st.RIM)])
    return core, tuple(gates)


def slope_encoding(encoding: Encoding, passing: PairSet) -> Encoding:
    """Raw coordinates: film position and slope, u = (pupil point - film point) / scale."""
    p, u = encoding.planes(passing.inputs)
    return replace(encoding, chief=1.0, pupil_scale_mm=float((u - p).norm(dim=0).max()))


@dataclass(frozen=True)
class Outputs:
    """Inputs and values [K] of one fit: variables [5, N], values [K, N], weights [N] or None for all alike."""

    variables: Tensor
    values: Tensor
    weights: Tensor | None = None


@dataclass(frozen=True)
class RawData:
    """Ray pairs in raw coordinates."""

    pairs: RayPairs
    encoding: Encoding

    @staticmethod
    def of(prepared: Prepared, centred: bool = False) -> RawData:
        """Position and slope; `centred`: the slope less its chief-ray part, which float32 evaluates with less rounding.

        Polynomials of all terms to a total degree are the same functions of both.

        Raises:
            InputError: a lens with cylinders.
        """
        encoding = prepared.encoding
        if encoding.mirror:
            expected = "a lens that is round about its axis, for a published method"
            raise InputError("fit", "lens", "(cylinders)", expected)
        return RawData(prepared.pairs, encoding if centred else slope_encoding(encoding, prepared.pairs.train))

    @property
    def dispersive(self) -> bool:
        return self.encoding.dispersive

    @property
    def curvature(self) -> float:
        """The curvature of the outer pupil in units of 1 / position unit."""
        return float(self.pairs.lens.surfaces[0].vertex_curvature("x")) * scales_of(self.pairs.lens).position_mm

    def variables(self, rays: PairSet) -> Tensor:
        """[5, N] x, y, slopes, w."""
        field = self.encoding(rays.inputs)
        return torch.cat([field.p, field.u, field.w[None]])

    @cached_property
    def outputs(self) -> tuple[Outputs, ...]:
        """The fits of `OUTPUTS`: ray and transmittance on the training rays, the stop crossing about its rim too.

        The published fits discard blocked rays; on those alone the edge of the stop would lie at the edge of the data.
        """
        lens, train, rim = self.pairs.lens, self.pairs.train, self.pairs.rim
        scale, k = scales_of(lens), lens.stop_index
        position = torch.stack([train.scene.x, train.scene.y]) / scale.position_mm
        tangents = to_tangents(position, train.scene[3:], self.curvature)
        inside, about = self.variables(train), self.variables(rim)
        crossing = torch.stack([rim.cross_x[k], rim.cross_y[k]]) / scale.stop_mm
        arrives = gate_reach((Gate(k, st.RIM),), rim)[0]
        weights = None if arrives.all() else arrives.to(crossing.dtype)
        rays = [Outputs(inside, row[None]) for row in (*position, *tangents)]
        stops = [Outputs(about, row[None], weights) for row in crossing]
        return (*rays, *stops, Outputs(inside, train.transmittance[None]))


def parity_exponents(degree: int, odd: tuple[int, int], *, dispersive: bool) -> Exponents:
    """Raw exponents to a total degree of the parity that an output has in (x, x slope) and in (y, y slope).

    The others' coefficients vanish by the mirror symmetry of the lens.
    """
    rows = raw_exponents(degree, dispersive=dispersive)
    chosen = ((rows[:, 0] + rows[:, 2]) % 2 == odd[0]) & ((rows[:, 1] + rows[:, 3]) % 2 == odd[1])
    return np.asarray(rows[chosen])


def solve_outputs(outputs: tuple[Outputs, ...], supports: list[Exponents]) -> RawPolynomial:
    """Least squares of every output on a support of its own, as one polynomial on the union of the supports."""
    exponents, columns = united(supports)
    rows = torch.zeros((len(outputs), len(exponents)), dtype=torch.float64)
    for row, output, support, at in zip(rows, outputs, supports, columns, strict=True):
        row[at] = stable_solve(monomials(output.variables, support), output.values, output.weights)[0]
    return raw_polynomial(exponents, rows)


def raw_polynomial(exponents: Exponents, rows: Tensor) -> RawPolynomial:
    """The polynomial of coefficients [7, M] in the order of `OUTPUTS`."""
    return RawPolynomial(exponents, rows[:6].reshape(3, 2, -1).numpy(), rows[6:].numpy())


def stable_solve(columns: Tensor, outputs: Tensor, weights: Tensor | None = None, cut: float = 1e-7) -> Tensor:
    """Least squares as `terms.solve`, with singular values cut where float32 could not evaluate what they add.

    Raw coordinates of a wide angle are nearly dependent (the slope follows the position), and plain least squares then
    gives large terms that cancel. `cut` is relative to the largest singular value of columns of unit length.
    """
    if weights is not None:
        columns, outputs = columns * weights, outputs * weights
    norms = columns.norm(dim=1).clamp_min(1e-300)
    q, r = torch.linalg.qr((columns / norms[:, None]).T)
    found = torch.linalg.lstsq(r, q.T @ outputs.T, rcond=cut, driver="gelsd").solution
    return (found / norms[:, None]).T
