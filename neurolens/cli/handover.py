"""`neurolens handover CAMERA --film WxH --size WxH -o FOLDER`: a lens as files of all that follows the render."""

from __future__ import annotations

import argparse
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import atomic_write_text, write_json
from neurolens.base.html import html
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.base.settings import setting
from neurolens.cli.arguments import CAMERAS_HELP, check_folder, check_run_folder, output_path
from neurolens.cli.output import number, table
from neurolens.cli.projection import fitted_to, write_projection
from neurolens.cli.stmap import Maker, StMap, TracedFrame, part_of

if TYPE_CHECKING:
    from neurolens.handover.lensfun import Entry
    from neurolens.handover.shot import Handed
    from neurolens.render.stmap import Plates

_CURVES = "behind_m", "focal_mm", "before_m", "f_stop"
_KINDS = "opencv", "opencv-rational", "kannala-brandt", "f-theta"


@dataclass(frozen=True, kw_only=True)
class Handover(StMap):
    """Write a lens (or model, or any other camera) as the files of the programs that follow a render, to FOLDER:

      shot.undistort.exr, shot.redistort.exr, shot.illumination.exr   ST maps, see neurolens stmap
      shot.nk, shot.blender.py     the maps as node groups of Nuke and Blender, with the pinhole to render CG with
      shot.usda                    that pinhole in USD, and the lens by NVIDIA's lookup pictures, shot.enter.exr and
                                   shot.exit.exr
      shot.opentrackio.json        a sample of OpenTrackIO 1.0.1
      shot.lensfun.xml             a profile of lensfun: distortion, lateral colour, light by aperture
      shot.opencv.yaml, .json ...  projections of OpenCV, nerfstudio and NVIDIA, see neurolens projection
      README.md                    how to start, what each file leaves in pixels, what its standard cannot say

    With --frames there is one of each map, sample and projection a frame; cameras are animated. An interrupted run
    goes on: maps that are whole stay. What a standard has no place for is not written, and said. Needs the extra
    "train" (scipy)."""

    about: ClassVar[str] = "a lens as files for Nuke, Blender, USD, OpenTrackIO, lensfun, OpenCV"
    kept: ClassVar[str] = "files that were written are whole; the same command goes on"
    resumes: ClassVar[bool] = True
    epilog: ClassVar[str] = f"""{CAMERAS_HELP}

examples:
  neurolens handover laikin_double_gauss_50 --film 36x20.25 --size 3840x2160 --focus 2 --f-number 2.8 -o shot/
  neurolens handover models/NAME.onnx --film 36x20.25 --width 1920 --frames 1:48 --key focus=1:1.2,48:3 -o pull/
  neurolens handover isshiki_fisheye_10 --film 18x18 --width 2000 --projection equidistant -o fisheye/"""

    out: Path = output_path("FOLDER", "folder of the files, which is made")
    fps: Fraction = setting(
        Fraction(24), "frames a second, as 24 or 24000/1001 (default: 24)", kind=lambda text: _rate(text), metavar="N"
    )

    def run(self) -> int:
        """Trace the fields of all frames, write the maps, then what is fitted to them."""
        check_folder(self.out, "--output")
        check_run_folder(self.out, self.called, "--output")
        self.frames.check(self.called)
        import neurolens.analysis.projections  # noqa: F401 - fails here where scipy is missing, before the work

        progress = self.progress()
        frames, plates = self.traced(progress)
        self.out.mkdir(exist_ok=True)
        files: list[str] = []
        with progress.stage("write the maps") as report:
            for k, frame in enumerate(frames):
                files += self.written(frame, plates, part_of(report, k, len(frames)))
        data = self.data_of(frames, plates)
        writer = _Writer(self, frames, plates, data, {"maps_px": _worst(data)}, {}, [])
        files += writer.files(progress)
        for note in writer.notes:
            warn(f"not written: {note}")
        data |= {"files": files, "not_written": writer.notes, "left": writer.left, "projections": writer.fits}
        return self.answer(data, lambda: _text(self, files, writer))

    @property
    def start(self) -> Path:
        """The start of the maps' names."""
        return self.out / "shot"

    def jobs(self, frame: TracedFrame) -> list[tuple[str, str, Maker]]:
        """The maps of `stmap`, light as a grey picture with alpha, which all programs multiply by, and NVIDIA's."""
        import numpy as np

        from neurolens.handover.usd import enter_map, exit_map
        from neurolens.render.stmap import illumination_map

        def light(*given: Any) -> dict[str, Any]:
            grey = illumination_map(*given)["Y"]
            return {**dict.fromkeys("RGB", grey), "A": np.ones_like(grey)}

        return [
            *super().jobs(frame)[:-1],
            ("illumination", "", light),
            ("enter", "", enter_map),
            ("exit", "", exit_map),
        ]


