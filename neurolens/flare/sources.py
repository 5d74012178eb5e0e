"""Lights of flare from where they are: in a scene, or in a picture of one.

Of a scene: rectangles, discs, spheres, points, spots and the sun, as far as they are seen from the lens's front vertex.
Of a picture: regions brighter than a threshold. The sky and other surroundings are no lights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.field import Array, Field
from neurolens.flare.lights import Light
from neurolens.render.colour import balance
from neurolens.render.job import camera_axes
from neurolens.render.scene import Scene
from neurolens.render.spectrum import SpectralRange
from neurolens.render.world import World

_SIDE = 8  # samples along each side of a light
_PATCHES = 4  # patches along each side of a large one
_SMALL = math.radians(1.0)  # about its middle, seen from the lens: one light
_CELL = 1 / 48  # of the picture's width: larger highlights are several lights
WHOLE = -1
_FADES = 1.25
_MOST_PIXELS, _AT_ONCE = 1 << 22, 1 << 18  # above the threshold; of these together, each of some 500 bytes
_DIMMEST = 0.02  # relative illumination that a highlight's radiance is told from


Name = tuple[int, int]  # of a light of a scene: its number, and which part of it, or `WHOLE`


class SceneLights:
    """The lights of a scene, to be seen from anywhere."""

    def __init__(self, scene: Scene) -> None:
        low, high = scene.settings.camera.wavelengths_nm
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
        """The lights of `named`."""
        return list(self.named(scene, film_z_mm, most).values())

    def named(self, scene: Scene, film_z_mm: float, most: int | None = None) -> dict[Name, Light]:
        """The lights before the lens of a camera of `scene`, whose place may be another.

        Args:
            film_z_mm: of the lens: the front vertex lies so far before the film.
            most: lights to look at, those that are strongest there if nothing hides them; None: all.
        """
        pose = scene.settings.camera
        axes = camera_axes(pose).astype(np.float64)
        front = np.array(pose.position_m) - axes[:, 2] * film_z_mm / 1000
        side = (np.arange(_SIDE) + 0.5) / _SIDE
        square = np.stack([a.ravel() for a in np.meshgrid(side, side)]).astype(np.float32)
        point = np.repeat(front[:, None], square.shape[1], 1).astype(np.float32)
        found: dict[Name, Light] = {}
        lights = self._world.lights
        numbers = range(lights.count) if most is None else lights.strongest(tuple(front.tolist()), most)
        for number, (direction, distance, scale) in zip(numbers, lights.each(numbers, point, square), strict=True):
            rgb = self._rgb[self._colour[number]]
            seen = np.where(self._world.visible(point, direction, distance), scale, 0).astype(np.float64)
            parts = _lights(axes.T @ direction, distance, seen, rgb)
            found |= {(number, part): light for part, light in parts.items()}
        return found


def _lights(towards: Array, distance: FloatArray, scale: Array, rgb: Array) -> dict[int, Light]:
    """A light sampled over its square, as one (`WHOLE`), or where it is large as several, by number.

    Args:
        towards: [3, N] camera frame. scale: [N] irradiance of emission 1.
    """
    if not (scale.any() and rgb.any()):
        return {}
    middle = towards @ scale
    middle /= np.linalg.norm(middle)
    apart = np.linalg.norm(towards[:, scale > 0] - middle[:, None], axis=0).max()
    cells = 1 if apart <= _SMALL else _PATCHES
    number = np.arange(_SIDE) * cells // _SIDE
    cell = (number[:, None] * cells + number).ravel()
    lights = {}
    for k in range(cells * cells):
        share = np.where(cell == k, scale, 0)
        if share.any():
            mean = float(share @ distance / share.sum()) if np.isfinite(distance).all() else math.inf
            lights[k if cells > 1 else WHOLE] = _light(towards @ share, rgb * share.sum() / scale.size, mean)
    return {part: light for part, light in lights.items() if light is not None}


def _light(towards: Array, rgb: Array, distance_m: float = math.inf) -> Light | None:
    """None behind the lens."""
    x, y, z = towards / np.linalg.norm(towards)
    azimuth, elevation = math.degrees(math.atan2(x, -z)), math.degrees(math.asin(max(-1.0, min(1.0, y))))
    if not z < -1e-6:
        return None
    r, g, b = (max(float(v), 0.0) for v in rgb)
    return Light(azimuth, elevation, (r, g, b), distance_m)


class Kept(NamedTuple):
    """Lights, brightest first, of how many, and the share of their energy that is left out."""

    lights: list[Light]
    of: int
    dropped: float


def keep(lights: Sequence[Light], most: int, fade: bool = False) -> Kept:
    """The lights of the most energy at the lens.

    Args:
        fade: whether lights fade as their energy comes down to that of the brightest one left out, from `_FADES` times
            it on: over frames none then comes or goes at once. Where all would be dark, none fades.
    """
    ordered = sorted(lights, key=_energy, reverse=True)
    kept, whole = ordered[:most], sum(map(_energy, ordered))
    cut = _energy(ordered[most]) if fade and len(ordered) > most else 0.0
    if 0 < cut < _energy(ordered[0]):
        kept = [_dimmed(k, min((_energy(k) / cut - 1) / (_FADES - 1), 1.0)) for k in kept if _energy(k) > cut]
    left = 1 - sum(map(_energy, kept)) / max(whole, 1e-300) if len(ordered) > most else 0.0
    return Kept(kept, len(ordered), left)


def keep_named(lights: Mapping[Name, Light], names: frozenset[Name]) -> Kept:
    """The lights of these names; see `chosen`."""
    kept = sorted((light for name, light in lights.items() if name in names), key=_energy, reverse=True)
    whole = sum(map(_energy, lights.values()))
    left = 1 - sum(map(_energy, kept)) / max(whole, 1e-300) if len(kept) < len(lights) else 0.0
    return Kept(kept, len(lights), left)


def chosen(frames: Sequence[Mapping[Name, Light]], most: int) -> frozenset[Name]:
    """Names of the lights that are kept in all frames: so many at most, of the most energy in all frames together.

    So none comes or goes because others do. Parts of a light go with it, as far as there is room.
    """
    energy: dict[int, float] = {}
    parts: dict[int, dict[int, float]] = {}
    for frame in frames:
        for (number, part), light in frame.items():
            energy[number] = energy.get(number, 0.0) + _energy(light)
            of_parts = parts.setdefault(number, {})
            of_parts[part] = of_parts.get(part, 0.0) + _energy(light)
    found, room = set[Name](), most
    for number in sorted(energy, key=lambda number: -energy[number]):
        if room <= 0:
            break
        of_it = sorted(set(parts[number]) - {WHOLE}, key=lambda part: -parts[number][part])[:room]
        found |= {(number, WHOLE), *((number, part) for part in of_it)}
        room -= max(len(of_it), 1)
    return frozenset(found)


def _energy(light: Light) -> float:
    return sum(light.rgb)


def _dimmed(light: Light, share: float) -> Light:
    r, g, b = light.rgb
    return replace(light, rgb=(share * r, share * g, share * b))


def highlights(
    picture: FloatArray, field: Field, film_mm: tuple[float, float], threshold: float, most: int, fade: bool = False
) -> Kept:
    """The regions of a picture [H, W, 3] (linear; 1 is a white card of radiance 1) that reach a threshold in a colour.

    A region of connected pixels is a light far away with the region's radiance times solid angle; a large one is
    several. Radiance is the picture's value over the relative illumination. Pixels count in full from twice the
    threshold on, less the nearer they are to it: a light that a film brings over it does not switch on at once.

    Args:
        field: of the camera that took the picture, laid out as equidistant. most, fade: lights, as of `keep`.

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
        return Kept([], 0, 0.0)
    region = _regions(bright, max(1, round(_CELL * width)))
    count = int(region.max()) + 1
    colour, middle = np.zeros((count, 3)), np.zeros((3, count))
    for start in range(0, row.size, _AT_ONCE):
        r, c, of = (a[start : start + _AT_ONCE] for a in (row, column, region))
        energy, towards = _pixels(picture[r, c], r, c, field, film_mm, (height, width))
        energy *= np.minimum(value[r, c] / threshold - 1, 1)[:, None]
        colour += np.stack([np.bincount(of, e, count) for e in energy.T], 1)
        middle += np.stack([np.bincount(of, energy.sum(1) * t, count) for t in towards])
    each = colour.sum(1)
    seen = np.flatnonzero((each > 0) & (middle[2] < -1e-6 * np.linalg.norm(middle, axis=0)))
    first = seen[np.argsort(-each[seen], kind="stable")][: most + 1]  # one more tells how they fade
    kept = keep([light for k in first if (light := _light(middle[:, k], colour[k]))], most, fade).lights
    left = 1 - sum(map(_energy, kept)) / float(each[seen].sum()) if len(seen) > most else 0.0
    return Kept(kept, len(seen), left)


def _regions(bright: NDArray[np.bool_], cell: int) -> NDArray[np.intp]:
    """Numbers from 0 of connected regions [N], of the bright pixels row by row; one larger than two cells has a number
    for each cell of it. Time and memory grow with the pixels alone, not with the regions."""
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
) -> tuple[Array, Array]:  # fmt: skip
    """Irradiance at the lens [N, 3] and direction [3, N] (lens frame) of pixels, as their corners are seen."""
    x = (np.array([[0], [1], [1], [0]]) + column) * (film_mm[0] / size[1]) - film_mm[0] / 2
    y = film_mm[1] / 2 - (np.array([[0], [0], [1], [1]]) + row) * (film_mm[1] / size[0])
    corner = field.directions((x + 1j * y).reshape(-1)).reshape(3, 4, -1)
    corner[2] *= -1
    across, down = corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1]
    solid = np.linalg.norm(np.cross(across, down, axis=0), axis=0) / 2
    light = field.relative_light(x.mean(0) + 1j * y.mean(0))
    radiance = np.where(light[:, None] > _DIMMEST, np.maximum(colour, 0) / np.maximum(light, _DIMMEST)[:, None], 0)
    return radiance * solid[:, None], corner.sum(1)
