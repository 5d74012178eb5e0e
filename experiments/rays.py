"""An open benchmark of lens rays: the error and the time of tracers and models, ours and others, on the same rays.

Rules. A row is a program that takes film points to scene rays; whoever adds one writes an adapter of about 20 lines
(`ray_peers`).

1. Lens: a table of lenses/, of spheres and even aspheres, every rim kept, at the d line (587.56 nm). Others get our
   indices.
2. Rays: 100,000 through points uniform over the film's disc and points uniform over a disc on the pupil plane, blocked
   ones included, by `numpy.random.default_rng(36)`. Discs and planes are those of the lens's models, the film lies in
   the focus of infinity; the page states them. Programs slower than 0.2 us a ray may do the first 20,000 alone, those
   slower than 10 us the first 500.
3. Answer: a point on the scene ray, its direction, and whether light passes every surface, rim and the stop.
4. Error: against our trace in float64, RMS over the rays that both pass: of direction (urad); of position (um), the
   distance of the ray from our point on the front surface; on the film (um), direction times focal length. "Other" is
   the share of rays that one passes and the other blocks.
5. Time: processor time of all threads, ns a ray, minimum (and median) of at least 10 rounds in which all rows of a lens
   take turns in one process, after a round that does not count. One thread. Each row takes its best batch. The clock
   starts with arrays of film and pupil points, or of starts and directions, in the row's own type and order, and stops
   with arrays of the answers, in its own, too. A row that answers more (transmittance) is named as such.
6. The page states machine, instruction set, versions, and the precision of each row. All its rows come from one run.
7. What was tried has a row; what could not run says why.

Writes rays.md, rays.json and rays.png. Other programs run where they are installed: see `ray_peers`.
"""

from __future__ import annotations

import argparse
import inspect
import math
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments import lab
from experiments.ray_peers import ABSENT, PEERS, WAVELENGTH_NM, Found, Prepared, Task, table_of
from experiments.tracer_race import has_avx512
from neurolens.analysis.plots import drawing, plain_log_ticks
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxlens import BATCH
from neurolens.graph.compiler import FLAGS, find_compiler, has_compiler
from neurolens.graph.ir import pruned
from neurolens.graph.program import SCENE_RAY
from neurolens.graph.scalars import lower
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays
from neurolens.study.speed import CompiledSource, Unavailable
from neurolens.surrogates.file import read_model
from neurolens.surrogates.model import Domain
from neurolens.surrogates.source import fused_program
from neurolens.surrogates.terms import pinned_threads
from neurolens.trace.rays import compile_tracing, trace
from neurolens.trace.tracegraph import exact_graph

COUNT, SEED, LEAST_S = 100_000, 36, 0.004  # rays, their seed, and the least time of a sample
CASES = {  # lens: its models
    "laikin_double_gauss_50": ("ols-36", "mlp-16x2"),
    "canon_aspheric_50": ("ols-64", "mlp-16x2"),
    "thorlabs_lb1471_biconvex_50": ("ols-64", "mlp-16x2"),
}
C_BATCHES, ONNX_BATCHES, TORCH_BATCHES = (2000, 4000, 10000, 20000), (8192, BATCH), (10000, 20000, 50000)
TITLE, COMMAND = "# An open benchmark of lens rays", "`python -m experiments rays`"
FAMILIES = {"exact, ours": "tab:blue", "model, ours": "tab:green", "others": "tab:red"}
PACKAGES = ("optiland", "rayoptics", "deeplens-core")


@dataclass(frozen=True)
class Entry:
    """A candidate: what `ray_peers.Peer` has, and its family."""

    family: str
    name: str
    precision: str
    adapter: Callable[[Task], Prepared]
    batches: tuple[int, ...]
    most: int = COUNT

    @property
    def key(self) -> str:
        return f"{self.name}, {self.precision}"


@dataclass
class Row:
    """A row: minimum, median, batch and rounds in `ns`, what rule 4 wants in `errors`; or why there are none."""

    lens: str
    family: str
    name: str
    precision: str
    ns: dict[str, float] | None = None
    errors: dict[str, float] | None = None
    reason: str | None = None


