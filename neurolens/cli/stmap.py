"""`neurolens stmap CAMERA -o SHOT`: maps that undistort the picture of a lens, and distort it again; and `neurolens
projection CAMERA --projection NAME`: a lens as the projections of vision and splatting programs."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field as dataclass_field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import fingerprint_of
from neurolens.base.progress import Progress
from neurolens.base.report import PART, Report, plain
from neurolens.base.settings import LIGHT_NM, between, positive, setting, wavelengths_nm
from neurolens.cameras.build import near_of
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.field import (
    Field,
    Frame,
    diagonal_points,
    field_of,
    frame_of,
    lit_points,
    on_axis,
    shown_at,
    spectrum_of,
)
from neurolens.cameras.sampling import focus_m
from neurolens.cli import arguments as cli
from neurolens.cli.keys import LENS_KEYS, Frames, frames_group
from neurolens.optics.lens.shot import Runtime, Shot
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.pictures import read_channels, standard_attributes, write_channels
from neurolens.pictures.render.settings import size_by_shape
from neurolens.pictures.render.stmap import (
    Plates,
    illumination_map,
    in_pixels,
    plates_of,
    redistort_map,
    undistort_map,
    worst_px,
)

if TYPE_CHECKING:
    from neurolens.programs.handover import FittedProjection

Maker = Callable[[Field, Plates, Callable[[float], None]], dict[str, FloatArray]]
_LARGEST = 16384  # pixels a side
_SEEN = 17, 11  # points of the film, whose parallax is told
# Dominant wavelengths of the primaries of Rec. 709 (and sRGB), for light of D65.
_CHANNELS_NM = (611.4, 549.1, 464.2)
_NAMES = ("red", "green", "blue")


def whole_pair(names: str, most: int) -> Callable[[str], tuple[int, int]]:
    """Return the type of --size and --grid: two whole numbers with x between them."""

    def pair(text: str) -> tuple[int, int]:
        words = text.lower().split("x")
        if len(words) == 2 and all(w.isascii() and w.isdecimal() and 1 <= int(w[:9]) <= most for w in words):
            return int(words[0]), int(words[1])
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {names}, each from 1 to {most}")

    return pair


def channels_nm(text: str) -> tuple[float, ...]:
    """Read --wavelengths: those of red, green and blue."""
    waves = wavelengths_nm(text)
    if len(waves) == 3 and all(LIGHT_NM[0] <= nm <= LIGHT_NM[1] for nm in waves):
        return waves
    span = f"{LIGHT_NM[0]:g} to {LIGHT_NM[1]:g}"
    raise argparse.ArgumentTypeError(f"got {text!r}, expected three wavelengths from {span} nm: red,green,blue")


@dataclass(frozen=True, kw_only=True)
class PictureCommand(cli.Reporting):
    """A command about the picture of a lens."""

    kept = "files that were written are whole"
    usual_px: ClassVar[int] = 1920

    camera: str = cli.lens(models=True, cameras=True, positional=True)
    width: int | None = setting(
        None, "width of the lens's picture (default: by --height, else one that the command states)",
        within=(1, _LARGEST), metavar="PIXELS", common=True,
    )  # fmt: skip
    height: int | None = setting(
        None, "height of the lens's picture (default: from --width and the film's shape)", within=(1, _LARGEST),
        metavar="PIXELS",
    )  # fmt: skip
    size: tuple[int, int] | None = setting(
        None, argparse.SUPPRESS, kind=whole_pair("WIDTHxHEIGHT in pixels", _LARGEST), metavar="WxH",
    )  # fmt: skip  # the old spelling
    film: tuple[float, float] = cli.film()
    state: cli.LensState = cli.camera_state()

    def assumed(self) -> Any:
        """Assume the width as well."""
        width = "--width", lambda: (self.usual_px, str(self.usual_px))
        return super().assumed() | ({} if self.height or self.size else {"width": width})

    @property
    def picture(self) -> tuple[int, int]:
        """Width and height of the lens's picture in pixels."""
        return self.size or size_by_shape(self.film[0] / self.film[1], self.width, self.height)

    def make(
        self,
        state: cli.LensState,
        progress: Progress,
        runtime: Runtime | None = "onnxruntime",
        light_nm: tuple[float, float] = LIGHT_NM,
    ) -> tuple[Camera, Shot]:
        """Make the camera in a state of its lens, for light of this range; return it with its settings.

        `runtime`: as of `Shot`; maps take so few rays that compiling would take longer.

        Raises:
            InputError: a film whose shape is not that of the picture.
        """
        PixelGrid(*self.picture, self.film)
        shot = state.shot(self.film, wavelength_nm=light_nm, runtime=state.given.runtime or runtime)
        camera = cli.camera(self.camera, shot, progress)
        return camera, replace(shot, focus_m=focus_m(camera, shot))


