"""Ghosts drawn as areas: each cell of a grid of rays spreads its light over the area that it covers on the film.

So the picture of a ghost has neither holes nor noise, and its sum is the light of the ghost, however the map from pupil
to film stretches, folds or turns (Hullin et al. 2011, section 4.2, spread light over quads in this way). Rims cut cells
where the largest r / R on the way is 1, by linear interpolation between rays. Pixels are covered exactly (`area.c`): an
edge adds its height, times the step of density across it, to the pixels that it crosses, and sums along rows make the
picture. Within whole cells the density is linear between the corners, where it is the mean of the cells that meet
there. So no borders show where the density changes little from cell to cell, and each cell keeps its light, except for
a part in 10,000 at its border pixels.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np
from numpy.typing import NDArray

from neurolens.flare.stack import Floats
from neurolens.flare.steps import LOST
from neurolens.graph.compiler import c_source, load_compiled

_PER_CELL = 8  # edges at most: of two triangles that rims cut


def edges_of(found: Floats, columns: int, size: tuple[int, int], per_mm: float) -> NDArray[np.float64]:
    """The light of a grid of rays of one wavelength as edges for `draw_edges`; none if it misses the film.

    Args:
        found: [4, N] film x, y (mm), power and worst of the rays, row after row, with one ray more than `columns` each.
        size: width and height of the film in pixels. per_mm: pixels per mm.

    Raises:
        InputError: no C compiler, or one that fails.
    """
    rows = found.shape[1] // (columns + 1) - 1
    assert found.dtype == np.float32 and found.flags.c_contiguous and found.shape == (4, (rows + 1) * (columns + 1))
    edges, room = np.empty((_PER_CELL * found.shape[1], 7)), np.zeros((15, found.shape[1]))
    pointers = [a.ctypes.data for a in (found, room, edges)]
    return edges[: _compiled().edges(columns, rows, *size, per_mm, *pointers)].copy()


def draw_edges(
    picture: Floats, rows: range, edges: NDArray[np.float64], counts: NDArray[np.int64], light: NDArray[np.float64]
) -> None:
    """Add light to some rows of a picture [H, W, 3], centred and upright (the film turned by 180 degrees).

    A row is the same whether it is drawn by itself or with others.

    Args:
        edges: [N, 7], edges of several grids: x and y of both ends in pixels, then the step of density across the edge
            (at the corner of the picture, and its slopes in x and y). An edge of two equal ends is light at a point.
        counts: [K] number of edges of each grid. light: [K, 3] colour of a cell whose power is 1.

    Raises:
        InputError: as of `edges_of`.
    """
    height, width, _ = picture.shape
    assert picture.dtype == np.float32 and picture.flags.c_contiguous and rows.stop <= height
    given, sums = np.zeros((len(light), 4)), np.zeros((2, len(rows), width + 3, 4))
    given[:, :3] = light
    pointers = [a.ctypes.data for a in (counts, edges, given, sums, picture[rows.start :])]
    _compiled().draw(width, rows.start, len(rows), len(light), *pointers)


@cache
def _compiled() -> ctypes.CDLL:
    library = load_compiled(c_source("flare/area.c", LOST=LOST))
    whole, real, pointer = ctypes.c_int, ctypes.c_double, ctypes.c_void_p
    library.edges.argtypes, library.edges.restype = [*[whole] * 4, real, *[pointer] * 3], ctypes.c_size_t
    library.draw.argtypes, library.draw.restype = [*[whole] * 4, *[pointer] * 5], None
    return library