@dataclass(frozen=True)
class _Writer:
    """Writes what a shot has besides its maps.

    Attributes:
        data: the figures of its maps. left: the worst that each standard leaves, of all frames; what is None is not
            written. fits: by kind of projection. notes: what is not written, and why.
    """

    command: Handover
    frames: list[TracedFrame]
    plates: Plates
    data: dict[str, Any]
    left: dict[str, Any]
    fits: dict[str, dict[str, Any]]
    notes: list[str]

    @cached_property
    def handed(self) -> Handed:
        """The shot as the templates read it."""
        from neurolens.handover.shot import Handed, Pinhole
        from neurolens.render.pictures import standard_attributes

        first, rate = self.frames[0], self.command.fps
        known = standard_attributes(first.camera.settings)
        pinholes = tuple(Pinhole.of(f.number, f.fields[""], f.camera.settings, f.focus_m) for f in self.frames)
        return Handed(
            str(known.get("lensModel") or first.camera.name), str(known.get("lensMake") or ""), __version__,
            (rate.numerator, rate.denominator), pinholes, self.plates, tuple(name for name in first.fields if name),
        )  # fmt: skip

    def files(self, progress: Progress) -> list[str]:
        """Write all; their names."""
        names = []
        with progress.stage("fit projections, OpenTrackIO") as report:
            for k in range(len(self.frames)):
                names += self._of_frame(k)
                report((k + 1) / len(self.frames))
        values = self._values(self._entries(progress))
        for name in ("shot.usda", "shot.nk", "shot.blender.py", "shot.lensfun.xml", "README.md"):
            template = "md" if name == "README.md" else name.removeprefix("shot.")
            if template != "lensfun.xml" or values["entries"]:
                atomic_write_text(self.command.out / name, html(f"handover.{template}.jinja", **values))
                names.append(str(self.command.out / name))
        return names

    def _of_frame(self, k: int) -> list[str]:
        """Write the sample of OpenTrackIO and the projections of a frame; their names."""
        from neurolens.handover.opentrackio import sample
        from neurolens.render.pictures import standard_attributes

        command, pinhole, field = self.command, self.handed.frames[k], self.frames[k].fields[""]
        out = command.out
        told, left = sample(field, pinhole, self.handed, standard_attributes(self.frames[k].camera.settings))
        write_json(path := out / f"shot.opentrackio{pinhole.name}.json", plain(told))
        self._worse("opentrackio_px", left["distortion_px"])
        self._worse("light_share", left["light_share"])
        names = [str(path)]
        for kind in _KINDS:
            try:
                fitted, _, data = fitted_to(
                    kind, field, self.plates.picture, self.command.film, str(self.command.camera)
                )
            except InputError as error:
                note = f"shot.{kind}: got {error.value}, expected {error.expected}"
                self.notes += [note] if note not in self.notes else []
                continue
            names += write_projection(out / f"shot.{kind}{pinhole.name}", fitted, data)
            row = {"worst_px": data["worst_px"], "rms_px": data["rms_px"], "turns": data["turns_back_at_deg"]}
            if row["worst_px"] >= self.fits.get(kind, row)["worst_px"]:
                self.fits[kind] = row | {"nvidia": kind == "f-theta"}
        return names

    def _worse(self, name: str, value: float | None) -> None:
        if value is not None:
            self.left[name] = max(value, self.left.get(name) or 0.0)

    def _entries(self, progress: Progress) -> list[Entry]:
        """The entries of lensfun's profile, by focal length; none of a lens with cylinders."""
        from neurolens.handover.lensfun import MOST_FRAMES, entry_of

        command, by_focal = self.command, {f"{p.focal_mm:.5g}": k for k, p in enumerate(self.handed.frames)}
        if self.handed.frames[0].squeeze != 1:
            self.notes.append("shot.lensfun.xml: lensfun knows no anamorphic lens")
            return []
        chosen = sorted(by_focal.values(), key=lambda k: self.handed.frames[k].focal_mm)
        step = max(1, math.ceil((len(chosen) - 1) / (MOST_FRAMES - 1)))
        chosen = sorted({*chosen[::step], chosen[-1]}, key=lambda k: self.handed.frames[k].focal_mm)
        states, found = command.states(), []
        with progress.stage("fit lensfun's profile") as report:
            for k in chosen:
                frame, state = self.frames[k], states[k][1]
                entry = entry_of(
                    frame.fields[""], frame.camera, frame.focus_m, self.plates.picture, command.film,
                    (command.wavelengths[0], command.wavelengths[2]),
                    lambda f, state=state: command.make(replace(state, f_number=f), progress)[0],
                    found[0].model if found else None,
                )  # fmt: skip
                found.append(entry)
                self._worse("lensfun_px", entry.distortion_px)
                self._worse("colour_px", entry.colour_px)
                self._worse("lensfun_share", entry.light_share)
                report(len(found) / len(chosen))
        return found

    def _values(self, entries: list[Entry]) -> dict[str, Any]:
        """What the templates of the texts are filled with."""
        from neurolens.handover import lensfun, usd

        shot, command = self.handed, self.command
        width, height = command.film
        folder = [f"@./shot.{kind}{p.name}.exr@" for kind in ("enter", "exit") for p in shot.frames]
        rows = [
            vars(p) | {
                "focus_cm": 100 * p.focus_m - p.pupil_mm / 10, "place": f"(0, 0, {-p.pupil_mm / 10})",
                "behind_m": -p.pupil_mm / 1000, "before_m": p.focus_m - p.pupil_mm / 1000,
                "enter": folder[k], "exit": folder[k + len(shot.frames)],
            }
            for k, p in enumerate(shot.frames)
        ]  # fmt: skip
        exits = usd.exit_map(self.frames[0].fields[""], self.plates)
        self.left["exit_px"] = usd.exit_residual_px(self.frames[0].fields[""], self.plates, exits)
        first = self.data["frames"][0]
        return {
            "shot": shot,
            "rows": rows,
            "curves": {
                key: _curve(shot, [row[key] for row in rows]) for key in ("behind_m", "focal_mm", "before_m", "f_stop")
            },
            "about": f"{shot.lens} ({command.camera}), neurolens {__version__}",
            "projection": command.projection,
            "parallax": [(f"{p['distance_m']:.3g}", p["px"]) for p in first["parallax"]],
            "left": {"opentrackio_px": None, **self.left},
            "fits": self.fits,
            "notes": self.notes,
            "entries": entries,
            "crop": lensfun.FULL_FRAME_MM / (math.hypot(width, height) / 2),
            "aspect": max(width, height) / min(width, height),
            "type": lensfun.TYPES[command.projection],
            "maker": shot.designer or "neurolens",
        }


