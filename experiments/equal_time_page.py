"""Error over time of the exact lens, a polynomial, a network and a thin lens in three scenes.

Against a converged exact render with other seeds: bias and variance told apart, seconds per sample, from when the exact
lens is ahead, equal time and equal samples, FLIP maps and film-space error maps in micrometres; the exact lens and the
network as compiled C, too. Renders are kept in the run folder: an interrupted run resumes, and
what would give another picture is rendered again. Needs the extra "train" (torch, matplotlib, flip-evaluator) and a C
compiler. Writes README.md, equal_time.json and three pictures a scene (about ten minutes).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from experiments import lab
from experiments.equal_time import (
    EXACT,
    EXACTS,
    LENS,
    QUICK,
    SCENES,
    CameraResult,
    Counts,
    SceneResult,
    measure_scene,
    scene_file,
)
from experiments.equal_time_errors import Estimate, crossover_s, log_interpolate
from neurolens.analysis.plots import FAINT, INK, drawing, plain_log_ticks
from neurolens.study.plots import family_colour, side_by_side

_INTRO = """\
# Equal time and equal samples

`python -m experiments equal-time`: {lens} exact in torch, through surrogates in onnxruntime, both as compiled
C (fused), and as a thin lens of its focal length and f-number. Against the exact lens with other seeds and {reference}
samples per pixel, in two halves. Every camera draws the same random numbers, one wavelength per path. Times are the
render's own seconds (best; median in brackets), {threads}, {size} pixels; making a camera, its fit and the
scene's tables are not in them.

- *Error*: relative RMSE, the root of the mean of (a - b)^2 / (b^2 + 0.01) on linear radiance, in percent; mean FLIP.
  The reference's own noise is taken out of the first (products of the differences from its two halves), not of FLIP.
- *Bias*: what more samples do not lower. A render adds passes of {pass_samples} samples with seeds of their own, so
  that error^2 = bias^2 + V / passes exactly. *Alone* takes this law to infinity from the camera's own {passes} passes
  and the reference; *paired* compares its passes with the exact lens's of the same random numbers, where most noise
  cancels. Deviations by the jackknife over passes; where a square is below two of them, "<" gives the bound of two.
- *Variance*: V times the samples of a pass, relative. *Efficiency*: 1 / (V x seconds of a pass).
- *Exact ahead*, *fused exact ahead*: the time from which the exact lens, in torch and as C, has the smaller error, for
  the paired bias (for two deviations more and less); beyond the measured times by the law.
- *FLIP paired*: between the camera's mean picture and the exact lens's of the same random numbers.
- *Film*: where the camera's ray meets the plane in focus, taken back to the film by the exact lens's differential, from
  the exact ray in float64 of the same film and pupil point and wavelength: median and 99th percentile of all rays, um.
