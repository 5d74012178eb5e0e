"""Writes the exact lens of a file as source code, for one zoom position or with the zoom as an argument."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np

from neurolens import __version__
from neurolens.base import status as st
from neurolens.base.progress import Progress
from neurolens.base.settings import LIGHT_NM, RANGE
from neurolens.cameras.shaders.source import Array, Focusing, film_extras, followed, state_ranges
from neurolens.graph.c import Extras
from neurolens.graph.program import Program
from neurolens.graph.scalars import lower
from neurolens.models.axes import Axis, mixture_of, weights
from neurolens.models.fit import gap_axis, zoom_axis
from neurolens.models.source import DOUBLE, Written, checked_name, lines_of, write_program
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.focusing import best_focus_of_stops_mm, focus_states
from neurolens.optics.setting.pupils import image_radius_mm, pupil_bounds, pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.tracegraph import TRANSMITTANCE, exact_graph

_NEAR_EFL = 10.0  # nearest focus of the function of the film's position, in focal lengths
_DISTANCES = 12  # about as many distances are placed for each lens
_CHECKED = (0.12, 0.42, 0.83)  # shares of the range where the film's position is measured


def write_lens(
    file: Path,
    out: Path,
    to: str,
    shot: Shot,
    *,
    name: str | None = None,
    progress: Progress | None = None,
) -> Written:
    """Write a lens as a function of film and pupil point, wavelength, film position, stop radius and any zoom range.

    Args:
        file: the lens file.
        out: the file to write.
        to: one of `models.source.WRITERS`.
        shot: zoom, size and coating of the lens; the zoom may be "range".
        name: of the function; None takes the lens's id.
    """
    lens = read_any(file)
    name = checked_name(to, lens.lens_id, name)
    axes: tuple[Axis, ...] = ()
    lines = []
    if shot.zoom == RANGE:
        axis, error_mm = gap_axis(zoom_axis(lens), lambda zoom_mm: set_lens(lens, zoom=zoom_mm))
        axes, nodes = (axis,), [set_lens(lens, replace(shot, zoom=v)) for v in axis.nodes]
        lines.append(
            f"Argument state: NAME_at(zoom_mm) makes it, once for all rays, of the focal length at infinity focus, "
            f"{_span(axis)} mm. Gaps between the source's own positions are within {1e3 * error_mm:.2g} um (measured)."
        )
    else:
        nodes = [set_lens(lens, shot)]
        if lens.configurations:
            lines.append("One zoom position: its gaps are numbers in the code (--zoom range makes it an argument).")
    if given := {key: value for key, value in shot.given.items() if key != "zoom"}:
        lines.append(f"The lens is set to {', '.join(f'{key} {value}' for key, value in given.items())}.")
    if focus_states(lens):
        lines.append(
            "Groups stand as at infinity focus: unlike in the product, the whole lens moves to focus (film_z_mm)."
        )
    planes = pupil_planes_mm(nodes, axes)
    program = lens_program(nodes, axes, planes, double=to == DOUBLE)
    constants, functions = followed(axes, numbers(nodes, planes))
    constants |= {**state_ranges(axes), "wavelength_min_nm": LIGHT_NM[0], "wavelength_max_nm": LIGHT_NM[1]}
    between = [a.range[0] + (a.range[1] - a.range[0]) * share for a in axes for share in _CHECKED]
    checked = {v: set_lens(lens, replace(shot, zoom=v)) for v in between}
    placed, said = _film(nodes, axes, checked, progress or Progress(quiet=True))
    plane = f"z = {planes[0]:.6g} mm" if "pupil_z_mm" in constants else "z = NAME_pupil_z_mm(zoom_mm)"
    extras = Extras(constants, {**functions, **placed})
    return write_program(program, out, to, name, lines_of([*_head(lens, plane), *lines, *said]), extras)


def _span(axis: Axis) -> str:
    return " to ".join(f"{v:.6g}" for v in axis.range)


def _head(lens: Lens, plane: str) -> list[str]:
    return [
        f"{lens.name}: every surface traced, written by neurolens {__version__}.",
        TRANSMITTANCE,
        f"Lens data: {lens.source} (sha256 {str(lens.sha256)[:16]}).",
        "Lens frame: mm, front vertex at z = 0, film at z > 0. Rays go from the film point through the pupil point on "
        f"the plane {plane}; the ray that comes out is a point on the front surface and a unit direction.",
        f"Wavelengths from {LIGHT_NM[0]:g} to {LIGHT_NM[1]:g} nm. Status: 0 passed; at surface k, counted from 0 "
        f"at the front, {st.blocked(0, st.MISSED)} + 4 k missed, {st.blocked(0, st.RIM)} + 4 k beyond its rim, "
        f"{st.blocked(0, st.TOTAL_REFLECTION)} + 4 k totally reflected.",
    ]


def _film(
    nodes: Sequence[Lens], axes: Sequence[Axis], between: Mapping[float, Lens], progress: Progress
) -> tuple[dict[str, Program], list[str]]:
    """Return the film's position, as `film_extras` does; `between` has the lens at states where it is measured."""
    lenses = [*nodes, *between.values()]
    data = [first_order(at) for at in lenses]
    # In a zoom the separation of the principal planes may change its sign, so one number serves for all.
    apart = max(abs(float(d.rear_principal_z_mm - d.front_principal_z_mm)) for d in data)
    nearest_m = [(_NEAR_EFL * abs(float(d.efl_mm)) + apart) / 1000 for d in data]
    with progress.stage("best focus of distances and stops") as report:
        done = count(1)

        def focusing(at: Lens, near_m: float) -> Focusing:
            """Return how a lens is focused by its film, up to a nearest distance."""

            def best(focus_m: float, stops_mm: Array) -> Array:
                report(min(1.0, next(done) / (_DISTANCES * len(lenses))))
                return best_focus_of_stops_mm(at, focus_m, stops_mm.tolist(), LIGHT_NM)

            return Focusing(near_m, float(at.stop_radius_mm), lambda focus_m: film_z_mm(at, focus_m), best)

        focused = [focusing(at, near) for at, near in zip(lenses, nearest_m, strict=True)]
        checked = [((v,), f) for v, f in zip(between, focused[len(nodes) :], strict=True)]
        return film_extras(focused[: len(nodes)], axes, checked)


