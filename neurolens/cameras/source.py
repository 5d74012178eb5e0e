"""What source code for integrators holds besides a lens's function: whole cameras, constants, focusing.

A camera's program is the graph that compiled cameras run (`fused`), its numbers and its table of the pupil's outline
written in: from a film point and two random numbers to a weighted ray, at one focus and stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.fused import LensGraph, whole_camera
from neurolens.cameras.lens_film import LensFilm
from neurolens.graph.c import Extras
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import with_film_derivatives
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.optics.film_plane import film_z_mm

_DEGREES = range(2, 13)
_ENOUGH_MM = 1e-5  # error of the film's position: a twentieth of a wavelength
_ACROSS = 400  # distances at which it is measured
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
        InputError: a stop whose shape is a picture; a pupil other than the outline.
    """
    if lens.aperture is not None and lens.blades is None:
        raise InputError("export", "aperture", "(a picture)", "a round stop or one with blades")
    if film.pupil is not film.outline:
        raise InputError("export", "pupil", "(another)", "outline: the only one that is written")
    if derivatives:
        lens = lens._replace(graph=with_film_derivatives(lens.graph))
    graph, numbers = whole_camera(film, lens, pupil_too=True)
    program = lower(graph, numbers)
    if own_table:
        program.own_tables["outline"] = film.outline.table.astype(np.float64)
    return program


def model_extras(card: Mapping[str, Any], focusing: bool = True) -> tuple[Extras, list[str]]:
    """Constants of a model's card and, if `focusing`, the film's position for a focus; see `extras_of`."""
    lens, d = card["lens"], card["domain"]
    low, high = d["film_z_mm"]
    constants = {
        "efl_mm": lens["efl_mm"], "film_radius_mm": d["film_radius_mm"], "film_z_min_mm": low, "film_z_max_mm": high,
        "pupil_z_mm": d["pupil_z_mm"], "pupil_radius_mm": d["pupil_radius_mm"],
        "stop_radius_max_mm": d["stop_radius_mm"], "wavelength_min_nm": d["wavelength_nm"][0],
        "wavelength_max_nm": d["wavelength_nm"][1],
    }  # fmt: skip
    near = float(d["focus_m"][1]) if focusing else math.inf
    planes = lens["efl_mm"], lens["front_principal_z_mm"], lens["rear_principal_z_mm"]
    return extras_of(constants, near, lambda focus_m: film_z_mm(*planes, focus_m))


def extras_of(
    constants: Mapping[str, float], near_m: float, place: Callable[[float], float]
) -> tuple[Extras, list[str]]:
    """Constants, and the film's position as a function `film_z_mm` of the distance in focus, from infinity to `near_m`.

    Args:
        place: the film's position in mm at a distance in m; a polynomial of 1 / distance is fitted to it.

    Returns them with lines for the comment: the function's range and measured error.
    """
    if not 0 < near_m < math.inf:
        return Extras(constants), []
    vergence = (1 - np.cos(np.pi * (np.arange(_ACROSS) + 0.5) / _ACROSS)) / (2 * near_m)
    z = np.array([place(1 / v) for v in vergence])
    for degree in _DEGREES:
        g = Graph()
        fit = np.polynomial.Polynomial.fit(vergence, z, degree, domain=[0, 1 / near_m], window=[0, 1 / near_m])
        g.outputs["film_z_mm"] = g.series(1.0 / g.input("focus_m"), fit.coef)
        program = lower(g)
        error = float(np.abs(program.evaluate({"focus_m": 1 / vergence})["film_z_mm"] - z).max())
        if error < _ENOUGH_MM:
            break
    said = f"film_z_mm(focus_m): film plane of the paraxial focus, object to film from {near_m:.4g} m to infinity, "
    return Extras(constants, {"film_z_mm": program}), [f"{said}within {1e3 * error:.2g} um (measured)."]
