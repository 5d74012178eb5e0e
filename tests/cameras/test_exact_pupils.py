"""Pupils of the literature: the same picture through each, and the shares of rays that pass in their known order."""

from __future__ import annotations

from copy import copy
from functools import cache

import numpy as np
import pytest
from camera_helpers import at, camera, film_rays, jittered

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.exact import OUTLINE, PUPILS, pupil_named
from neurolens.cameras.lens_film import LensFilm
from neurolens.cameras.vignetting import VIGNETTINGS
from neurolens.commands import arguments


@cache
def film(name: str) -> LensFilm:
    """The film of the exact camera with another pupil."""
    exact = camera("exact")
    made = copy(exact.film)
    if name != OUTLINE:
        made.pupil = pupil_named(name, exact.lens, exact.film.outline, exact.film.film_z_mm)
    return made


@pytest.mark.parametrize("name", [p for p in PUPILS if p != OUTLINE])
def test_every_pupil_gives_the_same_picture(name: str) -> None:
    """Film values of points at half height and near the corner, by samples so even that 0.4% shows."""
    square, wavelength = jittered(256)
    for point in ((9.0, 4.0), (16.0, 11.0)):
        points = at(point, wavelength.size)
        wanted, found = (film(n).sample(points, square, wavelength).weight.mean() for n in (OUTLINE, name))
        assert found == pytest.approx(wanted, rel=4e-3)


@pytest.mark.parametrize("name", [p for p in PUPILS if p != OUTLINE])
def test_every_pupil_holds_the_outline(name: str) -> None:
    """Points of the outline lie in the pupil's support: its points come as near to them as they lie together."""
    exact = camera("exact")
    held = film(name).pupil
    radius = np.linspace(0, exact.film.outline.film_radius_mm * 0.999, 12).astype(np.float32)
    square = np.random.default_rng(0).random((2, 4000), np.float32)
    edge = square.copy()
    edge[0, ::2], edge[1, 1::2] = 1 - 1e-6, 1e-6
    for r in radius:
        point = np.repeat(np.array([[r], [0.0]], np.float32), 4000, axis=1)
        waves = np.full(4000, 400, np.float32)
        (wide, _), (inner, _) = held.sample(point, square, waves), exact.film.outline.sample(point, edge, waves)
        slack = 0.04 * np.ptp(wide[0])
        assert inner[0].min() >= wide[0].min() - slack and inner[0].max() <= wide[0].max() + slack
        assert np.abs(inner[1]).max() <= np.abs(wide[1]).max() + slack


def test_shares_that_pass_are_in_their_known_order() -> None:
    rays = film_rays(camera("exact"), 20_000)
    share = {name: float((film(name).sample(*rays).status == st.PASSED).mean()) for name in PUPILS}
    assert share["rear-rim"] < share["boxes"] < share["ellipses"] < share[OUTLINE]
    assert share["rear-rim"] < share["exit-pupil"] and share["pixel-disc"] < share[OUTLINE]
    assert share[OUTLINE] > 0.995 and share["rear-rim"] < 0.15


def test_beyond_the_light_and_for_nonsense_there_is_no_area() -> None:
    points = np.array([[np.nan, np.inf, 1e4, 1.0], [0, 0, 0, np.inf]], np.float32)
    for name in PUPILS:
        rays = film(name).sample(points, np.full((2, 4), 0.4, np.float32), np.full(4, 550, np.float32))
        assert (rays.status == st.OUTSIDE_DOMAIN).all() and (rays.weight == 0).all()
        assert np.isfinite(rays.direction).all()


def test_an_unknown_name_is_named() -> None:
    exact = camera("exact")
    with pytest.raises(InputError, match="outline, rear-rim"):
        pupil_named("disc", exact.lens, exact.film.outline, exact.film.film_z_mm)


def test_the_command_line_knows_the_same_names() -> None:
    assert arguments.PUPILS == PUPILS and arguments.VIGNETTINGS == VIGNETTINGS
