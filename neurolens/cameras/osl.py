"""Cameras as shaders of Blender's Cycles (4.5 and later), in Open Shading Language.

The whole camera is a graph: from the place in the picture and two random numbers to a weighted ray, at any stop and
focus of the lens. Inputs of the shader (`PARAMETERS`) are numbers when the renderer compiles it, and what depends on
them alone costs nothing then. Besides them it reads, of Blender's camera, the sensor's size (with its fit and the
picture's aspect), shift and, where `focus_m` is 0, the distance of depth of field.

One of the two random numbers tells the wavelength by its low bits, which leaves both as even as they were. Its colour
weights are Bernstein's polynomials of second order: never negative, of mean 1 each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.cameragraph import D_FILM, weight_graph
from neurolens.cameras.focus_function import FOCUS, SMALLEST, Focusing, film_function
from neurolens.cameras.lens_state import squeeze_of
from neurolens.cameras.model import ModelScene
from neurolens.cameras.onnxlens import OnnxLens
from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_arcs_fit import Sight, fit_arcs
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.cameras.sampling import stratified
from neurolens.cameras.source import model_focusing
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.graph.loworder import with_film_derivatives, with_low_order_derivatives
from neurolens.graph.osl import Parameter, write_osl
from neurolens.graph.program import STOP_RADIUS
from neurolens.graph.scalars import lower
from neurolens.modelfile.graph import graph_of
from neurolens.optics.film_plane import LINE_D_NM

Array = NDArray[np.float64]
OUTPUTS = ("position", "direction", "throughput", "dPdx", "dPdy", "dDdx", "dDdy")
MAX_BLADES = 16
_FAR_M = 1e-4  # Blender's focus distance below this means that depth of field is off
_LOW_BITS = 4096.0  # of a random number: what lies below 1 / 4096 of it
_QUADRATURE = 64  # points a side of the exposure on the axis
_NEAR = 0.999  # of the near limit: rounding
# Cycles takes the mean size of derivatives, for the footprint of a pixel: their errors by output, and of all of them.
_DERIVATIVES, _WORST = 0.03, 0.05
_ACROSS, _FILM_POWERS = 16, 7  # distances and stops at which the film is placed, and powers of each
_BESIDE = 0.01  # of the film radius: near the axis
_LIGHT_NM = (400.0, 700.0)  # colours beyond would spread fringes that no eye and no film sees
Report = Callable[[float], object]
_FRAME = """\
    point raster = camera_shader_raster_position();
    vector pixel_right = Dx(raster), pixel_up = Dy(raster);
    point pair = camera_shader_random_sample();
    vector sensor = vector(36.0, 24.0, 0.0);
    getattribute("cam:sensor_size", sensor);
    float asked_m = focus_m;
    if (focus_m <= 0.0)
        getattribute("cam:focal_distance", asked_m);
    float half_turn = M_PI / max(blades, 3);
    float first_edge = radians(rotation) + half_turn;
    float raster_x = raster[0], raster_y = raster[1], first = pair[0], second = pair[1];
    float pixel_x = pixel_right[0], pixel_y = pixel_up[1], sensor_x_mm = sensor[0], sensor_y_mm = sensor[1];
    float half_cos = cos(half_turn), half_sin = sin(half_turn), edge_cos = cos(first_edge), edge_sin = sin(first_edge);
    float count = blades, in_colour = dispersion, shaded = vignetting, as_lens = exposure, at_pupil = origin;
    float warned = warn;
