"""`neurolens bench WHAT`: speed and numerics of the exact tracer, and surrogates against it, written as tables."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.commands import (
    bench_equal_time,
    bench_fused,
    bench_inverse,
    bench_mitsuba,
    bench_models,
    bench_render,
    bench_surrogates,
    bench_vignetting,
    bench_zoom,
)
from neurolens.commands.arguments import Parser, whole

_DESCRIPTION = """\
Measure the exact tracer and surrogates on this machine and write tables.
Needs the extra "train" (torch)."""
_TRACE = """\
Rays per second of the exact tracer: eager and compiled, float32 and float64, by number of
surfaces and threads, with two aspheres, and the memory that it takes. Candidates run in turn,
so that ratios are fair on a busy machine; absolute figures want a quiet one.
Writes trace_speed.md and trace_speed.json."""
_EXTREMES = """\
Errors of float32 from float64, and of float64 from 50 digits, at the ends of what optics allows:
f/0.6 to f/45, 220 degrees, radii from the semi-diameter to a plane, grazing rays, the critical
angle, cemented equal indices, near and far objects, every lens file, both ways.
Exit code 1 where a number is not finite or a status differs away from any edge.
Writes extremes.md and extremes.json."""

_PUPILS = """\
What share of the rays that a pupil sends pass the lens: the pupils of the literature and the outlines
of this project's cameras, on the lenses of the theses, beside their figures (half a minute).
Writes passage.md, passage.json and passage.png."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "bench", help="speed and numerics of the exact tracer; surrogates", description=_DESCRIPTION
    )
    kinds = parser.add_subparsers(metavar="WHAT", required=True, parser_class=Parser)
    _add_trace(kinds)
    _add_extremes(kinds)
    _add_pupils(kinds)
    bench_surrogates.add_parser(kinds)
    bench_vignetting.add_parsers(kinds)
    bench_fused.add_parser(kinds)
    bench_models.add_parser(kinds)
    bench_inverse.add_parser(kinds)
    bench_zoom.add_parser(kinds)
    bench_equal_time.add_parser(kinds)
    bench_render.add_parser(kinds)
    bench_mitsuba.add_parser(kinds)


