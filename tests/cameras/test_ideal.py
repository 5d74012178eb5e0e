"""Pinhole, thin lens, thick lens and fisheye projections against closed forms."""

import math
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_helpers import FILM, GAUSS, ROOT, at, differences, film_rays, film_value, jittered
from shipped import disc_irradiance

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras import build
from neurolens.cameras.build import make_camera
from neurolens.cameras.cameragraph import concentric_disk
from neurolens.cameras.contract import Camera
from neurolens.cameras.ideal import PROJECTIONS, Fisheye, Pinhole, ThickLens, ThinLens
from neurolens.graph.compiler import has_compiler
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.paraxial import first_order, system_of
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens


def square_grid(side: int) -> np.ndarray:
    """Centres of a side x side grid on the unit square, [2, side^2] float32."""
    u = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(u, u)).reshape(2, -1).astype(np.float32)


def test_disk_map_is_uniform() -> None:
    disk = concentric_disk(square_grid(200))
    radius2 = np.sum(disk**2, axis=0)
    assert radius2.max() <= 1.0
    assert abs(radius2.mean() - 0.5) < 1e-3
    for radius in (0.2, 0.5, 0.8):
        assert abs(np.mean(radius2 < radius**2) - radius**2) < 5e-3
    assert np.all(concentric_disk(np.full((2, 1), 0.5, np.float32)) == 0)


@pytest.mark.parametrize("film", [(0.0, 0.0), (10.0, -5.0), (-18.0, 12.0)])
@pytest.mark.parametrize("focus_m", [0.3, 30.0, 1e3])
def test_thin_lens_rays_of_a_film_point_meet_at_the_focus_distance(film: tuple[float, float], focus_m: float) -> None:
    camera = ThinLens(50.0, 1.8, focus_m)
    pupil = square_grid(16)
    rays = camera.sample(at(film, pupil.shape[1]), pupil, np.full(pupil.shape[1], 550, np.float32))
    along = (-focus_m - rays.origin_m[2]) / rays.direction[2]
    met = rays.origin_m + along * rays.direction
    magnification = (1e3 * focus_m - camera.image_distance_mm) / camera.image_distance_mm
    expected = np.array([-film[0] * magnification, -film[1] * magnification]) * 1e-3
    assert np.abs(met[:2] - expected[:, None]).max() < 4e-7 * max(1.0, magnification)
    assert np.allclose(np.sum(rays.direction**2, axis=0), 1, atol=1e-6)
    assert np.all(rays.status == 0)
    assert rays.origin_m.dtype == rays.direction.dtype == rays.weight.dtype == np.float32


RETROFOCUS = ROOT / "lenses" / "angenieux_retrofocus_35.toml"
TELEPHOTO = ROOT / "lenses" / "sigler_telephoto_100.toml"
ZOOM = ROOT / "lenses" / "nikon_zoom_70_200.toml"


def made(path: Path, focus_m: float = 2.0, **change: object) -> ThickLens:
    camera = make_camera(f"thick:{path}", Shot(FILM, focus_m, **change))  # type: ignore[arg-type]
    assert isinstance(camera, ThickLens)
    return camera


@pytest.mark.parametrize("path", [GAUSS, RETROFOCUS, TELEPHOTO])
def test_rays_of_a_film_point_meet_at_the_focus_distance_and_fill_the_entrance_pupil(path: Path) -> None:
    focus_m, height = 2.0, 9.0
    camera = made(path, focus_m)
    square, wavelength = jittered(24)
    rays = camera.sample(at((height, 0.0), 576), square, wavelength)
    t = (-focus_m - rays.origin_m[2]) / rays.direction[2]
    met = rays.origin_m[:2] + t * rays.direction[:2]
    lens = set_lens(read_lens(path), focus_m=focus_m, focus_mode="best")
    data = first_order(lens)
    assert lens.film_z_mm is not None
    magnification = paraxial_chief_slope(lens, height) * (data.entrance_pupil_z_mm - lens.film_z_mm + 1e3 * focus_m)
    magnification /= height
    assert met[0] == pytest.approx(-1e-3 * height * magnification, rel=2e-4) and np.abs(met[1]).max() < 2e-5
    # On the plane of the entrance pupil the same rays fill its disc.
    t = (1e-3 * (data.entrance_pupil_z_mm - lens.film_z_mm) - rays.origin_m[2]) / rays.direction[2]
    place = 1e3 * (rays.origin_m[:2] + t * rays.direction[:2])
    radius = np.hypot(*place)
    assert radius.max() == pytest.approx(data.entrance_pupil_diameter_mm / 2, rel=0.01)
    assert np.mean(radius**2) == pytest.approx((data.entrance_pupil_diameter_mm / 2) ** 2 / 2, rel=0.02)


