"""Bundles of rays from the scene that fill the real stop, traced to the film; for every lens that has chief rays.

The chief ray is found from the stop outwards (`optics.trace.aiming`), as pupils may move with the field (fisheyes). Its
neighbours start on the plane across it at the front of the lens, and Newton's method on that plane takes each of them
to its point of the stop. Rays for which this fails walk there from the chief ray in small steps. The derivative of the
mapping also turns stop area into the energy that a ray carries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.analysis.fields import ChiefRays, Scene, on_plane
from neurolens.optics.setting.pupil_nodes import LitPart, lit_nodes, lit_part
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.rays import optical_path, plain_trace
from neurolens.optics.trace.surfaces import Rays

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
    """The centre and `rings` rings of 6, 12, 18, ... points, the last on the stop's edge: 1 + 3 n (n + 1) points.

    Each ring has as its weight the area that is nearest to it.
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
    """2 n points: n along the meridional plane from -1 to 1, then n across it. With an odd n the centre is there."""
    line = torch.linspace(-1, 1, n, dtype=torch.float64) * (1 - _EDGE)
    zero = torch.zeros_like(line)
    return Pattern(torch.cat([line, zero]), torch.cat([zero, line]), torch.zeros(2 * n, dtype=torch.float64))


def points(tangential: list[float], sagittal: list[float]) -> Pattern:
    """Return single points, without weight."""
    return Pattern(_tensor(tangential), _tensor(sagittal), torch.zeros(len(tangential), dtype=torch.float64))


