"""Cameras as shaders of Blender's Cycles (4.5 and later), in Open Shading Language.

The whole camera is a graph: from the place in the picture and two random numbers to a weighted ray, at any stop and
focus of the lens. Inputs of the shader (`PARAMETERS`) are numbers when the renderer compiles it, and what depends on
them alone costs nothing then. Besides them it reads, of Blender's camera, the sensor's size (with its fit and the
picture's aspect) and, where `focus_m` is 0, the distance of depth of field; shift moves the place in the picture.
This distance and the places of the rays are in units of the scene, which are `unit_m` metres long.

Of a lens in several states (zoom, internal focus) every number of the camera follows the state, mixed from cameras at
the nodes of its axes as a model's own numbers are: the zoom is an input, internal focus the distance in focus.

One of the two random numbers tells the wavelength by its low bits, which leaves both as even as they were. Its colour
weights are Bernstein's polynomials of second order: never negative, of mean 1 each.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.progress import Report
from neurolens.cameras.arcs_passing import passing
from neurolens.cameras.blades import MAX_BLADES, Blades
from neurolens.cameras.cameragraph import D_FILM, weight_graph
from neurolens.cameras.focus_function import FOCUS, SMALLEST, Focusing, film_function, followed_rows
from neurolens.cameras.lens_state import squeeze_of
from neurolens.cameras.model import ModelScene
from neurolens.cameras.onnxlens import OnnxLens
from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_arcs_fit import fit_arcs
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.cameras.pupil_circles import PupilCircles
from neurolens.cameras.pupil_sight import Sight
from neurolens.cameras.sampling import stratified
from neurolens.cameras.source import model_focusing
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.graph.loworder import low_orders, with_film_derivatives
from neurolens.graph.lowtests import low_tests
from neurolens.graph.osl import Parameter, write_osl
from neurolens.graph.program import STOP_RADIUS, Mixture, Program
from neurolens.graph.scalars import lower
from neurolens.modelfile.axes import Axis, product, weights
from neurolens.modelfile.stategraph import state_graph, state_names
from neurolens.modelfile.states import STATE
from neurolens.optics.film_plane import LINE_D_NM

Array = NDArray[np.float64]
OUTPUTS = ("position", "direction", "throughput", "dPdx", "dPdy", "dDdx", "dDdy")
_FAR_M = 1e-4  # Blender's focus distance below this means that depth of field is off
_LOW_BITS = 4096.0  # of a random number: what lies below 1 / 4096 of it
_NEARLY, _EDGES = 0.99, 0.75  # of rays beyond this share of the stop's radius: their places at the stop are known
_LEAST = 1.7e-3  # of the stop's radius, by which blades are widened; no other number of a graph, which would share it
_QUADRATURE = 64  # points a side of the exposure on the axis
_NEAR, _ROUNDS = 0.999, 4  # of the near limit: rounding; that place a film
# Errors of derivatives, whose mean size Cycles takes, by output and in all; nothing is nearer than this share of focus.
_DERIVATIVES, _WORST, _SEEN = 0.05, 0.05, 0.25
_ACROSS, _FILM_POWERS = 16, (7, 5)  # distances and stops at which the film is placed; powers of stop and distance
_BESIDE = 0.01  # of the film radius: near the axis
_LIGHT_NM = (400.0, 700.0)  # colours beyond would spread fringes that no eye and no film sees
FOCUS_AXIS = "focus"
_FRAME = """\
    point raster = camera_shader_raster_position();
    vector pixel_right = Dx(raster), pixel_up = Dy(raster);
    point pair = camera_shader_random_sample();
    vector sensor = vector(36.0, 24.0, 0.0);
    getattribute("cam:sensor_size", sensor);
    float asked_m = focus_m;
    if (focus_m <= 0.0 && getattribute("cam:focal_distance", asked_m))
        asked_m *= unit_m;
    float half_turn = M_PI / max(blades, 3);
    float first_edge = radians(rotation) + half_turn;
    float raster_x = raster[0], raster_y = raster[1], first = pair[0], second = pair[1];
    float pixel_x = pixel_right[0], pixel_y = pixel_up[1], sensor_x_mm = sensor[0], sensor_y_mm = sensor[1];
    float half_cos = cos(half_turn), half_sin = sin(half_turn), edge_cos = cos(first_edge), edge_sin = sin(first_edge);
    float count = blades, in_colour = dispersion, shaded = vignetting, as_lens = exposure, at_pupil = origin;
    float warned = warn;
