"""The pupil of every film point, filled exactly: outlines of what passes, by film radius, and points inside them.

Rays that pass a lens from one film point cross the pupil plane in a region bounded by a few smooth arcs: the images of
the stop and of the rims that vignette. A polygon about a centre inside it, interpolated between film radii, holds the
region so closely that nearly every ray sent through it passes. The arcs move with the wavelength, by 2% of the pupil
over the visible range in a double Gauss, and so do the polygons.

The search needs nothing but a test whether rays pass, which the exact tracer and an exported model both have, at any
focus and stop. It goes outwards from a centre, ray by ray, for all rows of the outline at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.cameragraph import pupil_graph
from neurolens.cameras.contract import FloatArray
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.card import pupil_rows


@dataclass(frozen=True)
class PupilOutline:
    """Polygons on the pupil plane that hold the passing rays of film points, by film radius and wavelength.

    For a film point at radius r along +x, the polygon has its centre at (centre, 0) and is symmetric about the x axis;
    `x` and `y` are the vertices of its upper half relative to the centre, from +x to -x. Film radii grow by less and
    less: row i of R lies at (1 - (1 - i / (R - 1))^2) of the last radius. For near the end of the light the region
    shrinks as the root of the distance to that end, which is then linear from row to row.

    Attributes:
        pupil_z_mm: the pupil plane.
        film_radius_mm: radius of the last row, beyond which no ray passes; the first row is the axis.
        wavelength_nm: the W wavelengths of `x` and `y`, one or two; between two, vertices move linearly with 1 /
            wavelength^2.
        centre: [R], mm.
        x, y: [W, R, K + 1], mm; y is 0 at both ends.
        lean: [R, K + 1], of the outline of a turned film (`leaning`): by which share a vertex of the first wavelength
            moves away from the centre for a `lean` of 1 (`pose.to_plane`). None is the outline of an upright film.
    """

    pupil_z_mm: float
    film_radius_mm: float
    wavelength_nm: tuple[float, ...]
    centre: FloatArray
    x: FloatArray
    y: FloatArray
    lean: FloatArray | None = None

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray, lean: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return points that fill the polygons of film points evenly, by `graph`.

        Args:
            film_mm: [2, N].
            square: [2, N] in [0, 1).
            wavelength_nm: [N].
            lean: [N], of rays of a turned film; None is 0.

            Returns:
                The points [2, N] in mm, and for each the area [N], in mm^2 of pupil plane for each unit of area of the
                square; 0 where nothing passes. It is the inverse of the point's probability density. Over a polygon it
                varies little, and its mean is the polygon's area.
        """
        given = {
            "film_mm": film_mm,
            "square": square,
            "wavelength_nm": wavelength_nm[None],
            "outline": self.table,
            **{name: np.array([[value]], np.float32) for name, value in self.numbers.items()},
            "lean": 0 * film_mm[:1] if lean is None else lean[None],
        }
        found = evaluate(self.graph, given)
        area = found["area_mm2"][0]
        return found["pupil_mm"], np.where(area > 0, area, np.float32(0))

    def on_plane(self, pupil_z_mm: float, film_z_mm: float) -> PupilOutline:
        """Return the outline of the same rays on another plane, with their film at a given place."""
        scale = np.float32((pupil_z_mm - film_z_mm) / (self.pupil_z_mm - film_z_mm))
        film = self.radii(np.arange(self.centre.size, dtype=np.float64)).astype(np.float32)
        centre = film + (self.centre - film) * scale
        return replace(self, pupil_z_mm=pupil_z_mm, centre=centre, x=self.x * scale, y=self.y * scale)

    @property
    def graph(self) -> Graph:
        """Write the outline's `pupil_graph`."""
        return pupil_graph(self.x.shape[2] - 1, len(self.x), self.lean is not None)

    def radii(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the film radii in mm of (fractional) rows."""
        return self.film_radius_mm * (1 - (1 - place / (self.centre.size - 1)) ** 2)

    @cached_property
    def numbers(self) -> dict[str, float]:
        """Return the inputs of `pupil_graph` for a whole call."""
        waves = [w**-2 for w in self.wavelength_nm]
        numbers = {"per_radius": 1 / self.film_radius_mm, "last_row": float(self.centre.size - 1)}
        if len(self.x) > 1:
            numbers |= {"wave_first": waves[0], "wave_scale": 1 / (waves[1] - waves[0])}
        return numbers

    @cached_property
    def table(self) -> FloatArray:
        """Return the table of `pupil_graph`, [R * (K + 1), 10 W] or 10 more, with contiguous columns.

        Columns stand in groups, whose weights are 1, step, share, and share times step: first vertex and edge (x, y,
        dx, dy) and centre at a row; their steps to the next row; and for two wavelengths the change of both from the
        first to the second. Two groups more have the change with the lean of a turned film's rays. The last cell of a
        row is its end, which belongs to the last edge.
        """
        edges = [np.diff(c, append=2 * c[..., -1:] - c[..., -2:-1]) for c in (self.x, self.y)]
        centre = np.broadcast_to(self.centre[:, None], self.x.shape)
        here = np.stack([self.x, self.y, *edges, centre], 1)  # [W, 5, R, K + 1]
        leaning = [] if self.lean is None else [self.lean * self.x[0], self.lean * self.y[0]]
        here[1:] -= here[:1]
        if leaning:
            turned = [*leaning, *(np.diff(c, append=2 * c[:, -1:] - c[:, -2:-1]) for c in leaning), 0 * centre[0]]
            here = np.concatenate([here, np.stack(turned)[None]])
        groups = np.stack([here, np.diff(here, axis=2, append=here[:, :, -1:])], 1)
        return np.ascontiguousarray(groups.reshape(10 * len(here), -1), np.float32).T


def wavelength_between(wavelength_nm: tuple[float, ...], share: float) -> float:
    """Return the wavelength in nm at a share of the way from the first to the last, in 1 / wavelength^2."""
    first, last = wavelength_nm[0], wavelength_nm[-1]
    if share in (0, 1):  # no rounding may leave the range
        return last if share else first
    return first if first == last else float((first**-2 + share * (last**-2 - first**-2)) ** -0.5)


# ---- the search ----

# Halvings that place the end of the light, and the lattice on a box that looks for light.
_END_HALVINGS = 10
_COARSE_LATTICE = (40, 20)

# Tells whether light of a wavelength in nm passes from film points through pupil points, [2, N] in mm each: bool [N].
Passes = Callable[[FloatArray, FloatArray, float], NDArray[np.bool_]]
Array = NDArray[np.float64]
# Tells whether rays pass from film points (radius, 0) through points [2, ...]; the radius broadcasts with the points.
PassTest = Callable[[Array, Array], NDArray[np.bool_]]


@dataclass(frozen=True)
class PupilTable:
    """Boxes on the pupil plane that hold the passing rays of film points at equally spaced radii.

    For a film point at radius r along +x, passing rays lie within low <= u <= high along +x and |v| <= half across.

    Attributes:
        pupil_z_mm: the pupil plane.
        film_radius_mm: radius of the last row; the first row is the axis.
        rows: [3, R], low, high and half; low > high where nothing passes.
    """

    pupil_z_mm: float
    film_radius_mm: float
    rows: FloatArray

    @staticmethod
    def of(bounds: Mapping[str, Any]) -> PupilTable:
        """Make the table of the fields of `PupilBounds`, as a model's card holds them."""
        return PupilTable(float(bounds["pupil_z_mm"]), float(bounds["film_radius_mm"]), pupil_rows(bounds))


def tightened(table: PupilTable, passing: PassTest, lattice: tuple[int, int] = (96, 48)) -> PupilTable:
    """Return the table with its boxes cut to what passes now, for example through a stop that is closed down."""
    last = table.rows.shape[1] - 1
    place = np.minimum(np.arange(last + 1), last * (1 - 1e-6))
    found = _lattice(_boxes(table, place), table.film_radius_mm * place / last, passing, lattice)
    return replace(table, rows=found.boxes.astype(np.float32))


class SearchFrame(NamedTuple):
    """Describes where to search in each row [R].

    The frame is stretched so that the region is about as wide as it is high.

    Attributes:
        radius: film radius.
        centre: of the polygon.
        stretch: [2, R], half widths along and across.
        reach: the farthest distance in the stretched frame.
    """

    radius: Array
    centre: Array
    stretch: Array
    reach: Array


def pass_test(passes: Passes, wavelength_nm: Sequence[float]) -> PassTest:
    """Return a test whether rays pass at any of the wavelengths."""

    def passing(radius: Array, points: Array) -> NDArray[np.bool_]:
        film = np.zeros(points.shape, np.float32)
        film[0] = radius
        rays = np.concatenate([film, points]).reshape(4, -1).astype(np.float32)
        passed = np.zeros(rays.shape[1], np.bool_)
        for wavelength in wavelength_nm:
            left = np.flatnonzero(~passed)
            passed[left] = passes(rays[:2, left], rays[2:, left], wavelength)
        return passed.reshape(points.shape[1:])

    return passing


def end_of_light(table: PupilTable, passing: PassTest) -> float | None:
    """Return the largest film radius, within those of the table, from which a ray is found to pass."""
    last = table.rows.shape[1] - 1

    def light(boxes: Array, place: Array) -> Array:
        """Search given boxes at fractional rows, and return boxes [3, M] about the rays that pass."""
        return _lattice(boxes, table.film_radius_mm * place / last, passing).boxes

    rows = np.minimum(np.arange(last + 1), last * (1 - 1e-6))
    boxes = light(_boxes(table, rows), rows)
    some = np.flatnonzero(boxes[0] <= boxes[1])
    if not some.size:
        return None
    lit, box = rows[some[-1:]], boxes[:, some[-1:]]
    dark = rows[some[-1] + 1 : some[-1] + 2]
    for _ in range(_END_HALVINGS if dark.size else 0):
        middle = (lit + dark) / 2
        # What is left of the pupil mostly lies within what was left before, where a lattice finds smaller regions.
        found = next((f for b in (box, _boxes(table, middle)) if (f := light(b, middle))[0] <= f[1]), None)
        lit, dark, box = (lit, middle, box) if found is None else (middle, dark, found)
    return float(table.film_radius_mm * lit[0] / last) if lit[0] > 0 else None


def _boxes(table: PupilTable, place: Array) -> Array:
    """Return low, high and half width [3, M] of boxes that hold what passes at fractional rows of the table."""
    low, high, half = table.rows.astype(np.float64)
    empty = low > high
    low, high = np.where(empty, np.inf, low), np.where(empty, -np.inf, high)
    a = np.minimum(place.astype(np.intp), low.size - 1)
    b = np.minimum(a + 1, low.size - 1)
    return np.stack([np.minimum(low[a], low[b]), np.maximum(high[a], high[b]), np.maximum(half[a], half[b])])


class _Found(NamedTuple):
    """What passes of lattices: boxes [3, M] about it, a step wider (low > high if none does), and its mean along x."""

    boxes: Array
    centre: Array


@np.errstate(over="ignore", invalid="ignore")  # nothing passes of empty boxes, nor of those near float32's end
def _lattice(boxes: Array, radius: Array, passing: PassTest, size: tuple[int, int] = _COARSE_LATTICE) -> _Found:
    """Test lattices of points on boxes [3, M] from film radii [M]."""
    low, high, half = boxes
    u, v = ((np.arange(n) + 0.5) / n for n in size)
    x, y = points = np.empty((2, radius.size, *size))
    x[:] = low[:, None, None] + (high - low)[:, None, None] * u[:, None]
    y[:] = half[:, None, None] * v
    passed = passing(radius[:, None, None], points) & (low <= high)[:, None, None]
    left, right = np.where(passed, x, np.inf).min((1, 2)), np.where(passed, x, -np.inf).max((1, 2))
    top = np.where(passed, y, 0).max((1, 2))
    centre = np.where(passed, x, 0).sum((1, 2)) / np.maximum(passed.sum((1, 2)), 1)
    step, rise = (high - low) / size[0], half / size[1]
    return _Found(np.where(passed.any((1, 2)), [left - step, right + step, top + rise], [[1], [-1], [0]]), centre)


def frame_of(table: PupilTable, radius: Array, passing: PassTest) -> SearchFrame:
    """Return the centroid and extent of what passes at each film radius, from a lattice."""
    place = radius / table.film_radius_mm * (table.rows.shape[1] - 1)
    boxes, centre = _lattice(_boxes(table, place), radius, passing)
    # A row whose lattice misses a small region takes over what its neighbours have.
    rows, found = np.arange(radius.size), boxes[0] <= boxes[1]
    centre, low, high, half = (np.interp(rows, rows[found], a[found]) for a in (centre, *boxes))
    centre[radius == 0] = 0.0  # the axis has no azimuth: pupil points must not jump as a film point passes it
    stretch = np.stack([(high - low) / 2, half])
    off_centre = np.abs(centre - (low + high) / 2) / stretch[0]
    return SearchFrame(radius, centre, stretch, 1.05 * np.hypot(1 + off_centre, 1))


_DIRECTIONS = 33  # directions in which the first outline is sought
# Where the interpolated outline is checked: between rows, along an edge, and between the two wavelengths; at which
# multiples of it; and how far beyond what was found vertices are pushed, which is a hair, against rounding.
_BETWEEN_ROWS, _ALONG_EDGE = (0.0, 0.5), (0.0, 0.3, 0.5, 0.7)
_CHECKS, _CHECK_HALVINGS = (1.0, 1.002, 1.01, 1.03, 1.07, 1.15, 1.35), 5
_HAIR = 2e-5
# Where the region of one wavelength is less than this share of both together, one outline serves both. A half-plane
# that does not hold the centroid of a convex region cuts off less than 1 - 1/e of it (Gruenbaum 1960), so the centre
# lies inside all regions.
_APART = 0.65
# One outline serves both, too, where a wavelength between reaches this much farther than the ends of the spectrum let
# expect.
_BULGE = 1.04


class Detail(NamedTuple):
    """How finely an outline is searched.

    Attributes:
        rows: film radii.
        segments: edges of the upper half of a polygon.
        wavelengths: shares of the way from the shortest to the longest, in 1 / wavelength^2, the ends among them.
        steps: how many steps outwards each of the two searches takes.
        coarse, fine: how often the first and the second search halve the step that crosses the boundary.
        reach: how many times as far as the first search found the second looks.
        tighten: lattice on each box, along and across, because the table may be much wider than what passes.
    """

    rows: int = 65
    segments: int = 32
    wavelengths: tuple[float, ...] = (0.0, 0.4, 0.75, 1.0)
    steps: int = 24
    coarse: int = 5
    fine: int = 12
    reach: float = math.inf
    tighten: tuple[int, int] = (96, 48)


FINE = Detail()
# For a lens with cylinders: each test takes tracing at many azimuths, and no outline fits all of them. What is saved
# errs towards outlines that are too wide, for halvings end outside what passes.
COARSE = Detail(33, 16, (0.0, 0.5, 1.0), 12, 2, 5, 1.2, (48, 24))


def outline_of(
    table: PupilTable,
    passes: Passes,
    wavelength_nm: tuple[float, float],
    detail: Detail = FINE,
    report: Callable[[float], object] = lambda share: None,
) -> PupilOutline | None:
    """Search the outline of what passes; return None where nothing does.

    The polygons hold every point found to pass at the rows, between them and between vertices, even where the region is
    not convex or the outline bends: their vertices are pushed out until they do.

    Args:
        table: boxes that hold what passes; wider ones take longer, but do no harm.
        passes: tests the lens at one focus and stop.
        wavelength_nm: shortest and longest wavelength; equal ones give an outline for one.
        detail: how finely to search.
        report: takes the share of the search that is done.
    """
    ends = tuple(sorted(set(wavelength_nm)))
    wavelengths_nm = sorted({wavelength_between(ends, share) for share in detail.wavelengths})
    passing = pass_test(passes, wavelengths_nm)
    tight = tightened(table, passing, detail.tighten)
    end = end_of_light(tight, passing)
    if end is None:
        return None
    rows = detail.rows
    empty = np.zeros((len(ends), rows, 1), np.float32)
    outline = PupilOutline(table.pupil_z_mm, end, ends, empty[0, :, 0], empty, empty)
    frame = frame_of(tight, outline.radii(np.arange(rows, dtype=np.float64)), passing)
    start = np.repeat(np.linspace(0, np.pi, _DIRECTIONS)[None], rows, axis=0)
    reach = np.repeat(frame.reach[:, None], _DIRECTIONS, axis=1)
    report(0.1)
    rough = _boundary(passing, frame, start, reach, detail.steps, detail.coarse)
    report(0.2)
    angles = _equal_areas(start, rough, detail.segments)
    if detail.reach < math.inf:
        reach = np.minimum(reach, np.maximum(detail.reach * rough, reach / detail.steps))
    reach = np.stack([np.interp(*row) for row in zip(angles, start, reach, strict=True)])
    found = []
    for w in wavelengths_nm:
        found.append(_boundary(pass_test(passes, (w,)), frame, angles, reach, detail.steps, detail.fine))
        report(0.2 + 0.4 * len(found) / len(wavelengths_nm))
    fine = _together(np.stack(found), detail.wavelengths)
    x, y = (fine * a[:, None] * f(angles) for a, f in zip(frame.stretch, (np.cos, np.sin), strict=True))
    y[..., [0, -1]] = 0
    centre, x, y = (a.astype(np.float32) for a in (frame.centre, x, y))
    pushed = replace(outline, centre=centre, x=x, y=y)
    return _pushed_out(pushed, passes, detail.wavelengths, lambda share: report(0.6 + 0.4 * share))


def _boundary(passing: PassTest, frame: SearchFrame, angles: Array, reach: Array, steps: int, halvings: int) -> Array:
    """Return the distance [R, D] from the centre to the last passing point in each direction, in the stretched frame.

    It is searched within `reach` [R, D], by so many steps and halvings of the last.
    """
    direction = np.stack([np.cos(angles), np.sin(angles)]) * frame.stretch[:, :, None]
    tried = np.linspace(0, 1, steps + 1)[:, None] * reach.ravel()
    flat = _farthest(passing, *_flat(frame.radius, frame.centre, direction), tried, halvings)
    return flat.reshape(angles.shape)


def _flat(radius: Array, centre: Array, direction: Array) -> tuple[Array, Array, Array]:
    """Return film radius [M], origin and direction [2, M] of all directions [2, R, D] from the centres of rows."""
    count = direction.shape[2]
    origin = np.stack([np.repeat(centre, count), np.zeros(centre.size * count)])
    return np.repeat(radius, count), origin, direction.reshape(2, -1)


def _farthest(
    passing: PassTest,
    radius: Array,
    origin: Array,
    direction: Array,
    steps: Array,
    halvings: int,
) -> Array:
    """Return the largest t [M] at which origin + t direction passes, to the last halving and never less.

    Args:
        passing: the test whether rays pass.
        radius, origin, direction: [M], [2, M], [2, M], mm.
        steps: [S, M], rising values of t. All are tried, so that a region with a dent is held whole. Where none passes,
            the first is the answer.
    """
    # All are tested together, because tracing few rays at a time costs more than tracing many.
    passed = passing(np.broadcast_to(radius, steps.shape), origin[:, None] + steps * direction[:, None])
    last = len(steps) - 1 - np.argmax(passed[::-1], axis=0)
    found = np.flatnonzero(passed.any(0))
    low, high = steps[0].copy(), steps[np.minimum(last + 1, len(steps) - 1), np.arange(radius.size)]
    low[found] = steps[last[found], found]
    radius, origin, direction = radius[found], origin[:, found], direction[:, found]
    a, b = low[found], high[found]
    for _ in range(halvings):
        middle = (a + b) / 2
        now = passing(radius, origin + middle * direction)
        a, b = np.where(now, middle, a), np.where(now, b, middle)
    low[found] = b
    return low


def _equal_areas(angles: Array, distance: Array, segments: int) -> Array:
    """Return angles [R, segments + 1] between which the outline, given by its distance at `angles`, has equal areas."""
    wedges = distance[:, 1:] * distance[:, :-1] + 1e-9
    area = np.concatenate([np.zeros((len(angles), 1)), np.cumsum(wedges, axis=1)], axis=1)
    wanted = np.linspace(0, 1, segments + 1)
    return np.stack([np.interp(wanted * a[-1], a, t) for a, t in zip(area, angles, strict=True)])


def _together(distance: Array, shares: tuple[float, ...]) -> Array:
    """Return distances at both ends of the spectrum, from those [W, R, D] at shares of it.

    Where the distances of a row differ much, both ends get the largest.

    At the edge of the light, lateral colour leaves some wavelengths dark before others.
    """
    if len(distance) == 1:
        return distance
    joined = distance.max(0, keepdims=True)
    area, whole = ((d[..., 1:] * d[..., :-1]).sum(2) for d in (distance, joined))
    apart = (area < _APART * whole).any(0)
    for share, found in zip(shares, distance, strict=True):
        apart |= (found > _BULGE * ((1 - share) * distance[0] + share * distance[-1])).any(1)
    return np.where(apart[:, None], joined, distance[[0, -1]])


def _pushed_out(
    outline: PupilOutline, passes: Passes, shares: tuple[float, ...], report: Callable[[float], object]
) -> PupilOutline:
    """Return the outline, moved outwards until it holds what passes between rows, vertices and wavelengths."""
    needed = np.ones(outline.x.shape)
    both = len(outline.wavelength_nm) > 1
    for done, share in enumerate(shares if both else (0.0,)):
        report(done / len(shares))
        passing = pass_test(passes, (wavelength_between(outline.wavelength_nm, share),))
        ends = {0.0: slice(0, 1), 1.0: slice(-1, None)}.get(share, slice(None))
        x, y = ((1 - share) * c[0].astype(np.float64) + share * c[-1] for c in (outline.x, outline.y))
        for step, found in _excess(outline, (x, y), passing):
            _keep_largest(needed[ends], found, step)
    scale = (needed + _HAIR).astype(np.float32)
    return replace(outline, x=outline.x * scale, y=outline.y * scale)


def _excess(outline: PupilOutline, vertices: tuple[Array, Array], passing: PassTest) -> list[tuple[float, Array]]:
    """Return how far passing rays reach between rows and vertices, as shares [rows, edges] of the outline.

    Each comes with its place's part of the step between rows.
    """

    def between(c: Array, step: float) -> Array:
        return (1 - step) * c[:-1] + step * c[1:] if step else c

    centres, rows = outline.centre.astype(np.float64), np.arange(outline.centre.size, dtype=np.float64)
    parts = []
    for step in _BETWEEN_ROWS:
        x, y = (between(c, step) for c in vertices)
        for t in _ALONG_EDGE:
            point = np.stack([(1 - t) * c[:, :-1] + t * c[:, 1:] for c in (x, y)])
            parts.append(_flat(outline.radii(between(rows, step)), between(centres, step), point))
    radius, origin, direction = (np.concatenate(c, axis=-1) for c in zip(*parts, strict=True))
    steps = np.repeat(np.array(_CHECKS)[:, None], radius.size, axis=1)
    found = _farthest(passing, radius, origin, direction, steps, _CHECK_HALVINGS)
    edges = vertices[0].shape[1] - 1
    shares = np.split(found, np.cumsum([len(part[0]) for part in parts])[:-1])
    steps_between = np.repeat(_BETWEEN_ROWS, len(_ALONG_EDGE))
    return [(step, share.reshape(-1, edges)) for step, share in zip(steps_between, shares, strict=True)]


_LEANS, _LEAN_HALVINGS = np.linspace(0.5, 1.5, 11), 10  # where leaning outlines are sought, over upright ones


def leaning(outline: PupilOutline, passes: Passes, reach: float) -> PupilOutline:
    """Return the outline for a turned film (`PupilOutline.lean`); it, too, holds all rays that pass.

    A ray of lean k with the central place c crosses the film plane of the outline at c + k q, for a point q of the
    pupil. Each vertex is sought again at both ends of k, and moves linearly between.

    Args:
        outline: of the upright film. passes: see `outline_of`. reach: the largest k.
    """
    vertices = outline.x.astype(np.float64), outline.y.astype(np.float64)
    rows = np.arange(outline.centre.size, dtype=np.float64)

    def tested(lean: float, nm: float) -> PassTest:
        return pass_test(lambda film, pupil, nm: passes(film + np.float32(lean) * pupil, pupil, nm), (nm,))

    direction = np.stack([c[0] for c in vertices])
    flat = _flat(outline.radii(rows), outline.centre.astype(np.float64), direction)
    steps = np.repeat(_LEANS[:, None], flat[0].size, axis=1)
    ends = [
        _farthest(tested(k, outline.wavelength_nm[0]), *flat, steps, _LEAN_HALVINGS).reshape(direction.shape[1:])
        for k in (-reach, reach)
    ]
    lean = (ends[1] - ends[0]) / (2 * reach)
    needed = np.ones(vertices[0].shape[1:])
    for nm, *upright in zip(outline.wavelength_nm, *vertices, strict=True):
        for k in (-reach, -reach / 2, reach / 2, reach):
            x, y = (c + k * lean * first for c, first in zip(upright, direction, strict=True))
            for step, found in _excess(outline, (x, y), tested(k, nm)):
                _keep_largest(needed, found, step)
    wider = (needed + _HAIR).astype(np.float32)
    return replace(outline, x=outline.x * wider, y=outline.y * wider, lean=lean.astype(np.float32))


def _keep_largest(needed: Array, found: Array, step: float) -> None:
    """Raise the needs of vertices [..., R, K + 1] to what was found [rows, edges] beside them.

    `step` is the place between rows at which it was found.
    """
    rows = len(found)
    for row in (slice(0, rows), slice(1, 1 + rows)) if step else (slice(0, rows),):
        for edge in (slice(0, -1), slice(1, None)):
            needed[..., row, edge] = np.maximum(needed[..., row, edge], found)
