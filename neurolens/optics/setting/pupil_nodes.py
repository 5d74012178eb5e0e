"""Quadrature over what stop and rims leave open of a plane, whatever its outline, refined until two levels agree.

The light of an opening, counted by rays on a grid, has an error that falls only as n^-1.5, and rings of the stop lose
what a rim cuts between two of them. Here the outline itself is searched, along spokes from the middle of what is lit,
and Gauss's nodes lie along the spokes: figures that are smooth over the pupil converge exponentially. What is dark
inside the outline is left out ray by ray.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.arrays import passing
from neurolens.optics.trace.surfaces import Rays

Array = NDArray[np.float64]
Passes = Callable[[Tensor, Tensor], Tensor]

_LATTICE, _LOOKS = 32, 6  # points a side of a grid that finds what is lit, first in the box given; how often at most
_CLOSER = 4  # how many times smaller the box becomes where nothing is found
_SCAN, _ROUNDS = 13, 5  # points along a spoke that find the outline, and how often they are drawn closer
_SPOKES, _RINGS = 32, 6  # of the coarsest level; every further level has twice as many of both
LEVELS = 4
AGREE = 5e-4  # share of a figure's scale by which two levels may differ: half of a third digit


class Nodes(NamedTuple):
    """Points of a plane, each [B, N], with the areas they stand for; points on the outline itself have the area 0."""

    u: Tensor
    v: Tensor
    area: Tensor


class LitPart(NamedTuple):
    """The middle of what is lit in each of B planes, [B], and how far it reaches from there; 0 where nothing is lit."""

    u: Tensor
    v: Tensor
    reach: Tensor


def lit_part(passes: Passes, low: Tensor, high: Tensor, near: Tensor) -> LitPart:
    """Find what is lit inside boxes, one for each of B planes.

    Args:
        passes: tells of points u, v, [B, N], whether they are lit.
        low, high: [B, 2], corners of the boxes.
        near: [B, 2], a point about which smaller boxes are searched where nothing is found.
    """
    step = (torch.arange(_LATTICE, dtype=torch.float64) + 0.5) / _LATTICE
    a, b = (s.reshape(-1) for s in torch.meshgrid(step, step, indexing="ij"))
    known = torch.zeros(len(low), dtype=torch.bool)
    for _ in range(_LOOKS):
        u, v = (low[:, k, None] + (high - low)[:, k, None] * s for k, s in enumerate((a, b)))
        lit, cell = passes(u, v), (high - low) / _LATTICE
        any_lit = lit.any(1)
        places = torch.stack([u, v], 2)
        low_lit = torch.where(lit[..., None], places, math.inf).amin(1) - cell
        high_lit = torch.where(lit[..., None], places, -math.inf).amax(1) + cell
        low, high = (
            torch.where(any_lit[:, None], lit_end, near + (end - near) / _CLOSER)
            for lit_end, end in ((low_lit, low), (high_lit, high))
        )
        if (known & any_lit).all():
            break
        known = any_lit
    count = lit.sum(1).clamp_min(1)
    middle_u, middle_v = ((lit * p).sum(1) / count for p in (u, v))
    away = torch.hypot(u - middle_u[:, None], v - middle_v[:, None])
    reach = torch.where(lit, away, 0.0).amax(1) + torch.hypot(cell[:, 0], cell[:, 1])
    return LitPart(middle_u, middle_v, torch.where(any_lit, reach, 0.0))


def lit_nodes(passes: Passes, part: LitPart, level: int) -> Nodes:
    """Return nodes over what is lit; `passes` is as for `lit_part`, and `level` counts from 0."""
    spokes, rings = _SPOKES << level, _RINGS << level
    angle = torch.arange(spokes, dtype=torch.float64) * (2 * math.pi / spokes)
    cos, sin = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
    share = torch.linspace(0, 1, _SCAN, dtype=torch.float64)

    def places(radius: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points [B, S * K] at radii [B, S, K]."""
        u, v = part.u[:, None, None] + radius * cos, part.v[:, None, None] + radius * sin
        return u.flatten(1), v.flatten(1)

    high = part.reach[:, None].expand(-1, spokes)
    low = torch.zeros_like(high)
    for _ in range(_ROUNDS):
        radius = low[..., None] + (high - low)[..., None] * share
        lit = passes(*places(radius)).reshape(radius.shape)
        last = (lit * torch.arange(_SCAN)).amax(2, keepdim=True)
        low, high = (radius.gather(2, k)[..., 0] for k in (last, (last + 1).clamp_max(_SCAN - 1)))
    # Gauss's nodes lie in the square of the radius, of which the area is a linear function.
    nodes, weights = (torch.from_numpy(c) for c in np.polynomial.legendre.leggauss(rings))
    end = (low + high) / 2
    radius = torch.cat([end[..., None] * torch.sqrt((nodes + 1) / 2), low[..., None]], 2)
    area = (end**2)[..., None] * torch.cat([weights / 2, torch.zeros(1, dtype=torch.float64)]) * (math.pi / spokes)
    return Nodes(*places(radius), area.flatten(1))


