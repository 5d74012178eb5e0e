"""Vignetting of any camera switched off: natural, optical, or both.

The film value of white surroundings is V(f) at a film point f, 1 on the axis. It is the product of:

    natural N(f) = <T cos^4> / <T>    cos^4 of the film-side angle to the axis, mean over the light that passes: the
                                      chief ray's, as the stop closes; of a fisheye projection its own law
    optical O(f) = <T> A              effective aperture: the area through which light passes, times its transmittance

each over its value on the axis. For the four white cards of Steinert 2009, 5.2, every ray of a film point is weighed by
the same factor, so that blur keeps its shape:

    both: 1     natural: N / V     optical: O / V     none: 1 / V

White surroundings then show V, N, O, or 1 wherever any light arrives. The means, over the wavelengths too, are tabled
on rings of the film, which are closer to each other towards the end of the light.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import RAYS_A_CALL, CameraRays, FilmPoints, FloatArray, SpectralRays
from neurolens.cameras.field import Complex, end_of_light, on_rings, turns
from neurolens.cameras.sampling import common_light, stratified
from neurolens.lens.shot import Vignetting

VIGNETTINGS: tuple[str, ...] = get_args(Vignetting)

Array = NDArray[np.float64]

# Rings, azimuths and samples a side of the tables, of round cameras and of others.
_ROUND, _OTHER = (129, 1, 64), (33, 36, 24)
# Where roundness is tried, at azimuths of which none is the mirror image of another; of the largest value.
_TRIED, _AROUND, _UNEVEN = (0.5, 0.8, 0.95), np.exp(0.83j * np.arange(7)), 0.01
_BATCH = 1 << 17


class Vignetted:
    """A camera with its vignetting switched off, in part or as a whole; see the module.

    Args:
        camera: with `natural`, as all of this package have.
        vignetting: the part that is kept.
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
        self.costly, self.lateral = getattr(camera, "costly", False), getattr(camera, "lateral", False)
        self.rays_a_call = getattr(camera, "rays_a_call", RAYS_A_CALL)
        self.settings: dict[str, Any] = {**camera.settings, "vignetting": vignetting}
        light = common_light(camera.wavelength_nm or wavelength_nm, wavelength_nm)
        corner = 1.0001 * math.hypot(*camera.film_mm) / 2
        self._end = end_of_light(lambda r: bool((_means(camera, light, r * _AROUND, 16)[0] > 0).any()), corner)
        tried = _means(camera, light, (self._end * np.array(_TRIED)[:, None] * _AROUND).reshape(-1), _OTHER[2])[0]
        uneven = np.ptp(tried.reshape(len(_TRIED), -1), axis=1) > _UNEVEN * tried.max()
        rings, azimuths, side = _OTHER if uneven.any() else _ROUND
        radius = self._end * (1 - (1 - np.arange(rings) / (rings - 1)) ** 2)
        means = _means(camera, light, (radius[:, None] * turns(azimuths)).reshape(-1), side)
        value, optical = (m.reshape(rings, azimuths) for m in means)
        optical /= optical[0].mean()
        natural = np.where(optical > 0, value / np.where(optical > 0, optical, 1) / value[0].mean(), np.nan)
        for row in range(1, rings):  # where it is dark, as where light was last
            natural[row] = np.where(np.isnan(natural[row]), natural[row - 1], natural[row])
        self._cards = {"natural": natural, "optical": optical, "none": np.ones_like(value), "both": value}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """The camera's rays, weighed anew."""
        return self._weighed(self.camera.sample(film_mm, pupil, wavelength_nm), film_mm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials, too."""
        return self._weighed(self.camera.sample_differentials(film_mm, pupil, wavelength_nm), film_mm)

    def sample_spectrum(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SpectralRays:
        """The camera's rays of several wavelengths, weighed anew at the film point of each."""
        found = self.camera.sample_spectrum(film_mm, pupil, wavelength_nm)
        passed = found.weight > 0
        factor = np.stack([self._factors(p, film) for p, film in zip(passed, found.film_mm, strict=True)])
        # Wavelengths share a ray in proportion to their factors, as to the densities with which they would draw it.
        # In equal shares a companion at the end of the light would have an unbounded weight.
        share = passed.sum(axis=0) * factor[0] / np.maximum(factor.sum(axis=0), 1e-30)
        return replace(found, weight=(found.weight * factor * share).astype(np.float32))

    @property
    def companion_reach_mm(self) -> tuple[float, float] | None:
        """The bound of the camera inside; None if it cannot place companions."""
        return getattr(self.camera, "companion_reach_mm", None)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """The camera's film points, weighed anew."""
        return self._weighed(found := self.camera.to_film(point_m, pupil, wavelength_nm), found.film_mm)

    def _weighed(self, rays: Any, film_mm: FloatArray) -> Any:
        return replace(rays, weight=(rays.weight * self._factors(rays.weight > 0, film_mm)).astype(np.float32))

    def _factors(self, passed: NDArray[np.bool_], film_mm: FloatArray) -> Array:
        """Factors of the weights of rays; 0 where none passes or the table is dark."""
        x, y = np.nan_to_num(film_mm.astype(np.float64), posinf=1e9, neginf=-1e9)
        radius = np.hypot(x, y)
        place = 1 - np.sqrt(1 - np.minimum(radius / self._end, 1))  # rings are equal steps of it
        point = (x + 1j * y) / np.where(radius > 0, radius, 1) * place
        value, wanted = (on_rings(table, 1.0, point) for table in (self._cards["both"], self._cards[self.vignetting]))
        lit = (value > 0) & passed
        return np.where(lit, np.maximum(wanted, 0) / np.where(lit, value, 1), 0)


def _means(camera: Any, light_nm: tuple[float, float], point: Complex, side: int) -> tuple[Array, Array]:
    """V and <T> A at film points [M]: one wavelength a sample."""
    square, wavelength = stratified(side, light_nm)
    count, film = square.shape[1], np.stack([point.real, point.imag]).astype(np.float32)
    value, optical = np.zeros(point.size), np.zeros(point.size)
    step = max(1, _BATCH // count)
    for start in range(0, point.size, step):
        part = film[:, start : start + step]
        rays = np.repeat(part, count, axis=1), np.tile(square, part.shape[1]), np.tile(wavelength, part.shape[1])
        weight, natural = camera.sample(*rays).weight, camera.natural(*rays)
        area = np.where(weight > 0, weight / np.where(natural > 0, natural, 1), 0)
        for means, values in ((value, weight), (optical, area)):
            means[start : start + step] = values.reshape(part.shape[1], count).mean(1, dtype=np.float64)
    return value, optical
