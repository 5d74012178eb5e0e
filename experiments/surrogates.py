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
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.methods import Bench, BenchSettings, chosen_rows, run_bench
from experiments.methods_page import NOTES, summary_page, write_lens
from neurolens.base.errors import InputError, printable
from neurolens.base.files import atomic_write_text, write_json
from neurolens.base.progress import Progress
from neurolens.base.records import plain, versions
from neurolens.cli.arguments import add_glass, add_lens, check_ids, check_run_folder, whole
from neurolens.study.describe import lens_files
from neurolens.study.experiment import DomainChoice, LensChoice
from neurolens.surrogates.pairs import PairSettings

DEFAULT_LENSES = (
    "laikin_double_gauss_50", "ogawa_zoom_70_200", "schaefter_primoplan_100", "horimoto_fisheye_16", "phone_lens_6"
)  # fmt: skip
OPTIONS = (
    lambda parser: add_lens(parser, "lenses", nargs="*"),
    lab.option("--library", action="store_true", help="every lens file of lenses/"),
    lab.option(
        "--methods", metavar="METHOD", nargs="+", default=[],
        help="rows by name, or groups: paraxial, published, ours, ablations (default: the first three)",
    ),
    lab.option("--near", action="store_true", help="focus from infinity to the near limit, not infinity alone"),
    lab.option("--quick", action="store_true", help="6000 rays, 3 rounds, no compiled tracer: rough figures"),
    lab.option("--rays", metavar="N", type=whole(1000, 10**6), help="rays of fits and errors (default 30000)"),
    lab.option("--seed", metavar="N", type=whole(0), default=1, help="seed of the rays (default 1)"),
    lab.option("--rounds", metavar="N", type=whole(0), help="rounds of the race, 0 for none (default 10)"),
    lab.option("--threads", metavar="N", type=whole(1, 256), default=1, help="threads of the race (default 1)"),
    lab.option("--restart", action="store_true", help="make the records of the chosen rows again"),
    lab.out(lab.ROOT / "runs" / "surrogates", "folder"),
    add_glass,
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Make the missing records, and write the pages after every lens."""
    rows, settings, out = chosen_rows(args.methods), _settings(args), args.out
    benches = [Bench(LensChoice(Path(file)), settings, out) for file in _lenses(args)]
    check_run_folder(out, "experiments surrogates", "--output")
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
        return [Path(file) for file in lens_files(lab.LENSES)]
    files = args.lenses or [lab.LENSES / f"{name}.toml" for name in DEFAULT_LENSES]
    check_ids(files, "experiments surrogates", "LENS")
    return list(files)


def _settings(args: argparse.Namespace) -> BenchSettings:
    rays = args.rays or (6000 if args.quick else 30000)
    rounds = args.rounds if args.rounds is not None else (3 if args.quick else 10)
    return BenchSettings(
        # The goals are stated for 400-700 nm.
        domain=DomainChoice(focus_m=None if args.near else (math.inf, math.inf), wavelength_nm=(400.0, 700.0)),
        pairs=PairSettings(rays, rays, rays, args.seed),
        vignetting_rays=50_000 if args.quick else 200_000,
        rounds=rounds,
        threads=args.threads,
        compile_exact=not args.quick,
    )


def _conditions(args: argparse.Namespace, settings: BenchSettings) -> str:
    focus = "focus from infinity to the near limit" if args.near else "focus at infinity"
    pairs = settings.pairs
    return (
        f"Full aperture and lit film, 400-700 nm (one wavelength where no dispersion is known), {focus}; {pairs.train} "
        f"rays to fit, {pairs.held_out} to measure, {settings.vignetting_rays} for the vignetting, seed {pairs.seed}; "
        f"{settings.threads} thread{'s' * (settings.threads > 1)}, {settings.rounds} rounds."
    )
