"""Light on the film by an integral over the pupil's boundary: an oracle for cameras, pupils and flare.

A film point at distance Z from the pupil plane receives E = L integral of T cos^4(theta) / Z^2 over the area of that
plane through which rays pass (Kolb et al. 1995, eq. 3). No camera, outline or sample of the package is used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays, pupil_bounds, pupil_plane_z_mm
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays

Array = NDArray[np.float64]

# Steps outwards from a centre inside the pupil: the first, as a share of its half width, their growth, their number;
# halvings of the step that meets the boundary; nodes of the quadrature along a radius.
FIRST, GROWTH, STEPS, HALVINGS, NODES = 0.01, 1.15, 46, 30, 8
LATTICE = (48, 24)


@dataclass(frozen=True)
class FilmLight:
    """Light on the film at radii [F]; 0 where it is dark.

    Attributes:
        irradiance: over the radiance of uniform surroundings, in sr; with transmittance.
        area_mm2: effective aperture: area of the pupil plane through which rays pass.
        cos4, transmittance: means over that area.
        distance_mm: Z, of the pupil plane from the film.
    """

    irradiance: Array
    area_mm2: Array
    cos4: Array
    transmittance: Array
    distance_mm: float

    @property
    def natural(self) -> Array:
        """The mean of cos^4 over its value on the axis."""
        return self.cos4 / self.cos4[0]

    @property
    def relative(self) -> Array:
        """Relative illumination E(r) / E(0); the first film point must be on the axis."""
        return self.irradiance / self.irradiance[0]


def film_light(
    lens: Lens, radius_mm: Sequence[float] | Array, *, wavelength_nm: float | None = None, directions: int = 128
) -> FilmLight:
    """Light on the film of a focused lens that is round about its axis, at one wavelength (None: `Lens.reference_nm`).

    The first of the film radii must be 0; `directions` is the number of directions about the centre of the upper half
    of the pupil in which its boundary is searched.
    """
    search = _Search(lens, np.asarray(radius_mm, float), wavelength_nm or lens.reference_nm, directions)
    boundary = search.boundary()
    area = ((boundary * boundary).sum(1) * search.step).numpy()
    cos4, with_glass = search.means(boundary)
    lit = area > 0
    transmittance = np.where(lit, with_glass / np.where(lit, cos4, 1), 0)
    return FilmLight(area * with_glass / search.distance_mm**2, area, cos4, transmittance, search.distance_mm)


class _Search:
    """Rays from all film points to the pupil plane, in polar coordinates about a point inside each pupil."""

    def __init__(self, lens: Lens, radius: Array, wavelength_nm: float, directions: int) -> None:
        assert lens.film_z_mm is not None and not lens.anamorphic and lens.aperture is None and radius[0] == 0
        self.lens, self.film_z, self.wavelength = lens, float(lens.film_z_mm), wavelength_nm
        self.plane = pupil_plane_z_mm(lens)
        self.distance_mm = self.film_z - self.plane
        self.radius = torch.from_numpy(radius)
        angle = (torch.arange(directions, dtype=torch.float64) + 0.5) * (math.pi / directions)
        self.cos, self.sin, self.step = torch.cos(angle), torch.sin(angle), math.pi / directions
        end = max(float(radius.max()), 1e-3 * self.distance_mm)
        bounds = pupil_bounds(lens, end, (self.film_z,) * 2, (wavelength_nm,) * 2, rows=33, points=64)
        low, high, half = (np.array(v) for v in (bounds.low_mm, bounds.high_mm, bounds.half_mm))
        row = np.minimum(radius / end * 32, 32)
        a, b = np.floor(row).astype(int), np.ceil(row).astype(int)
        empty = low > high
        low, high = np.where(empty, np.inf, low), np.where(empty, -np.inf, high)
        self._centre(np.minimum(low[a], low[b]), np.maximum(high[a], high[b]), np.maximum(half[a], half[b]))

    def _centre(self, low: Array, high: Array, half: Array) -> None:
        """Centroid and half width of what passes, from a lattice on boxes [F]."""
        sound = low <= high
        low, high = np.where(sound, low, 0), np.where(sound, high, 1)
        u, v = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in LATTICE)
        low_, width, half_ = (torch.from_numpy(c)[:, None, None] for c in (low, high - low, half))
        x, y = torch.broadcast_tensors(low_ + width * u[:, None], half_ * v)
        passed = self._passes(x.reshape(len(low), -1), y.reshape(len(low), -1)).reshape(x.shape)
        count = passed.sum((1, 2))
        self.lit = count > 0
        self.centre = (x * passed).sum((1, 2)) / count.clamp_min(1)
        reach = torch.hypot(x - self.centre[:, None, None], y) * passed
        self.width = reach.amax((1, 2)).clamp_min(1e-9)

    def _rays(self, x: Tensor, y: Tensor) -> Rays:
        film = self.radius[:, None].expand_as(x).reshape(-1)
        return camera_rays(film, torch.zeros_like(film), self.film_z, x.reshape(-1), y.reshape(-1), self.plane)

    def _passes(self, x: Tensor, y: Tensor) -> Tensor:
        with torch.no_grad():
            return (trace(self.lens, self._rays(x, y), self.wavelength).status == 0).reshape(x.shape)

    def boundary(self) -> Tensor:
        """Distance [F, D] from the centre to the first point that does not pass."""
        low = torch.zeros(len(self.radius), len(self.cos), dtype=torch.float64)
        inside = torch.ones_like(low, dtype=torch.bool)
        t = FIRST * self.width[:, None].expand_as(low)
        for _ in range(STEPS):
            inside = inside & self._passes(self.centre[:, None] + t * self.cos, t * self.sin)
            low = torch.where(inside, t, low)
            t = t * GROWTH
        high = torch.where(low > 0, low * GROWTH, FIRST * self.width[:, None])
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            now = self._passes(self.centre[:, None] + middle * self.cos, middle * self.sin)
            low, high = torch.where(now, middle, low), torch.where(now, high, middle)
        return low * self.lit[:, None]

    def means(self, boundary: Tensor) -> tuple[Array, Array]:
        """Means [F] over the area inside of cos^4, and of transmittance times cos^4."""
        nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(NODES))
        share = (nodes + 1) / 2
        t = boundary[:, :, None] * share
        x = (self.centre[:, None, None] + t * self.cos[:, None]).reshape(len(boundary), -1)
        y = (t * self.sin[:, None]).reshape(len(boundary), -1)
        rays = self._rays(x, y)
        with torch.no_grad():
            through = trace(self.lens, rays, self.wavelength, transmittance=True).transmittance
        assert through is not None
        weight = (boundary[:, :, None] ** 2 * (share * weights)).reshape(x.shape)
        cos4 = (rays.dz**4).reshape(x.shape)
        total = weight.sum(1).clamp_min(1e-300)
        means = [(weight * v).sum(1) / total for v in (cos4, cos4 * through.reshape(x.shape))]
        return means[0].numpy(), means[1].numpy()
