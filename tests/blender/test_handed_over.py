"""The script of `neurolens handover` in Blender: its camera, its groups, and where they show a light."""

from __future__ import annotations

import os
import runpy
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Blender as a module (bpy) is not installed: make test-blender runs these")

FOLDER = os.environ.get("NEUROLENS_BLENDER_SHOTS")
pytestmark = pytest.mark.skipif(FOLDER is None, reason="no numbers of tests/blender/expect.py: make test-blender")
PLACES_M = [(0.0, 0.0), (-0.5, 0.28), (0.55, -0.3), (0.3, 0.1)]  # of lights in the plane in focus


def pixels_of(file: Path) -> np.ndarray:
    """A picture's pixels [H, W, 4], the lowest row first."""
    image = bpy.data.images.load(str(file), check_existing=False)
    image.colorspace_settings.name = "Non-Color"
    found = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(found)
    return found.reshape(image.size[1], image.size[0], 4).astype(float)


def test_a_render_through_the_script_s_camera_and_group_is_the_lens_s_picture() -> None:
    """Small lights lie where the map says that the lens shows what the pinhole shows there, as bright as its light."""
    folder = Path(str(FOLDER)) / "handed"
    bpy.ops.wm.read_homefile(app_template="", use_factory_startup=True)
    for found in [o for o in bpy.data.objects if o.type != "CAMERA"]:
        bpy.data.objects.remove(found)
    made = runpy.run_path(str(folder / "shot.blender.py"))
    scene = bpy.context.scene
    data, film = scene.camera.data, bpy.data.objects["neurolens film"]
    [(_, _, focal, pupil, focus, stop)] = made["FRAMES"]
    assert (data.lens, data.dof.focus_distance, data.dof.aperture_fstop) == pytest.approx((focal, focus - pupil, stop))
    assert (scene.render.resolution_x, scene.render.resolution_y) == tuple(made["UNDISTORTED"])
    assert {"neurolens undistort", "neurolens redistort"} <= set(bpy.data.node_groups.keys())
    film.location = (0, 0, focus)
    glow = bpy.data.materials.new("glow")
    if glow.node_tree is None:  # to Blender 4.5
        glow.use_nodes = True
    nodes = glow.node_tree.nodes
    nodes.clear()
    emission, out = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    glow.node_tree.links.new(emission.outputs[0], out.inputs["Surface"])
    for x, y in PLACES_M:
        bpy.ops.mesh.primitive_circle_add(vertices=64, radius=0.04, fill_type="NGON", location=(x, y, 0))
        bpy.context.object.data.materials.append(glow)
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0, 0, 0, 1)
    data.dof.use_dof = False
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 64, False
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(folder / "comp" / "whole.exr")
    bpy.ops.render.render(write_still=True)
    [file] = (folder / "comp").glob("lens_*.exr")
    picture, light = pixels_of(file), pixels_of(folder / "shot.illumination.exr")
    (width, height), (wide, high) = made["PLATE"], made["UNDISTORTED"]
    assert picture.shape[:2] == (height, width)
    for channel, colour in enumerate(("red", "green", "blue")):
        map_ = pixels_of(folder / f"shot.redistort.{colour}.exr")
        for x, y in PLACES_M:
            seen = np.array([x, y]) / (focus - pupil) * focal / made["FILM_MM"][0] * wide  # pixels from the middle
            way = np.stack([(map_[..., 0] - 0.5) * wide, (map_[..., 1] - 0.5) * high], 2) - seen
            near = np.hypot(way[..., 0], way[..., 1]) < 6
            weight = picture[..., channel] * near
            # The centroid of what the pinhole shows there: by the map, of pixels of about one size.
            off = [(way[..., k] * weight).sum() / weight.sum() for k in (0, 1)]
            assert np.hypot(*off) < 0.1
            middle = np.hypot(way[..., 0], way[..., 1]) < 1.2
            assert picture[..., channel][middle].mean() == pytest.approx(light[..., 0][middle].mean(), abs=0.03)
