"""`neurolens bench inverse`: how often inverse maps arrive, beside the published iteration."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.commands.arguments import whole

_DESCRIPTION = """\
Fit a model and its inverse maps to every lens file and count the rays that three Newton steps do not
find, beside Newton's method as published (10 to 30 s a lens). Lenses that are in the table are kept.
Writes inverse.md and inverse.json."""


def add_parser(kinds: Any) -> None:
    """Add the command to those of `neurolens bench`."""
    parser = kinds.add_parser("inverse", help="inverse maps: how often they arrive", description=_DESCRIPTION)
    parser.add_argument("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
    parser.add_argument("--rays", metavar="N", type=whole(1000), default=100_000, help="rays a lens (default: 100000)")
    parser.add_argument("--raw", action="store_true", help="invert a model of raw monomials too (half a minute a lens)")
    parser.add_argument("--again", action="store_true", help="measure the chosen lenses again")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="finished lenses are in the table; the same command goes on")


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, and write the tables after each lens."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches.inverse import BenchSettings, measure_lens, page, read_records, write_records
    from neurolens.evaluate.project import project_root

    root = project_root()
    files = [f for f in sorted((root / "lenses").glob("*.toml")) if args.only in f.stem]
    if not files:
        raise InputError("neurolens bench inverse", "--only", args.only, "part of the name of a lens file")
    out = args.out or root / "experiments" / "results"
    records = read_records(out / "inverse.json")
    missing = [f for f in files if args.again or f.stem not in records]
    progress = Progress({f.stem: 20.0 for f in missing}, quiet=args.quiet)
    text = page(list(records.values()))
    for file in missing:
        with progress.stage(file.stem):
            try:
                records[file.stem] = measure_lens(file, BenchSettings(rays=args.rays, raw=args.raw))
            except InputError as error:
                records[file.stem] = {"lens": file.stem, "refused": str(error).removeprefix(f"{root}/")}
        text = write_records(list(records.values()), out)
    print(text)
    return 0
