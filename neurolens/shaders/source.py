"""What source code for integrators holds besides a lens's function: whole cameras, constants, focusing.

A camera's program is the graph that compiled cameras run (`fused`), its numbers and its table of the pupil's outline
written in: from a film point and two random numbers to a weighted ray, at one focus and stop.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.lens_film import LensFilm, LensGraph, whole_camera
from neurolens.cameras.model import ModelScene, best_focus_of_stops_mm
from neurolens.cameras.onnxlens import OnnxLens
from neurolens.graph.c import Extras
from neurolens.graph.loworder import with_film_derivatives
from neurolens.graph.program import STOP_RADIUS, Program
from neurolens.graph.scalars import lower
from neurolens.lens.film_plane import film_z_of_card_mm
from neurolens.shaders.focus_function import FOCUS, SMALLEST, Array, Focus, Focusing, film_function, number_of
from neurolens.surrogates.axes import Axis, product, state_names

CAMERA_FRAME = """\
Camera frame: metres, origin at the film's centre, the camera looks along -z, y up, x right. Film points are mm in the
lens frame: the picture on the film stands on its head. u and v are random numbers in [0, 1). The film value is the mean
of weight times radiance over u, v: uniform surroundings of radiance 1 give 1 on the axis. Rays of status other than 0
weigh 0. pupil_x_mm, pupil_y_mm: where the ray crosses the pupil plane; 1 / area_mm2 is the density of that point.
Derivatives by the film point are in metres (directions: 1) per mm."""


def camera_program(film: LensFilm, lens: LensGraph, derivatives: bool = False, own_table: bool = True) -> Program:
    """A camera as one program.

    Args:
        film, lens: of the same focus and stop. derivatives: of the ray by the film point, too: the graph's own.
        own_table: whether the outline's table is part of it; else the caller gives `outline`.

    Inputs: film_x_mm, film_y_mm, u, v, wavelength_nm. Outputs: see `CAMERA_FRAME`.

    Raises:
        InputError: a stop whose shape is a picture.
    """
    if lens.aperture is not None and lens.blades is None:
        raise InputError("export", "aperture", "(a picture)", "a round stop or one with blades")
    if derivatives:
        lens = lens._replace(graph=with_film_derivatives(lens.graph))
    graph, numbers = whole_camera(film, lens, pupil_too=True)
    program = lower(graph, numbers)
    if own_table:
        program.own_tables["outline"] = film.outline.table.astype(np.float64)
    return program


# Names in the source, where they stand in the card, and how they follow a state (as in `surrogates.card`).
_NUMBERS = (
    (("efl_mm",), "lens", "efl_mm", "reciprocal"),
    (("film_radius_mm",), "domain", "film_radius_mm", "square"),
    (("film_z_min_mm", "film_z_max_mm"), "domain", "film_z_mm", ""),
    (("pupil_z_mm",), "domain", "pupil_z_mm", ""),
    (("pupil_radius_mm",), "domain", "pupil_radius_mm", "square"),
    (("stop_radius_max_mm",), "domain", "stop_radius_mm", ""),
    (("wavelength_min_nm", "wavelength_max_nm"), "domain", "wavelength_nm", ""),
)
_BETWEEN = (0.12, 0.42, 0.83)  # of the range of each axis: states at which functions of them are measured


def model_extras(model: OnnxLens, *, film: bool = True, stop_mm: float | None = None) -> tuple[Extras, list[str]]:
    """Constants of a model's card, those that follow a state as functions of it, and the film's position.

    Args:
        film: whether the film is to be placed. stop_mm: a fixed radius of the stop; None leaves it an argument.

    Returns them with lines for the comment: what the functions are, their range and measured error.
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
    """Numbers by name, their values at the nodes and their rule (see `number_of`), as constants or functions."""
    found = {name: number_of(axes, values, rule) for name, values, rule in numbers}
    return (
        {name: value for name, value in found.items() if isinstance(value, float)},
        {name: value for name, value in found.items() if isinstance(value, Program)},
    )


def state_ranges(axes: Sequence[Axis]) -> dict[str, float]:
    """The range of each of a state's numbers as constants."""
    constants: dict[str, float] = {}
    for axis, name in zip(axes, state_names(axes), strict=True):
        word, _, unit = name.partition("_")
        constants |= {f"{word}_min_{unit}": axis.range[0], f"{word}_max_{unit}": axis.range[1]}
    return constants


def model_focusing(model: OnnxLens, state: Sequence[float] = (), stop_mm: float | None = None) -> Focusing:
    """How a model in a state is focused, with its stop as wide as it goes, or fixed."""
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
    """The film's position as functions: `film_z_mm`, best focus, and `film_z_paraxial_mm`, where the film focuses.

    Arguments as of `film_function`; not `by_stop`: at the widest stop alone. Returns them with lines for the comment:
    range and measured error.
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
        functions[name], error, _ = film_function(nodes, axes, between, focus)
        given = ", ".join([*state, *distance, *(stop if by_stop else [])])
        lines.append(
            f"{name}({given}): film plane of {what}, {', '.join(limits)}, beyond as at the end; within "
            f"{1e3 * error:.2g} um (measured)."
        )
    return functions, lines
