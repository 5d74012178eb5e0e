"""A lens in one state as a shader uses it, and the image of its stop: pupil points by film point and stop point.

Seen from a film point, a pupil may have many shapes. In coordinates of the stop it is nearly a disc, which the rims cut
by other discs. Discs are easy to sample, and the image takes the samples to the pupil.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pupil_outline import PupilTable, end_of_light, pass_test
from neurolens.cameras.shaders.source import Focusing
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Graph, Value
from neurolens.graph.loworder import pursue
from neurolens.optics.lens.prescription import LINE_D_NM

Array = NDArray[np.float64]
_PART = 1 << 15  # rays that are evaluated together
_PARTS, _LOW_BITS = 16.0, 4096.0  # parts of the spectrum; a number's bits below 1 / 4096 choose the place within a part


@dataclass(frozen=True)
class ShaderLens:
    """Holds a lens in one state.

    Attributes:
        graph: the lens; see `cameragraph.LensGraph`.
        table: boxes on the pupil plane that hold the passing rays.
        film_z_mm, wavelength_nm: the ranges of film position and light.
        stop_radius_mm: radius of the widest stop.
        stop_surface: the stop's surface, which the status of rays names that it blocks.
        anamorphic: whether the lens is symmetric about the x and y axes only.
        focusing: where the film stands.
        f_number: that of the widest stop.
        efl_mm: the focal length.
    """

    graph: Graph
    table: PupilTable
    film_z_mm: tuple[float, float]
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    stop_surface: int
    anamorphic: bool
    focusing: Focusing
    f_number: float
    efl_mm: float

    @property
    def film_radius_mm(self) -> float:
        """Return the radius beyond which the model knows no ray."""
        return self.table.film_radius_mm

    def end_of_light_mm(self) -> float:
        """Return the film radius at which light ends."""
        low, high = self.film_z_mm
        radii = [0.0]
        for z in {low, (low + high) / 2, high}:
            for azimuth in np.linspace(0, np.pi / 2, 4) if self.anamorphic else [0.0]:
                passes = partial(self._passes, film_z=z, azimuth=azimuth)
                radii.append(end_of_light(self.table, pass_test(passes, self.wavelength_nm)) or 0.0)
        return min(max(radii), self.film_radius_mm)

    def _passes(
        self, film: FloatArray, pupil: FloatArray, nanometres: float, film_z: float, azimuth: float
    ) -> NDArray[np.bool_]:
        """Test whether rays pass through points [2, N] of the boxes, turned about the axis or mirrored."""
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        turn, sides = np.array([[cos, -sin], [sin, cos]]), (1.0, -1.0) if self.anamorphic else (1.0,)
        points = [(turn @ film, turn @ (pupil * [[1.0], [side]])) for side in sides]
        codes = np.stack([self.status(*pair, nanometres, film_z, self.stop_radius_mm) for pair in points])
        return np.asarray((np.hypot(*film) <= self.film_radius_mm) & (codes == st.PASSED).any(0))

    def status(
        self, film: ArrayLike, pupil: ArrayLike, nanometres: ArrayLike, film_z: ArrayLike, stop: ArrayLike
    ) -> NDArray[Any]:
        """Return the status [N] of rays from film points [2, N] through pupil points [2, N] (mm).

        The other arguments are [N] or one number.
        """
        film = np.asarray(film)
        rays = np.concatenate([film, pupil, np.broadcast_to(nanometres, (1, film.shape[1]))]).astype(np.float32)
        call = {"film_z_mm": _row(film_z), "stop_radius_mm": _row(stop)}
        codes = []
        for start in range(0, rays.shape[1], _PART):
            part = np.s_[:, start : start + _PART]
            inputs = {"rays": rays[part]} | {name: v[part] if v.size > 1 else v for name, v in call.items()}
            codes.append(np.broadcast_to(evaluate(self._status, inputs)["status"][0], inputs["rays"].shape[1]))
        return np.concatenate(codes) if codes else np.zeros(0)

    @cached_property
    def _status(self) -> Graph:
        """Return the graph that gives the status alone."""
        return replace(self.graph, outputs={"status": self.graph.outputs["status"]})


def _row(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, np.float32).reshape(1, -1)


def light(range_nm: tuple[float, float], numbers: Value, in_colour: Value) -> tuple[Value, Value, Value]:
    """Choose a ray's wavelength and colour weights [3], red to blue, and return them with two numbers for its pupil.

    Cycles's numbers are the second and third dimension of Sobol's sequence, and their high bits are the most even. Four
    bits choose one of sixteen parts of the spectrum: the first bit of either number, whether their second bits differ,
    and the third bit of the first number. The lowest bits choose the wavelength within the part, and the other bits are
    left for the pupil. So sixteen samples of a pixel hold each eighth of the spectrum twice, once in each of the halves
    by which adaptive sampling judges noise. A half holds the samples whose index has an odd number of the bits 2, 8,
    32...: within it the second bit of a number is uneven, but the first bits are even, and so is whether the second
    bits differ. The weights are Bernstein's polynomials of second order, which are never negative and each have the
    mean 1.
    """
    g, (short, long) = numbers.graph, range_nm
    halves = numbers * 2.0
    left = halves - halves.floor()
    quarters, many = (left * 2.0).floor(), left[0] * 4.0
    first, third = many - many.floor(), many.floor() - quarters[0] * 2.0
    fine = first * _LOW_BITS
    eighth = halves[0].floor() * 8.0 + halves[1].floor() * 4.0 + (quarters[0] - quarters[1]).abs() * 2.0
    part = (eighth + third + fine - fine.floor()) * (1 / _PARTS)
    rest, grey = 1.0 - part, in_colour <= 0.5
    nanometres = g.select(grey, min(max(LINE_D_NM, short), long), part * (short - long) + long)
    colour = g.concat(rest * rest * 3.0, part * rest * 6.0, part * part * 3.0)
    return nanometres, g.select(grey, 1.0, colour), g.select(grey, numbers, g.concat(first, left[1]))


# ---- the image of the stop ----

HAIR = 1e-18  # mm; keeps the direction of a film point on the axis finite
_RAYS, _FEWEST = 4_000, 1_000  # rays of a fit at most, and how many have to pass
_TERMS = ((12, 24, 72), (16, 32, 72))  # most terms of each fit; rays of the next fit are drawn through the last one
_ENOUGH = 0.0012  # RMS error, in units of the stop's radius, at which a fit needs no more terms
# stops whose edges count most; how far beyond them rays lie
_SIZES, _REACH = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.0), 1.06
# Highest powers of film and stop point together, of the stop point alone, and of film and stop point in terms that move
# with wavelength or film; each for round lenses and for anamorphic ones.
_DEGREE, _STOP_DEGREE, _MOVING = (13, 7), (7, 5), (7, 4)
# powers of the film radius in those terms of a round lens that are linear in the stop point, for fisheyes need them
_FIELD = 21
# powers of the wavelength's variable and of the film position
_MOVES = ((0, 0), (1, 0), (0, 1), (0, 2), (1, 1), (2, 0))


@dataclass(frozen=True)
class StopImage:
    """Pupil points of points (x, y) of the stop, by two polynomials P and Q.

    A round lens is described in the frame of the film point, whose x axis points to it. There the pupil point is (x P +
    Q, y P), with P and Q polynomials of the film radius, x and x^2 + y^2, which is the general form of a map that
    rotations and mirrors leave alone. The pupil point of an anamorphic lens is (P, Q), of film point and stop point.

    Attributes:
        film_mm, stop_mm: units of film points and of stop points, which are the same in all states of a lens.
        film_z_mm, wave: middle and half the range of film positions, and of (1000 / wavelength)^2.
        anamorphic: which of the two forms it is.
        exponents: [M, 7]: 0 for terms of P and 1 for Q, then the powers of two film variables, of two stop variables,
            of the wavelength's variable and of the film position.
        numbers: [M], coefficients in mm.
    """

    film_mm: float
    stop_mm: float
    film_z_mm: tuple[float, float]
    wave: tuple[float, float]
    anamorphic: bool
    exponents: Exponents
    numbers: Array

    @cached_property
    def graph(self) -> Graph:
        """Write the graph of the image.

        Inputs are `film_mm`, `point_mm` [2] and `wavelength_nm`, and for a whole call `film_z_mm`; the output is
        `pupil_mm` [2], with its derivatives by the point. A round lens takes (radius, 0) as the film point.
        """
        g = Graph()
        (middle, half), (mean, reach) = self.film_z_mm, self.wave
        position = (g.input("film_z_mm", per_call=True) - middle) * (1 / half)
        inverse = (1000.0 * reach**-0.5) / g.input("wavelength_nm")
        field = g.concat(g.input("film_mm", 2) * (1 / self.film_mm), inverse * inverse - mean / reach)
        point = g.input("point_mm", 2) * (1 / self.stop_mm)
        stop = point if self.anamorphic else g.concat(point[0], g.square(point))
        p, q = (self._polynomial(part, field, stop, position) for part in (0, 1))
        g.outputs["pupil_mm"] = g.concat(p, q) if self.anamorphic else g.concat(point[0] * p + q, point[1] * p)
        return with_derivatives(g, ["pupil_mm"], [("point_mm", 0), ("point_mm", 1)])

    def _polynomial(self, part: int, field: Value, stop: Value, position: Value) -> Value:
        """Return P or Q as a polynomial of the stop variables, whose derivatives share its coefficients."""
        g, mine = field.graph, self.exponents[:, 0] == part
        exponents, numbers = self.exponents[mine, 1:], self.numbers[mine]
        powers, index = np.unique(exponents[:, 2:4], axis=0, return_inverse=True)
        if not len(powers):
            return g.constant(0.0)
        rows = []
        for k in range(len(powers)):
            terms = index.ravel() == k
            rows.append(moving_polynomial(exponents[terms][:, [0, 1, 4, 5]], numbers[terms], field, position))
        return g.dot(g.concat(*rows), g.polynomial(powers, np.eye(len(powers)), stop))

    def placed(self, film: Value, film_z: Value, nanometres: Value, point: Value) -> tuple[Value, Value]:
        """Return the pupil point [2] of a point of the stop (mm), and the area in the pupil of a unit of area there."""
        inputs = {"film_mm": film, "film_z_mm": film_z, "wavelength_nm": nanometres, "point_mm": point}
        rows = film.graph.inline(self.graph, inputs)
        by_x, by_y = (rows[derivative("pupil_mm", f"point_mm_{axis}")] for axis in (0, 1))
        return rows["pupil_mm"], (by_x[0] * by_y[1] - by_x[1] * by_y[0]).abs()

    def through_stop(self, lens: Graph) -> Graph:
        """Write the lens's graph with points of the stop in place of pupil points."""
        g = Graph()
        rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
        film, point, nanometres = rays[0:2], rays[2:4], rays[4]
        if self.anamorphic:
            pupil, _ = self.placed(film, film_z, nanometres, point)
        else:
            radius, turn, aside = frame_of_film_point(film)
            turned = g.concat(g.dot(turn, point), g.dot(aside, point))
            image, _ = self.placed(g.concat(radius, radius * 0.0), film_z, nanometres, turned)
            pupil = turn * image[0] + aside * image[1]
        g.outputs = g.inline(lens, {"rays": g.concat(film, pupil, nanometres), "film_z_mm": film_z})
        return g


