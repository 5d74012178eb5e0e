"""Progress on stderr: one line per stage, with the time left for the stage and for the whole run."""

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol, TextIO

from neurolens.base.errors import printable

# The planned times weigh as much as so many seconds of measured times.
_TRUST_S = 20.0


class Report(Protocol):
    """A stage calls this with the fraction done and, if it has its own estimate, the seconds left."""

    def __call__(self, fraction: float, seconds_left: float | None = None) -> None: ...


def duration(seconds: float) -> str:
    """Return a time as text: "0.4 s", "12 s", "3 min 05 s", "2 h 10 min"."""
    if seconds < 9.95:
        return f"{max(seconds, 0.0):.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class Progress:
    """Reports the stages of a run, a line for each:

        progress = Progress({"trace ray pairs": 2, "fit": 60})
        with progress.stage("trace ray pairs") as report:
            report(0.3)

    On a terminal the line is rewritten in place. Elsewhere a line is printed at most every `interval_s`, and when the
    stage ends.

    Args:
        plan: expected seconds of the coming stages; measured times correct the remaining plan.
        quiet: print nothing.
        stream: None uses the current sys.stderr at each call.
        interval_s: seconds between lines where there is no terminal.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        plan: Mapping[str, float] | None = None,
        *,
        quiet: bool = False,
        stream: TextIO | None = None,
        interval_s: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._waiting = dict(plan or {})
        self._quiet, self._stream, self._interval_s, self._clock = quiet, stream, interval_s, clock
        self._expected_s, self._taken_s = 0.0, 0.0  # of the planned stages that are done
        self._open_line = False
        self._printed_at = -float("inf")

    def plan(self, stages: Mapping[str, float]) -> None:
        """Add coming stages with their expected seconds."""
        self._waiting.update(stages)

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Time one stage; yields the function that reports the fraction done, from 0 to 1."""
        expected = self._waiting.pop(name, None)
        began = self._clock()
        self._printed_at = began  # the first line comes after a whole interval: short stages print one line only

        def report(fraction: float, seconds_left: float | None = None) -> None:
            share = min(max(float(fraction), 0.0), 1.0)
            elapsed = self._clock() - began
            left = seconds_left
            if left is None and share > 0.02:  # estimated from its pace, once it has one
                left = elapsed * (1 / share - 1)
            elif left is None and expected is not None:
                left = max(expected * self._pace() - elapsed, 0.0)
            to_go = "" if left is None else f", {duration(left)} left{self._total(left)}"
            self._show(f"{name}: {100 * share:3.0f}%, {duration(elapsed)}{to_go}")

        if self._terminal():
            report(0.0)
        try:
            yield report
        except BaseException:
            if self._open_line and self._output is not None:
                self._output.write("\n")
                self._output.flush()
                self._open_line = False
            raise
        taken = self._clock() - began
        if expected is not None:
            self._expected_s += expected
            self._taken_s += taken
        self._show(f"{name}: done in {duration(taken)}{self._total(0.0)}", last=True)

    def note(self, text: str) -> None:
        """Print a permanent line."""
        self._show(text, last=True)

    def _pace(self) -> float:
        """Return measured over expected seconds of finished stages, damped: short stages predict long ones poorly."""
        return (self._taken_s + _TRUST_S) / (self._expected_s + _TRUST_S)

    def _total(self, left: float) -> str:
        """Return the words on the time left for the whole run; none in its last stage."""
        if not self._waiting:
            return ""
        return f" (in all {duration(left + self._pace() * sum(self._waiting.values()))} left)"

    @property
    def _output(self) -> TextIO | None:
        return None if self._quiet else self._stream or sys.stderr

    def _terminal(self) -> bool:
        stream = self._output
        return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"

    def _show(self, text: str, last: bool = False) -> None:
        stream = self._output
        if stream is None:
            return
        now, text = self._clock(), printable(text)
        if self._terminal():
            if not last and self._open_line and now - self._printed_at < 0.1:
                return
            width = shutil.get_terminal_size().columns - 1
            stream.write(f"\r{text[:width]}\x1b[K" + ("\n" if last else ""))
            self._open_line = not last
        elif last or now - self._printed_at >= self._interval_s:
            stream.write(text + "\n")
        else:
            return
        self._printed_at = now
        stream.flush()
