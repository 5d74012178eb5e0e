"""The one contract between cameras and the renderer: film and pupil sample, wavelength in; scene ray out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]


@dataclass(frozen=True)
class CameraRays:
    """Scene-side rays in the camera frame: metres, origin at the film-plane centre, looking along -z, y up, x right.

    Attributes:
        origin_m: [3, N] float32, a point of the ray in front of the lens.
        direction: [3, N] float32, unit vectors.
        weight: [N] float32. The film value is the mean of weight times radiance over the pupil samples; a uniform
            environment of radiance 1 gives 1 on the axis for every camera. 0 where the ray did not pass.
        status: [N] int32, see `neurolens.status`.
    """

    origin_m: FloatArray
    direction: FloatArray
    weight: FloatArray
    status: NDArray[np.int32]


class Camera(Protocol):
    """What the renderer knows of a camera.

    Attributes:
        name: a word for reports ("pinhole", "thin", the lens's or model's name).
        film_mm: width and height of the film.
        wavelength_nm: range of wavelengths accepted, None for any.
        dispersive: whether rays depend on the wavelength.
        settings: JSON-able description (focal length, f-number, focus, model card), kept in the picture's metadata.
    """

    name: str
    film_mm: tuple[float, float]
    wavelength_nm: tuple[float, float] | None
    dispersive: bool
    settings: dict[str, Any]

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm (lens frame), pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        ...