"""


class Seen(NamedTuple):
    """A lens in one state: its rays, how it is focused, f-number of its widest stop and focal length (mm)."""

    sight: Sight
    focusing: Focusing
    f_number: float
    efl_mm: float


@dataclass(frozen=True)
class OslCamera:
    """What a shader of a lens in one state is made of.

    Attributes:
        sight: the lens. lens: its graph with derivatives by the film point. arcs: its pupil. film, nearest_m: see
            `_film`. limit_m: nearer than that nothing is in focus; 0 where nothing moves.
        f_number: of the widest stop. efl_mm: focal length. entrance_mm: z of the entrance pupil, lens frame.
            stop_image: see `_stop_image`. unit: whether directions are sure to be of unit length.
    """

    sight: Sight
    lens: Graph
    arcs: PupilArcs | PupilCircles
    film: Array
    nearest_m: tuple[float, float]
    limit_m: float
    f_number: float
    efl_mm: float
    entrance_mm: float
    stop_image: tuple[float, float]
    unit: bool

    @property
    def pupil_z_mm(self) -> float:
        """Of the plane of pupil points."""
        return self.sight.table.pupil_z_mm


@dataclass(frozen=True)
class OslLens:
    """A lens as its shader has it.

    Attributes:
        nodes: in each state of `product(axes)`; the one of a lens without axes.
        between: weights of the nodes, and the lens in states between them.
    """

    nodes: list[OslCamera]
    axes: tuple[Axis, ...] = ()
    between: Sequence[tuple[Array, Sight]] = ()

    @property
    def near_m(self) -> tuple[float, float]:
        """The nearest distance in focus, of the state that focuses nearest and of that which does least; 0: fixed."""
        own = [c.limit_m for c in self.nodes]
        return min(own), max(own)

    @property
    def f_number(self) -> float:
        """The widest of all states."""
        return min(c.f_number for c in self.nodes)

    @property
    def film_radius_mm(self) -> float:
        """Of the picture that all states fill."""
        return min(c.arcs.film_radius_mm for c in self.nodes)

    def passing(self) -> dict[float, float]:
        """Share of the samples that pass, in the worst state, by shares of the widest stop."""
        if not self.axes:
            return passing(self.nodes[0].sight, self.nodes[0].arcs)
        first, *others = (c.arcs for c in self.nodes if isinstance(c.arcs, PupilArcs))  # as all of several states are
        seen = [(np.eye(len(self.nodes))[k], c.sight) for k, c in enumerate(self.nodes)]
        found = [passing(sight, first.mixed(others, weights)) for weights, sight in [*seen, *self.between]]
        return {share: min(f[share] for f in found) for share in found[0]}


def parameters(lens: OslLens) -> list[Parameter]:
    """The inputs that a user turns, in order: f_number, focus_m, zoom_mm of a zoom's range, blades, roundness,
    rotation, exposure, vignetting, dispersion, origin, unit_m, warn."""
    widest = float(f"{lens.f_number:.4g}")
    zoom = []
    for axis, name in zip(lens.axes, state_names(lens.axes), strict=True):
        low, high = (float(f"{v:.6g}") for v in axis.range)
        if axis.name != FOCUS_AXIS:
            zoom.append(Parameter(name, "Zoom (mm)", "Focal length at infinity focus", low, low, high))
    return [
        Parameter("f_number", "F-number", "Stop; below the widest it is the widest", widest, 0.1, 1000.0),
        Parameter("focus_m", "Focus (m)", "Distance in focus from the camera; 0 takes that of depth of field, infinity "
                  "where that is off", 0.0, 0.0, 1e6),
        *zoom,
        Parameter("blades", "Blades", f"Of the stop, 3 to {MAX_BLADES}; 0 is round", 0, 0, MAX_BLADES),
        Parameter("roundness", "Roundness", "Of the blades: 0 straight, 1 round", 0.0),
        Parameter("rotation", "Rotation", "Of the blades in degrees", 0.0, -360.0, 360.0),
        Parameter("exposure", "Exposure", "As Blender's camera, or as the lens: its stop and what glass and focus take",
                  0, widget="mapper", options="Blender:0|Lens:1"),
        Parameter("vignetting", "Vignetting", "Darkening towards the corners", 1, widget="boolean"),
        Parameter("dispersion", "Dispersion", "Colours go their own ways", 1, widget="boolean"),
        Parameter("origin", "Origin", "What stands where Blender's camera stands, and distances are measured from",
                  1, widget="mapper", options="Film:0|Entrance pupil:1"),
        Parameter("unit_m", "Metres per Unit", "Length of a unit of the scene, its Unit Scale", 1.0, 1e-6, 1e6),
        Parameter("warn", "Warn", "Magenta where the lens is unknown (beyond its film, too near), in place of black",
                  0, widget="boolean"),
    ]  # fmt: skip


def write_camera(lens: OslLens, name: str, comment: list[str]) -> tuple[str, int]:
    """The text of a camera's shader, and the operations of one ray through a round stop: compilers know the blades."""
    program = osl_program(lens).with_shorter_sums().in_order_of_need()
    text = write_osl(program, name, comment, parameters(lens), _FRAME, OUTPUTS)
    return text, sum(osl_program(lens, {"count": 0.0}).count().values())