@dataclass(frozen=True, kw_only=True)
class FieldCommand(PictureCommand):
    """A command about where things appear in the picture of a lens.

    It also says how wrong a single centre of projection is for things at other distances.
    """

    near: float | None = setting(
        None, "distance from the film to the nearest thing in view, whose parallax the command states in pixels "
        "(default: the nearest that the lens focuses)",
        kind=between(1e-3, 1e6, "a distance in metres"), metavar="M", common=True,
    )  # fmt: skip

    def near_m(self, frame: Frame) -> float:
        """Return the nearest distance, checked against the entrance pupil's."""
        pupil = 1e-3 * max(frame.pupil_mm)
        if self.near is not None and self.near <= pupil:
            self.refuse("--near", self.near, f"more than {pupil:.4g} m, the distance of the entrance pupil")
        return self.near or float(f"{max(near_of(self.camera, **self._size()), 1.5 * pupil):.3g}")

    def parallax(self, camera: Camera, field: Field) -> list[dict[str, float]]:
        """Return how far things, at infinity and near, appear from where the field's one centre puts them."""
        point = np.concatenate([lit_points(field, self.film, _SEEN), diagonal_points(field, self.film)])
        point = point[field.lit(point)]
        pixel = self.film[0] / self.picture[0], self.film[1] / self.picture[1]
        distances = [d for d in (math.inf, self.near_m(field.frame)) if d != field.distance_m]
        return [{"distance_m": d, **in_pixels(shown_at(camera, field, point, d) - point, pixel)} for d in distances]


@dataclass(frozen=True)
class TracedFrame:
    """One frame: its number in file names ("" for a single one), focus, camera, and fields by their maps' names."""

    number: str
    focus_m: float
    camera: Camera
    fields: dict[str, Field]

    @property
    def index(self) -> int | None:
        """The frame's number; None for a single frame."""
        return int(self.number) if self.number else None


