"""The picture that a camera takes of a plate: its rays, followed to what the plate shows.

The picture gets the camera's blur, distortion, vignetting and colour fringes. The camera traces rays only at
nodes, a sixtieth of the film apart, through one set of pupil points; the rays of a pixel lie between those of
the four nodes around it. Each channel has its own wavelengths, those that make its light from white surfaces, so that
colours blur apart but have no noise of their own. What a ray meets is found in the plate's depth (`gather.c`). A pixel
takes the more samples, the wider the lens blurs there, and weighs them so that even light stays even: the mean of
radiance by weight, times the mean weight of the whole pupil.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.tasks import in_order
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.defocus.plate import FINEST, FloatArray, Plate
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.render.colour import SpectralRange
from neurolens.render.sampler import sobol

_NUMBERS = 5  # of a line: ax, ay, bx, by, weight
_NODES, _PITCH = 64, 8  # cells along the longer side of the film, and their least size in pixels
_SET = 512  # points of the pupil
_FEW = 128  # of them, to measure blur
_LEAST, _A_PIXEL = 8, 1  # samples of a pixel, and more for each pixel of the blur's radius: FLIP hardly gains by others
_MIDDLE_NM = 550.0
_CLEAR = 0.01  # of its inverse depth, by which what hides a point is nearer
LIGHT_NM = (400.0, 700.0)


@dataclass(frozen=True)
class Gathered:
    """The picture [H, W, 3] that a camera takes of a plate, and the shares of its light that the plate did not have:
    `filled`, behind the edges of things, and `beyond`, outside of the plate; `highlights` were spread as discs."""

    rgb: FloatArray
    filled: float
    beyond: float
    highlights: int = 0


class _Table(ctypes.Structure):
    _fields_ = [  # noqa: RUF012
        *((name, ctypes.c_int) for name in ("across", "down", "samples", "channels", "stride")),
        *((name, ctypes.c_float) for name in ("pitch_x", "pitch_y")),
        *((name, ctypes.c_void_p) for name in ("rays", "jitter")),
        ("above", ctypes.c_float),
    ]


@cache
def compiled() -> ctypes.CDLL:
    defined = {"NUMBERS": _NUMBERS, "WEIGHT": _NUMBERS - 1, "FINEST": FINEST.bit_length() - 1, "CLEAR": f"{_CLEAR}f"}
    library = load_compiled(c_source("defocus/gather.c", **defined))
    whole, pointer = ctypes.c_int, ctypes.c_void_p
    library.splat.argtypes = [pointer, whole, pointer, whole, pointer, *[whole] * 2, pointer, *[whole] * 2, pointer]
    library.splat.restype = None
    library.gather.argtypes = [pointer, whole, _Table, whole, whole, whole, pointer, pointer]
    library.gather.restype = None
    return library


def channel_wavelengths(sample: FloatArray, low_nm: float, high_nm: float) -> FloatArray:
    """Wavelengths [3, N] of red, green and blue for uniform samples [N], by their share in the film's light."""
    light = SpectralRange(low_nm, high_nm)
    found = []
    for part in np.maximum(light.response * light.basis, 0):
        reached = np.concatenate([[0.0], np.cumsum(part, dtype=np.float64)])
        found.append(np.interp(sample, reached / reached[-1], light.edges_nm))
    return np.array(found, np.float32)


def turned(square: NDArray[Any], angle_rad: NDArray[Any]) -> FloatArray:
    """Points [2, N] of the unit square whose places on the disk are turned by angles [N] (`concentric_disk`)."""
    a, b = 2.0 * square[0] - 1.0, 2.0 * square[1] - 1.0
    size = np.maximum(np.abs(a), np.abs(b))
    along = 2.0 - np.divide(a, size, out=np.zeros_like(a), where=size > 0) * (
        2.0 - np.divide(np.abs(b), size, out=np.zeros_like(a), where=size > 0)
    )
    # Along the sides of the square, from 0 at +x over 2 at +y to 8.
    along = (np.where(b < 0, 8.0 - along, along) + angle_rad * (4.0 / math.pi)) % 8.0
    x, y = (np.clip(np.abs((along - by) % 8.0 - 4.0) - 2.0, -1.0, 1.0) for by in (0.0, 2.0))
    return np.stack([0.5 + 0.5 * size * x, 0.5 + 0.5 * size * y]).astype(np.float32)


