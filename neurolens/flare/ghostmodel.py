"""Fitted ghosts: where light of a direction that enters at a point of the front meets the film, its power, and files.

The film point of a ghost and its crossings with the rims that stop light are vectors A p + B u, and the power is a
scalar, with A, B and the power polynomials in rho = p.p, sigma = p.u, tau = u.u and w: the form of the surrogates of
images (`surrogates.cores`) with other inputs. p is the light's direction, u the point on the plane of the front vertex
less its part that follows p. For a lens with cylinders x and y of vectors and the power are polynomials in p, u and w
themselves, of the terms that its two planes of symmetry leave. Stop and blades are tests on the crossings with the
stop, which need no new fit.

A model is stored as ONNX that any runtime evaluates, with a card and the coefficients. Inputs: entering [5, N] float32
(dx, dy of the light's unit direction towards the film; x, y in mm of its point on the plane z = 0; wavelength in nm)
and stop_radius_mm [1]. Outputs g07_03 and so on, one for each ghost, [4, N]: film x, y (mm), power, and worst, the
largest r^2 / R^2 at the rims that are tested: light arrives where it is at most 1.
"""

from __future__ import annotations

import ctypes
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import neurolens
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.tomlfile import check_tree
from neurolens.flare.ghosts import GhostRays, GhostTracer, Pair
from neurolens.flare.steps import LOST, Floats, function_text
from neurolens.graph.c import NOTHING
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Graph, Value
from neurolens.graph.onnx import write_onnx
from neurolens.graph.program import ARRIVING, ENTERING
from neurolens.graph.scalars import lower
from neurolens.lens.glass import inverse_square_um
from neurolens.lens.prescription import Lens
from neurolens.surrogates.card import CARD_KEY, MODEL_KEY, card_in, card_to_json, read_metadata
from neurolens.surrogates.file import damage_said, deflated, inflated, pack, packed_lens, unpack, unpacked_lens
from neurolens.surrogates.lightfield import ROUND
from neurolens.surrogates.source import WRITERS, identifier

Array = NDArray[np.float64]
KIND, SCHEMA = "neurolens.ghost_model", 1
_CALL = 7  # numbers of the call: p, chief p (mm), 1 / scale, the stop's radius
_FITTED = 1.5  # of u^2: beyond it polynomials mean nothing
_SLACK = 1.02  # of the largest angle: rays of a near light differ
_FRAME = "Lens frame: z along the optical axis towards the film, front vertex at z = 0, x right and y up from behind."
_REFERENCE = 5  # rays in the card that coefficients are checked with
_OFF = 1e-4  # of reference values, relative and in mm: coefficients are rounded to float32
_MOST = 4096  # ghosts of a file


@dataclass(frozen=True, eq=False)
class GhostPolynomial:
    """The polynomials of one ghost.

    Attributes:
        chief_mm, scale_mm: [2] for x and y: u = (point - chief_mm p) / scale_mm for points [2] in mm on the plane
            z = 0. The ghost's light has |u| below 1.
        surfaces: for each crossing, the surface whose rim is its unit.
        exponents: [M, 4] of rho, sigma, tau, w; of a lens with cylinders [M, 5] of p_x, p_y, u_x, u_y, w.
        ab: [1 + K, 2, M] coefficients of A and B, with cylinders of x and y, of the film point (mm) and K crossings.
        power: [M] coefficients of the power.
    """

    chief_mm: Array
    scale_mm: Array
    surfaces: tuple[int, ...]
    exponents: Exponents
    ab: Array
    power: Array

    @cached_property
    def table(self) -> Array:
        """All coefficients [2 (1 + K) + 1, M]: A and B of each vector, then the power."""
        return np.concatenate([self.ab.reshape(-1, len(self.power)), self.power[None]])

    @cached_property
    def places(self) -> tuple[Exponents, Exponents]:
        """The exponents [L, 2] of sigma and tau (of u_x and u_y) that occur, and which of them each term has, [M]."""
        rest, place = np.unique(self.exponents[:, -3:-1], axis=0, return_inverse=True)
        return rest, place.reshape(-1).astype(np.int64)

    @cached_property
    def _grouped(self) -> tuple[Exponents, Exponents, Exponents]:
        """Terms grouped by their place and their power of w: the order that has the terms of a group side by side,
        where each group begins, and its number, which is L times the power plus the place."""
        number = self.exponents[:, -1] * len(self.places[0]) + self.places[1]
        order = np.argsort(number, kind="stable")
        numbers, first = np.unique(number[order], return_index=True)
        return order.astype(np.int64), first.astype(np.int64), numbers

    def fixed(self, p: Array, w: Array) -> Array:
        """The coefficients [W, rows, L] of the monomials of `places` for one direction and wavelengths [W]."""
        order, first, numbers = self._grouped
        of_p, powers, direction = self.exponents[:, :-3], 1 + int(self.exponents[:, -1].max()), np.ones(len(self.power))
        for value, power in zip(p if of_p.shape[1] == 2 else [p @ p], of_p.T, strict=True):
            direction *= (value ** np.arange(1 + power.max()))[power]
        sums = np.zeros((len(self.table), powers * len(self.places[0])))
        sums[:, numbers] = np.add.reduceat((self.table * direction)[:, order], first, axis=1)
        of_w = w[:, None] ** np.arange(powers)
        return (of_w @ sums.reshape(len(sums), powers, -1)).swapaxes(0, 1)

    @cached_property
    def key(self) -> tuple[tuple[int, ...], ...]:
        """The exponents of `places` in a form that can be hashed."""
        return tuple(map(tuple, self.places[0].tolist()))


