"""Where rays from the scene meet the front surface, where surfaces end, and which of them touch.

Torch is not imported, as cameras without it use this module.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.trace.arithmetic import NUMPY
from neurolens.trace.shapes import Figure, Shape, curve_of, sag_and_derivatives, sag_mm, without_rim
from neurolens.trace.surfaces import AIR, Rays, meet

if TYPE_CHECKING:
    from neurolens.lens.prescription import Medium, Surface

Array = NDArray[np.float64]

TOUCH_MM = 1e-6  # edge contact is common in patents; only rounding is forgiven


def meet_front(
    shape: Shape | None, x: Array, y: Array, z: Array, dx: Array, dy: Array, dz: Array
) -> tuple[Array, Array]:
    """(x, y) where the line of each ray meets the front surface, None the plane z = 0, next to its vertex; else NaN.

    Rays are points (mm) and directions of either sense, float64 [N].
    """
    # Before the lens light travels towards +z, or from the side and beyond: the sense is that of the camera ray's end.
    rays = Rays(x, y, z, -dx, -dy, -dz)
    figure = Figure(0.0, plain=True) if shape is None else without_rim(curve_of(shape))
    with np.errstate(all="ignore"):
        met = meet(NUMPY, rays, figure, 1, AIR, entering=True)
        passed = np.logical_and.reduce([low <= high for low, high in met.tests])
        return np.where(passed, met.x, math.nan), np.where(passed, met.y, math.nan)


def front_rays(
    shape: Shape | None,
    x: Array,
    y: Array,
    z: Array,
    dx: Array,
    dy: Array,
    dz: Array,
    *,
    index: Sequence[float] | None = None,
    wavelength_nm: Array | float = math.nan,
) -> tuple[Array, Array]:
    """Scene rays as models have them, and the solid angle per area of their direction vectors [N].

    Rows [4, N]: x and y (mm) on the front surface, and the direction vector, theta (dx, dy) / |(dx, dy)| with theta
    from -z; of first-order models, which have no shape, the slope. Arguments as of `meet_front`, unit directions away
    from the lens. `index`: where direction vectors are those inside the front glass, its index as a power series in
    1 / lambda^2 (1/um^2).
    """
    x, y = meet_front(shape, x, y, z, dx, dy, dz)
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


def entered(shape: Shape, x: Array, y: Array, d: Array, index: Array) -> tuple[Array, Array]:
    """Unit directions [3, N] inside the front glass of rays that leave it at (x, y) along d [3, N].

    Also the solid angle of a bundle of them outside over that inside, n^2 cos(inside) / cos(outside) [N].
    """
    _, zx, zy = sag_and_derivatives(shape, x, y)
    normal = np.stack([zx, zy, np.full_like(zx, -1.0)]) / np.sqrt(1 + zx * zx + zy * zy)
    cosine = (d * normal).sum(0)
    inner = np.sqrt(1 - (1 - cosine * cosine) / index**2)
    return d / index + normal * (inner - cosine / index), index**2 * inner / cosine


def end_mm(surface: Surface) -> float:
    """Distance from the axis at which a surface's conic ends: the radius of a sphere; inf where it goes on."""
    sections = [(float(surface.radius_mm), float(surface.conic))]
    if surface.across is not None:
        sections.append((surface.across[0], surface.across[1] or 0.0))
    return min(abs(radius) / math.sqrt(1 + k) if k > -1 else math.inf for radius, k in sections)


def check_figures(surfaces: Sequence[Surface], file: str, state: str = "") -> None:
    """Raise for figures that no lens has, whose squares and inverses would overflow; a NaN is not yet known.

    Raises:
        InputError: names the file, the zoom state if there is one, the surface and the figure.
    """
    for k, s in enumerate(surfaces):
        if s.focal_mm is not None and any(t.n_d != 1 or t.glass for t in surfaces[max(k - 1, 0) : k + 1]):
            raise InputError(file, f"{state}surface {k}, focal_mm", s.focal_mm, "air on both sides of an ideal lens")
        rim = min(s.semi_diameter_mm, 1e6)
        figures: tuple[tuple[str, Any, float, float], ...] = (
            ("radius_mm", abs(s.radius_mm), 1e-6, math.inf),
            ("across_mm", abs(s.across[0]) if s.across else 1.0, 1e-6, math.inf),
            ("across_conic", abs(s.across[1] or 0.0) if s.across else 0.0, 0.0, 1e9),
            ("focal_mm", abs(s.focal_mm or 1.0), 1e-6, 1e9),
            ("thickness_mm", abs(s.thickness_mm), 0.0, 1e6),
            ("diameter_mm", s.diameter_mm, 1e-6, 1e6),
            ("V_d", 100.0 if s.V_d is None else s.V_d, 1.0, 1e4),
            ("conic", abs(s.conic), 0.0, 1e9),
            ("asphere", sum(abs(float(a)) * rim**p for p, a in s.asphere), 0.0, 1e6),
            ("absorption_per_mm", s.absorption_per_mm, 0.0, 1e6),
        )
        for name, value, low, high in figures:
            if value < low or value > high:
                expected = f"a size from {low:g} to {high:g}" + (" mm of sag at the rim" if name == "asphere" else "")
                raise InputError(file, f"{state}surface {k}, {name}", float(value), expected)


def check_clearance(surfaces: Sequence[Surface], file: str, state: str = "") -> None:
    """Raise as `check_figures`, for rims beyond the radius of curvature, and for neighbours that overlap inside theirs.

    The gap between two spheres is monotone from the axis outwards, so that axis and the smaller of the two rims
    decide; other shapes are also tested in between. A stop that bends nothing may lie inside an element beside which
    it is listed; what stands on both sides of it must be clear of each other.

    Raises:
        InputError: names the file, the zoom state if there is one, the surface and by how much.
    """
    check_figures(surfaces, file, state)
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
            gap = axis_gap_mm + sag_mm(after, x, y) - sag_mm(before, x, y)
            found = min(found, (gap, h))
    return found


def neighbours(surfaces: Sequence[Surface]) -> Iterator[tuple[int, int, float]]:
    """Pairs of surfaces that may collide, a stop that bends nothing aside, with the distance of their vertices."""
    idle = [s.stop and same_medium(surfaces, k) for k, s in enumerate(surfaces)]
    for k in range(len(surfaces) - 1):
        if not idle[k] and not idle[k + 1]:
            yield k, k + 1, surfaces[k].thickness_mm
    for k in range(1, len(surfaces) - 1):
        if idle[k] and math.isinf(surfaces[k].radius_mm):
            yield k - 1, k + 1, surfaces[k - 1].thickness_mm + surfaces[k].thickness_mm


def same_medium(surfaces: Sequence[Surface], k: int, in_front: Medium | None = None) -> bool:
    """Whether the medium is the same before and behind surface k; `in_front`, by default air, lies before the first."""
    first = surfaces[k - 1] if k else in_front
    before = (first.n_d, first.V_d, first.glass) if first else (1.0, None, None)
    s = surfaces[k]
    return before == (s.n_d, s.V_d, s.glass) and s.focal_mm is None