"""


@dataclass(frozen=True)
class OslCamera:
    """What a shader is made of.

    Attributes:
        sight: the lens. arcs: its pupil. film: its position
            (mm) by powers of stop and focus, see `_film`. near_m: nearest distance, inf where the film does not focus.
        f_number: of the widest stop. efl_mm: focal length.
        entrance_mm: z of the entrance pupil, lens frame.
    """

    sight: Sight
    arcs: PupilArcs
    film: Array
    near_m: float
    f_number: float
    efl_mm: float
    entrance_mm: float
    pupil_z_mm: float

    @property
    def nearest_m(self) -> float:
        """The distance that vergences are shares of."""
        return self.near_m if math.isfinite(self.near_m) else 1.0


def parameters(camera: OslCamera) -> list[Parameter]:
    """The inputs that a user turns, in order: f_number, focus_m, blades, roundness, rotation, exposure, vignetting,
    dispersion, origin, warn."""
    widest = float(f"{camera.f_number:.4g}")
    return [
        Parameter("f_number", "F-number", "Stop; below the widest it is the widest", widest, 0.1, 1000.0),
        Parameter("focus_m", "Focus (m)", "Distance in focus from the camera; 0 takes that of depth of field, infinity "
                  "where that is off", 0.0, 0.0, 1e6),
        Parameter("blades", "Blades", f"Of the stop, 3 to {MAX_BLADES}; 0 is round", 0, 0, MAX_BLADES),
        Parameter("roundness", "Roundness", "Of the blades: 0 straight, 1 round", 0.0),
        Parameter("rotation", "Rotation", "Of the blades in degrees", 0.0, -360.0, 360.0),
        Parameter("exposure", "Exposure", "As Blender's camera, or as the lens: its stop and what glass and focus take",
                  0, widget="mapper", options="Blender:0|Lens:1"),
        Parameter("vignetting", "Vignetting", "Darkening towards the corners", 1, widget="boolean"),
        Parameter("dispersion", "Dispersion", "Colours go their own ways", 1, widget="boolean"),
        Parameter("origin", "Origin", "What stands where Blender's camera stands, and distances are measured from",
                  1, widget="mapper", options="Film:0|Entrance pupil:1"),
        Parameter("warn", "Warn", "Magenta where the lens is unknown (beyond its film, too near), in place of black",
                  0, widget="boolean"),
    ]  # fmt: skip


def write_camera(camera: OslCamera, name: str, comment: list[str]) -> tuple[str, int]:
    """The text of a camera's shader, and the operations of one ray."""
    program = lower(osl_graph(camera))
    return write_osl(program, name, comment, parameters(camera), _FRAME, OUTPUTS), sum(program.count().values())


def osl_graph(camera: OslCamera) -> Graph:
    """The camera as a graph. Inputs are floats of `_FRAME` and the parameters, outputs `OUTPUTS` [3] each."""
    g = Graph()
    call = _Call(g, camera)
    raster = g.concat(g.input("raster_x"), g.input("raster_y"))
    square = g.concat(g.input("first"), g.input("second"))
    film = (raster - 0.5) * -call.sensor
    nanometres, colour = _light(camera, square[0], call.number("in_colour"))
    per_call = {"film_z_mm": call.film_z, "stop_radius_mm": call.stop}
    pupil = g.inline(camera.arcs.graph, {"film_mm": film, "square": square, "wavelength_nm": nanometres, **per_call})
    rays = g.concat(film, pupil["pupil_mm"], nanometres)
    found = g.inline(_with_derivatives(camera), {"rays": rays, **per_call})
    given = {"film_mm": film, **pupil, **found, "lens_status": found["status"], **per_call, **call.weighting()}
    done = g.inline(weight_graph(D_FILM), given)
    shaded = done["weight"]
    even = g.select(done["status"] <= float(st.PASSED), pupil["area_mm2"] / pupil["mean_area_mm2"], 0.0)
    weight = g.select(call.number("shaded") <= 0.5, even, shaded)
    opened = _opened(g, call, found["stop_xy_mm"])
    weight = g.select(opened, weight, 0.0)
    known = (g.square(film) <= camera.arcs.film_radius_mm**2) & call.focused
    warned = g.select(known, 0.0, call.number("warned"))
    _set_outputs(g, camera, call, film, done, colour * g.select(known, weight, 0.0), warned)
    return g