def osl_program(lens: OslLens, fixed: Mapping[str, float] | None = None) -> Program:
    """The camera as a program, some inputs numbers; inputs as of `osl_graph`, and `zoom_mm` of a zoom's range."""
    program = lower([osl_graph(camera) for camera in lens.nodes], fixed).with_shared_inverses()
    program.mixture = _mixture(lens) if lens.axes else None
    return program


def _mixture(lens: OslLens) -> Mixture:
    """How the nodes are mixed; internal focus stands where the camera is focused."""
    focus = [a for a in lens.axes if a.name == FOCUS_AXIS]
    others = tuple(a for a in lens.axes if a.name != FOCUS_AXIS)
    far = lens.nodes[:: len(focus[0].nodes)] if focus else lens.nodes  # the last axis goes fastest
    g, rows = followed_rows(others, [[c.sight.film_z_mm[0] - c.entrance_mm] for c in far])
    state = [g.input(name, per_call=True).clip(*a.range) for a, name in zip(others, state_names(others), strict=True)]
    if focus:
        away, at_pupil = (g.input(name, per_call=True) for name in ("asked_m", "at_pupil"))
        vergence = 1.0 / (_away(away) + rows * at_pupil * 1e-3)
        state.append(vergence.clip(*focus[0].range))
    graph, transform = state_graph(lens.axes)
    g.outputs = g.inline(graph, {STATE: g.concat(*state)})
    return Mixture(lower(g), transform)


def _away(asked_m: Value) -> Value:
    return asked_m.graph.select(asked_m <= _FAR_M, 1e9, asked_m)


def osl_graph(camera: OslCamera) -> Graph:
    """The camera as a graph. Inputs are floats of `_FRAME` and the parameters, outputs `OUTPUTS` [3] each."""
    g = Graph()
    call = _Call(g, camera)
    square = g.concat(g.input("first"), g.input("second"))
    film = (0.5 - g.concat(g.input("raster_x"), g.input("raster_y"))) * call.sensor
    nanometres, colour = _light(camera, square[0], call.number("in_colour"))
    per_call = {"film_z_mm": call.film_z, "stop_radius_mm": call.stop}
    sampler = camera.arcs.sampler(Blades, *camera.stop_image)
    pupil = g.inline(sampler, {"film_mm": film, "square": square, "wavelength_nm": nanometres, **per_call})
    rays = g.concat(film, pupil["pupil_mm"], nanometres)
    found = g.inline(camera.lens, {"rays": rays, **per_call})
    given = {"film_mm": film, **pupil, **found, "lens_status": found["status"], **per_call, **call.weighting()}
    done = g.inline(weight_graph(unit=camera.unit), given)
    even = g.select(done["status"] <= float(st.PASSED), pupil["area_mm2"] / pupil["mean_area_mm2"], 0.0)
    weight = g.select(call.number("shaded") <= 0.5, even, done["weight"])
    weight = g.select(Blades(g).opened(found["stop_xy_mm"] * (1.0 / call.stop)), weight, 0.0)
    known = (g.square(film) <= camera.arcs.film_radius_mm**2) & call.focused
    warned = g.select(known, 0.0, call.number("warned"))
    # Beyond the film nothing has an area.
    _set_outputs(g, camera, call, film, found, colour * g.select(call.focused, weight, 0.0), warned)
    return g


