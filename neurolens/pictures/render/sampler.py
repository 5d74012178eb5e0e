"""The random numbers of a path, and directions drawn with them: by cosine, in a cone, or by a table over the sphere.

A number is a pure function of seed, pixel, sample and dimension. Nothing depends on the camera, on the order of work or
on the number of workers, so that pictures of two cameras with one seed carry the same noise. The first dimensions
(film, pupil, wavelength, first light and bounce) are a Sobol' sequence, scrambled for each pixel; the rest are hashed.

Sources: Joe and Kuo 2008, "Constructing Sobol sequences with better two-dimensional projections" (direction numbers);
Laine and Karras 2011 and Burley 2020, "Practical hash-based Owen scrambling".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render.primitives import dot

UInt32Array = NDArray[np.uint32]

# Dimensions of a path. Each bounce takes BOUNCE_DIMENSIONS more, from FIRST_BOUNCE on.
FILM, PUPIL, WAVELENGTH, FIRST_BOUNCE = 0, 2, 4, 5
LIGHT_CHOICE, LIGHT, SCATTER, LOBE, ROULETTE = 0, 1, 3, 5, 6
BOUNCE_DIMENSIONS = 7
_SOBOL_DIMENSIONS = FIRST_BOUNCE + 5

# Degree s, coefficients a and first direction numbers m of dimensions 2 to 10 of Joe and Kuo's table.
_JOE_KUO: tuple[tuple[int, int, tuple[int, ...]], ...] = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
    (5, 4, (1, 1, 5, 5, 5)),
    (5, 7, (1, 1, 7, 11, 19)),
)

_PI, TWO_PI = np.float32(math.pi), np.float32(2 * math.pi)


def _direction_numbers(dimension: int) -> list[int]:
    if dimension == 0:
        return [1 << (31 - k) for k in range(32)]
    degree, coefficients, first = _JOE_KUO[dimension - 1]
    numbers = [m << (31 - k) for k, m in enumerate(first)]
    for k in range(degree, 32):
        value = numbers[k - degree] ^ (numbers[k - degree] >> degree)
        for j in range(1, degree):
            if coefficients >> (degree - 1 - j) & 1:
                value ^= numbers[k - j]
        numbers.append(value)
    return numbers


def sobol(count: int, dimensions: int = _SOBOL_DIMENSIONS) -> UInt32Array:
    """Return the first `count` points of the Sobol' sequence, [dimensions, count], as 32-bit fractions."""
    index = np.arange(count, dtype=np.uint32)
    points = np.zeros((dimensions, count), np.uint32)
    for dimension in range(dimensions):
        for k, number in enumerate(_direction_numbers(dimension)[: count.bit_length()]):
            points[dimension] ^= (index >> np.uint32(k) & np.uint32(1)) * np.uint32(number)
    return points


def hash32(x: UInt32Array) -> UInt32Array:
    """Mix all bits of 32-bit integers one to one (two rounds of xor-shift and multiply); x is unchanged."""
    x = x ^ (x >> np.uint32(16))
    x *= np.uint32(0x7FEB352D)
    x ^= x >> np.uint32(15)
    x *= np.uint32(0x846CA68B)
    x ^= x >> np.uint32(16)
    return x


