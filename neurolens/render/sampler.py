"""Random numbers of a path: a pure function of seed, pixel, sample and dimension.

Nothing depends on the camera, on the order of work or on the number of workers, so that pictures of two cameras with
one seed carry the same noise. The first dimensions (film, pupil, wavelength, first light and bounce) are a Sobol'
sequence, scrambled for each pixel; the rest are hashed.

Sources: Joe and Kuo 2008, "Constructing Sobol sequences with better two-dimensional projections" (direction numbers);
Laine and Karras 2011 and Burley 2020, "Practical hash-based Owen scrambling".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray

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
    """The first `count` points of the Sobol' sequence, [dimensions, count], as 32-bit fractions."""
    index = np.arange(count, dtype=np.uint32)
    points = np.zeros((dimensions, count), np.uint32)
    for dimension in range(dimensions):
        for k, number in enumerate(_direction_numbers(dimension)[: count.bit_length()]):
            points[dimension] ^= (index >> np.uint32(k) & np.uint32(1)) * np.uint32(number)
    return points


def hash32(x: UInt32Array) -> UInt32Array:
    """A bijection of 32-bit integers that mixes all bits (two rounds of xor-shift and multiply); x is unchanged."""
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
    """Floats in [0, 1) from the upper 24 bits, so that rounding never gives 1."""
    unit = (bits >> np.uint32(8)).astype(np.float32)
    unit *= np.float32(2.0**-24)
    return unit


@dataclass(frozen=True)
class PathKeys:
    """Keys of paths [N] for the sampler: the hashed pixel number and seed, the sample's index in its pixel.

    `path` is a hash of both, for the dimensions beyond the Sobol' sequence.
    """

    pixel: UInt32Array
    sample: NDArray[np.intp]
    path: UInt32Array

    def take(self, rows: NDArray[np.intp]) -> PathKeys:
        """The keys of some paths."""
        return PathKeys(self.pixel.take(rows), self.sample.take(rows), self.path.take(rows))

    def cut(self, start: int, stop: int) -> PathKeys:
        """The keys of consecutive paths, without a copy."""
        return PathKeys(self.pixel[start:stop], self.sample[start:stop], self.path[start:stop])


class Sampler:
    """Samples for a picture of so many samples per pixel (a power of two stratifies best), of one seed."""

    def __init__(self, samples: int, seed: int) -> None:
        self._sobol_reversed = np.stack([_reverse_bits(points) for points in sobol(samples)])
        self._seed = hash32(np.array([seed & 0xFFFFFFFF], np.uint32))[0] ^ np.uint32(seed >> 32 & 0xFFFFFFFF)

    def keys(self, pixel: NDArray[np.intp], sample: NDArray[np.intp]) -> PathKeys:
        """Keys of the paths of pixel numbers [N] and sample indices [N]."""
        pixel_key = hash32(hash32(pixel.astype(np.uint32)) ^ self._seed)
        path = hash32(pixel_key + sample.astype(np.uint32) * np.uint32(0x9E3779B9))
        return PathKeys(pixel_key, sample, path)

    def draw(self, keys: PathKeys, dimension: int) -> FloatArray:
        """Numbers [N] in [0, 1) of one dimension of each path."""
        salt = np.uint32((dimension + 1) * 0x85EBCA6B & 0xFFFFFFFF)
        if dimension >= _SOBOL_DIMENSIONS:
            return _to_unit(hash32(keys.path + salt))
        x = self._sobol_reversed[dimension].take(keys.sample)
        x += hash32(keys.pixel + salt)
        for multiplier in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
            x ^= x * np.uint32(multiplier)
        return _to_unit(_reverse_bits(x))

    def draw2(self, keys: PathKeys, dimension: int) -> FloatArray:
        """Numbers [2, N] of two dimensions in a row."""
        return np.stack([self.draw(keys, dimension), self.draw(keys, dimension + 1)])
