"""Prescriptions with named figures, in millimetres: JSON of ours, of DeepLens and of ISET, TOML of "Physical Camera".

Ours is the form that ../shared/data/README.md defines: surfaces have full diameters, a radius of 0 is a plane, an index
of null is air, a last thickness of 0 or null stands for the computed back focus, `cyl-x` is a cylinder curved along x.
What else the file states is checked against its table: focal length and back focus, and the object's distance in every
focus state. States that the transcriber marked as interpolated are left out with a warning.

DeepLens (differentiable design): surfaces of type Spheric, Aspheric, Stop or Aperture with `r` (semi-diameter), `roc`
or else `c` (curvature), `d_next` (thickness), `mat2` (medium behind: a name, or "n_d/V_d"), `k` and `ai` (sag a_1 r^2 +
a_2 r^4 + ...); keys in brackets repeat others. ISET (pbrt lenses of a camera simulator): `radius` (0 is a plane),
`thickness`, `ior` (one index; 0 marks the stop), `semi_aperture`.

Physical Camera (for Blender): tables `lens` and `focus`, and a `surface` each with radius (0 is a plane), thickness,
ior behind, aperture (full clear diameter) and abbe_v (0 is unknown). The type is spherical or flat if it is missing;
else it is "stop", "aspheric" (conic, aspheric_coeffs of r^4, r^6, ...), "cylindrical_x" (bent along x) or
"cylindrical_y". `focus` has the distance of a near object, and thicknesses there.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import parse_json
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.figures import Figure, figure_of
from neurolens.optics.lens.prescription import Configuration, Lens, MediumFields, Surface
from neurolens.optics.readers.assemble import finish, first_order, lens_of
from neurolens.optics.readers.draft import MAX_STATES, UNKNOWN, Draft, Row, ShapeFields, State
from neurolens.optics.readers.glasses import named_glass, same_glass
from neurolens.optics.readers.source import MAX_SURFACES, ReadOptions, Table, read_text, warn
from neurolens.optics.setting.rims import check_states

KEYS = (
    *("name", "designer", "source", "efl_mm", "f_number", "field_or_image_circle", "notes", "computed_at_nd"),
    *("diameters_estimated", "surfaces", "configurations"),
)
SURFACE_KEYS = (
    *("radius_mm", "thickness_mm", "material", "n_d", "V_d", "diameter_mm", "stop", "conic"),
    *("aspheric_coefficients", "shape"),
)
SHAPES = {"sphere": None, "asphere": None, "cyl-x": "x", "cyl-y": "y"}
# Words in notes by which diameters are not the source's, whatever `diameters_estimated` says.
_NOT_THE_SOURCE_S = frozenset("trimmed enlarged chosen estimated inferred computed reduced".split())
STATE_KEYS = (
    *("name", "efl_mm", "efl_y_mm", "efl_x_mm", "f_number", "object_distance_mm", "magnification"),
    *("thickness_overrides", "stop_diameter_mm", "interpolated_by_transcriber", "note"),
)
DOUBTFUL = 0.05  # relative difference between a stated object distance and the paraxial one that is worth a warning
AGREES = 1e-4  # relative: more than rounding of the printed figures, less than any wrong digit
_NUMBER = r"(?<![0-9.])([0-9]{1,9}(?:\.[0-9]{1,9})?)"  # bounded, because a search tries every place
_DEEPLENS = (
    *("info", "foclen", "fnum", "r_sensor", "d_sensor", "sensor_size", "sensor_res", "hfov", "fov", "float_hfov"),
    *("float_foclen", "float_rfov", "rfov", "surfaces", "r_last"),
)
_DEEPLENS_SURFACE = (
    *("idx", "type", "r", "c", "roc", "d", "d_next", "mat1", "mat2", "k", "ai", "is_square", "diffraction", "use_ai2"),
)
_MEDIUM = ("n_d", "V_d", "material", "glass")
_STOPS, _AIR = ("Stop", "Aperture"), ("air", "vacuum", "occluder")
_ISET = ("name", "description", "type", "surfaces", "microlens")
_ISET_SURFACE = ("radius", "thickness", "ior", "semi_aperture", "conic_constant")
_LENS = ("name", "patent", "focal_length", "max_fstop", "coating", "squeeze", "image_circle", "sensor_width")
_SURFACE = ("type", "radius", "thickness", "ior", "aperture", "abbe_v", "conic", "aspheric_coeffs")
_TYPES = ("spherical", "flat", "stop", "aspheric", "cylindrical_x", "cylindrical_y")


def read_json_lens(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a JSON file, unfocused.

    Args:
        options: name and source replace the file's; f-number and half field are for a file that states none.

    Warns:
        NeurolensWarning: something was left out, computed, or is doubtful.

    Raises:
        InputError: the first mistake; names file, surface and field.
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
    rows = data["surfaces"]
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
        designer=table.text("designer", required=False),
        notes=notes,
        rims="estimated" if estimated else "source",
        path=file,
        **image_and_field(data, file),
    )
    lens = replace(lens, half_field_deg=lens.half_field_deg or options.half_field_deg)
    lens = finish(lens, film_given=bool(surfaces[-1].thickness_mm))
    lens = stated_efl(lens, data)
    check_computed(lens, data)
    return read_states(lens, data)


def _tells_of_other_diameters(notes: str) -> bool:
    """Return whether a clause has "diameter" and after it one of `_NOT_THE_SOURCE_S`."""
    clauses = (clause.partition("diameter")[2] for clause in re.split("[.;]", notes.lower()))
    return any(not _NOT_THE_SOURCE_S.isdisjoint(re.findall(r"\w+", rest)) for rest in clauses)


def _load(path: str | Path) -> dict[str, Any]:
    """Return the top-level object of a file."""
    try:
        data = parse_json(read_text(path), path)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(path, "file", f"({error})", "valid JSON, none of ray-optics or Optiland") from None
    if not isinstance(data, dict):
        raise InputError(path, "file", f"(a {type(data).__name__})", "a JSON object with the key surfaces")
    if "surfaces" not in data:
        raise InputError(path, "format", "(not known: JSON without the key surfaces)", "our own, DeepLens's or ISET's")
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
    figure = {"conic": row.optional("conic", above=None) or 0.0, "asphere": [(p, a) for p, a in terms if a]}
    return Surface(
        radius_mm=radius or math.inf,
        thickness_mm=thickness,
        diameter_mm=diameter,
        stop=stop,
        figure=figure_of(figure | {"cylinder": SHAPES[shape]}),
        **_glass(row),
    )


def _glass(row: Table) -> MediumFields:
    """Read a glass; it becomes the catalogue's where the named glass has the same figures."""
    if row.data.get("n_d") is None:
        for key in ("V_d", "material"):
            if row.data.get(key) not in (None, "air"):
                raise row.error("n_d", "(null)", f"the index of the glass, as {key} is given")
        return {}
    n_d = row.number("n_d", above=0)
    V_d = row.optional("V_d")
    material = row.text("material", required=False) or None
    return {"n_d": n_d, "V_d": V_d, "material": material, "glass": same_glass(material, n_d, V_d)}


