"""Makes the pictures that the gallery's scenes lay on walls: wheel.png (rims and spokes) and crosses.png."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).parent
FINE = 4  # samples per pixel, each way


def wheel(side: int = 900, rims: int = 9, spokes: int = 40) -> np.ndarray:
    """Dark rims and spokes on white, [H, W] from 0 to 1."""
    y, x = np.mgrid[0 : side * FINE, 0 : side * FINE].astype(np.float32) / (side * FINE / 2) - 1
    r, turn = np.hypot(x, y), np.arctan2(y, x) * spokes / (2 * np.pi)
    width = 0.006  # half of a line, radius 1
    rim = np.abs(r * rims - np.rint(r * rims)) < width * rims
    spoke = np.abs(turn - np.rint(turn)) * 2 * np.pi * r / spokes < width
    dark = (rim & (r > 0.5 / rims) | spoke & (r > 3 / rims)) & (r < 1 + width)
    return smaller(1.0 - dark, side)


def crosses(side: int = 300) -> np.ndarray:
    """One cell of a wall of crosses: white on dark."""
    y, x = np.mgrid[0 : side * FINE, 0 : side * FINE] / (side * FINE) - 0.5
    inside = np.maximum(np.abs(x), np.abs(y)) < 0.33
    return smaller((inside & ((np.abs(x) < 0.035) | (np.abs(y) < 0.035))).astype(np.float32), side)


def smaller(picture: np.ndarray, side: int) -> np.ndarray:
    """The mean of FINE x FINE samples."""
    return picture.reshape(side, FINE, side, FINE).mean((1, 3))


if __name__ == "__main__":
    for name, picture in (("wheel", wheel()), ("crosses", crosses())):
        grey = Image.fromarray(np.rint(255 * picture).astype(np.uint8))
        grey.quantize(8).save(HERE / f"{name}.png", optimize=True)
