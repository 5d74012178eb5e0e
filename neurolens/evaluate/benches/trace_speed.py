"""Speed of the exact tracer alone: eager and compiled, both precisions, by the number of surfaces and of threads.

Rays are made beforehand: film points over the image circle, aimed at the rear rim, wavelengths of their own, blocked
ones included; tracing tests the stop and every rim and follows dispersion, without transmittance. Candidates run in
turn, round after round (`speed.race`), so that ratios within a race are fair.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.evaluate.candidates import COMPILED_BATCHES, EAGER_BATCHES
from neurolens.evaluate.layout import refractions
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


@dataclass(frozen=True)
class Goal:
    """A figure that the tracer is meant to reach: on one thread, 12 refractions."""

    text: str
    wanted: float
    at_least: bool
    measured: float | None

    @property
    def verdict(self) -> str:
        if self.measured is None:
            return "not measured"
        return "reached" if (self.measured >= self.wanted) == self.at_least else "missed"


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
    """Race the tracer on one lens, and beside it on one with aspheres, a race a thread count, compiled once.

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
        "refractions": refractions(lens),
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


def goals(rows: Sequence[dict[str, Any]]) -> list[Goal]:
    """What the tracer is meant to reach, against the rows of the main lens on one thread in float32."""
    main = [r for r in rows if r["threads"] == 1 and r["refractions"] == MAIN and r["dtype"] == "float32"]
    found = []
    for kind, wanted in (("eager", 10.0), ("compiled", 30.0)):
        best = [r["ns_min"] for r in main if r["kind"] == kind and not r["aspheres"] and "ns_min" in r]
        found.append(Goal(f"Mray/s per core, {kind}", wanted, True, 1000 / min(best) if best else None))
    for kind in ("eager", "compiled"):
        ratios = [r["over_spheres"]["min"] for r in main if r["kind"] == kind and r.get("over_spheres")]
        found.append(Goal(f"times slower with two aspheres, {kind}", 1.7, False, min(ratios) if ratios else None))
    return found


def selected(lenses: dict[int, Lens], only: str) -> dict[int, Lens]:
    """Those whose file name holds a text.

    Raises:
        InputError: none does.
    """
    left = {n: lens for n, lens in lenses.items() if only in Path(lens.path).stem}
    if not left:
        known = ", ".join(Path(lens.path).stem for lens in lenses.values())
        raise InputError("bench trace", "--only", only, f"part of one of: {known}")
    return left
