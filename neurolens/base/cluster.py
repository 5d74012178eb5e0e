"""The executor of a Dask cluster (see `base.tasks`), and tasks whose files travel with them to its workers.

A task's input files travel to the worker, and the files that it writes come back. Such a task is a dataclass. On the
worker its paths lie below a folder in the shape that they have here, so that scenes find their pictures. Its attribute
`out` names the file or folder that it writes; what it writes beside `out` comes back, too.
"""

import io
import logging
import math
import os
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import nullcontext, redirect_stdout, suppress
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from neurolens import __version__
from neurolens.base.errors import NeurolensError, one_line, pip_install
from neurolens.base.files import TemporaryFolder, atomic_path, cache_folder, place_inside
from neurolens.base.tasks import Failed, Lost, Shared, answer_of, cores, failure, keep_memory

R = TypeVar("R")
_MOST = 4096  # tasks in flight: each has a thread here that waits for it
_ASK_EVERY_S = 1.0  # between two counts of the workers
_TIMEOUT, _POLL_S = "10s", 5.0
_ANSWERED_S = 5.0  # in which a worker's answer can leave before the worker ends
_LOST = "the Dask scheduler is lost: what is done is kept, the same command goes on"
_KILLED = "its worker was killed, again and again: did the memory run out?"
_ALONE = threading.Lock()  # in a worker: tasks set options of the whole process, such as torch's threads


