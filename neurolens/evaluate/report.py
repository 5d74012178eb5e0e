"""`report.html`: one page of a run, from its results alone. No script, no network; light and dark.

Pictures are files of the run folder, referred to by relative names, so that the folder can be moved or zipped.
A picture or link is shown only if its file lies inside the run folder. Missing values are shown as a dash.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.pages import DASH, Column, Record, facts, figure_grid, number, page, section, show, table, text
from neurolens.evaluate.records import Results, pareto_front

_CLOSE_UM = 2.0  # a model within this RMS error counts as close in the headline: half a fine pixel

_MODEL_COLUMNS = (
    Column("error RMS (µm)", "rms_um"),
    Column("p99 (µm)", "p99_um"),
    Column("max (µm)", "max_um"),
    Column("RMS at infinity (µm)", "rms_infinity_um"),
    Column("direction RMS (°)", "direction_rms_deg", digits=2),
    Column("time min (ns/ray)", "ns_per_ray.min"),
    Column("speed-up over compiled exact", "speedup_over_compiled"),
    Column("coefficients per vector", "coefficients_per_vector", digits=6),
    Column("false pass (%)", "false_pass", 100, 2),
    Column("false block (%)", "false_block", 100, 2),
    Column("position RMS (µm)", "position_rms_um"),
    Column("transmittance RMS", "transmittance_rms", digits=2),
    Column("median (ns/ray)", "ns_per_ray.median"),
    Column("size (kB)", "bytes", 1e-3),
    Column("fit (s)", "fit_s"),
    Column("break-even (Mray)", "break_even_rays", 1e-6),
)
_STOPPED_COLUMNS = tuple(
    Column(f"{stops} stops closed: {what} (%)", f"stopped_down.{stops}_stops.{key}", 100, 2)
    for stops in (2, 4)
    for what, key in (("false pass", "false_pass"), ("false block", "false_block"))
)
_EXACT_COLUMNS = (
    Column("time min (ns/ray)", "ns_per_ray.min"),
    Column("median (ns/ray)", "ns_per_ray.median"),
    Column("threads", "ns_per_ray.threads"),
)
_CAMERA_COLUMNS = (
    Column("render (s)", "render_s"),
    Column("in the camera (s)", "camera_s"),
    Column("camera's share (%)", "camera_share", 100),
    Column("camera alone (ns/ray)", "ns_per_ray.min"),
    Column("samples per pixel", "samples", digits=6),
    Column("width (px)", "width", digits=6),
    Column("height (px)", "height", digits=6),
    Column("threads", "threads"),
)
_IMAGE_COLUMNS = (
    Column("FLIP", "flip"),
    Column("its noise floor", "noise_floor_flip"),
    Column("FLIP over floor", "flip_ratio", digits=4),
    Column("relative MSE", "rel_mse"),
    Column("its noise floor", "noise_floor_rel_mse"),
    Column("pairs", "pairs"),
)
_GAIN_COLUMNS = (Column("film radius (mm)", "film_radius_mm"), Column("f-number", "f_number"))


def write_report(run_dir: str | Path, results: Results) -> Path:
    """Write `report.html` into the run folder, which holds the pictures that the results name; return its path.

    Raises:
        InputError: no such folder.
    """
    folder = Path(run_dir)
    if not folder.is_dir():
        raise InputError(folder, "run folder", "(missing)", "a folder that exists")
    title = str(results.title or results.lens.get("name") or "neurolens run")
    body = [
        _header(results, title),
        section("Headline", _headline(results)),
        _warnings(results),
        section("What was run", _what_was_run(results)),
        section("Models, on rays held out from the fit", _models(results.models)),
        section("Exact tracers", _exact(results.exact)),
        section("The trade", figure_grid(folder, results.figures)),
        section("Cameras in renders", table(_names(results.cameras, "name"), results.cameras, _CAMERA_COLUMNS)),
        section("Pictures", _images(folder, results.images)),
        section("What a domain taken from the scene gains", _domain_gain(results.domain_gain or {})),
    ]
    path = folder / "report.html"
    atomic_write_text(path, page(title, "".join(body)))
    return path


def _header(results: Results, title: str) -> str:
    wall = None if results.wall_s is None else f"{results.wall_s:.0f} s in all"
    line = " · ".join(text(part) for part in (results.command, results.started, wall) if part)
    return f"<header><h1>{text(title)}</h1><p class='lead'>{line}</p></header>"


def _names(records: Sequence[Record], last: str, first: str = "scene") -> list[str]:
    """What records are of: the scene or the domain, then the camera or the model."""
    return [" · ".join(str(r[key]) for key in (first, last) if r.get(key)) for r in records]


def _headline(results: Results) -> str:
    """The main figures, each with its model; missing ones are left out."""
    models = results.models
    close = [m for m in models if (e := number(m, "rms_um")) is not None and e <= _CLOSE_UM]
    within = f"within {_CLOSE_UM:g} µm"
    rims = [{"name": m["name"], "worse": max(_pair)} for m in models if len(_pair := _false(m)) == 2]
    ratios = _worst_ratios(results.images)
    cards = (
        _card("lowest error, RMS", models, "rms_um", 1, "µm", min),
        _card("lowest direction error, RMS", models, "direction_rms_deg", 1, "°", min),
        _card(f"least time, {within}", close, "ns_per_ray.min", 1, "ns/ray", min),
        _card(f"best speed-up over the compiled exact tracer, {within}", close, "speedup_over_compiled", 1, "×", max),
        _card("vignetting: false pass or false block, the larger, at best", rims, "worse", 100, "%", min),
        _card("FLIP over its noise floor: best camera, in its worst scene", ratios, "ratio", 1, "", min),
    )
    return f"<div class='cards'>{''.join(cards)}</div>" if any(cards) else ""


def _false(model: Record) -> list[float]:
    return [v for v in (number(model, "false_pass"), number(model, "false_block")) if v is not None]


def _worst_ratios(images: Sequence[Record]) -> list[dict[str, Any]]:
    worst: dict[str, float] = {}
    for record in images:
        ratio, camera = number(record, "flip_ratio"), str(record.get("camera", ""))
        if ratio is not None and not camera.startswith("exact"):  # which is 1 by definition
            worst[camera] = max(ratio, worst.get(camera, 0.0))
    return [{"name": camera, "ratio": ratio} for camera, ratio in worst.items()]


def _card(label: str, records: Sequence[Record], key: str, factor: float, unit: str, best: Any) -> str:
    found = [(value, r) for r in records if (value := number(r, key)) is not None]
    if not found:
        return ""
    value, record = best(found, key=lambda pair: pair[0])
    who = record.get("name", "")
    shown = f"{show(value * factor, 3)}<small> {text(unit)}</small>"
    return f"<div class='card'><span>{text(label)}</span><b>{shown}</b><span>{text(who)}</span></div>"


def _warnings(results: Results) -> str:
    notes = [str(note) for note in results.warnings]
    for record in results.exact:
        if not record.get("available", True):
            notes.append(f"{record.get('name')}: unavailable ({record.get('reason') or 'no reason given'})")
    items = "".join(f"<li>{text(note)}</li>" for note in notes)
    return f"<section class='warn'><h2>Notes and warnings</h2><ul>{items}</ul></section>" if items else ""


def _what_was_run(results: Results) -> str:
    about = {"seed": results.seed, **results.versions}
    parts = [("Lens", results.lens), ("Domain", results.domain), ("Seed and versions", about)]
    parts.append(("Image comparison", results.image_settings or {}))
    blocks = "".join(f"<div><h3>{text(name)}</h3>{facts(values)}</div>" for name, values in parts if values)
    settings = facts(results.settings) if results.settings else ""
    more = f"<details><summary>Resolved settings</summary>{settings}</details>" if settings else ""
    return f"<div class='facts'>{blocks}</div>{more}"


def _models(models: Sequence[Record]) -> str:
    """All models, by family as recorded; a star marks those on the Pareto front of error and time."""
    key = "rms_um" if any(number(m, "rms_um") is not None for m in models) else "direction_rms_deg"
    timed = [
        (i, (t, e))
        for i, m in enumerate(models)
        if (t := number(m, "ns_per_ray.min")) is not None and (e := number(m, key)) is not None
    ]
    front = {timed[k][0] for k in pareto_front([point for _, point in timed])}
    names = [("★ " if i in front else "") + str(m["name"]) for i, m in enumerate(models)]
    note = (
        "Error: film-equivalent, focused plane, rays that the exact lens passes. False pass: rays the model passes and "
        "the lens blocks, of those the model passes; false block: rays the model blocks and the lens passes, of those "
        "the lens passes. Speed-up: compiled exact over model, least times of one run. Break-even: rays after which "
        "fitting and loading have paid for themselves against the compiled exact tracer. "
        "★ no other model is both faster and closer."
    )
    notes = [f"{m['name']}: {m['note']}" for m in models if m.get("note")]
    stopped = [m for m in models if m.get("stopped_down")]
    closed = table([str(m["name"]) for m in stopped], stopped, _STOPPED_COLUMNS)
    below = f"<h3>The same fits, stopped down</h3>{closed}" if closed else ""
    return table(names, models, _MODEL_COLUMNS) + _notes([note, *notes] if models else []) + below


def _exact(records: Sequence[Record]) -> str:
    names = [
        str(r["name"]) + ("" if r.get("available", True) else f": unavailable ({r.get('reason') or DASH})")
        for r in records
    ]
    return table(names, records, _EXACT_COLUMNS)


def _images(folder: Path, records: Sequence[Record]) -> str:
    """Pictures with their captions and files, then their errors beside the noise floor."""
    named = [(n or str(r.get("name", "")), r) for n, r in zip(_names(records, "camera"), records, strict=True)]
    figures = [
        {"file": png, "title": name, "caption": r.get("caption"), "links": {"EXR": r.get("file_exr"), "PNG": png}}
        for name, r in named
        if (png := r.get("file_png"))
    ]
    measured = [(n, r) for n, r in named if number(r, "flip") is not None or number(r, "rel_mse")]
    note = "Against the exact render of another seed; the floor is what exact renders of different seeds differ by."
    figures_table = table([n for n, _ in measured], [r for _, r in measured], _IMAGE_COLUMNS)
    return figure_grid(folder, figures, small=True) + figures_table + _notes([note] if measured else [])


def _domain_gain(gain: Record) -> str:
    rows: Sequence[Record] = gain.get("rows", ())
    said = ": ".join(str(gain[key]) for key in ("scene", "text") if gain.get(key))
    words = f"<p>{text(said)}</p>" if said else ""
    return words + table(_names(rows, "name", "domain"), rows, _GAIN_COLUMNS + _MODEL_COLUMNS)


def _notes(notes: Sequence[str]) -> str:
    return "".join(f"<p class='note'>{text(note)}</p>" for note in notes)
