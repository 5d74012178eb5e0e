"""Vignetting and relative illumination over the field.

Irradiance on the film is the scene's radiance times the integral of dL dM over the direction cosines of the rays that
arrive. By conservation of etendue it is also the energy of the beam that enters times one number of the field, dL dM
over beam area, which is taken from rays all over the open stop; vignetting is counted on a finer grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import Scene
from neurolens.analysis.patterns import Pattern, grid, hexapolar
from neurolens.analysis.results import Array, Result
from neurolens.optics.glass import LINE_D_NM

_STEP = 1e-4  # stop radii, of the differences


@dataclass(frozen=True)
class Illumination(Result):
    """Light over F fields from the axis to the edge, one wavelength, glass without losses.

    Attributes:
        field_deg, height_mm: [F] of the chief ray.
        relative: [F] film irradiance over that on the axis.
        unvignetted: [F] the same if only the stop were in the way: natural falloff, pupil growth and distortion.
        passed: [F] share of the beam through the stop that no rim takes.
        cos4: [F] cos^4 of the field angle, 0 from 90 degrees on.
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    relative: Array
    unvignetted: Array
    passed: Array
    cos4: Array


def illumination(
    scene: Scene, *, wavelength_nm: float = LINE_D_NM, fields: int = 21, n: int = 41, edge_deg: float | None = None
) -> Illumination:
    """Relative illumination up to the edge of the field, with n points across the stop."""
    angles = np.linspace(0, scene.edge_deg() if edge_deg is None else edge_deg, fields)
    rays = bundle(scene, angles.tolist(), [wavelength_nm], grid(n))
    passed = (rays.weight.sum((1, 2)) / rays.open_weight.sum((1, 2))).numpy()
    natural = _projected_solid_angle(scene, angles, wavelength_nm)
    return Illumination(
        wavelength_nm,
        angles,
        rays.chief_height_mm.numpy(),
        natural * passed / (natural[0] * passed[0]),
        natural / natural[0],
        passed,
        np.where(angles < 90, np.cos(np.radians(angles)), 0.0) ** 4,
    )


def _projected_solid_angle(scene: Scene, angles: Array, wavelength_nm: float) -> Array:
    """Integral of dL dM over the open stop, [F] in sr."""
    base = hexapolar(4)
    inside = 1 - 2 * _STEP
    t, s = base.tangential * inside, base.sagittal * inside
    zero = torch.zeros_like(base.weight)
    three = Pattern(torch.cat([t, t + _STEP, t]), torch.cat([s, s, s + _STEP]), zero.repeat(3))
    film = bundle(scene.open, angles.tolist(), [wavelength_nm], three).film

    def slopes(cosine: Tensor) -> tuple[Tensor, Tensor]:
        start, along, across = cosine[:, 0].reshape(len(angles), 3, -1).unbind(1)
        return (along - start) / _STEP, (across - start) / _STEP

    (xt, xs), (yt, ys) = slopes(film.dx), slopes(film.dy)
    found: Array = np.pi * torch.nansum(base.weight * (xt * ys - xs * yt).abs(), 1).numpy()
    return found
