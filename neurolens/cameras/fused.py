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
from neurolens.cameras.contract import MANY_RAYS_A_CALL, CameraRays, FloatArray, RayDifferentials
from neurolens.cameras.fusedsource import Setting, camera_source
from neurolens.cameras.lens_film import LensFilm
from neurolens.cameras.model import UNIT_SLACK, ModelScene, OnnxCamera
from neurolens.graph.compiler import load_compiled
from neurolens.graph.derive import derivative
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import with_film_derivatives, with_low_order_derivatives
from neurolens.graph.program import FILM_X_Y
from neurolens.graph.scalars import lower
from neurolens.modelfile.graph import graph_of
from neurolens.optics.apertures import Aperture

_SAMPLES = 4096  # rays that low-order derivatives are fitted to


class FusedFilm:
    """A lens's film and pupil, and the lens itself as a graph, as one compiled function.

    Differentials are polynomials fitted to those of the graph, within `loworder.WORST` of them, or else the graph's
    own, which cost as much as its rays.

    Args:
        film: of the same lens, focus and stop.
        graph: of the lens.
        stop_radius_mm: of its round stop.
        film_mm: width and height of the film whose rays differentials are fitted to.
        aperture: the shape of the opening, tested on the rays' crossings with the stop; None is round.
        stop_surface: of the lens, for the status of rays that the shape blocks.

    Attributes:
        moves_error: RMS error of fitted differentials over their size; None where they are the graph's own, or were
            not asked for yet.

    Raises:
        InputError: no C compiler, or one that fails; a pupil that is not sampled by its outline.
    """

    def __init__(
        self,
        film: LensFilm,
        graph: Graph,
        stop_radius_mm: float,
        film_mm: tuple[float, float],
        aperture: Aperture | None = None,
        stop_surface: int = 0,
    ) -> None:
        if film.pupil is not film.outline:
            raise InputError("camera", "pupil", "(another)", "outline: the only one that fused cameras sample")
        self._graph = graph
        self._aperture, self._stop_radius_mm = aperture, stop_radius_mm
        self._stopped = np.int32(st.blocked(stop_surface, st.RIM))
        self._outline, self._film_mm = film.outline, film_mm
        self._edges, self._centres = _tables(film)
        outline = film.outline
        waves = [w**-2 for w in outline.wavelength_nm]
        self._setting = Setting(
            self._edges.ctypes.data,
            self._centres.ctypes.data,
            outline.centre.size,
            outline.x.shape[2] - 1,
            1 / outline.film_radius_mm,
            waves[0],
            1 / (waves[1] - waves[0]) if len(waves) > 1 else 0.0,
            1 / film.distance_mm,
            1 / (film.distance_mm**2 * film.exposure),
            film.film_z_mm,
            stop_radius_mm,
            1e-3 * film.film_z_mm,
        )
        self._rays: Any = _compiled(graph)
        self._rays_and_moves: Any = None
        self.moves_error: float | None = None

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray, differentials: bool = False
    ) -> CameraRays:
        """As `LensFilm.sample`, with the differentials of the rays where asked for."""
        film, square, wavelength = (np.ascontiguousarray(a, np.float32) for a in (film_mm, square, wavelength_nm))
        count = film.shape[1]
        if film.shape != (2, count) or square.shape != (2, count) or wavelength.shape != (count,):
            raise ValueError(f"film {film.shape}, square {square.shape}, wavelengths {wavelength.shape}")
        origin, direction = np.empty((3, count), np.float32), np.empty((3, count), np.float32)
        weight, status = np.empty(count, np.float32), np.empty(count, np.int32)
        stop = np.empty((2, count), np.float32) if self._aperture is not None else None
        moves = np.empty((2, 3, 2, count), np.float32) if differentials else None
        arrays = [film, square, wavelength, origin, direction, weight, status, stop, moves]
        self._call(moves is not None)(count, ctypes.byref(self._setting), *map(_address, arrays))
        if self._aperture is not None and stop is not None:
            inside = self._aperture.inside(stop[0], stop[1], self._stop_radius_mm)
            shut = ~inside & (status == st.PASSED)
            weight[shut], status[shut] = 0, self._stopped
        found = None if moves is None else RayDifferentials(moves[0], moves[1])
        return CameraRays(origin, direction, weight, status, found)

    def _call(self, differentials: bool) -> Any:
        if not differentials:
            return self._rays
        if self._rays_and_moves is None:
            self._rays_and_moves = _compiled(self._with_differentials())
        return self._rays_and_moves

    def _with_differentials(self) -> Graph:
        """The graph with differentials, points in metres."""
        fitted = with_low_order_derivatives(self._graph, self._samples())
        self.moves_error = None if fitted is None else fitted.error
        graph = with_film_derivatives(self._graph) if fitted is None else fitted.graph
        for name in (derivative("scene_ray", by) for by in FILM_X_Y):
            graph.outputs[name] = graph.outputs[name] * [1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0]
        return graph

    def _samples(self) -> dict[str, FloatArray]:
        """Inputs of the graph for rays all over film, pupil and wavelengths."""
        rng, outline = np.random.default_rng(0), self._outline
        film = (rng.random((2, _SAMPLES)) - 0.5) * np.array(self._film_mm)[:, None]
        film *= np.minimum(1, 0.99 * outline.film_radius_mm / np.hypot(*film))
        wavelength = rng.uniform(outline.wavelength_nm[0], outline.wavelength_nm[-1], _SAMPLES).astype(np.float32)
        film, square = film.astype(np.float32), rng.random((2, _SAMPLES), np.float32)
        rays = np.stack([*film, *outline.sample(film, square, wavelength)[0], wavelength])
        per_call = {"film_z_mm": self._setting.film_z_mm, "stop_radius_mm": self._setting.stop_radius_mm}
        return {"rays": rays} | {name: np.array([[value]], np.float32) for name, value in per_call.items()}


