"""Speed in nanoseconds per ray, measured in races so that ratios mean something, and what may run in these.

Candidates run in turn, round after round, on one thread of one process, so that a machine that slows down slows all of
them; ratios are taken within rounds. Every candidate does the same rays, from one film plane as in a picture: uniform
over the film and over the pupil disc of the domain, also those that are blocked, because a render traces them, too.
Each candidate uses its fastest batch size.
"""

import ctypes
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
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError, ModelError, NeurolensError
from neurolens.base.files import TemporaryFolder
from neurolens.base.records import ExactRecord, Timing, break_even_rays
from neurolens.cameras.contract import Camera
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.cameras.model import OnnxLens, load_model
from neurolens.graph.c import Signature, in_double, literal, write_blocks, write_c, write_double
from neurolens.graph.compiler import FLAGS, compile_c, has_compiler
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


class CompiledSource:
    """A program as a shared library in a temporary folder of its own.

    Args:
        double: whether it computes in double precision, which is not for programs with lookups.
        state: of a program with a mixture, its numbers.

    Raises:
        Unavailable: there is no compiler, or it fails; the message says how.
    """

    def __init__(
        self, program: Program, flags: tuple[str, ...] = FLAGS, double: bool = False, state: Sequence[float] = ()
    ) -> None:
        self.signature, self._real = Signature.of(program, "lens"), np.float64 if double else np.float32
        self._folder = TemporaryFolder()
        library = Path(self._folder.name) / "lens.so"
        blocks = bool(program.own_tables)  # functions with lookups: loops over arrays do these apart
        if double:
            text = write_double(program, "lens", ["A timed model."]) + in_double(self._wrapper(False, state))
        else:
            text = write_blocks(program, "lens") if blocks else write_c(program, "lens", ["A timed model."])
            text += self._wrapper(blocks, state)
        try:
            self.warnings = compile_c(text, library, flags)
        except InputError as error:
            raise Unavailable(str(error)) from error
        self._run = ctypes.CDLL(str(library)).neurolens_run
        self._run.argtypes, self._run.restype = [ctypes.c_size_t, ctypes.c_void_p], None

    def _wrapper(self, blocks: bool, state: Sequence[float]) -> str:
        """Write a function that takes all arguments as one array of pointers, for ctypes is slow for each argument."""
        s = self.signature
        if blocks:
            first = len(s.per_ray)
            call, out = ", ".join(f"*(const float *)a[{k}]" for k in range(first, len(s.inputs))), len(s.inputs)
            given = f"(const float *const *)a, call, lens_table, lens_table_cells, (float *const *)(a + {out})"
            body = f"const float call[] = {{{call}}}; lens(n, {given}, (int *)a[{out + len(s.outputs)}]);"
            return f"void neurolens_run(size_t n, void **a) {{ {body} }}\n"
        kinds = ["(const float *)a[{}]"] * len(s.per_ray) + ["*(const float *)a[{}]"] * len(s.per_call)
        kinds += ["*(const int *)a[{}]"] * (s.bands > 1) + ["(float *)a[{}]"] * len(s.outputs) + ["(int *)a[{}]"]
        arguments, made = [kind.format(i) for i, kind in enumerate(kinds)], ""
        if s.state:
            arguments.insert(len(s.inputs), "&state")
            numbers = ", ".join(literal(v) for v in state)
            made = f"static lens_state state; if (!state.inside) state = lens_at({numbers}); "  # once
        return f"void neurolens_run(size_t n, void **a) {{ {made}lens_rays(n, {', '.join(arguments)}); }}\n"

    def outputs(self, count: int) -> dict[str, NDArray[Any]]:
        """Return arrays for the results of `count` rays."""
        found: dict[str, NDArray[Any]] = {name: np.empty(count, self._real) for name in self.signature.outputs}
        return {**found, "status": np.empty(count, np.int32)}

    def prepared(self, inputs: Mapping[str, ArrayLike], out: Mapping[str, NDArray[Any]], band: int = 0) -> Call:
        """Return a call that computes rays into `out`; inputs go by name, arrays [N] or numbers, others are ignored."""
        s = self.signature
        count = len(out["status"])
        arrays = [np.ascontiguousarray(inputs[name], self._real) for name in (*s.per_ray, *s.per_call)]
        if any(a.shape != (count,) for a in arrays[: len(s.per_ray)]):
            raise ValueError("inputs and outputs of one length expected")
        arrays += [np.array([band], np.int32)] if s.bands > 1 else []
        arrays += [*(out[name] for name in s.outputs), out["status"]]
        pointers = (ctypes.c_void_p * len(arrays))(*(a.ctypes.data for a in arrays))
        run, size = self._run, ctypes.c_size_t(count)

        def call(kept: Any = arrays) -> None:
            run(size, pointers)

        return call

    def rays(self, inputs: Mapping[str, ArrayLike], band: int = 0) -> dict[str, NDArray[Any]]:
        """Return the results of rays by name, the status among them."""
        out = self.outputs(len(np.asarray(inputs[self.signature.per_ray[0]])))
        self.prepared(inputs, out, band)()
        return out


# Inputs and results of a batch lie in the second-level cache.
FUSED_BATCHES = (2048, 4096, 8192, 16384)


def program_candidate(
    name: str, program: Program, domain: Domain, stop_radius_mm: float | None = None, flags: tuple[str, ...] = FLAGS,
    double: bool = False,
) -> Candidate:  # fmt: skip
    """Return a program of `models.source` as a candidate, which is compiled when the race prepares it.

    Args:
        stop_radius_mm: None takes the stop of the domain.
    """
    compiled = cache(lambda: CompiledSource(program, flags, double))

    @cache
    def room(count: int) -> dict[str, NDArray[Any]]:
        """Return memory for outputs, which one pass after another uses, as tracers and onnxruntime do with theirs."""
        return compiled().outputs(count)

    def prepare(rays: FilmRays) -> Call:
        names = ("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
        columns: dict[str, Any] = {n: c.numpy().astype(np.float32) for n, c in zip(names, rays.columns(), strict=False)}
        columns["film_z_mm"] = columns["film_z_mm"][0]
        columns["stop_radius_mm"] = np.float32(domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm)
        return compiled().prepared(columns, room(len(rays)))

    return Candidate(name, prepare, FUSED_BATCHES)


def fused_candidate(name: str, file: Path, domain: Domain) -> Candidate | None:
    """Return the model of an exported file as compiled C; None without a compiler or a form in C."""
    try:
        program = fused_program([read_model(file).at()]) if has_compiler() else None
    except (ModelError, InputError):
        return None
    return None if program is None else program_candidate(name, program, domain)