def lens_program(
    nodes: Sequence[Lens], axes: Sequence[Axis], planes_mm: Sequence[float], *, double: bool = False
) -> Program:
    """Return the program of the lens; gaps and planes of pupil points follow the state, from tables at its nodes."""
    program = lower([exact_graph(n, z, LIGHT_NM, double=double) for n, z in zip(nodes, planes_mm, strict=True)])
    program.mixture = mixture_of(axes) if axes else None
    return program


def pupil_planes_mm(nodes: Sequence[Lens], axes: Sequence[Axis]) -> list[float]:
    """Return the plane of pupil points (mm) at each node.

    Over a zoom's range it is linear between knots, because the best plane jumps.
    """
    if not axes:
        return [pupil_plane_z_mm(node) for node in nodes]
    (axis,) = axes
    knots = replace(axis, degree=1)
    ends = np.array([pupil_plane_z_mm(nodes[axis.nodes.index(v)]) for v in knots.nodes])
    return [float(weights((knots,), (v,)) @ ends) for v in axis.nodes]


def numbers(nodes: Sequence[Lens], planes_mm: Sequence[float]) -> list[tuple[str, list[float], str]]:
    """Return the numbers of a lens by name: their values at the nodes, and how they follow the state (`number_of`)."""
    data, infinity = [first_order(n) for n in nodes], [film_z_mm(n, math.inf) for n in nodes]
    radii = [image_radius_mm(n)[0] for n in nodes]
    discs = [
        pupil_bounds(n, r, (z, z), LIGHT_NM, pupil_z_mm=plane, rows=9).disc_mm
        for n, r, z, plane in zip(nodes, radii, infinity, planes_mm, strict=True)
    ]
    return [
        ("efl_mm", [float(d.efl_mm) for d in data], "reciprocal"),
        ("film_radius_mm", radii, "square"),
        ("film_z_infinity_mm", infinity, ""),
        ("pupil_z_mm", list(planes_mm), ""),
        ("pupil_radius_mm", discs, "square"),
        ("stop_radius_max_mm", [float(n.stop_radius_mm) for n in nodes], ""),
    ]
