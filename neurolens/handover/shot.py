"""The pinhole that the files of a shot are of, frame by frame; what the templates of all texts read.

Its place is the entrance pupil, its focal length the paraxial size of the picture (of a lens with cylinders: of the y
meridian, and widths are stretched by the squeeze). Breathing is a focal length that changes with the focus. Its
f-number is this focal length over the entrance pupil's diameter, which gives discs of the lens's size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurolens.cameras.field import Array, Complex, Field
from neurolens.render.stmap import Plates

FAR_M = 1e6  # stands for infinity where a program takes no other number


@dataclass(frozen=True)
class Pinhole:
    """One frame.

    Attributes:
        number: of the frame; name: of it in file names, ".0001", "" for a still.
        focal_mm: see the module. squeeze: focal length of the y over that of the x meridian.
        pupil_mm: from the film to the entrance pupil; focus_m: to what is in focus, at most `FAR_M`.
        f_stop: see the module. t_stop: None where it is not known.
    """

    number: int
    name: str
    focal_mm: float
    squeeze: float
    pupil_mm: float
    focus_m: float
    f_stop: float
    t_stop: float | None

    @classmethod
    def of(cls, number: str, field: Field, settings: Mapping[str, Any], focus_m: float) -> Pinhole:
        """The pinhole of a camera's frame; `number` as file names have it."""
        state, (x, y) = settings["lens_state"], field.frame.reach_mm
        size = y / (state["effective_focal_length_mm"] or y)
        return cls(
            int(number or 1), f".{number}" if number else "", y, float(f"{y / x:.6g}"), field.frame.pupil_mm[1],
            min(focus_m, FAR_M), size * state["f_number"], state["t_stop"],
        )  # fmt: skip


@dataclass(frozen=True)
class Handed:
    """A shot.

    Attributes:
        attributes: of the first camera, see `render.pictures.standard_attributes`; texts are a stranger's.
        rate: frames a second, numerator and denominator. colours: names of those that have maps of their own.
    """

    attributes: Mapping[str, Any]
    version: str
    rate: tuple[int, int]
    frames: tuple[Pinhole, ...]
    plates: Plates
    colours: tuple[str, ...]

    @property
    def lens(self) -> str:
        """The lens's name, not empty."""
        return str(self.attributes.get("lensModel") or self.attributes["cameraModel"])

    @property
    def pixel_aspect(self) -> float:
        """The width of a pixel over its height in what it shows."""
        return float(f"{self.frames[0].squeeze * self.plates.pixel_mm[0] / self.plates.pixel_mm[1]:.6g}")

    def film_mm(self, size: tuple[int, int], squeezed: bool = False) -> tuple[float, float]:
        """The film of a picture of so many pixels, of the pinhole's focal length in both directions or as it is."""
        stretch = 1.0 if squeezed else self.frames[0].squeeze
        return size[0] * self.plates.pixel_mm[0] * stretch, size[1] * self.plates.pixel_mm[1]


def falloff(light: Array, radius: Array) -> tuple[tuple[float, ...], float]:
    """Coefficients of r^2, r^4, r^6 of light over that on the axis, by least squares, and the worst that they leave."""
    lit = light > 0
    powers = np.stack([radius[lit] ** k for k in (2, 4, 6)], 1)
    scale = powers.max(0)
    found = np.linalg.lstsq(powers / scale, light[lit] - 1, rcond=None)[0] / scale
    return tuple(found.tolist()), float(np.abs(powers @ found + 1 - light[lit]).max())


def film_points(field: Field, film_mm: tuple[float, float], count: int = 65) -> Complex:
    """Points from the axis, without it, to the film's corner, or where the light ends, mm."""
    return np.linspace(0, min(field.end_mm, math.hypot(*film_mm) / 2), count)[1:].astype(np.complex128)
