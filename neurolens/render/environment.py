"""Light from infinity: a colour, a gradient, a picture or the clear sky, and the sun.

In each direction it is a sum of up to three spectra of the palette. All but a single colour are aimed at, by a table of
how bright they are in each direction; of a single colour, scattered rays are the best samples there are.

Luminance and chromaticity of the clear sky are those of Preetham, Shirley and Smits 1999, "A practical analytic model
for daylight" (appendix A.2). With theta from the zenith, gamma from the sun, turbidity T, sun at theta_s:

    F(theta, gamma) = (1 + A e^(B / cos theta)) (1 + C e^(D gamma) + E cos^2 gamma)            Perez et al. 1993
    v(theta, gamma) = v_zenith F(theta, gamma) / F(0, theta_s)                                 for v = Y, x, y

with A to E linear in T. From chromaticity to spectrum: CIE daylight.

The sun is a disc of 0.533 degrees with the spectrum of a black body at 5778 K and 133.1 klx outside the atmosphere
(ASTM E490), dimmed by air and haze (the same paper, appendix A.1) along the air mass of Kasten 1966,
m = 1 / (cos + 0.15 (93.885 - degrees)^-1.253): by exp(-0.008735 lambda^-4.08 m) for molecules and by
exp(-beta lambda^-1.3 m), beta = 0.04608 T - 0.04586, for haze, lambda in um. Ozone, water vapour and mixed gases, a few
per cent of the visible light, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.colour import FloatArray64, Index, Palette, daylight_table, daylight_weights, planck, table
from neurolens.render.lights import Aimed, LightGroup, Numbers
from neurolens.render.primitives import dot
from neurolens.render.sampler import TWO_PI, DirectionTable, cell_of, centres, in_cone
from neurolens.render.scenetables import BLACK, Environment, Sky, Vector

Coefficients = Callable[[FloatArray], FloatArray]  # of the three spectra, [3, N] in directions [3, N]
_TABLE = (128, 256)  # rows are even, so that the horizon is the edge of one
# Least weight of a cell with light, as a share of the mean: it may be brighter away from its middle.
_FAINTEST = 0.02

SUN_RADIUS_RAD = math.radians(0.533 / 2)
_SUN_K, _SUN_LUX = 5778.0, 133.1e3

# Slope and offset in T of A, B, C, D, E.
_PEREZ = {
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}
# Rows T^2, T, 1; columns theta_s^3, theta_s^2, theta_s, 1.
_ZENITH = {
    "x": (
        (0.00166, -0.00375, 0.00209, 0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ),
    "y": ((0.00275, -0.0061, 0.00317, 0), (-0.04214, 0.0897, -0.04153, 0.00516), (0.15346, -0.26756, 0.0667, 0.26688)),
}


def sun_direction(sky: Sky) -> FloatArray64:
    """Unit vector [3] towards the sun's middle."""
    up, around = math.radians(sky.sun_elevation_deg), math.radians(sky.sun_azimuth_deg)
    return np.array([math.cos(up) * math.sin(around), math.sin(up), -math.cos(up) * math.cos(around)])


def zenith(sky: Sky) -> dict[str, float]:
    """Luminance Y in kcd/m^2 and chromaticity x, y of the zenith."""
    sun, t = math.radians(90 - sky.sun_elevation_deg), sky.turbidity
    chi = (4 / 9 - t / 120) * (math.pi - 2 * sun)
    found = {"Y": (4.0453 * t - 4.9710) * math.tan(chi) - 0.2155 * t + 2.4192}
    powers = np.array([sun**3, sun**2, sun, 1.0])
    for name, matrix in _ZENITH.items():
        found[name] = float(np.array([t * t, t, 1.0]) @ np.array(matrix) @ powers)
    return found


