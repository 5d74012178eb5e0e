"""The pupil of every film point at any stop and film position, for shaders: the stop's disc, cut by circles.

The rays that pass a lens cross its stop within the opening, and within what the rims before and behind the stop leave
of that. In points of the stop, rims are circles whose centres and radii are short polynomials of the film point.
Samples fill what the circles have in common, and `shader_lens.StopImage` maps them to the pupil.

There is no table, since in a renderer's shader a table costs more than all of this. `pupil_outline` fits the pupil more
closely, but at one stop and focus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.cameragraph import unit_disc
from neurolens.cameras.shaders.shader_lens import HAIR, ShaderLens, StopImage, frame_of_film_point, moving_polynomial
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Graph, Value

MAX_BLADES = 16
# share of the stop's radius: how near the middle of a pupil may come to an edge before points stay apart
_CLOSEST = 0.05


class Blades:
    """The opening of an `Aperture` whose numbers are inputs of the call.

    Inputs are `count` (below 3 the stop is round), `roundness` of the edges, and cosine and sine of half a blade's
    angle and of the first edge's direction (`half_cos`, `edge_cos` and so on). Points are in units of the stop's
    radius. The graph has a fixed number of edges; those of fewer blades repeat.
    """

    def __init__(self, g: Graph) -> None:
        names = "count", "roundness", "half_cos", "half_sin", "edge_cos", "edge_sin"
        count, roundness, cos, sin, *edge = (g.input(name, per_call=True) for name in names)
        self.none = count <= 2.5
        step_cos, step_sin = cos * cos - sin * sin, cos * sin * 2.0
        self.edges: list[tuple[Value, Value]] = []
        for _ in range(MAX_BLADES):
            self.edges.append((edge[0], edge[1]))
            edge = [edge[0] * step_cos - edge[1] * step_sin, edge[0] * step_sin + edge[1] * step_cos]
        rise = roundness * (1.0 - cos)
        self.curvature, self.middle = rise * 2.0 / (sin * sin + rise * rise), cos + rise
        self.scale = 1.0 - self.curvature * self.middle

    def _excess(self, point: Value) -> Value:
        """Return the part of the test of an edge that is the same for all edges.

        Added to it is `scale` times the point's distance along the edge's direction.

        The sum is above 0 beyond that edge; see `Aperture.opening`.
        """
        return self.curvature * 0.5 * (self.middle * self.middle + point.graph.square(point)) - self.middle

    def opened(self, point: Value) -> Value:
        """Return 1 for points [2] within the opening, 0 for others."""
        along = reduce(Value.maximum, (point[0] * cos + point[1] * sin for cos, sin in self.edges))
        inside = point.graph.select(along * self.scale + self._excess(point) <= 0.0, 1.0, 0.0)
        return point.graph.select(self.none, 1.0, inside)

    def drawn(self, start: Value, way: Value, margin: float) -> Value:
        """Return the share of a way [2] from a point [2] at which the opening ends, at most 1.

        A point at the share s lies beyond an edge where a s^2 + b s > c; the end is where 1 / s = (b + sqrt(b^2 + 4 a
        c)) / 2 c.

        Args:
            margin: by how much edges are moved outwards.
        """
        g = start.graph
        a, turned = self.curvature * 0.5 * g.square(way), self.curvature * g.dot(start, way)
        within, inverse = margin - self._excess(start), g.constant(1.0)
        for cos, sin in self.edges:
            along, ahead = (self.scale * (v[0] * cos + v[1] * sin) for v in (start, way))
            b, c = ahead + turned, (within - along).maximum(_CLOSEST)
            inverse = inverse.maximum((b + (b * b + 4.0 * a * c).sqrt()) * 0.5 / c)
        return g.select(self.none, 1.0, 1.0 / inverse)


Array = NDArray[np.float64]
_NODES = ((-(0.5**0.5), 0.25), (0.0, 0.5), (0.5**0.5, 0.25))  # Gauss's nodes and weights over a disc, along a diameter
_TIP = 1e-7  # least 1 - x^2, near the ends of a diameter
_ROUNDS = 2  # how often the blades are found from the pupil's middle, whose place depends on where they are


@dataclass(frozen=True)
class PupilCircles:
    """Circles that hold the passing rays of film points, in points of the stop in units of `image.stop_mm`.

    Attributes:
        film_radius_mm: beyond it no light passes.
        image: maps points of the stop to the pupil.
        wide: three numbers for how wide the stop's disc is. The first two are in units of the stop's radius: the width
            on the axis, and what the square of (film radius squared times the stop) adds. The third, in units of
            `image.stop_mm`, is added at all stops where the stop's image folds; there is no circle then, and the image
            only moves and scales the stop.
        exponents: [M, 3], of film x and y, scaled as in the image, and of the film position.
        numbers: [K, 3, M], for each rim's circle u^2 + v^2 <= c + 2 a u + 2 b v: c, a and b in these monomials.
        squeeze: scales film points' y where the direction is taken in which the pupil of an anamorphic lens is filled.
    """

    film_radius_mm: float
    image: StopImage
    wide: tuple[float, float, float]
    exponents: Exponents
    numbers: Array
    squeeze: float = 1.0

    @cached_property
    def graph(self) -> Graph:
        """Return the graph of `sampler` for a round stop."""
        return self.sampler()

    def sampler(self, blades: type[Blades] | None = None, margin: float = 0.0) -> Graph:
        """Write the graph from a film point and a point of the unit square to a pupil point.

        Args:
            blades: moves points of the disc towards its middle, to where the stop's blades end.
            margin: by how much blades are widened, in units of the stop's radius, because the image is not exact.

        Inputs are `film_mm`, `square` [2] and `wavelength_nm`; for a whole call, `film_z_mm` and `stop_radius_mm`.
        Outputs are `pupil_mm` [2]; `area_mm2`, the inverse of its density, 0 where nothing passes; `mean_area_mm2`, the
        mean of that over the square for a round stop, as if the pupil were stretched everywhere as at the point; and
        `at_stop` [2], about where the ray crosses the stop, in units of its radius.
        """
        g = Graph()
        film, square = g.input("film_mm", 2), g.input("square", 2)
        film_z, nanometres = g.input("film_z_mm", per_call=True), g.input("wavelength_nm")
        size = g.input("stop_radius_mm", per_call=True) * (1 / self.image.stop_mm)
        anamorphic, (radius, turn, aside) = self.image.anamorphic, frame_of_film_point(film)
        if self.squeeze != 1:
            _, turn, aside = frame_of_film_point(film * [1.0, self.squeeze])
        field = film if anamorphic else g.concat(radius, g.constant(0.0))
        disc_radius = self._disc(field, size)
        opening = _Circle(g.constant(0.0), None, disc_radius * disc_radius, disc_radius)
        shape = _Shape([opening, *self._rims(field, film_z, turn)])

        def at_stop(x: Value, y: Value) -> Value:
            return (turn * x + aside * y) * (1.0 / size)

        disc, share = unit_disc(square), g.constant(1.0)
        if blades is not None and not self.wide[2]:  # a point of a folded image is no place in the stop
            share = _within_blades(disc, shape, at_stop, blades(g), margin)
            disc = disc * share
        x, y, tall = shape.point(disc, disc[0])
        point = turn * x + aside * y if anamorphic else g.concat(x, y)
        pupil, stretched = self.image.placed(field, film_z, nanometres, point * self.image.stop_mm)
        if not anamorphic:
            pupil = turn * pupil[0] + aside * pupil[1]
        unit = stretched * (shape.half * (math.pi * self.image.stop_mm**2))
        lit = (radius <= self.film_radius_mm) & (shape.low <= shape.high)
        g.outputs = {"pupil_mm": pupil, "at_stop": at_stop(x, y)}
        g.outputs["area_mm2"] = g.select(lit, tall * (share * share) * unit, 0.0)
        one = g.constant(1.0)
        first, *others = (shape.chord(one * x)[1] * weight for x, weight in _NODES)
        g.outputs["mean_area_mm2"] = sum(others, first) * unit
        return g

    def _disc(self, film: Value, size: Value) -> Value:
        """Return the radius of the stop's disc."""
        g = film.graph
        grown = g.square(film * (1 / self.image.film_mm)) * size
        # They have names, so that states in which they equal other numbers of the graph keep the same structure.
        first, second, more = (g.constant(value, f"wide {k}") for k, value in enumerate(self.wide))
        disc = size * (grown * grown * second + first)
        return disc + more if self.wide[2] else disc

    def _rims(self, field: Value, film_z: Value, turn: Value) -> list[_Circle]:
        """Return the rims' circles in the frame in which the disc is filled."""
        circles = []
        for c, a, b in self._rows(field, film_z):
            if self.image.anamorphic:
                a, b = turn[0] * a + turn[1] * b, turn[0] * b - turn[1] * a
                level = c + b * b
                circles.append(_Circle(a, b, level, (level + a * a).maximum(0.0).sqrt()))
            else:
                circles.append(_Circle(a, None, c, (c + a * a).maximum(0.0).sqrt()))
        return circles

    def _rows(self, film: Value, film_z: Value) -> list[tuple[Value, Value, Value]]:
        """Return c, a and b of every circle; those that are 0 by symmetry have no terms."""
        g, (middle, half) = film.graph, self.image.film_z_mm
        position, variables = (film_z - middle) * (1 / half), film * (1 / self.image.film_mm)
        circles = []
        for numbers in self.numbers:
            rows = []
            for k, row in enumerate(numbers):
                terms = self._terms(k)
                some = (
                    moving_polynomial(self.exponents[terms], row[terms], variables, position) if terms.any() else None
                )
                rows.append(g.constant(0.0) if some is None else some)
            circles.append((rows[0], rows[1], rows[2]))
        return circles

    def _terms(self, row: int) -> NDArray[np.bool_]:
        """Return which monomials c, a or b has by symmetry."""
        x, y = self.exponents[:, 0] + (row == 1), self.exponents[:, 1] + (row == 2)
        return np.asarray((x % 2 == 0) & (y % 2 == 0) & (self.image.anamorphic | (row < 2)))

    @cached_property
    def checked(self) -> Graph:
        """Write the graph of how far points of the stop lie inside.

        Inputs are `film_mm`, `point_mm` [2], `film_z_mm` and `stop_radius_mm`; a round lens takes points in the film
        point's frame. The output `within` is how far inside the disc, then inside each circle.
        """
        g = Graph()
        film, point = g.input("film_mm", 2), g.input("point_mm", 2) * (1 / self.image.stop_mm)
        size = g.input("stop_radius_mm") * (1 / self.image.stop_mm)
        square, disc = g.square(point), self._disc(film, size)
        rows = [disc * disc - square]
        for c, a, b in self._rows(film, g.input("film_z_mm")):
            rows.append(c + (a * point[0] + b * point[1]) * 2.0 - square)
        g.outputs["within"] = g.concat(*rows)
        return g

    def mixed(self, others: Sequence[PupilCircles], weights: Array) -> PupilCircles:
        """Return the pupil in a state between nodes: this pupil and others of the same lens, mixed by these weights."""
        states = [self, *others]

        def mean(values: Sequence[Array | float]) -> Array:
            return np.tensordot(weights, np.asarray(values, np.float64), 1)

        middle, half = zip(*(s.image.film_z_mm for s in states), strict=True)
        image = replace(
            self.image,
            film_z_mm=(float(mean(middle)), 1 / float(mean([1 / h for h in half]))),
            numbers=mean([s.image.numbers for s in states]),
        )
        first, second, more = mean([np.array(s.wide) for s in states])
        radius, numbers = float(mean([s.film_radius_mm for s in states])), mean([s.numbers for s in states])
        return replace(self, film_radius_mm=radius, image=image, wide=(first, second, more), numbers=numbers)