def paraxial_chief_slope(lens: Lens, height_mm: float) -> float:
    """Slope in the scene of the chief ray of a film point, marched surface by surface towards the scene."""
    turned, exit_z = system_of(lens).turned(), first_order(lens).exit_pupil_z_mm
    film_z, last_z = float(lens.film_z_mm or 0.0), float(lens.vertices_mm[-2])
    slope = -height_mm / (film_z - exit_z)  # from the film point to the exit pupil's centre
    return abs(turned.march(height_mm + slope * (film_z - last_z), slope).after[-1])


@pytest.mark.parametrize("focus", ["best", "paraxial"])
@pytest.mark.parametrize("focus_m", [math.inf, 0.9])
@pytest.mark.parametrize("path", [GAUSS, RETROFOCUS, TELEPHOTO, ZOOM])
def test_ideal_cameras_frame_the_plane_in_focus_as_the_lens_does(path: Path, focus_m: float, focus: str) -> None:
    """Chief rays of a film point of the lens and of its thin lens, thick lens and pinhole meet there (item 16)."""
    lens = set_lens(read_lens(path), focus_m=focus_m, focus_mode=focus)  # type: ignore[arg-type]
    height, depth = 8.0, 1e7 if math.isinf(focus_m) else 1e3 * focus_m  # from the film, mm
    pupil = first_order(lens).entrance_pupil_z_mm - float(lens.film_z_mm or 0.0)
    wanted = -paraxial_chief_slope(lens, height) * (depth + pupil)
    for kind in ("thin", "thick", "pinhole"):
        camera = make_camera(f"{kind}:{path}", Shot(FILM, focus_m, focus_mode=focus))  # type: ignore[arg-type]
        rays = camera.sample(at((height, 0.0), 1), np.full((2, 1), 0.5, np.float32), np.full(1, 550.0, np.float32))
        t = (-1e-3 * depth - rays.origin_m[2]) / rays.direction[2]
        assert 1e3 * (rays.origin_m + t * rays.direction)[0, 0] == pytest.approx(wanted, rel=2e-5), kind


@pytest.mark.parametrize("path", [GAUSS, RETROFOCUS, TELEPHOTO])
def test_light_falls_off_as_that_of_the_exit_pupil(path: Path) -> None:
    """The irradiance of a uniform disc, at any height (Foote 1915), is that of the paraxial exit pupil."""
    camera = made(path, math.inf, focus_mode="paraxial")
    data = first_order(set_lens(read_lens(path), focus_m=math.inf))
    distance = data.rear_focal_z_mm - data.exit_pupil_z_mm
    heights = np.array([0.0, 10.0, 20.0])
    light = disc_irradiance(data.exit_pupil_diameter_mm / 2, distance, heights)
    found = [film_value(camera, (h, 0.0)) for h in heights]
    assert found == pytest.approx(light / light[0], abs=2e-4)