class FilmLight:
    """The light that F film points see through a lens, on a plane; losses in glass are left out.

    Args:
        film_mm: x and y of the film points, [F] each.
        film_z_mm, plane_z_mm: where film and plane are.
        low, high, near: as for `lit_part`.
    """

    def __init__(
        self, lens: Lens, film_mm: tuple[Tensor, Tensor], film_z_mm: float, plane_z_mm: float, low: Tensor,
        high: Tensor, near: Tensor,
    ) -> None:  # fmt: skip
        self.lens, self.film_mm, self.film_z_mm, self.plane_z_mm = lens, film_mm, film_z_mm, plane_z_mm
        self.part = lit_part(self._passes, low, high, near)

    def only(self, fields: list[int]) -> FilmLight:
        """Return the light of some of the film points, by their numbers."""
        found = copy(self)
        found.film_mm = self.film_mm[0][fields], self.film_mm[1][fields]
        found.part = LitPart(*(c[fields] for c in self.part))
        return found

    def _rays(self, u: Tensor, v: Tensor) -> Rays:
        x, y = (c[:, None].expand(u.shape).reshape(-1) for c in self.film_mm)
        return camera_rays(x, y, self.film_z_mm, u.reshape(-1), v.reshape(-1), self.plane_z_mm)

    def _passes(self, u: Tensor, v: Tensor) -> Tensor:
        rays = Rays(*(c.numpy() for c in self._rays(u, v)))
        return torch.from_numpy(passing(self.lens, rays, self.lens.reference_nm)).reshape(u.shape)

    def sums(self, level: int) -> Array:
        """Return the integrals [F] of cos^4 over what is lit."""
        nodes = lit_nodes(self._passes, self.part, level)
        cos4 = self._rays(*nodes[:2]).dz.reshape(nodes.u.shape) ** 4
        return np.asarray((nodes.area * cos4 * self._passes(*nodes[:2])).sum(1).numpy())


def converged(
    compute: Callable[[int, list[int]], Sequence[Array]],
    figures: Callable[[list[Array]], Mapping[str, tuple[Array, Array | float]]],
    fields: int,
    first: int = 0,
) -> tuple[list[Array], dict[str, Array]]:
    """Compute arrays [F, ...] at finer and finer levels until two agree, field by field, or levels end.

    Args:
        compute: gives the arrays of a level, from 0, for some of the fields.
        figures: takes all arrays and gives, by name, the figures that are shown, [F, ...], and the scale on which their
            errors count: the figures themselves, or 1 for shares of 1.
        fields: the number of fields, F.
        first: the level to begin with.

    Returns:
        The arrays, and by name how far the last two levels differ [F, ...], over the scale and at most 1.
    """
    rows = list(range(fields))
    result = [np.array(a) for a in compute(first, rows)]
    spread = {name: np.zeros(values.shape) for name, (values, _) in figures(result).items()}
    for level in range(first + 1, LEVELS):
        before = figures([a.copy() for a in result])
        for whole, part in zip(result, compute(level, rows), strict=True):
            whole[rows] = part
        for name, (values, scale) in figures(result).items():
            off = np.nan_to_num(np.abs(values - before[name][0]) / np.maximum(scale, 1e-300))
            spread[name][rows] = off[rows].clip(max=1.0)
        rows = [k for k in rows if any((s[k] > AGREE).any() for s in spread.values())]
        if not rows:
            break
    return result, spread
