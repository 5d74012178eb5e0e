"""Outlines of the pupil, of known shapes and of real lenses: nothing lost, hardly anything wasted, evenly filled."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from film_light import film_light
from shipped import whole

from neurolens.base import status as st
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera
from neurolens.cameras.pupil_outline import Passes, PupilOutline, PupilTable, outline_of
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.figures import Cylinder
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

RADIUS, SHIFT = 4.0, 0.45  # of the discs, and how fast they part, mm per mm of film radius
VISIBLE, ONE = (400.0, 700.0), (550.0, 550.0)


def disc(film: np.ndarray, pupil: np.ndarray, wavelength_nm: float) -> np.ndarray:
    """A disc whose radius grows with the wavelength and whose centre moves with the film point."""
    radius = RADIUS * (1 - 0.04 * ((550 / wavelength_nm) ** 2 - 1))
    return np.hypot(pupil[0] - 0.1 * film[0], pupil[1]) <= radius


def lens_shape(film: np.ndarray, pupil: np.ndarray, wavelength_nm: float) -> np.ndarray:
    """Two discs that part as the film point leaves the axis, until the light ends at 2 RADIUS / (2 SHIFT)."""
    shift = SHIFT * film[0]
    return (np.hypot(pupil[0] - shift, pupil[1]) <= RADIUS) & (np.hypot(pupil[0] + shift, pupil[1]) <= RADIUS)


def bean(film: np.ndarray, pupil: np.ndarray, wavelength_nm: float) -> np.ndarray:
    """A disc out of which another has bitten a piece: not convex."""
    return (np.hypot(*pupil) <= RADIUS) & (np.hypot(pupil[0] + 6, pupil[1]) >= 3.5)


def shifting_edge(film: np.ndarray, pupil: np.ndarray, wavelength_nm: float) -> np.ndarray:
    """A disc that a straight edge sweeps away near the end of the light, green last (lateral colour)."""
    edge = 20 * (film[0] - 9) + 3 * ((wavelength_nm - 550) / 150) ** 2
    return (np.hypot(*pupil) <= RADIUS) & (pupil[0] >= np.maximum(edge, 0) - RADIUS)


def table(film_radius: float, reach: float = 7.0, rows: int = 9) -> PupilTable:
    boxes = np.repeat(np.array([[-reach], [reach], [reach]], np.float32), rows, axis=1)
    return PupilTable(0.0, film_radius, boxes)


def found(passes: Passes, film_radius: float, wavelength_nm: tuple[float, float] = ONE) -> PupilOutline:
    outline = outline_of(table(film_radius), passes, wavelength_nm)
    assert outline is not None
    return outline


def rate_and_lost(outline: PupilOutline, passes: Passes, reach: float = 7.0, wider: float = 1.3) -> tuple[float, float]:
    """Share of the samples of random film points that pass, and share of the light outside the outline."""
    rng = np.random.default_rng(1)
    sent = hit = lost = light = 0.0
    for wavelength in np.linspace(outline.wavelength_nm[0], outline.wavelength_nm[-1], 7):
        square = rng.random((2, 40_000), np.float32)
        film = np.zeros_like(square)
        film[0] = outline.film_radius_mm * np.sqrt(rng.random(square.shape[1]))
        waves = np.full(square.shape[1], wavelength, np.float32)
        points, area = outline.sample(film, square, waves)
        passed = passes(film, points, wavelength)
        sent, hit = sent + (area > 0).sum(), hit + passed.sum()
        wide = PupilOutline(
            0.0, outline.film_radius_mm, outline.wavelength_nm, outline.centre, wider * outline.x, wider * outline.y
        )
        points, area = wide.sample(film, square, waves)
        passed = passes(film, points, wavelength)
        beyond = np.abs(2 * square - 1).max(0) > 1 / wider
        lost, light = lost + (area * (passed & beyond)).sum(), light + (area * passed).sum()
    return hit / sent, lost / light


@pytest.mark.parametrize(
    ("passes", "wavelength_nm", "least"),
    [
        (disc, VISIBLE, 0.995),
        (disc, ONE, 0.995),
        (lens_shape, ONE, 0.99),
        (shifting_edge, VISIBLE, 0.95),
        (bean, ONE, 0),
    ],
)
def test_nearly_every_ray_passes_and_hardly_any_light_is_lost(
    passes: Passes, wavelength_nm: tuple[float, float], least: float
) -> None:
    rate, lost = rate_and_lost(found(passes, 12.0, wavelength_nm), passes)
    assert rate >= least
    assert lost <= 1e-4


def test_mean_area_is_that_of_the_region() -> None:
    """Of the lens shape: 2 R^2 acos(d / 2R) - d/2 sqrt(4 R^2 - d^2) for discs whose centres are d apart."""
    outline = found(lens_shape, 12.0)
    side = (np.arange(256) + 0.5) / 256
    square = np.stack([a.ravel() for a in np.meshgrid(side, side)]).astype(np.float32)
    for film_radius in (0.0, 1.3, 4.0, 7.7):
        film = np.zeros_like(square)
        film[0] = film_radius
        _, area = outline.sample(film, square, np.full(square.shape[1], 550, np.float32))
        d = 2 * SHIFT * film_radius
        true = 2 * RADIUS**2 * math.acos(d / (2 * RADIUS)) - d / 2 * math.sqrt(4 * RADIUS**2 - d * d)
        assert true * (1 - 1e-4) <= area.mean(dtype=np.float64) <= true * 1.01 + 1e-3


def test_end_of_the_light() -> None:
    outline = found(lens_shape, 12.0)
    end = RADIUS / SHIFT
    assert 0.995 * end < outline.film_radius_mm <= end * (1 + 1e-6)
    film = np.array([[0.0, 3.0, 10.0, np.nan, -6.0], [0.0, -2.0, 2.0, 0.0, 0.0]], np.float32)
    _, area = outline.sample(film, np.full((2, 5), 0.3, np.float32), np.full(5, 550, np.float32))
    assert (area[[0, 1, 4]] > 0).all() and (area[[2, 3]] == 0).all()


def test_no_light_no_outline() -> None:
    assert outline_of(table(5.0), lambda film, pupil, w: np.zeros(film.shape[1], bool), ONE) is None


def test_samples_fill_the_polygon_evenly_with_the_density_stated() -> None:
    """Moments of the points, weighted by their areas, are those of the disc; unweighted nearly so."""
    outline = found(disc, 12.0)
    rng = np.random.default_rng(2)
    square = rng.random((2, 400_000), np.float32)
    film = np.repeat(np.array([[3.0], [4.0]], np.float32), square.shape[1], axis=1)
    points, area = outline.sample(film, square, np.full(square.shape[1], 550, np.float32))
    x, y = points - 0.1 * film
    for weight in (area, np.full_like(area, area.mean())):
        total = weight.sum(dtype=np.float64)
        assert (weight * x).sum() / total == pytest.approx(0, abs=0.02)
        assert (weight * y).sum() / total == pytest.approx(0, abs=0.02)
        for moment in (x * x, y * y):
            assert (weight * moment).sum() / total == pytest.approx(RADIUS**2 / 4, rel=0.01)
        assert (weight * x * y).sum() / total == pytest.approx(0, abs=0.03)
    assert np.std(area) < 0.03 * area.mean()
    assert area.mean() == pytest.approx(math.pi * RADIUS**2, rel=0.003)


def test_the_map_keeps_neighbours_together() -> None:
    """Strata of the square stay compact: no step in it moves a point by much more than a disk's map would."""
    outline = found(lens_shape, 12.0)
    side = (np.arange(400) + 0.5) / 400
    square = np.stack(np.meshgrid(side, side)).astype(np.float32)
    for film_radius in (0.0, 5.0, 8.5):
        film = np.zeros((2, square[0].size), np.float32)
        film[0] = film_radius
        points, _ = outline.sample(film, square.reshape(2, -1), np.full(square[0].size, 550, np.float32))
        points = points.reshape(2, 400, 400)
        size = np.ptp(points, axis=(1, 2)).max()
        for axis in (1, 2):
            step = np.linalg.norm(np.diff(points, axis=axis), axis=0) * 400 / size
            assert step.max() < 3.5


