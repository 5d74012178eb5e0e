"""Cameras that are a point: the pinhole, and fisheye projections to compare lenses with.

One ray a film point, everything in focus. With r = f rho(theta) on the film, a small hole of area A gives E = L A c
dOmega / dA_film, for what enters is what arrives (conservation of etendue): c is the hole's foreshortening. Projections
that end at 90 degrees have a flat hole, c = cos(theta), as the pinhole; those that see beyond have one that turns with
the ray, c = 1, as the entrance pupils of real fisheyes nearly do. Relative to the axis E is then

    rectilinear     rho = tan(theta)           cos^4(theta)       (the pinhole)
    orthographic    rho = sin(theta)           1                  flat hole, to 90 degrees
    equidistant     rho = theta                sin(theta)/theta   to 180 degrees
    equisolid       rho = 2 sin(theta/2)       1                  to 180 degrees
    stereographic   rho = 2 tan(theta/2)       cos^4(theta/2)     up to 180 degrees, on a film without end

Source of the projections: Miyamoto 1964, "Fish Eye Lens", J. Opt. Soc. Am. 54(8).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FilmPoints, FloatArray, RayDifferentials
from neurolens.cameras.sampling import arrived, ideal_state, positive, sound
from neurolens.lens.shot import check_film

Array = NDArray[Any]
Function = Callable[[Array], Array]


@dataclass(frozen=True)
class Projection:
    """A projection of focal length 1.

    Attributes:
        angle, slope: theta in rad and d theta / d rho of rho. radius: rho of theta. falloff: E / E(axis) of theta.
        end: of rho; nothing is seen from there on. flat: whether the hole is flat.
    """

    angle: Function
    slope: Function
    radius: Function
    falloff: Function
    end: float
    flat: bool = False


PROJECTIONS = {
    "equidistant": Projection(
        lambda rho: rho, np.ones_like, lambda theta: theta, lambda theta: np.sinc(theta / math.pi), math.pi
    ),
    "equisolid": Projection(
        lambda rho: 2 * np.arcsin(rho / 2),
        lambda rho: 1 / np.sqrt((1 - rho / 2) * (1 + rho / 2)),
        lambda theta: 2 * np.sin(theta / 2),
        np.ones_like,
        2.0,
    ),
    "stereographic": Projection(
        lambda rho: 2 * np.arctan(rho / 2),
        lambda rho: 1 / (1 + rho * rho / 4),
        lambda theta: 2 * np.tan(theta / 2),
        lambda theta: np.cos(theta / 2) ** 4,
        math.inf,
    ),
    "orthographic": Projection(
        np.arcsin, lambda rho: 1 / np.sqrt((1 - rho) * (1 + rho)), np.sin, np.ones_like, 1.0, flat=True
    ),
}
_RECTILINEAR = Projection(
    np.arctan, lambda rho: 1 / (1 + rho * rho), np.tan, lambda theta: np.cos(theta) ** 4, math.inf, flat=True
)


class Fisheye:
    """A hole at distance `focal_length_mm` from the film whose picture obeys a fisheye projection.

    Args:
        projection: one of `PROJECTIONS`.
        focal_length_mm: focal length of the projection.
        film_mm: width and height of the film.
        field_deg: full field of view, beyond which the film is dark; None sees as far as the projection goes.
        f_number: nominal, as the pinhole's.

    Raises:
        InputError: an unknown projection, a length, field or f-number not above 0, a field that it does not see.
    """

    dispersive = False
    achromatic = True
    wavelength_nm: tuple[float, float] | None = None

    def __init__(
        self,
        projection: str,
        focal_length_mm: float,
        film_mm: tuple[float, float] = (36.0, 24.0),
        *,
        field_deg: float | None = None,
        f_number: float = 8.0,
    ) -> None:
        if projection not in PROJECTIONS:
            raise InputError("camera", "projection", projection, f"one of: {', '.join(PROJECTIONS)}")
        self.name = f"fisheye-{projection}"
        self.projection = PROJECTIONS[projection]
        self.widest_rad = check_field(projection, field_deg)
        self._set(focal_length_mm, film_mm, f_number, field_deg=2 * math.degrees(self.widest_rad))

    def _set(self, focal_length_mm: float, film_mm: tuple[float, float], f_number: float, **more: float) -> None:
        self.focal_length_mm, self.film_mm = positive("focal_length_mm", focal_length_mm), check_film(film_mm)
        self.settings: dict[str, Any] = {
            "camera": self.name,
            "efl_mm": self.focal_length_mm,
            "f_number": positive("f_number", f_number),
            "focus_m": None,
            **more,
            "film_mm": list(self.film_mm),
            "lens_state": ideal_state(self.focal_length_mm, f_number, self.focal_length_mm),
        }

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays through the hole for film points [2, N] in mm; pupil and wavelength change nothing."""
        rho, towards, lit = self._place(film_mm)
        theta = self.projection.angle(rho)
        lit &= theta <= np.float32(self.widest_rad)
        direction = np.empty((3, film_mm.shape[1]), np.float32)
        direction[:2] = -towards * (np.sin(theta) * lit)
        direction[2] = -np.where(lit, np.cos(theta), np.float32(1))
        origin = np.zeros_like(direction)
        origin[2] = -1e-3 * self.focal_length_mm
        weight = (self.projection.falloff(theta) * lit).astype(np.float32)
        status = np.where(lit, st.PASSED, st.OUTSIDE_DOMAIN).astype(np.int32)
        return sound(CameraRays(origin, direction, weight, status), np.ones_like(rho), pupil, wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, with their differentials; all rays start at the hole."""
        rays = self.sample(film_mm, pupil, wavelength_nm)
        rho, towards, _ = self._place(film_mm)
        theta = self.projection.angle(rho)
        along = self.projection.slope(rho)  # of theta; across the radius directions turn by sin(theta) / rho
        across = np.where(rho > 0, np.sin(theta) / np.where(rho > 0, rho, 1), np.float32(1))
        radial = np.cos(theta) * along - across
        moves = np.zeros((3, 2, film_mm.shape[1]), np.float32)
        for axis in (0, 1):
            moves[axis, axis] = -across
            moves[:2, axis] -= radial * towards * towards[axis]
            moves[2, axis] = np.sin(theta) * along * towards[axis]
        moves *= np.where(rays.status == st.PASSED, np.float32(1 / self.focal_length_mm), np.float32(0))
        return replace(rays, differentials=RayDifferentials(np.zeros_like(moves), moves))

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """The whole weight: the projection's own law."""
        return self.sample(film_mm, pupil, wavelength_nm).weight

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Film points of scene points [3, N] in m through the hole; pupil and wavelength change nothing."""
        origin = np.array([[0.0], [0.0], [-1e-3 * self.focal_length_mm]]) + np.zeros((1, point_m.shape[1]))
        with np.errstate(all="ignore"):
            way = point_m - origin
            side, squared = np.hypot(way[0], way[1]), np.einsum("in,in->n", way, way)
            theta = np.arctan2(side, -way[2])
            film = -self.focal_length_mm * self.projection.radius(theta) * way[:2] / np.where(side > 0, side, 1)
            # A' / E0 of a small hole is the square of its distance from the film, where it faces the ray.
            weight = self.focal_length_mm**2 / squared * (np.cos(theta) if self.projection.flat else 1)
        beyond = (theta > self.widest_rad) | (self.projection.flat & (way[2] >= 0))
        out = np.where(beyond, st.blocked(0, st.MISSED), st.OUTSIDE_DOMAIN)
        # Straight behind, the projection has no direction to lay the point in.
        lit = ~beyond & (self.projection.radius(theta) < self.projection.end) & (theta < math.pi)
        status = np.where(lit, st.PASSED, out).astype(np.int32)
        return arrived(film, origin, point_m, weight, status, wavelength_nm)

    def _place(self, film_mm: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """rho [N] and the unit vectors [2, N] from the axis to film points, and which lie within the projection."""
        scaled = film_mm * np.float32(1 / self.focal_length_mm)
        with np.errstate(over="ignore", invalid="ignore"):
            rho = np.hypot(scaled[0], scaled[1])
            lit = (rho < np.float32(self.projection.end)) & (rho < np.float32(1e18))
        rho = np.where(lit, rho, np.float32(0))
        towards = np.where(lit, scaled, np.float32(0)) / np.where(rho > 0, rho, np.float32(1))
        return rho.astype(np.float32, copy=False), towards.astype(np.float32, copy=False), np.asarray(lit)


class Pinhole(Fisheye):
    """A hole at distance `focal_length_mm` from the film.

    The hole stands for a lens of the nominal f-number, E = pi L / (4 N^2) on the axis, so the weight is cos^4 of the
    angle to the axis, 1 on the axis; `f_number` is kept in the settings and changes no ray.

    Args:
        focal_length_mm: distance from hole to film.
        film_mm: width and height of the film.
        f_number: nominal.

    Raises:
        InputError: a length or the f-number is not a finite number above 0.
    """

    rays_a_call = MANY_RAYS_A_CALL

    def __init__(
        self, focal_length_mm: float, film_mm: tuple[float, float] = (36.0, 24.0), f_number: float = 8.0
    ) -> None:
        self.name, self.projection, self.widest_rad = "pinhole", _RECTILINEAR, math.pi / 2
        self._set(focal_length_mm, film_mm, f_number)

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays through the hole, without the angles that the other projections need."""
        count = film_mm.shape[1]
        direction = np.empty((3, count), np.float32)
        np.divide(film_mm, np.float32(-self.focal_length_mm), out=direction[:2])
        direction[2] = -1.0
        with np.errstate(over="ignore", invalid="ignore"):
            cos2 = 1.0 / (1.0 + direction[0] ** 2 + direction[1] ** 2)
            direction *= np.sqrt(cos2)
        origin = np.zeros((3, count), np.float32)
        origin[2] = -1e-3 * self.focal_length_mm
        rays = CameraRays(origin, direction, (cos2 * cos2).astype(np.float32), np.zeros(count, np.int32))
        return sound(rays, cos2, pupil, wavelength_nm)


def check_field(projection: str, field_deg: float | None) -> float:
    """Half of a full field of view, in rad: at most what the projection sees, which None takes.

    Raises:
        InputError: a field that is not above 0, or beyond the projection.
    """
    widest = 180.0 if PROJECTIONS[projection].flat else 360.0
    if field_deg is None:
        return math.radians(widest / 2)
    if not 0 < field_deg <= widest:
        raise InputError(f"camera fisheye-{projection}", "field_deg", field_deg, f"degrees up to {widest:g}")
    return math.radians(field_deg) / 2
