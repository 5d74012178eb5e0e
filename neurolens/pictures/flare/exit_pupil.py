"""Where and how a light's rays leave a lens, and the outline of the opening through which they leave.

The exit pupil of a light is a part of the plane of direction cosines (L, M) in which its rays meet the film: the part
that the stop's blades or mask and every rim leave open, as traced for this light. There it has the light per area and
the wavefront W: the mixed characteristic, whose slopes are the aberrations of the rays, dW/dL = -x, dW/dM = -y (Born
and Wolf, section 4.1). All are polynomials fitted to a few thousand traced rays, so that they are known everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from contourpy import contour_generator
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.optics.analysis.fields import on_plane
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.rays import Rays, passing, trace
from neurolens.pictures.flare.lights import Light, Patch, disc, light_towards, rays_across

Array = NDArray[np.floating[Any]]

CELLS = 1024  # cells across the pupil
_SEARCH, _BOX = 1 << 16, 48  # rays that find where light passes; rays along a side, for the polynomials
_DEGREE = 14  # of the polynomials
_FEWEST = 240  # the fewest rays for their 120 terms
_BEYOND = 1.15  # rays up to so many radii of a rim count for the polynomials
_FLAT = 1e-6  # a beam of less half width, in cosines, does not meet on the film
_BENT = 0.1  # sine of the smallest angle that counts as a corner


@dataclass(frozen=True)
class ExitPupil:
    """Where and how the light of one direction and wavelength leaves a lens, in direction cosines at the film.

    Attributes:
        wavelength_nm: of the light.
        centre_mm: film point [2] from which x and y are counted: the mean of the rays.
        middle, half: [2] middle and half sides of the box of cosines that holds the light.
        figures: [D, D, K] Chebyshev coefficients on that box: of the wavefront W in mm, of the light per area of
            cosines in mm^2 (for an irradiance of 1 at the lens), and of x, y in mm at each surface that may cut the
            beam.
        limits_mm: radii of those surfaces; the stop is the first.
        aperture: the stop's shape.
        hits_mm: [2, N] where some of the rays meet the film, counted from the centre.
        box: the part of the disc across the light's direction that holds the rays, [2 (low, high), 2].
    """

    wavelength_nm: float
    centre_mm: Array
    middle: Array
    half: Array
    figures: Array
    limits_mm: tuple[float, ...]
    aperture: Aperture | None
    hits_mm: Array
    box: Array

    @property
    def blur_mm(self) -> float:
        """The greatest distance of a ray from the centre on the film."""
        return float(np.hypot(*self.hits_mm).max())

    def passes(self, places: Array | tuple[Array, Array]) -> NDArray[np.bool_]:
        """Whether light passes at points [2, N] of the box (-1 to 1); a tuple of two axes stands for their grid."""
        at = self._at(places, slice(2, None))
        inside = np.ones(at.shape[1:], bool)
        for x, y, limit in zip(at[::2], at[1::2], self.limits_mm, strict=True):
            inside &= x * x + y * y <= limit * limit
        if self.aperture is not None:
            inside[inside] = self.aperture.inside(at[0][inside], at[1][inside], self.limits_mm[0])
        return inside

    def field(self, places: Array | tuple[Array, Array]) -> NDArray[np.complex128]:
        """Return sqrt(e) exp(i k W) at points, which are as in `passes`."""
        w, e = self._at(places, slice(2))
        return np.sqrt(np.maximum(e, 0)) * np.exp(2e6j * math.pi / self.wavelength_nm * w)

    def hits(self, places: Array) -> Array:
        """Return where the rays of points [2, N] meet the film, [2, N] in mm from the centre."""
        (u, v), wave = places, self.figures[..., 0]
        return -np.stack([chebyshev.chebval2d(u, v, chebyshev.chebder(wave, axis=k)) / self.half[k] for k in (0, 1)])

    def _at(self, places: Array | tuple[Array, Array], rows: slice) -> Array:
        """Return the figures [K, ...] at points, which are as in `passes`."""
        u, v = (chebyshev.chebvander(p, _DEGREE) for p in places)
        figures = np.moveaxis(self.figures[..., rows], -1, 0)
        if isinstance(places, tuple):
            return np.asarray(u @ figures @ v.T)
        return np.stack([((u @ figure) * v).sum(1) for figure in figures])


def exit_pupil(lens: Lens, light: Light, wavelength_nm: float, like: ExitPupil | None = None) -> ExitPupil | None:
    """Return a light's exit pupil; None if no light arrives, or its rays meet nowhere (a pinhole, a plate).

    Args:
        lens: its film must be placed (`set_lens`).
        like: the pupil of another wavelength, whose boxes are taken.

    Raises:
        InputError: the lens has no film, or the light is inside the lens.
    """
    if lens.film_z_mm is None:
        raise InputError(lens.path, "film", None, "a focused lens (set_lens)")
    box = _box(lens, light, wavelength_nm) if like is None else like.box
    if box is None:
        return None
    places = _grid(box, 1.1, _BOX)
    rays, area = rays_across(lens, light, places)
    every = range(len(lens.surfaces))
    with torch.no_grad():
        found = trace(
            without_rims(lens), Rays(*torch.from_numpy(rays)), wavelength_nm, towards="film", transmittance=True,
            record=every,
        )  # fmt: skip
    film = on_plane(found.rays, lens.film_z_mm)
    assert found.transmittance is not None
    power = found.transmittance.numpy()
    cosines, hits = _pair(film.dx, film.dy), _pair(film.x, film.y)
    at = np.stack([_pair(found.crossings[k].x, found.crossings[k].y) for k in every])
    limits = np.array([s.semi_diameter_mm for s in lens.surfaces])
    part = np.hypot(at[:, 0], at[:, 1]) / limits[:, None]  # relative to the rim's radius, at each surface
    near = (found.status.numpy() == 0) & (part.max(0) < _BEYOND)
    inside = near & (part.max(0) <= 1)
    if inside.sum() < 16 or near.sum() < _FEWEST:
        return None
    low, high = cosines[:, inside].min(1), cosines[:, inside].max(1)
    middle, half = ((low + high) / 2, 0.53 * (high - low)) if like is None else (like.middle, like.half)
    if not half.min() > _FLAT:
        return None
    centre = hits[:, inside].mean(1)
    cut = [lens.stop_index, *(k for k in every if k != lens.stop_index and part[k, near].max() > 1)]
    off = hits[:, near] - centre[:, None]
    figures = _fitted(
        (cosines[:, near] - middle[:, None]) / half[:, None], half, off, places[:, near],
        power[near] * area / math.pi, at[cut][..., near].reshape(2 * len(cut), -1),
    )  # fmt: skip
    through = inside.copy()
    if lens.aperture is not None:
        through &= lens.aperture.inside(at[lens.stop_index, 0], at[lens.stop_index, 1], lens.stop_radius_mm)
    hits = (hits - centre[:, None])[:, through if through.any() else inside]
    return ExitPupil(wavelength_nm, centre, middle, half, figures, tuple(limits[cut]), lens.aperture, hits, box)


def image_moves(lens: Lens, patch: Patch, wavelength_nm: float) -> Array:
    """Return how far the image of a point moves on the film (mm) along the sides of a light's patch, [2, 2]."""
    moves = np.zeros((2, 2))
    for along, side in zip(moves, patch.sides, strict=True):
        ends = [
            light_towards(patch.light.towards + f * side, patch.light.rgb, patch.light.distance_m) for f in (-0.5, 0.5)
        ]
        pupils = [exit_pupil(lens, light, wavelength_nm) for light in ends if light is not None and side.any()]
        if len(pupils) == 2 and pupils[0] and pupils[1]:
            along[:] = pupils[1].centre_mm - pupils[0].centre_mm
    return moves


