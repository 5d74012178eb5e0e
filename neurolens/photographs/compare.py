"""A lens table held against a measured profile: distortion, lateral colour and light over image height.

What a profile leaves free is taken out: the scale of the picture (the central one, too: fits to photographs are loose
there), and the light on the axis. The distance of the photographs is not stated either: rays come from infinity.

The light of film points, for any rims and any stop, comes from one trace through the open lens. Rays through a grid of
the pupil plane are traced without rims; what is kept is how far from the axis they meet each surface. A rim or the stop
then lets through the part of every grid cell in which that distance is smaller than its radius, as if it were linear
over a cell: no ray is traced again for another aperture or another rim.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.analysis.fields import Result
from neurolens.lens.film_plane import LINE_D_NM
from neurolens.lens.paraxial import stop_radius_mm
from neurolens.lens.prescription import Lens
from neurolens.photographs.figures import between, chief_angles, heights_of, ideal_heights, shapes
from neurolens.photographs.profiles import Light, Profile, Radial
from neurolens.setting.pupils import camera_rays, rear_opening_mm
from neurolens.setting.states import at_infinity, set_lens
from neurolens.trace.aiming import without_rims
from neurolens.trace.rays import trace

_COARSE, _FINE = 24, 32  # points a side of the grids that find what is lit, and that measure it
_WIDER = 1.5  # cells by which what is lit may reach beyond the lit points of a grid
_FLATTEST = 1e-3  # a slope over the steeper one, below which it makes no difference


@dataclass(frozen=True)
class OpenLight:
    """What the rays of film points meet.

    Attributes:
        radius_mm: [S, F, G, G] distance from the axis on each surface, inf where the ray does not get there.
        slopes_mm: [2, S, F, G, G] by how much it changes along the sides of a grid cell, above 0.
        light: [F, G, G] irradiance by a whole cell of radiance 1: cos^4 of its angle times the solid angle in
            which the axis sees it.
    """

    radius_mm: Array
    slopes_mm: Array
    light: Array

    def at(self, rims_mm: Array) -> Array:
        """The light [F] of the film points with rims of these radii [S], the stop's among them."""
        inside = np.min([self.inside(k, radius) for k, radius in enumerate(rims_mm)], axis=0)
        return np.asarray((inside * self.light).sum(axis=(1, 2)))

    def inside(self, surface: int, rim_mm: float) -> Array:
        """The part of every cell [F, G, G] that a rim of this radius lets through."""
        return _covered(rim_mm - self.radius_mm[surface], *self.slopes_mm[:, surface])


def _covered(margin: Array, a: Array, b: Array) -> Array:
    """The part of a unit cell in which a linear function is positive, by its value in the middle and both slopes.

    It is the convolution of two boxes as wide as the slopes, integrated up to the value.
    """
    margin = np.clip(np.nan_to_num(margin, neginf=-np.inf), -0.5 * (a + b), 0.5 * (a + b))
    corners = (np.maximum(margin + x * a + y * b, 0) ** 2 * (4 * x * y) for x in (-0.5, 0.5) for y in (-0.5, 0.5))
    return np.asarray(np.clip(sum(corners) / (2 * a * b), 0, 1))


def with_rims(lens: Lens, rims_mm: Array) -> Lens:
    """The lens with rims and stop of these radii [S]."""
    rows = zip(lens.surfaces, rims_mm, strict=True)
    return replace(lens, surfaces=tuple(replace(s, diameter_mm=2 * float(radius)) for s, radius in rows))


def open_light(lens: Lens, height_mm: Array, rims_mm: Array, rear: tuple[float, float] | None = None) -> OpenLight:
    """Trace the rays of film points at heights [F] of a lens whose film is placed.

    Args:
        rims_mm: [S] the widest radii of rims and stop for which light will be computed.
        rear: radius and z of the disc through which all light comes to the film; None: the last of these rims.
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
    """Middles u, v [F, G, G] of the cells of grids over boxes, of which v is the upper half, and the cells' sizes."""
    step = (np.arange(side) + 0.5) / side
    size = (box[1] - box[0]) / side
    u = box[0, 0][:, None] + step * (box[1] - box[0])[0][:, None]
    v = step * box[1, 1][:, None]  # the lens is its own mirror image
    shape = (len(u), side, side)
    return (
        np.broadcast_to(u[:, :, None], shape),
        np.broadcast_to(v[:, None, :], shape),
        np.stack([size[0], size[1] / 2]),
    )


