"""`neurolens handover CAMERA --film WxH --width PIXELS -o FOLDER`: a lens as files of all that follows the render."""

import argparse
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import atomic_write_text
from neurolens.base.html import html
from neurolens.base.progress import Progress
from neurolens.base.report import PART, Report, some_of
from neurolens.base.settings import setting, setting_of
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import on_axis
from neurolens.cli import arguments as cli
from neurolens.cli.stmap import Maker, Maps, Projection, StMap, TracedFrame, one_centre
from neurolens.optics.lens.shot import POSES
from neurolens.pictures.render.pictures import read_channels, standard_attributes
from neurolens.pictures.render.stmap import illumination_map
from neurolens.programs import handover as standards

_KINDS = "opencv", "opencv-rational", "kannala-brandt", "f-theta"


@dataclass(frozen=True, kw_only=True)
class Handover(StMap):
    """Write a lens, model or other camera as files for compositing and tracking: Nuke, Blender, USD, OpenTrackIO,
    lensfun, OpenCV. A lens is focused at infinity with its widest stop.

    It writes to FOLDER:

      shot.undistort.exr, shot.redistort.exr, shot.illumination.exr   ST maps, see neurolens stmap
      shot.nk, shot.blender.py     the maps as node groups of Nuke and Blender, with the pinhole to render CG with
      shot.usda                    that pinhole in USD, with NVIDIA's lookup pictures, shot.enter.exr and shot.exit.exr
      shot.opentrackio.json        a sample of OpenTrackIO 1.0.1
      shot.lensfun.xml             a profile of lensfun: distortion, lateral colour, light by aperture
      shot.opencv.yaml, .json ...  projections of OpenCV, nerfstudio and NVIDIA, see neurolens projection
      shot.noncentral.yaml         the ray of each pixel, where one centre leaves more than half a pixel
      README.md                    how to start, what each file leaves in pixels, what its standard cannot say

    With --frames there is one of each map, sample, projection and table of rays a frame; cameras are animated. What a
    standard has no place for is left out, and the command says so. Needs the extra "train" (scipy)."""

    kept = "files that were written are whole; the same command goes on"
    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens handover laikin_double_gauss_50 --film 36x20.25 --width 3840 --focus 2 --f-number 2.8 -o shot/
  neurolens handover models/NAME.onnx --film 36x20.25 --width 1920 --frames 1:48 --key focus=1:1.2,48:3 -o pull/
  neurolens handover isshiki_fisheye_10 --film 18x18 --width 2000 --projection equidistant -o fisheye/"""

    out: Path = cli.output_path("FOLDER", "folder of the files, which is made")
    noncentral: bool = setting_of(Projection, "noncentral", False)
    fps: Fraction = setting(
        Fraction(24), "frames a second, as 24 or 24000/1001 (default: 24)", kind=lambda text: _rate(text), metavar="N"
    )

    def run(self) -> int:
        """Trace the fields of all frames, write the maps, then what is fitted to them."""
        progress = self.progress()
        frames, plates = self.traced(progress)
        self.out.mkdir(parents=True, exist_ok=True)
        found = self.found(frames, plates, [])
        shot = standards.Handed(
            standard_attributes(frames[0].camera.settings), __version__, (self.fps.numerator, self.fps.denominator),
            tuple(standards.Pinhole.of(f.number, f.fields[""], f.camera.settings, f.focus_m) for f in frames), plates,
            tuple(name for name in frames[0].fields if name), _coatings(frames[0].camera.settings),
        )  # fmt: skip
        writer = _Writer(self, frames, shot)
        files = self.maps(frames, plates, progress, self.out / "shot") + writer.files(found, progress)
        for note in writer.notes:
            warn(f"not written: {note}")
        return self.answer(Handed(replace(found, files=files), writer.notes, writer.left, writer.fits))

    def jobs(self, frame: TracedFrame) -> list[tuple[str, str, Maker]]:
        """Return the maps of `stmap`, a map of the light (grey with alpha, for programs that multiply) and NVIDIA's."""

        def light(*given: Any) -> dict[str, Any]:
            grey = illumination_map(*given)["Y"]
            return {**dict.fromkeys("RGB", grey), "A": 0 * grey + 1}

        maps = super().jobs(frame)[:-1]
        return [
            *maps,
            ("illumination", "", light),
            ("enter", "", standards.enter_map),
            ("exit", "", standards.exit_map),
        ]


