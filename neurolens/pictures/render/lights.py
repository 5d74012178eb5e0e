"""The lights of a scene: rectangles, discs, spheres, points, spots, and what surrounds it, far away.

A light is chosen partly by how much it lights the point that the camera looks at, partly at random. Its group then
gives a direction towards it: rectangles and discs are sampled uniformly over their area, spheres over the cone that
they fill. In each direction, light from infinity is a sum of up to three spectra of the palette. It is aimed at by a
table of its brightness in each direction, unless it is a single colour, for which scattered rays are the best samples.

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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render import scenetables as tables
from neurolens.pictures.render.colour import (
    Array,
    Index,
    Palette,
    daylight_table,
    daylight_weights,
    planck,
    table,
)
from neurolens.pictures.render.primitives import dot
from neurolens.pictures.render.sampler import (
    TWO_PI,
    DirectionTable,
    cell_of,
    centres,
    in_cone,
    one_less_cosine,
    orthonormal,
)
from neurolens.pictures.render.scenetables import BLACK, Sky, Vector

if TYPE_CHECKING:
    from neurolens.pictures.render.scene import SceneSettings

Numbers = NDArray[np.intp]
Aimed = tuple[FloatArray, FloatArray, FloatArray]  # direction [3, N], distance [N] m, inverse density [N]
Coefficients = Callable[[FloatArray], FloatArray]  # factors [3, N] of the three spectra in directions [3, N]
_TABLE = (128, 256)  # an even number of rows, so that the horizon lies between two
# Least weight of a cell with light, as a share of the mean, for it may be brighter away from its middle.
_FAINTEST = 0.02

SUN_RADIUS_RAD = math.radians(0.533 / 2)
_SUN_K, _SUN_LUX = 5778.0, 133.1e3

_UNITS: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
# Slope and offset of A, B, C, D, E in the turbidity T.
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


@dataclass(frozen=True)
class LightSamples:
    """Directions to points on lights.

    Attributes:
        direction: [3, N] unit vectors. distance: [N] m, to the light's surface, inf to the sky. light: [N] the light's
            number.
        inverse_pdf: [N] 1 / density per solid angle, in which the choice of the light counts. It is 0 where the light
            shows its back, and for lights without size, which no scattered ray finds.
        scale: [N] factor on the light's emission: `inverse_pdf`, or for lights without size the irradiance of intensity
            1 over the probability of the choice.
    """

    direction: FloatArray
    distance: FloatArray
    light: Numbers
    inverse_pdf: FloatArray
    scale: FloatArray


class LightGroup:
    """Lights of one kind.

    Attributes:
        count: how many lights there are. round_from: from this number on, lights are discs: the first number of a
            sample is the square of the radius, the second the angle.
        sizeless: whether `sample` gives the irradiance of intensity 1 in place of inverse densities.
    """

    count: int
    round_from = math.inf
    sizeless = False

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        """Estimate the irradiance [count] at a point, its three colours added up."""
        raise NotImplementedError

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        """Return directions from points [3, N] to the lights of these numbers [N], for samples [2, N] in [0, 1)."""
        raise NotImplementedError

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """Return the density [N] per solid angle with which `sample` hits lights [N]; 0 for lights without size."""
        return np.zeros_like(distance)


class Lights:
    """Lights of several kinds, numbered group by group (some may be empty); what reaches `target_m` counts most."""

    def __init__(self, groups: Sequence[LightGroup], target_m: Vector = BLACK) -> None:
        self._groups: list[tuple[int, LightGroup]] = []
        self.count = 0
        for group in groups:
            if group.count:
                self._groups.append((self.count, group))
                self.count += group.count
        self.black = self.count == 0
        if self.black:
            return
        # The table by which lights are chosen: half by equal shares, half by importance. Each light has a whole number
        # of its entries, at least one, whose share is the light's exact probability.
        importance = np.concatenate([group.importance(target_m) for _, group in self._groups])
        parts = importance / max(importance.sum(), 1e-300) + 1 / self.count
        entries = np.maximum(1, np.rint(parts / parts.sum() * max(1024, 16 * self.count))).astype(np.intp)
        self._table = np.repeat(np.arange(self.count), entries)
        self.probability = (entries / entries.sum()).astype(np.float32)

    def sample(self, point: FloatArray, choice: FloatArray, square: FloatArray) -> LightSamples:
        """Return a direction from each point [3, N] to one of the lights, for numbers [N] and [2, N] in [0, 1)."""
        light = self._table.take((choice * np.float32(len(self._table))).astype(np.intp), mode="clip")
        direction, distance, scale = np.empty_like(point), np.empty_like(choice), np.empty_like(choice)
        inverse_pdf = np.empty_like(choice)
        for group, rows, number in self._by_group(light):
            aimed = group.sample(number, point.take(rows, axis=1), square.take(rows, axis=1))
            direction[:, rows], distance[rows], scale[rows] = aimed
            scale[rows] /= self.probability.take(light[rows])
            inverse_pdf[rows] = 0 if group.sizeless else scale[rows]
        return LightSamples(direction, distance, light, inverse_pdf, scale)

    def pdf(self, light: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes a direction that hits lights [N].

        Args:
            point: [3, N] where rays start. distance: [N] to the hit. cosine: [N] at the light, above 0.
        """
        density = np.zeros_like(distance)
        for group, rows, number in self._by_group(light):
            density[rows] = group.pdf(number, point.take(rows, axis=1), distance[rows], cosine[rows])
        density *= self.probability.take(light)
        return density

    def each(
        self, numbers: Iterable[int], point: FloatArray, place: NDArray[np.float64]
    ) -> Iterator[tuple[bool, Aimed]]:
        """Sample lights one after another from points [3, N]; yields whether each is round, and the group's samples.

        Args:
            place: [2, N] from -1 to 1 in the light's own square, or in the square about its disc.
        """
        square = ((place + 1) / 2).astype(np.float32)
        disc = np.stack([(place**2).sum(0), np.arctan2(place[1], place[0]) / TWO_PI % 1]).astype(np.float32)
        for number in numbers:
            first, group = next(part for part in reversed(self._groups) if part[0] <= number)
            is_round = number - first >= group.round_from
            some = np.full(point.shape[1], number - first)
            yield is_round, group.sample(some, point, disc if is_round else square)

    def strongest(self, target_m: Vector, most: int) -> list[int]:
        """The numbers of the `most` lights that bring a point most light if nothing is between, in rising order."""
        importance = [group.importance(target_m) for _, group in self._groups]
        return sorted(np.argsort(-np.concatenate([np.zeros(0), *importance]), kind="stable")[:most].tolist())

    def _by_group(self, light: Numbers) -> Iterator[tuple[LightGroup, Numbers, Numbers]]:
        """Yield the groups of lights [N], the places at which each group's lights stand, and their numbers in it."""
        for first, group in self._groups:
            rows = np.flatnonzero((light >= first) & (light < first + group.count))
            if rows.size:
                yield group, rows, light[rows] - first


