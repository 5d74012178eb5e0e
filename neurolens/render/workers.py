"""The work of a render: tiles of pixels, shared out to workers, on one film.

Workers are forked processes: numpy's short operations leave no time for threads to share the interpreter (two threads
were slower than one at 8k-element batches, two processes twice as fast). Where the system does not fork, threads do the
work.
"""

from __future__ import annotations

import mmap
import multiprocessing
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import Camera, FloatArray
from neurolens.errors import NeurolensError
from neurolens.render.film import PixelGrid
from neurolens.render.filmsettings import FilmSettings
from neurolens.render.integrator import trace
from neurolens.render.sampler import FILM, PUPIL, WAVELENGTH, Sampler
from neurolens.render.scatter import lit
from neurolens.render.scene import CameraSettings
from neurolens.render.scenefile import Scene
from neurolens.render.wavelengths import LANES, mode_for, spectral_range
from neurolens.render.world import World

BATCH = 32768  # paths; fewer, and calling numpy costs more than computing; many more, and their state leaves the cache
CAMERA_BATCH = 8192  # rays a call: a network keeps more numbers a ray than the tracer
SAMPLES_A_PASS = 16
Progress = Callable[[float, float], None]


def camera_axes(settings: CameraSettings) -> FloatArray:
    """Rotation [3, 3] from camera to scene axes: columns right, up, backwards."""
    backwards = np.subtract(settings.position_m, settings.look_at_m)
    backwards = backwards / np.linalg.norm(backwards)
    right = np.cross(settings.up, backwards)
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(backwards, right), backwards]).astype(np.float32)


