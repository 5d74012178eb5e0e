"""Where the light of one scene point falls on the film, from camera rays alone: no noise, no picture.

A camera sends rays from a film point through the pupil; on the scene point's plane they scatter about the point that
the film point sees. By reversibility the light of that point scatters on the film by as much, mapped back by the
picture's own derivative there (to first order in the size of the spot).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.gallery.cameras import View, pupil_rays
from neurolens.cameras.contract import Camera

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
    """How much farther from the film's centre, in um, a scene point's image lies at one wavelength than at another.

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
    """Where rays from one film point (lens frame, mm) meet the plane z = -depth_m: [2, N] m, and weights [N]."""
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
    """How far lines are blurred at a film point: rims (square to the radius) by the spot's width along the radius,
    spokes by its width across.
    """
    radial, tangential = _spot(view, *_place(view)).widths_um
    return {"rims_um": radial, "spokes_um": tangential, "rims_over_spokes": _ratio(radial, tangential)}


def edge_blur(view: View) -> dict[str, float]:
    """RMS radius of the spot in the film's middle and at the film point asked for, and their ratio."""
    middle, edge = (math.hypot(*_spot(view, *place).widths_um) for place in ((0.0, 0.0), _place(view)))
    return {"middle_um": middle, "edge_um": edge, "edge_over_middle": _ratio(edge, middle)}


def line_bow(view: View) -> dict[str, float]:
    """How far a straight line of the scene bends, its middle at (0, y_mm) and its end at x_mm: above 0 away from the
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
    """How much farther from the film's centre the red (650 nm) image of a point lies than the blue one (450 nm)."""
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
