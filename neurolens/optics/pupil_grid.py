"""Boxes about what passes of grids on the pupil plane: many film points at once, and few rays within what is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neurolens.optics.prescription import Lens
from neurolens.optics.pupil_rays import passes_at_any_azimuth

_STRIDE = 4  # of the points of a grid that are traced first; then only those that may widen what they found
FEW = 40  # points of a grid, of which so few pass that it may miss the edges of what passes, or the whole of it


class Box(NamedTuple):
    """Bounds of passing points for a film point on +x: along it, across it, from the axis, mm; how many were found."""

    low: float
    high: float
    half: float
    radius: float
    points: int = 0


class Place(NamedTuple):
    """A film point on +x: its distance from the axis and its plane, mm."""

    radius: float
    film_z: float


def union(boxes: Sequence[Box]) -> Box:
    """The box that holds all; an empty one (low > high) of none."""
    if not boxes:
        return Box(1.0, -1.0, 0.0, 0.0)
    return Box(
        min(b.low for b in boxes), max(b.high for b in boxes), max(b.half for b in boxes), max(b.radius for b in boxes)
    )


def search(
    lens: Lens,
    places: Sequence[Place],
    wavelengths: Sequence[float],
    pupil_z: float,
    boxes: Sequence[Box],
    points: int,
    film_mm: tuple[float, float] | None,
) -> list[Box | None]:
    """Boxes of the passing points of grids over `boxes` (upper halves: the lens is symmetric), a step wider; None for
    a film point whose grid no ray passes.

    A coarse grid inside each is traced first. Where enough of it passes, only the points that may lie beyond its
    extent by less than one of its steps follow; elsewhere all points near those found, or all.

    Args:
        places, boxes: film points and where to look from each.
        wavelengths: nm; rays of any of them count.
        points: of a grid along, and twice those across.
        film_mm: see `passes_at_any_azimuth`.
    """
    if not places:
        return []
    low, high, half = (
        torch.tensor([getattr(b, k) for b in boxes], dtype=torch.float64) for k in ("low", "high", "half")
    )
    u = low[:, None] + (high - low)[:, None] * torch.linspace(0, 1, points, dtype=torch.float64)
    v = half[:, None] * torch.linspace(0, 1, points // 2, dtype=torch.float64)
    radius, film_z = (torch.tensor(c, dtype=torch.float64) for c in zip(*places, strict=True))
    pu, pv = u[:, :, None].expand(-1, -1, v.shape[1]), v[:, None, :].expand(-1, u.shape[1], -1)
    passed = torch.zeros(pu.shape, dtype=torch.bool)

    def look(at: Tensor) -> None:
        for w in wavelengths:
            job, i, j = torch.nonzero(at & ~passed, as_tuple=True)
            x, y = u[job, i], v[job, j]
            passed[job, i, j] = passes_at_any_azimuth(lens, radius[job], film_z[job], x, y, pupil_z, w, film_mm)

    first = torch.zeros_like(passed)
    first[:, ::_STRIDE, ::_STRIDE] = True
    look(first)
    du, dv = u[:, 1] - u[:, 0], v[:, 1] - v[:, 0]
    look(~first & _may_widen(passed, pu, pv, _STRIDE * du, _STRIDE * dv))
    least, most, across, reach = (t.tolist() for t in _extent(passed, pu, pv))
    return [
        Box(least[k] - a, most[k] + a, across[k] + b, reach[k] + math.hypot(a, b) / 2, count) if count else None
        for k, (a, b, count) in enumerate(zip(du.tolist(), dv.tolist(), passed.sum((1, 2)).tolist(), strict=True))
    ]


def _extent(passed: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Least and largest u, largest v and largest distance from the axis of the passing points, each [M]."""
    nothing = torch.tensor(-math.inf, dtype=u.dtype)
    largest = [torch.where(passed, c, nothing).amax((1, 2)) for c in (-u, u, v, torch.hypot(u, v))]
    return -largest[0], largest[1], largest[2], largest[3]


def _may_widen(passed: Tensor, u: Tensor, v: Tensor, du: Tensor, dv: Tensor) -> Tensor:
    """Points that may lie beyond the extent found, by less than a step, along, across or from the axis; or more."""
    least, most, across, reach = (t[:, None, None] for t in _extent(passed, u, v))
    du, dv = du[:, None, None], dv[:, None, None]
    distance = torch.hypot(u, v)
    within = (u > least - du) & (u < most + du) & (v < across + dv) & (distance < reach + torch.hypot(du, dv))
    beyond = (u < least) | (u > most) | (v > across) | (distance > reach)
    count = passed.sum((1, 2))[:, None, None]
    # About few, all points are tried, two steps around; about none, the whole grid.
    near = (u > least - 2 * du) & (u < most + 2 * du) & (v < across + 2 * dv)
    return (within & beyond) | ((count < FEW) & near) | (count == 0)
