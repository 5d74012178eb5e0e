"""Finds the rays of a field angle that pass given points of the stop, from the stop outwards.

A search on the front surface for the ray that meets the stop's centre fails where the pupil moves (a fisheye's chief
ray enters centimetres beside the paraxial pupil). From the stop, every start is a ray that exists. Its angle in the
scene usually grows with its angle at the stop, so the wanted field is bracketed from the axis outwards. Where rays are
lost in between or turn back, the first ray of that field counts: the one on the branch that starts at the axis, where
that has one.
"""

import math
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.rays import plain_trace
from neurolens.optics.trace.shapes import followed_mm, sag_mm
from neurolens.optics.trace.surfaces import Rays

Axis = Literal["x", "y"]

_WIDEST_DEG = 89.9  # widest of the angles that are tried at the stop
_GRID = 721  # angles tried: an odd number includes the axis, and a step is a quarter of a degree
_ZOOM, _ROUNDS = 17, 4  # each round narrows the bracket 16 times, until a straight line is exact to the last digit
_JUMP = 1.0  # rad: fields of neighbours that differ by more belong to two branches, as on two sides of the axis
_MET = 1e-7  # rad from the wanted field that count as meeting it


class Bundle(NamedTuple):
    """Holds rays from infinity to points of the stop.

    Attributes:
        rays: [F * H], field by field, just before the front surface and travelling to the film.
        reached: [F, H] bool; where False, the field does not reach this point, and the ray is of the nearest field that
            does.
        field_rad: [F, H], angle between the ray and the axis in front of the lens.
    """

    rays: Rays
    reached: Tensor
    field_rad: Tensor


def without_rims(lens: Lens) -> Lens:
    """Return the lens with every surface and the stop as wide as they exist; aspheres continue beyond their rims."""
    ends = (followed_mm(s) if s.figure.powers else math.inf for s in lens.surfaces)
    rows = (replace(s, diameter_mm=math.inf, followed_mm=end) for s, end in zip(lens.surfaces, ends, strict=True))
    return replace(lens, aperture=None, surfaces=tuple(rows))


def aim_at_stop(
    lens: Lens, field_rad: Tensor, height_mm: Tensor, *, axis: Axis = "x", wavelength_nm: float | None = None
) -> Bundle:
    """Return the meridional rays of collimated light that cross the stop at given heights; rims are ignored.

    Args:
        field_rad: [F] angles to the axis, from 0 to below pi. The light comes from the positive side of `axis`, and its
            image lies on the negative side.
        height_mm: [F, H] heights in the stop, along `axis`.
        axis: the meridional plane, which matters for anamorphic lenses.
        wavelength_nm: None takes the lens's reference wavelength.
    """
    front = without_rims(replace(lens, surfaces=lens.surfaces[: lens.stop_index + 1]))
    nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    heights = height_mm.reshape(-1)
    target = field_rad[:, None].expand_as(height_mm).reshape(-1)

    def outwards(angle: Tensor) -> tuple[Rays, Tensor, Tensor]:
        return from_stop(front, heights[:, None].expand_as(angle), angle, axis, nm)

    widest = math.radians(_WIDEST_DEG)
    tried = torch.linspace(-widest, widest, _GRID, dtype=torch.float64)
    each, row = torch.unique(heights, return_inverse=True)
    _, field, exists = from_stop(front, each[:, None].expand(-1, _GRID), tried.expand(len(each), -1), axis, nm)
    exists = exists & (torch.arange(_GRID) >= _axial(tried, field, exists)[:, None])
    ends = bracket(tried.expand(len(heights), -1), field[row], exists[row], target)
    for _ in range(_ROUNDS):
        fine = between(ends)
        ends = bracket(fine, *outwards(fine)[1:], target)
    off = _off(*outwards(ends)[1:], target)
    rays, field, _ = outwards(ends.gather(1, off.argmin(1, keepdim=True)))
    return Bundle(rays, (off.amin(1) < _MET).reshape(height_mm.shape), field.reshape(height_mm.shape))


def _axial(angle: Tensor, field: Tensor, exists: Tensor) -> Tensor:
    """Return the index [n] of the last angle [G] before the ray that leaves the lens parallel to the axis.

    Of several such rays, the one least inclined at the stop is meant: the others graze the edges of the lens.
    """
    rises = _joined(field, exists) & (field[:, :-1] < 0) & (field[:, 1:] >= 0)
    inclined = torch.where(rises, (angle[:-1] + angle[1:]).abs(), math.inf)
    nearest = _off(field, exists, torch.zeros(len(field), dtype=torch.float64)).argmin(1)
    return torch.where(rises.any(1), inclined.argmin(1), nearest)


