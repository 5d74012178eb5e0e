"""The measures of effects, by the name in an effect's file: one or more numbers for every camera of a panel.

Aberrations are measured by where the light of one scene point falls on the film, from camera rays alone: no noise, no
picture. A camera sends rays from a film point through the pupil; on the scene point's plane they scatter about the
point that the film point sees. By reversibility the light of that point scatters on the film by as much, mapped back by
the picture's own derivative there (to first order in the size of the spot).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.pictures.gallery import bokeh, cameras
from experiments.pictures.gallery.bokeh import light_disc
from experiments.pictures.gallery.cameras import NEAR_CORNER, View, illumination, post_process, pupil_rays, strength_for
from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import OnnxCamera
from neurolens.optics.lens.glass import LINE_D_NM
from neurolens.pictures.render.job import camera_axes

_RADII = 13


def falloff(view: View) -> dict[str, float]:
    """Light half way to the film's corner and near it, over that in the middle.

    Option of the panel: edge_mm, a film radius that stands for the corner's, where the lens leaves corners dark.
    """
    corner = view.shot.panel.option("edge_mm", math.hypot(*view.shot.film_mm) / 2)
    middle, half, edge = illumination(view.camera, np.array([0.0, 0.5, NEAR_CORNER]) * corner)
    return {"light_half_way_percent": 100 * half / middle, "light_near_the_corner_percent": 100 * edge / middle}


def against_post(view: View) -> dict[str, float]:
    """The figures of `falloff`, and the largest error in between of a post-process of the same middle and corner."""
    corner = NEAR_CORNER * math.hypot(*view.shot.film_mm) / 2
    radii = np.linspace(0, corner, _RADII)
    curve = illumination(view.camera, radii)
    curve = curve / curve[0]
    off = curve - post_process(radii, strength_for(corner, curve[-1]))
    worst = int(np.argmax(np.abs(off)))
    return {
        "light_half_way_percent": 100 * float(np.interp(corner / NEAR_CORNER / 2, radii, curve)),
        "light_near_the_corner_percent": 100 * float(curve[-1]),
        "brighter_than_post_process_percent": 100 * float(off[worst]),
        "at_film_radius_mm": float(radii[worst]),
    }


Array = NDArray[np.float64]

_SQUARE = 16  # pupil samples per side, whose mean direction is taken
# Film radius over focal length of an angle to the axis.
PROJECTIONS: dict[str, Callable[[Any], Any]] = {
    "rectilinear": np.tan,
    "stereographic": lambda angle: 2 * np.tan(angle / 2),
    "equidistant": lambda angle: angle,
    "equisolid": lambda angle: 2 * np.sin(angle / 2),
    "orthographic": np.sin,
}


def panorama(view: View) -> dict[str, float]:
    """The full angle that the film sees, and by how much its last tenth lies off the five projections."""
    corner = math.hypot(*view.shot.film_mm) / 2
    radii = np.linspace(0, corner, 241)[1:]
    angles = field_angles(view.camera, radii)
    lit = np.isfinite(angles)
    last = int(np.flatnonzero(lit)[-1])
    radius, angle = float(radii[last]), float(angles[last])
    focal = float(view.camera.settings["efl_mm"])
    found = {"full_field_deg": 2 * math.degrees(angle), "image_radius_mm": radius}
    for name, projection in PROJECTIONS.items():
        meant = focal * float(projection(min(angle, math.radians(89.0)) if name == "rectilinear" else angle))
        found[f"radius_over_{name}_percent"] = 100 * radius / meant
    return found


def field_angles(camera: Camera, radii_mm: Array) -> Array:
    """Angle to the axis, radians, of the mean ray of film points [N] mm from the centre; NaN where none passes."""
    rays = cameras.pupil_rays(camera, cameras.outward(radii_mm), _SQUARE, LINE_D_NM)
    weight = cameras.passing_weight(rays, len(radii_mm))
    mean = (rays.direction.reshape(3, len(radii_mm), -1) * weight).sum(axis=2)
    angle = np.arctan2(np.hypot(mean[0], mean[1]), -mean[2])
    return np.asarray(np.where(weight.sum(axis=1) > 0, angle, np.nan))


_OFF_AXIS = 0.02  # of the distance: how far from the axis a light shows the scale of the picture
AIRY = 2.44  # first dark ring's diameter over wavelength times f-number


def depth_of_field(view: View) -> dict[str, float]:
    """Blur of lights on the axis at 1.0, 1.4 and 2.0 m, and how much larger a thing is at 1 m than at 2 m."""
    found = {f"blur_at_{d}_m_um": 1e3 * blur_mm(view.camera, d) for d in (1.0, 1.4, 2.0)}
    found["size_at_1_m_over_size_at_2_m"] = scale(view.camera, 1.0) / scale(view.camera, 2.0)
    return found


def series(view: View) -> dict[str, float]:
    """The scale of the picture, the blur at 2 m and the light on the film, by focal length and f-number."""
    return {
        "size_of_a_metre_at_2_m_mm": 1e3 * scale(view.camera, 2.0),
        "blur_at_2.0_m_um": 1e3 * blur_mm(view.camera, 2.0),
        "light_on_the_film_percent": 100 * exposure(view.camera),
    }


def pinhole(view: View) -> dict[str, float]:
    """Blur of a light at 0.5 m and at 2 m on the axis, and what diffraction would add (it is not in the picture)."""
    found = {f"blur_at_{d}_m_um": 1e3 * blur_mm(view.camera, d) for d in (0.5, 2.0)}
    found["airy_disc_at_550_nm_um"] = AIRY * 0.55 * view.shot.f_number
    return found


def blur_mm(camera: Camera, distance_m: float) -> float:
    """Diameter of the disc of a light on the axis, in mm of film; 0 for a pinhole without width."""
    if camera.name == "pinhole":
        return 0.0
    return float(np.mean(light_disc(camera, (0.0, 0.0, -distance_m), count=2500).widths_mm))


def scale(camera: Camera, distance_m: float) -> float:
    """Size of the picture of a thing over its own, near the axis, by the centroids of two discs."""
    x = _OFF_AXIS * distance_m
    places = [light_disc(camera, (u, 0.0, -distance_m), count=600).centre_mm[0] for u in (-x, x)]
    return float(abs(places[1] - places[0]) / (2e3 * x))


def exposure(camera: Camera) -> float:
    """Illuminance of the film's centre over pi times the luminance of what it sees: T sin^2 of the cone's half angle.

    Pictures are divided by it, so that a series of f-numbers is evenly bright.

    Raises:
        InputError: a camera that has none.
    """
    if isinstance(camera, ExactCamera | OnnxCamera):
        return camera.film.exposure / math.pi
    if isinstance(camera, ThinLens):
        return camera.radius_mm**2 / (camera.radius_mm**2 + camera.image_distance_mm**2)
    raise InputError("exposure", "camera", camera.name, "a lens, a model or a thin lens")


# ---- Aberrations. ----------------------------------------------------------------------------------------------------

_SIDE = 64  # pupil points per side
_STEP_MM = 0.02  # on the film, of the derivative

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spot:
    """Light on the film about its centroid.

    Attributes:
        radial_um, tangential_um: [N], outward from the film's centre and square to that; on the axis x and y.
        weight: [N], sums to 1.
        scene_m: x and y of the scene point, camera frame.
    """

    radial_um: Floats
    tangential_um: Floats
    weight: Floats
    scene_m: Floats

    @property
    def widths_um(self) -> tuple[float, float]:
        """Standard deviation along the radius and square to it."""
        return tuple(float(np.sqrt((self.weight * v**2).sum())) for v in (self.radial_um, self.tangential_um))  # type: ignore[return-value]

    @property
    def tail_um(self) -> float:
        """Cube root of the third moment along the radius: above 0 where a comet's tail points outward."""
        return float(np.cbrt((self.weight * self.radial_um**3).sum()))

    @property
    def lit(self) -> bool:
        return len(self.weight) > 0


