"""The parts of a lens camera as graphs: from film point, two random numbers and wavelength to ray, weight and status.

`lensfilm.whole_camera` joins them: the graph of the lens stands between those of the pupil and the weights.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.contract import CameraRays, RayDifferentials
from neurolens.graph.derive import derivative
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value, pruned
from neurolens.graph.program import FILM_X_Y
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.trace.surfaces import UNIT_SLACK

Array = NDArray[np.float64]

# How far a direction's squared length may be from 1: a poor network may decode none, and then there is no ray.
# Areas (mm^2) below this count as none: the outline at the end of the light.
_NO_AREA = 1e-30
# Outputs of a lens's graph with derivatives by the film point, in its x and its y.
D_FILM = tuple(derivative("scene_ray", by) for by in FILM_X_Y)
METRES = [1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0]
_HAIR = 1e-18  # mm; added so that the axis and the middle of a disc stay finite
_AHEAD = np.array([[0], [0], [0], [0], [0], [-1]], np.float32)


@lru_cache(maxsize=16)
def pupil_graph(segments: int, wavelengths: int, leaning: bool = False) -> Graph:
    """Write the graph from film point, point of the unit square and wavelength to a pupil point and its area.

    Concentric squares in the unit square become concentric copies of the polygon, as in Shirley and Chiu's map to the
    disk (1997): neighbours stay neighbours, and inside each triangle between centre and edge areas stay in proportion.

    Args:
        segments: K, of the upper half of a polygon.
        wavelengths: of the outline, 1 or 2.
        leaning: whether the outline is that of a turned film (`PupilOutline.lean`), with `lean` of `pose.to_plane`
            as one more input.

    Inputs are `film_mm`, `square` [2] and `wavelength_nm`; for a whole call, the table `outline`
    (`PupilOutline.table`), `per_radius` (1 / the last film radius), `last_row`, and for two wavelengths `wave_first`
    and `wave_scale`: the share of the second is (1 / wavelength^2 - first) scale. Outputs are `pupil_mm` [2], and
    `area_mm2`, which is that of `PupilOutline.sample`, but negative or NaN where nothing passes; there the point means
    nothing.
    """
    g = Graph()
    film, square, wavelength = g.input("film_mm", 2), g.input("square", 2), g.input("wavelength_nm")
    per_radius, last_row = (g.input(name, per_call=True) for name in ("per_radius", "last_row"))
    radius = g.square(film).sqrt()
    inner = 1.0 - radius * per_radius
    place = (1.0 - inner.maximum(0.0).sqrt()) * last_row
    row = place.floor()
    step = place - row
    a, b = g.split(square - 0.5, (1, 1))
    height = b.abs()
    size = a.abs().maximum(height)
    # The place along the upper half of a concentric square, from 0 at +x over 2 at +y to 4 at -x; the centre has none.
    per_size = 1.0 / size.maximum(1e-30)
    along = (2.0 - a * per_size * (2.0 - height * per_size)) * (segments / 4)
    edge = along.floor()
    cell, weights = row * (segments + 1.0) + edge, g.concat(g.constant(1.0), step)
    if wavelengths > 1:
        first, scale = (g.input(name, per_call=True) for name in ("wave_first", "wave_scale"))
        share = ((1.0 / (wavelength * wavelength) - first) * scale).clip(0.0, 1.0)
        weights = g.concat(weights, share, share * step)
    if leaning:
        lean = g.input("lean")
        weights = g.concat(weights, lean, lean * step)
    vertex, side, centre = g.split(g.lookup(g.table("outline", 10 * (wavelengths + leaning)), cell, weights), (2, 2, 1))
    products = vertex * g.affine([[0.0, 1.0], [1.0, 0.0]], side)
    area = g.affine([[float(segments), -float(segments)]], products).minimum(inner * 1e30)  # no area beyond the end
    sign = (b * 1e30).clip(-1.0, 1.0)
    x, y = g.split(vertex + side * (along - edge), (1, 1))
    size = size * 2.0
    x, y = x * size, y * (size * sign)
    # Turned to the film point's azimuth; on the axis that is 0, and does not move with the film point.
    turn = g.select(g.constant(_HAIR) <= radius, film * (1.0 / radius.maximum(_HAIR)), g.constant([1.0, 0.0]))
    pupil = turn * (x + centre) + g.affine([[0.0, -1.0], [1.0, 0.0]], turn) * y
    g.outputs = {"pupil_mm": pupil, "area_mm2": area}
    return g


@lru_cache(maxsize=16)
def status_graph(aperture: Aperture | None = None, stopped: int = 0, unit: bool = False) -> Graph:
    """Write the graph of the status: rays that pass the lens must have a unit direction and pass the stop's shape.

    Args:
        aperture: shape of the stop's opening, tested on the crossing `stop_xy_mm`; None is the lens's round one.
        stopped: the status of rays that the shape stops.
        unit: whether directions are known to be of unit length, and need no test.

    Inputs are `scene_ray` [6] and `lens_status`; for an aperture `stop_xy_mm` [2] and, for a whole call,
    `stop_radius_mm`; for a mask also the table `mask`. The output is `status`.
    """
    g = Graph()
    ray, status = g.input("scene_ray", 6), g.input("lens_status")
    if aperture is not None:
        opened = aperture.opening(g, g.input("stop_xy_mm", 2), g.input("stop_radius_mm", per_call=True))
        status = g.select(opened, status, g.select(status <= float(st.PASSED), float(stopped), status))
    if not unit:
        of_one = g.square(ray[3:]).between(1 - UNIT_SLACK, 1 + UNIT_SLACK)
        status = g.select(of_one, status, status.maximum(float(st.OUTSIDE_DOMAIN)))
    g.outputs["status"] = status
    return g


@lru_cache(maxsize=16)
def weight_graph(
    derivatives: tuple[str, ...] = (), aperture: Aperture | None = None, stopped: int = 0, unit: bool = False
) -> Graph:
    """Write the graph that turns rays of a lens into weighted rays in the camera's frame.

    The weight w is T A cos^4 / Z^2 over the exposure on the axis; see `cameras.contract`. Film points that no light
    reaches (area 0 or NaN) are outside the domain. A ray that does not pass has the weight 0.

    Args:
        derivatives: names of derivatives of `scene_ray`, which become inputs and outputs too.
        aperture, stopped, unit: see `status_graph`.

    Inputs are `film_mm`, `pupil_mm` [2], `area_mm2`, `scene_ray` [6] (mm, lens frame), `transmittance`, `lens_status`,
    and derivatives [6] of the ray; for a whole call `film_z_mm`, `per_distance` (1 / Z) and `scale` (1 / (Z^2
    exposure)). Outputs are `ray` [6] (metres, camera frame), `weight`, `status`, and derivatives of the ray.
    """
    g = Graph()
    film, pupil, area, ray = g.input("film_mm", 2), g.input("pupil_mm", 2), g.input("area_mm2"), g.input("scene_ray", 6)
    through, status = g.input("transmittance"), g.input("lens_status")
    per_distance, scale, film_z = (g.input(name, per_call=True) for name in ("per_distance", "scale", "film_z_mm"))
    status = g.inline(status_graph(aperture, stopped, unit), {"scene_ray": ray, "lens_status": status})["status"]
    status = g.select(g.constant(_NO_AREA) <= area, status, float(st.OUTSIDE_DOMAIN))
    cos2 = scale.sqrt() / (1.0 + g.square(pupil - film) * (per_distance * per_distance))
    weight = through.maximum(0.0) * area * cos2 * cos2
    g.outputs["ray"] = g.concat(ray[0:2] * 1e-3, ray[2] * 1e-3 + film_z * -1e-3, ray[3:6])
    g.outputs["weight"] = g.select(status <= float(st.PASSED), weight, 0.0)
    g.outputs["status"] = status.whole()
    for name in derivatives:
        g.outputs[name] = g.input(name, 6) * METRES
    return g


def unit_disc(square: Value) -> Value:
    """Map a point of the unit square evenly to a point [2] of the unit disc (Shirley and Chiu 1997)."""
    g = square.graph
    a, b = g.split(square * 2.0 - 1.0, (1, 1))
    flat = b * b <= a * a
    size = g.select(flat, a, b)
    angle = g.select(flat, b, a) / g.select(size * size <= _HAIR, 1.0, size)
    squared = angle * angle
    cos = size * g.series(squared, _COS)
    sin = size * angle * g.series(squared, _SIN)
    return g.concat(g.select(flat, cos, sin), g.select(flat, sin, cos))


def concentric_disk(square: NDArray[Any]) -> NDArray[Any]:
    """Map points [2, N] as `unit_disc` does, which keeps areas and neighbours."""
    g = Graph()
    g.outputs["disc"] = unit_disc(g.input("square", 2))
    return evaluate(g, {"square": square})["disc"]


def _series(function: Callable[[Array], Array]) -> Array:
    """Fit a polynomial in s = (angle / (pi / 4))^2, from 0 to 1, to a function of s, to float32's last bit."""
    fit = np.polynomial.Chebyshev.interpolate(function, 3, [0, 1])
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, np.float64)


