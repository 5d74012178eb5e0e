"""First-order (paraxial) data: focal length, principal planes, pupils, focus, by default at `Lens.reference_nm`.

The functions that place a film, a pupil or a framing from a few numbers alone, and the colours of best focus, serve
both lenses and cameras.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.optics.lens.glass import check_light, index_of
from neurolens.optics.lens.prescription import Lens

Meridian = Literal["x", "y"]
COLOURS = 7  # wavelengths that stand for a range of light
_SAME_NM = 0.1  # lens files round spectral lines by as much
_FAR_M = 1e15  # an object farther off counts as at infinity, for its image is the same to the last digit of a float64
_LEAST = 1e-3  # least weight of a colour, also where the eye sees none: infrared light has a focus, too


@dataclass(frozen=True)
class FirstOrder:
    """Holds the first-order data of a lens, in mm and in the lens frame.

    Attributes:
        efl_mm: effective focal length of the image side (negative for a diverging lens): -y / u' of a ray that comes
            parallel to the axis. The media in front and behind are those of the lens.
        back_focus_mm: distance from the last vertex to the rear focal point.
        rear_focal_z_mm, front_focal_z_mm: focal points on the axis.
        rear_principal_z_mm, front_principal_z_mm: principal points H' and H.
        entrance_pupil_z_mm, entrance_pupil_diameter_mm: the stop's paraxial image as seen from the scene.
        exit_pupil_z_mm, exit_pupil_diameter_mm: the stop's image as seen from the film; z is infinite for an
            image-telecentric lens.
        f_number: focal length over the diameter of the entrance pupil; infinite for a closed stop.
        front_efl_mm: focal length of the object side: `efl_mm` times the index in front over that behind.
    """

    efl_mm: float
    back_focus_mm: float
    rear_focal_z_mm: float
    front_focal_z_mm: float
    rear_principal_z_mm: float
    front_principal_z_mm: float
    entrance_pupil_z_mm: float
    entrance_pupil_diameter_mm: float
    exit_pupil_z_mm: float
    exit_pupil_diameter_mm: float
    f_number: float
    front_efl_mm: float

    def image_z_mm(self, object_z_mm: float) -> float:
        """Return the z (mm) of the paraxial image of a point on the axis, by Newton's x x' = -f f'."""
        return self.rear_focal_z_mm - self.efl_mm * self.front_efl_mm / (object_z_mm - self.front_focal_z_mm)


@dataclass(frozen=True)
class System:
    """A lens to first order.

    Attributes:
        curvature: of the surfaces [S], 1/mm.
        gap_mm: between the surfaces [S - 1].
        index: of the media [S + 1].
        ideal: powers of ideal thin lenses [S], 1/mm; 0 for other surfaces.
    """

    curvature: list[Any]
    gap_mm: list[Any]
    index: list[Any]
    ideal: list[float]

    def turned(self) -> System:
        """Return the system as light from the other side meets it."""
        return System([-c for c in reversed(self.curvature)], self.gap_mm[::-1], self.index[::-1], self.ideal[::-1])

    def behind(self, surface: int) -> System:
        """Return the surfaces behind the given one."""
        rest = slice(surface + 1, None)
        return System(self.curvature[rest], self.gap_mm[rest], self.index[rest], self.ideal[rest])

    def march(self, y: Any, u: Any) -> PathOfRay:
        """Return the paraxial ray of height y (mm) at the first surface and slope u before it.

        Source: Smith, Modern Optical Engineering, ch. 2.
        """
        path = PathOfRay([], [], [])
        n = self.index
        for k, c in enumerate(self.curvature):
            y = y + u * self.gap_mm[k - 1] if k else y
            after = (n[k] * u - y * c * (n[k + 1] - n[k]) - y * self.ideal[k]) / n[k + 1]
            for values, value in zip(path, (y, u, after), strict=True):
                values.append(value)
            u = after
        return path


class PathOfRay(NamedTuple):
    """A paraxial ray: its height at every surface (mm), and its slopes before and after each."""

    y: list[Any]
    before: list[Any]
    after: list[Any]


def system_of(lens: Lens, wavelength_nm: float | None = None, meridian: Meridian = "y") -> System:
    """Return the lens in one meridian at one wavelength; None takes `Lens.reference_nm`."""
    light = lens.reference_nm if wavelength_nm is None else wavelength_nm
    check_light(lens, light)
    curvature = [s.vertex_curvature(meridian) for s in lens.surfaces]
    index = [index_of(medium, light) for medium in lens.media]
    ideal = [s.figure.power for s in lens.surfaces]
    return System(curvature, [s.thickness_mm for s in lens.surfaces[:-1]], index, ideal)


