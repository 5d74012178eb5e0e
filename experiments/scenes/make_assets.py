"""Make what the scenes in experiments/scenes load: the meshes knot.obj (a torus knot), vase.ply (with normals and
texture coordinates), ridge.ply (a mountain ridge), firs.ply (a wood on a shore) and four pieces of chess, the pictures
poster.png, glaze.png (for the vase) and studio.png (lamps all around).

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
    return vertices, triangles(a, b, c, d)


def triangles(*corners: np.ndarray) -> np.ndarray:
    """Two triangles [T, 3] for each four corners."""
    a, b, c, d = corners
    return np.concatenate([np.stack(x, axis=-1).reshape(-1, 3) for x in ((a, b, c), (a, c, d))])


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles [T, 3] between `rows` + 1 rows of `columns` + 1 vertices, anticlockwise with columns to the right."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    return triangles(*(x * (columns + 1) + y for x, y in ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j))))


def revolved(line: np.ndarray, slope: np.ndarray, around: int, repeats: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 8] (point, normal, texture coordinates) and faces [T, 3] of an outline turned about the y axis.

    `line`, `slope`: [N, 2] radius and height, and their derivatives; `repeats`: of the texture around.
    """
    angle = np.linspace(0, 2 * np.pi, around + 1)
    radius, height, dr, dy = (np.broadcast_to(x[:, None], (len(line), around + 1)) for x in (*line.T, *slope.T))
    cos, sin = (np.broadcast_to(f(angle), radius.shape) for f in (np.cos, np.sin))
    normal = np.stack([dy * cos, -dr, -dy * sin])
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-12)
    uv = [repeats * angle / (2 * np.pi) + 0 * radius, height / line[-1, 1]]
    vertices = np.stack([radius * cos, height, -radius * sin, *normal, *uv], axis=-1).reshape(-1, 8)
    return vertices, grid_faces(len(line) - 1, around)


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


def vase(around: int = 30, up: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 8] and faces [T, 3] of a vase 1 m high that stands on y = 0."""
    t = np.linspace(0, 1, up)

    def outline(t: np.ndarray) -> np.ndarray:
        return 0.20 + 0.11 * np.sin(2 * np.pi * (1.25 * t - 0.25 * t * t) - 0.6) - 0.04 * t

    slope = (outline(t + 1e-5) - outline(t - 1e-5)) / 2e-5
    return revolved(np.stack([outline(t), t], axis=-1), np.stack([slope, np.ones(up)], axis=-1), around, repeats=3)


# Outlines of turned pieces of chess: radius and height in mm, from the foot up; a repeated point is a corner.
FOOT = [(0, 0), (1, 0), (1, 0), (1, 0.05), (1, 0.05), (0.97, 0.09), (0.86, 0.12), (0.84, 0.15), (0.75, 0.20)]
PIECES: dict[str, tuple[float, list[tuple[float, float]]]] = {
    "pawn": (
        14.5,
        [(8.0, 14), (5.6, 22), (5.0, 29), (5.2, 29), (8.2, 30.5), (8.4, 32), (5.5, 33.5), (5.6, 34), (8.4, 38)]
        + [(9.3, 42), (8.4, 46), (5.4, 50), (0, 51.5)],
    ),
    "bishop": (
        17.0,
        [(9.5, 18), (6.4, 30), (5.6, 42), (5.8, 42), (9.6, 44), (9.8, 46), (6.2, 48), (6.4, 49), (9.0, 55)]
        + [(9.2, 60), (6.6, 67), (3.0, 71.5), (2.3, 72.5), (3.2, 74.5), (2.4, 76.8), (0, 77.5)],
    ),
    "queen": (
        19.0,
        [(10.5, 20), (7.2, 36), (6.2, 54), (6.5, 54), (10.8, 56.5), (11.0, 58.5), (7.2, 60.5), (7.3, 62), (9.0, 70)]
        + [(11.8, 79), (11.8, 79), (11.2, 80), (8.5, 79.6), (6.5, 82), (3.4, 84), (2.9, 85), (3.8, 87), (2.8, 89.4)]
        + [(0, 90)],
    ),
    "king": (
        20.0,
        [(11.0, 22), (7.6, 40), (6.6, 58), (6.9, 58), (11.4, 60.5), (11.6, 63), (7.6, 65), (7.8, 66.5), (9.6, 76)]
        + [(11.6, 84), (11.6, 84), (10.4, 86.5), (4.5, 89), (2.2, 90), (2.2, 90), (1.9, 93), (4.3, 94.5), (4.3, 94.5)]
        + [(4.3, 97.5), (4.3, 97.5), (1.9, 99), (2.4, 102.5), (0, 103)],
    ),
}


def turned(foot: float, outline: list[tuple[float, float]], around: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 8] in metres and faces [T, 3] of a turned piece, whose foot has this radius in mm."""
    points = np.array([(foot * r, foot * 0.95 * y) for r, y in FOOT] + outline) / 1000
    # A spline by chords, with three points between two; where a point repeats, the outline has a corner.
    rows = [points[:1]]
    padded = np.concatenate([points[:1], points, points[-1:]])
    for before, here, there, after in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        t = np.linspace(0, 1, 5)[1:, None]
        left, right = (there - before) / 2, (after - here) / 2
        reach = float(np.linalg.norm(there - here))
        left, right = (v * min(1.0, reach / max(float(np.linalg.norm(v)), 1e-9)) for v in (left, right))
        rows.append(
            (2 * t**3 - 3 * t**2 + 1) * here + (t**3 - 2 * t**2 + t) * left
            + (3 * t**2 - 2 * t**3) * there + (t**3 - t**2) * right
        )  # fmt: skip
    line = np.concatenate(rows)
    line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-6])]
    line[:, 0] = np.maximum(line[:, 0], 0)
    return revolved(line, np.gradient(line, axis=0), around)


