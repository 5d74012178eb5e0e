"""Cameras as shaders of Blender's Cycles (4.5 and later), in Open Shading Language.

The whole camera is a graph, from a point of the picture and two random numbers to a weighted ray, at any stop and focus
of the lens. Inputs of the shader (`parameters`) are plain numbers by the time the renderer compiles it, and what
depends on them alone then costs nothing. From Blender's camera the shader reads the sensor's size (with its fit and the
picture's aspect) and, where `focus_m` is 0, the distance of depth of field; shift moves the point in the picture. This
distance and the origins of rays are in units of the scene, each `unit_m` metres long.

In a lens with several states (zoom, internal focus) every number of the camera follows the state. It is mixed from
cameras at the nodes of the lens's axes, as a model's numbers are: the zoom is an input, internal focus is the distance
in focus.

Cycles gives two random numbers, which serve both wavelength and pupil: see `light`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.progress import Report
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.cameragraph import D_FILM, weight_graph
from neurolens.cameras.model import ModelScene
from neurolens.cameras.onnxlens import OnnxLens
from neurolens.cameras.pose import TURNS, to_plane
from neurolens.cameras.pupil_outline import PupilTable
from neurolens.cameras.sampling import stratified
from neurolens.cameras.shaders.pupil import MAX_BLADES, Blades, PupilCircles, passing_share
from neurolens.cameras.shaders.pupil_fit import fit_pupil
from neurolens.cameras.shaders.shader_lens import ShaderLens, light
from neurolens.cameras.shaders.source import SMALLEST, Focusing, followed_rows, model_focusing
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.graph.loworder import low_orders, low_tests, with_film_derivatives
from neurolens.graph.program import Mixture, Program
from neurolens.graph.scalars import lower
from neurolens.graph.shading import Parameter, write_osl
from neurolens.models.axes import STATE, Axis, product, state_graph, state_names, weights
from neurolens.optics.lens.prescription import LINE_D_NM

Array = NDArray[np.float64]
OUTPUTS = ("position", "direction", "throughput", "dPdx", "dPdy", "dDdx", "dDdy")
_FAR_M = 1e-4  # a focus distance of Blender's below this means that depth of field is off
_NEARLY, _EDGES = 0.99, 0.75  # share of rays that a margin holds, of those beyond this share of the stop's radius
_LEAST = 1.7e-3  # of the stop's radius: the least margin of blades; a number that no other node of a graph has
_QUADRATURE = 64  # points a side of the quadrature of the exposure on the axis
_NEAR = 0.999  # factor of the near limit, for rounding
# Errors allowed of derivatives, whose mean size Cycles takes, by output and in all; nothing is nearer than the last
# share of the focus.
_DERIVATIVES, _WORST, _SEEN = 0.05, 0.05, 0.25
_ACROSS, _FILM_POWERS = 12, (7, 5)  # distances and stops of placed films; highest powers of stop and distance
_BESIDE = 0.01  # share of the film radius that counts as near the axis
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
    float tilt_sin = sin(radians(tilt)), tilt_cos = cos(radians(tilt));
    float swing_sin = sin(radians(swing)), swing_cos = cos(radians(swing));
    float count = blades, shaded = vignetting, as_lens = exposure, at_pupil = origin, warned = warn;
    float in_colour = dispersion > 1 ? 1 - few : dispersion;
"""


