"""The extension in Blender: installed from its zip, put on a camera, taken off, undone, saved, and what it says."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from in_blender import MODULE, bpy, first_scene, installed_pack, rendered, surroundings

from neurolens.programs.blender import Form, PackedLens, add_lens, user_folders

# A pinhole that shows its settings as a colour.
SHADER = """
shader camera(
  float f_number = 1.81 [[ string label = "F-Number", float min = 1.0 ]],
  int blades = 0 [[ string label = "Blades" ]],
  int vignetting = 1 [[ string widget = "checkBox" ]],
  float unit_m = 1.0 [[ string label = "Metres per Unit", float min = 1e-6 ]],
  output point position = 0.0, output vector direction = 0.0, output color throughput = 1.0)
{
  vector raster = camera_shader_raster_position();
  vector size = 0;
  float focus = 0;
  getattribute("cam:sensor_size", size);
  getattribute("cam:focal_distance", focus);
  direction = normalize(vector((raster[0] - 0.5) * size[0], (raster[1] - 0.5) * size[1], 50.0));
  throughput = color(f_number / 10.0, focus / 10.0, blades / 10.0);
}
"""
ZOOM = SHADER.replace("  int blades", "  float zoom_mm = 80.0 [[ float min = 80.0, float max = 200.0 ]],\n  int blades")
BROKEN = "shader camera(output point position = 0.0) { nonsense; }"


def packed(lens_id: str = "gauss", osl: str = SHADER, picture: bytes | None = None) -> PackedLens:
    forms = [Form("polynomial", "ols-60", osl, 0.17, 21.6, 1.81, 0.7), Form("exact", "", osl, None, 21.6, 1.81, None)]
    rows: dict[str, Any] = {"distortion_um": [[0.0, 50.0]] * 2, "blur_um": [[9.0, 20.0]] * 2, "light": [[1.0, 0.6]] * 2}
    field = {"radius_mm": [0.0, 21.0], "near_m": 1.0} | rows
    return PackedLens(
        lens_id, f"Lens {lens_id}", 49.6, 1.8, "US 2,701,982 (Angenieux, 1955)", picture, forms, field,
        "Angenieux" if picture else "", {"swirl": 0.4, "bubble": 1.2} if picture else None, picture,
    )  # fmt: skip


def phone() -> PackedLens:
    form = Form("network", "mlp-16x2", SHADER, 20.0, 3.6, 2.4, 0.1, ["pixels"], ["nothing absorbs"])
    return PackedLens("phone", "Phone lens", 5.9, 2.4, "US 7,535,658", None, [form])


def png() -> bytes:
    """A grey picture of 8 by 8 pixels."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress(b"".join(b"\0" + b"\x80" * 8 for _ in range(8)))
    head = struct.pack(">IIBBBBB", 8, 8, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("pack")
    with installed_pack(
        folder, [packed(picture=png()), phone(), packed("broken", BROKEN), packed("zoom", ZOOM)]
    ) as out:
        yield out


@pytest.fixture
def scene() -> Any:
    """A camera, 32 by 18 pixels, white surroundings and nothing else."""
    scene = first_scene()
    scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples = 32, 18, 1
    surroundings(scene, 1, 1, 1)
    return scene


def middle(scene: Any, folder: Path, frame: int = 1, eye: str = "") -> list[float]:
    """Colour of the middle of a render."""
    return list(rendered(scene, folder, frame, eye)[9, 16, :3])


def everything(scene: Any) -> dict[str, Any]:
    """What a camera and the render settings say, as far as Blender lets it be read."""
    found: dict[str, Any] = {}
    for name, thing in (("camera", scene.camera.data), ("dof", scene.camera.data.dof), ("cycles", scene.cycles),
                        ("render", scene.render)):  # fmt: skip
        for p in thing.bl_rna.properties:
            if p.type in ("INT", "FLOAT", "BOOLEAN", "STRING", "ENUM") and p.identifier != "is_evaluated":
                value = getattr(thing, p.identifier)
                found[f"{name}.{p.identifier}"] = list(value) if getattr(p, "is_array", False) else value
    found["custom"] = dict(scene.camera.data.cycles_custom.items())
    found["texts"] = [t.name for t in bpy.data.texts]
    return found


def test_the_search_chooses_a_lens_by_name_maker_or_nickname(scene: Any) -> None:
    panel = sys.modules[f"{MODULE}.panel"]
    (row,) = [row for row in panel.LIBRARY.found if row[0] == "gauss"]
    assert row[1].startswith("Angenieux: Lens gauss (49.6 mm f/1.8, 1955)")
    assert bpy.ops.neurolens.find(lens="phone") == {"FINISHED"}
    assert scene.camera.data.neurolens.lens == "phone"


def test_zip_is_one_that_blender_accepts_and_shows(installed: Path) -> None:
    script = Path(sys.modules["bl_pkg"].__file__).parent / "cli" / "blender_ext.py"
    done = subprocess.run([sys.executable, script, "validate", installed], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    menu = bpy.data.cameras.new("c").neurolens.bl_rna.properties["lens"]
    assert menu.type == "ENUM"
    module = sys.modules[f"{MODULE}.panel"]
    assert [item[:2] for item in module.LIBRARY.items["focal_length"]] == [
        ("phone", "Phone lens (5.9 mm f/2.4)"),
        ("broken", "Lens broken (49.6 mm f/1.8, 1955)"),
        ("gauss", "Lens gauss (49.6 mm f/1.8, 1955)"),
        ("zoom", "Lens zoom (49.6 mm f/1.8, 1955)"),
    ]
    pictures = module.LIBRARY.pictures  # without a screen they have no numbers to draw by
    assert pictures.keys() == {"gauss", "bokeh of gauss"}
    assert {tuple(pictures[name].image_size) for name in pictures} == {(8, 8)}


def test_menu_is_sorted_and_a_chosen_lens_stays_chosen(scene: Any) -> None:
    """Files keep numbers of lenses, not places in the menu."""
    props, module = scene.camera.data.neurolens, sys.modules[f"{MODULE}.panel"]
    props.lens = "zoom"
    firsts = {}
    for order in module.facts.ORDERS:
        props.order = order
        assert props.lens == "zoom"
        firsts[order] = module._lens_items(props, bpy.context)[0][:2]
    assert firsts["focal_length"] == ("phone", "Phone lens (5.9 mm f/2.4)")
    assert firsts["maker"] == ("gauss", "Angenieux: Lens gauss (49.6 mm f/1.8, 1955)")
    assert firsts["swirl"] == ("gauss", "Lens gauss (49.6 mm f/1.8, 1955), swirl 0.4")


def test_put_on_and_taken_back_leaves_no_trace(scene: Any) -> None:
    camera = scene.camera.data
    scene.render.engine, camera.sensor_fit, camera.lens = "BLENDER_WORKBENCH", "VERTICAL", 77.0
    camera.sensor_height = 20.0
    before = everything(scene)
    assert bpy.ops.neurolens.apply(lens="gauss", kind="polynomial") == {"FINISHED"}
    assert (camera.type, camera.custom_mode, scene.render.engine) == ("CUSTOM", "INTERNAL", "CYCLES")
    assert not scene.cycles.shading_system  # materials stay as they are: cameras in OSL do not ask for it
    assert camera.dof.use_dof and camera.lens == pytest.approx(49.6)
    assert set(camera.cycles_custom.keys()) == {"f_number", "blades", "vignetting", "unit_m"}
    assert bpy.ops.neurolens.apply(lens="gauss", kind="exact") == {"FINISHED"}
    assert bpy.ops.neurolens.take_back() == {"FINISHED"}
    assert everything(scene) == before


def test_blender_as_a_module_finds_what_reads_shaders(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # pip's bpy leaves Blender's own packages out of Python's sight, which conftest.py mends for the other tests
    monkeypatch.setattr(sys, "path", [p for p in sys.path if not (Path(p) / "oslquery").is_dir()])
    monkeypatch.setattr(f"{MODULE}.camera.find_spec", lambda _: None)
    assert bpy.ops.neurolens.apply(lens="gauss", kind="polynomial") == {"FINISHED"}
    assert any((Path(p) / "oslquery").is_dir() for p in sys.path)


def test_a_custom_camera_of_the_users_own_comes_back(scene: Any, tmp_path: Path) -> None:
    camera = scene.camera.data
    scene.render.engine = "CYCLES"
    text = bpy.data.texts.new("mine")
    text.from_string(SHADER.replace("blades / 10.0", "0.75"))
    camera.type, camera.custom_mode, camera.custom_shader = "CUSTOM", "INTERNAL", text
    from cycles.osl import update_custom_camera_shader

    assert update_custom_camera_shader(camera, print)
    camera.cycles_custom["f_number"] = 3.0
    seen = middle(scene, tmp_path)
    before = everything(scene)
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    assert middle(scene, tmp_path)[2] == pytest.approx(0, abs=1e-3)
    bpy.ops.neurolens.take_back()
    assert everything(scene) == before
    assert middle(scene, tmp_path) == pytest.approx(seen, abs=1e-6) and camera.custom_shader == text


def test_settings_of_the_scene_stay_for_the_other_camera(scene: Any) -> None:
    scene.render.engine = "BLENDER_WORKBENCH"
    other = bpy.data.objects.new("other", bpy.data.cameras.new("other"))
    scene.collection.objects.link(other)
    first = scene.camera
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    scene.camera = other
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    assert first.data.custom_shader == other.data.custom_shader
    scene.camera = first
    bpy.ops.neurolens.take_back()
    assert scene.render.engine == "CYCLES" and other.data.type == "CUSTOM" and first.data.type == "PERSP"
    scene.camera = other
    bpy.ops.neurolens.take_back()
    assert scene.render.engine == "BLENDER_WORKBENCH" and not bpy.data.texts


def test_undo_takes_both_back(scene: Any) -> None:
    bpy.ops.ed.undo_push(message="start")
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    bpy.ops.ed.undo_push(message="apply")
    bpy.ops.neurolens.take_back()
    bpy.ops.ed.undo_push(message="take back")
    assert bpy.context.scene.camera.data.type == "PERSP"
    bpy.ops.ed.undo()
    assert bpy.context.scene.camera.data.type == "CUSTOM"
    bpy.ops.ed.undo()
    assert bpy.context.scene.camera.data.type == "PERSP" and bpy.context.scene.render.engine != "CYCLES"
    bpy.ops.ed.redo()
    assert bpy.context.scene.camera.data.type == "CUSTOM"
    assert bpy.ops.neurolens.take_back() == {"FINISHED"}


def test_settings_are_animated_saved_and_rendered_without_the_extension(scene: Any, tmp_path: Path) -> None:
    camera = scene.camera.data
    target = bpy.data.objects.new("target", None)
    scene.collection.objects.link(target)
    view = scene.camera.matrix_world.normalized().col[2].xyz
    for frame, metres in ((1, 2.0), (3, 4.0)):
        target.location = scene.camera.location - metres * view
        target.keyframe_insert("location", frame=frame)
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    camera.dof.focus_object = target
    for frame, value in ((1, 2.0), (3, 6.0)):
        camera.cycles_custom["f_number"] = value
        camera.keyframe_insert('cycles_custom["f_number"]', frame=frame)
    camera.driver_add('cycles_custom["blades"]').driver.expression = "2 * frame"
    # Between two keys alike, Blender eases.
    expected = {1: (0.2, 0.2, 0.2), 2: (0.4, 0.3, 0.4), 3: (0.6, 0.4, 0.6)}
    for frame, colour in expected.items():
        assert middle(scene, tmp_path, frame) == pytest.approx(colour, abs=0.01)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.preferences.addon_disable(module=MODULE)
    try:
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
        for frame, colour in expected.items():
            assert middle(bpy.context.scene, tmp_path, frame) == pytest.approx(colour, abs=0.01)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "again.blend"))
    finally:
        bpy.ops.preferences.addon_enable(module=MODULE)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "again.blend"))
    props = bpy.context.scene.camera.data.neurolens
    assert (props.lens, props.kind, props.on) == ("gauss", "polynomial", "gauss/polynomial")
    assert bpy.ops.neurolens.take_back() == {"FINISHED"}
    assert bpy.context.scene.camera.data.type == "PERSP"


