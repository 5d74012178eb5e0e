"""`neurolens stmap CAMERA --width PIXELS -o SHOT`: maps that undistort the picture of a lens, and distort it again."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import fingerprint_of
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.base.settings import positive, setting
from neurolens.cli.arguments import (
    CAMERAS_HELP,
    Glasses,
    LensState,
    Reporting,
    check_folder,
    film_size,
    lens,
    lens_state,
    output_path,
    wavelengths_nm,
)  # fmt: skip
from neurolens.cli.keys import LENS_KEYS, Frames, frames_group, frames_of
from neurolens.cli.output import number
from neurolens.render.settings import size_by_shape

if TYPE_CHECKING:
    from neurolens.cameras.contract import Camera, FloatArray
    from neurolens.cameras.field import Field
    from neurolens.lens.shot import Shot
    from neurolens.render.stmap import Plates

Maker = Callable[["Field", "Plates", Callable[[float], None]], "dict[str, FloatArray]"]
_LARGEST = 16384  # pixels a side
LIGHT_NM = (400.0, 700.0)
# Dominant wavelengths of the primaries of Rec. 709 (and sRGB), for light of D65.
_CHANNELS_NM = (611.4, 549.1, 464.2)
_NAMES = ("red", "green", "blue")


def whole_pair(names: str, most: int) -> Callable[[str], tuple[int, int]]:
    """Type of --size and --grid: two whole numbers with x between them."""

    def pair(text: str) -> tuple[int, int]:
        words = text.lower().split("x")
        if len(words) == 2 and all(w.isascii() and w.isdecimal() and 1 <= int(w[:9]) <= most for w in words):
            return int(words[0]), int(words[1])
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {names}, each from 1 to {most}")

    return pair


def channels_nm(text: str) -> tuple[float, ...]:
    """Type of --wavelengths: those of red, green and blue."""
    waves = wavelengths_nm(text)
    if len(waves) == 3 and all(LIGHT_NM[0] <= nm <= LIGHT_NM[1] for nm in waves):
        return waves
    span = f"{LIGHT_NM[0]:g} to {LIGHT_NM[1]:g}"
    raise argparse.ArgumentTypeError(f"got {text!r}, expected three wavelengths from {span} nm: red,green,blue")


@dataclass(frozen=True, kw_only=True)
class PictureCommand(Glasses, Reporting):
    """A command about the picture of a lens."""

    kept: ClassVar[str] = "files that were written are whole"

    camera: str = lens(also=", see below", models=True, cameras=True, positional=True)
    width: int | None = setting(
        None, "width of the lens's picture (default: from --height and the film's shape)", within=(1, _LARGEST),
        metavar="PIXELS",
    )  # fmt: skip
    height: int | None = setting(
        None, "height of the lens's picture (default: from --width and the film's shape)", within=(1, _LARGEST),
        metavar="PIXELS",
    )  # fmt: skip
    size: tuple[int, int] | None = setting(
        None, argparse.SUPPRESS, kind=whole_pair("WIDTHxHEIGHT in pixels", _LARGEST), metavar="WxH",
    )  # fmt: skip  # the old spelling
    film: tuple[float, float] = setting(..., "size of the film in mm", kind=film_size, metavar="WxH")
    state: LensState = lens_state()

    @property
    def picture(self) -> tuple[int, int]:
        """Width and height of the lens's picture in pixels."""
        if not (self.size or self.width or self.height):
            self.refuse("--width", "(missing)", "--width or --height of the lens's picture")
        return self.size or size_by_shape(self.film[0] / self.film[1], self.width, self.height)

    def make(self, state: LensState, progress: Progress, compiled: bool = False) -> tuple[Camera, Shot]:
        """The camera in a state of its lens, and its settings; what the camera notes is a warning.

        `compiled`: a lens or model is compiled, unless the argument says how it runs.

        Raises:
            InputError: a film whose shape is not that of the picture.
        """
        from neurolens.base import lensname
        from neurolens.cameras.build import make_camera
        from neurolens.render.film import PixelGrid

        PixelGrid(*self.picture, self.film)
        shot = state.shot(self.film, wavelength_nm=LIGHT_NM)
        camera = make_camera(lensname.compiled(self.camera) if compiled else self.camera, shot, progress)
        for note in camera.settings.get("notes", ()):
            warn(note)
        return camera, shot


