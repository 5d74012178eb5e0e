"""Whether a prescription can be built: no rim beyond its sphere, no surfaces that pass through each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from neurolens.errors import InputError
from neurolens.optics.prescription import Surface

TOUCH_MM = 1e-6  # edge contact is common in patents; only rounding is forgiven


def sag_mm(radius_mm: float, height_mm: float) -> float:
    """Depth of a sphere at a height from the axis, relative to its vertex, towards +z; 0 for a plane.

    The form r^2 / (R (1 + sqrt(1 - r^2/R^2))) loses no digits where the sphere is nearly flat.
    """
    ratio = height_mm / radius_mm
    return height_mm * ratio / (1 + math.sqrt(1 - ratio * ratio))


def check_clearance(surfaces: Sequence[Surface], file: str, state: str = "") -> None:
    """Raise for a rim larger than its radius of curvature and for neighbours that overlap inside their rims.

    The gap between two spheres grows or shrinks steadily from the axis outwards, so that axis and the smaller of the
    two rims decide. Beside the stop only the rim counts: the stop's plane may lie inside the cap of an element; what
    stands on both sides of the stop must then be clear of each other.

    Args:
        state: words in front of the surface in messages, for a zoom state of the file.

    Raises:
        InputError: names the file, the surface and by how much.
    """
    for k, s in enumerate(surfaces):
        if s.semi_diameter_mm > abs(s.radius_mm):
            limit = f"at most twice the radius of curvature, {2 * abs(s.radius_mm):g} mm"
            raise InputError(file, f"{state}surface {k}, diameter_mm", s.diameter_mm, limit)
    for k, after, axis_gap_mm in _neighbours(surfaces):
        beside_stop = surfaces[k].stop or surfaces[after].stop
        if axis_gap_mm < -TOUCH_MM and not beside_stop:
            raise InputError(
                file, f"{state}surface {k}, thickness_mm", axis_gap_mm, "at least 0, except beside the stop"
            )
        rim_mm = min(surfaces[k].semi_diameter_mm, surfaces[after].semi_diameter_mm)
        gap_mm = axis_gap_mm + sag_mm(surfaces[after].radius_mm, rim_mm) - sag_mm(surfaces[k].radius_mm, rim_mm)
        if gap_mm < -TOUCH_MM:
            found = f"(an overlap of {-gap_mm:.4g} mm with surface {after}, {rim_mm:.4g} mm from the axis)"
            raise InputError(file, f"{state}surface {k}, thickness_mm", found, "surfaces that are clear of each other")


def _neighbours(surfaces: Sequence[Surface]) -> Iterator[tuple[int, int, float]]:
    """Pairs of surfaces that may collide, with the distance of their vertices; across the stop too."""
    for k in range(len(surfaces) - 1):
        yield k, k + 1, surfaces[k].thickness_mm
    for k in range(1, len(surfaces) - 1):
        if surfaces[k].stop and math.isinf(surfaces[k].radius_mm):
            yield k - 1, k + 1, surfaces[k - 1].thickness_mm + surfaces[k].thickness_mm