@dataclass(frozen=True)
class OslCamera:
    """Holds the parts of the shader of a lens in one state.

    Attributes:
        lens: the lens in this state.
        graph: the lens's graph with derivatives by the film point.
        pupil: where rays are sampled.
        film, nearest_m: see `_film`.
        limit_m: nothing nearer is in focus; 0 where the film does not move.
        entrance_mm: z of the entrance pupil, lens frame.
        margin: by how much the stop's blades are widened for samples, in units of the stop's radius.
        unit: whether directions are known to be of unit length.
    """

    lens: ShaderLens
    graph: Graph
    pupil: PupilCircles
    film: Array
    nearest_m: tuple[float, float]
    limit_m: float
    entrance_mm: float
    margin: float
    unit: bool

    @cached_property
    def per_exposure(self) -> Array:
        """Fit the squared share of the stop over the exposure on the axis, by the stop and the film position.

        The fit is by powers [N, M] of that share and of the film position, scaled to 1.
        """
        square, nanometres = stratified(_QUADRATURE, self.lens.wavelength_nm)
        (low, high), (middle, half) = self.lens.film_z_mm, _film_position(self)
        positions = np.linspace(low, high, 3) if high > low else np.array([low])
        rows, values = [], []
        for z, share in itertools.product(positions, (0.1, 0.3, 0.5, 0.7, 0.85, 1.0)):
            per_distance = 1 / (z - self.lens.table.pupil_z_mm)
            call = {
                "film_z_mm": z,
                "stop_radius_mm": share * self.lens.stop_radius_mm,
                "per_distance": per_distance,
                "scale": per_distance**2,
            }
            inputs: dict[str, NDArray[Any]] = {
                **{k: np.array([[v]]) for k, v in call.items()},
                "film_mm": np.zeros_like(square),
                "square": square,
                "wavelength_nm": nanometres[None],
            }
            inputs |= evaluate(self.pupil.graph, inputs)
            inputs["rays"] = np.concatenate([inputs["film_mm"], inputs["pupil_mm"], inputs["wavelength_nm"]])
            ray = evaluate(self.lens.graph, inputs)
            weight = evaluate(weight_graph(), inputs | ray | {"lens_status": ray["status"]})["weight"]
            rows.append((share, (z - middle) / half))
            values.append(share**2 / float(np.mean(weight, dtype=np.float64)))
        return _powers(np.array(rows), np.array(values), (4, len(positions)))


@dataclass(frozen=True)
class OslLens:
    """Holds a lens as its shader has it.

    Attributes:
        nodes: the lens in each state of `product(axes)`; a lens without axes has one node.
        axes: what its state consists of.
        between: the lens in states between nodes, each with the weights of the nodes.
    """

    nodes: list[OslCamera]
    axes: tuple[Axis, ...] = ()
    between: Sequence[tuple[Array, ShaderLens]] = ()

    @property
    def near_m(self) -> tuple[float, float]:
        """Return the nearest distance in focus of the best and of the worst state; 0 where the focus is fixed."""
        limits = [c.limit_m for c in self.nodes]
        return min(limits), max(limits)

    @property
    def f_number(self) -> float:
        """Return the widest f-number of all states."""
        return min(c.lens.f_number for c in self.nodes)

    @property
    def film_radius_mm(self) -> float:
        """Return the radius of the picture that all states fill."""
        return min(c.pupil.film_radius_mm for c in self.nodes)

    def states(self) -> list[tuple[ShaderLens, PupilCircles]]:
        """Return the lens and its pupil at each node, and in the states between them."""
        first, *others = (c.pupil for c in self.nodes)
        nodes = zip(np.eye(len(self.nodes)), (c.lens for c in self.nodes), strict=True)
        return [(lens, first.mixed(others, weights)) for weights, lens in [*nodes, *self.between]]

    def passing(self) -> dict[float, float]:
        """Return the share of the samples that pass in the worst state, by shares of the widest stop."""
        shares = [passing_share(*state) for state in self.states()]
        return {stop: min(s[stop] for s in shares) for stop in shares[0]}


def parameters(lens: OslLens) -> list[Parameter]:
    """Return the inputs that a user turns, in their order in the shader.

    They are f_number, focus_m, zoom_mm for a zoom's range, blades, roundness, rotation, tilt, swing, exposure,
    vignetting, dispersion, few, origin, unit_m and warn.
    """
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
        Parameter("tilt", "Film Tilt", "Of the film in degrees: the picture's lower half goes away from the lens", 0.0,
                  -45.0, 45.0),
        Parameter("swing", "Film Swing", "Of the film in degrees: the picture's left half goes away from the lens", 0.0,
                  -45.0, 45.0),
        Parameter("exposure", "Exposure", "As Blender's camera, or as the lens: its stop and what glass and focus take",
                  0, widget="mapper", options="Blender:0|Lens:1"),
        Parameter("vignetting", "Vignetting", "Darkening towards the corners", 1, widget="boolean"),
        Parameter("dispersion", "Dispersion", "Colours part; off, light goes the way of the d line, with less noise",
                  2, widget="mapper", options="Off:0|On:1|Off for few samples:2"),
        Parameter("few", "Few Samples", "The extension of neurolens sets it", 0, widget="boolean"),
        Parameter("origin", "Origin", "What stands where Blender's camera stands, and distances are measured from",
                  1, widget="mapper", options="Film:0|Entrance pupil:1"),
        Parameter("unit_m", "Metres per Unit", "Length of a unit of the scene, its Unit Scale", 1.0, 1e-6, 1e6),
        Parameter("warn", "Warn", "Magenta where the lens is unknown (beyond its film, too near), in place of black",
                  0, widget="boolean"),
    ]  # fmt: skip


