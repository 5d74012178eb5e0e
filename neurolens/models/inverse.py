"""Inverse maps of a surrogate: the camera ray through a point of the stop, and the camera ray of a given scene ray.

A polynomial that is fitted to the model's own rays gives the first guess. Newton's method with the model's Jacobian,
limited so that it never diverges, takes it to the model's own ray to rounding. The model itself says whether that ray
passes, so that both directions agree. Hanika and Dachsbacher 2014 introduced the iteration on the stop for polynomial
lenses.

Each map is one graph: the guess, the steps written out, the model itself at the solution. It follows from the model
alone, in a second, and is evaluated here by numpy or exported for other programs.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.derive import derivative, determinant, limited_newton, with_derivatives
from neurolens.graph.interpret import evaluate, monomials
from neurolens.graph.ir import Exponents, Graph, Value, pruned
from neurolens.graph.program import RAY
from neurolens.models.assemble import (
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
from neurolens.models.cores import (
    DIRECTION,
    MIRROR,
    POSITION,
    ROUND,
    STOP,
    Array,
    CoreValues,
    Field,
    Refracted,
    Units,
)
from neurolens.models.fitted import Domain, Encoding
from neurolens.models.model import LensModel
from neurolens.optics.trace.surfaces import Rays, front_rays

STEPS = 3
# A solution counts where its residual is below this: in stop radii; in front radii and radians.
TOLERANCE = 1e-4
# Longest Newton step: of the radius of the pupil (and of the film).
LIMIT = 0.35
_BATCH = 16384  # rays that numpy takes through a graph at once
# Degree of the guesses of round lenses and of those with cylinders, and passing rays of their fit.
_DEGREE, _MIRROR_DEGREE, _RAYS = 6, 3, 8000
_ROUNDS = 40  # of drawing as many rays again, until enough of them pass
_MARGIN = 0.1  # of the half widths of the boxes that rays are drawn from
_RIDGE = 1e-11  # relative
# The guess of the stop is fitted where the stop's image has at least this share of its usual area.
_FOLD = 0.1
# A solution this far from the ray, in pupil radii, is another ray of the same point.
_OTHER = 0.02


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

    @staticmethod
    def fitted(a: Array, b: Array, w: Array, z: Array, wanted: Array, *, mirror: bool) -> Guess:
        """Fit the guess of vectors `wanted` [K, 2, N] from a and b [2, N], by least squares over all terms."""
        rows, forms = [*a, *b], MIRROR if mirror else ROUND
        products = [sum(rows[i] * rows[j] for i, j in form) for form in forms]
        exponents = _exponents(_MIRROR_DEGREE if mirror else _DEGREE, len(forms), bool(w.any()), bool(z.any()))
        features = monomials(np.stack([*products, w, z]), exponents)
        ab = []
        for axes in ((0,), (1,)) if mirror else ((0, 1),):
            columns = np.hstack([np.vstack([features * v[i] for v in (a, b)]) for i in axes])
            norms = np.maximum(np.sqrt(np.einsum("ij,ij->i", columns, columns)), 1e-300)
            columns /= norms[:, None]
            gram = columns @ columns.T + _RIDGE * np.eye(len(columns))
            found = np.linalg.solve(gram, columns @ np.hstack([wanted[:, i] for i in axes]).T)
            ab.append((found.T / norms).reshape(len(wanted), 2, -1))
        return Guess(exponents, np.stack(ab, 2))

    def build(self, g: Graph, light: Field, z: Value | None) -> list[Value]:
        """Append the guessed vectors, 2 rows each, as functions of `light` and of z, which is 0 where None is given."""
        wide, last = self.ab.shape[2], self.exponents.shape[1] - 1
        variables = [v for v in range(last) if v < last - 1 or light.dispersive]
        x = light.products(MIRROR if wide == 2 else ROUND)
        if z is not None:
            variables, x = [*variables, last], g.concat(x, z)
        used = ~self.exponents[:, [v for v in range(last + 1) if v not in variables]].any(1)
        rows = g.polynomial(self.exponents[used][:, variables], self.ab.reshape(-1, len(self.exponents))[:, used], x)
        parts = g.split(rows, [wide] * (2 * len(self.ab)))
        return [a * light.p + b * light.u for a, b in zip(parts[::2], parts[1::2], strict=True)]


def _exponents(degree: int, invariants: int, dispersive: bool, moves: bool) -> Exponents:
    """Return exponents up to a total degree in the invariants; w and z multiply lower degrees only."""
    powers = itertools.product(
        *([range(degree + 1)] * invariants), range(3 if dispersive else 1), range(3 if moves else 1)
    )
    rows = [p for p in powers if sum(p[:-2]) + 2 * p[-2] + p[-1] + p[-2] * p[-1] <= degree]
    return np.array(sorted(rows, key=sum), dtype=np.int64)


class InverseRays(NamedTuple):
    """Camera rays that cross the stop in given points, or leave as given scene rays, [N].

    Attributes:
        rays: [5, N] film x, y, pupil x, y in mm, wavelength in nm.
        scene_ray, transmittance, stop_xy_mm, status: of the model for those rays, [6, N], [N], [2, N], [N]; NO_SOLUTION
            where they are not what was wanted.
        density: for stop points |d stop / d pupil|, area on the stop per area on the pupil plane, the film point held:
            a stop point drawn with density q per mm^2 is a pupil point drawn with density q times this. For scene rays
            |d (film, pupil) / d (position, direction)|, mm^2 on the film times mm^2 on the pupil plane, per mm^2 of
            (x, y) on the front surface and steradian.
        residual: distance from the given stop point, in stop radii; from the given scene ray, in front radii and in
            radians (root of the summed squares).
    """

    rays: Array
    scene_ray: Array
    transmittance: Array
    stop_xy_mm: Array
    status: NDArray[np.int32]
    density: Array
    residual: Array


@dataclass(frozen=True, eq=False)
class InverseModel:
    """Both inverse maps of one model; make it with `inverse_of`.

    Attributes:
        stop: from the film point (in film radii) and the stop point (in stop radii) to the pupil point, centred and
            scaled as the model's.
        scene: from position and direction vector, scaled as the model's, to u and p.
    """

    model: LensModel
    stop: Guess
    scene: Guess

    def through_stop(
        self, film_xy_mm: ArrayLike, stop_xy_mm: ArrayLike, wavelength_nm: ArrayLike, film_z_mm: ArrayLike,
        stop_radius_mm: float | None = None, steps: int = STEPS,
    ) -> InverseRays:  # fmt: skip
        """Find the rays from film points [2, N] through stop points [2, N], in the precision of the film points.

        Args:
            wavelength_nm, film_z_mm: [N], or one for all. stop_radius_mm: None takes the widest.

        Raises:
            InputError: arrays of other shapes.
        """
        film, stop = _checked(2, film_xy_mm=film_xy_mm, stop_xy_mm=stop_xy_mm)
        rays = np.concatenate([film, stop, _each("wavelength_nm", wavelength_nm, film)]).astype(film.dtype)
        return self._solved("stop", {"stop_rays": rays}, film_z_mm, stop_radius_mm, steps)

    def from_scene(
        self, origin_mm: ArrayLike, direction: ArrayLike, wavelength_nm: ArrayLike, film_z_mm: ArrayLike,
        stop_radius_mm: float | None = None, steps: int = STEPS,
    ) -> InverseRays:  # fmt: skip
        """Find the camera rays of light that comes along scene rays; other arguments and errors as of `through_stop`.

        Args:
            origin_mm: [3, N], a point of each ray before or on the front surface, lens frame.
            direction: [3, N] unit vectors of the camera rays, away from the lens, against the light: from a point X of
                the front surface to a scene point S, (S - X) / |S - X|.
        """
        origin, away = _checked(3, origin_mm=origin_mm, direction=direction)
        waves = _each("wavelength_nm", wavelength_nm, origin)
        lines = Rays(*origin.astype(np.float64), *away.astype(np.float64))
        front, solid = front_rays(self.model.front, lines, index=front_index(self.model), wavelength_nm=waves[0])
        given = np.concatenate([front, waves]).astype(origin.dtype)
        out = self._solved("scene", {"front_rays": given}, film_z_mm, stop_radius_mm, steps)
        with np.errstate(all="ignore"):  # from the area of direction vectors to solid angle
            return out._replace(density=out.density / solid)

    def _solved(
        self, name: str, given: dict[str, Array], film_z_mm: ArrayLike, stop_radius_mm: float | None, steps: int
    ) -> InverseRays:
        graph, ((key, rays),) = _exact_graph(self, name, steps), given.items()
        radius = np.full((1, 1), self.model.checked_radius_mm(stop_radius_mm), rays.dtype)
        film_z = _each("film_z_mm", film_z_mm, rays, rays.dtype)
        parts = []
        for start in range(0, max(rays.shape[1], 1), _BATCH):
            part = slice(start, start + _BATCH)
            call = {"film_z_mm": film_z[:, part], "stop_radius_mm": radius}
            out = evaluate(graph, {key: rays[:, part], **call})
            count = rays[:, part].shape[1]
            wide = {k: np.broadcast_to(v, (len(v), count)) for k, v in out.items()}
            parts.append([wide[k] if len(wide[k]) > 1 else wide[k][0] for k in InverseRays._fields])
        found = InverseRays(*(np.concatenate(of_one, -1) for of_one in zip(*parts, strict=True)))
        return found._replace(residual=np.where(np.isfinite(found.residual), found.residual, np.inf))


def _checked(rows: int, **arrays: ArrayLike) -> list[Array]:
    """Return arrays as floats of one precision, [rows, N] each. Raises InputError: another shape."""
    found = [np.asarray(a) for a in arrays.values()]
    for name, array in zip(arrays, found, strict=True):
        if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape != (rows, found[0].shape[-1]):
            raise InputError("inverse", name, f"({array.dtype}, {array.shape})", f"numbers ({rows}, N), N for all")
    kind = np.float32 if found[0].dtype == np.float32 else np.float64
    return [a.astype(kind) for a in found]


def _each(name: str, value: ArrayLike, rays: Array, kind: Any = np.float64) -> Array:
    """Return the value of every ray, [1, N]. Raises InputError: neither one number nor N."""
    if np.size(value) not in (1, rays.shape[1]):
        raise InputError("inverse", name, f"({np.shape(value)})", "one number, or one a ray")
    return np.broadcast_to(np.asarray(value, kind), (1, rays.shape[1]))


def inverse_of(model: LensModel) -> InverseModel:
    """Make the inverse maps of a model; their first guesses are fitted to rays that it passes.

    Raises:
        InputError: a model without rays that pass, or whose core gives no direction vector.
    """
    e, (rays, film_z) = model.encoding, passing_rays(model)
    g = Graph()
    light = light_field(g, e, g.input("rays", 5), g.input("film_z_mm", per_call=True))
    values = model.core.build(g, light, Units())
    if values.unit is not None:
        raise InputError(model.method, "inverse", type(model.core).__name__, "a core of direction vectors")
    g.outputs = dict(zip(("position", "direction", "stop"), values.vectors, strict=True)) | {"planes": light.planes}
    g.outputs["w"] = light.colour() if light.dispersive else g.constant(0.0)
    out = {k: np.broadcast_to(v, (len(v), len(film_z))) for k, v in evaluate(g, _inputs(model, rays, film_z)).items()}
    (p, u), w = np.split(out["planes"][:4], 2), out["w"][0]
    # Through a caustic two rays cross the stop at one point: the guess follows the sheet of the axis.
    turned = np.linalg.det(_d_stop(model, rays, film_z))
    sheet = turned > _FOLD * np.median(turned)
    z = scaled_film_z(model, film_z)
    z = np.zeros_like(w) if z is None else z
    chief, scale = (np.array(v)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
    at_pupil = (rays[2:4] - chief * rays[:2]) / scale
    at_sheet = (v[..., sheet] for v in (rays[:2] / e.film_scale_mm, out["stop"], w, z, at_pupil[None]))
    stop = Guess.fitted(*at_sheet, mirror=e.mirror)
    wanted = np.stack([u, p])
    scene = Guess.fitted(out["position"], out["direction"], w, np.zeros_like(w), wanted, mirror=e.mirror)
    return InverseModel(model, stop, scene)


def _inputs(model: LensModel, rays: Array, film_z: Array) -> dict[str, Array]:
    radius = np.full((1, 1), model.domain.stop_radius_mm)
    return {"rays": rays, "film_z_mm": film_z[None], "stop_radius_mm": radius.astype(rays.dtype)}


def _d_stop(model: LensModel, rays: Array, film_z: Array) -> Array:
    """Return the derivatives [N, 2, 2] of the stop crossing by the pupil point."""
    graph = with_derivatives(model.graph, ["stop_xy_mm"], [("rays", 2), ("rays", 3)])
    out = evaluate(graph, _inputs(model, rays, film_z))
    columns = [np.broadcast_to(out[derivative("stop_xy_mm", row)], (2, len(film_z))) for row in RAY[2:]]
    return np.stack(columns).transpose(2, 1, 0)


def passing_rays(model: LensModel, count: int = _RAYS, seed: int = 0) -> tuple[Array, Array]:
    """Return at most `count` rays [5, N] of the domain that the model passes, with their film planes [N].

    Raises:
        InputError: no ray passes.
    """
    rng, found, total = np.random.default_rng(seed), list[Array](), 0
    for _ in range(_ROUNDS):
        rays = _drawn(model.domain, count, rng)
        found.append(rays[:, evaluate(model.graph, _inputs(model, rays[:5], rays[5]))["status"][0] == st.PASSED])
        total += found[-1].shape[1]
        if total >= count:
            break
    if not total:
        raise InputError(model.method, "inverse", "(no ray passes)", "a model that passes light")
    rays = np.concatenate(found, 1)[:, :count]
    return rays[:5], rays[5]


def _drawn(domain: Domain, count: int, rng: np.random.Generator) -> Array:
    """Draw rays [6, N] from a domain's boxes about the rays that pass; the last row is their film planes."""
    b, (share, turn, across, along, colour, place) = domain.bounds, rng.random((6, count))
    radius, turn = domain.film_radius_mm * np.sqrt(share), 2 * np.pi * turn
    table = np.linspace(0, b.film_radius_mm, len(b.low_mm))
    low, high, half = (np.interp(radius, table, v) for v in (b.low_mm, b.high_mm, b.half_mm))
    u = (low + high) / 2 + (1 + _MARGIN) * (high - low) * (across - 0.5)
    v = (1 + _MARGIN) * half * (2 * along - 1)
    cos, sin = np.cos(turn), np.sin(turn)
    (near, far), (shortest, longest) = domain.film_z_mm, domain.wavelength_nm
    return np.stack(
        [radius * cos, radius * sin, u * cos - v * sin, u * sin + v * cos,
         shortest + (longest - shortest) * colour, near + (far - near) * place]
    )  # fmt: skip


