"""Vignetting of the library's surrogates: false passes and blocks at several openings, and relative illumination.

One fit per lens and domain serves every opening. The exact lens closed by some stops, or with blades, passes what it
passes open and what crosses the stop within the smaller opening; so does the model, by its own stop crossing, as
cameras test it outside the graph.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments import lab
from neurolens.analysis.plot_style import FIELD_COLOURS, INK, drawing
from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.progress import Progress
from neurolens.commands.arguments import whole
from neurolens.evaluate.describe import lens_files, read_quietly
from neurolens.evaluate.experiment import DomainChoice, LensChoice
from neurolens.evaluate.vignetting import SEED, false_shares, relative_illumination
from neurolens.optics.apertures import Aperture
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model, prepare
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import make_pairs, trace_pairs

# Stops closed, and the blades if any.
OPENINGS: dict[str, tuple[int, Aperture | None]] = {
    "full": (0, None),
    "2 stops": (2, None),
    "4 stops": (4, None),
    "6 blades": (2, Aperture(blades=6, rotation_deg=10.0)),
}
# Focused at infinity; and the default of `neurolens train --lens`: to the near limit, all of the visible light.
DOMAINS: dict[str, DomainChoice] = {
    "infinity": DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=(400.0, 700.0)),
    "default": DomainChoice(),
}
MODEL = ModelSettings("ols", terms=64)
_BATCH = 65536


def model_of(file: Path, choice: DomainChoice) -> tuple[LensModel, float, float]:
    """The fitted model of a lens file, the share of its disc that passes, and the seconds of rays and fit together."""
    lens = LensChoice(file).read()
    start = time.perf_counter()
    pairs = make_pairs(lens, choice.of(lens))
    model = fit_model(prepare(pairs), MODEL)
    return model, len(pairs.train) / pairs.tested, time.perf_counter() - start


def opening_errors(lens: Lens, model: LensModel, count: int, seed: int = SEED) -> dict[str, dict[str, float | None]]:
    """false_pass, false_block and the rays that pass the exact lens, by name of `OPENINGS`; one fit, one trace."""
    right: dict[str, list[Tensor]] = {name: [] for name in OPENINGS}
    said: dict[str, list[Tensor]] = {name: [] for name in OPENINGS}
    stop = lens.stop_index
    for start in range(0, count, _BATCH):
        rays = sample_domain(model.domain, min(_BATCH, count - start), seed, start)
        exact, found = trace_pairs(lens, rays, model.domain.pupil_z_mm), model.predict(rays)
        for name in OPENINGS:
            open_ = _within(exact.cross_x[stop], exact.cross_y[stop], model.domain, name)
            right[name].append((exact.status == st.PASSED) & open_)
            said[name].append((found.status == st.PASSED) & _within(found.stop_x, found.stop_y, model.domain, name))
    joined = {name: (torch.cat(right[name]), torch.cat(said[name])) for name in OPENINGS}
    return {name: {**false_shares(a, b), "passing": int(a.sum())} for name, (a, b) in joined.items()}


def _within(x: Tensor, y: Tensor, domain: Domain, name: str) -> Tensor:
    closed, blades = OPENINGS[name]
    radius = domain.stop_radius_mm / math.sqrt(2) ** closed
    if blades is not None:
        return torch.as_tensor(blades.inside(x, y, radius))
    return x * x + y * y <= radius * radius


def measure(file: Path, domain: str, rays: int) -> dict[str, Any]:
    """One row: of one lens over one of `DOMAINS`; a lens that cannot be measured has its reason."""
    row: dict[str, Any] = {"lens": file.stem, "domain": domain}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)
        try:
            model, share, seconds = model_of(file, DOMAINS[domain])
            light = relative_illumination(model.lens, model.domain, model.predict, points=8192, rows=9)
            row |= {
                "passing_share": share,
                "gates": len(model.gates),
                "monomials": len(getattr(model.core, "exponents", ())),
                "seconds": seconds,
                "openings": opening_errors(model.lens, model, rays),
                "illumination": asdict(light),
            }
        except NeurolensError as error:
            row["failed"] = str(error)
    return row


def measure_all(
    files: Sequence[Path], domains: Sequence[str], rays: int, folder: Path, report: Callable[[float], None]
) -> list[dict[str, Any]]:
    """Measure and write after every lens; rows of other lenses in the folder's vignetting.json stay.

    Returns all rows.

    Raises:
        InputError: a vignetting.json that holds something else.
    """
    target = folder / "vignetting.json"
    try:
        known = json.loads(target.read_text(encoding="utf-8")) if target.exists() else []
        rows = {(r["lens"], r["domain"]): r for r in known}
    except (ValueError, KeyError, TypeError) as error:
        expected = "rows of experiments vignetting"
        raise InputError(target, "file", f"({type(error).__name__})", expected) from error
    jobs = [(file, domain) for file in files for domain in domains]
    for i, (file, domain) in enumerate(jobs):
        rows[file.stem, domain] = measure(file, domain, rays)
        done = sorted(rows.values(), key=lambda r: (r["domain"], r["lens"]))
        lab.write_results(folder, "vignetting", page(done), done)
        report((i + 1) / len(jobs))
    return sorted(rows.values(), key=lambda r: (r["domain"], r["lens"]))


_INTRO = """\
# Vignetting of surrogates

