"""The render of a scene through a camera, with workers, progress, previews, checkpoints and an early end.

Workers are forked processes: numpy's short operations leave no time for threads to share the interpreter (two threads
were slower than one at 8k-element batches, two processes twice as fast). Where the system does not fork, threads do the
work.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError, NeurolensError, one_line
from neurolens.base.tasks import held
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.render.colour import check_name
from neurolens.render.film import (
    DROPPED,
    PASSED,
    Film,
    PixelGrid,
    check_memory,
    identity,
    read_checkpoint,
    write_checkpoint,
)
from neurolens.render.job import Job, Layers, develop
from neurolens.render.scene import Scene
from neurolens.render.settings import FilmSettings

Progress = Callable[[float, float], None]
RenderTile = Callable[[int, int], tuple[Any, ...]]  # tile and pass to what `Job.render_tile` returns
_FORKS = sys.platform.startswith("linux")
_POLL_S, _POLL_PARENT_S, _PATIENCE_S = 0.05, 0.5, 5.0
# Previews and checkpoints wait so many times as long as the last one took: they cost a twentieth of one core at most.
_REST = 20.0
_MOST_SAMPLES = 1 << 20
_LONGEST = 600  # characters of an error


@dataclass(frozen=True)
class Watch:
    """Previews, checkpoints and early end of a long render.

    Attributes:
        preview: called with the picture so far, [H, W, 3] linear sRGB, at most every `preview_s` seconds.
        checkpoint: file that the render is kept in every `checkpoint_s` seconds, when it is stopped and when it fails,
            and that it goes on from where it exists. Once written it stays until the caller, who then has the picture,
            removes it.
        restart: ignore an existing checkpoint.
        keep: write the checkpoint of a render that is complete, too, to add samples later.
        stop: polled; True ends the render with the present samples.
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
        self._preview_at = self._began + watch.preview_s
        self._checkpoint_at = self._began + watch.checkpoint_s
        self._failed: set[str] = set()

    @property
    def seconds(self) -> float:
        """Spent on the render, earlier runs included."""
        return self._earlier_s + time.perf_counter() - self._began

    def __call__(self) -> bool:
        """Do what is due; True if the render is to stop."""
        watch, fraction, now = self._watch, self._job.film.fraction, time.perf_counter()
        if self._progress is not None and fraction > self.resumed:
            pace = (now - self._began) / (fraction - self.resumed)
            self._progress(fraction, pace * (1 - fraction))
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
        """Keep a render that stopped; a complete one only to update an older checkpoint."""
        if self._watch.keep or self._written or self._job.film.fraction < 1:
            self._try("checkpoint", self.save)

    def rescue(self, error: NeurolensError) -> NeurolensError:
        """Keep the samples of a failed render; returns the error with the place of the checkpoint."""
        self._try("checkpoint", self.save)
        if not self._written:
            return error
        return NeurolensError(f"{error}; what was done is kept in {self._watch.checkpoint}: the same command resumes")

    def _try(self, what: str, act: Callable[[], None], pause_s: float = 0.0) -> float:
        """Do an optional action and return the time of the next; the first failure of each kind is reported."""
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


@dataclass(frozen=True)
class RenderResult:
    """A picture and how it was made.

    Attributes:
        rgb: [H, W, 3] float32 linear sRGB; a uniform environment of radiance 1 gives 1 on the axis.
        stats: JSON-able; settings, complete, samples_done (mean a pixel), seconds, paths, mpaths_per_s,
            passed_fraction, thread_seconds (summed over the workers), camera_thread_seconds (of these, in the camera),
            camera_fraction (their ratio), dropped_samples (not finite; they count as black). Seconds and dropped
            samples count those before a checkpoint, too.
        layers: additional channels.
        identity: what pictures of the same settings have in common, to tell whether rows belong together; of a part.
        save: writes the watch's checkpoint, for use if the picture cannot be written; raises OSError or
            NeurolensError. None without a watch that names one.
    """

    rgb: FloatArray
    stats: dict[str, Any]
    layers: Layers
    identity: dict[str, Any] | None = None
    save: Callable[[], None] | None = None


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

    The result depends on the seed, not on the number of threads, nor on whether it was interrupted and went on from a
    checkpoint: bit for bit, on one machine with one set of packages. Cameras share all random numbers. Samples are
    taken in the order of the Sobol' sequence, so that more can be added to those that a checkpoint has. Memory: the
    film's sums, picture and layers, 164 bytes per pixel at most, and for each worker what one tile takes, whatever the
    size of the picture.

    Args:
        width, height, samples, max_depth: as in `CameraSettings`; left out, those of the scene.
        film: spectral sampling and white balance; left out, those of the scene.
        rows: the first row and the one after the last, of a part of the picture: its pixels are those of the whole
            one, bit for bit, and the result holds no others. Statistics are of these pixels, too.
        threads: workers.
        progress: called with the fraction done and the estimated seconds left.
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
        idle = watch is None and progress is None
        run(job, min(threads, job.tiling.tiles), None if idle else keeper)
    except NeurolensError as error:
        raise keeper.rescue(error) from None
    except KeyboardInterrupt:
        keeper.finish()
        raise
    finally:
        seconds = keeper.seconds
    keeper.finish()
    rgb, layers = develop(job)
    stats = {"scene": scene.name, "threads": threads, **_stats(job, seconds)}
    # Otherwise the result would keep the film's sums in memory.
    save = keeper.save if watch is not None and watch.checkpoint is not None else None
    return RenderResult(rgb, stats, layers, None if rows is None else identity(job), save)


