"""The exact lens as a graph, from which C is written: the best that tracing can do, for comparison with surrogates.

Its surfaces are those of the tracer (`surfaces`), and so is the power that arrives (`transmission`).
"""

import math
from functools import cache
from typing import Any

import numpy as np

from neurolens.base import status as st
from neurolens.graph.ir import Graph, Value
from neurolens.optics.lens.glass import (
    ANY_WAVELENGTH_NM,
    absorption_of,
    cauchy,
    glass_of,
    index_at,
    index_of,
    stated_nm,
)
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.arithmetic import Graphs, is_number, times
from neurolens.optics.trace.filmfit import FilmFit, Rows, fitted, inverse_um_at
from neurolens.optics.trace.shapes import traced_curve
from neurolens.optics.trace.surfaces import Hit, Medium, Rays, Test, cross, media, radius2
from neurolens.optics.trace.transmission import NO_FILM, Passage, Shares, times_film

TRANSMITTANCE = (
    "Transmittance: of unpolarised light, with the polarisation that surfaces give to it, coatings and absorption."
)
_DEGREE, _FIT = 8, 1e-11  # degrees that the series of sine and cosine may have, and how close they are
_WIDEST_MM = 1e15  # widest radius of a stop, whose square is still finite in float32
_HALVINGS = 12  # of a phase, at most: films of 500 waves


def exact_graph(
    lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], *, whole: bool = True, path: bool = False,
    polarised: bool = True, double: bool = False,
) -> Graph:  # fmt: skip
    """Write the graph of a lens with every surface; its inputs and outputs are those of a model's graph.

    Args:
        pupil_z_mm: plane of the pupil points. wavelength_nm: range of the light, for coatings and absorption; a single
            wavelength fixes the indices. Outside `light_limits` the status says so, and where the stop has no radius.
        whole: with stop, rims, domain and transmittance; else the ray alone, and whether it gets through.
        polarised: as in `Passage`. double: as in `Graphs`.
        path: whether there is a further output, `path` [2 K]: z and y of the crossing with each surface, that next to
            the film first.
    """
    g = Graph()
    o = Graphs(g, double=double)
    rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
    stop_radius = g.input("stop_radius_mm", per_call=True) if whole else None
    stop_square = None if stop_radius is None else stop_radius * stop_radius
    single = wavelength_nm[0] == wavelength_nm[1]
    mediums = media(lens, wavelength_nm[0] if single else rays[4])
    power = GraphPassage(o, lens, rays[4], wavelength_nm, polarised) if whole else None
    tests: list[tuple[Test, int]] = []  # in the order in which rays meet them, with their codes
    at_stop, crossings = rays[0:2], list[Value]()
    d = rays[2] - rays[0], rays[3] - rays[1], pupil_z_mm - film_z
    # Directions are multiplied by the medium's index, see `surfaces`.
    scale = times(1.0 / o.dot(d, d).sqrt(), mediums[-1].n)
    r = Rays(rays[0], rays[1], film_z, *(c * scale for c in d))

    def opening(met: Hit) -> list[Test]:
        """Return the test of the stop, whose radius is a number of the call; no test where only the ray is wanted."""
        return [] if stop_square is None else [(radius2(o, met), stop_square)]

    last = len(lens.surfaces) - 1
    moving = {i for state in lens.configurations for i, _ in state.thickness_mm}
    for k in range(last, -1, -1):
        surface, before, after = lens.surfaces[k], mediums[k + 1], mediums[k]
        # Gaps as they are in the lens: gaps that are equal stay equal in every state of a zoom.
        gap = float(surface.thickness_mm) if k < last else -float(lens.vertices_mm[k])
        # In a single state, a gap that moves may happen to equal another number: its label keeps the nodes apart.
        step = g.constant(gap, *([f"gap {k}"] if k in moving else []))
        # Behind a plane z is the number 0; added to it, the gap would lose its label.
        r = r._replace(z=step if r.z.node.kind == "constant" else r.z + step)
        rim = opening if surface.stop or not whole else None
        met, bent, found, own = cross(o, surface, traced_curve(surface, float), r, -1, before, after, rim=rim)
        tests += [(test, st.blocked(k, reason)) for some, reason in found for test in some]
        if surface.stop:
            at_stop = g.concat(own.x, own.y)
        if power is not None:
            power.pass_surface(k, r, met, bent.q, (before, after), -1)
        r = bent.rays
        crossings += [r.z + float(lens.vertices_mm[k]), r.y]
    n = mediums[0].n
    directions = r[3:] if is_number(n) and n == 1 else [d * (1 / n) for d in r[3:]]
    g.outputs["scene_ray"] = g.concat(*(g.value(v) for v in (*r[:3], *directions)))
    if power is not None:
        through = g.value(power.arrived(r.x))
        if through.node.kind == "constant":  # no surface takes light, but the power is still a number for each ray
            through = g.select(rays[0] <= rays[0], through, 0.0)
        g.outputs |= {"transmittance": through, "stop_xy_mm": at_stop}
    pairs, codes = zip(*tests, strict=True) if tests else ((), ())
    status = g.first_failure([(g.value(a), g.value(b)) for a, b in pairs], codes)
    if stop_radius is not None:
        low, high = light_limits(lens, wavelength_nm)
        # The stop decides once for all rays of a call: where it has no radius, no wavelength passes, for none is at
        # most -1.
        high_or_none = g.select(stop_radius.between(0.0, _WIDEST_MM), high, -1.0)
        inside = (g.constant(low) <= rays[4]) & (rays[4] <= high_or_none)
        status = g.select(inside, status, float(st.OUTSIDE_DOMAIN))
    g.outputs["status"] = status.whole()
    if path:
        g.outputs["path"] = g.concat(*crossings)
    return g


