"""Exported lens models, run by onnxruntime on numpy arrays: rays in, rays out.

What runs is a graph that is built from the coefficients in a file, never the nodes stored in it.
"""

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.contract import FloatArray
from neurolens.graph.ir import Graph, pruned
from neurolens.graph.onnx import write_onnx
from neurolens.models.assemble import ONNX, SCALARS, Form, model_graph
from neurolens.models.axes import state_numbers
from neurolens.models.card import card_at, default_state
from neurolens.models.file import ModelFile, read_model
from neurolens.models.model import LensModel


def open_session(
    path: Path, data: bytes, inputs: dict[str, tuple[Any, ...]], outputs: dict[str, tuple[Any, ...]]
) -> Any:
    """Open a session of onnxruntime on the CPU.

    Args:
        path: of the file, for errors.
        data: the model's bytes.
        inputs, outputs: those expected: by name the type and then the dimensions, None for the number of rays.

    Raises:
        ModelError: onnxruntime cannot load the bytes, or has other inputs or outputs than those expected.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # batches fit a core's cache
    # A plan of which arrays share memory takes a time that grows with the square of the nodes: 7 s for 2,600, an exact
    # lens with aspheres. Without a plan it opens in 0.5 s and runs as fast, for memory that is freed is taken again.
    options.enable_mem_reuse = False
    # Nothing is left to simplify in what this package writes: searching for it takes two thirds of the time to open.
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.log_severity_level = 4  # errors are raised, so printing them would repeat them
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
    """Return type and dimensions by name; a named dimension is None. A name that is no UTF-8 raises an error."""
    return {v.name: (v.type, *(None if isinstance(d, str) else d for d in v.shape)) for v in tensors}


def run_batches(
    path: Path,
    session: Any,
    outputs: Sequence[str],
    rays: Mapping[str, NDArray[np.float32]],
    call: Mapping[str, Any],
    batch: int,
) -> list[NDArray[Any]]:
    """Run any number of rays, which are the last axis of all arrays, and return the outputs.

    Args:
        path: of the model, for errors.
        session: see `open_session`.
        outputs: names of those wanted.
        rays: inputs [K, N].
        call: the other inputs, which are the same for all rays.
        batch: the most rays for one call of onnxruntime.

    Raises:
        ModelError: onnxruntime cannot run the model.
    """
    count = next(iter(rays.values())).shape[1]
    numbers = {name: np.atleast_1d(np.asarray(value, np.float32)) for name, value in call.items()}
    # Calls get about equal sizes, because few rays cost nearly as much as many.
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
    """Return the same columns [R, N], followed by zeros where N would make onnxruntime slow.

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
# Rays for a call of onnxruntime: enough to hide the cost of its operators, few enough for the caches.
BATCH = 16384
MAX_RAYS = 2**27


class LensRays(NamedTuple):
    """A model's answer for N rays, in the lens frame and mm; valid where the status is 0.

    Attributes:
        scene_ray: [6, N] float32: x, y, z and the unit direction.
        transmittance: [N].
        stop_xy_mm: [2, N], the crossing with the stop.
        status: [N] int32, see `neurolens.base.status`.
    """

    scene_ray: FloatArray
    transmittance: FloatArray
    stop_xy_mm: FloatArray
    status: NDArray[np.int32]


class LensRun:
    """Runs the graph of a lens, exact or modelled, in onnxruntime, for rays through points of its pupil.

    Attributes:
        path: of the lens's file, for messages.
        stop_index: the surface at the stop.
    """

    stop_index: int

    def __init__(self, path: Path) -> None:
        self.path = path
        self._sessions: dict[tuple[Any, ...], Any] = {}  # by process and outputs; opened when needed

    def graph(self, form: Form = SCALARS) -> Graph:
        """Return the graph of the lens, with inputs and outputs as `models.assemble` has them."""
        raise NotImplementedError

    def run(self, rays: FloatArray, film_z_mm: ArrayLike, stop_radius_mm: float) -> LensRays:
        """Return the scene rays of columns [5, N] as `ray_columns` makes them."""
        call = {"film_z_mm": film_z_mm, "stop_radius_mm": stop_radius_mm}
        names = tuple(OUTPUTS)
        return LensRays(*run_batches(self.path, self._session(names), names, {"rays": rays}, call, BATCH))

    def status(self, rays: FloatArray, film_z_mm: float, stop_radius_mm: float) -> NDArray[np.int32]:
        """Return `run(...).status` alone, which takes less time, since nothing else is computed."""
        call = {"film_z_mm": film_z_mm, "stop_radius_mm": stop_radius_mm}
        names = ("status",)
        return run_batches(self.path, self._session(names), names, {"rays": rays}, call, BATCH)[0]

    def _session(self, outputs: tuple[str, ...]) -> Any:
        key = os.getpid(), *outputs  # a forked process opens its own
        if key not in self._sessions:
            graph = self.graph(ONNX)
            wanted = pruned(graph, {name: graph.outputs[name] for name in outputs})
            shapes = {name: OUTPUTS[name] for name in outputs}
            self._sessions[key] = open_session(self.path, write_onnx(wanted, {}), INPUTS, shapes)
        return self._sessions[key]


