"""Bundles of rays from the scene that fill the real stop, traced to the film, for every lens whose chief rays exist.

The chief ray is found from the stop outwards (`trace.aiming`), as pupils may move with the field (fisheyes). Its
neighbours start on the plane across it at the front of the lens, and Newton's method on that plane takes each to its
point of the stop; rays for which this fails at once walk there from the chief ray in small steps. The derivative of
the mapping also turns stop area into the energy that a ray carries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from neurolens.analysis.fields import ChiefRays, Scene, on_plane
from neurolens.analysis.pupil_nodes import LitPart, lit_nodes, lit_part
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.trace.aiming import without_rims
from neurolens.trace.rays import trace
from neurolens.trace.surfaces import Rays, media

# The outermost ring lies this share inside the stop's edge, so that rounding never clips it.
_EDGE = 1e-7


class Pattern(NamedTuple):
    """Pupil points, each [P].

    Attributes:
        tangential, sagittal: shares of the stop's radius, in the meridional plane of the field (positive on the side
            on which its image lies) and across it.
        weight: share of the stop's area that a point stands for; sums to 1 (0 for the points of a fan).
    """

    tangential: Tensor
    sagittal: Tensor
    weight: Tensor


def hexapolar(rings: int) -> Pattern:
    """The centre and `rings` rings of 6, 12, 18, ... points, the last on the stop's edge; 1 + 3 n (n + 1) points.

    The weights are the areas nearest to each ring.
    """
    t, s, w = [0.0], [0.0], [(0.5 / rings) ** 2]
    for k in range(1, rings + 1):
        r = k / rings * (1 - _EDGE)
        area = (min(k + 0.5, rings) / rings) ** 2 - ((k - 0.5) / rings) ** 2
        for i in range(6 * k):
            angle = 2 * math.pi * i / (6 * k)
            t.append(r * math.cos(angle))
            s.append(r * math.sin(angle))
            w.append(area / (6 * k))
    return Pattern(_tensor(t), _tensor(s), _tensor(w))


def fan(n: int) -> Pattern:
    """2 n points: n along the meridional plane from -1 to 1, then n across it. Odd n holds the centre."""
    line = torch.linspace(-1, 1, n, dtype=torch.float64) * (1 - _EDGE)
    zero = torch.zeros_like(line)
    return Pattern(torch.cat([line, zero]), torch.cat([zero, line]), torch.zeros(2 * n, dtype=torch.float64))


def points(tangential: list[float], sagittal: list[float]) -> Pattern:
    """Single points, without weight."""
    return Pattern(_tensor(tangential), _tensor(sagittal), torch.zeros(len(tangential), dtype=torch.float64))


def _tensor(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


_DIRECT, _STRIDES, _PER_STRIDE = 5, 8, 3  # Newton steps; steps of the continuation from the chief ray
_AIMED = 1e-8  # how near to its point, in stop radii, a ray must come
_DIFFERENCE = 3e-6  # step of the derivative, in stop radii
_MARGIN = 0.1  # of the box of the stop's edge in front of the lens, in which light is searched


class Aim:
    """The mapping from the plane across the chief rays at the front to the stop, for F * W * P rays at once."""

    def __init__(self, scene: Scene, chief: ChiefRays, shape: tuple[int, int, int], waves: tuple[float, ...]) -> None:
        lens = scene.lens
        self.front = without_rims(replace(lens, surfaces=lens.surfaces[: lens.stop_index + 1]))
        self.stop_mm = lens.stop_radius_mm
        self.step_mm = _DIFFERENCE * lens.stop_radius_mm
        self.along_x = scene.axis == "x"
        self.shape = shape
        self.waves = waves

        def repeated(values: Tensor) -> Tensor:
            return values[:, None, None].expand(shape).reshape(-1)

        self.chief = Rays(*(repeated(c) for c in chief.start))
        origin = scene.object_points(chief.start)
        self.origin = None if origin is None else tuple(repeated(c) for c in origin)
        self.exists = repeated(chief.exists)
        self.wavelength: Tensor = torch.tensor(waves, dtype=torch.float64)[None, :, None].expand(shape).reshape(-1)

    def rays(self, u: Tensor, v: Tensor, rows: Tensor | slice = slice(None)) -> Rays:
        """Rays at (u, v) mm on the plane across their chief rays: u in the meridional plane, v across it."""
        c = Rays(*(p[rows] for p in self.chief))
        if self.along_x:
            x, y, z = c.x + u * c.dz, c.y + v, c.z - u * c.dx
        else:
            x, y, z = c.x + v, c.y + u * c.dz, c.z - u * c.dy
        if self.origin is None:
            return Rays(x, y, z, c.dx, c.dy, c.dz)
        ox, oy, oz = (p[rows] for p in self.origin)
        dx, dy, dz = x - ox, y - oy, z - oz
        length = torch.sqrt(dx * dx + dy * dy + dz * dz)
        return Rays(x, y, z, dx / length, dy / length, dz / length)

    def lead_mm(self, u: Tensor, v: Tensor) -> Tensor:
        """Path from the object point to the plane across the chief rays, less that of the chief ray."""
        if self.origin is None:
            return torch.zeros_like(u)
        square = _distance2(self.chief[:3], self.origin)
        # sqrt(a + b) - sqrt(a) without the loss of digits.
        more = u * u + v * v
        return more / (torch.sqrt(square + more) + torch.sqrt(square))

    def at(self, pattern: Pattern) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """u, v of the rays through the points of a pattern, whether they were found, and d(beam) / d(stop share)."""
        goal_t, goal_s = (g.expand(self.shape).reshape(-1) for g in (-pattern.tangential, pattern.sagittal))
        zero = torch.zeros_like(goal_t)
        everything = torch.arange(len(zero))
        u, v = self._newton(zero, zero, goal_t, goal_s, everything, _DIRECT)
        error, stretch = self._error(u, v, goal_t, goal_s, everything)
        lost = torch.nonzero(~(error < _AIMED) & self.exists)[:, 0]
        if len(lost):
            walk_u, walk_v = torch.zeros_like(goal_t[lost]), torch.zeros_like(goal_t[lost])
            for stride in range(1, _STRIDES + 1):
                share = stride / _STRIDES
                walk_u, walk_v = self._newton(
                    walk_u, walk_v, share * goal_t[lost], share * goal_s[lost], lost, _PER_STRIDE
                )
            u, v = u.index_copy(0, lost, walk_u), v.index_copy(0, lost, walk_v)
            again, stretch_again = self._error(walk_u, walk_v, goal_t[lost], goal_s[lost], lost)
            error, stretch = error.index_copy(0, lost, again), stretch.index_copy(0, lost, stretch_again)
        aimed = (error < _AIMED) & self.exists
        return torch.where(aimed, u, 0.0), torch.where(aimed, v, 0.0), aimed, stretch

    def _newton(
        self, u: Tensor, v: Tensor, goal_t: Tensor, goal_s: Tensor, rows: Tensor, steps: int
    ) -> tuple[Tensor, Tensor]:
        """Newton's steps from (u, v); a step that leaves the lens is halved and tried again."""
        good_u, good_v = u, v
        for _ in range(steps):
            t, s, exists, (tu, tv, su, sv) = self._map(u, v, rows)
            exists = exists & torch.isfinite(t + s)
            good_u, good_v = torch.where(exists, u, good_u), torch.where(exists, v, good_v)
            det = tu * sv - tv * su
            det = torch.where(det == 0, 1.0, det)
            et, es = goal_t - t, goal_s - s
            next_u, next_v = u + (sv * et - tv * es) / det, v + (tu * es - su * et) / det
            u = torch.where(exists, next_u, (u + good_u) / 2)
            v = torch.where(exists, next_v, (v + good_v) / 2)
        return u, v

    def _error(self, u: Tensor, v: Tensor, goal_t: Tensor, goal_s: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Distance from the goal in stop radii (inf for rays that do not exist), and beam area per stop share."""
        t, s, exists, (tu, tv, su, sv) = self._map(u, v, rows)
        error = torch.where(exists, torch.hypot(t - goal_t, s - goal_s), math.inf)
        return error, math.pi / (tu * sv - tv * su).abs() * self.spread(u, v, rows)

    def spread(self, u: Tensor, v: Tensor, rows: Tensor | slice = slice(None)) -> Tensor | float:
        """Energy of an area on the plane across the chief rays: 1, or of a near object the solid angle, 1/mm^2."""
        if self.origin is None:
            return 1.0
        # cos / r^2, with cos = distance / r.
        distance2 = _distance2(self.chief[:3], self.origin)[rows]
        return torch.sqrt(distance2) / (distance2 + u * u + v * v) ** 1.5

    def _map(self, u: Tensor, v: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
        """Stop coordinates (tangential, sagittal; in radii) of rays, whether they exist, and their derivatives."""
        h, n = self.step_mm, len(u)
        three = rows.repeat(3)
        rays = self.rays(torch.cat([u, u + h, u]), torch.cat([v, v, v + h]), three)
        with torch.no_grad():
            out = trace(self.front, rays, self.wavelength[three], towards="film")
        # The stop is the last surface of this lens: rays end on it.
        x, y = out.rays.x / self.stop_mm, out.rays.y / self.stop_mm
        t, s = (x, y) if self.along_x else (y, x)
        exists = (out.status == 0).reshape(3, n).all(0)
        t, s = t.reshape(3, n), s.reshape(3, n)
        slopes = ((t[1] - t[0]) / h, (t[2] - t[0]) / h, (s[1] - s[0]) / h, (s[2] - s[0]) / h)
        return t[0], s[0], exists, slopes


def _distance2(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@dataclass(frozen=True)
class Bundle:
    """Rays of F fields, W wavelengths and P pupil points; tensors are [F, W, P], or [F] for the chief ray.

    Tangential coordinates, of the stop and of the film, grow towards the side on which the image lies (the negative
    side of the scene's `axis`); sagittal ones along the other transverse axis.

    Attributes:
        start: before the front surface, travelling to the film.
        film: on the film plane.
        tangential_mm, sagittal_mm: film points relative to the chief ray of the first wavelength.
        pattern: None where the rays are nodes of `Filled`.
        status: of the trace with all rims and the stop; rays that could not be aimed count as missing surface 0.
        weight: energy of each ray: beam area in mm^2 (distant object) or solid angle in sr; 0 where it is blocked.
        open_weight: the same without the rims.
        path_mm: optical path from the wavefront (or object point) to the film.
        chief_height_mm: [F], image height of the chief ray of the first wavelength, positive.
    """

    scene: Scene
    field_deg: tuple[float, ...]
    wavelength_nm: tuple[float, ...]
    pattern: Pattern | None
    start: Rays
    film: Rays
    tangential_mm: Tensor
    sagittal_mm: Tensor
    status: Tensor
    weight: Tensor
    open_weight: Tensor
    path_mm: Tensor
    chief_height_mm: Tensor

    @property
    def passed(self) -> Tensor:
        return self.status == 0

    @property
    def slopes(self) -> tuple[Tensor, Tensor]:
        """Tangential and sagittal slope (mm per mm along +z) of the rays at the film, [F, W, P]."""
        x, y = self.film.dx / self.film.dz, self.film.dy / self.film.dz
        return (-x, y) if self.scene.axis == "x" else (-y, x)

    def at_shift(self, shift_mm: float) -> tuple[Tensor, Tensor]:
        """Tangential and sagittal points with the film moved by `shift_mm` away from the lens, [F, W, P]."""
        t, s = self.slopes
        return self.tangential_mm + shift_mm * t, self.sagittal_mm + shift_mm * s


def bundle(
    scene: Scene,
    field_deg: Sequence[float] | None,
    wavelength_nm: Sequence[float] | None = None,
    pattern: Pattern | None = None,
) -> Bundle:
    """Aim and trace rays of several fields and wavelengths through the points of a pupil pattern.

    Args:
        scene: lens, object and meridional plane.
        field_deg: angles of the chief ray of the first wavelength, from 0 to below 180; None: `Scene.default_fields`.
        wavelength_nm: the first is the reference; all share the object point (or direction) of its chief ray. None:
            `Scene.waves_nm`.
        pattern: hexapolar with 8 rings where not given.
    """
    pattern = pattern or hexapolar(8)
    fields, waves, chief = _chief(scene, field_deg, wavelength_nm)
    shape = (len(fields), len(waves), len(pattern.weight))
    aim = Aim(scene, chief, shape, waves)
    u, v, aimed, stretch = aim.at(pattern)
    area = pattern.weight.expand(shape).reshape(-1) * stretch
    area = torch.where(aimed & _inside_stop(scene, pattern).expand(shape).reshape(-1), area, 0.0)
    return _traced(scene, fields, chief, aim, (u, v), aimed, area, pattern)


class Filled:
    """Bundles that fill what stop and rims leave open of each field and wavelength, to any accuracy.

    Their rays are nodes of a quadrature on the planes across the chief rays at the front of the lens.
    """

    def __init__(
        self,
        scene: Scene,
        field_deg: Sequence[float] | None = None,
        wavelength_nm: Sequence[float] | None = None,
        to_stop: bool = False,
    ) -> None:
        """Find the light; arguments as of `bundle`. `to_stop`: all light that enters the stop, whatever rims take."""
        self.scene = scene
        self.lens = scene.to_stop if to_stop else scene.traced
        self.fields, self.waves, self.chief = _chief(scene, field_deg, wavelength_nm)
        self.height_mm = self.chief.height_mm.numpy()
        outline = hexapolar(2)
        u, v, aimed, _ = (c.reshape(-1, len(outline.weight)) for c in self._aim(len(outline.weight)).at(outline))
        # Where no ray meets the edge of the stop, the front surface bounds the light.
        reach = torch.where(aimed.all(1, keepdim=True), 0.0, scene.lens.surfaces[0].semi_diameter_mm)
        low = torch.stack([torch.where(aimed, c, 0.0).amin(1) for c in (u, v)], 1) - reach
        high = torch.stack([torch.where(aimed, c, 0.0).amax(1) for c in (u, v)], 1) + reach
        margin = _MARGIN * (high - low).amax(1, keepdim=True)
        self.part = lit_part(self._passes, low - margin, high + margin, torch.zeros_like(low))

    def only(self, fields: list[int]) -> Filled:
        """The same for some of the fields, by their numbers."""
        found, waves = copy(self), len(self.waves)
        start, exists, height, film = self.chief
        found.chief = ChiefRays(
            Rays(*(c[fields] for c in start)), exists[fields], height[fields], Rays(*(c[fields] for c in film))
        )
        found.fields = tuple(self.fields[k] for k in fields)
        found.part = LitPart(*(c.reshape(-1, waves)[fields].reshape(-1) for c in self.part))
        return found

    def bundle(self, level: int, path: bool = False) -> Bundle:
        """The bundle of a level of `lit_nodes`; its weights hold no light that rims take, nor does `open_weight`.

        Without `path` the optical paths are NaN: they take half of the time.
        """
        nodes = lit_nodes(self._passes, self.part, level)
        aim = self._aim(nodes.u.shape[1])
        u, v, area = (c.reshape(-1) for c in nodes)
        return _traced(
            self.scene, self.fields, self.chief, aim, (u, v), aim.exists, area * aim.spread(u, v), None, path
        )

    def energy(self, level: int) -> Tensor:
        """Energy [F] of all wavelengths; units as of `Bundle.weight`."""
        nodes = lit_nodes(self._passes, self.part, level)
        u, v = (c.reshape(-1) for c in nodes[:2])
        weight = nodes.area * self._passes(*nodes[:2])
        return (weight.reshape(-1) * self._aim(nodes.u.shape[1]).spread(u, v)).reshape(len(self.fields), -1).sum(1)

    def _aim(self, count: int) -> Aim:
        return Aim(self.scene, self.chief, (len(self.fields), len(self.waves), count), self.waves)

    def _passes(self, u: Tensor, v: Tensor) -> Tensor:
        aim = self._aim(u.shape[1])
        with torch.no_grad():
            out = trace(self.lens, aim.rays(u.reshape(-1), v.reshape(-1)), aim.wavelength, towards="film")
        return ((out.status == 0) & aim.exists).reshape(u.shape)


def _chief(
    scene: Scene, field_deg: Sequence[float] | None, wavelength_nm: Sequence[float] | None
) -> tuple[tuple[float, ...], tuple[float, ...], ChiefRays]:
    """Fields, wavelengths and chief rays of a bundle."""
    fields = scene.default_fields() if field_deg is None else tuple(float(f) for f in field_deg)
    waves = tuple(float(w) for w in wavelength_nm or scene.waves_nm)
    return fields, waves, scene.chief_rays(fields, waves[0])


def _traced(
    scene: Scene, fields: tuple[float, ...], chief: ChiefRays, aim: Aim, at: tuple[Tensor, Tensor], aimed: Tensor,
    area: Tensor, pattern: Pattern | None, path: bool = True,
) -> Bundle:  # fmt: skip
    """Trace the rays at places (u, v) of an aim to the film."""
    start, shape = aim.rays(*at), aim.shape
    film, status, length = _to_film(scene, start, aim.wavelength, path)
    status = torch.where(aimed, status, st.blocked(0, st.MISSED))
    passed = status == 0
    x, y = (c.reshape(shape) for c in (film.x, film.y))
    x, y = x - chief.film.x[:, None, None], y - chief.film.y[:, None, None]
    t, s = (-x, y) if scene.axis == "x" else (-y, x)

    def shaped(value: Tensor, keep: Tensor = passed, other: float = math.nan) -> Tensor:
        return torch.where(keep, value, other).reshape(shape)

    return Bundle(
        scene, fields, aim.waves, pattern,
        Rays(*(c.reshape(shape) for c in start)),
        Rays(*(shaped(c) for c in film)),
        shaped(t.reshape(-1)), shaped(s.reshape(-1)),
        status.reshape(shape), shaped(area, other=0.0), area.reshape(shape),
        shaped(aim.lead_mm(*at) + length), chief.height_mm,
    )  # fmt: skip


def check_light(scene: Scene, field_deg: Sequence[float] | None, wavelength_nm: float) -> list[str]:
    """A warning of each of the default fields (None) from which no ray reaches the film.

    Raises:
        InputError: a requested field from which no ray reaches the film, or a lens that passes no ray.
    """
    fields = scene.default_fields() if field_deg is None else field_deg
    seen = (Filled(scene, [0.0, *fields], [wavelength_nm]).part.reach > 0).tolist()
    if not any(seen):
        raise InputError(scene.lens.path, "surfaces", "(no ray reaches the film)", "a lens that passes light")
    dark = [field for field, lit in zip(field_deg or (), seen[1:], strict=False) if not lit]
    if dark:
        edge = f"at most {scene.edge.field_deg:.4g} degrees, the edge of the image"
        raise InputError(scene.lens.path, f"field {dark[0]:g}", "(no light reaches the film)", edge)
    lit = zip(fields, seen[1:], strict=True)
    return [f"rims leave no light of the field of {field:.4g} degrees" for field, light in lit if not light]


def _to_film(scene: Scene, start: Rays, wavelength_nm: Tensor, wanted: bool) -> tuple[Rays, Tensor, Tensor | float]:
    """Rays on the film, their status, and the optical path from their start to the film, NaN if that is not wanted."""
    lens = scene.traced
    with torch.no_grad():
        out = trace(lens, start, wavelength_nm, towards="film", path=wanted)
    film = on_plane(out.rays, scene.film_z_mm)
    if not wanted:
        return film, out.status, math.nan
    path = torch.zeros_like(start.x)
    indices = [m.n for m in media(lens, wavelength_nm)]
    points: list[Rays] = [start, *out.path, film]
    for n, before, after in zip(indices, points, points[1:], strict=False):
        # Along the ray, not the distance: steps back to the stop inside an element count as negative.
        gap = sum((b - a) * d for a, b, d in zip(before[:3], after[:3], before[3:], strict=True))
        path = path + n * gap
    return film, out.status, path


def _inside_stop(scene: Scene, pattern: Pattern) -> Tensor:
    """Whether the points of a pattern lie inside the blades or the mask of the stop, [P]."""
    t, s = pattern.tangential, pattern.sagittal
    if scene.lens.aperture is None:
        return torch.ones_like(t, dtype=torch.bool)
    x, y = (-t, s) if scene.axis == "x" else (s, -t)
    opened: Tensor = scene.lens.aperture.inside(x, y, 1.0)
    return opened