def frame_of_film_point(film: Value) -> tuple[Value, Value, Value]:
    """Return a film point's distance from the axis, and unit vectors towards it and across."""
    radius = film.graph.square(film).sqrt()
    turn = (film + [HAIR, 0.0]) * (1.0 / (radius + HAIR))
    return radius, turn, film.graph.affine([[0.0, -1.0], [1.0, 0.0]], turn)


def moving_polynomial(exponents: Exponents, numbers: Array, variables: Value, position: Value) -> Value:
    """Return a polynomial of a ray's variables whose coefficients follow the film position, once a call.

    The last of its exponents [M, K + 1] is that of the film position.
    """
    g = variables.graph
    monomials, index = np.unique(exponents[:, :-1], axis=0, return_inverse=True)
    powers, moved = np.unique(exponents[:, -1], return_inverse=True)
    weights = np.zeros((len(monomials), len(powers)))
    np.add.at(weights, (index.ravel(), moved.ravel()), numbers)
    coefficients = g.polynomial(powers[:, None], weights, position)
    return g.dot(coefficients, g.polynomial(monomials, np.eye(len(monomials)), variables))


class StopRays(NamedTuple):
    """Rays [N] that pass the widest stop, with pupil points and points of the stop [2, N]."""

    film_mm: Array
    film_z_mm: Array
    wavelength_nm: Array
    pupil_mm: Array
    point_mm: Array


