"""Lights of flare that come from a scene, or from a picture of one.

A scene's lights are its rectangles, discs, spheres, points, spots and the sun, as far as the lens's front vertex sees
them; a picture's are regions brighter than a threshold. The sky and other surroundings are no lights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.field import Array, Field
from neurolens.flare.lights import CELLS, Light, Shape, flat_shape, light_towards, sides_across
from neurolens.render.colour import SpectralRange, balance
from neurolens.render.job import camera_axes
from neurolens.render.scene import Scene
from neurolens.render.world import World

_CELL = 1 / 48  # of the picture's width: larger highlights are several lights
_FADES = 1.25  # lights fade from so many times the energy of the brightest light that is left out
_MOST_PIXELS, _AT_ONCE = 1 << 22, 1 << 18  # above the threshold; at a time, each of some 500 bytes
_DIMMEST = 0.02  # relative illumination below which a highlight's radiance is not known


class SceneLights:
    """The lights of a scene, as any camera in it sees them."""

    def __init__(self, scene: Scene) -> None:
        low, high = scene.settings.camera.wavelength_nm
        spectral = SpectralRange(low, high)
        self._world, self._spectral, every = World(scene, spectral), spectral, np.arange(spectral.bins)
        rows, palette = self._world.light_emission_row, self._world.palette
        each, self._colour = np.unique(rows, return_inverse=True)
        self._rgb = [spectral.film_rgb(palette.look_up(np.full_like(every, row), every)[0]) for row in each]

    def balance(self, illuminant: str | None) -> Array:
        """Matrix [3, 3] on linear sRGB that makes an illuminant neutral, as renders of the scene have it."""
        if illuminant is None or not self._spectral.colours:
            return np.eye(3)
        return balance(self._spectral.film_rgb(self._world.palette.illuminant(illuminant)))

    def seen(self, scene: Scene, film_z_mm: float, most: int | None = None) -> list[Light]:
        """The lights before the lens of the camera of `scene`, which may stand anywhere in this scene.

        Args:
            film_z_mm: of the lens: the front vertex lies so far before the film.
            most: how many lights to test, those that are strongest there if nothing hides them; None tests all.
        """
        pose = scene.settings.camera
        axes = camera_axes(pose).astype(np.float64)
        front = np.array(pose.position_m) - axes[:, 2] * film_z_mm / 1000
        middle, corner = ((2 * np.arange(CELLS + k) + 1 - k) / CELLS - 1 for k in (0, 1))
        place = np.concatenate([np.stack(np.meshgrid(a, a, indexing="ij")).reshape(2, -1) for a in (middle, corner)], 1)
        point = np.repeat(front[:, None], place.shape[1], 1).astype(np.float32)
        lights, own, found = self._world.lights, CELLS * CELLS, list[Light]()
        numbers = range(lights.count) if most is None else lights.strongest(tuple(front.tolist()), most)
        for number, (is_round, aimed) in zip(numbers, lights.each(numbers, point, place), strict=True):
            direction, distance, scale = (a[..., :own] for a in aimed)
            inside = (place[:, :own] ** 2).sum(0) < 1 if is_round else np.ones(own, bool)
            seen = np.where(inside & self._world.visible(point[:, :own], direction, distance), scale, 0).astype(float)
            shape = Shape(
                (axes.T @ aimed[0][:, own:]).T.reshape(CELLS + 1, CELLS + 1, 3), seen.reshape(CELLS, CELLS),
                is_round and bool(seen[inside].all()),
            )  # fmt: skip
            rgb = self._rgb[self._colour[number]] * (seen.sum() / inside.sum())
            if rgb.any() and (light := _light(axes.T @ (direction @ seen), rgb, distance, shape)):
                found.append(light)
        return found


def _light(towards: Array, rgb: Array, distance: FloatArray, shape: Shape) -> Light | None:
    """A light of a scene. All corners of a light without size have the same direction."""
    mean = float(np.average(distance, weights=shape.weights.ravel())) if np.isfinite(distance).all() else math.inf
    extended = np.ptp(shape.corners, axis=(0, 1)).any()
    return light_towards(towards, rgb.tolist(), mean, shape if extended else None)


class KeptLights(NamedTuple):
    """The lights that are kept, brightest first; of how many; and the share of the energy that is left out."""

    lights: list[Light]
    of: int
    dropped: float


def keep(lights: Sequence[Light], most: int, fade: bool = False) -> KeptLights:
    """The lights of the most energy at the lens.

    Args:
        fade: whether lights fade as their energy approaches that of the brightest light that is left out, so that none
            comes or goes at once over frames. Where all would be dark, none fades.
    """
    ordered = sorted(lights, key=_energy, reverse=True)
    kept = ordered[:most]
    cut = _energy(ordered[most]) if fade and len(ordered) > most else 0.0
    if 0 < cut < _energy(ordered[0]):
        shares = [min((_energy(k) / cut - 1) / (_FADES - 1), 1.0) for k in kept]
        faded = ((k, s, *k.rgb) for k, s in zip(kept, shares, strict=True) if s > 0)
        kept = [replace(k, rgb=(s * r, s * g, s * b)) for k, s, r, g, b in faded]
    whole = sum(map(_energy, ordered))
    left = 1 - sum(map(_energy, kept)) / max(whole, 1e-300) if len(kept) < len(ordered) else 0.0
    return KeptLights(kept, len(ordered), left)


def _energy(light: Light) -> float:
    return sum(light.rgb)


def highlights(
    picture: FloatArray, field: Field, film_mm: tuple[float, float], threshold: float, most: int, fade: bool = False
) -> KeptLights:
    """The regions of a picture [H, W, 3] (linear; 1 is a white card of radiance 1) that reach a threshold in a colour.

    A region of connected pixels is a light far away with the region's radiance times solid angle; a large region is
    several lights. Radiance is the picture's value over the relative illumination. Pixels count in full from twice the
    threshold on, and less the nearer they are to it, so that over frames no light switches on at once.

    Args:
        field: of the camera that took the picture, laid out as equidistant. most, fade: as for `keep`.

    Raises:
        InputError: values that are not finite; more than `_MOST_PIXELS` pixels that reach the threshold.
    """
    if bad := int((~np.isfinite(picture)).any(-1).sum()):
        raise InputError("picture", "pixels", f"({bad} with NaN or infinity)", "finite values")
    height, width = picture.shape[:2]
    value = picture.max(-1)
    bright = value >= threshold
    if np.count_nonzero(bright) > _MOST_PIXELS:
        found = f"{threshold:g} ({np.count_nonzero(bright)} pixels)"
        raise InputError("picture", "threshold", found, f"one that at most {_MOST_PIXELS} pixels reach")
    row, column = np.nonzero(bright)
    if not row.size:
        return KeptLights([], 0, 0.0)
    region = _regions(bright, max(1, round(_CELL * width)))
    count = int(region.max()) + 1
    colour, moments = np.zeros((count, 3)), np.zeros((13, count))
    for start in range(0, row.size, _AT_ONCE):
        r, c, of = (a[start : start + _AT_ONCE] for a in (row, column, region))
        energy, towards, solid = _pixels(picture[r, c], r, c, field, film_mm, (height, width))
        energy *= np.minimum(value[r, c] / threshold - 1, 1)[:, None]
        colour += np.stack([np.bincount(of, e, count) for e in energy.T], 1)
        squares = (towards[:, None] * towards).reshape(9, -1)
        moments += np.stack([np.bincount(of, energy.sum(1) * t, count) for t in (*towards, *squares, solid)])
    middle = moments[:3]
    each = colour.sum(1)
    seen = np.flatnonzero((each > 0) & (middle[2] < -1e-6 * np.linalg.norm(middle, axis=0)))
    first = seen[np.argsort(-each[seen], kind="stable")][: most + 1]  # one more tells how they fade
    shapes = [_spread_of(moments[:, k] / each[k]) for k in first]
    lights = [light_towards(middle[:, k], colour[k], shape=shape) for k, shape in zip(first, shapes, strict=True)]
    kept = keep([light for light in lights if light], most, fade).lights
    left = 1 - sum(map(_energy, kept)) / float(each[seen].sum()) if len(seen) > most else 0.0
    return KeptLights(kept, len(seen), left)


def _spread_of(means: Array) -> Shape:
    """The parallelogram with the variances of a region, from means [13] of directions, their products, solid angles."""
    towards = means[:3] / np.linalg.norm(means[:3])
    across = sides_across(towards)
    variance = across @ (means[3:12].reshape(3, 3) - np.outer(means[:3], means[:3])) @ across.T
    pixel = means[12] / 12 * np.eye(2)  # its own variance, with that of its middles
    half = np.linalg.cholesky(variance + pixel)
    return flat_shape(towards, math.sqrt(12) * half.T @ across)


def _regions(bright: NDArray[np.bool_], cell: int) -> NDArray[np.intp]:
    """The number of the connected region of each bright pixel, [N] row by row; a region larger than two cells has a
    number for each of its cells. Time and memory grow with the pixels alone, not with the regions."""
    label, _ = ndimage.label(bright, np.ones((3, 3)))
    number = label[bright] - 1
    boxes = np.array([[(s.start, s.stop) for s in box] for box in ndimage.find_objects(label)]).reshape(-1, 2, 2)
    large = np.ptp(boxes, axis=2).max(1) > 2 * cell
    # The cell of each pixel, counted from its region's corner; a row has fewer cells than the picture has columns.
    row, column = (place - boxes[number, axis, 0] for axis, place in enumerate(np.nonzero(bright)))
    part = np.where(large[number], row // cell * label.shape[1] + column // cell, 0)
    _, numbers = np.unique(number * np.int64(bright.size) + part, return_inverse=True)
    return np.asarray(numbers.reshape(-1), np.intp)


def _pixels(
    colour: FloatArray, row: NDArray[np.intp], column: NDArray[np.intp], field: Field, film_mm: tuple[float, float],
    size: tuple[int, int],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Irradiance at the lens [N, 3], unit direction [3, N] (lens frame) and solid angle [N] of pixels, by the
    directions of their corners."""
    x = (np.array([[0], [1], [1], [0]]) + column) * (film_mm[0] / size[1]) - film_mm[0] / 2
    y = film_mm[1] / 2 - (np.array([[0], [0], [1], [1]]) + row) * (film_mm[1] / size[0])
    corner = field.directions((x + 1j * y).reshape(-1)).reshape(3, 4, -1)
    corner[2] *= -1
    across, down = corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1]
    solid = np.linalg.norm(np.cross(across, down, axis=0), axis=0) / 2
    light = field.relative_light(x.mean(0) + 1j * y.mean(0))
    radiance = np.where(light[:, None] > _DIMMEST, np.maximum(colour, 0) / np.maximum(light, _DIMMEST)[:, None], 0)
    towards = corner.sum(1)
    return radiance * solid[:, None], towards / np.linalg.norm(towards, axis=0), solid