def light_limits(lens: Lens, wavelength_nm: tuple[float, float]) -> tuple[float, float]:
    """Return the wavelengths that a lens takes as a graph for a range: those of it for which some glass is stated.

    A lens without dispersion takes any wavelength.
    """
    if not lens.dispersive:
        return ANY_WAVELENGTH_NM
    low, high = stated_nm(lens)
    return max(low, wavelength_nm[0]) / st.DOMAIN_SLACK, min(high, wavelength_nm[1]) * st.DOMAIN_SLACK


class GraphPassage(Passage):
    """The power of rays in a graph.

    Args:
        wavelength_nm: the wavelength of the rays. range_nm: wavelengths from and to which it may lie.
    """

    def __init__(
        self, o: Graphs, lens: Lens, wavelength_nm: Value, range_nm: tuple[float, float], polarised: bool = True
    ) -> None:
        super().__init__(o, lens, wavelength_nm, polarised)
        self.range_nm = range_nm

    def absorption(self, k: int) -> Value | None:
        """Return the Napierian absorption (1/mm) of the medium before surface k, in the range; None without any."""
        (low, high), surface = self.range_nm, self.lens.surfaces[k - 1]
        end = absorption_of(surface, high) if k else None
        if end is None:
            return None
        total = self.wavelength_nm.graph.constant(float(end))
        name = surface.glass or surface.absorbs_as
        bends = glass_of(name).bends() if name else []
        slope = sum(bend for nm, bend in bends if nm >= high)
        for nm, bend in [(high, slope), *((nm, bend) for nm, bend in bends if low < nm < high)]:
            if bend:
                total = total + (nm - self.wavelength_nm).maximum(0.0) * bend
        return total

    def transmitted(self, depth: Value) -> Value:
        """Return exp(-depth)."""
        return transmitted(depth)

    def coated(self, k: int, met: Hit, q: Value, media: tuple[Medium, Medium], sense: int, reflected: bool) -> Shares:
        """Return the shares that the coating of surface k transmits of light towards the scene; see `transmission`."""
        (one, two), coating, g = media, self.lens.surfaces[k].coating, self.wavelength_nm.graph
        assert sense < 0 and not reflected and coating is not None
        sides = self.lens.media[k : k + 2]
        # The largest index times sine of light that passes.
        sine = min(max(float(index_of(m, nm)) for nm in self.range_nm) for m in sides)
        before, after, n1, n2 = met.q, q, g.value(one.n), g.value(two.n)
        inverse_um = 1000.0 / self.wavelength_nm
        if not self._o.polish:
            low, high = self.range_nm
            around = 1000.0 / high, 1000.0 / low
            indices = [tuple(float(index_of(m, 1000.0 / u)) for u in inverse_um_at(around)) for m in reversed(sides)]
            fit = fitted(tuple(reversed(coating.layers)), *indices, around)
            if fit is not None:
                medium, cosine = (two, after) if is_number(two.n) else (one, before)
                square = (medium.n2 - cosine * cosine) * (2 / fit.most) - 1.0
                return self._by_fit(fit, square, inverse_um, around, before * after * 2.0)
        s = p = NO_FILM
        for n_d, thickness_nm, *V_d in reversed(coating.layers):
            index = g.series(inverse_um * inverse_um, [float(v) for v in cauchy(n_d, V_d[0])] if V_d else [float(n_d)])
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

    def _by_fit(self, fit: FilmFit, square: Value, inverse_um: Value, ends: tuple[float, float], flux: Value) -> Shares:
        """Return the shares by polynomials; the phase between s and p, which films keep small, is left out."""
        x = square.clip(-1.0, 1.0)
        y = ((inverse_um - sum(ends) / 2) * (2 / max(ends[1] - ends[0], 1e-9))).clip(-1.0, 1.0)

        def value(rows: Rows) -> Value:
            total: Any = None
            for row in reversed(rows):
                term = x.graph.series(y, row)
                total = term if total is None else self._o.fma(total, x, term)
            return total

        total, split = value(fit.both) + flux * 2.0, value(fit.split)
        return Shares(total, split, total, None, flux * 4.0, total * total - split * split)


def transmitted(depth: Value) -> Value:
    """Return exp(-depth) as (1 - t) / (1 + t) with t = tanh(depth / 2), which every writer has."""
    t = (depth * 0.5).tanh()
    return (1.0 - t) / (1.0 + t)


def _cos_and_sinc(phase2: Value, low: float, high: float) -> tuple[Value, Value]:
    """Return cos x and sin x / x for a square x^2 from `low` to `high`, which is below 0 for evanescent waves.

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
    """Return the coefficients of the series of cos and sin x / x by x^2, and how often the phase is halved before."""
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
