"""Lenses of other programs as JSON and TOML: DeepLens, ISET, and "Physical Camera" for Blender. Millimetres.

DeepLens (differentiable design): surfaces of type Spheric, Aspheric, Stop or Aperture with `r` (semi-diameter), `roc`
or else `c` (curvature), `d_next` (thickness), `mat2` (medium behind: a name, or "n_d/V_d"), `k` and `ai` (sag a_1 r^2 +
a_2 r^4 + ...); keys in brackets repeat others. ISET (pbrt lenses of a camera simulator): `radius` (0 is a plane),
`thickness`, `ior` (one index; 0 marks the stop), `semi_aperture`.

Physical Camera: tables `lens` and `focus`, and a `surface` each with radius (0 a plane), thickness, ior behind,
aperture (full clear diameter), abbe_v (0 unknown); type is spherical or flat where it is missing, "stop", "aspheric"
(conic, aspheric_coeffs of r^4, r^6, ...), "cylindrical_x" (bent along x) or "cylindrical_y". `focus` has the distance
of a near object, and thicknesses there.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens, Surface
from neurolens.readers.assemble import first_order
from neurolens.readers.draft import Draft, Row, State, lens_of
from neurolens.readers.glasses import named_glass
from neurolens.readers.source import ReadOptions, Table, warn

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


def read_others(data: Mapping[str, Any], file: str, options: ReadOptions) -> Lens | None:
    """Return the lens of a JSON object of DeepLens or ISET; None where it is of neither.

    Warns:
        NeurolensWarning: a stated focal length that is not that of the surfaces to 1%.

    Raises:
        InputError: a kind of surface that neurolens does not know, a key it would ignore, a figure out of range.
    """
    draft = _draft(data, file)
    if draft is None:
        return None
    lens = lens_of(draft, options)
    if "foclen" in data:
        stated, found = Table(data, file).number("foclen"), first_order(lens).efl_mm
        if abs(found - stated) > 0.01 * abs(stated):
            warn(file, f"foclen says {stated:.5g} mm, the first order of its surfaces {found:.5g} mm")
    return lens


def _draft(data: Mapping[str, Any], file: str) -> Draft | None:
    rows = data.get("surfaces")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, Mapping) for row in rows):
        return None
    if all("d_next" in row for row in rows):
        return _deeplens(data, rows, file)
    if all("semi_aperture" in row for row in rows):
        return _iset(data, rows, file)
    return None


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
    """The draft of a table in mm, with its film in the paraxial focus where the last thickness is 0."""
    rows = tuple(Row(s, aperture=not s.stop or not more.get("drawn")) for s in surfaces)
    return Draft(file, kind, rows, name, film_given=surfaces[-1].thickness_mm > 0, unit="mm", **more)


def _deeplens_surface(row: Table, before: Surface | None, skipped: Counter[str]) -> Surface:
    """One surface; keys that are not known go to `skipped`. A stop without `mat2` stands in the medium before it."""
    given, kind, stop = row.data, row.data.get("type"), row.data.get("type") in _STOPS
    if kind not in ("Spheric", "Aspheric", *_STOPS):
        raise row.error("type", kind, "Spheric, Aspheric, Stop or Aperture")
    for key in given.keys() - set(_DEEPLENS_SURFACE):
        # ai2, ai4, ... repeat the list ai.
        skipped[key] += not (_repeats(key) or (key[:2] == "ai" and key[2:].isdecimal() and "ai" in given))
    shape: dict[str, Any] = {}
    if kind == "Aspheric":
        shape = {"conic": row.number("k") if "k" in row else 0.0, "asphere": row.series("ai", 2)}
    return Surface(
        radius_mm=math.inf if stop else _radius_mm(row),
        thickness_mm=row.number("d_next", unit="mm"),
        diameter_mm=2 * row.number("r", unit="mm", above=0),
        stop=stop,
        **shape,
        **(_medium(row) if "mat2" in row or not stop else {key: getattr(before, key) for key in _MEDIUM if before}),
    )


def _radius_mm(row: Table) -> float:
    """`roc` has more digits than `c`, where both are there; 0 is a plane in both."""
    if "roc" in row:
        return row.number("roc", unit="mm", finite=False) or math.inf
    c = row.number("c", unit="1/mm")
    return 1 / c if c else math.inf


def _medium(row: Table) -> dict[str, Any]:
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
            conic=row.number("conic_constant") if "conic_constant" in row else 0.0,
        )
        surfaces.append(surface)
    return _draft_of(file, "ISET", surfaces, _line(data.get("name")), notes=[_line(data.get("description"))])


def _repeats(key: str) -> bool:
    """Test whether a key is in brackets: it repeats other keys."""
    return key.startswith("(") and key.endswith(")")


def _line(text: Any) -> str:
    return " ".join(text.split()) if isinstance(text, str) and text != "None" else ""


def is_blender(data: Mapping[str, Any]) -> bool:
    """Test whether the tables of a TOML file are those of such a lens."""
    return "schema" not in data and isinstance(data.get("surface"), list) and isinstance(data.get("lens"), Mapping)


def read_blender(data: Mapping[str, Any], file: str, options: ReadOptions | None = None) -> Lens:
    """Return the lens of such a file.

    Raises:
        InputError: a key or type that is not of the format, a figure out of range.
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
    shape: dict[str, Any] = {}
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
        **shape,
    )


def _states(top: Table, count: int, film_given: bool) -> tuple[State, ...]:
    """Return the near focus state, where there is one, after that at infinity."""
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