def ridge(doublings: int = 8, slopes: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [T, 3] of a ridge from x = -1 to 1, at most 1 high at z = 0, that falls to z = 0.6."""
    chance = np.random.default_rng(5)
    height = np.array([0.15, 0.45, 0.1, 0.6, 0.25])
    for k in range(doublings - 2):  # midpoints move by less and less
        middle = (height[1:] + height[:-1]) / 2 + 0.16 * 0.56**k * chance.standard_normal(len(height) - 1)
        height = np.insert(height, np.arange(1, len(height)), middle)
    height = (height - height.min() + 0.1) / (np.ptp(height) + 0.1)
    down = np.linspace(0, 1, slopes)[:, None]
    rough = 0.05 * np.sin(np.pi * down) * chance.standard_normal((slopes, len(height)))
    x = np.broadcast_to(np.linspace(-1, 1, len(height)), rough.shape)
    y = (height * (1 - down) ** 1.3 + rough).clip(0)
    y[-1] = -0.02
    vertices = np.stack([x, y, np.broadcast_to(0.6 * down, x.shape)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(slopes - 1), np.arange(len(height) - 1), indexing="ij")
    corners = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
    return vertices, triangles(*(u * len(height) + v for u, v in corners))


def firs(count: int = 90, boughs: int = 5, around: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [T, 3] of firs in m, each a stack of cones, thick on the left and thin to the right."""
    chance = np.random.default_rng(2)
    x = -46 + 62 * chance.random(count) ** 1.6
    z = -52 + 0.3 * x - 14 * chance.random(count)
    tall = (5 + 5 * chance.random(count)) * np.where(x < -14, 1.2, 0.8)
    k = np.arange(boughs)[:, None]
    angle = 2 * np.pi * np.arange(around) / around + 0.8 * k
    points, faces = [], []
    for tree in range(count):
        reach = 0.19 * tall[tree] * (1 - 0.17 * k) * (1 + 0.25 * chance.standard_normal((boughs, around)))
        low = tall[tree] * (0.1 + 0.17 * k - 0.04 * chance.random((boughs, around)))
        ring = np.stack([x[tree] + reach * np.cos(angle), low, z[tree] + reach * np.sin(angle)], axis=-1)
        tips = np.stack([np.full(boughs, x[tree]), tall[tree] * (0.32 + 0.17 * k[:, 0]), np.full(boughs, z[tree])], -1)
        first = tree * boughs * (around + 1) + k * (around + 1)
        turn = np.arange(around)
        points.append(np.concatenate([tips[:, None], ring], axis=1).reshape(-1, 3))
        faces += [np.stack(np.broadcast_arrays(first, first + 1 + (turn + 1) % around, first + 1 + turn), -1)]
    return np.concatenate(points), np.concatenate(faces).reshape(-1, 3)


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a binary PLY file of vertices, [V, 8] or [V, 3] (points alone), and triangles [T, 3]."""
    every = ("x", "y", "z", "nx", "ny", "nz", "s", "t")
    names = "".join(f"property float {name}\n" for name in every[: vertices.shape[1]])
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}"
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    path.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def glaze(size: int = 96) -> np.ndarray:
    """A picture [size, size, 3] uint8 that repeats sideways: waves and dots in blue on cream."""
    y, x = np.mgrid[0:size, 0:size] / size
    picture = np.empty((size, size, 3))
    picture[:] = (236, 228, 206)
    wave = np.abs(y - 0.5 - 0.07 * np.sin(4 * np.pi * x))
    picture[(wave < 0.03) | ((wave > 0.26) & (wave < 0.30))] = (24, 66, 140)
    for row in (0.34, 0.66):
        picture[np.hypot((4 * x) % 1 - 0.5, 4 * (y - row)) < 0.28] = (176, 60, 40)
    return picture.astype(np.uint8)


def studio(height: int = 64) -> np.ndarray:
    """An equirectangular picture [height, 2 height, 3] uint8: three soft lamps in a dim room."""
    v, u = (np.mgrid[0:height, 0 : 2 * height] + 0.5) / height
    picture = np.empty((height, 2 * height, 3))
    picture[:] = (np.array([26, 28, 34]) * (1.3 - v[..., None])).clip(0)
    for left, right, top, bottom, colour in (
        (0.25, 0.55, 0.22, 0.46, (255, 240, 220)),
        (1.20, 1.32, 0.15, 0.60, (190, 215, 255)),
        (1.65, 1.90, 0.30, 0.36, (255, 180, 120)),
    ):
        picture[(u > left) & (u < right) & (v > top) & (v < bottom)] = colour
    return picture.astype(np.uint8)


def main() -> None:
    """Write all files."""
    vertices, faces = knot()
    lines = ["# A (2, 3) torus knot, made by experiments/scenes/make_assets.py"]
    lines += ["v " + " ".join(f"{x:.4f}" for x in vertex) for vertex in vertices]
    lines += ["f " + " ".join(str(k + 1) for k in face) for face in faces]
    (TARGET / "knot.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    pieces = {name: turned(foot, outline) for name, (foot, outline) in PIECES.items()}
    for name, mesh in {"vase": vase(), "ridge": ridge(), "firs": firs(), **pieces}.items():
        write_ply(TARGET / f"{name}.ply", *mesh)
    for name, picture in (("poster", poster()), ("glaze", glaze()), ("studio", studio())):
        Image.fromarray(picture).save(TARGET / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
