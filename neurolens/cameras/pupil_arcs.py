"""The pupil of every film point at any stop and film position, bounded by three arcs whose ends are short polynomials.

Rays that pass a lens from a film point cross the pupil plane within the image of the stop, and of rims that cut it
from the side of the film point and from the other. In the frame of the film point (x towards its side) each is an arc
y^2 = H(x) that meets the x axis at right angles. So does their intersection, which is filled from the unit disc by
(X, Y) -> (middle + half width X, Y sqrt(H / (1 - X^2))): neighbours stay neighbours, and densities stay nearly even.

Where the stop's image folds its arc is another, `pupil_fold`.

Nothing here is a table: in a renderer's shader a table costs more than all of this. `pupil_outline` is the closer fit
at one stop and focus, `pupil_circles` that of lenses whose pupils no such arcs hold closely.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.cameras.blades import Blades
from neurolens.cameras.pupil_fold import NUMBERS, Fold, Opening
from neurolens.graph.ir import Graph, Value

Array = NDArray[np.float64]
HAIR = 1e-18  # mm
# Gauss's nodes and weights over a disc, along a diameter.
_NODES = ((-(0.5**0.5), 0.25), (0.0, 0.5), (0.5**0.5, 0.25))
TIP = 1e-7  # of 1 - X^2, near the ends of an arc
_ROUNDS = 2  # of the share of a way that blades leave: it depends on the width of the pupil there
RADIUS = 4  # powers of the film radius


@dataclass(frozen=True)
class PupilArcs:
    """Arcs that hold the passing rays of film points, mm on the pupil plane.

    Attributes:
        film_radius_mm: beyond it no light passes. film_z_mm: middle and half range of film positions.
        unit_mm, stop_radius_mm, wave: film radius, stop, middle and half range of (1000 / wavelength)^2 that `numbers`
            are scaled to; the same in all states of a lens.
        numbers: [A, 4, M]: of the stop's image, then of rims, the low end, the high end and two factors, as polynomials
            of the monomials `exponents` [M, 5] in film radius, stop, film position and wavelength, scaled to 1, and the
            cosine of twice the azimuth of the film point.
        sides: [A] of an arc: 1 of a rim that ends the light on the film point's side, -1 on the other, 0 on both; the
            row of an end that it has not is 0.

    Of a stop whose image folds `numbers` are [A, 8, M]: those of `Fold`, then of rims, with 0 after their four.
    """

    film_radius_mm: float
    unit_mm: float
    film_z_mm: tuple[float, float]
    stop_radius_mm: float
    wave: tuple[float, float]
    numbers: Array
    exponents: NDArray[np.int64]
    sides: tuple[int, ...]

    def scaled(self, radius: Array, stop: ArrayLike, film_z: ArrayLike, nanometres: Array, azimuth: ArrayLike) -> Array:
        """[5, ...]: film radius, stop, film position, wavelength and azimuth as the polynomials take them."""
        (middle, half), (mean, reach) = self.film_z_mm, self.wave
        call = np.divide(stop, self.stop_radius_mm), np.subtract(film_z, middle) / half
        parts = radius / self.unit_mm, *call, ((1000 / nanometres) ** 2 - mean) / reach, np.cos(np.multiply(azimuth, 2))
        return np.stack(np.broadcast_arrays(*parts))

    @cached_property
    def graph(self) -> Graph:
        """`sampler` of a round stop."""
        return self.sampler()

    def sampler(self, blades: type[Blades] | None = None, side: float = 1.0, margin: float = 0.0) -> Graph:
        """The pupil point of a film point and a point of the unit square.

        Args:
            blades: takes points of the disc nearer to its middle, to where the stop's blades end: the stop's image in
                the pupil is the arc of the stop, and is all but similar to it.
            side: -1 where that image is upside down. margin: by which blades are widened, as that is not exact.

        Inputs: `film_mm`, `square` [2], `wavelength_nm`; of the call `film_z_mm`, `stop_radius_mm`.
        Outputs: `pupil_mm` [2], and
        `area_mm2`, the inverse of its density, 0 or less where nothing passes; points mean nothing there;
        `mean_area_mm2`, its mean over the square of a round stop;
        `at_stop` [2], about where the ray crosses the stop, in units of its radius.
        """
        g = Graph()
        film, square = g.input("film_mm", 2), g.input("square", 2)
        radius = g.square(film).sqrt()
        turn = (film + [HAIR, 0.0]) * (1.0 / (radius + HAIR))
        arcs = self._arcs(g, radius * (1 / self.unit_mm), turn[0] * turn[0] - turn[1] * turn[1])
        low, high = _ends(arcs)
        stop = arcs[0]
        across = g.affine([[0.0, -1.0], [1.0, 0.0]], turn)

        # Written from the ends, so that rounding leaves no side negative.
        def stretch(left: Value, right: Value) -> tuple[None, Value]:
            rows = [
                arc.height(
                    None if arc.low is None else half * left + (low - arc.low),
                    None if arc.high is None else half * right + (arc.high - high),
                )
                for arc in arcs
            ]
            return None, (reduce(Value.minimum, rows) / (left * right).maximum(TIP)).maximum(0.0).sqrt()

        def at_stop(x: Value, y: Value) -> Value:
            along, aside, size = stop.at_stop(x, y)
            return (turn * along + across * aside) * (side / size)

        half = (high - low) * 0.5
        opening: Opening | None = None if blades is None else partial(blades(g).drawn, margin=margin)
        if opening is not None and isinstance(stop, Fold):
            opening = stop.where_unfolded(opening)
        x, y, area, mean = fill(unit_disc(square), low, high, stretch, at_stop, opening)
        inside = radius <= self.film_radius_mm
        g.outputs["pupil_mm"] = turn * x + across * y
        g.outputs["at_stop"] = at_stop(x, y)
        g.outputs["area_mm2"] = g.select(inside, area, 0.0)
        g.outputs["mean_area_mm2"] = mean
        return g

    @property
    def folds(self) -> bool:
        """Whether the first of them is the image of a stop that folds."""
        return self.numbers.shape[1] == NUMBERS

    def _arcs(self, g: Graph, radius: Value, twice: Value) -> list[Arc | Fold]:
        """The arcs of a film radius and the cosine of twice its azimuth, by Horner's rule with coefficients of the
        call."""
        stop, film_z = g.input("stop_radius_mm", per_call=True), g.input("film_z_mm", per_call=True)
        (middle, half), (mean, reach) = self.film_z_mm, self.wave
        call = g.concat(stop * (1 / self.stop_radius_mm), (film_z - middle) * (1 / half))
        inverse = (1000.0 * reach**-0.5) / g.input("wavelength_nm")
        wave = inverse * inverse - mean / reach
        factors = {(0, 0): None, (1, 0): wave, (0, 1): twice, (0, 2): twice * twice}
        every = []
        for numbers in self.numbers:
            rows: Value | None = None
            for powers, factor in factors.items():
                own = (self.exponents[:, 3:] == powers).all(1)
                if numbers[:, own].any():
                    part = self._horner(g, numbers, own, radius, call)
                    part = part if factor is None else part * factor
                    rows = part if rows is None else rows + part
            assert rows is not None
            every.append(g.split(rows, [1] * numbers.shape[0]))
        arcs = [
            Arc(None if side > 0 else low, None if side < 0 else high, first, change)
            for side, (low, high, first, change, *_) in zip(self.sides, every, strict=True)
        ]
        if not self.folds:
            return [*arcs]
        return [Fold.of(every[0], call[0], reduce(Value.minimum, (arc.end for arc in arcs[1:]))), *arcs[1:]]

    def _horner(self, g: Graph, numbers: Array, own: NDArray[np.bool_], radius: Value, call: Value) -> Value:
        """Rows of the terms `own`."""
        rows: Value | None = None
        for power in range(self.exponents[own, 0].max(), -1, -1):
            here = own & (self.exponents[:, 0] == power)
            rows = rows if rows is None else rows * radius
            if here.any():
                term = self._of_call(g, self.exponents[here, 1:3], numbers[:, here], call)
                rows = term if rows is None else rows + term
        assert rows is not None
        return rows

    def _of_call(self, g: Graph, exponents: NDArray[np.int64], numbers: Array, call: Value) -> Value:
        """Rows of polynomials in the stop and film position: the stop is known before the focus is."""
        rows: Value | None = None
        for power in range(exponents[:, 1].max(), -1, -1):
            part = exponents[:, 1] == power
            term = g.polynomial(exponents[part, :1], numbers[:, part], call[0])
            rows = term if rows is None else rows * call[1] + term
        assert rows is not None
        return rows

    def mixed(self, others: Sequence[PupilArcs], weights: Array) -> PupilArcs:
        """These arcs and others of the same lens, with these weights: those of a state between them."""
        nodes = [self, *others]
        middle, half = zip(*(a.film_z_mm for a in nodes), strict=True)
        return replace(
            self,
            film_radius_mm=float(weights @ [a.film_radius_mm for a in nodes]),
            film_z_mm=(float(weights @ middle), 1 / float(weights @ (1 / np.array(half)))),
            numbers=np.tensordot(weights, [a.numbers for a in nodes], 1),
        )

    @cached_property
    def checked(self) -> Graph:
        """Whether rays lie inside: inputs `film_mm`, `pupil_mm` [2] of film points on +x, from the azimuth whose double
        has the cosine `twice`, turned; outputs by arc, its factors too."""
        g = Graph()
        pupil = g.input("pupil_mm", 2)
        arcs = self._arcs(g, g.input("film_mm", 2)[0] * (1 / self.unit_mm), g.input("twice"))
        rows = [
            (None if arc.low is None else pupil[0] - arc.low, None if arc.high is None else arc.high - pupil[0])
            for arc in arcs
        ]
        for name, side in zip(("left", "right"), zip(*rows, strict=True), strict=True):
            g.outputs[name] = g.concat(*(pupil[0] * 0.0 + 1.0 if v is None else v for v in side))
        g.outputs["height"] = g.concat(*(arc.height(*row) for arc, row in zip(arcs, rows, strict=True)))
        g.outputs["change"] = g.concat(*(arc.change for arc in arcs))
        return g


@dataclass(frozen=True)
class Arc:
    """y^2 = left right (first + left change), left and right the distances from its ends; of a rim, which has one end,
    d (first + d change) at a distance d from that: every conic."""

    low: Value | None
    high: Value | None
    first: Value
    change: Value

    @property
    def end(self) -> Value:
        """Of a rim: where light ends on the film point's side; of one on the other side far off, where it does not."""
        if self.high is not None:
            return self.high
        assert self.low is not None
        return self.low + self.first.maximum(0.0) / (-self.change).maximum(HAIR)

    def at_stop(self, x: Value, y: Value) -> tuple[Value, Value, Value]:
        """Of the stop's own: about where in the stop a point lies, and the stop's radius there."""
        assert self.low is not None and self.high is not None
        reach, from_low = (self.high - self.low) * 0.5, x - self.low
        return from_low - reach, y / (self.first + self.change * from_low).maximum(TIP).sqrt(), reach

    def height(self, left: Value | None, right: Value | None) -> Value:
        """y^2 at distances from the ends that there are."""
        away = right if left is None else left
        assert away is not None
        found = away * (self.first + self.change * away)
        return found if left is None or right is None else right * found


