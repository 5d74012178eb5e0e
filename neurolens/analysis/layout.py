"""The section of a lens with rays from the scene: as plain data, and drawn in millimetres with equal axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.analysis.bundles import Pattern, bundle, fan
from neurolens.analysis.fields import Scene
from neurolens.analysis.plot_style import FAINT, FIELD_COLOURS, INK, new_figure, save, style
from neurolens.base.errors import InputError
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

    Returns: plain data for `lens_layout`: surfaces, rays, film_z_mm, film_half_height_mm, title, subtitle.
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
    # Slightly inside the ends: the outermost rays touch a rim.
    places = torch.linspace(0.01, 0.99, RAYS_A_FIELD, dtype=torch.float64) * (len(passing) - 1)
    chosen = passing[places.round().long()]
    start = Rays(*(c[0, 0][chosen] for c in rays.start))
    with torch.no_grad():
        path = trace(scene.lens, start, towards="film", path=True).path
    film = Rays(*(c[0, 0][chosen] for c in rays.film))
    # From a plane in front of all surfaces, or for a fisheye from the same distance.
    reach = 4 * max(d for d in scene.lens.semi_diameters_mm if math.isfinite(d))
    first = path[0]
    far = first._replace(x=first.x - reach * start.dx, y=first.y - reach * start.dy, z=first.z - reach * start.dz)
    columns = [torch.stack([p.z, p.x if scene.axis == "x" else p.y], -1) for p in (far, *path, film)]
    found: list[list[list[float]]] = torch.stack(columns, 1).tolist()
    return found


Points = NDArray[np.float64]
Section = Mapping[str, Any]

_AIR = 1.01  # a medium of a smaller index is drawn as air


def lens_layout(profile: Mapping[str, Any], path: str | Path) -> Path:
    """Draw a lens with rays, light from left to right.

    Args:
        profile: lens frame, mm:
            surfaces: list of {z_mm, radius_mm (inf: plane), semi_diameter_mm, n_after, stop}, scene to film; what is
                no sphere has its section as profile, [M, 2] of (z, y) from rim to rim;
            rays: list of {points: [M, 2] of (z, y), label (one field a label, None: not in the legend), field (colour
                number; by label where absent)};
            film_z_mm, film_half_height_mm (either may be absent); height ("y", the transverse axis); title, subtitle.
        path: PNG, PDF or SVG to write.
    Raises:
        InputError: no surface, a key missing, a semi-diameter that is not positive, a polyline of another shape.
    """
    surfaces = checked_surfaces(profile)
    rays = checked_rays(profile)
    height = max(float(s["semi_diameter_mm"]) for s in surfaces)
    with style():
        z = z_range(profile, surfaces, height)
        top = max(height * 1.18, 1.06 * float(profile.get("film_half_height_mm") or 0))
        figure = new_figure(9.4, min(9.0, max(3.4, 8.6 * 2 * top / (z[1] - z[0]) + 1.5)))
        axes = figure.add_subplot()
        axes.set(xlim=z, ylim=(-top, top), aspect="equal")
        axes.set(xlabel="z (mm), light travels this way →", ylabel=f"{profile.get('height', 'y')} (mm)")
        axes.plot(z, (0, 0), color=FAINT, lw=0.7, ls=(0, (12, 3, 2, 3)), zorder=1)
        draw_glass(axes, surfaces)
        draw_rims(axes, surfaces, height)
        draw_film(axes, profile)
        draw_rays(axes, rays)
        subtitle = str(profile.get("subtitle") or "")
        # The empty second line of the title keeps room for the subtitle, which has a lighter style.
        axes.set_title(str(profile.get("title", "")) + ("\n" if subtitle else ""), loc="left", fontweight="bold")
        axes.annotate(
            subtitle, (0, 1), xycoords="axes fraction", xytext=(0, 6), textcoords="offset points",
            fontsize=9, color="#555b63", in_layout=False,
        )  # fmt: skip
        _legend(figure, axes)
        return save(figure, path)


def arc(surface: Section, half_height_mm: float | None = None) -> Points:
    """Section of a surface from -h to h, [65, 2] of (z, y) in mm; h its semi-diameter or `half_height_mm`.

    Points are even in angle, not height: the rim of a front lens close to a half ball stays smooth. A surface that
    brings its own section (`profile`) has that.
    """
    if surface.get("profile") is not None and half_height_mm is None:
        return np.asarray(surface["profile"], dtype=np.float64)
    h = float(surface["semi_diameter_mm"] if half_height_mm is None else half_height_mm)
    z, radius = float(surface["z_mm"]), float(surface["radius_mm"])
    if not math.isfinite(radius) or radius == 0:
        y = np.linspace(-h, h, 65)
        return np.stack([np.full_like(y, z), y], axis=1)
    angle = np.linspace(-1, 1, 65) * math.asin(min(1.0, h / abs(radius)))
    return np.stack([z + radius * (1 - np.cos(angle)), abs(radius) * np.sin(angle)], axis=1)


def element_outline(front: Section, back: Section) -> Points:
    """Closed outline [K, 2] of the glass between two surfaces: both arcs, flats to the wider rim, the cylinder edge.

    Where the flats would cross (a thin-edged lens of unlike rims) the edge runs straight from rim to rim.
    """
    a, b = arc(front), arc(back)
    edge = max(float(front["semi_diameter_mm"]), float(back["semi_diameter_mm"]))
    z_front, z_back = a[-1, 0], b[-1, 0]
    if z_back <= z_front:
        return np.concatenate([a, b[::-1]])
    upper = np.array([[z_front, edge], [z_back, edge]])
    lower = np.array([[z_back, -edge], [z_front, -edge]])
    return np.concatenate([a, upper, b[::-1], lower])


def checked_surfaces(profile: Mapping[str, Any]) -> list[Section]:
    surfaces = list(profile.get("surfaces", ()))
    if not surfaces:
        raise InputError("lens layout", "surfaces", "(none)", "at least one surface")
    for index, surface in enumerate(surfaces):
        for key in ("z_mm", "radius_mm", "semi_diameter_mm", "n_after"):
            value = surface.get(key)
            if not isinstance(value, int | float) or math.isnan(value) or (key != "radius_mm" and math.isinf(value)):
                raise InputError("lens layout", f"surface {index}, {key}", value, "a number")
        if surface["semi_diameter_mm"] <= 0:
            raise InputError(
                "lens layout", f"surface {index}, semi_diameter_mm", surface["semi_diameter_mm"], "above 0"
            )
    return surfaces


def checked_rays(profile: Mapping[str, Any]) -> list[tuple[str | None, int | None, Points]]:
    """(label, field, points [M, 2]) for each ray, without points that are not finite, as a blocked ray leaves them."""
    rays = []
    for index, ray in enumerate(profile.get("rays", ())):
        points = np.asarray(ray["points"], dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError("lens layout", f"ray {index}, points", f"({points.shape})", "[M, 2] of (z, y)")
        rays.append((ray.get("label"), ray.get("field"), points[np.isfinite(points).all(axis=1)]))
    return rays


def z_range(profile: Mapping[str, Any], surfaces: Sequence[Section], height: float) -> tuple[float, float]:
    """From a little before the glass (rays come in from there) to a little behind the film."""
    film = profile.get("film_z_mm")
    z = np.concatenate([arc(s)[:, 0] for s in surfaces] + ([np.array([float(film)])] if film is not None else []))
    return float(z.min() - 0.55 * height - 0.04 * np.ptp(z)), float(z.max() + 0.06 * np.ptp(z) + 0.05 * height)


def draw_glass(axes: Any, surfaces: Sequence[Section]) -> None:
    """Fill each element, darker for a higher index, so that the parts of a cemented group stay apart."""
    for front, back in zip(surfaces, surfaces[1:], strict=False):
        n = float(front["n_after"])
        if n < _AIR:
            continue
        tone = min(1.0, max(0.0, (n - 1.45) / 0.45))
        fill = tuple(np.array([0.87, 0.93, 0.975]) * (1 - tone) + np.array([0.55, 0.71, 0.86]) * tone)
        axes.fill(*element_outline(front, back).T, fc=fill, ec="#3d5a75", lw=0.9, joinstyle="round", zorder=2)


def draw_rims(axes: Any, surfaces: Sequence[Section], height: float) -> None:
    """A tick outside each rim of glass, which blocks rays; the stop as two solid bars."""
    named = False
    for surface in surfaces:
        h, z = float(surface["semi_diameter_mm"]), arc(surface)[-1, 0]
        stop = bool(surface.get("stop"))
        reach = max(h * 1.15, h + 0.16 * height) if stop else h + 0.035 * height
        look = {"color": INK, "lw": 3.2 if stop else 1.3, "solid_capstyle": "butt", "zorder": 4 if stop else 3}
        for sign in (-1, 1):
            label = "stop" if stop and not named else None
            named = named or stop
            axes.plot((z, z), (sign * h, sign * reach), label=label, **look)


def draw_film(axes: Any, profile: Mapping[str, Any]) -> None:
    film, half = profile.get("film_z_mm"), profile.get("film_half_height_mm")
    if film is None:
        return
    bottom, top = axes.get_ylim()
    half = float(half) if half else max(abs(bottom), abs(top))
    axes.plot((film, film), (-half, half), color="#8b1a1a", lw=2.2, solid_capstyle="butt", zorder=5, label="film")


def draw_rays(axes: Any, rays: Sequence[tuple[str | None, int | None, Points]]) -> None:
    """Rays of one label share a colour and one entry of the legend; `field` sets the colour where given."""
    labels: list[str | None] = []
    for label, field, points in rays:
        known = label in labels
        if not known:
            labels.append(label)
        colour = FIELD_COLOURS[(labels.index(label) if field is None else int(field)) % len(FIELD_COLOURS)]
        axes.plot(*points.T, color=colour, lw=0.85, alpha=0.85, zorder=3.5, label=None if known else label)


def _legend(figure: Any, axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    order = sorted(range(len(labels)), key=lambda i: labels[i] in ("stop", "film"))  # fields first
    figure.legend(
        [handles[i] for i in order], [labels[i] for i in order], loc="outside lower center", ncols=min(7, len(labels))
    )
