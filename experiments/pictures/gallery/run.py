"""Render small scenes that show what real lenses do, each through the exact lens, a surrogate and a thin lens.

And measure the effect in each. An effect is a file of experiments/gallery; its figure, its numbers and a page of all
are written to experiments/results/gallery. Finished effects are kept, fitted models in runs/gallery.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pictures

from experiments import lab
from experiments.lab import Row as Record
from experiments.pictures.gallery.cameras import (
    CAMERAS,
    TITLES,
    Shot,
    Surrogate,
    View,
    Window,
    camera_of,
    luminance,
    same_state,
    shot_of,
    surrogate_of,
)
from experiments.pictures.gallery.measures import MEASURES
from experiments.pictures.gallery.settings import Effect, find_effects, read_effect
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text, write_json
from neurolens.base.progress import Progress, Report
from neurolens.optics.analysis.plots import new_figure, style
from neurolens.pictures.render.colour import linear_to_srgb
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene
from neurolens.studies.plots import rounded_up
from neurolens.studies.records import versions
from neurolens.studies.scenes import Image

SCHEMA = 1
_CAMERAS = 2  # counts changes of what a column's camera is: figures of earlier ones are made again


def run_effect(
    effect: Effect, out: Path, cache: Path, *, samples: int | None = None, threads: int = 2, progress: Progress
) -> Record:
    """Render and measure an effect: NAME.jpg and NAME.json in `out`, fitted models in `cache`.

    Args:
        samples: a pixel; None takes each panel's own.

    Returns:
        The record, as in NAME.json; that of an earlier run where nothing has changed since.

    Raises:
        InputError: whatever is wrong with lenses, scenes, columns or the measure's name.
    """
    check(effect)
    fingerprint = fingerprint_of(effect, samples)
    known = finished(effect, out)
    if known is not None and known["fingerprint"] == fingerprint:
        progress.note(f"{effect.name}: done by an earlier run")
        return known
    shots = [shot_of(panel, load_scene(panel.scene)) for panel in effect.panel]
    surrogates = _surrogates(effect, shots, cache, progress)
    rows, panels = [], []
    with progress.stage(f"{effect.name}: render") as report:
        for k, (shot, surrogate) in enumerate(zip(shots, surrogates, strict=True)):
            views = _views(effect, shot, surrogate, samples, threads, lab.part_of(report, k, len(shots)))
            rows.append(_row(shot, views))
            panels.append(_record(effect, shot, surrogate, views, rows[-1]))
    record = {"schema": SCHEMA, "name": effect.name, "title": effect.title, "text": effect.text}
    record |= {"source": effect.source, "command": f"python -m experiments gallery {effect.name}", "panels": panels}
    record |= {"samples": samples, "versions": versions(), "fingerprint": fingerprint}
    draw(effect.title, rows, out / f"{effect.name}.jpg")
    write_json(out / f"{effect.name}.json", _plain(record))
    return record


def check(effect: Effect) -> None:
    """Refuse names of columns and of a measure that do not exist, before anything is rendered."""
    if effect.measure not in MEASURES:
        raise InputError(effect.path, "measure", effect.measure, f"one of: {', '.join(MEASURES)}")
    for column in effect.columns:
        if column not in CAMERAS:
            raise InputError(effect.path, "columns", column, f"one of: {', '.join(CAMERAS)}")
    if not effect.columns:
        raise InputError(effect.path, "columns", "(none)", f"some of: {', '.join(CAMERAS)}")


def fingerprint_of(effect: Effect, samples: int | None) -> str:
    """A hash of everything that a figure depends on: files and pictures named, settings, versions, samples."""
    fits = [asdict(panel.fit) for panel in effect.panel]  # where the file says nothing, the defaults of this version
    found = hashlib.sha256(json.dumps([SCHEMA, _CAMERAS, versions(), samples, fits], sort_keys=True).encode())
    for file in [effect.path, *(file for panel in effect.panel for file in panel.files())]:
        found.update(file.read_bytes())
    for scene in dict.fromkeys(panel.scene for panel in effect.panel):
        for image in load_scene(scene).images.values():
            found.update(image.tobytes())
    return found.hexdigest()[:16]


def finished(effect: Effect, out: Path) -> Record | None:
    """The record that an earlier run left, with its figure."""
    try:
        record = json.loads((out / f"{effect.name}.json").read_text(encoding="utf-8"))
        return record if record["schema"] == SCHEMA and (out / f"{effect.name}.jpg").is_file() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _surrogates(effect: Effect, shots: Sequence[Shot], cache: Path, progress: Progress) -> list[Surrogate | None]:
    if "surrogate" not in effect.columns:
        return [None] * len(shots)
    made: list[tuple[Shot, Surrogate]] = []
    for shot in shots:
        if not any(same_state(shot, other) for other, _ in made):
            alike = [s for s in shots if same_state(shot, s)]
            with progress.stage(f"{effect.name}: surrogate of {shot.lens.lens_id}") as report:
                surrogate = surrogate_of(alike, cache, report)
            progress.note(f"{effect.name}: {surrogate.file.stem}, {_error(surrogate.record)}")
            made.append((shot, surrogate))
    return [next(s for other, s in made if same_state(shot, other)) for shot in shots]


def _error(record: Record) -> str:
    if record.get("rms_um") is not None:
        return f"RMS {record['rms_um']:.3g} um on the film"
    degrees = record.get("direction_rms_deg")
    return "no ray to measure" if degrees is None else f"RMS {degrees:.3g} degrees"


def _views(
    effect: Effect, shot: Shot, surrogate: Surrogate | None, samples: int | None, threads: int, report: Report
) -> dict[str, View]:
    """The views of a panel's cameras."""
    panel, views = shot.panel, {}
    window = panel.window_mm or (0.0, 0.0, *shot.film_mm)
    for k, column in enumerate(effect.columns):
        camera = camera_of(column, shot, surrogate)
        # One wavelength per path where the lens disperses: exact lens and surrogate then share their random numbers.
        film = replace(shot.scene.settings.film, wavelengths="one" if camera.dispersive else "hero")
        seen, height = camera_of(column, shot, surrogate), round(panel.width * window[3] / window[2])
        size: dict[str, Any] = {"width": panel.width, "height": max(1, height), "samples": samples or panel.samples}
        done = render(shot.scene, Window(seen, window), **size, threads=threads, film=film)
        views[column] = View(shot, camera, column, done.rgb)
        report((k + 1) / len(effect.columns))
    return views