def write_camera(lens: OslLens, name: str, comment: list[str]) -> tuple[str, int]:
    """Write a camera's shader, and count the operations of a ray.

    They are counted with a round stop and an upright film: a compiler leaves blades and turns out where it knows that
    there are none.
    """
    program = osl_program(lens).with_shorter_sums().in_order_of_need()
    text = write_osl(program, name, comment, parameters(lens), _FRAME, OUTPUTS)
    plain = {"count": 0.0, "tilt_sin": 0.0, "tilt_cos": 1.0, "swing_sin": 0.0, "swing_cos": 1.0}
    return text, sum(osl_program(lens, plain).count().values())


def osl_program(lens: OslLens, fixed: Mapping[str, float] | None = None) -> Program:
    """Return the camera as a program with inputs as of `osl_graph`, some fixed, and `zoom_mm` for a zoom's range."""
    program = lower([osl_graph(camera) for camera in lens.nodes], fixed).with_shared_inverses()
    program.mixture = _mixture(lens) if lens.axes else None
    return program


def _mixture(lens: OslLens) -> Mixture:
    """Return the mixture of the nodes, in which internal focus follows the distance in focus."""
    focus = [a for a in lens.axes if a.name == FOCUS_AXIS]
    others = tuple(a for a in lens.axes if a.name != FOCUS_AXIS)
    far = lens.nodes[:: len(focus[0].nodes)] if focus else lens.nodes  # the last axis varies fastest
    g, rows = followed_rows(others, [[c.lens.film_z_mm[0] - c.entrance_mm] for c in far])
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
    """Write the camera as a graph from floats (`_FRAME`) and the parameters to the `OUTPUTS`, [3] each."""
    g = Graph()
    call = _Call(g, camera)
    own = (0.5 - g.concat(g.input("raster_x"), g.input("raster_y"))) * call.sensor
    numbers = g.concat(g.input("first"), g.input("second"))
    nanometres, colour, square = light(camera.lens.wavelength_nm, numbers, call.number("in_colour"))
    per_call = {"film_z_mm": call.film_z, "stop_radius_mm": call.stop}
    sampler = camera.pupil.sampler(Blades, camera.margin)
    posed = {"film_mm": own, "per_distance": call.per_distance} | {name: call.number(name) for name in TURNS}
    unknown = {"pupil_mm": own * 0.0, "area_mm2": own[0]}
    central = g.inline(to_plane(None, None), posed | unknown)["central_mm"]
    pupil = g.inline(sampler, {"film_mm": central, "square": square, "wavelength_nm": nanometres, **per_call})
    turned = g.inline(to_plane(None, None), posed | pupil)
    film = turned["plane_mm"]
    ray = g.inline(camera.graph, {"rays": g.concat(film, pupil["pupil_mm"], nanometres), **per_call})
    inputs = {"film_mm": film, **pupil, **ray, "lens_status": ray["status"], **per_call, **call.weighting()}
    weighted = g.inline(weight_graph(unit=camera.unit), inputs | {"area_mm2": turned["area_mm2"]})
    moves = g.inline(to_plane(None, None, D_FILM), posed | pupil | ray)
    even = g.select(weighted["status"] <= float(st.PASSED), pupil["area_mm2"] / pupil["mean_area_mm2"], 0.0)
    weight = g.select(call.number("shaded") <= 0.5, even, weighted["weight"])
    weight = g.select(Blades(g).opened(ray["stop_xy_mm"] * (1.0 / call.stop)), weight, 0.0)
    known = (g.square(central) <= camera.pupil.film_radius_mm**2) & call.focused
    warned = g.select(known, 0.0, call.number("warned"))
    # Beyond the film nothing has an area.
    _set_outputs(g, camera, call, own, ray["scene_ray"], moves, colour * g.select(call.focused, weight, 0.0), warned)
    return g


