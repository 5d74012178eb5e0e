"""`neurolens bench models`: makes the models that ship, checks their cards and times them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

_DESCRIPTION = """\
Fit, check on fresh rays and time the models that experiments/models.toml lists, and write them with
index.json and README.md. Models that are there, made by the same settings and version, are kept: a
run that was interrupted goes on where it stopped.
Exit code 1 where a lens could not be done or a card does not hold."""


def add_parser(kinds: Any) -> None:
    """Add the command to those of `neurolens bench`."""
    parser = kinds.add_parser("models", help="make the models that ship", description=_DESCRIPTION)
    parser.add_argument("lenses", metavar="LENS", nargs="*", help="entries whose name starts so (default: all)")
    parser.add_argument("--list", metavar="FILE", type=Path, help="list (default: experiments/models.toml)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder (default: the project's models/)")
    parser.add_argument("--again", action="store_true", help="make the chosen entries again")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="finished entries are in the index; the same command goes on")


def run(args: argparse.Namespace) -> int:
    """Make what is missing; 1 where something failed."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches.make_models import make_models
    from neurolens.evaluate.benches.models_list import chosen, read_list
    from neurolens.evaluate.project import project_root

    library = read_list(args.list or project_root() / "experiments" / "models.toml")
    entries = chosen(library, args.lenses)
    out = args.out or project_root() / "models"
    out.mkdir(parents=True, exist_ok=True)
    failed = make_models(library, entries, out, Progress(quiet=args.quiet), again=args.again)
    print((out / "README.md").read_text(encoding="utf-8"))
    for line in failed:
        print(f"neurolens: {line}", file=sys.stderr)
    return 1 if failed else 0
