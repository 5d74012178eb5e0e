"""`neurolens stmap CAMERA --width PIXELS -o SHOT`: maps that undistort the picture of a lens, and distort it again."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.progress import Progress
from neurolens.cli.arguments import (
    CAMERAS_HELP,
    add_json,
    add_lens,
    add_lens_state,
    add_option,
    add_output,
    check_folder,
    positive,
    shot_of,
    wavelengths_nm,
    whole,
)
from neurolens.cli.output import answer, number
from neurolens.cli.render import film_size
from neurolens.cli.render_frames import LENS_KEYS, add_frames, frames_of
from neurolens.render.settings import size_by_shape

if TYPE_CHECKING:
    from neurolens.cameras.field import Field
    from neurolens.lens.shot import Shot
    from neurolens.render.stmap import Plates

_COMMAND = "neurolens stmap"
# Repeated here, so that help imports no camera; a test compares with `cameras.field`.
PROJECTIONS = ("rectilinear", "equidistant", "equisolid", "stereographic", "orthographic")
_LARGEST = 16384  # pixels a side
LIGHT_NM = (400.0, 700.0)
# Dominant wavelengths of the primaries of Rec. 709 (and sRGB), for light of D65.
_CHANNELS_NM = (611.4, 549.1, 464.2)
_NAMES = ("red", "green", "blue")

_DESCRIPTION = """\
Write ST maps of a lens (or model, or any other camera) for compositing, float32 OpenEXR:

  SHOT.undistort.exr     makes the undistorted picture from that of the lens (the plate)
  SHOT.redistort.exr     makes the picture of the lens from an undistorted one, as CG is rendered
  SHOT.illumination.exr  relative illumination of the plate, channel Y, 1 on the axis

R is s, G is t, B is 1 inside the picture that is read and 0 outside it. s and t are 0 at the left and
bottom edge of that picture, 1 at its right and top edge; the centre of pixel x, y from its lower left
corner is (x + 0.5) / width, (y + 0.5) / height: as Nuke's STMap and Blender's Map UV read them (which
takes B for alpha). Load the maps as raw data. A map has the size of the picture it makes.

The undistorted picture has the plate's pixels and centre, and is larger by the overscan, which is printed:
it holds every pixel of the plate. Render CG of that size with a pinhole camera of the focal length and place
that are printed: the lens's paraxial size in the plane in focus, seen from its entrance pupil. Things at other
distances are off by what is printed as parallax, for a lens's pupil moves with the field: --distance makes maps
for another plane.

