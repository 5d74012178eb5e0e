"""Footprints of film points: the places on the film that a camera's rays stand for, their parts, and how two differ.

The rays of a film point meet the plane across its chief ray at the distance of what it shows. The first-order map of
the exact camera takes these points back to the film, where they are its footprint, in mm: the picture of a point, seen
the other way. Any camera of the contract has one, so that all, fisheyes too, are held against the exact lens by the
same rule.

Footprints differ by the sliced Wasserstein distance of order 2 (Bonneel et al. 2015), scaled so that a shift by d is d.
It is the least RMS way by which light must move to turn one into the other, over lines through the film. It needs no
pairing of rays, and holds what a picture shows: place, size and shape of the blur, and of each wavelength by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import Camera, CameraRays

Array = NDArray[np.float64]

_LINES = 8  # directions of the sliced distance
_QUANTILES = 64
# how far outside the pupil's outline light is looked for, in pupil radii; points there
_BESIDE, _BESIDE_POINTS = 0.005, 24
_STEP = 1e-3  # step of the first-order map, as a share of the film's width


@dataclass(frozen=True)
class Places:
    """Film points with what they show, and the maps from there to the film.

    Attributes:
        film_mm: [2, N], lens frame. distance_m: [N] along the chief rays, inf allowed.
        origin_m, direction: [3, N] of the exact camera's chief rays, camera frame. across: [2, 3, N] unit vectors
            across these. to_film: [2, 2, N] from slopes against the chief ray to mm on the film.
        wavelength_nm: [W]. share: [W] of the light, with the sum 1.
    """

    film_mm: Array
    distance_m: Array
    origin_m: Array
    direction: Array
    across: Array
    to_film: Array
    wavelength_nm: Array
    share: Array

    def at(self, index: NDArray[np.intp]) -> Places:
        """Return some of the places, by number."""
        each = ("film_mm", "distance_m", "origin_m", "direction", "across", "to_film")
        return replace(self, **{name: getattr(self, name)[..., index] for name in each})


@dataclass(frozen=True)
class Footprints:
    """Rays of N places, W wavelengths and P pupil samples.

    Attributes:
        place_mm: [2, N, W, P] on the film, from the place's own film point. pupil_mm: [2, N, W, P] where rays cross the
            plane of the chief ray's origin, on the side of the scene. weight: [N, W, P]; 0 where a ray did not pass.
    """

    place_mm: Array
    pupil_mm: Array
    weight: Array

    @property
    def light(self) -> Array:
        """The film value [N] of white surroundings, averaged over wavelengths."""
        return self.weight.mean((1, 2))

    @cached_property
    def quantiles(self) -> list[Array]:
        """Places [N, W, Q] in mm at equal steps of the light, along each of some lines through the film."""
        x, y = self.place_mm
        return [_quantiles(np.cos(t) * x + np.sin(t) * y, self.weight) for t in np.arange(_LINES) * (np.pi / _LINES)]


def places_of(exact: Camera, film_mm: Array, depth_m: Array, wavelength_nm: Array, share: Array) -> Places:
    """Make places of film points [2, N] that show something at depths [N] along the axis; dark points are left out.

    Depths become distances along the exact camera's chief ray at the middle wavelength.
    """
    middle = float((wavelength_nm * share).sum())
    origin, direction, lit = _chief(exact, film_mm, middle)
    lit &= (depth_m > 0) | np.isinf(depth_m)
    film_mm, depth_m, origin, direction = film_mm[:, lit], depth_m[lit], origin[:, lit], direction[:, lit]
    with np.errstate(all="ignore"):  # a fisheye's ray across the axis meets no depth, and shows something distant
        distance = (depth_m + origin[2]) / np.maximum(-direction[2], 0.0)
    distance = np.where(np.isfinite(distance) & (distance > 0), distance, np.inf)
    first = np.cross(direction, np.where(np.abs(direction[0]) < 0.9, *np.eye(3)[:2, :, None]), axis=0)
    first /= np.linalg.norm(first, axis=0)
    across = np.stack([first, np.cross(direction, first, axis=0)])
    empty = np.zeros((2, 2, film_mm.shape[1]))
    raw = Places(film_mm, distance, origin, direction, across, empty, wavelength_nm, share)
    step, slopes = _STEP * max(exact.film_mm), []
    for moved in step * np.eye(2)[:, :, None]:
        ends = [_meet(raw, *_chief(exact, film_mm + s * moved, middle)[:2]) for s in (1.0, -1.0)]
        slopes.append((ends[0] - ends[1]) / (2 * step))
    jacobian = np.stack(slopes, axis=1).transpose(2, 0, 1)  # [N, slope, film]
    sound = np.isfinite(jacobian).all((1, 2)) & (np.abs(np.linalg.det(jacobian)) > 1e-12)
    return replace(raw.at(np.flatnonzero(sound)), to_film=np.linalg.inv(jacobian[sound]).transpose(1, 2, 0))


def footprints(camera: Camera, places: Places, samples: int = 16) -> Footprints:
    """Trace the footprints of a camera at places, by `samples` by `samples` stratified points of its pupil."""
    steps = (np.arange(samples) + 0.5) / samples
    rays, shape = _sampled(camera, places, np.stack(np.meshgrid(steps, steps)).reshape(2, -1))
    points = shape[0]
    origin, direction = (a.astype(np.float64).reshape(3, points, -1) for a in (rays.origin_m, rays.direction))
    place = np.einsum("ijn,jnk->ink", places.to_film, _meet(places, origin, direction)).reshape(2, *shape)
    from_chief, chief = origin - places.origin_m[:, :, None], places.direction[:, :, None]
    at_pupil = from_chief - (from_chief * chief).sum(0) / (direction * chief).sum(0) * direction
    across = 1e3 * np.einsum("icn,cnk->ink", places.across, at_pupil).reshape(2, *shape)
    weight = np.where(np.isfinite(place).all(0), rays.weight.astype(np.float64).reshape(shape), 0.0)
    return Footprints(np.where(weight > 0, place, 0.0), np.where(weight > 0, across, 0.0), weight)


def light_beside(camera: Camera, places: Places) -> Array:
    """Return the light [N] within half a percent of a pupil's radius outside its outline, from its density there."""
    angle = 2 * np.pi * (np.arange(_BESIDE_POINTS) + 0.5) / _BESIDE_POINTS
    edge = np.stack([np.cos(angle), np.sin(angle)])
    # the outline is continued beyond the edge of the square
    rays, shape = _sampled(camera, places, 0.5 + 0.5 * (1 + _BESIDE) * edge / np.abs(edge).max(0))
    return np.asarray(2 * _BESIDE * rays.weight.astype(np.float64).reshape(shape).mean((1, 2)))


