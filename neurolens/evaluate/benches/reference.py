"""A tracer of its own with 50 decimal digits, one ray at a time: what the fast tracer's float64 is held against.

It shares no formula with `optics.trace`: surfaces are written as F(x, y, z) = sag(x, y) - z with the normal as F's
gradient, the conic is met at the root of its quadratic, polynomial terms by Newton's iteration, and Snell's law is in
vector form (Glassner 1989). Slow: about a millisecond a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mpmath import mp, mpf, sqrt

from neurolens.base import status as st
from neurolens.optics.prescription import Lens, Surface

DIGITS = 50
Vector = tuple[Any, Any, Any]


@dataclass(frozen=True)
class ReferenceRay:
    """Where one ray ends: point on the last surface (lens frame, mm), unit direction after it, and its status.

    Point and direction are None where the ray is blocked.
    """

    point: Vector | None
    direction: Vector | None
    status: int


def trace_reference(lens: Lens, ray: Sequence[float], media: Sequence[float], towards: str) -> ReferenceRay:
    """Trace one ray through the whole lens with `DIGITS` decimal digits.

    Args:
        lens: spheres, planes, conics, polynomial aspheres and cylinders with plain numbers; rims and stop are circles.
        ray: x, y, z in mm (lens frame) and dx, dy, dz, which are made unit here.
        media: refractive indices from the scene (air) to the film: one more than there are surfaces.
        towards: "scene" or "film", as for `trace`.

    The tests at each surface are those of `neurolens.base.status`: met, inside the rim, not totally reflected.
    """
    with mp.workdps(DIGITS):
        sense = 1 if towards == "film" else -1
        p: Vector = (mpf(ray[0]), mpf(ray[1]), mpf(ray[2]))
        d = _unit((mpf(ray[3]), mpf(ray[4]), mpf(ray[5])))
        z = [mpf(0)]
        for s in lens.surfaces:
            z.append(z[-1] + mpf(float(s.thickness_mm)))
        for k in range(len(lens.surfaces))[::sense]:
            s = lens.surfaces[k]
            hit = _meet(s, (p[0], p[1], p[2] - z[k]), d, sense)
            if hit is None:
                return ReferenceRay(None, None, st.blocked(k, st.MISSED))
            if hit[0] ** 2 + hit[1] ** 2 > mpf(s.semi_diameter_mm) ** 2:
                return ReferenceRay(None, None, st.blocked(k, st.RIM))
            before, after = (media[k], media[k + 1])[::sense]
            bent = _refract(d, _normal(s, hit), mpf(float(before)) / mpf(float(after)))
            if bent is None:
                return ReferenceRay(None, None, st.blocked(k, st.TOTAL_REFLECTION))
            p, d = (hit[0], hit[1], hit[2] + z[k]), bent
        return ReferenceRay(p, d, st.PASSED)


def _unit(v: Vector) -> Vector:
    length = sqrt(sum(c * c for c in v))
    return v[0] / length, v[1] / length, v[2] / length


def _weights(s: Surface) -> tuple[int, int]:
    """How x^2 and y^2 enter the square of the height at which the sag is taken."""
    return (1, 0) if s.cylinder == "x" else (0, 1) if s.cylinder == "y" else (1, 1)


def _shape(s: Surface) -> tuple[Any, Any]:
    """Curvature at the vertex (without polynomial) and 1 + conic constant."""
    radius = mpf(float(s.radius_mm))
    return (mpf(0) if mp.isinf(radius) else 1 / radius), 1 + mpf(float(s.conic))


def _meet(s: Surface, p: Vector, d: Vector, sense: int) -> Vector | None:
    """Meeting point in the vertex frame, where the ray crosses the surface from its own side; None without one."""
    t = _meet_conic(s, p, d, sense)
    if t is None:
        return None
    if s.asphere:
        t = _newton(s, p, d, t)
        if t is None:
            return None
    hit = (p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2])
    return hit if -sense * _dot(d, _normal(s, hit)) > 0 else None


def _meet_conic(s: Surface, p: Vector, d: Vector, sense: int) -> Any:
    """Distance along the ray to the conic's sheet through the vertex, crossed along `sense`; None without one."""
    c, k1 = _shape(s)
    wx, wy = _weights(s)
    # c (wx x^2 + wy y^2 + k1 z^2) - 2 z = 0 along the ray: a t^2 + 2 b t + e = 0.
    a = c * (wx * d[0] ** 2 + wy * d[1] ** 2 + k1 * d[2] ** 2)
    b = c * (wx * p[0] * d[0] + wy * p[1] * d[1] + k1 * p[2] * d[2]) - d[2]
    e = c * (wx * p[0] ** 2 + wy * p[1] ** 2 + k1 * p[2] ** 2) - 2 * p[2]
    if a == 0:
        return -e / (2 * b) if b * sense < 0 else None
    square = b * b - a * e
    if square <= 0:
        return None
    # At a root, a t + b = -(d . normal) up to a positive factor: the crossing along `sense` has that sign.
    t = (-b - sense * sqrt(square)) / a
    z = p[2] + t * d[2]
    return t if 1 - c * k1 * z > 0 else None


def _newton(s: Surface, p: Vector, d: Vector, t: Any) -> Any:
    """Distance to the whole surface, from that to its conic; None where the iteration leaves it."""
    c, k1 = _shape(s)
    wx, wy = _weights(s)
    for _ in range(60):
        q = (p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2])
        u = wx * q[0] ** 2 + wy * q[1] ** 2
        if 1 - k1 * c * c * u <= 0:
            return None
        slope = _dot(d, _normal(s, q))
        if slope == 0:
            return None
        step = (_sag(s, u) - q[2]) / slope
        t -= step
        if abs(step) < mpf(10) ** (8 - DIGITS):
            return t
    return None


def _sag(s: Surface, u: Any) -> Any:
    """Depth at squared height u."""
    c, k1 = _shape(s)
    r = sqrt(u)
    polynomial = sum((mpf(float(a)) * r**power for power, a in s.asphere), mpf(0))
    return c * u / (1 + sqrt(1 - k1 * c * c * u)) + polynomial


def _normal(s: Surface, q: Vector) -> Vector:
    """Gradient of sag(x, y) - z, not of unit length."""
    c, k1 = _shape(s)
    wx, wy = _weights(s)
    u = wx * q[0] ** 2 + wy * q[1] ** 2
    r = sqrt(u)
    # Slope over r, which stays finite on the axis but for a term of power 1.
    slope = c / sqrt(1 - k1 * c * c * u)
    slope += sum((power * mpf(float(a)) * r ** (power - 2) for power, a in s.asphere if r > 0 or power >= 2), mpf(0))
    return slope * wx * q[0], slope * wy * q[1], mpf(-1)


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _refract(d: Vector, normal: Vector, mu: Any) -> Vector | None:
    """Direction after a surface; `mu` = n_before / n_after; None where the ray is totally reflected."""
    n = _unit(normal)
    cosine = -_dot(d, n)
    if cosine < 0:
        n, cosine = (-n[0], -n[1], -n[2]), -cosine
    square = 1 - mu * mu * (1 - cosine * cosine)
    if square <= 0:
        return None
    pull = mu * cosine - sqrt(square)
    return mu * d[0] + pull * n[0], mu * d[1] + pull * n[1], mu * d[2] + pull * n[2]
