"""Wavelengths of rays through a lens that disperses: one a ray, and what it is worth where the renderer carries RGB.

A path of an RGB renderer carries three numbers, not a wavelength; a lens that disperses needs one. Each ray takes a
wavelength, drawn by the film's response, and its channel c is weighted by

    w_c(lambda) = response_c(lambda) B_c(lambda) / pdf(lambda),

the diagonal of what our film makes of light of the basis spectra B (Mallett and Yuksel 2019; `SpectralRange`), without
its few negative values (Mitsuba's scalar variants drop samples below 0) and scaled to a mean of 1: white stays white,
and any colour stays itself where the rays do not depend on the wavelength. The terms off the diagonal have mean 0; an
RGB renderer has no place for them, and colour fringes of saturated objects differ by them from a spectral render.
"""

from __future__ import annotations

import numpy as np

from neurolens.cameras.contract import FloatArray
from neurolens.render.sampler import hash32
from neurolens.render.spectrum import SpectralRange


class ChannelWavelengths:
    """Draws wavelengths over a range and weighs them for R, G and B.

    Args:
        low_nm, high_nm: the range, within 380 to 780 nm. One too narrow to tell colours apart gives weights of 1.
    """

    def __init__(self, low_nm: float, high_nm: float) -> None:
        even = np.array([low_nm, high_nm]), np.ones(2)
        self._range = SpectralRange(low_nm, high_nm, light=even)
        diagonal = np.maximum(self._range.response * self._range.basis, 0)
        weights = diagonal / diagonal.mean(axis=1, keepdims=True)
        self._weights = (weights if self._range.colours else np.ones_like(weights)).astype(np.float32)

    def draw(self, sample: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Wavelengths [N] in nm and weights [3, N] for uniform samples [N] in [0, 1)."""
        weights = self._weights.take(self._range.bin_of(sample), axis=1)
        return self._range.wavelengths_nm(sample), weights


def wavelength_samples(position: FloatArray, aperture: FloatArray) -> FloatArray:
    """Uniform numbers [N] in [0, 1) for the wavelengths of a wavefront, from its points [2, N] on film and aperture.

    Steps of the golden ratio from a start that the first points decide: a pixel's samples follow each other in a
    wavefront, and so many in a row are spread almost evenly, which saves most of the colour noise. RGB variants of
    Mitsuba draw no such number at all.
    """
    first = np.ascontiguousarray(np.concatenate([position[:, :1], aperture[:, :1]]), np.float32)
    start = np.zeros(1, np.uint32)
    for value in first.view(np.uint32):
        start = hash32(start + value)
    steps = np.arange(position.shape[1], dtype=np.uint32) * np.uint32(0x9E3779B9) + start
    return (steps >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)
