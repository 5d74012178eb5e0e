"""Where a ray meets a conic, a cylinder, an asphere, a toroid or a biconic. Conventions as in `surfaces`.

A conic surface of curvature c and constant K is c (x^2 + y^2 + (1 + K) z^2) - 2 z = 0; a cylinder lacks the square of
the coordinate along which it is straight. Both are met in closed form. An asphere adds A_p h^p, h the distance from
the axis (from the plane of symmetry, for a cylinder): an iteration of Newton's kind along the ray, started from the
conic that fits best; started at the vertex plane it fails beyond about 55 degrees. Toroids and biconics likewise.

Beyond its rim a polynomial soon means nothing: a term in r^20 is 3,000 times as large at 1.5 times the rim. Where rims
are ignored an asphere therefore follows its figures only as far as they stay close to the slope at the rim, and then
continues with the same slope and curvature, which dies away: it becomes a cone that every ray can meet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurolens.optics.prescription import Surface
from neurolens.optics.sag import biconic, sag_and_derivatives, sag_mm, toroid
from neurolens.optics.surfaces import (
    Hit,
    Medium,
    Mode,
    Rays,
    also,
    at_most,
    choose,
    nearest_approach,
    positive,
    root,
    times,
)

Vector = tuple[Tensor, Tensor, Tensor]

# Steps of the iteration by how far the asphere departs from the conic that it starts from, in rim radii. A fixed
# count: a test of convergence would make an accelerator wait for its host at every surface.
STEPS = ((3e-4, 2), (3e-3, 3), (3e-2, 4), (math.inf, 7))
# Extra steps of float64 after the one that decides convergence, so that both precisions decide equally.
POLISH = {torch.float32: 0, torch.float64: 2}
# Length of the deciding step, in rim radii, that counts as converged: the error left is of the order of its square.
LAST_STEP = 3e-4
# cos^2 of the slope of the steepest conic that the iteration follows.
STEEPEST = 1e-7
# How far (rad) the slope of an asphere may turn beyond its rim before it continues smoothly, and again after that.
TURN = 0.25
FARTHEST = 1.5  # rim radii up to which figures are followed at most
_UPRIGHT = 1e6  # slope and bend that stand for infinite ones


def is_plain(surface: Surface) -> bool:
    """Whether a surface is a sphere or a plane, which `surfaces` meets."""
    conic = isinstance(surface.conic, Tensor) or surface.conic != 0
    return not (conic or surface.asphere or surface.cylinder)


def intersect_shape(r: Rays, surface: Surface, mode: Mode, before: Medium) -> Hit:
    """Meet a conic, cylinder or asphere at the root next to the vertex. Arguments as for a sphere."""
    w = (float(surface.cylinder != "y"), float(surface.cylinder != "x"))
    nearest = nearest_approach(r, before.inverse_n2)
    if surface.asphere or surface.across:
        return _meet_asphere(r, nearest, surface, w, mode, before)
    c = surface.curvature
    kind = (c * w[0], c * w[1], c * (1 + surface.conic))
    guard, spend = mode.guard, mode.spend
    met, q2, q, t = _meet_quadric(r, nearest, kind, mode.sense, before, guard, spend)
    x, y, z = _along(nearest, t, (r.dx, r.dy, r.dz))
    nx, ny, nz = times(x, -kind[0]), times(y, -kind[1]), 1 - times(z, kind[2])
    length2 = torch.addcmul(torch.addcmul(nx * nx, ny, ny), nz, nz)
    scale = torch.rsqrt(torch.where(length2 > 0, length2, 1.0) if guard else length2)
    met = also(met, positive(nz.clone() if spend else nz, spend=spend))
    return Hit(x, y, z, q * scale, q2 * scale * scale, met, (nx * scale, ny * scale, nz * scale))


def _weighted(a: Vector, b: Vector, w: tuple[Any, ...]) -> Tensor:
    """Sum of the products of two vectors' components, each times its weight; terms of weight 0 are left out."""
    terms = [times(p * q, k) for p, q, k in zip(a, b, w, strict=False) if isinstance(k, Tensor) or k != 0]
    total = terms[0] if terms else torch.zeros_like(a[0])
    for term in terms[1:]:
        total = total + term
    return total


