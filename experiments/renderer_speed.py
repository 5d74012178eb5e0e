"""Paths per second of the renderer through a thin lens with the scene's focus and aperture, fastest and median.

With --meshes, instead, nanoseconds per ray of each mesh of the scene, by the tree in numpy and by Embree.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from neurolens.base.errors import InputError
from neurolens.cameras.ideal import ThinLens
from neurolens.render.mesh import EmbreeMesh, Mesh
from neurolens.render.primitives import Primitive, Rays
from neurolens.render.renderer import render
from neurolens.render.scene import Scene, load_scene
from neurolens.render.wavelengths import LANES


def thin_camera(scene: Scene) -> ThinLens:
    """A 50 mm thin lens with the scene's focus and stop."""
    settings = scene.settings.camera
    film_mm = (settings.film_width_mm, settings.film_height_mm)
    return ThinLens(50.0, settings.f_number or 2.8, settings.focus_m, film_mm)


def measure(
    scene: str | Path, threads: int = 2, depth: int = 3, samples: int = 16, repeats: int = 5
) -> dict[str, float]:
    """Speed of a scene file at its own picture size, through a thin lens with the scene's focus and aperture.

    Returns:
        mpaths_per_s of the fastest and of the median render, their seconds, paths a render, lanes (wavelengths per
        path).
    """
    loaded = load_scene(scene)
    camera, size = thin_camera(loaded), {"samples": samples, "threads": threads, "max_depth": depth}
    stats = [render(loaded, camera, seed=k, **size).stats for k in range(repeats)]  # type: ignore[arg-type]
    seconds, paths = [s["seconds"] for s in stats], stats[0]["paths"]
    return {
        "mpaths_per_s": paths / min(seconds) * 1e-6,
        "mpaths_per_s_median": paths / statistics.median(seconds) * 1e-6,
        "seconds_min": min(seconds),
        "seconds_median": statistics.median(seconds),
        "paths": paths,
        "lanes": LANES if stats[0]["wavelengths"] == "hero" else 1,
    }


_BATCH = 32768


_MAKERS: dict[str, Callable[..., Primitive]] = {"tree": Mesh, "embree": EmbreeMesh}


def measure_meshes(scene: str | Path, repeats: int = 5) -> list[dict[str, float]]:
    """Nanoseconds a ray for each mesh of a scene: triangles, share of rays that hit, tree, embree (if installed).

    Raises:
        InputError: a scene that cannot be read or has no mesh.
    """
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


OPTIONS = (
    lab.option("scene", metavar="SCENE.toml", type=Path, help="scene file"),
    *(lab.count(n, k, f"default {k}") for n, k in (("threads", 2), ("depth", 3), ("samples", 16), ("repeats", 5))),
    lab.option("--meshes", action="store_true", help="the scene's meshes, in numpy and in Embree"),
)


def run(args: argparse.Namespace) -> None:
    """Print the speeds."""
    for row in measure_meshes(args.scene, args.repeats) if args.meshes else ():
        line = f"{row['triangles']} triangles, {row['hit']:.0%} of rays hit: tree {row['tree']:.0f} ns per ray"
        more = " (Embree is not installed: pip install neurolens[embree])"
        if "embree" in row:
            more = f", Embree {row['embree']:.0f} ns, {row['tree'] / row['embree']:.1f} times as fast"
        print(line + more)
    if not args.meshes:
        found = measure(args.scene, args.threads, args.depth, args.samples, args.repeats)
        print(
            f"{found['mpaths_per_s']:.2f} Mpath/s fastest, {found['mpaths_per_s_median']:.2f} median ({found['paths']} "
            f"paths of depth {args.depth}, wavelengths each: {found['lanes']}, {args.threads} threads, "
            f"{found['seconds_min']:.2f} s fastest, {found['seconds_median']:.2f} s median)"
        )