def turns_pupil(camera: Camera) -> bool:
    """Whether a camera's pupil samples turn about the axis with the film point, as those of round lenses do."""
    reach = 0.01 * min(camera.film_mm)
    film = np.repeat(np.array([[reach, 0.0], [0.0, reach]], np.float32), 2, axis=1)
    pupil = np.tile(np.array([[0.9, 0.5], [0.5, 0.9]], np.float32), 2)
    low, high = camera.wavelength_nm or LIGHT_NM
    x, y, _ = camera.sample(film, pupil, np.full(4, min(max(_MIDDLE_NM, low), high), np.float32)).origin_m
    first, second = (x + 1j * y)[::2] - (x + 1j * y)[1::2]
    return bool(abs(second - 1j * first) < abs(second - first))


class RayTable:
    """Rays of a camera at nodes of its film, as lines in a plate, for one set of points of the pupil.

    A point of the pupil is the same place in the lens for all film points.
    """

    def __init__(self, camera: Camera, plate: Plate, pupil: FloatArray, hue: FloatArray) -> None:
        self.camera, self.pinhole, self.size, self.pupil = camera, plate.pinhole, plate.size, pupil
        pitch = max(_PITCH, max(plate.size) / _NODES)
        self.cells = tuple(max(1, math.ceil(n / pitch)) for n in plate.size)
        self.turns = turns_pupil(camera)
        low, high = camera.wavelength_nm or LIGHT_NM
        if camera.dispersive and high > low:
            self.nm = channel_wavelengths(hue, max(low, LIGHT_NM[0]), min(high, LIGHT_NM[1]))[[1, 0, 2]]
        else:
            self.nm = np.full((1, pupil.shape[1]), min(max(_MIDDLE_NM, low), high), np.float32)

    def row(self, j: int) -> FloatArray:
        """Rays [nodes across, samples, 16 or 8] of the nodes of a row: lines and weights of green, red and blue.

        Where green does not pass, the others have no weight either; where it does, they have lines, too.
        """
        (across, down), (width, height) = self.cells, self.camera.film_mm
        channels, samples = self.nm.shape
        x = (0.5 - np.arange(across + 1) / across) * width
        film = np.empty((2, across + 1, samples, channels), np.float32)
        film[0], film[1] = x[:, None, None], (j / down - 0.5) * height
        shape = film.shape[1:]
        pupil = np.broadcast_to(self.pupil[:, None, :, None], (2, *shape)).reshape(2, -1)
        nm = np.broadcast_to(self.nm.T[None], shape).reshape(-1)
        lines = self._lines(film.reshape(2, -1), pupil, nm).reshape(*shape, _NUMBERS)
        for k in range(1, channels):
            lines[..., k, :4] = np.where(lines[..., k, 4:] > 0, lines[..., k, :4], lines[..., 0, :4])
            lines[..., k, 4] *= lines[..., 0, 4] > 0
        found = np.zeros((*shape[:2], 16 if channels > 1 else 8), np.float32)
        found[..., : channels * _NUMBERS] = lines.reshape(*shape[:2], -1)
        return found

    def at(self, place_px: NDArray[Any], pupil: FloatArray, nm: FloatArray) -> FloatArray:
        """Lines and weights [N, 5] of the rays of film places [2, N] by points of the pupil [2, N]."""
        return self._lines(self.film_mm(place_px), pupil, nm)

    def film_mm(self, place_px: NDArray[Any]) -> FloatArray:
        """Film points [2, N] of film places [2, N], which a picture shows upright."""
        return ((place_px.T / self.size - 0.5) * self.camera.film_mm * (-1, 1)).T.astype(np.float32)

    def unturned(self, film_mm: FloatArray, pupil: FloatArray) -> FloatArray:
        """The samples that the camera takes for points of the pupil [2, N], seen from film points [2, N]."""
        return turned(pupil, -np.arctan2(film_mm[1], film_mm[0])) if self.turns else pupil

    def _lines(self, film: FloatArray, pupil: FloatArray, nm: FloatArray) -> FloatArray:
        found = np.empty((len(nm), _NUMBERS), np.float32)
        pupil = self.unturned(film, pupil)
        step = getattr(self.camera, "rays_a_call", RAYS_A_CALL)
        for first in range(0, len(nm), step):
            part = slice(first, first + step)
            rays = self.camera.sample(*(np.ascontiguousarray(v[..., part]) for v in (film, pupil, nm)))
            passed = (rays.status == 0) & (rays.direction[2] < 0)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                lines = self.pinhole.lines(rays.origin_m, rays.direction)
            passed &= np.isfinite(lines).all(axis=0)
            found[part, :4] = np.where(passed, lines, 0).T
            found[part, 4] = np.where(passed, rays.weight, 0)
        return found


