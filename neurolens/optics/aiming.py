"""Rays from a field angle through given points of the stop, found from the stop outwards.

Searching the front surface for the ray that meets the stop's centre fails where the pupil moves (a fisheye's chief
ray enters centimetres beside the paraxial pupil). From the stop every start is a ray that exists: its angle in the
scene grows steadily with its angle at the stop, and the wanted field is bracketed from the axis outwards.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens
from neurolens.optics.sag import sag_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

Axis = Literal["x", "y"]

_WIDEST_DEG = 89.0  # of the angles tried at the stop
_GRID = 713  # odd, so that the axis is included; a step of a quarter of a degree
_STRETCH = 1.5  # of an asphere's rim: farther out the polynomial is meaningless
_ZOOM, _ROUNDS = 17, 9  # each round narrows the bracket 16 times: to the last digit of a double


class Bundle(NamedTuple):
    """Rays from infinity to points of the stop.

    Attributes:
        rays: [F * H], just before the front surface, travelling to the film; field by field.
        reached: [F, H] bool; where False the ray is that of the widest field from which this point is reached.
        field_rad: [F, H], angle of the ray to the axis in front of the lens.
    """

    rays: Rays
    reached: Tensor
    field_rad: Tensor


def without_rims(lens: Lens) -> Lens:
    """The lens with every surface, the stop too, open as far as it goes: an asphere a little beyond its tabled rim."""
    rows = (replace(s, diameter_mm=_STRETCH * s.diameter_mm if s.asphere else math.inf) for s in lens.surfaces)
    return replace(lens, aperture=None, surfaces=tuple(rows))


def aim_at_stop(
    lens: Lens, field_rad: Tensor, height_mm: Tensor, *, axis: Axis = "x", wavelength_nm: float = LINE_D_NM
) -> Bundle:
    """Meridional rays of collimated light that cross the stop at given heights, rims ignored.

    Args:
        field_rad: [F] angles to the axis, from 0 to below pi. The light comes from the positive side of `axis`, and
            its image lies on the negative side.
        height_mm: [F, H] heights in the stop, along `axis`.
        axis: the meridional plane, for anamorphic lenses.
    """
    front = without_rims(replace(lens, surfaces=lens.surfaces[: lens.stop_index + 1]))
    heights = height_mm.reshape(-1)
    target = field_rad[:, None].expand_as(height_mm).reshape(-1)

    def outwards(angle: Tensor) -> tuple[Rays, Tensor, Tensor]:
        return _follow(front, heights[:, None].expand_as(angle), angle, axis, wavelength_nm)

    widest = math.radians(_WIDEST_DEG)
    grid = torch.linspace(-widest, widest, _GRID, dtype=torch.float64).expand(len(heights), _GRID)
    low, high, reached = _bracket(grid, *outwards(grid)[1:], target)
    share = torch.linspace(0, 1, _ZOOM, dtype=torch.float64)
    for _ in range(_ROUNDS):
        fine = low[:, None] + (high - low)[:, None] * share
        _, field, exists = outwards(fine)
        above = (field >= target[:, None]) | ~exists
        above[:, -1] = True
        first = above.to(torch.int8).argmax(1).clamp_min(1)[:, None]
        low, high = fine.gather(1, first - 1)[:, 0], fine.gather(1, first)[:, 0]
    rays, field, _ = outwards(torch.where(reached, high, low)[:, None])
    return Bundle(rays, reached.reshape(height_mm.shape), field.reshape(height_mm.shape))


def _bracket(grid: Tensor, field: Tensor, exists: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angles at the stop [n] below and above the one that gives the target field, and whether there is one.

    The search starts at the ray along the axis and ends where rays stop existing or turn back: there, the last two.
    """
    count = grid.shape[1]
    places = torch.arange(count)
    start = torch.where(exists, field.abs(), math.inf).argmin(1)[:, None]
    rising = torch.ones_like(exists)
    rising[:, 1:] = field[:, 1:] > field[:, :-1]
    sound = (exists & rising) | (places <= start)
    onwards = sound.to(torch.int8).cumprod(1).bool() & exists & (places >= start)
    there = onwards & (field >= target[:, None])
    reached = there.any(1)
    first = there.to(torch.int8).argmax(1)
    last = (onwards * places).amax(1)
    upper = torch.where(reached, first, (last + 1).clamp_max(count - 1)).clamp_min(1)[:, None]
    return grid.gather(1, upper - 1)[:, 0], grid.gather(1, upper)[:, 0], reached


def _follow(
    front: Lens, height: Tensor, angle: Tensor, axis: Axis, wavelength_nm: float
) -> tuple[Rays, Tensor, Tensor]:
    """From the stop to the scene: the reversed rays, [n * G], their field angle and existence [n, G]."""
    stop, z = front.surfaces[-1], float(front.vertices_mm[-2])
    h, a = height.reshape(-1), angle.reshape(-1)
    known = {float(v): sag_mm(stop, float(v), 0.0) if axis == "x" else sag_mm(stop, 0.0, float(v))
             for v in torch.unique(h)}  # fmt: skip
    sag = torch.tensor([known[float(v)] for v in h[:: angle.shape[1]]], dtype=torch.float64)
    # The ray starts a millimetre before the stop's surface, so that this too is met and refracts where it is glass.
    across, along = torch.sin(a), -torch.cos(a)
    x, zero = h - across, torch.zeros_like(h)
    start_z = z + sag.repeat_interleave(angle.shape[1]) - along
    start = Rays(x, zero, start_z, across, zero, along) if axis == "x" else Rays(zero, x, start_z, zero, across, along)
    with torch.no_grad():
        out = trace(front, start, wavelength_nm)
    r = out.rays
    field = torch.atan2(r.dx if axis == "x" else r.dy, -r.dz)
    # Reversed and moved back, so that the front surface is still ahead.
    back = Rays(r.x + r.dx, r.y + r.dy, r.z + r.dz, -r.dx, -r.dy, -r.dz)
    return back, field.reshape(angle.shape), (out.status == 0).reshape(angle.shape)
