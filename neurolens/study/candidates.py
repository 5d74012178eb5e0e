"""Candidates of speed races (`speed`): the exact tracer eager and compiled, exported models, and simple cameras."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from threading import get_ident
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError, ModelError
from neurolens.base.files import TemporaryFolder
from neurolens.base.records import ExactRecord, Timing
from neurolens.cameras.contract import Camera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import OnnxLens, load_model
from neurolens.cameras.pinhole import Pinhole
from neurolens.graph.c import Signature, write_blocks, write_c
from neurolens.graph.compiler import FLAGS, compile_c, has_compiler
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays
from neurolens.study.rays import frame_width_mm
from neurolens.study.speed import Call, Candidate, Race, Unavailable, race
from neurolens.surrogates.assemble import ALL, Parts
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.file import read_model
from neurolens.surrogates.model import Domain, LensModel
from neurolens.surrogates.source import FREE, Fix, fused_program
from neurolens.trace.rays import Traced, compile_tracing, trace
from neurolens.trace.tracegraph import exact_graph

# Names of `exact_candidates` of a whole camera, and of `exact_c_candidate`.
EXACT = ("exact eager", "exact compiled", "exact C")
EAGER_BATCHES = (8192, 16384, 32768)
COMPILED_BATCHES = (16384,)  # each further size costs half a minute of compilation


def exact_candidates(
    lens: Lens,
    domain: Domain,
    *,
    transmittance: bool = True,
    build_rays: bool = True,
    compiled: bool = True,
    label: str = "exact",
) -> list[Candidate]:
    """The exact tracer in float32, eager and compiled: every surface, stop, rims and dispersion, status out.

    Args:
        transmittance: whether to follow it, as surrogates do.
        build_rays: start from film and pupil points, as surrogates do; else from camera rays made beforehand.
        compiled: whether to include the compiled one.
        label: names are "{label} eager" and "{label} compiled".
    """

    def tracing(rays: Any, wavelength: Any) -> Traced:
        return trace(lens, rays, wavelength, transmittance=transmittance)

    def whole(fx: Any, fy: Any, fz: Any, px: Any, py: Any, wavelength: Any) -> Traced:
        return tracing(camera_rays(fx, fy, fz, px, py, domain.pupil_z_mm), wavelength)

    def arguments(rays: FilmRays) -> tuple[Any, ...]:
        fx, fy, fz, px, py, wavelength = (c.to(torch.float32).contiguous() for c in rays.columns())
        fz = fz[0].clone()  # one film plane, as in a picture
        places = fx, fy, fz, px, py
        return (*places, wavelength) if build_rays else (camera_rays(*places, domain.pupil_z_mm), wavelength)

    run: Callable[..., Traced] = whole if build_rays else tracing
    fast = compile_tracing(run, fullgraph=True)

    def faster(rays: FilmRays) -> Call:
        given = arguments(rays)
        try:
            fast(*given)
        except Exception as error:  # of many types: no compiler, a compiler that fails, an unsupported platform
            raise Unavailable(f"torch cannot compile here: {_first_line(error)}") from error
        return partial(fast, *given)

    found = [Candidate(f"{label} eager", lambda rays: partial(run, *arguments(rays)), EAGER_BATCHES)]
    return [*found, Candidate(f"{label} compiled", faster, COMPILED_BATCHES)] if compiled else found


def exact_c_candidate(lens: Lens, domain: Domain) -> Candidate:
    """The exact trace as C, by the same writer and flags as the models: what a model as C is to be held against."""
    graph = exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm)
    return program_candidate(EXACT[2], lower(graph), domain)


def exact_records(timed: Race) -> list[ExactRecord]:
    """Those of the exact tracers that a race timed, or that could not run."""
    return [timed.record(name) for name in EXACT if name in timed.ns or name in timed.unavailable]


def _first_line(error: BaseException) -> str:
    # Torch wraps the reason: the innermost cause is the informative one.
    while error.__cause__ is not None:
        error = error.__cause__
    text = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {text}"[:200]


def camera_candidate(camera: Camera, domain: Domain, name: str | None = None) -> Candidate:
    """A camera of the renderer (thin lens, pinhole), from film points and pupil samples to weighted scene rays."""

    def prepare(rays: FilmRays) -> Call:
        film = np.ascontiguousarray(torch.stack([rays.film_x, rays.film_y]).numpy(), dtype=np.float32)
        square = torch.stack([rays.pupil_x, rays.pupil_y]) / (2 * domain.pupil_radius_mm) + 0.5
        pupil = np.ascontiguousarray(square.numpy(), dtype=np.float32)
        return partial(camera.sample, film, pupil, rays.wavelength_nm.numpy().astype(np.float32))

    return Candidate(name or camera.name, prepare)


def ideal_cameras(lens: Lens, domain: Domain) -> list[Candidate]:
    """Thin lens and pinhole of the lens's focal length, named "thin lens" and "pinhole"."""
    data = first_order(lens)
    focal, width = abs(data.efl_mm), frame_width_mm(domain.film_radius_mm)
    frame = (width, width * 2 / 3)
    thin, pinhole = ThinLens(focal, data.f_number, math.inf, frame), Pinhole(focal, frame)
    return [camera_candidate(thin, domain, "thin lens"), camera_candidate(pinhole, domain, "pinhole")]


