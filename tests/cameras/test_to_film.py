"""From scene points to the film: there and back, and the same picture by light tracing as by path tracing."""

import math
from typing import Any

import lens_models
import numpy as np
import pytest
from camera_helpers import FILM, FISHEYES, GAUSS, camera, film_rays, jittered, tabled

from neurolens.base import status as st
from neurolens.cameras.build import make_camera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot

IDEAL = ("pinhole", "thin", "thick", *FISHEYES)


@pytest.fixture(scope="module")
def model() -> OnnxCamera:
    return OnnxCamera(
        load_model(lens_models.exported("invariants")), Shot(FILM, 2.0, 4.0, wavelength_nm=(400.0, 700.0))
    )


def points_on(rays: Any, seed: int = 0) -> np.ndarray:
    """A point on each ray, 0.2 to 10 m from its origin."""
    away = 10 ** np.random.default_rng(seed).uniform(-0.7, 1, rays.weight.size)
    return (rays.origin_m + away * rays.direction).astype(np.float32)


@pytest.mark.parametrize("kind", IDEAL)
def test_there_and_back_through_ideal_cameras(kind: str) -> None:
    """Their pupil sample is the point on the pupil, in both directions."""
    film, square, wavelength = film_rays(camera(kind), 4000)
    rays = camera(kind).sample(film, square, wavelength)
    ok = rays.status == st.PASSED
    back = camera(kind).to_film(points_on(rays), square, wavelength)
    assert (back.status[ok] == st.PASSED).all()
    np.testing.assert_allclose(back.film_mm[:, ok], film[:, ok], atol=2e-3)
    np.testing.assert_allclose(back.direction[:, ok], rays.direction[:, ok], atol=2e-5)
    assert (back.weight[ok] > 0).all()


def in_square(point: np.ndarray) -> np.ndarray:
    """The point of the unit square that goes to a point x + i y of the unit disc (Shirley and Chiu 1997)."""
    size, turn = np.abs(point), np.angle(point)
    quarter = np.round(turn / (np.pi / 2))
    across = size * (turn - quarter * np.pi / 2) * 4 / np.pi
    found = (size + 1j * across) * 1j**quarter
    return np.stack([found.real, found.imag]) / 2 + 0.5


@pytest.mark.parametrize("kind", ["exact", "model"])
def test_there_and_back_through_lenses(kind: str, model: OnnxCamera) -> None:
    """Aimed at the point of the front surface where the ray left, light comes back to the film point. No ray leaves
    outside the disc that the scene point's light is aimed at."""
    lens = model if kind == "model" else camera(kind)
    film, square, wavelength = film_rays(lens, 4000)
    rays = lens.sample(film, square, wavelength)
    points = points_on(rays)
    up = np.array([[0.0], [0.0], [lens.film.film_z_mm]])
    middle, edge = (
        lens._front_discs.aim(1e3 * points + up, np.full((2, 4000), [[v], [0.5]], np.float32)) for v in (0.5, 1)
    )
    way = edge[0] - middle[0] + 1j * (edge[1] - middle[1])
    aimed = in_square(
        (1e3 * (rays.origin_m[0] + 1j * rays.origin_m[1].astype(float)) - middle[0] - 1j * middle[1]) / way
    )
    passed = rays.status == st.PASSED
    assert aimed[:, passed].min() >= 0 and aimed[:, passed].max() <= 1
    # Rays that graze a rim on the way out may be stopped by it on the way back.
    ok = np.flatnonzero(passed & (np.abs(2 * square - 1).max(0) < 0.98))
    back = lens.to_film(points, np.clip(aimed, 0, 1).astype(np.float32), wavelength)
    found = back.status[ok] == st.PASSED
    assert found.mean() > (0.99 if kind == "model" else 0.9999)
    off = np.abs(back.film_mm - film)[:, ok[found]].max(0)
    assert np.quantile(off, 0.99) < 5e-3 and np.median(off) < 5e-4
    np.testing.assert_allclose(back.origin_m[:, ok], rays.origin_m[:, ok], atol=2e-6)


def by_paths(lens: Any, height_m: float, centre: tuple[float, float], half_m: float, side: int) -> np.ndarray:
    """Of a square light of radiance 1 facing the camera: value times film area, and its moments [3]."""
    square, wavelength = jittered(side)
    rng = np.random.default_rng(5)
    cells = rng.permutation(side * side)
    film = ((jittered(side, 6)[0][:, cells] - 0.5) * np.array([FILM]).T).astype(np.float32)
    rays = lens.sample(film, square, wavelength)
    with np.errstate(all="ignore"):
        t = (-height_m - rays.origin_m[2]) / rays.direction[2]
    met = rays.origin_m[:2] + t * rays.direction[:2]
    seen = (t > 0) & (np.abs(met - np.array([centre]).T) < half_m).all(0)
    return (np.concatenate([np.ones((1, film.shape[1])), film]) * rays.weight * seen).mean(1) * math.prod(FILM)


def by_light(lens: Any, height_m: float, centre: tuple[float, float], half_m: float, side: int) -> np.ndarray:
    """The same from points of the light."""
    square, wavelength = jittered(side)
    cells = np.random.default_rng(7).permutation(side * side)
    place = np.array([centre]).T + half_m * (2 * jittered(side, 8)[0][:, cells] - 1)
    points = np.concatenate([place, np.full((1, side * side), -height_m)]).astype(np.float32)
    found = lens.to_film(points, square, wavelength)
    on_film = (np.abs(found.film_mm) <= np.array([FILM]).T / 2).all(0)
    light = found.weight * -found.direction[2] * on_film * (2 * half_m) ** 2
    return (np.concatenate([np.ones((1, side * side)), found.film_mm]) * light).mean(1)


