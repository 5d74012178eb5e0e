"""`neurolens bench fused`: models as C against the exact lens as C, torch and onnxruntime."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.commands.arguments import whole

_DESCRIPTION = """\
Fit the smallest polynomial within 1 um RMS and a small network to a few lenses, write them as C, with and
without what a scene fixes, and race them against the exact trace: written as C by the same means, and
compiled by torch (a minute a lens more), and against onnxruntime. One thread, float32. Needs a C compiler
and the extra "train" (torch). Writes fused_speed.md and fused_speed.json; lenses that are not asked for
keep their rows."""


def add_parser(kinds: Any) -> None:
    """Add the bench to `neurolens bench`."""
    parser = kinds.add_parser("fused", help="models as C against the exact lens as C", description=_DESCRIPTION)
    parser.add_argument("--quick", action="store_true", help="without the tracer compiled by torch, few rounds")
    parser.add_argument("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
    parser.add_argument("--rounds", metavar="N", type=whole(1), help="rounds (default 20; quick 5)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="lenses that were finished are in the table")


def run(args: argparse.Namespace) -> int:
    """Measure lens by lens; the table is written after each."""
    import warnings

    from neurolens.base.errors import NeurolensWarning
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches.compiled_source import find_compiler
    from neurolens.evaluate.benches.fused_page import earlier, write
    from neurolens.evaluate.benches.fused_speed import measure, selected
    from neurolens.evaluate.project import project_root

    warnings.simplefilter("ignore", NeurolensWarning)
    find_compiler()
    root = project_root()
    rounds = args.rounds or (5 if args.quick else 20)
    cases = selected(args.only)
    progress = Progress({c.file: 1.0 for c in cases}, quiet=args.quiet)
    out = args.out or root / "experiments" / "results"
    rows, text = earlier(out, [Path(c.file).stem for c in cases]), ""
    for case in cases:
        with progress.stage(case.file) as report:
            rows += measure(case, root / "lenses", rounds=rounds, torch_compiled=not args.quick, report=report)
        text = write(rows, out, rounds)
    print(text)
    return 0
