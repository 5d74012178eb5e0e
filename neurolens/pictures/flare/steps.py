"""The surfaces of a lens as compiled steps, by which ghosts and photons are traced.

Light always travels towards -z here: the frame is mirrored (z reversed) while light goes to the film. So one step, the
tracer's (`optics.trace.surfaces`), serves both directions. The figure of a surface and its media are numbers of the
call, so that all surfaces of one kind share a function, which is compiled once. Fresnel's reflectance is written
without the difference of nearly equal roots, which float32 would lose where glasses are cemented. The reflectance of a
coating is a polynomial in the cosine on the side of the lower index, fitted to its transfer matrices at one wavelength.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
from collections.abc import Iterable, Mapping
from functools import lru_cache, reduce
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pose import UPRIGHT, FilmPose
from neurolens.graph.c import Signature, write_c
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.graph.ir import Graph, Value
from neurolens.graph.scalars import lower
from neurolens.optics.lens import glass
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import Lens, same_medium
from neurolens.optics.trace.arithmetic import TINY, Graphs
from neurolens.optics.trace.films import Layers, reflectance
from neurolens.optics.trace.shapes import Centred, Curve, traced_curve
from neurolens.optics.trace.surfaces import Medium, Rays, meet, normal_at, radius2, reflect, refract
from neurolens.optics.trace.tracegraph import transmitted
from neurolens.optics.trace.transmission import path_mm
from neurolens.pictures.flare.canvas import LOST

Action = Literal["T", "R"]
STATE = 8  # rows of a ray: x, y, z (mm, this step's frame), direction, power, `worst` (largest r^2 / R^2 at a rim)
CALL = ("shift_mm", "curvature", "per_rim2", "n_before", "n_after", "n_step", "absorbed_per_mm")
DEGREE = 10  # the degree of a coating's reflectance
FILM = 12  # numbers of a film: see `film_numbers`
CURVE = ("stretch", "start_c", "start_cz", "last_step_mm")  # see `shapes.Curve`; `across` and the terms follow
ACROSS = 3
PLAIN = len(CALL) + DEGREE + 1  # how many numbers of the call a sphere takes
# Actions: refract light that travels to the film (0) or back (1), reflect such light (2, 3); with the light's sense
# before.
ACTIONS: tuple[tuple[Action, int], ...] = (("T", 1), ("T", -1), ("R", 1), ("R", -1))
Place = tuple[int, int]  # surface and action
_UNIT = Medium(1.0, 1.0, 1.0)  # not air, for behind it there may be total reflection
_FAINT = 2e-4  # ghosts of a smaller reflectance are not seen
_ASLANT = 0.0, 0.1, 0.2, 0.3  # 1 - cosine of angles at which light meets surfaces
_MASKS: dict[str, FloatArray] = {}  # masks of stops, which compiled code points to as long as it is loaded


class Shape(NamedTuple):
    """What a compiled function knows about a `shapes.Curve`, whose numbers are passed with each call."""

    terms: int = 0
    even: bool = True
    # whether the terms are powers about a centre, and whether these are written in Chebyshev's polynomials
    centred: bool | None = None
    steps: int = 0
    bent: tuple[bool, bool] = (True, True)
    crossed: bool = False
    turned: bool = False


class Kind(NamedTuple):
    """What one function of the compiled code does; steps of equal kind share the function.

    Attributes:
        action: "T" refracts, "R" reflects.
        shape: None for spheres and planes.
        bends: whether the media differ. coated: whether the reflectance is a polynomial, whose numbers are the call's.
        absorbs: whether the medium before the surface absorbs light.
        aperture: the shape of the stop's opening, which is tested at this surface; None is round.
    """

    action: Action
    shape: Shape | None = None
    bends: bool = True
    coated: bool = False
    absorbs: bool = False
    aperture: Aperture | None = None


def step_graph(kind: Kind) -> Graph:
    """Write the graph of one step: its input `state` [8] becomes the output `after` [8], in the frame of the next step.

    The input `call` holds `CALL`, then the coefficients of a coating's reflectance, lowest first, then `CURVE` and the
    terms of the polynomial (`_terms`), as many as the shape has.
    """
    g, shape = Graph(), kind.shape
    o = Graphs(g, finite=True)  # films average over all rays, also over lost ones, which have no power
    count = PLAIN + (0 if shape is None else len(CURVE) + ACROSS * shape.crossed + shape.terms)
    state, call = g.input("state", STATE), g.input("call", count, per_call=True)
    shift, curvature, per_rim2, n1, n2, n_step, absorbed = (call[k] for k in range(len(CALL)))
    power, worst = state[6], state[7]
    rays = Rays(state[0], state[1], state[2] + shift, state[3], state[4], state[5])
    curve = Curve(curvature, plain=True) if shape is None else _curve(shape, call)
    # Indices are relative to the medium before the surface, so that directions there are unit vectors.
    met = meet(o, rays, curve, -1, _UNIT)
    # Glass ends at the near half of a sphere.
    tests = [*met.tests, (TINY, normal_at(o, met, curvature)[2])]
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
    """Write the graph from a `state` behind the last surface to `film`: x, y (mm) on the film, power, worst.

    `call` has the film's numbers. The power is 0 where any rim stopped the ray.
    """
    g = Graph()
    state, call = g.input("state", STATE), g.input("call", FILM, per_call=True)
    start, way, worst = g.concat(state[0:2], state[2] + call[0]), state[3:6], state[7]
    facing = g.dot(call[7:10], way)
    place = start - way * (g.dot(call[7:10], start) / facing)
    arrives = (worst <= 1.0) & (facing <= -TINY)
    film = g.concat(g.dot(call[1:4], place), g.dot(call[4:7], place)) + call[10:12]
    g.outputs["film"] = g.concat(film, g.select(arrives, state[6], 0.0), worst)
    return g


def film_numbers(shift_mm: float, pose: FilmPose) -> FloatArray:
    """Return the `FILM` numbers of a film, in the mirrored frame of light towards it.

    They are its distance from the last surface along the axis, the directions of its x and y, its normal that points to
    the lens, and `moved_mm` of its pose.
    """
    x, y, away = pose.axes.T * [1.0, 1.0, -1.0]
    return np.array([shift_mm, *x, *y, *-away, *pose.moved_mm], np.float32)


def _fresnel(n1: Value, n2: Value, n_step: Value, cos_i: Value, cos_t: Value) -> Value:
    """Return (Rs + Rp) / 2 of a bare surface (Born and Wolf, 1.5.2, by a^2 - b^2 = (a - b)(a + b)).

    n_step is n2^2 - n1^2. With s = n1 c1 + n2 c2 and p = n2 c1 + n1 c2: rs = -n_step / s^2, rp = n_step (c1^2 - (n1 /
    n2)^2 (1 - c1^2)) / p^2.
    """
    s, p = n1 * cos_i + n2 * cos_t, n2 * cos_i + n1 * cos_t
    ratio, c2 = n1 / n2, cos_i * cos_i
    lack = c2 + ratio * ratio * (c2 + -1.0)
    rs, rp = n_step / (s * s), n_step * lack / (p * p)
    return (rs * rs + rp * rp) * 0.5


def _coated(g: Graph, call: Value, cos_i: Value, cos_t: Value, n_step: Value) -> Value:
    """Return a coating's reflectance: a polynomial in 1 - c with c the cosine on the side of the lower index."""
    u = 1.0 - g.select(g.constant(0.0) <= n_step, cos_i, cos_t)
    highest, *lower = (call[k] for k in range(PLAIN - 1, len(CALL) - 1, -1))
    return reduce(lambda total, coefficient: total * u + coefficient, lower, highest).maximum(0.0).minimum(1.0)


