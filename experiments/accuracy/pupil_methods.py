"""Pupils of the literature, to sample per lens from its film: shapes on a plane by film radius, `RadialPupil`.

They differ in how they are found, how many of their rays pass, and how much light they lose. The outlines that the
cameras use are in `neurolens.cameras.pupil_outline`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.trace.rays import trace

Array = NDArray[np.float64]
# Of the hull film points and points across; of Wu's search film points, rays of a fan, planes; pixels along the film's
# radius and probe rays of each; intervals of the radius and samples of each.
_HULL, _WU, _PIXELS, _RADIAL = (32, 96), (24, 801, 241), (256, 128), (50, 2000)
_HALVINGS = 20  # of the step to the last ray that passes
# Whether rays pass from film points (radius [N], 0) through points [2, N] of a plane, at the d line: bool [N].
Passes = Callable[[Array, Array], NDArray[np.bool_]]


@dataclass(frozen=True)
class RadialPupil:
    """Boxes or ellipses on a plane, one for each interval of the film radius.

    Attributes:
        pupil_z_mm: the plane, lens frame.
        film_radius_mm: outer end of the last of R equal intervals.
        centre, along, across: [R] mm, for a film point on +x: centre on the x axis, half widths; negative where no ray
            was found.
        shape: "box" or "ellipse".
    """

    pupil_z_mm: float
    film_radius_mm: float
    centre: Array
    along: Array
    across: Array
    shape: Literal["box", "ellipse"]

    def sample(self, film_mm: Array, square: Array, wavelength_nm: object = None) -> tuple[Array, Array]:
        """Uniform points in the shapes of film points [2, N] for numbers [2, N] in [0, 1).

        Returns points [2, N] in mm and the areas [N] of their shapes in mm^2, 0 where nothing is known to pass.
        """
        radius = np.hypot(*film_mm)
        count = self.centre.size
        row = np.minimum(radius * (count / self.film_radius_mm), count - 1).astype(np.intp)
        along, across = np.maximum(self.along[row], 0), np.maximum(self.across[row], 0)
        if self.shape == "box":
            u, v = 2 * square - 1
            area = 4 * along * across
        else:
            r, angle = np.sqrt(square[0]), 2 * math.pi * square[1]
            u, v = r * np.cos(angle), r * np.sin(angle)
            area = math.pi * along * across
        x, y = self.centre[row] + along * u, across * v
        azimuth = np.arctan2(film_mm[1], film_mm[0])
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        lit = radius <= self.film_radius_mm
        return np.stack([x * cos - y * sin, x * sin + y * cos]), area * lit


def passes_through(lens: Lens, pupil_z_mm: float) -> Passes:
    """Whether rays from the film of a focused lens through points of a plane pass the lens, at `Lens.reference_nm`."""
    film_z = _film_z_mm(lens)

    def passes(radius: Array, points: Array) -> NDArray[np.bool_]:
        x, u, v = (torch.from_numpy(np.ascontiguousarray(a)) for a in (radius, *points))
        rays = camera_rays(x, torch.zeros_like(x), film_z, u, v, pupil_z_mm)
        with torch.no_grad():
            return trace(lens, rays).status.numpy() == 0

    return passes


def _film_z_mm(lens: Lens) -> float:
    if lens.film_z_mm is None:
        raise InputError(lens.path, "film_z_mm", None, "a focused lens: set_lens(lens, focus_m=...)")
    return float(lens.film_z_mm)


def rear_rim(lens: Lens, film_radius_mm: float) -> RadialPupil:
    """The disc of the rear rim on the plane of its vertex: what Steinert (2009) calls the global pupil."""
    rear = len(lens.surfaces) - 1
    return _disc(float(lens.vertices_mm[rear]), film_radius_mm, lens.surfaces[rear].semi_diameter_mm)


def hull_disc(lens: Lens, film_radius_mm: float) -> RadialPupil:
    """The axial disc on the pupil plane that holds the passing rays of the whole film."""
    plane, (rows, points) = pupil_plane_z_mm(lens), _HULL
    start = _reach_on(lens, plane, film_radius_mm)
    grid = np.linspace(-start, start, points)
    film, u, v = (
        a.ravel() for a in np.meshgrid(np.linspace(0, film_radius_mm, rows), grid, grid[grid >= 0], indexing="ij")
    )
    passed = passes_through(lens, plane)(film, np.stack([u, v]))
    step = math.sqrt(2) * (grid[1] - grid[0]) / 2
    return _disc(plane, film_radius_mm, float(np.hypot(u, v)[passed].max()) + step)


def wu_exit_pupil(lens: Lens, film_radius_mm: float) -> RadialPupil:
    """One exit pupil, found by a search in two steps (after Wu et al. 2010, 2011).

    The first follows the tangential fan of film points to its two last passing rays; the second goes across it from
    the middle of the fan. The pupil is the axial disc that holds all those rays where it is smallest as seen from
    the film.
    """
    film_z, (film_points, rays, planes) = _film_z_mm(lens), _WU
    rear = float(lens.vertices_mm[len(lens.surfaces) - 1])
    passes = passes_through(lens, rear)
    radius = np.linspace(0, film_radius_mm, film_points)
    reach = _reach_on(lens, rear, film_radius_mm)
    fan = np.linspace(-reach, reach, rays)
    low, high = _ends(passes, radius, fan, lambda t: np.stack([t, np.zeros_like(t)]))
    lit = low <= high
    radius, low, high = radius[lit], low[lit], high[lit]
    middle = (low + high) / 2
    _, side = _ends(passes, radius, fan[fan >= 0], lambda t: np.stack([np.broadcast_to(middle[:, None], t.shape), t]))
    z = np.linspace(rear - 3 * abs(first_order(lens).efl_mm), rear + 0.7 * (film_z - rear), planes)
    share = ((z - film_z) / (rear - film_z))[:, None]
    x = [radius + share * (end - radius) for end in (low, high, middle)]
    hull = np.maximum.reduce([np.abs(x[0]), np.abs(x[1]), np.hypot(x[2], share * side)]).max(1)
    best = int((hull / (film_z - z)).argmin())
    return _disc(float(z[best]), film_radius_mm, float(hull[best]))


def pixel_pupils(lens: Lens, film_radius_mm: float) -> RadialPupil:
    """A pupil for every pixel from probe rays (Steinert et al. 2011): the disc about those that pass.

    By symmetry one film radius stands for all pixels at it. Probes that pass are few when the stop is closed: the
    disc about them is widened by half the distance between probes, and searched a second time inside it.
    """
    plane, (pixels, probes) = pupil_plane_z_mm(lens), _PIXELS
    passes, rng = passes_through(lens, plane), np.random.default_rng(0)
    film = (np.arange(pixels) + 0.5) * film_radius_mm / pixels
    centre, radius = np.zeros(pixels), np.full(pixels, hull_disc(lens, film_radius_mm).along[0])
    for _ in range(2):
        r, angle = np.sqrt(rng.random((pixels, probes))), 2 * math.pi * rng.random((pixels, probes))
        reach = np.maximum(radius, 0)[:, None] * r
        u, v = centre[:, None] + reach * np.cos(angle), reach * np.sin(angle)
        passed = passes(np.repeat(film, probes), np.stack([u.ravel(), v.ravel()])).reshape(pixels, probes)
        spacing = np.maximum(radius, 0) * math.sqrt(math.pi / probes) / 2
        some = passed.any(1)
        low, high = (f(np.where(passed, u, end), axis=1) for f, end in ((np.min, np.inf), (np.max, -np.inf)))
        centre = np.where(some, (np.where(some, low, 0) + np.where(some, high, 0)) / 2, 0)
        farthest = np.where(passed, np.hypot(u - centre[:, None], v), 0).max(1)
        radius = np.where(some, farthest + spacing, -1)
    return RadialPupil(plane, film_radius_mm, centre, radius, radius, "ellipse")


def radial_bounds(lens: Lens, film_radius_mm: float, shape: Literal["box", "ellipse"]) -> RadialPupil:
    """Bounds of the passing rays in each interval of the film radius (Pharr, Jakob and Humphreys 2016, 6.4.5).

    The box about random points of the plane that pass, widened by a step of so many samples; "ellipse" takes the
    ellipse inside the box, which loses what lies in the corners.
    """
    plane, (intervals, samples) = pupil_plane_z_mm(lens), _RADIAL
    passes = passes_through(lens, plane)
    rng = np.random.default_rng(0)
    reach = np.full(intervals, hull_disc(lens, film_radius_mm).along[0])
    film = (np.arange(intervals)[:, None] + rng.random((intervals, samples))) * film_radius_mm / intervals
    u, v = (reach[:, None] * (2 * rng.random((intervals, samples)) - 1) for _ in range(2))
    passed = passes(film.ravel(), np.stack([u.ravel(), v.ravel()])).reshape(film.shape)
    some = passed.any(1)
    step = 2 * reach / math.sqrt(samples)
    low, high = (f(np.where(passed, u, e), axis=1) for f, e in ((np.min, np.inf), (np.max, -np.inf)))
    low, high = np.where(some, low, 0), np.where(some, high, 0)
    along = np.where(some, (high - low) / 2 + step, -1)
    across = np.where(some, np.where(passed, np.abs(v), 0).max(1) + step, -1)
    return RadialPupil(plane, film_radius_mm, (low + high) / 2, along, across, shape)


def _disc(plane: float, film_radius_mm: float, radius: float) -> RadialPupil:
    return RadialPupil(plane, film_radius_mm, np.zeros(1), np.full(1, radius), np.full(1, radius), "ellipse")


def _reach_on(lens: Lens, plane: float, film_radius_mm: float) -> float:
    """Distance from the axis on a plane within which lies all that enters the rear rim from the film."""
    film_z = _film_z_mm(lens)
    stretch = (film_z - plane) / (film_z - float(lens.vertices_mm[len(lens.surfaces) - 1]))
    return 1.05 * lens.surfaces[-1].semi_diameter_mm * abs(stretch) + film_radius_mm * abs(1 - stretch)


def _ends(passes: Passes, film: Array, fan: Array, point: Callable[[Array], Array]) -> tuple[Array, Array]:
    """First and last passing place t [M] of a fan of points point(t) for each film radius [M]; inf, -inf where none."""
    t = np.broadcast_to(fan, (film.size, fan.size))
    passed = passes(np.repeat(film, fan.size), point(t).reshape(2, -1)).reshape(t.shape)
    some, step = passed.any(1), fan[1] - fan[0]
    ends = []
    for place, sign in (
        (fan[np.argmax(passed, axis=1)], -1.0),
        (fan[fan.size - 1 - np.argmax(passed[:, ::-1], axis=1)], 1.0),
    ):
        width = step
        for _ in range(_HALVINGS):
            width /= 2
            further = place + sign * width
            place = np.where(passes(film, point(further[:, None]).reshape(2, -1)), further, place)
        ends.append(np.where(some, place, -sign * np.inf))
    return ends[0], ends[1]
