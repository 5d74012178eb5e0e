"""Stop, f-number, film and rims of a lens where its file leaves them open, contradicts itself, or cannot mean them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from neurolens.base.errors import InputError
from neurolens.lens import paraxial
from neurolens.lens.paraxial import FirstOrder, system_of
from neurolens.lens.prescription import Lens, Medium
from neurolens.readers.source import MAX_INDEX, MAX_POWER, MAX_SURFACES, assume, warn
from neurolens.setting.rims import check_figures, end_mm, narrowed_rims, with_derived_rims

if TYPE_CHECKING:
    from neurolens.readers.draft import Draft

# A diameter that the file does not give, until `finish` has found it.
UNKNOWN = math.nan
NARROWER = 1e-4  # relative: smaller differences of stop diameters are rounding
_SLIGHTLY = 0.1  # of a rim's diameter
_TWICE, _SAME = (0.4, 0.7), (0.7, 1.4)  # f-number by the stop's diameter over the stated one: rims twice as wide, right


def finish(
    lens: Lens, *, pupil_mm: float | None = None, film_given: bool = True, stop_limit_mm: float | None = None
) -> Lens:
    """Return a lens from the rows of a file, with what follows from them: f-number or stop, and back focus.

    Rims that the file does not give stay `UNKNOWN`; states and overlaps are for the caller (`with_rims`,
    `check_states`).

    Args:
        lens: rows as read; `UNKNOWN` for a diameter that is not given, NaN for an f-number that is not (it sizes
            the stop where neither pupil nor stop diameter are known).
        pupil_mm: diameter of the entrance pupil, where the file gives that; it rules over the stop's diameter.
        film_given: whether the last thickness is the file's; else it becomes the paraxial back focus.
        stop_limit_mm: diameter of the aperture that the file sets on the stop itself; the smaller of it and of what
            pupil or f-number ask for is taken, with a warning.

    Raises:
        InputError: no row, too many, no stop or several, a figure out of range, a stop that nothing sizes, no image
            behind the lens.
    """
    _check_stop(lens)
    stop = lens.surfaces[lens.stop_index]
    stated = lens.f_number
    # First-order data needs an opening, whatever it is.
    trial = lens.with_stop_radius(1.0 if math.isnan(stop.diameter_mm) else stop.semi_diameter_mm)
    data = first_order(trial)
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


def smaller_stop(file: str, wanted: float, limit: float | None, state: str = "") -> float:
    """The smaller of two diameters of the stop: by pupil or f-number, and of its own aperture; warns of the latter."""
    if limit is None or not limit < wanted * (1 - NARROWER):
        return wanted
    message = f"{state}pupil or f-number ask for a stop {wanted:.6g} wide, its own aperture is {limit:.6g}"
    warn(file, f"{message} (in the file's unit): the smaller is taken")
    return limit


def first_order(lens: Lens) -> FirstOrder:
    """Return the first-order data in the y-z plane; of a lens without power there, in the x-z plane.

    Raises InputError for a lens without power, or whose entrance pupil is a point or infinite; a figure out of range.
    """
    _check_stop(lens)
    try:
        data = paraxial.first_order(lens, meridian="y")
    except InputError:
        if not lens.anamorphic:
            raise
        data = paraxial.first_order(lens, meridian="x")
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
    mirror = " (an index of -1 describes a mirror, and the lens model has none)"
    for k, s in enumerate(rows):
        terms = (s.conic, *(a for _, a in s.asphere))
        figures = (
            ("radius", s.radius_mm, abs(s.radius_mm) > 0, "a number other than 0, or a plane"),
            ("thickness", s.thickness_mm, math.isfinite(s.thickness_mm), "a finite length"),
            ("diameter", s.diameter_mm, math.isnan(s.diameter_mm) or 0 < s.diameter_mm < math.inf, "a length above 0"),
            ("index", s.n_d, 1 <= s.n_d <= MAX_INDEX, index + mirror * (s.n_d == -1)),
            ("Abbe number", s.V_d, s.V_d is None or 0 < s.V_d < math.inf, "a number above 0"),
            ("asphere", (s.conic, s.asphere), all(map(math.isfinite, terms)), "finite coefficients"),
            *(("asphere, power", p, 2 <= p <= MAX_POWER, f"a power from 2 to {MAX_POWER}") for p, _ in s.asphere),
        )
        for name, value, sound, expected in figures:
            if not sound:
                raise InputError(file, f"surface {k}, {name}", value, expected)
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
    """The draft with a stop: the surface wanted, that of the file, or else that whose rim limits the beam of the axis.

    Raises:
        InputError: no surface of that number.
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
        heights = system_of(lens).march(1.0, 0.0).y
        k = min(range(len(rows)), key=lambda k: _share(rows[k].semi_diameter_mm, heights[k]))
        assume(draft.file, f"no stop is marked: surface {names[k]}, whose rim limits the beam of the axis, is taken")
    # Its rim stays, where the f-number or pupil of the file would have a wider one.
    marked = (replace(row, surface=replace(row.surface, stop=i == k)) for i, row in enumerate(draft.rows))
    return replace(draft, rows=tuple(replace(row, aperture=row.aperture or row.surface.stop) for row in marked))


def _share(rim: float, height: float) -> float:
    """Return a rim over the height of the marginal ray of a beam 2 mm wide; infinite where there is no rim."""
    return math.inf if math.isnan(rim) or height == 0 else rim / abs(height)


def stop_aperture(draft: Draft) -> float | None:
    """Return the diameter of the aperture that the file sets on the stop itself, in its unit."""
    stops = (row.surface.diameter_mm for row in draft.rows if row.surface.stop and row.aperture)
    return next((d for d in stops if not math.isnan(d)), None)


def with_likely_rims(lens: Lens, draft: Draft) -> Lens:
    """Return the lens with rims of half the width, where stop and spheres say that radii were meant by diameters."""
    f_number = draft.f_number or draft.nominal
    if not any(s.stop for s in lens.surfaces):
        return lens  # `finish` says so
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
    rows = (replace(s, diameter_mm=s.diameter_mm / 2) for s in lens.surfaces)
    return replace(lens, surfaces=tuple(rows))


def with_rims(lens: Lens, in_file: Callable[[str], str] = str) -> Lens:
    """The lens with the rims that its file does not give derived by rule (`neurolens.setting.rims`), with a warning, in
    which `in_file` calls surfaces as the file does.
    """
    missing = [k for k, s in enumerate(lens.surfaces) if math.isnan(s.diameter_mm)]
    if not missing:
        return lens
    derived = with_derived_rims(lens)
    surfaces = in_file(f"surface {', '.join(map(str, missing))}")
    warn(lens.path, f"no rim is given for {surfaces}: derived from f-number and field")
    return derived


def narrowed(lens: Lens, draft: Draft) -> Lens:
    """Return the lens with rims no wider than their spheres and than where neighbours touch, in every state.

    Unless rims are `drawn`, a table stays as it is where rims are much wider (`_SLIGHTLY`) than their spheres, or would
    have to be much narrower and then cut the beam of the axis: its figures are wrong.
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