The place of a thing in the picture is the centroid of its light at this stop, over pupil and wavelengths as the
eye weighs them. Lenses with cylinders keep their squeeze: each meridian has its own focal length and its own
entrance pupil. All maps have the pixel aspect ratio, which is printed, in the attribute pixelAspectRatio."""
_EPILOG = """\
examples:
  neurolens stmap lenses/laikin_double_gauss_50.toml --width 3840 --film 36x20.25 --focus 2 -o shot
  neurolens stmap models/NAME.onnx --width 1920 --film 24x13.5 --frames 1:48 --key focus=1:1.2,48:3 -o pull
  neurolens stmap lenses/NAME.toml --width 1920 --film 36x20.25 --lateral-colour -o shot   # and per channel
  neurolens stmap lenses/isshiki_fisheye_10.toml --width 2000 --film 18x18 --projection equidistant -o fisheye"""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "stmap", help="ST maps, which undistort and redistort pictures of a lens",
        description=_DESCRIPTION, epilog=f"{CAMERAS_HELP}\n\n{_EPILOG}",
    )  # fmt: skip
    add_picture(parser)
    add_output(parser, "SHOT", "start of the files' names", required=True)
    parser.add_argument(
        "--projection", choices=PROJECTIONS, default=PROJECTIONS[0],
        help="of the undistorted picture (default: rectilinear, a plane: fields up to 85 degrees from the axis)",
    )  # fmt: skip
    parser.add_argument(
        "--distance", metavar="M", type=positive("a distance in metres", infinite=True),
        help="distance from the film to what shall be in place, in metres, or inf (default: what is in focus)",
    )  # fmt: skip
    parser.add_argument(
        "--lateral-colour", action="store_true",
        help="maps for each channel too, SHOT.undistort.red.exr and so on, of the --wavelengths",
    )  # fmt: skip
    add_option(
        parser, "--wavelengths", old=("--channels-nm",), metavar="NM", type=_channels, default=_CHANNELS_NM,
        help="those of red, green and blue (default: 611.4,549.1,464.2 nm, the dominant ones of Rec. 709)",
    )  # fmt: skip
    add_frames(parser, "maps of these frames, SHOT.undistort.0001.exr and so on, all of one overscan", names=LENS_KEYS)
    add_lens_state(parser)
    add_json(parser, quiet=True)
    parser.set_defaults(run=run, kept="files that were written are whole")


def add_picture(parser: argparse.ArgumentParser) -> None:
    """Add the camera, the size of the picture and --film."""
    add_lens(parser, "camera", ", see below", models=True, cameras=True)
    for side, other in (("width", "height"), ("height", "width")):
        about = f"{side} of the lens's picture (default: from --{other} and the film's shape)"
        parser.add_argument(f"--{side}", metavar="PIXELS", type=whole(1, _LARGEST), help=about)
    parser.add_argument("--size", type=_pixels, help=argparse.SUPPRESS)  # the old spelling
    parser.add_argument("--film", metavar="WxH", type=film_size, required=True, help="size of the film in mm")


def size_of(args: argparse.Namespace) -> tuple[int, int]:
    """Width and height of the lens's picture in pixels.

    Raises:
        InputError: the command line states neither.
    """
    if not (args.size or args.width or args.height):
        raise InputError(_COMMAND, "--width", "(missing)", "--width or --height of the lens's picture")
    return args.size or size_by_shape(args.film[0] / args.film[1], args.width, args.height)


def picture_shot(args: argparse.Namespace) -> Shot:
    """What the command line sets.

    Raises:
        InputError: as of `size_of`; a film whose shape is not that of the picture.
    """
    from neurolens.render.film import PixelGrid

    PixelGrid(*size_of(args), args.film)
    return shot_of(args, args.film, wavelength_nm=LIGHT_NM)


def _pixels(text: str) -> tuple[int, int]:
    """Type of --size."""
    words = text.lower().split("x")
    if len(words) == 2 and all(w.isascii() and w.isdecimal() and 1 <= int(w[:9]) <= _LARGEST for w in words):
        return int(words[0]), int(words[1])
    raise argparse.ArgumentTypeError(f"got {text!r}, expected WIDTHxHEIGHT in pixels, each from 1 to {_LARGEST}")


def _channels(text: str) -> tuple[float, ...]:
    """Type of --wavelengths: those of red, green and blue."""
    found = wavelengths_nm(text)
    if len(found) == 3 and all(LIGHT_NM[0] <= nm <= LIGHT_NM[1] for nm in found):
        return found
    span = f"{LIGHT_NM[0]:g} to {LIGHT_NM[1]:g}"
    raise argparse.ArgumentTypeError(f"got {text!r}, expected three wavelengths from {span} nm: red,green,blue")


@dataclass(frozen=True)
class _Frame:
    """One frame: its number in file names ("" for a single one), focus, camera, and fields by their maps' names."""

    number: str
    focus_m: float
    camera: str
    settings: dict[str, Any]
    fields: dict[str, Field]


