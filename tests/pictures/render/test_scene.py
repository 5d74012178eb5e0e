"""Scene files: the shipped ones, pictures and solids in them, and one clear error for each mistake."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from render_helpers import CAMERA, WHITE, diffuse, radiance, scene, world

from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.optics.lens.apertures import Aperture
from neurolens.pictures.render import images
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import encloses, load_scene, scene_from_tables

SCENES = Path(__file__).parents[3] / "experiments" / "scenes"
TEXTURES = {
    "tiles": {"kind": "checker", "colours": [[1, 1, 1], [0, 0, 0]], "cell_m": 1},
    "photo": {"kind": "image", "file": "none.png"},
}
GREY = diffuse(0.5, 0.5, 0.5)
SPHERE = {"centre_m": [0, 0, -3], "radius_m": 1, "material": "m"}
QUAD = {"corner_m": [0, 0, 0], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 1, 0], "material": "m"}
DISC = {"centre_m": [0, 0, 0], "normal": [0, 1, 0], "radius_m": 1, "material": "m"}
BOX = {"min_m": [-1, -1, 0], "max_m": [1, 1, 2], "material": "m"}
POINT = {"position_m": [0, 2, 0], "intensity": [1, 1, 1]}
SPOT = POINT | {"look_at_m": [0, 0, 0], "outer_deg": 30}
GLASS = {"kind": "glass", "n_d": 1.5}
SKY = {"sun_elevation_deg": 30}
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
CUBE_FACES = [
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
]  # fmt: skip
MESH = {"material": "m", "vertices_m": CUBE.tolist(), "faces": CUBE_FACES}
TRIANGLE = {"material": "m", "vertices_m": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]]}


@pytest.mark.parametrize("name", ["cornell", "garden", "grid", "lamps", "lights", "room", "studio"])
def test_shipped_scenes_render(name: str) -> None:
    loaded = load_scene(SCENES / f"{name}.toml")
    settings = loaded.settings.camera
    film = settings.film_mm
    camera = ThinLens(50.0, settings.f_number or 2.0, settings.focus_m, film)
    height = round(64 * film[1] / film[0])
    picture = render(loaded, camera, width=64, height=height, samples=4, threads=1).rgb
    assert np.all(np.isfinite(picture)) and 0.02 < picture.mean() < 1


@pytest.mark.parametrize(
    ("kind", "table", "message"),
    [
        ("camera", {"position": [0, 0, 0]}, "camera.position"),
        ("camera", {"look_at_m": [0, 0, 1]}, "look_at_m"),
        ("camera", {"samples": 0}, "samples"),
        ("camera", {"blade_curvature": 0.5}, "camera, aperture blades"),
        ("spheres", [SPHERE, SPHERE | {"colour": 1}], r"spheres\[1\].colour"),
        ("spheres", [SPHERE | {"material": "n"}], r"spheres\[0\].material.*one of: m, tiles"),
        ("spheres", [SPHERE | {"material": "tiles"}], "curved"),
        ("spheres", [SPHERE | {"radius_m": 0}], r"spheres\[0\].radius_m.*1e-09 to 1e\+09"),
        ("spheres", [SPHERE | {"centre_m": [0, 0, 0.5]}], r"camera.position_m.*outside spheres\[0\]"),
        ("quads", [QUAD | {"edge_v_m": [1, 1, 0]}], "edge_v_m.*perpendicular"),
        ("discs", [DISC | {"normal": [0, 0, 0]}], r"discs\[0\].normal"),
        ("discs", [DISC | {"emission": [1, 1, 1], "illuminant": "FL2"}], r"discs\[0\].illuminant"),
        ("boxes", [BOX | {"max_m": [1, 0, 1], "min_m": [0, 0, 0]}], "max_m"),
        ("boxes", [BOX], r"camera.position_m.*boxes\[0\]"),
        ("meshes", [TRIANGLE | {"faces": [[0, 1, 3]]}], r"faces\[0\].*vertices from 0 to 2"),
        ("meshes", [TRIANGLE | {"faces": [[0, 1, 1]]}], "degenerate"),
        ("meshes", [TRIANGLE | {"faces": []}], "at least one triangle"),
        ("meshes", [TRIANGLE | {"scale": 1e300}], r"meshes\[0\].vertices_m.*within 1e.09 m"),
        ("meshes", [{"material": "m"}], "either file"),
        ("meshes", [TRIANGLE | {"material": "tiles"}], "image texture without size_m"),
        ("meshes", [TRIANGLE | {"material": "photo"}], "texture coordinates"),
        ("meshes", [MESH | {"translate_m": [9, 0, 0]}, MESH], r"camera.position_m.*outside meshes\[1\]"),
        ("materials", {"m": GREY | {"reflectance": "paint"}}, "materials.m.reflectance.*none is defined"),
        ("materials", {"m": GREY | {"texture": "tiles"}}, "either reflectance or texture"),
        ("materials", {"m": GREY | {"transmittance": [1, 1, 1]}}, "transmittance.*left out"),
        ("materials", {"m": GLASS | {"n_d": 0.9}}, "n_d"),
        ("materials", {"m": GLASS | {"roughness": 0.1}}, "roughness.*left out"),
        ("materials", {"m": GLASS | {"transmittance": [1, 1, 1]}}, "transmittance_depth_m.*missing"),
        ("materials", {"m": GLASS | {"transmittance": [1, 0, 1], "transmittance_depth_m": 1}}, "transmittance"),
        ("textures", {"tiles": TEXTURES["tiles"] | {"kind": "grid", "line_m": 2}}, "line_m"),
        ("points", [POINT | {"intensity": [0, 0, 0]}], r"points\[0\].intensity.*above 0"),
        ("points", [POINT, POINT | {"illuminant": "moon"}], r"points\[1\].illuminant.*D65"),
        ("spots", [SPOT | {"inner_deg": 29.995}], r"spots\[0\].inner_deg.*0.01 below outer_deg"),
        ("sky", {"sun_elevation_deg": 91}, "sky.sun_elevation_deg.*0 .horizon. to 90"),
        ("sky", SKY | {"turbidity": 1}, "sky.turbidity.*2 to 10"),
        ("sky", SKY | {"sun_azimuth_deg": 1e300}, "sky.sun_azimuth_deg.*36000"),
        ("sky", SKY | {"white_kcd_per_m2": 0}, "sky.white_kcd_per_m2"),
        ("environment", {}, "environment.*one of: colour"),
        ("environment", WHITE | {"scale": 2}, "environment.scale.*left out"),
        ("environment", {"file": "none.png"}, "environment.file.*exists"),
        ("environment", {"file": "none.exr"}, "environment.file.*exists"),
        ("environment", WHITE | {"illuminant": "F99"}, r"environment\.illuminant: got 'F99', expected one of: D65,"),
        ("environment", WHITE | {"illuminant": "100 K"}, r"environment\.illuminant: got '100 K'.*500 K to 100000 K"),
        ("film", {"white_balance": "D60"}, r"film\.white_balance: got 'D60'.*did you mean 'D65'"),
        ("illuminants", {"lamp": {"spectrum": [[380, 1], [780, 1]], "file": "a.csv"}}, "either spectrum or file"),
        ("illuminants", {"A": {"spectrum": [[380, 1], [780, 1]]}}, r"illuminants\.A: got 'A', expected a name"),
        ("reflectances", {"p": {}}, "reflectances.p.spectrum.*either"),
        ("reflectances", {"p": {"spectrum": [[400, 0.5], [700, 1.5]]}}, r"reflectances.p.spectrum\[1\].*0 to 1"),
    ],
)
def test_each_mistake_is_named(kind: str, table: Any, message: str) -> None:
    tables = {kind: table} if kind != "camera" else {}
    used = any(name in str((table, message)) for name in ("tiles", "photo"))
    materials = {"m": GREY} | ({name: {"kind": "diffuse", "texture": name} for name in TEXTURES} if used else {})
    with pytest.raises(InputError, match=message) as caught:
        scene(
            table if kind == "camera" else None,
            **({"materials": materials, "textures": TEXTURES if used else {}} | tables),
        )
    assert str(caught.value).startswith("test.toml: ") and ", expected " in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "grey", "colour"),
    [
        ("materials", {"m": {"kind": "glossy", "specular": 0.04, "roughness": 0.3, "reflectance": 0}},
         {"m": {"kind": "glossy", "specular": [0.04] * 3, "roughness": 0.3, "reflectance": [0] * 3}}),
        ("materials", {"m": GLASS | {"transmittance": 0.5, "transmittance_depth_m": 1.0}},
         {"m": GLASS | {"transmittance": [0.5] * 3, "transmittance_depth_m": 1.0}}),
        ("discs", [DISC | {"emission": 2}], [DISC | {"emission": [2.0] * 3}]),
        ("environment", {"colour": 0.5}, {"colour": [0.5] * 3}),
    ],
)  # fmt: skip
def test_one_number_is_a_grey(kind: str, grey: Any, colour: Any) -> None:
    """A colour of one number is three equal ones, held to the same bounds; a place of one number stays a mistake."""
    materials = {"materials": {"m": GREY}}
    one, three = (getattr(scene(**(materials | {kind: table})).settings, kind) for table in (grey, colour))
    assert one == three
    for name, table in (("discs", [DISC | {"emission": -1}]), ("discs", [DISC | {"centre_m": 1}])):
        with pytest.raises(InputError, match="emission|centre_m"):
            scene(**(materials | {name: table}))


def test_a_scene_without_a_focus_says_that_it_is_missing(tmp_path: Path) -> None:
    (path := tmp_path / "a.toml").write_text("[camera]\nposition_m = [0, 0, 0]\nlook_at_m = [0, 0, -1]\n")
    with pytest.raises(InputError, match=r"camera\.focus_m: got \(missing\), expected a number"):
        load_scene(path)


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
    made = scene_from_tables({"camera": CAMERA | {"aperture_mask": "stop.png"}}, tmp_path / "a.toml")
    assert made.aperture == Aperture(mask=np.array([[1, 0], [1, 1]]))


def test_a_scene_sets_its_shot_with_units_and_a_camera_refuses_what_it_does_not_take() -> None:
    """The table [camera] has every setting of a shot, in the bounds and units of the options."""
    asked = {"focus_m": "6ft", "f_number": "f/4", "film_offset_mm": "0.1cm", "focus_mode": "paraxial", "zoom": "72mm"}
    shot = scene(asked).settings.camera.shot()
    assert shot.focus_m == pytest.approx(1.8288) and (shot.f_number, shot.film_offset_mm) == (4, 1)
    assert (shot.focus_mode, shot.zoom, shot.clamp_f_number) == ("paraxial", "72mm", True)
    with pytest.raises(InputError, match="camera pinhole: .*zoom: got '72mm', expected left out: .*focal_length_mm"):
        make_camera("pinhole", replace(shot, film_offset_mm=0.0))
    for key, value, said in (("cover_glass_mm", 200, "mm from 0 to 100"), ("clamp_f_number", True, "unknown key")):
        with pytest.raises(InputError, match=f"camera.{key}: .*{said}"):
            scene({key: value})


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
        ((4, 8), -1.0, "black"),
        ((4, 8), np.nan, "black"),
        ((4, 8), np.inf, "black"),
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
    few, many = (images.read_picture(tmp_path, "file", tmp_path / name) for name in ("8.png", "16.png"))
    assert few.shape == (16, 16, 3) and few.max() == 1 and np.allclose(few, many, atol=1e-6)
    with pytest.raises(InputError, match="8 or 16 bits"):
        images.read_picture(tmp_path, "file", tmp_path / "32.tiff")


def test_broken_and_large_environments_are_named(tmp_path: Path) -> None:
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
    refused("cut.exr", "OpenEXR|black")
    _write_exr(tmp_path / "a.exr", np.ones((1, 8193, 3), np.float32))
    Image.new("RGB", (8193, 1), (9, 9, 9)).save(tmp_path / "a.png")
    refused("a.exr", "at most 8192 pixels")
    refused("a.png", "at most 8192 pixels")


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
