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
# Their two planes of symmetry give the rest: what passes at -a is the mirror image of what passes at a.
AZIMUTHS = tuple(math.radians(5 * k) for k in range(-18, 19))


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
    film_z: float,
    pupil_x: Tensor,
    pupil_y: Tensor,
    pupil_z: float,
    wavelength_nm: float,
) -> Tensor:
    """Whether light passes from film points on +x through pupil points, bool [N], however the whole may be turned.

    Blades and masks are left out: the round opening about them holds what they let through at every azimuth. Only
    lenses with cylinders are traced at more than one azimuth, `AZIMUTHS`, for they change with it.

    Args:
        film_radius, pupil_x, pupil_y: [N] mm. film_z, pupil_z: planes, mm, lens frame.
    """
    lens = replace(lens, aperture=None)
    passed = torch.zeros_like(film_radius, dtype=torch.bool)
    for azimuth in (0.0,) if symmetric_about_axis(lens) else AZIMUTHS:
        left = torch.nonzero(~passed).squeeze(1)
        r, u, v = film_radius[left], pupil_x[left], pupil_y[left]
        c, s = math.cos(azimuth), math.sin(azimuth)
        rays = camera_rays(c * r, s * r, film_z, c * u - s * v, s * u + c * v, pupil_z)
        passed[left] = trace(lens, rays, wavelength_nm).status == 0
    return passed
