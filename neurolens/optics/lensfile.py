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

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.tomlfile import read_toml, reject_unknown
from neurolens.optics.apertures import Aperture
from neurolens.optics.glass import check_against_table
from neurolens.optics.prescription import Coating, Configuration, Lens, Surface
from neurolens.optics.sag import check_clearance

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


MAX_SURFACES = 500
MAX_LAYERS = 200
MAX_POWER = 40
SURFACE_KEYS = (
    *("radius_mm", "thickness_mm", "diameter_mm", "n_d", "V_d", "glass", "material", "stop", "conic", "asphere"),
    *("cylinder", "absorption_per_mm", "coating"),
)


def read_surfaces(data: Mapping[str, Any], file: str) -> tuple[Surface, ...]:
    """All rows of a lens file, checked one by one and together.

    Raises:
        InputError: names file, surface and field.
    """
    rows = data.get("surfaces", "(missing)")
    if not isinstance(rows, list) or not rows:
        raise InputError(file, "surfaces", rows, "a list of tables, one a surface")
    if len(rows) > MAX_SURFACES:
        raise InputError(file, "surfaces", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    coatings = _coatings(data, file)
    surfaces: list[Surface] = []
    for k, row in enumerate(rows):
        surfaces.append(_surface(row, f"surface {k}", file, surfaces[-1].n_d if surfaces else 1.0, coatings))
    stops = [k for k, s in enumerate(surfaces) if s.stop]
    if len(stops) != 1:
        found = f"(stop = true on surfaces {', '.join(map(str, stops))})" if stops else "(no stop)"
        raise InputError(file, "surfaces", found, "exactly one row with stop = true")
    if surfaces[-1].n_d != 1:
        raise InputError(
            file, f"surface {len(surfaces) - 1}, n_d", surfaces[-1].n_d, "air between last surface and film"
        )
    return tuple(surfaces)


def _surface(row: Any, place: str, file: str, n_before: float, coatings: Mapping[str, Coating]) -> Surface:
    if not isinstance(row, Mapping):
        raise InputError(
            file, place, row, "a table such as { radius_mm = 50.0, thickness_mm = 5.0, diameter_mm = 20.0 }"
        )
    where = f"{place}, "
    reject_unknown(file, where, row, SURFACE_KEYS)
    radius_mm = number(row, "radius_mm", file, where, unit="mm, inf for a plane", finite=False)
    if radius_mm == 0:
        raise InputError(file, f"{where}radius_mm", radius_mm, "a radius that is not 0 (a plane is inf)")
    stop = row.get("stop", False)
    if not isinstance(stop, bool):
        raise InputError(file, f"{where}stop", stop, "true or false")
    surface = Surface(
        radius_mm=math.inf if math.isinf(radius_mm) else radius_mm,
        thickness_mm=number(row, "thickness_mm", file, where, unit="mm"),
        diameter_mm=number(row, "diameter_mm", file, where, unit="mm", above=0),
        stop=stop,
        **_glass(row, file, where),
        **_shape(row, file, where),
    )
    check_against_table(surface, file, where)
    if "coating" not in row:
        return surface
    return replace(surface, coating=_coating(row, file, where, (n_before, surface.n_d), coatings))


def _glass(row: Mapping[str, Any], file: str, where: str) -> dict[str, Any]:
    """The medium after the surface; what a catalogue knows need not be in the file."""
    for key in ("V_d", "material", "absorption_per_mm"):
        if key in row and not row.keys() & {"n_d", "glass"}:
            raise InputError(file, f"{where}n_d", "(missing)", f"the index of the glass, as {key} is given")
    medium: dict[str, Any] = {"n_d": index(row, file, where) if "n_d" in row else 1.0}
    if "V_d" in row:
        medium["V_d"] = number(row, "V_d", file, where, above=0)
    if "material" in row:
        medium["material"] = text(row, "material", file, where)
    if "absorption_per_mm" in row:
        medium["absorption_per_mm"] = number(row, "absorption_per_mm", file, where, unit="1/mm")
        if medium["absorption_per_mm"] < 0:
            raise InputError(
                file, f"{where}absorption_per_mm", medium["absorption_per_mm"], "at least 0: no glass shines"
            )
    if "glass" in row:
        from neurolens.optics import catalogue

        medium["glass"] = text(row, "glass", file, where)
        known = catalogue.find(medium["glass"], file, f"{where}glass")
        medium = {"V_d": known.V_d, **medium, "n_d": medium["n_d"] if "n_d" in row else known.n_d}
    return medium


def _shape(row: Mapping[str, Any], file: str, where: str) -> dict[str, Any]:
    """Conic, asphere and cylinder of a row."""
    shape: dict[str, Any] = {"conic": number(row, "conic", file, where)} if "conic" in row else {}
    if "cylinder" in row:
        shape["cylinder"] = text(row, "cylinder", file, where)
        if shape["cylinder"] not in ("x", "y"):
            raise InputError(
                file, f"{where}cylinder", shape["cylinder"], 'the axis along which it is curved: "x" or "y"'
            )
    if "asphere" in row:
        given = row["asphere"]
        if not isinstance(given, Mapping) or not given:
            raise InputError(file, f"{where}asphere", given, "a table such as { 4 = 1e-6, 6 = 2e-9 }")
        terms = []
        for key in given:
            if not (key.isascii() and key.isdecimal() and str(int(key)) == key and 2 <= int(key) <= MAX_POWER):
                raise InputError(file, f"{where}asphere", key, f"a power from 2 to {MAX_POWER}")
            if isinstance(given[key], Mapping) and len(given[key]) == 1:  # TOML takes 4.5 for a key in a key
                power = f"{key}.{next(iter(given[key]))}"
                raise InputError(file, f"{where}asphere", power, f"a whole power from 2 to {MAX_POWER}")
            terms.append((int(key), number(given, key, file, f"{where}asphere, power ")))
        shape["asphere"] = tuple(sorted(terms))
    return shape


def _coatings(data: Mapping[str, Any], file: str) -> dict[str, Coating]:
    """The coatings that the file itself defines, by name."""
    tables = data.get("coating", [])
    if not isinstance(tables, list) or not all(isinstance(t, Mapping) for t in tables):
        raise InputError(file, "coating", tables, "tables under [[coating]]")
    found: dict[str, Coating] = {}
    for place, table in enumerate(tables):
        where = f"coating {place}, "
        reject_unknown(file, where, table, ("name", "layers"))
        name, rows = text(table, "name", file, where), table.get("layers", "(missing)")
        if name in found:
            raise InputError(file, f"{where}name", name, "a name that no other coating has")
        if not isinstance(rows, list) or not 0 < len(rows) <= MAX_LAYERS:
            raise InputError(file, f"{where}layers", rows, f"1 to {MAX_LAYERS} layers such as [1.38, 99.6]")
        layers = []
        for n, row in enumerate(rows):
            if not isinstance(row, list) or len(row) != 2:
                raise InputError(file, f"{where}layers", row, "[refractive index, thickness in nm]")
            pair = {"index": row[0], "thickness_nm": row[1]}
            n_film, nm = (number(pair, key, file, f"{where}layer {n}, ", above=0) for key in pair)
            layers.append((n_film, nm))
        found[name] = Coating(name, tuple(layers))
    return found


def unused_coatings(data: Mapping[str, Any]) -> list[str]:
    """Names of the coatings of a file (one that reads) that no surface has."""
    used = {row.get("coating") for row in data["surfaces"]}
    return [table["name"] for table in data.get("coating", []) if table["name"] not in used]


def _coating(
    row: Mapping[str, Any], file: str, where: str, indices: tuple[float, float], known: Mapping[str, Coating]
) -> Coating:
    """A coating of the file by its name, else one of the usual designs for the two media."""
    name = text(row, "coating", file, where)
    if name in known:
        return known[name]
    from neurolens.optics import coatings

    return coatings.design(name, *indices, file=file, where=f"{where}coating")
