"""Rays through the section of a lens, as the plain data that `plots.lens_layout` draws."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neurolens import status as st
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays
from neurolens.optics.trace import trace
from neurolens.surrogates.domain import Domain

FIELDS = (0.0, 0.7, 1.0)  # shares of the film radius: axis, the zone of equal areas inside and outside, edge
RAYS_A_FIELD = 7
_FAN = 2001


def layout_profile(lens: Lens, domain: Domain) -> dict[str, Any]:
    """Section of a lens with meridional fans of rays from the axis, 70% and the edge of the film, d line.

    Args:
        lens: placed by `Lens.at`; where it is not, the film is that of the domain's farthest focus.
        domain: gives film radius and where the passing rays lie.

    Returns: plain data for `plots.lens_layout`: surfaces, rays, film_z_mm, film_half_height_mm, title, subtitle. A
        field from which no ray of the section passes has no rays.
    """
    film_z = lens.film_z_mm if lens.film_z_mm is not None else domain.film_z_mm[0]
    rays: list[dict[str, Any]] = []
    for number, share in enumerate(FIELDS):
        fan = _fan(lens, domain, share * domain.film_radius_mm, float(film_z))
        if fan is None:
            continue
        lines, angle_deg = fan
        where = "axis" if share == 0 else "edge" if share == 1 else f"{100 * share:.0f}% of the film radius"
        label = where if share == 0 else f"{where}, {angle_deg:.1f}°"
        rays += [{"points": line, "label": label, "field": number} for line in lines]
    return {
        "surfaces": [
            {
                "z_mm": float(z),
                "radius_mm": float(s.radius_mm),
                "semi_diameter_mm": s.semi_diameter_mm,
                "n_after": float(s.n_d),
                "stop": s.stop,
            }
            for s, z in zip(lens.surfaces, lens.vertices_mm[:-1], strict=True)
        ],
        "rays": rays,
        "film_z_mm": float(film_z),
        "film_half_height_mm": domain.film_radius_mm,
        "title": lens.name,
        "subtitle": _subtitle(lens, domain),
    }


def refractions(lens: Lens) -> int:
    """Surfaces at which the medium changes: the stop and other surfaces in air do not count."""
    before = [1.0, *(float(s.n_d) for s in lens.surfaces)]
    return sum(a != b for a, b in zip(before, before[1:], strict=False))


def _subtitle(lens: Lens, domain: Domain) -> str:
    data = first_order(lens)
    focus = "infinity" if math.isinf(domain.focus_m[0]) else f"{domain.focus_m[0]:g} m"
    return (
        f"f = {data.efl_mm:.1f} mm, f/{data.f_number:.2g}, {refractions(lens)} refractions, focus {focus}, "
        f"film radius {domain.film_radius_mm:.1f} mm"
    )


def _fan(lens: Lens, domain: Domain, height: float, film_z: float) -> tuple[list[list[list[float]]], float] | None:
    """Polylines (z, y) of the rays from film height `height` that pass, and their mean angle to the axis in degrees."""
    radius = domain.pupil_radius_mm
    u = torch.linspace(-radius, radius, _FAN, dtype=torch.float64)
    zero = torch.zeros_like(u)
    start = camera_rays(torch.full_like(u, height), zero, film_z, u, zero, domain.pupil_z_mm)
    every = range(len(lens.surfaces) - 1, -1, -1)
    with torch.no_grad():
        out = trace(lens, start, record=list(every))
    passing = torch.nonzero(out.status == st.PASSED)[:, 0]
    if len(passing) == 0:
        return None
    # A hair inside the ends: the outermost rays touch a rim.
    places = torch.linspace(0.01, 0.99, RAYS_A_FIELD, dtype=torch.float64) * (len(passing) - 1)
    chosen = passing[places.round().long()]
    columns = [torch.stack([torch.full_like(chosen, film_z, dtype=torch.float64), start.x[chosen]])]
    for k in every:
        x = out.crossings[k].x[chosen]
        columns.append(torch.stack([float(lens.vertices_mm[k]) + _sag(lens, k, x), x]))
    reach = 4 * max(lens.semi_diameters_mm)
    end = torch.stack([out.rays.dz[chosen], out.rays.dx[chosen]]) * reach
    lines = torch.stack([*columns, columns[-1] + end]).permute(2, 0, 1)  # [rays, points, (z, y)]
    angle = torch.atan2(out.rays.dx[passing].abs(), -out.rays.dz[passing]).mean()
    return lines.tolist(), math.degrees(float(angle))


def _sag(lens: Lens, k: int, height: Tensor) -> Tensor:
    """Depth of surface k at `height` behind its vertex, mm."""
    c = float(lens.surfaces[k].curvature)
    square = c * height * height
    return square / (1 + torch.sqrt((1 - c * square).clamp_min(0.0)))
