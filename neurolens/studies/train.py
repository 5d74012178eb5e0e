"""Runs one experiment from lens file to report, stage by stage, in one run folder."""

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import fingerprint_of
from neurolens.base.progress import Progress
from neurolens.cameras.model import load_model
from neurolens.models.export import export_states
from neurolens.models.fit import NETWORKS, ModelSettings, Prepared, StateSettings, StateSpace, fit_states, prepare
from neurolens.models.pairs import RayPairs, make_pairs
from neurolens.models.terms import pinned_threads
from neurolens.optics.analysis.layout import lens_layout
from neurolens.optics.lens.paraxial import first_order
from neurolens.studies.check import card_errors, errors_at, random_states
from neurolens.studies.experiment import Experiment, Pictures, Renders, keep_inputs
from neurolens.studies.measure import (
    FRESH,
    MORE,
    Measured,
    export_measured,
    fit_and_measure,
    known_record,
    onnx_predictor,
    shared_rays,
    what_is_poor,
)
from neurolens.studies.pages import CLOSE_UM, exact_of, to_use, write_report
from neurolens.studies.plots import illumination_plot, layout_profile, states_plot, trade_plot
from neurolens.studies.rays import Illumination, pixel_um, relative_illumination
from neurolens.studies.records import Results, reaches, target_record, versions, write_results
from neurolens.studies.speed import (
    EXACT,
    Race,
    exact_c_candidate,
    exact_candidate,
    exact_records,
    ideal_cameras,
    model_candidates,
    race,
    time_model,
)

_IDEAL = ("thin lens", "pinhole")
_LIT_RAYS = 4096  # for each film radius, which takes a quarter of a second a model
# At how many states a model of many states is measured for its card, and on how many passing rays at each.
STATES, RAYS = 16, 8_000