@lru_cache(maxsize=4096)  # equal for every frame, stop and tracer, and for surfaces that are coated alike
def reflectance_fit(layers: Layers, n_before: float, n_after: float, wavelength_nm: float) -> tuple[float, ...]:
    """Fit a coating's reflectance by a polynomial in 1 - c, c the cosine on the lower index's side; lowest first.

    The squares of relative errors are least at Chebyshev nodes, because ghosts live on the little that is left near
    normal incidence. Light from both sides has the same, for nothing is lost. `n_before` is on the scene's side.
    """
    c = 0.5 + 0.5 * np.cos((np.arange(64) + 0.5) * math.pi / 64)
    low, high = min(n_before, n_after), max(n_before, n_after)
    there = np.sqrt(1 - (low / high) ** 2 * (1 - c * c))
    cos_i = torch.from_numpy(c if n_before <= n_after else there)
    exact = reflectance(cos_i, n_before, n_after, layers, wavelength_nm).numpy()
    return tuple(np.polynomial.polynomial.polyfit(1 - c, exact, DEGREE, w=1 / (exact + _FAINT)).tolist())


def _curve(shape: Shape, call: Value) -> Curve:
    more = ACROSS * shape.crossed
    stretch, c, cz, last_step, *rest = (call[PLAIN + k] for k in range(len(CURVE) + more + shape.terms))
    curve = Curve(call[CALL.index("curvature")], stretch, bent=shape.bent)
    if not shape.terms and not shape.crossed:
        return curve
    other: Any = rest[1] if shape.crossed else 0.0
    start = c if shape.bent[0] else other, c if shape.bent[1] else other, cz
    terms = rest[more:]
    centred = None if shape.centred is None else Centred(terms[0], terms[1::2], terms[2::2], shape.centred)
    return curve._replace(
        terms=terms, centred=centred, even=shape.even, start=start, steps=shape.steps, last_step=last_step,
        across=(rest[0], rest[2]) if shape.crossed else (), turned=shape.turned,
    )  # fmt: skip


