"""What is measured of a picture of a point, by neurolens's rays and by Blender's pixels alike; numpy 1 or 2."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
LIT = 0.05  # of the mean of the brighter half: what is darker is no part of a disc


def crop_at(centre_px: tuple[float, float], half_px: int) -> tuple[int, int, int, int]:
    """Left, bottom, right and top pixel (ends not included) of a square about a place."""
    x, y = (int(np.floor(c)) for c in centre_px)
    return x - half_px, y - half_px, x + half_px + 1, y + half_px + 1


def measures(picture: Array, corner_px: tuple[int, int]) -> dict[str, Any]:
    """Centroids of the channels (px from the picture's lower left corner), area (px) and axes of what is lit.

    Args:
        picture: [H, W, 3], the lowest row first.
        corner_px: left and bottom of it in the whole picture.
    """
    light = picture.sum(2)
    y, x = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    centroid = [
        [float((c * x).sum() / c.sum()) + corner_px[0], float((c * y).sum() / c.sum()) + corner_px[1]]
        for c in (light, *np.moveaxis(picture, 2, 0))
    ]
    mean = (light * light).sum() / light.sum()
    lit = light > LIT * mean
    place = np.stack([x[lit], y[lit]])
    spread = np.cov(place) if place.shape[1] > 2 else np.eye(2)
    minor, major = np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0))
    share = light / light.sum()
    wide = float(np.sqrt((share * ((x - (share * x).sum()) ** 2 + (y - (share * y).sum()) ** 2)).sum()))
    return {"centroid_px": centroid, "area_px": float(lit.sum()), "axes": float(minor / major), "rms_px": wide}
