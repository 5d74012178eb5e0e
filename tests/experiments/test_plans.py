"""Whether what plans are judged by tells what was done to a picture, and a case of each table."""

from typing import Any

import numpy as np
import pytest

from experiments import lab
from experiments.pictures import plans
from experiments.pictures.plan_errors import by_rays, fresh_places, fresh_prints, moved, pieces_of, rendered
from neurolens.cameras.build import make_camera
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.pictures.render.scene import load_scene

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
        own = before**2 + 1 / 6  # with the pixel's
        wanted = np.sqrt(own + 2 * 0.8**2) - np.sqrt(own)
        assert moved(exact, blurred, before).px == pytest.approx(wanted, rel=0.12)


class Shifted:
    """A camera whose picture is moved on its film by `by_mm` along x."""

    def __init__(self, camera: Any, by_mm: float) -> None:
        self._camera, self._by = camera, np.array([[by_mm], [0.0]], np.float32)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> Any:
        return self._camera.sample(film_mm + self._by, pupil, wavelength_nm)


def test_a_shifted_camera_is_as_far_off_by_rays_and_by_renders() -> None:
    scene = plans.suited(load_scene(lab.SCENES / "grid.toml"), read_lens("lenses/canon_gauss_35.toml"), 4.0, 2.0)
    shot = scene.settings.camera
    exact = make_camera("thin", Shot(shot.film_mm, 2.0, focal_length_mm=35.0, f_number=4.0))
    pixel = shot.film_mm[0] / shot.width
    other = Shifted(exact, 0.4 * pixel)
    places = fresh_places(scene, exact, np.ones(3), across=5)
    apart, light = by_rays(other, exact, places, fresh_prints(exact, places), pixel, (0.05,))
    assert apart == pytest.approx(0.4, rel=1e-2) and light.max() < 1e-3
    centres = pieces_of(scene, exact, 40, cells=(2, 1))
    renders = [rendered(scene, c, centres, 40, samples=16, seeds=3) for c in (exact, other)]
    for k in range(2):
        found = moved(renders[0][:, k], renders[1][:, k], blur_px=0.5)
        assert found.px == pytest.approx(0.4, rel=0.1, abs=3 * found.noise_px) and found.noise_px < 0.04