def _irradiance(
    area: NDArray[np.floating], middle: NDArray[np.floating], emission: Sequence[Vector], target_m: Vector
) -> NDArray[np.float64]:
    """Estimate the irradiance at a point from lights [n] of a visible area, the three colours added up."""
    away2 = np.sum((middle - np.array(target_m)) ** 2, axis=1)
    return area * np.array([sum(rgb) for rgb in emission]) / np.maximum(away2, 1e-6)


class FlatLights(LightGroup):
    """Rectangles, then discs. A rectangle is a corner and two edges, a disc its centre and two radii."""

    def __init__(self, quads: Sequence[tables.Quad], discs: Sequence[tables.Disc]) -> None:
        self.count, self._quads = len(quads) + len(discs), len(quads)
        self.round_from = self._quads
        self._emission = [light.emission for light in (*quads, *discs)]
        corner = np.array([q.corner_m for q in quads] + [d.centre_m for d in discs], np.float64).reshape(-1, 3)
        normal = np.array([d.normal for d in discs], np.float64).reshape(-1, 3).T
        radius = np.array([d.radius_m for d in discs])
        tangent, bitangent = orthonormal(normal / np.linalg.norm(normal, axis=0))
        edge_u = np.concatenate([np.array([q.edge_u_m for q in quads]).reshape(-1, 3), (tangent * radius).T])
        edge_v = np.concatenate([np.array([q.edge_v_m for q in quads]).reshape(-1, 3), (bitangent * radius).T])
        normal = np.cross(edge_u, edge_v)
        area = np.linalg.norm(normal, axis=1)
        self._corner, self._edge_u, self._edge_v = (a.T.astype(np.float32) for a in (corner, edge_u, edge_v))
        self._normal = (normal / area[:, None]).T.astype(np.float32)
        area[self._quads :] *= math.pi
        self._area = area.astype(np.float32)
        self._middle = corner + 0.5 * (edge_u + edge_v)
        self._middle[self._quads :] = corner[self._quads :]

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        return _irradiance(self._area, self._middle, self._emission, target_m)

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        if self._quads < self.count:
            radius, angle = np.sqrt(square[0]), square[1] * TWO_PI
            disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
            square = np.where(number < self._quads, square, disc)
        direction = self._corner.take(number, axis=1)
        direction += self._edge_u.take(number, axis=1) * square[0]
        direction += self._edge_v.take(number, axis=1) * square[1]
        direction -= point
        distance2 = dot(direction, direction)
        distance = np.sqrt(distance2)
        direction /= distance
        inverse_pdf = dot(self._normal.take(number, axis=1), direction)
        inverse_pdf *= -self._area.take(number)
        inverse_pdf /= distance2
        return direction, distance, np.maximum(inverse_pdf, np.float32(0), out=inverse_pdf)

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        return distance * distance / (self._area.take(number) * cosine)