def _pupil(system: System, stop: int) -> tuple[Any, Any]:
    """Return how far behind the last vertex the stop's image lies, and its magnification by the surfaces behind it."""
    behind = system.behind(stop)
    if not behind.curvature:
        return 0.0, 1.0
    slanted = behind.march(system.gap_mm[stop] * 1.0, 1.0)  # from the point of the stop on the axis
    level = behind.march(1.0, 0.0)  # parallel to the axis, at height 1 in the stop
    distance = -slanted.y[-1] / slanted.after[-1] if slanted.after[-1] != 0 else math.inf
    return distance, (level.y[-1] + level.after[-1] * distance if math.isfinite(distance) else math.inf)


def first_order(lens: Lens, wavelength_nm: float | None = None, meridian: Meridian = "y") -> FirstOrder:
    """Return the first-order data of a lens at one wavelength, in one meridian.

    A lens without power (a pinhole, with filters before or behind it) gets its film's centre as the focal point, and as
    its focal length the distance from the hole to the film, by which it maps angles to the film.

    Args:
        wavelength_nm: None takes `Lens.reference_nm`.
        meridian: matters for a lens with cylinders, toroids or biconics.

    Raises:
        InputError: an afocal lens (no finite focal length).
    """
    system, last_z = system_of(lens, wavelength_nm, meridian), lens.vertices_mm[-2]
    turned = system.turned()
    ahead = system.march(1.0, 0.0)
    y, u = ahead.y[-1], ahead.after[-1]
    if u == 0:
        if not is_pinhole(lens):
            plane = f" in the {meridian}-z plane" * lens.anamorphic
            raise InputError(lens.path, "surfaces", f"(an afocal system{plane})", "a lens with a finite focal length")
        return _pinhole(lens, system)
    back = turned.march(1.0, 0.0)
    efl, back_focus = -1.0 / u, -y / u
    front_efl = efl * (system.index[0] / system.index[-1])
    rear_focal, front_focal = last_z + back_focus, back.y[-1] / back.after[-1]
    exit_distance, exit_magnification = _pupil(system, lens.stop_index)
    entrance_distance, entrance_magnification = _pupil(turned, len(lens.surfaces) - 1 - lens.stop_index)
    opening = 2 * lens.stop_radius_mm
    entrance_diameter = opening * abs(entrance_magnification)
    return FirstOrder(
        efl_mm=efl,
        back_focus_mm=back_focus,
        rear_focal_z_mm=rear_focal,
        front_focal_z_mm=front_focal,
        rear_principal_z_mm=rear_focal - efl,
        front_principal_z_mm=front_focal + front_efl,
        entrance_pupil_z_mm=-entrance_distance,
        entrance_pupil_diameter_mm=entrance_diameter,
        exit_pupil_z_mm=last_z + exit_distance,
        exit_pupil_diameter_mm=opening * abs(exit_magnification),
        f_number=abs(efl) / entrance_diameter if entrance_diameter else math.inf,
        front_efl_mm=front_efl,
    )


@dataclass(frozen=True)
class FirstOrderLight:
    """The wavelength of first-order data (nm), and focal length and back focus at the source's primary wavelength.

    `primary` is None where the source states no wavelength or the same one.
    """

    wavelength_nm: float
    primary: AtPrimary | None


@dataclass(frozen=True)
class AtPrimary:
    """Focal length and back focus at the primary wavelength of a lens's source."""

    wavelength_nm: float
    efl_mm: float
    back_focus_mm: float


def light_of(lens: Lens) -> FirstOrderLight:
    """Return the wavelength of first-order data, with focal length and back focus at the source's primary one."""
    at, primary = lens.reference_nm, next(iter(lens.wavelengths_nm), lens.reference_nm)
    found = None
    if abs(primary - at) > _SAME_NM:
        straight = lens.anamorphic and system_of(lens).march(1.0, 0.0).after[-1] == 0  # no power in the y-z plane
        data = first_order(lens, primary, "x" if straight else "y")
        found = AtPrimary(primary, float(data.efl_mm), float(data.back_focus_mm))
    return FirstOrderLight(at, found)


def is_pinhole(lens: Lens) -> bool:
    """Test whether no surface bends light: the lens is a hole, perhaps among plane filters."""
    return all(math.isinf(s.radius_mm) and not s.figure.bends for s in lens.surfaces)


