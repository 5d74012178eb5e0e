"""The field of a camera: the undistorted place of every point of its picture, the way back, and the light there.

Picture points are mm on the film as the picture is looked at: x right, y up, origin at its centre. What a point of the
picture shows is the centroid of the light that arrives there: the mean of where its rays meet the object, over pupil
and wavelengths and by weight. That is where a picture shows a thing, whatever the stop, and also where the focus is not
perfect; the ray through the stop's centre differs from it by the coma.

The object is a plane across the axis for the rectilinear projection, and a sphere about the entrance pupil for the
others, at the distance in focus unless another is asked for. Undistorted places are those in the picture of an ideal
camera: a point at the lens's paraxial entrance pupil, whose picture on the axis has the lens's paraxial size (by chief
rays; for a lens with cylinders, in each of its meridians). The lens itself sees from a point that moves with the field.
So it shows a point nearer or farther than the object at another place, which `shown_at` gives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.ideal import PROJECTIONS
from neurolens.cameras.sampling import axis_mm
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.paraxial import first_order

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

RECTILINEAR = "rectilinear"
WIDEST_DEG = 85.0  # field that can be laid on a plane: a picture is then 11 focal lengths from the axis

_PUPIL = 6, 24  # rings of pupil samples, and samples of a ring
_RAYS = 1 << 17  # rays at once
_ROUND, _OTHER = (513, 1), (97, 64)  # radii and azimuths of the tables, for round cameras and others
BEYOND = 1.02  # radius of the film's corner over that of the light that is allowed, for lenses are engraved so
_FINER = 64, 4  # rings of the map back for each of the map there; of cameras that are not round, also azimuths
_EDGE = 16  # points on each side of the film
_SPREAD = 61, 41  # points over a film
# shares of the radius and azimuths that are tried; unevenness of a round one
_TRIED, _AZIMUTHS, _UNEVEN = (0.4, 0.7, 0.95), 7, 3e-6
_HALVINGS = 24
DIM = 2e-3  # share of the light on the axis, nine stops below: from there on places continue straight
_STEPS = 6  # steps of Newton's method
_SMALL = 0.004  # share of the radius at which the size on the axis is measured, for cameras that do not know it


class Frame(NamedTuple):
    """The ideal camera that a picture is compared with.

    Attributes:
        reach_mm: the size on the film of a slope of 1, along x and along y.
        pupil_mm: how far in front of the film its point lies, in each meridian.
    """

    reach_mm: tuple[float, float]
    pupil_mm: tuple[float, float]


class Light(NamedTuple):
    """The light of picture points, [N] each.

    Attributes:
        place: the undistorted place, x + i y in mm.
        light: the amount of light over that on the axis.
        angle: of the mean ray to the axis, rad.
    """

    place: Complex
    light: Array
    angle: Array


Spectrum = tuple[Array, Array]  # wavelengths in nm, and their weights


def spectrum_of(camera: Any, light_nm: tuple[float, float] = LIGHT_NM, only_nm: float | None = None) -> Spectrum:
    """Return one wavelength, or several with the eye's sensitivity as weights; a camera limits them to its range."""
    low, high = camera.wavelength_nm or light_nm
    if only_nm is not None:
        if camera.wavelength_nm is not None and not low <= only_nm <= high:
            raise InputError(camera.name, "wavelength_nm", only_nm, f"a wavelength from {low:g} to {high:g} nm")
        return np.array([float(only_nm)]), np.ones(1)
    if not camera.dispersive and getattr(camera, "achromatic", False):
        return np.array([550.0]), np.ones(1)
    return paraxial.colours((max(low, light_nm[0]), min(high, light_nm[1])))


def frame_of(camera: Any) -> Frame:
    """Return the ideal camera that stands beside any camera: by its first-order data, or by traced rays."""
    state, lens = camera.settings["lens_state"], getattr(camera, "lens", None)
    y = state["pinhole_focal_length_mm"], state["entrance_pupil_offset_mm"]
    if None in y:
        return _measured(camera)
    if state["squeeze"] == 1:
        x = y
    elif lens is not None:
        data, film = first_order(lens, meridian="x"), float(camera.settings["film_z_mm"])
        focal, pupil = (data.front_focal_z_mm, data.rear_focal_z_mm), data.entrance_pupil_z_mm
        x = paraxial.reach_mm(data.efl_mm, data.front_efl_mm, focal, pupil, film), film - pupil
    else:
        (reach, _), (pupil, _) = _measured(camera)
        x = reach, pupil
    return Frame((float(x[0]), float(y[0])), (float(x[1]), float(y[1])))


