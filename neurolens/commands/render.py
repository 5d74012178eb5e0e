"""`neurolens render SCENE --camera ...`: a picture of a scene through a lens, a model, a thin lens or a pinhole."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.bounds import FILM_MM
from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.options import add_options, from_options
from neurolens.base.progress import Progress
from neurolens.commands.arguments import (
    CAMERAS_HELP,
    add_camera,
    add_exposure,
    add_json,
    add_lens_state,
    add_option,
    add_output,
    aperture_of,
    between,
    whole,
)
from neurolens.commands.output import answer
from neurolens.commands.render_dask import run_on_dask
from neurolens.commands.render_files import (
    Files,
    Stopping,
    Unfinished,
    add_safety,
    add_tile,
    so_far,
    summary,
    warn,
    watch_of,
    write_pictures,
)
from neurolens.commands.render_frames import add_frames, run_frames
from neurolens.evaluate.records import plain
from neurolens.render.film_settings import FilmSettings

if TYPE_CHECKING:
    from neurolens.cameras.build import Shot
    from neurolens.cameras.contract import Camera, FloatArray
    from neurolens.optics.apertures import Aperture
    from neurolens.optics.prescription import Lens
    from neurolens.render.renderer import RenderResult
    from neurolens.render.scene import CameraSettings, Scene

_LENS_STATE = "focus", "f_number", "zoom"
_FLARE_FRAMES = 16  # that tell which lights and ghosts are brightest

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
    add_lens_state(
        parser,
        efl="as tabled; 50 for thin and pinhole, 14 for fisheyes; a model has its own",
        f_number="the scene's, or the widest that the lens opens to; 4 for thin",
        focus="the scene's",
    )
    parser.add_argument(
        "--threads", metavar="N", type=whole(1, 256), default=2,
        help="workers, each pinned to a core if there are as many as cores (default: 2)",
    )  # fmt: skip
    add_json(parser, quiet=True)
    parser.set_defaults(position_m=None, look_at_m=None, frame=None, shared=None)
    parser.set_defaults(run=run_kept, kept="no picture was written; older files of that name are untouched")


def run_kept(args: argparse.Namespace) -> int:
    """As `run`, or tiles merged, with running out of memory as a one-line error."""
    from neurolens.commands.merge import run_merge

    if not args.merge:
        if len(args.scene) != 1 or args.camera is None:
            missing = "SCENE" if len(args.scene) != 1 else "--camera"
            raise InputError("neurolens render", missing, " ".join(map(str, args.scene)) or "(none)", "one of it")
        (args.scene,) = args.scene
    try:
        return (run_merge if args.merge else run)(args)
    except MemoryError as error:
        raise NeurolensError(f"render: out of memory ({str(error) or 'no more said'})") from None


def run(args: argparse.Namespace) -> int:
    """Render one picture, or one a frame."""
    if args.dask is not None:
        return run_on_dask(args, prepared, render_alone)
    if args.frames is not None:
        return run_frames(args, _run_one)
    if args.key:
        raise InputError("neurolens render", "--key", args.key[0], "--frames beside it")
    return _run_one(args)


@dataclass(frozen=True)
class Prepared:
    """What the arguments of a picture name, read and checked; `rows`: of its tile, None: all of them."""

    files: Files
    scene: Scene
    film: FilmSettings
    camera: Camera
    size: tuple[int, int]
    rows: tuple[int, int] | None

    def metadata(self, args: argparse.Namespace) -> dict[str, Any]:
        return {"version": __version__, "scene": str(args.scene), "camera": plain(self.camera.settings)}


def prepared(args: argparse.Namespace, progress: Progress) -> Prepared:
    """Read and check all that a picture needs, before it is rendered."""
    from neurolens.cameras.build import make_camera
    from neurolens.render.film import PixelGrid
    from neurolens.render.illuminants import check_name
    from neurolens.render.scene import files_named, load_scene, seen_from
    from neurolens.render.tiles import rows_of, tile_path

    files = Files.of(tile_path(args.out, args.tile))
    scene = seen_from(load_scene(args.scene), args.scene, args.position_m, args.look_at_m)
    files.spare(args.scene.parent / name for name in files_named(scene.settings))
    settings, film = scene.settings.camera, from_options(scene.settings.film, args)
    if args.white_balance is not None:
        check_name(args.scene, "--white-balance", args.white_balance, scene.illuminants)
    if args.film is not None:
        settings = replace(settings, film_width_mm=args.film[0], film_height_mm=args.film[1])
        if args.width is None and args.height is None:
            args.width = settings.width
    width, height = picture_size(settings, args.width, args.height)
    PixelGrid(width, height, (settings.film_width_mm, settings.film_height_mm))  # before the slow make_camera
    rows = None if args.tile is None else rows_of(height, args.tile)
    camera = make_camera(args.camera, shot_of(settings, args, scene.aperture), progress)
    for note in (*camera.settings.get("notes", ()), *_pixel_notes(camera, width)):
        warn(note)
    return Prepared(files, scene, film, camera, (width, height), rows)


def _run_one(args: argparse.Namespace) -> int:
    """Render, write both pictures, print a summary."""
    progress = Progress(quiet=args.quiet)
    made = prepared(args, progress)
    flare = _flare(made, args, progress)
    with Stopping() as stopping, progress.stage(f"render {made.scene.name}, {made.camera.name}") as report:
        result = _rendered(made, args, args.threads, progress=report, watch=watch_of(args, made.files, stopping))
        if not result.stats["complete"]:
            raise Unfinished
    return _deliver(args, made, result, stopping, flare)


def render_alone(args: argparse.Namespace) -> None:
    """Render in this process and write the EXR alone, as a task of a farm does."""
    quiet = Progress(quiet=True)
    made = prepared(args, quiet)
    result = _rendered(made, args, 1)
    write_pictures(made.files, result, made.metadata(args), made.film, args, _flare(made, args, quiet))
    made.files.preview.unlink()


def _rendered(made: Prepared, args: argparse.Namespace, threads: int, **more: Any) -> RenderResult:
    from neurolens.render.renderer import render

    width, height = made.size
    return render(
        made.scene, made.camera, width=width, height=height, samples=args.samples, seed=args.seed,
        threads=threads, max_depth=args.max_depth, film=made.film, rows=made.rows, **more,
    )  # fmt: skip


def _flare(made: Prepared, args: argparse.Namespace, progress: Progress) -> dict[str, FloatArray]:
    """The layers of flare that a scene asks for."""
    scene, camera = made.scene, made.camera
    if scene.settings.flare is None:
        return {}
    lens = getattr(camera, "lens", None)
    if lens is None:
        warn(f"no flare of {camera.name}: that takes a lens file that is traced as it is")
        return {}
    from neurolens.flare.layers import scene_choice, scene_flare
    from neurolens.flare.picture import Raster

    raster = Raster(camera.film_mm, *made.size)
    try:
        if args.shared is not None and args.shared.flare is None:
            args.shared.flare = scene_choice(list(_flare_frames(scene, lens, args)), raster, args.threads)
        choice = None if args.shared is None else args.shared.flare
        return scene_flare(scene, lens, raster, made.film.white_balance, args.threads, progress, choice)
    except InputError as error:
        raise InputError(args.scene, f"[flare]: {error.file}, {error.field}", error.value, error.expected) from None


def _flare_frames(scene: Scene, lens: Lens, args: argparse.Namespace) -> Iterator[tuple[Scene, Lens]]:
    """The scene and the lens in some of the frames that a command makes."""
    from neurolens.cameras.build import make_camera
    from neurolens.render.scene import seen_from

    lenses = {tuple(getattr(args, name) for name in _LENS_STATE): lens}
    states = args.shared.states
    for values in states[:: -(-len(states) // _FLARE_FRAMES)]:
        there = argparse.Namespace(**vars(args) | values)
        state = tuple(getattr(there, name) for name in _LENS_STATE)
        if state not in lenses:
            shot = shot_of(scene.settings.camera, there, scene.aperture)
            lenses[state] = make_camera(args.camera, shot, Progress(quiet=True)).lens  # type: ignore[attr-defined]
        yield seen_from(scene, args.scene, there.position_m, there.look_at_m), lenses[state]


def _pixel_notes(camera: Camera, width: int) -> list[str]:
    """A sentence on a model whose error is larger than the pixels of a picture so many wide."""
    error = (camera.settings.get("card") or {}).get("errors", {}).get("rms_um") or 0.0
    pixel = 1e3 * camera.film_mm[0] / width
    return [f"the model's RMS error of {error:.3g} um is more than a pixel, {pixel:.3g} um"] if error > pixel else []


def _deliver(
    args: argparse.Namespace,
    made: Prepared,
    result: RenderResult,
    stopping: Stopping,
    flare: Mapping[str, FloatArray],
) -> int:
    """Write the pictures, complete or not, and print a summary; the exit code."""
    files = made.files
    if stopping():
        args.kept = files.kept()
    if not result.stats["paths"]:
        return stopping.say(args.kept)
    write_pictures(files, result, made.metadata(args), made.film, args, flare)
    if dropped := result.stats["dropped_samples"]:
        warn(f"{dropped} of {result.stats['paths']} samples were not finite and count as black")
    if not result.stats["complete"]:
        return stopping.say(f"{so_far(result, files)}; {files.kept()}")
    if not args.keep_checkpoint:
        files.checkpoint.unlink(missing_ok=True)
    stats = plain(result.stats)
    data = {"file": str(files.out), "preview": str(files.preview), **stats, "camera": made.camera.settings}
    return answer(args, data, lambda: summary(stats, files))


def shot_of(settings: CameraSettings, args: argparse.Namespace, aperture: Aperture | None = None) -> Shot:
    """The scene's camera settings (and shape of the stop) with the command line's options."""
    from neurolens.cameras.build import Shot

    return Shot(
        film_mm=(settings.film_width_mm, settings.film_height_mm),
        focus_m=settings.focus_m if args.focus is None else args.focus,
        f_number=settings.f_number if args.f_number is None else args.f_number,
        efl_mm=args.efl,
        zoom=args.zoom,
        field_deg=args.field,
        focus=args.focusing,
        aperture=aperture_of(args) or aperture,
        wavelength_nm=settings.wavelengths_nm,
        # A scene's f-number is clamped to the lens; one of the command line must be possible.
        clamp_f_number=args.f_number is None,
        film_offset_mm=args.film_offset,
        vignetting=args.vignetting,
    )


def picture_size(settings: CameraSettings, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height; a missing one follows from the other and the film's shape."""
    if width is None and height is None:
        return settings.width, settings.height
    return size_by_shape(settings.film_width_mm / settings.film_height_mm, width, height)


def size_by_shape(shape: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height of a film of this width over height, of which one may be missing."""
    found_width = max(1, round((height or 0) * shape)) if width is None else width
    return found_width, max(1, round(found_width / shape)) if height is None else height


def film_size(text: str) -> tuple[float, float]:
    """Type of --film: width x height in mm, as in 36x24."""
    width, _, height = text.lower().partition("x")
    side = between(*FILM_MM, "the film's width x height in mm, as in 36x24, each")
    try:
        return side(width), side(height)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from None
