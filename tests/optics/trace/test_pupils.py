"""Pupils of lenses, and how the literature samples them."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from film_light import film_light
from shipped import SOME, focused, tabled, whole

from experiments.accuracy.pupil_methods import (
    RadialPupil,
    hull_disc,
    passes_through,
    pixel_pupils,
    radial_bounds,
    rear_rim,
    wu_exit_pupil,
)
from neurolens.base.errors import InputError
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.check import film_edge_mm
from neurolens.optics.setting.pupils import camera_rays, image_radius_mm, pupil_bounds, pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays


def outside(lens: Lens, film_radius: float, rows: int, points: int) -> tuple[int, int, int]:
    """Passing rays of a brute-force search beyond the bounds; those outside their row's box; outside the disc.

    Half of the rays go everywhere within 1.5 rear radii of the axis on the rear vertex plane, where nothing is missed;
    few of them pass where the film is near (a cover glass) or the pupil far: the others keep to twice each row's box.
    """
    film_z = lens.film_z_mm
    bounds = pupil_bounds(lens, film_radius, (film_z, film_z), (587.5618, 587.5618), rows=rows, points=points)
    low, high, half = (torch.tensor(v, dtype=torch.float64) for v in (bounds.low_mm, bounds.high_mm, bounds.half_mm))
    g = torch.Generator().manual_seed(0)
    u = torch.rand((3, 60000), generator=g, dtype=torch.float64)
    film_x = film_radius * u[2].sqrt()
    row = (film_x / film_radius * (rows - 1)).round().long()
    a, b = torch.arange(30000), torch.arange(30000, 60000)
    r, turn = 1.5 * lens.surfaces[-1].semi_diameter_mm * u[0, a].sqrt(), 2 * math.pi * u[1, a]
    wide = camera_rays(film_x[a], 0 * r, film_z, r * turn.cos(), r * turn.sin(), float(lens.vertices_mm[-2]))
    middle, reach = (low + high)[row[b]] / 2, (high - low)[row[b]].clamp_min(0)
    x, y = middle + reach * (2 * u[0, b] - 1), 2 * half[row[b]] * (2 * u[1, b] - 1)
    near = camera_rays(film_x[b], 0 * x, film_z, x, y, bounds.pupil_z_mm)
    rays = Rays(*(torch.cat(c) for c in zip(wide, near, strict=True)))
    passed = trace(lens, rays).status == 0
    along = (bounds.pupil_z_mm - film_z) / rays.dz
    x, y = (film_x + along * rays.dx)[passed], (along * rays.dy)[passed]
    row = row[passed]
    in_row = (x >= low[row]) & (x <= high[row]) & (y.abs() <= half[row])
    return int(passed.sum()), int((~in_row).sum()), int((torch.hypot(x, y) > bounds.disc_mm).sum())


@pytest.mark.parametrize("name", SOME)
def test_bounds_hold_what_passes(name: str) -> None:
    lens = focused(name)
    passed, beyond_row, beyond_disc = outside(lens, image_radius_mm(lens)[0], rows=17, points=64)
    assert passed > 1000
    assert beyond_row <= 1e-4 * passed + 1
    assert beyond_disc <= 1e-4 * passed


@pytest.mark.parametrize("radius", [14.0, -14.0])
def test_bounds_hold_at_a_deep_rear_surface(radius: float) -> None:
    """The rear rim lies millimetres from the rear vertex plane: nearer to the film where the surface is hollow."""
    # A shell of nearly no power: every ray through its rear rim passes.
    rows = (Surface(math.inf, 9, 200, stop=True), Surface(radius + 1, 1.0, 28, 1.5), Surface(radius, 20, 26))
    lens = replace(Lens("deep", "", rows, 2.0), film_z_mm=30.0)
    passed, beyond_row, beyond_disc = outside(lens, 15.0, rows=17, points=64)
    assert passed > 1000
    assert beyond_row <= 1e-4 * passed + 1
    assert beyond_disc <= 1e-4 * passed


@pytest.mark.parametrize("name", SOME)
def test_the_pupil_plane_is_apart_from_the_film(name: str) -> None:
    lens = focused(name)
    rear = lens.vertices_mm[len(lens.surfaces) - 1]
    assert lens.film_z_mm - pupil_plane_z_mm(lens) >= 0.25 * (lens.film_z_mm - rear)


def test_no_ray_passes() -> None:
    """The stop is shut."""
    shut = focused("thorlabs_acl5040u_asphere_40").with_stop_radius(0.0)
    with pytest.raises(InputError, match="no ray passes"):
        pupil_bounds(shut, 10.0, (60.0, 60.0), (500.0, 500.0), rows=3, points=16)


def test_camera_rays_run_towards_the_lens() -> None:
    """Unit directions with dz < 0, for a pupil before and behind the film; through the pupil point."""
    x = torch.tensor([0.0, 3.0, -2.0], dtype=torch.float64)
    for plane in (10.0, 90.0):
        rays = camera_rays(x, 2 * x, 50.0, x + 1, x - 1, plane)
        assert (rays.dz < 0).all()
        torch.testing.assert_close(rays.dx**2 + rays.dy**2 + rays.dz**2, torch.ones_like(x), rtol=0, atol=1e-15)
        along = (plane - 50.0) / rays.dz
        torch.testing.assert_close(rays.x + along * rays.dx, x + 1, rtol=0, atol=1e-12)
        torch.testing.assert_close(rays.y + along * rays.dy, x - 1, rtol=0, atol=1e-12)


def test_image_radius_rules() -> None:
    tessar = focused("brendel_tessar_100")
    f = first_order(tessar).efl_mm
    stated = replace(tessar, image_radius_mm=33.0)
    assert image_radius_mm(stated) == (33.0, "the lens file")
    by_field = replace(tessar, image_radius_mm=None, half_field_deg=20.0)
    assert image_radius_mm(by_field)[0] == pytest.approx(f * math.tan(math.radians(20)))
    fisheye = tabled("isshiki_fisheye_10")
    narrow = replace(fisheye, image_radius_mm=None, half_field_deg=45.0)
    # Where its chief ray lands, far within f tan(field).
    assert (
        0.8 * first_order(narrow).efl_mm > image_radius_mm(narrow)[0] == pytest.approx(film_edge_mm(narrow), rel=0.01)
    )
    first, *others = by_field.surfaces
    diverging = replace(by_field, surfaces=(replace(first, radius_mm=-100.0), *others))
    assert first_order(diverging).efl_mm < 0 < image_radius_mm(diverging)[0]
    dark, why = image_radius_mm(replace(tessar, image_radius_mm=None, half_field_deg=None))
    assert "illumination" in why and dark > f * math.tan(math.radians(20))
    fisheye = focused("muller_fisheye_100")
    radius, why = image_radius_mm(fisheye)
    # Its rims end the light at about 74 degrees, before the stated 78. A scaled lens has a scaled image.
    assert "illumination" in why
    assert radius / first_order(fisheye).efl_mm == pytest.approx(1.3, abs=0.1)
    assert image_radius_mm(fisheye.scaled(0.14))[0] == pytest.approx(0.14 * radius, rel=1e-9)
    wider = focused("shimizu_fisheye_220")
    radius, why = image_radius_mm(wider)
    assert "half field" in why and radius / first_order(wider).efl_mm == pytest.approx(1.86, abs=0.03)


@pytest.mark.parametrize("gap", [0.01, 0.5])
def test_a_cover_glass_on_the_film_changes_little(gap: float) -> None:
    """The light of a film point fills a speck of it; without field and image circle its rim would seem to be dark."""
    tessar = replace(focused("brendel_tessar_100"), image_radius_mm=None, half_field_deg=None)
    dark, _ = image_radius_mm(tessar)
    *rows, last = tessar.surfaces
    back = tessar.film_z_mm - tessar.vertices_mm[-2]
    plate = Surface(math.inf, 3.0, 150.0, 1.5), Surface(math.inf, gap, 150.0)
    rows = [*rows, replace(last, thickness_mm=back - 3.0 / 1.5 - gap), *plate]
    covered = set_lens(replace(tessar, surfaces=tuple(rows), film_z_mm=None))
    assert image_radius_mm(covered)[0] == pytest.approx(dark, rel=0.05)
    assert covered.film_z_mm - pupil_plane_z_mm(covered) > 10


FILM_RADIUS = 18.0
METHODS: dict[str, Callable[[Lens, float], RadialPupil]] = {
    "hull": hull_disc,
    "wu": wu_exit_pupil,
    "pixel disc": pixel_pupils,
    "boxes": lambda lens, radius: radial_bounds(lens, radius, "box"),
}


@cache
def lens(name: str, efl_mm: float, f_number: float) -> Lens:
    return set_lens(tabled(name), focal_length_mm=efl_mm, f_number=f_number)


def rate_and_light(some: Lens, pupil: RadialPupil, count: int = 20_000) -> tuple[float, float]:
    """Share of rays that pass, and mean irradiance over radiance, over film radii uniform on the disc."""
    rng = np.random.default_rng(0)
    film = np.stack([FILM_RADIUS * np.sqrt((np.arange(count) + 0.5) / count), np.zeros(count)])
    points, area = pupil.sample(film, rng.random((2, count)))
    passed = passes_through(some, pupil.pupil_z_mm)(film[0], points) & (area > 0)
    distance = some.film_z_mm - pupil.pupil_z_mm
    cos2 = 1 / (1 + (((points - film) / distance) ** 2).sum(0))
    return float(passed.mean()), float((passed * area * cos2**2).mean() / distance**2)


GAUSS, FISHEYE = ("tronnier_double_gauss_100", 100.0, 4.0), ("muller_fisheye_100", 14.0, 5.6)


def test_the_paraxial_exit_pupil_loses_light_off_the_axis() -> None:
    """The image of the stop as the film's centre sees it (Kolb et al. 1995)."""
    some = lens("tronnier_double_gauss_100", 100.0, 4.0)
    seen, wide = first_order(some), hull_disc(some, FILM_RADIUS)
    radius = np.full_like(wide.along, seen.exit_pupil_diameter_mm / 2)
    paraxial = replace(wide, pupil_z_mm=seen.exit_pupil_z_mm, along=radius, across=radius)
    rate, light = rate_and_light(some, paraxial)
    assert rate > 0.99
    assert light < 0.99 * rate_and_light(some, wide)[1]


