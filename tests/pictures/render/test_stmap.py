"""ST maps: closed forms, the analysis as oracle, what a render shows, there and back, the files and their errors."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from shutil import which
from typing import Any, get_args, get_type_hints

import numpy as np
import OpenEXR
import pytest

from neurolens.cameras import field as fields
from neurolens.cameras.build import make_camera
from neurolens.cameras.field import Field, field_of, spectrum_of
from neurolens.cameras.sampling import stratified
from neurolens.cli import stmap as command
from neurolens.optics.analysis.field_curves import colour, distortion, illumination
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.paraxial import chief_reach_mm, first_order
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.render.pictures import read_exr, read_layers
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene
from neurolens.pictures.render.stmap import illumination_map, plates_of, redistort_map, undistort_map, worst_px
from tests.command_line import failure, run_json

ROOT = Path(__file__).parents[3]
GAUSS = ROOT / "lenses" / "laikin_double_gauss_50.toml"
MODEL = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
WIDE, FILM = (384, 216), (36.0, 20.25)


@cache
def traced(spec: str, film_mm: tuple[float, float] = FILM, target: str = "rectilinear", **shot: Any) -> Field:
    camera = make_camera(spec, Shot(film_mm=film_mm, **{"focus_m": 2.0, **shot}))
    return field_of(camera, shot.get("focus_m", 2.0), target)


def read_through(picture: np.ndarray, planes: dict[str, np.ndarray]) -> np.ndarray:
    """A picture [H, W, ...] read by an ST map as compositing programs do: bilinear, (x + 0.5) / width, from below."""
    height, width = picture.shape[:2]
    x, y = planes["R"] * width - 0.5, (1 - planes["G"]) * height - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    found = 0
    for right in (0, 1):
        for down in (0, 1):
            weight = np.abs(1 - right - (x - column)) * np.abs(1 - down - (y - row))
            part = picture[np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)]
            found = found + part * weight.reshape(*weight.shape, *[1] * (picture.ndim - 2))
    return np.asarray(found)


def centres(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """s and t of the centres of a picture's pixels [H, W], rows from the top."""
    s, t = (np.arange(size[0]) + 0.5) / size[0], 1 - (np.arange(size[1]) + 0.5) / size[1]
    return np.broadcast_to(s, size[::-1]), np.broadcast_to(t[:, None], size[::-1])


@pytest.mark.parametrize("target", ["rectilinear", "equidistant", "stereographic"])
def test_a_pinhole_undistorts_to_itself_and_fisheyes_to_their_closed_forms(target: str) -> None:
    """r = f rho(theta) on both sides; within 0.01 of a pixel of 3840 over the film."""
    film, focal = (24.0, 13.5), 14.0
    field = traced("pinhole" if target == "rectilinear" else "fisheye-equidistant", film, target)
    plates = plates_of([field], WIDE, film)
    if target == "rectilinear":
        assert plates.undistorted == WIDE and plates.overscan == (1.0, 1.0)
    if target != "stereographic":  # f theta onto f theta, too
        planes = undistort_map(field, plates)
        s, t = centres(plates.undistorted)
        wide = np.array(plates.undistorted) / WIDE
        assert np.abs(planes["R"] - ((s - 0.5) * wide[0] + 0.5)).max() < 0.01 / 3840
        assert np.abs(planes["G"] - ((t - 0.5) * wide[1] + 0.5)).max() < 0.01 / 3840
    radius = np.linspace(0.1, math.hypot(*film) / 2, 50)
    ideal = {"rectilinear": radius, "equidistant": radius, "stereographic": 2 * focal * np.tan(radius / focal / 2)}
    for turn in (1, np.exp(2j)):
        assert np.abs(field.ideal(radius * turn) - ideal[target] * turn).max() < 0.01 * film[0] / 3840
        assert np.abs(field.picture(ideal[target] * turn) - radius * turn).max() < 0.01 * film[0] / 3840


