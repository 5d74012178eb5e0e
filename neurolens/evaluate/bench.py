"""Speed against the promises: `python -m neurolens.evaluate.bench` (`make bench`).

Races each model of models/ against the exact tracer of its lens, the thin lens and the pinhole, all in one run, writes
the table to experiments/results/, and fails when a model is slower, relative to the compiled exact tracer, than
models/index.json promises. `--trace` times the exact tracer alone on every lens file.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from neurolens.cameras.model import load_model
from neurolens.errors import InputError, NeurolensError
from neurolens.evaluate.candidates import exact_candidates, ideal_cameras, model_candidate
from neurolens.evaluate.layout import refractions
from neurolens.evaluate.speed import Race, race
from neurolens.evaluate.speed_table import COMPILED, markdown, notes, table_rows
from neurolens.files import atomic_write_text
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain, domain_of

ROOT = Path(__file__).parents[2]


@dataclass
class Outcome:
    """Rows of the table, and what failed.

    Attributes:
        rows: one a candidate, with units in the keys.
        missed: promises that were not kept, in words.
        checked, unchecked: promises held against a measurement, and those that could not be.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    checked: int = 0
    unchecked: list[str] = field(default_factory=list)


Save = Callable[[Outcome], None]


def read_index(folder: Path) -> list[dict[str, Any]]:
    """Rows of models/index.json.

    Raises:
        InputError: no such file, not JSON, or rows without a model file or a lens file.
    """
    path = folder / "index.json"
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["models"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, "file", f"({type(error).__name__}: {error})", "the index that `make models` writes"
        ) from error
    if not isinstance(rows, list):
        raise InputError(path, "models", type(rows).__name__, "a list")
    for i, row in enumerate(rows):
        for key in ("file", "lens_file"):
            if not isinstance(row, dict) or not isinstance(row.get(key), str):
                raise InputError(path, f"models {i}, {key}", "(missing)", "the name of a file")
    return rows


