"""The script of `neurolens handover` in Blender: its camera, its groups, and where they show a light."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from in_blender import FOLDER, bpy, first_scene, pixels_of, rendered, surface, surroundings, with_shots

pytestmark = with_shots
PLACES_M = [(0.0, 0.0), (-0.5, 0.28), (0.55, -0.3), (0.3, 0.1)]  # of lights in the plane in focus


def test_a_render_through_the_script_s_camera_and_group_is_the_lens_s_picture(tmp_path: Path) -> None:
    """Small lights lie where the map says that the lens shows what the pinhole shows there, as bright as its light."""
    folder, scene = Path(shutil.copytree(FOLDER / "handed", tmp_path / "handed")), first_scene()
    made = runpy.run_path(str(folder / "shot.blender.py"))
    data, film = scene.camera.data, bpy.data.objects["neurolens film"]
    [(_, _, focal, pupil, focus, stop)] = made["FRAMES"]
    assert (data.lens, data.dof.focus_distance, data.dof.aperture_fstop) == pytest.approx((focal, focus - pupil, stop))
    assert (scene.render.resolution_x, scene.render.resolution_y) == tuple(made["UNDISTORTED"])
    assert {"neurolens undistort", "neurolens redistort"} <= set(bpy.data.node_groups.keys())
    film.location = (0, 0, focus)
    glow, _ = surface("Emission")
    for x, y in PLACES_M:
        bpy.ops.mesh.primitive_circle_add(vertices=64, radius=0.04, fill_type="NGON", location=(x, y, 0))
        bpy.context.object.data.materials.append(glow)
    surroundings(scene, 0, 0, 0)
    data.dof.use_dof = False
    scene.render.engine, scene.cycles.samples = "CYCLES", 64
    rendered(scene, tmp_path)
    node = next(n for n in bpy.data.node_groups["neurolens redistort"].nodes if n.bl_idname == "CompositorNodeMapUV")
    reach = 0.1 if "Interpolation" in node.inputs else 0.3  # of the filter that Blender 4.5 has alone: see the page
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
            assert np.hypot(*off) < reach
            middle = np.hypot(way[..., 0], way[..., 1]) < 1.2
            assert picture[..., channel][middle].mean() == pytest.approx(light[..., 0][middle].mean(), abs=0.03)