def test_outlines_turn_with_the_film_point() -> None:
    outline = found(lens_shape, 12.0)
    square = np.random.default_rng(3).random((2, 100), np.float32)
    waves = np.full(100, 550, np.float32)
    for angle in (0.7, 2.0, -1.0):
        film = np.repeat(5 * np.array([[math.cos(angle)], [math.sin(angle)]], np.float32), 100, axis=1)
        plain = np.repeat(np.array([[5.0], [0.0]], np.float32), 100, axis=1)
        turned, straight = (outline.sample(f, square, waves) for f in (film, plain))
        c, s = math.cos(angle), math.sin(angle)
        expected = np.stack([c * straight[0][0] - s * straight[0][1], s * straight[0][0] + c * straight[0][1]])
        assert np.abs(turned[0] - expected).max() < 1e-4
        assert turned[1] == pytest.approx(straight[1], rel=1e-4)


def test_numbers_outside_the_square_raise_nothing() -> None:
    outline = found(disc, 10.0, VISIBLE)
    strange = np.float32([math.nan, math.inf, -math.inf, -3.0, 7.0, 1.0])
    square = np.stack([strange, np.full_like(strange, 0.5)])
    film, wavelength = np.full((2, 6), 1.0, np.float32), np.full(6, 550, np.float32)
    for given in (square, square[::-1]):
        with np.errstate(all="ignore"):
            points, area = outline.sample(film, np.ascontiguousarray(given), wavelength)
        assert points.shape == (2, 6) and np.isnan(points[:, 0]).all() and np.isfinite(area).all()


