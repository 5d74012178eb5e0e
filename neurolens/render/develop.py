"""From the film's sums to a picture and its layers, whole or as far as it got."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.job import Job
from neurolens.render.sums import DEPTH, HITS, LUMINANCE2, PASSED, RGB

# Of the layers, for the metadata of a picture.
MEANING = {
    "samples": "samples in the pixel",
    "variance": "of the pixel's luminance (linear sRGB), from its samples as if they were independent",
    "depth": "channel Z: m along the optical axis from the film's plane to the first surface, mean; inf: none",
    "blocked": "share of the samples whose camera ray did not pass",
}


@dataclass(frozen=True)
class Layers:
    """What a picture says of its own pixels, [H, W] float32 each.

    Attributes:
        samples: samples in the pixel, 0 where nothing is done yet.
        variance: of the pixel's luminance (of linear sRGB after the white balance), estimated from its samples as if
            they were independent: the sample variance over their number. That of low-discrepancy samples is lower.
            Infinite below two samples. With wavelength lanes four paths count as one sample.
        depth: distance in m along the optical axis from the film's plane to the first surface, the mean over samples
            that hit one: what is in focus is at `focus_m`. Infinite where none did.
        blocked: share of the samples whose camera ray did not pass the lens.
    """

    samples: FloatArray
    variance: FloatArray
    depth: FloatArray
    blocked: FloatArray


def develop(job: Job) -> tuple[FloatArray, Layers]:
    """Picture [H, W, 3] float32 linear sRGB and its layers; each tile is divided by the samples that it has.

    It may be called while the workers go on.
    """
    tiling, grid = job.tiling, job.grid
    rgb = np.zeros((tiling.pixels, 3), np.float32)
    planes = np.zeros((4, tiling.pixels), np.float32)
    for first, stop in tiling.chunks():
        sums, done = job.film.copy(first, stop)
        part = tiling.pixels_of(first, stop)
        samples = np.repeat(tiling.samples_done(done), tiling.tile)[: len(sums)]
        colour = sums[:, RGB] / np.maximum(samples, 1)[:, None]
        rgb[part] = colour if job.neutral else colour @ job.balance.T
        planes[:, part] = _layers(job, sums, samples)
    shape = (grid.height, grid.width)
    return rgb.reshape(*shape, 3), Layers(*(plane.reshape(shape) for plane in planes))


def _layers(job: Job, sums: NDArray[np.float64], samples: NDArray[np.int64]) -> NDArray[np.float64]:
    """Samples, variance, depth and blocked share [4, n]."""
    total = sums[:, RGB] @ job.luminance_row
    groups = -(-samples // job.paths_a_sample)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Of the sum over independent samples, then of the mean over paths.
        spread = np.maximum(sums[:, LUMINANCE2] - total**2 / groups, 0) * groups / (groups - 1)
        variance = np.where(groups > 1, spread / samples.astype(np.float64) ** 2, np.inf)
        depth = np.where(sums[:, HITS] > 0, sums[:, DEPTH] / sums[:, HITS], np.inf)
        blocked = np.where(samples > 0, 1 - sums[:, PASSED] / samples, 0.0)
    return np.stack([samples, variance, depth, blocked])
