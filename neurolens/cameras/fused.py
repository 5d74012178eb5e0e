"""Lenses as compiled C cameras: everything between the random numbers and the weighted ray in one call.

The system's C compiler makes the code when the camera is made (1 to 10 s, kept for the next time; see
`graph.compiler`). It runs in float32 on the thread that calls it; workers that are forked share it.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import D_FILM
from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FloatArray
from neurolens.cameras.lens_film import LensFilm, LensGraph, camera_rays, whole_camera
from neurolens.cameras.model import OnnxCamera
from neurolens.graph.c import Signature, padded_columns, write_blocks
from neurolens.graph.compiler import load_compiled
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import with_film_derivatives, with_low_order_derivatives
from neurolens.graph.program import row_names
from neurolens.graph.scalars import lower

# Of a camera with its lens: 2900 in the largest that ships. gcc 12 takes 48 s for 7100, and ever longer.
MAX_STEPS = 12_000
_SAMPLES = 4096  # rays that low-order derivatives are fitted to


class FusedFilm:
    """A lens's film and pupil, and the lens itself as a graph, as one compiled function.

    Differentials are polynomials fitted to those of the graph, within `loworder.WORST` of them, or else the graph's
    own, which cost as much as its rays.

    Args:
        film: of the same lens, focus and stop.
        lens: its graph.
        film_mm: width and height of the film whose rays differentials are fitted to.

    Attributes:
        moves_error: RMS error of fitted differentials over their size; None where they are the graph's own, or were
            not asked for yet.

    Raises:
        InputError: no C compiler, or one that fails.
    """

    def __init__(self, film: LensFilm, lens: LensGraph, film_mm: tuple[float, float]) -> None:
        self._film, self._lens, self._film_mm = film, lens, film_mm
        # A mask is tested on rays that come back.
        self._mask = lens.aperture if lens.blades is None else None
        self._rays = self._compiled(lens)
        self._rays_and_moves: _Compiled | None = None
        self.moves_error: float | None = None

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray, differentials: bool = False
    ) -> CameraRays:
        """Sample rays as `LensFilm.sample` does, with their differentials where the caller wants them."""
        film, square, wavelength = (np.ascontiguousarray(a, np.float32) for a in (film_mm, square, wavelength_nm))
        count = film.shape[1]
        if film.shape != (2, count) or square.shape != (2, count) or wavelength.shape != (count,):
            raise ValueError(f"film {film.shape}, square {square.shape}, wavelengths {wavelength.shape}")
        if differentials and self._rays_and_moves is None:
            self._rays_and_moves = self._compiled(self._with_differentials())
        run = self._rays_and_moves if differentials and self._rays_and_moves is not None else self._rays
        found = run({"film_mm": film, "square": square, "wavelength_nm": wavelength[None]})
        if self._mask is not None:
            inside = self._mask.inside(found["stop_xy_mm"][0], found["stop_xy_mm"][1], self._lens.stop_radius_mm)
            shut = ~inside & (found["status"][0] == st.PASSED)
            found["weight"][0, shut], found["status"][0, shut] = 0, self._lens.stopped
        return camera_rays(found)

    def _compiled(self, lens: LensGraph) -> _Compiled:
        table = self._film.outline.table
        groups = table.reshape(len(table), -1, 5)
        padded = np.pad(groups, ((0, 0), (0, 0), (0, padded_columns(5) - 5)))
        return _Compiled(*whole_camera(self._film, lens), padded)

    def _with_differentials(self) -> LensGraph:
        """The lens with differentials."""
        graph = self._lens.graph
        fitted = with_low_order_derivatives(graph, self._samples())
        self.moves_error = None if fitted is None else fitted.error
        return self._lens._replace(graph=with_film_derivatives(graph) if fitted is None else fitted.graph)

    def _samples(self) -> dict[str, FloatArray]:
        """Inputs of the graph for rays all over film, pupil and wavelengths."""
        rng, outline = np.random.default_rng(0), self._film.outline
        film = (rng.random((2, _SAMPLES)) - 0.5) * np.array(self._film_mm)[:, None]
        film *= np.minimum(1, 0.99 * outline.film_radius_mm / np.hypot(*film))
        wavelength = rng.uniform(outline.wavelength_nm[0], outline.wavelength_nm[-1], _SAMPLES).astype(np.float32)
        film, square = film.astype(np.float32), rng.random((2, _SAMPLES), np.float32)
        rays = np.stack([*film, *outline.sample(film, square, wavelength)[0], wavelength])
        per_call = {"film_z_mm": self._film.film_z_mm, "stop_radius_mm": self._lens.stop_radius_mm}
        return {"rays": rays} | {name: np.array([[value]], np.float32) for name, value in per_call.items()}


class Compiled:
    """What compiled cameras have in place of their lens's own sampling: `FusedFilm`."""

    _fused: FusedFilm
    rays_a_call = MANY_RAYS_A_CALL

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self._fused.sample(film_mm, pupil, wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does; the same pass gives their differentials."""
        return self._fused.sample(film_mm, pupil, wavelength_nm, True)

    @property
    def differentials_error(self) -> float | None:
        """See `FusedFilm.moves_error`."""
        return self._fused.moves_error


class FusedCamera(Compiled, OnnxCamera):
    """An exported model as a compiled camera: the rays of `OnnxCamera` to rounding, at a fraction of its cost.

    Args and attributes are those of `OnnxCamera`. Differentials (see `FusedFilm`) need no model exported with
    derivatives.

    Raises:
        InputError: as `OnnxCamera`; no C compiler; a model of operators that have no such form.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._compile()

    @classmethod
    def of(cls, camera: OnnxCamera) -> FusedCamera:
        """A camera of onnxruntime, compiled: its film and pupil are not searched again."""
        made = cls.__new__(cls)
        made.__dict__ |= camera.__dict__
        made._compile()
        return made

    def _compile(self) -> None:
        self._fused = FusedFilm(self.film, self.lens_graph(), self.film_mm)
        self.settings = self.settings | {"runtime": "fused"}

    def for_worker(self) -> FusedCamera:
        """This camera: compiled code needs no session of its own."""
        return self


class _Compiled:
    """A camera's graph as a compiled function, with numbers of the call and the outline's table."""

    def __init__(self, graph: Graph, numbers: dict[str, float], table: FloatArray) -> None:
        program = lower(graph).in_order_of_need()
        if len(program.steps) > MAX_STEPS:
            raise InputError("fused camera", "steps", len(program.steps), f"up to {MAX_STEPS}: not compiled, it works")
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
