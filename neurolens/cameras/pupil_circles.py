"""The pupil of every film point as the stop shows it: a disc of the stop's own points, cut by circles.

Rays that pass a lens cross its stop within its opening, and within what rims before and behind it leave of that: seen
in points of the stop they are circles, whose places and sizes are short polynomials of the film point, whatever the
pupil plane shows. `stop_image` takes points of the stop to the pupil.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial, reduce

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.blades import Blades
from neurolens.cameras.pupil_arcs import HAIR, TIP, fill, unit_disc
from neurolens.cameras.stop_image import StopImage
from neurolens.graph.ir import Graph, Value

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PupilCircles:
    """Circles that hold the passing rays of film points, in points of the stop in units of its widest radius.

    Attributes:
        film_radius_mm: beyond it no light passes. image: of the stop. anamorphic: symmetric about x and y alone; else
            all is in the frame of the film point (x towards its side).
        wide: radius of the stop's disc in units of the stop: on the axis, and by the square
            of the film radius squared times the stop's.
        exponents: [M, 3] of film x and y, scaled as the image does, and of the film position.
        numbers: [K, 3, M] of each rim's circle: u^2 + v^2 <= c + 2 a u + 2 b v with c, a, b of these monomials.
        squeeze: y of film points is scaled by it for the direction in which pupils are filled: that of their cuts.
    """

    film_radius_mm: float
    image: StopImage
    anamorphic: bool
    wide: tuple[float, float]
    exponents: NDArray[np.int64]
    numbers: Array
    squeeze: float = 1.0

    @property
    def film_z_mm(self) -> tuple[float, float]:
        """Middle and half range of film positions."""
        return self.image.film_z_mm

    @cached_property
    def graph(self) -> Graph:
        """`sampler` of a round stop."""
        return self.sampler()

    def sampler(self, blades: type[Blades] | None = None, side: float = 1.0, margin: float = 0.0) -> Graph:
        """As of `PupilArcs`; `mean_area_mm2` as if the pupil were everywhere stretched as at the point."""
        g = Graph()
        film, square = g.input("film_mm", 2), g.input("square", 2)
        film_z, nanometres = g.input("film_z_mm", per_call=True), g.input("wavelength_nm")
        size = g.input("stop_radius_mm", per_call=True) * (1 / self.image.stop_mm)
        radius = length = g.square(film).sqrt()
        ahead = film
        if self.squeeze != 1:
            ahead = film * [1.0, self.squeeze]
            length = g.square(ahead).sqrt()
        turn = (ahead + [HAIR, 0.0]) * (1.0 / (length + HAIR))
        aside = g.affine([[0.0, -1.0], [1.0, 0.0]], turn)
        own = film if self.anamorphic else g.concat(radius, g.constant(0.0))
        disc = self._disc(own, size)
        circles = [_Circle(g.constant(0.0), None, disc)]
        for c, a, b in self._rows(own, film_z):
            if self.anamorphic:
                a, b = turn[0] * a + turn[1] * b, turn[0] * b - turn[1] * a
            squared = c + a * a + b * b if self.anamorphic else c + a * a
            circles.append(_Circle(a, b if self.anamorphic else None, squared.maximum(0.0).sqrt()))
        low, high = reduce(Value.maximum, (c.low for c in circles)), reduce(Value.minimum, (c.high for c in circles))
        half = (high - low) * 0.5

        def across(left: Value, right: Value) -> tuple[Value | None, Value]:
            squares = [(half * left + (low - c.low)) * (half * right + (c.high - high)) for c in circles]
            root = (left * right).maximum(TIP)
            if not self.anamorphic:
                return None, (reduce(Value.minimum, squares) / root).maximum(0.0).sqrt()
            roots = [s.maximum(0.0).sqrt() for s in squares]
            top, bottom = roots[0], -roots[0]
            for c, tall in zip(circles[1:], roots[1:], strict=True):
                assert c.y is not None
                top, bottom = top.minimum(c.y + tall), bottom.maximum(c.y - tall)
            return (top + bottom) * 0.5, ((top - bottom) * 0.5).maximum(0.0) / root.sqrt()

        def at_stop(x: Value, y: Value) -> Value:
            return (turn * x + aside * y) * (side / size)

        opening = None if blades is None else partial(blades(g).drawn, margin=margin)
        x, y, area, mean = fill(unit_disc(square), low, high, across, at_stop, opening)
        place = turn * x + aside * y if self.anamorphic else g.concat(x, y)
        point, stretched = self.image.placed(own, film_z, nanometres, place * self.image.stop_mm)
        if not self.anamorphic:
            point = turn * point[0] + aside * point[1]
        unit = stretched * self.image.stop_mm**2
        lit = (radius <= self.film_radius_mm) & (low <= high)
        g.outputs = {"pupil_mm": point, "at_stop": at_stop(x, y), "area_mm2": g.select(lit, area * unit, 0.0)}
        g.outputs["mean_area_mm2"] = mean * unit
        return g

    def _disc(self, film: Value, size: Value) -> Value:
        """Its radius at a stop."""
        grown = film.graph.square(film * (1 / self.image.unit_mm)) * size
        return size * (grown * grown * self.wide[1] + self.wide[0])

    def _rows(self, film: Value, film_z: Value) -> list[tuple[Value, Value, Value]]:
        """c, a and b of every circle, with coefficients of the call."""
        g, (middle, half) = film.graph, self.image.film_z_mm
        place, powers = (film_z - middle) * (1 / half), np.unique(self.exponents[:, 2])[::-1]
        own, index = np.unique(self.exponents[:, :2], axis=0, return_inverse=True)
        products = g.polynomial(own, np.eye(len(own)), film * (1 / self.image.unit_mm))
        found = []
        for numbers in self.numbers.reshape(-1, len(self.exponents)):
            weights = np.zeros((len(own), powers[0] + 1))
            np.add.at(weights, (index.ravel(), self.exponents[:, 2]), numbers)
            used = np.flatnonzero(weights.any(1))
            if not used.size:
                found.append(g.constant(0.0))
                continue
            weight = g.polynomial(np.arange(powers[0] + 1)[:, None], weights[used], place)
            found.append(g.dot(weight, products[used.tolist()]))
        return [tuple(found[k : k + 3]) for k in range(0, len(found), 3)]  # type: ignore[misc]

    @cached_property
    def checked(self) -> Graph:
        """How far points of the stop lie inside: inputs `film_mm`, `point_mm` [2], `film_z_mm`, `stop_radius_mm`; of a
        round lens in the film point's frame. Output `within`: of the disc, then of the circles."""
        g = Graph()
        film, point = g.input("film_mm", 2), g.input("point_mm", 2) * (1 / self.image.stop_mm)
        size = g.input("stop_radius_mm") * (1 / self.image.stop_mm)
        square, disc = g.square(point), self._disc(film, size)
        rows = [disc * disc - square]
        for c, a, b in self._rows(film, g.input("film_z_mm")):
            rows.append(c + (a * point[0] + b * point[1]) * 2.0 - square)
        g.outputs["within"] = g.concat(*rows)
        return g


@dataclass(frozen=True)
class _Circle:
    """In the frame of the film point; y: None where that is 0 of all."""

    x: Value
    y: Value | None
    radius: Value

    @property
    def low(self) -> Value:
        return self.x - self.radius

    @property
    def high(self) -> Value:
        return self.x + self.radius
