"""Lenses in Cycles against neurolens's exact ones: places, colours, discs, focus, stop and the white card."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_blender import FOLDER, bpy, first_scene, pixels_of, surface, surroundings, with_shots
from measure import measures

pytestmark = with_shots
SHOTS = json.loads((FOLDER / "shots.json").read_text(encoding="utf-8")) if FOLDER.name else []
_SAMPLES = 3e6  # of a crop


def named(name: str, lens: str | None = None) -> list[dict[str, Any]]:
    found = [s for s in SHOTS if s["name"] == name and lens in (None, s["lens"])]
    assert found
    return found


class Studio:
    """A dark scene with one sphere of light, and a camera at the origin that looks along -z."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.scene = folder, first_scene()
        self.camera = self.scene.camera
        self.camera.matrix_world.identity()
        self.camera.data.clip_start = 1e-4
        mesh = bpy.data.meshes.new("light")
        import bmesh

        ball = bmesh.new()
        bmesh.ops.create_uvsphere(ball, u_segments=64, v_segments=32, radius=1.0)
        ball.to_mesh(mesh)
        ball.free()
        self.light = bpy.data.objects.new("light", mesh)
        self.scene.collection.objects.link(self.light)
        mesh.materials.append(surface("Emission")[0])
        self.white(False)
        self.scene.render.engine = "CYCLES"
        cycles = self.scene.cycles
        cycles.max_bounces, cycles.pixel_filter_type, cycles.use_adaptive_sampling = 0, "BOX", False

    def white(self, is_on: bool) -> None:
        """White surroundings in place of the light."""
        surroundings(self.scene, *[float(is_on)] * 3)
        self.light.hide_render = is_on

    def set(self, shot: dict[str, Any]) -> None:
        """Lens, sensor, size and settings of a shot."""
        data, render = self.camera.data, self.scene.render
        text = bpy.data.texts.get(shot["lens"])
        if text is None:
            text = bpy.data.texts.new(shot["lens"])
            text.from_string((FOLDER / f"{shot['lens']}.osl").read_text(encoding="utf-8"))
        if data.custom_shader != text:
            from cycles.osl import update_custom_camera_shader

            data.type, data.custom_mode, data.custom_shader = "CUSTOM", "INTERNAL", text
            assert update_custom_camera_shader(data, print)
        data.sensor_width = shot["film_mm"][0]
        for name, value in shot["custom"].items():
            data.cycles_custom[name] = value
        data.dof.use_dof = True
        data.update_tag()
        render.resolution_x, render.resolution_y = shot["width"], shot["height"]
        if "point_m" in shot:
            self.light.location, self.light.scale = shot["point_m"], [shot["radius_m"]] * 3

    def picture(self, shot: dict[str, Any], samples: int | None = None) -> Any:
        """[H, W, 3] of a shot's crop, the lowest row first."""
        return self.pixels(shot, samples)[..., :3]

    def pixels(self, shot: dict[str, Any], samples: int | None = None, matte: str = "") -> Any:
        """[H, W, 4] of a shot's crop, or its matte of an object by Cryptomatte, the lowest row first."""
        self.set(shot)
        render = self.scene.render
        left, bottom, right, top = shot.get("crop", (0, 0, shot["width"], shot["height"]))
        render.use_border = render.use_crop_to_border = "crop" in shot
        # Blender cuts off what is left over a whole pixel.
        render.border_min_x, render.border_max_x = ((edge + 0.25) / shot["width"] for edge in (left, right))
        render.border_min_y, render.border_max_y = ((edge + 0.25) / shot["height"] for edge in (bottom, top))
        shape = top - bottom, right - left
        self.scene.cycles.samples = samples or int(min(max(_SAMPLES / math.prod(shape), 32), 4096))
        render.filepath = str(self.folder / "shot.exr")
        render.use_compositing = bool(matte)
        if matte:
            with composition(self.scene) as (tree, out):
                node = tree.nodes.new("CompositorNodeCryptomatteV2")
                node.source, node.scene, node.matte_id = "RENDER", self.scene, matte
                tree.links.new(node.outputs["Matte"], out)
                bpy.ops.render.render(write_still=True)
        else:
            bpy.ops.render.render(write_still=True)
        found = pixels_of(Path(render.filepath))
        assert found.shape[:2] == shape
        return found

    def measured(self, shot: dict[str, Any], samples: int | None = None) -> dict[str, Any]:
        return measures(self.picture(shot, samples), shot["crop"][:2])


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    yield Studio(tmp_path_factory.mktemp("renders"))


