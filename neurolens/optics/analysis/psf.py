"""Point spread of fields by rays and by diffraction, as `neurolens analyse` shows it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from neurolens.base.report import BULK, Report, over
from neurolens.optics.analysis.bundles import Filled
from neurolens.optics.analysis.diffraction import FINEST, cells_needed, cells_of, irradiance, perfect_peak, pupils
from neurolens.optics.analysis.exit_pupil import ExitPupil
from neurolens.optics.analysis.fields import Array, Scene
from neurolens.optics.analysis.spots import airy
from neurolens.optics.setting.pupil_nodes import LEVELS, converged

_BINS, _POINTS = 49, 97  # points a side of the geometric and the diffraction image; odd, so that one is in the centre
_ENCIRCLED = 0.98  # share of the geometric spot's energy inside the window


@dataclass(frozen=True)
class Psf(Report):
    """Point spread of F fields; images are indexed [tangential, sagittal], centred on the spot's centroid.

    Attributes:
        half_width_um: [F], from the centre of the image to its edge; NaN without light.
        geometric: [F, 49, 49] share of all wavelengths' energy in each square, without what lies outside; NaN without
            light.
        diffraction: [F, 97, 97] at the first wavelength; 1 is the peak of the same pupil without aberrations. NaN where
            the aberrations are too large for it (diffraction is then negligible against `geometric`) or almost no light
            arrives.
        strehl: [F] the greatest value of `diffraction`.
        pupil_points: [F] how many points across the pupil the diffraction image needs; 0 without light.
        airy_um: radius of the first dark ring on the axis.
        spread: for each figure by name, [F, ...], how much two samplings of the pupil differ (`pupil_nodes.converged`).
    """

    field_deg: Array
    wavelength_nm: Array
    half_width_um: Array = field(metadata=over("field_deg"))
    geometric: Array = field(metadata=BULK)
    diffraction: Array = field(metadata=BULK)
    strehl: Array = field(metadata=over("field_deg"))
    pupil_points: Array = field(metadata=over("field_deg"))
    airy_um: float
    spread: dict[str, Array] = field(metadata=over())


def psf(scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None) -> Psf:
    """Compute the point spread of fields, in a window that holds the spot and six Airy radii.

    Raises:
        InputError: the lens is a pinhole, whose rays do not meet: there is no focus about which waves could be summed.
    """
    scene.require_power()
    filled = Filled(scene, field_deg, wavelength_nm)
    scene.lens.require_glass("optical path")
    _, dark_um = airy(scene, filled.waves[0])
    least_mm = 6e-3 * float(np.nan_to_num(dark_um))
    waves = [found[0][0] for found in pupils(scene, filled.fields, filled.waves[:1])]

    def images(level: int, fields: list[int]) -> list[Array]:
        return _images(filled.only(fields), [waves[k] for k in fields], level, least_mm)

    def scaled(found: list[Array]) -> dict[str, tuple[Array, Array | float]]:
        return {"half_width_um": (found[0], 20 * found[0]), "strehl": (found[2].max((1, 2)), 1.0)}

    (half, centre, diffraction, needed), spread = converged(images, scaled, len(filled.fields), first=1)
    rays = filled.bundle(LEVELS - 1)  # a picture needs rays in every square, even where figures need fewer
    each = zip(rays.tangential_mm, rays.sagittal_mm, rays.weight, centre, half, strict=True)
    geometric = np.stack([_histogram(t - c[0], s - c[1], w, h / 1000) for t, s, w, c, h in each])
    return Psf(
        np.array(filled.fields), np.array(filled.waves), half, geometric, diffraction, diffraction.max((1, 2)), needed,
        dark_um, spread,
    )  # fmt: skip


def _images(filled: Filled, waves: Sequence[ExitPupil | None], level: int, least_mm: float) -> list[Array]:
    """Return half widths (um), centres (mm), diffraction images and the points across the pupil for these, [F, ...].

    The windows have at least the half width `least_mm`. `waves` are the pupils of the first wavelength.
    """
    rows, rays = [], filled.bundle(level)
    for k, pupil in enumerate(waves):
        t, s, w = (v[k].flatten() for v in (rays.tangential_mm, rays.sagittal_mm, rays.weight))
        centre, radius = _spot(t, s, w)
        half = max(least_mm, 1.1 * radius)
        if not (half > 0 and w.sum() > 0):
            half = math.nan
        cells, image = (0, 0), np.full((_POINTS, _POINTS), np.nan)
        if pupil is not None and not math.isnan(half):
            cells = cells_needed(pupil, math.sqrt(2) * half)
        if pupil is not None and 0 < max(cells) <= FINEST:
            line, field = np.linspace(-half, half, _POINTS), cells_of(pupil, tuple(n << (level - 1) for n in cells))
            chief = np.array([float(c[k]) for c in filled.chief.film[:2]]) - pupil.centre_mm
            # Tangential is along -x or -y of the film, sagittal along the other axis.
            if filled.scene.axis == "x":
                image = irradiance(pupil, chief[0] - centre[0] - line, chief[1] + centre[1] + line, field).T
            else:
                image = irradiance(pupil, chief[0] + centre[1] + line, chief[1] - centre[0] - line, field)
            image = image / perfect_peak(pupil, field)
        rows.append((1000 * half, centre, image, float(max(cells))))
    return [np.array(column) for column in zip(*rows, strict=True)]


def _spot(t: Tensor, s: Tensor, w: Tensor) -> tuple[tuple[float, float], float]:
    """Return the centroid (mm), and the radius about it that holds most of the energy."""
    if not w.sum() > 0:
        return (0.0, 0.0), 0.0
    t, s = torch.nan_to_num(t), torch.nan_to_num(s)
    centre = (float((w * t).sum() / w.sum()), float((w * s).sum() / w.sum()))
    away, order = torch.hypot(t - centre[0], s - centre[1]).sort()
    within = w[order].cumsum(0) / w.sum()
    return centre, float(away[min(int((within < _ENCIRCLED).sum()), len(away) - 1)])


def _histogram(t: Tensor, s: Tensor, w: Tensor, half_mm: float) -> Array:
    if math.isnan(half_mm):
        return np.full((_BINS, _BINS), np.nan)
    keep = w > 0
    edges = np.linspace(-half_mm, half_mm, _BINS + 1)
    counts, _, _ = np.histogram2d(t[keep].numpy(), s[keep].numpy(), bins=(edges, edges), weights=w[keep].numpy())
    return np.asarray(counts / float(w.sum()))
