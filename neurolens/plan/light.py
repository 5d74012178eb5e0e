"""An overview of the light of a scene: a small picture, its spectrum and contrast, and the light that a lens adds.

A small picture with few samples shows where the scene is bright; two of other seeds, where it has contrast that is no
noise. The lens's ghosts, glare and stars of the scene's own lights, drawn on as few pixels, are set against it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import field_of
from neurolens.flare.canvas import Raster
from neurolens.flare.layers import FlareJob, flare_layers
from neurolens.flare.lights import Light, SceneLights, highlights, keep
from neurolens.graph.compiler import has_compiler
from neurolens.lens.paraxial import colours
from neurolens.lens.prescription import Lens
from neurolens.render.colour import SpectralRange
from neurolens.render.job import expected_light
from neurolens.render.renderer import render
from neurolens.render.scene import Scene
from neurolens.render.settings import FlareSettings

Array = NDArray[np.float64]

ACROSS = 48  # pixels of the small picture along its longer side
BLACK = 0.01  # of the picture's mean: relative to less than that nothing counts
STRAY = {"ghosts": "flare", "glare": "glare", "starburst": "star-bursts"}  # layers, and their names in a plan
_SAMPLES = 16
_MOST_LIGHTS = 8
_STARS = 2  # lights whose stars are drawn, the brightest in view: a second each
_HIGHLIGHT = 4.0  # times the picture's mean: what shines or mirrors what does
_NEAR_DEG = 2.0  # between a highlight and a light that it is the image of
_WAVES, _CELL_PX, _PHOTONS = 3, 2.0, 1 << 18  # photons of all lights together
_TAIL = 1e-3  # of the light, that its range leaves out at either end


@dataclass(frozen=True)
class Overview:
    """A small picture of a scene.

    Attributes:
        rgb: [H, W, 3] linear sRGB.
        contrast: [H, W] RMS relative difference of neighbours (one to the right and one below), noise taken out.
        range_nm: the range of all but the last of its light by the eye.
        wavelength_nm, share: [W] of that, of sum 1.
    """

    rgb: Array
    contrast: Array
    range_nm: tuple[float, float]
    wavelength_nm: Array
    share: Array

    @property
    def floor(self) -> float:
        """Radiance below which the picture is black."""
        return _floor(self.rgb)


def _floor(rgb: Array) -> float:
    return max(BLACK * float(rgb.mean()), 1e-30)


def overview(scene: Scene, camera: Camera) -> Overview:
    """Look at a scene through a camera."""
    width, height = small_raster(camera.film_mm)
    drawn = partial(render, scene, camera, width=width, height=height, samples=_SAMPLES, threads=1)
    two = [drawn(seed=seed).rgb.astype(np.float64) for seed in (0, 1)]
    rgb = (two[0] + two[1]) / 2
    steps = [_steps(picture.mean(-1)) for picture in two]
    # Noise of two seeds is independent: its product is 0 on the mean.
    square = (steps[0] * steps[1]).mean(0)
    contrast = np.sqrt(np.maximum(square, 0)) / np.maximum(rgb.mean(-1), _floor(rgb))
    return Overview(rgb, contrast, *light_of(scene, camera, rgb.mean((0, 1))))


def small_raster(film_mm: tuple[float, float], across: int = ACROSS) -> tuple[int, int]:
    """Width and height in pixels of a picture with so many along its longer side."""
    width, height = (max(round(across * side / max(film_mm)), 1) for side in film_mm)
    return width, height


def light_of(scene: Scene, camera: Camera, rgb: Array) -> tuple[tuple[float, float], Array, Array]:
    """Range and wavelengths in nm and their shares of a picture's light, as the eye weighs it: see `spectrum_seen`.

    Equal parts of the range that holds all but the last of it are each one wavelength, their centroid: a narrow line
    is one.
    """
    low, high = scene.settings.camera.wavelength_nm
    if not camera.dispersive and getattr(camera, "achromatic", False):
        return (low, high), np.array([(low + high) / 2]), np.ones(1)
    nm, seen = spectrum_seen(scene, rgb)
    reached = np.cumsum(seen) / seen.sum()
    first, last = (int(np.searchsorted(reached, q)) for q in (_TAIL, 1 - _TAIL))
    return (float(nm[first]), float(nm[last])), *parts_of(nm, seen, first, last, len(colours((low, high))[0]))


def spectrum_seen(scene: Scene, rgb: Array) -> tuple[Array, Array]:
    """Wavelengths in nm and their light as the eye weighs it: of the scene's lights, tinted so that its picture has the
    mean colour [3]."""
    low, high = scene.settings.camera.wavelength_nm
    nm, light = expected_light(scene)
    spectral = SpectralRange(low, high, len(nm))
    if spectral.colours and rgb.max() > 0:
        white = spectral.film_rgb(light)
        light = light * spectral.spectrum(np.clip(rgb / np.maximum(white, 1e-3 * white.max()), 0, None))
    eye = np.interp(nm, *colours((low, high))) if low < high else np.ones_like(nm)
    return nm, np.maximum(light * eye, 0)


def parts_of(nm: Array, seen: Array, first: int, last: int, count: int) -> tuple[Array, Array]:
    """Centroids of equal parts of a spectrum from one index to another, and their shares; dark parts left out."""
    edges = np.linspace(nm[first], nm[last], count + 1)
    part = np.clip(np.searchsorted(edges, nm, side="right") - 1, 0, count - 1)
    share = np.bincount(part, seen, count)
    lit = share > 1e-6 * share.sum()
    return np.bincount(part, seen * nm, count)[lit] / share[lit], share[lit] / share[lit].sum()


def stray_light(scene: Scene, camera: Any, seen: Overview) -> dict[str, Array]:
    """Light that the lens adds, relative to the small picture, [H, W] by name of `STRAY`; the most of its colours.

    The lights are those of the scene, in view or not, and highlights of the picture that are not their images. What
    mirrors or shines beyond the picture's edge is not known.

    Raises:
        InputError: no compiler, or a lens whose flare is not known (cylinders).
    """
    lens: Lens = camera.lens
    assert lens.film_z_mm is not None
    if not has_compiler():
        raise InputError(lens.path, "flare", "(no C compiler)", "one, to trace ghosts")
    height, width = seen.rgb.shape[:2]
    sources = SceneLights(scene)
    lights = keep(sources.seen(scene, lens.film_z_mm, 16 * _MOST_LIGHTS), _MOST_LIGHTS).lights
    lights += _highlights(camera, seen, lights)
    none = np.zeros((height, width))
    if not lights:
        return dict.fromkeys(STRAY.values(), none)
    raster, light_nm = Raster(camera.film_mm, width, height), scene.settings.camera.wavelength_nm
    settings = FlareSettings(bins=_WAVES, cell_px=_CELL_PX, glare=_PHOTONS // len(lights))
    layers = flare_layers(FlareJob(lens, lights, raster, settings, light_nm, threads=1))
    half = np.array(camera.film_mm) / 2 / camera.settings["lens_state"]["pinhole_focal_length_mm"]
    stars = [a for a in lights if (np.abs(a.towards[:2]) < -1.1 * half * a.towards[2]).all()][:_STARS]
    only = replace(settings, glare=0, starburst=True, without=("ghosts",))
    layers |= flare_layers(FlareJob(lens, stars, raster, only, light_nm, threads=1)) if stars else {}
    base = np.maximum(seen.rgb.mean(-1), seen.floor)
    return {effect: layers[name].max(-1) / base if name in layers else none for name, effect in STRAY.items()}


def _highlights(camera: Any, seen: Overview, known: list[Light]) -> list[Light]:
    """Bright regions of the picture that are not where a known light is."""
    threshold = _HIGHLIGHT * float(seen.rgb.mean())
    if not threshold > 0 or not (seen.rgb.max(-1) >= threshold).any():
        return []
    focus = float(camera.settings.get("focus_m") or math.inf)
    middle = float((seen.wavelength_nm * seen.share).sum())  # one tells where they are
    field = field_of(camera, focus, "equidistant", spectrum=(np.array([middle]), np.ones(1)))
    found = highlights(seen.rgb.astype(np.float32), field, camera.film_mm, threshold, _MOST_LIGHTS)
    near = math.cos(math.radians(_NEAR_DEG + 45 / ACROSS))
    return [a for a in found.lights if all(float(a.towards @ b.towards) < near for b in known)]


def _steps(picture: Array) -> Array:
    """Differences [2, H, W] to the neighbours on the right and below; the last ones repeat those before."""
    steps = [np.diff(picture, axis=axis) for axis in (1, 0)]
    pads = ((0, 0), (0, 1)), ((0, 1), (0, 0))
    edged = (np.pad(s, pad, "edge") if s.size else np.zeros_like(picture) for s, pad in zip(steps, pads, strict=True))
    return np.stack([*edged])
