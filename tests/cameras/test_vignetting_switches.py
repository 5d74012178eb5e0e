"""Vignetting switched off: the four white cards, their product, cameras that are not round."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from camera_helpers import FILM, RADII, camera, film_rays, film_value, light, tabled

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.vignetting import VIGNETTINGS, Vignetted

KINDS = ("pinhole", "thin", "thick", "exact", "network", "fisheye-equidistant", "fisheye-orthographic")


def without(kind: str, left: str) -> Vignetted:
    """The camera with that vignetting left; all kinds share one table."""
    made = copy(tabled(kind))
    made.vignetting = left
    return made


def card(kind: str, left: str) -> np.ndarray:
    made = camera(kind) if left == "both" else without(kind, left)
    return np.array([film_value(made, (0.6 * r, 0.8 * r), 96) for r in RADII])


@pytest.mark.parametrize("kind", KINDS)
def test_the_four_white_cards(kind: str) -> None:
    both, natural, optical, none = (card(kind, left) for left in ("both", "natural", "optical", "none"))
    lit = both > 0
    assert none == pytest.approx(lit.astype(float), abs=2e-3)
    assert both == pytest.approx(natural * optical, abs=2e-3)
    if kind not in ("exact", "network"):  # nothing clips in an ideal lens
        assert optical == pytest.approx(lit.astype(float), abs=2e-3)


def test_natural_and_optical_are_what_an_integral_over_the_pupil_gives() -> None:
    assert card("exact", "natural") == pytest.approx(light().natural, abs=2e-3)
    # The losses of the glass go with the aperture.
    aperture = light().area_mm2 * light().transmittance
    assert card("exact", "optical") == pytest.approx(aperture / aperture[0], abs=4e-3)


@pytest.mark.parametrize("kind", ["thin", "exact", "fisheye-orthographic"])
def test_rays_stay_where_they_are_and_the_dark_stays_dark(kind: str) -> None:
    rays = film_rays(camera(kind), 3000)
    before, after = camera(kind).sample(*rays), without(kind, "none").for_worker().sample(*rays)
    assert np.array_equal(before.direction, after.direction) and np.array_equal(before.status, after.status)
    assert np.array_equal(before.weight > 0, after.weight > 0) and np.isfinite(after.weight).all()
    assert np.array_equal(without(kind, "both").sample(*rays).weight, before.weight)
    moved = without(kind, "none").sample_differentials(*rays)
    assert np.array_equal(moved.weight, after.weight) and moved.differentials is not None


class Uneven(Pinhole):
    """A pinhole whose light depends on the azimuth: less on one side, none at a corner."""

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        rays = super().sample(film_mm, pupil, wavelength_nm)
        radius = np.hypot(*film_mm) / 22
        share = 1 - 0.5 * radius * (1 + np.cos(np.arctan2(film_mm[1], film_mm[0]) - 0.7))
        return replace(rays, weight=(rays.weight * np.clip(share, 0, 1)).astype(np.float32))

    def natural(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> Any:
        return super().sample(film_mm, pupil, wavelength_nm).weight


def test_cameras_that_are_not_round() -> None:
    """The table then goes over azimuths, too."""
    lens = Uneven(50.0, FILM)
    none, natural = (Vignetted(lens, left) for left in ("none", "natural"))
    for point in ((0.0, 0.0), (12.0, 8.0), (-12.0, -8.0), (-3.0, 10.0), (14.0, -2.0), (-14.0, 1e-6)):
        cos4 = (1 + (math.hypot(*point) / 50) ** 2) ** -2
        assert film_value(none, point, 4) == pytest.approx(1, abs=5e-3)
        assert film_value(natural, point, 4) == pytest.approx(cos4, abs=5e-3)


def test_points_that_are_none_are_dark() -> None:
    film = np.array([[math.nan, math.inf, 0.0], [0.0, 0.0, 0.0]], np.float32)
    for kind in ("thin", "fisheye-orthographic"):
        rays = without(kind, "none").sample(film, np.full((2, 3), 0.3, np.float32), np.full(3, 550, np.float32))
        assert rays.weight.tolist()[:2] == [0, 0] and rays.weight[2] > 0 and rays.weight.dtype == np.float32
        assert rays.status.tolist() == [st.OUTSIDE_DOMAIN, st.OUTSIDE_DOMAIN, st.PASSED]


def test_made_from_a_shot() -> None:
    made = make_camera("thin", Shot(FILM, 2.0, vignetting="natural"))
    assert isinstance(made, Vignetted) and made.settings["vignetting"] == "natural"
    assert not isinstance(make_camera("thin", Shot(FILM, 2.0)), Vignetted)
    assert set(VIGNETTINGS) == {"both", "natural", "optical", "none"}
    with pytest.raises(InputError, match="vignetting"):
        make_camera("thin", Shot(FILM, 2.0, vignetting="cos4"))