# What the shaders of lenses make of `dispersion` and `few` (`_FRAME` in shaders/osl.py).
COLOURS = SHADER.replace(
    "  int vignetting", '  int dispersion = 2,\n  int few = 0 [[ string widget = "boolean" ]],\n  int vignetting'
)
COLOURS = COLOURS.replace("blades / 10.0", "dispersion > 1 ? 1 - few : dispersion")


def test_a_camera_of_two_scenes_has_the_dispersion_of_the_rendered_one(scene: Any, tmp_path: Path) -> None:
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    camera, on_camera = scene.camera.data, sys.modules[f"{MODULE}.camera"]
    camera.custom_shader.from_string(COLOURS)
    on_camera._compile(camera)
    scene.cycles.samples = 16
    other = bpy.data.scenes.new("Z")  # the last of the two
    other.collection.objects.link(scene.camera)
    try:
        other.cycles.samples = 1
        assert middle(scene, tmp_path)[2] == pytest.approx(1)
        scene.cycles.samples, other.cycles.samples = 1, 16
        assert middle(scene, tmp_path)[2] == pytest.approx(0)
        assert camera.cycles_custom["few"] is True  # in the viewport
    finally:
        bpy.data.scenes.remove(other)


def test_few_samples_have_no_dispersion_unless_the_user_chose_it(scene: Any, tmp_path: Path) -> None:
    """In renders by their number of samples, in the viewport always; files keep what their render takes."""
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    camera, on_camera = scene.camera.data, sys.modules[f"{MODULE}.camera"]
    custom = camera.cycles_custom
    camera.custom_shader.from_string(COLOURS)
    on_camera._compile(camera)
    on_camera.tell_samples(render=False)
    for samples, told in (
        (1, "nor does this render of 1 samples"),
        (15, "of 15 samples"),
        (16, "nor do renders below 16"),
    ):
        scene.cycles.samples = samples
        assert middle(scene, tmp_path)[2] == pytest.approx(float(samples >= 16))
        assert custom["few"] is True and told in " ".join(panel(scene))
        for chosen in (0, 1):
            custom["dispersion"] = chosen
            assert middle(scene, tmp_path)[2] == pytest.approx(chosen)
            assert "viewport has no dispersion" not in " ".join(panel(scene))
        custom["dispersion"] = 2
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "many.blend"))
    assert custom["few"] is True
    bpy.ops.preferences.addon_disable(module=MODULE)
    try:
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "many.blend"))
        assert middle(bpy.context.scene, tmp_path)[2] == pytest.approx(1)
    finally:
        bpy.ops.preferences.addon_enable(module=MODULE)


