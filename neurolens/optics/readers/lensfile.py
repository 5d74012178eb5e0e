"""Lens files: one prescription in a TOML file, read strictly, written in aligned columns and with every digit.

docs/pages/reference/lens-file.md describes the format: every key with its unit, default and limits, and an example.
"""

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.base.settings import WAVELENGTH_NM, said, within
from neurolens.base.tomlfile import format_value, read_toml
from neurolens.optics.lens import designs, glass as catalogue
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.figures import KEYS as FIGURE_KEYS, read_figure
from neurolens.optics.lens.glass import by_figures, check_against_table, index_at
from neurolens.optics.lens.placement import MOST_DECENTRE_MM, MOST_TILT_DEG, Placement
from neurolens.optics.lens.prescription import Coating, Configuration, Lens, Medium, Surface
from neurolens.optics.readers.source import MAX_INDEX, MAX_SURFACES, Table
from neurolens.optics.setting.rims import check_states, with_derived_rims

SCHEMA = 1
MAX_TERMS = 1000  # of all surfaces' aspheric coefficients: each costs every ray a step, and lenses have at most 400
MAX_LAYERS = 200
_LONGEST_NM = 780.0  # of visible light
FILM_KEYS = ("index", "thickness_nm", "V_d")
MEASURED_TEXTS, MEASURED_NUMBERS = ("profile", "match"), ("distortion_percent", "light_widest_stops", "light_f8_stops")
RIMS = ("source", "estimated", "derived", "photographs")
MAX_WAVELENGTHS = 100
# The keys of the head with the fields of `Lens` that they are, in the order of writing.
HEAD = {
    **{key: key for key in ("name", "believed_to_be", "designer", "mount", "source", "f_number")},
    **{"efl_mm": "stated_efl_mm", "efl_x_mm": "stated_efl_x_mm"},
    **{key: key for key in ("most_tilt_deg", "most_shift_mm", "image_radius_mm", "half_field_deg", "rims")},
    "wavelengths_nm": "wavelengths_nm",
}
LENS_KEYS = (
    "schema", *HEAD, "notes", "object_medium", "surfaces", "moved", "coating", "configuration", "aperture", "measured"
)  # fmt: skip
MEDIUM_KEYS = ("n_d", "V_d", "glass", "material")
# Numbers of a surface stand in columns; texts and tables go last, as a column of glass names needs no right edge.
COLUMNS = ("radius_mm", "thickness_mm", "diameter_mm", "n_d", "V_d", *FIGURE_KEYS)
PLACE_KEYS = ("decentre_mm", "tilt_deg")
SURFACE_KEYS = (*COLUMNS, "conic", "asphere", *PLACE_KEYS, "glass", "material", "absorption_per_mm", "coating", "stop")
GROUP_KEYS = ("surfaces", *PLACE_KEYS, "pivot_mm")
STATE_NUMBERS = ("efl_mm", "half_field_deg", "f_number", "stop_diameter_mm", "object_distance_mm")
CONFIGURATION_KEYS = ("name", *STATE_NUMBERS, "thickness_mm")
APERTURE_KEYS = ("blades", "rotation_deg", "curvature")
ROWS_COMMENT = """\
# From the scene to the film, numbered from 0. radius_mm is positive when the centre of curvature lies towards the film;
# inf is a plane. n_d and V_d are of the glass after the surface; air where they are left out.
"""
WRAP = 110


