"""Distortion: image height of the chief ray against the projections that lenses are built for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from neurolens.analysis.fields import Scene
from neurolens.analysis.results import Array, Result
from neurolens.optics.glass import LINE_D_NM

# Image height over focal length for an angle in rad.
PROJECTIONS = {
    "rectilinear, f tan": lambda a: np.where(a < math.pi / 2, np.tan(np.minimum(a, 1.57)), np.nan),
    "equidistant, f theta": lambda a: a,
    "equisolid, 2 f sin(theta/2)": lambda a: 2 * np.sin(a / 2),
    "stereographic, 2 f tan(theta/2)": lambda a: 2 * np.tan(a / 2),
    "orthographic, f sin": lambda a: np.where(a <= math.pi / 2, np.sin(a), np.nan),
}
RECTILINEAR = next(iter(PROJECTIONS))
_SMALL_DEG = 1e-3  # the field whose image height gives the scale


@dataclass(frozen=True)
class Distortion(Result):
    """Distortion over F fields from the axis to the edge.

    Attributes:
        field_deg, height_mm: [F] of the chief ray.
        scale_mm: image height per radian at the axis: the focal length for a distant object.
        error_percent: projection to [F], 100 (height / ideal - 1); 0 on the axis, NaN where the projection ends.
        best: the projection of least root mean square error over the whole field.
        reference: the one to judge the lens by: rectilinear below 60 degrees of half field, `best` from there on.
        edge_percent: error of `reference` at the edge of the field.
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    scale_mm: float
    error_percent: dict[str, Array]
    best: str
    reference: str
    edge_percent: float


def distortion(
    scene: Scene, *, wavelength_nm: float = LINE_D_NM, fields: int = 41, edge_deg: float | None = None
) -> Distortion:
    """Distortion against every projection. The object of a near rectilinear picture is a plane: its heights count."""
    angles = np.linspace(0, scene.edge_deg() if edge_deg is None else edge_deg, fields)
    chief = scene.chief_rays(np.concatenate([[_SMALL_DEG], angles]), wavelength_nm)
    height = chief.height_mm.numpy()
    theta = np.radians(np.concatenate([[_SMALL_DEG], angles]))
    errors = {name: _error(height, ideal(theta)) for name, ideal in PROJECTIONS.items()}
    origin = scene.object_points(chief.start)
    if origin is not None and not scene.wide:
        across = (origin[0] if scene.axis == "x" else origin[1]).numpy()
        errors[RECTILINEAR] = _error(height, across)
    best = min(errors, key=lambda name: _rms(errors[name]))
    reference = best if scene.wide else RECTILINEAR
    return Distortion(
        wavelength_nm, angles, height[1:], float(height[0] / theta[0]), errors, best, reference,
        float(errors[reference][-1]),
    )  # fmt: skip


def _error(height: Array, ideal: Array) -> Array:
    """Error in percent with the scale that is right at the first, small field; that field left out of the answer."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = 100 * (height / ideal * (ideal[0] / height[0]) - 1)
    return np.where(ideal[1:] == 0, 0.0, error[1:])


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2))) if np.isfinite(error).all() else math.inf
