"""The one contract between cameras and the renderer.

Forwards, for path tracing: film point, pupil sample and wavelength in; scene ray, weight and status out, and on request
how the ray moves with the film point. Backwards, for light tracing: scene point, pupil sample and wavelength in; film
point, weight and status out. The renderer knows no other camera than this.

Frames. Film points are millimetres in the lens frame: origin on the axis, x right, y up as the camera looks, so that
the picture on the film stands on its head; its writer turns it by 180 degrees. Scene-side rays and points are metres in
the camera frame: origin at the film's centre, the camera looks along -z, y up, x right.

Weights. The film value is E(film point) / E0: irradiance over the exposure on the axis in uniform surroundings of
radiance 1, both as the lens would give them. A ray of a film point through a point of a plane at axial distance Z that
was sampled uniformly on the area A weighs

    w = T A cos^4(theta) / (Z^2 E0),    E0 = integral of T cos(theta) over solid angle on the axis,

with transmittance T and the film-side angle theta to the axis (Kolb et al. 1995, eq. 3). So the film value is the mean
of weight times radiance over the pupil samples, and every camera, whatever its f-number, shows white surroundings as 1
on the axis; off it as natural and optical vignetting leave them (`neurolens.cameras.reduced` switches these off).
Cameras that are points (pinhole, fisheye projections) are the limit of a small hole.

Light tracing measures the same integral from the other end:

    integral of film value over the film = integral of W L cos(theta_P) over dA_P, mean over the pupil samples,

where dA_P (m^2) is a patch of the scene that sends radiance L at the angle theta_P to its normal. Lenses keep etendue:

    W = T A' cos(theta') / (d^2 E0):

A' (mm^2) is the inverse density of the point on the lens's front at which the pupil sample aims, theta' the angle there
to the normal, d (m) the distance between the two. Ideal lenses, thin and thick, image planes to planes and cannot keep
it: their W is w times the film's area for an area square to the ray, so that both directions give the same picture. W
has the unit mm^2 / m^2. For points drawn with the density p per m^2, add
W L cos(theta_P) / (p N a) to the pixel of area a (mm^2) that holds the film point, for each of N points.

Spectra. A path may carry several wavelengths along the scene ray of one of them, the hero (`SpectralRays`). At the
others, its companions, a lens that disperses takes the same scene ray from other film points, where their light
belongs. Lenses keep etendue, so each wavelength would have drawn this ray with nearly the same density: n wavelengths
that pass share a ray evenly. Each weighs 1 / n of its own T A cos^4(theta) / (Z^2 E0), with the hero's A, theta and Z,
and a ray that the hero does not pass is left to the wavelengths that do (the balance heuristic of Wilkie et al. 2014
for wavelengths that can draw the ray).

Status. Every ray has one (`base.status`); what did not pass has weight 0 and finite numbers elsewhere, and so have
film or scene points that are not finite. A wavelength that is no finite number above 0 is outside every camera's
domain. Nothing in a ray raises; shapes and domains of settings do, when a camera is
made (`InputError`). A batch may be empty, and of any size that memory holds.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
# A network in numpy or onnxruntime keeps hundreds of numbers a ray between its steps: more rays would leave the cache.
RAYS_A_CALL = 8000
MANY_RAYS_A_CALL = 32768  # for cameras that keep next to nothing, where a call costs as much as a thousand rays


@dataclass(frozen=True)
class RayDifferentials:
    """The derivatives of rays by the film point's x and y, per mm, with the point on the pupil held (Igehy 1999).

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
        status: [N] int32, see `neurolens.base.status`.
        differentials: of the rays, from `DifferentialCamera.sample_differentials` only.
    """

    origin_m: FloatArray
    direction: FloatArray
    weight: FloatArray
    status: NDArray[np.int32]
    differentials: RayDifferentials | None = None


@dataclass(frozen=True)
class SpectralRays:
    """Camera rays that carry several wavelengths; see the module.

    Attributes:
        rays: of the hero, the first wavelength, with its weight as the only one.
        weight: [W, N] float32 of each wavelength, 0 where it does not pass.
        film_mm: [W, 2, N] float32, where their light belongs, on the film; the hero's where the weight is 0.
    """

    rays: CameraRays
    weight: FloatArray
    film_mm: FloatArray


@dataclass(frozen=True)
class FilmPoints:
    """The film points at which light of scene points arrives, and the camera rays that lead to the scene points.

    Attributes:
        film_mm: [2, N] float32, lens frame; may lie beyond the edges of the film. 0 where nothing arrives.
        origin_m, direction: [3, N] float32, camera frame, as in `CameraRays`: the ray from the lens to the scene point.
            Whatever stands between the two shades the point.
        weight: [N] float32, W of the module in mm^2 / m^2; 0 where nothing arrives.
        status: [N] int32, see `neurolens.base.status`.
    """

    film_mm: FloatArray
    origin_m: FloatArray
    direction: FloatArray
    weight: FloatArray
    status: NDArray[np.int32]


class Camera(Protocol):
    """The interface of a camera to the renderer.

    Attributes:
        name: a word for reports ("pinhole", "thin", the lens's or model's name).
        film_mm: width and height of the film.
        wavelength_nm: range of wavelengths accepted, None for any.
        dispersive: whether rays depend on the wavelength.
        achromatic: optional, true where neither rays nor weights depend on the wavelength.
        tints: optional function of wavelengths [...], the light of each over that of one wavelength, where nothing else
            depends on them.
        rays_a_call: optional, how many rays at once suit it best; `RAYS_A_CALL` where it says nothing.
        settings: JSON-able description (focal length, f-number, focus, model card), kept in the picture's metadata.
    """

    name: str
    film_mm: tuple[float, float]
    wavelength_nm: tuple[float, float] | None
    dispersive: bool
    settings: dict[str, Any]

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays of film points [2, N] (mm, lens frame), pupil samples [2, N] in [0, 1), wavelengths [N] (nm)."""


class DifferentialCamera(Camera, Protocol):
    """The interface of all cameras of this package; `Vignetted` has no `natural`."""

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials, too."""

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Return film points for scene points [3, N] (m, camera frame), pupil samples [2, N] and wavelengths [N] (nm).

        The pupil sample chooses the point on the front of the lens at which the scene point's light is aimed; it is not
        the sample for which `sample` returns the same ray.

        Raises:
            InputError: a model whose core gives no direction vectors.
        """

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return the part [N] of the weights of `sample` that is the cos^4 law, or a fisheye projection's own law.

        It is given for every ray, passed or not. A weight divided by it is area times transmittance.
        """


def towards(vector: FloatArray, slope: FloatArray, fixed: FloatArray) -> RayDifferentials:
    """Return differentials of rays along `vector` [3, N] (of any length), whose derivatives are `slope` [3, 2, N].

    `fixed`: [3, N] origins, which do not move.
    """
    length = np.sqrt(np.einsum("in,in->n", vector, vector))
    unit = vector / length
    turn = (slope - unit[:, None] * np.einsum("in,ikn->kn", unit, slope)) / length
    return RayDifferentials(np.zeros((3, 2, fixed.shape[1]), np.float32), turn.astype(np.float32))