def _tensor(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


_DIRECT, _STRIDES, _PER_STRIDE = 5, 8, 3  # Newton steps; steps of the continuation from the chief ray
_AIMED = 1e-8  # how near to its point, in stop radii, a ray must come
_DIFFERENCE = 3e-6  # step of the derivative, in stop radii
_MARGIN = 0.1  # of the box of the stop's edge in front of the lens, in which light is searched


class Aim:
    """The mapping from the plane across the chief rays at the front to the stop, for F * W * P rays at once."""

    def __init__(self, scene: Scene, chief: ChiefRays, points: int, waves: tuple[float, ...]) -> None:
        lens, shape = scene.lens, (len(chief.exists), len(waves), points)
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
        # Squared distance from the object point to the plane across the chief ray; None where the object is distant.
        ends = zip(self.chief[:3], self.origin or (), strict=False)
        self.distance2 = None if origin is None else sum((a - b) ** 2 for a, b in ends)
        self.exists = repeated(chief.exists)
        self.wavelength: Tensor = torch.tensor(waves, dtype=torch.float64)[None, :, None].expand(shape).reshape(-1)

    def rays(self, u: Tensor, v: Tensor, rows: Tensor | slice = slice(None)) -> Rays:
        """Return rays at (u, v) mm on the plane across their chief rays: u in the meridional plane, v across it."""
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
        """Return how much longer (mm) the rays' paths from object point to front plane are than the chief ray's."""
        if self.distance2 is None:
            return torch.zeros_like(u)
        # sqrt(a + b) - sqrt(a) without the loss of digits.
        more = u * u + v * v
        return more / (torch.sqrt(self.distance2 + more) + torch.sqrt(self.distance2))

    def at(self, pattern: Pattern) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Aim at the points of a pattern: u, v (mm) [F W P], whether rays were found, and d(beam) / d(stop share)."""
        goal = torch.stack([-pattern.tangential, pattern.sagittal])[:, None, None].expand(2, *self.shape).flatten(1)
        everything = torch.arange(goal.shape[1])
        uv = self._newton(torch.zeros_like(goal), goal, everything, _DIRECT)
        error, stretch = self._error(uv, goal, everything)
        lost = torch.nonzero(~(error < _AIMED) & self.exists)[:, 0]
        if len(lost):
            walk, far = torch.zeros_like(goal[:, lost]), goal[:, lost]
            for stride in range(1, _STRIDES + 1):
                walk = self._newton(walk, stride / _STRIDES * far, lost, _PER_STRIDE)
            uv = uv.index_copy(1, lost, walk)
            again, stretch_again = self._error(walk, far, lost)
            error, stretch = error.index_copy(0, lost, again), stretch.index_copy(0, lost, stretch_again)
        aimed = (error < _AIMED) & self.exists
        u, v = torch.where(aimed, uv, 0.0)
        return u, v, aimed, stretch

    def _newton(self, uv: Tensor, goal: Tensor, rows: Tensor, steps: int) -> Tensor:
        """Take Newton's steps from places [2, N]; a step that leaves the lens is halved and tried again."""
        good = uv
        for _ in range(steps):
            stop, exists, (tu, tv, su, sv) = self._map(uv, rows)
            exists = exists & torch.isfinite(stop.sum(0))
            good = torch.where(exists, uv, good)
            det = tu * sv - tv * su
            det = torch.where(det == 0, 1.0, det)
            et, es = goal - stop
            step = torch.stack([sv * et - tv * es, tu * es - su * et]) / det
            uv = torch.where(exists, uv + step, (uv + good) / 2)
        return uv

    def _error(self, uv: Tensor, goal: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """The distance from the goal in stop radii (inf for rays that do not exist), and beam area per stop share."""
        stop, exists, (tu, tv, su, sv) = self._map(uv, rows)
        error = torch.where(exists, torch.hypot(*(stop - goal)), math.inf)
        return error, math.pi / (tu * sv - tv * su).abs() * self.spread(uv[0], uv[1], rows)

    def spread(self, u: Tensor, v: Tensor, rows: Tensor | slice = slice(None)) -> Tensor | float:
        """The energy per area of the plane across the chief rays: 1, or for a near object solid angle in 1/mm^2."""
        if self.distance2 is None:
            return 1.0
        # cos / r^2, with cos = distance / r.
        distance2 = self.distance2[rows]
        return torch.sqrt(distance2) / (distance2 + u * u + v * v) ** 1.5

    def _map(self, uv: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Return stop coordinates [2, N] (tangential, sagittal; in radii), whether rays exist, and the derivatives."""
        (u, v), h = uv, self.step_mm
        three = rows.repeat(3)
        rays = self.rays(torch.cat([u, u + h, u]), torch.cat([v, v, v + h]), three)
        out = plain_trace(self.front, rays, self.wavelength[three], towards="film")
        # The stop is the last surface of this lens: rays end on it.
        x, y = (c.reshape(3, -1) / self.stop_mm for c in out.rays[:2])
        t, s = (x, y) if self.along_x else (y, x)
        exists = (out.status == 0).reshape(3, -1).all(0)
        slopes = ((t[1] - t[0]) / h, (t[2] - t[0]) / h, (s[1] - s[0]) / h, (s[2] - s[0]) / h)
        return torch.stack([t[0], s[0]]), exists, slopes


@dataclass(frozen=True)
class Bundle:
    """Rays of F fields, W wavelengths and P pupil points; tensors are [F, W, P], or [F] for the chief ray.

    Tangential coordinates, of the stop and of the film, grow towards the side on which the image lies (the negative
    side of the scene's `axis`); sagittal ones along the other transverse axis.

    Attributes:
        start: before the front surface, travelling to the film.
        film: on the film plane.
        tangential_mm, sagittal_mm: film points relative to the chief ray of the first wavelength.
        status: of the trace with all rims and the stop; rays that could not be aimed count as missing surface 0.
        weight: energy of each ray: beam area in mm^2 (distant object) or solid angle in sr; 0 where it is blocked.
        open_weight: the same for all rays through the stop, whatever stops them; in `Filled`, rays that rims stop are
            not there.
        path_mm: optical path from the wavefront (or object point) to the film.
        chief_height_mm: [F], image height of the chief ray of the first wavelength, positive.
    """

    scene: Scene
    field_deg: tuple[float, ...]
    wavelength_nm: tuple[float, ...]
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
        """Whether each ray reaches the film, [F, W, P]."""
        return self.status == 0

    @property
    def slopes(self) -> tuple[Tensor, Tensor]:
        """The tangential and sagittal slopes (mm per mm along +z) of the rays at the film, [F, W, P]."""
        return self.scene.image_axes(self.film.dx / self.film.dz, self.film.dy / self.film.dz)

    @property
    def cosines(self) -> tuple[Tensor, Tensor]:
        """The tangential and sagittal direction cosines of the rays at the film, [F, W, P]."""
        return self.scene.image_axes(self.film.dx, self.film.dy)

    def at_shift(self, shift_mm: float) -> tuple[Tensor, Tensor]:
        """Return tangential and sagittal points with the film moved by `shift_mm` away from the lens, [F, W, P]."""
        t, s = self.slopes
        return self.tangential_mm + shift_mm * t, self.sagittal_mm + shift_mm * s


def bundle(
    scene: Scene, field_deg: Sequence[float] | None, wavelength_nm: Sequence[float] | None = None,
    pattern: Pattern | None = None,
) -> Bundle:  # fmt: skip
    """Aim and trace rays of several fields and wavelengths through the points of a pupil pattern.

    Args:
        scene: lens, object and meridional plane.
        field_deg: angles of the chief ray of the first wavelength, from 0 to below 180; None: `Scene.default_fields`.
        wavelength_nm: the first is the reference; all wavelengths share the object point (or direction) of its chief
            ray. None: `Scene.waves_nm`.
        pattern: None is hexapolar with 8 rings.
    """
    pattern = pattern or hexapolar(8)
    fields, waves, chief = _chief(scene, field_deg, wavelength_nm)
    aim = Aim(scene, chief, len(pattern.weight), waves)
    u, v, aimed, stretch = aim.at(pattern)
    area = pattern.weight
    if scene.lens.aperture is not None:  # blades or a mask
        x, y = (-pattern.tangential, pattern.sagittal)[:: 1 if scene.axis == "x" else -1]
        area = torch.where(scene.lens.aperture.inside(x, y, 1.0), area, 0.0)
    area = torch.where(aimed, area.expand(aim.shape).reshape(-1) * stretch, 0.0)
    return _traced(scene, fields, chief, aim, (u, v), aimed, area)


class Filled:
    """Bundles that fill what stop and rims leave open for each field and wavelength, as finely as wanted.

    Their rays are nodes of a quadrature on the planes across the chief rays at the front of the lens.
    """

    def __init__(
        self, scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None,
        to_stop: bool = False,
    ) -> None:  # fmt: skip
        """Find the light; arguments as for `bundle`. With `to_stop` it is all light that enters the stop."""
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
        """Return the filled pupils of some of the fields, by the numbers of the fields."""
        some = copy(self)
        start, exists, height, film = self.chief
        rays = (Rays(*(c[fields] for c in r)) for r in (start, film))
        some.chief = ChiefRays(next(rays), exists[fields], height[fields], next(rays))
        some.fields = tuple(self.fields[k] for k in fields)
        some.part = LitPart(*(c.reshape(-1, len(self.waves))[fields].reshape(-1) for c in self.part))
        return some

    def bundle(self, level: int, path: bool = False) -> Bundle:
        """Trace the bundle of a level of `lit_nodes`; without `path`, optical paths are NaN, in half the time."""
        nodes = lit_nodes(self._passes, self.part, level)
        aim = self._aim(nodes.u.shape[1])
        u, v, area = (c.reshape(-1) for c in nodes)
        return _traced(self.scene, self.fields, self.chief, aim, (u, v), aim.exists, area * aim.spread(u, v), path)

    def energy(self, level: int) -> Tensor:
        """Return the energy [F] of all wavelengths, in the units of `Bundle.weight`."""
        nodes = lit_nodes(self._passes, self.part, level)
        u, v = (c.reshape(-1) for c in nodes[:2])
        weight = nodes.area * self._passes(*nodes[:2])
        return (weight.reshape(-1) * self._aim(nodes.u.shape[1]).spread(u, v)).reshape(len(self.fields), -1).sum(1)

    def box(self) -> tuple[Tensor, Tensor]:
        """Return the lowest and highest places u, v of light, [F * W, 2], to half a percent."""
        nodes = lit_nodes(self._passes, self.part, 0)
        places = torch.stack([nodes.u, nodes.v], 2)
        return places.amin(1), places.amax(1)

    def _aim(self, count: int) -> Aim:
        return Aim(self.scene, self.chief, count, self.waves)

    def _passes(self, u: Tensor, v: Tensor) -> Tensor:
        aim = self._aim(u.shape[1])
        out = plain_trace(self.lens, aim.rays(u.reshape(-1), v.reshape(-1)), aim.wavelength, towards="film")
        return ((out.status == 0) & aim.exists).reshape(u.shape)


def _chief(
    scene: Scene, field_deg: Sequence[float] | None, wavelength_nm: Sequence[float] | None
) -> tuple[tuple[float, ...], tuple[float, ...], ChiefRays]:
    """Return fields, wavelengths and chief rays of a bundle."""
    fields = scene.default_fields() if field_deg is None else tuple(float(f) for f in field_deg)
    waves = tuple(float(w) for w in wavelength_nm or scene.waves_nm)
    return fields, waves, scene.chief_rays(fields, waves[0])


def _traced(
    scene: Scene, fields: tuple[float, ...], chief: ChiefRays, aim: Aim, at: tuple[Tensor, Tensor], aimed: Tensor,
    area: Tensor, path: bool = True,
) -> Bundle:  # fmt: skip
    """Trace the rays at places (u, v) of an aim to the film."""
    start = aim.rays(*at)
    out = plain_trace(scene.traced, start, aim.wavelength, towards="film", path=path)
    film, status = on_plane(out.rays, scene.film_z_mm), torch.where(aimed, out.status, st.blocked(0, st.MISSED))
    length = optical_path(scene.traced, [start, *out.path, film], aim.wavelength) if path else math.nan

    def shaped(value: Tensor, blocked: float = math.nan) -> Tensor:
        return torch.where(status == 0, value, blocked).reshape(aim.shape)

    rays = Rays(*(shaped(c) for c in film))
    t, s = scene.image_axes(*(c - middle[:, None, None] for c, middle in zip(rays[:2], chief.film[:2], strict=True)))
    return Bundle(
        scene, fields, aim.waves, Rays(*(c.reshape(aim.shape) for c in start)), rays, t, s, status.reshape(aim.shape),
        shaped(area, blocked=0.0), area.reshape(aim.shape), shaped(aim.lead_mm(*at) + length), chief.height_mm,
    )  # fmt: skip


def check_light(scene: Scene, field_deg: Sequence[float] | None, wavelength_nm: float) -> list[str]:
    """Warn of each of the default fields (None) from which no ray reaches the film; returns the warnings.

    Raises:
        InputError: no ray of a requested field reaches the film, or the lens passes no ray at all.
    """
    fields = scene.default_fields() if field_deg is None else field_deg
    axis_lit, *lit = (Filled(scene, [0.0, *fields], [wavelength_nm]).part.reach > 0).tolist()
    if not (axis_lit or any(lit)):
        raise InputError(scene.lens.path, "surfaces", "(no ray reaches the film)", "a lens that passes light")
    dark = [field for field, light in zip(fields, lit, strict=True) if not light]
    if dark and field_deg is not None:
        edge = f"at most {scene.edge.field_deg:.4g} degrees, the edge of the image"
        raise InputError(scene.lens.path, f"field {dark[0]:g}", "(no light reaches the film)", edge)
    return [f"rims leave no light of the field of {field:.4g} degrees" for field in dark]
