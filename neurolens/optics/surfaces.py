"""Where a ray meets a sphere or a plane and how it bends there: pure functions on separate x, y, z tensors [N].

Directions in here are optical direction cosines: unit vectors times the refractive index of the medium, p = n d, for
which Snell's law needs no division (p after = p before + a multiple of the normal). `sense` is +1 for rays travelling
from the scene to the film (+z) and -1 for camera rays. Coordinates are relative to the surface's vertex. Formulas:
Spencer and Murty 1962, "General Ray-Tracing Procedure", in the form that needs no division by dz and gives the cosine
of incidence for free; optical direction cosines as in Welford 1986, "Aberrations of Optical Systems", ch. 4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from neurolens.optics.survival import positive


class Rays(NamedTuple):
    """Rays as a structure of arrays, each [N]: a point (mm) and a direction (unit, or times the index in here)."""

    x: Tensor
    y: Tensor
    z: Tensor
    dx: Tensor
    dy: Tensor
    dz: Tensor


class Medium(NamedTuple):
    """A refractive index with its square and the inverse of that: numbers, or tensors [N] where dispersive."""

    n: Any
    n2: Any
    inverse_n2: Any


class Hit(NamedTuple):
    """A meeting point, each [N].

    `q` is n times the cosine of incidence and `q2` its square: positive where the ray meets the surface, and a smooth
    measure of how far it misses elsewhere. `met` is False (or 0) where there is no meeting (NaN is none). `normal` is
    the unit normal towards +z; None for a sphere of curvature c, whose normal is (-c x, -c y, 1 - c z).
    """

    x: Tensor
    y: Tensor
    z: Tensor
    q: Tensor
    q2: Tensor
    met: Tensor
    normal: tuple[Tensor, Tensor, Tensor] | None = None


AIR = Medium(1.0, 1.0, 1.0)


def medium(n: Any) -> Medium:
    """A medium of index `n` (number or tensor)."""
    n2 = n * n
    return Medium(n, n2, 1 / n2)


def plus_times(a: Tensor, b: Tensor, k: Any) -> Tensor:
    """a + k b in one pass over memory where k is a number; k may be a tensor where gradients are wanted."""
    return a + b * k if isinstance(k, Tensor) else torch.add(a, b, alpha=k)


def times(a: Tensor, k: Any) -> Tensor:
    """a k, at no cost where k is the number 1."""
    return a if not isinstance(k, Tensor) and k == 1 else a * k


def root(square: Tensor, guard: bool) -> Tensor:
    """Square root; with `guard`, 1 instead of NaN (or of an infinite slope) where there is none."""
    if guard:
        return torch.sqrt(torch.where(square > 0, square, 1.0))
    if torch.compiler.is_compiling():
        return torch.sqrt(square)
    # The mathematics library behind torch.sqrt takes 20 times as long for negative numbers, and blocked rays have them.
    return square * torch.rsqrt(square)


def nearest_approach(r: Rays, inverse_n2: Any) -> tuple[Tensor, Tensor, Tensor]:
    """The point of a ray nearest to the vertex: its coordinates are small, which keeps float32 to micrometres."""
    e = times((r.x * r.dx).addcmul_(r.y, r.dy).addcmul_(r.z, r.dz), inverse_n2)
    return (
        torch.addcmul(r.x, e, r.dx, value=-1),
        torch.addcmul(r.y, e, r.dy, value=-1),
        torch.addcmul(r.z, e, r.dz, value=-1),
    )


def _minus_curved(a: Tensor, f: Tensor, n2: Any, curvature: Any) -> Tensor:
    """a - curvature n2 f, in one pass over memory where the curvature is a number; it may overwrite `a`."""
    if isinstance(n2, Tensor) and not isinstance(curvature, Tensor):
        return a.addcmul_(f, n2, value=-curvature)
    return plus_times(a, times(f, n2), -curvature)


def intersect_sphere(
    r: Rays, curvature: Any, sense: int, before: Medium, entering: bool, guard: bool, spend: bool
) -> Hit:
    """Meet a sphere of signed curvature (1/mm) at the root next to the vertex.

    `entering` marks the first surface met, where rays may arrive at more than 90 degrees. `guard` keeps rays without a
    meeting finite (for gradients and for crossings that are learnt from); without it they are NaN. `spend` is as in
    `survival.positive`.
    """
    mx, my, mz = nearest_approach(r, before.inverse_n2)
    m2 = (mx * mx).addcmul_(my, my).addcmul_(mz, mz)
    f = plus_times(m2 * curvature, mz, -2.0)
    q2 = _minus_curved(r.dz * r.dz, f, before.n2, curvature)
    q = root(q2, guard or entering)
    denominator = torch.add(r.dz, q, alpha=sense)
    if entering:
        # Beyond 90 degrees the usual form divides two vanishing numbers; the conjugate form is exact there.
        met = q2 > 0
        backwards = r.dz * sense <= 0
        # A plane given as a tensor: 0 / 0 is not taken, but its gradient would be.
        bent = torch.where(curvature == 0, 1.0, curvature) if isinstance(curvature, Tensor) else curvature
        conjugate = times(torch.sub(r.dz, q, alpha=sense) / bent, before.inverse_n2)
        t = torch.where(backwards, conjugate, f / torch.where(backwards, float(sense), denominator))
    elif guard:
        met = (q2 > 0) & (denominator * sense > 0)
        t = f / torch.where(met, denominator, float(sense))
    else:
        t = f / denominator
        # One comparison: NaN from a negative square fails it too.
        met = positive(denominator, sense, spend=spend)
    # In place where nobody needs the nearest approach any more: a third less memory to move.
    add = Tensor.addcmul_ if spend else torch.addcmul
    x, y, z = add(mx, t, r.dx), add(my, t, r.dy), add(mz, t, r.dz)
    if entering:
        # A ray from anywhere may meet the far half of the sphere, where there is no glass.
        met = met & (z * curvature <= 1)
    return Hit(x, y, z, q, q2, met)


def intersect_plane(r: Rays, sense: int, guard: bool, spend: bool) -> Hit:
    """Meet the plane z = 0; a ray that does not travel along `sense` misses it. Arguments as for a sphere."""
    q = r.dz * sense
    met = positive(q.clone() if spend else q, spend=spend)
    t = r.z / (torch.where(met, r.dz, float(sense)) if guard else r.dz)
    x = torch.addcmul(r.x, t, r.dx, value=-1)
    y = torch.addcmul(r.y, t, r.dy, value=-1)
    return Hit(x, y, torch.zeros_like(r.z), q, r.dz * r.dz, met)


def refract(
    r: Rays, hit: Hit, curvature: Any, sense: int, before: Medium, after: Medium, guard: bool
) -> tuple[Rays, Tensor, Tensor]:
    """Snell's law: the tangential part of the optical direction cosines stays, the normal part follows their length.

    Returns the refracted rays (vertex frame), n' times the cosine of refraction [N], and the square of that before
    guarding, which is not positive where the ray is totally reflected.
    """
    q2 = hit.q2 + (after.n2 - before.n2)
    q = root(q2, guard)
    bend = q - hit.q
    if hit.normal is not None:
        direction = (torch.addcmul(p, bend, n, value=sense) for p, n in zip(r[3:], hit.normal, strict=True))
        return Rays(hit.x, hit.y, hit.z, *direction), q, q2
    ahead = torch.add(r.dz, bend, alpha=sense)
    if isinstance(curvature, Tensor):
        pull = bend * (curvature * sense)
        return Rays(hit.x, hit.y, hit.z, r.dx - pull * hit.x, r.dy - pull * hit.y, ahead - pull * hit.z), q, q2
    pull = -curvature * sense
    dx = torch.addcmul(r.dx, bend, hit.x, value=pull)
    dy = torch.addcmul(r.dy, bend, hit.y, value=pull)
    dz = ahead.addcmul_(bend, hit.z, value=pull) if curvature else ahead
    return Rays(hit.x, hit.y, hit.z, dx, dy, dz), q, q2


def fresnel_transmittance(q_before: Tensor, q_after: Tensor, before: Medium, after: Medium) -> Tensor:
    """Unpolarised power transmitted by a bare surface, (Ts + Tp) / 2 in [0, 1], shape [N] (Born and Wolf, 1.5.2).

    `q_before` and `q_after` are n cos i and n' cos t. Lossless media: T = 1 - R.
    """
    r_s = (q_before - q_after) / (q_before + q_after)
    p_before, p_after = times(q_before, after.n2), times(q_after, before.n2)
    r_p = (p_before - p_after) / (p_before + p_after)
    return 1 - 0.5 * (r_s * r_s + r_p * r_p)
