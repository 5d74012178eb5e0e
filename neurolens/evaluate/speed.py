"""Speed in nanoseconds per ray, so that a ratio means something.

Candidates run in turn, round after round, in one process with the same pinned threads, so that a machine that slows
down slows all of them; ratios are taken within rounds. Every candidate does the same rays: uniform over the film and
over the pupil disc of the domain, those that are blocked included, because a render pays for them too. Each may choose
the batch that suits it best.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch

from neurolens.errors import InputError, NeurolensError
from neurolens.evaluate.records import ExactRecord, Timing
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain

POOL = (
    65536  # rays of one pass: every batch size divides it, and float32 inputs of a pass stay in the third-level cache
)
BATCHES = (4096, 8192, 16384)
_SAMPLE_S = 0.01  # a sample of the clock lasts at least this long

Call = Callable[[], object]


class Unavailable(NeurolensError):
    """A candidate cannot run here; the message says why."""


@dataclass(frozen=True)
class Candidate:
    """Something that turns camera rays into scene rays.

    Attributes:
        name: for tables.
        prepare: takes the rays of one batch (float64) and gives the call to be timed; conversions belong here, off the
            clock. Raises `Unavailable` where it cannot run.
        batches: batch sizes to choose from.
    """

    name: str
    prepare: Callable[[FilmRays], Call]
    batches: tuple[int, ...] = BATCHES


@contextmanager
def pinned_threads(threads: int) -> Iterator[None]:
    """Give torch this many threads inside the block, and what it had before after it.

    Raises:
        InputError: fewer than one.
    """
    if threads < 1:
        raise InputError("speed", "threads", threads, "at least 1")
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def onnx_session_options(threads: int) -> Any:
    """onnxruntime options for a session with pinned threads: `threads` within an operator, one operator at a time."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    # Spinning threads would take the core from the next candidate.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options


def time_per_ray(call: Call, rays: int, threads: int = 1, repeats: int = 20) -> Timing:
    """Nanoseconds per ray of one call that does `rays` rays, after one call to warm up; torch's threads are pinned."""
    with pinned_threads(threads):
        call()
        inner = _calls_for_a_sample(call)
        samples = [_sample_ns(call, inner, rays) for _ in range(repeats)]
    return _timing(samples, threads, rays)


@dataclass(frozen=True)
class Race:
    """Times of candidates that ran in turn.

    Attributes:
        ns: nanoseconds per ray of each round, by candidate.
        batch: rays a call, the best of those tried.
        threads, rounds: of all.
        unavailable: reason, by candidate that could not run.
        load_before, load_after: load average of the machine, where known: above `threads`, others were working too.
    """

    ns: dict[str, list[float]]
    batch: dict[str, int]
    threads: int
    rounds: int
    unavailable: dict[str, str] = field(default_factory=dict)
    load_before: float | None = None
    load_after: float | None = None

    def timing(self, name: str) -> Timing | None:
        """Best and median of the rounds; None where the candidate could not run."""
        return _timing(self.ns[name], self.threads, self.batch[name]) if name in self.ns else None

    def speedup(self, name: str, over: str) -> dict[str, float] | None:
        """How many times faster `name` is than `over`: "min" by the minima, "median" of the ratios within rounds."""
        if name not in self.ns or over not in self.ns:
            return None
        ratios = [b / a for a, b in zip(self.ns[name], self.ns[over], strict=True)]
        return {"min": min(self.ns[over]) / min(self.ns[name]), "median": statistics.median(ratios)}

    def record(self, name: str) -> ExactRecord:
        """Row for the list of exact tracers in `results.json`."""
        if name in self.unavailable:
            return {"name": name, "available": False, "reason": self.unavailable[name], "ns_per_ray": None}
        return {"name": name, "available": True, "ns_per_ray": self.timing(name)}


def race(candidates: Sequence[Candidate], domain: Domain, *, threads: int = 1, rounds: int = 20, seed: int = 3) -> Race:
    """Time candidates in turn on the same rays of a domain.

    Raises:
        InputError: no rounds, fewer than one thread, or two candidates of one name.
    """
    names = [c.name for c in candidates]
    if rounds < 1 or len(set(names)) < len(names):
        raise InputError("race", "rounds, candidates", (rounds, names), "at least one round, and names that differ")
    pool = sample_domain(domain, POOL, seed)
    unavailable: dict[str, str] = {}
    passes: dict[str, Call] = {}
    batch: dict[str, int] = {}
    before = _load()
    with pinned_threads(threads), torch.no_grad():
        torch._dynamo.reset()  # torch compiles one function only so often before it gives up; a race starts afresh
        for c in candidates:
            try:
                passes[c.name], batch[c.name] = _best_batch(c, pool)
            except Unavailable as reason:
                unavailable[c.name] = str(reason)
        inner = {name: _calls_for_a_sample(call) for name, call in passes.items()}
        ns: dict[str, list[float]] = {name: [] for name in passes}
        for i in range(rounds):
            order = list(passes) if i % 2 == 0 else list(reversed(passes))  # nobody always follows the same neighbour
            for name in order:
                passes[name]()  # warms the caches for this candidate
                ns[name].append(_sample_ns(passes[name], inner[name], len(pool)))
    return Race(ns, batch, threads, rounds, unavailable, before, _load())


def _best_batch(candidate: Candidate, pool: FilmRays) -> tuple[Call, int]:
    """One pass over the pool in the fastest of the candidate's batch sizes."""
    best, call, size = math.inf, None, 0
    for batch in candidate.batches:
        calls = [candidate.prepare(pool.select(slice(i, i + batch))) for i in range(0, len(pool), batch)]

        def one_pass(calls: list[Call] = calls) -> None:
            for each in calls:
                each()

        one_pass()
        took = min(_sample_ns(one_pass, 1, len(pool)) for _ in range(3 if len(candidate.batches) > 1 else 1))
        if took < best:
            best, call, size = took, one_pass, batch
    assert call is not None
    return call, size


def _calls_for_a_sample(call: Call) -> int:
    return max(1, math.ceil(_SAMPLE_S * 1e9 / max(_sample_ns(call, 1, 1), 1.0)))


def _sample_ns(call: Call, inner: int, rays: int) -> float:
    start = time.perf_counter_ns()
    for _ in range(inner):
        call()
    return max(time.perf_counter_ns() - start, 1) / (inner * rays)


def _timing(samples: list[float], threads: int, batch: int) -> Timing:
    return {
        "min": min(samples),
        "median": statistics.median(samples),
        "threads": threads,
        "batch": batch,
        "repeats": len(samples),
    }


def _load() -> float | None:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None
