"""Exported lens models and their inverse maps, run by onnxruntime: rays in, rays out, numpy arrays.

What runs is the graph that is built from the coefficients in a file, never the nodes in it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.contract import FloatArray
from neurolens.graph.ir import Graph, pruned
from neurolens.graph.onnx import write_onnx
from neurolens.lens.prescription import Surface
from neurolens.surrogates.assemble import ONNX, SCALARS, Form, model_graph
from neurolens.surrogates.axes import state_numbers
from neurolens.surrogates.card import card_at, default_state
from neurolens.surrogates.file import ModelFile, check_size, read_model
from neurolens.surrogates.inverse import Guess, front_index, scene_graph, stop_graph
from neurolens.surrogates.model import LensModel
from neurolens.trace.surfaces import front_rays


def open_session(
    path: Path, data: bytes, inputs: dict[str, tuple[Any, ...]], outputs: dict[str, tuple[Any, ...]]
) -> Any:
    """A session of onnxruntime on the CPU.

    Raises:
        ModelError: onnxruntime cannot load the bytes, or inputs or outputs are others than those expected: by name the
            type, then the dimensions, None for the number of rays.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # batches fit a core's cache
    options.log_severity_level = 4  # what goes wrong is raised, not printed
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        inside = [_shapes(session.get_inputs()), _shapes(session.get_outputs())]
    except Exception as error:  # onnxruntime raises types of its own, without a common base
        raise ModelError(f"{path}: onnxruntime cannot load it ({_first_line(error)})") from error
    for what, expected, shapes in zip(("input", "output"), (inputs, outputs), inside, strict=True):
        if shapes != expected:
            raise ModelError(f"{path}: {what}s: got {shapes}, expected {expected} (None: the number of rays)")
    return session


def _shapes(tensors: Any) -> dict[str, tuple[Any, ...]]:
    """Type and dimensions by name; a dimension that has a name is None. A name that is no UTF-8 raises an error."""
    return {v.name: (v.type, *(None if isinstance(d, str) else d for d in v.shape)) for v in tensors}


