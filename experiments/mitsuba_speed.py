"""Paths per second of the renderer beside the scalar and LLVM variants of Mitsuba 3, on Mitsuba's own Cornell box.

With its pinhole and through a lens model: the same picture, samples, depth and roulette, in one run. Each renderer
makes a picture in turn, so that a busy machine slows all alike; compiling is not counted. Without the extra "mitsuba"
nothing is measured, and the page says so.
Writes render_speed.md and render_speed.json.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.lab import Report
from experiments.mitsuba_scenes import our_scene, with_our_spectra
from neurolens import mitsuba
from neurolens.base.errors import NeurolensError
from neurolens.base.progress import Progress
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.ideal import Pinhole
from neurolens.mitsuba import require_mitsuba
from neurolens.mitsuba.sensor import libraries
from neurolens.render.renderer import render
from neurolens.render.scene import Scene
from neurolens.render.settings import FilmSettings

FOCAL_MM = 50.0
FOCUS_M, F_NUMBER = 3.9, 2.0
ROULETTE_FROM = 3  # segments in Mitsuba's count: what our integrator does after two surfaces
_TRIANGLES = "triangles (Embree)"
VARIANTS = ("scalar_rgb", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_spectral")


@dataclass(frozen=True)
class Settings:
    """The task of all renderers: a picture of size x size pixels, samples per pixel, threads, repeats."""

    size: int = 256
    samples: int = 16
    threads: int = 2
    repeats: int = 5

    @property
    def paths(self) -> int:
        """The paths of one picture."""
        return self.size * self.size * self.samples


@dataclass
class Row:
    """One renderer: seconds of each repeat, `first_s` of the first, with compiling.

    `pictures` [H, W, 3] of the repeats are divided by `white`, the camera's picture of a white card.
    """

    name: str
    carries: str
    camera: str
    draw: Callable[[int], FloatArray]
    white: FloatArray
    first_s: float = 0.0
    seconds: list[float] = field(default_factory=list)
    pictures: list[FloatArray] = field(default_factory=list)

    def run(self, seed: int) -> None:
        """Make and time one picture; the first is kept apart."""
        began = time.perf_counter()
        picture = self.draw(seed)
        seconds = time.perf_counter() - began
        if not self.first_s:
            self.first_s = seconds
            return
        self.seconds.append(seconds)
        self.pictures.append(picture / self.white)


def cornell_box(settings: Settings) -> dict[str, Any]:
    """Mitsuba's Cornell box at a picture size, box-filtered, with our beginning of roulette.

    Sampled by `multijitter`: of Mitsuba's samplers the one of least noise at equal time (its scene has `independent`).
    """
    mi, _ = libraries()
    box: dict[str, Any] = mi.cornell_box()
    size = settings.size
    box["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    box["sensor"]["sampler"] = {"type": "multijitter", "sample_count": settings.samples}
    box["integrator"]["rr_depth"] = ROULETTE_FROM
    return box


def film_mm(box: dict[str, Any]) -> tuple[float, float]:
    """The film on which a 50 mm pinhole sees what Mitsuba's camera sees."""
    side = 2 * FOCAL_MM * math.tan(math.radians(box["sensor"]["fov"] / 2))
    return side, side


_NO_WHITE = np.ones((1, 1, 1), np.float32)