def stated_efl(lens: Lens, data: Mapping[str, Any]) -> Lens:
    """Return the lens with the focal length that its file states.

    The two focal lengths of an anamorphic lens are those of its meridians. Of several others the first is taken, which
    is that of the table.
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
    """Read `image_radius_mm` and `half_field_deg` from the free text of `field_or_image_circle`, if it is unambiguous.

    It understands "image radius 21.6 mm", "image circle 43.2 mm", "38 deg half field", "+-20 deg", "180 deg full
    field", "AOV 45.2 deg" (full; the first of several), and the keys fullFieldDeg and imageCircleMm. Else it warns.
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
    """Return one state; focal length and object distance, where the source gives none, follow from its thicknesses."""
    efl, efl_y = table.optional("efl_mm"), table.optional("efl_y_mm")
    efl, distance = efl_y if efl is None else efl, table.data.get("object_distance_mm")
    sizes = {key: table.optional(key) for key in ("f_number", "stop_diameter_mm")}
    gaps = table.gaps("thickness_overrides", len(lens.surfaces), 'an object such as {"5": 26.15}')
    state = Configuration(name, efl, tuple(sorted(gaps)), **sizes)
    table_lens = lens.with_gaps(dict(state.thickness_mm))
    data = first_order(table_lens)  # distance of the object that the tabled film focuses, by Newton's x x' = -f f'
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


