"""What exact and modelled lenses share as cameras: pupil sampling, weights, exposure, and the camera frame.

One code for both, so that they send the same rays for the same random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import D_FILM, weight_graph
from neurolens.cameras.contract import CameraRays, FloatArray, RayDifferentials
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.cameras.sampling import is_light, stratified
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, pruned
from neurolens.lens.apertures import Aperture

# Points a side of the quadrature of the exposure on the axis.
_QUADRATURE = 256
_AHEAD = np.array([[0], [0], [0], [0], [0], [-1]], np.float32)


class SceneRays(NamedTuple):
    """Scene-side rays: scene_ray [6, N] (x, y, z mm, unit direction; lens frame), transmittance [N], status [N].

    `d_film`: derivatives [6, 2, N] of scene_ray by the film point's x and y (per mm), where they were asked for.
    """

    scene_ray: FloatArray
    transmittance: FloatArray
    status: NDArray[np.int32]
    d_film: FloatArray | None = None


# Film points [2, N] mm, pupil points [2, N] mm and wavelengths [N] nm to scene-side rays.
SceneFunction = Callable[[FloatArray, FloatArray, FloatArray], SceneRays]


class LensFilm:
    """Film and pupil of a lens at one focus and stop: from film points and random numbers to weighted rays.

    Args:
        outline: the pupil of every film radius; None where no ray passes.
        film_z_mm: film plane, lens frame.
        wavelength_nm: range of the wavelengths used.
        scene: the lens.

    Raises:
        InputError: no ray passes from the film's centre.
    """

    def __init__(
        self, outline: PupilOutline | None, film_z_mm: float, wavelength_nm: tuple[float, float], scene: SceneFunction
    ) -> None:
        if outline is None:
            raise InputError("camera", "f_number, focus_m", "(no ray passes)", "a lens that light can pass")
        self.film_z_mm, self.scene = film_z_mm, scene
        self.distance_mm = film_z_mm - outline.pupil_z_mm
        self.outline = outline
        self.exposure = 1.0
        self.exposure = self._exposure_on_axis(wavelength_nm)

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray, scene: SceneFunction | None = None
    ) -> CameraRays:
        """Rays for film points [2, N] in mm, random numbers [2, N] in [0, 1) and wavelengths [N] in nm.

        `scene` stands in for the lens's own function, for one that gives more (`SceneRays.d_film`).
        """
        scene = scene or self.scene
        pupil, area = self.outline.sample(film_mm, square, wavelength_nm)
        lit = (area > 0) & is_light(wavelength_nm)
        if lit.all():
            return camera_rays(self._weighted(scene, film_mm, pupil, area, wavelength_nm))
        # A film point that nothing reaches is dark: no ray is traced.
        some = np.flatnonzero(lit)
        found = self._weighted(scene, film_mm[:, some], pupil[:, some], area[some], wavelength_nm[some])
        whole = {name: np.zeros((*part.shape[:-1], lit.size), part.dtype) for name, part in found.items()}
        whole["status"][:] = st.OUTSIDE_DOMAIN
        for name, part in found.items():
            whole[name][..., some] = part
        return camera_rays(whole)

    def _weighted(
        self, scene: SceneFunction, film: FloatArray, pupil: FloatArray, area: FloatArray, wavelength_nm: FloatArray
    ) -> dict[str, NDArray[Any]]:
        """What `camera_rays` takes, for lit film points [2, N] through pupil points [2, N], densities 1 / area [N]."""
        out = scene(film, pupil, wavelength_nm)
        given = {"film_mm": film, "pupil_mm": pupil, "area_mm2": area[None], "scene_ray": out.scene_ray}
        given |= {"transmittance": out.transmittance[None], "lens_status": out.status[None].astype(np.float32)}
        given |= {} if out.d_film is None else dict(zip(D_FILM, np.moveaxis(out.d_film, 1, 0), strict=True))
        given |= {name: np.array([[value]], np.float32) for name, value in self.numbers.items()}
        found = evaluate(weight_graph(() if out.d_film is None else D_FILM), given)
        moves = [found.pop(name) for name in D_FILM if name in found]
        return found | ({"d_film": np.stack(moves, 1)} if moves else {})

    @property
    def numbers(self) -> dict[str, float]:
        """The inputs of the call of `cameragraph.weight_graph`."""
        scale = 1 / (self.distance_mm**2 * self.exposure)
        return {"per_distance": 1 / self.distance_mm, "scale": scale, "film_z_mm": self.film_z_mm}

    def natural(self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """cos^4 of the angles between the axis and the rays of `sample` on the film's side."""
        slope = (self.outline.sample(film_mm, square, wavelength_nm)[0] - film_mm) * np.float32(1 / self.distance_mm)
        cos4: FloatArray = np.square(1 / (1 + np.einsum("in,in->n", slope, slope)))
        return cos4

    def _exposure_on_axis(self, wavelength_nm: tuple[float, float]) -> float:
        """Integral of T cos over solid angle at the film's centre, mean over the wavelengths."""
        square, wavelength = stratified(_QUADRATURE, wavelength_nm)
        weight = self.sample(np.zeros_like(square), square, wavelength).weight
        exposure = float(weight.mean(dtype=np.float64))
        if not exposure > 0:
            raise InputError("camera", "f_number, focus_m", "(no ray passes on the axis)", "a lens that light can pass")
        return exposure


