"""A lens at one focus and stop before its film: which rays pass, the pupil of film points, and the camera's graph.

`whole_camera` writes the graph of a camera, once for all that run it: the graph of its lens stands between those of the
pupil and the weights (`cameragraph`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.cameragraph import (
    LensGraph,
    lens_inside,
    status_graph,
    unrounded,
    weight_graph,
)
from neurolens.cameras.companions import Pair
from neurolens.cameras.contract import (
    FloatArray,
)
from neurolens.cameras.onnxlens import LensRays, LensRun
from neurolens.cameras.pose import UPRIGHT, FilmPose, to_film, to_plane
from neurolens.cameras.pupil_outline import PupilOutline, leaning
from neurolens.cameras.sampling import stratified
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.models.inverse import InverseRays
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import LINE_D_NM
from neurolens.optics.setting.pupils import GROUPS

Array = NDArray[np.float64]

_ROUND = 0.02  # the squeeze of a model may differ from 1 by this error without a cylinder
# Points on each side of the square over which the exposure on the axis is integrated.
_QUADRATURE = 256
_RINGS, _WIDER = 192, 1.5  # of the pupil, for the light on the axis; their reach over the first-order pupil's


@dataclass(frozen=True)
class LensScene:
    """A lens at one focus and stop; takes film points, pupil points [2, N] (mm) and wavelengths [N] (nm) to scene rays.

    Attributes:
        lens: a lens with a round stop.
        film_z_mm: the film plane.
        stop_radius_mm: radius of the stop.
        aperture: the shape of the opening, where it is not round.
    """

    lens: LensRun
    film_z_mm: float
    stop_radius_mm: float
    aperture: Aperture | None = None

    def __call__(self, film: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> LensRays:
        rays = np.concatenate([film, pupil, wavelength_nm[None]]).astype(np.float32)
        out = self.lens.run(rays, self.film_z_mm, self.stop_radius_mm)
        return out._replace(status=self.status_of(out))

    def status_of(self, rays: LensRays | InverseRays) -> NDArray[np.int32]:
        """Return the status [N] of rays of the lens, with that of the stop's shape; see `status_graph`."""
        given = {"scene_ray": rays.scene_ray, "lens_status": rays.status[None].astype(np.float32)}
        if self.aperture is not None:
            given |= {"stop_xy_mm": rays.stop_xy_mm, "stop_radius_mm": np.array([[self.stop_radius_mm]], np.float32)}
            given |= {} if self.aperture.mask is None else {"mask": self.aperture.table}
        return evaluate(status_graph(self.aperture, self.stopped), given)["status"][0].astype(np.int32)

    @property
    def stopped(self) -> int:
        """Return the status of rays that the stop's shape blocks."""
        return st.blocked(self.lens.stop_index, st.RIM)

    def passes(self, film: FloatArray, pupil: FloatArray, wavelength_nm: float) -> NDArray[np.bool_]:
        """Test whether rays pass at one wavelength, bool [N]; for a round stop only the status is computed."""
        waves = np.full(film.shape[1], wavelength_nm, np.float32)
        if self.aperture is not None:
            return self(film, pupil, waves).status == st.PASSED
        rays = np.concatenate([film, pupil, waves[None]]).astype(np.float32)
        return self.lens.status(rays, self.film_z_mm, self.stop_radius_mm) == st.PASSED

    def passes_at_any_azimuth(self, film: FloatArray, pupil: FloatArray, wavelength_nm: float) -> NDArray[np.bool_]:
        """Test whether rays of a lens with cylinders pass at any azimuth of their film and pupil points, bool [N]."""
        passed = np.zeros(film.shape[1], bool)
        for azimuth in chain(*GROUPS):
            left = np.flatnonzero(~passed)
            if len(left):
                cos, sin = math.cos(azimuth), math.sin(azimuth)
                turn = np.array([[cos, -sin], [sin, cos]], np.float32)
                passed[left] = self.passes(turn @ film[:, left], turn @ pupil[:, left], wavelength_nm)
        return passed

    def squeeze(self, height_mm: float, wavelength_nm: tuple[float, float]) -> float | None:
        """Return the squeeze of a lens known by its rays alone.

        A ray that leaves it parallel to the axis at height h has the slope h / f on the film's side, which tells f in
        each meridian. Rays count whether they pass or not.
        """
        h = height_mm
        film = np.array([[h, -h, 0, 0], [0, 0, h, -h]], np.float32)
        out = self(film, film, np.clip([LINE_D_NM] * 4, *wavelength_nm).astype(np.float32))
        with np.errstate(all="ignore"):
            slope = out.scene_ray[3:5].astype(np.float64) / out.scene_ray[5]
            squeeze = float((slope[0, 0] - slope[0, 1]) / (slope[1, 2] - slope[1, 3]))
        if abs(squeeze - 1) < _ROUND:
            return 1.0
        return squeeze if math.isfinite(squeeze) and squeeze > 0 else None


