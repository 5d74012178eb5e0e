"""Fused models against the exact lens, both written as C by the same means, and against torch and onnxruntime.

For each lens: the smallest polynomial within 1 um RMS on the film, and a small network. All race in turn in one
process on one thread, float32, doing the same rays (`speed`), in two kinds of work: position and direction only, and
with stop, rims and transmittance.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxsession import open_session
from neurolens.evaluate.benches.fused import fused_candidate, program_candidate
from neurolens.evaluate.candidates import exact_candidates, model_candidate
from neurolens.evaluate.experiment import LensChoice
from neurolens.evaluate.layout import refractions
from neurolens.evaluate.rays import ray_errors
from neurolens.evaluate.speed import Call, Candidate, Race, race
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.optics.prescription import Lens
from neurolens.optics.tracegraph import exact_graph
from neurolens.surrogates.assemble import ALL, RAY_ONLY, Parts
from neurolens.surrogates.domain import Domain, FilmRays, domain_of
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.source import Fixed, fused_program
from neurolens.surrogates.specialise import Fix, fixed_models

WITHIN_UM = 1.0
POLYNOMIALS = tuple(ModelSettings("ols", terms=n) for n in (8, 12, 16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 100))
NETWORKS = tuple(ModelSettings("mlp", units=n, layers=1) for n in (4, 5, 6, 7, 8, 9, 10, 12, 16))
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

    def lens(self, folder: Path) -> Lens:
        return LensChoice(folder / self.file, self.efl_mm, self.configuration).read()


CASES = (
    Case("thorlabs_lb1471_biconvex_50.toml", 21.6, math.inf),
    Case("brendel_tessar_100.toml", None, 0.7, efl_mm=50.0),
    Case("laikin_double_gauss_50.toml", 21.6, 0.7),
    Case("ogawa_zoom_70_200.toml", 21.6, math.inf, configuration="72mm"),
)


@dataclass
class Row:
    """One candidate: what it is, the work it does, its floor, its time.

    Attributes:
        work: "ray" (position and direction) or "whole" (with stop, rims and transmittance).
        operations: float operations of one ray (a fused multiply-add is one), bytes: that a ray reads and writes.
        roots: square roots and divisions among them.
        speedup: over the exact tracer in C and over the one compiled by torch at the same work, of the same race.
        load: load average of the machine meanwhile, the larger of before and after.
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


def selected(only: str) -> list[Case]:
    """Cases whose file name holds a text.

    Raises:
        InputError: none does.
    """
    found = [c for c in CASES if only in c.file]
    if not found:
        raise InputError("bench fused", "--only", only, f"part of one of: {', '.join(c.file for c in CASES)}")
    return found


def small_enough(prepared: Prepared, choices: Sequence[ModelSettings]) -> tuple[LensModel, float]:
    """The first of the models within `WITHIN_UM`, and its error; the last where none is."""
    pairs = prepared.pairs
    for settings in choices:
        model = fit_model(prepared, settings)
        rms = float(ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict)["rms_um"])
        if rms <= WITHIN_UM:
            break
    return model, rms


def measure(
    case: Case, folder: Path, *, rounds: int, torch_compiled: bool, report: Callable[[float], None] = lambda share: None
) -> list[Row]:
    """Fit, race and hold against the exact tracers; one row a candidate."""
    lens = case.lens(folder)
    domain = domain_of(lens, film_radius_mm=case.film_radius_mm, focus_m=(math.inf, case.near_m))
    prepared = prepare(make_pairs(lens, domain, PairSettings()))
    fitted = [small_enough(prepared, choices) for choices in (POLYNOMIALS, NETWORKS)]
    report(0.3)
    entries: list[tuple[Row, Candidate]] = []

    def add(name: str, work: str, candidate: Candidate, program: Program | None = None, **known: Any) -> None:
        row = Row(Path(case.file).stem, refractions(lens), name, work, **known, **(_floor(program) if program else {}))
        entries.append((row, replace(candidate, name=f"{name}, {work}")))

    _add_exact(add, lens, domain, torch_compiled)
    for model, error in fitted:
        known = {"rms_um": error, "coefficients": model.core.coefficients}
        for name, models, fixed in _forms(model):
            for work, parts in (("ray", RAY_ONLY), ("whole", ALL)):
                _add_fused(add, name, work, models, domain, parts, fixed, known)
    with tempfile.TemporaryDirectory(prefix="neurolens-fused-") as scratch:
        for model, error in fitted:
            file = export_onnx(model, Path(scratch) / f"{model.method}.onnx", {})
            candidate = model_candidate(model.method, load_model(file), domain.stop_radius_mm)
            add(f"{model.method}, onnxruntime", "whole", candidate, rms_um=error)
            add(f"{model.method}, onnxruntime", "ray", ray_candidate(model.method, file), rms_um=error)
        timed = race([c for _, c in entries], domain, rounds=rounds, report=lambda s: report(0.3 + 0.7 * s))
    return [_timed(row, candidate.name, timed) for row, candidate in entries]