def test_a_switch_of_an_earlier_version_stays_off(scene: Any) -> None:
    on_camera, custom = sys.modules[f"{MODULE}.camera"], scene.camera.data.cycles_custom
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    custom["dispersion"] = False
    camera = scene.camera.data
    lens = sys.modules[f"{MODULE}.panel"].LIBRARY.lenses["gauss"]
    on_camera._set(scene, camera, lens, lens.variants["exact"], COLOURS, None, 1.0)
    assert custom["dispersion"] == 0 and custom["dispersion"] is not False


def said(**given: Any) -> str:
    """The message of an operator that must fail."""
    with pytest.raises(RuntimeError) as failed:
        bpy.ops.neurolens.apply(**given)
    return str(failed.value).removeprefix("Error: ").strip()


def test_focal_length_of_the_viewport_follows_the_zoom(scene: Any, tmp_path: Path) -> None:
    camera, before = scene.camera.data, everything(scene)
    bpy.ops.neurolens.apply(lens="zoom", kind="polynomial")
    for zoom_mm in (85.0, 150.0):
        camera.cycles_custom["zoom_mm"] = zoom_mm
        camera.update_tag()
        bpy.context.view_layer.update()
        assert camera.lens == pytest.approx(zoom_mm)
    for frame, zoom_mm in ((1, 80.0), (3, 200.0)):
        camera.cycles_custom["zoom_mm"] = zoom_mm
        camera.keyframe_insert('cycles_custom["zoom_mm"]', frame=frame)
    scene.frame_set(2)
    assert camera.lens == pytest.approx(140.0, abs=0.1)
    assert bpy.ops.neurolens.apply(lens="gauss", kind="polynomial") == {"FINISHED"}
    assert not camera.animation_data.drivers
    bpy.ops.neurolens.take_back()
    camera.animation_data_clear()
    scene.frame_set(1)
    assert everything(scene) == before
    bpy.ops.neurolens.apply(lens="zoom", kind="polynomial")
    bpy.ops.neurolens.take_back()
    assert not camera.animation_data.drivers and everything(scene) == before