@pytest.mark.parametrize("lens", ["rectilinear", "turned", "fisheye", "anamorphic", "zoom", "inside"])
def test_points_lie_where_the_exact_lens_has_them(studio: Studio, lens: str) -> None:
    off, fringe = [], []
    for shot in named("grid", lens):
        seen, wanted = (np.array(m["centroid_px"]) for m in (studio.measured(shot), shot["found"]))
        off.append(np.hypot(*(seen[0] - wanted[0])))
        pitch_um = 1e3 * shot["film_mm"][0] / shot["width"]
        fringe.append(pitch_um * np.hypot(*((seen[1] - seen[3]) - (wanted[1] - wanted[3]))))
    print(lens, "off (px)", np.round(off, 3), "lateral colour off (um)", np.round(fringe, 2))
    assert max(off) < 0.1
    assert max(fringe) < 1.0


def test_the_turn_of_the_film_is_there_to_be_measured() -> None:
    spread = [max(s["found"]["rms_px"] for s in named("grid", lens)) for lens in ("rectilinear", "turned")]
    assert spread[1] > 2 * spread[0]  # its focus lies on a tilted plane


def test_lateral_colour_is_there_to_be_measured() -> None:
    reds, blues = (np.array([s["found"]["centroid_px"][k] for s in named("grid", "rectilinear")]) for k in (1, 3))
    assert np.hypot(*(reds - blues).T).max() > 0.15  # px of 18.75 um


@pytest.mark.parametrize("name", ["stop", "off axis"])
def test_discs_have_the_size_and_shape_of_the_exact_lens(studio: Studio, name: str) -> None:
    areas, axes = [], []
    for shot in named(name):
        seen = studio.measured(shot)
        areas.append(seen["area_px"] / shot["found"]["area_px"] - 1)
        axes.append(seen["axes"] - shot["found"]["axes"])
    print(name, "areas", np.round(areas, 4), "axes", np.round(axes, 4))
    assert max(map(abs, areas)) < 0.02
    assert max(map(abs, axes)) < 0.02


def test_cats_eyes_are_there_to_be_measured() -> None:
    assert min(s["found"]["axes"] for s in named("off axis")) < 0.75
    areas = [s["found"]["area_px"] for s in named("stop")]
    assert areas[0] / areas[-1] == pytest.approx((11 / 1.83) ** 2, rel=0.1)


def test_focus_is_pulled_by_keyframes(studio: Studio) -> None:
    shots = named("pull")
    studio.set(shots[0])
    data = studio.camera.data
    for shot in shots:
        data.cycles_custom["focus_m"] = shot["custom"]["focus_m"]
        data.keyframe_insert('cycles_custom["focus_m"]', frame=shot["frame"])
    wide = []
    try:
        for shot in shots:
            studio.scene.frame_set(shot["frame"])
            kept = {**shot, "custom": {k: v for k, v in shot["custom"].items() if k != "focus_m"}}
            wide.append(studio.measured(kept)["rms_px"] / shot["found"]["rms_px"] - 1)
    finally:
        data.animation_data_clear()
    print("blur over the exact lens's", np.round(wide, 4))
    assert max(map(abs, wide)) < 0.03


