"""Engines: what runs tasks and hands back their answers, in this process or on a cluster of Dask.

A task and its answer are bytes and plain values, and who runs it needs no folder in common with who asks. An answer
depends on its task alone, so that it is the same wherever and however often a task runs: a cluster may start one again
whose worker was lost. Tasks are taken one by one, as there is room for them, and answers come in any order.
"""

from __future__ import annotations

import ctypes
import logging
import math
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from neurolens import __version__
from neurolens.base.errors import NeurolensError, one_line
from neurolens.base.files import own_folder

T = TypeVar("T")
Work = Callable[[bytes, T], bytes]  # of what all tasks have in common, and of one task, to its answer
_ASK_EVERY_S = 1.0  # how many workers there are
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LONGEST, _TIMEOUT = 600, "10s"
_LOST = "the Dask scheduler is lost: what is done is kept, the same command goes on"
_KILLED = "its worker was killed, again and again: did the memory run out?"
_ALONE = threading.Lock()  # of a worker: tasks set process-wide things, such as torch's threads


@dataclass(frozen=True)
class Failed:
    """What is left of a task without an answer: the reason, in a line."""

    reason: str


Engine = Callable[[Iterable[T]], Iterator[tuple[T, bytes | Failed]]]


def here(work: Work[T], common: bytes = b"") -> Engine[T]:
    """The engine of this process: one task after the other."""

    def run(tasks: Iterable[T]) -> Iterator[tuple[T, bytes | Failed]]:
        for task in tasks:
            yield task, _answer(work, __version__, common, task)

    return run


def on_dask(address: str, work: Work[T], common: bytes = b"") -> Engine[T]:
    """The engine of a Dask cluster.

    A worker that is killed costs only its task, which another one takes; one that has cost eight workers has failed.

    Args:
        address: of the scheduler, as tcp://host:8786, or "local" (a worker a core of this machine), "local:N" (N).
            Whoever reaches a scheduler at tcp:// can run code on its workers and here, as this user: answers and
            errors of Dask are pickled. One at tls:// lets in those who have its keys (Dask's settings, comm.tls).
        work: a function of a module, which workers import. common: sent once to each worker that needs it.

    Raises (while it runs):
        NeurolensError: no Dask, no such scheduler, a scheduler that is lost; answers so far were handed out.
    """

    def run(tasks: Iterable[T]) -> Iterator[tuple[T, bytes | Failed]]:
        distributed = _distributed()
        with warnings.catch_warnings(), _Cluster(distributed, address) as client:
            warnings.filterwarnings("ignore", "Sending large graph")
            flight = _Flight(client, distributed.as_completed(), work, common)
            waiting, last = iter(tasks), False
            while True:
                # None is sent ahead: Dask blames all tasks that a worker has when it is killed.
                while not last and len(flight.running) < flight.room():
                    try:
                        flight.send(next(waiting))
                    except StopIteration:
                        last = True
                if not flight.running:
                    return
                yield from flight.land()

    return run


class _Flight:
    """The tasks that a cluster has, at most one a thread of its workers."""

    def __init__(self, client: Any, done: Any, work: Work[Any], common: bytes) -> None:
        self._client, self._done, self._work, self._common = client, done, work, common
        self._shared = client.submit(bytes, common, pure=False)
        self._room, self._asked = 0, -math.inf
        self.running: dict[
            Any, tuple[Any, int]
        ] = {}  # futures to their tasks, and how often these failed with a worker

    def room(self) -> int:
        if time.monotonic() > self._asked + _ASK_EVERY_S:
            workers = self._client.scheduler_info(n_workers=-1).get("workers")
            if workers is None:
                raise NeurolensError(_LOST)
            self._room, self._asked = max(sum(w["nthreads"] for w in workers.values()), 1), time.monotonic()
        return self._room

    def send(self, task: Any, failed: int = 0) -> None:
        if self._shared.status not in ("finished", "pending"):
            self._shared = self._client.submit(bytes, self._common, pure=False)
        future = self._client.submit(_answer, self._work, __version__, self._shared, task, pure=False)
        self.running[future] = task, failed
        self._done.add(future)

    def land(self) -> Iterator[tuple[Any, bytes | Failed]]:
        """Wait for one future: the task and its answer, or nothing where it is sent again."""
        future = next(self._done)
        task, failed = self.running.pop(future)
        try:
            yield task, future.result()
        except (Exception, CancelledError) as error:
            if getattr(error, "reason", "") == "scheduler-connection-lost":
                raise NeurolensError(_LOST) from None
            blamed = isinstance(error, CancelledError) or type(error).__name__ == "KilledWorker"
            if blamed and not failed:  # perhaps for another one's fault
                self.send(task, failed + 1)
            else:
                yield task, Failed(_KILLED if blamed else _line(f"{type(error).__name__}: {error}"))
        finally:
            future.release()


