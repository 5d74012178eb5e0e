"""Grids of rays drawn as the areas that their cells cover on the film.

A picture drawn so has neither holes nor noise, and its sum is the light of the grid, however the map to the film
stretches, folds or turns (Hullin et al. 2011, section 4.2, spread light over quads in this way). Rims cut cells where
the largest r / R on the way is 1, by linear interpolation between rays. Pixels are covered exactly (`area.c`): an edge
adds its height, times the step of density across it, to the pixels that it crosses, and sums along rows make the
picture. Within whole cells the density is linear between the corners, where it is the mean of the cells that meet
there. So no borders show where the density changes little from cell to cell, and each cell keeps its light, but for a
part in 10,000 at its border pixels.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.compiler import c_source, load_compiled

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
LOST = 1e30  # `worst` of a ray that meets no surface, or is totally reflected where it should go on
_PER_CELL = 8  # edges of two triangles that rims cut, at most


def edges_of(rays: Floats, columns: int, size: tuple[int, int], per_mm: float) -> Doubles:
    """The light of a grid of rays of one wavelength as edges for `draw_edges`; none if it misses the film.

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


def draw_edges(picture: Floats, rows: range, edges: Doubles, counts: NDArray[np.int64], light: Doubles) -> None:
    """Add light to some rows of a picture [H, W, 3], centred and upright (the film turned by 180 degrees).

    A row is the same whether it is drawn by itself or with others.

    Args:
        edges: [N, 7], edges of several grids: x and y of both ends in pixels, then the step of density across the edge
            (at the corner of the picture, and its slopes in x and y). An edge of two equal ends is light at a point.
        counts: [K] number of edges of each grid. light: [K, 3] colour of a cell whose power is 1.

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
    library = load_compiled(c_source("flare/area.c", LOST=LOST))
    whole, real, pointer = ctypes.c_int, ctypes.c_double, ctypes.c_void_p
    library.edges.argtypes, library.edges.restype = [*[whole] * 4, real, *[pointer] * 3], ctypes.c_size_t
    library.draw.argtypes, library.draw.restype = [*[whole] * 4, *[pointer] * 5], None
    return library
