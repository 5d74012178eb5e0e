"""What it gains to model only what a shot requires: its film crop, stop, focus and wavelengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.cameras.model import load_model
from neurolens.evaluate.candidates import model_candidate
from neurolens.evaluate.experiment import Experiment
from neurolens.evaluate.measure import fit_and_measure
from neurolens.evaluate.speed import race
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.progress import Progress
from neurolens.render.scenefile import load_scene
from neurolens.surrogates.domain import Domain, domain_from_camera
from neurolens.surrogates.fit import prepare
from neurolens.surrogates.pairs import make_pairs


def scene_gain(experiment: Experiment, folder: Path, progress: Progress) -> dict[str, Any] | None:
    """One model for the whole lens, the same for one shot, and for the shot half of it: error, size and time.

    Returns a `records.DomainGain`, None where the experiment names no scene.
    """
    choice = experiment.scene_domain
    if choice is None:
        return None
    scene = load_scene(choice.scene)
    shot = scene.settings.camera
    lens = experiment.lens.read()
    widest = first_order(lens).f_number
    shot_lens, shot_domain = domain_from_camera(
        lens,
        film_mm=(shot.film_width_mm, shot.film_height_mm),
        focus_m=shot.focus_m,
        f_number=max(shot.f_number or widest, widest),
        wavelength_nm=shot.wavelengths_nm,
    )
    half = replace(choice.model, name="", terms=max(choice.model.terms // 2, 2), units=max(choice.model.units // 2, 2))
    states = (
        ("whole lens", lens, experiment.domain_of(lens), (choice.model,)),
        (scene.name, shot_lens, shot_domain, (choice.model, half)),
    )
    rows, candidates = [], []
    with progress.stage("fit the scene's domain") as report:
        for name, state, domain, models in states:
            prepared = prepare(make_pairs(state, domain, experiment.pairs))
            place = folder / f"for-{name.replace(' ', '-')}"
            place.mkdir(parents=True, exist_ok=True)
            for settings in models:
                m = fit_and_measure(prepared, settings, place, experiment.evaluation.vignetting_rays, report)
                rows.append({**m.record, "domain": name, **domain_facts(state, domain)})
                rows[-1]["file"] = f"models/{place.name}/{m.file.name}"
                key = f"{name}: {settings.label}"
                candidates.append((key, domain, model_candidate(key, load_model(m.file), domain.stop_radius_mm)))
        for row, (key, domain, candidate) in zip(rows, candidates, strict=True):
            timed = race([candidate], domain, rounds=experiment.evaluation.rounds)
            row["ns_per_ray"] = timed.timing(key)
    return {"scene": scene.name, "text": _words(rows), "rows": rows}


def domain_facts(lens: Lens, domain: Domain) -> dict[str, Any]:
    """A domain as a flat table, units in the keys."""
    return {
        "film_radius_mm": domain.film_radius_mm,
        "f_number": first_order(lens).f_number,
        "wavelength_nm": list(domain.wavelength_nm),
        "focus_m": ["infinity" if f == float("inf") else f for f in domain.focus_m],
    }


def _words(rows: Sequence[Mapping[str, Any]]) -> str:
    whole, same, half = rows
    if not all(row.get("rms_um") for row in rows):
        return ""
    return (
        f"{whole['name']} has {whole['rms_um']:.3g} um RMS over the whole lens, "
        f"{same['rms_um']:.3g} um over this shot; "
        f"{half['name']} has {half['rms_um']:.3g} um over the shot."
    )
