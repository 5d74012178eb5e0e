"""`neurolens bench`: every method on the same rays of every lens, as records, tables and plots."""

from __future__ import annotations

import argparse
import math
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.cluster import Dask
from neurolens.base.errors import NeurolensError, printable
from neurolens.base.travel import run_remotely
from neurolens.commands.arguments import (
    QUIET_HELP,
    add_dask,
    add_glass,
    add_lens,
    add_option,
    add_output,
    check_ids,
    check_run_folder,
    more_glasses,
    whole,
)

if TYPE_CHECKING:
    from neurolens.evaluate.methods import BenchSettings

SURROGATES = """\
Fit every method for every lens on the same rays, measure errors, size and time against the exact
tracer, and write one JSON record per lens and method, one table and plot per lens, and a summary over
the lenses with the median and the worst. Needs the extra "train" (torch).

Existing records of the same settings and version are kept: an interrupted run resumes where it
stopped. A method that fails on a lens is a row with the reason."""
_EPILOG = """\
examples:
  neurolens bench my_lens.toml
  neurolens bench laikin_double_gauss_50 my_lens.toml --methods ours schrade

DIR holds summary.md, LENS.md and LENS.png, records/, models/ (ONNX) and config.json."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "bench", help="every kind of surrogate on a lens, against its exact trace", description=SURROGATES,
        epilog=_EPILOG,
    )  # fmt: skip
    add_surrogate_arguments(parser, "+")
    parser.set_defaults(run=run_surrogates, kept="finished records are kept; the same command resumes")


def add_surrogate_arguments(parser: argparse.ArgumentParser, lenses: str) -> None:
    """Add the lenses, as many as argparse's `lenses` says, and the options."""
    add_lens(parser, "lenses", nargs=lenses)
    parser.add_argument(
        "--methods", metavar="METHOD", nargs="+", default=[],
        help="rows by name, or groups: paraxial, published, ours, ablations (default: the first three)",
    )  # fmt: skip
    parser.add_argument("--near", action="store_true", help="focus from infinity to the near limit, not infinity alone")
    parser.add_argument("--quick", action="store_true", help="6000 rays, 3 rounds, no compiled tracer: rough figures")
    parser.add_argument("--rays", metavar="N", type=whole(1000, 10**6), help="rays of fits and errors (default 30000)")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=1, help="of the rays (default 1)")
    parser.add_argument("--rounds", metavar="N", type=whole(0), help="of the race, 0 for none (default 10)")
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=1, help="of the race (default 1)")
    add_option(parser, "--restart", old=("--again",), action="store_true", help="recompute the chosen records")
    add_dask(parser)
    add_output(parser, "DIR", "folder (default: runs/surrogates)", default=Path("runs/surrogates"))
    add_glass(parser)
    parser.add_argument("--quiet", action="store_true", help=QUIET_HELP)


def run_surrogates(args: argparse.Namespace) -> int:
    """Make missing records, and write the pages after every lens."""
    from neurolens.base.files import atomic_write_text, write_json
    from neurolens.base.progress import Progress
    from neurolens.evaluate.experiment import LensChoice
    from neurolens.evaluate.methods import Bench, chosen_rows, lacks, run_bench
    from neurolens.evaluate.methods_page import NOTES, summary_page, write_lens
    from neurolens.evaluate.records import plain, versions

    rows, settings, out = chosen_rows(args.methods), _settings(args), args.out
    files: list[Path] = args.lenses
    check_ids(files, "neurolens bench", "LENS")
    check_run_folder(out, "neurolens bench", "--output")
    benches = [Bench(LensChoice(file), settings, out) for file in files]
    for bench in benches:
        bench.choice.read()  # a file that cannot be read ends the command, not each of its methods
    out.mkdir(parents=True, exist_ok=True)
    config = {
        "lenses": [str(file) for file in files],
        "methods": [row.name for row in rows],
        "settings": asdict(settings),
        "seed": args.seed,
        "versions": versions(),
        "machine": {"processor": platform.processor() or platform.machine(), "system": platform.platform()},
    }
    write_json(out / "config.json", plain(config))
    facts = f"{_conditions(args, settings)} {NOTES}"
    found: dict[str, Any] = {}
    progress = Progress(quiet=args.quiet)
    again = args.restart
    if args.dask is not None:
        asked = [bench for bench in benches if again or lacks(bench, rows)]
        glasses = tuple(args.glass_files)
        tasks = {
            bench.name: _Task(bench.choice.file, settings, out / bench.name, tuple(args.methods), glasses)
            for bench in asked
        }
        with progress.stage(f"{len(asked)} of {len(benches)} lenses") as report, Dask(args.dask) as executor:
            failed = run_remotely(executor, bench_alone, tasks, {*files, *args.glass_files}, out, report)
        for name, why in failed.items():
            raise NeurolensError(f"{name}: {why}; finished records are kept: the same command resumes")
        again = False
    for bench, records in run_bench(benches, rows, progress, again=again):
        found[bench.name] = records
        write_lens(bench.name, records, facts, out)
        atomic_write_text(out / "summary.md", summary_page(found, facts))
    pages = f"Look at\n  {out / 'summary.md'}\n  {out / (benches[0].name + '.md')}, ..."
    print(printable(f"{summary_page(found, facts)}\n{pages}"))
    return 0


@dataclass(frozen=True)
class _Task:
    """The records of one lens, in the folder of `out`, with the catalogues of glass that it needs."""

    lens: Path
    settings: BenchSettings
    out: Path
    methods: tuple[str, ...]
    glass_files: tuple[Path, ...] = ()


def bench_alone(task: _Task) -> None:
    """Make the records of a lens, without pages, as a task of a cluster does."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.experiment import LensChoice
    from neurolens.evaluate.methods import Bench, chosen_rows, run_bench

    with more_glasses(task):
        bench = Bench(LensChoice(task.lens), task.settings, task.out.parent)
        list(run_bench([bench], chosen_rows(task.methods), Progress(quiet=True)))


def _settings(args: argparse.Namespace) -> BenchSettings:
    from neurolens.evaluate.experiment import DomainChoice
    from neurolens.evaluate.methods import BenchSettings
    from neurolens.surrogates.pairs import PairSettings

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
