"""Point spread, geometric and by diffraction, with the wavefront by the path lengths of the exact trace."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import Bundle, bundle, grid, hexapolar, points
from neurolens.analysis.fields import DEFAULT_NM, Array, Result, Scene
from neurolens.analysis.spots import working_f_number


def opd_mm(rays: Bundle) -> Tensor:
    """Path difference [F, W, P] in mm from the chief ray of each wavelength, NaN where a ray is blocked.

    Positive as for an undercorrected lens. Each ray's path is taken to its foot of the perpendicular from the chief
    ray's film point (of the first wavelength): a reference sphere about that point whose radius is large against the
    aberrations.
    """
    chief = bundle(rays.scene.open, rays.field_deg, rays.wavelength_nm, points([0.0], [0.0]))
    return path_to_chief_mm(chief) - path_to_chief_mm(rays)


def path_to_chief_mm(rays: Bundle) -> Tensor:
    """Optical path to the plane through the chief ray's film point that stands on the ray, [F, W, P].

    Raises:
        InputError: a lens with ideal surfaces, which have a law of rays and none of phases.
    """
    rays.scene.lens.require_glass("optical path")
    along_t, along_s = cosines(rays)
    return rays.path_mm - rays.tangential_mm * along_t - rays.sagittal_mm * along_s


def cosines(rays: Bundle) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal direction cosine at the film, [F, W, P]."""
    x, y = rays.film.dx, rays.film.dy
    return (-x, y) if rays.scene.axis == "x" else (-y, x)


_BINS, _POINTS = 49, 97  # of the geometric and the diffraction image, odd: one on the centre
_FINEST = 128  # points across the pupil that are still traced
_HELD = 0.98  # share of the geometric spot's energy that the window holds


@dataclass(frozen=True)
class Psf(Result):
    """Point spread of F fields; images are indexed [tangential, sagittal], centred on the spot's centroid.

    Attributes:
        half_width_um: [F], from the centre of the image to its edge; NaN without light.
        geometric: [F, 49, 49] share of all wavelengths' energy in each square; what lies outside is missing; NaN
            without light.
        diffraction: [F, 97, 97] at the first wavelength, 1 at the peak of the same pupil without aberrations; NaN where
            the aberrations are too large for it (then diffraction is negligible against `geometric`) or almost
            no light arrives.
        strehl: [F], greatest value of `diffraction`.
        pupil_points: [F], points across the pupil that the diffraction image needs; 0 without light.
        airy_um: radius of the first dark ring on the axis.
    """

    field_deg: Array
    wavelength_nm: Array
    half_width_um: Array
    geometric: Array
    diffraction: Array
    strehl: Array
    pupil_points: Array
    airy_um: float


def psf(scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] = DEFAULT_NM) -> Psf:
    """Point spread of fields; the window holds the spot and six Airy radii.

    Raises:
        InputError: a pinhole, whose rays do not meet: it has no focus that waves could be summed about.
    """
    scene.require_power()
    airy = 1.22e-3 * wavelength_nm[0] * working_f_number(scene, wavelength_nm[0])
    rays = bundle(scene, field_deg, wavelength_nm, grid(64))
    half, geometric, diffraction, needed = [], [], [], []
    for k, field in enumerate(rays.field_deg):
        t, s, w = (v[k].flatten() for v in (rays.tangential_mm, rays.sagittal_mm, rays.weight))
        centre, radius = _spot(t, s, w)
        window = max(6e-3 * np.nan_to_num(airy), 1.1 * radius)
        if not (window > 0 and w.sum() > 0):
            window = math.nan
        geometric.append(_histogram(t - centre[0], s - centre[1], w, window))
        count = _needed(scene, field, wavelength_nm[0], window)
        diffraction.append(_diffraction(scene, field, wavelength_nm[0], count, centre, window))
        half.append(1000 * window)
        needed.append(count)
    return Psf(
        np.array(rays.field_deg), np.array(wavelength_nm), np.array(half), np.stack(geometric), np.stack(diffraction),
        np.stack(diffraction).max((1, 2)), np.array(needed, dtype=np.float64), airy,
    )  # fmt: skip


def _spot(t: Tensor, s: Tensor, w: Tensor) -> tuple[tuple[float, float], float]:
    """Centroid (mm) and the radius about it that holds most of the energy."""
    if not w.sum() > 0:
        return (0.0, 0.0), 0.0
    t, s = torch.nan_to_num(t), torch.nan_to_num(s)
    centre = (float((w * t).sum() / w.sum()), float((w * s).sum() / w.sum()))
    away, order = torch.hypot(t - centre[0], s - centre[1]).sort()
    held = w[order].cumsum(0) / w.sum()
    return centre, float(away[min(int((held < _HELD).sum()), len(away) - 1)])


def _histogram(t: Tensor, s: Tensor, w: Tensor, half_mm: float) -> Array:
    if math.isnan(half_mm):
        return np.full((_BINS, _BINS), np.nan)
    keep = w > 0
    edges = np.linspace(-half_mm, half_mm, _BINS + 1)
    found: Array
    found, _, _ = np.histogram2d(t[keep].numpy(), s[keep].numpy(), bins=(edges, edges), weights=w[keep].numpy())
    return found / float(w.sum())


def _needed(scene: Scene, field: float, wavelength_nm: float, half_mm: float) -> int:
    """Points across the pupil so that the phase anywhere in the window turns by less than half a turn between two."""
    rays = bundle(scene, [field], [wavelength_nm], hexapolar(6))
    t, s = cosines(rays)
    if math.isnan(half_mm) or not rays.passed.any():
        return 0
    span = max(float(np.nanmax(v) - np.nanmin(v)) for v in (t.numpy(), s.numpy()))
    blur = float(torch.nan_to_num(torch.hypot(rays.tangential_mm, rays.sagittal_mm)).max())
    return max(32, math.ceil(span * 2 * (math.sqrt(2) * half_mm + blur) / (wavelength_nm * 1e-6)))


def _diffraction(
    scene: Scene, field: float, wavelength_nm: float, count: int, centre: tuple[float, float], half_mm: float
) -> Array:
    if not 0 < count <= _FINEST:
        return np.full((_POINTS, _POINTS), np.nan)
    return diffraction_image(bundle(scene, [field], [wavelength_nm], grid(count)), centre, half_mm)


def diffraction_image(rays: Bundle, centre_mm: tuple[float, float], half_mm: float, points: int = _POINTS) -> Array:
    """Diffraction image of a bundle of one field and one wavelength, [points, points]; see `Psf.diffraction`.

    Its centre is given as tangential and sagittal distance from the chief ray's film point.
    """
    wave = 2 * math.pi / (rays.wavelength_nm[0] * 1e-6)
    keep = rays.passed[0, 0]
    t, s = (c[0, 0][keep] for c in cosines(rays))
    path, weight = path_to_chief_mm(rays)[0, 0][keep], rays.weight[0, 0][keep]
    # Paths are metres of waves: only their differences may be turned into phases.
    lead = path - path.mean() + t * centre_mm[0] + s * centre_mm[1]
    amplitude = torch.polar(weight / weight.sum(), wave * lead)
    line = torch.linspace(-half_mm, half_mm, points, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    along, across = (torch.polar(one, wave * line[:, None] * c) for c in (t, s))
    image: Array = ((along * amplitude) @ across.T).abs().square().numpy()
    return image
