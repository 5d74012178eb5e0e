"""Ghosts as surrogates: where light of a direction that enters at a point of the front meets the film, and its power.

Of every ghost the film point and the crossings with the rims that stop light are vectors A p + B u, and the power is a
scalar, with A, B and the power polynomials in rho = p.p, sigma = p.u, tau = u.u and w: the form of the surrogates of
images (`surrogates.cores`) with other inputs. p is the light's direction, u the point on the plane of the front vertex
less its part that follows p. Of a lens with cylinders x and y of vectors and the power are polynomials in p, u and w
themselves, each of the terms that its two planes of symmetry leave. Stop and blades are tests on the crossings with the
stop: they need no new fit.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.ghosts import GhostRays, GhostTracer, Pair
from neurolens.flare.steps import LOST, Floats, function_text
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Graph, Value
from neurolens.lens.glass import inverse_square_um
from neurolens.lens.prescription import Lens
from neurolens.surrogates.lightfield import ROUND

Array = NDArray[np.float64]
_CALL = 7  # numbers of the call: p, what chief is of it (mm), 1 / scale, the stop's radius
_FITTED = 1.5  # of u^2: beyond it polynomials mean nothing
_SLACK = 1.02  # of the largest angle: rays of a near light differ


@dataclass(frozen=True, eq=False)
class GhostPolynomial:
    """One ghost.

    Attributes:
        chief_mm: [2] of x and y, u = (place - chief_mm p) / scale_mm for places [2] in mm on the plane z = 0.
        scale_mm: [2], see there; the ghost's light has |u| below 1.
        surfaces: of each crossing the surface whose rim it is in units of.
        exponents: [M, 4] of rho, sigma, tau, w; of a lens with cylinders [M, 5] of p_x, p_y, u_x, u_y, w.
        ab: [1 + K, 2, M] coefficients of A and B, with cylinders of x and y, of the film point (mm) and K crossings.
        power: [M].
    """

    chief_mm: Array
    scale_mm: Array
    surfaces: tuple[int, ...]
    exponents: Exponents
    ab: Array
    power: Array

    @cached_property
    def table(self) -> Array:
        """[2 (1 + K) + 1, M]: A and B of each vector, then the power."""
        return np.concatenate([self.ab.reshape(-1, len(self.power)), self.power[None]])

    @cached_property
    def places(self) -> tuple[Exponents, Exponents]:
        """[L, 2] the exponents of sigma and tau (of u_x and u_y), and [M] which of them each term has."""
        rest, place = np.unique(self.exponents[:, -3:-1], axis=0, return_inverse=True)
        return rest, place.reshape(-1).astype(np.int64)

    @cached_property
    def _grouped(self) -> tuple[Exponents, Exponents, Exponents]:
        """Terms of one place and one power of w: the order that has them side by side, where each begins, and its
        number, the power's times L and the place's."""
        number = self.exponents[:, -1] * len(self.places[0]) + self.places[1]
        order = np.argsort(number, kind="stable")
        numbers, first = np.unique(number[order], return_index=True)
        return order.astype(np.int64), first.astype(np.int64), numbers

    def fixed(self, p: Array, w: Array) -> Array:
        """The tables [W, rows, L] of one direction and wavelengths [W], over the first of `places`."""
        order, first, numbers = self._grouped
        of_p, powers, direction = self.exponents[:, :-3], 1 + int(self.exponents[:, -1].max()), np.ones(len(self.power))
        for value, power in zip(p if of_p.shape[1] == 2 else [p @ p], of_p.T, strict=True):
            direction *= (value ** np.arange(1 + power.max()))[power]
        found = np.zeros((len(self.table), powers * len(self.places[0])))
        found[:, numbers] = np.add.reduceat((self.table * direction)[:, order], first, axis=1)
        of_w = w[:, None] ** np.arange(powers)
        return (of_w @ found.reshape(len(found), powers, -1)).swapaxes(0, 1)

    @cached_property
    def key(self) -> tuple[tuple[int, ...], ...]:
        """The exponents of `places`, hashable."""
        return tuple(map(tuple, self.places[0].tolist()))


@dataclass(frozen=True, eq=False)
class GhostModel:
    """Surrogates of a lens's ghosts, in the state that it has; takes the place of a `GhostTracer`.

    Attributes:
        lens: its stop may be closed, and be given blades, but no mask, after the fit.
        pairs, ghosts: those that are kept, brightest first.
        sine: of the largest angle between the axis and the light.
        wavelength_nm: range. stop_radius_mm: of the fit.
        report: what the fit measured, JSON-able.
    """

    lens: Lens
    pairs: tuple[Pair, ...]
    ghosts: tuple[GhostPolynomial, ...]
    sine: float
    wavelength_nm: tuple[float, float]
    stop_radius_mm: float
    report: dict[str, Any]

    def __post_init__(self) -> None:
        if self.lens.aperture is not None and self.lens.aperture.mask is not None:
            raise InputError("flare", "aperture", "(a mask)", "a round stop or blades: fitted ghosts take no mask")
        if not self.lens.stop_radius_mm <= 1.00001 * self.stop_radius_mm:
            expected = f"at most {self.stop_radius_mm:.6g} mm, that of the fit"
            raise InputError("flare", "stop_radius_mm", self.lens.stop_radius_mm, expected)

    @cached_property
    def _of(self) -> dict[Pair, GhostPolynomial]:
        return dict(zip(self.pairs, self.ghosts, strict=True))

    @cached_property
    def w_middle_half(self) -> tuple[float, float]:
        """w = (1 / lambda^2 - middle) / half, lambda in um."""
        short, long = (float(inverse_square_um(v)) for v in self.wavelength_nm)
        return (short + long) / 2, (short - long) / 2

    def start(self, rays: Floats) -> Floats:
        """Directions and places of rays [6, N] as `follow` takes them, [4, N]: rows `ENTERING` but the wavelength.

        Raises:
            InputError: rays further from the axis than the fit goes.
        """
        way = rays[2] / rays[5]
        start = np.stack([rays[3], rays[4], rays[0] - way * rays[3], rays[1] - way * rays[4]])
        widest = float(np.hypot(start[0], start[1]).max(initial=0.0))
        if not widest <= _SLACK * self.sine:
            found, most = (math.degrees(math.asin(min(v, 1.0))) for v in (widest, self.sine))
            raise InputError("light", "degrees off the axis", found, f"at most {most:.4g}, for which the model is made")
        return start

    def trace(self, rays: Floats, wavelength_nm: float) -> GhostRays:
        """Trace ghosts as `GhostTracer.trace` does."""
        return self.follow(self.start(rays), wavelength_nm)

    def sums(self, rays: Floats, wavelength_nm: float) -> NDArray[np.float64]:
        """Sum the light of fitted ghosts as `GhostTracer.sums` does; the image is traced exactly."""
        image = GhostTracer(self.lens, []).sums(rays, wavelength_nm)
        return np.concatenate([self.trace(rays, wavelength_nm).sums, image])

    def follow(
        self, start: Floats, wavelength_nm: float, *, only: Sequence[Pair] | None = None, reach: float = 1.0
    ) -> GhostRays:
        """Follow ghosts as `GhostTracer.follow` does; all rays are followed.

        Raises:
            InputError: a wavelength out of range.
        """
        some: Sequence[Pair] = self.pairs if only is None else only
        return GhostRays(np.concatenate([self.follow_each(start, [wavelength_nm], pair) for pair in some]))

    def follow_each(self, start: Floats, wavelengths_nm: Sequence[float], pair: Pair, reach: float = 1.0) -> Floats:
        """Follow ghosts as `GhostTracer.follow_each` does; it raises what `follow` raises."""
        low, high = self.wavelength_nm
        for nm in wavelengths_nm:
            if not low <= nm <= high:
                raise InputError("flare", "wavelength_nm", nm, f"from {low:g} to {high:g}, as the model is made")
        ghost, count = self._of[pair], start.shape[1]
        if count and (start[:2] == start[:2, :1]).all():
            return self._alike(ghost, start[:2, 0], start[2:], wavelengths_nm)
        radius = np.full((1, 1), self.lens.stop_radius_mm)
        rays = [np.concatenate([start, np.full((1, count), nm)]) for nm in wavelengths_nm]
        rows = [evaluate(ghost_graph(self, ghost), {"entering": r, "stop_radius_mm": radius})["arriving"] for r in rays]
        return np.stack(rows).astype(np.float32)

    def _alike(
        self, ghost: GhostPolynomial, direction: Floats, places: Floats, wavelengths_nm: Sequence[float]
    ) -> Floats:
        """Rays of one direction by compiled code, whose coefficients are numbers of the call."""
        p, (middle, half) = direction / self.sine, self.w_middle_half
        w = (inverse_square_um(np.asarray(wavelengths_nm, np.float64)) - middle) / half
        tables = np.ascontiguousarray(ghost.fixed(p.astype(np.float64), w), np.float32)
        head = [*p, *(ghost.chief_mm * p), *(1 / ghost.scale_mm), self.lens.stop_radius_mm]
        call = np.array(head, np.float32)
        given = np.ascontiguousarray(places, np.float32)
        out = np.empty((len(w), 4, given.shape[1]), np.float32)
        run, monomials, lights = self._compiled
        kinds = monomials[ghost.key], lights[self._stops(ghost)]
        run(given.shape[1], len(w), *tables.shape[1:], *kinds, *(a.ctypes.data for a in (given, call, tables, out)))
        return out

    def _stops(self, ghost: GhostPolynomial) -> tuple[bool, ...]:
        """Which crossings are with the stop."""
        return tuple(k == self._stop for k in ghost.surfaces)

    @cached_property
    def _stop(self) -> int:
        return self.lens.stop_index

    @cached_property
    def _compiled(self) -> tuple[Any, dict[Any, int], dict[Any, int]]:
        """The driver, and the number of each set of monomials and of each sort of crossings."""
        monomials = {key: n for n, key in enumerate(dict.fromkeys(ghost.key for ghost in self.ghosts))}
        lights = {key: n for n, key in enumerate(dict.fromkeys(map(self._stops, self.ghosts)))}
        text = ""
        for key, n in monomials.items():
            text += function_text(self._monomial_graph(key), f"terms_{n}", f"run_terms_{n}", "place", "term", "call")
        for stops, n in lights.items():
            text += function_text(self._light_graph(stops), f"lit_{n}", f"run_lit_{n}", "row", "light", "call")
        driver = c_source(
            "flare/ghostmodel.c",
            TERMS=", ".join(f"run_terms_{n}" for n in monomials.values()),
            LIGHTS=", ".join(f"run_lit_{n}" for n in lights.values()),
            MOST=max(4, *map(len, monomials)),  # a ray's four results have their places there, too
            ROWS=2 + max(2 * len(stops) + 3 for stops in lights),
        )
        run = load_compiled(f"#include <stddef.h>\n{text}{driver}").ghosts
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        run.argtypes, run.restype = [ctypes.c_size_t, *[whole] * 5, *[pointer] * 4], None
        return run, monomials, lights

    def _light_graph(self, stops: Sequence[bool]) -> Graph:
        """Input `row`, the place (mm) and what the rows of a table give, and the numbers of `_CALL`; output `light`."""
        g, rows = Graph(), 2 * len(stops) + 3
        row, call = g.input("row", 2 + rows), g.input("call", _CALL, per_call=True)
        u = (row[0:2] - call[2:4]) * call[4:6]
        g.outputs["light"] = self._light(stops, call[0:2], u, row[2:], call[6])
        return g

    def _monomial_graph(self, exponents: Sequence[tuple[int, ...]]) -> Graph:
        """Input `place` (mm) and the numbers of `_CALL`; output `term`, monomials of sigma and tau (of u_x and u_y)."""
        g, count = Graph(), len(exponents)
        place, call = g.input("place", 2), g.input("call", _CALL, per_call=True)
        u = (place - call[2:4]) * call[4:6]
        both = u if self.lens.anamorphic else g.concat(g.dot(call[0:2], u), g.square(u))
        g.outputs["term"] = g.polynomial(np.array(exponents, np.int64), np.eye(count), both)
        return g

    def _light(self, stops: Sequence[bool], p: Value, u: Value, rows: Value, stop_radius: Value) -> Value:
        """Rows `LIGHT` of the rows of a table; `stops`: which of the crossings are with the stop."""
        g, pairs = rows.graph, [rows[k : k + 2] for k in range(0, 2 + 2 * len(stops), 2)]
        film, *crossings = pairs if self.lens.anamorphic else (a[0] * p + a[1] * u for a in pairs)
        worst = g.square(u)
        for crossing, at_stop in zip(crossings, stops, strict=True):
            if not at_stop:
                ratio = g.square(crossing)
            elif self.lens.aperture is None:
                per_radius = self.stop_radius_mm / stop_radius
                ratio = g.square(crossing) * (per_radius * per_radius)
            else:
                ratio = self.lens.aperture.rim(g, crossing * self.stop_radius_mm, stop_radius, LOST)
            worst = worst.maximum(ratio)
        worst = g.select(g.square(u) <= _FITTED, worst, LOST)
        power = rows[rows.rows - 1].maximum(0.0)
        return g.concat(film, g.select(worst <= 1.0, power, 0.0), worst)


def ghost_graph(model: GhostModel, ghost: GhostPolynomial, g: Graph | None = None, output: str = "arriving") -> Graph:
    """One ghost as a graph: inputs `rays` [5] (`RAYS`) and, of the call, `stop_radius_mm`; output rows `ARRIVING`."""
    g = g or Graph()
    rays, radius = g.input("entering", 5), g.input("stop_radius_mm", per_call=True)
    p = rays[0:2] * (1 / model.sine)
    u = (rays[2:4] - p * ghost.chief_mm) * (1 / ghost.scale_mm)
    planes = g.concat(p, u)
    middle, half = model.w_middle_half
    v = (1000 / math.sqrt(half)) / rays[4]
    w = g.quadratic(v, [((0, 0),)], [-middle / half])
    variables = g.concat(planes if model.lens.anamorphic else g.quadratic(planes, ROUND), w)
    stops = [k == model.lens.stop_index for k in ghost.surfaces]
    rows = g.polynomial(ghost.exponents, ghost.table, variables)
    g.outputs[output] = model._light(stops, p, u, rows, radius)
    return g
