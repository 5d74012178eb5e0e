"""Prescriptions as JSON, in the form that ../shared/data/README.md defines: surfaces with full diameters in mm.

A radius of 0 is a plane, an index of null is air, a last thickness of 0 or null stands for the computed back focus,
`cyl-x` is a cylinder curved along x. States marked as interpolated by the transcriber are left out with a warning. The
forms of DeepLens and ISET are read too (`json_others`).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import reject_unknown
from neurolens.optics.lensfile import MAX_SURFACES, number, text
from neurolens.optics.prescription import Lens, Surface
from neurolens.readers.assemble import UNKNOWN, finish, same_glass
from neurolens.readers.draft import Given
from neurolens.readers.json_others import read_others
from neurolens.readers.json_stated import check_computed, image_and_field, stated_efl
from neurolens.readers.json_states import read_states
from neurolens.readers.source import decode, read_bytes, warn

KEYS = (
    *("name", "designer", "source", "efl_mm", "f_number", "field_or_image_circle", "notes", "computed_at_nd"),
    *("diameters_estimated", "surfaces", "configurations"),
)
SURFACE_KEYS = (
    *("radius_mm", "thickness_mm", "material", "n_d", "V_d", "diameter_mm", "stop", "conic"),
    *("aspheric_coefficients", "shape"),
)
SHAPES = {"sphere": None, "asphere": None, "cyl-x": "x", "cyl-y": "y"}
# Words of the notes that tell of diameters which are not the source's, whatever `diameters_estimated` says.
_NOT_THE_SOURCE_S = re.compile(
    r"diameters?[^.;]*\b(trimmed|enlarged|chosen|estimated|inferred|computed|reduced)\b", re.IGNORECASE
)


def read_json_lens(path: str | Path, given: Given | None = None, *, catalogue: bool = True) -> Lens:
    """The lens of a JSON file, unfocused.

    Args:
        given: name and source that replace those of the file; f-number and half field for a file that states none.
        catalogue: set `Surface.glass` where the named glass is in the catalogue with the same figures; without it the
            figures of the file rule over all colours.

    Warns:
        NeurolensWarning: whatever was left out, computed or doubtful.

    Raises:
        InputError: the first mistake met; it names file, surface and field.
    """
    file = str(path)
    given = given or Given()
    if given.units not in (None, "mm"):
        raise InputError(file, "--units", given.units, "mm, as the keys of the file say (or no --units)")
    data = _load(path)
    other = read_others(data, file, given)
    if other is not None:
        return other
    reject_unknown(file, "", data, KEYS)
    rows = data.get("surfaces", "(missing)")
    if not isinstance(rows, list) or not rows or len(rows) > MAX_SURFACES:
        found = f"({len(rows)} of them)" if isinstance(rows, list) else rows
        raise InputError(file, "surfaces", found, f"a list of 1 to {MAX_SURFACES} objects")
    last = len(rows) - 1
    surfaces = tuple(_surface(row, k, file, is_last=k == last, catalogue=catalogue) for k, row in enumerate(rows))
    notes, estimated = text(data, "notes", file, required=False), data.get("diameters_estimated", False)
    if not isinstance(estimated, bool):
        raise InputError(file, "diameters_estimated", estimated, "true or false")
    if not estimated and _NOT_THE_SOURCE_S.search(notes):
        warn(file, "the notes tell of diameters that are not the source's; rims are taken as estimated")
        estimated = True
    stated = number(data, "f_number", file, above=0) if data.get("f_number") is not None else math.nan
    lens = Lens(
        name=given.name or text(data, "name", file),
        source=given.source or text(data, "source", file),
        surfaces=surfaces,
        f_number=given.f_number if given.f_number is not None and math.isnan(stated) else stated,
        designer=_optional_text(data, "designer", file),
        notes=notes,
        rims="estimated" if estimated else "source",
        path=file,
        **image_and_field(data, file),
    )
    if lens.half_field_deg is None and given.half_field_deg is not None:
        lens = replace(lens, half_field_deg=given.half_field_deg)
    lens = finish(lens, film_given=bool(surfaces[-1].thickness_mm))
    lens = stated_efl(lens, data)
    check_computed(lens, data)
    return read_states(lens, data)


def looks_like_json(head: str) -> bool:
    """Whether the beginning of a text is that of a JSON object."""
    return head.lstrip().startswith("{")


def _load(path: str | Path) -> dict[str, Any]:
    """The top-level object; what JSON itself forbids (NaN) or leaves open (a key twice) is an error."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise InputError(path, twice, "(given twice)", "each key once")
        return found

    def refuse(word: str) -> float:
        raise InputError(path, "file", word, "finite numbers, as JSON has no other")

    try:
        data = json.loads(decode(read_bytes(path), path), object_pairs_hook=once, parse_constant=refuse)
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(path, "file", f"({error})", "valid JSON") from None
    if not isinstance(data, dict):
        raise InputError(path, "file", f"(a {type(data).__name__})", "a JSON object with the key surfaces")
    return data