def _set_outputs(
    g: Graph, camera: OslCamera, call: _Call, film: Value, ray: Value, moves: Mapping[str, Value], throughput: Value,
    warned: Value,
) -> None:  # fmt: skip
    """Set the outputs: rays in Cycles's frame (x right, y up, z ahead) and scene units.

    Warnings are rays of a pinhole, in magenta.
    """
    length = call.units_per_m * [1e-3, 1e-3, -1e-3]
    ahead = g.concat(film * -1.0, g.constant(camera.lens.efl_mm))
    ahead = ahead * (1.0 / g.square(ahead).sqrt())
    start = (ray[0:3] - g.concat(g.constant([0.0, 0.0]), call.origin_mm)) * length
    plain = warned <= 0.5
    g.outputs["position"] = g.select(plain, start, 0.0)
    g.outputs["direction"] = g.select(plain, ray[3:] * [1.0, 1.0, -1.0], ahead)
    g.outputs["throughput"] = g.select(plain, throughput, g.constant([1.0, 0.0, 1.0]))
    for axis, name, step in zip((0, 1), D_FILM, ("x", "y"), strict=True):
        pixel = call.sensor[axis] * call.number(f"pixel_{step}")
        rows = moves[name] * (pixel * g.concat(length * -1.0, g.constant([-1.0, -1.0, 1.0])))
        g.outputs[f"dPd{step}"], g.outputs[f"dDd{step}"] = rows[0:3], rows[3:]


class _Call:
    """Holds the values that all rays of a call share: stop, film position, exposure."""

    def __init__(self, g: Graph, camera: OslCamera) -> None:
        self.g, self.camera = g, camera
        self.sensor = g.concat(self.number("sensor_x_mm"), self.number("sensor_y_mm"))
        self.share = (camera.lens.f_number / self.number("f_number")).minimum(1.0)
        # It has a name, because only in some states of a lens does it equal the unit of the pupil's numbers.
        self.stop = self.share * g.constant(camera.lens.stop_radius_mm, "stop radius")
        at_pupil, away = self.number("at_pupil"), _away(self.number("asked_m"))
        ways = zip(camera.film, camera.nearest_m, strict=True)
        places = (_in_turn(g, f, self.share, (near / away).clip(0.0, 1.0)) for f, near in ways)
        self.film_z = g.select(at_pupil <= 0.5, *places)
        distance = away + (self.film_z - camera.entrance_mm) * at_pupil * 1e-3
        self.focused = g.constant(camera.limit_m * _NEAR) <= distance
        self.origin_mm = g.select(at_pupil <= 0.5, self.film_z, camera.entrance_mm)
        self.per_distance = 1.0 / (self.film_z - camera.lens.table.pupil_z_mm)
        self.units_per_m = 1.0 / self.number("unit_m")

    def number(self, name: str) -> Value:
        return self.g.input(name, per_call=True)

    def weighting(self) -> dict[str, Value]:
        """Return the numbers of `weight_graph`."""
        g, camera = self.g, self.camera
        middle, half = _film_position(camera)
        per_share = _in_turn(g, camera.per_exposure, self.share, (self.film_z - middle) * (1 / half))
        facing = self.number("tilt_cos") * self.number("swing_cos")  # a turned film, too, has 1 on the axis
        per_lens = per_share * (1.0 / (self.share * self.share * facing))
        per_exposure = g.select(self.number("as_lens") <= 0.5, per_lens, 4 * camera.lens.f_number**2 / math.pi)
        return {"per_distance": self.per_distance, "scale": self.per_distance * self.per_distance * per_exposure}


def _in_turn(g: Graph, weights: Array, first: Value, then: Value) -> Value:
    """Return a polynomial of two numbers of the call, with weights [N, M] of powers of the one and the other.

    A shader is often compiled when the stop is known and the focus is not: so the focus comes last.
    """
    total: Value | None = None
    for row in weights.T[::-1]:
        part = g.series(first, row)
        total = part if total is None else total * then + part
    assert total is not None
    return total


def _film_position(camera: OslCamera) -> tuple[float, float]:
    """Return the middle and half the range of film positions."""
    low, high = camera.lens.film_z_mm
    return (low + high) / 2, max((high - low) / 2, 1e-6)


