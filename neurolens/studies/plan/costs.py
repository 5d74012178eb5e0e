"""The cost of a camera in its target: nanoseconds or operations of a path, times the noise of its picture.

Their product is proportional to the seconds to equal error. A pixel is the mean of n samples w L of weights and
radiances, which are independent. With a and b the squared relative deviations of these, its relative variance is ((1 +
a)(1 + b) - 1) / n. Where radiances vary much, which is where samples are many, it is proportional to 1 + a = mean(w^2)
/ mean(w)^2: so many times the rays of a camera of even weights give its error. Weights that are 1 with probability p
and else 0 need 1 / p times the rays.

In our renderer a camera that disperses has more noise than that, and its paths take longer: both are measured for the
scene, by strips of its picture through the exact lens and through a thin one (`work_of`).
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from neurolens.base.records import Timing
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera
from neurolens.cameras.shaders.osl import OslLens, osl_program
from neurolens.cameras.shaders.source import camera_program
from neurolens.graph.program import Program
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.job import Job, develop
from neurolens.pictures.render.renderer import run
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.world import shared_worlds
from neurolens.studies.plan.footprints import Array, Places

UNIT = {"render": "ns", "c": "ns", "onnx": "ns", "osl": "ns", "glsl": "operations"}
# Of a camera ray in Cycles under a white sky, experiments/results/osl_speed.md: Blender's own cameras; for a shader a
# base, each of its operations, and what a division or a root takes besides. Fitted to the least times of the six lenses
# there, on quiet cores: within 3.5%.
CYCLES_NS: Mapping[str, float] = {"pinhole": 114.4, "thin": 140.9}
SHADER_NS = 90.66
_STEP_NS, _DEAR_NS, _DEAR = 0.2295, 2.772, ("div", "sqrt")
# Of GLSL as anybody would write it: a direction with its length, a point of a disc by concentric squares, the plane in
# focus.
GLSL_OPERATIONS: Mapping[str, float] = {"pinhole": 14, "thin": 44, "thick": 47}
_ROUNDS, _SIDE = 7, 16
# To measure the paths of a picture: the most strips; the fewest rows of one (where cameras disperse, rows beside a
# strip have light in it and are rendered, too); paths of all strips, and the part of the picture's paths that these may
# be; samples of a pixel, at most. Thin lenses and those that disperse gain differently by more samples: noise is
# compared at the scene's own number.
_STRIPS, _ROWS, _STRIP_PATHS, _PART, _SAMPLES = 6, 4, 400_000, 400, 16
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
_MOST_DARK = 0.05  # share of the places that may be dark


@dataclass(frozen=True)
class Work:
    """What all cameras of a kind share in the cost of a path; each pair is without and with dispersion.

    Attributes:
        rest: cost of a path without the hero's camera ray; 0 where the camera alone counts.
        noise: variance at equal samples and equal weights, relative to cameras that do not disperse.
    """

    rest: tuple[float, float] = (0.0, 0.0)
    noise: tuple[float, float] = (1.0, 1.0)


ALONE = Work()  # where the camera alone counts


def noise(weight: Array, share: Array) -> float:
    """Return how many times as many rays a camera with weights [N, W, P] needs, averaged over places.

    `share` is that of each wavelength. It is inf where more than 5% of the places get no light.
    """
    mean, square = ((w.mean(-1) * share).sum(-1) for w in (weight, weight**2))
    lit = mean > 0
    return float((square[lit] / mean[lit] ** 2).mean()) if lit.mean() > 1 - _MOST_DARK else math.inf


def ns_a_ray(camera: Camera, places: Places) -> Timing:
    """Return the processor's nanoseconds for a ray: least and median of some calls on one thread."""
    rays = int(getattr(camera, "rays_a_call", RAYS_A_CALL))
    rng = np.random.default_rng(1)
    rows = rng.integers(0, places.film_mm.shape[1], rays)
    film, pupil = places.film_mm[:, rows].astype(np.float32), rng.random((2, rays), np.float32)
    waves = rng.choice(places.wavelength_nm, rays, p=places.share).astype(np.float32)
    ns = []
    for _ in range(_ROUNDS):
        began = time.process_time()
        camera.sample(film, pupil, waves)
        ns.append(1e9 * (time.process_time() - began) / rays)
    return {"min": min(ns), "median": statistics.median(ns), "repeats": _ROUNDS}


def small(scene: Scene, across: int) -> tuple[int, int]:
    """Return width and height of the scene's picture, no wider than `across`."""
    shot = scene.settings.camera
    width = min(across, shot.width)
    return width, max(round(width * shot.film_mm[1] / shot.film_mm[0]), 1)


