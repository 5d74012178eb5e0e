"""Points of the pupil, as shares of the stop's radius: rings, squares, and the two lines of a ray fan."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

# The outermost ring lies this share inside the stop's edge, so that rounding never clips it.
_EDGE = 1e-7


class Pattern(NamedTuple):
    """Pupil points, each [P].

    Attributes:
        tangential, sagittal: shares of the stop's radius, in the meridional plane of the field (positive on the side
            on which its image lies) and across it.
        weight: share of the stop's area that a point stands for; sums to 1 (0 for the points of a fan).
    """

    tangential: Tensor
    sagittal: Tensor
    weight: Tensor


def hexapolar(rings: int) -> Pattern:
    """The centre and `rings` rings of 6, 12, 18, ... points, the last on the stop's edge; 1 + 3 n (n + 1) points.

    The weights start from the area nearest to each ring, and are moved as little as makes the means of r^2, r^4, ...,
    r^12 right: spots of steep aberrations are decided near the edge, where areas alone would be far off.
    """
    radius = [k / rings for k in range(rings + 1)]
    weight = _ring_weights(rings)
    t, s, w = [0.0], [0.0], [weight[0]]
    for k in range(1, rings + 1):
        r = radius[k] * (1 - _EDGE)
        for i in range(6 * k):
            angle = 2 * math.pi * i / (6 * k)
            t.append(r * math.cos(angle))
            s.append(r * math.sin(angle))
            w.append(weight[k] / (6 * k))
    return Pattern(_tensor(t), _tensor(s), _tensor(w))


def _ring_weights(rings: int) -> list[float]:
    """Shares of the disc for rings of radius 0, 1/n, ..., 1, all above 0."""
    k = torch.arange(rings + 1, dtype=torch.float64)
    inner, outer = ((k - 0.5).clamp_min(0) / rings) ** 2, ((k + 0.5).clamp_max(rings) / rings) ** 2
    area = outer - inner
    for moments in range(min(7, rings), 0, -1):
        m = torch.arange(moments, dtype=torch.float64)[:, None]
        power = (k / rings) ** (2 * m)
        lack = 1 / (m[:, 0] + 1) - power @ area
        moved = area + area * (torch.linalg.solve((power * area) @ power.T, lack) @ power)
        if (moved > 0).all():
            return moved.tolist()
    return area.tolist()


def grid(n: int) -> Pattern:
    """Centres of the cells of an n by n square over the stop that lie inside it, all of one weight."""
    line = (torch.arange(n, dtype=torch.float64) + 0.5) * (2 / n) - 1
    t, s = (v.reshape(-1) for v in torch.meshgrid(line, line, indexing="ij"))
    inside = t * t + s * s < 1
    return Pattern(t[inside], s[inside], torch.full_like(t[inside], 1 / int(inside.sum())))


def fan(n: int) -> Pattern:
    """2 n points: n along the meridional plane from -1 to 1, then n across it. Odd n holds the centre."""
    line = torch.linspace(-1, 1, n, dtype=torch.float64) * (1 - _EDGE)
    zero = torch.zeros_like(line)
    return Pattern(torch.cat([line, zero]), torch.cat([zero, line]), torch.zeros(2 * n, dtype=torch.float64))


def points(tangential: list[float], sagittal: list[float]) -> Pattern:
    """Single points, without weight."""
    return Pattern(_tensor(tangential), _tensor(sagittal), torch.zeros(len(tangential), dtype=torch.float64))


def _tensor(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
