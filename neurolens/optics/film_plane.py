"""Where the film lies for an object distance: first-order focusing, shared by lenses and cameras."""

from __future__ import annotations

import math
from pathlib import Path

from neurolens.base.errors import InputError


def film_z_mm(
    efl_mm: float, front_principal_z_mm: float, rear_principal_z_mm: float, focus_m: float, file: str | Path = "camera"
) -> float:
    """Film plane (mm, frame of the principal planes) that focuses an object `focus_m` metres from the film.

    With D that distance less the separation of the principal planes, the image lies behind the rear one by the smaller
    root of s'^2 - D s' + D f = 0. Written 2 D f / (D + sqrt(D (D - 4 f))) it keeps its digits: the usual form,
    (D - sqrt(D (D - 4 f))) / 2, is the difference of two numbers that are nearly equal for a far object.

    Args:
        focus_m: inf allowed.
        file: what an error names.

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
