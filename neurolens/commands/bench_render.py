"""`neurolens bench render`: seconds of renders by camera, scene, refractions and shape of the stop."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

_DESCRIPTION = """\
Render three scenes of rising cost through a pinhole, a thin lens, a stop without glass, and lenses of 2 to 40
refractions: traced exactly (torch, and compiled as C), through their polynomials and networks in onnxruntime
and compiled (12 minutes of one core; --quick: one). Needs the extra "train" (torch) and a C compiler; what
this machine cannot make is left out, and said. Writes README.md, render_times.csv and render_times.png."""


def add_parser(kinds: Any) -> None:
    """Add the bench to `neurolens bench`."""
    parser = kinds.add_parser("render", help="render time by camera and scene", description=_DESCRIPTION)
    parser.add_argument("--quick", action="store_true", help="three lenses in the cheap scene, one small round")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results/render_times)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="what was measured is in the tables")


def run(args: argparse.Namespace) -> int:
    """Make the cameras, time them alone and in renders; the tables are written after each step."""
    import warnings

    import torch

    from neurolens.base.errors import NeurolensWarning
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches import render_times as bench
    from neurolens.evaluate.benches.render_times_page import Found, write
    from neurolens.evaluate.benches.render_times_plot import draw
    from neurolens.evaluate.benches.render_times_shapes import time_shapes
    from neurolens.evaluate.project import project_root

    warnings.simplefilter("ignore", NeurolensWarning)
    torch.set_num_threads(1)
    root = project_root()
    out = args.out or root / "experiments" / "results" / "render_times"
    found = Found(bench.Size(64, 36, 16, 1) if args.quick else bench.Size())
    scenes = bench.load_scenes(root, args.quick)
    progress = Progress({"cameras": 25, "cameras alone": 5, "renders": 65, "stop shapes": 5}, quiet=args.quiet)
    with progress.stage("cameras") as report:
        found.subjects = bench.make_subjects(root, args.quick, report)
    with progress.stage("cameras alone") as report:
        bench.time_alone(found.subjects, report)
    write(found, out)
    with progress.stage("renders") as report:
        found.rows = bench.time_renders(found.subjects, scenes, found.size, report)
    write(found, out)
    with progress.stage("stop shapes") as report:
        found.shapes = time_shapes(root, scenes["cheap"], found.size, report)
    draw(found, out / "render_times.png")
    print(write(found, out))
    return 0
