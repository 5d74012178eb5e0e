"""The light over image height for any rims, and a fit of the rims to the light measured at several apertures.

The light of film points, for any rims and any stop, comes from one trace through the open lens. Rays through a grid of
the pupil plane are traced without rims, and how far from the axis they meet each surface is kept. A rim or the stop
then lets through the part of each grid cell in which that distance, taken as linear over a cell, is smaller than its
radius. So no ray is traced again for another aperture or another rim.

Rims are fitted as follows. On each side of the stop either all rims are scaled by one factor, or a ring of the mount is
put in front of the lens or behind it; a product has such rings, a patent does not state them. Nothing cuts the beam of
the axis at the lens's widest aperture, and no rim is wider than its neighbours allow. What is left then is the sensor's
own shading, or a pupil that differs from the product's.
"""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.report import Report, over
from neurolens.optics.lens.paraxial import stop_radius_mm
from neurolens.optics.lens.prescription import LINE_D_NM, Configuration, Lens, Surface
from neurolens.optics.photographs.profiles import Light, Profile
from neurolens.optics.setting.pupils import camera_rays, rear_opening_mm
from neurolens.optics.setting.rims import narrowed_rims
from neurolens.optics.setting.states import at_infinity, set_lens
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.rays import plain_trace

Array = NDArray[np.float64]

_COARSE, _FINE = 24, 32  # points a side of the grid that finds what is lit, and of the one that measures it
_WIDER = 1.5  # cells by which the lit part may reach beyond the lit points of a grid
_FLATTEST = 1e-3  # a slope over the steeper one: a smaller one makes no difference
_STOP_SLACK = 1.03  # an aperture of a profile counts as full where the lens's own is this near
_FACTORS = (0.4, 1.2)  # the least and the largest factor on rims that is tried
_FRONT = (0.15, 0.3, 0.5, 0.8, 1.2)  # places in front of the lens where rings are tried, over the length of the lens
_REAR = (0.2, 0.45, 0.7)  # places behind it, over the distance from the last vertex to the film
_RIMS = -1  # stands for scaled rims on a side; its other ways are numbers of rings
# values tried at a time, rounds over both sides, closer looks, factor between these
_TRIED, _ROUNDS, _LEVELS, _CLOSER = 9, 3, 2, 4.0
_PREFERENCE = 2e-3  # stops that a value twice as far from 1 must gain
_FIRST, _HEIGHTS = 0.2, 11  # of the heights to the film's corner: the first as a share of the last, and their number
_RING = 0.01  # stops by which a ring must be better than scaled rims
_CLOSED = 11.5  # f-number at and beyond which no rim is seen
_WIDE_MM = 1e5  # the radius of a ring that is not there
_DARK = -4.0  # stops, for no light


def at_focal_length(lens: Lens, focal_mm: float) -> Lens:
    """Return the lens at infinity focus, a zoom at a profile's focal length or at the end of its range next to that."""
    states = [c.efl_mm for c in lens.configurations if c.efl_mm and c.object_distance_mm is None]
    if len(states) > 1 and max(states) > 1.05 * min(states):
        low, high = min(states), max(states)
        return set_lens(lens, zoom=float(min(max(focal_mm, low), high)))
    return set_lens(lens)


def stop_for(lens: Lens, f_number: float) -> float:
    """Return the radius (mm) of the stop at an f-number of a profile; at the widest it is that of the file."""
    if f_number <= _STOP_SLACK * lens.f_number:
        return lens.stop_radius_mm
    return float(stop_radius_mm(at_infinity(lens), f_number))


def near_f8(f_numbers: Iterable[float]) -> float:
    """Return the aperture nearest to f/8, at which hardly any rim of a lens is seen."""
    return min(f_numbers, key=lambda f: abs(math.log(f / 8)))


