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
import json
import math
import os
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments import lab
from experiments.peers.ray_peers import ABSENT, PEERS, WAVELENGTH_NM, Found, Peer, Prepared, Task, table_of
from experiments.speed.compiled_source import CompiledSource
from experiments.speed.tracer_race import has_avx512
from neurolens.base.files import cache_folder
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxlens import BATCH
from neurolens.graph.compiler import FLAGS, find_compiler, has_compiler
from neurolens.graph.ir import pruned
from neurolens.graph.program import SCENE_RAY
from neurolens.graph.scalars import lower
from neurolens.models.file import read_model
from neurolens.models.fitted import Domain
from neurolens.models.source import fused_program
from neurolens.models.terms import pinned_threads
from neurolens.optics.analysis.plots import drawing, plain_log_ticks
from neurolens.optics.lens import glass
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.shapes import centred, start_of
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.studies.plots import place_labels
from neurolens.studies.speed import Unavailable

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


def in_torch(run: Callable[..., Any], dtype: torch.dtype, device: str = "cpu") -> Callable[[Task], Prepared]:
    """The tracer in torch, eager or compiled."""

    def adapter(task: Task) -> Prepared:
        columns = (torch.from_numpy(np.ascontiguousarray(c)) for c in (*task.film, *task.pupil))
        fx, fy, px, py = (c.to(device, dtype) for c in columns)
        z, wavelength = torch.full_like(fx, task.film_z), torch.tensor(WAVELENGTH_NM, dtype=dtype, device=device)

        def call() -> Any:
            with torch.no_grad():
                return run(task.lens, fx, fy, z, px, py, task.pupil_z, wavelength)

        return call, lambda out: Found(*split(torch.stack(out.rays).cpu().numpy()), out.status.cpu().numpy() == 0)

    return adapter


def whole_trace(lens: Lens, fx: Any, fy: Any, fz: Any, px: Any, py: Any, pupil_z: float, wavelength: Any) -> Any:
    return trace(lens, camera_rays(fx, fy, fz, px, py, pupil_z), wavelength)


def compile_tracing(run: Callable[..., Any], lens: Lens | None = None, fullgraph: bool = False) -> Callable[..., Any]:
    """Compile a function that traces rays through a lens with torch, with the prescription folded in as constants.

    Every new number of rays compiles anew, so call the result with batches of one length. Without a C++ compiler the
    first call raises torch's own error; `trace` itself needs none.

    What the compiler may take for constant is marked in here and not at import, because marking imports the compiler,
    which takes longer than a camera needs to start. Torch keeps the machine code that it makes, and runs what it finds:
    by default in a folder that every user of the machine can create. So its cache is moved into the user's own folder.
    """
    for surface in lens.surfaces if lens else ():  # read the catalogue now: compiled code cannot read files
        glass.index_of(surface, glass.LINE_D_NM)
    if "TORCHINDUCTOR_CACHE_DIR" not in os.environ:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(cache_folder("torch"))
    for constant in (start_of, centred):
        torch.compiler.assume_constant_result(constant)
    return torch.compile(run, dynamic=False, fullgraph=fullgraph)


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


def ours(name: str, task: Task, compiled: bool) -> list[Peer]:
    """Our rows for a lens."""
    lens, domain = task.lens, task.domain

    def exact(name: str, precision: str, adapter: Any, batches: tuple[int, ...] = C_BATCHES) -> Peer:
        return Peer(name, precision, adapter, batches, COUNT, "exact, ours")

    @cache
    def ray_alone() -> CompiledSource:
        graph = exact_graph(lens, domain.pupil_z_mm, (WAVELENGTH_NM, WAVELENGTH_NM))
        return CompiledSource(lower(pruned(graph, {k: graph.outputs[k] for k in ("scene_ray", "status")})))

    @cache
    def whole() -> CompiledSource:
        return CompiledSource(lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm)))

    rows = [
        exact("torch", str(dtype).removeprefix("torch."), in_torch(whole_trace, dtype), TORCH_BATCHES)
        for dtype in (torch.float64, torch.float32)
    ]
    if compiled:
        slow = any(s.figure.asphere for s in lens.surfaces)
        run = too_long if slow else in_torch(compile_tracing(whole_trace), torch.float32)
        rows.append(exact("torch, compiled", "float32", run, (20000,)))
    rows += [exact("C", "float32", as_c(ray_alone))]
    rows += [exact("C, with dispersion and transmittance", "float32", as_c(whole))]
    for kind in CASES[name]:
        file = lab.MODELS / f"{name}.{kind}.onnx"
        source = cache(lambda file=file: CompiledSource(fused_program([read_model(file).at()])))
        for how, adapter, sizes in (
            ("C", as_c(source), C_BATCHES),
            ("onnxruntime", in_onnxruntime(file), ONNX_BATCHES),
        ):
            rows.append(Peer(f"{kind}, {how}", "float32", adapter, sizes, COUNT, "model, ours"))
    return rows


# ---- The race. -------------------------------------------------------------------------------------------------------


