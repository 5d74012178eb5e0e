"""Equal time and equal samples: errors of pictures through a lens, its models and a thin lens in three scenes.

The reference is a converged picture through the exact lens with other seeds, in two halves. A progressive render adds
passes with seeds of their own, so that its squared error, mean over the pixels, is bias^2 + V / K after K passes. With
pictures I_i of the passes and the halves R_1, R_2, the products <I_i - R_1, I_j - R_2> have the mean bias^2 for i != j,
and bias^2 + V for i = j: the bias alone, free of the reference's own noise. With the exact lens's passes J_i of the
same random numbers, <I_i - J_i, I_j - J_j> for i != j has the mean bias^2 between the two, and most noise cancels
first: the paired bias. Needs the extra "train" (torch, flip-evaluator) and a C compiler. Writes equal_time.md,
equal_time.json and equal_time.png after each scene (some ten minutes); scenes that these have are kept.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from experiments import lab
from experiments.lab import Row
from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.onnxlens import load_model
from neurolens.models.fitted import Domain
from neurolens.optics.analysis.plots import drawing, plain_log_ticks
from neurolens.optics.readers.lensfile import read_lens
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import CameraSettings, load_scene
from neurolens.studies import scenes
from neurolens.studies.scenes import EPS, flip

Floats = NDArray[np.float64]
Passes = tuple[list[Floats], list[float]]  # pictures [H, W, 3] and seconds, in the order of `Counts.jobs`

EXACT, FUSED_EXACT, LENS = "exact", "fused exact", "laikin_double_gauss_50"
MODELS = {name: lab.MODELS / f"{LENS}.{name}.onnx" for name in ("ols-28", "mlp-16x2")}
SCENES = ("grid", "lights", "room")
_PASS_SEED, _SHORT_SEED, _REFERENCE_SEED = 100, 1000, 1_000_000


@dataclass(frozen=True)
class Counts:
    """The amount of rendering.

    Attributes:
        size: width and height in pixels.
        short: samples of the renders shorter than a pass, each `repeats` times. pass_samples, passes: of a pass, and
            how many. reference: samples of each half of the reference.
    """

    size: tuple[int, int] = (160, 90)
    short: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    repeats: int = 4
    pass_samples: int = 64
    passes: int = 8
    reference: int = 2048

    @property
    def jobs(self) -> list[tuple[int, int]]:
        """(samples, seed) of the renders through each camera, passes last."""
        short = [(n, _SHORT_SEED * (i + 1) + k) for k in range(self.repeats) for i, n in enumerate(self.short)]
        return short + [(self.pass_samples, _PASS_SEED + k) for k in range(self.passes)]


QUICK = Counts((64, 36), (1, 2, 4, 8), 2, 16, 4, 256)


# ---- Estimates. ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """A value and its standard deviation, by the jackknife over the passes."""

    value: float
    sd: float

    @property
    def resolved(self) -> bool:
        """Whether the value is more than two deviations above 0."""
        return self.value > 2 * self.sd


def weights(reference: ArrayLike) -> Floats:
    """Weight of each value's squared error in the relative MSE: 1 / (R^2 + eps)."""
    return np.asarray(1 / (np.asarray(reference, np.float64) ** 2 + EPS))


def squared_error(image: ArrayLike, halves: Sequence[ArrayLike], weight: ArrayLike) -> float:
    """Weighted mean of (I - R_1)(I - R_2): the squared error of `image`, without the reference's own noise.

    It may come out below 0 where the error is smaller than that noise.
    """
    one, two = (np.asarray(image, np.float64) - np.asarray(half, np.float64) for half in halves)
    return float(np.mean(np.asarray(weight) * one * two))


def reference_variance(halves: Sequence[ArrayLike], weight: ArrayLike) -> float:
    """Variance of the mean of two independent halves: a quarter of their mean squared difference."""
    difference = np.asarray(halves[0], np.float64) - np.asarray(halves[1], np.float64)
    return float(np.mean(np.asarray(weight) * difference**2)) / 4


def bias_and_variance(passes: ArrayLike, halves: Sequence[ArrayLike], weight: ArrayLike) -> tuple[Estimate, Estimate]:
    """bias^2 and the variance of one pass, from passes [K, ...] with seeds of their own; see the module.

    Raises:
        InputError: fewer than three passes, which leave no deviation.
    """
    rows = _rows(passes)
    root = np.sqrt(np.asarray(weight, np.float64)).ravel()
    one, two = ((rows - np.asarray(half, np.float64).ravel()) * root for half in halves)
    gram = one @ two.T / rows.shape[1]
    return _jackknife(gram, _apart), _jackknife(gram, lambda g: float(np.trace(g)) / len(g) - _apart(g))