def _stats(job: Job, seconds: float) -> dict[str, Any]:
    tiling = job.tiling
    began = tiling.tile * np.arange(tiling.tiles)
    ends = np.minimum(began + tiling.tile, job.own.stop)
    pixels = np.maximum(ends - np.maximum(began, job.own.start), 0)  # of the job's rows
    paths = int(np.sum(pixels * tiling.samples_done(job.film.done)))
    sums = job.film.sums[job.own]
    camera_s, thread_s = (float(s) for s in job.film.seconds)
    return {
        "camera": job.camera.name,
        "samples": tiling.samples,
        "samples_done": paths / len(sums),
        "complete": job.film.fraction == 1,
        **job.picture_settings(),
        "wavelengths": job.mode,
        "wavelengths_nm": [job.spectral.low_nm, job.spectral.high_nm],
        "seconds": seconds,
        "paths": paths,
        "mpaths_per_s": paths / seconds * 1e-6,
        "passed_fraction": float(sums[:, PASSED].sum()) / max(paths, 1),
        "dropped_samples": int(sums[:, DROPPED].sum()),
        "thread_seconds": thread_s,
        "camera_thread_seconds": camera_s,
        "camera_fraction": camera_s / max(thread_s, 1e-12),
    }


def _count(field: str, value: int, most: float = math.inf) -> int:
    if not 1 <= value <= most:
        at_most = f", at most {most}" if most < math.inf else ""
        raise InputError("render", field, value, f"an integer above 0{at_most}")
    return value


def run(job: Job, workers: int, watch: Callable[[], bool] | None = None) -> None:
    """Render what the job's film lacks; `watch` is polled, and True ends the work early, between tiles.

    Without `watch` a single worker is this process itself.

    Raises:
        NeurolensError: a worker failed or was killed; whole tiles are on the film.
    """
    if workers == 1 and watch is None:
        _drive(job.film, _renderer(job))
        return
    forks = _FORKS and not multiprocessing.current_process().daemon  # such as a worker of Dask: it may have no children
    with held():  # inherited by forked workers: only this process handles Ctrl-C
        forked = [_Forked(job, k, workers) for k in range(workers)] if forks else []
    renderers: list[RenderTile] = [worker.render for worker in forked]
    renderers = renderers or [_renderer(job) for _ in range(workers)]
    with ThreadPoolExecutor(workers) as threads:
        running = {threads.submit(_drive, job.film, render) for render in renderers}
        try:
            while running and not (watch is not None and watch()):
                ended, running = wait(running, _POLL_S, FIRST_COMPLETED)
                for thread in ended:
                    thread.result()
        finally:
            job.film.stop()
            wait(running, _PATIENCE_S)
            for worker in forked:
                worker.end()


def _drive(film: Film, render: RenderTile) -> None:
    """Have tiles rendered until none is left; of several workers each has a thread here."""
    while (task := film.take()) is not None:
        film.add(*task, *render(*task))


def _renderer(job: Job) -> RenderTile:
    """Renders tiles where it is called; raises NeurolensError with one line."""

    def render(tile: int, part: int) -> tuple[Any, ...]:
        try:
            return job.render_tile(tile, part)
        except Exception as error:
            raise NeurolensError(_reason(error)) from error

    return render


class _Forked:
    """A forked worker, which renders the tiles that it is asked for one after another."""

    def __init__(self, job: Job, number: int, workers: int) -> None:
        context: Any = multiprocessing.get_context("fork")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(job, there, number, workers, os.getpid()), daemon=True)
        self._process.start()
        there.close()

    def render(self, tile: int, part: int) -> tuple[Any, ...]:
        """Have a tile rendered.

        Raises:
            NeurolensError: the worker failed, or was killed.
        """
        try:
            self._pipe.send((tile, part))
            answer = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            guess = ": did the memory run out?" if code == -signal.SIGKILL else ""
            why = f" (signal {-code}{guess})" if code < 0 else ""
            raise NeurolensError(f"a render worker was killed{why} before it had finished") from None
        if isinstance(answer, str):
            raise NeurolensError(answer)
        return answer

    def end(self) -> None:
        """Kill it: what it may still render is of no use."""
        self._process.kill()
        self._process.join()


def _serve(job: Job, pipe: Any, number: int, workers: int, parent: int) -> None:
    """The main function of a forked worker."""
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _pin(number, workers)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)  # a forked process must not enter torch's thread pool: it never returns
    try:
        render = _renderer(job)
        while True:
            pipe.send(render(*pipe.recv()))
    except Exception as error:
        pipe.send(_reason(error))


def _end_with(parent: int) -> None:
    """End this worker once its parent is gone, whatever it does: a killed parent can ask nobody to stop."""
    while os.getppid() == parent:
        time.sleep(_POLL_PARENT_S)
    os._exit(1)


def _reason(error: BaseException) -> str:
    """One line for an expected error; for any other with its place in the code."""
    if isinstance(error, NeurolensError):
        return str(error)
    if isinstance(error, MemoryError):
        return f"a render worker ran out of memory ({error or 'no more said'})"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{os.path.basename(frame.filename)}:{frame.lineno}"
    return one_line(f"a render worker failed: {type(error).__name__}: {error}", _LONGEST) + f" ({place})"


def _pin(number: int, workers: int) -> None:
    """Pin a worker to one core if there is a worker for each core; fewer are left to the scheduler."""
    with suppress(AttributeError, OSError):
        cores = sorted(os.sched_getaffinity(0))
        if workers >= len(cores):
            os.sched_setaffinity(0, {cores[number % len(cores)]})
