"""Where rays meet the front surface of a lens: numpy alone, for the fits and for what runs without them.

Surfaces are given by anything with curvature, conic, asphere and cylinder (see `optics.prescription.Surface`).
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Newton's steps along the ray from the sphere of the vertex to a conic, asphere or cylinder.
_STEPS = 8


class Shape(Protocol):
    """A surface of revolution, or a cylinder bent in x or y only: c h^2 / (1 + sqrt(1 - (1 + k) c^2 h^2)) + sum a h^p.

    Attributes:
        curvature: 1/mm. conic: k. asphere: pairs (p, a). cylinder: the axis that is bent, or None.
    """

    @property
    def curvature(self) -> Any: ...
    @property
    def conic(self) -> Any: ...
    @property
    def asphere(self) -> Any: ...
    @property
    def cylinder(self) -> str | None: ...


def sag_and_slope(shape: Shape, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """z (mm) above the vertex plane and its derivatives by x and y; NaN beyond the end of a conic."""
    c, k = float(shape.curvature), float(shape.conic)
    gx, gy = float(shape.cylinder != "y"), float(shape.cylinder != "x")
    h2 = gx * x * x + gy * y * y
    root = np.sqrt(1 - (1 + k) * c * c * h2)
    z = c * h2 / (1 + root)
    # dz / d(h^2), of the conic: c / (2 root).
    slope = c / (2 * root)
    for power, a in shape.asphere:
        z = z + float(a) * h2 ** (power / 2)
        slope = slope + float(a) * (power / 2) * h2 ** (power / 2 - 1)
    return z, 2 * gx * x * slope, 2 * gy * y * slope


def meet_front(
    shape: Shape | None, x: Array, y: Array, z: Array, dx: Array, dy: Array, dz: Array
) -> tuple[Array, Array]:
    """(x, y) where the line of each ray meets the front surface next to its vertex; NaN where it does not.

    Args:
        shape: None is the plane z = 0. The rest: points (mm) and directions of either sense, float64 [N].
    """
    # Before the lens light travels towards +z, or from the side and beyond: the sense is that of the camera ray's end.
    dx, dy, dz = -dx, -dy, -dz
    c = 0.0 if shape is None else float(shape.curvature)
    with np.errstate(all="ignore"):
        # The point nearest to the vertex, then c |m + t d|^2 = 2 (m_z + t d_z), its root next to the vertex.
        along = x * dx + y * dy + z * dz
        mx, my, mz = x - along * dx, y - along * dy, z - along * dz
        f = c * (mx * mx + my * my + mz * mz) - 2 * mz
        root = np.sqrt(dz * dz - c * f)
        t = np.where(dz > 0, f / (dz + root), (dz - root) / c if c else np.nan)
        px, py, pz = mx + t * dx, my + t * dy, mz + t * dz
        if shape is not None and (float(shape.conic) or len(shape.asphere) or shape.cylinder):
            lost = ~np.isfinite(t)
            px, py, pz = (np.where(lost, m, p) for m, p in ((mx, px), (my, py), (mz, pz)))
            for _ in range(_STEPS):
                sag, sx, sy = sag_and_slope(shape, px, py)
                t = (sag - pz) / (dz - sx * dx - sy * dy)
                px, py, pz = px + t * dx, py + t * dy, pz + t * dz
    return px, py
