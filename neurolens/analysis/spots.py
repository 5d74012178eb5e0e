"""Ray aberrations: spot diagrams over field and focus, ray fans, and the geometric MTF of the spots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import Bundle, bundle, fan, grid, hexapolar, points
from neurolens.analysis.fields import DEFAULT_NM, Array, Result, Scene
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
        rms_um: [F] root mean square distance from the centroid, over all wavelengths, weighted by energy.
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
    rays = bundle(scene, field_deg, wavelength_nm, hexapolar(rings))
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
        # Rays parallel up to rounding have no best focus.
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
    """Shifts about the film that include the best foci of the fields, and at least a few depths of focus."""
    depth = 4e-6 * wavelength_nm * f_number**2 if math.isfinite(f_number) else 0.0  # Rayleigh's, +- 2 lambda N^2
    reach = max(2 * depth, 1.5 * float(torch.nan_to_num(best).abs().median()))
    return np.linspace(-reach, reach, _SHIFTS) if reach > 0 else np.linspace(-0.1, 0.1, _SHIFTS)


@dataclass(frozen=True)
class Fans(Result):
    """Fans of F fields, W wavelengths and n pupil points.

    Attributes:
        pupil: [n] share of the stop's radius, -1 to 1.
        tangential_um: [F, W, n], aberration in the meridional plane of the rays along it.
        sagittal_um: [F, W, n], aberration across the meridional plane of the rays along the other line.
            Both from the chief ray of the first wavelength; NaN where a rim blocks.
    """

    field_deg: Array
    wavelength_nm: Array
    height_mm: Array
    pupil: Array
    tangential_um: Array
    sagittal_um: Array


def fans(
    scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] = DEFAULT_NM, *, n: int = 65
) -> Fans:
    """Ray fans of fields (`Scene.default_fields` if not given) with n points along each line of the stop."""
    pattern = fan(n)
    rays = bundle(scene, field_deg, wavelength_nm, pattern)
    return Fans(
        np.array(rays.field_deg),
        np.array(rays.wavelength_nm),
        rays.chief_height_mm.numpy(),
        pattern.tangential[:n].numpy(),
        1000 * rays.tangential_mm[..., :n].numpy(),
        1000 * rays.sagittal_mm[..., n:].numpy(),
    )


@dataclass(frozen=True)
class Mtf(Result):
    """MTF of F fields at K frequencies.

    Attributes:
        frequency_per_mm: [K] cycles per mm on the film.
        tangential: [F, K], contrast of lines across the meridional plane (blur along it counts).
        sagittal: [F, K], contrast of lines along it.
        diffraction_limit: [K], of a perfect lens of the same working f-number on the axis, first wavelength.
        shift_mm: how far from the film, positive away from the lens.
    """

    field_deg: Array
    height_mm: Array
    wavelength_nm: Array
    frequency_per_mm: Array
    tangential: Array
    sagittal: Array
    diffraction_limit: Array
    working_f_number: float
    shift_mm: float


def mtf(
    scene: Scene,
    field_deg: Sequence[float] | None = None,
    wavelength_nm: Sequence[float] = DEFAULT_NM,
    *,
    frequency_per_mm: Sequence[float] | None = None,
    shift_mm: float = 0.0,
    across: int = 128,
) -> Mtf:
    """Modulus of the energy-weighted mean of exp(2 pi i f x) over the rays of all wavelengths; NaN without light.

    The rays fill the stop as a square grid, `across` points wide: a fine one, since rims cut the pupil anywhere. With
    128 points an even disc of light comes within 0.001 of its Bessel function, and fields that lose up to two thirds
    of their light to the rims within 0.01 of a grid of 300 points, 0.0025 up to 50 cycles/mm.
    """
    rays = bundle(scene, field_deg, wavelength_nm, grid(across))
    f = np.linspace(0, 100, 101) if frequency_per_mm is None else np.asarray(frequency_per_mm, dtype=np.float64)
    n = working_f_number(scene, wavelength_nm[0])
    weight = (rays.weight / rays.weight.sum((1, 2), keepdim=True)).flatten(1)
    both = [_contrast(torch.nan_to_num(x).flatten(1), weight, f) for x in rays.at_shift(shift_mm)]
    return Mtf(
        np.array(rays.field_deg), rays.chief_height_mm.numpy(), np.array(rays.wavelength_nm), f, both[0], both[1],
        diffraction_mtf(f, wavelength_nm[0], n), n, shift_mm,
    )  # fmt: skip


def diffraction_mtf(frequency_per_mm: Array, wavelength_nm: float, f_number: float) -> Array:
    """MTF of a perfect lens with a round pupil: 2/pi (acos s - s sqrt(1 - s^2)), s = f lambda N (Goodman, 6.3)."""
    s = np.clip(frequency_per_mm * wavelength_nm * 1e-6 * f_number, 0.0, 1.0)
    found: Array = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    return found


def _contrast(x_mm: torch.Tensor, weight: torch.Tensor, frequency: Array) -> Array:
    found = []
    for f in frequency.tolist():
        phase = x_mm * (2 * np.pi * f)
        found.append(torch.hypot((weight * torch.cos(phase)).sum(1), (weight * torch.sin(phase)).sum(1)))
    result: Array = torch.stack(found, 1).numpy()
    return result
