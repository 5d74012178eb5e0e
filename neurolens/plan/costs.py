"""The cost of a camera in its target: nanoseconds or operations a ray, times the noise of its weights.

That is proportional to the seconds to equal error. A pixel is the mean of n samples w L of weights and radiances, which
are independent; with a and b their squared relative deviations its relative variance is ((1 + a)(1 + b) - 1) / n. Where
radiances vary much, that is where samples are many, it goes with 1 + a = mean(w^2) / mean(w)^2: so many times the rays
of a camera of even weights have its error. Weights that are 1 with probability p and else 0 need 1 / p times the rays.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping

import numpy as np

from neurolens.base.records import Timing
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera
from neurolens.graph.program import Program
from neurolens.plan.footprints import Array, Places
from neurolens.render.renderer import render
from neurolens.render.scene import Scene
from neurolens.shaders.osl import OslLens, osl_program
from neurolens.shaders.source import camera_program

UNIT = {"render": "ns", "c": "ns", "onnx": "ns", "osl": "ns", "glsl": "operations"}
# Of a camera ray in Cycles under a white sky, experiments/results/osl_speed.md: Blender's own cameras; any shader, each
# of its operations, and what each division and root takes besides. Fitted to the least times of the six cameras of
# lenses there, on quiet cores: within 2.8%.
CYCLES_NS: Mapping[str, float] = {"pinhole": 111.9, "thin": 139.5}
SHADER_NS = 70.42
_STEP_NS, _DEAR_NS, _DEAR = 0.2761, 2.324, ("div", "sqrt")
# Of GLSL that anybody writes: a direction with its length, a point of a disc by concentric squares, the plane in focus.
GLSL_OPERATIONS: Mapping[str, float] = {"pinhole": 14, "thin": 44, "thick": 47}
_ROUNDS, _SIDE = 7, 16
_REST_ACROSS, _REST_SAMPLES = 96, 4
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
_MOST_DARK = 0.05  # of the places


def noise(weight: Array, share: Array) -> float:
    """The factor of rays that a camera with weights [N, W, P] needs, by the share of each wavelength: mean over places.

    inf where more than 5% of the places get no light.
    """
    mean, square = ((w.mean(-1) * share).sum(-1) for w in (weight, weight**2))
    lit = mean > 0
    return float((square[lit] / mean[lit] ** 2).mean()) if lit.mean() > 1 - _MOST_DARK else math.inf


def ns_a_ray(camera: Camera, places: Places) -> Timing:
    """Nanoseconds of a ray: least and median of some calls on one thread."""
    rays = int(getattr(camera, "rays_a_call", RAYS_A_CALL))
    rng = np.random.default_rng(1)
    rows = rng.integers(0, places.film_mm.shape[1], rays)
    film, pupil = places.film_mm[:, rows].astype(np.float32), rng.random((2, rays), np.float32)
    waves = rng.choice(places.wavelength_nm, rays, p=places.share).astype(np.float32)
    ns = []
    for _ in range(_ROUNDS):
        began = time.perf_counter()
        camera.sample(film, pupil, waves)
        ns.append(1e9 * (time.perf_counter() - began) / rays)
    return {"min": min(ns), "median": statistics.median(ns), "repeats": _ROUNDS}


def small(scene: Scene, across: int) -> tuple[int, int]:
    """Width and height of the scene's picture, no wider than `across`."""
    shot = scene.settings.camera
    width = min(across, shot.width)
    return width, max(round(width * shot.film_mm[1] / shot.film_mm[0]), 1)


def rest_ns(scene: Scene, camera: Camera) -> float:
    """Nanoseconds of one thread that a path takes besides its camera, by a small picture in our renderer."""
    width, height = small(scene, _REST_ACROSS)
    stats = render(scene, camera, width=width, height=height, samples=_REST_SAMPLES, threads=1).stats
    return float(1e9 * (stats["thread_seconds"] - stats["camera_thread_seconds"]) / stats["paths"])


def glsl_operations(camera: OnnxCamera | ExactCamera) -> int:
    """Count the operations of a ray of `neurolens export --whole-camera --to glsl`; a fused multiply-add counts as one.

    Raises:
        InputError: a lens or model that has no such form.
    """
    graph = camera.lens_graph()
    return sum(camera_program(camera.film, graph, own_table=False).count().values())


def cycles_ns(program: Program) -> float:
    """Nanoseconds of a ray of a shader in Cycles, by its operations."""
    kinds = program.count()
    return SHADER_NS + _STEP_NS * sum(kinds.values()) + _DEAR_NS * sum(kinds.get(k, 0) for k in _DEAR)


def shader_cost(
    lens: OslLens, places: Places, film_mm: tuple[float, float], f_number: float, focus_m: float
) -> tuple[float, float]:
    """Nanoseconds of a ray of a shader in Cycles by its operations, and its noise in luminance.

    The noise is that of the shader's own throughput at the places: of its pupil, and of wavelengths drawn evenly.
    """
    program = osl_program(lens, {"count": 0.0})
    ns = cycles_ns(program)
    points, rays = places.film_mm.shape[1], _SIDE * _SIDE
    steps, rng = (np.arange(_SIDE) + 0.5) / _SIDE, np.random.default_rng(1)
    first, second = np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    # Low bits of the first number tell the wavelength.
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
