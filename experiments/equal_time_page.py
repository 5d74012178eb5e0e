"""`python -m experiments equal-time` and its output: the page, every point as CSV, records, the pictures."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from experiments import lab
from experiments.equal_time import (
    EXACT,
    EXACTS,
    LENS,
    MEASURES,
    QUICK,
    SCENES,
    CameraResult,
    Counts,
    SceneResult,
    measure_scene,
    scene_file,
)
from experiments.equal_time_errors import Estimate, crossover_s, log_interpolate
from neurolens.analysis.plot_style import FAINT, INK, drawing, heading, plain_log_ticks
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, atomic_write_text
from neurolens.base.progress import Progress
from neurolens.commands.arguments import whole
from neurolens.evaluate.figures import side_by_side
from neurolens.evaluate.plots import family_colour
from neurolens.evaluate.records import plain

_INTRO = """\
# Equal time and equal samples

`python -m experiments equal-time`: {lens} exact in torch, through surrogates in onnxruntime, both as compiled
C (fused), and as a thin lens of its focal length and f-number. Against the exact lens with other seeds and {reference}
samples per pixel, in two halves. Every camera draws the same random numbers, one wavelength per path. Times are the
render's own seconds (best; median in brackets), {threads} thread{s}, {size} pixels; making a camera, its fit and the
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


def write(results: Sequence[SceneResult], folder: Path) -> str:
    """Write tables of all scenes and the pictures of each; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    text = page(results)
    atomic_write_text(folder / "equal_time.csv", _csv(results))
    data = {"machine": lab.machine(), "scenes": [_scene_data(r) for r in results]}
    atomic_write_text(folder / "equal_time.json", json.dumps(plain(data), indent=1, allow_nan=False) + "\n")
    for result in results:
        draw(result, folder)
    atomic_write_text(folder / "README.md", text)
    return text


def page(results: Sequence[SceneResult]) -> str:
    """The tables in Markdown."""
    counts, threads = results[0].counts, results[0].threads
    parts = [
        _INTRO.format(
            lens=LENS, reference=2 * counts.reference, threads=threads, s="" if threads == 1 else "s",
            size="{} x {}".format(*counts.size), pass_samples=counts.pass_samples, passes=counts.passes,
        )
    ]  # fmt: skip
    parts += [_scene_text(result) for result in results]
    about = lab.machine()
    parts.append(f"{about['processor']}, {about['cores']} cores, Python {about['python']}, numpy {about['numpy']}.\n")
    return "\n".join(parts)


def equal_time_s(result: SceneResult) -> float:
    """The longest time that every camera was rendered for: all passes of the fastest."""
    return min(c.levels[-1].seconds_min for c in result.cameras.values())


def _scene_text(result: SceneResult) -> str:
    most, seconds = next(iter(result.cameras.values())).levels[-1].samples, equal_time_s(result)
    noise = 100 * math.sqrt(result.noise2["rel_mse"])
    stem = result.name
    return "\n".join(
        [
            f"## {stem}\n",
            f"Focused at {result.settings.focus_m:g} m, f/{result.f_number:.3g}."
            f" The reference's own noise: {noise:.3g}%; FLIP between its halves {result.flip_halves:.3g}.\n",
            lab.table(
                ["camera", "bias paired %", "bias alone %", "variance a sample", "ms a sample", "efficiency 1/s"]
                + [f"{name} ahead" for name in _exacts(result)],
                [_law_cells(result, c) for c in result.cameras.values()],
            ),
            "",
            lab.table(
                ["camera", f"{most} samples: error %", "FLIP", f"{seconds:.3g} s: samples", "error %", "FLIP"]
                + ["FLIP paired", "film median", "film 99%"],
                [_equal_cells(result, c, seconds) for c in result.cameras.values()],
            ),
            f"\n![Error against time]({stem}-error.png)\n",
            f"![FLIP maps]({stem}-flip.png)\n\n![Film-space error]({stem}-film.png)\n",
        ]
    )


def _law_cells(result: SceneResult, camera: CameraResult) -> list[str]:
    exact = camera.name == EXACT
    samples, best, middle = result.counts.pass_samples, *camera.pass_s
    variance = camera.variance["rel_mse"].value
    return [
        camera.name,
        "0" if exact else _root(camera.bias2["rel_mse"]),
        _root(camera.extrapolated2["rel_mse"]),
        f"{samples * variance:.3g}",
        f"{1000 * best / samples:.3g} ({1000 * middle / samples:.3g})",
        f"{1 / (variance * best):.3g}",
        *("–" if camera.name in EXACTS else _crossover_text(result, camera, name) for name in _exacts(result)),
    ]


def _equal_cells(result: SceneResult, camera: CameraResult, seconds: float) -> list[str]:
    last = camera.levels[-1]
    seen = log_interpolate(seconds, sorted((level.seconds_min, level.flip) for level in camera.levels))
    return [
        camera.name,
        _percent(last.rel_mse),
        f"{last.flip:.3g}",
        f"{seconds * result.counts.pass_samples / camera.pass_s[0]:.0f}",
        _percent(camera.law("rel_mse").at(seconds)),
        f"{seen:.3g}",
        "0" if camera.name == EXACT else f"{camera.flip_same:.2g}",
        um_text(camera.film.p50_um),
        um_text(camera.film.p99_um),
    ]


def _percent(square: float) -> str:
    return f"{100 * math.sqrt(square):.3g}" if square > 0 else "~0"


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


def _crossover_text(result: SceneResult, camera: CameraResult, exact: str) -> str:
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


def _csv(results: Iterable[SceneResult]) -> str:
    """Every measured point: squared errors as their roots; an empty cell where noise made the square negative."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(["scene", "camera", "samples", "seconds_min", "seconds_median", "rmse", "relative_rmse", "flip"])
    for result in results:
        for camera in result.cameras.values():
            for level in camera.levels:
                roots = [f"{math.sqrt(e):.5g}" if e > 0 else "" for e in (level.mse, level.rel_mse)]
                times = [f"{t:.5g}" for t in (level.seconds_min, level.seconds_median)]
                table.writerow([result.name, camera.name, level.samples, *times, *roots, f"{level.flip:.5g}"])
    return out.getvalue()


