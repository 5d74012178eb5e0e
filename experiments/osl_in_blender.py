"""The race of `osl_speed`, in Blender's own Python, which has neither neurolens nor torch: PLAN.json RESULT.json.

The plan holds `cameras`, each with `name`, `focal_mm`, `depth_of_field` and `shader`, the text of one in OSL or null
for the camera that Blender has, and `scenes` by name, each with `size` (pixels), `samples`, `rounds` and names of
`cameras`. Cameras of a scene render in turn; the result is, by scene and camera, `full` and `tiny`: seconds of CPU of
the pictures, and of pictures of a few rays, which is what Cycles takes to begin.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

FOCUS_M, F_NUMBER = 2.0, 1.8
_TINY = (8, 8, 1)  # pixels and samples


def main(plan_file: str, result_file: str) -> None:
    """Run the plan; prints the share that is done, and what is wrong with a shader."""
    bpy = _blender()
    plan, found = json.loads(Path(plan_file).read_text(encoding="utf-8")), {}
    total = sum((s["rounds"] + 1) * len(s["cameras"]) for s in plan["scenes"].values())
    done = 0
    for name, wanted in plan["scenes"].items():
        scene = _scene(bpy, name == "real")
        cameras = {c["name"]: _camera(bpy, scene, c) for c in plan["cameras"] if c["name"] in wanted["cameras"]}
        times: dict[str, dict[str, list[float]]] = {camera: {"full": [], "tiny": []} for camera in cameras}
        full = (*wanted["size"], wanted["samples"])
        for number in range(wanted["rounds"] + 1):
            for camera, its_times in times.items():
                scene.camera = cameras[camera]
                seconds = {kind: _render(bpy, scene, size) for kind, size in (("tiny", _TINY), ("full", full))}
                for kind, value in seconds.items():
                    if number:  # the first warms up
                        its_times[kind].append(value)
                done += 1
                print(f"\nshare {done / total:.4f}", flush=True)
        found[name] = times
    Path(result_file).write_text(json.dumps({"blender": bpy.app.version_string, "scenes": found}), encoding="utf-8")


def _blender() -> Any:
    """Blender as a module; its compiler of shaders wants what lies in its own folder."""
    found = importlib.util.find_spec("bpy")
    if found is None or found.origin is None:
        raise SystemExit("no module bpy")
    places = Path(found.origin).parent.glob("*/python/lib/python*/site-packages")
    sys.path += [str(p) for p in places if (p / "oslquery").is_dir()]
    import bpy

    return bpy


def _scene(bpy: Any, real: bool) -> Any:
    """A white sky, or meshes on a floor, lit by lamps; one thread of Cycles, nothing adaptive."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine, cycles = "CYCLES", scene.cycles
    cycles.device, cycles.shading_system = "CPU", True
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces = 4
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.world = bpy.data.worlds.new("sky")
    level = 0.1 if real else 1.0
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (level, level, level, 1.0)
    if real:
        _furnish(bpy)
    return scene


def _furnish(bpy: Any) -> None:
    """A floor, six smooth heads, and three lamps, from 1 to 5 m before the camera."""
    bpy.ops.mesh.primitive_plane_add(size=20, location=(0, -0.6, -3), rotation=(-math.pi / 2, 0, 0))
    for k in range(6):
        place = (0.5 * (k % 3 - 1), -0.2 + 0.4 * (k // 3), -1.4 - 1.8 * (k // 3))
        bpy.ops.mesh.primitive_monkey_add(size=0.4, location=place, rotation=(0.0, 0.4 * k, 0.0))
        bpy.ops.object.modifier_add(type="SUBSURF")
        bpy.context.object.modifiers[0].render_levels = 1
        paint = bpy.data.materials.new(f"paint {k}")
        paint.use_nodes = True
        inputs = paint.node_tree.nodes["Principled BSDF"].inputs
        inputs["Base Color"].default_value = (0.2 + 0.1 * k, 0.5, 0.9 - 0.1 * k, 1.0)
        inputs["Roughness"].default_value = 0.1 + 0.1 * k
        bpy.context.object.data.materials.append(paint)
    for place, watts in (((2, 3, 0), 150), ((-3, 2, -2), 100), ((0, 4, -5), 200)):
        bpy.ops.object.light_add(type="AREA", radius=1.0, location=place, rotation=(-math.pi / 2, 0, 0))
        bpy.context.object.data.energy = watts


def _camera(bpy: Any, scene: Any, wanted: dict[str, Any]) -> Any:
    """A camera at the origin that looks along -z, focused on `FOCUS_M` at `F_NUMBER`."""
    data = bpy.data.cameras.new(wanted["name"])
    camera = bpy.data.objects.new(wanted["name"], data)
    scene.collection.objects.link(camera)
    data.lens, data.sensor_width, data.clip_start = wanted["focal_mm"], 36.0, 1e-3
    data.dof.use_dof, data.dof.focus_distance, data.dof.aperture_fstop = wanted["depth_of_field"], FOCUS_M, F_NUMBER
    if wanted["shader"] is not None:
        from cycles.osl import update_custom_camera_shader

        text = bpy.data.texts.new(wanted["name"])
        text.from_string(wanted["shader"])
        data.type, data.custom_mode, data.custom_shader = "CUSTOM", "INTERNAL", text
        if not update_custom_camera_shader(data, lambda kinds, message: print(message, file=sys.stderr)):
            raise SystemExit(f"the shader of {wanted['name']} does not compile")
    return camera


def _render(bpy: Any, scene: Any, size: tuple[int, int, int]) -> float:
    """Seconds of CPU of a picture."""
    scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples = size
    scene.render.resolution_percentage = 100
    began = time.process_time()
    bpy.ops.render.render()
    return time.process_time() - began


if __name__ == "__main__":
    main(*sys.argv[1:])
