"""Speed in nanoseconds per ray, measured in races so that ratios mean something, and what may run in these.

Candidates run in turn, round after round, on one thread of one process, so that a machine that slows down slows all of
them; ratios are taken within rounds. Every candidate does the same rays, from one film plane as in a picture: uniform
over the film and over the pupil disc of the domain, also those that are blocked, because a render traces them, too.
Each candidate uses its fastest batch size.
"""

import math
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError, ModelError, NeurolensError
from neurolens.cameras.contract import Camera
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.cameras.model import OnnxLens, load_model
from neurolens.graph.compiled import CompiledGraph
from neurolens.graph.compiler import has_compiler
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.models.file import read_model
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import sample_domain
from neurolens.models.source import fused_program
from neurolens.models.terms import pinned_threads
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.rays import Traced, trace
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.studies.rays import frame_width_mm
from neurolens.studies.records import ExactRecord, Timing, break_even_rays

# Rays of one pass: every batch size divides their number, and a pass's float32 inputs stay in the third-level cache.
POOL = 65536
BATCHES = (4096, 8192, 16384)
_SAMPLE_S = 0.001  # shortest time of a sample; short samples fit between the interruptions of a busy machine
_SAMPLES = 5  # samples of a round, of which the best counts
_PREPARING = 0.7  # about what share of a race's time preparation takes

Call = Callable[[], object]


class Unavailable(NeurolensError):
    """A candidate cannot run here; the message says why."""


@dataclass(frozen=True)
class Candidate:
    """Something that turns camera rays into scene rays.

    Attributes:
        name: for tables.
        prepare: takes the rays of one batch (float64, one film plane) and returns the call to be timed; conversions
            belong in here, off the clock. Raises `Unavailable` where the candidate cannot run.
        batches: batch sizes to choose from.
    """

    name: str
    prepare: Callable[[FilmRays], Call]
    batches: tuple[int, ...] = BATCHES


class Gain(NamedTuple):
    """A model's times, how many times as fast it is (by the minima), and after how many rays it pays off.

    They are None where one of the two was not timed; break_even_rays also where the model is no faster.
    """

    ns_per_ray: Timing | None
    speedup: float | None
    break_even_rays: float | None


@dataclass(frozen=True)
class Race:
    """Times of candidates that ran in turn.

    Attributes:
        ns: nanoseconds per ray of each round (the best of a few short samples), by candidate.
        batch: rays per call, the best number of those tried.
        unavailable: the reason, by candidate that could not run.
        load: the machine's load average before or after, whichever is higher, if known; above 1 the machine was shared.
    """

    ns: dict[str, list[float]]
    batch: dict[str, int]
    unavailable: dict[str, str] = field(default_factory=dict)
    load: float | None = None

    def timing(self, name: str) -> Timing | None:
        """Return best and median of the rounds; None where the candidate could not run."""
        if name not in self.ns:
            return None
        ns = self.ns[name]
        timing: Timing = {"min": min(ns), "median": statistics.median(ns), "threads": 1}
        return {**timing, "batch": self.batch[name], "repeats": len(ns)}

    def speedup(self, name: str, over: str) -> dict[str, float] | None:
        """Return how many times as fast as `over` a candidate is: "min" by minima, "median" of ratios within rounds."""
        if name not in self.ns or over not in self.ns:
            return None
        ratios = [b / a for a, b in zip(self.ns[name], self.ns[over], strict=True)]
        return {"min": min(self.ns[over]) / min(self.ns[name]), "median": statistics.median(ratios)}

    def gain(self, name: str, exact: str, fit_s: float | None, load_s: float | None) -> Gain:
        """Return the gain over an exact tracer of a model that took `fit_s` to fit and `load_s` to load."""
        timing, ratio, slow = self.timing(name), self.speedup(name, exact), self.timing(exact)
        pays = break_even_rays(fit_s, load_s, slow["min"], timing["min"]) if slow and timing else None
        return Gain(timing, ratio["min"] if ratio else None, pays)

    def record(self, name: str) -> ExactRecord:
        """Return the row for the list of exact tracers in `results.json`."""
        if name in self.unavailable:
            return {"name": name, "available": False, "reason": self.unavailable[name], "ns_per_ray": None}
        return {"name": name, "available": True, "ns_per_ray": self.timing(name)}


