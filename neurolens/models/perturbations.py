"""Fits how the rays of a lens change with what is off in a copy, so that a model can be set to any copy of its lens.

The exact tracer gives the derivative of every ray by each figure that `optics.setting.copies` draws, by central
differences in float64. Terms are chosen for all figures together, each weighed by how far it may be off.

A copy is focused as its lens is: its film, and with it the frame, moves by as much as its paraxial focus. Its scene ray
is continued to the front surface of the lens, wherever its own front may be.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.models.copied import FORMS, Perturbed, copy_of
from neurolens.models.cores import DIRECTION, POSITION, STOP, Array, InvariantPolynomial, LightField
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import PairSet, blocked_splits, draw, lost, trace_pairs
from neurolens.models.targets import boundary_weights, film_equivalent, film_equivalent_weights, gate_values
from neurolens.models.terms import (
    Exponents,
    Sweep,
    forward,
    invariant_exponents,
    monomials,
    pinned_threads,
    replace_terms,
    solve,
    united,
    vector_columns,
)
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.copies import Off, Tolerances, draws_of, elements_of, perturbed
from neurolens.optics.trace.surfaces import Rays, front_rays

# Rays of each kind that are traced for each figure, and how many are drawn to find them.
_RAYS, _DRAWN = 2500, 30_000
# Steps of the central differences: of lengths in focal lengths, of tilts in degrees, of radii in percent, of indices.
_STEP_LENGTH, _STEP_TILT, _STEP_RADIUS, _STEP_INDEX = 1e-4, 0.01, 0.01, 1e-5
_DEVIATION = 0.44  # of a figure, over its limit: half, cut off at the limit
_DEGREE = 4  # of the terms that may join those of the round model
# Most terms for each output, and what share of all changes may be left: of position, direction and stop crossing by
# vectors across the axis, of a gate by those; and how many more than the round model's by other figures.
_MOST = {POSITION: 6, DIRECTION: 14, STOP: 3}
_MOST_OF_GATE, _MORE, _LEFT, _PASSES = 1, 6, 0.005, 2


class Answers(NamedTuple):
    """Exact answers of a lens in a model's units: vectors [3, 2, N], gates [G, N]; which rays are whole, which pass.

    A whole ray meets every surface, inside its rim or not.
    """

    vectors: Tensor
    gates: Tensor
    whole: Tensor
    passed: Tensor


def exact_answers(model: LensModel, lens: Lens, inputs: FilmRays) -> Answers:
    """Trace rays [N] of a model through a copy of its lens, which is focused as the lens itself is."""
    shift = _focus_z_mm(lens) - _focus_z_mm(model.lens)
    rays = replace(inputs, film_z=inputs.film_z + shift)
    pairs = trace_pairs(lens, rays, model.domain.pupil_z_mm + shift, power=False)
    x, y, z, *d = (c.numpy() for c in pairs.scene)
    found, _ = front_rays(model.front, Rays(x, y, z - shift, *d))
    vectors = torch.empty((3, 2, len(inputs)), dtype=torch.float64)
    vectors[POSITION] = torch.from_numpy(found[:2]) / model.scales.position_mm
    vectors[DIRECTION] = torch.from_numpy(found[2:])
    vectors[STOP] = torch.stack([c[lens.stop_index] for c in (pairs.cross_x, pairs.cross_y)]) / model.scales.stop_mm
    whole = ~lost(pairs) & torch.isfinite(vectors).all(0).all(0)
    return Answers(vectors, gate_values(lens, model.gates, pairs), whole, pairs.status == st.PASSED)


def _focus_z_mm(lens: Lens) -> float:
    data = first_order(lens)
    return float(data.rear_principal_z_mm + data.efl_mm)


class _Step(NamedTuple):
    """A small step of one figure, and how far the figure may be off, in the same unit."""

    off: Off
    step: float
    limit: float


def steps_of(lens: Lens, limits: Tolerances) -> tuple[list[_Step], list[_Step]]:
    """Return the steps of all figures: in the order of `Off.vectors`, along x alone, then in that of `Off.scalars`.

    Figures that no lens or no copy has, such as a plane's radius, have steps of 0.
    """
    length = _STEP_LENGTH * abs(first_order(lens).efl_mm)
    glass = [float(s.n_d) != 1 for s in lens.surfaces]

    def step(name: str, place: int | tuple[int, int], size: float, limit: float) -> _Step:
        off = Off.none(lens)
        getattr(off, name)[place] = size
        return _Step(off, size, limit)

    elements, last = range(len(elements_of(lens))), len(lens.surfaces) - 1
    vectors = [step("decentre_mm", (e, 0), length, limits.decentre_mm) for e in elements]
    vectors += [step("tilt_deg", (e, 1), _STEP_TILT, limits.tilt_deg) for e in elements]
    scalars = [
        step("thickness_mm", k, length * (k < last), limits.thickness_mm if g else limits.gap_mm)
        for k, g in enumerate(glass)
    ]
    scalars += [
        step("radius_percent", k, _STEP_RADIUS * bool(s.curvature), limits.radius_percent)
        for k, s in enumerate(lens.surfaces)
    ]
    scalars += [
        step("index", k, _STEP_INDEX * (glass[k] and s.glass is None), limits.index)
        for k, s in enumerate(lens.surfaces)
    ]
    return vectors, scalars


def derivatives(model: LensModel, steps: Sequence[_Step], inputs: FilmRays) -> Answers:
    """Return the derivatives [V, ...] of the exact answers by each figure, and which rays pass with every step."""
    found, whole = list[list[Tensor]](), torch.ones(len(inputs), dtype=torch.bool)
    for off, step, _ in steps:
        if not step:
            found.append([])
            continue
        back = Off(*(-v for v in vars(off).values()))
        ahead, behind = (exact_answers(model, perturbed(model.lens, o), inputs) for o in (off, back))
        whole &= ahead.whole & behind.whole
        found.append([(a - b) / (2 * step) for a, b in zip(ahead[:2], behind[:2], strict=True)])
    shapes = ((3, 2, len(inputs)), (len(model.gates), len(inputs)))
    nothing = [torch.zeros(shape, dtype=torch.float64) for shape in shapes]
    vectors, gates = (torch.stack([(one or nothing)[i] for one in found]) for i in (0, 1))
    return Answers(vectors, gates, whole, whole)


def with_perturbations(model: LensModel, limits: Tolerances | None = None) -> LensModel:
    """Return a model that can be set to copies of its lens (`copy_of`); its own rays stay as they are, to the bit.

    Args:
        model: a round polynomial of one state; any derivatives that it has are fitted again.
        limits: how far each figure may be off, which decides what is worth a term.

    Raises:
        InputError: a network; a lens with cylinders, or whose rays graze its front; a model with optical paths.
    """
    core = model.core.parts[0] if isinstance(model.core, Perturbed) else model.core
    if not isinstance(core, InvariantPolynomial) or model.direction != "angle":
        found = f"{model.method} ({type(core).__name__})"
        expected = "a polynomial of a round lens, without a path and without refraction of grazing rays at its front"
        raise InputError(model.lens.path, "model", found, expected)
    with pinned_threads(), torch.no_grad():
        rays, near = _rays(model)
        bent, turned = steps_of(model.lens, limits or Tolerances())
        reach = [s.limit for s in bent for _ in "xy"] + [s.limit * bool(s.step) for s in turned]
        both = FilmRays(*(torch.cat(c) for c in zip(rays.columns(), near.inputs.columns(), strict=True)))
        vectors, scalars = (derivatives(model, steps, both) for steps in (bent, turned))
        fit = _Fit(model, core, both, len(rays), near, vectors.whole & scalars.whole)
        exponents, bends, leans = fit.across(vectors, _deviations(bent))
        ab, rows = fit.along(scalars, _deviations(turned))
    more = [(0, len(exponents) - len(core.exponents))]
    ab, rows = (np.pad(a, [(0, 0)] * (a.ndim - 1) + more) for a in (ab, rows))
    return replace(model, core=Perturbed((core,), exponents, bends, leans, ab, rows, np.array(reach)))


def _deviations(steps: Sequence[_Step]) -> Tensor:
    return torch.tensor([_DEVIATION * s.limit if s.step else 0.0 for s in steps], dtype=torch.float64)


def _rays(model: LensModel) -> tuple[FilmRays, PairSet]:
    """Return rays that pass, and rays near the rims, which may pass or not."""
    drawn, _ = draw(model.domain, _DRAWN, seed=int(model.settings.get("rays_seed") or 0) + 77)
    pairs = trace_pairs(model.lens, drawn, model.domain.pupil_z_mm, power=False)
    passing = torch.nonzero(pairs.status == st.PASSED)[:_RAYS, 0]
    near = torch.nonzero(blocked_splits(model.lens, pairs)["rim"])[:_RAYS, 0]
    if min(len(passing), len(near)) < 10 * max(_MOST.values()):
        raise InputError(model.lens.path, "domain", f"({len(passing)} of {_DRAWN} rays pass)", "more rays that pass")
    return drawn.select(passing), pairs.select(near)


class _Fit:
    """Fits terms to derivatives; the first `passing` rays pass, the others are those near the rims."""

    def __init__(
        self, model: LensModel, core: InvariantPolynomial, rays: FilmRays, passing: int, near: PairSet, whole: Tensor
    ) -> None:
        self.core = core
        places = torch.nonzero(whole)[:, 0]
        pass_, rim = places[places < passing], places[places >= passing]
        gates, stop = boundary_weights(model.lens, model.gates, near.select(rim - passing))
        # For each output the rays on which it is fitted, their weights, and the unit of its errors.
        um = film_equivalent_weights(model.lens, model.domain)
        self.rays = {POSITION: pass_, DIRECTION: pass_, STOP: rim}
        self.weights = {POSITION: um[0] + 0 * pass_, DIRECTION: um[1] + 0 * pass_, STOP: stop}
        self.rim, self.gates = rim, gates
        self.field = model.encoding(rays)

    def _at(self, places: Tensor) -> LightField:
        return LightField(*(c[..., places] for c in self.field))

    def across(self, found: Answers, deviation: Tensor) -> tuple[Exponents, Array, Array]:
        """Fit f and h: the exponents [K, 4], `bends` [V, 3, 5, K] and `leans` [V, G, 2, K] of `Perturbed`."""
        own = self.core.exponents
        extra = invariant_exponents(_DEGREE, dispersive=bool((self.field.w != 0).any()))
        terms, (there, _) = united([own, extra])
        allowed = np.zeros(len(terms), bool)
        allowed[there] = self.core.serves
        allowed[len(own) :] = True
        candidates = terms[allowed]
        count, place = len(candidates), np.flatnonzero(allowed).tolist()
        bends = np.zeros((len(deviation), 3, FORMS, len(terms)))
        leans = np.zeros((len(deviation), len(self.gates), 2, len(terms)))
        for v, most in _MOST.items():
            field = self._at(self.rays[v])
            m, ((px, py), (ux, uy)) = monomials(field.invariants(), candidates), (field.p, field.u)
            forms = [
                (1.0 + 0 * px, 0 * px),
                (px * px, py * px),
                (px * ux, py * ux),
                (ux * px, uy * px),
                (ux * ux, uy * ux),
            ]
            columns = torch.cat([torch.cat([m * x, m * y], 1) for x, y in forms])
            wanted = found.vectors[:, v][..., self.rays[v]].flatten(1)
            chosen, solved = _pursued(columns, wanted, self.weights[v].repeat(2), deviation, most)
            bends.reshape(len(deviation), 3, -1)[:, v, _columns(chosen, count, place, len(terms))] = solved
        field = self._at(self.rim)
        m = monomials(field.invariants(), candidates)
        columns = torch.cat([m * field.p[0], m * field.u[0]])
        for g, weight in enumerate(self.gates):
            wanted = found.gates[:, g][:, self.rim]
            chosen, solved = _pursued(columns, wanted, weight, deviation, _MOST_OF_GATE)
            leans.reshape(len(deviation), len(self.gates), -1)[:, g, _columns(chosen, count, place, len(terms))] = (
                solved
            )
        used = (bends != 0).any((0, 1, 2)) | (leans != 0).any((0, 1, 2))
        used[: len(own)] = True
        return terms[used], bends[..., used], leans[..., used]

    def along(self, found: Answers, deviation: Tensor) -> tuple[Array, Array]:
        """Fit the changes by figures that leave the lens round: `ab` [P, 3, 2, M] and `scalars` [P, 1 + G, M]."""
        core, count = self.core, len(self.core.exponents)
        ab = np.zeros((len(deviation), 3, 2 * count))
        rows = np.zeros((len(deviation), *core.scalars.shape))
        serving = np.flatnonzero(core.serves)
        for v, places in self.rays.items():
            field = self._at(places)
            columns = vector_columns(monomials(field.invariants(), core.exponents), field)
            start = np.flatnonzero(core.ab[v].reshape(-1)).tolist()
            wanted = found.vectors[:, v][..., places].flatten(1)
            others = [*serving.tolist(), *(serving + count).tolist()]
            chosen, solved = _pursued(columns, wanted, self.weights[v].repeat(2), deviation, _MORE, start, others)
            ab[:, v, chosen] = solved
        columns = monomials(self._at(self.rim).invariants(), core.exponents)
        for g, weight in enumerate(self.gates, 1):
            start = np.flatnonzero(core.scalars[g]).tolist()
            wanted = found.gates[:, g - 1][:, self.rim]
            chosen, solved = _pursued(columns, wanted, weight, deviation, _MOST_OF_GATE, start, serving.tolist())
            rows[:, g, chosen] = solved
        return ab.reshape(-1, *core.ab.shape), rows


def _columns(chosen: list[int], count: int, place: list[int], terms: int) -> list[int]:
    """Return where chosen candidates, `count` in each form, stand among the columns of all terms.

    `place` are the numbers of the candidates among the terms.
    """
    return [k // count * terms + place[k % count] for k in chosen]


def _pursued(
    columns: Tensor, wanted: Tensor, weight: Tensor, deviation: Tensor, most: int,
    start: Sequence[int] = (), allowed: Sequence[int] | None = None,
) -> tuple[list[int], Array]:  # fmt: skip
    """Choose columns [C, N] that serve all changes [V, N] together, and solve for the coefficients of each [V, chosen].

    Args:
        weight: [N] of the rays. deviation: [V] of the figures, by which their changes count.
        most: columns, besides those of `start`.
        allowed: the columns that may be chosen; None: all.
    """
    names = list(range(len(columns))) if allowed is None else sorted({*start, *allowed})
    sweep = Sweep.of_columns(columns[names] * weight, wanted * deviation[:, None] * weight)
    whole = sweep.residual
    for k in start:
        sweep.add(names.index(k))
    first = len(sweep.chosen)
    while len(sweep.chosen) < first + most and sweep.residual > _LEFT**2 * whole:
        before = len(sweep.chosen)
        forward(sweep, before + 1)
        if len(sweep.chosen) == before:
            break
    if not start:
        replace_terms(sweep, _PASSES)
    chosen = [names[k] for k in sorted(sweep.chosen)]
    return chosen, solve(columns[chosen], wanted, weight).numpy() if chosen else np.zeros((len(wanted), 0))


# Rays and copies on which errors are measured; how much of a copy's change may be left within the domain that a card
# states, and by how many times the limits that domain is sought.
_HELD_OUT, _COPIES, LEFT, _TIMES = 3000, 4, 0.05, (0.1, 0.3, 1, 3, 10, 30)


def copy_errors(model: LensModel, copy: LensModel, lens: Lens) -> dict[str, float]:
    """Return the errors of a copy of a model beside the exact copy, on rays that the fit has not seen.

    Lengths are RMS on the film in um, to first order, at infinity or in the nearest focused plane, whichever is larger.
    `rms_um` is the copy's error. `change_um` is how far the copy differs from its lens, and `change_error_um` how far
    the model is wrong about that, apart from the round model's own error. The others are shares of rays that pass or
    are blocked wrongly.
    """
    rays, _ = draw(model.domain, _HELD_OUT, seed=int(model.settings.get("rays_seed") or 0) + 78)
    with torch.no_grad():
        (before, after), field = (exact_answers(model, one, rays) for one in (model.lens, lens)), model.encoding(rays)
        (round_, _), (found, scalars) = model.core(field), copy.core(field)
    passed = ((found[STOP] * model.scales.stop_mm).norm(dim=0) <= model.domain.stop_radius_mm) & (scalars[1:] <= 0).all(
        0
    )
    both = before.passed & after.passed

    def rms_um(vectors: Tensor) -> float:
        on_film = film_equivalent(model.lens, model.domain, vectors[..., both])
        return float(on_film.square().sum(1).mean(1).sqrt().max())

    change = after.vectors - before.vectors
    return {
        "rms_um": rms_um(found - after.vectors),
        "change_um": rms_um(change),
        "change_error_um": rms_um(found - round_ - change),
        "false_pass": float((passed & ~after.passed).sum() / passed.sum().clamp_min(1)),
        "false_block": float((~passed & after.passed).sum() / after.passed.sum().clamp_min(1)),
    }


def with_reach(model: LensModel, limits: Tolerances) -> tuple[LensModel, dict[str, float]]:
    """Return a model whose inputs go as far as its copies hold, and what its card says of them.

    The card gives the worst errors of some copies within the limits. It also says how far copies hold: `decentre_mm`
    and `tilt_deg` together, and `others`, a factor on the other limits. Up to there at most `LEFT` of what a copy
    changes is wrong, as a root mean square over copies.
    """
    across = Tolerances(limits.decentre_mm, limits.tilt_deg, 0, 0, 0, 0)
    along = replace(limits, decentre_mm=0, tilt_deg=0)

    def errors(some: Tolerances, times: float) -> list[dict[str, float]]:
        draws = draws_of(model.lens, Tolerances(*(v * times for v in vars(some).values())), _COPIES, seed=5)
        return [copy_errors(model, copy_of(model, off), lens) for off, lens in draws]

    def holds(some: Tolerances) -> float:
        reach = 0.0
        for times in _TIMES:
            try:
                rows = errors(some, times)
            except InputError:  # beyond the bounds of tolerances, or surfaces overlap
                break
            wrong, whole = (math.hypot(*(row[name] for row in rows)) for name in ("change_error_um", "change_um"))
            if wrong > LEFT * whole:
                break
            reach = times
        return reach

    times, others, rows, core = holds(across), holds(along), errors(limits, 1), model.core
    assert isinstance(core, Perturbed)
    factors = np.where(np.arange(len(core.limits)) < 2 * len(core.bends), times, others)
    within = {"decentre_mm": times * limits.decentre_mm, "tilt_deg": times * limits.tilt_deg, "others": others}
    found = {name: max(row[name] for row in rows) for name in rows[0]} | within
    return replace(model, core=replace(core, limits=factors * core.limits)), found
