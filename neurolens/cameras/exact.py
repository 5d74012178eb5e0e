"""The exact lens as a camera: every ray traced through every surface. The one camera that needs torch."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.cameras.contract import CameraRays, FloatArray
from neurolens.cameras.lens_film import LensFilm, SceneRays
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.cameras.pupil_search import COARSE, FINE
from neurolens.cameras.sampling import check_film, positive
from neurolens.optics.differentials import film_tangents, trace_differentials
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Focus, Lens
from neurolens.optics.pupils import PupilBounds, camera_rays, passes_at_any_azimuth, pupil_bounds, symmetric_about_axis
from neurolens.optics.trace import trace


class ExactCamera:
    """A camera whose lens is the prescription itself.

    Args:
        lens: in the zoom state wanted.
        film_mm: width and height of the film.
        focus_m: distance from film to the object in focus; inf allowed.
        f_number: None keeps the lens's stop.
        wavelength_nm: range of the wavelengths; the d line stands in for a lens without known dispersion.
        dtype: precision of the trace.
        focus: how the lens is focused; see `Lens.at`.
        film_offset_mm: moves the film away from the lens (negative: towards it) after focusing.
        bounds: pupil bounds of a domain that holds this focus and stop; rays are then those of the domain's models for
            the same random numbers. None searches for them, over the whole film.

    Raises:
        InputError: a focus nearer than four focal lengths, a lens that no ray passes.
    """

    def __init__(
        self,
        lens: Lens,
        *,
        film_mm: tuple[float, float],
        focus_m: float,
        f_number: float | None = None,
        wavelength_nm: tuple[float, float] = (400.0, 700.0),
        dtype: Literal["float32", "float64"] = "float32",
        bounds: PupilBounds | None = None,
        focus: Focus = "film",
        film_offset_mm: float = 0.0,
    ) -> None:
        self._pid = os.getpid()
        self.film_mm = check_film(film_mm)
        self.focus_m = positive("focus_m", focus_m, infinite=True)
        self.lens = lens.at(f_number=f_number, focus_m=self.focus_m, focus=focus)
        self.name = lens.name
        self.dispersive = lens.dispersive
        self.wavelength_nm = wavelength_nm if self.dispersive else None
        used = wavelength_nm if self.dispersive else (LINE_D_NM, LINE_D_NM)
        film_z = self.lens.film_z_mm
        assert film_z is not None  # `at` places the film
        if film_offset_mm:
            film_z += film_offset_mm
            self.lens = replace(self.lens, film_z_mm=film_z)
        # A lens with cylinders is searched at many azimuths for one outline: coarser, for it fits none of them closely.
        round_ = symmetric_about_axis(self.lens)
        detail = FINE if round_ else COARSE._replace(tighten=bounds is not None)
        if bounds is None:
            corner = math.hypot(*self.film_mm) / 2
            rows, points = (17, 128) if round_ else (13, 48)
            bounds = pupil_bounds(
                self.lens, 1.0001 * corner, (film_z, film_z), used, rows=rows, points=points, film_mm=self.film_mm
            )
        self._pupil_z_mm = bounds.pupil_z_mm
        self._dtype = torch.float32 if dtype == "float32" else torch.float64
        self.film = LensFilm(PupilTable.of(asdict(bounds)), float(film_z), used, self._scene, self._passes, detail)
        data = first_order(self.lens)
        self.settings: dict[str, Any] = {
            "camera": "exact",
            "lens": {"id": lens.lens_id, "name": lens.name, "sha256": lens.sha256},
            "efl_mm": float(data.efl_mm),
            "f_number": float(data.f_number),
            "focus_m": None if math.isinf(self.focus_m) else self.focus_m,
            "film_mm": list(self.film_mm),
            "film_z_mm": float(film_z),
            "film_offset_mm": film_offset_mm,
            "stop_radius_mm": float(self.lens.stop_radius_mm),
            "focusing": focus,
            "derived": self.lens.derived,
            "rims": lens.rims,
            "aperture": self.lens.aperture and self.lens.aperture.settings(),
            "dtype": dtype,
        }

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self.film.sample(film_mm, pupil, wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays, carried through every surface."""
        return self.film.sample(film_mm, pupil, wavelength_nm, self._with_differentials)

    def for_worker(self) -> ExactCamera:
        """This camera, in a render worker. A forked process must not enter torch's thread pool: it never returns."""
        if os.getpid() != self._pid:
            torch.set_num_threads(1)
        return self

    def _scene(self, film: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SceneRays:
        fx, fy, px, py, wavelength = (
            torch.from_numpy(np.ascontiguousarray(a)).to(self._dtype) for a in (*film, *pupil, wavelength_nm)
        )
        film_z = self.lens.film_z_mm
        assert film_z is not None
        rays = camera_rays(fx, fy, film_z, px, py, self._pupil_z_mm)
        with torch.no_grad():
            done = trace(self.lens, rays, wavelength, transmittance=True)
        assert done.transmittance is not None
        scene = torch.stack(list(done.rays)).to(torch.float32).numpy()
        return SceneRays(scene, done.transmittance.to(torch.float32).numpy(), done.status.numpy())

    def _with_differentials(self, film: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SceneRays:
        fx, fy, px, py, wavelength = (
            torch.from_numpy(np.ascontiguousarray(a)).double() for a in (*film, *pupil, wavelength_nm)
        )
        film_z = self.lens.film_z_mm
        assert film_z is not None
        rays = camera_rays(fx, fy, film_z, px, py, self._pupil_z_mm)
        gap = film_z - self._pupil_z_mm
        distance = torch.sqrt((fx - px) ** 2 + (fy - py) ** 2 + gap * gap)
        moves = trace_differentials(self.lens, rays, film_tangents(rays, distance), wavelength).derivatives
        d_film = torch.stack([torch.stack(list(m)) for m in moves], 1).to(torch.float32).numpy()
        return self._scene(film, pupil, wavelength_nm)._replace(d_film=d_film)

    def _passes(self, film: FloatArray, pupil: FloatArray, wavelength_nm: float) -> NDArray[np.bool_]:
        """Whether light passes from film points (r, 0) through pupil points; see `passes_at_any_azimuth`."""
        r, u, v = (torch.from_numpy(np.ascontiguousarray(a)).to(self._dtype) for a in (film[0], *pupil))
        film_z = self.lens.film_z_mm
        assert film_z is not None
        with torch.no_grad():
            return passes_at_any_azimuth(
                self.lens, r, film_z, u, v, self._pupil_z_mm, wavelength_nm, self.film_mm
            ).numpy()
