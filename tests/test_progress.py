"""Progress lines: what they say of the time left, on a terminal and elsewhere, and that quiet means quiet."""

from __future__ import annotations

import io

import pytest

from neurolens.base.progress import Progress, duration


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0.0 s"), (-1, "0.0 s"), (0.44, "0.4 s"), (9.96, "10 s"), (59.7, "1 min 00 s"), (185, "3 min 05 s")],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_time_left_follows_the_pace_of_the_stage_and_the_plan_of_the_rest() -> None:
    clock, stream = Clock(), io.StringIO()
    progress = Progress({"trace": 10, "fit": 60}, stream=stream, interval_s=5, clock=clock)
    with progress.stage("trace") as report:
        clock.now += 6
        report(0.25)
    assert stream.getvalue().splitlines()[0] == "trace:  25%, 6.0 s, 18 s left (in all 1 min 18 s left)"


def test_a_slow_stage_corrects_the_plan() -> None:
    clock, stream = Clock(), io.StringIO()
    progress = Progress({"trace": 10, "fit": 60}, stream=stream, clock=clock)
    with progress.stage("trace"):
        clock.now += (
            40  # four times as long as planned: the 60 s to come take longer too, though not for sure four times
        )
    words = stream.getvalue().split("in all ")[1].split()
    assert 60 < 60 * int(words[0]) + int(words[2]) <= 240


def test_the_last_stage_has_no_total_and_its_own_estimate_wins() -> None:
    clock, stream = Clock(), io.StringIO()
    with Progress(stream=stream, interval_s=0, clock=clock).stage("render") as report:
        clock.now += 1
        report(0.5, 42.0)
    assert stream.getvalue().splitlines() == ["render:  50%, 1.0 s, 42 s left", "render: done in 1.0 s"]


def test_lines_are_rare_without_a_terminal() -> None:
    clock, stream = Clock(), io.StringIO()
    with Progress(stream=stream, interval_s=5, clock=clock).stage("fit") as report:
        for k in range(100):
            clock.now += 0.1
            report(k / 100)
    assert len(stream.getvalue().splitlines()) <= 3


def test_a_terminal_has_one_line_a_stage() -> None:
    clock, stream = Clock(), Terminal()
    progress = Progress(stream=stream, clock=clock)
    for name in ("trace", "fit"):
        with progress.stage(name) as report:
            for k in range(10):
                clock.now += 1
                report(k / 10)
    assert stream.getvalue().count("\n") == 2


def test_an_error_leaves_the_line_closed() -> None:
    stream = Terminal()
    with pytest.raises(ValueError), Progress(stream=stream).stage("fit") as report:
        report(0.1)
        raise ValueError
    assert stream.getvalue().endswith("\n") and "done" not in stream.getvalue()


@pytest.mark.parametrize("fraction", [-1.0, 0.0, 1.0, 7.0])
def test_any_fraction_is_taken(fraction: float) -> None:
    stream = io.StringIO()
    with Progress({"a": 0, "b": 0}, stream=stream, interval_s=0).stage("a") as report:
        report(fraction)
    assert "%" in stream.getvalue()


def test_quiet_prints_nothing() -> None:
    stream = Terminal()
    progress = Progress(quiet=True, stream=stream)
    progress.note("hello")
    with progress.stage("fit") as report:
        report(0.5)
    assert stream.getvalue() == ""
