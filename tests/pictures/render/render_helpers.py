"""What the renderer's tests share: scenes from tables, radiance along one ray, comparisons of noisy means."""

import math
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.integrator import Paths, trace
from neurolens.pictures.render.sampler import Sampler
from neurolens.pictures.render.scene import Scene, scene_from_tables
from neurolens.pictures.render.world import World

CAMERA: dict[str, Any] = {"position_m": [0, 0, 1], "look_at_m": [0, 0, 0], "focus_m": 2}
FILM = (36.0, 24.0)
SIZE: dict[str, Any] = {"width": 36, "height": 24}
WHITE = {"colour": [1, 1, 1]}
THIN, PINHOLE = ThinLens(50.0, 2.0, 3.0, FILM), Pinhole(50.0, FILM)


def scene(camera: dict[str, Any] | None = None, **tables: Any) -> Scene:
    return scene_from_tables({"camera": CAMERA | (camera or {}), **tables}, "test.toml")


def world(camera: dict[str, Any] | None = None, lanes: int = 1, **tables: Any) -> World:
    return World(scene(camera, **tables), SpectralRange(400, 700, lanes=lanes))


def diffuse(*rgb: float) -> dict[str, Any]:
    return {"kind": "diffuse", "reflectance": list(rgb)}


MATERIALS: dict[str, Any] = {
    "white": diffuse(1, 1, 1),
    "grey": diffuse(0.5, 0.5, 0.5),
    "mirror": {"kind": "mirror", "reflectance": [1, 1, 1]},
    "glass": {"kind": "glass", "n_d": 1.6, "V_d": 35.0},
    "plastic": {"kind": "glossy", "specular": [0.05] * 3, "roughness": 0.3, "reflectance": [0.5] * 3},
}
FLOOR = {"point_m": [0, 0, 0], "normal": [0, 1, 0], "material": "grey"}


def on_floor(**tables: Any) -> World:
    """A grey floor, or as `planes` says, and what else is given."""
    return world(**({"materials": MATERIALS, "planes": [FLOOR]} | tables))


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """What the system says of a longer file is what it says of a full disk, but for the words."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def lit_scene(red: float = 0.7, camera: dict[str, Any] | None = None) -> Scene:
    """A ball and a lamp in white surroundings."""
    ball = {"centre_m": [0, 0, -2], "radius_m": 0.7, "material": "m"}
    lamp = {"centre_m": [1, 1, -1], "radius_m": 0.3, "emission": [9, 8, 7]}
    return scene(camera, environment=WHITE, materials={"m": diffuse(red, 0.6, 0.5)}, spheres=[ball, lamp])


def radiance(
    made: World,
    origin: list[float],
    towards: list[float],
    samples: int = 4096,
    max_depth: int = 4,
    aim: bool = True,
    seed: int = 0,
    lanes: int = 1,
    pixels: int = 1,
) -> np.ndarray:
    """Radiance [samples] ([lanes, samples], [pixels * samples]) along one ray, wavelengths spread over 400-700 nm."""
    direction = np.subtract(towards, origin)
    direction = direction / np.linalg.norm(direction)
    sampler, count = Sampler(samples, seed), pixels * samples
    pixel, sample = np.divmod(np.arange(count), samples)
    rays = [np.repeat(np.float32(v)[:, None], count, axis=1) for v in (origin, direction)]
    bins = np.arange(count) * 256 // count if pixels == 1 else np.full(count, 128)
    weight = np.ones((lanes, count), np.float32)
    found = trace(made, sampler, sampler.keys(pixel, sample), Paths.of(*rays, weight, bins), max_depth, aim=aim)
    return found if lanes > 1 else found[0]


def assert_aimed(made: World, towards: list[float], noise: float, resolved: float = 0.03, max_depth: int = 3) -> None:
    """Aiming at lights changes the noise, to less than `noise` of it, and not the mean, known to `resolved` of it."""
    aimed = radiance(made, [0, 1, 3], towards, samples=16384, max_depth=max_depth)
    found = radiance(made, [0, 1, 3], towards, samples=65536, max_depth=max_depth, aim=False, seed=1)
    assert aimed.std() < noise * found.std()
    tolerance = 4 * math.hypot(aimed.std() / 128, found.std() / 256)
    assert tolerance < resolved * aimed.mean() and abs(aimed.mean() - found.mean()) < tolerance


def assert_same_mean(a: np.ndarray, b: np.ndarray, resolved: float) -> None:
    """Means of pictures [seed, H, W, 3] agree within 4 standard errors over seeds, at most `resolved` of them."""
    means = a.mean(axis=(1, 2)), b.mean(axis=(1, 2))  # [seed, 3]
    error = np.sqrt(sum(m.var(axis=0, ddof=1) / len(m) for m in means))
    assert np.all(error < resolved * means[0].mean(axis=0))
    assert np.all(np.abs(means[0].mean(axis=0) - means[1].mean(axis=0)) < 4 * error)