def fill(
    disc: Value, low: Value, high: Value, across: Callable[[Value, Value], tuple[Value | None, Value]],
    at_stop: Callable[[Value, Value], Value], opening: Opening | None,
) -> tuple[Value, Value, Value, Value]:  # fmt: skip
    """A point of a shape of a point of the unit disc: x, y, the inverse of its density and the mean of that.

    Args:
        low, high: ends of the shape along x. across: at distances from the ends, in halves of its length, its middle
            along y (None: 0) and its half height over that of the unit disc. at_stop: of a point, in units of the
            stop's radius. opening: which share of a way from a point of the stop its blades leave.
    """
    g, half, middle = disc.graph, (high - low) * 0.5, (low + high) * 0.5

    def point(place: Value, x: Value) -> tuple[Value, Value, Value]:
        """Of a place in the disc, as tall as the shape is at x."""
        centre, tall = across(x + 1.0, 1.0 - x)
        y = place[1] * tall
        return middle + half * place[0], y if centre is None else centre + y, tall

    share = g.constant(1.0)
    if opening is not None:
        centre, _ = across(g.constant(1.0), g.constant(1.0))
        start = at_stop(middle, g.constant(0.0) if centre is None else centre)
        way = disc * (1.0 / (g.square(disc).sqrt() + HAIR))
        for _ in range(_ROUNDS):
            end = at_stop(*point(way, way[0] * share)[:2])
            share = opening(start, end - start)
        disc = disc * share
    x, y, here = point(disc, disc[0])
    one = g.constant(1.0)
    nodes = [across(one * (1 + x), one * (1 - x))[1] * w for x, w in _NODES]
    return x, y, half * here * (share * share * math.pi), half * (nodes[0] + nodes[1] + nodes[2]) * math.pi


