"""`report.html`: one page of a run, from its results alone. No script, no network; light and dark.

Pictures are files of the run folder, referred to by relative names, so that the folder can be moved or zipped.
A picture or link is shown only if its file lies inside the run folder. Missing values are shown as a dash.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
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
        results: `records.Results`; every part may be missing.
    Raises:
        InputError: no such folder; results of another shape.
    """
    folder = Path(run_dir)
    if not folder.is_dir():
        raise InputError(folder, "run folder", "(missing)", "a folder that exists")
    check_results(results, folder / "results.json")
    title = str(results.get("title") or (results.get("lens") or {}).get("name") or "neurolens run")
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


def _header(results: Mapping[str, Any], title: str) -> str:
    parts = [results.get("command"), results.get("started")]
    wall = number(results, "wall_s")
    parts.append(None if wall is None else f"{wall:.0f} s in all")
    line = " · ".join(text(part) for part in parts if part)
    return f"<header><h1>{text(title)}</h1><p class='lead'>{line}</p></header>"


def _headline(results: Mapping[str, Any]) -> str:
    """The main figures, each with its model; missing ones are left out."""
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
    below = f"<h3>The same fits, stopped down</h3>{closed}" if closed else ""
    return table(names, models, _MODEL_COLUMNS) + _notes([note, *notes] if models else []) + below


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
        {"file": png, "title": name, "caption": r.get("caption"), "links": {"EXR": r.get("file_exr"), "PNG": png}}
        for name, r in zip(names, records, strict=True)
        if (png := r.get("file_png"))
    ]
    measured = [
        (n, r) for n, r in zip(names, records, strict=True) if number(r, "flip") is not None or number(r, "rel_mse")
    ]
    note = "Against the exact render of another seed; the floor is what exact renders of different seeds differ by."
    figures_table = table([n for n, _ in measured], [r for _, r in measured], _IMAGE_COLUMNS)
    return figure_grid(folder, figures, small=True) + figures_table + _notes([note] if measured else [])


def _domain_gain(results: Mapping[str, Any]) -> str:
    gain = results.get("domain_gain") or {}
    rows: Sequence[Record] = gain.get("rows", ())
    names = [" · ".join(str(r[key]) for key in ("domain", "name") if r.get(key)) for r in rows]
    said = ": ".join(str(gain[key]) for key in ("scene", "text") if gain.get(key))
    return (f"<p>{text(said)}</p>" if said else "") + table(names, rows, _GAIN_COLUMNS + _MODEL_COLUMNS)


def _notes(notes: Sequence[str]) -> str:
    return "".join(f"<p class='note'>{text(note)}</p>" for note in notes)


DASH = "–"

_CSS = """
:root { color-scheme: light dark; --ink: #1b1f24; --dim: #5d6670; --line: #dfe3e8; --back: #fff; --card: #f5f7f9;
  --accent: #0062a3; --warn: #fff6e0; --warnline: #e0a800; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --dim: #98a2ad; --line: #333a42; --back: #15181c;
  --card: #1e2329; --accent: #6cb8f0; --warn: #2b2414; --warnline: #a07c10; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1320px; padding: 2rem 1.25rem 4rem; background: var(--back); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .8rem; padding-bottom: .3rem; border-bottom: 1px solid var(--line); }
h3 { font-size: .95rem; margin: 0 0 .35rem; color: var(--dim); font-weight: 600; }
a { color: var(--accent); }
.lead, .note, figcaption { color: var(--dim); } .note { font-size: .85rem; max-width: 75ch; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(210px, 1fr)); gap: .8rem; }
.card { background: var(--card); border-radius: 8px; padding: .8rem 1rem; display: flex; flex-direction: column; }
.card b { font-size: 1.6rem; font-variant-numeric: tabular-nums; } .card b small { font-size: .9rem; font-weight: 500; }
.card span { font-size: .83rem; color: var(--dim); }
.warn { background: var(--warn); border-left: 4px solid var(--warnline); border-radius: 4px; padding: .1rem 1rem;
  margin-top: 1.6rem; } .warn h2 { border: 0; margin: .6rem 0 0; font-size: 1rem; } .warn ul { margin: .3rem 0 .8rem;
  padding-left: 1.2rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); gap: 1.4rem; }
dl { display: grid; grid-template-columns: auto 1fr; gap: .1rem .9rem; margin: 0; font-size: .88rem; }
dt { color: var(--dim); } dd { margin: 0; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
details { margin-top: 1rem; } summary { cursor: pointer; color: var(--accent); margin-bottom: .5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th, td { padding: .32rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
thead th { white-space: normal; vertical-align: bottom; color: var(--dim); font-weight: 600; min-width: 4.6rem; }
tbody th { text-align: left; font-weight: 500; position: sticky; left: 0; background: var(--back); }
th:first-child { text-align: left; } tbody tr:hover > * { background: var(--card); }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr)); gap: 1.4rem;
  margin-bottom: 1.4rem; } .figures.small { grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr)); }
figure { margin: 0; } figure.wide { grid-column: 1 / -1; }
figure img { width: 100%; height: auto; display: block; border-radius: 6px; background: #fff;
  border: 1px solid var(--line); }
figcaption { font-size: .85rem; margin-top: .35rem; } figcaption b { color: var(--ink); }
.small img { image-rendering: auto; border: 0; }
@media print { body { max-width: none; } tbody th { position: static; } }
"""


