"""Source code for other integrators: whole cameras, constants of a model, and the film's position by focus and stop.

A camera's program is the graph that compiled cameras run (`cameragraph`), with its numbers and the table of the pupil's
outline written into it: it takes a film point and two random numbers to a weighted ray, at one focus and stop.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import LensGraph
from neurolens.cameras.lensfilm import LensFilm, whole_camera
from neurolens.cameras.model import ModelScene, best_focus_of_stops_mm
from neurolens.cameras.onnxlens import OnnxLens
from neurolens.graph.c import Extras
from neurolens.graph.ir import Graph, Value
from neurolens.graph.loworder import with_film_derivatives
from neurolens.graph.program import STOP_RADIUS, Program
from neurolens.graph.scalars import lower
from neurolens.models.axes import STATE, Axis, product, state_graph, state_names
from neurolens.optics.lens.paraxial import film_z_of_card_mm

Array = NDArray[np.float64]
FOCUS = "focus_m"
Focus = Literal["best", "widest", "paraxial"]

SMALLEST = 1 / 16  # share of the widest stop; at smaller stops the film stays
_SAMPLES = (8, 12)  # distances and stops at which the film is placed, and at which errors are measured
_CHECKS = (4, 6)
# Degrees in 1 / distance and in the stop's radius, and the error (mm) that is enough.
_SAMPLES_OF_STATES = (5, 8)  # at each of the nodes
_BEST, _BEST_MM = ((3, 2), (4, 4), (4, 6), (5, 6), (6, 8), (6, 10)), 2e-4
_PARAXIAL, _PARAXIAL_MM = tuple((n, 0) for n in range(2, 13)), 1e-5
_RISING, _RISING_MM = 200, 1e-4  # distances at which the film must rise, and a fall (mm) that counts as rounding


@dataclass(frozen=True)
class Focusing:
    """Describes how a lens in one state is focused.

    Attributes:
        nearest_m: the nearest object's distance from the film; inf where the film does not focus.
        stop_radius_mm: radius of the widest stop.
        paraxial: gives the film's place (mm) in the paraxial image of an object at so many metres.
        best: gives the places of least spot at stop radii [S].
        film_z_mm: first and last place of the film; None where it has no ends.
    """

    nearest_m: float
    stop_radius_mm: float
    paraxial: Callable[[float], float]
    best: Callable[[float, Array], Array]
    film_z_mm: tuple[float, float] | None = None

    def places(self, vergence: Array, stops: Array) -> Array:
        """Return film positions [D, S] for 1 / distance [D], over that of the nearest, and shares [S] of the stop.

        They are of best focus; without shares, of the paraxial image.
        """
        far = [self.nearest_m / v if v > 0 else np.inf for v in vergence]
        if stops.size:
            z = np.array([self.best(d, stops * self.stop_radius_mm) for d in far])
        else:
            z = np.array([[self.paraxial(d)] for d in far])
        return z if self.film_z_mm is None else z.clip(*self.film_z_mm)


def number_of(axes: Sequence[Axis], nodes: Sequence[float], rule: str = "") -> float | Program:
    """Return a number that follows the state as a model's numbers do: a constant if all nodes agree, else a function.

    Args:
        nodes: its value at each node.
        rule: "square" or "reciprocal" where the state mixes squares or reciprocals of the number; "" for the number.
    """
    values = np.array(nodes, np.float64)
    if (values == values[0]).all():
        return float(values[0])
    powers = {"square": 2.0, "reciprocal": -1.0}
    g, row = followed_rows(axes, values[:, None] ** powers.get(rule, 1.0))
    g.outputs["value"] = row.sqrt() if rule == "square" else 1.0 / row if rule == "reciprocal" else row
    return lower(g)


def film_function(
    nodes: Sequence[Focusing],
    axes: Sequence[Axis] = (),
    between: Sequence[tuple[Sequence[float], Focusing]] = (),
    focus: Focus = "best",
) -> tuple[Program, float]:
    """The film's place as a function of distance (m, inf allowed) and, for "best", stop radius (mm); and its error.

    The error is the largest, in mm. The film never falls back as the object comes nearer, and it stays in place beyond
    the nearest object and beyond the smallest and widest stop.

    Args:
        nodes: the lens at every node of the axes; one lens without axes.
        between: states, and the lens in them, at which errors are measured; without axes that is the lens itself.
        focus: "widest" is best focus at the widest stop.
    """
    moved = np.isfinite(nodes[0].nearest_m)
    choices, enough = (_BEST, _BEST_MM) if focus == "best" else (_PARAXIAL, _PARAXIAL_MM)
    samples = _SAMPLES_OF_STATES if axes and focus == "best" else _SAMPLES
    if focus == "paraxial":
        samples = (_PARAXIAL[-1][0] + 4, 1)
    choices = tuple((i, j) for i, j in choices if i < samples[0] and j < samples[1])

    def grid(distances: Array, stops: Array) -> tuple[Array, Array]:
        by_stop = {"best": SMALLEST + (1 - SMALLEST) * stops, "widest": np.ones(1), "paraxial": np.zeros(0)}
        return distances if moved else np.zeros(1), by_stop[focus]

    fit, check = grid(*(_roots(n) for n in samples)), grid(*(np.linspace(0, 1, n) for n in _CHECKS))
    placed = np.array([node.places(*fit) for node in nodes])
    checked = [(state, lens, lens.places(*check)) for state, lens in between or [((), nodes[0])]]
    found: list[tuple[Program, float]] = []
    for degrees in choices:
        program = lower(_fitted(nodes, axes, placed, fit, degrees))
        error = max(_error(program, axes, *known, check) for known in checked)
        found.append((program, error))
        if error < enough:
            break
    return min(found, key=lambda f: f[1])


def followed_rows(axes: Sequence[Axis], nodes: ArrayLike) -> tuple[Graph, Value]:
    """Return a graph of the state's numbers, with n rows that follow the state, from their values [nodes, n].

    Without axes they are constants.
    """
    g, values = Graph(), np.asarray(nodes, np.float64)
    if not axes:
        return g, g.constant(values[0])
    graph, transform = state_graph(axes)
    state = g.concat(*(g.input(name, per_call=True) for name in state_names(axes)))
    return g, g.affine((transform @ values).T, g.inline(graph, {STATE: state})["features"])


def _roots(count: int) -> Array:
    """Return the roots of the Chebyshev polynomial of that degree, scaled to 0 to 1."""
    return np.asarray((1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2)


def _fitted(
    nodes: Sequence[Focusing], axes: Sequence[Axis], placed: Array, at: tuple[Array, Array], degrees: tuple[int, int]
) -> Graph:
    """Fit polynomials of these degrees to the film positions `placed` [nodes, D, S], by least squares."""
    moved, by_stop = (len(places) > 1 for places in at)
    across, along = degrees[0] * moved, degrees[1] * by_stop
    # The degree is high in one variable alone, not in both.
    exponents = np.array(
        [(i, j) for i in range(across + 1) for j in range(along + 1) if i * along + j * across <= across * along]
    )
    x, y = np.meshgrid(2 * at[0] - 1, _centred(at[1]) if by_stop else np.zeros(1), indexing="ij")
    basis = np.prod(np.stack([x.ravel(), y.ravel()], -1)[:, None] ** exponents, -1)
    terms = np.linalg.lstsq(basis, placed.reshape(len(nodes), -1).T, rcond=None)[0].T
    ends = [(1 / node.nearest_m, node.stop_radius_mm, *(node.film_z_mm or ())) for node in nodes]
    g, numbers = followed_rows(axes, np.concatenate([terms, ends], 1))
    count = len(exponents)
    near, stop, *film = (numbers[count + k] for k in range(len(ends[0])))
    rows = [((1.0 / g.input(FOCUS)) / near).clip(0.0, 1.0) * 2.0 - 1.0] if moved else []
    rows += [_centred((g.input(STOP_RADIUS) / stop).clip(SMALLEST, 1.0))] if by_stop else []
    z = numbers[0]
    if rows:
        used = exponents[:, [k for k, there in enumerate((moved, by_stop)) if there]]
        z = g.dot(numbers[0:count], g.polynomial(used, np.eye(count), g.concat(*rows)))
    g.outputs["film_z_mm"] = z.maximum(film[0]).minimum(film[1]) if film else z
    return g


def _centred(share: Any) -> Any:
    """Return a share of the stop, from `SMALLEST` to 1, scaled to -1 to 1."""
    return share * (2 / (1 - SMALLEST)) - (1 + SMALLEST) / (1 - SMALLEST)


def _error(
    program: Program,
    axes: Sequence[Axis],
    state: Sequence[float],
    lens: Focusing,
    wanted: Array,
    at: tuple[Array, Array],
) -> float:
    """Return the largest error in mm at a state; infinite for a function that falls as the object comes nearer."""

    def values(distances: Array) -> Array:
        v, s = np.meshgrid(distances, at[1] if at[1].size else np.ones(1), indexing="ij")
        with np.errstate(divide="ignore"):
            given = {FOCUS: lens.nearest_m / v, STOP_RADIUS: s * lens.stop_radius_mm}
        found = program.evaluate(given | dict(zip(state_names(axes), state, strict=True)))
        return np.broadcast_to(found["film_z_mm"], v.shape).astype(np.float64)

    rising = len(at[0]) == 1 or np.diff(values(np.linspace(0, 1, _RISING)), axis=0).min() >= -_RISING_MM
    return float(np.abs(values(at[0]) - wanted).max()) if rising else np.inf


CAMERA_FRAME = """\
Camera frame: metres, origin at the film's centre, the camera looks along -z, y up, x right. Film points are mm in the
lens frame: the picture on the film stands on its head. u and v are random numbers in [0, 1). The film value is the mean
of weight times radiance over u, v: uniform surroundings of radiance 1 give 1 on the axis. Rays of status other than 0
weigh 0. pupil_x_mm, pupil_y_mm: where the ray crosses the pupil plane; 1 / area_mm2 is the density of that point.
Derivatives by the film point are in metres (directions: 1) per mm."""


def camera_program(film: LensFilm, lens: LensGraph, derivatives: bool = False, own_table: bool = True) -> Program:
    """Write a camera as one program.

    Args:
        film, lens: of the same focus and stop.
        derivatives: whether to include the ray's derivatives by the film point, which are the graph's own.
        own_table: whether the outline's table is part of it; else the caller gives `outline`.

    Inputs are film_x_mm, film_y_mm, u, v and wavelength_nm; for outputs see `CAMERA_FRAME`.

    Raises:
        InputError: a stop whose shape is a picture.
    """
    if lens.aperture is not None and lens.blades is None:
        raise InputError("export", "aperture", "(a picture)", "a round stop or one with blades")
    if derivatives:
        lens = lens._replace(graph=with_film_derivatives(lens.graph))
    graph, numbers = whole_camera(film, lens, ("pupil_mm", "area_mm2"))
    program = lower(graph, numbers)
    if own_table:
        program.own_tables["outline"] = film.outline.table.astype(np.float64)
    return program


# Names in the source, where the numbers stand in the card, and how they follow a state (as in `models.card`).
_NUMBERS = (
    (("efl_mm",), "lens", "efl_mm", "reciprocal"),
    (("film_radius_mm",), "domain", "film_radius_mm", "square"),
    (("film_z_min_mm", "film_z_max_mm"), "domain", "film_z_mm", ""),
    (("pupil_z_mm",), "domain", "pupil_z_mm", ""),
    (("pupil_radius_mm",), "domain", "pupil_radius_mm", "square"),
    (("stop_radius_max_mm",), "domain", "stop_radius_mm", ""),
    (("wavelength_min_nm", "wavelength_max_nm"), "domain", "wavelength_nm", ""),
)
_BETWEEN = (0.12, 0.42, 0.83)  # shares of the range of each axis: states at which functions of them are measured


def model_extras(model: OnnxLens, *, film: bool = True, stop_mm: float | None = None) -> tuple[Extras, list[str]]:
    """Return a model's constants, those that follow a state as functions of it, and the film's position.

    They come with lines for the comment, which tell what the functions are, their range and measured error.

    Args:
        film: whether the film is to be placed.
        stop_mm: a fixed radius of the stop; None leaves it an argument.
    """
    axes = model.axes
    cards = model.card["states"]["nodes"] if axes else [model.card]
    constants, functions = followed(
        axes,
        [
            (name, values, rule)
            for names, part, key, rule in _NUMBERS
            for name, values in zip(names, np.atleast_2d(np.array([card[part][key] for card in cards]).T), strict=True)
        ],
    )
    constants |= state_ranges(axes)
    lines = [f"Functions of the state ({', '.join(state_names(axes))}): {', '.join(functions)}."] if functions else []
    if film:
        nodes = [model_focusing(model, state, stop_mm) for state in product(axes)] if axes else None
        between = [tuple(a.range[0] + (a.range[1] - a.range[0]) * share for a in axes) for share in _BETWEEN]
        placed, said = film_extras(
            nodes or [model_focusing(model, (), stop_mm)],
            axes,
            [(state, model_focusing(model, state, stop_mm)) for state in between] if axes else (),
            by_stop=stop_mm is None,
        )
        functions, lines = functions | placed, lines + said
    return Extras(constants, functions), lines


def followed(
    axes: Sequence[Axis], numbers: Iterable[tuple[str, Sequence[float], str]]
) -> tuple[dict[str, float], dict[str, Program]]:
    """Return numbers as constants, or as functions of the state.

    Each is given by its name, its values at the nodes and its rule (`number_of`).
    """
    found = {name: number_of(axes, values, rule) for name, values, rule in numbers}
    return (
        {name: value for name, value in found.items() if isinstance(value, float)},
        {name: value for name, value in found.items() if isinstance(value, Program)},
    )


def state_ranges(axes: Sequence[Axis]) -> dict[str, float]:
    """Return the range of each of a state's numbers as constants."""
    constants: dict[str, float] = {}
    for axis, name in zip(axes, state_names(axes), strict=True):
        word, _, unit = name.partition("_")
        constants |= {f"{word}_min_{unit}": axis.range[0], f"{word}_max_{unit}": axis.range[1]}
    return constants


