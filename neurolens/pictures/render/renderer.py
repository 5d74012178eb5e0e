"""The render of a scene through a camera, whole or in tiles, with workers, progress, previews and checkpoints.

A tile is a band of whole rows. It is an OpenEXR file whose data window is the band and whose display window is the
picture, so that other programs show it in its place. Its metadata say what it was rendered from and how; tiles of
different settings do not go together. Put together, tiles are the picture that one run gives, bit for bit.
"""

from __future__ import annotations

import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.files import check_writable
from neurolens.base.report import PART
from neurolens.base.tasks import Failed, Forked, Here, run_each
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.pictures.render.colour import COLOUR_SPACES, SRGB, check_name, conversion, converted
from neurolens.pictures.render.film import (
    DROPPED,
    PASSED,
    PixelGrid,
    check_memory,
    difference,
    read_checkpoint,
    write_checkpoint,
)
from neurolens.pictures.render.job import Job, Layers, develop, identity
from neurolens.pictures.render.pictures import (
    COLOURS,
    read_channels,
    read_metadata,
    standard_attributes,
    write_channels,
    write_png,
)
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import FilmSettings

Progress = Callable[[float, float | None], None]
_FORKS = sys.platform.startswith("linux")
# Previews and checkpoints wait this many times as long as the last one took, and so cost a twentieth of one core at
# most.
_REST = 20.0
_MOST_SAMPLES = 1 << 20
_EXPECTED = 'a tile of "neurolens render --tile"'
_BYTES_A_PIXEL = 50  # of a merge: seven channels, those of the tile being read, and what the writer packs
# What a merged picture's statistics add up, each at most `_MOST`. The rest follows, or is the same in all tiles.
_MOST = 1e15
_SUMMED = ("seconds", "paths", "dropped_samples", "thread_seconds", "camera_thread_seconds")


@dataclass(frozen=True)
class Watch:
    """Previews, checkpoints and early end of a long render.

    Attributes:
        preview: called with the picture so far, [H, W, 3] linear sRGB, at most every `preview_s` seconds.
        checkpoint: file in which the render is kept every `checkpoint_s` seconds, when it is stopped and when it fails.
            Where the file exists, the render goes on from it. It stays until the caller removes it, who then has the
            picture.
        restart: whether to ignore an existing checkpoint.
        keep: whether to write the checkpoint of a complete render, too, to add samples later.
        stop: asked often; once it is true, the render ends with the samples so far.
        note: called with a line on failures that do not end the render, such as a preview that could not be written.
    """

    preview: Callable[[FloatArray], None] | None = None
    preview_s: float = 5.0
    checkpoint: Path | None = None
    checkpoint_s: float = 30.0
    restart: bool = False
    keep: bool = False
    stop: Callable[[], bool] = lambda: False
    note: Callable[[str], None] = lambda _: None


