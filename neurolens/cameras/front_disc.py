"""Where light from the scene is aimed at a lens: its front surface, within the radius that light of the film crosses.

What passes from a scene point crosses the front surface there, at any field angle, also beyond 90 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens import status as st
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.lens_film import LensFilm
from neurolens.cameras.sampling import concentric_disk
from neurolens.frontsurface import Shape, meet_front, sag_and_slope

Array = NDArray[np.float64]

_RAYS = 2**16  # that look for the radius
_BEYOND = 1.02  # of the radius found


class Aim(NamedTuple):
    """Points on the front surface [3, N] in mm, lens frame; unit directions [3, N] from them to the scene points; area
    [N] in mm^2 per unit area of the square, times the cosine to the surface's normal; status [N]."""

    position: Array
    direction: Array
    area: Array
    status: NDArray[np.int32]


@dataclass(frozen=True)
class FrontDisc:
    """The part of a front surface that light of a film crosses. `shape` None is the plane z = 0."""

    shape: Shape | None
    radius_mm: float

    def aim(self, point_mm: Array, square: FloatArray) -> Aim:
        """From scene points [3, N] (mm, lens frame) to points of the surface chosen by numbers [2, N] in [0, 1)."""
        x, y = concentric_disk(square).astype(np.float64) * self.radius_mm
        with np.errstate(all="ignore"):
            z, sx, sy = (np.zeros_like(x),) * 3 if self.shape is None else sag_and_slope(self.shape, x, y)
            position = np.stack([x, y, z])
            way = point_mm - position
            direction = way / np.sqrt(np.einsum("in,in->n", way, way))
            # dA cos = dx dy (d . n) / |n_z|, with the outward normal along (sx, sy, -1).
            facing = sx * direction[0] + sy * direction[1] - direction[2]
        lost = np.where(np.isnan(facing), st.OUTSIDE_DOMAIN, st.blocked(0, st.MISSED))
        status = np.where(facing > 0, st.PASSED, lost).astype(np.int32)
        return Aim(position, direction, math.pi * self.radius_mm**2 * facing, status)


def front_disc(
    film: LensFilm, film_mm: tuple[float, float], wavelength_nm: tuple[float, float], shape: Any
) -> FrontDisc:
    """The disc that the light of a film crosses, from camera rays, half of them at the edges of film and pupils."""
    rng = np.random.default_rng(0)
    half = np.array(film_mm)[:, None] / 2
    place, square = (2 * rng.random((2, _RAYS)) - 1) * half, rng.random((2, _RAYS), np.float32)
    edge = np.arange(0, _RAYS, 2)
    place[:, edge] /= np.abs(place[:, edge] / half).max(0)
    place *= np.minimum(0.9999 * film.outline.film_radius_mm / np.hypot(*place), 1)
    square[edge // 2 % 2, edge] = np.where(edge // 4 % 2, np.float32(1e-4), np.float32(1 - 1e-4))
    points, wavelength = place.astype(np.float32), rng.uniform(*wavelength_nm, _RAYS).astype(np.float32)
    rays = film.scene(points, film.outline.sample(points, square, wavelength)[0], wavelength)
    x, y = meet_front(shape, *rays.scene_ray[:, rays.status == st.PASSED].astype(np.float64))
    return FrontDisc(shape, _BEYOND * float(np.nanmax(np.hypot(x, y))))
