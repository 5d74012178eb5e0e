"""A complete surrogate: raw millimetres and nanometres in; scene ray, transmittance, stop crossing and status out.

Polynomials and networks differ only in their core, which maps the light field to a few vectors and scalars. Everything
round it (scaling, symmetry, decoding, stop, rims, domain guard) is here, once, and is what the ONNX graph repeats.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.modelfile import DOMAIN_SLACK
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.surrogates.domain import Domain, FilmRays
from neurolens.surrogates.front import sag_mm
from neurolens.surrogates.lightfield import Encoding, LightField, direction_of, direction_of_slope

# Order of the vector outputs of every core.
POSITION, DIRECTION, STOP = 0, 1, 2

# Positive and finite, in float32 too.
ANY_WAVELENGTH_NM = (1e-30, 3e38)


class Core(Protocol):
    """What differs between surrogates.

    Attributes:
        coefficients_per_vector: coefficients that one of position and direction costs (A and B terms both count;
            weights of a network: all of them).
        coefficients: all of them.
    """

    @property
    def coefficients_per_vector(self) -> int: ...

    @property
    def coefficients(self) -> int: ...

    def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
        """Vectors [3, 2, N] (position, direction, stop; see `Scales`) and scalars [1 + G, N] (transmittance, gates)."""
        ...

    def to(self, dtype: torch.dtype) -> Core:
        """The same core computing in another precision."""
        ...


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
        core = self.core.to(rays.film_x.dtype)
        vectors, scalars = core(self.encoding(rays))
        x, y = vectors[POSITION] * self.scales.position_mm
        stop_x, stop_y = vectors[STOP] * self.scales.stop_mm
        decode = direction_of if self.direction == "angle" else direction_of_slope
        dx, dy, dz = decode(vectors[DIRECTION])
        radius = self.domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm
        status = self._status(rays, scalars[1:], stop_x * stop_x + stop_y * stop_y, radius)
        return Prediction(Rays(x, y, self._sag(x, y), dx, dy, dz), scalars[0], stop_x, stop_y, status)

    def _sag(self, x: Tensor, y: Tensor) -> Tensor:
        # First-order models give the position in the plane of the front vertex.
        return sag_mm(self.lens.surfaces[0], x, y) if self.direction == "angle" else 0.0 * (x + y)

    def _status(self, rays: FilmRays, gates: Tensor, stop_square: Tensor, stop_radius: float) -> Tensor:
        """First failure in the order of travel, then the domain; guards are written so that NaN fails them."""
        status = torch.zeros_like(rays.film_x, dtype=torch.int32)
        stop = self.lens.stop_index
        # Camera rays meet the last surface first, so the first failure is the one written last here.
        tests = [(g.surface, ~(gates[i] <= 0), g.status) for i, g in enumerate(self.gates)]
        tests.append((stop, ~(stop_square <= stop_radius**2), st.blocked(stop, st.RIM)))
        for _, fails, code in sorted(tests, key=lambda t: (t[0], -(t[2] % 4))):
            status = torch.where(fails, code, status)
        return torch.where(self.inside_domain(rays), status, st.OUTSIDE_DOMAIN).to(torch.int32)

    def inside_domain(self, rays: FilmRays) -> Tensor:
        """[N] bool; false for NaN. Bounds have a relative slack of 1e-5, the rounding of float32 inputs."""
        d, slack = self.domain, DOMAIN_SLACK
        ok = rays.film_x**2 + rays.film_y**2 <= (d.film_radius_mm * slack) ** 2
        ok &= rays.pupil_x**2 + rays.pupil_y**2 <= (d.pupil_radius_mm * slack) ** 2
        near, far = d.film_z_mm
        ok &= (rays.film_z >= near / slack) & (rays.film_z <= far * slack)
        low, high = self.wavelength_limits_nm
        return ok & (rays.wavelength_nm >= low) & (rays.wavelength_nm <= high)

    @property
    def wavelength_limits_nm(self) -> tuple[float, float]:
        """Wavelengths accepted: those of the domain with their slack; any for glass without dispersion."""
        if not self.lens.dispersive:
            return ANY_WAVELENGTH_NM
        low, high = self.domain.wavelength_nm
        return low / DOMAIN_SLACK, high * DOMAIN_SLACK
