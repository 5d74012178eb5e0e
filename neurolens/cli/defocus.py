"""`neurolens defocus PLATE.exr --lens LENS`: the picture that a lens takes of a sharp picture with depth; and
`neurolens bokeh LENS --distance 1 -o OUT`: kernels of a lens's blur for compositing programs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from neurolens import __version__
from neurolens.base.errors import note
from neurolens.base.progress import Progress
from neurolens.base.report import Report
from neurolens.base.settings import group, positive, setting, whole
from neurolens.cameras.build import near_of
from neurolens.cameras.field import Frame, frame_of
from neurolens.cameras.sampling import focus_m
from neurolens.cli import arguments as cli
from neurolens.cli.stmap import PictureCommand, channels_nm, whole_pair
from neurolens.pictures.defocus.diffraction import Diffraction
from neurolens.pictures.defocus.kernels import Cell, Grooves, as_picture, as_preview, aspheres, diffracted, kernels_over
from neurolens.pictures.defocus.picture import SAMPLES, check_field, defocus
from neurolens.pictures.defocus.plate import DepthSettings, middle_m, read_plate
from neurolens.pictures.frames import Files
from neurolens.pictures.render.pictures import standard_attributes, write_channels, write_exr, write_png
from neurolens.pictures.render.sensor import about, expose
from neurolens.pictures.render.settings import SensorSettings, diffraction

_MOST = 64  # fields along a side, at most


@dataclass(frozen=True, kw_only=True)
class Defocus(cli.Reporting):
    """Give a sharp picture with depth the blur, distortion and vignetting of a lens, with its widest stop, focused on
    what the middle of the picture shows.

    PLATE.exr is a pinhole's picture: R, G, B and a channel Z with the distance along the axis in metres (0, 1e9
    and more, inf: sky), without motion blur; depth without antialiasing is best. Its pinhole stands where
    `neurolens stmap` says; pictures of `neurolens render --camera pinhole:LENS` need nothing else. A data window
    larger than the display window is overscan, which a lens with barrel distortion needs. What a lens sees behind the
    edges of things is read from layers with a depth of their own (behind.R, behind.G, behind.B, behind.Z in the file,
    or --behind) or from deep files. Without them, what is beside an edge is put there, and the command says which share
    of the light that is."""

    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens render room --camera pinhole:laikin_double_gauss_50 --film 45x25.3125 --width 400 -o plate.exr && \\
      neurolens defocus plate.exr --lens laikin_double_gauss_50 --film 36x20.25 --focus 3.9 -o blurred.exr
  neurolens defocus plate.exr --lens laikin_double_gauss_50 --film 36x20.25 --focus 2 --f-number 2 -o out.exr
  neurolens defocus beauty.exr --depth Depth.Z --lens models/NAME.onnx --film 36x24 --focus 1.2 -o out.exr"""
    kept = "no picture was written; older files of that name are untouched"

    plate: Path = setting(..., "OpenEXR file, sharp, with depth", positional=True, metavar="PLATE.exr")
    lens: str = cli.lens(models=True, cameras=True, metavar="LENS", old=("camera",))
    film: tuple[float, float] = cli.film()
    out: Path = cli.output_path("OUT.exr", "picture to write; the preview is OUT.png")
    behind: tuple[Path, ...] = setting(
        (), "OpenEXR file of what is behind the things of the plate, with depth (repeatable)", metavar="FILE.exr",
        common=True,
    )  # fmt: skip
    depth: str = setting("", "name of the channel with the depth (default: Z, or Depth.Z)", metavar="CHANNEL")
    depth_scale: float | None = setting(None, "metres of a unit of depth (default: 1)", within=(-1e6, 1e6), metavar="M")
    depth_along: Literal["axis", "ray"] = setting(
        "axis", "direction of depth: along the axis, or along each ray (default: axis)"
    )
    depth_from: Literal["auto", "film", "pinhole"] = setting(
        "auto", "where depth begins (default: auto, the film in pictures of neurolens, else the pinhole)"
    )
    samples: int = setting(
        SAMPLES, "samples of a pixel whose blur is uneven, rounded up to a power of two; others take fewer "
        f"(default: {SAMPLES})", within=(8, 512),
    )  # fmt: skip
    no_highlights: bool = setting(False, "do not spread very bright pixels as discs; their blur is then noisy")
    diffraction: bool = diffraction()
    half: bool = setting(False, "16-bit floats in the EXR (default: 32-bit)")
    exposure: float = cli.exposure()
    sensor: SensorSettings = group("sensor (any of these adds what it reads as channels raw)", unset=True)
    seed: int = setting(0, "seed of the sensor's noise, for each frame another (default: 0)", kind=whole(0))
    state: cli.LensState = cli.camera_state(texts={"focus_m": "what the middle of the plate shows, else "})
    threads: int = cli.threads()

    def assumed(self) -> Any:
        """Assume the focus as well."""
        given = self.state.given
        return super().assumed() | ({} if given.focus_m or given.zoom else {"state": ("--focus", self._focus)})

    def _film(self) -> tuple[tuple[float, float], str]:
        """Return the largest film of the plate's shape within the film that the lens covers."""
        return cli.film_like(self.plate, *super()._film())

    def _focus(self) -> tuple[cli.LensState, str]:
        """Return the state, focused on what the middle of the plate shows, or as near to that as the lens can."""
        near_m, said = near_of(self.lens, **self._size()), "what the middle of the plate shows"
        focus_m = float(f"{middle_m(self.plate, self._frame, self._depth()):.3g}")
        if focus_m < near_m:
            focus_m, said = near_m, f"the nearest of the lens; {said} is nearer"
        return self.state.at(focus_m=focus_m), f"{focus_m:g} ({said})"

    def _frame(self) -> Frame:
        """Return the ideal camera of the lens's picture, as it is focused without --focus."""
        film = self.film or self._film()[0]
        return frame_of(cli.camera(self.lens, self.state.shot(film, runtime="onnxruntime"), Progress(quiet=True)))

    def _depth(self) -> DepthSettings:
        """Return how the plate's depth is to be understood."""
        starts = {"auto": None, "film": True, "pinhole": False}
        return DepthSettings(self.depth, self.depth_scale, self.depth_along, starts[self.depth_from])

    def run(self) -> int:
        """Read the plate, blur it, write the picture."""
        files = Files.of(self.out)
        files.spare((self.plate, *self.behind))
        counted = {k: v for k, v in vars(self.sensor).items() if v is not None}
        sensor = SensorSettings(**counted) if counted else None
        if self.depth_scale == 0:
            self.refuse("--depth-scale", 0, "metres of a unit")
        progress = self.progress()
        camera = cli.camera(self.lens, shot := self.state.shot(self.film), progress)
        check_field(camera)
        plate = read_plate(self.plate, self.film, frame_of(camera), self._depth(), self.behind)
        waves = Diffraction.of(camera, plate.size) if self.diffraction else None
        found = defocus(plate, camera, self.samples, self.threads, not self.no_highlights, progress)
        found = found if waves is None else replace(found, rgb=waves(found.rgb))
        answer = Blurred(
            self.plate.name, len(plate.layers), str(files.out), found.highlights, found.filled, found.lost, found.beyond
        )
        metadata: dict[str, Any] = {"version": __version__, "camera": camera.settings, "defocus": vars(answer)}
        metadata["diffraction"] = self.diffraction
        layers = {}
        if sensor is not None:
            layers, metadata["sensor"] = expose(found.rgb, sensor, self.seed), about(sensor, self.seed)
        focus = None if math.isinf(metres := focus_m(camera, shot)) else metres
        attributes = standard_attributes(camera.settings, *plate.size)
        write_exr(
            files.out, found.rgb, half=self.half, metadata=metadata | {"focus_m": focus}, space=plate.space,
            layers=layers, attributes=attributes,
        )  # fmt: skip
        write_png(files.preview, found.rgb, self.exposure)
        return self.answer(answer)