def _worst(data: dict[str, Any]) -> float:
    return max(row["there_and_back_px"] for row in data["frames"])


def _curve(shot: Handed, values: list[float]) -> str:
    """Values by frame as Nuke has them."""
    if not shot.animated:
        return repr(values[0])
    keys = " ".join(f"x{p.number} {value!r}" for p, value in zip(shot.frames, values, strict=True))
    return "{curve " + keys + "}"


def _rate(text: str) -> Fraction:
    """Type of --fps."""
    with suppress(ValueError, ZeroDivisionError):
        if len(text) < 20 and 1 <= (rate := Fraction(text)) <= 1000:
            return rate.limit_denominator(1001)
    raise argparse.ArgumentTypeError(f"got {text!r}, expected frames a second from 1 to 1000, as 24 or 24000/1001")


def _text(command: Handover, files: list[str], writer: _Writer) -> str:
    left, first = writer.left, writer.handed.frames[0]
    (width, height), (wide, high) = writer.plates.picture, writer.plates.undistorted
    names = {"ST maps, there and back": "maps_px", "NVIDIA's lookup pictures": "exit_px"}
    names |= {"OpenTrackIO": "opentrackio_px", "lensfun": "lensfun_px", "lensfun, colours": "colour_px"}
    rows = [(name, f"{left[key]:.2g}") for name, key in names.items() if key in left]
    rows += [(kind, f"{fit['worst_px']:.2g}") for kind, fit in writer.fits.items()]
    lines = [
        f"{command.camera}: {len(files)} files in {command.out}, see README.md there",
        f"picture {width} x {height}, undistorted {wide} x {high} pixels, focal length {number(first.focal_mm, 6)} mm, "
        f"pupil {number(first.pupil_mm, 6)} mm before the film" + (" (first frame)" if len(writer.frames) > 1 else ""),
        table(("left at most", "pixels"), rows),
    ]
    return "\n".join(lines)