@dataclass(frozen=True, kw_only=True)
class StMap(FieldCommand):
    """Write the ST maps of a camera for compositing, as float32 OpenEXR. A lens is focused at infinity with its widest
    stop:

      SHOT.undistort.exr     makes the undistorted picture from that of the lens (the plate)
      SHOT.redistort.exr     makes the picture of the lens from an undistorted one, as CG is rendered
      SHOT.illumination.exr  relative illumination of the plate, channel Y, 1 on the axis

    R is s, G is t, from 0 at the left and bottom edge of the picture that is read to 1, as Nuke's STMap and Blender's
    Map UV read them; B is 1 inside that picture. Load the maps as raw data. A map has the size of the picture it makes.

    The undistorted picture has the plate's pixels and centre, and is larger by the overscan: it holds every pixel of
    the plate. Render CG of that size with a pinhole camera of the focal length and place that are printed: the lens's
    paraxial size in the plane in focus, seen from its entrance pupil. Things at other distances are off by what is
    printed as parallax; --distance makes maps for another plane. The place of a thing is the centroid of its light at
    this stop, as the eye weighs wavelengths. Maps that an earlier run of the same settings left stay."""

    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens stmap laikin_double_gauss_50 --width 3840 --film 36x20.25 --focus 2 -o shot
  neurolens stmap models/NAME.onnx --width 1920 --film 24x13.5 --frames 1:48 --key focus=1:1.2,48:3 -o pull
  neurolens stmap lenses/NAME.toml --width 1920 --film 36x20.25 --lateral-colour -o shot   # and per channel
  neurolens stmap isshiki_fisheye_10 --width 2000 --film 18x18 --projection equidistant -o fisheye"""

    out: Path = cli.output_path("SHOT", "start of the files' names")
    projection: Literal["rectilinear", "equidistant", "equisolid", "stereographic", "orthographic"] = setting(
        "rectilinear",
        "projection of the undistorted picture (default: rectilinear, a plane, which holds 85 degrees from "
        "the axis)",
        common=True,
    )  # fmt: skip
    distance: float | None = setting(
        None, "distance from the film to what shall be in place, in metres, or inf (default: what is in focus)",
        kind=positive("a distance in metres", infinite=True), metavar="M",
    )  # fmt: skip
    lateral_colour: bool = setting(
        False, "write maps for each channel, too (SHOT.undistort.red.exr, ...), of the --wavelengths", common=True
    )
    wavelengths: tuple[float, float, float] = setting(
        _CHANNELS_NM, "wavelengths of red, green and blue (default: 611.4,549.1,464.2 nm, the dominant ones of Rec. "
        "709)",
        kind=channels_nm, metavar="NM", old=("channels-nm",),
    )  # fmt: skip
    frames: Frames = frames_group(
        "maps of these frames, SHOT.undistort.0001.exr and so on, all of one overscan", LENS_KEYS
    )

    def run(self) -> int:
        """Trace the fields of all frames, then write their maps, of one size."""
        progress = self.progress()
        frames, plates = self.traced(progress)
        return self.answer(self.found(frames, plates, self.maps(frames, plates, progress, self.out)))

    def states(self) -> list[tuple[str, cli.LensState]]:
        """Return the numbers of frames as file names have them, with the state of the lens in each."""
        keyed = self.frames.states(vars(self.state.given), self.called, LENS_KEYS)
        return [(digits, self.state.at(**values)) for _, digits, values in keyed]

    def traced(self, progress: Progress) -> tuple[list[TracedFrame], Plates]:
        """Return all frames with their fields, and the pictures that hold what any of them shows."""
        states, frames = self.states(), list[TracedFrame]()
        colours = dict(zip(_NAMES, self.wavelengths, strict=True)) if self.lateral_colour else {}
        with progress.stage(f"trace the field of {self.camera}") as report:
            for digits, state in states:
                camera, shot = self.make(state, progress)
                frame = frame_of(camera)
                self.near_m(frame)
                fields = {
                    name: field_of(
                        camera, shot.focus_m, self.projection, frame=frame, distance_m=self.distance,
                        spectrum=spectrum_of(camera, LIGHT_NM, nm),
                    )
                    for name, nm in {"": None, **colours}.items()
                }  # fmt: skip
                frames.append(TracedFrame(digits, shot.focus_m, camera, fields))
                report(len(frames) / len(states))
        return frames, plates_of([f for frame in frames for f in frame.fields.values()], self.picture, self.film)

    def jobs(self, frame: TracedFrame) -> list[tuple[str, str, Maker]]:
        """Return the maps of a frame: kind, colour ("" for the mean one), and what makes the channels."""
        makers = {"undistort": undistort_map, "redistort": redistort_map}
        pairs = [(kind, name, make) for name in frame.fields for kind, make in makers.items()]
        return [*pairs, ("illumination", "", illumination_map)]

    def maps(self, frames: list[TracedFrame], plates: Plates, progress: Progress, start: Path) -> list[str]:
        """Write the maps of all frames and return their names, which begin with `start`.

        Maps that an earlier run of the same settings left are kept.
        """
        files, todo = list[str](), [(frame, *job) for frame in frames for job in self.jobs(frame)]
        with progress.stage("write the maps") as report:
            for k, (frame, kind, name, make) in enumerate(todo):
                path = start.with_name(".".join(filter(None, (start.name, kind, name, frame.number, "exr"))))
                field, facts = frame.fields[name], self._facts(frame, plates, kind, name)
                if not _is_of(path, facts):

                    def part(share: float, done: int = k) -> None:
                        report((done + share / 2) / len(todo))

                    planes = make(field, plates, part)
                    header = {
                        **standard_attributes(frame.camera.settings, frame=frame.index),
                        "pixelAspectRatio": facts["pixel_aspect"],
                    }
                    write_channels(path, planes, None, facts, header)
                files.append(str(path))
                report((k + 1) / len(todo))
        return files

    def _facts(self, frame: TracedFrame, plates: Plates, kind: str, name: str) -> dict[str, Any]:
        """Return what the header of a map says of it."""
        field = frame.fields[name]
        return {
            "version": __version__,
            "name": frame.camera.name,
            "picture_px": list(plates.picture),
            "undistorted_px": list(plates.undistorted),
            "film_mm": list(self.film),
            "focus_m": None if math.isinf(frame.focus_m) else frame.focus_m,
            "settings": fingerprint_of(plain([frame.camera.settings, self.distance, self.state.stop])),
            "map": kind,
            "wavelengths_nm": field.spectrum[0].tolist(),
            **vars(Undistorted.of(field, plates)),
        }

    def found(self, frames: list[TracedFrame], plates: Plates, files: list[str]) -> Maps:
        """Return the figures of the maps."""
        rows = []
        for frame in frames:
            field, ideal = frame.fields[""], Undistorted.of(frame.fields[""], plates)
            moved, missed = worst_px(field, plates)
            # One pinhole, at the y meridian's pupil, shows widths in this plane as the pupil of the x meridian does.
            plane = 1e3 * (frame.focus_m if self.distance is None else self.distance)
            x, y = field.frame.pupil_mm
            nearer = 1.0 if math.isinf(plane) else (plane - x) / (plane - y)
            rows.append(MapsOfFrame(
                frame=frame.index, focus_m=frame.focus_m, ideal=ideal, field_deg=field.field_deg, shift_px=moved,
                there_and_back_px=missed, plane_m=plane / 1e3, pixel_aspect_of_one_pinhole=ideal.pixel_aspect * nearer,
                parallax=self.parallax(frame.camera, field),
            ))  # fmt: skip
        film = [n * p for n, p in zip(plates.undistorted, plates.pixel_mm, strict=True)]
        return Maps(
            camera=str(self.camera), picture_px=plates.picture, undistorted_px=plates.undistorted,
            overscan=plates.overscan, film_undistorted_mm=film, frames=rows, files=files,
        )  # fmt: skip


def _is_of(path: Path, facts: dict[str, Any]) -> bool:
    """Test whether a map is there, whole, with these facts in its header."""
    with suppress(InputError):
        return read_channels(path)[1] == plain(facts)
    return False


@dataclass(frozen=True)
class Undistorted:
    """The camera that an undistorted picture is of; lists are for the x and the y meridian.

    In both pictures a pixel shows `pixel_aspect` times as much across as up, and viewers stretch it so.
    """

    projection: str
    focal_mm: list[float]
    before_film_mm: list[float]
    pixel_aspect: float

    @classmethod
    def of(cls, field: Field, plates: Plates) -> Undistorted:
        """Return the one of a field."""
        (x, y), (width, height) = field.frame.reach_mm, plates.pixel_mm
        aspect = float(f"{y / x * width / height:.6g}")
        return cls(field.target, [x, y], list(field.frame.pupil_mm), aspect)


@dataclass(frozen=True, kw_only=True)
class MapsOfFrame:
    """Figures of the maps of a frame.

    Attributes:
        field_deg: widest angle to the axis. plane_m: from the film to the plane of the maps.
        shift_px: how far distortion moves points at most. there_and_back_px: the most that both maps leave.
        pixel_aspect_of_one_pinhole: of what a pinhole at the y meridian's pupil shows in that plane.
        parallax: for each distance in m, how far things there lie from their place in the maps, in pixels.
    """

    frame: int | None
    focus_m: float
    ideal: Undistorted = dataclass_field(metadata=PART)
    field_deg: float
    shift_px: float
    there_and_back_px: float
    plane_m: float
    pixel_aspect_of_one_pinhole: float
    parallax: list[dict[str, float]]


@dataclass(frozen=True, kw_only=True)
class Maps(Report):
    """The sizes of the pictures of ST maps, the figures of each frame, and the files."""

    camera: str
    picture_px: tuple[int, int]
    undistorted_px: tuple[int, int]
    overscan: tuple[float, float]
    film_undistorted_mm: list[float]
    frames: list[MapsOfFrame]
    files: list[str]

    def text(self) -> str:
        """Return the sizes, the ideal camera, the largest shift, and the files."""
        first, ideal = self.frames[0], self.frames[0].ideal
        (width, height), (wide, high), (fx, fy) = self.picture_px, self.undistorted_px, self.overscan
        focal, before = (
            " x ".join(dict.fromkeys(cli.number(v, 6) for v in both)) for both in (ideal.focal_mm, ideal.before_film_mm)
        )
        film = " x ".join(cli.number(v, 6) for v in self.film_undistorted_mm)
        moved, missed = (max(getattr(f, k) for f in self.frames) for k in ("shift_px", "there_and_back_px"))
        lines = [
            f"{self.camera}: picture {width} x {height}, undistorted {wide} x {high} pixels "
            f"(overscan {fx:.4f} x {fy:.4f}), {film} mm",
            f"undistorted, {ideal.projection}: focal length {focal} mm, the pinhole {before} mm before the film"
            + (" (first frame)" if len(self.frames) > 1 else ""),
            f"distortion moves points by up to {moved:.4g} pixels; there and back within {missed:.2g}",
        ]
        if " x " in focal:
            x, y = (cli.number(v, 6) for v in ideal.before_film_mm)
            line = f"pixel aspect ratio {ideal.pixel_aspect:.5g}; entrance pupil of the x meridian {x} mm, of the y "
            line += f"meridian {y} mm before the film"
            if math.isfinite(first.plane_m):
                plane, aspect = cli.number(first.plane_m, 3), f"{first.pixel_aspect_of_one_pinhole:.5g}"
                line += f"; a pinhole at the latter shows what is {plane} m from the film with {aspect}"
            lines.append(line)
        lines.append(one_centre(first.parallax, ideal.before_film_mm))
        return "\n".join([*lines, *self.files])


def one_centre(parallax: list[dict[str, float]], before_film_mm: list[float]) -> str:
    """Return a sentence on how wrong one centre is for things at other distances."""
    told = [
        f"{cli.number(p['rms_px'], 2)} pixels RMS, {cli.number(p['worst_px'], 2)} at most, for things "
        f"{_where(p['distance_m'])}"
        for p in parallax
    ]
    before = " x ".join(dict.fromkeys(cli.number(v, 4) for v in before_film_mm))
    moves = "the entrance pupil moves with the field, so that one centre"
    return f"{moves}, {before} mm before the film, is off by {'; '.join(told)}"


@dataclass(frozen=True, kw_only=True)
class Projection(FieldCommand, cli.Figures):
    """Describe a camera by a projection of another program (OpenCV, nerfstudio, NVIDIA), and say how many pixels that
    is off. A lens is focused at infinity with its widest stop:

      opencv            fx fy cx cy, k1 k2 p1 p2 k3      opencv-rational   and k4 k5 k6
      kannala-brandt    OpenCV's fisheye, k1 k2 k3 k4    f-theta           NVIDIA's polynomials, both ways

    Directions are those of the light's centroid at this stop, from the lens's entrance pupil to what is in focus. That
    pupil moves with the field, so one centre is wrong for things at other distances: the command says by how many
    pixels, at infinity and at --near. With -o NAME it writes NAME.yaml for OpenCV's FileStorage and NAME.json for
    nerfstudio (its camera block; cx, cy from the corner of the first pixel, OpenCV's from its centre), with NVIDIA's
    names for f-theta; and, where one centre leaves more than half a pixel, NAME.noncentral.yaml: the ray of each pixel,
    as the model noncentral_generic of camera_calibration (Schoeps et al. 2020). `neurolens rays` writes rays over the
    whole pupil, with their light. The command says where a projection turns back within the field, and
    refuses a planar one beyond 85 degrees. Needs the extra "train" (scipy)."""

    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens projection laikin_double_gauss_50 --width 1920 --film 36x20.25 --projection opencv -o gauss
  neurolens projection models/NAME.onnx --width 1920 --film 36x24 --projection f-theta --focus 2 -o fisheye"""

    projection: Literal["opencv", "opencv-rational", "kannala-brandt", "f-theta"] | None = setting(
        None,
        "the projection to fit (default: opencv, or kannala-brandt beyond 85 degrees from the axis)",
        old=("model",),
    )
    noncentral: bool = setting(
        False, "write the ray of each pixel, too, however little one centre leaves (default: above half a pixel)"
    )
    out: Path | None = cli.output_path("NAME", "write NAME.json and, for OpenCV's, NAME.yaml", None)

    def run(self) -> int:
        """Trace, fit, write."""
        from neurolens.programs import handover

        out, progress = self.out, self.progress()
        if out is None and self.noncentral:
            self.refuse("--noncentral", "(without -o)", "-o NAME, which names the file")
        if out is not None and out.suffix in (".json", ".yaml"):  # the name of a file that will be written
            out = out.with_suffix("")
        camera, shot = self.make(self.state, progress, None)
        near_m, spectrum = self.near_m(frame := frame_of(camera)), spectrum_of(camera, LIGHT_NM)
        with progress.stage(f"trace the field of {self.camera}"):
            field = field_of(camera, shot.focus_m, "equidistant", frame=frame, spectrum=spectrum)
        with progress.stage("fit the projection"):
            fitted, left, told = handover.fitted_projection(
                self.projection, field, self.picture, self.film, str(self.camera), complex(on_axis(camera)[0])
            )
        with progress.stage("trace other distances"):
            parallax = self.parallax(camera, field)
            told = replace(told, parallax=parallax)
            if field.round:
                pupil = handover.pupil_mm(camera, field, near_m, np.array([row.to_deg for row in told.by_field]))
                rows = zip(told.by_field, pupil.tolist(), strict=True)
                told = replace(told, by_field=[replace(row, pupil_before_film_mm=mm) for row, mm in rows])
        files = []
        if out is not None and (self.noncentral or handover.noncentral_pays(parallax)):
            with progress.stage("fit the ray of each pixel"):
                table, beside = handover.ray_table(camera, field, self.picture, self.film, shot.focus_m, near_m)
            told = replace(told, noncentral=beside)
            files = [handover.write_ray_table(out, table, beside, str(self.camera), field)]
        elif out is not None:  # one of an earlier run would not belong to these coefficients
            handover.ray_table_path(out).unlink(missing_ok=True)
        if out is not None:
            files = handover.write_projection(out, fitted, told) + files
        if not left.sound:
            turns = f"turns back at {left.fold_deg:.4g} degrees; the picture goes to {left.field_deg:.4g}"
            warn(f"{fitted.kind} {turns}")
        return self.answer(Projected(told, files))


def _where(distance_m: float) -> str:
    return "at infinity" if math.isinf(distance_m) else f"{distance_m:g} m from the film"


@dataclass(frozen=True)
class Projected(Report):
    """A fitted projection, and the files that were written."""

    found: FittedProjection = dataclass_field(metadata=PART)
    files: list[str]

    def text(self) -> str:
        """Return the numbers of the projection, and what it leaves by field and by distance."""
        found = self.found
        numbers = ", ".join(f"{k} {cli.number(v, 6)}" for k, v in found.coefficients.items())
        focal, centre = (" x ".join(cli.number(v, 7) for v in values) for values in (found.focal_px, found.centre_px))
        radii = f"scale {focal}" if found.model == "f-theta" else f"focal length {focal}"
        light = f"{100 * found.light_at_worst:.3g}% of the axis's light arrives"
        worst = f"at most {found.worst_px:.3g} (at {found.worst_at_deg:.3g} degrees, where {light})"
        header, rows = ["field, degrees", "RMS px", "worst px"], list[tuple[str, ...]]()
        for span in found.by_field:
            pupil = () if span.pupil_before_film_mm is None else (f"{span.pupil_before_film_mm:.4g}",)
            angles = f"{span.from_deg:.3g} to {span.to_deg:.3g}"
            rows.append((angles, f"{span.rms_px:.3g}", f"{span.worst_px:.3g}", *pupil))
        if len(rows[0]) > len(header):
            header.append("entrance pupil at its end, mm before the film")
        lines = [
            f"{found.camera}, {found.model}: {radii}, centre {centre} pixels",
            numbers,
            f"what is in focus is off by {found.rms_px:.3g} pixels RMS, {worst}",
            cli.table(header, rows),
            one_centre(found.parallax or [], found.before_film_mm),
        ]
        if found.noncentral is not None:
            rms, most = (cli.number(max(row[key] for row in found.noncentral), 2) for key in ("rms_px", "worst_px"))
            lines.append(f"the ray of each pixel is off by {rms} pixels RMS, {most} at most, at all these distances")
        if found.model == "kannala-brandt" and found.field_deg >= 90:
            lines.append("OpenCV's own functions end at 90 degrees, for they divide by z")
        return "\n".join([*lines, *self.files])
