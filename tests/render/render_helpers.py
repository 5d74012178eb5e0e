"""What the renderer's tests share: scenes from tables, radiance along one ray."""

from __future__ import annotations

from typing import Any

import numpy as np

from neurolens.render.integrator import trace
from neurolens.render.sampler import Sampler
from neurolens.render.scene import Scene, scene_from_tables
from neurolens.render.spectrum import SpectralRange
from neurolens.render.world import World

CAMERA: dict[str, Any] = {"position_m": [0, 0, 1], "look_at_m": [0, 0, 0], "focus_m": 2}
WHITE = {"colour": [1, 1, 1]}


def scene(camera: dict[str, Any] | None = None, **tables: Any) -> Scene:
    return scene_from_tables({"camera": CAMERA | (camera or {}), **tables}, "test.toml")


def world(camera: dict[str, Any] | None = None, **tables: Any) -> World:
    return World(scene(camera, **tables), SpectralRange(400, 700))


def diffuse(*rgb: float) -> dict[str, Any]:
    return {"kind": "diffuse", "reflectance": list(rgb)}


def radiance(
    made: World,
    origin: list[float],
    towards: list[float],
    samples: int = 4096,
    max_depth: int = 4,
    aim: bool = True,
    seed: int = 0,
) -> np.ndarray:
    """Radiance [samples] along one ray, wavelengths spread over 400-700 nm."""
    direction = np.subtract(towards, origin)
    direction = direction / np.linalg.norm(direction)
    sampler = Sampler(samples, seed)
    keys = sampler.keys(np.zeros(samples, np.intp), np.arange(samples))
    rays = [np.repeat(np.float32(v)[:, None], samples, axis=1) for v in (origin, direction)]
    bins = np.arange(samples) * 256 // samples
    return trace(made, sampler, keys, *rays, np.ones(samples, np.float32), bins, max_depth, aim=aim)
