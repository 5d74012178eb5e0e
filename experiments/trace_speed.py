"""Speed of the exact tracer alone: eager and compiled, both precisions, by the number of surfaces and of threads.

Rays are made beforehand: film points over the image circle, aimed at the rear rim, wavelengths of their own, blocked
ones included; tracing tests the stop and every rim and follows dispersion, without transmittance. Candidates run in
turn, round after round (`speed.race`), so that ratios within a race are fair.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from experiments import lab
from neurolens.base import status as st
from neurolens.base.progress import Progress
from neurolens.commands.arguments import whole
from neurolens.evaluate.candidates import COMPILED_BATCHES, EAGER_BATCHES
from neurolens.evaluate.speed import POOL, Call, Candidate, Race, Unavailable, race
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays
from neurolens.optics.trace import Rays, compile_trace, trace
from neurolens.surrogates.domain import FilmRays

# Lens files by number of refractions; the first that is there is taken.
LENSES = {
    2: "thorlabs_lb1471*",
    7: "brendel_tessar*",
    10: "tronnier_double_gauss*",
    12: "laikin_double_gauss_50",
    18: "itoh*",
    25: "ikemori*",
    33: "ogawa*",
    57: "panavision*",
}
MAIN = 12  # the double Gauss on which the goals stand, with and without aspheres
ASPHERIC_SURFACES = (0, 12)  # of that double Gauss: first and last, where aspheres are used
DTYPES = (torch.float32, torch.float64)


def chosen_lenses(folder: Path) -> tuple[dict[int, Lens], list[str]]:
    """The lenses of the table that have a file, by nominal number of refractions, and what is missing."""
    found: dict[int, Lens] = {}
    missing = []
    for count, pattern in LENSES.items():
        paths = sorted(folder.glob(f"{pattern}.toml"))
        if paths:
            found[count] = read_lens(paths[0]).at()
        else:
            missing.append(f"{count} refractions ({pattern}.toml)")
    return found, missing


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


def candidates(lens: Lens, dtypes: Sequence[torch.dtype] = DTYPES, label: str = "") -> list[Candidate]:
    """The tracer eager and compiled in each precision, named "{label}eager float32" and so on."""
    found = []
    for dtype in dtypes:
        name = str(dtype).removeprefix("torch.")
        found.append(Candidate(f"{label}eager {name}", _eager(lens, dtype), EAGER_BATCHES))
        found.append(Candidate(f"{label}compiled {name}", _compiled(lens, dtype), COMPILED_BATCHES))
    return found


def _eager(lens: Lens, dtype: torch.dtype) -> Callable[[FilmRays], Call]:
    def prepare(rays: FilmRays) -> Call:
        given = launched(lens, rays, dtype)
        return lambda: trace(lens, *given)

    return prepare


def _compiled(lens: Lens, dtype: torch.dtype) -> Callable[[FilmRays], Call]:
    fast = compile_trace(lens)

    def prepare(rays: FilmRays) -> Call:
        given = launched(lens, rays, dtype)
        try:
            fast(*given)
        except Exception as error:  # torch raises its own kinds: no compiler, or one that fails
            raise Unavailable(f"torch cannot compile here: {type(error).__name__}") from error
        return lambda: fast(*given)

    return prepare


def time_lens(
    lens: Lens,
    threads: Sequence[int],
    rounds: int,
    *,
    aspheric: Lens | None = None,
    dtypes: Sequence[torch.dtype] = DTYPES,
    report: Callable[[float], None] = lambda share: None,
) -> list[dict[str, Any]]:
    """Race the tracer on one lens, and beside it on one with aspheres, a race per thread count, compiled once.

    Returns: rows with units in their keys.

    Raises:
        InputError: as of `race`.
    """
    rays = film_rays(lens)
    field = candidates(lens, dtypes)
    if aspheric is not None:
        field += candidates(aspheric, dtypes, "aspheres, ")
    share = float((trace(lens, *launched(lens, rays, torch.float32)).status == st.PASSED).double().mean())
    rows = []
    for i, count in enumerate(threads):

        def part(done: float, before: int = i) -> None:
            report((before + done) / len(threads))

        timed = race(field, rays, threads=count, rounds=rounds, fresh=i == 0, report=part)
        rows += [_row(c.name, lens, timed, share) for c in field]
    return rows


def _row(name: str, lens: Lens, timed: Race, passing: float) -> dict[str, Any]:
    aspheres = len(ASPHERIC_SURFACES) if name.startswith("aspheres, ") else sum(bool(s.asphere) for s in lens.surfaces)
    kind, dtype = name.removeprefix("aspheres, ").split()
    row: dict[str, Any] = {
        "lens": Path(lens.path).stem,
        "refractions": lens.refractions,
        "surfaces": len(lens.surfaces),
        "aspheres": aspheres,
        "cylinders": sum(s.cylinder is not None for s in lens.surfaces),
        "kind": kind,
        "dtype": dtype,
        "threads": timed.threads,
        "passing_share": passing,
        "load": [timed.load_before, timed.load_after],
        "reason": timed.unavailable.get(name),
    }
    timing = timed.timing(name)
    if timing is not None:
        row |= {"ns_min": timing["min"], "ns_median": timing["median"], "batch": timing["batch"]}
    if name.startswith("aspheres, "):
        slower = timed.speedup(name.removeprefix("aspheres, "), name)
        row["over_spheres"] = slower  # times as long as the spherical lens, in the same race
    return row


def goals(rows: Sequence[dict[str, Any]]) -> list[lab.Goal]:
    """Goals of the tracer, for the main lens on one thread in float32."""
    main = [r for r in rows if r["threads"] == 1 and r["refractions"] == MAIN and r["dtype"] == "float32"]
    found = []
    for kind, wanted in (("eager", 10.0), ("compiled", 30.0)):
        best = [r["ns_min"] for r in main if r["kind"] == kind and not r["aspheres"] and "ns_min" in r]
        found.append(lab.Goal(f"Mray/s per core, {kind}", wanted, 1000 / min(best) if best else None, at_least=True))
    for kind in ("eager", "compiled"):
        ratios = [r["over_spheres"]["min"] for r in main if r["kind"] == kind and r.get("over_spheres")]
        found.append(lab.Goal(f"times slower with two aspheres, {kind}", 1.7, min(ratios) if ratios else None))
    return found


SIZES = (100_000, 1_000_000, 10_000_000)
_PART = 65536


def memory_of(lens_file: str, count: int) -> dict[str, Any]:
    """Trace `count` float32 rays, in a fresh process.

    Returns: rays, results_mb (the tensors that come out), growth_mb (highest resident memory while tracing, less that
        before), working_mb (growth less results: what tracing itself needs).
    """
    torch.set_num_threads(1)
    lens = read_lens(lens_file).at()
    rays, wavelength = _rays(lens, count)
    with torch.no_grad():
        trace(lens, Rays(*(c[:_PART] for c in rays)), wavelength[:_PART])  # what torch sets up once
        out, growth = lab.memory_growth(lambda: trace(lens, rays, wavelength))
    results = sum(c.element_size() * c.nelement() for c in (*out.rays, out.status)) / 1e6
    grown = growth / 1e6
    return {"rays": count, "results_mb": results, "growth_mb": grown, "working_mb": grown - results}


def _rays(lens: Any, count: int) -> tuple[Rays, torch.Tensor]:
    """Float32 rays, the same few again and again, made without temporaries of their size."""
    start, wavelength = launched(lens, film_rays(lens, _PART), torch.float32)
    columns = [torch.empty(count) for _ in range(7)]
    for i in range(0, count, _PART):
        for column, part in zip(columns, (*start, wavelength), strict=True):
            column[i : i + _PART] = part[: min(_PART, count - i)]
    return Rays(*columns[:6]), columns[6]


NOTES = """\
Rays made beforehand: film points over the image circle, aimed at the rear rim, 400 to 700 nm, a wavelength each;
blocked rays are traced like the others. Stop, every rim, total reflection and dispersion; no transmittance. Best and
median of {rounds} rounds in turn (A B .. B A), each the best of a few short samples; more threads than one share out
batches. A refraction is a surface at which the medium changes."""


@dataclass
class Found:
    """What has been measured so far.

    Attributes:
        rows: of `time_lens`. memory: of `memory_of`.
        missing: lenses without a file, and what could not be measured, as sentences.
    """

    rounds: int
    rows: list[dict[str, Any]] = field(default_factory=list)
    memory: list[dict[str, Any]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def write(found: Found, folder: Path) -> None:
    """Write trace_speed.md and trace_speed.json, each whole or not at all."""
    data = {
        "machine": lab.machine(),
        "rounds": found.rounds,
        "rows": found.rows,
        "memory": found.memory,
        "goals": [g.to_dict() for g in goals(found.rows)],
        "missing": found.missing,
    }
    lab.write_results(folder, "trace_speed", page(found), data)


def page(found: Found) -> str:
    """The whole page."""
    parts = ["# The exact tracer", "`python -m experiments trace`", _conditions(found)]
    parts += [lab.goal_table("goal (12 refractions, float32, one thread)", goals(found.rows)), speed_table(found.rows)]
    if found.memory:
        parts.append(memory_table(found.memory))
    if found.missing:
        parts.append("Not measured: " + "; ".join(found.missing) + ".")
    return "\n\n".join(parts) + "\n"


def _conditions(found: Found) -> str:
    m = lab.machine()
    loads = [v for row in found.rows for v in row["load"] if v is not None]
    busy = f" Load average meanwhile up to {max(loads):.1f}." if loads else ""
    return f"{NOTES.format(rounds=found.rounds)}\n\n{lab.machine_line(', ' + m['vectors'])}{busy}"


def speed_table(rows: Sequence[dict[str, Any]]) -> str:
    """One line per lens and thread count; Mray/s by the best time (by the median)."""
    kinds = [(kind, dtype) for dtype in ("float32", "float64") for kind in ("eager", "compiled")]
    kinds = [k for k in kinds if any((r["kind"], r["dtype"]) == k for r in rows)]
    columns = ["lens", "refractions", "aspheres", "cylinders", "threads", *(f"{k} {d}, Mray/s" for k, d in kinds), ""]
    lines = []
    groups: dict[tuple[Any, ...], dict[tuple[str, str], dict[str, Any]]] = {}
    for r in rows:
        key = (r["lens"], r["refractions"], r["aspheres"], r["cylinders"], r["threads"])
        groups.setdefault(key, {})[r["kind"], r["dtype"]] = r
    for key, cells in groups.items():
        aspheric = [(k, c) for k, d in kinds if (c := cells.get((k, d))) and c.get("over_spheres")]
        ratios = [f"{k} {c['over_spheres']['min']:.2f}" for k, c in aspheric]
        note = f"times as long as spheres: {', '.join(ratios)}" if ratios else ""
        lines.append([*key, *(_speed(cells.get(k)) for k in kinds), note])
    return lab.table(columns, lines)


def _speed(row: dict[str, Any] | None) -> str:
    if row is None or "ns_min" not in row:
        return row["reason"] or "" if row is not None else ""
    return f"{1000 / row['ns_min']:.2f} ({1000 / row['ns_median']:.2f})"


def memory_table(memory: Sequence[dict[str, Any]]) -> str:
    """Memory beyond rays and results."""
    note = "Memory of one call of `trace` (12 refractions, float32, one thread), each size in a process of its own:"
    rows = [[f"{m['rays']:,}", *(f"{m[key]:.1f}" for key in ("results_mb", "growth_mb", "working_mb"))] for m in memory]
    return f"{note}\n\n{lab.table('rays|results, MB|growth of resident memory, MB|tracing itself, MB', rows)}"


ABOUT = """\
Rays per second of the exact tracer: eager and compiled, float32 and float64, by number of
surfaces and threads, with two aspheres, and the memory that it takes. Candidates run in turn,
so that ratios are fair on a busy machine; absolute figures want a quiet one.
Writes trace_speed.md and trace_speed.json."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m experiments trace`."""
    parser.add_argument("--quick", action="store_true", help="12 refractions on one thread, few rounds (a minute)")
    lab.add_only(parser)
    parser.add_argument(
        "--threads", metavar="N", type=whole(1), nargs="+", default=[1, 2], help="thread counts (default: 1 2)"
    )
    parser.add_argument("--rounds", metavar="N", type=whole(1), help="rounds (default 20; quick 5)")
    lab.add_out(parser)


