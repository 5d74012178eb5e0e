"""Shaders for Blender's Cycles (`neurolens export --to osl`), of a model or of a lens with every surface traced."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.lensname import is_model
from neurolens.base.progress import Progress, Report
from neurolens.base.settings import LIGHT_NM, RANGE
from neurolens.cameras.onnxlens import load_model
from neurolens.cameras.pupil_outline import PupilTable
from neurolens.cameras.shaders.osl import (
    FOCUS_AXIS,
    OslLens,
    model_lens,
    osl_lens,
    parameters,
    states_between,
    write_camera,
)
from neurolens.cameras.shaders.shader_lens import ShaderLens
from neurolens.cameras.shaders.source import Focusing
from neurolens.models.axes import product, weights
from neurolens.models.card import state_for
from neurolens.models.source import OSL, checked_name, lines_of
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.focusing import best_focus_of_stops_mm, film_range_mm, focus_states
from neurolens.optics.setting.pupils import image_radius_mm, pupil_bounds, pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.tracegraph import TRANSMITTANCE, exact_graph

# For an exact lens: its nearest focus in focal lengths; and the share of the film's travel by which best focus may lie
# next to the paraxial one.
_NEAR_EFL, _SPARE = 10.0, 0.1
MAX_STEPS = 12_000  # operations of a ray; for more, compilers take minutes


@dataclass(frozen=True)
class Shader:
    """A camera's shader, with what a user may want to know of it.

    Attributes:
        name: the shader's name.
        text: its source.
        operations: how many one ray takes.
        parameters: names of its inputs.
        passing: share of the rays that pass, by f-number.
        film_radius_mm: of the lens.
        f_number: that of the widest stop.
        nearest_m: distance of the nearest object; None where the film does not focus.
        notes: sentences for the user.
    """

    name: str
    text: str
    operations: int
    parameters: tuple[str, ...]
    passing: dict[str, float]
    film_radius_mm: float
    f_number: float
    nearest_m: float | None
    notes: tuple[str, ...] = ()


def shader_of(file: Path, *, zoom: str | float | None = None, name: str | None = None, quiet: bool = False) -> Shader:
    """Return the shader of a model (.onnx) or of a lens file.

    Args:
        file: the model or lens file.
        zoom: state of a zoom by name or focal length. "range" makes the zoom an input, and so does None for a model of
            a range.
        name: the shader's name; None takes the lens's id.

    Raises:
        InputError: a name that is no identifier, or a lens that is too large for compilers.
    """
    with Progress(quiet=quiet).stage(f"fit the pupil of {file.stem}") as report:
        lens_id, lens, lines = lens_of(file, zoom, report)
    function = checked_name(OSL, lens_id, name)
    passed = {f"{lens.f_number / share:.3g}": value for share, value in lens.passing().items()}
    near, least = lens.near_m
    focus = f"from {near:.4g} m" if near else "fixed"
    comment = [
        f"A camera for Blender's Cycles (4.5 and later), written by neurolens {__version__} from {file.name}.",
        *lines,
        f"Film radius {lens.film_radius_mm:.4g} mm, f/{lens.f_number:.3g}, focus {focus}; rays that pass: "
        + ", ".join(f"f/{n} {share:.1%}" for n, share in passed.items()) + ".",
        "Sensor size and shift are Blender's; shift X counts widths of the picture, shift Y heights.",
        "Focus: focus_m, or where that is 0 the distance of depth of field.",
    ]  # fmt: skip
    notes = []
    for axis in lens.axes:
        low, high = axis.range
        if axis.name == FOCUS_AXIS:
            notes.append("Groups move to focus: the picture breathes as the lens's does")
        elif least > near:
            notes.append(f"Nearest focus from {near:.3g} to {least:.3g} m over the zoom, {low:.4g} to {high:.4g} mm")
    text, operations = write_camera(lens, function, lines_of([*comment, *(f"{n}." for n in notes)]))
    if operations > MAX_STEPS:
        raise InputError(file, "operations", operations, f"up to {MAX_STEPS}: a model of the lens is smaller")
    return Shader(
        function, text, operations, tuple(p.name for p in parameters(lens)), passed, lens.film_radius_mm, lens.f_number,
        near or None, tuple(notes),
    )  # fmt: skip


def lens_of(file: Path, zoom: str | float | None, report: Report) -> tuple[str, OslLens, list[str]]:
    """Return the id of a model or lens file, the lens as a shader has it, and lines that describe it. Arguments and
    errors are those of `shader_of`."""
    return _of_model(file, zoom, report) if is_model(file) else exact_lens(file, zoom, report)


def _of_model(file: Path, zoom: str | float | None, report: Report) -> tuple[str, OslLens, list[str]]:
    model, fixed = load_model(file), zoom not in (None, RANGE)
    if fixed or (zoom is not None and not model.axes):
        model = model.at(*state_for(model.path, model.axes, model.state, zoom, math.inf))
    lens, fit = model.card["lens"], model.card["fit"]
    state = ", ".join(f"{a.name} {v:.5g}" for a, v in zip(model.axes, model.state, strict=True))
    lines = [f"{lens['name']}: {fit['method']}, {lens['source']} (sha256 {lens['sha256'][:16]})."]
    made = model_lens(model, report, fixed=fixed)
    return str(lens["id"]), made, lines + [f"State: {state}."] * bool(state and fixed)


def exact_lens(file: Path, zoom: str | float | None, report: Report) -> tuple[str, OslLens, list[str]]:
    """Return id, lens and lines as `lens_of` does, of a lens with every surface traced.

    It focuses by its groups where its file tells how they move, else by its film, to ten focal lengths.

    Args:
        zoom: as for `shader_of`.

    Raises:
        InputError: a range is asked of a lens without zoom, or of one whose groups move to focus.
    """
    from neurolens.models.fit import StateSpace, axes_of, gap_axis

    lens, state = read_any(file), None if zoom == RANGE else zoom
    ranged, internal = zoom == RANGE, bool(focus_states(lens))
    if ranged and internal:  # refused before minutes of work
        raise InputError(lens.path, "zoom", RANGE, "one focal length of the zoom: its groups move to focus, too")
    lines = [f"{lens.name}: every surface traced, {lens.source} (sha256 {str(lens.sha256)[:16]}).", TRANSMITTANCE]
    if not (ranged or internal):
        at = set_lens(lens, zoom=state)
        return lens.lens_id, osl_lens([_traced(at, pupil_plane_z_mm(at))], report), lines
    space = StateSpace(lens, axes_of(lens, zoom=ranged, internal=internal, state=state), state)
    if len(space.axes) == 1:
        axis, error_mm = gap_axis(space.axes[0], lambda value: space.lens_at((value,)))
        space = replace(space, axes=(axis,))
        lines.append(f"Between {len(axis.nodes)} states its gaps are within {1e3 * error_mm:.2g} um (measured).")
    knots = tuple(replace(a, degree=1) for a in space.axes)
    planes = [pupil_plane_z_mm(space.lens_at(s)) for s in product(knots)]

    def lens_in(s: tuple[float, ...]) -> ShaderLens:
        plane, far = float(weights(knots, s) @ planes), space.lens_at((*s[:-1], 0.0)) if internal else None
        return _traced(space.lens_at(s), plane, far, 1 / s[-1] if internal and s[-1] else math.inf)

    nodes = [lens_in(s) for s in product(space.axes)]
    between = [(weights(space.axes, s), lens_in(s)) for s in states_between(space.axes)]
    return lens.lens_id, osl_lens(nodes, report, space.axes, between), lines


def _traced(lens: Lens, plane_mm: float, far: Lens | None = None, inside_m: float = math.inf) -> ShaderLens:
    """Return a lens in one state as a shader has it.

    Args:
        plane_mm: the plane of its pupil points.
        far, inside_m: where groups have moved to focus, the lens at infinity focus, which sets the picture's size, and
            the distance in focus.
    """
    data, (radius, _) = first_order(lens), image_radius_mm(far or lens)
    apart, efl = abs(float(data.rear_principal_z_mm - data.front_principal_z_mm)), float(data.efl_mm)
    near = math.inf if far else (_NEAR_EFL * abs(efl) + apart) / 1000
    if far:
        places = film_range_mm(lens, inside_m, LIGHT_NM)
    else:
        infinity, close = film_z_mm(lens, math.inf), film_z_mm(lens, near)
        spare = _SPARE * abs(close - infinity)
        places = min(infinity, close) - spare, max(infinity, close) + spare
    bounds = pupil_bounds(lens, radius, places, LIGHT_NM, rows=9, points=48, pupil_z_mm=plane_mm)
    stop = float(lens.stop_radius_mm)

    def paraxial(focus_m: float) -> float:
        return float(lens.film_z_mm or 0.0) if far else film_z_mm(lens, focus_m)

    def best(focus_m: float, stops_mm: Any) -> Any:
        return best_focus_of_stops_mm(lens, inside_m if far else focus_m, stops_mm, LIGHT_NM)

    lens.require_centred("a shader")
    return ShaderLens(
        graph=exact_graph(lens, plane_mm, LIGHT_NM),
        table=PupilTable.of(asdict(bounds)),
        film_z_mm=places,
        wavelength_nm=LIGHT_NM,
        stop_radius_mm=stop,
        stop_surface=lens.stop_index,
        anamorphic=lens.anamorphic,
        focusing=Focusing(near, stop, paraxial, best, places),
        f_number=float(data.f_number),
        efl_mm=efl,
    )
