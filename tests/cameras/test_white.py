"""White surroundings through every camera, at extremes too: 1 on the axis, off it what an integral of its own gives."""

from __future__ import annotations

import math

import lens_models
import numpy as np
import pytest
from camera_helpers import FILM, FISHEYES, KINDS, RADII, camera, film_value, jittered, light
from shipped import disc_irradiance

from neurolens.base import status as st
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThickLens, ThinLens
from neurolens.cameras.pinhole import PROJECTIONS
from neurolens.optics.paraxial import first_order


def expected(kind: str) -> np.ndarray:
    """Film values at `RADII`, none of them by the camera's own code."""
    if kind in FISHEYES:
        if kind == "fisheye-orthographic":
            return (RADII < 14.0).astype(float)
        theta = PROJECTIONS[kind.removeprefix("fisheye-")].angle(RADII / 14.0)
        return (np.sinc(theta / math.pi), 1 + 0 * theta, np.cos(theta / 2) ** 4)[FISHEYES.index(kind)]
    if kind == "pinhole":
        return (1 + (RADII / 50.0) ** 2) ** -2.0
    if kind in ("thin", "thick"):
        lens = lens_models.lens().at(focus_m=2.0, f_number=4.0)
        data = first_order(lens)
        assert lens.film_z_mm is not None
        image = camera("thin").image_distance_mm
        disc = (
            (6.25, image)
            if kind == "thin"
            else (data.exit_pupil_diameter_mm / 2, lens.film_z_mm - data.exit_pupil_z_mm)
        )
        irradiance = disc_irradiance(*disc, RADII)
        return irradiance / irradiance[0]
    return light().relative


@pytest.mark.parametrize("kind", KINDS)
def test_film_values_of_white_surroundings(kind: str) -> None:
    found = np.array([film_value(camera(kind), (0.8 * r, -0.6 * r), wavelength_nm=550.0) for r in RADII])
    assert film_value(camera(kind), (0.0, 0.0)) == pytest.approx(1, abs=1e-3)
    assert found / found[0] == pytest.approx(expected(kind), abs=1.2e-3)


@pytest.mark.parametrize("f_number", [0.7, 45.0])
def test_extreme_stops(f_number: float) -> None:
    """The closed form for ideal lenses, and 1 on the axis for the exact lens, whatever then is its stop."""
    wanted = disc_irradiance(50.0 / (2 * f_number), 50.0, RADII)
    for lens in (ThinLens(50.0, f_number, math.inf), ThickLens(50.0, f_number, math.inf)):
        found = [film_value(lens, (r, 0.0)) for r in RADII]
        assert found == pytest.approx(wanted / wanted[0], abs=5e-4)
    shot = {"film_mm": FILM, "focus_m": 2.0, "f_number": f_number, "bounds": lens_models.domain().bounds}
    pupil = "ellipses" if f_number > 1 else "outline"
    lens = ExactCamera(lens_models.lens(), **shot, pupil=pupil)  # type: ignore[arg-type]
    assert lens.settings["pupil"] == pupil
    assert film_value(lens, (0.0, 0.0)) == pytest.approx(1, abs=4e-3)
    assert 0 < film_value(lens, (17.5, 11.5)) < 1


@pytest.mark.parametrize("kind", KINDS)
def test_no_batch_is_too_small_or_too_large(kind: str) -> None:
    nothing = np.empty((2, 0), np.float32)
    for rays in (camera(kind).sample(nothing, nothing, nothing[0]), camera(kind).natural(nothing, nothing, nothing[0])):
        assert getattr(rays, "weight", rays).shape == (0,)
    count = 150_000
    film = np.tile(np.array([[1.0], [2.0]], np.float32), count)
    square, wavelength = np.tile(np.array([[0.3], [0.6]], np.float32), count), np.full(count, 550, np.float32)
    rays = camera(kind).sample(film, square, wavelength)
    assert rays.direction.shape == (3, count) and (rays.status == st.PASSED).all()
    assert np.ptp(rays.weight) <= 1e-5 and np.ptp(rays.direction, axis=1).max() <= 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_film_points_that_are_none_are_dark_and_finite(kind: str) -> None:
    bad = [math.nan, math.inf, -math.inf, 1e30, -3e38]
    film = np.array([[*bad, *bad, 0.0], [*bad, *[0.0] * 6]], np.float32)
    square, wavelength = np.full((2, 11), 0.3, np.float32), np.full(11, 550, np.float32)
    rays = camera(kind).sample(film, square, wavelength)
    assert (rays.weight[:10] == 0).all() and (rays.status[:10] == st.OUTSIDE_DOMAIN).all()
    assert rays.weight[10] > 0 and rays.status[10] == st.PASSED
    assert np.isfinite(rays.origin_m).all()
    assert np.linalg.norm(rays.direction, axis=0) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_rays_are_whole_wherever_they_pass(kind: str) -> None:
    """Over the film to its corners: unit directions, weights that are 0 where and only where a ray did not pass."""
    square, wavelength = jittered(64)
    film = (np.random.default_rng(2).random((2, 4096)) - 0.5).astype(np.float32) * np.array([FILM], np.float32).T
    film[:, :4] = np.array([[18, 18, -18, -18], [12, -12, 12, -12]])
    rays = camera(kind).sample(film, square, wavelength)
    passed = rays.status == st.PASSED
    assert np.linalg.norm(rays.direction[:, passed], axis=0) == pytest.approx(1, abs=1e-5)
    assert (rays.weight[passed] > 0).all() and (rays.weight[~passed] == 0).all()
    for numbers in (rays.origin_m, rays.direction, rays.weight):
        assert np.isfinite(numbers).all() and numbers.dtype == np.float32
    assert rays.status.dtype == np.int32