class Dask(ThreadPoolExecutor):
    """Runs tasks on a cluster, to which it connects when the first task is submitted.

    A worker that is killed costs only its task, which another one takes; a task that has cost two rounds of workers has
    failed. A lost scheduler fails all tasks with `Lost`.

    Args:
        address: the scheduler's, as tcp://host:8786, or "local" (a worker for each core of this machine), "local:N" (N
            workers), which needs a script with `if __name__ == "__main__":`. Whoever reaches a scheduler at tcp:// can
            run code on its workers and here, as this user: answers and errors of Dask are pickled. One at tls:// lets
            in those who have its keys (Dask's settings, comm.tls).
        limit_s: seconds after which a task has failed; its worker ends.

    Raises (when tasks are submitted):
        NeurolensError: Dask is not installed, there is no such scheduler. Lost: the scheduler is lost.
    """

    def __init__(self, address: str, limit_s: float = math.inf) -> None:
        super().__init__(_MOST)
        self._address, self._limit_s = address, limit_s
        self._cluster: _Cluster | None = None
        self._lock, self._suspected = threading.Lock(), threading.Lock()
        self._room, self._asked = 0, -math.inf
        self._sent: dict[Shared, Any] = {}
        self._ended = False

    @property
    def room(self) -> int:
        """The number of tasks that the cluster takes: one for each thread of its workers.

        No task is sent ahead, because Dask blames all tasks that a worker has when it is killed.
        """
        if time.monotonic() > self._asked + _ASK_EVERY_S:
            client = self._client()
            workers = client.scheduler_info(n_workers=-1).get("workers") if client.status == "running" else None
            if workers is None:
                raise Lost(_LOST)
            self._room, self._asked = max(sum(w["nthreads"] for w in workers.values()), 1), time.monotonic()
        return min(self._room, _MOST)

    def submit(self, work: Callable[..., R], /, *args: Any, **named: Any) -> Future[R]:
        """Send a task. `work` must be a function of a module, which workers import."""
        self._client()
        return super().submit(self._on_worker, work, args, named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the tasks, or with `cancel_futures` drop them, and leave the cluster; local workers end."""
        self._ended = self._ended or cancel_futures
        super().shutdown(wait and not cancel_futures, cancel_futures=cancel_futures)
        with self._lock:
            if self._cluster is not None and (wait or cancel_futures):
                self._cluster.close()
                self._cluster = None

    def _client(self) -> Any:
        with self._lock:
            if self._cluster is None:
                self._cluster = _Cluster(distributed(), self._address)
            return self._cluster.client

    def _on_worker(self, work: Callable[..., R], args: Any, named: Any) -> R:
        """Wait for the answer of a task, which is sent again where its worker was killed, perhaps by another task.

        Tasks whose worker was killed go again one after the other, so that none of them fails for the fault of another.
        """
        client = self._client()
        for before in (nullcontext(), self._suspected):
            try:
                with before:
                    outcome = self._sent_and_awaited(client, work, args, named)
            except (Exception, CancelledError) as error:
                if not self._ended and client.status != "running":
                    raise Lost(_LOST) from None
                if getattr(error, "reason", "") == "scheduler-connection-lost":
                    raise Lost(_LOST) from None
                if self._ended or not (isinstance(error, CancelledError) or type(error).__name__ == "KilledWorker"):
                    raise NeurolensError(one_line(f"{type(error).__name__}: {error}", 600)) from None
            else:
                return answer_of(outcome)
        raise NeurolensError(_KILLED)

    def _sent_and_awaited(self, client: Any, work: Callable[..., Any], args: Any, named: Any) -> Any:
        """Send a task and return its outcome; raises TimeoutError once the client is closed, for then none comes."""
        sent = [self._shared(client, each) if isinstance(each, Shared) else each for each in args]
        future = client.submit(_answer, work, __version__, self._limit_s, sent, named, pure=False)
        try:
            while True:
                try:
                    return future.result(timeout=_POLL_S)
                except TimeoutError:
                    if self._ended or client.status != "running":
                        raise
        finally:
            future.release()

    def _shared(self, client: Any, value: Shared) -> Any:
        """Return the place of shared bytes on the cluster, to which they are sent again where all workers lost them."""
        with self._lock:
            place = self._sent.get(value)
            if place is None or place.status not in ("finished", "pending"):
                place = self._sent[value] = client.submit(Shared, value.data, pure=False)
            return place


def _answer(work: Callable[..., Any], version: str, limit_s: float, args: Any, named: Any) -> Any:
    """Run a task on a worker; errors travel as text."""
    if version != __version__:
        return Failed(f"a worker has neurolens {__version__}, not {version}")
    keep_memory()
    try:
        with _ALONE:
            return work(*args, **named) if math.isinf(limit_s) else _in_time(work, limit_s, args, named)
    except Exception as error:
        return failure(error)


def _in_time(work: Callable[..., Any], limit_s: float, args: Any, named: Any) -> Any:
    """Run a task; after `limit_s`, return Failed and end the worker soon after, for no thread can be stopped."""
    pool = ThreadPoolExecutor(1)
    try:
        return pool.submit(work, *args, **named).result(limit_s)
    except TimeoutError:
        threading.Timer(_ANSWERED_S, os._exit, (1,)).start()
        return Failed(f"took longer than {limit_s:g} s")
    finally:
        pool.shutdown(wait=False)


def distributed() -> Any:
    """Return Dask's package. Raises NeurolensError, which names the extra, where it is not installed."""
    try:
        import distributed
    except ModuleNotFoundError:
        raise NeurolensError(f"--dask needs Dask, which is not installed: {pip_install('dask')}") from None
    return distributed


class _Cluster:
    """A client, and the workers of this machine that it was asked to start."""

    def __init__(self, distributed: Any, address: str) -> None:
        self._distributed, self._local = distributed, None
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # our own line reports errors
        warnings.filterwarnings("ignore", "Sending large graph")
        # The client is created before it starts, because one that fails to start must be closed: otherwise the garbage
        # collector closes it while the next one starts, whose lock it takes, and both stop.
        self.client: Any = distributed.Client.__new__(distributed.Client)
        kind, _, count = address.partition(":")
        try:
            if kind == "local":
                self._local = self._started(int(count or cores()))
            self.client.__init__(self._local or address, timeout=_TIMEOUT)
        except BaseException as error:
            self.close()
            if isinstance(error, ImportError):
                raise NeurolensError(f"--dask local needs cryptography: {pip_install('dask')}") from None
            if not isinstance(error, (OSError, ValueError)):
                raise
            expected = "tcp://HOST:PORT of a scheduler that runs, local, or local:N"
            raise NeurolensError(f"--dask {address}: {one_line(str(error), 600)}; expected {expected}") from None

    def _started(self, workers: int) -> Any:
        """Start workers on this machine for this process alone, because a scheduler runs any code that it is sent.

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
                dashboard_address="127.0.0.1:0", local_directory=str(cache_folder("dask")),
                silence_logs=logging.CRITICAL, memory_limit=0,
            )  # fmt: skip
        cluster.scheduler.http_server.stop()
        return cluster

    def close(self) -> None:
        """Leave the cluster; a scheduler that is slow to answer spoils nothing."""
        for each, timeout_s in ((self.client, 2), (self._local, 5)):
            if each is not None:
                with suppress(Exception):
                    each.close(timeout=timeout_s)


T = TypeVar("T")
_THEN = (1980, 1, 1, 0, 0, 0)  # the same files are the same bytes


def packed(files: Mapping[str, Path] | Iterable[Path]) -> bytes:
    """Pack files into bytes, under the names given, or else under their absolute paths."""
    named = files if isinstance(files, Mapping) else {os.path.abspath(path): path for path in files}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(named):
            archive.writestr(zipfile.ZipInfo(name.lstrip("/"), _THEN), named[name].read_bytes())
    return buffer.getvalue()


def unpack(data: bytes, folder: Path) -> list[Path]:
    """Write packed files below a folder, each whole or not at all, and return their paths."""
    written = []
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for name in archive.namelist():
            try:
                path = place_inside(folder, name)
            except ValueError as error:
                raise NeurolensError(f"an answer with a file outside its folder: {error}") from None
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                temporary.write_bytes(archive.read(name))
            written.append(path)
    return written


def with_paths(value: T, move: Callable[[Path], Path]) -> T:
    """Return a copy of a value, which is made of dataclasses and tuples, with each path moved by `move`."""
    if isinstance(value, Path):
        return move(value)  # type: ignore[return-value]
    if isinstance(value, tuple):
        parts = [with_paths(each, move) for each in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)  # type: ignore[return-value]
    if is_dataclass(value) and not isinstance(value, type):
        changes = {field.name: with_paths(getattr(value, field.name), move) for field in fields(value)}
        return replace(value, **changes)
    return value


def absolute(task: T) -> T:
    """Return a task with absolute paths, as it travels to a worker."""
    return with_paths(task, lambda path: Path(os.path.abspath(path)))


def run_with_files(work: Callable[[Any], object], files: Shared, task: Any) -> bytes:
    """Run `work(task)` on a worker, and return the files that it wrote, packed.

    Args:
        files: the task's inputs, packed by their absolute paths.

    Progress and warnings are not shown. Paths in the message of a NeurolensError are those of the machine that asked.
    """
    root = Path(_unpacked(files.data).name)
    task = with_paths(task, lambda path: root / str(path).lstrip("/"))
    folder = task.out.parent  # relative paths from there to the inputs are those of the machine that asked
    folder.mkdir(parents=True, exist_ok=True)
    before = set(folder.rglob("*"))
    try:
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            work(task)
        made = [path for path in sorted(folder.rglob("*")) if path.is_file() and path not in before]
        return packed({str(path.relative_to(folder)): path for path in made})
    except NeurolensError as error:
        raise NeurolensError(str(error).replace(str(root), "")) from None
    finally:
        for path in sorted(set(folder.rglob("*")) - before, reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()


@lru_cache(maxsize=2)
def _unpacked(files: bytes) -> TemporaryFolder:
    """Unpack the files of a run, once in a worker."""
    folder = TemporaryFolder()
    unpack(files, Path(folder.name))
    return folder
