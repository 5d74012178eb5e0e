"""Pictures of whole shots with their flare and their files. `pictures.frames.farm` renders them in tiles.

A `Frame` holds everything that decides one picture; `render_frame` renders it and writes its files::

    frame = Frame.of("experiments/scenes/room.toml", "lenses/cooke_triplet_50.toml", f_number=4.0, samples=16)
    render_frame(frame, Path("room.exr"))

`prepare` only reads and checks the files that a frame names, for a picture in memory::

    picture = prepare(frame, Path("room.exr")).render(threads=2).rgb
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, reason, warn
from neurolens.base.files import check_writable
from neurolens.base.lensname import Named, resolve
from neurolens.base.progress import Progress
from neurolens.base.report import plain
from neurolens.base.settings import setting, setting_of, whole, with_changes
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.optics.lens.shot import Shot, film_size
from neurolens.optics.readers.glasses import more_glasses
from neurolens.pictures.defocus.diffraction import Diffraction
from neurolens.pictures.render.behind import Behind
from neurolens.pictures.render.colour import (
    ACESCG,
    COLOUR_SPACES,
    SRGB,
    ColourSpace,
    check_name,
    conversion,
    converted,
    in_gamut,
)
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.job import MEANING
from neurolens.pictures.render.pictures import standard_attributes, write_exr, write_png
from neurolens.pictures.render.renderer import RenderResult, Watch, render, rows_of, tile_path, windows
from neurolens.pictures.render.scene import CameraSettings, Scene, files_named, load_scene, seen_from
from neurolens.pictures.render.sensor import about, expose
from neurolens.pictures.render.settings import LAYERS, FilmSettings, SensorSettings, diffraction, size_by_shape
from neurolens.pictures.render.world import shared_worlds

if TYPE_CHECKING:
    from neurolens.cameras.pose import FilmPose
    from neurolens.optics.lens.apertures import Aperture
    from neurolens.optics.lens.prescription import Lens
    from neurolens.pictures.flare.canvas import Raster
    from neurolens.pictures.flare.layers import Choice

Vector = tuple[float, float, float]
Layers = dict[str, FloatArray]
_CHOICE_FRAMES = 16  # frames of an animation that decide the brightest ghosts
_PALER = 1e-3  # a share of the light that may lie below zero without a warning


@dataclass(frozen=True, kw_only=True)
class Picture:
    """The settings of a picture that are options of commands. None leaves a setting to the scene."""

    samples: int | None = setting_of(CameraSettings, "samples")
    width: int | None = setting_of(CameraSettings, "width")
    height: int | None = setting_of(CameraSettings, "height")
    film_mm: tuple[float, float] | None = setting(
        None, "width and height of the film in mm (default: the scene's)", option="film", kind=film_size, metavar="WxH",
        common=True,
    )  # fmt: skip
    seed: int = setting(0, "seed of the random numbers (default: 0)", kind=whole(0))
    max_depth: int | None = setting_of(CameraSettings, "max_depth")
    half: bool = setting(False, "16-bit floats in the EXR (default: 32-bit)")
    exposure: float = setting(
        0.0, "stops by which the preview OUT.png is brighter; OUT.exr keeps the light as it is (default: 0)",
        within=(-40, 40), unit="stops", metavar="STOPS",
    )  # fmt: skip
    channels: Literal["all", "beauty"] = setting(
        "all", "channels of the EXR: beauty is colour alone; all adds samples, variance (of the pixel's luminance), "
        "Z (depth in m along the axis from the film) and blocked (share of camera rays that do not pass) "
        "(default: all)", old=("layers",),
    )  # fmt: skip
    behind: int = setting(
        0, "add so many layers of what stands behind the first things that a pinhole sees, as channels behind1.R and "
        "so on, for the blur of neurolens defocus; each takes as long as the picture (default: 0)", within=(0, 8),
    )  # fmt: skip
    diffraction: bool = diffraction()


@dataclass(frozen=True, kw_only=True)
class Frame(Picture):
    """Everything that decides one picture. A value of None leaves the setting to the scene file, or to the lens.

    Attributes:
        scene: the scene file. camera: what `base.lensname.resolve` makes of a camera's name.
        shot: settings of the camera; its film is `film_mm`.
        glass_files: Zemax's catalogues, whose glasses come before those that ship.
        position_m, look_at_m: where the camera stands, and a point on its optical axis.
        colour: changes of the scene's [film] table by key, such as {"white_balance": "A"}.
        sensor: changes of the scene's [sensor] table; with any of them the picture has the sensor's channels.
        number: the frame's in an animation. tile: I and N, to render only the I-th of N bands of rows.
    """

    scene: Path
    camera: Named
    shot: Shot = Shot.part()
    glass_files: tuple[Path, ...] = ()
    position_m: Vector | None = None
    look_at_m: Vector | None = None
    colour: FilmSettings | Mapping[str, Any] | None = None
    sensor: SensorSettings | None = None
    number: int | None = None
    tile: tuple[int, int] | None = None

    @classmethod
    def of(cls, scene: str | Path, camera: str | Path, **settings: Any) -> Frame:
        """Return the frame of a scene file through a camera, both by name, as `neurolens render SCENE --camera CAMERA`
        has it; `settings` as of `at`."""
        return cls(scene=Path(scene), camera=resolve(camera)).at(**settings)

    def at(self, **settings: Any) -> Frame:
        """Return the frame with other settings, of its own or of its shot, by name."""
        of_shot = {name: settings.pop(name) for name in settings.keys() & vars(self.shot).keys() - vars(self).keys()}
        return replace(self, shot=replace(settings.pop("shot", self.shot), **of_shot), **settings)

    def whole_shot(self, settings: CameraSettings, aperture: Aperture | None) -> Shot:
        """Return the scene's settings of the camera, with this stop's shape and the frame's changes."""
        # A scene's f-number is clamped to the lens's; that of the frame must be possible.
        scenes = replace(settings.shot(aperture), clamp_f_number=self.shot.f_number is None)
        return with_changes(with_changes(scenes, self.shot), {"film_mm": self.film_mm})

    def reads(self, settings: SensorSettings | None) -> SensorSettings | None:
        """Return the scene's [sensor] table with the frame's changes; None: no sensor."""
        asked = self.sensor is not None and set(vars(self.sensor).values()) != {None}
        return with_changes(settings or SensorSettings(), self.sensor) if asked else settings

    def size(self, settings: CameraSettings) -> tuple[int, int]:
        """Return width and height in pixels."""
        film = self.film_mm or settings.film_mm
        width, height = self.width, self.height
        if width is None and height is None:
            if self.film_mm is None:
                return settings.width, settings.height
            width = settings.width
        return size_by_shape(film[0] / film[1], width, height)