def distance_mm(a: Footprints, b: Footprints, share: Array) -> Array:
    """Return the sliced Wasserstein distance [N] between footprints of the same places, RMS over wavelengths, in mm.

    It is NaN where one has light and the other has none.
    """
    total = np.zeros(a.weight.shape[:2])
    for of_a, of_b in zip(a.quantiles, b.quantiles, strict=True):
        total += ((of_a - of_b) ** 2).mean(-1)
    return np.asarray(np.sqrt((2 / _LINES * total * share).sum(1)))


def effects_mm(exact: Footprints, thin: Footprints, share: Array) -> dict[str, Array]:
    """Return the effects of the lens, by name: parts of the exact camera's footprints, [N] RMS mm on the film.

    A thin lens framed as the lens has the defocus of each depth. What else the exact footprint has is expanded in the
    pupil point by degree. Each part is orthogonal to those below it over the light that passes, as Zernike's
    polynomials are over a disc: coma has the tilt that balances it, spherical aberration its best focus.
    """
    (centre, by_wave), (ideal, ideal_by_wave) = centroids(exact, share), centroids(thin, share)
    (linear, parts), (plain, _) = _expanded(exact, by_wave), _expanded(thin, ideal_by_wave)
    size = _pupil_size(exact)
    mean, defocus = (np.einsum("ijnw,w->ijn", part, share) for part in (linear, plain))
    extra = mean - defocus
    focus = (extra[0, 0] + extra[1, 1]) / 2
    bent = extra - focus * np.eye(2)[:, :, None]
    colour = (linear - mean[..., None])[[0, 1], [0, 1]].mean(0)

    def over_waves(value: Array) -> Array:
        return np.sqrt((value * share).sum(-1))

    return {
        "distortion": np.hypot(*(centre - ideal)),
        "defocus": np.sqrt((defocus**2).sum((0, 1))) * size,
        "spherical aberration": over_waves(parts[1]),
        "coma": over_waves(parts[0]),
        "astigmatism": np.sqrt((bent**2).sum((0, 1))) * size,
        "field curvature": np.abs(focus) * size * np.sqrt(2),
        "higher orders": over_waves(parts[2]),
        "longitudinal colour": over_waves(colour**2) * size * np.sqrt(2),
        "lateral colour": over_waves(((by_wave - centre[:, :, None]) ** 2).sum(0)),
    }


def blur_mm(prints: Footprints, share: Array) -> Array:
    """The RMS diameter [N] of footprints in mm: twice the RMS distance from their centroid, over all wavelengths."""
    centre, _ = centroids(prints, share)
    weight = prints.weight * share[:, None]
    away = ((prints.place_mm - centre[:, :, None, None]) ** 2).sum(0)
    return np.asarray(2 * np.sqrt((weight * away).sum((1, 2)) / np.maximum(weight.sum((1, 2)), 1e-300)))


