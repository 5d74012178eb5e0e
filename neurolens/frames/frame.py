"""A `Frame` holds everything that decides one picture; `prepare` reads the files that it names and checks it.

frame = Frame.of("experiments/scenes/room.toml", "lenses/cooke_triplet_50.toml", f_number=4.0, samples=16)
prepared = prepare(frame, Path("room.exr"))
picture = prepared.render(threads=2).rgb
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neurolens import __version__
from neurolens.base.errors import InputError, warn
from neurolens.base.files import check_writable
from neurolens.base.lensname import Named, resolve
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.contract import Camera
from neurolens.render.film import PixelGrid
from neurolens.render.film_settings import (
    ColourSpaceName,
    FilmSettings,
    WavelengthMode,
    WavelengthSampling,
    size_by_shape,
)
from neurolens.render.illuminants import check_name
from neurolens.render.renderer import RenderResult, Watch, render
from neurolens.render.scene import CameraSettings, Scene, files_named, load_scene, seen_from
from neurolens.render.tiles import rows_of, tile_path

if TYPE_CHECKING:
    from neurolens.lens.apertures import Aperture

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Everything that decides one picture. Values of None leave a setting to the scene file, or to the lens.

    Attributes:
        scene: the scene file. camera: what `base.lensname.resolve` makes of a camera's name.
        film_mm, focus_m, f_number, efl_mm, zoom, field_deg, focus, aperture, film_offset_mm, vignetting: as in
            `cameras.build.Shot`.
        glass_files: catalogues of Zemax, whose glasses come before those that ship.
        position_m, look_at_m: where the camera stands, and a point on its optical axis.
        width, height: in pixels; one of them follows from the other and the film's shape. samples: in each pixel.
        seed: of the random numbers. max_depth: bounces of a path.
        colour_space, white_balance, wavelengths, wavelength_sampling: as in `FilmSettings`.
        half: whether the EXR has 16-bit floats. channels: "all", or "beauty" for colour alone.
        exposure: stops by which the preview is brighter.
        number: of the frame in an animation. tile: I and N, for the I-th of N bands of rows alone.
    """

    scene: Path
    camera: Named
    focus_m: float | None = None
    f_number: float | None = None
    efl_mm: float | None = None
    zoom: str | float | None = None
    field_deg: float | None = None
    focus: Literal["best", "paraxial", "internal"] = "best"
    aperture: Aperture | None = None
    film_offset_mm: float = 0.0
    vignetting: str = "both"
    glass_files: tuple[Path, ...] = ()
    position_m: Vector | None = None
    look_at_m: Vector | None = None
    film_mm: tuple[float, float] | None = None
    width: int | None = None
    height: int | None = None
    samples: int | None = None
    seed: int = 0
    max_depth: int | None = None
    colour_space: ColourSpaceName | None = None
    white_balance: str | None = None
    wavelengths: WavelengthMode | None = None
    wavelength_sampling: WavelengthSampling | None = None
    half: bool = False
    channels: Literal["all", "beauty"] = "all"
    exposure: float = 0.0
    number: int | None = None
    tile: tuple[int, int] | None = None

    @classmethod
    def of(cls, scene: str | Path, camera: str | Path, **settings: Any) -> Frame:
        """A frame of a scene file through a camera, both by name, as in `neurolens render SCENE --camera CAMERA`."""
        return cls(scene=Path(scene), camera=resolve(camera), **settings)

    def glasses(self) -> AbstractContextManager[None]:
        """A block in which the glasses of `glass_files` are known."""
        if not self.glass_files:
            return nullcontext()
        from neurolens.readers.agf import more_glasses

        return more_glasses(self.glass_files)

    def shot(self, settings: CameraSettings, aperture: Aperture | None) -> Shot:
        """The scene's settings of the camera, and its stop's shape, with the changes of the frame."""
        film_mm, light_nm = (settings.film_width_mm, settings.film_height_mm), settings.wavelengths_nm
        clamped = self.f_number is None  # a scene's f-number is clamped to the lens; one of the frame must be possible
        scene = Shot(
            film_mm, settings.focus_m, settings.f_number, aperture=aperture, wavelength_nm=light_nm,
            clamp_f_number=clamped,
        )  # fmt: skip
        changes = {field.name: getattr(self, field.name, None) for field in fields(Shot)}
        return replace(scene, **{name: value for name, value in changes.items() if value is not None})

    def film(self, settings: FilmSettings) -> FilmSettings:
        """The scene's [film] table with the changes of the frame."""
        names = "colour_space", "white_balance", "wavelengths", "wavelength_sampling"
        changes = {name: getattr(self, name) for name in names}
        return replace(settings, **{name: value for name, value in changes.items() if value is not None})

    def size(self, settings: CameraSettings) -> tuple[int, int]:
        """Width and height in pixels."""
        film = self.film_mm or (settings.film_width_mm, settings.film_height_mm)
        width, height = self.width, self.height
        if width is None and height is None:
            if self.film_mm is None:
                return settings.width, settings.height
            width = settings.width
        return size_by_shape(film[0] / film[1], width, height)