def spot(camera: Camera, printed_mm: tuple[float, float], depth_m: float, wavelength_nm: float = 550.0) -> Spot:
    """The spot at a film point.

    Args:
        printed_mm: film point as printed (x right, y up).
        depth_m: of the scene point before the film, along the axis.
    """
    film = -np.array(printed_mm, np.float64)
    middle, weight = _crossings(camera, film, depth_m, wavelength_nm)
    total = weight.sum()
    if not total > 0:
        return Spot(np.zeros(0), np.zeros(0), np.zeros(0), np.full(2, np.nan))
    weight = weight / total
    centre = middle @ weight
    jacobian = _jacobian(camera, film, depth_m, wavelength_nm)
    # Light of the point through the same pupil point falls by minus this beside the film point; printed, by plus.
    offset = 1e3 * np.linalg.solve(jacobian, middle - centre[:, None])
    length = float(np.hypot(*printed_mm))
    out = np.array(printed_mm) / length if length > 0 else np.array([1.0, 0.0])
    radial, tangential = out @ offset, np.array([-out[1], out[0]]) @ offset
    return Spot(radial, tangential, weight, centre)


def scene_point(camera: Camera, printed_mm: tuple[float, float], depth_m: float, wavelength_nm: float) -> Floats:
    """Centroid x, y in m of what a film point sees on the plane `depth_m` before the film; NaN where it is dark."""
    points, weight = _crossings(camera, -np.array(printed_mm, np.float64), depth_m, wavelength_nm)
    total = weight.sum()
    return points @ (weight / total) if total > 0 else np.full(2, np.nan)


