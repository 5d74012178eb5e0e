"""Where a ray meets a conic, a cylinder or an asphere. Conventions as in `surfaces`.

A conic surface of curvature c and constant K is c (x^2 + y^2 + (1 + K) z^2) - 2 z = 0; a cylinder lacks the square of
the coordinate along which it is straight. Both are met in closed form. An asphere adds A_p h^p, h the distance from
the axis (from the plane of symmetry, for a cylinder): an iteration of Newton's kind along the ray, started from the
conic that fits best; started at the vertex plane it fails beyond about 55 degrees.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from neurolens.optics.clearance import surface_sag_mm
from neurolens.optics.prescription import Surface
from neurolens.optics.surfaces import Hit, Medium, Rays, nearest_approach, root, times

Vector = tuple[Tensor, Tensor, Tensor]

# Steps of the iteration by how far the asphere departs from the conic that it starts from, in rim radii. A fixed
# count, for a test of convergence would make an accelerator wait for its host at every surface.
STEPS = ((1e-4, 2), (3e-3, 3), (3e-2, 4), (math.inf, 7))
# More steps that float64 takes after the one that decides convergence, so that both precisions decide alike.
POLISH = {torch.float32: 0, torch.float64: 2}
# Length of the deciding step, in rim radii, that counts as converged: the error left is of the order of its cube.
LAST_STEP = 3e-4
# cos^2 of the slope of the steepest conic that the iteration walks on.
STEEPEST = 1e-7


def is_plain(surface: Surface) -> bool:
    """Whether a surface is a sphere or a plane, which `surfaces` meets."""
    conic = isinstance(surface.conic, Tensor) or surface.conic != 0
    return not (conic or surface.asphere or surface.cylinder)


def intersect_shape(r: Rays, surface: Surface, sense: int, before: Medium, guard: bool) -> Hit:
    """Meet a conic, cylinder or asphere at the root next to the vertex. Arguments as for a sphere."""
    w = (float(surface.cylinder != "y"), float(surface.cylinder != "x"))
    nearest = nearest_approach(r, before.inverse_n2)
    if surface.asphere:
        return _meet_asphere(r, nearest, surface, w, sense, before)
    c = surface.curvature
    met, q2, q, t = _meet_quadric(r, nearest, (c * w[0], c * w[1], c * (1 + surface.conic)), sense, guard)
    x, y, z = _along(nearest, t, (r.dx, r.dy, r.dz))
    nx, ny, nz = times(x, -c * w[0]), times(y, -c * w[1]), 1 - times(z, c * (1 + surface.conic))
    length2 = torch.addcmul(torch.addcmul(nx * nx, ny, ny), nz, nz)
    scale = torch.rsqrt(torch.where(length2 > 0, length2, 1.0))
    return Hit(x, y, z, q * scale, q2 * scale * scale, met & (nz > 0), (nx * scale, ny * scale, nz * scale))


def _weighted(a: Vector, b: Vector, w: tuple[Any, ...]) -> Tensor:
    """Sum of the products of two vectors' components, each times its weight; a weight of 0 costs nothing."""
    terms = [times(p * q, k) for p, q, k in zip(a, b, w, strict=False) if isinstance(k, Tensor) or k != 0]
    total = terms[0] if terms else torch.zeros_like(a[0])
    for term in terms[1:]:
        total = total + term
    return total


def _along(m: Vector, t: Tensor, p: Vector) -> Vector:
    x, y, z = (torch.addcmul(o, t, d) for o, d in zip(m, p, strict=True))
    return x, y, z


