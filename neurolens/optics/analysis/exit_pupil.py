"""Where and how light leaves a lens: the pupil function of an object point, fitted to its rays.

The exit pupil of a point is a part of the plane of direction cosines (L, M) in which its rays meet the film: the part
that the stop's blades or mask and every rim leave open, as traced for this point. There it has the light per area and
the wavefront W: the mixed characteristic, whose slopes are the aberrations of the rays, dW/dL = -x, dW/dM = -y (Born
and Wolf, section 4.1). All are polynomials fitted to a few thousand traced rays, so that they are known everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.linalg import cho_solve  # type: ignore[import-untyped]

from neurolens.optics.analysis.fields import on_plane
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.rays import Rays, trace

Array = NDArray[np.floating[Any]]

_DEGREE = 14  # of the polynomials
_FEWEST = 240  # the fewest rays for their 120 terms
# Rays up to so many radii of a rim count for the polynomials. For the wavefront those beyond it weigh little: they
# steady it at the edge, but what steep aspheres do to them there is no part of the pupil. With full weight up to 1.15
# radii they moved the wavefront of an aspheric 16 mm f/1.4 by 0.2 waves.
_BEYOND, _OUTSIDE = 1.05, 0.03
# Slopes of Chebyshev series from the series.
_STEEP = np.pad(chebyshev.chebder(np.eye(_DEGREE + 1)), [(0, 1), (0, 0)])
# Lines at Gauss's nodes run through a cell that an edge crosses, from its side with most light to the other one. By
# powers of the lit part of each: what the nine middles about the cell weigh in sums over it, exact for parabolas.
_NODES, _SHARES = (a / 2 for a in np.polynomial.legendre.leggauss(3))
_GROWN = np.array([[3 / 8, -1 / 2, 1 / 6], [3 / 4, 1 / 2, -1 / 3], [-1 / 8, 0, 1 / 6]])
_NEAR = np.stack([_NODES * (_NODES - 1) / 2, 1 - _NODES**2, _NODES * (_NODES + 1) / 2]) * _SHARES
_MOMENTS = np.einsum("pn,qk->nkpq", _GROWN, _NEAR).reshape(-1, 9).astype(np.float32)
# The four corners as seen from each side of a cell, and which of them are on it.
_CORNERS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [0, 2, 1, 3], [2, 0, 3, 1]])
_ON = np.array([[k in side[::2] for side in _CORNERS] for k in range(4)], np.float32)
# Begins of lines, and ways along them.
_LINES = [np.kron([0.5 - _NODES, 0.5 + _NODES], way).astype(np.float32) for way in ([[1], [0]], [[-1], [1]])]
_HALVINGS = 6  # of a line, to find where a blade or a mask ends its lit part
_ROOM = 1.1  # the box of cosines over the rays that pass, between which edges lie
_FLAT = 1e-6  # a beam of less half width, in cosines, does not meet on the film


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
        limits_mm: radii of those surfaces. The stop is the first. The last of a traced pupil is no surface, but the
            ellipse about its rays (`_ellipse_about`).
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

    @cached_property
    def blur_mm(self) -> float:
        """Return the greatest distance of a ray from the centre on the film."""
        return float(np.hypot(*self.hits_mm).max())

    @cached_property
    def blurs_mm(self) -> Array:
        """Return the greatest distance [2] of a ray from the centre along x and y on the film."""
        return np.asarray(np.abs(self.hits_mm).max(1))

    def passes(self, places: Array | tuple[Array, ...]) -> NDArray[np.bool_]:
        """Whether light passes at points [2, N] of the box (-1 to 1); a tuple of two axes stands for their grid."""
        at = self._at(places, slice(2, None))
        at = at.reshape(len(self.limits_mm), 2, *at.shape[1:])
        return _lets(self.aperture, (at.T / self.limits_mm).T)[0]

    def field(self, places: Array | tuple[Array, ...]) -> NDArray[np.complex64]:
        """Return sqrt(e) exp(i k W) at points, which are as in `passes`."""
        w, e = self._at(places, slice(2))
        return phasor(w * (1e6 / self.wavelength_nm), np.sqrt(np.maximum(e, 0)))

    def perfect(self) -> ExitPupil:
        """Return the pupil without aberrations: all its light goes to the film point from which x and y are counted."""
        figures = self.figures.copy()
        figures[..., 0] = 0
        return replace(self, figures=figures, centre_mm=np.zeros(2), hits_mm=np.zeros((2, 1)))

    def hits(self, places: Array | tuple[Array, ...]) -> Array:
        """Return where the rays of points, which are as in `passes`, meet the film: [2, ...] in mm from the centre."""
        return summed(slopes([self])[0], places)

    def _at(self, places: Array | tuple[Array, ...], rows: slice) -> Array:
        """Return the figures [K, ...] at points, which are as in `passes`."""
        return summed(np.moveaxis(self.figures[..., rows], -1, 0), places)


def summed(figures: Array, places: Array | tuple[Array, ...]) -> Array:
    """Return Chebyshev series [..., D, D] at points, as in `ExitPupil.passes`, in the precision of the figures."""
    if isinstance(places, tuple):
        u, v = (_on_line(p.tobytes()).astype(figures.dtype) for p in places)
        return np.asarray(u @ figures @ v.T)
    u, v = (chebyshev.chebvander(p, _DEGREE) for p in places)
    return np.asarray(((u @ figures) * v).sum(-1))


def slopes(pupils: Sequence[ExitPupil]) -> Array:
    """Return the series [W, 2, D, D] of where the rays of pupils meet the film, in mm from their centres."""
    wave = np.stack([p.figures[..., 0] for p in pupils])
    return -np.stack([_STEEP @ wave, wave @ _STEEP.T], 1) / np.array([p.half for p in pupils])[..., None, None]


def open_shares(pupils: Sequence[ExitPupil], cells: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the share [W, *cells] of each cell of the box that light passes, by the pupils of a place.

    Besides, what the middles of the cells weigh in sums over the open pupil, [W, *cells]: each part of a cell counts
    for the nine middles about it, so that parabolas are summed exactly. Edges are found on lines through their cells,
    along which places at the rims are linear.
    """
    aperture, rims = pupils[0].aperture, max(len(p.limits_mm) for p in pupils)
    # The stop, which comes first, stands again for rims that only other wavelengths have.
    lack = [rims - len(p.limits_mm) for p in pupils]
    limits = np.array([p.limits_mm + p.limits_mm[:1] * k for p, k in zip(pupils, lack, strict=True)])
    kept = [[*range(2, 2 + 2 * (rims - k)), *[2, 3] * k] for k in lack]
    series = np.array([p.figures.take(k, -1) for p, k in zip(pupils, kept, strict=True)], np.float32)
    series /= limits.repeat(2, 1)[:, None, None]
    at = summed(series.transpose(3, 0, 1, 2), tuple(np.linspace(-1, 1, n + 1) for n in cells))
    at = at.reshape(rims, 2, *at.shape[1:])
    lit, height = _lets(aperture, at)
    bits = lit.view(np.int8)
    bits = bits[:, :-1] + 2 * bits[:, 1:]
    bits = bits[:, :, :-1] + 4 * bits[:, :, 1:]
    whole = (bits == 15).astype(np.float32)
    edge = np.flatnonzero((bits > 0) & (bits < 15))  # some of the four corners are lit, not all
    (w, i, j), wide = np.unravel_index(edge, bits.shape), cells[1] + 2
    first, steps = (w * (cells[0] + 1) + i) * (wide - 1) + j, np.array([0, wide - 1, 1, wide])
    # From the lit side; of two that are lit alike, from that where light passes farther from the rims.
    side = ((lit - 0.1 * height).reshape(-1)[first[:, None] + steps] @ _ON).argmax(1)
    corner = first[:, None] + steps[_CORNERS][side]
    ends = at.reshape(rims, 2, -1).take(corner, 2)
    cuts = ((ends * ends).sum(1).max((1, 2), initial=0) > 1) | (np.arange(rims) == 0)
    begin, way = (ends[cuts] @ line for line in _LINES)
    a, b, c = (way * way).sum(1), (way * begin).sum(1), 1 - (begin * begin).sum(1)
    part = (c / np.maximum(b + np.sqrt(np.maximum(b * b + a * c, 0)), 1e-12)).min(0).clip(0, 1)
    if aperture is not None:
        known = 0 * part
        for _ in range(_HALVINGS):
            part = part / 2
            x, y = begin[0] + (known + part) * way[0]
            known += part * aperture.inside(x, y, 1.0)
        part = known + part / 2
    given = np.concatenate([part, part * part, part * part * part], 1) @ _MOMENTS
    about = np.add.outer(np.arange(3) * wide, np.arange(3))
    about = np.stack([about, about[::-1], about.T, about.T[::-1]]).reshape(4, 9)
    place = ((w * (cells[0] + 2) + i) * wide + j)[:, None] + about[side]
    shape = len(pupils), cells[0] + 2, wide
    edges = np.bincount(place.reshape(-1), given.reshape(-1), math.prod(shape)).reshape(shape)[:, 1:-1, 1:-1]
    weight = _nearby(_nearby(whole).swapaxes(1, 2)).swapaxes(1, 2) + edges.astype(np.float32)
    whole.reshape(-1)[edge] = given @ np.ones(9, np.float32)
    return whole, weight