def _set_outputs(
    g: Graph, camera: OslCamera, call: _Call, film: Value, found: Mapping[str, Value], throughput: Value, warned: Value
) -> None:
    """Rays in the frame of Cycles, in units of the scene and x right, y up, z ahead; warnings as of a pinhole."""
    length = call.units_per_m * [1e-3, 1e-3, -1e-3]
    ahead = g.concat(film * -1.0, g.constant(camera.efl_mm))
    ahead = ahead * (1.0 / g.square(ahead).sqrt())
    ray = found["scene_ray"]
    start = (ray[0:3] - g.concat(g.constant([0.0, 0.0]), call.origin_mm)) * length
    plain = warned <= 0.5
    g.outputs["position"] = g.select(plain, start, 0.0)
    g.outputs["direction"] = g.select(plain, ray[3:] * [1.0, 1.0, -1.0], ahead)
    g.outputs["throughput"] = g.select(plain, throughput, g.constant([1.0, 0.0, 1.0]))
    for axis, name, step in zip((0, 1), D_FILM, ("x", "y"), strict=True):
        way = call.sensor[axis] * call.number(f"pixel_{step}")
        rows = found[name] * (way * g.concat(length * -1.0, g.constant([-1.0, -1.0, 1.0])))
        g.outputs[f"dPd{step}"], g.outputs[f"dDd{step}"] = rows[0:3], rows[3:]


class _Call:
    """What is the same for all rays: stop, film position, exposure."""

    def __init__(self, g: Graph, camera: OslCamera) -> None:
        self.g, self.camera = g, camera
        self.sensor = g.concat(self.number("sensor_x_mm"), self.number("sensor_y_mm"))
        # Before the radius: the share of it in the pupil's numbers, of all states, would be this one's own in some.
        self.share = (camera.f_number / self.number("f_number")).minimum(1.0)
        self.stop = self.share * camera.sight.stop_radius_mm
        at_pupil, asked = self.number("at_pupil"), self.number("asked_m")
        away = _away(asked)
        ways = zip(camera.film, camera.nearest_m, strict=True)
        places = (_in_turn(g, f, self.share, (near / away).clip(0.0, 1.0)) for f, near in ways)
        self.film_z = g.select(at_pupil <= 0.5, *places)
        distance = away + (self.film_z - camera.entrance_mm) * at_pupil * 1e-3
        self.focused = g.constant(camera.limit_m * _NEAR) <= distance
        self.origin_mm = g.select(at_pupil <= 0.5, self.film_z, camera.entrance_mm)
        self.units_per_m = 1.0 / self.number("unit_m")

    def number(self, name: str) -> Value:
        return self.g.input(name, per_call=True)

    def weighting(self) -> dict[str, Value]:
        """The numbers of `weight_graph`."""
        g, camera = self.g, self.camera
        per_distance = 1.0 / (self.film_z - camera.pupil_z_mm)
        own = _in_turn(g, _per_exposure(camera), self.share, _place(camera, self.film_z))
        own, nominal = own * (1.0 / (self.share * self.share)), 4 * camera.f_number**2 / math.pi
        per_exposure = g.select(self.number("as_lens") <= 0.5, own, nominal)
        return {"per_distance": per_distance, "scale": per_distance * per_distance * per_exposure}


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


def _samples(sight: Sight, arcs: PupilArcs | PupilCircles, count: int = 32768) -> dict[str, NDArray[np.float32]]:
    """Rays through the arcs, nearly half at the widest stop, as inputs of the lens's graph; `at_stop` of the arcs."""
    rng = np.random.default_rng(0)
    angle, radius = 2 * np.pi * rng.random(count), 0.99 * arcs.film_radius_mm * np.sqrt(rng.random(count))
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    stop = sight.stop_radius_mm * rng.uniform(0.2, 1.6, (1, count)).clip(max=1)
    given = {"film_mm": film, "square": rng.random((2, count)), "stop_radius_mm": stop}
    given["film_z_mm"] = rng.uniform(*sight.film_z_mm, (1, count))
    given["wavelength_nm"] = rng.uniform(*sight.wavelength_nm, (1, count))
    pupil = evaluate(arcs.graph, given)
    given |= {"rays": np.concatenate([film, pupil["pupil_mm"], given["wavelength_nm"]]), "at_stop": pupil["at_stop"]}
    return {k: given[k].astype(np.float32) for k in ("rays", "film_z_mm", "stop_radius_mm", "at_stop")}


