"""Kernels of bokeh over the field and distances, in pictures that compositing programs read."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import frame_of
from neurolens.defocus.kernels import Kernel, kernel_at
from neurolens.defocus.plate import FloatArray, PlatePinhole
from neurolens.defocus.rings import Grooves

_LARGEST = 16384  # pixels a side of an atlas


@dataclass(frozen=True)
class Cell:
    """One kernel: its field (-1 to 1 from left to right and from bottom to top of the film), its distance from the film
    in m, the film place that is its centre, and the kernel; None where no light arrives."""

    field: tuple[float, float]
    distance_m: float
    place_px: tuple[float, float]
    kernel: Kernel | None

    @property
    def width_px(self) -> int:
        """Pixels a side, odd, that hold the kernel about its place."""
        if self.kernel is None:
            return 1
        first = np.subtract(self.kernel.corner_px, np.floor(self.place_px))
        return 2 * int(np.abs([first, first + self.kernel.light.shape[1::-1] - 1]).max()) + 1


def pinhole_of(camera: Camera, size: tuple[int, int]) -> PlatePinhole:
    """The camera's own pinhole, whose picture has `size` pixels on its film: that of `neurolens stmap`."""
    frame = frame_of(camera)
    per_mm = [n / mm for n, mm in zip(size, camera.film_mm, strict=True)]
    reach = frame.reach_mm[0] * per_mm[0], frame.reach_mm[1] * per_mm[1]
    return PlatePinhole(reach, (size[0] / 2, size[1] / 2), frame.pupil_mm[1])


def kernels_over(
    camera: Camera, size: tuple[int, int], distances_m: Sequence[float], fields: tuple[int, int],
    wavelengths_nm: tuple[float, float, float] | None = None, grooves: Grooves | None = None,
    report: Callable[[float], None] = lambda _: None,
) -> list[list[Cell]]:  # fmt: skip
    """The kernels of each distance, row by row from the top of the picture.

    Args:
        size: of the picture in pixels. distances_m: from the film, along the axis; inf is far.
        fields: columns and rows of places, in the middles of equal parts of the picture.
        wavelengths_nm, grooves: as for `kernel_at`.

    Raises:
        InputError: a distance within the lens; kernels too large for memory.
    """
    pinhole, found = pinhole_of(camera, size), []
    places = [
        ((i + 0.5) / fields[0] * size[0], (j + 0.5) / fields[1] * size[1])
        for j, i in itertools.product(range(fields[1]), range(fields[0]))
    ]
    for number, distance in enumerate(distances_m):
        ahead, cells = distance - pinhole.before_film_mm / 1000, list[Cell]()
        if not ahead > 0:
            expected = f"above {pinhole.before_film_mm / 1000:g}, the entrance pupil"
            raise InputError("kernels", "distance_m", distance, expected)
        for place in places:
            kernel = kernel_at(
                camera, pinhole, size, place, 1 / ahead, place, wavelengths_nm=wavelengths_nm, grooves=grooves
            )
            field = 2 * place[0] / size[0] - 1, 1 - 2 * place[1] / size[1]
            cells.append(Cell(field, distance, place if kernel is None else kernel.middle_px, kernel))
            if max(fields) * (side := cells[-1].width_px) > _LARGEST:
                got = f"({fields[0] * side} x {fields[1] * side} pixels)"
                expected = f"at most {_LARGEST} pixels a side: fewer fields, or less blur"
                raise InputError("kernels", "size", got, expected)
            report((number + len(cells) / len(places)) / len(distances_m))
        found.append(cells)
    return found


def as_picture(cells: Sequence[Cell], columns: int, side: int) -> FloatArray:
    """The atlas [rows side, columns side, 3] of the kernels of one distance, each of sum 1 in each channel."""
    picture = np.zeros((len(cells) // columns * side, columns * side, 3), np.float32)
    for k, cell in enumerate(cells):
        j, i = divmod(k, columns)
        if cell.kernel is not None:
            picture[j * side :, i * side :][:side, :side] = cell.kernel.centred(side, cell.place_px)
    return picture


def as_preview(picture: FloatArray, side: int) -> FloatArray:
    """An atlas with each kernel as bright as the others, to be looked at."""
    found = picture.copy()
    for j, i in itertools.product(range(0, len(found), side), range(0, found.shape[1], side)):
        part = found[j : j + side, i : i + side]
        part /= float(np.percentile(part[part > 0], 90)) if part.any() else 1.0
    return found
