"""One surface: where a ray meets it, the tests that it passes there, and how it is bent or reflected.

Written once, for tensors, numpy arrays and graphs (`arithmetic`), and used for the lens in both directions and for
ghosts. Directions in here are optical direction cosines: unit vectors times the refractive index of the medium,
p = n d, for which Snell's law needs no division (p after = p before + a multiple of the normal). `sense` is +1 for rays
that travel from the scene to the film (+z) and -1 for camera rays. Coordinates are relative to the surface's vertex.

Formulas: Spencer and Murty 1962, "General Ray-Tracing Procedure", in the form that needs no division by dz and gives
the cosine of incidence for free; optical direction cosines as in Welford 1986, "Aberrations of Optical Systems", ch. 4.
Spheres, conics and cylinders are met in closed form. An asphere is met by an iteration of Newton's kind along the ray,
started from the quadric that fits best; started at the vertex plane it fails beyond about 55 degrees.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.optics.lens import glass, prescription
from neurolens.optics.lens.placement import CENTRED
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.arithmetic import NUMPY, TINY, Arithmetic, is_number, times
from neurolens.optics.trace.shapes import (
    STEEPEST,
    Curve,
    Quadric,
    crossed,
    curve_of,
    depth,
    height2,
    is_deep,
    rim_sine,
    sag_and_derivatives,
    without_rim,
)

Array = NDArray[np.float64]

# A test (low, high) is passed where low is at most high; NaN passes none.
Test = tuple[Any, Any]


Towards = Literal["scene", "film"]  # where rays travel: camera rays to the scene, light to the film


class Rays(NamedTuple):
    """Rays as arrays [N] of points (mm) and directions, which are unit or, in this module, times the index."""

    x: Any
    y: Any
    z: Any
    dx: Any
    dy: Any
    dz: Any


class Medium(NamedTuple):
    """A refractive index, its square and the inverse of the square: numbers, or [N] where dispersive."""

    n: Any
    n2: Any
    inverse_n2: Any


AIR = Medium(1.0, 1.0, 1.0)
UNIT_SLACK = 1e-3  # how far a direction's squared length may be from 1; float32 rounding is a thousandth of it
_FARTHEST = 1e6  # largest parameter of a meeting along its ray, counted from the point nearest to the vertex


class Hit(NamedTuple):
    """The intersection of rays with a surface, each [N].

    Attributes:
        x, y, z: the point.
        q: index times cosine of incidence.
        q2: its square; positive where the ray meets the surface, and elsewhere, with guards, a smooth measure of how
            far the ray misses it.
        tests: a ray meets the surface where it passes all of them.
        normal: unit normal towards +z; None for a sphere or plane, whose curvature gives it (`normal_at`).
    """

    x: Any
    y: Any
    z: Any
    q: Any
    q2: Any
    tests: list[Test]
    normal: Quadric | None = None


class Outgoing(NamedTuple):
    """Rays behind a surface, in its vertex frame.

    Attributes:
        rays: points, and directions times the index.
        q: n' times the cosine of refraction.
        q2: its square, which is not positive where rays are totally reflected.
        tests: the test for total reflection.
    """

    rays: Rays
    q: Any
    q2: Any
    tests: list[Test]


def medium(n: Any) -> Medium:
    """Return the medium of index `n`, a number or a value."""
    n2 = n * n
    return Medium(n, n2, 1 / n2)


def media(lens: Lens, wavelength_nm: Any) -> list[Medium]:
    """Return the media from the scene to the film; that at place k lies before surface k.

    Where the medium does not change, it is the same object.

    Args:
        wavelength_nm: number or [N]; a dispersive medium has its shape.
    """
    known: dict[Any, Medium] = {"air": AIR}
    for s in lens.media:
        if _medium_key(s) not in known:
            known[_medium_key(s)] = medium(glass.index_of(s, wavelength_nm))
    return [known[_medium_key(s)] for s in lens.media]


def _medium_key(s: Surface | prescription.Medium) -> Any:
    if s.glass is None and s.V_d is None and is_number(s.n_d) and s.n_d == 1:
        return "air"
    return (s.glass, None if s.glass else (float(s.n_d) if is_number(s.n_d) else id(s.n_d)), s.V_d)


def nearest_approach(o: Arithmetic, r: Rays, inverse_n2: Any) -> Quadric:
    """Return the point of a ray nearest to the vertex: with such small coordinates float32 is good to micrometres."""
    e = times(o.dot(r[:3], r[3:]), inverse_n2)
    return o.fma(e, r.dx, r.x, -1), o.fma(e, r.dy, r.y, -1), o.fma(e, r.dz, r.z, -1)


def meet(o: Arithmetic, r: Rays, curve: Curve, sense: int, before: Medium, entering: bool = False) -> Hit:
    """Find where rays meet a surface, of several points the one next to its vertex.

    Args:
        entering: whether it is the first surface met, where rays may arrive at more than 90 degrees.
    """
    if curve.flat:
        return _meet_plane(o, r, sense)
    nearest = nearest_approach(o, r, before.inverse_n2)
    if curve.plain:
        return _meet_sphere(o, r, nearest, curve.curvature, sense, before, entering)
    if curve.start is not None:
        return _meet_asphere(o, r, nearest, curve, sense, before)
    return _meet_conic(o, r, nearest, curve, sense, before)


def _meet_plane(o: Arithmetic, r: Rays, sense: int) -> Hit:
    q = times(r.dz, sense)
    t = r.z / o.positive(q)
    x, y = (o.fma(t, d, a, -sense) for d, a in ((r.dx, r.x), (r.dy, r.y)))
    return Hit(x, y, o.like(r.z, 0.0), q, r.dz * r.dz, [(TINY, q)])


def _meet_sphere(o: Arithmetic, r: Rays, m: Quadric, curvature: Any, sense: int, before: Medium, entering: bool) -> Hit:
    c = times(curvature, sense)
    f = o.fma(m[2], -2.0 * sense, o.dot(m, m) * c)
    q2 = o.fma(f, before.n2, r.dz * r.dz, times(c, -1))
    q = o.root(q2)
    if not entering:
        denominator = o.fma(r.dz, sense, q)
        t = f / o.positive(denominator)
        x, y, z = (o.add_to(a, t, d) for a, d in zip(m, r[3:], strict=True))
        # A root that is NaN fails the test of the denominator too.
        return Hit(x, y, z, q, q2, [(TINY, denominator), *([(TINY, q2)] if o.guard else [])])
    # Beyond 90 degrees the usual form is a quotient of two vanishing numbers, where the conjugate form is exact.
    forward = times(r.dz, sense)
    conjugate = times(forward - q, before.inverse_n2) / (c if is_number(c) else o.nonzero(c))
    t = o.select(forward, 0.0, conjugate, f / o.select(forward, 0.0, 1.0, forward + q))
    x, y, z = _along(o, m, t, r)
    # Any other ray may meet the far half of the sphere, where there is no glass.
    return Hit(x, y, z, q, q2, [(TINY, q2), (times(z, curvature), 1.0)])


def _meet_conic(o: Arithmetic, r: Rays, m: Quadric, curve: Curve, sense: int, before: Medium) -> Hit:
    c = curve.curvature
    kind = (c * curve.bent[0], c * curve.bent[1], c * curve.stretch)
    q2, denominator, t = _meet_quadric(o, r, m, kind, sense, before)
    x, y, z = _along(o, m, t, r)
    nx, ny, nz = times(x, -kind[0]), times(y, -kind[1]), o.fma(z, -kind[2], 1.0)
    scale = o.inverse_root(o.dot((nx, ny, nz), (nx, ny, nz)))
    tests = [(TINY, q2), (TINY, denominator * denominator), (TINY, nz)]
    return Hit(x, y, z, o.root(q2) * scale, q2 * scale * scale, tests, (nx * scale, ny * scale, nz * scale))


def _meet_quadric(o: Arithmetic, r: Rays, m: Quadric, c: Quadric, sense: int, before: Medium) -> tuple[Any, Any, Any]:
    """Find where rays meet cx x^2 + cy y^2 + cz z^2 = 2 z, at the root next to the vertex.

    Returns:
        The square of the left side's derivative along the ray, which is positive where there is a root; the divisor of
        the ray's parameter; and this parameter, counted from the ray's nearest approach `m`.
    """
    p, (cx, cy, cz) = (r.dx, r.dy, r.dz), c
    if cx is cy or (is_number(cx) and is_number(cy) and cx == cy):
        # For a surface of revolution, p.p = n^2 and m.p = 0 simplify the terms.
        a = o.fma(p[2] * p[2], cz - cx, times(before.n2, cx))
        b = p[2] * o.fma(m[2], cz - cx, -1.0)
        f = o.fma(o.dot(m[:2], m[:2]), cx, m[2] * o.fma(m[2], cz, -2.0))
    else:
        a, b, f = _weighted(o, p, p, c), _weighted(o, m, p, c) - r.dz, o.fma(m[2], -2.0, _weighted(o, m, m, c))
    q2 = o.fma(a, f, b * b, -1)
    q, back = o.held_root(q2), times(b, -sense)
    # Two forms of the same root: the one is taken whose divisor is not small.
    denominator = o.select(back, 0.0, a, o.fma(q, sense, -b))
    numerator = o.select(back, 0.0, o.fma(q, -sense, -b), f)
    return q2, denominator, numerator / o.nonzero(denominator)


def _weighted(o: Arithmetic, a: Sequence[Any], b: Sequence[Any], w: Sequence[Any]) -> Any:
    """Return the sum of two vectors' products, each times its weight; terms of weight 0 are left out."""
    total: Any = None
    for p, q, k in zip(a, b, w, strict=True):
        if not (is_number(k) and k == 0):
            total = times(p * q, k) if total is None else o.fma(p, q, total, k)
    return o.like(a[0], 0.0) if total is None else total


