"""The thick lens against first-order data, the thin lens, and imaging between conjugate planes."""

from __future__ import annotations

import math
from pathlib import Path

import lens_models
import numpy as np
import pytest
from camera_helpers import FILM, GAUSS, ROOT, at, camera, differences, film_rays, film_value, jittered

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.ideal import ThickLens, ThinLens
from neurolens.optics.apertures import Aperture
from neurolens.optics.lensfile import read_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.radiometry import disc_irradiance

RETROFOCUS = ROOT / "lenses" / "angenieux_retrofocus_35.toml"
TELEPHOTO = ROOT / "lenses" / "sigler_telephoto_100.toml"


def made(path: Path, focus_m: float = 2.0, **change: object) -> ThickLens:
    camera = make_camera(f"thick:{path}", Shot(FILM, focus_m, **change))  # type: ignore[arg-type]
    assert isinstance(camera, ThickLens)
    return camera


def test_with_planes_and_pupil_together_it_is_the_thin_lens() -> None:
    thin = ThinLens(50.0, 1.8, 0.7, FILM)
    thick = ThickLens(50.0, 1.8, 0.7, FILM)
    rays = film_rays(thin, 2000)
    a, b = thin.sample(*rays), thick.sample(*rays)
    np.testing.assert_allclose(a.direction, b.direction, atol=1e-6)
    np.testing.assert_allclose(a.origin_m, b.origin_m, atol=1e-7)
    np.testing.assert_allclose(a.weight, b.weight, rtol=1e-5)


@pytest.mark.parametrize("path", [GAUSS, RETROFOCUS, TELEPHOTO])
def test_rays_of_a_film_point_meet_at_the_focus_distance_and_fill_the_entrance_pupil(path: Path) -> None:
    focus_m, height = 2.0, 9.0
    camera = made(path, focus_m)
    square, wavelength = jittered(24)
    rays = camera.sample(at((height, 0.0), 576), square, wavelength)
    t = (-focus_m - rays.origin_m[2]) / rays.direction[2]
    met = rays.origin_m[:2] + t * rays.direction[:2]
    lens = read_lens(path).at(focus_m=focus_m)
    data = first_order(lens)
    assert lens.film_z_mm is not None
    image = lens.film_z_mm - data.rear_principal_z_mm
    separation = data.rear_principal_z_mm - data.front_principal_z_mm
    magnification = (1e3 * focus_m - separation - image) / image
    assert met[0] == pytest.approx(-1e-3 * height * magnification, rel=2e-4) and np.abs(met[1]).max() < 2e-5
    # On the plane of the entrance pupil the same rays fill its disc.
    t = (1e-3 * (data.entrance_pupil_z_mm - lens.film_z_mm) - rays.origin_m[2]) / rays.direction[2]
    place = 1e3 * (rays.origin_m[:2] + t * rays.direction[:2])
    radius = np.hypot(*place)
    assert radius.max() == pytest.approx(data.entrance_pupil_diameter_mm / 2, rel=0.01)
    assert np.mean(radius**2) == pytest.approx((data.entrance_pupil_diameter_mm / 2) ** 2 / 2, rel=0.02)


@pytest.mark.parametrize("path", [GAUSS, RETROFOCUS, TELEPHOTO])
def test_light_falls_off_as_that_of_the_exit_pupil(path: Path) -> None:
    """The irradiance of a uniform disc, at any height (Foote 1915), is that of the paraxial exit pupil."""
    camera = made(path, math.inf)
    data = first_order(read_lens(path).at(focus_m=math.inf))
    distance = data.rear_focal_z_mm - data.exit_pupil_z_mm
    heights = np.array([0.0, 10.0, 20.0])
    light = disc_irradiance(data.exit_pupil_diameter_mm / 2, distance, heights)
    found = [film_value(camera, (h, 0.0)) for h in heights]
    assert found == pytest.approx(light / light[0], abs=2e-4)


