"""The film plane of least RMS spot on the axis, from traced rays over the whole pupil."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.optics import paraxial
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

_RINGS, _SPOKES = 512, 24
_WIDER = 1.1  # the disc of rays over the paraxial entrance pupil: aberrations of the pupil move its edge
_ROUNDS = 4  # an object at a distance from the film moves with it: each round leaves a hundredth of the step


def best_focus_z_mm(
    lens: Lens, focus_m: float = math.inf, weights: Sequence[tuple[float, float]] = ((LINE_D_NM, 1.0),)
) -> float:
    """Film plane (lens frame, mm) of least RMS spot for the axial point `focus_m` metres from it.

    Rays are spread evenly over the entrance pupil, those pass that the stop and the rims let through, and the plane
    follows in closed form: the spot's second moment is a parabola in z. With pure third-order spherical aberration it
    lies two thirds of the way from the paraxial to the marginal focus. A pinhole's film stays where it is.

    Args:
        weights: (wavelength in nm, weight) pairs; the spot is that of all colours together.

    Raises:
        InputError: no ray passes, weights that are not positive, or focus nearer than four focal lengths.
    """
    if not weights or not all(w > 0 for pair in weights for w in pair):
        raise InputError("best focus", "weights", tuple(weights), "(wavelength in nm, weight) pairs above 0")
    film_z = paraxial.film_z_mm(lens, focus_m)
    if paraxial.is_pinhole(lens):
        return film_z
    for _ in range(1 if math.isinf(focus_m) else _ROUNDS):
        film_z = _least_spot_z_mm(lens, film_z - 1000 * focus_m, weights)
    return film_z


def axial_rays(lens: Lens, object_z_mm: float) -> Rays:
    """Rays towards the film from a point of the axis (-inf allowed), of equal areas of the entrance pupil."""
    data = paraxial.first_order(lens)
    ring = torch.sqrt((torch.arange(_RINGS, dtype=torch.float64) + 0.5) / _RINGS)
    spoke = 2 * math.pi * (torch.arange(_SPOKES, dtype=torch.float64) + 0.5) / _SPOKES
    radius = _WIDER / 2 * data.entrance_pupil_diameter_mm * ring[:, None]
    x, y = (radius * torch.cos(spoke)).reshape(-1), (radius * torch.sin(spoke)).reshape(-1)
    # Started well in front of every lens, so that a front surface bulging towards the scene is still ahead.
    start = -max(10.0, lens.surfaces[0].diameter_mm if math.isfinite(lens.surfaces[0].diameter_mm) else 10.0)
    if math.isinf(object_z_mm):
        zero = torch.zeros_like(x)
        return Rays(x, y, zero + start, zero, zero, zero + 1)
    depth = data.entrance_pupil_z_mm - object_z_mm
    length = torch.sqrt(x * x + y * y + depth * depth) * math.copysign(1.0, depth)
    dx, dy, dz = x / length, y / length, depth / length
    t = (start - object_z_mm) / dz
    if object_z_mm > start:
        t = torch.zeros_like(t)
    return Rays(dx * t, dy * t, object_z_mm + dz * t, dx, dy, dz)


def _least_spot_z_mm(lens: Lens, object_z_mm: float, weights: Sequence[tuple[float, float]]) -> float:
    """Plane where sum w (x^2 + y^2) is least; x = x0 + z tx, so z = -sum w (x0 tx + y0 ty) / sum w (tx^2 + ty^2)."""
    rays = axial_rays(lens, object_z_mm)
    along, across = 0.0, 0.0
    for wavelength_nm, weight in weights:
        with torch.no_grad():
            out = trace(lens, rays, wavelength_nm, towards="film")
        passed = out.status == 0
        r = Rays(*(c[passed] for c in out.rays))
        tx, ty = r.dx / r.dz, r.dy / r.dz
        along += weight * _sum((r.x - r.z * tx) * tx + (r.y - r.z * ty) * ty)
        across += weight * _sum(tx * tx + ty * ty)
    if not across > 0:
        raise InputError(lens.path, "focus", "best", "a lens that axial light passes and bends")
    return -along / across


def _sum(values: Tensor) -> float:
    return float(values.sum())