def _surface(row: Any, k: int, file: str, *, is_last: bool, catalogue: bool) -> Surface:
    where = f"surface {k}, "
    if not isinstance(row, Mapping):
        raise InputError(file, f"surface {k}", row, "an object with radius_mm, thickness_mm, diameter_mm")
    reject_unknown(file, where, row, SURFACE_KEYS)
    radius = number(row, "radius_mm", file, where, unit="mm, 0 for a plane")
    thickness = 0.0 if is_last and row.get("thickness_mm") is None else number(row, "thickness_mm", file, where)
    if row.get("diameter_mm") is None and not row.get("stop"):
        raise InputError(file, f"{where}diameter_mm", "(null)", "the full clear diameter in mm")
    diameter = UNKNOWN if row.get("diameter_mm") is None else number(row, "diameter_mm", file, where, above=0)
    stop, shape = row.get("stop", False), row.get("shape", "sphere")
    if not isinstance(stop, bool):
        raise InputError(file, f"{where}stop", stop, "true or false")
    if not isinstance(shape, str) or shape not in SHAPES:
        raise InputError(file, f"{where}shape", shape, f"one of {', '.join(SHAPES)}")
    conic = number(row, "conic", file, where) if row.get("conic") is not None else 0.0
    return Surface(
        radius_mm=radius or math.inf,
        thickness_mm=thickness,
        diameter_mm=diameter,
        stop=stop,
        conic=conic,
        asphere=_asphere(row, file, where),
        cylinder=SHAPES[shape],
        **_glass(row, file, where, catalogue=catalogue),
    )


def _glass(row: Mapping[str, Any], file: str, where: str, *, catalogue: bool) -> dict[str, Any]:
    if row.get("n_d") is None:
        for key in ("V_d", "material"):
            if row.get(key) not in (None, "air"):
                raise InputError(file, f"{where}n_d", "(null)", f"the index of the glass, as {key} is given")
        return {}
    medium: dict[str, Any] = {"n_d": number(row, "n_d", file, where, above=0)}
    medium["V_d"] = number(row, "V_d", file, where, above=0) if row.get("V_d") is not None else None
    medium["material"] = _optional_text(row, "material", file, where) or None
    if catalogue:
        medium["glass"] = same_glass(medium["material"], medium["n_d"], medium["V_d"])
    return medium


def _asphere(row: Mapping[str, Any], file: str, where: str) -> tuple[tuple[int, float], ...]:
    given = row.get("aspheric_coefficients") or {}
    if not isinstance(given, Mapping):
        raise InputError(file, f"{where}aspheric_coefficients", given, 'an object such as {"4": 1e-6}')
    terms = []
    for key in given:
        if not (key.isascii() and key.isdecimal() and len(key) < 4):
            raise InputError(file, f"{where}aspheric_coefficients", key, "powers of r as keys")
        terms.append((int(key), number(given, key, file, f"{where}aspheric_coefficients, power ")))
    return tuple(sorted((power, value) for power, value in terms if value))


def _optional_text(table: Mapping[str, Any], key: str, file: str, where: str = "") -> str:
    """A text that may be null."""
    return "" if table.get(key) is None else text(table, key, file, where, required=False)
