"""Fused models against the exact lens, both written as C by the same means, and against torch and onnxruntime.

For each lens the smallest polynomial within 1 um RMS on the film, and a small network, with and without what a scene
fixes. All race in turn in one process on one thread, float32, doing the same rays, in two kinds of work: position and
direction only, and with stop, rims and transmittance. A minute per lens more where torch compiles its tracer. Needs a C
compiler and the extra "train" (torch). Writes fused_speed.md and fused_speed.json; rows of other lenses are kept.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.exact_race import exact_candidates
from experiments.lab import Report
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxlens import open_session
from neurolens.graph.compiler import FLAGS, find_compiler
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.lens.prescription import Lens
from neurolens.study.experiment import LensChoice
from neurolens.study.rays import ray_errors
from neurolens.study.speed import Call, Candidate, model_candidate, program_candidate, race
from neurolens.surrogates.assemble import ALL, RAY_ONLY
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import FilmRays, PairSettings, domain_of, make_pairs
from neurolens.surrogates.source import Fix, fixed_models, fused_program
from neurolens.trace.tracegraph import exact_graph

WITHIN_UM = 1.0
# Other ways to compile, of what is not fixed: one ray at a time, as an integrator calls it; without AVX-512.
OTHERWISE = {
    "one ray at a time, -O2": ("-std=c99", "-O2", "-march=native", "-fno-math-errno", "-fno-tree-vectorize"),
    "AVX2": (*FLAGS, "-mno-avx512f"),
}
IDLE = 1e-4  # rims that alone block fewer of the rays are not tested
TERMS = (8, 12, 16, 20, 24, 28, 32, 36, 38, 40, 48, 56, 64, 80, 100)
POLYNOMIALS = tuple(ModelSettings("ols", terms=n, idle_gates=IDLE) for n in TERMS)
NETWORKS = tuple(ModelSettings("mlp", units=n, layers=1, idle_gates=IDLE) for n in (4, 5, 6, 7, 8, 9, 10, 12, 16))
WAVELENGTH_NM = 550.0
_STOPPED = math.sqrt(0.5)  # one stop down, where a stop is fixed


@dataclass(frozen=True)
class Case:
    """A lens of the table and its domain."""

    file: str
    film_radius_mm: float | None
    near_m: float
    efl_mm: float | None = None
    configuration: str | None = None

    def lens(self) -> Lens:
        return LensChoice(lab.LENSES / self.file, self.efl_mm, self.configuration).read()


CASES = (
    Case("thorlabs_lb1471_biconvex_50.toml", 21.6, math.inf),
    Case("brendel_tessar_100.toml", None, 0.7, efl_mm=50.0),
    Case("laikin_double_gauss_50.toml", 21.6, 0.7),
    Case("ogawa_zoom_70_200.toml", 21.6, math.inf, configuration="72mm"),
)


@dataclass
class Row:
    """One candidate.

    Attributes:
        work: "ray" (position and direction) or "whole" (with stop, rims and transmittance).
        operations: float operations of one ray (a fused multiply-add is one); roots: square roots and divisions of
            them; bytes: that a ray reads and writes.
        speedup: over the exact tracer in C and over the one compiled by torch, in the same race at the same work.
        load: load average of the machine, the larger of before and after.
    """

    lens: str
    refractions: int
    name: str
    work: str
    rms_um: float | None = None
    coefficients: int | None = None
    operations: int | None = None
    roots: int | None = None
    bytes: int | None = None
    ns: dict[str, Any] | None = None
    reason: str | None = None
    speedup: dict[str, float] = field(default_factory=dict)
    load: float | None = None

    def count(self, program: Program) -> None:
        """Note the work of a program."""
        kinds = program.count()
        inputs = sum(program.steps[k].kind == "input" for k in program.live())
        self.operations, self.roots = sum(kinds.values()), kinds.get("div", 0) + kinds.get("sqrt", 0)
        self.bytes = 4 * (inputs + len(program.outputs))


def small_enough(prepared: Prepared, choices: Sequence[ModelSettings]) -> tuple[LensModel, float]:
    """The first of the models within `WITHIN_UM`, and its error; the last where none is."""
    pairs = prepared.pairs
    for settings in choices:
        model = fit_model(prepared, settings)
        rms = float(ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict).rms_um)
        if rms <= WITHIN_UM:
            break
    return model, rms


def measure(case: Case, *, rounds: int, torch_compiled: bool, report: Report) -> list[Row]:
    """Fit, race and hold against the exact tracers; one row per candidate."""
    lens = case.lens()
    domain = domain_of(lens, film_radius_mm=case.film_radius_mm, focus_m=(math.inf, case.near_m))
    prepared = prepare(make_pairs(lens, domain, PairSettings()))
    fitted = [small_enough(prepared, choices) for choices in (POLYNOMIALS, NETWORKS)]
    report(0.3)
    rows: dict[str, Row] = {}
    field: list[Candidate] = []

    def add(name: str, work: str, candidate: Candidate | None, program: Program | None = None, **known: Any) -> None:
        if candidate is not None:
            row = rows[f"{name}, {work}"] = Row(Path(case.file).stem, lens.refractions, name, work, **known)
            if program is not None:
                row.count(program)
            field.append(replace(candidate, name=f"{name}, {work}"))

    for work in ("ray", "whole"):
        program = lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, whole=work == "whole"))
        add("exact C", work, program_candidate("", program, domain), program)
        for words, flags in OTHERWISE.items():
            add(f"exact C, {words}", work, program_candidate("", program, domain, flags=flags), program)
        if torch_compiled:
            add("exact torch", work, exact_candidates(lens, domain, transmittance=work == "whole")[1])
    for model, error in fitted:
        known = {"rms_um": error, "coefficients": model.core.coefficients}
        for name, models, fixed in _forms(model):
            for work, parts in (("ray", RAY_ONLY), ("whole", ALL)):
                program = fused_program(models, parts, fixed)
                add(name, work, program_candidate(name, program, domain, fixed.stop_radius_mm), program, **known)
                for words, flags in OTHERWISE.items() if name.endswith(_FUSED) else ():
                    other = program_candidate("", program, domain, flags=flags)
                    add(f"{name}, {words}", work, other, program, **known)
    with tempfile.TemporaryDirectory(prefix="neurolens-fused-") as scratch:
        for model, error in fitted:
            file, name = export_onnx(model, Path(scratch) / f"{model.method}.onnx", {}), f"{model.method}, onnxruntime"
            add(name, "whole", model_candidate(name, load_model(file), domain.stop_radius_mm), rms_um=error)
            add(name, "ray", ray_candidate(name, file), rms_um=error)
        timed = race(field, domain, rounds=rounds, report=lambda s: report(0.3 + 0.7 * s))
    for key, row in rows.items():
        timing = timed.timing(key)
        row.ns, row.reason = None if timing is None else dict(timing), timed.unavailable.get(key)
        row.load = timed.load
        ratios = {exact: timed.speedup(key, f"{exact}, {row.work}") for exact in EXACTS}
        row.speedup = {exact: ratio["min"] for exact, ratio in ratios.items() if ratio is not None}
    return list(rows.values())


def ray_candidate(name: str, file: Path) -> Candidate:
    """The part of an exported graph that gives position and direction, alone in onnxruntime: no domain guard."""
    import onnx
    from onnx.utils import Extractor

    part = Extractor(onnx.load(file)).extract_model(["rays", "film_z_mm"], ["scene_ray"]).SerializeToString()
    wanted = {"rays": ("tensor(float)", 5, None), "film_z_mm": ("tensor(float)", 1)}
    session = open_session(file, part, wanted, {"scene_ray": ("tensor(float)", 6, None)})

    def prepare(rays: FilmRays) -> Call:
        columns = [np.ascontiguousarray(c.numpy(), dtype=np.float32) for c in rays.columns()]
        feeds = {"film_z_mm": columns[2][:1]}
        return lambda: session.run(None, {"rays": np.stack([*columns[0:2], *columns[3:6]]), **feeds})

    return Candidate(name, prepare)


def _forms(model: LensModel) -> list[tuple[str, tuple[LensModel, ...], Fix]]:
    """Nothing fixed; one wavelength; wavelength, film position and stop."""
    d = model.domain
    found: list[tuple[str, tuple[LensModel, ...], Fix]] = [(f"{model.method}, C", (model,), Fix())]
    if not model.encoding.w_half:
        return found
    z, stop = d.film_z_mm[0], _STOPPED * d.stop_radius_mm
    one = fixed_models(model, Fix((WAVELENGTH_NM,)))
    every = fixed_models(model, Fix((WAVELENGTH_NM,), z, stop))
    found.append((f"{model.method}, C, one wavelength", one, Fix()))
    found.append((f"{model.method}, C, wavelength, film, stop fixed", every, Fix((), z, stop)))
    return found


_NOTES = """\
One thread, float32, batches that fit the caches, {rounds} rounds in turn in one process (best; median in brackets).
Rays uniform over film and pupil disc of the domain, blocked ones included. "ray": film and pupil point in, position on
the front surface, direction and domain guard out. "whole": with stop, rims and transmittance.

