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
from typing import Any

import numpy as np

from experiments import lab
from experiments.peers.mitsuba_scenes import our_scene, with_our_spectra
from neurolens.base.errors import NeurolensError
from neurolens.base.progress import Progress
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.ideal import Pinhole
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import FilmSettings
from neurolens.programs import mitsuba
from neurolens.programs.mitsuba import require_mitsuba
from neurolens.programs.mitsuba.sensor import libraries

FOCAL_MM = 50.0
FOCUS_M, F_NUMBER = 3.9, 2.0
ROULETTE_FROM = 3  # segments in Mitsuba's count: what our integrator does after two surfaces
_TRIANGLES = "triangles (Embree)"
VARIANTS = ("scalar_rgb", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_spectral")


@dataclass
class Renderer:
    """A renderer of the race: what draws a picture by a seed, and the camera's picture of a white card."""

    name: str
    carries: str
    camera: str
    draw: Callable[[int], FloatArray]
    white: FloatArray
    seconds: list[float] = field(default_factory=list)
    pictures: list[FloatArray] = field(default_factory=list)

    def run(self, seed: int) -> None:
        """Make and time one picture; the first is with compiling."""
        began = time.perf_counter()
        picture = self.draw(seed)
        self.seconds.append(time.perf_counter() - began)
        self.pictures.append(picture / self.white)

    def noise(self) -> float | None:
        """Variance of a pixel's luminance between the repeats over its square, both means over the picture."""
        grey = np.stack(self.pictures[1:]) @ np.array([0.2126, 0.7152, 0.0722], np.float32)
        return float(np.mean(grey.var(axis=0, ddof=1)) / np.mean(grey**2)) if len(grey) > 1 else None

    def row(self, base: Renderer, paths: int) -> lab.Row:
        """Mpath/s of the fastest and of the median repeat, time over that of `base`, noise, and time to its noise."""
        low, middle = min(self.seconds[1:]), statistics.median(self.seconds[1:])
        noise, base_noise, over = self.noise(), base.noise(), middle / statistics.median(base.seconds[1:])
        return {
            "name": self.name, "carries": self.carries, "camera": self.camera, "first_s": self.seconds[0],
            "mpaths_per_s": paths / low * 1e-6, "mpaths_per_s_median": paths / middle * 1e-6, "seconds_min": low,
            "seconds_median": middle, "time_over_ours": over, "noise": noise,
            "mean_rgb": np.mean(self.pictures[1:], axis=(0, 1, 2)).tolist(),
            "equal_noise": over * noise / base_noise if noise and base_noise else None,
        }  # fmt: skip


def cornell_box(size: int, samples: int) -> dict[str, Any]:
    """Mitsuba's Cornell box at a picture size, box-filtered, with our beginning of roulette.

    Sampled by `multijitter`: of Mitsuba's samplers the one of least noise at equal time (its scene has `independent`).
    """
    mi, _ = libraries()
    box: dict[str, Any] = mi.cornell_box()
    box["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    box["sensor"]["sampler"] = {"type": "multijitter", "sample_count": samples}
    box["integrator"]["rr_depth"] = ROULETTE_FROM
    return box


_NO_WHITE = np.ones((1, 1, 1), np.float32)


def renderers(args: argparse.Namespace) -> list[Renderer]:
    """Every renderer that this machine can run; a variant without its compiler is left out.

    Raises:
        NeurolensError: no Mitsuba at all.
    """
    mi = require_mitsuba("scalar_rgb")
    libraries()[1].set_thread_count(args.threads)
    box = cornell_box(args.size, args.samples)
    side = 2 * FOCAL_MM * math.tan(math.radians(box["sensor"]["fov"] / 2))  # a 50 mm pinhole sees what theirs sees
    pinhole = Pinhole(FOCAL_MM, (side, side))
    lens = make_camera(lab.MODELS / MODEL, Shot((28.0, 28.0), FOCUS_M, F_NUMBER))
    behind, meshes = (
        our_scene(box, pinhole.film_mm, back_m=1e-3 * FOCAL_MM, triangles=triangles) for triangles in (False, True)
    )
    made = [
        _ours(behind, pinhole, "hero", args),
        _ours(behind, pinhole, "one", args),
        _ours(meshes, pinhole, "hero", args, _TRIANGLES),
        _ours(our_scene(box, lens.film_mm), lens, "one", args),
    ]
    # Natural vignetting of the pinhole, [size, size, 1], which Mitsuba's has not.
    place = (np.arange(args.size) + 0.5) / args.size - 0.5
    tangent2 = (place[:, None] ** 2 + place[None, :] ** 2) * (pinhole.film_mm[0] / pinhole.focal_length_mm) ** 2
    white = ((1 + tangent2) ** 2.0).astype(np.float32)[..., None]
    for variant in VARIANTS:
        with suppress(NeurolensError):
            require_mitsuba(variant)
            made.append(_theirs(variant, None, args, white))
            if variant.startswith("llvm"):
                made.append(_theirs(variant, lens, args, _NO_WHITE))
    mi.set_variant("scalar_rgb")
    return made


def _ours(
    scene: Scene, chosen: Camera, wavelengths: Any, args: argparse.Namespace, how: str = "rectangles"
) -> Renderer:
    film = FilmSettings(wavelengths=wavelengths)

    def draw(seed: int) -> FloatArray:
        return render(scene, chosen, samples=args.samples, threads=args.threads, seed=seed, film=film).rgb

    carries = {"hero": "4 wavelengths", "one": "1 wavelength"}[wavelengths]
    return Renderer(f"neurolens, {how}", carries, _word(chosen), draw, _NO_WHITE)


def _theirs(variant: str, chosen: Camera | None, args: argparse.Namespace, white: FloatArray) -> Renderer:
    """Mitsuba in a variant, through its own pinhole or a camera of ours."""
    spectral = variant.endswith("spectral")
    require_mitsuba(variant)
    box = cornell_box(args.size, args.samples)
    scene = mitsuba.load_scene(with_our_spectra(box) if spectral else box)

    def draw(seed: int) -> FloatArray:
        mi = require_mitsuba(variant)
        if chosen is not None:
            return mitsuba.render(scene, chosen, spp=args.samples, seed=seed)
        return np.array(mi.render(scene, spp=args.samples, seed=seed), np.float32)

    lanes = "RGB" if not spectral else "1 wavelength" if chosen is not None else "4 wavelengths"
    return Renderer(f"Mitsuba {variant}", lanes, _word(chosen), draw, white)


def _word(chosen: Camera | None) -> str:
    return "pinhole" if chosen is None or chosen.name == "pinhole" else "lens model"


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


MODEL = "laikin_double_gauss_50.ols-60.onnx"
OPTIONS = (
    lab.count("size", 256, "side in pixels (default: 256)", 16, 2048),
    lab.count("samples", 16, "a pixel (default: 16)", 1, 4096),
    lab.count("repeats", 5, "default: 5", 1, 100),
    lab.count("threads", 2, "of all (default: 2)", 1, 256),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Run every renderer once to warm up, then in turn `repeats` times, and write the page."""
    rows, missing, versions = list[lab.Row](), "", _versions()
    with Progress({"beside Mitsuba": 120.0}, quiet=args.quiet).stage("beside Mitsuba") as report:
        try:
            made = renderers(args)
            for k in range(total := len(made) * (args.repeats + 1)):
                made[k % len(made)].run(seed=k // len(made))
                report((k + 1) / total)
            rows = [each.row(made[0], args.size**2 * args.samples) for each in made]
        except NeurolensError as error:
            missing = f"Not measured: beside Mitsuba ({error})"
    words = ", ".join(f"{name} {version}" for name, version in versions.items())
    parts = [f"One run of `python -m experiments mitsuba` ({words}); {args.threads} threads."]
    if rows:
        parts += ["## Beside Mitsuba 3", _BESIDE.format(**vars(args)), lab.table(_SPEEDS, rows, "–")]
    settings = {key: getattr(args, key) for key in ("size", "samples", "threads", "repeats")}
    data = {"settings": settings, "versions": versions, "rows": rows, "missing": missing}
    print(lab.write_results(args.out, "render_speed", lab.page("# Speed of the renderer", *parts, missing), data))


def _versions() -> dict[str, str]:
    known = {}
    for package in ("numpy", "mitsuba", "drjit", "embreex"):
        with suppress(PackageNotFoundError):
            known[package] = version(package)
    with suppress(NeurolensError, AttributeError):  # no LLVM, or a Dr.Jit that does not tell
        require_mitsuba("llvm_ad_rgb")
        known["LLVM"] = ".".join(map(str, libraries()[1].detail.llvm_version()))
    return known
