"""The pupil of every film point, filled exactly: outlines of what passes, by film radius, and points inside them.

Rays that pass a lens from one film point cross the pupil plane in a region bounded by a few smooth arcs: the images of
the stop and of the rims that vignette. A polygon about a centre inside it, interpolated between film radii, holds the
region so closely that nearly every ray sent through it passes. The arcs move with the wavelength, by 2% of the pupil
over the visible range in a double Gauss, and so do the polygons.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray


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
        """Points that fill the polygons of film points evenly.

        The square's concentric squares become concentric copies of the polygon, as for Shirley and Chiu's disk (1997):
        neighbours stay neighbours, and inside each triangle between centre and edge areas stay in proportion.

        Args:
            film_mm: [2, N].
            square: [2, N] in [0, 1).
            wavelength_nm: [N].

        Returns the points [2, N] in mm, and for each the area [N] in mm^2 of pupil plane per area of the square, 0
        where nothing passes: the inverse of its probability density. It varies little over a polygon, whose area is
        its mean.
        """
        radius = np.sqrt(np.einsum("in,in->n", film_mm, film_mm))
        row, step, lit = self.place(radius)
        a = square[0] * np.float32(2)
        a -= np.float32(1)
        b = square[1] * np.float32(2)
        b -= np.float32(1)
        height = np.abs(b)
        size = np.maximum(np.abs(a), height)
        # Along the upper half of a concentric square, from 0 at +x over 2 at +y to 4 at -x; the centre has no place.
        scale = np.float32(1) / np.maximum(size, np.float32(1e-30))
        along = np.float32(2) - a * scale * (np.float32(2) - height * scale)
        segments = self.x.shape[2] - 1
        along *= np.float32(segments / 4)
        with np.errstate(invalid="ignore"):  # NaN is in no segment: any will do
            edge = np.clip(along.astype(np.intp), 0, segments - 1)
        along -= edge
        x, y, dx, dy = self._edge(row * segments + edge, step, wavelength_nm)
        area = x * dy
        area -= y * dx
        area *= np.float32(segments)
        area *= lit
        # Where the light ends, rows between which the outline turns leave slivers of negative area: nothing (1e-6).
        np.maximum(area, np.float32(0), out=area)
        dx *= along
        dx += x
        dx *= size
        dy *= along
        dy += y
        dy *= np.copysign(size, b)
        centre, centre_step = self.centres.take(row, axis=1)
        centre_step *= step
        dx += centre
        dx += centre_step
        return turned(dx, dy, film_mm, radius), area

    def place(self, radius: FloatArray) -> tuple[NDArray[np.intp], FloatArray, NDArray[np.bool_]]:
        """Row below each film radius [N], the fraction of the way to the next, and whether light arrives there."""
        last = self.centre.size - 1
        inner = np.float32(1) - radius * np.float32(1 / self.film_radius_mm)
        lit = inner >= 0
        # NaN and what lies beyond the end are taken for the axis; they carry no area.
        place = np.float32(last) * (np.float32(1) - np.sqrt(np.where(lit, inner, np.float32(1))))
        row = np.minimum(place.astype(np.intp), last)
        return row, place - row, lit

    def radii(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Film radii in mm of (fractional) rows: the inverse of `place`."""
        return self.film_radius_mm * (1 - (1 - place / (self.centre.size - 1)) ** 2)

    def _edge(self, index: NDArray[np.intp], step: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """First vertex (x, y) and edge (dx, dy) [4, N] at a fraction of the way to the next row, for wavelengths."""
        known = self.edges.take(index, axis=2)
        rows = known[:, 4:]
        rows *= step
        here = known[:, :4]
        here += rows
        if len(known) == 1:
            return here[0]
        change = here[1]
        change *= self.share(wavelength_nm)
        change += here[0]
        return change

    def share(self, wavelength_nm: FloatArray) -> FloatArray:
        """How far each wavelength [N] lies from the first of the outline's to the second, in 1 / wavelength^2."""
        first, second = (w**-2 for w in self.wavelength_nm)
        share = wavelength_nm**-2
        share -= np.float32(first)
        share *= np.float32(1 / (second - first))
        return np.clip(share, np.float32(0), np.float32(1), out=share)

    @cached_property
    def edges(self) -> FloatArray:
        """[W, 8, R * K]: first vertex and edge at each row, their steps to the next row; second the change of all."""
        first = np.stack([self.x[..., :-1], self.y[..., :-1], np.diff(self.x), np.diff(self.y)], axis=1)
        steps = np.diff(first, axis=2, append=first[:, :, -1:])
        both = np.concatenate([first, steps], axis=1)
        both[1:] -= both[:1]
        return np.ascontiguousarray(both.reshape(len(both), 8, -1), np.float32)

    @cached_property
    def centres(self) -> FloatArray:
        """[2, R]: centre at each row and its step to the next."""
        return np.stack([self.centre, np.diff(self.centre, append=self.centre[-1:])]).astype(np.float32)


def wavelength_between(wavelength_nm: tuple[float, ...], share: float) -> float:
    """The wavelength in nm at a share of the way from the first to the last, in 1 / wavelength^2."""
    first, last = wavelength_nm[0], wavelength_nm[-1]
    if share in (0, 1):  # no rounding may leave the range
        return last if share else first
    return first if first == last else float((first**-2 + share * (last**-2 - first**-2)) ** -0.5)


def turned(along: FloatArray, across: FloatArray, film_mm: FloatArray, radius: FloatArray) -> FloatArray:
    """Points [2, N] of film points on +x, turned to the azimuth of the film points [2, N] at the radii given."""
    on_axis = radius == 0
    scale = np.float32(1) / np.where(on_axis, np.float32(1), radius)
    with np.errstate(invalid="ignore"):  # infinite film points, which carry no area
        cos, sin = film_mm[0] * scale + on_axis, film_mm[1] * scale
    return np.stack([along * cos - across * sin, along * sin + across * cos])