def fit_stop_images(lenses: Sequence[ShaderLens], folded: bool = False) -> list[StopImage] | None:
    """Fit the image of the stop in every state of a lens, with the same terms in all; None where too few rays pass.

    Where it is `folded`, return the best image that only moves and scales the stop.
    """
    candidates = np.array(list(_of_anamorphic() if lenses[0].anamorphic else _of_round()), np.int64)
    if folded:
        candidates = candidates[candidates[:, 3:5].sum(1) <= lenses[0].anamorphic]
    images: list[StopImage] | None = None
    for seed, most in enumerate(_TERMS[lenses[0].anamorphic]):
        previous: Sequence[StopImage | None] = [None] * len(lenses) if folded or images is None else images
        rays = [draw_rays(lens, image, seed) for lens, image in zip(lenses, previous, strict=True)]
        if min(r.film_z_mm.size for r in rays) < _FEWEST:
            return None
        empty = [_without_terms(lens, lenses) for lens in lenses]
        fits = [_equations(*pair, candidates) for pair in zip(empty, rays, strict=True)]
        columns, wanted = zip(*fits, strict=True)
        terms, numbers = pursue(columns, wanted, [_ENOUGH] * len(lenses), most)
        images = [_with_terms(*pair, candidates[terms]) for pair in zip(empty, numbers, strict=True)]
    return images