def curve_numbers(curve: Curve, turn: float) -> list[Any]:
    """Return the numbers `CURVE`, `across` and terms; `turn` is -1.0 for light that travels towards +z (lens frame)."""
    cx, cy, cz = curve.start or (0.0, 0.0, 0.0)
    c, other = (cx, cy) if curve.bent[0] else (cy, cx)
    across = [turn * curve.across[0], turn * other, curve.across[1]] if curve.across else []
    return [curve.stretch, turn * c, turn * cz, curve.last_step, *across, *_terms(curve, turn)]


def _terms(curve: Curve, turn: float) -> list[float]:
    """Return the numbers of a polynomial: its terms, or of a centred one the scale, then terms of its sag and slope."""
    if curve.centred is None:
        return [turn * v for v in curve.terms]
    scale, sag, slope, _ = curve.centred
    return [scale, *(turn * v for pair in zip(sag, slope, strict=True) for v in pair)]


def _sort(curve: Curve) -> tuple[bool, bool | None]:
    return curve.even, curve.centred and curve.centred.chebyshev


class Stack:
    """The steps of a set lens: the function that each surface needs, and its numbers at a wavelength.

    Args:
        lens: its film must be placed (`set_lens`).
        places: the surfaces and actions that are needed; each kind of surface takes a moment to compile.
        pose: how the film stands.

    Attributes:
        functions: [surfaces, actions] int32, the number of the compiled function, -1 where there is none.

    Raises:
        InputError: the lens has no film position, or ideal surfaces, which reflect nothing.
    """

    def __init__(self, lens: Lens, places: Iterable[Place], pose: FilmPose = UPRIGHT) -> None:
        if lens.film_z_mm is None:
            raise InputError(lens.path, "film_z_mm", None, "a focused lens (set_lens)")
        lens.require_glass("reflections, of which flare is made")
        lens.require_centred("flare")
        self.lens, self.pose = lens, pose
        # All aspheres with the same sort of terms get the degree of the highest one, so that they share a function.
        self._curves = {k: traced_curve(s, float) for k, s in enumerate(lens.surfaces) if not s.figure.plain}
        curves = self._curves.values()
        most: dict[tuple[bool, bool | None], int] = {}
        for f in curves:
            most[_sort(f)] = max(most.get(_sort(f), 0), len(_terms(f, 1.0)))
        self._terms = {k: most[_sort(f)] if f.terms else 0 for k, f in self._curves.items()}
        self.width = PLAIN + len(CURVE) + ACROSS + max(most.values(), default=0)
        kinds = {place: self.kind(*place) for place in sorted(places)}
        self._kinds = tuple(dict.fromkeys(kinds.values()))
        self.functions = np.full((len(lens.surfaces), len(ACTIONS)), -1, np.int32)
        for place, kind in kinds.items():
            self.functions[place] = self._kinds.index(kind)

    def compiled(self, driver: str, name: str, graphs: Mapping[str, Graph]) -> ctypes._NamedFuncPointer:
        """Compile a C text that calls the steps by `go` of `stack.c`, and return its function `name`.

        Args:
            driver: the text. graphs: further functions run_NAME, from rows `row` and numbers `call` to rows `event`.

        Raises:
            InputError: there is no C compiler, or it fails.
        """
        mask = self.lens.aperture.table if self.lens.aperture and self.lens.aperture.mask is not None else None
        key = "" if mask is None else hashlib.sha256(mask.tobytes()).hexdigest()
        text = "" if mask is None else c_source("pictures/flare/mask.c", MASK=key)
        for number, kind in enumerate(self._kinds):
            text += function_text(step_graph(kind), f"step_{number}", f"run_{number}", "state", "after", "call")
        text += function_text(film_graph(), "film", "run_film", "state", "film", "call")
        for called, graph in graphs.items():
            text += function_text(graph, called, f"run_{called}", "row", "event", "call")
        runs = ", ".join(f"run_{number}" for number in range(len(self._kinds)))
        head = c_source("pictures/flare/stack.c", STEPS=runs, STATE=STATE, WIDTH=self.width, ACTIONS=len(ACTIONS))
        library = load_compiled(text + head + driver)
        if mask is not None:
            kept = _MASKS.setdefault(key, mask)
            library.take_mask(ctypes.c_void_p(kept.ctypes.data), len(kept))
        call: ctypes._NamedFuncPointer = getattr(library, name)
        call.restype = None
        return call

    def kind(self, k: int, which: int) -> Kind:
        """Return what a step does at surface k by the action of this number."""
        lens, s, f = self.lens, self.lens.surfaces[k], self._curves.get(k)
        return Kind(
            ACTIONS[which][0],
            None if f is None else Shape(self._terms[k], *_sort(f), f.steps, f.bent, bool(f.across), f.turned),
            reflects(lens, k),
            bool(s.coating and s.coating.layers),
            any(t.glass or t.absorbs_as or t.absorption_per_mm for t in lens.surfaces),
            lens.aperture if s.stop else None,
        )

    @lru_cache(maxsize=256)  # noqa: B019  a few stacks are kept, which are small
    def numbers(self, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
        """Return the numbers of all steps [surfaces, actions, width], and those of the film."""
        lens, z = self.lens, [float(v) for v in self.lens.vertices_mm]
        n = [float(glass.index_of(medium, wavelength_nm)) for medium in lens.media]
        a = [0.0, *(float(glass.absorption_of(s, wavelength_nm) or 0.0) for s in lens.surfaces)]
        numbers = np.zeros((len(lens.surfaces), len(ACTIONS), self.width), np.float32)
        for k, s in enumerate(lens.surfaces):
            for which, (_, sense) in enumerate(ACTIONS):
                before, after = (k, k + 1) if sense > 0 else (k + 1, k)
                # A ray comes in the frame of the surface before; at the front and the rear in that of the surface
                # itself.
                gap = sense * (z[k] - z[k - sense]) if 0 <= k - sense < len(lens.surfaces) else 0.0
                step = (n[after] - n[before]) * (n[after] + n[before])
                row = gap, -sense * float(s.curvature), 1 / s.semi_diameter_mm**2, n[before], n[after], step, a[before]
                numbers[k, which, : len(CALL)] = row
                if k in self._curves:
                    curve = curve_numbers(self._curves[k], -sense)
                    numbers[k, which, PLAIN : PLAIN + len(curve)] = curve
                if s.coating and s.coating.layers and ACTIONS[which][0] == "R":
                    numbers[k, which, len(CALL) : PLAIN] = numbers[k, which - 2, len(CALL) : PLAIN]
                elif s.coating and s.coating.layers:
                    fit = reflectance_fit(s.coating.layers, n[k], n[k + 1], wavelength_nm)
                    numbers[k, which, len(CALL) : PLAIN] = fit
        assert lens.film_z_mm is not None
        return numbers, film_numbers(float(lens.film_z_mm) - z[len(lens.surfaces) - 1], self.pose)

    def reflectance(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the reflectances [surfaces] for light towards the film.

        Those of coatings are means over angles of incidence up to 46 degrees, for a coating that reflects nothing at
        right angles still reflects light that comes aslant.
        """
        numbers = self.numbers(wavelength_nm)[0][:, 0].astype(np.float64)
        n1, n2 = numbers[:, CALL.index("n_before")], numbers[:, CALL.index("n_after")]
        coated = [bool(s.coating and s.coating.layers) for s in self.lens.surfaces]
        aslant = [np.polynomial.polynomial.polyval(u, numbers[:, len(CALL) : PLAIN].T).clip(1e-9, 1) for u in _ASLANT]
        return np.where(coated, np.mean(aslant, axis=0), ((n1 - n2) / (n1 + n2)) ** 2)


def entering(rays: NDArray[np.floating]) -> FloatArray:
    """Return states [STATE, N] before the first surface of rays [6, N]: moved near the front vertex, and mirrored."""
    rays = np.asarray(rays, np.float64)
    if rays.ndim != 2 or rays.shape[0] != 6:
        raise InputError("flare", "rays", f"({rays.shape})", "an array [6, N]")
    point, d = rays[:3], rays[3:]
    state = np.empty((STATE, rays.shape[1]), np.float32)
    state[:3], state[3:6], state[6], state[7] = point - (point * d).sum(0) * d, d, 1, 0
    state[[2, 5]] *= -1
    return state


def reflects(lens: Lens, k: int) -> bool:
    """Return whether surface k reflects any light, because the medium changes there or it is coated."""
    coating = lens.surfaces[k].coating
    return bool(coating and coating.layers) or not same_medium(lens.surfaces, k, lens.object_medium)


def function_text(graph: Graph, name: str, run: str, inputs: str, outputs: str, numbers: str) -> str:
    """Write a graph as C text: a function `name`, and a function `run` that takes pointers to its rows.

    Args:
        inputs, outputs, numbers: what the graph's input rows, output rows and numbers of the call are named.
    """
    program = lower(graph).in_order_of_need()
    s = Signature.of(program, name)

    def places(rows: tuple[str, ...], array: str, of: str) -> list[str]:
        return [f"{array}[{row.removeprefix(of + '_') if row != of else 0}]" for row in rows]

    tables = [f"{table}, {table}_cells" for table in s.tables]
    arguments = places(s.per_ray, "in", inputs) + places(s.per_call, "call", numbers) + tables
    arguments += places(s.outputs, "out", outputs)
    head = f"static void {run}(size_t n, const float *const *in, const float *call, float *const *out)"
    text = write_c(program, name, ["A step of flare."])
    return f"{text}\n{head}\n{{\n    (void)call;\n    {name}_rays(n, {', '.join(arguments)});\n}}\n"
