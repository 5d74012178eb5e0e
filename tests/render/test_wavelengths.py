"""Colours go to spectra and come back; wavelengths drawn by importance have exact densities and less noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from render_helpers import WHITE, assert_same_mean, diffuse, scene

from neurolens.cameras.pinhole import Pinhole
from neurolens.render.film import FilmSettings
from neurolens.render.illuminants import table
from neurolens.render.renderer import render
from neurolens.render.spectrum import SpectralRange
from neurolens.render.wavelengths import expected_light, spectral_range

FLAT = (table("wavelength_nm"), np.ones(81))
SPIKE = (np.array([400.0, 499.0, 500.0, 501.0, 700.0]), np.array([0.01, 0.01, 5.0, 0.01, 0.01]))
CAMERA = Pinhole(50.0, (36.0, 24.0))


@pytest.mark.parametrize("light", [FLAT, SPIKE], ids=["flat", "spike"])
def test_the_density_is_that_of_the_bins(light: tuple[np.ndarray, np.ndarray]) -> None:
    spectral = SpectralRange(400, 700, light=light)
    assert spectral.edges_nm[[0, -1]] == pytest.approx([400, 700], abs=0) and np.all(np.diff(spectral.edges_nm) > 0)
    sample = ((np.arange(256 * 64) + 0.5) / (256 * 64)).astype(np.float32)
    nm, bins = spectral.wavelengths_nm(sample), spectral.bin_of(sample)
    assert np.all(np.diff(nm) > 0) and np.all(np.bincount(bins) == 64)
    assert np.all((nm >= spectral.edges_nm[bins] - 1e-3) & (nm <= spectral.edges_nm[bins + 1] + 1e-3))
    # Divided by the density, the mean of 1 is the length of the range.
    assert np.mean(np.diff(spectral.edges_nm)[bins]) * spectral.bins == pytest.approx(300, rel=1e-9)
    # A tenth of all wavelengths is spread evenly, so that no density is below a tenth of the uniform one.
    assert np.diff(spectral.edges_nm).max() <= 10.01 * 300 / 256


@pytest.mark.parametrize("light", [None, FLAT, SPIKE], ids=["even", "flat", "spike"])
@pytest.mark.parametrize("rgb", [(1, 1, 1), (0.9, 0.1, 0.05), (0, 1, 0), (0.2, 0.3, 0.7), (0, 0, 1)])
def test_colours_come_back_through_any_bins(rgb: tuple[float, float, float], light: Any) -> None:
    for limits in ((380, 780), (400, 700), (450, 650)):
        spectral = SpectralRange(*limits, light=light)
        spectrum = spectral.spectrum(rgb)
        assert spectrum.min() >= 0 and spectrum.max() <= 1 + 1e-6
        assert spectral.film_rgb(spectrum) == pytest.approx(rgb, abs=1e-5)


def test_upsampling_conserves_energy_and_reciprocates_over_the_cube() -> None:
    spectral = SpectralRange(380, 780)
    axis = np.linspace(0, 1, 9)
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    spectra = spectral.spectrum(cube)
    assert spectra.min() >= 0 and spectra.max() <= 1 + 1e-6 and np.allclose(spectra[-1], 1, atol=1e-6)
    assert spectra.astype(float) @ spectral.response.T / spectral.bins == pytest.approx(cube, abs=1e-5)
    # Complementary colours are complementary at every wavelength.
    assert spectral.spectrum(cube) + spectral.spectrum(1 - cube) == pytest.approx(np.ones_like(spectra), abs=1e-6)


def test_the_importance_is_the_response_times_the_light() -> None:
    flat, spike = SpectralRange(400, 700, light=FLAT), SpectralRange(400, 700, light=SPIKE)
    density = 1 / np.diff(flat.edges_nm)
    assert 10 * density[0] < density.max() and 10 * density[-1] < density.max()
    near = np.abs(spike.centres_nm - 500) < 1.5
    assert near.sum() > 3 * (np.abs(flat.centres_nm - 500) < 1.5).sum()
    # Equal bins everywhere would be the optimum of the defensive mixture: response over density is bounded.
    strongest = np.sqrt(np.sum(flat.response.astype(float) ** 2, axis=0))
    assert strongest.max() < 1.2 * strongest.mean() / 0.9
    assert np.array_equal(SpectralRange(540, 560, light=FLAT).edges_nm, SpectralRange(540, 560).edges_nm)


def test_the_light_of_a_scene() -> None:
    lamp = {"corner_m": [-1, -1, -3], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 2, 0], "emission": [2, 2, 2]}
    nm, white = expected_light(scene(quads=[lamp]))
    assert white == pytest.approx(1, rel=1e-3) and nm[0] > 400 and nm[-1] < 700
    _, warm = expected_light(scene(quads=[lamp | {"illuminant": "A"}]))
    assert np.all(np.diff(warm[::64]) > 0)
    _, dark = expected_light(scene())
    assert np.all(dark == 1)
    one = expected_light(scene({"wavelengths_nm": [550, 550]}, environment=WHITE))
    assert spectral_range(scene({"wavelengths_nm": [550, 550]}), CAMERA, FilmSettings()).centres_nm[0] == 550
    assert np.all(np.isfinite(one[1]))


def coloured_room() -> object:
    wall = {"point_m": [0, 0, -2], "normal": [0, 0, 1], "material": "m"}
    ball = {"centre_m": [0.2, 0.1, -1.5], "radius_m": 0.3, "material": "g"}
    lamp = {"centre_m": [0.6, 0.6, -1], "radius_m": 0.1, "emission": [9, 9, 9], "illuminant": "3000 K"}
    glossy = {"kind": "glossy", "specular": [0.1, 0.05, 0.02], "roughness": 0.4, "reflectance": [0.1, 0.2, 0.6]}
    return scene(
        environment={"colour": [0.3, 0.3, 0.3]},
        materials={"m": diffuse(0.7, 0.3, 0.1), "g": glossy},
        planes=[wall],
        spheres=[ball, lamp],
    )


def test_importance_changes_the_noise_and_not_the_mean() -> None:
    made, options = coloured_room(), {"width": 18, "height": 12, "samples": 16, "threads": 1, "max_depth": 3}
    even, drawn = (
        np.stack([render(made, CAMERA, seed=k, film=film, **options).rgb for k in range(24)])
        for film in (FilmSettings(wavelength_sampling=s, wavelengths="one") for s in ("uniform", "importance"))
    )
    assert_same_mean(even, drawn, 0.01)
    assert drawn.var(axis=0).mean() < 0.8 * even.var(axis=0).mean()


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
