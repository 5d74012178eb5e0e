"""The front surface, on which predicted rays start: its sag at a point."""

from __future__ import annotations

import torch
from torch import Tensor

from neurolens.optics.prescription import Surface


def sag_mm(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """z (mm) [N] of a surface above its vertex plane at (x, y) mm; beyond the conic's end finite, without meaning."""
    h2 = _height_square(surface, x, y)
    c, bend = float(surface.curvature), (1 + float(surface.conic)) * float(surface.curvature) ** 2
    z = c * h2 / (1 + torch.sqrt((1 - bend * h2).clamp_min(0.0)))
    for power, a in surface.asphere:
        z = z + float(a) * (h2 ** (power // 2) if power % 2 == 0 else h2.sqrt() ** power)
    return z


def _height_square(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    if surface.cylinder is None:
        return x * x + y * y
    return x * x if surface.cylinder == "x" else y * y