"""


def _threads(result: SceneResult) -> str:
    return f"{result.threads} thread" + "s" * (result.threads != 1)


def page(results: Sequence[SceneResult]) -> str:
    """The tables in Markdown."""
    counts, about = results[0].counts, lab.machine()
    told = {"reference": 2 * counts.reference, "pass_samples": counts.pass_samples, "passes": counts.passes}
    parts = [_INTRO.format(lens=LENS, threads=_threads(results[0]), size="{} x {}".format(*counts.size), **told)]
    for result in results:
        noise, cameras = 100 * math.sqrt(result.noise2["rel_mse"]), list(result.cameras.values())
        parts += [
            f"## {result.name}",
            f"Focused at {result.settings.focus_m:g} m, f/{result.f_number:.3g}. "
            f"The reference's own noise: {noise:.3g}%; FLIP between its halves {result.flip_halves:.3g}.",
            lab.table(_law_columns(result), cameras),
            lab.table(_equal_columns(result), cameras),
            f"![Error against time]({result.name}-error.png)",
            f"![FLIP maps]({result.name}-flip.png)",
            f"![Film-space error]({result.name}-film.png)",
        ]
    machine = f"{about['processor']}, {about['cores']} cores, Python {about['python']}, numpy {about['numpy']}."
    return lab.page(*parts, machine)


def equal_time_s(result: SceneResult) -> float:
    """The longest time that every camera was rendered for: all passes of the fastest."""
    return min(c.levels[-1].seconds_min for c in result.cameras.values())


def _law_columns(result: SceneResult) -> Sequence[lab.Column]:
    samples = result.counts.pass_samples
    return lab.columns(
        ("camera", "name"),
        ("bias paired %", lambda c: "0" if c.name == EXACT else _root(c.bias2["rel_mse"])),
        ("bias alone %", lambda c: _root(c.extrapolated2["rel_mse"])),
        ("variance a sample", "variance.rel_mse.value", ".3g", samples),
        ("ms a sample", lambda c: "{:.3g} ({:.3g})".format(*(1000 * s / samples for s in c.pass_s))),
        ("efficiency 1/s", lambda c: 1 / (c.variance["rel_mse"].value * c.pass_s[0]), ".3g"),
        *((f"{name} ahead", partial(_crossover_text, result, name)) for name in _exacts(result)),
    )


def _equal_columns(result: SceneResult) -> Sequence[lab.Column]:
    most, seconds = next(iter(result.cameras.values())).levels[-1].samples, equal_time_s(result)

    def flip_then(camera: CameraResult) -> float:
        return log_interpolate(seconds, sorted((level.seconds_min, level.flip) for level in camera.levels))

    return lab.columns(
        ("camera", "name"),
        (f"{most} samples: error %", lambda c: _percent(c.levels[-1].rel_mse)),
        ("FLIP", lambda c: c.levels[-1].flip, ".3g"),
        (f"{seconds:.3g} s: samples", lambda c: seconds * result.counts.pass_samples / c.pass_s[0], ".0f"),
        ("error %", lambda c: _percent(c.law("rel_mse").at(seconds))),
        ("FLIP", flip_then, ".3g"),
        ("FLIP paired", lambda c: "0" if c.name == EXACT else f"{c.flip_same:.2g}"),
        ("film median", lambda c: um_text(c.film.p50_um)),
        ("film 99%", lambda c: um_text(c.film.p99_um)),
    )


def _percent(square: float) -> str:
    return f"{100 * math.sqrt(square):.3g}" if square > 0 else "~0"


def um_text(value: float) -> str:
    """Micrometres with two figures, whole from 100 on."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def _root(square: Estimate) -> str:
    """An error in percent from its square, with its deviation, or the bound where it is not resolved."""
    if not square.resolved:
        return f"< {100 * math.sqrt(square.upper):.2g}"
    root = math.sqrt(square.value)
    return f"{100 * root:.3g} ± {100 * square.sd / (2 * root):.1g}"


def _exacts(result: SceneResult) -> list[str]:
    """The exact lens's cameras in a scene: in torch, and as C."""
    return [name for name in EXACTS if name in result.cameras]


def crossovers_s(result: SceneResult, camera: CameraResult, exact: str) -> tuple[float, float, float]:
    """When the exact lens is ahead for good: by the paired bias, and with two deviations more and less."""
    law, bias = result.cameras[exact].law("rel_mse", 0.0), camera.bias2["rel_mse"]
    least = max(bias.value - 2 * bias.sd, 0.0)
    times = [crossover_s(law, camera.law("rel_mse", b)) for b in (max(bias.value, 0.0), bias.upper, least)]
    return times[0], times[1], times[2]


def _crossover_text(result: SceneResult, exact: str, camera: CameraResult) -> str:
    if camera.name in EXACTS:
        return "–"
    middle, early, late = crossovers_s(result, camera, exact)
    if middle == 0.0:
        return "from the first sample"
    if not camera.bias2["rel_mse"].resolved:
        return f"after more than {_time(early)}" if early > 0 else "not resolved"
    times = [_time(t) for t in (middle, early, late)]
    return f"after {times[0]}" if len(set(times)) == 1 else f"after {times[0]} ({times[1]} to {times[2]})"


def _time(seconds: float) -> str:
    """Two digits in a suitable unit, from milliseconds to years."""
    if math.isinf(seconds):
        return "never"
    units = ((1e-3, "ms"), (1.0, "s"), (60.0, "min"), (3600.0, "h"), (86400.0, "days"), (31557600.0, "years"))
    size, name = next((u for u in reversed(units) if seconds >= u[0]), units[0])
    return f"{float(f'{seconds / size:.2g}'):g} {name}"


