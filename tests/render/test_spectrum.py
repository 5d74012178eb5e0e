"""Colours go to spectra and come back."""

from __future__ import annotations

import numpy as np
import pytest

from neurolens.render.colour import linear_to_srgb, srgb_to_linear
from neurolens.render.spectrum import SpectralRange


@pytest.mark.parametrize("limits", [(380, 780), (400, 700), (450, 650)])
@pytest.mark.parametrize("rgb", [(1, 1, 1), (0.9, 0.1, 0.05), (0, 1, 0), (0.2, 0.3, 0.7)])
def test_colour_in_white_light_comes_back(limits: tuple[float, float], rgb: tuple[float, float, float]) -> None:
    spectral = SpectralRange(*limits)
    spectrum = spectral.spectrum(rgb)
    assert spectrum.min() >= 0 and spectrum.max() <= 1
    assert np.mean(spectral.response * spectrum, axis=1) == pytest.approx(rgb, abs=1e-5)


def test_white_is_one_at_every_wavelength() -> None:
    assert np.allclose(SpectralRange(400, 700).spectrum((1, 1, 1)), 1, atol=1e-6)


@pytest.mark.parametrize("limits", [(587.5618, 587.5618), (540, 560)])
def test_light_of_one_wavelength_makes_a_grey_picture(limits: tuple[float, float]) -> None:
    spectral = SpectralRange(*limits)
    assert not spectral.colours
    assert np.all(spectral.response == 1)
    assert np.allclose(spectral.wavelengths_nm(np.float32([0, 0.999])), limits, atol=0.1)


def test_cauchy_index_has_the_asked_abbe_number() -> None:
    lines = [SpectralRange(nm, nm).refractive_index(1.62, 36.4)[0] for nm in (587.5618, 486.1327, 656.2725)]
    assert lines[0] == pytest.approx(1.62, abs=1e-6)
    assert (lines[0] - 1) / (lines[1] - lines[2]) == pytest.approx(36.4, rel=1e-4)
    assert np.all(SpectralRange(400, 700).refractive_index(1.5, None) == np.float32(1.5))


def test_srgb_encoding_round_trip() -> None:
    linear = np.linspace(0, 1, 101)
    assert np.allclose(srgb_to_linear(linear_to_srgb(linear)), linear, atol=1e-6)
    assert linear_to_srgb(np.array([-1.0, np.nan, 9.0])) == pytest.approx([0, 0, 1], abs=1e-6)