def work_of(scene: Scene, plain: Camera, colours: Camera, places: Places, weights: tuple[Array, Array]) -> Work:
    """Measure the work of a path of our renderer, and what dispersion does to its noise.

    Args:
        plain, colours: cameras of the same lens, without and with its dispersion. weights: those of both at the places,
            as for `noise`.
    """
    shot = scene.settings.camera
    samples = min(shot.samples, _SAMPLES)
    paths = min(shot.width * shot.height * shot.samples // _PART, _STRIP_PATHS)
    strips = strips_of(scene, paths, samples)
    rest, variance = [], []
    for camera, weight in zip((plain, colours), weights, strict=True):
        with shared_worlds():
            _strip(scene, camera, 0, (0, 1), samples)  # fits and compilations, done once, are no part of a path
            some = [[_strip(scene, camera, seed, rows, samples) for rows in strips] for seed in (0, 1)]
        ns = np.array([[seconds for _, seconds in row] for row in some]).min(axis=0).mean()
        rest.append(max(float(ns) - ns_a_ray(camera, places)["min"], 0.0))
        one, two = (np.concatenate([picture for picture, _ in row]) for row in some)
        apart = np.square(one - two).mean(axis=-1)  # is twice the variance
        # brighter differences, from the rarest lights, are left to chance
        most = np.percentile(apart, 100 * (1 - _MOST_DARK))
        mean = max(float(one.mean()), 1e-30)
        variance.append(float(np.minimum(apart, most).mean()) / mean**2 / noise(weight, places.share))
    ratio = variance[1] / variance[0] if variance[0] > 0 and math.isfinite(variance[1]) else 1.0
    return Work((rest[0], rest[1]), (1.0, ratio))


def strips_of(scene: Scene, paths: int, samples: int) -> list[tuple[int, int]]:
    """Return first row and the one after the last of strips of a picture that have `paths` paths in all."""
    shot = scene.settings.camera
    rows = max(paths // (samples * shot.width), 1)
    count = min(max(rows // _ROWS, 1), _STRIPS)
    rows = min(rows // count, shot.height)
    firsts = np.unique(np.linspace(0, shot.height - rows, count + 2).astype(int)[1:-1])
    return [(int(first), int(first) + rows) for first in firsts]


def _strip(scene: Scene, camera: Camera, seed: int, rows: tuple[int, int], samples: int) -> tuple[Array, float]:
    """Render rows of a picture; also return a path's nanoseconds of the processor (a clock counts other work)."""
    shot = scene.settings.camera
    grid = PixelGrid(shot.width, shot.height, camera.film_mm)
    job = Job(scene, camera, grid, samples, seed, shot.max_depth, scene.settings.film, rows)
    began = time.process_time()
    run(job, 1)
    took = time.process_time() - began
    return develop(job)[0].astype(np.float64), 1e9 * took / (job.tiling.pixels * samples)


def glsl_operations(camera: OnnxCamera | ExactCamera) -> int:
    """Count the operations of a ray of `neurolens export --whole-camera --to glsl`; a fused multiply-add counts as one.

    Raises:
        InputError: the lens or model has no such form.
    """
    graph = camera.lens_graph()
    return sum(camera_program(camera.film, graph, own_table=False).count().values())


def cycles_ns(program: Program) -> float:
    """Return the nanoseconds of a ray of a shader in Cycles, from its operations."""
    kinds = program.count()
    return SHADER_NS + _STEP_NS * sum(kinds.values()) + _DEAR_NS * sum(kinds.get(k, 0) for k in _DEAR)


def shader_cost(
    lens: OslLens, places: Places, film_mm: tuple[float, float], f_number: float, focus_m: float
) -> tuple[float, float]:
    """Return the nanoseconds of a shader's ray in Cycles, from its operations, and the noise of its luminance.

    The noise is that of the shader's own throughput at the places: from its pupil, and from wavelengths drawn evenly.
    """
    program = osl_program(lens, {"count": 0.0})
    ns = cycles_ns(program)
    points, rays = places.film_mm.shape[1], _SIDE * _SIDE
    steps, rng = (np.arange(_SIDE) + 0.5) / _SIDE, np.random.default_rng(1)
    first, second = np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    # The low bits of the first number choose the wavelength within a part of the spectrum.
    low = (rng.permuted(np.tile(np.arange(rays), (points, 1)), axis=1) + 0.5) / rays
    raster = 0.5 - places.film_mm / np.array(film_mm)[:, None]
    half = math.pi / 3
    call = {
        "f_number": f_number, "asked_m": min(focus_m, 1e9), "roundness": 0.0, "in_colour": 1.0, "shaded": 1.0,
        "as_lens": 0.0, "at_pupil": 0.0, "unit_m": 1.0, "warned": 0.0, "pixel_x": 1e-3, "pixel_y": 1e-3,
        "sensor_x_mm": film_mm[0], "sensor_y_mm": film_mm[1], "half_cos": math.cos(half),
        "half_sin": math.sin(half), "edge_cos": math.cos(half), "edge_sin": math.sin(half),
    }  # fmt: skip
    rows = {"raster_x": np.repeat(raster[0], rays), "raster_y": np.repeat(raster[1], rays)}
    rows |= {"first": (np.tile(first, points) + low.ravel() / 4096).ravel(), "second": np.tile(second, points)}
    call |= {f"{a.name}_mm": a.range[0] for a in lens.axes if a.name == "zoom"}
    found = program.evaluate({**rows, **{k: np.float32(v) for k, v in call.items()}})
    light = sum(y * found[f"throughput_{k}"].astype(np.float64) for k, y in enumerate(_LUMINANCE))
    return ns, noise(np.broadcast_to(light, points * rays).reshape(points, 1, rays), np.ones(1))
