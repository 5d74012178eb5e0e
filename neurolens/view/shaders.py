"""Functions of the page's shaders that come from graphs, besides those of lenses and models.

They are the weights of rays, the blades, a thin lens, the crossings of rays with the surfaces of a lens, and ghosts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from neurolens.cameras.cameragraph import weight_graph
from neurolens.flare.ghosts import GhostTracer, entrances, ghost_graphs
from neurolens.graph.c import Signature
from neurolens.graph.ir import Graph
from neurolens.graph.program import FILM_Z, STOP_RADIUS, WAVELENGTH, Program
from neurolens.graph.scalars import lower
from neurolens.graph.shading import write_glsl
from neurolens.lens.prescription import VISIBLE_NM, Lens
from neurolens.shaders.pupil import Blades
from neurolens.trace.tracegraph import exact_graph

# The names that inputs and outputs of functions have in the page's shaders.
_PLACES = {
    "film_x_mm": "film.x", "film_y_mm": "film.y", "pupil_x_mm": "pupil.x", "pupil_y_mm": "pupil.y",
    WAVELENGTH: "nm", FILM_Z: "film_z", STOP_RADIUS: "stop_radius", "x_mm": "p.x", "y_mm": "p.y", "z_mm": "p.z",
    "dx": "d.x", "dy": "d.y", "dz": "d.z", "transmittance": "through", "stop_x_mm": "at.x", "stop_y_mm": "at.y",
    **{name: name for name in ("distance_mm", "per_depth", "per_distance", "scale", "roundness", "weight", "inside")},
    **{name: name for name in ("half_cos", "half_sin", "edge_cos", "edge_sin")}, "count": "blades",
    "area_mm2": "area", "lens_status": "float(status)",
    **{f"seen_{k}": f"{'origin' if k < 3 else 'to'}.{'xyz'[k % 3]}" for k in range(6)},
}  # fmt: skip
_ENTERING = {"dx": "d.x", "dy": "d.y", "x_mm": "at.x", "y_mm": "at.y", WAVELENGTH: "nm", STOP_RADIUS: "stop_radius"}
_ARRIVING = ("arriving.x", "arriving.y", "arriving.z", "arriving.w")  # as `program.ARRIVING`
_SINE = math.sin(math.radians(35.0))  # of the largest angle between the axis and a lamp that makes ghosts
_COMMENT = re.compile(r"/\*.*?\*/\s*", re.DOTALL)


def call_of(signature: Signature) -> str:
    """The call of a lens's function, its arguments as the page's shaders name them; a state is a uniform."""
    given = [_PLACES[name] for name in signature.inputs]
    found = [*(_PLACES[o] for o in signature.outputs), *["status"] * signature.status]
    return f"{signature.name}({', '.join([*given, *found])})"


def shared_glsl() -> dict[str, tuple[str, str]]:
    """Functions for all lenses, and their calls, by name.

    `weigh` gives the ray in the camera's frame and its weight, `opened` whether it goes through the blades, and `thin`
    is a thin lens.
    """
    graphs = {"weigh": _weight_in_frame(), "opened": _blades_opened(), "thin": _thin_lens()}
    programs = {name: lower(graph) for name, graph in graphs.items()}
    return {name: (_text(p, name), call_of(Signature.of(p, name))) for name, p in programs.items()}


def _blades_opened() -> Graph:
    """A graph that is 1 where a crossing with the stop lies between the blades, else 0."""
    g = Graph()
    g.outputs["inside"] = Blades(g).opened(g.input("stop_xy_mm", 2) * (1.0 / g.input(STOP_RADIUS, per_call=True)))
    return g


def _weight_in_frame() -> Graph:
    """`cameragraph.weight_graph` with outputs of names of their own."""
    g = Graph()
    inputs = {"film_mm": 2, "pupil_mm": 2, "area_mm2": 1, "scene_ray": 6, "transmittance": 1, "lens_status": 1}
    given = {name: g.input(name, rows) for name, rows in inputs.items()}
    given |= {name: g.input(name, per_call=True) for name in ("per_distance", "scale", FILM_Z)}
    found = g.inline(weight_graph(), given)
    g.outputs["seen"] = found["ray"]  # under a name of its own: the ray of the lens is an input
    g.outputs["weight"] = found["weight"]
    return g


def _thin_lens() -> Graph:
    """A thin lens with the contract of models.

    Pupil points are on the lens, `distance_mm` before the film; besides it takes `per_depth`, 1 / f - 1 / distance
    (per mm): the ray goes on towards the point conjugate to the film point.
    """
    g = Graph()
    film, pupil = g.input("film_mm", 2), g.input("pupil_mm", 2)
    film_z, stop, distance, per_depth = (
        g.input(name, per_call=True) for name in (FILM_Z, STOP_RADIUS, "distance_mm", "per_depth")
    )
    way = g.concat(film * (-1.0 / distance) - pupil * per_depth, g.constant(-1.0))
    g.outputs["scene_ray"] = g.concat(pupil, film_z - distance, way * (1.0 / g.square(way).sqrt()))
    g.outputs["transmittance"] = g.constant(1.0)
    g.outputs["stop_xy_mm"] = pupil
    g.outputs["status"] = g.first_failure([(g.square(pupil), stop * stop)], [6]).whole()
    return g


def path_glsl(lens: Lens, pupil_z_mm: float, light_nm: tuple[float, float]) -> tuple[str, list[str]]:
    """The text of `lens_path` for meridional rays (film and pupil points on the y axis), and the names of its outputs.

    These are z and y (mm) at each surface from the film on, the direction in front of the lens, and the status.
    """
    g = Graph()
    zero = g.constant(0.0)
    rays = g.concat(zero, g.input("film_y_mm"), zero, g.input("pupil_y_mm"), g.input(WAVELENGTH))
    found = g.inline(exact_graph(lens, pupil_z_mm, light_nm, path=True), {"rays": rays})
    g.outputs = {"path": found["path"], "dy": found["scene_ray"][4], "dz": found["scene_ray"][5]}
    g.outputs["status"] = found["status"]
    program = lower(g)
    return _text(program, "lens_path"), list(Signature.of(program, "lens_path").outputs)


@dataclass(frozen=True)
class GhostFunction:
    """The function of a ghost, whose rays cross the plane z = 0 at (x, y) = chief_mm p + scale_mm u."""

    name: str
    text: str
    call: str
    chief_mm: Sequence[float]
    scale_mm: Sequence[float]


@dataclass(frozen=True)
class Ghosts:
    """Ghosts, brightest first, for p = direction / sine and stops up to `stop_radius_mm`; `light` is their share of the
    light of all."""

    functions: Sequence[GhostFunction]
    sine: float
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    light: float


def ghosts_glsl(lens: Lens, film_radius_mm: float, most: int) -> Ghosts:
    """The brightest ghosts on the film of a lens, which must be placed; at most so many.

    Raises:
        InputError: as `GhostTracer` and `ghost_graphs`.
    """
    every = entrances(GhostTracer(lens), _SINE, film_radius_mm, 0.5 * sum(VISIBLE_NM))
    found = []
    for ghost, graph in zip(every[:most], ghost_graphs(lens, [g.pair for g in every[:most]], VISIBLE_NM), strict=True):
        name, program = f"ghost_{ghost.pair.name.replace('-', '_')}", lower(graph)
        given = [_ENTERING[i] for i in Signature.of(program, name).inputs]
        call = f"{name}({', '.join([*given, *_ARRIVING])})"
        places = ghost.chief_mm.tolist(), ghost.scale_mm.tolist()
        found.append(GhostFunction(ghost.pair.name, _text(program, name), call, *places))
    light = sum(g.light for g in every[:most]) / max(sum(g.light for g in every), 1e-300)
    return Ghosts(found, _SINE, VISIBLE_NM, float(lens.stop_radius_mm), light)


def _text(program: Program, name: str) -> str:
    return _COMMENT.sub("", write_glsl(program, name, []))