def test_f_theta_onto_a_plane_is_a_tangent_and_its_overscan_holds_every_pixel() -> None:
    film, focal = (24.0, 13.5), 14.0
    field = traced("fisheye-equidistant", film)
    plates = plates_of([field], (960, 540), film)
    corner = math.hypot(*film) / 2
    stretch = math.tan(corner / focal) * focal / corner
    # The corner of the picture is the corner of the undistorted one, to whole pixels on both sides.
    for made, side in zip(plates.undistorted, (960, 540), strict=True):
        assert made % 2 == side % 2 and side * stretch <= made < side * stretch + 2
    there, back = redistort_map(field, plates), undistort_map(field, plates)
    assert there["B"].min() == 1.0 and back["B"].shape == plates.undistorted[::-1]
    assert 0 < back["B"].mean() < 1 and back["R"].min() < 0 and back["R"].max() > 1
    s, t = centres((960, 540))
    radius = np.hypot((s - 0.5) * film[0], (t - 0.5) * film[1])
    expected = 0.5 + (s - 0.5) * 960 / plates.undistorted[0] * focal * np.tan(radius / focal) / radius
    assert np.abs(there["R"] - expected).max() * plates.undistorted[0] < 0.01
    steep = traced("fisheye-equidistant", (36.0, 20.25), focal_length_mm=14.2)
    assert 83 < steep.field_deg < 85 and worst_px(steep, plates_of([steep], (960, 540), (36.0, 20.25)))[1] < 0.01
    # There and back by the maps themselves: what the one reads, read through the other.
    again = read_through(np.stack([back["R"], back["G"]], -1), there)
    assert np.abs((again - np.stack([s, t], -1)) * (960, 540)).max() < 0.01


def test_a_lens_goes_there_and_back_through_its_maps() -> None:
    field = traced(str(MODEL))
    plates = plates_of([field], (960, 540), FILM)
    there, back = redistort_map(field, plates), undistort_map(field, plates)
    again = read_through(np.stack([back["R"], back["G"]], -1), there)
    assert there["B"].min() == 1.0
    assert np.abs((again - np.stack(centres((960, 540)), -1)) * (960, 540)).max() < 0.01
    moved, missed = worst_px(field, plates)
    assert 20 < moved < 50 and missed < 0.01


def test_a_model_and_its_lens_have_one_field_and_that_of_the_chief_rays_when_stopped_down() -> None:
    exact, model = traced(str(GAUSS)), traced(str(MODEL))
    points = np.linspace(0.5, 20.5, 30) * np.exp(0.5j)
    assert np.abs(exact.ideal(points) - model.ideal(points)).max() < 2e-3
    assert np.allclose(exact.frame, model.frame, rtol=1e-4)
    # The stop closed, the centroid is the chief ray, and heights are those of the analysis's own search.
    camera = make_camera(str(GAUSS), Shot(film_mm=FILM, focus_m=2.0, f_number=90, focus_mode="paraxial"))
    closed = field_of(camera, 2.0, spectrum=spectrum_of(camera, only_nm=587.6))
    found = distortion(Scene(camera.lens, 2.0), wavelength_nm=587.6, fields=9)  # type: ignore[attr-defined]
    height = found.height_mm[1:-1]
    percent = 100 * (height / closed.ideal(height + 0j).real - 1)
    assert np.abs(percent - found.error_percent["rectilinear, f tan"][1:-1]).max() < 2e-3
    assert closed.frame.reach_mm[0] == pytest.approx(chief_reach_mm(camera.lens))  # type: ignore[attr-defined]


def test_a_render_undistorted_by_the_map_is_the_pinholes(tmp_path: Path) -> None:
    """Small lights in the plane in focus: their places within 0.1 pixel."""
    places = [(x, y) for x in (-0.56, -0.28, 0.0, 0.28, 0.56) for y in (-0.3, -0.15, 0.15, 0.3)]
    lights = [f"{{ centre_m = [{x}, {y}, 0.0], radius_m = 0.014, emission = [1.0, 1.0, 1.0] }}," for x, y in places]
    camera = "[camera]\nposition_m = [0.0, 0.0, 2.0]\nlook_at_m = [0.0, 0.0, 0.0]\nfocus_m = 2.0\nf_number = 2.8\n"
    (tmp_path / "a.toml").write_text("spheres = [\n" + "\n".join(lights) + "\n]\n" + camera)
    scene = load_scene(tmp_path / "a.toml")
    shot = Shot(film_mm=FILM, focus_m=2.0, f_number=2.8)
    lens = make_camera(MODEL, shot)
    field = field_of(lens, 2.0)
    plates = plates_of([field], WIDE, FILM)
    undistort = undistort_map(field, plates)
    seen = lens.compiled() if which("cc") else lens  # type: ignore[attr-defined]
    one, other = (
        render(scene, camera, width=WIDE[0], height=WIDE[1], samples=16, threads=1).rgb[..., 1]
        for camera in (seen, make_camera(f"pinhole:{GAUSS}", shot))
    )
    pictures = [read_through(one, undistort), other]
    pixel, off = FILM[0] / WIDE[0], []
    for x, y in places:
        image = np.array([x, -y]) * field.frame.reach_mm[0] / (2000 - field.frame.pupil_mm[0]) * 1000 / pixel
        found = []
        for picture in pictures:
            middle = (np.array(picture.shape[1::-1]) - 1) / 2
            left, top = np.rint(middle + image).astype(int) - 8
            part = picture[top : top + 17, left : left + 17]
            grid = np.stack(np.meshgrid(np.arange(17) + left, np.arange(17) + top))
            found.append((grid * part).sum((1, 2)) / part.sum() - middle)
        off.append(np.hypot(*(found[0] - found[1])))
    assert len(off) == 20 and max(off) < 0.12
    moved = plates.pixels(field.ideal(np.array([14.5 + 7.8j])) - (14.5 + 7.8j))
    assert moved > 3  # undistorted by pixels, not by chance