_COS = _series(lambda s: np.cos(np.pi / 4 * np.sqrt(np.maximum(s, 0))))
_SIN = _series(lambda s: np.pi / 4 * np.sinc(np.sqrt(np.maximum(s, 0)) / 4))


class LensGraph(NamedTuple):
    """The graph of a lens, and what the graph of its camera needs besides.

    Attributes:
        graph: its inputs are `rays` [5] (film point, pupil point and wavelength), `film_z_mm` and `stop_radius_mm`; its
            outputs `scene_ray` [6], `transmittance`, `status`, `stop_xy_mm` [2], and any derivatives of `scene_ray`.
        stop_radius_mm: radius of the lens's round stop.
        aperture: the shape of the opening, tested on the rays' crossings with the stop; None is round.
        stopped: status of rays that the shape blocks.
        unit: whether directions are known to be of unit length.
    """

    graph: Graph
    stop_radius_mm: float
    aperture: Aperture | None = None
    stopped: int = 0
    unit: bool = False

    @property
    def blades(self) -> Aperture | None:
        """The opening, unless it is a mask, whose table is too large for compiled loops."""
        return None if self.aperture is None or self.aperture.mask is not None else self.aperture


def lens_inside(g: Graph, lens: LensGraph, rays: Value, mask_too: bool) -> tuple[dict[str, Value], Aperture | None]:
    """Put the graph of a lens, for rays [5], into another graph; return its outputs and the shape of the stop to test.

    Where the caller has to test a mask, `stop_xy_mm` becomes an output of the other graph.
    """
    aperture = lens.aperture if mask_too else lens.blades
    wanted = {k: v for k, v in lens.graph.outputs.items() if k != "stop_xy_mm" or lens.aperture is not None}
    found = g.inline(pruned(lens.graph, wanted), {"rays": rays})
    if aperture is None and "stop_xy_mm" in found:
        g.outputs["stop_xy_mm"] = found["stop_xy_mm"]
    return found, aperture


def unrounded(status: Value) -> Value:
    """Return the status of a lens's graph before it becomes an integer, so that tests can be added to it."""
    return status.graph.inputs_of(status.number)[0] if status.node.kind == "whole" else status


def camera_rays(found: Mapping[str, NDArray[Any]]) -> CameraRays:
    """Return the outputs of `weight_graph`, [R, N] each, as camera rays; those that do not pass look straight ahead.

    The derivatives by the film point are one input, `d_film` [6, 2, N].
    """
    ray, moves = found["ray"], found.get("d_film")
    lost = np.flatnonzero(found["status"][0] != st.PASSED)
    if lost.size:
        ray[:, lost] = _AHEAD
        if moves is not None:
            moves[..., lost] = 0
    differentials = None if moves is None else RayDifferentials(moves[:3], moves[3:])
    return CameraRays(ray[:3], ray[3:], found["weight"][0], found["status"][0], differentials)
