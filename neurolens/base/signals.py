"""Signals that ask a command to end: Ctrl-C, SIGTERM, and SIGHUP, which a terminal sends when it closes."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

ASKING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


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