@dataclass(frozen=True)
class Files:
    """The files of a picture: the EXR, the PNG beside it, and the temporary checkpoint."""

    out: Path
    preview: Path
    checkpoint: Path

    @classmethod
    def of(cls, out: Path) -> Files:
        """Name the files of an EXR; names that cannot be written are refused before anything is rendered.

        Raises:
            InputError: the suffix is not .exr, or there is no such folder.
            OSError: the folder cannot be written, or a folder has that name.
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
                    raise InputError(self.out, "--output", written.name, f"another name: {read} is read")

    def kept(self) -> str:
        """Say in a sentence how to resume a render that ended early."""
        if self.checkpoint.exists():
            return f"the same command resumes from {self.checkpoint}"
        return "there is no checkpoint to resume from"


@dataclass(frozen=True)
class Prepared:
    """A frame that is ready to be rendered.

    Attributes:
        scene: with the camera in the frame's place. film: its [film] table with the frame's changes.
        sensor: what turns the picture into numbers; None without one. size: width and height of the whole picture in
            pixels.
        rows: the first row of the frame's tile and the one after its last; None without a tile.
        diffraction: of the camera; None without.
    """

    frame: Frame
    files: Files
    scene: Scene
    film: FilmSettings
    sensor: SensorSettings | None
    camera: Camera
    size: tuple[int, int]
    rows: tuple[int, int] | None
    diffraction: Diffraction | None = None

    @property
    def traced(self) -> tuple[int, int] | None:
        """Return the rows that are rendered: those of the tile, and those whose light diffraction sends into it."""
        r, height = self.diffraction.reach_px if self.diffraction else 0, self.size[1]
        return self.rows and (max(self.rows[0] - r, 0), min(self.rows[1] + r, height))

    @property
    def name(self) -> str:
        """Name scene and camera, for messages."""
        return f"{self.scene.name}, {self.camera.name}"

    def render(self, threads: int = 2, progress: Any = None, watch: Watch | None = None) -> RenderResult:
        """Path-trace the frame, without its flare; see `pictures.render.renderer.render`."""
        (width, height), frame = self.size, self.frame

        def taken(camera: Camera, watch: Watch | None) -> RenderResult:
            return render(
                self.scene, camera, width=width, height=height, samples=frame.samples, seed=frame.seed,
                threads=threads, max_depth=frame.max_depth, film=self.film, rows=self.traced, progress=progress,
                watch=watch,
            )  # fmt: skip

        with shared_worlds():
            result = taken(self.camera, watch)
            behind = watch and replace(watch, preview=None, checkpoint=None)
            for k in range(1, frame.behind + 1):
                if result.stats.complete:
                    layer = taken(Behind(self.camera, self.scene, k), behind)
                    if not layer.stats.complete:  # the picture itself is in its checkpoint; its layers begin anew
                        result = replace(result, stats=replace(result.stats, complete=False))
                        if result.save is not None:
                            result.save()
                        break
                    result = replace(result, behind=(*result.behind, layer))
        return result


def prepare(frame: Frame, out: Path, progress: Progress | None = None) -> Prepared:
    """Read and check everything that a frame needs, before it is rendered to `out` (a tile: beside that).

    The glasses of `frame.glass_files` must be known already, see `optics.readers.glasses.more_glasses`.

    Warns:
        NeurolensWarning: what the camera's settings note, such as a film larger than the image circle.

    Raises:
        InputError: the scene or the camera has a mistake; an output cannot be written or is an input.
        OSError: an output that cannot be written.
    """
    files = Files.of(tile_path(out, frame.tile))
    scene = seen_from(load_scene(frame.scene), frame.scene, frame.position_m, frame.look_at_m)
    files.spare(frame.scene.parent / name for name in files_named(scene.settings))
    settings = scene.settings.camera
    shot, (width, height) = frame.whole_shot(settings, scene.aperture), frame.size(settings)
    film, sensor = with_changes(scene.settings.film, frame.colour), frame.reads(scene.settings.sensor)
    if frame.colour is not None and film.white_balance is not None:
        check_name(frame.scene, "--white-balance", film.white_balance, scene.illuminants)
    PixelGrid(width, height, shot.film_mm)  # checks sizes before `make_camera`, which is slow
    rows = None if frame.tile is None else rows_of(height, frame.tile)
    camera = make_camera(str(frame.camera), shot, progress)
    if frame.behind and (camera.settings.get("camera") != "pinhole" or frame.channels != "all"):
        shown = f"(with --camera {frame.camera}, --channels {frame.channels})"
        raise InputError("neurolens render", f"--behind {frame.behind}", shown, "a pinhole, and all channels")
    for note in camera.settings.get("notes", ()):
        warn(note)
    error = (camera.settings.get("card") or {}).get("errors", {}).get("rms_um") or 0.0
    if error > (pixel := 1e3 * camera.film_mm[0] / width):
        warn(f"the model's RMS error of {error:.3g} um is more than a pixel, {pixel:.3g} um")
    waves = Diffraction.of(camera, (width, height)) if frame.diffraction else None
    return Prepared(frame, files, scene, film, sensor, camera, (width, height), rows, waves)


def render_frame(
    frame: Frame,
    out: Path,
    *,
    threads: int = 2,
    choice: Choice | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
    preview: bool = True,
) -> RenderResult:
    """Render a frame with the flare that its scene asks for, and write OUT.exr and OUT.png.

    The bytes of the picture depend on the frame alone, not on the number of threads.

    Args:
        out: the picture; for a tile, the name of the whole picture (see `pictures.render.renderer.tile_path`).
        choice: that of `flare_choice`, which all frames of an animation share; None chooses by this frame.
        watch: previews, checkpoints and an early end. preview: whether OUT.png is written.

    Raises:
        InputError, OSError: as `prepare`. NeurolensError: a worker failed, or the files cannot be written.
    """
    progress = progress or Progress(quiet=True)
    with more_glasses(frame.glass_files):
        prepared = prepare(frame, out, progress)
        flare = flare_of(prepared, choice, threads, progress)
        with progress.stage(f"render {prepared.name}") as report:
            result = prepared.render(threads, report, watch)
        write_pictures(prepared, result, flare, preview)
    return result


def flare_of(prepared: Prepared, choice: Choice | None, threads: int, progress: Progress) -> Layers:
    """Make the layers of flare that a frame's scene asks for, by name, [H, W, 3] linear sRGB each.

    Warns:
        NeurolensWarning: the camera has no flare.
    """
    if prepared.scene.settings.flare is None:
        return {}
    flaring = _flaring(prepared.camera)
    if flaring is None:
        warn(f"no flare: {prepared.camera.name} has no surfaces that reflect, as a lens file has")
        return {}
    from neurolens.pictures.flare.layers import scene_flare

    with _errors_of_table(prepared.frame.scene):
        filmed, balance = (prepared.scene, *flaring), prepared.film.white_balance
        return scene_flare(filmed, _raster(prepared), balance, threads, progress, choice)


def _flaring(camera: Any) -> tuple[Lens, FilmPose] | None:
    """Return the lens of a camera, for its flare, and how its film stands."""
    return (camera.lens, camera.film.pose) if hasattr(camera, "lens") else None


def flare_choice(frames: Sequence[Frame], prepared: Prepared, threads: int = 2) -> Choice | None:
    """Choose the ghosts that become layers of the flare in all frames of an animation.

    At most 16 of the frames, evenly spread, decide which ghosts are brightest. `prepared` is one of the frames, or
    another of the same camera and scene. The choice is None where there is no flare.
    """
    if prepared.scene.settings.flare is None or (first := _flaring(prepared.camera)) is None:
        return None
    from neurolens.pictures.flare.layers import scene_choice

    scene = prepared.scene
    flaring, scenes = {_state(prepared.frame): first}, []
    for frame in frames[:: -(-len(frames) // _CHOICE_FRAMES)]:
        if _state(frame) not in flaring:
            shot = frame.whole_shot(scene.settings.camera, scene.aperture)
            found = _flaring(make_camera(str(frame.camera), replace(shot, runtime="onnxruntime")))
            assert found is not None  # as the first
            flaring[_state(frame)] = found
        scenes.append((seen_from(scene, frame.scene, frame.position_m, frame.look_at_m), *flaring[_state(frame)]))
    with _errors_of_table(prepared.frame.scene):
        return scene_choice(scenes, _raster(prepared), threads, fade=prepared.frame.number is not None)


def _state(frame: Frame) -> tuple[Any, ...]:
    """Return the settings that decide how a lens is set: frames that have them in common share the lens."""
    return tuple(value for name, value in vars(frame.shot).items() if name != "aperture")  # which is one for all


def _raster(prepared: Prepared) -> Raster:
    from neurolens.pictures.flare.canvas import Raster

    return Raster(prepared.camera.film_mm, *prepared.size)


@contextmanager
def _errors_of_table(scene: Path) -> Iterator[None]:
    """Make errors of flare name the scene's table."""
    try:
        yield
    except InputError as error:
        raise InputError(scene, f"[flare]: {error.file}, {error.field}", error.value, error.expected) from None