`python -m experiments vignetting`: orthogonal least squares, 64 coefficients per vector, one fit per lens and domain.
False passes over the rays that the model passes / false blocks over those that the exact lens passes, in percent, of
rays uniform over the film and over the bounding disc of passing rays enlarged by 5%; closed by two and four stops, and
by two with six straight blades. *Light*: largest difference of the relative illumination from the exact lens's, in
percent of the exact value on the axis. *Passing*: share of the disc's rays that pass. *Terms*: monomials computed for
all outputs.
"""
_ABOUT = {
    "infinity": "Focused at infinity, 400-700 nm",
    "default": "Focused from infinity to the near limit, 380-780 nm or as far as the glasses are stated (the default)",
}


def page(rows: Sequence[dict[str, Any]]) -> str:
    """The tables in Markdown, with the median and the worst of each column."""
    parts = [_INTRO]
    for domain, title in _ABOUT.items():
        mine = [r for r in rows if r["domain"] == domain]
        good = [r for r in mine if "failed" not in r]
        if not mine:
            continue
        head = ["lens", *OPENINGS, "light", "passing", "gates", "terms", "s"]
        lines = [_line(r) for r in good]
        for name, choose in (("**median**", statistics.median), ("**worst**", max)):
            if good:
                lines.append(_summary(name, choose, good))
        failed = [f"- {r['lens']}: {r['failed']}" for r in mine if "failed" in r]
        parts.append("\n".join([f"## {title}\n", lab.table(head, lines), *failed]) + "\n")
    return "\n".join(parts)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.3f}"


def _line(row: dict[str, Any]) -> list[str]:
    pairs = [f"{_percent(o['false_pass'])} / {_percent(o['false_block'])}" for o in row["openings"].values()]
    light = _percent(row["illumination"]["max_difference"])
    rest = [f"{100 * row['passing_share']:.0f}%", str(row["gates"]), str(row["monomials"]), f"{row['seconds']:.1f}"]
    return [row["lens"], *pairs, light, *rest]


def _summary(name: str, choose: Callable[[list[float]], float], rows: Sequence[dict[str, Any]]) -> list[str]:
    cells = []
    for opening in OPENINGS:
        both = ([r["openings"][opening][k] for r in rows] for k in ("false_pass", "false_block"))
        known = ([v for v in values if v is not None] for values in both)  # None where no ray counts
        cells.append(" / ".join(_percent(choose(values) if values else None) for values in known))
    cells.append(_percent(choose([r["illumination"]["max_difference"] for r in rows])))
    return [name, *cells, "", "", "", ""]


_RADII = (0.0, 0.4, 0.7, 0.9, 1.0)  # shares of the film radius
_POINTS = 200
_EXACT, _MODEL = "#cfd8e3", "#d55e00"
_SHOWN = ("full", "6 blades")


def cats_eyes(models: Sequence[LensModel], path: Path) -> Path:
    """Draw a row per model: exact passing pupils filled, the model's outlined, open and with blades two stops down."""
    with drawing(path, 2.1 * len(_RADII), 2.2 * len(models) + 0.5) as figure:
        grid = figure.subplots(len(models), len(_RADII), squeeze=False)
        for axes_row, model in zip(grid, models, strict=True):
            for axes, share in zip(axes_row, _RADII, strict=True):
                _draw(axes, model, share)
                axes.set_title(f"{share * model.domain.film_radius_mm:.1f} mm", fontsize=8)
            axes_row[0].set_ylabel(model.lens.name[:28], fontsize=8)
        figure.suptitle(
            "Passing pupil by film radius: exact (filled), model (outline); open, and 6 blades 2 stops down", fontsize=9
        )
    return Path(path)