def read_lens(path: str | Path, data: Mapping[str, Any] | None = None) -> Lens:
    """The lens of a file in our own format, unfocused (`set_lens` places the film); `data`: its tables, if known.

    What the file leaves open of coatings and absorption is assumed (`designs.with_assumptions`).

    Warns:
        NeurolensWarning: the V_d of some glasses is unknown, and their index taken as constant; no surface has a
            coating.

    Raises:
        InputError: the first mistake: an unknown or missing key, a wrong type, a value out of range, no stop or two,
            surfaces that overlap inside their rims in some zoom state. Names file, surface and field.
    """
    data, file = read_toml(path) if data is None else data, str(path)
    table = Table(data, file)
    table.only(LENS_KEYS)
    if data.get("schema") != SCHEMA or isinstance(data["schema"], bool):
        raise table.error("schema", data.get("schema", "(missing)"), f"{SCHEMA}, the version of the format")
    example = "a table such as { n_d = 1.333, V_d = 55.8 }"
    medium = Medium(**_glass(table.inner("object_medium", data.get("object_medium", {}), MEDIUM_KEYS, example)))
    surfaces = _surfaces(table, medium)
    if data.get("rims", "(missing)") not in RIMS:
        expected = 'where the diameters come from: "source", "estimated", "derived" or "photographs"'
        raise table.error("rims", data.get("rims", "(missing)"), expected)
    stated: dict[str, Any] = {
        **{key: table.text(key) for key in ("name", "source", "rims")},
        **{key: table.text(key, required=False) for key in ("believed_to_be", "designer", "mount", "notes")},
    }
    numbers = ("image_radius_mm", "efl_mm", "efl_x_mm", "most_tilt_deg", "most_shift_mm")
    stated |= {HEAD[key]: table.optional(key) for key in numbers}
    lens = Lens(
        surfaces=surfaces,
        f_number=table.number("f_number", above=0),
        half_field_deg=table.half_field(),
        configurations=_configurations(table, len(surfaces)),
        path=file,
        aperture=_aperture(table),
        object_medium=medium,
        wavelengths_nm=_wavelengths(table),
        measured=_measured(table),
        **stated,
    )
    lens = _with_rims(lens, table)
    check_states(lens)
    unknown = ", ".join(str(k) for k, s in enumerate(surfaces) if s.n_d != 1 and s.V_d is None and s.glass is None)
    if unknown:
        message = f"{file}: V_d is not given after surface {unknown}: the index is taken as constant"
        warnings.warn(message, NeurolensWarning, stacklevel=2)
    used = {row.get("coating") for row in data["surfaces"]}
    for name in (coating["name"] for coating in data.get("coating", []) if coating["name"] not in used):
        warnings.warn(f'{file}: coating "{name}": no surface has it', NeurolensWarning, stacklevel=2)
    return designs.with_assumptions(lens)


def _with_rims(lens: Lens, table: Table) -> Lens:
    """Return the lens with the diameters that its file leaves out."""
    missing = [k for k, s in enumerate(lens.surfaces) if math.isnan(s.diameter_mm)]
    if not missing:
        return lens
    if lens.rims != "derived":
        expected = 'the full clear diameter in mm, or rims = "derived" to have it computed'
        raise table.error(f"surface {missing[0]}, diameter_mm", "(missing)", expected)
    return with_derived_rims(lens)


def _wavelengths(table: Table) -> tuple[float, ...]:
    given, expected = table.data.get("wavelengths_nm", []), f"a list of wavelengths {said(WAVELENGTH_NM)} nm"
    if not isinstance(given, list) or len(given) > MAX_WAVELENGTHS:
        raise table.error("wavelengths_nm", given, expected)
    for value in given:
        if isinstance(value, bool) or not isinstance(value, int | float) or not within(WAVELENGTH_NM, value):
            raise table.error("wavelengths_nm", value, expected)
    return tuple(float(value) for value in given)


