"""One experiment from lens file to report, stage by stage, in one run folder."""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from neurolens.analysis.layout import lens_layout
from neurolens.base.errors import NeurolensWarning
from neurolens.base.progress import Progress
from neurolens.base.records import Results, reaches, target_record, versions, write_results
from neurolens.cameras.model import load_model
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.study.advice import CLOSE_UM, exact_of, to_use
from neurolens.study.candidates import (
    EXACT,
    exact_c_candidate,
    exact_candidates,
    exact_records,
    ideal_cameras,
    model_candidates,
)
from neurolens.study.describe import layout_profile
from neurolens.study.experiment import Experiment, keep_inputs
from neurolens.study.figures import illumination_plot
from neurolens.study.image import SETTINGS
from neurolens.study.measure import FRESH, MORE, Measured, fit_and_measure, onnx_predictor, shared_rays, what_is_poor
from neurolens.study.plots import trade_plot
from neurolens.study.rays import pixel_um, pupil_disc_share
from neurolens.study.report import write_report
from neurolens.study.scenes import Pictures, domain_facts, render_all, scene_gain
from neurolens.study.speed import Race, race
from neurolens.study.train_states import run_states
from neurolens.study.vignetting import Illumination, relative_illumination
from neurolens.surrogates.fit import NETWORKS, Prepared, prepare
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import RayPairs, make_pairs, save_pairs
from neurolens.surrogates.terms import pinned_threads

_IDEAL = ("thin lens", "pinhole")
_LIT_RAYS = 4096  # a film radius: a quarter of a second a model


def run_experiment(
    experiment: Experiment, out: str | Path, *, progress: Progress | None = None, command: str = ""
) -> dict[str, Any]:
    """Run an experiment and write everything to one folder.

    Writes config.toml (resolved), lenses/ (its lens file), models/*.onnx, pictures/, results.json and report.html. A
    run that was interrupted resumes when it is started again: existing models are not fitted again.

    Returns:
        The results, as in results.json (`records.Results`).

    Raises:
        InputError: mistakes in the lens, the domain, the fits or the scenes.
    """
    folder, started, clock = Path(out), datetime.now(UTC), time.perf_counter()
    progress = progress or Progress(quiet=True)
    if experiment.lens.many_states:
        return run_states(experiment, folder, progress=progress, command=command)
    models, pictures = folder / "models", folder / "pictures"
    progress.plan(_plan(experiment))
    with warnings.catch_warnings(record=True) as heard, pinned_threads():
        warnings.simplefilter("always")
        lens = experiment.lens.read()
        domain = experiment.domain.of(lens)
        for each in (models, pictures):  # only now, so that an invalid lens leaves no folder
            each.mkdir(parents=True, exist_ok=True)
        settings = keep_inputs(experiment, folder)
        with progress.stage("trace ray pairs") as report:
            pairs = make_pairs(lens, domain, experiment.pairs, report)
            if experiment.save_pairs:
                save_pairs(pairs, folder / "pairs.npz")
            prepared = prepare(pairs)
        count, asked = experiment.evaluation.vignetting_rays, experiment.target
        within_um = asked.within_um(domain.film_radius_mm) if asked else None
        fresh = functools.cache(lambda: shared_rays(prepared, count))
        measured = list[Measured]()
        for model in experiment.model:
            with progress.stage(f"fit {model.label}") as report:
                measured.append(fit_and_measure(prepared, model, models, count, report, fresh))
            _say_what_is_poor(measured[-1])
            if within_um and reaches(measured[-1].record, within_um):
                break
        timed = _race(experiment, prepared, measured, progress)
        use = to_use([m.record for m in measured], within_um or CLOSE_UM, exact=exact_of(exact_records(timed)))
        with progress.stage("illumination"):
            names = experiment.render.models or shown_models(measured, use)
            shown = {m.settings.label: m for m in measured if m.settings.label in names}
            light = _illumination(shown, lens, domain, pairs.settings.seed)
        gain = scene_gain(experiment, folder / "models", progress)
        drawn = Pictures()
        if experiment.render.scenes:
            with progress.stage("render") as report:
                files = {name: m.file for name, m in shown.items()}
                drawn = render_all(experiment.render, lens, domain, files, pictures, report)
    results = Results(
        title=experiment.title,
        command=command,
        lens=_describe_lens(lens),
        domain=_describe_domain(lens, pairs),
        settings=settings,
        models=[m.record for m in measured],
        target=target_record([m.record for m in measured], within_um) if within_um else None,
        exact=exact_records(timed),
        cameras=[*({"name": n, "ns_per_ray": timed.timing(n)} for n in _IDEAL if n in timed.ns), *drawn.cameras],
        images=drawn.images,
        image_settings=SETTINGS if drawn.images else None,
        domain_gain=gain,
        figures=_draw(pairs, measured, timed, light, pictures, use) + drawn.figures,
        versions=versions(),
        seed=experiment.pairs.seed,
        started=started.isoformat(timespec="seconds"),
        wall_s=time.perf_counter() - clock,
        warnings=sorted({str(w.message) for w in heard if issubclass(w.category, UserWarning)}),
    )
    write_results(folder / "results.json", results)
    write_report(folder, results)
    return asdict(results)


def _say_what_is_poor(m: Measured) -> None:
    poor = what_is_poor(m.record)
    if poor and m.settings.family != "paraxial":
        text = f"{m.settings.label}: {', '.join(poor)}; a smaller film or stop, or another method, may do better"
        warnings.warn(text, NeurolensWarning, stacklevel=2)


