"""What a core is fitted to: ray pairs, their exact vectors and scalars, scaled, with weights that say what counts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from neurolens.lens.glass import inverse_square_um
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, Core
from neurolens.surrogates.gates import boundary_rays, boundary_weights
from neurolens.surrogates.lightfield import LightField, angle_vector
from neurolens.surrogates.model import Domain, Encoding, Gate, Scales
from neurolens.surrogates.pairs import PairSet, RayPairs


def scales_of(lens: Lens) -> Scales:
    """Front-surface positions in units of the front rim, stop crossings in units of the stop."""
    return Scales(lens.surfaces[0].semi_diameter_mm, lens.stop_radius_mm)


@dataclass(frozen=True)
class Targets:
    """Inputs and outputs of a fit.

    Attributes:
        field: light field of the rays.
        vectors: [3, 2, N] position, direction (angle vector), stop crossing, scaled.
        transmittance: [N].
    """

    field: LightField
    vectors: Tensor
    transmittance: Tensor


def targets_of(lens: Lens, encoding: Encoding, pairs: PairSet) -> Targets:
    """Targets of rays that reach the scene."""
    scales, scene, stop = scales_of(lens), pairs.scene, lens.stop_index
    vectors = torch.empty((3, 2, len(pairs)), dtype=scene.x.dtype)
    vectors[POSITION] = torch.stack([scene.x, scene.y]) / scales.position_mm
    vectors[DIRECTION] = angle_vector(scene.dx, scene.dy, scene.dz)
    vectors[STOP] = torch.stack([pairs.cross_x[stop], pairs.cross_y[stop]]) / scales.stop_mm
    return Targets(encoding(pairs.inputs), vectors, pairs.transmittance)


@dataclass(frozen=True)
class Prepared:
    """Ray pairs with what all fits share.

    Attributes:
        encoding, gates: of the model.
        lost_share: rays of the domain that miss a surface or are totally reflected in a way that no gate tells.
    """

    pairs: RayPairs
    encoding: Encoding
    gates: tuple[Gate, ...]
    lost_share: float = 0.0

    @property
    def train(self) -> Targets:
        return targets_of(self.pairs.lens, self.encoding, self.pairs.train)

    @cached_property
    def boundary(self) -> PairSet:
        """The rays on which gates and the stop crossing are fitted."""
        return boundary_rays(self.pairs, self.gates)

    @property
    def boundary_field(self) -> LightField:
        return self.encoding(self.boundary.inputs)

    @cached_property
    def boundary_weights(self) -> tuple[Tensor, Tensor]:
        """The weights of the gates [G, N] and of the stop crossing [N]."""
        return boundary_weights(self.pairs.lens, self.gates, self.boundary)


def film_equivalent_weights(lens: Lens, domain: Domain) -> tuple[float, float]:
    """Micrometres on the film per unit of scaled position and per radian, first order.

    A direction error d moves the image by f d; a position error e on the front surface moves a point in the nearest
    focused plane by e, and so its image by e times the magnification there; objects nearer than that plane count where
    the domain knows of any (`Domain.nearest_m`). At infinity position does not count; the fit uses at least the
    magnification of 20 focal lengths, so that near objects keep their place.
    """
    f = abs(first_order(lens).efl_mm)
    nearest_m = min(*domain.focus_m, math.inf if domain.nearest_m is None else domain.nearest_m)
    nearest_mm = min(1000 * nearest_m, 20 * f)
    magnification = f / max(nearest_mm - f, f)
    return 1000 * magnification * scales_of(lens).position_mm, 1000 * f


def film_equivalent(lens: Lens, domain: Domain, vectors: Tensor) -> Tensor:
    """[2, 2, N] micrometres on the film of vectors [3, 2, N]: in the nearest focused plane, and at infinity."""
    position, direction = film_equivalent_weights(lens, domain)
    at_infinity = direction * vectors[DIRECTION]
    return torch.stack([at_infinity + position * vectors[POSITION], at_infinity])


def squared_error(pairs: RayPairs, encoding: Encoding, core: Core, rays: PairSet) -> float:
    """Summed squared film-equivalent error (um^2) of a core over rays of a lens and domain."""
    targets = targets_of(pairs.lens, encoding, rays)
    found, wanted = (film_equivalent(pairs.lens, pairs.domain, v) for v in (core(targets.field)[0], targets.vectors))
    return float(((found - wanted) ** 2).sum())


def weighed_apart(lens: Lens, domain: Domain, vectors: Tensor, position_weight: float) -> Tensor:
    """[2, 2, N] what decides which terms a fit keeps: direction in micrometres on the film, and position.

    Position counts `position_weight` times what first order makes of it (see `film_equivalent_weights`): the point on
    the front surface matters by itself too, for objects near the lens and for what stands on the front rim.
    """
    position, direction = film_equivalent_weights(lens, domain)
    return torch.stack([direction * vectors[DIRECTION], position_weight * position * vectors[POSITION]])


def fit_encoding(domain: Domain, passing: PairSet, *, mirror: bool = False) -> Encoding:
    """Centre and scale by the passing rays of a domain; `mirror`: x and y by themselves, for lenses with cylinders."""
    plain = Encoding(domain.film_z_mm[0], domain.pupil_z_mm, 0.0, 1.0, 1.0, 0.0, 0.0)
    p, u = plain.planes(passing.inputs)
    axes = [slice(0, 1), slice(1, 2)] if mirror else [slice(0, 2)]
    chiefs = [float((p[a] * u[a]).sum() / (p[a] * p[a]).sum()) for a in axes]
    scales = [float((u[a] - k * p[a]).norm(dim=0).max()) for a, k in zip(axes, chiefs, strict=True)]
    shortest, longest = (float(inverse_square_um(v)) for v in domain.wavelength_nm)
    return Encoding(
        film_plane_z_mm=plain.film_plane_z_mm,
        pupil_plane_z_mm=plain.pupil_plane_z_mm,
        chief=chiefs[0],
        film_scale_mm=float(p.norm(dim=0).max()),
        pupil_scale_mm=scales[0],
        w_middle=(shortest + longest) / 2,
        w_half=(shortest - longest) / 2,
        chief_y=chiefs[1] if mirror else None,
        pupil_scale_y_mm=scales[1] if mirror else None,
    )
