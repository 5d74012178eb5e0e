"""Speed in nanoseconds per ray, measured in races so that ratios are meaningful.

Candidates run in turn, round after round, in one process with the same number of threads, so that a machine that
slows down slows all of them; ratios are taken within rounds. Every candidate does the same rays: uniform over the film
and over the pupil disc of the domain, those that are blocked included, because a render traces them too, and all from
one film plane, as in a picture. Each candidate uses its fastest batch size.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch

from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.records import ExactRecord, Timing, break_even_rays
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.model import Domain
from neurolens.surrogates.terms import pinned_threads

# Rays of one pass: every batch size divides it, and float32 inputs of a pass stay in the third-level cache.
POOL = 65536
BATCHES = (4096, 8192, 16384)
_SAMPLE_S = 0.001  # least time of a sample; short ones fit between the interruptions of a busy machine
_SAMPLES = 5  # samples of a round, of which the best counts
_PREPARING = 0.7  # approximate share of compilation in a race's time

Call = Callable[[], object]


class Unavailable(NeurolensError):
    """A candidate cannot run here; the message says why."""


@dataclass(frozen=True)
class Candidate:
    """Something that turns camera rays into scene rays.

    Attributes:
        name: for tables.
        prepare: takes the rays of one batch (float64, one film plane) and gives the call to be timed; conversions
            belong here, off the clock. Raises `Unavailable` where it cannot run.
        batches: batch sizes to choose from.
        domain: whose rays it does, where candidates of several domains run in one race; None takes the race's.
    """

    name: str
    prepare: Callable[[FilmRays], Call]
    batches: tuple[int, ...] = BATCHES
    domain: Domain | None = None


@dataclass(frozen=True)
class Gain:
    """A model on the clock: its times, how many times faster it is (by the minima), after how many rays it pays off.

    None where one of the two was not timed; break_even_rays also where the model is no faster.
    """

    ns_per_ray: Timing | None
    speedup: float | None
    break_even_rays: float | None


@dataclass(frozen=True)
class Race:
    """Times of candidates that ran in turn.

    Attributes:
        ns: nanoseconds per ray of each round (the best of a few short samples), by candidate.
        batch: rays per call, the best of those tried.
        threads, rounds: of all.
        unavailable: reason, by candidate that could not run.
        load_before, load_after: load average of the machine, if known; above `threads` it was shared.
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
        ns = self.ns.get(name)
        if ns is None:
            return None
        return {
            "min": min(ns),
            "median": statistics.median(ns),
            "threads": self.threads,
            "batch": self.batch[name],
            "repeats": len(ns),
        }

    def speedup(self, name: str, over: str) -> dict[str, float] | None:
        """How many times faster `name` is than `over`: "min" by the minima, "median" of the ratios within rounds."""
        if name not in self.ns or over not in self.ns:
            return None
        ratios = [b / a for a, b in zip(self.ns[name], self.ns[over], strict=True)]
        return {"min": min(self.ns[over]) / min(self.ns[name]), "median": statistics.median(ratios)}

    def gain(self, name: str, exact: str, fit_s: float | None, load_s: float | None) -> Gain:
        """What a model that took `fit_s` to fit and `load_s` to load gains over an exact tracer."""
        timing, ratio, slow = self.timing(name), self.speedup(name, exact), self.timing(exact)
        pays = break_even_rays(fit_s, load_s, slow["min"], timing["min"]) if slow and timing else None
        return Gain(timing, ratio["min"] if ratio else None, pays)

    def record(self, name: str) -> ExactRecord:
        """Row for the list of exact tracers in `results.json`."""
        if name in self.unavailable:
            return {"name": name, "available": False, "reason": self.unavailable[name], "ns_per_ray": None}
        return {"name": name, "available": True, "ns_per_ray": self.timing(name)}


