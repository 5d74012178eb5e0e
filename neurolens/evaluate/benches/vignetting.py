"""Vignetting of the library's surrogates: false passes and blocks at several openings, and relative illumination.

One fit a lens and domain serves every opening. The exact lens closed by some stops, or with blades, passes what it
passes open and what crosses the stop within the smaller opening; so does the model, by its own stop crossing, as
cameras test it outside the graph.
"""

from __future__ import annotations

import json
import math
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.experiment import DomainChoice, LensChoice
from neurolens.evaluate.vignetting import SEED, false_shares, relative_illumination
from neurolens.optics.apertures import Aperture
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain, sample_domain
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
                "illumination": light,
            }
        except NeurolensError as error:
            row["failed"] = str(error)
    return row


def run(
    files: Sequence[Path],
    domains: Sequence[str],
    rays: int,
    folder: Path,
    report: Callable[[float], None],
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
        expected = "rows of neurolens bench vignetting"
        raise InputError(target, "file", f"({type(error).__name__})", expected) from error
    jobs = [(file, domain) for file in files for domain in domains]
    folder.mkdir(parents=True, exist_ok=True)
    for i, (file, domain) in enumerate(jobs):
        rows[file.stem, domain] = measure(file, domain, rays)
        done = sorted(rows.values(), key=lambda r: (r["domain"], r["lens"]))
        atomic_write_text(target, json.dumps(done, indent=1, allow_nan=False) + "\n")
        atomic_write_text(folder / "vignetting.md", page(done))
        report((i + 1) / len(jobs))
    return sorted(rows.values(), key=lambda r: (r["domain"], r["lens"]))


_INTRO = """\
# Vignetting of surrogates

`neurolens bench vignetting`: orthogonal least squares, 64 coefficients a vector, one fit a lens and domain. False
passes over the rays that the model passes / false blocks over those that the exact lens passes, in percent, of rays
uniform over the film and over the bounding disc of passing rays enlarged by 5%; closed by two and four stops, and by
two with six straight blades. *Light*: largest difference of the relative illumination from the exact lens's, in percent
of the exact value on the axis. *Passing*: share of the disc's rays that pass. *Terms*: monomials computed for all
outputs.
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
        lines = [f"## {title}\n", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        lines += [_line(r) for r in good]
        for name, choose in (("**median**", statistics.median), ("**worst**", max)):
            if good:
                lines.append(_summary(name, choose, good))
        lines += [f"- {r['lens']}: {r['failed']}" for r in mine if "failed" in r]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.3f}"


def _line(row: dict[str, Any]) -> str:
    pairs = [f"{_percent(o['false_pass'])} / {_percent(o['false_block'])}" for o in row["openings"].values()]
    light = _percent(row["illumination"]["max_difference"])
    rest = [f"{100 * row['passing_share']:.0f}%", str(row["gates"]), str(row["monomials"]), f"{row['seconds']:.1f}"]
    return "| " + " | ".join([row["lens"], *pairs, light, *rest]) + " |"


def _summary(name: str, choose: Callable[[list[float]], float], rows: Sequence[dict[str, Any]]) -> str:
    cells = []
    for opening in OPENINGS:
        both = ([r["openings"][opening][k] for r in rows] for k in ("false_pass", "false_block"))
        known = ([v for v in values if v is not None] for values in both)  # None where no ray counts
        cells.append(" / ".join(_percent(choose(values) if values else None) for values in known))
    cells.append(_percent(choose([r["illumination"]["max_difference"] for r in rows])))
    return "| " + " | ".join([name, *cells, "", "", "", ""]) + " |"
