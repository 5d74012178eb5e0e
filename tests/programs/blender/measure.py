"""What is measured of a picture of a point, by neurolens's rays and by Blender's pixels alike; numpy 1 or 2."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def crop_at(centre_px: tuple[float, float], half_px: int) -> tuple[int, int, int, int]:
    """Left, bottom, right and top pixel (ends not included) of a square about a place."""
    x, y = (int(np.floor(c)) for c in centre_px)
    return x - half_px, y - half_px, x + half_px + 1, y + half_px + 1


def measures(picture: Array, corner_px: tuple[int, int]) -> dict[str, Any]:
    """Centroids of all light and of the channels (px from the picture's lower left corner), and its second moments.

    Area (px) and ratio of the axes are those of the evenly lit ellipse of the same moments.

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
    share = light / light.sum()
    aside = x - (share * x).sum(), y - (share * y).sum()
    spread = np.array([[(share * a * b).sum() for a in aside] for b in aside])
    minor, major = np.sqrt(np.linalg.eigvalsh(spread))
    area, wide = 4 * math.pi * minor * major, math.hypot(minor, major)
    return {"centroid_px": centroid, "area_px": area, "axes": float(minor / major), "rms_px": wide}