@dataclass(frozen=True)
class _Circle:
    """A circle (x' - x)^2 + (y' - y)^2 <= radius^2 in the frame in which the disc is filled.

    Here y is None if all centres lie on the x axis. Its half height at x' is the root of level + 2 x x' - x'^2.
    """

    x: Value
    y: Value | None
    level: Value
    radius: Value

    @property
    def low(self) -> Value:
        return self.x - self.radius

    @property
    def high(self) -> Value:
        return self.x + self.radius


class _Shape:
    """The region that circles have in common, of which the first is the stop's.

    The unit disc is mapped to it chord by chord, so that densities stay nearly even.
    """

    def __init__(self, circles: Sequence[_Circle]) -> None:
        self.circles = circles
        self.low = reduce(Value.maximum, (c.low for c in circles))
        self.high = reduce(Value.minimum, (c.high for c in circles))
        self.half, self.middle = (self.high - self.low) * 0.5, (self.low + self.high) * 0.5

    def chord(self, x: Value) -> tuple[Value | None, Value]:
        """Return the middle along y (None: 0) of the unit disc's chord at x, and its half height over the disc's."""
        square, at = ((x + 1.0) * (1.0 - x)).maximum(_TIP), self.middle + self.half * x
        twice, below = at * 2.0, at * at
        levels = [c.level + c.x * twice for c in self.circles]
        if all(c.y is None for c in self.circles):
            return None, ((reduce(Value.minimum, levels) - below) / square).maximum(0.0).sqrt()
        first, *others = ((level - below).maximum(0.0).sqrt() for level in levels)
        top, bottom = first, -first
        for circle, tall in zip(self.circles[1:], others, strict=True):
            assert circle.y is not None
            top, bottom = top.minimum(circle.y + tall), bottom.maximum(circle.y - tall)
        return (top + bottom) * 0.5, ((top - bottom) * 0.5).maximum(0.0) / square.sqrt()

    def point(self, disc: Value, x: Value) -> tuple[Value, Value, Value]:
        """Return x, y and the half height over that of the disc, for a point of the unit disc on the chord at x."""
        centre, tall = self.chord(x)
        y = disc[1] * tall
        return self.middle + self.half * disc[0], y if centre is None else centre + y, tall


