"""Puts a lens on a camera and takes it off; what is changed is first written down on the camera and the scene.

The shader's text and its compiled form are kept in the .blend file, and its settings are the custom camera's own
properties. So the file renders where the extension is missing, and keyframes and drivers act on the settings directly.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import bpy

from .library import FEW, PASSES, LensError, LensFacts, Setting, Variant, fitting_width_mm, refusals, refused

# What `apply` changes in the camera and in the scene; the scene's first camera of this extension keeps the scene's.
_CAMERA = (
    "type", "custom_mode", "custom_filepath", "custom_bytecode", "custom_bytecode_hash",
    "sensor_fit", "sensor_width", "sensor_height", "lens",
)  # fmt: skip
_RAYS = (24, 14)  # across and down, to find the depths in view
_TEXT = "neurolens "  # how the names of our shaders in a file begin
_ZOOM = 'cycles_custom["zoom_mm"]'


def camera_of(context: Any) -> Any:
    """Return the camera object that operators act on: the panel's, else the scene's.

    Raises:
        LensError: there is none, or it belongs to another file.
    """
    shown = context.object if getattr(context, "camera", None) is not None else None
    found = shown if shown is not None and shown.type == "CAMERA" else context.scene.camera
    if found is None:
        raise LensError("The scene has no camera: add one (Add > Camera), and make it the scene's")
    if found.type != "CAMERA":
        raise LensError(f"The scene's camera {found.name!r} is not a camera, but of type {found.type}")
    if found.data.library is not None:
        raise LensError(f"The camera {found.name!r} is linked from another file: make it local first")
    return found


def applied(camera: Any) -> bool:
    """Return whether camera data carry a lens of the extension."""
    return bool(camera.neurolens.before) and camera.type == "CUSTOM"


def setting_of(scene: Any, found: Any) -> Setting:
    """Return the scene's settings for a lens on this camera object."""
    camera, render = found.data, scene.render
    custom = camera.cycles_custom if applied(camera) else {}
    f_number = float(custom["f_number"]) if "f_number" in custom else None
    # the shader's own focus, which rules if it is above 0
    own = float(custom["focus_m"]) if "focus_m" in custom else 0.0
    off = applied(camera) and not camera.dof.use_dof  # putting a lens on switches it on
    focus = own if own > 0 else None if off else focus_m(found)
    sensor = sensor_mm(camera, render)
    side = {"HORIZONTAL": sensor[0], "VERTICAL": sensor[1]}.get(camera.sensor_fit, max(sensor))
    unit = scene.unit_settings.scale_length if scene.unit_settings.system != "NONE" else 1.0
    # Until the lens is on, its scale is the scene's, which it will take; shaders of earlier versions take metres.
    lens_unit = float(custom.get("unit_m", 1.0)) if applied(camera) else unit
    return Setting(
        sensor_mm=sensor,
        pixels=max(1, round(render.resolution_x * render.resolution_percentage / 100)),
        focus_m=focus if focus is None or own > 0 else focus * lens_unit,
        focus_object="" if own > 0 or camera.dof.focus_object is None else camera.dof.focus_object.name,
        f_number=f_number,
        shift=(camera.shift_x, camera.shift_y),
        shift_side_mm=side,
        stereo=_stereo(camera, render),
        turned=any(custom.get(name) for name in ("tilt", "swing")),
        unit_m=unit,
        lens_unit_m=lens_unit,
        on_gpu=_on_other_gpu(scene),
        darkens=bool(custom.get("vignetting", 1)) or bool(custom.get("exposure", 0)),
        passes=_passes(scene),
        samples=int(scene.cycles.samples) if custom.get("dispersion") == 2 and "few" in custom else None,
    )


def _stereo(camera: Any, render: Any) -> tuple[float, ...]:
    """Return what stereo adds to shift X for the left and for the right eye, as Blender computes it."""
    stereo = camera.stereo
    off_axis = stereo.convergence_mode == "OFFAXIS" and render.use_multiview and render.views_format == "STEREO_3D"
    if not off_axis:
        return ()
    shift = stereo.interocular_distance / stereo.convergence_distance * camera.lens / camera.sensor_width
    left, right = {"LEFT": (0.0, 1.0), "RIGHT": (1.0, 0.0)}.get(stereo.pivot, (0.5, 0.5))
    return shift * left, -shift * right


def _passes(scene: Any) -> tuple[str, ...]:
    """Return which of `PASSES` the scene renders."""
    layers = [layer for layer in scene.view_layers if layer.use]
    mattes = ("object", "material", "asset")
    asked = {
        "alpha": scene.render.film_transparent,
        "cryptomatte": any(getattr(layer, f"use_pass_cryptomatte_{kind}") for layer in layers for kind in mattes),
        "vector": any(layer.use_pass_vector for layer in layers),
    }
    return tuple(name for name in PASSES if asked[name])


def focus_m(found: Any) -> float:
    """Return the focus distance along the view, in units of the scene, as Cycles computes it."""
    dof = found.data.dof
    if dof.focus_object is None:
        return float(dof.focus_distance)
    frame = found.matrix_world.normalized()
    return abs(float((dof.focus_object.matrix_world.translation - frame.translation).dot(frame.col[2].xyz)))


