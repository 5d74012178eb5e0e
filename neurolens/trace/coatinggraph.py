"""What coatings and glass take from light, as parts of a graph; with tensors, `coatings` and `glass` tell the same."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from neurolens.graph.ir import Value
from neurolens.lens.glass import absorption_of, glass_of, index_at, index_of
from neurolens.lens.prescription import Lens
from neurolens.trace.coatings import times_film
from neurolens.trace.surfaces import Medium, Met
from neurolens.trace.transmission import Shares

_DEGREE, _FIT = 8, 1e-9  # of the series of sine and cosine, and how close they are
_HALVINGS = 12  # of a phase, at most: films of 500 waves


class GraphLosses:
    """What glass and coatings do to light in a graph, as `transmission.Losses` does it with tensors.

    Args:
        wavelength_nm: of the rays. range_nm: wavelengths from and to which it may lie.
    """

    def __init__(self, lens: Lens, wavelength_nm: Value, range_nm: tuple[float, float]) -> None:
        self.lens, self.wavelength_nm, self.range_nm = lens, wavelength_nm, range_nm

    def absorption(self, k: int) -> Value | None:
        """Napierian absorption (1/mm) of the medium before surface k, in the range; None where there is none."""
        (low, high), surface = self.range_nm, self.lens.surfaces[k - 1]
        end = absorption_of(surface, high) if k else None
        if end is None:
            return None
        total = self.wavelength_nm.graph.constant(float(end))
        bends = glass_of(surface.glass).bends() if surface.glass else []
        slope = sum(bend for nm, bend in bends if nm >= high)
        for nm, bend in [(high, slope), *((nm, bend) for nm, bend in bends if low < nm < high)]:
            if bend:
                total = total + (nm - self.wavelength_nm).maximum(0.0) * bend
        return total

    def transmitted(self, depth: Value) -> Value:
        """exp(-depth)."""
        return transmitted(depth)

    def coated(self, k: int, met: Met, q: Value, media: tuple[Medium, Medium], sense: int, reflected: bool) -> Shares:
        """What the coating of surface k transmits of light on its way to the scene; see `coatings`."""
        (one, two), coating, g = media, self.lens.surfaces[k].coating, self.wavelength_nm.graph
        assert sense < 0 and not reflected and coating is not None
        sides = self.lens.media[k : k + 2]
        # The largest index times sine of light that passes.
        sine = min(max(float(index_of(m, nm)) for nm in self.range_nm) for m in sides)
        before, after, n1, n2 = met.q, q, g.value(one.n), g.value(two.n)
        inverse_um = 1000.0 / self.wavelength_nm
        s: tuple[Value | float, ...] = (1.0, 0.0, 0.0, 1.0)
        p = s
        for n_d, thickness_nm, *V_d in reversed(coating.layers):
            at_1000, at_500 = (float(index_at(n_d, V_d[0] if V_d else None, nm)) for nm in (1000.0, 500.0))
            rise = (at_500 - at_1000) / 3  # of Cauchy's index by 1 / lambda^2 in um
            index = g.series(inverse_um * inverse_um, [at_1000 - rise, rise])
            phase_per_q = inverse_um * (2e-3 * math.pi * float(thickness_nm))
            q2 = before * before + (index - n1) * (index + n1)
            numbers = [float(index_at(n_d, V_d[0] if V_d else None, nm)) for nm in self.range_nm]
            most = [2 * math.pi * float(thickness_nm) / nm for nm in self.range_nm]
            ends = [(n * n - part) * k * k for n, k in zip(numbers, most, strict=True) for part in (0.0, sine * sine)]
            cos, sinc = _cos_and_sinc(q2 * (phase_per_q * phase_per_q), min(0.0, *ends), max(0.0, *ends))
            s, p = times_film(s, p, (cos, sinc * phase_per_q, q2 * sinc * phase_per_q), index * index)
        cos_i, cos_t = before / n1, after / n2
        real_s, other_s = before * s[0] + after * s[3], before * after * s[1] + s[2]
        real_p, other_p = n2 * cos_i * p[0] + n1 * cos_t * p[3], cos_i * cos_t * p[1] + n1 * n2 * p[2]
        size_s, size_p = real_s * real_s + other_s * other_s, real_p * real_p + other_p * other_p
        real, imaginary = real_s * real_p + other_s * other_p, other_s * real_p - real_s * other_p
        both = size_s * size_p
        return Shares(size_p + size_s, size_p - size_s, real * 2.0, imaginary * 2.0, before * after * 2.0, both)


def transmitted(depth: Value) -> Value:
    """exp(-depth) as (1 - t) / (1 + t) with t = tanh(depth / 2), which every writer has."""
    t = (depth * 0.5).tanh()
    return (1.0 - t) / (1.0 + t)


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