def ray_candidate(name: str, file: Path) -> Candidate:
    """The part of an exported graph that gives position and direction, alone in onnxruntime: no domain guard."""
    import onnx
    from onnx.utils import Extractor

    part = Extractor(onnx.load(file)).extract_model(["rays", "film_z_mm"], ["scene_ray"]).SerializeToString()
    wanted = {"rays": ("tensor(float)", 5, None), "film_z_mm": ("tensor(float)", 1)}
    session = open_session(file, part, 1, wanted, {"scene_ray": ("tensor(float)", 6, None)})

    def prepare(rays: FilmRays) -> Call:
        columns = [np.ascontiguousarray(c.numpy(), dtype=np.float32) for c in rays.columns()]
        feeds = {"film_z_mm": columns[2][:1]}
        return lambda: session.run(None, {"rays": np.stack([*columns[0:2], *columns[3:6]]), **feeds})

    return Candidate(name, prepare)


def _add_exact(add: Callable[..., None], lens: Lens, domain: Domain, torch_compiled: bool) -> None:
    for work in ("ray", "whole"):
        program = lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, whole=work == "whole"))
        add("exact C", work, program_candidate("", program, domain), program)
        if torch_compiled:
            add("exact torch", work, exact_candidates(lens, domain, transmittance=work == "whole")[1])


def _forms(model: LensModel) -> list[tuple[str, tuple[LensModel, ...], Fixed]]:
    """Nothing fixed; one wavelength; wavelength, film position and stop."""
    d = model.domain
    found: list[tuple[str, tuple[LensModel, ...], Fixed]] = [(f"{model.method}, C", (model,), Fixed())]
    if not model.encoding.w_half:
        return found
    z, stop = d.film_z_mm[0], _STOPPED * d.stop_radius_mm
    one = fixed_models(model, Fix((WAVELENGTH_NM,)))
    every = fixed_models(model, Fix((WAVELENGTH_NM,), z, stop))
    found.append((f"{model.method}, C, one wavelength", one, Fixed()))
    found.append((f"{model.method}, C, wavelength, film, stop fixed", every, Fixed(z, stop)))
    return found


def _add_fused(
    add: Callable[..., None],
    name: str,
    work: str,
    models: tuple[LensModel, ...],
    domain: Domain,
    parts: Parts,
    fixed: Fixed,
    known: dict[str, Any],
) -> None:
    candidate = fused_candidate(name, models, domain, parts=parts, fixed=fixed)
    if candidate is not None:
        add(name, work, candidate, fused_program(models, parts, fixed), **known)


def _floor(program: Program) -> dict[str, Any]:
    """What a ray costs at least: operations and bytes."""
    count = program.count()
    inputs = sum(s.kind == "input" for s in (program.steps[k] for k in program.live()))
    return {
        "operations": sum(count.values()),
        "roots": count.get("div", 0) + count.get("sqrt", 0),
        "bytes": 4 * (inputs + len(program.outputs)),
    }


def _timed(row: Row, name: str, timed: Race) -> Row:
    timing = timed.timing(name)
    row.ns = None if timing is None else dict(timing)
    row.reason = timed.unavailable.get(name)
    row.load = max((v for v in (timed.load_before, timed.load_after) if v is not None), default=None)
    for exact in ("exact C", "exact torch"):
        ratio = timed.speedup(name, f"{exact}, {row.work}")
        if ratio is not None:
            row.speedup[exact] = ratio["min"]
    return row
