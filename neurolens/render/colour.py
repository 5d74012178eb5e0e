"""Colour spaces of a picture, and the adaptation from one white to another.

The film gathers linear sRGB. Everything after that is one matrix: other primaries, another white, a white
balance. Whites are adapted by von Kries scaling in the Bradford space.

Sources: IEC 61966-2-1 (sRGB), Academy S-2014-004 (ACEScg: primaries AP1, the white of ACES near D60), SMPTE RP 177-1993
(primaries to matrix), Lam 1985 and ICC.1 Annex E (Bradford), OpenEXR's standard attributes and the ids of the Color
Interop Forum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.cameras.contract import FloatArray

Matrix = NDArray[np.float64]

BRADFORD: Matrix = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def xyz_of(xy: ArrayLike) -> Matrix:
    """CIE XYZ [3] of a chromaticity (x, y) with Y = 1."""
    x, y = np.asarray(xy, np.float64)
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _solve(matrix: Matrix, right: Matrix) -> Matrix:
    return np.asarray(np.linalg.solve(matrix, right), np.float64)


def adaptation(xyz_from: ArrayLike, xyz_to: ArrayLike) -> Matrix:
    """Matrix [3, 3] on XYZ that turns one white into another (XYZ [3] each) and keeps its luminance (Bradford)."""
    source, target = (np.asarray(white, np.float64) / np.asarray(white)[1] for white in (xyz_from, xyz_to))
    scale = np.diag(BRADFORD @ target / (BRADFORD @ source))
    return _solve(BRADFORD, scale @ BRADFORD)


@dataclass(frozen=True)
class ColourSpace:
    """A linear RGB space.

    Attributes:
        name: for display and the command line. interop_id: value of the attribute colorInteropID of an EXR.
        primaries: chromaticities (x, y) of red, green and blue. white: of (1, 1, 1).
    """

    name: str
    interop_id: str
    primaries: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    white: tuple[float, float]

    @property
    def to_xyz(self) -> Matrix:
        """Matrix [3, 3] from RGB to XYZ; the white has Y = 1."""
        columns = np.column_stack([xyz_of(xy) for xy in self.primaries])
        return columns * np.linalg.solve(columns, xyz_of(self.white))

    @property
    def chromaticities(self) -> tuple[float, ...]:
        """Primaries and white as OpenEXR's attribute of that name has them, 8 numbers."""
        return tuple(value for xy in (*self.primaries, self.white) for value in xy)

    @property
    def stated(self) -> dict[str, Any]:
        """What the metadata of a picture say of its colours."""
        return {"space": self.name, "white_xy": list(self.white), "adaptation": "Bradford"}


SRGB = ColourSpace("sRGB", "lin_rec709_scene", ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)), (0.3127, 0.3290))
ACESCG = ColourSpace("ACEScg", "lin_ap1_scene", ((0.713, 0.293), (0.165, 0.830), (0.128, 0.044)), (0.32168, 0.33767))
COLOUR_SPACES = {space.name: space for space in (SRGB, ACESCG)}


def conversion(source: ColourSpace, target: ColourSpace) -> Matrix:
    """Matrix [3, 3] from one linear RGB to another; white stays white."""
    adapt = adaptation(xyz_of(source.white), xyz_of(target.white))
    return _solve(target.to_xyz, adapt @ source.to_xyz)


def converted(colours: NDArray[np.floating], matrix: ArrayLike) -> NDArray[np.floating]:
    """Colours [..., 3] times rows of a matrix [n, 3]: [..., n], each rounded the same in whatever array it stands.

    A product by BLAS rounds the last rows of an array otherwise, and a tile would not be that part of its picture.
    """
    columns = np.asarray(matrix).T
    total = colours[..., :1] * columns[0]
    for k in (1, 2):
        total += colours[..., k : k + 1] * columns[k]
    return total


def balance(white_rgb: ArrayLike) -> Matrix:
    """Matrix [3, 3] on linear sRGB that makes the colour `white_rgb` [3] neutral and keeps its luminance."""
    white = SRGB.to_xyz @ np.asarray(white_rgb, np.float64)
    return _solve(SRGB.to_xyz, adaptation(white, xyz_of(SRGB.white)) @ SRGB.to_xyz)


def srgb_to_linear(encoded: NDArray[np.floating]) -> FloatArray:
    """Linear light of sRGB-encoded values in [0, 1] (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> FloatArray:
    """sRGB encoding of linear light, clipped to [0, 1] (IEC 61966-2-1)."""
    clipped = np.clip(np.nan_to_num(np.asarray(linear, np.float32), nan=0.0), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055).astype(np.float32)
