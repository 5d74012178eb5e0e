"""Fused models against the exact lens, both written as C by the same means, and against onnxruntime.

For each lens the smallest polynomial within 1 um RMS on the film, and a small network, with and without what a scene
fixes. All race in turn in one process on one thread, float32, doing the same rays, in two kinds of work: position and
direction only, and with stop, rims and the transmittance of coated glass. Needs a C compiler and the extra "train"
(torch). Writes fused_speed.md and fused_speed.json; rows of other lenses are kept.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.lab import Report, Row
from experiments.speed.compiled_source import program_candidate
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxlens import open_session
from neurolens.graph.compiler import FLAGS, find_compiler
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.models.assemble import ALL, RAY_ONLY
from neurolens.models.export import export_onnx
from neurolens.models.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.models.source import Fix, fixed_models, fused_program
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.studies.experiment import LensChoice
from neurolens.studies.rays import ray_errors
from neurolens.studies.speed import Call, Candidate, model_candidate

WITHIN_UM = 1.0
AVX2 = (*FLAGS, "-mno-avx512f")  # what is not fixed is compiled a second time, without AVX-512
IDLE = 1e-4  # rims that alone block fewer of the rays are not tested
TERMS = (8, 12, 16, 20, 24, 28, 32, 36, 38, 40, 48, 56, 64, 80, 100)
POLYNOMIALS = tuple(ModelSettings("ols", terms=n, idle_gates=IDLE) for n in TERMS)
NETWORKS = tuple(ModelSettings("mlp", units=n, layers=1, idle_gates=IDLE) for n in (4, 5, 6, 7, 8, 9, 10, 12, 16))
WAVELENGTH_NM = 550.0
_STOPPED = math.sqrt(0.5)  # one stop down, where a stop is fixed
EXACT = "exact C"


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


def small_enough(prepared: Prepared, choices: Sequence[ModelSettings]) -> tuple[LensModel, float]:
    """The first of the models within `WITHIN_UM`, and its error; the last where none is."""
    pairs = prepared.pairs
    for settings in choices:
        model = fit_model(prepared, settings)
        rms = float(ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict).rms_um)
        if rms <= WITHIN_UM:
            break
    return model, rms


def measure(case: Case, rounds: int, report: Report) -> list[Row]:
    """Fit, race and hold against the exact tracers; one row per candidate and kind of work."""
    lens = case.lens()
    domain = domain_of(lens, film_radius_mm=case.film_radius_mm, focus_m=(math.inf, case.near_m))
    prepared = prepare(make_pairs(lens, domain, PairSettings()))
    fitted = [small_enough(prepared, choices) for choices in (POLYNOMIALS, NETWORKS)]
    report(0.3)
    rows: dict[str, Row] = {}
    field: list[Candidate] = []

    def add(name: str, work: str, candidate: Candidate | None, program: Program | None = None, **known: Any) -> None:
        if candidate is None:
            return
        row: Row = {"lens": Path(case.file).stem, "refractions": lens.refractions, "name": name, "work": work} | known
        if program is not None:
            inputs = sum(program.steps[k].kind == "input" for k in program.live())
            row |= lab.operations_of(program) | {"bytes": 4 * (inputs + len(program.outputs))}
        rows[f"{name}, {work}"] = row
        field.append(replace(candidate, name=f"{name}, {work}"))

    for work, parts in (("ray", RAY_ONLY), ("whole", ALL)):
        program = lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, whole=work == "whole"))
        add(EXACT, work, program_candidate("", program, domain), program)
        add(f"{EXACT}, AVX2", work, program_candidate("", program, domain, flags=AVX2), program)
        for model, error in fitted:
            known = {"rms_um": error, "coefficients": model.core.coefficients}
            for name, models, fixed in _forms(model):
                program = fused_program(models, parts, fixed)
                add(name, work, program_candidate("", program, domain, fixed.stop_radius_mm), program, **known)
                if name.endswith(_FUSED):
                    add(f"{name}, AVX2", work, program_candidate("", program, domain, flags=AVX2), program, **known)
    with tempfile.TemporaryDirectory(prefix="neurolens-fused-") as scratch:
        for model, error in fitted:
            file, name = export_onnx(model, Path(scratch) / f"{model.method}.onnx", {}), f"{model.method}{_GRAPH}"
            add(name, "whole", model_candidate(name, load_model(file), domain.stop_radius_mm), rms_um=error)
            add(name, "ray", ray_candidate(name, file), rms_um=error)
        return lab.race_rows(
            rows, field, domain, rounds, lambda name: {EXACT: f"{EXACT}, {rows[name]['work']}"},
            lambda share, left=None: report(0.3 + 0.7 * share),
        )  # fmt: skip


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
    whole: list[tuple[str, tuple[LensModel, ...], Fix]] = [(f"{model.method}{_FUSED}", (model,), Fix())]
    if not model.encoding.w_half:
        return whole
    z, stop = model.domain.film_z_mm[0], _STOPPED * model.domain.stop_radius_mm
    one, every = (fixed_models(model, fix) for fix in (Fix((WAVELENGTH_NM,)), Fix((WAVELENGTH_NM,), z, stop)))
    return [
        *whole, (f"{model.method}{_FUSED}{_FOLDED}", one, Fix()),
        (f"{model.method}{_FUSED}, wavelength, film, stop fixed", every, Fix((), z, stop)),
    ]  # fmt: skip


_NOTES = """\
One thread, float32, batches that fit the caches, {rounds} rounds in turn in one process (best; median in brackets).
Rays uniform over film and pupil disc of the domain, blocked ones included. "ray": film and pupil point in, position on
the front surface, direction and domain guard out. "whole": with stop, rims and transmittance.

