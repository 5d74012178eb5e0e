"""How the light falls off from the film's centre to its corner: of a lens, by the cosine law, of a post-process."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurolens import status as st
from neurolens.cameras.contract import Camera
from neurolens.evaluate.gallery.measures.view import View

Array = NDArray[np.float64]

_SQUARE = 96  # pupil samples a side
_WAVELENGTHS = (450.0, 550.0, 650.0)


def falloff(view: View) -> dict[str, float]:
    """Relative illumination half way to the film's corner and near it, and the aperture that is left there."""
    corner = math.hypot(*view.shot.film_mm) / 2
    middle, half, edge = illumination(view.camera, np.array([0.0, 0.5, 0.95]) * corner)
    return {
        "light_half_way_percent": 100 * half / middle,
        "light_near_the_corner_percent": 100 * edge / middle,
    }


def against_post(view: View) -> dict[str, float]:
    """As `falloff`, and how far the best post-process of the same centre and corner is from the lens in between."""
    corner = 0.95 * math.hypot(*view.shot.film_mm) / 2
    radii = np.linspace(0, corner, 13)
    curve = illumination(view.camera, radii)
    curve = curve / curve[0]
    off = curve - post_process(radii, corner, curve[-1])
    worst = int(np.argmax(np.abs(off)))
    return {
        "light_half_way_percent": 100 * float(curve[6]),
        "light_near_the_corner_percent": 100 * float(curve[-1]),
        "lens_less_post_process_percent": 100 * float(off[worst]),
        "at_film_radius_mm": float(radii[worst]),
    }


def post_process(radius_mm: Array, corner_mm: float, at_corner: float) -> Array:
    """The vignette that editors and shaders draw: the cosine law (1 + k r^2)^-2, k from what is left at the corner."""
    k = (at_corner**-0.5 - 1) / corner_mm**2
    return np.asarray((1 + k * radius_mm**2) ** -2)


def illumination(camera: Camera, radii_mm: Array, azimuth_deg: float = 33.7) -> Array:
    """Mean weight of the rays of film points [N] mm from the centre: the picture of a white card, without noise.

    Of lenses that bend the wavelengths apart, the mean over three of them.
    """
    middle = ((np.arange(_SQUARE) + 0.5) / _SQUARE).astype(np.float32)
    square = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
    where = np.array([math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))])
    found = []
    for radius in radii_mm:
        film = np.repeat((where * radius)[:, None], square.shape[1], axis=1).astype(np.float32)
        weights = []
        for wavelength in _WAVELENGTHS if camera.dispersive else _WAVELENGTHS[1:2]:
            rays = camera.sample(film, square, np.full(square.shape[1], wavelength, np.float32))
            weights.append(np.where(rays.status == st.PASSED, rays.weight, 0).mean(dtype=np.float64))
        found.append(np.mean(weights))
    return np.array(found)
