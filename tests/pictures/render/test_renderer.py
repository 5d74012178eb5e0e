"""Whole renders: exposure, orientation, the same numbers for everybody, errors."""

import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from render_helpers import FILM, PINHOLE, SIZE, THIN, WHITE, diffuse, lit_scene, scene
from shipped import whole

from neurolens.base.errors import InputError, ModelError, NeurolensError
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.pictures.render.renderer import Watch, render

LETTER_F = ["#####", "#....", "####.", "#....", "#....", "#...."]


def letter_quads() -> list[dict[str, Any]]:
    """The letter F of glowing squares 1 m wide on the plane z = -10, as one standing at the origin reads it."""
    rows, columns = len(LETTER_F), len(LETTER_F[0])
    square = {"edge_u_m": [1, 0, 0], "edge_v_m": [0, 1, 0], "emission": [1, 1, 1]}
    cells = [(r, c) for r in range(rows) for c in range(columns) if LETTER_F[r][c] == "#"]
    return [square | {"corner_m": [c - columns / 2, rows / 2 - r - 1, -10]} for r, c in cells]


@pytest.mark.parametrize("camera", [Pinhole(20.0, (10.0, 12.0)), ThinLens(20.0, 8.0, 10.0, (10.0, 12.0))])
@pytest.mark.parametrize("turn", [0, 1])
def test_letter_is_upright_and_unmirrored(camera: Any, turn: int) -> None:
    # The second pose looks at the letter's place from elsewhere: right of it, towards -x.
    quads = letter_quads()
    pose: dict[str, Any] = {"position_m": [0, 0, 0], "look_at_m": [0, 0, -10]}
    if turn:
        pose = {"position_m": [10, 0, -10], "look_at_m": [0, 0, -10]}
        for quad in quads:
            x, y, _ = quad["corner_m"]
            quad |= {"corner_m": [0, y, -10 - x], "edge_u_m": [0, 0, -1]}
    picture = render(scene(pose, quads=quads), camera, width=50, height=60, samples=16, max_depth=1).rgb[..., 1]
    cells = picture.reshape(6, 10, 5, 10).mean(axis=(1, 3))
    expected = np.array([[cell == "#" for cell in row] for row in LETTER_F])
    assert np.all(cells[expected] > 0.7) and np.all(cells[~expected] < 0.1)


@pytest.mark.parametrize("colour", [None, (0.7, 0.2, 0.05)])
@pytest.mark.parametrize("camera", [Pinhole(400.0, FILM), ThinLens(400.0, 4.0, 5.0, FILM)], ids=["pinhole", "thin"])
def test_white_is_white_and_a_wall_in_it_keeps_its_colour(camera: Any, colour: Any) -> None:
    wall = {"point_m": [0, 0, -1], "normal": [0, 0, 1], "material": "m"}
    tables = {} if colour is None else {"materials": {"m": diffuse(*colour)}, "planes": [wall]}
    rgb = render(scene(environment=WHITE, **tables), camera, width=48, height=32, samples=64).rgb
    assert rgb.mean(axis=(0, 1)) == pytest.approx(colour or (1, 1, 1), abs=5e-3)


def test_workers_do_not_change_the_picture_and_seeds_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", 1024)
    made, camera, options = lit_scene(), THIN, SIZE | {"samples": 40}
    one = render(made, camera, threads=1, **options)
    seen: list[float] = []
    two = render(made, camera, threads=2, progress=lambda fraction, left: seen.append(fraction), **options)
    assert np.array_equal(one.rgb, two.rgb)
    assert not np.array_equal(one.rgb, render(made, camera, threads=1, seed=1, **options).rgb)
    assert seen == sorted(seen) and all(0 < x <= 1 for x in seen)
    assert one.stats.paths == 36 * 24 * 40 and one.stats.passed_fraction == 1
    assert one.rgb.shape == (24, 36, 3) and one.rgb.dtype == np.float32


