"""Makes the models that ship: `python -m neurolens.evaluate.make_models` (`make models`).

Reads experiments/models.toml; writes models/*.onnx, models/index.json (error, time, size and the speed-up that
`make bench` holds each model to) and models/README.md, the same as a table.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neurolens.cameras.model import load_model
from neurolens.config import read_config
from neurolens.errors import InputError, NeurolensError
from neurolens.evaluate.bench import read_index
from neurolens.evaluate.candidates import exact_candidates, model_candidate
from neurolens.evaluate.experiment import DomainChoice, Experiment, LensChoice, check_names
from neurolens.evaluate.measure import Measured, fit_and_measure
from neurolens.evaluate.project import project_root
from neurolens.evaluate.speed import race
from neurolens.evaluate.train import versions
from neurolens.files import atomic_path, atomic_write_text
from neurolens.progress import Progress
from neurolens.surrogates.fit import ModelSettings, prepare
from neurolens.surrogates.pairs import PairSettings, make_pairs

_HEAD = """# Models that ship

Made by `make models` from experiments/models.toml. Errors on held-out rays at full aperture (definition:
`neurolens.evaluate.rays`); times on one core in onnxruntime, with stop, rims and transmittance; speed-up over the
compiled exact tracer doing the same work in the same run. Coefficients: of one vector output for polynomials, all
weights for networks. Check one with `neurolens evaluate models/FILE`, the speed of all with `make bench`.

| model | RMS um | p99 um | direction RMS deg | false pass / block % | coefficients | kB | ns per ray | speed-up |
|---|---|---|---|---|---|---|---|---|
"""
# The bench fails below this share of the speed-up measured here: machines and days differ, regressions differ more.
PROMISE = 0.8
_KEPT = (
    "rms_um p99_um direction_rms_deg position_rms_um transmittance_rms false_pass false_block "
    "coefficients_per_vector parameters bytes fit_s"
).split()


_SHOWN = (*_KEPT, "ns_per_ray", "speedup_over_compiled")  # what the table needs of a row


def _default_models() -> tuple[ModelSettings, ...]:
    polynomials = tuple(ModelSettings(method="ols", terms=terms) for terms in (60, 100))
    return *polynomials, ModelSettings(method="mlp", units=16), ModelSettings(method="mlp", units=32, steps=20)


@dataclass(frozen=True)
class Entry:
    """One lens in one state and the models made of it."""

    lens: LensChoice
    domain: DomainChoice = field(default_factory=DomainChoice)
    models: tuple[ModelSettings, ...] = field(default_factory=_default_models)

    def __post_init__(self) -> None:
        check_names("lens", [self.state])
        check_names("models", [m.label for m in self.models])

    @property
    def state(self) -> str:
        """Name of the lens and its state, as model files carry it."""
        c = self.lens
        parts = [c.file.stem, c.configuration or "", f"{c.efl_mm:g}mm" if c.efl_mm else ""]
        return "-".join(p for p in parts if p)

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the model files, in the order of `models`."""
        return tuple(f"{self.state}.{m.label}.onnx" for m in self.models)


@dataclass(frozen=True)
class Library:
    """All entries, and the ray pairs of each."""

    entry: tuple[Entry, ...]
    pairs: PairSettings = field(default_factory=PairSettings)

    def __post_init__(self) -> None:
        files = [name for e in self.entry for name in e.files]
        twice = sorted({f for f in files if files.count(f) > 1})
        if not files or twice:
            raise InputError("settings", "entry", twice or "(none)", "at least one model, each of a file of its own")


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
        for name, m in zip(entry.files, measured, strict=True):
            with atomic_path(out / name) as temporary:
                temporary.write_bytes(m.file.read_bytes())
            timing, speedup = timed.timing(m.settings.label), timed.speedup(m.settings.label, "exact compiled")
            row: dict[str, Any] = {
                "file": name,
                "lens_file": Path(os.path.relpath(choice.file.resolve(), project_root().resolve())).as_posix(),
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


def make_library(library: Library, folder: Path, out: Path, progress: Progress) -> None:
    """Make every entry, lens files lying relative to `folder`.

    The index is whole at any time: rows are replaced one entry at a time, and rows of models that the library no longer
    names go when all is done, so that an interrupted run leaves the other models in it.
    """
    try:
        rows = {row["file"]: row for row in read_index(out) if row.keys() >= set(_SHOWN)}
    except InputError:
        rows = {}  # none yet, or one that cannot be read and is replaced
    for entry in library.entry:
        rows |= {row["file"]: row for row in make_entry(entry, library.pairs, folder, out, progress)}
        write_index(list(rows.values()), out)
    write_index([rows[name] for entry in library.entry for name in entry.files], out)


def main(argv: Sequence[str] | None = None) -> int:
    """Make every entry; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m neurolens.evaluate.make_models", description=__doc__)
    parser.add_argument(
        "--experiment", type=Path, help="list of models (default: the project's experiments/models.toml)"
    )
    parser.add_argument("--out", type=Path, help="folder for models and index (default: the project's models/)")
    a = parser.parse_args(argv)
    warnings.simplefilter("ignore")
    try:
        source = a.experiment or project_root() / "experiments" / "models.toml"
        out = a.out or project_root() / "models"
        library = read_config(Library, source)
        out.mkdir(parents=True, exist_ok=True)
        make_library(library, source.parent, out, Progress())
    except NeurolensError as error:
        print(error, file=sys.stderr)
        return 2
    print((out / "README.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
