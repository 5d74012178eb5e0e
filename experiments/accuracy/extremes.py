"""Errors of float32 from float64, and of float64 from 50 digits, at the ends of what optics allows.

f/0.6 to f/45, 220 degrees, radii from the semi-diameter to a plane, grazing rays, the critical angle, cemented equal
indices, near and far objects, every lens file, both ways.

Both precisions trace the same rays: each ray is rounded to float32 first, and its direction made unit again in float64.
Where the two disagree on what ends a ray, the ray must pass an edge (a rim, the end of a sphere, the critical angle)
more closely than float32 can tell: some ray within the case's tolerance of it has, in float64, the status that float32
gave. The tolerance is what float32 itself shows on the passing rays of the case: their largest errors of position and
of direction. Exit code 1 where a number is not finite or a status differs away from any edge.
Writes extremes.md and extremes.json.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from mpmath import mp, mpf, sqrt
from torch import Tensor

from experiments import lab
from experiments.accuracy.extreme_cases import Case, all_cases
from neurolens.base import status as st
from neurolens.optics.lens import glass
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import Rays, Traced, trace

EPS32 = 2.0**-23
_NEIGHBOURS = (256, 16384)  # rays tried within the tolerance of one in dispute; more where those do not settle it


@dataclass(frozen=True)
class Row:
    """One case, measured. Lengths in mm, angles in rad; errors are the largest over passing rays.

    Attributes:
        position_mm, angle_rad: float32 from float64, point on the last surface and direction after it.
        relative: position_mm over the largest coordinate of all rays' first and last points.
        within, beyond: rays whose statuses differ, within and beyond the tolerance of an edge.
        not_finite: numbers in all results, both precisions, that are NaN or infinite: none is allowed.
        exact_rays, exact_mm, exact_rad: rays traced with 50 digits, and float64's errors from them.
        exact_status: those that do not end the same way in float64 and with 50 digits.
    """

    group: str
    name: str
    rays: int
    passed: int
    position_mm: float
    relative: float
    angle_rad: float
    within: int
    beyond: int
    not_finite: int
    exact_rays: int
    exact_mm: float
    exact_rad: float
    exact_status: int


def measure(case: Case, exact_rays: int = 12) -> Row:
    """Trace one case in both precisions, and a few of its rays with 50 digits."""
    coarse_rays, fine_rays = both_precisions(case.rays)
    options = {"towards": case.towards, "transmittance": True}
    with torch.no_grad():
        coarse: Traced = trace(case.lens, coarse_rays, case.wavelength_nm, **options)  # type: ignore[arg-type]
        fine: Traced = trace(case.lens, fine_rays, case.wavelength_nm, **options)  # type: ignore[arg-type]
        passed = (fine.status == st.PASSED) & (coarse.status == st.PASSED)
        position, angle = _errors(coarse.rays, fine.rays, passed)
        scale = float(torch.stack((*fine_rays[:3], *fine.rays[:3])).abs().max())
        allowed = (max(position, 4 * EPS32 * scale), max(angle, 4 * EPS32))
        disputed = torch.nonzero(fine.status != coarse.status)[:, 0]
        beyond = sum(not _near_edge(case, fine_rays, int(i), int(coarse.status[i]), allowed) for i in disputed)
    results = (*coarse.rays, *fine.rays, coarse.transmittance, fine.transmittance)
    not_finite = sum(int((~torch.isfinite(c)).sum()) for c in results if c is not None)
    exact = _against_reference(case, fine_rays, fine, exact_rays)
    found = (int(passed.sum()), position, position / scale, angle, len(disputed) - beyond, beyond, not_finite)
    return Row(case.group, case.name, len(fine.status), *found, *exact)


def both_precisions(rays: Rays) -> tuple[Rays, Rays]:
    """The same rays in float32 and, from those, in float64 with unit directions."""
    coarse = Rays(*(c.to(torch.float32) for c in rays))
    fine = [c.to(torch.float64) for c in coarse]
    length = torch.sqrt(fine[3] ** 2 + fine[4] ** 2 + fine[5] ** 2)
    return coarse, Rays(*fine[:3], *(c / length for c in fine[3:]))


def _errors(a: Rays, b: Rays, chosen: Tensor) -> tuple[float, float]:
    """Largest distance of points (mm) and of directions (rad) among the chosen rays."""
    if not chosen.any():
        return 0.0, 0.0
    offset = torch.stack([(p.double() - q)[chosen] for p, q in zip(a, b, strict=True)])
    return float(offset[:3].norm(dim=0).max()), float(offset[3:].norm(dim=0).max())


def _near_edge(case: Case, rays: Rays, i: int, wanted: int, allowed: tuple[float, float]) -> bool:
    """Whether float64 gives the status `wanted` to some ray within the tolerances (mm, rad) of ray i."""
    g = torch.Generator().manual_seed(i)
    for count in _NEIGHBOURS:
        # Neighbours at all scales: what the tolerance allows may be far wider than what is needed.
        size = 10 ** (-6 * torch.rand(count, generator=g, dtype=torch.float64))
        shift = torch.randn((6, count), generator=g, dtype=torch.float64) * size
        shift[:3, 0::3] = 0  # some differ in direction alone, some in position alone
        shift[3:, 1::3] = 0
        near = [c[i] + s * a for c, s, a in zip(rays, shift, 3 * allowed[:1] + 3 * allowed[1:], strict=True)]
        length = torch.sqrt(near[3] ** 2 + near[4] ** 2 + near[5] ** 2)
        start = Rays(*near[:3], *(c / length for c in near[3:]))
        if (trace(case.lens, start, case.wavelength_nm, towards=case.towards).status == wanted).any():
            return True
    return False


def _same_end(a: int, b: int) -> bool:
    """Whether two statuses agree; beyond a sphere's edge a ray may be called a miss or blocked by the rim."""
    if a == b:
        return True
    return st.surface_of(a) == st.surface_of(b) is not None and {a % 4, b % 4} == {st.MISSED, st.RIM}


