"""What coatings and glass take from light, as parts of a graph; with tensors, `coatings` and `glass` tell the same."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from neurolens.graph.ir import Value
from neurolens.optics.coatings import Layers, times_film
from neurolens.optics.glass import absorption_of, glass_of, index_at
from neurolens.optics.prescription import Surface
from neurolens.optics.transmission import Shares

_DEGREE, _FIT = 8, 1e-9  # of the series of sine and cosine, and how close they are
_HALVINGS = 12  # of a phase, at most: films of 500 waves


class Wave(NamedTuple):
    """The wavelength of rays, nm, and the range that it lies in."""

    nanometres: Value
    range_nm: tuple[float, float]


def transmitted(depth: Value) -> Value:
    """exp(-depth) as (1 - t) / (1 + t) with t = tanh(depth / 2), which every writer has."""
    t = (depth * 0.5).tanh()
    return (1.0 - t) / (1.0 + t)


def absorption(surface: Surface, wave: Wave) -> Value | None:
    """As `glass.absorption_of`, to rounding within the wavelengths' range; None where there is none."""
    low, high = wave.range_nm
    end = absorption_of(surface, high)
    if end is None:
        return None
    total = wave.nanometres.graph.constant(float(end))
    bends = glass_of(surface.glass).bends() if surface.glass else []
    slope = sum(bend for nm, bend in bends if nm >= high)
    for nm, bend in [(high, slope), *((nm, bend) for nm, bend in bends if low < nm < high)]:
        if bend:
            total = total + (nm - wave.nanometres).maximum(0.0) * bend
    return total


def coated_shares(
    layers: Layers, cosines: tuple[Value, Value], media: tuple[Value, Value], sine: float, wave: Wave
) -> Shares:
    """What a coated surface transmits of light on its way to the scene; see `coatings`.

    Args:
        cosines: of incidence and of refraction. media: indices as the light meets them.
        sine: the largest index times sine of light that passes.
    """
    (cos_i, cos_t), (n1, n2) = cosines, media
    before, after = n1 * cos_i, n2 * cos_t
    inverse_um = 1000.0 / wave.nanometres
    s: tuple[Value | float, ...] = (1.0, 0.0, 0.0, 1.0)
    p = s
    for n_d, thickness_nm, *V_d in reversed(layers):
        at_1000, at_500 = (float(index_at(n_d, V_d[0] if V_d else None, nm)) for nm in (1000.0, 500.0))
        rise = (at_500 - at_1000) / 3  # of Cauchy's index by 1 / lambda^2 in um
        index = wave.nanometres.graph.series(inverse_um * inverse_um, [at_1000 - rise, rise])
        phase_per_q = inverse_um * (2e-3 * math.pi * float(thickness_nm))
        q2 = before * before + (index - n1) * (index + n1)
        numbers = [float(index_at(n_d, V_d[0] if V_d else None, nm)) for nm in wave.range_nm]
        most = [2 * math.pi * float(thickness_nm) / nm for nm in wave.range_nm]
        ends = [(n * n - part) * k * k for n, k in zip(numbers, most, strict=True) for part in (0.0, sine * sine)]
        cos, sinc = _cos_and_sinc(q2 * (phase_per_q * phase_per_q), min(0.0, *ends), max(0.0, *ends))
        s, p = times_film(s, p, (cos, sinc * phase_per_q, q2 * sinc * phase_per_q), index * index)
    real_s, other_s = before * s[0] + after * s[3], before * after * s[1] + s[2]
    real_p, other_p = n2 * cos_i * p[0] + n1 * cos_t * p[3], cos_i * cos_t * p[1] + n1 * n2 * p[2]
    size_s, size_p = real_s * real_s + other_s * other_s, real_p * real_p + other_p * other_p
    real, imaginary = real_s * real_p + other_s * other_p, other_s * real_p - real_s * other_p
    both = size_s * size_p
    return Shares(size_p + size_s, size_p - size_s, real * 2.0, imaginary * 2.0, before * after * 2.0, both)


def _cos_and_sinc(phase2: Value, low: float, high: float) -> tuple[Value, Value]:
    """cos and sin x / x of the root of a square from `low` to `high`: those of an evanescent wave where it is below 0.

    They are entire functions of the square: series at a part of the phase, which is then doubled.
    """
    cos_series, sinc_series, halvings = _series(low, high)
    g, part = phase2.graph, phase2 * 0.25**halvings
    cos, sinc = g.series(part, cos_series), g.series(part, sinc_series)
    for _ in range(halvings):
        cos, sinc = cos * cos * 2.0 + -1.0, sinc * cos
    return cos, sinc


@cache
def _series(low: float, high: float) -> tuple[tuple[float, ...], tuple[float, ...], int]:
    """Coefficients of the series of cos and sin x / x by x^2, and how often the phase is halved before."""
    for halvings in range(_HALVINGS + 1):
        ends = low * 0.25**halvings, high * 0.25**halvings
        square = (ends[0] + ends[1]) / 2 + (ends[1] - ends[0]) / 2 * np.cos(np.linspace(0, math.pi, 100))
        x = np.emath.sqrt(square)
        wanted = np.cos(x).real, np.sinc(x / math.pi).real
        for degree in range(1, _DEGREE + 1):
            fits = [np.polynomial.Chebyshev.fit(square, w, degree, domain=ends) for w in wanted]
            error = max(np.abs(f(square) - w).max() / np.abs(w).max() for f, w in zip(fits, wanted, strict=True))
            if error < _FIT or (halvings == _HALVINGS and degree == _DEGREE):
                cos, sinc = (tuple(f.convert(kind=np.polynomial.Polynomial).coef.tolist()) for f in fits)
                return cos, sinc, halvings
    raise AssertionError("unreachable")
