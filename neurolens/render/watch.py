"""What goes on beside a render: progress, a preview, checkpoints, and the question whether to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neurolens.base.errors import NeurolensError
from neurolens.cameras.contract import FloatArray
from neurolens.render.checkpoint import read_checkpoint, write_checkpoint
from neurolens.render.develop import develop
from neurolens.render.job import Job

Progress = Callable[[float, float], None]
# Previews and checkpoints wait so many times as long as the last one took: they cost a twentieth of one core at most.
_REST = 20.0


def _never() -> bool:
    return False


def _silent(_: str) -> None:
    return None


@dataclass(frozen=True)
class Watch:
    """How a long render is kept safe.

    Attributes:
        preview: called with the picture so far, [H, W, 3] linear sRGB, at most every `preview_s` seconds.
        checkpoint: file that the render is kept in every `checkpoint_s` seconds, when it is stopped and when it fails,
            and that it goes on from where it exists. Once written it stays until the caller, who then has the picture,
            removes it.
        restart: begin again, whatever the checkpoint holds.
        keep: write the checkpoint of a render that is complete, too, to add samples later.
        stop: asked now and then; True ends the render with what it has.
        note: told in one line what went wrong beside the render, such as a preview that could not be written.
    """

    preview: Callable[[FloatArray], None] | None = None
    preview_s: float = 5.0
    checkpoint: Path | None = None
    checkpoint_s: float = 30.0
    restart: bool = False
    keep: bool = False
    stop: Callable[[], bool] = _never
    note: Callable[[str], None] = _silent


class Keeper:
    """Does what a `Watch` asks for, for one job.

    Attributes:
        resumed: share of the work that was done before.
    """

    def __init__(self, job: Job, watch: Watch, identity: Callable[[], dict[str, Any]], progress: Progress | None):
        self._job, self._watch, self._progress = job, watch, progress
        self._identity = identity() if watch.checkpoint is not None else {}
        self._earlier_s, self._written = 0.0, False
        if watch.checkpoint is not None and watch.checkpoint.exists() and not watch.restart:
            spent = read_checkpoint(watch.checkpoint, job.film, self._identity)
            self._earlier_s, self._written = spent["seconds"], True
            job.seconds[:] = spent["camera_thread_seconds"], spent["thread_seconds"]
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
        """What is due; True where the render shall stop."""
        self._report()
        now = time.perf_counter()
        if self._watch.preview is not None and now >= self._preview_at and self._job.film.done.any():
            self._try("preview", self._preview)
            done = time.perf_counter()
            self._preview_at = done + max(self._watch.preview_s, _REST * (done - now))
        now = time.perf_counter()
        if self._watch.checkpoint is not None and now >= self._checkpoint_at:
            self._try("checkpoint", self.save)
            done = time.perf_counter()
            self._checkpoint_at = done + max(self._watch.checkpoint_s, _REST * (done - now))
        return self._watch.stop()

    def save(self) -> None:
        """Write the checkpoint, where there is one to write and something to keep that it has not yet."""
        fraction = self._job.film.fraction
        if self._watch.checkpoint is None or not fraction:
            return
        if self._kept == fraction and self._watch.checkpoint.exists():
            return  # a disk may have no room for another
        camera, every = (float(s) for s in self._job.seconds)
        spent = {"seconds": self.seconds, "camera_thread_seconds": camera, "thread_seconds": every}
        write_checkpoint(self._watch.checkpoint, self._job.film, self._identity, spent)
        self._written, self._kept = True, fraction

    def finish(self) -> None:
        """Keep a render that stopped; one that is complete only where a checkpoint would else tell of less of it."""
        if self._watch.keep or self._written or self._job.film.fraction < 1:
            self._try("checkpoint", self.save)

    def rescue(self, error: NeurolensError) -> NeurolensError:
        """Keep what a render that failed had; the error, with where that is."""
        self._try("checkpoint", self.save)
        if not self._written:
            return error
        return NeurolensError(f"{error}; what was done is kept in {self._watch.checkpoint}: the same command goes on")

    def _report(self) -> None:
        fraction = self._job.film.fraction
        if self._progress is not None and fraction > self.resumed:
            pace = (time.perf_counter() - self._began) / (fraction - self.resumed)
            self._progress(fraction, pace * (1 - fraction))

    def _preview(self) -> None:
        assert self._watch.preview is not None
        self._watch.preview(develop(self._job)[0])

    def _try(self, what: str, act: Callable[[], None]) -> None:
        """Do what the render can do without; the first failure of a kind is told."""
        try:
            act()
        except (OSError, NeurolensError, MemoryError) as error:
            if what not in self._failed:
                self._failed.add(what)
                place = getattr(error, "filename", None)
                said = getattr(error, "strerror", None) or str(error) or type(error).__name__
                self._watch.note(f"{what} not written: {f'{place}: ' if place else ''}{said}")
