"""Light on the film against closed forms; its factors are what their names say, and multiply to the whole."""

import math
from dataclasses import replace

import numpy as np
import pytest
from shipped import before, disc_irradiance, pinhole, tabled

from experiments.radiometry import FilmLight, film_light, white_card
from neurolens.base.errors import InputError
from neurolens.lens.apertures import Aperture
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens, Surface
from neurolens.setting.states import set_lens


def lens(name: str, **state: float) -> Lens:
    return set_lens(tabled(name), **state)


def product(light: FilmLight) -> np.ndarray:
    shares = light.optical * light.mechanical * light.transmittance
    return light.natural * light.aperture * shares / shares[0]


@pytest.mark.parametrize("radius_mm", [0.01, 3.0, 25.0])
def test_a_hole_of_any_size_is_the_exact_double_integral(radius_mm: float) -> None:
    height = np.array([0.0, 4.0, 11.0, 30.0, 80.0])
    light = film_light(set_lens(pinhole(36.0, radius_mm)), height)
    np.testing.assert_allclose(light.irradiance, disc_irradiance(radius_mm, 36.0, height), rtol=1e-7)
    np.testing.assert_allclose(light.aperture, 1, rtol=1e-8)
    np.testing.assert_allclose(light.area_mm2, math.pi * radius_mm**2, rtol=1e-8)
    for factor in (light.optical, light.mechanical, light.transmittance):
        np.testing.assert_allclose(factor, 1, rtol=1e-12)


def test_the_disc_formula_at_its_limits() -> None:
    """pi sin^2 on the axis; cos^4 for a small disc; pi under an endless one; a numerical integral elsewhere."""
    theta = math.atan(7 / 10)
    assert disc_irradiance(7.0, 10.0, np.zeros(1))[0] == pytest.approx(math.pi * math.sin(theta) ** 2, rel=1e-14)
    height = np.array([0.0, 5.0, 10.0, 40.0])
    small = disc_irradiance(1e-4, 10.0, height)
    np.testing.assert_allclose(small / small[0], np.cos(np.arctan(height / 10)) ** 4, rtol=1e-9)
    np.testing.assert_allclose(disc_irradiance(1e7, 10.0, height), math.pi, rtol=1e-9)
    r, phi = np.meshgrid((np.arange(2000) + 0.5) / 2000 * 7, (np.arange(400) + 0.5) / 400 * math.pi)
    for h in (3.0, 9.0, 20.0):
        distance2 = 100 + (r * np.cos(phi) - h) ** 2 + (r * np.sin(phi)) ** 2
        total = 2 * np.sum(100 / distance2**2 * r) * (7 / 2000) * (math.pi / 400)
        assert disc_irradiance(7.0, 10.0, np.array([h]))[0] == pytest.approx(total, rel=1e-5)


def test_on_the_axis_it_is_pi_sin2_of_the_last_ray() -> None:
    """Of the steepest ray that passes, whatever the aberrations: E = pi L sin^2(theta')."""
    double_gauss = lens("laikin_double_gauss_50")
    light = film_light(double_gauss, [0.0])
    edge = math.sqrt(light.area_mm2[0] / math.pi)
    sine2 = edge**2 / (edge**2 + light.distance_mm**2)
    without_loss = light.irradiance[0] / light.transmittance[0]
    assert without_loss == pytest.approx(math.pi * sine2, rel=1e-6)
    # E = pi L / (4 N^2) for the working f-number, which is near the nominal one of a corrected lens.
    assert without_loss == pytest.approx(math.pi / (4 * first_order(double_gauss).f_number ** 2), rel=0.05)


