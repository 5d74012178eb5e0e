"""Make what the scenes in experiments/scenes load: knot.obj (a torus knot) and poster.png (a test picture).

python experiments/scenes/make_assets.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

TARGET = Path(__file__).parent


def knot(around: int = 96, across: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [T, 3] (from 0) of a (2, 3) torus knot about 1 m wide that stands on y = 0."""
    t = np.linspace(0, 2 * np.pi, around, endpoint=False)

    def curve(s: np.ndarray) -> np.ndarray:
        ring = 2 + np.cos(3 * s)
        return np.stack([ring * np.cos(2 * s), ring * np.sin(2 * s), 1.2 * np.sin(3 * s)], axis=-1) / 6

    centre, step = curve(t), curve(t + 1e-4) - curve(t - 1e-4)
    tangent = step / np.linalg.norm(step, axis=1, keepdims=True)
    # The direction from the knot's core circle turns with the curve and never lies along it.
    outward = centre - np.stack([np.cos(2 * t), np.sin(2 * t), np.zeros_like(t)], axis=-1) / 3
    side = np.cross(tangent, outward)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    angle = np.linspace(0, 2 * np.pi, across, endpoint=False)
    tube = 0.085 * (np.cos(angle)[:, None] * up[:, None] + np.sin(angle)[:, None] * side[:, None])
    vertices = (centre[:, None] + tube).reshape(-1, 3)
    vertices[:, 1] -= vertices[:, 1].min()
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = i * across + j, i * across + (j + 1) % across
    c, d = (i + 1) % around * across + (j + 1) % across, (i + 1) % around * across + j
    faces = np.concatenate([np.stack(x, axis=-1).reshape(-1, 3) for x in ((a, b, c), (a, c, d))])
    return vertices, faces


def poster(size: int = 384) -> np.ndarray:
    """A picture [size, 1.4 size, 3] uint8: a sun over bands of hills, cream border."""
    height, width = size, size * 7 // 5
    y, x = np.mgrid[0:height, 0:width] / size
    picture = np.empty((height, width, 3))
    picture[:] = np.array([250, 226, 190]) - 90 * y[..., None] * np.array([0.1, 0.5, 0.6])
    picture[np.hypot(x - 0.9, y - 0.38) < 0.17] = (226, 92, 58)
    # Level, swing, waves, phase and colour of each hill, from far to near.
    hills = [
        (0.52, 0.07, 5, 0.3, (231, 168, 108)),
        (0.62, 0.06, 7, 2, (92, 142, 146)),
        (0.74, 0.08, 4, 4.1, (38, 76, 98)),
    ]
    for level, swing, waves, phase, colour in hills:
        picture[y > level + swing * np.sin(waves * x + phase)] = colour
    border = (np.minimum(x, width / size - x) < 0.05) | (np.minimum(y, 1 - y) < 0.05)
    picture[border] = (244, 240, 230)
    return picture.astype(np.uint8)


def main() -> None:
    """Write both files."""
    vertices, faces = knot()
    lines = ["# A (2, 3) torus knot, made by experiments/scenes/make_assets.py"]
    lines += ["v " + " ".join(f"{x:.4f}" for x in vertex) for vertex in vertices]
    lines += ["f " + " ".join(str(k + 1) for k in face) for face in faces]
    (TARGET / "knot.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    Image.fromarray(poster()).save(TARGET / "poster.png", optimize=True)


if __name__ == "__main__":
    main()
