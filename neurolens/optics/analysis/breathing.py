"""Focus breathing: how field of view, focal length and magnification of a lens change with its focus."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.analysis.plots import FIELD_COLOURS, drawing, plain_log_ticks
from neurolens.optics.lens.paraxial import chief_reach_mm, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import FocusMode
from neurolens.optics.setting.focusing import focus_states, focused_inside, nearest_focus_m
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import set_lens


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
    """Describe a lens, set to its zoom position, at several focus distances from object to film; inf is allowed.

    h is the radius of the image circle at infinity focus (the film does not grow), x' the film's distance behind the
    rear focal point. Then the magnification is -x'/f, and the chief ray of the film's edge leaves at atan(h /
    `paraxial.chief_reach_mm`).

    Raises:
        InputError: there is no distance, or one that the lens does not reach; "internal" for a lens without focus
            states.
    """
    if not focus_m:
        raise InputError("breathing", "focus_m", "(none)", "distances in m")
    radius, breaths = image_radius_mm(set_lens(lens))[0], []
    for distance in focus_m:
        inside = focus_mode == "internal"
        state = focused_inside(lens, distance) if inside else set_lens(lens, focus_m=distance, focus_mode=focus_mode)
        data, reach, film_z = first_order(state), chief_reach_mm(state), state.film_z_mm
        assert film_z is not None
        breaths.append(
            Breath(
                focus_m=float(distance),
                efl_mm=float(data.efl_mm),
                magnification=float(-(film_z - data.rear_focal_z_mm) / data.efl_mm),
                field_deg=2 * math.degrees(math.atan2(radius, reach)),
                film_z_mm=float(film_z),
                working_f_number=float(abs(reach * data.efl_mm / data.front_efl_mm) / data.entrance_pupil_diameter_mm),
            )
        )
    return breaths


def field_change(breaths: Sequence[Breath]) -> float:
    """Return the largest size of the picture over the smallest, less 1: 0 for a lens that does not breathe."""
    tangents = [math.tan(math.radians(b.field_deg / 2)) for b in breaths]
    return max(tangents) / min(tangents) - 1


_DASHES = ((0, ()), (0, (5, 2)))


def draw_breathing(lens: Lens, path: str | Path, count: int = 48) -> dict[str, list[Breath]]:
    """Compute and draw a lens's breathing from its nearest focus to a thousand focal lengths.

    Three panels share one logarithmic axis of distance, on which infinity has no place. There is a line for each way to
    focus: two where the lens file has focus states. Returns what is drawn, infinity first.
    """
    data = first_order(set_lens(lens))
    nearest = 1.05 * (4 * abs(data.efl_mm) + data.rear_principal_z_mm - data.front_principal_z_mm) / 1000
    modes: dict[str, FocusMode] = {"film moves": "paraxial"}
    if focus_states(lens):
        modes["groups move"] = "internal"
        nearest = max(nearest, 1.0001 * nearest_focus_m(lens))
    far = max(abs(data.efl_mm), 10 * nearest)
    distances = [nearest * (far / nearest) ** (k / (count - 1)) for k in range(count)]
    found = {name: breathing(lens, [math.inf, *distances], mode) for name, mode in modes.items()}
    with drawing(path, 7.6, 7.4) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for (name, breaths), colour, dashes in zip(found.items(), FIELD_COLOURS, _DASHES, strict=False):
            label = f"{name} (picture grows by {100 * field_change(breaths):.1f}%)"
            near = [(b.field_deg, b.efl_mm, abs(b.magnification)) for b in breaths[1:]]
            for axes, values in zip(panels, zip(*near, strict=True), strict=True):
                axes.plot(distances, values, color=colour, ls=dashes, lw=1.8, label=label)
        panels[0].set_title(f"Focus breathing of {lens.name}", loc="left", fontweight="bold")
        panels[0].legend(loc="best")
        labels = ("field of view (degrees,\nwithout distortion)", "focal length (mm)", "magnification")
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
            axes.grid(True)
            axes.ticklabel_format(axis="y", useOffset=False)
        panels[2].set(xscale="log", yscale="log", xlabel="distance from object to film (m)")
        plain_log_ticks(panels[2].xaxis, panels[2].yaxis)
    return found
