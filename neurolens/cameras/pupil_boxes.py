"""Boxes on the pupil plane that hold the rays that pass a lens, by film radius: what a model's card carries.

Lattices on them tell roughly where light passes: they tighten boxes, and find the end of the light on the film.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.surrogates.card import pupil_rows

# Halvings that place the end of the light; lattice on a box that looks for light.
_END_HALVINGS = 10
_COARSE_LATTICE = (40, 20)

# Whether light of a wavelength in nm passes from film points [2, N] through pupil points [2, N], both mm: bool [N].
Passes = Callable[[FloatArray, FloatArray, float], NDArray[np.bool_]]
Float64Array = NDArray[np.float64]
# Whether rays pass from film points (radius, 0) through points [2, ...]; the radius broadcasts with the points.
Ask = Callable[[Float64Array, Float64Array], NDArray[np.bool_]]


@dataclass(frozen=True)
class PupilTable:
    """Boxes on the pupil plane that hold the passing rays of film points at equally spaced radii.

    For a film point at radius r along +x, passing rays lie within low <= u <= high along +x and |v| <= half across.

    Attributes:
        pupil_z_mm: the plane.
        film_radius_mm: radius of the last row; the first row is the axis.
        rows: [3, R]: low, high, half; low > high where nothing passes.
    """

    pupil_z_mm: float
    film_radius_mm: float
    rows: FloatArray

    @staticmethod
    def of(bounds: Mapping[str, Any]) -> PupilTable:
        """From the fields of `setting.pupils.PupilBounds`, as a model's card holds them."""
        return PupilTable(float(bounds["pupil_z_mm"]), float(bounds["film_radius_mm"]), pupil_rows(bounds))


@np.errstate(over="ignore", invalid="ignore")  # of boxes near the end of float32 nothing passes
def tightened(
    table: PupilTable, passes: Passes, wavelength_nm: Sequence[float], lattice: tuple[int, int] = (96, 48)
) -> PupilTable:
    """The same rows with boxes cut to what passes now at any of the wavelengths, for example through a closed stop.

    Bounds move on a lattice of the table's own boxes, along and across one half, one step wider than what passes: the
    boundary lies between two points.
    """
    low, high, half = (a[:, None] for a in table.rows)
    count = table.rows.shape[1]
    u, v = (np.linspace(0, 1, n, dtype=np.float32) for n in lattice)
    radius = table.film_radius_mm * np.minimum(np.arange(count) / (count - 1), 1 - 1e-6)
    along, across = low + (high - low) * u, half * v
    shape = (2, count, *lattice)
    film, pupil = np.zeros(shape, np.float32), np.empty(shape, np.float32)
    film[0] = radius[:, None, None]
    pupil[0], pupil[1] = along[:, :, None], across[:, None, :]
    passed = passes_any(passes, film.reshape(2, -1), pupil.reshape(2, -1), wavelength_nm).reshape(shape[1:])
    passed &= (low <= high)[:, :, None]
    boxes = np.tile(np.array([[1], [-1], [0]], np.float32), count)
    for k in np.flatnonzero(passed.any((1, 2))):
        columns, lines = np.flatnonzero(passed[k].any(1)), np.flatnonzero(passed[k].any(0))
        boxes[:, k] = (
            along[k, max(columns[0] - 1, 0)],
            along[k, min(columns[-1] + 1, len(u) - 1)],
            across[k, min(lines[-1] + 1, len(v) - 1)],
        )
    return replace(table, rows=_with_neighbours(boxes))


def passes_any(
    passes: Passes, film: FloatArray, pupil: FloatArray, wavelength_nm: Sequence[float]
) -> NDArray[np.bool_]:
    """Whether rays of film points [2, N] through pupil points [2, N] pass at any of the wavelengths."""
    passed = np.zeros(film.shape[1], bool)
    for wavelength in wavelength_nm:
        left = np.flatnonzero(~passed)
        passed[left] = passes(film[:, left], pupil[:, left], wavelength)
    return passed


def _with_neighbours(boxes: FloatArray) -> FloatArray:
    """Every box joined with the boxes of the film radii next to it."""
    low = np.where(boxes[0] <= boxes[1], boxes[0], np.inf)
    high = np.where(boxes[0] <= boxes[1], boxes[1], -np.inf)
    padded = [np.pad(a, 1, constant_values=c) for a, c in ((low, np.inf), (high, -np.inf), (boxes[2], 0.0))]
    low, high, half = (
        f([a[:-2], a[1:-1], a[2:]], axis=0) for f, a in zip((np.min, np.max, np.max), padded, strict=True)
    )
    empty = low > high
    return np.stack([np.where(empty, 1, low), np.where(empty, -1, high), half]).astype(np.float32)


