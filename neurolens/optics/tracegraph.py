"""The exact lens as a graph, from which C is written: the best that tracing can do, with which surrogates are compared.

Surfaces of every shape, stop, rims, missed surfaces, total reflection, dispersion; transmittance of bare and coated
surfaces with the polarisation that each gives to the light (`transmission`), and what glass absorbs. Ray tracing after
Feder, J. Opt. Soc. Am. 41 (1951); conics, cylinders and aspheres as in `shapes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from neurolens.base import status as st
from neurolens.graph.ir import Graph, Value
from neurolens.optics.filmgraph import Wave, absorption, coated_shares, transmitted
from neurolens.optics.glass import index_of
from neurolens.optics.prescription import Lens, Medium, Surface
from neurolens.optics.sag import biconic, toroid
from neurolens.optics.shapes import LAST_STEP, STEEPEST, is_plain, start_of
from neurolens.optics.transmission import Light, crossed, crossed_spheres, fresnel, pass_surface, turned

TRANSMITTANCE = (
    "Transmittance: of unpolarised light, with the polarisation that surfaces give to it, coatings and absorption."
)
# The index is a polynomial in 1 / lambda^2 that holds it to float32's last bit.
_INDEX = 3e-8
_TINY = 1e-30  # least value under a root
Number = float | Value
Test = tuple[Value, Value]  # passed where the first is at most the second


def exact_graph(
    lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], *, whole: bool = True, path: bool = False
) -> Graph:
    """Film and pupil points in, scene ray and status out: inputs and outputs are those of a model's graph.

    Args:
        pupil_z_mm: plane of the pupil points. wavelength_nm: range in which the indices hold to float32's last bit.
        whole: with stop, rims and transmittance; else the ray alone, and whether it gets through.
        path: an output more, `path` [2 K]: z and y of the crossing with each surface, that next to the film first.
    """
    tracing = _Tracing(lens, pupil_z_mm, wavelength_nm, whole)
    if path:
        tracing.graph.outputs["path"] = tracing.graph.concat(*tracing.crossings)
    return tracing.graph


class _Tracing:
    def __init__(self, lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], whole: bool) -> None:
        self.lens, self.wavelength_nm, self.whole = lens, wavelength_nm, whole
        self.graph = g = Graph()
        rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
        self.wave, self.inverse_square = Wave(rays[4], wavelength_nm), g.square(1000.0 / rays[4])
        self.stop_square = g.square(g.input("stop_radius_mm", per_call=True)) if whole else g.constant(0.0)
        self.indices: dict[object, Value] = {}
        self.tests: list[tuple[Test, int]] = []  # in the order in which rays meet them, with their codes
        self.at_stop = rays[0:2]
        self.light: Light | None = None
        self.last: tuple[int, Value, Value] | None = None  # surface that acted on the light, its normal, cosine behind
        self.depth: Value | None = None  # sum of path length times absorption
        self.crossings: list[Value] = []
        way = g.concat(rays[2:4] - rays[0:2], pupil_z_mm - film_z)
        self.d = way * (1.0 / g.square(way).sqrt())
        self.x = g.concat(rays[0:2], film_z)
        self._through()

    def _through(self) -> None:
        g, lens = self.graph, self.lens
        last = len(lens.surfaces) - 1
        moving = {i for state in lens.configurations for i, _ in state.thickness_mm}
        for k in range(last, -1, -1):
            # Gaps as the lens has them: those that are equal stay so in every state of a zoom.
            gap = float(lens.surfaces[k].thickness_mm) if k < last else -float(lens.vertices_mm[k])
            # A gap that moves may happen to equal another number in one state alone: its label keeps the nodes apart.
            label = [f"gap {k}"] if k in moving else []
            self.x = g.concat(self.x[0:2], self.x[2] + g.constant(gap, *label))
            self._surface(k, lens.surfaces[k])
            self.crossings += [self.x[2] + float(lens.vertices_mm[k]), self.x[1]]
        g.outputs["scene_ray"] = g.concat(self.x, self.d)
        if self.whole:
            power = g.constant(1.0) if self.light is None else self.light.power
            arrived = power if self.depth is None else power * transmitted(self.depth)
            g.outputs |= {"transmittance": arrived, "stop_xy_mm": self.at_stop}
        tests, codes = zip(*self.tests, strict=True) if self.tests else ((), ())
        g.outputs["status"] = g.first_failure(tests, codes).whole()

    def _surface(self, k: int, s: Surface) -> None:
        g, d = self.graph, self.d
        nearest = d * -g.dot(self.x, d) + self.x  # of the ray's points, to the vertex
        met = meet_plain(nearest, d, float(s.curvature)) if is_plain(s) else meet_shape(nearest, d, figure_of(s))
        if self.whole:
            self._absorb(s, met.point)
        self.x = met.point
        self.tests += [(test, st.blocked(k, st.MISSED)) for test in met.tests]
        if s.stop:
            self.at_stop = self.x[0:2]
        if self.whole:
            limit = self.stop_square if s.stop else g.constant(s.semi_diameter_mm**2)
            self.tests.append(((g.square(self.x[0:2]), limit), st.blocked(k, st.RIM)))
        before, after = self._index(k + 1), self._index(k)
        if s.focal_mm is not None:  # slopes change by -x / f and -y / f, as light travels
            d = g.concat(self.x[0:2] * d[2] * (1 / s.focal_mm) + d[0:2], d[2])
            self.d = d * (1.0 / g.square(d).sqrt())
        layers = s.coating.layers if s.coating and self.whole else ()
        if before == after and not layers:
            return
        arriving, ratio, q = self.d, before / after, met.cosine
        cos2 = ratio * ratio * (q * q + -1.0) + 1.0
        self.tests.append((_above(cos2), st.blocked(k, st.TOTAL_REFLECTION)))
        cos = cos2.sqrt()
        bent = cos - ratio * q
        if met.normal is not None:
            self.d = met.normal * -bent + d * ratio
        else:  # of a sphere, the unit normal towards the film is (-c x, -c y, 1 - c z)
            turn = bent * float(s.curvature)
            self.d = g.concat(self.x[0:2] * turn + d[0:2] * ratio, d[2] * ratio + (self.x[2] * turn + -bent))
        if self.whole:
            self._transmit(k, met, arriving, cos, (before, after))

    def _transmit(self, k: int, met: _Meeting, d: Value, cos_t: Value, media: tuple[Value, Value]) -> None:
        """Carry the light through a surface, for rays of direction d that leave at this cosine."""
        g, s, (before, after) = self.graph, self.lens.surfaces[k], media
        c, cos_i, normal = float(s.curvature), met.cosine, met.normal
        if normal is None:
            normal = g.concat(self.x[0:2] * -c, self.x[2] * -c + 1.0) if c else g.constant([0.0, 0.0, 1.0])
        if s.coating and s.coating.layers:
            sides = self.lens.media[k : k + 2]
            sine = min(max(float(index_of(m, nm)) for nm in self.wavelength_nm) for m in sides)
            shares = coated_shares(s.coating.layers, (cos_i, cos_t), media, sine, self.wave)
        else:
            shares = fresnel(before * cos_i, after * cos_t, after * cos_i + before * cos_t)
        turn = None
        if self.last is not None:
            last, other, cosine = self.last
            pair = self.lens.surfaces[last], s
            if all(is_plain(one) for one in pair):
                gap = float(self.lens.vertices_mm[k] - self.lens.vertices_mm[last])
                across = crossed_spheres(self.x, d, (float(pair[0].curvature), c), gap)
            else:
                across = crossed(d, other, normal)
            turn = turned(other, normal, cosine * cos_i, across)
        self.light = pass_surface(self.light, turn, shares)
        self.last = k, normal, cos_t

    def _absorb(self, s: Surface, to: Value) -> None:
        """What the medium behind surface s, as light comes from the scene, takes on the way from the last point."""
        absorbed = absorption(s, self.wave)
        if absorbed is not None:
            depth = self.graph.dot(to - self.x, self.d) * absorbed
            self.depth = depth if self.depth is None else self.depth + depth

    def _index(self, k: int) -> Value:
        """Index of the medium in front of surface k, as light comes from the scene."""
        s = self.lens.media[k]
        key = (s.glass, float(s.n_d), s.V_d)
        if key not in self.indices:
            self.indices[key] = self._polynomial(s)
        return self.indices[key]

    def _polynomial(self, s: Surface | Medium) -> Value:
        g = self.graph
        if s.glass is None and s.V_d is None:
            return g.constant(float(s.n_d))
        long, short = ((1000 / w) ** 2 for w in reversed(self.wavelength_nm))
        if long == short:
            return g.constant(float(index_of(s, 1000 / long**0.5)))
        inverse = np.linspace(long, short, 200)
        n = np.array([float(index_of(s, 1000 / v**0.5)) for v in inverse])
        for degree in range(1, 8):
            fit = np.polynomial.Polynomial.fit(inverse, n, degree)
            if np.abs(fit(inverse) - n).max() < _INDEX:
                break
        return g.series(self.inverse_square, fit.convert().coef)


class _Meeting(NamedTuple):
    """Point, cosine of incidence and tests that tell whether there is one; unit normal towards +z, None of a sphere."""

    point: Value
    cosine: Value
    tests: list[Test]
    normal: Value | None = None


def _above(square: Value) -> Test:
    """Passed where `square` is positive; NaN does not pass."""
    return square.graph.constant(_TINY), square


def meet_plain(m: Value, d: Value, c: float | Value) -> _Meeting:
    """Meet a sphere or a plane from the ray's point m nearest to the vertex (Feder's e, M1 and L), towards -z."""
    if not isinstance(c, Value) and not c:
        return _Meeting(d * -(m[2] / d[2]) + m, -d[2], [])
    f = m.graph.square(m) * c + m[2] * -2.0
    q2 = f * -c + d[2] * d[2]
    q = q2.sqrt()
    way = f / (d[2] - q)  # towards -z
    return _Meeting(d * way + m, q, [_above(q2)])


class Figure(NamedTuple):
    """A conic, cylinder, asphere, toroid or biconic; lengths in mm, as numbers or as values of the call.

    Attributes:
        curvature, stretch: c and 1 + K of the conic. terms: A_p of h^(p - 2), lowest first; empty without a polynomial.
        start: c and c (1 + K) of the conic that the iteration starts from. last_step: how long its last step may be.
        even: whether the terms are those of even powers alone. steps: of the iteration.
        bent: whether along x and y.
        across: of a toroid or biconic, along the other axis: curvature, that of the start, 1 + K (0 of a toroid).
        turned: whether it is a toroid.
    """

    curvature: Number
    stretch: Number
    terms: Sequence[Number] = ()
    start: tuple[Number, Number] = (0.0, 0.0)
    last_step: Number = 0.0
    even: bool = True
    steps: int = 0
    bent: tuple[bool, bool] = (True, True)
    across: tuple[Number, ...] = ()
    turned: bool = False


def figure_of(surface: Surface) -> Figure:
    """The figure of a surface that is no sphere and no plane."""
    conic = Figure(float(surface.curvature), 1 + float(surface.conic))
    bent = surface.cylinder != "y", surface.cylinder != "x"
    if not surface.asphere and not surface.across:
        return conic._replace(bent=bent)
    powers = {n: float(a) for n, a in surface.asphere}
    even = all(n % 2 == 0 for n in powers)
    terms = tuple(powers.get(n, 0.0) for n in range(2, max(powers, default=0) + 1, 2 if even else 1))
    (cx, cy, cz), steps = start_of(surface)
    last_step = LAST_STEP * surface.semi_diameter_mm
    start = (cx if bent[0] else cy), cz
    found = conic._replace(terms=terms, start=start, last_step=last_step, even=even, steps=steps, bent=bent)
    if not surface.across:
        return found
    (radius, other), c_start = surface.across, cy if bent[0] else cx
    return found._replace(across=(1 / radius, c_start, 1 + (other or 0.0)), turned=other is None)


def meet_shape(m: Value, d: Value, figure: Figure) -> _Meeting:
    """Meet a surface that is no sphere and no plane, as `meet_plain`."""
    if figure.terms or figure.across:
        return _meet_asphere(m, d, figure)
    g, c, bent = m.graph, figure.curvature, figure.bent
    cz = c * figure.stretch
    q2, denominator, way = _meet_quadric(m, d, (c, cz), bent)
    point = d * way + m
    across = [point[k] * -c if bent[k] else g.constant(0.0) for k in (0, 1)]
    normal = g.concat(*across, point[2] * -cz + 1.0)
    scale = 1.0 / g.square(normal).sqrt()
    tests = [_above(q2), _above(denominator * denominator), _above(normal[2])]
    return _Meeting(point, q2.sqrt() * scale, tests, normal * scale)


def _meet_quadric(
    m: Value, d: Value, kind: tuple[Number, Number], bent: tuple[bool, bool], other: Number | None = None
) -> tuple[Value, ...]:
    """Meet c h^2 + cz z^2 (+ the other curvature times the square across) = 2 z.

    Returns discriminant, what the way is divided by, and the way from m.
    """
    c, cz = kind
    pairs = (d, d), (m, d), (m, m)
    a, b, f = (_across(p, q, bent) * c + p[2] * q[2] * cz for p, q in pairs)
    if other is not None:
        k = bent.index(False)
        a, b, f = (v + p[k] * q[k] * other for v, (p, q) in zip((a, b, f), pairs, strict=True))
    b, f = b - d[2], m[2] * -2.0 + f
    q2 = b * b + -(a * f)
    q, towards = q2.maximum(0.0).sqrt(), b <= 0.0
    # The two forms of the same root: each divides by what is not small.
    denominator = m.graph.select(towards, a, -b - q)
    numerator = m.graph.select(towards, q - b, f)
    return q2, denominator, numerator / denominator


def _across(a: Value, b: Value, bent: tuple[bool, bool]) -> Value:
    """The scalar product of what a and b have along the axes that are bent."""
    rows = [k for k in (0, 1) if bent[k]]
    return a.graph.dot(a[rows], b[rows])


def _meet_asphere(m: Value, d: Value, figure: Figure) -> _Meeting:
    """From the conic that fits best, by the steps of `shapes`, of which the last decides whether they converged."""
    g, bent = m.graph, figure.bent
    _, _, way = _meet_quadric(m, d, figure.start, bent, figure.across[1] if figure.across else None)
    for _ in range(figure.steps - 1):
        at = d * way + m
        if figure.across:
            value, gradient, bend, _ = _crossed(figure, at, d)
            rate, lack = g.dot(gradient, d), value * 2.0
            root = (rate * rate + -(bend * lack)).maximum(_TINY).sqrt()
            way = way + lack / -(root + rate)
            continue
        sag, slope, turn = _sag(figure, at)
        along = _across(at, d, bent)
        rate = slope * along + -d[2]
        bend = along * along * turn + slope * _across(d, d, bent)
        lack = (sag - at[2]) * 2.0
        root = (rate * rate + -(bend * lack)).maximum(_TINY).sqrt()
        way = way + lack / -(root + rate)
    at = d * way + m
    if figure.across:
        value, gradient, *_ = _crossed(figure, at, d)
        step = -value / g.dot(gradient, d)
        point = d * step + at
        _, gradient, _, exists = _crossed(figure, point, d)
        normal = gradient * (-1.0 / g.square(gradient).sqrt())
        cosine = -g.dot(normal, d)
        tests = [(step.abs(), g.value(figure.last_step)), _above(cosine), (g.constant(STEEPEST), exists)]
        return _Meeting(point, cosine, tests, normal)
    sag, slope, _ = _sag(figure, at)
    step = (at[2] - sag) / (slope * _across(at, d, bent) + -d[2])
    point = d * step + at
    _, slope, _ = _sag(figure, point)
    normal = point[0:2] * [-float(v) for v in bent] * slope
    scale = 1.0 / g.quadratic(normal, [((0, 0), (1, 1))], [1.0]).sqrt()
    cosine = -((normal[0] * d[0] + (normal[1] * d[1] + d[2])) * scale)
    tests = [
        (step.abs(), g.value(figure.last_step)),
        _above(cosine),
        (g.constant(STEEPEST), _cos2(figure, _across(point, point, bent))),
    ]
    return _Meeting(point, cosine, tests, g.concat(normal * scale, scale))


def _crossed(figure: Figure, at: Value, d: Value) -> tuple[Value, Value, Value, Value]:
    """As `shapes._crossed`, of a toroid or biconic: value, gradient [3], second derivative along d, what exists."""
    g, (c, _, stretch), swapped = at.graph, figure.across, figure.bent[0]
    place, way = ((v[int(swapped)], v[int(not swapped)], v[2]) for v in (at, d))
    if figure.turned:
        value, gradient, bend = toroid(c, _sag(figure, at), place, way)
        exists = (-gradient[2]).minimum(_cos2(figure, place[1] * place[1]))
    else:
        along = figure.curvature, figure.stretch
        value, gradient, bend, exists = biconic(along, (c, stretch), place, way, lambda v: v.maximum(STEEPEST).sqrt())
        gradient = gradient[0], gradient[1], g.constant(-1.0)
    return value, g.concat(gradient[swapped], gradient[not swapped], gradient[2]), bend, exists


def _sag(figure: Figure, at: Value) -> tuple[Value, Value, Value]:
    """Depth, d sag / d h over h, and the change of this by h over h of the conic alone."""
    h2 = _across(at, at, figure.bent)
    sag, slope = (_polynomial(figure, h2, order) for order in (0, 1))
    c = figure.curvature
    if not isinstance(c, Value) and not c:
        return sag * h2, slope, at.graph.constant(0.0)
    cos = _cos2(figure, h2).maximum(STEEPEST).sqrt()
    both = c / (cos * cos + cos)  # one division for c / (1 + cos) and c / cos
    inverse = both * cos + both
    turn = inverse * inverse * inverse * figure.stretch
    return (both * cos + sag) * h2, inverse + slope, turn


def _cos2(figure: Figure, h2: Value) -> Value:
    return h2 * -(figure.stretch * figure.curvature * figure.curvature) + 1.0


def _polynomial(figure: Figure, h2: Value, order: int) -> Value:
    """sum A_p h^(p - 2) (order 0) or sum p A_p h^(p - 2) (order 1), in h^2 or, where odd powers occur, in h."""
    if not figure.terms:
        return h2.graph.constant(0.0)
    h, down = (h2, 2) if figure.even else (h2.maximum(_TINY).sqrt(), 1)
    terms = [a * float((2 + down * k) ** order) for k, a in enumerate(figure.terms)]
    numbers = [a for a in terms if not isinstance(a, Value)]
    if len(numbers) == len(terms):
        return h.graph.series(h, numbers)
    total = h.graph.value(terms[-1])
    for a in reversed(terms[:-1]):
        total = total * h + a
    return total
