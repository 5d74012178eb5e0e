"""`neurolens defocus PLATE.exr --lens LENS`: the picture that a lens takes of a sharp picture with depth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from neurolens import __version__
from neurolens.base.errors import warn
from neurolens.base.settings import group, setting, setting_of, whole
from neurolens.cli.arguments import (
    CAMERAS_HELP,
    Glasses,
    LensState,
    Reporting,
    check_folder,
    check_suffix,
    exposure,
    film_size,
    lens,
    lens_state,
    output_path,
)  # fmt: skip
from neurolens.lens.shot import Dispersion, Shot, Vignetting
from neurolens.render.settings import SensorSettings


@dataclass(frozen=True, kw_only=True)
class Defocus(Glasses, Reporting):
    """Give a sharp picture with depth the blur of a lens, by field, depth and colour, with its distortion and
    vignetting.

    PLATE.exr is a pinhole's picture: R, G, B and a channel Z with the distance along the axis in metres (0, 1e9
    and more, inf: sky), sharp, without motion blur; depth without antialiasing is best. Its pinhole stands where
    `neurolens stmap` says: focal length and place are printed there. Pictures of `neurolens render --camera
    pinhole:LENS` need nothing else. A data window larger than the display window is overscan, which a lens with
    barrel distortion needs.

    What a lens sees behind the edges of things is not in one picture. Layers with a depth of their own (behind.R,
    behind.G, behind.B, behind.Z in the file, or the files of --behind) and deep files have it; else what is beside
    an edge is put there, and the share of that light is said.

    Pixels far brighter than their surroundings are spread as clean discs, without noise. A sensor counts the
    finished picture, as in `neurolens render`."""

    about: ClassVar[str] = "the blur of a lens for a sharp picture with depth"
    epilog: ClassVar[str] = f"""{CAMERAS_HELP}

examples:
  neurolens defocus plate.exr --lens lenses/laikin_double_gauss_50.toml --film 36x20.25 --focus 2 \\
      --f-number 2 -o out.exr
  neurolens defocus beauty.exr --depth Depth.Z --lens fused:models/NAME.onnx --film 36x24 --focus 1.2 -o out.exr"""
    kept: ClassVar[str] = "no picture was written; older files of that name are untouched"

    plate: Path = setting(..., "OpenEXR file, sharp, with depth", positional=True, metavar="PLATE.exr")
    lens: str = lens(models=True, cameras=True, metavar="LENS")
    film: tuple[float, float] = setting(..., "size of the film in mm", kind=film_size, metavar="WxH")
    out: Path = output_path("OUT.exr", "picture to write; the preview is OUT.png")
    behind: tuple[Path, ...] = setting(
        (), "OpenEXR file of what is behind the things of the plate, with depth (repeatable)", metavar="FILE.exr"
    )
    depth: str = setting("", "name of the channel with the depth (default: Z, or Depth.Z)", metavar="CHANNEL")
    depth_scale: float | None = setting(None, "metres of a unit of depth (default: 1)", within=(-1e6, 1e6), metavar="M")
    depth_along: Literal["axis", "ray"] = setting("axis", "whether depth is along the axis or each ray (default: axis)")
    depth_from: Literal["auto", "film", "pinhole"] = setting(
        "auto", "where depth begins (default: auto, the film in pictures of neurolens, else the pinhole)"
    )
    samples: int = setting(
        64, "most samples of a pixel, where blur is wide, rounded up to a power of two (default: 64)", within=(8, 512)
    )
    no_highlights: bool = setting(False, "do not spread very bright pixels as discs; their blur is then noisy")
    film_offset_mm: float | None = setting_of(Shot, "film_offset_mm")
    vignetting: Vignetting | None = setting_of(Shot, "vignetting")
    dispersion: Dispersion | None = setting_of(Shot, "dispersion")
    half: bool = setting(False, "16-bit floats in the EXR (default: 32-bit)")
    exposure: float = exposure()
    sensor: SensorSettings = group("sensor (any of these adds what it reads as channels raw)", unset=True)
    seed: int = setting(0, "seed of the sensor's noise, for each frame another (default: 0)", kind=whole(0))
    state: LensState = lens_state()
    threads: int = setting(2, "workers (default: 2)", within=(1, 256))

    def run(self) -> int:
        """Read the plate, blur it, write the picture."""
        check_suffix(self.out, "--output", (".exr",))
        check_folder(self.out, "--output")
        from neurolens.base.lensname import compiled
        from neurolens.cameras.build import make_camera
        from neurolens.cameras.field import frame_of
        from neurolens.defocus.picture import check_field, defocus
        from neurolens.defocus.plate import DepthSettings, read_plate
        from neurolens.render.pictures import standard_attributes, write_exr, write_png
        from neurolens.render.sensor import about, expose

        if self.out.resolve() in {file.resolve() for file in (self.plate, *self.behind)}:
            self.refuse("--output", str(self.out), "another file than those that are read")
        if self.depth_scale == 0:
            self.refuse("--depth-scale", 0, "metres of a unit")
        progress = self.progress()
        given = {k: getattr(self, k) for k in ("film_offset_mm", "vignetting", "dispersion")}
        shot = self.state.shot(self.film, **{k: v for k, v in given.items() if v is not None})
        # Kernels ask for many rays: compiled, unless the argument says how.
        camera = make_camera(compiled(self.lens), shot, progress)
        for note in camera.settings.get("notes", ()):
            warn(note)
        check_field(camera)
        starts = {"auto": None, "film": True, "pinhole": False}
        depth = DepthSettings(self.depth, self.depth_scale, self.depth_along, starts[self.depth_from])
        plate = read_plate(self.plate, self.film, frame_of(camera), depth, self.behind)
        found = defocus(plate, camera, self.samples, self.threads, not self.no_highlights, progress)
        data: dict[str, Any] = {"plate": self.plate.name, "layers": len(plate.layers), "file": str(self.out)}
        data |= {name: getattr(found, name) for name in ("highlights", "filled", "beyond")}
        metadata = {"version": __version__, "camera": camera.settings, "defocus": data}
        layers = {}
        if counted := {k: v for k, v in vars(self.sensor).items() if v is not None}:
            sensor = SensorSettings(**counted)
            layers, metadata["sensor"] = expose(found.rgb, sensor, self.seed), about(sensor, self.seed)
        focus = None if math.isinf(shot.focus_m) else shot.focus_m
        attributes = standard_attributes(camera.settings, *plate.size)
        write_exr(
            self.out, found.rgb, half=self.half, metadata=metadata | {"focus_m": focus}, space=plate.space,
            layers=layers, attributes=attributes,
        )  # fmt: skip
        write_png(self.out.with_suffix(".png"), found.rgb, self.exposure)
        return self.answer(data, lambda: _text(data))


def _text(data: dict[str, Any]) -> str:
    said = (
        f"{data['file']}: {data['layers']} layer{'s' * (data['layers'] > 1)}, {data['highlights']} highlights spread, "
    )
    return said + f"{data['filled']:.2%} of the light filled in, {data['beyond']:.2%} from beyond the plate"
