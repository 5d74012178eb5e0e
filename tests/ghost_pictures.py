"""Pictures of ghosts, each of some layers, for tests of what is drawn."""

from collections.abc import Sequence

import numpy as np

from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import ghost_layers


def ghost_picture(job: FlareJob, layers: Sequence[int] | None = None) -> np.ndarray:
    """The ghosts of lights, [layers, H, W, 3] linear sRGB; for each pair its layer, or all in one."""
    layers = [0] * len(job.tracer.pairs) if layers is None else layers
    picture = np.zeros((1 + max(layers, default=0), job.raster.height, job.raster.width, 3), np.float32)
    for number, drawn in ghost_layers(job, layers):
        picture[number] = drawn
    return picture
