"""The pupils of the literature for the exact lens, each widened until it holds the outline of what passes.

Found at one wavelength, some of them lose light (a paraxial exit pupil up to 12% of it; `python -m experiments
pupils`): then pictures would differ in brightness. Widened, they differ in the share of rays that pass, and in noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.optics import pupil_methods as known
from neurolens.optics.prescription import Lens
from neurolens.optics.pupil_methods import RadialPupil

OUTLINE = "outline"
_MAKERS: dict[str, Callable[[Lens, float], RadialPupil]] = {
    "rear-rim": known.rear_rim,
    "exit-pupil": known.global_exit_pupil,
    "wu": known.wu_exit_pupil,
    "pixel-disc": lambda lens, end: known.pixel_pupils(lens, end, "disc"),
    "pixel-ellipse": lambda lens, end: known.pixel_pupils(lens, end, "ellipse"),
    "boxes": lambda lens, end: known.radial_bounds(lens, end, "box"),
    "ellipses": lambda lens, end: known.radial_bounds(lens, end, "ellipse"),
}
PUPILS = (OUTLINE, *_MAKERS)

_HAIR = 1.001  # between the film radii at which a pupil is held against the outline
_BETWEEN = 4  # film radii of the outline between two of its rows


@dataclass(frozen=True)
class HeldPupil:
    """A pupil on a plane of its own, sampled as the outline is, on the outline's plane.

    Attributes:
        pupil: what is sampled. film_z_mm, plane_z_mm: of the film, and of the plane that points are wanted on.
    """

    pupil: RadialPupil
    film_z_mm: float
    plane_z_mm: float

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `PupilOutline.sample`; every wavelength has the same pupil."""
        finite = np.isfinite(film_mm).all(0)
        film = np.where(finite, film_mm, np.float32(0)).astype(np.float64)
        points, area = self.pupil.sample(film, square.astype(np.float64))
        stretch = (self.film_z_mm - self.plane_z_mm) / (self.film_z_mm - self.pupil.pupil_z_mm)
        held = (film + stretch * (points - film)).astype(np.float32)
        return held, (area * stretch**2 * finite).astype(np.float32)


def pupil_named(name: str, lens: Lens, outline: PupilOutline, film_z_mm: float) -> HeldPupil:
    """One of `PUPILS` other than the outline, for a focused lens.

    Raises:
        InputError: an unknown name, or a paraxial exit pupil at infinity.
    """
    if name not in _MAKERS:
        raise InputError("camera", "pupil", name, f"one of: {', '.join(PUPILS)}")
    found = _MAKERS[name](lens, outline.film_radius_mm)
    return HeldPupil(_holding(found, outline, film_z_mm), film_z_mm, outline.pupil_z_mm)


def _holding(pupil: RadialPupil, outline: PupilOutline, film_z_mm: float) -> RadialPupil:
    """The pupil with each of its shapes enlarged about its centre until it holds the outline at its film radii."""
    radius, x, y = _corners(outline)
    stretch = (film_z_mm - pupil.pupil_z_mm) / (film_z_mm - outline.pupil_z_mm)
    x, y = radius[:, None] + stretch * (x - radius[:, None]), stretch * y
    count = pupil.centre.size
    place = radius / pupil.film_radius_mm * count
    centre, along, across = pupil.centre.copy(), pupil.along.copy(), pupil.across.copy()
    for row in range(count):
        # The ends of the interval belong to it, and their nearest radii of the outline on either side.
        inside = np.flatnonzero((place >= row) & (place <= row + 1))
        first, last = np.searchsorted(place, [row, row + 1])
        rows = np.unique(np.clip(np.concatenate([inside, [first - 1, last]]), 0, radius.size - 1))
        u, v = x[rows], np.abs(y[rows])
        if along[row] <= 0 or across[row] <= 0:  # no ray was found, where the outline holds some
            centre[row] = (u.max() + u.min()) / 2
            along[row], across[row] = max((u.max() - u.min()) / 2, 1e-9), max(float(v.max()), 1e-9)
        u, v = np.abs(u - centre[row]) / along[row], v / across[row]
        reach = np.maximum(u, v) if pupil.shape == "box" else np.hypot(u, v)
        scale = max(_HAIR * float(reach.max()), 1.0)
        along[row], across[row] = along[row] * scale, across[row] * scale
    return replace(pupil, centre=centre, along=along, across=across)


def _corners(outline: PupilOutline) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Film radii [R'] and corners x, y [R', V] of the outline there, all its wavelengths together."""
    last = outline.centre.size - 1
    place = np.linspace(0, last, last * _BETWEEN + 1)
    row = np.minimum(place.astype(int), last - 1)
    step = (place - row)[:, None, None]
    x, y = (c.transpose(1, 0, 2).astype(np.float64) for c in (outline.centre[None, :, None] + outline.x, outline.y))
    x, y = ((1 - step) * c[row] + step * c[row + 1] for c in (x, y))
    return outline.radii(place), x.reshape(place.size, -1), y.reshape(place.size, -1)