def _meet_quadric(
    r: Rays, m: Vector, c: tuple[Any, Any, Any], sense: int, guard: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Meet cx x^2 + cy y^2 + cz z^2 = 2 z at the root next to the vertex.

    Returns whether there is one, the square of the derivative of the left side along the ray and its root, and the
    parameter from the point `m` of the ray: that of the closest approach where there is none.
    """
    p = (r.dx, r.dy, r.dz)
    a, b, f = _weighted(p, p, c), _weighted(m, p, c) - r.dz, _weighted(m, m, c) - 2 * m[2]
    q2 = b * b - a * f
    q = root(q2, True) if guard else torch.sqrt(q2.clamp_min(0))
    # The two forms of the same root: each divides by what is not small.
    backwards = b * sense >= 0
    denominator = torch.where(backwards, a, torch.add(-b, q, alpha=sense))
    sound = denominator != 0
    t = torch.where(backwards, torch.add(-b, q, alpha=-sense), f) / torch.where(sound, denominator, 1.0)
    return (q2 > 0) & sound, q2, q, t


def _meet_asphere(r: Rays, m: Vector, surface: Surface, w: tuple[float, float], sense: int, before: Medium) -> Hit:
    """Iterate along the rays, from the conic that fits the asphere best.

    All steps but the last are taken outside the graph: the last one alone carries the derivative of the solution
    (implicit function theorem), so that gradients cost no memory for iterations.
    """
    p = (r.dx, r.dy, r.dz)
    (c, cz), steps = _start(surface)
    with torch.no_grad():
        held = Rays(*(v.detach() for v in r))
        held_m, held_p = (m[0].detach(), m[1].detach(), m[2].detach()), (held.dx, held.dy, held.dz)
        _, missed, _, t = _meet_quadric(held, held_m, (c * w[0], c * w[1], cz), sense, False)
        t = torch.where(torch.isfinite(t), t, 0.0)
        polish = POLISH[t.dtype]
        for n in range(steps + polish - 1):
            step = _step(_along(held_m, t, held_p), held_p, surface, w, sense)
            if n == steps - 1:
                deciding = step
            t = t + step
    at = _along(m, t.detach(), p)
    step = _step(at, p, surface, w, sense)
    x, y, z = _along(at, step, p)
    _, slope, _, cos2 = _sag(surface, w, x, y)
    nx, ny = (times(v * -slope, k) for v, k in zip((x, y), w, strict=True))
    scale = torch.rsqrt(1 + nx * nx + ny * ny)
    q = (nx * p[0] + ny * p[1] + p[2]) * scale * sense
    length = times((deciding if polish else step).abs(), before.n)
    met = (length <= LAST_STEP * surface.semi_diameter_mm) & (q > 0)
    if cos2 is not None:
        met = met & (cos2 > STEEPEST)
    q2 = torch.where(met, q * q, torch.minimum(missed, -q * q))
    return Hit(x, y, z, q, q2, met, (nx * scale, ny * scale, scale))


@torch.compiler.assume_constant_result
def _start(surface: Surface) -> tuple[tuple[float, float], int]:
    """The conic c h^2 + cz z^2 = 2 z nearest to an asphere inside its rim, as (c, cz), and the steps it needs."""
    asphere = tuple((p, _number(a)) for p, a in surface.asphere)
    return _fitted(_number(surface.curvature), _number(surface.conic), asphere, surface.semi_diameter_mm)


def _number(value: Any) -> float:
    return float(value.detach() if isinstance(value, Tensor) else value)


@lru_cache(maxsize=4096)
def _fitted(
    curvature: float, conic: float, asphere: tuple[tuple[int, float], ...], rim_mm: float
) -> tuple[tuple[float, float], int]:
    if not math.isfinite(rim_mm):
        return (curvature, curvature * (1 + conic)), STEPS[-1][1]
    radius_mm = 1 / curvature if curvature else math.inf
    same = Surface(radius_mm, 0.0, 2 * rim_mm, conic=conic, asphere=asphere)
    points = [(h, surface_sag_mm(same, h, 0.0)) for h in (rim_mm * i / 24 for i in range(1, 25))]
    points = [(h, z) for h, z in points if math.isfinite(z)]
    # Linear least squares for c and cz: each point's error is that of its height along the axis, times 2.
    hh, hz, zz = (sum(h ** (4 - 2 * k) * z ** (2 * k) for h, z in points) for k in range(3))
    hb, zb = sum(2 * h * h * z for h, z in points), sum(2 * z**3 for _, z in points)
    determinant = hh * zz - hz * hz
    if determinant > 1e-9 * hh * zz:
        c, cz = (hb * zz - zb * hz) / determinant, (zb * hh - hb * hz) / determinant
    else:
        c, cz = (hb / hh if hh else curvature), 0.0
    worst = max((abs(c * h * h + cz * z * z - 2 * z) / 2 for h, z in points), default=math.inf)
    return (c, cz), next(steps for departure, steps in STEPS if worst <= departure * rim_mm)


def _step(at: Vector, p: Vector, surface: Surface, w: tuple[float, float], sense: int) -> Tensor:
    """Euler's step along the rays towards sag(x, y) = z: Newton's with the bend of the surface taken into account.

    Newton's own step is lost where a ray all but touches the surface, for there two meetings lie close together; the
    parabola through value, slope and bend has both, and the sign of its root is that of the one wanted.
    """
    x, y, z = at
    sag, slope, turn, _ = _sag(surface, w, x, y)
    along = _weighted((x, y, z), p, w)
    rate = slope * along - p[2]
    # Second derivative of the sag along the ray, but for what the polynomial adds to the change of its own slope.
    bend = slope * _weighted(p, p, w)
    if turn is not None:
        bend = bend + along * along * turn
    lack = sag - z
    square = (rate * rate - 2 * bend * lack).clamp_min(0)
    denominator = rate - sense * torch.sqrt(square + 1e-30)
    return -2 * lack / denominator


def _sag(
    surface: Surface, w: tuple[float, float], x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """The asphere at points [N]: depth, slope d sag / d h divided by h, the change d slope / d h divided by h of the
    conic alone, and the conic's squared cosine, positive where it exists; the last two None without a conic."""
    h2 = _weighted((x, y, x), (x, y, x), w)
    powers = dict(surface.asphere)
    even = all(p % 2 == 0 for p in powers)
    # Horner's rule in h^2, or in h where odd powers occur; the root is kept from 0, where its slope is infinite.
    h = h2 if even else torch.sqrt(h2.clamp_min(1e-30))
    highest = max(powers)
    sag, slope = torch.full_like(h2, 0.0) + powers[highest], torch.full_like(h2, 0.0) + highest * powers[highest]
    for k in range(highest - (2 if even else 1), 1, -2 if even else -1):
        sag, slope = sag * h, slope * h
        if k in powers:
            sag, slope = sag + powers[k], slope + k * powers[k]
    c = surface.curvature
    if not isinstance(c, Tensor) and c == 0:
        return sag * h2, slope, None, None
    stretch = (1 + surface.conic) * c * c
    cos2 = 1 - h2 * stretch
    cos = torch.sqrt(cos2.clamp_min(STEEPEST))
    # One division for both c h^2 / (1 + cos) and c / cos.
    both = c / (cos + cos * cos)
    inverse = both * (1 + cos)
    turn = inverse * inverse * inverse * (1 + surface.conic)
    return both * cos * h2 + sag * h2, inverse + slope, turn, cos2
