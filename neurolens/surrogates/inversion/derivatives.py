"""Derivatives of surrogates: how the scene ray and the stop crossing change with film point, pupil point, wavelength.

Every core is a function of the light field ray by ray, so its Jacobian is six small vectors a ray. Polynomials are
differentiated term by term: the derivatives are polynomials in (nearly) the same monomials, so that one matrix product
gives values and slopes. Ray differentials: Igehy 1999, "Tracing Ray Differentials".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from neurolens.graph.interpret import monomials
from neurolens.surrogates.cores import (
    DIRECTION,
    POSITION,
    STOP,
    Core,
    InvariantPolynomial,
    MirrorPolynomial,
    Network,
    Partitioned,
    RawPolynomial,
)
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.lightfield import Encoding, LightField, direction_of, direction_of_slope
from neurolens.surrogates.model import LensModel, Prediction

# Vectors [K, 2, N] of a core, and their slopes [K, 2, 5, N] with respect to p_x, p_y, u_x, u_y, w.
VectorSlopes = tuple[Tensor, Tensor]
SlopeFunction = Callable[[LightField], VectorSlopes]
ALL = (POSITION, DIRECTION, STOP)


def slopes_of(core: Core, dtype: torch.dtype = torch.float64, vectors: Sequence[int] = ALL) -> SlopeFunction:
    """A function from light fields to the vectors asked for and their derivatives.

    Analytic for the polynomials and networks of this package and their partitions; any other core is differentiated
    in forward mode by torch.
    """
    wanted = list(vectors)
    cast = core.to(dtype)
    if isinstance(core, InvariantPolynomial | MirrorPolynomial):
        return _SymmetricSlopes.of(core, dtype, wanted)
    if isinstance(core, RawPolynomial):
        return _RawSlopes.of(core, dtype, wanted)
    if isinstance(cast, Network):
        return _NetworkSlopes(cast, wanted)
    if isinstance(core, Partitioned):
        return _PartitionedSlopes(core.edges, [slopes_of(part, dtype, wanted) for part in core.parts])
    return lambda field: forward_mode(cast, field, wanted)


def forward_mode(core: Core, field: LightField, vectors: Sequence[int] = ALL) -> VectorSlopes:
    """Slopes of any core by torch's forward-mode differentiation, one pass a variable."""
    inputs = torch.cat([field.p, field.u, field.w[None]])

    def call(v: Tensor) -> Tensor:
        return core(LightField(v[:2], v[2:4], v[4]))[0]

    columns = []
    for k in range(5):
        tangent = torch.zeros_like(inputs)
        tangent[k] = 1
        columns.append(_along(call, (inputs,), (tangent,)))
    return call(inputs)[list(vectors)], torch.stack(columns, 2)[list(vectors)]


def _along(function: Callable[..., Tensor], inputs: tuple[Tensor, ...], tangents: tuple[Tensor, ...]) -> Tensor:
    """Derivative of a function of tensors along tangents of its inputs."""
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(v.contiguous(), t) for v, t in zip(inputs, tangents, strict=True)]
        value, slope = forward_ad.unpack_dual(function(*duals))
        return torch.zeros_like(value) if slope is None else slope


