"""`neurolens flare LENS --light AZ,EL ...`: the ghosts of lights as a table and as a picture with layers."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.commands.arguments import (
    add_json,
    add_lens_state,
    between,
    check_suffix,
    lens_path,
    state_of,
    whole,
)
from neurolens.commands.output import answer, number, table
from neurolens.commands.render import film_size
from neurolens.evaluate.records import plain

if TYPE_CHECKING:
    from neurolens.flare.ghosts import Pair
    from neurolens.flare.picture import Ghost, Light
    from neurolens.optics.prescription import Lens

_DESCRIPTION = """\
Trace all ghosts of a lens exactly: light that two of its surfaces reflect on its way to the
film, with Fresnel's or the coatings' reflectance, all rims and the stop's shape, spectrally.
Prints the brightest by energy, place and size; with -o writes their picture as OpenEXR, to be
added to a render of the same lens, film and focus: R, G and B are all ghosts, and each of the
brightest --layers is one layer, NAME.R, .G, .B (g07-03: reflected at surface 7, then at 3,
counted from 0 at the front), the rest is "rest". Values are those of `neurolens render`: a
white card of radiance 1 is 1 on the axis. With --photons light goes on by chance instead, with
any number of reflections, smoothed by a kernel. Needs the extra "train" (torch) and a C compiler."""
_EPILOG = """\
examples:
  neurolens flare laikin_double_gauss_50 --light 15,8 --path g08-06 path.png
  neurolens flare laikin_double_gauss_50 --light 15,8,0.01 --coating quarter-wave --blades 6 --f-number 8 -o flare.exr
  neurolens flare lenses/ogawa_zoom_70_200.toml --zoom 100 --light -12,3,1/0.8/0.5 --layers 8 -o flare.exr"""
_SHOWN = 12  # ghosts of the table


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "flare", help="ghosts of lights: a table, and a picture with layers", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("file", metavar="LENS", type=Path, help="lens file, or the name of one of lenses/")
    parser.add_argument(
        "--light", metavar="AZ,EL[,E[,M]]", action="append", required=True, dest="lights",
        help="degrees to the right of and above the axis, as the camera sees it, irradiance at the lens (radiance "
        "times solid angle in sr; a number or R/G/B; default 1), and distance in metres (default inf); repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--coating", metavar="NAME",
        help="of every surface between glass and air that the lens file leaves bare: quarter-wave, v-coat, broadband",
    )  # fmt: skip
    parser.add_argument("-o", "--out", metavar="OUT.exr", type=Path, help="picture (default: only the table)")
    parser.add_argument(
        "--path",
        metavar=("GHOST", "OUT"),
        nargs=2,
        help="draw the rays of one ghost of the first light (PNG, PDF, SVG)",
    )
    parser.add_argument("--film", metavar="WxH", type=film_size, default=(36.0, 24.0), help="in mm (default: 36x24)")
    parser.add_argument(
        "--width", metavar="PX", type=whole(1, 16384), default=960, help="of the picture (default: 960)"
    )
    parser.add_argument(
        "--samples", metavar="N", type=whole(1, 1 << 30), default=1 << 18,
        help="rays a light and wavelength (default: 262144)",
    )  # fmt: skip
    parser.add_argument(
        "--wavelengths", metavar="N", type=whole(1, 256), default=15, help="from 400 to 700 nm (default: 15)"
    )
    parser.add_argument(
        "--layers", metavar="N", type=whole(0, 64), default=0, help="brightest ghosts as layers (default: 0)"
    )
    parser.add_argument(
        "--photons", metavar="N", type=whole(1, 1 << 30),
        help="instead of all pairs, photons with up to --reflections by chance, N a light and wavelength",
    )  # fmt: skip
    parser.add_argument("--reflections", metavar="N", type=whole(1, 1000), default=10, help="default: 10")
    parser.add_argument(
        "--kernel", metavar="PX", type=between(0, 100, "pixels"), default=3.0,
        help="radius of the kernel that smooths photons (default: 3)",
    )  # fmt: skip
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=2, help="default: 2")
    add_lens_state(parser, efl="as tabled", f_number="the widest")
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="nothing is written")


def run(args: argparse.Namespace) -> int:
    """Trace, print, write."""
    from neurolens.flare.ghosts import GhostTracer, coated
    from neurolens.flare.picture import ghost_table
    from neurolens.optics.lensfile import read_lens

    lights = [_light(text) for text in args.lights]
    if args.photons and args.layers:
        raise InputError("neurolens flare", "--layers", args.layers, "0 with --photons, which know no single ghosts")
    if args.out is not None:
        check_suffix(args.out, "--out", (".exr",))
    if args.path is not None:
        check_suffix(Path(args.path[1]), "--path", (".png", ".pdf", ".svg"))
    args.focus = float("inf") if args.focus is None else args.focus
    lens = state_of(args, read_lens(lens_path(args.file, "flare")))
    lens = lens if args.coating is None else coated(lens, args.coating)
    began = time.perf_counter()
    tracer = GhostTracer(lens)
    rows = [ghost_table(tracer, light, 550.0) for light in lights]
    found = {"lens": lens.name, "pairs": len(tracer.pairs), "lights": [plain(asdict(light)) for light in lights]}
    found |= {"ghosts": [[_about(ghost) for ghost in of_light] for of_light in rows]}
    if args.path is not None:
        _draw(lens, args.path[0], Path(args.path[1]), lights[0], tracer.pairs)
        found["path"] = args.path[1]
    if args.out is not None:
        found["out"] = str(args.out)
        _write(args, tracer, lens, lights, rows, found)
    found["seconds"] = time.perf_counter() - began
    return answer(args, found, lambda: _text(lens, lights, rows, found))


def _write(
    args: argparse.Namespace, tracer: Any, lens: Lens, lights: list[Light], rows: list[list[Ghost]], about: Any
) -> None:
    from neurolens.cameras.exact import placed_settings
    from neurolens.flare.photons import PhotonTracer
    from neurolens.flare.picture import Raster, ghost_picture, photon_picture
    from neurolens.render.exr_attributes import standard_attributes
    from neurolens.render.pictures import write_exr

    energy: dict[Any, float] = {}
    for light, of_light in zip(lights, rows, strict=True):
        for ghost in of_light:
            energy[ghost.pair] = energy.get(ghost.pair, 0.0) + ghost.energy * sum(light.rgb)
    top = sorted(energy, key=lambda pair: -energy[pair])[: args.layers]
    layer_of = {pair: number for number, pair in enumerate(top)}
    raster = Raster(args.film, args.width, max(1, round(args.width * args.film[1] / args.film[0])))
    options: dict[str, Any] = {"wavelengths": args.wavelengths, "threads": args.threads}
    with Progress(quiet=args.quiet or args.json).stage("photons" if args.photons else "ghosts") as options["done"]:
        if args.photons:
            more = {"photons": args.photons, "most_reflections": args.reflections, "kernel_px": args.kernel}
            picture = photon_picture(PhotonTracer(lens), lights, raster, **options, **more)[None]
        else:
            in_layers = [layer_of.get(pair, len(top)) for pair in tracer.pairs]
            picture = ghost_picture(tracer, lights, raster, samples=args.samples, layers=in_layers, **options)
    names = [*(pair.name for pair in top), "rest"]
    layers = {f"{name}.{c}": picture[n, ..., k] for n, name in enumerate(names) for k, c in enumerate("RGB")}
    settings = {k: v for k, v in vars(args).items() if isinstance(v, str | int | float | list | tuple | None)}
    metadata = {"neurolens": __version__, "flare": {**about, "settings": plain(settings)}}
    header = standard_attributes(placed_settings(lens, args.film, args.focus), raster.width, raster.height)
    write_exr(args.out, picture.sum(0), metadata=metadata, layers=layers if args.layers else None, attributes=header)


def _draw(lens: Lens, name: str, out: Path, light: Light, pairs: tuple[Pair, ...]) -> None:
    from neurolens.analysis.layout import lens_layout
    from neurolens.flare.picture import ghost_layout

    pair = next((p for p in pairs if p.name == name), None)
    if pair is None:
        raise InputError(
            "neurolens flare", "--path", name, f"a ghost of this lens, as {pairs[0].name}" if pairs else ""
        )
    lens_layout(ghost_layout(lens, pair, light), out)


def _light(text: str) -> Light:
    from neurolens.flare.picture import Light

    words = text.split(",")
    try:
        angles = [float(word) for word in words[:2]]
        rgb = [float(word) for word in (words[2] if len(words) > 2 else "1").split("/")]
        distance = float(words[3]) if len(words) > 3 else math.inf
    except ValueError:
        angles, rgb, distance = [], [], math.inf
    if len(angles) != 2 or len(words) > 4 or len(rgb) not in (1, 3):
        raise InputError("neurolens flare", "--light", text, "AZ,EL[,E[,M]], numbers, E also as R/G/B")
    try:
        return Light(angles[0], angles[1], (rgb[0], rgb[-2 % len(rgb)], rgb[-1]), distance)
    except InputError as error:
        raise InputError("neurolens flare", "--light", text, error.expected) from None


def _about(ghost: Ghost) -> dict[str, Any]:
    return {
        "name": ghost.pair.name,
        "energy": ghost.energy,
        "x_mm": ghost.centre_mm[0],
        "y_mm": ghost.centre_mm[1],
        "size_mm": ghost.size_mm,
        "passed": ghost.passed,
    }


def _text(lens: Lens, lights: list[Light], rows: list[list[Ghost]], about: dict[str, Any]) -> str:
    parts = [f"{lens.name}: {about['pairs']} pairs of surfaces"]
    head = ("ghost", "energy of the image's", "x mm", "y mm", "RMS radius mm", "rays that arrive %")
    for light, of_light in zip(lights, rows, strict=True):
        all_of = sum(ghost.energy for ghost in of_light)
        parts.append(
            f"light at {light.azimuth_deg:g}, {light.elevation_deg:g} deg: {len(of_light)} ghosts reach the film's "
            f"plane, with {number(100 * all_of)}% of the image's light; the brightest at 550 nm:"
        )
        cells = [
            [g.pair.name, number(g.energy), *map(number, g.centre_mm), number(g.size_mm), number(100 * g.passed)]
            for g in of_light[:_SHOWN]
        ]
        parts.append(table(head, cells))
    parts.append(f"{about.get('out', 'done')}: {about['seconds']:.1f} s")
    return "\n\n".join(parts)