def task_of(name: str, count: int = COUNT) -> Task:
    """The rays of a lens, by rules 1 and 2."""
    lens = lab.lens_of(name)
    domain = Domain.from_dict(load_model(lab.MODELS / f"{name}.{CASES[name][0]}.onnx").card["domain"])
    u = np.random.default_rng(SEED).random((4, count))
    film, pupil = (
        radius * np.sqrt(u[i]) * np.stack([np.cos(2 * math.pi * u[i + 1]), np.sin(2 * math.pi * u[i + 1])])
        for i, radius in ((0, domain.film_radius_mm), (2, domain.pupil_radius_mm))
    )
    points = (torch.from_numpy(c) for c in (*film, *pupil))
    fx, fy, px, py = points
    start = camera_rays(fx, fy, torch.full_like(fx, domain.film_z_mm[0]), px, py, domain.pupil_z_mm)
    numbers = np.stack([c.numpy() for c in start])
    z = domain.film_z_mm[0], domain.pupil_z_mm
    return Task(table_of(lens), film, pupil, *z, numbers[:3], numbers[3:], lens, domain)


# ---- Ours. -----------------------------------------------------------------------------------------------------------


def in_torch(run: Callable[..., Any], dtype: torch.dtype) -> Callable[[Task], Prepared]:
    """The tracer in torch, eager or compiled."""

    def adapter(task: Task) -> Prepared:
        fx, fy, px, py = (torch.from_numpy(np.ascontiguousarray(c)).to(dtype) for c in (*task.film, *task.pupil))
        z, wavelength = torch.full_like(fx, task.film_z), torch.tensor(WAVELENGTH_NM, dtype=dtype)

        def call() -> Any:
            with torch.no_grad():
                return run(task.lens, fx, fy, z, px, py, task.pupil_z, wavelength)

        return call, lambda out: Found(*split(torch.stack(out.rays).numpy()), out.status.numpy() == 0)

    return adapter


def whole_trace(lens: Lens, fx: Any, fy: Any, fz: Any, px: Any, py: Any, pupil_z: float, wavelength: Any) -> Any:
    return trace(lens, camera_rays(fx, fy, fz, px, py, pupil_z), wavelength)


def too_long(task: Task) -> Prepared:
    raise Unavailable("torch takes minutes to compile these aspheres")


def split(ray: Any) -> tuple[Any, Any]:
    return ray[:3], ray[3:]


def as_c(made: Callable[[], CompiledSource]) -> Callable[[Task], Prepared]:
    """A program as C; `made` compiles it."""

    def adapter(task: Task) -> Prepared:
        source, count = made(), task.film.shape[1]
        columns = {"film_x_mm": task.film[0], "film_y_mm": task.film[1], "film_z_mm": task.film_z}
        columns |= {"pupil_x_mm": task.pupil[0], "pupil_y_mm": task.pupil[1]}
        columns |= {"wavelength_nm": np.full(count, WAVELENGTH_NM), "stop_radius_mm": task.domain.stop_radius_mm}
        out = source.outputs(count)
        call = source.prepared(columns, out)
        return call, lambda _: Found(*split(np.stack([out[name] for name in SCENE_RAY])), out["status"] == 0)

    return adapter


def in_onnxruntime(file: Path) -> Callable[[Task], Prepared]:
    """An exported model in onnxruntime."""
    model = load_model(file)

    def adapter(task: Task) -> Prepared:
        film, pupil = task.film.astype(np.float32), task.pupil.astype(np.float32)
        wavelength = np.full(film.shape[1], WAVELENGTH_NM, np.float32)
        call = partial(model.rays, film, pupil, wavelength, task.film_z, task.domain.stop_radius_mm)
        return call, lambda out: Found(*split(out.scene_ray), out.status == 0)

    return adapter


