"""Draws light on the film: grids of rays as the areas of their cells, and extended lights as smears by kernels.

A picture of areas has neither holes nor noise, and its sum is the light of the grid, however the map to the film
stretches, folds or turns (Hullin et al. 2011, section 4.2, spread light over quads in this way). Rims cut cells where
the largest r / R on the way is 1, by linear interpolation between rays. Pixels are covered exactly (`area.c`): an edge
adds its height, times the step of density across it, to the pixels that it crosses, and sums along rows make the
picture. Within whole cells the density is linear between the corners, where it is the mean of the cells that meet
there. So no borders show where the density changes little from cell to cell. Each cell keeps its light, except for one
part in 10,000 at its border pixels.

Light adds up: the picture of an extended light is the integral over its points (Goodman, Introduction to Fourier
Optics, section 6.1). Over a small patch a ghost, or a star, keeps its shape and moves with the point, so that the
integral is a convolution with the patch, as large as the picture moves. Each ghost moves by another factor.
"""

import ctypes
import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.graph.compiler import c_source, load_compiled

Array = NDArray[np.float64]
CELLS = 8  # along each side of an extended light
FADE = 8  # parts of a cell's side where patches of a light fade into each other
LOST = 1e30  # `worst` of a ray that misses a surface, or is totally reflected where it should go on
_PER_CELL = 8  # the most edges of two triangles that rims cut
_LEAST = 0.5  # pixels: a light whose picture moves by less is a point
_STEP, _STEPS = 0.125, 256  # movements are rounded to this many pixels, or to such a part of themselves
_CORNERS = 64  # corners that stand for an ellipse
_THIN = 0.25  # least width of a patch in pixels
_FINE = 12.0  # the fewest pixels that draw the width of a smear
_FADING = 0.15  # the largest step of light, over the most light, within a patch that fades over 16 parts or more is 0.1


def edges_of(rays: FloatArray, columns: int, size: tuple[int, int], per_mm: float) -> Array:
    """Return the light of a grid of rays of one wavelength as edges for `draw_edges`; none if it misses the film.

    Args:
        rays: [4, N] film x, y (mm), power and worst, row after row, with one ray more than `columns` in each.
        size: width and height of the film in pixels. per_mm: pixels per mm.

    Raises:
        InputError: there is no C compiler, or it fails.
    """
    rows = rays.shape[1] // (columns + 1) - 1
    assert rays.dtype == np.float32 and rays.flags.c_contiguous and rays.shape == (4, (rows + 1) * (columns + 1))
    edges, room = np.empty((_PER_CELL * rays.shape[1], 7)), np.zeros((15, rays.shape[1]))
    pointers = [a.ctypes.data for a in (rays, room, edges)]
    return edges[: _compiled().edges(columns, rows, *size, per_mm, *pointers)].copy()


def draw_edges(picture: FloatArray, rows: range, edges: Array, counts: NDArray[np.int64], light: Array) -> None:
    """Add light to some rows of a picture [H, W, 3], centred and upright (the film turned by 180 degrees).

    A row comes out the same whether it is drawn by itself or with others.

    Args:
        edges: [N, 7] of several grids: x and y of both ends in pixels, then the step of density across the edge (at the
            corner of the picture, and its slopes in x and y). An edge whose ends are equal is light at a point.
        counts: [K] how many edges each grid has. light: [K, 3] colour of a cell whose power is 1.

    Raises:
        InputError: as `edges_of`.
    """
    height, width, _ = picture.shape
    assert picture.dtype == np.float32 and picture.flags.c_contiguous and rows.stop <= height
    padded, sums = np.zeros((len(light), 4)), np.zeros((2, len(rows), width + 3, 4))
    padded[:, :3] = light
    pointers = [a.ctypes.data for a in (counts, edges, padded, sums, picture[rows.start :])]
    _compiled().draw(width, rows.start, len(rows), len(light), *pointers)


@cache
def _compiled() -> ctypes.CDLL:
    library = load_compiled(c_source("pictures/flare/area.c", LOST=LOST))
    whole, real, pointer = ctypes.c_int, ctypes.c_double, ctypes.c_void_p
    library.edges.argtypes, library.edges.restype = [*[whole] * 4, real, *[pointer] * 3], ctypes.c_size_t
    library.draw.argtypes, library.draw.restype = [*[whole] * 4, *[pointer] * 5], None
    return library


@dataclass(frozen=True)
class Raster:
    """The film and its pixels: width and height in mm, and in pixels."""

    film_mm: tuple[float, float]
    width: int
    height: int

    @property
    def per_mm(self) -> float:
        """Pixels per mm."""
        return self.width / self.film_mm[0]