def _scene_data(result: SceneResult) -> dict[str, Any]:
    def camera_data(c: CameraResult) -> dict[str, Any]:
        return {
            "name": c.name,
            "levels": [asdict(level) for level in c.levels],
            "pass_s_min": c.pass_s[0],
            "pass_s_median": c.pass_s[1],
            **{key: {m: asdict(getattr(c, key)[m]) for m in MEASURES} for key in _ESTIMATES},
            "flip_same_seeds": c.flip_same,
            "film_p50_um": c.film.p50_um,
            "film_p99_um": c.film.p99_um,
            "ahead_after_s": {} if c.name in EXACTS else {n: crossovers_s(result, c, n) for n in _exacts(result)},
        }

    return {
        "scene": result.name,
        "f_number": result.f_number,
        "focus_m": result.settings.focus_m,
        "counts": asdict(result.counts),
        "threads": result.threads,
        "equal_time_s": equal_time_s(result),
        "reference_variance": result.noise2,
        "reference_flip_halves": result.flip_halves,
        "cameras": [camera_data(c) for c in result.cameras.values()],
    }


_ESTIMATES = ("bias2", "extrapolated2", "variance")


_MOST_BYTES = 150_000  # of a picture
_TITLES = {"mse": "RMSE (linear radiance)", "rel_mse": "relative RMSE (share of 1)"}