@dataclass(frozen=True)
class _Writer:
    """Writes what a shot has besides its maps.

    Attributes:
        left: the largest error of each standard over all frames.
        fits: what is fitted, by kind of projection.
        notes: what is not written, and why.
    """

    command: Handover
    frames: list[TracedFrame]
    shot: standards.Handed
    left: dict[str, float] = field(default_factory=dict)
    fits: dict[str, standards.FittedProjection] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def posed(self) -> list[str]:
        """Return the settings by which the film of any frame is turned or moved."""
        return sorted({name for f in self.frames for name in POSES if f.camera.settings.get(name)})

    def files(self, found: Maps, progress: Progress) -> list[str]:
        """Write all files and return their names."""
        names, command, shot = [], self.command, self.shot
        tables = command.noncentral or any(standards.noncentral_pays(row.parallax) for row in found.frames)
        with progress.stage("fit projections, OpenTrackIO") as report:
            for k in range(len(self.frames)):
                names += self._of_frame(k)
                if tables:
                    names.append(self._ray_table(k))
                else:  # a file of an earlier run would not belong to these
                    standards.ray_table_path(self._name(k)).unlink(missing_ok=True)
                report((k + 1) / len(self.frames))
        entries = self._entries(progress)
        exits, _ = read_channels(command.out / f"shot.exit{shot.frames[0].name}.exr", "RG")
        self._worse("exit_px", standards.exit_residual_px(self.frames[0].fields[""], shot.plates, exits))
        self._worse("maps_px", max(row.there_and_back_px for row in found.frames))
        values = {
            "shot": shot,
            "about": f"{shot.about}, neurolens {__version__}",
            "entries": entries,
            "left": self.left,
            "fits": self.fits,
            "notes": self.notes,
            "projection": command.projection,
            "parallax": found.frames[0].parallax,
            "types": standards.LENSFUN_TYPES,
        }
        for name in ("shot.usda", "shot.nk", "shot.blender.py", "shot.lensfun.xml", "README.md"):
            if entries or name != "shot.lensfun.xml":
                template = f"handover.{name.removeprefix('shot.')}.jinja"
                atomic_write_text(command.out / name, html(template, **values))
                names.append(str(command.out / name))
        return names

    def _of_frame(self, k: int) -> list[str]:
        """Write the OpenTrackIO sample and the projections of a frame; return their names."""
        command, pinhole, traced = self.command, self.shot.frames[k], self.frames[k].fields[""]
        text, left_px, share = standards.opentrackio_sample(traced, pinhole, self.shot, bool(self.posed))
        atomic_write_text(path := command.out / f"shot.opentrackio{pinhole.name}.json", text)
        self._worse("opentrackio_px", left_px)
        self._worse("light_share", share)
        names, axis = [str(path)], complex(on_axis(self.frames[k].camera)[0])
        for kind in _KINDS:
            try:
                fitted, _, told = standards.fitted_projection(
                    kind, traced, command.picture, command.film, self.shot.about, axis
                )
            except InputError as error:
                note = f"shot.{kind}: got {error.value}, expected {error.expected}"
                self.notes.extend([note] if note not in self.notes else [])
                continue
            names += standards.write_projection(command.out / f"shot.{kind}{pinhole.name}", fitted, told)
            if told.worst_px >= self.fits.get(kind, told).worst_px:
                self.fits[kind] = told
        return names

    def _ray_table(self, k: int) -> str:
        """Write the table of rays of a frame; return its name."""
        command, frame = self.command, self.frames[k]
        field, near_m = frame.fields[""], command.near_m(frame.fields[""].frame)
        table, left = standards.ray_table(frame.camera, field, command.picture, command.film, frame.focus_m, near_m)
        self._worse("noncentral_px", max(row["worst_px"] for row in left))
        return standards.write_ray_table(self._name(k), table, left, self.shot.about, field)

    def _name(self, k: int) -> Path:
        """Return the start of the names of a frame's files."""
        return self.command.out / f"shot{self.shot.frames[k].name}"

    def _worse(self, name: str, value: float | None) -> None:
        if value is not None:
            self.left[name] = max(value, self.left.get(name, 0.0))

    def _entries(self, progress: Progress) -> list[standards.LensfunEntry]:
        """Return the entries of lensfun's profile, by focal length; none for a moved film or a lens with cylinders."""
        if self.posed:
            moves = ", ".join(self.posed)
            self.notes.append(f"shot.lensfun.xml: lensfun knows no film that is turned or moved ({moves})")
            self.notes.append(f"USD, Nuke, Blender and OpenTrackIO get an upright pinhole; the ST maps hold {moves}")
            return []
        if self.shot.frames[0].squeeze != 1:
            self.notes.append("shot.lensfun.xml: lensfun knows no anamorphic lens")
            return []
        command, states, found = self.command, self.command.states(), list[Any]()
        by_focal = dict(sorted((float(f"{p.focal_mm:.5g}"), k) for k, p in enumerate(self.shot.frames)))
        rows = list(by_focal.values())
        chosen = some_of(rows, standards.MOST_ENTRIES)
        red_blue = command.wavelengths[0], command.wavelengths[2]
        with progress.stage("fit lensfun's profile") as report:
            for row in chosen:
                frame, (_, state) = self.frames[row], states[row]
                plane_m = frame.focus_m if command.distance is None else command.distance

                def at_stop(f_number: float | None, state: cli.LensState = state) -> Camera:
                    return command.make(state.at(f_number=f_number), progress)[0]

                entry = standards.lensfun_entry(frame.fields[""], frame.camera, plane_m, self.shot, red_blue, at_stop)
                found.append(entry)
                self._worse("lensfun_px", entry.distortion_px)
                self._worse("colour_px", entry.colour_px)
                self._worse("lensfun_share", entry.light_share)
                report(len(found) / len(chosen))
        return found