def _pinhole(lens: Lens, system: System) -> FirstOrder:
    """Return the data of a hole among planes; seen through a plane plate of index n, distances are n times as short."""
    k, n, front, rear = lens.stop_index, len(lens.surfaces), system.index[0], system.index[-1]
    depth = [s.thickness_mm / i for s, i in zip(lens.surfaces, system.index[1:], strict=True)]
    last_z = lens.vertices_mm[n - 1]
    film = lens.vertices_mm[n] if lens.film_z_mm is None else lens.film_z_mm
    behind, opening = rear * sum(depth[k : n - 1]), 2 * lens.stop_radius_mm
    entrance, exit_, efl = front * sum(depth[:k]), last_z - behind, film - last_z + behind
    f_number, front_efl = efl / opening if opening else math.inf, efl * (front / rear)
    planes = film, entrance - front_efl, exit_, entrance
    return FirstOrder(efl, film - last_z, *planes, entrance, opening, exit_, opening, f_number, front_efl)


def chief_reach_mm(lens: Lens) -> float:
    """Return film height (mm) over slope in the scene of the paraxial chief ray, which passes the entrance pupil."""
    data = first_order(lens)
    assert lens.film_z_mm is not None
    focal_points = data.front_focal_z_mm, data.rear_focal_z_mm
    return reach_mm(data.efl_mm, data.front_efl_mm, focal_points, data.entrance_pupil_z_mm, lens.film_z_mm)


def framing_mm(lens: Lens, focus_m: float) -> tuple[float, float]:
    """Return the image distances (mm) with which two ideal lenses show the plane in focus as large as the lens does.

    With them, the chief rays of a film point meet that plane in one point, also where the film is not in the paraxial
    image.

    Args:
        lens: as placed by `set_lens`.
        focus_m: distance of the plane from the film, m.

    Returns:
        The image distance of a thin lens or a hole that stands so far before the film, and that of a lens in the front
        principal plane of this one.
    """
    data, reach = first_order(lens), chief_reach_mm(lens)
    if math.isinf(focus_m):
        return reach, reach
    assert lens.film_z_mm is not None
    plane = lens.film_z_mm - 1000 * focus_m
    size = (data.entrance_pupil_z_mm - plane) / reach  # size of the plane in focus over its size on the film
    return 1000 * focus_m / (1 + size), (data.front_principal_z_mm - plane) / size


def stop_radius_mm(lens: Lens, f_number: float) -> float:
    """Return the radius of the stop (mm) for an f-number, focal length over entrance pupil at infinity focus."""
    # Scaled from an opening of 1 mm, for a closed stop has no f-number that could be scaled.
    return first_order(lens.with_stop_radius(1.0)).f_number / f_number


def distance_m(focus_m: float) -> float:
    """Return a distance (m); infinity where a float64 cannot tell the image of such an object from one at infinity."""
    return math.inf if focus_m > _FAR_M else focus_m


def film_z_mm(lens: Lens, focus_m: float) -> float:
    """Return the z (mm) of the film that focuses an object `focus_m` metres from it; see `film_z_of_planes_mm`.

    The film of a pinhole stays in place: it is equally sharp at every distance.

    Raises:
        InputError: an object nearer than four focal lengths, for which no film plane exists.
    """
    data = first_order(lens)
    if is_pinhole(lens):
        return float(data.rear_focal_z_mm)
    planes = data.front_principal_z_mm, data.rear_principal_z_mm
    return film_z_of_planes_mm(data.efl_mm, *planes, focus_m, lens.path, data.front_efl_mm / data.efl_mm)


def image_z_mm(lens: Lens, object_z_mm: float) -> float:
    """Return the z (mm) of a point's paraxial image on the axis, at `Lens.reference_nm`; a pinhole's is its film."""
    data = first_order(lens)
    return float(data.rear_focal_z_mm if is_pinhole(lens) else data.image_z_mm(object_z_mm))