def test_cameras_share_their_noise() -> None:
    made = lit_scene()
    options = SIZE | {"samples": 4, "threads": 1}
    pinhole = render(made, PINHOLE, **options).rgb
    almost = render(made, ThinLens(50.0, 1e5, np.inf, FILM), **options).rgb
    other = render(made, PINHOLE, seed=1, **options).rgb
    assert np.abs(pinhole - almost).mean() < 0.02 * np.abs(pinhole - other).mean()


class HalfBlocked(Pinhole):
    """Blocks the left half of the film, with rays that must not be used."""

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        rays = super().sample(film_mm, pupil, wavelength_nm)
        blocked = film_mm[0] > 0
        direction = np.where(blocked, np.float32(np.nan), rays.direction)
        return CameraRays(rays.origin_m, direction, rays.weight, np.where(blocked, 6, 0).astype(np.int32))


def test_rays_that_do_not_pass_are_black_whatever_they_hold() -> None:
    result = render(lit_scene(), HalfBlocked(50.0, FILM), **SIZE, samples=4)
    assert not result.rgb[:, :18].any() and result.rgb[:, 18:].mean() > 0.5
    assert result.stats.passed_fraction == pytest.approx(0.5, abs=1e-6)


class Prism(Pinhole):
    """Disperses, and knows only part of the spectrum."""

    dispersive = True
    wavelength_nm = (450.0, 650.0)


class Raising(Pinhole):
    """Fails as told."""

    error: Exception = Exception()

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        raise self.error


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ModelError("a.onnx: cannot run it"), "a.onnx: cannot run it"),
        *whole((MemoryError("2 TB"), "a worker ran out of memory (2 TB)")),
        *whole((ValueError("x" * 10_000), "a fault of neurolens: ValueError: xxx")),
        (RuntimeError("no rays today"), "a fault of neurolens: RuntimeError: no rays today (test_renderer.py:"),
    ],
)
def test_what_a_worker_raises_is_one_line(error: Exception, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", 64)
    camera = Raising(50.0, FILM)
    camera.error = error
    with pytest.raises(NeurolensError) as failed:
        render(scene(environment=WHITE), camera, **SIZE, samples=1, threads=2)
    assert str(failed.value).startswith(said) and len(str(failed.value).splitlines()) == 1


class Killed(Pinhole):
    """Takes its process along."""

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        if len(wavelength_nm) == 4 * 8:  # in the last pass
            os.kill(os.getpid(), signal.SIGKILL)
        return super().sample(film_mm, pupil, wavelength_nm)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="workers are threads")
def test_a_killed_worker_ends_the_render_and_what_was_done_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", 64)
    part, camera = tmp_path / "a.exr.part", Killed(50.0, FILM)
    options = SIZE | {"samples": 40, "threads": 2}
    with pytest.raises(NeurolensError, match=r"killed by signal 9: did the memory run out\?.* kept in .*a\.exr\.part"):
        render(scene(environment=WHITE), camera, watch=Watch(checkpoint=part), **options)
    with np.load(part, allow_pickle=False) as kept:
        assert kept["done"].min() >= 1 and kept["done"].max() == 2


def test_errors_are_clear() -> None:
    made, small = scene(environment=WHITE), SIZE | {"samples": 1}
    for change, field in (
        ({"samples": 0}, "samples"),
        ({"samples": 1 << 40}, "samples.*at most 1048576"),
        ({"threads": 0}, "threads"),
        ({"width": 20}, "width x height"),
        ({"width": 3_000_000, "height": 2_000_000}, "width x height.*164 bytes"),
    ):
        with pytest.raises(InputError, match=field):
            render(made, PINHOLE, **(small | change))
    with pytest.raises(InputError, match="450-650 nm"):
        render(made, Prism(50.0, FILM), **small)
    narrow = scene({"wavelengths_nm": [460, 640]}, environment=WHITE)
    assert render(narrow, Prism(50.0, FILM), **small).rgb.shape == (24, 36, 3)
