"""An ideal camera whose picture is warped afterwards, as a camera."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera, CameraRays, FloatArray
from neurolens.cameras.field import (
    BEYOND,
    RECTILINEAR,
    WIDEST_DEG,
    Array,
    Complex,
    Field,
    field_of,
    film_edge,
    frame_of,
    spectrum_of,
    traced_light,
)


class Warped:
    """An ideal camera whose picture is warped by ST maps of a lens's plane field, and has the lens's light.

    Args:
        flat: pinhole, thin or thick lens, of the same film. camera: to be shown. focus_m: from the film to the plane
            that the maps are of. tables: of both fields, which take seconds, or that of the camera, made before;
            without them film points are traced.

    Raises:
        InputError: a camera that sees some of the film's edge beyond `WIDEST_DEG`, or not at all.
    """

    def __init__(self, flat: Camera, camera: Camera, focus_m: float, tables: bool | Field = False) -> None:
        self.name, self.film_mm, self.settings = f"{flat.name}, warped", flat.film_mm, flat.settings
        self.wavelength_nm, self.dispersive = flat.wavelength_nm, flat.dispersive
        self.achromatic = getattr(flat, "achromatic", False)
        self._flat, self._focus_m = flat, focus_m
        self._frames = {id(c): frame_of(c) for c in (flat, camera)}
        self._shown = camera
        self._fields: dict[int, Field] = {}
        self._axis = {id(c): self._traced(c, np.zeros(1, complex))[1][0] for c in (flat, camera)}
        near, own, frame = 1e-3 / focus_m, self._frames[id(flat)], self._frames[id(camera)]
        # Sizes of things in focus, of the one over the other: 1, but for the other meridian of cylinders.
        self._size = [
            (1 - near * before) / reach * own_reach / (1 - near * own_before)
            for before, reach, own_before, own_reach in zip(
                frame.pupil_mm, frame.reach_mm, own.pupil_mm, own.reach_mm, strict=True
            )
        ]
        ideal, light = self._traced(camera, film_edge(self.film_mm) / BEYOND)
        if not ((light > 0) & (np.abs(ideal) < math.tan(math.radians(WIDEST_DEG)) * max(frame.reach_mm))).all():
            expected = "a film within the image circle, and a narrower field"
            raise InputError(camera.name, "film_mm", self.film_mm, expected)
        before = self._before(ideal)
        # Beyond the edge of the film, too, which the lens's distortion moves farther out than points within it.
        sides = 2 * BEYOND**2 * np.array([np.abs(before.real).max(), np.abs(before.imag).max()]) / self.film_mm
        self.area = float(np.maximum(sides, 1.0).prod())  # of the picture before it is warped, over that of the film
        if tables:
            wide = copy(flat)
            wide.film_mm = float(sides[0] * self.film_mm[0]), float(sides[1] * self.film_mm[1])
            shown = tables if isinstance(tables, Field) else field_of(camera, focus_m)
            self._fields = {id(camera): shown, id(flat): field_of(wide, focus_m)}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays of film points [2, N] in mm, as of the ideal camera."""
        each, back = -(film_mm[0] + 1j * film_mm[1]).astype(np.complex128), np.arange(film_mm.shape[1])
        if not self._fields:
            each, back = np.unique(each, return_inverse=True)
        ideal, light = self._place_and_light(self._shown, each)
        place = self._before(ideal)
        flat = self._place_and_light(self._flat, place)[1]
        light = np.where(flat > 0, light / np.where(flat > 0, flat, 1), 0)  # dark where the flat picture ends
        film = -np.stack([place.real, place.imag])[:, back].astype(np.float32)
        rays = self._flat.sample(np.ascontiguousarray(film), pupil, wavelength_nm)
        return replace(rays, weight=rays.weight * light[back].astype(np.float32))

    def _place_and_light(self, camera: Camera, point: Complex) -> tuple[Complex, Array]:
        """Undistorted places of picture points, and light over that on the axis."""
        if field := self._fields.get(id(camera)):
            return field.ideal(point), field.relative_light(point)
        ideal, light = self._traced(camera, point)
        return ideal, light / self._axis[id(camera)]

    def _traced(self, camera: Camera, point: Complex) -> tuple[Complex, Array]:
        frame = self._frames[id(camera)]
        traced = traced_light(camera, point, spectrum_of(camera), frame, RECTILINEAR, self._focus_m)
        return traced.place, traced.light

    def _before(self, ideal: Complex) -> Complex:
        """Places in the ideal camera's picture, mm."""
        return np.asarray(self._size[0] * ideal.real + 1j * (self._size[1] * ideal.imag))
