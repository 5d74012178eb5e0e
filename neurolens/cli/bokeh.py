"""`neurolens bokeh LENS --distance 1 -o OUT`: kernels of a lens's blur for compositing programs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from neurolens import __version__
from neurolens.base.settings import positive, setting
from neurolens.cli.arguments import CAMERAS_HELP, check_folder, output_path
from neurolens.cli.output import number
from neurolens.cli.stmap import PictureCommand, channels_nm, whole_pair

if TYPE_CHECKING:
    from neurolens.defocus.kernels import Cell

_MOST = 64  # fields along a side


@dataclass(frozen=True, kw_only=True)
class Bokeh(PictureCommand):
    """Write the kernels of a lens's blur, float32 OpenEXR, for ZDefocus and Bokeh in Nuke and for programs of your own:

      OUT.0.8m.exr     for things 0.8 m from the film, one kernel a field, in columns and rows as in the picture
      OUT.0.8m.png     the same, each kernel as bright as the others, to be looked at

    Every kernel has its field's cat's eye, coma and colour fringes, in pixels of the picture, and a sum of 1 in each
    channel. All cells have the same odd width, and the centroid of green is in the middle one of its pixels. How much
    light each field gets relative to the axis, and how far its blur reaches, is in the metadata and with --json.
    For a program that takes one kernel, --grid 1x1 gives the one of the axis."""

    about: ClassVar[str] = "kernels of a lens's blur over field and distance"
    epilog: ClassVar[str] = f"""{CAMERAS_HELP}

examples:
  neurolens bokeh lenses/laikin_double_gauss_50.toml --width 1920 --film 36x20.25 --focus 2 --f-number 2 \\
      --distance 0.8 --distance 5 --distance inf -o bokeh
  neurolens bokeh lenses/leica_summilux_m_35mm_f1_4_asph_v1.toml --width 3840 --film 36x24 --focus 0.7 \\
      --distance inf --grid 1x1 --ring-height 5 -o rings
  neurolens bokeh models/NAME.onnx --width 3840 --film 36x24 --focus 1 --distance inf --grid 1x1 -o kernel"""

    out: Path = output_path("OUT", "start of the files' names")
    distance: tuple[float, ...] = setting(
        ..., "of things from the film in metres, or inf (repeatable)",
        kind=positive("a distance in metres", infinite=True), metavar="M",
    )  # fmt: skip
    grid: tuple[int, int] = setting(
        (5, 3),
        "columns and rows of places in the picture (default: 5x3)",
        kind=whole_pair("COLUMNSxROWS", _MOST),
        metavar="CxR",
    )
    wavelengths: tuple[float, float, float] | None = setting(
        None, "one wavelength for red, green and blue each (default: those that make each channel's light)",
        kind=channels_nm, metavar="NM",
    )  # fmt: skip
    ring_height: float = setting(
        0.0, "height of the grooves that grinding leaves on aspheres, which draw onion rings: 1 to 20 nm are plain "
        "(default: 0)", within=(0, 1000), metavar="NM",
    )  # fmt: skip
    ring_spacing: float = setting(0.5, "from groove to groove (default: 0.5 mm)", within=(0.01, 100), metavar="MM")

    def run(self) -> int:
        """Find the kernels of all distances, then write an atlas for each."""
        check_folder(self.out, "--output")
        if not self.out.name:
            self.refuse("--output", str(self.out), "the start of the files' names")
        from neurolens.defocus.kernels import Grooves, as_picture, as_preview, aspheres, kernels_over
        from neurolens.defocus.picture import check_field
        from neurolens.render.pictures import write_channels, write_png

        progress = self.progress()
        camera, shot = self.make(self.state, progress, compiled=True)
        check_field(camera)
        grooves = Grooves(self.ring_height, self.ring_spacing) if self.ring_height else None
        if grooves:
            aspheres(camera)
        with progress.stage("find the kernels") as report:
            found = kernels_over(
                camera, self.picture, tuple(dict.fromkeys(self.distance)), self.grid, self.wavelengths, grooves, report
            )
        side = max(cell.width_px for cells in found for cell in cells)
        about: dict[str, Any] = {"version": __version__, "camera": camera.settings, "picture_px": list(self.picture)}
        about |= {"film_mm": list(self.film), "focus_m": None if math.isinf(shot.focus_m) else shot.focus_m}
        about |= {"grooves": vars(grooves)} if grooves else {}
        files, rows = [], []
        for cells in found:
            distance = "inf" if math.isinf(cells[0].distance_m) else f"{cells[0].distance_m:.10g}m"
            path = self.out.with_name(f"{self.out.name}.{distance}.exr")
            picture = as_picture(cells, self.grid[0], side)
            rows += (facts := [_facts(cell) for cell in cells])
            more = {"kernel_px": side, "fields": list(self.grid), "kernels": facts}
            write_channels(path, {c: picture[..., k] for k, c in enumerate("RGB")}, None, about | more)
            write_png(path.with_suffix(".png"), as_preview(picture, side))
            files.append(str(path))
        data = {"kernel_px": side, "fields": list(self.grid), "kernels": rows, "files": files}
        return self.answer(data, lambda: _text(data))


def _facts(cell: Cell) -> dict[str, Any]:
    """What the metadata say of a kernel; light beside that of a point on the axis of an ideal lens, of each channel."""
    distance = None if math.isinf(cell.distance_m) else cell.distance_m
    facts: dict[str, Any] = {"field": list(cell.field), "distance_m": distance, "place_px": list(cell.place_px)}
    lit = cell.kernel is not None
    return facts | {"light": cell.kernel.energy.tolist() if lit else [0.0] * 3, "width_px": cell.width_px if lit else 0}  # type: ignore[union-attr]


def _text(data: dict[str, Any]) -> str:
    columns, rows = data["fields"]
    lines = [f"{columns} x {rows} kernels a picture, {data['kernel_px']} pixels a side each"]
    for k, file in enumerate(data["files"]):
        cells = data["kernels"][k * columns * rows : (k + 1) * columns * rows]
        widths, light = ([row[name] for row in cells] for name in ("width_px", "light"))
        low, high = (number(by(v[1] for v in light), 3) for by in (min, max))
        lines.append(f"{file}: blur {min(widths)} to {max(widths)} pixels wide, light {low} to {high}")
    return "\n".join(lines)
