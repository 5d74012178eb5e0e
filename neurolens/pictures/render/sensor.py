"""Turns a linear picture into what a sensor reads: electrons of a pixel's colour, their noise, and numbers.

A pixel whose value is v takes `electrons` times v on average, as if its colour filters were those of linear sRGB.
Values below 0, which lie beyond the gamut, give none. Photons arrive by chance (Poisson), the well holds at most
`full_well`, reading adds normal noise, and the converter rounds: number = black level + electrons * (2^bits - 1 - black
level) / full well. The area of the pixel is in the picture already, whose filter is a box (`FilmSettings.fill_factor`).

Each row has its own random numbers, so that a picture in tiles has the noise of the whole one.
"""

from dataclasses import asdict
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render.settings import SensorSettings

RAW = "raw"  # the channel of a mosaic; other pictures have raw.R, raw.G and raw.B
_SURE = 20.0  # standard deviations above a full well at which a pixel is surely full


def expose(rgb: FloatArray, settings: SensorSettings, seed: int = 0, first_row: int = 0) -> dict[str, FloatArray]:
    """Return the numbers that a sensor reads of a picture [H, W, 3] of linear sRGB: [H, W] float32 by channel.

    Args:
        seed: of the noise. first_row: where this is a part, the number of its first row in the whole picture, so that
            colours of the mosaic and noise are those of the whole.

    Raises:
        InputError: no such picture, or values that are not finite.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or not rgb.size:
        raise InputError("sensor", "picture", rgb.shape, "[height, width, 3]")
    if bad := int(np.count_nonzero(~np.isfinite(rgb))):
        raise InputError("sensor", "picture", f"({bad} values not finite)", "finite values")
    height, width = rgb.shape[:2]
    colours = {f"{RAW}.{name}": np.full((height, width), k) for k, name in enumerate("RGB")}
    if settings.mosaic != "none":
        cells = np.array(["RGB".index(name) for name in settings.mosaic]).reshape(2, 2)
        row, column = np.ogrid[first_row : first_row + height, :width]
        colours = {RAW: cells[row % 2, column % 2]}
    stated, noisy = about(settings, seed), settings.noise == "all"
    full = settings.full_well + _SURE * settings.full_well**0.5 + _SURE**2
    planes = {name: np.empty((height, width), np.float32) for name in colours}
    for k in range(height):
        random = np.random.default_rng([seed, first_row + k])
        for name, colour in colours.items():
            mean = np.take_along_axis(rgb[k], colour[k, :, None], 1)[:, 0].astype(np.float64) * settings.electrons
            mean = mean.clip(0, full)
            counted = np.minimum(random.poisson(mean) if noisy else mean, settings.full_well)
            read = counted + (settings.read_noise * random.standard_normal(width) if noisy else 0.0)
            numbers = np.rint(settings.black + read / stated["electrons_per_number"])
            planes[name][k] = numbers.clip(0, stated["white_level"])
    return planes


def about(settings: SensorSettings, seed: int) -> dict[str, Any]:
    """Return the metadata of the channels: the settings, the largest number, and how many electrons a step of it is."""
    most = 2**settings.bits - 1
    electrons = settings.full_well / (most - settings.black)
    known = {"black_level": settings.black, "seed": seed, "white_level": most, "electrons_per_number": electrons}
    return asdict(settings) | known