def _along(o: Arithmetic, m: Quadric, t: Any, r: Rays) -> Quadric:
    return o.fma(t, r.dx, m[0]), o.fma(t, r.dy, m[1]), o.fma(t, r.dz, m[2])


def _meet_asphere(o: Arithmetic, r: Rays, m: Quadric, curve: Curve, sense: int, before: Medium) -> Hit:
    """Find where rays meet an asphere by an iteration along them, from the quadric that fits it best.

    Only the last step carries the derivative (by the implicit function theorem), so that gradients need no memory for
    the iterations.
    """
    assert curve.start is not None
    still = Rays(*(o.fixed(v) for v in r))
    nearest = (o.fixed(m[0]), o.fixed(m[1]), o.fixed(m[2]))
    with o.constant():
        missed, _, t = _meet_quadric(o, still, nearest, curve.start, sense, Medium(*(o.fixed(v) for v in before)))
        for n in range(curve.steps + o.polish - 1):
            step = _toward(o, _along(o, nearest, t, still), still, curve, sense)
            if n == curve.steps - 1:
                deciding = step
            t = t + step
        if o.guard:
            t = o.select(o.abs(t), _FARTHEST, t, 0.0)  # rays that meet nothing must give no NaN in the normal
    at = _along(o, m, o.fixed(t), r)
    step, p = _last_step(o, at, r, curve), (r.dx, r.dy, r.dz)
    x, y, z = _along(o, at, step, r)
    if curve.across:
        _, (nx, ny, nz), _, exists = crossed(o, curve, (x, y, z), p)
        scale = times(o.inverse_root(o.dot((nx, ny, nz), (nx, ny, nz))), -1)
        q = o.dot((nx, ny, nz), p) * times(scale, sense)
    else:
        _, slope, _, exists = depth(o, curve, height2(o, curve, x, y), order=1)
        nx, ny = (v * -slope if bent else o.like(v, 0.0) for v, bent in zip((x, y), curve.bent, strict=True))
        scale = o.inverse_root(o.fma(ny, ny, o.fma(nx, nx, 1.0)))
        nz, q = 1.0, o.fma(ny, r.dy, o.fma(nx, r.dx, r.dz)) * times(scale, sense)
    length = times(o.abs(deciding if o.polish else step), before.n)
    tests = [(length, curve.last_step), (TINY, q)]
    if exists is not None:
        tests.append((STEEPEST, exists))
    # How far a ray misses is of use only where crossings are learnt from.
    q2 = q * q
    if o.guard:
        for low, high in tests:
            q2 = o.select(low, high, q2, o.least(missed, -q * q))
    return Hit(x, y, z, q, q2, tests, (nx * scale, ny * scale, times(scale, nz)))