def _points(count: int, numbers: int) -> FloatArray:
    """Points [numbers, count] of the unit cube, evenly."""
    return ((sobol(count, numbers) + 2.0**31 / count) / 2.0**32).astype(np.float32)


def spread_over(camera: Camera, plate: Plate) -> NDArray[np.float64]:
    """The variance of the places at which rays of each node [rows, columns, 3] see a point: of a, 2 covariances, of b;
    summed over x and y, so that its root is the radius of an even disc over sqrt(2)."""
    points, found = _points(_FEW, 3), []
    table = RayTable(camera, plate, points[:2], points[2])
    for j in range(table.cells[1] + 1):
        rays = table.row(j)[..., :_NUMBERS].astype(np.float64)
        weight = rays[..., 4:] / np.maximum(rays[..., 4:].sum(axis=1, keepdims=True), 1e-30)
        a, b = (part - (weight * part).sum(axis=1, keepdims=True) for part in (rays[..., :2], rays[..., 2:4]))
        found.append(np.stack([(weight * term).sum(axis=(1, 2)) for term in (a * a, 2 * a * b, b * b)], axis=1))
    return np.stack(found)


def radius_px(spread: NDArray[np.float64], w: NDArray[Any]) -> NDArray[np.float64]:
    """Radii in pixels of the discs of things of inverse depth w."""
    a, ab, b = np.moveaxis(spread, -1, 0)
    return np.sqrt(np.maximum(2 * (a + (ab + b * w) * w), 0))


def _sizes(plate: Plate, spread: NDArray[np.float64], samples: int) -> NDArray[np.uint8]:
    """Binary logarithms [H, W] of the numbers of samples, by the widest disc that reaches a pixel."""
    width, height = plate.size
    places = [np.minimum(np.arange(0, n, FINEST) + FINEST / 2, n - 1) for n in (height, width)]
    nodes = [
        np.minimum((p / n * (k - 1)).round().astype(int), k - 1)
        for p, n, k in zip(places, (height, width), spread.shape[:2], strict=True)
    ]
    here = spread[np.ix_(*nodes)]
    widest = np.zeros(here.shape[:2])
    for layer in plate.layers:
        low, high = np.zeros(widest.shape), np.full(widest.shape, max(layer.nearest, 0.0))
        for _ in range(2):
            reach = np.maximum(radius_px(here, low), radius_px(here, high))
            level = np.clip(np.ceil(np.log2(np.maximum(reach, 1) / FINEST)), 0, len(layer.bounds) - 1).astype(int)
            for k in np.unique(level):
                bounds = layer.bounds[k]
                cell = FINEST << int(k)
                rows, columns = (
                    np.clip(((p + border) / cell).astype(int), 0, n - 1)
                    for p, border, n in zip(places, plate.border_px[::-1], bounds.shape, strict=False)
                )
                least, most = _around(bounds[..., 0], np.minimum), _around(bounds[..., 1], np.maximum)
                inside = level == k
                low = np.where(inside, np.maximum(least[np.ix_(rows, columns)], 0), low)
                high = np.where(inside, np.maximum(most[np.ix_(rows, columns)], 0), high)
        widest = np.maximum(widest, np.maximum(radius_px(here, low), radius_px(here, high)))
    wanted = np.ceil(np.log2(np.clip(_LEAST / 2 + _A_PIXEL * widest, _LEAST, samples))).astype(np.uint8)
    return np.ascontiguousarray(wanted.repeat(FINEST, 0).repeat(FINEST, 1)[:height, :width])


