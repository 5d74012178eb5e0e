"""Renders for `osl_speed` by Blender's own Python, which has no neurolens: PLAN.json RESULT.json.

The plan holds `cameras`, each with `name`, `focal_mm`, `depth_of_field` and `shader`, the text of one in OSL or null
for the camera that Blender has, and `scenes` by name, each with `size` (pixels), `samples`, `rounds` and names of
`cameras`. Cameras of a scene render in turn; the result is, by scene and camera, `full` and `tiny`: seconds of CPU of
the pictures, and of pictures of a few rays, which is what Cycles takes to begin. `noise` is a plan of `osl_noise`.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

FOCUS_M, F_NUMBER = 2.0, 1.8
_TINY = (8, 8, 1)  # pixels and samples
_LIGHTS = ((1.0, 0.62, 0.25), (0.3, 0.75, 1.0), (1.0, 0.2, 0.25), (0.45, 1.0, 0.4), (1.0, 0.85, 0.6))


def main(plan_file: str, result_file: str) -> None:
    """Run the plan; prints the share that is done, and what is wrong with a shader."""
    # On one core Blender starts no threads beside its renderer's: idle ones spin, and their time would count.
    if hasattr(os, "sched_setaffinity"):  # of Linux
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    bpy = _blender()
    plan, found = json.loads(Path(plan_file).read_text(encoding="utf-8")), {}
    shots = plan.get("shots", [])
    total = sum((s["rounds"] + 1) * len(s["cameras"]) for s in plan["scenes"].values()) + len(shots)
    done = 0
    for name, wanted in plan["scenes"].items():
        scene = _scene(bpy, name)
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
    seconds = {}
    scene = _evening(bpy) if shots else None
    for shot in shots:
        seconds[shot["name"]] = _shoot(bpy, scene, shot)
        done += 1
        print(f"\nshare {done / total:.4f}", flush=True)
    result = {"blender": bpy.app.version_string, "scenes": found, "shots": seconds}
    if "noise" in plan:
        result["noise"] = _noise(bpy, plan["noise"], plan["cameras"], Path(result_file).with_suffix(".exr"))
    Path(result_file).write_text(json.dumps(result), encoding="utf-8")


def _blender() -> Any:
    """Blender as a module; its compiler of shaders wants what lies in its own folder."""
    found = importlib.util.find_spec("bpy")
    if found is None or found.origin is None:
        raise SystemExit("no module bpy")
    places = Path(found.origin).parent.glob("*/python/lib/python*/site-packages")
    sys.path += [str(p) for p in places if (p / "oslquery").is_dir()]
    import bpy

    return bpy


def _noise(bpy: Any, plan: dict[str, Any], cameras: list[dict[str, Any]], file: Path) -> list[dict[str, Any]]:
    """Rows of noise at equal samples and of what adaptive sampling takes, by scene, pattern of samples and camera."""
    import numpy as np

    rows, (width, height), most, edge = [], plan["size"], plan["most"], plan["edge"]
    total, inside = len(plan["scenes"]) * len(plan["patterns"]) * len(cameras), np.s_[edge:-edge, edge:-edge]
    for name in plan["scenes"]:
        scene = _scene(bpy, name)
        _flicker(bpy)
        scene.view_layers[0].cycles.pass_debug_sample_count = True
        settings, cycles = scene.render.image_settings, scene.cycles
        if hasattr(settings, "media_type"):  # from Blender 5.0
            settings.media_type = "MULTI_LAYER_IMAGE"
        settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
        scene.render.filepath, cycles.pixel_filter_type = str(file), "BOX"

        def picture(samples: int, seed: int, adaptive: bool, scene: Any = scene) -> tuple[Any, Any]:
            scene.cycles.seed, scene.cycles.use_adaptive_sampling = seed, adaptive
            _render(bpy, scene, (width, height, samples), write_still=True)
            planes = _planes(file)
            rgb = np.stack([planes[f"ViewLayer.Combined.{c}"] for c in "RGB"], 2).astype(float)[inside]
            taken = (
                planes.get("ViewLayer.Debug Sample Count.X", np.ones((height, width))) * most
            )  # written as shares of the largest
            if adaptive and np.abs(taken / 16 - np.rint(taken / 16)).max() > 0.01:  # Cycles looks at every 16th
                raise SystemExit(f"no pixel took {most} samples")
            return rgb, taken[inside]

        made = {c["name"]: _camera(bpy, scene, c) for c in cameras}
        exact = {}
        for scene.camera in made.values():
            exact[scene.camera.name] = picture(plan["reference"], 10_000, False)[0]
        for cycles.sampling_pattern in plan["patterns"]:
            for camera, scene.camera in made.items():
                mean, noise, median = exact[camera].mean(), {}, {}
                for samples in plan["samples"]:
                    off = [picture(samples, seed, False)[0] / mean - exact[camera] / mean for seed in plan["seeds"]]
                    noise[samples] = [float(v) for v in np.sqrt(np.square(off).mean((0, 1, 2)))]
                    median[samples] = float(np.median(np.sqrt(np.square(off).mean((0, 3)))))
                row = {"scene": name, "pattern": cycles.sampling_pattern, "camera": camera}
                row |= {"noise": noise, "median": median}
                for cycles.adaptive_threshold in plan["thresholds"]:
                    found = [picture(most, seed, True) for seed in plan["seeds"]]
                    off = [rgb / mean - exact[camera] / mean for rgb, _ in found]
                    at = f"{cycles.adaptive_threshold:.3g}"
                    row[f"samples {at}"] = float(np.mean([taken for _, taken in found]))
                    row[f"noise {at}"] = float(np.sqrt(np.square(off).mean()))
                rows.append(row)
                print(f"\nshare {len(rows) / total:.4f}", flush=True)
    return rows


def _planes(file: Path) -> dict[str, Any]:
    """The channels of all parts of an EXR, by name."""
    import OpenImageIO  # of Blender

    picture: Any = OpenImageIO.ImageInput.open(str(file))
    planes: dict[str, Any] = {}
    part = 0
    while picture.seek_subimage(part, 0):
        names = picture.spec().channelnames
        planes |= zip(names, picture.read_image(part, 0, 0, len(names), "float").transpose(2, 0, 1), strict=True)
        part += 1
    picture.close()
    return planes


def _flicker(bpy: Any) -> None:
    """A patch of noise in the picture's corner that lights nothing, and on which adaptive sampling does not end."""
    bpy.ops.mesh.primitive_plane_add(size=0.16, location=(0.64, 0.41, -2.0))
    patch = bpy.context.object
    for way in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(patch, f"visible_{way}", False)
    paint = _paint(bpy, (0.0, 0.0, 0.0), 1.0, 1.0)
    nodes, links = paint.node_tree.nodes, paint.node_tree.links
    noise, place = (nodes.new(f"ShaderNode{kind}") for kind in ("TexWhiteNoise", "NewGeometry"))
    power, bright = (nodes.new("ShaderNodeMath") for _ in range(2))
    power.operation, power.inputs[1].default_value = "POWER", 100.0
    bright.operation, bright.inputs[1].default_value = "MULTIPLY", 1e6
    links.new(place.outputs["Position"], noise.inputs["Vector"])
    links.new(noise.outputs["Value"], power.inputs[0])
    links.new(power.outputs[0], bright.inputs[0])
    links.new(bright.outputs[0], nodes["Principled BSDF"].inputs["Emission Strength"])
    nodes["Principled BSDF"].inputs["Emission Color"].default_value = (1.0, 1.0, 1.0, 1.0)


