"""Point spread, geometric and by diffraction, with the wavefront by the path lengths of the exact trace."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import Bundle, Filled, bundle, points
from neurolens.analysis.fields import Array, Result, Scene
from neurolens.analysis.pupil_nodes import LEVELS, converged
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
        spread: by figure, [F, ...], by how much two samplings of the pupil differ (`pupil_nodes.converged`).
    """

    field_deg: Array
    wavelength_nm: Array
    half_width_um: Array
    geometric: Array
    diffraction: Array
    strehl: Array
    pupil_points: Array
    airy_um: float
    spread: dict[str, Array]


def psf(scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None) -> Psf:
    """Point spread of fields; the window holds the spot and six Airy radii.

    Raises:
        InputError: a pinhole, whose rays do not meet: it has no focus that waves could be summed about.
    """
    scene.require_power()
    filled = Filled(scene, field_deg, wavelength_nm)
    airy = 1.22e-3 * filled.waves[0] * working_f_number(scene, filled.waves[0])
    least_mm = 6e-3 * float(np.nan_to_num(airy))

    def images(level: int, fields: list[int]) -> list[Array]:
        return _images(filled.only(fields).bundle(level, path=True), least_mm)

    def shown(found: list[Array]) -> dict[str, tuple[Array, Array | float]]:
        return {"half_width_um": (found[0], 20 * found[0]), "strehl": (found[2].max((1, 2)), 1.0)}

    (half, centre, diffraction, needed), spread = converged(images, shown, len(filled.fields), first=1)
    rays = filled.bundle(LEVELS - 1)  # a picture needs rays in every square, whatever figures need
    spots = zip(rays.tangential_mm, rays.sagittal_mm, rays.weight, centre, half, strict=True)
    geometric = np.stack([_histogram(t - c[0], s - c[1], w, h / 1000) for t, s, w, c, h in spots])
    return Psf(
        np.array(filled.fields), np.array(filled.waves), half, geometric, diffraction, diffraction.max((1, 2)), needed,
        airy, spread,
    )  # fmt: skip


def _images(rays: Bundle, least_mm: float) -> list[Array]:
    """Half widths (um), centres (mm), diffraction images and points across the pupil that these need, [F, ...].

    In windows of at least some half width.
    """
    rows = []
    for k in range(len(rays.field_deg)):
        t, s, w = (v[k].flatten() for v in (rays.tangential_mm, rays.sagittal_mm, rays.weight))
        centre, radius = _spot(t, s, w)
        window = max(least_mm, 1.1 * radius)
        if not (window > 0 and w.sum() > 0):
            window = math.nan
        needed, image = _needed(rays, k, window), np.full((_POINTS, _POINTS), np.nan)
        if 0 < needed <= _FINEST:
            image = diffraction_image(rays, centre, window, field=k)
        rows.append((1000 * window, centre, image, float(needed)))
    return [np.array(column) for column in zip(*rows, strict=True)]


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


def _needed(rays: Bundle, field: int, half_mm: float) -> int:
    """Points across the pupil so that the phase anywhere in the window turns by less than half a turn between two."""
    if math.isnan(half_mm) or not rays.passed[field].any():
        return 0
    span = max(float(np.nanmax(v[field]) - np.nanmin(v[field])) for v in cosines(rays))
    blur = float(torch.nan_to_num(torch.hypot(rays.tangential_mm[field], rays.sagittal_mm[field])).max())
    return max(32, math.ceil(span * 2 * (math.sqrt(2) * half_mm + blur) / (rays.wavelength_nm[0] * 1e-6)))


def diffraction_image(
    rays: Bundle, centre_mm: tuple[float, float], half_mm: float, points: int = _POINTS, field: int = 0
) -> Array:
    """Diffraction image of a field of a bundle at its first wavelength, [points, points]; see `Psf.diffraction`.

    Its centre is given as tangential and sagittal distance from the chief ray's film point.
    """
    wave = 2 * math.pi / (rays.wavelength_nm[0] * 1e-6)
    keep = rays.passed[field, 0]
    t, s = (c[field, 0][keep] for c in cosines(rays))
    path, weight = path_to_chief_mm(rays)[field, 0][keep], rays.weight[field, 0][keep]
    # Paths are metres of waves: only their differences may be turned into phases.
    lead = path - path.mean() + t * centre_mm[0] + s * centre_mm[1]
    amplitude = torch.polar(weight / weight.sum(), wave * lead)
    line = torch.linspace(-half_mm, half_mm, points, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    along, across = (torch.polar(one, wave * line[:, None] * c) for c in (t, s))
    image: Array = ((along * amplitude) @ across.T).abs().square().numpy()
    return image
