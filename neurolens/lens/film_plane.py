"""Film, pupils and framing to first order, and the colours of best focus; for lenses and cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError

LINE_D_NM = 587.5618  # helium, yellow: where first-order data stand
COLOURS = 7  # wavelengths that stand for a range
_LEAST = 1e-3  # weight of a colour that the eye does not see: infrared light has a focus, too


def film_z_mm(
    efl_mm: float,
    front_principal_z_mm: float,
    rear_principal_z_mm: float,
    focus_m: float,
    file: str | Path = "camera",
    ratio: float = 1.0,
) -> float:
    """Film plane (mm, frame of the principal planes) that focuses an object `focus_m` metres (or inf) from the film.

    `ratio` r is the index of the medium in front of the lens over that of the medium behind it. With D the distance
    less the separation of the principal planes, the image lies behind the rear one by the smaller root of
    s'^2 - B s' + D f = 0, B = D + (1 - r) f. Written 2 D f / (B + sqrt(B^2 - 4 D f)) it keeps its digits: the usual
    form, (B - sqrt(B^2 - 4 D f)) / 2, is the difference of two numbers that are nearly equal for a far object.

    Raises:
        InputError: an object nearer than (1 + sqrt(r))^2 focal lengths, which are four in one medium, or a distance
            that is not a positive number.
    """
    if not focus_m > 0:
        raise InputError(file, "focus_m", focus_m, "a distance in m above 0, or inf")
    if math.isinf(focus_m):
        return rear_principal_z_mm + efl_mm
    efl_mm, focus_m = float(efl_mm), float(focus_m)  # numbers of numpy would warn of overflow
    separation = rear_principal_z_mm - front_principal_z_mm
    d = 1000.0 * focus_m - separation
    lengths = (1 + math.sqrt(ratio)) ** 2
    if not (d > 0 and d >= lengths * efl_mm):
        nearest = (max(lengths * efl_mm, 0.0) + separation) / 1000
        count = "four" if ratio == 1 else f"{lengths:.3g}"
        raise InputError(file, "focus_m", focus_m, f"at least {nearest:.4g} m, {count} focal lengths")
    b = d + (1 - ratio) * efl_mm
    return rear_principal_z_mm + 2 * d * efl_mm / (b + math.sqrt(max(b * b - 4 * d * efl_mm, 0.0)))


def index_ratio(card_lens: Mapping[str, Any]) -> float:
    """The index in front of a model's lens over that behind it, 1 where the card's table of the lens has none."""
    return float(card_lens.get("index_ratio", 1.0))


def film_z_of_card_mm(card_lens: Mapping[str, Any], focus_m: float) -> float:
    """`film_z_mm` of the lens of a model's card."""
    efl, front, rear = (card_lens[key] for key in ("efl_mm", "front_principal_z_mm", "rear_principal_z_mm"))
    return film_z_mm(efl, front, rear, focus_m, ratio=index_ratio(card_lens))


def reach_mm(
    efl_mm: float, front_efl_mm: float, focal_z_mm: tuple[float, float], entrance_pupil_z_mm: float, film_z_mm: float
) -> float:
    """Film height (mm) over the slope of the chief ray, of a lens known by its focal points, front and rear, and pupil.

    f + x' e / f', with f and f' the focal lengths of the object and of the image side, x' the film's distance behind
    the rear focal point and e the pupil's behind the front one.
    """
    film, pupil = film_z_mm - focal_z_mm[1], entrance_pupil_z_mm - focal_z_mm[0]
    return float(front_efl_mm + film * pupil / efl_mm)


def entrance_pupil_z_mm(
    efl_mm: float, front_efl_mm: float, focal_z_mm: tuple[float, float], exit_pupil_z_mm: float
) -> float:
    """The entrance pupil of which the exit pupil (inf allowed) is the image, by the focal points (x x' = -f f')."""
    behind = exit_pupil_z_mm - focal_z_mm[1]
    return focal_z_mm[0] - efl_mm * front_efl_mm / behind if behind else math.inf


def colours(range_nm: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the wavelengths (nm) in the middle of equal parts of a range and their weights in the spot of best focus.

    A picture is judged by its luminance: weights are the eye's photopic sensitivity (CIE V, as a Gaussian of 559 nm).
    """
    low, high = range_nm
    count = COLOURS if low < high else 1
    nm = low + (high - low) * (np.arange(count) + 0.5) / count
    return nm, np.exp(-285.4e-6 * (nm - 559.0) ** 2) + _LEAST


@dataclass(frozen=True)
class PupilBounds:
    """Bounds of the passing rays on the pupil plane at equally spaced film radii (as pbrt: Pharr et al. 2016, 6.4.5).

    For a film point at radius r along +x, passing rays lie within `low` <= u <= `high` along +x and |v| <= `half`
    across.

    Attributes:
        pupil_z_mm: the plane.
        film_radius_mm: radius of the last row; the first row is the axis.
        low_mm, high_mm, half_mm: one value per film radius; an empty row (low > high) where no ray passes.
        disc_mm: radius of the axial disc that holds all passing rays.
    """

    pupil_z_mm: float
    film_radius_mm: float
    low_mm: tuple[float, ...]
    high_mm: tuple[float, ...]
    half_mm: tuple[float, ...]
    disc_mm: float

    @property
    def lit_radius_mm(self) -> float:
        """The first film radius from which on every row is empty; that of the film where its edge is lit."""
        rows = enumerate(zip(self.low_mm, self.high_mm, strict=True))
        last = max((k for k, (low, high) in rows if low <= high), default=0)
        return self.film_radius_mm * min(last + 1, len(self.low_mm) - 1) / (len(self.low_mm) - 1)