@pytest.mark.parametrize("kind", [*IDEAL, "exact", "model", "exact, no vignetting"])
def test_light_tracing_gives_what_path_tracing_gives(kind: str, model: OnnxCamera) -> None:
    """A square light out of focus and off the axis: its light on the film, and where that lies."""
    lens = model if kind == "model" else camera(kind.split(",")[0])
    if kind.endswith("vignetting"):
        lens = tabled("exact")
    scene = (1.2, (0.12, -0.08), 0.12) if kind not in FISHEYES else (0.6, (0.2, -0.15), 0.3)
    paths, light = by_paths(lens, *scene, 256), by_light(lens, *scene, 256)
    assert light[0] == pytest.approx(paths[0], rel=0.012)
    assert light[1:] / light[0] == pytest.approx(paths[1:] / paths[0], abs=0.1)


@pytest.mark.parametrize("lens", [ThinLens(50.0, 1.4, 1.0), make_camera(f"thick:{GAUSS}", Shot(FILM, 1.0))])
def test_a_small_light_in_focus_on_the_axis_in_closed_form(lens: Any) -> None:
    """Its image has the film value 1 and the area of the light times the square of the magnification."""
    square, wavelength = jittered(64)
    points = np.zeros((3, 64 * 64), np.float32)
    points[2] = -1.0
    found = lens.to_film(points, square, wavelength)
    assert np.abs(found.film_mm).max() < 1e-3
    light = float((found.weight * -found.direction[2]).mean(dtype=np.float64))
    step = 1e-3  # m; the magnification by the film points of two rays of one lens point
    moved = points.copy()
    moved[0] = step
    magnification = float(np.median(lens.to_film(moved, square, wavelength).film_mm[0])) / (1e3 * step)
    assert light == pytest.approx((1e3 * magnification) ** 2, rel=2e-3)


def test_three_blades_take_light_as_evenly_as_a_round_stop(model: OnnxCamera) -> None:
    """Over the exposure, which counts them, too: no ray at the edge of the round outline passes three blades."""
    blades = OnnxCamera(model.model, Shot(FILM, 2.0, 4.0, aperture=Aperture(3), wavelength_nm=(400.0, 700.0)))
    point, square = np.repeat([[0.0], [0.0], [-2.0]], 1 << 14, axis=1).astype(np.float32), jittered(1 << 7)[0]
    light = [made.to_film(point, square, np.full(1 << 14, 550, np.float32)).weight.mean() for made in (model, blades)]
    assert light[1] == pytest.approx(light[0], rel=0.02)


@pytest.mark.parametrize("kind", [*IDEAL, "exact", "model"])
def test_points_from_which_no_light_arrives(kind: str, model: OnnxCamera) -> None:
    lens = model if kind == "model" else camera(kind)
    bad = np.array(
        [[np.nan, 0, 0], [np.inf, 0, -2], [0, 0, np.inf], [0, 0, 0.0], [0.2, 0, 3.0], [0, 0, -2]], np.float32
    )
    found = lens.to_film(bad.T, np.full((2, 6), 0.5, np.float32), np.full(6, 550, np.float32))
    dark = 4 if kind in FISHEYES[:3] else 5  # three of them see what lies behind
    assert (found.status[:dark] != st.PASSED).all() and (found.weight[:dark] == 0).all()
    assert found.status[5] == st.PASSED and found.weight[5] > 0 and np.abs(found.film_mm[:, 5]).max() < 1e-3
    for numbers in (found.film_mm, found.origin_m, found.direction, found.weight):
        assert np.isfinite(numbers).all() and numbers.dtype == np.float32
    assert np.linalg.norm(found.direction, axis=0) == pytest.approx(1, abs=1e-5)
    nothing = np.empty((3, 0), np.float32)
    assert lens.to_film(nothing, nothing[:2], nothing[0]).weight.shape == (0,)


@pytest.mark.parametrize("kind", [*IDEAL, "exact", "model"])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_is_no_wavelength_has_one_answer(kind: str, model: OnnxCamera) -> None:
    """Outside the domain of every camera, dark and finite, both ways; thin lenses took it for light, exact ones for
    total reflection or for light."""
    lens = model if kind == "model" else camera(kind)
    film, square, wavelength = film_rays(lens, 12)
    film = 0.3 * film
    wavelength[:6] = [np.nan, np.inf, -np.inf, 0.0, -0.0, -550.0]
    rays = lens.sample(film, square, wavelength)
    assert (rays.status[6:] == st.PASSED).any()
    back = lens.to_film(points_on(lens.sample(film, square, np.full_like(wavelength, 550.0))), square, wavelength)
    for found in (rays, back):
        assert (found.status[:6] == st.OUTSIDE_DOMAIN).all() and (found.weight[:6] == 0).all()
        assert np.isfinite(found.direction).all() and np.isfinite(found.origin_m).all()
    assert np.isfinite(back.film_mm).all() and (back.status[6:] == st.PASSED).any()
    moved = lens.sample_differentials(film, square, wavelength)
    assert (moved.status == rays.status).all() and np.isfinite(moved.differentials.direction).all()
