"""What `neurolens bench equal-time` writes: README.md, equal_time.csv (every point), equal_time.json, the pictures."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from neurolens.base.files import atomic_write_text
from neurolens.evaluate.benches.equal_time import MEASURES, CameraResult, SceneResult
from neurolens.evaluate.benches.equal_time_cameras import EXACT, EXACTS, LENS
from neurolens.evaluate.benches.equal_time_fit import Estimate, crossover_s, log_interpolate
from neurolens.evaluate.benches.equal_time_pictures import draw, um_text
from neurolens.evaluate.benches.trace_speed_page import machine
from neurolens.evaluate.records import plain

_INTRO = """\
# Equal time and equal samples

`neurolens bench equal-time`: {lens} exact in torch, through surrogates in onnxruntime, both as compiled
C (fused), and as a thin lens of its focal length and f-number. Against the exact lens with other seeds and {reference}
samples a pixel, in two halves. Every camera draws the same random numbers, one wavelength a path. Times are the
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
    data = {"machine": machine(), "scenes": [_scene_data(r) for r in results]}
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
    about = machine()
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
            *_table(
                ["camera", "bias paired %", "bias alone %", "variance a sample", "ms a sample", "efficiency 1/s"]
                + [f"{name} ahead" for name in _exacts(result)],
                [_law_cells(result, c) for c in result.cameras.values()],
            ),
            "",
            *_table(
                ["camera", f"{most} samples: error %", "FLIP", f"{seconds:.3g} s: samples", "error %", "FLIP"]
                + ["FLIP paired", "film median", "film 99%"],
                [_equal_cells(result, c, seconds) for c in result.cameras.values()],
            ),
            f"\n![Error against time]({stem}-error.png)\n",
            f"![FLIP maps]({stem}-flip.png)\n\n![Film-space error]({stem}-film.png)\n",
        ]
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]


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
    """Two figures in a unit that suits, from milliseconds to years."""
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
