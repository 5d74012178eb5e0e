"""Race each model of which models/index.json promises a speed-up against the exact tracer of its lens (`make bench`).

All models of a lens race in one run with it, on rays uniform over film and pupil disc of their domain, blocked ones
included; then the floors of the tracer and the renderer, and of the README's ratios: a fitted polynomial as C over the
exact lens as C. Prints the times. Exit code 1 where a model as C is slower, relative to the exact lens as C, than
promised, or where a floor is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.lab import Row
from experiments.speed import fused_speed
from neurolens.base.errors import InputError
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import load_model
from neurolens.models.fit import ModelSettings, prepare
from neurolens.models.fitted import Domain
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.models.source import fused_program
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene
from neurolens.studies.speed import (
    EXACT,
    Race,
    exact_c_candidate,
    model_candidates,
    program_candidate,
    race,
)

LENS, SCENE = "laikin_double_gauss_50", lab.SCENES / "room.toml"
TRACER_MRAY_S = 20.0  # 12 refractions, with stop, rims and transmittance
# A polynomial within 1 um, with stop, rims and transmittance, must be so many times as fast as the exact lens as C:
# three quarters of the README's ratios, since machines differ.
RATIOS = {(2, 38): 3.3, (3, 28): 13.0}  # by the case and the terms of `fused_speed`
RENDER_MPATH_S = 1.0  # the room, depth 3, two cores


@dataclass
class Outcome:
    """The promises that were checked, those that could not be, and those that were not kept, as sentences.

    `floors`: least speeds of the tracer and the renderer.
    """

    missed: list[str] = field(default_factory=list)
    checked: int = 0
    unchecked: list[str] = field(default_factory=list)
    floors: list[lab.Goal] = field(default_factory=list)


def read_index(folder: Path) -> list[dict[str, Any]]:
    """Rows of models/index.json.

    Raises:
        InputError: no such file, not JSON, rows without a model file or a lens file, or a model elsewhere.
    """
    path = folder / "index.json"
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["models"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = "the index that `python -m experiments models` writes"
        raise InputError(path, "file", f"({type(error).__name__}: {error})", expected) from error
    if not isinstance(rows, list):
        raise InputError(path, "models", type(rows).__name__, "a list")
    for i, row in enumerate(rows):
        for key in ("file", "lens_file"):
            if not isinstance(row, dict) or not isinstance(row.get(key), str):
                raise InputError(path, f"models {i}, {key}", "(missing)", "the name of a file")
        if Path(row["file"]).name != row["file"]:  # files that an index names may be removed
            raise InputError(path, f"models {i}, file", row["file"], "the name of a file beside the index")
    return rows


def bench_models(args: argparse.Namespace) -> Outcome:
    """Race the models of the index in `args.models`, lens by lens, and print their times.

    Without --only, those of which the index promises a speed-up.
    """
    folder, only, groups = args.models, args.only, dict[tuple[Any, ...], list[Row]]()
    for row in read_index(folder):
        if only in row["file"] and (only or row.get("promised_speedup") is not None):
            groups.setdefault((row["lens_file"], row.get("configuration"), row.get("efl_mm")), []).append(row)
    if not groups:
        raise InputError(folder / "index.json", "models", "(none)", f"models with {only!r} in the file's name")
    outcome = Outcome()
    for group, report in lab.stages(groups, _state, args.quiet, 60.0):
        rows, (lens_file, configuration, efl_mm) = groups[group], group
        lens = lab.lens_of(lab.ROOT / lens_file, zoom=configuration, focal_length_mm=efl_mm)
        models = {row["file"]: folder / row["file"] for row in rows}
        domain = Domain.from_dict([load_model(file, lens.sha256) for file in models.values()][0].card["domain"])
        lens = lens.with_stop_radius(domain.stop_radius_mm)
        candidates = [exact_c_candidate(lens, domain), *model_candidates(models, domain)]
        timed = race(candidates, domain, rounds=args.rounds, report=report)
        print(f"{_state(group)}\n{times(timed)}\n")
        hold_to_promises(rows, timed, outcome)
    return outcome


def times(timed: Race) -> str:
    """A table of the times of a race, and of the speed-ups over the exact lens as C."""
    rows = []
    for name in (*timed.ns, *timed.unavailable):
        timing, ratio = timed.timing(name), timed.speedup(name, EXACT[1])
        cells = (timing["min"], timing["median"]) if timing else ()
        shown = lab.best_median(*cells, form=".1f") if cells else f"unavailable: {timed.unavailable.get(name)}"
        rows.append([name, shown, lab.best_median(ratio["min"], ratio["median"]) if ratio else None])
    return lab.table("candidate|ns per ray, best (median)|over exact C", rows)


def _state(group: tuple[Any, ...]) -> str:
    """Words for the lens and the state of a group of models."""
    return " ".join([Path(group[0]).stem, *([str(group[1])] if group[1] else [])])


def hold_to_promises(rows: Sequence[dict[str, Any]], timed: Race, outcome: Outcome) -> None:
    """Add to `outcome` the result for each row's `promised_speedup` as C over the exact lens as C.

    The larger of the two ratios counts (by minima, median within rounds): a busy machine affects one of them at a time.
    """
    for row in rows:
        promised = row.get("promised_speedup")
        if promised is None:
            continue
        ratios = timed.speedup(f"{row['file']} fused", EXACT[1])
        if ratios is None:
            reason = timed.unavailable.get(EXACT[1]) or timed.unavailable.get(f"{row['file']} fused") or "not timed"
            outcome.unchecked.append(f"{row['file']}: {reason}")
            continue
        outcome.checked += 1
        best = max(ratios.values())
        if not best >= promised:
            outcome.missed.append(f"{row['file']}: {best:.3g} times the exact lens as C, promised {promised:g}")


def check_floors(rounds: int) -> list[lab.Goal]:
    """Measure the floors; the best of the rounds counts, as a busy machine only ever slows."""
    lens = lab.lens_of(LENS)
    domain = domain_of(lens)
    timed = race([exact_c_candidate(lens, domain)], domain, rounds=rounds)
    timing = timed.timing(EXACT[1])
    speed, reason = (1000 / timing["min"], "") if timing else (None, timed.unavailable[EXACT[1]])
    text = "exact lens as C, coated, one core, float32, Mray/s"
    floors = [lab.Goal(text, TRACER_MRAY_S, speed, at_least=True, worst=reason)]
    for (case, terms), least in RATIOS.items():
        floors.append(ratio_as_c(fused_speed.CASES[case], terms, least, rounds))
    scene = load_scene(SCENE)
    shot = scene.settings.camera
    camera = ThinLens(50.0, shot.f_number or 2.8, shot.focus_m, shot.film_mm)
    drawn = [render(scene, camera, seed=k, threads=2, max_depth=3, samples=16) for k in range(5)]
    speed = max(float(picture.stats.mpaths_per_s) for picture in drawn)
    return [*floors, lab.Goal("render of the room, two cores, depth 3, Mpath/s", RENDER_MPATH_S, speed, at_least=True)]


def ratio_as_c(case: fused_speed.Case, terms: int, least: float, rounds: int) -> lab.Goal:
    """The goal of a polynomial as C over the exact lens as C; one beyond 1 um has no ratio."""
    lens = case.lens()
    domain = domain_of(lens, film_radius_mm=case.film_radius_mm, focus_m=(math.inf, case.near_m))
    settings = [ModelSettings("ols", terms=terms, idle_gates=fused_speed.IDLE)]
    model, error = fused_speed.small_enough(prepare(make_pairs(lens, domain, PairSettings())), settings)
    fitted = program_candidate("fitted", fused_program([model]), domain)
    timed = race([exact_c_candidate(lens, domain), fitted], domain, rounds=rounds)
    ratio = timed.speedup("fitted", EXACT[1]) if error <= fused_speed.WITHIN_UM else None
    text = f"times as fast as exact C, {lens.refractions} refractions, ols-{terms} as C, whole"
    best, reason = max(ratio.values()) if ratio else None, f"{error:.2g} um; {timed.unavailable or ''}"
    return lab.Goal(text, least, best, at_least=True, worst=reason)


def report_outcome(outcome: Outcome) -> int:
    """Print what was kept, missed and not checked; 1 where a promise or a floor was missed."""
    for line in outcome.unchecked:
        print(f"not checked: {line}")
    for line in outcome.missed:
        print(f"SLOWER THAN PROMISED: {line}", file=sys.stderr)
    below = [f for f in outcome.floors if f.verdict == "missed"]
    for f in below:
        print(f"BELOW ITS FLOOR: {f.text}: {f.measured:.3g}, at least {f.wanted:g}", file=sys.stderr)
    print(f"{outcome.checked - len(outcome.missed)} of {outcome.checked + len(outcome.unchecked)} promises kept")
    if outcome.unchecked and not outcome.checked:
        reason = outcome.unchecked[0].partition(": ")[2]
        print(f"UNCHECKED: no promise could be checked here ({reason})", file=sys.stderr)
    return 1 if outcome.missed or below else 0


OPTIONS = (
    lab.option("--models", metavar="DIR", type=Path, default=lab.MODELS, help="with index.json (default: models)"),
    lab.option("--only", metavar="TEXT", default="", help="models whose names hold this, promised or not; no floors"),
    lab.count("rounds", 20, "of each candidate (default 20)"),
    lab.QUIET,
)


def run(args: argparse.Namespace) -> int:
    """0 where all that could be checked is kept, 1 where something is not."""
    warnings.simplefilter("ignore")
    outcome = bench_models(args)
    if not args.only:
        outcome.floors = check_floors(args.rounds)
        print(lab.goal_table("floor", outcome.floors))
    return report_outcome(outcome)