@dataclass(frozen=True, eq=False)
class GhostModel:
    """Surrogates of the ghosts of a set lens: a `GhostSource`, as `GhostTracer` is.

    Attributes:
        lens: its stop may be closed, and be given blades, but no mask, after the fit.
        pairs, ghosts: the ghosts that the fit kept, brightest first.
        sine: of the largest angle between the axis and the light.
        wavelength_nm: range of the fit. stop_radius_mm: its stop.
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
        """The numbers in w = (1 / lambda^2 - middle) / half, with lambda in um."""
        short, long = (float(inverse_square_um(v)) for v in self.wavelength_nm)
        return (short + long) / 2, (short - long) / 2

    def start(self, rays: Floats) -> Floats:
        """Directions and points of rays [6, N] as `follow` takes them, [4, N]: rows `ENTERING` but the wavelength.

        Raises:
            InputError: rays are further from the axis than those of the fit.
        """
        way = rays[2] / rays[5]
        start = np.stack([rays[3], rays[4], rays[0] - way * rays[3], rays[1] - way * rays[4]])
        widest = float(np.hypot(start[0], start[1]).max(initial=0.0))
        if not widest <= _SLACK * self.sine:
            angle, most = (math.degrees(math.asin(min(v, 1.0))) for v in (widest, self.sine))
            raise InputError("light", "degrees off the axis", angle, f"at most {most:.4g}, for which the model is made")
        return start

    def trace(self, rays: Floats, wavelength_nm: float) -> GhostRays:
        """Trace ghosts as `GhostTracer.trace` does."""
        return self.follow(self.start(rays), wavelength_nm)

    def sums(self, rays: Floats, wavelength_nm: float) -> Array:
        """Sum the light of fitted ghosts as `GhostTracer.sums` does; the image is traced exactly."""
        image = GhostTracer(self.lens, []).sums(rays, wavelength_nm)
        return np.concatenate([self.trace(rays, wavelength_nm).sums, image])

    def follow(
        self, start: Floats, wavelength_nm: float, *, only: Sequence[Pair] | None = None, reach: float = 1.0
    ) -> GhostRays:
        """Follow ghosts as `GhostTracer.follow` does; all rays are followed.

        Raises:
            InputError: the wavelength is out of range.
        """
        some: Sequence[Pair] = self.pairs if only is None else only
        return GhostRays(np.concatenate([self.follow_each(start, [wavelength_nm], pair) for pair in some]))

    def follow_each(self, start: Floats, wavelengths_nm: Sequence[float], pair: Pair, reach: float = 1.0) -> Floats:
        """Follow a ghost as `GhostTracer.follow_each` does; raises InputError as `follow`."""
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
        """Rays of one direction, by compiled code, whose coefficients are numbers of the call."""
        p, (middle, half) = direction / self.sine, self.w_middle_half
        w = (inverse_square_um(np.asarray(wavelengths_nm, np.float64)) - middle) / half
        tables = np.ascontiguousarray(ghost.fixed(p.astype(np.float64), w), np.float32)
        head = [*p, *(ghost.chief_mm * p), *(1 / ghost.scale_mm), self.lens.stop_radius_mm]
        call = np.array(head, np.float32)
        places = np.ascontiguousarray(places, np.float32)
        out = np.empty((len(w), 4, places.shape[1]), np.float32)
        run, monomials, lights = self._compiled
        kinds = monomials[ghost.key], lights[self._stops(ghost)]
        run(places.shape[1], len(w), *tables.shape[1:], *kinds, *(a.ctypes.data for a in (places, call, tables, out)))
        return out

    def _stops(self, ghost: GhostPolynomial) -> tuple[bool, ...]:
        """Which crossings are with the stop."""
        stop = self.lens.stop_index
        return tuple(k == stop for k in ghost.surfaces)

    @cached_property
    def _compiled(self) -> tuple[Any, dict[Any, int], dict[Any, int]]:
        """The compiled function, and the numbers of the sets of monomials and of the sorts of crossings."""
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
            MOST=max(4, *map(len, monomials)),  # also room for a ray's four results
            ROWS=2 + max(2 * len(stops) + 3 for stops in lights),
        )
        run = load_compiled(f"#include <stddef.h>\n{text}{driver}").ghosts
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        run.argtypes, run.restype = [ctypes.c_size_t, *[whole] * 5, *[pointer] * 4], None
        return run, monomials, lights

    def _light_graph(self, stops: Sequence[bool]) -> Graph:
        """The graph from `row`, the point (mm) and the sums of a table's rows, and the numbers `call` to `light`."""
        g, rows = Graph(), 2 * len(stops) + 3
        row, call = g.input("row", 2 + rows), g.input("call", _CALL, per_call=True)
        u = (row[0:2] - call[2:4]) * call[4:6]
        g.outputs["light"] = self._light(stops, call[0:2], u, row[2:], call[6])
        return g

    def _monomial_graph(self, exponents: Sequence[tuple[int, ...]]) -> Graph:
        """The graph from `place` (mm) and the numbers `call` to `term`, monomials of sigma and tau (of u_x and u_y)."""
        g, count = Graph(), len(exponents)
        place, call = g.input("place", 2), g.input("call", _CALL, per_call=True)
        u = (place - call[2:4]) * call[4:6]
        both = u if self.lens.anamorphic else g.concat(g.dot(call[0:2], u), g.square(u))
        g.outputs["term"] = g.polynomial(np.array(exponents, np.int64), np.eye(count), both)
        return g

    def _light(self, stops: Sequence[bool], p: Value, u: Value, rows: Value, stop_radius: Value) -> Value:
        """The rows `ARRIVING` from the sums of a table's rows; `stops`: which of the crossings are with the stop."""
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
    """One ghost as a graph: from `entering` [5] (`ENTERING`) and, of the call, `stop_radius_mm` to rows `ARRIVING`."""
    g = g or Graph()
    rays, radius = g.input("entering", 5), g.input("stop_radius_mm", per_call=True)
    p = rays[0:2] * (1 / model.sine)
    u = (rays[2:4] - p * ghost.chief_mm) * (1 / ghost.scale_mm)
    planes = g.concat(p, u)
    middle, half = model.w_middle_half
    v = (1000 / math.sqrt(half)) / rays[4]
    w = g.quadratic(v, [((0, 0),)], [-middle / half])
    variables = g.concat(planes if model.lens.anamorphic else g.quadratic(planes, ROUND), w)
    rows = g.polynomial(ghost.exponents, ghost.table, variables)
    g.outputs[output] = model._light(model._stops(ghost), p, u, rows, radius)
    return g


