"""The scene's lights in a list for `neurolens flare`, and layers of flare in the compositor."""

from __future__ import annotations

import importlib
import json
import math
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_blender import bpy, first_scene, installed_pack, rendered, surface, surroundings
from test_extension import packed

sys.path.append(str(Path(__file__).parents[3]))  # experiments


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with installed_pack(tmp_path_factory.mktemp("pack"), [packed()]) as out:
        yield out


@pytest.fixture
def scene() -> Any:
    """A camera at the origin that looks along -z, of 36 x 36 mm and f/2; 8 x 8 pixels, black surroundings."""
    scene = first_scene(camera=False)
    scene.camera = camera = added(scene, bpy.data.cameras.new("camera"))
    camera.data.dof.use_dof, camera.data.dof.aperture_fstop = True, 2.0
    scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", 64, 0
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.frame_start = scene.frame_end = 1
    surroundings(scene, 0, 0, 0)
    return scene


def added(scene: Any, data: Any, place: tuple[float, float, float] = (0, 0, 0)) -> Any:
    thing = bpy.data.objects.new(data.name if data else "thing", data)
    scene.collection.objects.link(thing)
    thing.location = place
    return thing


def light(scene: Any, kind: str, place: tuple[float, float, float], **settings: Any) -> Any:
    data = bpy.data.lights.new(kind.lower(), kind)
    for name, value in settings.items():
        setattr(data, name, value)
    return added(scene, data, place)


def wall(scene: Any, x: tuple[float, float], z: float, y: float = 10.0) -> Any:
    """An opaque wall across the view, from x[0] to x[1]."""
    mesh = bpy.data.meshes.new("wall")
    mesh.from_pydata([(x[0], -y, z), (x[1], -y, z), (x[1], y, z), (x[0], y, z)], [], [(0, 1, 2, 3)])
    return added(scene, mesh)


def rows(tmp_path: Path, rays: int = 64) -> list[dict[str, Any]]:
    assert bpy.ops.neurolens.write_lights(filepath=str(tmp_path / "lights.json"), rays=rays) == {"FINISHED"}
    found: list[dict[str, Any]] = json.loads((tmp_path / "lights.json").read_text())
    return found


def pixel(scene: Any, folder: Path, frame: int = 1) -> np.ndarray[Any, Any]:
    """Colour of a render, mean over its pixels."""
    return np.asarray(rendered(scene, folder, frame)[..., :3].mean((0, 1)))


def card(scene: Any, way: Any, folder: Path) -> Any:
    """Colour of a small white card at the origin across the way of a light."""
    card = wall(scene, (-0.001, 0.001), 0.0, 0.001)
    material, diffuse = surface("BsdfDiffuse")
    diffuse.inputs["Color"].default_value = (1, 1, 1, 1)
    card.data.materials.append(material)
    towards = way / np.linalg.norm(way)
    turned = type(scene.camera.location)(towards).to_track_quat("Z", "Y")
    for thing in (card, scene.camera):
        thing.rotation_mode, thing.rotation_quaternion = "QUATERNION", turned
    scene.camera.location = tuple(0.05 * towards)
    scene.camera.data.sensor_width, scene.camera.data.lens, scene.camera.data.dof.use_dof = 0.5, 50.0, False
    scene.camera.data.clip_start = 0.001
    return pixel(scene, folder)


ACROSS = {"POINT": {}, "SPOT": {"spot_size": math.radians(50), "spot_blend": 0.6},
          "AREA": {"shape": "RECTANGLE", "size": 0.2, "size_y": 0.4}, "SUN": {"angle": 0.1}}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        *ACROSS.items(),
        ("AREA", {"shape": "DISK", "size": 0.3, "spread": math.radians(70)}),
        ("AREA", {"shape": "SQUARE", "size": 0.3, "normalize": False}),
        ("POINT", {"normalize": False, "exposure": 1.5}),
        ("SUN", {"angle": 0.1, "normalize": False}),
        ("POINT", {"use_temperature": True, "temperature": 3000.0}),
    ],
)
def test_irradiance_is_what_a_white_card_shows(kind: str, settings: dict[str, Any], scene: Any, tmp_path: Path) -> None:
    """The light is written as a camera at the card's place sees it; then the card is rendered."""
    place = (0.9, 0.5, -5.0)
    lamp = light(scene, kind, place, energy=700.0 if kind != "SUN" else 3.0, color=(1.0, 0.5, 0.25), **settings)
    if "shadow_soft_size" in dir(lamp.data) and kind in ("POINT", "SPOT"):
        lamp.data.shadow_soft_size = 0.1
    lamp.rotation_euler = (math.radians(180 + 9), math.radians(12), 0)  # towards the camera, a little aside
    (row,) = rows(tmp_path)
    assert row["visible"] == 1 and min(row["r"], row["g"], row["b"]) > 0
    way = np.array(place) if kind != "SUN" else np.array(lamp.matrix_world.col[2].xyz)
    if kind != "SUN":
        assert row["distance_m"] == pytest.approx(np.linalg.norm(way), rel=1e-5)
    assert row["azimuth_deg"] == pytest.approx(math.degrees(math.atan2(way[0], -way[2])), abs=1e-4)
    assert row["elevation_deg"] == pytest.approx(math.degrees(math.asin(way[1] / np.linalg.norm(way))), abs=1e-4)
    shown = card(scene, way, tmp_path)
    assert shown == pytest.approx(np.array([row["r"], row["g"], row["b"]]) / math.pi, rel=0.01)