def film_z_of_planes_mm(
    efl_mm: float,
    front_principal_z_mm: float,
    rear_principal_z_mm: float,
    focus_m: float,
    file: str | Path = "camera",
    ratio: float = 1.0,
) -> float:
    """Return the z (mm) of the film that focuses an object `focus_m` metres (or inf) from it.

    Let D be the distance less the separation of the principal planes, f the focal length and r the `ratio`. The image
    lies behind the rear principal plane by the smaller root of s'^2 - B s' + D f = 0, with B = D + (1 - r) f. Written
    as 2 D f / (B + sqrt(B^2 - 4 D f)) it keeps its digits, where (B - sqrt(B^2 - 4 D f)) / 2 would be the difference of
    two nearly equal numbers for a far object.

    Args:
        efl_mm, front_principal_z_mm, rear_principal_z_mm: of the lens, in the frame of the result.
        file: what an error names.
        ratio: index of the medium in front of the lens over that of the medium behind it.

    Raises:
        InputError: an object nearer than (1 + sqrt(r))^2 focal lengths, which is four where both media are the same, or
            a distance that is not a positive number.
    """
    if not focus_m > 0:
        raise InputError(file, "focus_m", focus_m, "a distance in m above 0, or inf")
    if math.isinf(distance_m(focus_m)):
        return rear_principal_z_mm + efl_mm
    efl_mm, focus_m = float(efl_mm), float(focus_m)  # numbers of numpy would warn of overflow
    separation = rear_principal_z_mm - front_principal_z_mm
    d = 1000.0 * focus_m - separation
    lengths = (1 + math.sqrt(ratio)) ** 2
    if not (d > 0 and d >= lengths * efl_mm):
        nearest = (max(lengths * efl_mm, 0.0) + separation) / 1000
        count = "four" if ratio == 1 else f"{lengths:.3g}"
        raise InputError(file, "focus_m", focus_m, f"at least {nearest:.4g} m, {count} focal lengths")
    b = d + (1 - ratio) * efl_mm
    return rear_principal_z_mm + 2 * d * efl_mm / (b + math.sqrt(max(b * b - 4 * d * efl_mm, 0.0)))


def index_ratio(card_lens: Mapping[str, Any]) -> float:
    """The index in front of a model's lens over that behind it; 1 where the card's table of the lens has none."""
    return float(card_lens.get("index_ratio", 1.0))


def film_z_of_card_mm(card_lens: Mapping[str, Any], focus_m: float) -> float:
    """Return `film_z_of_planes_mm` for the lens of a model's card."""
    efl, front, rear = (card_lens[key] for key in ("efl_mm", "front_principal_z_mm", "rear_principal_z_mm"))
    return film_z_of_planes_mm(efl, front, rear, focus_m, ratio=index_ratio(card_lens))


def reach_mm(
    efl_mm: float, front_efl_mm: float, focal_z_mm: tuple[float, float], entrance_pupil_z_mm: float, film_z_mm: float
) -> float:
    """Return film height (mm) over the slope of the chief ray, for a lens known by its focal points and pupil.

    It is f + x' e / f', with f and f' the focal lengths of the object and image sides, x' the film's distance behind
    the rear focal point and e the pupil's behind the front one.
    """
    film, pupil = film_z_mm - focal_z_mm[1], entrance_pupil_z_mm - focal_z_mm[0]
    return float(front_efl_mm + film * pupil / efl_mm)


def entrance_pupil_z_mm(
    efl_mm: float, front_efl_mm: float, focal_z_mm: tuple[float, float], exit_pupil_z_mm: float
) -> float:
    """Return the z (mm) of the entrance pupil whose image is the exit pupil (inf allowed), by x x' = -f f'."""
    behind = exit_pupil_z_mm - focal_z_mm[1]
    return focal_z_mm[0] - efl_mm * front_efl_mm / behind if behind else math.inf


def colours(range_nm: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return wavelengths (nm), the middles of equal parts of a range, and their weights in the spot of best focus.

    A picture is judged by its luminance, so the weights are the eye's photopic sensitivity (CIE V, as a Gaussian about
    559 nm).
    """
    low, high = range_nm
    count = COLOURS if low < high else 1
    nm = low + (high - low) * (np.arange(count) + 0.5) / count
    return nm, np.exp(-285.4e-6 * (nm - 559.0) ** 2) + _LEAST


@dataclass(frozen=True)
class PupilBounds:
    """Bounds of the passing rays on the pupil plane, at equally spaced film radii.

    As in pbrt (Pharr et al. 2016, 6.4.5), for a film point at radius r along +x the passing rays lie within `low` <= u
    <= `high` along +x and within |v| <= `half` across.

    Attributes:
        pupil_z_mm: the pupil plane.
        film_radius_mm: film radius of the last row; the first row is for the axis.
        low_mm, high_mm, half_mm: one value per film radius; a row is empty (low > high) where no ray passes.
        disc_mm: radius of the disc about the axis that holds all passing rays.
    """

    pupil_z_mm: float
    film_radius_mm: float
    low_mm: tuple[float, ...]
    high_mm: tuple[float, ...]
    half_mm: tuple[float, ...]
    disc_mm: float

    @property
    def lit_radius_mm(self) -> float:
        """The film radius from which on every row is empty; `film_radius_mm` where light reaches the film's edge."""
        rows = enumerate(zip(self.low_mm, self.high_mm, strict=True))
        last = max((k for k, (low, high) in rows if low <= high), default=0)
        return self.film_radius_mm * min(last + 1, len(self.low_mm) - 1) / (len(self.low_mm) - 1)
