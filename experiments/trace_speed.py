"""Rays per second of the exact tracer: eager and compiled, float32 and float64, by number of surfaces and threads.

With two aspheres too, and the memory that it takes. Rays are made beforehand; candidates run in turn, so that ratios
are fair on a busy machine; absolute figures want a quiet one. Writes trace_speed.md and trace_speed.json.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import torch

from experiments import lab
from experiments.lab import Report, Row
from neurolens.base import status as st
from neurolens.base.progress import Progress
from neurolens.base.settings import whole
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays
from neurolens.study.speed import COMPILED_BATCHES, EAGER_BATCHES, POOL, Call, Candidate, Race, Unavailable, race
from neurolens.surrogates.domain import FilmRays
from neurolens.trace.rays import Rays, compile_tracing, trace

# Lens files by number of refractions.
LENSES = {
    2: "thorlabs_lb1471_biconvex_50",
    7: "brendel_tessar_100",
    10: "tronnier_double_gauss_100",
    12: "laikin_double_gauss_50",
    18: "itoh_zoom_100_146",
    25: "ikemori_retrofocus_14",
    33: "ogawa_zoom_70_200",
    57: "panavision_anamorphic_zoom_21",
}
MAIN = 12  # the double Gauss on which the goals stand, with and without aspheres
ASPHERIC_SURFACES = (0, 12)  # of that double Gauss: first and last, where aspheres are used
DTYPES = (torch.float32, torch.float64)
ASPHERES = "aspheres, "


def with_aspheres(lens: Lens) -> Lens:
    """The same lens with even terms A4 to A10 on two surfaces, of a size that takes as many steps as designs do."""
    surfaces = list(lens.surfaces)
    for k in ASPHERIC_SURFACES:
        h = surfaces[k].semi_diameter_mm
        asphere = tuple((p, a / h**p) for p, a in ((4, -0.2), (6, 0.08), (8, -0.04), (10, 0.01)))
        surfaces[k] = replace(surfaces[k], asphere=asphere)
    return replace(lens, surfaces=tuple(surfaces), name=f"{lens.name}, two aspheres")


def film_rays(lens: Lens, count: int = POOL, seed: int = 3) -> FilmRays:
    """Film points uniform over the image circle, pupil points over the rear rim, 400 to 700 nm; float64 [count]."""
    g = torch.Generator().manual_seed(seed)
    u = torch.rand((5, count), generator=g, dtype=torch.float64)
    film, rear = lens.image_radius_mm or lens.surfaces[-1].semi_diameter_mm, lens.surfaces[-1].semi_diameter_mm
    z = lens.film_z_mm if lens.film_z_mm is not None else lens.vertices_mm[-1]
    discs = [
        radius * torch.sqrt(u[i]) * turn(2 * math.pi * u[i + 1])
        for i, radius in ((0, film), (2, rear))
        for turn in (torch.cos, torch.sin)
    ]
    return FilmRays(discs[0], discs[1], torch.full_like(u[0], float(z)), discs[2], discs[3], 400 + 300 * u[4])


def launched(lens: Lens, rays: FilmRays, dtype: torch.dtype) -> tuple[Rays, torch.Tensor]:
    """Camera rays and wavelengths, contiguous, in one precision."""
    plane = float(lens.vertices_mm[len(lens.surfaces) - 1])
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, plane)
    return Rays(*(c.to(dtype).contiguous() for c in start)), rays.wavelength_nm.to(dtype).contiguous()


def candidates(lens: Lens, label: str = "") -> list[Candidate]:
    """The tracer eager and compiled in each precision, named "{label}eager float32" and so on."""
    fast = compile_tracing(partial(trace, lens), lens)
    results = []
    for dtype in DTYPES:

        def eager(rays: FilmRays, dtype: torch.dtype = dtype) -> Call:
            given = launched(lens, rays, dtype)
            return lambda: trace(lens, *given)

        def compiled(rays: FilmRays, dtype: torch.dtype = dtype) -> Call:
            given = launched(lens, rays, dtype)
            try:
                fast(*given)
            except Exception as error:  # torch raises its own kinds: no compiler, or one that fails
                raise Unavailable(f"torch cannot compile here: {type(error).__name__}") from error
            return lambda: fast(*given)

        name = str(dtype).removeprefix("torch.")
        results.append(Candidate(f"{label}eager {name}", eager, EAGER_BATCHES))
        results.append(Candidate(f"{label}compiled {name}", compiled, COMPILED_BATCHES))
    return results


def time_lens(lens: Lens, threads: Sequence[int], rounds: int, report: Report, aspheric: Lens | None) -> list[Row]:
    """Rows of the tracer on one lens, and beside it on one with aspheres: a race per thread count, compiled once."""
    rays = film_rays(lens)
    field = candidates(lens) + (candidates(aspheric, ASPHERES) if aspheric is not None else [])
    share = float((trace(lens, *launched(lens, rays, torch.float32)).status == st.PASSED).double().mean())
    rows = []
    for i, count in enumerate(threads):
        part = lab.part_of(report, i, len(threads))
        timed = race(field, rays, threads=count, rounds=rounds, fresh=i == 0, report=part)
        rows += [_row(c.name, lens, timed, share) for c in field]
    return rows


def _row(name: str, lens: Lens, timed: Race, passing: float) -> Row:
    aspheric, timing = name.startswith(ASPHERES), timed.timing(name)
    kind, dtype = name.removeprefix(ASPHERES).split()
    row: Row = {"lens": Path(lens.path).stem, "refractions": lens.refractions, "surfaces": len(lens.surfaces)}
    row["aspheres"] = len(ASPHERIC_SURFACES) if aspheric else sum(bool(s.asphere) for s in lens.surfaces)
    row |= {"cylinders": sum(s.cylinder is not None for s in lens.surfaces), "kind": kind, "dtype": dtype}
    row |= {"threads": timed.threads, "passing_share": passing, "load": [timed.load_before, timed.load_after]}
    row["reason"] = timed.unavailable.get(name)
    if timing is not None:
        row |= {"ns_min": timing["min"], "ns_median": timing["median"], "batch": timing["batch"]}
    if aspheric:  # times as long as the spherical lens, in the same race
        row["over_spheres"] = timed.speedup(name.removeprefix(ASPHERES), name)
    return row


def goals(rows: Sequence[Row]) -> list[lab.Goal]:
    """Goals of the tracer, for the main lens on one thread in float32."""
    main = [r for r in rows if r["threads"] == 1 and r["refractions"] == MAIN and r["dtype"] == "float32"]
    results = []
    for kind, wanted in (("eager", 10.0), ("compiled", 30.0)):
        best = [r["ns_min"] for r in main if r["kind"] == kind and not r["aspheres"] and "ns_min" in r]
        results.append(lab.Goal(f"Mray/s per core, {kind}", wanted, 1000 / min(best) if best else None, at_least=True))
    for kind in ("eager", "compiled"):
        ratios = [r["over_spheres"]["min"] for r in main if r["kind"] == kind and r.get("over_spheres")]
        results.append(lab.Goal(f"times slower with two aspheres, {kind}", 1.7, min(ratios) if ratios else None))
    return results


SIZES = (100_000, 1_000_000, 10_000_000)
_PART = 65536


def memory_of(lens_file: str, count: int) -> Row:
    """Trace `count` float32 rays in a fresh process: the MB of results, of all memory added, of tracing itself."""
    torch.set_num_threads(1)
    lens = lab.lens_of(Path(lens_file))
    rays, wavelength = repeated_rays(lens, count)
    with torch.no_grad():
        trace(lens, Rays(*(c[:_PART] for c in rays)), wavelength[:_PART])  # what torch sets up once
        out, growth = lab.memory_growth(lambda: trace(lens, rays, wavelength))
    results = sum(c.element_size() * c.nelement() for c in (*out.rays, out.status)) / 1e6
    grown = growth / 1e6
    return {"rays": count, "results_mb": results, "growth_mb": grown, "working_mb": grown - results}


def repeated_rays(lens: Lens, count: int) -> tuple[Rays, torch.Tensor]:
    """Float32 rays, the same few again and again, made without temporaries of their size."""
    start, wavelength = launched(lens, film_rays(lens, _PART), torch.float32)
    columns = [torch.empty(count) for _ in range(7)]
    for i in range(0, count, _PART):
        for column, part in zip(columns, (*start, wavelength), strict=True):
            column[i : i + _PART] = part[: min(_PART, count - i)]
    return Rays(*columns[:6]), columns[6]


_NOTES = """\
Rays made beforehand: film points over the image circle, aimed at the rear rim, 400 to 700 nm, a wavelength each;
blocked rays are traced like the others. Stop, every rim, total reflection and dispersion; no transmittance. Best and
median of {rounds} rounds in turn (A B .. B A), each the best of a few short samples; more threads than one share out
batches. A refraction is a surface at which the medium changes."""
_MEMORY = "Memory of one call of `trace` (12 refractions, float32, one thread), each size in a process of its own:"
_MEMORY_COLUMNS = lab.columns(
    ("rays", "rays", ","),
    ("results, MB", "results_mb", ".1f"),
    ("growth of resident memory, MB", "growth_mb", ".1f"),
    ("tracing itself, MB", "working_mb", ".1f"),
)


@dataclass
class Results:
    """The results so far: rows of `time_lens` and of `memory_of`; `missing` says what could not be measured."""

    rounds: int
    rows: list[Row] = field(default_factory=list)
    memory: list[Row] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def write(self, folder: Path) -> str:
        """Write trace_speed.md and trace_speed.json; returns the page."""
        data = {"machine": lab.machine(), **vars(self), "goals": goals(self.rows)}
        return lab.write_results(folder, "trace_speed", page(self), data)


def page(results: Results) -> str:
    """The whole page."""
    load = lab.most_load(results.rows)
    machine = lab.machine_line(f", {lab.machine()['vectors']}")
    return lab.page(
        "# The exact tracer",
        "`python -m experiments trace`",
        _NOTES.format(rounds=results.rounds),
        machine + ("" if load is None else f" Load average meanwhile up to {load:.1f}."),
        lab.goal_table("goal (12 refractions, float32, one thread)", goals(results.rows)),
        speed_table(results.rows),
        f"{_MEMORY}\n\n{lab.table(_MEMORY_COLUMNS, results.memory)}" if results.memory else "",
        f"Not measured: {'; '.join(results.missing)}." if results.missing else "",
    )


def speed_table(rows: Sequence[Row]) -> str:
    """One line per lens and thread count; Mray/s by the best time (by the median)."""
    keys = ("lens", "refractions", "aspheres", "cylinders", "threads")
    kinds = [f"{kind} {dtype}" for dtype in ("float32", "float64") for kind in ("eager", "compiled")]
    lines: dict[tuple[object, ...], Row] = {}
    for r in rows:
        lines.setdefault(tuple(r[k] for k in keys), {})[f"{r['kind']} {r['dtype']}"] = r

    def speed(cells: Row, kind: str) -> str:
        row = cells.get(kind, {})
        if "ns_min" in row:
            return lab.best_median(1000 / row["ns_min"], 1000 / row["ns_median"])
        return row.get("reason") or ""

    def note(cells: Row) -> str:
        aspheric = [cells[k] for k in kinds if cells.get(k, {}).get("over_spheres")]
        ratios = [f"{r['kind']} {r['over_spheres']['min']:.2f}" for r in aspheric]
        return f"times as long as spheres: {', '.join(ratios)}" if ratios else ""

    kinds = [kind for kind in kinds if any(kind in cells for cells in lines.values())]
    cells = [[*key, *(speed(results, kind) for kind in kinds), note(results)] for key, results in lines.items()]
    return lab.table([*keys, *(f"{kind}, Mray/s" for kind in kinds), ""], cells)


OPTIONS = (
    lab.option("--quick", action="store_true", help="12 refractions on one thread, few rounds (a minute)"),
    lab.ONLY,
    lab.option("--threads", metavar="N", type=whole(1), nargs="+", default=[1, 2], help="counts (default: 1 2)"),
    lab.ROUNDS,
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Time the tracer, lens by lens; the table is written after each."""
    lab.quiet_glasses()
    counts = lab.chosen([MAIN] if args.quick else list(LENSES), lambda n: LENSES[n], args.only, "trace")
    lenses, results = {n: lab.lens_of(LENSES[n]) for n in counts}, Results(lab.rounds_of(args))
    threads = args.threads[:1] if args.quick else args.threads
    plan = {f"{n} refractions": (2.0 if n == MAIN else 1.0) * (8 + n + n * len(threads)) for n in lenses}
    progress = Progress(plan | {"memory": 10.0}, quiet=args.quiet)
    for n, lens in lenses.items():
        with progress.stage(f"{n} refractions") as report:
            aspheric = with_aspheres(lens) if n == MAIN else None
            results.rows += time_lens(lens, threads, results.rounds, report, aspheric)
        text = results.write(args.out)
    if MAIN in lenses:
        with progress.stage("memory") as report:
            try:
                for i, size in enumerate(SIZES[: 2 if args.quick else 3]):
                    results.memory.append(lab.in_child(memory_of, lenses[MAIN].path, size))
                    report((i + 1) / len(SIZES))
            except lab.Unmeasured as reason:
                results.missing.append(str(reason))
        text = results.write(args.out)
    print(text)
