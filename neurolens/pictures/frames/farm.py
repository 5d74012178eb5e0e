"""Frames cut into tiles, which any executor of `base.tasks` renders, and put together when all tiles are there.

Tiles are kept in a folder until their picture is written. A frame and its files decide their names, so that the next
run takes the tiles that are there.

    with Dask("local:2") as executor:
        render_frames({Path("room.exr"): Frame.of("experiments/scenes/room.toml", "thin")}, executor)
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.cluster import absolute, packed, run_with_files, unpack
from neurolens.base.errors import NeurolensError
from neurolens.base.files import forget_parts, how_to_resume, noted_files
from neurolens.base.progress import Progress
from neurolens.base.tasks import Failed, Shared, run_each
from neurolens.optics.readers.glasses import more_glasses
from neurolens.pictures.frames import Frame, Prepared, flare_choice, prepare, render_frame
from neurolens.pictures.render.film import digest
from neurolens.pictures.render.renderer import Merged, read_tile, tile_path, write_picture

if TYPE_CHECKING:
    from neurolens.pictures.flare.layers import Choice

_PATHS_A_TILE, _MOST_TILES = 1 << 24, 1024  # about 20 s of a core; the most tiles of a picture
_FEW, _PATHS_OF_FEW = 4, 1 << 19  # a small picture has so many tiles, if each has so many paths


@dataclass(frozen=True)
class TileTask:
    """A tile to render.

    Attributes:
        name: for messages. out: the file of its whole picture. choice: the layers of its flare.
    """

    name: str
    frame: Frame
    out: Path
    choice: Choice | None


@dataclass
class _Picture:
    """A picture in the making: its frame, where it is written, its tiles' files, and which tiles are missing."""

    frame: Frame
    out: Path
    tiles: dict[int, Path]
    missing: set[int]


def render_tile(task: TileTask) -> None:
    """Render a tile in one thread and write its EXR alone."""
    render_frame(task.frame, task.out, threads=1, choice=task.choice, preview=False)


def render_frames(
    frames: Mapping[Path, Frame],
    executor: Executor,
    folder: Path | None = None,
    *,
    shown: Sequence[Frame] | None = None,
    restart: bool = False,
    progress: Progress | None = None,
) -> list[Merged]:
    """Render frames by tiles, wherever the executor runs them. Pictures are those of one machine, bit for bit.

    Args:
        frames: of one scene and one camera, by the files of their pictures (.exr); a frame must not be a tile itself.
        folder: where tiles are kept (default: OUT.exr.tiles for the first picture OUT.exr).
        shown: the frames that decide which ghosts become layers of flare, see `flare_choice`; None takes `frames`.
        restart: whether to render tiles that are there again.

    Raises:
        InputError: a scene or a camera has a mistake; this is found before anything is sent. NeurolensError: a tile has
            failed; the other tiles are kept. Lost: the executor has failed.
    """
    out, frame = next(iter(frames.items()))
    progress = progress or Progress(quiet=True)
    folder = Path(os.path.abspath(folder or out.with_name(f"{out.name}.tiles")))
    with noted_files() as files, more_glasses(frame.glass_files):
        prepared = prepare(frame, out, progress)
        choice = flare_choice(shown or list(frames.values()), prepared)
    common = packed(files | {path for path in (frame.scene, frame.camera.file, *frame.glass_files) if path is not None})
    shared = sha256(common).hexdigest(), choice
    todo = dict(_picture(each, out, folder, shared, prepared, restart) for out, each in frames.items())
    folder.mkdir(exist_ok=True)
    pictures, done, count = dict[Path, Merged](), 0, sum(len(picture.tiles) for picture in todo.values())
    tasks = (
        absolute(TileTask(f"{p.out.name}, tile {k} of {n}", replace(p.frame, tile=(k, n)), place, choice))
        for place, p, n in [(place, p, len(p.tiles)) for place, p in todo.items()]
        for k in sorted(p.missing)
    )
    with progress.stage(f"render {prepared.name}: {count} tiles") as report:
        for task, answer in run_each(executor, run_with_files, tasks, render_tile, Shared(common)):
            if isinstance(answer, Failed):
                raise NeurolensError(f"{task.name}: {answer.reason}; {how_to_resume(folder)}")
            unpack(answer, folder)
            picture = todo[task.out]
            picture.missing -= {task.frame.tile[0]} if task.frame.tile else set()
            if not picture.missing:
                pictures[picture.out] = _finish(todo.pop(task.out), prepared)
            done += 1
            report(done / count)
        # Pictures of which all tiles were there.
        pictures |= {picture.out: _finish(picture, prepared) for picture in todo.values()}
    forget_parts(folder, "*.tile-*.exr")
    return [pictures[out] for out in frames]


def _picture(
    frame: Frame, out: Path, folder: Path, shared: Any, prepared: Prepared, restart: bool
) -> tuple[Path, _Picture]:
    """Return the name by which tiles know their picture, and the picture.

    Its cut into tiles depends on the picture alone, so that the next command has the same tiles.
    """
    width, height = prepared.size
    paths = width * height * (frame.samples or prepared.scene.settings.camera.samples)
    few = min(_FEW, math.ceil(paths / _PATHS_OF_FEW))
    count = min(max(math.ceil(paths / _PATHS_A_TILE), few), _MOST_TILES, height)
    place = folder / f"{digest((__version__, out.name, replace(frame, exposure=0.0), shared))}.exr"
    tiles = {k: tile_path(place, (k, count)) for k in range(1, count + 1)}
    return place, _Picture(frame, out, tiles, {k for k, tile in tiles.items() if restart or not tile.is_file()})


def _finish(picture: _Picture, prepared: Prepared) -> Merged:
    """Put a picture together, with paths as they are on this machine, and remove its tiles."""
    tiles = [read_tile(tile) for tile in picture.tiles.values()]
    for tile in tiles:
        tile.metadata["scene"] = str(picture.frame.scene)
        if "model" in tile.metadata["camera"]:
            tile.metadata["camera"]["model"] = prepared.camera.settings["model"]
    written = write_picture(tiles, picture.out, picture.frame.exposure)
    for file in picture.tiles.values():
        file.unlink()
    return written
