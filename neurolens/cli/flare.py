"""`neurolens flare LENS --light AZ,EL ...`: the ghosts of lights as a table and as a picture with layers."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from neurolens.base.errors import InputError
from neurolens.base.settings import add_options, from_options, positive, setting, titled
from neurolens.cli.arguments import (
    Glasses,
    LensState,
    Parser,
    Reporting,
    check_suffix,
    exposure,
    film_size,
    floats,
    lens,
    lens_state,
    output_path,
)  # fmt: skip
from neurolens.cli.keys import Frames, frames_group
from neurolens.render.settings import ColourSpaceName, FlareSettings

_COMMAND = "neurolens flare"
_QUICK_WIDTH = 480  # pixels at most
_LIGHTS, _PICTURE, _LAYERS = "lights, at least one; all of them together", "picture", "layers"
_SETTINGS = {  # the fields of `FlareSettings` by the titles of their options
    "": ["coating"],
    _LIGHTS: ["most"],
    _PICTURE: ["cell_px", "bins"],
    _LAYERS: ["brightest", "without", "starburst"],
    "photons, and what scatters them": [
        *("photons", "most_reflections", "kernel_px", "glare", "barrel", "sensor", "dust", "haze_per_mm", "seed")
    ],
}


def _gain(text: str) -> tuple[str, list[float]]:
    """The type of --gain: a name, and factors of red, green and blue."""
    name, _, rest = text.partition("=")
    factors = floats(rest, "/")
    if len(factors) not in (1, 3) or not all(0 <= v < math.inf for v in factors):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=X or NAME=R/G/B, of at least 0")
    return name, factors * (3 // len(factors))


@dataclass(frozen=True, kw_only=True)
class Flare(Glasses, Reporting):
    """Trace all ghosts of a lens exactly: light that two of its surfaces reflect on its way to the film, with
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

    about: ClassVar[str] = "ghosts of lights: a table, and a picture with layers"
    epilog: ClassVar[str] = """\
examples:
  neurolens flare laikin_double_gauss_50 --light 15,8 --path g08-06 path.png
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating quarter-wave --blades 6 --f-number 8 -o flare.exr
  neurolens flare lenses/ogawa_zoom_70_200.toml --zoom 100 --light -12,3,3/2.5/1.5 --layers 8 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --coating multi-layer --barrel 0.05 --dust 0.01 -o flare.exr
  neurolens flare laikin_double_gauss_50 --light 15,8 --blades 7 --f-number 11 --starburst -o flare.exr
  neurolens flare laikin_double_gauss_50 --lights sun.csv --frames 1:48 --key camera.csv -o flare.exr"""

    file: Path = lens(positional=True)
    light: tuple[str, ...] = setting(
        (), "degrees to the right of and above the axis, as the camera sees it; irradiance at the lens, radiance "
        "times solid angle in sr, as a number or R/G/B, of a point (default: the sun's disc with pi, which lights a "
        "white card to radiance 1); and distance in metres (default: inf); repeatable",
        metavar="AZ,EL[,E[,M]]", title=_LIGHTS,
    )  # fmt: skip
    lights: tuple[Path, ...] = setting(
        (), "a scene (.toml), whose shapes that shine, points, spots and sun the camera of the scene sees; or a list, "
        "CSV or JSON, with azimuth_deg, elevation_deg, and where wanted light (a name), frame (keys), r, g, b, "
        "diameter_deg (of a disc; the sun has 0.53), distance_m, visible (share that shows); repeatable",
        title=_LIGHTS,
    )  # fmt: skip
    image: Path | None = setting(
        None, "connected regions of this picture by the same lens, film and focus that reach --threshold, as lights "
        "far away; # in its name stands for the frame's digits", metavar="PLATE.exr", title=_LIGHTS,
    )  # fmt: skip
    threshold: float = setting(
        2.0, "of --image: value of a colour, where a white card of radiance 1 is 1; pixels count in full from 2 T on, "
        "so that none switches on at once (default: 2)",
        kind=positive("a value of the picture"), metavar="T", title=_LIGHTS,
    )  # fmt: skip
    out: Path | None = output_path(
        "OUT.exr", "picture to write; the preview is OUT.png (default: only the table)", None
    )
    path: tuple[str, str] | None = setting(
        None, "draw the rays of one ghost of the first light (PNG, PDF, SVG)",
        kind=str, nargs=2, metavar=("GHOST", "OUT"),
    )  # fmt: skip
    film: tuple[float, float] = setting(
        (36.0, 24.0), "in mm (default: 36x24)", kind=film_size, metavar="WxH", title=_PICTURE
    )
    width: int = setting(960, "of the picture (default: 960)", within=(1, 16384), metavar="PIXELS", title=_PICTURE)
    exposure: float | None = exposure(
        None, "99% of the lit pixels become no brighter than 0.8; frames share one value", title=_PICTURE
    )
    colour_space: ColourSpaceName | None = setting(
        None, "of the EXR, linear: sRGB (D65) or ACEScg (AP1, the white of ACES); default: that of --image, else of a "
        "scene's [film] table, else sRGB", title=_PICTURE,
    )  # fmt: skip
    quick: bool = setting(
        False, "at most 480 pixels wide, 5 wavelengths and 65536 photons a light and wavelength, --cell at least 24",
        old=("preview",), title=_PICTURE,
    )  # fmt: skip
    gain: tuple[tuple[str, list[float]], ...] = setting(
        (), "factor of a layer (ghosts) or a ghost (g07-03), or one for each colour, NAME=R/G/B; repeatable, gains "
        "multiply", kind=_gain, metavar="NAME=X", old=("tint",), title=_LAYERS,
    )  # fmt: skip
    threads: int = setting(2, "default: 2", within=(1, 256))
    frames: Frames = frames_group(
        "flare of these frames to OUT.0001.exr and so on, of lights by their keys in lists, the lens, and the camera "
        "of a scene of --lights by --key; a frame that exists is kept."
    )
    restart: bool = setting(False, "of --frames: make those that exist again")
    state: LensState = lens_state()

    settings: FlareSettings = FlareSettings()
    frame: int | None = None
    position_m: tuple[float, float, float] | None = None  # of a scene's camera
    look_at_m: tuple[float, float, float] | None = None

    @property
    def focus_m(self) -> float:
        """Distance to the object in focus in metres."""
        return math.inf if self.state.focus_m is None else self.state.focus_m

    @property
    def picture(self) -> Path:
        """The picture to write, with -o."""
        assert self.out is not None
        return self.out

    @classmethod
    def add_options(cls, parser: Parser) -> None:
        """Add its arguments and options, those of `FlareSettings` under several titles."""
        super().add_options(parser)
        for title, names in _SETTINGS.items():
            add_options(titled(parser, title) or parser, FlareSettings, names, most_reflections=None)

    @classmethod
    def of(cls, args: argparse.Namespace) -> Flare:
        """The command with the settings of its flare.

        Raises:
            InputError: options that exclude each other.
        """
        _check(args)
        flare = super().of(args)
        flare.frames.check(_COMMAND)
        gains: dict[str, tuple[float, float, float]] = {}
        for name, factors in flare.gain:
            r, g, b = (a * b for a, b in zip(gains.get(name, (1.0, 1.0, 1.0)), factors, strict=True))
            gains[name] = (r, g, b)
        settings = replace(from_options(FlareSettings, args), gains=gains)
        width = min(flare.width, _QUICK_WIDTH) if flare.quick else flare.width
        return replace(flare, settings=settings.quick() if flare.quick else settings, width=width)

    def run(self) -> int:
        """Trace the ghosts, and print or write them."""
        from neurolens.cli.flare_run import run_flare

        return run_flare(self)


def _check(args: argparse.Namespace) -> None:
    """Refuse options that exclude each other and files that cannot be written; raises InputError."""
    if args.frames is not None and args.output is None:
        raise InputError(_COMMAND, "--frames", f"({len(args.frames)})", "-o beside it")
    by_chance = args.photons or args.glare or args.barrel or args.sensor or args.dust or args.haze_per_mm
    if not by_chance and args.reflections not in (None, 2):
        expected = "2, or --photons or --glare beside it, whose light is reflected more often"
        raise InputError(_COMMAND, "--reflections", args.reflections, expected)
    if args.photons and args.layers:
        expected = "no --photons beside it: they tell no single ghosts apart"
        raise InputError(_COMMAND, "--layers", args.layers, expected)
    if args.output is not None:
        from neurolens.frames.frame import Files

        Files.of(args.output)
    if args.path is not None:
        check_suffix(Path(args.path[1]), "--path", (".png", ".pdf", ".svg"))