def _measured(camera: Any) -> Frame:
    """Find the ideal camera beside one without first-order data: rays close to the axis are traced to two planes."""
    height = _SMALL * math.hypot(*camera.film_mm) / 2
    points = np.asarray(on_axis(camera) + height * np.array([1, 1j, -1, -1j, 2, 2j, -2, -2j]), np.complex128)
    near, far, origin = 1000.0, 3000.0, Frame((1.0, 1.0), (0.0, 0.0))
    sizes = []
    for distance in (near, far):  # by the middle of the pupil
        z = traced_light(camera, points, spectrum_of(camera), origin, RECTILINEAR, distance / 1000, (1, 1)).place
        x, y = z.real * distance / height, z.imag * distance / height
        once, twice = np.array([x[0] - x[2], y[1] - y[3]]) / 2, np.array([x[4] - x[6], y[5] - y[7]]) / 4
        sizes.append((4 * once - twice) / 3)  # the error grows with the square
    growth = [(b - a) / (far - near) for a, b in zip(*sizes, strict=True)]  # per mm: 1 / reach
    pupil = [near - a / g for a, g in zip(sizes[0], growth, strict=True)]
    return Frame((float(1 / growth[0]), float(1 / growth[1])), (float(pupil[0]), float(pupil[1])))


def on_axis(camera: Any) -> Complex:
    """Return the picture point [1] on the axis."""
    return np.array([-complex(*axis_mm(camera)[0])])


