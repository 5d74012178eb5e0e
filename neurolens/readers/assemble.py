"""Last step of every reader: from the data of a file to a complete, checked lens."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from neurolens.base.errors import InputError
from neurolens.lens import catalogue, paraxial
from neurolens.lens.catalogue import LINE_C_NM, LINE_D_NM, LINE_F_NM, Glass
from neurolens.lens.glass import by_figures
from neurolens.lens.paraxial import FirstOrder
from neurolens.lens.prescription import Lens
from neurolens.readers.source import MAX_INDEX, MAX_POWER, MAX_SURFACES, Line, assume, warn
from neurolens.setting.rims import check_figures

# A diameter that the file does not give, until `finish` has found it.
UNKNOWN = math.nan
NARROWER = 1e-4  # relative: smaller differences of stop diameters are rounding
_NAMES = frozenset(m.upper() for m in catalogue.MAKERS)
_SAME_LINE_NM = 0.1
_MOULDED = re.compile("([ _-]?MOLD(ED)?|M)$", re.IGNORECASE)
_MOULDING = 0.01  # by how much moulding lowers an index at the most
# Discontinued glasses of Schott, of which no dispersion formula is at hand: n_d (Elphel's optical-design-viewer), V_d.
_DISCONTINUED: dict[str, tuple[float, float | None]] = {"LASF14A": (1.82223, None), "SF58": (1.917613, 21.5)}
SAME_INDEX, SAME_ABBE = 2e-5, 0.005  # tolerance of printed figures against those of a catalogue glass


def finish(
    lens: Lens, *, pupil_mm: float | None = None, film_given: bool = True, stop_limit_mm: float | None = None
) -> Lens:
    """A lens from the rows of a file, with what follows from them: f-number or stop, and back focus.

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
    asked = 2 * trial.stop_radius_mm
    if smaller_stop(lens.path, asked, stop_limit_mm) != asked:
        trial = trial.with_stop_radius((stop_limit_mm or asked) / 2)
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


def smaller_stop(file: str, asked: float, limit: float | None, state: str = "") -> float:
    """The smaller of two diameters of the stop: by pupil or f-number, and of its own aperture; warns of the latter."""
    if limit is None or not limit < asked * (1 - NARROWER):
        return asked
    told = f"{state}pupil or f-number ask for a stop {asked:.6g} wide, its own aperture is {limit:.6g}"
    warn(file, f"{told} (in the file's unit): the smaller is taken")
    return limit


def first_order(lens: Lens) -> FirstOrder:
    """First-order data in the y-z plane; of a lens without power there, in the x-z plane.

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


def named_glass(
    name: str,
    file: str,
    field: str,
    makers: Sequence[str] = (),
    *,
    said: str | None = None,
    figures: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Fields of a surface whose glass the file gives by name alone; warns where it is ambiguous.

    For a discontinued glass its replacement, with the prefix "N-", is taken. A moulded variant of a glass ("..._MOLD",
    "...M") has an index lower by some 0.004, which no catalogue here states; its base glass is offered.

    Args:
        makers: the makers' catalogues that the file names; the first that has the glass is meant.
        said: the file's text, if it names the maker.
        figures: n_d and V_d that the file gives beside the name, for a glass that the catalogue does not know.

    Raises:
        InputError: such a name without figures; the message suggests the nearest.
    """
    same = catalogue.same_name(name)
    if not same and not figures and (left := _DISCONTINUED.get(name.upper())):
        warn(file, f"{field}: glass {name} is discontinued: taken by n_d {left[0]:g} and V_d {left[1] or 'unknown'}")
        return {"n_d": left[0], "V_d": left[1], "material": name}
    base = next(iter(catalogue.same_name(_MOULDED.sub("", name))), None)
    if base and not same and not figures:
        expected = f"a glass of the catalogue: it has {base.name}, whose moulded variant this may be; or give --glass"
        raise InputError(file, field, name, expected)
    if base and not same and figures and not 0 <= base.n_d - figures[0] <= _MOULDING:
        told = f"assumed to be {base} (n_d {base.n_d:.5f}), moulded: n_d {figures[0]:g} beside it fits no such glass"
        assume(file, f"{field}: glass {name} is {told}")
        return {"n_d": base.n_d, "V_d": base.V_d, "glass": short_name(base), "material": name}
    known = next((g for m in makers for g in same if g.maker.upper() == m), None)
    replacing = next((g for m in makers for g in catalogue.same_name(f"{m}:N-{name}") if m in _NAMES), None)
    if not (same or replacing or makers):
        replacing = next(iter(catalogue.same_name(f"N-{name}")), None)
    if figures and not (same or replacing):
        return by_figures(name, *figures, f"{file}: {field}")
    taken = known or replacing or catalogue.find(name, file, field)
    if makers and taken.maker.upper() not in makers:
        why = f"no glass of that name in the catalogues that the file names ({', '.join(makers)})"
    elif not makers and said is None:
        why = "the file names no maker"
    else:
        other = _letters(taken.name) not in _letters(said or name)
        why = "its maker's catalogue has none of that very name" if other else ""
    if why:
        warn(file, f"glass {said or name} is taken as {taken} (n_d {taken.n_d:.5f}, V_d {taken.V_d:.2f}): {why}")
    return {"n_d": taken.n_d, "V_d": taken.V_d, "glass": short_name(taken), "material": name}


