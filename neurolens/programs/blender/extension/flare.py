"""Lists the scene's lamps, and its meshes that shine, frame by frame for `neurolens flare`.

Irradiance is on the scale of the picture: in Cycles, too, a white card across the way of a light has the radiance
irradiance / pi. How much of a light shows is found by rays, so that it dims smoothly as an edge passes before it.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from . import camera as on_camera, lights
from .library import LensError
from .panel import _Operator

_MOST_PASSED = 64  # surfaces that no camera sees, which a ray passes on its way
_WIDEST = math.pi / 4  # half angle: a mesh that shines and is wider counts as surroundings
_SHINE = {"EMISSION": ("Color", "Strength"), "BSDF_PRINCIPLED": ("Emission Color", "Emission Strength")}
_KINDS: dict[str, lights.Kind] = {"SUN": "distant", "AREA": "rectangle", "POINT": "sphere", "SPOT": "sphere"}


def _seen(data: Any, frame: Any, eye: Any) -> tuple[lights.Seen, Any]:
    """Return a light of Blender with the frame [4, 4] as seen from a place, and its irradiance there [3]."""
    kind = _KINDS[data.type]
    size: tuple[float, ...] = (data.angle if kind == "distant" else data.shadow_soft_size,)
    if data.type == "AREA":
        size = (data.size, data.size_y if data.shape in ("RECTANGLE", "ELLIPSE") else data.size)
        kind = "disc" if data.shape in ("DISK", "ELLIPSE") else kind
    seen = lights.see(kind, frame, size, data.normalize, eye)
    power = seen.irradiance * data.energy * 2.0**data.exposure / (1.0 if kind == "distant" else math.pi)
    if data.type == "AREA" and (half := data.spread / 2) < 0.4999 * math.pi:
        across = math.sqrt(max(1 - seen.cos**2, 0.0)) / max(seen.cos, 1e-9)
        power *= max(math.tan(half) - across, 0.0) / max(math.tan(half) - half, 1e-9)
    if data.type == "SPOT":
        edge = math.cos(data.spot_size / 2)
        t = min(max((seen.cos - edge) / max((1 - edge) * data.spot_blend, 1e-9), 0.0), 1.0)
        power *= t * t * (3 - 2 * t)
    return seen, power * np.array(data.color) * np.array(data.temperature_color if data.use_temperature else 1.0)


def _radiance(material: Any) -> Any:
    """Return the radiance [3] of a material; None where a texture, or more than one node, decides it."""
    nodes = material.node_tree.nodes if material and material.node_tree else ()
    pairs = [[node.inputs[name] for name in _SHINE[node.type]] for node in nodes if node.type in _SHINE]
    shining = [pair for pair in pairs if all(s.is_linked or np.atleast_1d(s.default_value)[:3].any() for s in pair)]
    if not shining:
        return np.zeros(3)
    colour, strength = shining[0]
    to = [link.to_node.type for output in colour.node.outputs for link in output.links]
    if len(shining) > 1 or colour.is_linked or strength.is_linked or to != ["OUTPUT_MATERIAL"]:
        return None
    return strength.default_value * np.array(colour.default_value[:3])


def _shining_faces(thing: Any, frame: Any, radiance_of: Callable[[Any], Any]) -> tuple[Any, Any, set[int]] | None:
    """Return the triangles [N, 3, 3] of a mesh that shine, their radiances [N, 3], and the numbers of their faces."""
    found, mesh = [radiance_of(slot.material) for slot in thing.material_slots], thing.data
    radiance = np.array([np.zeros(3) if one is None else one for one in found])
    if not radiance.any():
        return None
    mesh.calc_loop_triangles()
    own = [radiance[min(part.material_index, len(found) - 1)] for part in mesh.loop_triangles]
    lit = [(part, one) for part, one in zip(mesh.loop_triangles, own, strict=True) if one.any()]
    place = np.array([[mesh.vertices[k].co for k in part.vertices] for part, _ in lit]).reshape(-1, 3, 3)
    place = place @ frame[:3, :3].T + frame[:3, 3]
    return place, np.array([one for _, one in lit]).reshape(-1, 3), {part.polygon_index for part, _ in lit}


def _is_free(scene: Any, graph: Any, start: Any, end: Any, near: float, light: Any, own: set[int]) -> bool:
    """Return whether the way between two points is free, beyond `near` from the first.

    What counts is what cameras see, but not the light's own faces.
    """
    left = float(np.linalg.norm(end - start))
    way, done = (end - start) / left, near
    for _ in range(_MOST_PASSED):
        if done >= left:
            break
        from_ = start + done * way
        hit, point, _normal, face, thing, _frame = scene.ray_cast(graph, from_.tolist(), way, distance=left - done)
        if not hit or (thing.visible_camera and not thing.hide_render):
            return not hit or (face in own and thing.original == light.original)
        done += float(np.linalg.norm(np.array(point) - from_)) * (1 + 1e-5) + 1e-6 * left
    return True


def rows_now(context: Any, found: Any, frame: int, rays: int) -> Iterator[lights.Row]:
    """Yield the rows of all lights that renders show, at the scene's present frame."""
    scene, graph = context.scene, context.evaluated_depsgraph_get()
    view = np.array(found.evaluated_get(graph).matrix_world)
    eye, setting = view[:3, 3], on_camera.setting_of(scene, found)
    opened = setting.f_number or (found.data.dof.aperture_fstop if found.data.dof.use_dof else math.inf)
    across = found.data.lens / (2000 * opened * setting.lens_unit_m)
    pupil = across * (view[:3, :2] / np.linalg.norm(view[:3, :2], axis=0)).T
    radiance_of = cache(_radiance)
    for instance in graph.object_instances:
        light, place = instance.object, np.array(instance.matrix_world)
        faces = _shining_faces(light, place, radiance_of) if light.type == "MESH" else None
        if light.hide_render or not (faces or light.type == "LIGHT"):
            continue
        seen, rgb = lights.see_faces(*faces[:2], eye) if faces else _seen(light.data, place, eye)
        own = faces[2] if faces else set[int]()
        if faces and not (own and seen.half_rad < _WIDEST):
            continue
        number = "".join(f".{k}" for k in instance.persistent_id[:2]) if instance.is_instance else ""
        pairs = zip(*lights.ends(seen, eye, pupil, rays), strict=True)
        lit = rgb.any() and (seen.middle - eye) @ view[:3, 2] < 0
        shown = [_is_free(scene, graph, *pair, found.data.clip_start, light, own) for pair in pairs] if lit else [False]
        rgb *= scene.cycles.film_exposure
        yield lights.row(light.name + number, frame, seen, view, setting.lens_unit_m, rgb, sum(shown) / len(shown))


