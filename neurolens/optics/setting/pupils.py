"""Camera rays from film and pupil points, and a search for the pupil points through which light passes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.optics.lens.paraxial import PupilBounds, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.rims import end_mm
from neurolens.optics.trace.arrays import follow, passing
from neurolens.optics.trace.shapes import sag_mm
from neurolens.optics.trace.surfaces import Rays

Array = NDArray[np.float64]

# Lenses with cylinders are searched at these azimuths, 5 degrees apart: at 15, one of them lost 7% of its corners. The
# lens is symmetric about both of its planes: what passes at -a is the mirror image of what passes at a.
_STEP_DEG = 5
AZIMUTHS = tuple(math.radians(_STEP_DEG * k) for k in range(-18, 19))
# The azimuths in groups, of which the first find most of what passes.
GROUPS = (AZIMUTHS[18:19], AZIMUTHS[::9], tuple(a for k, a in enumerate(AZIMUTHS) if k % 9))
# A lens with surfaces off its axis has no plane of symmetry: it is searched all around, on both sides of the pupil. A
# lens with cylinders takes all of these azimuths, others every third: a decentre acts by the sine of the azimuth.
AROUND = tuple(math.radians(_STEP_DEG * k) for k in range(72))
# A film radius is searched at the azimuths of radii smaller by this share, too: outlines are interpolated between
# radii.
_BETWEEN_RADII = 0.03


def pupil_plane_z_mm(lens: Lens) -> float:
    """Return the z (mm) of the plane of pupil points: the paraxial exit pupil, where passing rays crowd together.

    Where the exit pupil lies near or behind the film, or too far in front of it to be useful, the rear vertex stands in
    for it: that of the lens itself, in front of a cover glass on the film.
    """
    data = first_order(lens)
    rear = float(lens.vertices_mm[len(lens.surfaces) - 1])
    film = data.rear_focal_z_mm
    z = data.exit_pupil_z_mm
    useful = math.isfinite(z) and 0.25 * (film - rear) < film - z < 20 * abs(data.efl_mm)
    return float(z) if useful else rear_opening_mm(lens, film)[1]


def camera_rays(film_x: Any, film_y: Any, film_z: Any, pupil_x: Any, pupil_y: Any, pupil_z: float) -> Rays:
    """Return camera rays from film points towards (or away from) pupil points, [N] in mm, lens frame; dz is negative.

    Points are arrays or tensors; the z of their planes may be plain numbers.
    """
    x, y, z = pupil_x - film_x, pupil_y - film_y, 0 * film_x + (pupil_z - film_z)
    scale = -1 / (x * x + y * y + z * z) ** 0.5
    scale = scale * (z / abs(z))
    return Rays(film_x, film_y, film_z + 0 * film_x, x * scale, y * scale, z * scale)


def on_plane(rays: Rays, z_mm: float) -> Rays:
    """Return the rays, moved along themselves to the plane at z."""
    t = (z_mm - rays.z) / rays.dz
    return rays._replace(x=rays.x + t * rays.dx, y=rays.y + t * rays.dy, z=z_mm + 0 * rays.z)


def passes_at_any_azimuth(
    lens: Lens,
    film_radius: Array,
    film_z: Array,
    pupil_x: Array,
    pupil_y: Array,
    pupil_z: float,
    wavelength_nm: float,
    film_mm: tuple[float, float] | None = None,
) -> NDArray[np.bool_]:
    """Test whether light passes from film points on +x through pupil points, at any azimuth of the whole, bool [N].

    Blades and masks are left out: the round opening about them holds what they let through at every azimuth. Only
    lenses that are not round are traced at more than one azimuth: with cylinders at `AZIMUTHS`, with surfaces off the
    axis at those `AROUND` and on both sides of the pupil.

    Args:
        film_radius, film_z, pupil_x, pupil_y: [N], mm.
        pupil_z: plane of the pupil points, mm, lens frame.
        film_mm: width and height of a film. Only azimuths count at which it has points that far from its middle.
    """
    lens = replace(lens, aperture=None)
    passed, round_ = np.zeros(len(film_radius), bool), lens.round
    around = (AROUND[::18], AROUND[:: 1 if lens.anamorphic else 3])
    groups = ((0.0,),) if round_ else around if lens.decentred else GROUPS
    low, high = (-math.inf, math.inf) if round_ or film_mm is None else azimuths_on_film(film_radius, film_mm)
    for group, side in product(groups, (1.0, -1.0) if lens.decentred else (1.0,)):
        # Traced together, because few rays take nearly as long as many.
        azimuth = np.array(group)[:, None]
        first = np.arccos(np.abs(np.cos(azimuth))) if lens.decentred else abs(azimuth)  # in the first quadrant
        which, left = np.nonzero(~passed & (low <= first) & (first <= high))
        r, u, v = film_radius[left], pupil_x[left], side * pupil_y[left]
        c, s = np.cos(azimuth[which, 0]), np.sin(azimuth[which, 0])
        rays = camera_rays(c * r, s * r, film_z[left], c * u - s * v, s * u + c * v, pupil_z)
        passed[left[passing(lens, rays, wavelength_nm)]] = True
    return passed


def azimuths_on_film(film_radius: Array, film_mm: tuple[float, float]) -> tuple[Array, Array]:
    """Return the least and largest azimuth in the first quadrant, rad [N], at which a film has points that far out.

    The film is centred, and half a step of `AZIMUTHS` is added at either end; beyond the corner, azimuths about the
    corner's count.
    """
    width, height = film_mm
    radius = np.maximum(film_radius * (1 - _BETWEEN_RADII), 1e-12)
    low, high = np.arccos(np.minimum(width / 2 / radius, 1)), np.arcsin(np.minimum(height / 2 / radius, 1))
    corner = math.atan2(height, width)
    beyond = 1.001 * math.radians(_STEP_DEG) / 2
    return np.minimum(low, corner) - beyond, np.maximum(high, corner) + beyond


_STRIDE = 4  # every so many points of a grid are traced first, then only those that may widen what these found
FEW = 40  # where so few points of a grid pass, it may miss the edges of what passes, or all of it


class Box(NamedTuple):
    """Bounds (mm) of passing points for a film point on +x: along x, across it, from the axis; and their count."""

    low: float
    high: float
    half: float
    radius: float
    points: int = 0


class Place(NamedTuple):
    """A film point on +x, by its distance from the axis and the z of its plane, mm."""

    radius: float
    film_z: float


def union(boxes: Sequence[Box]) -> Box:
    """Return the box that holds all boxes; for no boxes an empty one (low > high)."""
    if not boxes:
        return Box(1.0, -1.0, 0.0, 0.0)
    return Box(
        min(b.low for b in boxes), max(b.high for b in boxes), max(b.half for b in boxes), max(b.radius for b in boxes)
    )


def search(
    lens: Lens,
    places: Sequence[Place],
    wavelengths: Sequence[float],
    pupil_z: float,
    boxes: Sequence[Box],
    points: int,
    film_mm: tuple[float, float] | None,
) -> list[Box | None]:
    """Find the boxes of passing points of grids over `boxes`, a step wider; None for a film point without any.

    Grids cover the upper halves, since the lens is symmetric.

    A coarse grid is traced first. Where enough of it passes, the fine grid is traced only at points that may lie beyond
    the extent found, by less than a coarse step. Elsewhere it is traced at all points near those found, or at all
    points.

    Args:
        places, boxes: film points, and where to look from each.
        wavelengths: in nm; rays of any of them count.
        points: of a grid along the box; half of that, for the upper half, are across.
        film_mm: see `passes_at_any_azimuth`.
    """
    if not places:
        return []
    low, high, half = (np.array([getattr(b, k) for b in boxes], np.float64) for k in ("low", "high", "half"))
    u = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, points)
    v = half[:, None] * np.linspace(0, 1, points // 2)
    radius, film_z = np.array(places, np.float64).T
    pu, pv = np.broadcast_arrays(u[:, :, None], v[:, None, :])
    passed = np.zeros(pu.shape, bool)

    def look(at: NDArray[np.bool_]) -> None:
        for w in wavelengths:
            job, i, j = np.nonzero(at & ~passed)
            x, y = u[job, i], v[job, j]
            passed[job, i, j] = passes_at_any_azimuth(lens, radius[job], film_z[job], x, y, pupil_z, w, film_mm)

    first = np.zeros_like(passed)
    first[:, ::_STRIDE, ::_STRIDE] = True
    look(first)
    du, dv = u[:, 1] - u[:, 0], v[:, 1] - v[:, 0]
    look(~first & _may_widen(passed, pu, pv, _STRIDE * du, _STRIDE * dv))
    least, most, across, reach = (t.tolist() for t in _extent(passed, pu, pv))
    return [
        Box(least[k] - a, most[k] + a, across[k] + b, reach[k] + math.hypot(a, b) / 2, count) if count else None
        for k, (a, b, count) in enumerate(zip(du.tolist(), dv.tolist(), passed.sum((1, 2)).tolist(), strict=True))
    ]


def _extent(passed: NDArray[np.bool_], u: Array, v: Array) -> tuple[Array, Array, Array, Array]:
    """Return the passing points' least and largest u, largest v, and largest distance from the axis, [M] each."""
    largest = [np.where(passed, c, -math.inf).max((1, 2)) for c in (-u, u, v, np.hypot(u, v))]
    return -largest[0], largest[1], largest[2], largest[3]