def model_candidate(name: str, model: OnnxLens, stop_radius_mm: float) -> Candidate:
    """An exported model, loaded with one thread: the race shares out batches."""

    def prepare(rays: FilmRays) -> Call:
        columns = [np.ascontiguousarray(c.numpy(), dtype=np.float32) for c in rays.columns()]
        film, pupil, film_z_mm = np.stack(columns[0:2]), np.stack(columns[3:5]), float(rays.film_z[0])
        return partial(model.rays, film, pupil, columns[5], film_z_mm, stop_radius_mm)

    return Candidate(name, prepare)


def model_candidates(files: Mapping[str, Path], domain: Domain, threads: int = 1) -> list[Candidate]:
    """Exported models by name, in onnxruntime; and on one thread "NAME fused", as C, where that is possible."""
    found: list[Candidate | None] = []
    for name, file in files.items():
        found.append(model_candidate(name, load_model(file), domain.stop_radius_mm))
        found += [fused_candidate(f"{name} fused", file, domain)] if threads == 1 else []
    return [candidate for candidate in found if candidate is not None]


def time_model(model: OnnxLens, name: str, *, rounds: int, threads: int = 1) -> Timing | None:
    """Nanoseconds per ray of an exported model over its domain."""
    domain = Domain.from_dict(model.card["domain"])
    return race([model_candidate(name, model, domain.stop_radius_mm)], domain, threads=threads, rounds=rounds).timing(
        name
    )


