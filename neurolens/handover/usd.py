"""The two lookup pictures of NVIDIA's schema OmniLensDistortionLutAPI, by which a USD camera has a lens's projection.

`enter`, of the picture's size: the direction that a pixel sees, as R, G and B; x right, y up, -z forward; where no
light arrives 0, 0, 1, which is behind the camera. `exit`, a square: where the picture shows a direction, as R and G
from 0 to 1 from its upper left corner; -1 where it shows none. Directions are folded onto the square as onto an
octahedron, with forward in its middle; x grows to the right, and y, which is up, from the first row to the last. The
side is odd: so the folds run through centres of pixels, where pictures that are read between pixels are exact.

NVIDIA's renderer traces rays by the first; the second serves what it projects, such as motion vectors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neurolens.cameras.contract import FloatArray
from neurolens.cameras.field import Array, Field
from neurolens.render.stmap import Plates, blocks

SIDE = 2049  # of the exit picture
_NEAR = 1.0  # pictures beyond the edge, so that what is read between pixels is right up to it
_TRIED = 3  # each of so many is tried
Report = Callable[[float], None]


def enter_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """The channels of the picture of directions."""
    planes = {name: np.empty(plates.picture[::-1], np.float32) for name in "RGB"}
    for rows, point in blocks(plates.picture, plates.pixel_mm, report):
        point = np.broadcast_to(point, (point.shape[0], plates.picture[0]))
        way = field.directions(point.reshape(-1)) * np.array([1.0, 1.0, -1.0])[:, None]
        way = np.where(field.lit(point.reshape(-1)) & np.isfinite(way).all(0), way, [[0.0], [0.0], [1.0]])
        for plane, values in zip(planes.values(), way, strict=True):
            plane[rows] = values.reshape(point.shape)
    return planes


def exit_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """The channels of the picture of places."""
    planes = {name: np.zeros((SIDE, SIDE), np.float32) for name in "RGB"}
    across = np.asarray((np.arange(SIDE) + 0.5) * (2 / SIDE) - 1, np.float64)
    for row, down in enumerate(across):
        place = place_of(field, plates, folded(across, np.full(SIDE, down)))
        planes["R"][row], planes["G"][row] = place
        report((row + 1) / SIDE)
    return planes


def folded(u: Array, v: Array) -> Array:
    """Directions [3, N], not of unit length, at points of the square from -1 to 1."""
    z = 1 - np.abs(u) - np.abs(v)
    out = z < 0
    x = np.where(out, (1 - np.abs(v)) * np.where(u < 0, -1, 1), u)
    y = np.where(out, (1 - np.abs(u)) * np.where(v < 0, -1, 1), v)
    return np.stack([x, y, -z])


def place_of(field: Field, plates: Plates, way: Array) -> Array:
    """Where the picture shows directions [3, N] of a USD camera, 0 to 1 from the upper left; -1 where it does not."""
    point = field.point(way * np.array([1.0, 1.0, -1.0])[:, None])
    film = [n * p for n, p in zip(plates.picture, plates.pixel_mm, strict=True)]
    place = np.stack([point.real / film[0] + 0.5, 0.5 - point.imag / film[1]])
    with np.errstate(invalid="ignore"):
        near = (np.abs(place - 0.5) < 0.5 + _NEAR).all(0) & (np.abs(point) < 2 * field.end_mm)
    return np.where(near, place, -1.0)


def exit_residual_px(field: Field, plates: Plates, planes: Mapping[str, FloatArray]) -> float:
    """The worst by which places that are read between four pixels of the exit picture are wrong, over the picture."""
    middle = np.arange(1, SIDE)[::_TRIED] * (2 / SIDE) - 1
    exact = place_of(field, plates, folded(*(c.reshape(-1) for c in np.meshgrid(middle, middle))))
    four = [p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:] + p[1:, 1:] for p in (planes["R"], planes["G"])]
    read = np.stack([f[::_TRIED, ::_TRIED].reshape(-1) / 4 for f in four])
    inside = (np.abs(exact - 0.5) < 0.5).all(0)
    return float(np.hypot(*((read - exact)[:, inside] * np.array(plates.picture)[:, None])).max(initial=0))
