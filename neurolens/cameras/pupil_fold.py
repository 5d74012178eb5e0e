"""The image of a stop that folds in the pupil: far off the axis of simple lenses, two parts of the pupil show one part
of the stop.

Along x the place in the stop rises to a peak and falls again, steeply: s = (a + b x + c x^2) / (1 + d x + e x^2), in
the stop's widest radii. A stop of radius r ends where s^2 + y^2 (f + g x + h x^2) = r^2, whatever it is: no number of
the eight depends on it. Its ends along x are roots: s = -r at both, or, before the image folds, s = r at the high one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.ir import Value

Array = NDArray[np.float64]
# Which share of a way from a point of the stop its blades leave.
Opening = Callable[[Value, Value], Value]
NUMBERS = 8
LEAST, _SMALL = 0.02, 1e-9  # of 1 + d x + e x^2: beyond lies the pole; of what is divided by


@dataclass(frozen=True)
class Fold:
    """Such an image of a film point, in place of an `Arc`.

    Attributes:
        low, high: its ends, mm. unfolded: whether s = r at the high one. size: of the stop. slope, bend: s + r is
            (slope + bend x) / (1 + d x + e x^2) times the distance from the low end. numbers: the eight.
    """

    low: Value
    high: Value
    unfolded: Value
    size: Value
    slope: Value
    bend: Value
    numbers: Sequence[Value]

    @staticmethod
    def of(numbers: Sequence[Value], size: Value, rim: Value) -> Fold:
        """Of the eight numbers; rim: where light ends at the latest."""
        a, b, c, d, e, *_ = numbers

        def roots(r: Value) -> tuple[Value, Value, Value, Value, Value]:
            """Of the places where s = -r, r of either sign: discriminant, slope and bend, the low and the high one."""
            bend, way = c + e * r, b + d * r
            square = way * way - bend * (a + r) * 4.0
            slope = ((way + square.maximum(0.0).sqrt()) * 0.5).maximum(_SMALL)
            return square, slope, bend, -(a + r) / slope, slope / (-bend).maximum(_SMALL)

        # Where it folds deeply, s = r again beyond the pole: an end of nothing.
        (_, slope, bend, low, folded), (square, _, _, high, again) = roots(size), roots(-size)
        unfolded = (-square <= 0.0) & (rim <= again) & (high <= folded)
        return Fold(low, low.graph.select(unfolded, high, folded).minimum(rim), unfolded, size, slope, bend, numbers)

    @property
    def change(self) -> Value:
        """How y^2 is multiplied at x = 0, by x."""
        return self.numbers[6]

    def height(self, left: Value | None, right: Value | None) -> Value:
        """y^2 at a distance from the low end."""
        assert left is not None
        x = self.low + left
        above = self._above(left, x)
        return above * (self.size * 2.0 - above) / self._wide(x)

    def at_stop(self, x: Value, y: Value) -> tuple[Value, Value, Value]:
        """As of an `Arc`."""
        return self._above(x - self.low, x) - self.size, y * self._wide(x).sqrt(), self.size

    def where_unfolded(self, opening: Opening) -> Opening:
        """The share of a way that blades leave, all where the image folds: ways in the stop are not straight there."""
        return lambda start, way: start.graph.select(self.unfolded, opening(start, way), 1.0)

    def _above(self, left: Value, x: Value) -> Value:
        """s + r."""
        _, _, _, d, e, *_ = self.numbers
        return left * (self.slope + self.bend * x) / ((e * x + d) * x + 1.0).maximum(LEAST)

    def _wide(self, x: Value) -> Value:
        f, g, h = self.numbers[5:]
        return ((h * x + g) * x + f).maximum(_SMALL)


def fold_margins(rows: Array, x: Array, y: Array, size: Array) -> tuple[Array, list[Array | None], Array]:
    """How far points lie within images of these numbers [8, N], about in the stops' radii; its slopes by these, times
    the scale; the scale."""
    a, b, c, d, e, f, g, h = rows
    inverse = 1 / np.maximum(1 + (d + e * x) * x, LEAST)
    along = (a + (b + c * x) * x) * inverse
    scale, by, wide = 2 * size**2, -2 * along * inverse, y**2
    within, bent = (size**2 - along**2 - wide * (f + (g + h * x) * x)) / scale, -by * along * x
    return within, [by, by * x, by * x**2, bent, bent * x, -wide, -wide * x, -wide * x**2], scale