class CompiledSource:
    """A program as a shared library in its own temporary folder.

    Raises:
        Unavailable: there is no compiler, or it fails; the message says how.
    """

    def __init__(self, program: Program, flags: tuple[str, ...] = FLAGS) -> None:
        self.signature = Signature.of(program, "lens")
        self._folder = TemporaryFolder()
        library = Path(self._folder.name) / "lens.so"
        blocks = bool(program.own_tables)  # lookups: loops of arrays have them apart
        text = write_blocks(program, "lens") if blocks else write_c(program, "lens", ["A timed model."])
        text += self._wrapper(blocks)
        try:
            self.warnings = compile_c(text, library, flags)
        except InputError as error:
            raise Unavailable(str(error)) from error
        self._run = ctypes.CDLL(str(library)).neurolens_run
        self._run.argtypes, self._run.restype = [ctypes.c_size_t, ctypes.c_void_p], None

    def _wrapper(self, blocks: bool) -> str:
        """All arguments as one array of pointers: ctypes is slow per argument."""
        s = self.signature
        if blocks:
            first = len(s.per_ray)
            call, out = ", ".join(f"*(const float *)a[{k}]" for k in range(first, len(s.inputs))), len(s.inputs)
            given = f"(const float *const *)a, call, lens_table, lens_table_cells, (float *const *)(a + {out})"
            body = f"const float call[] = {{{call}}}; lens(n, {given}, (int *)a[{out + len(s.outputs)}]);"
            return f"void neurolens_run(size_t n, void **a) {{ {body} }}\n"
        kinds = ["(const float *)a[{}]"] * len(s.per_ray) + ["*(const float *)a[{}]"] * len(s.per_call)
        kinds += ["*(const int *)a[{}]"] * (s.bands > 1) + ["(float *)a[{}]"] * len(s.outputs) + ["(int *)a[{}]"]
        given = ", ".join(kind.format(i) for i, kind in enumerate(kinds))
        return f"void neurolens_run(size_t n, void **a) {{ lens_rays(n, {given}); }}\n"

    def outputs(self, count: int) -> dict[str, NDArray[Any]]:
        """Arrays for the results of so many rays."""
        found: dict[str, NDArray[Any]] = {name: np.empty(count, np.float32) for name in self.signature.outputs}
        return {**found, "status": np.empty(count, np.int32)}

    def prepared(self, inputs: Mapping[str, ArrayLike], out: Mapping[str, NDArray[Any]], band: int = 0) -> Call:
        """A call that computes rays into `out`; inputs by name, arrays [N] or numbers; others are ignored."""
        s = self.signature
        count = len(out["status"])
        arrays = [np.ascontiguousarray(inputs[name], np.float32) for name in (*s.per_ray, *s.per_call)]
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
        """Results of rays, by name, status among them."""
        out = self.outputs(len(np.asarray(inputs[self.signature.per_ray[0]])))
        self.prepared(inputs, out, band)()
        return out


# Inputs and results of a batch lie in the second-level cache.
FUSED_BATCHES = (2048, 4096, 8192, 16384)


def program_candidate(
    name: str,
    program: Program,
    domain: Domain,
    stop_radius_mm: float | None = None,
    flags: tuple[str, ...] = FLAGS,
) -> Candidate:
    """A program of `surrogates.source`, compiled when the race prepares it; no stop radius: the domain's."""
    compiled = cache(lambda: CompiledSource(program, flags))
    room: dict[tuple[int, int], dict[str, NDArray[Any]]] = {}

    def prepare(rays: FilmRays) -> Call:
        source = compiled()
        names = ("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
        columns: dict[str, Any] = {n: c.numpy().astype(np.float32) for n, c in zip(names, rays.columns(), strict=False)}
        columns["film_z_mm"] = columns["film_z_mm"][0]
        columns["stop_radius_mm"] = np.float32(domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm)
        count = len(rays)
        calls: dict[int, Call] = {}

        def call() -> None:
            # A thread reuses its output memory, as tracers and onnxruntime do.
            thread = get_ident()
            if thread not in calls:
                if (thread, count) not in room:
                    room[thread, count] = source.outputs(count)
                calls[thread] = source.prepared(columns, room[thread, count])
            calls[thread]()

        return call

    return Candidate(name, prepare, FUSED_BATCHES)


def fused_candidate(
    name: str, model: LensModel | Sequence[LensModel] | Path, domain: Domain, *, parts: Parts = ALL, fix: Fix = FREE
) -> Candidate | None:
    """A model, or that of an exported file, as compiled C; None without a compiler or a form in C.

    Of a model for each fixed wavelength the first is timed.
    """
    if not has_compiler():
        return None
    try:
        found = read_model(model).at() if isinstance(model, Path) else model
        models = [found] if isinstance(found, LensModel) else found
        program = fused_program(models, parts, fix)
    except (ModelError, InputError):
        return None
    return program_candidate(name, program, domain, fix.stop_radius_mm)
