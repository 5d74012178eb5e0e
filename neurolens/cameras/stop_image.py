"""The image of a lens's stop in its pupil, by film point: pupil points as sparse polynomials of points of the stop.

In points of this image all but nothing is left of a pupil's shape but the circle of the stop, and rims that cut it:
where a lens is anamorphic, or its pupil changes much over the film, short polynomials do not describe its ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.graph.loworder import pursue

if TYPE_CHECKING:
    from neurolens.cameras.pupil_sight import Sight

Array = NDArray[np.float64]
_RAYS, _FEWEST = 12_000, 1_000  # that tell of an image, at least
# Terms of a coordinate by rounds: rays of each are drawn by the last one's. Error (RMS) of the stop that is enough.
_TERMS, _GOOD = ((12, 24, 44), (12, 30, 72)), 0.0012
_SIZES, _REACH = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.0), 1.06  # of stops, whose edge counts most; rays beyond it
# Most of the powers of film and stop point together, of the stop point, of terms that move with focus or wavelength: of
# anamorphic lenses, of round ones.
_DEGREE, _STOP_DEGREE, _MOVING = (7, 13), (5, 7), (4, 7)
_FIELD = 21  # powers of the film point beside up to one of the stop point, of round lenses
_MOVES = ((1, 0), (0, 1), (0, 2), (1, 1), (2, 0))  # wavelength, film position
HAIR = 1e-18  # mm


@dataclass(frozen=True)
class StopImage:
    """Pupil points of points of the stop, in the frame of the film point where the lens is round.

    Attributes:
        unit_mm, stop_mm: that film points and those of the stop are scaled by. film_z_mm, wave: middle and half range
            of film positions and of (1000 / wavelength)^2.
        exponents: [M, 6]: of film x and y, stop x and y, wavelength and film position. numbers: [2, M], mm.
    """

    unit_mm: float
    stop_mm: float
    film_z_mm: tuple[float, float]
    wave: tuple[float, float]
    exponents: NDArray[np.int64]
    numbers: Array

    @cached_property
    def graph(self) -> Graph:
        """Of points `point_mm` [2] with derivatives; numbers of the focus are of the call."""
        g = Graph()
        (middle, half), (mean, reach) = self.film_z_mm, self.wave
        place = (g.input("film_z_mm", per_call=True) - middle) * (1 / half)
        inverse = (1000.0 * reach**-0.5) / g.input("wavelength_nm")
        wave = inverse * inverse - mean / reach
        film, point = g.input("film_mm", 2) * (1 / self.unit_mm), g.input("point_mm", 2) * (1 / self.stop_mm)
        rays, own = np.unique(self.exponents[:, :5], axis=0, return_inverse=True)
        monomials = g.polynomial(rays, np.eye(len(rays)), g.concat(film, point, wave))
        powers = self.exponents[:, 5].max() + 1
        rows = []
        for numbers in self.numbers:
            weights = np.zeros((len(rays), powers))
            np.add.at(weights, (own.ravel(), self.exponents[:, 5]), numbers)
            used = np.flatnonzero(weights.any(1))
            rows.append(g.dot(g.polynomial(np.arange(powers)[:, None], weights[used], place), monomials[used.tolist()]))
        g.outputs["pupil_mm"] = g.concat(*rows)
        return with_derivatives(g, ["pupil_mm"], [("point_mm", 0), ("point_mm", 1)])

    def placed(self, film: Value, film_z: Value, nanometres: Value, point: Value) -> tuple[Value, Value]:
        """The pupil point [2] of a point of the stop (mm), and the area of a unit of area there."""
        given = {"film_mm": film, "film_z_mm": film_z, "wavelength_nm": nanometres, "point_mm": point}
        found = film.graph.inline(self.graph, given)
        by_x, by_y = (found[derivative("pupil_mm", f"point_mm_{row}")] for row in (0, 1))
        return found["pupil_mm"], (by_x[0] * by_y[1] - by_x[1] * by_y[0]).abs()

    def before(self, lens: Graph, anamorphic: bool) -> Graph:
        """The graph of the lens, of rays through points of the stop in place of pupil points."""
        g = Graph()
        rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
        film, point = rays[0:2], rays[2:4]
        if anamorphic:
            pupil, _ = self.placed(film, film_z, rays[4], point)
        else:
            radius = g.square(film).sqrt()
            x, y = g.split((film + [HAIR, 0.0]) * (1.0 / (radius + HAIR)), (1, 1))
            turned = g.concat(x * point[0] + y * point[1], x * point[1] - y * point[0])
            own, _ = self.placed(g.concat(radius, radius * 0.0), film_z, rays[4], turned)
            pupil = g.concat(x * own[0] - y * own[1], y * own[0] + x * own[1])
        g.outputs = g.inline(lens, {"rays": g.concat(film, pupil, rays[4]), "film_z_mm": film_z})
        return g


def stop_image(sight: Sight) -> StopImage | None:
    """Of a lens, fitted to its rays; None where too few pass."""
    low, high = sight.film_z_mm
    long, short = ((1000 / w) ** 2 for w in reversed(sight.wavelength_nm))
    places = (low + high) / 2, max((high - low) / 2, 1e-6)
    waves = (long + short) / 2, max((short - long) / 2, 1e-9)
    exponents = [_exponents(k, sight.anamorphic) for k in range(2)]
    image: StopImage | None = None
    for seed, most in enumerate(_TERMS[not sight.anamorphic]):
        film, z, nm, pupil, point = draw_rays(sight, image, np.random.default_rng(seed))
        if z.size < _FEWEST:
            return None
        scaled = film / sight.film_radius_mm, point / sight.stop_radius_mm
        variables = np.stack(
            [*scaled[0], *scaled[1], ((1000 / nm) ** 2 - waves[0]) / waves[1], (z - places[0]) / places[1]]
        )
        weight = 1 / np.maximum(np.hypot(*scaled[1]), _SIZES[0])
        fits = []
        for k, powers in enumerate(exponents):
            columns = _products(variables, powers, not sight.anamorphic) * weight
            linear = np.stack([scaled[1][k], scaled[0][k]])[: 2 if scaled[0][k].any() else 1] * weight
            size = abs(float(np.linalg.lstsq(linear.T, pupil[k] * weight, rcond=None)[0][0]))  # mm of a stop's radius
            (chosen, values) = pursue([columns], [pupil[k] * weight], [_GOOD * size], most)
            fits.append(_monomials(powers[chosen], values[0], not sight.anamorphic))
        every = np.concatenate([powers for powers, _ in fits])
        numbers = np.zeros((2, len(every)))
        numbers[0, : len(fits[0][1])], numbers[1, len(fits[0][1]) :] = fits[0][1], fits[1][1]
        image = StopImage(sight.film_radius_mm, sight.stop_radius_mm, places, waves, every, numbers)
    return image


def _products(variables: Array, exponents: NDArray[np.int64], chebyshev: bool) -> Array:
    """[M, N] of powers of variables [6, N], or of Chebyshev's polynomials of the first, which differ more."""
    found = np.ones((len(exponents), variables.shape[1]))
    for k, value in enumerate(variables):
        degrees = range(exponents[:, k].max() + 1)
        if chebyshev and k == 0:
            rows = np.stack([np.cos(n * np.arccos(value.clip(-1, 1))) for n in degrees])
        else:
            rows = np.stack([value**n for n in degrees])
        found *= rows[exponents[:, k]]
    return found


