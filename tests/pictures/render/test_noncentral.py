"""The ray of each pixel: read by the format's own description, and held against chief rays through the prescription."""

from __future__ import annotations

import math
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from shipped import whole

from neurolens.cameras import field as fields
from neurolens.cameras.build import make_camera
from neurolens.cameras.field import Field, field_of, spectrum_of
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.projections import RayTable
from neurolens.optics.lens.shot import Shot
from neurolens.programs import handover as files
from tests.command_line import failure, run_json

ROOT = Path(__file__).parents[3]
LENSES = ROOT / "lenses"
FISHEYE = ROOT / "models" / "isshiki_fisheye_10.ols-64.onnx"


def rays_of(path: Path, pixel: np.ndarray) -> np.ndarray:
    """Points and unit directions [N, 6] of pixels (0, 0 the first one's centre) as the file says that it is read."""
    yaml = pytest.importorskip("yaml", reason="PyYAML (extra dev) is not installed")
    told = yaml.safe_load(path.read_text(encoding="utf-8"))
    width, height = told["grid_width"], told["grid_height"]
    found = np.zeros((len(pixel), 6))
    grid = np.concatenate([np.reshape(told[f"{k}_grid"], (height, width, 3)) for k in ("point", "direction")], 2)
    place = []
    for axis, count in (("x", width), ("y", height)):
        start, end = told[f"calibration_min_{axis}"], told[f"calibration_max_{axis}"] + 1
        place.append(1 + (count - 3) * (pixel[:, "xy".index(axis)] + 0.5 - start) / (end - start))

    def basis(t: np.ndarray) -> np.ndarray:
        """The uniform cubic B-spline about 0, in closed form."""
        t = np.abs(t)
        return np.where(t < 1, (4 - 6 * t**2 + 3 * t**3) / 6, np.where(t < 2, (2 - t) ** 3 / 6, 0.0))

    for row in range(height):
        for column in range(width):
            found += (basis(place[0] - column) * basis(place[1] - row))[:, None] * grid[row, column]
    found[:, 3:] /= np.linalg.norm(found[:, 3:], axis=1, keepdims=True)
    return found


def table_of(
    name: str, film: tuple[float, float], size: tuple[int, int], focus_m: float, near_m: float, f_number: float = 90.0
) -> tuple[Any, Field, RayTable, list[dict[str, float]]]:
    """Its camera, field, table and errors, in light of 550 nm."""
    camera = make_camera(f"fused:{LENSES / name}.toml", Shot(film_mm=film, focus_m=focus_m, f_number=f_number))
    field = field_of(camera, focus_m, "equidistant", spectrum=spectrum_of(camera, only_nm=550.0))
    return camera, field, *files.ray_table(camera, field, size, film, focus_m, near_m)


EIGHT_HUNDRED = "nikon_af_s_nikkor_800mm_f5_6e_fl_ed_vr"


