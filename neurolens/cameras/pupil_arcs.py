"""The pupil of every film point at any stop and film position, bounded by three arcs whose ends are short polynomials.

Rays that pass a lens from a film point cross the pupil plane within the image of the stop, and of rims that cut it
from the side of the film point and from the other. In the frame of the film point (x towards its side) each is an arc
y^2 = H(x) that meets the x axis at right angles. So does their intersection, which is filled from the unit disc by
(X, Y) -> (middle + half width X, Y sqrt(H / (1 - X^2))): neighbours stay neighbours, and densities stay nearly even.

Nothing here is a table: in a renderer's shader a table costs more than all of this. `pupil_outline` is the closer fit
at one stop and focus.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.ir import Graph, Value

Array = NDArray[np.float64]
_HAIR = 1e-18  # mm
# Gauss's nodes and weights over a disc, along a diameter.
_NODES = ((-(0.5**0.5), 0.25), (0.0, 0.5), (0.5**0.5, 0.25))
_TIP = 1e-7  # of 1 - X^2, near the ends of an arc
RADIUS = 4  # powers of the film radius


@dataclass(frozen=True)
class PupilArcs:
    """Arcs that hold the passing rays of film points, mm on the pupil plane.

    Attributes:
        film_radius_mm: beyond it no light passes. film_z_mm, stop_radius_mm: middle and half range of film positions;
            the widest stop. wave: middle and half range of (1000 / wavelength)^2.
        numbers: [3, 4, M]: of the stop's image, and of rims on the film point's side and on the other, the low end, the
            high end and two factors, as polynomials of the monomials `exponents` [M, 4] in film radius, stop, film
            position and wavelength, scaled to 1. Rows of rims that never block hold everything.
        passing: share of the points that pass, by stop.
    """

    film_radius_mm: float
    film_z_mm: tuple[float, float]
    stop_radius_mm: float
    wave: tuple[float, float]
    numbers: Array
    exponents: NDArray[np.int64]
    used: tuple[bool, ...]

    def scaled(self, radius: Array, stop: float, film_z: float, nanometres: Array) -> Array:
        """[4, ...]: film radius, stop, film position and wavelength as the polynomials take them."""
        (middle, half), (mean, reach) = self.film_z_mm, self.wave
        call = stop / self.stop_radius_mm, (film_z - middle) / half
        parts = radius / self.film_radius_mm, *call, ((1000 / nanometres) ** 2 - mean) / reach
        return np.stack(np.broadcast_arrays(*parts))

    @cached_property
    def graph(self) -> Graph:
        """The pupil point of a film point and a point of the unit square.

        Inputs: `film_mm`, `square` [2], `wavelength_nm`; of the call `film_z_mm`, `stop_radius_mm`.
        Outputs: `pupil_mm` [2], and
        `area_mm2`, the inverse of its density, 0 or less where nothing passes; points mean nothing there;
        `mean_area_mm2`, its mean over the square.
        """
        g = Graph()
        film, square = g.input("film_mm", 2), g.input("square", 2)
        radius = g.square(film).sqrt()
        arcs = self._arcs(g, radius * (1 / self.film_radius_mm))
        disc = unit_disc(square)
        low, high = _ends(arcs)
        half, along, across = (high - low) * 0.5, disc[0], disc[1]
        left, right = along + 1.0, 1.0 - along

        # Written from the ends, so that rounding leaves no side negative.
        def stretch(left: Value, right: Value) -> Value:
            rows = [arc.height(half * left + (low - arc.low), half * right + (arc.high - high)) for arc in arcs]
            return (_least(rows) / (left * right).maximum(_TIP)).maximum(0.0).sqrt()

        here = stretch(left, right)
        x, y = (low + high) * 0.5 + half * along, across * here
        turn = (film + [_HAIR, 0.0]) * (1.0 / (radius + _HAIR))
        inside = radius <= self.film_radius_mm
        g.outputs["pupil_mm"] = turn * x + g.affine([[0.0, -1.0], [1.0, 0.0]], turn) * y
        g.outputs["area_mm2"] = g.select(inside, half * here * math.pi, 0.0)
        one = g.constant(1.0)
        nodes = [stretch(one * (1 + x), one * (1 - x)) * w for x, w in _NODES]
        g.outputs["mean_area_mm2"] = half * (nodes[0] + nodes[1] + nodes[2]) * math.pi
        return g

    def _arcs(self, g: Graph, radius: Value) -> list[Arc]:
        """The arcs of a film radius, by Horner's rule with coefficients of the call."""
        stop, film_z = g.input("stop_radius_mm", per_call=True), g.input("film_z_mm", per_call=True)
        (middle, half), (mean, reach) = self.film_z_mm, self.wave
        call = g.concat(stop * (1 / self.stop_radius_mm), (film_z - middle) * (1 / half))
        inverse = 1000.0 / g.input("wavelength_nm")
        arcs = []
        for kind in np.flatnonzero(self.used):
            rows = self._horner(g, self.numbers[kind], 0, radius, call)
            if kind == 0:
                rows = rows + self._horner(g, self.numbers[kind], 1, radius, call) * (
                    inverse * inverse * (1 / reach) - mean / reach
                )
            arcs.append(Arc(*g.split(rows, (1, 1, 1, 1))))
        return arcs

    def _horner(self, g: Graph, numbers: Array, wave: int, radius: Value, call: Value) -> Value:
        """Rows of the terms of one power of the wavelength's variable."""
        rows: Value | None = None
        own = self.exponents[:, 3] == wave
        for power in range(self.exponents[own, 0].max(), -1, -1):
            here = own & (self.exponents[:, 0] == power)
            term = self._of_call(g, self.exponents[here, 1:3], numbers[:, here], call)
            rows = term if rows is None else rows * radius + term
        assert rows is not None
        return rows

    def _of_call(self, g: Graph, exponents: NDArray[np.int64], numbers: Array, call: Value) -> Value:
        """Rows of polynomials in the stop and, to first order, film position: the stop is known before the focus is."""
        moves = exponents[:, 1] == 1
        still, moved = (g.polynomial(exponents[part, :1], numbers[:, part], call[0]) for part in (~moves, moves))
        return still + moved * call[1] if moves.any() else still

    @cached_property
    def checked(self) -> Graph:
        """Whether rays lie inside: inputs `film_mm`, `pupil_mm` [2] of film points on +x; outputs by arc."""
        g = Graph()
        pupil = g.input("pupil_mm", 2)
        arcs = self._arcs(g, g.input("film_mm", 2)[0] * (1 / self.film_radius_mm))
        rows = [(pupil[0] - arc.low, arc.high - pupil[0]) for arc in arcs]
        g.outputs["left"], g.outputs["right"] = (g.concat(*side) for side in zip(*rows, strict=True))
        g.outputs["height"] = g.concat(*(arc.height(*row) for arc, row in zip(arcs, rows, strict=True)))
        return g