def race(
    candidates: Sequence[Candidate],
    domain: Domain | FilmRays,
    *,
    threads: int = 1,
    rounds: int = 20,
    fresh: bool = True,
    report: Callable[[float], None] = lambda share: None,
) -> Race:
    """Time candidates in turn on the same rays of a domain, or each on its own.

    Args:
        domain: of the rays of candidates without their own domain; or those rays, `POOL` of them.
        fresh: forget what torch compiled before; False keeps what an earlier race of the same candidates compiled.
        report: called with the fraction done.

    Each call runs on one thread; with more threads, that many workers share out the batches, as a renderer does
    (torch and onnxruntime gain nothing from threads within an operator at batches that fit the caches).

    Raises:
        InputError: no rounds, fewer than one thread, or two candidates of one name.
    """
    names = [c.name for c in candidates]
    if rounds < 1 or len(set(names)) < len(names):
        raise InputError("race", "rounds, candidates", (rounds, names), "at least one round, and names that differ")
    unavailable: dict[str, str] = {}
    passes: dict[str, _Pass] = {}
    before = _load()
    with _workers(threads) as team, pinned_threads(), torch.no_grad():
        if fresh:
            torch._dynamo.reset()  # torch limits the number of recompilations of a function
        for i, c in enumerate(candidates):
            try:
                passes[c.name] = _best_batch(c, _pool(c.domain or domain), team)
            except Unavailable as reason:
                unavailable[c.name] = str(reason)
            report(_PREPARING * (i + 1) / len(candidates))
        inner = {name: max(1, math.ceil(_SAMPLE_S * 1e9 / each.sample_ns(1))) for name, each in passes.items()}
        ns: dict[str, list[float]] = {name: [] for name in passes}
        for i in range(rounds):
            order = list(passes) if i % 2 == 0 else list(reversed(passes))  # neighbours alternate
            for name in order:
                passes[name].sample_ns(1)  # warms the caches for this candidate
                ns[name].append(min(passes[name].sample_ns(inner[name]) for _ in range(_SAMPLES)) / POOL)
            report(_PREPARING + (1 - _PREPARING) * (i + 1) / rounds)
    return Race(ns, {n: p.batch for n, p in passes.items()}, threads, rounds, unavailable, before, _load())


def _pool(domain: Domain | FilmRays) -> FilmRays:
    """The rays of one pass: `POOL` of them, from the domain's film plane nearest to the lens."""
    if isinstance(domain, FilmRays):
        return domain
    rays = sample_domain(domain, POOL, seed=3)
    return replace(rays, film_z=torch.full_like(rays.film_z, domain.film_z_mm[0]))


@dataclass(frozen=True)
class _Pass:
    """The calls of one candidate that together do every ray of the pool once, shared out among workers."""

    batch: int
    calls: tuple[Call, ...]
    workers: ThreadPoolExecutor | None
    threads: int

    def sample_ns(self, inner: int) -> float:
        """Nanoseconds of one pass, mean of `inner` in a row."""
        start = time.perf_counter_ns()
        if self.workers is None:
            _repeat(self.calls, inner)
        else:
            # A worker repeats its own share, so that distribution is not timed with every pass.
            shares = [self.calls[i :: self.threads] for i in range(self.threads)]
            for done in [self.workers.submit(_repeat, share, inner) for share in shares]:
                done.result()
        return max(time.perf_counter_ns() - start, 1) / inner


def _repeat(calls: Sequence[Call], times: int) -> None:
    with torch.no_grad():  # gradients are a setting of each thread
        for _ in range(times):
            for call in calls:
                call()


@contextmanager
def _workers(threads: int) -> Iterator[ThreadPoolExecutor | None]:
    """Threads that share out batches; None for a single one."""
    if threads < 1:
        raise InputError("race", "threads", threads, "at least 1")
    if threads == 1:
        yield None
        return
    # The number of threads within an operator is a setting of each thread, too.
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as workers:
        yield workers


def _best_batch(candidate: Candidate, pool: FilmRays, workers: ThreadPoolExecutor | None) -> _Pass:
    """One pass over the pool in the fastest of the candidate's batch sizes."""
    threads = 1 if workers is None else workers._max_workers
    best, found = math.inf, None
    for batch in candidate.batches:
        calls = tuple(candidate.prepare(pool.select(slice(i, i + batch))) for i in range(0, len(pool), batch))
        each = _Pass(batch, calls, workers, threads)
        each.sample_ns(1)
        took = min(each.sample_ns(1) for _ in range(2 * _SAMPLES)) if len(candidate.batches) > 1 else 0.0
        if took < best:
            best, found = took, each
    assert found is not None
    return found


def _load() -> float | None:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None
