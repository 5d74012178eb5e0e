"""Projections of vision programs: OpenCV's own functions, closed forms, folds, files."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from neurolens.cameras.build import make_camera
from neurolens.cameras.field import Field, field_of
from neurolens.cli import main, stmap as command
from neurolens.optics.analysis.projections import NAMES, Projection, fit, has_pole, inverse_polynomial, residual
from neurolens.optics.lens.shot import Shot
from neurolens.programs import handover as files
from tests.command_line import failure, run_json

ROOT = Path(__file__).parents[3]
GAUSS = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
FISHEYE = ROOT / "models" / "isshiki_fisheye_10.ols-64.onnx"
SIZE, FILM = (1920, 1080), (36.0, 20.25)
PICTURE = ("--width", "1920", "--film", "36x20.25", "--quiet")
# One of each kind, as strong as lenses are, and its widest angle in rad.
EXAMPLES = {
    "opencv": ((1400.0, 1380.0), (-0.21, 0.06, 1e-3, -5e-4, -0.008), 0.7),
    "opencv-rational": ((1400.0, 1400.0), (0.5, -0.1, 0.0, 0.0, 0.01, 0.72, 0.05, 0.01), 0.7),
    "kannala-brandt": ((560.0, 560.0), (-0.02, 0.002, -4e-4, 2e-5), 2.0),
    "f-theta": ((0.98, 1.0), (540.0, 3.0, -9.0, 2.0, -0.4), 1.8),
}


def example(kind: str) -> Projection:
    focal, coefficients, widest = EXAMPLES[kind]
    return Projection(kind, SIZE, focal, coefficients, widest)


def rays(widest: float, count: int = 400) -> np.ndarray:
    """Unit directions over a field, the axis among them."""
    rng = np.random.default_rng(3)
    angle, turn = widest * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    angle[0] = 0
    found = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
    return np.stack(found, 1)


def field_of_camera(spec: str | Path, **shot: float) -> Field:
    return field_of(make_camera(spec, Shot(film_mm=FILM, focus_m=math.inf, **shot)), math.inf, "equidistant")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", NAMES)
def test_the_length_of_a_direction_changes_no_pixel_and_the_axis_is_the_middle(kind: str) -> None:
    found = example(kind)
    direction = rays(0.95 * found.widest_rad).reshape(20, 20, 3)
    pixel = found.project(3 * direction)
    assert pixel.shape == (20, 20, 2) and np.allclose(pixel, found.project(direction))
    assert found.project(np.array([0.0, 0.0, 1.0])).tolist() == pytest.approx([959.5, 539.5])


@pytest.mark.parametrize("kind", ["opencv", "opencv-rational", "kannala-brandt"])
def test_opencv_projects_to_the_same_pixels(kind: str, tmp_path: Path) -> None:
    """Its own functions, with the numbers that its FileStorage reads from our file."""
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless (extra dev) is not installed")
    found = example(kind)
    direction = rays(min(found.widest_rad, 1.5))
    path = tmp_path / "camera.yaml"
    told = files.FittedProjection(
        camera="it", model=kind, size=list(SIZE), focal_px=[1.0, 1.0], centre_px=[0.0, 0.0], coefficients={},
        rms_px=0.25, worst_px=1.0, worst_at_deg=1.0, light_at_worst=1.0, field_deg=1.0, turns_back_at_deg=None,
        by_field=[], before_film_mm=[1.0, 1.0],
    )  # fmt: skip
    files.write_projection(tmp_path / "camera", found, told)
    stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, numbers = (stored.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
    assert (stored.getNode("image_width").real(), stored.getNode("avg_reprojection_error").real()) == (1920, 0.25)
    zero, fisheye = np.zeros(3), kind == "kannala-brandt"
    points = (direction / direction[:, 2:])[:, None]
    pixel = (cv2.fisheye.projectPoints if fisheye else cv2.projectPoints)(points, zero, zero, matrix, numbers)[0]
    assert np.abs(pixel[:, 0] - found.project(direction)).max() < 1e-6


def test_coefficients_are_found_again() -> None:
    for kind in ("opencv", "kannala-brandt", "f-theta"):
        known = example(kind)
        # A lens centred on its axis has none of these.
        names = dict(known.named) | {"p1": 0.0, "p2": 0.0}
        known = Projection(kind, SIZE, known.focal_px, tuple(names[n] for n in NAMES[kind]), known.widest_rad)
        direction = rays(known.widest_rad, 900)
        start = (1010.0, 1990.0) if kind != "f-theta" else (0.98 * 530.0, 530.0)
        found = fit(kind, direction, known.project(direction), SIZE, start)
        assert residual(found, direction, known.project(direction)).worst_px < 1e-5
        assert found.coefficients == pytest.approx(known.coefficients, rel=1e-3, abs=1e-5)
        assert found.focal_px == pytest.approx(known.focal_px)


def test_closed_forms_of_ideal_cameras() -> None:
    """Equidistant is t, equisolid 2 sin(t / 2) = t (1 - t^2 / 24 + t^4 / 1920 - ...), a pinhole has no distortion."""
    pixel = FILM[0] / SIZE[0]
    for spec, kind, focal, expected in (
        ("fisheye-equidistant", "kannala-brandt", 14.0, {"k1": 0.0, "k2": 0.0}),
        ("fisheye-equidistant", "f-theta", 14.0, {"a1": 14.0 / pixel, "a2": 0.0}),
        ("fisheye-equisolid", "kannala-brandt", 14.0, {"k1": -1 / 24, "k2": 1 / 1920}),
        ("pinhole", "opencv", 50.0, {"k1": 0.0, "k2": 0.0}),
    ):
        field = field_of_camera(spec)
        points = files._shown(field, SIZE, FILM, files.lit_points(field, FILM))
        found = fit(kind, *points, SIZE, (focal / pixel, focal / pixel))
        left = residual(found, *files._shown(field, SIZE, FILM, files.lit_points(field, FILM, (40, 30))))
        assert left.worst_px < 2e-3 and left.sound
        least = 0.01 if kind == "f-theta" else 2e-4  # pixels, or a share
        assert {k: found.named[k] for k in expected} == pytest.approx(expected, abs=least, rel=1e-4)
        if kind != "f-theta":
            assert found.focal_px == pytest.approx((focal / pixel, focal / pixel), rel=1e-5)


def test_a_projection_that_turns_back_says_so() -> None:
    """r (1 - r^2 / 2) rises to r = sqrt(2 / 3)."""
    found = Projection("opencv", SIZE, (1000.0, 1000.0), (-0.5, 0.0, 0.0, 0.0, 0.0), 0.8)
    fold = math.atan(math.sqrt(2 / 3))
    assert found.fold_rad == pytest.approx(fold, abs=1e-3)
    beyond = rays(1.2)
    left = residual(found, beyond, found.project(beyond))
    assert not left.sound and left.fold_deg == pytest.approx(math.degrees(fold), abs=0.1)
    assert np.isnan(found.project(np.array([0.0, 0.1, -1.0]))).all()


def test_parallax_is_the_walk_of_the_entrance_pupil(capsys: pytest.CaptureFixture[str]) -> None:
    """A fisheye's pupil moves by millimetres: one centre is off by tens of pixels of what is near, an ideal camera's
    by none, and what is twice as far from the pupil is off by half."""
    words = ("--width", "3840", "--film", "18x18", "--quiet", "--focus", "1", "--projection", "kannala-brandt")
    near = {}
    for metres in (0.5, 0.8):
        told = run_json(capsys, "projection", FISHEYE, *words, "--near", metres)
        far, close = told["parallax"]
        assert far["distance_m"] == "infinity" and close["distance_m"] == metres and told["rms_px"] < 0.1
        near[metres] = close["worst_px"], 1 / (metres - told["before_film_mm"][0] / 1000)
        one = 1 / (1 - told["before_film_mm"][0] / 1000)
        # Proportional to the difference of reciprocal distances from the pupil, to a first approximation.
        assert close["worst_px"] / far["worst_px"] == pytest.approx((near[metres][1] - one) / one, rel=0.2)
        assert far["worst_px"] > 20
    assert main(["projection", str(FISHEYE), *words]) == 0
    assert re.search(
        r"is off by \S+ pixels RMS, \S+ at most, for things at infinity; \S+ pixels RMS", capsys.readouterr().out
    )
    ideal = run_json(capsys, "projection", "fisheye-equidistant", *words)
    assert all(row["worst_px"] < 0.01 for row in ideal["parallax"])


def test_the_rim_of_the_light_is_no_fold(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fisheye's light ends at 18.8 mm of this film, and its mean steps back by 5 um in the last thousandth."""
    field = field_of_camera(ROOT / "lenses" / "isshiki_fisheye_10.toml")
    assert 18.5 < field.end_mm < 19 and (np.diff(np.abs(field.ideal(np.linspace(0, field.end_mm, 999) + 0j))) > 0).all()