def _pair(a: Tensor, b: Tensor) -> Array:
    return np.stack([a.numpy(), b.numpy()])


def _box(lens: Lens, light: Light, wavelength_nm: float) -> Array | None:
    """Find the box [2 (low, high), 2] of passing rays on the disc across the light's direction, for a round stop."""
    lens, box = replace(lens, aperture=None), np.zeros((2, 2))
    places: Array = disc(0, _SEARCH)
    for step in (0.02, 0.05, 0.05):
        rays, _ = rays_across(lens, light, places)
        passed = passing(lens, Rays(*torch.from_numpy(rays)), wavelength_nm, towards="film").numpy()
        if not passed.any():
            return None
        box = np.stack([places[:, passed].min(1), places[:, passed].max(1)])
        box += np.array([[-1], [1]]) * (step if step < 0.05 else step / 2 * (box[1] - box[0]))
        places = _grid(box, 1.0, 64)
    return box


def _grid(box: Array, widened: float, count: int) -> Array:
    """Return points [2, count^2] of a box [2 (low, high), 2], widened by a factor."""
    share = np.linspace(-widened, widened, count)
    place = np.stack(np.meshgrid(share, share)).reshape(2, -1)
    return box.mean(0)[:, None] + (box[1] - box[0])[:, None] / 2 * place


