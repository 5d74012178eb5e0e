"""Fit every kind of surrogate on the same rays of each lens; measure errors, size and time against the exact tracer.

Lenses are files, or names in lenses/. Without LENS: laikin_double_gauss_50 (a standard lens), ogawa_zoom_70_200 (a long
zoom), schaefter_primoplan_100 (hard for its aperture), horimoto_fisheye_16 and phone_lens_6 (steep aspheres).

The folder holds summary.md (the median and the worst over the lenses), LENS.md and LENS.png, records/, models/ (ONNX)
and config.json. Records of the same settings and version are kept, so that an interrupted run resumes where it stopped.
A method that fails on a lens is a row with the reason.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.accuracy.methods import GROUPS, QUICK_STEPS, Bench, BenchSettings, chosen_rows, run_bench
from experiments.accuracy.published import NAMED
from experiments.lab import markdown_table
from neurolens.base.errors import InputError, printable
from neurolens.base.files import atomic_write_text, write_json
from neurolens.base.progress import Progress
from neurolens.base.report import plain
from neurolens.base.settings import LIGHT_NM, add_options, whole
from neurolens.cli.arguments import Reporting, check_ids, check_written, named_lens
from neurolens.graph.scalars import MOST_WEIGHTS
from neurolens.models.pairs import PairSettings
from neurolens.studies.experiment import DomainChoice, EvaluationChoice, LensChoice
from neurolens.studies.pages import DASH, Column, Record, number, show
from neurolens.studies.plots import Kinds, trade_plot
from neurolens.studies.records import versions

DEFAULT_LENSES = (
    "laikin_double_gauss_50", "ogawa_zoom_70_200", "schaefter_primoplan_100", "horimoto_fisheye_16", "phone_lens_6"
)  # fmt: skip
OPTIONS = (
    lab.option(
        "lenses", metavar="LENS", nargs="*", type=partial(named_lens, False, False),
        help="lens file of any format, or its name in lenses/",
    ),
    lab.option("--library", action="store_true", help="every lens file of lenses/"),
    lab.option(
        "--methods", metavar="METHOD", nargs="+", default=[],
        help="rows by name, or groups: paraxial, published, ours, ablations (default: the first three)",
    ),
    lab.option("--near", action="store_true", help="focus from infinity to the near limit, not infinity alone"),
    lab.option(
        "--quick", action="store_true",
        help="a row or two a method, 6000 rays, 3 rounds, less training: rough figures in 3 minutes",
    ),
    lab.option("--rays", metavar="N", type=whole(1000, 10**6), help="rays of fits and errors (default 30000)"),
    lab.option("--seed", metavar="N", type=whole(0), default=1, help="seed of the rays (default 1)"),
    lab.option("--rounds", metavar="N", type=whole(0), help="rounds of the race, 0 for none (default 10)"),
    lab.option("--restart", action="store_true", help="make the records of the chosen rows again"),
    lab.out(lab.ROOT / "runs" / "surrogates", "folder"),
    lambda parser: add_options(parser, Reporting, ("glass",)),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Make the missing records, and write the pages after every lens."""
    rows, settings, out = chosen_rows(args.methods, args.quick), _settings(args), args.out
    benches = [Bench(LensChoice(Path(file)), settings, out) for file in _lenses(args)]
    check_written(out, "--output", "FOLDER")
    for bench in benches:
        bench.choice.read()  # a file that cannot be read ends the command, not each of its methods
    out.mkdir(parents=True, exist_ok=True)
    config = {
        "lenses": [str(bench.choice.file) for bench in benches],
        "methods": [row.name for row in rows],
        "settings": asdict(settings),
        "seed": args.seed,
        "versions": versions(),
        "machine": lab.machine(),
    }
    write_json(out / "config.json", plain(config))
    facts, records_by_lens = f"{_conditions(args, settings)} {NOTES}", dict[str, Any]()
    for bench, records in run_bench(benches, rows, Progress(quiet=args.quiet), again=args.restart):
        records_by_lens[bench.name] = records
        write_lens(bench.name, records, facts, out)
        atomic_write_text(out / "summary.md", summary_page(records_by_lens, facts))
    pages = f"Look at\n  {out / 'summary.md'}\n  {out / (benches[0].name + '.md')}, ..."
    print(printable(f"{summary_page(records_by_lens, facts)}\n{pages}"))


def _lenses(args: argparse.Namespace) -> list[Path]:
    if args.library:
        if args.lenses:
            raise InputError("experiments surrogates", "LENS", args.lenses, "none beside --library")
        return lab.historical()
    files = args.lenses or [lab.LENSES / f"{name}.toml" for name in DEFAULT_LENSES]
    check_ids(files, "experiments surrogates", "LENS")
    return list(files)


