"""Image error: closed forms of the relative MSE, what FLIP must obey, the noise floor, bad input."""

import math
import sys

import numpy as np
import pytest

from neurolens.base.errors import InputError, NeurolensError
from neurolens.pictures.render.colour import linear_to_srgb
from neurolens.studies import scenes


@pytest.fixture
def picture() -> np.ndarray:
    """A smooth 24 x 32 linear picture with dark and bright parts."""
    y, x = np.mgrid[:24, :32] / 32
    return np.stack([0.05 + 0.6 * x, 0.4 + 0.3 * np.sin(9 * y), 0.2 + 0.5 * x * y], axis=2)


def noisy(picture: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    return picture + sigma * np.random.default_rng(seed).normal(size=picture.shape)


@pytest.mark.parametrize(("level", "offset", "eps"), [(1.0, 0.1, 0.01), (0.0, 0.1, 0.01), (20.0, -2.0, 1e-4)])
def test_relative_mse_of_a_constant_offset(
    level: float, offset: float, eps: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes, "EPS", eps)
    reference = np.full((5, 7, 3), level)
    expected = offset**2 / (level**2 + eps)
    assert scenes.rel_mse(reference + offset, reference) == pytest.approx(expected, rel=1e-12)


def test_srgb_curve_at_known_points() -> None:
    linear = np.array([-1.0, 0.0, 0.0031308, 0.2140411, 1.0, 9.0])
    assert linear_to_srgb(linear) == pytest.approx([0, 0, 0.04045, 0.5, 1, 1], abs=2e-5)


def test_flip_grows_with_noise_is_symmetric_and_bounded(picture: np.ndarray) -> None:
    assert scenes.rel_mse(picture, picture) == scenes.flip(picture, picture) == 0.0
    errors = [scenes.flip(noisy(picture, sigma, 1), picture) for sigma in (0.01, 0.03, 0.1, 0.3)]
    assert errors == sorted(errors) and errors[0] > 0 and errors[-1] < 1
    test = noisy(picture, 0.1, 1)
    assert scenes.flip(test, picture) == pytest.approx(scenes.flip(picture, test), rel=1e-4)
    black, white = np.zeros((16, 16, 3)), np.ones((16, 16, 3))
    assert 0.9 < scenes.flip(white, black) <= 1.0


def test_flip_sees_what_the_display_shows(picture: np.ndarray) -> None:
    """Radiance above the clip differs for the relative MSE only; a lower exposure brings it back into view."""
    bright = picture + 2.0
    assert scenes.flip(2 * bright, bright) == 0.0
    assert scenes.flip(0.2 * bright, 0.1 * bright) > 0.1
    assert scenes.rel_mse(2 * bright, bright) > 0.5


def test_noise_floor_of_known_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two renders of level L with noise s: the mean of (a - b)^2 / b^2 is about 2 s^2 / L^2."""
    monkeypatch.setattr(scenes, "EPS", 1e-9)
    level, sigma = 1.0, 0.02
    renders = [noisy(np.full((64, 64, 3), level), sigma, seed) for seed in range(5)]
    floor = scenes.compare(renders, renders)
    assert floor.pairs == 5
    assert floor.noise_floor_rel_mse == pytest.approx(2 * sigma**2, rel=0.03)
    assert floor.noise_floor_flip > 0


def test_comparing_tells_a_true_camera_from_a_wrong_one(picture: np.ndarray) -> None:
    exact = [noisy(picture, 0.05, seed) for seed in range(4)]
    same = scenes.compare(exact, exact)
    assert same.flip_paired == same.paired_share == 0.0 and same.flip == same.noise_floor_flip
    other_noise = scenes.compare([noisy(picture, 0.05, 10 + seed) for seed in range(4)], exact)
    assert other_noise.paired_share == pytest.approx(1.0, abs=0.05)
    wrong = scenes.compare([np.roll(render, 4, axis=1) for render in exact], exact)
    assert wrong.paired_share > 1.3 and wrong.rel_mse > 2 * wrong.noise_floor_rel_mse


@pytest.mark.parametrize(
    ("test", "words"),
    [
        (np.zeros((4, 4)), "shape"),
        (np.zeros((0, 4, 3)), "shape"),
        (np.zeros((4, 5, 3)), "shape of the reference"),
        (np.full((4, 4, 3), math.nan), "not finite"),
        (np.zeros((4, 4, 3), dtype=np.uint8), "uint8"),
    ],
)
def test_bad_pictures_are_refused(test: np.ndarray, words: str) -> None:
    for measure in (scenes.rel_mse, scenes.flip):
        with pytest.raises(InputError, match=words):
            measure(test, np.ones((4, 4, 3)))


def test_without_flip_evaluator_the_extra_is_named(picture: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(NeurolensError, match=r"\.\[train\]"):
        scenes.flip(picture, picture)


def test_comparing_fewer_renders_uses_the_floor_of_the_same_pairs_and_a_floor_of_zero_gives_no_ratio(
    picture: np.ndarray,
) -> None:
    exact = [noisy(picture, 0.02 * (1 + seed), seed) for seed in range(4)]
    figures = scenes.compare(exact[:1], exact)
    assert figures.pairs == 1 and figures.paired_share == 0.0
    assert figures.noise_floor_flip == scenes.compare(exact, exact).noise_floor_flip
    figures = scenes.compare([picture * 1.1] * 4, [picture] * 4)
    assert figures.noise_floor_flip == 0.0 and figures.paired_share is None and figures.flip_paired > 0


def test_bad_counts_are_refused(picture: np.ndarray) -> None:
    with pytest.raises(InputError, match="at least 4"):
        scenes.compare([picture], [picture] * 3)
    with pytest.raises(InputError, match="surrogate renders"):
        scenes.compare([picture] * 5, [picture] * 4)
