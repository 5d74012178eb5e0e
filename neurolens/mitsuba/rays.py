"""Film samples of Mitsuba to rays in its camera frame, through any camera of the contract: numpy alone.

Mitsuba's camera looks along +z with y up and x to the left of the picture, ours along -z with x to the right: half a
turn about y. The origin is the centre of the film plane, as in our scenes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from neurolens.cameras.contract import RAYS_A_CALL, Camera, FloatArray
from neurolens.render.film import PixelGrid

BATCH = RAYS_A_CALL  # of the camera
_TURNED = np.array([[-1], [1], [-1]], np.float32)  # half a turn about y


class LocalRays(NamedTuple):
    """Rays in Mitsuba's camera frame: origin [3, N] in scene units, unit direction [3, N], weight [N], 0 if blocked."""

    origin: FloatArray
    direction: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class FilmRays:
    """Rays of a camera for samples of a Mitsuba film.

    Attributes:
        camera: of our contract. grid: the whole film, turned as our pictures are.
        crop_offset, crop_size: the part that samples in [0, 1)^2 cover, as shares of the film (x, y).
        units_per_m: scene units in a metre.
    """

    camera: Camera
    grid: PixelGrid
    crop_offset: tuple[float, float] = (0.0, 0.0)
    crop_size: tuple[float, float] = (1.0, 1.0)
    units_per_m: float = 1.0

    def sample(self, position: FloatArray, aperture: FloatArray, wavelength_nm: FloatArray) -> LocalRays:
        """Rays for film positions [2, N] and aperture samples [2, N] in [0, 1), and wavelengths [N] in nm.

        Wavelengths beyond what the camera was made for become its last ones: Mitsuba draws from 360 to 830 nm, and the
        eye sees a few thousandths of white light outside 400 to 700.
        """
        count = position.shape[1]
        origin, direction = np.empty((3, count), np.float32), np.empty((3, count), np.float32)
        weight = np.empty(count, np.float32)
        accepted = self.camera.wavelength_nm
        if accepted is not None:
            wavelength_nm = np.clip(wavelength_nm, *accepted)
        for start in range(0, count, BATCH):
            part = slice(start, start + BATCH)
            film = self._film_points(position[:, part])
            pupil = np.ascontiguousarray(aperture[:, part], np.float32)
            rays = self.camera.sample(film, pupil, np.ascontiguousarray(wavelength_nm[part], np.float32))
            passed = rays.status == 0
            weight[part] = np.where(passed, rays.weight, np.float32(0))
            # What did not pass still needs a ray that a scene can be asked about.
            direction[:, part] = np.where(passed, rays.direction * _TURNED, [[0], [0], [1]])
            origin[:, part] = np.where(passed, rays.origin_m * _TURNED, np.float32(0))
        origin *= np.float32(self.units_per_m)
        return LocalRays(origin, direction, weight)

    def _film_points(self, position: FloatArray) -> FloatArray:
        """Film points [2, N] in mm."""
        size = np.array([self.grid.width, self.grid.height], np.float32)[:, None]
        offset, part = (np.array(x, np.float32)[:, None] for x in (self.crop_offset, self.crop_size))
        place = (position * part + offset) * size
        return self.grid.film_points(np.zeros(position.shape[1], np.intp), place)
