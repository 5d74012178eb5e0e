"""The cameras of a shot, by the name of their column, and a window on a part of a camera's film."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.contract import RAYS_A_CALL, Camera, CameraRays, FloatArray
from neurolens.cameras.exact import ExactCamera, FusedExactCamera
from neurolens.cameras.fused import FusedCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.thin import ThinLens
from neurolens.cameras.vignetting import Vignetted
from neurolens.evaluate.gallery.lenses import Shot, Surrogate
from neurolens.evaluate.gallery.vignettes import PostProcessed
from neurolens.optics.paraxial import first_order


class Window:
    """A part of a camera's film, as a camera: film points are counted from the window's centre.

    Args:
        camera: of the whole film.
        window_mm: centre x and y as printed (x right, y up: the lens frame turned by 180 degrees), width and height.
    """

    def __init__(self, camera: Camera, window_mm: tuple[float, float, float, float]) -> None:
        x, y, width, height = window_mm
        self._camera = camera
        self._centre = np.array([[-x], [-y]], np.float32)
        self.film_mm = (width, height)
        self.name, self.wavelength_nm, self.dispersive = camera.name, camera.wavelength_nm, camera.dispersive
        self.achromatic = getattr(camera, "achromatic", False)
        self.rays_a_call = getattr(camera, "rays_a_call", RAYS_A_CALL)
        self.settings: dict[str, Any] = {**camera.settings, "window_mm": list(window_mm)}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As the camera's, the film points [2, N] in mm counted from the window's centre."""
        return self._camera.sample(film_mm + self._centre, pupil, wavelength_nm)

    def for_worker(self) -> Window:
        """The same window on a camera of the worker's own."""
        opener = getattr(self._camera, "for_worker", None)
        other = Window.__new__(Window)
        other.__dict__.update(self.__dict__)
        other._camera = self._camera if opener is None else opener()
        return other


def exact_camera(shot: Shot, surrogate: Surrogate | None, kind: type[ExactCamera] = ExactCamera) -> Camera:
    """The prescription itself, sampled over the surrogate's pupil: the same rays for the same random numbers."""
    return kind(
        replace(shot.lens, film_z_mm=None),
        film_mm=shot.film_mm,
        focus_m=shot.focus_m,
        wavelength_nm=shot.wavelength_nm,
        bounds=None if surrogate is None else surrogate.domain.bounds,
        film_offset_mm=shot.offset_mm,
    )


def surrogate_camera(shot: Shot, surrogate: Surrogate | None, kind: type[OnnxCamera] = OnnxCamera) -> Camera:
    """The exported model."""
    assert surrogate is not None
    return kind(
        load_model(surrogate.file),
        film_mm=shot.film_mm,
        focus_m=shot.focus_m,
        f_number=float(first_order(shot.lens).f_number),
        aperture=shot.lens.aperture,
        wavelength_nm=shot.wavelength_nm,
        film_offset_mm=shot.offset_mm,
    )


def thin_camera(shot: Shot, surrogate: Surrogate | None) -> Camera:
    """A thin lens of the same focal length, f-number and focus, its film moved as the panel asks."""
    return ThinLens(
        float(first_order(shot.lens).efl_mm),
        shot.f_number,
        shot.focus_m,
        shot.film_mm,
        aperture=shot.lens.aperture,
        film_offset_mm=shot.panel.film_offset_mm,
    )


def pinhole_camera(shot: Shot, surrogate: Surrogate | None) -> Camera:
    """A pinhole at the focal length."""
    return Pinhole(float(first_order(shot.lens).efl_mm), shot.film_mm, shot.f_number)


def post_processed(shot: Shot, surrogate: Surrogate | None) -> Camera:
    """A thin lens without vignetting, darkened afterwards to the exact lens's centre and corner."""
    return PostProcessed(thin_camera(shot, surrogate), exact_camera(shot, surrogate))


# Columns that an effect may ask for. A camera is made of the shot and of the surrogate, None where no column needs one.
CAMERAS: dict[str, Callable[[Shot, Surrogate | None], Camera]] = {
    "exact": exact_camera,
    "surrogate": surrogate_camera,
    "thin": thin_camera,
    "pinhole": pinhole_camera,
    "post": post_processed,
}
# The same as compiled code: many times as fast, but not for every lens, nor on every machine.
_COMPILED: dict[str, Callable[[Shot, Surrogate | None], Camera]] = {
    "exact": partial(exact_camera, kind=FusedExactCamera),
    "surrogate": partial(surrogate_camera, kind=FusedCamera),
}
TITLES = {
    "exact": "exact lens",
    "surrogate": "surrogate",
    "thin": "thin lens",
    "pinhole": "pinhole",
    "post": "post-process",
}


def camera_of(column: str, shot: Shot, surrogate: Surrogate | None, compiled: bool = False) -> Camera:
    """The camera of a column, with what the panel leaves of its vignetting.

    Args:
        compiled: as compiled code, where there can be such: the same rays to rounding.
    """
    camera = None
    if compiled and column in _COMPILED:
        with suppress(InputError):  # coatings, absorbing glass, or no compiler
            camera = _COMPILED[column](shot, surrogate)
    if camera is None:
        camera = CAMERAS[column](shot, surrogate)
    left = shot.panel.vignetting
    return camera if left == "both" else Vignetted(camera, left, shot.wavelength_nm)
