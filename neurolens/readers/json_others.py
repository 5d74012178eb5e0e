"""JSON prescriptions of other programs: DeepLens (differentiable design) and ISET (pbrt lenses of a camera simulator).

DeepLens: surfaces of type Spheric, Aspheric, Stop or Aperture with `r` (semi-diameter), `roc` or else `c` (curvature),
`d_next` (thickness), `mat2` (medium behind: a name, or "n_d/V_d"), `k` and `ai` (sag a_1 r^2 + a_2 r^4 + ...); keys in
brackets repeat others. ISET: `radius` (0 is a plane), `thickness`, `ior` (one index; 0 marks the stop),
`semi_aperture`. Millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import reject_unknown
from neurolens.optics.lensfile import number
from neurolens.optics.prescription import Lens, Surface
from neurolens.readers.assemble import first_order, named_glass
from neurolens.readers.draft import Draft, Given, Row, lens_of
from neurolens.readers.source import warn

_DEEPLENS = (
    *("info", "foclen", "fnum", "r_sensor", "d_sensor", "sensor_size", "sensor_res", "hfov", "fov", "float_hfov"),
    *("float_foclen", "float_rfov", "rfov", "surfaces"),
)
_DEEPLENS_SURFACE = (
    *("idx", "type", "r", "c", "roc", "d", "d_next", "mat1", "mat2", "k", "ai", "is_square", "diffraction"),
)
_STOPS, _AIR = ("Stop", "Aperture"), ("air", "vacuum", "occluder")
_ISET = ("name", "description", "type", "surfaces", "microlens")
_ISET_SURFACE = ("radius", "thickness", "ior", "semi_aperture", "conic_constant")


def read_others(data: Mapping[str, Any], file: str, given: Given) -> Lens | None:
    """The lens of a JSON object of DeepLens or ISET; None where it is of neither.

    Warns:
        NeurolensWarning: a stated focal length that is not that of the surfaces to 1%.

    Raises:
        InputError: a kind of surface that neurolens does not know, a key it would ignore, a figure out of range.
    """
    draft = _draft(data, file)
    if draft is None:
        return None
    lens = lens_of(draft, given)
    if "foclen" in data:
        stated, found = number(data, "foclen", file), first_order(lens).efl_mm
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
    reject_unknown(file, "", {k: v for k, v in data.items() if not _repeats(k)}, _DEEPLENS)
    surfaces = [_deeplens_surface(row, file, f"surface {k}, ") for k, row in enumerate(rows)]
    return Draft(
        file=file,
        kind="DeepLens",
        rows=tuple(Row(s, aperture=True) for s in surfaces),
        name=_line(data.get("info")),
        image_radius=number(data, "r_sensor", file, above=0) if "r_sensor" in data else None,
        film_given=surfaces[-1].thickness_mm > 0,
        unit="mm",
    )


def _deeplens_surface(row: Mapping[str, Any], file: str, where: str) -> Surface:
    kind, stop = row.get("type"), row.get("type") in _STOPS
    if kind not in ("Spheric", "Aspheric", *_STOPS):
        raise InputError(file, f"{where}type", kind, "Spheric, Aspheric, Stop or Aperture")
    # ai2, ai4, ... say the list ai once more.
    once = {k: v for k, v in row.items() if not (_repeats(k) or (k[:2] == "ai" and k[2:].isdecimal() and "ai" in row))}
    reject_unknown(file, where, once, _DEEPLENS_SURFACE)
    shape: dict[str, Any] = {}
    if kind == "Aspheric":
        terms = row.get("ai") or []
        if not isinstance(terms, list):
            raise InputError(file, f"{where}ai", terms, "a list of coefficients of r^2, r^4, ...")
        table = {f"ai[{k}]": value for k, value in enumerate(terms)}
        sag = [(2 * k + 2, number(table, key, file, where)) for k, key in enumerate(table)]
        conic = number(row, "k", file, where) if "k" in row else 0.0
        shape = {"conic": conic, "asphere": tuple((power, value) for power, value in sag if value)}
    return Surface(
        radius_mm=math.inf if stop else _radius_mm(row, file, where),
        thickness_mm=number(row, "d_next", file, where, unit="mm"),
        diameter_mm=2 * number(row, "r", file, where, unit="mm", above=0),
        stop=stop,
        **shape,
        **_medium(row.get("mat2"), file, where),
    )


def _radius_mm(row: Mapping[str, Any], file: str, where: str) -> float:
    """`roc` has more digits than `c`, where both are there; 0 is a plane in both."""
    if "roc" in row:
        return number(row, "roc", file, where, unit="mm", finite=False) or math.inf
    c = number(row, "c", file, where, unit="1/mm")
    return 1 / c if c else math.inf


def _medium(name: Any, file: str, where: str) -> dict[str, Any]:
    if not isinstance(name, str):
        raise InputError(file, f"{where}mat2", name, 'a glass, "n_d/V_d" or "air"')
    if name.lower() in _AIR:
        return {}
    index, slash, abbe = name.partition("/")
    if not slash:
        return named_glass(name, file, f"{where}mat2")
    try:
        return {"n_d": float(index), "V_d": float(abbe)}
    except ValueError:
        raise InputError(file, f"{where}mat2", name, 'two numbers, "n_d/V_d"') from None


def _iset(data: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], file: str) -> Draft:
    reject_unknown(file, "", data, _ISET)
    if data.get("microlens"):
        raise InputError(file, "microlens", "(given)", "a lens without microlenses")
    surfaces = []
    for k, row in enumerate(rows):
        where = f"surface {k}, "
        reject_unknown(file, where, row, _ISET_SURFACE)
        ior = number(row, "ior", file, where)
        surface = Surface(
            radius_mm=number(row, "radius", file, where, unit="mm, 0 for a plane") or math.inf,
            thickness_mm=number(row, "thickness", file, where, unit="mm"),
            diameter_mm=2 * number(row, "semi_aperture", file, where, unit="mm", above=0),
            n_d=ior or 1.0,  # the stop stands in air
            stop=ior == 0,
            conic=number(row, "conic_constant", file, where) if "conic_constant" in row else 0.0,
        )
        surfaces.append(surface)
    return Draft(
        file=file,
        kind="ISET",
        rows=tuple(Row(s, aperture=True) for s in surfaces),
        name=_line(data.get("name")),
        notes=_line(data.get("description")),
        film_given=surfaces[-1].thickness_mm > 0,
        unit="mm",
    )


def _repeats(key: str) -> bool:
    """Whether a key stands in brackets: what it says follows from others."""
    return key.startswith("(") and key.endswith(")")


def _line(text: Any) -> str:
    return " ".join(text.split()) if isinstance(text, str) and text != "None" else ""