def _shared(shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
    """Zeros that forked workers share."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer(mmap.mmap(-1, size), dtype).reshape(shape)


class Job:
    """One render: the scene made ready, and memory shared by the workers.

    Attributes:
        film: [pixels, 3] float64 sums. done: [tiles] passes finished. tallies: [3] seconds in the camera, paths passed,
        seconds in all. message: text of a worker's error. stop: set to end the work early.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        grid: PixelGrid,
        samples: int,
        seed: int,
        max_depth: int,
        film: FilmSettings,
        differentials: bool = False,
    ) -> None:
        settings = scene.settings.camera
        self.mode = mode_for(camera, grid, settings.wavelengths_nm, film)
        self.camera, self.grid, self.samples, self.max_depth = camera, grid, samples, max_depth
        self.differentials = differentials
        self.spectral = spectral_range(scene, camera, film, LANES if self.mode == "hero" else 1)
        self.world = World(scene, self.spectral)
        self.response = self.spectral.rotated(self.spectral.response)
        self.sampler = Sampler(samples, seed)
        self.axes, self.position = camera_axes(settings), np.array(settings.position_m, np.float32)
        self.pixels = grid.width * grid.height
        self.samples_a_pass = min(samples, SAMPLES_A_PASS)
        self.tile = max(1, BATCH // self.samples_a_pass)
        self.passes = -(-samples // self.samples_a_pass)
        self.film = _shared((self.pixels, 3), np.float64)
        self.done = _shared((-(-self.pixels // self.tile),), np.int64)
        self.tallies = _shared((3,), np.float64)
        self.message, self.stop = _shared((4096,), np.uint8), _shared((1,), np.uint8)

    def work(self, claimed: Any) -> None:
        """Take tiles, all of one pass before the next, until none is left; `claimed` counts them over all workers."""
        try:
            opener = getattr(self.camera, "for_worker", None)
            camera = opener() if opener else self.camera
            while True:
                with claimed.get_lock():
                    number = claimed.value
                    claimed.value += 1
                part, tile = divmod(number, len(self.done))
                if part >= self.passes or self.stop[0]:
                    return
                # Sums are added in the order of passes, so that rounding does not depend on the workers.
                while self.done[tile] != part:
                    if self.stop[0]:
                        return
                    time.sleep(1e-4)
                tallies = self._render_tile(camera, tile, part)
                self.done[tile] += 1
                with claimed.get_lock():
                    self.tallies += tallies
        except BaseException:
            text = traceback.format_exc().encode()[-len(self.message) :]
            self.message[: len(text)] = np.frombuffer(text, np.uint8)
            self.stop[0] = 1
            raise

    def _render_tile(self, camera: Camera, tile: int, part: int) -> NDArray[np.float64]:
        """Add one pass of one tile to the film."""
        began = time.perf_counter()
        first = tile * self.tile
        pixels = np.arange(first, min(first + self.tile, self.pixels))
        indices = np.arange(part * self.samples_a_pass, min((part + 1) * self.samples_a_pass, self.samples))
        pixel, sample = np.repeat(pixels, len(indices)), np.tile(indices, len(pixels))
        lanes = LANES if self.mode == "lanes" else 1
        keys = self.sampler.keys(pixel, sample // lanes)
        hue = self.sampler.draw(keys, WAVELENGTH)
        if lanes > 1:
            hue = _turned(hue, (sample % lanes / lanes).astype(np.float32))
        film_mm = self.grid.film_points(pixel, self.sampler.draw2(keys, FILM))
        pupil = self.sampler.draw2(keys, PUPIL)

        asked = time.perf_counter()
        origin, direction, weight = self._hero_rays(camera, film_mm, pupil, hue)
        answered = time.perf_counter()

        bins = self.spectral.bin_of(hue)
        value = trace(self.world, self.sampler, keys, origin, direction, weight, bins, self.max_depth)
        shape = (len(pixels), len(indices))
        colour = self.response.take(bins, axis=-1).reshape(-1, 3, *shape)
        self.film[pixels] += np.einsum("lcps,lps->pc", colour, value.reshape(-1, *shape))
        passed = float(lit(weight).size)
        return np.array([answered - asked, passed, time.perf_counter() - began])

    def _hero_rays(
        self, camera: Camera, film_mm: FloatArray, pupil: FloatArray, hue: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rays of the hero wavelengths; weights [lanes, N] of all lanes where there are several."""
        rays = self._camera_rays(camera, film_mm, pupil, self._camera_wavelengths(hue))
        lanes = self.spectral.lanes
        if lanes == 1:
            return rays
        weight = np.empty((lanes, len(hue)), np.float32)
        weight[:] = rays[2]
        if camera.dispersive or not getattr(camera, "achromatic", False):
            for lane in range(1, lanes):
                wavelength_nm = self._camera_wavelengths(_turned(hue, np.float32(lane / lanes)))
                weight[lane] = self._camera_rays(camera, film_mm, pupil, wavelength_nm)[2]
            weight *= rays[2] > 0  # the hero's ray must exist
        weight /= lanes
        return rays[0], rays[1], weight

    def _camera_rays(
        self, camera: Camera, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Origins and directions [3, N] in the scene and weights [N], 0 for rays that do not pass."""
        count = len(wavelength_nm)
        origin, direction = np.empty((3, count), np.float32), np.empty((3, count), np.float32)
        weight = np.empty(count, np.float32)
        sample = camera.sample_differentials if self.differentials else camera.sample  # type: ignore[attr-defined]
        for start in range(0, count, CAMERA_BATCH):
            part = slice(start, start + CAMERA_BATCH)
            inputs = (film_mm[:, part], pupil[:, part], wavelength_nm[part])
            rays = sample(*(np.ascontiguousarray(x) for x in inputs))
            np.add(self.axes @ rays.origin_m, self.position[:, None], out=origin[:, part])
            np.matmul(self.axes, rays.direction, out=direction[:, part])
            weight[part] = np.where(rays.status == 0, rays.weight, np.float32(0))
        return origin, direction, weight

    def _camera_wavelengths(self, hue: FloatArray) -> FloatArray:
        """Wavelengths for the camera; one that does not disperse gets them clipped to what it was made for."""
        wavelengths = self.spectral.wavelengths_nm(hue)
        accepted = self.camera.wavelength_nm
        if accepted is not None:
            np.clip(wavelengths, accepted[0], accepted[1], out=wavelengths)
        return wavelengths


def _turned(hue: FloatArray, by: FloatArray | np.float32) -> FloatArray:
    """Numbers in [0, 1) turned round."""
    turned = hue + by
    turned -= turned >= 1
    return turned


def run(job: Job, workers: int, progress: Progress | None) -> None:
    """Do the work in this process, or in forked ones while this one reports progress."""
    context = multiprocessing.get_context("fork" if sys.platform.startswith("linux") else None)
    claimed = context.Value("q", 0)
    if workers == 1 and progress is None:
        job.work(claimed)
        return
    fork = sys.platform.startswith("linux") and workers > 1
    kind: Any = context.Process if fork else threading.Thread
    team = [kind(target=_quiet, args=(job, claimed), daemon=True) for _ in range(workers)]
    began = time.perf_counter()
    try:
        with _interrupts_held():  # which forked workers inherit: the one that hears Ctrl-C is this process
            for worker in team:
                worker.start()
        while any(worker.is_alive() for worker in team):
            team[-1].join(0.05)
            fraction = float(job.done.sum()) / (len(job.done) * job.passes)
            if progress is not None and fraction > 0:
                progress(fraction, (time.perf_counter() - began) * (1 / fraction - 1))
            if fork and any(worker.exitcode for worker in team):
                break  # killed, and the others may wait for its tile for ever
    finally:
        job.stop[0] = 1
        for worker in team:
            if worker.ident is None:
                continue  # interrupted before it was started
            if fork:
                worker.terminate()
            worker.join()
    if job.message[0]:
        raise NeurolensError(f"a render worker failed: {bytes(job.message).rstrip(bytes(1)).decode(errors='replace')}")
    if int(job.done.sum()) != len(job.done) * job.passes:
        raise NeurolensError("a render worker was killed before it had finished")


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Keep Ctrl-C waiting inside the block; processes and threads started there never see it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _quiet(job: Job, claimed: Any) -> None:
    """`Job.work`, its error left in the shared message alone."""
    try:
        job.work(claimed)
    except Exception:
        return
