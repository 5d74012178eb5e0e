"""The exact tracer against Optiland 0.6.3 (the newest in November 2026) on the same lens and rays, in one run.

Optiland (MIT licence) is no dependency of this project: it lives in an environment of its own.

    python3 -m venv /tmp/optiland
    /tmp/optiland/bin/pip install optiland==0.6.3 torch==2.13.0
    export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 PYTHONPATH=.
    /tmp/optiland/bin/python -m experiments optiland [--quick] [-o DIR]

Writes optiland.md and optiland.json. Both trace light from the scene through the double Gauss (and the same with two
even aspheres) with every rim and the stop, one wavelength, one thread, in float32 and float64; Optiland with constant
indices and without records of each surface, which is its fastest way. Candidates run in turn, each with the batch that
suits it best. Where a ray lands on the last surface is compared as well. Once with all rays of the film and the front
rim, as a renderer sends them, and once with those alone that pass, which its aspheres need: see `WHY`.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from experiments import lab
from experiments.lab import Row
from experiments.trace_speed import film_rays, with_aspheres
from neurolens.base.errors import NeurolensError
from neurolens.lens import glass
from neurolens.lens.prescription import Lens
from neurolens.study.speed import POOL, Call, Candidate, Race, race
from neurolens.surrogates.domain import FilmRays
from neurolens.trace.rays import Rays, compile_tracing, trace

try:
    import optiland
    import optiland.backend as be
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic
    from optiland.rays import RealRays
except ImportError as error:
    raise NeurolensError(f"this needs Optiland 0.6.3 in an environment of its own: see {__file__}") from error

LENS = "laikin_double_gauss_50"
FOCAL_MM = 50.0
BATCHES = (4096, 16384, 65536)
DTYPES = {"float32": torch.float32, "float64": torch.float64}
GOAL = 5.0  # times Optiland's rays per second, eager
PASSING = ", rays that pass"
WHY = """\
Optiland meets spheres and conics in closed form (numpy: in a loop that numba compiles), aspheres by Newton's iteration
from the base conic, in array operations on all rays, until every ray is within 1e-10 mm (in float32: within rounding)
or 100 steps are done. A ray that missed a surface before is NaN and never gets there: one in a batch makes it take all
100, and of the rays above a fifth are such. Where all pass it takes one or two. Ours takes a fixed number of steps
(two to seven, by how far the asphere departs from the conic that fits it best), in plain torch."""


def light(lens: Lens, rays: FilmRays, dtype: torch.dtype) -> Rays:
    """Light from distant points: the direction that a film point sees, through a place of the front rim."""
    front, rear = lens.surfaces[0].semi_diameter_mm, lens.surfaces[-1].semi_diameter_mm
    sx, sy = rays.film_x / FOCAL_MM, rays.film_y / FOCAL_MM
    length = torch.sqrt(1 + sx * sx + sy * sy)
    x, y = rays.pupil_x * front / rear, rays.pupil_y * front / rear
    columns = (x - sx, y - sy, torch.full_like(x, -1.0), sx / length, sy / length, 1 / length)
    return Rays(*(c.to(dtype).contiguous() for c in columns))


def optiland_lens(lens: Lens) -> Optic:
    """The same prescription in Optiland, in its present backend and precision."""
    optic = Optic()
    optic.surfaces.add(index=0, radius=be.inf, thickness=be.inf)
    for k, s in enumerate(lens.surfaces):
        shape: dict[str, Any] = {"radius": float(s.radius_mm), "conic": float(s.conic)}
        if s.asphere:
            terms = dict(s.asphere)
            shape |= {"surface_type": "even_asphere", "coefficients": [terms.get(p, 0.0) for p in range(2, 11, 2)]}
        optic.surfaces.add(
            index=k + 1,
            thickness=float(s.thickness_mm),
            material=IdealMaterial(float(glass.index_of(s, glass.LINE_D_NM))),
            is_stop=s.stop,
            aperture=s.diameter_mm,
            **shape,
        )
    return optic


def theirs(lens: Lens, backend: str, dtype: str) -> tuple[Callable[[FilmRays], Call], Callable[[FilmRays], np.ndarray]]:
    """A function that prepares Optiland's call, and one that returns its landing points and directions [6, N]."""

    def prepare(rays: FilmRays) -> Call:
        be.set_backend(backend)
        be.set_precision(dtype)
        columns: list[Any] = list(light(lens, rays, DTYPES[dtype]))
        columns += [torch.ones_like(columns[0]), torch.full_like(columns[0], glass.LINE_D_NM / 1000)]
        start, optic = [c.numpy() if backend == "numpy" else c for c in columns], optiland_lens(lens)

        def call() -> RealRays:
            be.set_backend(backend)
            traced = RealRays(*start)
            optic.surfaces.trace(traced, skip=1, record=False)
            return traced

        return call

    def land(rays: FilmRays) -> np.ndarray:
        found: Any = prepare(rays)()
        # Blocked rays go on with no intensity.
        out = np.stack([be.to_numpy(c) for c in (found.x, found.y, found.z, found.L, found.M, found.N)])
        return np.where(be.to_numpy(found.i) > 0, out, np.nan)

    return prepare, land


