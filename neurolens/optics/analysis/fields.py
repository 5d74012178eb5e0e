"""Fields of view: chief rays from the scene, where they meet the film, and which field reaches its edge.

A field is an angle from the axis in degrees in one meridional plane, that of the chief ray (through the middle of
the stop) before the lens. The image lies on the negative side of the plane's axis; image heights are given positive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.base.report import Report, over
from neurolens.optics.lens.glass import LINE_C_NM, LINE_D_NM, LINE_F_NM
from neurolens.optics.lens.paraxial import FirstOrder, first_order, is_pinhole
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import image_radius_mm, on_plane
from neurolens.optics.trace.aiming import Axis, aim_at_stop, between, bracket, from_stop, without_rims
from neurolens.optics.trace.rays import plain_trace
from neurolens.optics.trace.surfaces import Rays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OverField(Report):
    """Base of results over F fields, `field_deg` [F], whose chief rays meet the film at `height_mm` [F].

    Arrays are numpy float64, NaN where undefined.
    """

    field_deg: Array
    height_mm: Array = field(metadata=over("field_deg"))


DEFAULT_NM = (LINE_D_NM, LINE_F_NM, LINE_C_NM)

# From this half field on a lens counts as wide: near objects then lie on a sphere, not on a plane.
WIDE_DEG = 60.0

_FRACTIONS = (0.0, 0.5, 0.7, 0.85, 1.0)
_WIDEST_DEG = 179.0
# fields that are tried, denser near the axis; how often neighbours among them are looked at more closely
_SEARCH, _ROUNDS = 181, 4
_MET = 1e-6  # of the film's radius or of the field: how close a search must come


class ChiefRays(NamedTuple):
    """Chief rays of F fields, traced without rims.

    Attributes:
        start: [F] just before the front surface, travelling to the film.
        exists: [F] bool; False where no ray of a field meets the middle of the stop.
        height_mm: [F] image height, positive.
        film: [F] rays on the film.
    """

    start: Rays
    exists: Tensor
    height_mm: Tensor
    film: Rays

    @property
    def field_rad(self) -> Tensor:
        """The angles [F] to the axis in the scene."""
        return torch.atan2(torch.hypot(self.start.dx, self.start.dy), self.start.dz)


@dataclass(frozen=True)
class FieldEdge(Report):
    """The widest field that is analysed.

    Attributes:
        field_deg, height_mm: of its chief ray.
        meant: which edge was looked for: the film's, as the lens file or an option states it; the field's, where the
            file states only that; else that of the lit film.
        reached: False where no chief ray comes from there; this is then the nearest field that has one.
    """

    field_deg: float
    height_mm: float
    meant: str
    reached: bool

    @property
    def name(self) -> str:
        """The edge in words."""
        return self.meant if self.reached else f"the last chief ray, {self.height_mm:.4g} mm"

    @property
    def warning(self) -> str | None:
        """A sentence about an edge that was not reached; None where it was."""
        where = f"{self.field_deg:.4g} degrees, {self.height_mm:.4g} mm"
        return None if self.reached else f"no chief ray comes from {self.meant}; fields end at {where}"


@dataclass(frozen=True)
class Scene:
    """A lens that is set, with its object.

    Attributes:
        lens: placed by `set_lens`; else the table's last thickness places the film.
        focus_m: distance from the film to the object, inf allowed. The object is a plane across the axis; for a lens of
            60 degrees half field or more it is a sphere about the entrance pupil.
        axis: transverse axis of the meridional plane; it matters for anamorphic lenses only.
        rims: False opens every rim but the stop's; aspheres continue smoothly beyond theirs.
    """

    lens: Lens
    focus_m: float = math.inf
    axis: Axis = "y"
    rims: bool = True

    @property
    def film_z_mm(self) -> float:
        """The z of the film in mm."""
        return float(self.lens.film_z_mm if self.lens.film_z_mm is not None else self.lens.vertices_mm[-1])

    @property
    def waves_nm(self) -> tuple[float, ...]:
        """The wavelengths of white light, reference first: d, F and C, or those of a lens made for other light."""
        return DEFAULT_NM if self.lens.visible else self.lens.wavelengths_nm

    @property
    def first_order(self) -> FirstOrder:
        return first_order(self.lens, meridian=self.axis)

    @property
    def image_radius_mm(self) -> float:
        """The radius of the lit film."""
        return image_radius_mm(self.lens)[0]

    def image_axes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tangential component, positive towards the image, and the sagittal one of x and y on the film."""
        return (-x, y) if self.axis == "x" else (-y, x)

    @property
    def object_z_mm(self) -> float:
        """The z in mm of the object on the axis; -inf for a distant one."""
        return self.film_z_mm - 1000 * self.focus_m

    def chief_rays(self, field_deg: Sequence[float] | Tensor | Any, wavelength_nm: float | None = None) -> ChiefRays:
        """Return chief rays of fields in degrees, 0 to below 180, at one wavelength (None: the reference)."""
        nm = self.lens.reference_nm if wavelength_nm is None else wavelength_nm
        angles = torch.deg2rad(torch.as_tensor(field_deg, dtype=torch.float64).reshape(-1))
        middle = torch.zeros(len(angles), 1, dtype=torch.float64)
        aimed = aim_at_stop(self.lens, angles, middle, axis=self.axis, wavelength_nm=nm)
        return self._from(aimed.rays, aimed.reached[:, 0], nm)

    def chief_rays_at(self, stop_rad: Sequence[float] | Array, wavelength_nm: float | None = None) -> ChiefRays:
        """Chief rays by their angles [F] in the stop, which need no search; `ChiefRays.field_rad` has their fields."""
        nm = self.lens.reference_nm if wavelength_nm is None else wavelength_nm
        angle = torch.as_tensor(stop_rad, dtype=torch.float64).reshape(1, -1)
        front = without_rims(replace(self.lens, surfaces=self.lens.surfaces[: self.lens.stop_index + 1]))
        start, _, exists = from_stop(front, torch.zeros_like(angle), angle, self.axis, nm)
        return self._from(start, exists[0], nm)

    def _from(self, start: Rays, exists: Tensor, nm: float) -> ChiefRays:
        """Trace chief rays from before the front surface to the film."""
        out = plain_trace(without_rims(self.lens), start, nm, towards="film")
        exists = exists & (out.status == 0)
        film = on_plane(out.rays, self.film_z_mm)
        height, _ = self.image_axes(film.x, film.y)
        return ChiefRays(start, exists, torch.where(exists, height, math.nan), film)

    def object_points(self, chief: Rays) -> tuple[Tensor, Tensor, Tensor] | None:
        """Return the points of the object that the chief rays leave, [F] each, mm; None for a distant object."""
        if math.isinf(self.focus_m):
            return None
        if self.wide:
            centre = self.first_order.entrance_pupil_z_mm
            radius = centre - self.object_z_mm
            # Of the ray run backwards, the far meeting with the sphere: |p - c + t d| = radius.
            z = chief.z - centre
            b = chief.x * chief.dx + chief.y * chief.dy + z * chief.dz
            t = -b - torch.sqrt(b * b - (chief.x**2 + chief.y**2 + z * z - radius * radius))
        else:
            t = (self.object_z_mm - chief.z) / chief.dz
        return chief.x + t * chief.dx, chief.y + t * chief.dy, chief.z + t * chief.dz

    @property
    def wide(self) -> bool:
        return (self.lens.half_field_deg or self.edge.field_deg) >= WIDE_DEG

    @property
    def edge(self) -> FieldEdge:
        """The widest field that is analysed.

        Raises:
            InputError: the lens forms no image, or has no chief rays off the axis.
        """
        return _edge(self)

    def default_fields(self) -> tuple[float, ...]:
        """Return the axis, 50%, 70%, 85% and the edge of the field, in degrees."""
        return tuple(share * self.edge.field_deg for share in _FRACTIONS)

    def fields_at(self, height_mm: Sequence[float]) -> list[float]:
        """Return the fields in degrees whose chief rays meet the film at these heights; NaN where no chief ray does."""
        field, reached = self.nearest_fields(height_mm)
        return np.where(reached, field, math.nan).tolist()

    def nearest_fields(self, wanted: Sequence[float], *, degrees: bool = False) -> tuple[Array, Array]:
        """Find the fields in degrees whose chief rays meet the film at the heights `wanted` (mm).

        Of several such fields the one nearest to the axis is returned; where there is none, the field of the chief ray
        that comes nearest. The second array tells where there is one.

        Args:
            degrees: whether the values are angles of fields instead; the nearest that has a chief ray is taken.
        """
        target = torch.as_tensor(wanted, dtype=torch.float64).reshape(-1)
        angle = (_WIDEST_DEG * torch.linspace(0, 1, _SEARCH, dtype=torch.float64) ** 2).expand(len(target), -1)
        for closer in range(_ROUNDS + 1):
            chief = self.chief_rays(angle.reshape(-1))
            exists, value = chief.exists.reshape(angle.shape), chief.height_mm.reshape(angle.shape)
            value = angle if degrees else value
            if closer < _ROUNDS:
                ends = bracket(angle, value, exists, target, math.inf)
                angle = ends if closer == _ROUNDS - 1 else between(ends)
        off, best = torch.where(exists, (value - target[:, None]).abs(), math.inf).min(1, keepdim=True)
        reached = off[:, 0] <= _MET * target.abs().clamp_min(1.0)
        return angle.gather(1, best)[:, 0].numpy(), reached.numpy()

    @property
    def open(self) -> Scene:
        """Return the scene with a lens that has no rims."""
        return replace(self, rims=False)

    @property
    def round(self) -> Scene:
        """Return the scene with a round stop in its lens."""
        return replace(self, lens=replace(self.lens, aperture=None))

    @property
    def traced(self) -> Lens:
        """The lens that rays go through."""
        if self.rims:
            return self.lens
        rows = zip(self.lens.surfaces, without_rims(self.lens).surfaces, strict=True)
        return replace(self.lens, surfaces=tuple(old if old.stop else new for old, new in rows))

    @property
    def to_stop(self) -> Lens:
        """The lens from the front to the stop, whose opening is the only rim."""
        return replace(self.lens, surfaces=self.open.traced.surfaces[: self.lens.stop_index + 1])

    def require_power(self) -> None:
        """Raise InputError for a pinhole, which has no focus."""
        if is_pinhole(self.lens):
            raise InputError(self.lens.path, "surfaces", "(a pinhole)", "a lens with power")


@lru_cache(maxsize=16)
def _edge(scene: Scene) -> FieldEdge:
    lens, stated, focal = scene.lens, scene.lens.half_field_deg, scene.first_order.efl_mm
    if focal <= 0:
        raise InputError(lens.path, "efl_mm", f"{focal:.4g}", "a lens that forms an image (EFL above 0)")
    by_field = lens.image_radius_mm is None and stated is not None
    wanted = float(stated) if by_field and stated is not None else scene.image_radius_mm
    film = "film" if lens.image_radius_mm is not None else "lit film (10% of the light)"
    meant = f"the stated half field, {wanted:.4g} degrees" if by_field else f"the edge of the {film}, {wanted:.4g} mm"
    (field,), (reached,) = scene.nearest_fields([wanted], degrees=by_field)
    if not field > 0:
        raise InputError(lens.path, "half_field_deg", stated, "a lens with chief rays off the axis")
    return FieldEdge(float(field), float(scene.chief_rays([field]).height_mm[0]), meant, bool(reached))
