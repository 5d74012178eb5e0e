"""`neurolens survey FOLDER`: every lens file of a folder, read, checked, fitted and measured."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.base.cluster import Dask
from neurolens.base.errors import InputError, printable
from neurolens.base.files import read_bytes
from neurolens.base.tasks import Processes, cores
from neurolens.cli.arguments import (
    QUIET_HELP,
    add_dask,
    add_glass,
    add_json,
    add_option,
    add_output,
    between,
    check_run_folder,
    whole,
)
from neurolens.cli.output import answer

_DESCRIPTION = """\
Read every lens file of a folder (all formats of `neurolens convert`, and folders inside), check it against its
own statements, derive rims where it gives none, fit a polynomial by the default settings, and measure it on
rays that the fit has not seen. Nothing is left out silently: what cannot be read is one line with the reason.

Every file is a process of its own. A finished file is not done again: the same command goes on."""
_EPILOG = """\
examples:
  neurolens survey lenses/
  neurolens survey my_patents/ -o runs/patents --jobs 8
  neurolens survey my_patents/ --no-fit

DIR holds survey.html (a table with sections of the lenses, to sort and filter), survey.csv, survey.json, records/."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "survey", help="every lens file of a folder: read, checked, fitted, measured", description=_DESCRIPTION,
        epilog=_EPILOG,
    )  # fmt: skip
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder of lens files")
    add_output(parser, "DIR", "default: runs/survey", default=Path("runs/survey"))
    parser.add_argument("--no-fit", action="store_true", help="read and check only")
    parser.add_argument("--terms", metavar="N", type=whole(1, 400), default=64, help="coefficients (default 64)")
    parser.add_argument(
        "--rays", metavar="N", type=whole(1000, 10**6), default=30_000, help="to fit and to measure (default 30000)"
    )
    parser.add_argument("--seed", metavar="N", type=whole(0), default=1, help="of the rays (default 1)")
    parser.add_argument(
        "--half-field", metavar="DEG", type=between(1e-3, 179.0, "degrees"), default=15.0,
        help="assumed where a file gives neither rims nor a field (default 15)",
    )  # fmt: skip
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=whole(1, 256),
        default=cores(),
        help="files at a time, about 1 GB of memory each (default: all cores)",
    )
    add_dask(parser)
    add_option(parser, "--restart", old=("--again",), action="store_true", help="do finished files again")
    add_glass(parser)
    add_json(parser)
    parser.add_argument("--quiet", action="store_true", help=QUIET_HELP)
    parser.set_defaults(run=run, kept="finished files are kept; the same command goes on")


def run(args: argparse.Namespace) -> int:
    """Survey a folder; 1 where a file met a fault of neurolens."""
    from neurolens.base.progress import Progress
    from neurolens.readers.any_format import collection_of
    from neurolens.readers.source import MAX_BYTES
    from neurolens.study.survey import SurveySettings, summary_of
    from neurolens.study.survey_page import summary_lines
    from neurolens.study.survey_run import TIME_LIMIT_S, survey

    check_run_folder(args.out, "neurolens survey", "--output")
    if args.out.resolve() == args.folder.resolve():
        raise InputError("neurolens survey", "--output", str(args.out), "a folder other than that of the lenses")
    collection = collection_of(args.folder)
    settings = SurveySettings(not args.no_fit, args.terms, args.rays, args.seed, args.half_field)
    glasses = [(file.name, read_bytes(file, MAX_BYTES, "a glass catalogue")) for file in args.glass_files]
    progress = Progress(quiet=args.quiet)
    limit_s = TIME_LIMIT_S
    with Processes(args.jobs, limit_s) if args.dask is None else Dask(args.dask, limit_s) as executor:
        records = survey(collection, args.out, settings, executor, progress, glasses=glasses, again=args.restart)
    summary = {**summary_of(records), "others": collection.others, "page": str(args.out / "survey.html")}
    lines = [*summary_lines(records, collection.others), f"Look at {args.out / 'survey.html'}"]
    answer(args, summary, lambda: printable("\n".join(lines)))
    return 1 if summary["fault"] else 0
