"""The section of a lens with rays from the scene, as the plain data that `plot_layout.lens_layout` draws."""

from __future__ import annotations

import math
from typing import Any

import torch

from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import Scene
from neurolens.analysis.patterns import Pattern, fan
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.sag import sag_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

FIELDS = (0.0, 0.7, 1.0)  # shares of the film radius: axis, the zone of equal areas inside and outside, edge
RAYS_A_FIELD = 7
_FAN = 401


def layout_profile(scene: Scene, film_radius_mm: float | None = None) -> dict[str, Any]:
    """Section of a lens with meridional fans of rays to the axis, 70% and the edge of the film, d line.

    Args:
        film_radius_mm: edge of the film; that of the image circle if not given.

    Returns: plain data for `plot_layout.lens_layout`: surfaces, rays, film_z_mm, film_half_height_mm, title, subtitle.
        A field from which no ray of the section passes has no rays.
    """
    lens = scene.lens
    radius = scene.image_radius_mm if film_radius_mm is None else film_radius_mm
    rays: list[dict[str, Any]] = []
    for number, (share, field) in enumerate(zip(FIELDS, scene.fields_at([f * radius for f in FIELDS]), strict=True)):
        if math.isnan(field):
            continue
        where = "axis" if share == 0 else "edge" if share == 1 else f"{100 * share:.0f}% of the film radius"
        label = where if share == 0 else f"{where}, {field:.1f}°"
        rays += [{"points": line, "label": label, "field": number} for line in _fan_lines(scene, field)]
    return {
        "surfaces": [
            {
                "z_mm": float(z),
                "radius_mm": float(s.radius_mm),
                "semi_diameter_mm": s.semi_diameter_mm,
                "n_after": float(s.n_d),
                "stop": s.stop,
                "profile": _profile(s, float(z), scene.axis),
            }
            for s, z in zip(lens.surfaces, lens.vertices_mm[:-1], strict=True)
        ],
        "rays": rays,
        "film_z_mm": scene.film_z_mm,
        "film_half_height_mm": radius,
        "height": scene.axis,
        "title": lens.name,
        "subtitle": f"{state_text(scene)}, film radius {radius:.1f} mm",
    }


def refractions(lens: Lens) -> int:
    """Surfaces at which the medium changes: the stop and other surfaces in air do not count."""
    before = [1.0, *(float(s.n_d) for s in lens.surfaces)]
    return sum(a != b for a, b in zip(before, before[1:], strict=False))


def _profile(s: Surface, vertex_mm: float, axis: str) -> list[list[float]] | None:
    """Points [65] of (z, height) from rim to rim of a surface that is no sphere; None for spheres and planes."""
    if not (s.conic or s.asphere or s.cylinder) or math.isinf(s.semi_diameter_mm):
        return None
    height = torch.linspace(-s.semi_diameter_mm, s.semi_diameter_mm, 65, dtype=torch.float64)
    place = (height, torch.zeros_like(height)) if axis == "x" else (torch.zeros_like(height), height)
    found: list[list[float]] = torch.stack([vertex_mm + sag_mm(s, *place, held=True), height], 1).tolist()
    return found


def state_text(scene: Scene) -> str:
    """Focal length, f-number, refractions and focus of a scene, for headings."""
    data = scene.first_order
    focus = "infinity" if math.isinf(scene.focus_m) else f"{scene.focus_m:.4g} m"
    plane = f", {scene.axis}-z plane" if scene.lens.anamorphic else ""
    return (
        f"f = {data.efl_mm:.1f} mm, f/{data.f_number:.2g}, {refractions(scene.lens)} refractions, focus {focus}{plane}"
    )


def _fan_lines(scene: Scene, field: float) -> list[list[list[float]]]:
    """Polylines (z, height) of rays that pass, evenly spread over the open part of the stop."""
    line = fan(_FAN)
    tangential = Pattern(*(v[:_FAN] for v in line))
    rays = bundle(scene, [field], [LINE_D_NM], tangential)
    passing = torch.nonzero(rays.passed[0, 0])[:, 0]
    if len(passing) == 0:
        return []
    # A hair inside the ends: the outermost rays touch a rim.
    places = torch.linspace(0.01, 0.99, RAYS_A_FIELD, dtype=torch.float64) * (len(passing) - 1)
    chosen = passing[places.round().long()]
    start = Rays(*(c[0, 0][chosen] for c in rays.start))
    with torch.no_grad():
        path = trace(scene.lens, start, towards="film", path=True).path
    film = Rays(*(c[0, 0][chosen] for c in rays.film))
    # From a plane in front of everything, or for a fisheye from as far off.
    reach = 4 * max(d for d in scene.lens.semi_diameters_mm if math.isfinite(d))
    first = path[0]
    far = first._replace(x=first.x - reach * start.dx, y=first.y - reach * start.dy, z=first.z - reach * start.dz)
    columns = [torch.stack([p.z, p.x if scene.axis == "x" else p.y], -1) for p in (far, *path, film)]
    found: list[list[list[float]]] = torch.stack(columns, 1).tolist()
    return found