def test_blue_light_at_the_rim_does_not_bend_the_fit() -> None:
    """From 18.4 to 18.8 mm of this film only blue light arrives, a hundredth of the axis's and less, from elsewhere."""
    field = field_of_camera(ROOT / "lenses" / "isshiki_fisheye_10.toml")
    _, left, told = files.fitted_projection("kannala-brandt", field, (384, 216), (36.0, 20.25), "here")
    assert all(worst < 0.002 for _, to, _, worst in left.by_field if to < 91)  # pixels; 0.03 with all points alike
    assert left.rms_px < 0.04 and left.worst_at_deg > 111 and 0.001 < told.light_at_worst < 0.02


@pytest.mark.parametrize("camera", [GAUSS, ROOT / "models" / "nikon_zoom_14_24.ols-64.onnx"])
def test_a_ratio_has_no_pole_in_its_picture(camera: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two lenses to which six free terms put a pole beside a zero: at every thousandth of a pixel the place is near
    that of the lens, and beyond the corner no denominator is zero for another tenth."""
    monkeypatch.setattr("neurolens.cameras.field._ROUND", (129, 1))
    field = field_of_camera(camera)
    found, left, _ = files.fitted_projection("opencv-rational", field, SIZE, FILM, "here")
    end = 1.1 * math.tan(found.widest_rad)
    x = np.linspace(0, end, round(1000 * end * found.focal_px[0])) ** 2
    k1, k2, _, _, k3, k4, k5, k6 = found.coefficients
    assert (1 + x * (k4 + x * (k5 + x * k6))).min() > 0.05
    assert (
        np.abs(np.diff(np.sqrt(x) * (1 + x * (k1 + x * (k2 + x * k3))) / (1 + x * (k4 + x * (k5 + x * k6))))).max()
        < 1e-5
    )
    assert left.worst_px < 0.1


def test_poles_are_found_by_the_roots_of_the_denominator() -> None:
    """(1 - x) (1 - x / 9), a double root, a pair of roots that are not real, and a root beyond the picture."""
    assert has_pole([-10 / 9, 1 / 9, 0.0], 1.5) and not has_pole([-10 / 9, 1 / 9, 0.0], 0.99)
    assert has_pole([-2.0, 1.0, 0.0], 1.5) and not has_pole([-2.0, 1.01, 0.0], 1.5)
    assert not has_pole([0.0, 0.0, 0.0], 10.0) and not has_pole([145.73, 2.0, 1.0], 10.0)


def test_the_ring_where_a_ratio_is_sharpest_is_known() -> None:
    """A ratio whose denominator all but reaches zero 43 pixels from the centre."""
    x = 0.0017  # r^2 there
    sharp = Projection(
        "opencv-rational", SIZE, (1044.5, 1044.5), (-2 / x, 1 / x**2, 0, 0, 0, -2 / x, 1.0000001 / x**2, 0), 0.7
    )
    (angle, _) = sharp.sharp_rad
    assert not sharp.pole and 1044.5 * math.tan(angle) == pytest.approx(43.07, abs=0.01)


def test_f_theta_goes_both_ways() -> None:
    field = field_of_camera("fisheye-stereographic")
    points = files._shown(field, SIZE, FILM, files.lit_points(field, FILM))
    found = fit("f-theta", *points, SIZE, (746.7, 746.7))
    angle = np.linspace(0, found.widest_rad, 50)
    radius = sum(a * angle ** (k + 1) for k, a in enumerate(found.coefficients))
    back = sum(b * radius ** (k + 1) for k, b in enumerate(inverse_polynomial(found)))
    assert np.abs(back - angle).max() < 2e-4


def test_the_command_fits_a_lens_and_writes_what_programs_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neurolens.cameras.field._ROUND", (129, 1))
    monkeypatch.setattr(files, "_CELLS", (6,))
    told = run_json(capsys, "projection", GAUSS, *PICTURE, "--projection", "opencv", "-o", tmp_path / "a.json")
    assert told["rms_px"] < 0.02 and told["worst_px"] < 0.1 and told["turns_back_at_deg"] is None
    assert -0.3 < told["coefficients"]["k1"] < -0.2 and told["focal_px"][0] == told["focal_px"][1]
    assert len(told["by_field"]) == 5 and told["centre_px"] == [959.5, 539.5]
    block = json.loads((tmp_path / "a.json").read_text())
    assert block["camera_model"] == "OPENCV" and (block["cx"], block["cy"], block["w"]) == (960.0, 540.0, 1920)
    assert "camera_matrix: !!opencv-matrix" in (tmp_path / "a.yaml").read_text()
    monkeypatch.setattr("neurolens.cameras.field._OTHER", (33, 16))
    moved = ["--film-shift", "3", "--film-rise", "-2"]  # the principal point lies to the left and above
    told = run_json(capsys, "projection", GAUSS, *PICTURE, "--projection", "opencv", *moved)
    assert told["rms_px"] < 0.05 and told["centre_px"] == pytest.approx([959.5 - 160, 539.5 - 2 * 1920 / 36])
    kinds = {"kannala-brandt": 0.5, "f-theta": 0.5}  # pixels RMS of 10 mm, 220 degrees
    for kind, most in kinds.items():
        asked = (
            () if kind == "kannala-brandt" else ("--projection", kind)
        )  # so wide a field takes the fisheye by itself
        told = run_json(capsys, "projection", FISHEYE, *PICTURE, *asked, "-o", tmp_path / kind)
        assert told["rms_px"] < most and told["field_deg"] > 95
    assert json.loads((tmp_path / "kannala-brandt.json").read_text())["camera_model"] == "OPENCV_FISHEYE"
    theta = json.loads((tmp_path / "f-theta.json").read_text())
    assert len(theta["angle_to_pixeldist_poly"]) == len(theta["pixeldist_to_angle_poly"]) == 6
    assert theta["linear_cde"] == [1.0, 0.0, 0.0] and theta["principal_point"] == [959.5, 539.5]


def test_bad_input_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for camera, change, words in (
        (FISHEYE, ("--projection", "opencv"), "a field up to 85 degrees"),
        (GAUSS, ("--projection", "pinhole"), "--projection"),
        (GAUSS, ("--projection", "opencv", "-o", tmp_path / "none" / "a"), "a folder that exists"),
        (GAUSS, ("--projection", "opencv", "--height", "1920"), "shape of the film"),
    ):
        assert words in failure(capsys, "projection", camera, *PICTURE, *change)
    kinds = get_args(get_type_hints(command.Projection)["projection"])[0]
    assert get_args(kinds) == tuple(NAMES) and not list(tmp_path.iterdir())
