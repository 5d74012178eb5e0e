"""Curves over the field: colour, field curvature and astigmatism, distortion, vignetting and illumination."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import bundle, hexapolar, points
from neurolens.analysis.fields import Array, Result, Scene, on_plane
from neurolens.analysis.pupil_nodes import LitPart, converged, lit_nodes, lit_part
from neurolens.analysis.seidel import petzval_curvature
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays, pupil_plane_z_mm
from neurolens.trace.rays import passing
from neurolens.trace.surfaces import Rays

LINE_G_NM = 435.8343  # mercury, the usual fourth line

# Share of the stop's radius that stands for the paraxial ray: its error grows with the square.
PARAXIAL = 1e-3
_ZONES = (PARAXIAL, 0.5**0.5, 1 - 1e-7)
_VISIBLE_NM = (380.0, 780.0)


@dataclass(frozen=True)
class Colour(Result):
    """Colour of a lens; the film's place counts as zero focus, shifts positive away from the lens.

    Attributes:
        spectrum_nm: [L].
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
    line_nm: Sequence[float] | None = None,
    fields: int = 21,
) -> Colour:
    """Longitudinal colour on the axis by zones, and lateral colour of chief rays up to the edge of the field.

    The spectrum is 380 to 780 nm and the lines are d, F, C and g; of a lens for other light, its range and wavelengths.

    Raises:
        InputError: a pinhole, which has no focus.
    """
    scene.require_power()
    lens = scene.lens
    if spectrum_nm is None:
        spectrum_nm = np.linspace(*(_VISIBLE_NM if lens.visible else lens.light_nm), 41).tolist()
    spectrum = np.asarray(spectrum_nm, dtype=np.float64)
    line_nm = line_nm or (*scene.waves_nm, *((LINE_G_NM,) if lens.visible else ()))
    axial = bundle(scene.round, [0.0], spectrum.tolist(), points(list(_ZONES), [0.0] * 3))
    crossing = -(axial.tangential_mm / axial.slopes[0])[0].numpy()
    angles = np.linspace(0, scene.edge.field_deg, fields)
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
    scene: Scene, *, wavelength_nm: float | None = None, fields: int = 31, edge_deg: float | None = None
) -> Curvature:
    """Sagittal and tangential foci up to the edge of the field, rims ignored.

    Raises:
        InputError: a pinhole, which has no focus.
    """
    scene.require_power()
    wavelength_nm = scene.lens.reference_nm if wavelength_nm is None else wavelength_nm
    angles = np.linspace(0, scene.edge.field_deg if edge_deg is None else edge_deg, fields)
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
        edge_percent: error of `reference` at the edge of the field. edge: which edge that is.
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    scale_mm: float
    error_percent: dict[str, Array]
    best: str
    reference: str
    edge_percent: float
    edge: str


