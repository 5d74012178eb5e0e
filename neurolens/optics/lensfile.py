"""Lens files: one prescription a TOML file, read strictly. `lenswriter` writes them.

The format, complete; keys marked optional may be left out:

    schema = 1
    name = "Double Gauss 50 mm f/1.8"
    designer = "..."            # optional
    source = "patent or book and page"
    f_number = 1.8              # nominal, of the source; the stop's diameter is what counts
    image_radius_mm = 21.6      # optional
    half_field_deg = 23.3       # optional, from the axis
    rims = "source"             # where the diameters come from: "source" or "estimated"
    notes = "..."               # optional: what was corrected or estimated, and why

    # From the scene to the film, one row a surface, numbered from 0.
    # radius_mm: positive when the centre of curvature lies towards the film, inf for a plane.
    # thickness_mm: to the next surface; the last one to the film. diameter_mm: full clear diameter.
    # n_d, V_d: of the glass after the surface; without n_d it is air. V_d may be left out where unknown: the index
    # is then constant. material: name of the glass, for people only. stop = true: the aperture stop, one row.
    surfaces = [
      { radius_mm = 33.802, thickness_mm = 5.817, diameter_mm = 41.66, n_d = 1.6645, V_d = 35.91, material = "..." },
      { radius_mm = inf, thickness_mm = 10.211, diameter_mm = 19.05, stop = true },
    ]

    [[configuration]]           # zoom states, optional: thicknesses that replace those above, by surface number
    name = "135mm"
    efl_mm = 135.0
    half_field_deg = 9.15       # optional
    thickness_mm = { 5 = 26.15, 9 = 12.89 }
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.errors import InputError, NeurolensWarning
from neurolens.optics.clearance import check_clearance
from neurolens.optics.prescription import Configuration, Lens, Surface
from neurolens.tomlfile import read_toml, reject_unknown

SCHEMA = 1
MAX_SURFACES = 500
MAX_INDEX = 4.5  # germanium, the densest lens material there is, has 4.0
LENS_KEYS = (
    *("schema", "name", "designer", "source", "f_number", "image_radius_mm", "half_field_deg", "rims", "notes"),
    *("surfaces", "configuration"),
)
SURFACE_KEYS = ("radius_mm", "thickness_mm", "diameter_mm", "n_d", "V_d", "material", "stop")
CONFIGURATION_KEYS = ("name", "efl_mm", "half_field_deg", "thickness_mm")


def read_lens(path: str | Path) -> Lens:
    """The lens of a file, unfocused (`Lens.at` places the film).

    Warns:
        NeurolensWarning: glasses whose V_d is unknown; their index is taken as constant.

    Raises:
        InputError: the first mistake met: an unknown or missing key, a wrong type, a value out of range, no stop or
            two, surfaces that overlap inside their rims in any zoom state. It names file, surface and field.
    """
    data, file = read_toml(path), str(path)
    reject_unknown(file, "", data, LENS_KEYS)
    if data.get("schema") != SCHEMA or isinstance(data["schema"], bool):
        raise InputError(file, "schema", data.get("schema", "(missing)"), f"{SCHEMA}, the version of the format")
    surfaces = _surfaces(data, file)
    lens = Lens(
        name=_text(data, "name", file),
        source=_text(data, "source", file),
        surfaces=surfaces,
        f_number=_number(data, "f_number", file, above=0),
        image_radius_mm=_number(data, "image_radius_mm", file, above=0) if "image_radius_mm" in data else None,
        half_field_deg=_half_field(data, file),
        designer=_text(data, "designer", file, required=False),
        notes=_text(data, "notes", file, required=False),
        rims=_text(data, "rims", file),
        configurations=_configurations(data, len(surfaces), file),
        path=file,
    )
    if lens.rims not in ("source", "estimated"):
        raise InputError(file, "rims", lens.rims, 'where the diameters come from: "source" or "estimated"')
    check_clearance(surfaces, file)
    for c in lens.configurations:
        moved = dict(c.thickness_mm)
        rows = [replace(s, thickness_mm=moved.get(k, s.thickness_mm)) for k, s in enumerate(surfaces)]
        check_clearance(rows, file, f'configuration "{c.name}", ')
    unknown = ", ".join(str(k) for k, s in enumerate(surfaces) if s.n_d != 1 and s.V_d is None)
    if unknown:
        text = f"{file}: V_d is not given after surface {unknown}: the index is taken as constant"
        warnings.warn(text, NeurolensWarning, stacklevel=2)
    return lens


def _surfaces(data: Mapping[str, Any], file: str) -> tuple[Surface, ...]:
    rows = data.get("surfaces", "(missing)")
    if not isinstance(rows, list) or not rows:
        raise InputError(file, "surfaces", rows, "a list of tables, one a surface")
    if len(rows) > MAX_SURFACES:
        raise InputError(file, "surfaces", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    surfaces = tuple(_surface(row, f"surface {k}", file) for k, row in enumerate(rows))
    stops = [k for k, s in enumerate(surfaces) if s.stop]
    if len(stops) != 1:
        found = f"(stop = true on surfaces {', '.join(map(str, stops))})" if stops else "(no stop)"
        raise InputError(file, "surfaces", found, "exactly one row with stop = true")
    if all(s.n_d == 1 for s in surfaces):
        raise InputError(file, "surfaces", "(air only)", "at least one surface with n_d")
    if surfaces[-1].n_d != 1:
        raise InputError(
            file, f"surface {len(surfaces) - 1}, n_d", surfaces[-1].n_d, "air between last surface and film"
        )
    return surfaces


def _surface(row: Any, place: str, file: str) -> Surface:
    if not isinstance(row, Mapping):
        raise InputError(
            file, place, row, "a table such as { radius_mm = 50.0, thickness_mm = 5.0, diameter_mm = 20.0 }"
        )
    where = f"{place}, "
    reject_unknown(file, where, row, SURFACE_KEYS)
    radius_mm = _number(row, "radius_mm", file, where, unit="mm, inf for a plane", finite=False)
    if radius_mm == 0:
        raise InputError(file, f"{where}radius_mm", radius_mm, "a radius that is not 0 (a plane is inf)")
    for key in ("V_d", "material"):
        if key in row and "n_d" not in row:
            raise InputError(file, f"{where}n_d", "(missing)", f"the index of the glass, as {key} is given")
    stop = row.get("stop", False)
    if not isinstance(stop, bool):
        raise InputError(file, f"{where}stop", stop, "true or false")
    return Surface(
        radius_mm=math.inf if math.isinf(radius_mm) else radius_mm,
        thickness_mm=_number(row, "thickness_mm", file, where, unit="mm"),
        diameter_mm=_number(row, "diameter_mm", file, where, unit="mm", above=0),
        n_d=_index(row, file, where) if "n_d" in row else 1.0,
        V_d=_number(row, "V_d", file, where, above=0) if "V_d" in row else None,
        material=_text(row, "material", file, where) if "material" in row else None,
        stop=stop,
    )


def _configurations(data: Mapping[str, Any], n_surfaces: int, file: str) -> tuple[Configuration, ...]:
    tables = data.get("configuration", [])
    if not isinstance(tables, list) or not all(isinstance(t, Mapping) for t in tables):
        raise InputError(file, "configuration", tables, "tables under [[configuration]]")
    result: list[Configuration] = []
    for number, table in enumerate(tables):
        where = f"configuration {number}, "
        reject_unknown(file, where, table, CONFIGURATION_KEYS)
        name = _text(table, "name", file, where)
        if name in [c.name for c in result]:
            raise InputError(file, f"{where}name", name, "a name that no other configuration has")
        where = f'configuration "{name}", '
        moved = table.get("thickness_mm", "(missing)")
        if not isinstance(moved, Mapping):
            raise InputError(file, f"{where}thickness_mm", moved, "a table such as { 5 = 26.15 }, by surface number")
        thickness = []
        for key in moved:
            if not (key.isascii() and key.isdecimal() and str(int(key)) == key and int(key) < n_surfaces):
                raise InputError(file, f"{where}thickness_mm", key, f"a surface number from 0 to {n_surfaces - 1}")
            thickness.append((int(key), _number(moved, key, file, f"{where}thickness_mm, surface ", unit="mm")))
        efl_mm = _number(table, "efl_mm", file, where, unit="mm", above=0)
        result.append(Configuration(name, efl_mm, tuple(thickness), _half_field(table, file, where)))
    return tuple(result)


def _number(
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
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:
        number = math.nan
    if math.isnan(number) or (finite and math.isinf(number)) or (above is not None and not number > above):
        raise InputError(file, where + key, value, expected)
    return number


def _index(row: Mapping[str, Any], file: str, where: str) -> float:
    n_d = _number(row, "n_d", file, where)
    if not 1 <= n_d <= MAX_INDEX:
        raise InputError(file, f"{where}n_d", n_d, f"a refractive index from 1 to {MAX_INDEX}")
    return n_d


def _half_field(table: Mapping[str, Any], file: str, where: str = "") -> float | None:
    if "half_field_deg" not in table:
        return None
    angle = _number(table, "half_field_deg", file, where, unit="degrees", above=0)
    if angle >= 180:
        raise InputError(file, f"{where}half_field_deg", angle, "an angle from the axis, below 180 degrees")
    return angle


def _text(table: Mapping[str, Any], key: str, file: str, where: str = "", *, required: bool = True) -> str:
    if key not in table and not required:
        return ""
    value = table.get(key, "(missing)")
    if key not in table or not isinstance(value, str) or (required and not value.strip()):
        raise InputError(file, where + key, value, "a text")
    return value