def _plan(experiment: Experiment) -> dict[str, float]:
    """Expected seconds of each stage on two cores, for the time left."""
    plan: dict[str, float] = {"trace ray pairs": 3}
    for m in experiment.model:
        plan[f"fit {m.label}"] = 0.06 * m.steps * (m.units * m.layers / 32) ** 2.5 if m.method in NETWORKS else 3
    plan["race for speed"] = (45 if experiment.evaluation.compile_exact else 5) + 2 * len(experiment.model)
    if experiment.scene_domain is not None:
        plan["fit the scene's domain"] = 5
    if experiment.render.scenes:
        plan["render"] = 40
    return plan


def _race(experiment: Experiment, prepared: Prepared, measured: Sequence[Measured], progress: Progress) -> Race:
    """Time the exact tracers and all models in one run, and add times, speed-ups and break-even to the records.

    Models run in onnxruntime and, on one thread and with a compiler, as C; the exact lens eager, as C, and compiled by
    torch where that is asked for.
    """
    chosen, lens, domain = experiment.evaluation, prepared.pairs.lens, prepared.pairs.domain
    if not chosen.rounds:
        return Race({}, {}, chosen.threads, 0)
    with progress.stage("race for speed") as report:
        candidates = exact_candidates(lens, domain, compiled=chosen.compile_exact)
        candidates += [exact_c_candidate(lens, domain)] if chosen.threads == 1 else []
        candidates += model_candidates({m.settings.label: m.file for m in measured}, domain, chosen.threads)
        candidates += ideal_cameras(lens, domain)
        timed = race(candidates, domain, threads=chosen.threads, rounds=chosen.rounds, report=report)
    for m in measured:
        cost = m.record["fit_s"], m.record["load_s"]
        plain, fused_gain = (
            timed.gain(f"{m.settings.label}{kind}", exact, *cost)
            for kind, exact in (("", EXACT[1]), (" fused", EXACT[2]))
        )
        m.record.update(ns_per_ray=plain.ns_per_ray, speedup_over_compiled=plain.speedup)
        m.record.update(fused_ns_per_ray=fused_gain.ns_per_ray, fused_speedup=fused_gain.speedup)
        if fused_gain.speedup is not None:
            m.record["break_even_rays"] = fused_gain.break_even_rays
    return timed


def _illumination(shown: Mapping[str, Measured], lens: Lens, domain: Domain, seed: int) -> dict[str, Illumination]:
    """Curves of models by name; `seed` of the rays of the fit is avoided."""

    def of(file: Path) -> Illumination:
        predict = onnx_predictor(load_model(file))
        return relative_illumination(lens, domain, predict, points=_LIT_RAYS, seed=seed + FRESH)

    return {name: of(m.file) for name, m in shown.items()}


def shown_models(measured: Sequence[Measured], use: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Names of the polynomial and the network in pictures: the model to use, and of the other kind the closest."""
    names = []
    for networks in (False, True):
        rows = [m for m in measured if (m.settings.method in NETWORKS) == networks and m.settings.family != "paraxial"]
        if rows:
            names.append(min(rows, key=lambda m: (m.record is not use, m.error)).settings.label)
    return tuple(names)


def _draw(
    pairs: RayPairs, measured: Sequence[Measured], timed: Race, light: Mapping[str, Illumination], folder: Path,
    use: Mapping[str, Any] | None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Plots of errors, the lens and its illumination; `use`: the record of what is advised."""
    lens, domain = pairs.lens, pairs.domain
    records = [m.record for m in measured]
    exact = [timed.record(n) for n in EXACT if n in timed.ns]
    lens_layout(layout_profile(lens, domain), folder / "layout.png")
    texts = [("layout", "The lens", "Rays of three fields, traced exactly.")]
    if trade_plot(lens.name, records, exact, folder / "trade.png", use=(use or {}).get("name")):
        told = "Held-out rays, full aperture; coefficients per vector output, A and B terms both counted."
        texts.insert(0, ("trade", "Error against time and size", told))
    if light:
        illumination_plot(light, folder / "illumination.png", title=f"{lens.name}: relative illumination")
        texts.append(("illumination", "Relative illumination", "Of a uniform scene, full aperture, far focus."))
    return [
        {"file": f"{folder.name}/{stem}.png", "title": title, "caption": told, "wide": stem == "trade"}
        for stem, title, told in texts
    ]


def _describe_lens(lens: Lens) -> dict[str, Any]:
    data = first_order(lens)
    return {
        "name": lens.name,
        "source": lens.source,
        "file": Path(lens.path).name,
        "sha256": lens.sha256,
        "refractions": lens.refractions,
        "efl_mm": data.efl_mm,
        "f_number": data.f_number,
        "half_field_deg": lens.half_field_deg,
        "image_radius_mm": lens.image_radius_mm,
        "dispersive": lens.dispersive,
    }


def _describe_domain(lens: Lens, pairs: RayPairs) -> dict[str, Any]:
    domain = pairs.domain
    return {
        **domain_facts(lens, domain),
        "pupil_plane_z_mm": domain.pupil_z_mm,
        "pupil_radius_mm": domain.pupil_radius_mm,
        "pupil_disc_holds": pupil_disc_share(lens, domain),
        "passing_share": len(pairs.train) / pairs.tested,
        "rays_train": len(pairs.train),
        "rays_held_out": MORE * len(pairs.held_out),
        "rays_rim": len(pairs.rim),
        "pixel_um": pixel_um(domain),
    }