@pytest.mark.parametrize(
    ("name", "film", "focus_m", "near_m", "f_number", "degrees", "central_px"),
    [
        ("isshiki_fisheye_10", (18.0, 18.0), 1.0, 0.3, 90.0, np.linspace(4, 50, 12), 10),
        *whole(("nikon_zoom_14_24", (36.0, 24.0), math.inf, 0.3, 22.0, np.linspace(3, 38, 12), 1)),
        *whole(
            ("nikon_af_s_nikkor_800mm_f5_6e_fl_ed_vr", (36.0, 24.0), math.inf, 6.0, 90.0, np.linspace(0.1, 0.8, 12), 0)
        ),
    ],
    ids=["fisheye", "wide", "telephoto"],
)
def test_a_table_has_the_chief_rays_where_one_centre_has_not(
    name: str, film: tuple[float, float], focus_m: float, near_m: float, f_number: float,
    degrees: np.ndarray, central_px: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Stopped down, where chief ray and centroid agree: things at the near limit stand on the table's rays within
    0.05 pixels of 3840; the best of all centres is wrong by far more where the entrance pupil moves with the field."""
    monkeypatch.setattr(fields, "_ROUND", (129, 1))
    monkeypatch.setattr(files, "_CELLS", (24, 48))
    size = 3840, round(3840 * film[1] / film[0])
    camera, field, table, left = table_of(name, film, size, focus_m, near_m, f_number)
    assert max(row["worst_px"] for row in left) < 0.05
    path = Path(files.write_ray_table(tmp_path / "a", table, left, "here", field))
    scene = Scene(camera.lens, focus_m)
    chief = scene.chief_rays(degrees, 550.0)
    pupil_z = scene.film_z_mm - field.frame.pupil_mm[1]
    # From the lens's frame, light along +z, to OpenCV's about the entrance pupil, in m; the picture is turned by 180.
    start = 1e-3 * np.stack([chief.start.x, -chief.start.y, pupil_z - chief.start.z], 1)
    way = np.stack([-chief.start.dx, chief.start.dy, chief.start.dz], 1)
    pixel = np.stack([chief.film.x / film[0], chief.film.y / film[1]], 1) * [-size[0], size[1]]
    pixel += np.array(size) / 2 - 0.5
    assert chief.exists.all() and (np.abs(pixel - np.array(size) / 2) < np.array(size) / 2).all()
    radius = near_m - 1e-3 * field.frame.pupil_mm[1]
    along = (start * way).sum(1)
    near = start + (-along + np.sqrt(along**2 + radius**2 - (start**2).sum(1)))[:, None] * way
    rays = rays_of(path, pixel)
    assert np.allclose(rays, table(pixel), atol=1e-8)
    px = np.hypot(*np.gradient(pixel, np.arctan2(np.hypot(*way[:, :2].T), way[:, 2]), axis=0).T)  # a radian
    for place, reach in ((near, radius), (way, 1.0)):
        point = rays[:, :3] if reach == radius else 0 * way
        off = np.linalg.norm(np.cross(place - point, rays[:, 3:]), axis=1) / reach * px
        assert off.max() < 0.05
    # A centre on the axis, calibrated by what is far.
    off = minimize_scalar(
        lambda z: np.sqrt(np.mean((np.linalg.norm(np.cross(near - [0, 0, z], way), axis=1) / radius * px) ** 2)),
        bounds=(-0.1, 0.1), method="bounded",
    ).fun  # fmt: skip
    assert off >= central_px


@pytest.mark.whole  # a quarter of a minute
def test_a_lens_with_cylinders_has_two_pupils_which_a_table_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fields, "_OTHER", (25, 16))
    monkeypatch.setattr(files, "_CELLS", (12,))
    camera, field, table, left = table_of("cooke_anamorphic_42", (20.0, 16.0), (1920, 1536), 3.0, 1.0, 11.0)
    point = fields.lit_points(field, (20.0, 16.0), (9, 7))
    moved = np.abs(fields.shown_at(camera, field, point, 1.0) - point) * 1920 / 20
    assert max(row["worst_px"] for row in left) < 0.05 and np.nanmax(moved) > 10
    # Near the centre rays along x and along y meet the axis at the pupils of both meridians, 33 mm apart.
    px = np.array([[1919 / 2 + 100, 1535 / 2], [1919 / 2, 1535 / 2 + 100]])
    x, y, z, dx, dy, dz = table(px).T
    meet = 1e3 * np.array([(z - x * dz / dx)[0], (z - y * dz / dy)[1]]) + np.mean(field.frame.pupil_mm)
    assert meet == pytest.approx(field.frame.pupil_mm, abs=1.0)


def test_a_camera_with_a_centre_has_rays_through_it() -> None:
    """An equidistant fisheye: directions in closed form, no way from the centre."""
    camera = make_camera("fisheye-equidistant", Shot(film_mm=(36.0, 24.0), focus_m=math.inf, focal_length_mm=12.0))
    field = field_of(camera, math.inf, "equidistant")
    table, left = files.ray_table(camera, field, (360, 240), (36.0, 24.0), math.inf, 0.3)
    pixel = np.array([[179.5, 119.5], [0.0, 119.5], [179.5, 239.0], [300.25, 17.5]])
    rays = table(pixel)
    side = (pixel - [179.5, 119.5]) * 0.1 / 12
    angle = np.hypot(*side.T)
    way = np.stack([*(side.T * np.sinc(angle / np.pi)), np.cos(angle)], 1)
    assert np.abs(rays[:, 3:] - way).max() < 1e-5 and np.abs(rays[:, :3]).max() < 1e-6
    assert table.grid.shape[1] == 15 and max(row["worst_px"] for row in left) < 0.01


def test_the_page_reads_a_table_that_does_not_span_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("yaml", reason="PyYAML (extra dev) is not installed")
    page = (ROOT / "docs" / "pages" / "how-to" / "projection.md").read_text(encoding="utf-8")
    code = next(block for block in re.findall(r"^```python\n(.*?)^```", page, re.M | re.S) if "noncentral" in block)
    camera = make_camera("fisheye-equidistant", Shot(film_mm=(36.0, 24.0), focus_m=1.0))
    field = field_of(camera, 1.0, "equidistant", spectrum=spectrum_of(camera, only_nm=550.0))
    grid = np.random.default_rng(1).normal(size=(7, 9, 6))
    table = RayTable((1920, 1080), (200, 30), (1699, 1029), grid)
    files.write_ray_table(tmp_path / "gauss", table, [{"rms_px": 0.0, "worst_px": 0.0, "distance_m": 1.0}], "it", field)
    monkeypatch.chdir(tmp_path)
    Path("block.py").write_text(code.replace("[0.5, 0.5]", "[300.5, 40.5]"), encoding="utf-8")
    exact = table(np.array([[300.0, 40.0], [959.5, 539.5]]))
    found = runpy.run_path("block.py")["found"]
    found[:, 3:] /= np.linalg.norm(found[:, 3:], axis=1, keepdims=True)
    np.testing.assert_allclose(found, exact, atol=1e-8)


def test_dark_parts_of_the_picture_bend_no_ray_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The light of this fisheye ends within the film, whose corners have rays that mean nothing."""
    monkeypatch.setattr(fields, "_ROUND", (257, 1))
    monkeypatch.setattr(files, "_CELLS", (24,))
    camera = make_camera(f"fused:{LENSES / 'isshiki_fisheye_10'}.toml", Shot(film_mm=(60.0, 40.0), focus_m=1.0))
    field = field_of(camera, 1.0, "equidistant", spectrum=spectrum_of(camera, only_nm=550.0))
    table, _ = files.ray_table(camera, field, (1500, 1000), (60.0, 40.0), 1.0, 0.3)
    assert field.end_mm < 19 and 250 < table.first[0] < 300 and 1200 < table.last[0] < 1250 and table.first[1] > 20
    angle = np.linspace(0, 2 * np.pi, 40)
    pixel = np.array([749.5, 499.5]) + 0.97 * field.end_mm * 25 * np.stack([np.cos(angle), np.sin(angle)], 1)
    point = 0.97 * field.end_mm * np.exp(-1j * angle)
    exact = files.sight(camera, field, point, 0.3)
    assert np.abs(table(pixel)[:, 3:] - exact[:, 3:]).max() * 10 * 25 < 0.05  # pixels


def test_the_command_writes_the_table_where_one_centre_is_not_enough(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fields, "_ROUND", (129, 1))
    words = ("projection", FISHEYE, "--width", "480", "--film", "18x18", "--quiet", "--focus", "1", "--projection")
    told = run_json(capsys, *words, "kannala-brandt", "--near", "0.3", "-o", tmp_path / "a")
    assert str(tmp_path / "a.noncentral.yaml") in told["files"] and (tmp_path / "a.noncentral.yaml").is_file()
    assert {row["distance_m"] for row in told["noncentral"]} == {"infinity", 1.0, 0.3}
    assert max(row["worst_px"] for row in told["noncentral"]) < 0.01 < 10 < told["parallax"][1]["worst_px"]
    walk = [row["pupil_before_film_mm"] for row in told["by_field"]]
    assert walk == sorted(walk) and 15 < walk[-1] - told["before_film_mm"][0] < 25  # mm
    ideal = ("projection", "fisheye-equidistant", *words[2:], "kannala-brandt", "-o", tmp_path / "b")
    assert "noncentral" not in run_json(capsys, *ideal) and not (tmp_path / "b.noncentral.yaml").exists()
    assert len(run_json(capsys, *ideal, "--noncentral")["files"]) == 3
    assert len(run_json(capsys, *ideal)["files"]) == 2 and not (tmp_path / "b.noncentral.yaml").exists()
    said = failure(capsys, *words, "kannala-brandt", "--near", "0.1")
    assert "--near" in said and "the distance of the entrance pupil" in said
    assert "a distance in metres from 0.001 to 1e+06" in failure(capsys, *words, "kannala-brandt", "--near", "1e308")
    assert "-o NAME" in failure(capsys, *words, "kannala-brandt", "--noncentral")
