"""Layers behind the things that a pinhole sees: what follows on a ray, and such plates beside a path-traced lens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neurolens.cameras.build import make_camera
from neurolens.cameras.field import frame_of
from neurolens.cli import main
from neurolens.graph.compiler import has_compiler
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.defocus.picture import defocus, spread_over, take_highlights
from neurolens.pictures.defocus.plate import DepthSettings, Layer, Plate, PlatePinhole, read_plate
from neurolens.pictures.render.pictures import read_channels, read_exr
from tests.command_line import failure
from tests.pictures.render.render_helpers import world

FILM = "36x20.25"
# Five posts at 0.7 m before a far wall, and a grid of lamps on it: as many are behind posts as beside them. All shine
# by themselves.
POSTS = """[camera]
position_m = [0, 0, 0]
look_at_m = [0, 0, -1]
focus_m = 1
max_depth = 1
[environment]
colour = [0, 0, 0]
[[quads]]
corner_m = [-9, -6, -8.1]
edge_u_m = [18, 0, 0]
edge_v_m = [0, 12, 0]
emission = [0.1, 0.2, 0.4]
""" + "".join(
    f"[[quads]]\ncorner_m = [{x - 0.0255}, -0.5, -0.7]\nedge_u_m = [0.051, 0, 0]\nedge_v_m = [0, 1, 0]\n"
    "emission = [0.3, 0.05, 0.05]\n"
    for x in np.linspace(-0.204, 0.204, 5)
) + "".join(
    f"[[spheres]]\ncentre_m = [{x:.4f}, {y:.4f}, -8]\nradius_m = 0.03\nemission = [30, 20, 10]\n"
    for y in np.linspace(-1.2, 1.2, 9)
    for x in np.linspace(-3.2, 3.2, 37)
)  # fmt: skip


def render(scene: Path, out: Path, *words: object) -> Path:
    assert main(["render", *map(str, (scene, *words, "-o", out, "--threads", 1, "--quiet"))]) == 0
    return out


@pytest.fixture
def posts(tmp_path: Path) -> Path:
    (path := tmp_path / "posts.toml").write_text(POSTS, encoding="utf-8")
    return path


def follow(things: int, x: float = 0.0, **tables: Any) -> tuple[float, bool]:
    """The way of a ray from (x, 0, 1) along -z to just behind the first things, and whether anything follows."""
    start = np.array([[x], [0.0], [1.0]], np.float32)
    way, follows = world(**tables).behind(start, np.array([[0.0], [0.0], [-1.0]], np.float32), things)
    return float(way[0]), bool(follows[0])


def ball(z: float, radius: float = 0.25) -> dict[str, Any]:
    return {"centre_m": [0, 0, z], "radius_m": radius, "material": "white"}


WHITE = {"white": {"kind": "diffuse", "reflectance": [1, 1, 1]}}


def test_a_ball_is_one_thing_and_what_stands_in_it_is_none() -> None:
    """Two balls that overlap are one thing, a third farther on the next; then comes the sky."""
    spheres = [ball(0.0), ball(-0.3), ball(-2.0)]
    assert follow(1, spheres=spheres, materials=WHITE) == (pytest.approx(1.55, abs=1e-3), True)
    assert follow(2, spheres=spheres, materials=WHITE) == (pytest.approx(3.25, abs=1e-3), True)
    assert not follow(3, spheres=spheres, materials=WHITE)[1]
    assert not follow(1, x=3.0, spheres=spheres, materials=WHITE)[1]  # it meets nothing


def test_nothing_follows_what_has_no_edge() -> None:
    """Behind the wall of a room, or below an infinite floor, no lens sees; behind a screen it does."""
    room = {"min_m": [-1, -1, -3], "max_m": [1, 1, 2], "material": "white"}
    screen = {"corner_m": [-0.5, -0.5, 0], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 1, 0], "material": "white"}
    plane = {"point_m": [0, 0, -2], "normal": [0, 0, 1], "material": "white"}
    for tables in ({"rooms": [room]}, {"planes": [plane]}):
        assert follow(1, quads=[screen], materials=WHITE, **tables) == (pytest.approx(1.0, abs=1e-3), True)
        assert not follow(2, quads=[screen], materials=WHITE, **tables)[1]
    # The wall is met before the ball outside of the room is.
    assert not follow(1, rooms=[room], spheres=[ball(-5)], materials=WHITE)[1]


def test_a_box_on_a_wall_hides_the_wall() -> None:
    box = {"min_m": [-0.5, -0.5, -2], "max_m": [0.5, 0.5, -1], "material": "white"}
    plane = {"point_m": [0, 0, -1.5], "normal": [0, 0, 1], "material": "white"}
    for planes in ([], [plane]):
        assert follow(1, boxes=[box], planes=planes, materials=WHITE)[1]


def test_layers_behind_hold_radiance_cover_and_depth(tmp_path: Path, posts: Path) -> None:
    """Behind each post the wall or a lamp, at their own depth from the film; behind the wall the black sky."""
    planes, metadata = read_channels(render(posts, tmp_path / "a.exr", *PLATE, "--behind", 2))
    at = {name: float(plane[74:77, 139:150].mean()) for name, plane in planes.items()}  # of a post, between lamps
    assert (at["Z"], at["behind1.Z"]) == (pytest.approx(0.7, abs=1e-3), pytest.approx(8.1, abs=1e-3))
    assert [at[f"behind1.{c}"] for c in "RGB"] == pytest.approx([0.1, 0.2, 0.4], rel=0.02) and at["behind1.A"] == 1
    assert at["behind2.A"] == 1 and np.isinf(at["behind2.Z"]) and at["behind2.G"] == 0
    assert {"behind1", "behind2"} <= metadata["layers"].keys()


PLATE = "--camera", "pinhole", "--film", "54x30.375", "--width", 288, "--samples", 16


@pytest.mark.skipif(not has_compiler(), reason="defocus takes a C compiler")
def test_a_plate_with_layers_is_nearer_to_the_path_traced_lens(tmp_path: Path, posts: Path) -> None:
    """Posts before a wall of lamps: nothing is made up with layers, and less of the light is missing."""
    camera = make_camera("thin", Shot((36.0, 20.25), 1.0, f_number=1.4, focal_length_mm=50.0))
    lens = "--camera", "thin", "--f-number", 1.4, "--focal-length", 50, "--film", FILM, "--width", 192
    truth, _ = read_exr(render(posts, tmp_path / "lens.exr", *lens, "--samples", 64))
    path = render(posts, tmp_path / "plate.exr", *PLATE, "--focal-length", 50, "--behind", 1)
    error, light, lost, filled = [], [], [], []
    for layers in (1, 2):
        plate = read_plate(path, (36.0, 20.25), frame_of(camera), DepthSettings())
        assert len(plate.layers) == 2
        found = defocus(Plate(plate.layers[:layers], plate.pinhole, plate.size), camera)
        error.append(float(np.sqrt(np.square(_coarse(found.rgb) - _coarse(truth)).mean()) / truth.mean()))
        light.append(float(found.rgb.sum() / truth.sum()))
        lost.append(found.lost)
        filled.append(found.filled)
    assert error[1] < 0.9 * error[0] and abs(1 - light[1]) < 0.75 * abs(1 - light[0])
    assert lost[1] < lost[0] / 2 and filled[0] > 0.03 and filled[1] < filled[0] / 20


def _coarse(rgb: np.ndarray) -> np.ndarray:
    """Means of squares of 4 pixels, in which a picture of few samples has little noise."""
    return rgb[: rgb.shape[0] // 4 * 4].reshape(rgb.shape[0] // 4, 4, -1, 4, 3).mean(axis=(1, 3))


def test_even_light_at_the_border_of_a_layer_is_no_highlight() -> None:
    """A grey strip, beside which the layer behind has nothing; a lamp on the strip is one."""
    rgb, w = np.zeros((54, 96, 3), np.float32), np.full((54, 96), -1, np.float32)
    rgb[:, 40:56], w[:, 40:56] = 0.2, 0.1
    rgb[27, 48] = 50.0
    camera = make_camera("thin", Shot((36.0, 20.25), 0.7, f_number=1.4, focal_length_mm=50.0))
    pinhole = PlatePinhole((133.0, 133.0), (48.0, 27.0), 50.0)
    plate = Plate([Layer(rgb, w)], pinhole, (96, 54))
    found = take_highlights(plate, 0, spread_over(camera, plate))
    assert found.place_px.tolist() == [[48.5, 27.5]]


@pytest.mark.parametrize("words", [("thin",), ("pinhole", "--channels", "beauty")])
def test_layers_behind_are_of_a_pinhole_with_all_channels(
    words: tuple[str, ...], tmp_path: Path, posts: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = failure(capsys, "render", posts, "--camera", *words, "--behind", 1, "-o", tmp_path / "no.exr")
    assert "--behind 1" in said and "expected a pinhole, and all channels" in said


def test_tiles_have_the_layers_of_the_whole_picture(tmp_path: Path, posts: Path) -> None:
    words = "--camera", "pinhole", "--film", FILM, "--width", 32, "--samples", 4, "--behind", 1
    whole = read_channels(render(posts, tmp_path / "whole.exr", *words))[0]
    for k in (1, 2):
        render(posts, tmp_path / "a.exr", *words, "--tile", f"{k}/2")
    tiles = [str(tmp_path / f"a.tile-{k}-of-2.exr") for k in (1, 2)]
    assert main(["render", "--merge", *tiles, "-o", str(tmp_path / "merged.exr"), "--quiet"]) == 0
    merged = read_channels(tmp_path / "merged.exr")[0]
    assert merged.keys() == whole.keys()
    for name, plane in whole.items():
        np.testing.assert_array_equal(merged[name], plane, err_msg=name)
