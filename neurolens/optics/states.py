"""What a photographer changes, in this order: zoom, size, f-number, focus. `Lens.at` is the front door."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import torch

from neurolens.base.errors import InputError
from neurolens.optics import paraxial
from neurolens.optics.aiming import aim_at_stop
from neurolens.optics.bestfocus import best_focus_z_mm
from neurolens.optics.internal import at_infinity, focused_inside, gaps_mm, zoom_state_of
from neurolens.optics.prescription import Configuration, Focus, Lens
from neurolens.optics.pupils import image_radius_mm
from neurolens.optics.trace import trace
from neurolens.optics.zoom import zoomed


def at(
    lens: Lens,
    focus_m: float | None,
    f_number: float | None,
    focal_length_mm: float | None,
    field_deg: float | None,
    zoom: str | float | None,
    focus: Focus,
) -> Lens:
    """The lens in another state; arguments and errors are those of `Lens.at`."""
    _check(lens, focus_m, f_number, focal_length_mm, field_deg, focus)
    if (
        f_number is not None
        and lens.film_z_mm is not None
        and (focus_m, focal_length_mm, field_deg, zoom) == (None,) * 4
    ):
        # Closing the stop leaves the focus where it is.
        return lens.with_stop_radius(paraxial.stop_radius_mm(at_infinity(lens), f_number))
    lens, object_mm = at_infinity(lens), None
    if isinstance(zoom, str) and zoom not in [c.name for c in lens.configurations]:
        zoom = _millimetres(zoom)
    if isinstance(zoom, str):
        state = state_named(lens, zoom)
        lens, object_mm = in_state(lens, state), state.object_distance_mm
        if focus == "internal" and focus_m is not None:
            lens = at_infinity(lens)
    elif zoom is not None:
        lens = zoomed(lens, zoom)
    if focal_length_mm is not None:
        factor = _factor_for_efl(lens, focal_length_mm)
    else:
        factor = 1.0 if field_deg is None else _factor_for_field(lens, field_deg)
    image_radius = lens.image_radius_mm
    if factor != 1:
        lens, object_mm = lens.scaled(factor), None if object_mm is None else object_mm * factor
    if field_deg is not None:
        lens = replace(lens, image_radius_mm=image_radius, half_field_deg=field_deg / 2)
    if f_number is not None:
        lens = lens.with_stop_radius(paraxial.stop_radius_mm(at_infinity(lens), f_number))
    if focus == "internal":
        return focused_inside(lens, focus_m, object_mm)
    return replace(lens, film_z_mm=_film_z_mm(lens, focus_m, object_mm, focus))


def state_named(lens: Lens, name: str) -> Configuration:
    """The zoom or focus state of that name.

    Raises:
        InputError: the file has none such; it lists those it has.
    """
    for c in lens.configurations:
        if c.name == name:
            return c
    known = ", ".join(c.name for c in lens.configurations) or "none in this file"
    raise InputError(lens.path, "zoom", name, f"one of: {known}")


def in_state(lens: Lens, state: Configuration) -> Lens:
    """The lens with the thicknesses, stop, field and f-number of a state as the source gives them."""
    near = state.object_distance_mm is not None
    start = gaps_mm(lens, zoom_state_of(lens, state) if near else None)
    moved = lens.with_gaps(start | dict(state.thickness_mm))
    if state.stop_diameter_mm is not None:
        moved = moved.with_stop_radius(state.stop_diameter_mm / 2)
    return replace(
        moved,
        half_field_deg=half_field_in(lens, state),
        f_number=_f_number_in(lens, state),
        stated_efl_mm=state.efl_mm,
        stated_efl_x_mm=None,
        derived="",
        infinity_mm=tuple((k, start[k]) for k, _ in state.thickness_mm) if near else (),
    )


def half_field_in(lens: Lens, state: Configuration) -> float | None:
    """Half field of a state: its own, else that of the image circle where the lens has one (None), else the lens's."""
    return state.half_field_deg or (None if lens.image_radius_mm is not None else lens.half_field_deg)


def _f_number_in(lens: Lens, state: Configuration) -> float:
    """Nominal f-number of a state: its own, else that of the zoom state which it focuses, else the lens's."""
    if state.f_number is None and state.object_distance_mm is not None:
        focused = zoom_state_of(lens, state)
        return lens.f_number if focused is None or focused.f_number is None else focused.f_number
    return lens.f_number if state.f_number is None else state.f_number


def _check(
    lens: Lens,
    focus_m: float | None,
    f_number: float | None,
    focal_length_mm: float | None,
    field_deg: float | None,
    focus: Focus,
) -> None:
    finite = {"f_number": f_number, "focal_length_mm": focal_length_mm}
    for field, value in (*finite.items(), ("focus_m", focus_m)):
        if value is not None and not (value > 0 and (field == "focus_m" or math.isfinite(value))):
            raise InputError(lens.path, field, value, "a positive number")
    if field_deg is not None and not 0 < field_deg < 360:
        raise InputError(lens.path, "field_deg", field_deg, "a full field of view in degrees, above 0 and below 360")
    if field_deg is not None and focal_length_mm is not None:
        raise InputError(lens.path, "field_deg", field_deg, "left out beside focal_length_mm: each sets the size")
    if focus not in get_args(Focus):
        raise InputError(lens.path, "focus", focus, " or ".join(f'"{f}"' for f in get_args(Focus)))


def _millimetres(text: str) -> float | str:
    """A focal length that was typed, or the text itself: a name, then, that no state has."""
    try:
        return float(text)
    except ValueError:
        return text


def _factor_for_efl(lens: Lens, focal_length_mm: float) -> float:
    now_mm = paraxial.first_order(at_infinity(lens)).efl_mm
    if now_mm < 0:
        raise InputError(
            lens.path, "focal_length_mm", focal_length_mm, f"none: this lens diverges (EFL {now_mm:.4g} mm)"
        )
    return focal_length_mm / now_mm


def _factor_for_field(lens: Lens, field_deg: float) -> float:
    """Scale at which the chief ray of half the field meets the edge of the image circle, at infinity focus."""
    lens = at_infinity(lens)
    lens = replace(lens, film_z_mm=paraxial.film_z_mm(lens, math.inf), aperture=None)
    radius, _ = image_radius_mm(lens)
    half = torch.tensor([math.radians(field_deg / 2)], dtype=torch.float64)
    chief = aim_at_stop(lens, half, torch.zeros(1, 1, dtype=torch.float64))
    out = trace(lens, chief.rays, towards="film")
    reached = float(chief.field_rad[0, 0])
    assert lens.film_z_mm is not None
    r = out.rays
    height = abs(float(r.x + (lens.film_z_mm - r.z) * r.dx / r.dz))
    if not bool(chief.reached.all()) or int(out.status[0]) != 0 or not height > 0:
        seen = min(math.degrees(reached) * 2, lens.half_field_deg * 2 if lens.half_field_deg else 360.0)
        raise InputError(lens.path, "field_deg", field_deg, f"a field that this lens sees (about {seen:.3g} degrees)")
    return radius / height


def _film_z_mm(lens: Lens, focus_m: float | None, object_mm: float | None, focus: Focus) -> float:
    if object_mm is not None and focus_m is None:
        film_z = paraxial.image_z_mm(lens, -object_mm)
        focus_m = (film_z + object_mm) / 1000
    else:
        focus_m = math.inf if focus_m is None else focus_m
        film_z = paraxial.film_z_mm(lens, focus_m)
    return best_focus_z_mm(lens, focus_m) if focus == "best" else film_z