def run(args: argparse.Namespace) -> int:
    """Trace the fields of all frames, then write their maps, of one size."""
    check_folder(args.out, "--output")
    if not args.out.name:
        raise InputError(_COMMAND, "--output", str(args.out), "the start of the files' names")
    if args.frames is None and args.key:
        raise InputError(_COMMAND, "--key", args.key[0], "--frames beside it")
    from neurolens.render.stmap import plates_of

    progress = Progress(quiet=args.quiet)
    states = [("", {})] if args.frames is None else [(n, v) for _, n, v in frames_of(args, _COMMAND, LENS_KEYS)]
    frames = []
    with progress.stage(f"trace the field of {args.camera}") as report:
        for k, (text, values) in enumerate(states):
            frames.append(_traced(argparse.Namespace(**vars(args) | values), text, progress))
            report((k + 1) / len(states))
    plates = plates_of([f for frame in frames for f in frame.fields.values()], size_of(args), args.film)
    files = []
    with progress.stage("write the maps") as report:
        for k, frame in enumerate(frames):
            files += _written(args, frame, plates, _part(report, k, len(frames)))
    data = _told(args, frames, plates) | {"files": files}
    return answer(args, data, lambda: _text(data))


def _traced(args: argparse.Namespace, text: str, progress: Progress) -> _Frame:
    """The fields of one frame."""
    from neurolens.cameras.build import make_camera
    from neurolens.cameras.field import field_of, frame_of, spectrum_of

    shot = picture_shot(args)
    camera = make_camera(args.camera, shot, progress)
    for note in camera.settings.get("notes", ()):
        warn(note)
    frame = frame_of(camera)
    wavelengths = dict(zip(_NAMES, args.wavelengths, strict=True)) if args.lateral_colour else {}
    fields = {
        name: field_of(
            camera, shot.focus_m, args.projection, frame=frame, distance_m=args.distance,
            spectrum=spectrum_of(camera, LIGHT_NM, nm),
        )
        for name, nm in {"": None, **wavelengths}.items()
    }  # fmt: skip
    return _Frame(text, shot.focus_m, camera.name, camera.settings, fields)


def _written(args: argparse.Namespace, frame: _Frame, plates: Plates, report: Callable[[float], None]) -> list[str]:
    """Write the maps of one frame; their names."""
    from neurolens.render.pictures import standard_attributes, write_channels
    from neurolens.render.stmap import illumination_map, redistort_map, undistort_map

    makers = {"undistort": undistort_map, "redistort": redistort_map}
    jobs = [(kind, name, makers[kind]) for name in frame.fields for kind in makers]
    jobs.append(("illumination", "", illumination_map))
    files = []
    header = standard_attributes(frame.settings, frame=int(frame.number) if frame.number else None)
    header["pixelAspectRatio"] = _ideal(frame.fields[""], plates)["pixel_aspect"]
    for k, (kind, name, make) in enumerate(jobs):
        field = frame.fields[name]
        planes = make(field, plates, _part(report, 2 * k, 2 * len(jobs)))
        words = [args.out.name, kind, *([name] if name else []), *([frame.number] if frame.number else []), "exr"]
        path = args.out.with_name(".".join(words))
        write_channels(path, planes, None, _about(args, frame, plates, kind, field), header)
        files.append(str(path))
        report((k + 1) / len(jobs))
    return files


def _part(report: Callable[[float], None], done: int, of: int) -> Callable[[float], None]:
    """The report of the part of a stage that begins when `done` of so many are done."""
    return lambda share: report((done + share) / of)


def _about(args: argparse.Namespace, frame: _Frame, plates: Plates, kind: str, field: Field) -> dict[str, Any]:
    """The metadata of a map."""
    said: dict[str, Any] = {"version": __version__, "map": kind, "camera": str(args.camera), "name": frame.camera}
    said |= {"picture_px": list(plates.picture), "undistorted_px": list(plates.undistorted)}
    said |= {"film_mm": list(args.film), "wavelengths_nm": field.spectrum[0].tolist()}
    return said | _ideal(field, plates) | {"focus_m": None if math.isinf(frame.focus_m) else frame.focus_m}


