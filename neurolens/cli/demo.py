"""`neurolens demo`: one scene through a lens's model, its exact prescription, a thin lens and a pinhole, on a page."""

from __future__ import annotations

import argparse
import importlib.util
import shlex
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text, library
from neurolens.base.records import program
from neurolens.cli import render
from neurolens.cli.arguments import Parser, add_output, whole

_DESCRIPTION = """\
Render lights at many depths through a model of a 50 mm f/1.8 double Gauss, the lens itself (where the extra
"train" is installed), a thin lens and a pinhole that show the plane in focus at the same size, then through a
fisheye's model, and write them on one page, each with its command. Needs no checkout: the library ships."""
_LENS = "laikin_double_gauss_50"
_PICTURES = (
    ("model", f"{_LENS}.mlp-16x2", "its model, a network of 556 weights: cat's eyes, dark corners, colour fringes"),
    ("exact", _LENS, "the lens itself, every ray through every surface"),
    ("thin", "thin", "a thin lens: round discs to the corner"),
    ("pinhole", "pinhole", "a pinhole: no blur at all"),
    ("fisheye", "isshiki_fisheye_10.mlp-16x2", "another lens: the model of a 180-degree fisheye"),
)
_SIZE = "--focal-length 49.64"
_MORE = {"thin": f"{_SIZE} --f-number 1.8", "pinhole": _SIZE, "fisheye": "--film 30x16.875"}


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "demo", help="one scene through a lens, its model, a thin lens and a pinhole", description=_DESCRIPTION
    )
    add_output(parser, "FOLDER", "default: neurolens-demo", default=Path("neurolens-demo"))
    parser.add_argument("--width", metavar="PIXELS", type=whole(1, 4096), default=480, help="(default: 480)")
    parser.add_argument("--samples", metavar="N", type=whole(1, 2**16), default=32, help="a pixel (default: 32)")
    parser.set_defaults(run=run, kept="pictures so far are kept; the same command goes on")


def run(args: argparse.Namespace) -> int:
    """Render and write the page."""
    from neurolens.base.html import html
    from neurolens.study.pages import figures_of

    folder = args.out
    if folder.exists() and not folder.is_dir():
        raise InputError("neurolens demo", "--output", str(folder), "a folder")
    folder.mkdir(parents=True, exist_ok=True)
    parser = Parser()
    render.add_parser(parser.add_subparsers())
    figures, traced = [], importlib.util.find_spec("torch") is not None
    for name, camera, caption in _PICTURES:
        if name == "exact" and not traced:
            continue
        scene = str(library() / "experiments" / "scenes" / "lights.toml")
        size = ["--width", str(args.width), "--samples", str(args.samples)]
        words = ["render", scene, "--camera", camera, *_MORE.get(name, "").split(), *size]
        words += ["-o", str(folder / f"{name}.exr")]
        command = f"{program()} {shlex.join(words)}"
        print(command, flush=True)
        given = parser.parse_args(words)
        given.run(given)
        figures.append({"file": f"{name}.png", "title": caption, "caption": command})
    page = html("demo.html", title="One scene, five cameras", shown=figures_of(folder, figures))
    atomic_write_text(folder / "index.html", page)
    more = [f"  {program()} {words}" for words in ("--help", "models", "lens list")]
    more[2] += "" if traced else "   # with the extra 'train', which traces lenses"
    print("\n".join([f"\nLook at {folder}/index.html\nThen", *more]))
    return 0
