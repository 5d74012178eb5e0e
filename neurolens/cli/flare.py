"""`neurolens flare LENS --light AZ,EL ...`: the ghosts of lights as a table and as a picture with layers."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.options import add_options, from_options
from neurolens.cli.arguments import (
    add_exposure,
    add_json,
    add_lens,
    add_lens_state,
    add_option,
    add_output,
    add_within,
    between,
    check_suffix,
    positive,
    whole,
)
from neurolens.cli.render import film_size
from neurolens.cli.render_frames import add_frames
from neurolens.render.settings import FilmSettings, FlareSettings

_DESCRIPTION = """\
Trace all ghosts of a lens exactly: light that two of its surfaces reflect on its way to the film, with
the reflectance of Fresnel's equations or of the coatings, all rims, the shape of the stop, and the
spectrum. The command prints the brightest ghosts with their energy, position and size. Positions are
on the film itself, which pictures show turned by 180 degrees: a light to the right is imaged at x < 0.

With -o the ghosts are written as an OpenEXR picture that can be added to a render of the same lens,
film and focus: R, G and B are the sum of the layers (ghosts.R, .G, .B, and so on). The --layers ghosts
with the greatest values on the film become layers of their own (g07-03 is reflected at surface 7, then
at surface 3, counted from 0 at the front), and the layer "rest" has the others. A PNG preview beside
the EXR shows the flare, brighter by --exposure. Values are those of `neurolens render`: a white card of
radiance 1 is 1 on the axis.

Each surface divides light by the mean of both polarisations. If polarisation were followed from surface
to surface, the light of all ghosts would change by -2 to +12% in three lenses tried, and that of single
bright ghosts by -22 to +48%, most in coated lenses. Edges of ghosts are as rays draw them, without the
rings of diffraction, which no option adds.

