"""Ray-transfer functions (Goossens et al. 2022): rays turned into a meridian, dense polynomials, an elliptic pupil.

Every ray is turned about the axis until its point in the input plane lies on the y axis; one dense polynomial per
output maps (y, dx, dy), of a unit direction, to the position on the output surface and to the direction (dx, dy, dz,
normalised), which is then turned back. A ray passes where it crosses the pupil plane within an ellipse whose centre
and radii depend on y: that of least area about the exact passing rays at a number of y, linear between them.

The pass function belongs to one stop: the model knows no stop crossing (its stop output is 0), and a smaller stop
would need a new fit. Left open by the paper and chosen here: the input plane is the film's at infinity focus, the
output surface the front surface; the paper has one fit a wavelength, here the coefficients are parabolas in
1 / lambda^2 fitted on all rays at once, and one ellipse serves all wavelengths; the transmittance, which they leave
out, is one polynomial more of the same terms.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError  # type: ignore[import-untyped]
from torch import Tensor

from experiments.accuracy.published.data import RawData, stable_solve
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.ir import Graph, Value
from neurolens.models.cores import Core, CoreValues, Field, LightField, Units, stored_as
from neurolens.models.fitted import FilmRays, Gate
from neurolens.models.pairs import trace_pairs
from neurolens.models.targets import scales_of
from neurolens.models.terms import Exponents, monomials

Array = NDArray[np.float64]
# Positions of the input plane at which the ellipse is fitted, and rays of each.
POSITIONS = 33
_RAYS = 6000


@stored_as("meridian")
@dataclass(frozen=True, eq=False)
class Meridian(Core):
    """The core: polynomials in the meridian of the ray, and the elliptic pass function.

    Attributes:
        exponents: [M, 4] int64 of y, dx, dy, w.
        outputs: [6, M]: across and along the meridian of the position (scaled), the same of the direction, its part
            against z, transmittance.
        slope: slope of the ray per unit of u.
        pupil: u in mm on the pupil plane, so that the crossing is film p + pupil u.
        film: p in mm.
        knots: [K] y (in units of p) at which the ellipse was fitted.
        ellipse: [K, 3]: radius across, radius along, centre along the meridian (mm).
    """

    exponents: Exponents
    outputs: Array
    slope: float
    pupil: float
    film: float
    knots: Array
    ellipse: Array
    basis = "raw"

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        p, u, unit = field.p, field.u, units.vectors[0]
        radius, y = meridian_of(p)
        slope = u * self.slope
        along = 1.0 / (g.square(slope) + 1.0).sqrt()
        x = g.concat(radius, g.concat(*turn(slope, y)) * along)
        exponents, weight = self.exponents, self.outputs * np.array([unit, unit, 1, 1, 1, 1])[:, None]
        if field.dispersive:
            x = g.concat(x, field.colour())
        else:
            used = exponents[:, 3] == 0
            exponents, weight = exponents[used][:, :3], weight[:, used]
        position, direction, transmittance = g.split(g.polynomial(exponents, weight, x), [2, 3, 1])
        direction = direction * (1.0 / g.square(direction).sqrt())
        position = turned_back(position, y)
        crossing = turn(p * self.film + u * self.pupil, y)
        vectors = (position, position, position * 0.0)
        gate = (self._ellipse(radius, crossing) - 1.0) * units.gates
        return CoreValues(vectors, transmittance, gate, g.concat(turned_back(direction[0:2], y), -direction[2]))

    def _ellipse(self, radius: Value, crossing: tuple[Value, Value]) -> Value:
        """Squared place of a crossing in the ellipse at a radius: above 1 outside. Piecewise linear by hinges."""
        g = radius.graph
        slopes = np.diff(self.ellipse, axis=0) / np.diff(self.knots)[:, None]
        bends = np.concatenate([slopes[:1], np.diff(slopes, axis=0)]).T
        hinges = g.affine(np.ones((len(self.knots) - 1, 1)), radius, -self.knots[:-1]).maximum(0.0)
        across, along, centre = g.split(g.affine(bends, hinges, self.ellipse[0]), [1, 1, 1])
        a, b = crossing[0] / across, (crossing[1] - centre) / along
        return a * a + b * b

    @property
    def coefficients_per_vector(self) -> int:
        """The coefficients of the direction, which has three outputs."""
        return int((self.outputs[2:5] != 0).sum())

    @property
    def coefficients(self) -> int:
        return int((self.outputs != 0).sum()) + self.ellipse.size


def meridian_of(p: Value) -> tuple[Value, tuple[Value, Value]]:
    """The length of p, and the components of the unit vector along it; on the axis the y axis itself."""
    g, rho = p.graph, p.graph.square(p)
    radius, on_axis = rho.sqrt(), rho <= 0.0
    safe = g.select(on_axis, 1.0, radius)
    return radius, (p[0] / safe, g.select(on_axis, 1.0, p[1] / safe))


def turned_back(v: Value, y: tuple[Value, Value]) -> Value:
    """The inverse of `turn`."""
    a, b = v.graph.split(v, [1, 1])
    return v.graph.concat(a * y[1] + b * y[0], b * y[1] - a * y[0])


def _meridian(p: Tensor) -> Tensor:
    """[2, N] unit vectors along p; along y on the axis."""
    radius = torch.hypot(p[0], p[1])
    off = radius > 0
    safe = torch.where(off, radius, 1.0)
    return torch.stack([torch.where(off, p[0] / safe, 0.0), torch.where(off, p[1] / safe, 1.0)])


def turn(v: Any, y: Any) -> tuple[Any, Any]:
    """Components of v across and along the meridian y, two rows each: y is turned into the y axis."""
    return v[0] * y[1] - v[1] * y[0], v[0] * y[0] + v[1] * y[1]


def meridian_variables(field: LightField, slope: float) -> tuple[Tensor, Tensor]:
    """[4, N] y, dx, dy, w of turned rays, and the meridians [2, N]."""
    y = _meridian(field.p)
    rise = torch.stack(turn(slope * field.u, y))
    unit = rise * torch.rsqrt(1 + rise[0] * rise[0] + rise[1] * rise[1])
    return torch.stack([torch.hypot(field.p[0], field.p[1]), *unit, field.w]), y


def meridian_exponents(degree: int, *, dispersive: bool) -> Exponents:
    """[M, 4] all exponents of y, dx, dy to a total degree, each with w^0, w^1 and w^2."""
    rows = [e for e in itertools.product(range(degree + 1), repeat=3) if sum(e) <= degree]
    return np.array([(*e, w) for w in range(3 if dispersive else 1) for e in rows], dtype=np.int64)


def fit_rtf(data: RawData, degree: int) -> tuple[Meridian, tuple[Gate, ...]]:
    """Fit the polynomials on the training rays, and the ellipses on rays traced for them."""
    e, train, lens = data.encoding, data.pairs.train, data.pairs.lens
    slope = e.pupil_scale_mm / (e.film_plane_z_mm - e.pupil_plane_z_mm)
    field = e(train.inputs)
    variables, y = meridian_variables(field, slope)
    scene = train.scene
    position = turn(torch.stack([scene.x, scene.y]) / scales_of(lens).position_mm, y)
    direction = turn(torch.stack([scene.dx, scene.dy]), y)
    values = torch.stack([*position, *direction, -scene.dz])
    exponents = meridian_exponents(degree, dispersive=data.dispersive)
    if len(train) <= len(exponents):
        raise InputError("fit", "train", len(train), f"more training rays than the {len(exponents)} terms")
    columns = monomials(variables, exponents)
    # A coarser cut for the transmittance, which varies little: in float32 its rounding would show first.
    outputs = torch.cat([stable_solve(columns, values), stable_solve(columns, train.transmittance[None], cut=1e-5)])
    knots, ellipse = fit_ellipses(data)
    core = Meridian(exponents, outputs.numpy(), slope, e.pupil_scale_mm, e.film_scale_mm, knots, ellipse)
    return core, (Gate(0 if lens.stop_index else len(lens.surfaces) - 1, st.RIM),)


def fit_ellipses(data: RawData) -> tuple[Array, Array]:
    """Knots [K] (in units of p) and ellipses [K, 3] (radius across and along, centre along; mm on the pupil plane).

    Positions where no three rays pass take the ellipse of their neighbour towards the axis.
    """
    e = data.encoding
    knots = np.linspace(0, 1, POSITIONS)
    rows: list[tuple[float, float, float]] = []
    for knot in knots:
        crossings = _passing(data, float(knot) * e.film_scale_mm)
        if len(crossings) >= 3:
            rows.append(least_ellipse(crossings))
        elif rows:
            rows.append(rows[-1])
    while len(rows) < POSITIONS:
        rows.insert(0, rows[0] if rows else (1e-9, 1e-9, 0.0))
    return knots, np.array(rows)


def _passing(data: RawData, y_mm: float) -> Array:
    """[K, 2] where passing rays from height y in the input plane cross the pupil plane, across and along."""
    domain = data.pairs.domain
    points = torch.quasirandom.SobolEngine(3, scramble=True, seed=17).draw(_RAYS, dtype=torch.float64).T
    radius, angle = domain.pupil_radius_mm * torch.sqrt(points[0]), 2 * torch.pi * points[1]
    low, high = domain.wavelength_nm
    zero = torch.zeros_like(radius)
    plane = zero + data.encoding.film_plane_z_mm
    crossing = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)])
    rays = FilmRays(zero, zero + y_mm, plane, crossing[0], crossing[1], low + (high - low) * points[2])
    passed = trace_pairs(data.pairs.lens, rays, domain.pupil_z_mm, power=False).status == st.PASSED
    return np.asarray(crossing[:, passed].T.numpy(), dtype=np.float64)


def least_ellipse(points: Array, tolerance: float = 1e-4) -> tuple[float, float, float]:
    """Radius along x, radius along y and centre on the y axis of the least ellipse about points and mirror images.

    The mirror is the y axis, x -> -x: the ellipse then has its centre on it and its axes along x and y. Khachiyan 1996,
    with the steps of Todd and Yildirim 2007; the area is right to about `tolerance`, and all points lie inside.

    Args:
        points: [K, 2], at least one.
    """
    both = np.concatenate([points, points * [-1, 1]])
    size = max(float(np.ptp(both, axis=0).max()), 1e-12)
    try:
        both = both[ConvexHull(both).vertices]
    except (QhullError, ValueError):
        half = np.ptp(both, axis=0) / 2  # points on a line
        return max(float(half[0]), 1e-9 * size), max(float(half[1]), 1e-9 * size), float(both[:, 1].mean())
    centre_y, scale = both[:, 1].mean(), size / 2
    lifted = np.concatenate([both[:, :1], both[:, 1:] - centre_y, np.full((len(both), 1), scale)], axis=1).T / scale
    weights = np.full(len(both), 1 / len(both))
    for _ in range(2000):
        inverse = np.linalg.inv((lifted * weights) @ lifted.T)
        distance = np.einsum("ik,ij,jk->k", lifted, inverse, lifted)
        far = int(distance.argmax())
        near = int(np.where(weights > 1e-12, distance, np.inf).argmin())
        excess, lack = distance[far] / 3 - 1, 1 - distance[near] / 3
        if max(excess, lack) <= tolerance:
            break
        k = far if excess >= lack else near
        step = (distance[k] - 3) / (3 * (distance[k] - 1))
        step = max(step, -weights[k] / (1 - weights[k])) if weights[k] < 1 else step
        weights *= 1 - step
        weights[k] += step
    centre = both.T @ weights
    spread = ((both - centre).T * weights) @ (both - centre)
    radii = np.sqrt(2 * np.diag(spread))
    # The last ten thousandth: grow until every point is inside.
    outside = np.sqrt((((both - [0.0, centre[1]]) / radii) ** 2).sum(1).max())
    return float(radii[0] * outside), float(radii[1] * outside), float(centre[1])