def traced_light(
    camera: Any, point: Complex, spectrum: Spectrum, frame: Frame, target: str, distance_m: float,
    pupil: tuple[int, int] = _PUPIL,
) -> Light:  # fmt: skip
    """Trace the light of picture points [N]; see the module.

    Args:
        distance_m: from the film to the object on the axis; inf is allowed.
        pupil: see `_pupil_samples`.
    """
    (waves, weights), (square, shares) = spectrum, _pupil_samples(*pupil)
    each = np.tile(square, waves.size).astype(np.float32)
    nm = np.repeat(waves, shares.size).astype(np.float32)
    share = np.outer(weights / weights.sum(), shares).reshape(-1)
    count, step = point.size, max(1, _RAYS // nm.size)
    direction, light, angle = np.zeros((3, count)), np.zeros(count), np.zeros(count)
    for start in range(0, count, step):
        part = slice(start, start + step)
        film = np.repeat(-np.stack([point.real, point.imag])[:, part], nm.size, axis=1).astype(np.float32)
        points = film.shape[1] // nm.size
        rays = camera.sample(film, np.tile(each, points), np.tile(nm, points))
        weight = rays.weight.astype(np.float64).reshape(points, -1) * share
        way = rays.direction.astype(np.float64).reshape(3, points, -1)
        place = _on_object(rays.origin_m.astype(np.float64).reshape(way.shape), way, frame, target, distance_m)
        light[part], mean = weight.sum(1), np.einsum("inm,nm->in", way, weight)
        angle[part] = np.arctan2(np.hypot(mean[0], mean[1]), -mean[2])
        sound = np.isfinite(place).all(0)
        met, place = np.where(sound, weight, 0.0), np.where(sound, place, 0.0)
        direction[:, part] = np.einsum("inm,nm->in", place, met) / np.maximum(met.sum(1), 1e-30)
    return Light(_undistorted(direction, frame, target), light, angle)


def _pupil_samples(rings: int, around: int) -> tuple[Array, Array]:
    """Return points [2, N] of the unit square and weights that integrate what is smooth over a pupil.

    All cameras map concentric squares to concentric copies of the pupil, so the points lie on rings by Gauss's rule, in
    equal steps around. One more sample is the centre.
    """
    if around == 1:
        return np.full((2, 1), 0.5), np.ones(1)
    node, weight = np.polynomial.legendre.leggauss(rings)
    size = np.sqrt((1 + node) / 2)  # the area of a square grows with its square
    turn = (np.arange(around) + 0.5) * (8 / around)  # along the edge of the square from +x, which is 8 long
    from_x = 4 - np.abs(4 - turn)
    a, b = np.clip(2 - from_x, -1, 1), np.sign(4 - turn) * np.clip(np.minimum(from_x, 4 - from_x), 0, 1)
    square = (1 + np.stack([np.outer(size, a), np.outer(size, b)])) / 2
    return square.reshape(2, -1), np.repeat(weight / 2 / around, around)


def _on_object(origin: Array, way: Array, frame: Frame, target: str, distance_m: float) -> Array:
    """Return directions [3, ...], z ahead, from the ideal camera's point to where rays (m) meet the object."""
    flip, pupil = np.array([1.0, 1.0, -1.0])[:, None, None], 1e-3 * np.array(frame.pupil_mm)
    with np.errstate(all="ignore"):
        if target == RECTILINEAR:
            slope = np.where(way[2] < -1e-3, way[:2] / -way[2], np.nan)
            if math.isinf(distance_m):
                return np.concatenate([slope, np.ones_like(slope[:1])])
            place = origin[:2] + slope * (distance_m + origin[2])
            # Each meridian is seen from its own pupil, so the direction is scaled to z = 1.
            return np.concatenate([place / (distance_m - pupil)[:, None, None], np.ones_like(slope[:1])])
        if math.isinf(distance_m):
            return way * flip
        radius = distance_m - pupil.mean()
        start = origin + np.array([0.0, 0.0, pupil.mean()])[:, None, None]
        along = (start * way).sum(0)
        root = np.sqrt(along**2 + radius**2 - (start**2).sum(0))
        return (start + (root - along) * way) * flip / radius


def _undistorted(direction: Array, frame: Frame, target: str) -> Complex:
    """Return the undistorted places x + i y [N], in mm, of directions [3, N]."""
    side = np.hypot(direction[0], direction[1])
    angle = np.arctan2(side, direction[2])
    with np.errstate(all="ignore"):
        rho = np.tan(angle) if target == RECTILINEAR else PROJECTIONS[target].radius(angle)
    rho = rho / np.where(side > 0, side, 1.0)
    return frame.reach_mm[0] * rho * direction[0] + 1j * (frame.reach_mm[1] * rho * direction[1])


def _directions(place: Complex, frame: Frame, target: str) -> Array:
    """Return the unit vectors [3, N] of undistorted places."""
    place = place.real / frame.reach_mm[0] + 1j * (place.imag / frame.reach_mm[1])
    rho = np.abs(place)
    angle = np.arctan(rho) if target == RECTILINEAR else PROJECTIONS[target].angle(rho)
    turn = place / np.where(rho > 0, rho, 1.0)
    return np.stack([np.sin(angle) * turn.real, np.sin(angle) * turn.imag, np.cos(angle)])


def is_round(camera: Any) -> bool:
    """Test whether places and light of a camera agree at several azimuths, none of which mirrors another."""
    corner = math.hypot(*camera.film_mm) / 2
    angle = np.arange(_AZIMUTHS) * 0.83
    turn = np.exp(1j * np.tile(angle, len(_TRIED)))
    points = np.asarray(np.repeat(corner * np.array(_TRIED), angle.size) * turn, np.complex128)
    traced = traced_light(camera, points, spectrum_of(camera), Frame((1, 1), (0, 0)), "equidistant", math.inf)
    place = (traced.place / turn).reshape(len(_TRIED), -1)
    light = traced.light.reshape(place.shape) > 0
    lit = light.all(1)  # a row that is dark in part is not round; one that is all dark tells nothing
    uneven = np.abs(place[lit] - place[lit].mean(1, keepdims=True))
    return bool((lit | ~light.any(1)).all() and (uneven <= _UNEVEN * np.abs(place[lit])).all())


@dataclass(frozen=True)
class Polar:
    """A map of the plane to itself, near the identity; places are complex numbers x + i y.

    On rings it is tabulated as a ratio: the place to which a point goes, over the point.

    Attributes:
        end: radius of the last ring, mm; beyond it the map continues straight along the radius.
        ratio: [R, A] complex, at equal steps of radius (from 0) and azimuth (from +x); A is 1 where the map is round.
        slope: [A] complex, derivative along the radius at the last ring.
        shift: what is added everywhere, for cameras that are not round.
    """

    end: float
    ratio: Complex
    slope: Complex
    shift: complex = 0j

    @classmethod
    def of(cls, end: float, place: Complex) -> Polar:
        """Make the map of where the points of the rings go, [R, A]; the first ring is the centre."""
        rings, turn = place.shape[0], turns(place.shape[1])
        shift = complex(place[0].mean()) if len(turn) > 1 else 0j  # of a round camera it is only rounding
        radius = np.linspace(0, end, rings)[:, None]
        ratio = np.ones_like(place)
        ratio[1:] = (place[1:] - shift) / (radius[1:] * turn)
        ratio[0] = (4 * ratio[1] - ratio[2]) / 3  # ratios are even about the centre
        a, b, c = place[-1], place[-2], place[-3]
        return cls(end, ratio, (3 * a - 4 * b + c) / (2 * radius[1] * turn), shift)

    def __call__(self, point: Complex) -> Complex:
        """Return where the map takes points."""
        radius = np.abs(point)
        inner = np.minimum(radius, self.end)
        turn = point / np.where(radius > 0, radius, 1.0)
        found: Complex = on_rings(self.ratio, self.end, point) * (inner * turn) + self.shift
        if (radius > self.end).any():
            found = found + on_rings(np.stack([self.slope] * 4), self.end, point) * ((radius - inner) * turn)
        return found


def turns(azimuths: int) -> Complex:
    """Return the unit vectors [A] to equally spaced azimuths."""
    return np.exp(2j * math.pi * np.arange(azimuths) / azimuths)


def on_rings(table: NDArray[Any], end: float, point: Complex) -> NDArray[Any]:
    """Interpolate a table [R, A] on rings from the centre to `end`, by cubics; beyond, take the last ring's values."""
    rings, azimuths = table.shape
    place = np.minimum(np.abs(point), end) * ((rings - 1) / end)
    row = np.clip(place.astype(np.intp) - 1, 0, rings - 4)
    along = _lagrange(place - row)
    if azimuths == 1:
        column = np.ascontiguousarray(table[:, 0])
        return np.asarray(sum(w * column[row + k] for k, w in enumerate(along)))
    around = np.angle(point) * (azimuths / (2 * math.pi))
    first = np.floor(around).astype(np.intp) - 1
    columns = [((first + j) % azimuths, w) for j, w in enumerate(_lagrange(around - first))]
    return np.asarray(sum(w * v * table[row + k, c] for k, w in enumerate(along) for c, v in columns))


def _lagrange(t: Array) -> list[Array]:
    """Return the weights of four values at 0, 1, 2 and 3."""
    a, b, c = t - 1, t - 2, t - 3
    return [-a * b * c / 6, t * b * c / 2, -t * a * c / 2, t * a * b / 6]


@dataclass(frozen=True)
class Field:
    """Holds both maps between a camera's picture and its undistorted picture, and the light.

    Attributes:
        ideal, picture: undistorted place of a picture point, and the way back, both x + i y in mm.
        frame, target: the ideal camera and the projection; see the module.
        end_mm: radius of the tables: the film's corner, or where the light ends.
        field_deg: widest angle to the axis of light that arrives within that radius.
        light: [R, A] on the rings of `ideal`, over that on the axis.
        distance_m: from the film to the object.
        spectrum: wavelengths in nm and their weights.
    """

    ideal: Polar
    picture: Polar
    frame: Frame
    target: str
    end_mm: float
    field_deg: float
    light: Array
    distance_m: float
    spectrum: Spectrum

    @property
    def round(self) -> bool:
        """Whether the field is the same at all azimuths."""
        return self.light.shape[1] == 1

    def lit(self, point: Complex) -> NDArray[np.bool_]:
        """Test whether light arrives at points x + i y (mm) of the lens's picture, of any shape."""
        if (self.light > 0).all():
            return np.asarray(np.abs(point) <= self.end_mm * (1 + 1e-9))
        return self.relative_light(point) > 0

    def bright(self, point: Complex) -> NDArray[np.bool_]:
        """Test whether the places of picture points are traced ones: beyond `DIM` they continue straight."""
        return self.relative_light(point) >= DIM

    def relative_light(self, point: Complex) -> Array:
        """Return the light at picture points (as `lit`) over that on the axis; 0 beyond the end of the light."""
        value = np.maximum(on_rings(self.light, self.end_mm, point), 0.0)
        return np.where(np.abs(point) <= self.end_mm * (1 + 1e-9), value, 0.0)

    def directions(self, point: Complex) -> Array:
        """Return the unit vectors [3, N] (z towards the scene) of picture points, from the ideal camera's point."""
        return _directions(self.ideal(point), self.frame, self.target)

    def point(self, direction: Array) -> Complex:
        """Return the picture points of directions [3, N] as `directions` gives them; NaN where the camera sees none."""
        behind = direction[2] <= 0 if self.target == RECTILINEAR else direction[2] < -1 + 1e-9
        with np.errstate(all="ignore"):
            return self.picture(np.where(behind, np.nan, _undistorted(direction, self.frame, self.target)))


def field_of(
    camera: Any, focus_m: float, target: str = RECTILINEAR, *,
    frame: Frame | None = None, spectrum: Spectrum | None = None, distance_m: float | None = None,
) -> Field:  # fmt: skip
    """Trace a camera's field and tabulate it.

    Args:
        camera: any camera of this package; its stop and focus are those in use.
        focus_m: distance from the film to what is in focus.
        frame: the ideal camera; found where it is not given.
        spectrum: see `spectrum_of`.
        distance_m: to the object, where that is not in focus.

    Raises:
        InputError: an object nearer than the entrance pupil; a field beyond `WIDEST_DEG`, or dark corners, for a plane;
            a picture that folds.
    """
    frame, spectrum = frame or frame_of(camera), spectrum or spectrum_of(camera)
    distance = focus_m if distance_m is None else distance_m
    nearest = 1e-3 * max(frame.pupil_mm)
    if not distance > nearest:
        raise InputError(camera.name, "distance_m", distance, f"more than {nearest:.4g} m, the entrance pupil's")
    rings, azimuths = _ROUND if is_round(camera) else _OTHER

    def at(points: Complex) -> tuple[Complex, Light]:
        traced = traced_light(camera, points, spectrum, frame, target, distance)
        return np.where(traced.light > 0, traced.place, np.nan), traced

    corner = math.hypot(*camera.film_mm) / 2
    end = corner if azimuths > 1 else end_of_light(lambda r: at(np.array([r + 0j]))[1].light[0] > 0, corner)
    points = (np.linspace(0, end, rings)[:, None] * turns(azimuths)).reshape(-1)
    place, found = at(points)
    edge_place, _ = at(film_edge(camera.film_mm) / BEYOND)
    widest = math.degrees(float(np.where(found.light > 0, found.angle, 0.0).max()))
    if target == RECTILINEAR:
        _check_plane(camera, widest, bool(np.isfinite(edge_place).all()), end)
    # At the very rim few samples of the pupil are lit, so that their mean steps to and fro: that is no fold.
    whole = float(at(on_axis(camera))[1].light[0])
    place = np.where(found.light < DIM * whole, np.nan, place)
    place = _filled(place.reshape(rings, azimuths))
    rising = (np.diff(np.abs(place - place[:1]), axis=0) > 0).all(1)
    if not rising.all():
        fold = end * (int(np.argmin(rising)) + 1) / (rings - 1)
        raise InputError(camera.name, "film_mm", camera.film_mm, f"no picture beyond {fold:.4g} mm, where it folds")
    ideal, light = Polar.of(end, place), found.light.reshape(rings, azimuths) / whole
    return Field(ideal, _inverted(ideal), frame, target, end, widest, light, distance, spectrum)


def shown_at(camera: Any, field: Field, point: Complex, distance_m: float) -> Complex:
    """Return where a field puts the things that picture points [N] show at this distance; NaN where it is dark."""
    seen = traced_light(camera, point, field.spectrum, field.frame, field.target, distance_m)
    return np.where(seen.light > 0, field.picture(seen.place), np.nan)


def film_points(field: Field, film_mm: tuple[float, float], count: int = 65) -> Complex:
    """Return points along x, from next to the axis to the radius of the film's corner or the end of the light, mm."""
    return np.linspace(0, min(field.end_mm, math.hypot(*film_mm) / 2), count)[1:].astype(np.complex128)


def radial_points(field: Field, film_mm: tuple[float, float], count: int = 65) -> Complex:
    """Return points to which formulae of the radius are fitted: along x, or over all of a picture that is not round.

    No such formula holds for a copy of a lens, whose elements are decentred: over the picture one sees what it leaves.
    """
    points = film_points(field, film_mm, count) if field.round else lit_points(field, film_mm)
    return points if field.round else points[field.bright(points)]


def diagonal_points(field: Field, film_mm: tuple[float, float], count: int = 65) -> Complex:
    """Return points as `film_points` does, along the diagonal, for pictures that are not round."""
    return film_points(field, film_mm, count) * (complex(*film_mm) / math.hypot(*film_mm))


def lit_points(field: Field, film_mm: tuple[float, float], count: tuple[int, int] = _SPREAD) -> Complex:
    """Return points spread over the part of a film that light reaches, mm."""
    x, y = np.meshgrid(*(np.linspace(-0.5, 0.5, n) * side for n, side in zip(count, film_mm, strict=True)))
    points = np.asarray(x + 1j * y, np.complex128).reshape(-1)
    return points[field.lit(points)]


def centroids_m(camera: Any, field: Field, point: Complex, distance_m: float) -> Array:
    """Return the places [3, N] of the light of picture points on a sphere about the entrance pupil, their origin.

    The frame is x right, y up, z towards the scene. The sphere cuts the axis at this distance from the film; for
    infinity unit directions are returned. Where the picture is dark they are NaN.
    """
    traced = traced_light(camera, point, field.spectrum, field.frame, "equidistant", distance_m)
    radius = 1.0 if math.isinf(distance_m) else distance_m - 1e-3 * float(np.mean(field.frame.pupil_mm))
    return np.where(traced.light > 0, radius * _directions(traced.place, field.frame, "equidistant"), np.nan)


def film_edge(film_mm: tuple[float, float]) -> Complex:
    """Return points round the edge of a film, mm."""
    line, (x, y) = np.linspace(-1, 1, _EDGE), np.array(film_mm) / 2
    return np.concatenate([x * line + 1j * y, x * line - 1j * y, x + 1j * y * line, -x + 1j * y * line])


def end_of_light(lit: Callable[[float], bool], corner: float) -> float:
    """Return the radius up to which a picture is lit, at most that of the corner."""
    steps = np.linspace(0, corner, 33)
    dark = next((k for k, r in enumerate(steps) if not lit(float(r))), None)
    if dark is None:
        return corner
    low, high = float(steps[max(dark - 1, 0)]), float(steps[dark])
    for _ in range(_HALVINGS):
        low, high = ((low + high) / 2, high) if lit((low + high) / 2) else (low, (low + high) / 2)
    return low


def _check_plane(camera: Any, widest_deg: float, bright: bool, end_mm: float) -> None:
    """Raise InputError for a field that cannot be laid on a plane."""
    other = "--projection equidistant, or a smaller film"
    if widest_deg > WIDEST_DEG:
        raise InputError(camera.name, "field", f"({widest_deg:.4g} degrees from the axis)",
                         f"at most {WIDEST_DEG:g}, to be laid on a plane: {other}")  # fmt: skip
    if not bright:
        film, diagonal = " x ".join(f"{v:g}" for v in camera.film_mm), math.hypot(*camera.film_mm)
        lit = f"{2 * end_mm:.4g} mm" if 2 * end_mm < diagonal else "less"
        raise InputError(camera.name, "film_mm", f"({film} mm, {diagonal:.4g} mm across corners, of which {lit} lit)",
                         f"a film within the image circle: {other}")  # fmt: skip


def _filled(place: Complex) -> Complex:
    """Continue places [R, A] along a straight line, at each azimuth, beyond the end of the light."""
    for k in range(place.shape[1]):
        dark = np.flatnonzero(~np.isfinite(place[:, k]))
        if dark.size and dark[0] > 1:
            first = int(dark[0])
            step = place[first - 1, k] - place[first - 2, k]
            place[first:, k] = place[first - 1, k] + step * np.arange(1, place.shape[0] - first + 1)
    if not np.isfinite(place).all():
        raise InputError("camera", "film_mm", "(dark)", "a picture that light reaches near its centre")
    return place


def _inverted(forward: Polar) -> Polar:
    """Return the inverse of a map, by Newton's method on its rings."""
    rings, azimuths = forward.ratio.shape
    finer = _FINER[azimuths > 1]
    rings, azimuths = finer * (rings - 1) + 1, finer * azimuths if azimuths > 1 else 1
    turn = turns(azimuths)
    radius = np.linspace(0, forward.end, rings)
    reach = np.abs(forward(radius[:, None] * turn))
    mean, end = reach.mean(1), float(reach[-1].max())
    goal = np.linspace(0, end, rings)[:, None] * turn
    point = np.interp(np.abs(goal), mean, radius) * turn
    small = 1e-6 * forward.end
    for _ in range(_STEPS):
        wrong = forward(point) - goal
        ax, ay = ((forward(point + h) - forward(point - h)) / (2 * small) for h in (small, 1j * small))
        det = ax.real * ay.imag - ax.imag * ay.real
        step = (wrong.real * ay.imag - wrong.imag * ay.real) + 1j * (wrong.imag * ax.real - wrong.real * ax.imag)
        point = point - step / det
    return Polar.of(end, point)
