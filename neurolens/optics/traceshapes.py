"""Where a ray towards the scene meets a conic, a cylinder or an asphere, as steps of a program: the way of `shapes`."""

from __future__ import annotations

from typing import NamedTuple

from neurolens.graph.program import Expr, Program
from neurolens.optics.prescription import Surface
from neurolens.optics.shapes import LAST_STEP, STEEPEST, start_of

Vector = tuple[Expr, Expr, Expr]


class Meeting(NamedTuple):
    """Point and unit normal towards +z, cosine of incidence, and pairs (low, high): met where low <= high in all."""

    point: Vector
    normal: Vector
    cosine: Expr
    tests: list[tuple[Expr, Expr]]


def meet_shape(p: Program, nearest: Vector, direction: Vector, surface: Surface) -> Meeting:
    """Meet a surface that is no sphere and no plane.

    Args:
        nearest: the ray's point nearest to the vertex, vertex frame, mm. direction: unit vector, towards -z.
    """
    w = (float(surface.cylinder != "y"), float(surface.cylinder != "x"))
    if surface.asphere:
        return _meet_asphere(p, nearest, direction, surface, w)
    c = float(surface.curvature)
    kind = (c * w[0], c * w[1], c * (1 + float(surface.conic)))
    q2, denominator, t = _meet_quadric(p, nearest, direction, kind)
    x, y, z = point = _along(p, nearest, t, direction)
    nx, ny, nz = x * -kind[0], y * -kind[1], p.fma(z, -kind[2], 1.0)
    scale = p.literal(1.0) / p.op("sqrt", p.fma(nx, nx, p.fma(ny, ny, nz * nz)))
    tiny = p.literal(1e-30)
    tests = [(tiny, q2), (tiny, denominator * denominator), (tiny, nz)]
    return Meeting(point, (nx * scale, ny * scale, nz * scale), p.op("sqrt", q2) * scale, tests)


def _meet_quadric(p: Program, m: Vector, d: Vector, kind: tuple[float, float, float]) -> tuple[Expr, Expr, Expr]:
    """Meet cx x^2 + cy y^2 + cz z^2 = 2 z: discriminant, what the way is divided by, and the way from m."""
    a, b, f = (_weighted(p, *pair, kind) for pair in ((d, d), (m, d), (m, m)))
    b, f = b - d[2], p.fma(m[2], -2.0, f)
    q2 = p.fma(b, b, -(a * f))
    q = p.op("sqrt", p.op("max", q2, 0.0))
    # The two forms of the same root: each divides by what is not small.
    zero = p.literal(0.0)
    denominator, numerator = p.select(b, zero, a, -b - q), p.select(b, zero, q - b, f)
    return q2, denominator, numerator / denominator


def _weighted(p: Program, a: Vector, b: Vector, weights: tuple[float, ...]) -> Expr:
    total = p.literal(0.0)
    for left, right, weight in zip(a, b, weights, strict=False):
        total = p.fma(left * weight, right, total) if weight else total
    return total


def _along(p: Program, m: Vector, t: Expr, d: Vector) -> Vector:
    return p.fma(t, d[0], m[0]), p.fma(t, d[1], m[1]), p.fma(t, d[2], m[2])


def _meet_asphere(p: Program, m: Vector, d: Vector, surface: Surface, w: tuple[float, float]) -> Meeting:
    """From the conic that fits best, by the steps of `shapes`, of which the last decides whether they converged."""
    (c, cz), steps = start_of(surface)
    _, _, t = _meet_quadric(p, m, d, (c * w[0], c * w[1], cz))
    for _ in range(steps - 1):
        at = _along(p, m, t, d)
        sag, slope, turn = _sag(p, surface, w, at)
        along = _weighted(p, at, d, w)
        rate = p.fma(slope, along, -d[2])
        bend = p.fma(along * along, turn, slope * _weighted(p, d, d, w))
        lack = (sag - at[2]) * 2.0
        root = p.op("sqrt", p.op("max", p.fma(rate, rate, -(bend * lack)), 1e-30))
        t = t + lack / -(root + rate)
    at = _along(p, m, t, d)
    sag, slope, _ = _sag(p, surface, w, at)
    step = (at[2] - sag) / p.fma(slope, _weighted(p, at, d, w), -d[2])
    x, y, _ = point = _along(p, at, step, d)
    _, slope, _ = _sag(p, surface, w, point)
    nx, ny = x * -w[0] * slope, y * -w[1] * slope
    scale = p.literal(1.0) / p.op("sqrt", p.fma(nx, nx, p.fma(ny, ny, 1.0)))
    cosine = -(p.fma(nx, d[0], p.fma(ny, d[1], d[2])) * scale)
    tests = [
        (p.op("max", step, -step), p.literal(LAST_STEP * surface.semi_diameter_mm)),
        (p.literal(1e-30), cosine),
        (p.literal(STEEPEST), _cos2(p, surface, _height2(p, w, point))),
    ]
    return Meeting(point, (nx * scale, ny * scale, scale), cosine, tests)


def _sag(p: Program, surface: Surface, w: tuple[float, float], at: Vector) -> tuple[Expr, Expr, Expr]:
    """Depth, d sag / d h over h, and the change of this by h over h of the conic alone."""
    h2 = _height2(p, w, at)
    sag, slope = (_polynomial(p, surface, h2, order) for order in (0, 1))
    c = float(surface.curvature)
    if not c:
        return sag * h2, slope, p.literal(0.0)
    cos = p.op("sqrt", p.op("max", _cos2(p, surface, h2), STEEPEST))
    both = p.literal(c) / p.fma(cos, cos, cos)  # one division for c / (1 + cos) and c / cos
    inverse = p.fma(both, cos, both)
    turn = inverse * inverse * inverse * (1 + float(surface.conic))
    return p.fma(both, cos, sag) * h2, inverse + slope, turn


def _cos2(p: Program, surface: Surface, h2: Expr) -> Expr:
    c = float(surface.curvature)
    return p.fma(h2, -(1 + float(surface.conic)) * c * c, 1.0)


def _height2(p: Program, w: tuple[float, float], at: Vector) -> Expr:
    return _weighted(p, at, at, w)


def _polynomial(p: Program, surface: Surface, h2: Expr, order: int) -> Expr:
    """sum A_p h^(p - 2) (order 0) or sum p A_p h^(p - 2) (order 1), in h^2 or, where odd powers occur, in h."""
    powers = {n: float(a) for n, a in surface.asphere}
    even = all(n % 2 == 0 for n in powers)
    h, down = (h2, 2) if even else (p.op("sqrt", p.op("max", h2, 1e-30)), 1)
    count = (max(powers) - 2) // down + 1
    return p.horner(h, [powers.get(2 + down * k, 0.0) * (2 + down * k) ** order for k in range(count)])
