"""False passes and false blocks of one surrogate a lens, and how far its illumination is from the exact lens's.

Open, closed by two and four stops, and with blades, over every lens that is round about its axis (some minutes of one
core); rows of an earlier run stay where a lens is not chosen. One fit per lens and domain serves every opening: the
exact lens closed by some stops passes what it passes open and what crosses the stop within the smaller opening; so does
the model, by its own stop crossing, as cameras test it outside the graph.
Writes vignetting.md and vignetting.json.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from itertools import groupby
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from experiments import lab
from experiments.lab import Row
from experiments.speed.promises import read_index
from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.model import load_model
from neurolens.models.fit import ModelSettings, fit_model, prepare
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import make_pairs, sample_domain, trace_pairs
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import lens_files
from neurolens.studies.describe import read_quietly
from neurolens.studies.experiment import DomainChoice, LensChoice
from neurolens.studies.measure import onnx_predictor
from neurolens.studies.rays import SEED, false_shares, relative_illumination

# By how many stops the lens is closed, and its blades.
OPENINGS: dict[str, tuple[int, Aperture | None]] = {
    "full": (0, None),
    "2 stops": (2, None),
    "4 stops": (4, None),
    "6 blades": (2, Aperture(blades=6, rotation_deg=10.0)),
}
# Focused at infinity; and the default of `neurolens train --lens`: to the near limit, all of the visible light.
DOMAINS: dict[str, DomainChoice] = {
    "infinity": DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=LIGHT_NM),
    "default": DomainChoice(),
}
MODEL = ModelSettings("ols", terms=64)
_BATCH = 65536


def model_of(file: Path, choice: DomainChoice) -> tuple[LensModel, float, float]:
    """The fitted model of a lens file, the share of the disc that passes, and the seconds for rays and fit together."""
    lens = LensChoice(file).read()
    start = time.perf_counter()
    pairs = make_pairs(lens, choice.of(lens))
    model = fit_model(prepare(pairs), MODEL)
    return model, len(pairs.train) / pairs.tested, time.perf_counter() - start


def opening_errors(lens: Lens, model: LensModel, count: int, seed: int = SEED) -> dict[str, Row]:
    """false_pass, false_block and how many rays pass the exact lens, by name of `OPENINGS`, from one fit and trace."""
    parts: dict[str, list[tuple[Tensor, Tensor]]] = {name: [] for name in OPENINGS}
    for start in range(0, count, _BATCH):
        rays = sample_domain(model.domain, min(_BATCH, count - start), seed, start)
        for name, both in passing(lens, model, rays).items():
            parts[name].append(both)
    joined = {name: [torch.cat(column) for column in zip(*both, strict=True)] for name, both in parts.items()}
    return {name: {**false_shares(a, b), "passing": int(a.sum())} for name, (a, b) in joined.items()}


def passing(lens: Lens, model: LensModel, rays: FilmRays) -> dict[str, tuple[Tensor, Tensor]]:
    """Whether rays pass the exact lens, and whether the model passes them, by name of `OPENINGS`."""
    exact, predicted = trace_pairs(lens, rays, model.domain.pupil_z_mm, power=False), model.predict(rays)
    x, y = exact.cross_x[lens.stop_index], exact.cross_y[lens.stop_index]
    return {
        name: (
            (exact.status == st.PASSED) & _within(x, y, model.domain, name),
            (predicted.status == st.PASSED) & _within(predicted.stop_x, predicted.stop_y, model.domain, name),
        )
        for name in OPENINGS
    }


def _within(x: Tensor, y: Tensor, domain: Domain, name: str) -> Tensor:
    closed, blades = OPENINGS[name]
    radius = domain.stop_radius_mm / math.sqrt(2) ** closed
    if blades is not None:
        return torch.as_tensor(blades.inside(x, y, radius))
    return x * x + y * y <= radius * radius


def measure(file: Path, domain: str, rays: int) -> Row:
    """The row of one lens over one of `DOMAINS`, or the reason why it cannot be measured."""
    row: Row = {"lens": file.stem, "domain": domain}
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


_INTRO = """\
# Vignetting of surrogates

