"""`report.html`: one page of a run, from its results alone. No script, no network; light and dark.

Pictures are files of the run folder, referred to by relative names, so that the folder can be moved or zipped.
A picture or link is shown only if its file lies inside the run folder. Missing values are shown as a dash.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from markupsafe import Markup

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.advice import advice
from neurolens.evaluate.pages import (
    DASH,
    Column,
    Record,
    facts,
    figure_grid,
    folded,
    html,
    joined,
    legend,
    number,
    page,
    section,
    table,
)
from neurolens.evaluate.records import NOISY, Results, pareto_front, time_of

_MODEL_COLUMNS = (
    Column("error RMS (µm)", "rms_um", about="distance between exact and modelled ray on the plane in focus, "
           "taken back to the film; root mean square over rays that no fit saw"),
    Column("p99 (µm)", "p99_um", about="99% of those rays are closer than this"),
    Column("pixels RMS", "rms_px", digits=2, about="the RMS error in pixels of a picture 4000 wide"),
    Column("C (ns/ray)", "fused_ns_per_ray.min", about="nanoseconds a ray on one core as compiled C: "
           "--camera fused:MODEL, or neurolens export --to c"),
    Column("onnxruntime (ns/ray)", "ns_per_ray.min", about="the same as an ONNX graph, as most programs run models"),
    Column("C: × exact", "fused_speedup", about="how many times faster than the exact lens as C, in the same race"),
    Column("× exact compiled by torch", "speedup_over_compiled", about="onnxruntime over the exact tracer of torch"),
    Column("false pass (%)", "false_pass", 100, 2, "rays that the model passes and the lens does not"),
    Column("false block (%)", "false_block", 100, 2, "rays that the model blocks and the lens does not"),
    Column("coefficients", "coefficients_per_vector", digits=6, about="of one vector output of a polynomial"),
    Column("fit (s)", "fit_s", about="seconds of the clock, on the machine of the run"),
)  # fmt: skip
_MORE_COLUMNS = (
    Column("max (µm)", "max_um", about="largest error of a ray"),
    Column("RMS at infinity (µm)", "rms_infinity_um", about="error RMS where the plane in focus is at infinity"),
    Column("direction RMS (°)", "direction_rms_deg", digits=2, about="angle between exact and modelled ray"),
    Column("position RMS (µm)", "position_rms_um", about="distance of the modelled front point from the exact ray"),
    Column("transmittance RMS", "transmittance_rms", digits=2, about="error of the share of light that passes, 0 to 1"),
    Column("parameters", "parameters", digits=6, about="numbers of the whole model"),
    Column("size (kB)", "bytes", 1e-3, about="of the file"),
    Column("break-even (Mray)", "break_even_rays", 1e-6, about="million rays after which the fit has paid for itself"),
)
_STOPPED_COLUMNS = tuple(
    Column(f"{stops} stops closed: {what} (%)", f"stopped_down.{stops}_stops.{key}", 100, 2)
    for stops in (2, 4)
    for what, key in (("false pass", "false_pass"), ("false block", "false_block"))
)
_AXIS_COLUMNS = (Column("zoom (mm)", "zoom", digits=5), Column("focus (1/m)", "focus", digits=5))
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
    Column("FLIP", "flip_paired", about="difference that an eye sees from the exact render of the same random numbers"),
    Column("of noise (%)", "paired_share", 100, about="that FLIP over the noise floor"),
    Column("noise floor", "noise_floor_flip", about="FLIP of two exact renders that differ by their noise alone"),
    Column("FLIP with noise", "flip", about="from an exact render of other random numbers"),
    Column("relative MSE", "rel_mse", about="mean squared difference over the square of the brightness"),
    Column("noise floor of it", "noise_floor_rel_mse", about="the same of two exact renders"),
    Column("pairs", "pairs", about="of renders compared"),
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
        _use(folder, results),
        _warnings(results),
        section("Models, on rays held out from the fit", _models(results.models)),
        section("Exact tracers", _exact(results.exact)),
        section("The trade", figure_grid(folder, results.figures)),
        section("Cameras in renders", table(_names(results.cameras, "name"), results.cameras, _CAMERA_COLUMNS)),
        section("Pictures", _images(folder, results.images)),
        section("What a domain taken from the scene gains", _domain_gain(results.domain_gain or {})),
        section("What was run", _what_was_run(results)),
    ]
    path = folder / "report.html"
    atomic_write_text(path, page(title, joined("{}", body)))
    return path


def _header(results: Results, title: str) -> Markup:
    wall = None if results.wall_s is None else f"{results.wall_s:.0f} s in all"
    line = " · ".join(str(part) for part in (results.command, results.started, wall) if part)
    return html("<header><h1>{}</h1><p class='lead'>{}</p></header>", title, line)


def _use(folder: Path, results: Results) -> Markup:
    """What to use where, why, and the commands for it."""
    found = advice(asdict(results), folder)
    pre = [html("<pre>{}</pre>", a.command) if a.command else "" for a in found]
    use = [html("<h2>{} use {}</h2><p>{}.</p>{}", a.where, a.name, a.why, p) for a, p in zip(found, pre, strict=True)]
    return html("<section class='use'>{}</section>", joined("{}", use)) if use else Markup()


def _names(records: Sequence[Record], last: str, first: str = "scene") -> list[str]:
    """What records are of: the scene or the domain, then the camera or the model."""
    return [" · ".join(str(r[key]) for key in (first, last) if r.get(key)) for r in records]


def _warnings(results: Results) -> Markup:
    notes = [str(note) for note in results.warnings]
    for record in results.exact:
        if not record.get("available", True):
            notes.append(f"{record.get('name')}: unavailable ({record.get('reason') or 'no reason given'})")
    items = joined("<li>{}</li>", notes)
    return html("<section class='warn'><h2>Notes and warnings</h2><ul>{}</ul></section>", items) if items else Markup()


def _what_was_run(results: Results) -> Markup:
    about = {"seed": results.seed, **results.versions}
    parts = [("Lens", results.lens), ("Domain", results.domain), ("Seed and versions", about)]
    parts.append(("Image comparison", results.image_settings or {}))
    blocks = (html("<div><h3>{}</h3>{}</div>", name, facts(values)) for name, values in parts if values)
    more = folded("Resolved settings", facts(results.settings)) if results.settings else ""
    return html("<div class='facts'>{}</div>{}", joined("{}", blocks), more)


def _models(models: Sequence[Record]) -> Markup:
    """All models, by family as recorded; a star marks those on the Pareto front of error and time."""
    key = "rms_um" if any(number(m, "rms_um") is not None for m in models) else "direction_rms_deg"
    timed = [
        (i, (t, e))
        for i, m in enumerate(models)
        if (t := number(time_of(m), "min")) is not None and (e := number(m, key)) is not None
    ]
    front = {timed[k][0] for k in pareto_front([point for _, point in timed])}
    names = [("★ " if i in front else "") + str(m["name"]) for i, m in enumerate(models)]
    note = "★ no other model is both faster (as C where that was timed) and closer. ~ a noisy time: the median of its "
    note += f"rounds is more than {NOISY:g} times the least, which is shown. Point at a heading to see what it means."
    notes = [f"{m['name']}: {m['note']}" for m in models if m.get("note")]
    stopped = [m for m in models if m.get("stopped_down")]
    closed = table([str(m["name"]) for m in stopped], stopped, _STOPPED_COLUMNS)
    below = html("<h3>The same fits, stopped down</h3>{}", closed) if closed else Markup()
    more = table(names, models, _MORE_COLUMNS) + _states(models)
    words = legend((*_MODEL_COLUMNS, *_MORE_COLUMNS, *_IMAGE_COLUMNS)) if models else Markup()
    rest = folded("More figures", more + below) if more else below
    return table(names, models, _MODEL_COLUMNS) + _notes([note, *notes] if models else []) + words + rest


def _states(models: Sequence[Record]) -> Markup:
    """Models of many states, state by state."""
    rows = [(str(m["name"]), row) for m in models for row in m.get("states") or ()]
    if not rows:
        return Markup()
    columns = (*_AXIS_COLUMNS, *_MODEL_COLUMNS, *_MORE_COLUMNS)
    return html("<h3>State by state</h3>") + table([n for n, _ in rows], [r for _, r in rows], columns)


def _exact(records: Sequence[Record]) -> Markup:
    names = [
        str(r["name"]) + ("" if r.get("available", True) else f": unavailable ({r.get('reason') or DASH})")
        for r in records
    ]
    return table(names, records, _EXACT_COLUMNS)


def _images(folder: Path, records: Sequence[Record]) -> Markup:
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


def _domain_gain(gain: Record) -> Markup:
    rows: Sequence[Record] = gain.get("rows", ())
    said = ": ".join(str(gain[key]) for key in ("scene", "text") if gain.get(key))
    words = html("<p>{}</p>", said) if said else Markup()
    return words + table(_names(rows, "name", "domain"), rows, _GAIN_COLUMNS + _MODEL_COLUMNS)


def _notes(notes: Sequence[str]) -> Markup:
    return joined("<p class='note'>{}</p>", notes)
