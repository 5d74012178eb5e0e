"""The stop's shape in the tracer: `neurolens.apertures` on torch's tensors."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from neurolens.apertures import Aperture

__all__ = ["Aperture", "inside"]


def inside(aperture: Aperture, x: Tensor, y: Tensor, radius_mm: float) -> Tensor:
    """Whether points [N] (mm, in the stop's plane) lie in the opening; False for NaN.

    The circle round the opening is the stop's own rim, which the tracer tests beside this.
    """
    if aperture.blades is not None:
        opened: Tensor = aperture.between_blades(x, y, radius_mm)
        return opened
    row, column = aperture.places(x, y, radius_mm)
    on_mask: Tensor = aperture.on_mask(row, column)
    row, column = (torch.where(on_mask, v, 0.0).to(torch.int64) for v in (row, column))
    mask = _mask(aperture, str(x.device))
    return on_mask & mask[row, column]


@lru_cache(maxsize=8)
def _mask(aperture: Aperture, device: str) -> Tensor:
    assert aperture.mask is not None
    return torch.tensor(aperture.mask, device=device)
