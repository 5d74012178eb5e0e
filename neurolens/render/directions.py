"""Directions: frames, and directions drawn by cosine, in a cone, or by a table over the sphere."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.primitives import dot

_PI, TWO_PI = np.float32(math.pi), np.float32(2 * math.pi)


def orthonormal(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors [3, N] that make a right-handed frame with each unit normal [3, N] (Duff et al. 2017)."""
    x, y, z = normal
    sign = np.copysign(np.float32(1), z)
    a = np.float32(-1) / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    bitangent = np.stack([b, sign + y * y * a, -y])
    return tangent, bitangent


def cosine_direction(normal: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions [3, N] with density cos / pi about the normals, and their cosines [N].

    A normal plus a uniform point on the unit sphere has that distribution; no tangent frame is needed.
    """
    height = 1 - 2 * square[0]
    radius = np.sqrt(1 - height * height)
    angle = square[1] * TWO_PI
    direction = np.empty_like(normal)
    np.cos(angle, out=direction[0])
    np.sin(angle, out=direction[1])
    direction[:2] *= radius
    direction[2] = height
    direction += normal
    # The point opposite to the normal would give the zero vector.
    length2 = np.maximum(dot(direction, direction), np.float32(1e-12))
    direction /= np.sqrt(length2)
    return direction, np.maximum(dot(direction, normal), np.float32(1e-6))


def one_less_cosine(sin2: FloatArray) -> FloatArray:
    """1 - cos of the half angle of a cone, from its squared sine, without loss for narrow cones."""
    sin2 = np.minimum(sin2, np.float32(1))
    return sin2 / (1 + np.sqrt(1 - sin2))


def in_cone(axis: FloatArray, one_less_cos: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions [3, N] uniform within cones about unit axes [3, N], and their cosines' distance from 1, [N].

    1 - cos directly, not cos: a distant sphere's cone is narrower than float32 resolves near 1.
    """
    lost = square[0] * one_less_cos
    sin = np.sqrt(lost * (2 - lost))
    angle = square[1] * TWO_PI
    tangent, bitangent = orthonormal(axis)
    return axis * (1 - lost) + tangent * (sin * np.cos(angle)) + bitangent * (sin * np.sin(angle)), lost


def cell_of(direction: FloatArray, height: int, width: int, turn: float = 0.0) -> NDArray[np.intp]:
    """Flat numbers [N] of the cells of a table [height, width], turned by `turn` radians about y, in directions."""
    across = np.arctan2(direction[0], -direction[2])
    across += np.float32(turn)
    across *= np.float32(0.5) / _PI
    across += np.float32(0.5)
    across -= np.floor(across)
    down = np.arccos(np.clip(direction[1], -1, 1)) / _PI
    column = np.minimum((across * np.float32(width)).astype(np.intp), width - 1)
    row = np.minimum((down * np.float32(height)).astype(np.intp), height - 1)
    return row * width + column


def centres(height: int, width: int) -> FloatArray:
    """Unit directions [3, height * width] of the middles of the cells."""
    down = (np.arange(height) + 0.5) * math.pi / height
    across = (np.arange(width) + 0.5) * 2 * math.pi / width - math.pi
    sin, cos = np.sin(down)[:, None], np.cos(down)[:, None]
    x, y, z = sin * np.sin(across), np.broadcast_to(cos, (height, width)), -sin * np.cos(across)
    return np.stack([x, y, z]).reshape(3, -1).astype(np.float32)


class DirectionTable:
    """Directions with a density per solid angle that is constant in each cell, in proportion to its weight.

    The table is a picture in the equirectangular form: its middle looks along -z, its right half along +x, its top row
    is at the zenith (+y).

    Args:
        weights: [H, W], 0 or more, at least one above 0.
        turn: radians by which the table is turned about y.
    """

    def __init__(self, weights: NDArray[np.floating], turn: float = 0.0) -> None:
        self._height, self._width = weights.shape
        self._turn = turn
        # Uniform in the cosine from the zenith within a row, so that a density is constant per solid angle.
        cosine = np.cos(np.linspace(0, math.pi, self._height + 1))
        self._cosine = cosine.astype(np.float32)
        solid = (cosine[:-1] - cosine[1:]) * 2 * math.pi / self._width
        # Each step in place: of a picture of 8192 by 4096 cells an array takes 0.27 GB.
        share = np.multiply(weights, solid[:, None], dtype=np.float64)
        rows = share.sum(axis=1)
        self.total = float(rows.sum())
        self._density = (weights / self.total).astype(np.float32, copy=False).ravel()
        self._rows = np.concatenate([[0.0], np.cumsum(rows) / self.total])
        self._rows[-1] = 1.0
        # One sorted list for all rows: that of row r runs from r to r + 1.
        np.cumsum(share, axis=1, out=share)
        share /= np.maximum(rows, 1e-300)[:, None]
        share[:, -1] = 1.0
        np.minimum(share, 1.0, out=share)
        share += np.arange(self._height)[:, None]
        self._columns = share.ravel()

    def sample(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Directions [3, N] and densities [N] per solid angle for numbers [2, N] in [0, 1)."""
        up = square[1].astype(np.float64)
        row = np.clip(np.searchsorted(self._rows, up, side="right") - 1, 0, self._height - 1)
        low = self._rows[row]
        down = np.clip((up - low) / np.maximum(self._rows[row + 1] - low, 1e-300), 0, 1)
        place = row + square[0].astype(np.float64)
        cell = np.clip(np.searchsorted(self._columns, place, side="right"), row * self._width, None)
        cell = np.minimum(cell, (row + 1) * self._width - 1)
        column = cell - row * self._width
        left = np.where(column > 0, self._columns[cell - 1], row)
        along = np.clip((place - left) / np.maximum(self._columns[cell] - left, 1e-300), 0, 1)
        angle = ((column + along) / self._width * 2 * math.pi - math.pi - self._turn).astype(np.float32)
        cosine = self._cosine[row] + (self._cosine[row + 1] - self._cosine[row]) * down.astype(np.float32)
        sine = np.sqrt(np.maximum(1 - cosine * cosine, 0))
        return np.stack([sine * np.sin(angle), cosine, -sine * np.cos(angle)]), self._density.take(cell)

    def pdf(self, direction: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes directions [3, N]."""
        return self._density.take(cell_of(direction, self._height, self._width, self._turn))
