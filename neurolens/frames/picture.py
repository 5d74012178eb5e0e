"""A frame rendered with its flare, and its files: OpenEXR and a PNG preview::

frame = Frame.of("experiments/scenes/lights.toml", "lenses/cooke_triplet_50.toml", samples=16)
render_frame(frame, Path("lights.exr"))
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError, NeurolensError, warn
from neurolens.base.progress import Progress
from neurolens.base.records import plain
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import FloatArray
from neurolens.frames.frame import Files, Frame, Prepared, prepare
from neurolens.render.colour import COLOUR_SPACES, SRGB, ColourSpace, conversion, converted
from neurolens.render.exr_attributes import standard_attributes
from neurolens.render.job import MEANING
from neurolens.render.renderer import RenderResult, Watch
from neurolens.render.scene import Scene, seen_from
from neurolens.render.tiles import windows

if TYPE_CHECKING:
    from neurolens.flare.canvas import Raster
    from neurolens.flare.layers import Choice
    from neurolens.lens.prescription import Lens

_CHOICE_FRAMES = 16  # of an animation, which decide the brightest lights and ghosts
Layers = dict[str, FloatArray]


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
        out: the picture; of a tile the name of the whole picture, see `render.tiles.tile_path`.
        choice: the lights and ghosts of `flare_choice`, which all frames of an animation share; None: of this frame.
        watch: previews, checkpoints and an early end. preview: whether OUT.png is written.

    Raises:
        InputError, OSError: as `prepare`. NeurolensError: a worker failed, or the files cannot be written.
    """
    progress = progress or Progress(quiet=True)
    with frame.glasses():
        prepared = prepare(frame, out, progress)
        flare = flare_of(prepared, choice, threads, progress)
        with progress.stage(f"render {prepared.name}") as report:
            result = prepared.render(threads, report, watch)
        write_pictures(prepared, result, flare, preview)
    return result


def flare_of(prepared: Prepared, choice: Choice | None, threads: int, progress: Progress) -> Layers:
    """The layers of flare that the scene of a frame asks for, by name, [H, W, 3] linear sRGB each.

    Warns:
        NeurolensWarning: a camera that has no flare.
    """
    if prepared.scene.settings.flare is None:
        return {}
    lens = getattr(prepared.camera, "lens", None)
    if lens is None:
        warn(f"no flare of {prepared.camera.name}: that takes a lens file that is traced as it is")
        return {}
    from neurolens.flare.layers import scene_flare

    with _errors_of_table(prepared.frame.scene):
        return scene_flare(
            prepared.scene, lens, _raster(prepared), prepared.film.white_balance, threads, progress, choice
        )


def flare_choice(frames: Sequence[Frame], prepared: Prepared, threads: int = 2) -> Choice | None:
    """Which lights and ghosts the layers of flare show in all frames of an animation.

    At most 16 of the frames, evenly spread, decide which are brightest. `prepared` is one of the frames, or of the same
    camera and scene. The choice is None where there is no flare.
    """
    if prepared.scene.settings.flare is None or getattr(prepared.camera, "lens", None) is None:
        return None
    from neurolens.flare.layers import scene_choice

    some = frames[:: -(-len(frames) // _CHOICE_FRAMES)]
    with _errors_of_table(prepared.frame.scene):
        return scene_choice(list(_scenes(some, prepared)), _raster(prepared), threads)


def _scenes(frames: Sequence[Frame], prepared: Prepared) -> Iterator[tuple[Scene, Lens]]:
    """The scene and the lens in each of the frames."""

    def state(frame: Frame) -> tuple[Any, ...]:
        return frame.focus_m, frame.f_number, frame.zoom

    lenses: dict[tuple[Any, ...], Lens] = {state(prepared.frame): prepared.camera.lens}  # type: ignore[attr-defined]
    for frame in frames:
        if state(frame) not in lenses:
            shot = frame.shot(prepared.scene.settings.camera, prepared.scene.aperture)
            lenses[state(frame)] = make_camera(str(frame.camera), shot).lens  # type: ignore[attr-defined]
        yield seen_from(prepared.scene, frame.scene, frame.position_m, frame.look_at_m), lenses[state(frame)]


def _raster(prepared: Prepared) -> Raster:
    from neurolens.flare.canvas import Raster

    return Raster(prepared.camera.film_mm, *prepared.size)


@contextmanager
def _errors_of_table(scene: Path) -> Iterator[None]:
    """Errors of flare name the scene's table."""
    try:
        yield
    except InputError as error:
        raise InputError(scene, f"[flare]: {error.file}, {error.field}", error.value, error.expected) from None


def write_pictures(
    prepared: Prepared, result: RenderResult, flare: Mapping[str, FloatArray], preview: bool = True
) -> None:
    """Write EXR and PNG; if they cannot be written, the checkpoint.

    Args:
        flare: layers by name, [H, W, 3] linear sRGB of the whole picture, which are to be added.

    Raises:
        NeurolensError: they cannot be written; with the way to resume.
    """
    from neurolens.render.pictures import write_exr, write_png

    frame, files, (width, height) = prepared.frame, prepared.files, prepared.size
    space, settings = COLOUR_SPACES[prepared.film.colour_space], prepared.metadata()
    metadata = settings | {"render": plain(result.stats), "colour": space.stated}
    layers: Layers = {}
    if frame.channels == "all" or not result.stats["complete"]:
        layers, metadata["layers"] = asdict(result.layers), MEANING
    rows = prepared.rows or (0, height)
    layers |= flare_channels({name: picture[slice(*rows)] for name, picture in flare.items()}, space)
    attributes = standard_attributes(settings["camera"], width, height, frame.number)
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
        raise NeurolensError(f"{_text(error)}; {_rescued(files, result)}") from None


def flare_channels(flare: Mapping[str, FloatArray], space: ColourSpace) -> Layers:
    """The channels of layers of flare in a colour space, of pictures [H, W, 3] linear sRGB by name."""
    channels: Layers = {}
    for name, picture in flare.items():
        colour = picture if space is SRGB else converted(picture, conversion(SRGB, space)).astype(picture.dtype)
        channels |= {f"{name}.{c}": colour[..., k] for k, c in enumerate("RGB")}
    return channels


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
            return f"only a part of the render is kept ({_text(error)}): {files.kept()}"
        return f"the render is lost, for the checkpoint cannot be written either ({_text(error)})"
    return f"the render is kept: {files.kept()}"


def _text(error: BaseException) -> str:
    if not isinstance(error, OSError):
        return str(error) or type(error).__name__
    file = "" if error.filename is None else f"{error.filename}: "
    return f"{file}{error.strerror or error}"
