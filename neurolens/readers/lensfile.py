"""Reads lens files, strictly: one prescription in a TOML file. `lenswriter` writes them.

docs/pages/reference/lens-file.md describes the format: every key with its unit, default and limits, and an example.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neurolens.base.bounds import WAVELENGTH_NM, said, within
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.tomlfile import read_toml, reject_unknown
from neurolens.lens import catalogue, designs
from neurolens.lens.apertures import Aperture
from neurolens.lens.glass import by_figures, check_against_table, index_at
from neurolens.lens.prescription import Coating, Configuration, Lens, Medium, Surface
from neurolens.setting.rims import check_states, with_derived_rims

SCHEMA = 1
MAX_SURFACES = 500
MAX_TERMS = 1000  # aspheric coefficients of all surfaces: each costs every ray a step, and lenses have at most 400
MAX_LAYERS = 200
_LONGEST_NM = 780.0  # of visible light
FILM_KEYS = ("index", "thickness_nm", "V_d")
MAX_POWER = 40
LARGEST = 1e15  # of any figure but a radius
MAX_INDEX = 4.5  # germanium, the densest lens material there is, has 4.0
RIMS = ("source", "estimated", "derived")
LENS_KEYS = (
    *("schema", "name", "designer", "source", "f_number", "efl_mm", "efl_x_mm", "image_radius_mm", "half_field_deg"),
    *("rims", "notes", "surfaces", "coating", "configuration", "aperture", "object_medium", "wavelengths_nm"),
)
MEDIUM_KEYS = ("n_d", "V_d", "glass", "material")
MAX_WAVELENGTHS = 100
SURFACE_KEYS = (
    *("radius_mm", "thickness_mm", "diameter_mm", "n_d", "V_d", "glass", "material", "stop", "conic", "asphere"),
    *("cylinder", "across_mm", "across_conic", "focal_mm", "absorption_per_mm", "coating"),
)
CONFIGURATION_KEYS = (
    *("name", "efl_mm", "half_field_deg", "thickness_mm", "f_number", "stop_diameter_mm", "object_distance_mm"),
)


@dataclass(frozen=True)
class Table:
    """One table of a file, read strictly.

    Attributes:
        where: goes in front of the key in errors, with its separator: "surface 3, ".
    """

    data: Mapping[str, Any]
    file: str
    where: str = ""

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def error(self, key: str, value: object, expected: str) -> InputError:
        return InputError(self.file, self.where + key, value, expected)

    def only(self, known: Sequence[str]) -> None:
        """Raise for a key that is not known."""
        reject_unknown(self.file, self.where, self.data, known)

    def number(self, key: str, *, unit: str = "", above: float | None = None, finite: bool = True) -> float:
        """A number: an integer or a float, never a bool, a text or NaN."""
        value = self.data.get(key, "(missing)")
        expected = "a finite number" if finite else "a number"
        expected += (f" above {above:g}" if above is not None else "") + (f" in {unit}" if unit else "")
        try:
            found = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
        except OverflowError:
            found = math.nan
        expected += f", at most {LARGEST:g}" if finite and LARGEST < abs(found) < math.inf else ""
        if math.isnan(found) or (finite and not abs(found) <= LARGEST) or (above is not None and not found > above):
            raise self.error(key, value, expected)
        return found

    def optional(self, key: str, *, above: float | None = 0.0) -> float | None:
        """The number, above 0 unless said otherwise; None where it is absent or null."""
        return None if self.data.get(key) is None else self.number(key, above=above)

    def gaps(self, key: str, n_surfaces: int, expected: str) -> tuple[tuple[int, float], ...]:
        """Thicknesses in mm by surface number."""
        given = self.data.get(key, "(missing)")
        if not isinstance(given, Mapping):
            raise self.error(key, given, expected)
        found = []
        for place in given:
            if place not in map(str, range(n_surfaces)):
                raise self.error(key, place, f"a surface number from 0 to {n_surfaces - 1}")
            found.append((int(place), Table(given, self.file, f"{self.where}{key}, surface ").number(place, unit="mm")))
        return tuple(found)

    def text(self, key: str, *, required: bool = True) -> str:
        """A text; an empty one where a text that is not required is absent."""
        if key not in self.data and not required:
            return ""
        value = self.data.get(key, "(missing)")
        if key not in self.data or not isinstance(value, str) or (required and not value.strip()):
            raise self.error(key, value, "a text")
        return value

    def flag(self, key: str) -> bool:
        """True or false; false where it is absent."""
        value = self.data.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, value, "true or false")
        return value

    def half_field(self) -> float | None:
        """The optional `half_field_deg`."""
        if "half_field_deg" not in self.data:
            return None
        angle = self.number("half_field_deg", unit="degrees", above=0)
        if angle >= 180:
            raise self.error("half_field_deg", angle, "an angle from the axis, below 180 degrees")
        return angle


def read_lens(path: str | Path, data: Mapping[str, Any] | None = None) -> Lens:
    """The lens of a file in our own format, unfocused (`set_lens` places the film); `data`: its tables, where known.

    Warns:
        NeurolensWarning: glasses whose V_d is unknown; their index is taken as constant. A coating that no surface has.

    Raises:
        InputError: the first mistake met: an unknown or missing key, a wrong type, a value out of range, no stop or
            two, surfaces that overlap inside their rims in any zoom state. It names file, surface and field.
    """
    data, file = read_toml(path) if data is None else data, str(path)
    table = Table(data, file)
    table.only(LENS_KEYS)
    if data.get("schema") != SCHEMA or isinstance(data["schema"], bool):
        raise table.error("schema", data.get("schema", "(missing)"), f"{SCHEMA}, the version of the format")
    medium = _object_medium(table)
    surfaces = _surfaces(table, medium)
    if data.get("rims", "(missing)") not in RIMS:
        expected = 'where the diameters come from: "source", "estimated" or "derived"'
        raise table.error("rims", data.get("rims", "(missing)"), expected)
    lens = Lens(
        name=table.text("name"),
        source=table.text("source"),
        surfaces=surfaces,
        f_number=table.number("f_number", above=0),
        image_radius_mm=table.optional("image_radius_mm"),
        half_field_deg=table.half_field(),
        designer=table.text("designer", required=False),
        notes=table.text("notes", required=False),
        rims=table.text("rims"),
        configurations=_configurations(table, len(surfaces)),
        path=file,
        aperture=_aperture(table),
        stated_efl_mm=table.optional("efl_mm"),
        stated_efl_x_mm=table.optional("efl_x_mm"),
        object_medium=medium,
        wavelengths_nm=_wavelengths(table),
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
    return lens


def _with_rims(lens: Lens, table: Table) -> Lens:
    """The lens with the diameters that its file leaves out."""
    missing = [k for k, s in enumerate(lens.surfaces) if math.isnan(s.diameter_mm)]
    if not missing:
        return lens
    if lens.rims != "derived":
        expected = 'the full clear diameter in mm, or rims = "derived" to have it computed'
        raise table.error(f"surface {missing[0]}, diameter_mm", "(missing)", expected)
    return with_derived_rims(lens)


def _object_medium(table: Table) -> Medium:
    given = table.data.get("object_medium", {})
    if not isinstance(given, Mapping):
        raise table.error("object_medium", given, "a table such as { n_d = 1.333, V_d = 55.8 }")
    row = Table(given, table.file, "object_medium, ")
    row.only(MEDIUM_KEYS)
    return Medium(**_glass(row))


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
    for k, row in enumerate(rows):
        if not isinstance(row, Mapping):
            expected = "a table such as { radius_mm = 50.0, thickness_mm = 5.0, diameter_mm = 20.0 }"
            raise table.error(f"surface {k}", row, expected)
        before = surfaces[-1].n_d if surfaces else in_front.n_d
        surfaces.append(_surface(Table(row, table.file, f"surface {k}, "), before, known))
    stops = [k for k, s in enumerate(surfaces) if s.stop]
    if len(stops) != 1:
        found = f"(stop = true on surfaces {', '.join(map(str, stops))})" if stops else "(no stop)"
        raise table.error("surfaces", found, "exactly one row with stop = true")
    if (terms := sum(len(s.asphere) for s in surfaces)) > MAX_TERMS:
        raise table.error("surfaces", f"({terms} aspheric coefficients)", f"at most {MAX_TERMS}")
    return tuple(surfaces)


def _surface(row: Table, n_before: float, known: Mapping[str, Coating]) -> Surface:
    row.only(SURFACE_KEYS)
    radius_mm = row.number("radius_mm", unit="mm, inf for a plane", finite=False)
    if radius_mm == 0:
        raise row.error("radius_mm", radius_mm, "a radius that is not 0 (a plane is inf)")
    surface = Surface(
        stop=row.flag("stop"),
        radius_mm=math.inf if math.isinf(radius_mm) else radius_mm,
        thickness_mm=row.number("thickness_mm", unit="mm"),
        diameter_mm=row.number("diameter_mm", unit="mm", above=0) if "diameter_mm" in row else math.nan,
        **_glass(row),
        **_shape(row),
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
    """The medium after the surface; what a catalogue knows need not be in the file."""
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


def _shape(row: Table) -> dict[str, Any]:
    shape: dict[str, Any] = {"conic": row.number("conic")} if "conic" in row else {}
    if "cylinder" in row:
        shape["cylinder"] = row.text("cylinder")
        if shape["cylinder"] not in ("x", "y"):
            raise row.error("cylinder", shape["cylinder"], 'the axis along which it is curved: "x" or "y"')
    shape |= _across(row) | _ideal(row)
    if "asphere" not in row:
        return shape
    given = row.data["asphere"]
    if not isinstance(given, Mapping) or not given:
        raise row.error("asphere", given, "a table such as { 4 = 1e-6, 6 = 2e-9 }")
    terms = []
    for key in given:
        if not (key.isascii() and key.isdecimal() and str(int(key)) == key and 2 <= int(key) <= MAX_POWER):
            raise row.error("asphere", key, f"a power from 2 to {MAX_POWER}")
        if isinstance(given[key], Mapping) and len(given[key]) == 1:  # TOML takes 4.5 for a key in a key
            power = f"{key}.{next(iter(given[key]))}"
            raise row.error("asphere", power, f"a whole power from 2 to {MAX_POWER}")
        terms.append((int(key), Table(given, row.file, f"{row.where}asphere, power ").number(key)))
    return {**shape, "asphere": tuple(sorted(terms))}


def _across(row: Table) -> dict[str, Any]:
    """What bends a toroid or a biconic across its cylinder; an infinite radius leaves a cylinder."""
    for key in (k for k in ("across_mm", "across_conic") if k in row):
        if "cylinder" not in row:
            raise row.error("cylinder", "(missing)", f'the axis of the curve that {key} goes with: "x" or "y"')
    if "across_mm" not in row:
        if "across_conic" in row:
            raise row.error("across_mm", "(missing)", "the radius that across_conic goes with")
        return {}
    radius = row.number("across_mm", unit="mm", finite=False)
    if "across_conic" in row and "asphere" in row:
        raise row.error("asphere", row.data["asphere"], "none: a biconic has no polynomial (a toroid has)")
    if not abs(radius) > 0:
        raise row.error("across_mm", radius, "a radius of curvature other than 0, or inf")
    conic = row.number("across_conic") if "across_conic" in row else None
    return {"across": (radius, conic)} if math.isfinite(radius) else {}


def _ideal(row: Table) -> dict[str, Any]:
    if "focal_mm" not in row:
        return {}
    focal = row.number("focal_mm", unit="mm")
    shaped = [key for key in ("conic", "asphere", "cylinder", "coating") if key in row]
    if shaped or not math.isinf(row.number("radius_mm", finite=False)):
        raise row.error(
            shaped[0] if shaped else "radius_mm",
            row.data.get((shaped or ["radius_mm"])[0]),
            "a plane in air (radius_mm = inf, nothing else), as focal_mm makes it an ideal thin lens",
        )
    if focal == 0:
        raise row.error("focal_mm", focal, "a focal length other than 0")
    return {"focal_mm": focal}


def _coatings(table: Table) -> dict[str, Coating]:
    found: dict[str, Coating] = {}
    for place, given in enumerate(_tables(table, "coating")):
        one = Table(given, table.file, f"coating {place}, ")
        one.only(("name", "layers"))
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


def _tables(table: Table, key: str) -> list[Mapping[str, Any]]:
    tables = table.data.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(t, Mapping) for t in tables):
        raise table.error(key, tables, f"tables under [[{key}]]")
    return tables


def _aperture(table: Table) -> Aperture | None:
    if "aperture" not in table:
        return None
    if not isinstance(table.data["aperture"], Mapping):
        raise table.error("aperture", table.data["aperture"], "a table under [aperture]")
    blades = Table(table.data["aperture"], table.file, "aperture, ")
    blades.only(("blades", "rotation_deg", "curvature"))
    more: dict[str, Any] = {k: blades.number(k) for k in ("rotation_deg", "curvature") if k in blades}
    try:
        return Aperture(blades.data.get("blades"), **more)
    except InputError as error:
        raise blades.error(error.field, error.value, error.expected) from None


def _configurations(lens: Table, n_surfaces: int) -> tuple[Configuration, ...]:
    result: list[Configuration] = []
    for place, given in enumerate(_tables(lens, "configuration")):
        table = Table(given, lens.file, f"configuration {place}, ")
        table.only(CONFIGURATION_KEYS)
        name = table.text("name")
        if name in [c.name for c in result]:
            raise table.error("name", name, "a name that no other configuration has")
        table = replace(table, where=f'configuration "{name}", ')
        thickness = table.gaps("thickness_mm", n_surfaces, "a table such as { 5 = 26.15 }, by surface number")
        above_0 = ("efl_mm", "f_number", "stop_diameter_mm", "object_distance_mm")
        values = {key: table.optional(key) for key in above_0}
        if values["efl_mm"] is None and values["object_distance_mm"] is None:
            raise table.error("efl_mm", "(missing)", "the focal length of a zoom state")
        result.append(Configuration(name, thickness_mm=thickness, half_field_deg=table.half_field(), **values))
    return tuple(result)
