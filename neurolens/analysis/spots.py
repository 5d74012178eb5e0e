"""Ray aberrations: spot diagrams over field and focus, ray fans, and the geometric MTF of the spots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurolens.analysis.bundles import Bundle, Filled, bundle, fan, hexapolar
from neurolens.analysis.fields import Array, Result, Scene
from neurolens.analysis.pupil_nodes import converged
from neurolens.lens.paraxial import is_pinhole

_RINGS = 16
_SHIFTS = 21


@dataclass(frozen=True)
class Spots(Result):
    """Spots of F fields, W wavelengths, P rays; shifts of the film are positive away from the lens.

    Attributes:
        field_deg, height_mm: [F], of the chief ray of the first wavelength.
        tangential_um, sagittal_um: [F, W, P] from that chief ray, NaN where blocked; rings over the stop, to draw.
            The figures below are converged over what stop and rims leave open (`pupil_nodes`).
        slope_tangential, slope_sagittal: [F, W, P], for spots at another focus.
        rms_um: [F] root mean square distance from the centroid, over all wavelengths, weighted by energy.
        geometric_um: [F] the largest distance from the centroid; NaN, as all sizes, where no ray passes.
        rms_by_wavelength_um: [F, W], each from its own centroid.
        passed: [F] share of the stop's light that no rim takes.
        airy_um: radius of the first dark ring on the axis, 1.22 lambda N with the working f-number.
        shift_mm, through_focus_um: [K] and [F, K], RMS radius with the film moved.
        best_shift_mm, best_rms_um: [F], where each field's RMS radius is least; NaN where rays stay parallel.
        spread: by figure, [F, ...], by how much two samplings of the pupil differ (`pupil_nodes.converged`).
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
    spread: dict[str, Array]


def spots(
    scene: Scene,
    field_deg: Sequence[float] | None = None,
    wavelength_nm: Sequence[float] | None = None,
    *,
    rings: int = _RINGS,
    shift_mm: Sequence[float] | None = None,
) -> Spots:
    """Spot diagrams; the fields are those of `Scene.default_fields` and the shifts span the best foci if not given."""
    rays = bundle(scene, field_deg, wavelength_nm, hexapolar(rings))
    waves = rays.wavelength_nm
    n = working_f_number(scene, waves[0])
    airy = 1.22e-3 * waves[0] * n
    filled, stop = (Filled(scene, rays.field_deg, waves, to_stop=to_stop) for to_stop in (False, True))

    def figures(level: int, fields: list[int]) -> list[Array]:
        return _figures(filled.only(fields).bundle(level), stop.only(fields).energy(level))

    found, spread = converged(figures, lambda f: _shown(f, np.nan_to_num(airy)), len(rays.field_deg))
    rms, geometric, by_wavelength, passed, best, best_rms, *parabola = found
    shifts = np.asarray(_span(best, n, waves[0]) if shift_mm is None else shift_mm, dtype=np.float64)
    st, ss = rays.slopes
    return Spots(
        np.array(rays.field_deg), np.array(waves), rays.chief_height_mm.numpy(),
        1000 * rays.tangential_mm.numpy(), 1000 * rays.sagittal_mm.numpy(), st.numpy(), ss.numpy(),
        rms, geometric, by_wavelength, passed, n, airy,
        shifts, _rms_um(parabola, shifts), best, best_rms, spread,
    )  # fmt: skip


def _figures(rays: Bundle, open_energy: Tensor) -> list[Array]:
    """The figures of `Spots` that depend on how the pupil is sampled, and the second moments, each [F, ...].

    In the order of `_shown`; `open_energy` [F] is the light that enters the stop.
    """
    moments, each = _Moments(rays), _Moments(rays, by_wavelength=True)
    away = torch.hypot(*(p - c for p, c in zip((rays.tangential_mm, rays.sagittal_mm), moments.centroid, strict=True)))
    largest = torch.where(rays.passed, away, -math.inf).amax((1, 2))
    passed, best = rays.weight.sum((1, 2)) / open_energy, moments.best_shift()
    here = np.zeros(1)
    parabola = [v.numpy() for v in (moments.spread, moments.mixed, moments.steep)]
    return [
        _rms_um(parabola, here)[:, 0],
        1000 * largest.where(largest >= 0, math.nan).numpy(),
        _rms_um([v.numpy() for v in (each.spread, each.mixed, each.steep)], here)[..., 0],
        passed.numpy(), best.numpy(), _rms_um(parabola, best.numpy()[:, None])[:, 0], *parabola,
    ]  # fmt: skip


def _shown(figures: list[Array], airy_um: float) -> dict[str, tuple[Array, Array | float]]:
    """What is shown of `_figures`, with scales. The largest radius is that of a single ray: to fewer digits."""
    rms, geometric, by_wavelength, passed, best, best_rms = figures[:6]
    least = 0.01 * airy_um
    return {
        "rms_um": (rms, rms + least),
        "rms_by_wavelength_um": (by_wavelength, by_wavelength + least),
        "geometric_um": (geometric, 20 * (geometric + least)),
        "passed": (passed, 1.0),
        "best_shift_mm": (best, np.maximum(np.abs(best), 0.1)),
        "best_rms_um": (best_rms, best_rms + least),
    }


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
            self.centroid.append(mean_a)
            self.spread = self.spread + (weight * (a - mean_a) ** 2).sum(along)
            self.mixed = self.mixed + (weight * (a - mean_a) * (b - mean_b)).sum(along)
            self.steep = self.steep + (weight * (b - mean_b) ** 2).sum(along)

    def best_shift(self) -> Tensor:
        # Rays parallel up to rounding have no best focus.
        return torch.where(self.steep > 1e-20, -self.mixed / self.steep, math.nan)


