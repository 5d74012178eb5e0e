"""A public collection of lens files: what is read, what is refused and why, and agreement with ray-optics.

The collection is OpticsDatabase (github.com/amegahed/OpticsDatabase, MIT licence, 1,218 Zemax files); it is not stored
in this project: clone it, and name its folder. The independent tracer is ray-optics 0.9.8 (BSD 3-clause licence), which
brings a toolkit for windows and lives in an environment of its own:

    git clone https://github.com/amegahed/OpticsDatabase
    python3 -m venv /tmp/ray-optics
    /tmp/ray-optics/bin/pip install rayoptics==0.9.8
    python -m experiments collection OpticsDatabase --ray-optics /tmp/ray-optics/bin/python

Both programs read each file. Compared are focal length, back focus, and the image heights of real chief rays (through
the middle of the stop, rims ignored) at ten fields up to the file's own, at one wavelength and with the object at
infinity. Answers of ray-optics are kept in OUT/ray_optics.json, so that a second run asks it for new files alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import re
import subprocess
import time
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.lab import Row
from neurolens.analysis.fields import Scene
from neurolens.base.errors import AssumedWarning, InputError, NeurolensError, NeurolensWarning
from neurolens.optics.glass import LINE_D_NM, index_of
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.readers.any_format import read_any

SCRIPT = Path(__file__).with_name("ray_optics.py")
LIMIT = 1e-4  # of a difference, relative
FIELDS = 10  # from a tenth of the file's field to all of it
SMALL_FIELD_DEG = 1.0  # of files that state no field


def edge_deg(lens: Lens) -> float:
    """The field that the file states, as an angle; an image height as without distortion."""
    if lens.half_field_deg:
        return lens.half_field_deg
    radius = lens.image_radius_mm
    return math.degrees(math.atan(radius / abs(first_order(lens).efl_mm))) if radius else SMALL_FIELD_DEG


def own_row(path: Path, name: str) -> Row:
    """What neurolens says of a file: verdict, reason or notes, and the figures that are compared."""
    row: Row = {"file": name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "verdict": "refused"}
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", NeurolensWarning)
        try:
            lens = read_any(path)
            row |= {"verdict": "read", "seconds": time.perf_counter() - began} | figures_of(lens)
        except NeurolensError as error:
            row["reason"] = str(error).removeprefix(f"{path}: ")
        except Exception as error:  # a fault of ours, which the table must show
            row |= {"verdict": "fault", "reason": f"{type(error).__name__}: {error}"}
    said = [(str(w.message).removeprefix(f"{path}: "), issubclass(w.category, AssumedWarning)) for w in heard]
    return row | {"notes": [text for text, _ in said], "assumed": [text for text, assumed in said if assumed]}


def figures_of(lens: Lens) -> Row:
    """First-order data and chief rays, lengths from the last surface at which the medium changes."""
    index = [1.0, *(float(index_of(s, LINE_D_NM)) for s in lens.surfaces)]
    z, data, scene = lens.vertices_mm, first_order(lens), Scene(lens)
    changes = [k for k in range(len(lens.surfaces)) if index[k + 1] != index[k]]
    fields = [edge_deg(lens) * k / FIELDS for k in range(1, FIELDS + 1)]
    heights = scene.chief_rays(fields).height_mm.tolist()
    return {
        "wavelength_nm": LINE_D_NM,
        "efl_mm": data.efl_mm,
        "back_mm": data.rear_focal_z_mm - z[changes[-1]],
        "film_mm": scene.film_z_mm - z[changes[-1]],
        "fields_deg": fields,
        "heights_mm": [None if math.isnan(h) else h for h in heights],
        "z_mm": [z[k] - z[changes[0]] for k in changes],
        "index": [index[k + 1] for k in changes],
    }


# ---- The other program. ----------------------------------------------------------------------------------------------


def ask_ray_optics(python: Path, folder: Path, rows: list[Row], quiet: bool) -> Iterable[Row]:
    """The answers of ray-optics for the files of rows, one after the other.

    Raises:
        InputError: no such program, or one without ray-optics.
    """
    tasks = [
        {"file": str(folder / r["file"]), "wavelength_nm": r["wavelength_nm"], "fields_deg": r["fields_deg"]}
        for r in rows
    ]
    text = "".join(json.dumps(task) + "\n" for task in tasks)
    with subprocess.Popen(
        [python, SCRIPT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        ...
