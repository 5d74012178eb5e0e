"""The optical path of rays, and sums of waves over rays, for tests of wavefronts and of point spread."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.optics.analysis.bundles import Bundle, bundle, points


def opd_mm(rays: Bundle) -> Tensor:
    """Path difference [F, W, P] in mm from the chief ray of each wavelength, NaN where a ray is blocked.

    It is positive as for an undercorrected lens. Each ray's path is taken to its foot of the perpendicular from the
    chief ray's film point (of the first wavelength): a reference sphere about that point whose radius is large against
    the aberrations.
    """
    chief = bundle(rays.scene.open, rays.field_deg, rays.wavelength_nm, points([0.0], [0.0]))
    return path_to_chief_mm(chief) - path_to_chief_mm(rays)


def path_to_chief_mm(rays: Bundle) -> Tensor:
    """Return the optical path [F, W, P] to the plane across the ray through the chief ray's film point.

    Raises:
        InputError: the lens has ideal surfaces, which have a law of rays and none of phases.
    """
    rays.scene.lens.require_glass("optical path")
    along_t, along_s = rays.cosines
    return rays.path_mm - rays.tangential_mm * along_t - rays.sagittal_mm * along_s


def diffraction_image(
    rays: Bundle, centre_mm: tuple[float, float], half_mm: float, points: int, field: int = 0
) -> NDArray[np.float64]:
    """Sum waves over the rays of a field of a bundle, at its first wavelength: the image [points, points] of `Psf`.

    Its centre is given as tangential and sagittal distance from the chief ray's film point.
    """
    wave = 2 * math.pi / (rays.wavelength_nm[0] * 1e-6)
    keep = rays.passed[field, 0]
    t, s = (c[field, 0][keep] for c in rays.cosines)
    path, weight = path_to_chief_mm(rays)[field, 0][keep], rays.weight[field, 0][keep]
    # Paths are metres of waves: only their differences keep the digits of a phase.
    lead = path - path.mean() + t * centre_mm[0] + s * centre_mm[1]
    amplitude = torch.polar(weight / weight.sum(), wave * lead)
    line = torch.linspace(-half_mm, half_mm, points, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    along, across = (torch.polar(one, wave * line[:, None] * c) for c in (t, s))
    return np.asarray(((along * amplitude) @ across.T).abs().square().numpy())