def axial_light(
    trace: Callable[[Array], LensRays], turns: int, slope: float, distance_mm: float, stop_mm: float, stopped: int
) -> Array:
    """Return the light [waves] on the axis that a round stop lets to the film, over pi, in surroundings of radiance 1.

    It is the integral of transmittance times the cosine over solid angle; 1 / (4 N^2) for a perfect lens of f-number N.

    Args:
        trace: takes points of the pupil [2, N] to rays of the axial film point, [waves * N].
        turns: azimuths; 1 where the lens is round.
        slope: `film_slope`. distance_mm: from pupil to film.
        stop_mm: radius of the stop. stopped: status of rays that it blocks.
    """
    edges, turn = _WIDER * abs(slope) * np.linspace(0, 1, _RINGS + 1), 2 * np.pi * (np.arange(turns) + 0.5) / turns
    middle = 0.5 * distance_mm * (edges[1:] + edges[:-1])[:, None]
    rays = trace(np.stack([middle * np.cos(turn), middle * np.sin(turn)]).reshape(2, -1))
    shape = -1, _RINGS, turns
    seen = np.isin(rays.status, (st.PASSED, stopped)) & np.isfinite(rays.transmittance)
    radius = np.hypot(*rays.stop_xy_mm.astype(np.float64)).reshape(shape) / stop_mm
    with np.errstate(all="ignore"):  # a ring at the stop's edge counts in part
        share = ((1 - radius) / np.gradient(radius, axis=1) + 0.5).clip(0, 1)
        light = np.where(seen.reshape(shape) & np.isfinite(share), share * rays.transmittance.reshape(shape), 0.0)
    return np.asarray(light.mean(axis=2) @ np.diff(edges**2 / (1 + edges**2)))


def film_slope(f_number: float, rear_focal_z_mm: float, exit_pupil_z_mm: float, film_z_mm: float) -> float:
    """Return the slope at the film of the paraxial ray through the stop's edge: 1 / (2 N) at the rear focal point."""
    pupil = exit_pupil_z_mm - rear_focal_z_mm
    return 0.5 / f_number / (1 - (film_z_mm - rear_focal_z_mm) / pupil if math.isfinite(pupil) else 1)


