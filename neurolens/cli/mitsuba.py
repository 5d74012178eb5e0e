"""`neurolens mitsuba SCENE --camera ...`: an unmodified scene of Mitsuba 3 through a neurolens camera."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.errors import warn
from neurolens.base.progress import Progress, duration
from neurolens.base.records import plain
from neurolens.cli.arguments import (
    add_exposure,
    add_json,
    add_lens,
    add_lens_state,
    add_output,
    positive,
    shot_of,
    whole,
)
from neurolens.cli.output import answer
from neurolens.cli.render import film_size

if TYPE_CHECKING:
    from neurolens.lens.shot import Shot

_DESCRIPTION = """\
Render a scene of Mitsuba 3 (.xml, or its own cornell-box) with its integrator and its film, through
a lens where its camera stands, and write OpenEXR with a PNG preview beside it.
Needs the extra "mitsuba"; its llvm variants need libLLVM too, scalar ones trace one lens ray at a time."""
_EPILOG = """\
examples:
  neurolens mitsuba cornell-box --camera models/NAME.onnx --film 28x28 --focus 3.6 -o box.exr
  neurolens mitsuba scene.xml --camera thin --f-number 2 --focus 4 --variant llvm_ad_rgb -o thin.exr"""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "mitsuba", help="render a scene of Mitsuba 3 through a neurolens camera",
        description=_DESCRIPTION, epilog=_EPILOG,
    )  # fmt: skip
    parser.add_argument("scene", metavar="SCENE", help="scene file (.xml), or cornell-box")
    add_lens(parser, "--camera", models=True, cameras=True, required=True)
    add_output(parser, "OUT.exr", "picture to write; the preview is OUT.png", required=True)
    parser.add_argument(
        "--variant", metavar="NAME", help="of Mitsuba (default: llvm_ad_spectral; scalar_spectral without LLVM)"
    )
    parser.add_argument("--samples", metavar="N", type=whole(1, 1 << 20), help="a pixel (default: the scene's)")
    parser.add_argument(
        "--film", metavar="WxH", type=film_size, help="size in mm (default: 36 wide, the picture's shape)"
    )
    parser.add_argument("--seed", metavar="N", type=whole(0, 1 << 15), default=0, help="default: 0")
    parser.add_argument(
        "--units-per-m", metavar="N", type=positive("scene units in a metre"), default=1.0,
        help="of the scene (default: 1; 1000 for one in millimetres)",
    )  # fmt: skip
    add_exposure(parser)
    add_lens_state(parser)
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="no picture was written; older files of that name are untouched")


def run(args: argparse.Namespace) -> int:
    """Render, write both pictures, print a summary."""
    from neurolens.cameras.build import make_camera
    from neurolens.frames.frame import Files
    from neurolens.mitsuba import load_scene, render
    from neurolens.mitsuba.library import libraries
    from neurolens.render.pictures import standard_attributes, write_exr, write_png

    preview = Files.of(args.out).preview
    scene = load_scene(args.scene, args.variant)
    width, height = (int(v) for v in scene.sensors()[0].film().size())
    progress = Progress(quiet=args.quiet)
    camera = make_camera(args.camera, _shot(args, height / width), progress)
    for note in camera.settings.get("notes", ()):
        warn(note)
    began = time.perf_counter()
    with progress.stage(f"render {args.scene}, {camera.name}") as report:
        given = {"spp": args.samples, "seed": args.seed, "units_per_m": args.units_per_m}
        picture = render(scene, camera, **given, progress=report)
    mi, _ = libraries()
    stats = {
        "scene": args.scene,
        "width": picture.shape[1],
        "height": picture.shape[0],
        "samples": args.samples,
        "seed": args.seed,
        "seconds": time.perf_counter() - began,
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
    }
    metadata = {"version": __version__, "camera": plain(camera.settings), "render": plain(stats)}
    attributes = standard_attributes(camera.settings, picture.shape[1], picture.shape[0])
    write_exr(args.out, picture, metadata=metadata, attributes=attributes)
    write_png(preview, picture, args.exposure)
    said = f"{width} x {height} in {duration(float(stats['seconds']))} ({mi.variant()})"
    data = {"file": str(args.out), "preview": str(preview), **stats, "camera": camera.settings}
    return answer(args, data, lambda: f"{args.scene} through {camera.name}: {said}\n{args.out}\n{preview}")


def _shot(args: argparse.Namespace, shape: float) -> Shot:
    """What the command line sets, on a film for a picture of `shape`, its height over its width."""
    from neurolens.mitsuba.sensor import FILM_WIDTH_MM, LIGHT_NM

    return shot_of(args, args.film or (FILM_WIDTH_MM, FILM_WIDTH_MM * shape), wavelength_nm=LIGHT_NM)