@dataclass(frozen=True)
class Files:
    """Files of a picture: the EXR, the PNG beside it, and the temporary checkpoint."""

    out: Path
    preview: Path
    checkpoint: Path

    @classmethod
    def of(cls, out: Path) -> Files:
        """The files of an EXR; refuses names that cannot be written, before anything is rendered.

        Raises:
            InputError: not .exr, or no such folder.
            OSError: a folder that cannot be written, a folder of that name.
        """
        if out.suffix.lower() != ".exr":
            raise InputError(out, "--output", out.suffix or "(no suffix)", ".exr")
        if not out.parent.is_dir():
            raise InputError(out, "--output", str(out.parent), "a folder that exists")
        files = cls(out, out.with_suffix(".png"), out.with_name(f"{out.name}.part"))
        for path in (files.out, files.preview, files.checkpoint):
            check_writable(path)
        return files

    def spare(self, inputs: Iterable[Path]) -> None:
        """Raise InputError if an output is one of `inputs`, such as a texture with the preview's name."""
        for read in inputs:
            for written in (self.out, self.preview, self.checkpoint):
                if written.exists() and read.exists() and written.samefile(read):
                    raise InputError(self.out, "--output", written.name, f"another name: the scene reads {read}")

    def kept(self) -> str:
        """How to resume a render that ended early."""
        if self.checkpoint.exists():
            return f"the same command resumes from {self.checkpoint}"
        return "there is no checkpoint to resume from"


@dataclass(frozen=True)
class Prepared:
    """A frame that is ready to be rendered.

    Attributes:
        scene: with the camera in the frame's place. film: its [film] table with the frame's changes.
        size: width and height of the whole picture in pixels. rows: the first row of the frame's tile and the one after
            its last; None without a tile.
    """

    frame: Frame
    files: Files
    scene: Scene
    film: FilmSettings
    camera: Camera
    size: tuple[int, int]
    rows: tuple[int, int] | None

    @property
    def name(self) -> str:
        """Scene and camera, for messages."""
        return f"{self.scene.name}, {self.camera.name}"

    def render(self, threads: int = 2, progress: Any = None, watch: Watch | None = None) -> RenderResult:
        """Path-trace the frame, without its flare; see `render.renderer.render`."""
        width, height = self.size
        return render(
            self.scene, self.camera, width=width, height=height, samples=self.frame.samples, seed=self.frame.seed,
            threads=threads, max_depth=self.frame.max_depth, film=self.film, rows=self.rows, progress=progress,
            watch=watch,
        )  # fmt: skip

    def metadata(self) -> dict[str, Any]:
        """What the EXR says of the scene and the camera."""
        return {"version": __version__, "scene": str(self.frame.scene), "camera": plain(self.camera.settings)}


def prepare(frame: Frame, out: Path, progress: Progress | None = None) -> Prepared:
    """Read and check everything that a frame needs, before it is rendered to `out` (of a tile: beside it).

    The glasses of `frame.glass_files` must be known already, see `Frame.glasses`.

    Warns:
        NeurolensWarning: what the camera's settings note, as a film larger than the image circle.

    Raises:
        InputError: a mistake in the scene or the camera, an output that cannot be written or is an input.
        OSError: an output that cannot be written.
    """
    files = Files.of(tile_path(out, frame.tile))
    scene = seen_from(load_scene(frame.scene), frame.scene, frame.position_m, frame.look_at_m)
    files.spare(frame.scene.parent / name for name in files_named(scene.settings))
    if frame.white_balance is not None:
        check_name(frame.scene, "--white-balance", frame.white_balance, scene.illuminants)
    settings = scene.settings.camera
    shot, (width, height) = frame.shot(settings, scene.aperture), frame.size(settings)
    PixelGrid(width, height, shot.film_mm)  # checked before the slow make_camera
    rows = None if frame.tile is None else rows_of(height, frame.tile)
    camera = make_camera(str(frame.camera), shot, progress)
    for note in (*camera.settings.get("notes", ()), *_pixel_notes(camera, width)):
        warn(note)
    return Prepared(frame, files, scene, frame.film(scene.settings.film), camera, (width, height), rows)


def _pixel_notes(camera: Camera, width: int) -> list[str]:
    """A sentence on a model whose error is larger than the pixels of a picture so many wide."""
    error = (camera.settings.get("card") or {}).get("errors", {}).get("rms_um") or 0.0
    pixel = 1e3 * camera.film_mm[0] / width
    return [f"the model's RMS error of {error:.3g} um is more than a pixel, {pixel:.3g} um"] if error > pixel else []