ROOT = Path(__file__).parents[2]
FILM = (36.0, 24.0)
# Lens, focal length, f-number, least share of rays that pass.
LENSES = [
    ("laikin_double_gauss_50", 50.0, None, 0.995),
    ("mizuguchi_fisheye_10", 10.5, 8.0, 0.97),
    *whole(("muller_fisheye_100", 14.0, 4.0, 0.99)),
]


@cache
def exact(name: str, efl_mm: float, f_number: float | None) -> ExactCamera:
    lens = set_lens(read_lens(ROOT / "lenses" / f"{name}.toml"), focal_length_mm=efl_mm, f_number=f_number)
    return ExactCamera(lens, Shot(FILM, math.inf))


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


@pytest.mark.parametrize(
    ("name", "efl_mm", "f_number"), [("laikin_double_gauss_50", 50.0, None), *whole(("muller_fisheye_100", 14.0, 4.0))]
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
    # The exposure is a mean over wavelengths, as glass and its coatings have a colour.
    spread = np.random.default_rng(7).permutation(np.linspace(400, 700, count, dtype=np.float32))
    white = camera.sample(np.zeros((2, count), np.float32), square, spread).weight.mean(dtype=np.float64)
    assert white == pytest.approx(1, abs=0.005)


def test_blades_and_cylinders_are_held() -> None:
    """A bladed stop passes its share of the circle about it; a lens with cylinders passes what it does at any
    azimuth."""
    lens = set_lens(read_lens(ROOT / "lenses" / "tronnier_double_gauss_100.toml"), f_number=8.0)
    camera = ExactCamera(lens.with_aperture(Aperture(blades=5)), Shot(FILM, math.inf))
    passed = camera.sample(*film_rays(camera, 40_000)).status == st.PASSED
    # Area of a regular pentagon over that of its circle: 5/2 sin(72 deg) / pi; Willi 2021, Table 6.3: 76.6%.
    assert passed.mean() == pytest.approx(2.5 * math.sin(math.radians(72)) / math.pi, abs=0.01)
    rows = (
        Surface(40.0, 3.0, 16.0, 1.5, figure=Cylinder(cylinder="x")),
        Surface(math.inf, 1.0, 16.0),
        Surface(math.inf, 1.0, 9.0, stop=True),
        Surface(60.0, 3.0, 14.0, 1.6),
        Surface(-60.0, 30.0, 14.0),
    )
    anamorphic = ExactCamera(set_lens(Lens("anamorphic", "", rows, 4.0)), Shot((20.0, 15.0), math.inf))
    passed = anamorphic.sample(*film_rays(anamorphic, 20_000)).status == st.PASSED
    assert passed.mean() > 0.9
    assert lost_share(anamorphic, 40_000) <= 3e-4