def _along(m: Vector, t: Tensor, p: Vector) -> Vector:
    x, y, z = (torch.addcmul(o, t, d) for o, d in zip(m, p, strict=True))
    return x, y, z


def _meet_quadric(
    r: Rays, m: Vector, c: tuple[Any, Any, Any], sense: int, before: Medium, guard: bool, spend: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Meet cx x^2 + cy y^2 + cz z^2 = 2 z at the root next to the vertex.

    Returns whether there is one, the square of the left side's derivative along the ray and its root, and the
    parameter from the nearest approach `m` of the ray: near it where there is none.
    """
    p, (cx, cy, cz) = (r.dx, r.dy, r.dz), c
    if cx is cy or (not isinstance(cx, Tensor) and cx == cy):
        # Rotationally symmetric: p.p = n^2 and m.p = 0 simplify the terms.
        a = p[2] * p[2] * (cz - cx) + before.n2 * cx
        b = p[2] * (times(m[2], cz - cx) - 1)
        f = torch.addcmul(m[0] * m[0], m[1], m[1]) * cx + m[2] * (times(m[2], cz) - 2)
    else:
        a, b, f = _weighted(p, p, c), _weighted(m, p, c) - r.dz, _weighted(m, m, c) - 2 * m[2]
    q2 = torch.addcmul(b * b, a, f, value=-1)
    q = root(q2, True) if guard else torch.sqrt(q2.clamp_min(0))
    # The two forms of the same root: each divides by what is not small.
    backwards = at_most(b * -sense, 0.0, spend=spend)
    denominator = choose(backwards, a, torch.add(-b, q, alpha=sense))
    numerator = choose(backwards, torch.add(-b, q, alpha=-sense), f)
    sound = positive(denominator * denominator, spend=spend)
    t = numerator / (torch.where(sound, denominator, 1.0) if guard else denominator)
    return also(positive(q2.clone() if spend else q2, spend=spend), sound), q2, q, t


def _meet_asphere(r: Rays, m: Vector, surface: Surface, w: tuple[float, float], mode: Mode, before: Medium) -> Hit:
    """Iterate along the rays, from the conic that fits the asphere best.

    All steps but the last are outside the graph: it alone carries the derivative (implicit function theorem), so
    that gradients cost no memory for iterations.
    """
    p, sense, guard, spend = (r.dx, r.dy, r.dz), mode.sense, mode.guard, mode.spend
    start, steps = start_of(surface)
    with torch.no_grad():
        held = Rays(*(v.detach() for v in r))
        held_m, held_p = (m[0].detach(), m[1].detach(), m[2].detach()), (held.dx, held.dy, held.dz)
        medium = Medium(*(v.detach() if isinstance(v, Tensor) else v for v in before))
        _, missed, _, t = _meet_quadric(held, held_m, start, sense, medium, False, spend)
        t = torch.nan_to_num(t, 0.0, 0.0, 0.0) if guard else t
        polish = POLISH[t.dtype]
        for n in range(steps + polish - 1):
            step = _step(_along(held_m, t, held_p), held_p, surface, w, sense)
            if n == steps - 1:
                deciding = step
            t = t + step
    at = _along(m, t.detach(), p)
    step = _step(at, p, surface, w, sense, last=True)
    x, y, z = _along(at, step, p)
    if surface.across:
        _, (nx, ny, nz), _, cos2 = _crossed(surface, w, (x, y, z), p)
        scale = -torch.rsqrt(nx * nx + ny * ny + nz * nz)
        q = _weighted((nx, ny, nz), p, (1, 1, 1)) * (scale * sense)
    else:
        derivative, cos2 = _derivative(surface, w, x, y)
        nx, ny = (times(v * -derivative, k) for v, k in zip((x, y), w, strict=True))
        scale = torch.rsqrt(torch.addcmul(nx * nx, ny, ny) + 1)
        nz, q = 1.0, torch.addcmul(torch.addcmul(p[2], nx, p[0]), ny, p[1]) * (scale * sense)
    length = times((deciding if polish else step).abs(), before.n)
    met = also(
        at_most(length, LAST_STEP * _extent_mm(surface), spend=spend),
        positive(q.clone() if spend else q, spend=spend),
    )
    if cos2 is not None:
        met = also(met, positive(cos2 - STEEPEST, spend=spend))
    # How far a ray misses is of use only where crossings are learnt from.
    q2 = torch.where(met, q * q, torch.minimum(missed, -q * q)) if guard else q * q
    return Hit(x, y, z, q, q2, met, (nx * scale, ny * scale, times(scale, nz)))


def start_of(surface: Surface) -> tuple[tuple[float, float, float], int]:
    """The quadric cx x^2 + cy y^2 + cz z^2 = 2 z nearest to a surface inside its rim, and the steps it needs."""
    asphere = tuple((p, _number(a)) for p, a in surface.asphere)
    curve = _number(surface.curvature), _number(surface.conic), asphere, _extent_mm(surface)
    if not surface.across:
        (c, cz), steps = _fitted(*curve)
        return (c * (surface.cylinder != "y"), c * (surface.cylinder != "x"), cz), steps
    (c, other, cz), steps = _fitted_crossed(*curve, surface.across)
    return ((other, c, cz) if surface.cylinder == "y" else (c, other, cz)), steps


def followed_mm(surface: Surface) -> float:
    """Distance from the axis up to which an asphere's figures are followed where rims are ignored, at least its rim."""
    height = surface.semi_diameter_mm * np.linspace(1, FARTHEST, 51)
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = np.arctan(_profile(surface, height)[0])
        tame = np.abs(angle - angle[0]) <= TURN  # NaN beyond the end of the conic is not
    return float(height[max(int(np.argmin(tame)) - 1, 0) if not tame.all() else -1])


def _profile(surface: Surface, height: Any) -> tuple[Any, Any]:
    """First and second derivative by the height of a surface's meridional curve (of a cylinder: across its lines)."""
    curve = replace(surface, cylinder=None, across=None)
    step = 1e-4 * height
    before, slope = (sag_and_derivatives(curve, h, 0 * h)[1] for h in (height - step, height))
    return slope, (slope - before) / step


def _extent_mm(surface: Surface) -> float:
    """Distance from the axis up to which a surface's own figures hold."""
    return min(surface.semi_diameter_mm, surface.followed_mm)


@lru_cache(maxsize=4096)
def _end_of(surface: Surface) -> tuple[float, float, float]:
    """Slope and second derivative of the curve where its figures end, and the length in which the latter dies away."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a conic may end at its rim, upright
        profile = _profile(surface, np.array(surface.followed_mm))
    slope, bend = (float(np.nan_to_num(v, nan=0.0, posinf=_UPRIGHT, neginf=-_UPRIGHT)) for v in profile)
    return slope, bend, min(TURN * surface.followed_mm, TURN * (1 + slope * slope) / max(abs(bend), 1e-300))


class _Beyond(NamedTuple):
    """How a curve continues where its figures end, each [N]; at points inside 0, 1, 0.

    With d the distance beyond the end: its slope there is slope + bend * length * (1 - exp(-d / length)).
    """

    rise: Tensor  # what is added to the sag at the end
    share: Tensor  # by which d sag / d h over h at the end is multiplied
    turned: Tensor  # what is added to that
    turn: Tensor  # the change of the sum by h over h


def _beyond(surface: Surface, h2: Tensor) -> _Beyond:
    slope, bend, length = _end_of(surface)
    h = torch.sqrt(h2.clamp_min(1e-30)).clamp_min(surface.followed_mm)
    d = h - surface.followed_mm
    left = torch.exp(d / -length)
    turned = bend * length * (1 - left)
    rise = slope * d + bend * length * (d - length * (1 - left))
    return _Beyond(rise, surface.followed_mm / h, turned / h, (bend * left - (slope + turned) / h) / (h * h))


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
    points = [(h, sag_mm(same, h, 0.0)) for h in (rim_mm * i / 24 for i in range(1, 25))]
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


@lru_cache(maxsize=4096)
def _fitted_crossed(
    curvature: float,
    conic: float,
    asphere: tuple[tuple[int, float], ...],
    rim_mm: float,
    across: tuple[float, float | None],
) -> tuple[tuple[float, float, float], int]:
    """As `_fitted`, of a toroid or biconic: along the curve, across it, along z."""
    if not math.isfinite(rim_mm):
        return (curvature, 1 / across[0], 0.0), STEPS[-1][1]
    radius_mm = 1 / curvature if curvature else math.inf
    same = Surface(radius_mm, 0.0, 2 * rim_mm, conic=conic, asphere=asphere, cylinder="y", across=across)
    h, turn = np.meshgrid(rim_mm * np.arange(1, 25) / 24, np.linspace(0, math.pi / 2, 9))
    a, h = h.ravel() * np.sin(turn.ravel()), h.ravel() * np.cos(turn.ravel())
    z = sag_mm(same, a, h)
    a, h, z = (v[np.isfinite(z)] for v in (a, h, z))
    found, *_ = np.linalg.lstsq(np.stack([h * h, a * a, z * z], 1), 2 * z, rcond=1e-9)
    worst = np.abs(found @ np.stack([h * h, a * a, z * z]) - 2 * z).max(initial=0.0) / 2
    c, other, cz = found.tolist()
    return (c, other, cz), next(steps for departure, steps in STEPS if worst <= departure * rim_mm)


def _crossed(surface: Surface, w: tuple[float, float], at: Vector, p: Vector) -> tuple[Any, ...]:
    """A function that is 0 on a toroid or biconic and grows with -z, its gradient [3], its second derivative along p,
    and a number that is positive where the surface exists; each [N]."""
    assert surface.across is not None
    (radius, conic), swapped = surface.across, surface.cylinder == "x"
    (a, h, z), (pa, ph, pz) = ((v[swapped], v[not swapped], v[2]) for v in (at, p))
    if conic is None:
        g, slope, turn = _sag(surface, w, *at[:2])
        curve = g, slope, 0.0 if turn is None else turn
        value, gradient, bend = toroid(1 / radius, curve, (a, h, z), (pa, ph, pz))
        own = _derivative(surface, w, *at[:2])[1]
        cos2 = -gradient[2] if own is None else torch.minimum(own, -gradient[2])
    else:
        along = surface.curvature, 1 + surface.conic
        value, gradient, bend, cos2 = biconic(along, (1 / radius, 1 + conic), (a, h, z), (pa, ph, pz), _held_root)
        gradient = gradient[0], gradient[1], torch.full_like(z, -1.0)
    return value, (gradient[swapped], gradient[not swapped], gradient[2]), bend, cos2


def _held_root(square: Tensor) -> Tensor:
    return torch.sqrt(square.clamp_min(STEEPEST))


def _step(at: Vector, p: Vector, surface: Surface, w: tuple[float, float], sense: int, last: bool = False) -> Tensor:
    """Euler's step along the rays towards sag(x, y) = z: Newton's with the bend of the surface taken into account.

    Newton's own is lost where a ray all but touches the surface, for there two meetings lie close together; the
    parabola has both. The `last` step is Newton's: by then both are the same.
    """
    x, y, z = at
    if surface.across:
        value, gradient, bend, _ = _crossed(surface, w, at, p)
        rate = _weighted(gradient, p, (1, 1, 1))
        if last:
            return -value / rate
        lack = 2 * value
    else:
        sag, derivative, turn = _sag(surface, w, x, y)
        along = _weighted((x, y, z), p, w)
        rate = derivative * along - p[2]
        if last:
            return (z - sag) / rate
        # Second derivative of the sag along the ray, but for what the polynomial adds to the change of its derivative.
        bend = derivative * _weighted(p, p, w)
        if turn is not None:
            bend = torch.addcmul(bend, along * along, turn)
        lack = 2 * (sag - z)
    square = torch.addcmul(rate * rate, bend, lack, value=-1)
    denominator = torch.sub(torch.sqrt(square.clamp_min(1e-30)), rate, alpha=sense) * sense
    return lack / denominator


def _sag(surface: Surface, w: tuple[float, float], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """Depth at points [N], d sag / d h over h, and the change of this by h over h of the conic alone (None without)."""
    h2 = _height2(w, x, y)
    if surface.followed_mm == math.inf:
        return _own_sag(surface, h2)
    end2, more = surface.followed_mm**2, _beyond(surface, h2)
    sag, derivative, turn = _own_sag(surface, h2.clamp_max(end2))
    turn = torch.where(h2 > end2, more.turn, 0.0 if turn is None else turn)
    return sag + more.rise, derivative * more.share + more.turned, turn


def _own_sag(surface: Surface, h2: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    sag, derivative = _polynomials(surface, h2, (0, 1))
    c = surface.curvature
    if not isinstance(c, Tensor) and c == 0:
        return sag * h2, derivative, None
    cos = _held_root(1 - h2 * ((1 + surface.conic) * c * c))
    # One division for both c h^2 / (1 + cos) and c / cos.
    both = c / torch.addcmul(cos, cos, cos)
    inverse = torch.addcmul(both, both, cos)
    turn = inverse * inverse * inverse * (1 + surface.conic)
    return torch.addcmul(sag, both, cos) * h2, inverse + derivative, turn


def _derivative(surface: Surface, w: tuple[float, float], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor | None]:
    """d sag / d h divided by h at points [N], and the conic's squared cosine, positive where it exists."""
    h2 = _height2(w, x, y)
    if surface.followed_mm == math.inf:
        return _own_derivative(surface, h2)
    derivative, cos2 = _own_derivative(surface, h2.clamp_max(surface.followed_mm**2))
    more = _beyond(surface, h2)
    return derivative * more.share + more.turned, cos2


def _own_derivative(surface: Surface, h2: Tensor) -> tuple[Tensor, Tensor | None]:
    (derivative,) = _polynomials(surface, h2, (1,))
    c = surface.curvature
    if not isinstance(c, Tensor) and c == 0:
        return derivative, None
    cos2 = 1 - h2 * ((1 + surface.conic) * c * c)
    return derivative + c * torch.rsqrt(cos2.clamp_min(STEEPEST)), cos2


def _height2(w: tuple[float, float], x: Tensor, y: Tensor) -> Tensor:
    return torch.addcmul(x * x, y, y) if w == (1.0, 1.0) else (x * x if w[0] else y * y)


def _polynomials(surface: Surface, h2: Tensor, orders: Sequence[int]) -> list[Tensor]:
    """sum A_p h^(p - 2) (order 0) and sum p A_p h^(p - 2) (order 1) by Horner's rule, each [N]."""
    powers = dict(surface.asphere)
    if not powers:
        return [torch.zeros_like(h2) for _ in orders]
    even = all(p % 2 == 0 for p in powers)
    # In h^2, or in h where odd powers occur; the root is kept from 0, where its derivative is infinite.
    h = h2 if even else torch.sqrt(h2.clamp_min(1e-30))
    highest, down = max(powers), 2 if even else 1
    found = []
    for order in orders:
        total: Any = powers[highest] * highest**order
        for k in range(highest - down, 1, -down):
            total = total * h
            if k in powers:
                total = total + powers[k] * k**order
        found.append(total if isinstance(total, Tensor) and total.shape == h2.shape else torch.zeros_like(h2) + total)
    return found
