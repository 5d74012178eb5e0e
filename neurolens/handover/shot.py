"""The pinhole that the files of a shot are of, frame by frame, in the units of cameras: mm for lens and film, else m.

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
from numpy.typing import NDArray

from neurolens.cameras.field import Field
from neurolens.render.stmap import Plates

Array = NDArray[np.float64]

FAR_M = 1e6  # stands for infinity where a program takes no other number


@dataclass(frozen=True)
class Pinhole:
    """One frame.

    Attributes:
        number: of the frame; digits: as file names have it, "" for a still.
        focal_mm: see the module. squeeze: focal length of the y over that of the x meridian.
        pupil_mm: from the film to the entrance pupil; focus_m: to what is in focus, at most `FAR_M`.
        f_stop: see the module. t_stop: None where it is not known.
    """

    number: int
    digits: str
    focal_mm: float
    squeeze: float
    pupil_mm: float
    focus_m: float
    f_stop: float
    t_stop: float | None

    @classmethod
    def of(cls, number: str, field: Field, settings: Mapping[str, Any], focus_m: float) -> Pinhole:
        """The pinhole of a camera's frame; `number` as in file names."""
        state, (x, y) = settings["lens_state"], field.frame.reach_mm
        size = y / (state["effective_focal_length_mm"] or y)
        return cls(
            int(number or 1), number, y, float(f"{y / x:.6g}"), field.frame.pupil_mm[1], min(focus_m, FAR_M),
            size * state["f_number"], state["t_stop"],
        )  # fmt: skip

    @property
    def name(self) -> str:
        """What file names have of the frame."""
        return f".{self.digits}" if self.digits else ""


@dataclass(frozen=True)
class Handed:
    """A shot: what the templates of its files read.

    Attributes:
        lens, designer: names, of strangers' files. rate: frames a second, numerator and denominator.
        frames: one or more. plates: sizes of the lens's picture and of the undistorted one.
        colours: names of colours that have maps of their own.
    """

    lens: str
    designer: str
    version: str
    rate: tuple[int, int]
    frames: tuple[Pinhole, ...]
    plates: Plates
    colours: tuple[str, ...]

    @property
    def animated(self) -> bool:
        """Whether there are frames by number."""
        return bool(self.frames[0].digits)

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.rate[0] / self.rate[1]

    @property
    def pixel_aspect(self) -> float:
        """The width of a pixel over its height in what it shows."""
        return float(f"{self.frames[0].squeeze * self.plates.pixel_mm[0] / self.plates.pixel_mm[1]:.6g}")

    def film_mm(self, undistorted: bool) -> tuple[float, float]:
        """The film of the pinhole for the lens's picture or the undistorted one, widths stretched by the squeeze."""
        width, height = self.plates.undistorted if undistorted else self.plates.picture
        return width * self.plates.pixel_mm[0] * self.frames[0].squeeze, height * self.plates.pixel_mm[1]

    @property
    def margin(self) -> tuple[int, int]:
        """Pixels of the undistorted picture left of and below the lens's."""
        (width, height), (wide, high) = self.plates.picture, self.plates.undistorted
        return (wide - width) // 2, (high - height) // 2

    @property
    def pattern(self) -> str:
        """The frame's number in file names as Nuke has it."""
        return f".%0{len(self.frames[0].digits)}d" if self.animated else ""


def falloff(light: Array, radius: Array) -> tuple[tuple[float, float, float], float]:
    """Coefficients of r^2, r^4, r^6 of light over that on the axis, by least squares, and the worst that they leave."""
    lit = light > 0
    powers = np.stack([radius[lit] ** k for k in (2, 4, 6)], 1)
    scale = powers.max(0)
    found = np.linalg.lstsq(powers / scale, light[lit] - 1, rcond=None)[0] / scale
    a, b, c = found.tolist()
    return (a, b, c), float(np.abs(powers @ found + 1 - light[lit]).max())


def film_radii(field: Field, film_mm: tuple[float, float], count: int = 65) -> Array:
    """Radii from the axis to the film's corner, or where the light ends, without the axis, mm."""
    return np.linspace(0, min(field.end_mm, math.hypot(*film_mm) / 2), count)[1:]