def errors(found: Found, exact: Found, focal_mm: float) -> dict[str, float]:
    """The figures of rule 4."""
    passes = found.passes & np.isfinite(found.way).all(0)
    both = passes & exact.passes
    point, way, p0, d0 = (a[:, both].astype(np.float64) for a in (found.point, found.way, exact.point, exact.way))
    angle = 1e6 * 2 * np.arcsin(np.minimum(np.linalg.norm(way - d0, axis=0) / 2, 1))
    away = 1e3 * np.linalg.norm(np.cross(point - p0, d0, axis=0), axis=0)
    rms = {name: math.sqrt(float((v * v).mean())) for name, v in (("direction_urad", angle), ("position_um", away))}
    other = float((passes != exact.passes).mean())
    return {"film_um": 1e-3 * abs(focal_mm) * rms["direction_urad"], **rms, "other": other, "rays": len(passes)}


def reference(task: Task) -> Found:
    """The trace of rule 4."""
    call, read = in_torch(whole_trace, torch.float64)(task)
    return read(call())


def answer(entry: Peer, task: Task, batch: int) -> Found:
    """What an entry answers to the rays, batch by batch."""
    parts = []
    for first in range(0, min(entry.most, task.film.shape[1]), batch):
        call, read = entry.adapter(task.part(first, batch))
        parts.append(read(call()))
    return Found(*(np.concatenate(each, -1) for each in zip(*parts, strict=True)))


def best_pass(entry: Peer, task: Task) -> tuple[int, Callable[[], int]]:
    """The fastest batch, and a function that does the rays in such batches often enough and returns how many it did."""
    tried = []
    for batch in entry.batches:
        calls = [entry.adapter(task.part(k, batch))[0] for k in range(0, entry.most, batch)]

        def once(calls: Sequence[Callable[[], Any]] = calls) -> float:
            began = time.process_time()
            for call in calls:
                call()
            return time.process_time() - began

        first = once()
        tried.append((once() if first > 1 else min(once() for _ in range(4)), batch, once))
    took, batch, once = min(tried, key=lambda each: each[0])
    repeats = max(1, math.ceil(LEAST_S / max(took, 1e-6)))

    def run() -> int:
        for _ in range(repeats):
            once()
        return repeats * entry.most

    return batch, run


def measure(name: str, rounds: int, compiled: bool, report: lab.Report) -> list[lab.Row]:
    """Race everything through one lens: minimum, median, batch and rounds in `ns`, the figures of rule 4 in `errors`.

    Rows of programs that cannot run have a `reason`.
    """
    task = task_of(name)
    exact, focal = reference(task), first_order(task.lens).efl_mm
    field = [*ours(name, task, compiled), *PEERS]
    about: lab.Row = {"lens": name, "title": f"{task.lens.name}, {task.lens.refractions} refractions (`{name}`)"}
    about["rays"] = (
        f"Film disc {task.domain.film_radius_mm:.4g} mm at z = {task.film_z:.6f}, pupil disc "
        f"{task.domain.pupil_radius_mm:.6f} mm at z = {task.pupil_z:.6f} (front vertex at 0, mm); "
        f"{100 * float(exact.passes.mean()):.0f}% of the rays pass."
    )
    rows: dict[str, lab.Row] = {
        e.key: about | {"family": e.family, "name": e.name, "precision": e.precision, "ns": None} for e in field
    }
    runs: dict[str, Callable[[], int]] = {}
    with pinned_threads():
        torch._dynamo.reset()
        for k, entry in enumerate(field):
            try:
                batch, runs[entry.key] = best_pass(entry, task)
                answers = answer(entry, task, batch)
                first = Found(*(a[..., : len(answers.passes)] for a in exact))
                rows[entry.key] |= {"batch": batch, "errors": errors(answers, first, focal)}
            except Unavailable as reason:
                rows[entry.key]["reason"] = str(reason)
            report(0.6 * (k + 1) / len(field))
        times = lab.cpu_ns(runs, rounds, lambda done, left=None: report(0.6 + 0.4 * done, left))
    for key, ns in times.items():
        rows[key]["ns"] = {"min": min(ns), "median": float(np.median(ns)), "rounds": len(ns)}
    absent = [about | {"family": "others", "name": n, "ns": None, "reason": why} for n, why in ABSENT.items()]
    return [row | {"load": os.getloadavg()[0]} for row in (*rows.values(), *absent)]


# ---- Page and plot. --------------------------------------------------------------------------------------------------

_COLUMNS = lab.columns(
    ("program", "name"), ("precision", "precision"), ("ns a ray", lab.times_of), ("batch", "batch"),
    ("film um", "errors.film_um", ".2g"), ("direction urad", "errors.direction_urad", ".2g"),
    ("position um", "errors.position_um", ".2g"), ("other, %", "errors.other", ".2g", 100),
)  # fmt: skip
_READING = """\
Models, the exact lens in C "with dispersion and transmittance" and the tracer written by hand answer with the
transmittance, too; the last takes the mean of both polarisations. Slow rows did the first 20,000 rays
(Optiland, DeepLens) or 500 (ray-optics). The cards of the singlet's models call them poor. Whoever knows a faster way
to call one of the others is asked to say so. A pixel is 5 um. Rows of a GPU were measured there, by `experiments
gpu-day`: all of its threads, the device idle before and after."""