def _toward(o: Arithmetic, at: Quadric, r: Rays, curve: Curve, sense: int) -> Any:
    """Return Euler's step along the rays towards sag(x, y) = z: Newton's step that allows for the surface's bend.

    Newton's own step gets lost where a ray all but touches the surface, for two meetings lie close together there; the
    parabola of Euler's step has both.
    """
    p, (x, y, z) = (r.dx, r.dy, r.dz), at
    if curve.across:
        value, gradient, bend, _ = crossed(o, curve, at, p)
        rate, lack = o.dot(gradient, p), 2.0 * value
    else:
        sag, slope, turn, _ = depth(o, curve, height2(o, curve, x, y), order=2)
        bent = (*map(float, curve.bent), 0.0)
        along = _weighted(o, at, p, bent)
        rate = o.fma(slope, along, -r.dz)
        # Second derivative of the sag along the ray, without what the polynomial adds to the change of its slope.
        bend = o.fma(along * along, turn, slope * _weighted(o, p, p, bent))
        lack = 2.0 * (sag - z)
    root = o.held_root(o.fma(bend, lack, rate * rate, -1))
    return lack / times(o.fma(rate, -sense, root), sense)


def _last_step(o: Arithmetic, at: Quadric, r: Rays, curve: Curve) -> Any:
    """Return Newton's step, which equals Euler's so close to the meeting."""
    if curve.across:
        value, gradient, *_ = crossed(o, curve, at, (r.dx, r.dy, r.dz))
        return -value / o.nonzero(o.dot(gradient, r[3:]))
    sag, slope, *_ = depth(o, curve, height2(o, curve, at[0], at[1]), order=0)
    along = _weighted(o, at, r[3:], (*map(float, curve.bent), 0.0))
    return (at[2] - sag) / o.nonzero(o.fma(slope, along, -r.dz))


