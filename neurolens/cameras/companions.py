"""Companion wavelengths of camera rays: where on film and pupil another wavelength takes the same scene ray.

A path that carries several wavelengths follows the scene ray of one, the hero. At a companion wavelength the same scene
ray belongs to another film point, some microns away, and to another pupil point. Polynomials of low order give both
shifts; the lens's own graph then says whether the companion passes and how much of its light arrives.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.cameras.cameragraph import LensGraph, lens_inside, status_graph, unrounded
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.graph.program import RAY

Array = NDArray[np.float64]

# Degrees in film and pupil point of the terms without a wavelength, linear in the wavelengths, and quadratic.
_DEGREES = (7, 3, 1)
_STEPS, _CLOSE = 5, 1e-4  # of Newton's method; how well a shift must keep the scene ray, mm
_FAR_MM = 50.0  # from the lens, where an error of a direction counts as an error of the position
_FEWEST = 500  # rays, to fit to
_WORST_MM, _WORST = 5e-4, 0.05  # RMS error of the film point, alone and of the shifts, one of which must do
_BEYOND = 1.5  # the farthest shift over that of the rays of the fit


class Shift(NamedTuple):
    """The shift from the film and pupil point of the hero to those of a companion.

    Attributes:
        of_hero: inputs `film_mm`, `pupil_mm` [2], `wavelength_nm`; output `shift` [12], what all companions share.
        graph: inputs those of `of_hero`, `shift` and `companion_nm`; outputs `companion` [4], the film and pupil point
            in mm of the same scene ray at the companion wavelength, and `known`, 0 beyond the film or the reach.
        reach_mm: the largest shift of the film point along x and along y; a companion beyond it counts as blocked.
    """

    of_hero: Graph
    graph: Graph
    reach_mm: tuple[float, float]


def fit_shift(
    lens: Graph, samples: Mapping[str, Array], companion_nm: Array, film_mm: tuple[float, float]
) -> Shift | None:
    """Fit the shift of a lens; None if too few rays pass, or the error on held-out rays is too large.

    Args:
        lens: the graph of the lens (`cameragraph.LensGraph`).
        samples: its inputs for rays that cover film, pupil and wavelengths; half of them measure the error.
        companion_nm: [N] wavelengths of the companions. film_mm: width and height of the film.
    """
    rays = samples["rays"]
    shift, kept = _solved(lens, samples, companion_nm)
    if kept.sum() < _FEWEST:
        return None
    rays, shift, companion_nm = rays[:, kept], shift[:, kept], companion_nm[kept]
    waves = (1000 / np.stack([rays[4], companion_nm])) ** 2
    low, high = float(waves.min()), float(waves.max())
    middle, spread = 0.5 * (low + high), 0.5 * (high - low)
    scale = np.repeat([np.abs(rays[:2]).max(), np.abs(rays[2:4]).max()], 2)
    columns = np.concatenate([rays[:4] / scale[:, None], (waves - middle) / spread])
    exponents, odd = _monomials()
    products = np.stack([np.prod(columns.T**powers, axis=1) for powers in exponents]) * (columns[5] - columns[4])
    train = np.arange(rays.shape[1]) % 2 == 0
    weights = np.zeros((4, len(exponents)))
    for row in range(4):  # x of film and pupil are odd in x and even in y
        terms = odd == row % 2
        sizes = np.linalg.norm(products[terms][:, train], axis=1)
        part = (products[terms][:, train] / sizes[:, None]).T
        weights[row, terms] = np.linalg.lstsq(part, shift[row, train], rcond=1e-10)[0] / sizes
    left, size = (
        float(np.sqrt(np.mean(np.sum(v[:2, ~train] ** 2, axis=0)))) for v in (shift - weights @ products, shift)
    )
    if left > max(_WORST_MM, _WORST * size):
        return None
    x, y = (_BEYOND * float(v) for v in np.abs(shift[:2]).max(axis=1))
    return Shift(*_shift_graphs((exponents, weights), scale, (middle, spread), (x, y), film_mm), (x, y))


def _shift_graphs(
    terms: tuple[NDArray[np.int64], Array], scale: Array, waves: tuple[float, float], *limits_mm: tuple[float, float]
) -> tuple[Graph, Graph]:
    """The graphs of `Shift`, for exponents [M, 6] and weights [4, M] of variables so scaled, the reach and the film."""
    exponents, weights = terms
    each, place = np.unique(exponents[:, :5], axis=0, return_inverse=True)
    powers = np.zeros((len(_DEGREES), 4, len(each)))  # of the companion's variable
    powers[exponents[:, 5], :, place.ravel()] = weights.T

    def variable(g: Graph, name: str) -> Value:
        inverse = 1000.0 / g.input(name)
        return (inverse * inverse + -waves[0]) * (1 / waves[1])

    of_hero, g = Graph(), Graph()
    start, point = (h.concat(h.input("film_mm", 2), h.input("pupil_mm", 2)) for h in (of_hero, g))
    variables = of_hero.concat(start * (1 / scale), variable(of_hero, "wavelength_nm"))
    of_hero.outputs["shift"] = of_hero.polynomial(each, powers.reshape(-1, len(each)), variables)
    hero, other = (variable(g, name) for name in ("wavelength_nm", "companion_nm"))
    constant, linear, quadratic = g.split(g.input("shift", 12), [4, 4, 4])
    moved = point + (constant + (linear + quadratic * other) * other) * (other - hero)
    reach, half = np.array(limits_mm[0]), 0.5 * np.array(limits_mm[1])
    near = (moved - point)[:2].between(-reach, reach) & moved[:2].between(-half, half)
    g.outputs |= {"companion": moved, "known": near[0] & near[1]}
    return of_hero, g


def companion_graph(lens: LensGraph, shift: Graph, mask_too: bool) -> Graph:
    """The graph of companions: from a ray's film and pupil point and two wavelengths to the companion's light.

    Inputs: those of `Shift.graph`, beyond whose limits companions are outside the domain, and those of the lens for a
    whole call; with `mask_too` the table of a mask.
    Outputs: `companion` [2], the film point, `transmittance`, `status`; without `mask_too` also `stop_xy_mm` of a lens
    with a mask.
    """
    g = Graph()
    shifted = g.inline(shift, {})
    found, aperture = lens_inside(g, lens, g.concat(shifted["companion"], g.input("companion_nm")), mask_too)
    given = {**found, "lens_status": unrounded(found["status"])}
    status = g.inline(status_graph(aperture, lens.stopped, lens.unit), given)["status"]
    status = g.select(shifted["known"], status, status.maximum(float(st.OUTSIDE_DOMAIN))).whole()
    g.outputs |= {"companion": shifted["companion"][:2], "transmittance": found["transmittance"], "status": status}
    return g


@cache
def _monomials() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Exponents [M, 6] of film x, y, pupil x, y, hero and companion; and [M] 0 where odd in x, 1 where odd in y.

    Lenses with two planes of symmetry have no others, round or with cylinders.
    """
    found = []
    for *point, hero, other in product(*[range(_DEGREES[0] + 1)] * 4, *[range(len(_DEGREES))] * 2):
        order = hero + other
        if order < len(_DEGREES) and sum(point) <= _DEGREES[order] and sum(point) % 2:
            found.append((*point, hero, other))
    exponents = np.array(found, np.int64)
    return exponents, 1 - (exponents[:, 0] + exponents[:, 2]) % 2


def _solved(lens: Graph, samples: Mapping[str, Array], companion_nm: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Shifts [4, N] of film and pupil points by Newton's method in float64, and [N] which of them are solutions."""
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
    return place - start, kept
