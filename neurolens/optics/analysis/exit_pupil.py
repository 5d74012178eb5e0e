"""Where and how light leaves a lens: the pupil function of an object point, fitted to its rays.

The exit pupil of a point is a part of the plane of direction cosines (L, M) in which its rays meet the film: the part
that the stop's blades or mask and every rim leave open, as traced for this point. There it has the light per area and
the wavefront W: the mixed characteristic, whose slopes are the aberrations of the rays, dW/dL = -x, dW/dM = -y (Born
and Wolf, section 4.1). All are polynomials fitted to a few thousand traced rays, so that they are known everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
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
_BEYOND = 1.15  # rays up to so many radii of a rim count for the polynomials
_PARTS = 8  # of a cell along its side, where an edge crosses it
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
        """Return the greatest distance of a ray from the centre on the film."""
        return float(np.hypot(*self.hits_mm).max())

    def passes(self, places: Array | tuple[Array, Array]) -> NDArray[np.bool_]:
        """Whether light passes at points [2, N] of the box (-1 to 1); a tuple of two axes stands for their grid."""
        return self._lets(self._at(places, slice(2, None)))

    def _lets(self, at: Array) -> NDArray[np.bool_]:
        """Return whether light passes, from its places [K, ...] at the rims."""
        inside = np.ones(at.shape[1:], bool)
        for x, y, limit in zip(at[::2], at[1::2], self.limits_mm, strict=True):
            inside &= x * x + y * y <= limit * limit
        if self.aperture is not None:
            inside[inside] = self.aperture.inside(at[0][inside], at[1][inside], self.limits_mm[0])
        return inside

    def open_share(self, cells: int) -> Array:
        """Return the share [cells, cells] of each cell of the box that light passes.

        Cells on an edge are divided; places at the rims are linear between their corners.
        """
        at = self._at((np.linspace(-1, 1, cells + 1),) * 2, slice(2, None))
        lit = self._lets(at)
        corners = np.stack([lit[:-1, :-1], lit[1:, :-1], lit[:-1, 1:], lit[1:, 1:]])
        share: Array = np.array(corners.all(0), np.float64)
        i, j = edge = np.nonzero(corners.any(0) & ~corners.all(0))
        part = (np.arange(_PARTS) + 0.5) / _PARTS
        ways = [(1 - part[:, None]) * (1 - part), part[:, None] * (1 - part), (1 - part[:, None]) * part]
        ways.append(part[:, None] * part)
        ends = np.stack([at[:, i, j], at[:, i + 1, j], at[:, i, j + 1], at[:, i + 1, j + 1]], -1)
        share[edge] = self._lets(ends @ np.stack(ways).reshape(4, -1)).mean(-1)
        return share

    def field(self, places: Array | tuple[Array, Array]) -> NDArray[np.complex64]:
        """Return sqrt(e) exp(i k W) at points, which are as in `passes`."""
        w, e = self._at(places, slice(2))
        return phasor(w * (1e6 / self.wavelength_nm), np.sqrt(np.maximum(e, 0)))

    def perfect(self) -> ExitPupil:
        """Return the pupil without aberrations: all its light goes to the film point from which x and y are counted."""
        figures = self.figures.copy()
        figures[..., 0] = 0
        return replace(self, figures=figures, centre_mm=np.zeros(2), hits_mm=np.zeros((2, 1)))

    def light(self, places: Array | tuple[Array, Array]) -> Array:
        """Return the light per area of cosines (mm^2) at points, which are as in `passes`."""
        return np.asarray(np.maximum(self._at(places, slice(1, 2))[0], 0))

    def hits(self, places: Array | tuple[Array, Array]) -> Array:
        """Return where the rays of points, which are as in `passes`, meet the film: [2, ...] in mm from the centre."""
        wave, room = self.figures[..., 0], ((0, 1), (0, 0))
        slopes = [np.pad(chebyshev.chebder(wave), room), np.pad(chebyshev.chebder(wave, axis=1), room[::-1])]
        return -_summed(np.stack(slopes) / self.half[:, None, None], places)

    def _at(self, places: Array | tuple[Array, Array], rows: slice) -> Array:
        """Return the figures [K, ...] at points, which are as in `passes`."""
        return _summed(np.moveaxis(self.figures[..., rows], -1, 0), places)


def _summed(figures: Array, places: Array | tuple[Array, Array]) -> Array:
    """Return Chebyshev series [K, D, D] at points, which are as in `ExitPupil.passes`."""
    if isinstance(places, tuple):
        u, v = (_on_line(p.tobytes()) for p in places)
        return np.asarray(u @ figures @ v.T)
    u, v = (chebyshev.chebvander(p, _DEGREE) for p in places)
    return np.stack([np.einsum("nk,nk->n", u @ figure, v) for figure in figures])


def phasor(cycles: Array, amplitude: Array | float = 1.0) -> NDArray[np.complex64]:
    """Return amplitude exp(2 pi i cycles): parts of a cycle are taken before they are rounded."""
    angle = ((cycles - np.rint(cycles)) * (2 * math.pi)).astype(np.float32)
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
        wave_mm: [N] the wavefront W about `hits` [2, 1], which then are one place; None: it follows from all hits.
    """

    cosines: Array
    hits: Array
    at: Array
    power: Array
    exists: NDArray[np.bool_]
    limits_mm: Array
    stop: int
    wave_mm: Array | None = None


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
    centre = rays.hits[:, inside].mean(1) if rays.wave_mm is None else rays.hits[:, 0]
    every = range(len(limits))
    cut = [rays.stop, *(k for k in every if k != rays.stop and part[k, near].max() > 1)]
    wave = -(rays.hits[:, near] - centre[:, None]).reshape(-1) if rays.wave_mm is None else rays.wave_mm[near]
    figures = _fitted(
        (cosines[:, near] - middle[:, None]) / half[:, None], half, wave, places[:, near],
        (rays.power * energy)[near], rays.at[cut][..., near].reshape(2 * len(cut), -1),
    )  # fmt: skip
    through = inside.copy()
    if aperture is not None:
        through &= aperture.inside(rays.at[rays.stop, 0], rays.at[rays.stop, 1], float(limits[rays.stop]))
    through = through if through.any() else inside
    box = np.zeros((2, 2)) if box is None else box
    found = ExitPupil(wavelength_nm, centre, middle, half, figures, tuple(limits[cut]), aperture, np.zeros((2, 0)), box)
    if rays.wave_mm is None:
        return replace(found, hits_mm=(rays.hits - centre[:, None])[:, through])
    hits = found.hits((cosines[:, through] - middle[:, None]) / half[:, None])
    figures[1, 0, 0], figures[0, 1, 0] = (figures[1, 0, 0], figures[0, 1, 0]) + half * hits.mean(1)
    return replace(found, centre_mm=centre + hits.mean(1), hits_mm=hits - hits.mean(1, keepdims=True))


