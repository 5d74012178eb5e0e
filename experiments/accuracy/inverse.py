"""Fit a model to every lens file, and count the rays that three Newton steps do not find.

Beside it Newton's method as published (Hanika and Dachsbacher 2014; Schrade et al. 2016): from the first-order map,
undamped, a fixed number of steps, with the Jacobian of the polynomial. Both work on the same model, so that only the
iteration differs. 10 to 30 s a lens; lenses that are in the table are kept. Writes inverse.md and inverse.json.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from experiments.lab import Report, Row
from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.graph.derive import solve, with_jacobian
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.cores import Array
from neurolens.models.fit import ModelSettings, fit_model, prepare
from neurolens.models.fitted import Domain
from neurolens.models.inverse import (
    STEPS,
    TOLERANCE,
    InverseModel,
    convergence,
    front_index,
    inverse_of,
    scene_system,
    stop_system,
)
from neurolens.models.model import LensModel
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.models.terms import pinned_threads
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.surfaces import Rays, front_rays
from neurolens.studies.experiment import LensChoice

PUBLISHED_STEPS = (3, 5, 10, 20)
# A residual beyond this (in stop radii; of the front's radius, in radians) counts as diverged, not just missed.
AWAY = 1.0
# Points per side of the grid of starts in the search for rays that an inverse map did not find.
_STARTS = 7


Given = dict[str, NDArray[np.float64]]


def measure_lens(file: Path, rays: int, terms: int = 64) -> Row:
    """One record: lens, focus_m, and the shares of rays that each iteration finds.

    Args:
        rays: that pass the lens (a tenth otherwise than by three steps).

    Raises:
        InputError: a lens that cannot be fitted.
    """
    with pinned_threads(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)
        lens = LensChoice(file).read()
        domain = _domain(lens)
        known = prepare(make_pairs(lens, domain, PairSettings(train=15000, held_out=rays, rim=15000)))
        model = fit_model(known, ModelSettings("ols", terms=terms))
        start = time.perf_counter()
        inverse = inverse_of(model)
        seconds = time.perf_counter() - start
        held_out = known.pairs.held_out.inputs
        every = held_out.rows.numpy(), held_out.film_z.numpy()
        few = every[0][:, : rays // 10], every[1][: rays // 10]
        return {
            "lens": file.stem,
            "focus_m": ["inf" if math.isinf(f) else f for f in domain.focus_m],
            "fit": {"seconds": seconds},
            "ours": {t: convergence(inverse, every[0].astype(t), every[1].astype(t)) for t in ("float64", "float32")},
            "two_steps": convergence(inverse, *few, steps=2),
            "published": _published(inverse, *few),
            "rays": rays,
        }


def _domain(lens: Lens) -> Domain:
    """The domain from infinity to 14 focal lengths, or of infinity alone where that is nearer than the near limit."""
    try:
        return domain_of(lens, focus_m=(math.inf, 14e-3 * abs(first_order(lens).efl_mm)))
    except InputError:
        return domain_of(lens)


def _published(inverse: InverseModel, rays: Array, film_z: Array) -> dict[str, Any]:
    """For both maps: shares of the model's passing rays not found after each count of steps, and run away."""
    model = inverse.model
    radius = np.full((1, 1), model.domain.stop_radius_mm)
    forward = evaluate(model.graph, {"rays": rays, "film_z_mm": film_z[None], "stop_radius_mm": radius})
    passed = forward["status"][0] == st.PASSED
    rays, film_z, scene_ray = rays[:, passed], film_z[passed], forward["scene_ray"][:, passed]
    known, _ = front_rays(model.front, Rays(*scene_ray), index=front_index(model), wavelength_nm=rays[4])
    wanted = np.concatenate([known[:2] / model.scales.position_mm, known[2:]])
    scene = _plain(scene_system(model), {"wanted": wanted, "wavelength_nm": rays[4:]})
    stop = _stop_inputs(model, rays, film_z, forward["stop_xy_mm"][:, passed])
    return {"stop": _plain(stop_system(model), stop), "scene": scene}


def _stop_inputs(model: LensModel, rays: Array, film_z: Array, stop: Array) -> Given:
    wanted = stop / model.scales.stop_mm
    return {"film": rays[:2], "wanted": wanted, "wavelength_nm": rays[4:], "film_z_mm": film_z[None]}


