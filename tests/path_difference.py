"""The optical path difference of rays from their chief ray, for tests of wavefronts."""

from torch import Tensor

from neurolens.optics.analysis.bundles import Bundle, bundle, points
from neurolens.optics.analysis.spots import path_to_chief_mm


def opd_mm(rays: Bundle) -> Tensor:
    """Path difference [F, W, P] in mm from the chief ray of each wavelength, NaN where a ray is blocked.

    It is positive as for an undercorrected lens. Each ray's path is taken to its foot of the perpendicular from the
    chief ray's film point (of the first wavelength): a reference sphere about that point whose radius is large against
    the aberrations.
    """
    chief = bundle(rays.scene.open, rays.field_deg, rays.wavelength_nm, points([0.0], [0.0]))
    return path_to_chief_mm(chief) - path_to_chief_mm(rays)
