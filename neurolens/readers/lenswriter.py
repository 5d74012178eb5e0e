"""Lenses written to files: aligned columns for people, every figure exact for `read_lens`."""

from __future__ import annotations

import re
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.tomlfile import format_value
from neurolens.lens.designs import is_design
from neurolens.lens.prescription import Lens, Medium, Surface
from neurolens.readers.lensfile import MEDIUM_KEYS, SCHEMA

ROWS_COMMENT = """\
# From the scene to the film, numbered from 0. radius_mm is positive when the centre of curvature lies towards the film;
# inf is a plane. n_d and V_d are of the glass after the surface; air where they are left out.
"""
WRAP = 110
# Texts and tables go last: a column of glass names needs no right edge.
UNPADDED = ("conic", "asphere", "glass", "material", "absorption_per_mm", "coating", "stop")


def write_lens(lens: Lens, path: str | Path) -> None:
    """Write a lens file that `read_lens` reads back to the same lens (but for its `path`).

    A lens that was focused keeps its film plane: it becomes the last thickness. What is derived goes into the notes.
    """
    atomic_write_text(path, format_lens(lens))


def format_lens(lens: Lens) -> str:
    """The text of a lens file."""
    head = {
        "schema": SCHEMA,
        "name": lens.name,
        "designer": lens.designer or None,
        "source": lens.source,
        "f_number": float(lens.f_number),
        "efl_mm": lens.stated_efl_mm,
        "efl_x_mm": lens.stated_efl_x_mm,
        "image_radius_mm": lens.image_radius_mm,
        "half_field_deg": lens.half_field_deg,
        "rims": lens.rims,
        "wavelengths_nm": list(lens.wavelengths_nm) or None,
    }
    lines = [f"{key} = {format_value(value)}" for key, value in head.items() if value is not None]
    notes = " ".join(text for text in (lens.notes, lens.derived) if text)
    if notes:
        lines.append(f"notes = {_wrapped(notes)}")
    if lens.object_medium != Medium():
        medium = ((key, getattr(lens.object_medium, key)) for key in MEDIUM_KEYS)
        lines.append(f"object_medium = {format_value({key: value for key, value in medium if value is not None})}")
    text = "\n".join(lines) + "\n\n" + ROWS_COMMENT + "surfaces = [\n" + _rows(lens) + "]\n"
    for name, layers in _stacks(lens).items():
        text += f"\n[[coating]]\nname = {format_value(name)}\nlayers = {format_value(layers)}\n"
    text += _aperture(lens)
    for c in lens.configurations:
        text += f"\n[[configuration]]\nname = {format_value(c.name)}\n"
        for key in ("efl_mm", "half_field_deg", "f_number", "stop_diameter_mm", "object_distance_mm"):
            value = getattr(c, key)
            text += "" if value is None else f"{key} = {format_value(float(value))}\n"
        text += f"thickness_mm = {format_value({str(k): float(t) for k, t in c.thickness_mm})}\n"
    return text


def _stacks(lens: Lens) -> dict[str, tuple[tuple[float, ...], ...]]:
    """Layers by name of the coatings that are no designs: those follow from their name and the glass they are on."""
    found, before = {}, float(lens.object_medium.n_d)
    for s in lens.surfaces:
        if s.coating and not is_design(s.coating, before, float(s.n_d)):
            found[s.coating.name] = s.coating.layers
        before = float(s.n_d)
    return found


def _aperture(lens: Lens) -> str:
    """The table of the stop's blades; a mask is refused, for a lens file has no form for it."""
    if lens.aperture is None:
        return ""
    if lens.aperture.blades is None:
        raise InputError(lens.path, "aperture", "(a mask)", "blades, or a round stop: masks are no part of lens files")
    values = {"blades": lens.aperture.blades, "rotation_deg": float(lens.aperture.rotation_deg)}
    values["curvature"] = float(lens.aperture.curvature)
    return "\n[aperture]\n" + "".join(f"{key} = {format_value(v)}\n" for key, v in values.items())


def _rows(lens: Lens) -> str:
    """One inline table per surface, keys in columns; a column that no surface uses is left out."""
    surfaces = list(lens.surfaces)
    cells = [_cells(s) for s in surfaces]
    if lens.film_z_mm is not None:
        cells[-1]["thickness_mm"] = repr(float(lens.film_z_mm) - float(lens.vertices_mm[-2]))
    widths = {
        key: max(len(row.get(key, "")) for row in cells) for key in dict.fromkeys(k for row in cells for k in row)
    }
    text = ""
    for row in cells:
        columns = [f"{key} = {row[key].rjust(widths[key])}" for key in row if key not in UNPADDED]
        columns += [f"{key} = {row[key]}" for key in UNPADDED if key in row]
        text += "  { " + ", ".join(columns) + " },\n"
    return text


def _cells(s: Surface) -> dict[str, str]:
    cells = {key: repr(float(getattr(s, key))) for key in ("radius_mm", "thickness_mm", "diameter_mm")}
    if float(s.n_d) != 1 or s.V_d is not None or s.material is not None or s.absorption_per_mm:
        cells["n_d"] = repr(float(s.n_d))
    if s.V_d is not None:
        cells["V_d"] = repr(float(s.V_d))
    if s.cylinder is not None:
        cells["cylinder"] = format_value(s.cylinder)
    for key, value in (("across_mm", s.across and s.across[0]), ("across_conic", s.across and s.across[1])):
        if value is not None:
            cells[key] = repr(value)
    if s.focal_mm is not None:
        cells["focal_mm"] = repr(s.focal_mm)
    if float(s.conic) != 0:
        cells["conic"] = repr(float(s.conic))
    if s.asphere:
        cells["asphere"] = format_value({str(p): float(a) for p, a in s.asphere})
    if s.absorption_per_mm:
        cells["absorption_per_mm"] = repr(s.absorption_per_mm)
    for key, name in (("glass", s.glass), ("material", s.material), ("coating", s.coating and s.coating.name)):
        if name is not None:
            cells[key] = format_value(name)
    if s.stop:
        cells["stop"] = "true"
    return cells


def _wrapped(text: str) -> str:
    """A text in short lines. TOML drops a backslash at the end of a line and the blanks after it."""
    if len(text) <= WRAP:
        return format_value(text)
    lines: list[str] = []
    for word in re.split(r"(?<= )(?=\S)", text):
        if lines and len(lines[-1]) + len(word.split(" ", 1)[0]) <= WRAP:
            lines[-1] += word
        else:
            lines.append(word)
    return '"""\\\n' + "\\\n".join(format_value(line)[1:-1] for line in lines) + '"""'