def _reverse_bits(x: UInt32Array) -> UInt32Array:
    x = x.byteswap()
    for shift, mask in ((4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        low = x & np.uint32(mask)
        x >>= np.uint32(shift)
        x &= np.uint32(mask)
        low <<= np.uint32(shift)
        x |= low
    return x


def _to_unit(bits: UInt32Array) -> FloatArray:
    """Return floats in [0, 1) from the upper 24 bits, so that rounding never gives 1."""
    unit = (bits >> np.uint32(8)).astype(np.float32)
    unit *= np.float32(2.0**-24)
    return unit


@dataclass(frozen=True)
class PathKeys:
    """Keys of paths [N] for the sampler: a hash of pixel number and seed, and the sample's index in its pixel.

    `path` is a hash of both, for the dimensions beyond the Sobol' sequence.
    """

    pixel: UInt32Array
    sample: NDArray[np.intp]
    path: UInt32Array

    def take(self, rows: NDArray[np.intp]) -> PathKeys:
        """Return the keys of some paths."""
        return PathKeys(self.pixel.take(rows), self.sample.take(rows), self.path.take(rows))

    def cut(self, start: int, stop: int) -> PathKeys:
        """Return the keys of consecutive paths, without a copy."""
        return PathKeys(self.pixel[start:stop], self.sample[start:stop], self.path[start:stop])


class Sampler:
    """The random numbers of a picture with one seed and so many samples a pixel (a power of two stratifies best)."""

    def __init__(self, samples: int, seed: int) -> None:
        self._sobol_reversed = np.stack([_reverse_bits(points) for points in sobol(samples)])
        self._seed = hash32(np.array([seed & 0xFFFFFFFF], np.uint32))[0] ^ np.uint32(seed >> 32 & 0xFFFFFFFF)

    def keys(self, pixel: NDArray[np.intp], sample: NDArray[np.intp]) -> PathKeys:
        """Make the keys of the paths of pixel numbers [N] and sample indices [N]."""
        pixel_key = hash32(hash32(pixel.astype(np.uint32)) ^ self._seed)
        return PathKeys(pixel_key, sample, hash32(pixel_key + sample.astype(np.uint32) * np.uint32(0x9E3779B9)))

    def draw(self, keys: PathKeys, dimension: int) -> FloatArray:
        """Return numbers [N] in [0, 1), one dimension of each path."""
        salt = np.uint32((dimension + 1) * 0x85EBCA6B & 0xFFFFFFFF)
        if dimension >= _SOBOL_DIMENSIONS:
            return _to_unit(hash32(keys.path + salt))
        x = self._sobol_reversed[dimension].take(keys.sample)
        x += hash32(keys.pixel + salt)
        for multiplier in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
            x ^= x * np.uint32(multiplier)
        return _to_unit(_reverse_bits(x))

    def draw2(self, keys: PathKeys, dimension: int) -> FloatArray:
        """Return numbers [2, N] of two successive dimensions."""
        return np.stack([self.draw(keys, dimension), self.draw(keys, dimension + 1)])


def orthonormal(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors [3, N] that make a right-handed frame with each unit normal [3, N] (Duff et al. 2017)."""
    x, y, z = normal
    sign = np.copysign(np.float32(1), z)
    a = np.float32(-1) / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    bitangent = np.stack([b, sign + y * y * a, -y])
    return tangent, bitangent


def cosine_direction(normal: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Draw directions [3, N] with density cos / pi about the normals; also return their cosines [N].

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
    direction /= np.sqrt(np.maximum(dot(direction, direction), np.float32(1e-12)))
    return direction, np.maximum(dot(direction, normal), np.float32(1e-6))


def one_less_cosine(sin2: FloatArray) -> FloatArray:
    """Return 1 - cos of a cone's half angle from its squared sine, without loss for narrow cones."""
    sin2 = np.minimum(sin2, np.float32(1))
    return sin2 / (1 + np.sqrt(1 - sin2))


def in_cone(axis: FloatArray, one_less_cos: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Draw directions [3, N], uniform within cones about unit axes [3, N]; also return 1 - cos to the axes, [N].

    It is 1 - cos, not cos, because a distant sphere's cone is narrower than float32 resolves near 1.
    """
    lost = square[0] * one_less_cos
    sin = np.sqrt(lost * (2 - lost))
    angle = square[1] * TWO_PI
    tangent, bitangent = orthonormal(axis)
    return axis * (1 - lost) + tangent * (sin * np.cos(angle)) + bitangent * (sin * np.sin(angle)), lost


def cell_of(direction: FloatArray, height: int, width: int, turn: float = 0.0) -> NDArray[np.intp]:
    """Return the flat numbers [N] of a table's cells in directions; [height, width], turned by `turn` rad about y."""
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
    """Return unit directions [3, height * width] to the middles of the cells."""
    down = (np.arange(height) + 0.5) * math.pi / height
    across = (np.arange(width) + 0.5) * 2 * math.pi / width - math.pi
    sin, cos = np.sin(down)[:, None], np.cos(down)[:, None]
    x, y, z = sin * np.sin(across), np.broadcast_to(cos, (height, width)), -sin * np.cos(across)
    return np.stack([x, y, z]).reshape(3, -1).astype(np.float32)


class DirectionTable:
    """Draws directions with a density per solid angle that is constant in each cell, in proportion to its weight.

    The table is a picture in the equirectangular form: its middle looks along -z, its right half along +x, its top row
    is at the zenith (+y).

    Args:
        weights: [H, W], 0 or more, at least one above 0.
        turn: radians by which the table is turned about y.
    """

    def __init__(self, weights: NDArray[np.floating], turn: float = 0.0) -> None:
        self._height, self._width = weights.shape
        self._turn = turn
        # Rows are uniform in the cosine from the zenith, so that a density is constant per solid angle.
        cosine = np.cos(np.linspace(0, math.pi, self._height + 1))
        self._cosine = cosine.astype(np.float32)
        solid = (cosine[:-1] - cosine[1:]) * 2 * math.pi / self._width
        # Each step works in place: at 8192 by 4096 cells an array takes 0.27 GB.
        share = np.multiply(weights, solid[:, None], dtype=np.float64)
        rows = share.sum(axis=1)
        self.total = float(rows.sum())
        self._density = (weights / self.total).astype(np.float32, copy=False).ravel()
        self._rows = np.concatenate([[0.0], np.cumsum(rows) / self.total])
        self._rows[-1] = 1.0
        # One sorted list serves all rows: that of row r runs from r to r + 1.
        np.cumsum(share, axis=1, out=share)
        share /= np.maximum(rows, 1e-300)[:, None]
        share[:, -1] = 1.0
        np.minimum(share, 1.0, out=share)
        share += np.arange(self._height)[:, None]
        self._columns = share.ravel()

    def sample(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return directions [3, N] and densities [N] per solid angle for numbers [2, N] in [0, 1)."""
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
        """Return the density [N] per solid angle with which `sample` takes directions [3, N]."""
        return self._density.take(cell_of(direction, self._height, self._width, self._turn))
