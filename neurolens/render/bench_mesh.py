"""How fast rays meet meshes, by the tree in numpy and by Embree: `python -m neurolens.render.bench_mesh SCENE`.

Rays from all around each mesh of the scene towards its middle, in the batches of a render. Prints the fastest of some
repeats of each, and their ratio.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensError
from neurolens.render.mesh import EmbreeMesh, Mesh
from neurolens.render.primitives import Primitive, Rays
from neurolens.render.scene import load_scene

_BATCH = 32768
_MAKERS: dict[str, Callable[..., Primitive]] = {"tree": Mesh, "embree": EmbreeMesh}


def measure(scene: str | Path, repeats: int = 5) -> list[dict[str, float]]:
    """Nanoseconds a ray for each mesh of a scene: triangles, share of rays that hit, tree, embree (if installed).

    Raises:
        InputError: a scene that cannot be read or has no mesh, a count below 1.
    """
    if repeats < 1:
        raise InputError("bench", "repeats", repeats, "an integer above 0")
    triangles = load_scene(scene).triangles
    if not triangles:
        raise InputError(scene, "meshes", "(none)", "a scene with a mesh")
    return [_race(part.vertices, part.faces, repeats) for part in triangles]


def _race(vertices: NDArray[np.float64], faces: NDArray[np.int64], repeats: int) -> dict[str, float]:
    rays = _rays_around(vertices)
    found: dict[str, float] = {"triangles": len(faces)}
    for name, make in _MAKERS.items():
        try:
            mesh = make(0, vertices, faces)
        except ImportError:
            continue
        times = []
        for _ in range(repeats):
            best, hit = np.full(_BATCH, np.inf, np.float32), np.full(_BATCH, -1, np.int32)
            began = time.perf_counter()
            mesh.nearer(rays, best, hit)
            times.append(time.perf_counter() - began)
        found["hit"] = float(np.mean(hit >= 0))
        found[name] = min(times) / _BATCH * 1e9
    return found


def _rays_around(vertices: NDArray[np.float64]) -> Rays:
    random = np.random.default_rng(0)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre, reach = (0.5 * (low + high))[:, None], float(np.linalg.norm(high - low))
    origin = random.normal(size=(3, _BATCH))
    origin = centre + 2 * reach * origin / np.linalg.norm(origin, axis=0)
    direction = centre + random.uniform(-0.5, 0.5, (3, _BATCH)) * (high - low)[:, None] - origin
    direction /= np.linalg.norm(direction, axis=0)
    return Rays.of(origin.astype(np.float32), direction.astype(np.float32))


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status, 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="scene file (TOML) with meshes")
    parser.add_argument("--repeats", type=int, default=5, help="default 5")
    try:
        rows = measure(**vars(parser.parse_args(argv)))
    except NeurolensError as error:
        print(error, file=sys.stderr)
        return 2
    for row in rows:
        line = f"{row['triangles']} triangles, {row['hit']:.0%} of rays hit: tree {row['tree']:.0f} ns a ray"
        if "embree" in row:
            line += f", Embree {row['embree']:.0f} ns, {row['tree'] / row['embree']:.1f} times as fast"
        print(line)
    if "embree" not in rows[0]:
        print("Embree is not installed: pip install neurolens[embree]")
    return 0


if __name__ == "__main__":
    sys.exit(main())
