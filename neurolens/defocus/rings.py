"""Onion rings: concentric grooves, which grinding leaves on aspheres, move the light within a blur disc.

A groove raises the surface along the axis by h(r). The path of a ray through it changes by W = h (n d_z - n' d'_z), d
and d' the directions before and after the surface. By Fermat's principle the light of a point that passes the same
place of the lens then arrives on the film beside its old place, by the gradient of W over the direction cosines with
which rays leave that place. This is exact to first order in h; diffraction by the grooves is left out, as by Joo et
al. 2016 ("Efficient ray tracing through aspheric lenses and imperfect bokeh synthesis"), who measured such rings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError

Array = NDArray[np.float64]
_STEP_MM = 0.01  # on the pupil's plane, of differences


@dataclass(frozen=True)
class Grooves:
    """Grooves of the height H sin(2 pi r / spacing)."""

    height_nm: float
    spacing_mm: float

    def heights(self, radius_mm: Array) -> tuple[Array, Array]:
        """The heights in mm, and their derivatives by the radius."""
        turn, height = 2 * math.pi / self.spacing_mm, 1e-6 * self.height_nm
        return height * np.sin(turn * radius_mm), height * turn * np.cos(turn * radius_mm)


def aspheres(camera: Any) -> list[int]:
    """The surfaces of a camera's lens that are round aspheres. Raises InputError: there is none."""
    lens = getattr(camera, "lens", None)
    surfaces = lens.surfaces if lens is not None else ()
    found = [k for k, s in enumerate(surfaces) if s.cylinder is None and (s.asphere or s.conic)]
    if not found:
        raise InputError(
            camera.name, "ring_height", "(no asphere)", "the file of a lens with aspheres, to have grooves"
        )
    return found


def responses(camera: Any, film_mm: NDArray[Any], square: NDArray[Any], nm: NDArray[Any]) -> Array:
    """How light moves: [aspheres, 5, N] for rays of film points [2, N] by points of the pupil's square [2, N].

    Of each asphere the distance in mm from the axis at which the ray meets it, and by how many mm light moves on the
    film, x and y, for a slope of 1 there, then for a height of 1 mm.
    """
    surfaces, outline = aspheres(camera), camera.film.outline
    pupil, _ = outline.sample(*(v.astype(np.float32) for v in (film_mm, square, nm)))

    steps = _STEP_MM * np.array([[0, 0], [1, 0], [0, 1]])[..., None]
    (q, here), *moved = (camera.path_by_height(surfaces, film_mm, pupil + step, nm) for step in steps)
    (ax, ay), (bx, by) = (m[0] - q for m in moved)
    to_a, to_b = (m[1] - here for m in moved)
    gradient = np.stack([to_a * by - to_b * ay, to_b * ax - to_a * bx], 2) / (ax * by - ay * bx)
    return np.concatenate([here[:, :1], here[:, 1:] * gradient[:, 0], gradient[:, 1]], 1)


def moves(response: Array, grooves: Grooves) -> Array:
    """By how many mm [2, N] grooves on all aspheres move light on the film; `response` as of `responses`."""
    height, slope = grooves.heights(response[:, 0])
    return np.asarray((response[:, 1:3] * slope[:, None] + response[:, 3:] * height[:, None]).sum(axis=0))
