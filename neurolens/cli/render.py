"""`neurolens render SCENE --camera ...`: a picture of a scene through a lens, a model, a thin lens or a pinhole."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.bounds import FILM_MM
from neurolens.base.cluster import Dask
from neurolens.base.errors import InputError, NeurolensError, warn
from neurolens.base.options import add_options
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.cli.arguments import (
    CAMERAS_HELP,
    SHOT_OPTIONS,
    Parser,
    add_camera,
    add_exposure,
    add_json,
    add_lens_state,
    add_option,
    add_output,
    aperture_of,
    between,
    check_folder,
    check_suffix,
    whole,
)
from neurolens.cli.output import answer
from neurolens.cli.render_files import (
    Stopping,
    Unfinished,
    add_safety,
    add_tile,
    so_far,
    summary,
    watch_of,
)
from neurolens.cli.render_frames import add_frames, frames_by_file, missing_frames
from neurolens.render.settings import FilmSettings

if TYPE_CHECKING:
    from neurolens.cameras.contract import FloatArray
    from neurolens.frames.frame import Frame, Prepared

_DESCRIPTION = """\
Path-trace a scene (experiments/scenes/*.toml) and write OpenEXR, linear sRGB or ACEScg, with
a PNG preview beside it. The settings, the camera and the card of a model are kept in the EXR's
metadata, attribute "neurolens", as JSON.

The same seed gives the same picture for any number of threads; all cameras share its
random numbers. A model (.onnx), the thin lens and the points need no torch; a lens file
(.toml) does (extra "train").

The preview is updated during the render. Ctrl-C (SIGTERM, SIGHUP) writes the picture so far; the same
command then resumes from OUT.exr.part and ends with the same picture, bit for bit."""
_EPILOG = """\
examples:
  neurolens render experiments/scenes/room.toml --camera pinhole --samples 4 -o quick.exr
  neurolens render experiments/scenes/room.toml --camera lenses/laikin_double_gauss_50.toml -o exact.exr
  neurolens render experiments/scenes/lights.toml --camera models/NAME.onnx --f-number 2.8 \\
      --half -o lights.exr
  neurolens render experiments/scenes/grid.toml --camera lenses/ogawa_zoom_70_200.toml \\
      --zoom 100 --blades 8 --blade-curvature 0.5 -o zoom.exr
  neurolens render experiments/scenes/room.toml --camera thin --samples 64 --keep-checkpoint -o room.exr
  neurolens render experiments/scenes/room.toml --camera thin --samples 256 -o room.exr   # 192 more
  neurolens render experiments/scenes/room.toml --camera thin --tile 1/2 -o room.exr   # and 2/2 elsewhere
  neurolens render --merge room.tile-*.exr -o room.exr
  neurolens render experiments/scenes/room.toml --camera fused:models/NAME.onnx --frames 1:48 \\
      --key focus=1:1.2,48:3 --key position=1:0/1.6/3,48:0.5/1.6/2.5 -o pull.exr"""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "render", help="a scene through a lens, a model, a thin lens or a pinhole",
        description=_DESCRIPTION, epilog=f"{CAMERAS_HELP}\n\n{_EPILOG}",
    )  # fmt: skip
    parser.add_argument("scene", metavar="SCENE", nargs="*", type=Path, help="scene file (.toml), or tiles of --merge")
    add_camera(parser)
    add_output(parser, "OUT.exr", "picture to write; the preview is OUT.png", required=True)
    picture = parser.add_argument_group("picture")
    picture.add_argument("--samples", metavar="N", type=whole(1, 2**20), help="per pixel (default: the scene's)")
    picture.add_argument(
        "--width", metavar="PIXELS", type=whole(1, 16384),
        help="width (default: the scene's, or from --height and the film's shape)",
    )  # fmt: skip
    picture.add_argument(
        "--height", metavar="PIXELS", type=whole(1, 16384),
        help="height (default: the scene's, or from --width and the film's shape)",
    )  # fmt: skip
    picture.add_argument(
        "--film", metavar="WxH", type=film_size, help="width and height of the film in mm (default: the scene's)"
    )
    picture.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the random numbers (default: 0)")
    picture.add_argument("--max-depth", metavar="N", type=whole(1, 1000), help="bounces (default: the scene's)")
    picture.add_argument("--half", action="store_true", help="16-bit floats in the EXR (default: 32-bit)")
    add_exposure(picture)
    add_option(
        picture, "--channels", old=("--layers",), choices=("all", "beauty"), default="all",
        help="of the EXR: colour alone, or also samples, variance (of the pixel's luminance), Z (depth in m along the "
        "axis from the film) and blocked (share of camera rays that do not pass) (default: all)",
    )  # fmt: skip
    add_options(parser.add_argument_group("colour (left out: the scene's [film] table)"), FilmSettings, unset=True)
    add_frames(parser)
    add_tile(parser)
    add_safety(parser)
    add_lens_state(parser)
    parser.add_argument(
        "--threads", metavar="N", type=whole(1, 256), default=2,
        help="workers, each pinned to a core if there are as many as cores (default: 2)",
    )  # fmt: skip
    add_json(parser, quiet=True)
    parser.set_defaults(run=run_kept, kept="no picture was written; older files of that name are untouched")


def run_kept(args: argparse.Namespace) -> int:
    """As `run`, or tiles merged, with running out of memory as a one-line error."""
    if not args.merge:
        if len(args.scene) != 1 or args.camera is None:
            missing = "SCENE" if len(args.scene) != 1 else "--camera"
            raise InputError("neurolens render", missing, " ".join(map(str, args.scene)) or "(none)", "one of it")
        (args.scene,) = args.scene
    try:
        return (_run_merge if args.merge else run)(args)
    except MemoryError as error:
        raise NeurolensError(f"render: out of memory ({str(error) or 'no more said'})") from None


def run(args: argparse.Namespace) -> int:
    """Render one picture, or one for each frame; the exit code of the first that fails."""
    if args.frames is None and args.key:
        raise InputError("neurolens render", "--key", args.key[0], "--frames beside it")
    frames = {args.out: frame_of(args)} if args.frames is None else frames_by_file(args, frame_of(args))
    missing = frames if args.frames is None else missing_frames(args, frames)
    if args.dask is not None:
        return _run_on_dask(args, frames, missing)
    from neurolens.frames.frame import flare_choice, flare_of, prepare

    choice = None
    for number, (out, frame) in enumerate(missing.items()):
        progress = Progress(quiet=args.quiet)
        prepared = prepare(frame, out, progress)
        choice = choice if number else flare_choice(list(frames.values()), prepared, args.threads)
        code = _render(args, prepared, flare_of(prepared, choice, args.threads, progress), progress)
        if code:
            return code
    return 0


def frame_of(args: argparse.Namespace) -> Frame:
    """The frame that the options describe."""
    from neurolens.frames.frame import Frame

    return Frame.of(
        args.scene, args.camera, **{name: getattr(args, name) for name in SHOT_OPTIONS}, aperture=aperture_of(args),
        glass_files=tuple(args.glass_files), film_mm=args.film,
        width=args.width, height=args.height, samples=args.samples, seed=args.seed, max_depth=args.max_depth,
        colour_space=args.colour_space, white_balance=args.white_balance, wavelengths=args.wavelength_mode,
        wavelength_sampling=args.wavelength_sampling, half=args.half, channels=args.channels, exposure=args.exposure,
        tile=args.tile,
    )  # fmt: skip


def _render(args: argparse.Namespace, prepared: Prepared, flare: Mapping[str, FloatArray], progress: Progress) -> int:
    """Render a frame until it is done or a signal asks to stop, write its pictures, and print a summary."""
    from neurolens.frames.frame import write_pictures

    files = prepared.files
    with Stopping() as stopping, progress.stage(f"render {prepared.name}") as report:
        result = prepared.render(args.threads, report, watch_of(args, files, stopping))
        if not result.stats["complete"]:
            raise Unfinished
    if stopping():
        args.kept = files.kept()
    if not result.stats["paths"]:
        return stopping.say(args.kept)
    write_pictures(prepared, result, flare)
    if dropped := result.stats["dropped_samples"]:
        warn(f"{dropped} of {result.stats['paths']} samples were not finite and count as black")
    if not result.stats["complete"]:
        return stopping.say(f"{so_far(result, files)}; {files.kept()}")
    if not args.keep_checkpoint:
        files.checkpoint.unlink(missing_ok=True)
    stats = plain(result.stats)
    data = {"file": str(files.out), "preview": str(files.preview), **stats, "camera": prepared.camera.settings}
    return answer(args, data, lambda: summary(stats, files))


def _run_on_dask(args: argparse.Namespace, frames: Mapping[Path, Frame], missing: Mapping[Path, Frame]) -> int:
    """Render frames by tiles on a cluster."""
    from neurolens.frames.farm import how_to_resume, render_frames

    for option, value in (("--tile", args.tile), ("--keep-checkpoint", args.keep_checkpoint or None)):
        if value is not None:
            raise InputError("neurolens render", option, value, "left out beside --dask")
    if not missing:
        return 0
    folder, progress = args.out.with_name(f"{args.out.name}.tiles"), Progress(quiet=args.quiet)
    args.kept = how_to_resume(folder)
    with Dask(args.dask) as executor:
        pictures = render_frames(
            missing, executor, folder, shown=list(frames.values()), restart=args.restart, progress=progress
        )
    return _say_pictures(args, pictures)


def _run_merge(args: argparse.Namespace) -> int:
    """Put tiles together."""
    _check_alone(args)
    check_suffix(args.out, "--output", (".exr",))
    check_folder(args.out, "--output")
    from neurolens.render.tiles import merge_tiles

    return _say_pictures(args, merge_tiles(args.scene, args.out, args.exposure))


def _check_alone(args: argparse.Namespace) -> None:
    """Refuse no tiles at all, and options that tiles have settled already; raises InputError."""
    parser, taken = Parser(), ("scene", "merge", "out", "exposure", "quiet", "json")
    add_parser(parser.add_subparsers())
    for name, unset in vars(parser.parse_args(["render", "-o", "a.exr"])).items():
        if name not in taken and getattr(args, name) != unset:
            option = f"--{name.replace('_', '-')}"
            raise InputError("neurolens render", option, "(beside --merge)", "tiles, -o and --exposure alone")
    if not args.scene:
        raise InputError("neurolens render", "--merge", "(no tiles)", "the tiles of a render")


def _say_pictures(args: argparse.Namespace, pictures: Sequence[Mapping[str, Any]]) -> int:
    return answer(args, {"pictures": pictures}, lambda: "\n".join(str(p["file"]) for p in pictures))


def film_size(text: str) -> tuple[float, float]:
    """Type of --film: width x height in mm, as in 36x24."""
    width, _, height = text.lower().partition("x")
    side = between(*FILM_MM, "the film's width x height in mm, as in 36x24, each")
    try:
        return side(width), side(height)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from None
