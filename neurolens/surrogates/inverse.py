"""Inverse maps of a surrogate: the camera ray through a point of the stop, and the camera ray of a given scene ray.

A direct fit of the inverse map gives the first guess. Newton's method with the model's Jacobian, limited so that it
never diverges, takes it to the model's own ray to rounding. The model itself says whether that ray passes, so that both
directions agree. Hanika and Dachsbacher 2014 introduced the iteration on the stop for polynomial lenses.

Each map is one graph: the guess, the steps written out, the model itself at the solution. It is evaluated on torch
tensors, or exported: in onnxruntime one call takes 5 to 8 (stop) and 7 to 14 (scene) times that of the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Exponents, Graph, Value, pruned
from neurolens.graph.program import RAY
from neurolens.surrogates.assemble import (
    EXACT,
    DirectionSeries,
    Form,
    add_outputs,
    light_field,
    model_graph,
    units_of,
    wavelength_row,
    within_domain,
)  # fmt: skip
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, CoreValues, Field, Refracted, Units
from neurolens.surrogates.file import pack, unpack
from neurolens.surrogates.lightfield import MIRROR, ROUND, Encoding
from neurolens.surrogates.model import LensModel, Prediction, prediction_of
from neurolens.trace.surfaces import front_rays

if TYPE_CHECKING:
    from torch import Tensor

    from neurolens.surrogates.domain import FilmRays
    from neurolens.trace.surfaces import Rays

Array = NDArray[np.float64]

STEPS = 3
# A solution counts where its residual is below this: of the stop's radius; of the front's radius and in radians.
TOLERANCE = 1e-4
# Longest Newton step: of the radius of the pupil (and of the film).
LIMIT = 0.35


@dataclass(frozen=True, eq=False)
class Guess:
    """First guess of an inverse map: K vectors from two vectors a and b.

    The inverse of an equivariant map is equivariant, so it has the same form as the map itself: A a + B b with A and B
    polynomials in a.a, a.b, b.b, w (or the invariants of two mirrors) and one more variable z.

    Attributes:
        exponents: [M, 5 or 8] int64: the invariants of `LightField`, w, then z.
        ab: [K, 2, 1 or 2, M]: A and B of each vector, for both components or for x and y by themselves.
    """

    exponents: Exponents
    ab: Array

    @property
    def coefficients(self) -> int:
        return int((self.ab != 0).sum())

    def packed(self) -> dict[str, Any]:
        """The guess as its file holds it, in float32."""
        return {"exponents": pack(self.exponents), "ab": pack(self.ab)}

    @staticmethod
    def unpacked(packed: Mapping[str, Any]) -> Guess:
        """The inverse of `packed`. Raises ValueError, KeyError, TypeError: a damaged one."""
        return Guess(unpack(packed["exponents"]), unpack(packed["ab"]))

    def build(self, g: Graph, light: Field, z: Value | None) -> list[Value]:
        """The vectors, 2 rows each, of a and b, the p and u of `light`; z None: it is 0."""
        wide, last = self.ab.shape[2], self.exponents.shape[1] - 1
        variables = [v for v in range(last) if v < last - 1 or light.dispersive]
        x = light.products(MIRROR if wide == 2 else ROUND)
        if z is not None:
            variables, x = [*variables, last], g.concat(x, z)
        used = ~self.exponents[:, [v for v in range(last + 1) if v not in variables]].any(1)
        rows = g.polynomial(self.exponents[used][:, variables], self.ab.reshape(-1, len(self.exponents))[:, used], x)
        parts = g.split(rows, [wide] * (2 * len(self.ab)))
        return [a * light.p + b * light.u for a, b in zip(parts[::2], parts[1::2], strict=True)]


class InverseRays(NamedTuple):
    """Camera rays that cross the stop in given points, or leave as given scene rays, [N].

    Attributes:
        rays: with the pupil points found (of scene rays, the film points too).
        prediction: of the model for those rays. Its status is that of `neurolens.base.status`, NO_SOLUTION among them.
        density: for stop points |d stop / d pupil|, area on the stop per area on the pupil plane, the film point held:
            a stop point drawn with density q per mm^2 is a pupil point drawn with density q times this. For scene rays
            |d (film, pupil) / d (position, direction)|, mm^2 on the film times mm^2 on the pupil plane, per mm^2 of
            (x, y) on the front surface and steradian.
        residual: distance from the given stop point, in stop radii; from the given scene ray, in front radii and in
            radians (root of the summed squares).
    """

    rays: FilmRays
    prediction: Prediction
    density: Tensor
    residual: Tensor


@dataclass(frozen=True, eq=False)
class InverseModel:
    """Both inverse maps of one model; see `inverse_fit.fit_inverse`.

    Attributes:
        stop: from the film point (in film radii) and the stop point (in stop radii) to the pupil point, centred and
            scaled as the model's.
        scene: from position and direction vector, scaled as the model's, to u and p.
        report: JSON-able: how it was fitted.
    """

    model: LensModel
    stop: Guess
    scene: Guess
    report: dict[str, Any] = field(default_factory=dict)

    def through_stop(
        self,
        film_x: Tensor,
        film_y: Tensor,
        film_z: Tensor,
        stop_x: Tensor,
        stop_y: Tensor,
        wavelength_nm: Tensor,
        steps: int = STEPS,
        start: Tensor | None = None,
    ) -> InverseRays:
        """The rays from film points through stop points; all [N], mm and nm, in the dtype of the inputs.

        Args:
            start: [2, N] in place of the first guess: pupil points, centred and scaled as the model's.
        """
        import torch

        inputs = {"stop_rays": torch.stack([film_x, film_y, stop_x, stop_y, wavelength_nm])}
        return self._solved("stop", inputs if start is None else inputs | {"start": start}, film_z, steps)

    def from_scene(self, scene: Rays, film_z: Tensor, wavelength_nm: Tensor, steps: int = STEPS) -> InverseRays:
        """The camera rays of light that comes along scene rays; all [N], in the dtype of the inputs.

        Args:
            scene: a point of the ray (mm, lens frame) before or on the front surface, and the unit direction of the
                camera ray: away from the lens, against the light. Light from a scene point S through a point X of the
                front surface has direction (S - X) / |S - X|.
            film_z: the film planes, mm.
        """
        import torch

        *lines, wavelength = (c.detach().double().numpy() for c in (*scene, wavelength_nm))
        rays_at_front = front_rays(self.model.front, *lines, index=front_index(self.model), wavelength_nm=wavelength)
        front, solid = (torch.from_numpy(a).to(film_z.dtype) for a in rays_at_front)
        out = self._solved("scene", {"front_rays": torch.cat([front, wavelength_nm[None]])}, film_z, steps)
        return out._replace(density=out.density / solid)

    def _solved(self, name: str, inputs: dict[str, Tensor], film_z: Tensor, steps: int) -> InverseRays:
        import torch

        from neurolens.surrogates.domain import FilmRays

        radius = film_z.new_full((1, 1), self.model.domain.stop_radius_mm)
        graph = _exact_graph(self, name, steps, "start" in inputs)
        out = evaluate(graph, {**inputs, "film_z_mm": film_z[None], "stop_radius_mm": radius})
        film_x, film_y, pupil_x, pupil_y, wavelength = out["rays"]
        rays = FilmRays(film_x, film_y, film_z, pupil_x, pupil_y, wavelength)
        density, residual = (out[n].expand(1, len(rays))[0] for n in ("density", "residual"))
        residual = torch.where(torch.isfinite(residual), residual, torch.inf)
        return InverseRays(rays, prediction_of(out, len(rays)), density, residual)


def front_index(model: LensModel) -> list[float] | None:
    """Power series in 1 / lambda^2 (1/um^2) of the front glass's index, where direction vectors are those inside it."""
    if not isinstance(model.core, Refracted):
        return None
    e, series = model.encoding, np.polynomial.Polynomial(model.core.index)
    w = np.polynomial.Polynomial([-e.w_middle / e.w_half, 1 / e.w_half] if e.w_half else [0.0])
    return [float(a) for a in series(w).coef]