def test_light_is_that_of_the_analysis() -> None:
    camera = make_camera(str(GAUSS), Shot(film_mm=FILM, focus_m=2.0, focus_mode="paraxial"))
    field = field_of(camera, 2.0, spectrum=spectrum_of(camera, only_nm=587.6))
    found = illumination(Scene(camera.lens, 2.0), fields=9)  # type: ignore[attr-defined]
    keep = found.height_mm < 20
    assert np.abs(field.relative_light(found.height_mm[keep] + 0j) / found.relative[keep] - 1).max() < 0.01
    plates = plates_of([field], WIDE, FILM)
    light = illumination_map(field, plates)["Y"]
    assert light.shape == WIDE[::-1] and light[107:109, 191:193] == pytest.approx(1, abs=2e-3)
    assert light[0, 0] == light.min() and light[0, 0] == pytest.approx(light[-1, -1], rel=1e-5)


def test_lateral_colour_is_that_of_the_analysis() -> None:
    camera = make_camera(str(GAUSS), Shot(film_mm=FILM, focus_m=2.0, f_number=60, focus_mode="paraxial"))
    lens, lines = camera.lens, (549.1, 611.4, 464.2)  # type: ignore[attr-defined]
    by_line = [field_of(camera, 2.0, spectrum=spectrum_of(camera, only_nm=nm)) for nm in lines]
    found = colour(Scene(lens, 2.0), line_nm=lines, fields=9)
    height = found.height_mm[3:8]
    place = by_line[0].ideal(height + 0j)
    for field, lateral in zip(by_line[1:], found.lateral_um.T[1:], strict=True):
        assert np.abs(1e3 * (field.picture(place).real - height) - lateral[3:8]).max() < 0.1
    assert np.abs(found.lateral_um[3:8]).max() > 1  # there is some to be seen