def _scene_data(result: SceneResult) -> lab.Row:
    def camera_data(c: CameraResult) -> lab.Row:
        estimates = {"bias2": c.bias2, "extrapolated2": c.extrapolated2, "variance": c.variance}
        times = {"pass_s_min": c.pass_s[0], "pass_s_median": c.pass_s[1], "flip_same_seeds": c.flip_same}
        film = {"film_p50_um": c.film.p50_um, "film_p99_um": c.film.p99_um}
        ahead = {} if c.name in EXACTS else {n: crossovers_s(result, c, n) for n in _exacts(result)}
        return {"name": c.name, "levels": c.levels, **times, **estimates, **film, "ahead_after_s": ahead}

    about = {"scene": result.name, "f_number": result.f_number, "focus_m": result.settings.focus_m}
    about |= {"counts": result.counts, "threads": result.threads, "equal_time_s": equal_time_s(result)}
    about |= {"reference_variance": result.noise2, "reference_flip_halves": result.flip_halves}
    return about | {"cameras": [camera_data(c) for c in result.cameras.values()]}


_MOST_BYTES = 150_000  # of a picture
_TITLES = {"mse": "RMSE (linear radiance)", "rel_mse": "relative RMSE (share of 1)"}


class Panel(NamedTuple):
    """One kind of error by camera: (seconds [L], error [L]), the reference's own, errors that samples do not lower."""

    label: str
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    floor: float
    floor_name: str
    levels: Mapping[str, float]


def _panels(result: SceneResult) -> list[Panel]:
    """RMSE, relative RMSE and FLIP."""
    cameras, panels = result.cameras.items(), []
    seconds = {n: [level.seconds_min for level in c.levels] for n, c in cameras}
    for measure, title in _TITLES.items():
        squares = {n: np.array([getattr(level, measure) for level in c.levels]) for n, c in cameras}
        roots = {n: (seconds[n], list(np.sqrt(np.maximum(s, 0)))) for n, s in squares.items()}
        biased = {n: math.sqrt(c.bias2[measure].value) for n, c in cameras if c.bias2[measure].resolved}
        panels.append(Panel(title, roots, math.sqrt(result.noise2[measure]), "noise of the reference", biased))
    flips = {n: (seconds[n], [level.flip for level in c.levels]) for n, c in cameras}
    return [*panels, Panel("mean FLIP (0 to 1)", flips, result.flip_halves, "between halves of the reference", {})]


def draw(result: SceneResult, folder: Path) -> None:
    """Three pictures: error over time, FLIP maps at equal samples, film-space maps."""
    folder.mkdir(parents=True, exist_ok=True)
    shot, counts = result.settings, result.counts
    over_time, flips, films = (folder / f"{result.name}-{kind}.png" for kind in ("error", "flip", "film"))
    where = f"{result.name}, f/{result.f_number:.3g}, focused at {shot.focus_m:g} m"
    size = f"{counts.size[0]} x {counts.size[1]} pixels, {_threads(result)}"
    note = f"{size}; markers: 1, 2, 4 ... samples per pixel; the reference has {2 * counts.reference}"
    panels = _panels(result)
    with drawing(over_time, 3.5 * len(panels), 4.1, f"Error against render time: {where}", note) as figure:
        handles: dict[str, Any] = {}
        for axes, panel in zip(figure.subplots(1, len(panels)), panels, strict=True):
            handles |= _draw(axes, panel)
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    shown = {n: c for n, c in result.cameras.items() if not n.startswith(_FUSED)}  # whose pictures are their models'
    side_by_side(
        {"reference": result.reference} | {n: c.picture for n, c in shown.items()},
        {n: c.flip_map for n, c in shown.items()},
        flips,
        {n: _flip_caption(c) for n, c in shown.items()},
        title=f"{result.name}: FLIP against the reference, {counts.pass_samples * counts.passes} samples each",
    )
    _film_maps(result, films, f"Film-space error: {where}")
    for picture in (over_time, flips, films):
        _fewer_colours(picture)


def _flip_caption(camera: CameraResult) -> str:
    same = "" if camera.name == EXACT else f"\nfrom exact, same random numbers: {camera.flip_same:.2g}"
    return f"FLIP {camera.flip_map.mean():.3g}{same}"


def _fewer_colours(picture: Path) -> None:
    """Keep at most 256 colours of a PNG, half as many and so on until it is small enough for the repository."""
    with Image.open(picture) as full:
        pixels = full.convert("RGB")

    def reduced(colours: int) -> Image.Image:
        return pixels.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)

    lab.write_small(picture, ((reduced(n), {"optimize": True}) for n in (256, 128, 64, 32)), _MOST_BYTES)


_MARKERS = "osD^vP"
_FUSED = "fused "