- Models test no rim that alone blocks fewer than {idle:.2g} of the rays.
- exact C: the exact trace as C from the same writer as the models, compiled alike ({flags}), every surface coated;
  "ray" tests no rim. `python -m experiments tracer` holds it against a tracer that was written by hand.
- onnxruntime, "ray": the part of the exported graph that gives position and direction, without the domain guard.
- AVX2: without AVX-512. Fixed: {wavelength:g} nm; film at the farthest focus, one stop down.
- Operations: float operations per ray, a fused multiply-add is one; in brackets, how many are divisions and square
  roots. Bytes: what a ray reads and writes.

The exact tracer has no error and needs no fit: with few surfaces it is nearly as fast."""
_FUSED, _FOLDED, _GRAPH = ", C", ", one wavelength", ", onnxruntime"
_NS_GOALS = (  # by refractions and the kind of work
    ("fused", 12, _FUSED, {"ray": 6.0, "whole": 4.5}), ("fused", 33, _FUSED, {"whole": 4.0}),
    ("fused, one wavelength", 12, _FOLDED, {"ray": 4.0, "whole": 8.0}),
    ("onnxruntime", 12, _GRAPH, {"ray": 20.0, "whole": 60.0}),
)  # fmt: skip
_RATIO_GOALS = (  # at 12 and 33 refractions
    ("fused", _FUSED, "ray", (5.0, 15.0)), ("fused", _FUSED, "whole", (3.0, 8.0)),
    ("onnxruntime", _GRAPH, "ray", (1.5, 4.0)), ("onnxruntime", _GRAPH, "whole", (1.5, 4.0)),
)  # fmt: skip


def goals(rows: Sequence[Row]) -> list[lab.Goal]:
    """Goals of the fastest model of each form within 1 um."""

    def fastest(refractions: int, work: str, ending: str) -> Row:
        form = [r for r in rows if (r["refractions"], r["work"]) == (refractions, work) and r["name"].endswith(ending)]
        good = [r for r in form if r["ns"] and r.get("rms_um") is not None and r["rms_um"] <= WITHIN_UM]
        return min(good, key=lambda r: r["ns"]["min"], default={"ns": {}, "speedup": {}})

    made = [
        lab.Goal(f"ns per ray, {n} refractions, {kind}, {work}", most, fastest(n, work, ending)["ns"].get("min"))
        for kind, n, ending, limits in _NS_GOALS
        for work, most in limits.items()
    ]
    return made + [
        lab.Goal(
            f"times as fast as {EXACT}, {count} refractions, {kind}, {work}", least,
            fastest(count, work, ending)["speedup"].get(EXACT), at_least=True,
        )
        for kind, ending, work, wanted in _RATIO_GOALS
        for count, least in zip((12, 33), wanted, strict=True)
    ]  # fmt: skip


_COLUMNS = lab.columns(
    ("lens", "lens"), ("refractions", "refractions"), ("candidate", "name"), ("work", "work"),
    ("RMS um", "rms_um", ".2g"), ("coefficients", "coefficients"),
    ("operations", lambda r: f"{r['operations']} ({r['roots']})" if r.get("operations") else None), ("bytes", "bytes"),
    ("ns per ray", lab.times_of), (f"over {EXACT}", f"speedup.{EXACT}", ".2f"),
)  # fmt: skip
OPTIONS = (lab.ONLY, lab.ROUNDS, lab.out())


def run(args: argparse.Namespace) -> None:
    """Measure lens by lens; the table is written after each."""
    lab.quiet_glasses()
    find_compiler()
    rounds = args.rounds or 20
    cases = {Path(c.file).stem: c for c in lab.chosen(CASES, lambda c: c.file, args.only, "fused")}

    def page(rows: Sequence[Row]) -> str:
        notes = _NOTES.format(rounds=rounds, idle=IDLE, flags=" ".join(FLAGS), wavelength=WAVELENGTH_NM)
        head = "# Fused models against the exact lens", "`python -m experiments fused`", notes, lab.load_line(rows)
        return lab.page(*head, lab.goal_table("goal", goals(rows)), lab.table(_COLUMNS, rows))

    lab.resume(
        args, "fused_speed", cases, lambda case, report: measure(case, rounds, report),
        lambda row: row["lens"], page, facts={"machine": lab.machine(), "flags": list(FLAGS)}, again=True,
        about=lambda rows: {"rounds": rounds, "goals": goals(rows)}, order=[Path(c.file).stem for c in CASES],
    )  # fmt: skip