def run_batches(
    path: Path,
    session: Any,
    outputs: Sequence[str],
    rays: Mapping[str, NDArray[np.float32]],
    call: Mapping[str, Any],
    batch: int,
) -> list[NDArray[Any]]:
    """The outputs for any number of rays, which are the last axis of all of them.

    Args:
        rays: inputs [K, N]. call: the other inputs, the same for all rays.
        batch: rays a call of onnxruntime, at most.

    Raises:
        ModelError: onnxruntime cannot run the model `path`.
    """
    count = next(iter(rays.values())).shape[1]
    numbers = {name: np.atleast_1d(np.asarray(value, np.float32)) for name, value in call.items()}
    # Calls of about the same size: few rays cost nearly as much as many.
    ends = np.linspace(0, count, max(1, -(-count // batch)) + 1).astype(int)
    parts = []
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        feeds = {name: _padded(columns[:, start:end]) for name, columns in rays.items()} | numbers
        try:
            done = session.run(list(outputs), feeds)
        except Exception as error:  # onnxruntime raises types of its own, without a common base
            raise ModelError(f"{path}: onnxruntime cannot run it ({_first_line(error)})") from error
        parts.append([values[..., : end - start] for values in done])
    return parts[0] if len(parts) == 1 else [np.concatenate(of_one, -1) for of_one in zip(*parts, strict=True)]


def _padded(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same columns [R, N] and further ones of zeros where N would make onnxruntime slow.

    Rows a power of two apart share cache lines, which makes matrix products a third slower.
    """
    rows, count = values.shape
    if count % 1024:
        return np.ascontiguousarray(values)
    whole = np.zeros((rows, count + 16), np.float32)
    whole[:, :count] = values
    return whole


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


INPUTS = {"rays": ("tensor(float)", 5, None), "film_z_mm": ("tensor(float)", 1), "stop_radius_mm": ("tensor(float)", 1)}
OUTPUTS = {
    "scene_ray": ("tensor(float)", 6, None),
    "transmittance": ("tensor(float)", None),
    "stop_xy_mm": ("tensor(float)", 2, None),
    "status": ("tensor(int32)", None),
}
# Rays a call of onnxruntime: enough to hide the cost of its operators, few enough for the caches.
BATCH = 16384
MAX_RAYS = 2**27


class LensRays(NamedTuple):
    """The answer of a model for N rays; lens frame, mm. Rays are valid where status is 0.

    scene_ray [6, N] float32 (x, y, z, unit direction), transmittance [N], stop_xy_mm [2, N] (crossing with the stop),
    status [N] int32 (see `neurolens.base.status`).
    """

    scene_ray: FloatArray
    transmittance: FloatArray
    stop_xy_mm: FloatArray
    status: NDArray[np.int32]


class OnnxLens:
    """An exported model, loaded and checked. Make it with `load_model`.

    Attributes:
        file: what the file says.
        card: see `neurolens.surrogates.card`; its lens and domain are those of `state`.
        path: of the file.
        axes: what the model's state is made of (zoom in mm, focus in 1/m); none for a model of one state.
        state: a number for every axis.
    """

    def __init__(self, file: ModelFile) -> None:
        self.file, self.path, self.card = file, file.path, file.card
        self.axes, self.state = file.axes, default_state(file.card)
        self._sessions: dict[tuple[Any, ...], Any] = {}  # by process and outputs; opened when they are needed
        self._graphs: dict[Form, Graph] = {}

    def at(self, *state: float) -> OnnxLens:
        """The same model in another state, its card with the lens and the domain there.

        Raises:
            InputError: another number of values than axes, or one out of range.
        """
        if not self.axes and not state:
            return self
        other = OnnxLens(self.file)
        other.card, other.state = card_at(self.file.card, self.axes, state), tuple(float(v) for v in state)
        return other

    @cached_property
    def fitted(self) -> LensModel:
        """The model of this state: its coefficients, its encoding and its domain."""
        return self.file.at(self.state)

    def graph(self, form: Form = SCALARS) -> Graph:
        """The graph of the model in its state; inputs and outputs as `surrogates.assemble` says."""
        if form not in self._graphs:
            self._graphs[form] = model_graph(self.fitted, form)
        return self._graphs[form]

    @np.errstate(over="ignore")  # numbers that float32 does not hold are outside the domain
    def rays(
        self,
        film_xy_mm: ArrayLike,
        pupil_xy_mm: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | ArrayLike | None = None,
        stop_radius_mm: float | None = None,
        state: float | Sequence[float] | None = None,
    ) -> LensRays:
        """Scene-side rays of camera rays.

        Args:
            film_xy_mm, pupil_xy_mm: [2, N], lens frame, on the film plane and on the plane domain.pupil_z_mm.
            wavelength_nm: [N], or one number.
            film_z_mm: film plane; None takes the paraxial image of the farthest focus. An array [N] costs
                a call for each distinct value.
            stop_radius_mm: None takes the widest stop.
            state: of a model of many states, a number for every axis; None takes `self.state`, at first the first end
                of every axis. Out of range, every ray is outside the domain.

        Raises:
            InputError: arrays of other shapes, or another number of states than axes. Rays outside the domain are no
                error: their status says so.
        """
        if state is not None:
            values = state_numbers(self.axes, state)
            if all(a.limits[0] <= v <= a.limits[1] for a, v in zip(self.axes, values, strict=True)):
                return self.at(*values).rays(film_xy_mm, pupil_xy_mm, wavelength_nm, film_z_mm, stop_radius_mm)
        points = {"film_xy_mm": film_xy_mm, "pupil_xy_mm": pupil_xy_mm}
        columns = ray_columns("OnnxLens.rays", 2, points, wavelength_nm)
        stop = self.card["domain"]["stop_radius_mm"] if stop_radius_mm is None else stop_radius_mm
        film_z_mm = self.card["lens"]["film_z_mm"] if film_z_mm is None else film_z_mm
        plane, count = np.atleast_1d(np.asarray(film_z_mm, np.float32)), columns.shape[1]
        if plane.shape not in ((1,), (count,)):
            raise InputError("OnnxLens.rays", "film_z_mm", plane.shape, f"a number or an array ({count},)")
        if state is not None:  # out of range
            status = np.full(count, st.OUTSIDE_DOMAIN, np.int32)
            ray, through, crossing = (np.zeros(shape, np.float32) for shape in ((6, count), (count,), (2, count)))
            return LensRays(ray, through, crossing, status)
        if len(plane) == 1:
            return self._run(columns, plane, stop)
        planes, at = np.unique(plane, return_inverse=True)
        parts = [self._run(columns[:, at == k], planes[k : k + 1], stop) for k in range(len(planes))]
        place = np.argsort(np.argsort(at, kind="stable"), kind="stable")
        return LensRays(*(np.concatenate(of_one, -1)[..., place] for of_one in zip(*parts, strict=True)))

    def _run(self, rays: FloatArray, plane: FloatArray, stop_radius_mm: float) -> LensRays:
        session, call = self._session(tuple(OUTPUTS)), {"film_z_mm": plane, "stop_radius_mm": stop_radius_mm}
        return LensRays(*run_batches(self.path, session, tuple(OUTPUTS), {"rays": rays}, call, BATCH))

    def status(
        self, film_xy_mm: FloatArray, pupil_xy_mm: FloatArray, wavelength_nm: FloatArray, film_z_mm: float, stop: float
    ) -> NDArray[np.int32]:
        """`rays(...).status` alone, in less time: nothing else is computed. Arguments as there."""
        points = {"film_xy_mm": film_xy_mm, "pupil_xy_mm": pupil_xy_mm}
        rays = {"rays": ray_columns("OnnxLens.status", 2, points, wavelength_nm)}
        session, call = self._session(("status",)), {"film_z_mm": film_z_mm, "stop_radius_mm": stop}
        found: NDArray[np.int32] = run_batches(self.path, session, ("status",), rays, call, BATCH)[0]
        return found

    def _session(self, outputs: tuple[str, ...]) -> Any:
        key = os.getpid(), *outputs  # a forked process opens its own
        if key not in self._sessions:
            graph = self.graph(ONNX)
            wanted = pruned(graph, {name: graph.outputs[name] for name in outputs})
            shapes = {name: OUTPUTS[name] for name in outputs}
            self._sessions[key] = open_session(self.path, write_onnx(wanted, {}), INPUTS, shapes)
        return self._sessions[key]


def load_model(path: str | Path, lens: str | None = None) -> OnnxLens:
    """Load an exported model and check it.

    Args:
        lens: SHA-256 of the prescription (`Lens.sha256`) that the model must stand for; None takes any.

    Raises:
        ModelError: as `read_model`; a file of another lens, or of an inverse map.
    """
    file = read_model(path)
    if "inverse" in file.card:
        raise ModelError(f"{file.path}: card: inverse: it is an inverse map, expected a model")
    check_lens(file, lens)
    return OnnxLens(file)


def check_lens(file: ModelFile, lens: str | None) -> None:
    """Refuse a file of another lens than the one with this SHA-256; None takes any. Raises ModelError: as it says."""
    known = str(file.card["lens"]["sha256"])
    if lens is not None and known != lens:
        raise ModelError(
            f"{file.path}: card: lens.sha256: got {known[:16]}... ({file.card['lens']['name']}), expected "
            f"{lens[:16]}...: the model stands for another lens"
        )


def ray_columns(
    where: str, rows: int, points: Mapping[str, ArrayLike], wavelength_nm: ArrayLike, dtype: type = np.float32
) -> NDArray[Any]:
    """Arrays [rows, N] of points or directions, by name, and wavelengths [N] or one for all, below each other.

    Raises:
        InputError: other shapes; more than `MAX_RAYS`.
    """
    try:
        given: list[NDArray[Any]] = [np.asarray(v, dtype) for v in (*points.values(), wavelength_nm)]
    except (ValueError, TypeError) as error:
        raise InputError(where, f"{', '.join(points)}, wavelength_nm", "(no arrays)", "arrays of numbers") from error
    *arrays, wavelength = given
    count = arrays[0].shape[1] if arrays[0].ndim == 2 else MAX_RAYS
    for name, array in zip(points, arrays, strict=True):
        if array.shape != (rows, count) or count > MAX_RAYS:
            expected = f"an array ({rows}, N) with N up to {MAX_RAYS}, the same for all"
            raise InputError(where, name, f"({array.shape})", expected)
    if wavelength.shape not in ((), (count,)):
        raise InputError(where, "wavelength_nm", f"({wavelength.shape})", f"a number or an array ({count},)")
    return np.concatenate([*arrays, np.broadcast_to(wavelength, (1, count))])


# ---- inverse maps: from stop points and from scene rays back to camera rays ----


_MAP_BATCH = 4096  # these graphs have more rows than those of models alone
_MAP_OUTPUTS = {"rays": ("tensor(float)", 5, None), **OUTPUTS, "density": ("tensor(float)", None)}
_GIVEN = {"stop": "stop_rays", "scene": "front_rays"}


class InverseRays(NamedTuple):
    """Camera rays found, [N]; they mean something where status is 0.

    rays [5, N] float32 (film x, y, pupil x, y in mm, wavelength in nm); scene_ray [6, N], transmittance [N], stop_xy_mm
    [2, N] and status [N] as the model gives them for those rays, with NO_SOLUTION where they are not what was asked
    for; density [N]: of `through_stop` |d stop / d pupil|, of `from_scene` mm^2 of film times mm^2 of the pupil plane
    per mm^2 of (x, y) on the front surface and steradian.
    """

    rays: FloatArray
    scene_ray: FloatArray
    transmittance: FloatArray
    stop_xy_mm: FloatArray
    status: NDArray[np.int32]
    density: FloatArray


class OnnxInverse:
    """The inverse maps of one model. Make it with `load_inverse`.

    Attributes:
        card: of the model; its entry "inverse" says how the map was fitted and how often it converges, by map.
    """

    def __init__(self, maps: Mapping[str, tuple[Any, ModelFile]], path: Path) -> None:
        self.path, self._maps = path, maps
        self.card = next(iter(maps.values()))[1].card

    def through_stop(
        self,
        film_xy_mm: ArrayLike,
        stop_xy_mm: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | None = None,
        stop_radius_mm: float | None = None,
    ) -> InverseRays:
        """Rays from film points [2, N] through stop points [2, N].

        Raises:
            InputError: arrays of other shapes, or no file of this map.
        """
        points = {"film_xy_mm": film_xy_mm, "stop_xy_mm": stop_xy_mm}
        return self._run("stop", ray_columns("OnnxInverse", 2, points, wavelength_nm), film_z_mm, stop_radius_mm)

    def from_scene(
        self,
        origin_mm: ArrayLike,
        direction: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | None = None,
        stop_radius_mm: float | None = None,
    ) -> InverseRays:
        """Camera rays of light along scene rays.

        Args:
            origin_mm: [3, N], a point of each ray before or on the front surface, lens frame.
            direction: [3, N] unit vectors of the camera rays, away from the lens: from a point X of the front surface
                to a scene point S, (S - X) / |S - X|.

        Raises:
            InputError: arrays of other shapes, or no file of this map.
        """
        lines = {"origin_mm": origin_mm, "direction": direction}
        *rays, wavelength = ray_columns("OnnxInverse", 3, lines, wavelength_nm, np.float64)
        index = front_index(self._map("scene")[1].nodes[0])
        known, solid = front_rays(self.front, *rays, index=index, wavelength_nm=wavelength)
        out = self._run("scene", np.concatenate([known, [wavelength]]), film_z_mm, stop_radius_mm)
        with np.errstate(all="ignore"):  # area of direction vectors to solid angle
            return out._replace(density=(out.density / solid).astype(np.float32))

    @property
    def front(self) -> Surface | None:
        """The surface on which scene rays are taken; None for the plane z = 0.

        Raises:
            InputError: no file of the map of scene rays.
        """
        return self._map("scene")[1].nodes[0].front

    def _map(self, name: str) -> tuple[Any, ModelFile]:
        if name not in self._maps:
            raise InputError(self.path, "map", name, f"one of those found: {', '.join(self._maps)}")
        return self._maps[name]

    def _run(
        self, name: str, given: NDArray[Any], film_z_mm: float | None, stop_radius_mm: float | None
    ) -> InverseRays:
        session, file = self._map(name)
        card, domain = file.card, file.card["domain"]
        call = {
            "film_z_mm": card["lens"]["film_z_mm"] if film_z_mm is None else film_z_mm,
            "stop_radius_mm": domain["stop_radius_mm"] if stop_radius_mm is None else stop_radius_mm,
        }
        with np.errstate(over="ignore"):
            rays = {_GIVEN[name]: given.astype(np.float32)}
        return InverseRays(*run_batches(self.path, session, InverseRays._fields, rays, call, _MAP_BATCH))


def load_inverse(path: str | Path, lens: str | None = None) -> OnnxInverse:
    """Load the inverse maps that lie beside a model: NAME.stop.onnx and NAME.scene.onnx for NAME.onnx.

    Args:
        path: of the model. lens: see `load_model`.

    Raises:
        ModelError: neither file is there, or one is damaged, of another lens, or does not lead the card's reference
            rays back.
    """
    base = Path(path).with_suffix("")
    maps = {}
    for name in _GIVEN:
        file = base.with_name(f"{base.name}.{name}.onnx")
        if file.is_file():
            maps[name] = _load(file, name, lens)
    if not maps:
        raise ModelError(f"{base}.stop.onnx, {base}.scene.onnx: no such files, expected exported inverse maps")
    inverse = OnnxInverse(maps, Path(path))
    for name, (_, model) in maps.items():
        _check(inverse, name, model.card)
    return inverse


def _load(path: Path, name: str, lens: str | None) -> tuple[Any, ModelFile]:
    file = read_model(path)
    facts = file.card.get("inverse")
    if not isinstance(facts, dict) or facts.get("map") != name or file.axes:
        raise ModelError(f"{path}: card: inverse: got {str(facts)[:80]}, expected the facts of the {name} map")
    check_lens(file, lens)
    build = stop_graph if name == "stop" else scene_graph
    try:
        with np.errstate(all="ignore"):
            guess = Guess.unpacked(file.more["guess"])
            check_size((guess.exponents, guess.ab))
            data = write_onnx(build(file.nodes[0], guess, ONNX), {})
    except (ValueError, TypeError, KeyError, IndexError, ArithmeticError, AttributeError) as error:
        raise ModelError(f"{path}: its first guess is damaged ({type(error).__name__}: {error})") from error
    inputs = {_GIVEN[name] if key == "rays" else key: shape for key, shape in INPUTS.items()}
    return open_session(path, data, inputs, _MAP_OUTPUTS), file


def _check(inverse: OnnxInverse, name: str, card: dict[str, Any]) -> None:
    """Nine of ten of the card's passing reference rays come back; folded maps lead a few to another ray."""
    try:
        reference = card["reference"]
        passed = np.asarray(reference["status"]) == st.PASSED
        rays = np.asarray(reference["rays"], np.float64)[:, passed]
        call = (rays[4], float(reference["film_z_mm"][0]), float(reference["stop_radius_mm"]))
        if name == "stop":
            found = inverse.through_stop(rays[:2], np.asarray(reference["stop_xy_mm"])[:, passed], *call)
        else:
            scene = np.asarray(reference["scene_ray"], np.float64)[:, passed]
            found = inverse.from_scene(scene[:3], scene[3:], *call)
    except (InputError, KeyError, TypeError, ValueError, IndexError) as error:
        raise ModelError(f"{inverse.path}: {name}: card: reference: {type(error).__name__}: {error}") from error
    off = np.abs(found.rays[:4] - rays[:4]).max(0)
    back = (off < 1e-3 * float(card["domain"]["pupil_radius_mm"])) & (found.status == st.PASSED)
    if not (back.size and back.mean() >= 0.9):
        raise ModelError(f"{inverse.path}: {name} map: {int(back.sum())} of {back.size} reference rays come back")