def _draw(axes: Any, panel: Panel) -> dict[str, Any]:
    handles = {}
    for k, (name, (seconds, errors)) in enumerate(panel.curves.items()):
        t, e = np.asarray(seconds, np.float64), np.asarray(errors, np.float64)
        kept = np.isfinite(e) & (e > 0)
        look = {"color": _colour(name), "marker": _MARKERS[k % len(_MARKERS)], "ms": 4.2, "lw": 1.4}
        look |= {"ls": "--", "mfc": "white"} if name.startswith(_FUSED) else {}
        handles[name] = axes.plot(t[kept], e[kept], **look)[0]
    axes.set(xscale="log", yscale="log", xlabel="render time (s)", ylabel=panel.label)
    low = min(axes.get_ylim()[0], 0.7 * panel.floor) if panel.floor > 0 else axes.get_ylim()[0]
    axes.set_ylim(low, axes.get_ylim()[1])
    if panel.floor > 0:
        axes.axhline(panel.floor, color=FAINT, lw=1.2, ls="--")
        axes.annotate(
            panel.floor_name, (0.02, panel.floor), xycoords=("axes fraction", "data"), xytext=(0, 2),
            textcoords="offset points", fontsize=7.6, color=FAINT, va="bottom",
        )  # fmt: skip
    for name, level in panel.levels.items():
        if level > low:
            handles[f"bias of {name}"] = axes.axhline(level, color=_colour(name), lw=1.0, ls=":")
    axes.grid(True, which="major")
    plain_log_ticks(axes.xaxis, axes.yaxis)
    return handles


def _film_maps(result: SceneResult, path: Path, title: str) -> None:
    """Errors over the film, as the picture shows it, each with its own colour bar: they differ too much."""
    note = "against the exact ray in float64 of the same film and pupil point; median over pupil and wavelengths"
    count = len(result.cameras)
    columns = 2 if count in (2, 4) else min(count, 3)
    rows = -(-count // columns)
    with drawing(path, 4.0 * columns, 0.7 + 2.3 * rows, title, note) as figure:
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        across, up = result.settings.film_mm[0] / 2, result.settings.film_mm[1] / 2
        for axes, (name, camera) in zip(places, result.cameras.items(), strict=False):
            film = camera.film
            shown = axes.imshow(film.median_um, cmap="magma", vmin=0, extent=(-across, across, -up, up))
            caption = f"all rays: median {um_text(film.p50_um)}, 99% {um_text(film.p99_um)} µm"
            axes.set_title(f"{name}\n{caption}", fontsize=9.5)
            axes.set(xlabel="across the picture (mm on the film)", ylabel="up (mm)")
            axes.xaxis.label.set_size(8.5)
            bar = figure.colorbar(shown, ax=axes, shrink=0.85)
            bar.set_label("median error (µm)", fontsize=8.5)
            bar.outline.set_visible(False)
        for axes in places[count:]:
            axes.set_axis_off()


def _colour(name: str) -> str:
    """Black for the exact lens, else that of the family that a name begins with; a fused camera is drawn dashed."""
    kind = name.removeprefix(_FUSED)
    if kind == "exact":
        return INK
    return family_colour("paraxial" if kind.startswith("thin") else kind.split("-")[0])


OPTIONS = (
    lab.option("--scene", metavar="SCENE", action="append", help="grid, lights, room or a file (default: all)"),
    lab.option("--quick", action="store_true", help="tiny pictures (a minute)"),
    lab.count("threads", 1, "of the timed renders (default 1)", 1, 256),
    lab.option("--folder", metavar="DIR", type=Path, help="of the kept renders (default: runs/equal_time)"),
    lab.out(lab.RESULTS / "equal_time"),
)


def run(args: argparse.Namespace) -> None:
    """Measure scene by scene; the page is written after each."""
    counts = QUICK if args.quick else Counts()
    folder = args.folder or lab.ROOT / "runs" / ("equal_time_quick" if args.quick else "equal_time")
    files = [scene_file(name) for name in args.scene or SCENES]
    done: list[SceneResult] = []
    for file, report in lab.stages(files, lambda f: f.stem, args.quiet):
        done.append(measure_scene(file, folder, counts, args.threads, report))
        draw(done[-1], args.out)
        data = {"machine": lab.machine(), "scenes": [_scene_data(result) for result in done]}
        text = lab.write_results(args.out, "README", page(done), data, "equal_time")
    print(f"{text}\nWritten to {args.out}")