class OnnxLens(LensRun):
    """An exported model, loaded and checked; make it with `load_model`.

    Attributes:
        file: what the file says.
        card: see `neurolens.models.card`; its lens and domain are those of `state`.
        axes: what the model's state consists of (zoom in mm, focus in 1/m); empty for a model of one state.
        state: a number for every axis.
    """

    def __init__(self, file: ModelFile) -> None:
        super().__init__(file.path)
        self.file, self.card, self.axes, self.state = file, file.card, file.axes, default_state(file.card)
        self.stop_index = int(file.card["lens"].get("stop_surface", 0))
        self._graphs: dict[Form, Graph] = {}

    def at(self, *state: float) -> Self:
        """Return the model in another state; its card then has the lens and the domain of that state.

        Raises:
            InputError: a number of values other than that of the axes, or a value out of range.
        """
        if not self.axes and not state:
            return self
        other = type(self)(self.file)
        other.card, other.state = card_at(self.file.card, self.axes, state), tuple(float(v) for v in state)
        return other

    @cached_property
    def fitted(self) -> LensModel:
        """Return the model of this state: its coefficients, its encoding and its domain."""
        return self.file.at(self.state)

    def graph(self, form: Form = SCALARS) -> Graph:
        """Return the graph of the model in its state, with inputs and outputs as `models.assemble` has them."""
        if form not in self._graphs:
            self._graphs[form] = model_graph(self.fitted, form)
        return self._graphs[form]

    @np.errstate(over="ignore")  # numbers too large for float32 are outside the domain
    def rays(
        self,
        film_xy_mm: ArrayLike,
        pupil_xy_mm: ArrayLike,
        wavelength_nm: ArrayLike,
        film_z_mm: float | ArrayLike | None = None,
        stop_radius_mm: float | None = None,
        state: float | Sequence[float] | None = None,
    ) -> LensRays:
        """Trace camera rays to the scene side.

        Args:
            film_xy_mm, pupil_xy_mm: [2, N], lens frame, on the film plane and on the plane `domain.pupil_z_mm`.
            wavelength_nm: [N], or one number.
            film_z_mm: film plane; None takes the paraxial image of the farthest focus. An array [N] costs a call for
                each distinct value.
            stop_radius_mm: None takes the widest stop.
            state: a number for every axis of a model of many states; None takes `self.state`, which starts with the
                first end of every axis. For a state out of range, every ray is outside the domain.

        Raises:
            InputError: arrays of other shapes, or a number of states other than that of the axes. Rays outside the
                domain are no error: their status tells.
        """
        if state is not None:
            values = state_numbers(self.axes, state)
            if all(a.limits[0] <= v <= a.limits[1] for a, v in zip(self.axes, values, strict=True)):
                return self.at(*values).rays(film_xy_mm, pupil_xy_mm, wavelength_nm, film_z_mm, stop_radius_mm)
        points = {"film_xy_mm": film_xy_mm, "pupil_xy_mm": pupil_xy_mm}
        columns = ray_columns("OnnxLens.rays", points, wavelength_nm)
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
            return self.run(columns, plane, stop)
        planes, at = np.unique(plane, return_inverse=True)
        parts = [self.run(columns[:, at == k], planes[k : k + 1], stop) for k in range(len(planes))]
        place = np.argsort(np.argsort(at, kind="stable"), kind="stable")
        return LensRays(*(np.concatenate(of_one, -1)[..., place] for of_one in zip(*parts, strict=True)))


def load_model(path: str | Path, lens: str | None = None) -> OnnxLens:
    """Load an exported model and check it.

    Args:
        path: the model's file.
        lens: SHA-256 of the prescription (`Lens.sha256`) that the model must stand for; None takes any.

    Raises:
        ModelError: as `read_model` raises it, and for a model of another lens.
    """
    file = read_model(path)
    known = str(file.card["lens"]["sha256"])
    if lens is not None and known != lens:
        raise ModelError(
            f"{file.path}: card: lens.sha256: got {known[:16]}... ({file.card['lens']['name']}), expected "
            f"{lens[:16]}...: the model stands for another lens"
        )
    return OnnxLens(file)


def ray_columns(where: str, points: Mapping[str, ArrayLike], wavelength_nm: ArrayLike) -> FloatArray:
    """Stack arrays [2, N] of points, by name, and wavelengths, [N] or one for all.

    Raises:
        InputError: other shapes, or more than `MAX_RAYS` rays.
    """
    try:
        given = [np.asarray(v, np.float32) for v in (*points.values(), wavelength_nm)]
    except (ValueError, TypeError) as error:
        raise InputError(where, f"{', '.join(points)}, wavelength_nm", "(no arrays)", "arrays of numbers") from error
    *arrays, wavelength = given
    count = arrays[0].shape[1] if arrays[0].ndim == 2 else MAX_RAYS
    for name, array in zip(points, arrays, strict=True):
        if array.shape != (2, count) or count > MAX_RAYS:
            expected = f"an array (2, N) with N up to {MAX_RAYS}, the same for all"
            raise InputError(where, name, f"({array.shape})", expected)
    if wavelength.shape not in ((), (count,)):
        raise InputError(where, "wavelength_nm", f"({wavelength.shape})", f"a number or an array ({count},)")
    return np.concatenate([*arrays, np.broadcast_to(wavelength, (1, count))])