def read_others(data: Mapping[str, Any], file: str, options: ReadOptions) -> Lens | None:
    """Return the lens of a JSON object of DeepLens or ISET; None where it is neither.

    Warns:
        NeurolensWarning: a stated focal length differs from that of the surfaces by more than 1%.

    Raises:
        InputError: a kind of surface is unknown, a key would be ignored, or a figure is out of range.
    """
    rows = data["surfaces"]
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Mapping) for row in rows):
        return None
    if all("d_next" in row for row in rows):
        draft = _deeplens(data, rows, file)
    elif all("semi_aperture" in row for row in rows):
        draft = _iset(data, rows, file)
    else:
        return None
    lens = lens_of(draft, options)
    if "foclen" in data:
        stated, found = Table(data, file).number("foclen"), first_order(lens).efl_mm
        if abs(found - stated) > 0.01 * abs(stated):
            warn(file, f"foclen says {stated:.5g} mm, the first order of its surfaces {found:.5g} mm")
    return lens


def _deeplens(data: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], file: str) -> Draft:
    if "DOE" in data:
        raise InputError(file, "DOE", "(given)", "a lens without a diffractive element: the lens model has none")
    skipped, surfaces = Counter({key: not _repeats(key) for key in data.keys() - set(_DEEPLENS)}), list[Surface]()
    for k, row in enumerate(rows):
        before = surfaces[-1] if surfaces else None
        surfaces.append(_deeplens_surface(Table(row, file, f"surface {k}, "), before, skipped))
    radius = Table(data, file).number("r_sensor", above=0) if "r_sensor" in data else None
    return _draft_of(file, "DeepLens", surfaces, _line(data.get("info")), image_radius=radius, skipped=skipped)


def _draft_of(file: str, kind: str, surfaces: Sequence[Surface], name: str, **more: Any) -> Draft:
    """Return the draft of a table in mm; where the last thickness is 0, its film is in the paraxial focus."""
    rows = tuple(Row(s, aperture=not s.stop or not more.get("drawn")) for s in surfaces)
    return Draft(file, kind, rows, name, film_given=surfaces[-1].thickness_mm > 0, unit="mm", **more)


def _deeplens_surface(row: Table, before: Surface | None, skipped: Counter[str]) -> Surface:
    """Return one surface; unknown keys go to `skipped`. A stop without `mat2` stands in the medium before it."""
    given, kind, stop = row.data, row.data.get("type"), row.data.get("type") in _STOPS
    if kind not in ("Spheric", "Aspheric", *_STOPS):
        raise row.error("type", kind, "Spheric, Aspheric, Stop or Aperture")
    for key in given.keys() - set(_DEEPLENS_SURFACE):
        # ai2, ai4, ... repeat the list ai.
        skipped[key] += not (_repeats(key) or (key[:2] == "ai" and key[2:].isdecimal() and "ai" in given))
    shape: ShapeFields = {}
    if kind == "Aspheric":
        shape = {"conic": row.number("k") if "k" in row else 0.0, "asphere": row.series("ai", 2)}
    return Surface(
        radius_mm=math.inf if stop else _radius_mm(row),
        thickness_mm=row.number("d_next", unit="mm"),
        diameter_mm=2 * row.number("r", unit="mm", above=0),
        stop=stop,
        figure=figure_of(shape),
        **(_medium(row) if "mat2" in row or not stop else {key: getattr(before, key) for key in _MEDIUM if before}),
    )


def _radius_mm(row: Table) -> float:
    """Return the radius: where both are there `roc` has more digits than `c`; 0 is a plane in both."""
    if "roc" in row:
        return row.number("roc", unit="mm", finite=False) or math.inf
    c = row.number("c", unit="1/mm")
    return 1 / c if c else math.inf


def _medium(row: Table) -> MediumFields:
    name = row.data.get("mat2")
    if not isinstance(name, str):
        raise row.error("mat2", name, 'a glass, "n_d/V_d" or "air"')
    if name.lower() in _AIR:
        return {}
    index, slash, abbe = name.partition("/")
    if not slash:
        return named_glass(name, row.file, f"{row.where}mat2")
    try:
        return {"n_d": float(index), "V_d": float(abbe)}
    except ValueError:
        raise row.error("mat2", name, 'two numbers, "n_d/V_d"') from None


