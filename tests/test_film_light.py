"""The oracle of light on the film against closed forms."""

import math

import numpy as np
import pytest
from film_light import film_light
from shipped import disc_irradiance, focused, pinhole

from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.states import set_lens


@pytest.mark.parametrize("radius_mm", [0.01, 3.0, 25.0])
def test_a_hole_of_any_size_is_the_exact_double_integral(radius_mm: float) -> None:
    height = np.array([0.0, 4.0, 11.0, 30.0, 80.0])
    light = film_light(set_lens(pinhole(36.0, radius_mm)), height)
    np.testing.assert_allclose(light.irradiance, disc_irradiance(radius_mm, 36.0, height), rtol=1e-7)
    np.testing.assert_allclose(light.area_mm2, math.pi * radius_mm**2, rtol=1e-8)
    np.testing.assert_allclose(light.transmittance, 1, rtol=1e-12)


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
    """The steepest ray that passes decides, whatever the aberrations: E = pi L sin^2(theta')."""
    double_gauss = focused("laikin_double_gauss_50")
    light = film_light(double_gauss, [0.0])
    edge = math.sqrt(light.area_mm2[0] / math.pi)
    without_loss = light.irradiance[0] / light.transmittance[0]
    assert without_loss == pytest.approx(math.pi * edge**2 / (edge**2 + light.distance_mm**2), rel=1e-6)
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


def test_rims_take_area_and_dark_film_is_zero() -> None:
    light = film_light(set_lens(focused("muller_fisheye_100"), focal_length_mm=14.0), np.linspace(0, 20, 11))
    lit = light.irradiance > 0
    assert not lit[-1] and lit[:-2].all() and (np.diff(light.area_mm2) <= 1e-6 * light.area_mm2[0]).all()
    assert light.area_mm2[lit][-1] < 0.8 * light.area_mm2[0] and (light.transmittance[lit] < 1).all()
