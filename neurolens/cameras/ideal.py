"""Ideal lenses: the thick lens has the principal planes and pupils of a real one; in the thin lens all coincide.

The thick lens is that of Kolb, Mitchell and Hanrahan 1995, "A Realistic Camera Model for Computer Graphics". A ray of a
film point through the exit pupil meets the rear principal plane H', and continues at the same height from the front one
H, towards the object point conjugate to the film point. So focus is perfect on one plane, and there are no aberrations
and no rims. But where the film's picture is, how large, and how its light falls off (cos^4 about the exit pupil) are
the real lens's, to first order.

The pinhole and the fisheye projections, to compare lenses with, are cameras that are a point: they have one ray for
each film point and everything in focus. With r = f rho(theta) on the film, a small hole of area A gives E = L A c
dOmega / dA_film (what enters arrives), where c is the hole's foreshortening. Projections that end at 90 degrees have a
flat hole, c = cos(theta), as the pinhole has. Those that see beyond have a hole that turns with the ray, c = 1, as the
entrance pupils of real fisheyes nearly do. Relative to the axis E is then

    rectilinear     rho = tan(theta)           cos^4(theta)       (the pinhole)
    orthographic    rho = sin(theta)           1                  flat hole, to 90 degrees
    equidistant     rho = theta                sin(theta)/theta   to 180 degrees
    equisolid       rho = 2 sin(theta/2)       1                  to 180 degrees
    stereographic   rho = 2 tan(theta/2)       cos^4(theta/2)     up to 180 degrees, on a film without end

The projections are those of Miyamoto 1964, "Fish Eye Lens", J. Opt. Soc. Am. 54(8).
"""

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import camera_rays, concentric_disk, unit_disc
from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FilmPoints, FloatArray, RayDifferentials, towards
from neurolens.cameras.sampling import (
    LEAST_COS2,
    arrived,
    ideal_state,
    positive,
    sound,
    stratified,
)
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.paraxial import film_z_of_planes_mm
from neurolens.optics.lens.shot import check_film

_QUADRATURE = 256  # points a side of the square


