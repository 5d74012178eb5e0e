"""The distance in pixels of a camera's picture of a scene from that of the exact lens, in two ways that no plan takes.

`by_rays`: footprints as a plan has them, at other places (closer, at random in their cells), other pupil samples, other
wavelengths, of the camera that `--camera` names. `moved`: pieces of the picture, rendered by both cameras with the
same random numbers, at the picture's own pixels. What differs in a piece is fitted, in each colour, by what a shift, a
change of blur and a change of light would make of it, to second order in the size of them:

    other - exact = -shift . grad exact + 1/2 (change of variance) : hessian exact + gain exact.

All are filtered by one Gaussian before, so that derivatives are of what is sampled. Noise would bend a fit towards 0:
derivatives and differences that are multiplied come from renders of different seeds (an instrument's variables, Lucas
and Kanade's rule otherwise), and each part counts as far as it is above three times its standard error, from leaving
a seed out. A change of variance becomes a way that light moves by the blur that the exact lens and the pixel have
there: a picture shows no finer one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter  # type: ignore[import-untyped]

from neurolens.cameras.contract import Camera, CameraRays, FloatArray
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import FilmSettings
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.footprints import Footprints, Places
from neurolens.studies.plan.probe import COUNTED, light_of
from neurolens.studies.scenes import seen_depths_m

Array = NDArray[np.float64]
_PUPILS = 18, 64, 160  # squared: pupil samples of a fresh footprint, and where those leave its error unsure
_RIM = 0.002, 0.1  # errors that samples of another outline may make: of a blur's diameter; times rows of samples
_WAVES = 5  # of the light
_CHUNK = 2_000_000  # rays at once
_SMOOTH_PX = 1.2  # of pictures before derivatives
_EDGE = 4  # pixels at a piece's rim that the filter spoils
_COLOURS = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear sRGB: what each colour counts
_DEPTH = 2  # of paths: light that comes directly has all edges
_PART = 3.0  # standard errors, of four seeds, above which a part of a difference is one
_PIXEL = 1 / 6  # squared RMS distance of a pixel's points from its centre, px^2: a picture shows no finer blur


# ---- By rays. --------------------------------------------------------------------------------------------------------


def fresh_places(scene: Scene, exact: Camera, rgb: Array, across: int = 22, seed: int = 5) -> Places:
    """Places at random in the cells of a grid, `across` along the width, at the centroids of fifths of the range of the
    light, whose picture has this mean colour."""
    shot = scene.settings.camera
    film = np.array(shot.film_mm)[:, None]
    cells = across, max(round(across * shot.film_mm[1] / shot.film_mm[0]), 1)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in cells))).reshape(2, -1)
    points = ((index + np.random.default_rng(seed).random(index.shape)) / np.array(cells)[:, None] - 0.5) * film
    depth = seen_depths_m(scene, exact, points)
    _, nanometres, share = light_of(scene, rgb, _WAVES if exact.dispersive else 1)
    return prints.places_of(exact, points, np.where(np.isnan(depth), np.inf, depth), nanometres, share)


def by_rays(
    camera: Camera, exact: Camera, places: Places, seen: Footprints, pixel_mm: float, budgets_px: Sequence[float]
) -> tuple[Array, Array]:
    """Errors [N] of fresh places, in pixels, and of light; inf where one has light that the other lacks.

    Rows of pupil samples leave out the rim of the square that fills a pupil's outline, and with it what does not pass.
    So two outlines of one lens seem to differ by 0.1% of their footprint and more, 0.15 px beside blurs of 140; with
    400 rows, which meet the rim, by 0.01 px. Where only errors that this could make break the largest budget that is
    missed, they are measured again with more rows.

    Args:
        seen: `fresh_prints` of the exact camera.
    """
    own = prints.footprints(camera, places, _PUPILS[0])
    apart = _apart_px(own, seen, places, pixel_mm)
    light = np.abs(own.light / np.maximum(seen.light, 1e-30) - 1)
    blur = prints.blur_mm(seen, places.share) / pixel_mm
    for before, samples in pairwise(_PUPILS):
        missed = [b for b in budgets_px if b < np.percentile(apart, COUNTED)]
        unsure = (apart > max(missed, default=math.inf)) & (apart < min(_RIM[0], _RIM[1] / before) * blur)
        if not missed or np.mean((apart > max(missed)) & ~unsure) > 1 - COUNTED / 100:
            break
        step = max(_CHUNK // (samples**2 * len(places.wavelength_nm)), 1)
        for part in np.split(index := np.flatnonzero(unsure), range(step, len(index), step)):
            there = places.at(part)
            finer = [prints.footprints(c, there, samples) for c in (camera, exact)]
            apart[part] = _apart_px(finer[0], finer[1], there, pixel_mm)
    return apart, light


def _apart_px(own: Footprints, seen: Footprints, places: Places, pixel_mm: float) -> Array:
    apart = prints.distance_mm(seen, own, places.share) / pixel_mm
    return np.where(np.isfinite(apart), apart, np.inf)


def fresh_prints(camera: Camera, places: Places) -> Footprints:
    """Footprints at fresh places, with the pupil samples that `by_rays` begins with."""
    return prints.footprints(camera, places, _PUPILS[0])


# ---- By renders. -----------------------------------------------------------------------------------------------------


class Pieces:
    """A camera whose film is some square pieces of another's, side by side.

    Args:
        camera: the other. centre_mm: [2, K] of the pieces. side_mm: of each.
    """

    def __init__(self, camera: Any, centre_mm: Array, side_mm: float) -> None:
        self._camera, self._centre, self._side = camera, centre_mm.astype(np.float32), np.float32(side_mm)
        self.name, self.dispersive, self.settings = camera.name, camera.dispersive, camera.settings
        self.wavelength_nm, self.achromatic = camera.wavelength_nm, getattr(camera, "achromatic", False)
        self.film_mm = (float(side_mm) * centre_mm.shape[1], float(side_mm))

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """The rays of points on the pieces, as `Camera.sample`."""
        count = self._centre.shape[1]
        place = film_mm[0] / self._side + np.float32(count / 2)
        piece = np.clip(np.floor(place).astype(np.intp), 0, count - 1)
        own = np.stack([(place - piece - np.float32(0.5)) * self._side, film_mm[1]])
        return self._camera.sample(np.ascontiguousarray(self._centre[:, piece] + own), pupil, wavelength_nm)


def pieces_of(scene: Scene, exact: Camera, side_px: int, cells: tuple[int, int] = (5, 3)) -> Array:
    """Centres [2, K] mm of a piece in each cell of the picture, where a coarse render of it has most contrast."""
    film = np.array(exact.film_mm)
    width = 48 * cells[0]
    height = round(width * film[1] / film[0])
    settings: dict[str, Any] = {"width": width, "height": height, "samples": 8, "threads": 1, "max_depth": _DEPTH}
    image = render(scene, exact, **settings, film=FilmSettings(wavelengths="one")).rgb
    grey = np.log1p(np.maximum(image @ _COLOURS, 0.0) * 4)
    side = max(round(side_px * width / scene.settings.camera.width), 2)
    smooth = gaussian_filter(grey, 1.0, mode="nearest", truncate=3)
    rough = uniform_filter(np.hypot(*np.gradient(smooth)), side, mode="constant")
    columns, rows = (np.linspace(0, n, k + 1).astype(int) for n, k in zip((width, height), cells, strict=True))
    centres = []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            part = rough[top:bottom, left:right]
            row, column = np.unravel_index(int(np.argmax(part)), part.shape)
            x = np.clip(left + column + 0.5, side / 2, width - side / 2) / width
            y = np.clip(top + row + 0.5, side / 2, height - side / 2) / height
            centres.append(((0.5 - x) * film[0], (y - 0.5) * film[1]))  # film points lie turned by 180 degrees
    return np.array(centres).T


def rendered(
    scene: Scene, camera: Camera, centre_mm: Array, side_px: int, samples: int, seeds: int
) -> NDArray[np.float64]:
    """Renders [seeds, K, side, side, 3] of pieces of the picture."""
    shot = scene.settings.camera
    pieces = Pieces(camera, centre_mm, side_px * shot.film_mm[0] / shot.width)
    count = centre_mm.shape[1]
    pictures = []
    for seed in range(seeds):
        done = render(
            scene, pieces, width=side_px * count, height=side_px, samples=samples, seed=seed, threads=1,
            max_depth=_DEPTH, film=FilmSettings(wavelengths="one"),
        )  # fmt: skip
        # The picture is the film turned: its first piece is the last of the film's row.
        parts = done.rgb.astype(np.float64).reshape(side_px, count, side_px, 3).transpose(1, 0, 2, 3)
        pictures.append(parts[::-1])
    return np.array(pictures)


@dataclass(frozen=True)
class Moved:
    """The change that a camera makes to a piece of a picture.

    `px`: pixels that light moves by, as far as they are above the noise; `noise_px`: standard error of the shift, inf
    where the piece has too little contrast to tell; `gain`: relative, of light.
    """

    px: float
    noise_px: float
    gain: float


def moved(exact: Array, other: Array, blur_px: float) -> Moved:
    """The change between renders [seeds, H, W, 3] of a piece by two cameras with the same seeds; see the module.

    Args:
        blur_px: RMS distance of the exact camera's footprint there from its centroid.
    """
    total = noise = gain = 0.0
    for colour, share in enumerate(_COLOURS / _COLOURS.sum()):
        found, error = _fit(exact[..., colour], other[..., colour])
        sure = np.sign(found) * np.maximum(np.abs(found) - _PART * error, 0.0)
        # A shift's own second order looks like a variance.
        wider = found[2] - found[0] ** 2 - found[1] ** 2
        wider = np.sign(wider) * max(abs(wider) - _PART * error[2], 0.0)
        before = blur_px**2 + _PIXEL
        spread = np.sqrt(max(before + wider, 0.0)) - np.sqrt(before)
        total += share * (sure[0] ** 2 + sure[1] ** 2 + spread**2)
        noise += share * (error[0] ** 2 + error[1] ** 2)
        gain += share * found[3]
    return Moved(float(np.sqrt(total)), float(np.sqrt(noise)), float(gain))


def _fit(exact: Array, other: Array) -> tuple[Array, Array]:
    """Shift along x and y in pixels, change of the squared RMS distance from the centroid, gain; their errors [4]."""
    seeds = exact.shape[0]
    columns, wanted = [], []
    for a, b in zip(exact, other, strict=True):
        flat, apart = (gaussian_filter(c, _SMOOTH_PX, mode="nearest", truncate=3) for c in (a, b - a))
        down, right = (np.gradient(flat, axis=k) for k in (0, 1))
        bend = np.asarray(np.gradient(down, axis=0) + np.gradient(right, axis=1))
        inner = (slice(_EDGE, -_EDGE),) * 2
        # The variance along each axis is half of the squared distance: 1/2 * 1/2.
        columns.append(np.stack([-right[inner], -down[inner], bend[inner] / 4, flat[inner]]).reshape(4, -1))
        wanted.append(apart[inner].reshape(-1))
    x, d = np.array(columns), np.array(wanted)
    matrix = np.einsum("san,tbn->stab", x, x)
    vector = np.einsum("san,tn->sta", x, d)

    def solve(use: NDArray[np.intp]) -> Array:
        pairs = ~np.eye(len(use), dtype=bool)
        left, right = matrix[np.ix_(use, use)][pairs].mean(0), vector[np.ix_(use, use)][pairs].mean(0)
        size = np.sqrt(np.maximum(np.diag(left), 1e-30))
        scaled = (left + left.T) / 2 / np.outer(size, size)
        if np.linalg.eigvalsh(scaled)[0] < 1e-3:
            return np.full(4, np.inf)
        return np.asarray(np.linalg.solve(scaled, right / size) / size)

    every = np.arange(seeds)
    found = solve(every)
    without = np.array([solve(np.delete(every, s)) for s in every])
    if not np.isfinite(without).all():
        return np.zeros(4), np.full(4, np.inf)
    error = np.sqrt((seeds - 1) * ((without - without.mean(0)) ** 2).mean(0))
    return found, error