def depths_in_view(context: Any, found: Any, setting: Setting, efl_mm: float) -> list[float]:
    """Return depths along the view (m) where rays of a pinhole of this focal length end; inf if they meet nothing."""
    graph = context.evaluated_depsgraph_get()
    frame = found.evaluated_get(graph).matrix_world.normalized()
    right, up, back = (frame.col[k].xyz for k in range(3))
    (width, height), (across, down), depths = setting.sensor_mm, _RAYS, []
    for k in range(across * down):
        x, y = ((k % across + 0.5) / across - 0.5) * width, ((k // across + 0.5) / down - 0.5) * height
        way = right * (x / efl_mm) + up * (y / efl_mm) - back
        hit, point, *_ = context.scene.ray_cast(graph, frame.translation, way.normalized())
        depths.append((frame.translation - point).dot(back) * setting.lens_unit_m if hit else math.inf)
    return depths


def sensor_mm(camera: Any, render: Any) -> tuple[float, float]:
    """Return width and height (mm) that the picture shows, as Cycles gives them to shaders."""
    across = render.resolution_x * render.pixel_aspect_x
    down = render.resolution_y * render.pixel_aspect_y
    fit = camera.sensor_fit
    if fit == "AUTO":
        longer = camera.sensor_width
        return (longer, longer * down / across) if across >= down else (longer * across / down, longer)
    if fit == "HORIZONTAL":
        return camera.sensor_width, camera.sensor_width * down / across
    return camera.sensor_height * across / down, camera.sensor_height


def _on_other_gpu(scene: Any) -> bool:
    if scene.cycles.device != "GPU":
        return False
    found = bpy.context.preferences.addons.get("cycles")
    return found is None or found.preferences.compute_device_type != "OPTIX"


def apply(scene: Any, found: Any, lens: LensFacts, kind: str, *, fit_sensor: bool = False) -> None:
    """Put a lens on a camera object.

    Raises:
        LensError: the lens cannot be put on; nothing has changed.
    """
    camera = found.data
    if (why := refused(bpy.app.version, bpy.app.build_options.cycles_osl)) is not None:
        raise LensError(why)
    if kind not in lens.variants:
        raise LensError(f"{lens.name} has no {kind} form here: {', '.join(lens.variants)}")
    variant, setting = lens.variants[kind], setting_of(scene, found)
    width = None
    if fit_sensor:
        width = fitting_width_mm(variant, setting)
        setting = replace(setting, sensor_mm=(width, setting.sensor_mm[1] * (width / setting.sensor_mm[0])))
    if wrong := refusals(variant, setting):
        raise LensError("; ".join(wrong))
    try:
        source = variant.path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise LensError(f"The shader {variant.path} cannot be read: {error}") from None
    memory = _remembered(scene, camera)
    try:
        _set(scene, camera, lens, variant, source, width, setting.unit_m)
    except LensError:
        _put_back(scene, camera, memory)
        raise
    if not camera.neurolens.before:
        camera.neurolens.before = json.dumps(memory["camera"])
        if not scene.neurolens_before:
            scene.neurolens_before = json.dumps(memory["scene"])
    camera.neurolens.on = f"{lens.lens_id}/{kind}"
    tell_samples(render=False)


def _set(
    scene: Any, camera: Any, lens: LensFacts, variant: Variant, source: str, width_mm: float | None, unit_m: float
) -> None:
    """Change camera and scene, and compile the shader.

    Raises:
        LensError: it does not compile.
    """
    if find_spec("oslquery") is None:  # Blender as a module (pip's bpy) does not tell Python where its own packages are
        sys.path += [str(f.parent) for f in Path(bpy.utils.resource_path("LOCAL"), "python").rglob("oslquery")]
    first, in_units = not applied(camera), "unit_m" in camera.cycles_custom
    opened = camera.dof.aperture_fstop if camera.dof.use_dof else None
    scene.render.engine = "CYCLES"
    if _on_other_gpu(scene):
        scene.cycles.device = "CPU"
    if width_mm is not None:
        render = scene.render
        across, down = (width_mm, width_mm * sensor_mm(camera, render)[1] / sensor_mm(camera, render)[0])
        camera.sensor_fit, camera.sensor_width = "AUTO", max(across, down)
    # in earlier versions it was a switch; a number keeps its choice
    if camera.cycles_custom.get("dispersion") is False:
        camera.cycles_custom["dispersion"] = 0
    camera.type, camera.custom_mode = "CUSTOM", "INTERNAL"
    old = camera.custom_shader
    camera.custom_shader = _text(f"{_TEXT}{variant.path.name}", source)
    _drop(old)
    if first and not _is_animated(camera, "lens"):
        camera.lens = max(1.0, lens.efl_mm)  # frames what the viewport shows
    camera.dof.use_dof = True  # without it Cycles does not tell shaders the focus
    _compile(camera)
    custom = camera.cycles_custom
    if "unit_m" in custom and not in_units:  # one that the user has changed stays
        custom["unit_m"] = unit_m
    if first and opened is not None and "f_number" in custom:
        custom["f_number"] = max(float(opened), variant.f_number)
    _follow_zoom(camera)


def tell_samples(render: bool, only: Any = None) -> None:
    """Tell the shaders of all cameras whether they get few samples: always in the viewport, in renders by the number.

    Files keep what is told for renders, so that they render alike without the extension. `only` is the scene that is
    rendered, since another scene with the same camera may have another number.
    """
    for scene in bpy.data.scenes if only is None else [only]:
        few = not render or scene.cycles.samples < FEW
        for camera in (o.data for o in scene.objects if o.type == "CAMERA" and applied(o.data)):
            if bool(camera.cycles_custom.get("few", few)) != few:
                camera.cycles_custom["few"] = few
                camera.update_tag()


def _text(name: str, source: str) -> Any:
    """Return a text of the file with this content; cameras with the same content share one."""
    for text in bpy.data.texts:
        if text.name.startswith(name) and text.as_string().rstrip("\n") == source.rstrip("\n"):
            return text
    text = bpy.data.texts.new(name)
    text.from_string(source)
    return text


def _compile(camera: Any) -> None:
    said: list[str] = []
    try:
        from cycles.osl import update_custom_camera_shader

        done = update_custom_camera_shader(camera, lambda kind, text: said.append(text) if "ERROR" in kind else None)
    except ImportError as error:
        raise LensError(f"Cycles cannot compile shaders here: {error}") from None
    if not done:
        raise LensError(f"The shader does not compile: {'; '.join(said) or 'see the console'}")


def _is_animated(camera: Any, path: str) -> bool:
    data = camera.animation_data
    if data is None:
        return False
    return any(driver.data_path == path for driver in data.drivers) or (data.action is not None)


def _zoom_driver(camera: Any) -> Any:
    """Return our driver of the focal length, or None."""
    for driver in camera.animation_data.drivers if camera.animation_data is not None else ():
        if driver.data_path == "lens" and any(t.data_path == _ZOOM for v in driver.driver.variables for t in v.targets):
            return driver
    return None


def _follow_zoom(camera: Any) -> None:
    """Let the focal length, which frames the viewport, follow the lens's zoom, unless it is animated itself."""
    ours, zooms = _zoom_driver(camera), "zoom_mm" in camera.cycles_custom
    if ours is not None and not zooms:
        camera.driver_remove("lens")
    elif zooms and ours is None and not _is_animated(camera, "lens"):
        driver = camera.driver_add("lens").driver
        driver.type = "SUM"  # no script: those may be forbidden
        target = driver.variables.new().targets[0]
        target.id_type, target.id, target.data_path = "CAMERA", camera, _ZOOM


def _remembered(scene: Any, camera: Any) -> dict[str, Any]:
    """Return the state of everything that `apply` changes, JSON-able."""
    kept = {
        **{name: getattr(camera, name) for name in _CAMERA},
        "custom_shader": None if camera.custom_shader is None else camera.custom_shader.name,
        "use_dof": camera.dof.use_dof,
        "custom": {k: list(v) if hasattr(v, "to_list") else v for k, v in camera.cycles_custom.items()},
    }
    return {"camera": kept, "scene": {"engine": scene.render.engine, "device": scene.cycles.device}}


def take_back(scene: Any, found: Any) -> None:
    """Take the lens off a camera object, so that everything that `apply` changed is as it was.

    The scene's render settings stay while another camera of the scene carries a lens.

    Raises:
        LensError: there is none.
    """
    camera = found.data
    if not camera.neurolens.before:
        raise LensError(f"The camera {found.name!r} carries no lens of neurolens")
    if _zoom_driver(camera) is not None:
        camera.driver_remove("lens")
    memory: dict[str, Any] = {"camera": json.loads(camera.neurolens.before)}
    others = (o.data for o in scene.objects if o.type == "CAMERA" and o.data != camera)
    if scene.neurolens_before and not any(applied(other) for other in others):
        memory["scene"] = json.loads(scene.neurolens_before)
        scene.neurolens_before = ""
    _put_back(scene, camera, memory)
    camera.neurolens.before = camera.neurolens.on = ""


def _put_back(scene: Any, camera: Any, memory: dict[str, Any]) -> None:
    text, kept = camera.custom_shader, dict(memory["camera"])
    custom, shader = kept.pop("custom"), kept.pop("custom_shader")
    camera.dof.use_dof = kept.pop("use_dof")
    camera.custom_shader = bpy.data.texts.get(shader) if shader else None
    for name, value in kept.items():
        setattr(camera, name, value)
    for name in list(camera.cycles_custom.keys()):
        del camera.cycles_custom[name]
    for name, value in custom.items():
        camera.cycles_custom[name] = value
    if before := memory.get("scene"):
        scene.cycles.device, scene.render.engine = before["device"], before["engine"]
    _drop(text)


def _drop(text: Any) -> None:
    """Remove a shader of ours that nothing uses any more."""
    ours = text is not None and text.name.startswith(_TEXT)
    if ours and not bpy.data.user_map(subset={text})[text]:
        bpy.data.texts.remove(text)
