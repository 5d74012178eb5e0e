"""Scenes of Mitsuba: rendered unmodified through a neurolens camera, or converted to scenes of our renderer.

Scenes of rectangles, cubes, diffuse colours and area lights can be converted, which is enough for Mitsuba's own
Cornell box, on which the two renderers are compared.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensError
from neurolens.cameras.build import Shot, make_camera
from neurolens.cameras.contract import Camera, FloatArray
from neurolens.mitsuba.library import matrix, require_mitsuba
from neurolens.mitsuba.sensor import FILM_WIDTH_MM, LIGHT_NM, PLUGIN, register
from neurolens.render.illuminants import table
from neurolens.render.scene import Scene, scene_from_tables

PASS_RAYS = 1 << 20  # of one wavefront: numpy holds some 200 bytes per ray
CORNELL_BOX = "cornell-box"


def camera(
    spec: str | Path,
    *,
    film_mm: tuple[float, float] = (FILM_WIDTH_MM, FILM_WIDTH_MM),
    focus_m: float = math.inf,
    f_number: float | None = None,
) -> Camera:
    """A camera for `render`: a model (.onnx), a lens file (.toml), "thin" or "pinhole".

    Args:
        film_mm: width and height; they have the shape of the scene's picture.
        focus_m: distance from the film to the object in focus.
        f_number: None is the widest.

    Other settings: see `neurolens.cameras.build`.

    Raises:
        InputError, ModelError: as `make_camera`.
    """
    return make_camera(spec, Shot(film_mm, focus_m, f_number, wavelength_nm=LIGHT_NM))


def load_scene(scene: str | Path | Mapping[str, Any], variant: str | None = None, **parameters: Any) -> Any:
    """A scene of Mitsuba (mi.Scene): an XML file, its own "cornell-box", or a dictionary for mi.load_dict.

    Mitsuba reads no glTF; its Blender add-on turns such a scene into XML.

    Args:
        variant: of Mitsuba; None is the current one, else llvm_ad_spectral.
        parameters: values for the $names of an XML file.

    Raises:
        NeurolensError: no Mitsuba, no LLVM; a scene that Mitsuba rejects, with its message.
        InputError: no such file, or one of another format; a scene without a sensor or an integrator.
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
    except Exception as error:  # the library raises bare RuntimeError, ours inside it with a traceback
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
        spp: samples per pixel; None is the sampler's own number.
        units_per_m: scene units in a metre.
        to_world: mi.ScalarTransform4f that places the film instead.
        sensor: index of the scene's sensor that supplies film, sampler and transform.
        progress: called with the fraction done.

    Returns: [H, W, 3] float32, linear sRGB; white light of radiance 1 everywhere gives 1 on the axis.

    Raises:
        InputError: a film of another shape or without colours, no such sensor, a place with a scale.
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
            raise InputError("mitsuba scene", "film", f"({picture.shape})", "a film of red, green and blue")
        total += picture[..., :3] * count
        if progress is not None:
            progress((start + count) / spp)
    return (total / spp).astype(np.float32)


_SKIPPED = ("type", "integrator", "sensor")
# Centres and edges of faces from -1 to 1; edge_u x edge_v is the outward normal.
_RECTANGLE = [(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]))]
_CUBE = [
    (sign * np.roll([1.0, 0, 0], axis), np.roll([0, 2.0, 0], axis), np.roll([0, 0, 2.0 * sign], axis))
    for axis in range(3)
    for sign in (1, -1)
]


def our_scene(
    description: Mapping[str, Any],
    film_mm: tuple[float, float],
    *,
    back_m: float = 0.0,
    wavelengths_nm: tuple[float, float] = (400.0, 700.0),
    triangles: bool = False,
) -> Scene:
    """A dictionary of Mitsuba, such as mi.cornell_box(), as a scene of ours: the same geometry, colours and depth.

    Args:
        description: for mi.load_dict, with a sensor; a scene unit is a metre.
        film_mm: size of the film.
        back_m: how far behind the place of Mitsuba's sensor the film stands. Its own pinhole and thin lens stand at
            that place themselves, one image distance in front of the film.
        wavelengths_nm: of the light.
        triangles: a mesh for each material instead of rectangles; lights stay rectangles.

    Raises:
        InputError: unsupported shapes, materials or lights.
    """
    named = {k: v for k, v in description.items() if k not in _SKIPPED}
    materials = {k: v for k, v in named.items() if v["type"] == "diffuse"}
    quads: list[dict[str, Any]] = []
    for name, item in named.items():
        if item["type"] in ("rectangle", "cube"):
            quads += _quads(name, item, materials)
        elif name not in materials:
            raise InputError("mitsuba scene", f"{name}.type", item["type"], "rectangle, cube or diffuse")
    flat = [q for q in quads if not triangles or "emission" in q]
    tables = {
        "camera": _camera(description, film_mm, back_m, wavelengths_nm),
        "materials": {k: {"kind": "diffuse", "reflectance": _rgb(k, v["reflectance"])} for k, v in materials.items()},
        "quads": flat,
        "meshes": [] if not triangles else [_mesh(k, [q for q in quads if q not in flat]) for k in materials],
    }
    return scene_from_tables(tables, "mitsuba scene")