@pytest.mark.parametrize("lens", ["rectilinear", "turned", "anamorphic", "fisheye"])
def test_white_card_is_that_of_the_exact_lens(studio: Studio, lens: str) -> None:
    [shot] = named("card", lens)
    studio.white(True)
    try:
        picture = studio.picture(shot, 2048).mean(2)
    finally:
        studio.white(False)
    wanted = np.array(shot["found"])
    rows, columns = wanted.shape
    seen = picture.reshape(rows, picture.shape[0] // rows, columns, -1).mean((1, 3))
    print(lens, "white card over the exact lens's, largest", np.abs(seen / wanted - 1).max(), "darkest", wanted.min())
    # The pupil of a turned film is that of an upright one where the chief ray meets it: corners lose up to 2%.
    assert np.abs(seen / wanted - 1).max() < (0.025 if lens == "turned" else 0.01)


def test_exact_shader_shows_what_the_model_does(studio: Studio) -> None:
    for shot in named("grid", "rectilinear")[:3]:
        seen, wanted = (np.array(m["centroid_px"]) for m in (studio.measured({**shot, "lens": "exact"}), shot["found"]))
        assert np.hypot(*(seen[0] - wanted[0])) < 0.1


def test_shift_counts_widths_and_heights_where_blenders_own_camera_counts_the_longer_side(studio: Studio) -> None:
    """What the panel says of it; the picture of a point on the axis moves so."""
    shot = {**named("grid", "rectilinear")[4], "width": 160, "height": 90, "point_m": [0, 0, -2.0], "radius_m": 0.02}
    del shot["crop"]
    data, found = studio.camera.data, []
    try:
        for data.shift_x, data.shift_y in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1)):
            found.append(measures(studio.picture(shot, 64), (0, 0))["centroid_px"][0])
        assert np.array(found) == pytest.approx(np.array([[80, 45], [64, 45], [80, 36]]), abs=0.1)
        data.type = "PERSP"  # 0.1 of 160 pixels
        assert measures(studio.picture(shot, 64), (0, 0))["centroid_px"][0] == pytest.approx([80, 29], abs=0.1)
    finally:
        data.type, data.shift_x, data.shift_y = "CUSTOM", 0.0, 0.0


def test_a_scene_in_centimetres_is_the_scene_in_metres(studio: Studio) -> None:
    """Lengths of the scene, and the distance of depth of field, 100 times as large; the lens out of focus as before."""
    [shot] = [s for s in named("off axis") if s["crop"] == named("off axis")[0]["crop"]]
    data = studio.camera.data
    custom = shot["custom"] | {"focus_m": 0.0}
    found = []
    try:
        for unit_m in (1.0, 0.01):
            data.dof.focus_distance, data.clip_end = 3.0 / unit_m, 100.0 / unit_m
            scaled = shot | {"point_m": [v / unit_m for v in shot["point_m"]], "radius_m": shot["radius_m"] / unit_m}
            found.append(studio.measured(scaled | {"custom": custom | {"unit_m": unit_m}}, samples=434))
    finally:
        data.cycles_custom["unit_m"], data.clip_end = 1.0, 100.0
    assert found[1]["centroid_px"][0] == pytest.approx(found[0]["centroid_px"][0], abs=0.02)
    for seen in found:
        assert seen["centroid_px"][0] == pytest.approx(shot["found"]["centroid_px"][0], abs=0.3)
        assert seen["area_px"] == pytest.approx(shot["found"]["area_px"], rel=0.02)


def test_alpha_and_cryptomatte_are_what_the_panel_and_the_documentation_say(studio: Studio) -> None:
    """Of empty sky, alpha is 1 minus the lens's light; coverage of what is opaque is that light, and without vignetting
    nearly 1."""
    [shot] = named("card", "rectilinear")
    scene, layer = studio.scene, studio.scene.view_layers[0]
    studio.white(True)
    wall = bpy.data.objects.new("wall", bpy.data.meshes.new("wall"))
    wall.data.from_pydata([(-9, -9, -5), (9, -9, -5), (9, 9, -5), (-9, 9, -5)], [], [(0, 1, 2, 3)])
    scene.collection.objects.link(wall)
    layer.use_pass_cryptomatte_object = True
    scene.render.image_settings.color_mode = "RGBA"
    try:
        for vignetting, least, most in ((True, 0.5, 0.7), (False, 0.9, 1.0)):
            given = shot | {"custom": shot["custom"] | {"vignetting": vignetting}}
            wall.hide_render, scene.render.film_transparent = True, False
            light = studio.picture(given, 128).mean(2)  # of all colours, as throughput counts
            scene.render.film_transparent = True
            assert studio.pixels(given, 128)[..., 3] == pytest.approx(1 - light, abs=0.03)
            wall.hide_render = False
            assert studio.pixels(given, 128)[..., 3] == pytest.approx(1, abs=1e-4)
            coverage = studio.pixels(given, 128, matte="wall")[..., 0]
            assert coverage == pytest.approx(light, abs=0.03) and least < coverage.min() < most
    finally:
        studio.white(False)
        layer.use_pass_cryptomatte_object = scene.render.film_transparent = False
        bpy.data.objects.remove(wall)
        studio.camera.data.cycles_custom["vignetting"] = True


