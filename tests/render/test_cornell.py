"""The Cornell box of experiments/scenes against another renderer: means over parts of the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neurolens.cameras.pinhole import Pinhole
from neurolens.render.film import PixelGrid
from neurolens.render.integrator import trace
from neurolens.render.sampler import FILM, Sampler
from neurolens.render.scene import load_scene
from neurolens.render.spectrum import SpectralRange
from neurolens.render.world import World

SCENE = Path(__file__).parents[2] / "experiments" / "scenes" / "cornell.toml"
REFERENCE = np.loadtxt(Path(__file__).with_name("cornell_reference.csv"), delimiter=",")  # rows nm, 8 means
SAMPLES, PIXELS = 64, 32


@pytest.mark.parametrize("nm", [450.0, 550.0, 650.0])
def test_cornell_box_agrees_with_mitsuba(nm: float) -> None:
    scene = load_scene(SCENE)
    settings = scene.settings.camera
    world = World(scene, SpectralRange(nm, nm))
    sampler, count = Sampler(SAMPLES, 3), PIXELS * PIXELS * SAMPLES
    pixel, sample = np.divmod(np.arange(count), SAMPLES)
    keys = sampler.keys(pixel, sample)
    points = PixelGrid(PIXELS, PIXELS, (25.0, 25.0)).film_points(pixel, sampler.draw2(keys, FILM))
    rays = Pinhole(35.0, (25.0, 25.0)).sample(points, np.zeros_like(points), np.full(count, nm, np.float32))
    axes = np.diag(np.float32([-1, 1, -1]))  # the camera looks along +z, up is +y
    assert settings.up == (0, 1, 0) and settings.look_at_m[:2] == settings.position_m[:2]
    origin = axes @ rays.origin_m + np.float32(settings.position_m)[:, None]
    bins = np.zeros(count, np.intp)
    found = trace(world, sampler, keys, origin, axes @ rays.direction, np.ones((1, count), np.float32), bins, 40)

    (lamp,) = scene.settings.quads
    parts = found.reshape(8, PIXELS // 8, 8, PIXELS // 8, SAMPLES) / lamp.emission[0]
    means, pixels = parts.mean(axis=(1, 3, 4)), parts.mean(axis=4)
    # Of the mean of a part: the spread within pixels, an upper bound as samples are stratified.
    error = np.sqrt(parts.var(axis=4).mean(axis=(1, 3)) / (SAMPLES * pixels.shape[1] ** 2)) + 2e-3 * means
    expected = REFERENCE[REFERENCE[:, 0] == nm, 1:]
    assert expected.shape == (8, 8)
    assert np.abs((means - expected) / (error + 1e-6)).max() < 4.5
    # All but the rows that show the lamp, a tenth of a per cent of which outshines the noise of the rest.
    assert means[2:].mean() == pytest.approx(expected[2:].mean(), rel=0.005)