def text(value: Any) -> str:
    """`value` as escaped text, safe between tags and inside quoted attributes."""
    return html.escape(str(value), quote=True)


def show(value: float | None, digits: int) -> str:
    """A number with significant digits, without an exponent if it is short; a dash for None."""
    if value is None:
        return DASH
    if value == 0 or 1e-4 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:,.0f}" if 1 <= abs(value) < 1e7 else f"{value:.{digits - 1}e}"


def section(heading: str, body: str) -> str:
    """A section with a heading; empty if it has no content."""
    return f"<section><h2>{text(heading)}</h2>{body}</section>" if body else ""


def table(
    names: Sequence[str], records: Sequence[Mapping[str, Any]], columns: Iterable[tuple[str, str, float, int]]
) -> str:
    """One row a record; a column that no record holds is left out, a figure that one record lacks is a dash."""
    columns = [c for c in columns if any(number(r, c[1]) is not None for r in records)]
    if not records:
        return ""
    head = "".join(f"<th scope='col'>{text(c[0])}</th>" for c in columns)
    rows = []
    for name, record in zip(names, records, strict=True):
        values = [number(record, key) for _, key, _, _ in columns]
        cells = [show(None if v is None else v * c[2], c[3]) for v, c in zip(values, columns, strict=True)]
        rows.append(f"<tr><th scope='row'>{text(name)}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    body = f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f"<div class='scroll'><table>{body}</table></div>"


def facts(values: Mapping[str, Any]) -> str:
    """A table of settings as a definition list; nested tables with dotted names."""
    rows = "".join(f"<dt>{text(key)}</dt><dd>{text(value)}</dd>" for key, value in _flat(values))
    return f"<dl>{rows}</dl>"


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", _plain(value)))
    return rows


def _plain(value: Any) -> str:
    if value is None or value != value:  # NaN differs from itself
        return DASH
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return " to ".join(map(_plain, value)) if len(value) == 2 else ", ".join(map(_plain, value))
    return str(value)


def figure_grid(folder: Path, figures: Iterable[Mapping[str, Any]], small: bool = False) -> str:
    """Pictures with title, caption and links; one whose file is not in `folder` leaves a line that says so."""
    shown = "".join(_figure(folder, figure) for figure in figures)
    return f"<div class='figures{' small' if small else ''}'>{shown}</div>" if shown else ""


def _figure(folder: Path, figure: Mapping[str, Any]) -> str:
    name, caption = str(figure.get("title") or ""), str(figure.get("caption") or "")
    links = {label: local_url(folder, file) for label, file in (figure.get("links") or {}).items()}
    files = " · ".join(f"<a href='{url}'>{text(label)}</a>" for label, url in links.items() if url)
    words = " ".join(part for part in (f"<b>{text(name)}</b>" if name else "", text(caption), files) if part)
    url = local_url(folder, figure.get("file"))
    if url is None:
        return f"<p class='note'>Picture missing: {text(figure.get('file'))}</p>"
    picture = f"<a href='{url}'><img src='{url}' alt='{text(name or caption)}' loading='lazy'></a>"
    kind = " class='wide'" if figure.get("wide") else ""
    return f"<figure{kind}>{picture}<figcaption>{words}</figcaption></figure>"


def local_url(folder: Path, file: Any) -> str | None:
    """Relative URL of a file inside `folder`; None if it is missing or its resolved path lies outside."""
    if not file:
        return None
    root = folder.resolve()
    path = (root / str(file)).resolve()
    if not path.is_relative_to(root) or not path.is_file():
        return None
    return "./" + quote(path.relative_to(root).as_posix())  # "./", so that a name with a colon is not read as a scheme


def page(title: str, body: str) -> str:
    """A whole document around `body`."""
    head = "<meta charset='utf-8'><meta name='viewport' content='width=device-width, initial-scale=1'>"
    head += f"<title>{text(title)}</title><style>{_CSS}</style>"
    return f"<!DOCTYPE html>\n<html lang='en'><head>{head}</head><body>{body}</body></html>\n"
