"""Depth of field, perspective, the series of focal lengths and f-numbers, and the pinhole: blur, scale and exposure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera
from neurolens.cameras.thin import ThinLens
from neurolens.evaluate.gallery.measures.lightdiscs import light_disc
from neurolens.evaluate.gallery.measures.view import View
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens

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


def paraxial_blur_mm(lens: Lens, distance_m: float, wavelength_nm: float = 550.0) -> float:
    """First-order diameter of the disc of a light on the axis: D m |d - s| / d.

    D is the diameter of the entrance pupil, d and s the distances from it of the light and of what is in focus, m the
    magnification there: the pupil's cone cut by the plane in focus, and that plane's picture.

    Args:
        lens: focused, its film in place. distance_m: from film to light.
    """
    data: Any = first_order(lens, wavelength_nm)
    assert lens.film_z_mm is not None
    light_z = lens.film_z_mm - 1e3 * distance_m
    behind = lens.film_z_mm - float(data.rear_principal_z_mm)
    efl = float(data.efl_mm)
    focus_z = float(data.front_principal_z_mm) - 1 / (1 / efl - 1 / behind)
    to_light, to_focus = (float(data.entrance_pupil_z_mm) - z for z in (light_z, focus_z))
    magnification = (behind - efl) / efl
    return float(data.entrance_pupil_diameter_mm) * magnification * abs(to_light - to_focus) / to_light