def _fitted(places: Array, half: Array, off_mm: Array, disc_places: Array, power: Array, at_mm: Array) -> Array:
    """Fit `ExitPupil.figures` by least squares to rays at points [2, N] of the box.

    The wavefront is fitted by its slopes, the light per area of cosines by the derivatives of the points on the disc.
    """
    orders = np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE
    # Chebyshev polynomials of each coordinate, and their slopes.
    value = [chebyshev.chebvander(p, _DEGREE) for p in places]
    turn = chebyshev.chebder(np.eye(_DEGREE + 1))
    slope = [chebyshev.chebvander(p, _DEGREE - 1) @ turn for p in places]

    def products(a: Array, b: Array) -> Array:
        return (a[:, :, None] * b[:, None, :])[:, orders]

    plain, by_u, by_v = products(*value), products(slope[0], value[1]), products(value[0], slope[1])
    slopes = np.concatenate([by_u / half[0], by_v / half[1]])
    wave = _least(*np.linalg.qr(slopes[:, 1:]), -off_mm.reshape(-1))
    basis = np.linalg.qr(plain)
    mapped = _least(*basis, disc_places.T)
    (au, bu), (av, bv) = (by_u @ mapped).T / half[0], (by_v @ mapped).T / half[1]
    rest = _least(*basis, np.stack([power * np.abs(au * bv - av * bu), *at_mm], 1))
    figures = np.zeros((_DEGREE + 1, _DEGREE + 1, 1 + rest.shape[1]))
    figures[orders] = np.concatenate([np.concatenate([[0.0], wave])[:, None], rest], 1)
    return figures


def _least(q: Array, r: Array, given: Array) -> Array:
    """Return the least-squares solution by a matrix's QR decomposition."""
    return np.asarray(np.linalg.solve(r, q.T @ given))


def outline(pupil: ExitPupil) -> list[Array]:
    """Trace the edge of the opening through a grid's cells: closed lines [2, P] in the box, light on the left."""
    nodes = np.linspace(-1, 1, CELLS + 1)
    lit = pupil.passes((nodes, nodes))
    lit[[0, -1]] = lit[:, [0, -1]] = False
    # Half steps from the grid's corner. Above 0.5, a cell whose lit nodes are opposite corners keeps these apart.
    found: Any = contour_generator(z=lit.T.astype(float)).lines(0.51)
    closed = [np.rint(2 * line[:-1].T).astype(int) for line in found]
    twice = np.concatenate(closed, 1) if closed else np.zeros((2, 0), int)
    ends = twice // 2, (twice + 1) // 2  # the nodes at both ends of the grid's edge that the line crosses
    first_lit = lit[tuple(ends[0])]
    inner, outer = (nodes[np.where(first_lit == k, *ends)] for k in (True, False))
    for _ in range(24):
        middle = (inner + outer) / 2
        passed = pupil.passes(middle)
        inner, outer = np.where(passed, middle, inner), np.where(passed, outer, middle)
    cuts = np.cumsum([line.shape[1] for line in closed])[:-1]
    return [_with_corners(line) for line in np.split(inner, cuts, 1)] if closed else []


def _with_corners(line: Array) -> Array:
    """Add to a closed line through cells the corners that it cuts off, where its parts before and after a cell meet."""
    before, here, there, after = (np.roll(line, k, 1) for k in (1, 0, -1, -2))
    come, go, gap = here - before, after - there, there - here

    def cross(a: Array, b: Array) -> Array:
        return np.asarray(a[0] * b[1] - a[1] * b[0])

    turn = cross(come, go)
    bent = np.abs(turn) > _BENT * np.hypot(*come) * np.hypot(*go)
    on, back = (cross(gap, d) / np.where(bent, turn, 1) for d in (go, come))
    corner, cell = here + on * come, 2 / CELLS
    near = (np.hypot(*(corner - here)) < 2 * cell) & (np.hypot(*(corner - there)) < 2 * cell)
    beyond = (on * np.hypot(*come) > 1e-3 * cell) & (-back * np.hypot(*go) > 1e-3 * cell)
    kept = np.nonzero(bent & near & beyond)[0]
    return np.insert(line, kept + 1, corner[:, kept], axis=1)


def coverage(lines: Sequence[Array], cells: int) -> Array:
    """Return the share [cells, cells] of each cell of the box inside an outline; exact if `cells` divides `CELLS`."""
    share = np.zeros((cells + 1, cells))
    for line in lines:
        a = (line + 1) / 2 * cells
        b = np.roll(a, -1, 1)
        column, row = np.minimum(((a + b) / 2).astype(int), cells - 1)
        rise, beside = b[1] - a[1], (a[0] + b[0]) / 2 - column
        np.add.at(share, (column, row), -rise * (1 - beside))
        np.add.at(share, (column + 1, row), -rise * beside)
    return np.cumsum(share, 0)[:-1]