def test_a_telecentric_lens_has_no_falloff() -> None:
    """An entrance pupil in the front focal plane: every film point sees the same cone."""
    camera = ThickLens(50.0, 2.8, math.inf, FILM, principal_z_mm=(0.0, 20.0), entrance_pupil_z_mm=-50.0)
    assert [film_value(camera, p) for p in ((0.0, 0.0), (15.0, 10.0))] == pytest.approx([1, 1], abs=2e-4)


def test_differentials_are_finite_differences() -> None:
    camera = made(RETROFOCUS)
    film, square, wavelength = film_rays(camera, 500)
    moves = camera.sample_differentials(film, square, wavelength).differentials
    assert moves is not None
    found = np.concatenate([moves.origin_m, moves.direction])
    np.testing.assert_allclose(found, differences(camera, film, square, wavelength, 0.25), atol=3e-6)


def test_thick_lens_and_exact_lens_see_the_same_to_first_order() -> None:
    """Near the axis their rays meet at the same place, and the light is the same."""
    thick, exact = (camera(kind) for kind in ("thick", "exact"))
    square, wavelength = jittered(16)[0], np.full(256, 587.6, np.float32)
    lines = []
    for lens in (thick, exact):
        rays = lens.sample(at((1.0, 0.5), 256), square, wavelength)
        passed = rays.status == st.PASSED
        t = (-2.0 - rays.origin_m[2]) / rays.direction[2]
        lines.append((rays.origin_m + t * rays.direction)[:2, passed].mean(1))
    assert lines[0] == pytest.approx(lines[1], rel=5e-3)
    assert film_value(thick, (1.0, 0.5)) == pytest.approx(film_value(exact, (1.0, 0.5)), abs=2e-3)


def test_shapes_of_the_stop_keep_the_exposure() -> None:
    camera = made(GAUSS, aperture=Aperture(blades=5))
    assert film_value(camera, (0.0, 0.0)) == pytest.approx(1, abs=5e-3)
    square, wavelength = jittered(128)
    passed = camera.sample(at((3.0, 0.0), 128 * 128), square, wavelength).status == st.PASSED
    assert passed.mean() == pytest.approx(2.5 * math.sin(math.radians(72)) / math.pi, abs=0.01)


def test_settings_are_those_of_the_lens_in_its_state() -> None:
    camera = made(GAUSS, f_number=4.0, efl_mm=35.0)
    assert camera.settings["efl_mm"] == pytest.approx(35) and camera.settings["f_number"] == pytest.approx(4)
    assert camera.settings["lens"]["sha256"] == lens_models.lens().at(focal_length_mm=35.0).sha256


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: made(ROOT / "lenses" / "cooke_anamorphic_42.toml"), "cylinders"),
        (lambda: make_camera("thick:absent.toml", Shot(FILM, 2.0)), "absent.toml"),
        (lambda: make_camera("thick:model.onnx", Shot(FILM, 2.0)), "camera"),
        (lambda: make_camera(f"thick:{GAUSS}", Shot(FILM, 2.0, pupil="boxes")), "pupil"),
        (lambda: ThickLens(50.0, 2.0, 0.1), "focus_m"),
        (lambda: ThickLens(50.0, 2.0, 2.0, entrance_pupil_z_mm=math.nan), "entrance_pupil_z_mm"),
        (lambda: ThickLens(50.0, 2.0, 2.0, principal_z_mm=(0.0, math.inf)), "principal_z_mm"),
        (lambda: ThickLens(50.0, 2.0, 2.0, film_at_mm=-1.0), "film_at_mm"),
        # With x' = 50 the exit pupil of an entrance pupil at x = -50 lies in the film.
        (lambda: ThickLens(50.0, 2.0, 0.2, entrance_pupil_z_mm=-100.0), "exit pupil"),
    ],
)
def test_bad_arguments_are_named(make: object, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()  # type: ignore[operator]
