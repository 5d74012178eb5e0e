"""The aberrations, measured: spots from camera rays, and the profile of a light from the picture.

Every measure looks at the film point `options.x_mm`, `options.y_mm` as printed (x right, y up), on the plane in focus
unless `options.depth_m` says how far before the film.
"""

from __future__ import annotations

import math

import numpy as np

from neurolens.evaluate.gallery.measures.spots import Spot, film_shift, scene_point, spot
from neurolens.evaluate.gallery.measures.view import View

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
