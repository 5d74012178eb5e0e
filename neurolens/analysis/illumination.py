"""Vignetting and relative illumination over the field: what film points see of the stop.

Irradiance at a film point is the scene's radiance times the integral of cos^4 / Z^2 over the area of the exit pupil
from which rays come. Bundles from the scene say where to look; the integral itself is traced from the film, where it
is exact whatever the aberrations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import Scene, on_plane
from neurolens.analysis.patterns import hexapolar
from neurolens.analysis.results import Array, Result
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

_MARGIN = 0.08  # what the grid is wider than the bundle, for film points beside the chief ray see another pupil


@dataclass(frozen=True)
class Illumination(Result):
    """Light over F fields from the axis to the edge, one wavelength, glass without losses.

    Attributes:
        field_deg, height_mm: [F] of the chief ray.
        relative: [F] film irradiance over that on the axis.
        unvignetted: [F] the same if only the stop were in the way: natural falloff, pupil growth and distortion.
        passed: [F] share of the stop's light that no rim takes.
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
    scene: Scene, *, wavelength_nm: float = LINE_D_NM, fields: int = 21, n: int = 80, edge_deg: float | None = None
) -> Illumination:
    """Relative illumination up to the edge of the field, with n by n rays from each film point.

    Fields without a chief ray are NaN, and all are where the axis gets no light.
    """
    angles = np.linspace(0, scene.edge_deg() if edge_deg is None else edge_deg, fields)
    rays = bundle(scene.open, angles.tolist(), [wavelength_nm], hexapolar(6))
    film = on_plane(Rays(*(c[:, 0] for c in rays.film)), pupil_plane_z_mm(scene.lens))
    start, area = _grid(scene, rays.chief_height_mm, film, n)
    with torch.no_grad():
        light = area[:, None] * start.dz.reshape(fields, -1) ** 4
        whole, seen = (_sum(light, lens, start, wavelength_nm) for lens in (scene.open.traced, scene.lens))
    with np.errstate(divide="ignore", invalid="ignore"):  # dark fields, or an axis without light: NaN
        relative, unvignetted, passed = seen / (seen[0] or np.nan), whole / (whole[0] or np.nan), seen / whole
    return Illumination(
        wavelength_nm,
        angles,
        rays.chief_height_mm.numpy(),
        relative,
        unvignetted,
        passed,
        np.where(angles < 90, np.cos(np.radians(angles)), 0.0) ** 4,
    )


def _sum(light: Tensor, lens: Lens, start: Rays, wavelength_nm: float) -> Array:
    passed = (trace(lens, start, wavelength_nm).status == 0).reshape(light.shape)
    found: Array = (light * passed).sum(1).where(torch.isfinite(light).all(1), torch.nan).numpy()
    return found


def _grid(scene: Scene, height: Tensor, pupil: Rays, n: int) -> tuple[Rays, Tensor]:
    """Rays [F * n * n] from the film to a grid over the pupil that a bundle fills, and the area of its cells [F]."""
    share = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    columns = []
    area = torch.ones_like(height)
    for place in (pupil.x, pupil.y):
        low = torch.nan_to_num(place, nan=torch.inf).amin(1)
        high = torch.nan_to_num(place, nan=-torch.inf).amax(1)
        low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
        columns.append(low[:, None] + (high - low)[:, None] * share)
        area = area * (high - low) / n**2
    shape = (len(height), n, n)
    px, py = columns[0][:, :, None].expand(shape).reshape(-1), columns[1][:, None, :].expand(shape).reshape(-1)
    h, zero = (-height)[:, None, None].expand(shape).reshape(-1), torch.zeros_like(px)
    x, y = (h, zero) if scene.axis == "x" else (zero, h)
    return camera_rays(x, y, scene.film_z_mm, px, py, pupil_plane_z_mm(scene.lens)), area
