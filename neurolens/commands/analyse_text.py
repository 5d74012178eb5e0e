"""The analyses as compact tables. Data in as the results' `to_dict` gives it, text out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from neurolens.commands.output import number, table

_ROWS = 6  # of curves over the field: enough to see their shape
_MTF_PER_MM = (10, 20, 30, 40, 50)


def layout(data: dict[str, Any]) -> str:
    """Which fields the drawn rays belong to."""
    counts: dict[str, int] = {}
    for ray in data["rays"]:
        counts[ray["label"]] = counts.get(ray["label"], 0) + 1
    rows = [(label, str(count)) for label, count in counts.items()]
    return f"Layout: {len(data['surfaces'])} surfaces\n" + table(("field", "rays drawn"), rows)


def spots(data: dict[str, Any]) -> str:
    waves = data["wavelength_nm"]
    header = (
        "field",
        "height mm",
        "RMS µm",
        *(f"{w:.0f} nm" for w in waves),
        "largest µm",
        "passed",
        "best focus mm",
        "RMS there",
    )
    rows = [
        (
            *_place(data, i),
            number(data["rms_um"][i]),
            *(_three(v) for v in data["rms_by_wavelength_um"][i]),
            number(data["geometric_um"][i]),
            _percent(data["passed"][i]),
            _three(data["best_shift_mm"][i]),
            _three(data["best_rms_um"][i]),
        )
        for i in range(len(data["field_deg"]))
    ]  # fmt: skip
    airy = f"Airy disc radius {number(data['airy_um'], 3)} µm at the working f/{number(data['working_f_number'], 3)}"
    return f"Spots (radius from the centroid, all wavelengths; each by itself; {airy})\n" + table(header, rows)


def fans(data: dict[str, Any]) -> str:
    header = (
        "field",
        "height mm",
        *(f"{name} {w:.0f} nm" for name in ("tang.", "sag.") for w in data["wavelength_nm"]),
    )
    rows = [
        (
            *_place(data, i),
            *(_three(_largest(row)) for row in data["tangential_um"][i]),
            *(_three(_largest(row)) for row in data["sagittal_um"][i]),
        )
        for i in range(len(data["field_deg"]))
    ]  # fmt: skip
    return "Ray fans (largest transverse aberration, µm)\n" + table(header, rows)


def colour(data: dict[str, Any]) -> str:
    some = _some(len(data["spectrum_nm"]), 9)
    zones = ("paraxial", *(f"zone {z:.2f}" for z in data["zone"][1:]))
    first = [(f"{data['spectrum_nm'][i]:.0f} nm", *(_three(v) for v in data["focus_shift_mm"][i])) for i in some]
    second = [(*_place(data, i), *(_three(v) for v in data["lateral_um"][i])) for i in _some(len(data["field_deg"]))]
    lines = [f"{w:.0f} nm" for w in data["line_nm"]]
    return (
        "Longitudinal colour (focus from the film, mm)\n" + table(("wavelength", *zones), first)
        + "\n\nLateral colour (height from that of the first line, µm)\n"
        + table(("field", "height mm", *lines), second)
    )  # fmt: skip


def curvature(data: dict[str, Any]) -> str:
    keys = ("tangential_mm", "sagittal_mm", "petzval_mm")
    rows = [(*_place(data, i), *(_three(data[k][i]) for k in keys)) for i in _some(len(data["field_deg"]))]
    head = f"Field curvature (focus from the film, mm; Petzval radius {number(data['petzval_radius_mm'])} mm)"
    return f"{head}\n" + table(("field", "height mm", "tangential", "sagittal", "Petzval"), rows)


def distortion(data: dict[str, Any]) -> str:
    names = list(data["error_percent"])
    rows = [
        (*_place(data, i), *(_three(data["error_percent"][n][i]) for n in names)) for i in _some(len(data["field_deg"]))
    ]
    head = (
        f"Distortion (%; {_fixed(data['edge_percent'], 2)}% at the edge against {data['reference']}; "
        f"closest is {data['best']}; {number(data['scale_mm'])} mm per radian on the axis)"
    )
    return f"{head}\n" + table(("field", "height mm", *(n.partition(",")[0] for n in names)), rows)


def vignetting(data: dict[str, Any]) -> str:
    keys = ("relative", "unvignetted", "passed", "cos4")
    rows = [(*_place(data, i), *(_percent(data[k][i]) for k in keys)) for i in _some(len(data["field_deg"]))]
    header = ("field", "height mm", "illumination", "without rims", "rims pass", "cos^4")
    return "Vignetting and relative illumination\n" + table(header, rows)


def mtf(data: dict[str, Any]) -> str:
    at = [data["frequency_per_mm"].index(f) for f in _MTF_PER_MM if f in data["frequency_per_mm"]]
    header = ("field", "height mm", *(f"{data['frequency_per_mm'][k]:g}/mm {d}" for k in at for d in "TS"))
    rows = [
        (*_place(data, i), *(_fixed(data[key][i][k]) for k in at for key in ("tangential", "sagittal")))
        for i in range(len(data["field_deg"]))
    ]
    limit = ", ".join(_fixed(data["diffraction_limit"][k]) for k in at)
    waves = ", ".join(f"{w:.0f}" for w in data["wavelength_nm"])
    return (
        f"Geometric MTF ({waves} nm; T tangential, S sagittal; without diffraction, whose limit is {limit})\n"
        + table(header, rows)
    )  # fmt: skip


def seidel(data: dict[str, Any]) -> str:
    header = ("surface", *(name.replace(" colour", "") for name in data["names"]))
    rows = [(str(k), *(f"{round(v, 5) + 0.0:.5f}" for v in row)) for k, row in enumerate(data["surfaces"])]
    rows.append(("total", *(f"{round(v, 5) + 0.0:.5f}" for v in data["total"])))
    odd = data["odd_powers"]
    note = f"\nNot counted: the odd powers of surface {', '.join(map(str, odd))}" if odd else ""
    head = f"Seidel sums (mm, {data['wavelength_nm']:.0f} nm, image height {number(data['image_height_mm'])} mm)"
    return f"{head}\n" + table(header, rows) + note


def psf(data: dict[str, Any]) -> str:
    rows = [
        (
            "axis" if data["field_deg"][i] == 0 else f"{data['field_deg'][i]:.2f}°",
            number(data["half_width_um"][i]),
            number(data["strehl"][i], 3),
        )
        for i in range(len(data["field_deg"]))
    ]
    head = f"Point spread ({data['wavelength_nm'][0]:.0f} nm; Strehl ratio '-' where aberrations rule out diffraction)"
    return f"{head}\n" + table(("field", "half width µm", "Strehl ratio"), rows)


def _place(data: dict[str, Any], i: int) -> tuple[str, str]:
    field = data["field_deg"][i]
    return ("axis" if field == 0 else f"{field:.2f}°", _fixed(data["height_mm"][i], 2))


def _some(count: int, rows: int = _ROWS) -> list[int]:
    """About so many of the indices below `count`, evenly spread, both ends among them."""
    steps = min(rows, count) - 1
    return [round(k * (count - 1) / steps) for k in range(steps + 1)] if steps > 0 else [0] * count


def _fixed(value: float, places: int = 3) -> str:
    """So many places, "-" where there is no value."""
    return "-" if math.isnan(value) else f"{value + 0.0:.{places}f}"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}%"


def _largest(values: Sequence[float]) -> float:
    seen = [abs(v) for v in values if not math.isnan(v)]
    return max(seen) if seen else math.nan


def _three(value: float) -> str:
    """Three digits; what rounding leaves of a zero is a zero."""
    return number(0.0 if abs(value) < 1e-6 else value, 3)