def ours(name: str, task: Task, compiled: bool) -> list[Entry]:
    """Our rows for a lens."""
    lens, domain = task.lens, task.domain
    exact, model = "exact, ours", "model, ours"
    found = [
        Entry(exact, "torch", str(dtype).removeprefix("torch."), in_torch(whole_trace, dtype), TORCH_BATCHES)
        for dtype in (torch.float64, torch.float32)
    ]
    if compiled:
        run = (
            too_long if any(s.asphere for s in lens.surfaces) else in_torch(compile_tracing(whole_trace), torch.float32)
        )
        found.append(Entry(exact, "torch, compiled", "float32", run, (20000,)))

    @cache
    def ray_alone() -> CompiledSource:
        graph = exact_graph(lens, domain.pupil_z_mm, (WAVELENGTH_NM, WAVELENGTH_NM))
        return CompiledSource(lower(pruned(graph, {k: graph.outputs[k] for k in ("scene_ray", "status")})))

    @cache
    def whole() -> CompiledSource:
        return CompiledSource(lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm)))

    found.append(Entry(exact, "C", "float32", as_c(ray_alone), C_BATCHES))
    found.append(Entry(exact, "C, with dispersion and transmittance", "float32", as_c(whole), C_BATCHES))
    for kind in CASES[name]:
        file = lab.MODELS / f"{name}.{kind}.onnx"
        source = cache(lambda file=file: CompiledSource(fused_program([read_model(file).at()])))
        found.append(Entry(model, f"{kind}, C", "float32", as_c(source), C_BATCHES))
        found.append(Entry(model, f"{kind}, onnxruntime", "float32", in_onnxruntime(file), ONNX_BATCHES))
    return found


# ---- The race. -------------------------------------------------------------------------------------------------------


def errors(found: Found, exact: Found, focal_mm: float) -> dict[str, float]:
    """The figures of rule 4."""
    passes = found.passes & np.isfinite(found.way).all(0)
    both = passes & exact.passes
    point, way, p0, d0 = (a[:, both].astype(np.float64) for a in (found.point, found.way, exact.point, exact.way))
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(way - d0, axis=0) / 2, 1))
    away = np.linalg.norm(np.cross(point - p0, d0, axis=0), axis=0)
    rms = {name: math.sqrt(float((v * v).mean())) for name, v in (("direction_urad", angle), ("position_um", away))}
    rms = {"direction_urad": 1e6 * rms["direction_urad"], "position_um": 1e3 * rms["position_um"]}
    other = float((passes != exact.passes).mean())
    return {"film_um": 1e-3 * abs(focal_mm) * rms["direction_urad"], **rms, "other": other, "rays": len(passes)}


def reference(task: Task) -> Found:
    """The trace of rule 4."""
    call, read = in_torch(whole_trace, torch.float64)(task)
    return read(call())


def answer(entry: Entry, task: Task, batch: int) -> Found:
    """What an entry answers to the rays, batch by batch."""
    parts = []
    for first in range(0, min(entry.most, task.film.shape[1]), batch):
        call, read = entry.adapter(task.part(first, batch))
        parts.append(read(call()))
    return Found(*(np.concatenate(each, -1) for each in zip(*parts, strict=True)))


def best_pass(entry: Entry, task: Task) -> tuple[int, Callable[[], int]]:
    """The fastest batch, and a function that does the rays in such batches often enough and returns how many it did."""
    found = []
    for batch in entry.batches:
        calls = [entry.adapter(task.part(k, batch))[0] for k in range(0, entry.most, batch)]

        def once(calls: Sequence[Callable[[], Any]] = calls) -> float:
            began = time.process_time()
            for call in calls:
                call()
            return time.process_time() - began

        first = once()
        took = once() if first > 1 else min(once() for _ in range(4))
        found.append((took, batch, calls))
    took, batch, calls = min(found, key=lambda each: each[0])
    repeats = max(1, math.ceil(LEAST_S / max(took, 1e-6)))

    def run() -> int:
        for _ in range(repeats):
            for call in calls:
                call()
        return repeats * entry.most

    return batch, run