@dataclass(frozen=True)
class OpenLight:
    """The rays from film points through the open lens: their heights on every surface, and the light they bring.

    Attributes:
        radius_mm: [S, F, G, G] distance from the axis on each surface, inf where the ray does not get there.
        slopes_mm: [2, S, F, G, G] by how much that changes along the sides of a grid cell, above 0.
        light: [F, G, G] irradiance by a whole cell of radiance 1: cos^4 of its angle, times the solid angle in which
            the axis sees it.
    """

    radius_mm: Array
    slopes_mm: Array
    light: Array

    def at(self, rims_mm: Array) -> Array:
        """Return the light [F] of the film points with rims of these radii [S], the stop's among them."""
        inside = np.min([self.inside(k, radius) for k, radius in enumerate(rims_mm)], axis=0)
        return np.asarray((inside * self.light).sum(axis=(1, 2)))

    def inside(self, surface: int, rim_mm: float) -> Array:
        """Return the part of every cell [F, G, G] that a rim of this radius lets through: where the margin is positive.

        The margin is linear in a cell. The part is the convolution of two boxes as wide as the slopes, integrated up to
        the margin in the middle.
        """
        a, b = self.slopes_mm[:, surface]
        margin = np.nan_to_num(rim_mm - self.radius_mm[surface], neginf=-np.inf)
        margin = np.clip(margin, -0.5 * (a + b), 0.5 * (a + b))
        corners = (np.maximum(margin + x * a + y * b, 0) ** 2 * (4 * x * y) for x in (-0.5, 0.5) for y in (-0.5, 0.5))
        return np.asarray(np.clip(sum(corners) / (2 * a * b), 0, 1))


def with_rims(lens: Lens, rims_mm: Array) -> Lens:
    """Return the lens with rims and stop of these radii [S]."""
    rows = zip(lens.surfaces, rims_mm, strict=True)
    return replace(lens, surfaces=tuple(replace(s, diameter_mm=2 * float(radius)) for s, radius in rows))


def open_light(lens: Lens, height_mm: Array, rims_mm: Array, rear: tuple[float, float] | None = None) -> OpenLight:
    """Trace the rays of film points at heights [F] of a lens whose film is placed.

    Args:
        rims_mm: [S] the widest radii of rims and stop for which light will be computed.
        rear: radius and z of the disc through which all light comes to the film; None takes the last of these rims.
    """
    bare = without_rims(replace(lens, aperture=None))
    film = float(lens.film_z_mm if lens.film_z_mm is not None else lens.vertices_mm[-1])
    reach, plane = rear or rear_opening_mm(with_rims(lens, rims_mm), film)
    box = np.broadcast_to(np.array([-reach, reach])[:, None, None], (2, 2, len(height_mm)))
    for side in (_COARSE, _COARSE, _FINE):
        u, v, cell = _grid(box, side)
        found = _traced(bare, film, plane, height_mm, u, v)
        if side == _FINE:
            return _measured(*found, cell / (film - plane))
        box = _around(np.all(found[0] <= rims_mm[:, None, None, None], axis=0), u, v, box)
    raise AssertionError


def _grid(box: Array, side: int) -> tuple[Array, Array, Array]:
    """Return middles u, v [F, G, G] of the cells of grids over boxes (only upper halves in v), and the cells' sizes."""
    step = (np.arange(side) + 0.5) / side
    size = (box[1] - box[0]) / side
    u = box[0, 0][:, None] + step * (box[1] - box[0])[0][:, None]
    v = step * box[1, 1][:, None]  # the lower half is its mirror image
    shape = (len(u), side, side)
    return (
        np.broadcast_to(u[:, :, None], shape),
        np.broadcast_to(v[:, None, :], shape),
        np.stack([size[0], size[1] / 2]),
    )


