"""`report.html`: one page of a run, from its results alone. No script, no network; light and dark.

Pictures are files of the run folder, referred to by relative names, so that the folder can be moved or zipped.
A picture or link is shown only if its file lies inside the run folder. Missing values are shown as a dash.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.html import html
from neurolens.base.records import NOISY, Results, pareto_front, time_of
from neurolens.study.advice import advice
from neurolens.study.pages import Column, Record, figures_of, flat, number, table

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
    wall = None if results.wall_s is None else f"{results.wall_s:.0f} s in all"
    gain = results.domain_gain or {}
    rows: Sequence[Record] = gain.get("rows", ())
    page = html(
        "report.html",
        title=str(results.title or results.lens.get("name") or "neurolens run"),
        lead=[part for part in (results.command, results.started, wall) if part],
        advice=advice(asdict(results), folder),
        warnings=_warnings(results),
        exact=table([_exact_name(r) for r in results.exact], results.exact, _EXACT_COLUMNS),
        trade=figures_of(folder, results.figures),
        cameras=table(_names(results.cameras, "name"), results.cameras, _CAMERA_COLUMNS),
        gain_text=": ".join(str(gain[key]) for key in ("scene", "text") if gain.get(key)),
        gains=table(_names(rows, "name", "domain"), rows, _GAIN_COLUMNS + _MODEL_COLUMNS),
        about=_about(results),
        settings=flat(results.settings or {}),
        **_models(results.models),
        **_pictures(folder, results.images),
    )
    atomic_write_text(folder / "report.html", page)
    return folder / "report.html"


def _names(records: Sequence[Record], last: str, first: str = "scene") -> list[str]:
    """The scene or the domain of each record, then its camera or model."""
    return [" · ".join(str(r[key]) for key in (first, last) if r.get(key)) for r in records]


def _exact_name(record: Record) -> str:
    lacks = "" if record.get("available", True) else f": unavailable ({record.get('reason') or 'no reason given'})"
    return f"{record.get('name')}{lacks}"


def _warnings(results: Results) -> list[str]:
    missing = [_exact_name(record) for record in results.exact if not record.get("available", True)]
    return [*map(str, results.warnings), *missing]


def _about(results: Results) -> list[tuple[str, list[tuple[str, str]]]]:
    parts = {"Lens": results.lens, "Domain": results.domain}
    parts["Seed and versions"] = {"seed": results.seed, **results.versions}
    parts["Image comparison"] = results.image_settings or {}
    return [(name, flat(values)) for name, values in parts.items()]


def _models(models: Sequence[Record]) -> dict[str, Any]:
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
    stopped = [m for m in models if m.get("stopped_down")]
    states = [(str(m["name"]), row) for m in models for row in m.get("states") or ()]
    return {
        "models": table(names, models, _MODEL_COLUMNS),
        "model_notes": [note, *(f"{m['name']}: {m['note']}" for m in models if m.get("note"))] if models else [],
        "legend_columns": (*_MODEL_COLUMNS, *_MORE_COLUMNS, *_IMAGE_COLUMNS) if models else (),
        "more": table(names, models, _MORE_COLUMNS),
        "states": table(
            [n for n, _ in states], [r for _, r in states], (*_AXIS_COLUMNS, *_MODEL_COLUMNS, *_MORE_COLUMNS)
        ),
        "stopped": table([str(m["name"]) for m in stopped], stopped, _STOPPED_COLUMNS),
    }


def _pictures(folder: Path, records: Sequence[Record]) -> dict[str, Any]:
    """Pictures with their captions and files, and their errors beside the noise floor."""
    named = [(n or str(r.get("name", "")), r) for n, r in zip(_names(records, "camera"), records, strict=True)]
    figures = [
        {"file": png, "title": name, "caption": r.get("caption"), "links": {"EXR": r.get("file_exr"), "PNG": png}}
        for name, r in named
        if (png := r.get("file_png"))
    ]
    measured = [(n, r) for n, r in named if number(r, "flip") is not None or number(r, "rel_mse")]
    errors = table([n for n, _ in measured], [r for _, r in measured], _IMAGE_COLUMNS)
    return {"pictures": figures_of(folder, figures), "measured": errors}