def _may_widen(passed: NDArray[np.bool_], u: Array, v: Array, du: Array, dv: Array) -> NDArray[np.bool_]:
    """Return points that may lie beyond the extent found, by less than a step, along, across or from the axis."""
    least, most, across, reach = (t[:, None, None] for t in _extent(passed, u, v))
    du, dv = du[:, None, None], dv[:, None, None]
    distance = np.hypot(u, v)
    within = (u > least - du) & (u < most + du) & (v < across + dv) & (distance < reach + np.hypot(du, dv))
    beyond = (u < least) | (u > most) | (v > across) | (distance > reach)
    count = passed.sum((1, 2))[:, None, None]
    # Where only few were found, all points within two steps are tried; where none were, the whole grid.
    near = (u > least - 2 * du) & (u < most + 2 * du) & (v < across + 2 * dv)
    return (within & beyond) | ((count < FEW) & near) | (count == 0)


# Where the rear rim's box is more than _FAR times as wide, rays are also looked for within this many paraxial exit
# pupils of the axis.
_NEAR, _FAR = 3.0, 4.0
_CLOSE = 0.25  # a rim that is closer to the film than this share of its radius
_COARSE = 8  # film radii of the illumination, of which the search for its end first takes every eighth
_DISTORTED = 1.1  # a lens that images a field this much nearer to the axis than f tan(field) is no rectilinear one