@pytest.mark.parametrize("kind", ["Emission", "BsdfPrincipled"])
@pytest.mark.parametrize("shape", ["sphere", "circle", "cube"])
def test_a_mesh_that_shines_is_a_light(shape: str, kind: str, scene: Any, tmp_path: Path) -> None:
    """Irradiance is what a white card shows of it, which stands where the camera is; a wall hides it."""
    material, node = surface(kind)
    scene.cycles.samples = 1024
    names = ("Color", "Strength") if kind == "Emission" else ("Emission Color", "Emission Strength")
    node.inputs[names[0]].default_value, node.inputs[names[1]].default_value = (1.0, 0.5, 0.25, 1), 40.0
    place, size = (0.9, 0.5, -5.0), 0.2
    if shape == "sphere":
        bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=size, location=place)
    elif shape == "circle":
        bpy.ops.mesh.primitive_circle_add(vertices=64, radius=size, fill_type="NGON", location=place)
    else:
        bpy.ops.mesh.primitive_cube_add(size=size, location=place, rotation=(0.4, 0.7, 0.2))
    bpy.context.object.data.materials.append(material)
    (row,) = rows(tmp_path)
    way = np.array(place)
    assert row["visible"] == 1 and row["light"] == bpy.context.object.name
    assert row["distance_m"] == pytest.approx(np.linalg.norm(way), abs=size)
    assert row["azimuth_deg"] == pytest.approx(math.degrees(math.atan2(way[0], -way[2])), abs=0.2)
    if shape == "sphere":
        assert row["diameter_deg"] == pytest.approx(math.degrees(2 * math.asin(size / np.linalg.norm(way))), rel=0.01)
    screen = wall(scene, (-9, 9), -2.0)
    assert rows(tmp_path)[0]["visible"] == 0
    bpy.data.objects.remove(screen)
    assert card(scene, way, tmp_path) == pytest.approx(np.array([row["r"], row["g"], row["b"]]) / math.pi, rel=0.01)


def test_a_screen_does_not_shine_through_its_back(scene: Any, tmp_path: Path) -> None:
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(0, 0, -4))
    box = bpy.context.object
    box.data.materials.append(surface("BsdfDiffuse")[0])
    box.data.materials.append(surface("Emission")[0])
    front = max(box.data.polygons, key=lambda face: face.center.z)
    front.material_index = 1
    (row,) = rows(tmp_path)
    assert row["visible"] == 1 and row["r"] == pytest.approx(0.25 / 3.75**2, rel=0.01)
    box.rotation_euler = (0, math.pi, 0)
    assert rows(tmp_path)[0]["visible"] == 0


def test_a_dome_is_no_light(scene: Any, tmp_path: Path) -> None:
    light(scene, "POINT", (0, 0, -4.0))
    bpy.ops.mesh.primitive_uv_sphere_add(radius=50)
    bpy.context.object.data.materials.append(surface("Emission")[0])
    assert [row["light"] for row in rows(tmp_path)] == ["point"]


def test_a_light_dims_as_an_edge_passes_before_it(scene: Any, tmp_path: Path) -> None:
    """The share that shows is that of a disc of which a chord takes a part; the lens is nearly closed."""
    radius, near = 0.3, 2.0
    light(scene, "POINT", (0, 0, -4.0), shadow_soft_size=radius)
    scene.camera.data.dof.aperture_fstop = 64
    edge = wall(scene, (-50, 0), -near)
    scene.frame_end = 21
    places = np.linspace(-1.2, 1.2, 21)  # of the edge's shadow, in radii
    for frame, place in enumerate(places, 1):
        edge.location.x = place * radius * near / 4.0
        edge.keyframe_insert("location", frame=frame)
    shown = np.array([row["visible"] for row in rows(tmp_path, rays=512)])
    u = places.clip(-1, 1)
    expected = (np.arccos(u) - u * np.sqrt(1 - u * u)) / math.pi
    assert [row["frame"] for row in rows(tmp_path)] == list(range(1, 22))
    assert np.abs(shown - expected).max() < 0.02 and (np.diff(shown) <= 0).all()
    assert shown[10] == pytest.approx(0.5, abs=0.02)


