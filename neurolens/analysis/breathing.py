"""Focus breathing: how the picture of a lens grows or shrinks when the lens is focused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from neurolens.base.errors import InputError
from neurolens.lens import paraxial
from neurolens.lens.prescription import Lens
from neurolens.lens.shot import FocusMode
from neurolens.setting.pupils import image_radius_mm
from neurolens.setting.states import set_lens


@dataclass(frozen=True)
class Breath:
    """A lens at one focus distance, to first order (distortion is left out).

    Attributes:
        focus_m: from object to film.
        efl_mm: focal length of the groups in this state.
        magnification: image over object height, negative for an inverted image; 0 at infinity.
        field_deg: full field of view across the image circle, seen from the entrance pupil.
        film_z_mm: film plane, lens frame.
        working_f_number: 1 / (2 tan theta') of the paraxial marginal ray.
    """

    focus_m: float
    efl_mm: float
    magnification: float
    field_deg: float
    film_z_mm: float
    working_f_number: float


def breathing(lens: Lens, focus_m: Sequence[float], focus_mode: FocusMode = "paraxial") -> list[Breath]:
    """The lens, in the zoom position wanted, at several focus distances from object to film, `inf` allowed.

    With h the radius of the image circle at infinity focus (the film does not grow) and x' the film's distance behind
    the rear focal point: the magnification is -x'/f, and the chief ray of the film's edge leaves at
    atan(h / `paraxial.chief_reach_mm`).

    Raises:
        InputError: no distance, or one that the lens does not reach; "internal" for a lens without focus states.
    """
    if not focus_m:
        raise InputError("breathing", "focus_m", "(none)", "distances in m")
    radius, _ = image_radius_mm(set_lens(lens))
    found = []
    for distance in focus_m:
        state = set_lens(lens, focus_m=distance, focus_mode=focus_mode)
        data = paraxial.first_order(state)
        assert state.film_z_mm is not None
        extension = state.film_z_mm - data.rear_focal_z_mm
        reach = paraxial.chief_reach_mm(state)
        found.append(
            Breath(
                focus_m=float(distance),
                efl_mm=float(data.efl_mm),
                magnification=float(-extension / data.efl_mm),
                field_deg=2 * math.degrees(math.atan2(radius, reach)),
                film_z_mm=float(state.film_z_mm),
                working_f_number=float(abs(reach * data.efl_mm / data.front_efl_mm) / data.entrance_pupil_diameter_mm),
            )
        )
    return found


def field_change(breaths: Sequence[Breath]) -> float:
    """Largest size of the picture over the smallest, less 1: 0 for a lens that does not breathe."""
    tangents = [math.tan(math.radians(b.field_deg / 2)) for b in breaths]
    return max(tangents) / min(tangents) - 1
