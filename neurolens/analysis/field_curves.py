"""Curves over the field: colour, field curvature and astigmatism, distortion, vignetting and illumination."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import bundle, hexapolar, points
from neurolens.analysis.fields import DEFAULT_NM, Array, Result, Scene, on_plane
from neurolens.analysis.seidel import petzval_curvature
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

LINE_G_NM = 435.8343  # mercury, the usual fourth line

# Share of the stop's radius that stands for the paraxial ray: its error grows with the square.
PARAXIAL = 1e-3
_ZONES = (PARAXIAL, 0.5**0.5, 1 - 1e-7)
_VISIBLE_NM = (380.0, 780.0)


@dataclass(frozen=True)
class Colour(Result):
    """Colour of a lens; the film's place counts as zero focus, shifts positive away from the lens.

    Attributes:
        spectrum_nm: [L], 380 to 780.
        zone: [3] shares of the stop's radius: paraxial, half of the area, edge.
        focus_shift_mm: [L, 3] where rays of each zone cross the axis; NaN where a rim blocks them.
        field_deg, height_mm: [F], of the chief ray of the first line.
        line_nm: [W]; the first is the reference.
        lateral_um: [F, W] image height less that of the reference.
    """

    spectrum_nm: Array
    zone: Array
    focus_shift_mm: Array
    field_deg: Array
    height_mm: Array
    line_nm: Array
    lateral_um: Array


def colour(
    scene: Scene,
    *,
    spectrum_nm: Sequence[float] | None = None,
    line_nm: Sequence[float] = (*DEFAULT_NM, LINE_G_NM),
    fields: int = 21,
) -> Colour:
    """Longitudinal colour on the axis by zones, and lateral colour of chief rays up to the edge of the field.

    Raises:
        InputError: a pinhole, which has no focus.
    """
    scene.require_power()
    spectrum = np.linspace(*_VISIBLE_NM, 41) if spectrum_nm is None else np.asarray(spectrum_nm, dtype=np.float64)
    axial = bundle(scene.round, [0.0], spectrum.tolist(), points(list(_ZONES), [0.0] * 3))
    crossing = -(axial.tangential_mm / axial.slopes[0])[0].numpy()
    angles = np.linspace(0, scene.edge_deg(), fields)
    chief = bundle(scene.open, angles.tolist(), line_nm, points([0.0], [0.0]))
    # Tangential points grow with image height where the field's angle is positive.
    lateral = 1000 * chief.tangential_mm[..., 0].numpy()
    return Colour(
        spectrum, np.array(_ZONES), crossing, angles, chief.chief_height_mm.numpy(), np.array(line_nm), lateral
    )


_CLOSE = 1e-3  # stop radii; differences are central, so that the error is of the order of its square


@dataclass(frozen=True)
class Curvature(Result):
    """Foci over F fields from the axis to the edge, one wavelength.

    Attributes:
        field_deg, height_mm: [F] of the chief ray.
        tangential_mm, sagittal_mm: [F] along the axis from the film, positive away from the lens.
        petzval_mm: [F] the Petzval surface at these heights, drawn through the sagittal focus on the axis.
        petzval_radius_mm: its radius, positive when its centre lies towards +z; inf when flat; NaN with cylinders.
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    tangential_mm: Array
    sagittal_mm: Array
    petzval_mm: Array
    petzval_radius_mm: float


def curvature(
    scene: Scene, *, wavelength_nm: float = LINE_D_NM, fields: int = 31, edge_deg: float | None = None
) -> Curvature:
    """Sagittal and tangential foci up to the edge of the field, rims ignored.

    Raises:
        InputError: a pinhole, which has no focus.
    """
    scene.require_power()
    angles = np.linspace(0, scene.edge_deg() if edge_deg is None else edge_deg, fields)
    pattern = points([-_CLOSE, _CLOSE, 0.0, 0.0], [0.0, 0.0, -_CLOSE, _CLOSE])
    rays = bundle(scene.open, angles.tolist(), [wavelength_nm], pattern)
    slope_t, slope_s = rays.slopes
    tangential = _crossing(rays.tangential_mm[:, 0, :2], slope_t[:, 0, :2])
    sagittal = _crossing(rays.sagittal_mm[:, 0, 2:], slope_s[:, 0, 2:])
    height = rays.chief_height_mm.numpy()
    bend = petzval_curvature(scene.lens, wavelength_nm)
    return Curvature(
        wavelength_nm, angles, height, tangential, sagittal,
        sagittal[0] + bend * height**2 / 2,
        float("inf") if bend == 0 else 1 / bend,
    )  # fmt: skip