def _traced(lens: Lens, film: float, plane: float, height_mm: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Distances from the axis [S, F, G, G] at the surfaces, and cos^4 of the rays."""
    shape = u.shape
    x = np.broadcast_to(height_mm[:, None, None], shape)
    flat = [torch.from_numpy(np.ascontiguousarray(a).reshape(-1)) for a in (x, np.zeros(shape), u, v)]
    rays = camera_rays(flat[0], flat[1], film, flat[2], flat[3], plane)
    with torch.no_grad():
        out = trace(lens, rays, LINE_D_NM, record=range(len(lens.surfaces)))
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
    """Boxes about what is lit, wider by what may lie between the points; as they were where nothing is."""
    step = _WIDER * (box[1] - box[0]) / lit.shape[1]
    low_u = np.where(lit, u, np.inf).min(axis=(1, 2)) - step[0]
    high_u = np.where(lit, u, -np.inf).max(axis=(1, 2)) + step[0]
    high_v = np.where(lit, v, -np.inf).max(axis=(1, 2)) + step[1] / 2
    found = lit.any(axis=(1, 2))
    low = np.where(found, np.stack([low_u, -high_v]), box[0])
    return np.stack([low, np.where(found, np.stack([high_u, high_v]), box[1])])


def _slopes(radius: Array, axis: int) -> Array:
    """How much distances change from cell to cell; beside rays that get lost, on the side of the others."""
    with np.errstate(invalid="ignore"):
        step = np.abs(np.diff(radius, axis=axis, prepend=np.inf, append=np.inf))
    step = np.where(np.isfinite(step), step, np.inf)
    before, after = (np.take(step, range(k, k + radius.shape[axis]), axis=axis) for k in (0, 1))
    mean = 0.5 * (before + after)
    return np.where(np.isfinite(mean), mean, np.minimum(before, after))


def _measured(radius: Array, cos4: Array, cell: Array) -> OpenLight:
    """What is kept of the fine grid."""
    slopes = np.stack([_slopes(radius, axis) for axis in (-2, -1)])
    slopes = np.where(np.isfinite(slopes), slopes, 1.0)
    least = np.maximum(_FLATTEST * slopes.max(axis=0), 1e-9)
    return OpenLight(radius, np.maximum(slopes, least), 2 * cos4 * cell.prod(axis=0)[:, None, None])


Array = NDArray[np.float64]

# Broad bands of a camera: those at which rays agree best with lensfun's lateral colour.
_BANDS_NM = {"red": (585.0, 600.0, 615.0), "green": (520.0, 540.0, 560.0), "blue": (465.0, 480.0, 495.0)}
_STOP_SLACK = 1.03  # an aperture named in a profile counts as full where the lens's own is that near


@dataclass(frozen=True)
class Curve(Result):
    """One measured and one computed figure over image height; what the profile leaves free is taken out.

    Attributes:
        height_mm, measured, computed: [H], NaN beyond what either knows.
    """

    height_mm: Array
    measured: Array
    computed: Array

    @property
    def rms(self) -> float:
        """Root mean square of the difference; NaN where there is none."""
        off = self.measured - self.computed
        off = off[np.isfinite(off)]
        return float(np.sqrt(np.mean(off**2))) if len(off) else math.nan


@dataclass(frozen=True)
class Comparison(Result):
    """A lens, in one focal length, against one profile.

    Attributes:
        focal_mm: of the profile.
        distortion_percent: of the image height, mean removed. size: of the picture, for which it agrees best.
        red_um, blue_um: beside green.
        light_stops: by f-number, beside the axis.
    """

    focal_mm: float
    distortion_percent: Curve | None
    red_um: Curve | None
    blue_um: Curve | None
    light_stops: dict[float, Curve]
    size: float = 1.0


def at_focal_length(lens: Lens, focal_mm: float) -> Lens:
    """The lens focused at infinity, a zoom at the focal length of a profile; its ends are rounded in names."""
    states = [c.efl_mm for c in lens.configurations if c.efl_mm and c.object_distance_mm is None]
    if len(states) > 1 and max(states) > 1.05 * min(states):
        low, high = min(states), max(states)
        return set_lens(lens, zoom=float(min(max(focal_mm, low), high)))
    return set_lens(lens)


def distortion_curve(lens: Lens, profile: Profile, radial: Radial) -> tuple[Curve, float]:
    """The shape of the distortion, measured and computed, and the size of the picture for which both agree best."""
    height = heights_of(profile, lens)
    angle, (real,) = chief_angles(lens, float(height.max()), [lens.reference_nm])
    theirs, ours, size = shapes(height, profile.stretch(radial, height), real, real / ideal_heights(profile, angle))
    return Curve(height, theirs, ours), size


def colour_curves(lens: Lens, profile: Profile, radials: Mapping[str, Radial | None]) -> dict[str, Curve | None]:
    """How much farther from the axis red and blue lie than green, in um, over broad bands as a camera's."""
    height = heights_of(profile, lens)
    _, real = chief_angles(lens, float(height.max()), [nm for band in _BANDS_NM.values() for nm in band])
    red, green, blue = (np.mean(part, axis=0) for part in np.split(np.array(real), len(_BANDS_NM)))
    found: dict[str, Curve | None] = {}
    for band, ours in (("red", red - green), ("blue", blue - green)):
        radial = radials[band]
        found[band] = radial and Curve(height, profile.shift_um(radial, height), between(height, green, 1000 * ours))
    return found


def stop_for(lens: Lens, f_number: float) -> float:
    """The radius of the stop at an f-number of a profile; that of the file where it is the lens's widest."""
    if f_number <= _STOP_SLACK * lens.f_number:
        return lens.stop_radius_mm
    return float(stop_radius_mm(at_infinity(lens), f_number))


def near_f8(f_numbers: Iterable[float]) -> float:
    """The aperture nearest to f/8, at which hardly any rim of a lens is seen."""
    return min(f_numbers, key=lambda f: abs(math.log(f / 8)))


def light_curves(lens: Lens, profile: Profile, lights: Sequence[Light]) -> dict[float, Curve]:
    """The light over image height by f-number, in stops beside the axis."""
    height, stop = heights_of(profile, lens), lens.stop_index
    rims = np.array(lens.semi_diameters_mm)
    opened = open_light(lens, np.concatenate([[0.0], height]), rims)
    past_rims = np.min([opened.inside(k, radius) for k, radius in enumerate(rims) if k != stop], axis=0)
    curves = {}
    for row in lights:
        inside = np.minimum(past_rims, opened.inside(stop, stop_for(lens, row.f_number)))
        with np.errstate(divide="ignore", invalid="ignore"):
            sums = (inside * opened.light).sum(axis=(1, 2))
            ours = np.log2(sums[1:] / sums[0])
        ours[~np.isfinite(ours)] = math.nan
        curves[row.f_number] = Curve(height, profile.stops(row, height), ours)
    return curves


def compare(lens: Lens, profile: Profile, focal_mm: float) -> Comparison:
    """Compare a lens with a profile at one of the profile's focal lengths."""
    placed = at_focal_length(lens, focal_mm)

    def row(rows: Sequence[Radial]) -> Radial | None:
        return next((r for r in rows if r.focal_mm == focal_mm), None)

    radial, red, blue = row(profile.distortion), row(profile.red), row(profile.blue)
    distortion, size = (None, 1.0) if radial is None else distortion_curve(placed, profile, radial)
    colours = colour_curves(placed, profile, {"red": red, "blue": blue}) if red or blue else {}
    light = light_curves(placed, profile, lights) if (lights := profile.light_at(focal_mm)) else {}
    return Comparison(focal_mm, distortion, colours.get("red"), colours.get("blue"), light, size)
