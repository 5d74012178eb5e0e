"""A complete surrogate: raw millimetres and nanometres in; scene ray, transmittance, stop crossing and status out.

Polynomials and networks differ only in their core, which maps the light field to a few vectors and scalars. Everything
round it is written once, in `assemble`; here it is evaluated on torch tensors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.program import RAY, WAVELENGTH
from neurolens.modelfile import DOMAIN_SLACK, POLARISED
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import Rays
from neurolens.surrogates.assemble import EXACT, model_graph
from neurolens.surrogates.cores import DIRECTION, Core, Refracted
from neurolens.surrogates.domain import Domain, FilmRays, draw
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.pairs import trace_pairs

OUTPUTS = ("scene_ray", "transmittance", "stop_xy_mm", "status")
_DIFFERENTIATED = ("scene_ray", "stop_xy_mm")
_ANGLE_RAYS, _FEWEST_RAYS = 32_768, 300
# Positive and finite, in float32 too.
ANY_WAVELENGTH_NM = (1e-30, 3e38)


@dataclass(frozen=True)
class Gate:
    """A boundary that blocks rays: the scalar output is positive where surface `surface` stops the ray for `reason`.

    `reason` RIM: scalar = (r / rim radius)^2 - 1, or of depths where a sphere ends near its rim. MISSED or
    TOTAL_REFLECTION: the negated discriminant.
    """

    surface: int
    reason: int

    @property
    def status(self) -> int:
        return st.blocked(self.surface, self.reason)


@dataclass(frozen=True)
class Scales:
    """Units of a core's vectors: front-surface position and stop crossing in mm per unit; direction is in radians."""

    position_mm: float
    stop_mm: float


class Prediction(NamedTuple):
    """What a model gives for N rays; lens frame, mm. The ray is meaningful where status is 0."""

    rays: Rays
    transmittance: Tensor
    stop_x: Tensor
    stop_y: Tensor
    status: Tensor


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


def prediction_of(out: Mapping[str, Tensor], count: int) -> Prediction:
    """The outputs of a model's graph for `count` rays."""
    scene, power, stop, status = (out[n].expand(-1, count) for n in OUTPUTS)
    return Prediction(Rays(*scene), power[0], stop[0], stop[1], status[0])


@dataclass(frozen=True)
class LensModel:
    """A fitted surrogate of one lens over one domain.

    Attributes:
        lens: the prescription it stands for (front surface, stop and rims are read from it).
        domain, encoding, scales, gates: see their types. Gates are in the order in which camera rays meet them.
        core: polynomial or network.
        method: name of the fit, for tables ("ols invariants", "mlp 16x2").
        settings: JSON-able settings of the fit.
        fit_s: seconds that the fit took.
        direction: what the core's direction vector is: the angle vector, or the slope for first-order models.
        transmittance: "polarised" as the tracer follows it, or "averaged" over s and p at every surface (of files made
            by version 0.1.0 and earlier).
    """

    lens: Lens
    domain: Domain
    encoding: Encoding
    scales: Scales
    gates: tuple[Gate, ...]
    core: Core
    method: str
    settings: dict[str, Any] = field(default_factory=dict)
    fit_s: float = 0.0
    direction: Literal["angle", "slope"] = "angle"
    transmittance: str = POLARISED

    def predict(self, rays: FilmRays, stop_radius_mm: float | None = None) -> Prediction:
        """Evaluate the model in the dtype of `rays`.

        Args:
            rays: film point, pupil point and wavelength, [N] each.
            stop_radius_mm: any radius up to that of the domain; None takes the domain's.

        Raises:
            InputError: a stop wider than the model was fitted for.
        """
        return prediction_of(evaluate(self.graph, self._inputs(rays, stop_radius_mm)), len(rays))

    def differentiate(self, rays: FilmRays, stop_radius_mm: float | None = None) -> Derivatives:
        """Evaluate the model with its derivatives; arguments and errors as `predict`.

        The wavelength's derivative is at fixed film and pupil point. Where the status is not 0 the figures mean
        nothing.
        """
        out = evaluate(self._derivative_graph, self._inputs(rays, stop_radius_mm))
        scene, stop = (
            torch.stack([out[derivative(name, row)].expand(-1, len(rays)) for row in (*RAY, WAVELENGTH)], 1)
            for name in _DIFFERENTIATED
        )
        parts = [block for d in (scene, stop) for block in (d[:, :2], d[:, 2:4], d[:, 4])]
        return Derivatives(prediction_of(out, len(rays)), *parts)

    def _inputs(self, rays: FilmRays, stop_radius_mm: float | None) -> dict[str, Tensor]:
        radius = rays.film_z.new_full((1, 1), self.checked_radius_mm(stop_radius_mm))
        return {"rays": rays.rows, "film_z_mm": rays.film_z[None], "stop_radius_mm": radius}

    def checked_radius_mm(self, stop_radius_mm: float | None) -> float:
        """The stop radius asked for, or the domain's. Raises InputError: a stop wider than the model was fitted for."""
        if stop_radius_mm is not None and not 0 <= stop_radius_mm <= DOMAIN_SLACK * self.domain.stop_radius_mm:
            expected = f"0 to {self.domain.stop_radius_mm:.6g} mm, the widest stop of the fit"
            raise InputError(self.method, "stop_radius_mm", stop_radius_mm, expected)
        return self.domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm

    @cached_property
    def graph(self) -> Graph:
        """For evaluation in float64: inputs and outputs as `assemble` says."""
        return model_graph(self, self.largest_angle, EXACT)

    @cached_property
    def largest_angle(self) -> float:
        """Largest angle (rad) between the axis and the rays that the exact lens passes, enlarged by 5%.

        A core's direction vector is no longer than that. Where it is, as a network's may be far from the rays of its
        fit, the ray lies outside the domain. Where all rays point forwards the angle stays below a right one; of a
        `Refracted` core it is that inside the glass.
        """
        rays, _ = draw(self.domain, _ANGLE_RAYS, seed=5)
        with torch.no_grad():
            exact = trace_pairs(self.lens, rays, self.domain.pupil_z_mm)
            if isinstance(self.core, Refracted):
                angles = self.core(self.encoding(rays))[0][DIRECTION].norm(dim=0)
            else:
                angles = torch.atan2(torch.hypot(exact.scene.dx, exact.scene.dy), -exact.scene.dz)
        angles = angles[exact.status == st.PASSED]
        if len(angles) < _FEWEST_RAYS:  # they do not tell the largest
            return math.pi
        angle = float(angles.max())
        bound = next((b for b in (math.pi / 2, math.pi) if angle < b), math.pi)
        return min(1.05 * angle, (angle + bound) / 2, bound)

    @cached_property
    def _derivative_graph(self) -> Graph:
        return with_derivatives(self.graph, _DIFFERENTIATED, [("rays", k) for k in range(5)])

    @property
    def front(self) -> Surface | None:
        """The surface on which scene rays are taken; None: the plane of its vertex, of first-order models."""
        return None if self.direction == "slope" else self.lens.surfaces[0]

    @property
    def wavelength_limits_nm(self) -> tuple[float, float]:
        """Wavelengths accepted: those of the domain with their slack; any for glass without dispersion."""
        if not self.lens.dispersive:
            return ANY_WAVELENGTH_NM
        low, high = self.domain.wavelength_nm
        return low / DOMAIN_SLACK, high * DOMAIN_SLACK