@pytest.mark.whole  # takes half a minute; lenses that are round have the same maps
def test_maps_of_an_anamorphic_lens_tell_their_pixels_shape_and_both_pupils(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The lens squeezes 1.98 times: by its focal lengths of 42.475 and 21.455 mm for what is far; in a plane, by how
    far from the axis it shows a point 30 mm from it in both meridians."""
    monkeypatch.setattr(fields, "_OTHER", (9, 8))
    lens, film = ROOT / "lenses" / "cooke_anamorphic_42.toml", (20.0, 16.0)
    args = ("stmap", lens, "--width", "100", "--film", "20x16", "--focus", "1.5", "--f-number", "22", "--quiet")
    [row] = run_json(capsys, *args, "-o", tmp_path / "a")["frames"]
    assert row["pixel_aspect"] == pytest.approx(42.475 / 21.455, rel=5e-3)
    x, y = (first_order(set_lens(read_any(lens)), meridian=m).entrance_pupil_z_mm for m in ("x", "y"))
    before = row["before_film_mm"]
    assert before[0] - before[1] == pytest.approx(y - x) == pytest.approx(33.16, abs=0.01)
    camera = make_camera(lens, Shot(film_mm=film, focus_m=1.5, f_number=22.0))
    square, _ = stratified(192, (550.0, 550.0))
    sizes = []
    for k in range(2):
        point = np.zeros((3, square.shape[1]), np.float32)
        point[k], point[2] = 0.03, -1.5
        seen = camera.to_film(point, square, np.full(square.shape[1], 550.0, np.float32))
        sizes.append(abs(np.average(seen.film_mm[k], weights=seen.weight)))
    assert row["pixel_aspect_of_one_pinhole"] == pytest.approx(sizes[1] / sizes[0], rel=1e-3)
    assert row["pixel_aspect"] / row["pixel_aspect_of_one_pinhole"] > 1.02
    for kind in ("undistort", "redistort", "illumination"):
        header = OpenEXR.File(str(tmp_path / f"a.{kind}.exr"), header_only=True).parts[0].header
        assert header["pixelAspectRatio"] == pytest.approx(row["pixel_aspect"])


def test_the_command_writes_maps_of_one_size_for_all_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ("stmap", MODEL, "--height", "54", "--film", "36x20.25", "--f-number", "4", "--quiet")
    keys = ("--frames", "1:3:2", "--key", "focus=1:1,3:inf", "--lateral-colour")
    told = run_json(capsys, *args, *keys, "-o", tmp_path / "a")
    names = sorted(path.name for path in tmp_path.iterdir())
    kinds = [f"{kind}{name}" for kind in ("redistort", "undistort") for name in ("", ".blue", ".green", ".red")]
    assert names == sorted(f"a.{kind}.000{n}.exr" for kind in (*kinds, "illumination") for n in (1, 3))
    assert sorted(Path(f).name for f in told["files"]) == names
    assert [row["focus_m"] for row in told["frames"]] == [1.0, None] or told["frames"][0]["focus_m"] == 1.0
    assert told["picture_px"] == [96, 54] and told["frames"][0]["focal_mm"] != told["frames"][1]["focal_mm"]
    pictures = {name: read_exr(tmp_path / name) for name in names if "illumination" not in name}
    for name, (picture, facts) in pictures.items():
        size = told["undistorted_px"] if "undistort" in name else [96, 54]
        assert list(picture.shape) == [size[1], size[0], 3] and facts["undistorted_px"] == told["undistorted_px"]
    red, blue = pictures["a.redistort.red.0001.exr"][0], pictures["a.redistort.blue.0001.exr"][0]
    assert 0 < np.abs(red - blue).max() * 96 < 1
    assert list(read_layers(tmp_path / "a.illumination.0001.exr")) == ["Y"]
    header = OpenEXR.File(str(tmp_path / "a.undistort.0001.exr"), header_only=True).parts[0].header
    assert header["pixelAspectRatio"] == 1
    # Top left: s small, t near 1; the plate's pixel centres lie inside the undistorted picture.
    first = pictures["a.redistort.0001.exr"][0]
    assert first[0, 0, 0] < 0.1 and first[0, 0, 1] > 0.9 and first[..., 2].min() == 1


def test_bad_input_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fisheye = ROOT / "models" / "isshiki_fisheye_10.ols-64.onnx"
    good = {"camera": MODEL, "--width": "96", "--height": "54", "--film": "36x20.25", "-o": tmp_path / "a"}
    for change, words in (
        ({"--width": "0"}, "--width"),
        ({"--width": "1000000"}, "16384"),
        ({"--height": "nan"}, "--height"),
        ({"--height": "96"}, "shape of the film"),
        ({"--size": "nanx54"}, "WIDTHxHEIGHT"),
        ({"--film": "nanx20"}, "--film"),
        ({"--film": "72x40.5"}, "a film within the image circle"),
        ({"--focus": "0.01"}, "focus_m"),
        ({"--focus": "nan"}, "--focus"),
        ({"--distance": "0.05"}, "entrance pupil"),
        ({"--key": "focus=1:1"}, "--frames beside it"),
        ({"--wavelengths": "600,500"}, "three wavelengths"),
        ({"-o": tmp_path / "none" / "a"}, "a folder that exists"),
        ({"camera": "lens.zmx"}, "a lens file of any format"),
        ({"camera": fisheye}, "degrees from the axis"),
        ({"camera": "fisheye-equidistant", "--efl": "9"}, "to be laid on a plane"),
        (
            {"camera": "fisheye-equidistant", "--efl": "14.2", "--width": "9600", "--height": "5400"},
            "another --projection",
        ),
    ):
        given = good | change
        rest = [word for name, value in given.items() if name != "camera" for word in (name, value)]
        assert words in failure(capsys, "stmap", given["camera"], *rest, "--quiet"), change
    assert not list(tmp_path.iterdir())
    assert get_args(get_type_hints(command.StMap)["projection"]) == (fields.RECTILINEAR, *fields.PROJECTIONS)
