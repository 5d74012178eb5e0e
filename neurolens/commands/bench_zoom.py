"""`neurolens bench zoom`: one model over the whole range of each zoom, and over internal focus."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.commands.arguments import whole

_DESCRIPTION = """\
Fit one model for the whole range of each zoom of the library, for internal focus, and for both, and
measure it at random states against the exact lens, beside models fitted to one state each. A minute
or two for each of the eight, ten for the last; those that are in the table are kept.
Writes zoom.md, zoom.json and zoom.png."""


def add_parser(kinds: Any) -> None:
    """Add the command to those of `neurolens bench`."""
    parser = kinds.add_parser("zoom", help="models of whole zooms, of internal focus", description=_DESCRIPTION)
    parser.add_argument("cases", metavar="CASE", nargs="*", help="cases by name, as in the table (default: all)")
    parser.add_argument("--states", metavar="N", type=whole(2, 1000), default=25, help="random states (default: 25)")
    parser.add_argument("--again", action="store_true", help="measure the chosen cases again")
    parser.add_argument("--models", metavar="DIR", type=Path, help="folder for the models (default: runs/zoom)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="finished cases are in the table; the same command goes on")


def run(args: argparse.Namespace) -> int:
    """Measure what is missing, and write the table after each case."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches.states import CASES, measure_case, page, read_records, write_records
    from neurolens.evaluate.project import project_root
    from neurolens.surrogates.threads import pinned_threads

    known = {c.name: c for c in CASES}
    unknown = [name for name in args.cases if name not in known]
    if unknown:
        raise InputError("neurolens bench zoom", "CASE", unknown[0], f"one of: {', '.join(known)}")
    root = project_root()
    out, folder = args.out or root / "experiments" / "results", args.models or Path("runs") / "zoom"
    folder.mkdir(parents=True, exist_ok=True)
    records = read_records(out / "zoom.json")
    missing = [known[n] for n in args.cases or known if args.again or n not in records]
    progress = Progress(dict.fromkeys((c.name for c in missing), 60.0), quiet=args.quiet)
    text = page(list(records.values()))
    with pinned_threads():
        for case in missing:
            with progress.stage(case.name) as report:
                records[case.name] = measure_case(case, root / "lenses", folder, args.states, report)
            text = write_records(records, out)
    print(text)
    return 0
