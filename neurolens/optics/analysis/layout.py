"""The section of a lens with rays from the scene: as plain data, and drawn in mm with equal scales on both axes."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurolens.base.errors import InputError
from neurolens.base.report import BULK, Report
from neurolens.optics.analysis.bundles import Pattern, bundle, fan
from neurolens.optics.analysis.fields import Array, Scene
from neurolens.optics.analysis.plots import FAINT, FIELD_COLOURS, INK, drawing
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.trace.rays import plain_trace
from neurolens.optics.trace.shapes import sag_mm
from neurolens.optics.trace.surfaces import Rays

FIELDS = (0.0, 0.7, 1.0)  # shares of the film radius: the axis, the height that halves the picture's area, the edge
RAYS_A_FIELD = 7
_FAN = 401
_AIR = 1.01  # a medium of a smaller index is drawn as air


@dataclass(frozen=True)
class Section:
    """One surface in section, lens frame, mm.

    Attributes:
        radius_mm: inf for a plane.
        n_after: index of the medium behind it.
        profile: [M, 2] points (z, height) from rim to rim of a surface that is no sphere, else None.
        ideal: whether it is an ideal thin lens.
    """

    z_mm: float
    radius_mm: float
    semi_diameter_mm: float
    n_after: float
    stop: bool = False
    profile: Array | None = None
    ideal: bool = False

    def arc(self) -> Array:
        """Return points [M, 2] of (z, height) from rim to rim.

        On a sphere they are evenly spaced in angle, not in height: the rim of a front lens near a half ball stays
        smooth.
        """
        if self.profile is not None:
            return self.profile
        h, radius = self.semi_diameter_mm, self.radius_mm
        if not math.isfinite(radius):
            y = np.linspace(-h, h, 65)
            return np.stack([np.full_like(y, self.z_mm), y], axis=1)
        angle = np.linspace(-1, 1, 65) * math.asin(min(1.0, h / abs(radius)))
        return np.stack([self.z_mm + radius * (1 - np.cos(angle)), abs(radius) * np.sin(angle)], axis=1)


@dataclass(frozen=True)
class Line:
    """A ray: points [M, 2] of (z, height) in mm, the name of its field in the legend, and the field's colour."""

    points: Array
    label: str
    field: int


@dataclass(frozen=True)
class Layout(Report):
    """The section of a lens, scene to film; lens frame, mm.

    Attributes:
        height: transverse axis of the section, "x" or "y".

    Raises:
        InputError: a surface has a semi-diameter that is not positive and finite.
    """

    surfaces: tuple[Section, ...] = field(metadata=BULK)
    rays: tuple[Line, ...] = field(metadata=BULK)
    film_z_mm: float
    film_half_height_mm: float
    height: str
    title: str
    subtitle: str

    def __post_init__(self) -> None:
        for index, s in enumerate(self.surfaces):
            if not 0 < s.semi_diameter_mm < math.inf:
                where = f"surface {index}, semi_diameter_mm"
                raise InputError("lens layout", where, s.semi_diameter_mm, "a number above 0")


def layout_profile(scene: Scene, film_radius_mm: float | None = None) -> Layout:
    """Return a lens's section with meridional fans of rays to the axis, 70% and the edge of the film.

    They are of the reference wavelength. The edge of the film is that of the image circle if not given. A field of
    which no ray passes has none.
    """
    lens = scene.lens
    radius = scene.image_radius_mm if film_radius_mm is None else film_radius_mm
    rays: list[Line] = []
    for number, (share, angle) in enumerate(zip(FIELDS, scene.fields_at([f * radius for f in FIELDS]), strict=True)):
        if math.isnan(angle):
            continue
        where = "axis" if share == 0 else "edge" if share == 1 else f"{100 * share:.0f}% of the film radius"
        label = where if share == 0 else f"{where}, {angle:.1f}°"
        rays += [Line(points, label, number) for points in _fan_lines(scene, angle)]
    sections = (
        Section(
            *(float(z), float(s.radius_mm), s.semi_diameter_mm, float(s.n_d), s.stop),
            *(_profile(s, float(z), scene.axis), s.figure.power != 0),
        )
        for s, z in zip(lens.surfaces, lens.vertices_mm[:-1], strict=True)
    )
    subtitle = f"{state_text(scene)}, film radius {radius:.1f} mm"
    return Layout(tuple(sections), tuple(rays), scene.film_z_mm, radius, scene.axis, lens.name, subtitle)


def _profile(s: Surface, vertex_mm: float, axis: str) -> Array | None:
    """Points [65, 2] of (z, height) from rim to rim of a surface that is no sphere; None for spheres and planes."""
    if s.figure.plain or math.isinf(s.semi_diameter_mm):
        return None
    height = torch.linspace(-s.semi_diameter_mm, s.semi_diameter_mm, 65, dtype=torch.float64)
    place = (height, torch.zeros_like(height)) if axis == "x" else (torch.zeros_like(height), height)
    return torch.stack([vertex_mm + sag_mm(s, *place, held=True), height], 1).numpy()