def run_experiment(
    experiment: Experiment, out: str | Path, *, progress: Progress | None = None, command: str = "",
    renders: Renders | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run an experiment and write everything to one folder.

    It writes config.toml (resolved), lenses/ (its lens file), models/*.onnx, pictures/, results.json and report.html;
    for a lens in many states states.png in place of pictures. A run that was interrupted goes on when it is started
    again: existing models are not fitted again. An experiment with scenes needs `renders` (`scenes.renders`).

    Returns:
        The results, as in results.json (`records.Results`).

    Raises:
        InputError: the lens, the domain, the fits or the scenes have a mistake; no model supports many states.
    """
    folder, started, clock = Path(out), datetime.now(UTC), time.perf_counter()
    progress = progress or Progress(quiet=True)
    with warnings.catch_warnings(record=True) as caught, pinned_threads():
        warnings.simplefilter("always")
        if experiment.lens.many_states:
            parts = _of_many_states(experiment, folder, progress)
        else:
            parts = _of_one_state(experiment, folder, progress, renders)
    texts = sorted({str(w.message) for w in caught if issubclass(w.category, UserWarning)})
    results = Results(
        title=experiment.title,
        command=command,
        versions=versions(),
        seed=experiment.pairs.seed,
        started=started.isoformat(timespec="seconds"),
        wall_s=time.perf_counter() - clock,
        warnings=[*texts, *parts.pop("warnings", ())],
        **parts,
    )
    write_results(folder / "results.json", results)
    write_report(folder, results)
    return asdict(results)


def _of_one_state(experiment: Experiment, folder: Path, progress: Progress, renders: Renders | None) -> dict[str, Any]:
    """Return the parts of `records.Results` for a lens in one state."""
    models, pictures = folder / "models", folder / "pictures"
    progress.plan(_plan(experiment))
    lens = experiment.lens.read()
    domain = experiment.domain.of(lens)
    drawn, render = Pictures(), None
    if experiment.render.scenes:
        assert renders is not None, "scenes, and nothing that renders them"
        render = renders(experiment.render, lens, domain)
    for each in (models, pictures):  # late, so that an invalid lens leaves no folder
        each.mkdir(parents=True, exist_ok=True)
    settings = keep_inputs(experiment, folder)
    with progress.stage("trace ray pairs") as report:
        pairs = make_pairs(lens, domain, experiment.pairs, report)
        prepared = prepare(pairs)
    within_um = experiment.target.within_um(domain.film_radius_mm) if experiment.target else None
    measured = _fitted(experiment, prepared, models, within_um, progress)
    records = [m.record for m in measured]
    timed = _race(experiment, prepared, measured, progress)
    use = to_use(records, within_um or CLOSE_UM, exact=exact_of(exact_records(timed)))
    with progress.stage("illumination"):
        names = experiment.render.models or shown_models(measured, use)
        shown = {m.settings.label: m.file for m in measured if m.settings.label in names}
        options = {"points": _LIT_RAYS, "seed": pairs.settings.seed + FRESH}
        light = {
            name: relative_illumination(lens, domain, onnx_predictor(load_model(file)), **options)
            for name, file in shown.items()
        }
    if render is not None:
        with progress.stage("render") as report:
            drawn = render(shown, pictures, report)
    keys = ("name", "source", "sha256", "refractions", "half_field_deg", "image_radius_mm", "dispersive")
    data, facts = first_order(lens), {key: getattr(lens, key) for key in keys}
    return {
        "lens": {**facts, "file": Path(lens.path).name, "efl_mm": data.efl_mm, "f_number": data.f_number},
        "domain": _domain_table(pairs, data.f_number),
        "settings": settings,
        "models": records,
        "target": target_record(records, within_um) if within_um else None,
        "exact": exact_records(timed),
        "cameras": [*({"name": n, "ns_per_ray": timed.timing(n)} for n in _IDEAL if n in timed.ns), *drawn.cameras],
        "images": drawn.images,
        "image_settings": drawn.settings,
        "figures": _draw(pairs, records, timed, light, pictures, use) + drawn.figures,
    }


def _fitted(
    experiment: Experiment, prepared: Prepared, folder: Path, within_um: float | None, progress: Progress
) -> list[Measured]:
    """Fit the models of an experiment in their order, up to the first whose error is at most `within_um`."""
    count = experiment.evaluation.vignetting_rays
    fresh, measured = cache(lambda: shared_rays(prepared, count)), list[Measured]()
    for model in experiment.model:
        with progress.stage(f"fit {model.label}") as report:
            measured.append(fit_and_measure(prepared, model, folder, count, report, fresh))
        poor = what_is_poor(measured[-1].record)
        if poor and model.family != "paraxial":
            text = f"{model.label}: {', '.join(poor)}; a smaller film or stop, or another method, may do better"
            warnings.warn(text, NeurolensWarning, stacklevel=2)
        if within_um and reaches(measured[-1].record, within_um):
            break
    return measured


def _domain_table(pairs: RayPairs, f_number: float) -> dict[str, Any]:
    """Return the domain of a run as a table, with how many rays each split has."""
    domain = pairs.domain
    return {
        "film_radius_mm": domain.film_radius_mm,
        "f_number": f_number,
        "wavelength_nm": list(domain.wavelength_nm),
        "focus_m": ["infinity" if f == math.inf else f for f in domain.focus_m],
        "nearest_m": domain.nearest_m,
        "pupil_plane_z_mm": domain.pupil_z_mm,
        "pupil_radius_mm": domain.pupil_radius_mm,
        "passing_share": len(pairs.train) / pairs.tested,
        "rays_train": len(pairs.train),
        "rays_held_out": MORE * len(pairs.held_out),
        "rays_rim": len(pairs.rim),
        "pixel_um": pixel_um(domain),
    }


def _plan(experiment: Experiment) -> dict[str, float]:
    """Estimate the seconds of each stage on two cores, for the time left."""
    plan: dict[str, float] = {"trace ray pairs": 3}
    for m in experiment.model:
        plan[f"fit {m.label}"] = 0.06 * m.steps * (m.units * m.layers / 32) ** 2.5 if m.method in NETWORKS else 3
    plan["race for speed"] = 5 + 2 * len(experiment.model)
    plan |= {"render": 40} if experiment.render.scenes else {}
    return plan


def _race(experiment: Experiment, prepared: Prepared, measured: Sequence[Measured], progress: Progress) -> Race:
    """Time the exact tracers and all models in one run, and add times, speed-ups and break-even to the records.

    Models run in onnxruntime and, with a compiler, as C; the exact lens by torch and as C.
    """
    chosen, lens, domain = experiment.evaluation, prepared.pairs.lens, prepared.pairs.domain
    if not chosen.rounds:
        return Race({}, {})
    with progress.stage("race for speed") as report:
        candidates = [
            exact_candidate(lens, domain),
            exact_c_candidate(lens, domain),
            *model_candidates({m.settings.label: m.file for m in measured}, domain),
            *ideal_cameras(lens, domain),
        ]
        timed = race(candidates, domain, rounds=chosen.rounds, report=report)
    for m in measured:
        cost = m.record["fit_s"], m.record["load_s"]
        fused_ns, fused_speedup, pays = timed.gain(f"{m.settings.label} fused", EXACT[1], *cost)
        m.record.update(ns_per_ray=timed.timing(m.settings.label))
        m.record.update(fused_ns_per_ray=fused_ns, fused_speedup=fused_speedup)
        if fused_speedup is not None:
            m.record["break_even_rays"] = pays
    return timed


def shown_models(measured: Sequence[Measured], use: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Return the names of the polynomial and of the network that pictures show.

    One of them is the model to use; of the other kind it is the model with the least error.
    """
    names = []
    for networks in (False, True):
        rows = [m for m in measured if (m.settings.method in NETWORKS) == networks and m.settings.family != "paraxial"]
        if rows:
            names.append(min(rows, key=lambda m: (m.record is not use, m.error)).settings.label)
    return tuple(names)


def _draw(
    pairs: RayPairs, records: Sequence[Mapping[str, Any]], timed: Race, light: Mapping[str, Illumination],
    folder: Path, use: Mapping[str, Any] | None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Plot errors, the lens and its illumination; `use` is the record of what is advised."""
    lens = pairs.lens
    exact = [timed.record(n) for n in EXACT if n in timed.ns]
    lens_layout(layout_profile(lens, pairs.domain), folder / "layout.png")
    figures = [("layout", "The lens", "Rays of three fields, traced exactly.")]
    if trade_plot(lens.name, records, exact, folder / "trade.png", use=(use or {}).get("name")):
        caption = "Held-out rays, full aperture; coefficients per vector output, A and B terms both counted."
        figures.insert(0, ("trade", "Error against time and size", caption))
    if light:
        illumination_plot(light, folder / "illumination.png", title=f"{lens.name}: relative illumination")
        figures.append(("illumination", "Relative illumination", "Of a uniform scene, full aperture, far focus."))
    return [
        {"file": f"{folder.name}/{stem}.png", "title": title, "caption": caption} for stem, title, caption in figures
    ]


def _of_many_states(experiment: Experiment, folder: Path, progress: Progress) -> dict[str, Any]:
    """Return the parts of `records.Results` for a lens in many states: a zoom's range, internal focus, or both."""
    models = folder / "models"
    models.mkdir(parents=True, exist_ok=True)
    space, settings = experiment.states(), keep_inputs(experiment, folder)
    wanted = [m for m in experiment.model if m.method == "ols"]
    if not wanted:
        raise InputError("settings", "model", [m.label for m in experiment.model], 'a model of method "ols"')
    target, records = experiment.target, list[dict[str, Any]]()
    within_um = target.within_um(_first_domain(space).film_radius_mm) if target else None
    for m in wanted:
        state = state_settings(m, experiment.pairs.train, experiment.pairs.seed)
        with progress.stage(f"fit {state.label}") as report:
            records.append(fit_and_measure_states(space, state, models, report=report))
        if within_um and reaches(records[-1], within_um):
            break
    for record in records:
        record["ns_per_ray"] = time_model(load_model(folder / record["file"]), record["name"], rounds=8)
    states_plot({r["name"]: r["states"] for r in records}, space.axes[0], folder / "states.png")
    others = [m.label for m in experiment.model if m not in wanted]
    return {
        "lens": {"name": space.lens.name, "file": Path(space.lens.path).name, "source": space.lens.source},
        "domain": {a.name: {"range": list(a.range), "unit": a.unit} for a in space.axes},
        "settings": settings,
        "models": records,
        "target": target_record(records, within_um) if within_um else None,
        "figures": [
            {"file": "states.png", "title": "Error over the state", "caption": "At random states.", "wide": True}
        ],
        "warnings": [f"left out, only polynomials support many states: {label}" for label in others],
    }


def state_settings(settings: ModelSettings, rays: int, seed: int) -> StateSettings:
    """Return the settings of a model of one state as those of a model of many states.

    Raises:
        InputError: the method is not "ols".
    """
    if settings.method != "ols":
        raise InputError("settings", "model", settings.label, 'method "ols" on the invariants, for many states')
    if settings.phase:
        raise InputError("settings", "model.phase", "true", "false, or a model of one state of the lens")
    return StateSettings(settings.terms, settings.degree, rays, seed, settings.name or f"states-{settings.terms}")


def _first_domain(space: StateSpace) -> Any:
    return space.domain_at(tuple(a.range[0] for a in space.axes))


def fit_and_measure_states(
    space: StateSpace, settings: StateSettings, folder: Path, *, states: int = STATES,
    report: Callable[[float], None] = lambda done: None,
) -> dict[str, Any]:  # fmt: skip
    """Fit, export and measure one model of many states, or take an existing one of the same settings and version.

    Errors are those of the exported float32 graph in onnxruntime, at random states; the record's own are the worst.
    """
    file = folder / f"{settings.label}.onnx"
    made_of = [a.to_dict() for a in space.axes], space.zoom, space.f_number, _first_domain(space).to_dict()
    fingerprint = fingerprint_of([__version__, space.lens.sha256, *made_of, asdict(settings), states])
    if (record := known_record(file, fingerprint)) is not None:
        return record
    model = fit_states(space, settings, lambda done: report(0.6 * done))

    def errors_of(loaded: Any) -> dict[str, Any]:
        rows = []
        for state in random_states(space.axes, states, settings.seed + FRESH):
            rows.append(errors_at(loaded, space, state, RAYS, settings.seed + FRESH))
            report(0.6 + 0.4 * len(rows) / states)
        return card_errors(rows, RAYS)

    core = model.nodes[0].core
    facts = {
        "name": settings.label, "family": "ols", "variables": "invariants", "file": f"{folder.name}/{file.name}",
        "nodes": len(model.nodes), "coefficients_per_vector": core.coefficients_per_vector,
        "parameters": len(model.nodes) * core.coefficients, "fit_s": model.fit_s,
    }  # fmt: skip
    return export_measured(
        file, fingerprint, facts, lambda path, errors: export_states(model, path, errors or None), errors_of
    )
