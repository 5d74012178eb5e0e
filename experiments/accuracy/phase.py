"""Give the polynomial that ships of every historical lens the optical path, and compare it with exact rays.

Errors are of rays that no fit has seen, in float32, over the whole film and stop: once for 400 to 700 nm and focus at
infinity, once over all light and focus of the model. Strehl ratios are of the point spread at infinity and 546 nm, on
the axis and at 0.7 of the film's radius, wide open and two and four stops down, from the model and from traced rays.
Times are CPU seconds of this machine, of each the least that half a second of repeating finds: of pupils, for nine
wavelengths, and of the waves summed over them. 10 to 30 s a lens; lenses that are in the table are kept. Writes
phase.md and phase.json.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments import lab
from experiments.lab import Report, Row
from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.model import load_model
from neurolens.models.file import as_stored
from neurolens.models.model import LensModel
from neurolens.models.pairs import passing_rays
from neurolens.models.phase import ENOUGH_WAVES, MORE_TERMS, TERMS, path_errors, with_phase
from neurolens.models.wavefront import model_pupils
from neurolens.optics.analysis.diffraction import cells_of, irradiance, perfect_peak, pupils_at, spread
from neurolens.optics.analysis.exit_pupil import ExitPupil
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.states import set_lens

WITHIN, STREHL_WITHIN, SEEN = 0.05, 0.01, 0.1  # waves; Strehl ratios, of those above the last
_NM, _STOPS, _FIELDS = 546.0, (1.0, 2.0, 4.0), (0.0, 0.7)
_FIT, _FRESH, _BATCH, _CELLS, _TIMED_S = 16_000, 6_000, 8192, 256, 0.5


def measure_lens(file: Path) -> Row:
    """Return one record: lens, terms and errors over both domains, Strehl ratios, CPU seconds.

    Raises:
        InputError: a lens whose models have no path.
    """
    model = load_model(sorted((lab.ROOT / "models").glob(f"{file.stem}.ols-*.onnx"))[-1]).fitted
    domain, (low, high) = model.domain, model.domain.wavelength_nm
    if model.encoding.dispersive:
        low, high = max(low, LIGHT_NM[0]), min(high, LIGHT_NM[1])
    # Without `fit_planes` again: the planes are those of the model over all its light and focus.
    narrow = replace(domain, wavelength_nm=(low, high), film_z_mm=(_infinity(model),) * 2)
    found = {
        name: _fitted(replace(model, domain=d), most)
        for name, d, most in (("infinity", narrow, MORE_TERMS), ("short", domain, TERMS), ("whole", domain, MORE_TERMS))
    }
    row: Row = {"lens": file.stem}
    for name, (fitted, errors) in found.items():
        row[name] = {"terms": len(fitted.core.path), **errors}  # type: ignore[attr-defined]
    return row | _strehls(found["whole"][0])


def _infinity(model: LensModel) -> float:
    near, far = model.domain.film_z_mm
    return min(max(float(first_order(model.lens).rear_focal_z_mm), near), far)


def _fitted(model: LensModel, most: int) -> tuple[LensModel, dict[str, float]]:
    rays, fresh = (
        passing_rays(model.lens, model.domain, n, s, batch=_BATCH).inputs for n, s in ((_FIT, 5), (_FRESH, 99))
    )
    (fitted,) = as_stored([with_phase(model, rays, most)])
    return fitted, path_errors(fitted, fresh)


def _strehls(model: LensModel) -> Row:
    """Return Strehl ratios by the model and by traced rays, and CPU seconds of pupils and of a point spread."""
    widest = float(first_order(model.lens).f_number)
    places = np.array([[share * model.domain.film_radius_mm, 0.0] for share in _FIELDS])
    rows = []
    for closed in _STOPS:
        film = (model.domain.film_radius_mm,) * 2
        scene = Scene(set_lens(model.lens, Shot(film_mm=film, f_number=widest * closed)))
        both = [pupils_at(scene, places, (_NM,)), model_pupils(model, scene, places, (_NM,))]
        for share, exact, made in zip(_FIELDS, *both, strict=True):
            if exact[0] is not None and made[0] is not None:
                ratios = {"traced": _strehl(exact[0]), "model": _strehl(made[0])}
                rows.append({"f_number": widest * closed, "field": share, **ratios})
    low, high = model.domain.wavelength_nm
    waves = [_NM, *np.linspace(max(low, 440.0), min(high, 640.0), 8)]
    made, white = model_pupils(model, scene, places, waves), np.ones((1, len(waves)))
    timed = {
        "traced": lambda: pupils_at(scene, places, waves),
        "model": lambda: model_pupils(model, scene, places, waves),
        "waves": lambda: [spread(some, white, 0.003, 33) for some in made],
    }
    return {"strehl": rows, "cpu_s": {name: _least_s(call) / len(places) for name, call in timed.items()}}


def _least_s(call: Callable[[], object]) -> float:
    """Return the least CPU seconds that a call takes, which is repeated for `_TIMED_S`."""
    begun, found = time.process_time(), math.inf
    while time.process_time() < begun + _TIMED_S:
        start = time.process_time()
        call()
        found = min(found, time.process_time() - start)
    return found


def _strehl(pupil: ExitPupil) -> float:
    field = cells_of(pupil, (_CELLS, _CELLS))
    reach = max(4e-6 * pupil.wavelength_nm / float(pupil.half.max()), pupil.blur_mm)
    line = np.linspace(-reach, reach, 2 * _CELLS + 1)
    peak = perfect_peak(pupil, field)  # 0 where the pupil of a condenser's model is all beyond its rims
    return float(irradiance(pupil, line, line, field).max()) / peak if peak else 0.0


def _off(row: Row) -> float | None:
    """Return the largest error of a Strehl ratio above `SEEN`; None without any."""
    offs = [abs(s["model"] - s["traced"]) for s in row["strehl"] if s["traced"] > SEEN]
    return max(offs, default=None)


def page(rows: Sequence[Row]) -> str:
    """Return the page: how many lenses reach each goal, and a row for each lens."""
    done = [r for r in rows if "whole" in r]
    columns = lab.columns(
        ("lens", "lens"), ("terms", "infinity.terms"), ("RMS, waves", "infinity.phase_rms_waves", ".4f"),
        (f"all focus, {TERMS} terms: RMS", "short.phase_rms_waves", ".4f"),
        ("terms", "whole.terms"), ("RMS, waves", "whole.phase_rms_waves", ".4f"),
        ("largest", "whole.phase_max_waves", ".2f"), ("path and rays, um", "whole.phase_rays_um", ".2f"),
        ("Strehl off by", _off, ".4f"), ("pupils traced, ms", "cpu_s.traced", ".0f", 1000),
        ("by model", "cpu_s.model", ".0f", 1000), ("waves summed", "cpu_s.waves", ".0f", 1000),
    )  # fmt: skip
    within = {name: sum(r[name]["phase_rms_waves"] <= WITHIN for r in done) for name in ("infinity", "short", "whole")}
    known = [off for r in done if (off := _off(r)) is not None]
    sums = {k: float(np.median([r["cpu_s"][k] for r in done])) for k in ("traced", "model", "waves")} if done else {}
    near = sum(off <= STREHL_WITHIN for off in known)
    goals = [
        lab.Goal("lenses within a twentieth of a wave, focus at infinity", 30, within["infinity"], True),
        lab.Goal(f"the same over all light and focus, of at most {TERMS} terms", 30, within["short"], True),
        lab.Goal(f"the same, of at most {MORE_TERMS} terms", 30, within["whole"], True),
        lab.Goal(f"of them all, lenses whose Strehl ratios are within {STREHL_WITHIN}", len(known), near, True),
    ]
    if sums:
        whole, *own = (
            (cpu["traced"] + cpu["waves"]) / (cpu["model"] + cpu["waves"])
            for cpu in (sums, *(r["cpu_s"] for r in done))
        )
        goals += [
            lab.Goal("pupils of the model, times faster than traced", 30, sums["traced"] / sums["model"], True),
            lab.Goal("point spread, times faster (waves take the rest)", 30, whole, True),
            lab.Goal("the same, the median of the lenses' own ratios", 30, float(np.median(own)), True),
        ]
    refused = [f"- {r['lens']}: {r['refused']}" for r in rows if "refused" in r]
    return lab.page(
        f"# The optical path of models\n\n`python -m experiments phase`\n\nUp to {TERMS} terms beside the rays, or "
        f"{MORE_TERMS} where these leave more than {ENOUGH_WAVES} waves and less than one. Where they leave more, rays "
        "count by their blur, so that the path is known where there is an image. Waves are of 546 nm; path and rays: "
        "the median distance on the film between where each says that light goes.",
        lab.goal_table("goal", goals), lab.table(columns, done, "-"),
        *(["No path:", "\n".join(refused)] if refused else []),
    )  # fmt: skip


OPTIONS = (lab.ONLY, lab.AGAIN, lab.out())


def run(args: argparse.Namespace) -> None:
    """Measure what is missing, and write the table after each lens."""

    def measured(file: Path, report: Report) -> Row:
        try:
            return measure_lens(file)
        except InputError as error:
            return {"lens": file.stem, "refused": str(error).removeprefix(f"{lab.ROOT}/")}

    files = lab.chosen(lab.historical(), lambda f: f.stem, args.only, "phase")
    chosen = {file.stem: file for file in files}
    lab.resume(args, "phase", chosen, measured, lambda r: r["lens"], page, listed="lenses", again=args.restart)
