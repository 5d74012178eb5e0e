"""`neurolens bench vignetting` and `neurolens bench outside`: who passes, and that nothing passes that must not."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.commands.arguments import whole

_DESCRIPTION = """\
False passes and false blocks of one surrogate a lens: open, closed by two and four stops, and with
blades; and how far its relative illumination is from the exact lens's. Over every lens that is round
about its axis (some minutes of one core). Rows of an earlier run stay where a lens is not chosen.
Writes vignetting.md, vignetting.json and vignetting.png (cat's eyes, exact and of the model)."""
_OUTSIDE = """\
Random numbers of every kind (any bit pattern, NaN, infinities, denormals, huge and negative ones,
rays just outside the domain) through an exported model. A ray outside the domain never passes; one
that passes is finite, and its direction is of unit length. Exit code 1 where that is broken."""
_DRAWN = ("laikin_double_gauss_50", "tajima_retrofocus_24", "isshiki_fisheye_10", "shimizu_fisheye_220")


def add_parsers(kinds: Any) -> None:
    """Add both commands to those of `neurolens bench`."""
    parser = kinds.add_parser("vignetting", help="false passes and blocks, illumination", description=_DESCRIPTION)
    parser.add_argument("--rays", metavar="N", type=whole(1000), default=100_000, help="a lens (default 100000)")
    parser.add_argument("--only", metavar="TEXT", default="", help="lens files whose name holds this text")
    parser.add_argument("--domain", choices=("infinity", "default"), help="one of the two domains (default: both)")
    parser.add_argument("--lenses", metavar="DIR", type=Path, help="folder of lens files (default: lenses)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run_vignetting, kept="lenses that were finished are in the table")
    parser = kinds.add_parser("outside", help="random inputs through exported models", description=_OUTSIDE)
    parser.add_argument("models", metavar="MODEL", type=Path, nargs="+", help="exported models (.onnx)")
    parser.add_argument("--rays", metavar="N", type=whole(1000), default=10_000_000, help="a model (default 10000000)")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=1, help="of the numbers (default 1)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run_outside, kept="nothing is written")


def run_vignetting(args: argparse.Namespace) -> int:
    """Measure the lenses, draw four of them."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches import vignetting as vignetting_bench
    from neurolens.evaluate.benches.library import lens_files, read_quietly
    from neurolens.evaluate.plots.vignetting import cats_eyes
    from neurolens.evaluate.project import project_root

    root = project_root()
    folder, out = args.lenses or root / "lenses", args.out or root / "experiments" / "results"
    files = [f for f in lens_files(folder) if args.only in f.stem and not read_quietly(f).anamorphic]
    if not files:
        raise InputError("neurolens bench vignetting", "--only", args.only, f"part of the name of a lens of {folder}")
    domains = [args.domain] if args.domain else list(vignetting_bench.DOMAINS)
    with Progress(quiet=args.quiet).stage("vignetting") as report:
        rows = vignetting_bench.run(files, domains, args.rays, out, lambda share: report(0.9 * share))
        drawn = [f for f in files if f.stem in _DRAWN] or files[:1]
        if not args.only or not (out / "vignetting.png").exists():
            choice = vignetting_bench.DOMAINS["infinity"]
            cats_eyes([vignetting_bench.model_of(f, choice)[0] for f in drawn], out / "vignetting.png")
    print(vignetting_bench.page(rows))
    return 0


def run_outside(args: argparse.Namespace) -> int:
    """Send random numbers; 1 where a promise is broken."""
    from neurolens.base.progress import Progress
    from neurolens.cameras.onnxlens import load_model
    from neurolens.evaluate.benches.outside import send

    broken = 0
    for path in args.models:
        with Progress(quiet=args.quiet).stage(path.stem) as report:
            found = send(load_model(path), args.rays, args.seed, report)
        print(f"{path}: {found.rays} rays, {found.inside} of them inside the domain, {found.passed} passed")
        for promise, count in found.broken.items():
            if count:
                broken += count
                print(f"neurolens: {path}: {count} rays: {promise}", file=sys.stderr)
    return 1 if broken else 0
