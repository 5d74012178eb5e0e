"""Polynomial surrogates: dense, by matching pursuit, by orthogonal least squares with replacement; and first order.

One choice of monomials serves position and direction, by the film-equivalent error in the nearest focused plane and at
infinity. Orthogonal least squares then keeps for each the terms that it needs. The stop crossing and the gates are
fitted on the monomials that are computed anyway.
The thin and the thick lens that renderers use today have the same form: their rays follow the ideal (collinear) map of
the prescription's focal length and principal planes; stop and rims are fitted as quadratic forms, which is what
first-order rim crossings are. Lenses with cylinders, which have two planes of symmetry, are fitted axis by axis.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.models.boundaries import (
    boundary_terms,
    features_of,
    fit_stop,
    invariant_core,
    needed_for,
    solve_scalars,
    stop_crossing,
)
from neurolens.models.cores import DIRECTION, POSITION, STOP, InvariantPolynomial, LightField, MirrorPolynomial
from neurolens.models.fitted import Encoding
from neurolens.models.pairs import PairSet, RayPairs
from neurolens.models.targets import (
    POLYNOMIALS,
    ModelSettings,
    Prepared,
    film_equivalent,
    film_equivalent_weights,
    scales_of,
    targets_of,
    weighed_apart,
)
from neurolens.models.terms import (
    Exponents,
    Sweep,
    backward,
    forward,
    further,
    invariant_exponents,
    kept,
    monomials,
    ordered,
    powers,
    replace_terms,
    solve,
    united,
    vector_columns,
)
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens

ParaxialMethod = Literal["thin", "thick"]
Shift = tuple[float, float]

_CHOICE_RAYS = 10_000
_SURPLUS = 1.5  # terms before elimination over terms kept
_POSITION_SHARE = 2 / 3  # the position may err by this share of the direction's error, both weighed
# Growth goes on while directions err by more than this, for so many more rounds, each of which must take away this
# share of the squared residual. The last number: passes of replacement.
FINE_DEG, _MORE_ROUNDS, _LEAST_FALL, _PASSES = 0.002, 4, 0.03, 3
# The search for planes: rays of a trial fit, degree of its candidates; multiples of u in p and of p in u (scaled, see
# `shifted`) from which it starts, its steps, and the farthest of those multiples.
_TRIAL_RAYS, _TRIAL_DEGREE = 2500, 7
_START = tuple(product((-0.6, -0.3, 0.0, 0.3), (-0.2, 0.0, 0.2, 0.4)))
_STEPS, _FARTHEST = (0.12, 0.06, 0.03), 1.5
_MIRROR_METHODS = ("omp", "ols")  # and networks (`mlp`)
_MOST_CANDIDATES = 2500  # more would take too long to choose from


def fit_polynomial(data: Prepared, settings: ModelSettings) -> InvariantPolynomial:
    """Fit by the method of the settings, one of `POLYNOMIALS`.

    Raises:
        InputError: an unknown method, fewer than two terms, or too few training rays.
    """
    if settings.method not in POLYNOMIALS:
        raise InputError("fit", "method", settings.method, f"one of {', '.join(POLYNOMIALS)}")
    if settings.terms < 2:
        raise InputError("settings", "model.terms", settings.terms, "at least 2 coefficients per vector output")
    count = len(data.pairs.train)
    if count <= settings.terms:
        raise InputError("settings", "pairs.train", count, f"more training rays than the {settings.terms} terms")
    train, dispersive = data.train, data.encoding.dispersive
    outputs = weighed_apart(data.pairs.lens, data.pairs.domain, train.vectors, settings.position_weight)
    # Many rays more than candidates make a choice no better; the coefficients are fitted on all of them.
    field, wanted = LightField(*(c[..., :_CHOICE_RAYS] for c in train.field)), outputs[..., :_CHOICE_RAYS]
    exponents = invariant_exponents(settings.degree, dispersive=dispersive)
    for _ in range(settings.growth if settings.method == "ols" else 0):
        if 2 * len(exponents) <= settings.terms:
            break
        chosen = _choose(_sweep(exponents, field, wanted), replace(settings, replacement=False))
        exponents = _grown(exponents, chosen, dispersive=dispersive)
    chosen = _choose(_sweep(exponents, field, wanted), settings)
    first = kept(exponents, chosen)[0]
    if settings.method == "ols" and settings.replacement and settings.growth > 1 and len(chosen) == settings.terms:
        exponents, chosen = _grown_on(data, exponents, chosen, lambda e: _sweep(e, field, wanted), settings.terms)
    chosen = chosen or [0]  # rays on the axis alone choose nothing
    exponents, columns = kept(exponents, chosen)
    own = len(exponents)
    exponents = np.concatenate([exponents, boundary_terms(data, exponents, first)])
    columns = [c if c < own else c - own + len(exponents) for c in columns]
    rows = vector_columns(monomials(train.field.invariants(), exponents), train.field)
    coefficients = rows.new_zeros((STOP, len(rows)))
    least = 0.0
    for row, vector in enumerate((DIRECTION, POSITION)):
        mine = columns
        if settings.method == "ols" and len(columns) == settings.terms:
            sweep = _sweep(exponents, field, wanted[row : row + 1])
            sweep.restart(columns)
            error = max(sweep.residual, least)
            mine, least = min(needed_for(sweep, error), columns, key=len), _POSITION_SHARE**2 * error
        coefficients[vector, mine] = solve(rows[mine], train.vectors[vector].reshape(1, -1))[0]
    return invariant_core(data, exponents, range(len(rows)), coefficients, sparse=True)


def _sweep(exponents: Exponents, field: LightField, outputs: Tensor) -> Sweep:
    return Sweep.of_vectors(monomials(field.invariants(), exponents), field, outputs)


def _grown(exponents: Exponents, chosen: list[int], *, dispersive: bool) -> Exponents:
    """Return the exponents [M, 4], and below them those of the chosen columns raised by one in each variable."""
    parents = exponents[sorted({k % len(exponents) for k in chosen})]
    children = np.concatenate([parents + step for step in np.eye(4, dtype=np.int64)[: 4 if dispersive else 3]])
    return np.concatenate([exponents, further(children, exponents)])


def _grown_on(
    data: Prepared, exponents: Exponents, chosen: list[int], sweep: Callable[[Exponents], Sweep], terms: int
) -> tuple[Exponents, list[int]]:
    """Choose in more rounds, each among the chosen terms and their products; returns exponents and columns.

    Rounds end where directions err by less than `FINE_DEG`, or where one takes off less than `_LEAST_FALL`. Each
    round searches with several widths, from the chosen terms and from none, for each search ends in another place.
    """
    fine = math.radians(FINE_DEG) * film_equivalent_weights(data.pairs.lens, data.pairs.domain)[1]
    for _ in range(_MORE_ROUNDS):
        own, columns = kept(exponents, chosen)
        more = _grown(own, columns, dispersive=data.encoding.dispersive)
        trial = sweep(more)
        start = [c if c < len(own) else c - len(own) + len(more) for c in columns]
        trial.restart(start)
        before, best = trial.residual, (trial.residual, start)
        if trial.residuals[0] < fine**2 * min(len(data.pairs.train), _CHOICE_RAYS):
            break
        for surplus, first in ((1.25, start), (1.5, start), (2.0, start), (1.5, [])):
            trial.restart(first)
            forward(trial, math.ceil(surplus * terms))
            backward(trial, terms)
            replace_terms(trial, _PASSES)
            best = min(best, (trial.residual, sorted(trial.chosen)))
        if best[0] > (1 - _LEAST_FALL) * before:
            break
        exponents, chosen = more, best[1]
    return exponents, chosen


def _choose(sweep: Sweep, settings: ModelSettings) -> list[int]:
    if settings.method == "dense":
        return list(range(sweep.count))
    surplus = _SURPLUS if settings.method == "ols" and settings.elimination else 1.0
    forward(sweep, math.ceil(surplus * settings.terms), "omp" if settings.method == "omp" else "ols")
    backward(sweep, settings.terms)
    if settings.method == "ols" and settings.replacement:
        replace_terms(sweep)
    return sorted(sweep.chosen)


def ideal_map(lens: Lens, encoding: Encoding, method: ParaxialMethod) -> Tensor:
    """Return [2, 2]: position (scaled) and slope (dx / -dz) of the scene-side ray per unit of scaled p and u.

    The position is that in the plane of the front vertex. "thin" puts both principal planes at the rear one.
    """
    data = first_order(lens)
    rear = data.rear_principal_z_mm
    front = data.front_principal_z_mm if method == "thick" else rear
    rows = []
    for p, u in ((1.0, 0.0), (0.0, 1.0)):
        on_film = p * encoding.film_scale_mm
        on_pupil = u * encoding.pupil_scale_mm + encoding.chief * on_film
        rise = (on_pupil - on_film) / (encoding.pupil_plane_z_mm - encoding.film_plane_z_mm)  # dx / dz, film side
        height = on_film + rise * (rear - encoding.film_plane_z_mm)
        rise = rise + height / data.efl_mm  # light loses h / f on its way to the film; camera rays regain it
        rows.append([(height - rise * front) / scales_of(lens).position_mm, -rise])
    return torch.tensor(rows, dtype=torch.float64).T


def fit_paraxial(data: Prepared, method: ParaxialMethod) -> InvariantPolynomial:
    """Fit a model of first order alone, whose direction vector is a slope (see `LensModel.direction`)."""
    exponents = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], dtype=np.int64)
    ab = torch.zeros((3, 2, len(exponents)), dtype=torch.float64)
    ab[[POSITION, DIRECTION], :, 0] = ideal_map(data.pairs.lens, data.encoding, method)
    ab[STOP, :, 0] = fit_stop(data, features_of(exponents[:1]))
    return InvariantPolynomial(exponents, ab.numpy(), solve_scalars(data, features_of(exponents)).numpy())


# ---- the planes of the light field ----


def shifted(encoding: Encoding, passing: PairSet, shift: Shift) -> Encoding:
    """Return the encoding with q = p - m u for p and u - k q for u, for shift (k, m), scaled by the rays of `passing`.

    q is the crossing with another plane up to scale, so that only plane, chief and scales change.
    """
    k, m = shift
    p_weight, u_weight = _weights(encoding, m)
    total = p_weight + u_weight
    film, pupil = encoding.film_plane_z_mm, encoding.pupil_plane_z_mm
    moved = replace(encoding, film_plane_z_mm=pupil + (film - pupil) * p_weight / total)
    # u - k p'' with p'' = total * (crossing with the new plane): u0 / U - (c / U) p0 - k total q, in terms of u0 and q.
    along = p_weight / total  # q = along p0 + (1 - along) u0
    c = encoding.chief / encoding.pupil_scale_mm
    u0 = 1 / encoding.pupil_scale_mm + c * (1 - along) / along
    moved = replace(moved, chief=(c / along + k * total) / u0)
    p, u = moved.planes(passing.inputs)
    film_scale, pupil_scale = (float(v.norm(dim=0).max()) for v in (p, u - moved.chief * p))
    return replace(moved, film_scale_mm=film_scale, pupil_scale_mm=pupil_scale)


def _weights(encoding: Encoding, m: float) -> tuple[float, float]:
    """Return the weights of the crossings p0 and u0 (mm) in p - m u, with p = p0 / P and u = (u0 - c p0) / U."""
    from_u = m / encoding.pupil_scale_mm
    return 1 / encoding.film_scale_mm + encoding.chief * from_u, -from_u


def _proper(encoding: Encoding, shift: Shift) -> bool:
    """Return whether the moved p plane is neither the u plane nor at infinity, nor far from where it was."""
    p_weight, u_weight = _weights(encoding, shift[1])
    least = 0.05 / encoding.film_scale_mm
    return max(map(abs, shift)) <= _FARTHEST and p_weight > least and abs(p_weight + u_weight) > least


def fit_planes(pairs: RayPairs, encoding: Encoding, terms: int, position_weight: float) -> Encoding:
    """Search for the planes in which a polynomial of `terms` coefficients per vector output is best.

    A ray's crossings with any two planes carry the same information, and a polynomial of full degree in them spans the
    same functions, because the change is linear. A sparse one does not: its variables should follow the lens's own (its
    field, and where the ray crosses its stop). So the search moves the p plane, and the multiple of p that is taken
    from u, to the least film-equivalent residual of a sparse fit. Nothing changes in the evaluator. The encoding itself
    is among the trials; it comes back where none does better, or where there are too few rays for a trial to mean
    anything. The search is deterministic.
    """
    rays = pairs.train.select(slice(0, _TRIAL_RAYS))
    if encoding.mirror or len(rays) < 4 * _SURPLUS * terms:
        return encoding
    targets = targets_of(pairs.lens, encoding, rays)
    outputs = weighed_apart(pairs.lens, pairs.domain, targets.vectors, position_weight)
    exponents = invariant_exponents(_TRIAL_DEGREE, dispersive=encoding.dispersive)

    @cache
    def residual(shift: Shift) -> float:
        field = shifted(encoding, rays, shift)(rays.inputs) if _proper(encoding, shift) else None
        if field is None or not bool(torch.isfinite(field.p).all() & torch.isfinite(field.u).all()):
            return math.inf
        sweep = _sweep(exponents, field, outputs)
        forward(sweep, math.ceil(_SURPLUS * terms))
        backward(sweep, terms)
        return sweep.residual

    best = min(_START, key=residual)
    for step in _STEPS:
        while True:
            k, m = best
            nearby = min(((k + step, m), (k - step, m), (k, m + step), (k, m - step)), key=residual)
            if residual(nearby) >= residual(best):
                break
            best = nearby
    return encoding if best == (0.0, 0.0) else shifted(encoding, pairs.train, best)


# ---- lenses with cylinders ----


def _mirror_columns(exponents: Exponents, axis: int, field: LightField) -> Tensor:
    """Return [2 M, N] terms of one component: monomials [M, 7], each times p (first M columns) and times u (M more)."""
    m = monomials(field.invariants(mirror=True), exponents)
    return torch.cat([m * field.p[axis], m * field.u[axis]])


def mirror_exponents(degree: int, axis: int, *, dispersive: bool = True) -> Exponents:
    """Return exponents [M, 7] of the monomials that multiply p and u of one axis, up to a `degree` in the invariants.

    The x of a vector is odd in (p_x, u_x) and even in (p_y, u_y), the y the other way about. Terms of x are p_x or u_x
    times a monomial of `LightField.invariants` without p_x u_x (p_x (p_x u_x) is p_x^2 u_x, which is there), and with
    p_y u_y at most once (its square is p_y^2 u_y^2): so every term stands once. The wavelength multiplies lower degrees
    only, as in `invariant_exponents`.
    """
    own, other = (0, 3) if axis == 0 else (3, 0)
    rows = []
    for w, most in enumerate([degree, degree - 2, degree - 3] if dispersive else [degree]):
        for rho, tau, rho_other, tau_other, sigma_other in powers(5, most):
            row = [0, 0, 0, 0, 0, 0, w]
            row[own], row[own + 2] = rho, tau
            row[other : other + 3] = rho_other, sigma_other, tau_other
            rows += [tuple(row)] if sigma_other <= 1 else []
    return ordered(rows)


def fit_mirror(data: Prepared, method: str, terms: int, degree: int) -> MirrorPolynomial:
    """Fit the polynomial of a lens with cylinders. Position and direction share terms, x and y have their own.

    Args:
        method: "ols" (orthogonal least squares with replacement) or "omp" (matching pursuit).
        terms: coefficients per vector output, half of them of x and half of y.
        degree: of the candidates in the invariants, twice that in the raw coordinates; lowered where there
            would be more than 2500 candidates.

    Raises:
        InputError: another method, fewer than four terms, or too few rays.
    """
    if method not in _MIRROR_METHODS:
        raise InputError(
            "fit", "method", method, f"{', '.join(_MIRROR_METHODS)} or mlp, the fits of lenses with cylinders"
        )
    if terms < 4:
        raise InputError("settings", "model.terms", terms, "at least 4 coefficients per vector output")
    pairs, train = data.pairs, data.train
    if len(pairs.train) <= terms:
        raise InputError("settings", "pairs.train", len(pairs.train), f"more training rays than the {terms} terms")
    dispersive = data.encoding.dispersive
    outputs = film_equivalent(pairs.lens, pairs.domain, train.vectors)
    field = LightField(*(c[..., :_CHOICE_RAYS] for c in train.field))
    supports: list[Exponents] = []
    sides = []  # whether each chosen column is one of u
    for axis in (0, 1):
        candidates = next(
            e
            for e in (mirror_exponents(d, axis, dispersive=dispersive) for d in range(degree, -1, -1))
            if 2 * len(e) <= _MOST_CANDIDATES
        )
        sweep = Sweep.of_columns(_mirror_columns(candidates, axis, field), outputs[:, axis, :_CHOICE_RAYS])
        forward(sweep, terms // 2, "ols" if method == "ols" else "omp")
        if method == "ols":
            replace_terms(sweep)
        chosen, count = np.array(sorted(sweep.chosen)), len(candidates)
        supports.append(candidates[chosen % count])
        sides.append((chosen >= count).astype(int))
    exponents, places = united([*supports, _scalar_terms(dispersive=dispersive)])
    features = monomials(train.field.invariants(mirror=True), exponents)
    ab = torch.zeros((3, 2, 2, len(exponents)), dtype=torch.float64)
    for axis, (side, place) in enumerate(zip(sides, places, strict=False)):
        vectors = torch.stack([train.field.p[axis], train.field.u[axis]])
        ab[:2, side, axis, place] = solve(features[place] * vectors[side], train.vectors[:2, axis])
    crossing, weight = stop_crossing(data)
    for axis in (0, 1):
        columns = _mirror_columns(exponents, axis, data.boundary_field)
        ab[STOP, :, axis] = solve(columns, crossing[axis][None], weight).reshape(2, -1)
    scalars = solve_scalars(data, lambda field: monomials(field.invariants(mirror=True), exponents))
    return MirrorPolynomial(exponents, ab.numpy(), scalars.numpy())


def _scalar_terms(*, dispersive: bool) -> Exponents:
    """Return terms for gates: every invariant, with low powers of w."""
    units = np.eye(7, dtype=np.int64)
    w, reach = units[6], range(3 if dispersive else 1)
    return np.array([*(w * k for k in reach), *(e + w * k for e in units[:6] for k in reach)])