def whole_graph(model: GhostModel) -> Graph:
    """All ghosts as one graph, that of the file."""
    g = Graph()
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        ghost_graph(model, ghost, g, output_of(pair))
    return g


def output_of(pair: Pair) -> str:
    """The name of a ghost's output."""
    return pair.name.replace("-", "_")


def write_ghosts(model: GhostModel, path: str | Path) -> Path:
    """Write a model as ONNX; the stop of the graph is round.

    Raises:
        InputError: numbers that float32 cannot hold.
    """
    from neurolens.surrogates.export import write_file

    rows = []
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        numbers = [list(values) for values in (ghost.chief_mm, ghost.scale_mm, ghost.surfaces)]
        rows.append([*pair, *numbers, *map(pack, (ghost.exponents, ghost.ab, ghost.power))])
    card = {
        "kind": KIND,
        "schema": SCHEMA,
        "lens": {**model.lens.identity, "stop_radius_mm": model.stop_radius_mm},
        "frame": _FRAME,
        "rays": ENTERING,
        "outputs": {output_of(pair): ARRIVING for pair in model.pairs},
        "domain": {"sine": model.sine, "wavelength_nm": model.wavelength_nm},
        "fit": model.report,
        "reference": _reference(model),
        "versions": {"neurolens": neurolens.__version__, "numpy": np.__version__},
    }
    coefficients = deflated({"schema": SCHEMA, "lens": packed_lens(model.lens), "ghosts": rows})
    return write_file(path, write_onnx(whole_graph(model), {CARD_KEY: card_to_json(card), MODEL_KEY: coefficients}))