def rows(model: Path, settings: Settings) -> list[Row]:
    """Every renderer that this machine can run; a variant without its compiler is left out.

    Raises:
        NeurolensError: no Mitsuba at all.
    """
    mi = require_mitsuba("scalar_rgb")
    libraries()[1].set_thread_count(settings.threads)
    box = cornell_box(settings)
    pinhole = Pinhole(FOCAL_MM, film_mm(box))
    lens = mitsuba.camera(model, film_mm=(28.0, 28.0), focus_m=FOCUS_M, f_number=F_NUMBER)
    behind, meshes = (
        our_scene(box, pinhole.film_mm, back_m=1e-3 * FOCAL_MM, triangles=triangles) for triangles in (False, True)
    )
    results = [
        _ours(behind, pinhole, "hero", settings),
        _ours(behind, pinhole, "one", settings),
        _ours(meshes, pinhole, "hero", settings, _TRIANGLES),
        _ours(our_scene(box, lens.film_mm), lens, "one", settings),
    ]
    # Natural vignetting of the pinhole, [size, size, 1], which Mitsuba's has not.
    place = (np.arange(settings.size) + 0.5) / settings.size - 0.5
    tangent2 = (place[:, None] ** 2 + place[None, :] ** 2) * (pinhole.film_mm[0] / pinhole.focal_length_mm) ** 2
    cos4 = ((1 + tangent2) ** -2.0).astype(np.float32)[..., None]
    for variant in VARIANTS:
        try:
            require_mitsuba(variant)
        except NeurolensError:
            continue
        results.append(_theirs(variant, None, settings, np.reciprocal(cos4)))
        if variant.startswith("llvm"):
            results.append(_theirs(variant, lens, settings, _NO_WHITE))
    mi.set_variant("scalar_rgb")
    return results


def _ours(scene: Scene, chosen: Camera, wavelengths: Any, settings: Settings, how: str = "rectangles") -> Row:
    film = FilmSettings(wavelengths=wavelengths)

    def draw(seed: int) -> FloatArray:
        return render(scene, chosen, samples=settings.samples, threads=settings.threads, seed=seed, film=film).rgb

    carries = {"hero": "4 wavelengths", "one": "1 wavelength"}[wavelengths]
    return Row(f"neurolens, {how}", carries, _word(chosen), draw, _NO_WHITE)


def _theirs(variant: str, chosen: Camera | None, settings: Settings, white: FloatArray) -> Row:
    """Mitsuba in a variant, through its own pinhole or a camera of ours."""
    spectral = variant.endswith("spectral")
    require_mitsuba(variant)
    box = cornell_box(settings)
    scene = mitsuba.load_scene(with_our_spectra(box) if spectral else box)

    def draw(seed: int) -> FloatArray:
        mi = require_mitsuba(variant)
        if chosen is not None:
            return mitsuba.render(scene, chosen, spp=settings.samples, seed=seed)
        return np.array(mi.render(scene, spp=settings.samples, seed=seed), np.float32)

    lanes = "RGB" if not spectral else "1 wavelength" if chosen is not None else "4 wavelengths"
    return Row(f"Mitsuba {variant}", lanes, _word(chosen), draw, white)


def _word(chosen: Camera | None) -> str:
    return "pinhole" if chosen is None or chosen.name == "pinhole" else "lens model"


def record(row: Row, settings: Settings, base: Row) -> dict[str, Any]:
    """Figures of a row: Mpath/s of the fastest and of the median repeat, time over that of `base`, and the picture.

    `mean_rgb`: of the picture. `noise`: variance of a pixel's luminance between the repeats over its square, both
    means over the picture, at the settings' samples. `equal_noise`: time to the noise that `base` has, over its time.
    """
    low, middle = min(row.seconds), statistics.median(row.seconds)
    (noise, base_noise), over = (_noise(r) for r in (row, base)), middle / statistics.median(base.seconds)
    return {
        **{key: getattr(row, key) for key in ("name", "carries", "camera", "first_s")},
        **{"mpaths_per_s": settings.paths / low * 1e-6, "mpaths_per_s_median": settings.paths / middle * 1e-6},
        **{"seconds_min": low, "seconds_median": middle, "time_over_ours": over, "noise": noise},
        "mean_rgb": np.mean(row.pictures, axis=(0, 1, 2)).tolist(),
        "equal_noise": over * noise / base_noise if noise and base_noise else None,
    }


def _noise(row: Row) -> float | None:
    grey = np.stack(row.pictures) @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    return float(np.mean(grey.var(axis=0, ddof=1)) / np.mean(grey**2)) if len(grey) > 1 else None