def _answer(work: Work[T], version: str, common: bytes, task: T) -> bytes | Failed:
    """Run a task, on a worker: errors travel as text."""
    if version != __version__:
        return Failed(f"a worker has neurolens {__version__}, not {version}")
    if "MALLOC_TRIM_THRESHOLD_" in os.environ:
        _keep_memory()
    try:
        with _ALONE:
            return work(common, task)
    except NeurolensError as error:
        return Failed(_line(str(error)))
    except Exception as error:
        return Failed(_line(f"a fault of neurolens: {type(error).__name__}: {error}"))


@cache
def _keep_memory() -> None:
    """Let the C library (glibc) keep freed memory, once a worker, up to the sizes that it comes to by itself.

    Dask's nannies have it given back at once (MALLOC_TRIM_THRESHOLD_), which also ends those sizes' growth: getting the
    pages of every larger array anew takes two fifths of a fit's time.
    """
    with suppress(AttributeError, OSError):  # another C library
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 32 << 20)
        library.mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def _line(text: str) -> str:
    return one_line(text, _LONGEST)


def _distributed() -> Any:
    try:
        import distributed
    except ModuleNotFoundError:
        raise NeurolensError("--dask needs Dask, which is not installed: pip install 'neurolens[dask]'") from None
    return distributed


class _Cluster:
    """A client inside the block, and the workers of this machine that it was asked to start."""

    def __init__(self, distributed: Any, address: str) -> None:
        self._distributed, self._address = distributed, address
        self._client: Any = None
        self._local: Any = None

    def __enter__(self) -> Any:
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are told in a line of ours
        kind, _, count = self._address.partition(":")
        try:
            if kind == "local":
                self._local = self._started(int(count or _cores()))
            # At hand before it starts, for one that fails to must be closed: found by the collector amid the start of
            # the next one, whose lock it wants, it stops both.
            self._client = self._distributed.Client.__new__(self._distributed.Client)
            self._client.__init__(self._local or self._address, timeout=_TIMEOUT)
        except BaseException as error:
            self.__exit__()
            if isinstance(error, ImportError):
                raise NeurolensError("--dask local needs cryptography: pip install 'neurolens[dask]'") from None
            if not isinstance(error, (OSError, ValueError)):
                raise
            expected = "tcp://HOST:PORT of a scheduler that runs, local, or local:N"
            raise NeurolensError(f"--dask {self._address}: {_line(str(error))}; expected {expected}") from None
        return self._client

    def _started(self, workers: int) -> Any:
        """Workers of this machine, for this process alone: a scheduler runs any code that it is sent.

        Keys that live as long as the cluster keep other users of the machine out; nothing is served over HTTP.
        """
        import dask
        from distributed.security import Security

        quiet: dict[str, list[str]] = {
            f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker", "nanny")
        }
        with dask.config.set(quiet):
            cluster = self._distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, host="127.0.0.1", security=Security.temporary(),
                dashboard_address="127.0.0.1:0", local_directory=str(own_folder("dask")),
                silence_logs=logging.CRITICAL, memory_limit=0,
            )  # fmt: skip
        cluster.scheduler.http_server.stop()
        return cluster

    def __exit__(self, *_: object) -> None:
        for each, timeout_s in ((self._client, 2), (self._local, 5)):
            if each is not None:
                with suppress(Exception):  # a scheduler that is slow to say good-bye spoils no answer
                    each.close(timeout=timeout_s)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
