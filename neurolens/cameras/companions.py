"""Companion wavelengths of camera rays: where on film and pupil another wavelength takes the same scene ray.

A path that carries several wavelengths follows the scene ray of one of them, the hero. At a companion wavelength the
same scene ray belongs to another film point, some microns away, and to another pupil point. Polynomials of low order
give both shifts and the ratio of their light. Whether a companion passes the lens is certain inside the pupil; near the
pupil's edge the lens's own graph decides.
"""

from collections.abc import Callable, Mapping
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.cameragraph import LensGraph, lens_inside, status_graph, unrounded
from neurolens.cameras.pose import FilmPose, to_film
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value, pruned
from neurolens.graph.program import RAY

Array = NDArray[np.float64]
Degrees = tuple[int, int, int]
Pair = tuple[float, float]

# Degrees in film and pupil point: of the terms without a wavelength, of those linear in the wavelengths, and of the
# quadratic ones. The second set serves where the first does not keep film points within `_WORST_MM`.
_DEGREES = ((5, 3, 1), (7, 3, 1))
_FITTED = 1.5  # up to where the variable of the wavelength counts as fitted; the ends of the fit are at 1
_LIGHT_DEGREE, _TINT = 4, 8  # degrees of the ratio of light: in film and pupil point, and in the wavelength alone
_STEPS, _CLOSE = 5, 1e-4  # steps of Newton's method, and how closely (mm) a shift must keep the scene ray
_FAR_MM = 50.0  # distance from the lens at which an error of direction counts as one of position
_FEWEST = 500  # rays that a fit needs
_WORST_MM, _WORST = 5e-4, 0.05  # RMS error of the film point, in mm or as a share of the shifts: one must do
_BEYOND = 1.5  # the farthest shift over the fitted rays', and the pupil's edge over where they are lost
_SURELY = 0.02  # share of the rays, next to the edge, that are traced in any case


class Shift(NamedTuple):
    """The shift from a hero's film and pupil points to those of a companion.

    Attributes:
        of_hero: the part that all companions share; inputs `film_mm`, `pupil_mm` [2] and `wavelength_nm`, outputs
            `film_shift` and `pupil_shift` [6], and `tint`.
        graph: takes these inputs, the outputs of `of_hero` and `companion_nm`, and gives `film_there` and `pupil_there`
            [2], the points (mm) of the same scene ray at the companion wavelength, and the `ratio` of its light to the
            hero's. Here `film_mm` and `film_there` are points of the upright film plane.
        reach_mm: the largest shift of the film point along x and along y; a companion beyond it counts as blocked.
        edge: three numbers. A companion passes if the hero passes and its distance inside the pupil's edge (mm) is more
            than the first number, than the second times d, and than the third times -d. Here d is by how much its 1 /
            wavelength^2 (um) exceeds the hero's, with the sign changed on the far side of the pupil's middle, for
            dispersion moves rays to one side.
    """

    of_hero: Graph
    graph: Graph
    reach_mm: tuple[float, float]
    edge: tuple[float, float, float]