_AT_MANY_AZIMUTHS = 64  # at most so many points a grid where each is traced at many azimuths

# Finds boxes about what passes from film points, within the boxes given.
_Look = Callable[[Lens, list[Place], list[Box]], list[Box | None]]


def pupil_bounds(
    lens: Lens,
    film_radius_mm: float,
    film_z_mm: tuple[float, float],
    wavelength_nm: tuple[float, float],
    *,
    rows: int = 33,
    points: int = 128,
    film_mm: tuple[float, float] | None = None,
    pupil_z_mm: float | None = None,
) -> PupilBounds:
    """Search the pupil plane for passing rays, for all film radii together, by coarse grids, then by finer ones.

    Each row is widened by the step of its grid and by its neighbours, so that the bounds hold between rows too.

    Args:
        film_radius_mm: radius of the last row.
        film_z_mm: nearest and farthest film plane.
        wavelength_nm: range of the light.
        rows: number of film radii.
        points: of a grid along x.
        film_mm: width and height of a film; what lies beyond it is left out of the search of a lens with cylinders (see
            `passes_at_any_azimuth`).
        pupil_z_mm: the plane; None takes `pupil_plane_z_mm`.

    Raises:
        InputError: no ray passes from any film point.
    """
    plane = pupil_plane_z_mm(lens) if pupil_z_mm is None else pupil_z_mm
    if not lens.round:
        points = min(points, _AT_MANY_AZIMUTHS)
    wavelengths = sorted(set(wavelength_nm))
    data = first_order(lens)
    near = math.inf
    if pupil_plane_z_mm(lens) == data.exit_pupil_z_mm:
        near = _NEAR * data.exit_pupil_diameter_mm / 2
    jobs = []
    for i in range(rows):
        for z in sorted(set(film_z_mm)):
            place = Place(film_radius_mm * i / (rows - 1), z)
            jobs += [(i, place, start) for start in _starts(lens, place, plane, near, data.exit_pupil_z_mm)]

    def look(lens: Lens, places: list[Place], starts: list[Box]) -> list[Box | None]:
        return search(lens, places, wavelengths, plane, starts, points, film_mm)

    found = _found(look, lens, [place for _, place, _ in jobs], [start for _, _, start in jobs])
    by_row: list[list[Box]] = [[] for _ in range(rows)]
    for (i, _, _), box in zip(jobs, found, strict=True):
        by_row[i] += [box] if box else []
    boxes = [union(row) if row else None for row in by_row]
    if not any(boxes) or not lens.stop_radius_mm > 0:  # the very middle of a shut stop is no light
        expected = f"rays from a film of radius {film_radius_mm:.4g} mm"
        raise InputError(lens.path, "surfaces", "(no ray passes the lens)", expected)
    merged = [union([b for b in boxes[max(i - 1, 0) : i + 2] if b]) for i in range(rows)]
    return PupilBounds(
        plane,
        film_radius_mm,
        tuple(b.low for b in merged),
        tuple(b.high for b in merged),
        tuple(b.half for b in merged),
        max(b.radius for b in boxes if b),
    )


