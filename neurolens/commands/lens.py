"""`neurolens lens FILE`: what a lens file holds, computed and drawn."""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.commands import lens_list, lens_rims
from neurolens.commands.arguments import add_json, add_lens_state, aperture_of, focus_of, given_options
from neurolens.commands.lens_text import lens_text
from neurolens.commands.output import print_json

if TYPE_CHECKING:
    from neurolens.optics.prescription import Lens
    from neurolens.surrogates.domain import Domain

_DESCRIPTION = """\
Read a lens file strictly and print what follows from it: focal length, pupils, film plane,
image circle, how much of the light gets through and what stops the rest, and anything
doubtful about it. "neurolens lens list" checks a whole folder and prints a table;
--derive-rims computes the rim diameters that a patent does not print.

Lengths are in mm along the axis, z = 0 at the front vertex, light travelling to +z; angles
are from the axis in degrees; first-order data is for the d line (587.56 nm). Needs the extra
"train" (torch)."""
_EPILOG = """\
examples:
  neurolens lens lenses/laikin_double_gauss_50.toml
  neurolens lens lenses/brendel_tessar_100.toml --efl 50 --focus 1.5 --layout tessar.png
  neurolens lens lenses/ogawa_zoom_70_200.toml --zoom 135mm --json
  neurolens lens list --layouts lenses.png
  neurolens lens lenses/brendel_tessar_100.toml --derive-rims -o tessar.toml"""
_LAYOUT_SUFFIXES = (".png", ".pdf", ".svg")


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "lens", help="first-order data, field and layout of a lens file", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("file", metavar="FILE", type=Path, help='lens file (lenses/*.toml), or the word "list"')
    parser.add_argument(
        "folder", metavar="FOLDER", type=Path, nargs="?", help='of lens files, after "list" (default: those that ship)'
    )
    add_lens_state(parser, {"efl": "as tabled", "f_number": "the tabled stop", "focus": "inf"})
    parser.add_argument(
        "--layout", metavar="OUT.png", type=Path,
        help="draw the lens with rays from three field points: axis, 70%% and edge of the film (.png, .pdf, .svg)",
    )  # fmt: skip
    lens_list.add_arguments(parser)
    lens_rims.add_arguments(parser)
    parser.add_argument(
        "--breathing", metavar="OUT.png", type=Path,
        help="draw field of view, focal length and magnification against the focus distance (.png, .pdf, .svg)",
    )  # fmt: skip
    add_json(parser)
    parser.set_defaults(run=run, kept="nothing is written but a finished --layout picture")


def _check_mode(args: argparse.Namespace, listing: bool) -> None:
    """Refuse an option that the chosen table would silently ignore."""
    alone = not listing and not args.derive_rims
    kinds = {
        "--layouts": (args.layouts is not None, listing, 'with "list"'),
        "FOLDER": (args.folder is not None, listing, 'after "list"'),
        "--vignetting": (args.vignetting is not None, args.derive_rims, "with --derive-rims"),
        "--breathing": (args.breathing is not None, alone, "with one lens file alone"),
        **{
            name: (True, not listing and not args.derive_rims, "with one lens file alone")
            for name in given_options(args)
        },
        "-o": (args.output is not None, args.derive_rims, "with --derive-rims"),
        "--half-field": (args.half_field is not None, args.derive_rims, "with --derive-rims"),
        "--derive-rims": (args.derive_rims, not listing, "with one lens file"),
        "--layout": (args.layout is not None, alone, "with one lens file alone"),
        **dict.fromkeys(given_options(args), (True, alone, "with one lens file alone")),
    }
    for option, (given, allowed, where) in kinds.items():
        if given and not allowed:
            raise InputError("neurolens lens", option, "(given)", f"this option only {where}")


def run(args: argparse.Namespace) -> int:
    """Print the data of a lens, and draw it where asked; or the table of a folder; or derived rims."""
    listing = str(args.file) == lens_list.WORD
    _check_mode(args, listing)
    if listing:
        return lens_list.run(args)
    if args.derive_rims:
        return lens_rims.run(args)
    for option in ("layout", "breathing"):
        if getattr(args, option) is not None:
            check_layout_path(getattr(args, option), f"--{option}")
    from neurolens.evaluate.describe import describe_lens, file_doubts, glass_table
    from neurolens.optics.lensfile import read_lens
    from neurolens.surrogates.domain import domain_of

    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)  # `describe_lens` says the same among its warnings
        tabled = read_lens(args.file)
    lens = tabled.at(
        zoom=args.zoom,
        focal_length_mm=args.efl,
        field_deg=args.field,
        f_number=args.f_number,
        focus_m=args.focus,
        focus=args.focusing,
    ).with_aperture(aperture_of(args) or tabled.aperture)
    focus, film_z = focus_of(args, tabled, lens), float(lens.film_z_mm or 0.0)
    domain = domain_of(lens, focus_m=(focus, focus), film_z_mm=(film_z, film_z))
    configurations = [
        {"name": c.name, "efl_mm": c.efl_mm, "object_distance_mm": c.object_distance_mm} for c in tabled.configurations
    ]
    data = {
        "file": str(args.file),
        **describe_lens(lens, domain),
        "zoom": args.zoom,
        "focusing": args.focusing,
        "derived": lens.derived,
        "aperture": lens.aperture and lens.aperture.settings(),
        "configurations": configurations,
        "surfaces": glass_table(lens),
        "layout": None if args.layout is None else str(args.layout),
        "breathing_plot": None if args.breathing is None else str(args.breathing),
    }
    data["warnings"] += file_doubts(tabled)
    if args.layout is not None:
        draw_layout(lens, domain, args.layout)
    if args.breathing is not None:
        from neurolens.evaluate.plots.breathing import draw_breathing

        found = draw_breathing(lens, args.breathing)
        data["breathing"] = {name: [asdict(b) for b in breaths] for name, breaths in found.items()}
    data["seconds"] = time.perf_counter() - began
    if args.json:
        print_json(data)
    else:
        print(lens_text(data))
    return 0


def check_layout_path(path: Path, option: str = "--layout") -> None:
    """Refuse a picture that could not be written before any work is done for it.

    Raises:
        InputError: another suffix, or no such folder.
    """
    if path.suffix.lower() not in _LAYOUT_SUFFIXES:
        raise InputError(path, option, path.suffix or "(no suffix)", f"one of {', '.join(_LAYOUT_SUFFIXES)}")
    if not path.parent.is_dir():
        raise InputError(path, option, str(path.parent), "a folder that exists")


def draw_layout(lens: Lens, domain: Domain, path: Path) -> None:
    """Draw the section of a lens with rays."""
    from neurolens.evaluate.layout import layout_profile
    from neurolens.evaluate.plots import lens_layout

    lens_layout(layout_profile(lens, domain), path)