def fit_shift(
    lens: Graph, samples: Mapping[str, Array], margin: Array, companion_nm: Array, film_mm: Pair,
    from_plane: Callable[[Array, Array], Array],
) -> Shift | None:  # fmt: skip
    """Fit the shift of a lens; return None if too few rays pass, or if the error on held-out rays is too large.

    Args:
        lens: the graph of the lens (`cameragraph.LensGraph`).
        samples: its inputs for rays that cover film, pupil and wavelengths; half of them measure the error.
        margin: [N], how far inside the pupil these rays pass, as in `lanes_graph`.
        companion_nm: [N], wavelengths of the companions.
        film_mm: width and height of the film. from_plane: takes where rays cross the upright film plane and the pupil
            to film points (`LensFilm.from_plane`).
    """
    found = _solved(lens, samples, companion_nm)
    if found.kept.sum() < _FEWEST:
        return None
    rays, values, companion_nm = (v[..., found.kept] for v in (samples["rays"], found.values, companion_nm))
    waves = (1000 / np.stack([rays[4], companion_nm])) ** 2
    middle, spread = 0.5 * float(waves.min() + waves.max()), 0.5 * float(np.ptp(waves))
    scale = np.repeat([np.abs(rays[:2]).max(), np.abs(rays[2:4]).max()], 2)
    columns = np.concatenate([rays[:4] / scale[:, None], (waves - middle) / spread])
    for degrees in _DEGREES:
        weights, tint, left = _terms(columns, values, degrees)
        if left <= _WORST_MM:
            break
    if left > max(_WORST_MM, _WORST * float(np.sqrt(np.mean(np.sum(values[:2] ** 2, axis=0))))):
        return None
    hero, there = (from_plane(*np.split(rays[:4] + moved, 2)) for moved in (0.0, values[:4]))
    x, y = (_BEYOND * float(v) for v in np.abs(there - hero).max(axis=1))
    graphs = _shift_graphs(degrees, weights, tint, scale, (middle, spread))
    on_film = (np.abs(there) < 0.5 * np.array(film_mm)[:, None]).all(axis=0)
    surely, inside = float(np.quantile(margin, _SURELY)), margin[found.kept]
    lost = on_film & ~found.passed[found.kept] & (inside > surely)
    away = ((waves[1] - waves[0]) * np.where((rays[:2] * rays[2:4]).sum(axis=0) <= 0, -1, 1))[lost]
    near, far = (_BEYOND * float(np.max(inside[lost] / way, initial=0, where=way > 0)) for way in (away, -away))
    return Shift(*graphs, (x, y), (surely, near, far))


def _terms(columns: Array, values: Array, degrees: Degrees) -> tuple[Array, Array, float]:
    """Fit the values [5, N] of `_Solved` by polynomials of variables [6, N].

    Returns:
        The weights [5, M] of the monomials, the coefficients of the light by wavelength, and the RMS error of the film
        point on the half of the rays that were not fitted.
    """
    exponents, parity = _monomials(degrees)
    products = np.stack([np.prod(columns.T**powers, axis=1) for powers in exponents]) * (columns[5] - columns[4])
    tints = np.stack([columns[5] ** k - columns[4] ** k for k in range(1, _TINT + 1)])
    train = np.arange(values.shape[1]) % 2 == 0
    weights, tint = np.zeros((5, len(exponents))), np.zeros(_TINT + 1)
    for row, kind in enumerate((0, 1, 0, 1, 2)):
        terms = parity == kind
        part = np.concatenate([products[terms], tints[: _TINT if kind == 2 else 0]])[:, train]
        sizes = np.linalg.norm(part, axis=1)
        solved = np.linalg.lstsq((part / sizes[:, None]).T, values[row, train], rcond=1e-10)[0] / sizes
        weights[row, terms], tint[1:] = solved[: terms.sum()], solved[terms.sum() :] if kind == 2 else 0
    left = (values - weights @ products)[:2, ~train]
    along = np.linspace(-1, 1, 8 * _TINT)
    light = np.exp(np.vander(along, _TINT + 1, increasing=True) @ tint)
    return weights, np.polyfit(along, light, _TINT)[::-1], float(np.sqrt(np.mean(np.sum(left**2, axis=0))))