def test_a_focal_length_with_a_driver_of_its_own_keeps_it(scene: Any) -> None:
    camera = scene.camera.data
    camera.driver_add("lens").driver.expression = "35"
    bpy.ops.neurolens.apply(lens="zoom", kind="polynomial")
    bpy.ops.neurolens.take_back()
    assert [d.driver.expression for d in camera.animation_data.drivers] == ["35"]


def test_a_render_that_will_be_black_says_so(scene: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    middle(scene, tmp_path)
    assert "neurolens" not in capfd.readouterr().err
    scene.camera.data.dof.focus_distance = 0.3
    middle(scene, tmp_path)
    [line] = [text for text in capfd.readouterr().err.splitlines() if "neurolens" in text]
    assert line.startswith("neurolens: camera 'Camera', frame 1: The focus distance is 0.3 m away, nearer than")
    bpy.ops.neurolens.take_back()
    middle(scene, tmp_path)
    assert "neurolens" not in capfd.readouterr().err


def test_a_lens_takes_the_scene_s_unit_and_keeps_the_user_s(scene: Any) -> None:
    """Centimetres: a focus distance of 50 is 0.5 m, nearer than the lens focuses."""
    gauss, camera = {"lens": "gauss", "kind": "polynomial"}, scene.camera.data
    scene.unit_settings.scale_length, camera.dof.focus_distance = 0.01, 50.0
    assert "The focus distance is 0.5 m away" in said(**gauss)
    camera.dof.focus_distance = 200.0
    bpy.ops.neurolens.apply(**gauss)
    assert camera.cycles_custom["unit_m"] == pytest.approx(0.01) and "unit of this scene" not in "".join(panel(scene))
    camera.cycles_custom["unit_m"] = 0.1
    bpy.ops.neurolens.apply(lens="zoom", kind="polynomial")
    assert camera.cycles_custom["unit_m"] == pytest.approx(0.1)
    assert "A unit of this scene is 0.01 m by its unit scale; the lens takes it for 0.1 m" in " ".join(panel(scene))
    scene.unit_settings.system = "NONE"  # where Blender's unit scale does not count
    assert "A unit of this scene is 1 m by its unit scale" in " ".join(panel(scene))


def test_stereo_that_leaves_the_image_circle_is_told_by_what_cycles_shifts(
    scene: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The eyes' films move by what the panel counts, which a shader shows that renders the place in the picture."""
    camera, render, on_camera = scene.camera.data, scene.render, sys.modules[f"{MODULE}.camera"]
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    camera.custom_shader.from_string("""shader camera(output point position = 0.0, output vector direction = 0.0,
        output color throughput = 1.0) { direction = vector(0, 0, 1);
        throughput = color(camera_shader_raster_position()) + 1; }""")
    on_camera._compile(camera)
    render.use_multiview, render.image_settings.views_format = True, "INDIVIDUAL"
    scene.cycles.samples = 64
    camera.sensor_width, camera.shift_x, camera.stereo.convergence_distance = 30.0, 0.05, 1.0
    for pivot, eyes in (("CENTER", (0.5, -0.5)), ("LEFT", (0.0, -1.0))):
        camera.stereo.pivot = pivot
        seen = [middle(scene, tmp_path, eye=eye)[0] - 1.5 - 0.5 / 32 for eye in ("_L", "_R")]
        counted = on_camera.setting_of(scene, scene.camera).stereo
        assert counted == pytest.approx([share * 0.065 * camera.lens / 30.0 for share in eyes])
        assert seen == pytest.approx([0.05 + shift for shift in counted], abs=1e-3)
    assert "stereo" not in " ".join(panel(scene)) + capfd.readouterr().err
    camera.stereo.interocular_distance = 0.4
    middle(scene, tmp_path, eye="_L")
    assert "Off-axis stereo takes a corner to" in " ".join(panel(scene))
    assert "frame 1: Off-axis stereo takes a corner to" in capfd.readouterr().err
    camera.stereo.convergence_mode = "PARALLEL"
    assert "stereo" not in " ".join(panel(scene))


def test_what_cannot_be_is_one_sentence_and_changes_nothing(scene: Any) -> None:
    gauss = {"lens": "gauss", "kind": "polynomial"}
    camera, before = scene.camera, everything(scene)
    assert "There is no lens 'other'; lenses: phone, broken, gauss, zoom" in said(lens="other")
    assert "larger than the lens's picture of 7.2 mm" in said(lens="phone")
    assert "does not compile" in said(lens="broken", kind="polynomial")
    assert "has no network form here: polynomial, exact" in said(lens="gauss", kind="network")
    assert everything(scene) == before
    near = bpy.data.objects.new("nose", None)
    scene.collection.objects.link(near)
    near.location = camera.location - 0.5 * camera.matrix_world.normalized().col[2].xyz
    camera.data.dof.focus_object = near
    for on in (True, False):  # the lens switches depth of field on
        camera.data.dof.use_dof = on
        before = everything(scene)
        bpy.context.view_layer.update()
        assert "The focus object 'nose' is 0.5 m away, nearer than the lens focuses: 0.7 m" in said(**gauss)
        assert everything(scene) == before
    scene.camera = near
    assert "'nose' is not a camera, but of type EMPTY" in said(**gauss)
    scene.camera = None
    assert "The scene has no camera" in said(**gauss)
    with pytest.raises(RuntimeError, match="no camera"):
        bpy.ops.neurolens.take_back()
    scene.camera = camera
    with pytest.raises(RuntimeError, match="carries no lens"):
        bpy.ops.neurolens.take_back()


def test_a_sensor_is_fitted_to_a_small_lens_and_comes_back(scene: Any) -> None:
    before = everything(scene)
    bpy.ops.neurolens.apply(lens="phone", fit_sensor=True)
    camera = scene.camera.data
    assert math.hypot(camera.sensor_width, camera.sensor_width * 18 / 32) == pytest.approx(7.2, abs=0.02)
    bpy.ops.neurolens.take_back()
    assert everything(scene) == before


class Paper:
    """A layout that writes down what is drawn on it."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def label(self, text: str, icon: str = "") -> None:
        self.lines.append(text)

    def prop(self, thing: Any, name: str, text: str | None = None) -> None:
        self.lines.append(f"<{name}>")

    def prop_enum(self, thing: Any, name: str, value: str) -> None:
        self.lines.append(f"<{name}:{value}>")

    def operator(self, name: str, **look: Any) -> Any:
        self.lines.append(f"({name})")
        return SimpleNamespace()

    def template_icon_view(self, *args: Any, **look: Any) -> None:
        self.lines.append("[picture]")

    def template_icon(self, icon_value: int, scale: float) -> None:
        self.lines.append("[bokeh]")

    def row(self, align: bool = False) -> Paper:
        return self

    column = row


def panel(scene: Any) -> list[str]:
    """Lines of the panel of the scene's camera."""
    paper = Paper()
    drawn = SimpleNamespace(layout=paper)
    shown = sys.modules[f"{MODULE}.panel"].NEUROLENS_PT_lens
    for name in ("_draw_scene", "_draw_settings"):
        setattr(drawn, name, getattr(shown, name).__get__(drawn))
    shown.draw(drawn, SimpleNamespace(scene=scene, camera=scene.camera.data, object=scene.camera))
    return paper.lines


def test_lenses_of_the_user_folder_join_the_menu(scene: Any) -> None:
    [folder] = user_folders()
    try:
        add_lens(folder, packed("mine"))
        bpy.ops.neurolens.reload()
        assert bpy.ops.neurolens.apply(lens="mine", kind="exact") == {"FINISHED"}
        (folder / "lenses.json").write_text(json.dumps({"schema": 99, "lenses": []}))
        bpy.ops.neurolens.reload()
        assert any("schema is 99" in line for line in panel(scene))
        assert bpy.ops.neurolens.take_back() == {"FINISHED"}
    finally:
        (folder / "lenses.json").unlink()
        bpy.ops.neurolens.reload()


def test_a_shot_that_needs_no_lens_is_told_so(scene: Any) -> None:
    """A wall at the focus, wide tolerance: Blender's own camera; what is near needs depth of field; then the lens."""
    camera = scene.camera
    camera.location, camera.rotation_euler = (0, 0, 0), (0, 0, 0)
    bpy.ops.mesh.primitive_plane_add(size=100, location=(0, 0, -4))
    camera.data.dof.focus_distance, camera.data.sensor_width = 4.0, 36.0
    bpy.ops.neurolens.apply(lens="gauss", kind="polynomial")
    told = {}
    for name, tolerance in (("all", 1e3), ("little", 0.005)):
        camera.data.neurolens.tolerance_px = tolerance
        assert bpy.ops.neurolens.needs() == {"FINISHED"}
        told[name] = camera.data.neurolens.advice.splitlines()
    assert told["all"][0].startswith("Use Blender's camera without") and "by up to 0 px" in told["all"][1]
    assert "form polynomial" in told["little"][0]  # 0.17 um where a pixel is 1125 um
    bpy.ops.mesh.primitive_plane_add(size=0.1, location=(0, 0, -0.5))
    bpy.context.view_layer.update()
    camera.data.neurolens.tolerance_px = 1.5
    bpy.ops.neurolens.needs()
    assert "by up to 2" in camera.data.neurolens.advice or "by up to 1" in camera.data.neurolens.advice