def unit_disc(square: Value) -> Value:
    """The point [2] of the unit disc of a point of the unit square, evenly (Shirley and Chiu 1997)."""
    g = square.graph
    a, b = g.split(square * 2.0 - 1.0, (1, 1))
    flat = b * b <= a * a
    size = g.select(flat, a, b)
    angle = g.select(flat, b, a) / g.select(size * size <= HAIR, 1.0, size)
    squared = angle * angle
    cos = size * g.series(squared, _COS)
    sin = size * angle * g.series(squared, _SIN)
    return g.concat(g.select(flat, cos, sin), g.select(flat, sin, cos))


def _chebyshev(function: Callable[[Array], Array]) -> Array:
    """On squares of angles of up to pi / 4, in units of that: to float32's last bit."""
    fit = np.polynomial.Chebyshev.interpolate(function, 3, [0, 1])
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, np.float64)


_COS = _chebyshev(lambda s: np.cos(np.pi / 4 * np.sqrt(np.maximum(s, 0))))
_SIN = _chebyshev(lambda s: np.pi / 4 * np.sinc(np.sqrt(np.maximum(s, 0)) / 4))


def _ends(arcs: Sequence[Arc | Fold]) -> tuple[Value, Value]:
    lows, highs = [arc.low for arc in arcs if arc.low is not None], [arc.high for arc in arcs if arc.high is not None]
    return reduce(Value.maximum, lows), reduce(Value.minimum, highs)