def _rms_um(parabola: Sequence[Array], shift_mm: Array) -> Array:
    """RMS radius at shifts [K] (or one for each field [F, 1]), with shifts last, in um, of spread, mixed and steep."""
    a, b, c = (m[..., None] for m in parabola)
    return np.asarray(1000 * np.sqrt(np.maximum(a + 2 * b * shift_mm + c * shift_mm**2, 0.0)))


def working_f_number(scene: Scene, wavelength_nm: float) -> float:
    """1 / (2 sin theta') of the outermost real ray of the axis that passes stop and rims; NaN if none does.

    Of a hole without a lens: its distance from the film over its diameter.
    """
    if is_pinhole(scene.lens):
        return float(scene.first_order.f_number)
    rays = Filled(scene.round, [0.0], [wavelength_nm]).bundle(0)
    across = rays.film.dx if scene.axis == "x" else rays.film.dy
    sine = float(torch.where(rays.passed, across.abs(), 0.0).max())
    return 1 / (2 * sine) if sine > 0 else math.nan


def _span(best: Array, f_number: float, wavelength_nm: float) -> Array:
    """Shifts about the film that include the best foci of the fields, and at least a few depths of focus."""
    depth = 4e-6 * wavelength_nm * f_number**2 if math.isfinite(f_number) else 0.0  # Rayleigh's, +- 2 lambda N^2
    reach = max(2 * depth, 1.5 * float(np.median(np.abs(np.nan_to_num(best)))))
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
    scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None, *, n: int = 65
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
        spread: by direction, [F, k] for the first k frequencies, by how much two samplings of the pupil differ
            (`pupil_nodes.converged`).
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
    spread: dict[str, Array]


_SHOWN_PER_MM = 50.0  # of the frequencies that are taken where none are given, those up to here must be converged


def mtf(
    scene: Scene,
    field_deg: Sequence[float] | None = None,
    wavelength_nm: Sequence[float] | None = None,
    *,
    frequency_per_mm: Sequence[float] | None = None,
    shift_mm: float = 0.0,
) -> Mtf:
    """Modulus of the energy-weighted mean of exp(2 pi i f x) over the rays of all wavelengths; NaN without light.

    The frequencies are 0 to 100 per mm where none are given.
    """
    filled = Filled(scene, field_deg, wavelength_nm)
    f = np.linspace(0, 100, 101) if frequency_per_mm is None else np.asarray(frequency_per_mm, dtype=np.float64)
    shown = f <= (_SHOWN_PER_MM if frequency_per_mm is None else math.inf)

    def contrast(level: int, fields: list[int]) -> list[Array]:
        rays = filled.only(fields).bundle(level)
        weight = (rays.weight / rays.weight.sum((1, 2), keepdim=True)).flatten(1)
        return [_contrast(torch.nan_to_num(x).flatten(1), weight, f) for x in rays.at_shift(shift_mm)]

    names = ("tangential", "sagittal")
    both, spread = converged(
        contrast, lambda c: {k: (v[:, shown], 1.0) for k, v in zip(names, c, strict=True)}, len(filled.fields)
    )
    n = working_f_number(scene, filled.waves[0])
    return Mtf(
        np.array(filled.fields), filled.height_mm, np.array(filled.waves), f, both[0], both[1],
        diffraction_mtf(f, filled.waves[0], n), n, shift_mm, spread,
    )  # fmt: skip


HEIGHT_PER_MM = (10.0, 20.0, 40.0)  # the frequencies that lens makers print


def mtf_over_height(
    scene: Scene,
    wavelength_nm: Sequence[float] | None = None,
    *,
    frequency_per_mm: Sequence[float] = HEIGHT_PER_MM,
    fields: int = 21,
) -> Mtf:
    """MTF of some frequencies at fields from the axis to the edge: the chart of lens makers."""
    angles = np.linspace(0, scene.edge.field_deg, fields).tolist()
    return mtf(scene, angles, wavelength_nm, frequency_per_mm=sorted(set(frequency_per_mm)))


def diffraction_mtf(frequency_per_mm: Array, wavelength_nm: float, f_number: float) -> Array:
    """MTF of a perfect lens with a round pupil: 2/pi (acos s - s sqrt(1 - s^2)), s = f lambda N (Goodman, 6.3)."""
    s = np.clip(frequency_per_mm * wavelength_nm * 1e-6 * f_number, 0.0, 1.0)
    found: Array = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    return found


def _contrast(x_mm: Tensor, weight: Tensor, frequency: Array) -> Array:
    found, before, step, turn = [], 0.0, math.nan, weight
    now = weight.to(torch.complex128)
    for f in frequency.tolist():
        if not abs(f - before - step) < 1e-9:  # evenly spaced frequencies share the turn of the phases between them
            step = f - before
            turn = torch.polar(torch.ones_like(x_mm), x_mm * (2 * np.pi * step))
        now, before = now * turn, f
        found.append(now.sum(1).abs())
    result: Array = torch.stack(found, 1).numpy()
    return result
