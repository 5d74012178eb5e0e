"""Pinhole camera: one ray a film point, everything in focus."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FilmPoints, FloatArray, towards
from neurolens.cameras.sampling import ahead, arrived, check_film, positive, sound


class Pinhole:
    """A hole at distance `focal_mm` from the film.

    The hole stands for a lens of the nominal f-number, E = pi L / (4 N^2) on the axis, so the weight is cos^4 of the
    angle to the axis, 1 on the axis; `f_number` is kept in the settings and changes no ray.

    Args:
        focal_mm: distance from hole to film.
        film_mm: width and height of the film.
        f_number: nominal.

    Raises:
        InputError: a length or the f-number is not a finite number above 0.
    """

    name = "pinhole"
    dispersive = False
    achromatic = True
    rays_a_call = MANY_RAYS_A_CALL
    wavelength_nm: tuple[float, float] | None = None

    def __init__(self, focal_mm: float, film_mm: tuple[float, float] = (36.0, 24.0), f_number: float = 8.0) -> None:
        self.focal_mm = positive("focal_mm", focal_mm)
        self.film_mm = check_film(film_mm)
        self.f_number = positive("f_number", f_number)
        self.settings: dict[str, Any] = {
            "camera": self.name,
            "efl_mm": self.focal_mm,
            "f_number": self.f_number,
            "focus_m": None,
            "film_mm": list(self.film_mm),
        }

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays through the hole for film points [2, N] in mm; pupil and wavelength change nothing."""
        count = film_mm.shape[1]
        direction = np.empty((3, count), np.float32)
        np.divide(film_mm, np.float32(-self.focal_mm), out=direction[:2])
        direction[2] = -1.0
        with np.errstate(over="ignore", invalid="ignore"):
            cos2 = 1.0 / (1.0 + direction[0] ** 2 + direction[1] ** 2)
            direction *= np.sqrt(cos2)
        origin = np.zeros((3, count), np.float32)
        origin[2] = -1e-3 * self.focal_mm
        return sound(CameraRays(origin, direction, (cos2 * cos2).astype(np.float32), np.zeros(count, np.int32)), cos2)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays, all of which start at the hole."""
        rays = self.sample(film_mm, pupil, wavelength_nm)
        slope = np.zeros((3, 2, film_mm.shape[1]), np.float32)
        slope[0, 0] = slope[1, 1] = -1 / self.focal_mm
        return replace(rays, differentials=towards(rays.direction / -rays.direction[2], slope, rays.origin_m))

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """The whole weight: a point has no vignetting but the cosine's."""
        return self.sample(film_mm, pupil, wavelength_nm).weight

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Film points of scene points [3, N] in m through the hole; pupil and wavelength change nothing."""
        origin = np.array([[0.0], [0.0], [-1e-3 * self.focal_mm]]) + np.zeros((1, point_m.shape[1]))
        with np.errstate(all="ignore"):
            way = point_m - origin
            squared = np.einsum("in,in->n", way, way)
            film = self.focal_mm * way[:2] / way[2]
            # A' / E0 of a small hole is the square of its distance from the film.
            weight = self.focal_mm**2 * -way[2] / squared**1.5
        return arrived(film, origin, point_m, weight, ahead(-way[2]))
