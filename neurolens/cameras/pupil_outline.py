"""The pupil of every film point, filled exactly: outlines of what passes, by film radius, and points inside them.

Rays that pass a lens from one film point cross the pupil plane in a region bounded by a few smooth arcs: the images of
the stop and of the rims that vignette. A polygon about a centre inside it, interpolated between film radii, holds the
region so closely that nearly every ray sent through it passes. The arcs move with the wavelength, by 2% of the pupil
over the visible range in a double Gauss, and so do the polygons.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph

_HAIR = 1e-18  # mm


@dataclass(frozen=True)
class PupilOutline:
    """Polygons on the pupil plane that hold the passing rays of film points, by film radius and wavelength.

    For a film point at radius r along +x the polygon has its centre at (centre, 0) and is symmetric about the x axis;
    `x`, `y` are the vertices of its upper half relative to the centre, from +x to -x. Film radii grow by less and
    less: row i of R lies at (1 - (1 - i / (R - 1))^2) of the last radius, for near the end of the light the region
    shrinks as the root of the distance to it, which then is linear from row to row.

    Attributes:
        pupil_z_mm: the plane.
        film_radius_mm: radius of the last row: beyond it no ray passes. The first row is the axis.
        wavelength_nm: the W wavelengths of `x` and `y`, one or two; between two, vertices go with 1 / wavelength^2.
        centre: [R] mm.
        x, y: [W, R, K + 1] mm; y is 0 at both ends.
    """

    pupil_z_mm: float
    film_radius_mm: float
    wavelength_nm: tuple[float, ...]
    centre: FloatArray
    x: FloatArray
    y: FloatArray

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Points that fill the polygons of film points evenly, by `graph`.

        Args:
            film_mm: [2, N].
            square: [2, N] in [0, 1).
            wavelength_nm: [N].

        Returns the points [2, N] in mm, and for each the area [N] in mm^2 of pupil plane per area of the square, 0
        where nothing passes: the inverse of its probability density. It varies little over a polygon, whose area is
        its mean.
        """
        given = {"film_mm": film_mm, "square": square, "wavelength_nm": wavelength_nm[None], "outline": self.table}
        given |= {name: np.array([[value]], np.float32) for name, value in self.numbers.items()}
        found = evaluate(self.graph, given)
        area = found["area_mm2"][0]
        return found["pupil_mm"], np.where(area > 0, area, np.float32(0))

    def on_plane(self, pupil_z_mm: float, film_z_mm: float) -> PupilOutline:
        """The same rays on another plane, those of the film at a place."""
        scale = np.float32((pupil_z_mm - film_z_mm) / (self.pupil_z_mm - film_z_mm))
        film = self.radii(np.arange(self.centre.size, dtype=np.float64)).astype(np.float32)
        centre = film + (self.centre - film) * scale
        return replace(self, pupil_z_mm=pupil_z_mm, centre=centre, x=self.x * scale, y=self.y * scale)

    @property
    def graph(self) -> Graph:
        """The outline's `pupil_graph`."""
        return pupil_graph(self.x.shape[2] - 1, len(self.x))

    def radii(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Film radii in mm of (fractional) rows."""
        return self.film_radius_mm * (1 - (1 - place / (self.centre.size - 1)) ** 2)

    @cached_property
    def numbers(self) -> dict[str, float]:
        """The inputs of the call of `pupil_graph`."""
        waves = [w**-2 for w in self.wavelength_nm]
        numbers = {"per_radius": 1 / self.film_radius_mm, "last_row": float(self.centre.size - 1)}
        if len(self.x) > 1:
            numbers |= {"wave_first": waves[0], "wave_scale": 1 / (waves[1] - waves[0])}
        return numbers

    @cached_property
    def table(self) -> FloatArray:
        """The table of `pupil_graph`, [R * (K + 1), 10 W]; each column is contiguous.

        Groups of columns (weights 1, step, share, share step): first vertex and edge (x, y, dx, dy) at a row, and
        centre; their steps to the next row; and of two wavelengths the change of both from the first to the second.
        The last cell of a row is its end, which belongs to the last edge.
        """
        edges = [np.diff(c, append=2 * c[..., -1:] - c[..., -2:-1]) for c in (self.x, self.y)]
        centre = np.broadcast_to(self.centre[:, None], self.x.shape)
        here = np.stack([self.x, self.y, *edges, centre], 1)  # [W, 5, R, K + 1]
        here[1:] -= here[:1]
        groups = np.stack([here, np.diff(here, axis=2, append=here[:, :, -1:])], 1)
        return np.ascontiguousarray(groups.reshape(10 * len(here), -1), np.float32).T


@cache
def pupil_graph(segments: int, wavelengths: int) -> Graph:
    """The pupil point of a film point, of a point of the unit square and a wavelength, and its area, as a graph.

    The square's concentric squares become concentric copies of the polygon, as for Shirley and Chiu's disk (1997):
    neighbours stay neighbours, and inside each triangle between centre and edge areas stay in proportion.

    Args:
        segments: K, of the upper half of a polygon. wavelengths: of the outline, 1 or 2.

    Inputs: `film_mm`, `square` [2], `wavelength_nm`; of the call the table `outline` (`PupilOutline.table`),
    `per_radius` (1 / the last film radius), `last_row`, and of two wavelengths `wave_first`, `wave_scale`: the share of
    the second is (1 / wavelength^2 - first) scale.
    Outputs: `pupil_mm` [2], and `area_mm2`, that of `PupilOutline.sample`, but negative or NaN where nothing passes;
    points mean nothing there.
    """
    g = Graph()
    film, square, wavelength = g.input("film_mm", 2), g.input("square", 2), g.input("wavelength_nm")
    per_radius, last_row = (g.input(name, per_call=True) for name in ("per_radius", "last_row"))
    radius = g.square(film).sqrt()
    inner = 1.0 - radius * per_radius
    place = (1.0 - inner.maximum(0.0).sqrt()) * last_row
    row = place.floor()
    step = place - row
    a, b = g.split(square - 0.5, (1, 1))
    height = b.abs()
    size = a.abs().maximum(height)
    # Along the upper half of a concentric square, from 0 at +x over 2 at +y to 4 at -x; the centre has no place.
    per_size = 1.0 / size.maximum(1e-30)
    along = (2.0 - a * per_size * (2.0 - height * per_size)) * (segments / 4)
    edge = along.floor()
    cell, weights = row * (segments + 1.0) + edge, g.concat(g.constant(1.0), step)
    if wavelengths > 1:
        first, scale = (g.input(name, per_call=True) for name in ("wave_first", "wave_scale"))
        share = ((1.0 / (wavelength * wavelength) - first) * scale).clip(0.0, 1.0)
        weights = g.concat(weights, share, share * step)
    vertex, side, centre = g.split(g.lookup(g.table("outline", 10 * wavelengths), cell, weights), (2, 2, 1))
    products = vertex * g.affine([[0.0, 1.0], [1.0, 0.0]], side)
    area = g.affine([[float(segments), -float(segments)]], products).minimum(inner * 1e30)  # none beyond the end
    sign = (b * 1e30).clip(-1.0, 1.0)
    x, y = g.split(vertex + side * (along - edge), (1, 1))
    size = size * 2.0
    x, y = x * size, y * (size * sign)
    # Turned to the azimuth of the film point; on the axis (a hair beside it, far below rounding) that is 0.
    turn = (film + [_HAIR, 0.0]) * (1.0 / (radius + _HAIR))
    pupil = turn * (x + centre) + g.affine([[0.0, -1.0], [1.0, 0.0]], turn) * y
    g.outputs = {"pupil_mm": pupil, "area_mm2": area}
    return g


def wavelength_between(wavelength_nm: tuple[float, ...], share: float) -> float:
    """The wavelength in nm at a share of the way from the first to the last, in 1 / wavelength^2."""
    first, last = wavelength_nm[0], wavelength_nm[-1]
    if share in (0, 1):  # no rounding may leave the range
        return last if share else first
    return first if first == last else float((first**-2 + share * (last**-2 - first**-2)) ** -0.5)
