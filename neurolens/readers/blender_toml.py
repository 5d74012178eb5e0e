"""TOML files of lens cameras for Blender ("Physical Camera"): tables `lens` and `focus`, and a `surface` each.

Figures are in mm: radius (0 a plane), thickness, ior behind, aperture (full clear diameter), abbe_v (0 unknown); type
is spherical or flat where it is missing, "stop", "aspheric" (conic, aspheric_coeffs of r^4, r^6, ...), "cylindrical_x"
(bent along x) or "cylindrical_y". `focus` has the distance of a near object, and thicknesses there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens, Surface
from neurolens.readers.draft import Draft, Given, Row, State, lens_of
from neurolens.readers.source import MAX_SURFACES, Table

_LENS = ("name", "patent", "focal_length", "max_fstop", "coating", "squeeze", "image_circle", "sensor_width")
_SURFACE = ("type", "radius", "thickness", "ior", "aperture", "abbe_v", "conic", "aspheric_coeffs")
_TYPES = ("spherical", "flat", "stop", "aspheric", "cylindrical_x", "cylindrical_y")


def is_blender(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are those of such a lens."""
    return "schema" not in data and isinstance(data.get("surface"), list) and isinstance(data.get("lens"), Mapping)


def read_blender(data: Mapping[str, Any], file: str, given: Given | None = None) -> Lens:
    """The lens of such a file.

    Raises:
        InputError: a key or type that is not of the format, a figure out of range.
    """
    top = Table(data, file)
    top.only(("lens", "surface", "focus"))
    head, rows = Table(data["lens"], file, "lens, "), data["surface"]
    head.only(_LENS)
    if len(rows) > MAX_SURFACES:
        raise top.error("surface", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    surfaces = []
    for k, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise top.error(f"surface {k}", row, "a table")
        surfaces.append(_surface(Table(row, file, f"surface {k}, ")))
    if not surfaces:
        raise top.error("surface", "(none)", "a table for each surface")
    film_given = surfaces[-1].thickness_mm > 0
    draft = Draft(
        file=file,
        kind="Physical Camera",
        rows=tuple(Row(s, aperture=not s.stop) for s in surfaces),
        name=head.text("name", required=False),
        notes=[head.text("patent", required=False)],
        states=_states(top, len(surfaces), film_given),
        f_number=head.optional("max_fstop"),
        film_given=film_given,
        unit="mm",
        rims="estimated",
        stated_efl=head.optional("focal_length"),
        drawn=True,
    )
    return lens_of(draft, given)


def _surface(row: Table) -> Surface:
    row.only(_SURFACE)
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
    """The near focus state, where there is one, after that at infinity."""
    if "focus" not in top:
        return ()
    if not isinstance(top.data["focus"], Mapping):
        raise top.error("focus", top.data["focus"], "a table")
    focus = Table(top.data["focus"], top.file, "focus, ")
    focus.only(("close_distance", "variable"))
    moved: dict[int, float] = {}
    for row in focus.data.get("variable", []):
        if not isinstance(row, Mapping):
            raise focus.error("variable", row, "a table")
        table = Table(row, top.file, "focus.variable, ")
        table.only(("surface", "thickness_close"))
        k = table.number("surface")
        if k not in range(count):
            raise table.error("surface", k, f"a surface number from 0 to {count - 1}")
        moved[int(k)] = table.number("thickness_close", unit="mm")
    if not moved:
        raise InputError(top.file, "focus, variable", "(none)", "the thicknesses of the near state")
    distance = focus.number("close_distance", unit="mm", above=0)
    return (State(f"{distance:g} mm", moved, object_distance=distance, film_given=film_given),)
