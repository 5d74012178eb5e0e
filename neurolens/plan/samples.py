"""Blur of each pixel, for samplers that give more samples where light comes from more of the scene.

What an exact lens blurs a point by depends on its place in the picture and its depth, smoothly: footprints on a grid of
film points at a few depths are interpolated, and each pixel takes its own depth, so that nothing is smeared across
edges. Of an aberration-free lens the square of the blur is a parabola of the inverse distance from the entrance pupil.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]
from scipy.interpolate import RectBivariateSpline  # type: ignore[import-untyped]

from neurolens.plan import footprints as prints
from neurolens.plan.footprints import Array
from neurolens.plan.probe import Probed, upright
from neurolens.render.film import check_memory
from neurolens.study.scenes import seen_depths_m

Pixels = NDArray[np.float32]

_ACROSS, _LEAST = 17, 4  # film points along the longer side, and along either
_DEPTHS, _SAMPLES = 5, 12
_AT_ONCE = 1 << 18  # pixels
_NEAREST = 1e-3  # m from the entrance pupil


def blur_map(found: Probed) -> tuple[Pixels, Pixels]:
    """Diameter of the blur in pixels, and depth in m along the axis from the film (inf: none), [H, W], upright.

    The diameter is that of the disc whose light is as far from its middle, RMS: of a thin lens its circle of confusion.
    0 where the chief ray is dark.

    Raises:
        InputError: a picture beyond memory.
    """
    shot, film = found.scene.settings.camera, np.array(found.asked.shot.film_mm)
    check_memory(shot.width, shot.height)
    x, y = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in zip((shot.width, shot.height), film, strict=True))
    depth = np.empty((shot.height, shot.width), np.float32)
    rows = max(_AT_ONCE // shot.width, 1)
    bands = [slice(first, first + rows) for first in range(0, shot.height, rows)]
    for band in bands:
        points = np.stack(np.meshgrid(x, y[band])).reshape(2, -1)
        depth[band] = seen_depths_m(found.scene, found.exact, points).reshape(-1, shot.width)
    pupil = 1e-3 * float(found.exact.settings["lens_state"]["entrance_pupil_offset_mm"] or 0.0)
    near = 1 / np.maximum(np.where(np.isnan(depth), np.inf, depth) - pupil, _NEAREST)
    nodes = _nodes(float(near.min()), float(near.max()))
    surfaces = [_squares(found, film, pupil + (1 / node if node else math.inf)) for node in nodes]
    blur = np.empty_like(depth)
    for band in bands:
        parts = [s(y[band], x) * w for s, w in zip(surfaces, _lagrange(nodes, near[band]), strict=True)]
        blur[band] = np.sqrt(np.maximum(sum(parts), 0.0)) / found.asked.pixel_mm
    blur[np.isnan(depth)] = 0
    depth[np.isnan(depth)] = np.inf
    return upright(blur), upright(depth)


def _nodes(low: float, high: float) -> Array:
    """Chebyshev's points of an interval, its ends among them; one if it is a point."""
    if high - low <= 1e-6 * high:
        return np.array([high])
    return (low + high) / 2 - (high - low) / 2 * np.cos(np.arange(_DEPTHS) * (np.pi / (_DEPTHS - 1)))


def _lagrange(nodes: Array, at: Array) -> list[Array]:
    """Weights of the values at nodes for those elsewhere."""
    return [
        np.prod([(at - other) / (node - other) for other in nodes if other != node], axis=0, initial=1.0)
        for node in nodes
    ]


def _squares(found: Probed, film: Array, depth_m: float) -> RectBivariateSpline:
    """The square of the diameter in mm over film y and x, of what lies at one depth."""
    counts = [max(round(_ACROSS * side / film.max()), _LEAST) for side in film]
    x, y = (np.linspace(-side / 2, side / 2, n) for side, n in zip(film, counts, strict=True))
    points = np.stack(np.meshgrid(x, y)).reshape(2, -1)
    share, nm = found.places.share, found.places.wavelength_nm
    places = prints.places_of(found.exact, points, np.full(points.shape[1], depth_m), nm, share)
    diameter = math.sqrt(2) * prints.blur_mm(prints.footprints(found.exact, places, _SAMPLES), share)
    square = np.full(counts[::-1], np.nan)
    column, row = (np.rint((places.film_mm[k] / film[k] + 0.5) * (counts[k] - 1)).astype(int) for k in (0, 1))
    square[row, column] = diameter**2
    if np.isnan(square).any():  # dark: as the nearest that is not
        lit = ndimage.distance_transform_edt(np.isnan(square), return_distances=False, return_indices=True)
        square = square[tuple(lit)]
    return RectBivariateSpline(y, x, square, kx=3, ky=3)