def _starts(lens: Lens, place: Place, plane: float, near: float, exit_z: float) -> list[Box]:
    """Bound a film point's light on the pupil plane by the rear rim.

    Where that bounds it badly, a second box bounds it by `near` mm about the middle of the exit pupil.
    """
    rear = lens.surfaces[-1]
    rear_z = float(lens.vertices_mm[len(lens.surfaces) - 1])
    limit = min(rear.semi_diameter_mm, end_mm(rear))
    depths = [sag_mm(rear, limit * t, 0.0) for t in (0.0, 0.5, 0.8, 1 - 1e-12)]
    # Every ray that enters crosses the rear surface, which lies between two planes, within the rim's radius. Seen from
    # the film point, the two ends of this cylinder bound the ray on the pupil plane.
    ends = []
    for z in (rear_z + min(depths), rear_z + max(depths)):
        stretch = (place.film_z - plane) / (place.film_z - z)
        centre, reach = place.radius * (1 - stretch), 1.02 * rear.semi_diameter_mm * abs(stretch)
        ends.append(Box(centre - reach, centre + reach, reach, 0.0))
    starts = [union(ends)]
    if math.isfinite(near):
        stretch = (place.film_z - plane) / (place.film_z - exit_z)
        centre, reach = place.radius * (1 - stretch), near * abs(stretch)
        if starts[0].high - starts[0].low > _FAR * reach:
            # With a cover glass a millimetre from the film, the pupil is so small that it falls between the points of a
            # grid.
            starts.append(Box(centre - reach, centre + reach, reach, 0.0))
    return starts


def _found(look: _Look, lens: Lens, places: list[Place], starts: list[Box]) -> list[Box | None]:
    """Return the boxes of what passes, by a grid over each start and another over what that finds."""
    coarse = look(lens, places, starts)
    few = [k for k, box in enumerate(coarse) if box is None or box.points < FEW]
    # A small stop may lie between the points of the grid, so look again where light passes the open stop.
    wide = look(lens.with_stop_radius(math.inf), [places[k] for k in few], [starts[k] for k in few])
    lit = [(k, box) for k, box in zip(few, wide, strict=True) if box]
    closer = look(lens, [places[k] for k, _ in lit], [box for _, box in lit])
    for k in few:
        coarse[k] = None
    for (k, _), box in zip(lit, closer, strict=True):
        coarse[k] = box
    some = [(k, box) for k, box in enumerate(coarse) if box]
    fine = look(lens, [places[k] for k, _ in some], [box for _, box in some])
    for (k, box), finer in zip(some, fine, strict=True):
        coarse[k] = finer or box
    return coarse