def test_a_light_without_size_dims_over_the_pupil(scene: Any, tmp_path: Path) -> None:
    """50 mm at f/2: an edge half way to the light takes 12.5 mm to pass before all of the pupil."""
    light(scene, "POINT", (0, 0, -4.0), shadow_soft_size=0.0)
    edge = wall(scene, (-50, 0), -2.0)
    shown = []
    for shift in (-0.007, -0.003, 0.0, 0.003, 0.007):
        edge.location.x = shift
        shown.append(rows(tmp_path, rays=512)[0]["visible"])
    u = np.array([-0.003, 0.0, 0.003]) / (0.0125 / 2)  # places of the edge, in radii of the pupil there
    expected = (np.arccos(u) - u * np.sqrt(1 - u * u)) / math.pi
    assert shown[0] == 1 and shown[-1] == 0 and shown[1:4] == pytest.approx(expected, abs=0.02)


def test_what_no_camera_sees_hides_nothing(scene: Any, tmp_path: Path) -> None:
    light(scene, "POINT", (0, 0, -4.0))
    for z, change in ((-2.0, "visible_camera"), (-2.3, "hide_render"), (-2.6, "")):
        screen = wall(scene, (-1, 1), z)
        if change:
            setattr(screen, change, change == "hide_render")
        assert rows(tmp_path)[0]["visible"] == (1.0 if change else 0.0)
    scene.camera.data.clip_start = 3.0  # and what is nearer than the camera shows
    assert rows(tmp_path)[0]["visible"] == 1


def test_lights_that_move_come_and_go_have_a_row_in_every_frame(scene: Any, tmp_path: Path) -> None:
    lamp, other = light(scene, "POINT", (0, 0, -4.0)), light(scene, "POINT", (0, 1, -4.0))
    scene.frame_start, scene.frame_end, scene.frame_step = 2, 8, 2
    for frame in (2, 4, 6, 8):
        lamp.location.x = frame / 2 - 2
        lamp.keyframe_insert("location", frame=frame)
    for frame, hidden in ((2, True), (4, False), (8, True)):
        other.hide_render = hidden
        other.keyframe_insert("hide_render", frame=frame)
    scene.frame_set(5)
    found = {name: [row for row in rows(tmp_path) if row["light"] == name] for name in ("point", "point.001")}
    assert scene.frame_current == 5
    assert [[row["frame"] for row in own] for own in found.values()] == [[2, 4, 6, 8]] * 2
    expected = [math.degrees(math.atan((frame / 2 - 2) / 4)) for frame in (2, 4, 6, 8)]
    assert [row["azimuth_deg"] for row in found["point"]] == pytest.approx(expected, abs=1e-3)
    assert [row["visible"] for row in found["point.001"]] == [0, 1, 1, 0]


def test_lights_behind_the_camera_are_written_as_such(scene: Any, tmp_path: Path) -> None:
    light(scene, "POINT", (0, 0, 4.0))
    (row,) = rows(tmp_path)
    assert abs(row["azimuth_deg"]) == pytest.approx(180) and row["visible"] == 0


def test_keys_of_a_lens_go_with_its_lights(scene: Any, tmp_path: Path) -> None:
    light(scene, "POINT", (0, 0, -4.0))
    scene.unit_settings.scale_length = 0.01
    data = scene.camera.data
    data.sensor_width, data.dof.focus_distance, data.shift_x = 24.0, 250.0, 0.25
    assert bpy.ops.neurolens.apply(lens="gauss", kind="polynomial") == {"FINISHED"}
    (row,) = rows(tmp_path)
    assert row["distance_m"] == pytest.approx(0.04)
    assert json.loads((tmp_path / "lights.keys.json").read_text()) == [
        {"frame": 1, "focus": pytest.approx(2.5), "f-number": pytest.approx(2.0), "film-shift": 6.0, "film-rise": 0.0}
    ]