def write_pictures(
    prepared: Prepared, result: RenderResult, flare: Mapping[str, FloatArray], preview: bool = True
) -> None:
    """Write EXR and PNG; where they cannot be written, write the checkpoint.

    Args:
        flare: layers by name, [H, W, 3] linear sRGB of the whole picture, which are added to it.

    Raises:
        NeurolensError: they cannot be written; it says how to resume.
    """
    frame, files, (width, height) = prepared.frame, prepared.files, prepared.size
    space, camera = COLOUR_SPACES[prepared.film.colour_space], plain(prepared.camera.settings)
    metadata: dict[str, Any] = {
        "version": __version__,
        "scene": str(frame.scene),
        "camera": camera,
        "render": plain(result.stats),
        "colour": space.stated,
        "diffraction": frame.diffraction,
    }
    rows, (began, _) = prepared.rows or (0, height), prepared.traced or (0, height)
    own, layers = slice(rows[0] - began, rows[1] - began), Layers()
    if prepared.diffraction is not None:
        result = replace(result, rgb=prepared.diffraction(result.rgb, began)[own])
    if frame.channels == "all" or not result.stats.complete:
        layers = {name: channel[own] for name, channel in asdict(result.layers).items()}
        metadata["layers"] = dict(MEANING)
    for k, layer in enumerate(result.behind, 1):
        behind = converted(layer.rgb, conversion(SRGB, space)).astype(np.float32)
        layers |= {f"behind{k}.{c}": behind[..., n] for n, c in enumerate("RGB")}
        layers |= {f"behind{k}.A": 1 - layer.layers.blocked, f"behind{k}.Z": layer.layers.depth}
        metadata["layers"][f"behind{k}"] = f"what follows the first {k} things on each ray; premultiplied"
    if (sensor := prepared.sensor) is not None:
        added = (flare[name][slice(*rows)] for name in LAYERS if name in flare)  # flare also covers what stands behind
        layers |= expose(sum(added, start=result.rgb), sensor, frame.seed, rows[0])
        metadata["sensor"] = about(sensor, frame.seed)
    layers |= flare_channels({name: picture[slice(*rows)] for name, picture in flare.items()}, space)
    attributes = standard_attributes(camera, width, height, frame.number)
    if frame.tile is not None:
        number, count = frame.tile
        metadata["tile"] = {"number": number, "of": count, "frame": frame.number, "half": frame.half}
        metadata["tile"]["identity"] = plain(result.identity)
        attributes |= windows(width, height, rows)
    try:
        write_exr(
            files.out, result.rgb, half=frame.half, metadata=metadata, space=space, layers=layers, attributes=attributes
        )
        if preview:
            write_png(files.preview, result.rgb, frame.exposure)
    except (OSError, NeurolensError) as error:
        raise NeurolensError(f"{reason(error)}; {_rescued(files, result)}") from None


