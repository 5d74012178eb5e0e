"""What is seen infinitely far away: a colour, a gradient, a picture or the clear sky, and the sun.

In each direction it is a sum of up to three spectra of the palette. All but a single colour are aimed at, by a table of
how bright they are in each direction; of a single colour, scattered rays are the best samples there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.arealights import in_cone
from neurolens.render.checks import BLACK, Vector
from neurolens.render.directions import DirectionTable, cell_of, centres
from neurolens.render.lights import Numbers
from neurolens.render.lightsettings import Environment, Sky
from neurolens.render.palette import Index, Palette
from neurolens.render.primitives import dot
from neurolens.render.sky import SUN_RADIUS_RAD, daylight_weights, sky_colour, sun_direction, sun_spectrum

Coefficients = Callable[[FloatArray], FloatArray]  # of the three spectra, [3, N] in directions [3, N]
_TABLE = (128, 256)  # rows are even, so that the horizon is the edge of one
# Share of the mean that every cell with light weighs at least: it may be brighter away from its middle.
_FAINTEST = 0.02


class Surroundings:
    """Light from infinitely far away.

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
        self.table = None if weights is None or not weights.any() else DirectionTable(weights, turn)
        self.dark = self.table is None and not palette.mean(rows[0])

    def radiance(self, direction: FloatArray, bins: Index) -> FloatArray:
        """Radiance [..., N] along unit directions [3, N] at wavelength bins [N]."""
        spectra = [self._palette.look_up(np.full(len(bins), row), bins) for row in self._rows]
        if self._coefficients is None:
            return spectra[0]
        share = self._coefficients(direction)
        return np.maximum(sum(c * s for c, s in zip(share, spectra, strict=True)), np.float32(0))


def make_surroundings(
    environment: Environment, sky: Sky | None, picture: FloatArray | None, palette: Palette
) -> Surroundings:
    """The surroundings that a scene's tables describe; `picture` [H, W, 3] is that of the environment."""
    if sky is not None:
        return _clear_sky(sky, palette)
    if picture is not None:
        return _picture(environment, picture, palette)
    if environment.colour is not None:
        return Surroundings(palette, [palette.light(environment.colour, environment.illuminant)])
    return _gradient(environment, palette)


def _weights(palette: Palette, rows: list[int], coefficients: Coefficients, shape: tuple[int, int]) -> FloatArray:
    """Brightness [H, W] in the middles of cells."""
    means = np.array([palette.mean(row) for row in rows], np.float32)
    bright = np.maximum(means @ coefficients(centres(*shape)), 0).reshape(shape)
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
    texels = np.ascontiguousarray(picture.reshape(-1, 3).T) * np.float32(environment.scale)
    turn = math.radians(environment.rotate_y_deg)

    def coefficients(direction: FloatArray) -> FloatArray:
        return texels.take(cell_of(direction, height, width, turn), axis=1)

    means = np.array([palette.mean(row) for row in rows], np.float32)
    return Surroundings(palette, rows, coefficients, (means @ texels).reshape(height, width), turn)


def _clear_sky(sky: Sky, palette: Palette) -> Surroundings:
    daylight = [palette.daylight(k) for k in range(3)]
    rows, luminance = [row for row, _ in daylight], np.array([value for _, value in daylight])

    def coefficients(direction: FloatArray) -> FloatArray:
        bright, x, y = sky_colour(sky, direction)
        weights = daylight_weights(x, y)
        weights *= bright / sky.white_kcd_per_m2 / (luminance @ weights)
        return weights.astype(np.float32)

    return Surroundings(palette, rows, coefficients, _weights(palette, rows, coefficients, _TABLE))


class SkyLight:
    """The surroundings as a light to aim at, if they have a table."""

    sizeless = False

    def __init__(self, surroundings: Surroundings) -> None:
        self._table = surroundings.table
        self.count = 0 if self._table is None else 1

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """See `LightGroup`: half of the light of all directions, of three colours."""
        return np.array([1.5 * self._table.total] if self._table else [])

    def sample(
        self, number: Numbers, point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `LightGroup`."""
        assert self._table is not None
        direction, density = self._table.sample(square)
        inverse: FloatArray = np.reciprocal(np.maximum(density, np.float32(1e-20)))
        return direction, np.full(len(number), np.inf, np.float32), inverse

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """See `LightGroup`; no surface belongs to it."""
        return np.zeros_like(distance)

    def far_pdf(self, direction: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes directions [3, N]."""
        assert self._table is not None
        return self._table.pdf(direction)


class SunLight:
    """The sun's disc, as far as it is above the horizon, if the scene has a sky with a sun."""

    sizeless = False

    def __init__(self, sky: Sky | None) -> None:
        self.count = int(sky is not None and sky.sun)
        self._axis = sun_direction(sky).astype(np.float32) if sky else np.zeros(3, np.float32)
        self._one_less_cos = np.float32(2 * math.sin(SUN_RADIUS_RAD / 2) ** 2)
        self._radiance = sun_spectrum(sky)[2] / sky.white_kcd_per_m2 if sky else 0.0

    def row(self, sky: Sky, palette: Palette) -> int:
        """Row of the palette with the disc's radiance."""
        nm, values, _ = sun_spectrum(sky)
        return palette.measured_light(("sun", sky), (nm, values), self._radiance)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """See `LightGroup`."""
        return np.full(self.count, 3 * self._radiance * 2 * math.pi * float(self._one_less_cos))

    def sample(
        self, number: Numbers, point: FloatArray, square: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `LightGroup`."""
        axis = np.repeat(self._axis[:, None], len(number), axis=1)
        direction, _ = in_cone(axis, np.full(len(number), self._one_less_cos), square)
        solid = np.where(direction[1] >= 0, np.float32(2 * math.pi) * self._one_less_cos, np.float32(0))
        return direction, np.full(len(number), np.inf, np.float32), solid

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """See `LightGroup`; no surface belongs to it."""
        return np.zeros_like(distance)

    def far_pdf(self, direction: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes directions [3, N]; 0 where no disc is seen."""
        # The distance from the axis, not the cosine, which float32 cannot tell from 1.
        away = direction - self._axis[:, None]
        inside = (dot(away, away) <= 2 * self._one_less_cos) & (direction[1] >= 0)
        return np.where(inside, 1 / (np.float32(2 * math.pi) * self._one_less_cos), np.float32(0))