def _surfaces(table: Table, in_front: Medium) -> tuple[Surface, ...]:
    rows = table.data.get("surfaces", "(missing)")
    if not isinstance(rows, list) or not rows:
        raise table.error("surfaces", rows, "a list of tables, one per surface")
    if len(rows) > MAX_SURFACES:
        raise table.error("surfaces", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    known = _coatings(table)
    surfaces: list[Surface] = []
    example = "a table such as { radius_mm = 50.0, thickness_mm = 5.0, diameter_mm = 20.0 }"
    for k, row in enumerate(rows):
        before = surfaces[-1].n_d if surfaces else in_front.n_d
        surfaces.append(_surface(table.inner(f"surface {k}", row, SURFACE_KEYS, example), before, known))
    stops = [k for k, s in enumerate(surfaces) if s.stop]
    if len(stops) != 1:
        found = f"(stop = true on surfaces {', '.join(map(str, stops))})" if stops else "(no stop)"
        raise table.error("surfaces", found, "exactly one row with stop = true")
    if (terms := sum(len(s.figure.powers) for s in surfaces)) > MAX_TERMS:
        raise table.error("surfaces", f"({terms} aspheric coefficients)", f"at most {MAX_TERMS}")
    for place, given in enumerate(table.tables("moved")):
        _move_group(table.inner(f"moved {place}", given, GROUP_KEYS), surfaces)
    return tuple(surfaces)


def _placement(row: Table) -> Placement:
    """Return how keys move and turn a surface or a group."""
    found = []
    for key, most, unit in zip(PLACE_KEYS, (MOST_DECENTRE_MM, MOST_TILT_DEG), ("mm", "degrees"), strict=True):
        given, numbers = row.data.get(key, [0.0, 0.0]), (int, float)
        sound = isinstance(given, list) and len(given) in (2, 3)
        if not sound or not all(type(v) in numbers and abs(v) <= most for v in given):
            expected = f"[x, y] or [x, y, z] in {unit}, each from {-most:g} to {most:g}"
            raise row.error(key, given, expected)
        x, y, z = (*map(float, given), 0.0)[:3]
        found.append((x, y, z))
    return Placement(*found)


def _move_group(group: Table, surfaces: list[Surface]) -> None:
    """Move and turn a group of surfaces as a rigid body."""
    ends, last = group.data.get("surfaces", "(missing)"), len(surfaces) - 1
    if not isinstance(ends, list) or len(ends) != 2 or any(type(k) is not int for k in ends):
        raise group.error("surfaces", ends, "[first, last], the numbers of surfaces that are moved together")
    if not 0 <= ends[0] <= ends[1] <= last:
        raise group.error("surfaces", ends, f"numbers from 0 to {last}, the first not above the last")
    pivot, placement = group.number("pivot_mm") if "pivot_mm" in group else 0.0, _placement(group)
    z = -pivot
    for k in range(ends[0], ends[1] + 1):
        surfaces[k] = replace(surfaces[k], placement=surfaces[k].placement.in_group(placement, z))
        z += float(surfaces[k].thickness_mm)


def _surface(row: Table, n_before: float, known: Mapping[str, Coating]) -> Surface:
    radius_mm = row.number("radius_mm", unit="mm, inf for a plane", finite=False)
    if radius_mm == 0:
        raise row.error("radius_mm", radius_mm, "a radius that is not 0 (a plane is inf)")
    surface = Surface(
        stop=row.flag("stop"),
        radius_mm=math.inf if math.isinf(radius_mm) else radius_mm,
        thickness_mm=row.number("thickness_mm", unit="mm"),
        diameter_mm=row.number("diameter_mm", unit="mm", above=0) if "diameter_mm" in row else math.nan,
        **_glass(row),
        figure=read_figure(row),
        placement=_placement(row),
    )
    check_against_table(surface, row.file, row.where)
    if "coating" not in row:
        return surface
    name = row.text("coating")
    if name in known:
        return replace(surface, coating=known[name])
    design = designs.design(name, n_before, surface.n_d, file=row.file, where=f"{row.where}coating")
    return replace(surface, coating=design)


def _glass(row: Table) -> dict[str, Any]:
    """Return the medium after the surface; what a catalogue knows may be missing in the file."""
    for key in ("V_d", "material", "absorption_per_mm"):
        if key in row and "n_d" not in row and "glass" not in row:
            raise row.error("n_d", "(missing)", f"the index of the glass, as {key} is given")
    medium: dict[str, Any] = {"n_d": row.number("n_d") if "n_d" in row else 1.0}
    if not 1 <= medium["n_d"] <= MAX_INDEX:
        raise row.error("n_d", medium["n_d"], f"a refractive index from 1 to {MAX_INDEX}")
    if "V_d" in row:
        medium["V_d"] = row.number("V_d", above=0)
    if "material" in row:
        medium["material"] = row.text("material")
    if "absorption_per_mm" in row:
        medium["absorption_per_mm"] = row.number("absorption_per_mm", unit="1/mm")
        if medium["absorption_per_mm"] < 0:
            raise row.error("absorption_per_mm", medium["absorption_per_mm"], "at least 0")
    if "glass" in row:
        name = row.text("glass")
        if not catalogue.same_name(name) and "n_d" in row and "V_d" in row:
            return medium | by_figures(name, medium["n_d"], medium["V_d"], f"{row.file}: {row.where}glass")
        medium["glass"] = name
        known = catalogue.find(name, row.file, f"{row.where}glass")
        medium = {"V_d": known.V_d, **medium, "n_d": medium["n_d"] if "n_d" in row else known.n_d}
    return medium


def _coatings(table: Table) -> dict[str, Coating]:
    found: dict[str, Coating] = {}
    for place, given in enumerate(table.tables("coating")):
        one = table.inner(f"coating {place}", given, ("name", "layers"))
        name, rows = one.text("name"), given.get("layers", "(missing)")
        if name in found:
            raise one.error("name", name, "a name that no other coating has")
        if not isinstance(rows, list) or not 0 < len(rows) <= MAX_LAYERS:
            raise one.error("layers", rows, f"1 to {MAX_LAYERS} layers such as [1.38, 99.6]")
        layers = []
        for n, row in enumerate(rows):
            if not isinstance(row, list) or len(row) not in (2, 3):
                raise one.error("layers", row, "[refractive index, thickness in nm], or with V_d behind them")
            film = Table(dict(zip(FILM_KEYS, row, strict=False)), table.file, f"{one.where}layer {n}, ")
            layer = tuple(film.number(key, above=0) for key in film.data)
            if len(layer) > 2 and index_at(layer[0], layer[2], _LONGEST_NM) < 1:
                raise film.error(
                    "V_d", layer[2], f"a dispersion with which its index is at least 1 at {_LONGEST_NM:g} nm"
                )
            layers.append(layer)
        found[name] = Coating(name, tuple(layers))
    return found


def _aperture(table: Table) -> Aperture | None:
    if "aperture" not in table:
        return None
    blades = table.inner("aperture", table.data["aperture"], APERTURE_KEYS, "a table under [aperture]")
    more: dict[str, Any] = {k: blades.number(k) for k in APERTURE_KEYS[1:] if k in blades}
    try:
        return Aperture(blades.data.get("blades"), **more)
    except InputError as error:
        raise blades.error(error.field, error.value, error.expected) from None


def _measured(lens: Table) -> tuple[tuple[str, Any], ...]:
    if "measured" not in lens:
        return ()
    keys = (*MEASURED_TEXTS, *MEASURED_NUMBERS)
    table = lens.inner("measured", lens.data["measured"], keys, "a table under [measured]")
    given = [key for key in keys if key in table]
    return tuple((key, table.text(key) if key in MEASURED_TEXTS else table.number(key)) for key in given)


def _configurations(lens: Table, n_surfaces: int) -> tuple[Configuration, ...]:
    result: list[Configuration] = []
    for place, given in enumerate(lens.tables("configuration")):
        table = lens.inner(f"configuration {place}", given, CONFIGURATION_KEYS)
        name = table.text("name")
        if name in [c.name for c in result]:
            raise table.error("name", name, "a name that no other configuration has")
        table = replace(table, where=f'configuration "{name}", ')
        thickness = table.gaps("thickness_mm", n_surfaces, "a table such as { 5 = 26.15 }, by surface number")
        values = {key: table.optional(key) for key in STATE_NUMBERS if key != "half_field_deg"}
        if values["efl_mm"] is None and values["object_distance_mm"] is None:
            raise table.error("efl_mm", "(missing)", "the focal length of a zoom state")
        result.append(Configuration(name, thickness_mm=thickness, half_field_deg=table.half_field(), **values))
    return tuple(result)


def write_lens(lens: Lens, path: str | Path) -> None:
    """Write a lens file, from which `read_lens` reads the same lens (except for its `path`).

    A focused lens keeps its film plane, which becomes the last thickness. What is derived goes into the notes.
    """
    atomic_write_text(path, format_lens(lens))


def format_lens(lens: Lens) -> str:
    """Return the text of a lens file."""
    values = {
        "schema": SCHEMA,
        **{key: getattr(lens, field) for key, field in HEAD.items()},
        "f_number": float(lens.f_number),
    }
    head = {key: value for key, value in values.items() if value not in (None, "", ())}
    lines = [f"{key} = {format_value(value)}" for key, value in head.items()]
    notes = " ".join(text for text in (lens.notes, lens.derived) if text)
    if notes:
        lines.append(f"notes = {_wrapped(notes)}")
    if lens.object_medium != Medium():
        medium = ((key, getattr(lens.object_medium, key)) for key in MEDIUM_KEYS)
        lines.append(f"object_medium = {format_value({key: value for key, value in medium if value is not None})}")
    text = "\n".join(lines) + "\n\n" + ROWS_COMMENT + "surfaces = [\n" + _rows(lens) + "]\n"
    for name, layers in _stacks(lens).items():
        text += f"\n[[coating]]\nname = {format_value(name)}\nlayers = {format_value(layers)}\n"
    text += _blades(lens)
    if lens.measured:
        text += "\n[measured]\n" + "".join(f"{key} = {format_value(value)}\n" for key, value in lens.measured)
    for c in lens.configurations:
        text += f"\n[[configuration]]\nname = {format_value(c.name)}\n"
        for key in STATE_NUMBERS:
            value = getattr(c, key)
            text += "" if value is None else f"{key} = {format_value(float(value))}\n"
        text += f"thickness_mm = {format_value({str(k): float(t) for k, t in c.thickness_mm})}\n"
    return text


def _stacks(lens: Lens) -> dict[str, tuple[tuple[float, ...], ...]]:
    """Return the layers, by name, of the coatings that are not designs; name and glass determine a design."""
    found, before = {}, float(lens.object_medium.n_d)
    for s in lens.surfaces:
        if s.coating and s.coating.origin != "assumed" and not designs.is_design(s.coating, before, float(s.n_d)):
            found[s.coating.name] = s.coating.layers
        before = float(s.n_d)
    return found


def _blades(lens: Lens) -> str:
    """Return the table of the stop's blades; a mask is refused, because a lens file has no form for it."""
    if lens.aperture is None:
        return ""
    if lens.aperture.blades is None:
        raise InputError(lens.path, "aperture", "(a mask)", "blades, or a round stop: masks are no part of lens files")
    blades, *more = (getattr(lens.aperture, key) for key in APERTURE_KEYS)
    values = zip(APERTURE_KEYS, (blades, *map(float, more)), strict=True)
    return "\n[aperture]\n" + "".join(f"{key} = {format_value(v)}\n" for key, v in values)


def _rows(lens: Lens) -> str:
    """Return one inline table per surface, with keys in columns; a column that no surface uses is left out."""
    cells = [_cells(s) for s in lens.surfaces]
    if lens.film_z_mm is not None:
        cells[-1]["thickness_mm"] = repr(float(lens.film_z_mm) - float(lens.vertices_mm[-2]))
    widths = {key: max(len(row.get(key, "")) for row in cells) for key in COLUMNS}
    text = ""
    for row in cells:
        parts = (f"{key} = {row[key].rjust(widths.get(key, 0))}" for key in SURFACE_KEYS if key in row)
        text += "  { " + ", ".join(parts) + " },\n"
    return text


def _cells(s: Surface) -> dict[str, str]:
    """Return the texts of a surface's figures by key, without those that say nothing."""
    bare = float(s.n_d) == 1 and s.V_d is None and s.material is None and not s.absorption_per_mm
    values: dict[str, Any] = {
        **{key: float(getattr(s, key)) for key in ("radius_mm", "thickness_mm", "diameter_mm")},
        "n_d": None if bare else float(s.n_d),
        "V_d": None if s.V_d is None else float(s.V_d),
        **s.figure.cells(),
        **s.placement.record(),
        "absorption_per_mm": s.absorption_per_mm or None,
        "coating": s.coating.name if s.coating and s.coating.origin != "assumed" else None,
        "stop": s.stop or None,
        **{key: getattr(s, key) for key in ("glass", "material")},
    }
    return {key: format_value(value) for key, value in values.items() if value is not None}


def _wrapped(text: str) -> str:
    """Return a text in short lines. TOML drops a backslash at the end of a line and the blanks that follow."""
    if len(text) <= WRAP:
        return format_value(text)
    lines: list[str] = []
    for word in re.split(r"(?<= )(?=\S)", text):
        if lines and len(lines[-1]) + len(word.split(" ", 1)[0]) <= WRAP:
            lines[-1] += word
        else:
            lines.append(word)
    return '"""\\\n' + "\\\n".join(format_value(line)[1:-1] for line in lines) + '"""'
