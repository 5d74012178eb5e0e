"""The exact lens as a compiled C camera: every surface, in one call."""

from __future__ import annotations

from typing import Any

from neurolens.base.errors import InputError
from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FloatArray
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.fused import FusedFilm
from neurolens.optics.glass import LINE_D_NM, absorption_of
from neurolens.optics.prescription import Lens
from neurolens.optics.traceprogram import exact_program


class FusedExactCamera(ExactCamera):
    """A prescription without coatings and absorption as a compiled camera: the rays of `ExactCamera` to rounding.

    Args and attributes are those of `ExactCamera`, whose `dtype` is float32 here; for differentials see `FusedFilm`.

    Raises:
        InputError: as `ExactCamera`; no C compiler; coatings or glass that absorbs.
    """

    rays_a_call = MANY_RAYS_A_CALL

    def __init__(self, lens: Lens, **kwargs: Any) -> None:
        _check(lens)
        super().__init__(lens, **kwargs)
        waves = self.wavelength_nm or (LINE_D_NM, LINE_D_NM)
        program = exact_program(self.lens, self._pupil_z_mm, waves)
        stop, surface = float(self.lens.stop_radius_mm), self.lens.stop_index
        self._fused = FusedFilm(self.film, program, stop, self.film_mm, self.lens.aperture, surface)
        self.settings |= {"runtime": "fused"}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self._fused.sample(film_mm, pupil, wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays, which come from the same pass."""
        return self._fused.sample(film_mm, pupil, wavelength_nm, True)

    @property
    def differentials_error(self) -> float | None:
        """See `FusedFilm.moves_error`."""
        return self._fused.moves_error


def _check(lens: Lens) -> None:
    for k, s in enumerate(lens.surfaces):
        coated = s.coating is not None and bool(s.coating.layers)
        absorbs = (s.glass is not None or s.absorption_per_mm) and absorption_of(s, LINE_D_NM) is not None
        if coated or absorbs:
            found = "(a coating)" if coated else "(glass that absorbs)"
            raise InputError(lens.path, f"surface {k}", found, "a bare, clear lens for a C tracer: leave out fused:")
