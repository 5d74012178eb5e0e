"""Whether what plans are judged by tells what was done to a picture, and a case of each table."""

import numpy as np
import pytest

from experiments.plan_errors import moved

SIDE, SEEDS = 56, 4


def pictures(shift: tuple[float, float], blur_px: float, gain: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Renders of a wavy picture, and of the same moved by `shift` (right, down), spread and brighter."""
    rng = np.random.default_rng(2)
    waves = [(rng.normal(0, 0.35, 2), rng.random() * 6.3, rng.random()) for _ in range(14)]
    y, x = np.mgrid[:SIDE, :SIDE]

    def seen(right: float, down: float, variance: float) -> np.ndarray:
        return 4 + sum(
            a * np.exp(-0.5 * variance * (k @ k)) * np.cos(k[0] * (x - right) + k[1] * (y - down) + p)
            for k, p, a in waves
        )  # fmt: skip

    own, made = seen(0, 0, 0.5), (1 + gain) * seen(*shift, 0.5 + blur_px**2)
    grain = rng.normal(0, noise, (SEEDS, SIDE, SIDE, 3))  # as of the same random numbers, mostly the same
    more = rng.normal(0, noise / 4, grain.shape)
    return own[None, ..., None] + grain, made[None, ..., None] + grain + more


@pytest.mark.parametrize("size", [0.05, 0.25, 1.0])
def test_a_shift_is_found(size: float) -> None:
    found = moved(*pictures((0.6 * size, -0.8 * size), 0.0, 0.0, 0.02), blur_px=0.0)
    assert found.px == pytest.approx(size, rel=0.1, abs=3 * found.noise_px) and found.noise_px < 0.01


def test_a_blur_is_found_as_the_way_that_light_moves() -> None:
    exact, blurred = pictures((0.0, 0.0), 0.8, 0.0, 0.02)
    for before in (0.0, 2.0):  # RMS distance from the centroid: sqrt 2 of the width along an axis
        wanted = np.sqrt(before**2 + 2 * 0.8**2) - before
        assert moved(exact, blurred, before).px == pytest.approx(wanted, rel=0.12)


def test_light_alone_moves_nothing() -> None:
    found = moved(*pictures((0.0, 0.0), 0.0, 0.03, 0.02), blur_px=0.0)
    assert found.gain == pytest.approx(0.03, rel=0.05) and found.px < 0.02


def test_noise_is_no_shift_and_flat_pictures_tell_nothing() -> None:
    exact, same = pictures((0.0, 0.0), 0.0, 0.0, 0.3)
    found = moved(exact, same, 1.0)
    assert found.px < 0.02 and 0 < found.noise_px < 0.1
    flat = np.ones((SEEDS, SIDE, SIDE, 3))
    assert np.isinf(moved(flat, 1.1 * flat, 1.0).noise_px)