def _joined(value: Tensor, exists: Tensor, jump: float = _JUMP) -> Tensor:
    """Test whether neighbours [n, G - 1] both exist and belong to one branch."""
    return exists[:, 1:] & exists[:, :-1] & ((value[:, 1:] - value[:, :-1]).abs() < jump)


def _off(field: Tensor, exists: Tensor, target: Tensor) -> Tensor:
    """Return the distances of fields [n, G] from their targets [n]; inf where there is no ray."""
    return torch.where(exists, (field - target[:, None]).abs(), math.inf)


def bracket(angle: Tensor, value: Tensor, exists: Tensor, target: Tensor, jump: float = _JUMP) -> Tensor:
    """Find, among increasing angles [n, G], the first two neighbours whose values lie on both sides of a target [n].

    Where there are none, they are the neighbours of the ray whose value is nearest, since rays between them may come
    nearer still.

    Args:
        angle: [n, G], increasing.
        value: [n, G], of the ray of each angle.
        exists: [n, G], whether there is such a ray.
        target: [n].
        jump: values of neighbours that differ by more belong to two branches, with nothing in between.

    Returns:
        [n, 3]: the two angles, and between them the one at which the straight line through their values meets the
        target.
    """
    above = value >= target[:, None]
    crosses = _joined(value, exists, jump) & (above[:, 1:] != above[:, :-1])
    found = crosses.any(1)
    first, nearest = crosses.to(torch.int8).argmax(1), _off(value, exists, target).argmin(1)
    low = torch.where(found, first, (nearest - 1).clamp_min(0))
    high = torch.where(found, first + 1, (nearest + 1).clamp_max(angle.shape[1] - 1))
    (a, b), (va, vb) = ([v.gather(1, k[:, None])[:, 0] for k in (low, high)] for v in (angle, value))
    share = torch.nan_to_num((target - va) / (vb - va), 0.5).clamp(0, 1)
    return torch.stack([a, a + (b - a) * share, b], 1)


def between(ends: Tensor) -> Tensor:
    """Return the 17 angles [n, 17] of the next closer look, from the first to the last of those of `bracket`."""
    return ends[:, :1] + (ends[:, 2:] - ends[:, :1]) * torch.linspace(0, 1, _ZOOM, dtype=torch.float64)


def from_stop(
    front: Lens, height: Tensor, angle: Tensor, axis: Axis, wavelength_nm: float
) -> tuple[Rays, Tensor, Tensor]:
    """Trace from the stop to the scene; return the reversed rays [n * G], their field angles and existence [n, G].

    Args:
        front: the lens up to its stop, without rims.
        height, angle: where the rays start in the stop, and at what angle, [n, G].
    """
    stop, z = front.surfaces[-1], float(front.vertices_mm[-2])
    h, a = height.reshape(-1), angle.reshape(-1)
    known = {float(v): sag_mm(stop, float(v), 0.0) if axis == "x" else sag_mm(stop, 0.0, float(v))
             for v in torch.unique(h)}  # fmt: skip
    # A height that is no number, where a search has failed, is not equal to itself, and so not known.
    sag = torch.tensor([known.get(float(v), math.nan) for v in h[:: angle.shape[1]]], dtype=torch.float64)
    # The ray starts a millimetre before the stop's surface, so that it meets this too, and is refracted where it is
    # glass.
    across, along = torch.sin(a), -torch.cos(a)
    x, zero = h - across, torch.zeros_like(h)
    start_z = z + sag.repeat_interleave(angle.shape[1]) - along
    start = Rays(x, zero, start_z, across, zero, along) if axis == "x" else Rays(zero, x, start_z, zero, across, along)
    out = plain_trace(front, start, wavelength_nm)
    r = out.rays
    field = torch.atan2(r.dx if axis == "x" else r.dy, -r.dz)
    # The rays are reversed and moved back, so that the front surface is still ahead of them.
    back = Rays(r.x + r.dx, r.y + r.dy, r.z + r.dz, -r.dx, -r.dy, -r.dz)
    return back, field.reshape(angle.shape), (out.status == 0).reshape(angle.shape)
