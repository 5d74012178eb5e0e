"""`neurolens render --dask`: tiles as tasks of a cluster, and each frame put together when its tiles are there.

Tiles that came are kept in the folder OUT.exr.tiles until their picture is written, under names that their settings
and inputs decide: the same command takes those that are there.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.engine import Failed, on_dask
from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.files import noted_files
from neurolens.base.progress import Progress
from neurolens.commands.farm import Task, files_of, packed, run_task, unpack
from neurolens.commands.output import answer
from neurolens.commands.render_frames import shots_of

if TYPE_CHECKING:
    from neurolens.commands.render import Prepared

_PATHS_A_TILE, _MOST_TILES = 1 << 24, 1024  # some 20 s of a core
_FEW, _PATHS_OF_FEW = 4, 1 << 19  # tiles of small pictures, if each has so many paths
# What changes no pixel, and what a task does not have.
_NO_MATTER = ("run", "kept", "out", "threads", "quiet", "json", "restart", "dask", "checkpoint_every", "frames", "key")


@dataclass
class _Shot:
    """A picture to render: its arguments, and the files of its tiles; those that are missing yet."""

    args: argparse.Namespace
    tiles: list[Path]
    missing: set[int]


def run_on_dask(
    args: argparse.Namespace,
    prepare: Callable[[argparse.Namespace, Progress], Prepared],
    render: Callable[[argparse.Namespace], None],
) -> int:
    """Render one picture, or one a frame, on a cluster.

    Args:
        prepare: checks the arguments of a picture. render: renders a tile, on a worker.

    Raises:
        InputError: options that a cluster has not; mistakes in scene and camera. NeurolensError: a tile has failed.
    """
    for option, given in (("--tile", args.tile), ("--keep-checkpoint", args.keep_checkpoint or None)):
        if given is not None:
            raise InputError("neurolens render", option, given, "left out beside --dask")
    progress, folder = Progress(quiet=args.quiet), args.out.with_name(f"{args.out.name}.tiles")
    chosen = [argparse.Namespace(**vars(args) | {"key": []})] if args.frames is None else list(shots_of(args))
    if not chosen:
        return 0
    with noted_files() as files:  # mistakes are told before anything is sent
        made = prepare(chosen[0], progress)
    common = packed(files | files_of(args))
    shots = [_shot(each, folder, common, made) for each in chosen]
    args.kept = f"tiles that are done are kept in {folder}: the same command goes on"
    folder.mkdir(exist_ok=True)
    engine = on_dask(args.dask, run_task, common)
    pictures, done, count = [], 0, sum(len(shot.tiles) for shot in shots)
    with progress.stage(f"render {made.scene.name}, {made.camera.name}: {count} tiles") as report:
        waiting: dict[str, _Shot] = {}
        for task, came in engine(_tasks(shots, waiting, render)):
            if isinstance(came, Failed):
                raise NeurolensError(f"{task.name}: {came.reason}; {args.kept}")
            unpack(came, folder)
            shot = waiting.pop(task.name)
            shot.missing.discard(task.args["tile"][0])
            if not shot.missing:
                pictures.append(_finish(shot, made))
            done += 1
            report(done / count)
        pictures += [_finish(shot, made) for shot in shots if shot.tiles]  # whose tiles were all there
    with suppress(OSError):
        for stale in folder.glob("*.tile-*.exr"):
            stale.unlink()
        folder.rmdir()
    return answer(args, {"pictures": pictures}, lambda: "\n".join(str(p["file"]) for p in pictures))


def _shot(args: argparse.Namespace, folder: Path, common: bytes, made: Prepared) -> _Shot:
    """A picture cut into tiles; the cut depends on the picture alone, so that the next command has the same."""
    from neurolens.render.tiles import tile_path

    width, height = made.size
    paths = width * height * (args.samples or made.scene.settings.camera.samples)
    few = min(_FEW, math.ceil(paths / _PATHS_OF_FEW))
    count = min(max(math.ceil(paths / _PATHS_A_TILE), few), _MOST_TILES, height)
    asked = {key: str(value) for key, value in sorted(vars(args).items()) if key not in _NO_MATTER}
    mark = sha256(repr((__version__, asked, sha256(common).hexdigest())).encode()).hexdigest()[:16]
    tiles = [tile_path(folder / f"{mark}.exr", (k, count)) for k in range(1, count + 1)]
    missing = {k for k, tile in enumerate(tiles, 1) if args.restart or not tile.is_file()}
    return _Shot(args, tiles, missing)


def _tasks(
    shots: list[_Shot], waiting: dict[str, _Shot], render: Callable[[argparse.Namespace], None]
) -> Iterator[Task]:
    for shot in shots:
        mark = shot.tiles[0].name.partition(".")[0] if shot.tiles else ""
        for k in sorted(shot.missing):
            args = argparse.Namespace(**vars(shot.args) | {"tile": (k, len(shot.tiles)), "frames": None, "key": []})
            name = f"{shot.args.out.name}, tile {k} of {len(shot.tiles)}"
            waiting[name] = shot
            yield Task.of(name, render, args, shot.tiles[0].with_name(f"{mark}.exr"))


def _finish(shot: _Shot, made: Prepared) -> dict[str, Any]:
    """Put a picture together, with the paths as they are here, and remove its tiles."""
    from neurolens.commands.merge import write_picture
    from neurolens.render.tiles import read_tile

    told = write_picture(
        [read_tile(tile) for tile in shot.tiles], shot.args.out, shot.args.exposure, partial(_local, shot, made)
    )
    for tile in shot.tiles:
        tile.unlink()
    shot.tiles = []
    return told


def _local(shot: _Shot, made: Prepared, told: dict[str, Any]) -> None:
    told["scene"] = str(shot.args.scene)
    if "model" in told["camera"]:
        told["camera"]["model"] = made.camera.settings["model"]