def measure(name: str, rounds: int, compiled: bool, report: lab.Report) -> list[Row]:
    """Race everything through one lens."""
    task = task_of(name)
    exact, focal = reference(task), first_order(task.lens).efl_mm
    field = ours(name, task, compiled)
    field += [Entry("others", p.name, p.precision, p.adapter, p.batches, p.most) for p in PEERS]
    rows = {e.key: Row(name, e.family, e.name, e.precision) for e in field}
    runs: dict[str, Callable[[], int]] = {}
    batch: dict[str, int] = {}
    with pinned_threads():
        torch._dynamo.reset()
        for k, entry in enumerate(field):
            try:
                batch[entry.key], runs[entry.key] = best_pass(entry, task)
                found = answer(entry, task, batch[entry.key])
                first = Found(*(a[..., : len(found.passes)] for a in exact))
                rows[entry.key].errors = errors(found, first, focal)
            except Unavailable as reason:
                rows[entry.key].reason = str(reason)
            report(0.6 * (k + 1) / len(field))
        times = lab.cpu_ns(runs, rounds, lambda done, left=None: report(0.6 + 0.4 * done, left))
    for key, ns in times.items():
        rows[key].ns = {"min": min(ns), "median": float(np.median(ns)), "batch": batch[key], "rounds": len(ns)}
    return [*rows.values(), *(Row(name, "others", n, "", reason=why) for n, why in ABSENT.items())]


# ---- Page and plot. --------------------------------------------------------------------------------------------------


def _figure(key: str) -> Callable[[Row], str | None]:
    return lambda r: None if r.errors is None else f"{r.errors[key]:.2g}"


_COLUMNS = lab.columns(
    ("program", "name"),
    ("precision", "precision"),
    (
        "ns a ray",
        lambda r: lab.best_median(r.ns["min"], r.ns["median"], form=".3g") if r.ns else f"not run: {r.reason}",
    ),
    ("batch", lambda r: r.ns and format(r.ns["batch"], ".0f")),
    ("film um", _figure("film_um")),
    ("direction urad", _figure("direction_urad")),
    ("position um", _figure("position_um")),
    ("other, %", lambda r: None if r.errors is None else f"{100 * r.errors['other']:.2g}"),
)
_NOTES = """\
{line}
Instruction set of C: {vectors}, by {compiler} {flags}; of torch: {torch}.
{packages} {rounds} rounds, load average up to {load:.1f} on {cores} cores; times are of the processor, minimum (median
in brackets). A pixel is 5 um."""
_READING = """\
Models, the exact lens in C "with dispersion and transmittance" and the tracer written by hand answer with the
transmittance, too; the last takes the mean of both polarisations. Slow rows did the first 20,000 rays
(Optiland, DeepLens) or 500 (ray-optics). The cards of the singlet's models call them poor. Whoever knows a faster way
to call one of the others is asked to say so."""