def normal_at(o: Arithmetic, met: Hit, curvature: Any) -> Quadric:
    """Return the unit normal towards +z at a meeting point; for spheres and planes it follows from the curvature."""
    if met.normal is not None:
        return met.normal
    return met.x * -curvature, met.y * -curvature, 1.0 - met.z * curvature


def refract(
    o: Arithmetic, r: Rays, met: Hit, curvature: Any, sense: int, before: Medium, after: Medium, step: Any = None
) -> Outgoing:
    """Refract rays by Snell's law: the tangential part of their directions stays, the normal part makes up the length.

    Directions are optical direction cosines.

    Args:
        step: n'^2 - n^2, where it is known better than from the media.
    """
    step = after.n2 - before.n2 if step is None else step
    q2 = met.q2 + step
    q = o.root(q2, o.finite)
    # This is q - met.q without the rounding of both roots, which was a third of all error in float32.
    bend = step / o.positive(q + met.q)
    if met.normal is not None:
        direction = [o.fma(bend, n, p, sense) for p, n in zip(r[3:], met.normal, strict=True)]
    else:
        pull = times(curvature, -sense)
        direction = [
            o.fma(bend, met.x, r.dx, pull), o.fma(bend, met.y, r.dy, pull),
            o.add_to(o.fma(bend, sense, r.dz), bend, met.z, pull),
        ]  # fmt: skip
    if after is AIR and not o.polish:
        # The rounding of dz changes the length of a direction, and long gaps multiply that change: in float32 it was
        # nearly all error of a telephoto. In air, where the length is 1, dz makes up for it, exactly so along the axis.
        excess = o.dot(direction, direction) - 1.0
        # Lost rays have any length, and guards keep them finite.
        change = o.select(o.abs(excess), UNIT_SLACK, excess, 0.0) if o.guard else excess
        direction[2] = o.fma(change, -0.5 * sense, direction[2])
    # Light from air is never totally reflected.
    return Outgoing(Rays(*met[:3], *direction), q, q2, [] if before is AIR else [(TINY, q2)])


