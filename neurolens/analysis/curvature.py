"""Field curvature and astigmatism: where close rays about the chief ray come to a focus.

By close-ray differences: rays that cross the stop a thousandth of its radius beside the chief ray, in the meridional
plane and across it. Coddington's equations are the limit of this for spheres; differences serve every surface alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import Scene
from neurolens.analysis.patterns import points
from neurolens.analysis.results import Array, Result
from neurolens.analysis.seidel import petzval_curvature
from neurolens.base.errors import InputError
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.paraxial import is_pinhole

_CLOSE = 1e-3  # stop radii; differences are central, so that the error is of the order of its square


@dataclass(frozen=True)
class Curvature(Result):
    """Foci over F fields from the axis to the edge, one wavelength.

    Attributes:
        field_deg, height_mm: [F] of the chief ray.
        tangential_mm, sagittal_mm: [F] along the axis from the film, positive away from the lens.
        petzval_mm: [F] the Petzval surface at these heights, drawn through the sagittal focus on the axis.
        petzval_radius_mm: its radius, positive when its centre lies towards +z; inf when flat; NaN with cylinders.
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    tangential_mm: Array
    sagittal_mm: Array
    petzval_mm: Array
    petzval_radius_mm: float

    @property
    def astigmatism_mm(self) -> Array:
        """Tangential less sagittal focus, [F]."""
        return self.tangential_mm - self.sagittal_mm


def curvature(
    scene: Scene, *, wavelength_nm: float = LINE_D_NM, fields: int = 31, edge_deg: float | None = None
) -> Curvature:
    """Sagittal and tangential foci up to the edge of the field, rims left out of account.

    Raises:
        InputError: a pinhole, which has no focus.
    """
    if is_pinhole(scene.lens):
        raise InputError(scene.lens.path, "surfaces", "(a pinhole)", "a lens with power")
    angles = np.linspace(0, scene.edge_deg() if edge_deg is None else edge_deg, fields)
    pattern = points([-_CLOSE, _CLOSE, 0.0, 0.0], [0.0, 0.0, -_CLOSE, _CLOSE])
    rays = bundle(scene.open, angles.tolist(), [wavelength_nm], pattern)
    slope_t, slope_s = rays.slopes
    tangential = _crossing(rays.tangential_mm[:, 0, :2], slope_t[:, 0, :2])
    sagittal = _crossing(rays.sagittal_mm[:, 0, 2:], slope_s[:, 0, 2:])
    height = rays.chief_height_mm.numpy()
    bend = petzval_curvature(scene.lens, wavelength_nm)
    return Curvature(
        wavelength_nm, angles, height, tangential, sagittal,
        sagittal[0] + bend * height**2 / 2,
        float("inf") if bend == 0 else 1 / bend,
    )  # fmt: skip


def _crossing(place: Tensor, slope: Tensor) -> Array:
    """z from the film at which two rays [F, 2] cross."""
    return (-(place[:, 1] - place[:, 0]) / (slope[:, 1] - slope[:, 0])).numpy()