def paired_bias(passes: ArrayLike, others: ArrayLike, weight: ArrayLike) -> Estimate:
    """bias^2 between two cameras whose passes [K, ...] share their random numbers, pass by pass.

    Raises:
        InputError: passes that do not pair, or fewer than three.
    """
    rows, against = _rows(passes), _rows(others)
    if rows.shape != against.shape:
        raise InputError("paired bias", "passes", f"({rows.shape})", f"those of the other camera, {against.shape}")
    difference = (rows - against) * np.sqrt(np.asarray(weight, np.float64)).ravel()
    return _jackknife(difference @ difference.T / rows.shape[1], _apart)


def _rows(passes: ArrayLike) -> Floats:
    values = np.asarray(passes, np.float64)
    if values.ndim < 2 or len(values) < 3:
        raise InputError("bias and variance", "passes", f"({len(np.atleast_1d(values))})", "at least three pictures")
    return values.reshape(len(values), -1)


def _apart(gram: Floats) -> float:
    """Mean of the products of different passes."""
    count = len(gram)
    return float(gram.sum() - np.trace(gram)) / (count * (count - 1))


def _jackknife(gram: Floats, statistic: Callable[[Floats], float]) -> Estimate:
    """A statistic of the products of passes, and its deviation from leaving out one pass after the other (Tukey)."""
    count = len(gram)
    without = np.array([statistic(np.delete(np.delete(gram, k, 0), k, 1)) for k in range(count)])
    return Estimate(statistic(gram), float(np.sqrt((count - 1) * np.mean((without - without.mean()) ** 2))))


# ---- One scene. ------------------------------------------------------------------------------------------------------


def scene_cameras(shot: CameraSettings) -> dict[str, Camera]:
    """The cameras of a scene by name, the exact one first.

    All cameras of the lens have the pupil bounds of the models' domain: the same random numbers are the same rays.
    """
    lens = read_lens(lab.LENSES / f"{LENS}.toml")
    domain = Domain.from_dict(load_model(MODELS["ols-28"]).card["domain"])
    plain = scenes.scene_cameras(lens, domain, MODELS, shot)
    fused = scenes.scene_cameras(lens, domain, {"mlp-16x2": MODELS["mlp-16x2"]}, shot, fused=True)
    cameras = {name: plain[name] for name in (EXACT, *MODELS)}
    cameras |= {"fused mlp-16x2": fused["mlp-16x2"], FUSED_EXACT: fused[EXACT]}
    return cameras | {"thin lens": plain["thin lens"]}


def measure_scene(file: Path, counts: Counts, threads: int, report: lab.Report) -> Row:
    """Render one scene through every camera in turn, so that load affects all equally, and measure the pictures."""
    torch.set_num_threads(1)  # in this process; workers do so themselves
    scene = load_scene(file)
    shot, film = scene.settings.camera, replace(scene.settings.film, wavelengths="one")  # shared random numbers
    cameras, (width, height) = scene_cameras(shot), counts.size
    done, total = 0, 2 * counts.reference + len(cameras) * sum(n for n, _ in counts.jobs)

    def drawn(camera: Camera, samples: int, seed: int, workers: int) -> tuple[Floats, float]:
        nonlocal done
        made = render(
            scene, camera, width=width, height=height, film=film, samples=samples, seed=seed, threads=workers
        )  # fmt: skip
        done += samples
        report(done / total)
        return made.rgb.astype(np.float64), float(made.stats.seconds)

    halves = [drawn(cameras[EXACT], counts.reference, _REFERENCE_SEED + k, 2)[0] for k in range(2)]
    for camera in cameras.values():  # the first render of a camera loads code and fills caches
        render(scene, camera, width=width, height=height, samples=1, threads=1)
    rendered: dict[str, Passes] = {name: ([], []) for name in cameras}
    for samples, seed in counts.jobs:
        for name, camera in cameras.items():
            picture, seconds = drawn(camera, samples, seed, threads)
            rendered[name][0].append(picture)
            rendered[name][1].append(seconds)
    weight = weights((halves[0] + halves[1]) / 2)
    return {
        "scene": scene.name,
        "f_number": float(cameras[EXACT].settings["f_number"]),
        "focus_m": shot.focus_m,
        "counts": asdict(counts),
        "threads": threads,
        "reference_variance": reference_variance(halves, weight),
        "reference_flip": flip(halves[0], halves[1]),
        "cameras": [camera_row(name, own, rendered[EXACT], halves, counts) for name, own in rendered.items()],
    }