def ours(lens: Lens, dtype: str, compiled: bool) -> Callable[[FilmRays], Call]:
    """A function that prepares our call."""
    fast = compile_tracing(partial(trace, lens, towards="film"), lens) if compiled else None

    def prepare(rays: FilmRays) -> Call:
        start = light(lens, rays, DTYPES[dtype])
        wavelength = torch.tensor(glass.LINE_D_NM, dtype=DTYPES[dtype])
        if fast is not None:
            return lambda: fast(start, wavelength)
        return lambda: trace(lens, start, glass.LINE_D_NM, towards="film")

    return prepare


def passing(lens: Lens, rays: FilmRays) -> FilmRays:
    """Replace the rays that are blocked by copies of those that pass, so that the count stays the same."""
    with torch.no_grad():
        status = trace(lens, light(lens, rays, torch.float64), glass.LINE_D_NM, towards="film").status
    places = torch.nonzero(status == 0)[:, 0]
    places = places.repeat(-(-len(rays) // len(places)))[: len(rays)]
    return FilmRays(*(c[places] for c in rays.columns()))


def contest(
    lens: Lens, dtype: str, all_pass: bool, rounds: int, report: Callable[[float], None]
) -> tuple[Race, dict[str, Any]]:
    """Race all of them on one lens in one precision, and compare where rays land."""
    rays = passing(lens, film_rays(lens)) if all_pass else film_rays(lens)
    backends = {name: theirs(lens, name, dtype) for name in ("numpy", "torch")}
    field = [Candidate(f"Optiland, {name}", prepare, BATCHES) for name, (prepare, _) in backends.items()]
    field += [Candidate("neurolens, eager", ours(lens, dtype, False), (*BATCHES[:2], 32768))]
    field += [Candidate("neurolens, compiled", ours(lens, dtype, True), (16384,))]
    timed = race(field, rays, rounds=rounds, report=report)
    with torch.no_grad():
        out = trace(lens, light(lens, rays, DTYPES[dtype]), glass.LINE_D_NM, towards="film")
        own = np.where(out.status.numpy() == 0, torch.stack(out.rays).numpy(), np.nan)
        found = {name: compare(own, land(rays)) for name, (_, land) in backends.items()}
    return timed, {"passing_share": float(np.isfinite(own[0]).mean()), "against": found}


def compare(own: np.ndarray, other: np.ndarray) -> Row:
    """Largest distance of landing points (mm) and of directions (rad), and rays that only one of us passes."""
    a, b = np.isfinite(own).all(0), np.isfinite(other).all(0)
    offset = (own.astype(float) - other)[:, a & b]
    return {
        "position_mm": float(np.linalg.norm(offset[:3], axis=0).max()),
        "angle_rad": float(np.linalg.norm(offset[3:], axis=0).max()),
        "one_passes": int((a != b).sum()),
    }


def rows_of(timed: Race, dtype: str, lens: str, agreement: dict[str, Any]) -> list[Row]:
    """Plain tables, units in the keys."""
    rows = []
    for name in timed.ns:
        row: Row = {"lens": lens, "dtype": dtype, "name": name, **(timed.timing(name) or {}), **agreement}
        row["load"] = [timed.load_before, timed.load_after]
        if name.startswith("neurolens"):
            row["faster_than"] = {other: timed.speedup(name, other) for other in timed.ns if other.startswith("Opti")}
        rows.append(row)
    return rows


def _times(backend: str) -> Callable[[Row], str | None]:
    """Times as fast as Optiland with a backend."""

    def cell(row: Row) -> str | None:
        found = row.get("faster_than", {}).get(f"Optiland, {backend}")
        return None if found is None else lab.best_median(found["min"], found["median"], form=".1f")

    return cell


_COLUMNS = lab.columns(
    ("lens", "lens"),
    ("precision", "dtype"),
    ("tracer", "name"),
    ("Mray/s, best (median)", lambda r: lab.best_median(1000 / r["min"], 1000 / r["median"])),
    ("batch", "batch"),
    ("times Optiland numpy", _times("numpy")),
    ("times Optiland torch", _times("torch")),
)
_AGREEMENT = lab.columns(
    ("lens", "lens"),
    ("precision", "dtype"),
    ("Optiland", "backend"),
    ("mm", "position_mm", ".1e"),
    ("rad", "angle_rad", ".1e"),
    ("rays", "one_passes"),
    ("of", lambda r: POOL),
)
_SAME = """\
The same rays from the scene through the same 13 surfaces (12 refractions, every rim, the stop), one wavelength, one \
thread; {rounds} rounds in turn. Ratios: by the best times (median within rounds)."""


def page(rows: list[Row], rounds: int) -> str:
    """The result as Markdown."""
    m, version = lab.machine(), getattr(optiland, "__version__", "0.6.3")
    first = {(r["lens"], r["dtype"]): r for r in reversed(rows)}
    landed = [
        {"lens": lens, "dtype": dtype, "backend": backend, **found}
        for lens, dtype in dict.fromkeys((r["lens"], r["dtype"]) for r in rows)
        for backend, found in first[lens, dtype]["against"].items()
    ]
    goals = [f"Goal: eager at least {GOAL:g} times Optiland, numpy and torch, in the same precision."]
    for dtype in DTYPES:
        eager = [r for r in rows if r["name"] == "neurolens, eager" and r["dtype"] == dtype]
        least = min(v["min"] for r in eager for v in r["faster_than"].values())
        goals.append(f"{dtype}: {'reached' if least >= GOAL else 'missed'}, at least {least:.1f} times.")
    goals.append(f"\n{WHY}")
    machine = f"{m['processor']}, {m['vectors']}; Python {m['python']}, torch {m['torch']}, numpy {m['numpy']}, "
    machine += f"Optiland {version}. Load average meanwhile up to {lab.most_load(rows) or 0.0:.1f}."
    landing = "Where rays land on the last surface, and rays that only one of the two passes:"
    parts = ["`python -m experiments optiland`", _SAME.format(rounds=rounds), machine, lab.table(_COLUMNS, rows)]
    return lab.page("# Beside Optiland", *parts, landing, lab.table(_AGREEMENT, landed), "\n".join(goals))


OPTIONS = (lab.option("--quick", action="store_true", help="few rounds"), lab.out())


def run(args: argparse.Namespace) -> None:
    """Race, print and write."""
    warnings.simplefilter("ignore")
    be.set_backend("torch")
    be.grad_mode.disable()
    rounds = 5 if args.quick else 20
    lens = lab.lens_of(LENS)
    tables = {table.name + end: (table, bool(end)) for end in ("", PASSING) for table in (lens, with_aspheres(lens))}
    contests = [(name, dtype) for name in tables for dtype in DTYPES]
    rows: list[Row] = []
    for (name, dtype), report in lab.stages(contests, ", ".join, args.quiet, 40.0):
        timed, agreement = contest(tables[name][0], dtype, tables[name][1], rounds, report)
        rows += rows_of(timed, dtype, name, agreement)
    print(lab.write_results(args.out, "optiland", page(rows, rounds), {"machine": lab.machine(), "rows": rows}))