def _without_terms(lens: ShaderLens, states: Sequence[ShaderLens]) -> StopImage:
    low, high = lens.film_z_mm
    long, short = ((1000 / w) ** 2 for w in reversed(lens.wavelength_nm))
    return StopImage(
        film_mm=max(s.film_radius_mm for s in states),
        stop_mm=max(s.stop_radius_mm for s in states),
        film_z_mm=((low + high) / 2, max((high - low) / 2, 1e-6)),
        wave=((long + short) / 2, max((short - long) / 2, 1e-9)),
        anamorphic=lens.anamorphic,
        exponents=np.zeros((0, 7), np.int64),
        numbers=np.zeros(0),
    )


def _equations(image: StopImage, rays: StopRays, exponents: Exponents) -> tuple[Array, Array]:
    """Return columns [M, 2 N] of terms, and pupil points [2 N] that they shall sum to, in stop radii.

    Small stops count as much as the widest.
    """
    (middle, half), (mean, reach) = image.film_z_mm, image.wave
    film, (x, y) = rays.film_mm / image.film_mm, rays.point_mm / image.stop_mm
    weight = 1 / np.maximum(np.hypot(x, y), _SIZES[0])
    wave, position = ((1000 / rays.wavelength_nm) ** 2 - mean) / reach, (rays.film_z_mm - middle) / half
    stop = (x, y) if image.anamorphic else (x, x**2 + y**2)
    along_x = _powers(film[0], exponents[:, 1]) if image.anamorphic else _radial(film[0], exponents)
    products = along_x * _powers(film[1], exponents[:, 2])
    for values, powers in zip((*stop, wave, position), exponents.T[3:], strict=True):
        products *= _powers(values, powers)
    one, none = np.ones_like(x), np.zeros_like(x)
    directions = ((one, none), (none, one)) if image.anamorphic else ((x, y), (one, none))
    rows = []
    for k, pupil in enumerate(rays.pupil_mm):
        linear = np.stack([(x, y)[k], film[k]]) * weight
        size = abs(float(np.linalg.lstsq(linear.T, pupil * weight, rcond=None)[0][0]))  # mm of a stop radius
        scale = weight / size
        along = np.stack([direction[k] for direction in directions])
        rows.append((products * along[exponents[:, 0]] * scale, pupil * scale))
    return np.concatenate([c for c, _ in rows], 1), np.concatenate([w for _, w in rows])


def _powers(values: Array, powers: NDArray[np.int64]) -> Array:
    return np.stack([values**n for n in range(powers.max() + 1)])[powers]


def _lowest(exponents: NDArray[np.int64]) -> int:
    """Return the lowest power of the film radius that a round lens's term can have."""
    return int(exponents[3] + exponents[0])