def versions() -> str:
    """Versions of the packages of others that are here."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return f"Others: {', '.join(found)}." if found else ""


def page(rows: Sequence[Row], known: Mapping[str, Any]) -> str:
    """The table of every lens, the plot, the rules."""
    parts = []
    for name in dict.fromkeys(r.lens for r in rows):
        parts += [f"## {known['lenses'][name]['title']}", known["lenses"][name]["rays"]]
        mine = sorted((r for r in rows if r.lens == name), key=lambda r: (r.ns is None, r.ns["min"] if r.ns else 0))
        parts.append(lab.table(_COLUMNS, mine))
    rules = (inspect.getdoc(inspect.getmodule(page)) or "").partition("Rules. ")[2].partition("\n\nWrites")[0]
    plot = "![Error against time, a point a program](rays.png)"
    return lab.page(TITLE, COMMAND, _NOTES.format(**known), plot, *parts, _READING, "## Rules", rules)


def description(name: str) -> dict[str, str]:
    """What a page says of a lens and its rays."""
    task = task_of(name, 20000)
    d, passing = task.domain, float(reference(task).passes.mean())
    rays = (
        f"Film disc {d.film_radius_mm:.4g} mm at z = {task.film_z:.6f}, pupil disc {d.pupil_radius_mm:.6f} mm at "
        f"z = {task.pupil_z:.6f} (front vertex at 0, mm); {100 * passing:.0f}% of the rays pass."
    )
    return {"title": f"{task.lens.name}, {task.lens.refractions} refractions (`{name}`)", "rays": rays}


def draw(rows: Sequence[Row], known: Mapping[str, Any], file: Path) -> None:
    """Error on the film against time, a panel a lens."""
    names = list(dict.fromkeys(r.lens for r in rows))
    floor = 1e-11  # um; the trace that all are compared with has no error, and a logarithm none
    with drawing(file, 5.6 * len(names), 6.4) as figure:
        panels = figure.subplots(1, len(names), squeeze=False)[0]
        for name, panel in zip(names, panels, strict=True):
            timed = [(row.ns["min"], row) for row in rows if row.lens == name and row.ns]
            for k, (x, row) in enumerate(sorted(timed, key=lambda pair: pair[0])):
                assert row.errors
                y, colour = max(row.errors["film_um"], floor), FAMILIES[row.family]
                panel.plot(x, y, "s" if row.precision == "float64" else "o", color=colour, markersize=4)
                panel.annotate(f"{k + 1}", (x, y), (2, 4 if k % 2 else -9), textcoords="offset points", color=colour)
                place = 0.03, 0.02 + 0.028 * (len(timed) - 1 - k)
                panel.text(*place, f"{k + 1}  {row.name}", transform=panel.transAxes, fontsize=7, color=colour)
            panel.set(xscale="log", yscale="log", xlabel="ns a ray, one thread", title=known["lenses"][name]["title"])
            plain_log_ticks(panel.xaxis, panel.yaxis)
            panel.title.set_fontsize(8)
            panel.grid(alpha=0.3)
            panel.margins(0.2)
        panels[0].set_ylabel("RMS error on the film, um (1e-11: the reference itself)")
        for family, colour in FAMILIES.items():
            panels[0].plot([], [], "o", color=colour, label=family)
        panels[0].plot([], [], "s", color="grey", label="float64 (others float32)")
        panels[0].legend(fontsize=7, loc="upper right")


OPTIONS = (
    lab.option("--quick", action="store_true", help="without the tracer that torch compiles"),
    lab.ONLY,
    lab.count("rounds", 12, "rounds (default 12)", least=10),
    lab.out(),
)


def facts(rounds: int, load: float) -> dict[str, Any]:
    """What rule 6 wants, and how C was compiled."""
    compiler = Path(find_compiler()).name if has_compiler() else "no compiler"
    known: dict[str, Any] = {
        "machine": lab.machine(),
        "line": lab.machine_line(),
        "vectors": "AVX-512" if has_avx512() else "AVX2",
    }
    known |= {"compiler": compiler, "flags": " ".join(FLAGS), "packages": versions(), "rounds": rounds, "load": load}
    return known | {"torch": torch.backends.cpu.get_cpu_capability(), "cores": os.cpu_count()}


def run(args: argparse.Namespace) -> None:
    """Race lens by lens, then write page and plot."""
    lab.quiet_glasses()
    warnings.simplefilter("ignore")
    cases = lab.chosen(list(CASES), lambda c: c, args.only, "rays")
    rows, load, text, known = list[Row](), 0.0, "", dict[str, Any]()
    for name, report in lab.stages(cases, lambda c: c, args.quiet, 60.0):
        rows += measure(name, args.rounds, not args.quick, report)
        load = max(load, os.getloadavg()[0])
        known = facts(args.rounds, load) | {"lenses": {n: description(n) for n in dict.fromkeys(r.lens for r in rows)}}
        text = lab.write_results(args.out, "rays", page(rows, known), {**known, "rows": rows})
    draw(rows, known, args.out / "rays.png")
    print(text)