def _nearby(whole: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what the middles [W, N, M] weigh for cells that are whole, along their lines."""
    before, own, after = _GROWN.sum(1).astype(np.float32)
    found = own * whole
    found[:, :-1] += before * whole[:, 1:]
    found[:, 1:] += after * whole[:, :-1]
    return np.asarray(found)


def _lets(aperture: Aperture | None, at: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return whether light passes, from its places at rims [K, 2, ...] in units of their radii; how near a rim it is.

    The second is the square of the height at the rim that it is nearest to, in these units.
    """
    height = (at * at).sum(1).max(0)
    lit = np.asarray(height <= 1)
    if aperture is not None:
        lit[lit] = aperture.inside(at[0, 0][lit], at[0, 1][lit], 1.0)
    return lit, height


def phasor(cycles: Array, amplitude: Array | float = 1.0) -> NDArray[np.complex64]:
    """Return amplitude exp(2 pi i cycles): parts of a cycle are taken before they are rounded."""
    angle = ((cycles - np.rint(cycles)) * (2 * math.pi)).astype(np.float32, copy=False)
    found = np.empty(angle.shape, np.complex64)
    found.real, found.imag = np.cos(angle) * amplitude, np.sin(angle) * amplitude
    return found


@lru_cache(maxsize=64)
def _on_line(places: bytes) -> Array:
    """Return the Chebyshev polynomials [N, D] at places, which most pupils have in common."""
    return np.asarray(chebyshev.chebvander(np.frombuffer(places), _DEGREE))


class Arrived(NamedTuple):
    """N rays through the whole lens without its rims, on the film.

    Attributes:
        cosines, hits: [2, N] directions and places (mm) on the film. at: [S, 2, N] x and y in mm at each surface.
        power: [N] share of unpolarised light that arrives. exists: [N] False where a ray is lost.
        limits_mm: [S] radii of the surfaces. stop: the number of the stop among them.
    """

    cosines: Array
    hits: Array
    at: Array
    power: Array
    exists: NDArray[np.bool_]
    limits_mm: Array
    stop: int


def arrived(lens: Lens, rays: Rays, wavelength_nm: torch.Tensor | float) -> Arrived:
    """Trace rays from before the lens, whose film is placed, to the film."""
    every = range(len(lens.surfaces))
    with torch.no_grad():
        found = trace(without_rims(lens), rays, wavelength_nm, towards="film", transmittance=True, record=every)
    film = on_plane(found.rays, float(lens.film_z_mm or 0.0))
    assert found.transmittance is not None
    at = np.stack([np.stack([found.crossings[k].x.numpy(), found.crossings[k].y.numpy()]) for k in every])
    cosines, hits = (np.stack([a.numpy(), b.numpy()]) for a, b in ((film.dx, film.dy), (film.x, film.y)))
    limits = np.array([s.semi_diameter_mm for s in lens.surfaces])
    return Arrived(cosines, hits, at, found.transmittance.numpy(), found.status.numpy() == 0, limits, lens.stop_index)


def fitted_pupil(
    aperture: Aperture | None, rays: Arrived, places: Array, energy: Array | float, wavelength_nm: float,
    like: ExitPupil | None = None, box: Array | None = None,
) -> ExitPupil | None:  # fmt: skip
    """Fit the exit pupil to rays; None where too few arrive, or the rays meet nowhere (a pinhole, a plate).

    Args:
        aperture: shape of the stop; None is round.
        places: [2, N] of the rays on a surface before the lens. energy: of the rays, per area of those places.
        like: the pupil of another wavelength, whose boxes are taken.
    """
    limits = rays.limits_mm
    part = np.hypot(rays.at[:, 0], rays.at[:, 1]) / limits[:, None]  # relative to the rim's radius, at each surface
    near = rays.exists & (part.max(0) < _BEYOND)
    inside = near & (part.max(0) <= 1)
    if inside.sum() < 16 or near.sum() < _FEWEST:
        return None
    cosines = rays.cosines
    low, high = cosines[:, inside].min(1), cosines[:, inside].max(1)
    middle, half = ((low + high) / 2, _ROOM * (high - low) / 2) if like is None else (like.middle, like.half)
    if not half.min() > _FLAT:
        return None
    through = inside.copy()
    if aperture is not None:
        through &= aperture.inside(rays.at[rays.stop, 0], rays.at[rays.stop, 1], float(limits[rays.stop]))
    through = through if through.any() else inside
    centre = rays.hits[:, through].mean(1)
    every = range(len(limits))
    cut = [rays.stop, *(k for k in every if k != rays.stop and part[k, near].max() > 1)]
    known = np.ascontiguousarray((cosines[:, near] - middle[:, None]) / half[:, None])
    design = _design(known.tobytes())
    weight = np.tile(np.where(inside[near], 1.0, _OUTSIDE), 2)
    along = weight[:, None] * np.concatenate([by / side for by, side in zip(design.slopes, half, strict=True)])
    wave = _least(along[:, 1:])(-weight * (rays.hits[:, near] - centre[:, None]).reshape(-1))
    at, power = rays.at[cut][..., near].reshape(2 * len(cut), -1), (rays.power * energy)[near]
    figures = _fitted(design, half, np.array([0 * power, power, *places[:, near], *at])[:, None])[0]
    figures[_I, _J, 0] = [0, *wave]
    figures = np.concatenate([figures, _ellipse_about(known)], -1)
    hits, box = rays.hits[:, through] - centre[:, None], np.zeros((2, 2)) if box is None else box
    return ExitPupil(wavelength_nm, centre, middle, half, figures, (*limits[cut], 1.0), aperture, hits, box)


def _ellipse_about(points: Array) -> Array:
    """Return the series [D, D, 2] of two coordinates, in which the smallest ellipse about points is the unit circle.

    It is a rim of the pupil. For polynomials swing beyond the rays that they were fitted to, and may let light pass.

    Args:
        points: [2, N] of the box.
    """
    share, found = np.full(points.shape[1], 1 / points.shape[1]), np.zeros((_DEGREE + 1, _DEGREE + 1, 2))
    for _ in range(20):  # Titterington's way to the smallest ellipse: points far out come to weigh more
        middle = points @ share[:, None]
        round_ = np.linalg.inv(np.linalg.cholesky((points - middle) * share @ (points - middle).T))
        apart = ((round_ @ (points - middle)) ** 2).sum(0)
        share = share * (apart + 1) / 3
    round_ /= math.sqrt(apart.max())
    found[[0, 1, 0], [0, 0, 1]] = np.column_stack([-round_ @ middle, round_]).T
    return found


def fitted_waves(
    aperture: Aperture | None, wavelengths_nm: Sequence[float], box: tuple[Array, Array, Array], points: Array,
    near: NDArray[np.bool_], rows: Array, limits_mm: Array,
) -> list[ExitPupil | None] | None:  # fmt: skip
    """Fit the exit pupils of one film place to rays in the same directions, of which the wavefront is known.

    Args:
        aperture: as in `fitted_pupil`.
        box: the place, the middle of the box of cosines and its half sides, [2] each.
        points: [2, N] of the box in which rays come. near: [N] which of them count.
        rows: [R, W, N] the wavefront (mm) about the place, light per area, x and y on a surface before the lens, then x
            and y in mm at the stop and at the rims, whose radii are `limits_mm`.
    """
    part = (rows[4::2] ** 2 + rows[5::2] ** 2) / limits_mm[:, None, None] ** 2
    inside = near & (part.max(0) <= 1)
    if inside.sum(1).min() < 16 or near.sum() < _FEWEST:
        return None
    place, middle, half = box
    used = slice(None) if near.all() else near
    cut = [k for k in range(len(limits_mm)) if k == 0 or part[k][:, used].max() > 1]
    kept = [*range(4), *(4 + 2 * k + way for k in cut for way in (0, 1))]
    design = (_common if near.all() else _design)(points[:, used].tobytes())
    rows, inside = rows[kept][:, :, used], inside[:, used]
    rows[0] -= rows[0, :, :1]  # paths are long
    if aperture is not None:
        left = inside & aperture.inside(rows[4], rows[5], float(limits_mm[0]))
        inside = np.where(left.any(1, keepdims=True), left, inside)
    figures = _fitted(design, half, rows)
    every = -(design.slopes @ figures[:, _I, _J, 0].T / half[:, None, None]).transpose(2, 0, 1)
    centres = (every * inside[:, None]).sum(2) / inside.sum(1)[:, None]
    figures[:, [1, 0], [0, 1], 0] += half * centres
    every, limits, nowhere = every - centres[..., None], tuple(limits_mm[cut]), np.zeros((2, 2))
    found: list[ExitPupil | None] = [
        ExitPupil(nm, place + centre, middle, half, own, limits, aperture, hits[:, through], nowhere)
        for nm, centre, own, hits, through in zip(wavelengths_nm, centres, figures, every, inside, strict=True)
    ]
    return found


def _fitted(design: _Design, half: Array, rows: Array) -> Array:
    """Return `ExitPupil.figures` [W, D, D, K] by least squares to rays at points of the box.

    The light per area of cosines has the derivatives of the points on the disc.

    Args:
        rows: [R, W, N] the wavefront, power, x and y on the disc, x and y at rims.
    """
    waves, count = rows.shape[1:]
    found = design.solved(rows.reshape(-1, count).T).reshape(-1, len(rows), waves)
    steep = design.slopes @ found[:, 2:4].reshape(len(found), -1)
    (au, bu), (av, bv) = steep.reshape(2, count, 2, waves).transpose(0, 2, 3, 1)
    found[:, 1] = design.solved((rows[1] * np.abs(au * bv - av * bu) / half.prod()).T)
    figures = np.zeros((waves, _DEGREE + 1, _DEGREE + 1, len(rows) - 2))
    figures[:, _I, _J] = found[:, [0, 1, *range(4, len(rows))]].transpose(2, 0, 1)
    return figures


_APART = 1e-7  # the least share of the largest pivot that a sound fit has
_I, _J = np.nonzero(np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE)  # degrees of the terms


class _Design(NamedTuple):
    """Polynomials at N points: their slopes [2, N, M] by u and v, and the function that fits them to values."""

    slopes: Array
    solved: Callable[[Array], Array]


@lru_cache(maxsize=64)
def _common(places: bytes) -> _Design:
    """Return the design of points that many pupils have: the fit is one product of matrices."""
    design = _design(places)
    return design._replace(solved=design.solved(np.eye(design.slopes.shape[1])).__matmul__)


def _design(places: bytes) -> _Design:
    """Return the design of points [2, N]."""
    # Chebyshev polynomials of each coordinate, and their slopes.
    value = [chebyshev.chebvander(p, _DEGREE) for p in np.frombuffer(places).reshape(2, -1)]
    slope = [v @ _STEEP for v in value]

    def products(a: Array, b: Array) -> Array:
        return a[:, _I] * b[:, _J]

    slopes = np.stack([products(slope[0], value[1]), products(value[0], slope[1])])
    return _Design(slopes, _least(products(*value)))


def _least(a: Array) -> Callable[[Array], Array]:
    """Return a function that solves a x = b for any b by least squares.

    The normal equations take a fraction of the time of a QR decomposition; a second step on what the first leaves
    restores the digits that they lose. Where the rays that pass fill too little of the box to tell all polynomials
    apart, they would lose all digits, and the smallest solution is found by singular values.
    """
    factor, failed = torch.linalg.cholesky_ex(torch.from_numpy(a.T @ a))
    if failed or factor.diagonal().min() < _APART * factor.diagonal().max():
        return lambda b: np.linalg.lstsq(a, b, rcond=None)[0]

    def solved(b: Array) -> Array:
        first = cho_solve((factor.numpy(), True), a.T @ b, check_finite=False)
        return np.asarray(first + cho_solve((factor.numpy(), True), a.T @ (b - a @ first), check_finite=False))

    return solved
