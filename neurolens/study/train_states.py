"""Experiments on many states of a lens: one model of the zoom's whole range, of internal focus, or of both."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.analysis.plot_style import FIELD_COLOURS, INK, drawing, plain_log_ticks
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, fingerprint_of
from neurolens.base.progress import Progress
from neurolens.base.records import Results, reaches, target_record, versions, write_results
from neurolens.cameras.model import load_model
from neurolens.study.candidates import time_model
from neurolens.study.check import card_errors, errors_at, random_states
from neurolens.study.experiment import Experiment, keep_inputs
from neurolens.study.measure import FRESH, known_record, note_record, seconds_to_load
from neurolens.study.report import write_report
from neurolens.surrogates.axes import Axis
from neurolens.surrogates.export import export_states
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.states import StateSettings, StateSpace, fit_states

# States at which a model is measured for its card, and the rays of each (that pass).
STATES, RAYS = 16, 8_000


def state_settings(settings: ModelSettings, rays: int, seed: int) -> StateSettings:
    """The settings of a model of one state as those of many states.

    Raises:
        InputError: another method than "ols", zones, or the raw basis.
    """
    if (settings.method, settings.basis, settings.partitions) != ("ols", "invariants", 1):
        raise InputError("settings", "model", settings.label, 'method "ols" on the invariants, for many states')
    name = settings.name or f"states-{settings.terms}"
    return StateSettings(settings.terms, settings.degree, rays, seed, name)


def fit_and_measure_states(
    space: StateSpace,
    settings: StateSettings,
    folder: Path,
    *,
    states: int = STATES,
    report: Callable[[float], None] = lambda done: None,
) -> dict[str, Any]:
    """Fit, export and measure one model, or take an existing one of the same settings and version from the folder.

    Errors are those of the exported float32 graph, in onnxruntime, at random states: the record's own are the worst.
    """
    file = folder / f"{settings.label}.onnx"
    fingerprint = _fingerprint(space, settings, states)
    known = known_record(file, fingerprint)
    if known is not None:
        return known
    model = fit_states(space, settings, lambda done: report(0.6 * done))
    with atomic_path(file) as measured:  # a file without its errors never has the final name
        export_states(model, measured)
        loaded, rows = load_model(measured), []
        for state in random_states(space.axes, states, settings.seed + FRESH):
            rows.append(errors_at(loaded, space, state, RAYS, settings.seed + FRESH))
            report(0.6 + 0.4 * len(rows) / states)
        errors = card_errors(rows, RAYS)
        export_states(model, measured, errors)
    core = model.nodes[0].core
    record = {
        "name": settings.label,
        "family": "ols",
        "variables": "invariants",
        "file": f"{folder.name}/{file.name}",
        **errors,
        "nodes": len(model.nodes),
        "coefficients_per_vector": core.coefficients_per_vector,
        "parameters": len(model.nodes) * core.coefficients,
        "bytes": file.stat().st_size,
        "fit_s": model.fit_s,
        "load_s": seconds_to_load(file),
    }
    note_record(file, fingerprint, record)
    return record


def run_states(experiment: Experiment, folder: Path, *, progress: Progress, command: str = "") -> dict[str, Any]:
    """Fit and measure the polynomials of an experiment whose lens is in many states.

    Writes config.toml, lenses/ (its lens file), models/*.onnx, states.png, results.json and report.html.

    Raises:
        InputError: no model that supports many states, and mistakes in lens or domain.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    models = folder / "models"
    models.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        space = experiment.states()
        given = keep_inputs(experiment, folder)
        wanted = [m for m in experiment.model if m.method == "ols"]
        if not wanted:
            raise InputError("settings", "model", [m.label for m in experiment.model], 'a model of method "ols"')
        target, first = experiment.target, space.domain_at(tuple(a.range[0] for a in space.axes))
        within_um = target.within_um(first.film_radius_mm) if target else None
        records = list[dict[str, Any]]()
        for m in wanted:
            settings = state_settings(m, experiment.pairs.train, experiment.pairs.seed)
            with progress.stage(f"fit {settings.label}") as report:
                records.append(fit_and_measure_states(space, settings, models, report=report))
            if within_um and reaches(records[-1], within_um):
                break
        left_out = [m.label for m in experiment.model if m not in wanted]
    for record in records:
        record["ns_per_ray"] = time_model(load_model(folder / record["file"]), record["name"], rounds=8)
    states_plot({r["name"]: r["states"] for r in records}, space.axes[0], folder / "states.png")
    told = sorted({str(w.message) for w in heard if issubclass(w.category, UserWarning)})
    results = Results(
        title=experiment.title,
        command=command,
        lens={"name": space.lens.name, "file": Path(space.lens.path).name, "source": space.lens.source},
        domain={a.name: {"range": list(a.range), "unit": a.unit} for a in space.axes},
        settings=given,
        models=records,
        target=target_record(records, within_um) if within_um else None,
        figures=[{"file": "states.png", "title": "Error over the state", "caption": "At random states.", "wide": True}],
        versions=versions(),
        seed=experiment.pairs.seed,
        started=started.isoformat(timespec="seconds"),
        wall_s=time.perf_counter() - clock,
        warnings=[*told, *(f"left out, only polynomials support many states: {label}" for label in left_out)],
    )
    write_results(folder / "results.json", results)
    write_report(folder, results)
    return asdict(results)


def _fingerprint(space: StateSpace, settings: StateSettings, states: int) -> str:
    first = space.domain_at(tuple(a.range[0] for a in space.axes))
    made_of = ([a.to_dict() for a in space.axes], space.zoom, space.f_number, first.to_dict(), asdict(settings), states)
    return fingerprint_of([__version__, space.lens.sha256, *made_of])


AXIS_LABELS = {"zoom": "focal length (mm)", "focus": "1 / distance in focus (1/m)"}


def states_plot(
    models: Mapping[str, Sequence[Mapping[str, Any]]],
    axis: Axis,
    path: Path,
) -> None:
    """Film-equivalent RMS over the first state axis, and false passes and blocks below it.

    Args:
        models: name to rows as of `check.errors_at`.
        axis: the first axis.
        path: PNG, PDF or SVG to write.
    """
    with drawing(path, 7.2, 5.6) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for number, (name, rows) in enumerate(models.items()):
            colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
            error_line(top, axis, rows, colour, name)
            for key, mark in (("false_pass", "^"), ("false_block", "v")):
                x, share = [r[axis.name] for r in rows], [100 * (r[key] or 0.0) for r in rows]
                bottom.plot(x, share, mark, ms=4, color=colour, alpha=0.8, label=f"{name}: {key.replace('_', ' ')}")
        error_axes(top, axis, [r["rms_um"] for rows in models.values() for r in rows])
        top.set_title("One model of many states", loc="left", fontweight="bold")
        top.set_ylabel("film-equivalent RMS (um)")
        top.legend(loc="best", fontsize="small")
        bottom.set_ylabel("share of rays (%)")
        bottom.set_ylim(0, max(0.02, *bottom.get_ylim()))
        bottom.set_xlabel(AXIS_LABELS.get(axis.name, f"{axis.name} ({axis.unit})"))
        bottom.grid(True)
        bottom.legend(loc="best", fontsize="small")


def error_line(axes: Any, axis: Axis, rows: Sequence[Mapping[str, Any]], colour: str, label: str) -> None:
    """Film-equivalent RMS of rows over a state axis; a line where no other axis varies."""
    ordered = sorted(rows, key=lambda r: r[axis.name])
    several = any(set(r) & set(AXIS_LABELS) - {axis.name} for r in rows)  # no line if another axis varies, too
    y = [r["rms_um"] or float("nan") for r in ordered]
    axes.plot([r[axis.name] for r in ordered], y, "o" if several else "o-", ms=4, color=colour, label=label)


def error_axes(axes: Any, axis: Axis, errors: Sequence[float | None]) -> None:
    """Logarithmic axes of errors over a state axis, its nodes marked."""
    for knot in axis.knots:
        axes.axvline(knot, color=INK, lw=0.5, ls=":")
    if axis.name == "zoom":
        axes.set_xscale("log")
        plain_log_ticks(axes.xaxis)
    axes.set_yscale("log")
    plain_log_ticks(axes.yaxis)
    known = [e for e in errors if e]
    if known:  # at least a decade, so that noise is not seen as a trend
        axes.set_ylim(min(known) / 2, max(10 * min(known), 2 * max(known)))
    axes.grid(True)
