"""The film: which film point a pixel is, and the linear RGB that gathers there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray

# A picture whose pixels are this much out of square is a mistake, not a choice.
_ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class PixelGrid:
    """A picture of width x height pixels on a film of `film_mm`.

    A lens throws its picture upside down and mirrored. The film is turned by 180 degrees on the way to the picture: the
    pixel at the top left is the film point at +x, -y in the lens frame.

    Raises:
        InputError: picture and film differ in shape.
    """

    width: int
    height: int
    film_mm: tuple[float, float]

    def __post_init__(self) -> None:
        for field in ("width", "height"):
            if getattr(self, field) < 1:
                raise InputError("picture", field, getattr(self, field), "an integer above 0")
        film = self.film_mm[0] / self.film_mm[1]
        if abs(self.width / self.height / film - 1) > _ASPECT_TOLERANCE:
            shape = f"{self.film_mm[0]:g} x {self.film_mm[1]:g} mm"
            raise InputError("picture", "width x height", (self.width, self.height), f"the shape of the film, {shape}")

    def film_points(self, pixel: NDArray[np.intp], jitter: FloatArray) -> FloatArray:
        """Film points [2, N] in mm of pixels [N], numbered row by row from the top left, and places [2, N] in them."""
        row, column = np.divmod(pixel, self.width)
        points = np.empty((2, len(pixel)), np.float32)
        across, down = (column + jitter[0]) / self.width, (row + jitter[1]) / self.height
        points[0] = (0.5 - across) * self.film_mm[0]
        points[1] = (down - 0.5) * self.film_mm[1]
        return points
