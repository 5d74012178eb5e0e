"""Whether a prescription can be built: no rim beyond its sphere, no surfaces that pass through each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Surface

TOUCH_MM = 1e-6  # edge contact is common in patents; only rounding is forgiven


def sag_mm(radius_mm: float, height_mm: float) -> float:
    """Depth of a sphere at a height from the axis, relative to its vertex, towards +z; 0 for a plane.

    The form r^2 / (R (1 + sqrt(1 - r^2/R^2))) loses no digits where the sphere is nearly flat.
    """
    ratio = height_mm / radius_mm
    return height_mm * ratio / (1 + math.sqrt(1 - ratio * ratio))


def surface_sag_mm(surface: Surface, x_mm: float, y_mm: float) -> float:
    """Depth of any surface relative to its vertex, towards +z, at a point; NaN beyond the end of its conic."""
    h2 = (x_mm * x_mm if surface.cylinder != "y" else 0.0) + (y_mm * y_mm if surface.cylinder != "x" else 0.0)
    c = float(surface.curvature)
    under_root = 1 - (1 + float(surface.conic)) * c * c * h2
    if under_root < 0:
        return math.nan
    sag = c * h2 / (1 + math.sqrt(under_root))
    return sag + sum(float(a) * math.sqrt(h2) ** p for p, a in surface.asphere)


def end_mm(surface: Surface) -> float:
    """Distance from the axis at which a surface's conic ends: the radius of a sphere; inf where it goes on."""
    stretch = 1 + float(surface.conic)
    return abs(float(surface.radius_mm)) / math.sqrt(stretch) if stretch > 0 else math.inf


def check_clearance(surfaces: Sequence[Surface], file: str, state: str = "") -> None:
    """Raise for a rim larger than its radius of curvature and for neighbours that overlap inside their rims.

    The gap between two spheres grows or shrinks steadily from the axis outwards, so that axis and the smaller of the
    two rims decide; other shapes are looked at in between too. A stop that bends nothing (one medium on both sides) may
    lie inside an element, in front of which (or behind which) it is then listed; what stands on both sides of it must
    be clear of each other. A stop on a glass surface is a surface like any other.

    Args:
        state: words in front of the surface in messages, for a zoom state of the file.

    Raises:
        InputError: names the file, the surface and by how much.
    """
    for k, s in enumerate(surfaces):
        if s.semi_diameter_mm > end_mm(s):
            limit = f"at most {2 * end_mm(s):g} mm, where its {'conic' if s.conic else 'sphere'} ends"
            raise InputError(file, f"{state}surface {k}, diameter_mm", s.diameter_mm, limit)
    for k, after, axis_gap_mm in neighbours(surfaces):
        if axis_gap_mm < -TOUCH_MM:
            expected = "at least 0, except beside a stop with the same medium before and behind it"
            raise InputError(file, f"{state}surface {k}, thickness_mm", axis_gap_mm, expected)
        gap_mm, height_mm = _narrowest(surfaces[k], surfaces[after], axis_gap_mm)
        if gap_mm < -TOUCH_MM:
            found = f"(an overlap of {-gap_mm:.4g} mm with surface {after}, {height_mm:.4g} mm from the axis)"
            raise InputError(file, f"{state}surface {k}, thickness_mm", found, "surfaces that are clear of each other")


def _narrowest(before: Surface, after: Surface, axis_gap_mm: float) -> tuple[float, float]:
    """The smallest gap between two surfaces inside the smaller of their rims, and its distance from the axis, mm."""
    rim = min(before.semi_diameter_mm, after.semi_diameter_mm)
    spheres = all(not s.conic and not s.asphere and not s.cylinder for s in (before, after))
    steps = 1 if spheres else 32
    azimuths = [(1.0, 0.0), (0.0, 1.0)] if before.cylinder or after.cylinder else [(1.0, 0.0)]
    found = (axis_gap_mm, 0.0)
    for cos, sin in azimuths:
        for i in range(1, steps + 1):
            h = rim * i / steps
            x, y = h * cos, h * sin
            gap = axis_gap_mm + surface_sag_mm(after, x, y) - surface_sag_mm(before, x, y)
            found = min(found, (gap, h))
    return found


def neighbours(surfaces: Sequence[Surface]) -> Iterator[tuple[int, int, float]]:
    """Pairs of surfaces that may collide, a stop that bends nothing aside, with the distance of their vertices."""
    idle = [s.stop and _same_medium(surfaces, k) for k, s in enumerate(surfaces)]
    for k in range(len(surfaces) - 1):
        if not idle[k] and not idle[k + 1]:
            yield k, k + 1, surfaces[k].thickness_mm
    for k in range(1, len(surfaces) - 1):
        if idle[k] and math.isinf(surfaces[k].radius_mm):
            yield k - 1, k + 1, surfaces[k - 1].thickness_mm + surfaces[k].thickness_mm


def _same_medium(surfaces: Sequence[Surface], k: int) -> bool:
    """Whether a surface has the same medium before and behind it."""
    after = surfaces[k]
    if not k:
        return after.n_d == 1
    before = surfaces[k - 1]
    return (before.n_d, before.V_d, before.glass) == (after.n_d, after.V_d, after.glass)
