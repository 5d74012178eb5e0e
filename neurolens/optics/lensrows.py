"""The rows of a lens file: one surface each, with its glass, shape and coating, read strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import reject_unknown
from neurolens.optics.glass import check_against_table
from neurolens.optics.lensfields import index, number, text
from neurolens.optics.prescription import Coating, Surface

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