def _samples(lens: ShaderLens, pupil: PupilCircles, count: int = 32768) -> dict[str, NDArray[np.float32]]:
    """Return rays through the pupil as inputs of the lens's graph, and `at_stop`; nearly half have the widest stop."""
    rng = np.random.default_rng(0)
    angle, radius = 2 * np.pi * rng.random(count), 0.99 * pupil.film_radius_mm * np.sqrt(rng.random(count))
    film = radius * np.stack([np.cos(angle), np.sin(angle)])
    stop = lens.stop_radius_mm * rng.uniform(0.2, 1.6, (1, count)).clip(max=1)
    inputs = {
        "film_mm": film,
        "square": rng.random((2, count)),
        "stop_radius_mm": stop,
        "film_z_mm": rng.uniform(*lens.film_z_mm, (1, count)),
        "wavelength_nm": rng.uniform(*lens.wavelength_nm, (1, count)),
    }
    sample = evaluate(pupil.graph, inputs)
    inputs["rays"] = np.concatenate([film, sample["pupil_mm"], inputs["wavelength_nm"]])
    inputs |= {name: sample[name] for name in ("at_stop",) if name in sample}
    return {k: v.astype(np.float32) for k, v in inputs.items() if k not in ("film_mm", "square", "wavelength_nm")}