def by_indices(line: Line, field: str, indices: Sequence[float], wavelengths_nm: Sequence[float]) -> dict[str, Any]:
    """Fields of a surface from indices at some wavelengths, reduced to n_d and V_d with a warning; one index is n_d.

    Between the wavelengths the index is a polynomial of 1 / lambda^2 through the four that are nearest.

    Raises:
        InputError: several indices, whose wavelengths do not enclose the lines d, F and C.
    """
    if len(indices) == 1:
        return {"n_d": indices[0]}
    table = {nm: n for nm, n in zip(wavelengths_nm, indices, strict=False) if nm > 0}
    lines = (LINE_D_NM, LINE_F_NM, LINE_C_NM)
    if not table or min(table) > min(lines) + _SAME_LINE_NM or max(table) < max(lines) - _SAME_LINE_NM:
        expected = "indices from the F line (486.13 nm) to the C line (656.27 nm), to reduce the glass to n_d and V_d"
        raise line.error(field, f"(wavelengths {list(wavelengths_nm)})", expected)
    found = []
    for line_nm in lines:
        near = sorted(table, key=lambda nm: abs(nm - line_nm))[:4]
        if abs(near[0] - line_nm) <= _SAME_LINE_NM:
            near = near[:1]
        shares = (math.prod((line_nm**-2 - b**-2) / (a**-2 - b**-2) for b in near if b != a) for a in near)
        found.append(sum(table[nm] * share for nm, share in zip(near, shares, strict=True)))
    n_d, n_F, n_C = found
    warn(line.file, f"line {line.number}, {field}: the glass is reduced to n_d and V_d")
    return {"n_d": n_d, "V_d": (n_d - 1) / (n_F - n_C) if n_F > n_C else None}


def _letters(name: str) -> str:
    """Letters and digits of a name, the rest of which does not count."""
    return "".join(filter(str.isalnum, name.upper()))


def same_glass(name: str | None, n_d: float, V_d: float | None) -> str | None:
    """The catalogue's glass of that name whose figures are the given ones to the digits printed, or None."""
    if name is None or V_d is None:
        return None
    for known in catalogue.same_name(name):
        if abs(known.n_d - n_d) <= SAME_INDEX and abs(known.V_d - V_d) <= SAME_ABBE * V_d:
            return short_name(known)
    return None


def short_name(glass: Glass) -> str:
    """The name that finds a glass again, with its maker only where others have one of that name."""
    return glass.name if catalogue.find(glass.name) is glass else str(glass)
