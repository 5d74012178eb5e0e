"""A lens set as a photographer does: zoom, size, aperture, f-number, focus, cover glass, coating, film offset in turn.

Between the zoom states of the source, the places of all groups, measured from the film, are interpolated against log
focal length. Focal length and image are then made exact by moving the groups behind the first varying gap, which keeps
its interpolated value. A zoom of two moving groups has no freedom left. A lens that is set so is marked as derived.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, note, warn
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.designs import coated, with_assumptions
from neurolens.optics.lens.prescription import Configuration, Lens
from neurolens.optics.lens.shot import FocusMode, Shot
from neurolens.optics.setting.focusing import (
    at_infinity,
    best_focused,
    focused_inside,
    gaps_mm,
    groups_reach_m,
    infinity_states,
    monotone,
    reached_inside,
    with_cover_glass,
    zoom_state_of,
)
from neurolens.optics.setting.pupils import image_radius_mm, on_plane
from neurolens.optics.setting.rims import check_clearance


def set_lens(lens: Lens, shot: Shot | None = None, *, focus_mode: FocusMode = "paraxial", **settings: Any) -> Lens:
    """Return the lens set for a shot: its zoom, size, aperture, f-number, focus, cover glass, coating and film offset::

        lens = set_lens(read_lens("lenses/laikin_double_gauss_50.toml"), focus_m=2.0, f_number=4.0)

    Args:
        shot: some or all settings of a shot, as commands and cameras have them; what its `focus_mode` leaves open is
            "auto" (`focus_mode_of`). Or some by name, as in the example.
        focus_mode: of settings by name: "paraxial" moves the film as the paraxial image does; "best" to the least RMS
            spot of the axial point (`focusing.best_focus_z_mm`); "internal" moves the groups as the file's focus states
            do (`focusing.focused_inside`), and then the film to that spot.
        settings: as in `Shot`. An f-number alone closes the stop of a lens that is set, whose focus stays. An f-number
            is the focal length over the diameter of the paraxial entrance pupil at infinity focus, of a bladed stop by
            the circle round it; a stop wider than the rims let light through is allowed: they then vignette. A field is
            that of the image circle at infinity focus, by the traced chief ray along x. Light that is not given is
            `Lens.light_nm`.

    Raises:
        InputError: the state is unknown, the focal length lies beyond the zoom's range, a setting is out of its bounds,
            the focus is nearer than the lens allows, the lens does not see the field, the cover glass has no room, or a
            size is asked of a lens that diverges.

    Warns:
        NeurolensWarning: an f-number opens the stop by over 5% beyond what the source states.
    """
    if shot is None:
        shot = Shot.part(focus_mode=focus_mode, **settings)
        if lens.film_z_mm is not None and shot.f_number and shot.given.keys() <= {"f_number", "focus_mode"}:
            return lens.with_stop_radius(paraxial.stop_radius_mm(at_infinity(lens), shot.f_number))
    lens, light_nm = at_infinity(lens), shot.wavelength_nm or lens.light_nm
    lens = _sized(_zoomed_to(lens, shot.zoom), shot)
    mode = focus_mode_of(lens, shot)
    if mode != shot.focus_mode and mode == "best" and shot.focus_m is not None and math.isfinite(shot.focus_m):
        reach_m = groups_reach_m(lens)
        if reach_m is not None and shot.focus_m < reach_m:
            note(f"{lens.path}: its groups focus to {reach_m:.3g} m; nearer, the whole lens moves")
    lens = lens.with_aperture(shot.aperture or lens.aperture)
    if shot.f_number is not None:
        far = at_infinity(lens)
        widest = paraxial.first_order(far).f_number if shot.clamp_f_number else 0.0
        if (f_number := shot.f_number_for(widest)) is not None:
            for said in wider_than_stated(lens, f_number):
                warn(said)
            lens = lens.with_stop_radius(paraxial.stop_radius_mm(far, f_number))
    object_mm = _object_mm(lens, shot)
    if mode == "internal":
        lens = focused_inside(lens, shot.focus_m, object_mm)
    elif shot.focus_m is None and object_mm is not None:
        lens = replace(lens, film_z_mm=paraxial.image_z_mm(lens, -object_mm))
    else:
        lens = replace(lens, film_z_mm=paraxial.film_z_mm(lens, focus_of(lens, shot)))
    if mode != "paraxial":
        lens = best_focused(lens, focus_of(lens, shot), light_nm)
    lens = with_cover_glass(lens, shot.cover_glass_mm or 0.0, focus_of(lens, shot), mode, light_nm)
    if shot.cover_glass_mm and any(s.coating and s.coating.origin == "assumed" for s in lens.surfaces):
        lens = with_assumptions(lens)
    lens = lens if shot.coating is None else coated(lens, shot.coating)
    assert lens.film_z_mm is not None
    return replace(lens, film_z_mm=lens.film_z_mm + shot.film_offset_mm) if shot.film_offset_mm else lens


def wider_than_stated(lens: Lens, f_number: float) -> list[str]:
    """Return a sentence if an f-number opens the stop of a lens by over 5% beyond what its source states."""
    if f_number >= 0.95 * lens.f_number:
        return []
    return [f"the stop gives f/{f_number:.3g}, wider than the f/{lens.f_number:.3g} of the source"]


def focus_mode_of(lens: Lens, shot: Shot) -> FocusMode:
    """Return how a lens in its zoom position and size focuses for a shot: what "auto" stands for, else as asked.

    A focus state that the shot's zoom names keeps its groups.
    """
    if (mode := shot.focus_mode or Shot.focus_mode) != "auto":
        return mode
    inside = shot.focus_m is not None and _object_mm(lens, shot) is None and reached_inside(lens, shot.focus_m)
    return "internal" if inside else "best"


def focus_of(lens: Lens, shot: Shot) -> float:
    """Return the distance (m) from film to object, of a lens that is set for a shot.

    It is the shot's focus if given, else that of the focus state that its zoom names, else inf.
    """
    if shot.focus_m is not None:
        return shot.focus_m
    object_mm = _object_mm(lens, shot)
    return math.inf if object_mm is None else float(object_mm + (lens.film_z_mm or lens.vertices_mm[-1])) / 1000


def _object_mm(lens: Lens, shot: Shot) -> float | None:
    """The distance from the object of the focus state that a shot names to the front vertex; None without one."""
    return next((c.object_distance_mm for c in lens.configurations if c.name == shot.zoom), None)


def _zoomed_to(lens: Lens, zoom: str | float | None) -> Lens:
    """Return the lens in the state that is named, or at a focal length, given as a number or its text."""
    if zoom is None:
        return lens
    if isinstance(zoom, str) and zoom not in [c.name for c in lens.configurations]:
        with suppress(ValueError):  # it is a name, then, that no state has
            zoom = float(zoom)
    return in_state(lens, state_named(lens, zoom)) if isinstance(zoom, str) else zoomed(lens, zoom)


def _sized(lens: Lens, shot: Shot) -> Lens:
    """Return the lens scaled to the focal length of a shot, or to its field, in which case the image circle stays."""
    if shot.focal_length_mm is not None:
        now_mm = paraxial.first_order(at_infinity(lens)).efl_mm
        if now_mm < 0:
            expected = f"none: this lens diverges (EFL {now_mm:.4g} mm)"
            raise InputError(lens.path, "focal_length_mm", shot.focal_length_mm, expected)
        factor = shot.focal_length_mm / now_mm
        return lens if factor == 1 else lens.scaled(factor)
    if shot.field_deg is None:
        return lens
    scaled = lens.scaled(_factor_for_field(lens, shot.field_deg))
    return replace(scaled, image_radius_mm=lens.image_radius_mm, half_field_deg=shot.field_deg / 2)


def state_named(lens: Lens, name: str) -> Configuration:
    """Return the zoom or focus state of that name; the error of an unknown one lists those of the file."""
    for c in lens.configurations:
        if c.name == name:
            return c
    known = ", ".join(c.name for c in lens.configurations) or "none in this file"
    raise InputError(lens.path, "zoom", name, f"one of: {known}")


def in_state(lens: Lens, state: Configuration) -> Lens:
    """Return the lens with the thicknesses, stop, field and f-number that the source gives a state."""
    near = state.object_distance_mm is not None
    start = gaps_mm(lens, zoom_state_of(lens, state) if near else None)
    moved = lens.with_gaps(start | dict(state.thickness_mm))
    if state.stop_diameter_mm is not None:
        moved = moved.with_stop_radius(state.stop_diameter_mm / 2)
    return replace(
        moved,
        half_field_deg=lens.half_field_in(state),
        f_number=_f_number_in(lens, state),
        stated_efl_mm=state.efl_mm,
        stated_efl_x_mm=None,
        derived="",
        infinity_mm=tuple((k, start[k]) for k, _ in state.thickness_mm) if near else (),
    )


def _f_number_in(lens: Lens, state: Configuration) -> float:
    """Return the nominal f-number of a state: its own, that of the zoom state that it focuses, or the lens's."""
    if state.f_number is None and state.object_distance_mm is not None:
        focused = zoom_state_of(lens, state)
        return lens.f_number if focused is None or focused.f_number is None else focused.f_number
    return lens.f_number if state.f_number is None else state.f_number


