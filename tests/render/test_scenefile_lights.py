"""Scene files with lights, skies, measured surfaces and cameras in odd places: one clear error for each mistake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from render_helpers import CAMERA, diffuse, radiance, scene, world

from neurolens.base.errors import InputError
from neurolens.render import pictures
from neurolens.render.meshfile import encloses
from neurolens.render.scene import scene_from_tables

POINT = {"position_m": [0, 2, 0], "intensity": [1, 1, 1]}
SPOT = POINT | {"look_at_m": [0, 0, 0], "outer_deg": 30}
DISC = {"centre_m": [0, 0, 0], "normal": [0, 1, 0], "radius_m": 1, "material": "m"}
SPHERE = {"centre_m": [0, 0, 0.5], "radius_m": 0.6, "material": "m"}
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
CUBE_FACES = [
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
]  # fmt: skip
MESH = {"material": "m", "vertices_m": CUBE.tolist(), "faces": CUBE_FACES}
GLASS = {"kind": "glass", "n_d": 1.5}
PAINT = {"spectrum": [[380, 0.2], [780, 0.4]]}
SKY = {"sun_elevation_deg": 30}


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"points": [{"position_m": [0, 2, 0]}]}, r"points\[0\].intensity.*missing"),
        ({"points": [POINT | {"intensity": [0, 0, 0]}]}, r"points\[0\].intensity.*above 0"),
        ({"points": [POINT | {"intensity": [1, -1, 0]}]}, "intensity"),
        ({"points": [POINT | {"intensity": [1, float("inf"), 0]}]}, "intensity"),
        ({"points": [POINT | {"position_m": [0, float("inf"), 0]}]}, "position_m"),
        ({"points": [POINT | {"position_m": [0, 1e10, 0]}]}, r"position_m.*within 1e\+09 m"),
        ({"points": [POINT | {"intensity": [1e39, 1, 1]}]}, r"intensity.*0 to 1e\+18"),
        ({"points": [POINT, POINT | {"illuminant": "moon"}]}, r"points\[1\].illuminant.*D65"),
        ({"points": [POINT | {"emission": [1, 1, 1]}]}, r"points\[0\].emission.*unknown key"),
        ({"spots": [SPOT | {"look_at_m": [0, 2, 0]}]}, r"spots\[0\].look_at_m"),
        ({"spots": [SPOT | {"outer_deg": 120}]}, r"spots\[0\].outer_deg.*0.1 to 90"),
        ({"spots": [SPOT | {"inner_deg": 30}]}, r"spots\[0\].inner_deg.*below outer_deg"),
        ({"spots": [SPOT | {"outer_deg": 30, "inner_deg": 29.995}]}, r"spots\[0\].inner_deg.*0.01 below outer_deg"),
        ({"spots": [SPOT | {"illuminant": "30 K"}]}, r"spots\[0\].illuminant"),
        ({"discs": [DISC | {"normal": [0, 0, 0]}]}, r"discs\[0\].normal"),
        ({"discs": [DISC | {"radius_m": -1}]}, r"discs\[0\].radius_m"),
        ({"spheres": [SPHERE | {"radius_m": 1e-40}]}, r"spheres\[0\].radius_m.*1e-09 to 1e\+09"),
        ({"spheres": [SPHERE | {"radius_m": float("nan")}]}, r"spheres\[0\].radius_m"),
        ({"boxes": [{"min_m": [-1e30, 0, 0], "max_m": [1, 1, 1], "material": "m"}]}, r"boxes\[0\].min_m"),
        ({"environment": {"colour": [1e39, 1, 1]}}, "environment.colour"),
        ({"discs": [DISC | {"material": "n"}]}, r"discs\[0\].material.*one of: m"),
        ({"discs": [DISC | {"emission": [1, 1, 1], "illuminant": "FL2"}]}, r"discs\[0\].illuminant"),
        ({"discs": [{k: v for k, v in DISC.items() if k != "material"}]}, "material"),
        ({"sky": {}}, "sky.sun_elevation_deg.*missing"),
        ({"sky": {"sun_elevation_deg": -3}}, "sky.sun_elevation_deg.*0 .horizon. to 90"),
        ({"sky": {"sun_elevation_deg": 91}}, "sky.sun_elevation_deg"),
        ({"sky": SKY | {"turbidity": 1}}, "sky.turbidity.*2 to 10"),
        ({"sky": SKY | {"sun_azimuth_deg": float("inf")}}, "sky.sun_azimuth_deg"),
        ({"sky": SKY | {"white_kcd_per_m2": 0}}, "sky.white_kcd_per_m2"),
        ({"sky": SKY | {"sun_azimuth_deg": 1e300}}, "sky.sun_azimuth_deg.*36000"),
        ({"discs": [DISC | {"normal": [0, 1e200, 0]}]}, r"discs\[0\].normal.*a direction"),
        ({"materials": {"m": GLASS | {"transmittance": [1, 1, 1], "transmittance_depth_m": 1e-300}}}, "a length from"),
        ({"environment": {"file": "a.png", "rotate_y_deg": 1e300}}, "environment.rotate_y_deg"),
        ({"environment": {"file": "a.png", "scale": 1e300}}, "environment.scale"),
        ({"sky": SKY, "environment": {"colour": [1, 1, 1]}}, "either sky or environment"),
        ({"environment": {}}, "environment.*one of: colour"),
        ({"environment": {"file": "a.png", "colour": [1, 1, 1]}}, "environment.*several"),
        ({"environment": {"colour": [1, 1, 1], "scale": 2}}, "environment.scale.*left out"),
        ({"environment": {"colour": [1, 1, 1], "rotate_y_deg": 2}}, "environment.rotate_y_deg.*left out"),
        ({"environment": {"file": "none.png"}}, "environment.file.*exists"),
        ({"environment": {"file": "none.exr"}}, "environment.file.*exists"),
        ({"environment": {"colour": [1, 1, 1], "illuminant": "sun"}}, "environment.illuminant"),
        ({"materials": {"m": {"kind": "diffuse", "reflectance": "paint"}}}, "materials.m.reflectance.*none is defined"),
        ({"reflectances": {"p": {}}}, "reflectances.p.spectrum.*either"),
        ({"reflectances": {"p": {"spectrum": [[400, 0.5], [700, 1.5]]}}}, r"reflectances.p.spectrum\[1\].*0 to 1"),
        ({"reflectances": {"p": {"spectrum": [[700, 0.5], [400, 0.5]]}}}, "increase"),
        ({"reflectances": {"p": {"spectrum": [[500, 0.5], [700, 0.5]]}}}, "reflectances.p.*500 to 700"),
        ({"reflectances": {"p": {"file": "none.csv"}}}, "reflectances.p.file"),
        ({"materials": {"m": GLASS | {"transmittance": [1, 1, 1]}}}, "transmittance_depth_m.*missing"),
        ({"materials": {"m": GLASS | {"transmittance_depth_m": 1}}}, "transmittance.*missing"),
        ({"materials": {"m": GLASS | {"transmittance": [1, 0, 1], "transmittance_depth_m": 1}}}, "transmittance"),
        ({"materials": {"m": GLASS | {"transmittance": [1, 1, 1], "transmittance_depth_m": 0}}}, "depth_m"),
        ({"materials": {"m": diffuse(1, 1, 1) | {"transmittance": [1, 1, 1]}}}, "transmittance.*left out"),
        ({"meshes": [MESH | {"scale": 1e300}]}, r"meshes\[0\].vertices_m.*within 1e.09 m"),
        ({"meshes": [MESH | {"material": "tiles"}]}, "image texture without size_m"),
        ({"meshes": [MESH | {"material": "photo"}]}, "texture coordinates"),
        ({"spheres": [SPHERE]}, r"camera.position_m.*outside spheres\[0\]"),
        ({"boxes": [{"min_m": [-1, -1, 0], "max_m": [1, 1, 2], "material": "m"}]}, r"camera.position_m.*boxes\[0\]"),
        ({"meshes": [MESH | {"translate_m": [9, 0, 0]}, MESH]}, r"camera.position_m.*outside meshes\[1\]"),
    ],
)
def test_each_mistake_is_named(tables: dict[str, Any], message: str) -> None:
    textures = {
        "tiles": {"kind": "checker", "colours": [[1, 1, 1], [0, 0, 0]], "cell_m": 1},
        "photo": {"kind": "image", "file": "none.png"},
    }
    materials = {"m": diffuse(0.5, 0.5, 0.5)}
    if "meshes" in tables:
        materials |= {name: {"kind": "diffuse", "texture": name} for name in textures}
    with pytest.raises(InputError, match=message) as caught:
        scene(**({"materials": materials, "textures": textures if "meshes" in tables else {}} | tables))
    assert str(caught.value).startswith("test.toml: ") and ", expected " in str(caught.value)


def test_only_closed_meshes_that_face_outwards_are_solid() -> None:
    materials = {"m": diffuse(0.5, 0.5, 0.5)}
    inwards = [face[::-1] for face in CUBE_FACES]
    for faces in (inwards, CUBE_FACES[:-1]):  # a room, and a box without a lid
        made = scene(materials=materials, meshes=[MESH | {"faces": faces}])
        assert not encloses(made.triangles[0], np.array(CAMERA["position_m"], float))
    # A corner of its own for each triangle changes nothing.
    apart = CUBE[np.array(CUBE_FACES).ravel()]
    split = MESH | {"vertices_m": apart.tolist(), "faces": np.arange(36).reshape(-1, 3).tolist()}
    with pytest.raises(InputError, match="outside"):
        scene(materials=materials, meshes=[split])


@pytest.mark.parametrize(
    ("shape", "value", "message"),
    [
        ((4, 4), 1.0, "2 : 1"),
        ((4, 8), -1.0, "0 or more"),
        ((4, 8), np.nan, "0 or more"),
        ((4, 8), np.inf, "0 or more"),
        ((4, 8), 0.6e18, r"times scale are at most 1e\+18"),
        ((4, 8), 0.0, "black"),
    ],
)
def test_bad_environments_are_named(shape: tuple[int, int], value: float, message: str, tmp_path: Path) -> None:
    pixels = np.full((*shape, 3), value, np.float32)
    _write_exr(tmp_path / "a.exr", pixels)
    with pytest.raises(InputError, match=f"environment.file.*{message}"):
        scene_from_tables({"camera": CAMERA, "environment": {"file": "a.exr", "scale": 2.0}}, tmp_path / "s.toml")


def test_grey_pictures_of_16_bits_are_as_bright_as_those_of_8(tmp_path: Path) -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.fromarray(grey).save(tmp_path / "8.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "16.png")
    Image.fromarray(grey.astype(np.float32)).save(tmp_path / "32.tiff")
    few, many = (pictures.read_picture(tmp_path, "file", tmp_path / name) for name in ("8.png", "16.png"))
    assert few.shape == (16, 16, 3) and few.max() == 1 and np.allclose(few, many, atol=1e-6)
    with pytest.raises(InputError, match="8 or 16 bits"):
        pictures.read_picture(tmp_path, "file", tmp_path / "32.tiff")


def test_broken_and_large_environments_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(name: str, message: str) -> None:
        with pytest.raises(InputError, match=f"environment.file.*{message}"):
            scene_from_tables({"camera": CAMERA, "environment": {"file": name}}, tmp_path / "s.toml")

    (tmp_path / "text.exr").write_text("no picture")
    (tmp_path / "text.png").write_text("no picture")
    refused("text.exr", "OpenEXR")
    refused("text.png", "readable")
    _write_exr(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32))
    whole = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    refused("cut.exr", "OpenEXR|black|finite")
    Image.new("RGB", (8, 4), (9, 9, 9)).save(tmp_path / "a.png")
    monkeypatch.setattr(pictures, "LARGEST_ENVIRONMENT", 4)
    refused("a.exr", "at most 4 pixels")
    refused("a.png", "at most 4 pixels")


def test_an_exr_environment_is_seen_as_it_is(tmp_path: Path) -> None:
    pixels = np.zeros((4, 8, 3), np.float32)
    pixels[1, 6] = 7.0  # above the horizon, towards +x
    _write_exr(tmp_path / "a.exr", pixels)
    made = world(environment={"file": str(tmp_path / "a.exr"), "scale": 2})
    assert np.allclose(radiance(made, [0, 0, 0], [1, 0.4, 0.4], samples=16), 14)
    assert not radiance(made, [0, 0, 0], [1, -0.4, 0.4], samples=16).any()


def _write_exr(path: Path, pixels: np.ndarray) -> None:
    channels = {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate("RGB")}
    OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION}, channels).write(str(path))
