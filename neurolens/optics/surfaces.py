"""Where a ray meets a surface and how it bends there: pure functions on separate x, y, z tensors of shape [N].

`sense` is +1 for rays travelling from the scene to the film (+z) and -1 for camera rays. Coordinates are relative to
the surface's vertex. Formulas: Spencer and Murty 1962, "General Ray-Tracing Procedure", in the form that needs no
division by dz and gives the cosine of incidence for free.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor


class Rays(NamedTuple):
    """Rays as a structure of arrays, each [N]: a point (mm) and a unit direction."""

    x: Tensor
    y: Tensor
    z: Tensor
    dx: Tensor
    dy: Tensor
    dz: Tensor


class Hit(NamedTuple):
    """A meeting point, each [N].

    `discriminant` is the square of the cosine of incidence: positive where the ray meets the surface, and a smooth
    measure of how far it misses elsewhere. `met` is False where there is no meeting (NaN counts as none).
    """

    x: Tensor
    y: Tensor
    z: Tensor
    cos_i: Tensor
    discriminant: Tensor
    met: Tensor


def plus_times(a: Tensor, b: Tensor, k: Any) -> Tensor:
    """a + k b in one pass over memory where k is a number; k may be a tensor where gradients are wanted."""
    return a + b * k if isinstance(k, Tensor) else torch.add(a, b, alpha=k)


def _root(square: Tensor, guard: bool) -> Tensor:
    """Square root; with `guard`, 1 instead of NaN (or of an infinite slope) where there is none."""
    return torch.sqrt(torch.where(square > 0, square, 1.0)) if guard else torch.sqrt(square)


def intersect_sphere(r: Rays, curvature: Any, sense: int, entering: bool, guard: bool) -> Hit:
    """Meet a sphere of signed curvature (1/mm) at the root next to the vertex.

    Starts from the point of closest approach to the vertex: its coordinates stay small, which is what keeps float32
    to micrometres. `entering` marks the first surface met, where rays may arrive at more than 90 degrees. `guard`
    keeps rays without a meeting finite (for gradients and for crossings that are learnt from); without it they are NaN.
    """
    e = torch.addcmul(torch.addcmul(r.x * r.dx, r.y, r.dy), r.z, r.dz)
    mx = torch.addcmul(r.x, e, r.dx, value=-1)
    my = torch.addcmul(r.y, e, r.dy, value=-1)
    mz = torch.addcmul(r.z, e, r.dz, value=-1)
    m2 = torch.addcmul(torch.addcmul(mx * mx, my, my), mz, mz)
    f = plus_times(m2 * curvature, mz, -2.0)
    discriminant = plus_times(r.dz * r.dz, f, -curvature)
    cos_i = _root(discriminant, guard or entering)
    denominator = torch.add(r.dz, cos_i, alpha=sense)
    if entering:
        # Beyond 90 degrees the usual form divides two vanishing numbers; the conjugate form is exact there.
        met = discriminant > 0
        backwards = r.dz * sense <= 0
        conjugate = torch.sub(r.dz, cos_i, alpha=sense) / curvature
        t = torch.where(backwards, conjugate, f / torch.where(backwards, float(sense), denominator))
    elif guard:
        met = (discriminant > 0) & (denominator * sense > 0)
        t = f / torch.where(met, denominator, float(sense))
    else:
        # One comparison: NaN from a negative discriminant fails it too.
        met = denominator > 0 if sense > 0 else denominator < 0
        t = f / denominator
    x = torch.addcmul(mx, t, r.dx)
    y = torch.addcmul(my, t, r.dy)
    z = torch.addcmul(mz, t, r.dz)
    if entering:
        # A ray from anywhere may meet the far half of the sphere, where there is no glass.
        met = met & (z * curvature <= 1)
    return Hit(x, y, z, cos_i, discriminant, met)


def intersect_plane(r: Rays, sense: int) -> Hit:
    """Meet the plane z = 0; a ray that does not travel along `sense` misses it."""
    cos_i = r.dz * sense
    met = cos_i > 0
    t = r.z / torch.where(met, r.dz, float(sense))
    x = torch.addcmul(r.x, t, r.dx, value=-1)
    y = torch.addcmul(r.y, t, r.dy, value=-1)
    return Hit(x, y, torch.zeros_like(r.z), cos_i, r.dz * r.dz, met)


def refract(r: Rays, hit: Hit, curvature: Any, sense: int, mu: Any, guard: bool) -> tuple[Rays, Tensor, Tensor]:
    """Snell's law in vector form. `mu` is n_before / n_after (number or [N]).

    Returns the refracted rays (vertex frame), the cosine of refraction [N], and its square before guarding, which is
    not positive where the ray is totally reflected.
    """
    mu2 = mu * mu
    cos2_t = (
        torch.addcmul(1 - mu2, mu2, hit.discriminant) if isinstance(mu, Tensor) else hit.discriminant * mu2 + (1 - mu2)
    )
    cos_t = _root(cos2_t, guard)
    bend = cos_t - mu * hit.cos_i
    pull = bend * (curvature * sense)
    dx = torch.addcmul(mu * r.dx, pull, hit.x, value=-1)
    dy = torch.addcmul(mu * r.dy, pull, hit.y, value=-1)
    dz = torch.addcmul(torch.add(mu * r.dz, bend, alpha=sense), pull, hit.z, value=-1)
    return Rays(hit.x, hit.y, hit.z, dx, dy, dz), cos_t, cos2_t


def fresnel_transmittance(cos_i: Tensor, cos_t: Tensor, mu: Any) -> Tensor:
    """Unpolarised power transmitted by a bare surface, (Ts + Tp) / 2 in [0, 1], shape [N] (Born and Wolf, 1.5.2).

    `mu` is n_before / n_after. Lossless media: T = 1 - R.
    """
    r_s = (mu * cos_i - cos_t) / (mu * cos_i + cos_t)
    r_p = (cos_i - mu * cos_t) / (cos_i + mu * cos_t)
    return 1 - 0.5 * (r_s * r_s + r_p * r_p)
