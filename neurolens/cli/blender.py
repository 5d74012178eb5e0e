"""`neurolens blender`: the extension for Blender, packed with lenses, and lenses of your own in it."""

from __future__ import annotations

import argparse
import os
import time
import warnings
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import check_writable
from neurolens.base.files import library as shipped
from neurolens.base.progress import Progress
from neurolens.cli.arguments import (
    Parser,
    add_json,
    add_lens,
    add_option,
    add_output,
    check_folder,
    check_suffix,
    whole,
)
from neurolens.cli.output import answer

_DESCRIPTION = """\
Real lenses as cameras of Blender's Cycles (4.5 and later): an extension with a panel at the
camera's data, where a lens is put on with one click and taken off with one."""
_BUILD = """\
Pack the extension with a folder of models and with the lens files of the folder lenses/ beside it: of each
lens the best polynomial, the best network and the exact lens, every surface traced.
What cannot be a shader is left out and said.

Finished lenses are kept: a build that was stopped goes on where it was, and a second one is quick.

Install it in Blender: Edit > Preferences > Get Extensions > Install from Disk."""
_ADD = """\
Put a model (.onnx) or a lens file of any format into the extension: into the user folder of an installed
one (the newest Blender of this machine that has it), or into a zip. A form of a lens replaces the one
that was there. In Blender, "Read Lenses Again" in the panel shows it."""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "blender", help="the extension for Blender, and lenses in it", description=_DESCRIPTION
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=Parser)
    build = actions.add_parser("build", help="pack the extension as a zip", description=_BUILD)
    add_output(build, "OUT.zip", "default: neurolens.zip", default=Path("neurolens.zip"))
    build.add_argument(
        "--models", metavar="DIR", type=Path, default=shipped() / "models", help="default: the models that ship"
    )
    build.add_argument(
        "--lens", metavar="LENS", action="append", default=[],
        help="only this lens, repeatable: LENS of LENS.ols-64.onnx or of LENS.toml (default: all)",
    )  # fmt: skip
    build.add_argument("--no-exact", action="store_true", help="leave exact lenses out")
    build.add_argument(
        "--jobs", metavar="N", type=whole(1, 64), default=min(8, os.cpu_count() or 1),
        help="processes that make shaders, each of a core and 0.5 GB (default: all cores, at most 8)",
    )  # fmt: skip
    add_json(build, quiet=True)
    build.set_defaults(run=run_build, kept="no zip was written; finished shaders are kept for the next run")
    add = actions.add_parser("add", help="put a lens into the extension", description=_ADD)
    add_lens(add, "file", models=True)
    add_option(
        add, "--extension", old=("--to",), metavar="ZIP|DIR", type=Path,
        help="a packed extension, or a user folder of one",
    )  # fmt: skip
    add.add_argument("--zoom", metavar="STATE", help="state of a zoom, by name or focal length in mm; range: a setting")
    add_json(add, quiet=True)
    add.set_defaults(run=run_add, kept="nothing was added")


def run_build(args: argparse.Namespace) -> int:
    """Pack the extension."""
    check_suffix(args.out, "--output", (".zip",))
    check_folder(args.out, "--output")
    check_writable(args.out)
    if not args.models.is_dir():
        raise InputError("neurolens blender build", "--models", str(args.models), "a folder of models that exists")
    from neurolens.blender.pack import write_pack
    from neurolens.cli.blender_lenses import forms_of, library, packed_of, stated_lens
    from neurolens.readers.any_format import read_any

    began, packed = time.perf_counter(), []
    lens_folder = args.models.parent / "lenses"
    places = list(library(args.models, lens_folder, args.lens))
    if not places:
        raise InputError("neurolens blender build", "--models", str(args.models), "a folder with models (.onnx)")
    exact = [] if args.no_exact else [lens_file for _, lens_file in places if lens_file is not None]
    files = [*exact, *(file for models, _ in places for file in models)]  # exact lenses take longest, so they go first
    progress = Progress(quiet=args.quiet)
    with progress.stage("shaders") as report:
        forms, left = forms_of(files, args.jobs, report)
    with progress.stage("thumbnails") as report:
        for models, lens_file in places:
            own = [f for f in (*models, lens_file) if f is not None and f in forms]
            if own:
                lens = stated_lens(own[0], lens_folder) if lens_file is None else read_any(lens_file)
                packed.append(packed_of(own, [forms[f] for f in own], lens=lens))
            report(len(packed) / len(places))
    for why in left.values():
        warnings.warn(f"left out: {why}", NeurolensWarning, stacklevel=2)
    if not packed:
        raise InputError("neurolens blender build", "--models", str(args.models), "a folder with a model for a shader")
    write_pack(args.out, packed)
    data = {
        "file": str(args.out),
        "bytes": args.out.stat().st_size,
        "lenses": {p.lens_id: [f.model or f.kind for f in p.forms] for p in packed},
        "left_out": {file.name: why for file, why in left.items()},
        "seconds": time.perf_counter() - began,
    }
    return answer(args, data, lambda: f"{args.out}: {len(packed)} lenses, {sum(len(p.forms) for p in packed)} shaders")


def run_add(args: argparse.Namespace) -> int:
    """Add a lens."""
    from neurolens.blender.pack import add_to_folder, add_to_zip, check_takes, user_folders
    from neurolens.cli.blender_lenses import form_of, packed_of

    to = args.extension
    if to is None:
        to = next(iter(user_folders()), None)
    if to is None:
        expected = "a zip or a folder: no Blender of this machine has the extension installed"
        raise InputError("neurolens blender add", "--extension", "(missing)", expected)
    check_takes(to)
    form = form_of(args.file, zoom=args.zoom, quiet=args.quiet)
    lens = packed_of([args.file], [form], zoom=args.zoom)
    (add_to_zip if to.suffix == ".zip" else add_to_folder)(to, lens)
    data = {"lens": lens.lens_id, "to": str(to), "forms": [f.model or f.kind for f in lens.forms]}
    return answer(args, data, lambda: f"{lens.name} ({', '.join(data['forms'])}) is in {to}")