def _monomials(exponents: NDArray[np.int64], numbers: Array, chebyshev: bool) -> tuple[NDArray[np.int64], Array]:
    """Powers of the variables and their numbers, of products of `_products`."""
    if not chebyshev:
        return exponents, numbers
    total: dict[tuple[int, ...], float] = {}
    for (degree, *others), number in zip(exponents.tolist(), numbers, strict=True):
        for power, factor in enumerate(np.polynomial.chebyshev.cheb2poly([0.0] * degree + [1.0])):
            if factor:
                key = (power, *others)
                total[key] = total.get(key, 0.0) + factor * number
    return np.array(list(total), np.int64), np.array(list(total.values()))


def draw_rays(
    sight: Sight, image: StopImage | None, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array, Array]:
    """Random rays that pass the widest stop: film points [2, N], film positions, wavelengths,
    pupil points and points of the stop [2, N]; through an image, such that edges of all stops are met."""
    count, stop = _RAYS * (4 if image is None else 1), sight.stop_radius_mm
    radius = sight.film_radius_mm * np.sqrt(rng.random(count)) * 0.9999
    z, nm = (rng.uniform(*span, count) for span in (sight.film_z_mm, sight.wavelength_nm))
    angle = 2 * np.pi * rng.random(count) if sight.anamorphic else np.zeros(count)
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    if image is None:
        radii = np.linspace(0, sight.table.film_radius_mm, sight.table.rows.shape[1])
        low, high, half = (np.interp(radius, radii, row) for row in sight.table.rows)
        x, y = low + (high - low) * rng.random(count), half * rng.uniform(-1, 1, count)
        pupil = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])
    else:
        size, turn = (
            _REACH * stop * rng.choice(_SIZES, count) * rng.random(count) ** 0.15,
            2 * np.pi * rng.random(count),
        )
        given = {"film_mm": film, "point_mm": size * np.stack([np.cos(turn), np.sin(turn)])}
        pupil = evaluate(image.graph, given | {"film_z_mm": z[None], "wavelength_nm": nm[None]})["pupil_mm"]
    rays = np.concatenate([film, pupil, nm[None]])
    with np.errstate(all="ignore"):
        found = evaluate(sight.graph, {"rays": rays, "film_z_mm": z[None], "stop_radius_mm": np.array([[stop]])})
    code, point = found["status"][0], found["stop_xy_mm"].astype(np.float64)
    good = np.broadcast_to(code == st.PASSED, radius.shape)
    return film[:, good], z[good], nm[good], pupil[:, good].astype(np.float64), point[:, good]


def _exponents(axis: int, anamorphic: bool) -> NDArray[np.int64]:
    """Of the terms that mirrored lenses share: odd in what lies along the axis, even in the other."""
    degree, of_stop, moving = (row[not anamorphic] for row in (_DEGREE, _STOP_DEGREE, _MOVING))
    found = [
        (*e, 0, 0)
        for e in product(range(_FIELD), range(degree + 1 if anamorphic else 1), *[range(of_stop + 1)] * 2)
        if (sum(e) <= degree or (sum(e[2:]) <= 1 and not anamorphic)) and sum(e[2:]) <= of_stop
        and (e[axis] + e[2 + axis]) % 2 == 1 and (e[1 - axis] + e[3 - axis]) % 2 == 0
    ]  # fmt: skip
    moves = [
        (*e[:4], *m)
        for e in found
        for m in _MOVES
        if sum(e) <= moving or (m[0] == 0 and sum(e[2:]) <= 1 and not anamorphic)
    ]
    return np.array(found + moves, np.int64)
