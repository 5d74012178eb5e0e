"""Derivatives of exported models that were written with them: numpy and onnxruntime alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.onnxlens import DERIVATIVES, INPUTS, OUTPUTS, LensRays, OnnxLens
from neurolens.cameras.onnxsession import open_session, run_session

# Rays a call: these graphs have more rows than those without derivatives.
BATCH = 8192


class LensDerivatives(NamedTuple):
    """A model's rays, and their derivatives [6, 2, N]: x, y, z (mm) and direction by x and y of a point, per mm.

    `d_film`: the pupil point held; `d_pupil`: the film point held.
    """

    rays: LensRays
    d_film: FloatArray
    d_pupil: FloatArray


class OnnxDerivatives:
    """The derivatives of a loaded model; its session is one of its own, so that others do not pay for it.

    Raises:
        InputError: a model that was exported without derivatives, or one of many states.
    """

    def __init__(self, model: OnnxLens) -> None:
        self.model = model
        try:
            if model.axes:
                raise ModelError(f"{model.path}: a model of many states")
            self._session = open_session(model.path, model.data, model.threads, INPUTS, {**OUTPUTS, **DERIVATIVES})
        except ModelError as error:
            raise InputError(model.path, "derivatives", f"({error})", "a model exported with derivatives") from error

    def __call__(
        self, film: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray, film_z_mm: float, stop_radius_mm: float
    ) -> LensDerivatives:
        """Rays and derivatives for film and pupil points [2, N] mm and wavelengths [N] nm, as `OnnxLens.rays`."""
        count = film.shape[1]
        feeds = {
            "film_z_mm": np.array([film_z_mm], np.float32),
            "stop_radius_mm": np.array([stop_radius_mm], np.float32),
        }
        rays = np.empty((5, count), np.float32)
        rays[:2], rays[2:4], rays[4] = film, pupil, wavelength_nm
        parts = [
            run_session(
                self.model.path,
                self._session,
                (*OUTPUTS, *DERIVATIVES),
                {"rays": np.ascontiguousarray(rays[:, i : i + BATCH]), **feeds},
            )
            for i in range(0, max(count, 1), BATCH)
        ]
        out = [np.concatenate(columns, -1) for columns in zip(*parts, strict=True)]
        return LensDerivatives(LensRays(*out[:4]), *(np.moveaxis(d, 0, 1) for d in out[4:]))
