"""Scene files: the shipped ones, and one clear error for each mistake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from render_helpers import WHITE, diffuse, scene

from neurolens.base.errors import InputError
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.thin import ThinLens
from neurolens.optics.apertures import Aperture
from neurolens.render.renderer import render
from neurolens.render.scenefile import load_scene

SCENES = Path(__file__).parent.parent.parent / "experiments" / "scenes"
MATERIALS = {
    "m": diffuse(0.5, 0.5, 0.5),
    "tiles": {"kind": "diffuse", "texture": "tiles"},
    "photo": {"kind": "diffuse", "texture": "photo"},
}
TILES = {"tiles": {"kind": "checker", "colours": [[1, 1, 1], [0, 0, 0]], "cell_m": 1}}
SPHERE = {"centre_m": [0, 0, 0], "radius_m": 1, "material": "m"}
QUAD = {"corner_m": [0, 0, 0], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 1, 0], "material": "m"}
MESH = {"material": "m", "vertices_m": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]]}


@pytest.mark.parametrize("name", ["cornell", "garden", "grid", "lamps", "lights", "room", "studio"])
def test_shipped_scenes_render(name: str) -> None:
    loaded = load_scene(SCENES / f"{name}.toml")
    settings = loaded.settings.camera
    film = (settings.film_width_mm, settings.film_height_mm)
    camera = ThinLens(50.0, settings.f_number or 2.0, settings.focus_m, film)
    height = round(64 * film[1] / film[0])
    picture = render(loaded, camera, width=64, height=height, samples=4, threads=1).rgb
    assert np.all(np.isfinite(picture)) and 0.02 < picture.mean() < 1


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"camera": {"position": [0, 0, 0]}}, "position"),
        ({"camera": {"up": [0, 0, 2]}}, "up"),
        ({"camera": {"look_at_m": [0, 0, 1]}}, "look_at_m"),
        ({"camera": {"focus_m": -1}}, "focus_m"),
        ({"camera": {"focus_m": "two"}}, "focus_m"),
        ({"camera": {"wavelengths_nm": [700, 400]}}, "wavelengths_nm"),
        ({"camera": {"samples": 0}}, "samples"),
        ({"camera": {"width": 640.5}}, "width"),
        ({"camera": {"position_m": [0, float("inf"), 0]}}, "position_m"),
        ({"sphere": [SPHERE]}, "sphere"),
        ({"spheres": [SPHERE | {"radius_m": 0}]}, r"spheres\[0\].radius_m"),
        ({"spheres": [SPHERE, SPHERE | {"colour": 1}]}, r"spheres\[1\].colour"),
        ({"spheres": [SPHERE | {"material": "n"}]}, r"spheres\[0\].material.*one of: m, tiles"),
        ({"spheres": [SPHERE | {"material": "tiles"}]}, "curved"),
        ({"spheres": [{"centre_m": [0, 0, 0], "radius_m": 1}]}, "material"),
        ({"spheres": [SPHERE | {"emission": [1, -1, 0]}]}, "emission"),
        ({"quads": [QUAD | {"edge_v_m": [1, 1, 0]}]}, "edge_v_m.*perpendicular"),
        ({"quads": [QUAD | {"edge_v_m": [0, 0, 0]}]}, "edge_v_m"),
        ({"quads": [QUAD | {"corner_m": [0, 0]}]}, "corner_m"),
        ({"quads": [QUAD | {"material": "photo"}]}, "none.png"),
        ({"planes": [{"point_m": [0, 0, 0], "normal": [0, 0, 0], "material": "m"}]}, "normal"),
        ({"boxes": [{"min_m": [0, 0, 0], "max_m": [1, 0, 1], "material": "m"}]}, "max_m"),
        ({"rooms": [{"min_m": [0, 0, 0], "max_m": [1, 1, 1], "material": "m", "floor": "x"}]}, r"rooms\[0\].floor"),
        ({"meshes": [MESH | {"faces": [[0, 1, 3]]}]}, r"faces\[0\].*vertices from 0 to 2"),
        ({"meshes": [MESH | {"faces": [[0, 1, 1]]}]}, "degenerate"),
        ({"meshes": [MESH | {"vertices_m": [[0, 0, 0], [1, 0, 0], [2, 0, 0]]}]}, "degenerate"),
        ({"meshes": [MESH | {"faces": []}]}, "at least one triangle"),
        ({"meshes": [{"material": "m", "file": "none.obj"}]}, "none.obj"),
        ({"meshes": [{"material": "m"}]}, "either file"),
        ({"materials": {"m": {"kind": "wood"}}}, "kind"),
        ({"materials": {"m": diffuse(0.5, 1.5, 0.5)}}, "reflectance"),
        ({"materials": {"m": {"kind": "glass", "n_d": 0.9}}}, "n_d"),
        ({"materials": {"m": {"kind": "glass", "n_d": 1.5, "roughness": 0.1}}}, "roughness.*left out"),
        ({"materials": {"m": {"kind": "mirror"}}}, "reflectance.*missing"),
        ({"materials": {"m": diffuse(0.5, 0.5, 0.5) | {"texture": "tiles"}}}, "either reflectance or texture"),
        ({"materials": {"m": {"kind": "diffuse", "texture": "no"}}}, "texture.*tiles"),
        ({"textures": {"tiles": {"kind": "checker", "cell_m": 1}}}, "colours.*missing"),
        ({"textures": {"tiles": TILES["tiles"] | {"kind": "grid", "line_m": 2}}}, "line_m"),
        ({"environment": {"zenith": [1, 1, 1]}}, "environment"),
    ],
)
def test_each_mistake_is_named(change: dict[str, Any], field: str, tmp_path: Path) -> None:
    textures = TILES | {"photo": {"kind": "image", "file": "none.png"}} if "none.png" in field else TILES
    materials = {k: v for k, v in MATERIALS.items() if k != "photo" or "none.png" in field}
    tables = {"materials": materials, "textures": textures} | {k: v for k, v in change.items() if k != "camera"}
    with pytest.raises(InputError, match=field) as caught:
        scene(change.get("camera"), **tables)
    assert str(caught.value).startswith(("test.toml: ", "none.obj: ")) and ", expected " in str(caught.value)


def test_empty_and_missing_files(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    for content in ("", "camera = 3", "[camera", "[camera]\nfocus_m = 2\n"):
        path.write_text(content)
        with pytest.raises(InputError, match=r"a\.toml"):
            load_scene(path)
    with pytest.raises(InputError, match="missing"):
        load_scene(tmp_path / "none.toml")


def test_textures_lie_where_they_should(tmp_path: Path) -> None:
    # Left half white, right half black, upper left corner red: shown upright on a wall 2 m wide, 1 m high.
    picture = np.zeros((10, 20, 3), np.uint8)
    picture[:, :10] = 255
    picture[:3, :4] = (255, 0, 0)
    Image.fromarray(picture).save(tmp_path / "p.png")
    tables = {
        "textures": {"p": {"kind": "image", "file": str(tmp_path / "p.png")}},
        "materials": {"m": {"kind": "diffuse", "texture": "p"}},
        "quads": [{"corner_m": [-1, -0.5, -9], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 1, 0], "material": "m"}],
    }
    made = scene({"look_at_m": [0, 0, 0]}, environment=WHITE, **tables)
    shown = render(made, Pinhole(200.0, (40.0, 20.0)), width=20, height=10, samples=64, max_depth=1).rgb
    assert shown[5, 2:9].mean() > 0.9 and shown[5, 11:].mean() < 0.05
    assert shown[0:2, 0:3, 0].mean() > 0.9 and shown[0:2, 0:3, 1:].mean() < 0.1


def test_the_stop_s_shape_by_blades_or_by_a_picture_beside_the_scene(tmp_path: Path) -> None:
    assert scene({}).aperture is None
    assert scene({"blades": 7, "blade_rotation_deg": 10, "blade_curvature": 0.5}).aperture == Aperture(7, 10.0, 0.5)
    Image.fromarray(np.array([[255, 0], [255, 255]], np.uint8)).save(tmp_path / "stop.png")
    path = tmp_path / "a.toml"
    camera = 'position_m = [0, 0, 0]\nlook_at_m = [0, 0, -1]\nfocus_m = 2.0\naperture_mask = "stop.png"'
    path.write_text(f"[camera]\n{camera}\n[environment]\ncolour = [1, 1, 1]\n")
    assert load_scene(path).aperture == Aperture(mask=np.array([[1, 0], [1, 1]]))
    for change, expected in (
        ({"blades": 2}, "blades"),
        ({"blade_curvature": 0.5}, "blades"),
        ({"blades": 5, "aperture_mask": "stop.png"}, "not both"),
        ({"aperture_mask": "none.png"}, "missing"),
    ):
        with pytest.raises(InputError, match=expected) as caught:
            scene(change)
        assert str(caught.value).startswith("test.toml: camera, ")
