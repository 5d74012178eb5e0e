"""`neurolens mitsuba SCENE --camera ...`: an unmodified scene of Mitsuba 3 through a neurolens camera."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.base.errors import note
from neurolens.base.progress import duration
from neurolens.base.report import BULK, PART, Report, plain
from neurolens.base.settings import positive, setting, whole
from neurolens.cli import arguments as cli
from neurolens.pictures.frames import Files
from neurolens.pictures.render.pictures import standard_attributes, write_exr, write_png
from neurolens.programs.mitsuba import load_scene, render
from neurolens.programs.mitsuba.sensor import libraries


@dataclass(frozen=True, kw_only=True)
class Mitsuba(cli.Reporting):
    """Render a scene of Mitsuba 3 (.xml, or its own cornell-box) with its integrator and its film, through
    a lens where its camera stands, and write OpenEXR with a PNG preview beside it.
    Needs the extra "mitsuba"; its llvm variants need libLLVM too, scalar ones trace one lens ray at a time."""

    epilog = """\
examples:
  neurolens mitsuba cornell-box --camera laikin_double_gauss_50.ols-36 --film 28x28 --focus 3.6 -o box.exr
  neurolens mitsuba scene.xml --camera thin --f-number 2 --focus 4 --variant llvm_ad_rgb -o thin.exr"""
    kept = "no picture was written; older files of that name are untouched"

    scene: str = setting(..., "scene file (.xml), or cornell-box", positional=True, metavar="SCENE")
    camera: str = cli.lens(models=True, cameras=True, old=("lens",))
    out: Path = cli.output_path("OUT.exr", "picture to write; the preview is OUT.png")
    variant: str | None = setting(None, "variant of Mitsuba (default: llvm_ad_spectral; scalar_spectral without LLVM)")
    samples: int | None = setting(None, "samples of a pixel (default: the scene's)", within=(1, 1 << 20), common=True)
    film: tuple[float, float] | None = cli.film(
        None, "size in mm (default: the largest of the picture's shape that the lens covers)"
    )
    seed: int = setting(0, "seed of the random numbers (default: 0)", kind=whole(0, 1 << 15))
    units_per_m: float = setting(
        1.0, "units of the scene that make a metre (default: 1; 1000 for a scene in millimetres)",
        option="units-per-m", metavar="N",
        kind=positive("scene units in a metre"),
    )  # fmt: skip
    exposure: float = cli.exposure()
    state: cli.LensState = cli.camera_state()

    def run(self) -> int:
        """Render, write both pictures, print a summary."""
        preview = Files.of(self.out).preview
        scene = load_scene(self.scene, self.variant)
        width, height = (int(v) for v in scene.sensors()[0].film().size())
        progress = self.progress()
        if (film := self.film) is None:
            film, said = cli.film_shaped(width, height, self.scene, *self._film())
            note(f"assumed: --film {said}")
        camera = cli.camera(self.camera, self.state.shot(film), progress)
        began = time.perf_counter()
        with progress.stage(f"render {self.scene}, {camera.name}") as report:
            picture = render(
                scene, camera, spp=self.samples, seed=self.seed, units_per_m=self.units_per_m, progress=report
            )
        mi, _ = libraries()
        height, width = picture.shape[:2]
        spent, versions = time.perf_counter() - began, (mi.__version__, mi.variant())
        stats = Statistics(self.scene, width, height, self.samples, self.seed, spent, *versions)
        metadata = {"version": __version__, "camera": plain(camera.settings), "render": plain(stats)}
        attributes = standard_attributes(camera.settings, width, height)
        write_exr(self.out, picture, metadata=metadata, attributes=attributes)
        write_png(preview, picture, self.exposure)
        return self.answer(Rendered(self.out, preview, stats, camera.settings, camera.name))


@dataclass(frozen=True)
class Statistics:
    """What was rendered, in how many seconds, and by which version and variant of Mitsuba."""

    scene: str
    width: int
    height: int
    samples: int | None
    seed: int
    seconds: float
    mitsuba: str
    variant: str


@dataclass(frozen=True)
class Rendered(Report):
    """A finished picture, with the settings of its camera."""

    file: Path
    preview: Path
    took: Statistics = field(metadata=PART)
    camera: Mapping[str, Any]
    name: str = field(metadata=BULK)

    def text(self) -> str:
        """Return the size of the picture, its time and its files."""
        size = f"{self.took.width} x {self.took.height} in {duration(self.took.seconds)} ({self.took.variant})"
        return f"{self.took.scene} through {self.name}: {size}\n{self.file}\n{self.preview}"