@lru_cache(maxsize=16)
def _exact_graph(inverse: InverseModel, name: str, steps: int, start: bool) -> Graph:
    if name == "stop":
        return stop_graph(inverse.model, inverse.stop, EXACT, steps, start)
    return scene_graph(inverse.model, inverse.scene, EXACT, steps)


def stop_system(model: LensModel) -> Graph:
    """Where the ray through a pupil point crosses the stop, less the point asked for, in stop radii.

    Inputs `unknown`: the pupil point, centred on the chief ray through the film point and scaled as the model's u;
    `film` (mm), `wanted` (stop point, in stop radii), `wavelength_nm`, `film_z_mm`. Output `residual`.
    """
    g = Graph()
    unknown, film, wanted, wavelength = (
        g.input(name, rows) for name, rows in (("unknown", 2), ("film", 2), ("wanted", 2), ("wavelength_nm", 1))
    )
    rays = _pupil_rays(model.encoding, film, unknown, wavelength)
    light = light_field(g, model.encoding, rays, g.input("film_z_mm", per_call=True))
    g.outputs["residual"] = model.core.build(g, light, Units()).vectors[STOP] - wanted
    return g


def _pupil_rays(e: Encoding, film: Value, u: Value, wavelength: Value) -> Value:
    g = film.graph
    return g.concat(film, g.affine(np.diag(e.pupil_scales_mm), u, added=film * e.chiefs), wavelength)