def flare_channels(flare: Mapping[str, FloatArray], space: ColourSpace) -> Layers:
    """Return the channels of flare's layers in a colour space; pictures are [H, W, 3] linear sRGB by name.

    No value is negative: colours beyond the space are mixed with grey, see `in_gamut`. Single ghosts sum to all.

    Warns:
        NeurolensWarning: some colours become noticeably paler.
    """
    inside, below, above = dict[str, FloatArray](), 0.0, 0.0
    for name, picture in flare.items():
        colour = picture if space is SRGB else converted(picture, conversion(SRGB, space)).astype(picture.dtype)
        inside[name] = in_gamut(colour, space)
        below, above = below - float(colour.clip(max=0).sum()), above + float(colour.clip(0).sum())
    if below > _PALER * above:
        wider = "" if space is ACESCG else f"; the colour space {ACESCG.name} keeps more of them"
        warn(
            f"flare: colours beyond {space.name} are mixed with grey of their luminance, so that none is negative "
            f"({below / above:.1%} of the light){wider}"
        )
    if parts := [name for name in inside if name not in LAYERS]:
        ghosts, whole = inside["ghosts"], np.sum([inside[name] for name in parts], 0)
        # Parts without light stay so; a sum may be below 0 where colours are not mixed.
        lit = np.abs(whole) > np.finfo(np.float32).tiny
        inside |= {name: inside[name] * np.divide(ghosts, whole, out=np.ones_like(whole), where=lit) for name in parts}
    return {f"{name}.{c}": colour[..., k] for name, colour in inside.items() for k, c in enumerate("RGB")}


def _rescued(files: Files, result: RenderResult) -> str:
    """Save a render whose picture cannot be written; returns how to resume.

    A checkpoint is larger than the picture (64 bytes per pixel), but the disk may be full only for a moment, or the
    picture itself may be refused.
    """
    if result.save is None:
        return "it was rendered without a checkpoint"
    try:
        result.save()
    except (OSError, NeurolensError, MemoryError) as error:
        if files.checkpoint.exists():
            return f"only a part of the render is kept ({reason(error)}): {files.kept()}"
        return f"the render is lost, for the checkpoint cannot be written either ({reason(error)})"
    return f"the render is kept: {files.kept()}"