def distortion(
    scene: Scene, *, wavelength_nm: float | None = None, fields: int = 41, edge_deg: float | None = None
) -> Distortion:
    """Distortion against every projection. For a near object of a rectilinear lens, object heights are used."""
    wavelength_nm = scene.lens.reference_nm if wavelength_nm is None else wavelength_nm
    angles = np.linspace(0, scene.edge.field_deg if edge_deg is None else edge_deg, fields)
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
        float(errors[reference][-1]), scene.edge.name if edge_deg is None else f"{edge_deg:g} degrees",
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
        spread: by figure, [F, ...], by how much two samplings of the pupil differ (`pupil_nodes.converged`).
    """

    wavelength_nm: float
    field_deg: Array
    height_mm: Array
    relative: Array
    unvignetted: Array
    passed: Array
    cos4: Array
    spread: dict[str, Array]


def illumination(scene: Scene, *, fields: int = 21) -> Illumination:
    """Relative illumination at the reference wavelength up to the edge of the field, from where rays leave the film.

    Fields without a chief ray are NaN, and all are where the axis gets no light.
    """
    angles, nm = np.linspace(0, scene.edge.field_deg, fields), scene.lens.reference_nm
    rays = bundle(scene.open, angles.tolist(), [nm], hexapolar(6))
    pupil = on_plane(Rays(*(c[:, 0] for c in rays.film)), pupil_plane_z_mm(scene.lens))
    both = [_FilmLight(scene, lens, rays.chief_height_mm, pupil) for lens in (scene.open.traced, scene.lens)]

    def shares(light: list[Array]) -> dict[str, tuple[Array, Array | float]]:
        whole, seen = light
        with np.errstate(divide="ignore", invalid="ignore"):  # dark fields, or an axis without light: NaN
            found = seen / (seen[0] or np.nan), whole / (whole[0] or np.nan), seen / whole
        return {k: (v, 1.0) for k, v in zip(("relative", "unvignetted", "passed"), found, strict=True)}

    light, spread = converged(lambda level, some: [b.only(some).sums(level) for b in both], shares, fields)
    cos4 = np.where(angles < 90, np.cos(np.radians(angles)), 0.0) ** 4
    relative, unvignetted, passed = (values for values, _ in shares(light).values())
    height = rays.chief_height_mm.numpy()
    return Illumination(nm, angles, height, relative, unvignetted, passed, cos4, spread)


class _FilmLight:
    """Light that film points at F heights see through a lens, on the plane of the pupil."""

    def __init__(self, scene: Scene, lens: Lens, height_mm: Tensor, pupil: Rays) -> None:
        """`pupil`: rays [F, P] that fill the pupil of each film point, on its plane."""
        self.scene, self.lens, self.height_mm = scene, lens, height_mm
        self.plane_z_mm = pupil_plane_z_mm(scene.lens)
        # Where no ray meets the edge of the stop, the rear surface bounds the light, as seen from the film point.
        zero = torch.zeros_like(height_mm)
        film = torch.stack((-height_mm, zero) if scene.axis == "x" else (zero, -height_mm), 1)
        rear_mm, rear_z_mm = scene.lens.surfaces[-1].semi_diameter_mm, float(scene.lens.vertices_mm[-2])
        farther = (scene.film_z_mm - self.plane_z_mm) / (scene.film_z_mm - rear_z_mm)
        rear = [film + (edge - film) * farther for edge in (-rear_mm, rear_mm)]
        places = torch.stack([pupil.x, pupil.y], 2)
        sound = torch.isfinite(places)
        low = torch.where(sound, places, torch.minimum(*rear)[:, None]).amin(1)
        high = torch.where(sound, places, torch.maximum(*rear)[:, None]).amax(1)
        margin = _MARGIN * (high - low)
        near = torch.where(sound, places, 0.0).sum(1) / sound.sum(1).clamp_min(1)
        self.part = lit_part(self._passes, low - margin, high + margin, near)

    def only(self, fields: list[int]) -> _FilmLight:
        """The same for some of the film points."""
        found = copy(self)
        found.height_mm, found.part = self.height_mm[fields], LitPart(*(c[fields] for c in self.part))
        return found

    def _rays(self, u: Tensor, v: Tensor) -> Rays:
        h, zero = (-self.height_mm)[:, None].expand(u.shape).reshape(-1), torch.zeros(u.numel(), dtype=torch.float64)
        x, y = (h, zero) if self.scene.axis == "x" else (zero, h)
        return camera_rays(x, y, self.scene.film_z_mm, u.reshape(-1), v.reshape(-1), self.plane_z_mm)

    def _passes(self, u: Tensor, v: Tensor) -> Tensor:
        return passing(self.lens, self._rays(u, v), self.scene.lens.reference_nm).reshape(u.shape)

    def sums(self, level: int) -> Array:
        """Integral [F] of cos^4 over what is lit, NaN for a film point without a chief ray."""
        nodes = lit_nodes(self._passes, self.part, level)
        cos4 = self._rays(*nodes[:2]).dz.reshape(nodes.u.shape) ** 4
        light = (nodes.area * cos4 * self._passes(*nodes[:2])).sum(1)
        found: Array = light.where(torch.isfinite(self.height_mm), torch.nan).numpy()
        return found