def reflect(o: Arithmetic, r: Rays, met: Hit, curvature: Any, sense: int) -> Rays:
    """Return the rays with the normal part of their directions reversed."""
    normal = normal_at(o, met, curvature)
    return Rays(*met[:3], *(o.fma(met.q, n, p, -2 * sense) for p, n in zip(r[3:], normal, strict=True)))


def through_ideal(o: Arithmetic, r: Rays, met: Hit, power: float) -> Rays:
    """Return rays in air behind an ideal thin lens of power 1 / f: slopes change by -x / f and -y / f."""
    towards = o.abs(r.dz) * power
    dx, dy = o.fma(towards, met.x, r.dx, -1), o.fma(towards, met.y, r.dy, -1)
    scale = o.inverse_root(o.dot((dx, dy, r.dz), (dx, dy, r.dz)))
    return Rays(*met[:3], dx * scale, dy * scale, r.dz * scale)


class SurfaceStep(NamedTuple):
    """The passage of rays through a surface.

    Attributes:
        met: where they meet it.
        bent: the rays behind it, in its vertex frame.
        tests: all tests at the surface in order, each with the reason that it stands for (`base.status`).
        own: the meeting in the surface's own frame; another one than `met` where the surface is moved or turned.
    """

    met: Hit
    bent: Outgoing
    tests: list[tuple[list[Test], int]]
    own: Hit


def cross(
    o: Arithmetic,
    surface: Surface,
    curve: Curve,
    r: Rays,
    sense: int,
    before: Medium,
    after: Medium,
    *,
    entering: bool = False,
    reflected: bool = False,
    rim: Callable[[Hit], list[Test]] | None = None,
) -> SurfaceStep:
    """Take rays through a surface, or back from it where they are `reflected`; `rim` replaces the tests of the rim.

    Rays are relative to the place on the axis where the vertex of a centred surface is, and parallel to the lens's
    axes.
    """
    if surface.placement:
        centred, p = replace(surface, placement=CENTRED), surface.placement
        moved = [a - m if m else a for a, m in zip(r[:3], p.moved_mm, strict=True)]
        rays = Rays(*_turned(p.axes.T, moved), *_turned(p.axes.T, r[3:]))
        step = cross(o, centred, curve, rays, sense, before, after, entering=entering, reflected=reflected, rim=rim)
        normal = _turned(p.axes, normal_at(o, step.own, curve.curvature))
        place = [a + m if m else a for a, m in zip(_turned(p.axes, step.own[:3]), p.moved_mm, strict=True)]
        x, y, z = place
        met = step.own._replace(x=x, y=y, z=z, normal=(normal[0], normal[1], normal[2]))
        bent = step.bent._replace(rays=Rays(*place, *_turned(p.axes, step.bent.rays[3:])))
        return SurfaceStep(met, bent, step.tests, step.own)
    met = meet(o, r, curve, sense, before, entering)
    tests = [(met.tests, st.MISSED), ((rim or rim_tests(o, surface))(met), st.RIM)]
    if reflected:
        return SurfaceStep(met, Outgoing(reflect(o, r, met, curve.curvature, sense), met.q, met.q2, []), tests, met)
    if surface.figure.power:
        bent = Outgoing(through_ideal(o, r, met, surface.figure.power), met.q, met.q2, [])
    elif before is after:
        bent = Outgoing(Rays(*met[:3], *r[3:]), met.q, met.q2, [])
    else:
        bent = refract(o, r, met, curve.curvature, sense, before, after)
    return SurfaceStep(met, bent, [*tests, (bent.tests, st.TOTAL_REFLECTION)], met)