def _per_exposure(camera: OslCamera) -> Array:
    """The square of the stop's share over the exposure on the axis, by powers [N, M] of that share and the place."""
    sight = camera.sight
    square, nanometres = stratified(_QUADRATURE, sight.wavelength_nm)
    low, high = sight.film_z_mm
    places = np.linspace(low, high, 3) if high > low else np.array([low])
    rows, values = [], []
    for z in places:
        for share in (0.1, 0.3, 0.5, 0.7, 0.85, 1.0):
            per_distance = 1 / (z - camera.pupil_z_mm)
            call = {"film_z_mm": z, "stop_radius_mm": share * sight.stop_radius_mm}
            call |= {"per_distance": per_distance, "scale": per_distance**2}
            given: dict[str, Any] = {k: np.array([[v]]) for k, v in call.items()}
            given |= {"film_mm": np.zeros_like(square), "square": square, "wavelength_nm": nanometres[None]}
            given |= evaluate(camera.arcs.graph, given)
            lens = evaluate(
                sight.graph,
                given | {"rays": np.concatenate([given["film_mm"], given["pupil_mm"], given["wavelength_nm"]])},
            )
            weight = evaluate(weight_graph(), given | lens | {"lens_status": lens["status"]})["weight"]
            rows.append((share, (z - camera.arcs.film_z_mm[0]) / camera.arcs.film_z_mm[1]))
            values.append(share**2 / float(np.mean(weight, dtype=np.float64)))
    return _powers(np.array(rows), np.array(values), (4, len(places)))