class Frame(NamedTuple):
    """For each row [R]: film radius, centre of the polygon, half widths along and across [2, R], and farthest reach.

    Directions and the reach are those of a frame in which the region is about as wide as it is high.
    """

    radius: Float64Array
    centre: Float64Array
    stretch: Float64Array
    reach: Float64Array


def asking(passes: Passes, wavelength_nm: Sequence[float]) -> Ask:
    """The question whether rays pass at any of the wavelengths."""

    def ask(radius: Float64Array, points: Float64Array) -> NDArray[np.bool_]:
        film = np.zeros(points.shape, np.float32)
        film[0] = radius
        flat = film.reshape(2, -1), points.astype(np.float32).reshape(2, -1)
        return passes_any(passes, *flat, wavelength_nm).reshape(points.shape[1:])

    return ask


def end_of_light(table: PupilTable, ask: Ask) -> float | None:
    """The largest film radius, within those of the table, from which a ray is found to pass."""
    last = table.rows.shape[1] - 1
    lit, dark = None, None
    for place in np.minimum(np.flatnonzero(table.rows[0] <= table.rows[1]), last * (1 - 1e-6))[::-1]:
        # The rows of the table hold their neighbours, so the last of them may be dark.
        seen = _seen(_boxes(table, place[None]), table.film_radius_mm * place / last, ask)
        if seen is not None:
            lit = place
            break
        dark = place
    if lit is None or seen is None:
        return None
    for _ in range(_END_HALVINGS if dark is not None else 0):
        middle = (lit + dark) / 2
        # What is left of the pupil mostly lies in what was left before: a lattice there finds smaller regions.
        radius = table.film_radius_mm * middle / last
        left = _seen(seen, radius, ask)
        if left is None:
            left = _seen(_boxes(table, middle[None]), radius, ask)
        if left is None:
            dark = middle
        else:
            lit, seen = middle, left
    return float(table.film_radius_mm * lit / last) if lit > 0 else None


def _seen(box: Float64Array, radius: float, ask: Ask) -> Float64Array | None:
    """The box [3, 1] about what passes of a lattice on a box, a step wider, or None where nothing does."""
    passed, (x, y) = _lattice(box, np.array([radius]), ask)
    if not passed.any():
        return None
    x, y, (low, high, half) = x[passed], y[passed], box[:, 0]
    step, rise = (high - low) / _COARSE_LATTICE[0], half / _COARSE_LATTICE[1]
    return np.array([[x.min() - step], [x.max() + step], [y.max() + rise]])


def _boxes(table: PupilTable, place: Float64Array) -> Float64Array:
    """[3, M] low, high and half width that hold what passes at fractional rows of the table."""
    low, high, half = table.rows.astype(np.float64)
    empty = low > high
    low, high = np.where(empty, np.inf, low), np.where(empty, -np.inf, high)
    a = np.minimum(place.astype(np.intp), low.size - 1)
    b = np.minimum(a + 1, low.size - 1)
    return np.stack([np.minimum(low[a], low[b]), np.maximum(high[a], high[b]), np.maximum(half[a], half[b])])


def _lattice(boxes: Float64Array, radius: Float64Array, ask: Ask) -> tuple[NDArray[np.bool_], Float64Array]:
    """Which points of lattices on boxes [3, M] pass from film radii [M], [M, A, B], and the points, [2, M, A, B]."""
    low, high, half = boxes
    u, v = ((np.arange(n) + 0.5) / n for n in _COARSE_LATTICE)
    points = np.empty((2, radius.size, *_COARSE_LATTICE))
    points[0] = low[:, None, None] + (high - low)[:, None, None] * u[:, None]
    points[1] = half[:, None, None] * v
    return ask(radius[:, None, None], points), points


def frame_of(table: PupilTable, radius: Float64Array, ask: Ask) -> Frame:
    """Centroid and extent of what passes at each film radius, from a lattice."""
    place = radius / table.film_radius_mm * (table.rows.shape[1] - 1)
    low, high, half = boxes = _boxes(table, place)
    passed, (x, y) = _lattice(boxes, radius, ask)
    count = passed.sum((1, 2))
    centre = np.where(passed, x, 0).sum((1, 2)) / np.maximum(count, 1)
    low = np.where(passed, x, np.inf).min((1, 2)) - (high - low) / _COARSE_LATTICE[0]
    high = np.where(passed, x, -np.inf).max((1, 2)) + (high - low) / _COARSE_LATTICE[0]
    half = np.where(passed, y, 0).max((1, 2)) + half / _COARSE_LATTICE[1]
    # A row whose lattice misses a small region takes what its neighbours have.
    rows, found = np.arange(radius.size), count > 0
    centre, low, high, half = (np.interp(rows, rows[found], a[found]) for a in (centre, low, high, half))
    stretch = np.stack([(high - low) / 2, half])
    off_centre = np.abs(centre - (low + high) / 2) / stretch[0]
    return Frame(radius, centre, stretch, 1.05 * np.hypot(1 + off_centre, 1))