def test_a_thin_singlet_with_a_small_stop_and_far_rims_falls_as_cos4() -> None:
    rows = (Surface(math.inf, 0.01, 1.0, stop=True), Surface(50.0, 0.2, 60.0, 1.5), Surface(-50.0, 50.0, 60.0))
    singlet = set_lens(Lens("thin", "", rows, 50.0))
    height = np.array([0.0, 5.0, 12.0, 20.0])
    light = film_light(singlet, height)
    cos4 = np.cos(np.arctan(height / singlet.film_z_mm)) ** 4
    np.testing.assert_allclose(light.relative / light.transmittance * light.transmittance[0], cos4, rtol=0.01)
    np.testing.assert_allclose(light.natural, cos4, rtol=0.01)
    np.testing.assert_allclose(light.optical, 1, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "state"), [("laikin_double_gauss_50", {}), ("muller_fisheye_100", {"focal_length_mm": 14.0})]
)
def test_factors_multiply_to_the_whole(name: str, state: dict[str, float]) -> None:
    light = film_light(lens(name, **state), np.linspace(0, 18, 7))
    lit = light.irradiance > 0
    assert lit[:-1].all()
    np.testing.assert_allclose(product(light), light.relative, rtol=1e-12)
    assert (light.optical <= 1 + 1e-9).all() and (light.mechanical == lit).all()
    # Rims take more and more; a stop far down is seen whole.
    assert (np.diff(light.optical[lit]) <= 1e-6).all() and light.optical[lit][-1] < 0.8
    closed = film_light(lens(name, f_number=16.0, **state), np.linspace(0, 12, 4))
    assert closed.optical.min() > 0.97
    assert (0 < light.transmittance[lit]).all() and (light.transmittance < 1).all()


def test_a_hood_is_mechanical_and_changes_nothing_else() -> None:
    plain = lens("laikin_double_gauss_50")
    radius = np.linspace(0, 21, 6)
    without = film_light(plain, radius)
    hooded = film_light(before(plain, Surface(math.inf, 30.0, 60.0)), radius)
    for factor in ("aperture", "optical"):
        np.testing.assert_allclose(getattr(hooded, factor), getattr(without, factor), rtol=2e-3)
    assert hooded.mechanical[0] == pytest.approx(1, abs=1e-6) and hooded.mechanical[-1] < 0.9
    np.testing.assert_allclose(product(hooded), hooded.relative, rtol=1e-12)


def test_white_card_four_ways() -> None:
    """Effective aperture and cos^4 part the light between them: together what the film sees, each alone brighter."""
    light = film_light(lens("muller_fisheye_100", focal_length_mm=14.0, f_number=4.0), np.linspace(0, 20, 11))
    card = white_card(light)
    lit = light.irradiance > 0
    assert list(card) == ["flat", "cos4", "aperture", "both"]
    np.testing.assert_array_equal(card["flat"], lit.astype(float))
    without_loss = light.irradiance[lit] / light.transmittance[lit]
    np.testing.assert_allclose(card["both"][lit], without_loss / without_loss[0], rtol=1e-12)
    assert all(c[0] == pytest.approx(1) for c in card.values())
    far = lit & (light.radius_mm > 10)
    assert (card["both"][far] < card["cos4"][far]).all() and (card["both"][far] < card["aperture"][far]).all()
    assert (card["both"][~lit] == 0).all() and not lit[-1]


@pytest.mark.parametrize("radius", [[], [1.0, 2.0], [0.0, -1.0], [0.0, math.nan], [[0.0]]])
def test_radii_that_make_no_sense(radius: list[float]) -> None:
    with pytest.raises(InputError, match="film_radius_mm"):
        film_light(set_lens(pinhole(36.0, 1.0)), radius)


def test_lenses_that_are_not_round_or_not_focused() -> None:
    hole = pinhole(36.0, 1.0)
    with pytest.raises(InputError, match="film_z_mm"):
        film_light(hole, [0.0])
    with pytest.raises(InputError, match="cylinders or blades"):
        film_light(set_lens(hole).with_aperture(Aperture(blades=5)), [0.0])
    with pytest.raises(InputError, match="cylinders or blades"):
        film_light(lens("schneider_anamorphic_31"), [0.0])
    shut = replace(set_lens(hole), surfaces=(replace(hole.surfaces[0], diameter_mm=0.0),))
    with pytest.raises(InputError, match="no ray passes"):
        film_light(shut, [0.0])