def sky_colour(sky: Sky, direction: FloatArray) -> tuple[FloatArray64, FloatArray64, FloatArray64]:
    """Luminance [N] in kcd/m^2 and chromaticity x, y [N] in unit directions [3, N]; the horizon's colour below it."""
    height = np.maximum(direction[1].astype(np.float64), 1e-4)
    towards = np.clip(sun_direction(sky) @ direction.astype(np.float64), -1, 1)
    sun_height = math.sin(math.radians(sky.sun_elevation_deg))
    from_sun, at_zenith = np.arccos(towards), math.acos(sun_height)
    found = []
    for name, value in zenith(sky).items():
        a, b, c, d, e = (slope * sky.turbidity + offset for slope, offset in _PEREZ[name])
        seen = (1 + a * np.exp(b / height)) * (1 + c * np.exp(d * from_sun) + e * towards * towards)
        up = (1 + a * math.exp(b)) * (1 + c * math.exp(d * at_zenith) + e * sun_height**2)
        found.append(value * seen / up)
    luminance, x, y = found
    return np.where(direction[1] >= 0, luminance, 0.0), x, y


def sun_spectrum(sky: Sky) -> tuple[FloatArray64, FloatArray64, float]:
    """Wavelengths in nm, the sun's relative radiance there, and the luminance of its disc in kcd/m^2."""
    nm = table("wavelength_nm")
    outside = planck(nm, _SUN_K)
    zenith_deg = 90 - sky.sun_elevation_deg
    mass = 1 / (math.cos(math.radians(zenith_deg)) + 0.15 * (93.885 - zenith_deg) ** -1.253)
    um, beta = nm * 1e-3, 0.04608 * sky.turbidity - 0.04586
    inside = outside * np.exp(-mass * (0.008735 * um**-4.08 + beta * um**-1.3))
    left = float(np.sum(inside * table("y")) / np.sum(outside * table("y")))
    solid = 2 * math.pi * (1 - math.cos(SUN_RADIUS_RAD))
    return nm, inside, left * _SUN_LUX / solid * 1e-3


def total_spectrum(sky: Sky, direction: FloatArray) -> tuple[FloatArray64, NDArray[np.float64]]:
    """Wavelengths in nm and the spectrum of the sky's light, the mean over directions [3, N]."""
    luminance, x, y = sky_colour(sky, direction)
    nm, components = daylight_table()
    weights = daylight_weights(x, y)
    at = np.interp(nm, table("wavelength_nm"), table("y"))
    spectra = weights / (weights.T @ (components @ at)) * luminance
    return nm, np.asarray(np.maximum(spectra.mean(axis=1) @ components, 0))


