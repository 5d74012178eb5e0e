"""A pinhole whose picture is warped afterwards, as a camera."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.contract import CameraRays, FloatArray
from neurolens.cameras.field import (
    BEYOND,
    RECTILINEAR,
    WIDEST_DEG,
    Array,
    Complex,
    Field,
    film_edge,
    frame_of,
    laid,
    seen,
    spectrum_of,
)
from neurolens.cameras.pinhole import Pinhole


class WarpedPinhole(Pinhole):
    """What compositing makes of a pinhole's picture by the maps of a camera's rectilinear field: its places and light.

    Args:
        hole: any, of the same film. camera: to be shown. focus_m: from the film to the plane that the maps are of.
        field: of both, which takes seconds; without it every film point is traced by itself.

    Raises:
        InputError: a camera that sees some of the film's edge beyond `WIDEST_DEG`, or not at all.
    """

    name = "pinhole, warped"

    def __init__(self, hole: Pinhole, camera: Any, focus_m: float, field: Field | None = None) -> None:
        super().__init__(hole.focal_mm, hole.film_mm, hole.f_number)
        self._shown, self._focus_m, self._field = camera, focus_m, field
        self._frame, self._spectrum = frame_of(camera), spectrum_of(camera)
        self._axis = float(self._traced(np.zeros(1, complex))[1][0])
        near, frame = 1e-3 / focus_m, self._frame
        # Sizes of things in focus, of the hole over the ideal camera: 1, but for the other meridian of cylinders.
        self._size = [
            (1 - near * before) / reach * self.focal_mm / (1 - near * self.focal_mm)
            for before, reach in zip(frame.pupil_mm, frame.reach_mm, strict=True)
        ]
        edge = film_edge(self.film_mm) / BEYOND
        ideal, light = self._traced(edge)
        if not ((light > 0) & (np.abs(ideal) < math.tan(math.radians(WIDEST_DEG)) * max(frame.reach_mm))).all():
            raise InputError(
                camera.name, "film_mm", self.film_mm, "a film within the image circle, and a narrower field"
            )
        sides = 2 * BEYOND * np.abs(self._before(ideal)).max(1) / self.film_mm
        self.area = float(np.maximum(sides, 1.0).prod())  # of the picture before it is warped, over that of the film

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays of film points [2, N] in mm, as of the hole."""
        point = -(film_mm[0] + 1j * film_mm[1]).astype(np.complex128)
        if self._field is None:
            each, back = np.unique(point, return_inverse=True)
            places, lights = self._traced(each)
            ideal, light = places[back], lights[back] / self._axis
        else:
            ideal, light = self._field.ideal(point), self._field.relative_light(point)
        rays = super().sample(-self._before(ideal).astype(np.float32), pupil, wavelength_nm)
        return replace(rays, weight=light.astype(np.float32))

    def _traced(self, point: Complex) -> tuple[Complex, Array]:
        picture = np.stack([point.real, point.imag])
        found = seen(self._shown, picture, self._spectrum, self._frame, RECTILINEAR, self._focus_m)
        return laid(found.direction, self._frame, RECTILINEAR), found.light

    def _before(self, ideal: Complex) -> Array:
        """Places [2, N] in the hole's picture, mm."""
        return np.stack([self._size[0] * ideal.real, self._size[1] * ideal.imag])
