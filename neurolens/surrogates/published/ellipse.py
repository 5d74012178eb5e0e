"""The ellipse of least area about points, by Khachiyan's algorithm; for sets that one axis mirrors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError  # type: ignore[import-untyped]

Floats = NDArray[np.float64]


def least_ellipse(points: Floats, tolerance: float = 1e-4) -> tuple[float, float, float]:
    """Radius along x, radius along y and centre on the y axis of the least ellipse about points and mirror images.

    The mirror is the y axis, x -> -x: the ellipse then has its centre on it and its axes along x and y. Khachiyan 1996,
    with the steps of Todd and Yildirim 2007; the area is right to about `tolerance`, and all points lie inside.

    Args:
        points: [K, 2], at least one.
    """
    both = np.concatenate([points, points * [-1, 1]])
    size = max(float(np.ptp(both, axis=0).max()), 1e-12)
    try:
        both = both[ConvexHull(both).vertices]
    except (QhullError, ValueError):
        half = np.ptp(both, axis=0) / 2  # points on a line
        return max(float(half[0]), 1e-9 * size), max(float(half[1]), 1e-9 * size), float(both[:, 1].mean())
    centre_y, scale = both[:, 1].mean(), size / 2
    lifted = np.concatenate([both[:, :1], both[:, 1:] - centre_y, np.full((len(both), 1), scale)], axis=1).T / scale
    weights = np.full(len(both), 1 / len(both))
    for _ in range(2000):
        inverse = np.linalg.inv((lifted * weights) @ lifted.T)
        distance = np.einsum("ik,ij,jk->k", lifted, inverse, lifted)
        far = int(distance.argmax())
        near = int(np.where(weights > 1e-12, distance, np.inf).argmin())
        excess, lack = distance[far] / 3 - 1, 1 - distance[near] / 3
        if max(excess, lack) <= tolerance:
            break
        k = far if excess >= lack else near
        step = (distance[k] - 3) / (3 * (distance[k] - 1))
        step = max(step, -weights[k] / (1 - weights[k])) if weights[k] < 1 else step
        weights *= 1 - step
        weights[k] += step
    centre = both.T @ weights
    spread = ((both - centre).T * weights) @ (both - centre)
    radii = np.sqrt(2 * np.diag(spread))
    # The last ten thousandth: grow until every point is inside.
    outside = np.sqrt((((both - [0.0, centre[1]]) / radii) ** 2).sum(1).max())
    return float(radii[0] * outside), float(radii[1] * outside), float(centre[1])