@pytest.mark.parametrize(
    ("name", "case"),
    [("hull", GAUSS), ("boxes", FISHEYE), *whole(*((name, case) for name in METHODS for case in (GAUSS, FISHEYE)))],
)
def test_no_light_is_lost(name: str, case: tuple[str, float, float]) -> None:
    some = lens(*case)
    rate, light = rate_and_light(some, METHODS[name](some, FILM_RADIUS))
    radius = FILM_RADIUS * np.sqrt((np.arange(24) + 0.5) / 24)
    true = film_light(some, np.concatenate([[0.0], radius]))
    expected = (true.irradiance / true.transmittance)[1:].mean()
    assert light == pytest.approx(expected, rel=0.015)
    assert 0.6 < rate <= 1


def test_wu_finds_the_stop_where_it_is_seen() -> None:
    """For a lens that hardly vignettes and images its stop well the search ends at the paraxial exit pupil."""
    some = lens("tronnier_double_gauss_100", 100.0, 8.0)
    found, paraxial = wu_exit_pupil(some, 5.0), first_order(some)
    assert found.pupil_z_mm == pytest.approx(paraxial.exit_pupil_z_mm, abs=5)
    assert found.along[0] == pytest.approx(paraxial.exit_pupil_diameter_mm / 2, rel=0.05)


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
