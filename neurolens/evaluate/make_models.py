"""Makes the models that ship: `python -m neurolens.evaluate.make_models` (`make models`).

Reads experiments/models.toml; writes models/*.onnx, models/index.json (error, time, size and the speed-up that
`make bench` holds each model to) and models/README.md, the same as a table.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neurolens.cameras.model import load_model
from neurolens.config import read_config
from neurolens.errors import NeurolensError
from neurolens.evaluate.candidates import exact_candidates, model_candidate
from neurolens.evaluate.experiment import DomainChoice, Experiment, LensChoice
from neurolens.evaluate.measure import Measured, fit_and_measure
from neurolens.evaluate.speed import race
from neurolens.evaluate.train import versions
from neurolens.files import atomic_path, atomic_write_text
from neurolens.progress import Progress
from neurolens.surrogates.fit import ModelSettings, prepare
from neurolens.surrogates.pairs import PairSettings, make_pairs

ROOT = Path(__file__).parents[2]
_HEAD = """# Models that ship

Made by `make models` from experiments/models.toml. Errors on held-out rays at full aperture (definition:
`neurolens.evaluate.rays`); times on one core in onnxruntime, with stop, rims and transmittance; speed-up over the
compiled exact tracer doing the same work in the same run. Coefficients: of one vector output for polynomials, all
weights for networks. Check one with `neurolens evaluate models/FILE`, the speed of all with `make bench`.

| model | RMS um | p99 um | direction RMS deg | false pass / block % | coefficients | kB | ns per ray | speed-up |
|---|---|---|---|---|---|---|---|---|
"""
# The bench fails below this share of the speed-up measured here: machines and days differ, regressions differ more.
PROMISE = 0.6
_KEPT = (
    "rms_um p99_um direction_rms_deg position_rms_um transmittance_rms false_pass false_block "
    "coefficients_per_vector parameters bytes fit_s"
).split()


def _default_models() -> tuple[ModelSettings, ...]:
    return ModelSettings(method="ols", terms=60), ModelSettings(method="mlp", units=16)


@dataclass(frozen=True)
class Entry:
    """One lens in one state and the models made of it."""

    lens: LensChoice
    domain: DomainChoice = field(default_factory=DomainChoice)
    models: tuple[ModelSettings, ...] = field(default_factory=_default_models)

    @property
    def state(self) -> str:
        """Name of the lens and its state, as model files carry it."""
        c = self.lens
        parts = [c.file.stem, c.configuration or "", f"{c.efl_mm:g}mm" if c.efl_mm else ""]
        return "-".join(p for p in parts if p)


@dataclass(frozen=True)
class Library:
    """All entries, and the ray pairs of each."""

    entry: tuple[Entry, ...]
    pairs: PairSettings = field(default_factory=PairSettings)


def make_entry(entry: Entry, pairs: PairSettings, folder: Path, out: Path, progress: Progress) -> list[dict[str, Any]]:
    """Fit and time the models of one lens; returns rows of the index."""
    choice = LensChoice(folder / entry.lens.file, entry.lens.efl_mm, entry.lens.configuration, entry.lens.f_number)
    experiment = Experiment(title=entry.state, lens=choice, model=entry.models, domain=entry.domain, pairs=pairs)
    lens = choice.read()
    domain = experiment.domain_of(lens)
    prepared = prepare(make_pairs(lens, domain, pairs))
    measured: list[Measured] = []
    with tempfile.TemporaryDirectory() as scratch:
        for settings in entry.models:
            with progress.stage(f"{entry.state}: {settings.label}") as report:
                measured.append(fit_and_measure(prepared, settings, Path(scratch), 200_000, report))
        candidates = exact_candidates(lens, domain)
        candidates += [model_candidate(m.settings.label, load_model(m.file), domain.stop_radius_mm) for m in measured]
        with progress.stage(f"{entry.state}: race"):
            timed = race(candidates, domain)
        rows = []
        for m in measured:
            name = f"{entry.state}.{m.settings.label}.onnx"
            with atomic_path(out / name) as temporary:
                temporary.write_bytes(m.file.read_bytes())
            timing, speedup = timed.timing(m.settings.label), timed.speedup(m.settings.label, "exact compiled")
            row: dict[str, Any] = {
                "file": name,
                "lens_file": f"lenses/{entry.lens.file.name}",
                "lens": lens.name,
                "configuration": entry.lens.configuration,
                "efl_mm": entry.lens.efl_mm,
                "model": m.settings.label,
                **{k: m.record.get(k) for k in _KEPT},
                "ns_per_ray": timing,
                "exact_compiled_ns_per_ray": timed.timing("exact compiled"),
                "speedup_over_compiled": speedup["min"] if speedup else None,
                "promised_speedup": round(PROMISE * speedup["min"], 2) if speedup else None,
            }
            rows.append(row)
    return rows


def write_index(rows: list[dict[str, Any]], out: Path) -> None:
    """index.json and README.md."""
    index = {"schema": 1, "command": "make models", "versions": versions(), "models": rows}
    atomic_write_text(out / "index.json", json.dumps(index, indent=1, allow_nan=False) + "\n")
    lines = [
        f"| {r['file']} | {_n(r['rms_um'])} | {_n(r['p99_um'])} | {_n(r['direction_rms_deg'])} | "
        f"{_n(r['false_pass'], 100)} / {_n(r['false_block'], 100)} | "
        f"{r['coefficients_per_vector'] or r['parameters']} | {r['bytes'] / 1000:.0f} | "
        f"{_n((r['ns_per_ray'] or {}).get('min'))} | {_n(r['speedup_over_compiled'])} |"
        for r in rows
    ]
    atomic_write_text(out / "README.md", _HEAD + "\n".join(lines) + "\n")


def _n(value: float | None, factor: float = 1.0) -> str:
    return "–" if value is None else f"{value * factor:.3g}"


def main() -> int:
    """Make every entry; returns the exit status."""
    warnings.simplefilter("ignore")
    source, out = ROOT / "experiments" / "models.toml", ROOT / "models"
    out.mkdir(exist_ok=True)
    try:
        library = read_config(Library, source)
        progress = Progress()
        rows: list[dict[str, Any]] = []
        for entry in library.entry:
            rows += make_entry(entry, library.pairs, source.parent, out, progress)
            write_index(rows, out)
    except NeurolensError as error:
        print(error, file=sys.stderr)
        return 2
    print((out / "README.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