def _powers(at: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Least squares weights [N, M] of powers of two numbers, at places [K, 2] with values [K]."""
    a = np.stack([at[:, 0] ** i * at[:, 1] ** j for i in range(shape[0]) for j in range(shape[1])], axis=1)
    return np.asarray(np.linalg.lstsq(a, values, rcond=None)[0]).reshape(shape)


def _film(focusing: Focusing, entrance_mm: float) -> tuple[Array, tuple[float, float]]:
    """Best focus (mm) by powers [2, N, M] of the stop's share and of the nearest distance over the distance, from the
    film and from the entrance pupil; and that distance from either."""
    function, moves = film_function([focusing]), math.isfinite(focusing.nearest_m)
    side = (1 - np.cos(np.pi * (np.arange(_ACROSS) + 0.5) / _ACROSS)) / 2
    share, vergence = (a.ravel() for a in np.meshgrid(SMALLEST + (1 - SMALLEST) * side, side if moves else [0.0]))

    def place(share: Array, away_m: Array, at_pupil: bool) -> Array:
        z = np.full(share.shape, entrance_mm)
        for _ in range(_ROUNDS):  # distances are from the film there
            away = away_m + (z - entrance_mm) * (at_pupil * 1e-3)
            call = {FOCUS: away, STOP_RADIUS: share * focusing.stop_radius_mm}
            found = evaluate(function.graph, {name: value[None] for name, value in call.items()})["film_z_mm"][0]
            z = np.broadcast_to(found.astype(np.float64), share.shape)
        return z

    nearest = ahead = focusing.nearest_m if moves else 1.0
    if moves:
        ahead -= float(place(np.ones(1), np.full(1, nearest), False)[0] - entrance_mm) * 1e-3
    powers, at = (_FILM_POWERS[0], _FILM_POWERS[1] if moves else 1), np.stack([share, vergence], 1)
    places = [place(share, near / np.maximum(vergence, 1e-9), near != nearest) for near in (nearest, ahead)]
    return np.stack([_powers(at, z, powers) for z in places]), (nearest, ahead)


def model_lens(model: OnnxLens, graph: Graph | None, report: Report, *, fixed: bool = False) -> OslLens:
    """Of an exported model.

    Args:
        graph: of a model of one state; None takes its own. fixed: in its state alone.
    """
    if not model.axes or fixed:
        return osl_lens([_seen(model, graph)], report)
    axes = model.axes
    between = [(weights(axes, state), _seen(model.at(*state), None).sight) for state in states_between(axes)]
    return osl_lens([_seen(model.at(*state), None) for state in product(axes)], report, axes, between)


def states_between(axes: Sequence[Axis]) -> list[tuple[float, ...]]:
    """The middles between neighbouring nodes."""
    places = [[(a + b) / 2 for a, b in zip(axis.nodes, axis.nodes[1:], strict=False)] for axis in axes]
    return list(itertools.product(*places))


def _seen(model: OnnxLens, graph: Graph | None) -> Seen:
    """A model in its state."""
    lens, d = model.card["lens"], model.card["domain"]
    low, high = d["film_z_mm"]
    short, long = _light_of(*map(float, d["wavelength_nm"]))
    stop = float(d["stop_radius_mm"])
    if graph is None:
        graph = model.graph()
    height = _BESIDE * float(d["film_radius_mm"])
    squeeze = squeeze_of(ModelScene(model, float(low), stop), height, (short, long))
    sight = Sight(
        graph, PupilTable.of(d["bounds"]), (float(low), float(high)), (short, long), stop,
        int(lens.get("stop_surface", 0)), squeeze != 1.0,
    )  # fmt: skip
    focusing = model_focusing(model, model.state if model.axes else ())
    return Seen(sight, focusing, lens["f_number"] * lens["stop_radius_mm"] / stop, lens["efl_mm"])


def _light_of(short_nm: float, long_nm: float) -> tuple[float, float]:
    """Of the wavelengths of a model those that pictures are made of; all where it is of others."""
    short, long = max(short_nm, _LIGHT_NM[0]), min(long_nm, _LIGHT_NM[1])
    return (short, long) if short < long else (short_nm, long_nm)


def osl_lens(
    nodes: Sequence[Seen], report: Report, axes: tuple[Axis, ...] = (), between: Sequence[tuple[Array, Sight]] = ()
) -> OslLens:
    """Of any lens: what it is at each node of its axes, see `OslLens`.

    Raises:
        InputError: no ray passes.
    """
    sights = [node.sight for node in nodes]
    arcs = fit_arcs(sights, report, between)
    samples = [_samples(*of_one) for of_one in zip(sights, arcs, strict=True)]
    graphs = [s.graph for s in sights]
    graphs = (tested := low_tests(graphs, samples)) or graphs
    reach = _SEEN * min(1.0, *(node.focusing.nearest_m for node in nodes)) * 1e3
    fitted = low_orders(graphs, samples, _DERIVATIVES, _WORST, reach)
    graphs = [with_film_derivatives(g) for g in graphs] if fitted is None else [f.graph for f in fitted]
    inside = next((1 / a.range[1] for a in axes if a.name == FOCUS_AXIS), 0.0)
    cameras = []
    for seen, graph, own in zip(nodes, graphs, arcs, strict=True):
        near, entrance = seen.focusing.nearest_m, _entrance_mm(seen.sight)
        numbers = near if math.isfinite(near) else inside, seen.f_number, seen.efl_mm, entrance
        film, image = _film(seen.focusing, entrance), _stop_image(seen.sight, own)
        cameras.append(OslCamera(seen.sight, graph, own, *film, *numbers, image, tested is not None))
    return OslLens(cameras, axes, between)


def _stop_image(sight: Sight, arcs: PupilArcs | PupilCircles) -> tuple[float, float]:
    """The stop in its image in the pupil, as the arcs have it: -1 where it is upside down, and by how much, in the
    stop's radius, nearly no ray within an edge of blades seems to lie beyond it."""
    given = _samples(sight, arcs)
    seen = evaluate(sight.graph, given)
    passed = np.broadcast_to(seen["status"][0] == st.PASSED, given["at_stop"].shape[1:])
    place, true = ((v[0] + 1j * v[1])[passed] for v in (given["at_stop"], seen["stop_xy_mm"] / given["stop_radius_mm"]))
    side = 1.0 if np.mean((place * true.conj()).real) > 0 else -1.0
    place, true = (v[np.abs(true) > _EDGES] for v in (place, true))
    # Edges near a place face its own direction, to within half a blade's angle.
    facing = true / np.abs(true) * np.exp(1j * np.linspace(-1, 1, 5)[:, None] * np.pi / 5)
    beyond = ((side * place - true) * facing.conj()).real.max(0)
    return side, max(float(np.quantile(beyond, _NEARLY)), _LEAST)


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
