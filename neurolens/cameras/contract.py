"""The one contract between cameras and the renderer: film and pupil sample, wavelength in; scene ray out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]


@dataclass(frozen=True)
class RayDifferentials:
    """How rays change with the film point's x and y, per mm, the point on the pupil held (Igehy 1999).

    Attributes:
        origin_m: [3, 2, N] float32, metres per mm; the origin moves on the surface where rays start.
        direction: [3, 2, N] float32, per mm.
    """

    origin_m: FloatArray
    direction: FloatArray


@dataclass(frozen=True)
class CameraRays:
    """Scene-side rays in the camera frame: metres, origin at the film-plane centre, looking along -z, y up, x right.

    Attributes:
        origin_m: [3, N] float32, a point of the ray in front of the lens.
        direction: [3, N] float32, unit vectors.
        weight: [N] float32. The film value is the mean of weight times radiance over the pupil samples; a uniform
            environment of radiance 1 gives 1 on the axis for every camera. 0 where the ray did not pass.
        status: [N] int32, see `neurolens.status`.
        differentials: of the rays, from `DifferentialCamera.sample_differentials` only.
    """

    origin_m: FloatArray
    direction: FloatArray
    weight: FloatArray
    status: NDArray[np.int32]
    differentials: RayDifferentials | None = None


class Camera(Protocol):
    """What the renderer knows of a camera.

    Attributes:
        name: a word for reports ("pinhole", "thin", the lens's or model's name).
        film_mm: width and height of the film.
        wavelength_nm: range of wavelengths accepted, None for any.
        dispersive: whether rays depend on the wavelength.
        achromatic: optional, true where neither rays nor weights depend on the wavelength.
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


class DifferentialCamera(Camera, Protocol):
    """A camera that knows its ray differentials; all cameras of this package do."""

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays.

        Raises:
            InputError: an exported model without derivatives.
        """
        ...


def towards(vector: FloatArray, slope: FloatArray, fixed: FloatArray) -> RayDifferentials:
    """Differentials of rays along `vector` [3, N] (of any length), whose derivatives are `slope` [3, 2, N].

    `fixed`: [3, N] origins, which do not move.
    """
    length = np.sqrt(np.einsum("in,in->n", vector, vector))
    unit = vector / length
    turn = (slope - unit[:, None] * np.einsum("in,ikn->kn", unit, slope)) / length
    return RayDifferentials(np.zeros((3, 2, fixed.shape[1]), np.float32), turn.astype(np.float32))