def film_shift(camera: Camera, printed_mm: tuple[float, float], depth_m: float, from_nm: float, to_nm: float) -> float:
    """The distance in um by which a scene point's image lies farther from the film's centre at the second wavelength.

    The scene point is the one seen at `printed_mm` at the first wavelength.
    """
    here, there = (scene_point(camera, printed_mm, depth_m, nm) for nm in (from_nm, to_nm))
    film = -np.array(printed_mm, np.float64)
    moved = -1e3 * np.linalg.solve(_jacobian(camera, film, depth_m, to_nm), there - here)
    return float(moved @ film / np.hypot(*film))


def _jacobian(camera: Camera, film: Floats, depth_m: float, wavelength_nm: float) -> Floats:
    """Derivative [2, 2] of the scene point by the film point (lens frame), m per mm."""
    jacobian = np.empty((2, 2))
    for k in range(2):
        step = np.zeros(2)
        step[k] = _STEP_MM
        ends = [_crossings(camera, film + sign * step, depth_m, wavelength_nm) for sign in (1, -1)]
        jacobian[:, k] = np.subtract(*(p @ (w / w.sum()) for p, w in ends)) / (2 * _STEP_MM)
    return jacobian


def _crossings(camera: Camera, film: Floats, depth_m: float, wavelength_nm: float) -> tuple[Floats, Floats]:
    """The points [2, N] m where rays of a film point (lens frame, mm) meet the plane z = -depth_m, and weights [N]."""
    rays = pupil_rays(camera, film[:, None], _SIDE, wavelength_nm)
    weight = rays.weight.astype(np.float64)
    origin, direction = rays.origin_m.astype(np.float64), rays.direction.astype(np.float64)
    ahead = (weight > 0) & (direction[2] < 0)
    travel = (-depth_m - origin[2][ahead]) / direction[2][ahead]
    return origin[:2, ahead] + travel * direction[:2, ahead], weight[ahead]


BLUE_NM, RED_NM = 450.0, 650.0
_FAR_M = 100.0  # stands in for infinity


def light_profile(view: View) -> dict[str, float]:
    """The radial profile of a light's image: its radius, and how bright its core is over its rim.

    The radius holds 95% of the light, about its centroid; the core is the inner third of it, the rim the outer third.
    """
    grey, (x, y) = view.grey, view.places_mm()
    total = grey.sum()
    if not total > 0:
        return {"radius_um": math.nan, "core_over_rim": math.nan}
    r = np.hypot(x - (x * grey).sum() / total, y - (y * grey).sum() / total)
    order = np.argsort(r, axis=None)
    share = np.cumsum(grey.ravel()[order]) / total
    radius = float(r.ravel()[order][np.searchsorted(share, 0.95)])
    core, rim = grey[r < radius / 3].mean(), grey[(r > 2 * radius / 3) & (r < radius)].mean()
    return {"radius_um": 1e3 * radius, "core_over_rim": float(core / rim)}


def comet(view: View) -> dict[str, float]:
    """A light off the axis: cube root of the third moment of its spot along the radius (above 0: the tail points away
    from the film's centre), and its width along the radius over that across.
    """
    found = _spot(view, *_place(view))
    radial, tangential = found.widths_um
    return {"tail_um": found.tail_um, "radial_over_tangential": _ratio(radial, tangential)}


