"""What a JSON prescription states beside its table: focal length, field, and figures to check the table against."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from neurolens.base.errors import InputError
from neurolens.optics import paraxial
from neurolens.optics.prescription import Lens
from neurolens.readers.assemble import is_anamorphic
from neurolens.readers.source import warn

COMPUTED_KEYS = ("efl_mm", "bfd_mm", "efl_y_mm", "efl_x_mm", "bfd_y_mm", "bfd_x_mm", "f_number_from_stop")
AGREES = 1e-4  # relative: more than rounding of the printed figures, less than any wrong digit
_NUMBER = r"([0-9]+(?:\.[0-9]+)?)"


def stated_efl(lens: Lens, data: Mapping[str, Any]) -> Lens:
    """The lens with the focal length that the file states: of several, those of an anamorphic lens by meridian, else
    the first (the state that the table is in)."""
    given = data.get("efl_mm")
    values = [given] if not isinstance(given, list) else given
    for value in values:
        real = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
        if value is not None and not real:
            raise InputError(lens.path, "efl_mm", given, "a number above 0 in mm, a list of them, or null")
    if not values or values[0] is None:
        return lens
    if is_anamorphic(lens) and len(values) == 2:
        y = paraxial.first_order(lens, meridian="y").efl_mm
        x = paraxial.first_order(lens, meridian="x").efl_mm
        a, b = map(float, values)
        straight = abs(math.log(a / abs(y))) + abs(math.log(b / abs(x)))
        crossed = abs(math.log(b / abs(y))) + abs(math.log(a / abs(x)))
        a, b = (a, b) if straight <= crossed else (b, a)
        return replace(lens, stated_efl_mm=a, stated_efl_x_mm=b)
    return replace(lens, stated_efl_mm=float(values[0]))


def check_computed(lens: Lens, data: Mapping[str, Any]) -> None:
    """Warn where focal length or back focus differ from those that the file says were computed from its table."""
    given = data.get("computed_at_nd") or {}
    if not isinstance(given, Mapping):
        raise InputError(lens.path, "computed_at_nd", given, "an object with efl_mm and bfd_mm")
    table = replace(lens, surfaces=tuple(replace(s, glass=None) for s in lens.surfaces))
    axes: tuple[tuple[Literal["x", "y"], str], ...] = (("y", ""), ("y", "_y"), ("x", "_x"))
    for axis, suffix in axes:
        found = paraxial.first_order(table, meridian=axis)
        for key, value in ((f"efl{suffix}_mm", found.efl_mm), (f"bfd{suffix}_mm", found.back_focus_mm)):
            expected = given.get(key)
            if isinstance(expected, int | float) and not abs(value - expected) <= AGREES * abs(found.efl_mm):
                warn(lens.path, f"{key} computed from the table is {value:.6g}; the file says {expected:.6g}")


def image_and_field(data: Mapping[str, Any], file: str) -> dict[str, Any]:
    """`image_radius_mm` and `half_field_deg` from the free text of `field_or_image_circle`, where it is clear.

    Understood: "image radius 21.6 mm", "image circle 43.2 mm", "38 deg half field", "+-20 deg", "180 deg full field",
    "AOV 45.2 deg" (full; of several the first), and the keys fullFieldDeg and imageCircleMm. Else a warning.
    """
    text = data.get("field_or_image_circle")
    found: dict[str, Any] = {"image_radius_mm": None, "half_field_deg": None}
    if text is None or text == "":
        return found
    if not isinstance(text, str):
        raise InputError(file, "field_or_image_circle", text, "a text or null")
    for pattern, key, factor in (
        (rf"image radius {_NUMBER} mm", "image_radius_mm", 1.0),
        (rf"image height {_NUMBER} mm", "image_radius_mm", 1.0),
        (rf"image circle {_NUMBER} mm", "image_radius_mm", 0.5),
        (r'"imageCircleMm": *' + _NUMBER, "image_radius_mm", 0.5),
        (rf"{_NUMBER} deg half field", "half_field_deg", 1.0),
        (rf"\+-{_NUMBER} deg", "half_field_deg", 1.0),
        (rf"{_NUMBER} deg full field", "half_field_deg", 0.5),
        (rf"AOV {_NUMBER}", "half_field_deg", 0.5),
        (r'"fullFieldDeg": *' + _NUMBER, "half_field_deg", 0.5),
    ):
        match = re.search(pattern, text)
        if match and found[key] is None:
            found[key] = float(match[1]) * factor
    if found == {"image_radius_mm": None, "half_field_deg": None}:
        warn(file, f"field_or_image_circle is not clear and left out: {json.dumps(text)}")
    return found