def _turned(axes: Array, vector: Sequence[Any]) -> list[Any]:
    """Return the products of a matrix [3, 3] with vectors of tensors, arrays or values; terms of 0 are left out."""
    found = []
    for row in axes:
        terms = [times(v, float(m)) for v, m in zip(vector, row, strict=True) if m]
        found.append(sum(terms[1:], terms[0]))
    return found


def rim_tests(o: Arithmetic, surface: Surface) -> Callable[[Hit], list[Test]]:
    """Return the function that tests whether a meeting lies inside a surface's rim."""
    if is_deep(surface):
        # Tested by depth: a point on the far half of the sphere may be near the axis, but there is no glass.
        most = 1 - math.sqrt(1 - rim_sine(surface) ** 2)
        return lambda met: [(times(met.z, surface.curvature), most)]
    return lambda met: [(radius2(o, met), surface.semi_diameter_mm**2)]


def radius2(o: Arithmetic, met: Hit) -> Any:
    """Return the squared distance of a meeting from the axis, mm^2."""
    return o.dot(met[:2], met[:2])


def meet_front(shape: Surface | None, lines: Rays) -> tuple[Array, Array]:
    """Return (x, y) where the line of each ray meets the front surface next to its vertex; NaN where it does not.

    Args:
        shape: the front surface; None is the plane z = 0.
        lines: float64 [N], of either sense.
    """
    # In front of the lens light travels towards +z, or comes from the side and beyond: the sense is that of the camera
    # ray's end.
    rays = Rays(*lines[:3], *(-d for d in lines[3:]))
    curve = Curve(0.0, plain=True) if shape is None else without_rim(curve_of(shape))
    with np.errstate(all="ignore"):
        met = meet(NUMPY, rays, curve, 1, AIR, entering=True)
        passed = np.logical_and.reduce([low <= high for low, high in met.tests])
        return np.where(passed, met.x, math.nan), np.where(passed, met.y, math.nan)


def front_rays(
    shape: Surface | None, lines: Rays, *, index: Sequence[float] | None = None, wavelength_nm: Array | float = math.nan
) -> tuple[Array, Array]:
    """Return scene rays in the form that models use, and the solid angle per area of their direction vectors [N].

    The form is [4, N]: x and y (mm) on the front surface, and the direction vector theta (dx, dy) / |(dx, dy)|, where
    theta is the angle to -z. First-order models, which have no shape, have the slope in its place.

    Args:
        shape: as for `meet_front`.
        lines: of scene rays, with unit directions away from the lens.
        index: given where direction vectors are those inside the front glass: its index as a power series in 1 /
            lambda^2 (1/um^2).
    """
    (x, y), (dx, dy, dz) = meet_front(shape, lines), lines[3:]
    with np.errstate(all="ignore"):
        if shape is None:
            return np.stack([x, y, dx / -dz, dy / -dz]), np.abs(dz) ** 3
        wider: Array | float = 1.0
        if index is not None:
            n = np.polyval(np.asarray(index)[::-1], (1000 / wavelength_nm) ** 2)
            (dx, dy, dz), wider = entered(shape, x, y, np.stack([dx, dy, dz]), n)
        sine = np.hypot(dx, dy)
        angle = np.arctan2(sine, -dz)
        ratio = np.where(sine > 1e-12, angle / sine, 1.0)
        return np.stack([x, y, ratio * dx, ratio * dy]), wider * np.where(angle > 1e-12, sine / angle, 1.0)


def entered(shape: Surface, x: Array, y: Array, d: Array, index: Array) -> tuple[Array, Array]:
    """Return the unit directions [3, N], inside the front glass, of rays that leave it at (x, y) along d [3, N].

    Also return the solid angle of a bundle of them outside over that inside, n^2 cos(inside) / cos(outside) [N].
    """
    _, zx, zy = sag_and_derivatives(shape, x, y)
    normal = np.stack([zx, zy, np.full_like(zx, -1.0)]) / np.sqrt(1 + zx * zx + zy * zy)
    cosine = (d * normal).sum(0)
    inner = np.sqrt(1 - (1 - cosine * cosine) / index**2)
    return d / index + normal * (inner - cosine / index), index**2 * inner / cosine