@dataclass(frozen=True)
class Blurred(Report):
    """A picture that a lens took of a plate: its highlights that were spread, and shares of its light.

    Attributes:
        filled, beyond: that the plate did not have, behind the edges of things and outside of it.
        lost: of highlights, that no layer shows.
    """

    plate: str
    layers: int
    file: str
    highlights: int
    filled: float
    lost: float
    beyond: float

    def text(self) -> str:
        """Return a line."""
        said = f"{self.layers} layer{'s' * (self.layers > 1)}, {self.highlights} highlights spread"
        shares = f"{self.filled:.2%} of the light filled in, {self.lost:.2%} lost, {self.beyond:.2%} from beyond"
        return f"{self.file}: {said}, {shares} the plate"


@dataclass(frozen=True, kw_only=True)
class Bokeh(PictureCommand):
    """Write the blur of a lens as kernels for ZDefocus and Bokeh in Nuke or a program of your own: float32 OpenEXR, for
    5 x 3 places of the picture, with the widest stop:

      OUT.0.8m.exr     for things 0.8 m from the film, one kernel a field, in columns and rows as in the picture
      OUT.0.8m.png     the same, each kernel as bright as the others, to be looked at

    Every kernel has its field's cat's eye, coma and colour fringes, in pixels of the picture, and a sum of 1 in each
    channel; all cells have the same odd width, the centroid of green in the middle. The light of each field relative to
    the axis is in the metadata and with --json. --grid 1x1 gives the kernel of the axis alone."""

    epilog = f"""{cli.CAMERAS_HELP}

examples:
  neurolens bokeh laikin_double_gauss_50 --width 1920 --film 36x20.25 --focus 2 --f-number 2 \\
      --distance 0.8 --distance 5 --distance inf -o bokeh
  neurolens bokeh leica_summilux_m_35mm_f1_4_asph_v1 --width 3840 --film 36x24 --focus 0.7 \\
      --distance inf --grid 1x1 --ring-height 5 -o rings
  neurolens bokeh models/NAME.onnx --width 3840 --film 36x24 --focus 1 --distance inf --grid 1x1 -o kernel"""

    out: Path = cli.output_path("OUT", "start of the files' names")
    distance: tuple[float, ...] = setting(
        (), "distance of things from the film in metres, or inf; repeatable (default: inf, or 20 focal lengths "
        "where inf is in focus)",
        kind=positive("a distance in metres", infinite=True), metavar="M", common=True,
    )  # fmt: skip
    grid: tuple[int, int] = setting(
        (5, 3), "columns and rows of places in the picture (default: 5x3)", kind=whole_pair("COLUMNSxROWS", _MOST),
        metavar="CxR", common=True,
    )  # fmt: skip
    wavelengths: tuple[float, float, float] | None = setting(
        None, "one wavelength for red, green and blue each (default: those that make each channel's light)",
        kind=channels_nm, metavar="NM",
    )  # fmt: skip
    ring_height: float = setting(
        0.0, "height of the grooves that grinding leaves on aspheres, which draw onion rings: 1 to 20 nm are plain "
        "(default: 0)", within=(0, 1000), metavar="NM",
    )  # fmt: skip
    diffraction: bool = diffraction()
    ring_spacing: float = setting(0.5, "from groove to groove (default: 0.5 mm)", within=(0.01, 100), metavar="MM")

    def run(self) -> int:
        """Find the kernels of all distances, then write an atlas for each."""
        progress = self.progress()
        camera, shot = self.make(self.state, progress, None)
        check_field(camera)
        near_m = float(f"{20 * float(camera.settings['efl_mm']) / 1000:.3g}")  # it stands in the file's name
        distances = self.distance or (near_m if math.isinf(shot.focus_m) else math.inf,)
        if not self.distance:
            note(f"assumed: --distance {distances[0]:g}")
        grooves = Grooves(self.ring_height, self.ring_spacing) if self.ring_height else None
        if grooves:
            aspheres(camera)
            if self.diffraction:
                self.refuse("--diffraction", "(beside --ring-height)", "one of both")
        with progress.stage("find the kernels") as report:
            found = kernels_over(
                camera, self.picture, tuple(dict.fromkeys(distances)), self.grid, self.wavelengths, grooves, report
            )
        if self.diffraction:
            waves = Diffraction.of(camera, self.picture, self.wavelengths)
            found = [diffracted(camera, self.picture, cells, waves) for cells in found]
        side = max(cell.width_px for cells in found for cell in cells)
        facts: dict[str, Any] = {"version": __version__, "camera": camera.settings, "picture_px": list(self.picture)}
        facts |= {"film_mm": list(self.film), "focus_m": None if math.isinf(shot.focus_m) else shot.focus_m}
        facts |= {"diffraction": self.diffraction} | ({"grooves": vars(grooves)} if grooves else {})
        files, rows = [], []
        for cells in found:
            distance = "inf" if math.isinf(cells[0].distance_m) else f"{cells[0].distance_m:.10g}m"
            path = self.out.with_name(f"{self.out.name}.{distance}.exr")
            picture = as_picture(cells, self.grid[0], side)
            rows += (kernels := [KernelFacts.of(cell) for cell in cells])
            more = {"kernel_px": side, "fields": list(self.grid), "kernels": [vars(kernel) for kernel in kernels]}
            write_channels(path, {c: picture[..., k] for k, c in enumerate("RGB")}, None, facts | more)
            write_png(path.with_suffix(".png"), as_preview(picture, side))
            files.append(str(path))
        return self.answer(Kernels(side, self.grid, rows, files))