class Surroundings(LightGroup):
    """Light from infinity: one light to aim at, if there are weights.

    Args:
        rows: of the palette, three spectra, or the one of a single colour.
        coefficients: by direction; None for a single colour.
        weights: [H, W] brightness by direction, by which it is aimed at; None if it is not.
        turn: radians by which weights are turned about y.
    """

    def __init__(
        self,
        palette: Palette,
        rows: list[int],
        coefficients: Coefficients | None = None,
        weights: NDArray[np.floating] | None = None,
        turn: float = 0.0,
    ) -> None:
        self._palette, self._rows, self._coefficients = palette, rows, coefficients
        self._table = None if weights is None or not weights.any() else DirectionTable(weights, turn)
        self.count = 0 if self._table is None else 1
        self.dark = self._table is None and not palette.means(rows[:1]).any()

    def radiance(self, direction: FloatArray, bins: Index) -> FloatArray:
        """Radiance [lanes, N] along unit directions [3, N] at wavelength bins [N]."""
        spectra = [self._palette.look_up(np.full(len(bins), row), bins) for row in self._rows]
        if self._coefficients is None:
            return spectra[0]
        share = self._coefficients(direction)
        return np.maximum(sum(c * s for c, s in zip(share, spectra, strict=True)), np.float32(0))

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        # Half of the light of all directions, of three colours.
        return np.array([1.5 * self._table.total] if self._table else [])

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        assert self._table is not None
        direction, density = self._table.sample(square)
        inverse: FloatArray = np.reciprocal(np.maximum(density, np.float32(1e-20)))
        return direction, np.full(len(number), np.inf, np.float32), inverse

    def far_pdf(self, direction: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes directions [3, N]."""
        assert self._table is not None
        return self._table.pdf(direction)


def make_surroundings(
    environment: Environment, sky: Sky | None, picture: FloatArray | None, palette: Palette
) -> Surroundings:
    """The environment of a scene's tables; `picture` [H, W, 3] is its picture."""
    if sky is not None:
        return _clear_sky(sky, palette)
    if picture is not None:
        return _picture(environment, picture, palette)
    if environment.colour is not None:
        return Surroundings(palette, [palette.light(environment.colour, environment.illuminant)])
    return _gradient(environment, palette)


def _weights(palette: Palette, rows: list[int], coefficients: Coefficients, shape: tuple[int, int]) -> FloatArray:
    bright = np.maximum(palette.means(rows) @ coefficients(centres(*shape)), 0).reshape(shape)
    return np.where(bright > 0, np.maximum(bright, _FAINTEST * bright.mean()), 0)


def _gradient(environment: Environment, palette: Palette) -> Surroundings:
    bands = (environment.ground, environment.horizon, environment.zenith)
    rows = [palette.light(band or BLACK, environment.illuminant) for band in bands]

    def coefficients(direction: FloatArray) -> FloatArray:
        height = direction[1]
        below, above = np.maximum(-height, 0), np.maximum(height, 0)
        return np.stack([below, 1 - below - above, above])

    return Surroundings(palette, rows, coefficients, _weights(palette, rows, coefficients, (_TABLE[0], 4)))


def _picture(environment: Environment, picture: FloatArray, palette: Palette) -> Surroundings:
    units: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    rows = [palette.light(unit, environment.illuminant) for unit in units]
    height, width = picture.shape[:2]
    texels, scale = picture.reshape(-1, 3), np.float32(environment.scale)
    turn = math.radians(environment.rotate_y_deg)

    def coefficients(direction: FloatArray) -> FloatArray:
        return np.multiply(texels.take(cell_of(direction, height, width, turn), axis=0).T, scale, order="C")

    bright = (texels @ (palette.means(rows) * scale)).reshape(height, width)
    return Surroundings(palette, rows, coefficients, bright, turn)


def _clear_sky(sky: Sky, palette: Palette) -> Surroundings:
    daylight = [palette.daylight(k) for k in range(3)]
    rows, luminance = [row for row, _ in daylight], np.array([value for _, value in daylight])

    def coefficients(direction: FloatArray) -> FloatArray:
        bright, x, y = sky_colour(sky, direction)
        weights = daylight_weights(x, y)
        weights *= bright / sky.white_kcd_per_m2 / (luminance @ weights)
        return weights.astype(np.float32)

    return Surroundings(palette, rows, coefficients, _weights(palette, rows, coefficients, _TABLE))


class SunLight(LightGroup):
    """The sun's disc, as far as it is above the horizon, if the scene has a sky with a sun."""

    def __init__(self, sky: Sky | None) -> None:
        self.count = int(sky is not None and sky.sun)
        self._axis = sun_direction(sky).astype(np.float32) if sky else np.zeros(3, np.float32)
        self._one_less_cos = np.float32(2 * math.sin(SUN_RADIUS_RAD / 2) ** 2)
        self._radiance = sun_spectrum(sky)[2] / sky.white_kcd_per_m2 if sky else 0.0

    def row(self, sky: Sky, palette: Palette) -> int:
        """Row of the palette with the disc's radiance."""
        nm, values, _ = sun_spectrum(sky)
        return palette.measured_light(("sun", sky), (nm, values), self._radiance)

    def round(self, number: int) -> bool:
        return True

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        return np.full(self.count, 3 * self._radiance * 2 * math.pi * float(self._one_less_cos))

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        axis = np.repeat(self._axis[:, None], len(number), axis=1)
        direction, _ = in_cone(axis, np.full(len(number), self._one_less_cos), square)
        solid = np.where(direction[1] >= 0, TWO_PI * self._one_less_cos, np.float32(0))
        return direction, np.full(len(number), np.inf, np.float32), solid

    def far_pdf(self, direction: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes directions [3, N]; 0 where no disc is seen."""
        # The distance from the axis, not the cosine, which float32 cannot tell from 1.
        away = direction - self._axis[:, None]
        inside = (dot(away, away) <= 2 * self._one_less_cos) & (direction[1] >= 0)
        return np.where(inside, 1 / (TWO_PI * self._one_less_cos), np.float32(0))