def facts(rounds: int) -> str:
    """What rule 6 wants, and how C was compiled."""
    compiler = Path(find_compiler()).name if has_compiler() else "no compiler"
    others = []
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            others.append(f"{name} {version(name)}")
    return (
        f"Instruction set of C: {'AVX-512' if has_avx512() else 'AVX2'}, by {compiler} {' '.join(FLAGS)}; of torch: "
        f"{torch.backends.cpu.get_cpu_capability()}. Others: {', '.join(others) or 'none'}. {rounds} rounds on "
        f"{os.cpu_count()} cores; times are of the processor, minimum (median in brackets)."
    )


def on_a_gpu(name: str) -> list[lab.Row]:
    """The rows of a lens that `gpu_day` measured last, of the same rays (a million of them)."""
    file = lab.RESULTS / "gpu_day.json"
    found = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {"peers": [], "about": {}}
    rows = []
    for row in (r for r in found["peers"] if r["lens"] == name and "film_um" in r):
        ns = {"min": 1e9 * min(row["seconds"]), "median": 1e9 * float(np.median(row["seconds"]))}
        about = {"name": f"{row['program']}, {found['about']['device']}", "precision": "float32", "batch": row["rays"]}
        rows.append(about | {"ns": ns, "errors": row})
    return rows


def page(rows: Sequence[lab.Row], about: str) -> str:
    """The table of every lens, the plot, the rules."""
    parts = []
    for name in dict.fromkeys(r["lens"] for r in rows):
        both = [*(r for r in rows if r["lens"] == name), *on_a_gpu(name)]
        mine = sorted(both, key=lambda r: r["ns"]["min"] if r["ns"] else math.inf)
        parts += [f"## {both[0]['title']}", both[0]["rays"], lab.table(_COLUMNS, mine)]
    rules = (__doc__ or "").partition("Rules. ")[2].partition("\n\nWrites")[0]
    plot = "![Error against time, a point a program](rays.png)\n\nExact ones of ours are blue, models of ours green, "
    plot += "others red; squares calculate in float64."
    return lab.page(TITLE, COMMAND, f"{lab.load_line(rows)} {about}", plot, *parts, _READING, "## Rules", rules)


def draw(rows: Sequence[lab.Row], file: Path) -> None:
    """Error on the film against time, a panel a lens, a number a program in the order of time, named beside it."""
    titles = {r["lens"]: r["title"] for r in rows}
    with drawing(file, 9.0, 4.8 * len(titles)) as figure:
        for panel, name in zip(figure.subplots(len(titles), 1, squeeze=False)[:, 0], titles, strict=True):
            timed = sorted((r for r in rows if r["lens"] == name and r["ns"]), key=lambda r: r["ns"]["min"])
            points: list[tuple[float, float]] = []
            for k, row in enumerate(timed, 1):
                # The trace that all are compared with has no error, and a logarithm none.
                x, y, colour = row["ns"]["min"], max(row["errors"]["film_um"], 1e-11), FAMILIES[row["family"]]
                panel.plot(x, y, "s" if row["precision"] == "float64" else "o", color=colour, markersize=4)
                points.append((x, y))
                words = f"{k}  {row['name']}, {row['precision']}"
                panel.text(1.03, 1.02 - 0.05 * k, words, transform=panel.transAxes, fontsize=9, color=colour)
            title = titles[name].replace("`", "")
            panel.set(xscale="log", yscale="log", xlabel="ns a ray, one thread", title=title)
            plain_log_ticks(panel.xaxis, panel.yaxis)
            panel.margins(0.2)
            panel.set_ylabel("RMS error on the film, um (1e-11: the reference itself)")
            place_labels(panel, points, [str(k + 1) for k in range(len(points))])


OPTIONS = (
    lab.option("--quick", action="store_true", help="without the tracer that torch compiles"),
    lab.ONLY, lab.count("rounds", 12, "rounds (default 12)", least=10), lab.out(),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Race lens by lens, then write page and plot."""
    lab.quiet_glasses()
    warnings.simplefilter("ignore")
    cases, about = lab.chosen(list(CASES), str, args.only, "rays"), facts(args.rounds)

    def drawn(rows: Sequence[lab.Row]) -> str:
        if args.out.is_dir():
            draw(rows, args.out / "rays.png")
        return page(rows, about)

    lab.resume(
        args, "rays", {name: name for name in cases},
        lambda name, report: measure(name, args.rounds, not args.quick, report), lambda row: row["lens"], drawn,
        facts={"machine": lab.machine(), "about": about}, again=True, seconds=60.0, order=list(CASES),
    )  # fmt: skip
