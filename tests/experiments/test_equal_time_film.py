"""Film-space errors: known shifts of the film, closed forms of thin lenses, a real lens, what is refused."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import Any

import lens_models
import numpy as np
import pytest

from experiments.equal_time_errors import FilmMap, film_map
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera, CameraRays, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThinLens
from neurolens.optics.lensfile import read_lens

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
    return ExactCamera(lens, film_mm=(12.0, 6.0), focus_m=2.0, f_number=4.0)


def test_a_shift_behind_a_real_lens_is_found_through_its_aberrations(singlet: ExactCamera) -> None:
    found = mapped(singlet, Shifted(singlet, 3.0, 4.0))
    # The rays' own differentials hold aberrations; the pupil's outline moves with the film point, by little.
    assert found.median_um == pytest.approx(np.full((4, 6), 5.0), rel=0.02)


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


def test_dark_film_is_not_a_number() -> None:
    thin = ThinLens(50.0, 2.0, 2.0, FILM)

    class Dark(Shifted):
        def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
            rays = self.camera.sample(film_mm, pupil, wavelength_nm)
            lost = np.where(film_mm[1] > 0, st.blocked(0, st.RIM), rays.status).astype(np.int32)
            return replace(rays, status=lost)

    found = mapped(thin, Dark(thin, 0, 0)).median_um
    assert np.isnan(found[2:]).all() and not found[:2].any()


def test_cameras_that_do_not_take_the_same_picture_are_refused() -> None:
    thin = ThinLens(50.0, 2.0, 2.0, FILM)
    with pytest.raises(InputError, match="film_mm"):
        mapped(thin, ThinLens(50.0, 2.0, 2.0, (36.0, 24.0)))
    with pytest.raises(InputError, match="focus_m"):
        mapped(thin, ThinLens(50.0, 2.0, 3.0, FILM))
