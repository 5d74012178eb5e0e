"""The pupils of the literature: shapes are filled evenly, hold what they promise, and pass what the theses say."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from shipped import tabled

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Lens
from neurolens.optics.pupil_methods import (
    RadialPupil,
    global_exit_pupil,
    hull_disc,
    passes_through,
    pixel_pupils,
    radial_bounds,
    rear_rim,
    wu_exit_pupil,
)
from neurolens.optics.radiometry import film_light

FILM_RADIUS = 18.0
METHODS: dict[str, Callable[[Lens, float], RadialPupil]] = {
    "hull": hull_disc,
    "wu": wu_exit_pupil,
    "pixel disc": lambda lens, radius: pixel_pupils(lens, radius, "disc"),
    "pixel ellipse": lambda lens, radius: pixel_pupils(lens, radius, "ellipse"),
    "boxes": lambda lens, radius: radial_bounds(lens, radius, "box"),
}


@cache
def lens(name: str, efl_mm: float, f_number: float) -> Lens:
    return tabled(name).at(focal_length_mm=efl_mm, f_number=f_number)


def rate_and_light(some: Lens, pupil: RadialPupil, count: int = 20_000) -> tuple[float, float]:
    """Share of rays that pass, and mean irradiance over radiance, over film radii uniform on the disc."""
    rng = np.random.default_rng(0)
    film = np.stack([FILM_RADIUS * np.sqrt((np.arange(count) + 0.5) / count), np.zeros(count)])
    points, area = pupil.sample(film, rng.random((2, count)))
    passed = passes_through(some, pupil.pupil_z_mm)(film[0], points) & (area > 0)
    assert some.film_z_mm is not None
    distance = some.film_z_mm - pupil.pupil_z_mm
    cos2 = 1 / (1 + (((points - film) / distance) ** 2).sum(0))
    return float(passed.mean()), float((passed * area * cos2**2).mean() / distance**2)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("case", [("tronnier_double_gauss_100", 100.0, 4.0), ("muller_fisheye_100", 14.0, 5.6)])
def test_no_light_is_lost(name: str, case: tuple[str, float, float]) -> None:
    some = lens(*case)
    rate, light = rate_and_light(some, METHODS[name](some, FILM_RADIUS))
    radius = FILM_RADIUS * np.sqrt((np.arange(24) + 0.5) / 24)
    true = film_light(some, np.concatenate([[0.0], radius]))
    expected = (true.irradiance / true.transmittance)[1:].mean()
    assert light == pytest.approx(expected, rel=0.015)
    assert 0.6 < rate <= 1


def test_the_paraxial_exit_pupil_loses_light_off_the_axis() -> None:
    some = lens("tronnier_double_gauss_100", 100.0, 4.0)
    rate, light = rate_and_light(some, global_exit_pupil(some, FILM_RADIUS))
    assert rate > 0.99
    assert light < 0.99 * rate_and_light(some, hull_disc(some, FILM_RADIUS))[1]


def test_wu_finds_the_stop_where_it_is_seen() -> None:
    """For a lens that hardly vignettes and images its stop well the search ends at the paraxial exit pupil."""
    some = lens("tronnier_double_gauss_100", 100.0, 8.0)
    found, paraxial = wu_exit_pupil(some, 5.0), global_exit_pupil(some, 5.0)
    assert found.pupil_z_mm == pytest.approx(paraxial.pupil_z_mm, abs=5)
    assert found.along[0] == pytest.approx(paraxial.along[0], rel=0.05)


def test_the_rate_halves_with_each_stop() -> None:
    """Steinert 2009, Table 5.3: Tessar 50 mm, one pixel, the rear rim's disc: 64.31, 35.8, 18.1, 9.0 percent."""
    radius = math.hypot(128, 96) * 36 / 512
    rng = np.random.default_rng(0)
    square = rng.random((2, 40_000))
    for f_number, theirs in ((2.8, 64.31), (4.0, 35.8), (5.6, 18.1), (8.0, 9.0)):
        some = lens("brendel_tessar_100", 50.0, f_number)
        rim = rear_rim(some, radius)
        film = np.repeat([[radius], [0.0]], square.shape[1], axis=1)
        points, _ = rim.sample(film, square)
        passed = passes_through(some, rim.pupil_z_mm)(film[0], points)
        assert 100 * passed.mean() == pytest.approx(theirs, rel=0.05)


@pytest.mark.parametrize("shape", ["box", "ellipse"])
def test_shapes_are_filled_evenly_and_turn_with_the_film_point(shape: str) -> None:
    pupil = RadialPupil(0.0, 10.0, np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([1.0, -1.0]), shape)  # type: ignore[arg-type]
    square = np.random.default_rng(0).random((2, 200_000))
    angle = 1.1
    film = np.repeat(4 * np.array([[math.cos(angle)], [math.sin(angle)]]), square.shape[1], axis=1)
    points, area = pupil.sample(film, square)
    u = math.cos(angle) * points[0] + math.sin(angle) * points[1] - 1
    v = -math.sin(angle) * points[0] + math.cos(angle) * points[1]
    moment = 3 if shape == "box" else 4
    assert area == pytest.approx(12.0 if shape == "box" else 3 * math.pi)
    assert u.mean() == pytest.approx(0, abs=0.02) and v.mean() == pytest.approx(0, abs=0.01)
    assert (u * u).mean() == pytest.approx(9 / moment, rel=0.01)
    assert (v * v).mean() == pytest.approx(1 / moment, rel=0.01)
    assert np.abs(u).max() <= 3 and np.abs(v).max() <= 1
    # A row of no light, and beyond the last row.
    assert (pupil.sample(1.5 * film, square)[1] == 0).all() and (pupil.sample(3 * film, square)[1] == 0).all()


@pytest.mark.parametrize("make", [hull_disc, wu_exit_pupil, METHODS["pixel disc"], METHODS["boxes"]])
def test_a_lens_without_a_film(make: Callable[[Lens, float], RadialPupil]) -> None:
    with pytest.raises(InputError, match="film_z_mm"):
        make(tabled("tronnier_double_gauss_100"), 10.0)
