"""Helpers of all cameras: finite rays, where light from the scene is aimed, checks, and the lens data of headers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import concentric_disk
from neurolens.cameras.contract import Camera, CameraRays, FilmPoints, FloatArray
from neurolens.cameras.pose import FilmPose
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.trace.shapes import sag_mm
from neurolens.optics.trace.surfaces import Rays, meet_front

_BEYOND = 1.02  # largest diagonal of a film over its image circle: 36x24 on 43.2 mm is engraved so
_ANGLES, _LEVELS, _ROOM = 24, 5, 1.01  # intervals and levels of `FrontDiscs`, and by how much its discs are widened
LEAST_COS2 = 1e-30  # the square of the tangent beyond it comes near the end of float32
_AHEAD = np.array([[0], [0], [-1]], np.float32)


@dataclass(frozen=True)
class FrontDiscs:
    """Discs on a lens's front surface at which light from the scene is aimed, by its angle to the axis.

    Light that reaches the film from one direction crosses a part of the front surface, which moves with the angle. The
    directions of light from a scene point spread by as much as the front is wide, seen from there.

    Attributes:
        width_rad: width of the equal intervals of the angle, which start at 0.
        discs: [L, B, 2], for each interval together with the 2^l next on either side: the disc's centre along the
            azimuth of the direction, and its radius (mm).
        far_mm: radius of a disc about the axis for all light.
        reach_mm: distance from the vertex to its farthest point on the surface.
    """

    width_rad: float
    discs: NDArray[np.float64]
    far_mm: float
    reach_mm: float

    @staticmethod
    def of(leaving: NDArray[np.float64], shape: Surface | None) -> FrontDiscs:
        """Return the discs of scene rays [6, N] (mm, lens frame); `shape` is the surface's, None the plane z = 0."""
        x, y = meet_front(shape, Rays(*leaving))
        side = np.hypot(leaving[3], leaving[4])
        angle, azimuth = np.arctan2(side, -leaving[5]), (leaving[3] + 1j * leaving[4]) / np.maximum(side, 1e-12)
        width, place, far = angle.max() / _ANGLES, (x + 1j * y) * azimuth.conj(), float(np.hypot(x, y).max())
        row = np.minimum(angle / width, _ANGLES - 1).astype(np.intp)
        discs = np.full((_LEVELS, _ANGLES, 2), [0.0, far])
        for level, k in product(range(_LEVELS), np.unique(row)):
            near = place[np.abs(row - k) <= 2**level]
            discs[level, k, 0] = (near.real.min() + near.real.max()) / 2 if k else 0.0  # the axis has no azimuth
            discs[level, k, 1] = np.abs(near - discs[level, k, 0]).max()
        depth = 0.0 if shape is None else float(sag_mm(shape, far, 0.0, held=True))
        return FrontDiscs(float(width), discs * [1.0, _ROOM], _ROOM * far, _ROOM * math.hypot(far, depth))

    def aim(self, point_mm: NDArray[np.float64], square: FloatArray) -> tuple[NDArray[np.float64], ...]:
        """Return x, y (mm) and the area of the whole square (mm^2), [N] each, for scene points [3, N] (mm)."""
        point_mm = np.where(np.isfinite(point_mm).all(0), point_mm, 0.0)
        side, distance = np.hypot(point_mm[0], point_mm[1]), np.sqrt((point_mm**2).sum(0))
        angle = np.arctan2(side, -point_mm[2])
        # Directions from points of the surface, and their azimuths, differ from those at the vertex by no more than
        # this.
        apart = np.arcsin(np.minimum(self.reach_mm / np.maximum(distance, 1e-9), 1))
        turn = np.sin(apart) / np.maximum(np.sin(angle), 1e-12)
        turn = np.where((turn < 1) & (apart < np.pi / 2), math.sqrt(2) * turn, 2.0)  # at least the chord of that angle
        level = np.ceil(np.log2(np.maximum(apart / self.width_rad, 1))).astype(np.intp)
        interval = np.minimum(angle / self.width_rad, _ANGLES - 1).astype(np.intp)
        centre, radius = self.discs[np.minimum(level, _LEVELS - 1), interval].T
        some = (level < _LEVELS) & (radius + np.abs(centre) * turn < self.far_mm)
        centre, radius = np.where(some, centre, 0.0), np.where(some, radius + np.abs(centre) * turn, self.far_mm)
        azimuth = np.where(side > 0, (point_mm[0] + 1j * point_mm[1]) / np.where(side > 0, side, 1), 1.0)
        u, v = concentric_disk(square).astype(np.float64)
        place = azimuth * (centre + radius * (u + 1j * v))
        return place.real, place.imag, math.pi * radius * radius