def _coatings(settings: Mapping[str, Any]) -> str:
    """Return the coatings of a camera's lens, as `Lens.coatings`; "" where the camera states none."""
    return str(settings.get("coatings") or (settings.get("card") or {}).get("lens", {}).get("coatings", ""))


def _rate(text: str) -> Fraction:
    """Read --fps."""
    with suppress(ValueError, ZeroDivisionError):
        if len(text) < 20 and 1 <= (rate := Fraction(text)) <= 1000:
            return rate.limit_denominator(1001)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected frames a second from 1 to 1000, as 24 or 24000/1001")


@dataclass(frozen=True)
class Handed(Report):
    """The maps and files of a shot, what was not written, and the most that each standard and projection leaves."""

    maps: Maps = field(metadata=PART)
    not_written: list[str]
    left: dict[str, float]
    projections: dict[str, standards.FittedProjection]

    def text(self) -> str:
        """Return a table of what each standard leaves."""
        names = {
            "ST maps, there and back": "maps_px", "NVIDIA's lookup pictures": "exit_px",
            "ray of each pixel, at any distance": "noncentral_px", "OpenTrackIO": "opentrackio_px",
            "lensfun": "lensfun_px", "lensfun, colours": "colour_px",
        }  # fmt: skip
        rows = [(name, f"{self.left[key]:.2g}") for name, key in names.items() if key in self.left]
        rows += [(kind, f"{fit.worst_px:.2g}") for kind, fit in self.projections.items()]
        maps, first = self.maps, self.maps.frames[0]
        heading = f"{maps.camera}: {len(maps.files)} files are written; README.md in their folder explains them"
        told = f"{cli.table(('largest error of what is in focus', 'pixels'), rows)}"
        return f"{heading}\n{told}\n{one_centre(first.parallax, first.ideal.before_film_mm)}"
