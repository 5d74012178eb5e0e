"""What a measure is given: a shot, the camera that took it, and the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.gallery.cameras import Shot
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.evaluate.image import Image


@dataclass(frozen=True)
class View:
    """One camera's share of a panel.

    Attributes:
        shot: panel, scene and lens. camera: of the whole film, in millimetres of the lens frame.
        column: its name. rgb: [H, W, 3] linear sRGB of the part that is drawn, before any exposure.
    """

    shot: Shot
    camera: Camera
    column: str
    rgb: FloatArray

    @property
    def window_mm(self) -> tuple[float, float, float, float]:
        """Centre x and y as printed, width and height of the picture."""
        return self.shot.panel.window_mm or (0.0, 0.0, *self.shot.film_mm)

    @property
    def grey(self) -> Image:
        """[H, W] luminance (Rec. 709)."""
        return luminance(self.rgb)

    def places_mm(self) -> tuple[Image, Image]:
        """Film x and y [H, W] of the pixels' middles, as printed: x right, y up."""
        height, width = self.rgb.shape[:2]
        x, y, wide, tall = self.window_mm
        across = x + wide * ((np.arange(width) + 0.5) / width - 0.5)
        up = y + tall * (0.5 - (np.arange(height) + 0.5) / height)
        x_mm, y_mm = np.meshgrid(across, up)
        return x_mm, y_mm


def luminance(rgb: FloatArray) -> Image:
    """Rec. 709 luminance of linear RGB [..., 3]."""
    grey: Image = np.asarray(rgb, np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    return grey
