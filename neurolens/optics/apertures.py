"""Shapes of the stop's opening: blades, and any shape from a mask, for numpy arrays (cameras) and torch tensors.

A shape lies inside the round stop, the circle round the blades' corners. Lens frame: x right, y up, from the film.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

MIN_BLADES, MAX_BLADES = 3, 100
MAX_MASK = 4096
THRESHOLD = 0.5


@dataclass(frozen=True, eq=False)
class Aperture:
    """The opening of a stop: straight or curved blades, or a mask; exactly one of them.

    Attributes:
        blades: 3 to 100; None for a mask.
        rotation_deg: from x towards y: of the first corner from the x axis, or of the whole mask.
        curvature: of the blades' edges: 0 straight, 1 arcs of the circle through the corners; the bulge of the edge
            grows linearly between.
        mask: [H, W] bool, read-only, True where light passes. Row 0 is the top (+y), column 0 the left (-x); its longer
            side spans the stop's diameter. Numbers are taken at a threshold of one half: light passes or it does not.

    Raises:
        InputError: a value out of range, neither blades nor mask or both, a mask that is too large or passes no light.
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
        """Area of the opening over that of the round stop: n / (2 pi) sin(2 pi / n) for n straight blades."""
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
        """What goes into a picture's metadata."""
        if self.blades is None:
            assert self.mask is not None
            return {"mask": list(self.mask.shape), "rotation_deg": self.rotation_deg, "area_share": self.area_share}
        return {"blades": self.blades, "rotation_deg": self.rotation_deg, "curvature": self.curvature}

    def inside(self, x: Any, y: Any, radius_mm: float) -> Any:
        """Whether points of the stop lie in the opening: booleans of the shape of x and y; False for NaN.

        Numpy arrays x, y and the stop's radius in mm; for torch tensors see `inside_on_tensors`.
        """
        open_ = x * x + y * y <= radius_mm * radius_mm
        if self.blades is not None:
            return open_ & self.between_blades(x, y, radius_mm)
        assert self.mask is not None
        row, column = self.places(x, y, radius_mm)
        open_ = open_ & self.on_mask(row, column)
        row, column = (np.where(open_, v, 0).astype(np.intp) for v in (row, column))
        return open_ & self.mask[row, column]

    def between_blades(self, x: Any, y: Any, radius_mm: float) -> Any:
        """Whether points lie within every blade's edge: half planes, or discs through two corners each.

        A disc of curvature k that touches the edge's middle line at distance e holds what has
        u (1 - k e) <= e - k (e^2 + x^2 + y^2) / 2, with u the distance along that line; k = 0 is the half plane.
        """
        assert self.blades is not None
        half = math.pi / self.blades
        rise = self.curvature * radius_mm * (1 - math.cos(half))
        curvature = 2 * rise / ((radius_mm * math.sin(half)) ** 2 + rise * rise)
        edge = radius_mm * math.cos(half) + rise
        bound = edge - curvature / 2 * (x * x + y * y + edge * edge)
        scale = 1 - curvature * edge
        within = x * scale == x * scale  # False for NaN
        if self.curvature == 1:
            return within & (x * x + y * y <= radius_mm * radius_mm)
        for k in range(self.blades):
            angle = math.radians(self.rotation_deg) + (2 * k + 1) * half
            within = within & (x * (scale * math.cos(angle)) + y * (scale * math.sin(angle)) <= bound)
        return within

    def places(self, x: Any, y: Any, radius_mm: float) -> tuple[Any, Any]:
        """Row and column of points on the mask, as numbers with a fraction."""
        assert self.mask is not None
        height, width = self.mask.shape
        scale = max(height, width) / (2 * radius_mm) if radius_mm > 0 else 0.0
        cos, sin = (f(math.radians(self.rotation_deg)) * scale for f in (math.cos, math.sin))
        return height / 2 - (y * cos - x * sin), width / 2 + (x * cos + y * sin)

    def on_mask(self, row: Any, column: Any) -> Any:
        """Whether such places lie on the mask."""
        assert self.mask is not None
        height, width = self.mask.shape
        return (row >= 0) & (row < height) & (column >= 0) & (column < width)


def inside_on_tensors(aperture: Aperture, x: Tensor, y: Tensor, radius_mm: float) -> Tensor:
    """Whether points [N] (mm, in the stop's plane) lie between the blades or on the mask; False for NaN.

    The circle round the opening is the stop's own rim, which the tracer tests beside this.
    """
    if aperture.blades is not None:
        opened: Tensor = aperture.between_blades(x, y, radius_mm)
        return opened
    import torch

    row, column = aperture.places(x, y, radius_mm)
    on_mask: Tensor = aperture.on_mask(row, column)
    row, column = (torch.where(on_mask, v, 0.0).to(torch.int64) for v in (row, column))
    mask = _mask_on(aperture, str(x.device))
    return on_mask & mask[row, column]


@lru_cache(maxsize=8)
def _mask_on(aperture: Aperture, device: str) -> Tensor:
    import torch

    assert aperture.mask is not None
    return torch.tensor(aperture.mask, device=device)


def _real(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _read_only(mask: ArrayLike) -> NDArray[np.bool_]:
    """A mask as the dataclass keeps it; refuses what is no array of two dimensions, too large, or passes no light."""
    given = np.asarray(mask)
    if given.ndim != 2 or not 1 <= min(given.shape) <= max(given.shape) <= MAX_MASK or given.dtype.kind not in "bfiu":
        found = f"({given.dtype} {given.shape})"
        raise InputError("aperture", "mask", found, f"numbers [H, W], at most {MAX_MASK} a side")
    whole = np.array(given >= THRESHOLD)  # a copy, independent of the caller's array
    if not whole.any():
        raise InputError("aperture", "mask", "(shut everywhere)", "an opening: values of at least 0.5")
    whole.flags.writeable = False
    return whole
