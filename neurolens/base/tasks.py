"""Executors of tasks: in this process, in a process for each, in forked processes. Also the handling of signals.

All have the interface of `concurrent.futures`: `submit` returns a `Future`, and `wait` and `as_completed` of the
standard library take it. `run_each` hands out the answers of any number of tasks while only a few of them wait in
memory. An answer must depend on its task alone, because a cluster starts a task again when its worker was lost::

    with Processes(jobs=4) as executor:
        for task, answer in run_each(executor, work, tasks):
            print(task, answer.reason if isinstance(answer, Failed) else answer)

`in_order` runs tasks in threads and yields answers in the order of the tasks, for sums that must not depend on timing.
"""

from __future__ import annotations

import ctypes
import math
import multiprocessing
import os
import select
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import wait
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from neurolens.base.errors import NeurolensError, missing, one_line, out_of_memory, reason

T = TypeVar("T")
R = TypeVar("R")
_LONGEST = 3000  # characters of a reason
_POLL_S, _POLL_PARENT_S, _PATIENCE_S = 0.05, 0.5, 5.0
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
# A thread that starts a process asks all processes for their exit codes, which can be read only once: one at a time.
_STARTING = threading.Lock()
# Signals that ask a command to end: Ctrl-C, SIGTERM, and SIGHUP, which a terminal sends when it closes.
ASKING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_AT_ONCE_S = 1.0


@dataclass(frozen=True)
class Failed:
    """Stands for the answer of a task that failed: the reason in one line."""

    reason: str


@dataclass(frozen=True)
class Shared:
    """Bytes that many tasks take as an argument: a cluster sends them to each worker once."""

    data: bytes


class Lost(NeurolensError):
    """The executor itself has failed, so that its remaining tasks have no answers."""


