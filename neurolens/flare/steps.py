"""One surface as a graph, refracting or reflecting: the step that ghosts are traced by, on compiled code.

Light always travels towards -z here: in a frame that is mirrored (z reversed) while it goes to the film. So one step
serves both directions; it is that of the tracer (`trace.surfaces`). The figure of a surface is numbers of the call, as
its media are: surfaces of one kind share a function. Fresnel's reflectance is written without the difference of nearly
equal roots, which float32 would lose where glasses are cemented; a coating's is a polynomial in the cosine on the side
of the lower index, fitted to its transfer matrices at one wavelength.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.graph.ir import Graph, Value
from neurolens.lens.apertures import Aperture
from neurolens.trace import coatings
from neurolens.trace.arithmetic import TINY, Graphs
from neurolens.trace.coatinggraph import transmitted
from neurolens.trace.shapes import Figure
from neurolens.trace.surfaces import Medium, Rays, meet, normal_at, radius2, reflect, refract
from neurolens.trace.transmission import path_mm

Action = Literal["T", "R"]
STATE = 8  # rows: x, y, z (mm, this step's frame), direction, power, largest r^2 over the rim's so far
LOST = 1e30  # of that ratio: the ray meets no surface, or is totally reflected where it should go on
CALL = ("shift_mm", "curvature", "per_rim2", "n_before", "n_after", "n_step", "absorbed_per_mm")
DEGREE = 10  # of a coating's reflectance
FIGURE = ("stretch", "start_c", "start_cz", "last_step_mm")  # as `shapes.Figure`; then `across`, then the terms
ACROSS = 3
PLAIN = len(CALL) + DEGREE + 1  # numbers of the call of a sphere
_UNIT = Medium(1.0, 1.0, 1.0)  # no air: light may be totally reflected behind it
_FAINT = 2e-4  # reflectance that no ghost is seen by


class Shape(NamedTuple):
    """What a function knows of a `shapes.Figure`; its numbers are those of the call."""

    terms: int = 0
    even: bool = True
    steps: int = 0
    bent: tuple[bool, bool] = (True, True)
    crossed: bool = False
    turned: bool = False


class Kind(NamedTuple):
    """What one function of the compiled code does; steps of equal kind share it.

    Attributes:
        action: "T" refracted or "R" reflected.
        shape: None for spheres and planes; else what a figure has that is no number of the call: see `Shape`.
        bends: whether the media differ. coated: whether the reflectance is a polynomial of the call.
        absorbs: whether the medium before the surface takes light.
        aperture: the shape of the stop's opening, tested there; None is round.
    """

    action: Action
    shape: Shape | None = None
    bends: bool = True
    coated: bool = False
    absorbs: bool = False
    aperture: Aperture | None = None


def step_graph(kind: Kind) -> Graph:
    """Input `state` [8] and numbers of the call `call`; output `state` [8] after the surface, in the next step's frame.

    The order of `call` is `CALL`, then the coefficients of a coating's reflectance, lowest first, then `FIGURE` and the
    terms of the polynomial, as many as the shape has.
    """
    g, shape = Graph(), kind.shape
    o = Graphs(g, finite=True)  # films average over rays, also over those that are lost and have no power
    count = PLAIN + (0 if shape is None else len(FIGURE) + ACROSS * shape.crossed + shape.terms)
    state, call = g.input("state", STATE), g.input("call", count, per_call=True)
    shift, curvature, per_rim2, n1, n2, n_step, absorbed = (call[k] for k in range(len(CALL)))
    power, worst = state[6], state[7]
    rays = Rays(state[0], state[1], state[2] + shift, state[3], state[4], state[5])
    figure = Figure(curvature, plain=True) if shape is None else _figure(shape, call)
    # Indices are those relative to the medium before the surface, so that directions there are unit vectors.
    met = meet(o, rays, figure, -1, _UNIT)
    normal = normal_at(o, met, curvature)
    # On the near half of a sphere: beyond it there is no glass.
    tests = [*met.tests, (TINY, normal[2])]
    ratio2 = radius2(o, met) * per_rim2
    point, d = g.concat(met.x, met.y, met.z), state[3:6]
    if kind.absorbs:
        power = power * transmitted(path_mm(o, rays, met, _UNIT) * absorbed)
    if kind.bends:
        ratio = n1 / n2
        bent = refract(o, rays, met, curvature, -1, _UNIT, _UNIT, n_step / (n1 * n1))
        q, cos = met.q, bent.q * ratio
        reflected = _coated(g, call, q, cos, n_step) if kind.coated else _fresnel(n1, n2, n_step, q, cos)
        if kind.action == "R":
            power = power * o.select(TINY, bent.q2, reflected, 1.0)
        else:
            tests += bent.tests
            power = power * (1.0 - reflected)
            d = g.concat(*bent.rays[3:]) * ratio
    if kind.action == "R":
        d = g.concat(*reflect(o, rays, met, curvature, -1)[3:]) * [1.0, 1.0, -1.0]
        point = point * [1.0, 1.0, -1.0]
    if kind.aperture is not None:
        ratio2 = kind.aperture.rim(g, point[0:2], 1.0 / per_rim2.sqrt(), LOST)
    on = ratio2 <= LOST  # false for NaN
    for low, high in tests:
        on = on & (g.value(low) <= high)
    g.outputs["after"] = g.concat(point, d, power, g.select(on, worst.maximum(ratio2), LOST))
    return g


def film_graph() -> Graph:
    """Where light meets the film: input `state` and the film's `shift_mm`; output `film`: x, y (mm), power, worst.

    Power is 0 where any rim stopped the ray.
    """
    g = Graph()
    state, shift = g.input("state", STATE), g.input("shift_mm", per_call=True)
    z, dz, worst = state[2] + shift, state[5], state[7]
    place = state[0:2] - state[3:5] * (z / dz)
    arrives = (worst <= 1.0) & (dz <= -TINY)
    g.outputs["film"] = g.concat(place, g.select(arrives, state[6], 0.0), worst)
    return g


def _fresnel(n1: Value, n2: Value, n_step: Value, cos_i: Value, cos_t: Value) -> Value:
    """(Rs + Rp) / 2 of a bare surface; n_step = n2^2 - n1^2 (Born and Wolf, 1.5.2, by a^2 - b^2 = (a - b)(a + b)).

    With s = n1 c1 + n2 c2 and p = n2 c1 + n1 c2: rs = -n_step / s^2, rp = n_step (c1^2 - (n1 / n2)^2 (1 - c1^2)) / p^2.
    """
    s, p = n1 * cos_i + n2 * cos_t, n2 * cos_i + n1 * cos_t
    ratio, c2 = n1 / n2, cos_i * cos_i
    lack = c2 + ratio * ratio * (c2 + -1.0)
    rs, rp = n_step / (s * s), n_step * lack / (p * p)
    return (rs * rs + rp * rp) * 0.5


def _coated(g: Graph, call: Value, cos_i: Value, cos_t: Value, n_step: Value) -> Value:
    """The polynomial of a coating, in 1 - c with c the cosine on the side of the lower index."""
    u = 1.0 - g.select(g.constant(0.0) <= n_step, cos_i, cos_t)
    first = len(CALL)
    total = call[first + DEGREE]
    for k in reversed(range(DEGREE)):
        total = total * u + call[first + k]
    return total.maximum(0.0).minimum(1.0)


def reflectance_fit(
    layers: coatings.Layers, n_before: float, n_after: float, wavelength_nm: float, sense: int
) -> tuple[list[float], float]:
    """Coefficients of a coating's reflectance in 1 - c (c on the side of the lower index), and the largest error.

    By least relative squares at Chebyshev's places: ghosts live on what is left near normal incidence. n_before and
    n_after are as light of this sense meets them. The error is relative, of a reflectance of at least `_FAINT`.
    """
    c = 0.5 + 0.5 * np.cos((np.arange(64) + 0.5) * math.pi / 64)
    low, high = min(n_before, n_after), max(n_before, n_after)
    there = np.sqrt(1 - (low / high) ** 2 * (1 - c * c))
    cos_i = torch.from_numpy(c if n_before <= n_after else there)
    exact = coatings.reflectance(cos_i, n_before, n_after, layers, wavelength_nm, sense).numpy()
    fit = np.polynomial.Chebyshev.fit(1 - c, exact, DEGREE, domain=(0, 1), w=1 / (exact + _FAINT))
    worst = np.abs(fit(1 - c) - exact) / (exact + _FAINT)
    return (np.asarray(fit.coef, np.float64) @ _powers()).tolist(), float(worst.max())


@cache
def _powers() -> NDArray[np.float64]:
    """Coefficients of the powers of u in Chebyshev's polynomials of 2 u - 1, [DEGREE + 1, DEGREE + 1]."""
    basis = [np.polynomial.Chebyshev.basis(k, domain=(0, 1)) for k in range(DEGREE + 1)]
    powers = [each.convert(kind=np.polynomial.Polynomial).coef for each in basis]
    return np.stack([np.pad(each, (0, DEGREE + 1 - len(each))) for each in powers])