class FusedCamera(OnnxCamera):
    """An exported model as a compiled camera: the rays of `OnnxCamera` to rounding, at a fraction of its cost.

    Args and attributes are those of `OnnxCamera`. Differentials (see `FusedFilm`) need no model exported with
    derivatives.

    Raises:
        InputError: as `OnnxCamera`; no C compiler; a model of operators that have no such form.
    """

    rays_a_call = MANY_RAYS_A_CALL

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        graph = graph_of(self.model.path, self.model.data, self.model.state if self.model.axes else ())
        scene = self.film.scene
        assert isinstance(scene, ModelScene)
        surface = int(self.model.card["lens"].get("stop_surface", 0))
        self._fused = FusedFilm(self.film, graph, scene.stop_radius_mm, self.film_mm, scene.aperture, surface)
        self.settings |= {"runtime": "fused"}

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self._fused.sample(film_mm, pupil, wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays, which come from the same pass."""
        return self._fused.sample(film_mm, pupil, wavelength_nm, True)

    def for_worker(self) -> FusedCamera:
        """This camera: compiled code needs no session of its own."""
        return self

    @property
    def differentials_error(self) -> float | None:
        """See `FusedFilm.moves_error`."""
        return self._fused.moves_error


def _tables(film: LensFilm) -> tuple[FloatArray, FloatArray]:
    """The outline as `Setting` has it: edges [R * K, 16], centres [R, 2]."""
    outline = film.outline
    edges = outline.edges  # [W, 8, R * K]
    both = np.zeros((2, *edges.shape[1:]), np.float32)
    both[: len(edges)] = edges
    return np.ascontiguousarray(both.reshape(16, -1).T), np.ascontiguousarray(outline.centres.T)


def _compiled(graph: Graph) -> Any:
    program = lower(graph).in_order_of_need()
    function = load_compiled(camera_source(program, st.PASSED, st.OUTSIDE_DOMAIN, UNIT_SLACK)).neurolens_camera
    function.argtypes, function.restype = [ctypes.c_size_t] + [ctypes.c_void_p] * 10, None
    return function


def _address(array: NDArray[Any] | None) -> int | None:
    return None if array is None else int(array.__array_interface__["data"][0])
