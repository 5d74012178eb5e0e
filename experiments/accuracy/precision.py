"""Rays in float32, which cameras, C and shaders use, beside float64, through every lens file.

Rays of 550 nm from points of the film, up to 21.6 mm from the axis, to points of the exit pupil, the lens focused at
infinity, are rounded to float32 first, so that both precisions trace the same ones; those that pass count. The error is
that of the scene ray's direction as a distance on the film: the focal length times the difference of direction cosines.
Where polynomials of a lens are summed about the middle of their zones (`optics/trace/shapes.py`), the same rays go
through its powers, too, to show what that is worth.
Exit code 1 where a lens misses the goal. Writes precision.md and precision.json.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from experiments import lab
from experiments.accuracy.extremes import both_precisions
from neurolens.base import status as st
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace import shapes
from neurolens.optics.trace.rays import Rays, trace

GOAL_UM = 0.2  # 99th percentile, on the film
FILM_MM = 21.6
_NM = 550.0


def camera_rays(lens: Lens, count: int) -> tuple[Rays, float]:
    """Rays from the film of a set lens to its exit pupil, both discs filled evenly, and the focal length in mm."""
    data = first_order(lens)
    focal_mm, z_mm = abs(float(data.efl_mm)), float(lens.film_z_mm or math.nan)
    rng = np.random.default_rng(0)
    radius = np.sqrt(rng.random((2, count))) * [[min(FILM_MM, 1.2 * focal_mm)], [data.exit_pupil_diameter_mm / 2]]
    film, pupil = np.exp(2j * math.pi * rng.random((2, count))) * radius
    start = np.stack([film.real, film.imag, np.full(count, z_mm)])
    way = np.stack([pupil.real, pupil.imag, np.full(count, data.exit_pupil_z_mm)]) - start
    way *= np.sign(-way[2]) / np.linalg.norm(way, axis=0)
    return Rays(*(torch.from_numpy(c.copy()) for c in (*start, *way))), focal_mm


def errors_um(lens: Lens, rays: Rays, focal_mm: float) -> tuple[np.ndarray[Any, Any], float]:
    """Errors (um on the film) of rays that pass in both precisions, and the share of rays whose statuses differ."""
    with torch.no_grad():
        coarse, fine = (trace(lens, r, _NM, towards="scene") for r in both_precisions(rays))
    passed = (coarse.status == st.PASSED) & (fine.status == st.PASSED)
    off = [(getattr(coarse.rays, d).double() - getattr(fine.rays, d))[passed].numpy() for d in ("dx", "dy")]
    return 1e3 * focal_mm * np.hypot(*off), float((coarse.status != fine.status).double().mean())


def measure(path: Path, count: int) -> dict[str, Any]:
    """One lens: errors as they are and, where any polynomial is centred, as its powers would have them."""
    lens = lab.lens_of(path, focus_m=math.inf)
    rays, focal_mm = camera_rays(lens, count)
    error, differ = errors_um(lens, rays, focal_mm)
    centred = sum(s.figure.asphere != () and shapes.centred(s) is not None for s in lens.surfaces)
    powers = None
    if centred:
        with patch.object(shapes, "centred", lambda surface: None):
            powers = float(np.quantile(errors_um(lens, rays, focal_mm)[0], 0.99))
    return {
        "name": path.stem, "aspheres": sum(bool(s.figure.asphere) for s in lens.surfaces), "centred": centred,
        "powers_um": powers, "median_um": float(np.median(error)), "p99_um": float(np.quantile(error, 0.99)),
        "worst_um": float(error.max()), "rays": len(error), "status_differs": differ,
    }  # fmt: skip


_COLUMNS = lab.columns(
    ("lens", "name"), ("rays", "rays", "d"), ("aspheres", "aspheres", "d"), ("centred", "centred", "d"),
    ("99%, by powers, um", "powers_um", ".3g"), ("median, um", "median_um", ".2g"), ("99%, um", "p99_um", ".3g"),
    ("worst, um", "worst_um", ".3g"), ("statuses differ, %", "status_differs", ".3f", 100),
)  # fmt: skip
_FAR = (
    " The error of a long lens is the rounding of points and directions to float32, which its focal length multiplies: "
    "for 800 mm one unit in the last place of a direction is 0.05 um."
)
OPTIONS = (
    lab.count("rays", 20000, "rays per lens, before any is stopped (default 20000)", 100),
    lab.option("--only", metavar="TEXT", default="", help="lenses whose name holds this text"),
    lab.out(),
)


def run(args: argparse.Namespace) -> int:
    """Measure all lens files and write the table; returns 1 where a lens misses the goal."""
    lab.quiet_glasses()
    paths = lab.chosen(sorted(lab.LENSES.glob("*.toml")), lambda path: path.stem, args.only, "lenses")
    rows = [measure(path, args.rays) for path in lab.counted(paths, "precision", args.quiet)]
    rows.sort(key=lambda row: -row["p99_um"])
    bent = [row for row in rows if row["aspheres"]]
    goals = [
        lab.Goal(f"99th percentile of the worst {kind}, um", GOAL_UM, some[0]["p99_um"])
        for kind, some in (("lens with aspheres", bent), ("lens", rows))
        if some
    ]
    middle = f"{len(rows)} lenses, {len(bent)} of them aspheric" + (f"; {_median(bent)}." if bent else ".")
    parts = [
        "# float32 beside float64",
        "`python -m experiments precision`",
        middle + _FAR,
        lab.goal_table("goal", goals),
    ]
    text = lab.page(*parts, "Errors on the film, largest 99th percentile first:", lab.table(_COLUMNS, rows, "-"))
    print(lab.write_results(args.out, "precision", text, rows))
    return int(not all(row["p99_um"] <= GOAL_UM for row in bent))  # NaN, too


def _median(rows: list[dict[str, Any]]) -> str:
    return f"the median of these has {np.median([row['p99_um'] for row in rows]):.2g} um at its 99th percentile"