class Keeper:
    """Carries out a `Watch` for one job; `resumed` is the share of the work that was done before."""

    def __init__(self, job: Job, watch: Watch, progress: Progress | None) -> None:
        self._job, self._watch, self._progress = job, watch, progress
        self._identity = {**identity(job), "rows": list(job.rows)} if watch.checkpoint is not None else {}
        self._earlier_s, self._written = 0.0, False
        if watch.checkpoint is not None and watch.checkpoint.exists() and not watch.restart:
            spent = read_checkpoint(watch.checkpoint, job.film, self._identity)
            self._earlier_s, self._written = spent["seconds"], True
            job.film.seconds[:] = spent["camera_thread_seconds"], spent["thread_seconds"]
        self.resumed = job.film.fraction
        self._kept = self.resumed if self._written else 0.0
        self._began = time.perf_counter()
        self._first: tuple[float, float] | None = None  # seconds and share of the work when some was done
        self._preview_at = self._began + watch.preview_s
        self._checkpoint_at = self._began + watch.checkpoint_s
        self._failed: set[str] = set()

    @property
    def seconds(self) -> float:
        """Return the seconds spent on the render, earlier runs included."""
        return self._earlier_s + time.perf_counter() - self._began

    def __call__(self) -> bool:
        """Do what is due, and return whether the render is to stop."""
        watch, fraction, now = self._watch, self._job.film.fraction, time.perf_counter()
        if self._progress is not None and fraction > self.resumed:
            self._first = self._first or (now, fraction)
            since, done = self._first if fraction > self._first[1] else (self._began, self.resumed)
            # The first rays of a run also wait for compilers, and foretell nothing.
            self._progress(fraction, (now - since) / (fraction - done) * (1 - fraction) if done else None)
        if (preview := watch.preview) is not None and now >= self._preview_at and fraction:
            self._preview_at = self._try("preview", lambda: preview(develop(self._job)[0]), watch.preview_s)
        if watch.checkpoint is not None and now >= self._checkpoint_at:
            self._checkpoint_at = self._try("checkpoint", self.save, watch.checkpoint_s)
        return watch.stop()

    def save(self) -> None:
        """Write the checkpoint, if one is named and it lacks finished work."""
        fraction = self._job.film.fraction
        if self._watch.checkpoint is None or not fraction:
            return
        if self._kept == fraction and self._watch.checkpoint.exists():
            return  # the disk may lack room for another
        camera, every = (float(s) for s in self._job.film.seconds)
        spent = {"seconds": self.seconds, "camera_thread_seconds": camera, "thread_seconds": every}
        write_checkpoint(self._watch.checkpoint, self._job.film, self._identity, spent)
        self._written, self._kept = True, fraction

    def finish(self) -> None:
        """Keep a render that stopped; a complete one only where `keep` asks for it, or to update a checkpoint."""
        if self._watch.keep or self._written or self._job.film.fraction < 1:
            self._try("checkpoint", self.save)

    def rescue(self, error: NeurolensError) -> NeurolensError:
        """Keep the samples of a failed render; returns the error with the place of the checkpoint."""
        self._try("checkpoint", self.save)
        if not self._written:
            return error
        return NeurolensError(f"{error}; what was done is kept in {self._watch.checkpoint}: the same command resumes")

    def _try(self, what: str, act: Callable[[], None], pause_s: float = 0.0) -> float:
        """Do an optional action and return the time of the next one; the first failure of each kind is reported."""
        began = time.perf_counter()
        try:
            act()
        except (OSError, NeurolensError, MemoryError) as error:
            if what not in self._failed:
                self._failed.add(what)
                place = getattr(error, "filename", None)
                said = getattr(error, "strerror", None) or str(error) or type(error).__name__
                self._watch.note(f"{what} not written: {f'{place}: ' if place else ''}{said}")
        done = time.perf_counter()
        return done + max(pause_s, _REST * (done - began))


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """What a render took, or that of some rows. Seconds and samples include those before a checkpoint.

    Attributes:
        samples_done: mean of a pixel. dropped_samples: were not finite, and count as black.
        settings: those that decide the picture, its width and height among them.
        wavelengths: how a path takes them. passed_fraction: of the camera rays.
        thread_seconds: summed over the workers. camera_thread_seconds, camera_fraction: of these, in the camera.
    """

    scene: str
    threads: int
    camera: str
    samples: int
    samples_done: float
    complete: bool
    settings: dict[str, Any] = field(metadata=PART)
    wavelengths: str
    wavelengths_nm: tuple[float, float]
    seconds: float
    paths: int
    mpaths_per_s: float
    passed_fraction: float
    dropped_samples: int
    thread_seconds: float
    camera_thread_seconds: float
    camera_fraction: float


@dataclass(frozen=True)
class RenderResult:
    """A picture and how it was made.

    Attributes:
        rgb: [H, W, 3] float32 linear sRGB; a uniform environment of radiance 1 gives 1 on the axis.
        layers: additional channels.
        identity: what pictures of the same settings have in common, to tell whether rows belong together; only of a
            part of a picture.
        behind: pictures of what is behind the first thing on each ray, behind the first two, and so on.
        save: writes the checkpoint of the watch, for use if the picture cannot be written; raises OSError or
            NeurolensError. None where the watch names no checkpoint.
    """

    rgb: FloatArray
    stats: Statistics
    layers: Layers
    identity: dict[str, Any] | None = None
    save: Callable[[], None] | None = None
    behind: tuple[RenderResult, ...] = ()


