"""Renders a scene through a camera."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurolens.cameras.contract import Camera, FloatArray
from neurolens.errors import InputError
from neurolens.render.colour import balance
from neurolens.render.film import PixelGrid
from neurolens.render.filmsettings import FilmSettings
from neurolens.render.illuminants import check_name
from neurolens.render.scenefile import Scene
from neurolens.render.workers import Job, Progress, run


@dataclass(frozen=True)
class RenderResult:
    """A picture and how it was made.

    Attributes:
        rgb: [H, W, 3] float32 linear sRGB; a uniform environment of radiance 1 gives 1 on the axis.
        stats: JSON-able; settings, seconds, paths, mpaths_per_s, passed_fraction, thread_seconds (summed over the
            workers), camera_thread_seconds (of these, in the camera), camera_fraction (their ratio).
    """

    rgb: FloatArray
    stats: dict[str, Any]


def render(
    scene: Scene,
    camera: Camera,
    *,
    width: int | None = None,
    height: int | None = None,
    samples: int | None = None,
    seed: int = 0,
    threads: int = 2,
    max_depth: int | None = None,
    film: FilmSettings | None = None,
    differentials: bool = False,
    progress: Progress | None = None,
) -> RenderResult:
    """Path-trace `scene` through `camera`.

    The result depends on the seed, not on the number of threads; cameras share all random numbers.

    Args:
        width, height, samples, max_depth: as in `CameraSettings`; left out, those of the scene.
        film: spectral sampling and white balance; left out, those of the scene.
        threads: workers. A camera may have `for_worker() -> Camera`, called once in each, to open sessions of its own.
        differentials: ask the camera for ray differentials, too. Nothing uses them: for measuring what they cost.
        progress: called now and then with the fraction done and the estimated seconds left.

    Raises:
        InputError: a size or count below 1, an unknown illuminant, picture and film of different shape, a camera
            that disperses and does not cover the scene's wavelengths, or one without the differentials asked for.
        NeurolensError: a worker failed; the message holds its traceback.
    """
    settings, film = scene.settings.camera, film or scene.settings.film
    if film.white_balance is not None:
        check_name("render", "film.white_balance", film.white_balance, scene.illuminants)
    job = Job(
        scene,
        camera,
        PixelGrid(width or settings.width, height or settings.height, camera.film_mm),
        _at_least_one("samples", settings.samples if samples is None else samples),
        seed,
        _at_least_one("max_depth", settings.max_depth if max_depth is None else max_depth),
        film,
        differentials,
    )
    if differentials:
        _check_differentials(camera)
    began = time.perf_counter()
    run(job, min(_at_least_one("threads", threads), len(job.done)), progress)
    seconds = time.perf_counter() - began
    grid, paths = job.grid, job.pixels * job.samples
    stats = {
        "scene": scene.name,
        "camera": camera.name,
        "width": grid.width,
        "height": grid.height,
        "samples": job.samples,
        "seed": seed,
        "max_depth": job.max_depth,
        "threads": threads,
        "wavelengths_nm": [job.spectral.low_nm, job.spectral.high_nm],
        "wavelengths": job.mode,
        "wavelength_sampling": film.wavelength_sampling,
        "white_balance": film.white_balance,
        "seconds": seconds,
        "paths": paths,
        "mpaths_per_s": paths / seconds * 1e-6,
        "passed_fraction": float(job.tallies[1]) / paths,
        "differentials": differentials,
        "thread_seconds": float(job.tallies[2]),
        "camera_thread_seconds": float(job.tallies[0]),
        "camera_fraction": float(job.tallies[0] / max(job.tallies[2], 1e-12)),
    }
    rgb = job.film / job.samples
    if film.white_balance is not None and job.spectral.colours:
        rgb = rgb @ balance(job.spectral.film_rgb(job.world.palette.illuminant(film.white_balance))).T
    return RenderResult(rgb.astype(np.float32).reshape(grid.height, grid.width, 3), stats)


def _check_differentials(camera: Camera) -> None:
    """Ask for the differentials of one ray, so that a camera without them is found before the work."""
    ask = getattr(camera, "sample_differentials", None)
    if ask is None:
        raise InputError("render", "differentials", True, f"left out: camera {camera.name} has none")
    low, high = camera.wavelength_nm or (550.0, 550.0)
    ask(np.zeros((2, 1), np.float32), np.full((2, 1), 0.5, np.float32), np.full(1, (low + high) / 2, np.float32))


def _at_least_one(field: str, value: int) -> int:
    if value < 1:
        raise InputError("render", field, value, "an integer above 0")
    return value