def race(
    candidates: Sequence[Candidate],
    domain: Domain,
    *,
    rounds: int = 20,
    report: Callable[[float], None] = lambda share: None,
) -> Race:
    """Time candidates in turn on the same rays of a domain; `report` is called with the fraction done.

    Raises:
        InputError: there are no rounds, or two candidates have one name.
    """
    names = [c.name for c in candidates]
    if rounds < 1 or len(set(names)) < len(names):
        raise InputError("race", "rounds, candidates", (rounds, names), "at least one round, and names that differ")
    unavailable: dict[str, str] = {}
    passes: dict[str, _Pass] = {}
    before = _load()
    rays = sample_domain(domain, POOL, seed=3)  # of the film plane nearest to the lens
    pool = replace(rays, film_z=torch.full_like(rays.film_z, domain.film_z_mm[0]))
    with pinned_threads(), torch.no_grad():
        for i, c in enumerate(candidates):
            try:
                passes[c.name] = _best_batch(c, pool)
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
    load = max((v for v in (before, _load()) if v is not None), default=None)
    return Race(ns, {n: p.batch for n, p in passes.items()}, unavailable, load)


@dataclass(frozen=True)
class _Pass:
    """The calls of one candidate that together do every ray of the pool once."""

    batch: int
    calls: tuple[Call, ...]

    def sample_ns(self, inner: int) -> float:
        """Return the nanoseconds of one pass, as the mean of `inner` passes in a row."""
        start = time.perf_counter_ns()
        for _ in range(inner):
            for call in self.calls:
                call()
        return max(time.perf_counter_ns() - start, 1) / inner


def _best_batch(candidate: Candidate, pool: FilmRays) -> _Pass:
    """Return one pass over the pool in the fastest of the candidate's batch sizes."""
    passes = []
    for batch in candidate.batches:
        calls = tuple(candidate.prepare(pool.select(slice(i, i + batch))) for i in range(0, len(pool), batch))
        passes.append(_Pass(batch, calls))
        passes[-1].sample_ns(1)
    if len(passes) == 1:
        return passes[0]
    return min(passes, key=lambda each: min(each.sample_ns(1) for _ in range(2 * _SAMPLES)))


def _load() -> float | None:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


# Names of the exact tracers: by torch, and as C.
EXACT = ("exact eager", "exact C")
EAGER_BATCHES = (8192, 16384, 32768)


def exact_candidate(lens: Lens, domain: Domain) -> Candidate:
    """Return torch's exact tracer in float32: every surface, stop, rims, transmittance and dispersion, status out."""

    def run(*columns: Any) -> Traced:
        *points, wavelength = columns
        fx, fy, fz, px, py = points
        return trace(lens, camera_rays(fx, fy, fz, px, py, domain.pupil_z_mm), wavelength, transmittance=True)

    return Candidate(EXACT[0], lambda rays: partial(run, *eager_arguments(rays)), EAGER_BATCHES)


def eager_arguments(rays: FilmRays) -> tuple[Any, ...]:
    """Return the columns of rays in float32, with one film plane, as in a picture."""
    fx, fy, fz, px, py, wavelength = (c.to(torch.float32).contiguous() for c in rays.columns())
    return fx, fy, fz[0].clone(), px, py, wavelength


def exact_c_candidate(lens: Lens, domain: Domain) -> Candidate:
    """Return the exact trace as C, by the writer and flags of the models, with which a model as C is compared."""
    return program_candidate(EXACT[1], lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm)), domain)


def exact_records(timed: Race) -> list[ExactRecord]:
    """Return records of the exact tracers that a race timed, or that could not run."""
    return [timed.record(name) for name in EXACT if name in timed.ns or name in timed.unavailable]


