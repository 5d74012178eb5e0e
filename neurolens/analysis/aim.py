"""Aiming: which rays of a field meet given points of the real stop.

The chief ray is found from the stop outwards (`optics.aiming`), so that pupils which wander (fisheyes) do no harm.
Its neighbours start on the plane across the chief ray at the front of the lens, and Newton's method on that plane takes
each to its point of the stop; rays for which this fails at once walk there from the chief ray in small steps. The
derivative of the mapping is also what turns stop area into the energy that a ray carries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neurolens.analysis.fields import ChiefRays, Scene
from neurolens.analysis.patterns import Pattern
from neurolens.optics.aiming import without_rims
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

_DIRECT, _STRIDES, _PER_STRIDE = 5, 8, 3  # Newton steps; strides of the careful walk
_AIMED = 1e-8  # how near to its point, in stop radii, a ray must come
_DIFFERENCE = 3e-6  # step of the derivative, in stop radii


class Aim:
    """The mapping from the plane across the chief rays at the front to the stop, for F * W * P rays at once."""

    def __init__(self, scene: Scene, chief: ChiefRays, shape: tuple[int, int, int], waves: tuple[float, ...]) -> None:
        lens = scene.lens
        self.front = without_rims(replace(lens, surfaces=lens.surfaces[: lens.stop_index + 1]))
        self.stop_mm = lens.stop_radius_mm
        self.step_mm = _DIFFERENCE * lens.stop_radius_mm
        self.along_x = scene.axis == "x"
        self.shape = shape

        def spread(values: Tensor) -> Tensor:
            return values[:, None, None].expand(shape).reshape(-1)

        self.chief = Rays(*(spread(c) for c in chief.start))
        origin = scene.object_points(chief.start)
        self.origin = None if origin is None else tuple(spread(c) for c in origin)
        self.exists = spread(chief.exists)
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
        beam = math.pi / (tu * sv - tv * su).abs()
        if self.origin is not None:
            # Solid angle of an area on the plane across the chief ray: cos / r^2, with cos = distance / r.
            distance2 = _distance2(self.chief[:3], self.origin)[rows]
            beam = beam * torch.sqrt(distance2) / (distance2 + u * u + v * v) ** 1.5
        return error, beam

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
