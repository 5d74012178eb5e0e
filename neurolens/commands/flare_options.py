"""Options of `neurolens flare` that say what is made and how finely, and the settings that they are."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from neurolens.commands.arguments import add_exposure, add_option, between, whole
from neurolens.commands.render import add_colour_space, film_size

if TYPE_CHECKING:
    from neurolens.flare.layers import FlareSettings

_PREVIEW = {"width": 480, "bins": 5, "photons": 1 << 16, "glare": 1 << 16}  # at most
_PREVIEW_CELL = 24.0
# Arguments that are numbers of `FlareSettings`, by its names.
_NUMBERS = (
    "cell_px", "photons", "most_reflections", "kernel_px", "glare", "starburst", "seed", "threads"
)  # fmt: skip
_GLARE = 1 << 18  # photons where anything scatters
# Of `Scatter`: option, attribute, highest value, unit, help.
_SCATTER = (
    ("--barrel", "barrel", 1.0, "SHARE", "of light that the barrel reflects, its rings and the stop, a fifth glossily"),
    ("--sensor", "sensor", 0.9, "SHARE", "of light that the film reflects, half of it as a mirror"),
    ("--dust", "dust", 1.0, "SHARE", "of the front that is dusty: light scatters there, mean cosine 0.98"),
    ("--haze", "haze_per_mm", 10.0, "PER_MM", "scattering in glass, inverse of the mean free path, mean cosine 0.9"),
)


def add_made(parser: argparse.ArgumentParser) -> None:
    """Add the options of the picture, its layers and photons."""
    _add_picture(parser)
    _add_layers(parser)
    _add_chances(parser)
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=2, help="default: 2")


def _add_picture(parser: argparse.ArgumentParser) -> None:
    """Add how large and how fine the picture is."""
    group = parser.add_argument_group("picture")
    group.add_argument("--film", metavar="WxH", type=film_size, default=(36.0, 24.0), help="in mm (default: 36x24)")
    group.add_argument(
        "--width", metavar="PIXELS", type=whole(1, 16384), default=960, help="of the picture (default: 960)"
    )
    group.add_argument(
        "--cell", metavar="PX", type=between(1, 256, "pixels"), default=8.0, dest="cell_px",
        help="size on film of the cells that a ghost is drawn by (default: 8; a quick look: 48)",
    )  # fmt: skip
    add_option(
        group, "--bins", old=("--wavelengths",), metavar="N", type=whole(1, 256), default=15,
        help="wavelengths of stars and photons, in equal steps from 400 to 700 nm; ghosts take what their colours "
        "need, at most four times as many (default: 15)",
    )  # fmt: skip
    add_exposure(group, None, "99% of the lit pixels become no brighter than 0.8; frames share one value")
    add_colour_space(group, "; default: that of --image, else of a scene's [film] table, else sRGB")
    add_option(
        group, "--quick", old=("--preview",), action="store_true",
        help="at most 480 pixels wide, 5 wavelengths and 65536 photons a light and wavelength, --cell at least 24",
    )  # fmt: skip


def _add_layers(parser: argparse.ArgumentParser) -> None:
    """Add what layers there are, and how bright they are."""
    group = parser.add_argument_group("layers")
    group.add_argument(
        "--layers", metavar="N", type=whole(0, 64), default=0,
        help="ghosts with a layer of their own, those with the greatest values on the film (default: 0)",
    )  # fmt: skip
    group.add_argument(
        "--without",
        metavar="LAYER",
        action="append",
        default=[],
        help="layer that is not made: ghosts, glare, starburst; repeatable",
    )
    group.add_argument(
        "--polarised", action="store_true", help="ghosts whose light keeps its polarisation from surface to surface"
    )
    group.add_argument("--starburst", action="store_true", help="the layer starburst; some seconds a light")
    group.add_argument(
        "--gain", metavar="NAME=X", action="append", default=[], type=_factor(1),
        help="of a layer (ghosts), a ghost (g07-03) or all that a surface reflects (s07); repeatable, gains multiply",
    )  # fmt: skip
    group.add_argument(
        "--tint", metavar="NAME=R/G/B", action="append", default=[], type=_factor(3), help="the same, of each colour"
    )


def _add_chances(parser: argparse.ArgumentParser) -> None:
    """Add what photons do."""
    group = parser.add_argument_group("photons, and what scatters them")
    group.add_argument(
        "--photons", metavar="N", type=whole(1, 1 << 30), default=0,
        help="instead of all pairs, photons with up to --reflections by chance, N a light and wavelength",
    )  # fmt: skip
    group.add_argument(
        "--reflections", metavar="N", type=whole(1, 1000), dest="most_reflections",
        help="of photons and glare at most (default: 10); of ghosts without them, 2 (the default) or 4",
    )  # fmt: skip
    group.add_argument(
        "--kernel", metavar="PX", type=between(0, 100, "pixels"), default=3.0, dest="kernel_px",
        help="radius of the kernel that smooths photons, where they are dense (default: 3); 0 leaves them",
    )  # fmt: skip
    group.add_argument(
        "--glare", metavar="N", type=whole(0, 1 << 30), default=0,
        help=f"photons a light and wavelength of the layer glare (default: {_GLARE} if anything scatters, else none)",
    )  # fmt: skip
    for option, name, most, unit, text in _SCATTER:
        group.add_argument(
            option, metavar=unit, type=between(0, most, "a number"), default=0.0, dest=name, help=f"{text} (default: 0)"
        )
    group.add_argument(
        "--seed", metavar="N", type=whole(0, 1 << 20), default=0,
        help="of the chances of photons, the same in all frames; ghosts have none (default: 0)",
    )  # fmt: skip


def _factor(size: int) -> Callable[[str], tuple[str, tuple[float, ...]]]:
    """Type of --gain and --tint: a name and the factors of red, green and blue."""

    def read(text: str) -> tuple[str, tuple[float, ...]]:
        name, _, rest = text.partition("=")
        try:
            found = tuple(float(word) for word in rest.split("/"))
        except ValueError:
            found = ()
        if len(found) != size or not all(0 <= v < math.inf for v in found):
            raise argparse.ArgumentTypeError(
                f"got {text!r}, expected NAME={'X' if size == 1 else 'R/G/B'}, of at least 0"
            )
        return name, found * (3 // size)

    return read


def complete(args: argparse.Namespace) -> None:
    """Photons of what scatters where none were asked for, and the bounds of a preview."""
    args.glare = args.glare or _GLARE * any(getattr(args, name) > 0 for _, name, *_ in _SCATTER)
    if args.quick:
        vars(args).update({name: min(getattr(args, name), most) for name, most in _PREVIEW.items()})
        args.cell_px = max(args.cell_px, _PREVIEW_CELL)


def settings_of(args: argparse.Namespace) -> FlareSettings:
    """The settings, but for the ghosts.

    Raises:
        InputError: as of `FlareSettings`.
    """
    from neurolens.flare.layers import FlareSettings
    from neurolens.flare.scatter import Scatter

    numbers = {name: getattr(args, name) for name in _NUMBERS}
    scatter = Scatter(**{name: getattr(args, name) for _, name, *_ in _SCATTER})
    return FlareSettings(
        wavelengths=args.bins, **numbers, scatter=scatter, without=tuple(args.without), gains=(*args.gain, *args.tint)
    )
