"""Make the pictures of the scenes beside this file: wheel.png (rims and spokes), crosses.png, stop masks and signs.

python experiments/gallery/scenes/make_assets.py

The masks open the shares of the stop that Willi 2021 (Table 6.3) has for his: star 45.2%, heart 47.0%.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TARGET = Path(__file__).parent
FINE = 4  # samples per pixel, each way
SIDE = 256  # of a mask


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


def places() -> tuple[np.ndarray, np.ndarray]:
    """x right and y up of a mask's pixels, the stop's radius as unit."""
    middle = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y = np.meshgrid(middle, -middle)
    return x, y


def star(share: float = 0.452) -> np.ndarray:
    """Five points on the stop's rim, one of them up; the inner corners follow from the open share of the disc."""
    inner = share * np.pi / (5 * np.sin(np.pi / 5))
    x, y = places()
    angle = np.abs((np.arctan2(x, y) + np.pi / 5) % (2 * np.pi / 5) - np.pi / 5)  # from the nearest point
    u, v = np.hypot(x, y) * np.cos(angle), np.hypot(x, y) * np.sin(angle)
    corner_u, corner_v = inner * np.cos(np.pi / 5), inner * np.sin(np.pi / 5)
    return (1 - u) * corner_v - v * (1 - corner_u) >= 0


def heart(share: float = 0.470) -> np.ndarray:
    """(x^2 + y^2 - 1)^3 < x^2 y^3, of the size that opens `share` of the disc."""
    x, y = places()

    def of_scale(scale: float) -> np.ndarray:
        u, v = x / scale, y / scale + 0.1
        return ((u * u + v * v - 1) ** 3 < u * u * v**3) & (x * x + y * y <= 1)

    low, high = 0.3, 1.0
    for _ in range(40):
        scale = (low + high) / 2
        low, high = (scale, high) if of_scale(scale).sum() < share * np.pi / 4 * SIDE**2 else (low, scale)
    return of_scale(high)


def sign(text: str, size: int = 128) -> Image.Image:
    """A distance in black on white, framed."""
    picture = Image.new("L", (size, size), 255)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((3, 3, size - 4, size - 4), outline=0, width=6)
    draw.text((size / 2, size / 2), text, fill=0, font=ImageFont.load_default(size=74), anchor="mm")
    return picture


def main() -> None:
    """Write them all."""
    for name, picture in (("wheel", wheel()), ("crosses", crosses())):
        grey = Image.fromarray(np.rint(255 * picture).astype(np.uint8))
        grey.quantize(8).save(TARGET / f"{name}.png", optimize=True)
    for name, mask in (("star", star()), ("heart", heart())):
        Image.fromarray(mask * np.uint8(255)).convert("1").save(TARGET / f"{name}.png", optimize=True)
    for k in range(6):
        sign(f"{1 + 0.2 * k:.1f}").convert("P").save(TARGET / f"sign-{10 + 2 * k}.png", optimize=True)


if __name__ == "__main__":
    main()