def _traced(lens: Lens, film: float, plane: float, height_mm: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Return distances from the axis [S, F, G, G] at the surfaces, and cos^4 of the rays."""
    shape = u.shape
    x = np.broadcast_to(height_mm[:, None, None], shape)
    flat = [torch.from_numpy(np.ascontiguousarray(a).reshape(-1)) for a in (x, np.zeros(shape), u, v)]
    rays = camera_rays(flat[0], flat[1], film, flat[2], flat[3], plane)
    out = plain_trace(lens, rays, LINE_D_NM, record=range(len(lens.surfaces)))
    radius = np.empty((len(lens.surfaces), *shape))
    dead = torch.zeros(rays.x.shape, dtype=torch.bool)
    for k in range(len(lens.surfaces))[::-1]:
        c = out.crossings[k]
        dead |= ~(c.meets > 0)
        radius[k] = torch.where(dead, torch.inf, torch.hypot(c.x, c.y)).numpy().reshape(shape)
        dead |= ~(c.refracts > 0)
    radius[0] = np.where((out.status.numpy() == 0).reshape(shape), radius[0], np.inf)
    return radius, (rays.dz.numpy() ** 4).reshape(shape)


def _around(lit: Any, u: Array, v: Array, box: Array) -> Array:
    """Return boxes about the lit points, wider by what may lie between points; unchanged where nothing is lit."""
    step = _WIDER * (box[1] - box[0]) / lit.shape[1]
    low_u = np.where(lit, u, np.inf).min(axis=(1, 2)) - step[0]
    high_u = np.where(lit, u, -np.inf).max(axis=(1, 2)) + step[0]
    high_v = np.where(lit, v, -np.inf).max(axis=(1, 2)) + step[1] / 2
    found = lit.any(axis=(1, 2))
    low = np.where(found, np.stack([low_u, -high_v]), box[0])
    return np.stack([low, np.where(found, np.stack([high_u, high_v]), box[1])])


def _slopes(radius: Array, axis: int) -> Array:
    """Return how much distances change from cell to cell; next to lost rays, the change on the other side."""
    with np.errstate(invalid="ignore"):
        step = np.abs(np.diff(radius, axis=axis, prepend=np.inf, append=np.inf))
    step = np.where(np.isfinite(step), step, np.inf)
    before, after = (np.take(step, range(k, k + radius.shape[axis]), axis=axis) for k in (0, 1))
    mean = 0.5 * (before + after)
    return np.where(np.isfinite(mean), mean, np.minimum(before, after))


def _measured(radius: Array, cos4: Array, cell: Array) -> OpenLight:
    """Return the light of a fine grid's cells, with how distances from the axis change across each cell."""
    slopes = np.stack([_slopes(radius, axis) for axis in (-2, -1)])
    slopes = np.where(np.isfinite(slopes), slopes, 1.0)
    least = np.maximum(_FLATTEST * slopes.max(axis=0), 1e-9)
    return OpenLight(radius, np.maximum(slopes, least), 2 * cos4 * cell.prod(axis=0)[:, None, None])


class Ring(NamedTuple):
    """An opening of the mount, which is a plane in air.

    Attributes:
        before: the surface of the table in front of which it lies; the number of surfaces for a ring behind the last.
        distance_mm: from the vertex of that surface; for a ring behind the last, from that one.
        radius_mm: of the opening.
    """

    before: int
    distance_mm: float
    radius_mm: float


@dataclass(frozen=True)
class FittedRims(Report):
    """Rims that were fitted to photographs.

    Attributes:
        front, rear: factors on the rims in front of the stop and behind it.
        rings: of the mount, at most one on each side.
        rims_mm: [S] radii.
        before_stops, after_stops: residual of the light by f-number, before and after the fit; root mean square over
            heights.
        unused: f-numbers that the fit did not use.
    """

    front: float
    rear: float
    rings: tuple[Ring, ...]
    rims_mm: Array
    before_stops: dict[float, float] = field(metadata=over("f_number"))
    after_stops: dict[float, float] = field(metadata=over("f_number"))
    unused: tuple[float, ...]

    @property
    def closed(self) -> float:
        """The aperture nearest to f/8, at which hardly any rim is seen."""
        return near_f8(self.after_stops)


class RimLight:
    """The light of a lens by aperture, with other rims and with rings of the mount."""

    def __init__(self, lens: Lens, profile: Profile, lights: Sequence[Light]) -> None:
        """`lens` is at infinity focus, with its stop open."""
        self.rims, self.count = np.array(lens.semi_diameters_mm), len(lens.surfaces)
        self.rings, ringed = _with_rings(lens)
        self._sides: dict[tuple[bool, float], Array] = {}
        rows = [k for k, s in enumerate(ringed.surfaces) if s.diameter_mm < _WIDE_MM]
        self.place = np.array(rows)  # places of the table's surfaces among those with the rings
        self.stop, self.stop_place = lens.stop_index, rows[lens.stop_index]
        widest = np.full(len(ringed.surfaces), _WIDE_MM)
        widest[self.place] = _FACTORS[1] * self.rims
        widest[self.stop_place] = self.rims[self.stop]
        height = min(profile.half_diagonal_mm, lens.image_radius_mm or math.inf) * np.linspace(_FIRST, 1, _HEIGHTS)
        self.f_numbers = [row.f_number for row in lights]
        self.measured = np.stack([profile.stops(row, height) for row in lights])
        reach, plane = rear_opening_mm(with_rims(lens, widest[self.place]), float(lens.film_z_mm or 0.0))
        rear = reach, plane + float(ringed.film_z_mm or 0.0) - float(lens.film_z_mm or 0.0)
        self.opened = open_light(ringed, np.concatenate([[0.0], height]), widest, rear)
        radii = [stop_for(lens, f_number) for f_number in self.f_numbers]
        self.stops = [self.opened.inside(self.stop_place, radius) for radius in radii]
        # The beam of the axis is what the table's own rims let through: beyond them rays may fold back into the stop.
        tabled = np.full(len(widest), math.inf)
        tabled[self.place] = self.rims
        axis = self.opened.radius_mm[:, 0]
        beam = np.all(axis <= tabled[:, None, None], axis=0) & np.isfinite(axis).all(axis=0)
        self.beam_mm = np.where(beam, axis, 0.0).max(axis=(1, 2))
        lit = np.min([self.opened.inside(k, r) for k, r in enumerate(widest)], axis=0) > 0
        self.lit_mm = np.where(lit, np.where(np.isfinite(self.opened.radius_mm), self.opened.radius_mm, 0), 0).max(
            axis=(1, 2, 3)
        )
        limit = np.array(narrowed_rims(with_rims(lens, widest[self.place])).semi_diameters_mm)
        self.limit_mm = np.maximum(np.maximum(limit, self.beam_mm[self.place]), self.rims)

    def scaled(self, front: float, rear: float) -> Array:
        """Return the radii of the rims for factors on both sides of the stop."""
        factor = np.where(np.arange(self.count) < self.stop, front, rear)
        radii = np.clip(factor * self.rims, self.beam_mm[self.place], self.limit_mm)
        radii[self.stop] = self.rims[self.stop]
        return radii

    def ring(self, number: int, value: float) -> Ring:
        """Return a ring between the beam of the axis (value 0) and what is lit (value 1)."""
        place, ring = self.rings[number]
        low, high = self.beam_mm[place], self.lit_mm[place]
        radius_mm = float(low + value * (high - low))
        # rounded up, so that it is never smaller than the beam
        return ring._replace(radius_mm=math.ceil(1e4 * radius_mm) / 1e4)

    def side(self, front: bool, way: int, value: float) -> Array:
        """Return what the rims on one side of the stop let through, [F, G, G] as shares of cells.

        Args:
            way: whether the rims are scaled, or which ring is added.
            value: the factor on the rims, or the place of the ring between its limits (see `ring`).
        """
        if way != _RIMS:
            ring = self.opened.inside(self.rings[way][0], self.ring(way, value).radius_mm)
            return np.minimum(self.side(front, _RIMS, 1.0), ring)
        if (front, value) not in self._sides:
            radii = self.scaled(value, value)
            surfaces = range(self.stop) if front else range(self.stop + 1, self.count)
            parts = [self.opened.inside(self.place[k], radii[k]) for k in surfaces]
            self._sides[front, value] = np.min(parts or [np.ones(self.opened.light.shape)], axis=0)
        return self._sides[front, value]

    def residuals(self, front: Array, rear: Array) -> Array:
        """Residuals [A] by aperture: computed less measured light, RMS over heights, for what both sides let pass."""
        both = np.minimum(front, rear)
        light = np.stack([(np.minimum(both, stop) * self.opened.light).sum(axis=(1, 2)) for stop in self.stops])
        with np.errstate(divide="ignore", invalid="ignore"):
            stops = np.log2(light[:, 1:] / light[:, :1])
        return np.asarray(np.sqrt(np.nanmean((np.where(stops > _DARK, stops, _DARK) - self.measured) ** 2, axis=1)))

    def fit(self, used: Sequence[int]) -> list[tuple[int, float]]:
        """Return the way and the value that fit best, of the front and of the rear.

        The sides are fitted in turn; later turns look more closely about the values found.

        Args:
            used: the apertures that count.
        """
        chosen = [(_RIMS, 1.0), (_RIMS, 1.0)]
        ways = [[k for k, (_, ring) in enumerate(self.rings) if (ring.before == 0) == front] for front in (True, False)]
        sides = [self.side(True, *chosen[0]), self.side(False, *chosen[1])]
        for turn in range(2 * (_ROUNDS + _LEVELS)):
            side, closer = turn % 2, max(turn // 2 - _ROUNDS + 1, 0)
            best = (math.inf, *chosen[side])
            for way in [_RIMS, *ways[side]] if not closer else [chosen[side][0]]:
                low, high = _FACTORS if way == _RIMS else (0.0, 1.0)
                if closer:
                    reach = (high - low) / (_TRIED - 1) / _CLOSER ** (closer - 1)
                    low, high = max(low, chosen[side][1] - reach), min(high, chosen[side][1] + reach)
                for value in np.linspace(low, high, _TRIED):
                    open_ = self.side(side == 0, way, value)
                    each = self.residuals(open_, sides[1]) if side == 0 else self.residuals(sides[0], open_)
                    error = float(np.sqrt(np.mean(each[used] ** 2))) + _PREFERENCE * abs(value - 1)
                    best = min(best, (error + _RING * (way != _RIMS), way, float(value)))
            chosen[side] = best[1:]
            sides[side] = self.side(side == 0, *chosen[side])
        return chosen


def with_ring(lens: Lens, ring: Ring) -> Lens:
    """Return the lens with a ring as a plane surface in air; states of a zoom follow."""
    at, gap = ring.before, ring.distance_mm
    row = Surface(math.inf, gap, 2 * ring.radius_mm)
    surfaces = list(lens.surfaces)
    if at:
        before = surfaces[at - 1]
        row = replace(row, thickness_mm=round(before.thickness_mm - gap, 9))
        surfaces[at - 1] = replace(before, thickness_mm=gap)
    surfaces.insert(at, row)

    def moved(gaps: tuple[tuple[int, Any], ...]) -> tuple[tuple[int, Any], ...]:
        return tuple((k + 1, t - gap) if k == at - 1 else (k + (k >= at), t) for k, t in gaps)

    def of_state(c: Configuration) -> Configuration:
        nearer = None if c.object_distance_mm is None else c.object_distance_mm - (0 if at else gap)
        return replace(c, thickness_mm=moved(c.thickness_mm), object_distance_mm=nearer)

    states = tuple(map(of_state, lens.configurations))
    film = lens.film_z_mm if at or lens.film_z_mm is None else lens.film_z_mm + gap
    infinity = moved(lens.infinity_mm)
    return replace(lens, surfaces=tuple(surfaces), configurations=states, film_z_mm=film, infinity_mm=infinity)


def _with_rings(lens: Lens) -> tuple[list[tuple[int, Ring]], Lens]:
    """Return the rings to try, each with its place among the surfaces of a lens that has them all, and that lens."""
    z = [float(v) for v in lens.vertices_mm]
    _, rear_z = rear_opening_mm(lens, float(lens.film_z_mm or z[-1]))
    last = min(range(len(lens.surfaces)), key=lambda k: abs(z[k] - rear_z))
    front = [round(share * z[-2], 2) for share in _FRONT]
    gap = float(lens.surfaces[last].thickness_mm)
    rear = [round(share * gap, 2) for share in _REAR] if lens.surfaces[last].n_d == 1 else []
    ringed, near = lens, 0.0
    for distance in rear[::-1]:
        ringed = with_ring(ringed, Ring(last + 1, distance, _WIDE_MM))
    for distance in front:
        ringed, near = with_ring(ringed, Ring(0, distance - near, _WIDE_MM)), distance
    count = len(front)
    rings = [(count - 1 - k, Ring(0, distance, _WIDE_MM)) for k, distance in enumerate(front)]
    rings += [(count + last + 1 + k, Ring(last + 1, distance, _WIDE_MM)) for k, distance in enumerate(rear)]
    return rings, ringed


def fit_rims(lens: Lens, profile: Profile, unused: Collection[float] = ()) -> FittedRims:
    """Fit the rims of a lens to the light of a profile, except at `unused` f-numbers; a zoom at its shortest end.

    Raises:
        InputError: the profile has no light at apertures of this lens.
    """
    focal_mm = min((row.focal_mm for row in profile.light), default=math.nan)
    lights = [row for row in profile.light_at(focal_mm) if row.f_number <= _CLOSED]
    if not [row for row in lights if row.f_number not in unused]:
        raise InputError(lens.path, "profile", profile.model, "one with light up to f/11, at apertures that are used")
    light = RimLight(at_focal_length(lens, focal_mm), profile, lights)
    before = light.residuals(light.side(True, _RIMS, 1.0), light.side(False, _RIMS, 1.0))
    chosen = light.fit([k for k, f_number in enumerate(light.f_numbers) if f_number not in unused])
    after = light.residuals(light.side(True, *chosen[0]), light.side(False, *chosen[1]))
    factors = [value if way == _RIMS else 1.0 for way, value in chosen]
    rings = tuple(light.ring(way, value) for way, value in chosen if way != _RIMS and value < 1)
    residuals = [dict(zip(light.f_numbers, map(float, values), strict=True)) for values in (before, after)]
    radii = light.scaled(factors[0], factors[1])
    return FittedRims(factors[0], factors[1], rings, radii, residuals[0], residuals[1], tuple(sorted(unused)))


def with_fitted_rims(lens: Lens, found: FittedRims) -> Lens:
    """Return the lens of a file with fitted rims and rings; touching neighbours trim rims, and the stop stays."""
    pairs = zip(lens.surfaces, found.rims_mm, strict=True)
    radii = [s.semi_diameter_mm if s.stop else round(float(radius), 4) for s, radius in pairs]
    lens = replace(narrowed_rims(with_rims(lens, np.array(radii))), rims="photographs")
    for ring in sorted(found.rings, key=lambda ring: -ring.before):
        lens = with_ring(lens, ring)
    return lens
