"""neurolens cameras in Mitsuba 3: its scenes, unmodified, through a lens or model (extra "mitsuba").

    import mitsuba as mi
    import neurolens.programs.mitsuba as nm
    from neurolens.cameras.build import make_camera
    from neurolens.optics.lens.shot import Shot

    mi.set_variant("llvm_ad_spectral")
    camera = make_camera("models/laikin_double_gauss_50.ols-64.onnx", Shot((36.0, 36.0), focus_m=3.9, f_number=2.0))
    picture = nm.render(mi.cornell_box(), camera, spp=64)

or, in a scene (`<sensor type="neurolens">` in XML), after `nm.register()`:

    {"type": "neurolens", "camera": "models/NAME.onnx", "focus_m": 3.9, "f_number": 2.0, "to_world": ..., "film": ...}

Mitsuba itself is imported by the functions, not with this package.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError, NeurolensError
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.programs.mitsuba.sensor import PLUGIN, matrix, register, require_mitsuba

__all__ = ["load_scene", "register", "render", "require_mitsuba"]
PASS_RAYS = 1 << 20  # in one wavefront: numpy holds some 200 bytes per ray
CORNELL_BOX = "cornell-box"


def load_scene(scene: str | Path | Mapping[str, Any], variant: str | None = None, **parameters: Any) -> Any:
    """Load a scene of Mitsuba (mi.Scene): an XML file, its own "cornell-box", or a dictionary for mi.load_dict.

    Mitsuba reads no glTF; its Blender add-on turns such a scene into XML.

    Args:
        variant: Mitsuba's; None takes the current one, else llvm_ad_spectral.
        parameters: values for the $names of an XML file.

    Raises:
        NeurolensError: Mitsuba or LLVM is missing, or Mitsuba rejects the scene, with its message.
        InputError: there is no such file, or it has another format; the scene has no sensor or no integrator.
    """
    mi = require_mitsuba(variant)
    register()
    if isinstance(scene, Mapping):
        name, load = "dictionary", lambda: mi.load_dict(dict(scene))
    elif str(scene) == CORNELL_BOX:
        name, load = CORNELL_BOX, lambda: mi.load_dict(mi.cornell_box())
    else:
        name = str(scene)
        if Path(scene).suffix.lower() != ".xml" or not Path(scene).is_file():
            found = Path(scene).suffix or str(scene) if Path(scene).is_file() else "(missing)"
            raise InputError(scene, "file", found, f"a scene of Mitsuba (.xml), or {CORNELL_BOX}")
        load = lambda: mi.load_file(str(scene), **parameters)  # noqa: E731
    try:
        loaded = load()
    except Exception as error:  # the library raises bare RuntimeError, with ours inside it and a traceback
        ours = re.findall(r"^(?:InputError|ModelError): (.*)", str(error), re.MULTILINE)
        reason = ours[-1] if ours else " ".join(str(error).split())
        raise NeurolensError(f"mitsuba scene {name}: {reason}") from error
    if not isinstance(loaded, mi.Scene):
        raise InputError(name, "type", type(loaded).__name__, "a scene")
    for part, there in (("sensor", loaded.sensors()), ("integrator", loaded.integrator())):
        if not there:
            raise InputError(name, part, "(missing)", "a scene that has one")
    return loaded


def render(
    scene: Any,
    camera: Camera,
    *,
    spp: int | None = None,
    seed: int = 0,
    units_per_m: float = 1.0,
    to_world: Any = None,
    sensor: int = 0,
    progress: Callable[[float], None] | None = None,
) -> FloatArray:
    """Render a scene with its own integrator, film and sampler, with `camera` in the place of its camera.

    Args:
        scene: mi.Scene, or what `load_scene` takes.
        camera: any of our contract; the film has the shape of the scene's picture. Its plane stands at the origin of
            the scene's sensor.
        spp: samples per pixel; None takes the sampler's own number.
        units_per_m: scene units in a metre.
        to_world: mi.ScalarTransform4f that places the film, in place of the sensor's.
        sensor: index of the scene's sensor that supplies film, sampler and transform.
        progress: called with the fraction done.

    Returns: [H, W, 3] float32, linear sRGB; white light of radiance 1 everywhere gives 1 on the axis.

    Raises:
        InputError: the film has another shape or no colours, there is no such sensor, or its place has a scale.
    """
    mi = require_mitsuba()
    made = register()
    if not isinstance(scene, mi.Scene):
        scene = load_scene(scene)
    sensors = scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise InputError("mitsuba scene", "sensor", sensor, f"from 0 to {len(sensors) - 1}")
    own = sensors[sensor]
    props = mi.Properties(PLUGIN)
    props["film"], props["sampler"], props["units_per_m"] = own.film(), own.sampler(), units_per_m
    props["to_world"] = mi.ScalarTransform4f(matrix(own.world_transform())) if to_world is None else to_world
    lens = made(props, camera)
    width, height = own.film().crop_size()
    spp = int(own.sampler().sample_count()) if spp is None else spp
    if spp < 1:
        raise InputError("render", "spp", spp, "an integer above 0")
    each = max(1, PASS_RAYS // int(width * height))
    total = np.zeros((int(height), int(width), 3))
    for number, start in enumerate(range(0, spp, each)):
        count = min(each, spp - start)
        picture = np.array(mi.render(scene, sensor=lens, spp=count, seed=seed + (number << 16)), np.float32)
        if picture.ndim != 3 or picture.shape[2] < 3:
            raise InputError("mitsuba scene", "film", picture.shape, "a film of red, green and blue")
        total += picture[..., :3] * count
        if progress is not None:
            progress((start + count) / spp)
    return (total / spp).astype(np.float32)
