"""Rays that shipped models pass or block wrongly, against exact tracing: networks beside polynomials.

Rays are uniform over the lit film and the disc that holds the pupil. Cameras leave out parts of that disc where nothing
passes, which changes no share of the passing rays. A ray points backwards where no ray does that the exact lens
passes; for a fisheye, where it is a twentieth further from the axis than all of those.
Writes clipping.md and clipping.json.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from statistics import median

import torch

from experiments import lab
from experiments.lab import Row
from experiments.promises import read_index
from neurolens.base import status as st
from neurolens.cameras.model import load_model
from neurolens.study.measure import onnx_predictor
from neurolens.study.vignetting import SEED, false_shares
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import trace_pairs

_BATCH = 65536
_SHARES, _KINDS = ("false_pass", "false_block"), ("ols-64", "mlp-16x2")


def measure(rows: Sequence[Row], folders: Sequence[Path], count: int) -> list[Row]:
    """A row for each model of one lens: `folder 0`, `folder 1` ... hold the figures of the file in each folder."""
    models = [load_model(folder / row["file"]) for row in rows for folder in folders]
    state, domain = rows[0], Domain.from_dict(models[0].card["domain"])
    lens = lab.lens_of(lab.ROOT / state["lens_file"], zoom=state["configuration"], focal_length_mm=state["efl_mm"])
    lens, parts, widest = lens.with_stop_radius(domain.stop_radius_mm), list[tuple[torch.Tensor, ...]](), -1.0
    for start in range(0, count, _BATCH):
        rays = sample_domain(domain, min(_BATCH, count - start), SEED, start)
        exact, predicted = trace_pairs(lens, rays, domain.pupil_z_mm), [onnx_predictor(model)(rays) for model in models]
        passes = exact.status == st.PASSED
        widest = max(widest, float(torch.where(passes, exact.scene.dz, -1.0).max()))
        ahead = [torch.where(m.status == st.PASSED, m.rays.dz, -1.0) for m in predicted]
        parts.append((passes, torch.stack([m.status == st.PASSED for m in predicted]), torch.stack(ahead)))
    exact_passes, model_passes, dz = (torch.cat(part, -1) for part in zip(*parts, strict=True))
    limit = 0.0 if widest < 0 else -math.cos(min(1.05 * math.acos(-widest), math.pi))
    figures = [
        {**false_shares(exact_passes, s), "backwards": int((d > limit).sum())}
        for s, d in zip(model_passes, dz, strict=True)
    ]
    made, each = list[Row](), len(folders)
    for n, row in enumerate(rows):
        about = {"lens": row["entry"], "model": row["model"], "passing": int(exact_passes.sum())}
        made.append(about | {f"folder {k}": one for k, one in enumerate(figures[each * n : each * (n + 1)])})
    return made


def _cells(rows: Sequence[Row], keys: Sequence[str], choose: Callable[[list[float]], float] = max) -> list[str]:
    """Both shares in percent at each of the keys, chosen from those of the rows, then the rays that point backwards."""
    shares = [[choose([row[at][k] or 0.0 for row in rows]) for k in _SHARES] for at in keys]
    pairs = [" / ".join(f"{100 * v:.4f}" for v in pair) for pair in shares]
    return [*pairs, *(str(sum(row[at]["backwards"] for row in rows)) for at in keys)]


def page(rows: Sequence[Row], titles: Sequence[str], count: int) -> str:
    """The median and the worst lens of the two models that every lens has, then every model."""
    keys, lines = [f"folder {k}" for k in range(len(titles))], []
    for model in _KINDS:
        mine = [r for r in rows if r["model"] == model]
        for name, choose in (("median", median), ("worst", max)) if mine else ():
            lines.append([f"{model}, {name}", *_cells(mine, keys, choose)])
    header = [*titles, *(f"backwards, {title}" for title in titles)]
    each = [[f"{r['lens']}.{r['model']}", *_cells([r], keys)] for r in rows]
    intro = f"""\
`python -m experiments clipping`: false passes over the rays that a model passes / false blocks over those that the
exact lens passes, in percent, of {count:,} rays a lens; passed rays that point backwards. First the polynomials and the
networks that every lens has, then every model."""
    parts = [lab.table(["models", *header], lines), lab.table(["model", *header], each)]
    return lab.page("# Clipping of the models that ship", intro, *parts)


OPTIONS = (
    lab.count("rays", 1_000_000, "a lens (default 1000000)", 1000),
    lab.ONLY,
    lab.option("--models", metavar="DIR", type=Path, default=lab.MODELS, help="with index.json (default: models)"),
    lab.option("--before", metavar="DIR", type=Path, help="earlier files of the same names, to be measured as well"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure lens by lens; the tables are written after each."""
    lab.quiet_glasses()
    folders, titles = [args.models], ["now"]
    if args.before:
        folders, titles = [args.before, args.models], ["before", "now"]
    known = [r for r in read_index(args.models) if not r.get("axes") and args.only in r["file"]]
    groups = [list(group) for _, group in groupby(known, lambda r: r["entry"])]
    rows, text = list[Row](), ""
    for group, _ in lab.stages(groups, lambda g: g[0]["entry"], args.quiet):
        rows += measure(group, folders, args.rays)
        text = lab.write_results(args.out, "clipping", page(rows, titles, args.rays), {"folders": titles, "rows": rows})
    print(text)
