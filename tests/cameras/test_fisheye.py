"""Fisheye projections against their formulas, and their weights against what etendue demands."""

from __future__ import annotations

import math

import numpy as np
import pytest
from camera_helpers import differences

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.pinhole import PROJECTIONS, Fisheye

FOCAL = 10.0
# Film radius in focal lengths, angle in degrees.
PLACES = {
    "equidistant": [(math.pi / 4, 45), (math.pi / 2, 90), (2.5, math.degrees(2.5))],
    "equisolid": [(2 * math.sin(math.pi / 8), 45), (math.sqrt(2), 90), (math.sqrt(3), 120)],
    "stereographic": [(2 * math.tan(math.pi / 8), 45), (2, 90), (2 * math.sqrt(3), 120)],
    "orthographic": [(math.sqrt(0.5), 45), (0.5, 30), (math.sqrt(0.75), 60)],
}


def sample(camera: Fisheye, film: np.ndarray):  # noqa: ANN201
    return camera.sample(film.astype(np.float32), np.zeros((2, film.shape[1]), np.float32), np.zeros(film.shape[1]))


@pytest.mark.parametrize("name", PROJECTIONS)
def test_known_angles_at_known_places(name: str) -> None:
    radius, degrees = np.array(PLACES[name]).T
    film = FOCAL * radius * np.array([[0.6], [-0.8]])
    rays = sample(Fisheye(name, FOCAL), film)
    angle = np.degrees(np.arctan2(np.hypot(*rays.direction[:2]), -rays.direction[2]))
    assert angle == pytest.approx(degrees, rel=1e-5)
    # The camera looks along -z, and the picture stands on its head.
    assert (rays.direction[0] < 0).all() and (rays.direction[1] > 0).all()
    assert (rays.status == st.PASSED).all()


@pytest.mark.parametrize("name", PROJECTIONS)
def test_weight_is_that_of_etendue(name: str) -> None:
    """E / E(axis) = c f^2 dOmega / dA, the solid angle of a patch of film by differences of its rays' directions."""
    camera = Fisheye(name, FOCAL, (200.0, 200.0))
    rng = np.random.default_rng(0)
    edge = FOCAL * min(0.97 * camera.projection.end, 8.0)
    radius, azimuth = edge * rng.random(400), 2 * math.pi * rng.random(400)
    film = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth)]).astype(np.float32)
    rays = sample(camera, film)
    slopes = differences(camera, film, film, film[0], 0.02)[3:]
    solid = FOCAL**2 * np.linalg.norm(np.cross(slopes[:, 0].T, slopes[:, 1].T), axis=1)
    foreshortening = -rays.direction[2] if name == "orthographic" else 1
    assert rays.weight == pytest.approx(foreshortening * solid, abs=2e-3)
    assert sample(camera, np.zeros((2, 1))).weight[0] == 1


def test_laws_of_the_falloff() -> None:
    theta = np.radians([20.0, 60.0, 89.0, 130.0])
    laws = {"equidistant": np.sin(theta) / theta, "equisolid": 1 + 0 * theta, "stereographic": np.cos(theta / 2) ** 4}
    for name, law in laws.items():
        radius = FOCAL * PROJECTIONS[name].radius(theta)
        assert sample(Fisheye(name, FOCAL), np.stack([radius, 0 * radius])).weight == pytest.approx(law, abs=1e-5)


def test_film_beyond_the_projection_is_dark() -> None:
    for name, end in (("equidistant", math.pi), ("equisolid", 2.0), ("orthographic", 1.0)):
        rays = sample(Fisheye(name, FOCAL), FOCAL * end * np.array([[0.999, 1.001, 50.0], [0.0, 0.0, 50.0]]))
        assert rays.status.tolist() == [st.PASSED, st.OUTSIDE_DOMAIN, st.OUTSIDE_DOMAIN]
        assert (rays.weight[1:] == 0).all() and np.linalg.norm(rays.direction, axis=0) == pytest.approx(1, abs=1e-6)
    # A stereographic film has no end: it sees all but what lies straight behind.
    assert sample(Fisheye("stereographic", FOCAL), np.full((2, 1), 1e4)).status[0] == st.PASSED
    half = Fisheye("equidistant", FOCAL, field_deg=90.0)
    assert sample(half, FOCAL * np.array([[0.78, 0.79], [0.0, 0.0]])).status.tolist() == [0, st.OUTSIDE_DOMAIN]


@pytest.mark.parametrize("name", PROJECTIONS)
def test_differentials_are_finite_differences(name: str) -> None:
    camera = Fisheye(name, FOCAL)
    rng = np.random.default_rng(0)
    film = (rng.random((2, 300)) * 12 - 6).astype(np.float32)
    film[:, 0] = 0
    moves = camera.sample_differentials(film, film, film[0]).differentials
    assert moves is not None
    found = np.concatenate([moves.origin_m, moves.direction])
    np.testing.assert_allclose(found, differences(camera, film, film, film[0], 0.02), atol=2e-5)


def test_field_sets_the_circle_within_the_film() -> None:
    camera = make_camera("fisheye-equisolid", Shot((36.0, 24.0), 1.0, field_deg=200.0))
    assert isinstance(camera, Fisheye)
    rays = sample(camera, np.array([[0.0, 0.0], [11.999, 12.001]]))
    assert rays.status.tolist() == [st.PASSED, st.OUTSIDE_DOMAIN]
    assert math.degrees(math.acos(-rays.direction[2, 0])) == pytest.approx(100, abs=0.02)


@pytest.mark.parametrize(
    ("spec", "change", "field"),
    [
        ("fisheye-equal", {}, "camera"),
        ("fisheye-equidistant", {"zoom": 50.0}, "zoom"),
        ("fisheye-equidistant", {"focus": "best"}, "focus"),
        ("fisheye-equidistant", {"field_deg": 361.0}, "field_deg"),
        ("fisheye-orthographic", {"field_deg": 181.0}, "field_deg"),
        ("fisheye-equisolid", {"field_deg": 90.0, "efl_mm": 8.0}, "efl_mm"),
        ("fisheye-equisolid", {"efl_mm": math.inf}, "focal_mm"),
        ("fisheye-equisolid", {"pupil": "boxes"}, "pupil"),
    ],
)
def test_bad_settings_are_named(spec: str, change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        make_camera(spec, Shot((36.0, 24.0), 1.0, **change))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="projection"):
        Fisheye("fish", 10.0)