def _iset(data: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], file: str) -> Draft:
    top = Table(data, file)
    top.only(_ISET)
    if data.get("microlens"):
        raise InputError(file, "microlens", "(given)", "a lens without microlenses")
    surfaces = []
    for k, given in enumerate(rows):
        row = top.inner(f"surface {k}", given, _ISET_SURFACE)
        ior = row.number("ior")
        surface = Surface(
            radius_mm=row.number("radius", unit="mm, 0 for a plane") or math.inf,
            thickness_mm=row.number("thickness", unit="mm"),
            diameter_mm=2 * row.number("semi_aperture", unit="mm", above=0),
            n_d=ior or 1.0,  # the stop stands in air
            stop=ior == 0,
            figure=Figure(row.number("conic_constant") if "conic_constant" in row else 0.0),
        )
        surfaces.append(surface)
    return _draft_of(file, "ISET", surfaces, _line(data.get("name")), notes=[_line(data.get("description"))])


def _repeats(key: str) -> bool:
    """Return whether a key is in brackets, and so repeats other keys."""
    return key.startswith("(") and key.endswith(")")


def _line(text: Any) -> str:
    return " ".join(text.split()) if isinstance(text, str) and text != "None" else ""


def is_blender(data: Mapping[str, Any]) -> bool:
    """Return whether the tables of a TOML file are a lens of Physical Camera."""
    return "schema" not in data and isinstance(data.get("surface"), list) and isinstance(data.get("lens"), Mapping)


def read_blender(data: Mapping[str, Any], file: str, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a TOML file of Physical Camera.

    Raises:
        InputError: a key or a type is not of the format, or a figure is out of range.
    """
    top = Table(data, file)
    top.only(("lens", "surface", "focus"))
    head = top.inner("lens", data["lens"], _LENS)
    surfaces = [_blender_surface(top.inner(f"surface {k}", row, _SURFACE)) for k, row in enumerate(data["surface"])]
    if not surfaces:
        raise top.error("surface", "(none)", "a table for each surface")
    name, notes = head.text("name", required=False), [head.text("patent", required=False)]
    draft = _draft_of(file, "Physical Camera", surfaces, name, notes=notes, rims="estimated", drawn=True)
    draft.f_number, draft.stated_efl = head.optional("max_fstop"), head.optional("focal_length")
    draft.states = _states(top, len(surfaces), draft.film_given)
    return lens_of(draft, options)


def _blender_surface(row: Table) -> Surface:
    kind = row.text("type", required=False) or "spherical"
    if kind not in _TYPES:
        raise row.error("type", kind, f"one of {', '.join(_TYPES)}")
    shape: ShapeFields = {}
    if kind == "aspheric":
        conic = row.number("conic") if "conic" in row else 0.0
        shape = {"conic": conic, "asphere": row.series("aspheric_coeffs", 4)}
    elif "aspheric_coeffs" in row or "conic" in row:
        raise row.error("type", kind, "aspheric, as there are coefficients")
    radius = math.inf if kind in ("stop", "flat") else row.number("radius", unit="mm, 0 for a plane") or math.inf
    if kind.startswith("cylindrical") and not math.isinf(radius):
        shape["cylinder"] = kind[-1]
    index, abbe = row.number("ior"), row.number("abbe_v") if "abbe_v" in row else 0.0
    return Surface(
        radius_mm=radius,
        thickness_mm=row.number("thickness", unit="mm"),
        diameter_mm=row.number("aperture", unit="mm", above=0),
        n_d=index,
        V_d=abbe if index != 1 and abbe > 0 else None,
        stop=kind == "stop",
        figure=figure_of(shape),
    )


def _states(top: Table, count: int, film_given: bool) -> tuple[State, ...]:
    """Return the near focus state, where there is one, behind that at infinity."""
    if "focus" not in top:
        return ()
    focus = top.inner("focus", top.data["focus"], ("close_distance", "variable"))
    moved: dict[int, float] = {}
    for row in focus.data.get("variable", []):
        table = focus.inner("variable", row, ("surface", "thickness_close"))
        k = table.number("surface")
        if k not in range(count):
            raise table.error("surface", k, f"a surface number from 0 to {count - 1}")
        moved[int(k)] = table.number("thickness_close", unit="mm")
    if not moved:
        raise InputError(top.file, "focus, variable", "(none)", "the thicknesses of the near state")
    distance = focus.number("close_distance", unit="mm", above=0)
    return (State(f"{distance:g} mm", moved, object_distance=distance, film_given=film_given),)