def camera_rays(found: Mapping[str, NDArray[Any]]) -> CameraRays:
    """Rays of the outputs of `cameragraph.weight_graph`, [R, N] each; those that do not pass look ahead.

    Derivatives by the film point stand together, `d_film` [6, 2, N].
    """
    ray, moves = found["ray"], found.get("d_film")
    lost = np.flatnonzero(found["status"][0] != st.PASSED)
    if lost.size:
        ray[:, lost] = _AHEAD
        if moves is not None:
            moves[..., lost] = 0
    differentials = None if moves is None else RayDifferentials(moves[:3], moves[3:])
    return CameraRays(ray[:3], ray[3:], found["weight"][0], found["status"][0], differentials)


class LensGraph(NamedTuple):
    """The graph of a lens with what its camera's graph takes from it.

    Attributes:
        graph: inputs `rays` [5] (film and pupil point, wavelength), `film_z_mm` and `stop_radius_mm`; outputs
            `scene_ray` [6], `transmittance`, `status`, `stop_xy_mm` [2], and any derivatives of `scene_ray`.
        stop_radius_mm: of its round stop.
        aperture: the shape of the opening, tested on the rays' crossings with the stop; None is round.
        stopped: status of rays that the shape blocks.
    """

    graph: Graph
    stop_radius_mm: float
    aperture: Aperture | None = None
    stopped: int = 0

    @property
    def blades(self) -> Aperture | None:
        """The opening where it is no mask: a mask's table is too large for compiled loops."""
        return None if self.aperture is None or self.aperture.mask is not None else self.aperture


def whole_camera(
    film: LensFilm, lens: LensGraph, pupil_too: bool = False, mask_too: bool = False
) -> tuple[Graph, dict[str, float]]:
    """The graph of a camera with the graph of its lens inside, and its numbers of the call.

    Inputs: those of `pupil_graph` and `weight_graph`. Outputs: those of `weight_graph`, derivatives of the ray that the
    lens's graph has, and with `pupil_too` the outputs of `pupil_graph`. A mask in the stop is tested in the graph with
    `mask_too`; else `stop_xy_mm` is an output, for the caller to test it.
    """
    aperture = lens.aperture if mask_too else lens.blades
    wanted = {k: v for k, v in lens.graph.outputs.items() if k != "stop_xy_mm" or lens.aperture is not None}
    g = Graph()
    pupil = g.inline(film.outline.graph, {})
    film_mm, wavelength = g.input("film_mm", 2), g.input("wavelength_nm")
    found = g.inline(pruned(lens.graph, wanted), {"rays": g.concat(film_mm, pupil["pupil_mm"], wavelength)})
    derivatives = tuple(name for name in found if "_by_" in name)
    status = found["status"]
    if status.node.kind == "whole":  # the camera's tests take the number before it is made an integer
        (status,) = g.inputs_of(status.number)
    given = {"film_mm": film_mm, **pupil, **found, "lens_status": status}
    g.outputs = g.inline(weight_graph(derivatives, aperture, lens.stopped), given)
    if aperture is None and "stop_xy_mm" in found:
        g.outputs["stop_xy_mm"] = found["stop_xy_mm"]
    if pupil_too:
        g.outputs |= pupil
    return g, film.outline.numbers | film.numbers | {"stop_radius_mm": lens.stop_radius_mm}