class Here(Executor):
    """Runs each task in this process, before `submit` returns."""

    room = 1

    def submit(self, work: Callable[..., R], /, *args: Any, **named: Any) -> Future[R]:
        """Run the task; its future is done."""
        future: Future[R] = Future()
        try:
            future.set_result(work(*args, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes(ThreadPoolExecutor):
    """Runs each task in a process of its own, whose memory ends with it.

    A process that is killed or takes too long costs its own task only. A script that uses these must guard its main
    part by `if __name__ == "__main__":`, since each process imports the script.

    Args:
        jobs: how many processes run at a time. limit_s: seconds after which a process is killed.
    """

    def __init__(self, jobs: int, limit_s: float = math.inf) -> None:
        super().__init__(jobs)
        self.room = jobs
        self._limit_s, self._running, self._ended = limit_s, set[Any](), False

    def submit(self, work: Callable[..., R], /, *args: Any, **named: Any) -> Future[R]:
        """Start the task once a process has room. `work` must be a function of a module; its arguments are pickled."""
        return super().submit(self._in_process, work, args, named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the tasks, or with `cancel_futures` kill the processes that run."""
        if cancel_futures:
            with _STARTING:
                self._ended = True
                for process in self._running:
                    process.kill()
        super().shutdown(wait, cancel_futures=cancel_futures)

    def _in_process(self, work: Callable[..., R], args: Any, named: Any) -> R:
        """Start a process and wait for its answer, in a thread of the pool."""
        pipe, process = self._started(work, args, named)
        try:
            if not pipe.poll(None if math.isinf(self._limit_s) else self._limit_s):
                process.kill()
                raise NeurolensError(f"took longer than {self._limit_s:g} s")
            return answer_of(pipe.recv())
        except EOFError:
            raise NeurolensError(f"its process {_end_of(process)}") from None
        finally:
            pipe.close()
            _exit_code(process)
            self._running.discard(process)

    def _started(self, work: Callable[..., R], args: Any, named: Any) -> tuple[Any, Any]:
        context = _context(sorted({each.__module__ for each in (work, *args) if callable(each)}))
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(there, work, args, named), daemon=True)
        with _STARTING, held():  # this process handles Ctrl-C
            if self._ended:
                raise NeurolensError("the executor was shut down")
            process.start()
            self._running.add(process)
        there.close()
        return here, process


class Forked(ThreadPoolExecutor):
    """Runs tasks of one function in processes that are forked from this one and share all that it holds, uncopied.

    Args:
        work: the function of all tasks. jobs: how many processes; each is pinned to a core if there is one for each.
    """

    def __init__(self, work: Callable[..., Any], jobs: int) -> None:
        super().__init__(jobs)
        self.room, self._work = jobs, work
        self._free, self._processes = SimpleQueue[tuple[Any, Any]](), list[Any]()
        context: Any = multiprocessing.get_context("fork")
        with held():  # only this process handles Ctrl-C
            for number in range(jobs):
                here, there = context.Pipe()
                process = context.Process(target=_serve, args=(there, work, number, jobs, os.getpid()), daemon=True)
                process.start()
                there.close()
                self._processes.append(process)
                self._free.put((here, process))

    def submit(self, work: Callable[..., R], /, *args: Any, **named: Any) -> Future[R]:
        """Send the arguments, which are pickled, to a free process; `work` must be the executor's function."""
        assert work == self._work
        return super().submit(self._answer, args, named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the tasks, or with `cancel_futures` kill the processes that run; then end all processes."""
        if not cancel_futures:
            super().shutdown(wait)
        for process in self._processes:
            process.kill()
        super().shutdown(cancel_futures=cancel_futures)
        for process in self._processes:
            process.join()

    def _answer(self, args: Any, named: Any) -> Any:
        pipe, process = self._free.get()
        try:
            pipe.send((args, named))
            answer = pipe.recv()
        except (EOFError, OSError):
            raise NeurolensError(f"a worker {_end_of(process)}") from None
        finally:  # a worker that is gone fails at once from now on
            self._free.put((pipe, process))
        return answer_of(answer)


def in_order(threads: int, work: Callable[[T], R], tasks: Iterable[T]) -> Iterator[R]:
    """Run `work(task)` for each task in threads of this process, and yield the answers in the order of the tasks.

    A task is taken whenever a thread is free. Where the iteration ends early, no further task starts.
    """
    with ThreadPoolExecutor(threads) as pool:
        running = deque[Future[R]]()
        try:
            for task in tasks:
                running.append(pool.submit(work, task))
                if len(running) > threads:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def run_each(
    executor: Executor, work: Callable[..., R], tasks: Iterable[T], *common: Any, stop: Callable[[], bool] | None = None
) -> Iterator[tuple[T, R | Failed]]:
    """Run `work(*common, task)` for each task, and yield tasks with their answers in the order of completion.

    Tasks are taken one by one, when the executor has room, so that hundreds of thousands need little memory. Where the
    iteration ends early, the executor is shut down and its processes are killed.

    Args:
        executor: any executor of `concurrent.futures`; its attribute `room`, where it has one, bounds the tasks in
            flight (the number of cores elsewhere).
        stop: is called many times a second; once it is true no task starts, and those that run have five seconds left.

    Raises:
        Lost: the executor has failed; the answers so far were yielded.
    """
    waiting, running, done = iter(tasks), dict[Future[R], T](), SimpleQueue[Future[R]]()
    more, end = True, math.inf
    try:
        while (more or running) and time.monotonic() < end:
            while more and len(running) < getattr(executor, "room", cores()):
                try:
                    task = next(waiting)
                except StopIteration:
                    more = False
                    break
                future = executor.submit(work, *common, task)
                running[future] = task
                future.add_done_callback(done.put)
            with suppress(Empty):
                if running:
                    future = done.get(timeout=None if stop is None else _POLL_S)
                    yield running.pop(future), _result(future)
            if stop is not None and end == math.inf and stop():
                more, end = False, time.monotonic() + _PATIENCE_S
    finally:
        if more or running:
            executor.shutdown(wait=False, cancel_futures=True)


def _result(future: Future[Any]) -> Any:
    try:
        return future.result()
    except Lost:
        raise
    except Exception as error:
        return failure(error)


def failure(error: Exception) -> Failed:
    """Return the reason that an error gives, in one line: errors travel between processes as text."""
    if isinstance(error, NeurolensError) or missing(error):
        return Failed(one_line(reason(error), _LONGEST))
    if out_of_memory(error):
        return Failed(one_line(f"a worker ran out of memory ({error or 'no more is known'})", _LONGEST))
    frame = traceback.extract_tb(error.__traceback__)[-1]
    said = one_line(f"a fault of neurolens: {type(error).__name__}: {error}", _LONGEST)
    return Failed(f"{said} ({os.path.basename(frame.filename)}:{frame.lineno})")


def _outcome(work: Callable[..., Any], args: Any, named: Any) -> Any:
    try:
        return work(*args, **named)
    except Exception as error:
        return failure(error)


def answer_of(outcome: Any) -> Any:
    """Return the answer that another process sent. Raises NeurolensError with the reason where the task failed."""
    if isinstance(outcome, Failed):
        raise NeurolensError(outcome.reason)
    return outcome


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def keep_memory() -> None:
    """Let the C library (glibc) keep the memory of freed arrays from the start, as it does by itself only later.

    Otherwise it returns the memory of every larger array, and a trace spends half of its time on getting pages again.
    Dask's nannies set MALLOC_TRIM_THRESHOLD_, which also stops the C library from raising these sizes. One call serves
    the whole process.
    """
    with suppress(AttributeError, OSError):  # another C library
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 32 << 20)
        library.mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def _context(modules: list[str]) -> Any:
    """Return the context of new processes: they are forked by a server without threads.

    The server has imported the first task's modules, so that a process need not.
    """
    kind = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context: Any = multiprocessing.get_context(kind)
    if kind == "forkserver":
        context.set_forkserver_preload(modules)
    return context


def _exit_code(process: Any) -> int:
    wait([process.sentinel])
    with _STARTING:
        process.join()
        return int(process.exitcode)


def _end_of(process: Any) -> str:
    """Say how a process ended that has given no answer."""
    code = _exit_code(process)
    if code >= 0:
        return f"ended with code {code}"
    return f"was killed by signal {-code}" + (": did the memory run out?" if code == -signal.SIGKILL else "")


def _serve(pipe: Any, work: Callable[..., Any], number: int, jobs: int, parent: int) -> None:
    """Run as the main function of a forked process."""
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    with suppress(AttributeError, OSError):  # fewer processes than cores are left to the scheduler
        if jobs >= len(free := sorted(os.sched_getaffinity(0))):
            os.sched_setaffinity(0, {free[number % len(free)]})
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)  # a forked process must not enter torch's thread pool: it never returns
    with suppress(EOFError):
        while True:
            args, named = pipe.recv()
            pipe.send(_outcome(work, args, named))


def _end_with(parent: int) -> None:
    """End this process once its parent is gone, whatever it is doing: a killed parent can tell nobody to stop."""
    while os.getppid() == parent:
        time.sleep(_POLL_PARENT_S)
    os._exit(1)


def _work(pipe: Any, work: Callable[..., Any], args: Any, named: Any) -> None:
    """Run as the main function of a process."""
    end_at_once()
    threading.Thread(target=_end_unread, args=(pipe.fileno(),), daemon=True).start()
    with suppress(BrokenPipeError):  # the process that asked was killed
        pipe.send(_outcome(work, args, named))


def _end_unread(pipe: int) -> None:
    """End this process once nobody reads from the pipe any more: a reader that was killed cannot ask it to end."""
    if hasattr(select, "poll"):
        waiting = select.poll()
        waiting.register(pipe, 0)  # errors alone, such as a closed end
        waiting.poll()
        os._exit(1)


@contextmanager
def handled(by: Callable[[int], None]) -> Iterator[dict[int, Any]]:
    """Call `by` with the number of a signal of `ASKING` inside the block; yields the previous handlers.

    Signals that are ignored, as `nohup` does, stay ignored. Only the main thread can handle signals; in other threads
    nothing changes.
    """

    def handler(number: int, _: object) -> None:
        if number != signal.SIGINT:
            _leave_closed_terminal()
        by(number)

    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {n: signal.getsignal(n) for n in ASKING if signal.getsignal(n) not in (signal.SIG_IGN, None)}
        for number in before:
            signal.signal(number, handler)
    try:
        yield before
    finally:
        for number, old in before.items():
            signal.signal(number, old)


class Stopping:
    """Inside the block, a signal of `ASKING` first requests a stop; a second one takes its usual effect.

    `timeout` and others send a signal twice at once, to the process and to its group: that counts as one.
    """

    def __init__(self) -> None:
        self._handled = handled(self._asked)
        self._before: dict[int, Any] = {}
        self.number: int | None = None  # of the signal
        self._at = 0.0

    def __enter__(self) -> Stopping:
        self._before = self._handled.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        self._handled.__exit__(None, None, None)
        return kind is Unfinished

    def __call__(self) -> bool:
        """True once a stop was requested."""
        return self.number is not None

    def _asked(self, number: int) -> None:
        if self.number is None:
            self.number, self._at = number, time.monotonic()
        elif time.monotonic() > self._at + _AT_ONCE_S:
            signal.signal(number, self._before[number])
            signal.raise_signal(number)


class Unfinished(Exception):
    """The exception that leaves the block of a `Stopping`; a stage of the progress then prints no last line."""


@contextmanager
def held() -> Iterator[None]:
    """Hold back the signals of `ASKING` inside the block, and for ever in processes and threads that start there."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ASKING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_at_once() -> None:
    """Let signals end a process that was started inside `held`; a signal that waits ends it now.

    Signals that were ignored before stay ignored.
    """
    for number in ASKING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ASKING)


def _leave_closed_terminal() -> None:
    """Discard what is still printed: writing to a closed terminal is an error, which would interrupt saving."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
