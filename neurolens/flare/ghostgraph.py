"""Ghosts as graphs, for programs that draw them on a GPU: their exact paths, and where their light enters the lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.ghosts import GhostTracer, Pair
from neurolens.flare.steps import CALL, Stack, film_graph, step_graph
from neurolens.graph.ir import Graph, Value
from neurolens.lens.glass import inverse_square_um
from neurolens.lens.prescription import Lens

Array = NDArray[np.float64]
_RAYS = 1 << 16  # that look for the light of each ghost
_FEWEST = 8  # of them that reach the film, for a ghost to be known
_WIDE = 1.3  # the disc that they enter, over the front's radius
_MARGIN = 1.12  # of the disc in which they find the light
_DEGREE = 13  # of the numbers of a surface by the wavelength


@dataclass(frozen=True, eq=False)
class Entrance:
    """A ghost, and the disc through which its light enters the lens.

    The disc has the points chief_mm p + scale_mm u of the plane z = 0 (mm), with |u| < 1, where p is the light's
    direction (x, y) over the sine of the widest angle. `light` is the ghost's light on the film.
    """

    pair: Pair
    light: float
    chief_mm: Array
    scale_mm: Array


def entrances(
    tracer: GhostTracer, sine: float, film_radius_mm: float, wavelength_nm: float, seed: int = 0
) -> list[Entrance]:
    """Find the discs through which the ghosts enter whose light reaches the film, brightest first.

    Args:
        tracer: of a lens whose film is placed. sine: of the largest angle between the axis and the light.
    """
    lens, rng = tracer.lens, np.random.default_rng(seed)
    p, u = _drawn(lens, rng)
    wide = _WIDE * lens.surfaces[0].semi_diameter_mm
    place = wide * u
    d = np.concatenate([sine * p, np.sqrt(1 - sine**2 * (p**2).sum(0, keepdims=True))])
    before = np.concatenate([place, np.zeros((1, _RAYS))]) - 1000.0 * d
    rays = tracer.trace(np.concatenate([before, d]), wavelength_nm)
    on_film = np.hypot(*np.moveaxis(rays.film_xy_mm, 1, 0)) < film_radius_mm
    found = []
    for pair, power, here in zip(tracer.pairs, rays.power, on_film, strict=True):
        lit = here & (power > 0)
        if lit.sum() >= _FEWEST:
            light = float((np.where(lit, power, 0) * d[2]).mean(dtype=np.float64))
            found.append(Entrance(pair, light, *_disc(p[:, lit], place[:, lit], lens.anamorphic)))
    return sorted(found, key=lambda entrance: -entrance.light)


def _drawn(lens: Lens, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random p and u [2, N], each in the unit disc; with an axis of symmetry p lies along x, which stands for all."""
    r, turn = np.sqrt(rng.random(_RAYS)), 2 * np.pi * rng.random(_RAYS)
    length = np.sqrt(rng.random(_RAYS))
    about = 2 * np.pi * rng.random(_RAYS) if lens.anamorphic else np.zeros(_RAYS)
    return r * np.stack([np.cos(about), np.sin(about)]), length * np.stack([np.cos(turn), np.sin(turn)])


def _disc(along: Array, place: Array, anamorphic: bool) -> tuple[Array, Array]:
    """The chief and the scale [2] of a disc that holds points [2, N] of light of directions p [2, N]."""
    chief = (place * along).sum(1) / np.maximum((along**2).sum(1), 1e-300)
    chief[1] = chief[1] if anamorphic else chief[0]
    off = place - chief[:, None] * along
    wide = np.abs(off).max(1) if anamorphic else np.ones(2)
    scale = (1 + 2 / math.sqrt(off.shape[1])) * float(np.hypot(*(off / wide[:, None])).max()) * wide
    return chief, _MARGIN * scale


def ghost_graphs(lens: Lens, pairs: Sequence[Pair], wavelength_nm: tuple[float, float]) -> list[Graph]:
    """The exact path of each ghost as a graph, from `program.ENTERING` to `program.ARRIVING`.

    `entering` [5] is the light's unit direction towards the film (dx, dy), its point on the plane z = 0 (mm) and the
    wavelength; `stop_radius_mm` of the call is that of a round stop. `arriving` [4] is the film point (mm), the power,
    and the largest r^2 / R^2 at any rim.

    Args:
        lens: its film must be placed. wavelength_nm: the range in which indices and coatings hold.

    Raises:
        InputError: the lens has a mask in its stop.
    """
    if lens.aperture is not None and lens.aperture.mask is not None:
        raise InputError(lens.path, "aperture", "(a mask)", "a round stop: ghosts as graphs take no mask")
    count = len(lens.surfaces)
    stack = Stack(replace(lens, aperture=None), [(k, action) for k in range(count) for action in range(4)])
    short, long = (float(inverse_square_um(nm)) for nm in wavelength_nm)
    nodes = np.cos((np.arange(_DEGREE + 1) + 0.5) * math.pi / (_DEGREE + 1))
    at = [1000 / math.sqrt((short + long) / 2 + (short - long) / 2 * node) for node in nodes]
    numbers = np.stack([stack.numbers(nm)[0] for nm in at], -1).astype(np.float64)
    return [_graph(stack, pair, numbers, nodes, stack.numbers(at[0])[1], (short, long)) for pair in pairs]


def _graph(
    stack: Stack, pair: Pair, numbers: Array, nodes: Array, shift_mm: float, w_range: tuple[float, float]
) -> Graph:
    g, (first, second), (short, long) = Graph(), pair, w_range
    rays, radius = g.input("entering", 5), g.input("stop_radius_mm", per_call=True)
    inverse_um = 1000.0 / rays[4]
    w = (inverse_um * inverse_um - (short + long) / 2) * (2 / max(short - long, 1e-30))
    per_stop2 = 1.0 / (radius * radius)
    ahead = (1.0 - g.square(rays[0:2])).sqrt()
    state = g.concat(rays[2:4], g.constant(0.0), rays[0:2], -ahead, g.constant([1.0, 0.0]))
    steps = [*((k, 0) for k in range(second)), (second, 2), *((k, 1) for k in range(second - 1, first, -1)), (first, 3)]
    for k, action in [*steps, *((k, 0) for k in range(first + 1, len(stack.lens.surfaces)))]:
        step = step_graph(stack.kind(k, action))
        call: list[Value] = []
        for n in range(next(node.rows for node in step.nodes if node.name == "call")):
            values = numbers[k, action, n]
            if n == CALL.index("per_rim2") and stack.lens.surfaces[k].stop:
                call.append(per_stop2)
            elif np.ptp(values) > 0:
                call.append(g.series(w, np.polynomial.polynomial.polyfit(nodes, values, _DEGREE)))
            else:
                call.append(g.constant(float(values[0])))
        state = g.inline(step, {"state": state, "call": g.concat(*call)})["after"]
    g.outputs["arriving"] = g.inline(film_graph(), {"state": state, "shift_mm": g.constant(shift_mm)})["film"]
    return g