- Models test no rim that alone blocks fewer than {idle:.2g} of the rays.
- exact C: the exact trace as C from the same writer as the models, compiled alike
  ({flags}): the tracer to beat. Every surface is bare; "ray" tests no rim. It
  goes in loops of few steps over blocks of rays, so that a core works on several rays while each waits for a
  division or a root; `python -m experiments tracer` holds it against a tracer that was written by hand.
- exact torch: the project's own tracer compiled by torch, rims tested in both kinds of work.
- onnxruntime, "ray": the part of the exported graph that gives position and direction, without the domain guard.
- One ray at a time: the same function without vectors ({scalar}), as an integrator calls it. AVX2: without AVX-512.
- Operations: float operations per ray, a fused multiply-add is one; in brackets, how many are divisions and square
roots.
  A core with two 512-bit pipes does 32 a cycle. Bytes: what a ray reads and writes.
- Fixed: {wavelength:g} nm; film at the farthest focus, one stop down. These do less: one wavelength is no white light.

The exact tracer has no error and needs no fit: with few surfaces it is nearly as fast, and a fit takes seconds, in
which it traces hundreds of millions of rays."""
EXACTS = ("exact C", "exact torch")
_FUSED, _FOLDED, _GRAPH = ", C", ", one wavelength", ", onnxruntime"
_NS_GOALS = (
    ("fused", _FUSED, {"ray": 6.0, "whole": 12.0}),
    ("fused, one wavelength", _FOLDED, {"ray": 4.0, "whole": 8.0}),
    ("onnxruntime", _GRAPH, {"ray": 20.0, "whole": 40.0}),
)
_RATIO_GOALS = (  # by work, at 12 and 33 refractions
    ("fused", _FUSED, "ray", {12: 5.0, 33: 15.0}),
    ("fused", _FUSED, "whole", {12: 3.0, 33: 8.0}),
    ("onnxruntime", _GRAPH, "ray", {12: 1.5, 33: 4.0}),
    ("onnxruntime", _GRAPH, "whole", {12: 1.5, 33: 4.0}),
)


def goals(rows: Sequence[Row]) -> list[lab.Goal]:
    """Goals of the fastest model within 1 um."""
    made = []
    for words, ending, most in _NS_GOALS:
        for work, limit in most.items():
            row = _fastest(rows, 12, work, ending)
            ns = float(row.ns["min"]) if row is not None and row.ns else None
            made.append(lab.Goal(f"ns per ray, 12 refractions, {words}, {work}", limit, ns))
    for exact in EXACTS:
        for kind, ending, work, wanted in _RATIO_GOALS:
            for count, least in wanted.items():
                row = _fastest(rows, count, work, ending)
                ratio = None if row is None else row.speedup.get(exact)
                text = f"times as fast as {exact}, {count} refractions, {kind}, {work}"
                made.append(lab.Goal(text, least, ratio, at_least=True))
    return made


def _fastest(rows: Sequence[Row], refractions: int, work: str, ending: str) -> Row | None:
    """The fastest model of one form within 1 um."""
    form = [r for r in rows if r.refractions == refractions and r.work == work and r.name.endswith(ending) and r.ns]
    good = [r for r in form if r.rms_um is not None and r.rms_um <= WITHIN_UM]
    return min(good, key=lambda r: r.ns["min"] if r.ns else 0.0, default=None)


_COLUMNS = lab.columns(
    ("lens", "lens"),
    ("refractions", "refractions"),
    ("candidate", "name"),
    ("work", "work"),
    ("RMS um", "rms_um", ".2g"),
    ("coefficients", "coefficients"),
    ("operations", lambda r: None if r.operations is None else f"{r.operations} ({r.roots})"),
    ("bytes", "bytes"),
    ("ns per ray", lambda r: lab.best_median(r.ns["min"], r.ns["median"]) if r.ns else f"unavailable: {r.reason}"),
    *((f"over {exact}", f"speedup.{exact}", ".2f") for exact in EXACTS),
)
_BUSY = """\
 Load average
