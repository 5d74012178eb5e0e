"""`neurolens gallery`: what real lenses do, rendered and measured through exact lenses, surrogates and thin lenses."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.commands.arguments import add_json, whole
from neurolens.commands.output import print_json, table

_DESCRIPTION = """\
Render small scenes that show what real lenses do, each through the exact lens, a surrogate and a
thin lens, and measure the effect in each. An effect is a file of experiments/gallery; its figure,
its numbers and a page of all are written to experiments/results/gallery. What an earlier run
finished is not done again; fitted models are kept in runs/gallery."""
_EPILOG = """\
examples:
  neurolens gallery --list
  neurolens gallery coma --samples 16 --out runs/coma
  neurolens gallery"""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "gallery", help="what real lenses do: figures and numbers", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("effects", metavar="EFFECT", nargs="*", help="names of effects (default: all)")
    parser.add_argument("--list", action="store_true", help="list the effects and stop")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder (default: experiments/results/gallery)")
    parser.add_argument("--effects-in", metavar="DIR", type=Path, help="effect files (default: experiments/gallery)")
    parser.add_argument(
        "--samples", metavar="N", type=whole(1, 1 << 16), help="samples a pixel (default: the effect's own)"
    )
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=2, help="workers (default: 2)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_json(parser)
    parser.set_defaults(run=run, kept="effects that were finished are kept")


def run(args: argparse.Namespace) -> int:
    """Render and measure the effects asked for, then write the page of all that are there."""
    from neurolens.base.progress import Progress
    from neurolens.evaluate.gallery.page import quantity_name, write_page
    from neurolens.evaluate.gallery.run import check, finished, run_effect
    from neurolens.evaluate.gallery.settings import find_effects, read_effect
    from neurolens.evaluate.project import project_root

    root = project_root()
    folder = args.effects_in or root / "experiments" / "gallery"
    out = args.out or root / "experiments" / "results" / "gallery"
    effects = [read_effect(path) for path in find_effects(folder, args.effects)]
    for effect in effects:
        check(effect)
    if args.list:
        print(table(("effect", "title"), [(effect.name, effect.title) for effect in effects], left=2))
        return 0
    out.mkdir(parents=True, exist_ok=True)
    progress, records = Progress(quiet=args.quiet), []
    for effect in effects:
        cache = root / "runs" / "gallery"
        records.append(run_effect(effect, out, cache, samples=args.samples, threads=args.threads, progress=progress))
        everything = [finished(read_effect(path), out) for path in find_effects(folder)]
        write_page([record for record in everything if record is not None], out / "README.md")
    if args.json:
        print_json({"effects": records})
        return 0
    columns = ("exact", "surrogate", "thin")
    rows = [
        (record["name"], panel["label"], quantity_name(name), *(_cell(found.get(c)) for c in columns))
        for record in records
        for panel in record["panels"]
        for name, found in panel["measured"].items()
    ]
    print(table(("effect", "panel", "measured", *columns), rows, left=3))
    print(out / "README.md")
    return 0


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