def _shift_graphs(degrees: Degrees, weights: Array, tint: Array, scale: Array, waves: Pair) -> tuple[Graph, Graph]:
    """Write the graphs of `Shift` from what `_terms` finds in scaled variables."""
    exponents, of_hero, g = _monomials(degrees)[0], Graph(), Graph()

    def variable(g: Graph, name: str) -> Value:
        inverse = 1000.0 / g.input(name)
        return (inverse * inverse + -waves[0]) * (1 / waves[1])

    start = of_hero.concat(of_hero.input("film_mm", 2), of_hero.input("pupil_mm", 2))
    variables = of_hero.concat(start * (1 / scale), variable(of_hero, "wavelength_nm"))
    for name, rows in (("film_shift", slice(0, 2)), ("pupil_shift", slice(2, 4)), ("tint", slice(4, 5))):
        used = weights[rows].any(axis=0)
        each, place = np.unique(exponents[used][:, :5], axis=0, return_inverse=True)
        powers = np.zeros((1 if name == "tint" else len(degrees), len(weights[rows]), len(each)))
        powers[exponents[used][:, 5], :, place.ravel()] = weights[rows][:, used].T  # of the companion's variable
        of_hero.outputs[name] = of_hero.polynomial(each, powers.reshape(-1, len(each)), variables)
    hero, other = (variable(g, name) for name in ("wavelength_nm", "companion_nm"))
    for what in ("film", "pupil"):
        constant, linear, quadratic = g.split(g.input(f"{what}_shift", 6), [2, 2, 2])
        moved = (constant + (linear + quadratic * other) * other) * (other - hero)
        g.outputs[f"{what}_there"] = g.input(f"{what}_mm", 2) + moved
    light = g.series(other, tint) / g.series(hero, tint)
    # A wavelength far from those that were fitted has no light: the series would give it any number.
    light = g.select(g.square(other) <= _FITTED**2, light.maximum(0.0), 0.0)
    g.outputs["ratio"] = light * ((other - hero) * g.input("tint") + 1.0)
    return of_hero, g


def lanes_graph(shift: Shift, companions: int, film_mm: Pair, pose: FilmPose) -> Graph:
    """Write the graph of all wavelengths of a ray, as if the lens let every companion pass.

    Inputs are those of `Shift.of_hero` (its film point is named `plane_mm`), `companion_nm` [companions], and of the
    hero ray `film_mm` and `square` [2], `area_mm2` and `weight`. Of the outputs, `light` [companions] has the weight
    that each would have alone, which is 0 beyond the reach and beyond the film (of size `film_mm`, in its `pose`).
    `places` has the film points of all wavelengths, which are the hero's where there is no light. `sure` [companions]
    is above 0 where a companion passes if the hero does.
    """
    g = Graph()
    film, light, weight = g.input("film_mm", 2), g.input("companion_nm", companions), g.input("weight")
    plane, reach, half = g.input("plane_mm", 2), np.array(shift.reach_mm), np.array(film_mm) / 2
    shifts = ("film_shift", "tint") if not pose.turned else tuple(shift.of_hero.outputs)
    same = g.inline(pruned(shift.of_hero, {k: shift.of_hero.outputs[k] for k in shifts}), {"film_mm": plane})
    wanted = {k: v for k, v in shift.graph.outputs.items() if k != "pupil_there" or pose.turned}
    lanes, there = [], []
    for k in range(companions):
        found = g.inline(pruned(shift.graph, wanted), same | {"companion_nm": light[k], "film_mm": plane})
        place = found["film_there"]
        if pose:
            given = {"plane_mm": place, "pupil_mm": found.get("pupil_there", place)}
            place = g.inline(to_film(pose), given)["film_mm"]
        near = (place - film).between(-reach, reach) & place.between(-half, half)
        lanes.append(g.select(near[0] & near[1], found["ratio"] * weight, 0.0))
        there.append(g.select(lanes[-1] <= 0.0, film, place))
    g.outputs |= {"light": g.concat(*lanes), "places": g.concat(film, *there)}
    inside = (g.input("square", 2) * 2.0 - 1.0).abs()
    margin = (1.0 - inside[0].maximum(inside[1])) * g.input("area_mm2").maximum(0.0).sqrt()  # about in mm
    surely, *slopes = shift.edge
    hero, *others = (g.square(1000.0 / nm) for nm in (g.input("wavelength_nm"), *g.split(light, [1] * companions)))
    side = g.select(g.dot(plane, g.input("pupil_mm", 2)) <= 0.0, -1.0, 1.0)
    aways = [(other - hero) * side for other in others]
    edges = [(away * slopes[0]).maximum(away * -slopes[1]).maximum(surely) for away in aways]
    g.outputs["sure"] = g.concat(*(margin - edge for edge in edges))
    return g


