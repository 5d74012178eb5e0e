"""Prescriptions as JSON, in the form that ../shared/data/README.md defines: surfaces with full diameters in mm.

A radius of 0 is a plane, an index of null is air, a last thickness of 0 or null stands for the computed back focus,
`cyl-x` is a cylinder curved along x. Other statements of the file are checked against its table: focal length and back
focus, and the object's distance of every focus state. States marked as interpolated by the transcriber are left out
with a warning. The forms of DeepLens and ISET are read too (`keyed`).
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import check_tree
from neurolens.lens import paraxial
from neurolens.lens.prescription import Configuration, Lens, Surface
from neurolens.readers.assemble import UNKNOWN, finish, first_order
from neurolens.readers.glasses import same_glass
from neurolens.readers.keyed import read_others
from neurolens.readers.source import MAX_SURFACES, ReadOptions, Table, read_text, warn
from neurolens.setting.rims import check_states

KEYS = (
    *("name", "designer", "source", "efl_mm", "f_number", "field_or_image_circle", "notes", "computed_at_nd"),
    *("diameters_estimated", "surfaces", "configurations"),
)
SURFACE_KEYS = (
    *("radius_mm", "thickness_mm", "material", "n_d", "V_d", "diameter_mm", "stop", "conic"),
    *("aspheric_coefficients", "shape"),
)
SHAPES = {"sphere": None, "asphere": None, "cyl-x": "x", "cyl-y": "y"}
# Words in the notes that indicate diameters not from the source, independent of `diameters_estimated`.
_NOT_THE_SOURCE_S = frozenset("trimmed enlarged chosen estimated inferred computed reduced".split())
STATE_KEYS = (
    *("name", "efl_mm", "efl_y_mm", "efl_x_mm", "f_number", "object_distance_mm", "magnification"),
    *("thickness_overrides", "stop_diameter_mm", "interpolated_by_transcriber", "note"),
)
MAX_STATES = 200
DOUBTFUL = 0.05  # relative difference of a stated object distance from the paraxial one that is worth a warning
AGREES = 1e-4  # relative: more than rounding of the printed figures, less than any wrong digit
_NUMBER = r"(?<![0-9.])([0-9]{1,9}(?:\.[0-9]{1,9})?)"  # bounded: a search tries every place


def read_json_lens(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a JSON file, unfocused.

    Args:
        options: name and source that replace those of the file; f-number and half field for a file that states none.

    Warns:
        NeurolensWarning: for everything left out, computed or doubtful.

    Raises:
        InputError: the first mistake met; it names file, surface and field.
    """
    file = str(path)
    options = options or ReadOptions()
    if options.units not in (None, "mm"):
        raise InputError(file, "--units", options.units, "mm, as the keys of the file say (or no --units)")
    data = _load(path)
    other = read_others(data, file, options)
    if other is not None:
        return other
    if options.stop is not None:
        raise InputError(file, "--stop", options.stop, "no such option: this form of JSON marks its stop")
    table = Table(data, file)
    table.only(KEYS)
    rows = data.get("surfaces", "(missing)")
    if not isinstance(rows, list) or not rows or len(rows) > MAX_SURFACES:
        found = f"({len(rows)} of them)" if isinstance(rows, list) else rows
        raise table.error("surfaces", found, f"a list of 1 to {MAX_SURFACES} objects")
    last = len(rows) - 1
    example = "an object with radius_mm, thickness_mm, diameter_mm"
    tables = (table.inner(f"surface {k}", row, SURFACE_KEYS, example) for k, row in enumerate(rows))
    surfaces = tuple(_surface(row, k == last) for k, row in enumerate(tables))
    notes, estimated = table.text("notes", required=False), table.flag("diameters_estimated")
    if not estimated and _tells_of_other_diameters(notes):
        warn(file, "the notes tell of diameters that are not the source's; rims are taken as estimated")
        estimated = True
    stated = table.optional("f_number")
    lens = Lens(
        name=options.name or table.text("name"),
        source=options.source or table.text("source"),
        surfaces=surfaces,
        f_number=stated or options.f_number or math.nan,
        designer=_optional_text(table, "designer"),
        notes=notes,
        rims="estimated" if estimated else "source",
        path=file,
        **image_and_field(data, file),
    )
    if lens.half_field_deg is None and options.half_field_deg is not None:
        lens = replace(lens, half_field_deg=options.half_field_deg)
    lens = finish(lens, film_given=bool(surfaces[-1].thickness_mm))
    lens = stated_efl(lens, data)
    check_computed(lens, data)
    return read_states(lens, data)


