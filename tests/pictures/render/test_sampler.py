"""Random numbers: the right sequence, stratified in every pixel, the same whoever asks."""

import numpy as np
import pytest

from neurolens.pictures.render.sampler import FILM, PUPIL, WAVELENGTH, Sampler, sobol


def pixel_samples(sampler: Sampler, pixel: int, count: int, dimension: int) -> np.ndarray:
    keys = sampler.keys(np.full(count, pixel, np.intp), np.arange(count))
    return sampler.draw(keys, dimension)


def test_sobol_matches_scipy() -> None:
    qmc = pytest.importorskip("scipy.stats").qmc
    expected = qmc.Sobol(10, scramble=False, bits=30).random_base2(8)
    ours = sobol(256, 10).T / 2.0**32
    # scipy runs through the points in Gray-code order: the same set in every block of 2^k.
    for order in (4, 6, 8):
        block = 2**order
        assert np.array_equal(np.sort(ours[:block], axis=0), np.sort(expected[:block], axis=0))
        assert set(map(tuple, ours[:block])) == set(map(tuple, expected[:block]))


@pytest.mark.parametrize("dimension", range(10))
def test_every_pixel_is_stratified_in_each_dimension(dimension: int) -> None:
    sampler = Sampler(64, seed=3)
    for pixel in (0, 1, 57599):
        strata = np.floor(pixel_samples(sampler, pixel, 64, dimension) * 64).astype(int)
        assert sorted(strata) == list(range(64))


def test_film_and_pupil_are_stratified_in_two_dimensions() -> None:
    sampler = Sampler(64, seed=5)
    for first, side in ((FILM, 8), (PUPIL, 4)):
        u, v = pixel_samples(sampler, 9, 64, first), pixel_samples(sampler, 9, 64, first + 1)
        assert len(set(np.floor(u * side) * side + np.floor(v * side))) == side**2


def test_pixels_seeds_and_dimensions_differ_and_repeat() -> None:
    base = pixel_samples(Sampler(16, seed=1), 4, 16, WAVELENGTH)
    assert np.array_equal(base, pixel_samples(Sampler(16, seed=1), 4, 16, WAVELENGTH))
    assert not np.any(base == pixel_samples(Sampler(16, seed=2), 4, 16, WAVELENGTH))
    assert not np.any(base == pixel_samples(Sampler(16, seed=1), 5, 16, WAVELENGTH))
    assert not np.any(base == pixel_samples(Sampler(16, seed=1), 4, 16, FILM))


@pytest.mark.parametrize("dimension", [0, 7, 25])
def test_numbers_are_uniform_over_pixels(dimension: int) -> None:
    sampler = Sampler(4, seed=0)
    pixel = np.repeat(np.arange(20000), 4)
    numbers = sampler.draw(sampler.keys(pixel, np.tile(np.arange(4), 20000)), dimension)
    assert numbers.min() >= 0 and numbers.max() < 1
    assert abs(numbers.mean() - 0.5) < 0.004
    assert np.ptp(np.histogram(numbers, 16, (0, 1))[0]) < 500
    assert abs(np.corrcoef(numbers[:-4], numbers[4:])[0, 1]) < 0.02