def write_ghost_source(model: GhostModel, path: str | Path) -> Path:
    """Write a model as source code, one function a ghost: C99 to a name that ends in .h, else GLSL.

    Raises:
        InputError: numbers that float32 cannot hold.
    """
    write = WRITERS["c" if Path(path).suffix == ".h" else "glsl"]
    own, parts = identifier(model.lens.lens_id), []
    comment = [
        f"Ghosts of {model.lens.name}, written by neurolens {neurolens.__version__}.", _FRAME,
        f"Given {', '.join(ENTERING)}: the light's direction towards the film, and its point on the plane z = 0.",
        f"Gives {', '.join(ARRIVING)}: light arrives where worst, the largest r^2 / R^2 at rims, is at most 1.",
        f"Directions up to {model.sine:.4g} for sqrt(dx^2 + dy^2), wavelengths {model.wavelength_nm} nm, stop radii up "
        f"to {model.stop_radius_mm:.6g} mm.",
    ]  # fmt: skip
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        parts.append(write(lower(ghost_graph(model, ghost)), f"{own}_{output_of(pair)}", comment, NOTHING))
    atomic_write_text(Path(path), "\n".join(parts))
    return Path(path)


def read_ghosts(path: str | Path) -> GhostModel:
    """The model of a file, with its coefficients rounded to float32.

    Raises:
        ModelError: the file is missing, too large, no model of ghosts, or damaged.
    """
    metadata = read_metadata(path)
    card = card_in(path, metadata, KIND)
    with damage_said(path):
        data = json.loads(inflated(metadata[MODEL_KEY]))
        check_tree(data, "coefficients")
        if data["schema"] != SCHEMA or len(data["ghosts"]) > _MOST:
            raise ValueError(f"schema {data['schema']!r}, {len(data['ghosts'])} ghosts")
        low, high = map(float, card["domain"]["wavelength_nm"])
        lens = unpacked_lens(data["lens"])
        model = GhostModel(
            lens,
            tuple(Pair(int(first), int(second)) for first, second, *_ in data["ghosts"]),
            tuple(_ghost(5 if lens.anamorphic else 4, *row[2:]) for row in data["ghosts"]),
            float(card["domain"]["sine"]),
            (low, high),
            float(card["lens"]["stop_radius_mm"]),
            dict(card["fit"]),
        )
        if not (0 < low < high < math.inf and 0 < model.sine <= 1) or model.lens.sha256 != card["lens"]["sha256"]:
            raise ValueError("its domain or prescription is not that of its card")
        for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
            reference = card["reference"][output_of(pair)]
            rays = np.array(reference["rays"], np.float64).reshape(5, _REFERENCE)
            if not np.allclose(_light(model, ghost, rays), reference["light"], rtol=_OFF, atol=_OFF):
                raise ValueError("its coefficients do not give the reference rays of its card")
    return model


def _ghost(
    variables: int, chief: Any, scale: Any, surfaces: Any, exponents: Any, ab: Any, power: Any
) -> GhostPolynomial:
    middle, size = (np.array(v, np.float64).reshape(2) for v in (chief, scale))
    ghost = GhostPolynomial(middle, size, tuple(map(int, surfaces)), unpack(exponents), unpack(ab), unpack(power))
    terms = len(ghost.exponents)
    if ghost.exponents.shape != (terms, variables) or ghost.ab.shape != (1 + len(ghost.surfaces), 2, terms):
        raise ValueError(f"tables of {ghost.exponents.shape}, {ghost.ab.shape}")
    if ghost.power.shape != (terms,) or not (ghost.scale_mm > 0).all():
        raise ValueError(f"tables of {ghost.power.shape}, scale {ghost.scale_mm}")
    return ghost


def _reference(model: GhostModel) -> dict[str, Any]:
    """Rays near the middle of each ghost's light, and the light on the film that they become."""
    share, reference = np.linspace(0, 0.5, _REFERENCE), {}
    for pair, ghost in zip(model.pairs, model.ghosts, strict=True):
        p = np.stack([share, -0.5 * share])
        place = ghost.chief_mm[:, None] * p + ghost.scale_mm[:, None] * np.stack([0.3 * share, 0.1 * share])
        rays = np.stack([*(model.sine * p), *place, np.linspace(*model.wavelength_nm, _REFERENCE)])
        rays = rays.astype(np.float32).astype(np.float64)
        reference[output_of(pair)] = {"rays": rays.tolist(), "light": _light(model, ghost, rays).tolist()}
    return reference


def _light(model: GhostModel, ghost: GhostPolynomial, rays: Array) -> Array:
    radius = np.full((1, 1), model.stop_radius_mm)
    return np.asarray(evaluate(ghost_graph(model, ghost), {"entering": rays, "stop_radius_mm": radius})["arriving"])