def _set_outputs(
    g: Graph, camera: OslCamera, call: _Call, film: Value, done: Mapping[str, Value], throughput: Value, warned: Value
) -> None:
    """Rays in the frame of Cycles, metres and x right, y up, z ahead; warnings as of a pinhole."""
    turned = [1.0, 1.0, -1.0]
    ahead = g.concat(film * -1.0, g.constant(camera.efl_mm))
    ahead = ahead * (1.0 / g.square(ahead).sqrt())
    ray = done["ray"]
    start = g.concat(ray[0:2], call.shift_m - ray[2])
    plain = warned <= 0.5
    g.outputs["position"] = g.select(plain, start, 0.0)
    g.outputs["direction"] = g.select(plain, ray[3:] * turned, ahead)
    g.outputs["throughput"] = g.select(plain, throughput, g.constant([1.0, 0.0, 1.0]))
    for axis, name, step in zip((0, 1), D_FILM, ("x", "y"), strict=True):
        moved = done[name] * (call.sensor[axis] * -call.number(f"pixel_{step}"))
        g.outputs[f"dPd{step}"], g.outputs[f"dDd{step}"] = moved[0:3] * turned, moved[3:] * turned


class _Call:
    """What is the same for all rays: stop, film position, exposure."""

    def __init__(self, g: Graph, camera: OslCamera) -> None:
        self.g, self.camera = g, camera
        self.sensor = g.concat(self.number("sensor_x_mm"), self.number("sensor_y_mm"))
        widest = camera.sight.stop_radius_mm
        self.stop = (camera.f_number * widest / self.number("f_number")).minimum(widest)
        at_pupil, asked = self.number("at_pupil"), self.number("asked_m")
        away = g.select(asked <= _FAR_M, 1e9, asked)
        self.film_z = g.constant(camera.sight.film_z_mm[0])
        for _ in range(2):  # distances are from the film there
            distance = away + (self.film_z - camera.entrance_mm) * at_pupil * 1e-3
            vergence = (camera.nearest_m / distance).clip(0.0, 1.0)
            self.film_z = _in_turn(g, camera.film, self.stop * (1 / widest), vergence)
        moves = math.isfinite(camera.near_m)
        self.focused = g.constant(camera.near_m * _NEAR if moves else 0.0) <= distance
        # Of the ray in the camera's frame, turned: from the film, or from the entrance pupil.
        self.shift_m = (camera.entrance_mm - self.film_z) * at_pupil * 1e-3

    def number(self, name: str) -> Value:
        return self.g.input(name, per_call=True)

    def weighting(self) -> dict[str, Value]:
        """The numbers of `weight_graph`."""
        g, camera = self.g, self.camera
        per_distance = 1.0 / (self.film_z - camera.pupil_z_mm)
        share = self.stop * (1 / camera.sight.stop_radius_mm)
        own = _in_turn(g, _exposure(camera), share, _place(camera, self.film_z)) * share * share
        nominal = math.pi / (4 * camera.f_number**2)
        exposure = g.select(self.number("as_lens") <= 0.5, own, nominal)
        return {"per_distance": per_distance, "scale": per_distance * per_distance / exposure}


def _in_turn(g: Graph, weights: Array, first: Value, then: Value) -> Value:
    """A polynomial in two numbers of the call, weights [N, M] of powers of the one and the other.

    Shaders are compiled when the stop is known, and often before the focus is: it comes last.
    """
    total: Value | None = None
    for row in weights.T[::-1]:
        part = g.series(first, row)
        total = part if total is None else total * then + part
    assert total is not None
    return total


def _place(camera: OslCamera, film_z: Value) -> Value:
    middle, half = camera.arcs.film_z_mm
    return (film_z - middle) * (1 / half)


def _light(camera: OslCamera, random: Value, in_colour: Value) -> tuple[Value, Value]:
    """Wavelength and colour weights [3] of a ray, red to blue."""
    g, (short, long) = random.graph, camera.sight.wavelength_nm
    fine = random * _LOW_BITS
    place = fine - fine.floor()
    rest = 1.0 - place
    grey = in_colour <= 0.5
    reference = min(max(LINE_D_NM, short), long)
    nanometres = g.select(grey, reference, place * (short - long) + long)
    colour = g.concat(rest * rest * 3.0, place * rest * 6.0, place * place * 3.0)
    return nanometres, g.select(grey, 1.0, colour)