def _settings(args: argparse.Namespace) -> BenchSettings:
    rays = args.rays or (6000 if args.quick else 30000)
    rounds = args.rounds if args.rounds is not None else (3 if args.quick else 10)
    # The goals are stated for 400-700 nm.
    domain = DomainChoice(focus_m=None if args.near else (math.inf, math.inf), wavelength_nm=LIGHT_NM)
    evaluation = EvaluationChoice(50_000 if args.quick else 200_000, rounds)
    return BenchSettings(domain, PairSettings(rays, rays, rays, args.seed), evaluation)


def _conditions(args: argparse.Namespace, settings: BenchSettings) -> str:
    focus = "focus from infinity to the near limit" if args.near else "focus at infinity"
    pairs, e = settings.pairs, settings.evaluation
    cut = ", ".join(f"{name} for {steps}" for name, steps in QUICK_STEPS.items())
    quick = f" Quick: steps of training, too few: {cut}." if args.quick else ""
    return (
        f"Full aperture and lit film, 400-700 nm (one wavelength where no dispersion is known), {focus}; {pairs.train} "
        f"rays to fit, {pairs.held_out} to measure, {e.vignetting_rays} for the vignetting, seed {pairs.seed}; "
        f"1 thread, {e.rounds} rounds.{quick}"
    )


# ---- The pages. -----------------------------------------------------------------------------------------------------

COLUMNS = (
    Column("RMS um", "rms_um_at_21_6"),
    Column("p99 um", "p99_um_at_21_6"),
    Column("max um", "max_um_at_21_6"),
    Column("RMS px", "rms_px"),
    Column("p99 px", "p99_px"),
    Column("max px", "max_px"),
    Column("direction deg", "direction_rms_deg"),
    Column("position um", "position_rms_um_at_21_6"),
    Column("T RMS", "transmittance_rms", digits=2),
    Column("false pass %", "false_pass", 100, 2),
    Column("2 stops", "stopped_down.2_stops.false_pass", 100, 2),
    Column("4 stops", "stopped_down.4_stops.false_pass", 100, 2),
    Column("false block %", "false_block", 100, 2),
    Column("2 stops", "stopped_down.2_stops.false_block", 100, 2),
    Column("4 stops", "stopped_down.4_stops.false_block", 100, 2),
    Column("coefficients", "coefficients_per_vector", digits=4),
    Column("all", "parameters", digits=6),
    Column("bytes", "bytes", digits=7),
    Column("fit s", "fit_s", digits=2),
    Column("ns/ray", "ns_per_ray.min"),
    Column("fused ns/ray", "fused_ns_per_ray.min"),
    Column("speed-up", "speedup", digits=2),
    Column("fused", "fused_speedup", digits=2),
    Column("break-even Mray", "break_even_rays", 1e-6, 2),
    Column("fused", "fused_break_even_rays", 1e-6, 2),
)
# Figures of the overall page; larger is better for the speed-ups, smaller for the others.
SUMMED = tuple(
    c for c in COLUMNS if c.key in
    "rms_um_at_21_6 direction_rms_deg position_rms_um_at_21_6 transmittance_rms false_pass false_block "
    "coefficients_per_vector fit_s ns_per_ray.min fused_ns_per_ray.min speedup fused_speedup".split()
)  # fmt: skip
_OF_A_LENS = tuple(
    Column(c.heading, c.key, c.factor, 2) for c in SUMMED if c.key in
    "rms_um_at_21_6 direction_rms_deg position_rms_um_at_21_6 transmittance_rms false_pass false_block".split()
)  # fmt: skip
_WORST: dict[str, Callable[[Sequence[float]], float]] = {"speedup": min, "fused_speedup": min}

_LOOK: Kinds = {
    "paraxial": (GROUPS["paraxial"], "#7f7f7f", "D"),
    "published": (GROUPS["published"], "#e69f00", "s"),
    "ours": (GROUPS["ours"], "#0072b2", "o"),
    "ablations": (GROUPS["ablations"], "#cc79a7", "^"),
}

NOTES = (
    "Errors on held-out rays at full aperture, as `neurolens.studies.rays` defines them, of the exported float32 "
    "graph. Micrometres are film-equivalent and at an image radius of 21.6 "
    "mm, the position's at the front surface likewise; pixels are the frame's width over 4000. False pass: blocked "
    "rays over rays that the model passes; false block: lost rays over rays that the lens passes. Coefficients: of "
    "one vector output (A and B, or all scalars of it); all: rims, stop and transmittance included, weights of "
    "networks. Times in float32, stop, rims and transmittance included; speed-ups over the exact lens as C "
    "doing the same work in the same race. Break-even: rays after which fitting and loading have paid for themselves "
    "against it."
)


