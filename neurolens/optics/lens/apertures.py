"""Shapes of the stop's opening, blades or any shape from a mask, for numpy arrays (cameras) and torch tensors.

Every shape lies inside the round stop, which is the circle through the corners of the blades. In the lens frame, seen
from the film, x points right and y up.
"""

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value

MIN_BLADES, MAX_BLADES = 3, 100
MAX_MASK = 4096
THRESHOLD = 0.5
_AT_ONCE = 1 << 16  # points at a time, for each of them takes one number per blade


@dataclass(frozen=True, eq=False)
class Aperture:
    """Describes the opening of a stop: either straight or curved blades, or a mask.

    Attributes:
        blades: how many, 3 to 100; None for a mask.
        rotation_deg: angle from x towards y, of the first corner from the x axis or by which the mask is turned.
        curvature: of the blades' edges, from 0 (straight) to 1 (arcs of the circle through the corners); the bulge of
            an edge grows linearly with it.
        mask: [H, W] bool, read-only, True where light passes. Row 0 is the top (+y), column 0 the left (-x); the longer
            side spans the stop's diameter. Numbers are compared with one half: light passes or it does not.

    Raises:
        InputError: a value out of range, both blades and a mask or neither, a mask that is too large or passes no
            light.
    """

    blades: int | None = None
    rotation_deg: float = 0.0
    curvature: float = 0.0
    mask: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        if (self.blades is None) == (self.mask is None):
            raise InputError("aperture", "blades", self.blades, "a number of blades, or else a mask")
        if not (_real(self.rotation_deg) and math.isfinite(self.rotation_deg)):
            raise InputError("aperture", "rotation_deg", self.rotation_deg, "an angle in degrees")
        if not (_real(self.curvature) and 0 <= self.curvature <= 1):
            raise InputError("aperture", "curvature", self.curvature, "a number from 0 (straight) to 1 (round)")
        if self.mask is not None:
            object.__setattr__(self, "mask", _read_only(self.mask))
        elif isinstance(self.blades, bool) or not isinstance(self.blades, int):
            raise InputError("aperture", "blades", self.blades, "an integer")
        elif not MIN_BLADES <= self.blades <= MAX_BLADES:
            raise InputError("aperture", "blades", self.blades, f"from {MIN_BLADES} to {MAX_BLADES}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Aperture) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self) -> tuple[Any, ...]:
        mask = None if self.mask is None else (self.mask.shape, hashlib.sha256(self.mask.tobytes()).digest())
        return (self.blades, self.rotation_deg, self.curvature, mask)

    @property
    def area_share(self) -> float:
        """The area of the opening over that of the round stop: n / (2 pi) sin(2 pi / n) for n straight blades."""
        if self.blades is None:
            places = ((np.arange(1024) + 0.5) / 512 - 1).astype(np.float64)
            x, y = np.meshgrid(places, places)
            return float(self.inside(x, y, 1.0).sum() / (x * x + y * y <= 1).sum())
        half = math.pi / self.blades
        share = math.sin(2 * half) / (2 * half)
        rise = self.curvature * (1 - math.cos(half))
        if rise == 0:
            return share
        radius = (math.sin(half) ** 2 + rise**2) / (2 * rise)
        angle = 2 * math.asin(min(math.sin(half) / radius, 1.0))
        return share + radius**2 * (angle - math.sin(angle)) / (2 * half)

    def settings(self) -> dict[str, Any]:
        """Return the description of the opening that the metadata of pictures hold."""
        if self.blades is None:
            assert self.mask is not None
            return {"mask": list(self.mask.shape), "rotation_deg": self.rotation_deg, "area_share": self.area_share}
        return {"blades": self.blades, "rotation_deg": self.rotation_deg, "curvature": self.curvature}

    def inside(self, x: Any, y: Any, radius_mm: float) -> Any:
        """Test whether points of the stop lie in the opening.

        Args:
            x, y: positions in the stop, mm; numpy arrays or torch tensors.
            radius_mm: radius of the stop.

        Returns:
            Booleans of the shape of x and y; False for NaN.
        """
        tensors = not isinstance(x, np.ndarray)
        library: Any = import_module("torch") if tensors else np
        points = library.stack([x.reshape(-1), y.reshape(-1)])
        call = {"stop_radius_mm": library.ones_like(points[:1, :1]) * radius_mm}
        if self.mask is not None:
            call["mask"] = _mask_on(self, str(x.device)) if tensors else self.table
        parts = [points[:, k : k + _AT_ONCE] for k in range(0, max(points.shape[1], 1), _AT_ONCE)]
        opened = [evaluate(self._graph, {"stop_xy_mm": part, **call})["open"][0] > 0 for part in parts]
        return library.concatenate(opened).reshape(x.shape)

    def opening(self, g: Graph, xy: Value, radius: Value) -> Value:
        """Test whether points [2] of a stop of this radius (mm) lie in the opening; a mask is the graph's table `mask`.

        A point lies in the opening where it lies within every blade's edge: within half planes, or discs through two
        corners each. In units of the stop's radius, take a disc of curvature k that touches the edge's middle line at
        distance e, and let u be the distance along that line: the disc holds the points with u (1 - k e) <= e - k (e^2
        + x^2 + y^2) / 2. For k = 0 that is the half plane.
        """
        point = xy / radius
        within = g.square(point) <= 1.0
        if self.mask is not None:
            turn = math.radians(self.rotation_deg)
            height, width = self.mask.shape
            scale = max(height, width) / 2
            cos, sin = math.cos(turn) * scale, math.sin(turn) * scale
            place = g.affine([[sin, -cos], [cos, sin]], point, [height / 2, width / 2]).floor()
            cell = g.affine([[float(width), 1.0]], place)
            bright = g.constant(THRESHOLD) <= g.lookup(g.table("mask", 1), cell, g.constant(1.0))
            on_mask = place.between([0.0, 0.0], [height - 1.0, width - 1.0])
            return within & on_mask[0] & on_mask[1] & bright
        assert self.blades is not None
        if self.curvature == 1:
            return within
        along, limit = self._edges(g, point)
        return within & (along <= limit)

    def rim(self, g: Graph, xy: Value, radius: Value, shut: float) -> Value:
        """Return a value that is at most 1 in the opening, continuous across blades, and r^2 / R^2 for a round stop.

        Args:
            g, xy, radius: as for `opening`.
            shut: the value where a mask passes no light.
        """
        point = xy / radius
        if self.mask is not None:
            return g.select(self.opening(g, xy, radius), g.square(point), shut)
        if self.curvature == 1:
            return g.square(point)
        along, limit = self._edges(g, point)
        return g.square(point).maximum(along - limit + 1.0)

    def _edges(self, g: Graph, point: Value) -> tuple[Value, Value]:
        """Return two values: a point lies within all the blades' edges where the first is at most the second."""
        assert self.blades is not None
        half = math.pi / self.blades
        rise = self.curvature * (1 - math.cos(half))
        curvature = 2 * rise / (math.sin(half) ** 2 + rise * rise)
        edge = math.cos(half) + rise
        scale, turn = 1 - curvature * edge, math.radians(self.rotation_deg)
        angles = turn + (2 * np.arange(self.blades) + 1) * half
        along = g.affine(scale * np.stack([np.cos(angles), np.sin(angles)], 1), point)
        while along.rows > 1:  # the largest of all
            part = (along.rows + 1) // 2
            along = along[:part].maximum(along[along.rows - part :])
        return along, (edge - curvature / 2 * edge * edge) - g.square(point) * (curvature / 2)

    @cached_property
    def _graph(self) -> Graph:
        g = Graph()
        opened = self.opening(g, g.input("stop_xy_mm", 2), g.input("stop_radius_mm", per_call=True))
        g.outputs["open"] = g.select(opened, 1.0, 0.0)
        return g

    @cached_property
    def table(self) -> NDArray[np.float32]:
        """The mask as the table that `opening` reads, [H W, 1], row after row."""
        assert self.mask is not None
        return self.mask.reshape(-1, 1).astype(np.float32)


@lru_cache(maxsize=8)
def _mask_on(aperture: Aperture, device: str) -> Any:
    return import_module("torch").as_tensor(aperture.table, device=device)


def _real(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _read_only(mask: ArrayLike) -> NDArray[np.bool_]:
    """Check a mask and return a copy; refuse one that is not two-dimensional, is too large or passes no light."""
    array = np.asarray(mask)
    if array.ndim != 2 or not 1 <= min(array.shape) <= max(array.shape) <= MAX_MASK or array.dtype.kind not in "bfiu":
        raise InputError(
            "aperture", "mask", f"({array.dtype} {array.shape})", f"numbers [H, W], at most {MAX_MASK} a side"
        )
    whole = np.array(array >= THRESHOLD)  # a copy, independent of the caller's array
    if not whole.any():
        raise InputError("aperture", "mask", "(shut everywhere)", "an opening: values of at least 0.5")
    whole.flags.writeable = False
    return whole