def _opened(g: Graph, call: _Call, stop_xy: Value) -> Value:
    """Whether rays go through the blades; see `Aperture.opening`. Edges of fewer blades repeat."""
    point = stop_xy * (1.0 / call.stop)
    cos, sin, blades = call.number("half_cos"), call.number("half_sin"), call.number("count")
    step_cos, step_sin = cos * cos - sin * sin, cos * sin * 2.0
    edge = call.number("edge_cos"), call.number("edge_sin")
    along = None
    for _ in range(MAX_BLADES):
        here = point[0] * edge[0] + point[1] * edge[1]
        along = here if along is None else along.maximum(here)
        edge = edge[0] * step_cos - edge[1] * step_sin, edge[0] * step_sin + edge[1] * step_cos
    assert along is not None
    rise = call.number("roundness") * (1.0 - cos)
    curvature = rise * 2.0 / (sin * sin + rise * rise)
    middle = cos + rise
    limit = middle - curvature * 0.5 * (middle * middle + g.square(point))
    inside = (along * (1.0 - curvature * middle)) <= limit
    return g.select(blades <= 2.5, 1.0, g.select(inside, 1.0, 0.0))


def _samples(camera: OslCamera, count: int = 4096) -> dict[str, NDArray[np.float32]]:
    """Rays through the arcs, as inputs of the lens's graph."""
    rng, sight = np.random.default_rng(0), camera.sight
    angle, radius = 2 * np.pi * rng.random(count), 0.99 * camera.arcs.film_radius_mm * np.sqrt(rng.random(count))
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    stop = (sight.stop_radius_mm * rng.uniform(0.2, 1, count))[None]
    given = {"film_mm": film, "square": rng.random((2, count)), "stop_radius_mm": stop}
    given |= {
        "film_z_mm": rng.uniform(*sight.film_z_mm, (1, count)),
        "wavelength_nm": rng.uniform(*sight.wavelength_nm, (1, count)),
    }
    pupil = evaluate(camera.arcs.graph, given)["pupil_mm"]
    rays = np.concatenate([film, pupil, given["wavelength_nm"]])
    return {
        k: v.astype(np.float32)
        for k, v in {"rays": rays, "film_z_mm": given["film_z_mm"], "stop_radius_mm": stop}.items()
    }


def _with_derivatives(camera: OslCamera) -> Graph:
    found = with_low_order_derivatives(camera.sight.graph, _samples(camera), _DERIVATIVES, _WORST)
    return with_film_derivatives(camera.sight.graph) if found is None else found.graph


def _exposure(camera: OslCamera) -> Array:
    """Exposure on the axis over the square of the stop's share, by powers [N, M] of that share and the place."""
    sight = camera.sight
    square, nanometres = stratified(_QUADRATURE, sight.wavelength_nm)
    low, high = sight.film_z_mm
    places = np.linspace(low, high, 3) if high > low else np.array([low])
    rows, values = [], []
    for z in places:
        for share in (0.1, 0.3, 0.5, 0.7, 0.85, 1.0):
            per_distance = 1 / (z - camera.pupil_z_mm)
            call = {
                "film_z_mm": z,
                "stop_radius_mm": share * sight.stop_radius_mm,
                "per_distance": per_distance,
                "scale": per_distance**2,
            }
            given: dict[str, Any] = {k: np.array([[v]]) for k, v in call.items()}
            given |= {"film_mm": np.zeros_like(square), "square": square, "wavelength_nm": nanometres[None]}
            given |= evaluate(camera.arcs.graph, given)
            lens = evaluate(
                sight.graph,
                given | {"rays": np.concatenate([given["film_mm"], given["pupil_mm"], given["wavelength_nm"]])},
            )
            weight = evaluate(weight_graph(), given | lens | {"lens_status": lens["status"]})["weight"]
            rows.append((share, (z - camera.arcs.film_z_mm[0]) / camera.arcs.film_z_mm[1]))
            values.append(float(np.mean(weight, dtype=np.float64)) / share**2)
    return _powers(np.array(rows), np.array(values), (4, len(places)))


