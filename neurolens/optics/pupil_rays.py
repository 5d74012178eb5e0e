"""Rays between a film and the pupil plane, and whether they pass the lens, at one azimuth or at all."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

# Azimuths at which lenses with cylinders are searched, 5 degrees apart: at 15, one of them lost 7% of its corners.
# Their two planes of symmetry give the rest: what passes at -a is the mirror image of what passes at a. In groups,
# the first of which find most of what passes.
_STEP_DEG = 5
AZIMUTHS = tuple(math.radians(_STEP_DEG * k) for k in range(-18, 19))
_GROUPS = (AZIMUTHS[18:19], AZIMUTHS[::9], tuple(a for k, a in enumerate(AZIMUTHS) if k % 9))
# Azimuths of a film are those at radii this share smaller too: outlines are interpolated between radii.
_BETWEEN_RADII = 0.03


def pupil_plane_z_mm(lens: Lens) -> float:
    """z of the plane on which pupil points lie: the paraxial exit pupil, where passing rays crowd together.

    The rear vertex stands in where the exit pupil lies near or behind the film or too far in front of it to be useful.
    """
    data = first_order(lens)
    rear = float(lens.vertices_mm[len(lens.surfaces) - 1])
    film = data.rear_focal_z_mm
    z = data.exit_pupil_z_mm
    useful = math.isfinite(z) and 0.25 * (film - rear) < film - z < 20 * abs(data.efl_mm)
    return float(z) if useful else rear


def camera_rays(
    film_x: Tensor, film_y: Tensor, film_z: Tensor | float, pupil_x: Tensor, pupil_y: Tensor, pupil_z: float
) -> Rays:
    """Camera rays from film points towards (or away from) pupil points, all [N] in mm, lens frame; dz is negative."""
    x, y = pupil_x - film_x, pupil_y - film_y
    z = torch.as_tensor(pupil_z, dtype=film_x.dtype, device=film_x.device) - film_z
    scale = -torch.sign(z) / torch.sqrt(x * x + y * y + z * z)
    start_z = torch.as_tensor(film_z, dtype=film_x.dtype, device=film_x.device).expand_as(film_x)
    return Rays(film_x, film_y, start_z, x * scale, y * scale, (z * scale).expand_as(film_x))


def symmetric_about_axis(lens: Lens) -> bool:
    """Whether turning the lens about its axis changes nothing but the place of its blades: no surface is a cylinder."""
    return all(s.cylinder is None for s in lens.surfaces)


def passes_at_any_azimuth(
    lens: Lens,
    film_radius: Tensor,
    film_z: Tensor | float,
    pupil_x: Tensor,
    pupil_y: Tensor,
    pupil_z: float,
    wavelength_nm: float,
    film_mm: tuple[float, float] | None = None,
) -> Tensor:
    """Whether light passes from film points on +x through pupil points, bool [N], however the whole may be turned.

    Blades and masks are left out: the round opening about them holds what they let through at every azimuth. Only
    lenses with cylinders are traced at more than one azimuth, `AZIMUTHS`, for they change with it.

    Args:
        film_radius, pupil_x, pupil_y: [N] mm. film_z, pupil_z: planes, mm, lens frame.
        film_mm: width and height of a film; of the azimuths, those at which it has points that far from its middle.
    """
    lens = replace(lens, aperture=None)
    passed = torch.zeros_like(film_radius, dtype=torch.bool)
    round_ = symmetric_about_axis(lens)
    low, high = (None, None) if round_ or film_mm is None else azimuths_on_film(film_radius, film_mm)
    planes = torch.as_tensor(film_z, dtype=film_radius.dtype).expand_as(film_radius)
    for group in ((0.0,),) if round_ else _GROUPS:
        # Together, for few rays take nearly as long as many.
        azimuth = torch.tensor(group, dtype=film_radius.dtype)[:, None]
        asked = (~passed).expand(len(group), -1)
        if low is not None and high is not None:
            asked = asked & (low <= azimuth.abs()) & (high >= azimuth.abs())
        which, left = torch.nonzero(asked, as_tuple=True)
        if not len(left):
            continue
        r, u, v = film_radius[left], pupil_x[left], pupil_y[left]
        c, s = torch.cos(azimuth[which, 0]), torch.sin(azimuth[which, 0])
        rays = camera_rays(c * r, s * r, planes[left], c * u - s * v, s * u + c * v, pupil_z)
        passed[left[trace(lens, rays, wavelength_nm).status == 0]] = True
    return passed


def azimuths_on_film(film_radius: Tensor, film_mm: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Least and largest azimuth in the first quadrant, rad [N], at which a centred film has points that far out.

    With half a step of `AZIMUTHS` beyond either; beyond the corner, those about the corner's.
    """
    width, height = film_mm
    radius = (film_radius * (1 - _BETWEEN_RADII)).clamp_min(1e-12)
    low, high = torch.acos((width / 2 / radius).clamp_max(1)), torch.asin((height / 2 / radius).clamp_max(1))
    corner = math.atan2(height, width)
    beyond = 1.001 * math.radians(_STEP_DEG) / 2
    return low.clamp_max(corner) - beyond, high.clamp_min(corner) + beyond