def camera_row(name: str, own: Passes, exact: Passes, halves: Sequence[Floats], counts: Counts) -> Row:
    """The errors of one camera's renders.

    Returns: levels, by samples; pass_s, best and median seconds of a pass; bias2, against the exact camera with the
        same random numbers; alone2, bias^2 from the camera's own passes and the reference; variance of a pass;
        flip_paired, FLIP of the mean picture against the exact camera's with the same random numbers.
    """
    reference = (halves[0] + halves[1]) / 2
    weight, order = weights(reference), [n for n, _ in counts.jobs]
    (pictures, seconds), others = own, np.stack(exact[0][-counts.passes :])
    passes, times = pictures[-counts.passes :], seconds[-counts.passes :]

    def level(samples: int, some: Sequence[Floats], took: Sequence[float]) -> Row:
        error = float(np.mean([squared_error(p, halves, weight) for p in some]))
        row = {"samples": samples, "seconds_min": min(took), "seconds_median": float(np.median(took))}
        return row | {"rel_mse": error, "flip": float(np.mean([flip(p, reference) for p in some]))}

    levels = []
    for samples in counts.short:
        mine = [k for k, n in enumerate(order) if n == samples]
        levels.append(level(samples, [pictures[k] for k in mine], [seconds[k] for k in mine]))
    for together in (2**k for k in range(int(math.log2(counts.passes)) + 1)):  # passes in groups that share none
        groups = [passes[k : k + together] for k in range(0, counts.passes - together + 1, together)]
        means = [np.mean(group, axis=0) for group in groups]
        levels.append(level(together * counts.pass_samples, means, [together * t for t in times]))
    alone, variance = bias_and_variance(np.stack(passes), halves, weight)
    return {
        "name": name,
        "levels": levels,
        "pass_s": [min(times), float(np.median(times))],
        "bias2": asdict(paired_bias(np.stack(passes), others, weight)),
        "alone2": asdict(alone),
        "variance": asdict(variance),
        "flip_paired": flip(np.mean(passes, axis=0), others.mean(axis=0)),
    }


# ---- The page. -------------------------------------------------------------------------------------------------------

_INTRO = """\
# Equal time and equal samples

`python -m experiments equal-time`: {lens} exact and through models in onnxruntime, both as compiled
C (fused), and as a thin lens of its focal length and f-number. Against the exact lens with other seeds and {reference}
samples per pixel, in two halves. Every camera draws the same random numbers, one wavelength per path. Times are the
render's own seconds (best; median in brackets), threads: {threads}, {width} x {height} pixels; making a camera, its fit
and the scene's tables are not in them.

- *Error*: relative RMSE, the root of the mean of (a - b)^2 / (b^2 + 0.01) on linear radiance, in percent; mean FLIP.
  The reference's own noise is taken out of the first (products of the differences from its two halves), not of FLIP.
- *Bias*: what more samples do not lower. A render adds passes of {pass_samples} samples with seeds of their own, so
  that error^2 = bias^2 + V / passes exactly. *Alone* takes this law to infinity from the camera's own {passes} passes
  and the reference; *paired* compares its passes with the exact lens's of the same random numbers, where most noise
  cancels. Deviations by the jackknife over passes; where a square is below two of them, "<" gives the bound of two.
- *Variance*: V times the samples of a pass, relative. *Efficiency*: 1 / (V x seconds of a pass).
- *FLIP paired*: between the camera's mean picture and the exact lens's of the same random numbers.
"""


def page(rows: Sequence[Row]) -> str:
    """The tables of scenes in Markdown."""
    counts, about = rows[0]["counts"], lab.machine()
    (width, height), samples = counts["size"], {k: counts[k] for k in ("pass_samples", "passes")}
    about_run = {"lens": LENS, "reference": 2 * counts["reference"], "threads": rows[0]["threads"]}
    parts = [_INTRO.format(width=width, height=height, **about_run, **samples)]
    for row in rows:
        noise = 100 * math.sqrt(row["reference_variance"])
        parts += [
            f"## {row['scene']}",
            f"Focused at {row['focus_m']:g} m, f/{row['f_number']:.3g}. "
            f"The reference's own noise: {noise:.3g}%; FLIP between its halves {row['reference_flip']:.3g}.",
            lab.table(_law_columns(row), row["cameras"]),
            lab.table(_equal_columns(row), row["cameras"]),
        ]
    parts.append("![Error against time, a line a camera, a panel a scene](equal_time.png)")
    machine = f"{about['processor']}, {about['cores']} cores, Python {about['python']}, numpy {about['numpy']}."
    return lab.page(*parts, machine)