def _powers(at: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Least squares weights [N, M] of powers of two numbers, at places [K, 2] with values [K]."""
    a = np.stack([at[:, 0] ** i * at[:, 1] ** j for i in range(shape[0]) for j in range(shape[1])], axis=1)
    return np.asarray(np.linalg.lstsq(a, values, rcond=None)[0]).reshape(shape)


def _film(focusing: Focusing) -> Array:
    """Best focus (mm) by powers of the stop's share and of the nearest distance over the distance."""
    function = film_function([focusing])
    moves = math.isfinite(focusing.nearest_m)
    side = (1 - np.cos(np.pi * (np.arange(_ACROSS) + 0.5) / _ACROSS)) / 2
    share, vergence = (a.ravel() for a in np.meshgrid(SMALLEST + (1 - SMALLEST) * side, side if moves else [0.0]))
    nearest = focusing.nearest_m if moves else 1.0
    call = {FOCUS: nearest / np.maximum(vergence, 1e-9), STOP_RADIUS: share * focusing.stop_radius_mm}
    z = evaluate(function.graph, {name: value[None] for name, value in call.items()})["film_z_mm"][0]
    z = np.broadcast_to(z, share.shape)
    return _powers(np.stack([share, vergence], 1), z, (_FILM_POWERS, _FILM_POWERS if moves else 1))


def model_camera(model: OnnxLens, graph: Graph | None, report: Report) -> OslCamera:
    """Of an exported model in its state.

    Args:
        graph: of the model; None reads it from its file.
    """
    lens, d = model.card["lens"], model.card["domain"]
    low, high = d["film_z_mm"]
    short, long = _light_of(*map(float, d["wavelength_nm"]))
    stop = float(d["stop_radius_mm"])
    if graph is None:
        graph = graph_of(model.path, model.data, model.state if model.axes else ())
    height = _BESIDE * float(d["film_radius_mm"])
    squeeze = squeeze_of(ModelScene(model, float(low), stop), height, (short, long))
    sight = Sight(
        graph, PupilTable.of(d["bounds"]), (float(low), float(high)), (short, long), stop,
        int(lens.get("stop_surface", 0)), squeeze != 1.0,
    )  # fmt: skip
    focusing = model_focusing(model, model.state if model.axes else ())
    return osl_camera(sight, focusing, lens["f_number"] * lens["stop_radius_mm"] / stop, lens["efl_mm"], report)


def _light_of(short_nm: float, long_nm: float) -> tuple[float, float]:
    """Of the wavelengths of a model those that pictures are made of; all where it is of others."""
    short, long = max(short_nm, _LIGHT_NM[0]), min(long_nm, _LIGHT_NM[1])
    return (short, long) if short < long else (short_nm, long_nm)


def osl_camera(sight: Sight, focusing: Focusing, f_number: float, efl_mm: float, report: Report) -> OslCamera:
    """Of any lens: its graph, how it is focused, f-number of its widest stop and focal length.

    Raises:
        InputError: no ray passes.
    """
    arcs = fit_arcs(sight, report)
    plane = sight.table.pupil_z_mm
    return OslCamera(sight, arcs, _film(focusing), focusing.nearest_m, f_number, efl_mm, _entrance_mm(sight), plane)


def _entrance_mm(sight: Sight) -> float:
    """z of the entrance pupil: where the ray through the stop's middle, from beside the film's, crosses the axis."""
    height, nudge = _BESIDE * sight.table.film_radius_mm, 1e-3 * sight.table.film_radius_mm
    nm = min(max(LINE_D_NM, sight.wavelength_nm[0]), sight.wavelength_nm[1])
    pupil = 0.0
    for _ in range(4):  # Newton's steps
        ends = np.array([[height, height], [0, 0], [pupil, pupil + nudge], [0, 0], [nm, nm]])
        call = {"film_z_mm": sight.film_z_mm[0], "stop_radius_mm": sight.stop_radius_mm}
        found = evaluate(sight.graph, {"rays": ends} | {k: np.array([[v]]) for k, v in call.items()})
        at_stop = found["stop_xy_mm"][0]
        pupil -= float(at_stop[0] * nudge / (at_stop[1] - at_stop[0]))
    x, _, z, dx, _, dz = found["scene_ray"][:, 0]
    return float(z - x * dz / dx)