@dataclass
class Results:
    """The results: rows of `record`; `missing` says what was not measured, and why."""

    settings: Settings
    versions: dict[str, str]
    rows: list[dict[str, Any]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


_BESIDE = """\
Its own Cornell box, {size} x {size} pixels, {samples} samples, at most seven surfaces, roulette after two in all; \
{repeats} repeats in turn; the first picture, with compiling, is beside. Time: median, over that of our first row. \
Mean: of the picture's R, G and B; the lens sees another part of the box than the pinhole, and RGB paths mix colours \
otherwise than spectra. Noise: variance of a pixel's luminance over its square at these samples, low-discrepancy in \
all (Mitsuba's `multijitter`); beside it the time to the noise of our first row, over its time. A lens that disperses \
leaves a path one wavelength, in Mitsuba four times the same. The llvm variants take the processor's widest vectors: \
held to AVX2 they ran 1.6 to 1.9 times as long on a processor with AVX-512, with LLVM 15 as with LLVM 19 (LLVM 15 \
cannot compile them for AVX-512)."""
_SPEEDS = lab.columns(
    ("renderer", "name"),
    ("a path carries", "carries"),
    ("camera", "camera"),
    ("Mpath/s, fastest", "mpaths_per_s", ".3g"),
    ("median", "mpaths_per_s_median", ".3g"),
    ("time", "time_over_ours", ".2f"),
    ("mean R G B", lambda r: " ".join(f"{v:.4f}" for v in r["mean_rgb"])),
    ("noise", "noise", ".2g"),
    ("time to equal noise", "equal_noise", ".2f"),
    ("first picture s", "first_s", ".2g"),
)


def page(results: Results) -> str:
    """The tables as Markdown."""
    s = results.settings
    versions = ", ".join(f"{name} {version}" for name, version in results.versions.items())
    parts = [f"One run of `python -m experiments mitsuba` ({versions}); {s.threads} threads."]
    if results.rows:
        parts += ["## Beside Mitsuba 3", _BESIDE.format(**vars(s)), lab.table(_SPEEDS, results.rows, "–")]
    return lab.page("# Speed of the renderer", *parts, *(f"Not measured: {reason}" for reason in results.missing))


MODEL = "laikin_double_gauss_50.ols-60.onnx"
OPTIONS = (
    lab.count("size", 256, "side in pixels (default: 256)", 16, 2048),
    lab.count("samples", 16, "a pixel (default: 16)", 1, 4096),
    lab.count("repeats", 5, "default: 5", 1, 100),
    lab.count("threads", 2, "of all (default: 2)", 1, 256),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure, and write the page."""
    results = Results(Settings(args.size, args.samples, args.threads, args.repeats), _versions())
    with Progress({"beside Mitsuba": 120.0}, quiet=args.quiet).stage("beside Mitsuba") as report:
        try:
            _beside(results, report)
        except NeurolensError as error:
            results.missing.append(f"beside Mitsuba ({error})")
    print(lab.write_results(args.out, "render_speed", page(results), vars(results)))


def _versions() -> dict[str, str]:
    known = {}
    for package in ("numpy", "mitsuba", "drjit", "embreex"):
        with suppress(PackageNotFoundError):
            known[package] = version(package)
    with suppress(NeurolensError, AttributeError):  # no LLVM, or a Dr.Jit that does not tell
        require_mitsuba("llvm_ad_rgb")
        known["LLVM"] = ".".join(map(str, libraries()[1].detail.llvm_version()))
    return known


def _beside(results: Results, report: Report) -> None:
    """Run every renderer once to warm up, then in turn `repeats` times."""
    made = rows(lab.MODELS / MODEL, results.settings)
    total = len(made) * (results.settings.repeats + 1)
    for k in range(total):
        made[k % len(made)].run(seed=k // len(made))
        report((k + 1) / total)
    results.rows = [record(row, results.settings, made[0]) for row in made]
