"""From a draft to the lens: stop, f-number, back focus, rims and states, completed where a file leaves them open."""

import math
from bisect import bisect_right
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from neurolens.base.errors import InputError, printable
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.paraxial import FirstOrder, system_of
from neurolens.optics.lens.prescription import Configuration, Lens, Medium, same_medium
from neurolens.optics.readers.draft import Draft, State
from neurolens.optics.readers.source import MAX_INDEX, MAX_POWER, MAX_SURFACES, UNITS_MM, ReadOptions, assume, warn
from neurolens.optics.setting.rims import check_figures, check_states, end_mm, narrowed_rims, with_derived_rims

_ONE_PLACE = "one configuration, where surfaces are tilted or decentred"
_ROUNDED_MM = 1e-4  # to which programs round lengths
_AGREES = 0.03  # relative, since f-numbers are printed with two digits
NARROWER = 1e-4  # relative: smaller differences of stop diameters are rounding
_SHORTEST = 0.01  # focal length over the thickest glass, at least: of 391 lenses none is below 0.19
_SLIGHTLY = 0.1  # share of a rim's diameter
# f-number by the stop's diameter over the stated one: where radii were meant by diameters, and where all is right
_TWICE, _SAME = (0.4, 0.7), (0.7, 1.4)


def lens_of(draft: Draft, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a draft, in mm, checked by `finish`; InputError if `options` give another unit."""
    options = options or ReadOptions()
    if +draft.skipped:
        listed = (word if count == 1 else f"{word} ({count})" for word, count in (+draft.skipped).items())
        warn(draft.file, f"left out, unknown or without effect on rays: {', '.join(listed)}")
    try:
        draft = with_stop(_without_negative_zeros(draft), options.stop)
        draft = _without_dummies(draft)
        if draft.states and any(row.surface.placement for row in draft.rows):
            raise InputError(draft.file, "configurations", f"({len(draft.states)} of them)", _ONE_PLACE)
        return _lens_of(draft, options)
    except InputError as error:
        value = draft.in_file(error.value) if isinstance(error.value, str) else error.value
        raise InputError(error.file, draft.in_file(error.field), value, draft.in_file(error.expected)) from None


def _lens_of(draft: Draft, options: ReadOptions) -> Lens:
    unit = options.units or draft.unit or "mm"
    if options.units and draft.unit and options.units != draft.unit:
        raise InputError(
            draft.file, "--units", options.units, f"{draft.unit!r}, as the file itself says (or no --units)"
        )
    if unit not in UNITS_MM:
        raise InputError(draft.file, "--units", unit, f"one of {', '.join(UNITS_MM)}")
    factor = UNITS_MM[unit]
    if options.f_number is not None and (draft.f_number or draft.pupil) is not None:
        warn(draft.file, f"--f-number {options.f_number:g} is not used: the file sizes the stop itself")
    f_number = draft.f_number or options.f_number or math.nan
    lens = Lens(
        name=options.name or draft.name or printable(Path(draft.file).stem),
        source=options.source or f"{draft.kind} file {printable(Path(draft.file).name)}",
        surfaces=tuple(row.surface for row in draft.rows),
        f_number=f_number,
        image_radius_mm=draft.image_radius,
        half_field_deg=options.half_field_deg or draft.half_field_deg,
        notes="\n".join(draft.notes),
        rims=draft.rims,
        path=draft.file,
        stated_efl_mm=draft.stated_efl,
        object_medium=Medium(**draft.object_medium),
        wavelengths_nm=draft.wavelengths_nm,
    )
    if draft.drawn:
        lens = with_likely_rims(lens, draft)
    if draft.f_number is not None and draft.pupil is None and not draft.stop_given:
        # The file's f-number overrides a diameter of the stop, except for an aperture set on it.
        rows = (replace(s, diameter_mm=math.nan) if s.stop else s for s in lens.surfaces)
        lens = replace(lens, surfaces=tuple(rows))
    lens = finish(lens, pupil_mm=pupil_of(lens, draft), film_given=draft.film_given, stop_limit_mm=stop_aperture(draft))
    if draft.stop_given and abs((by_stop := first_order(lens).f_number) / lens.f_number - 1) > _AGREES:
        message = f"a stop {lens.stop_radius_mm * 2:g} wide gives f/{by_stop:.3g}, the file says f/{lens.f_number:.3g}"
        warn(draft.file, f"{message}: the diameter is kept")
    lens = replace(lens, configurations=tuple(_configuration(lens, draft, state) for state in _states(draft)))
    lens = with_rims(lens.scaled(factor) if factor != 1 else lens, draft.in_file)
    with suppress(InputError):
        check_states(lens)
        return lens
    lens = narrowed(lens, draft)
    check_states(lens)
    return lens


def _states(draft: Draft) -> tuple[State, ...]:
    """Return the states of the file; a table without states that is focused near becomes a focus state."""
    if not draft.states and math.isfinite(draft.object_distance):
        return (State("as filed", object_distance=draft.object_distance, film_given=draft.film_given),)
    return draft.states


def _configuration(lens: Lens, draft: Draft, state: State) -> Configuration:
    """Return a state for the lens file; its stop follows from the state's pupil or f-number."""
    last = len(lens.surfaces) - 1
    thickness = dict(state.thickness)
    if not state.film_given:
        thickness.pop(last, None)
    found = Configuration(state.name, None, tuple(sorted(thickness.items())))
    there = lens.with_gaps(dict(found.thickness_mm))
    data = first_order(there)
    opening, f_number = state.stop_diameter, state.f_number
    pupil = state.pupil
    if pupil is None and f_number is not None:
        pupil = abs(data.efl_mm) / f_number
    if pupil is None and opening is None:
        pupil = draft.pupil
        if pupil is None and draft.f_number is not None:
            pupil = abs(data.efl_mm) / draft.f_number
    if pupil is not None and opening is None:
        wanted = 2 * there.stop_radius_mm * pupil / data.entrance_pupil_diameter_mm
        opening = smaller_stop(draft.file, wanted, stop_aperture(draft), f'state "{state.name}": ')
        f_number = f_number if opening == wanted else None
    if f_number is None and opening is not None:
        f_number = data.f_number * 2 * there.stop_radius_mm / opening
    distance = state.object_distance if math.isfinite(state.object_distance) else None
    if not state.film_given:
        focal_z = data.rear_focal_z_mm if distance is None else data.image_z_mm(-distance)
        thickness[last] = focal_z - float(there.vertices_mm[last])
    return replace(
        found,
        efl_mm=None if distance is not None else data.efl_mm,
        thickness_mm=tuple(sorted(thickness.items())),
        f_number=f_number,
        stop_diameter_mm=opening,
        object_distance_mm=distance,
    )


def _without_negative_zeros(draft: Draft) -> Draft:
    """Return the draft with gaps closed that are negative by no more than rounding."""
    least, rows = -_ROUNDED_MM / UNITS_MM.get(draft.unit or "mm", 1.0), list(draft.rows)
    for k, row in enumerate(draft.rows):
        if least <= row.surface.thickness_mm < 0:
            rows[k] = replace(row, surface=replace(row.surface, thickness_mm=0.0))
            found = f"surface {k}: a thickness of {row.surface.thickness_mm:.3g} is taken as 0"
            warn(draft.file, draft.in_file(found))
    return replace(draft, rows=tuple(rows))


def _without_dummies(draft: Draft) -> Draft:
    """Return the draft without planes between equal media that cut no beam; gaps on both sides become one."""
    if len(draft.rows) > MAX_SURFACES:
        raise InputError(draft.file, "surfaces", f"({len(draft.rows)} of them)", f"at most {MAX_SURFACES}")
    rows, surfaces, medium = draft.rows, [row.surface for row in draft.rows], Medium(**draft.object_medium)
    flat = [math.isinf(s.radius_mm) and not s.stop and not s.figure.bends for s in surfaces]
    idle = [flat[k] and not row.aperture and same_medium(surfaces, k, medium) for k, row in enumerate(rows)]
    dropped = [k for k in range(len(rows)) if idle[k]]
    kept = [k for k in range(len(rows)) if k not in dropped]
    if not dropped or not kept:
        return draft
    # The kept row to which each row's thickness belongs; those in front of all (-1) belong to the object's distance.
    owner = [bisect_right(kept, k) - 1 for k in range(len(rows))]

    def merged(thickness: dict[int, float]) -> tuple[list[float], float]:
        sums = [0.0] * (len(kept) + 1)
        for k, row in enumerate(rows):
            sums[owner[k]] += thickness.get(k, row.surface.thickness_mm)
        return sums[:-1], sums[-1]

    table, front = merged({})
    new = tuple(
        replace(rows[k], surface=replace(rows[k].surface, thickness_mm=t)) for k, t in zip(kept, table, strict=True)
    )
    states = []
    for state in draft.states:
        sums, before = merged(state.thickness)
        gaps = {place: sums[place] for place in sorted({owner[k] for k in state.thickness if owner[k] >= 0})}
        states.append(replace(state, thickness=gaps, object_distance=state.object_distance + before))
    listed = draft.in_file(f"surface {', '.join(map(str, dropped))}")
    warn(draft.file, f"{listed} left out: a plane in one medium that cuts no beam")
    return replace(draft, rows=new, states=tuple(states), object_distance=draft.object_distance + front)


def finish(
    lens: Lens, *, pupil_mm: float | None = None, film_given: bool = True, stop_limit_mm: float | None = None
) -> Lens:
    """Return the lens of a file's rows with what follows from them: its f-number or stop, and the back focus.

    Rims that the file does not give stay `UNKNOWN`; states and overlaps are for the caller (`with_rims`,
    `check_states`).

    Args:
        lens: rows as read; `UNKNOWN` for a diameter that is not given, NaN for an f-number that is not (it sizes the
            stop where neither pupil nor stop diameter is known).
        pupil_mm: diameter of the entrance pupil, where the file gives that; it rules over the stop's diameter.
        film_given: whether the last thickness is the file's; else it becomes the paraxial back focus.
        stop_limit_mm: diameter of the aperture that the file sets on the stop itself. It is taken, with a warning,
            where pupil or f-number ask for a wider stop.

    Raises:
        InputError: there is no row, or too many; no stop, or several; a figure is out of range; nothing sizes the stop;
            there is no image behind the lens.
    """
    _check_stop(lens)
    stop = lens.surfaces[lens.stop_index]
    stated = lens.f_number
    # First-order data needs an opening, whatever it is.
    trial = lens.with_stop_radius(1.0 if math.isnan(stop.diameter_mm) else stop.semi_diameter_mm)
    data = first_order(trial)
    thickest = max((s.thickness_mm for s in lens.surfaces[:-1] if s.n_d != 1), default=0.0)
    if abs(data.efl_mm) < _SHORTEST * thickest:
        expected = f"at least a hundredth of the thickest glass ({thickest:g}): are curvatures taken for radii or such?"
        raise InputError(lens.path, "focal length", data.efl_mm, expected)
    if pupil_mm is not None:
        trial = trial.with_stop_radius(trial.stop_radius_mm * pupil_mm / data.entrance_pupil_diameter_mm)
        stated = abs(data.efl_mm) / pupil_mm if math.isnan(stated) else stated
    elif math.isnan(stop.diameter_mm):
        if math.isnan(stated):
            raise InputError(lens.path, "stop", "(no diameter, no f-number)", "one of them: give --f-number")
        trial = trial.with_stop_radius(trial.stop_radius_mm * data.f_number / stated)
    wanted = 2 * trial.stop_radius_mm
    if smaller_stop(lens.path, wanted, stop_limit_mm) != wanted:
        trial = trial.with_stop_radius((stop_limit_mm or wanted) / 2)
        stated = first_order(trial).f_number
    if math.isnan(stated):
        stated = first_order(trial).f_number
        warn(lens.path, f"no f-number is stated; f/{stated:.4g} follows from the stop's diameter")
    if lens.surfaces[-1].n_d != 1:
        name = lens.surfaces[-1].material or "a medium"
        assume(lens.path, f"the film lies in {name} of index {lens.surfaces[-1].n_d:g}, as the last row says")
    rows = list(trial.surfaces)
    if not film_given:
        rows[-1] = replace(rows[-1], thickness_mm=data.back_focus_mm)
        if data.back_focus_mm <= 0:
            raise InputError(lens.path, "back focus", data.back_focus_mm, "a film behind the last surface")
    return replace(lens, surfaces=tuple(rows), f_number=float(stated))


def pupil_of(lens: Lens, draft: Draft) -> float | None:
    """Return the diameter of the entrance pupil that a file gives, or a near object's beam; else InputError."""
    if draft.object_na is None and draft.image_f_number is None:
        return draft.pupil
    data, sine = first_order(lens.with_stop_radius(1.0)), (draft.object_na or 0.0) / float(lens.object_medium.n_d)
    reach, beyond_focus = (draft.object_distance + z for z in (data.entrance_pupil_z_mm, data.front_focal_z_mm))
    if not (sine < 1 and 0 < reach < math.inf and beyond_focus):
        raise InputError(
            lens.path,
            "numerical aperture of the object",
            draft.object_na,
            "an aperture below the index in front, of an object at a finite distance",
        )
    by_image = abs(data.efl_mm / beyond_focus) / (draft.image_f_number or math.inf)
    return reach * (by_image or 2 * sine / math.sqrt(1 - sine * sine))


def smaller_stop(file: str, wanted: float, limit: float | None, state: str = "") -> float:
    """Return the smaller diameter of the stop: by pupil or f-number, or by its own aperture, with a warning."""
    if limit is None or not limit < wanted * (1 - NARROWER):
        return wanted
    message = f"{state}pupil or f-number ask for a stop {wanted:.6g} wide, its own aperture is {limit:.6g}"
    warn(file, f"{message} (in the file's unit): the smaller is taken")
    return limit


def first_order(lens: Lens) -> FirstOrder:
    """Return the first-order data in the y-z plane; for a lens without power there, in the x-z plane.

    Raises InputError for a lens without power, one whose entrance pupil is a point or infinite, or a figure out of
    range.
    """
    _check_stop(lens)
    try:
        data = paraxial.first_order(lens, meridian="y")
    except InputError:
        if not lens.anamorphic:
            raise
        data = paraxial.first_order(lens, meridian="x")
    if not data.efl_mm:
        raise InputError(lens.path, "film", "(in the hole of a pinhole)", "a film behind the hole")
    if not 0 < data.entrance_pupil_diameter_mm < math.inf:
        found = f"(seen from the scene {data.entrance_pupil_diameter_mm:g} mm wide)"
        raise InputError(lens.path, "stop", found, "a stop whose image in front of it has a size")
    return data


def check_rows(lens: Lens) -> None:
    """Raise InputError for no surface, too many, or a figure out of range; whether there is a stop is not checked."""
    rows, file = lens.surfaces, lens.path
    if not rows:
        raise InputError(file, "surfaces", "(none)", "at least one surface between object and image")
    if len(rows) > MAX_SURFACES:
        raise InputError(file, "surfaces", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    index = f"a refractive index from 1 to {MAX_INDEX}"
    for k, s in enumerate(rows):
        if not 1 <= s.n_d <= MAX_INDEX:
            mirror = " (an index of -1 describes a mirror, and the lens model has none)" if s.n_d == -1 else ""
            raise InputError(file, f"surface {k}, index", s.n_d, index + mirror)
        if not abs(s.radius_mm) > 0:
            raise InputError(file, f"surface {k}, radius", s.radius_mm, "a number other than 0, or a plane")
        if not math.isfinite(s.thickness_mm):
            raise InputError(file, f"surface {k}, thickness", s.thickness_mm, "a finite length")
        for power in (p for p, _ in s.figure.powers if not 2 <= p <= MAX_POWER):
            raise InputError(file, f"surface {k}, asphere, power", power, f"a power from 2 to {MAX_POWER}")
    if not 1 <= lens.object_medium.n_d <= MAX_INDEX:
        raise InputError(file, "object, index", lens.object_medium.n_d, index)
    check_figures(rows, file)


def _check_stop(lens: Lens) -> None:
    check_rows(lens)
    stops = [k for k, s in enumerate(lens.surfaces) if s.stop]
    if len(stops) != 1:
        found = f"(on surface {', '.join(map(str, stops))})" if stops else "(none)"
        raise InputError(lens.path, "stop", found, "exactly one surface that is the aperture stop")


def with_stop(draft: Draft, wanted: str | None) -> Draft:
    """The draft with a stop: the surface wanted, the file's, or the surface whose rim limits the beam of the axis.

    Raises:
        InputError: there is no surface of that number.
    """
    names = [row.name or str(k) for k, row in enumerate(draft.rows)]
    if wanted is not None:
        if wanted not in names:
            raise InputError(draft.file, "--stop", wanted, f"the number of a surface in the file: {', '.join(names)}")
        k = names.index(wanted)
    elif any(row.surface.stop for row in draft.rows) or not draft.rows:
        return draft
    else:
        rows = tuple(row.surface for row in draft.rows)
        lens = Lens("", "", rows, math.nan, path=draft.file, object_medium=Medium(**draft.object_medium))
        check_rows(lens)
        heights = system_of(lens).march(1.0, 0.0).y  # of a beam that is 2 mm wide
        shares = [s.semi_diameter_mm / abs(y) if y else math.nan for s, y in zip(rows, heights, strict=True)]
        k = min(range(len(rows)), key=lambda k: math.inf if math.isnan(shares[k]) else shares[k])
        assume(draft.file, f"no stop is marked: surface {names[k]}, whose rim limits the beam of the axis, is taken")
    # Its rim stays, even where the file's f-number or pupil would make it wider.
    marked = (replace(row, surface=replace(row.surface, stop=i == k)) for i, row in enumerate(draft.rows))
    return replace(draft, rows=tuple(replace(row, aperture=row.aperture or row.surface.stop) for row in marked))


def stop_aperture(draft: Draft) -> float | None:
    """Return the diameter of the aperture that the file sets on the stop itself, in its unit."""
    stops = (row.surface.diameter_mm for row in draft.rows if row.surface.stop and row.aperture)
    return next((d for d in stops if not math.isnan(d)), None)


def with_likely_rims(lens: Lens, draft: Draft) -> Lens:
    """Return the lens with rims of half the width, where stop and spheres tell that diameters are meant as radii."""
    f_number = draft.f_number or draft.nominal
    if not any(s.stop for s in lens.surfaces):
        return lens  # `finish` reports it
    beyond = [k for k, s in enumerate(lens.surfaces) if s.semi_diameter_mm > end_mm(s) * (1 + 1e-6)]
    evidence = f"the rim of surface {beyond[0]} is wider than its sphere" if beyond else ""
    if f_number and not math.isnan(lens.stop_radius_mm):  # some files write 0 for none
        by_stop = first_order(lens).f_number
        if _SAME[0] <= by_stop / f_number <= _SAME[1]:
            return lens
        if _TWICE[0] <= by_stop / f_number < _TWICE[1]:
            evidence = f"the stop would give f/{by_stop:.3g}, the file says f/{f_number:.3g}"
    if not evidence:
        return lens
    assume(lens.path, f"rims are assumed to be half as wide as the format has them: {draft.in_file(evidence)}")
    return replace(lens, surfaces=tuple(replace(s, diameter_mm=s.diameter_mm / 2) for s in lens.surfaces))


def with_rims(lens: Lens, in_file: Callable[[str], str] = str) -> Lens:
    """Return the lens with the rims that its file lacks, by rule (`neurolens.optics.setting.rims`), with a warning.

    In the warning `in_file` calls surfaces as the file does.
    """
    missing = [k for k, s in enumerate(lens.surfaces) if math.isnan(s.diameter_mm)]
    if not missing:
        return lens
    surfaces = in_file(f"surface {', '.join(map(str, missing))}")
    if not lens.half_field_deg and not lens.image_radius_mm and (filled := _as_beside(lens)) is not None:
        warn(lens.path, f"no rim is given for {surfaces}, nor a field: as wide as the wider rim of the same glass")
        return filled
    derived = with_derived_rims(lens)
    warn(lens.path, f"no rim is given for {surfaces}: derived from f-number and field")
    return derived


def _as_beside(lens: Lens) -> Lens | None:
    """The lens with missing rims as wide as those on the other side of the glass; None where some are not there."""
    rows = list(lens.surfaces)
    for k, s in enumerate(lens.surfaces):
        before, behind = rows[max(k - 1, 0) : k], lens.surfaces[k + 1 : k + 2] if s.n_d != 1 else ()
        ends = [*(end for end in before if end.n_d != 1), *behind]
        if math.isnan(s.diameter_mm):
            widest = max((end.diameter_mm for end in ends if not math.isnan(end.diameter_mm)), default=math.nan)
            rows[k] = replace(s, diameter_mm=min(widest, 2 * end_mm(s)))
    return None if any(math.isnan(row.diameter_mm) for row in rows) else replace(lens, surfaces=tuple(rows))


def narrowed(lens: Lens, draft: Draft) -> Lens:
    """Return the lens with rims no wider than their spheres and than where neighbours touch, in every state.

    Where rims are much wider than their spheres (`_SLIGHTLY`), or would have to be so narrow that they cut the beam of
    the axis, the figures of the table are wrong. Such a table stays as it is, unless its rims are `drawn`.
    """
    found = narrowed_rims(lens)
    pairs = list(zip(lens.surfaces, found.surfaces, strict=True))
    if not draft.drawn:
        if any((1 - _SLIGHTLY) * s.semi_diameter_mm > end_mm(s) for s in lens.surfaces):
            return lens
        for state in (lens, *(lens.with_gaps(dict(c.thickness_mm)) for c in lens.configurations)):
            heights = system_of(state).march(1.0, 0.0).y
            beam = [abs(2 * lens.stop_radius_mm * y / (heights[lens.stop_index] or math.inf)) for y in heights]
            if any(
                b.diameter_mm < min((1 - _SLIGHTLY) * a.diameter_mm, need)
                for (a, b), need in zip(pairs, beam, strict=True)
            ):
                return lens
    widths = [(k, f"{a.diameter_mm:.4g} to {b.diameter_mm:.4g} mm") for k, (a, b) in enumerate(pairs) if a != b]
    changed = [f"{draft.in_file(f'surface {k}')} ({width})" for k, width in widths]
    if changed:  # no rim is wider than its sphere: where one is said to be, table or rims are in doubt
        say = assume if any(s.semi_diameter_mm > end_mm(s) * (1 + 1e-6) for s in lens.surfaces) else warn
        say(lens.path, f"rims narrowed to where spheres end or neighbours touch: {', '.join(changed)}")
    return found
