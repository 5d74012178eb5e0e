"""`neurolens bench equal-time`: error of every camera over render time, against a converged exact render."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.commands.arguments import whole

_DESCRIPTION = """\
Error over time of the exact lens, a polynomial, a network and a thin lens in three scenes, against a
converged exact render with other seeds: bias and variance told apart, seconds a sample, from when the
exact lens is ahead, equal time and equal samples, FLIP maps and film-space error maps in micrometres.
Best and median seconds; the exact lens and the network as compiled C, too.
Renders are kept in the run folder: a run that was interrupted goes on where it was, and what would give
another picture is rendered again. Needs the extra "train" (torch, matplotlib, flip-evaluator) and a C
compiler. Writes README.md, equal_time.csv, equal_time.json and three pictures a scene (about ten minutes)."""


def add_parser(kinds: Any) -> None:
    """Add the bench to `neurolens bench`."""
    parser = kinds.add_parser("equal-time", help="error over render time of every camera", description=_DESCRIPTION)
    parser.add_argument(
        "--scene", metavar="SCENE", action="append",
        help="grid, lights, room or a scene file; again for more (default: all three)",
    )  # fmt: skip
    parser.add_argument(
        "--quick", action="store_true", help="tiny pictures, few samples (a minute); results stay in the run folder"
    )
    parser.add_argument(
        "--threads", metavar="N", type=whole(1, 256), default=1, help="of the timed renders (default 1)"
    )
    parser.add_argument("--folder", metavar="DIR", type=Path, help="of the kept renders (default: runs/equal_time)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: experiments/results/equal_time")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="renders that were finished are kept, and the same command goes on from there")


def run(args: argparse.Namespace) -> int:
    """Measure scene by scene; the page is written after each."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches import equal_time, equal_time_page
    from neurolens.evaluate.project import project_root

    root = project_root()
    counts = equal_time.QUICK if args.quick else equal_time.Counts()
    folder = args.folder or root / "runs" / ("equal_time_quick" if args.quick else "equal_time")
    out = args.out or (folder / "results" if args.quick else root / "experiments" / "results" / "equal_time")
    files = [equal_time.scene_file(name, root) for name in args.scene or equal_time.SCENES]
    progress = Progress({file.stem: 1.0 for file in files}, quiet=args.quiet)
    done: list[equal_time.SceneResult] = []
    for file in files:
        with progress.stage(file.stem) as report:
            done.append(equal_time.measure_scene(file, root, folder, counts, args.threads, report))
        text = equal_time_page.write(done, out)
    print(text)
    print(f"Written to {out}")
    return 0