def _row(shot: Shot, views: dict[str, View]) -> Row:
    first = next(iter(views.values()))
    exposure = exposure_of(views.get("exact", first).rgb, shot.panel.exposure)
    difference = None
    if "exact" in views and "surrogate" in views:
        difference = difference_of(views["surrogate"].rgb, views["exact"].rgb, exposure)
    return Row(shot.panel.label, first.window_mm, {c: v.rgb for c, v in views.items()}, exposure, difference)


def _record(effect: Effect, shot: Shot, surrogate: Surrogate | None, views: dict[str, View], row: Row) -> Record:
    measured = {column: MEASURES[effect.measure](view) for column, view in views.items()}
    names = list(dict.fromkeys(name for figures in measured.values() for name in figures))
    errors = None
    if surrogate is not None:
        keys = ("rms_um", "direction_rms_deg", "false_pass", "false_block")
        errors = {"name": surrogate.file.stem, **{k: surrogate.record.get(k) for k in keys}}
    about = {"label": shot.panel.label, "lens": shot.lens.lens_id, "f_number": shot.f_number, "surrogate": errors}
    about["difference_mean"] = None if row.difference is None else float(row.difference.mean())
    return about | {"measured": {name: {c: figures.get(name) for c, figures in measured.items()} for name in names}}


def _plain(value: Any) -> Any:
    """JSON-able: numbers of four digits, null if not finite."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if math.isfinite(value) else None
    return value


_HEAD = """\
# What real lenses do

Small scenes after the figures of two theses (Steinert 2009, Willi 2021). Each is drawn through the exact lens, a
model of it, and a thin lens with its pupil, which shows the plane in focus at the same size. The last column is the
difference of model and exact lens in luminance, from the same random numbers. The difference and all numbers are
those of the renders; the pictures are shown after Open Image Denoise. A table below each figure measures the effect;
what is below 0.001 stands as 0.
Axes are millimetres of film, and pictures are upright. `python -m experiments gallery` made this page; the command
beside an effect makes that effect alone.
"""


def page(records: Sequence[Record]) -> str:
    """All effects (records of `run_effect`), whose figures lie beside the page."""
    return lab.page(_HEAD, *(section(record) for record in records))


def section(record: Record) -> str:
    """One effect, in Markdown."""
    name = record["name"]
    toml = f"[experiments/gallery/{name}.toml](../../gallery/{name}.toml)"
    return lab.page(
        f"## {record['title']}",
        record["text"].strip(),
        f"![{record['title']}]({name}.jpg)",
        effect_table(record),
        f"After {record['source'].strip()} {toml}, `{record['command']}`.",
    )


def effect_table(record: Record) -> str:
    """The measured numbers: a row a panel and quantity, a column per camera, and the surrogate's error."""
    panels = record["panels"]
    cameras = list(dict.fromkeys(c for p in panels for found in p["measured"].values() for c in found))
    rows = []
    for p in panels:
        for k, (quantity, figures) in enumerate(p["measured"].items()):
            values = [None if figures.get(c) is None else _short(figures[c]) for c in cameras]
            ends = ("", "") if k else (p["label"], _surrogate_error(p["surrogate"]))
            rows.append([ends[0], quantity_name(quantity), *values, ends[1]])
    head = ["panel", "measured", *(TITLES.get(c, c) for c in cameras), "RMS of the model"]
    return lab.table(head, rows, "–")