def camera_candidate(camera: Camera, domain: Domain, name: str | None = None) -> Candidate:
    """Return a camera of the renderer as a candidate: from film points and pupil samples to weighted rays."""

    def prepare(rays: FilmRays) -> Call:
        film = _float32(torch.stack([rays.film_x, rays.film_y]))
        pupil = _float32(torch.stack([rays.pupil_x, rays.pupil_y]) / (2 * domain.pupil_radius_mm) + 0.5)
        return partial(camera.sample, film, pupil, _float32(rays.wavelength_nm))

    return Candidate(name or camera.name, prepare)


def _float32(values: torch.Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(values.numpy(), dtype=np.float32)


def ideal_cameras(lens: Lens, domain: Domain) -> list[Candidate]:
    """Return a thin lens and a pinhole of the lens's focal length, named "thin lens" and "pinhole"."""
    data = first_order(lens)
    focal, width = abs(data.efl_mm), frame_width_mm(domain.film_radius_mm)
    frame = (width, width * 2 / 3)
    thin, pinhole = ThinLens(focal, data.f_number, math.inf, frame), Pinhole(focal, frame)
    return [camera_candidate(thin, domain, "thin lens"), camera_candidate(pinhole, domain, "pinhole")]


def model_candidate(name: str, model: OnnxLens, stop_radius_mm: float) -> Candidate:
    """Return an exported model that runs in onnxruntime on one thread."""

    def prepare(rays: FilmRays) -> Call:
        film_x, film_y, _, pupil_x, pupil_y, wavelength = map(_float32, rays.columns())
        film, pupil = np.stack([film_x, film_y]), np.stack([pupil_x, pupil_y])
        return partial(model.rays, film, pupil, wavelength, float(rays.film_z[0]), stop_radius_mm)

    return Candidate(name, prepare)


def model_candidates(files: Mapping[str, Path], domain: Domain) -> list[Candidate]:
    """Return each exported model to be timed in onnxruntime and, as "NAME fused", in C where a compiler is here."""
    candidates = []
    for name, file in files.items():
        candidates.append(model_candidate(name, load_model(file), domain.stop_radius_mm))
        fused = fused_candidate(f"{name} fused", file, domain)
        candidates += [fused] if fused else []
    return candidates


def time_model(model: OnnxLens, name: str, *, rounds: int) -> Timing | None:
    """Time an exported model over its domain, in nanoseconds per ray."""
    domain = Domain.from_dict(model.card["domain"])
    return race([model_candidate(name, model, domain.stop_radius_mm)], domain, rounds=rounds).timing(name)


# Inputs and results of a batch lie in the second-level cache.
FUSED_BATCHES = (2048, 4096, 8192, 16384)


def program_candidate(name: str, program: Program, domain: Domain) -> Candidate:
    """Return a program of a lens or a model as a candidate, which is compiled when the race prepares it."""
    numbers = {"film_z_mm": domain.film_z_mm[0], "stop_radius_mm": domain.stop_radius_mm}
    compiled = cache(lambda: CompiledGraph(program, dict.fromkeys(program.outputs, 1), numbers))
    room = cache(
        lambda count: compiled().room(count)
    )  # one pass after another uses it, as onnxruntime does with its own

    def prepare(rays: FilmRays) -> Call:
        film_x, film_y, _, pupil_x, pupil_y, wavelength = map(_float32, rays.columns())
        given = {"rays": np.stack([film_x, film_y, pupil_x, pupil_y, wavelength])}
        try:
            return compiled().prepared(given, room(len(rays)))
        except InputError as error:
            raise Unavailable(str(error)) from error

    return Candidate(name, prepare, FUSED_BATCHES)


def fused_candidate(name: str, file: Path, domain: Domain) -> Candidate | None:
    """Return the model of an exported file as compiled C; None without a compiler or a form in C."""
    try:
        program = fused_program([read_model(file).at()]) if has_compiler() else None
    except (ModelError, InputError):
        return None
    return None if program is None else program_candidate(name, program, domain)
