"""Bundles of rays that reach a whole lens and somewhat beyond its edges; float64, lens frame, mm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.trace import Rays, trace


def from_film(lens: Lens, count: int, g: torch.Generator, *, share: float = 1.02, film: float = 1.0) -> Rays:
    """Camera rays from the film, half of them to the rear rim, half to the paraxial exit pupil, both `share` as wide.

    Film points lie within `film` times the image radius, where that is unknown the rear rim's.
    """
    rear, z = lens.surfaces[-1].semi_diameter_mm, _film_z_mm(lens)
    rear_z = float(lens.vertices_mm[len(lens.surfaces) - 1])
    data = first_order(lens)
    pupil_z, pupil = data.exit_pupil_z_mm, abs(data.exit_pupil_diameter_mm) / 2
    if not (math.isfinite(pupil_z) and math.isfinite(pupil) and pupil_z < z - 1):
        pupil_z, pupil = rear_z, rear
    fx, fy = disc(g, count, film * (lens.image_radius_mm or rear))
    px, py = disc(g, count, share)
    to_rear = torch.arange(count) % 2 == 0
    radius = torch.where(to_rear, rear, 1.2 * pupil).double()
    depth = torch.where(to_rear, rear_z, pupil_z).double() - z
    return Rays(fx, fy, torch.full_like(fx, z), *unit(px * radius - fx, py * radius - fy, depth))


def _film_z_mm(lens: Lens) -> float:
    return float(lens.film_z_mm if lens.film_z_mm is not None else lens.vertices_mm[-1])


def from_scene(lens: Lens, count: int, g: torch.Generator, *, slope: float, wide: float = 1.0) -> Rays:
    """Light from in front of the lens to `wide` times its front rim, at slopes up to `slope`."""
    x, y = disc(g, count, wide * lens.surfaces[0].semi_diameter_mm)
    sx, sy = disc(g, count, slope)
    d = unit(sx, sy, torch.ones_like(sx))
    front = torch.full_like(x, min(0.0, _rim_sag(lens.surfaces[0])) - 1.0)
    return Rays(x - sx, y - sy, front, *d)


def returning(lens: Lens, rays: Rays, count: int) -> Rays:
    """The passing of some camera rays turned round, every other one pushed aside by a hundredth of a radian."""
    out = trace(lens, rays)
    passed = torch.nonzero(out.status == st.PASSED)[:count, 0]
    r = Rays(*(c[passed] for c in out.rays))
    push = 0.01 * torch.randn((2, len(passed)), generator=generator(), dtype=torch.float64)
    push[:, ::2] = 0
    turned = Rays(*r[:3], *unit(push[0] - r.dx, push[1] - r.dy, -r.dz))
    return moved(turned, -0.5 * lens.surfaces[0].semi_diameter_mm)


def generator() -> torch.Generator:
    """Always the same one."""
    return torch.Generator().manual_seed(11)


def uniform(g: torch.Generator, count: int, half: float) -> Tensor:
    """[2, count] numbers within `half` of 0."""
    return (2 * torch.rand((2, count), generator=g, dtype=torch.float64) - 1) * half


def disc(g: torch.Generator, count: int, radius: float) -> tuple[Tensor, Tensor]:
    """Points uniform over a disc."""
    u = torch.rand((2, count), generator=g, dtype=torch.float64)
    r = radius * torch.sqrt(u[0])
    return r * torch.cos(2 * math.pi * u[1]), r * torch.sin(2 * math.pi * u[1])


def unit(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same directions with length 1."""
    length = torch.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def moved(r: Rays, travel: Tensor | float) -> Rays:
    """The rays started `travel` mm farther along."""
    return Rays(r.x + travel * r.dx, r.y + travel * r.dy, r.z + travel * r.dz, *r[3:])


def sag(radius: float, at: Sequence[Tensor] | Tensor) -> Tensor:
    """Depth of a sphere behind its vertex at points x, y."""
    ratio2 = (at[0] ** 2 + at[1] ** 2) / radius
    return ratio2 / (1 + torch.sqrt((1 - ratio2 / radius).clamp_min(0)))


def _rim_sag(s: Surface) -> float:
    height = torch.tensor([min(s.semi_diameter_mm, abs(float(s.radius_mm))), 0.0], dtype=torch.float64)
    return float(sag(float(s.radius_mm), height))