def _factor_for_field(lens: Lens, field_deg: float) -> float:
    """Return the scale at which, at infinity focus, the chief ray of half the field meets the image circle's edge."""
    import torch  # aims the chief ray; nothing else here needs it

    from neurolens.optics.trace.aiming import aim_at_stop
    from neurolens.optics.trace.rays import trace

    lens = at_infinity(lens)
    lens = replace(lens, film_z_mm=paraxial.film_z_mm(lens, math.inf), aperture=None)
    radius, _ = image_radius_mm(lens)
    half = torch.tensor([math.radians(field_deg / 2)], dtype=torch.float64)
    chief = aim_at_stop(lens, half, torch.zeros(1, 1, dtype=torch.float64))
    out = trace(lens, chief.rays, towards="film")
    reached = float(chief.field_rad[0, 0])
    assert lens.film_z_mm is not None
    height = abs(float(on_plane(out.rays, lens.film_z_mm).x))
    if not bool(chief.reached.all()) or int(out.status[0]) != 0 or not height > 0:
        widest = min(math.degrees(reached) * 2, lens.half_field_deg * 2 if lens.half_field_deg else 360.0)
        raise InputError(lens.path, "field_deg", field_deg, f"a field that this lens sees (about {widest:.3g} degrees)")
    return radius / height