def _fitted(places: Array, half: Array, wave_mm: Array, disc_places: Array, power: Array, at_mm: Array) -> Array:
    """Fit `ExitPupil.figures` by least squares to rays at points [2, N] of the box.

    The wavefront is fitted to its values [N] or its slopes [2 N] (dW/dL, then dW/dM), the light per area of cosines by
    the derivatives of the points on the disc.
    """
    design = _design(np.ascontiguousarray(places).tobytes())
    (by_u, by_v), solved = design.slopes, design.solved
    if len(wave_mm) == places.shape[1]:
        wave = solved(wave_mm)[1:]
    else:
        wave = _least(np.concatenate([by_u / half[0], by_v / half[1]])[:, 1:])(wave_mm)
    mapped = solved(disc_places.T)
    (au, bu), (av, bv) = (by_u @ mapped).T / half[0], (by_v @ mapped).T / half[1]
    rest = solved(np.stack([power * np.abs(au * bv - av * bu), *at_mm], 1))
    figures = np.zeros((_DEGREE + 1, _DEGREE + 1, 1 + rest.shape[1]))
    figures[_ORDERS] = np.concatenate([np.concatenate([[0.0], wave])[:, None], rest], 1)
    return figures


_APART = 1e-7  # the least share of the largest pivot that a sound fit has
_ORDERS = np.nonzero(np.add.outer(np.arange(_DEGREE + 1), np.arange(_DEGREE + 1)) <= _DEGREE)


class _Design(NamedTuple):
    """Polynomials at N points: their slopes [N, M] by u and v, and the function that fits them to values."""

    slopes: tuple[Array, Array]
    solved: Callable[[Array], Array]


@lru_cache(maxsize=1)
def _design(places: bytes) -> _Design:
    """Return the design of points [2, N], which the wavelengths of a model have in common."""
    # Chebyshev polynomials of each coordinate, and their slopes.
    value = [chebyshev.chebvander(p, _DEGREE) for p in np.frombuffer(places).reshape(2, -1)]
    turn = np.pad(chebyshev.chebder(np.eye(_DEGREE + 1)), [(0, 1), (0, 0)])
    slope = [v @ turn for v in value]

    def products(a: Array, b: Array) -> Array:
        return a[:, _ORDERS[0]] * b[:, _ORDERS[1]]

    return _Design((products(slope[0], value[1]), products(value[0], slope[1])), _least(products(*value)))


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
