"""How light falls off towards a film's corners: measured in a camera, and drawn as a post-process would."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import Camera, CameraRays, FloatArray

Array = NDArray[np.float64]

NEAR_CORNER = 0.95  # of the way to the film's corner, where falloff is matched and measured
_SQUARE = 64  # pupil samples a side


def illumination(camera: Camera, radii_mm: Array, azimuth_deg: float = 33.7) -> Array:
    """Mean weight of the rays of film points [N] mm from the centre at 550 nm: a white card without noise."""
    middle = ((np.arange(_SQUARE) + 0.5) / _SQUARE).astype(np.float32)
    square = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
    where = np.array([math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))])
    wavelength, found = np.full(square.shape[1], 550.0, np.float32), []
    for radius in radii_mm:
        film = np.repeat((where * radius)[:, None], square.shape[1], axis=1).astype(np.float32)
        rays = camera.sample(film, square, wavelength)
        found.append(np.where(rays.status == st.PASSED, rays.weight, 0).mean(dtype=np.float64))
    return np.array(found)


def post_process(radius_mm: Any, k: float) -> Any:
    """The vignette that editors and shaders draw: the cosine law, (1 + k r^2)^-2 at a film radius r in mm."""
    return (1 + k * radius_mm * radius_mm) ** -2


def strength_for(radius_mm: float, left: float) -> float:
    """k of the post-process that leaves the share `left` of the light at a radius."""
    return float((left**-0.5 - 1) / radius_mm**2)


class PostProcessed:
    """A camera whose picture is even, darkened afterwards by a post-process that meets a lens at one film radius.

    Args:
        plain: the camera that takes the picture. lens: whose light is met at the centre and near the film's corner.
    """

    def __init__(self, plain: Camera, lens: Camera) -> None:
        radius = NEAR_CORNER * math.hypot(*plain.film_mm) / 2
        middle, corner = illumination(lens, np.array([0.0, radius]))
        self.strength = strength_for(radius, corner / middle)
        self._plain = plain
        self.film_mm, self.name, self.achromatic = plain.film_mm, "post-process", getattr(plain, "achromatic", False)
        self.wavelength_nm, self.dispersive = plain.wavelength_nm, plain.dispersive
        self.settings: dict[str, Any] = {**plain.settings, "post_process_k": self.strength}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As the camera's, every ray weighing what the post-process leaves at its film point [2, N]."""
        rays = self._plain.sample(film_mm, pupil, wavelength_nm)
        left = post_process(np.hypot(film_mm[0], film_mm[1]), self.strength).astype(np.float32)
        return replace(rays, weight=np.where(rays.status == st.PASSED, left, np.float32(0)))