MOVES = 0.02  # a group counts as moving where its travel is above this share of the largest
_STATED = 1e-6  # a focal length is a state's, as stated or as computed, where it differs by less than this share
_ROUNDS = 40

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class _State:
    """A zoom state of the source, with the places of its groups.

    Attributes:
        efl_mm: focal length as computed.
        places: distances of the groups' fronts from the film (paraxial image), from scene to film; one more than the
            gaps.
    """

    source: Configuration
    efl_mm: float
    places: Vector


def zoomed(lens: Lens, efl_mm: float) -> Lens:
    """Return the lens at infinity focus, zoomed to a focal length between those of its states.

    At the focal length of a state, stated or computed, it is that state. Elsewhere stop, field and nominal f-number are
    interpolated too, and `derived` tells between which states the lens lies.

    Raises:
        InputError: fewer than two states, a focal length beyond theirs, or groups that would collide on the way.
    """
    states = _states(lens)
    if len(states) < 2:
        raise InputError(lens.path, "zoom", efl_mm, "the name of a state: a zoom needs two states of the file or more")
    for s in states:
        for known in (s.source.efl_mm, s.efl_mm):
            if known is not None and abs(efl_mm / known - 1) < _STATED:
                return in_state(lens, s.source)
    known_mm = [e for s in states for e in (s.source.efl_mm, s.efl_mm) if e is not None]
    if not min(known_mm) < efl_mm < max(known_mm):
        raise InputError(lens.path, "zoom", efl_mm, f"a focal length from {min(known_mm):g} to {max(known_mm):g} mm")
    gaps = _varying_gaps(lens)
    places = _solved(lens, gaps, states, efl_mm)
    inner = dict(zip(gaps, (places[:-1] - places[1:]).tolist(), strict=True))
    last = len(lens.surfaces) - 1
    i = sum(s.efl_mm <= efl_mm for s in states[1:-1])
    beside = states[i], states[i + 1]
    moved = in_state(lens, Configuration("", efl_mm, (*inner.items(), (last, float(places[-1])))))
    check_clearance(moved.surfaces, lens.path, f"zoom {efl_mm:g} mm, ")
    moved = _interpolated_texts(moved, states, efl_mm)
    names = " and ".join(f'"{s.source.name}"' for s in beside)
    return replace(moved, derived=f"Zoom to {efl_mm:g} mm, between the source's states {names}: gaps interpolated.")


def _states(lens: Lens) -> list[_State]:
    gaps, found = _varying_gaps(lens), []
    for c in infinity_states(lens):
        data = paraxial.first_order(lens.with_gaps(gaps_mm(lens, c)))
        if not 0 < data.efl_mm < math.inf:
            expected = "a positive one in every state of a zoom"
            raise InputError(lens.path, f'focal length of "{c.name}"', f"({data.efl_mm:.6g} mm)", expected)
        thickness = gaps_mm(lens, c)
        inner = [thickness[k] for k in gaps]
        found.append(_State(c, data.efl_mm, data.back_focus_mm + np.append(np.cumsum(inner[::-1])[::-1], 0.0)))
    return sorted(found, key=lambda s: s.efl_mm)