@dataclass(frozen=True)
class KernelFacts:
    """What the metadata say of a kernel, and its light by channel over that of an ideal lens on the axis."""

    field: tuple[float, float]
    distance_m: float | None
    place_px: tuple[float, float]
    light: list[float]
    width_px: int

    @classmethod
    def of(cls, cell: Cell) -> KernelFacts:
        """Return the facts of a cell, which is dark where no light reaches it."""
        distance = None if math.isinf(cell.distance_m) else cell.distance_m
        light, width = ([0.0] * 3, 0) if cell.kernel is None else (cell.kernel.energy.tolist(), cell.width_px)
        return cls(cell.field, distance, cell.place_px, light, width)


@dataclass(frozen=True)
class Kernels(Report):
    """Kernels of all distances, in columns and rows (`fields`), one file a distance."""

    kernel_px: int
    fields: tuple[int, int]
    kernels: list[KernelFacts]
    files: list[str]

    def text(self) -> str:
        """Return how wide and how bright the kernels of each file are."""
        columns, rows = self.fields
        lines = [f"{columns} x {rows} kernels a picture, {self.kernel_px} pixels a side each"]
        for k, file in enumerate(self.files):
            cells = self.kernels[k * columns * rows : (k + 1) * columns * rows]
            widths = [c.width_px for c in cells]
            low, high = (cli.number(by(c.light[1] for c in cells), 3) for by in (min, max))
            lines.append(f"{file}: blur {min(widths)} to {max(widths)} pixels wide, light {low} to {high}")
        return "\n".join(lines)
