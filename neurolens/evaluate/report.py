"""`report.html`: one page that shows a run, from its results alone. No script, no network; light and dark.

Pictures stay files of the run folder and are referred to by relative names: the folder can be moved or zipped as it is.
A picture or link is shown only if its file lies inside the run folder. What was not measured shows as a dash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.markup import DASH, facts, figure_grid, page, section, show, table, text
from neurolens.evaluate.records import check_results, number, pareto_front

Record = Mapping[str, Any]
_CLOSE_UM = 2.0  # a model within this RMS error counts as close in the headline: half a fine pixel
Column = tuple[str, str, float, int]  # heading with its unit, key, factor, significant digits

_MODEL_COLUMNS: tuple[Column, ...] = (
    ("error RMS (µm)", "rms_um", 1, 3),
    ("p99 (µm)", "p99_um", 1, 3),
    ("max (µm)", "max_um", 1, 3),
    ("RMS at infinity (µm)", "rms_infinity_um", 1, 3),
    ("direction RMS (°)", "direction_rms_deg", 1, 2),
    ("time min (ns/ray)", "ns_per_ray.min", 1, 3),
    ("speed-up over compiled exact", "speedup_over_compiled", 1, 3),
    ("coefficients per vector", "coefficients_per_vector", 1, 6),
    ("false pass (%)", "false_pass", 100, 2),
    ("false block (%)", "false_block", 100, 2),
    ("position RMS (µm)", "position_rms_um", 1, 3),
    ("transmittance RMS", "transmittance_rms", 1, 2),
    ("median (ns/ray)", "ns_per_ray.median", 1, 3),
    ("size (kB)", "bytes", 1e-3, 3),
    ("fit (s)", "fit_s", 1, 3),
    ("break-even (Mray)", "break_even_rays", 1e-6, 3),
)
_STOPPED_COLUMNS: tuple[Column, ...] = tuple(
    (f"{stops} stops closed: {what} (%)", f"stopped_down.{stops}_stops.{key}", 100, 2)
    for stops in (2, 4)
    for what, key in (("false pass", "false_pass"), ("false block", "false_block"))
)
_EXACT_COLUMNS: tuple[Column, ...] = (
    ("time min (ns/ray)", "ns_per_ray.min", 1, 3),
    ("median (ns/ray)", "ns_per_ray.median", 1, 3),
    ("threads", "ns_per_ray.threads", 1, 3),
)
_CAMERA_COLUMNS: tuple[Column, ...] = (
    ("render (s)", "render_s", 1, 3),
    ("in the camera (s)", "camera_s", 1, 3),
    ("camera's share (%)", "camera_share", 100, 3),
    ("camera alone (ns/ray)", "ns_per_ray.min", 1, 3),
    ("samples per pixel", "samples", 1, 6),
    ("width (px)", "width", 1, 6),
    ("height (px)", "height", 1, 6),
    ("threads", "threads", 1, 3),
)
_IMAGE_COLUMNS: tuple[Column, ...] = (
    ("FLIP", "flip", 1, 3),
    ("its noise floor", "noise_floor_flip", 1, 3),
    ("FLIP over floor", "flip_ratio", 1, 4),
    ("relative MSE", "rel_mse", 1, 3),
    ("its noise floor", "noise_floor_rel_mse", 1, 3),
    ("pairs", "pairs", 1, 3),
)
_GAIN_COLUMNS: tuple[Column, ...] = (("film radius (mm)", "film_radius_mm", 1, 3), ("f-number", "f_number", 1, 3))


def write_report(run_dir: str | Path, results: Mapping[str, Any]) -> Path:
    """Write `report.html` into the run folder and return its path.

    Args:
        run_dir: folder that holds the pictures the results name.
        results: `records.Results`; every part may be missing, and shows as such.
    Raises:
        InputError: no such folder; results of another shape.
    """
    folder = Path(run_dir)
    if not folder.is_dir():
        raise InputError(folder, "run folder", "(missing)", "a folder that exists")
    check_results(results, folder / "results.json")
    title = str(results.get("title") or _lens_name(results))
    body = [
        _header(results, title),
        section("Headline", _headline(results)),
        _warnings(results),
        section("What was run", _what_was_run(results)),
        section("Models, on rays held out from the fit", _models(results)),
        section("Exact tracers", _exact(results)),
        section("The trade", figure_grid(folder, results.get("figures", ()))),
        section("Cameras in renders", _cameras(results)),
        section("Pictures", _images(folder, results)),
        section("What a domain taken from the scene gains", _domain_gain(results)),
    ]
    path = folder / "report.html"
    atomic_write_text(path, page(title, "".join(body)))
    return path


def _lens_name(results: Mapping[str, Any]) -> str:
    return str((results.get("lens") or {}).get("name") or "neurolens run")


def _header(results: Mapping[str, Any], title: str) -> str:
    parts = [results.get("command"), results.get("started")]
    wall = number(results, "wall_s")
    parts.append(None if wall is None else f"{wall:.0f} s in all")
    line = " · ".join(text(part) for part in parts if part)
    return f"<header><h1>{text(title)}</h1><p class='lead'>{line}</p></header>"


def _headline(results: Mapping[str, Any]) -> str:
    """Figures a reader looks for first; each names its model. Nothing is shown that no record holds."""
    models: Sequence[Record] = results.get("models", ())
    close = [m for m in models if (e := number(m, "rms_um")) is not None and e <= _CLOSE_UM]
    within = f"within {_CLOSE_UM:g} µm"
    rims = [{"name": m["name"], "worse": max(_pair)} for m in models if len(_pair := _false(m)) == 2]
    cards = (
        _card("lowest error, RMS", models, "rms_um", 1, "µm", min),
        _card("lowest direction error, RMS", models, "direction_rms_deg", 1, "°", min),
        _card(f"least time, {within}", close, "ns_per_ray.min", 1, "ns/ray", min),
        _card(f"best speed-up over the compiled exact tracer, {within}", close, "speedup_over_compiled", 1, "×", max),
        _card("vignetting: false pass or false block, the larger, at best", rims, "worse", 100, "%", min),
        _card(
            "FLIP over its noise floor: best camera, in its worst scene", _worst_ratios(results), "ratio", 1, "", min
        ),
    )
    return f"<div class='cards'>{''.join(cards)}</div>" if any(cards) else ""


def _false(model: Record) -> list[float]:
    return [v for v in (number(model, "false_pass"), number(model, "false_block")) if v is not None]


def _worst_ratios(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each camera the largest FLIP over noise floor of its renders: one lucky scene proves nothing."""
    worst: dict[str, float] = {}
    for record in results.get("images", ()):
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