def _add_trace(kinds: Any) -> None:
    parser = kinds.add_parser("trace", help="rays per second and memory", description=_TRACE)
    parser.add_argument("--quick", action="store_true", help="12 refractions on one thread, few rounds (a minute)")
    parser.add_argument("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
    parser.add_argument(
        "--threads", metavar="N", type=whole(1), nargs="+", default=[1, 2], help="thread counts (default: 1 2)"
    )
    parser.add_argument("--rounds", metavar="N", type=whole(1), help="rounds (default 20; quick 5)")
    _add_out(parser)
    parser.set_defaults(run=run_trace, kept="lenses that were finished are in the table")


def _add_extremes(kinds: Any) -> None:
    parser = kinds.add_parser("extremes", help="errors and statuses at the ends", description=_EXTREMES)
    parser.add_argument("--rays", metavar="N", type=whole(100), default=20000, help="rays a case (default 20000)")
    _add_out(parser)
    parser.set_defaults(run=run_extremes, kept="nothing is written")


def _add_pupils(kinds: Any) -> None:
    parser = kinds.add_parser("pupils", help="share of rays that pass", description=_PUPILS)
    parser.add_argument("--rays", metavar="N", type=whole(1000), default=2**17, help="rays a method (default 131072)")
    parser.add_argument("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
    _add_out(parser)
    parser.set_defaults(run=run_pupils, kept="nothing is written")


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")


def run_trace(args: argparse.Namespace) -> int:
    """Time the tracer, lens by lens; the table is written after each."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches.trace_memory import SIZES, Unmeasured, memory_of
    from neurolens.evaluate.benches.trace_speed import MAIN, chosen_lenses, selected, time_lens, with_aspheres
    from neurolens.evaluate.benches.trace_speed_page import Found, page, write
    from neurolens.evaluate.project import project_root

    _quiet_glasses()
    root = project_root()
    out = args.out or root / "experiments" / "results"
    lenses, missing = chosen_lenses(root / "lenses")
    lenses = selected({MAIN: lenses[MAIN]} if args.quick else lenses, args.only)
    rounds = args.rounds or (5 if args.quick else 20)
    found = Found(rounds, missing=[] if args.quick or args.only else missing)
    threads = args.threads[:1] if args.quick else args.threads
    plan = {_stage(n): (2.0 if n == MAIN else 1.0) * (8 + n + n * len(threads)) for n in lenses} | {"memory": 10.0}
    progress = Progress(plan, quiet=args.quiet)
    for n, lens in lenses.items():
        with progress.stage(_stage(n)) as report:
            aspheric = with_aspheres(lens) if n == MAIN else None
            found.rows += time_lens(lens, threads, rounds, aspheric=aspheric, report=report)
        write(found, out)
    if MAIN in lenses:
        with progress.stage("memory") as report:
            try:
                for i, size in enumerate(SIZES[: 2 if args.quick else 3]):
                    found.memory.append(memory_of(root / "lenses" / Path(lenses[MAIN].path).name, size))
                    report((i + 1) / len(SIZES))
            except Unmeasured as reason:
                found.missing.append(str(reason))
        write(found, out)
    print(page(found))
    return 0


def _quiet_glasses() -> None:
    """No word on glasses of unknown dispersion: it changes nothing here."""
    import warnings

    from neurolens.base.errors import NeurolensWarning

    warnings.simplefilter("ignore", NeurolensWarning)


def _stage(count: int) -> str:
    return f"{count} refractions"


def run_extremes(args: argparse.Namespace) -> int:
    """Measure every case; 1 where something happened that never may."""
    import json

    from neurolens.base.files import atomic_write_text
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches import extremes
    from neurolens.evaluate.benches.extreme_cases import all_cases
    from neurolens.evaluate.project import project_root

    _quiet_glasses()
    root = project_root()
    out = args.out or root / "experiments" / "results"
    with Progress(quiet=args.quiet).stage("extremes") as report:
        cases = list(all_cases(root / "lenses", args.rays))
        done = []
        for case in cases:
            done.append(extremes.measure(case))
            report(len(done) / len(cases))
    bad = extremes.failures(done)
    text = extremes.page(done, bad)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(out / "extremes.md", text)
    atomic_write_text(out / "extremes.json", json.dumps(extremes.to_json(done), indent=1, allow_nan=False) + "\n")
    print(text)
    for line in bad:
        print(f"neurolens: {line}", file=sys.stderr)
    return 1 if bad else 0


def run_pupils(args: argparse.Namespace) -> int:
    """Measure every case of the theses and draw three."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches import passage, passage_page
    from neurolens.evaluate.benches.passage_cases import CASES, DRAWN
    from neurolens.evaluate.project import project_root

    _quiet_glasses()
    root = project_root()
    cases = [case for case in CASES if args.only in case.lens]
    if not cases:
        known = ", ".join(dict.fromkeys(case.lens for case in CASES))
        raise InputError("neurolens bench pupils", "--only", args.only, f"part of one of: {known}")
    with Progress(quiet=args.quiet).stage("pupils") as report:
        done = []
        for case in cases:
            done.append(passage.measure(case, root / "lenses", args.rays))
            report(len(done) / (len(cases) + 1))
        pixel = [] if args.only else list(passage.pixel_rates(root / "lenses", args.rays))
        shown = [p for p in done if p.case in DRAWN] or done[:1]
        cameras = [passage.camera_of(p.case, root / "lenses") for p in shown]
    out = args.out or root / "experiments" / "results"
    print(passage_page.write(done, pixel, shown, cameras, args.rays, out))
    return 0
