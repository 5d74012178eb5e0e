"""Vignetting of any camera switched off: natural, optical, or both.

The film value of white surroundings is V(f) at a film point f, 1 on the axis. It is the product of:

    natural N(f) = <T cos^4> / <T>    cos^4 of the film-side angle to the axis, mean over the light that passes: the
                                      chief ray's, as the stop closes; of a fisheye projection its own law
    optical O(f) = <T> A              effective aperture: the area through which light passes, times its transmittance

each over its value on the axis. For the four white cards of Steinert 2009, 5.2, every ray of a film point is weighed by
the same factor, so that blur keeps its shape:

    both: 1     natural: N / V     optical: O / V     none: 1 / V

White surroundings then show V, N, O, or 1 wherever any light arrives. The means, over the wavelengths too, are tabled
over the film radius, and over the azimuth where the camera is not round.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import RAYS_A_CALL, CameraRays, FilmPoints, FloatArray
from neurolens.cameras.sampling import common_light, stratified
from neurolens.lens.shot import Vignetting

VIGNETTINGS: tuple[str, ...] = get_args(Vignetting)

Array = NDArray[np.float64]

# Film radii, azimuths and samples a side of the tables, of round cameras and of others; where roundness is tried.
_ROUND, _OTHER = (129, 1, 64), (33, 36, 24)
_TRIED_AT, _TRIED_AZIMUTHS, _UNEVEN = (0.5, 0.8, 0.95), 7, 0.01
_BATCH = 1 << 17
_HALVINGS = 16


class Vignetted:
    """A camera with its vignetting switched off, in part or as a whole; see the module.

    Args:
        camera: with `natural`, as all of this package have.
        vignetting: which of the two is left.
        wavelength_nm: range of the light, over which the means are taken.

    Raises:
        InputError: an unknown kind of vignetting.
    """

    def __init__(
        self, camera: Any, vignetting: str = "none", wavelength_nm: tuple[float, float] = (400.0, 700.0)
    ) -> None:
        if vignetting not in VIGNETTINGS:
            raise InputError("camera", "vignetting", vignetting, f"one of: {', '.join(VIGNETTINGS)}")
        self.camera, self.vignetting = camera, vignetting
        self.name, self.film_mm, self.wavelength_nm = camera.name, camera.film_mm, camera.wavelength_nm
        self.dispersive, self.achromatic = camera.dispersive, getattr(camera, "achromatic", False)
        self.rays_a_call = getattr(camera, "rays_a_call", RAYS_A_CALL)
        self.settings: dict[str, Any] = {**camera.settings, "vignetting": vignetting}
        self._table = _Table(camera, wavelength_nm)

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """The camera's rays, weighed anew."""
        return self._weighed(self.camera.sample(film_mm, pupil, wavelength_nm), film_mm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials, too."""
        return self._weighed(self.camera.sample_differentials(film_mm, pupil, wavelength_nm), film_mm)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """The camera's film points, weighed anew."""
        return self._weighed(found := self.camera.to_film(point_m, pupil, wavelength_nm), found.film_mm)

    def for_worker(self) -> Vignetted:
        """This camera about the one that the camera has for a worker."""
        other = copy(self)
        opener = getattr(self.camera, "for_worker", None)
        other.camera = opener() if opener else self.camera
        return other

    def _weighed(self, rays: Any, film_mm: FloatArray) -> Any:
        factor = self._table.factor(film_mm, self.vignetting)
        return replace(rays, weight=np.where(rays.weight > 0, rays.weight * factor, np.float32(0)))


class _Table:
    """V, N and O of a camera on a polar grid of film points [R, A]; radii grow closer towards the end of the light."""

    def __init__(self, camera: Any, wavelength_nm: tuple[float, float]) -> None:
        self.light = common_light(camera.wavelength_nm or wavelength_nm, wavelength_nm)
        self.end = self._end_of_light(camera)
        rows, azimuths, side = _ROUND if self._is_round(camera) else _OTHER
        radius = self.end * (1 - (1 - np.arange(rows) / (rows - 1)) ** 2)
        angle = 2 * math.pi * np.arange(azimuths) / azimuths
        value, optical = (
            means.reshape(rows, azimuths)
            for means in self._means(camera, np.repeat(radius, azimuths), np.tile(angle, rows), side)
        )
        value[0], optical[0] = value[0].mean(), optical[0].mean()
        optical /= optical[0, 0]
        natural = np.where(optical > 0, value / np.where(optical > 0, optical, 1) / value[0, 0], np.nan)
        for row in range(1, rows):  # where it is dark, as where light was last
            natural[row] = np.where(np.isnan(natural[row]), natural[row - 1], natural[row])
        columns = {"value": value, "natural": natural, "optical": optical}
        # A column more closes the circle.
        self.columns = {k: np.concatenate([v, v[:, :1]], axis=1).astype(np.float32) for k, v in columns.items()}

    def factor(self, film_mm: FloatArray, vignetting: str) -> FloatArray | np.float32:
        """What weights [N] at film points [2, N] are multiplied by; 0 where the table is dark."""
        if vignetting == "both":
            return np.float32(1)
        value = self._at(film_mm, "value")
        wanted = np.float32(1) if vignetting == "none" else self._at(film_mm, vignetting)
        lit = value > 0
        factor: FloatArray = np.where(lit, wanted / np.where(lit, value, np.float32(1)), np.float32(0))
        return factor

    def _at(self, film_mm: FloatArray, name: str) -> FloatArray:
        """A column of the table at film points, bilinear; NaN and what lies beyond the end takes the last row."""
        table = self.columns[name]
        rows, columns = table.shape
        with np.errstate(all="ignore"):
            inner = np.fmax(np.float32(1) - np.hypot(film_mm[0], film_mm[1]) / np.float32(self.end), np.float32(0))
        place = np.float32(rows - 1) * (np.float32(1) - np.sqrt(inner))
        row = np.minimum(place.astype(np.intp), rows - 2)
        step = place - row.astype(np.float32)
        if columns == 2:
            return table[row, 0] + step * (table[row + 1, 0] - table[row, 0])
        turn = np.nan_to_num(np.arctan2(film_mm[1], film_mm[0])) * np.float32((columns - 1) / (2 * math.pi))
        turn = np.where(turn < 0, turn + np.float32(columns - 1), turn)
        column = np.minimum(turn.astype(np.intp), columns - 2)
        across = turn - column.astype(np.float32)
        low, high = ((1 - across) * table[r, column] + across * table[r, column + 1] for r in (row, row + 1))
        found: FloatArray = low + step * (high - low)
        return found

    def _means(self, camera: Any, radius: Array, angle: Array, side: int) -> tuple[Array, Array]:
        """V and <T> A at film points (radius, angle) [M]: one wavelength a sample."""
        square, wavelength = stratified(side, self.light)
        count = square.shape[1]
        film = np.stack([radius * np.cos(angle), radius * np.sin(angle)]).astype(np.float32)
        value, optical = np.zeros(radius.size), np.zeros(radius.size)
        step = max(1, _BATCH // count)
        for start in range(0, radius.size, step):
            part = film[:, start : start + step]
            points = np.repeat(part, count, axis=1)
            samples, waves = np.tile(square, part.shape[1]), np.tile(wavelength, part.shape[1])
            weight = camera.sample(points, samples, waves).weight
            natural = camera.natural(points, samples, waves)
            area = np.where(weight > 0, weight / np.where(natural > 0, natural, 1), 0)
            for means, rays in ((value, weight), (optical, area)):
                means[start : start + step] = rays.reshape(part.shape[1], count).mean(1, dtype=np.float64)
        return value, optical

    def _end_of_light(self, camera: Any) -> float:
        """The largest film radius up to the corner at which light is found at any of the azimuths tried."""
        corner = 1.0001 * math.hypot(*camera.film_mm) / 2

        def lit(radius: Array) -> NDArray[np.bool_]:
            angle = np.arange(_TRIED_AZIMUTHS) * (2 * math.pi / _TRIED_AZIMUTHS)
            value = self._means(camera, np.repeat(radius, angle.size), np.tile(angle, radius.size), 16)[0]
            return np.asarray((value.reshape(radius.size, -1) > 0).any(1))

        steps = np.linspace(0, corner, 65)
        last = int(np.flatnonzero(lit(steps)).max(initial=0))
        if last == steps.size - 1:
            return corner
        low, high = steps[last], steps[last + 1]
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            if lit(np.array([middle]))[0]:
                low = middle
            else:
                high = middle
        return float(low)

    def _is_round(self, camera: Any) -> bool:
        """Whether V is the same at some azimuths, none of which is another's mirror image."""
        angle = np.arange(_TRIED_AZIMUTHS) * 0.83
        value = self._means(
            camera, np.repeat(self.end * np.array(_TRIED_AT), angle.size), np.tile(angle, len(_TRIED_AT)), _OTHER[2]
        )[0].reshape(-1, angle.size)
        return bool((np.ptp(value, axis=1) <= _UNEVEN * value.max()).all())