def scene_system(model: LensModel) -> Graph:
    """Position and direction vector of the ray of u and p, less those asked for, scaled as the model's.

    Inputs `unknown`: u, then p: directions follow p most and positions u, and the solver wants that order; `wanted`,
    `wavelength_nm`. Output `residual`.

    Raises:
        InputError: a core that gives no direction vector.
    """
    g, e = Graph(), model.encoding
    unknown, wanted = g.input("unknown", 4), g.input("wanted", 4)
    light = _light(e, [unknown[2:4], unknown[0:2]], g.input("wavelength_nm"))
    values = model.core.build(g, light, Units())
    if values.unit is not None:
        raise InputError(model.method, "inverse", type(model.core).__name__, "a core of direction vectors")
    g.outputs["residual"] = g.concat(values.vectors[POSITION], values.vectors[DIRECTION]) - wanted
    return g


def _light(e: Encoding, vectors: list[Value], wavelength: Value) -> Field:
    """A light field whose p and u are these."""
    g = wavelength.graph
    if not e.w_half:
        return Field(g.concat(*vectors))
    return Field(g.concat(*vectors, wavelength_row(e, wavelength)), -e.w_middle / e.w_half)


def stop_graph(model: LensModel, guess: Guess, form: Form, steps: int = STEPS, start: bool = False) -> Graph:
    """The map from stop points to camera rays.

    Inputs stop_rays (film x, y, stop x, y in mm, wavelength in nm), film_z_mm, stop_radius_mm; `start`: another one of
    that name in place of the guess. Outputs rays (film x, y, pupil x, y, wavelength), density, those of the model, and
    where the form is exact `residual`. An exact graph gives the best point that was seen, any other that of the last
    step, which saves one evaluation.
    """
    e, g = model.encoding, Graph()
    film, stop, wavelength = g.split(g.input("stop_rays", 5), [2, 2, 1])
    wanted = stop * (1 / model.scales.stop_mm)
    inputs = {"film": film, "wanted": wanted, "wavelength_nm": wavelength}
    if start:
        first = g.input("start", 2)
    else:
        z = scaled_film_z(model, g.input("film_z_mm", per_call=True))
        (first,) = guess.build(g, _light(e, [film * (1 / e.film_scale_mm), wanted], wavelength), z)
    system = stop_system(model)
    u, size = _solve(system, inputs, first, steps, form)
    rays = _pupil_rays(e, film, u, wavelength)
    judge = with_derivatives(model_graph(model, form), ["stop_xy_mm"], [("rays", 2), ("rays", 3)])
    out = g.inline(judge, {"rays": rays})
    area = determinant([out.pop(derivative("stop_xy_mm", row)) for row in RAY[2:]]).abs()
    off = out["stop_xy_mm"] * (1 / model.scales.stop_mm) - wanted
    (status,) = g.inputs_of(out.pop("status").number)  # before it is made whole
    return _finished(g, rays, out, area, status, size or g.square(off), form)


