"""Fits the image of a stop that folds, see `pupil_fold`, to what passes a lens: where `moved` begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_fold import LEAST, NUMBERS
from neurolens.cameras.pupil_sight import Sight
from neurolens.cameras.stop_image import draw_rays

Array = NDArray[np.float64]
# Powers of the film radius of terms alone, with the film position, with its square and with the wavelength.
_POWERS = ((4, 0, 0), (3, 1, 0), (2, 2, 0), (3, 0, 1))
_FIELD = 3  # and of the numbers that tell of y
_MIDDLE = 0.15  # stops: rays within count as much
_RIDGE = 1e-6


def folded(arcs: PupilArcs, sight: Sight) -> PupilArcs:
    """The arcs of a lens with the image of a stop that folds in place of the stop's own."""
    exponents = np.array([(i, 0, film, wave, 0) for most, film, wave in _POWERS for i in range(most + 1)])
    numbers = np.zeros((len(arcs.sides), NUMBERS, len(exponents)))
    same = (exponents[:, None] == arcs.exponents).all(2)  # rims do not move with the stop: all of theirs are there
    numbers[1:, : arcs.numbers.shape[1]] = arcs.numbers[1:] @ same.T
    found = replace(arcs, exponents=exponents, numbers=numbers)
    film, z, nm, pupil, point = draw_rays(sight, None, np.random.default_rng(0))
    scaled = arcs.scaled(film[0], 1.0, z, nm, 0.0)
    monomials = np.prod(scaled[:, None] ** exponents.T[:, :, None], axis=0)
    numbers[0] = _numbers(monomials, exponents[:, 0] <= _FIELD, pupil, point / arcs.stop_radius_mm)
    return found


def _numbers(monomials: Array, few: NDArray[np.bool_], pupil: Array, point: Array) -> Array:
    """[8, M]: numbers of rays through pupil points [2, N] and points of the stop in its widest radii; least squares.

    Args:
        monomials: [M, N]; `few` of them are those of the numbers that tell of y.
    """
    x, y = pupil
    along, reach = point[0] * np.sign(x @ point[0]), np.hypot(*point)  # an image may be upside down
    weight, own = 1 / (_MIDDLE + reach), monomials[few]
    factors, numbers = (x**0, x, x**2, -x * along, -(x**2) * along), np.zeros((NUMBERS, len(monomials)))
    rows = np.concatenate([*(monomials * factor for factor in factors), own * y**2])
    numbers[:5] = _solved(rows * weight, along * weight)[: 5 * len(monomials)].reshape(5, -1)
    a, b, c, d, e = numbers[:5] @ monomials
    centred = (a + (b + c * x) * x) / np.maximum(1 + (d + e * x) * x, LEAST)
    rows = np.concatenate([own, own * x, own * x**2]) * y**2
    numbers[5:, few] = _solved(rows * weight**2, (reach**2 - centred**2) * weight**2).reshape(3, -1)
    return numbers


def _solved(rows: Array, wanted: Array) -> Array:
    """Where nothing folds, numerator and denominator may have any factor in common, poles too, but for the ridge."""
    size = np.sqrt((rows**2).mean(1)) + 1e-30
    scaled, count = rows / size[:, None], rows.shape[1]
    products = scaled @ scaled.T / count + _RIDGE * np.eye(len(rows))
    return np.asarray(np.linalg.solve(products, scaled @ wanted / count) / size)