def _around(values: FloatArray, by: np.ufunc) -> FloatArray:
    """The least or largest value of each cell and its eight neighbours."""
    padded = np.pad(values, 1, mode="edge")
    rows = by(by(padded[:-2], padded[1:-1]), padded[2:])
    return by(by(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def gather(
    plate: Plate, camera: Camera, spread: NDArray[np.float64], samples: int = 64, threads: int = 1,
    report: Callable[[float], None] = lambda _: None,
) -> Gathered:  # fmt: skip
    """The picture that a camera takes of a plate by at most `samples` a pixel; `spread`: `spread_over` of both."""
    width, height = plate.size
    points = _points(_SET, 5)
    jitter = np.ascontiguousarray(points[2:4].T)
    table = RayTable(camera, plate, points[:2], points[4])
    (across, down), structs, sizes = table.cells, plate.structs(), _sizes(plate, spread, samples)
    rgb = np.empty((height, width, 3), np.float32)
    lost = np.zeros(3)
    edges = [round(j * height / down) for j in range(down + 1)]

    def tasks() -> Iterator[tuple[int, FloatArray]]:
        before = table.row(0)
        for j in range(down):
            after = table.row(j + 1)
            yield j, np.stack([before, after])
            before = after

    def band(task: tuple[int, FloatArray]) -> NDArray[np.float64]:
        j, rays = task
        first, stop = edges[j], edges[j + 1]
        sums = np.empty((stop - first, width, 8), np.float32)
        struct = _Table(
            across + 1, 2, _SET, len(table.nm), rays.shape[3], width / across, height / down,
            rays.ctypes.data, jitter.ctypes.data, first - j * height / down,
        )  # fmt: skip
        part = sizes[first:stop]
        compiled().gather(structs, len(structs), struct, width, first, stop - first, part.ctypes.data, sums.ctypes.data)
        weights = rays[..., _NUMBERS - 1 : len(table.nm) * _NUMBERS : _NUMBERS].mean(axis=2, dtype=np.float64)
        weights = weights[..., [1, 0, 2]] if len(table.nm) > 1 else weights
        x, share = (np.arange(width) + 0.5) / width * across, (np.arange(first, stop) + 0.5) / height * down - j
        above, below = (np.stack([np.interp(x, np.arange(across + 1), c) for c in row.T], 1) for row in weights)
        light = above + (below - above) * share[:, None, None]
        weight = sums[..., 3:6]
        rgb[first:stop] = light * np.divide(sums[..., :3], weight, out=np.zeros_like(weight), where=weight > 0)
        return sums[..., [4, 6, 7]].sum(axis=(0, 1), dtype=np.float64)

    for j, part in enumerate(in_order(threads, band, tasks()), 1):
        lost += part
        report(j / down)
    filled, beyond = lost[1:] / max(lost[0], 1e-30)
    return Gathered(rgb, float(filled), float(beyond))