def test_a_telecentric_lens_has_no_falloff() -> None:
    """An entrance pupil in the front focal plane: every film point sees the same cone."""
    camera = ThickLens(50.0, 2.8, math.inf, FILM, principal_z_mm=(0.0, 20.0), entrance_pupil_z_mm=-50.0)
    assert [film_value(camera, p) for p in ((0.0, 0.0), (15.0, 10.0))] == pytest.approx([1, 1], abs=2e-4)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: ThinLens(50.0, 1.8, 0.19), "focus_m"),
        (lambda: ThinLens(-50.0, 1.8, 2.0), "focal_length_mm"),
        (lambda: Pinhole(math.inf), "focal_length_mm"),
        (lambda: Pinhole(50.0, (36.0, 0.0)), "film_mm"),
        (lambda: made(ROOT / "lenses" / "cooke_anamorphic_42.toml"), "cylinders"),
        (lambda: make_camera("thick:absent.toml", Shot(FILM, 2.0)), "absent.toml"),
        (lambda: make_camera("thick:model.onnx", Shot(FILM, 2.0)), "camera"),
        (lambda: ThickLens(50.0, 2.0, 0.1), "focus_m"),
        (lambda: ThickLens(50.0, 2.0, 2.0, entrance_pupil_z_mm=math.nan), "entrance_pupil_z_mm"),
        (lambda: ThickLens(50.0, 2.0, 2.0, principal_z_mm=(0.0, math.inf)), "principal_z_mm"),
        (lambda: ThickLens(50.0, 2.0, 2.0, film_at_mm=-1.0), "film_at_mm"),
        # With x' = 50 the exit pupil of an entrance pupil at x = -50 lies in the film.
        (lambda: ThickLens(50.0, 2.0, 0.2, entrance_pupil_z_mm=-100.0), "exit pupil"),
    ],
)
def test_bad_arguments_are_named(make: object, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()  # type: ignore[operator]


FOCAL = 10.0
# Film radius in focal lengths, angle in degrees.
PLACES = {
    "equidistant": [(math.pi / 4, 45), (math.pi / 2, 90), (2.5, math.degrees(2.5))],
    "equisolid": [(2 * math.sin(math.pi / 8), 45), (math.sqrt(2), 90), (math.sqrt(3), 120)],
    "stereographic": [(2 * math.tan(math.pi / 8), 45), (2, 90), (2 * math.sqrt(3), 120)],
    "orthographic": [(math.sqrt(0.5), 45), (0.5, 30), (math.sqrt(0.75), 60)],
}


def sample(camera: Fisheye, film: np.ndarray):  # noqa: ANN201
    return camera.sample(
        film.astype(np.float32), np.zeros((2, film.shape[1]), np.float32), np.full(film.shape[1], 550.0)
    )


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
    slopes = differences(camera, film, 0 * film, np.full(400, 550.0), 0.02)[3:]
    solid = FOCAL**2 * np.linalg.norm(np.cross(slopes[:, 0].T, slopes[:, 1].T), axis=1)
    foreshortening = -rays.direction[2] if name == "orthographic" else 1
    assert rays.weight == pytest.approx(foreshortening * solid, abs=2e-3)
    assert sample(camera, np.zeros((2, 1))).weight[0] == 1


@pytest.mark.parametrize(
    "camera",
    [
        Pinhole(FOCAL),
        *(Fisheye(name, FOCAL) for name in PROJECTIONS),
        ThinLens(FOCAL, 2.0, 2.0),
        ThickLens(FOCAL, 2.0, 2.0, principal_z_mm=(10.0, 30.0), entrance_pupil_z_mm=20.0),
    ],
    ids=lambda camera: camera.name,
)
def test_film_and_pupil_points_that_are_none_give_dark_unit_rays(camera: Camera) -> None:
    film = np.zeros((2, 8), np.float32)
    square = np.full((2, 8), 0.3, np.float32)
    film[:, :4], square[1, 4:] = [1e19, 1e21, 3e38, math.nan], [-0.01, 1.01, math.inf, math.nan]
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        rays = camera.sample(film, square, np.full(8, 550, np.float32))
    assert (rays.status[2:] == st.OUTSIDE_DOMAIN).all() and not rays.weight[2:].any()
    assert np.linalg.norm(rays.direction, axis=0) == pytest.approx(1, abs=1e-6)
    edge = camera.sample(np.zeros((2, 1), np.float32), np.ones((2, 1), np.float32), np.full(1, 550, np.float32))
    assert edge.status == st.PASSED


def test_film_beyond_the_projection_is_dark() -> None:
    for name, end in (("equidistant", math.pi), ("equisolid", 2.0), ("orthographic", 1.0)):
        rays = sample(Fisheye(name, FOCAL), FOCAL * end * np.array([[0.999, 1.001, 50.0], [0.0, 0.0, 50.0]]))
        assert rays.status.tolist() == [st.PASSED, st.OUTSIDE_DOMAIN, st.OUTSIDE_DOMAIN]
        assert (rays.weight[1:] == 0).all() and np.linalg.norm(rays.direction, axis=0) == pytest.approx(1, abs=1e-6)
    # A stereographic film has no end: it sees all but what lies straight behind.
    assert sample(Fisheye("stereographic", FOCAL), np.full((2, 1), 1e4)).status[0] == st.PASSED
    half = Fisheye("equidistant", FOCAL, field_deg=90.0)
    assert sample(half, FOCAL * np.array([[0.78, 0.79], [0.0, 0.0]])).status.tolist() == [0, st.OUTSIDE_DOMAIN]


@pytest.mark.parametrize("kind", ["pinhole", "thin", "thick", *PROJECTIONS])
def test_differentials_are_finite_differences(kind: str) -> None:
    ideal = {
        "pinhole": lambda: Pinhole(35.0),
        "thin": lambda: ThinLens(50.0, 2.0, 3.0),
        "thick": lambda: made(RETROFOCUS),
    }
    camera = ideal[kind]() if kind in ideal else Fisheye(kind, FOCAL)
    film, square, wavelength = film_rays(camera, 500)
    if kind in PROJECTIONS:
        film /= 3  # within all of them
        film[:, 0] = 0
    moves = camera.sample_differentials(film, square, wavelength).differentials
    assert moves is not None
    found = np.concatenate([moves.origin_m, moves.direction])
    step, most = (0.02, 2e-5) if kind in PROJECTIONS else (0.25, 3e-6)
    np.testing.assert_allclose(found, differences(camera, film, square, wavelength, step), atol=most)


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
        ("fisheye-equidistant", {"focus_mode": "internal"}, "focus_mode"),
        ("fisheye-equidistant", {"field_deg": 361.0}, "field_deg"),
        ("fisheye-orthographic", {"field_deg": 181.0}, "field_deg"),
        ("fisheye-equisolid", {"field_deg": 90.0, "focal_length_mm": 8.0}, "focal_length_mm"),
        ("fisheye-equisolid", {"focal_length_mm": math.inf}, "focal_length_mm"),
    ],
)
def test_bad_settings_are_named(spec: str, change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        make_camera(spec, Shot((36.0, 24.0), 1.0, **change))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="projection"):
        Fisheye("fish", 10.0)