def draw(result: SceneResult, folder: Path) -> list[Path]:
    """Three pictures: error over time, FLIP maps at equal samples, film-space maps."""
    shot, counts = result.settings, result.counts
    threads = f"{result.threads} thread" + ("" if result.threads == 1 else "s")
    where = f"{result.name}, f/{result.f_number:.3g}, focused at {shot.focus_m:g} m"
    size = f"{counts.size[0]} x {counts.size[1]} pixels"
    over_time = error_over_time_plot(
        [*(_root_panel(result, measure) for measure in MEASURES), _flip_panel(result)],
        folder / f"{result.name}-error.png",
        f"Error against render time: {where}",
        f"{size}, {threads}; markers: 1, 2, 4 ... samples per pixel; the reference has {2 * counts.reference}",
    )
    total = counts.pass_samples * counts.passes
    shown = {n: c for n, c in result.cameras.items() if not n.startswith("fused")}  # whose pictures are their models'
    flips = side_by_side(
        {"reference": result.reference} | {n: c.picture for n, c in shown.items()},
        {n: c.flip_map for n, c in shown.items()},
        folder / f"{result.name}-flip.png",
        {n: _flip_caption(c) for n, c in shown.items()},
        title=f"{result.name}: FLIP against the reference, {total} samples each",
    )
    films = film_maps_plot(
        {n: c.film.median_um for n, c in result.cameras.items()},
        (shot.film_width_mm, shot.film_height_mm),
        folder / f"{result.name}-film.png",
        f"Film-space error: {where}",
        "against the exact ray in float64 of the same film and pupil point; median over pupil and wavelengths",
        {
            n: f"all rays: median {um_text(c.film.p50_um)}, 99% {um_text(c.film.p99_um)} µm"
            for n, c in result.cameras.items()
        },
    )
    for picture in (over_time, flips, films):
        _fewer_colours(picture)
    return [over_time, flips, films]