def _tells_of_other_diameters(notes: str) -> bool:
    """Test whether a clause has "diameter" and after it one of the words."""
    clauses = (clause.partition("diameter")[2] for clause in re.split("[.;]", notes.lower()))
    return any(not _NOT_THE_SOURCE_S.isdisjoint(re.findall(r"\w+", rest)) for rest in clauses)


def looks_like_json(head: str) -> bool:
    """Test whether the beginning of a text is that of a JSON object."""
    return head.lstrip().startswith("{")


def _load(path: str | Path) -> dict[str, Any]:
    """Return the top-level object; what JSON itself forbids (NaN) or leaves open (a key twice) is an error."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            counts = Counter(key for key, _ in pairs)
            twice = next(key for key, count in counts.items() if count > 1)
            raise InputError(path, twice, "(given twice)", "each key once")
        return found

    endless: list[str] = []

    def refuse(word: str) -> float:
        endless.append(word)
        return math.nan

    try:
        data = json.loads(read_text(path), object_pairs_hook=once, parse_constant=refuse)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(path, "file", f"({error})", "valid JSON") from None
    check_tree(data, path)
    if not isinstance(data, dict):
        raise InputError(path, "file", f"(a {type(data).__name__})", "a JSON object with the key surfaces")
    if "surfaces" not in data:
        raise InputError(path, "format", "(not known: JSON without the key surfaces)", "our own, DeepLens's or ISET's")
    if endless:
        raise InputError(path, "file", endless[0], "finite numbers")
    return data


def _surface(row: Table, is_last: bool) -> Surface:
    given, radius = row.data, row.number("radius_mm", unit="mm, 0 for a plane")
    thickness = 0.0 if is_last and given.get("thickness_mm") is None else row.number("thickness_mm")
    if given.get("diameter_mm") is None and not given.get("stop"):
        raise row.error("diameter_mm", "(null)", "the full clear diameter in mm")
    diameter = UNKNOWN if given.get("diameter_mm") is None else row.number("diameter_mm", above=0)
    stop, shape = row.flag("stop"), given.get("shape", "sphere")
    if not isinstance(shape, str) or shape not in SHAPES:
        raise row.error("shape", shape, f"one of {', '.join(SHAPES)}")
    key = "aspheric_coefficients"
    terms = row.powers(key, 'an object such as {"4": 1e-6}') if given.get(key) else ()
    return Surface(
        radius_mm=radius or math.inf,
        thickness_mm=thickness,
        diameter_mm=diameter,
        stop=stop,
        conic=row.optional("conic", above=None) or 0.0,
        asphere=tuple((p, a) for p, a in terms if a),
        cylinder=SHAPES[shape],
        **_glass(row),
    )


def _glass(row: Table) -> dict[str, Any]:
    """Read a glass; it is that of the catalogue where the named one has the same figures."""
    if row.data.get("n_d") is None:
        for key in ("V_d", "material"):
            if row.data.get(key) not in (None, "air"):
                raise row.error("n_d", "(null)", f"the index of the glass, as {key} is given")
        return {}
    n_d = row.number("n_d", above=0)
    V_d = row.optional("V_d")
    material = _optional_text(row, "material") or None
    return {"n_d": n_d, "V_d": V_d, "material": material, "glass": same_glass(material, n_d, V_d)}


def _optional_text(table: Table, key: str) -> str:
    return "" if table.data.get(key) is None else table.text(key, required=False)


def stated_efl(lens: Lens, data: Mapping[str, Any]) -> Lens:
    """Return the lens with the focal length stated: of several, an anamorphic lens's by meridian, else the first (the
    table's).
    """
    given = data.get("efl_mm")
    values = [given] if not isinstance(given, list) else given
    for value in values:
        real = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
        if value is not None and not real:
            raise InputError(lens.path, "efl_mm", given, "a number above 0 in mm, a list of them, or null")
    if not values or values[0] is None:
        return lens
    if lens.anamorphic and len(values) == 2:
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
    """`image_radius_mm` and `half_field_deg` from the free text of `field_or_image_circle`, if unambiguous.

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