def model_focusing(model: OnnxLens, state: Sequence[float] = (), stop_mm: float | None = None) -> Focusing:
    """Return the focusing of a model in a state, with its stop as wide as it goes, or fixed."""
    at = model.at(*state) if state else model
    lens, domain = at.card["lens"], at.card["domain"]
    light, widest = tuple(domain["wavelength_nm"]), float(domain["stop_radius_mm"])
    inside = any(a.name == "focus" for a in at.axes)  # its groups have moved
    nearest, ends = float(domain["focus_m"][1]), tuple(domain["film_z_mm"])

    def paraxial(focus_m: float) -> float:
        return float(lens["film_z_mm"]) if inside else film_z_of_card_mm(lens, focus_m)

    def best(focus_m: float, stops_mm: Array) -> Array:
        distance = nearest if inside else focus_m
        scene = ModelScene(at, min(max(paraxial(distance), ends[0]), ends[1]), widest)
        return best_focus_of_stops_mm(scene, distance, light, stops_mm)

    return Focusing(math.inf if inside else nearest, stop_mm or widest, paraxial, best, ends)


def film_extras(
    nodes: Sequence[Focusing],
    axes: Sequence[Axis] = (),
    between: Sequence[tuple[Sequence[float], Focusing]] = (),
    *,
    by_stop: bool = True,
) -> tuple[dict[str, Program], list[str]]:
    """Return the film's position as functions: `film_z_mm`, best focus, and, where it focuses, `film_z_paraxial_mm`.

    They come with lines for the comment: range and measured error. Arguments are those of `film_function`; `by_stop`
    false means at the widest stop alone.
    """
    near, wide, state = nodes[0].nearest_m, nodes[0].stop_radius_mm, list(state_names(axes))
    distance = [FOCUS] if math.isfinite(near) else []
    stops = f"stop radius {SMALLEST:.3g} to 1 times the widest" if by_stop else f"stop radius {wide:.4g} mm"
    first = " (of the first state)" if axes else ""
    reach = [f"object to film from {near:.4g} m{first} to infinity"] if distance else []
    made: dict[str, tuple[Focus, list[str], str, list[str]]] = {
        "film_z_mm": ("best" if by_stop else "widest", [stops, *reach], "the least RMS spot on the axis", [STOP_RADIUS])
    }
    if distance:
        made["film_z_paraxial_mm"] = ("paraxial", reach, "the paraxial image", [])
    functions, lines = {}, []
    for name, (focus, limits, what, stop) in made.items():
        functions[name], error = film_function(nodes, axes, between, focus)
        given = ", ".join([*state, *distance, *(stop if by_stop else [])])
        lines.append(
            f"{name}({given}): film plane of {what}, {', '.join(limits)}, beyond as at the end; within "
            f"{1e3 * error:.2g} um (measured)."
        )
    return functions, lines
