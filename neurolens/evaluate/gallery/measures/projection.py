"""How a lens maps angles to the film: which way a fisheye bends the room."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import Camera
from neurolens.evaluate.gallery.measures.view import View

Array = NDArray[np.float64]

_SQUARE = 16  # pupil samples a side, whose mean direction is taken
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


def field_angles(camera: Camera, radii_mm: Array, azimuth_deg: float = 33.7, wavelength_nm: float = 587.5618) -> Array:
    """Angle to the axis, radians, of the mean ray of film points [N] mm from the centre; NaN where none passes."""
    middle = ((np.arange(_SQUARE) + 0.5) / _SQUARE).astype(np.float32)
    square = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
    where = np.array([math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))])
    film = np.repeat(where[:, None] * radii_mm, square.shape[1], axis=1).astype(np.float32)
    pupil = np.tile(square, len(radii_mm))
    rays = camera.sample(film, pupil, np.full(film.shape[1], wavelength_nm, np.float32))
    weight = np.where(rays.status == st.PASSED, rays.weight, 0).astype(np.float64).reshape(len(radii_mm), -1)
    mean = (rays.direction.reshape(3, len(radii_mm), -1) * weight).sum(axis=2)
    angle = np.arctan2(np.hypot(mean[0], mean[1]), -mean[2])
    return np.asarray(np.where(weight.sum(axis=1) > 0, angle, np.nan))
