"""Boxes on a lens's front surface at which light from the scene is aimed, by the angle from which the light comes.

Light of a direction that reaches the film crosses a part of the front surface that moves with the angle to the axis.
What comes from a scene point has directions as far apart as the front is wide as seen from there: the boxes of all of
them hold what passes, at any field angle, also beyond 90 degrees. Of far points so aimed, 0.2 to 0.7 pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.lenscamera import LensFilm
from neurolens.lens.prescription import Surface
from neurolens.trace.shapes import sag_and_derivatives
from neurolens.trace.surfaces import meet_front

Array = NDArray[np.float64]

_RAYS, _BINS = 2**17, 64  # rays that look for the boxes; intervals of the angle
_BEYOND = 0.02  # of the boxes' widths, against what lies between those rays


class Aim(NamedTuple):
    """Points on the front surface [3, N] in mm, lens frame; unit directions [3, N] from them to the scene points; area
    [N] in mm^2 per unit area of the square, times the cosine to the surface's normal; status [N]."""

    position: Array
    direction: Array
    area: Array
    status: NDArray[np.int32]


@dataclass(frozen=True)
class FrontAim:
    """Boxes on a front surface that hold the light of a film.

    Attributes:
        shape: of the surface; None is the plane z = 0.
        angle_rad: end of the last of equal intervals of the angle to the axis.
        boxes: [4, L, B] mm: low and high along the azimuth of the direction, half width across, and farthest from the
            axis; row l of L joins the boxes of 2^l intervals on either side. low > high where nothing arrives.
        reach_mm: from the vertex to the farthest point of all boxes, on the surface.
    """

    shape: Surface | None
    angle_rad: float
    boxes: Array
    reach_mm: float

    def box(self, point_mm: Array) -> Array:
        """For scene points [3, N] (mm, lens frame): low, high, half width in mm, cos and sin of the azimuth; [5, N]."""
        side, distance = np.hypot(point_mm[0], point_mm[1]), np.sqrt((point_mm**2).sum(0))
        angle = np.arctan2(side, -point_mm[2])
        # Directions from the surface differ from that of the vertex by no more than this, and their azimuths.
        apart = np.arcsin(np.minimum(self.reach_mm / np.maximum(distance, 1e-9), 1))
        turn = np.where(apart < np.pi / 2, np.sin(apart), 1) / np.maximum(np.sin(angle), 1e-12)
        _, levels, bins = self.boxes.shape
        width = self.angle_rad / bins
        level = np.minimum(np.ceil(np.log2(np.ceil(apart / width) + 1)).astype(np.intp), levels - 1)
        place = (angle / width).astype(np.intp)
        # Beyond the last interval, what is within reach lies in the boxes joined with the last one.
        beyond = np.maximum(place - (bins - 1), 0)
        dark = beyond > np.ceil(apart / width)
        low, high, half, far = self.boxes[:, level, np.minimum(place, bins - 1)]
        sine = np.minimum(turn, 1)
        # A box turned by that azimuth lies within one that is larger by what its farthest points move.
        spread = np.where(turn >= 1, 2.0, 1 - np.sqrt(1 - sine * sine)) * far + sine * half
        low, high, half = np.maximum(low - spread, -far), np.minimum(high + spread, far), half + sine * far
        on_axis = side == 0
        cos, sin = (c / np.where(on_axis, 1, side) for c in (point_mm[0] + on_axis, point_mm[1]))
        low = np.where(dark, high + 1, low)
        return np.stack([low, high, np.minimum(half, far), cos, sin])

    def aim(self, point_mm: Array, square: FloatArray) -> Aim:
        """Aim scene points [3, N] (mm, lens frame) at points of the surface that numbers [2, N] in [0, 1) choose."""
        finite = np.isfinite(point_mm).all(0)
        low, high, half, cos, sin = self.box(np.where(finite, point_mm, 0.0))
        along, across = low + (high - low) * square[0], half * (2 * square[1].astype(np.float64) - 1)
        x, y = along * cos - across * sin, along * sin + across * cos
        with np.errstate(all="ignore"):
            z, sx, sy = (np.zeros_like(x),) * 3 if self.shape is None else sag_and_derivatives(self.shape, x, y)
            position = np.stack([x, y, z])
            way = point_mm - position
            direction = way / np.sqrt(np.einsum("in,in->n", way, way))
            # dA cos = dx dy (d . n) / |n_z|, with the outward normal along (sx, sy, -1).
            facing = sx * direction[0] + sy * direction[1] - direction[2]
        status = np.where(facing > 0, st.PASSED, st.blocked(0, st.MISSED))
        status = np.where(high > low, status, st.blocked(0, st.RIM))
        status = np.where(finite, status, st.OUTSIDE_DOMAIN).astype(np.int32)
        return Aim(position, direction, 2 * half * (high - low) * facing, status)


