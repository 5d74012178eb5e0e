"""What exact and modelled lenses share as cameras: pupil sampling, weights, exposure, and the camera frame.

One code for both, so that they send the same rays for the same random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens import status as st
from neurolens.cameras.contract import CameraRays, FloatArray
from neurolens.errors import InputError

# Lattice on a row's box when the bounds are tightened for a closed stop; along and across (one half).
_LATTICE = (96, 48)
# Points a side of the quadrature of the exposure on the axis, and wavelengths.
_QUADRATURE, _WAVELENGTHS = 256, 3


class SceneRays(NamedTuple):
    """Scene-side rays: scene_ray [6, N] (x, y, z mm, unit direction; lens frame), transmittance [N], status [N]."""

    scene_ray: FloatArray
    transmittance: FloatArray
    status: NDArray[np.int32]


# Film points [2, N] mm, pupil points [2, N] mm and wavelengths [N] nm to scene-side rays.
SceneFunction = Callable[[FloatArray, FloatArray, FloatArray], SceneRays]


@dataclass(frozen=True)
class PupilTable:
    """Boxes on the pupil plane that hold the passing rays of film points at equally spaced radii.

    For a film point at radius r along +x, passing rays lie within low <= u <= high along +x and |v| <= half across.

    Attributes:
        pupil_z_mm: the plane.
        film_radius_mm: radius of the last row; the first row is the axis.
        rows: [3, R]: low, high, half; low > high where nothing passes.
    """

    pupil_z_mm: float
    film_radius_mm: float
    rows: FloatArray

    @staticmethod
    def of(bounds: Mapping[str, Any]) -> PupilTable:
        """From the fields of `optics.pupils.PupilBounds`, as a model's card holds them."""
        rows = np.array([bounds["low_mm"], bounds["high_mm"], bounds["half_mm"]], dtype=np.float32)
        if rows.ndim != 2 or rows.shape[1] < 2 or not np.isfinite(rows).all():
            raise InputError("pupil bounds", "low_mm, high_mm, half_mm", rows.shape, "three lists of finite numbers")
        return PupilTable(float(bounds["pupil_z_mm"]), float(bounds["film_radius_mm"]), rows)

    def sample(self, film_mm: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Uniform points in the boxes of film points.

        Args:
            film_mm: [2, N].
            square: [2, N] in [0, 1).

        Returns the points [2, N] in mm and the areas [N] of their boxes in mm^2, 0 where nothing passes.
        """
        count = self.rows.shape[1]
        radius = np.sqrt(np.einsum("in,in->n", film_mm, film_mm))
        # Beyond the last row, and for NaN, the place is that of the dark row at the end.
        place = np.fmin(radius * np.float32((count - 1) / self.film_radius_mm), np.float32(count - 1))
        row = place.astype(np.intp)
        step = place - row
        low, low_step, width, width_step, half, half_step = self._between.take(row, axis=1)
        width += width_step * step
        half += half_step * step
        along = low + low_step * step + width * square[0]
        across = half * (square[1] * np.float32(2) - np.float32(1))
        # Turn the box to the azimuth of the film point.
        on_axis = radius == 0
        scale = np.float32(1) / np.where(on_axis, np.float32(1), radius)
        cos, sin = film_mm[0] * scale + on_axis, film_mm[1] * scale
        return np.stack([along * cos - across * sin, along * sin + across * cos]), width * half * np.float32(2)

    @cached_property
    def _between(self) -> FloatArray:
        """[6, R] low, width and half width at each row, each with its step to the next; a dark row at the end.

        Rows hold the boxes of their neighbours, so what passes between two rows lies in the mean of their boxes.
        """
        low, high, half = self.rows
        lit = np.append((low <= high)[:-1] & (low <= high)[1:], False)
        columns = np.stack([low, high - low, half])
        steps = np.diff(columns, axis=1, append=columns[:, -1:])
        return np.where(lit, np.stack([columns, steps], axis=1).reshape(6, -1), np.float32(0))


def tightened(table: PupilTable, scene: SceneFunction, wavelength_nm: Sequence[float]) -> PupilTable:
    """The same rows with boxes cut to what passes now, for example through a closed stop.

    Bounds move on a lattice of the table's own boxes: two lenses that agree on which lattice points pass have equal
    tables.
    """
    count = table.rows.shape[1]
    u, v = np.linspace(0, 1, _LATTICE[0], dtype=np.float32), np.linspace(0, 1, _LATTICE[1], dtype=np.float32)
    fu, fv = (a.ravel() for a in np.meshgrid(u, v, indexing="ij"))
    boxes = np.empty((3, count), np.float32)
    for k in range(count):
        low, high, half = table.rows[:, k]
        boxes[:, k] = (1, -1, 0)
        if low > high:
            continue
        radius = np.float32(table.film_radius_mm * min(k / (count - 1), 1 - 1e-6))
        film = np.stack([np.full_like(fu, radius), np.zeros_like(fu)])
        pupil = np.stack([low + (high - low) * fu, half * fv])
        passed = np.zeros(_LATTICE, bool)
        for wavelength in wavelength_nm:
            status = scene(film, pupil, np.full_like(fu, wavelength)).status
            passed |= (status == st.PASSED).reshape(_LATTICE)
        if passed.any():
            along, across = np.flatnonzero(passed.any(1)), np.flatnonzero(passed.any(0))
            # One lattice step wider: the boundary lies between two points.
            first, last = max(along[0] - 1, 0), min(along[-1] + 1, len(u) - 1)
            boxes[:, k] = (
                low + (high - low) * u[first],
                low + (high - low) * u[last],
                half * v[min(across[-1] + 1, len(v) - 1)],
            )
    return replace(table, rows=_with_neighbours(boxes))


def _with_neighbours(boxes: FloatArray) -> FloatArray:
    """Every box joined with the boxes of the film radii next to it."""
    low = np.where(boxes[0] <= boxes[1], boxes[0], np.inf)
    high = np.where(boxes[0] <= boxes[1], boxes[1], -np.inf)
    padded = [np.pad(a, 1, constant_values=c) for a, c in ((low, np.inf), (high, -np.inf), (boxes[2], 0.0))]
    low, high, half = (
        f([a[:-2], a[1:-1], a[2:]], axis=0) for f, a in zip((np.min, np.max, np.max), padded, strict=True)
    )
    empty = low > high
    return np.stack([np.where(empty, 1, low), np.where(empty, -1, high), half]).astype(np.float32)


class LensFilm:
    """Film and pupil of a lens at one focus and stop: from film points and random numbers to weighted rays.

    Args:
        table: bounds of the passing rays, at least those of this focus and stop.
        film_z_mm: film plane, lens frame.
        wavelength_nm: range of the wavelengths used.
        scene: the lens.
        stopped: whether the stop is closed further than that of `table`, so that its boxes are worth tightening.

    Raises:
        InputError: no ray passes from the film's centre.
    """

    def __init__(
        self,
        table: PupilTable,
        film_z_mm: float,
        wavelength_nm: tuple[float, float],
        scene: SceneFunction,
        stopped: bool,
    ) -> None:
        self.film_z_mm, self.scene = film_z_mm, scene
        self.distance_mm = film_z_mm - table.pupil_z_mm
        self.table = tightened(table, scene, sorted(set(wavelength_nm))) if stopped else table
        self.exposure = 1.0
        self.exposure = self._exposure_on_axis(wavelength_nm)

    def sample(self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, random numbers [2, N] in [0, 1) and wavelengths [N] in nm."""
        pupil, area = self.table.sample(film_mm, square)
        out = self.scene(film_mm, pupil, wavelength_nm)
        # A film point that nothing reaches is dark; a model calls it outside its domain, and so does this.
        status = np.where((area > 0) | (out.status != st.PASSED), out.status, np.int32(st.OUTSIDE_DOMAIN))
        # w = T A cos^4 / Z^2, over the exposure on the axis.
        slope = (pupil - film_mm) * np.float32(1 / self.distance_mm)
        cos2 = 1 / (1 + np.einsum("in,in->n", slope, slope))
        scale = np.float32(1 / (self.distance_mm**2 * self.exposure))
        weight = np.maximum(out.transmittance, 0) * area * cos2 * cos2 * scale
        weight = np.where(status == st.PASSED, weight, np.float32(0))
        origin = out.scene_ray[:3] * np.float32(1e-3)
        origin[2] -= np.float32(1e-3 * self.film_z_mm)
        return CameraRays(
            origin, np.ascontiguousarray(out.scene_ray[3:]), weight.astype(np.float32), status.astype(np.int32)
        )

    def _exposure_on_axis(self, wavelength_nm: tuple[float, float]) -> float:
        """Integral of T cos over solid angle at the film's centre, mean over the wavelengths: midpoint rule."""
        middle = ((np.arange(_QUADRATURE) + 0.5) / _QUADRATURE).astype(np.float32)
        square = np.stack([a.ravel() for a in np.meshgrid(middle, middle)])
        film = np.zeros_like(square)
        low, high = wavelength_nm
        used = low + (high - low) * (np.arange(_WAVELENGTHS) + 0.5) / _WAVELENGTHS if low < high else [low]
        means = [
            self.sample(film, square, np.full(square.shape[1], w, np.float32)).weight.mean(dtype=np.float64)
            for w in used
        ]
        exposure = float(np.mean(means))
        if not exposure > 0:
            raise InputError("camera", "f_number, focus_m", "(no ray passes on the axis)", "a lens that light can pass")
        return exposure