def _powers(at: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Fit weights [N, M] of powers of two numbers by least squares, at places [K, 2] with values [K]."""
    a = np.stack([at[:, 0] ** i * at[:, 1] ** j for i in range(shape[0]) for j in range(shape[1])], axis=1)
    return np.asarray(np.linalg.lstsq(a, values, rcond=None)[0]).reshape(shape)


def _film(focusing: Focusing, entrance_mm: float) -> tuple[Array, tuple[float, float]]:
    """Fit the film position of best focus (mm) by powers of two numbers.

    These are the stop's share, and the nearest distance over the distance in focus.

    Returns:
        Weights [2, N, M] for distances from the film and from the entrance pupil, and the nearest distance from either.
    """
    moves = math.isfinite(focusing.nearest_m)
    side = (1 - np.cos(np.pi * (np.arange(_ACROSS) + 0.5) / _ACROSS)) / 2
    side[[0, -1]] = 0.0, 1.0
    shares, vergence = SMALLEST + (1 - SMALLEST) * side, side if moves else np.zeros(1)
    z = focusing.places(vergence, shares)  # [D, S]
    nearest, powers = (focusing.nearest_m if moves else 1.0), (_FILM_POWERS[0], _FILM_POWERS[1] if moves else 1)
    # The same places by distance from the entrance pupil: 1 / distance = v / (nearest - v way).
    way = (z - entrance_mm) * 1e-3
    ahead = nearest - float(way[-1, -1]) * moves
    by_pupil = vergence[:, None] * ahead / (nearest - vergence[:, None] * way)
    rows = [np.broadcast_to(v, z.shape).ravel() for v in (shares, vergence[:, None], by_pupil)]
    fits = [_powers(np.stack([rows[0], v], 1), z.ravel(), powers) for v in rows[1:]]
    return np.stack(fits), (nearest, ahead)


def model_lens(model: OnnxLens, report: Report, *, fixed: bool = False) -> OslLens:
    """Return an exported model as a shader has it; `fixed` leaves it in its state."""
    if not model.axes or fixed:
        return osl_lens([shader_lens(model)], report)
    axes = model.axes
    between = [(weights(axes, state), shader_lens(model.at(*state))) for state in states_between(axes)]
    return osl_lens([shader_lens(model.at(*state)) for state in product(axes)], report, axes, between)


def states_between(axes: Sequence[Axis]) -> list[tuple[float, ...]]:
    """Return the middles between neighbouring nodes."""
    middles = [[(a + b) / 2 for a, b in zip(axis.nodes, axis.nodes[1:], strict=False)] for axis in axes]
    return list(itertools.product(*middles))


def shader_lens(model: OnnxLens) -> ShaderLens:
    """Return a model in its state as a shader has it."""
    lens, d = model.card["lens"], model.card["domain"]
    low, high = d["film_z_mm"]
    all_nm = short, long = tuple(map(float, d["wavelength_nm"]))
    visible = max(short, LIGHT_NM[0]), min(long, LIGHT_NM[1])
    short, long = visible if visible[0] < visible[1] else all_nm
    stop = float(d["stop_radius_mm"])
    height = _BESIDE * float(d["film_radius_mm"])
    squeeze = ModelScene(model, float(low), stop).squeeze(height, (short, long))
    return ShaderLens(
        graph=model.graph(),
        table=PupilTable.of(d["bounds"]),
        film_z_mm=(float(low), float(high)),
        wavelength_nm=(short, long),
        stop_radius_mm=stop,
        stop_surface=int(lens.get("stop_surface", 0)),
        anamorphic=squeeze != 1.0,
        focusing=model_focusing(model, model.state if model.axes else ()),
        f_number=lens["f_number"] * lens["stop_radius_mm"] / stop,
        efl_mm=lens["efl_mm"],
    )


def osl_lens(
    nodes: Sequence[ShaderLens], report: Report, axes: tuple[Axis, ...] = (),
    between: Sequence[tuple[Array, ShaderLens]] = (),
) -> OslLens:  # fmt: skip
    """Make the shader's lens of any lens, from what it is at each node of its axes; see `OslLens`.

    Raises:
        InputError: no ray passes.
    """
    pupils = fit_pupil(nodes, report, between)
    samples = [_samples(*pair) for pair in zip(nodes, pupils, strict=True)]
    graphs = [lens.graph for lens in nodes]
    graphs = (tested := low_tests(graphs, samples)) or graphs
    reach = _SEEN * min(1.0, *(lens.focusing.nearest_m for lens in nodes)) * 1e3
    fitted = low_orders(graphs, samples, _DERIVATIVES, _WORST, reach)
    graphs = [with_film_derivatives(g) for g in graphs] if fitted is None else [f.graph for f in fitted]
    inside = next((1 / a.range[1] for a in axes if a.name == FOCUS_AXIS), 0.0)
    cameras = []
    for lens, graph, pupil in zip(nodes, graphs, pupils, strict=True):
        near, entrance = lens.focusing.nearest_m, _entrance_mm(lens)
        film, nearest = _film(lens.focusing, entrance)
        limit, margin = near if math.isfinite(near) else inside, _blade_margin(lens, pupil)
        cameras.append(OslCamera(lens, graph, pupil, film, nearest, limit, entrance, margin, tested is not None))
    return OslLens(cameras, axes, between)


def _blade_margin(lens: ShaderLens, pupil: PupilCircles) -> float:
    """Return the margin (stop radii) by which the sampler widens blades, for a fit may put a passing ray beyond one."""
    inputs = _samples(lens, pupil)
    ray = evaluate(lens.graph, inputs)
    passed = np.broadcast_to(ray["status"][0] == st.PASSED, inputs["at_stop"].shape[1:])
    image, true = (
        (v[0] + 1j * v[1])[passed] for v in (inputs["at_stop"], ray["stop_xy_mm"] / inputs["stop_radius_mm"])
    )
    image, true = (v[np.abs(true) > _EDGES] for v in (image, true))
    # Near a point, the edge faces the point's direction, to within half a blade's angle.
    facing = true / np.abs(true) * np.exp(1j * np.linspace(-1, 1, 5)[:, None] * np.pi / 5)
    return max(float(np.quantile(((image - true) * facing.conj()).real.max(0), _NEARLY)), _LEAST)


def _entrance_mm(lens: ShaderLens) -> float:
    """Return z of the entrance pupil, where the ray from near the film's middle through the stop's meets the axis."""
    height, nudge = _BESIDE * lens.table.film_radius_mm, 1e-3 * lens.table.film_radius_mm
    nm = min(max(LINE_D_NM, lens.wavelength_nm[0]), lens.wavelength_nm[1])
    pupil = 0.0
    for _ in range(4):  # Newton's steps
        ends = np.array([[height, height], [0, 0], [pupil, pupil + nudge], [0, 0], [nm, nm]])
        call = {"film_z_mm": lens.film_z_mm[0], "stop_radius_mm": lens.stop_radius_mm}
        rays = evaluate(lens.graph, {"rays": ends} | {k: np.array([[v]]) for k, v in call.items()})
        at_stop = rays["stop_xy_mm"][0]
        pupil -= float(at_stop[0] * nudge / (at_stop[1] - at_stop[0]))
    x, _, z, dx, _, dz = rays["scene_ray"][:, 0]
    return float(z - x * dz / dx)