def _within_blades(
    disc: Value, shape: _Shape, at_stop: Callable[[Value, Value], Value], blades: Blades, margin: float
) -> Value:
    """Return the factor that moves a point of the disc towards the middle until it lies within the blades."""
    g = disc.graph
    centre, _ = shape.chord(g.constant(0.0))
    start = at_stop(shape.middle, g.constant(0.0) if centre is None else centre)
    direction, share = disc * (1.0 / (g.square(disc).sqrt() + HAIR)), g.constant(1.0)
    for _ in range(_ROUNDS):
        x, y, _ = shape.point(direction, direction[0] * share)
        share = blades.drawn(start, at_stop(x, y) - start, margin)
    return share


_SAMPLES, _TRIES = 20_000, 64  # film points; samples that decide whether one has light


def passing_share(
    lens: ShaderLens, pupil: PupilCircles, stops: Sequence[float] = (1.0, 0.5, 0.25)
) -> dict[float, float]:
    """Return the share of samples that pass, all over the film, by shares of the widest stop.

    Film points without light do not count. One whose ray is blocked counts where any of 64 more rays passes.
    """
    rng, shares = np.random.default_rng(3), {}
    for stop in stops:
        angle, radius = 2 * np.pi * rng.random(_SAMPLES), 0.98 * pupil.film_radius_mm * np.sqrt(rng.random(_SAMPLES))
        film = radius * np.stack([np.cos(angle), np.sin(angle)])
        call = np.stack([rng.uniform(*span, _SAMPLES) for span in (lens.film_z_mm, lens.wavelength_nm)])
        passed = _sampled(lens, pupil, rng.random((2, _SAMPLES)), film, call, stop)
        blocked = np.flatnonzero(~passed)
        lit, tries = np.zeros(blocked.size, bool), 0
        while tries < _TRIES and not lit.all():
            # Each round doubles the rays of a dark point, because a call with few rays takes nearly as long as one with
            # many.
            more = min(max(1, min(tries, _SAMPLES // int(np.count_nonzero(~lit)))), _TRIES - tries)
            dark, tries = np.repeat(blocked[~lit], more), tries + more
            again = _sampled(lens, pupil, rng.random((2, dark.size)), film[:, dark], call[:, dark], stop)
            lit[~lit] = again.reshape(-1, more).any(1)
        shares[stop] = float(passed.sum() / max(passed.sum() + lit.sum(), 1))
    return shares


def _sampled(
    lens: ShaderLens, pupil: PupilCircles, square: Array, film: Array, call: Array, share: float
) -> NDArray[np.bool_]:
    """Test whether rays [N] of points of the unit square pass, at film positions and wavelengths `call` [2, N]."""
    (film_z, nanometres), stop = call, np.array([[share * lens.stop_radius_mm]])
    sample = evaluate(pupil.graph, {
        "film_mm": film, "square": square, "film_z_mm": film_z[None], "wavelength_nm": nanometres[None],
        "stop_radius_mm": stop,
    })  # fmt: skip
    status = lens.status(film, sample["pupil_mm"], nanometres, film_z, stop)
    return np.asarray((status == st.PASSED) & (sample["area_mm2"][0] > 0))
