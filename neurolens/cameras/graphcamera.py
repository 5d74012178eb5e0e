"""The camera class of lenses, exact or modelled: everything between the random numbers and the weighted ray.

A camera is one graph, that of its lens between the pupil and the weights (`lens_film.whole_camera`). Three runtimes
give the same rays to rounding:

    "onnxruntime"  the graph written as ONNX
    "c"            the graph compiled by the system's C compiler when the camera is made (1 to 10 s, kept for the next
                   time, see `graph.compiler`); it runs in float32 on the thread that calls it, and forks share it
    "trace"        the lens is traced by torch, surface by surface, and numpy runs the graph's two halves around it
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import D_FILM
from neurolens.cameras.contract import MANY_RAYS_A_CALL, RAYS_A_CALL, CameraRays, FloatArray
from neurolens.cameras.lens_film import LensFilm, LensGraph, camera_rays, whole_camera
from neurolens.cameras.onnxsession import open_session, run_batches
from neurolens.graph.c import Signature, padded_columns, write_blocks
from neurolens.graph.compiler import load_compiled
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import with_film_derivatives, with_low_order_derivatives
from neurolens.graph.onnx import write_onnx
from neurolens.graph.program import row_names
from neurolens.graph.scalars import lower
from neurolens.surrogates.assemble import ONNX, SCALARS, Form

Runtime = Literal["onnxruntime", "c", "trace"]
# Film points, pupil squares [2, N] and wavelengths [1, N] by name to what `camera_rays` takes.
GraphRun = Callable[[dict[str, FloatArray]], dict[str, NDArray[Any]]]

# The most steps of a camera that are compiled. The largest camera of a model that ships has 2900; gcc 12 takes 48 s for
# 7100, and its time grows faster than their number.
MAX_STEPS = 12_000
_SAMPLES = 4096  # rays that low-order derivatives are fitted to
_INPUTS = {"film_mm": ("tensor(float)", 2, None), "square": ("tensor(float)", 2, None)}
_INPUTS |= {"wavelength_nm": ("tensor(float)", 1, None)}
_OUTPUTS = {"ray": ("tensor(float)", 6, None), "weight": ("tensor(float)", None), "status": ("tensor(int32)", None)}


class LensCamera:
    """What cameras of lenses share; see `contract.Camera` for what all cameras do.

    Attributes:
        path: of the file of the lens or the model, for messages.
        film: film and pupil of the lens at its focus and stop. film_mm: width and height of the film.
        threads: of onnxruntime, within one operator.
        runtime: what runs the camera's graph.
        differentials_error: RMS error of fitted differentials over their size; None where differentials are the
            graph's own, or were not sampled yet. Compiled cameras fit them by polynomials of low order, within
            `loworder.WORST`: the graph's own cost as much as its rays.
    """

    path: Path
    film: LensFilm
    film_mm: tuple[float, float]
    settings: dict[str, Any]
    runtime: Runtime
    threads: int = 1
    differentials_error: float | None = None

    def lens_graph(self, form: Form = SCALARS) -> LensGraph:
        """The graph of the lens with its stop."""
        raise NotImplementedError

    @property
    def rays_a_call(self) -> int:
        """The rays with which a call is fastest."""
        return MANY_RAYS_A_CALL if self.runtime == "c" else RAYS_A_CALL

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self._sampled(film_mm, pupil, wavelength_nm, False)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials, too."""
        return self._sampled(film_mm, pupil, wavelength_nm, True)

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """cos^4 of the angles between the axis and the rays of `sample` on the film's side."""
        return self.film.natural(film_mm, pupil, wavelength_nm)

    def compiled(self) -> Self:
        """The same camera run as C; its film and pupil are not searched again. Raises InputError: no C compiler."""
        other = copy(self)
        other.start("c")
        return other

    def start(self, runtime: Runtime) -> None:
        """Choose what runs the camera; C is compiled at once. Raises InputError: no C compiler, or one that fails."""
        self.runtime, self._runs = runtime, dict[bool, GraphRun]()
        if runtime == "c":
            self.settings = self.settings | {"runtime": "fused"}
            self._run(False)

    def _sampled(self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray, moves: bool) -> CameraRays:
        film, square, wavelength = (np.ascontiguousarray(a, np.float32) for a in (film_mm, square, wavelength_nm))
        count = film.shape[1]
        if film.shape != (2, count) or square.shape != (2, count) or wavelength.shape != (count,):
            raise ValueError(f"film {film.shape}, square {square.shape}, wavelengths {wavelength.shape}")
        return camera_rays(self._run(moves)({"film_mm": film, "square": square, "wavelength_nm": wavelength[None]}))

    def _run(self, moves: bool) -> GraphRun:
        """The camera's graph in its runtime, with differentials or without them, made when it is first needed."""
        if moves not in self._runs:
            lens = self.lens_graph(SCALARS if self.runtime == "c" else ONNX)
            if moves:
                lens = lens._replace(graph=self._with_moves(lens.graph))
            self._runs[moves] = _compiled(self.film, lens) if self.runtime == "c" else self._in_onnxruntime(lens)
        return self._runs[moves]

    def _in_onnxruntime(self, lens: LensGraph) -> GraphRun:
        whole, numbers = whole_camera(self.film, lens, mask_too=True)
        g, mask = Graph(), lens.aperture and lens.aperture.mask
        constants = {name: g.constant(value) for name, value in numbers.items()}
        constants["outline"] = g.own_table(self.film.outline.table)
        if lens.aperture is not None and mask is not None:
            constants["mask"] = g.own_table(lens.aperture.table)
        g.outputs = g.inline(whole, constants)
        shapes = _OUTPUTS | {name: ("tensor(float)", 6, None) for name in D_FILM if name in g.outputs}
        path, names = self.path, tuple(shapes)
        session = open_session(path, write_onnx(g, {}), self.threads, _INPUTS, shapes)

        def run(rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
            done = run_batches(path, session, names, rays, {}, RAYS_A_CALL)
            found = {name: np.atleast_2d(values) for name, values in zip(names, done, strict=True)}
            derivatives = [found.pop(name) for name in D_FILM if name in found]
            return found | ({"d_film": np.stack(derivatives, 1)} if derivatives else {})

        return run

    def _with_moves(self, graph: Graph) -> Graph:
        """The lens's graph with the derivatives of its rays by the film point."""
        if self.runtime != "c":
            return with_film_derivatives(graph)
        fitted = with_low_order_derivatives(graph, self._film_samples())
        self.differentials_error = None if fitted is None else fitted.error
        return with_film_derivatives(graph) if fitted is None else fitted.graph

    def _film_samples(self) -> dict[str, FloatArray]:
        """Inputs of the lens's graph for rays all over film, pupil and wavelengths."""
        rng, outline = np.random.default_rng(0), self.film.outline
        film = (rng.random((2, _SAMPLES)) - 0.5) * np.array(self.film_mm)[:, None]
        film *= np.minimum(1, 0.99 * outline.film_radius_mm / np.hypot(*film))
        wavelength = rng.uniform(outline.wavelength_nm[0], outline.wavelength_nm[-1], _SAMPLES).astype(np.float32)
        film, square = film.astype(np.float32), rng.random((2, _SAMPLES), np.float32)
        rays = np.stack([*film, *outline.sample(film, square, wavelength)[0], wavelength])
        per_call = {"film_z_mm": self.film.film_z_mm, "stop_radius_mm": self.lens_graph().stop_radius_mm}
        return {"rays": rays} | {name: np.array([[value]], np.float32) for name, value in per_call.items()}


def _compiled(film: LensFilm, lens: LensGraph) -> GraphRun:
    """The camera's graph as a compiled function; a mask in the stop is tested on the rays that come back."""
    table = film.outline.table
    groups = table.reshape(len(table), -1, 5)
    run = _CompiledGraph(*whole_camera(film, lens), np.pad(groups, ((0, 0), (0, 0), (0, padded_columns(5) - 5))))
    mask = lens.aperture if lens.blades is None else None
    if mask is None:
        return run

    def masked(rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        found = run(rays)
        inside = mask.inside(found["stop_xy_mm"][0], found["stop_xy_mm"][1], lens.stop_radius_mm)
        shut = ~inside & (found["status"][0] == st.PASSED)
        found["weight"][0, shut], found["status"][0, shut] = 0, lens.stopped
        return found

    return masked


class _CompiledGraph:
    """A camera's graph as a compiled function, with numbers of the call and the outline's table."""

    def __init__(self, graph: Graph, numbers: dict[str, float], table: FloatArray) -> None:
        program = lower(graph).in_order_of_need()
        if len(program.steps) > MAX_STEPS:
            raise InputError("compiled camera", "steps", len(program.steps), f"up to {MAX_STEPS} for a compiler")
        self._rows = {name: (v.rows, np.int32 if name == "status" else np.float32) for name, v in graph.outputs.items()}
        self._signature = s = Signature.of(program, "camera")
        self._numbers, self._table = np.array([numbers[name] for name in s.per_call], np.float32), table
        self._call = load_compiled(write_blocks(program, "camera")).camera
        pointer = ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, pointer, pointer, pointer, ctypes.c_int, pointer, pointer]
        self._call.restype = None

    def __call__(self, rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        """What `lens_film.camera_rays` takes, for inputs [R, N]."""
        count = rays["film_mm"].shape[1]
        found: dict[str, NDArray[Any]] = {
            name: np.empty((rows, count), kind) for name, (rows, kind) in self._rows.items() if name not in D_FILM
        }
        arrays = rays | found
        if D_FILM[0] in self._rows:
            found["d_film"] = np.empty((6, 2, count), np.float32)
            arrays |= {name: found["d_film"][:, k] for k, name in enumerate(D_FILM)}
        places: dict[str, int] = {}
        for name, array in arrays.items():
            address, step = array.ctypes.data, array.strides[0]
            places |= {row: address + k * step for k, row in enumerate(row_names(name, len(array)))}
        given, out = (
            np.array([places[r] for r in rows], np.uintp) for rows in (self._signature.per_ray, self._signature.outputs)
        )
        numbers, table = self._numbers.ctypes.data, self._table.ctypes.data
        self._call(count, given.ctypes.data, numbers, table, len(self._table), out.ctypes.data, places["status"])
        return found