def _warnings(results: Mapping[str, Any]) -> str:
    notes = [str(note) for note in results.get("warnings", ())]
    for record in results.get("exact", ()):
        if not record.get("available", True):
            notes.append(f"{record.get('name')}: unavailable ({record.get('reason') or 'no reason given'})")
    items = "".join(f"<li>{text(note)}</li>" for note in notes)
    return f"<section class='warn'><h2>Notes and warnings</h2><ul>{items}</ul></section>" if items else ""


def _what_was_run(results: Mapping[str, Any]) -> str:
    about = {"seed": results.get("seed"), **(results.get("versions") or {})}
    parts = [("Lens", results.get("lens")), ("Domain", results.get("domain")), ("Seed and versions", about)]
    parts.append(("Image comparison", results.get("image_settings")))
    blocks = "".join(f"<div><h3>{text(name)}</h3>{facts(values)}</div>" for name, values in parts if values)
    settings = results.get("settings")
    more = f"<details><summary>Resolved settings</summary>{facts(settings)}</details>" if settings else ""
    return f"<div class='facts'>{blocks}</div>{more}"


def _models(results: Mapping[str, Any]) -> str:
    """All models, by family as recorded; a star marks those on the Pareto front of error and time."""
    models: Sequence[Record] = results.get("models", ())
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
    told = _notes([note, *notes] if models else [])
    below = f"<h3>The same fits, stopped down</h3>{closed}" if closed else ""
    return table(names, models, _MODEL_COLUMNS) + told + below


def _exact(results: Mapping[str, Any]) -> str:
    records: Sequence[Record] = results.get("exact", ())
    names = [
        str(r["name"]) + ("" if r.get("available", True) else f": unavailable ({r.get('reason') or DASH})")
        for r in records
    ]
    return table(names, records, _EXACT_COLUMNS)


def _cameras(results: Mapping[str, Any]) -> str:
    records: Sequence[Record] = results.get("cameras", ())
    names = [" · ".join(str(r[key]) for key in ("scene", "name") if r.get(key)) for r in records]
    return table(names, records, _CAMERA_COLUMNS)


def _images(folder: Path, results: Mapping[str, Any]) -> str:
    """Pictures with their captions and files, then their errors beside the noise floor."""
    records: Sequence[Record] = results.get("images", ())
    names = [
        " · ".join(str(r[key]) for key in ("scene", "camera") if r.get(key)) or str(r.get("name", "")) for r in records
    ]
    figures = [
        {"file": r.get("file_png"), "title": name, "caption": r.get("caption"), "links": _links(r)}
        for name, r in zip(names, records, strict=True)
        if r.get("file_png")
    ]
    measured = [
        (n, r) for n, r in zip(names, records, strict=True) if number(r, "flip") is not None or number(r, "rel_mse")
    ]
    note = "Against the exact render of another seed; the floor is what exact renders of different seeds differ by."
    figures_table = table([n for n, _ in measured], [r for _, r in measured], _IMAGE_COLUMNS)
    return figure_grid(folder, figures, small=True) + figures_table + _notes([note] if measured else [])


def _links(record: Record) -> dict[str, Any]:
    return {"EXR": record.get("file_exr"), "PNG": record.get("file_png")}


def _domain_gain(results: Mapping[str, Any]) -> str:
    gain = results.get("domain_gain") or {}
    rows: Sequence[Record] = gain.get("rows", ())
    names = [" · ".join(str(r[key]) for key in ("domain", "name") if r.get(key)) for r in rows]
    told = ": ".join(str(gain[key]) for key in ("scene", "text") if gain.get(key))
    return (f"<p>{text(told)}</p>" if told else "") + table(names, rows, _GAIN_COLUMNS + _MODEL_COLUMNS)


def _notes(notes: Sequence[str]) -> str:
    return "".join(f"<p class='note'>{text(note)}</p>" for note in notes)
