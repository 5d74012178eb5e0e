"""Shows what is behind the things that a pinhole sees: a picture for each layer, by depth peeling (Everitt 2001).

A lens sees past the edges of near things, and its blur needs what a pinhole does not show: see
`pictures/defocus/plate.py`.
"""

from dataclasses import replace

import numpy as np

from neurolens.base import status as st
from neurolens.cameras.contract import RAYS_A_CALL, Camera, CameraRays, FloatArray
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.job import camera_axes
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.world import world_of


class Behind:
    """A camera whose rays begin behind the first `things` that those of another camera meet in a scene.

    A ray passes only where something follows behind those things. The same random numbers give the same rays as the
    other camera's, so that the layers of a plate fit each other.
    """

    def __init__(self, camera: Camera, scene: Scene, things: int) -> None:
        self._camera, self._things, pose = camera, things, scene.settings.camera
        self.name, self.film_mm, self.settings = camera.name, camera.film_mm, camera.settings
        self.wavelength_nm, self.dispersive = camera.wavelength_nm, camera.dispersive
        self.achromatic = getattr(camera, "achromatic", False)
        self.rays_a_call = getattr(camera, "rays_a_call", RAYS_A_CALL)
        self._world = world_of(scene, SpectralRange(*pose.wavelength_nm), geometry=True)
        self._axes, self._position_m = camera_axes(pose), np.array(pose.position_m, np.float32)[:, None]

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays of the other camera that begin behind what they meet."""
        rays = self._camera.sample(film_mm, pupil, wavelength_nm)
        origin, direction = self._axes @ rays.origin_m + self._position_m, self._axes @ rays.direction
        way, follows = self._world.behind(origin, direction, self._things)
        status = np.where(follows | (rays.status != st.PASSED), rays.status, st.NO_SOLUTION).astype(np.int32)
        weight = np.where(status == st.PASSED, rays.weight, np.float32(0))
        return replace(rays, origin_m=rays.origin_m + way * rays.direction, weight=weight, status=status)