def test_materials_that_shine_by_a_texture_are_named_as_left_out(
    scene: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, strength in (("neon tube", 5.0), ("paint", 0.0), ("black", 5.0), ("screen", 5.0)):
        material, node = surface("BsdfPrincipled", name)
        node.inputs["Emission Strength"].default_value = strength
        node.inputs["Emission Color"].default_value = [float(name != "black")] * 4
        if name == "black":  # as old files have them, here with a second node
            material.node_tree.nodes.new("ShaderNodeEmission").inputs["Strength"].default_value = 0.0
        if name == "screen":
            picture = material.node_tree.nodes.new("ShaderNodeTexImage")
            material.node_tree.links.new(picture.outputs[0], node.inputs["Emission Color"])
        thing = wall(scene, (1, 2), -5.0, 0.1)
        thing.name = name
        thing.data.materials.append(material)
    assert [row["light"] for row in rows(tmp_path)] == ["neon tube"]
    said = capfd.readouterr().out
    assert "Left out" in said and "screen" in said and not any(name in said for name in ("neon", "paint", "black"))


@pytest.mark.parametrize("case", ["no light", "no folder", "no camera"])
def test_mistakes_are_one_line(case: str, scene: Any, tmp_path: Path) -> None:
    path, said = tmp_path / "lights.json", {"no light": "no light that is rendered", "no camera": "no camera"}
    if case == "no folder":
        light(scene, "POINT", (0, 0, -4.0))
        path, said[case] = tmp_path / "none" / "lights.json", "cannot be written"
    if case == "no camera":
        bpy.data.objects.remove(scene.camera)
    with pytest.raises(RuntimeError, match=said[case]):
        bpy.ops.neurolens.write_lights(filepath=str(path))
    assert not path.exists()


def write_exr(path: Path, channels: dict[str, float], size: int = 8) -> None:
    """An OpenEXR file without compression, whose channels have one value each."""
    names = sorted(channels)
    box = struct.pack("<4i", 0, 0, size - 1, size - 1)
    listed = b"".join(name.encode() + struct.pack("<x2iII", 2, 0, 1, 1) for name in names) + b"\0"
    about = {
        "channels": ("chlist", listed), "compression": ("compression", b"\0"), "dataWindow": ("box2i", box),
        "displayWindow": ("box2i", box), "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)), "screenWindowCenter": ("v2f", struct.pack("<2f", 0, 0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
    }  # fmt: skip
    head = struct.pack("<iI", 20000630, 2) + b"".join(
        f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value for name, (kind, value) in about.items()
    ) + b"\0"  # fmt: skip
    line = b"".join(struct.pack(f"<{size}f", *[channels[name]] * size) for name in names)
    starts = [len(head) + 8 * size + row * (8 + len(line)) for row in range(size)]
    lines = b"".join(struct.pack("<2i", row, len(line)) + line for row in range(size))
    path.write_bytes(head + struct.pack(f"<{size}Q", *starts) + lines)


def test_layers_are_added_in_the_compositor_by_their_gains(scene: Any, tmp_path: Path) -> None:
    """Each frame of a sequence gets its own picture of flare."""
    tool = importlib.import_module("experiments.pictures.flare_in_blender")
    for frame in (3, 4):
        layers = {
            "ghosts": (0.1, 0.2, 0.4),
            "g07-03": (0.1, 0.0, 0.1),
            "rest": (0.0, 0.2, 0.3),
            "glare": (0.5, 0.5, 0.5),
        }
        channels = {f"{name}.{c}": frame * v for name, rgb in layers.items() for c, v in zip("RGB", rgb, strict=True)}
        write_exr(tmp_path / f"flare.{frame:04d}.exr", channels | {"R": 9.0, "G": 9.0, "B": 9.0})
    surroundings(scene, 1, 2, 3)
    assert tool.add_layers(scene, tmp_path / "flare.0003.exr") == ["g07-03", "glare", "rest"]
    for frame in (3, 4):
        assert pixel(scene, tmp_path, frame) == pytest.approx(
            np.array([1 + 0.6 * frame, 2 + 0.7 * frame, 3 + 0.9 * frame]), rel=1e-3
        )
    tree = scene.compositing_node_group if hasattr(scene, "compositing_node_group") else scene.node_tree
    group = next(n for n in tree.nodes if n.bl_idname == "CompositorNodeGroup")
    group.inputs["glare"].default_value, group.inputs["rest"].default_value = 0.0, 2.0
    assert pixel(scene, tmp_path, 3) == pytest.approx(np.array([1.3, 3.2, 3 + 0.3 + 1.8]), rel=1e-3)
    write_exr(tmp_path / "still.exr", {"R": 1.0, "G": 1.0, "B": 1.0})
    assert tool.add_layers(scene, tmp_path / "still.exr") == ["flare"]  # after the first group
    assert pixel(scene, tmp_path, 3) == pytest.approx(np.array([2.3, 4.2, 4 + 0.3 + 1.8]), rel=1e-3)
    with pytest.raises(ValueError, match="no picture"):
        tool.add_layers(scene, tmp_path / "missing.exr")
