"""Speed of the renderer beside Mitsuba 3: the same Cornell box, picture, samples, depth and roulette, in one run.

The scene is Mitsuba's own, unmodified but for the depth at which Russian roulette begins, which is ours. Each renderer
makes a picture in turn, repeat after repeat, so that a busy machine slows all alike; compiling is not counted.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import NeurolensError
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.cameras.pinhole import Pinhole
from neurolens.mitsuba import camera, load_scene, render, require_mitsuba
from neurolens.mitsuba.library import libraries
from neurolens.mitsuba.scenes import our_scene, with_our_spectra
from neurolens.render.film import FilmSettings
from neurolens.render.renderer import render as our_render
from neurolens.render.scene import Scene

FOCAL_MM = 50.0
FOCUS_M, F_NUMBER = 3.9, 2.0
ROULETTE_FROM = 3  # segments in Mitsuba's count: what our integrator does after two surfaces
_TRIANGLES = f"triangles ({'Embree' if find_spec('embreex') else 'own tree'})"
VARIANTS = ("scalar_rgb", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_spectral")


@dataclass(frozen=True)
class Settings:
    """What all renderers do: a picture of size x size pixels, samples a pixel, threads, repeats."""

    size: int = 256
    samples: int = 16
    threads: int = 2
    repeats: int = 5

    @property
    def paths(self) -> int:
        """Of one picture."""
        return self.size * self.size * self.samples


@dataclass
class Row:
    """One renderer: name, what a path carries, camera; seconds of each repeat, first_s of the first (with compiling).

    `pictures`: of the repeats, [H, W, 3] each, free of what cameras do to a white card.
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


def cornell_box(size: int) -> dict[str, Any]:
    """Mitsuba's Cornell box at a picture size, box-filtered, with our beginning of roulette."""
    mi, _ = libraries()
    box: dict[str, Any] = mi.cornell_box()
    box["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    box["integrator"]["rr_depth"] = ROULETTE_FROM
    return box


def film_mm(box: dict[str, Any]) -> tuple[float, float]:
    """The film on which a 50 mm pinhole sees what Mitsuba's camera sees."""
    side = 2 * FOCAL_MM * math.tan(math.radians(box["sensor"]["fov"] / 2))
    return side, side


def rows(model: Path, settings: Settings) -> list[Row]:
    """Every renderer that this machine can run; a variant without its compiler is left out.

    Raises:
        NeurolensError: no Mitsuba at all.
    """
    mi = require_mitsuba("scalar_rgb")
    libraries()[1].set_thread_count(settings.threads)
    box = cornell_box(settings.size)
    pinhole = Pinhole(FOCAL_MM, film_mm(box))
    lens = camera(model, film_mm=(28.0, 28.0), focus_m=FOCUS_M, f_number=F_NUMBER)
    behind, meshes = (
        our_scene(box, pinhole.film_mm, back_m=1e-3 * FOCAL_MM, triangles=triangles) for triangles in (False, True)
    )
    found = [
        _ours(behind, pinhole, "hero", settings),
        _ours(behind, pinhole, "one", settings),
        _ours(meshes, pinhole, "hero", settings, _TRIANGLES),
        _ours(our_scene(box, lens.film_mm), lens, "one", settings),
    ]
    cos4 = _cos4(settings.size, pinhole)
    for variant in VARIANTS:
        try:
            require_mitsuba(variant)
        except NeurolensError:
            continue
        found.append(_theirs(variant, None, settings, np.reciprocal(cos4)))
        if variant.startswith("llvm"):
            found.append(_theirs(variant, lens, settings, np.ones((1, 1, 1), np.float32)))
    mi.set_variant("scalar_rgb")
    return found


def _ours(scene: Scene, chosen: Camera, wavelengths: Any, settings: Settings, how: str = "rectangles") -> Row:
    film = FilmSettings(wavelengths=wavelengths)

    def draw(seed: int) -> FloatArray:
        done = our_render(
            scene, chosen, samples=settings.samples, threads=settings.threads, seed=seed, film=film
        )  # fmt: skip
        return done.rgb

    carries = {"hero": "4 wavelengths", "one": "1 wavelength"}[wavelengths]
    return Row(f"neurolens, {how}", carries, _word(chosen), draw, np.ones((1, 1, 1), np.float32))


def _theirs(variant: str, chosen: Camera | None, settings: Settings, white: FloatArray) -> Row:
    """Mitsuba in a variant, through its own pinhole or a camera of ours."""
    spectral = variant.endswith("spectral")

    def prepared() -> Any:
        mi = require_mitsuba(variant)
        box = cornell_box(settings.size)
        return mi, load_scene(with_our_spectra(box) if spectral else box)

    scene = prepared()[1]

    def draw(seed: int) -> FloatArray:
        mi = require_mitsuba(variant)
        if chosen is not None:
            return render(scene, chosen, spp=settings.samples, seed=seed)
        return np.array(mi.render(scene, spp=settings.samples, seed=seed), np.float32)

    lanes = "RGB" if not spectral else "1 wavelength" if chosen is not None else "4 wavelengths"
    return Row(f"Mitsuba {variant}", lanes, _word(chosen), draw, white)


def _word(chosen: Camera | None) -> str:
    return "pinhole" if chosen is None or chosen.name == "pinhole" else "lens model"


def _cos4(size: int, pinhole: Pinhole) -> FloatArray:
    """Natural vignetting of the pinhole, [size, size, 1], which Mitsuba's has not."""
    place = (np.arange(size) + 0.5) / size - 0.5
    tangent2 = (place[:, None] ** 2 + place[None, :] ** 2) * (pinhole.film_mm[0] / pinhole.focal_mm) ** 2
    return ((1 + tangent2) ** -2.0).astype(np.float32)[..., None]


def measure(found: list[Row], settings: Settings, report: Callable[[float], None]) -> None:
    """Run every renderer once to warm up, then in turn `repeats` times."""
    total = len(found) * (settings.repeats + 1)
    for repeat in range(settings.repeats + 1):
        for k, row in enumerate(found):
            row.run(seed=repeat)
            report((repeat * len(found) + k + 1) / total)


def record(row: Row, settings: Settings, base: Row) -> dict[str, Any]:
    """Figures of a row: Mpath/s of the fastest and of the median repeat, time over that of `base`, and the picture.

    `mean_rgb`: of the picture. `noise`: variance of a pixel's luminance between the repeats over its square, both
    means over the picture, at the settings' samples.
    """
    low, middle = min(row.seconds), statistics.median(row.seconds)
    pictures = np.stack(row.pictures)
    grey = pictures @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    noise = float(np.mean(grey.var(axis=0, ddof=1)) / np.mean(grey**2)) if len(grey) > 1 else None
    return {
        "name": row.name,
        "carries": row.carries,
        "camera": row.camera,
        "mpaths_per_s": settings.paths / low * 1e-6,
        "mpaths_per_s_median": settings.paths / middle * 1e-6,
        "seconds_min": low,
        "seconds_median": middle,
        "first_s": row.first_s,
        "time_over_ours": middle / statistics.median(base.seconds),
        "mean_rgb": [float(v) for v in pictures.mean(axis=(0, 1, 2))],
        "noise": noise,
    }
