"""The time of a path of a picture and the noise of a camera, whose product is proportional to the time to equal error.

A pixel is the mean of n samples w L of weights and radiances, which are independent. With a and b the squared relative
deviations of these, its relative variance is ((1 + a)(1 + b) - 1) / n. Where radiances vary much, which is where
samples are many, it is proportional to 1 + a = mean(w^2) / mean(w)^2: so many times the rays of a camera of even
weights give its error. Weights that are 1 with probability p and else 0 need 1 / p times the rays.

In our renderer a camera that disperses has more noise than that, and its paths take longer. `work_of` measures both for
a scene.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

from neurolens.cameras.build import as_c, ideal_as
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.job import Job, develop
from neurolens.pictures.render.renderer import run
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.world import shared_worlds
from neurolens.studies.plan.footprints import Array, Places
from neurolens.studies.plan.probe import Probe

_ROUNDS = 7  # in which the rays of a camera are timed
# To measure the paths of a picture: the most strips; the fewest rows of one (where cameras disperse, rows beside a
# strip have light in it and are rendered, too); paths of all strips, and the part of the picture's paths that these may
# be; samples of a pixel, at most. Thin lenses and those that disperse gain differently by more samples: noise is
# compared at the scene's own number.
_STRIPS, _ROWS, _STRIP_PATHS, _PART, _SAMPLES = 6, 4, 400_000, 400, 16
_MOST_DARK = 0.05  # share of the places that may be dark


@dataclass(frozen=True)
class Work:
    """What all cameras share in the time and noise of a path; each pair is without and with dispersion.

    Attributes:
        rest: nanoseconds of a path besides the camera's ray; 0 where the camera alone counts.
        noise: variance at equal samples and equal weights, relative to cameras that do not disperse.
    """

    rest: tuple[float, float] = (0.0, 0.0)
    noise: tuple[float, float] = (1.0, 1.0)

    @property
    def whole(self) -> bool:
        """Whether the whole picture counts, and not the camera alone."""
        return any(self.rest)


ALONE = Work()  # where the camera alone counts


def noise(weight: Array, share: Array) -> float:
    """Return how many times as many rays a camera with weights [N, W, P] needs, averaged over places.

    `share` is that of each wavelength. The result is inf where more than 5% of the places get no light.
    """
    mean, square = ((w.mean(-1) * share).sum(-1) for w in (weight, weight**2))
    lit = mean > 0
    return float((square[lit] / mean[lit] ** 2).mean()) if lit.mean() > 1 - _MOST_DARK else math.inf


def ns_a_ray(camera: Camera, places: Places) -> float:
    """Return the processor's nanoseconds for a ray on one thread: the least of some calls."""
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
    return min(ns)


def work_of(probed: Probe) -> Work:
    """Measure the time of a path in our renderer, and what dispersion does to its noise.

    Strips of the scene's picture are rendered through a thin lens and through the exact lens.
    """
    scene, places = probed.scene, probed.places
    thin = as_c(ideal_as("thin:", probed.exact.lens, probed.shot))
    shot = scene.settings.camera
    samples = min(shot.samples, _SAMPLES)
    strips = strips_of(scene, min(shot.width * shot.height * shot.samples // _PART, _STRIP_PATHS), samples)
    rest, variance = [], []
    for camera, seen in ((thin, probed.thin_seen), (probed.exact, probed.seen)):
        with shared_worlds():
            _strip(scene, camera, 0, (0, 1), samples)  # fits and compilations, done once, are no part of a path
            some = [[_strip(scene, camera, seed, rows, samples) for rows in strips] for seed in (0, 1)]
        ns = np.array([[seconds for _, seconds in row] for row in some]).min(axis=0).mean()
        rest.append(max(float(ns) - ns_a_ray(camera, places), 0.0))
        one, two = (np.concatenate([picture for picture, _ in row]) for row in some)
        apart = np.square(one - two).mean(axis=-1)  # is twice the variance
        # brighter differences, from the rarest lights, are left to chance
        most = np.percentile(apart, 100 * (1 - _MOST_DARK))
        mean = max(float(one.mean()), 1e-30)
        variance.append(float(np.minimum(apart, most).mean()) / mean**2 / noise(seen.weight, places.share))
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
