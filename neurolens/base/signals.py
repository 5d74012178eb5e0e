"""Signals that ask a command to end: Ctrl-C, SIGTERM, and SIGHUP, which a terminal sends when it closes."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

ASKING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_AT_ONCE_S = 1.0


@contextmanager
def handled(by: Callable[[int], None]) -> Iterator[dict[int, Any]]:
    """Call `by` with the number of a signal of `ASKING` inside the block; yields the handlers of before.

    Signals that are ignored, as `nohup` has it, stay so. Only the main thread can handle signals: in others nothing
    changes.
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
    """Leaves the block of a `Stopping`, and a stage of the progress without its final line."""


@contextmanager
def held() -> Iterator[None]:
    """Keep the signals of `ASKING` waiting inside the block, and for ever from processes and threads started there."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ASKING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_at_once() -> None:
    """In a process started inside `held`: signals that were not ignored end it, those that wait now too."""
    for number in ASKING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ASKING)


def _leave_closed_terminal() -> None:
    """Let what is still printed go nowhere: writing to a closed terminal is an error, in the midst of saving."""
    for descriptor in (1, 2):
        try:
            os.write(descriptor, b"")
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
