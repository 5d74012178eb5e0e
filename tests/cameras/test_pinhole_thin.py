"""Pinhole and thin lens against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.sampling import concentric_disk
from neurolens.optics.film_plane import film_z_mm


def square_grid(side: int) -> np.ndarray:
    """Centres of a side x side grid on the unit square, [2, side^2] float32."""
    u = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(u, u)).reshape(2, -1).astype(np.float32)


def repeat(point: tuple[float, float], count: int) -> np.ndarray:
    return np.repeat(np.array(point, np.float32)[:, None], count, axis=1)


def test_disk_map_is_uniform() -> None:
    disk = concentric_disk(square_grid(200))
    radius2 = np.sum(disk**2, axis=0)
    assert radius2.max() <= 1.0
    assert abs(radius2.mean() - 0.5) < 1e-3
    for radius in (0.2, 0.5, 0.8):
        assert abs(np.mean(radius2 < radius**2) - radius**2) < 5e-3
    assert np.all(concentric_disk(np.full((2, 1), 0.5, np.float32)) == 0)


@pytest.mark.parametrize("film", [(0.0, 0.0), (10.0, -5.0), (-18.0, 12.0)])
@pytest.mark.parametrize("focus_m", [0.3, 2.0, 30.0])
def test_thin_lens_rays_of_a_film_point_meet_at_the_focus_distance(film: tuple[float, float], focus_m: float) -> None:
    camera = ThinLens(50.0, 1.8, focus_m)
    pupil = square_grid(16)
    rays = camera.sample(repeat(film, pupil.shape[1]), pupil, np.full(pupil.shape[1], 550, np.float32))
    along = (-focus_m - rays.origin_m[2]) / rays.direction[2]
    met = rays.origin_m + along * rays.direction
    magnification = (1e3 * focus_m - camera.image_distance_mm) / camera.image_distance_mm
    expected = np.array([-film[0] * magnification, -film[1] * magnification]) * 1e-3
    assert np.abs(met[:2] - expected[:, None]).max() < 4e-7 * max(1.0, magnification)
    assert np.allclose(np.sum(rays.direction**2, axis=0), 1, atol=1e-6)
    assert np.all(rays.status == 0)
    assert rays.origin_m.dtype == rays.direction.dtype == rays.weight.dtype == np.float32


def test_thin_lens_at_infinity_gives_parallel_rays_towards_the_upside_down_scene() -> None:
    camera = ThinLens(50.0, 2.0, math.inf)
    pupil = square_grid(8)
    rays = camera.sample(repeat((10.0, 5.0), 64), pupil, np.full(64, 550, np.float32))
    assert np.ptp(rays.direction, axis=1).max() == 0
    assert rays.direction[0, 0] < 0 and rays.direction[1, 0] < 0 and rays.direction[2, 0] < 0
    assert np.allclose(rays.direction[:2, 0] / rays.direction[2, 0], [10 / 50, 5 / 50], atol=1e-6)


def test_conjugate_distances_obey_the_lens_equation() -> None:
    for focus_m in (0.2, 0.5, 3.0, 1e6):
        image = film_z_mm(50.0, 0.0, 0.0, focus_m)
        assert 1 / image + 1 / (1e3 * focus_m - image) == pytest.approx(1 / 50.0, rel=1e-12)


def test_weight_is_one_on_the_axis_and_the_fourth_power_of_the_cosine_off_it() -> None:
    pupil = square_grid(64)
    wavelength = np.full(pupil.shape[1], 550, np.float32)
    for camera in (ThinLens(50.0, 1.4, 1.0), ThinLens(50.0, 22.0, math.inf), Pinhole(50.0)):
        axis = camera.sample(repeat((0.0, 0.0), pupil.shape[1]), pupil, wavelength)
        assert axis.weight.mean() == pytest.approx(1, abs=2e-4)
    for narrow in (ThinLens(50.0, 64.0, math.inf), Pinhole(50.0)):
        corner = narrow.sample(repeat((18.0, 12.0), pupil.shape[1]), pupil, wavelength)
        assert corner.weight.mean() == pytest.approx(math.cos(math.atan(math.hypot(18, 12) / 50)) ** 4, rel=1e-3)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: ThinLens(50.0, 1.8, 0.19), "focus_m"),
        (lambda: ThinLens(-50.0, 1.8, 2.0), "focal_mm"),
        (lambda: ThinLens(50.0, 0.0, 2.0), "f_number"),
        (lambda: ThinLens(50.0, 2.0, math.nan), "focus_m"),
        (lambda: Pinhole(math.inf), "focal_mm"),
        (lambda: Pinhole(50.0, (36.0, 0.0)), "film_mm height"),
    ],
)
def test_bad_arguments_are_named(make: object, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()  # type: ignore[operator]