@dataclass(frozen=True)
class TracedFrame:
    """One frame: its number in file names ("" for a single one), focus, camera, and fields by their maps' names."""

    number: str
    focus_m: float
    camera: Camera
    fields: dict[str, Field]


@dataclass(frozen=True, kw_only=True)
class StMap(PictureCommand):
    """Write ST maps of a lens (or model, or any other camera) for compositing, float32 OpenEXR:

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
    for another plane. Maps that an earlier run of the same settings left stay.

    The place of a thing in the picture is the centroid of its light at this stop, over pupil and wavelengths as the
    eye weighs them. Lenses with cylinders keep their squeeze: each meridian has its own focal length and its own
    entrance pupil. All maps have the pixel aspect ratio, which is printed, in the attribute pixelAspectRatio."""

    about: ClassVar[str] = "ST maps, which undistort and redistort pictures of a lens"
    epilog: ClassVar[str] = f"""{CAMERAS_HELP}

examples:
  neurolens stmap lenses/laikin_double_gauss_50.toml --width 3840 --film 36x20.25 --focus 2 -o shot
  neurolens stmap models/NAME.onnx --width 1920 --film 24x13.5 --frames 1:48 --key focus=1:1.2,48:3 -o pull
  neurolens stmap lenses/NAME.toml --width 1920 --film 36x20.25 --lateral-colour -o shot   # and per channel
  neurolens stmap lenses/isshiki_fisheye_10.toml --width 2000 --film 18x18 --projection equidistant -o fisheye"""

    out: Path = output_path("SHOT", "start of the files' names")
    projection: Literal["rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"] = setting(
        "rectilinear",
        "of the undistorted picture (default: rectilinear, a plane: fields up to 85 degrees from the axis)",
    )
    distance: float | None = setting(
        None, "distance from the film to what shall be in place, in metres, or inf (default: what is in focus)",
        kind=positive("a distance in metres", infinite=True), metavar="M",
    )  # fmt: skip
    lateral_colour: bool = setting(
        False, "maps for each channel too, SHOT.undistort.red.exr and so on, of the --wavelengths"
    )
    wavelengths: tuple[float, float, float] = setting(
        _CHANNELS_NM, "those of red, green and blue (default: 611.4,549.1,464.2 nm, the dominant ones of Rec. 709)",
        kind=channels_nm, metavar="NM", old=("channels-nm",),
    )  # fmt: skip
    frames: Frames = frames_group(
        "maps of these frames, SHOT.undistort.0001.exr and so on, all of one overscan", LENS_KEYS
    )

    def run(self) -> int:
        """Trace the fields of all frames, then write their maps, of one size."""
        check_folder(self.out, "--output")
        if not self.out.name:
            self.refuse("--output", str(self.out), "the start of the files' names")
        self.frames.check(self.called)
        progress = self.progress()
        frames, plates = self.traced(progress)
        files = self.maps(frames, plates, progress, self.out)
        data = self.data_of(frames, plates) | {"files": files}
        return self.answer(data, lambda: _text(data))

    def states(self) -> list[tuple[str, LensState]]:
        """The numbers of frames as file names have them, and the state of the lens there."""
        if self.frames.frames is None:
            return [("", self.state)]
        keyed = frames_of(self.frames.frames, self.frames.key, vars(self.state), self.called, LENS_KEYS)
        return [(digits, replace(self.state, **values)) for _, digits, values in keyed]

    def traced(self, progress: Progress) -> tuple[list[TracedFrame], Plates]:
        """All frames with their fields, and the pictures that hold what any of them shows."""
        from neurolens.render.stmap import plates_of

        states, frames = self.states(), []
        with progress.stage(f"trace the field of {self.camera}") as report:
            for k, (digits, state) in enumerate(states):
                frames.append(self._traced(state, digits, progress))
                report((k + 1) / len(states))
        return frames, plates_of([f for frame in frames for f in frame.fields.values()], self.picture, self.film)

    def _traced(self, state: LensState, digits: str, progress: Progress) -> TracedFrame:
        """The fields of one frame."""
        from neurolens.cameras.field import field_of, frame_of, spectrum_of

        camera, shot = self.make(state, progress)
        frame = frame_of(camera)
        wavelengths = dict(zip(_NAMES, self.wavelengths, strict=True)) if self.lateral_colour else {}
        fields = {
            name: field_of(
                camera, shot.focus_m, self.projection, frame=frame, distance_m=self.distance,
                spectrum=spectrum_of(camera, LIGHT_NM, nm),
            )
            for name, nm in {"": None, **wavelengths}.items()
        }  # fmt: skip
        return TracedFrame(digits, shot.focus_m, camera, fields)

    def maps(self, frames: list[TracedFrame], plates: Plates, progress: Progress, start: Path) -> list[str]:
        """Write the maps of all frames; their names, which begin with `start`."""
        files = []
        with progress.stage("write the maps") as report:
            for k, frame in enumerate(frames):
                files += self._written(frame, plates, start, _part(report, k, len(frames)))
        return files

    def jobs(self, frame: TracedFrame) -> list[tuple[str, str, Maker]]:
        """The maps of a frame: kind, colour ("" for the mean one), and what makes the channels."""
        from neurolens.render.stmap import illumination_map, redistort_map, undistort_map

        makers = {"undistort": undistort_map, "redistort": redistort_map}
        pairs = [(kind, name, make) for name in frame.fields for kind, make in makers.items()]
        return [*pairs, ("illumination", "", illumination_map)]

    def _written(self, frame: TracedFrame, plates: Plates, start: Path, report: Callable[[float], None]) -> list[str]:
        """Write the maps of one frame, but those that an earlier run of the same settings left; their names."""
        from neurolens.render.pictures import standard_attributes, write_channels

        jobs, files = self.jobs(frame), []
        header = standard_attributes(frame.camera.settings, frame=int(frame.number) if frame.number else None)
        header["pixelAspectRatio"] = _ideal(frame.fields[""], plates)["pixel_aspect"]
        about: dict[str, Any] = {"version": __version__, "camera": str(self.camera), "name": frame.camera.name}
        about |= {"picture_px": list(plates.picture), "undistorted_px": list(plates.undistorted)}
        about |= {"film_mm": list(self.film), "focus_m": None if math.isinf(frame.focus_m) else frame.focus_m}
        about["settings"] = fingerprint_of(plain([frame.camera.settings, self.distance, self.state.stop]))
        for k, (kind, name, make) in enumerate(jobs):
            field = frame.fields[name]
            path = start.with_name(".".join(filter(None, (start.name, kind, name, frame.number, "exr"))))
            facts = about | {"map": kind, "wavelengths_nm": field.spectrum[0].tolist(), **_ideal(field, plates)}
            if not _is_of(path, facts):
                planes = make(field, plates, _part(report, 2 * k, 2 * len(jobs)))
                write_channels(path, planes, None, facts, header)
            files.append(str(path))
            report((k + 1) / len(jobs))
        return files

    def data_of(self, frames: list[TracedFrame], plates: Plates) -> dict[str, Any]:
        """The figures of the maps."""
        from neurolens.render.stmap import worst_px

        rows = []
        for frame in frames:
            field = frame.fields[""]
            moved, missed = worst_px(field, plates)
            pixel = min(plates.pixel_mm)
            parallax = [{"distance_m": d, "px": mm / pixel} for d, mm in field.parallax_mm.items()]
            row: dict[str, Any] = {"frame": int(frame.number) if frame.number else None, "focus_m": frame.focus_m}
            row |= _ideal(field, plates)
            row |= {"field_deg": field.field_deg, "shift_px": moved, "there_and_back_px": missed}
            # One pinhole, at the y meridian's pupil, shows widths in this plane as the pupil of the x meridian does.
            plane = 1e3 * (frame.focus_m if self.distance is None else self.distance)
            x, y = field.frame.pupil_mm
            nearer = 1.0 if math.isinf(plane) else (plane - x) / (plane - y)
            row |= {"plane_m": plane / 1e3, "pixel_aspect_of_one_pinhole": row["pixel_aspect"] * nearer}
            rows.append(row | {"parallax": parallax})
        return {
            "camera": str(self.camera),
            "picture_px": list(plates.picture),
            "undistorted_px": list(plates.undistorted),
            "overscan": list(plates.overscan),
            "film_undistorted_mm": [n * p for n, p in zip(plates.undistorted, plates.pixel_mm, strict=True)],
            "frames": rows,
        }


def _is_of(path: Path, facts: dict[str, Any]) -> bool:
    """Whether a map is there, whole, with this in its header."""
    from neurolens.render.pictures import read_metadata

    with suppress(InputError):
        return read_metadata(path) == plain(facts)
    return False


def _part(report: Callable[[float], None], done: int, of: int) -> Callable[[float], None]:
    """The report of the part of a stage that begins when `done` of so many are done."""
    return lambda share: report((done + share) / of)


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