@pytest.mark.skipif(not has_compiler(), reason="no C compiler")
@pytest.mark.parametrize("kind", ["thin:", "thick:"])
@pytest.mark.parametrize("shape", [None, Aperture(blades=6, rotation_deg=10.0)])
def test_compiled_ideal_lenses_give_the_same_rays(kind: str, shape: Aperture | None) -> None:
    compiled: Any = make_camera(f"{kind}lenses/laikin_double_gauss_50.toml", Shot(FILM, 2.0, 2.8, aperture=shape))
    plain = copy(compiled)
    plain._run = plain._evaluated
    rng, count = np.random.default_rng(0), 5000
    film = ((rng.random((2, count)) - 0.5) * np.array(FILM)[:, None]).astype(np.float32)
    square, waves = rng.random((2, count), np.float32), np.full(count, 550, np.float32)
    square[:, :4] = [[0.5, 0.0, np.nan, 1.5], [0.5, 0.0, 0.5, 0.5]]
    film[0, 4], film[1, 5], waves[6], waves[7] = np.inf, 1e30, np.nan, -1.0
    one, other = (c.sample(film, square, waves) for c in (plain, compiled))
    np.testing.assert_array_equal(one.status, other.status)
    assert (one.status[2:8] != 0).all() and not one.weight[2:8].any()
    for part in ("origin_m", "direction", "weight"):
        np.testing.assert_allclose(getattr(one, part), getattr(other, part), rtol=0, atol=1e-6)


def test_without_a_compiler_ideal_lenses_run_in_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "has_compiler", lambda: False)
    camera: Any = make_camera("thin", Shot(FILM, 2.0, 2.8))
    assert camera._run == camera._evaluated
    rays = camera.sample(np.zeros((2, 1), np.float32), np.full((2, 1), 0.5, np.float32), np.full(1, 550, np.float32))
    assert rays.direction[:, 0] == pytest.approx([0, 0, -1]) and rays.status[0] == 0
