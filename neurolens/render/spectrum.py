"""Colour to spectrum and back: every path carries one wavelength, every surface colour and light colour is RGB.

A colour becomes the spectrum r R(l) + g G(l) + b B(l) of three basis functions that add up to 1 (Mallett and Yuksel
2019, "Spectral primary decomposition for rendering with sRGB reflectance"). Radiance is counted relative to daylight
D65, so white light is the number 1 at every wavelength and D65 itself sits in the film's response.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray

FloatArray64 = NDArray[np.float64]

# CIE XYZ to linear sRGB, IEC 61966-2-1.
XYZ_TO_RGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
FRAUNHOFER_NM = {"d": 587.5618, "F": 486.1327, "C": 656.2725}
# Beyond this the three responses are so alike over the range that separating them would only amplify noise.
_LARGEST_CONDITION = 30.0


@cache
def _tables() -> FloatArray64:
    """Columns wavelength_nm, x, y, z, d65, red, green, blue; made by experiments/make_spectral_tables.py."""
    text = resources.files("neurolens.render").joinpath("data/spectra.csv").read_text(encoding="utf-8")
    return np.array([[float(cell) for cell in line.split(",")] for line in text.splitlines()[1:]])


class SpectralRange:
    """A wavelength range cut into bins, and the tables of basis functions and film response at the bins' centres.

    Args:
        low_nm, high_nm: the range; equal for light of one wavelength.
        bins: table length; wavelengths themselves stay continuous, only spectra are read from the nearest bin.

    Attributes:
        centres_nm: [bins] float64.
        basis: [3, bins] float64, in [0, 1], adding up to 1.
        response: [3, bins] float32, linear sRGB film value of radiance 1 at a wavelength drawn uniformly from the
            range. The mean of response times basis is the unit matrix, so a colour lit by white light comes back as
            itself whatever the range. A range too narrow to tell colours apart gives a grey film.
        colours: whether the range tells colours apart.
    """

    def __init__(self, low_nm: float, high_nm: float, bins: int = 256) -> None:
        self.low_nm, self.high_nm = low_nm, high_nm
        self.bins = bins
        self.centres_nm = low_nm + (np.arange(bins) + 0.5) / bins * (high_nm - low_nm)
        tables = _tables()
        columns = np.stack([np.interp(self.centres_nm, tables[:, 0], column) for column in tables[:, 1:].T])
        self.basis = columns[4:] / columns[4:].sum(axis=0)
        rgb = XYZ_TO_RGB @ (columns[:3] * columns[3])
        mixing = rgb @ self.basis.T / bins  # [3 film, 3 basis], film value of each basis colour in white light
        self.colours = bool(np.linalg.cond(mixing) < _LARGEST_CONDITION)
        if self.colours:
            self.response = np.linalg.solve(mixing, rgb).astype(np.float32)
        else:
            self.response = np.ones((3, bins), np.float32)

    def wavelengths_nm(self, sample: FloatArray) -> FloatArray:
        """Wavelengths [N] in nm for uniform samples [N] in [0, 1)."""
        return np.float32(self.low_nm) + sample * np.float32(self.high_nm - self.low_nm)

    def bin_of(self, sample: FloatArray) -> NDArray[np.intp]:
        """Bins [N] of uniform samples [N] in [0, 1)."""
        return (sample * np.float32(self.bins)).astype(np.intp)

    def spectrum(self, rgb: tuple[float, float, float] | NDArray[np.floating]) -> FloatArray:
        """Spectrum [..., bins] of linear sRGB colours [..., 3]."""
        return (np.asarray(rgb, np.float64) @ self.basis).astype(np.float32)

    def refractive_index(self, n_d: float, v_d: float | None) -> FloatArray:
        """Index [bins], Cauchy's A + B / lambda^2 through n_d and n_F - n_C = (n_d - 1) / V_d; constant without V_d."""
        if v_d is None:
            return np.full(self.bins, n_d, np.float32)
        inverse = {line: 1 / nm**2 for line, nm in FRAUNHOFER_NM.items()}
        b = (n_d - 1) / v_d / (inverse["F"] - inverse["C"])
        return (n_d + b * (self.centres_nm**-2.0 - inverse["d"])).astype(np.float32)


def srgb_to_linear(encoded: NDArray[np.floating]) -> FloatArray:
    """Linear light of sRGB-encoded values in [0, 1] (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> FloatArray:
    """sRGB encoding of linear light, clipped to [0, 1] (IEC 61966-2-1)."""
    clipped = np.clip(np.nan_to_num(np.asarray(linear, np.float32), nan=0.0), 0.0, 1.0)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055).astype(np.float32)
