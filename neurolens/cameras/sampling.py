"""What the cameras share: the map from the unit square to a disk, and checks of their arguments."""

from __future__ import annotations

import math

import numpy as np

from neurolens.cameras.contract import FloatArray
from neurolens.errors import InputError


def concentric_disk(square: FloatArray) -> FloatArray:
    """Map points [2, N] of the unit square to the unit disk [2, N], keeping areas and neighbours.

    The ideal cameras use it for their pupil; lenses and their models map the square to the outline of what passes
    (`pupil_outline`). Source: Shirley and Chiu 1997, "A low distortion map between disk and square".
    """
    a = square[0] * np.float32(2) - np.float32(1)
    b = square[1] * np.float32(2) - np.float32(1)
    swap = np.abs(b) > np.abs(a)
    radius = np.where(swap, b, a)
    other = np.where(swap, a, b)
    angle = other * np.float32(math.pi / 4)
    # The centre, radius 0, has no direction: dividing by 1 there leaves the angle 0 and the point at the origin.
    angle /= np.where(radius == 0, np.float32(1), radius)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([radius * np.where(swap, sin, cos), radius * np.where(swap, cos, sin)])


def positive(field: str, value: float, *, infinite: bool = False) -> float:
    """`value` as a float above 0, finite unless `infinite` is allowed.

    Raises:
        InputError: names the field otherwise.
    """
    expected = "a number above 0" if infinite else "a finite number above 0"
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
        raise InputError("camera", field, value, expected)
    if math.isinf(value) and not infinite:
        raise InputError("camera", field, value, expected)
    return float(value)


def check_film(film_mm: tuple[float, float]) -> tuple[float, float]:
    """Width and height of the film as two floats above 0.

    Raises:
        InputError: it is not two such numbers.
    """
    if len(film_mm) != 2:
        raise InputError("camera", "film_mm", film_mm, "a width and a height")
    return positive("film_mm width", film_mm[0]), positive("film_mm height", film_mm[1])
