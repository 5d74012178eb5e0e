"""Spots over field and focus, ray fans and geometric MTF."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from neurolens.base.report import BULK, over
from neurolens.optics.analysis.bundles import Bundle, Filled, bundle, fan, hexapolar
from neurolens.optics.analysis.fields import Array, OverField, Scene
from neurolens.optics.lens.paraxial import is_pinhole
from neurolens.optics.setting.pupil_nodes import converged

_RINGS = 16
_SHIFTS = 21


@dataclass(frozen=True)
class Spots(OverField):
    """Spots of F fields, W wavelengths and P rays. Shifts of the film are positive away from the lens.

    Attributes:
        tangential_um, sagittal_um: [F, W, P] from the chief ray of the first wavelength, NaN where blocked; rings over
            the stop, to draw. The figures below are converged over what stop and rims leave open (`pupil_nodes`).
        slope_tangential, slope_sagittal: [F, W, P], for spots at another focus.
        rms_um: [F] root mean square distance from the centroid, over all wavelengths, weighted by energy.
        geometric_um: [F] the largest distance from the centroid; NaN, like all sizes, where no ray passes.
        rms_by_wavelength_um: [F, W], each from its own centroid.
        passed: [F] share of the stop's light that no rim takes.
        airy_um: radius of the first dark ring on the axis, 1.22 lambda N with the working f-number.
        shift_mm, through_focus_um: [K] shifts of the film, and [F, K] the RMS radius there.
        best_shift_mm, best_rms_um: [F] where each field's RMS radius is least; NaN where rays stay parallel.
        spread: for each figure by name, [F, ...], how much two samplings of the pupil differ (`pupil_nodes.converged`).
    """

    wavelength_nm: Array
    tangential_um: Array = field(metadata=BULK)
    sagittal_um: Array = field(metadata=BULK)
    slope_tangential: Array = field(metadata=BULK)
    slope_sagittal: Array = field(metadata=BULK)
    rms_um: Array = field(metadata=over("field_deg"))
    geometric_um: Array = field(metadata=over("field_deg"))
    rms_by_wavelength_um: Array = field(metadata=over("field_deg", "wavelength_nm"))
    passed: Array = field(metadata=over("field_deg"))
    working_f_number: float
    airy_um: float
    shift_mm: Array
    through_focus_um: Array = field(metadata=over("field_deg", "shift_mm"))
    best_shift_mm: Array = field(metadata=over("field_deg"))
    best_rms_um: Array = field(metadata=over("field_deg"))
    spread: dict[str, Array] = field(metadata=over())


def spots(
    scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None, *,
    rings: int = _RINGS, shift_mm: Sequence[float] | None = None,
) -> Spots:  # fmt: skip
    """Compute spots. Without fields they are `Scene.default_fields`, without shifts these span the best foci."""
    rays = bundle(scene, field_deg, wavelength_nm, hexapolar(rings))
    waves = rays.wavelength_nm
    n, dark_um = airy(scene, waves[0])
    filled, stop = (Filled(scene, rays.field_deg, waves, to_stop=to_stop) for to_stop in (False, True))

    def figures(level: int, fields: list[int]) -> list[Array]:
        return _figures(filled.only(fields).bundle(level), stop.only(fields).energy(level))

    found, spread = converged(figures, lambda f: _scaled(f, np.nan_to_num(dark_um)), len(rays.field_deg))
    rms, geometric, by_wavelength, passed, best, best_rms, *moments = found
    shifts = np.asarray(_span(best, n, waves[0]) if shift_mm is None else shift_mm, dtype=np.float64)
    slope_t, slope_s = rays.slopes
    return Spots(
        np.array(rays.field_deg), rays.chief_height_mm.numpy(), np.array(waves),
        1000 * rays.tangential_mm.numpy(), 1000 * rays.sagittal_mm.numpy(), slope_t.numpy(), slope_s.numpy(),
        rms, geometric, by_wavelength, passed, n, dark_um,
        shifts, _rms_um(moments, shifts), best, best_rms, spread,
    )  # fmt: skip


def _figures(rays: Bundle, open_energy: Tensor) -> list[Array]:
    """Return the figures of `Spots` that depend on the sampling of the pupil, and the second moments, each [F, ...].

    They stand in the order of `_scaled`; `open_energy` [F] is the light that enters the stop.
    """
    centroid, moments = _moments(rays, (1, 2))
    spread, mixed, steep = moments
    away = torch.hypot(*(p - c for p, c in zip((rays.tangential_mm, rays.sagittal_mm), centroid, strict=True)))
    largest = torch.where(rays.passed, away, -math.inf).amax((1, 2))
    # Rays that are parallel up to rounding have no best focus.
    best = torch.where(steep > 1e-20, -mixed / steep, math.nan).numpy()
    here, whole = np.zeros(1), [m.numpy() for m in moments]
    return [
        _rms_um(whole, here)[:, 0],
        1000 * largest.where(largest >= 0, math.nan).numpy(),
        _rms_um([m.numpy() for m in _moments(rays, (2,))[1]], here)[..., 0],
        (rays.weight.sum((1, 2)) / open_energy).numpy(), best, _rms_um(whole, best[:, None])[:, 0], *whole,
    ]  # fmt: skip


def _scaled(figures: list[Array], airy_um: float) -> dict[str, tuple[Array, Array | float]]:
    """Give the shown figures of `_figures`, each with the scale its error is judged by.

    The largest radius depends on one ray, so its scale is coarser.
    """
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


def _moments(rays: Bundle, along: tuple[int, ...]) -> tuple[list[Tensor], list[Tensor]]:
    """Return the centroid, and the energy-weighted second moments of points, of points with slopes, and of slopes.

    From these follows the RMS radius at every focus, whose square is a parabola.
    """
    weight = rays.weight / rays.weight.sum(along, keepdim=True)
    centroid, sums = [], [torch.zeros(1, dtype=torch.float64)] * 3
    for place, slope in zip((rays.tangential_mm, rays.sagittal_mm), rays.slopes, strict=True):
        a, b = torch.nan_to_num(place), torch.nan_to_num(slope)
        centroid.append((weight * a).sum(along, keepdim=True))
        a, b = a - centroid[-1], b - (weight * b).sum(along, keepdim=True)
        products = (weight * a**2, weight * a * b, weight * b**2)
        sums = [total + product.sum(along) for total, product in zip(sums, products, strict=True)]
    return centroid, sums


def _rms_um(moments: Sequence[Array], shift_mm: Array) -> Array:
    """Return the RMS radius in um from three second moments, at shifts [K] (or one a field, [F, 1]), shifts last."""
    a, b, c = (m[..., None] for m in moments)
    return np.asarray(1000 * np.sqrt(np.maximum(a + 2 * b * shift_mm + c * shift_mm**2, 0.0)))


def working_f_number(scene: Scene, wavelength_nm: float) -> float:
    """Return 1 / (2 sin theta') of the axis's outermost real ray that passes stop and rims; NaN if none does.

    For a hole without a lens it is the distance from the film over the diameter.
    """
    if is_pinhole(scene.lens):
        return float(scene.first_order.f_number)
    rays = Filled(scene.round, [0.0], [wavelength_nm]).bundle(0)
    across, _ = scene.image_axes(rays.film.dx, rays.film.dy)
    sine = float(torch.where(rays.passed, across.abs(), 0.0).max())
    return 1 / (2 * sine) if sine > 0 else math.nan


def airy(scene: Scene, wavelength_nm: float) -> tuple[float, float]:
    """Return the working f-number, and the radius in um of the first dark ring about a point on the axis."""
    n = working_f_number(scene, wavelength_nm)
    return n, 1.22e-3 * wavelength_nm * n


def _span(best: Array, f_number: float, wavelength_nm: float) -> Array:
    """Return shifts about the film that include the best foci of the fields, and at least a few depths of focus."""
    depth = 4e-6 * wavelength_nm * f_number**2 if math.isfinite(f_number) else 0.0  # Rayleigh's, +- 2 lambda N^2
    reach = max(2 * depth, 1.5 * float(np.median(np.abs(np.nan_to_num(best))))) or 0.1
    return np.linspace(-reach, reach, _SHIFTS)


@dataclass(frozen=True)
class Fans(OverField):
    """Fans of F fields, W wavelengths and n pupil points.

    Attributes:
        pupil: [n] share of the stop's radius, -1 to 1.
        tangential_um: [F, W, n] aberration of rays in the meridional plane, measured in that plane.
        sagittal_um: [F, W, n] aberration of rays in the plane across it, measured across the meridional plane. Both
            count from the chief ray of the first wavelength; NaN where a rim blocks.
    """

    wavelength_nm: Array
    pupil: Array
    tangential_um: Array = field(metadata=over("field_deg", "wavelength_nm", "pupil"))
    sagittal_um: Array = field(metadata=over("field_deg", "wavelength_nm", "pupil"))


def fans(
    scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None, *, n: int = 65
) -> Fans:
    """Compute ray fans of fields (`Scene.default_fields` if not given), with n points along each line of the stop."""
    pattern = fan(n)
    rays = bundle(scene, field_deg, wavelength_nm, pattern)
    return Fans(
        np.array(rays.field_deg), rays.chief_height_mm.numpy(), np.array(rays.wavelength_nm),
        pattern.tangential[:n].numpy(),
        1000 * rays.tangential_mm[..., :n].numpy(), 1000 * rays.sagittal_mm[..., n:].numpy(),
    )  # fmt: skip


@dataclass(frozen=True)
class Mtf(OverField):
    """MTF of F fields at K frequencies.

    Attributes:
        frequency_per_mm: [K] cycles per mm on the film.
        tangential: [F, K], contrast of lines across the meridional plane (blur along it counts).
        sagittal: [F, K], contrast of lines along it.
        diffraction_limit: [K] that of a perfect lens with the working f-number on the axis, at the first wavelength.
        shift_mm: how far the film is shifted, positive away from the lens.
        spread: by direction, [F, k] for the first k frequencies, how much two samplings of the pupil differ
            (`pupil_nodes.converged`).
    """

    wavelength_nm: Array
    frequency_per_mm: Array
    tangential: Array = field(metadata=over("field_deg", "frequency_per_mm"))
    sagittal: Array = field(metadata=over("field_deg", "frequency_per_mm"))
    diffraction_limit: Array = field(metadata=over("frequency_per_mm"))
    working_f_number: float
    shift_mm: float
    spread: dict[str, Array] = field(metadata=over())


_SHOWN_PER_MM = 50.0  # where no frequencies are given, those up to here must be converged


def mtf(
    scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None, *,
    frequency_per_mm: Sequence[float] | None = None, shift_mm: float = 0.0,
) -> Mtf:  # fmt: skip
    """Compute the modulus of the energy-weighted mean of exp(2 pi i f x) over the rays of all wavelengths.

    It is NaN without light. Without frequencies they are 0 to 100 per mm.
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
    scene: Scene, wavelength_nm: Sequence[float] | None = None, *,
    frequency_per_mm: Sequence[float] = HEIGHT_PER_MM, fields: int = 21,
) -> Mtf:  # fmt: skip
    """Compute the MTF of some frequencies at fields from the axis to the edge: the chart of lens makers."""
    angles = np.linspace(0, scene.edge.field_deg, fields).tolist()
    return mtf(scene, angles, wavelength_nm, frequency_per_mm=sorted(set(frequency_per_mm)))


def diffraction_mtf(frequency_per_mm: Array, wavelength_nm: float, f_number: float) -> Array:
    """The MTF of a perfect lens with a round pupil: 2/pi (acos s - s sqrt(1 - s^2)), s = f lambda N (Goodman, 6.3)."""
    s = np.clip(frequency_per_mm * wavelength_nm * 1e-6 * f_number, 0.0, 1.0)
    return np.asarray(2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s)))


def _contrast(x_mm: Tensor, weight: Tensor, frequency: Array) -> Array:
    rows = [torch.polar(weight, 2 * np.pi * f * x_mm).sum(1).abs() for f in frequency.tolist()]
    return np.asarray(torch.stack(rows, 1).numpy())
