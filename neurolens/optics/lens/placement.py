"""Where a surface stands that is not centred on the lens's axis: moved, and turned about its vertex."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
MOST_TILT_DEG, MOST_DECENTRE_MM = 60.0, 1e4  # of a surface, or of a group


@dataclass(frozen=True)
class Placement:
    """How a surface is moved from its place in the centred lens, and then turned about its vertex.

    Attributes:
        moved_mm: the vertex's move along x, y and z of the lens frame.
        tilt_deg: right-handed turns about the surface's own x, then its own y, then its own z: a positive first one
            moves points with y > 0 towards the film.
    """

    moved_mm: Vector = (0.0, 0.0, 0.0)
    tilt_deg: Vector = (0.0, 0.0, 0.0)

    def __bool__(self) -> bool:
        return any(self.moved_mm) or any(self.tilt_deg)

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """The surface's x, y and z as columns [3, 3] in the lens frame."""
        (a, b, c), (d, e, f) = ([g(math.radians(t)) for t in self.tilt_deg] for g in (math.sin, math.cos))
        about_x, about_y = [[1, 0, 0], [0, d, -a], [0, a, d]], [[e, 0, b], [0, 1, 0], [-b, 0, e]]
        return np.array(about_x) @ np.array(about_y) @ np.array([[f, -c, 0], [c, f, 0], [0, 0, 1]])

    def in_group(self, group: Placement, from_pivot_mm: float) -> Placement:
        """Return the placement in the lens of a surface that has this one in a group, which is placed as a whole.

        Args:
            from_pivot_mm: z of the surface's vertex in the centred lens, from the point about which the group turns.
        """
        place = group.axes @ (np.array(self.moved_mm) + [0.0, 0.0, from_pivot_mm]) + group.moved_mm
        return Placement.of(place - [0.0, 0.0, from_pivot_mm], group.axes @ self.axes)

    @classmethod
    def of(cls, moved_mm: NDArray[np.float64], axes: NDArray[np.float64]) -> Placement:
        """Return the placement of a surface that is moved so, and whose x, y and z are these columns [3, 3]."""
        turns = (
            np.arctan2(-axes[1, 2], axes[2, 2]),
            np.arcsin(axes[0, 2].clip(-1, 1)),
            np.arctan2(-axes[0, 1], axes[0, 0]),
        )
        x, y, z = (float(v) for v in moved_mm)
        a, b, c = (math.degrees(t) for t in turns)
        return cls((x, y, z), (a, b, c))

    def scaled(self, factor: float) -> Placement:
        """Return the placement in a lens that is larger by a factor."""
        x, y, z = (v * factor for v in self.moved_mm)
        return Placement((x, y, z), self.tilt_deg)

    def record(self) -> dict[str, list[float]]:
        """Return the keys of a lens file, without those that are 0; a last number of 0 is left out."""
        pairs = (("decentre_mm", self.moved_mm), ("tilt_deg", self.tilt_deg))
        return {key: list(v if v[2] else v[:2]) for key, v in pairs if any(v)}


CENTRED = Placement()
