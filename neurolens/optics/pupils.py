"""From film points and pupil points to camera rays, and where on the pupil plane the passing rays lie."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from neurolens.errors import InputError
from neurolens.optics.clearance import end_mm, surface_sag_mm
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupil_rays import camera_rays, passes_at_any_azimuth, pupil_plane_z_mm, symmetric_about_axis
from neurolens.optics.trace import trace

__all__ = [
    "PupilBounds",
    "camera_rays",
    "image_radius_mm",
    "passes_at_any_azimuth",
    "pupil_bounds",
    "pupil_plane_z_mm",
    "symmetric_about_axis",
]

# Where rays are looked for again: within so many paraxial exit pupils of the axis, where the box of the rear rim is so
# many times wider than that.
_NEAR, _FAR = 3.0, 4.0

_FEW = 40  # points of a grid, of which so few pass that it may miss the edges of what passes, or the whole of it


@dataclass(frozen=True)
class PupilBounds:
    """Bounds of the passing rays on the pupil plane at equally spaced film radii (as pbrt: Pharr et al. 2016, 6.4.5).

    For a film point at radius r along +x, passing rays lie within `low` <= u <= `high` along +x and |v| <= `half`
    across.

    Attributes:
        pupil_z_mm: the plane.
        film_radius_mm: radius of the last row; the first row is the axis.
        low_mm, high_mm, half_mm: one value a film radius; an empty row (low > high) where no ray passes.
        disc_mm: radius of the axial disc that holds all passing rays.
    """

    pupil_z_mm: float
    film_radius_mm: float
    low_mm: tuple[float, ...]
    high_mm: tuple[float, ...]
    half_mm: tuple[float, ...]
    disc_mm: float


def pupil_bounds(
    lens: Lens,
    film_radius_mm: float,
    film_z_mm: tuple[float, float],
    wavelength_nm: tuple[float, float],
    *,
    rows: int = 33,
    points: int = 128,
) -> PupilBounds:
    """Search the pupil plane for passing rays, film radius by film radius: a coarse grid, then its bounding box.

    Each row is widened by the step of its grid and by its neighbours, so that bounds hold between rows too.

    Raises:
        InputError: when no ray passes from any film point.
    """
    plane = pupil_plane_z_mm(lens)
    film_planes = sorted(set(film_z_mm))
    wavelengths = sorted(set(wavelength_nm))
    data = first_order(lens)
    near = _NEAR * data.exit_pupil_diameter_mm / 2 if plane == data.exit_pupil_z_mm else math.inf
    boxes = [
        _row(lens, film_radius_mm * i / (rows - 1), film_planes, wavelengths, plane, points, near) for i in range(rows)
    ]
    if not any(boxes):
        raise InputError(
            lens.path, "surfaces", "(no ray passes the lens)", f"rays from a film of radius {film_radius_mm:.4g} mm"
        )
    merged = [_union([b for b in boxes[max(i - 1, 0) : i + 2] if b]) for i in range(rows)]
    return PupilBounds(
        plane,
        film_radius_mm,
        tuple(b.low for b in merged),
        tuple(b.high for b in merged),
        tuple(b.half for b in merged),
        max(b.radius for b in boxes if b),
    )


class _Box(NamedTuple):
    """Bounds of passing points for a film point on +x: along it, across it, from the axis, mm; how many were found."""

    low: float
    high: float
    half: float
    radius: float
    points: int = 0


def _union(boxes: list[_Box]) -> _Box:
    if not boxes:
        return _Box(1.0, -1.0, 0.0, 0.0)
    return _Box(
        min(b.low for b in boxes), max(b.high for b in boxes), max(b.half for b in boxes), max(b.radius for b in boxes)
    )


def _row(
    lens: Lens,
    radius: float,
    film_planes: list[float],
    wavelengths: list[float],
    plane: float,
    points: int,
    near: float,
) -> _Box | None:
    """Box of the passing rays from one film radius, over all film planes and wavelengths given.

    `near` is how far from the axis light is looked for again where the rear rim bounds it badly, mm.
    """
    rear = lens.surfaces[-1]
    rear_z = float(lens.vertices_mm[len(lens.surfaces) - 1])
    limit = min(rear.semi_diameter_mm, end_mm(rear))
    depths = [surface_sag_mm(rear, limit * t, 0.0) for t in (0.0, 0.5, 0.8, 1 - 1e-12)]
    found = []
    for film_z in film_planes:
        # Every ray that enters crosses the rear surface between the planes that hold it, within the rim's radius; seen
        # from the film point, that cylinder's two ends bound it on the pupil plane.
        ends = []
        for z in (rear_z + min(depths), rear_z + max(depths)):
            stretch = (film_z - plane) / (film_z - z)
            centre, reach = radius * (1 - stretch), 1.02 * rear.semi_diameter_mm * abs(stretch)
            ends.append(_Box(centre - reach, centre + reach, reach, 0.0))
        starts = [_union(ends)]
        if starts[0].high - starts[0].low > _FAR * near:
            # A cover glass a millimetre from the film: the pupil is a speck that falls between the points of a grid.
            starts.append(_Box(-near, near, near, 0.0))
        for start in starts:
            coarse = _search(lens, radius, film_z, wavelengths, plane, start, points)
            if coarse is None or coarse.points < _FEW:
                # A stop far down may hide between the points of the grid: look closer where light passes an open one.
                wide = _search(lens.with_stop_radius(math.inf), radius, film_z, wavelengths, plane, start, points)
                coarse = wide and _search(lens, radius, film_z, wavelengths, plane, wide, points)
            if coarse is not None:
                found.append(_search(lens, radius, film_z, wavelengths, plane, coarse, points) or coarse)
    return _union(found) if found else None


def _search(
    lens: Lens, radius: float, film_z: float, wavelengths: list[float], plane: float, box: _Box, points: int
) -> _Box | None:
    """Box of the passing points of a grid over `box` (upper half only: the lens is symmetric), a step wider."""
    u = torch.linspace(box.low, box.high, points, dtype=torch.float64)
    v = torch.linspace(0, box.half, points // 2, dtype=torch.float64)
    pu, pv = (t.reshape(-1) for t in torch.meshgrid(u, v, indexing="ij"))
    film = torch.full_like(pu, radius)
    passed = torch.stack([passes_at_any_azimuth(lens, film, film_z, pu, pv, plane, w) for w in wavelengths]).any(0)
    if not passed.any():
        return None
    du, dv = float(u[1] - u[0]), float(v[1] - v[0])
    pu, pv = pu[passed], pv[passed]
    return _Box(
        float(pu.min()) - du,
        float(pu.max()) + du,
        float(pv.max()) + dv,
        float(torch.hypot(pu, pv).max()) + math.hypot(du, dv) / 2,
        pu.numel(),
    )


def image_radius_mm(lens: Lens) -> tuple[float, str]:
    """Radius of the lit film, and where it comes from.

    The file's own; else f tan(half field) below 60 degrees; beyond, the film radius whose mean passing ray leaves at
    the half field; else where the relative illumination falls to 10%.
    """
    if lens.image_radius_mm is not None:
        return lens.image_radius_mm, "the lens file"
    f = first_order(lens).efl_mm
    if lens.half_field_deg is not None and lens.half_field_deg < 60:
        return f * math.tan(math.radians(lens.half_field_deg)), "f tan(half field)"
    radii = torch.linspace(0, 3 * abs(f), 481, dtype=torch.float64)
    share, angle = _illumination(lens, radii)
    if not share[0] > 0:  # a stop nearly shut lies between the points of the grid
        share, angle = _illumination(lens, radii[:: len(radii) // 60], 384)
        radii = radii[:: len(radii) // 60]
    if not share[0] > 0:
        raise InputError(lens.path, "surfaces", "(no ray passes on the axis)", "a lens that light can pass")
    lit = float(radii[share >= 0.1 * share[0]].max())
    if lens.half_field_deg is not None:
        reached = float(radii[(angle <= math.radians(lens.half_field_deg)) & (share > 0)].max())
        if reached <= lit:
            return reached, "traced to the half field"
    return lit, "relative illumination of 10%"


def _illumination(lens: Lens, radii: Tensor, points: int = 48) -> tuple[Tensor, Tensor]:
    """Relative film irradiance (any unit) and mean angle (rad) of the passing rays at each film radius."""
    film_z = lens.film_z_mm if lens.film_z_mm is not None else float(lens.vertices_mm[-1])
    rear, rear_z = lens.surfaces[-1].semi_diameter_mm, float(lens.vertices_mm[len(lens.surfaces) - 1])
    grid = torch.linspace(-rear, rear, points, dtype=torch.float64)
    film, px, py = (t.reshape(-1) for t in torch.meshgrid(radii, grid, grid, indexing="ij"))
    rays = camera_rays(film, torch.zeros_like(film), film_z, px, py, rear_z)
    traced = trace(lens, rays)
    passed = ((traced.status == 0) & (px * px + py * py <= rear * rear)).reshape(len(radii), -1)
    weight = passed * (rays.dz**4).reshape(passed.shape)
    theta = torch.atan2(torch.hypot(traced.rays.dx, traced.rays.dy), -traced.rays.dz).reshape(passed.shape)
    return weight.sum(1), (theta * weight).sum(1) / weight.sum(1).clamp_min(1e-30)