def um_text(value: float) -> str:
    """Micrometres with two figures, whole from 100 on."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def _flip_caption(camera: CameraResult) -> str:
    same = "" if camera.name == EXACT else f"\nfrom exact, same random numbers: {camera.flip_same:.2g}"
    return f"FLIP {camera.flip_map.mean():.3g}{same}"


def _root_panel(result: SceneResult, measure: str) -> Panel:
    def curve(camera: CameraResult) -> tuple[list[float], list[float]]:
        squares = [getattr(level, measure) for level in camera.levels]
        return [level.seconds_min for level in camera.levels], [math.sqrt(s) if s > 0 else math.nan for s in squares]

    biased = {n: math.sqrt(c.bias2[measure].value) for n, c in result.cameras.items() if c.bias2[measure].resolved}
    curves = {n: curve(c) for n, c in result.cameras.items()}
    return Panel(_TITLES[measure], curves, math.sqrt(result.noise2[measure]), "noise of the reference", biased)


def _flip_panel(result: SceneResult) -> Panel:
    curves = {
        n: ([level.seconds_min for level in c.levels], [level.flip for level in c.levels])
        for n, c in result.cameras.items()
    }
    return Panel("mean FLIP (0 to 1)", curves, result.flip_halves, "between halves of the reference", {})


def _fewer_colours(picture: Path) -> None:
    """Keep at most 256 colours of a PNG, half as many and so on until it is small enough for the repository."""
    with Image.open(picture) as full:
        pixels = full.convert("RGB")
    for colours in (256, 128, 64, 32):
        with atomic_path(picture) as temporary:
            pixels.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
                temporary, optimize=True
            )
        if picture.stat().st_size <= _MOST_BYTES:
            return


_MARKERS = "osD^vP"
_FUSED = "fused "


@dataclass(frozen=True)
class Panel:
    """One kind of error.

    Attributes:
        label: quantity and unit. curves: camera to (seconds [L], error [L]); what is not above 0 is left out.
        floor: what the reference itself is worth, with its `floor_name`. levels: camera to an error that more samples
            do not lower, drawn where it lies in view.
    """

    label: str
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    floor: float
    floor_name: str
    levels: Mapping[str, float]


def error_over_time_plot(panels: Sequence[Panel], path: str | Path, title: str, subtitle: str) -> Path:
    """Panels side by side, log-log, one line per camera, with the reference's own noise and the biases.

    Raises:
        InputError: nothing to draw.
    """
    if not panels or not any(panel.curves for panel in panels):
        raise InputError("error over time", "panels", "(none)", "at least one panel with a curve")
    with drawing(path, 3.5 * len(panels), 4.1) as figure:
        row = figure.subplots(1, len(panels), squeeze=False)[0]
        handles: dict[str, Any] = {}
        for axes, panel in zip(row, panels, strict=True):
            handles |= _draw(axes, panel)
        heading(figure, title, subtitle)
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return Path(path)


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


def film_maps_plot(
    maps: Mapping[str, ArrayLike],
    film_mm: tuple[float, float],
    path: str | Path,
    title: str,
    subtitle: str,
    captions: Mapping[str, str] | None = None,
) -> Path:
    """Film-space errors over the film, as the picture shows it, each with its own colour bar: they differ too much.

    Args:
        maps: camera to [rows, columns] in um; NaN (no ray) stays white.
        film_mm: width and height.
        captions: below the name of a camera.
    Raises:
        InputError: no map.
    """
    if not maps:
        raise InputError("film maps", "maps", "(none)", "at least one map")
    columns = 2 if len(maps) in (2, 4) else min(len(maps), 3)
    rows = -(-len(maps) // columns)
    with drawing(path, 4.0 * columns, 0.7 + 2.3 * rows) as figure:
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        across, up = film_mm[0] / 2, film_mm[1] / 2
        for axes, (name, values) in zip(places, maps.items(), strict=False):
            shown = axes.imshow(np.asarray(values), cmap="magma", vmin=0, extent=(-across, across, -up, up))
            axes.set_title(f"{name}\n{(captions or {}).get(name, '')}", fontsize=9.5)
            axes.set(xlabel="across the picture (mm on the film)", ylabel="up (mm)")
            axes.xaxis.label.set_size(8.5)
            bar = figure.colorbar(shown, ax=axes, shrink=0.85)
            bar.set_label("median error (µm)", fontsize=8.5)
            bar.outline.set_visible(False)
        for axes in places[len(maps) :]:
            axes.set_axis_off()
        heading(figure, title, subtitle)
    return Path(path)


def _colour(name: str) -> str:
    """Black for the exact lens, else that of the family that a name begins with; a fused camera is drawn dashed."""
    kind = name.removeprefix(_FUSED)
    if kind == "exact":
        return INK
    return family_colour("paraxial" if kind.startswith("thin") else kind.split("-")[0])


ABOUT = """\
Error over time of the exact lens, a polynomial, a network and a thin lens in three scenes, against a
converged exact render with other seeds: bias and variance told apart, seconds per sample, from when the
exact lens is ahead, equal time and equal samples, FLIP maps and film-space error maps in micrometres.
Best and median seconds; the exact lens and the network as compiled C, too.
Renders are kept in the run folder: an interrupted run resumes, and what would give
another picture is rendered again. Needs the extra "train" (torch, matplotlib, flip-evaluator) and a C
compiler. Writes README.md, equal_time.csv, equal_time.json and three pictures a scene (about ten minutes)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m experiments equal-time`."""
    parser.add_argument(
        "--scene", metavar="SCENE", action="append",
        help="grid, lights, room or a scene file; again for more (default: all three)",
    )  # fmt: skip
    parser.add_argument(
        "--quick", action="store_true", help="tiny pictures, few samples (a minute); results stay in the run folder"
    )
    parser.add_argument(
        "--threads", metavar="N", type=whole(1, 256), default=1, help="of the timed renders (default 1)"
    )
    parser.add_argument("--folder", metavar="DIR", type=Path, help="of the kept renders (default: runs/equal_time)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: experiments/results/equal_time")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")


def run(args: argparse.Namespace) -> int:
    """Measure scene by scene; the page is written after each."""
    counts = QUICK if args.quick else Counts()
    folder = args.folder or lab.ROOT / "runs" / ("equal_time_quick" if args.quick else "equal_time")
    out = args.out or (folder / "results" if args.quick else lab.RESULTS / "equal_time")
    files = [scene_file(name, lab.ROOT) for name in args.scene or SCENES]
    progress = Progress({file.stem: 1.0 for file in files}, quiet=args.quiet)
    done: list[SceneResult] = []
    for file in files:
        with progress.stage(file.stem) as report:
            done.append(measure_scene(file, lab.ROOT, folder, counts, args.threads, report))
        text = write(done, out)
    print(text)
    print(f"Written to {out}")
    return 0
