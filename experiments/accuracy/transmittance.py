"""Transmittance with the polarisation that each surface gives to the light, and averaged over it at every surface.

Each lens of lenses/ in its own state, wide open: rays of its whole image circle, 400 to 700 nm, that pass; bare as
filed, and with a quarter wave of magnesium fluoride on every surface between glass and air. Writes transmittance.md and
transmittance.json.
"""

from __future__ import annotations

import argparse
import math
from statistics import median
from typing import Any

import torch

from experiments import lab
from neurolens.base import status as st
from neurolens.models.fitted import Domain
from neurolens.models.pairs import domain_of, sample_domain
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.rays import follow

COATINGS = {"bare": None, "coated": "quarter-wave"}


def difference(lens: Lens, domain: Domain, count: int) -> lab.Row:
    """The difference of the averaged transmittance from the true one: the largest, its place, the median."""
    rays = sample_domain(domain, count, seed=3)
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, domain.pupil_z_mm)
    steps: Any = [(k, "T") for k in reversed(range(len(lens.surfaces)))]
    with torch.no_grad():
        traced = [follow(lens, start, steps, rays.wavelength_nm, towards="scene", polarised=p) for p in (False, True)]
    passed = traced[1].status == st.PASSED
    averaged, true = (one.power[passed] for one in traced)
    off = averaged - true
    relative = (off / true).abs()
    worst = int(relative.argmax())
    radius = torch.hypot(rays.film_x, rays.film_y)[passed] / domain.film_radius_mm
    figures = {"relative": relative, "averaged": averaged, "true": true, "film_radius": radius}
    at_worst = {name: float(values[worst]) for name, values in figures.items()}
    return {"absolute": float(off.abs().max()), **at_worst, "median": float(relative.median())}


_COLUMNS = lab.columns(
    ("lens", "lens"),
    ("refractions", "refractions"),
    *((f"{kind}: most", f"{kind}.absolute", ".4f") for kind in COATINGS),
    *((f"{kind}: most, %", f"{kind}.relative", ".2f", 100) for kind in COATINGS),
    ("there, of the film radius", "bare.film_radius", ".2f"),
    ("averaged", "bare.averaged", ".3f"),
    ("true", "bare.true", ".3f"),
    *((f"{kind}: median, %", f"{kind}.median", ".3f", 100) for kind in COATINGS),
)
OPTIONS = (lab.count("rays", 12_000, "of each lens's domain (default 12,000)"), lab.ONLY, lab.out())


def run(args: argparse.Namespace) -> None:
    """Measure and write."""
    lab.quiet_glasses()
    rows = list[lab.Row]()
    files = lab.chosen(lab.historical(), lambda file: file.stem, args.only, "transmittance")
    for file in lab.counted(files, "lenses", args.quiet):
        lens = lab.lens_of(file.stem)
        domain = domain_of(lens, focus_m=(math.inf, math.inf))
        each = {kind: coated(lens, design) if design else lens for kind, design in COATINGS.items()}
        figures = {kind: difference(one, domain, args.rays) for kind, one in each.items()}
        rows.append({"lens": file.stem, "refractions": lens.refractions} | figures)
    about = [
        f"- {kind}: at most {100 * max(r[kind]['relative'] for r in rows):.1f}%, of the worst ray of each lens "
        f"{100 * median(r[kind]['relative'] for r in rows):.2f}% and of the median ray "
        f"{100 * median(r[kind]['median'] for r in rows):.3f}% (medians of {len(rows)} lenses)"
        for kind in COATINGS
    ]
    text = lab.page(
        "# Transmittance: averaged over polarisation at every surface, and true",
        f"`python -m experiments transmittance`: {args.rays} rays of each lens's domain. How far the product of\n"
        "(Ts + Tp) / 2 is from the power of unpolarised light whose polarisation is followed.",
        "\n".join(about),
        lab.table(_COLUMNS, rows),
    )
    print(lab.write_results(args.out, "transmittance", text, {"lenses": rows}))