def _varying_gaps(lens: Lens) -> list[int]:
    """Return the surfaces behind which zoom states set the gap; not the last surface, whose gap ends at the film."""
    return sorted({k for c in infinity_states(lens) for k, _ in c.thickness_mm} - {len(lens.surfaces) - 1})


def _solved(lens: Lens, gaps: list[int], states: list[_State], efl_mm: float) -> Vector:
    """Find the groups' places for this focal length, with the image on the film, by Gauss and Newton's least moves."""
    x = [math.log(s.efl_mm) for s in states]
    target = min(max(math.log(efl_mm), x[0]), x[-1])
    known = np.array([s.places for s in states])
    places, travel = np.array(monotone(x, known.tolist(), target)), np.ptp(known, axis=0)
    least = MOVES * travel.max()
    moving, kept = travel > least, int(np.argmax(np.ptp(known[:, :-1] - known[:, 1:], axis=0) > least))
    if moving.sum() > 2:
        (gap_mm,) = monotone(x, (known[:, kept : kept + 1] - known[:, kept + 1 : kept + 2]).tolist(), target)
        if moving[kept]:
            places[kept] = places[kept + 1] + gap_mm
        else:
            places[kept + 1] = places[kept] - gap_mm
    directions = _directions(moving, kept)

    def wrong(places: Vector) -> Vector:
        inner = dict(zip(gaps, (places[:-1] - places[1:]).tolist(), strict=True))
        data = paraxial.first_order(lens.with_gaps(inner))
        return np.array([data.efl_mm - efl_mm, data.back_focus_mm - places[-1]])

    step_mm = 1e-4 * efl_mm
    for _ in range(_ROUNDS):
        off = wrong(places)
        if np.abs(off).max() < 1e-12 * efl_mm:
            return places
        columns = [(wrong(places + step_mm * d) - wrong(places - step_mm * d)) / (2 * step_mm) for d in directions]
        change = np.linalg.lstsq(np.array(columns).T, -off, rcond=1e-6)[0] @ directions
        places = places + change
        if np.abs(change).max() < 1e-13 * efl_mm:
            return places
    raise InputError(lens.path, "zoom", efl_mm, "another focal length: here no place of its groups is in focus")


def _directions(moving: NDArray[np.bool_], kept: int) -> Vector:
    """Return the moves [D, groups] that may correct the interpolation."""
    unit = np.eye(len(moving))
    if moving.sum() < 2:
        return unit
    if moving.sum() == 2:
        return np.asarray(unit[moving])
    # The first varying gap is kept: the two groups beside it move together, or stand still if one of them does.
    together = [unit[kept] + unit[kept + 1]] if moving[kept] and moving[kept + 1] else []
    return np.array(together + [unit[j] for j in np.flatnonzero(moving) if j not in (kept, kept + 1)])


def _interpolated_texts(lens: Lens, states: list[_State], efl_mm: float) -> Lens:
    """Return the lens with stop, half field (by image height) and nominal f-number between those of its states.

    Only states that state a figure count for it.
    """
    x = [math.log(s.efl_mm) for s in states]
    place = min(max(math.log(efl_mm), x[0]), x[-1])

    def value(known: list[float | None]) -> float | None:
        sure = [(at, [k]) for at, k in zip(x, known, strict=True) if k is not None]
        if not sure or not sure[0][0] <= place <= sure[-1][0]:
            return None
        return monotone([s[0] for s in sure], [s[1] for s in sure], place)[0]

    heights = [
        None if s.source.half_field_deg is None or s.source.half_field_deg >= 89
        else s.efl_mm * math.tan(math.radians(s.source.half_field_deg))
        for s in states
    ]  # fmt: skip
    height, stop = value(heights), value([s.source.stop_diameter_mm for s in states])
    f_number = value([s.source.f_number for s in states])
    if stop is not None:
        lens = lens.with_stop_radius(stop / 2)
    return replace(
        lens,
        half_field_deg=lens.half_field_deg if height is None else math.degrees(math.atan(height / efl_mm)),
        f_number=lens.f_number if f_number is None else f_number,
        stated_efl_mm=None,
    )