def _draw(axes: Any, model: LensModel, share: float) -> None:
    u, v, exact, said = pupil_masks(model, share)
    for k, name in enumerate(_SHOWN):
        if exact[name].any():
            fill = _EXACT if k == 0 else FIELD_COLOURS[0]
            axes.contourf(u, v, exact[name].astype(float), levels=[0.5, 2.0], colors=[fill], alpha=1.0 - 0.55 * k)
        if said[name].any():
            axes.contour(u, v, said[name].astype(float), levels=[0.5], colors=[_MODEL], linewidths=0.9)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=6, colors=INK)


def pupil_masks(
    model: LensModel, share: float, points: int = _POINTS
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Grids u and v [points, points] of the pupil plane, mm, and what passes there, exact and by the model.

    From a film point at `share` of the film radius along +x, on the first film plane, at the middle wavelength; masks
    by name of opening.
    """
    b, d = model.domain.bounds, model.domain
    row = min(len(b.low_mm) - 1, round(share * (len(b.low_mm) - 1)))
    low, high, half = b.low_mm[row], b.high_mm[row], b.half_mm[row]
    if low >= high:
        low, high, half = -d.pupil_radius_mm, d.pupil_radius_mm, d.pupil_radius_mm
    reach = 1.08 * max((high - low) / 2, half)
    grid = torch.linspace(-reach, reach, points, dtype=torch.float64)
    u, v = (t.reshape(-1) for t in torch.meshgrid(grid + (low + high) / 2, grid, indexing="xy"))
    film_x = torch.full_like(u, share * d.film_radius_mm)
    wavelength = torch.full_like(u, sum(d.wavelength_nm) / 2)
    rays = FilmRays(film_x, torch.zeros_like(u), torch.full_like(u, d.film_z_mm[0]), u, v, wavelength)
    traced, found, stop = trace_pairs(model.lens, rays, d.pupil_z_mm), model.predict(rays), model.lens.stop_index
    exact: dict[str, np.ndarray] = {}
    said: dict[str, np.ndarray] = {}
    for name, (closed, blades) in OPENINGS.items():
        radius = d.stop_radius_mm / math.sqrt(2) ** closed
        both = (
            (exact, traced.status, traced.cross_x[stop], traced.cross_y[stop]),
            (said, found.status, found.stop_x, found.stop_y),
        )
        for masks, status, x, y in both:
            within = x * x + y * y <= radius**2 if blades is None else torch.as_tensor(blades.inside(x, y, radius))
            masks[name] = ((status == st.PASSED) & within).reshape(points, points).numpy()
    return u.reshape(points, points).numpy(), v.reshape(points, points).numpy(), exact, said


ABOUT = """\
False passes and false blocks of one surrogate a lens: open, closed by two and four stops, and with
blades; and how far its relative illumination is from the exact lens's. Over every lens that is round
about its axis (some minutes of one core). Rows of an earlier run stay where a lens is not chosen.
Writes vignetting.md, vignetting.json and vignetting.png (cat's eyes, exact and of the model)."""
_DRAWN = ("laikin_double_gauss_50", "tajima_retrofocus_24", "isshiki_fisheye_10", "shimizu_fisheye_220")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m experiments vignetting`."""
    parser.add_argument("--rays", metavar="N", type=whole(1000), default=100_000, help="a lens (default 100000)")
    lab.add_only(parser)
    parser.add_argument("--domain", choices=("infinity", "default"), help="one of the two domains (default: both)")
    parser.add_argument("--lenses", metavar="DIR", type=Path, default=lab.LENSES, help="lens files (default: lenses)")
    lab.add_out(parser)


def run(args: argparse.Namespace) -> int:
    """Measure the lenses, draw four of them."""
    files = [f for f in lens_files(args.lenses) if args.only in f.stem and not read_quietly(f).anamorphic]
    if not files:
        raise InputError("experiments vignetting", "--only", args.only, f"part of a lens's name in {args.lenses}")
    domains = [args.domain] if args.domain else list(DOMAINS)
    with Progress(quiet=args.quiet).stage("vignetting") as report:
        rows = measure_all(files, domains, args.rays, args.out, lambda share: report(0.9 * share))
        drawn = [f for f in files if f.stem in _DRAWN] or files[:1]
        if not args.only or not (args.out / "vignetting.png").exists():
            cats_eyes([model_of(f, DOMAINS["infinity"])[0] for f in drawn], args.out / "vignetting.png")
    print(page(rows))
    return 0