class Smear(NamedTuple):
    """How the image of a patch is smeared in a picture; equal smears are drawn together.

    Attributes:
        sides: right and down, in pixels, of the parallelogram's first side, then of its second.
        weights: [N, M] light of its cells along both sides; empty if all have the same.
        round: whether only the ellipse in the parallelogram is lit.
    """

    sides: tuple[float, float, float, float]
    weights: tuple[tuple[float, ...], ...]
    round: bool

    @property
    def coarse(self) -> int:
        """Return how many times as wide the pixels may be in which the smeared picture is drawn."""
        (a, b, c, d), weights = self.sides, np.array(self.weights or ((1.0,),))
        parts, steps = max(weights.shape), (np.abs(np.diff(weights, axis=axis)).max(initial=0) for axis in (0, 1))
        # The light may jump between cells, not between their parts; a patch of even light only fades.
        cells = 1 if max(steps) < _FADING else parts // FADE if parts > CELLS else parts
        wide = abs(a * d - b * c) / max(math.hypot(a, b), math.hypot(c, d))
        return 1 << max(0, math.floor(math.log2(wide / cells / _FINE)))

    def kernel(self, most: int, coarse: int = 1) -> FloatArray:
        """Return the smear as a kernel [2 H + 1, 2 W + 1] about the middle of its light.

        Its sum is 1, less the light beyond `most` pixels, which is cut off.

        Args:
            most: H and W are at most this.
            coarse: the width of the kernel's pixels, in pixels of the picture.
        """
        sides = np.array(self.sides).reshape(2, 2) / coarse
        area = abs(float(np.linalg.det(sides)))
        if self.round:
            turn = 2 * math.pi * np.arange(_CORNERS) / _CORNERS
            # gives the polygon the ellipse's area
            grown = math.sqrt(2 * math.pi / (_CORNERS * math.sin(2 * math.pi / _CORNERS)))
            places = 0.5 * grown * np.stack([np.cos(turn), np.sin(turn)], 1)[None]
            light = np.array([4 / math.pi])
        else:
            weights = np.array(self.weights or ((1.0,),))
            cell, light = np.argwhere(weights > 0), weights[weights > 0] / weights[weights > 0].sum()
            corners = cell[:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
            places = (corners - light @ (cell + 0.5)) / weights.shape
            light = light * weights.size
        points = places @ sides
        across, down = (min(math.ceil(v + 0.5), most) for v in np.abs(points).max((0, 1)))
        points = points + np.array([across + 0.5, down + 0.5])
        density = (light / area)[:, None, None] * np.tile([1.0, 0.0, 0.0], (*points.shape[:2], 1))
        edges = np.concatenate([points, np.roll(points, -1, 1), density], 2).reshape(-1, 7)
        picture = np.zeros((2 * down + 1, 2 * across + 1, 3), np.float32)
        draw_edges(picture, range(len(picture)), edges.copy(), np.array([len(edges)]), np.ones((1, 3)))
        return np.abs(picture[..., 0])


def smear_of(weights: Array, disc: bool, moved_px: NDArray[np.floating[Any]]) -> Smear | None:
    """Return the smear of a picture that moves by [2, 2] (right, down) along a patch's sides; None if it hardly moves.

    Args:
        weights: the light of the cells of the patch (see `lights.Patch`). disc: whether only an ellipse in it is lit.
    """
    size = float(np.abs(moved_px).sum(0).max())
    if not _LEAST < size < math.inf:
        return None
    step = max(_STEP, 2.0 ** math.floor(math.log2(size / _STEPS)))
    a, b = np.rint(moved_px / step) * step
    if abs(a[0] * b[1] - a[1] * b[0]) < _THIN * max(np.hypot(*a), np.hypot(*b)):
        wide, thin = (a, b) if np.hypot(*a) > np.hypot(*b) else (b, a)
        thin += _THIN / np.hypot(*wide) * np.array([-wide[1], wide[0]])
    even = disc or np.ptp(weights) < 0.01 * weights.max()
    shares = () if even else tuple(map(tuple, (weights / weights.max()).round(4).tolist()))
    return Smear((float(a[0]), float(a[1]), float(b[0]), float(b[1])), shares, disc)


def smeared(picture: FloatArray, kernel: FloatArray) -> FloatArray:
    """Convolve a picture [H + 2 M, W + 2 N, C] with a kernel [2 M + 1, 2 N + 1]; returns [H, W, C].

    It is done in float64: rounding is relative to the brightest pixel, and a millionth of that is seen, too.
    """
    from scipy import signal  # type: ignore[import-untyped]

    (down, across), (height, width) = kernel.shape, picture.shape[:2]
    whole = np.zeros((height + down - 1, width + across - 1, picture.shape[2]), np.float32)
    lit = np.abs(picture) @ np.ones(picture.shape[2], np.float32) > 0
    if lit.any():
        (top, below), (left, right) = ((v[0], v[-1] + 1) for v in (np.flatnonzero(lit.any(axis)) for axis in (1, 0)))
        part = picture[top:below, left:right].astype(np.float64)
        whole[top : below + down - 1, left : right + across - 1] = signal.oaconvolve(
            part, kernel[..., None].astype(np.float64), axes=(0, 1)
        )
    return whole[down - 1 : height, across - 1 : width]


def enlarged(picture: FloatArray, factor: int, height: int, width: int) -> FloatArray:
    """Enlarge a picture by a factor to pixels [height, width] about its middle, by linear interpolation."""
    if factor == 1:
        return picture
    for axis, size in enumerate((height, width)):
        at = (np.arange(size) + 0.5 - size / 2) / factor + picture.shape[axis] / 2 - 0.5
        picture = resampled(picture, axis, at)
    return picture


def resampled(values: FloatArray, axis: int, at: Array) -> FloatArray:
    """Return values at places along an axis, linear between the given ones."""
    first = np.floor(at).astype(int)
    part = np.moveaxis((at - first).astype(np.float32).reshape(-1, *[1] * (values.ndim - 1)), 0, axis)
    return values.take(first, axis, mode="clip") * (1 - part) + values.take(first + 1, axis, mode="clip") * part


def spread(picture: FloatArray, radius: float) -> FloatArray:
    """Blur a picture [H, W, C] by Epanechnikov's kernel of this radius, mirrored at the edges."""
    reach = min(math.ceil(radius), *picture.shape[:2])
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.maximum(1 - (x * x + y * y) / radius**2, 0)
    kernel[reach, reach] = 1
    padded = np.pad(picture, ((reach, reach), (reach, reach), (0, 0)), mode="symmetric")
    return smeared(padded, kernel / kernel.sum())
