"""The camera class of lenses, exact or modelled: everything between the random numbers and the weighted ray.

A camera is one graph, with that of its lens between the pupil and the weights (`lensfilm.whole_camera`). It
runs as C where the machine has a compiler, else in onnxruntime; both give the same rays, to rounding.
"""

import math
import os
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.cameras.cameragraph import D_FILM, LensGraph, camera_rays
from neurolens.cameras.companions import Pair, Shift, companion_graph, fit_shift, lanes_graph
from neurolens.cameras.contract import (
    MANY_RAYS_A_CALL,
    RAYS_A_CALL,
    CameraRays,
    FilmPoints,
    FloatArray,
    SpectralRays,
)
from neurolens.cameras.lensfilm import LensFilm, LensScene, whole_camera
from neurolens.cameras.onnxlens import open_session, run_batches
from neurolens.cameras.pose import FilmPose
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.cameras.sampling import FrontDiscs, arrived
from neurolens.graph.c import padded_columns
from neurolens.graph.compiled import CompiledGraph
from neurolens.graph.compiler import has_compiler
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import with_film_derivatives, with_low_order_derivatives
from neurolens.graph.onnx import write_onnx
from neurolens.models.assemble import ONNX, SCALARS, Form
from neurolens.optics.lens.prescription import Surface
from neurolens.optics.lens.shot import POSES, Runtime, Shot
from neurolens.optics.trace.shapes import sag_and_derivatives

Array = NDArray[np.float64]

# What a camera computes: rays, a few of them, rays with differentials, rays with companions, or whether companions pass
# (`companion_graph`).
Kind = Literal["rays", "few", "differentials", "hero", "companion"]
# Takes film points, pupil squares [2, N] and wavelengths [1, N], by name, to what `camera_rays` takes.
GraphRun = Callable[[dict[str, FloatArray]], dict[str, NDArray[Any]]]

_SAMPLES = 4096  # rays that derivatives of low order are fitted to
_EDGES = (1e-4, 1e-3, 3e-3, 1e-2)  # distances from the square's edge of what counts as the pupil's edge
_EDGE_RAYS = 2**16  # rays that find where light crosses the front surface


