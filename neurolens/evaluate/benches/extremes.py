"""Numerics at the extremes: float32 against float64, and float64 against 50 digits, as a table.

Both precisions trace the same rays: each ray is rounded to float32 first, and its direction made unit again in float64.
Where the two disagree on what ends a ray, the ray must pass an edge (a rim, the end of a sphere, the critical angle)
more closely than float32 can tell: some ray within the case's tolerance of it has, in float64, the status that float32
gave. The tolerance is what float32 itself shows on the passing rays of the case: their largest errors of position and
of direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.evaluate.benches.extreme_cases import Case
from neurolens.evaluate.benches.reference import trace_reference
from neurolens.optics import glass
from neurolens.optics.trace import Rays, Traced, trace

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
    return st.surface_of(a) == st.surface_of(b) is not None and {st.reason_of(a), st.reason_of(b)} == {
        st.MISSED,
        st.RIM,
    }


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
    """What may never happen, in words: numbers that are none, statuses that differ away from any edge."""
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


def to_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows as plain tables."""
    return [asdict(r) for r in rows]


_HEAD = "case|rays|pass|float32: mm|of the size|rad|status differs within|beyond|NaN|float64: mm|rad|status differs"
_NOTES = """\
Largest errors over the rays that pass. float32 is held against float64 on the same rays (rounded to float32 first):
mm at the last surface, the same over the largest coordinate that occurs, and rad of the direction. A status may differ
only within the tolerance of an edge, which is the case's own float32 error, or four units in the last place of its
largest coordinate. float64 is held against 50 decimal digits on a few rays a case. NaN counts every number of every
result that is not finite."""


def page(rows: Sequence[Row], bad: Sequence[str]) -> str:
    """The whole page: notes, totals, what failed, and a table a group in Markdown."""
    rays, within = sum(r.rays for r in rows), sum(r.within for r in rows)
    beyond, nan, exact = (sum(getattr(r, k) for r in rows) for k in ("beyond", "not_finite", "exact_status"))
    totals = (
        f"{len(rows)} cases, {rays:,} rays in each precision: {within} statuses differ within tolerance of an edge, "
        f"{beyond} beyond; {nan} numbers not finite; {exact} of {sum(r.exact_rays for r in rows)} rays have another "
        "status with 50 digits."
    )
    parts = ["# Numerics at the extremes", "`neurolens bench extremes`", _NOTES, totals, *(f"FAILED: {b}" for b in bad)]
    return "\n\n".join(parts) + "\n" + table(rows)


def table(rows: Sequence[Row]) -> str:
    """The rows as tables in Markdown, one a group."""
    lines: list[str] = []
    for group in dict.fromkeys(r.group for r in rows):
        lines += [f"\n## {group}\n", f"| {_HEAD.replace('|', ' | ')} |", "|---" * (_HEAD.count("|") + 1) + "|"]
        for r in (r for r in rows if r.group == group):
            shown = f"{r.position_mm:.1e} | {r.relative:.1e} | {r.angle_rad:.1e}"
            counts = f"{r.within} | {r.beyond} | {r.not_finite}"
            fine = f"{r.exact_mm:.1e} | {r.exact_rad:.1e} | {r.exact_status}"
            lines.append(f"| {r.name} | {r.rays} | {r.passed} | {shown} | {counts} | {fine} |")
    return "\n".join(lines) + "\n"