def bench_models(folder: Path, only: str, threads: int, rounds: int, save: Save) -> Outcome:
    """Race the models of an index, lens by lens; `save` what there is after each."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in read_index(folder):
        if only in row["file"]:
            groups.setdefault((row["lens_file"], row.get("configuration"), row.get("efl_mm")), []).append(row)
    if not groups:
        raise InputError(folder / "index.json", "models", "(none)", f"models with {only!r} in the file's name")
    outcome = Outcome()
    for (lens_file, configuration, efl_mm), rows in groups.items():
        state = " ".join([Path(lens_file).stem, *([str(configuration)] if configuration else [])])
        _say(f"{state}: compiling and timing, {len(rows)} models ...")
        lens = read_lens(ROOT / lens_file).at(configuration=configuration, efl_mm=efl_mm)
        models = {row["file"]: load_model(folder / row["file"], lens.sha256) for row in rows}
        domain = Domain.from_dict(next(iter(models.values())).card["domain"])
        lens = lens.with_stop_radius(domain.stop_radius_mm)
        candidates = exact_candidates(lens, domain)
        for name, model in models.items():
            candidates.append(model_candidate(name, model, domain.stop_radius_mm))
        candidates += ideal_cameras(lens, domain)
        timed = race(candidates, domain, threads=threads, rounds=rounds)
        outcome.rows += table_rows(state, timed)
        hold_to_promises(rows, timed, outcome)
        save(outcome)
    return outcome


def hold_to_promises(rows: Sequence[dict[str, Any]], timed: Race, outcome: Outcome) -> None:
    """Add to `outcome` what became of each row's `promised_speedup` over the compiled exact tracer.

    The larger of the two ratios counts (by minima, median within rounds): a busy machine spoils one of them at a time.
    """
    for row in rows:
        promised = row.get("promised_speedup")
        if promised is None:
            continue
        found = timed.speedup(row["file"], COMPILED)
        if found is None:
            reason = timed.unavailable.get(COMPILED) or timed.unavailable.get(row["file"]) or "not timed"
            outcome.unchecked.append(f"{row['file']}: {reason}")
            continue
        outcome.checked += 1
        best = max(found.values())
        if not best >= promised:
            outcome.missed.append(f"{row['file']}: {best:.3g} times the compiled exact tracer, promised {promised:g}")


def bench_trace(only: str, rounds: int, threads: Sequence[int], dtypes: Sequence[torch.dtype], save: Save) -> Outcome:
    """Race the exact tracer on every lens file: tracing alone by precision, and all that a camera needs."""
    outcome = Outcome()
    for path in sorted((ROOT / "lenses").glob("*.toml")):
        if only not in path.stem:
            continue
        lens = read_lens(path).at()
        domain = domain_of(lens)
        for count in threads:
            _say(f"{path.stem}: compiling and timing on {count} thread{'s' * (count > 1)} ...")
            timed = race(trace_candidates(lens, domain, dtypes), domain, threads=count, rounds=rounds)
            outcome.rows += table_rows(f"{path.stem} ({_work(lens)})", timed)
            save(outcome)
    return outcome


def trace_candidates(lens: Lens, domain: Domain, dtypes: Sequence[torch.dtype]) -> list[Any]:
    """Rays made beforehand, no transmittance; in float32 also from film and pupil points, with transmittance."""
    candidates = []
    for dtype in dtypes:
        label = "trace " + str(dtype).removeprefix("torch.")
        candidates += exact_candidates(lens, domain, dtype=dtype, transmittance=False, build_rays=False, label=label)
    if torch.float32 in dtypes:
        candidates += exact_candidates(lens, domain, label="camera float32")
    return candidates


def _work(lens: Lens) -> str:
    """What tracing this lens takes, in words."""
    return f"{refractions(lens)} refractions" + ("" if lens.dispersive else ", no dispersion")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """The command: 0 where every promise that could be checked is kept, 1 where one is not, 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m neurolens.evaluate.bench", description=__doc__)
    parser.add_argument("--models", type=Path, default=ROOT / "models", help="folder with index.json")
    parser.add_argument("--only", default="", help="models (with --trace: lens files) whose names hold this text")
    parser.add_argument("--threads", type=int, default=1, help="workers that share out batches (default 1)")
    parser.add_argument("--rounds", type=int, default=20, help="times that each candidate is timed (default 20)")
    parser.add_argument("--out", type=Path, default=ROOT / "experiments" / "results", help="folder for the tables")
    parser.add_argument(
        "--trace", action="store_true", help="the exact tracer alone, 1 and 2 threads, float32 and float64"
    )
    a = parser.parse_args(argv)
    warnings.simplefilter("ignore")
    name, title = ("trace", "The exact tracer") if a.trace else ("bench", "Models against the exact tracer")
    threads = "1 and 2 threads" if a.trace else f"{a.threads} thread" + "s" * (a.threads > 1)

    def save(outcome: Outcome) -> None:
        a.out.mkdir(parents=True, exist_ok=True)
        atomic_write_text(a.out / f"{name}.md", markdown(title, notes(threads, a.rounds), outcome.rows))
        atomic_write_text(a.out / f"{name}.json", json.dumps({"rows": outcome.rows}, indent=1) + "\n")

    try:
        if a.trace:
            outcome = bench_trace(a.only, a.rounds, (1, 2), (torch.float32, torch.float64), save)
        else:
            outcome = bench_models(a.models, a.only, a.threads, a.rounds, save)
    except NeurolensError as error:
        print(error, file=sys.stderr)
        return 2
    print(markdown(title, notes(threads, a.rounds), outcome.rows))
    for line in outcome.unchecked:
        print(f"not checked: {line}")
    for line in outcome.missed:
        print(f"SLOWER THAN PROMISED: {line}", file=sys.stderr)
    if not a.trace:
        print(f"{outcome.checked - len(outcome.missed)} of {outcome.checked + len(outcome.unchecked)} promises kept")
    return 1 if outcome.missed else 0


if __name__ == "__main__":
    sys.exit(main())
