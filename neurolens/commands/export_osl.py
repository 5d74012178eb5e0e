"""Shaders of `neurolens export --to osl`: of a model, or of a lens itself, every surface traced."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress

if TYPE_CHECKING:
    from neurolens.cameras.osl import OslCamera, Report
    from neurolens.graph.ir import Graph
    from neurolens.optics.prescription import Lens

# Of an exact lens: its wavelengths; its nearest focus in focal lengths; best focus lies beside the paraxial one by less
# than this share of the film's travel.
LIGHT_NM, _NEAR_EFL, _SPARE = (400.0, 700.0), 10.0, 0.1
_IDLE = 5e-4  # of the domain's rays: gates that alone block fewer go, and darken no pixel by a thousandth
MAX_STEPS = 12_000  # of a ray: compilers take minutes for more


@dataclass(frozen=True)
class Shader:
    """A camera's shader.

    Attributes:
        name: of the shader. text: its source. operations: of one ray. parameters: names of its inputs.
        passing: share of the rays that pass, by f-number. film_radius_mm, f_number, nearest_m: of the lens; the widest
            stop, and the nearest object, None where the film does not focus.
    """

    name: str
    text: str
    operations: int
    parameters: tuple[str, ...]
    passing: dict[str, float]
    film_radius_mm: float
    f_number: float
    nearest_m: float | None


def shader_of(file: Path, *, zoom: str | None = None, name: str | None = None, quiet: bool = False) -> Shader:
    """The shader of a model (.onnx) or of a lens file (.toml).

    Args:
        zoom: state of a zoom by name or focal length. name: of the shader; None takes the lens's id.

    Raises:
        InputError: coatings or glass that absorbs in a lens file, a name that is no identifier, a lens that is too
            large for compilers.
    """
    from neurolens.cameras.osl import parameters, write_camera
    from neurolens.cameras.pupil_arcs_fit import passing
    from neurolens.surrogates.source import OSL, checked_name, lines_of

    with Progress(quiet=quiet).stage(f"fit the pupil of {file.stem}") as report:
        if file.suffix == ".toml":
            from neurolens.optics.lensfile import read_lens

            lens = read_lens(file).at(zoom=zoom)
            own, camera = checked_name(OSL, lens.lens_id, name), exact_camera(lens, report)
            told = [f"{lens.name}: every surface traced (bare), {lens.source} (sha256 {str(lens.sha256)[:16]})."]
        else:
            own, camera, told = _of_model(file, zoom, name, report)
    shares = passing(camera.sight, camera.arcs)
    passed = {f"{camera.f_number / share:.3g}": value for share, value in shares.items()}
    near = f"from {camera.near_m:.4g} m" if math.isfinite(camera.near_m) else "fixed"
    comment = [
        f"A camera for Blender's Cycles (4.5 and later), written by neurolens {__version__} from {file.name}.",
        *told,
        f"Film radius {camera.arcs.film_radius_mm:.4g} mm, f/{camera.f_number:.3g}, focus {near}; rays that pass: "
        + ", ".join(f"f/{n} {share:.1%}" for n, share in passed.items()) + ".",
        "Sensor size and shift are Blender's. Focus: focus_m, or where that is 0 the distance of depth of field.",
    ]  # fmt: skip
    text, operations = write_camera(camera, own, lines_of(comment))
    if operations > MAX_STEPS:
        raise InputError("export", "operations", operations, f"up to {MAX_STEPS}: a model of the lens is smaller")
    return Shader(
        own, text, operations, tuple(p.name for p in parameters(camera)), passed, camera.arcs.film_radius_mm,
        camera.f_number, camera.near_m if math.isfinite(camera.near_m) else None,
    )  # fmt: skip


def _of_model(file: Path, zoom: str | None, name: str | None, report: Report) -> tuple[str, OslCamera, list[str]]:
    from neurolens.cameras.onnxlens import load_model
    from neurolens.cameras.osl import model_camera
    from neurolens.modelfile.states import state_for
    from neurolens.surrogates.source import OSL, checked_name

    model = load_model(file)
    if model.axes or zoom is not None:
        model = model.at(*state_for(model.path, model.axes, model.state, zoom, math.inf))
    lens, fit = model.card["lens"], model.card["fit"]
    own = checked_name(OSL, str(lens["id"]), name)
    state = ", ".join(f"{a.name} {v:.5g}" for a, v in zip(model.axes, model.state, strict=True))
    told = [f"{lens['name']}: {fit['method']}, {lens['source']} (sha256 {lens['sha256'][:16]})."]
    return (
        own,
        model_camera(model, _smallest(file, bool(model.axes)), report),
        told + [f"State: {state}."] * bool(state),
    )


def _smallest(file: Path, has_states: bool) -> Graph | None:
    """The graph of a model from its coefficients, a third smaller than that in its file; None without torch."""
    from importlib.util import find_spec

    if has_states or find_spec("torch") is None:
        return None
    from neurolens.surrogates.assemble import SCALARS, model_graph
    from neurolens.surrogates.export import largest_angle
    from neurolens.surrogates.specialise import without_idle_gates
    from neurolens.surrogates.stored import load_fitted

    (model,) = without_idle_gates((load_fitted(file),), _IDLE)
    return model_graph(model, largest_angle(model), SCALARS)


def exact_camera(lens: Lens, report: Report) -> OslCamera:
    """Of a lens itself, every surface traced; focused by moving its film, down to ten focal lengths.

    Raises:
        InputError: coatings or glass that absorbs.
    """
    from neurolens.cameras.exact import check_bare
    from neurolens.cameras.focus_function import Focusing
    from neurolens.cameras.osl import osl_camera
    from neurolens.cameras.pupil_arcs_fit import Sight
    from neurolens.cameras.pupil_boxes import PupilTable
    from neurolens.optics.focusing import best_focus_of_stops_mm
    from neurolens.optics.paraxial import film_z_mm, first_order
    from neurolens.optics.pupils import image_radius_mm, pupil_bounds, pupil_plane_z_mm
    from neurolens.optics.tracegraph import exact_graph

    check_bare(lens)
    data, plane, (radius, _) = first_order(lens), pupil_plane_z_mm(lens), image_radius_mm(lens)
    apart, efl = abs(float(data.rear_principal_z_mm - data.front_principal_z_mm)), float(data.efl_mm)
    near = (_NEAR_EFL * abs(efl) + apart) / 1000
    infinity, close = film_z_mm(lens, math.inf), film_z_mm(lens, near)
    spare = _SPARE * abs(close - infinity)
    places = min(infinity, close) - spare, max(infinity, close) + spare
    bounds = pupil_bounds(lens, radius, places, LIGHT_NM, rows=17, points=96)
    stop = float(lens.stop_radius_mm)

    def best(focus_m: float, stops_mm: Any) -> Any:
        return best_focus_of_stops_mm(lens, focus_m, stops_mm, LIGHT_NM)

    table = PupilTable.of(asdict(bounds))
    graph = exact_graph(lens, plane, LIGHT_NM)
    sight = Sight(graph, table, places, LIGHT_NM, stop, lens.stop_index, lens.anamorphic)
    focusing = Focusing(near, stop, lambda focus_m: film_z_mm(lens, focus_m), best, places)
    return osl_camera(sight, focusing, float(data.f_number), efl, report)