def run(args: argparse.Namespace) -> int:
    """Time the tracer, lens by lens; the table is written after each."""
    lab.quiet_glasses()
    lenses, missing = chosen_lenses(lab.LENSES)
    lenses = {MAIN: lenses[MAIN]} if args.quick else lenses
    lenses = {n: lenses[n] for n in lab.chosen(list(lenses), lambda n: Path(lenses[n].path).stem, args.only, "trace")}
    rounds = args.rounds or (5 if args.quick else 20)
    found = Found(rounds, missing=[] if args.quick or args.only else missing)
    threads = args.threads[:1] if args.quick else args.threads
    stages = {n: f"{n} refractions" for n in lenses}
    plan = {stages[n]: (2.0 if n == MAIN else 1.0) * (8 + n + n * len(threads)) for n in lenses} | {"memory": 10.0}
    progress = Progress(plan, quiet=args.quiet)
    for n, lens in lenses.items():
        with progress.stage(stages[n]) as report:
            aspheric = with_aspheres(lens) if n == MAIN else None
            found.rows += time_lens(lens, threads, rounds, aspheric=aspheric, report=report)
        write(found, args.out)
    if MAIN in lenses:
        with progress.stage("memory") as report:
            try:
                for i, size in enumerate(SIZES[: 2 if args.quick else 3]):
                    found.memory.append(lab.in_child(memory_of, lenses[MAIN].path, size))
                    report((i + 1) / len(SIZES))
            except lab.Unmeasured as reason:
                found.missing.append(str(reason))
        write(found, args.out)
    print(page(found))
    return 0