def _against_reference(case: Case, rays: Rays, fine: Traced, count: int) -> tuple[int, float, float, int]:
    """Rays compared with 50 digits, float64's largest errors in mm and rad, and the statuses that differ."""
    passed = torch.nonzero(fine.status == st.PASSED)[:, 0]
    blocked = torch.nonzero(fine.status != st.PASSED)[:, 0]
    chosen = [int(i) for i in (*passed[: count - count // 2], *blocked[: count // 2])]
    media = [1.0, *(float(glass.index_of(s, case.wavelength_nm)) for s in case.lens.surfaces)]
    position, angle, wrong = 0.0, 0.0, 0
    for i in chosen:
        exact = trace_reference(case.lens, [float(c[i]) for c in rays], media, case.towards)
        wrong += not _same_end(exact.status, int(fine.status[i]))
        if exact.point is None or exact.direction is None or exact.status != int(fine.status[i]):
            continue
        errors = [float(float(c[i]) - e) for c, e in zip(fine.rays, (*exact.point, *exact.direction), strict=True)]
        position, angle = max(position, math.hypot(*errors[:3])), max(angle, math.hypot(*errors[3:]))
    return len(chosen), position, angle, wrong


def failures(rows: Sequence[Row]) -> list[str]:
    """Violations as sentences: numbers that are not finite, statuses that differ away from any edge."""
    found = []
    for r in rows:
        where = f"{r.group}, {r.name}"
        if r.not_finite:
            found.append(f"{where}: {r.not_finite} numbers are not finite")
        if r.beyond:
            found.append(f"{where}: {r.beyond} rays change status away from any edge")
        if r.exact_status:
            found.append(f"{where}: {r.exact_status} of {r.exact_rays} rays have another status with 50 digits")
    return found


_NOTES = """\
Largest errors over the rays that pass. float32 is held against float64 on the same rays (rounded to float32 first):
mm at the last surface, the same over the largest coordinate that occurs, and rad of the direction. A status may differ
only within the tolerance of an edge, which is the case's own float32 error, or four units in the last place of its
largest coordinate. float64 is held against 50 decimal digits on a few rays per case. NaN counts every number of every
result that is not finite."""


_COLUMNS = lab.columns(
    ("case", "name"),
    ("rays", "rays"),
    ("pass", "passed"),
    ("float32: mm", "position_mm", ".1e"),
    ("of the size", "relative", ".1e"),
    ("rad", "angle_rad", ".1e"),
    ("status differs within", "within"),
    ("beyond", "beyond"),
    ("NaN", "not_finite"),
    ("float64: mm", "exact_mm", ".1e"),
    ("rad", "exact_rad", ".1e"),
    ("status differs", "exact_status"),
)


def page(rows: Sequence[Row], bad: Sequence[str]) -> str:
    """The whole page: notes, totals, what failed, and a table per group in Markdown."""
    keys = ("rays", "within", "beyond", "not_finite", "exact_status", "exact_rays")
    rays, within, beyond, nan, exact, exact_rays = (sum(getattr(r, k) for r in rows) for k in keys)
    totals = (
        f"{len(rows)} cases, {rays:,} rays in each precision: {within} statuses differ within tolerance of an edge, "
        f"{beyond} beyond; {nan} numbers not finite; {exact} of {exact_rays} rays have another status with 50 digits."
    )
    parts = ["# Numerics at the extremes", "`python -m experiments extremes`", _NOTES, totals]
    parts += [f"FAILED: {b}" for b in bad]
    for group in dict.fromkeys(r.group for r in rows):
        parts += [f"## {group}", lab.table(_COLUMNS, [r for r in rows if r.group == group])]
    return lab.page(*parts)


DIGITS = 50
Vector = tuple[Any, Any, Any]


@dataclass(frozen=True)
class ReferenceRay:
    """The end of one ray: point on the last surface (lens frame, mm), unit direction after it, and its status.

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
    """The weights of x^2 and y^2 in the squared height at which the sag is taken."""
    return (1, 0) if s.figure.axis == "x" else (0, 1) if s.figure.axis == "y" else (1, 1)


def _shape(s: Surface) -> tuple[Any, Any]:
    radius = mpf(float(s.radius_mm))
    return (mpf(0) if mp.isinf(radius) else 1 / radius), 1 + mpf(float(s.figure.conic))


def _meet(s: Surface, p: Vector, d: Vector, sense: int) -> Vector | None:
    """Meeting point in the vertex frame, where the ray crosses the surface from its own side; None without one."""
    t = _meet_conic(s, p, d, sense)
    if t is None:
        return None
    if s.figure.asphere:
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
    c, k1 = _shape(s)
    r = sqrt(u)
    polynomial = sum((mpf(float(a)) * r**power for power, a in s.figure.asphere), mpf(0))
    return c * u / (1 + sqrt(1 - k1 * c * c * u)) + polynomial


def _normal(s: Surface, q: Vector) -> Vector:
    """Gradient of sag(x, y) - z, not of unit length."""
    c, k1 = _shape(s)
    wx, wy = _weights(s)
    u = wx * q[0] ** 2 + wy * q[1] ** 2
    r = sqrt(u)
    # Slope over r, which stays finite on the axis but for a term of power 1.
    slope = c / sqrt(1 - k1 * c * c * u)
    slope += sum(
        (power * mpf(float(a)) * r ** (power - 2) for power, a in s.figure.asphere if r > 0 or power >= 2), mpf(0)
    )
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


OPTIONS = (lab.count("rays", 20000, "rays per case (default 20000)", 100), lab.out())


def run(args: argparse.Namespace) -> int:
    """Measure every case; 1 where there are violations."""
    lab.quiet_glasses()
    done = [measure(case) for case in lab.counted(all_cases(args.rays), "extremes", args.quiet)]
    bad = failures(done)
    print(lab.write_results(args.out, "extremes", page(done, bad), done))
    for line in bad:
        print(f"experiments: {line}", file=sys.stderr)
    return 1 if bad else 0
