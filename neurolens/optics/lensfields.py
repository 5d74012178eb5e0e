"""Values of a lens file, each read strictly: one clear error names file, field, value and what was expected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from neurolens.base.errors import InputError

MAX_INDEX = 4.5  # germanium, the densest lens material there is, has 4.0


def number(
    table: Mapping[str, Any],
    key: str,
    file: str,
    where: str = "",
    *,
    unit: str = "",
    above: float | None = None,
    finite: bool = True,
) -> float:
    """A number of the table: an integer or a float, never a bool, a text or NaN."""
    value = table.get(key, "(missing)")
    expected = "a finite number" if finite else "a number"
    expected += (f" above {above:g}" if above is not None else "") + (f" in {unit}" if unit else "")
    try:
        found = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:
        found = math.nan
    if math.isnan(found) or (finite and math.isinf(found)) or (above is not None and not found > above):
        raise InputError(file, where + key, value, expected)
    return found


def index(row: Mapping[str, Any], file: str, where: str) -> float:
    """The refractive index `n_d` of a row."""
    n_d = number(row, "n_d", file, where)
    if not 1 <= n_d <= MAX_INDEX:
        raise InputError(file, f"{where}n_d", n_d, f"a refractive index from 1 to {MAX_INDEX}")
    return n_d


def half_field(table: Mapping[str, Any], file: str, where: str = "") -> float | None:
    """The optional `half_field_deg` of a table."""
    if "half_field_deg" not in table:
        return None
    angle = number(table, "half_field_deg", file, where, unit="degrees", above=0)
    if angle >= 180:
        raise InputError(file, f"{where}half_field_deg", angle, "an angle from the axis, below 180 degrees")
    return angle


def text(table: Mapping[str, Any], key: str, file: str, where: str = "", *, required: bool = True) -> str:
    """A text of the table; an empty one where a text that is not required is absent."""
    if key not in table and not required:
        return ""
    value = table.get(key, "(missing)")
    if key not in table or not isinstance(value, str) or (required and not value.strip()):
        raise InputError(file, where + key, value, "a text")
    return value