def convergence(inverse: InverseModel, rays: Array, film_z: Array, steps: int = STEPS) -> dict[str, dict[str, float]]:
    """Measure how often the inverse maps find the model's own rays: those of `rays` [5, N] that pass, in its precision.

    Returns for "stop" and "scene": converged (share with a residual below TOLERANCE) and other (share that is another
    ray of the same stop point, or scene ray, because the map is folded there).
    """
    model = inverse.model
    forward = evaluate(model.graph, _inputs(model, rays, film_z))
    passed = forward["status"][0] == st.PASSED
    rays, film_z, scene = rays[:, passed], film_z[passed], forward["scene_ray"][:, passed]
    stop = inverse.through_stop(rays[:2], forward["stop_xy_mm"][:, passed], rays[4], film_z, steps=steps)
    back = inverse.from_scene(scene[:3], scene[3:], rays[4], film_z, steps=steps)
    shares = {}
    for name, out in (("stop", stop), ("scene", back)):
        solved = out.residual < TOLERANCE
        away = np.hypot(*(out.rays[2:4] - rays[2:4])) > _OTHER * model.domain.pupil_radius_mm
        count = max(len(solved), 1)
        shares[name] = {"converged": float(solved.sum()) / count, "other": float((solved & away).sum()) / count}
    return shares