def front_aim(film: LensFilm, film_mm: tuple[float, float], wavelength_nm: tuple[float, float], shape: Any) -> FrontAim:
    """The boxes that the light of a film crosses; `shape` is that of the front surface, None the plane z = 0."""
    scene = _leaving(film, film_mm, wavelength_nm)
    x, y = meet_front(shape, *scene)
    side = np.hypot(scene[3], scene[4])
    angle = np.arctan2(side, -scene[5])
    cos, sin = scene[3] / np.maximum(side, 1e-12), scene[4] / np.maximum(side, 1e-12)
    along, across = x * cos + y * sin, np.abs(y * cos - x * sin)
    end = 1.001 * float(angle.max())
    row = np.minimum(angle / end * _BINS, _BINS - 1).astype(np.intp)
    boxes = np.full((4, _BINS), -np.inf)  # of -low, high, half, far: the largest of each
    for column, values in zip(boxes, (-along, along, across, np.hypot(x, y)), strict=True):
        np.maximum.at(column, row, values)
    joined = [_joined(boxes, 1)]
    for level in range(1, math.ceil(math.log2(_BINS)) + 2):
        joined.append(_joined(joined[-1], 1 << (level - 1)))
    table = np.stack(joined, axis=1)
    table[0] *= -1
    width = np.where(np.isfinite(table[0]), table[1] - table[0], 0)
    table += _BEYOND * np.stack([-width, width, width, width])
    empty = ~np.isfinite(table).all(0)
    table[:, empty] = np.array([[1.0], [-1.0], [0.0], [0.0]])
    far = float(table[3].max())
    depth = (
        0.0 if shape is None else float(np.nan_to_num(sag_and_derivatives(shape, np.array([far]), np.zeros(1))[0])[0])
    )
    return FrontAim(shape, end, table, math.hypot(far, depth))


def _leaving(film: LensFilm, film_mm: tuple[float, float], wavelength_nm: tuple[float, float]) -> Array:
    """Scene rays [6, N] of a film, mm: half of those sent at the edges of pupils, some from those of the film."""
    rng = np.random.default_rng(0)
    half = np.array(film_mm)[:, None] / 2
    place, square = (2 * rng.random((2, _RAYS)) - 1) * half, rng.random((2, _RAYS), np.float32)
    edge = np.arange(0, _RAYS, 2)
    square[edge // 2 % 2, edge] = np.where(edge // 4 % 2, np.float32(1e-4), np.float32(1 - 1e-4))
    corner = edge[edge % 16 == 0]
    place[:, corner] /= np.abs(place[:, corner] / half).max(0)
    place *= np.minimum(0.9999 * film.outline.film_radius_mm / np.hypot(*place), 1)
    points, wavelength = place.astype(np.float32), rng.uniform(*wavelength_nm, _RAYS).astype(np.float32)
    rays = film.scene(points, film.outline.sample(points, square, wavelength)[0], wavelength)
    leaving: Array = rays.scene_ray[:, rays.status == st.PASSED].astype(np.float64)
    return leaving


def _joined(columns: Array, bins: int) -> Array:
    """The largest of each column [4, B] within so many bins on either side."""
    padded = np.pad(columns, ((0, 0), (bins, bins)), constant_values=-np.inf)
    return np.max(np.lib.stride_tricks.sliding_window_view(padded, 2 * bins + 1, axis=1), axis=2)
