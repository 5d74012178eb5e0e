"""Spot diagrams over field and focus, their sizes, and the Airy disc that diffraction would leave."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import Bundle, bundle
from neurolens.analysis.fields import DEFAULT_NM, Scene
from neurolens.analysis.patterns import hexapolar, points
from neurolens.analysis.results import Array, Result
from neurolens.optics.paraxial import is_pinhole

_RINGS = 16
_SHIFTS = 21
_ZONES = 101  # heights in the stop tried for the outermost ray that passes, and again between two of them


@dataclass(frozen=True)
class Spots(Result):
    """Spots of F fields, W wavelengths, P rays; shifts of the film are positive away from the lens.

    Attributes:
        field_deg, height_mm: [F], of the chief ray of the first wavelength.
        tangential_um, sagittal_um: [F, W, P] relative to that chief ray, NaN where blocked.
        slope_tangential, slope_sagittal: [F, W, P], for spots at another focus.
        rms_um: [F] root mean square distance from the centroid, all wavelengths alike, weighted by energy.
        geometric_um: [F] the largest distance from the centroid; NaN, as all sizes, where no ray passes.
        rms_by_wavelength_um: [F, W], each from its own centroid.
        passed: [F] share of the stop's light that no rim takes.
        airy_um: radius of the first dark ring on the axis, 1.22 lambda N with the working f-number.
        shift_mm, through_focus_um: [K] and [F, K], RMS radius with the film moved.
        best_shift_mm, best_rms_um: [F], where each field's RMS radius is least; NaN where rays stay parallel.
    """

    field_deg: Array
    wavelength_nm: Array
    height_mm: Array
    tangential_um: Array
    sagittal_um: Array
    slope_tangential: Array
    slope_sagittal: Array
    rms_um: Array
    geometric_um: Array
    rms_by_wavelength_um: Array
    passed: Array
    working_f_number: float
    airy_um: float
    shift_mm: Array
    through_focus_um: Array
    best_shift_mm: Array
    best_rms_um: Array


def spots(
    scene: Scene,
    field_deg: Sequence[float] | None = None,
    wavelength_nm: Sequence[float] = DEFAULT_NM,
    *,
    rings: int = _RINGS,
    shift_mm: Sequence[float] | None = None,
) -> Spots:
    """Spot diagrams; the fields are those of `Scene.default_fields` and the shifts span the best foci if not given."""
    rays = bundle(scene, scene.default_fields() if field_deg is None else field_deg, wavelength_nm, hexapolar(rings))
    t, s = 1000 * rays.tangential_mm, 1000 * rays.sagittal_mm
    st, ss = rays.slopes
    moments = _Moments(rays)
    best = moments.best_shift()
    n = working_f_number(scene, wavelength_nm[0])
    shifts = torch.as_tensor(_span(best, n, wavelength_nm[0]) if shift_mm is None else shift_mm, dtype=torch.float64)
    centre_t, centre_s = (1000 * m for m in moments.centroid)
    away = torch.hypot(t - centre_t[:, None, None], s - centre_s[:, None, None])
    open_energy = rays.open_weight.sum((1, 2))
    return Spots(
        np.array(rays.field_deg), np.array(rays.wavelength_nm), rays.chief_height_mm.numpy(),
        t.numpy(), s.numpy(), st.numpy(), ss.numpy(),
        moments.rms_um(torch.zeros(1, dtype=torch.float64))[:, 0].numpy(),
        torch.where(rays.passed, away, -1.0).amax((1, 2)).where(rays.passed.any(2).any(1), math.nan).numpy(),
        _Moments(rays, by_wavelength=True).rms_um(torch.zeros(1, dtype=torch.float64))[..., 0].numpy(),
        (rays.weight.sum((1, 2)) / open_energy).numpy(),
        n, 1.22e-3 * wavelength_nm[0] * n,
        shifts.numpy(), moments.rms_um(shifts).numpy(), best.numpy(), moments.rms_um(best[:, None]).numpy()[:, 0],
    )  # fmt: skip


class _Moments:
    """Energy-weighted second moments of a spot, from which its RMS radius at every focus follows: it is a parabola."""

    def __init__(self, rays: Bundle, by_wavelength: bool = False) -> None:
        along = (2,) if by_wavelength else (1, 2)
        weight = rays.weight / rays.weight.sum(along, keepdim=True)
        self.centroid: list[Tensor] = []
        self.spread = self.mixed = self.steep = torch.zeros(1, dtype=torch.float64)
        for place, slope in zip((rays.tangential_mm, rays.sagittal_mm), rays.slopes, strict=True):
            a, b = torch.nan_to_num(place), torch.nan_to_num(slope)
            mean_a, mean_b = (weight * a).sum(along, keepdim=True), (weight * b).sum(along, keepdim=True)
            self.centroid.append(mean_a.squeeze(2).squeeze(1) if not by_wavelength else mean_a[..., 0])
            self.spread = self.spread + (weight * (a - mean_a) ** 2).sum(along)
            self.mixed = self.mixed + (weight * (a - mean_a) * (b - mean_b)).sum(along)
            self.steep = self.steep + (weight * (b - mean_b) ** 2).sum(along)

    def best_shift(self) -> Tensor:
        # Rays parallel but for rounding meet nowhere.
        return torch.where(self.steep > 1e-20, -self.mixed / self.steep, math.nan)

    def rms_um(self, shift_mm: Tensor) -> Tensor:
        """RMS radius at shifts [K] (or one for each field [F, 1]), with shifts last, in um."""
        a, b, c = (m[..., None] for m in (self.spread, self.mixed, self.steep))
        return 1000 * torch.sqrt((a + 2 * b * shift_mm + c * shift_mm**2).clamp_min(0.0))


def working_f_number(scene: Scene, wavelength_nm: float) -> float:
    """1 / (2 sin theta') of the outermost real ray of the axis that passes stop and rims; NaN if none does.

    Of a hole without a lens: its distance from the film over its diameter.
    """
    if is_pinhole(scene.lens):
        return float(scene.first_order.f_number)
    low, high, sine = 0.0, 1 - 1e-7, 0.0
    for _ in range(2):
        heights = np.linspace(low, high, _ZONES)
        rays = bundle(scene.round, [0.0], [wavelength_nm], points(heights.tolist(), [0.0] * _ZONES))
        passed = rays.passed[0, 0].numpy()
        if not passed.any():
            break
        sines = torch.hypot(rays.film.dx, rays.film.dy)[0, 0].numpy()
        sine = max(sine, float(sines[passed].max()))
        last = int(np.flatnonzero(passed)[-1])
        if last == _ZONES - 1:
            break
        low, high = float(heights[last]), float(heights[last + 1])
    return 1 / (2 * sine) if sine > 0 else math.nan


def _span(best: Tensor, f_number: float, wavelength_nm: float) -> Array:
    """Shifts about the film that hold the best foci of the fields, and a few depths of focus in any case."""
    depth = 4e-6 * wavelength_nm * f_number**2 if math.isfinite(f_number) else 0.0  # Rayleigh's, +- 2 lambda N^2
    reach = max(2 * depth, 1.5 * float(torch.nan_to_num(best).abs().median()))
    return np.linspace(-reach, reach, _SHIFTS) if reach > 0 else np.linspace(-0.1, 0.1, _SHIFTS)