`python -m experiments vignetting`: orthogonal least squares, 64 coefficients per vector, one fit per lens and domain.
False passes over the rays that the model passes / false blocks over those that the exact lens passes, in percent, of
rays uniform over the film and over the bounding disc of passing rays enlarged by 5%; closed by two and four stops, and
by two with six straight blades. *Light*: largest difference of the relative illumination from the exact lens's, in
percent of the exact value on the axis. *Passing*: share of the disc's rays that pass. *Terms*: monomials computed for
all outputs.
"""
_TITLES = {
    "infinity": "Focused at infinity, 400-700 nm",
    "default": "Focused from infinity to the near limit, 380-780 nm or as far as the glasses are stated (the default)",
}


Choose = Callable[[list[float]], float]


def _percent(values: Iterable[float | None], choose: Choose) -> str:
    known = [v for v in values if v is not None]  # None where no ray counts
    return f"{100 * choose(known):.3f}" if known else "-"


def _errors(opening: str, rows: Sequence[Row], choose: Choose) -> str:
    """Both shares of an opening, chosen from those of the rows."""
    shares = ("false_pass", "false_block")
    return " / ".join(_percent((r["openings"][opening][k] for r in rows), choose) for k in shares)


_CHOSEN: dict[str, Callable[[Sequence[Row], Choose], str]] = {n: partial(_errors, n) for n in OPENINGS}
_CHOSEN["light"] = lambda rows, choose: _percent((r["illumination"]["max_difference"] for r in rows), choose)
_COLUMNS = lab.columns(
    ("lens", "lens"),
    *((title, lambda r, cell=cell: cell([r], max)) for title, cell in _CHOSEN.items()),
    ("passing", lambda r: f"{100 * r['passing_share']:.0f}%"),
    ("gates", "gates"),
    ("terms", "monomials"),
    ("s", "seconds", ".1f"),
)


def page(rows: Sequence[Row]) -> str:
    """The tables in Markdown, with the median and the worst of each column."""
    parts = [_INTRO]
    for domain, title in _TITLES.items():
        mine = [r for r in rows if r["domain"] == domain]
        good = [r for r in mine if "failed" not in r]
        lines = [[c.cell(r) for c in _COLUMNS] for r in good]
        for name, choose in (("**median**", median), ("**worst**", max)) if good else ():
            lines.append([name, *(cell(good, choose) for cell in _CHOSEN.values()), *[""] * 4])
        failed = [f"- {r['lens']}: {r['failed']}" for r in mine if "failed" in r]
        made = lab.table([c.title for c in _COLUMNS], lines)
        parts += [f"## {title}", "\n".join([made, *failed])] if mine else []
    return lab.page(*parts)


OPTIONS = (
    lab.count("rays", 100_000, "a lens (default 100000)", 1000),
    lab.ONLY,
    lab.option("--domain", choices=("infinity", "default"), help="one of the two domains (default: both)"),
    lab.option("--lenses", metavar="DIR", type=Path, default=lab.LENSES, help="lens files (default: lenses)"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure the lenses; the table is written after each."""
    files = [f for f in lens_files(args.lenses) if args.only in f.stem and not read_quietly(f).anamorphic]
    if not files:
        raise InputError("experiments vignetting", "--only", args.only, f"part of a lens's name in {args.lenses}")
    domains = [args.domain] if args.domain else DOMAINS
    jobs = {(domain, file.stem): (file, domain) for file in files for domain in domains}
    lab.resume(
        args,
        "vignetting",
        jobs,
        lambda job, report: measure(*job, args.rays),
        lambda row: (row["domain"], row["lens"]),
        page,
        again=True,
    )


# ---- Clipping of the models that ship. -------------------------------------------------------------------------------

_KINDS = ("ols-64", "mlp-16x2")


def measure_models(rows: Sequence[Row], folder: Path, count: int) -> list[Row]:
    """A row for each model of one lens in one state: its false shares, and how many of the rays pass the exact lens."""
    models = [load_model(folder / row["file"]) for row in rows]
    state, domain = rows[0], Domain.from_dict(models[0].card["domain"])
    lens = lab.lens_of(lab.ROOT / state["lens_file"], zoom=state["configuration"], focal_length_mm=state["efl_mm"])
    lens, parts = lens.with_stop_radius(domain.stop_radius_mm), list[tuple[Tensor, Tensor]]()
    for start in range(0, count, _BATCH):
        rays = sample_domain(domain, min(_BATCH, count - start), SEED, start)
        predicted = torch.stack([onnx_predictor(model)(rays).status == st.PASSED for model in models])
        parts.append((trace_pairs(lens, rays, domain.pupil_z_mm, power=False).status == st.PASSED, predicted))
    exact, passed = (torch.cat(part, -1) for part in zip(*parts, strict=True))
    return [
        {"lens": row["entry"], "model": row["model"], "passing": int(exact.sum())} | false_shares(exact, passed[n])
        for n, row in enumerate(rows)
    ]


def clipping_page(rows: Sequence[Row], count: int) -> str:
    """The median and the worst lens of the two models that every lens has, then every model."""

    def both(some: Sequence[Row], choose: Choose = max) -> str:
        chosen = (choose([row[k] or 0.0 for row in some]) for k in ("false_pass", "false_block"))
        return " / ".join(f"{100 * v:.4f}" for v in chosen)

    kinds = {model: [r for r in rows if r["model"] == model] for model in _KINDS}
    ends = [[f"{model}, {name}", both(mine, choose)] for model, mine in kinds.items() if mine
            for name, choose in (("median", median), ("worst", max))]  # fmt: skip
    intro = f"""\
`python -m experiments clipping`: false passes over the rays that a model passes / false blocks over those that the
exact lens passes, in percent, of {count:,} rays a lens. First the polynomials and the networks that every lens has,
then every model."""
    each = [[f"{r['lens']}.{r['model']}", both([r])] for r in rows]
    tables = lab.table("models|false pass / block", ends), lab.table("model|false pass / block", each)
    return lab.page("# Clipping of the models that ship", intro, *tables)


CLIPPING_OPTIONS = (
    lab.count("rays", 1_000_000, "a lens (default 1000000)", 1000),
    lab.ONLY,
    lab.option("--models", metavar="DIR", type=Path, default=lab.MODELS, help="with index.json (default: models)"),
    lab.out(),
)


def run_clipping(args: argparse.Namespace) -> None:
    """Rays that shipped models pass or block wrongly, against exact tracing: networks beside polynomials.

    Rays are uniform over the lit film and the disc that holds the pupil. Cameras leave out parts of that disc where
    nothing passes, which changes no share of the passing rays. Writes clipping.md and clipping.json.
    """
    lab.quiet_glasses()
    known = [r for r in read_index(args.models) if not r.get("axes") and args.only in r["file"]]
    groups = {entry: list(group) for entry, group in groupby(known, lambda r: r["entry"])}
    lab.resume(
        args, "clipping", groups, lambda group, report: measure_models(group, args.models, args.rays),
        lambda row: row["lens"], lambda rows: clipping_page(rows, args.rays), again=True,
        order=list(dict.fromkeys(r["entry"] for r in read_index(args.models))),
    )  # fmt: skip
