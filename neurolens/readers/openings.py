"""The stop and the rims of a lens where its file leaves them open, contradicts itself, or cannot mean what it says."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from neurolens.base.errors import InputError
from neurolens.lens.paraxial import system_of
from neurolens.lens.prescription import Lens, Medium
from neurolens.readers.assemble import check_rows, first_order
from neurolens.readers.source import assume, warn
from neurolens.setting.rims import end_mm, narrowed_rims, with_derived_rims

if TYPE_CHECKING:
    from neurolens.readers.draft import Draft

_SLIGHTLY = 0.1  # of a rim's diameter
_TWICE, _SAME = (0.4, 0.7), (0.7, 1.4)  # f-number by the stop's diameter over the stated one: rims twice as wide, right


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
    """A rim over the height of the marginal ray of a beam 2 mm wide; infinite where there is no rim."""
    return math.inf if math.isnan(rim) or height == 0 else rim / abs(height)


def stop_aperture(draft: Draft) -> float | None:
    """Diameter of the aperture that the file sets on the stop itself, in its unit."""
    stops = (row.surface.diameter_mm for row in draft.rows if row.surface.stop and row.aperture)
    return next((d for d in stops if not math.isnan(d)), None)


def with_likely_rims(lens: Lens, draft: Draft) -> Lens:
    """The lens with rims of half the width, where stop and spheres say that radii were meant by diameters."""
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
    """The lens with rims no wider than their spheres and than where neighbours touch, in every state.

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