def _sampled(camera: Camera, places: Places, pupil: Array) -> tuple[CameraRays, tuple[int, int, int]]:
    """Trace rays of N places, W wavelengths and points [2, P] of the pupil's square; also return (N, W, P)."""
    shape = places.film_mm.shape[1], len(places.wavelength_nm), pupil.shape[1]
    film = np.broadcast_to(places.film_mm[:, :, None, None], (2, *shape)).reshape(2, -1)
    square = np.broadcast_to(pupil[:, None, None, :], (2, *shape)).reshape(2, -1)
    nanometres = np.broadcast_to(places.wavelength_nm[None, :, None], shape).reshape(-1)
    return camera.sample(*(np.ascontiguousarray(a, np.float32) for a in (film, square, nanometres))), shape


def _chief(camera: Camera, film_mm: Array, nanometres: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    count = film_mm.shape[1]
    half, waves = np.full((2, count), 0.5, np.float32), np.full(count, nanometres, np.float32)
    rays = camera.sample(np.ascontiguousarray(film_mm, np.float32), half, waves)
    lit = (rays.status == 0) & (rays.weight > 0)
    return rays.origin_m.astype(np.float64), rays.direction.astype(np.float64), lit


def _meet(places: Places, origin: Array, direction: Array) -> Array:
    """Slopes [2, N(, K)] against the chief rays at which rays [3, N(, K)] meet the planes at the places' distances."""
    new = (None,) * (origin.ndim - 2)
    base, along, near = places.origin_m[..., *new], places.direction[..., *new], 1 / places.distance_m[..., *new]
    rate, from_base = (direction * along).sum(0), origin - base
    with np.errstate(all="ignore"):
        # All is divided by the distance, so that the plane may lie at infinity.
        step = (1 - near * (from_base * along).sum(0)) / rate
        meet = np.where(rate > 1e-3, near * from_base + step * direction, np.nan)
    return np.asarray((places.across[..., *new] * meet).sum(1))


def centroids(prints: Footprints, share: Array) -> tuple[Array, Array]:
    """Return the centroid of all light [2, N], and that of each wavelength [2, N, W]."""
    by_wave = (prints.place_mm * prints.weight).sum(3) / np.maximum(prints.weight.sum(2), 1e-300)
    return (by_wave * share).sum(2), by_wave


def _quantiles(value: Array, weight: Array) -> Array:
    """Return values [N, W, Q] at equal steps of the weight of samples [N, W, P]; NaN without weight."""
    order = np.argsort(value, axis=-1)
    value, weight = np.take_along_axis(value, order, -1), np.take_along_axis(weight, order, -1)
    total = weight.sum(-1, keepdims=True)
    with np.errstate(all="ignore"):
        middle = (np.cumsum(weight, -1) - weight / 2) / total
    steps = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    quantiles = np.full((*value.shape[:2], _QUANTILES), np.nan)
    for n, w in np.ndindex(*value.shape[:2]):
        if total[n, w, 0] > 0:
            lit = weight[n, w] > 0
            quantiles[n, w] = np.interp(steps, middle[n, w][lit], value[n, w][lit])
    return quantiles


def _pupil_size(prints: Footprints) -> Array:
    """Return the RMS pupil coordinate [N] along one axis (mm), by which a matrix per mm of pupil is multiplied."""
    weight = prints.weight / np.maximum(prints.weight.sum(2, keepdims=True), 1e-300)
    mean = (prints.pupil_mm * weight).sum(3, keepdims=True)
    return np.asarray(np.sqrt((((prints.pupil_mm - mean) ** 2) * weight).sum((0, 3)).mean(1) / 2))


def _expanded(prints: Footprints, centre: Array) -> tuple[Array, Array]:
    """Return linear parts [2, 2, N, W], mm per mm of pupil, and mean squares [3, N, W] of degrees 2, 3 and the rest."""
    size = np.maximum(_pupil_size(prints), 1e-12)[:, None, None]
    x, y = prints.pupil_mm / size
    root = np.sqrt(prints.weight / np.maximum(prints.weight.sum(2, keepdims=True), 1e-300))
    monomials = (1 + 0 * x, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3)
    basis = np.stack([root * m for m in monomials], axis=-1)  # [N, W, P, 10]
    q, r = np.linalg.qr(basis)
    wanted = np.moveaxis((prints.place_mm - centre[..., None]) * root, 0, -1)  # [N, W, P, 2]
    factors = np.swapaxes(q, -1, -2) @ wanted  # [N, W, 10, 2]
    with np.errstate(all="ignore"):
        weak = np.abs(np.diagonal(r, axis1=-2, axis2=-1))[..., 1:3].min(-1) < 1e-9
        steep = np.linalg.solve(np.where(weak[..., None, None], np.eye(2), r[..., 1:3, 1:3]), factors[..., 1:3, :])
    linear = np.where(weak[..., None, None], 0.0, steep) / size[..., None]
    square = (factors**2).sum(-1)
    rest = np.maximum((wanted**2).sum((-1, -2)) - square.sum(-1), 0.0)
    return linear.transpose(3, 2, 0, 1), np.stack([square[..., 3:6].sum(-1), square[..., 6:].sum(-1), rest])