@dataclass(frozen=True)
class Arc:
    """y^2 = (x - low) (high - x) (first + (x - low) change), each one row."""

    low: Value
    high: Value
    first: Value
    change: Value

    def height(self, left: Value, right: Value) -> Value:
        """y^2 at distances from the ends."""
        return left * right * (self.first + self.change * left)


def unit_disc(square: Value) -> Value:
    """The point [2] of the unit disc of a point of the unit square, evenly (Shirley and Chiu 1997)."""
    g = square.graph
    a, b = g.split(square * 2.0 - 1.0, (1, 1))
    flat = b.abs() <= a.abs()
    size = g.select(flat, a, b)
    angle = g.select(flat, b, a) / g.select(size.abs() <= _HAIR, 1.0, size)
    squared = angle * angle
    cos = size * g.series(squared, _COS)
    sin = size * angle * g.series(squared, _SIN)
    return g.concat(g.select(flat, cos, sin), g.select(flat, sin, cos))


def _chebyshev(function: Callable[[Array], Array]) -> Array:
    """On squares of angles of up to pi / 4, in units of that: to float32's last bit."""
    fit = np.polynomial.Chebyshev.interpolate(function, 4, [0, 1])
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, np.float64)


_COS = _chebyshev(lambda s: np.cos(np.pi / 4 * np.sqrt(np.maximum(s, 0))))
_SIN = _chebyshev(lambda s: np.pi / 4 * np.sinc(np.sqrt(np.maximum(s, 0)) / 4))


def _least(values: list[Value]) -> Value:
    found = values[0]
    for value in values[1:]:
        found = found.minimum(value)
    return found


def _ends(arcs: list[Arc]) -> tuple[Value, Value]:
    return -_least([-arc.low for arc in arcs]), _least([arc.high for arc in arcs])
