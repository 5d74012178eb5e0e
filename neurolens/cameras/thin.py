"""Thin-lens camera: perfect focus on one plane, a circular aperture, no aberration."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from neurolens.base import status as st
from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FilmPoints, FloatArray, towards
from neurolens.cameras.sampling import ahead, arrived, check_film, concentric_disk, positive, sound, stratified
from neurolens.optics.apertures import Aperture
from neurolens.optics.film_plane import film_z_mm

_QUADRATURE = 256  # points a side


class ThinLens:
    """A thin lens of focal length `focal_mm` and diameter `focal_mm / f_number`.

    Args:
        focal_mm: focal length.
        f_number: focal length over aperture diameter; it does not change with focus.
        focus_m: distance from film to the object in focus, or infinity.
        film_mm: width and height of the film.
        aperture: shape of the opening; None is round.
        film_offset_mm: moves the film away from the lens (negative: towards it) after focusing.

    Raises:
        InputError: a value is not above 0, `focus_m` is below 4 focal lengths, or the offset leaves no way to the film.
    """

    name = "thin"
    dispersive = False
    achromatic = True
    rays_a_call = MANY_RAYS_A_CALL
    wavelength_nm: tuple[float, float] | None = None

    def __init__(
        self,
        focal_mm: float,
        f_number: float,
        focus_m: float,
        film_mm: tuple[float, float] = (36.0, 24.0),
        *,
        aperture: Aperture | None = None,
        film_offset_mm: float = 0.0,
    ) -> None:
        self.focal_mm = positive("focal_mm", focal_mm)
        self.f_number = positive("f_number", f_number)
        self.focus_m = positive("focus_m", focus_m, infinite=True)
        self.film_mm = check_film(film_mm)
        self.image_distance_mm = film_z_mm(self.focal_mm, 0.0, 0.0, self.focus_m)
        self._object_distance_mm = 1e3 * self.focus_m - self.image_distance_mm
        if film_offset_mm:
            self.image_distance_mm = positive("film_offset_mm, film distance", self.image_distance_mm + film_offset_mm)
            power = 1 / self.focal_mm - 1 / self.image_distance_mm  # negative: what is sharp is virtual
            self._object_distance_mm = 1 / power if power else math.inf
        self.radius_mm = self.focal_mm / (2 * self.f_number)
        self.settings: dict[str, Any] = {
            "camera": self.name,
            "efl_mm": self.focal_mm,
            "f_number": self.f_number,
            "focus_m": None if math.isinf(self.focus_m) else self.focus_m,
            "film_mm": list(self.film_mm),
            "film_offset_mm": film_offset_mm,
            "aperture": aperture and aperture.settings(),
        }
        self.aperture = aperture
        # On-axis integral of cos over solid angle, pi R^2 / (R^2 + s'^2), and the part of it that a shape lets through.
        self._exposure, self._part = 1.0 + (self.radius_mm / self.image_distance_mm) ** 2, 1.0
        if aperture is not None:
            square, wavelength = stratified(_QUADRATURE, (550.0, 550.0))
            self._part = float(self.sample(np.zeros_like(square), square, wavelength).weight.mean(dtype=np.float64))

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm and pupil samples [2, N]; the wavelength changes nothing."""
        count = film_mm.shape[1]
        behind = np.float32(self.image_distance_mm)
        in_front = np.float32(self._object_distance_mm)
        lens = concentric_disk(pupil) * np.float32(self.radius_mm)  # [2, N] mm

        # All rays of a film point leave for the point where its ray through the lens centre meets the focus plane;
        # written per unit of depth, infinity is no special case.
        direction = np.empty((3, count), np.float32)
        direction[:2] = -film_mm / behind - lens / in_front
        direction[2] = -1.0
        with np.errstate(over="ignore", invalid="ignore"):
            direction /= np.sqrt(np.einsum("in,in->n", direction, direction))
            # w = A cos^4 / s'^2 over the exposure on the axis.
            tangent = (lens - film_mm) / behind
            cos2 = 1.0 / (1.0 + np.einsum("in,in->n", tangent, tangent))

        origin = np.empty((3, count), np.float32)
        np.multiply(lens, np.float32(1e-3), out=origin[:2])
        origin[2] = -1e-3 * behind

        weight = cos2 * cos2 * np.float32(self._exposure / self._part)
        if self.aperture is None:
            return sound(CameraRays(origin, direction, weight, np.zeros(count, np.int32)), cos2)
        inside = self.aperture.inside(lens[0], lens[1], self.radius_mm)
        status = np.where(inside, st.PASSED, st.blocked(0, st.RIM)).astype(np.int32)
        return sound(CameraRays(origin, direction, np.where(inside, weight, np.float32(0)), status), cos2)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays, which turn about their points on the lens."""
        rays = self.sample(film_mm, pupil, wavelength_nm)
        slope = np.zeros((3, 2, film_mm.shape[1]), np.float32)
        slope[0, 0] = slope[1, 1] = -1 / self.image_distance_mm
        return replace(rays, differentials=towards(rays.direction / -rays.direction[2], slope, rays.origin_m))

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """cos^4 of the angles between the axis and the rays from lens to film."""
        tangent = (concentric_disk(pupil) * np.float32(self.radius_mm) - film_mm) / np.float32(self.image_distance_mm)
        return np.square(1.0 / (1.0 + np.einsum("in,in->n", tangent, tangent))).astype(np.float32)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Film points of scene points [3, N] in m through points of the lens chosen by `pupil`."""
        lens = concentric_disk(pupil).astype(np.float64) * self.radius_mm
        behind, in_front = self.image_distance_mm, self._object_distance_mm
        origin = np.concatenate([1e-3 * lens, np.full((1, lens.shape[1]), -1e-3 * behind)])
        with np.errstate(all="ignore"):
            depth = -1e-3 * behind - point_m[2].astype(np.float64)
            slope = (point_m[:2] - origin[:2]) / depth
            # The inverse of `sample`: the slope of the ray gives the film point.
            film = -behind * (slope + lens / in_front)
            # The weight of `sample`, times mm^2 of film for each m^2 of a plane square to the ray.
            tangent2 = (((lens - film) / behind) ** 2).sum(0)
            weight = self._exposure / self._part / (1 + tangent2) ** 2 * (behind / depth) ** 2
            weight *= np.sqrt(1 + (slope**2).sum(0))
        status = ahead(depth)
        if self.aperture is not None:
            inside = self.aperture.inside(lens[0], lens[1], self.radius_mm)
            status = np.where(inside | (status != st.PASSED), status, st.blocked(0, st.RIM)).astype(np.int32)
        return arrived(film, origin, point_m, weight, status)
