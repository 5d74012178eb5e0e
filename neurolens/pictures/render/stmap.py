"""ST maps: for every pixel of a picture, where another picture holds what belongs there.

Conventions are those of Nuke's STMap and Blender's Map UV. s runs from 0 at the left edge to 1 at the right edge of the
picture that is read, t from 0 at its bottom edge to 1 at its top edge. The centre of its pixel x, y (from 0, y upwards)
is s = (x + 0.5) / width, t = (y + 0.5) / height. Channels are float32: R is s, G is t. B is a mask, and the third
coordinate that Map UV takes for alpha: 1 where the place lies within the picture that is read and the lens's picture
has light, else 0. A map has the size of the picture that it makes; data and display window are the same.

`undistort` reads the picture of a lens (the plate) and makes its undistorted picture, `redistort` the other way. Both
pictures have pixels of one size and share their centre; the undistorted one is larger by the overscan, so that it holds
every pixel of the plate. Where the undistorted picture shows more than the plate holds, s and t go on beyond 0 and 1.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.field import Complex, Field

_ROWS = 1 << 18  # pixels that are done at once
_EDGE = 513  # points on a side of the film
_TRIED = 97, 55  # points, across and down, that are mapped there and back
LARGEST_MAP = 1 << 26  # pixels

Report = Callable[[float], None]


@dataclass(frozen=True)
class Plates:
    """The two pictures: pixels (width, height) of the lens's own and of the undistorted one; size of a pixel in mm.

    The shapes of film and picture may differ by a rounded pixel, and so may the two sides of a pixel.
    """

    picture: tuple[int, int]
    undistorted: tuple[int, int]
    pixel_mm: tuple[float, float]

    @property
    def overscan(self) -> tuple[float, float]:
        """Width and height of the undistorted picture over those of the lens's."""
        return self.undistorted[0] / self.picture[0], self.undistorted[1] / self.picture[1]

    def pixels(self, way: Complex) -> NDArray[np.float64]:
        """Return the lengths, in pixels, of displacements in mm."""
        return np.hypot(way.real / self.pixel_mm[0], way.imag / self.pixel_mm[1])


def plates_of(fields: Sequence[Field], picture: tuple[int, int], film_mm: tuple[float, float]) -> Plates:
    """Return the smallest undistorted picture that holds, for all fields, everything that the lens's picture shows.

    Raises:
        InputError: it would have more than `LARGEST_MAP` pixels.
    """
    line = np.linspace(-0.5, 0.5, _EDGE)
    width, height = film_mm
    x = np.concatenate([line, line, 0 * line - 0.5, 0 * line + 0.5]) * width
    y = np.concatenate([0 * line - 0.5, 0 * line + 0.5, line, line]) * height
    pixel = width / picture[0], height / picture[1]
    places = np.stack([field.ideal(x + 1j * y) for field in fields])
    size = []
    for side, step, reach in zip(picture, pixel, (np.abs(places.real).max(), np.abs(places.imag).max()), strict=True):
        # By whole pixels on both sides, so that pixels of both pictures lie on one grid; rounding adds no pixel.
        size.append(side + 2 * max(0, math.ceil(reach / step - side / 2 - 1e-4)))
    if size[0] * size[1] > LARGEST_MAP:
        expected = f"at most {LARGEST_MAP} pixels undistorted: a smaller --width or --film, or another --projection"
        raise InputError("stmap", "--width", f"({size[0]} x {size[1]} pixels undistorted)", expected)
    return Plates(picture, (size[0], size[1]), pixel)


def undistort_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """Return the map [H, W] of the undistorted picture: R, G are places in the plate (0 to 1), B is where light is."""

    def read(place: Complex) -> tuple[Complex, NDArray[np.bool_]]:
        point = field.picture(place)
        return point, field.lit(point)

    return _channels(read, plates, plates.undistorted, plates.picture, report)


def redistort_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """Return the channels of the map that makes the lens's picture."""
    return _channels(lambda p: (field.ideal(p), field.lit(p)), plates, plates.picture, plates.undistorted, report)


def illumination_map(field: Field, plates: Plates, report: Report = lambda share: None) -> dict[str, FloatArray]:
    """Return the relative illumination of the lens's picture, 1 on the axis, as channel Y."""
    light = np.empty(plates.picture[::-1], np.float32)
    for rows, point in blocks(plates.picture, plates.pixel_mm, report):
        light[rows] = field.relative_light(point)
    return {"Y": light}


def _channels(
    where: Callable[[Complex], tuple[Complex, NDArray[np.bool_]]],
    plates: Plates,
    made: tuple[int, int],
    read: tuple[int, int],
    report: Report,
) -> dict[str, FloatArray]:
    planes = {name: np.empty(made[::-1], np.float32) for name in "RGB"}
    for rows, point in blocks(made, plates.pixel_mm, report):
        place, lit = where(point)
        s = place.real / (read[0] * plates.pixel_mm[0]) + 0.5
        t = place.imag / (read[1] * plates.pixel_mm[1]) + 0.5
        inside = lit & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        for name, values in zip("RGB", (s, t, inside), strict=True):
            planes[name][rows] = values
    return planes


def blocks(size: tuple[int, int], pixel_mm: tuple[float, float], report: Report) -> Iterator[tuple[slice, Complex]]:
    """Yield rows from the top with the places of their pixels' centres, x + i y in mm."""
    width, height = size
    x = (np.arange(width) + 0.5 - width / 2) * pixel_mm[0]
    y = (height / 2 - 0.5 - np.arange(height)) * pixel_mm[1]
    step = max(1, _ROWS // width)
    for start in range(0, height, step):
        rows = slice(start, min(start + step, height))
        yield rows, x[None, :] + 1j * y[rows, None]
        report(rows.stop / height)


def in_pixels(moved_mm: Complex, pixel_mm: tuple[float, float]) -> dict[str, float]:
    """Return the root mean square and the worst of displacements in mm, as pixels; NaN is left out."""
    px = np.hypot(moved_mm.real / pixel_mm[0], moved_mm.imag / pixel_mm[1])
    return {"rms_px": float(np.sqrt(np.nanmean(px**2))), "worst_px": float(np.nanmax(px))}


def worst_px(field: Field, plates: Plates) -> tuple[float, float]:
    """Return the farthest that distortion moves a point, and the largest error of undistorting it and coming back.

    Both are in pixels, and over a grid of points of the picture.
    """
    x, y = (np.linspace(-0.5, 0.5, n) * s * p for n, s, p in zip(_TRIED, plates.picture, plates.pixel_mm, strict=True))
    point = (x[None, :] + 1j * y[:, None]).reshape(-1)
    point = point[np.abs(point) <= field.end_mm]
    place = field.ideal(point)
    return float(plates.pixels(place - point).max()), float(plates.pixels(field.picture(place) - point).max())
