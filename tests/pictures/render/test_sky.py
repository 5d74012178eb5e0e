"""The clear sky against its paper's equations, written out anew, and against measured daylight."""

import math

import numpy as np
import pytest
from render_helpers import FLOOR, MATERIALS, assert_aimed, radiance, scene, world

from neurolens.cameras.ideal import Pinhole
from neurolens.pictures.render.colour import SRGB, SpectralRange, table
from neurolens.pictures.render.job import expected_light
from neurolens.pictures.render.lights import (
    SunLight,
    daylight_table,
    daylight_weights,
    sky_colour,
    sun_direction,
    sun_spectrum,
    zenith,
)
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scenetables import Sky
from neurolens.pictures.render.settings import FilmSettings

WHITE_FLOOR = FLOOR | {"material": "white"}


@pytest.mark.parametrize(("name", "kelvin"), [("d65", 6500.0), ("d50", 5000.0)])
def test_components_of_daylight_give_the_illuminants(name: str, kelvin: float) -> None:
    # CIE 15: chromaticity from the colour temperature, with the constant of today, M1 and M2 to three decimals.
    t = kelvin * 1.4388 / 1.4380
    x = -4.6070e9 / t**3 + 2.9678e6 / t**2 + 0.09911e3 / t + 0.244063
    weights = daylight_weights(np.array([x]), np.array([-3 * x * x + 2.87 * x - 0.275]))
    nm, components = daylight_table()
    found = np.round(weights[:, 0], 3) @ components
    assert np.allclose(found, np.interp(nm, table("wavelength_nm"), table(name)), atol=1e-3)


def perez(t: float, theta: np.ndarray, gamma: np.ndarray) -> np.ndarray:
    """Preetham et al. 1999, luminance distribution."""
    a, b, c = 0.1787 * t - 1.4630, -0.3554 * t + 0.4275, -0.0227 * t + 5.3251
    d, e = 0.1206 * t - 2.5771, -0.0670 * t + 0.3703
    return (1 + a * np.exp(b / np.cos(theta))) * (1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2)