def render(
    scene: Scene,
    camera: Camera,
    *,
    width: int | None = None,
    height: int | None = None,
    samples: int | None = None,
    seed: int = 0,
    threads: int = 2,
    max_depth: int | None = None,
    film: FilmSettings | None = None,
    rows: tuple[int, int] | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> RenderResult:
    """Path-trace `scene` through `camera`.

    The result depends on the seed, but not on the number of threads, nor on interruptions from which a checkpoint goes
    on: bit for bit, on one machine with one set of packages. All cameras get the same random numbers. Samples are taken
    in the order of the Sobol' sequence, so that more can be added to those of a checkpoint. Memory holds the film's
    sums, picture and layers, at most 164 bytes per pixel, and for each worker what one tile takes, whatever the size of
    the picture.

    Args:
        width, height, samples, max_depth: as in `CameraSettings`; left out, the scene's.
        film: spectral sampling and white balance; left out, the scene's.
        rows: the first row and the one after the last, to render only these. Their pixels are those of the whole
            picture, bit for bit, and statistics are theirs, too.
        threads: how many workers there are.
        progress: called with the fraction done and the estimated seconds left, None for the first rays.
        watch: previews, checkpoints and an early end.

    Raises:
        InputError: a size or count below 1 or beyond memory, an unknown illuminant, picture and film of different
            shape, a camera that disperses and does not cover the scene's wavelengths; a checkpoint that is not whole or
            of another render.
        NeurolensError: a worker failed; what was done is in the checkpoint.
    """
    settings, film = scene.settings.camera, film or scene.settings.film
    if film.white_balance is not None:
        check_name("render", "film.white_balance", film.white_balance, scene.illuminants)
    samples = _count("samples", settings.samples if samples is None else samples, _MOST_SAMPLES)
    max_depth = _count("max_depth", settings.max_depth if max_depth is None else max_depth)
    threads = _count("threads", threads)
    grid = PixelGrid(width or settings.width, height or settings.height, camera.film_mm)
    first, stop = rows or (0, grid.height)
    if not 0 <= first < stop <= grid.height:
        raise InputError("render", "rows", rows, f"two numbers from 0 to {grid.height}, the first below the second")
    check_memory(grid.width, stop - first)
    job = Job(scene, camera, grid, samples, seed, max_depth, film, (first, stop))
    keeper = Keeper(job, watch or Watch(), progress)
    try:
        run(job, min(threads, job.tiling.tiles), None if watch is None and progress is None else keeper)
    except NeurolensError as error:
        raise keeper.rescue(error) from None
    except KeyboardInterrupt:
        keeper.finish()
        raise
    finally:
        seconds = keeper.seconds
    keeper.finish()
    (rgb, layers), took = develop(job), _statistics_of(job, threads, seconds)
    # `keeper` itself would keep the film's sums in memory.
    save = keeper.save if watch is not None and watch.checkpoint is not None else None
    return RenderResult(rgb, took, layers, None if rows is None else identity(job), save)


def _statistics_of(job: Job, threads: int, seconds: float) -> Statistics:
    tiling = job.tiling
    began = tiling.tile * np.arange(tiling.tiles)
    ends = np.minimum(began + tiling.tile, job.own.stop)
    pixels = np.maximum(ends - np.maximum(began, job.own.start), 0)  # of the job's rows
    paths = int(np.sum(pixels * tiling.samples_done(job.film.done)))
    sums = job.film.sums[job.own]
    camera_s, thread_s = (float(s) for s in job.film.seconds)
    return Statistics(
        scene=job.scene.name, threads=threads, camera=job.camera.name, samples=tiling.samples,
        samples_done=paths / len(sums), complete=job.film.fraction == 1, settings=job.picture_settings(),
        wavelengths=job.mode, wavelengths_nm=(job.spectral.low_nm, job.spectral.high_nm), seconds=seconds, paths=paths,
        mpaths_per_s=paths / seconds * 1e-6, passed_fraction=float(sums[:, PASSED].sum()) / max(paths, 1),
        dropped_samples=int(sums[:, DROPPED].sum()), thread_seconds=thread_s, camera_thread_seconds=camera_s,
        camera_fraction=camera_s / max(thread_s, 1e-12),
    )  # fmt: skip


def _count(field: str, value: int, most: float = math.inf) -> int:
    if not 1 <= value <= most:
        at_most = f", at most {most}" if most < math.inf else ""
        raise InputError("render", field, value, f"an integer above 0{at_most}")
    return value


def run(job: Job, workers: int, watch: Callable[[], bool] | None = None) -> None:
    """Render what the job's film lacks; `watch` is polled, and True ends the work early, between tiles.

    Workers are forked processes: numpy's short operations leave no time for threads to share the interpreter (two
    threads were slower than one at 8k-element batches, two processes twice as fast). Where the system does not fork,
    threads do the work; without `watch` a single worker is this process itself.

    Raises:
        NeurolensError: a worker failed or was killed; whole tiles are on the film.
    """
    job.ready()
    forks = _FORKS and not multiprocessing.current_process().daemon  # a worker of Dask, for one, may have no children
    alone = workers == 1 and watch is None
    with Here() if alone else Forked(job.render_tile, workers) if forks else ThreadPoolExecutor(workers) as executor:
        for tile, answer in run_each(executor, job.render_tile, iter(job.film.take, None), stop=watch):
            if isinstance(answer, Failed):
                raise NeurolensError(answer.reason)
            sums, spill, seconds = answer
            job.film.add(*tile, sums, spill, seconds)


def rows_of(height: int, tile: tuple[int, int]) -> tuple[int, int]:
    """Return the first row of tile I of N, and the one after its last. Raises InputError: more tiles than rows."""
    number, count = tile
    if count > height:
        raise InputError("neurolens render", "--tile", f"{number}/{count}", f"at most {height} tiles, one a row")
    return (number - 1) * height // count, number * height // count


def tile_path(out: Path, tile: tuple[int, int] | None) -> Path:
    """Return the file of a tile of the picture `out`, OUT.tile-03-of-16.exr; without a tile `out` itself."""
    if tile is None:
        return out
    number, count = tile
    return out.with_name(f"{out.stem}.tile-{number:0{len(str(count))}d}-of-{count}{out.suffix}")


def windows(width: int, height: int, rows: Sequence[int]) -> dict[str, tuple[NDArray[np.int32], ...]]:
    """Return header values that place a band of rows in a picture of width x height."""

    def box(first: int, last: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        return np.array([0, first], np.int32), np.array([width - 1, last], np.int32)

    return {"dataWindow": box(rows[0], rows[1] - 1), "displayWindow": box(0, height - 1)}


@dataclass(frozen=True)
class Tile:
    """A tile in a file: tile `number` of `count`; its first row and the one after its last; its metadata."""

    path: Path
    number: int
    count: int
    rows: tuple[int, int]
    metadata: dict[str, Any]

    @property
    def frame(self) -> int | None:
        """The number of its picture in a sequence."""
        return self.metadata["tile"]["frame"]

    def settings(self) -> dict[str, Any]:
        """Return the settings that all tiles of one picture share."""
        metadata, render = self.metadata, self.metadata["render"]
        chosen = {name: render[name] for name in ("width", "height", "samples")}
        stored = {
            "half": metadata["tile"]["half"],
            "colour": metadata["colour"],
            "layers": sorted(metadata.get("layers", ())),
            "sensor": metadata.get("sensor"),
        }
        return {**metadata["tile"]["identity"], **chosen, **stored, "tiles": self.count}

    def channels(self) -> dict[str, FloatArray]:
        """Read its channels [rows, width] by name, R, G and B among them. Raises InputError: it has other rows."""
        found, _ = read_channels(self.path)
        shape = self.rows[1] - self.rows[0], self.metadata["render"]["width"]
        if not found.keys() >= set("RGB") or any(plane.shape != shape for plane in found.values()):
            raise InputError(self.path, "channels", "(other channels or rows than its metadata tell)", _EXPECTED)
        return found


def read_tile(path: Path) -> Tile:
    """Read a tile from its file; the pixels are read later.

    Raises:
        InputError: it is no OpenEXR file, none of ours, or what an interrupted run left.
    """
    metadata = read_metadata(path)
    try:
        facts, render = metadata["tile"], metadata["render"]
        numbers = number, count, width, height = facts["number"], facts["of"], render["width"], render["height"]
        if any(type(n) is not int for n in numbers) or not 1 <= number <= count <= height or width < 1:
            raise ValueError(f"tile {number} of {count}")
        tile = Tile(path, number, count, rows_of(height, (number, count)), metadata)
        if tile.settings()["colour"]["space"] not in COLOUR_SPACES:
            raise ValueError("other metadata")
        if not all(0 <= render[name] <= _MOST for name in (*_SUMMED, "passed_fraction")):
            raise ValueError("other statistics")
        complete, done = bool(render["complete"]), float(render["samples_done"])
        _attributes(metadata, tile.frame)  # tests that they can be written
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(path, "metadata", f"({why})", _EXPECTED) from None
    if not complete:
        raise InputError(path, "samples", done, f"{render['samples']}: it is not done; its command goes on")
    return tile


def check_together(tiles: Sequence[Tile]) -> None:
    """Raise InputError unless these are all the tiles of one picture, each once; it names what is wrong."""
    first = tiles[0]
    for other in tiles[1:]:
        if differs := difference(other.settings(), first.settings()):
            place, there, here = differs
            raise InputError(other.path, place, there, f"{here} as in {first.path}")
    paths: dict[int, Path] = {}
    for tile in tiles:
        if tile.number in paths:
            name = f"{tile.number} of {tile.count}"
            raise InputError(tile.path, "tile", name, f"each tile once: {paths[tile.number]} is that one, too")
        paths[tile.number] = tile.path
    if missing := [number for number in range(1, first.count + 1) if number not in paths]:
        of = "" if first.frame is None else f" of frame {first.frame}"
        shown = ", ".join(map(str, missing[:20])) + (", ..." if len(missing) > 20 else "")
        raise InputError("neurolens render --merge", f"tiles{of}", f"({shown} missing)", f"all {first.count}")


def merged(tiles: Sequence[Tile]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the channels [H, W] of all tiles of a picture, and its metadata, as one run stores them.

    Times are summed over the tiles; the remaining metadata are those of one run.

    Raises:
        InputError: as `check_together`; a picture beyond memory.
    """
    check_together(tiles)
    first, *_ = tiles = sorted(tiles, key=lambda tile: tile.number)
    width, height = first.metadata["render"]["width"], first.metadata["render"]["height"]
    check_memory(width, height, _BYTES_A_PIXEL)
    half = first.metadata["tile"]["half"]
    channels: dict[str, NDArray[Any]] = {}
    for tile in tiles:
        planes = tile.channels()
        if not channels:
            kinds = {name: np.float16 if half and name in COLOURS else np.float32 for name in planes}
            channels = {name: np.empty((height, width), kind) for name, kind in kinds.items()}
        if planes.keys() != channels.keys():
            raise InputError(tile.path, "channels", sorted(planes), f"{sorted(channels)} as in {first.path}")
        for name, plane in planes.items():
            channels[name][slice(*tile.rows)] = plane
    metadata = {
        **{key: value for key, value in first.metadata.items() if key != "tile"},
        "render": _statistics([tile.metadata["render"] for tile in tiles]),
    }
    return channels, metadata


def _statistics(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a picture's statistics from those of its tiles."""
    sums = {name: sum(part[name] for part in parts) for name in _SUMMED}
    passed = sum(round(part["passed_fraction"] * part["paths"]) for part in parts)
    return {
        **{key: value for key, value in parts[0].items() if key != "rows"},
        **sums,
        "mpaths_per_s": sums["paths"] / max(sums["seconds"], 1e-12) * 1e-6,
        "passed_fraction": passed / max(sums["paths"], 1),
        "camera_fraction": sums["camera_thread_seconds"] / max(sums["thread_seconds"], 1e-12),
    }


@dataclass(frozen=True)
class Merged:
    """A picture that was put together from its tiles, with the statistics of its render."""

    file: Path
    preview: Path
    tiles: int
    took: Mapping[str, Any] = field(metadata=PART)


def merge_tiles(paths: Iterable[Path], out: Path, exposure: float = 0.0) -> list[Merged]:
    """Check all tiles, then write their picture, or one for each frame: OUT.0001.exr and so on.

    Raises:
        InputError: as `check_together`; an output is one of the tiles. OSError: an output cannot be written.
    """
    frames: dict[int | None, list[Tile]] = {}
    for path in paths:
        tile = read_tile(path)
        frames.setdefault(tile.frame, []).append(tile)
    digits = max(4, *(len(str(frame)) for frame in frames))
    outs = {}
    for frame, tiles in frames.items():
        check_together(tiles)
        number = "" if frame is None else f".{frame:0{digits}d}"
        outs[frame] = out.with_name(f"{out.stem}{number}{out.suffix}")
        for file in (outs[frame], outs[frame].with_suffix(".png")):
            if any(file.exists() and file.samefile(tile.path) for each in frames.values() for tile in each):
                raise InputError(file, "--output", file.name, "another name: it is one of the tiles")
            check_writable(file)
    return [write_picture(tiles, outs[frame], exposure) for frame, tiles in frames.items()]


def write_picture(tiles: Sequence[Tile], out: Path, exposure: float) -> Merged:
    """Write the picture of all its tiles as one run writes it, and a preview.

    Raises:
        InputError: as `merged`. OSError: it cannot be written.
    """
    channels, metadata = merged(tiles)
    space, render = COLOUR_SPACES[metadata["colour"]["space"]], metadata["render"]
    rgb = np.stack([channels[name].astype(np.float32) for name in COLOURS], axis=-1)
    if space is not SRGB:
        rgb = converted(rgb, conversion(space, SRGB)).astype(np.float32)
    write_channels(out, channels, space, metadata, _attributes(metadata, tiles[0].frame))
    write_png(preview := out.with_suffix(".png"), rgb, exposure)
    return Merged(out, preview, len(tiles), render)


def _attributes(metadata: Mapping[str, Any], frame: int | None) -> dict[str, Any]:
    render = metadata["render"]
    return standard_attributes(metadata["camera"], render["width"], render["height"], frame)
