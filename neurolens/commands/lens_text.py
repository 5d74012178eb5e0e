"""The page of text that `neurolens lens FILE` prints, from the data that --json prints."""

from __future__ import annotations

import math
from typing import Any

from neurolens.commands.output import number, table


def lens_text(data: dict[str, Any]) -> str:
    """The data of `neurolens lens` as a page of text."""
    parts = [_head(data), _first_order(data), _light(data), _surfaces(data)]
    if data["configurations"]:
        zoom = [f"{c['name']} ({number(c['efl_mm'])} mm)" for c in data["configurations"] if not _near(c)]
        near = [f"{c['name']} ({number(c['object_distance_mm'])} mm)" for c in data["configurations"] if _near(c)]
        parts += [f"Zoom states (--zoom, also mm between them): {', '.join(zoom)}"] if zoom else []
        parts += [f"Focus states (--zoom, or --focusing internal): {', '.join(near)} to the object"] if near else []
    if data["derived"]:
        parts.append(f"Derived: {data['derived']}")
    parts += [f"Warning: {text}" for text in data["warnings"]]
    if data["layout"]:
        parts.append(f"Layout drawn in {data['layout']}")
    if data["breathing_plot"]:
        parts.append(f"Focus breathing drawn in {data['breathing_plot']}")
    return "\n\n".join(parts)


def _near(configuration: dict[str, Any]) -> bool:
    return configuration["object_distance_mm"] is not None


def _head(data: dict[str, Any]) -> str:
    by = f", {data['designer']}" if data["designer"] else ""
    return f"{data['name']}{by}\n{data['source']}"


def _first_order(data: dict[str, Any]) -> str:
    focus = "infinity" if math.isinf(data["focus_m"]) else f"{data['focus_m']:g} m"

    def mm(key: str) -> str:
        return f"{number(data[key], 6)} mm"

    rows = [
        ("focal length", mm("efl_mm"), "" if data["efl_x_mm"] is None else "in the y-z plane, as all that follows"),
        *(() if data["efl_x_mm"] is None else (("", mm("efl_x_mm"), "in the x-z plane"),)),
        ("back focus", mm("back_focus_mm"), "last vertex to rear focal point"),
        ("f-number", f"f/{number(data['f_number'])}", "focal length over entrance pupil"),
        ("working f-number", f"f/{number(data['working_f_number'])}", "of the real marginal ray at this focus"),
        ("principal planes", f"{mm('front_principal_z_mm')}, {mm('rear_principal_z_mm')}", "front H, rear H'"),
        ("entrance pupil", mm("entrance_pupil_z_mm"), f"diameter {mm('entrance_pupil_diameter_mm')}"),
        ("exit pupil", mm("exit_pupil_z_mm"), f"diameter {mm('exit_pupil_diameter_mm')}"),
        ("film plane", mm("film_z_mm"), f"focus at {focus}"),
        ("stop", f"surface {data['stop_surface']}", f"diameter {mm('stop_diameter_mm')}"),
        ("refractions", str(data["refractions"]), ""),
    ]
    return _columns(rows)


def _light(data: dict[str, Any]) -> str:
    reached, stated = data["half_field_reached_deg"], data["half_field_deg"]
    anamorphic = data["efl_x_mm"] is not None
    along, states = " along y" if anamorphic else "", "" if stated is None else f"; the file states {stated:g}"
    rows = [
        ("image radius", f"{number(data['image_radius_mm'])} mm", f"from {data['image_radius_from']}"),
        ("half field", _degrees(reached), f"reached at the edge of the film{along}{states}"),
        *((("", _degrees(data["half_field_reached_x_deg"]), "along x"),) if anamorphic else ()),
        (
            "rays that pass",
            f"{100 * data['passing_share']:.1f}%",
            "of rays uniform over the film and over the disc of all passing rays, 5% wider",
        ),
        *(("", f"{100 * e['share']:.1f}%", e["text"]) for e in data["ended"]),
    ]
    return _columns(rows)


def _degrees(angle: float | None) -> str:
    return "-" if angle is None else f"{angle:.2f} degrees"


def _columns(rows: list[tuple[str, str, str]]) -> str:
    wide = max(len(value) for _, value, _ in rows)
    return "\n".join(f"{name:18}{value:{wide}}  {note}".rstrip() for name, value, note in rows)


def _surfaces(data: dict[str, Any]) -> str:
    header = ["surface", "radius mm", "thickness mm", "diameter mm", "n_d", "V_d", "", ""]
    rows = []
    for s in data["surfaces"]:
        radius = "plane" if math.isinf(s["radius_mm"]) else f"{s['radius_mm']:.4f}"
        glass = ("", "") if s["n_d"] == 1 else (f"{s['n_d']:.4f}", "-" if s["V_d"] is None else f"{s['V_d']:.2f}")
        name = "stop" if s["stop"] else s["glass"] or s["material"] or ""
        size = f"{s['thickness_mm']:.4f}", f"{s['diameter_mm']:.4f}"
        rows.append([str(s["surface"]), radius, *size, *glass, name, surface_words(s)])
    if not any(row[-1] for row in rows):
        header, rows = header[:-1], [row[:-1] for row in rows]
    return table(header, rows)


def surface_words(row: dict[str, Any]) -> str:
    """What a row of `evaluate.describe.glass_table` has beside radius and glass, in a few words; empty of a sphere."""
    powers = sorted(map(int, row["asphere"]))
    span = "" if not powers else f"asphere {powers[0]}" + (f"-{powers[-1]}" if len(powers) > 1 else "")
    words = [
        span,
        f"K {row['conic']:.4g}" if row["conic"] else "",
        f"cylinder {row['cylinder']}" if row["cylinder"] else "",
        f"coating {row['coating']['name']}" if row["coating"] else "",
        f"absorbs {row['absorption_per_mm']:.3g}/mm" if row["absorption_per_mm"] else "",
    ]
    return ", ".join(word for word in words if word)
