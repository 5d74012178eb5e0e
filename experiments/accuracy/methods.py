"""The rows of `python -m experiments surrogates`: every method on the same rays of a lens, its errors and times."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from experiments.accuracy.published import PUBLISHED, fit_any
from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import fingerprint_of, read_kept, sha256_of, write_kept
from neurolens.base.lensname import lens_id_of
from neurolens.base.progress import Progress, Report
from neurolens.base.report import plain
from neurolens.cameras.model import load_model
from neurolens.models.export import export_onnx
from neurolens.models.fit import NETWORKS, ModelSettings, Prepared, prepare
from neurolens.models.fitted import Domain
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.studies.experiment import DomainChoice, EvaluationChoice, LensChoice
from neurolens.studies.measure import FreshRays, measure, onnx_predictor, seconds_to_load, shared_rays
from neurolens.studies.rays import REFERENCE_RADIUS_MM
from neurolens.studies.speed import EXACT, Race, exact_c_candidate, exact_records, model_candidates, race

GROUPS = {
    "paraxial": "what renderers use today",
    "published": "published methods, our implementations of their papers",
    "ours": "this project's",
    "ablations": "ours with one thing changed",
}
DEFAULT_GROUPS = ("paraxial", "published", "ours")


# What each ablation changes in a polynomial that "ols" fits in the invariants.
POLYNOMIAL_ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "planes not searched": {"planes": False},
    "candidates do not grow": {"growth": 0},
    "no elimination": {"elimination": False},
    "no replacement": {"replacement": False},
    "position at its first-order weight": {"position_weight": 1.0},
    "transmittance of 8 terms": {"transmittance_terms": 8},
    "forward selection alone": {"planes": False, "growth": 0, "elimination": False, "replacement": False},
    "matching pursuit": {"method": "omp"},
}
# What each ablation changes in a network.
NETWORK_ABLATIONS: Mapping[str, Mapping[str, Any]] = {"20 steps of training": {"steps": 20}, "one layer": {"layers": 1}}


def ablated(settings: ModelSettings, name: str) -> ModelSettings:
    """The settings with one part left out, named for the table; the benchmark gives the ratio of the two errors.

    Raises:
        InputError: an ablation of neither table, or of the other kind of model.
    """
    known = NETWORK_ABLATIONS if settings.method == "mlp" else POLYNOMIAL_ABLATIONS
    if name not in known:
        raise InputError("ablation", "name", name, f"one of {', '.join(known)}")
    return replace(settings, **known[name], name=f"{settings.label}, {name}")


@dataclass(frozen=True)
class Row:
    """One method with its settings.

    Attributes:
        name: of the table's row and of files.
        group: of `GROUPS`.
        settings: of the fit.
        source: the paper, or what an ablation changes.
    """

    name: str
    group: str
    settings: ModelSettings
    source: str = ""


def _ours() -> tuple[ModelSettings, ...]:
    polynomials = tuple(ModelSettings("ols", terms=terms) for terms in (20, 40, 64, 100))
    networks = tuple(ModelSettings("mlp", units=n, layers=k) for n, k in ((8, 1), (10, 1), (8, 2), (16, 2)))
    networks += (ModelSettings("mlp", units=32, steps=150),)  # a minute
    return *polynomials, *networks, *(ModelSettings("ols+mlp", terms=n, units=u) for n, u in ((40, 8), (64, 16)))


def _ablations() -> Iterator[Row]:
    """Our polynomial of 64 terms and our network, each without one part."""
    for whole, parts in (
        (ModelSettings("ols", terms=64), POLYNOMIAL_ABLATIONS),
        (ModelSettings("mlp"), NETWORK_ABLATIONS),
    ):
        for text in parts:
            name = f"{whole.label}-{text.replace(' ', '-')}"
            yield Row(name, "ablations", replace(ablated(whole, text), name=name), text)


@cache
def all_rows() -> tuple[Row, ...]:
    """Every row that this version can fit, group by group."""
    rows = [Row(name, "paraxial", ModelSettings(name)) for name in ("thin", "thick")]
    for method in PUBLISHED.values():
        rows += [Row(s.label, "published", s, method.citation) for s in method.presets]
    rows += [Row(s.label, "ours", s) for s in _ours()]
    return tuple([*rows, *_ablations()])


def chosen_rows(names: Sequence[str], quick: bool = False) -> tuple[Row, ...]:
    """Rows by name, by group, or by method ("ols", "schrade"; without ablations); none named: all but the ablations.

    Args:
        quick: none named: `QUICK_ROWS`. Train networks that take minutes for their `QUICK_STEPS` only; their sources
            say so.

    Raises:
        InputError: an unknown name.
    """
    rows, wanted = all_rows(), names or (QUICK_ROWS if quick else DEFAULT_GROUPS)
    picked: dict[str, Row] = {}
    for name in wanted:
        found = [r for r in rows if name in (r.name, r.group) or (name == r.settings.method and r.group != "ablations")]
        if not found and name not in GROUPS:
            known = ", ".join((*GROUPS, *(r.name for r in rows)))
            raise InputError("experiments surrogates", "--methods", name, f"one of: {known}")
        picked |= {r.name: r for r in found}
    return tuple(_quick(row) if quick else row for row in picked.values())


# A row a method, or two, of those that take less than half a minute.
QUICK_ROWS = (
    *("thin", "thick", "taylor-d5", "hanika-d5", "schrade-28", "zheng-adaptive-36x1", "neurolens2017-128x3", "rtf-d6"),
    *("ray-lut-16", "ols-20", "ols-64", "mlp-8x1", "mlp-16x2", "ols-40-mlp-8x2"),
)
# Steps of training of the networks that would take minutes.
QUICK_STEPS = {"neurolens2017-128x3": 500, "mlp-16x2": 40, "mlp-32x2": 40}


def _quick(row: Row) -> Row:
    if (steps := QUICK_STEPS.get(row.name)) is None:
        return row
    source = row.source and f"{row.source}, cut by --quick to {steps} steps: its errors are too large"
    return replace(row, settings=replace(row.settings, steps=steps), source=source)


_FIGURES = (
    "rms_um p99_um max_um rms_infinity_um rms_px p99_px max_px rms_um_at_21_6 direction_rms_deg direction_p99_deg "
    "direction_max_deg position_rms_um position_p99_um transmittance_rms transmittance_max false_pass false_block "
    "rays share_beyond_60_deg"
).split()


@dataclass(frozen=True)
class BenchSettings:
    """The settings that all rows share: domain of the models, rays of the fits and errors, measurement and race."""

    domain: DomainChoice
    pairs: PairSettings
    evaluation: EvaluationChoice


@dataclass(frozen=True)
class Bench:
    """One lens of the benchmark and the folder of its records; expensive parts are computed on first use."""

    choice: LensChoice
    settings: BenchSettings
    folder: Path

    @property
    def name(self) -> str:
        return "-".join(part for part in (lens_id_of(self.choice.file), str(self.choice.state or "")) if part)

    @cached_property
    def lens(self) -> Lens:
        return self.choice.read()

    @cached_property
    def domain(self) -> Domain:
        return self.settings.domain.of(self.lens)

    @cached_property
    def prepared(self) -> Prepared:
        return prepare(make_pairs(self.lens, self.domain, self.settings.pairs))

    @cached_property
    def rays(self) -> FreshRays:
        return shared_rays(self.prepared, self.settings.evaluation.vignetting_rays)

    def record_file(self, row: Row) -> Path:
        return self.folder / "records" / self.name / f"{row.name}.json"

    def model_file(self, row: Row) -> Path:
        return self.folder / "models" / self.name / f"{row.name}.onnx"

    def fingerprint(self, row: Row) -> str:
        """Hash of everything that decides a record except its times."""
        lens, s = self.lens, self.settings
        state = [__version__, lens.sha256, lens.stop_radius_mm, lens.image_radius_mm]
        rays = [asdict(s.domain), asdict(s.pairs), s.evaluation.vignetting_rays]
        return fingerprint_of([*state, *rays, asdict(row.settings)])


def run_bench(
    benches: Sequence[Bench], rows: Sequence[Row], progress: Progress, *, again: bool = False
) -> Iterator[tuple[Bench, list[dict[str, Any]]]]:
    """Lens by lens, the records of its rows; existing ones are recomputed only `again`."""
    slow = (*NETWORKS, "neurolens2017")
    for bench in benches:
        progress.plan({f"{bench.name}: {r.name}": 40.0 if r.settings.method in slow else 4.0 for r in rows})
        progress.plan({f"{bench.name}: race": 15.0})
    for bench in benches:
        records = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NeurolensWarning)
            for row in rows:
                with progress.stage(f"{bench.name}: {row.name}") as report:
                    records.append(_record(bench, row, again, report))
            with progress.stage(f"{bench.name}: race") as report:
                _add_times(bench, rows, records, report)
        yield bench, records


def _record(bench: Bench, row: Row, again: bool, report: Report) -> dict[str, Any]:
    """An existing record of the same settings, or a new one, with its failure if it fails."""
    file, mark = bench.record_file(row), ""
    head = {"lens": bench.name, "method": row.name, "group": row.group, "source": row.source}
    try:
        mark = bench.fingerprint(row)
        known = None if again else _known_record(file, mark)
        if known is not None and (known["failed"] or bench.model_file(row).is_file()):
            return known
        file.unlink(missing_ok=True)  # an interruption must not leave a record of removed files
        made = {"failed": None, **_fit_and_measure(bench, row, report)}
    except Exception as error:  # a row with the reason; other methods and lenses continue
        # Expected errors are permanent; unexpected ones are retried by the next run.
        mark = mark if isinstance(error, NeurolensError) else ""
        made = {"failed": _reason(error)}
    record = plain({"fingerprint": mark, **head, "settings": asdict(row.settings), **made})
    write_kept(file, record)
    return record


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split()).replace(f"{Path.cwd()}/", "")[:300]
    return text if isinstance(error, NeurolensError) else f"{type(error).__name__}: {text}"


def _fit_and_measure(bench: Bench, row: Row, report: Report) -> dict[str, Any]:
    """Errors of the exported graph in onnxruntime."""
    prepared, file = bench.prepared, bench.model_file(row)
    model = fit_any(prepared, row.settings, report)
    file.parent.mkdir(parents=True, exist_ok=True)
    export_onnx(model, file, {})
    found = measure(bench.rays, onnx_predictor(load_model(file)))
    figures = {key: found.figures[key] for key in _FIGURES}
    # Micrometres at the common scale of lenses of different size.
    scale = REFERENCE_RADIUS_MM / image_radius_mm(bench.lens)[0]
    scaled = {
        f"{key}_at_21_6": None if (value := figures[key]) is None else scale * value
        for key in ("p99_um", "max_um", "position_rms_um")
    }
    network = row.settings.method in NETWORKS
    return {
        **figures,
        **scaled,
        "stopped_down": found.stopped_down,
        "zones": found.zones,
        "coefficients_per_vector": None if network else model.core.coefficients_per_vector,
        "parameters": model.core.coefficients,
        "rims": len(model.gates),
        "bytes": file.stat().st_size,
        "fit_s": model.fit_s,
        "load_s": seconds_to_load(file),
        "film_radius_mm": bench.domain.film_radius_mm,
        "passing_share": float(bench.rays.passes.double().mean()),
    }


def _add_times(bench: Bench, rows: Sequence[Row], records: list[dict[str, Any]], report: Report) -> None:
    """Race all models of one lens and the exact tracer, and add the times to the records, unless that was done."""
    s = bench.settings.evaluation
    files = {row.name: bench.model_file(row) for row, r in zip(rows, records, strict=True) if not r["failed"]}
    if not s.rounds or not files:
        return
    hashes = {name: sha256_of(file) for name, file in sorted(files.items())}
    mark = fingerprint_of([hashes, s.rounds])
    if all(record.get("race") == mark for record in records if record["method"] in files):
        return
    domain = bench.domain
    lens = bench.lens.with_stop_radius(domain.stop_radius_mm)
    # "NAME fused" too, where a C compiler makes one. Torch's tracer takes microseconds for a coated ray.
    candidates = [exact_c_candidate(lens, domain), *model_candidates(files, domain)]
    timed = race(candidates, domain, rounds=s.rounds, report=report)
    for i, (row, record) in enumerate(zip(rows, records, strict=True)):
        if row.name in files:
            records[i] = plain({**record, **_times_of(record, timed), "race": mark})
            write_kept(bench.record_file(row), records[i])


def _known_record(file: Path, fingerprint: str) -> dict[str, Any] | None:
    """A record; None if it is missing, damaged or of other settings."""
    record = read_kept(file)
    return record if record is not None and record.get("fingerprint") == fingerprint else None


def _times_of(record: Mapping[str, Any], timed: Race) -> dict[str, Any]:
    """Times of one model for its record, held against the exact lens as C of the same race.

    Returns: ns_per_ray, speedup (by the minima), break_even_rays (after which fitting and loading pay off; "never"
        where the exact tracer is as fast), the same with "fused_" before, and exact: that lens's time.
    """
    found = dict[str, Any]()
    for prefix, name in (("", record["method"]), ("fused_", f"{record['method']} fused")):
        gain = timed.gain(name, EXACT[1], record["fit_s"], record["load_s"])
        never = "never" if gain.speedup is not None else None
        found |= {
            f"{prefix}ns_per_ray": gain.ns_per_ray,
            f"{prefix}speedup": gain.speedup,
            f"{prefix}break_even_rays": gain.break_even_rays or never,
        }
    return {
        **found,
        "exact": exact_records(timed),
    }