def _camera(
    description: Mapping[str, Any], film_mm: tuple[float, float], back_m: float, wavelengths_nm: tuple[float, float]
) -> dict[str, Any]:
    """The camera table from Mitsuba's sensor, film and integrator."""
    sensor = description["sensor"]
    at, film, depth = matrix(sensor["to_world"]), sensor["film"], description["integrator"].get("max_depth", -1)
    position = at[:3, 3] - back_m * at[:3, 2]
    return {
        "position_m": position.tolist(),
        "look_at_m": (position + at[:3, 2]).tolist(),
        "up": at[:3, 1].tolist(),
        "focus_m": float("inf"),
        "film_width_mm": film_mm[0],
        "film_height_mm": film_mm[1],
        "width": film["width"],
        "height": film["height"],
        "wavelengths_nm": list(wavelengths_nm),
        # Mitsuba counts the segments of a path, we count the surfaces between them; -1 is no limit there.
        "max_depth": depth - 1 if depth > 1 else 1000,
    }


def _quads(name: str, item: Mapping[str, Any], materials: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A rectangle, or the faces of a cube, as tables of our quads."""
    place = matrix(item["to_world"])
    material = item["bsdf"].get("id")
    if material not in materials:
        raise InputError("mitsuba scene", f"{name}.bsdf", material or "(inline)", f"one of: {', '.join(materials)}")
    emitter = item.get("emitter")
    if emitter is not None and emitter["type"] != "area":
        raise InputError("mitsuba scene", f"{name}.emitter", emitter["type"], "area")
    quads = []
    for centre, u, v in _CUBE if item["type"] == "cube" else _RECTANGLE:
        corner = place[:3, :3] @ (centre - (u + v) / 2) + place[:3, 3]
        quad = {"corner_m": corner, "edge_u_m": place[:3, :3] @ u}
        # Rotations that Mitsuba stores as float32 leave errors of 1e-8, which would misalign walls with the axes.
        quad = {k: x.round(6).tolist() for k, x in {**quad, "edge_v_m": place[:3, :3] @ v}.items()}
        light = {} if emitter is None else {"emission": _rgb(name, emitter["radiance"])}
        quads.append({**quad, "material": material, **light})
    return quads


def _mesh(material: str, quads: list[dict[str, Any]]) -> dict[str, Any]:
    """Two triangles for each rectangle of a material."""
    vertices: list[Any] = []
    faces: list[list[int]] = []
    for quad in quads:
        if quad["material"] == material:
            corner, u, v = (np.array(quad[k]) for k in ("corner_m", "edge_u_m", "edge_v_m"))
            k = len(vertices)
            vertices += [x.tolist() for x in (corner, corner + u, corner + u + v, corner + v)]
            faces += [[k, k + 1, k + 2], [k, k + 2, k + 3]]
    return {"material": material, "vertices_m": vertices, "faces": faces}


def _rgb(name: str, colour: Mapping[str, Any]) -> list[float]:
    if colour.get("type") != "rgb":
        raise InputError("mitsuba scene", f"{name}: colour", colour.get("type", "(missing)"), "rgb")
    value = np.broadcast_to(np.asarray(colour["value"], np.float64), 3)
    return [float(x) for x in value]


def with_our_spectra(description: Mapping[str, Any]) -> dict[str, Any]:
    """The dictionary with every RGB colour as the spectrum that our renderer makes of it, for spectral variants.

    Mitsuba turns RGB into other spectra of the same colour (Jakob and Hanika 2019), which differ once light has met two
    coloured surfaces. Reflectances are sums of Mallett and Yuksel's basis, lights the same times D65 of luminance 1.
    """

    def replaced(item: Any, light: bool) -> Any:
        if not isinstance(item, Mapping):
            return item
        if item.get("type") == "rgb":
            return _spectrum(np.asarray(_rgb("", item)), light)
        return {k: replaced(v, light or k in ("radiance", "emitter")) for k, v in item.items()}

    return {k: replaced(v, False) for k, v in description.items()}


def _spectrum(rgb: NDArray[np.float64], light: bool) -> dict[str, Any]:
    basis = np.stack([table(name) for name in ("red", "green", "blue")])
    values = rgb @ (basis / basis.sum(axis=0))
    if light:
        values = values * table("d65") * (table("y").sum() / (table("y") * table("d65")).sum())
    nm = table("wavelength_nm")
    text = ", ".join(f"{v:.7g}" for v in values)
    return {"type": "regular", "wavelength_min": float(nm[0]), "wavelength_max": float(nm[-1]), "values": text}