def state_text(scene: Scene) -> str:
    """Return the focal length, f-number, refractions and focus of a scene as text for headings."""
    data, count = scene.first_order, scene.lens.refractions
    focus = "infinity" if math.isinf(scene.focus_m) else f"{scene.focus_m:.4g} m"
    plane = f", {scene.axis}-z plane" if scene.lens.anamorphic else ""
    return f"f = {data.efl_mm:.1f} mm, f/{data.f_number:.2g}, {count} refractions, focus {focus}{plane}"


def _fan_lines(scene: Scene, field: float) -> list[Array]:
    """Return polylines (z, height) of rays that pass, evenly spread over the open part of the stop."""
    line = fan(_FAN)
    tangential = Pattern(*(v[:_FAN] for v in line))
    rays = bundle(scene, [field], [scene.lens.reference_nm], tangential)
    passing = torch.nonzero(rays.passed[0, 0])[:, 0]
    if len(passing) == 0:
        return []
    # Slightly inside the ends, where the outermost rays touch a rim.
    places = torch.linspace(0.01, 0.99, RAYS_A_FIELD, dtype=torch.float64) * (len(passing) - 1)
    chosen = passing[places.round().long()]
    start = Rays(*(c[0, 0][chosen] for c in rays.start))
    path = plain_trace(scene.lens, start, towards="film", path=True).path
    film = Rays(*(c[0, 0][chosen] for c in rays.film))
    # From a plane in front of all surfaces; for a fisheye, from the same distance.
    reach = 4 * max(d for d in scene.lens.semi_diameters_mm if math.isfinite(d))
    first = path[0]
    far = first._replace(x=first.x - reach * start.dx, y=first.y - reach * start.dy, z=first.z - reach * start.dz)
    columns = [torch.stack([p.z, p.x if scene.axis == "x" else p.y], -1) for p in (far, *path, film)]
    return list(torch.stack(columns, 1).numpy())


def lens_layout(layout: Layout, path: str | Path) -> None:
    """Draw a lens with rays, light from left to right, as PNG, PDF or SVG."""
    z, top = _limits(layout)
    height_in = min(9.0, max(3.5, 8.6 * 2 * top / (z[1] - z[0]) + 1.7))
    with drawing(path, 9.4, height_in, layout.title, layout.subtitle) as figure:
        axes = figure.add_subplot()
        axes.set(xlabel="z (mm), light travels this way →", ylabel=f"{layout.height} (mm)")
        draw_section(axes, layout, lw=0.7, ls=(0, (12, 3, 2, 3)))
        entries = sorted(zip(*axes.get_legend_handles_labels(), strict=True), key=lambda e: e[1] in ("stop", "film"))
        handles, labels = zip(*entries, strict=True)  # fields first
        figure.legend(handles, labels, loc="outside lower center", ncols=min(7, len(labels)))


def draw_section(axes: Any, layout: Layout, **axis: Any) -> None:
    """Draw the lens, its film and its rays on axes of equal scale; `axis` is the look of the optical axis."""
    z, top = _limits(layout)
    axes.set(xlim=z, ylim=(-top, top), aspect="equal")
    axes.plot(z, (0, 0), color=FAINT, zorder=1, **axis)
    _draw_glass(axes, layout.surfaces)
    _draw_rims(axes, layout.surfaces)
    film, half = layout.film_z_mm, layout.film_half_height_mm
    axes.plot((film, film), (-half, half), color="#8b1a1a", lw=2.2, solid_capstyle="butt", zorder=5, label="film")
    unnamed = {ray.label for ray in layout.rays}
    for ray in layout.rays:
        colour = FIELD_COLOURS[ray.field % len(FIELD_COLOURS)]
        label = ray.label if ray.label in unnamed else None  # the rays of a field have one entry in the legend
        unnamed.discard(ray.label)
        axes.plot(*ray.points.T, color=colour, lw=0.85, alpha=0.85, zorder=3.5, label=label)


def _limits(layout: Layout) -> tuple[tuple[float, float], float]:
    """Return z from a little before the glass to a little behind the film, and the greatest height."""
    height = max(s.semi_diameter_mm for s in layout.surfaces)
    z = np.concatenate([*(s.arc()[:, 0] for s in layout.surfaces), [layout.film_z_mm]])
    ends = float(z.min() - 0.55 * height - 0.04 * np.ptp(z)), float(z.max() + 0.06 * np.ptp(z) + 0.05 * height)
    return ends, max(height * 1.18, 1.06 * layout.film_half_height_mm)


