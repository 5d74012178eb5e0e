"""What the outlines promise of real lenses: nearly all rays pass, brightness is right, the dark costs nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import pytest

from neurolens.base import status as st
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.optics.apertures import Aperture
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.radiometry import film_light

ROOT = Path(__file__).parents[2]
FILM = (36.0, 24.0)
# Lens, focal length, f-number, least share of rays that pass.
LENSES = [
    ("laikin_double_gauss_50", 50.0, None, 0.995),
    ("laikin_double_gauss_50", 50.0, 11.0, 0.995),
    ("tronnier_double_gauss_100", 100.0, 4.0, 0.995),
    ("muller_fisheye_100", 14.0, 4.0, 0.99),
    ("muller_fisheye_100", 14.0, 8.0, 0.99),
    ("mizuguchi_fisheye_10", 10.5, 8.0, 0.97),
]
MODELS = ["laikin_double_gauss_50.ols-28", "muller_fisheye_100-14mm.ols-40", "thorlabs_lb1471_biconvex_50.ols-64"]


@cache
def exact(name: str, efl_mm: float, f_number: float | None) -> ExactCamera:
    lens = read_lens(ROOT / "lenses" / f"{name}.toml").at(focal_length_mm=efl_mm, f_number=f_number)
    return ExactCamera(lens, film_mm=FILM, focus_m=math.inf)


def film_rays(camera: ExactCamera | OnnxCamera, count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Random lit film points, squares and wavelengths."""
    rng = np.random.default_rng(seed)
    film = ((rng.random((2, count)) - 0.5) * np.array([camera.film_mm]).T).astype(np.float32)
    film = film[:, np.hypot(*film) <= camera.film.outline.film_radius_mm]
    low, high = camera.wavelength_nm or (587.6, 587.6)
    size = film.shape[1]
    return film, rng.random((2, size), np.float32), rng.uniform(low, high, size).astype(np.float32)


def lost_share(camera: ExactCamera | OnnxCamera, count: int, wider: float = 1.1) -> float:
    """Share of the light outside the outlines, by rays through outlines that much wider."""
    film, square, wavelength = film_rays(camera, count)
    outline = camera.film.outline
    wide = replace(outline, x=wider * outline.x, y=wider * outline.y)
    points, area = wide.sample(film, square, wavelength)
    passed = camera.film.scene(film, points, wavelength).status == st.PASSED
    return float((area * passed)[np.abs(2 * square - 1).max(0) > 1 / wider].sum() / (area * passed).sum())


@pytest.mark.parametrize(("name", "efl_mm", "f_number", "least"), LENSES)
def test_nearly_all_rays_of_lit_film_points_pass(
    name: str, efl_mm: float, f_number: float | None, least: float
) -> None:
    camera = exact(name, efl_mm, f_number)
    rays = camera.sample(*film_rays(camera, 40_000))
    assert (rays.status == st.PASSED).mean() >= least
    assert lost_share(camera, 40_000) <= 2e-4


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("f_number", [None, 8.0])
def test_models_that_ship_find_their_outlines_when_a_camera_is_made(name: str, f_number: float | None) -> None:
    model = load_model(ROOT / "models" / f"{name}.onnx")
    camera = OnnxCamera(model, film_mm=FILM, focus_m=math.inf, f_number=f_number)
    rays = camera.sample(*film_rays(camera, 40_000))
    assert (rays.status == st.PASSED).mean() >= 0.99
    assert lost_share(camera, 40_000) <= 2e-4


@pytest.mark.parametrize(
    ("name", "efl_mm", "f_number"), [("laikin_double_gauss_50", 50.0, None), ("muller_fisheye_100", 14.0, 4.0)]
)
def test_brightness_is_the_integral_over_the_pupil(name: str, efl_mm: float, f_number: float | None) -> None:
    """The mean weight over one table of pupil samples, the same for every film point, against an integral that knows
    nothing of outlines: within 0.2% of the axis everywhere, where the light falls to a fifth."""
    camera = exact(name, efl_mm, f_number)
    end = camera.film.outline.film_radius_mm
    radius = np.array([0.0, 0.3, 0.62, 0.8, 0.9, 0.97]) * end
    side = (np.arange(96) + 0.5) / 96
    square = np.stack([a.ravel() for a in np.meshgrid(side, side)]).astype(np.float32)
    count = square.shape[1]
    light = film_light(camera.lens, radius, wavelength_nm=550.0)
    for i, r in enumerate(radius):
        azimuth = 0.4 + i
        film = np.repeat(np.array([[r * math.cos(azimuth)], [r * math.sin(azimuth)]], np.float32), count, axis=1)
        mean = camera.sample(film, square, np.full(count, 550, np.float32)).weight.mean(dtype=np.float64)
        if i == 0:
            axis = mean
        assert mean / axis == pytest.approx(light.relative[i], abs=0.002)
    assert axis == pytest.approx(1, abs=0.005)  # the exposure is a mean over wavelengths