def _short(value: float) -> str:
    """Three digits without an exponent; what is below a thousandth is the rounding of a 0."""
    return f"{float(f'{value:.3g}'):,.10g}" if abs(value) >= 1e-3 else "0"


def quantity_name(key: str) -> str:
    """Text of a key, with its unit last: "radius_um" is "radius (um)"."""
    for unit in ("um", "mm", "deg", "percent", "nm", "stops"):
        if key.endswith(f"_{unit}"):
            return f"{key[: -len(unit) - 1].replace('_', ' ')} ({'%' if unit == 'percent' else unit})"
    return key.replace("_", " ")


def _surrogate_error(surrogate: Record | None) -> str | None:
    if surrogate is None:
        return None
    if surrogate["rms_um"] is not None:
        return f"{surrogate['rms_um']:.2g} um ({surrogate['name'].rpartition('.')[2]})"
    degrees = surrogate.get("direction_rms_deg")
    return None if degrees is None else f"{degrees:.2g} deg"


OPTIONS = (
    lab.option("effects", metavar="EFFECT", nargs="*", help="names of effects (default: all)"),
    lab.option(
        "--effects-in", metavar="DIR", type=Path, default=lab.ROOT / "experiments" / "gallery",
        help="effect files (default: experiments/gallery)",
    ),
    lab.count("samples", None, "samples per pixel (default: the effect's own)", 1, 1 << 16),
    lab.count("threads", 2, "workers (default: 2)", 1, 256),
    lab.out(lab.RESULTS / "gallery", "folder"),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Render and measure the effects asked for, then write the page of all that are there."""
    folder, out = args.effects_in, args.out
    effects = [read_effect(path) for path in find_effects(folder, args.effects)]
    for effect in effects:
        check(effect)
    out.mkdir(parents=True, exist_ok=True)
    progress, records = Progress(quiet=args.quiet), []
    for effect in effects:
        cache = lab.ROOT / "runs" / "gallery"
        records.append(run_effect(effect, out, cache, samples=args.samples, threads=args.threads, progress=progress))
        everything = [finished(read_effect(path), out) for path in find_effects(folder)]
        atomic_write_text(out / "README.md", page([record for record in everything if record is not None]))
    print(lab.page(*map(section, records), str(out / "README.md")))


# ---- The figure: a row a panel, a column per camera, their difference last; axes in millimetres of film. ------------

DPI = 100  # a picture of 360 pixels is 3.6 inches wide: one pixel of it, one of the figure
MOST_BYTES = 400_000
_LEFT, _GAP, _TOP, _FOOT, _BAR, _LABEL = 0.6, 0.1, 0.78, 0.42, 0.98, 0.24  # inches


@dataclass(frozen=True)
class Row:
    """One panel's pictures.

    Attributes:
        label, window_mm: centre x and y as printed, width and height.
        pictures: column to linear RGB [H, W, 3]. exposure: factor on them.
        difference: [H, W] |surrogate - exact| in luminance, as a share of white, or None.
    """

    label: str
    window_mm: tuple[float, float, float, float]
    pictures: dict[str, Any]
    exposure: float
    difference: Image | None


def difference_of(surrogate: Any, exact: Any, exposure: float) -> Image:
    """|surrogate - exact| in luminance [H, W], as a share of the display's white."""
    return np.abs(luminance(surrogate) - luminance(exact)) * exposure


def exposure_of(exact: Any, stops: float | str) -> float:
    """The factor on linear RGB that `Panel.exposure` asks for."""
    if not isinstance(stops, str):
        return float(2.0**stops)
    brightest = float(np.percentile(luminance(exact), 99.5)) or float(luminance(exact).max())
    return 0.9 / brightest if brightest > 0 else 1.0


def draw(title: str, rows: Sequence[Row], path: Path) -> None:
    """Write the figure, its pictures denoised, as a JPEG of at most `MOST_BYTES`.

    Raises:
        InputError: no rows, or a figure that cannot be made so small.
    """
    if not rows:
        raise InputError("gallery figure", "rows", "(none)", "at least one panel")
    maps = [row.difference for row in rows if row.difference is not None]
    scale = rounded_up(max((float(np.percentile(m, 99.5)) for m in maps), default=1e-6))
    with style():
        figure, boxes, bar = _page(rows, bool(maps))
        figure.text(0.006, 1 - 0.08 / figure.get_figheight(), title, fontsize=15, fontweight="bold", va="top")
        shown = None
        for index, (row, places) in enumerate(zip(rows, boxes, strict=True)):
            for k, (column, place) in enumerate(zip([*row.pictures, "difference"], places, strict=False)):
                difference = row.difference if column == "difference" else None
                if difference is None and column == "difference":
                    continue
                axes = figure.add_axes(place)
                x, y, width, height = row.window_mm
                extent = (x - width / 2, x + width / 2, y - height / 2, y + height / 2)
                look: dict[str, Any] = {"extent": extent, "interpolation": "nearest"}
                if difference is not None:
                    shown = axes.imshow(100 * difference, cmap="magma", vmin=0, vmax=100 * scale, **look)
                else:
                    axes.imshow(linear_to_srgb(row.exposure * lab.denoised(row.pictures[column])), **look)
                _axes(axes, first=k == 0)
                if k == 0:
                    axes.set_title(row.label, loc="left", fontsize=10.5, pad=3)
                if index == 0:
                    name = TITLES.get(column, "|model - exact|" if column == "difference" else column)
                    top = places[0][1] + places[0][3] + _LABEL / figure.get_figheight()
                    figure.text(place[0], top, name, fontsize=12, fontweight="bold", va="bottom")
        if shown is not None:
            colours = figure.colorbar(shown, cax=figure.add_axes(bar), ticks=[0, 50 * scale, 100 * scale], format="%g")
            colours.set_label("% of white", fontsize=9)
            colours.ax.tick_params(labelsize=9)
            colours.outline.set_visible(False)
        _save_small(figure, path)


def _axes(axes: Any, first: bool) -> None:
    axes.tick_params(labelsize=8.5, length=2, pad=1.5)
    axes.locator_params(nbins=4)
    for spine in axes.spines.values():
        spine.set_visible(False)
    if first:
        axes.set_ylabel("film y (mm)", fontsize=9, labelpad=1)
        axes.set_xlabel("film x (mm)", fontsize=9, labelpad=1)
    else:
        axes.set_xticks([])
        axes.set_yticks([])


def _page(rows: Sequence[Row], maps: bool) -> tuple[Any, list[list[Any]], Any]:
    """A figure, boxes (left, bottom, width, height in shares) of every row's pictures, and that of the colour bar."""
    sizes = [next(iter(row.pictures.values())).shape[:2] for row in rows]
    columns = max(len(row.pictures) for row in rows) + maps
    wide = max(width for _, width in sizes) / DPI
    heights = [height / DPI for height, _ in sizes]
    page = (_LEFT + columns * (wide + _GAP) + (_BAR if maps else 0), _TOP + sum(h + _FOOT + _LABEL for h in heights))
    figure = new_figure(*page)
    figure.set_layout_engine("none")

    def box(left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
        return left / page[0], 1 - (top + height) / page[1], width / page[0], height / page[1]

    boxes, top = [], _TOP
    for (_, across), tall in zip(sizes, heights, strict=True):
        boxes.append([box(_LEFT + k * (wide + _GAP), top, across / DPI, tall) for k in range(columns)])
        top += tall + _FOOT + _LABEL
    return figure, boxes, box(page[0] - _BAR + 0.08, _TOP, 0.13, min(max(heights[0], 1.4), 2.6))


def _save_small(figure: Any, path: Path) -> None:
    """Write the figure as a JPEG that is small enough for the repository, its colours as sharp as its brightness."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, facecolor="white", format="png")
    picture = Pictures.open(drawn).convert("RGB")
    forms = ((picture, {"quality": quality, "subsampling": 0, "optimize": True}) for quality in (82, 76))
    lab.write_small(path, forms, MOST_BYTES)