class LensFilm:
    """The film and pupil of a lens at one focus and stop.

    Args:
        outline: the pupil of every film radius; None where no ray passes.
        wavelength_nm: range of the wavelengths in use.
        scene: the lens, set for this film.
        film_mm: width and height of the film. pose: how it stands.

    Raises:
        InputError: no ray passes from the film's centre.
    """

    def __init__(
        self, outline: PupilOutline | None, wavelength_nm: tuple[float, float], scene: LensScene, film_mm: Pair,
        pose: FilmPose = UPRIGHT,
    ) -> None:  # fmt: skip
        if outline is None:
            raise InputError("camera", "f_number, focus_m", "(no ray passes)", "a wider stop or another focus")
        self.film_z_mm, self.scene, self.pose = scene.film_z_mm, scene, pose
        self.distance_mm = scene.film_z_mm - outline.pupil_z_mm
        if lean := pose.lean(film_mm, self.distance_mm):
            outline = leaning(outline, replace(scene, aperture=None).passes, lean)
        self.outline, self.exposure = outline, 1.0
        self.exposure = self._exposure_on_axis(wavelength_nm)

    @property
    def numbers(self) -> dict[str, float]:
        """Return the inputs of `cameragraph.weight_graph` for a whole call."""
        scale = 1 / (self.distance_mm**2 * self.exposure)
        return {"per_distance": 1 / self.distance_mm, "scale": scale, "film_z_mm": self.film_z_mm}

    def on_plane(self, g: Graph, film_mm: Value) -> tuple[Value, dict[str, Value]]:
        """Write the pupil of film points into a graph; return where its rays meet the plane of an upright film, too."""
        if not self.pose:
            return film_mm, g.inline(self.outline.graph, {"film_mm": film_mm})
        turn = to_plane(self.pose, self.outline.film_radius_mm)
        unknown = {"film_mm": film_mm, "pupil_mm": film_mm * 0.0, "area_mm2": film_mm[0]}
        central = g.inline(turn, unknown)
        pupil = g.inline(self.outline.graph, {"film_mm": central["central_mm"], "lean": central["lean"]})
        turned = g.inline(turn, {"film_mm": film_mm, **pupil})
        return turned["plane_mm"], pupil | {"area_mm2": turned["area_mm2"]}

    def start(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where rays of film points cross the upright film plane and the pupil [2, N], and their area [N].

        The area is that of `PupilOutline.sample`, times the factor from a weight on the plane to that on the film.
        """
        g, given = Graph(), {"film_mm": film_mm, "square": square, "wavelength_nm": wavelength_nm[None]}
        plane, pupil = self.on_plane(g, g.input("film_mm", 2))
        g.outputs = {"plane_mm": plane, **pupil}
        numbers = self.outline.numbers | {"per_distance": 1 / self.distance_mm}
        given |= {name: np.array([[value]], np.float32) for name, value in numbers.items()}
        found = evaluate(g, given | {"outline": self.outline.table})
        area = found["area_mm2"][0]
        return found["plane_mm"], found["pupil_mm"], np.where(area > 0, area, np.float32(0))

    def from_plane(self, plane_mm: Array, pupil_mm: Array) -> Array:
        """Return the film points [2, N] of rays by where they cross the upright film plane and the pupil plane."""
        given = {"plane_mm": plane_mm, "pupil_mm": pupil_mm, "per_distance": np.array([[1 / self.distance_mm]])}
        return np.asarray(evaluate(to_film(self.pose), given)["film_mm"])

    def natural(self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """Return cos^4 of the angles between the axis and the rays of `sample` on the film's side."""
        plane, pupil, _ = self.start(film_mm, square, wavelength_nm)
        slope = (pupil - plane) * np.float32(1 / self.distance_mm)
        return np.square(1 / (1 + np.einsum("in,in->n", slope, slope)))

    def _exposure_on_axis(self, wavelength_nm: tuple[float, float]) -> float:
        """Return the integral of T cos over solid angle where the axis meets the film, as a mean over wavelengths."""
        square, wavelength = stratified(_QUADRATURE, wavelength_nm)
        axis = np.zeros_like(square) + np.array(self.pose.moved_mm, np.float32)[:, None]
        film, pupil, area = self.start(axis, square, wavelength)
        out = self.scene(film, pupil, wavelength)
        given = {
            "film_mm": film,
            "pupil_mm": pupil,
            "area_mm2": area[None],
            "scene_ray": out.scene_ray,
            "transmittance": out.transmittance[None],
            "lens_status": out.status[None].astype(np.float32),
            **{name: np.array([[value]], np.float32) for name, value in self.numbers.items()},
        }
        exposure = float(evaluate(weight_graph(), given)["weight"].mean(dtype=np.float64))
        if not exposure > 0:
            raise InputError(
                "camera", "f_number, focus_m", "(no ray passes on the axis)", "a wider stop or another focus"
            )
        return exposure


def whole_camera(
    film: LensFilm, lens: LensGraph, also: Sequence[str] = (), mask_too: bool = False
) -> tuple[Graph, dict[str, float]]:
    """Write the graph of a camera, with the graph of its lens inside, and return it with its numbers of the call.

    Inputs are those of `pupil_graph` and `weight_graph`. Outputs are those of `weight_graph`, the derivatives of the
    ray that the lens's graph has, and those named in `also`, of the pupil's graph or the lens's, or `plane_mm`, where
    rays meet the plane of an upright film. With `mask_too` the graph tests a mask in the stop; else `stop_xy_mm` is an
    output, and the caller tests it.
    """
    g = Graph()
    own = g.input("film_mm", 2)
    film_mm, pupil = film.on_plane(g, own)
    wavelength = g.input("wavelength_nm")  # last, as the functions in C and in shaders have their arguments
    found, aperture = lens_inside(g, lens, g.concat(film_mm, pupil["pupil_mm"], wavelength), mask_too)
    derivatives = tuple(name for name in found if "_by_" in name)
    if film.pose.turned and derivatives:
        turn = to_plane(film.pose, film.outline.film_radius_mm, derivatives)
        turned = g.inline(turn, {"film_mm": own, **pupil, **{name: found[name] for name in derivatives}})
        found = found | {name: turned[name] for name in derivatives}
    given = {"film_mm": film_mm, **pupil, **found, "lens_status": unrounded(found["status"])}
    g.outputs |= g.inline(weight_graph(derivatives, aperture, lens.stopped, lens.unit), given)
    inner = pupil | found | {"plane_mm": film_mm}
    g.outputs |= {name: value for name, value in inner.items() if name in also}
    return g, film.outline.numbers | film.numbers | {"stop_radius_mm": lens.stop_radius_mm}
