"""Polynomial surrogates: dense, matching pursuit, orthogonal least squares with replacement, growth; and first order.

One support serves position and direction, chosen by the film-equivalent error in the nearest focused plane and at
infinity. The stop crossing, the transmittance and the gates are then fitted on the monomials that are computed anyway.
The thin and the thick lens that renderers use today have the same form: their rays follow the ideal (collinear) map of
the prescription's focal length and principal planes; stop and rims are fitted as quadratic forms, which is what
first-order rim crossings are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.surrogates.bases import (
    Exponents,
    invariant_exponents,
    kept,
    monomials,
    raw_exponents,
    raw_variables,
    solve,
    united,
    vector_columns,
)
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, Basis, InvariantPolynomial, RawPolynomial
from neurolens.surrogates.fits.boundaries import (
    boundary_terms,
    features_of,
    fit_scalars,
    fit_stop,
    invariant_core,
    solve_scalars,
    stop_crossing,
    transmittance_terms,
)
from neurolens.surrogates.fits.selection import Sweep, backward, forward, grow, matching_pursuit, replace_terms
from neurolens.surrogates.gates import gate_values
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.model import Encoding
from neurolens.surrogates.settings import POLYNOMIALS, ModelSettings
from neurolens.surrogates.targets import Prepared, film_equivalent_weights, scales_of, weighed_apart

ParaxialMethod = Literal["thin", "thick"]

_CHOICE_RAYS = 10_000
SURPLUS = 1.5
# Growth goes on while directions err by more than this, a round taking away at least a share of the squared residual.
FINE_DEG, _MORE_ROUNDS, _LEAST_FALL, _PASSES = 0.002, 4, 0.03, 3


def fit_polynomial(data: Prepared, settings: ModelSettings) -> InvariantPolynomial | RawPolynomial:
    """Fit by one of `POLYNOMIALS`.

    Raises:
        InputError: an unknown method or basis, fewer than two terms, or too few training rays.
    """
    for name, value, known in (("method", settings.method, POLYNOMIALS), ("basis", settings.basis, get_args(Basis))):
        if value not in known:
            raise InputError("fit", name, value, f"one of {', '.join(known)}")
    if settings.terms < 2:
        raise InputError("fit", "terms", settings.terms, "at least 2 coefficients per vector output")
    count = len(data.pairs.train)
    if count <= settings.terms:
        raise InputError("fit", "train", count, f"more training rays than the {settings.terms} terms")
    return _fit_invariant(data, settings) if settings.basis == "invariants" else _fit_raw(data, settings)


def _fit_invariant(data: Prepared, settings: ModelSettings) -> InvariantPolynomial:
    train = data.train
    invariants = train.field.invariants()
    outputs = weighed_apart(data.pairs.lens, data.pairs.domain, train.vectors, settings.position_weight)
    dispersive = data.encoding.dispersive
    if settings.method == "adaptive":
        exponents, chosen = grow(invariants, train.field, outputs, settings.terms, dispersive=dispersive)
        first = exponents
    else:
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
    own, features = len(exponents), monomials(invariants, exponents)
    # The chosen columns only; position and direction share them.
    coefficients = solve(vector_columns(features, train.field)[columns], train.vectors[:2].flatten(1))
    exponents = np.concatenate([exponents, boundary_terms(data, exponents, first)])
    exponents = np.concatenate([exponents, transmittance_terms(data, exponents, settings.transmittance_terms)])
    columns = [c if c < own else c - own + len(exponents) for c in columns]
    return invariant_core(data, exponents, columns, coefficients)


def _sweep(exponents: Exponents, field: LightField, outputs: Tensor) -> Sweep:
    return Sweep.of_vectors(monomials(field.invariants(), exponents), field, outputs)


def _grown(exponents: Exponents, chosen: list[int], *, dispersive: bool) -> Exponents:
    """The exponents [M, 4], and below them those of the chosen columns raised by one in each variable."""
    parents = exponents[sorted({k % len(exponents) for k in chosen})]
    children = np.concatenate([parents + step for step in np.eye(4, dtype=np.int64)[: 4 if dispersive else 3]])
    known = {tuple(e) for e in exponents.tolist()}
    new = [e for e in dict.fromkeys(map(tuple, children.tolist())) if e not in known]
    return np.concatenate([exponents, np.array(new, dtype=np.int64).reshape(-1, 4)])


def _grown_on(
    data: Prepared, exponents: Exponents, chosen: list[int], sweep: Callable[[Exponents], Sweep], terms: int
) -> tuple[Exponents, list[int]]:
    """The exponents and columns after more rounds, each from the chosen terms and what they give alone.

    Rounds end where directions err by less than `FINE_DEG`, or where one takes off less than `_LEAST_FALL`. Searches of
    several widths, from the chosen terms and from none, because each ends in another place.
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
        for surplus, known in ((1.25, start), (1.5, start), (2.0, start), (1.5, [])):
            trial.restart(known)
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
    surplus = SURPLUS if settings.method == "ols" and settings.elimination else 1.0
    forward(sweep, math.ceil(surplus * settings.terms), "omp" if settings.method == "omp" else "ols")
    backward(sweep, settings.terms)
    if settings.method == "ols" and settings.replacement:
        replace_terms(sweep)
    return sorted(sweep.chosen)


