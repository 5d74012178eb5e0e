"""`neurolens view`: one page in which lenses and their models run, for a browser."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from neurolens.base.settings import setting, setting_of
from neurolens.cli.arguments import Answering, Glasses, check_suffix, lens, output_path
from neurolens.cli.blender import Build

_DOWNLOADS = ("glsl", "onnx", "c", "osl")


def _kinds(text: str) -> list[str]:
    words = text.split(",")
    if words[0] != "glsl" or len(set(words)) < len(words) or not set(words) <= set(_DOWNLOADS):
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected glsl, and of {', '.join(_DOWNLOADS[1:])} what is wanted"
        )
    return words


@dataclass(frozen=True, kw_only=True)
class View(Glasses, Answering):
    """Write one page for a browser, which needs neither server nor network: lenses traced exactly and their
    models as GLSL in a path tracer of WebGPU, or of WebGL2 where the browser has no WebGPU, side by side or
    as their difference, at any focus, stop, blades and wavelength; their layout with the rays of a pixel,
    their error and what a ray costs there.

    LENS is a lens file of any format that `neurolens convert` reads, or a name of lenses/; MODEL an exported
    model, shown with the lens of its name. Without any, every lens of lenses/ with the best polynomial and
    the best network of models/."""

    about: ClassVar[str] = "write a page that runs lenses and models in a browser"
    epilog: ClassVar[str] = """\
examples:
  neurolens view -o view.html
  neurolens view petzval_portrait_100 laikin_double_gauss_50 -o two.html
  neurolens view my_lens.zmx runs/mine/models/ols-64.onnx -o mine.html
  neurolens view laikin_double_gauss_50 --ghosts -o flare.html"""
    kept: ClassVar[str] = "nothing was written"

    lenses: tuple[Path, ...] = lens((), models=True, positional=True, metavar="LENS|MODEL", nargs="*")
    out: Path = output_path("FILE.html", "page (default: view.html)", Path("view.html"))
    downloads: Sequence[str] = setting(
        _DOWNLOADS, "of glsl, onnx, c, osl what the page brings as files of each form (default: all; osl takes seconds "
        "a form, a minute of a zoom, once); the last are left out where the page grows beyond 3 MB, or 40 kB a lens, "
        "exact lenses' first", kind=_kinds, metavar="KINDS",
    )  # fmt: skip
    ghosts: bool = setting(
        False, "a lamp that can be dragged draws its ghosts, the 24 brightest of each LENS; needs a C compiler"
    )
    jobs: int = setting_of(Build, "jobs", Build.jobs)

    def run(self) -> int:
        """Write the page."""
        check_suffix(self.out, "--output", (".html", ".htm"))
        from neurolens.cli.view_run import run_view

        return run_view(self)