class LensCamera:
    """The camera of a lens, exact or modelled; `contract.Camera` is the interface of all cameras.

    Attributes:
        path: of the file of the lens or the model, for messages.
        film: film and pupil of the lens at its focus and stop. film_mm: width and height of the film.
        runtime: what runs the camera's graph. takes: settings of a shot besides those that every camera takes.
        differentials_error: RMS error of fitted differentials over their size; None where differentials are the
            graph's own, or were not sampled yet. Compiled cameras fit them by polynomials of low order, within
            `loworder.WORST`: the graph's own cost as much as its rays.
    """

    name: str
    path: Path
    film: LensFilm
    film_mm: Pair
    settings: dict[str, Any]
    runtime: Runtime
    _light_nm: tuple[float, float]
    _runs: dict[tuple[int, Kind, int], GraphRun]
    _told: Callable[[str], None]
    _asked: bool
    differentials_error: float | None = None

    takes = frozenset({"zoom", "focus_mode", "internal", "aperture", "film_offset_mm", *POSES})

    def place(
        self, outline: PupilOutline | None, scene: LensScene, shot: Shot, about: Mapping[str, Any],
        progress: Progress | None,
    ) -> None:  # fmt: skip
        """Place film and pupil for a shot, and start what runs the camera. Its `settings` are `about`, what it takes of
        the shot, the film's place and the stop. Raises InputError as `LensFilm` and `start` do."""
        self.film = LensFilm(outline, self._light_nm, scene, self.film_mm, FilmPose.of(shot))
        shape = scene.aperture and scene.aperture.settings()
        film = {"film_z_mm": scene.film_z_mm, "stop_radius_mm": scene.stop_radius_mm, "aperture": shape}
        self.settings = {**shot.record(self.takes), **about, **film}
        self.start(shot.runtime, progress)

    def lens_graph(self, form: Form = SCALARS) -> LensGraph:
        """Return the graph of the lens with its stop."""
        raise NotImplementedError

    @property
    def rays_a_call(self) -> int:
        """The number of rays with which a call is fastest."""
        return MANY_RAYS_A_CALL if self.runtime == "c" else RAYS_A_CALL

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Return rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self._sampled(film_mm, pupil, wavelength_nm, False)

    def sample_few(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, to rounding, without compiling: a few thousand take less time so."""
        film, square = self._checked(film_mm, pupil, wavelength_nm)
        return camera_rays(self._run("few")({"film_mm": film, "square": square, "wavelength_nm": wavelength_nm[None]}))

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Sample rays as `sample` does, and give their differentials too."""
        return self._sampled(film_mm, pupil, wavelength_nm, True)

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return cos^4 of the angles between the axis and the rays of `sample` on the film's side."""
        return self.film.natural(film_mm, pupil, wavelength_nm)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Return film points for scene points [3, N] in m, through points of the front surface that `pupil` chooses."""
        shape, up = self.front, np.array([[0.0], [0.0], [self.film.film_z_mm]])
        with np.errstate(all="ignore"):
            point = 1e3 * point_m.astype(np.float64) + up
            x, y, area = self._front_discs.aim(point, pupil)
            z, sx, sy = (0 * x,) * 3 if shape is None else sag_and_derivatives(shape, x, y)
            position = np.stack([x, y, z])
            way = point - position
            direction = way / np.sqrt((way * way).sum(0))
            # dA cos is dx dy (d . n) / |n_z|, where the outward normal is along (sx, sy, -1).
            facing = sx * direction[0] + sy * direction[1] - direction[2]
            places, through, status = self._traced_back(position, direction, wavelength_nm)
            film = self.film.from_plane(places[:2], places[2:]) if self.film.pose else places[:2]
            origin = 1e-3 * (position - up)
            weight = through * area * facing / (self.film.exposure * ((point_m - origin) ** 2).sum(0))
        aimed = np.where(np.isfinite(point).all(0), st.blocked(0, st.MISSED), st.OUTSIDE_DOMAIN)
        status = np.where(facing > 0, status, aimed).astype(np.int32)
        return arrived(film, origin, point_m, weight, status, wavelength_nm)

    @property
    def front(self) -> Surface | None:
        """Return the surface at which light from scene points is aimed; None is the plane z = 0."""
        raise NotImplementedError

    def _traced_back(
        self, position: Array, direction: Array, wavelength_nm: FloatArray
    ) -> tuple[Array, FloatArray, NDArray[np.int32]]:
        """Return where light from `direction` to points of the front crosses the planes of an upright film and of the
        pupil, [4, N], its transmittance and status."""
        raise NotImplementedError

    @cached_property
    def _front_discs(self) -> FrontDiscs:
        """Find where light to the film crosses the front surface, by rays at the pupil's edge.

        Half of these rays start at the film's edge.
        """
        rng, ray = np.random.default_rng(0), np.arange(_EDGE_RAYS)
        film = (rng.random((2, _EDGE_RAYS)) - 0.5) * np.array(self.film_mm)[:, None]
        film[:, ::2] *= 0.5 / np.abs(film[:, ::2] / np.array(self.film_mm)[:, None]).max(0)
        film = self._within(film, 0.9999)
        square = rng.random((2, _EDGE_RAYS), np.float32)
        # The outline of a turned film is less tight: rays at its very edge may all be lost.
        edge = np.array(_EDGES if self.film.pose.turned else _EDGES[:1], np.float32)
        edge = edge[ray // 8 % edge.size]
        square[ray // 2 % 2, ray] = np.where(ray // 4 % 2, edge, 1 - edge)
        waves, points = rng.uniform(*self._light_nm, _EDGE_RAYS).astype(np.float32), film.astype(np.float32)
        scene = replace(self.film.scene, aperture=None)  # at whose edge no ray may pass
        found = scene(*self.film.start(points, square, waves)[:2], waves)
        return FrontDiscs.of(found.scene_ray[:, found.status == st.PASSED].astype(np.float64), self.front)

    def compiled(self) -> Self:
        """Return the camera as compiled C, with the outline that was found; raises InputError without a compiler."""
        other = copy(self)
        other.start("c")
        return other

    def start(self, runtime: Runtime | None, progress: Progress | None = None) -> None:
        """Choose what runs the camera; None takes C where the machine has a compiler that takes it, else onnxruntime.

        Unless `runtime` asks for C, a program is compiled when the first rays need it. For many cameras are made for
        their pupil alone, and pictures take other programs than single rays. `progress` says where C is given up for
        onnxruntime.

        Raises:
            InputError: C is asked for, and there is no compiler, or it fails.
        """
        self._runs, self._asked, self._told = {}, runtime is not None, (progress or Progress(quiet=True)).note
        self._take(runtime or ("c" if has_compiler() else "onnxruntime"))
        if runtime == "c":
            self._run("rays")

    def _take(self, runtime: Runtime) -> None:
        self.runtime, self.settings = runtime, self.settings | {"runtime": runtime}

    def ready(self, wavelengths: int) -> None:
        """Compile what rays of so many wavelengths take; each process opens onnxruntime for itself."""
        if self.runtime == "c" and wavelengths == 1:
            self._run("rays")
        elif self.runtime == "c":
            self._run("hero", wavelengths - 1)
            self._run("companion")

    def sample_spectrum(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SpectralRays:
        """Rays as `sample` does, for wavelengths [W, N] in nm, the first of which is the hero's; see the contract.

        Raises:
            InputError: the camera cannot place companions (`companion_reach_mm`).
        """
        if self.companion_reach_mm is None:
            raise InputError(self.path, "wavelengths", "(several a ray)", "one: this lens has no companions")
        nm = np.ascontiguousarray(wavelength_nm, np.float32)
        film, square = self._checked(film_mm, pupil, nm[0])
        given = {"film_mm": film, "square": square, "wavelength_nm": nm[:1], "companion_nm": nm[1:]}
        lanes = len(nm)
        hero = self._run("hero", lanes - 1)(given)
        rays = camera_rays(hero)
        light, places = hero["light"], hero["places"].reshape(lanes, 2, -1)
        doubt = np.flatnonzero((hero["sure"] < self._sure) & (light > 0))  # of all companions, one after the other
        ray = doubt % film.shape[1]
        same = {"film_mm": hero["plane_mm"], "pupil_mm": hero["pupil_mm"], "wavelength_nm": nm[:1]}
        near = {name: values.take(ray, axis=1) for name, values in same.items()}
        near["companion_nm"] = nm[1:].reshape(1, -1).take(doubt, axis=1)
        lost = self._run("companion")(near)["status"][0] != st.PASSED
        light.reshape(-1)[doubt[lost]] = 0
        places[1 + doubt[lost] // film.shape[1], :, ray[lost]] = film[:, ray[lost]].T
        weight = np.concatenate([rays.weight[None], light])
        weight /= np.maximum((weight > 0).sum(axis=0, dtype=np.uint8), 1).astype(np.float32)
        return SpectralRays(rays, weight, places)

    @property
    def companion_reach_mm(self) -> tuple[float, float] | None:
        """Return how far along x and along y companions may lie from the hero's film point.

        It is None if they cannot be placed: too few rays pass, or no polynomial follows the shift.
        """
        return self._shift.reach_mm if self._shift else None

    def _sampled(self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray, moves: bool) -> CameraRays:
        wavelength = np.ascontiguousarray(wavelength_nm, np.float32)
        film, square = self._checked(film_mm, square, wavelength)
        run = self._run("differentials" if moves else "rays")
        return camera_rays(run({"film_mm": film, "square": square, "wavelength_nm": wavelength[None]}))

    @staticmethod
    def _checked(film_mm: FloatArray, square: FloatArray, wavelength: FloatArray) -> tuple[FloatArray, FloatArray]:
        film, square = (np.ascontiguousarray(a, np.float32) for a in (film_mm, square))
        count = film.shape[1]
        if film.shape != (2, count) or square.shape != (2, count) or wavelength.shape != (count,):
            raise ValueError(f"film {film.shape}, square {square.shape}, wavelengths {wavelength.shape}")
        return film, square

    def _run(self, kind: Kind, companions: int = 0) -> GraphRun:
        """Return the camera's graph in its runtime, made when first needed; onnxruntime's is made in each process."""
        key = 0 if self.runtime == "c" else os.getpid(), kind, companions
        if key not in self._runs:
            self._runs[key] = self._made(kind, companions)
        return self._runs[key]

    def _made(self, kind: Kind, companions: int) -> GraphRun:
        lens = self.lens_graph(SCALARS if self.runtime == "c" else ONNX)
        if kind == "differentials":
            lens = lens._replace(graph=self._with_moves(lens.graph))
        mask_too = self.runtime != "c" or kind == "few"
        if kind == "companion":
            assert self._shift is not None
            graph, numbers = companion_graph(lens, self._shift, mask_too), self._of_the_lens()
        else:
            also = ("pupil_mm", "area_mm2", "plane_mm") if kind == "hero" else ()
            graph, numbers = whole_camera(self.film, lens, also, mask_too)
            if kind == "hero":
                assert self._shift is not None
                same = {k: graph.outputs[k] for k in (*also, "weight")}
                del graph.outputs["area_mm2"]
                lanes = lanes_graph(self._shift, companions, self.film_mm, self.film.pose)
                graph.outputs |= graph.inline(lanes, same)
        if kind == "few":
            mask = {} if lens.aperture is None or lens.aperture.mask is None else {"mask": lens.aperture.table}
            call = {name: np.array([[value]], np.float32) for name, value in numbers.items()}
            return lambda rays: evaluate(graph, rays | call | mask | {"outline": self.film.outline.table})
        if self.runtime == "c":
            try:
                return _compiled(graph, numbers, self.film, lens)
            except InputError as error:  # a compiler that fails, or takes too long
                if self._asked:
                    raise
                self._told(f"{self.name} runs in onnxruntime: {error}")
                self._runs.clear()
                self._take("onnxruntime")
                return self._made(kind, companions)
        return self._in_onnxruntime(graph, numbers, lens)

    @cached_property
    def _shift(self) -> Shift | None:
        """Fit the shift of companions, once."""
        given, margin = self._film_samples()
        samples = {name: values.astype(np.float64) for name, values in given.items()}
        companions = np.random.default_rng(1).permutation(samples["rays"][4])
        return fit_shift(self.lens_graph().graph, samples, margin, companions, self.film_mm, self.film.from_plane)

    @cached_property
    def _sure(self) -> float:
        """Return the `sure` (`lanes_graph`) above which companions need no ray; inf where the stop has edges."""
        return 0.0 if self.lens_graph().aperture is None else math.inf

    def _of_the_lens(self) -> dict[str, float]:
        """Return the inputs of the lens's graph for a whole call."""
        return {"film_z_mm": self.film.film_z_mm, "stop_radius_mm": self.lens_graph().stop_radius_mm}

    def _in_onnxruntime(self, whole: Graph, numbers: dict[str, float], lens: LensGraph) -> GraphRun:
        g, mask = Graph(), lens.aperture and lens.aperture.mask
        constants = {name: g.constant(value) for name, value in numbers.items()}
        constants["outline"] = g.own_table(self.film.outline.table)
        if lens.aperture is not None and mask is not None:
            constants["mask"] = g.own_table(lens.aperture.table)
        g.outputs = g.inline(whole, constants)
        inputs = {n.name: ("tensor(float)", n.rows, None) for n in g.nodes if n.kind == "input"}
        rows = {name: [value.rows] for name, value in g.outputs.items()}
        shapes = {k: ("tensor(int32)" if k == "status" else "tensor(float)", *rows[k], None) for k in rows}
        path, names = self.path, tuple(rows)
        session = open_session(path, write_onnx(g, {}, shapes=rows), inputs, shapes)

        def run(rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
            found = dict(zip(names, run_batches(path, session, names, rays, {}, RAYS_A_CALL), strict=True))
            derivatives = [found.pop(name) for name in D_FILM if name in found]
            return found | ({"d_film": np.stack(derivatives, 1)} if derivatives else {})

        return run

    def _with_moves(self, graph: Graph) -> Graph:
        """Return the lens's graph with the derivatives of its rays by the film point."""
        if self.runtime != "c":
            return with_film_derivatives(graph)
        fitted = with_low_order_derivatives(graph, self._film_samples()[0])
        self.differentials_error = None if fitted is None else fitted.error
        return with_film_derivatives(graph) if fitted is None else fitted.graph

    def _within(self, film: Array, share: float) -> Array:
        """Return film points [2, N]; those beyond a share of the outline's radius are drawn in to that share."""
        axis, pose = np.array(self.film.pose.moved_mm)[:, None], self.film.pose
        off = film - axis
        place = off / (1 + pose.axes[2:, :2] @ off / self.film.distance_mm) if pose.turned else off
        return axis + off * np.minimum(1, share * self.film.outline.film_radius_mm / np.hypot(*place))

    def _film_samples(self) -> tuple[dict[str, FloatArray], NDArray[np.float64]]:
        """Return inputs of the lens's graph for rays all over film, pupil and light, and margins (`lanes_graph`)."""
        rng, outline = np.random.default_rng(0), self.film.outline
        film = (rng.random((2, _SAMPLES)) - 0.5) * np.array(self.film_mm)[:, None]
        film = self._within(film, 0.99)
        wavelength = rng.uniform(outline.wavelength_nm[0], outline.wavelength_nm[-1], _SAMPLES).astype(np.float32)
        film, square = film.astype(np.float32), rng.random((2, _SAMPLES), np.float32)
        film, pupil, area = self.film.start(film, square, wavelength)
        margin = ((1 - np.abs(2 * square - 1).max(axis=0)) * np.sqrt(area)).astype(np.float64)
        call = {k: np.array([[value]], np.float32) for k, value in self._of_the_lens().items()}
        return {"rays": np.stack([*film, *pupil, wavelength])} | call, margin


def _compiled(graph: Graph, numbers: dict[str, float], film: LensFilm, lens: LensGraph) -> GraphRun:
    """Compile a graph of the camera to a function, which tests a mask in the stop on the rays that come back."""
    run = CompiledProgram.of(graph, numbers, padded(film.outline.table, 5))
    mask = lens.aperture if lens.blades is None else None
    if mask is None:
        return run

    def masked(rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        found = run(rays)
        inside = mask.inside(found["stop_xy_mm"][0], found["stop_xy_mm"][1], lens.stop_radius_mm)
        shut = ~inside & (found["status"][0] == st.PASSED)
        found["status"][0, shut] = lens.stopped
        if "weight" in found:
            found["weight"][0, shut] = 0
        if "light" in found:
            found["light"][:, shut] = 0
            found["places"][2:, shut] = np.tile(rays["film_mm"][:, shut], (len(found["light"]), 1))
        return found

    return masked


def padded(table: FloatArray, columns: int) -> FloatArray:
    """Lay out a table as compiled code takes it, with each group of so many columns filling whole registers."""
    groups = table.reshape(len(table), -1, columns)
    return np.ascontiguousarray(np.pad(groups, ((0, 0), (0, 0), (0, padded_columns(columns) - columns))))


class CompiledProgram(CompiledGraph):
    """Runs a camera's program as a compiled function, which gives derivatives by both film coordinates in one array."""

    def __call__(
        self, rays: dict[str, FloatArray], into: Mapping[str, FloatArray] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return the results [R, N] for inputs [R, N]; those of a camera are the input of `camera_rays`."""
        if D_FILM[0] not in self.rows:
            return super().__call__(rays, into)
        both = np.empty((6, 2, next(iter(rays.values())).shape[1]), np.float32)
        found = super().__call__(rays, {name: both[:, k] for k, name in enumerate(D_FILM)})
        return {name: a for name, a in found.items() if name not in D_FILM} | {"d_film": both}