def _fit_raw(data: Prepared, settings: ModelSettings) -> RawPolynomial:
    """Every component with a support of its own, as published, half of `terms` each; one more for the scalars."""
    train = data.train
    # Supports are chosen on the rays near the rims, where every output has a value; coefficients on all boundary rays.
    rim = data.pairs.rim
    variables, rim_variables = raw_variables(train.field), raw_variables(data.encoding(rim.inputs))
    dispersive = data.encoding.dispersive
    half = replace(settings, terms=max(settings.terms // 2, 1))
    stop = data.pairs.lens.stop_index
    crossing = torch.stack([rim.cross_x[stop], rim.cross_y[stop]]) / data.pairs.lens.stop_radius_mm
    gates = gate_values(data.pairs.lens, data.gates, rim)
    wanted = {"scalars": (rim_variables, torch.cat([gates, rim.transmittance[None]]))}
    for axis in (0, 1):
        wanted[f"stop {axis}"] = (rim_variables, crossing[axis][None])
        for vector in (POSITION, DIRECTION):
            wanted[f"{vector} {axis}"] = (variables, train.vectors[vector, axis][None])
    exponents, places = united([_raw_support(*of, half, dispersive) for of in wanted.values()])
    columns = dict(zip(wanted, places, strict=True))
    features, boundary = monomials(variables, exponents), monomials(raw_variables(data.boundary_field), exponents)
    crossing, weight = stop_crossing(data)
    components = torch.zeros((3, 2, len(exponents)), dtype=torch.float64)
    for axis in (0, 1):
        for vector in (POSITION, DIRECTION):
            at = columns[f"{vector} {axis}"]
            components[vector, axis, at] = solve(features[at], train.vectors[vector, axis][None])[0]
        at = columns[f"stop {axis}"]
        components[STOP, axis, at] = solve(boundary[at], crossing[axis][None], weight)[0]
    at = columns["scalars"]
    scalars = torch.zeros((1 + len(data.gates), len(exponents)), dtype=torch.float64)
    scalars[:, at] = solve_scalars(data, lambda field: monomials(raw_variables(field), exponents)[at])
    return RawPolynomial(exponents, components.numpy(), scalars.numpy())


def _raw_support(variables: Tensor, outputs: Tensor, settings: ModelSettings, dispersive: bool) -> Exponents:
    """Exponents [K, 5] chosen for outputs [R, N] in common."""
    # Outputs count by how much they vary: transmittance varies little about a large mean, which one term explains.
    outputs = outputs / (outputs - outputs.mean(1, keepdim=True)).norm(dim=1, keepdim=True).clamp_min(1e-300)
    if settings.method == "adaptive":
        exponents, chosen = grow(variables, None, outputs[:, None], settings.terms, dispersive=dispersive)
        return exponents[chosen]
    exponents = raw_exponents(settings.degree, dispersive=dispersive)
    features = monomials(variables, exponents)
    if settings.method == "omp" and len(outputs) == 1:
        gram, moments = (features @ features.T).numpy(), (features @ outputs.T).numpy()
        return exponents[matching_pursuit(gram, moments[:, 0], settings.terms)]
    return exponents[_choose(Sweep.of_columns(features, outputs), settings)]


def ideal_map(lens: Lens, encoding: Encoding, method: ParaxialMethod) -> Tensor:
    """[2, 2]: position (scaled) and slope (dx / -dz) of the scene-side ray per unit of scaled p and u.

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
    """A model whose rays are first order; its direction vector is a slope (see `LensModel.direction`)."""
    exponents = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], dtype=np.int64)
    ab = torch.zeros((3, 2, len(exponents)), dtype=torch.float64)
    ab[[POSITION, DIRECTION], :, 0] = ideal_map(data.pairs.lens, data.encoding, method)
    ab[STOP, :, 0] = fit_stop(data, features_of(exponents[:1]))
    return InvariantPolynomial(exponents, ab.numpy(), fit_scalars(data, exponents).numpy())
