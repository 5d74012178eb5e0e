"""Film, pupils and framing to first order, and the colours of best focus; for lenses and cameras."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError

LINE_D_NM = 587.5618  # helium, yellow: where first-order data stand
COLOURS = 7  # wavelengths that stand for a range
_LEAST = 1e-3  # weight of a colour that the eye does not see: infrared light has a focus, too


def film_z_mm(
    efl_mm: float, front_principal_z_mm: float, rear_principal_z_mm: float, focus_m: float, file: str | Path = "camera"
) -> float:
    """Film plane (mm, frame of the principal planes) that focuses an object `focus_m` metres (or inf) from the film.

    With D that distance less the separation of the principal planes, the image lies behind the rear one by the smaller
    root of s'^2 - D s' + D f = 0. Written 2 D f / (D + sqrt(D (D - 4 f))) it keeps its digits: the usual form,
    (D - sqrt(D (D - 4 f))) / 2, is the difference of two numbers that are nearly equal for a far object.

    Raises:
        InputError: an object nearer than four focal lengths, or a distance that is not a positive number.
    """
    if not focus_m > 0:
        raise InputError(file, "focus_m", focus_m, "a distance in m above 0, or inf")
    if math.isinf(focus_m):
        return rear_principal_z_mm + efl_mm
    separation = rear_principal_z_mm - front_principal_z_mm
    d = 1000.0 * focus_m - separation
    if not (d > 0 and d >= 4 * efl_mm):
        nearest = (max(4 * efl_mm, 0.0) + separation) / 1000
        raise InputError(file, "focus_m", focus_m, f"at least {nearest:.4g} m, four focal lengths")
    return rear_principal_z_mm + 2 * d * efl_mm / (d + math.sqrt(d * (d - 4 * efl_mm)))


def reach_mm(efl_mm: float, focal_z_mm: tuple[float, float], entrance_pupil_z_mm: float, film_z_mm: float) -> float:
    """Film height (mm) over the slope of the chief ray, of a lens known by its focal points, front and rear, and pupil.

    f + x' e / f, with x' the film's distance behind the rear focal point and e the pupil's behind the front one.
    """
    film, pupil = film_z_mm - focal_z_mm[1], entrance_pupil_z_mm - focal_z_mm[0]
    return float(efl_mm + film * pupil / efl_mm)


def entrance_pupil_z_mm(efl_mm: float, focal_z_mm: tuple[float, float], exit_pupil_z_mm: float) -> float:
    """The entrance pupil of which the exit pupil (inf allowed) is the image, by the focal points (x x' = -f^2)."""
    behind = exit_pupil_z_mm - focal_z_mm[1]
    return focal_z_mm[0] - efl_mm**2 / behind if behind else math.inf


def colours(range_nm: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wavelengths (nm) in the middle of equal parts of a range and their weights in the spot of best focus.

    A picture is judged by its luminance: weights are the eye's photopic sensitivity (CIE V, as a Gaussian of 559 nm).
    """
    low, high = range_nm
    count = COLOURS if low < high else 1
    nm = low + (high - low) * (np.arange(count) + 0.5) / count
    return nm, np.exp(-285.4e-6 * (nm - 559.0) ** 2) + _LEAST
