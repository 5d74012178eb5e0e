"""Where a ray meets a sphere or a plane and how it bends there, and the tests that it passes on the way.

Pure functions on separate x, y, z tensors [N]. Directions in here are optical direction cosines: unit vectors times the
refractive index of the medium, p = n d, for which Snell's law needs no division (p after = p before + a multiple of the
normal). `sense` is +1 for rays travelling from the scene to the film (+z) and -1 for camera rays. Coordinates are
relative to the surface's vertex. Formulas: Spencer and Murty 1962, "General Ray-Tracing Procedure", in the form that
needs no division by dz and gives the cosine of incidence for free; optical direction cosines as in Welford 1986,
"Aberrations of Optical Systems", ch. 4.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neurolens.base import status as st


def positive(value: Tensor, sense: int = 1, *, spend: bool = False) -> Tensor:
    """Whether value * sense > 0, [N]; NaN is not. With `spend` as 1.0 and 0.0 in the place of `value` itself.

    Comparisons that give truth values are not vectorised on CPUs and cost five times as much as those in place; only
    for values that are not used afterwards, and never where gradients are wanted.
    """
    if not spend:
        return value > 0 if sense > 0 else value < 0
    return value.gt_(0) if sense > 0 else value.lt_(0)


def at_most(value: Tensor, limit: float, *, spend: bool = False) -> Tensor:
    """Whether value <= limit, [N]; NaN is not. `spend` as for `positive`."""
    return value.le_(limit) if spend else value <= limit


def also(first: Tensor, second: Tensor) -> Tensor:
    """Both tests passed, [N]; spends `first` where tests are 1.0 and 0.0."""
    return first.mul_(second) if first.is_floating_point() else first & second


def choose(test: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """`yes` where the test passed, else `no`, [N]. Of a test in numbers a mixture, for which both must be finite."""
    return torch.lerp(no, yes, test) if test.is_floating_point() else torch.where(test, yes, no)


class Labels:
    """The tests at each surface (met, inside the rim, not totally reflected), in the order in which they are called.

    The first failure decides. A ray goes on until it misses a surface or is totally reflected; one that a rim stops
    goes on, too, since surrogates are fitted to its crossings. This form keeps one label per ray: few instructions
    for a compiler, and gradients can be taken through it. `Counts` has the same methods.
    """

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        """Start with the rays that are `sound` [N] boolean; the others have the status `otherwise`."""
        self._status = (~sound).to(torch.int32) * otherwise
        self._goes_on = sound

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        """Apply the next test; `passed` is [N], boolean (in `Counts` 1.0 and 0.0, too)."""
        self._status = torch.where(passed | (self._status != 0), self._status, st.blocked(surface, reason))
        if reason != st.RIM:
            self._goes_on = self._goes_on & passed

    def end(self, sound: Tensor) -> None:
        """End rays that are not `sound` [N] boolean, whatever their status."""
        self._goes_on = self._goes_on & sound

    def only(self, value: Tensor, otherwise: float) -> Tensor:
        """`value` [N] of the rays that go on, `otherwise` for the others, even where it is NaN."""
        return torch.where(self._goes_on, value, otherwise)

    def passed(self) -> Tensor:
        """Whether every test so far was passed, [N]: boolean (of `Counts` 1.0 and 0.0)."""
        return self._status == 0

    def status(self) -> Tensor:
        """Status of every ray, [N] int32; see `neurolens.base.status`."""
        return self._status


class Counts:
    """How many tests a ray passed before its first failure, in numbers throughout: truth values, selections and
    conversions between them cost more than all the optics."""

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        """Start with the rays that are `sound` [N], 1.0 or 0.0; the others have the status `otherwise`."""
        self._alive, self._goes_on = sound.clone(), sound.clone()
        self._count = sound.clone()
        self._meanings = [otherwise]
        self._mask: Tensor | None = None

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        passed = passed.to(self._alive.dtype)
        self._alive.mul_(passed)
        self._count.add_(self._alive)
        self._meanings.append(st.blocked(surface, reason))
        if reason != st.RIM:
            self._goes_on.mul_(passed)
            self._mask = None

    def end(self, sound: Tensor) -> None:
        self._goes_on.mul_(sound)
        self._mask = None

    def only(self, value: Tensor, otherwise: float) -> Tensor:
        bits = torch.int32 if value.dtype == torch.float32 else torch.int64
        if self._mask is None:
            self._mask = self._goes_on.to(bits).neg_()
        # All bits or none: unlike a product with 0, this removes NaN.
        kept = value.view(bits).bitwise_and(self._mask).view(value.dtype)
        return kept if otherwise == 0 else kept.add_(1 - self._goes_on, alpha=otherwise)

    def passed(self) -> Tensor:
        return self._alive

    def status(self) -> Tensor:
        return _table((*self._meanings, st.PASSED), self._count.device).index_select(0, self._count.int())


Survival = Labels | Counts


@lru_cache(maxsize=256)
def _table(meanings: tuple[int, ...], device: torch.device) -> Tensor:
    """Cached: transferring it with every chunk would make the host wait for an accelerator."""
    return torch.tensor(meanings, dtype=torch.int32, device=device)


class Rays(NamedTuple):
    """Rays as a structure of arrays, each [N]: a point (mm) and a direction (unit, or times the index in here)."""

    x: Tensor
    y: Tensor
    z: Tensor
    dx: Tensor
    dy: Tensor
    dz: Tensor


class Mode(NamedTuple):
    """How to trace: direction of travel (+1 to the film), whether lost rays stay finite on the way, whether they are
    put on the axis at once (for gradients)."""

    sense: int
    guard: bool
    freeze: bool

    @property
    def spend(self) -> bool:
        """Whether tests may overwrite the numbers they test: where they are not used again, outside a compiler."""
        return not self.guard and not torch.compiler.is_compiling()


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
    """Square root; with `guard`, 1 instead of NaN (or of an infinite derivative) where there is none."""
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


def intersect_sphere(r: Rays, curvature: Any, mode: Mode, before: Medium, entering: bool) -> Hit:
    """Meet a sphere of signed curvature (1/mm) at the root next to the vertex.

    `entering` marks the first surface met, where rays may arrive at more than 90 degrees. Rays without a meeting are
    NaN, but finite where the mode guards.
    """
    sense, guard, spend = mode.sense, mode.guard, mode.spend
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
    # In place where the nearest approach is not used again: a third less memory to move.
    add = Tensor.addcmul_ if spend else torch.addcmul
    x, y, z = add(mx, t, r.dx), add(my, t, r.dy), add(mz, t, r.dz)
    if entering:
        # A general ray may meet the far half of the sphere, where there is no glass.
        met = met & (z * curvature <= 1)
    return Hit(x, y, z, q, q2, met)


def intersect_plane(r: Rays, mode: Mode) -> Hit:
    """Meet the plane z = 0; a ray that does not travel along `sense` misses it."""
    sense, guard, spend = mode.sense, mode.guard, mode.spend
    q = r.dz * sense
    met = positive(q.clone() if spend else q, spend=spend)
    t = r.z / (torch.where(met, r.dz, float(sense)) if guard else r.dz)
    x = torch.addcmul(r.x, t, r.dx, value=-1)
    y = torch.addcmul(r.y, t, r.dy, value=-1)
    return Hit(x, y, torch.zeros_like(r.z), q, r.dz * r.dz, met)


def refract(
    r: Rays, hit: Hit, curvature: Any, mode: Mode, before: Medium, after: Medium
) -> tuple[Rays, Tensor, Tensor]:
    """Snell's law: the tangential part of the optical direction cosines stays, the normal part follows their length.

    Returns the refracted rays (vertex frame), n' times the cosine of refraction [N], and the square of that before
    guarding, which is not positive where the ray is totally reflected.
    """
    step = after.n2 - before.n2
    sense, q2 = mode.sense, hit.q2 + step
    q = root(q2, mode.guard)
    if q.dtype == torch.float32:
        # q - hit.q without the rounding of both roots, which was a third of all error. Lost rays may have hit.q < 0.
        bend = step / (q + (hit.q.abs() if mode.guard else hit.q))
    else:
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
