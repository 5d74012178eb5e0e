"""Fused models against the exact lens, both written as C by the same means, and against torch and onnxruntime.

For each lens: the smallest polynomial within 1 um RMS on the film, and a small network. All race in turn in one
process on one thread, float32, doing the same rays (`speed`), in two kinds of work: position and direction only, and
with stop, rims and transmittance.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxsession import open_session
from neurolens.commands.arguments import whole
from neurolens.evaluate.candidates import (
    exact_candidates,
    fused_candidate,
    model_candidate,
    program_candidate,
)
from neurolens.evaluate.experiment import LensChoice
from neurolens.evaluate.rays import ray_errors
from neurolens.evaluate.speed import Call, Candidate, Race, race
from neurolens.graph.compiler import FLAGS, find_compiler
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
from neurolens.surrogates.source import fused_program
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


def small_enough(prepared: Prepared, choices: Sequence[ModelSettings]) -> tuple[LensModel, float]:
    """The first of the models within `WITHIN_UM`, and its error; the last where none is."""
    pairs = prepared.pairs
    for settings in choices:
        model = fit_model(prepared, settings)
        rms = float(ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict).rms_um)
        if rms <= WITHIN_UM:
            break
    return model, rms


def measure(
    case: Case, folder: Path, *, rounds: int, torch_compiled: bool, report: Callable[[float], None] = lambda share: None
) -> list[Row]:
    """Fit, race and hold against the exact tracers; one row per candidate."""
    lens = case.lens(folder)
    domain = domain_of(lens, film_radius_mm=case.film_radius_mm, focus_m=(math.inf, case.near_m))
    prepared = prepare(make_pairs(lens, domain, PairSettings()))
    fitted = [small_enough(prepared, choices) for choices in (POLYNOMIALS, NETWORKS)]
    report(0.3)
    entries: list[tuple[Row, Candidate]] = []

    def add(name: str, work: str, candidate: Candidate, program: Program | None = None, **known: Any) -> None:
        row = Row(Path(case.file).stem, lens.refractions, name, work, **known, **(_floor(program) if program else {}))
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


def _add_fused(
    add: Callable[..., None],
    name: str,
    work: str,
    models: tuple[LensModel, ...],
    domain: Domain,
    parts: Parts,
    fixed: Fix,
    known: dict[str, Any],
) -> None:
    candidate = fused_candidate(name, models, domain, parts=parts, fix=fixed)
    if candidate is not None:
        add(name, work, candidate, fused_program(models, parts, fixed), **known)


def _floor(program: Program) -> dict[str, Any]:
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


_NOTES = """\
One thread, float32, batches that fit the caches, {rounds} rounds in turn in one process (best; median in brackets).
Rays uniform over film and pupil disc of the domain, blocked ones included. "ray": film and pupil point in, position on
the front surface, direction and domain guard out. "whole": with stop, rims and transmittance.

- exact C: the exact trace as C from the same writer as the models, compiled alike
  ({flags}): the tracer to beat. Every surface is bare; "ray" tests no rim. Each
  surface waits for the one before it (a division and two roots in a row), which costs more than its operations.
- exact torch: the project's own tracer compiled by torch, rims tested in both kinds of work.
- onnxruntime, "ray": the part of the exported graph that gives position and direction, without the domain guard.
- Operations: float operations per ray, a fused multiply-add is one; in brackets, how many are divisions and square
roots.
  A core with two 512-bit pipes does 32 a cycle. Bytes: what a ray reads and writes.
- Fixed: {wavelength:g} nm; film at the farthest focus, one stop down. These do less: one wavelength is no white light.

The exact tracer has no error and needs no fit: with few surfaces it is nearly as fast, and a fit takes seconds, in
which it traces hundreds of millions of rays."""


def write(rows: Sequence[Row], folder: Path, rounds: int) -> str:
    """Write fused_speed.md and fused_speed.json; returns the page."""
    text = page(rows, rounds)
    data = {"machine": lab.machine(), "rounds": rounds, "flags": FLAGS}
    data |= {"goals": [g.to_dict() for g in goals(rows)], "rows": [asdict(r) for r in rows]}
    lab.write_results(folder, "fused_speed", text, data)
    return text


def earlier(folder: Path, names: Collection[str]) -> list[Row]:
    """Rows of other lenses than these that stand in a folder's fused_speed.json, if it was made on this machine."""
    try:
        data = json.loads((folder / "fused_speed.json").read_text(encoding="utf-8"))
        same = data["machine"] == lab.machine() and list(data["flags"]) == list(FLAGS)
        return [Row(**row) for row in data["rows"] if same and row["lens"] not in names]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def goals(rows: Sequence[Row]) -> list[lab.Goal]:
    """Goals of the fastest model within 1 um."""
    found = []

    for words, ending, work, wanted in (
        ("fused", _FUSED, "ray", 6.0),
        ("fused", _FUSED, "whole", 12.0),
        ("fused, one wavelength", _FOLDED, "ray", 4.0),
        ("fused, one wavelength", _FOLDED, "whole", 8.0),
        ("onnxruntime", _GRAPH, "ray", 20.0),
        ("onnxruntime", _GRAPH, "whole", 40.0),
    ):
        row = _fastest(rows, 12, work, ending)
        ns = float(row.ns["min"]) if row is not None and row.ns else None
        found.append(lab.Goal(f"ns per ray, 12 refractions, {words}, {work}", wanted, ns))
    for exact in ("exact C", "exact torch"):
        for count, ending, work, wanted in (
            (12, _FUSED, "ray", 5.0),
            (33, _FUSED, "ray", 15.0),
            (12, _FUSED, "whole", 3.0),
            (33, _FUSED, "whole", 8.0),
            (12, _GRAPH, "ray", 1.5),
            (33, _GRAPH, "ray", 4.0),
            (12, _GRAPH, "whole", 1.5),
            (33, _GRAPH, "whole", 4.0),
        ):
            row = _fastest(rows, count, work, ending)
            kind = "onnxruntime" if ending == _GRAPH else "fused"
            ratio = None if row is None else row.speedup.get(exact)
            text = f"times as fast as {exact}, {count} refractions, {kind}, {work}"
            found.append(lab.Goal(text, wanted, ratio, at_least=True))
    return found


