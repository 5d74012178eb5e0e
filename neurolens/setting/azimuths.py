"""Azimuths at which lenses with cylinders are searched for what passes.

They lie 5 degrees apart, for at 15 a lens lost 7% of its corners. Its two planes of symmetry give the rest:
what passes at -a is the mirror image of what passes at a.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEP_DEG = 5
AZIMUTHS = tuple(math.radians(_STEP_DEG * k) for k in range(-18, 19))
# In groups, the first of which find most of what passes.
GROUPS = (AZIMUTHS[18:19], AZIMUTHS[::9], tuple(a for k, a in enumerate(AZIMUTHS) if k % 9))
# Azimuths of a film are those at radii this share smaller too: outlines are interpolated between radii.
_BETWEEN_RADII = 0.03


def azimuths_on_film(film_radius: Array, film_mm: tuple[float, float]) -> tuple[Array, Array]:
    """Least and largest azimuth in the first quadrant, rad [N], at which a centred film has points that far out.

    With half a step of `AZIMUTHS` beyond either; beyond the corner, those about the corner's.
    """
    width, height = film_mm
    radius = np.maximum(film_radius * (1 - _BETWEEN_RADII), 1e-12)
    low, high = np.arccos(np.minimum(width / 2 / radius, 1)), np.arcsin(np.minimum(height / 2 / radius, 1))
    corner = math.atan2(height, width)
    beyond = 1.001 * math.radians(_STEP_DEG) / 2
    return np.minimum(low, corner) - beyond, np.maximum(high, corner) + beyond