def scene_graph(model: LensModel, guess: Guess, form: Form, steps: int = STEPS) -> Graph:
    """The map from scene rays to camera rays: as `stop_graph`, but for its input and what density is of.

    Input front_rays: x and y on the front surface (mm), direction vector of the model (angle vector in rad, or slope;
    inside the front glass where `front_index` says so), wavelength. Density is mm^2 of film times mm^2 of the pupil
    plane per mm^2 of (x, y) and area of direction vectors.
    """
    e, g = model.encoding, Graph()
    position, direction, wavelength = g.split(g.input("front_rays", 5), [2, 2, 1])
    position = position * (1 / model.scales.position_mm)
    wanted = g.concat(position, direction)
    first = g.concat(*guess.build(g, _light(e, [position, direction], wavelength), None))
    inputs = {"wanted": wanted, "wavelength_nm": wavelength}
    unknown, size = _solve(scene_system(model), inputs, first, steps, form)
    # Free space from the two planes to the film: F = U + (P - U) / along.
    u, p = g.split(unknown, [2, 2])
    p = p * e.film_scale_mm
    pupil = p * e.chiefs + u * e.pupil_scales_mm
    film_z = g.input("film_z_mm", per_call=True)
    back = (film_z - e.pupil_plane_z_mm) * (1 / (e.film_plane_z_mm - e.pupil_plane_z_mm))
    rays = g.concat(pupil + (p - pupil) * back, pupil, wavelength)

    radius, light = g.input("stop_radius_mm", per_call=True), light_field(g, e, rays, film_z)
    inside = within_domain(model, rays, film_z, radius, form)
    series = DirectionSeries.of(model, form)
    core, planes = _core_graph(model, light, units_of(model, series, form)), (2, 3, 0, 1)
    outputs = g.inline(with_derivatives(core, _SCENE, [("planes", k) for k in planes]), {"planes": light.planes})
    vectors = (outputs["position"], outputs["direction"], outputs["stop"])
    values = CoreValues(vectors, outputs["transmittance"], outputs.get("gates"), index=outputs.get("index"))
    status = add_outputs(model, values, inside, radius, series, form)
    area = determinant([g.concat(*(outputs[derivative(n, f"planes_{k}")] for n in _SCENE)) for k in planes]).abs()
    # Of (p, u), scaled, per mm^2 and (kappa rad)^2.
    factor = e.film_scale_mm**2 * math.prod(e.pupil_scales_mm) * series.kappa**2
    off = g.concat(*vectors[:2]) * (1 / np.repeat([model.scales.position_mm, series.kappa], 2)) - wanted
    return _finished(g, rays, g.outputs, back * back * factor / area, status, size or g.square(off), form)


_SCENE = ["position", "direction"]


def _core_graph(model: LensModel, light: Field, units: Units) -> Graph:
    """A core from planes such as those of `light`."""
    g = Graph()
    values = model.core.build(g, Field(g.input("planes", light.planes.rows), light.w_bias), units)
    g.outputs = dict(zip((*_SCENE, "stop"), values.vectors, strict=True)) | {"transmittance": values.transmittance}
    if values.gates is not None:
        g.outputs["gates"] = values.gates
    if values.index is not None:
        g.outputs["index"] = values.index
    return g


def scaled_film_z(model: LensModel, film_z: Any) -> Any:
    """The film plane, a value or a tensor, from -1 (nearest) to 1; None where there is one only."""
    near, far = model.domain.film_z_mm
    return (film_z - (near + far) / 2) * (2 / (far - near)) if far > near else None


def _solve(system: Graph, inputs: dict[str, Value], first: Value, steps: int, form: Form) -> tuple[Value, Value | None]:
    """Unknowns, and the squared length of their residual where the form is exact."""
    solved = limited_newton(system, inputs, first, steps, LIMIT)
    if not form.exact:
        return solved.last, None
    g = first.graph
    return solved.judged(g.square(g.inline(system, {**inputs, "unknown": solved.last})["residual"]))


def _finished(
    g: Graph, rays: Value, out: dict[str, Value], density: Value, status: Value, size: Value, form: Form
) -> Graph:
    """The graph with its outputs; `size` is the squared length of the residual."""
    if density.node.per_call:  # of first-order models
        density = density + rays[4] * 0.0
    status = g.select(size <= TOLERANCE**2, status, float(st.NO_SOLUTION)).whole()
    g.outputs = {"rays": rays, **out, "density": density, "status": status}
    if form.exact:
        g.outputs["residual"] = size.sqrt()
    return pruned(g)


# ---- limited Newton steps ----
#
# Plain Newton iterations of a fixed count, as published for lens polynomials, run away where a step leaves the data.
# Here no step is longer than a limit, and a point that is worse than the best one so far is replaced by a shorter step
# from the best one.

# A step that did not help is repeated at this share of its length.
SHORTER = 0.25
# The unknowns stay within this, each: scaled so that passing rays fill the unit disc.
REACH = 2.0
_HUGE = 3e38

# Rows a b / c d of a 2 x 2 matrix.
Block = tuple[Value, Value, Value, Value]


def with_jacobian(system: Graph) -> Graph:
    """A system, of inputs `unknown` (and others) and output `residual`, with the columns of its Jacobian as outputs."""
    unknowns = next(node.rows for node in system.nodes if node.name == "unknown")
    return with_derivatives(system, ["residual"], [("unknown", k) for k in range(unknowns)])