def _radial(radius: Array, exponents: Exponents) -> Array:
    """Return factors of the film radius for choosing terms: Chebyshev polynomials, which differ more than powers."""
    pairs = [(_lowest(e), (int(e[1]) - _lowest(e)) // 2) for e in exponents]
    factors = {(least, degree): radius**least * _chebyshev(degree)(radius**2) for least, degree in set(pairs)}
    return np.stack([factors[pair] for pair in pairs])


def _chebyshev(degree: int) -> np.polynomial.Chebyshev:
    return np.polynomial.Chebyshev.basis(degree, domain=[0, 1])


def _with_terms(image: StopImage, numbers: Array, exponents: Exponents) -> StopImage:
    """Return the image with the terms that `_equations` has, written as powers."""
    if image.anamorphic:
        return replace(image, exponents=exponents, numbers=numbers)
    total: dict[tuple[int, ...], float] = {}
    for powers, number in zip(exponents, numbers, strict=True):
        least = _lowest(powers)
        series = _chebyshev((int(powers[1]) - least) // 2).convert(kind=np.polynomial.Polynomial).coef
        for n, factor in enumerate(series):
            key = (int(powers[0]), least + 2 * n, *powers[2:].tolist())
            total[key] = total.get(key, 0.0) + factor * number
    return replace(image, exponents=np.array(list(total)), numbers=np.array([*total.values()]))


def _of_round() -> Iterator[tuple[int, ...]]:
    degree, of_stop, moving = _DEGREE[0], _STOP_DEGREE[0], _MOVING[0]
    for part, x, square, pairs in product((0, 1), range(of_stop + 1), range(of_stop // 2 + 1), range(_FIELD // 2 + 1)):
        field, stop = x + part + 2 * pairs, x + 2 * square + 1 - part
        if stop > of_stop or field + stop > (degree if stop > 1 else _FIELD):
            continue
        for wave, position in _MOVES:
            if wave + position == 0 or field + stop <= moving or (wave == 0 and stop <= 1):
                yield part, field, 0, x, square, wave, position


def _of_anamorphic() -> Iterator[tuple[int, ...]]:
    degree, of_stop, moving = _DEGREE[1], _STOP_DEGREE[1], _MOVING[1]
    for part, *powers in product((0, 1), *[range(degree + 1)] * 2, *[range(of_stop + 1)] * 2):
        if sum(powers) > degree or sum(powers[2:]) > of_stop:
            continue
        # Odd in the coordinate's own axis and even in the other: mirrors leave the lens alone.
        if (powers[part] + powers[2 + part]) % 2 == 1 and (powers[1 - part] + powers[3 - part]) % 2 == 0:
            for wave, position in _MOVES:
                if wave + position == 0 or sum(powers) <= moving:
                    yield part, *powers, wave, position


def draw_rays(lens: ShaderLens, image: StopImage | None, seed: int) -> StopRays:
    """Draw random rays that pass the widest stop, from film points on +x for round lenses.

    They go through the lens's boxes, or through an image of the stop, so that they meet the edges of all stops.
    """
    rng = np.random.default_rng(seed)
    count, stop = _RAYS * (4 if image is None else 1), lens.stop_radius_mm
    radius = lens.film_radius_mm * np.sqrt(rng.random(count)) * 0.9999
    z, nm = (rng.uniform(*span, count) for span in (lens.film_z_mm, lens.wavelength_nm))
    angle = 2 * np.pi * rng.random(count) if lens.anamorphic else np.zeros(count)
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    if image is None:
        radii = np.linspace(0, lens.film_radius_mm, lens.table.rows.shape[1])
        low, high, half = (np.interp(radius, radii, row) for row in lens.table.rows)
        x, y = np.stack([low + (high - low) * rng.random(radius.size), half * rng.uniform(-1, 1, radius.size)])
        pupil = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])
    else:
        turn = 2 * np.pi * rng.random(count)
        size = _REACH * stop * rng.choice(_SIZES, count) * rng.random(count) ** 0.15
        inputs = {"film_mm": film, "point_mm": size * np.stack([np.cos(turn), np.sin(turn)])}
        pupil = evaluate(image.graph, inputs | {"film_z_mm": z[None], "wavelength_nm": nm[None]})["pupil_mm"]
    rays = np.concatenate([film, pupil, nm[None]])
    with np.errstate(all="ignore"):
        out = evaluate(lens.graph, {"rays": rays, "film_z_mm": z[None], "stop_radius_mm": np.array([[stop]])})
    passed = np.flatnonzero(np.broadcast_to(out["status"][0] == st.PASSED, radius.shape))[:_RAYS]
    point = out["stop_xy_mm"].astype(np.float64)
    return StopRays(film[:, passed], z[passed], nm[passed], pupil[:, passed].astype(np.float64), point[:, passed])
