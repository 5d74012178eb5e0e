"""Light on the film: irradiance from uniform surroundings, and the factors that make it fall towards the edge.

A film point at distance Z from the pupil plane receives E = L integral of T cos^4(theta) / Z^2 over the area of that
plane through which rays pass (Kolb et al. 1995, eq. 3). The area varies, too, so that

    E(r) / E(0) = natural x aperture x optical x mechanical x transmittance

each relative to the axis: the mean of cos^4; the area left open by the stop alone; the share of it that the rims of
glass leave; the share of that which hoods and other rings leave; and the mean transmittance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays, pupil_bounds, pupil_plane_z_mm
from neurolens.trace.aiming import without_rims
from neurolens.trace.rays import trace
from neurolens.trace.sag import same_medium
from neurolens.trace.surfaces import Rays

Array = NDArray[np.float64]

# Steps outwards from a centre inside the pupil: the first, as a share of its half width, their growth, their number;
# halvings of the step that meets the boundary; nodes of the quadrature along a radius.
_FIRST, _GROWTH, _STEPS, _HALVINGS, _NODES = 0.01, 1.15, 46, 30, 8
_LATTICE = (48, 24)


@dataclass(frozen=True)
class FilmLight:
    """Light on the film at radii [F]; 0 where it is dark, and all factors too.

    Attributes:
        radius_mm: of the film points.
        irradiance: over the radiance of uniform surroundings, in sr; with transmittance.
        area_mm2: effective aperture: area of the pupil plane through which rays pass.
        natural, aperture, optical, mechanical, transmittance: see the module; natural and aperture over their values on
            the axis, the others as shares there too.
        cos4: mean of cos^4 of the angle on the film's side. distance_mm: Z, of the pupil plane from the film.
    """

    radius_mm: Array
    irradiance: Array
    area_mm2: Array
    natural: Array
    aperture: Array
    optical: Array
    mechanical: Array
    transmittance: Array
    cos4: Array
    distance_mm: float

    @property
    def relative(self) -> Array:
        """Relative illumination E(r) / E(0); the first film point must be on the axis."""
        return self.irradiance / self.irradiance[0]


def film_light(
    lens: Lens, film_radius_mm: Sequence[float] | Array, *, wavelength_nm: float | None = None, directions: int = 128
) -> FilmLight:
    """Light on the film of a focused lens at one wavelength, for a round stop.

    Args:
        film_radius_mm: [F], the first 0 (the axis), the others in any order.
        wavelength_nm: None takes `Lens.reference_nm`.
        directions: about the centre of the upper half of the pupil, in which its boundary is searched.

    Raises:
        InputError: a lens without a film, or with cylinders or blades; a first radius other than 0; no light there.
    """
    radius = np.asarray(film_radius_mm, np.float64)
    _check(lens, radius)
    bare = without_rims(lens).with_stop_radius(lens.stop_radius_mm)
    rims = tuple(replace(b, diameter_mm=s.diameter_mm) for b, s in zip(bare.surfaces, lens.surfaces, strict=True))
    rings = _rings(lens)
    glass = tuple(bare.surfaces[k] if k in rings else s for k, s in enumerate(rims))
    search = _Search(lens, radius, lens.reference_nm if wavelength_nm is None else wavelength_nm, directions)
    alone, behind_glass, all_rims = (search.boundary(replace(bare, surfaces=s)) for s in (bare.surfaces, glass, rims))
    area = [search.area(b) for b in (alone, behind_glass, all_rims)]
    if not area[2][0] > 0:
        raise InputError(lens.path, "surfaces", "(no ray passes on the axis)", "a lens that light can pass")
    cos4, with_glass = search.means(lens, all_rims)
    lit = search.lit
    optical, mechanical, through = (
        np.where(lit, a / np.where(lit, b, 1), 0)
        for a, b in ((area[1], area[0]), (area[2], area[1]), (with_glass, cos4))
    )
    return FilmLight(
        radius,
        area[2] * with_glass / search.distance_mm**2,
        area[2],
        cos4 / cos4[0],
        area[0] / area[0][0] * lit,
        optical,
        mechanical,
        through,
        cos4,
        search.distance_mm,
    )


def white_card(light: FilmLight) -> dict[str, Array]:
    """A uniformly lit white card by four weights of rays, each relative to the axis.

    "flat": every passing ray counts the same; "cos4": each counts cos^4; "aperture": the area of the effective aperture
    alone; "both": as film sees it (glass without losses). Source: Steinert 2009, 5.2.
    """
    cos4, area = light.natural, light.area_mm2 / light.area_mm2[0]
    return {"flat": (area > 0).astype(float), "cos4": cos4, "aperture": area, "both": cos4 * area}


def _check(lens: Lens, radius: Array) -> None:
    if lens.film_z_mm is None:
        raise InputError(lens.path, "film_z_mm", None, "a focused lens: set_lens(lens, focus_m=...)")
    if lens.anamorphic or lens.aperture is not None:
        raise InputError(lens.path, "surfaces", "(cylinders or blades)", "a lens that is round about its axis")
    if radius.ndim != 1 or not radius.size or radius[0] != 0 or not ((radius >= 0) & np.isfinite(radius)).all():
        raise InputError("film_light", "film_radius_mm", radius.tolist()[:4], "radii in mm of at least 0, the first 0")


def _rings(lens: Lens) -> set[int]:
    """Rows that bend nothing and are not the stop: hoods and other rings."""
    return {k for k, s in enumerate(lens.surfaces) if not s.stop and same_medium(lens.surfaces, k, lens.object_medium)}


class _Search:
    """Rays from all film points to the pupil plane in polar coordinates about a point inside each pupil."""

    def __init__(self, lens: Lens, radius: Array, wavelength_nm: float, directions: int) -> None:
        assert lens.film_z_mm is not None
        self.film_z, self.wavelength = float(lens.film_z_mm), wavelength_nm
        self.plane = pupil_plane_z_mm(lens)
        self.distance_mm = self.film_z - self.plane
        self.radius = torch.from_numpy(radius)
        angle = (torch.arange(directions, dtype=torch.float64) + 0.5) * (math.pi / directions)
        self.cos, self.sin, self.step = torch.cos(angle), torch.sin(angle), math.pi / directions
        end = max(float(radius.max()), 1e-3 * self.distance_mm)
        bounds = pupil_bounds(lens, end, (self.film_z,) * 2, (wavelength_nm,) * 2, rows=33, points=64)
        low, high, half = (np.array(v) for v in (bounds.low_mm, bounds.high_mm, bounds.half_mm))
        place = np.minimum(radius / end * 32, 32)
        a, b = np.floor(place).astype(int), np.ceil(place).astype(int)
        empty = low > high
        low, high = np.where(empty, np.inf, low), np.where(empty, -np.inf, high)
        self._centre(lens, np.minimum(low[a], low[b]), np.maximum(high[a], high[b]), np.maximum(half[a], half[b]))

    def _centre(self, lens: Lens, low: Array, high: Array, half: Array) -> None:
        """Centroid and half width of what passes, from a lattice on boxes [F]."""
        sound = low <= high
        low, high = np.where(sound, low, 0), np.where(sound, high, 1)
        u, v = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in _LATTICE)
        low_, width, half_ = (torch.from_numpy(c)[:, None, None] for c in (low, high - low, half))
        x, y = torch.broadcast_tensors(low_ + width * u[:, None], half_ * v)
        passed = self._passes(lens, x.reshape(len(low), -1), y.reshape(len(low), -1)).reshape(x.shape)
        count = passed.sum((1, 2))
        self.lit = count.numpy() > 0
        self.centre = (x * passed).sum((1, 2)) / count.clamp_min(1)
        reach = torch.hypot(x - self.centre[:, None, None], y) * passed
        self.width = reach.amax((1, 2)).clamp_min(1e-9)

    def _rays(self, x: Tensor, y: Tensor) -> Rays:
        film = self.radius[:, None].expand_as(x).reshape(-1)
        return camera_rays(film, torch.zeros_like(film), self.film_z, x.reshape(-1), y.reshape(-1), self.plane)

    def _passes(self, lens: Lens, x: Tensor, y: Tensor) -> Tensor:
        with torch.no_grad():
            return (trace(lens, self._rays(x, y), self.wavelength).status == 0).reshape(x.shape)

    def boundary(self, lens: Lens) -> Tensor:
        """Distance [F, D] from the centre to the first point that does not pass."""
        low, high = (torch.zeros(len(self.radius), len(self.cos), dtype=torch.float64) for _ in range(2))
        inside = torch.ones_like(low, dtype=torch.bool)
        t = _FIRST * self.width[:, None].expand_as(low)
        for _ in range(_STEPS):
            inside = inside & self._passes(lens, self.centre[:, None] + t * self.cos, t * self.sin)
            low = torch.where(inside, t, low)
            t = t * _GROWTH
        high = torch.where(low > 0, low * _GROWTH, _FIRST * self.width[:, None])
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            now = self._passes(lens, self.centre[:, None] + middle * self.cos, middle * self.sin)
            low, high = torch.where(now, middle, low), torch.where(now, high, middle)
        return low * torch.from_numpy(self.lit)[:, None]

    def area(self, boundary: Tensor) -> Array:
        """Area [F] inside a boundary, both halves."""
        found: Array = ((boundary * boundary).sum(1) * self.step).numpy()
        return found

    def means(self, lens: Lens, boundary: Tensor) -> tuple[Array, Array]:
        """Means [F] over the area inside of cos^4, and of transmittance times cos^4."""
        nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(_NODES))
        share = (nodes + 1) / 2
        t = boundary[:, :, None] * share
        x = (self.centre[:, None, None] + t * self.cos[:, None]).reshape(len(boundary), -1)
        y = (t * self.sin[:, None]).reshape(len(boundary), -1)
        rays = self._rays(x, y)
        with torch.no_grad():
            through = trace(lens, rays, self.wavelength, transmittance=True).transmittance
        assert through is not None
        weight = (boundary[:, :, None] ** 2 * (share * weights)).reshape(x.shape)
        cos4 = (rays.dz**4).reshape(x.shape)
        total = weight.sum(1).clamp_min(1e-300)
        means = [(weight * v).sum(1) / total for v in (cos4, cos4 * through.reshape(x.shape))]
        return means[0].numpy(), means[1].numpy()