@pytest.mark.parametrize(("elevation", "turbidity"), [(60.0, 3.0), (10.0, 2.0), (35.0, 8.0)])
def test_irradiance_of_the_sky_is_the_integral_of_its_luminance(elevation: float, turbidity: float) -> None:
    sky = {"sun_elevation_deg": elevation, "sun_azimuth_deg": 70, "turbidity": turbidity, "sun": False}
    made = world(materials=MATERIALS, sky=sky, planes=[WHITE_FLOOR])
    spectral = SpectralRange(400, 700)
    samples = 16384
    values = radiance(made, [0, 1, 3], [0, 0, 0], samples=samples, max_depth=1)
    bins = np.arange(samples) * 256 // samples
    luminance = float(SRGB.to_xyz[1] @ (spectral.response[:, bins] @ values.astype(float)) / samples)

    sun = math.radians(90 - elevation)
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * sun)
    at_zenith = (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192
    theta, phi = np.meshgrid((np.arange(400) + 0.5) * math.pi / 800, (np.arange(800) + 0.5) * 2 * math.pi / 800)
    gamma = np.arccos(np.clip(np.cos(sun) * np.cos(theta) + np.sin(sun) * np.sin(theta) * np.cos(phi), -1, 1))
    seen = at_zenith * perez(turbidity, theta, gamma) / perez(turbidity, np.zeros(1), np.full(1, sun))
    irradiance = np.sum(seen * np.cos(theta) * np.sin(theta)) * (math.pi / 800) * (2 * math.pi / 800)
    assert luminance == pytest.approx(irradiance / math.pi / 20, rel=5e-3)


def test_aiming_at_the_sky_changes_the_noise_and_not_the_mean() -> None:
    ball = {"centre_m": [0.3, 0.5, 0], "radius_m": 0.3, "material": "white"}
    sky = {"sun_elevation_deg": 25, "sun_azimuth_deg": 200, "sun": False}
    made = world(materials=MATERIALS, sky=sky, planes=[WHITE_FLOOR], spheres=[ball])
    assert_aimed(made, [0.2, 0, 0.1], 0.9, max_depth=2)


def test_the_sun_lights_as_its_disc_shines_and_is_seen_where_it_stands() -> None:
    settings = {"sun_elevation_deg": 40, "sun_azimuth_deg": 30}
    sky = Sky(**settings)
    with_sun, without = (
        world(materials=MATERIALS, sky=settings | {"sun": sun}, planes=[WHITE_FLOOR]) for sun in (True, False)
    )
    towards = sun_direction(sky)
    assert towards == pytest.approx([math.cos(0.698132) * 0.5, math.sin(0.698132), -math.cos(0.698132) * 0.8660254])
    disc, glow = (radiance(made, [0, 1, 0], list(towards + [0, 1, 0]), samples=256) for made in (with_sun, without))
    beside = radiance(with_sun, [0, 1, 0], list(towards + [0, 1, 0.01]), samples=256)
    assert disc.mean() > 1e4 * glow.mean() and beside.mean() < 2 * glow.mean()
    lit, shaded = (radiance(made, [0, 1, 3], [0, 0, 0], samples=8192, max_depth=1) for made in (with_sun, without))
    solid = 2 * math.pi * (1 - math.cos(math.radians(0.533 / 2)))
    direct = (disc - glow).mean() * solid * math.sin(math.radians(40)) / math.pi
    assert lit.mean() - shaded.mean() == pytest.approx(direct, rel=0.01)
    # Clear noon sun: of the order of 100 klx, and redder when it is low.
    klx = sun_spectrum(Sky(60.0))[2] * solid
    assert 80 < klx < 115

    def redness(elevation: float) -> float:
        nm, values, _ = sun_spectrum(Sky(elevation))
        return float(np.interp(650, nm, values) / np.interp(450, nm, values))

    assert redness(2.0) > 3 * redness(60.0)


@pytest.mark.parametrize("elevation", [0.0, 0.1, 0.3])
def test_of_a_sun_on_the_horizon_only_what_is_above_it_shines(elevation: float) -> None:
    made, without = (world(sky={"sun_elevation_deg": elevation, "sun": sun}) for sun in (True, False))
    axis = sun_direction(Sky(elevation))
    for up in (0.2, -0.2):
        towards = list(axis + [0, math.radians(up), 0])
        disc, glow = (radiance(w, [0, 0, 0], towards, samples=16).mean() for w in (made, without))
        assert disc > glow if elevation + up > 0 else disc == 0
    # Aimed at is the part of the disc above the horizon, a segment of a circle.
    light, square = SunLight(Sky(elevation)), np.random.default_rng(0).random((2, 20000), np.float32)
    direction, _, solid = light.sample(np.zeros(20000, np.intp), np.zeros((3, 20000), np.float32), square)
    height = min(elevation / (0.533 / 2), 1.0)
    share = (math.acos(-height) + height * math.sqrt(1 - height**2)) / math.pi
    whole = 2 * math.pi * (1 - math.cos(math.radians(0.533 / 2)))
    assert solid.mean() == pytest.approx(share * whole, rel=0.02)
    lit = solid > 0
    assert np.all(direction[1, lit] >= 0) and not light.far_pdf(direction[:, ~lit]).any()


def test_colour_and_brightness_of_the_sky() -> None:
    sky = Sky(45.0, turbidity=2.5)
    up = np.float32([[0], [1], [0]])
    luminance, x, y = sky_colour(sky, up)
    found = zenith(sky)
    assert (luminance[0], x[0], y[0]) == pytest.approx((found["Y"], found["x"], found["y"]), rel=1e-6)
    # Blue overhead, away from the sun; whiter and brighter at the horizon; nothing below it.
    around = np.float32([[0, 0, 0], [0.7071, 0.02, -0.3], [0.7071, 0.9998, 0.95]])
    luminance, x, _ = sky_colour(sky, around)
    assert x[0] < 0.27 < x[1] and luminance[1] > luminance[0] and luminance[2] == 0
    for elevation in (0.0, 5.0, 45.0, 90.0):
        for turbidity in (2.0, 10.0):
            grid = np.random.default_rng(0).normal(size=(3, 4000))
            grid[1] = np.abs(grid[1])
            bright, x, y = sky_colour(
                Sky(elevation, turbidity=turbidity), (grid / np.linalg.norm(grid, axis=0)).astype(np.float32)
            )
            assert np.all(bright >= 0) and np.all((x > 0.2) & (x < 0.55) & (y > 0.2) & (y < 0.5))


def test_one_and_four_wavelengths_a_path_see_the_same_sky() -> None:
    ball = {"centre_m": [0.3, 0.5, 0], "radius_m": 0.4, "material": "coat"}
    coat = {"kind": "glossy", "specular": [0.9, 0.6, 0.3], "roughness": 0.4, "reflectance": [0, 0, 0]}
    spot = {"position_m": [2, 2, 2], "look_at_m": [0, 0, 0], "intensity": [2, 1, 1], "outer_deg": 40, "illuminant": "A"}
    made = scene(
        {"position_m": [0, 1, 3]},
        materials=MATERIALS | {"coat": coat},
        sky={"sun_elevation_deg": 35, "sun_azimuth_deg": 220},
        planes=[WHITE_FLOOR],
        spheres=[ball],
        spots=[spot],
    )
    means = []
    for mode, samples in (("one", 256), ("hero", 128)):
        film = FilmSettings(wavelengths=mode)
        picture = render(made, Pinhole(30.0, (24.0, 24.0)), width=16, height=16, samples=samples, threads=2, film=film)
        means.append(np.median(picture.rgb.reshape(-1, 3), axis=0))
    assert np.allclose(*means, rtol=0.02)


def test_wavelengths_are_drawn_for_the_sky_and_the_lamps() -> None:
    nm, sky_light = expected_light(scene(sky={"sun_elevation_deg": 50, "sun": False}))
    _, sunset = expected_light(scene(sky={"sun_elevation_deg": 1}))
    _, bulb = expected_light(scene(points=[{"position_m": [0, 1, 0], "intensity": [1, 1, 1], "illuminant": "A"}]))
    blue, red = np.argmin(np.abs(nm - 450)), np.argmin(np.abs(nm - 650))
    assert sky_light[blue] > sky_light[red]
    assert bulb[red] > 3 * bulb[blue] and sunset[red] > sunset[blue]