def write_lights(context: Any, found: Any, path: Path, rays: int) -> tuple[int, str]:
    """Write the lights of all frames of the scene, and the keys of a camera that carries a lens (to PATH.keys.json).

    Returns how many lights there are, and the arguments of `neurolens flare` for them.

    Raises:
        LensError: there is no light, or no such folder.
    """
    scene, known, keys = context.scene, dict[str, list[lights.Row]](), list[dict[str, Any]]()
    before, frames = scene.frame_current, range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
    custom = found.data.cycles_custom if on_camera.applied(found.data) else {}
    try:
        for frame in frames:
            scene.frame_set(frame)
            for row in rows_now(context, found, frame, rays):
                known.setdefault(str(row["light"]), []).append(row)
            setting = on_camera.setting_of(scene, found)
            values = {
                "focus": setting.focus_m,
                "f-number": setting.f_number,
                "zoom": custom.get("zoom_mm"),
                **{f"film-{name}": custom.get(name) for name in ("tilt", "swing")},
            }
            moved = (part * side for part, side in zip(setting.shift, setting.sensor_mm, strict=True))
            values |= dict(zip(("film-shift", "film-rise"), moved, strict=True))
            keys.append({"frame": frame} | {name: value for name, value in values.items() if value is not None})
    finally:
        scene.frame_set(before)
    if not known:
        raise LensError("The scene has no light that is rendered")
    files = {path: [row for rows in known.values() for row in lights.in_every_frame(rows, frames)]}
    width, height = setting.sensor_mm
    words = (
        f"--lights {shlex.quote(path.name)} --frames {frames[0]}:{frames[-1]}:{frames.step} --film {width:g}x{height:g}"
    )
    words += f" --width {setting.pixels}"
    if custom:
        files[path.with_suffix(".keys.json")] = keys
        lens = shlex.quote(found.data.neurolens.on.partition("/")[0])
        words = f"{lens} {words} --key {shlex.quote(path.stem + '.keys.json')}"
    try:
        for file, content in files.items():
            file.write_text(json.dumps(content, indent=1), encoding="utf-8")
    except OSError as error:
        raise LensError(f"{error.filename or path} cannot be written: {error.strerror or error}") from None
    return len(known), words


def left_out(scene: Any) -> list[str]:
    """Return the names of materials that shine by a texture or a mixture of nodes, and so are not in the list."""
    slots = (slot.material for item in scene.objects if not item.hide_render for slot in item.material_slots)
    return sorted({material.name for material in slots if _radiance(material) is None})


class NEUROLENS_OT_write_lights(_Operator):
    """Write the scene's lights in all frames, and how much of each shows, for `neurolens flare --lights`"""

    bl_idname, bl_label = "neurolens.write_lights", "Write Lights for Flare"
    __annotations__ = {
        "filepath": bpy.props.StringProperty(name="File", subtype="FILE_PATH", default="//lights.json"),
        "rays": bpy.props.IntProperty(name="Rays", description="To each light", default=64, min=1, max=4096),
    }

    def act(self, context: Any, found: Any, props: Any) -> None:
        path = Path(bpy.path.abspath(self.filepath)).with_suffix(".json")
        count, words = write_lights(context, found, path, self.rays)
        self.report({"INFO"}, f"{count} lights in {path}: neurolens flare {words} -o flare.exr")
        if names := left_out(context.scene):
            why = f"emission of {', '.join(names[:9])}, which a texture or several nodes decide"
            self.report({"WARNING"}, f"Left out, as the world is: {why}; flare --image finds it in a plate")


CLASSES = (NEUROLENS_OT_write_lights,)