def element_outline(front: Section, back: Section, step: int = 1) -> Array:
    """Return the closed outline [K, 2] of the glass between two surfaces.

    It has both arcs, flats out to the wider rim, and the cylindrical edge. Where the flats would cross (a thin-edged
    lens with unlike rims) the edge runs straight from rim to rim. Of `step` points of an arc one is taken; `step`
    divides 64, so that the ends are among them.
    """
    a, b = front.arc()[::step], back.arc()[::step]
    edge = max(front.semi_diameter_mm, back.semi_diameter_mm)
    z_front, z_back = a[-1, 0], b[-1, 0]
    if z_back <= z_front:
        return np.concatenate([a, b[::-1]])
    upper = np.array([[z_front, edge], [z_back, edge]])
    lower = np.array([[z_back, -edge], [z_front, -edge]])
    return np.concatenate([a, upper, b[::-1], lower])


def _draw_glass(axes: Any, surfaces: Sequence[Section]) -> None:
    """Fill each element, darker for a higher index, so that the parts of a cemented group stay apart."""
    for front, back in zip(surfaces, surfaces[1:], strict=False):
        if front.n_after < _AIR:
            continue
        tone = min(1.0, max(0.0, (front.n_after - 1.45) / 0.45))
        fill = tuple(np.array([0.87, 0.93, 0.975]) * (1 - tone) + np.array([0.55, 0.71, 0.86]) * tone)
        axes.fill(*element_outline(front, back).T, fc=fill, ec="#3d5a75", lw=0.9, joinstyle="round", zorder=2)


def _draw_rims(axes: Any, surfaces: Sequence[Section]) -> None:
    """Draw a tick outside each rim of glass, which blocks rays, and the stop as two solid bars."""
    height = max(s.semi_diameter_mm for s in surfaces)
    for s in surfaces:
        if s.ideal:
            axes.plot(*s.arc().T, color="#3d5a75", lw=1.6, zorder=2)
        h, z = s.semi_diameter_mm, s.arc()[-1, 0]
        reach = max(h * 1.15, h + 0.16 * height) if s.stop else h + 0.035 * height
        look = {"color": INK, "lw": 3.2 if s.stop else 1.3, "solid_capstyle": "butt", "zorder": 4 if s.stop else 3}
        for sign, label in ((-1, "stop" if s.stop else None), (1, None)):
            axes.plot((z, z), (sign * h, sign * reach), label=label, **look)


_WIDTH, _LEAST, _MOST = 240.0, 60.0, 200.0  # pixels of a thumbnail: width, least and largest height
_EVERY = 8  # points of an arc of which one is drawn
_SVG_RAYS = ("#3b6fb6", "#3d9a50", "#c2502e")


def thumbnail(layout: Layout) -> str:
    """Return the section as a small SVG element (some 3 kB, no ids), for tables of many lenses."""
    (left, right), top = _limits(layout)
    scale = min(_WIDTH / (right - left), _MOST / (2 * top))
    width, height = scale * (right - left), max(2 * scale * top, _LEAST)

    def path(lines: Iterable[Array], look: str, close: str = "") -> str:
        """Write lines as steps in tenths of a pixel, which take half as many letters as places do."""
        text = ""
        for points in lines:
            x = np.clip(scale * (points[:, 0] - left), -9 * _WIDTH, 9 * _WIDTH)
            y = np.clip(height / 2 - scale * points[:, 1], -9 * _WIDTH, 9 * _WIDTH)
            places = np.rint(10 * np.stack([x, y], 1)).astype(int)
            first, *steps = [places[0], *np.diff(places, axis=0)]
            text += f"M{first[0]} {first[1]}l" + " ".join(f"{a} {b}" for a, b in steps) + close
        return f"<path d='{text.replace(' -', '-')}' {look}/>" if text else ""

    glass = [
        element_outline(front, back, _EVERY)
        for front, back in zip(layout.surfaces, layout.surfaces[1:], strict=False)
        if front.n_after >= _AIR
    ]
    parts = [
        path(glass, "fill='#a9cbe4' stroke='#3d5a75' stroke-width='7'", "Z"),
        path((s.arc()[[0, -1]] for s in layout.surfaces if s.ideal), "stroke='#3d5a75' stroke-width='12'"),
    ]
    rays = layout.rays[:: RAYS_A_FIELD // 2]
    for k, colour in enumerate(_SVG_RAYS):
        drawn = (r.points for r in rays if r.field % len(_SVG_RAYS) == k)
        parts.append(path(drawn, f"fill='none' stroke='{colour}' stroke-width='6'"))
    for s in layout.surfaces:
        if s.stop:
            h, reach = s.semi_diameter_mm, max(1.15 * s.semi_diameter_mm, s.semi_diameter_mm + 0.14 * top)
            bars = (np.array([[s.z_mm, sign * h], [s.z_mm, sign * reach]]) for sign in (1, -1))
            parts.append(path(bars, "stroke='currentColor' stroke-width='20'"))
    film, half = layout.film_z_mm, layout.film_half_height_mm
    parts.append(path([np.array([[film, -half], [film, half]])], "stroke='#b02a2a' stroke-width='16'"))
    box = f"viewBox='0 0 {10 * width:.0f} {10 * height:.0f}' width='{width:.0f}' height='{height:.0f}'"
    return f"<svg xmlns='http://www.w3.org/2000/svg' {box}>{''.join(parts)}</svg>"