def test_map_uv_reads_st_maps_as_they_are_written(studio: Studio) -> None:
    """A picture of its own pixels' places, led through both maps, holds what the maps say."""
    for kind, other in (("undistort", "redistort"), ("redistort", "undistort")):
        planes, read = (pixels_of(FOLDER / f"maps.{k}.exr") for k in (kind, other))
        map_ = bpy.data.images.load(str(FOLDER / f"maps.{kind}.exr"))
        map_.colorspace_settings.name = "Non-Color"
        height, width = read.shape[:2]
        rows, columns = np.mgrid[:height, :width].astype(np.float32)
        places = bpy.data.images.new("places", width, height, float_buffer=True)
        places.colorspace_settings.name = "Non-Color"
        places.pixels.foreach_set(np.stack([columns, rows, 0 * rows, 0 * rows + 1], 2).ravel())
        places.filepath_raw, places.file_format = str(studio.folder / "places.exr"), "OPEN_EXR"
        places.save()
        found, reach = composited(studio, places, map_, planes.shape[1], planes.shape[0])
        x, y = planes[..., 0] * width - 0.5, planes[..., 1] * height - 0.5
        inside = (planes[..., 2] > 0) & (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
        assert inside.mean() > 0.85
        assert np.abs(found[..., :2] - np.stack([x, y], 2))[inside].max() < reach
        assert not found[planes[..., 2] == 0].any()  # what the plate does not hold is clear


@contextmanager
def composition(scene: Any) -> Iterator[tuple[Any, Any]]:
    """A compositor's tree, in use inside the block, and the socket of the picture that it makes."""
    if hasattr(scene, "compositing_node_group"):  # from Blender 5.0
        tree = bpy.data.node_groups.new("maps", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        scene.compositing_node_group = tree
        out = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        out = tree.nodes.new("CompositorNodeComposite")
    scene.render.use_compositing = True
    yield tree, out.inputs[0]
    scene.render.use_compositing = False


def composited(studio: Studio, picture: Any, map_: Any, width: int, height: int) -> Any:
    """A picture through Blender's Map UV, the lowest row first, and how far from a place it may read, in pixels."""
    scene = studio.scene
    with composition(scene) as (tree, out):
        image, uv = (tree.nodes.new("CompositorNodeImage") for _ in range(2))
        image.image, uv.image = picture, map_
        node = tree.nodes.new("CompositorNodeMapUV")
        bilinear = "Interpolation" in node.inputs
        if bilinear:
            node.inputs["Interpolation"].default_value = "Bilinear"
        else:
            node.filter_type = "NEAREST"
        tree.links.new(image.outputs["Image"], node.inputs["Image"])
        tree.links.new(uv.outputs["Image"], node.inputs["UV"])
        tree.links.new(node.outputs[0], out)
        render = scene.render
        render.resolution_x, render.resolution_y, render.use_border = width, height, False
        scene.cycles.samples, render.filepath = 1, str(studio.folder / "mapped.exr")
        render.image_settings.color_mode = "RGBA"
        bpy.ops.render.render(write_still=True)
    return pixels_of(Path(render.filepath)), 0.001 if bilinear else 0.501
