"""Which rays a surrogate is fitted to, and what a fit finds: domain, rays, encoding, gates, core.

All of it is plain data, from which `assemble` writes a graph; `model` evaluates that. Methods that take or give tensors
import torch when they run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neurolens.base import status as st
from neurolens.base.status import DOMAIN_SLACK
from neurolens.models.cores import Array, Core, LightField
from neurolens.optics.lens.glass import ANY_WAVELENGTH_NM, inverse_square_um
from neurolens.optics.lens.paraxial import PupilBounds
from neurolens.optics.lens.prescription import Lens, Surface

if TYPE_CHECKING:
    import torch
    from torch import Tensor


@dataclass(frozen=True)
class Domain:
    """A set of camera rays. Lengths in mm, lens frame.

    Attributes:
        film_radius_mm: film points lie within this distance of the axis.
        film_z_mm: film planes, nearest to the lens first (best focus at infinity) to farthest (near limit).
        focus_m: the object distances that those planes focus (far, near), from film to object, at every aperture.
        pupil_z_mm: plane of the pupil points.
        pupil_radius_mm: pupil points lie within this distance of the axis; 1.05 times the disc of passing rays.
        wavelength_nm: shortest and longest wavelength; equal for a lens whose dispersion is unknown.
        stop_radius_mm: the widest stop for which the surrogate is fitted.
        bounds: where passing rays lie on the pupil plane, by film radius (for sampling in a render).
        nearest_m: distance from the film of the nearest object in view, where one lies before the plane in focus; None:
            the nearest focus. It changes no ray, but says how much an error of position counts in a fit.
    """

    film_radius_mm: float
    film_z_mm: tuple[float, float]
    focus_m: tuple[float, float]
    pupil_z_mm: float
    pupil_radius_mm: float
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    bounds: PupilBounds
    nearest_m: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the domain as data for JSON, with infinity as the string "inf"."""
        return {
            **{
                f.name: getattr(self, f.name) for f in fields(self)
            },  # a zoom mixes many: asdict takes ten times as long
            "focus_m": ["inf" if math.isinf(f) else f for f in self.focus_m],
            "bounds": {f.name: getattr(self.bounds, f.name) for f in fields(self.bounds)},
        }

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Domain:
        """Make a domain from what `to_dict` gives; data from before `nearest_m` existed have none."""
        table = {f.name: data["bounds"][f.name] for f in fields(PupilBounds)}
        bounds: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in table.items()}
        pairs = {k: tuple(float(v) for v in data[k]) for k in ("film_z_mm", "focus_m", "wavelength_nm")}
        values = {f.name: data[f.name] for f in fields(Domain) if f.name in data}
        return Domain(**{**values, **pairs, "bounds": PupilBounds(**bounds)})


@dataclass(frozen=True)
class FilmRays:
    """Camera rays as film point, pupil point and wavelength, each [N] float64; mm and nm, lens frame."""

    film_x: Tensor
    film_y: Tensor
    film_z: Tensor
    pupil_x: Tensor
    pupil_y: Tensor
    wavelength_nm: Tensor

    def __len__(self) -> int:
        return self.film_x.shape[0]

    @property
    def rows(self) -> Tensor:
        """Return rows [5, N] as graphs take them: all but the film plane."""
        import torch

        return torch.stack([self.film_x, self.film_y, self.pupil_x, self.pupil_y, self.wavelength_nm])

    def select(self, index: Tensor | slice) -> FilmRays:
        return FilmRays(*(c[index] for c in self.columns()))

    def to(self, dtype: torch.dtype) -> FilmRays:
        return FilmRays(*(c.to(dtype) for c in self.columns()))

    def columns(self) -> tuple[Tensor, ...]:
        return (self.film_x, self.film_y, self.film_z, self.pupil_x, self.pupil_y, self.wavelength_nm)


