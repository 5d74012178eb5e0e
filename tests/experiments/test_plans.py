"""Whether what plans are judged by tells what was done to a picture, and a case of each table."""

from typing import Any

import numpy as np
import pytest

from experiments import lab, plans
from experiments.plan_errors import by_rays, fresh_places, fresh_prints, moved, pieces_of, rendered
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.lens.shot import Shot
from neurolens.plan.candidates import Choice
from neurolens.plan.footprints import distance_mm, places_of
from neurolens.readers.lensfile import read_lens
from neurolens.render.scene import load_scene

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


class Outlined:
    """A round stop of radius 10 mm, focused at 2 m, its pupil filled as a polygon of twice so many sides about it."""

    film_mm, wavelength_nm, dispersive = (36.0, 24.0), None, False

    def __init__(self, sides: int) -> None:
        turn = np.linspace(0, np.pi, sides + 1)
        x, y = 10 / np.cos(np.pi / sides / 2) * np.stack([np.cos(turn), np.sin(turn)])
        rows = [np.tile(v, (1, 2, 1)).astype(np.float32) for v in (x, y * (np.sin(turn) > 1e-9))]
        self._outline = PupilOutline(0.0, 30.0, (550.0,), np.zeros(2, np.float32), *rows)

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        point, area = self._outline.sample(film_mm, pupil, wavelength_nm)
        weight = np.where(np.hypot(*point) <= 10, area / (np.pi * 100), 0).astype(np.float32)
        flat = np.zeros_like(point[:1])
        goal = np.concatenate([-film_mm / 50 * 2, flat - 2])
        origin = 1e-3 * np.concatenate([point, flat])
        way = (goal - origin) / np.linalg.norm(goal - origin, axis=0)
        return CameraRays(origin, way, weight, np.zeros(len(weight), np.int8))


def test_two_outlines_of_one_pupil_are_one_camera() -> None:
    one, other = Outlined(32), Outlined(12)
    film = np.array([[0.0, 9.0], [0.0, -5.0]])
    places = places_of(one, film, np.array([0.8, np.inf]), np.full(1, 550.0), np.ones(1))
    seen, pixel = fresh_prints(one, places), 0.004
    plain = distance_mm(seen, fresh_prints(other, places), places.share) / pixel
    assert plain == pytest.approx([0.24, 0.14], rel=0.05)  # beside 132 and 88 pixels of blur
    assert (by_rays(other, one, places, seen, pixel, (1.0, 0.01))[0] < 0.35 * plain).all()
    assert (by_rays(other, one, places, seen, pixel, (0.3,))[0] == plain).all()


def test_a_decision_is_held_against_the_cheapest_that_holds() -> None:
    every = [Choice(n, n, 0.0, 0.0, cost, 1.0) for n, cost in (("a", 10.0), ("b", 20.0), ("c", 30.0))]
    rows = {"a": {"px": 0.3, "light": 0.0}, "b": {"px": 0.1, "light": 0.0}, "c": {"px": 0.0, "light": 0.02}}
    for budget, best, holds, cheapest, ratio in (
        (0.5, 1, True, "a", 2.0), (0.2, 0, False, "b", 0.5), (0.2, 2, False, "b", 1.5), (0.05, None, True, None, None),
    ):  # fmt: skip
        made = plans._decision("render", budget, None if best is None else every[best], every, rows)
        assert (made["holds"], made["cheapest"], made["ratio"]) == (holds, cheapest, ratio)