class SphereLights(LightGroup):
    """Spheres that emit outwards."""

    round_from = 0

    def __init__(self, spheres: Sequence[tables.Sphere]) -> None:
        self.count, self._emission = len(spheres), [s.emission for s in spheres]
        self._centre = np.array([s.centre_m for s in spheres], np.float32).reshape(-1, 3).T
        self._radius2 = np.array([s.radius_m**2 for s in spheres], np.float32)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        return _irradiance(np.pi * self._radius2, self._centre.T, self._emission, target_m)

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        axis = self._centre.take(number, axis=1) - point
        away2 = dot(axis, axis)
        away = np.sqrt(away2)
        axis /= away
        radius2 = self._radius2.take(number)
        one_less_cos: FloatArray = one_less_cosine(radius2 / away2)
        direction, lost = in_cone(axis, one_less_cos, square)
        distance: FloatArray = away * (1 - lost) - np.sqrt(np.maximum(radius2 - away2 * (lost * (2 - lost)), 0))
        inverse_pdf: FloatArray = one_less_cos * TWO_PI
        inverse_pdf[away2 <= radius2] = 0  # inside the light
        return direction, distance, inverse_pdf

    def pdf(self, number: Numbers, point: FloatArray, distance: FloatArray, cosine: FloatArray) -> FloatArray:
        away = self._centre.take(number, axis=1) - point
        return np.float32(1) / (TWO_PI * one_less_cosine(self._radius2.take(number) / dot(away, away)))


class PointLights(LightGroup):
    """Points, then spots, which are found only by sampling lights; a point is a spot that emits in all directions."""

    sizeless = True

    def __init__(self, points: Sequence[tables.PointLight], spots: Sequence[tables.SpotLight]) -> None:
        lights = [*points, *spots]
        self.count = len(lights)
        self._position = np.array([light.position_m for light in lights], np.float32).reshape(-1, 3).T
        self._intensity = np.array([sum(light.intensity) for light in lights])
        axis = np.zeros((3, self.count))
        axis[:, len(points) :] = np.array([np.subtract(s.look_at_m, s.position_m) for s in spots]).reshape(-1, 3).T
        length = np.linalg.norm(axis, axis=0)
        self._axis = (axis / np.where(length > 0, length, 1)).astype(np.float32)
        # Falloff is the smoothstep of (cos - start) / width. A point's axis is the zero vector, and so its cosines are
        # 0.
        outer, inner = (
            np.array([math.cos(math.radians(getattr(s, name))) for s in spots]) for name in ("outer_deg", "inner_deg")
        )
        self._start = np.concatenate([np.full(len(points), -1.0), outer]).astype(np.float32)
        self._per_width = np.concatenate([np.ones(len(points)), 1 / (inner - outer)]).astype(np.float32)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        to = np.array(target_m)[:, None] - self._position
        distance2 = np.maximum(np.sum(to**2, axis=0), 1e-6)
        return self._intensity * self._falloff(np.arange(self.count), to / np.sqrt(distance2)) / distance2

    def _falloff(self, number: Numbers, away: NDArray[np.floating]) -> FloatArray:
        """Return the share [N] of the intensity that leaves in unit directions [3, N]."""
        cosine = dot(self._axis.take(number, axis=1), away)
        t = np.clip((cosine - self._start.take(number)) * self._per_width.take(number), 0, 1)
        return t * t * (3 - 2 * t)

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        direction = self._position.take(number, axis=1) - point
        distance2 = dot(direction, direction)
        distance = np.sqrt(distance2)
        direction /= distance
        return direction, distance, self._falloff(number, -direction) / distance2


