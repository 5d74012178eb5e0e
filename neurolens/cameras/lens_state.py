"""What a header says of the lens of a picture: focal lengths, entrance pupil, T-stop, squeeze; to first order, d line.

    nominal     the focal length at infinity as it is engraved: whole mm, tenths below 10
    pinhole     film height over the slope of the chief ray in the scene: what the picture is framed with
    offset      from the film to the entrance pupil, positive towards the scene
    T           f-number / sqrt(transmittance of the axial ray)
    squeeze     focal length of the y-z plane over that of the x-z plane, 1 for a round lens; the others are of y-z

Definitions: OpenEXR, Standard Attributes, Lens State.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neurolens.base import status as st
from neurolens.cameras.lens_film import SceneFunction
from neurolens.lens.film_plane import LINE_D_NM

_ROUND = 0.02  # of the squeeze: less than this from 1 is the error of a model, not a cylinder


def lens_state(
    *,
    nominal_mm: float | None,
    efl_mm: float,
    pinhole_mm: float,
    entrance_pupil_mm: float,
    f_number: float,
    transmittance: float | None = 1.0,
    squeeze: float | None = 1.0,
) -> dict[str, Any]:
    """The table `lens_state` of a camera's settings, None where a number is not defined.

    Args:
        nominal_mm: focal length at infinity, None where nothing is engraved.
        efl_mm, pinhole_mm: as in the module.
        entrance_pupil_mm: from the film towards the scene.
        f_number: focal length over the entrance pupil's diameter, as it is.
        transmittance: of the axial ray, 0 to 1.
        squeeze: as in the module.
    """
    t_stop = f_number / math.sqrt(transmittance) if transmittance else None
    engraved = None if nominal_mm is None else round(abs(nominal_mm), 0 if abs(nominal_mm) >= 10 else 1)
    found = {
        "nominal_focal_length_mm": engraved,
        "effective_focal_length_mm": efl_mm,
        "pinhole_focal_length_mm": pinhole_mm,
        "entrance_pupil_offset_mm": entrance_pupil_mm,
        "f_number": f_number,
        "t_stop": t_stop,
        "squeeze": squeeze,
    }
    return {k: float(v) if v is not None and math.isfinite(v) else None for k, v in found.items()}


def ideal_state(
    efl_mm: float, f_number: float, pinhole_mm: float, entrance_pupil_mm: float | None = None
) -> dict[str, Any]:
    """The table of an ideal lens: nothing is engraved, all light passes; the pupil is where the pinhole would be."""
    pupil = pinhole_mm if entrance_pupil_mm is None else entrance_pupil_mm
    return lens_state(nominal_mm=None, efl_mm=efl_mm, pinhole_mm=pinhole_mm, entrance_pupil_mm=pupil, f_number=f_number)


def axial_transmittance(scene: SceneFunction, wavelength_nm: tuple[float, float]) -> float | None:
    """Transmittance of the axial ray at the wavelength nearest to the d line; None where the stop's shape blocks it."""
    axis = np.zeros((2, 1), np.float32)
    out = scene(axis, axis, np.clip([LINE_D_NM], *wavelength_nm).astype(np.float32))
    through = float(out.transmittance[0])
    return through if out.status[0] == st.PASSED and 0 < through <= 1 else None


def squeeze_of(scene: SceneFunction, height_mm: float, wavelength_nm: tuple[float, float]) -> float | None:
    """Squeeze of a lens that is known by its rays alone: one that leaves parallel to the axis at height h slopes h / f.

    Rays count whether they pass or not.
    """
    h = height_mm
    film = np.array([[h, -h, 0, 0], [0, 0, h, -h]], np.float32)
    out = scene(film, film, np.clip([LINE_D_NM] * 4, *wavelength_nm).astype(np.float32))
    with np.errstate(all="ignore"):
        slope = out.scene_ray[3:5].astype(np.float64) / out.scene_ray[5]
        squeeze = float((slope[0, 0] - slope[0, 1]) / (slope[1, 2] - slope[1, 3]))
    if abs(squeeze - 1) < _ROUND:
        return 1.0
    return squeeze if math.isfinite(squeeze) and squeeze > 0 else None
