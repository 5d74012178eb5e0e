"""A complete surrogate: raw millimetres and nanometres in; scene ray, transmittance, stop crossing and status out.

Polynomials and networks differ only in their core, which maps the light field to a few vectors and scalars. Everything
round it is written once, in `assemble`; here it is evaluated on torch tensors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.modelfile import DOMAIN_SLACK
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.surrogates.assemble import EXACT, model_graph
from neurolens.surrogates.cores import Core
from neurolens.surrogates.domain import Domain, FilmRays
from neurolens.surrogates.lightfield import Encoding

OUTPUTS = ("scene_ray", "transmittance", "stop_xy_mm", "status")
# Positive and finite, in float32 too.
ANY_WAVELENGTH_NM = (1e-30, 3e38)


@dataclass(frozen=True)
class Gate:
    """A boundary that blocks rays: the scalar output is positive where surface `surface` stops the ray for `reason`.

    `reason` RIM: scalar = (r / rim radius)^2 - 1. MISSED or TOTAL_REFLECTION: the negated discriminant.
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

    def predict(self, rays: FilmRays, stop_radius_mm: float | None = None) -> Prediction:
        """Evaluate the model in the dtype of `rays`.

        Args:
            rays: film point, pupil point and wavelength, [N] each.
            stop_radius_mm: any radius up to that of the domain; None takes the domain's.

        Raises:
            InputError: a stop wider than the model was fitted for.
        """
        if stop_radius_mm is not None and not 0 <= stop_radius_mm <= DOMAIN_SLACK * self.domain.stop_radius_mm:
            expected = f"0 to {self.domain.stop_radius_mm:.6g} mm, the widest stop of the fit"
            raise InputError(self.method, "stop_radius_mm", stop_radius_mm, expected)
        radius = self.domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm
        columns = torch.stack([rays.film_x, rays.film_y, rays.pupil_x, rays.pupil_y, rays.wavelength_nm])
        inputs = {"rays": columns, "film_z_mm": rays.film_z[None], "stop_radius_mm": columns.new_full((1, 1), radius)}
        out = evaluate(self._graph, inputs)
        scene, power, stop, status = (out[n].expand(-1, len(rays)) for n in OUTPUTS)
        return Prediction(Rays(*scene), power[0], stop[0], stop[1], status[0])

    @cached_property
    def _graph(self) -> Graph:
        return model_graph(self, math.pi, EXACT)

    @property
    def wavelength_limits_nm(self) -> tuple[float, float]:
        """Wavelengths accepted: those of the domain with their slack; any for glass without dispersion."""
        if not self.lens.dispersive:
            return ANY_WAVELENGTH_NM
        low, high = self.domain.wavelength_nm
        return low / DOMAIN_SLACK, high * DOMAIN_SLACK