@dataclass(frozen=True)
class Solved:
    """The result of an iteration.

    Attributes:
        last: unknowns after the last step, whose residual is not known yet.
        best: unknowns of the smallest residual before that. size: its squared length. None of zero steps.
    """

    last: Value
    best: Value | None
    size: Value | None

    def judged(self, size: Value) -> tuple[Value, Value]:
        """The best unknowns, and the squared length of their residual, from that of the last unknowns."""
        if self.best is None or self.size is None:
            return self.last, size
        g, better = size.graph, size <= self.size
        return g.select(better, self.last, self.best), g.select(better, size, self.size)


def limited_newton(system: Graph, given: Mapping[str, Value], start: Value, steps: int, limit: float) -> Solved:
    """Append so many steps from `start` (2 or 4 rows).

    Args:
        system: a graph from `unknown`, and the inputs `given`, to `residual`, of as many rows.
        limit: the longest step, in units of the unknowns.
    """
    g, both = start.graph, with_jacobian(system)
    x, best, size, step = start.clip(-REACH, REACH), None, None, None
    for _ in range(steps):
        found = g.inline(both, {**given, "unknown": x})
        residual, *columns = (found[name] for name in both.outputs)
        square, newton = g.square(residual), _limited(solve(columns, residual), limit)
        if best is None or size is None or step is None:
            best, size, step = x, square, newton
        else:
            better = square <= size
            best = g.select(better, x, best)
            step = g.select(better, newton, step * SHORTER)
            size = g.select(better, square, size)
        x = (best - step).clip(-REACH, REACH)
    return Solved(x, best, size)


def _limited(step: Value, limit: float) -> Value:
    """A step no longer than the limit, and none where it is not finite: a singular Jacobian gives no direction."""
    g, square = step.graph, step.graph.square(step)
    shorter = step * (limit / square.sqrt().maximum(limit))
    return g.select(square <= _HUGE, shorter, 0.0)


def solve(columns: Sequence[Value], b: Value) -> Value:
    """x of columns x = b, for 2 or 4 unknowns; not finite where the matrix is singular.

    Four are solved in blocks of two, the last two first out: their own block must not be singular.
    """
    g = b.graph
    if len(columns) == 2:
        return g.concat(*_cramer(_block(columns, 0, 0), b[0], b[1]))
    lower, corner = _block(columns, 2, 0), _block(columns, 2, 2)
    schur, carry = _schur(columns)
    right = _apply(carry, b[2], b[3])
    first = _cramer(schur, b[0] - right[0], b[1] - right[1])
    left = _apply(lower, *first)
    return g.concat(*first, *_cramer(corner, b[2] - left[0], b[3] - left[1]))


def determinant(columns: Sequence[Value]) -> Value:
    """The determinant of the matrix with these columns, of 2 or 4 rows each."""
    if len(columns) == 2:
        return _determinant(_block(columns, 0, 0))
    return _determinant(_schur(columns)[0]) * _determinant(_block(columns, 2, 2))


def _block(columns: Sequence[Value], row: int, column: int) -> Block:
    left, right = columns[column], columns[column + 1]
    return left[row], right[row], left[row + 1], right[row + 1]


def _schur(columns: Sequence[Value]) -> tuple[Block, Block]:
    """upper - right corner^-1 lower, and right corner^-1, of the blocks upper, right / lower, corner."""
    a, b, c, d = corner = _block(columns, 2, 2)
    over = 1.0 / _determinant(corner)
    minus = -over
    carry = _times(_block(columns, 0, 2), (d * over, b * minus, c * minus, a * over))
    taken = _times(carry, _block(columns, 2, 0))
    p, q, r, s = (x - y for x, y in zip(_block(columns, 0, 0), taken, strict=True))
    return (p, q, r, s), carry


def _determinant(m: Block) -> Value:
    return m[0] * m[3] - m[1] * m[2]


def _times(m: Block, n: Block) -> Block:
    return (*_row(m[0], m[1], n), *_row(m[2], m[3], n))


def _row(a: Value, b: Value, n: Block) -> tuple[Value, Value]:
    return a * n[0] + b * n[2], a * n[1] + b * n[3]


def _apply(m: Block, x: Value, y: Value) -> tuple[Value, Value]:
    return m[0] * x + m[1] * y, m[2] * x + m[3] * y


def _cramer(m: Block, x: Value, y: Value) -> tuple[Value, Value]:
    """Cramer's rule."""
    over = 1.0 / _determinant(m)
    return (m[3] * x - m[1] * y) * over, (m[0] * y - m[2] * x) * over