class ThickLens:
    """An ideal lens with two principal planes and two pupils; planes are z in mm, lens frame.

    Args:
        focal_length_mm: focal length.
        f_number: focal length over the diameter of the entrance pupil; it does not change with focus.
        focus_m: distance from film to the object in focus, or infinity.
        film_mm: width and height of the film.
        principal_z_mm: front and rear principal planes H and H'.
        entrance_pupil_z_mm: None puts both pupils on the principal planes. The exit pupil is the image of the entrance
            pupil, at infinity for one in the front focal plane.
        film_at_mm: film plane; None follows from `focus_m`. If given, it decides, and `focus_m` is only written to the
            settings.
        aperture: shape of the opening; None is round.
        name: for reports.

    Raises:
        InputError: a value that is not finite or not above 0, `focus_m` below 4 focal lengths, a film in front of H' or
            in the exit pupil.
    """

    dispersive = False
    achromatic = True
    wavelength_nm: tuple[float, float] | None = None
    rays_a_call = MANY_RAYS_A_CALL
    _part = 1.0  # part of the exposure on the axis that a shape lets through

    def __init__(
        self,
        focal_length_mm: float,
        f_number: float,
        focus_m: float,
        film_mm: tuple[float, float] = (36.0, 24.0),
        *,
        principal_z_mm: tuple[float, float] = (0.0, 0.0),
        entrance_pupil_z_mm: float | None = None,
        film_at_mm: float | None = None,
        aperture: Aperture | None = None,
        name: str = "thick",
    ) -> None:
        self.name, self.film_mm, self.aperture = name, check_film(film_mm), aperture
        self.focal_length_mm = f = positive("focal_length_mm", focal_length_mm)
        self.f_number = positive("f_number", f_number)
        self.focus_m = positive("focus_m", focus_m, infinite=True)
        front, rear = (_finite("principal_z_mm", z) for z in principal_z_mm)
        self.front_z_mm, self.pupil_z_mm = front, front
        if entrance_pupil_z_mm is not None:
            self.pupil_z_mm = _finite("entrance_pupil_z_mm", entrance_pupil_z_mm)
        self.film_z_mm = film_z_of_planes_mm(f, front, rear, self.focus_m) if film_at_mm is None else float(film_at_mm)
        self.image_distance_mm = positive("film_at_mm behind H'", self.film_z_mm - rear)
        self.radius_mm = f / (2 * self.f_number)
        # Newton's distances from the focal points: x of the entrance pupil, x' = s' - f of the film. The exit pupil
        # lies at -f^2 / x and is f / x times as large: seen from the film F, a point e of it has the slopes (f e - x F)
        # / (x x' + f^2).
        self._x = self.pupil_z_mm - (front - f)
        self._seen = self._x * (self.image_distance_mm - f) + f * f
        if abs(self._seen) < 1e-6 * f * f:
            raise InputError("camera", "entrance_pupil_z_mm", self.pupil_z_mm, "an exit pupil away from the film")
        self._per_depth = 1 / f - 1 / self.image_distance_mm  # 1 / (distance from H to the object plane)
        self.settings: dict[str, Any] = {
            "camera": "thick",
            "efl_mm": f,
            "f_number": self.f_number,
            "focus_m": None if math.isinf(self.focus_m) else self.focus_m,
            "film_mm": list(self.film_mm),
            "film_z_mm": self.film_z_mm,
            "principal_z_mm": [front, rear],
            "entrance_pupil_z_mm": self.pupil_z_mm,
            "aperture": aperture and aperture.settings(),
            "lens_state": ideal_state(f, self.f_number, self._seen / f, self.film_z_mm - self.pupil_z_mm),
        }
        # The exposure on the axis is pi rho^2 / (1 + rho^2), with the slope rho of the exit pupil's rim.
        self._exposure = 1.0 + (self.radius_mm * f / self._seen) ** 2
        self._run: Callable[[dict[str, FloatArray]], dict[str, NDArray[Any]]] = self._evaluated
        if aperture is not None:
            square, wavelength = stratified(_QUADRATURE, (550.0, 550.0))
            self._part = float(self.sample(np.zeros_like(square), square, wavelength).weight.mean(dtype=np.float64))

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays for film points [2, N] in mm and pupil samples [2, N]; the wavelength changes nothing."""
        given = {"film_mm": film_mm, "square": pupil, "wavelength_nm": wavelength_nm[None]}
        with np.errstate(all="ignore"):  # points that are not sound give NaN
            return camera_rays(self._run({k: np.ascontiguousarray(v, np.float32) for k, v in given.items()}))

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, with their differentials; the origins move on the front principal plane."""
        rays = self.sample(film_mm, pupil, wavelength_nm)
        rise = 1 - self._x * self.image_distance_mm / self._seen  # of the height, by the film point
        slope = np.zeros((3, 2, film_mm.shape[1]), np.float32)
        slope[0, 0] = slope[1, 1] = -1 / self.image_distance_mm - self._per_depth * rise
        turns = towards(rays.direction / -rays.direction[2], slope, rays.origin_m).direction
        moves = np.zeros_like(slope)
        moves[0, 0] = moves[1, 1] = 1e-3 * rise
        return replace(rays, differentials=RayDifferentials(moves, turns))

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return cos^4 of the angles between the axis and the rays from exit pupil to film."""
        slope = self._slopes(film_mm, concentric_disk(pupil) * np.float32(self.radius_mm))
        return np.square(1.0 / (1.0 + np.einsum("in,in->n", slope, slope))).astype(np.float32)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Return film points for scene points [3, N] in m, through points of the entrance pupil chosen by `pupil`."""
        entrance = concentric_disk(pupil).astype(np.float64) * self.radius_mm
        with np.errstate(all="ignore"):
            point = 1e3 * point_m.astype(np.float64)
            depth = self.pupil_z_mm - self.film_z_mm - point[2]
            slope = (point[:2] - entrance) / depth  # forwards, for each unit of depth
            height = entrance + slope * (self.pupil_z_mm - self.front_z_mm)
            film = -self.image_distance_mm * (slope + height * self._per_depth)
            # This is the weight of `sample`, times the mm^2 of film for each m^2 of a plane square to the ray.
            tangent2 = (self._slopes(film, entrance) ** 2).sum(0)
            scale = self.image_distance_mm * (1 + self._per_depth * (self.pupil_z_mm - self.front_z_mm)) / depth
            weight = 1e6 * self._exposure / self._part / (1 + tangent2) ** 2 * scale**2
            weight *= np.sqrt(1 + (slope**2).sum(0))
        plane = np.full((1, depth.size), self.front_z_mm - self.film_z_mm)
        behind = np.where(depth <= 0, st.blocked(0, st.MISSED), st.OUTSIDE_DOMAIN)
        status = self._stopped(entrance, np.where(depth > 0, st.PASSED, behind).astype(np.int32))
        return arrived(film, 1e-3 * np.concatenate([height, plane]), point_m, weight, status, wavelength_nm)

    def compiled(self) -> Self:
        """Return the camera as compiled C; with a mask in its stop it stays as it is, for a mask's table is too large.

        Raises:
            InputError: there is no C compiler, or it fails.
        """
        from neurolens.cameras.lenscamera import CompiledProgram

        other = copy(self)
        if self.aperture is None or self.aperture.mask is None:
            other._run = CompiledProgram.of(ideal_graph(self.aperture), self._numbers, np.zeros((1, 1, 8), np.float32))
        return other

    def _evaluated(self, rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        mask = {} if self.aperture is None or self.aperture.mask is None else {"mask": self.aperture.table}
        numbers = {name: np.array([[value]], np.float32) for name, value in self._numbers.items()}
        return evaluate(ideal_graph(self.aperture), rays | numbers | mask)

    @property
    def _numbers(self) -> dict[str, float]:
        """Return the inputs of `ideal_graph` for a whole call."""
        return {
            "radius_mm": self.radius_mm,
            "spread": self.focal_length_mm / self._seen,
            "lean": -self._x / self._seen,
            "image_distance_mm": self.image_distance_mm,
            "per_image_distance": -1 / self.image_distance_mm,
            "per_depth": -self._per_depth,
            "scale": self._exposure / self._part,
            "place_m": 1e-3 * (self.front_z_mm - self.film_z_mm),
        }

    def _slopes(self, film_mm: NDArray[Any], entrance_mm: NDArray[Any]) -> NDArray[Any]:
        """Return the slopes [2, N] of rays from film points towards the images of points of the entrance pupil."""
        return entrance_mm * (self.focal_length_mm / self._seen) - film_mm * (self._x / self._seen)

    def _stopped(self, opening_mm: NDArray[Any], status: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the status; rays at points [2, N] of the opening that lie outside its shape get the rim's."""
        if self.aperture is None:
            return status
        inside = self.aperture.inside(opening_mm[0], opening_mm[1], self.radius_mm)
        return np.where(inside | (status != st.PASSED), status, st.blocked(0, st.RIM)).astype(np.int32)


@lru_cache(maxsize=16)
def ideal_graph(aperture: Aperture | None = None) -> Graph:
    """Write the rays of an ideal lens as a graph, whose numbers are inputs of the call (`ThickLens._numbers`).

    Its other inputs and its outputs are those of `lensfilm.whole_camera`.
    """
    g = Graph()
    film, square, light = g.input("film_mm", 2), g.input("square", 2), g.input("wavelength_nm")
    names = "radius_mm spread lean image_distance_mm per_image_distance per_depth scale place_m"
    radius_mm, spread, lean, distance, per_distance, per_depth, scale, place = (
        g.input(name, per_call=True) for name in names.split()
    )
    entrance = unit_disc(square) * radius_mm
    slope = entrance * spread + film * lean
    height = film + slope * distance
    across = film * per_distance + height * per_depth  # an object plane at infinity is no special case
    direction = g.concat(across, g.constant(-1.0)) * (1.0 / (g.square(across) + 1.0).sqrt())
    cos2 = 1.0 / (1.0 + g.square(slope))
    status = g.constant(float(st.PASSED))
    if aperture is not None:
        status = g.select(aperture.opening(g, entrance, radius_mm), status, float(st.blocked(0, st.RIM)))
    sound = cos2.between(LEAST_COS2, 2.0) & light.between(1e-30, 1e30)
    for part in g.split(square, (1, 1)):
        sound = sound & part.between(0.0, 1.0)
    status = g.select(sound, status, float(st.OUTSIDE_DOMAIN))
    g.outputs["ray"] = g.concat(height * 1e-3, place, direction)
    g.outputs["weight"] = g.select(status <= float(st.PASSED), cos2 * cos2 * scale, 0.0)
    g.outputs["status"] = status.whole()
    return g


class ThinLens(ThickLens):
    """A thin lens of focal length `focal_length_mm` and diameter `focal_length_mm / f_number`.

    Args:
        focal_length_mm: focal length.
        f_number: focal length over aperture diameter; it does not change with focus.
        focus_m: distance from film to the object in focus, or infinity.
        film_mm: width and height of the film.
        aperture: shape of the opening; None is round.
        film_offset_mm: moves the film away from the lens (negative: towards it) after focusing.

    Raises:
        InputError: a value is not above 0, `focus_m` is below 4 focal lengths, or the offset leaves no way to the film.
    """

    takes = frozenset({"focal_length_mm", "aperture", "film_offset_mm"})  # settings of a shot besides those of all

    def __init__(
        self,
        focal_length_mm: float,
        f_number: float,
        focus_m: float,
        film_mm: tuple[float, float] = (36.0, 24.0),
        *,
        aperture: Aperture | None = None,
        film_offset_mm: float = 0.0,
    ) -> None:
        film_at_mm = None
        if film_offset_mm:
            focused = film_z_of_planes_mm(
                positive("focal_length_mm", focal_length_mm), 0.0, 0.0, positive("focus_m", focus_m, infinite=True)
            )
            film_at_mm = positive("film_offset_mm, film distance", focused + film_offset_mm)
        super().__init__(
            focal_length_mm, f_number, focus_m, film_mm, film_at_mm=film_at_mm, aperture=aperture, name="thin"
        )
        for key in ("film_z_mm", "principal_z_mm", "entrance_pupil_z_mm"):
            del self.settings[key]
        self.settings |= {"camera": "thin", "film_offset_mm": film_offset_mm}


def _finite(field: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError("camera", field, value, "a finite number of mm")
    return float(value)


Array = NDArray[Any]
Function = Callable[[Array], Array]


@dataclass(frozen=True)
class Projection:
    """A projection of focal length 1, in theta, the angle to the axis (rad), and rho, the distance on the film.

    Attributes:
        angle: theta of rho.
        slope: d theta / d rho of rho.
        radius: rho of theta.
        falloff: E / E(axis) of theta.
        end: the rho from which on nothing is seen.
        flat: whether the hole is flat.
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
    """A hole at the distance `focal_length_mm` from the film whose picture obeys a fisheye projection.

    Args:
        projection: one of `PROJECTIONS`.
        focal_length_mm: focal length of the projection.
        film_mm: width and height of the film.
        field_deg: full field of view, beyond which the film is dark; None sees as far as the projection goes.
        f_number: a nominal one, as the pinhole's.

    Raises:
        InputError: an unknown projection, a length, field or f-number not above 0, or a field that the projection
            cannot see.
    """

    takes = frozenset({"focal_length_mm", "field_deg"})
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
        """Return rays through the hole for film points [2, N] in mm; pupil and wavelength change nothing."""
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
        along = self.projection.slope(rho)  # of theta; across the radius, directions turn by sin(theta) / rho
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
        """Return the whole weight, which is the projection's own law."""
        return self.sample(film_mm, pupil, wavelength_nm).weight

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Return film points for scene points [3, N] in m through the hole; pupil and wavelength change nothing."""
        origin = np.array([[0.0], [0.0], [-1e-3 * self.focal_length_mm]]) + np.zeros((1, point_m.shape[1]))
        with np.errstate(all="ignore"):
            way = point_m - origin
            side, squared = np.hypot(way[0], way[1]), np.einsum("in,in->n", way, way)
            theta = np.arctan2(side, -way[2])
            film = -self.focal_length_mm * self.projection.radius(theta) * way[:2] / np.where(side > 0, side, 1)
            # For a small hole A' / E0 is its squared distance from the film, where it faces the ray.
            weight = self.focal_length_mm**2 / squared * (np.cos(theta) if self.projection.flat else 1)
        beyond = (theta > self.widest_rad) | (self.projection.flat & (way[2] >= 0))
        out = np.where(beyond, st.blocked(0, st.MISSED), st.OUTSIDE_DOMAIN)
        # Straight behind, the projection has no direction in which to lay the point.
        lit = ~beyond & (self.projection.radius(theta) < self.projection.end) & (theta < math.pi)
        status = np.where(lit, st.PASSED, out).astype(np.int32)
        return arrived(film, origin, point_m, weight, status, wavelength_nm)

    def _place(self, film_mm: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return rho [N], the unit vectors [2, N] from the axis to film points, and which lie within the projection."""
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

    takes = frozenset({"focal_length_mm"})
    rays_a_call = MANY_RAYS_A_CALL

    def __init__(
        self, focal_length_mm: float, film_mm: tuple[float, float] = (36.0, 24.0), f_number: float = 8.0
    ) -> None:
        self.name, self.projection, self.widest_rad = "pinhole", _RECTILINEAR, math.pi / 2
        self._set(focal_length_mm, film_mm, f_number)

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays through the hole, without the angles that the other projections need."""
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
    """Return half of a full field of view, in rad; None takes all that the projection sees.

    Raises:
        InputError: a field that is not above 0, or that the projection does not see.
    """
    widest = 180.0 if PROJECTIONS[projection].flat else 360.0
    if field_deg is None:
        return math.radians(widest / 2)
    if not 0 < field_deg <= widest:
        raise InputError(f"camera fisheye-{projection}", "field_deg", field_deg, f"degrees up to {widest:g}")
    return math.radians(field_deg) / 2
