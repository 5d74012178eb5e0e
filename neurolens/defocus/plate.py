"""Plates: pictures of a pinhole camera with depth, in layers, made ready for rays to be followed through them.

Inverse depth is linear along the straight line that a ray draws in such a picture, and over every plane of the scene.
Steps of inverse depth that go on as the surface does on either side join two pixels; others are edges of things.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
FINEST = 4  # pixels a side of the smallest cells with bounds
_STEEPEST = 0.2  # of the inverse depth: a larger step to a neighbour is an edge
_LEVEL = 1e-4  # of the inverse depth: a smaller one is none
_SLOPES = 1.5
_MIXED = 4.0  # steps of the surfaces beside an edge, below which the pixel between them is a mixture of both


@dataclass(frozen=True)
class PlatePinhole:
    """The pinhole that a plate was rendered through.

    Attributes:
        reach_px: pixels for a slope of 1, along x and y; centre_px: where the axis meets the plate.
        before_film_mm: distance of the hole before the film.
    """

    reach_px: tuple[float, float]
    centre_px: tuple[float, float]
    before_film_mm: float

    def border_px(self, size: tuple[int, int]) -> tuple[float, float]:
        """How far a plate's first pixel lies beyond that of a film of `size` whose pixels are as large: overscan."""
        return self.centre_px[0] - size[0] / 2, self.centre_px[1] - size[1] / 2

    def lines(self, origin_m: FloatArray, direction: FloatArray) -> FloatArray:
        """Rays [3, N] in the camera frame as lines [4, N] in the plate: x = ax + bx w, y = ay + by w, w in 1/m."""
        slope = direction[:2] / -direction[2]
        ahead = -origin_m[2] - np.float32(1e-3 * self.before_film_mm)
        offset = origin_m[:2] - slope * ahead
        scale = np.array([[self.reach_px[0]], [-self.reach_px[1]]], np.float32)
        vanishing = np.array(self.centre_px, np.float32)[:, None] + scale * slope
        return np.concatenate([vanishing, scale * offset])


class Layer:
    """One layer of a plate.

    Args:
        rgb: [H, W, 3] linear radiance. inverse_depth: [H, W] 1/m from the pinhole, 0 for the sky, below 0 where the
            layer has nothing.
    """

    def __init__(self, rgb: FloatArray, inverse_depth: FloatArray) -> None:
        w = _unmixed(inverse_depth.astype(np.float32))
        self.texel = np.ascontiguousarray(np.concatenate([rgb, w[..., None]], axis=2), np.float32)
        steps = [_lesser(np.abs(np.diff(w, axis=axis)), axis) for axis in (0, 1)]
        most = _STEEPEST * np.abs(w)
        self.jump = np.ascontiguousarray(np.minimum(_SLOPES * (steps[0] + steps[1]), most) + _LEVEL * np.abs(w))
        self.bounds = _pyramid(w)
        self.nearest = float(w.max())

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.texel.shape[1], self.texel.shape[0]


class _Struct(ctypes.Structure):
    _fields_ = [  # noqa: RUF012
        *((name, ctypes.c_int) for name in ("width", "height", "levels")),
        *((name, ctypes.c_void_p) for name in ("texel", "jump", "bounds", "start")),
        ("nearest", ctypes.c_float),
    ]


def as_structs(layers: list[Layer]) -> tuple[Any, list[Any]]:
    """The layers as an array of C's structures, and what must be kept while these are used."""
    kept: list[Any] = []
    structs = (_Struct * len(layers))()
    for layer, struct in zip(layers, structs, strict=True):
        flat = np.concatenate([level.reshape(-1, 2) for level in layer.bounds])
        start = np.cumsum([0, *(level[..., 0].size for level in layer.bounds)])[:-1].astype(np.int64)
        kept += [flat, start, layer]
        struct.width, struct.height = layer.size
        struct.levels, struct.nearest = len(layer.bounds), layer.nearest
        for name, array in (("texel", layer.texel), ("jump", layer.jump), ("bounds", flat), ("start", start)):
            setattr(struct, name, array.ctypes.data)
    return structs, kept


def _lesser(step: FloatArray, axis: int) -> FloatArray:
    """The lesser of the steps to the two neighbours along an axis; of a border pixel, the one that it has."""
    padded = np.pad(step, [(int(a == axis), int(a == axis)) for a in (0, 1)], constant_values=np.inf)
    count = step.shape[axis] + 1
    return np.minimum(padded.take(range(count), axis), padded.take(range(1, count + 1), axis))


def _unmixed(w: FloatArray) -> FloatArray:
    """Inverse depth where pixels on edges, whose depth is a mean of both sides, take that of the nearer side."""
    found = w.copy()
    for axis in (0, 1):
        if w.shape[axis] < 5:
            continue
        far_before, before, here, after, far_after = (
            np.moveaxis(w, axis, 0)[k : w.shape[axis] - 4 + k] for k in range(5)
        )
        slopes = np.abs(before - far_before) + np.abs(far_after - after)
        edge = np.abs(after - before) > _MIXED * slopes + 0.02 * np.abs(here)
        mixed = edge & ((here - before) * (after - here) > 0) & (np.minimum(before, after) > 0)
        with np.errstate(divide="ignore", invalid="ignore"):  # depth, not its inverse, is averaged
            share = (1 / here - 1 / before) / (1 / after - 1 / before)
        target = np.moveaxis(found, axis, 0)[2:-2]
        np.copyto(target, np.where(share > 0.5, after, before), where=mixed)
    return found


def _pyramid(w: FloatArray) -> list[FloatArray]:
    """Least and largest values [h, w, 2] in cells of `FINEST` pixels a side, then of twice that, up to one cell."""
    least = most = w
    levels, step = list[FloatArray](), FINEST
    while True:
        least, most = _reduced(least, step, np.minimum), _reduced(most, step, np.maximum)
        levels.append(np.ascontiguousarray(np.stack([least, most], axis=2)))
        if least.size == 1:
            return levels
        step = 2


def _reduced(values: FloatArray, step: int, by: np.ufunc) -> FloatArray:
    for axis in (0, 1):
        values = by.reduceat(values, np.arange(0, values.shape[axis], step), axis=axis)
    return values