@lru_cache(maxsize=16)
def image_radius_mm(lens: Lens) -> tuple[float, str]:
    """Return the radius (mm) of the lit film, and where it comes from.

    It is the file's own. Without one it follows from the half field: below 60 degrees it is f tan(half field). Where no
    light falls there, or light of much wider fields, and from 60 degrees on, it is the film radius whose passing rays
    leave, in the mean, at the half field. Without a half field, and where rims cut the light before it, it is where the
    relative illumination falls to 10%.
    """
    if lens.image_radius_mm is not None:
        return lens.image_radius_mm, "the lens file"
    f = first_order(lens).front_efl_mm  # of angles in the medium in front
    if lens.half_field_deg is not None and lens.half_field_deg < 60:
        tangent = math.tan(math.radians(lens.half_field_deg))
        share, angle = _illumination(lens.with_stop_radius(math.inf), np.array([abs(f) * tangent]))
        if share[0] > 0 and angle[0] < math.atan(_DISTORTED * tangent):
            return abs(f) * tangent, "f tan(half field)"
    radii = np.linspace(0, 3 * abs(f), 481)
    points = 48
    if not _illumination(lens, radii[:1])[0] > 0:  # a nearly closed stop lies between the points of the grid
        radii, points = radii[:: len(radii) // 60], 384
    on_axis = _illumination(lens, radii[:1], points)[0]
    if not on_axis > 0:
        raise InputError(lens.path, "surfaces", "(no ray passes on the axis)", "rims that let axial light pass")
    coarse = np.arange(0, len(radii), _COARSE)
    known = _illumination(lens, radii[coarse], points)

    def last(holds: Callable[[Array, Array], NDArray[np.bool_]]) -> float:
        """Return the last radius at which a test of illumination and angle holds, by coarse steps, then fine ones."""
        from_ = int(coarse[holds(*known)].max())
        closer = np.arange(from_, min(from_ + _COARSE, len(radii)))
        return float(radii[closer[holds(*_illumination(lens, radii[closer], points))]].max())

    lit = last(lambda share, _: share >= 0.1 * on_axis)
    if lens.half_field_deg is not None:
        edge = math.radians(lens.half_field_deg)
        reached = last(lambda share, angle: (angle <= edge) & (share > 0))
        if reached <= lit:
            return reached, "traced to the half field"
    return lit, "relative illumination of 10%"


def _illumination(lens: Lens, radii: Array, points: int = 48) -> tuple[Array, Array]:
    """Return film irradiance (in any unit) and mean angle (rad) of the passing rays at each film radius."""
    film_z = lens.film_z_mm if lens.film_z_mm is not None else float(lens.vertices_mm[-1])
    rear, rear_z = rear_opening_mm(lens, film_z)
    grid = np.linspace(-rear, rear, points)
    # By symmetry the half above the axis stands for both.
    film, px, py = (t.reshape(-1) for t in np.meshgrid(radii, grid, grid[points // 2 :], indexing="ij"))
    rays = camera_rays(film, 0 * film, film_z, px, py, rear_z)
    found = follow(lens, rays, lens.reference_nm)
    passed = (found.status == 0) & (px * px + py * py <= rear * rear)
    weight = np.where(passed, rays.dz**4, 0.0).reshape(len(radii), -1)
    theta = np.where(passed, np.arctan2(np.hypot(found.rays.dx, found.rays.dy), -found.rays.dz), 0.0)
    return weight.sum(1), (theta.reshape(weight.shape) * weight).sum(1) / np.maximum(weight.sum(1), 1e-30)


def rear_opening_mm(lens: Lens, film_z: float) -> tuple[float, float]:
    """Return the radius and z (mm) of the disc through which light comes to the film: the last rim.

    On a cover glass that all but lies on the film, the light of a film point fills only a speck. Then the opening is
    the rim before the plates, made wider by as much as they shift rays.
    """
    last, shift = len(lens.surfaces) - 1, 0.0
    while last > 1 and film_z - float(lens.vertices_mm[last]) < _CLOSE * lens.surfaces[last].semi_diameter_mm:
        if not all(math.isinf(s.radius_mm) and not s.figure.bends for s in lens.surfaces[last - 1 : last + 1]):
            break
        shift += float(lens.surfaces[last - 1].thickness_mm)
        last -= 2
    return lens.surfaces[last].semi_diameter_mm + shift, float(lens.vertices_mm[last])
