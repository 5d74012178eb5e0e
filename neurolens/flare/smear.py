"""What a patch of a light makes, from what the point in its middle makes: its picture, smeared along the patch's image.

Light adds up: the picture of an extended light is the integral over its points (Goodman, Introduction to Fourier
Optics, section 6.1). Over a small patch a ghost, or a star, keeps its shape and moves with the point, so that the
integral is a convolution with the patch as large as the picture moves: of each ghost by another factor.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal  # type: ignore[import-untyped]

from neurolens.flare.area import draw_edges
from neurolens.flare.lights import Patch
from neurolens.flare.stack import Floats

_LEAST = 0.5  # pixels that a picture moves, below which a light is a point
_STEP, _STEPS = 0.125, 48  # pixels at least, and of a movement at most, by which different ones differ
_CORNERS = 64  # of an ellipse
_THIN = 0.25  # pixels that a patch is wide at least
_FINE = 12.0  # pixels that the width of a smear is drawn with, at least


class Smear(NamedTuple):
    """The image of a patch in a picture; equal ones may be shared.

    Attributes:
        sides: x and y in pixels, to the right and down, of both sides of the parallelogram.
        weights: [N, M] light of its cells, along the first side and the second; empty if all have the same.
        round: whether it is the ellipse in the parallelogram.
    """

    sides: tuple[float, float, float, float]
    weights: tuple[tuple[float, ...], ...]
    round: bool

    @property
    def coarse(self) -> int:
        """How many pixels wide those may be that the smeared picture is drawn with."""
        a, b, c, d = self.sides
        wide = abs(a * d - b * c) / max(math.hypot(a, b), math.hypot(c, d)) / max(map(len, self.weights), default=1)
        return 1 << max(0, math.floor(math.log2(wide / _FINE)))

    def kernel(self, most: int, coarse: int = 1) -> Floats:
        """[2 H + 1, 2 W + 1] about the middle of its light, of sum 1 but for what lies beyond so many pixels.

        Args:
            coarse: width of the pixels.
        """
        sides = np.array(self.sides).reshape(2, 2) / coarse
        area = abs(float(np.linalg.det(sides)))
        if self.round:
            turn = 2 * math.pi * np.arange(_CORNERS) / _CORNERS
            grown = math.sqrt(2 * math.pi / (_CORNERS * math.sin(2 * math.pi / _CORNERS)))  # to the ellipse's area
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


def smear_of(patch: Patch, moved_px: NDArray[np.floating[Any]]) -> Smear | None:
    """How a picture is smeared that moves so far [2, 2] (right and down) along the sides of a patch; None if hardly."""
    size = float(np.abs(moved_px).sum(0).max())
    if not _LEAST < size < math.inf:
        return None
    step = max(_STEP, 2.0 ** math.floor(math.log2(size / _STEPS)))
    a, b = np.rint(moved_px / step) * step
    if abs(a[0] * b[1] - a[1] * b[0]) < _THIN * max(np.hypot(*a), np.hypot(*b)):
        wide, thin = (a, b) if np.hypot(*a) > np.hypot(*b) else (b, a)
        thin += _THIN / np.hypot(*wide) * np.array([-wide[1], wide[0]])
    even = patch.round or np.ptp(patch.weights) < 0.01 * patch.weights.max()
    weights = () if even else tuple(map(tuple, (patch.weights / patch.weights.max()).round(2).tolist()))
    return Smear((float(a[0]), float(a[1]), float(b[0]), float(b[1])), weights, patch.round)


def smeared(picture: Floats, kernel: Floats) -> Floats:
    """A picture [H + 2 M, W + 2 N, C] under a kernel [2 M + 1, 2 N + 1]: [H, W, C].

    In float64: rounding is relative to the brightest pixel, and what is a millionth as bright is seen, too.
    """
    (down, across), (height, width) = kernel.shape, picture.shape[:2]
    found = np.zeros((height + down - 1, width + across - 1, picture.shape[2]), np.float32)
    lit = np.abs(picture).max(2) > 0
    if lit.any():
        (top, below), (left, right) = ((v[0], v[-1] + 1) for v in (np.flatnonzero(lit.any(axis)) for axis in (1, 0)))
        some = picture[top:below, left:right].astype(np.float64)
        found[top : below + down - 1, left : right + across - 1] = signal.oaconvolve(
            some, kernel[..., None].astype(np.float64), axes=(0, 1)
        )
    return found[down - 1 : height, across - 1 : width]


def enlarged(picture: Floats, factor: int, height: int, width: int) -> Floats:
    """A picture with pixels so many times as wide, in pixels [height, width] about the same middle; linear between."""
    if factor == 1:
        return picture
    for axis, size in enumerate((height, width)):
        at = (np.arange(size) + 0.5 - size / 2) / factor + picture.shape[axis] / 2 - 0.5
        first = np.floor(at).astype(int)
        part = np.moveaxis((at - first).astype(np.float32)[:, None, None], 0, axis)
        picture = picture.take(first, axis) * (1 - part) + picture.take(first + 1, axis) * part
    return picture


def spread(picture: Floats, radius: float) -> Floats:
    """A picture [H, W, C] under a kernel of Epanechnikov of this radius, mirrored at the edges."""
    reach = min(math.ceil(radius), *picture.shape[:2])
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.maximum(1 - (x * x + y * y) / radius**2, 0)
    kernel[reach, reach] = 1
    padded = np.pad(picture, ((reach, reach), (reach, reach), (0, 0)), mode="symmetric")
    return smeared(padded, kernel / kernel.sum())
