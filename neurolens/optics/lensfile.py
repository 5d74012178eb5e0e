"""Lens files: one prescription a TOML file, read strictly. `lenswriter` writes them.

The format, complete; keys marked optional may be left out:

    schema = 1
    name = "Double Gauss 50 mm f/1.8"
    designer = "..."            # optional
    source = "patent or book and page"
    f_number = 1.8              # nominal, of the source; the stop's diameter is what counts
    efl_mm = 50.0               # optional: as the source states it, in y-z; the surfaces are what counts
    efl_x_mm = 25.0             # optional: in x-z, of an anamorphic lens
    image_radius_mm = 21.6      # optional
    half_field_deg = 23.3       # optional, from the axis
    rims = "source"             # where the diameters come from: "source", "estimated" (by somebody) or "derived"
    notes = "..."               # optional: what was corrected or estimated, and why

    # From the scene to the film, one row a surface, numbered from 0.
    # radius_mm: positive when the centre of curvature lies towards the film, inf for a plane.
    # thickness_mm: to the next surface; the last one to the film. diameter_mm: full clear diameter.
    # n_d, V_d: of the glass after the surface; without n_d it is air. V_d may be left out where unknown: the index
    # is then constant. glass: name in the catalogue, whose dispersion then rules over n_d and V_d (which may be left
    # out). material: name of the glass in the source, for people only. stop = true: the aperture stop, one row.
    # Optional: conic (Schwarzschild's constant K, 0 a sphere, -1 a paraboloid), asphere (power = coefficient:
    # sag = conic + sum A_p r^p, mm), cylinder = "x" or "y" (the axis along which it is curved), absorption_per_mm
    # (Napierian, of the medium after the surface), coating (a design such as "quarter-wave 550", or the name of one of
    # the coatings below).
    surfaces = [
      { radius_mm = 33.802, thickness_mm = 5.817, diameter_mm = 41.66, n_d = 1.6645, V_d = 35.91, material = "..." },
      { radius_mm = inf, thickness_mm = 10.211, diameter_mm = 19.05, stop = true },
      { radius_mm = 20.0, thickness_mm = 3.0, diameter_mm = 12.0, glass = "N-BK7", asphere = { 4 = 1e-6 } },
    ]

    [[coating]]                 # optional: layers are [refractive index, thickness in nm] from the scene's side
    name = "mine"
    layers = [[1.38, 99.6]]

    [aperture]                  # optional: blades of the stop, whose diameter is then that of the circle round them
    blades = 9
    rotation_deg = 10.0         # optional: of the first corner, from x towards y
    curvature = 0.6             # optional: of the edges, 0 straight to 1 round

    [[configuration]]           # zoom and focus states, optional: thicknesses that replace those above, by surface
    name = "135mm"
    efl_mm = 135.0              # may be left out in a focus state
    thickness_mm = { 5 = 26.15, 9 = 12.89 }
    half_field_deg = 9.15       # optional
    f_number = 2.9              # optional
    stop_diameter_mm = 38.9     # optional
    object_distance_mm = 750.0  # of a focus state: object to front vertex
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.apertures import Aperture
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.tomlfile import read_toml, reject_unknown
from neurolens.optics.clearance import check_clearance
from neurolens.optics.lensfields import half_field, number, text
from neurolens.optics.lensrows import read_surfaces, unused_coatings
from neurolens.optics.prescription import Configuration, Lens

SCHEMA = 1
LENS_KEYS = (
    *("schema", "name", "designer", "source", "f_number", "efl_mm", "efl_x_mm", "image_radius_mm", "half_field_deg"),
    *("rims", "notes", "surfaces", "coating", "configuration", "aperture"),
)
CONFIGURATION_KEYS = (
    *("name", "efl_mm", "half_field_deg", "thickness_mm", "f_number", "stop_diameter_mm", "object_distance_mm"),
)
RIMS = ("source", "estimated", "derived")


def read_lens(path: str | Path) -> Lens:
    """The lens of a file, unfocused (`Lens.at` places the film).

    Warns:
        NeurolensWarning: glasses whose V_d is unknown; their index is taken as constant. A coating that no surface has.

    Raises:
        InputError: the first mistake met: an unknown or missing key, a wrong type, a value out of range, no stop or
            two, surfaces that overlap inside their rims in any zoom state. It names file, surface and field.
    """
    data, file = read_toml(path), str(path)
    reject_unknown(file, "", data, LENS_KEYS)
    if data.get("schema") != SCHEMA or isinstance(data["schema"], bool):
        raise InputError(file, "schema", data.get("schema", "(missing)"), f"{SCHEMA}, the version of the format")
    surfaces = read_surfaces(data, file)
    if data.get("rims", "(missing)") not in RIMS:
        expected = 'where the diameters come from: "source", "estimated" or "derived"'
        raise InputError(file, "rims", data.get("rims", "(missing)"), expected)
    lens = Lens(
        name=text(data, "name", file),
        source=text(data, "source", file),
        surfaces=surfaces,
        f_number=number(data, "f_number", file, above=0),
        image_radius_mm=number(data, "image_radius_mm", file, above=0) if "image_radius_mm" in data else None,
        half_field_deg=half_field(data, file),
        designer=text(data, "designer", file, required=False),
        notes=text(data, "notes", file, required=False),
        rims=text(data, "rims", file),
        configurations=_configurations(data, len(surfaces), file),
        path=file,
        aperture=_aperture(data, file),
        stated_efl_mm=number(data, "efl_mm", file, above=0) if "efl_mm" in data else None,
        stated_efl_x_mm=number(data, "efl_x_mm", file, above=0) if "efl_x_mm" in data else None,
    )
    check_clearance(surfaces, file)
    for c in lens.configurations:
        moved = dict(c.thickness_mm)
        rows = [replace(s, thickness_mm=moved.get(k, s.thickness_mm)) for k, s in enumerate(surfaces)]
        check_clearance(rows, file, f'configuration "{c.name}", ')
    unknown = ", ".join(str(k) for k, s in enumerate(surfaces) if s.n_d != 1 and s.V_d is None and s.glass is None)
    if unknown:
        message = f"{file}: V_d is not given after surface {unknown}: the index is taken as constant"
        warnings.warn(message, NeurolensWarning, stacklevel=2)
    for name in unused_coatings(data):
        warnings.warn(f'{file}: coating "{name}": no surface has it', NeurolensWarning, stacklevel=2)
    return lens


def _aperture(data: Mapping[str, Any], file: str) -> Aperture | None:
    if "aperture" not in data:
        return None
    table, where = data["aperture"], "aperture, "
    if not isinstance(table, Mapping):
        raise InputError(file, "aperture", table, "a table under [aperture]")
    reject_unknown(file, where, table, ("blades", "rotation_deg", "curvature"))
    more: dict[str, Any] = {k: number(table, k, file, where) for k in ("rotation_deg", "curvature") if k in table}
    try:
        return Aperture(table.get("blades"), **more)
    except InputError as error:
        raise InputError(file, where + error.field, error.value, error.expected) from None


def _configurations(data: Mapping[str, Any], n_surfaces: int, file: str) -> tuple[Configuration, ...]:
    tables = data.get("configuration", [])
    if not isinstance(tables, list) or not all(isinstance(t, Mapping) for t in tables):
        raise InputError(file, "configuration", tables, "tables under [[configuration]]")
    result: list[Configuration] = []
    for place, table in enumerate(tables):
        where = f"configuration {place}, "
        reject_unknown(file, where, table, CONFIGURATION_KEYS)
        name = text(table, "name", file, where)
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
            thickness.append((int(key), number(moved, key, file, f"{where}thickness_mm, surface ", unit="mm")))
        given = {
            key: number(table, key, file, where, above=0)
            for key in ("efl_mm", "f_number", "stop_diameter_mm", "object_distance_mm")
            if key in table
        }
        if not given.keys() & {"efl_mm", "object_distance_mm"}:
            raise InputError(file, f"{where}efl_mm", "(missing)", "the focal length of a zoom state")
        result.append(
            Configuration(
                name,
                thickness_mm=tuple(thickness),
                half_field_deg=half_field(table, file, where),
                **{"efl_mm": None, **given},
            )
        )
    return tuple(result)