meanwhile up to {:.1f}: others were working too. Short passes fall between interruptions, so their best times
hold; passes of the tracer compiled by torch, over 5 ms for many surfaces, do not: its times there are too long, and
ratios over it too high."""


def page(rows: Sequence[Row], rounds: int) -> str:
    """The whole page."""
    most, scalar = max((r.load or 0.0 for r in rows), default=0.0), OTHERWISE["one ray at a time, -O2"]
    return lab.page(
        "# Fused models against the exact lens",
        "`python -m experiments fused`",
        _NOTES.format(
            rounds=rounds, idle=IDLE, flags=" ".join(FLAGS), wavelength=WAVELENGTH_NM, scalar=" ".join(scalar)
        ),
        lab.machine_line() + (_BUSY.format(most) if most > (os.cpu_count() or 1) else ""),
        lab.goal_table("goal", goals(rows)),
        lab.table(_COLUMNS, rows),
    )


OPTIONS = (
    lab.option("--quick", action="store_true", help="without the tracer compiled by torch, few rounds"),
    lab.ONLY,
    lab.ROUNDS,
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure lens by lens; the table is written after each."""
    lab.quiet_glasses()
    find_compiler()
    rounds = args.rounds or (5 if args.quick else 20)
    cases = lab.chosen(CASES, lambda c: c.file, args.only, "fused")
    known = {"machine": lab.machine(), "flags": list(FLAGS)}
    names, text = [Path(c.file).stem for c in cases], ""
    rows = [Row(**row) for row in lab.earlier_rows(args.out / "fused_speed.json", known) if row["lens"] not in names]
    for case, report in lab.stages(cases, lambda c: c.file, args.quiet):
        rows += measure(case, rounds=rounds, torch_compiled=not args.quick, report=report)
        data = {**known, "rounds": rounds, "goals": goals(rows), "rows": rows}
        text = lab.write_results(args.out, "fused_speed", page(rows, rounds), data)
    print(text)