def sun_direction(sky: Sky) -> Array:
    """Return the unit vector [3] towards the sun's middle."""
    up, around = math.radians(sky.sun_elevation_deg), math.radians(sky.sun_azimuth_deg)
    return np.array([math.cos(up) * math.sin(around), math.sin(up), -math.cos(up) * math.cos(around)])


def zenith(sky: Sky) -> dict[str, float]:
    """Return luminance Y (kcd/m^2) and chromaticity x, y of the zenith."""
    sun, t = math.radians(90 - sky.sun_elevation_deg), sky.turbidity
    chi = (4 / 9 - t / 120) * (math.pi - 2 * sun)
    found = {"Y": (4.0453 * t - 4.9710) * math.tan(chi) - 0.2155 * t + 2.4192}
    powers = np.array([sun**3, sun**2, sun, 1.0])
    for name, matrix in _ZENITH.items():
        found[name] = float(np.array([t * t, t, 1.0]) @ np.array(matrix) @ powers)
    return found


def sky_colour(sky: Sky, direction: FloatArray) -> tuple[Array, Array, Array]:
    """Return luminance [N] (kcd/m^2) and x, y [N] in unit directions [3, N]; below the horizon it is black."""
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


def sun_spectrum(sky: Sky) -> tuple[Array, Array, float]:
    """Return wavelengths (nm), the sun's relative radiance there, and the luminance of its disc (kcd/m^2)."""
    nm = table("wavelength_nm")
    outside = planck(nm, _SUN_K)
    zenith_deg = 90 - sky.sun_elevation_deg
    mass = 1 / (math.cos(math.radians(zenith_deg)) + 0.15 * (93.885 - zenith_deg) ** -1.253)
    um, beta = nm * 1e-3, 0.04608 * sky.turbidity - 0.04586
    inside = outside * np.exp(-mass * (0.008735 * um**-4.08 + beta * um**-1.3))
    left = float(np.sum(inside * table("y")) / np.sum(outside * table("y")))
    solid = 2 * math.pi * (1 - math.cos(SUN_RADIUS_RAD))
    return nm, inside, left * _SUN_LUX / solid * 1e-3


def total_spectrum(sky: Sky, direction: FloatArray) -> tuple[Array, NDArray[np.float64]]:
    """Return wavelengths (nm) and the spectrum of the sky's light, the mean over directions [3, N]."""
    luminance, x, y = sky_colour(sky, direction)
    nm, components = daylight_table()
    weights = daylight_weights(x, y)
    at = np.interp(nm, table("wavelength_nm"), table("y"))
    spectra = weights / (weights.T @ (components @ at)) * luminance
    return nm, np.asarray(np.maximum(spectra.mean(axis=1) @ components, 0))


class Surroundings(LightGroup):
    """Light from infinity: a colour, a gradient, a picture or the clear sky. A table makes one light of it to aim at.

    Args:
        settings: the tables of the scene. picture: [H, W, 3], the environment's.
    """

    def __init__(self, settings: SceneSettings, picture: FloatArray | None, palette: Palette) -> None:
        around, self._palette = settings.environment, palette
        self._coefficients: Coefficients | None = None
        self._table: DirectionTable | None = None
        bands = [around.colour] if around.colour else [around.ground, around.horizon, around.zenith]
        if settings.sky is not None:
            self._rows, self._coefficients = _clear_sky(settings.sky, palette)
            self._aim(_TABLE)
        elif picture is not None:
            self._rows = [palette.light(unit, around.illuminant) for unit in _UNITS]
            turn = math.radians(around.rotate_y_deg)
            self._coefficients = _texels(picture, np.float32(around.scale), turn)
            bright = picture.reshape(-1, 3) @ (palette.means(self._rows) * np.float32(around.scale))
            if bright.any():  # a faint picture can be 0 in float32
                self._table = DirectionTable(bright.reshape(picture.shape[:2]), turn)
        else:
            self._rows = [palette.light(band or BLACK, around.illuminant) for band in bands]
            if around.colour is None:
                self._coefficients = _by_height
                self._aim((_TABLE[0], 4))
        self.count = 0 if self._table is None else 1
        self.dark = self._table is None and not palette.means(self._rows[:1]).any()

    def _aim(self, shape: tuple[int, int]) -> None:
        """Make the table from the middles of its cells, unless all are black."""
        assert self._coefficients is not None
        bright = self._palette.means(self._rows) @ self._coefficients(centres(*shape))
        bright = np.maximum(bright, 0).reshape(shape)
        if bright.any():
            self._table = DirectionTable(np.where(bright > 0, np.maximum(bright, _FAINTEST * bright.mean()), 0))

    def radiance(self, direction: FloatArray, bins: Index) -> FloatArray:
        """Radiance [lanes, N] along unit directions [3, N] at wavelength bins [N]."""
        spectra = [self._palette.look_up(np.full(len(bins), row), bins) for row in self._rows]
        if self._coefficients is None:
            return spectra[0]
        share = self._coefficients(direction)
        return np.maximum(sum(c * s for c, s in zip(share, spectra, strict=True)), np.float32(0))

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        # Half the light of all directions, in three colours.
        return np.array([1.5 * self._table.total] if self._table else [])

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        assert self._table is not None
        direction, density = self._table.sample(square)
        inverse: FloatArray = np.reciprocal(np.maximum(density, np.float32(1e-20)))
        return direction, np.full(len(number), np.inf, np.float32), inverse

    def far_pdf(self, direction: FloatArray) -> FloatArray:
        """Return the density [N] per solid angle with which `sample` takes directions [3, N]."""
        assert self._table is not None
        return self._table.pdf(direction)


