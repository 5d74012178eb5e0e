"""Equal time: bias and variance of known renders, and the error that follows after some seconds."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from experiments.lab import Row
from experiments.pictures.equal_time import (
    Counts,
    Estimate,
    Passes,
    bias_and_variance,
    camera_row,
    error_after,
    paired_bias,
    reference_variance,
    squared_error,
)

SHAPE = (12, 20, 3)
Picture = NDArray[np.float64]


def truth() -> Picture:
    return np.random.default_rng(1).random(SHAPE) + 0.2


def noise(count: int, sigma: float, seed: int) -> Picture:
    return sigma * np.random.default_rng(seed).normal(size=(count, *SHAPE))


# Estimators


@pytest.mark.parametrize(("bias", "sigma", "reference"), [(0.3, 0.5, 0.4), (0.02, 0.4, 0.3), (0.0, 1.0, 0.5)])
def test_bias_and_variance_of_known_pictures_with_a_noisy_reference(
    bias: float, sigma: float, reference: float
) -> None:
    """Without the two halves, the reference's own variance (0.16 at most) would count as bias."""
    wrong = bias * np.sign(np.random.default_rng(2).normal(size=SHAPE))
    halves = truth() + noise(2, reference, 3)
    found, variance = bias_and_variance(truth() + wrong + noise(24, sigma, 4), halves, np.ones(SHAPE))
    # What the reference's own noise adds to the jackknife's deviation: a product of two normal numbers a pixel.
    spread = math.hypot(found.sd, reference**2 / math.sqrt(720), bias * reference * math.sqrt(2 / 720))
    assert abs(found.value - bias**2) < 4 * spread
    assert abs(variance.value - sigma**2) < 4 * variance.sd < 0.2 * sigma**2


def test_shared_random_numbers_resolve_a_bias_that_independent_passes_cannot() -> None:
    exact = truth() + noise(8, 1.0, 5)
    other = exact + 1e-3 + noise(8, 1e-3, 6)
    alone, _ = bias_and_variance(other, truth() + noise(2, 0.1, 7), np.ones(SHAPE))
    paired = paired_bias(other, exact, np.ones(SHAPE))
    assert not alone.resolved and paired.resolved
    assert abs(paired.value - 1e-6) < 4 * paired.sd
    assert paired_bias(exact, exact, np.ones(SHAPE)) == Estimate(0.0, 0.0)


def test_squared_error_is_free_of_the_references_noise_and_that_noise_is_known() -> None:
    sets = [truth() + noise(2, 0.3, seed) for seed in range(60)]
    errors = [squared_error(truth() + 0.1, halves, np.ones(SHAPE)) for halves in sets]
    assert np.mean(errors) == pytest.approx(0.01, abs=4 * np.std(errors) / math.sqrt(60))
    assert np.mean([reference_variance(h, np.ones(SHAPE)) for h in sets]) == pytest.approx(0.09 / 2, rel=0.03)


# Results of one scene

COUNTS = Counts((SHAPE[1], SHAPE[0]), short=(1, 2), repeats=2, pass_samples=4, passes=4, reference=64)


def rendered(bias: float, seconds_a_sample: float, sigma: float = 0.4) -> Passes:
    """Pictures of a camera whose variance is sigma^2 / samples; all cameras draw the same noise."""
    own: list[Picture] = []
    for k, (samples, _) in enumerate(COUNTS.jobs):
        own.append(truth() + bias + noise(1, sigma / math.sqrt(samples), 50 + k)[0])
    return own, [seconds_a_sample * n for n, _ in COUNTS.jobs]


def rows(cameras: Sequence[tuple[str, float, float]]) -> dict[str, Row]:
    halves, exact = list(truth() + noise(2, 0.01, 9)), rendered(0.0, cameras[0][2])
    return {name: camera_row(name, rendered(bias, s), exact, halves, COUNTS) for name, bias, s in cameras}


@pytest.fixture(scope="module")
def scene() -> dict[str, Row]:
    return rows([("exact", 0.0, 0.02), ("mlp-16x2", 0.0, 0.01), ("thin lens", 0.2, 0.01)])


def test_a_camera_that_gives_the_exact_pictures_has_neither_bias_nor_flip(scene: dict[str, Row]) -> None:
    same, biased = scene["mlp-16x2"], scene["thin lens"]
    assert same["bias2"] == {"value": 0.0, "sd": 0.0} and same["flip_paired"] == 0.0
    weight = float(np.mean(1 / (truth() ** 2 + 0.01)))  # the noise is the same and cancels
    assert biased["bias2"]["value"] == pytest.approx(0.04 * weight, rel=0.05)
    assert biased["flip_paired"] > 0.05


def test_after_n_passes_the_variance_is_an_nth(scene: dict[str, Row]) -> None:
    for name, bias2 in (("exact", 0.0), ("thin lens", scene["thin lens"]["bias2"]["value"])):
        camera = scene[name]
        variance, (pass_s, _) = camera["variance"]["value"], camera["pass_s"]
        assert [error_after(camera, n * pass_s) - bias2 for n in (1, 2, 8)] == pytest.approx(
            [variance / n for n in (1, 2, 8)]
        )


def test_levels_hold_the_error_of_their_samples(scene: dict[str, Row]) -> None:
    weight = float(np.mean(1 / (truth() ** 2 + 0.01)))
    levels = scene["exact"]["levels"]
    assert [level["samples"] for level in levels] == [1, 2, 4, 8, 16]
    for level in levels:
        assert level["rel_mse"] == pytest.approx(weight * 0.16 / level["samples"], rel=0.2)
        assert level["seconds_min"] == pytest.approx(0.02 * level["samples"])
    assert [level["flip"] for level in levels] == sorted((level["flip"] for level in levels), reverse=True)