def lens_page(name: str, records: Sequence[Record], facts: str) -> str:
    """The table of one lens, group by group."""
    rows = []
    for record in _ordered(records):
        cells = [c.cell(record) for c in COLUMNS] if not record["failed"] else [""] * len(COLUMNS)
        if record["failed"]:
            cells[0] = f"failed: {_cell(record['failed'])}"
        rows.append([_named(record["method"]), *cells])
    for exact in _exact(records):
        time = number(exact, "ns_per_ray.min")
        cells = [DASH if c.key != "ns_per_ray.min" or time is None else show(time, 3) for c in COLUMNS]
        rows.append([exact["name"], *cells])
    lines = markdown_table(["method", *(c.heading for c in COLUMNS)], rows)
    apart = []
    for record in records:
        time, weights = number(record, "ns_per_ray.min"), number(record, "parameters") or 0
        if time and number(record, "fused_ns_per_ray.min") is None and weights > MOST_WEIGHTS:
            apart.append(
                f"- {record['method']} is not written as C: so many weights are products of matrices by blocks of "
                f"rays, which onnxruntime does at {2 * weights / time:.0f} Gflop/s here."
            )
    return "\n".join([f"# {name}", "", facts, "", *lines, *([""] if apart else []), *apart, ""])


def summary_page(found: Mapping[str, Sequence[Record]], facts: str) -> str:
    """Median and worst lens of every method, then lens by lens."""
    every = [r for records in found.values() for r in records]
    methods = {r["method"]: r for r in _ordered(every)}
    cells = []
    for method in methods:
        rows = [r for r in every if r["method"] == method]
        good = [r for r in rows if not r["failed"]]
        count = f"{len(good)}" if len(good) == len(rows) else f"{len(good)} of {len(rows)}"
        cells.append([_named(method), count, *(_median_and_worst(c, good) for c in SUMMED)])
    lines = markdown_table(["method", "lenses", *(c.heading for c in SUMMED)], cells)
    failures = [f"- {r['method']}, {r['lens']}: {_cell(r['failed'])}" for r in every if r["failed"]]
    sources = {r["method"]: r["source"] for r in methods.values() if r["source"]}
    parts = ["# Surrogates over lenses", "", facts, "", "Each cell: median, then worst lens.", "", *lines]
    figures = " / ".join(c.heading for c in _OF_A_LENS)
    parts += ["", "## By lens", "", f"{figures}.", "", *_by_lens(found, list(methods))]
    parts += ["", "## What failed", "", *failures] if failures else []
    parts += ["", "## Sources", "", *(f"- {m}: {s}" for m, s in sources.items())] if sources else []
    return "\n".join([*parts, ""])


def write_lens(name: str, records: Sequence[Record], facts: str, folder: Path) -> None:
    """NAME.md and, where a method has errors, NAME.png."""
    folder.mkdir(parents=True, exist_ok=True)
    text = lens_page(name, records, facts)
    named = [{**r, "name": r["method"]} for r in records]
    if trade_plot(name, named, _exact(records), folder / f"{name}.png", _LOOK, "group"):
        text += f"\n![Error against time and against coefficients]({name}.png)\n"
    atomic_write_text(folder / f"{name}.md", text)


def _ordered(records: Sequence[Record]) -> list[Record]:
    return sorted(records, key=lambda r: list(GROUPS).index(r["group"]))


def _exact(records: Sequence[Record]) -> list[Record]:
    """The exact tracers of the last race."""
    return next((list(r["exact"]) for r in records if r.get("exact")), [])


def _median_and_worst(column: Column, records: Sequence[Record]) -> str:
    values = [v for r in records if (v := number(r, column.key)) is not None]
    if not values:
        return DASH
    worst = _WORST.get(column.key, max)(values)
    median = statistics.median(values)
    return f"{show(column.factor * median, column.digits)}, {show(column.factor * worst, column.digits)}"


def _by_lens(found: Mapping[str, Sequence[Record]], methods: Sequence[str]) -> list[str]:
    """Every lens by every method, the worst of the first method first."""
    rows = {lens: {r["method"]: r for r in records if not r["failed"]} for lens, records in found.items()}

    def worst(lens: str) -> float:
        first = rows[lens].get(methods[0]) if methods else None
        return -((number(first, "direction_rms_deg") if first else None) or 0.0)

    def cell(record: Record | None) -> str:
        return DASH if record is None else " / ".join(c.cell(record) for c in _OF_A_LENS)

    lines = ([lens, *(cell(rows[lens].get(m)) for m in methods)] for lens in sorted(rows, key=worst))
    return markdown_table(["lens", *map(_named, methods)], lines)


def _named(method: str) -> str:
    return NAMED.get(method, method)


def _cell(text: str) -> str:
    return text.replace("|", "/")