def stratified(side: int, wavelength_nm: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return points [2, side^2] of the unit square and wavelengths [side^2] in nm for quadratures; always the same.

    Points lie at random in their cells, because midpoints would all lie inside the edge of a pupil's outline, near
    which a thousandth of the rays is blocked.
    """
    rng, count = np.random.default_rng(0), side * side
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side))).reshape(2, -1)
    square = np.minimum((cell + rng.random(cell.shape)) / side, 1 - 2.0**-24).astype(np.float32)
    share = rng.permutation((np.arange(count) + rng.random(count)) / count)
    return square, (wavelength_nm[0] + (wavelength_nm[1] - wavelength_nm[0]) * share).astype(np.float32)


def is_light(wavelength_nm: FloatArray) -> NDArray[np.bool_]:
    """Test which wavelengths [N] are finite and above 0; other rays are outside the domain of every camera."""
    return (wavelength_nm > 0) & (wavelength_nm < np.inf)


def sound(rays: CameraRays, cos2: FloatArray, square: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
    """Return the rays, with those that have no valid film point, pupil point or wavelength dark and straight ahead.

    A film point too far out for float32 is not valid either.

    Args:
        cos2: [N], a squared cosine of each ray, which is NaN or near 0 for film points that are not sound.
        square: [2, N] the pupil samples, which belong to [0, 1].
    """
    lit = is_light(wavelength_nm)
    # Written so that NaN fails.
    if cos2.min(initial=1) > LEAST_COS2 and square.min(initial=0) >= 0 and square.max(initial=0) <= 1 and lit.all():
        return rays
    good = (cos2 > LEAST_COS2) & ((square >= 0) & (square <= 1)).all(0) & lit
    return CameraRays(
        np.where(good, rays.origin_m, np.float32(0)),
        np.where(good, rays.direction, _AHEAD),
        np.where(good, rays.weight, np.float32(0)),
        np.where(good, rays.status, np.int32(st.OUTSIDE_DOMAIN)),
    )


def arrived(
    film_mm: NDArray[np.float64],
    origin_m: NDArray[np.float64],
    point_m: FloatArray,
    weight: NDArray[np.float64],
    status: NDArray[np.int32],
    wavelength_nm: FloatArray,
) -> FilmPoints:
    """Return film points [2, N] with what leads to them, dark and finite where the status or a number forbids them."""
    way = point_m - origin_m
    with np.errstate(all="ignore"):
        direction = (way / np.sqrt(np.einsum("in,in->n", way, way))).astype(np.float32)
        film, origin, weight = film_mm.astype(np.float32), origin_m.astype(np.float32), weight.astype(np.float32)
    status = np.where(is_light(wavelength_nm), status, st.OUTSIDE_DOMAIN)
    finite = np.isfinite(np.concatenate([film, origin, direction, weight[None]])).all(0)
    good = finite & (status == st.PASSED)
    return FilmPoints(
        np.where(good, film, np.float32(0)),
        np.where(good, origin, np.float32(0)),
        np.where(good, direction, _AHEAD),
        np.where(good, weight, np.float32(0)),
        np.where(finite | (status != st.PASSED), status, st.OUTSIDE_DOMAIN).astype(np.int32),
    )


def common_light(known_nm: tuple[float, float], light_nm: tuple[float, float]) -> tuple[float, float]:
    """Return the part of a range of light that a lens knows; where there is none, the nearest end of the lens's own."""
    low, high = known_nm
    return min(max(low, light_nm[0]), high), max(min(high, light_nm[1]), low)


def beyond_circle(film_mm: tuple[float, float], radius_mm: float, what: str, then: str) -> list[str]:
    """Return a sentence if a film is larger than the image circle."""
    circle, diagonal = 2 * radius_mm, math.hypot(*film_mm)
    if diagonal <= _BEYOND * circle:
        return []
    told = f"the film's diagonal of {diagonal:.3g} mm is {diagonal / circle:.3g} times {what} of {circle:.3g} mm"
    return [f"{told}: its corners {then}"]


def focus_m(camera: Camera, shot: Shot) -> float:
    """Return the distance from film to object in metres: that of the shot, else the one that its camera has chosen."""
    chosen = camera.settings.get("focus_m") if shot.focus_m is None else shot.focus_m
    return math.inf if chosen is None else float(chosen)


def axis_mm(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the film point [2] on a camera's axis, away from the middle of a film that is moved, and how far from the
    axis the film reaches along x and along y [2]."""
    axis = np.array(FilmPose.in_settings(camera.settings).moved_mm)
    return axis, np.array(camera.film_mm) / 2 + np.abs(axis)


def positive(field: str, value: float, *, infinite: bool = False) -> float:
    """Return `value` as a float above 0, finite unless `infinite` is allowed.

    Raises:
        InputError: names the field, for any other value.
    """
    expected = "a number above 0" if infinite else "a finite number above 0"
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
        raise InputError("camera", field, value, expected)
    if math.isinf(value) and not infinite:
        raise InputError("camera", field, value, expected)
    return float(value)


def lens_state(
    *,
    nominal_mm: float | None,
    efl_mm: float,
    pinhole_mm: float,
    entrance_pupil_mm: float,
    f_number: float,
    transmittance: float | None = 1.0,
    squeeze: float | None = 1.0,
) -> dict[str, Any]:
    """Return the table `lens_state` of a camera's settings; None where a number is not defined.

    Args:
        nominal_mm: focal length at infinity, None where nothing is engraved.
        efl_mm, pinhole_mm: as in the module.
        entrance_pupil_mm: distance from the film towards the scene.
        f_number: focal length over the entrance pupil's diameter in this state.
        transmittance: light on the axis over that of a lens without loss or aberrations.
        squeeze: as in the module.
    """
    t_stop = f_number / math.sqrt(transmittance) if transmittance else None
    engraved = None if nominal_mm is None else round(abs(nominal_mm), 0 if abs(nominal_mm) >= 10 else 1)
    found = {
        "nominal_focal_length_mm": engraved,
        "effective_focal_length_mm": efl_mm,
        "pinhole_focal_length_mm": pinhole_mm,
        "entrance_pupil_offset_mm": entrance_pupil_mm,
        "f_number": f_number,
        "t_stop": t_stop,
        "squeeze": squeeze,
    }
    return {k: float(v) if v is not None and math.isfinite(v) else None for k, v in found.items()}


def ideal_state(
    efl_mm: float, f_number: float, pinhole_mm: float, entrance_pupil_mm: float | None = None
) -> dict[str, Any]:
    """Return the table `lens_state` of an ideal lens.

    It has no engraved figures, all light passes, and the pupil lies where the pinhole would be.
    """
    pupil = pinhole_mm if entrance_pupil_mm is None else entrance_pupil_mm
    return lens_state(nominal_mm=None, efl_mm=efl_mm, pinhole_mm=pinhole_mm, entrance_pupil_mm=pupil, f_number=f_number)
