"""The workers of a render: distribution of tiles, start and end.

Workers are forked processes: numpy's short operations leave no time for threads to share the interpreter (two threads
were slower than one at 8k-element batches, two processes twice as fast). Where the system does not fork, threads do the
work.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from neurolens.base.errors import NeurolensError
from neurolens.base.signals import held
from neurolens.render.film import CONTEXT, FORKS
from neurolens.render.job import Job

_POLL_S, _POLL_PARENT_S, _PATIENCE_S = 0.05, 0.5, 5.0


def run(job: Job, workers: int, watch: Callable[[], bool] | None = None) -> None:
    """Do the remaining work, in this process or in forked ones; `watch` is polled and ends it early, between tiles.

    Raises:
        NeurolensError: a worker failed or was killed; the film's tiles stay consistent.
    """
    claimed = CONTEXT.Value("q", int(job.film.done.min()) * job.tiling.tiles)
    if workers == 1 and watch is None:
        _work(job, claimed)
        return
    forks = FORKS and not multiprocessing.current_process().daemon  # such as a worker of Dask: it may have no children
    kind: Any = CONTEXT.Process if forks else threading.Thread
    team = [
        kind(target=_quiet, args=(job, claimed, k, workers, os.getpid() if forks else None), daemon=True)
        for k in range(workers)
    ]
    killed: list[int] = []
    try:
        with held():  # inherited by forked workers: only this process handles Ctrl-C
            for worker in team:
                worker.start()
        while alive := [worker for worker in team if worker.is_alive()]:
            alive[0].join(_POLL_S)
            if forks:
                killed = [worker.exitcode for worker in team if worker.exitcode]
            if killed or (watch is not None and watch()):
                break  # after a kill the others may wait for its tile forever
    finally:
        job.stop[0] = 1
        _dismiss(job, [worker for worker in team if worker.ident is not None], forks)
    if job.message[0]:
        raise NeurolensError(bytes(job.message).rstrip(bytes(1)).decode(errors="replace"))
    if killed:
        guess = ": did the memory run out?" if killed[0] == -signal.SIGKILL else ""
        why = f" (signal {-killed[0]}{guess})" if killed[0] < 0 else ""
        raise NeurolensError(f"a render worker was killed{why} before it had finished")


def _dismiss(job: Job, team: Sequence[Any], forks: bool) -> None:
    """Let workers finish their tiles; forked ones that take long are killed, none of them while it holds the film."""
    until = time.monotonic() + _PATIENCE_S
    for worker in team:
        worker.join(max(until - time.monotonic(), 0) if forks else None)
    late = [worker for worker in team if worker.is_alive()]
    if late:
        with suppress(NeurolensError), job.film.held():
            for worker in late:
                worker.kill()
        for worker in late:
            worker.kill()
            worker.join()


def _work(job: Job, claimed: Any) -> None:
    """Take tiles, all of one pass before the next, until none is left; `claimed` counts them over all workers."""
    opener = getattr(job.camera, "for_worker", None)
    camera = opener() if opener else job.camera
    film, tiles = job.film, job.tiling.tiles
    while True:
        with claimed.get_lock():
            number = claimed.value
            claimed.value += 1
        part, tile = divmod(number, tiles)
        if part >= job.tiling.passes:
            return
        # Sums are added in the order of passes, so that rounding does not depend on the workers.
        while film.done[tile] < part and not job.stop[0]:
            time.sleep(1e-4)
        if job.stop[0]:
            return
        if film.done[tile] > part:
            continue  # done before a checkpoint
        began = time.perf_counter()
        sums, camera_s = job.render_tile(camera, tile, part)
        film.add(tile, sums)
        with claimed.get_lock():
            job.seconds += camera_s, time.perf_counter() - began


def _quiet(job: Job, claimed: Any, number: int, workers: int, parent: int | None) -> None:
    """One of several workers: its error goes to the shared message only; a thread has no `parent`."""
    try:
        if parent is not None:
            threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
            _pin(number, workers)
        _work(job, claimed)
    except BaseException as error:
        text = _said(error).encode()[: len(job.message)]
        job.message[: len(text)] = np.frombuffer(text, np.uint8)
        job.stop[0] = 1


def _end_with(parent: int) -> None:
    """End this worker once its parent is gone, whatever it does: a killed parent can ask nobody to stop."""
    while os.getppid() == parent:
        time.sleep(_POLL_PARENT_S)
    os._exit(1)


def _said(error: BaseException) -> str:
    """One line for an expected error; for any other with its place in the code."""
    if isinstance(error, NeurolensError):
        return str(error)
    if isinstance(error, MemoryError):
        return f"a render worker ran out of memory ({error or 'no more said'})"
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{os.path.basename(frame.filename)}:{frame.lineno}"
    return f"a render worker failed: {type(error).__name__}: {error} ({place})"


def _pin(number: int, workers: int) -> None:
    """Pin a worker to one core if there is a worker for each core; fewer are left to the scheduler."""
    with suppress(AttributeError, OSError):
        cores = sorted(os.sched_getaffinity(0))
        if workers >= len(cores):
            os.sched_setaffinity(0, {cores[number % len(cores)]})