def _figure(shape: Shape, call: Value) -> Figure:
    more = ACROSS * shape.crossed
    stretch, c, cz, last_step, *rest = (call[PLAIN + k] for k in range(len(FIGURE) + more + shape.terms))
    figure = Figure(call[CALL.index("curvature")], stretch, bent=shape.bent)
    if not shape.terms and not shape.crossed:
        return figure
    other: Any = rest[1] if shape.crossed else 0.0
    start = c if shape.bent[0] else other, c if shape.bent[1] else other, cz
    return figure._replace(
        terms=rest[more:], even=shape.even, start=start, steps=shape.steps, last_step=last_step,
        across=(rest[0], rest[2]) if shape.crossed else (), turned=shape.turned,
    )  # fmt: skip


def figure_numbers(figure: Figure, turn: float) -> list[Any]:
    """`FIGURE` and the terms as numbers, turned by -1.0 for light that travels towards +z in the lens frame."""
    cx, cy, cz = figure.start or (0.0, 0.0, 0.0)
    c, other = (cx, cy) if figure.bent[0] else (cy, cx)
    across = [turn * figure.across[0], turn * other, figure.across[1]] if figure.across else []
    return [figure.stretch, turn * c, turn * cz, figure.last_step, *across, *(turn * v for v in figure.terms)]
