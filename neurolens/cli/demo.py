"""`neurolens demo`: one scene through a lens's model, its exact prescription, a thin lens and a pinhole, on a page."""

from __future__ import annotations

import importlib.util
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from neurolens.base.files import atomic_write_text, library
from neurolens.base.records import program
from neurolens.base.settings import setting
from neurolens.cli.arguments import Command, Parser, check_run_folder, output_path
from neurolens.cli.render import Render

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


@dataclass(frozen=True, kw_only=True)
class Demo(Command):
    """Render lights at many depths through a model of a 50 mm f/1.8 double Gauss, the lens itself (where the extra
    "train" is installed), a thin lens and a pinhole that show the plane in focus at the same size, then through a
    fisheye's model, and write them on one page, each with its command. Needs no checkout: the library ships."""

    about: ClassVar[str] = "one scene through a lens, its model, a thin lens and a pinhole"
    kept: ClassVar[str] = "pictures so far are kept; the same command goes on"

    out: Path = output_path("FOLDER", "default: neurolens-demo", Path("neurolens-demo"))
    width: int = setting(480, "(default: 480)", within=(1, 4096), metavar="PIXELS")
    samples: int = setting(32, "a pixel (default: 32)", within=(1, 2**16))

    def run(self) -> int:
        """Render and write the page."""
        from neurolens.base.html import html
        from neurolens.study.pages import figures_of

        check_run_folder(self.out, self.called, "--output")
        self.out.mkdir(parents=True, exist_ok=True)
        parser = Parser()
        Render.add_parser(parser.add_subparsers())
        scene = str(library() / "experiments" / "scenes" / "lights.toml")
        figures, traced = [], importlib.util.find_spec("torch") is not None
        for name, camera, caption in _PICTURES:
            if name == "exact" and not traced:
                continue
            size = ["--width", str(self.width), "--samples", str(self.samples), "-o", str(self.out / f"{name}.exr")]
            words = ["render", scene, "--camera", camera, *_MORE.get(name, "").split(), *size]
            command = f"{program()} {shlex.join(words)}"
            print(command, flush=True)
            args = parser.parse_args(words)
            args.run(args)
            figures.append({"file": f"{name}.png", "title": caption, "caption": command})
        page = html("demo.html", title="One scene, five cameras", shown=figures_of(self.out, figures))
        atomic_write_text(self.out / "index.html", page)
        more = [f"  {program()} {words}" for words in ("--help", "models", "lens list")]
        more[2] += "" if traced else "   # with the extra 'train', which traces lenses"
        print("\n".join([f"\nLook at {self.out}/index.html\nThen", *more]))
        return 0