def _by_height(direction: FloatArray) -> FloatArray:
    """Return the shares of a gradient's three colours."""
    below, above = np.maximum(-direction[1], 0), np.maximum(direction[1], 0)
    return np.stack([below, 1 - below - above, above])


def _texels(picture: FloatArray, scale: np.float32, turn: float) -> Coefficients:
    """Return a function that looks a picture up by direction."""
    height, width = picture.shape[:2]
    texels = picture.reshape(-1, 3)
    return lambda d: np.multiply(texels.take(cell_of(d, height, width, turn), axis=0).T, scale, order="C")


def _clear_sky(sky: Sky, palette: Palette) -> tuple[list[int], Coefficients]:
    """Return the palette's rows of daylight's components, and a function of how much of each the sky has."""
    daylight = [palette.daylight(k) for k in range(3)]
    luminance = np.array([value for _, value in daylight])

    def coefficients(direction: FloatArray) -> FloatArray:
        bright, x, y = sky_colour(sky, direction)
        weights = daylight_weights(x, y)
        weights *= bright / sky.white_kcd_per_m2 / (luminance @ weights)
        return weights.astype(np.float32)

    return [row for row, _ in daylight], coefficients


class SunLight(LightGroup):
    """The sun's disc, as far as it is above the horizon; there is none without a sky that has a sun."""

    round_from = 0

    def __init__(self, sky: Sky | None) -> None:
        self.count = int(sky is not None and sky.sun)
        self._axis = sun_direction(sky).astype(np.float32) if sky else np.zeros(3, np.float32)
        self._one_less_cos = np.float32(2 * math.sin(SUN_RADIUS_RAD / 2) ** 2)
        self._radiance = sun_spectrum(sky)[2] / sky.white_kcd_per_m2 if sky else 0.0

    def row(self, sky: Sky, palette: Palette) -> int:
        """Return the palette's row with the disc's radiance."""
        nm, values, _ = sun_spectrum(sky)
        return palette.measured_light(("sun", sky), (nm, values), self._radiance)

    def importance(self, target_m: Vector) -> NDArray[np.float64]:
        return np.full(self.count, 3 * self._radiance * 2 * math.pi * float(self._one_less_cos))

    def sample(self, number: Numbers, point: FloatArray, square: FloatArray) -> Aimed:
        axis = np.repeat(self._axis[:, None], len(number), axis=1)
        direction, _ = in_cone(axis, np.full(len(number), self._one_less_cos), square)
        solid = np.where(direction[1] >= 0, TWO_PI * self._one_less_cos, np.float32(0))
        return direction, np.full(len(number), np.inf, np.float32), solid

    def far_pdf(self, direction: FloatArray) -> FloatArray:
        """Density [N] per solid angle with which `sample` takes directions [3, N]; 0 where no disc is seen."""
        # By the distance from the axis: float32 cannot tell the cosine from 1.
        away = direction - self._axis[:, None]
        inside = (dot(away, away) <= 2 * self._one_less_cos) & (direction[1] >= 0)
        return np.where(inside, 1 / (TWO_PI * self._one_less_cos), np.float32(0))