def polynomial_slopes(
    exponents: NDArray[np.int64], weight: NDArray[np.float64], variables: Sequence[int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """A polynomial with its partial derivatives.

    Args:
        exponents: [M, V]. weight: [R, M]. variables: those to differentiate by.

    Returns exponents [M', V] that hold the monomials of all of them, and weights [1 + len(variables), R, M']: first
    the polynomial, then each derivative.
    """
    place = {tuple(map(int, e)): i for i, e in enumerate(exponents)}
    used = [int(i) for i in np.flatnonzero(weight.any(0))]
    terms: list[list[tuple[int, int, int]]] = []
    for v in variables:
        rows = []
        for i in used:
            e = exponents[i]
            if e[v]:
                lower = tuple(int(x) - (j == v) for j, x in enumerate(e))
                rows.append((i, place.setdefault(lower, len(place)), int(e[v])))
        terms.append(rows)
    out = np.zeros((1 + len(terms), len(weight), len(place)))
    out[0, :, : len(exponents)] = weight
    for k, rows in enumerate(terms):
        for source, target, factor in rows:
            out[1 + k, :, target] += factor * weight[:, source]
    return np.array(list(place), dtype=np.int64).reshape(len(place), exponents.shape[1]), out


def ab_slopes(field: LightField, ab: Tensor, d_ab: Tensor) -> VectorSlopes:
    """Vectors A p + B u and their slopes.

    Args:
        ab: [K, 2, 1 or 2, N], A and B of each vector, for both components or for x and y by themselves.
        d_ab: [4 or 7, K, 2, 1 or 2, N], their derivatives by the invariants (of the axis, or of two mirrors).
    """
    p, u = field.p, field.u
    vectors = ab[:, 0] * p + ab[:, 1] * u
    by_invariant = d_ab[:, :, 0] * p + d_ab[:, :, 1] * u  # [4 or 7, K, 2, N]: gain of the vectors as each one grows
    slopes = vectors.new_empty((len(ab), 2, 5, vectors.shape[-1]))
    for i in (0, 1):
        pp, pu, uu = by_invariant[3 * i : 3 * i + 3] if len(by_invariant) == 7 else by_invariant[:3]
        slopes[:, :, i] = 2 * p[i] * pp + u[i] * pu
        slopes[:, :, 2 + i] = p[i] * pu + 2 * u[i] * uu
        slopes[:, i, i] += ab[:, 0, min(i, ab.shape[2] - 1)]
        slopes[:, i, 2 + i] += ab[:, 1, min(i, ab.shape[2] - 1)]
    slopes[:, :, 4] = by_invariant[-1]
    return vectors, slopes


@dataclass(frozen=True)
class _SymmetricSlopes:
    """Of the two polynomials in invariants."""

    exponents: NDArray[np.int64]
    weight: Tensor  # [5 or 8, K, 2, 1 or 2, M']
    mirror: bool

    @staticmethod
    def of(core: InvariantPolynomial | MirrorPolynomial, dtype: torch.dtype, vectors: list[int]) -> _SymmetricSlopes:
        ab = core.ab[vectors].to(torch.float64)
        ab = ab if ab.ndim == 4 else ab[:, :, None]  # [K, 2, 1 or 2, M]
        variables = core.exponents.shape[1]
        exponents, weight = polynomial_slopes(core.exponents, ab.flatten(0, 2).numpy(), range(variables))
        shaped = torch.from_numpy(weight).reshape(1 + variables, *ab.shape[:3], -1)
        return _SymmetricSlopes(exponents, shaped.to(dtype), variables == 7)

    def __call__(self, field: LightField) -> VectorSlopes:
        invariants = field.mirror_invariants() if self.mirror else field.invariants()
        out = (self.weight.flatten(0, 3) @ monomials(invariants, self.exponents)).reshape(*self.weight.shape[:4], -1)
        return ab_slopes(field, out[0], out[1:])


@dataclass(frozen=True)
class _RawSlopes:
    exponents: NDArray[np.int64]
    weight: Tensor  # [6, 2 K, M']
    count: int

    @staticmethod
    def of(core: RawPolynomial, dtype: torch.dtype, vectors: list[int]) -> _RawSlopes:
        rows = core.components[vectors].flatten(0, 1).to(torch.float64).numpy()
        exponents, weight = polynomial_slopes(core.exponents, rows, range(5))
        return _RawSlopes(exponents, torch.from_numpy(weight).to(dtype), len(vectors))

    def __call__(self, field: LightField) -> VectorSlopes:
        out = self.weight @ monomials(torch.cat([field.p, field.u, field.w[None]]), self.exponents)
        out = out.reshape(6, self.count, 2, -1)
        return out[0], out[1:].permute(1, 2, 0, 3)


@dataclass(frozen=True)
class _NetworkSlopes:
    core: Network
    vectors: list[int]

    def __call__(self, field: LightField) -> VectorSlopes:
        core = self.core
        invariants = field.mirror_invariants() if core.mirror else field.invariants()
        h = (invariants - core.shift[:, None]) * core.scale[:, None]
        # Derivatives by the invariants are carried along: [4 or 7, units, N], the same columns for all rays at first.
        d = torch.diag(core.scale)[:, :, None]
        for weight, bias in core.hidden:
            h = torch.tanh(weight @ h + bias[:, None])
            d = (weight @ d) * (1 - h * h)
        axes = core.ab_rows // 6
        rows = [2 * (axes * v + axis) + i for v in self.vectors for i in (0, 1) for axis in range(axes)]
        weight, bias = core.output[0][rows], core.output[1][rows]
        shape = (len(self.vectors), 2, axes, -1)
        return ab_slopes(
            field, (weight @ h + bias[:, None]).reshape(shape), (weight @ d).reshape(len(invariants), *shape)
        )


@dataclass(frozen=True)
class _PartitionedSlopes:
    edges: tuple[float, ...]
    parts: list[SlopeFunction]

    def __call__(self, field: LightField) -> VectorSlopes:
        vectors, slopes = self.parts[0](field)
        rho = field.invariants()[0]
        for edge, part in zip(self.edges, self.parts[1:], strict=True):
            outer = part(field)
            vectors = torch.where(rho > edge, outer[0], vectors)
            slopes = torch.where(rho > edge, outer[1], slopes)
        return vectors, slopes


class FieldSlopes(NamedTuple):
    """Derivatives of the light field: components of p and u change with the same component of a point only.

    `p_film`, `p_pupil`, `u_film`, `u_pupil` [2, N] (x and y) in 1/mm; `w` [N] in 1/nm.
    """

    p_film: Tensor
    p_pupil: Tensor
    u_film: Tensor
    u_pupil: Tensor
    w: Tensor


def field_slopes(encoding: Encoding, film_z: Tensor, wavelength_nm: Tensor) -> FieldSlopes:
    """Derivatives of `Encoding.__call__` with respect to film point, pupil point and wavelength."""
    e = encoding
    along = (e.film_plane_z_mm - e.pupil_plane_z_mm) / (film_z - e.pupil_plane_z_mm)
    # p = u + (film - u) along; then u - k p, both over their scales. w goes with 1 / lambda^2 in 1/um^2.
    chief, scale = (torch.tensor(v, dtype=along.dtype)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
    p_film = torch.stack([along, along]) / e.film_scale_mm
    p_pupil = torch.stack([1 - along, 1 - along]) / e.film_scale_mm
    w = -2e6 / wavelength_nm**3 / e.w_half if e.w_half else torch.zeros_like(wavelength_nm)
    return FieldSlopes(p_film, p_pupil, -chief * along / scale, (1 - chief * (1 - along)) / scale, w)


class Derivatives(NamedTuple):
    """A model's prediction and its derivatives; lens frame. Rows of a ray: x, y, z (mm), dx, dy, dz.

    Attributes:
        prediction: as `LensModel.predict` gives it.
        d_film, d_pupil: [6, 2, N] per mm of the film point's and of the pupil point's x and y, the other point held.
        d_wavelength: [6, N] per nm.
        stop_d_film, stop_d_pupil: [2, 2, N] of the stop crossing, mm per mm. stop_d_wavelength: [2, N] mm per nm.
    """

    prediction: Prediction
    d_film: Tensor
    d_pupil: Tensor
    d_wavelength: Tensor
    stop_d_film: Tensor
    stop_d_pupil: Tensor
    stop_d_wavelength: Tensor


def differentiate(model: LensModel, rays: FilmRays, stop_radius_mm: float | None = None) -> Derivatives:
    """Evaluate a model with its derivatives, in the dtype of `rays`; arguments and errors as `LensModel.predict`.

    The wavelength's derivative is at fixed film and pupil point. Where the status is not 0 the figures mean nothing.
    """
    prediction = model.predict(rays, stop_radius_mm)
    vectors, slopes = slopes_of(model.core, rays.film_x.dtype)(model.encoding(rays))
    by = field_slopes(model.encoding, rays.film_z, rays.wavelength_nm)
    # [3, 2, 5, N]: columns film x and y, pupil x and y, wavelength.
    p, u = slopes[:, :, :2], slopes[:, :, 2:4]
    columns = [p * by.p_film + u * by.u_film, p * by.p_pupil + u * by.u_pupil, slopes[:, :, 4:] * by.w]
    all_columns = torch.cat(columns, 2)
    d_position = all_columns[POSITION] * model.scales.position_mm
    d_stop = all_columns[STOP] * model.scales.stop_mm
    d_z = _sag_slopes(model, prediction, d_position)
    d_direction = direction_slopes(vectors[DIRECTION], all_columns[DIRECTION], model.direction == "angle")
    d_ray = torch.cat([d_position, d_z[None], d_direction])  # [6, 5, N]
    return Derivatives(
        prediction, d_ray[:, :2], d_ray[:, 2:4], d_ray[:, 4], d_stop[:, :2], d_stop[:, 2:4], d_stop[:, 4]
    )


def _sag_slopes(model: LensModel, prediction: Prediction, d_position: Tensor) -> Tensor:
    """[5, N] derivatives of z, the point moving on the front surface."""
    x, y = prediction.rays.x, prediction.rays.y
    one, none = torch.ones_like(x), torch.zeros_like(x)
    slope, across = _along(model._sag, (x, y), (one, none)), _along(model._sag, (x, y), (none, one))
    return slope * d_position[0] + across * d_position[1]


def direction_slopes(v: Tensor, d_v: Tensor, angle: bool = True) -> Tensor:
    """[3, C, N] derivatives of the unit direction, from its vector [2, N] and that one's derivatives [2, C, N]."""
    decode = direction_of if angle else direction_of_slope

    def call(v: Tensor) -> Tensor:
        return torch.stack(decode(v))

    halves = []
    for i in (0, 1):
        tangent = torch.zeros_like(v)
        tangent[i] = 1
        halves.append(_along(call, (v,), (tangent,))[:, None] * d_v[i])
    return halves[0] + halves[1]
