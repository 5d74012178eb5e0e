"""A folder of lens files as a table, every lens checked, and their sections for a sheet of pictures."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

from neurolens.analysis.layout import refractions
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.optics.lenscheck import Check, check_lens, doubts, verdict
from neurolens.optics.lensfile import read_lens
from neurolens.optics.lightcheck import film_edge_mm
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import image_radius_mm

UNREADABLE = "unreadable"
_NO_FIELD = 0.2  # film radius over focal length at which a lens of unknown field is drawn


def lens_files(folder: Path) -> list[Path]:
    """The lens files of a folder, by name.

    Raises:
        InputError: no such folder, a file, or none in it.
    """
    if folder.is_file():
        raise InputError(folder, "lens folder", "(a file)", 'a folder of lens files; leave out "list" for one lens')
    if not folder.is_dir():
        raise InputError(folder, "lens folder", "(missing)", "a folder of lens files (*.toml)")
    files = sorted(folder.glob("*.toml"))
    if not files:
        raise InputError(folder, "lens folder", "(no *.toml)", "a folder of lens files")
    return files


def read_quietly(path: Path) -> Lens:
    """A lens without the warnings of reading it, which its check repeats."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)
        return read_lens(path)


def library(files: list[Path]) -> list[dict[str, Any]]:
    """One row a lens file.

    Returns: lens, file, name, efl_mm and efl_x_mm computed (the latter of an anamorphic lens only), stated_efl_mm,
        f_number of the stop, half_field_deg as stated, image_radius_mm as stated, refractions, aspheres, cylinders,
        states (zoom or focus), rims, verdict ("ok", "doubtful", or "unreadable" with the error as its doubt), doubts,
        and checks: a list of {state, quantity, computed, stated, doubt}.
    """
    return [_row(path) for path in files]


def _row(path: Path) -> dict[str, Any]:
    try:
        lens = read_quietly(path)
        checks = check_lens(lens)
    except NeurolensError as error:
        return {"lens": path.stem, "file": str(path), "verdict": UNREADABLE, "doubts": [str(error)]}
    data = first_order(lens)
    cylinders = sum(s.cylinder is not None for s in lens.surfaces)
    return {
        "lens": path.stem,
        "file": str(path),
        "name": lens.name,
        "efl_mm": float(data.efl_mm),
        "efl_x_mm": float(first_order(lens, meridian="x").efl_mm) if cylinders else None,
        "stated_efl_mm": lens.stated_efl_mm,
        "f_number": float(data.f_number),
        "half_field_deg": lens.half_field_deg,
        "image_radius_mm": lens.image_radius_mm,
        "refractions": refractions(lens),
        "aspheres": sum(s.conic != 0 or bool(s.asphere) for s in lens.surfaces),
        "cylinders": cylinders,
        "states": len(lens.configurations),
        "rims": lens.rims,
        "verdict": verdict(checks),
        "doubts": doubts(checks),
        "checks": [check_row(c) for c in checks],
    }


def check_row(check: Check) -> dict[str, Any]:
    """A check as plain data."""
    return {
        "state": check.state,
        "quantity": check.quantity,
        "computed": check.computed,
        "stated": check.stated,
        "doubt": check.doubt,
    }


def sections(files: list[Path]) -> list[dict[str, Any]]:
    """The sections of lenses with rays, focused at infinity, as `plots.library.sheet` draws them.

    An anamorphic lens is shown in its y-z plane.
    """
    from neurolens.analysis.fields import Scene
    from neurolens.analysis.layout import layout_profile

    found = []
    for path in files:
        lens = read_quietly(path).at()
        data = first_order(lens)
        edge = film_edge_mm(lens)
        if edge is None:
            edge = _NO_FIELD * abs(data.efl_mm) if lens.half_field_deg is None else image_radius_mm(lens)[0]
        profile = layout_profile(Scene(lens, math.inf, "y"), edge)
        found.append({**profile, "title": path.stem, "subtitle": _caption(lens, data.efl_mm, data.f_number)})
    return found


def _caption(lens: Lens, efl_mm: float, f_number: float) -> str:
    text = f"{efl_mm:.4g} mm f/{f_number:.2g}"
    if lens.anamorphic:
        text = f"{efl_mm:.3g} / {first_order(lens, meridian='x').efl_mm:.3g} mm f/{f_number:.2g}"
    return text + ("" if lens.half_field_deg is None else f", {lens.half_field_deg:.3g}°") + f", rims {lens.rims}"
