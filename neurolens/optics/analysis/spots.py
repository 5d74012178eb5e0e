"""Spots over field and focus, ray fans, geometric MTF, and point spread by rays and by diffraction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from neurolens.base.report import BULK, Report, over
from neurolens.optics.analysis.bundles import Bundle, Filled, bundle, fan, hexapolar
from neurolens.optics.analysis.fields import Array, OverField, Scene
from neurolens.optics.lens.paraxial import is_pinhole
from neurolens.optics.setting.pupil_nodes import LEVELS, converged

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
    n, airy = _airy(scene, waves[0])
    filled, stop = (Filled(scene, rays.field_deg, waves, to_stop=to_stop) for to_stop in (False, True))

    def figures(level: int, fields: list[int]) -> list[Array]:
        return _figures(filled.only(fields).bundle(level), stop.only(fields).energy(level))

    found, spread = converged(figures, lambda f: _scaled(f, np.nan_to_num(airy)), len(rays.field_deg))
    rms, geometric, by_wavelength, passed, best, best_rms, *moments = found
    shifts = np.asarray(_span(best, n, waves[0]) if shift_mm is None else shift_mm, dtype=np.float64)
    slope_t, slope_s = rays.slopes
    return Spots(
        np.array(rays.field_deg), rays.chief_height_mm.numpy(), np.array(waves),
        1000 * rays.tangential_mm.numpy(), 1000 * rays.sagittal_mm.numpy(), slope_t.numpy(), slope_s.numpy(),
        rms, geometric, by_wavelength, passed, n, airy,
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


def _airy(scene: Scene, wavelength_nm: float) -> tuple[float, float]:
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


def path_to_chief_mm(rays: Bundle) -> Tensor:
    """Return the optical path [F, W, P] to the plane across the ray through the chief ray's film point.

    Raises:
        InputError: the lens has ideal surfaces, which have a law of rays and none of phases.
    """
    rays.scene.lens.require_glass("optical path")
    along_t, along_s = rays.cosines
    return rays.path_mm - rays.tangential_mm * along_t - rays.sagittal_mm * along_s


_BINS, _POINTS = 49, 97  # points a side of the geometric and the diffraction image; odd, so that one is in the centre
_FINEST = 128  # the most points across the pupil that are traced
_ENCIRCLED = 0.98  # share of the geometric spot's energy inside the window


@dataclass(frozen=True)
class Psf(Report):
    """Point spread of F fields; images are indexed [tangential, sagittal], centred on the spot's centroid.

    Attributes:
        half_width_um: [F], from the centre of the image to its edge; NaN without light.
        geometric: [F, 49, 49] share of all wavelengths' energy in each square, without what lies outside; NaN without
            light.
        diffraction: [F, 97, 97] at the first wavelength; 1 is the peak of the same pupil without aberrations. NaN where
            the aberrations are too large for it (diffraction is then negligible against `geometric`) or almost no light
            arrives.
        strehl: [F] the greatest value of `diffraction`.
        pupil_points: [F] how many points across the pupil the diffraction image needs; 0 without light.
        airy_um: radius of the first dark ring on the axis.
        spread: for each figure by name, [F, ...], how much two samplings of the pupil differ (`pupil_nodes.converged`).
    """

    field_deg: Array
    wavelength_nm: Array
    half_width_um: Array = field(metadata=over("field_deg"))
    geometric: Array = field(metadata=BULK)
    diffraction: Array = field(metadata=BULK)
    strehl: Array = field(metadata=over("field_deg"))
    pupil_points: Array = field(metadata=over("field_deg"))
    airy_um: float
    spread: dict[str, Array] = field(metadata=over())


def psf(scene: Scene, field_deg: Sequence[float] | None = None, wavelength_nm: Sequence[float] | None = None) -> Psf:
    """Compute the point spread of fields, in a window that holds the spot and six Airy radii.

    Raises:
        InputError: the lens is a pinhole, whose rays do not meet: there is no focus about which waves could be summed.
    """
    scene.require_power()
    filled = Filled(scene, field_deg, wavelength_nm)
    _, airy = _airy(scene, filled.waves[0])
    least_mm = 6e-3 * float(np.nan_to_num(airy))

    def images(level: int, fields: list[int]) -> list[Array]:
        return _images(filled.only(fields).bundle(level, path=True), least_mm)

    def scaled(found: list[Array]) -> dict[str, tuple[Array, Array | float]]:
        return {"half_width_um": (found[0], 20 * found[0]), "strehl": (found[2].max((1, 2)), 1.0)}

    (half, centre, diffraction, needed), spread = converged(images, scaled, len(filled.fields), first=1)
    rays = filled.bundle(LEVELS - 1)  # a picture needs rays in every square, even where figures need fewer
    each = zip(rays.tangential_mm, rays.sagittal_mm, rays.weight, centre, half, strict=True)
    geometric = np.stack([_histogram(t - c[0], s - c[1], w, h / 1000) for t, s, w, c, h in each])
    return Psf(
        np.array(filled.fields), np.array(filled.waves), half, geometric, diffraction, diffraction.max((1, 2)), needed,
        airy, spread,
    )  # fmt: skip


def _images(rays: Bundle, least_mm: float) -> list[Array]:
    """Return half widths (um), centres (mm), diffraction images and the points across the pupil for these, [F, ...].

    The windows have at least the half width `least_mm`.
    """
    rows = []
    for k in range(len(rays.field_deg)):
        t, s, w = (v[k].flatten() for v in (rays.tangential_mm, rays.sagittal_mm, rays.weight))
        centre, radius = _spot(t, s, w)
        window = max(least_mm, 1.1 * radius)
        if not (window > 0 and w.sum() > 0):
            window = math.nan
        needed, image = _needed(rays, k, window), np.full((_POINTS, _POINTS), np.nan)
        if 0 < needed <= _FINEST:
            image = diffraction_image(rays, centre, window, field=k)
        rows.append((1000 * window, centre, image, float(needed)))
    return [np.array(column) for column in zip(*rows, strict=True)]


def _spot(t: Tensor, s: Tensor, w: Tensor) -> tuple[tuple[float, float], float]:
    """Return the centroid (mm), and the radius about it that holds most of the energy."""
    if not w.sum() > 0:
        return (0.0, 0.0), 0.0
    t, s = torch.nan_to_num(t), torch.nan_to_num(s)
    centre = (float((w * t).sum() / w.sum()), float((w * s).sum() / w.sum()))
    away, order = torch.hypot(t - centre[0], s - centre[1]).sort()
    within = w[order].cumsum(0) / w.sum()
    return centre, float(away[min(int((within < _ENCIRCLED).sum()), len(away) - 1)])


def _histogram(t: Tensor, s: Tensor, w: Tensor, half_mm: float) -> Array:
    if math.isnan(half_mm):
        return np.full((_BINS, _BINS), np.nan)
    keep = w > 0
    edges = np.linspace(-half_mm, half_mm, _BINS + 1)
    counts, _, _ = np.histogram2d(t[keep].numpy(), s[keep].numpy(), bins=(edges, edges), weights=w[keep].numpy())
    return np.asarray(counts / float(w.sum()))


def _needed(rays: Bundle, field: int, half_mm: float) -> int:
    """The points across the pupil with which the phase, anywhere in the window, turns by less than half a turn."""
    if math.isnan(half_mm) or not rays.passed[field].any():
        return 0
    span = max(float(np.nanmax(v[field]) - np.nanmin(v[field])) for v in rays.cosines)
    blur = float(torch.nan_to_num(torch.hypot(rays.tangential_mm[field], rays.sagittal_mm[field])).max())
    return max(32, math.ceil(span * 2 * (math.sqrt(2) * half_mm + blur) / (rays.wavelength_nm[0] * 1e-6)))


def diffraction_image(
    rays: Bundle, centre_mm: tuple[float, float], half_mm: float, points: int = _POINTS, field: int = 0
) -> Array:
    """Return the diffraction image [points, points] of a field of a bundle, at its first wavelength (see `Psf`).

    Its centre is given as tangential and sagittal distance from the chief ray's film point.
    """
    wave = 2 * math.pi / (rays.wavelength_nm[0] * 1e-6)
    keep = rays.passed[field, 0]
    t, s = (c[field, 0][keep] for c in rays.cosines)
    path, weight = path_to_chief_mm(rays)[field, 0][keep], rays.weight[field, 0][keep]
    # Paths are metres of waves: only their differences keep the digits of a phase.
    lead = path - path.mean() + t * centre_mm[0] + s * centre_mm[1]
    amplitude = torch.polar(weight / weight.sum(), wave * lead)
    line = torch.linspace(-half_mm, half_mm, points, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    along, across = (torch.polar(one, wave * line[:, None] * c) for c in (t, s))
    return np.asarray(((along * amplitude) @ across.T).abs().square().numpy())
