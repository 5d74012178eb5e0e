"""What is measured of each effect, by the name that its file gives: a number or more for every camera of a panel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.gallery import aberrations, bokeh, cameras
from experiments.gallery.bokeh import light_disc
from experiments.gallery.cameras import NEAR_CORNER, View, illumination, post_process, strength_for
from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.model import OnnxCamera
from neurolens.lens.glass import LINE_D_NM

_RADII = 13


def falloff(view: View) -> dict[str, float]:
    """Light half way to the film's corner and near it, over that in the middle.

    Option of the panel: edge_mm, a film radius that stands for the corner's, where the lens leaves corners dark.
    """
    corner = view.shot.panel.option("edge_mm", math.hypot(*view.shot.film_mm) / 2)
    middle, half, edge = illumination(view.camera, np.array([0.0, 0.5, NEAR_CORNER]) * corner)
    return {"light_half_way_percent": 100 * half / middle, "light_near_the_corner_percent": 100 * edge / middle}


def against_post(view: View) -> dict[str, float]:
    """As `falloff`, and by how much a post-process of the same middle and corner is off in between, at worst."""
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
    """What focal length and f-number change: the scale of the picture, the blur of 2 m, the light on the film."""
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


# A measure takes what one camera saw and gives numbers; their names carry the unit.
MEASURES: dict[str, Callable[[View], dict[str, float]]] = {
    "light_profile": aberrations.light_profile,
    "comet": aberrations.comet,
    "line_blur": aberrations.line_blur,
    "edge_blur": aberrations.edge_blur,
    "line_bow": aberrations.line_bow,
    "colour_blur": aberrations.colour_blur,
    "lateral_colour": aberrations.lateral_colour,
    "stop_shape": bokeh.stop_shape,
    "cats_eye": bokeh.cats_eye,
    "anamorphic": bokeh.anamorphic,
    "falloff": falloff,
    "against_post": against_post,
    "depth_of_field": depth_of_field,
    "series": series,
    "pinhole": pinhole,
    "panorama": panorama,
}