def front_index(model: LensModel) -> list[float] | None:
    """Return the front glass's index as a power series in 1 / lambda^2 (1/um^2); None where rays end outside."""
    if not isinstance(model.core, Refracted):
        return None
    e, series = model.encoding, np.polynomial.Polynomial(model.core.index)
    w = np.polynomial.Polynomial([-e.w_middle / e.w_half, 1 / e.w_half] if e.w_half else [0.0])
    return [float(a) for a in series(w).coef]


@lru_cache(maxsize=16)
def _exact_graph(inverse: InverseModel, name: str, steps: int) -> Graph:
    build = stop_graph if name == "stop" else scene_graph
    return build(inverse.model, getattr(inverse, name), EXACT, steps)


def stop_system(model: LensModel) -> Graph:
    """Return the system of the stop: where a ray crosses it, less the point asked for, in stop radii.

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
    """Return the system of the scene ray: position and direction vector less those asked for, in the model's scales.

    Inputs `unknown`: u, then p: directions follow p most and positions u, and the solver wants that order; `wanted`,
    `wavelength_nm`. Output `residual`.

    Raises:
        InputError: a core that gives no direction vector.
    """
    g, e = Graph(), model.encoding
    unknown, wanted = g.input("unknown", 4), g.input("wanted", 4)
    values = model.core.build(g, _light(e, [unknown[2:4], unknown[0:2]], g.input("wavelength_nm")), Units())
    if values.unit is not None:
        raise InputError(model.method, "inverse", type(model.core).__name__, "a core of direction vectors")
    g.outputs["residual"] = g.concat(values.vectors[POSITION], values.vectors[DIRECTION]) - wanted
    return g


def _light(e: Encoding, vectors: list[Value], wavelength: Value) -> Field:
    """Return a light field whose p and u are these."""
    g = wavelength.graph
    if not e.w_half:
        return Field(g.concat(*vectors))
    return Field(g.concat(*vectors, wavelength_row(e, wavelength)), -e.w_middle / e.w_half)


def stop_graph(model: LensModel, guess: Guess, form: Form, steps: int = STEPS) -> Graph:
    """Write the map from stop points to camera rays.

    Inputs stop_rays (film x, y, stop x, y in mm, wavelength in nm), film_z_mm, stop_radius_mm. Outputs rays (film x, y,
    pupil x, y, wavelength), density, those of the model, and where the form is exact `residual`. An exact graph gives
    the best point that was seen, any other that of the last step, which saves one evaluation.
    """
    e, g = model.encoding, Graph()
    film, stop, wavelength = g.split(g.input("stop_rays", 5), [2, 2, 1])
    wanted = stop * (1 / model.scales.stop_mm)
    inputs = {"film": film, "wanted": wanted, "wavelength_nm": wavelength}
    z = scaled_film_z(model, g.input("film_z_mm", per_call=True))
    (first,) = guess.build(g, _light(e, [film * (1 / e.film_scale_mm), wanted], wavelength), z)
    u, size = _solve(stop_system(model), inputs, first, steps, form)
    rays = _pupil_rays(e, film, u, wavelength)
    judge = with_derivatives(model_graph(model, form), ["stop_xy_mm"], [("rays", 2), ("rays", 3)])
    out = g.inline(judge, {"rays": rays})
    area = determinant([out.pop(derivative("stop_xy_mm", row)) for row in RAY[2:]]).abs()
    off = out["stop_xy_mm"] * (1 / model.scales.stop_mm) - wanted
    (status,) = g.inputs_of(out.pop("status").number)  # before it is made whole
    return _finished(g, rays, out, area, status, size or g.square(off), form)


def scene_graph(model: LensModel, guess: Guess, form: Form, steps: int = STEPS) -> Graph:
    """Write the map from scene rays to camera rays: `stop_graph` with another input, and another meaning of density.

    Input front_rays: x and y on the front surface (mm), direction vector of the model (angle vector in rad, or slope;
    inside the front glass where `front_index` says so), wavelength. Density is mm^2 of film times mm^2 of the pupil
    plane per mm^2 of (x, y) and area of direction vectors.
    """
    e, g = model.encoding, Graph()
    position, direction, wavelength = g.split(g.input("front_rays", 5), [2, 2, 1])
    position = position * (1 / model.scales.position_mm)
    wanted = g.concat(position, direction)
    first = g.concat(*guess.build(g, _light(e, [position, direction], wavelength), None))
    unknown, size = _solve(scene_system(model), {"wanted": wanted, "wavelength_nm": wavelength}, first, steps, form)
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
    # The determinant is of scaled (p, u), per mm^2 and (kappa rad)^2.
    factor = e.film_scale_mm**2 * math.prod(e.pupil_scales_mm) * series.kappa**2
    off = g.concat(*vectors[:2]) * (1 / np.repeat([model.scales.position_mm, series.kappa], 2)) - wanted
    return _finished(g, rays, g.outputs, back * back * factor / area, status, size or g.square(off), form)


_SCENE = ["position", "direction"]


def _core_graph(model: LensModel, light: Field, units: Units) -> Graph:
    """Return the graph of a core that takes planes such as those of `light`."""
    g = Graph()
    values = model.core.build(g, Field(g.input("planes", light.planes.rows), light.w_bias), units)
    g.outputs = dict(zip((*_SCENE, "stop"), values.vectors, strict=True)) | {"transmittance": values.transmittance}
    if values.gates is not None:
        g.outputs["gates"] = values.gates
    if values.index is not None:
        g.outputs["index"] = values.index
    return g


def scaled_film_z(model: LensModel, film_z: Any) -> Any:
    """Scale the film plane, a value or an array, to -1 (nearest) to 1; None where there is one only."""
    near, far = model.domain.film_z_mm
    return (film_z - (near + far) / 2) * (2 / (far - near)) if far > near else None


def _solve(system: Graph, inputs: dict[str, Value], first: Value, steps: int, form: Form) -> tuple[Value, Value | None]:
    """Return the unknowns, and the squared length of their residual where the form is exact."""
    solved = limited_newton(system, inputs, first, steps, LIMIT)
    if not form.exact:
        return solved.last, None
    g = first.graph
    return solved.judged(g.square(g.inline(system, {**inputs, "unknown": solved.last})["residual"]))


def _finished(
    g: Graph, rays: Value, out: dict[str, Value], density: Value, status: Value, size: Value, form: Form
) -> Graph:
    """Return the graph with its outputs; `size` is the squared length of the residual."""
    if density.node.per_call:  # as in first-order models
        density = density + rays[4] * 0.0
    status = g.select(size <= TOLERANCE**2, status, float(st.NO_SOLUTION)).whole()
    g.outputs = {"rays": rays, **out, "density": density, "status": status}
    if form.exact:
        g.outputs["residual"] = size.sqrt()
    return pruned(g)
