"""Wavefront aberration: optical path differences at the film, from the path lengths of the exact trace."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import Bundle, bundle
from neurolens.analysis.fields import Scene
from neurolens.analysis.patterns import Pattern, hexapolar, points
from neurolens.analysis.results import Array, Result
from neurolens.optics.glass import LINE_D_NM


@dataclass(frozen=True)
class Wavefront(Result):
    """Wavefront of F fields at P pupil points, one wavelength.

    Attributes:
        pupil_tangential, pupil_sagittal: [P] shares of the stop's radius.
        opd_waves: [F, P], positive as for an undercorrected lens; about the chief ray's film point; NaN where blocked.
        rms_waves: [F], weighted by energy, less its mean and the tilt of best fit.
    """

    wavelength_nm: float
    field_deg: Array
    pupil_tangential: Array
    pupil_sagittal: Array
    opd_waves: Array
    rms_waves: Array


def wavefront(
    scene: Scene,
    field_deg: Sequence[float] | None = None,
    *,
    wavelength_nm: float = LINE_D_NM,
    pattern: Pattern | None = None,
) -> Wavefront:
    """Wavefront aberration on a hexapolar pattern of 12 rings, or on another."""
    pattern = pattern or hexapolar(12)
    rays = bundle(scene, scene.default_fields() if field_deg is None else field_deg, [wavelength_nm], pattern)
    waves = opd_mm(rays)[:, 0] / (wavelength_nm * 1e-6)
    film = torch.stack([torch.ones_like(waves), rays.film.dx[:, 0], rays.film.dy[:, 0]], -1)  # [F, P, 3]
    rms = [_rms(w, f, a) for w, f, a in zip(waves, film, rays.weight[:, 0], strict=True)]
    return Wavefront(
        wavelength_nm, np.array(rays.field_deg), pattern.tangential.numpy(), pattern.sagittal.numpy(),
        waves.numpy(), np.array(rms),
    )  # fmt: skip


def opd_mm(rays: Bundle) -> Tensor:
    """Path difference [F, W, P] in mm from the chief ray of each wavelength, NaN where a ray is blocked.

    Each ray's path is taken to its foot of the perpendicular from the chief ray's film point (of the first wavelength):
    a reference sphere about that point whose radius is large against the aberrations.
    """
    chief = bundle(rays.scene.open, rays.field_deg, rays.wavelength_nm, points([0.0], [0.0]))
    return path_to_chief_mm(chief) - path_to_chief_mm(rays)


def path_to_chief_mm(rays: Bundle) -> Tensor:
    """Optical path to the plane through the chief ray's film point that stands on the ray, [F, W, P]."""
    along_t, along_s = cosines(rays)
    return rays.path_mm - rays.tangential_mm * along_t - rays.sagittal_mm * along_s


def cosines(rays: Bundle) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal direction cosine at the film, [F, W, P]."""
    x, y = rays.film.dx, rays.film.dy
    return (-x, y) if rays.scene.axis == "x" else (-y, x)


def _rms(waves: Tensor, film: Tensor, weight: Tensor) -> float:
    seen = torch.isfinite(waves) & (weight > 0)
    if int(seen.sum()) < 4:
        return math.nan
    root = torch.sqrt(weight[seen] / weight[seen].sum())
    a, b = film[seen] * root[:, None], waves[seen] * root
    fit = torch.linalg.lstsq(a, b[:, None]).solution[:, 0]
    return float(torch.linalg.vector_norm(b - a @ fit))