@dataclass(frozen=True)
class Encoding:
    """How raw millimetres and nanometres become the light field.

    Attributes:
        film_plane_z_mm, pupil_plane_z_mm: the two planes (lens frame).
        chief: k of the chief ray's u = k p, subtracted so that u is centred on the passing rays.
        film_scale_mm, pupil_scale_mm: largest |p| and |u - k p| of the domain's passing rays.
        w_middle, w_half: w = (1 / lambda^2 - middle) / half in 1/um^2; the index is linear in 1 / lambda^2 (Cauchy).
            half is 0 for a lens without known dispersion, and then w = 0.
        chief_y, pupil_scale_y_mm: those of y, where the lens has cylinders; the two above are then those of x. None:
            the two above hold for both.
    """

    film_plane_z_mm: float
    pupil_plane_z_mm: float
    chief: float
    film_scale_mm: float
    pupil_scale_mm: float
    w_middle: float
    w_half: float
    chief_y: float | None = None
    pupil_scale_y_mm: float | None = None

    @property
    def mirror(self) -> bool:
        """Whether the lens has two planes of symmetry instead of an axis."""
        return self.chief_y is not None

    @property
    def dispersive(self) -> bool:
        """Whether rays depend on the wavelength."""
        return self.w_half != 0

    @property
    def chiefs(self) -> tuple[float, float]:
        """The factors `chief` for x and for y."""
        return self.chief, self.chief if self.chief_y is None else self.chief_y

    @property
    def pupil_scales_mm(self) -> tuple[float, float]:
        """The pupil scales of x and of y, in mm."""
        return self.pupil_scale_mm, self.pupil_scale_mm if self.pupil_scale_y_mm is None else self.pupil_scale_y_mm

    def planes(self, rays: FilmRays) -> tuple[Tensor, Tensor]:
        """Return the crossings with the two planes in mm, [2, N] each."""
        import torch

        u = torch.stack([rays.pupil_x, rays.pupil_y])
        film = torch.stack([rays.film_x, rays.film_y])
        along = (self.film_plane_z_mm - self.pupil_plane_z_mm) / (rays.film_z - self.pupil_plane_z_mm)
        return u + (film - u) * along, u

    def __call__(self, rays: FilmRays) -> LightField:
        import torch

        p, u = self.planes(rays)
        u = torch.stack([(u[i] - self.chiefs[i] * p[i]) / self.pupil_scales_mm[i] for i in (0, 1)])
        w = torch.zeros_like(rays.wavelength_nm)
        if self.dispersive:
            w = (inverse_square_um(rays.wavelength_nm) - self.w_middle) / self.w_half
        return LightField(p / self.film_scale_mm, u, w)

    @staticmethod
    def mixed(encodings: Sequence[Encoding], weights: Array) -> Encoding:
        """Return a state's encoding: planes are mixed as they are, scales by their reciprocals, as in the graph."""

        def mean(value: Callable[[Encoding], float]) -> float:
            return float(weights @ np.array([value(e) for e in encodings]))

        pupil_scale = 1 / mean(lambda e: 1 / e.pupil_scale_mm)
        return replace(
            encodings[0],
            film_plane_z_mm=mean(lambda e: e.film_plane_z_mm),
            pupil_plane_z_mm=mean(lambda e: e.pupil_plane_z_mm),
            chief=pupil_scale * mean(lambda e: e.chief / e.pupil_scale_mm),
            film_scale_mm=1 / mean(lambda e: 1 / e.film_scale_mm),
            pupil_scale_mm=pupil_scale,
        )


@dataclass(frozen=True)
class Gate:
    """A boundary that blocks rays: the scalar output is positive where surface `surface` stops the ray for `reason`.

    For the reason RIM it is (r / rim radius)^2 - 1, or the same of depths where a sphere ends near its rim. For MISSED
    and TOTAL_REFLECTION it is the negated discriminant.
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


@dataclass(frozen=True)
class Fitted:
    """A surrogate of one lens over one domain as its fit found it.

    Attributes:
        lens: the prescription it stands for (front surface, stop and rims are read from it).
        domain, encoding, scales, gates: see their types. Gates are in the order in which camera rays meet them.
        core: polynomial or network.
        direction: what the core's direction vector is: the angle vector, or the slope for first-order models.
        angle: largest angle (rad) between the axis and the rays that the exact lens passes, enlarged by 5%; see
            `targets.with_angle`. A ray whose direction vector comes out longer, as a network's may far from the rays of
            its fit, lies outside the domain. Where all rays point forwards the angle stays below a right one. A
            `Refracted` core's angle is that inside the glass. With pi no ray is refused.
    """

    lens: Lens
    domain: Domain
    encoding: Encoding
    scales: Scales
    gates: tuple[Gate, ...]
    core: Core
    direction: Literal["angle", "slope"] = field(default="angle", kw_only=True)
    angle: float = field(default=math.pi, kw_only=True)

    @property
    def front(self) -> Surface | None:
        """The surface on which scene rays are taken; None where it is the plane of its vertex (first-order models)."""
        return None if self.direction == "slope" else self.lens.surfaces[0]

    @property
    def wavelength_limits_nm(self) -> tuple[float, float]:
        """The wavelengths accepted: those of the domain with their slack; any where the dispersion is unknown."""
        if not self.lens.dispersive:
            return ANY_WAVELENGTH_NM
        low, high = self.domain.wavelength_nm
        return low / DOMAIN_SLACK, high * DOMAIN_SLACK