With --photons light goes on by chance instead, with any number of reflections, smoothed by a kernel.
With --glare, or if anything scatters, photons of the same kind make the layer "glare": light that is
reflected more than twice or scatters, so that ghosts and glare together are all the light. With
--starburst the layer "starburst" has the light that diffraction sends aside, by the shape of the
opening as each light sees it: the streaks of blades. It is 0 at the image of the light itself, which a
render has. Needs the extra "train" (torch) and a C compiler."""
_EPILOG = """\
examples:
  neurolens flare laikin_double_gauss_50 --light 15,8 --path g08-06 path.png
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating quarter-wave --blades 6 --f-number 8 -o flare.exr
  neurolens flare lenses/ogawa_zoom_70_200.toml --zoom 100 --light -12,3,3/2.5/1.5 --layers 8 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating multi-layer --barrel 0.05 --dust 0.01 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --blades 7 --f-number 11 --starburst -o flare.exr
  neurolens flare laikin_double_gauss_50 --lights sun.csv --frames 1:48 --key camera.csv -o flare.exr
  neurolens flare laikin_double_gauss_50 --fit ghosts.onnx; neurolens flare ghosts.onnx --light 15,8 -o flare.exr"""
_COMMAND = "neurolens flare"
_QUICK_WIDTH = 480  # pixels at most
_FRAMES = (
    "flare of these frames to OUT.0001.exr and so on, of lights by their keys in lists, the lens, and the camera of a "
    "scene of --lights by --key; a frame that exists is kept. Fitted ghosts keep their focus and zoom"
)


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "flare", help="ghosts of lights: a table, and a picture with layers", description=_DESCRIPTION, epilog=_EPILOG
    )
    add_lens(parser, "file", "; a model is one of fitted ghosts", models=True)
    _add_lights(parser)
    add_options(parser, FlareSettings, ["coating"])
    add_output(parser, "OUT.exr", "picture to write; the preview is OUT.png (default: only the table)")
    parser.add_argument(
        "--path", metavar=("GHOST", "OUT"), nargs=2,
        help="draw the rays of one ghost of the first light (PNG, PDF, SVG)",
    )  # fmt: skip
    _add_picture(parser)
    group = parser.add_argument_group("fitted ghosts")
    group.add_argument(
        "--fit", metavar="OUT", type=Path,
        help="fit polynomials to the ghosts, for lights in any direction and any smaller stop: OUT.onnx, which then "
        "stands for the lens; of such a file OUT.h or OUT.glsl, a function a ghost",
    )  # fmt: skip
    group.add_argument(
        "--angle", metavar="DEG", type=between(0.1, 89, "degrees"), default=35.0,
        help="of --fit: largest angle between light and axis (default: 35)",
    )  # fmt: skip
    about = "of --fit: RMS on the film in um at which a ghost's degree is high enough (default: 10um)"
    add_within(group, about, default=("rms_um", 10.0))
    add_frames(parser, _FRAMES)
    parser.add_argument("--restart", action="store_true", help="of --frames: make those that exist again")
    add_lens_state(parser)
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="nothing is written", position_m=None, look_at_m=None, frame=None)


def _add_lights(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("lights, at least one; all of them together")
    group.add_argument(
        "--light", metavar="AZ,EL[,E[,M]]", action="append", default=[], dest="light",
        help="degrees to the right of and above the axis, as the camera sees it; irradiance at the lens, radiance "
        "times solid angle in sr, as a number or R/G/B, of a point (default: the sun's disc with pi, which lights a "
        "white card to radiance 1); and distance in metres (default: inf); repeatable",
    )  # fmt: skip
    group.add_argument(
        "--lights", metavar="FILE", type=Path, action="append", default=[],
        help="a scene (.toml), whose shapes that shine, points, spots and sun the camera of the scene sees; or a list, "
        "CSV or JSON, with azimuth_deg, elevation_deg, and where wanted light (a name), frame (keys), r, g, b, "
        "diameter_deg (of a disc; the sun has 0.53), distance_m; repeatable",
    )  # fmt: skip
    group.add_argument(
        "--image", metavar="PLATE.exr", type=Path,
        help="connected regions of this picture by the same lens, film and focus that reach --threshold, as lights far "
        "away; # in its name stands for the frame's digits",
    )  # fmt: skip
    group.add_argument(
        "--threshold", metavar="T", type=positive("a value of the picture"), default=2.0,
        help="of --image: value of a colour, where a white card of radiance 1 is 1; pixels count in full from 2 T on, "
        "so that none switches on at once (default: 2)",
    )  # fmt: skip
    add_options(group, FlareSettings, ["most"])


def _add_picture(parser: argparse.ArgumentParser) -> None:
    """Add what the picture is, and the settings of its flare."""
    group = parser.add_argument_group("picture")
    group.add_argument("--film", metavar="WxH", type=film_size, default=(36.0, 24.0), help="in mm (default: 36x24)")
    group.add_argument(
        "--width", metavar="PIXELS", type=whole(1, 16384), default=960, help="of the picture (default: 960)"
    )
    add_options(group, FlareSettings, ["cell_px", "bins"])
    add_exposure(group, None, "99% of the lit pixels become no brighter than 0.8; frames share one value")
    (space,) = add_options(group, FilmSettings, ["colour_space"], unset=True)
    space.help = f"{space.help}; default: that of --image, else of a scene's [film] table, else sRGB"
    add_option(
        group, "--quick", old=("--preview",), action="store_true",
        help="at most 480 pixels wide, 5 wavelengths and 65536 photons a light and wavelength, --cell at least 24",
    )  # fmt: skip
    group = parser.add_argument_group("layers")
    add_options(group, FlareSettings, ["brightest", "without", "starburst"])
    add_option(
        group, "--gain", old=("--tint",), metavar="NAME=X", action="append", default=[], dest="gains", type=_gain,
        help="factor of a layer (ghosts) or a ghost (g07-03), or one for each colour, NAME=R/G/B; repeatable, gains "
        "multiply",
    )  # fmt: skip
    group = parser.add_argument_group("photons, and what scatters them")
    names = ("photons", "most_reflections", "kernel_px", "glare", "barrel", "sensor", "dust", "haze_per_mm", "seed")
    add_options(group, FlareSettings, names, most_reflections=None)
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=2, help="default: 2")


def _gain(text: str) -> tuple[str, list[float]]:
    """The type of --gain: a name, and factors of red, green and blue."""
    name, _, rest = text.partition("=")
    try:
        factors = [float(word) for word in rest.split("/")]
    except ValueError:
        factors = []
    if len(factors) not in (1, 3) or not all(0 <= v < math.inf for v in factors):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=X or NAME=R/G/B, of at least 0")
    return name, factors * (3 // len(factors))


def run(args: argparse.Namespace) -> int:
    """Check the options, then trace the ghosts and print or write them."""
    _check(args)
    args.settings = _settings(args)
    if args.quick:
        args.width = min(args.width, _QUICK_WIDTH)
    from neurolens.cli.flare_run import run_flare

    return run_flare(args)


def _settings(args: argparse.Namespace) -> FlareSettings:
    """The settings of the options."""
    gains: dict[str, tuple[float, float, float]] = {}
    for name, factors in args.gains:
        r, g, b = (a * b for a, b in zip(gains.get(name, (1.0, 1.0, 1.0)), factors, strict=True))
        gains[name] = (r, g, b)
    settings = replace(from_options(FlareSettings(), args), gains=gains)
    return settings.quick() if args.quick else settings


def _check(args: argparse.Namespace) -> None:
    """Refuse options that exclude each other and files that cannot be written; raises InputError."""
    for name in ("light", "lights", "image", "out", "path", "frames", "photons", "glare", "starburst"):
        if args.fit is not None and getattr(args, name):
            expected = f"no --{name} beside it: it writes the ghosts of one state, for any light"
            raise InputError(_COMMAND, "--fit", args.fit, expected)
    if args.within[0] != "rms_um":
        raise InputError(_COMMAND, "--within", f"{args.within[1]:g}px", "micrometres, as 10um: a ghost has no pixels")
    if args.frames is None and args.key:
        raise InputError(_COMMAND, "--key", args.key[0], "--frames beside it")
    if args.frames is not None:
        if args.out is None:
            raise InputError(_COMMAND, "--frames", f"({len(args.frames)})", "-o beside it")
        args.kept = "the frames that are there are kept: the same command goes on"
    by_chance = args.photons or args.glare or args.barrel or args.sensor or args.dust or args.haze_per_mm
    if not by_chance and args.reflections not in (None, 2):
        expected = "2, or --photons or --glare beside it, whose light is reflected more often"
        raise InputError(_COMMAND, "--reflections", args.reflections, expected)
    if args.photons and args.layers:
        expected = "no --photons beside it: they tell no single ghosts apart"
        raise InputError(_COMMAND, "--layers", args.layers, expected)
    if args.out is not None:
        from neurolens.frames.frame import Files

        Files.of(args.out)
    if args.path is not None:
        check_suffix(Path(args.path[1]), "--path", (".png", ".pdf", ".svg"))