def _ideal(field: Field, plates: Plates) -> dict[str, Any]:
    """The camera that an undistorted picture is of; lists are of the x and the y meridian. A pixel of both pictures is
    `pixel_aspect` times as wide as high in what it shows, as viewers stretch it."""
    (x, y), (width, height) = field.frame.reach_mm, plates.pixel_mm
    return {
        "projection": field.target,
        "focal_mm": [x, y],
        "before_film_mm": list(field.frame.pupil_mm),
        "pixel_aspect": float(f"{y / x * width / height:.6g}"),
    }


def _told(args: argparse.Namespace, frames: list[_Frame], plates: Plates) -> dict[str, Any]:
    """What --json tells."""
    from neurolens.render.stmap import worst_px

    rows = []
    for frame in frames:
        field = frame.fields[""]
        moved, missed = worst_px(field, plates)
        pixel = min(plates.pixel_mm)
        parallax = [{"distance_m": d, "px": mm / pixel} for d, mm in field.parallax_mm.items()]
        row: dict[str, Any] = {"frame": int(frame.number) if frame.number else None, "focus_m": frame.focus_m}
        row |= _ideal(field, plates) | {"field_deg": field.field_deg, "shift_px": moved, "there_and_back_px": missed}
        # One pinhole, at the y meridian's pupil, shows widths in this plane as the pupil of the x meridian does.
        plane = 1e3 * (frame.focus_m if args.distance is None else args.distance)
        x, y = field.frame.pupil_mm
        nearer = 1.0 if math.isinf(plane) else (plane - x) / (plane - y)
        row |= {"plane_m": plane / 1e3, "pixel_aspect_of_one_pinhole": row["pixel_aspect"] * nearer}
        rows.append(row | {"parallax": parallax})
    return {
        "camera": str(args.camera),
        "picture_px": list(plates.picture),
        "undistorted_px": list(plates.undistorted),
        "overscan": list(plates.overscan),
        "film_undistorted_mm": [n * p for n, p in zip(plates.undistorted, plates.pixel_mm, strict=True)],
        "frames": rows,
    }


def _text(data: dict[str, Any]) -> str:
    first = data["frames"][0]
    (width, height), (wide, high), (fx, fy) = data["picture_px"], data["undistorted_px"], data["overscan"]
    focal, before = (" x ".join(dict.fromkeys(number(v, 6) for v in first[k])) for k in ("focal_mm", "before_film_mm"))
    film = " x ".join(number(v, 6) for v in data["film_undistorted_mm"])
    worst = {k: max(row[k] for row in data["frames"]) for k in ("shift_px", "there_and_back_px")}
    lines = [
        f"{data['camera']}: picture {width} x {height}, undistorted {wide} x {high} pixels "
        f"(overscan {fx:.4f} x {fy:.4f}), {film} mm",
        f"undistorted, {first['projection']}: focal length {focal} mm, its point {before} mm before the film"
        + (" (first frame)" if len(data["frames"]) > 1 else ""),
        f"distortion moves points by up to {worst['shift_px']:.4g} pixels; there and back within "
        f"{worst['there_and_back_px']:.2g}",
    ]
    if " x " in focal:
        x, y = (number(v, 6) for v in first["before_film_mm"])
        line = f"pixel aspect ratio {first['pixel_aspect']:.5g}; entrance pupil of the x meridian {x} mm, of the y "
        line += f"meridian {y} mm before the film"
        if first["parallax"]:  # the plane is not at infinity
            plane, aspect = number(first["plane_m"], 3), f"{first['pixel_aspect_of_one_pinhole']:.5g}"
            line += f"; a pinhole at the latter shows what is {plane} m from the film with {aspect}"
        lines.append(line)
    if first["parallax"]:
        told = [f"{p['px']:.2g} pixels at {number(p['distance_m'], 3)}" for p in first["parallax"]]
        lines.append(f"parallax of the pupil, worst of the picture, by metres from the film: {', '.join(told)}")
    return "\n".join([*lines, *data["files"]])
