"""Light drawn on the film: smears of extended lights, kernels, and the exposure; areas of rays in `areas.py`.

Light adds up: the picture of an extended light is the integral over its points (Goodman, Introduction to Fourier
Optics, section 6.1). Over a small patch a ghost, or a star, keeps its shape and moves with the point, so that the
integral is a convolution with the patch as large as the picture moves: of each ghost by another factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import signal  # type: ignore[import-untyped]

from neurolens.base.errors import InputError
from neurolens.flare.areas import Floats, draw_edges
from neurolens.flare.lights import CELLS, FADE, Patch, disc
from neurolens.lens.prescription import Lens
from neurolens.trace.rays import Rays, trace

Doubles = NDArray[np.float64]
_AXIS = 1 << 15  # rays of the exposure
_LEAST = 0.5  # pixels that a picture moves, below which a light is a point
_STEP, _STEPS = 0.125, 256  # movements are rounded to so many pixels, and to such a part of themselves
_CORNERS = 64  # of an ellipse
_THIN = 0.25  # least width of a patch in pixels
_FINE = 12.0  # pixels that draw the width of a smear, at least


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


@lru_cache(maxsize=32)
def axis_irradiance(lens: Lens, wavelength_nm: float) -> float:
    """Irradiance at the film's centre from uniform surroundings of radiance 1, in sr: the integral of T cos."""
    film_z = lens.film_z_mm
    assert film_z is not None  # of a tracer's lens

    def share(sines: Doubles) -> Doubles:
        d = torch.from_numpy(np.stack([*sines, -np.sqrt(1 - (sines**2).sum(0))]))
        zero = torch.zeros_like(d[0])
        traced = trace(lens, Rays(zero, zero, zero + film_z, *d), wavelength_nm, transmittance=True)
        assert traced.transmittance is not None
        return torch.where(traced.status == 0, traced.transmittance, 0.0).numpy()

    coarse = disc(0, _AXIS)
    widest = 1.0
    for _ in range(3):  # narrows to the cone that passes, and a little more
        lit = share(widest * coarse) > 0
        widest *= 1.02 * float(np.hypot(*coarse)[lit].max(initial=0.0)) if lit.any() else 0.3
    light = math.pi * widest**2 * float(share(min(widest, 1.0) * coarse).mean())
    if not light > 0:
        raise InputError(lens.path, "surfaces", "(no ray passes on the axis)", "a lens that light can pass")
    return light


class Smear(NamedTuple):
    """The image of a patch in a picture; equal smears are drawn together.

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
        """How many pixels wide those pixels may be that the smeared picture is drawn with."""
        (a, b, c, d), parts = self.sides, max(map(len, self.weights), default=1)
        cells = parts // FADE if parts > CELLS else parts  # the light may jump between cells, not between their parts
        wide = abs(a * d - b * c) / max(math.hypot(a, b), math.hypot(c, d))
        return 1 << max(0, math.floor(math.log2(wide / cells / _FINE)))

    def kernel(self, most: int, coarse: int = 1) -> Floats:
        """The kernel [2 H + 1, 2 W + 1] about the middle of the light, of sum 1 but for what lies beyond `most` pixels.

        Args:
            coarse: width of the kernel's pixels.
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
    """The smear of a picture that moves so far [2, 2] (right and down) along the sides of a patch; None if hardly."""
    size = float(np.abs(moved_px).sum(0).max())
    if not _LEAST < size < math.inf:
        return None
    step = max(_STEP, 2.0 ** math.floor(math.log2(size / _STEPS)))
    a, b = np.rint(moved_px / step) * step
    if abs(a[0] * b[1] - a[1] * b[0]) < _THIN * max(np.hypot(*a), np.hypot(*b)):
        wide, thin = (a, b) if np.hypot(*a) > np.hypot(*b) else (b, a)
        thin += _THIN / np.hypot(*wide) * np.array([-wide[1], wide[0]])
    even = patch.round or np.ptp(patch.weights) < 0.01 * patch.weights.max()
    weights = () if even else tuple(map(tuple, (patch.weights / patch.weights.max()).round(4).tolist()))
    return Smear((float(a[0]), float(a[1]), float(b[0]), float(b[1])), weights, patch.round)


def smeared(picture: Floats, kernel: Floats) -> Floats:
    """A picture [H + 2 M, W + 2 N, C] under a kernel [2 M + 1, 2 N + 1]: [H, W, C].

    The convolution is in float64: rounding is relative to the brightest pixel, and a millionth of that is seen, too.
    """
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
    """A picture [H, W, C] under Epanechnikov's kernel of this radius, mirrored at the edges."""
    reach = min(math.ceil(radius), *picture.shape[:2])
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.maximum(1 - (x * x + y * y) / radius**2, 0)
    kernel[reach, reach] = 1
    padded = np.pad(picture, ((reach, reach), (reach, reach), (0, 0)), mode="symmetric")
    return smeared(padded, kernel / kernel.sum())