def test_the_dark_costs_nothing() -> None:
    """No ray is traced for a film point that nothing reaches."""
    camera = exact("muller_fisheye_100", 14.0, 8.0)
    traced: list[int] = []
    scene = camera.film.scene

    def counting(film: np.ndarray, pupil: np.ndarray, wavelength_nm: np.ndarray) -> object:
        traced.append(film.shape[1])
        return scene(film, pupil, wavelength_nm)

    rng = np.random.default_rng(0)
    film = ((rng.random((2, 5000)) - 0.5) * 60).astype(np.float32)
    square, wavelength = rng.random((2, 5000), np.float32), np.full(5000, 550, np.float32)
    expected = camera.sample(film, square, wavelength)
    camera.film.scene = counting  # type: ignore[assignment]
    try:
        rays = camera.sample(film, square, wavelength)
    finally:
        camera.film.scene = scene
    lit = camera.film.outline.sample(film, square, wavelength)[1] > 0
    assert lit.sum() == pytest.approx((np.hypot(*film) <= camera.film.outline.film_radius_mm).sum(), abs=5)
    assert 0.1 < lit.mean() < 0.6 and sum(traced) == lit.sum()
    dark = ~lit
    assert (rays.status[dark] == st.OUTSIDE_DOMAIN).all() and (rays.weight[dark] == 0).all()
    assert np.linalg.norm(rays.direction, axis=0) == pytest.approx(1, abs=1e-5)
    # Rays of the lit are those that they are when asked for alone.
    alone = camera.sample(film[:, lit], square[:, lit], wavelength[lit])
    assert np.array_equal(rays.direction[:, lit], alone.direction) and np.array_equal(rays.weight[lit], alone.weight)
    assert np.array_equal(rays.origin_m, expected.origin_m)


def test_exact_and_model_sample_the_same_pupil() -> None:
    """The outlines of a lens and of its model agree as closely as the two agree on which rays pass."""
    exact_camera = ExactCamera(
        lens_models.lens(), film_mm=FILM, focus_m=2.0, f_number=4.0, bounds=lens_models.domain().bounds
    )
    model = OnnxCamera(load_model(lens_models.exported("invariants")), film_mm=FILM, focus_m=2.0, f_number=4.0)
    rays = film_rays(exact_camera, 20_000)
    (a, area), (b, _) = (c.film.outline.sample(*rays) for c in (exact_camera, model))
    radius = np.sqrt(area / math.pi)
    assert np.quantile(np.hypot(*(a - b)) / radius, 0.99) < 0.02


def test_blades_and_cylinders_are_held() -> None:
    """A bladed stop passes its share of the circle about it; a lens with cylinders passes what it does at any
    azimuth."""
    lens = read_lens(ROOT / "lenses" / "tronnier_double_gauss_100.toml").at(f_number=8.0)
    camera = ExactCamera(lens.with_aperture(Aperture(blades=5)), film_mm=FILM, focus_m=math.inf)
    passed = camera.sample(*film_rays(camera, 40_000)).status == st.PASSED
    # Area of a regular pentagon over that of its circle: 5/2 sin(72 deg) / pi; Willi 2021, Table 6.3: 76.6%.
    assert passed.mean() == pytest.approx(2.5 * math.sin(math.radians(72)) / math.pi, abs=0.01)
    rows = (
        Surface(40.0, 3.0, 16.0, 1.5, cylinder="x"),
        Surface(math.inf, 1.0, 16.0),
        Surface(math.inf, 1.0, 9.0, stop=True),
        Surface(60.0, 3.0, 14.0, 1.6),
        Surface(-60.0, 30.0, 14.0),
    )
    anamorphic = ExactCamera(Lens("anamorphic", "", rows, 4.0).at(), film_mm=(20.0, 15.0), focus_m=math.inf)
    passed = anamorphic.sample(*film_rays(anamorphic, 20_000)).status == st.PASSED
    assert passed.mean() > 0.9
    assert lost_share(anamorphic, 40_000) <= 3e-4