def _plain(system: Graph, given: Given) -> dict[str, Any]:
    """Newton's method without limits; the system's inputs but the unknowns are given."""
    both, step = with_jacobian(system), Graph()
    unknowns = both.outputs["residual"].rows
    residual, *columns = (step.input(name, value.rows) for name, value in both.outputs.items())
    step.outputs["step"] = solve(columns, residual)
    # The first-order map's own solution is the start: linear, it takes one step from the axis.
    axis = {name: 0 * value if name in ("film", "wanted") else value for name, value in given.items()}
    x = np.zeros((unknowns, given["wavelength_nm"].shape[1]))
    jacobian = evaluate(both, {"unknown": x, **axis})
    x = x - evaluate(step, jacobian | evaluate(system, {"unknown": x, **given}))["step"]
    found: dict[str, Any] = {"missed": {}, "away": {}}
    with np.errstate(all="ignore"):
        for count in range(1, max(PUBLISHED_STEPS) + 1):
            x = x - evaluate(step, evaluate(both, {"unknown": x, **given}))["step"]
            if count in PUBLISHED_STEPS:
                size = np.linalg.norm(evaluate(system, {"unknown": x, **given})["residual"], axis=0)
                found["missed"][str(count)] = float((~(size < TOLERANCE)).mean())  # NaN is missed
                found["away"][str(count)] = float((~(size < AWAY)).mean())
    return found


_INTRODUCTION = """\
# Inverse maps

`python -m experiments inverse`

Rays that pass each lens (full aperture and field, 400-700 nm, infinity to 14 focal lengths);
share of them, in percent, that an iteration does not find ({tolerance:g} of the stop's radius; of the front's radius
and in radians). Published (Hanika and Dachsbacher 2014, Schrade et al. 2016): Newton from the first-order map,
undamped, 3 / 5 / 10 / 20 steps; "away": residual above 1 after 20. Ours: direct fit, then {steps} limited steps (two
for comparison). "other": another ray through the same point (the map is folded in the lens itself, and one ray of two
is found). Both on the same model (64 coefficients)."""


def _share(title: str, path: str, rest: bool = False) -> lab.Column:
    """A share in percent; `rest`: what is missing to 1."""

    def cell(row: Row) -> str:
        share = 1 - lab.look_up(row, path) if rest else lab.look_up(row, path)
        return "0" if share < 5e-7 else f"{100 * share:.4f}" if share < 0.01 else f"{100 * share:.2f}"

    return lab.Column(title, cell)


_MAPS = {"stop": "Film point and stop point to ray", "scene": "Scene ray to film"}


def _map_columns(which: str) -> list[lab.Column]:
    return [
        *lab.columns(("lens", "lens"), ("rays", "rays")),
        *(_share(f"published: {n}", f"published.{which}.missed.{n}") for n in PUBLISHED_STEPS),
        _share("away", f"published.{which}.away.{PUBLISHED_STEPS[-1]}"),
        _share("ours: 2", f"two_steps.{which}.converged", rest=True),
        _share("3", f"ours.float64.{which}.converged", rest=True),
        _share("3, float32", f"ours.float32.{which}.converged", rest=True),
        _share("other", f"ours.float64.{which}.other"),
        lab.Column("fit s", "fit.seconds", ".1f"),
    ]


def page(records: Sequence[Row]) -> str:
    """The tables in Markdown."""
    done = [r for r in records if "ours" in r]
    parts = [_INTRODUCTION.format(steps=STEPS, tolerance=TOLERANCE)]
    for which, title in _MAPS.items():
        parts += [f"## {title}", lab.table(_map_columns(which), done)]
    refused = [f"- {r['lens']}: {r['refused']}" for r in records if "refused" in r]
    return lab.page(*parts, *(["Not measured:", "\n".join(refused)] if refused else []))


OPTIONS = (lab.ONLY, lab.count("rays", 100_000, "per lens (default: 100000)", 1000), lab.AGAIN, lab.out())


def run(args: argparse.Namespace) -> None:
    """Measure what is missing, and write the tables after each lens."""

    def measured(file: Path, report: Report) -> Row:
        try:
            return measure_lens(file, args.rays)
        except InputError as error:
            return {"lens": file.stem, "refused": str(error).removeprefix(f"{lab.ROOT}/")}

    files = lab.chosen(lab.historical(), lambda f: f.stem, args.only, "inverse")
    chosen = {file.stem: file for file in files}
    lab.resume(args, "inverse", chosen, measured, lambda r: r["lens"], page, listed="lenses", again=args.restart)