def draw(rows: Sequence[Row], file: Path) -> None:
    """Draw the relative RMSE over seconds, both logarithmic: a panel a scene, a line a camera."""
    with drawing(file, 3.0 * len(rows), 3.8) as figure:
        panels = figure.subplots(1, len(rows), squeeze=False)[0]
        for axes, row in zip(panels, rows, strict=True):
            for camera in row["cameras"]:
                levels = [level for level in camera["levels"] if level["rel_mse"] > 0]
                errors = [100 * math.sqrt(level["rel_mse"]) for level in levels]
                axes.loglog([level["seconds_min"] for level in levels], errors, ".-", label=camera["name"])
            axes.set(title=row["scene"], xlabel="seconds of one thread")
            plain_log_ticks(axes.xaxis, axes.yaxis)
            axes.grid(alpha=0.3)
        panels[0].set_ylabel("relative RMSE, %")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


def error_after(camera: Row, seconds: float) -> float:
    """The squared error after at least one pass, by the law of the module; a bias below 0 counts as none."""
    bias2, variance, pass_s = camera["bias2"]["value"], camera["variance"]["value"], camera["pass_s"][0]
    return float(max(bias2, 0.0) + variance * pass_s / seconds)


def _law_columns(row: Row) -> Sequence[lab.Column]:
    samples = row["counts"]["pass_samples"]
    return lab.columns(
        ("camera", "name"),
        ("bias paired %", lambda c: "0" if c["name"] == EXACT else _root(Estimate(**c["bias2"]))),
        ("bias alone %", lambda c: _root(Estimate(**c["alone2"]))),
        ("variance a sample", "variance.value", ".3g", samples),
        ("ms a sample", lambda c: "{:.3g} ({:.3g})".format(*(1000 * s / samples for s in c["pass_s"]))),
        ("efficiency 1/s", lambda c: 1 / (c["variance"]["value"] * c["pass_s"][0]), ".3g"),
    )


def _equal_columns(row: Row) -> Sequence[lab.Column]:
    """Columns at the most samples, and at the longest time for which every camera was rendered."""
    most = row["cameras"][0]["levels"][-1]["samples"]
    seconds = min(c["levels"][-1]["seconds_min"] for c in row["cameras"])

    def flip_then(camera: Row) -> float:
        points = np.log(sorted((level["seconds_min"], level["flip"]) for level in camera["levels"]))
        return float(np.exp(np.interp(math.log(seconds), points[:, 0], points[:, 1])))

    return lab.columns(
        ("camera", "name"),
        (f"{most} samples: error %", lambda c: _percent(c["levels"][-1]["rel_mse"])),
        ("FLIP", lambda c: c["levels"][-1]["flip"], ".3g"),
        (f"{seconds:.3g} s: samples", lambda c: seconds * row["counts"]["pass_samples"] / c["pass_s"][0], ".0f"),
        ("error %", lambda c: _percent(error_after(c, seconds))),
        ("FLIP", flip_then, ".3g"),
        ("FLIP paired", lambda c: "0" if c["name"] == EXACT else f"{c['flip_paired']:.2g}"),
    )


def _percent(square: float) -> str:
    return f"{100 * math.sqrt(square):.3g}" if square > 0 else "~0"


def _root(square: Estimate) -> str:
    """An error in percent from its square, with its deviation, or the bound where it is not resolved."""
    if not square.resolved:
        return f"< {100 * math.sqrt(max(square.value, 0.0) + 2 * square.sd):.2g}"
    root = math.sqrt(square.value)
    return f"{100 * root:.3g} ± {100 * square.sd / (2 * root):.1g}"


OPTIONS = (
    lab.option("--scene", metavar="SCENE", action="append", help="grid, lights, room or a file (default: all)"),
    lab.option("--quick", action="store_true", help="tiny pictures (a minute)"),
    lab.count("threads", 1, "of the timed renders (default 1)", 1, 256),
    lab.AGAIN, lab.out(),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Measure scene by scene; the page is written after each."""
    counts, files = QUICK if args.quick else Counts(), dict[str, Path]()
    for name in args.scene or SCENES:
        file = lab.SCENES / f"{name}.toml" if name in SCENES else Path(name)
        files[load_scene(file).name] = file  # read now, so that mistakes are found before the work
    lab.resume(
        args, "equal_time", files,
        lambda file, report: measure_scene(file, counts, args.threads, report),
        lambda row: row["scene"], page, listed="scenes", again=args.restart, maker="experiments equal-time",
        seconds=200.0,
    )  # fmt: skip
    draw(json.loads((args.out / "equal_time.json").read_text(encoding="utf-8"))["scenes"], args.out / "equal_time.png")