def read_states(lens: Lens, data: Mapping[str, Any]) -> Lens:
    """Return the lens with the states of the file, checked."""
    states: list[Configuration] = []
    for place, given in enumerate(_tables(data, lens.path)):
        expected = "an object with thickness_overrides"
        table = Table(data, lens.path).inner(f"configuration {place}", given, STATE_KEYS, expected)
        name = table.text("name")
        if given.get("interpolated_by_transcriber"):
            warn(lens.path, f'configuration "{name}" is left out: interpolated by the transcriber, not from the source')
            continue
        if name in [c.name for c in states]:
            raise table.error("name", name, "a name that no other configuration has")
        states.append(_state(lens, replace(table, where=f'configuration "{name}", '), name))
    whole = replace(lens, configurations=tuple(states))
    check_states(whole)
    return whole


def _tables(data: Mapping[str, Any], file: str) -> list[Any]:
    given = data.get("configurations")
    if isinstance(given, Mapping):
        Table(given, file, "configurations, ").only(("configs",))
        given = given.get("configs")
    tables = [] if given is None else given
    if not isinstance(tables, list) or len(tables) > MAX_STATES:
        raise InputError(file, "configurations", given, f"null or a list of at most {MAX_STATES} states")
    return tables


def _state(lens: Lens, table: Table, name: str) -> Configuration:
    """One state; what the source leaves open (focal length, object distance) follows from its thicknesses."""
    efl, efl_y = table.optional("efl_mm"), table.optional("efl_y_mm")
    efl, distance = efl_y if efl is None else efl, table.data.get("object_distance_mm")
    sizes = {key: table.optional(key) for key in ("f_number", "stop_diameter_mm")}
    gaps = table.gaps("thickness_overrides", len(lens.surfaces), 'an object such as {"5": 26.15}')
    state = Configuration(name, efl, tuple(sorted(gaps)), **sizes)
    table_lens = lens.with_gaps(dict(state.thickness_mm))
    data = first_order(table_lens)  # of the object in focus on the tabled film, by Newton's x x' = -f f'
    beyond = float(table_lens.vertices_mm[-1]) - data.rear_focal_z_mm
    paraxial_mm = data.efl_mm * data.front_efl_mm / beyond - data.front_focal_z_mm if beyond else math.inf
    if isinstance(distance, str):
        if not (math.isfinite(paraxial_mm) and paraxial_mm > 0):
            raise table.error("object_distance_mm", distance, "a distance in mm, or null")
        place = f"{table.where}object_distance_mm {distance!r}"
        warn(lens.path, f"{place}: {paraxial_mm:.6g} mm follows from the thicknesses")
        return replace(state, object_distance_mm=paraxial_mm)
    if distance is not None:
        stated = table.number("object_distance_mm", unit="mm", above=0)
        if not abs(paraxial_mm / stated - 1) <= DOUBTFUL:
            focused = f"{stated:g} is stated; the thicknesses focus {paraxial_mm:.6g}"
            warn(lens.path, f"{table.where}object_distance_mm {focused}")
        return replace(state, object_distance_mm=stated)
    return state if efl is not None else replace(state, efl_mm=data.efl_mm)