def _scene(bpy: Any, name: str) -> Any:
    """A white sky; open, meshes on a floor, lit by lamps; or these in a room, with the bounces of light that Blender
    begins with. One thread of Cycles, nothing adaptive."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine, cycles = "CYCLES", scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    if name != "room":
        cycles.max_bounces = 4
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.world = bpy.data.worlds.new("sky")
    level = 1.0 if name == "sky" else 0.1
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (level, level, level, 1.0)
    if name != "sky":
        _furnish(bpy)
    if name == "room":
        bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 1.9, -2.8), scale=(8.0, 5.1, 9.6))
        _paint(bpy, (0.8, 0.78, 0.75))
    return scene


def _furnish(bpy: Any) -> None:
    """A floor, six smooth heads, and three lamps, from 1 to 5 m before the camera."""
    bpy.ops.mesh.primitive_plane_add(size=20, location=(0, -0.6, -3), rotation=(-math.pi / 2, 0, 0))
    for k in range(6):
        place = (0.5 * (k % 3 - 1), -0.2 + 0.4 * (k // 3), -1.4 - 1.8 * (k // 3))
        bpy.ops.mesh.primitive_monkey_add(size=0.4, location=place, rotation=(0.0, 0.4 * k, 0.0))
        bpy.ops.object.modifier_add(type="SUBSURF")
        bpy.context.object.modifiers[0].render_levels = 1
        _paint(bpy, (0.2 + 0.1 * k, 0.5, 0.9 - 0.1 * k), 0.1 + 0.1 * k)
    for place, watts in (((2, 3, 0), 150), ((-3, 2, -2), 100), ((0, 4, -5), 200)):
        bpy.ops.object.light_add(type="AREA", radius=1.0, location=place, rotation=(-math.pi / 2, 0, 0))
        bpy.context.object.data.energy = watts


def _paint(bpy: Any, colour: Any, roughness: float = 0.5, glow: float = 0.0) -> Any:
    """Give the newest object a material; one that glows is seen, and lights nothing."""
    paint = bpy.data.materials.new("paint")
    paint.use_nodes = True
    inputs = paint.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (*colour, 1.0)
    inputs["Roughness"].default_value = roughness
    inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = (*colour, 1.0), glow
    paint.cycles.emission_sampling = "NONE"
    bpy.context.object.data.materials.append(paint)
    return paint


def _evening(bpy: Any) -> Any:
    """A head between balls on a chequered floor, the subject at the origin; strings of coloured lights behind it."""
    scene = _scene(bpy, "sky")
    scene.cycles.max_bounces = 3
    scene.cycles.use_denoising, scene.cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.012, 0.018, 0.04, 1.0)
    bpy.ops.mesh.primitive_plane_add(size=60, location=(0, -0.12, -20), rotation=(-math.pi / 2, 0, 0))
    paint = _paint(bpy, (0.3, 0.3, 0.3), 0.4)
    tiles = paint.node_tree.nodes.new("ShaderNodeTexChecker")
    place = paint.node_tree.nodes.new("ShaderNodeTexCoord")
    paint.node_tree.links.new(place.outputs["Object"], tiles.inputs["Vector"])
    paint.node_tree.links.new(tiles.outputs["Color"], paint.node_tree.nodes["Principled BSDF"].inputs["Base Color"])
    tiles.inputs["Scale"].default_value = 8.0
    tiles.inputs["Color1"].default_value, tiles.inputs["Color2"].default_value = (
        (0.5, 0.45, 0.38, 1),
        (0.05, 0.05, 0.06, 1),
    )
    bpy.ops.mesh.primitive_monkey_add(size=0.2, location=(0, -0.02, 0), rotation=(-math.pi / 2, 0.35, 0.0))
    bpy.ops.object.modifier_add(type="SUBSURF")
    bpy.context.object.modifiers[0].render_levels = 2
    bpy.ops.object.shade_smooth()
    _paint(bpy, (0.75, 0.28, 0.1), 0.3)
    blue, green, yellow, red = (0.05, 0.3, 0.6), (0.1, 0.5, 0.2), (0.8, 0.6, 0.1), (0.6, 0.1, 0.2)
    balls = ((-0.2, -0.25, 0.07, blue), (0.22, -0.5, 0.09, green), (0.13, 0.12, 0.035, yellow), (-0.6, -1.2, 0.12, red))
    for x, z, radius, colour in balls:
        bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=(x, radius - 0.12, z), segments=48, ring_count=24)
        bpy.ops.object.shade_smooth()
        _paint(bpy, colour, 0.15)
    bulbs = []
    for colour in _LIGHTS:
        bpy.ops.mesh.primitive_uv_sphere_add(radius=0.025, location=(0, 0, 100), segments=16, ring_count=8)
        _paint(bpy, colour, glow=9.0)
        bulbs.append(bpy.context.object.data)
    for row in range(12):
        for k in range(41):
            bulb = bpy.data.objects.new("bulb", bulbs[(2 * k + row) % len(bulbs)])
            hang = 0.1 * math.cos(2 * math.pi * k / 5.5 + row)
            bulb.location = 0.32 * (k - 20) + 0.1 * (row % 3), 0.02 + 0.3 * row + hang, -4.0 - 0.7 * ((k + row) % 3)
            bulb.visible_diffuse = bulb.visible_glossy = False  # its reflections would be noise
            scene.collection.objects.link(bulb)
    for place, watts, size in (((1.2, 1.6, 1.0), 28, 0.8), ((-1.5, 0.8, 0.3), 8, 0.5), ((0.2, 1.2, -1.2), 10, 0.5)):
        bpy.ops.object.light_add(type="AREA", radius=size, location=place)
        lamp = bpy.context.object
        lamp.data.energy = watts
        lamp.rotation_euler = (-lamp.location).to_track_quat("-Z", "Y").to_euler()
    return scene


def _shoot(bpy: Any, scene: Any, shot: dict[str, Any]) -> float:
    """Seconds of CPU of a picture, which is written."""
    scene.camera = camera = _camera(bpy, scene, shot["camera"])
    camera.location = (0.0, 0.02, shot["focus_m"])
    camera.data.dof.focus_distance, camera.data.dof.aperture_ratio = shot["focus_m"], shot["aperture_ratio"]
    if shot["fisheye"]:
        camera.data.type = "PANO"
        panorama = camera.data if hasattr(camera.data, "panorama_type") else camera.data.cycles  # to Blender 4.5
        panorama.panorama_type = "FISHEYE_EQUISOLID"
        panorama.fisheye_lens, panorama.fisheye_fov = camera.data.lens, math.pi
    render = scene.render
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, shot["pixel_aspect"]
    render.filepath, render.image_settings.file_format = shot["file"], "PNG"
    return _render(bpy, scene, (*shot["size"], shot["samples"]), write_still=True)


def _camera(bpy: Any, scene: Any, wanted: dict[str, Any]) -> Any:
    """A camera at the origin that looks along -z, focused on `FOCUS_M` at `F_NUMBER`."""
    data = bpy.data.cameras.new(wanted["name"])
    camera = bpy.data.objects.new(wanted["name"], data)
    scene.collection.objects.link(camera)
    data.lens, data.sensor_width, data.clip_start = wanted["focal_mm"], wanted.get("sensor_mm", 36.0), 1e-3
    data.dof.use_dof, data.dof.focus_distance = wanted["depth_of_field"], FOCUS_M
    data.dof.aperture_fstop = wanted.get("f_number", F_NUMBER)
    if wanted["shader"] is not None:
        from cycles.osl import update_custom_camera_shader

        text = bpy.data.texts.new(wanted["name"])
        text.from_string(wanted["shader"])
        data.type, data.custom_mode, data.custom_shader = "CUSTOM", "INTERNAL", text
        if not update_custom_camera_shader(data, lambda kinds, message: print(message, file=sys.stderr)):
            raise SystemExit(f"the shader of {wanted['name']} does not compile")
    return camera


def _render(bpy: Any, scene: Any, size: tuple[int, int, int], write_still: bool = False) -> float:
    """Seconds of CPU of a picture."""
    scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples = size
    scene.render.resolution_percentage = 100
    began = time.process_time()
    bpy.ops.render.render(write_still=write_still)
    return time.process_time() - began


if __name__ == "__main__":
    main(*sys.argv[1:])