def companion_graph(lens: LensGraph, shift: Shift, mask_too: bool) -> Graph:
    """Write the graph that tells whether companions pass, from a ray's film and pupil point and two wavelengths.

    Inputs are those of `Shift.of_hero`, `companion_nm`, and those of the lens for a whole call; with `mask_too` also
    the table of a mask. Outputs are `status`, and without `mask_too`, for a lens with a mask, `stop_xy_mm`.
    """
    g = Graph()
    of_hero = {k: v for k, v in shift.of_hero.outputs.items() if k != "tint"}
    wanted = {k: shift.graph.outputs[k] for k in ("film_there", "pupil_there")}
    there = g.inline(pruned(shift.graph, wanted), g.inline(pruned(shift.of_hero, of_hero), {}))
    rays = g.concat(there["film_there"], there["pupil_there"], g.input("companion_nm"))
    found, aperture = lens_inside(g, lens, rays, mask_too)
    given = {**found, "lens_status": unrounded(found["status"])}
    g.outputs["status"] = g.inline(status_graph(aperture, lens.stopped, lens.unit), given)["status"].whole()
    return g


@cache
def _monomials(degrees: Degrees) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return exponents [M, 6] of film x, y, pupil x, y, hero and companion, and a number for the symmetry of each term.

    The number [M] is 0 for a term odd in x alone and 1 for one odd in y alone, as shifts are, and 2 for one odd in
    neither, as light is. A lens with two planes of symmetry, round or with cylinders, has no other terms.
    """
    found, parity = [], []
    for *point, hero, other in product(*[range(degrees[0] + 1)] * 4, *[range(len(degrees))] * 2):
        order, x, y = hero + other, (point[0] + point[2]) % 2, (point[1] + point[3]) % 2
        shifts = x + y == 1 and order < len(degrees) and sum(point) <= degrees[order]
        if shifts or (not (x or y or order) and 0 < sum(point) <= _LIGHT_DEGREE):
            found.append((*point, hero, other))
            parity.append(y if shifts else 2)
    return np.array(found, np.int64), np.array(parity)


class _Solved(NamedTuple):
    """Holds solved shifts.

    Attributes:
        values: [5, N], the shifts of film and pupil points [4, N] and the logarithm of the ratio of light.
        kept: [N], whether they are solutions.
        passed: [N], whether the companion passes.
    """

    values: Array
    kept: NDArray[np.bool_]
    passed: NDArray[np.bool_]


def _solved(lens: Graph, samples: Mapping[str, Array], companion_nm: Array) -> _Solved:
    """Solve for the shifts by Newton's method in float64."""
    graph = with_derivatives(lens, ["scene_ray"], [("rays", row) for row in range(4)])
    names = [derivative("scene_ray", row) for row in RAY]
    scale = np.array([1.0, 1.0, 1.0, *[_FAR_MM] * 3])[:, None]
    hero = evaluate(lens, samples)
    wanted = hero["scene_ray"] * scale
    kept = (hero["status"][0] == st.PASSED) & np.isfinite(wanted).all(0)
    start = samples["rays"][:4]
    place = start.copy()
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            found = evaluate(graph, {**samples, "rays": np.concatenate([place, companion_nm[None]])})
            left = np.nan_to_num(wanted - found["scene_ray"] * scale)
            slopes = np.stack([np.broadcast_to(found[name], left.shape) * scale for name in names], axis=1)
            slopes = np.nan_to_num(slopes).transpose(2, 0, 1)  # [N, 6, 4]
            turned = slopes.transpose(0, 2, 1)
            normal = turned @ slopes + 1e-12 * np.eye(4)
            place += np.linalg.solve(normal, turned @ left.T[..., None])[..., 0].T
        found = evaluate(lens, {**samples, "rays": np.concatenate([place, companion_nm[None]])})
        kept &= np.abs(found["scene_ray"] * scale - wanted).max(axis=0) < _CLOSE
        ratio = np.log(found["transmittance"] / hero["transmittance"])
    kept &= np.isfinite(ratio[0])
    return _Solved(np.concatenate([place - start, ratio]), kept, found["status"][0] == st.PASSED)