def _crossing(place: Tensor, slope: Tensor) -> Array:
    """z from the film at which two rays [F, 2] cross."""
    return (-(place[:, 1] - place[:, 0]) / (slope[:, 1] - slope[:, 0])).numpy()


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
        reference: rectilinear below 60 degrees of half field, `best` from there on.
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
    """Distortion against every projection. For a near object of a rectilinear lens, object heights are used."""
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


_MARGIN = 0.08  # margin of the grid around the bundle, as film points beside the chief ray see another pupil


@dataclass(frozen=True)
class Illumination(Result):
    """Light over F fields from the axis to the edge, one wavelength, glass without losses.

    Attributes:
        field_deg, height_mm: [F] of the chief ray.
        relative: [F] film irradiance over that on the axis.
        unvignetted: [F] the same without rims: natural falloff, pupil growth and distortion.
        passed: [F] share of the stop's light that no rim takes.
        cos4: [F] cos^4 of the field angle, 0 from 90 degrees on.
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    relative: Array
    unvignetted: Array
    passed: Array
    cos4: Array


def illumination(scene: Scene, *, fields: int = 21, n: int = 80) -> Illumination:
    """Relative illumination at the d line up to the edge of the field, with n by n rays from each film point.

    Fields without a chief ray are NaN, and all are where the axis gets no light.
    """
    angles = np.linspace(0, scene.edge_deg(), fields)
    rays = bundle(scene.open, angles.tolist(), [LINE_D_NM], hexapolar(6))
    film = on_plane(Rays(*(c[:, 0] for c in rays.film)), pupil_plane_z_mm(scene.lens))
    start, area = _grid(scene, rays.chief_height_mm, film, n)
    with torch.no_grad():
        light = area[:, None] * start.dz.reshape(fields, -1) ** 4
        whole, seen = (_sum(light, lens, start) for lens in (scene.open.traced, scene.lens))
    cos4 = np.where(angles < 90, np.cos(np.radians(angles)), 0.0) ** 4
    with np.errstate(divide="ignore", invalid="ignore"):  # dark fields, or an axis without light: NaN
        relative, unvignetted, passed = seen / (seen[0] or np.nan), whole / (whole[0] or np.nan), seen / whole
    return Illumination(LINE_D_NM, angles, rays.chief_height_mm.numpy(), relative, unvignetted, passed, cos4)


def _sum(light: Tensor, lens: Lens, start: Rays) -> Array:
    passed = (trace(lens, start).status == 0).reshape(light.shape)
    found: Array = (light * passed).sum(1).where(torch.isfinite(light).all(1), torch.nan).numpy()
    return found


def _grid(scene: Scene, height: Tensor, pupil: Rays, n: int) -> tuple[Rays, Tensor]:
    """Rays [F * n * n] from the film to a grid over the pupil that a bundle fills, and the area of its cells [F]."""
    share = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    columns = []
    area = torch.ones_like(height)
    for place in (pupil.x, pupil.y):
        low = torch.nan_to_num(place, nan=torch.inf).amin(1)
        high = torch.nan_to_num(place, nan=-torch.inf).amax(1)
        low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
        columns.append(low[:, None] + (high - low)[:, None] * share)
        area = area * (high - low) / n**2
    shape = (len(height), n, n)
    px, py = columns[0][:, :, None].expand(shape).reshape(-1), columns[1][:, None, :].expand(shape).reshape(-1)
    h, zero = (-height)[:, None, None].expand(shape).reshape(-1), torch.zeros_like(px)
    x, y = (h, zero) if scene.axis == "x" else (zero, h)
    return camera_rays(x, y, scene.film_z_mm, px, py, pupil_plane_z_mm(scene.lens)), area
