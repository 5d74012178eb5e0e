"""Speed against the promises: `python -m neurolens.evaluate.bench` (`make bench`).

Races each model of which models/index.json promises a speed-up against the exact tracer of its lens, the thin lens and
the pinhole, all in one run, writes the table to experiments/results/, and fails when a model is slower, relative to the
compiled exact tracer, than promised, or when tracer or renderer fall below their floors (`floors`). `neurolens bench
trace` times the exact tracer alone.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.files import atomic_write_text
from neurolens.cameras.model import load_model
from neurolens.evaluate.benches.floors import Floor, check_floors, floor_table
from neurolens.evaluate.candidates import exact_candidates, ideal_cameras, model_candidate
from neurolens.evaluate.project import project_root
from neurolens.evaluate.speed import Race, race
from neurolens.evaluate.speed_table import COMPILED, markdown, notes, table_rows
from neurolens.optics.lensfile import read_lens
from neurolens.surrogates.domain import Domain


@dataclass
class Outcome:
    """Rows of the table, and what failed.

    Attributes:
        rows: one a candidate, with units in the keys.
        missed: promises that were not kept, in words.
        checked, unchecked: promises held against a measurement, and those that could not be.
        floors: of the tracer and the renderer.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    checked: int = 0
    unchecked: list[str] = field(default_factory=list)
    floors: list[Floor] = field(default_factory=list)


Save = Callable[[Outcome], None]


def read_index(folder: Path) -> list[dict[str, Any]]:
    """Rows of models/index.json.

    Raises:
        InputError: no such file, not JSON, rows without a model file or a lens file, or a model elsewhere.
    """
    path = folder / "index.json"
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["models"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, "file", f"({type(error).__name__}: {error})", "the index that `neurolens bench models` writes"
        ) from error
    if not isinstance(rows, list):
        raise InputError(path, "models", type(rows).__name__, "a list")
    for i, row in enumerate(rows):
        for key in ("file", "lens_file"):
            if not isinstance(row, dict) or not isinstance(row.get(key), str):
                raise InputError(path, f"models {i}, {key}", "(missing)", "the name of a file")
        if Path(row["file"]).name != row["file"]:  # files that an index names may be removed
            raise InputError(path, f"models {i}, file", row["file"], "the name of a file beside the index")
    return rows


def bench_models(root: Path, folder: Path, only: str, threads: int, rounds: int, save: Save) -> Outcome:
    """Race the models of an index, lens by lens, their lens files below `root`; `save` what there is after each.

    Without `only`, those of which the index promises a speed-up.
    """
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in read_index(folder):
        if only in row["file"] and (only or row.get("promised_speedup") is not None):
            groups.setdefault((row["lens_file"], row.get("configuration"), row.get("efl_mm")), []).append(row)
    if not groups:
        raise InputError(folder / "index.json", "models", "(none)", f"models with {only!r} in the file's name")
    outcome = Outcome()
    for (lens_file, configuration, efl_mm), rows in groups.items():
        state = " ".join([Path(lens_file).stem, *([str(configuration)] if configuration else [])])
        _say(f"{state}: compiling and timing, {len(rows)} models ...")
        lens = read_lens(root / lens_file).at(zoom=configuration, focal_length_mm=efl_mm)
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


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """The command: 0 where all that could be checked is kept, 1 where something is not, 2 for bad input."""
    a = _parser().parse_args(argv)
    warnings.simplefilter("ignore")
    threads = f"{a.threads} thread" + "s" * (a.threads > 1)

    def page(outcome: Outcome) -> str:
        floors = f"\n## Floors\n\n{floor_table(outcome.floors)}" if outcome.floors else ""
        return markdown("Models against the exact tracer", notes(threads, a.rounds), outcome.rows) + floors

    try:
        root = project_root()
        out = a.out or root / "experiments" / "results"

        def save(outcome: Outcome) -> None:
            out.mkdir(parents=True, exist_ok=True)
            atomic_write_text(out / "bench.md", page(outcome))
            data = {"rows": outcome.rows, "floors": [{**asdict(f), "verdict": f.verdict} for f in outcome.floors]}
            atomic_write_text(out / "bench.json", json.dumps(data, indent=1) + "\n")

        outcome = bench_models(root, a.models or root / "models", a.only, a.threads, a.rounds, save)
        if not a.only:
            _say("floors of the tracer and the renderer ...")
            outcome.floors = check_floors(root, a.rounds)
            save(outcome)
    except NeurolensError as error:
        print(error, file=sys.stderr)
        return 2
    print(page(outcome))
    return verdict(outcome)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m neurolens.evaluate.bench", description=__doc__)
    parser.add_argument("--models", type=Path, help="folder with index.json (default: the project's models/)")
    parser.add_argument("--only", default="", help="models whose names hold this text, promised or not; no floors then")
    parser.add_argument("--threads", type=int, default=1, help="workers that share out batches (default 1)")
    parser.add_argument("--rounds", type=int, default=20, help="times that each candidate is timed (default 20)")
    parser.add_argument("--out", type=Path, help="folder for the tables (default: the project's experiments/results)")
    return parser


def verdict(outcome: Outcome) -> int:
    """Print what was kept, missed and not checked; 1 where a promise or a floor was missed."""
    for line in outcome.unchecked:
        print(f"not checked: {line}")
    for line in outcome.missed:
        print(f"SLOWER THAN PROMISED: {line}", file=sys.stderr)
    below = [f for f in outcome.floors if f.verdict == "FAIL"]
    for f in below:
        print(f"BELOW ITS FLOOR: {f.name}: {f.measured:.3g} {f.unit}, at least {f.floor:g}", file=sys.stderr)
    print(f"{outcome.checked - len(outcome.missed)} of {outcome.checked + len(outcome.unchecked)} promises kept")
    if outcome.unchecked and not outcome.checked:
        reason = outcome.unchecked[0].partition(": ")[2]
        print(f"UNCHECKED: no promise could be checked here ({reason})", file=sys.stderr)
    return 1 if outcome.missed or below else 0


if __name__ == "__main__":
    sys.exit(main())
