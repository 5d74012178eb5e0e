"""Equal time: bias and variance of known renders, errors in the film's space, laws of time."""

import math
from copy import copy
from dataclasses import replace
from typing import Any

import lens_models
import numpy as np
import pytest
from numpy.typing import NDArray

from experiments.equal_time_errors import (
    Estimate,
    FilmMap,
    Law,
    bias_and_variance,
    crossover_s,
    film_map,
    paired_bias,
    reference_variance,
    squared_error,
)
from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera, CameraRays, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThinLens
from neurolens.lens.shot import Shot
from neurolens.readers.lensfile import read_lens

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


# Laws of time

EXACT = Law(0.0, 4.0, 2.0, ((0.5, 12.0), (1.0, 8.0)))


def test_after_n_passes_the_variance_is_an_nth() -> None:
    law = Law(0.5, 4.0, 2.0)
    assert [law.at(2.0 * n) - 0.5 for n in (1, 2, 8)] == [4.0, 2.0, 0.5]
    assert EXACT.at(0.7) == pytest.approx(12 * (8 / 12) ** (math.log(1.4) / math.log(2)))
    assert EXACT.at(0.4) == math.inf


def test_both_errors_are_equal_where_the_exact_lens_gets_ahead() -> None:
    fast = Law(1e-4, 4.0, 1.0, ((0.25, 12.0),))
    t = crossover_s(EXACT, fast)
    assert t == pytest.approx((4.0 * 2.0 - 4.0 * 1.0) / 1e-4)
    assert fast.at(t) == pytest.approx(EXACT.at(t))
    assert fast.at(0.5 * t) < EXACT.at(0.5 * t) and fast.at(2 * t) > EXACT.at(2 * t)


# Results of one scene


# Errors in the film's space

FILM = (36.0, 18.0)
LIGHT = (450.0, 650.0)


class Shifted:
    """A camera whose film lies wrong by some um, over part of it."""

    def __init__(self, camera: Any, x_um: float, y_um: float, right_only: bool = False) -> None:
        self.camera, self.shift, self.right_only = camera, np.float32([[1e-3 * x_um], [1e-3 * y_um]]), right_only
        self.name, self.dispersive, self.wavelength_nm = "shifted", camera.dispersive, camera.wavelength_nm
        self.film_mm, self.settings = camera.film_mm, camera.settings

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        shift = np.where(film_mm[0] > 0, self.shift, 0) if self.right_only else self.shift
        rays: CameraRays = self.camera.sample((film_mm + shift).astype(np.float32), pupil, wavelength_nm)
        return rays


def mapped(exact: Any, camera: Camera, **size: int) -> FilmMap:
    return film_map(exact, camera, wavelengths_nm=LIGHT, **{"columns": 6, "rows": 4, "samples": 16, **size})


@pytest.mark.parametrize("focus_m", [0.5, 3.0, math.inf])
def test_a_shift_of_the_film_is_found_in_micrometres(focus_m: float) -> None:
    thin = ThinLens(50.0, 1.8, focus_m, FILM)
    assert mapped(thin, thin).p99_um == 0.0  # of a thin lens, a thin lens is exact
    found = mapped(thin, Shifted(thin, 30.0, -40.0))
    assert found.median_um == pytest.approx(np.full((4, 6), 50.0), rel=1e-3)
    assert found.p99_um == pytest.approx(50.0, rel=1e-3)


def test_a_thin_lens_of_another_focal_length_scales_the_picture() -> None:
    """Both in focus at D: a film point x is seen at x (D - s') / s', so that the error is x times the ratio less 1."""
    exact, other = ThinLens(50.0, 2.0, 2.0, FILM), ThinLens(51.0, 2.0, 2.0, FILM)
    sizes = [(2000 - c.image_distance_mm) / c.image_distance_mm for c in (exact, other)]
    x, y = np.meshgrid((np.arange(6) - 2.5) * FILM[0] / 6, (np.arange(4) - 1.5) * FILM[1] / 4)
    expected = 1000 * np.hypot(x, y) * (1 - sizes[1] / sizes[0])
    assert mapped(exact, other).median_um == pytest.approx(expected, rel=1e-3)


def test_the_map_is_turned_as_the_picture_is() -> None:
    """Film at +x is the left of the picture (render.film.PixelGrid)."""
    thin = ThinLens(50.0, 2.0, 2.0, FILM)
    found = mapped(thin, Shifted(thin, 10.0, 0.0, right_only=True)).median_um
    assert found[:, :3] == pytest.approx(np.full((4, 3), 10.0), rel=1e-3) and not found[:, 3:].any()


@pytest.fixture(scope="module")
def singlet() -> ExactCamera:
    """f/4 biconvex lens, with much spherical aberration, coma and colour."""
    lens = read_lens(lens_models.LENSES / "thorlabs_lb1471_biconvex_50.toml")
    return ExactCamera(lens, Shot((12.0, 6.0), 2.0, 4.0))


def test_another_pupil_outline_is_no_error_of_the_rays(singlet: ExactCamera) -> None:
    """The same lens whose pupil is a tenth narrower: pupil points differ, and so would the rays."""
    other: Any = copy(singlet)
    other.film = copy(singlet.film)
    outline = singlet.film.outline
    narrower = replace(outline, x=np.float32(0.9) * outline.x, y=np.float32(0.9) * outline.y)
    other.film.outline = other.film.pupil = narrower
    point, light = np.full((2, 1), 0.3, np.float32), np.full(1, 550, np.float32)
    moved = other.sample(point, point, light).origin_m - singlet.sample(point, point, light).origin_m
    assert np.abs(moved).max() > 1e-5  # metres: it is another pupil
    assert mapped(singlet, other).p99_um == 0.0


def test_cameras_that_do_not_take_the_same_picture_are_refused() -> None:
    thin = ThinLens(50.0, 2.0, 2.0, FILM)
    with pytest.raises(InputError, match="film_mm"):
        mapped(thin, ThinLens(50.0, 2.0, 2.0, (36.0, 24.0)))
    with pytest.raises(InputError, match="focus_m"):
        mapped(thin, ThinLens(50.0, 2.0, 3.0, FILM))