def line_blur(view: View) -> dict[str, float]:
    """The blur of lines at a film point: rims (square to the radius) by the spot's width along the radius,
    spokes by its width across.
    """
    radial, tangential = _spot(view, *_place(view)).widths_um
    return {"rims_um": radial, "spokes_um": tangential, "rims_over_spokes": _ratio(radial, tangential)}


def edge_blur(view: View) -> dict[str, float]:
    """Measure the RMS radius of the spot on the axis and at a film point, and their ratio."""
    middle, edge = (math.hypot(*_spot(view, *place).widths_um) for place in ((0.0, 0.0), _place(view)))
    return {"middle_um": middle, "edge_um": edge, "edge_over_middle": _ratio(edge, middle)}


def board_blur(view: View) -> dict[str, float]:
    """Measure the RMS radius of the spots of points of the scene's plane y = 0, at three heights of the picture."""
    camera = view.shot.scene.settings.camera
    up, height_m = camera_axes(camera)[1], float(camera.position_m[1])
    found = {}
    for name, y_mm in (("near", -9.0), ("middle", 0.0), ("far", 9.0)):
        # How high above the plane the middle ray is at two depths, and at which depth it meets the plane.
        near, far = (height_m + up @ [*scene_point(view.camera, (0.0, y_mm), d, 550.0), -d] for d in (0.5, 1.0))
        depth_m = 0.5 + 0.5 * float(near / (near - far))
        found[f"{name}_um"] = math.hypot(*spot(view.camera, (0.0, y_mm), depth_m).widths_um)
    return found


def line_bow(view: View) -> dict[str, float]:
    """The bow of a straight line of the scene, its middle at (0, y_mm) and its end at x_mm: above 0 away from the
    film's centre (pincushion), below towards it (barrel); in um, and in percent of y_mm.
    """
    x, y = _place(view)
    height = scene_point(view.camera, (0.0, y), _depth_m(view), 550.0)[1]
    low, high = 0.2 * y, 1.8 * y
    for _ in range(30):  # scene heights grow with film heights: halve
        middle = 0.5 * (low + high)
        seen = scene_point(view.camera, (x, middle), _depth_m(view), 550.0)[1]
        low, high = (middle, high) if seen < height else (low, middle)
    bow = 0.5 * (low + high) - y
    return {"bow_um": 1e3 * bow, "bow_percent": 100 * bow / y}


def colour_blur(view: View) -> dict[str, float]:
    """RMS radius of the spots of blue (450 nm) and red (650 nm): the larger one makes the outer fringe."""
    blue, red = (math.hypot(*_spot(view, *_place(view), nm).widths_um) for nm in (BLUE_NM, RED_NM))
    return {"blue_um": blue, "red_um": red, "red_minus_blue_um": red - blue}


def lateral_colour(view: View) -> dict[str, float]:
    """The distance by which the red image (650 nm) of a point lies farther out than the blue one (450 nm)."""
    return {"red_minus_blue_um": film_shift(view.camera, _place(view), _depth_m(view), BLUE_NM, RED_NM)}


def _place(view: View) -> tuple[float, float]:
    return view.shot.panel.option("x_mm", 0.0), view.shot.panel.option("y_mm", 0.0)


def _depth_m(view: View) -> float:
    return view.shot.panel.option("depth_m", min(view.shot.focus_m, _FAR_M))


def _spot(view: View, x_mm: float, y_mm: float, wavelength_nm: float = 550.0) -> Spot:
    return spot(view.camera, (x_mm, y_mm), _depth_m(view), wavelength_nm)


def _ratio(a: float, b: float) -> float:
    """a / b; NaN where b is but rounding: a point has no shape."""
    return a / b if b > 0.5 else math.nan


# A measure takes the view of one camera and returns numbers; their names carry the unit.
MEASURES: dict[str, Callable[[View], dict[str, float]]] = {
    measure.__name__: measure
    for measure in (
        *(light_profile, comet, line_blur, edge_blur, board_blur, line_bow, colour_blur, lateral_colour),
        *(falloff, against_post),
        *(depth_of_field, series, pinhole, panorama, bokeh.stop_shape, bokeh.cats_eye, bokeh.anamorphic),
    )
}