_FUSED, _FOLDED, _GRAPH = ", C", ", one wavelength", ", onnxruntime"


def _fastest(rows: Sequence[Row], refractions: int, work: str, ending: str) -> Row | None:
    """The fastest model of one form within 1 um."""
    some = [r for r in rows if r.refractions == refractions and r.work == work and r.name.endswith(ending) and r.ns]
    some = [r for r in some if r.rms_um is not None and r.rms_um <= WITHIN_UM]
    return min(some, key=lambda r: r.ns["min"] if r.ns else 0.0, default=None)


def page(rows: Sequence[Row], rounds: int) -> str:
    """The whole page."""
    parts = ["# Fused models against the exact lens", "`python -m experiments fused`"]
    parts.append(_NOTES.format(rounds=rounds, flags=" ".join(FLAGS), wavelength=WAVELENGTH_NM))
    parts += [lab.machine_line() + _busy(rows), lab.goal_table("goal", goals(rows)), _table(rows)]
    return "\n\n".join(parts) + "\n"


def _busy(rows: Sequence[Row]) -> str:
    """On the load, where it was more than the machine has cores for."""
    most = max((r.load for r in rows if r.load is not None), default=0.0)
    if most <= (os.cpu_count() or 1):
        return ""
    return (
        f" Load average\nmeanwhile up to {most:.1f}: others were working too. Short passes fall between interruptions, "
        "so their best times\nhold; passes of the tracer compiled by torch, over 5 ms for many surfaces, do not: its "
        "times there are too long, and\nratios over it too high."
    )


def _table(rows: Sequence[Row]) -> str:
    head = (
        "lens|refractions|candidate|work|RMS um|coefficients|operations|bytes|ns per ray|over exact C|over exact torch"
    )
    lines = []
    for r in rows:
        ns = f"{r.ns['min']:.2f} ({r.ns['median']:.2f})" if r.ns else f"unavailable: {r.reason}"
        operations = "" if r.operations is None else f"{r.operations} ({r.roots})"
        ratios = [f"{r.speedup[k]:.2f}" if k in r.speedup else "" for k in ("exact C", "exact torch")]
        rms = None if r.rms_um is None else f"{r.rms_um:.2g}"
        lines.append([r.lens, r.refractions, r.name, r.work, rms, r.coefficients, operations, r.bytes, ns, *ratios])
    return lab.table(head, lines)


ABOUT = """\
Fit the smallest polynomial within 1 um RMS and a small network to a few lenses, write them as C, with and
without what a scene fixes, and race them against the exact trace: written as C by the same means, and
compiled by torch (a minute per lens more), and against onnxruntime. One thread, float32. Needs a C compiler
and the extra "train" (torch). Writes fused_speed.md and fused_speed.json; rows of other lenses
are kept."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m experiments fused`."""
    parser.add_argument("--quick", action="store_true", help="without the tracer compiled by torch, few rounds")
    lab.add_only(parser)
    parser.add_argument("--rounds", metavar="N", type=whole(1), help="rounds (default 20; quick 5)")
    lab.add_out(parser)


def run(args: argparse.Namespace) -> int:
    """Measure lens by lens; the table is written after each."""
    lab.quiet_glasses()
    find_compiler()
    rounds = args.rounds or (5 if args.quick else 20)
    cases = lab.chosen(CASES, lambda c: c.file, args.only, "fused")
    progress = Progress({c.file: 1.0 for c in cases}, quiet=args.quiet)
    rows, text = earlier(args.out, [Path(c.file).stem for c in cases]), ""
    for case in cases:
        with progress.stage(case.file) as report:
            rows += measure(case, lab.LENSES, rounds=rounds, torch_compiled=not args.quick, report=report)
        text = write(rows, args.out, rounds)
    print(text)
    return 0
