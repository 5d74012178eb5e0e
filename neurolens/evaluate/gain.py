"""What it gains to model only what a shot requires: its film crop, stop, focus and wavelengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.progress import Progress
from neurolens.cameras.model import load_model
from neurolens.cameras.pinhole import Pinhole
from neurolens.evaluate.candidates import model_candidate
from neurolens.evaluate.experiment import Experiment
from neurolens.evaluate.measure import fit_and_measure
from neurolens.evaluate.speed import Candidate, race
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.render.job import camera_axes
from neurolens.render.primitives import Rays
from neurolens.render.scene import Scene, load_scene
from neurolens.render.spectrum import SpectralRange
from neurolens.render.world import World
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
    data = first_order(lens)
    widest = data.f_number
    shot_lens, shot_domain = domain_from_camera(
        lens,
        film_mm=(shot.film_width_mm, shot.film_height_mm),
        focus_m=shot.focus_m,
        f_number=max(shot.f_number or widest, widest),
        wavelength_nm=shot.wavelengths_nm,
        nearest_m=nearest_depth_m(scene, abs(data.efl_mm)),
    )
    half = replace(choice.model, name="", terms=max(choice.model.terms // 2, 2), units=max(choice.model.units // 2, 2))
    states = (
        ("whole lens", lens, experiment.domain_of(lens), (choice.model,)),
        (scene.name, shot_lens, shot_domain, (choice.model, half)),
    )
    rows: list[dict[str, Any]] = []
    candidates: list[Candidate] = []
    with progress.stage("fit the scene's domain") as report:
        for name, state, domain, models in states:
            prepared = prepare(make_pairs(state, domain, experiment.pairs))
            place = folder / f"for-{name.replace(' ', '-')}"
            place.mkdir(parents=True, exist_ok=True)
            for settings in models:
                m = fit_and_measure(prepared, settings, place, experiment.evaluation.vignetting_rays, report)
                rows.append({**m.record, "domain": name, **domain_facts(state, domain)})
                rows[-1]["file"] = f"models/{place.name}/{m.file.name}"
                candidate = model_candidate(f"{name}: {settings.label}", load_model(m.file), domain.stop_radius_mm)
                candidates.append(replace(candidate, domain=domain))
        # One race, so that the times can be set against each other.
        chosen = experiment.evaluation
        timed = race(candidates, shot_domain, threads=chosen.threads, rounds=chosen.rounds)
        for row, candidate in zip(rows, candidates, strict=True):
            row["ns_per_ray"] = timed.timing(candidate.name)
    return {"scene": scene.name, "text": _words(rows), "rows": rows}


def nearest_depth_m(scene: Scene, efl_mm: float, across: int = 96) -> float | None:
    """Depth of the nearest thing in view, in m from the film plane along the axis; None where nothing is in view.

    Rays of a pinhole of the lens's focal length through a grid of `across` x `across` points of the film: a thing
    smaller than a step of the grid may be missed.
    """
    shot = scene.settings.camera
    film = (shot.film_width_mm, shot.film_height_mm)
    steps = np.linspace(-0.5, 0.5, across, dtype=np.float32)
    points = np.stack(np.meshgrid(steps * film[0], steps * film[1])).reshape(2, -1).astype(np.float32)
    nanometres = np.full(points.shape[1], np.mean(shot.wavelengths_nm), np.float32)
    rays = Pinhole(efl_mm, film).sample(points, np.full_like(points, 0.5), nanometres)
    axes, position = camera_axes(shot), np.array(shot.position_m, np.float32)[:, None]
    world = World(scene, SpectralRange(*shot.wavelengths_nm))
    distance, _ = world.nearest(Rays.of(axes @ rays.origin_m + position, axes @ rays.direction))
    depth = -(rays.origin_m[2] + distance * rays.direction[2])  # the camera looks along -z
    nearest = float(depth.min())
    return nearest if np.isfinite(nearest) else None


def domain_facts(lens: Lens, domain: Domain) -> dict[str, Any]:
    """A domain as a flat table, units in the keys."""
    return {
        "film_radius_mm": domain.film_radius_mm,
        "f_number": first_order(lens).f_number,
        "wavelength_nm": list(domain.wavelength_nm),
        "focus_m": ["infinity" if f == float("inf") else f for f in domain.focus_m],
        "nearest_m": domain.nearest_m,
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
