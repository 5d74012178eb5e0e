"""Polynomial surrogates: dense, matching pursuit, orthogonal least squares with replacement, adaptive growth.

One support serves position and direction, chosen by the film-equivalent error in the nearest focused plane and at
infinity. The stop crossing, the transmittance and the gates are then fitted on the monomials that are computed anyway.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from neurolens import status as st
from neurolens.errors import InputError
from neurolens.surrogates.bases import (
    Exponents,
    invariant_exponents,
    monomials,
    raw_exponents,
    raw_variables,
    solve,
    vector_columns,
    vector_gram,
)
from neurolens.surrogates.cores import Basis, InvariantPolynomial, RawPolynomial
from neurolens.surrogates.gates import boundary_rays, gate_reach, gate_values
from neurolens.surrogates.growth import grow
from neurolens.surrogates.lightfield import Encoding, LightField
from neurolens.surrogates.model import DIRECTION, POSITION, STOP, Gate
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.surrogates.selection import Sweep, forward, matching_pursuit, replace_terms
from neurolens.surrogates.targets import Targets, film_equivalent, targets_of

Method = Literal["dense", "omp", "ols", "adaptive"]

# Only the neighbourhood of a rim decides who passes: rows of the gate fit weigh 1 / sqrt(1 + (g / width)^2).
GATE_WIDTH = 0.1


@dataclass(frozen=True)
class PolynomialSettings:
    """How a polynomial is fitted.

    Attributes:
        method: "dense" (all terms up to `degree`), "omp" (matching pursuit), "ols" (orthogonal least squares with
            replacement), "adaptive" (terms of any degree grown from chosen terms).
        basis: "invariants" (rotational symmetry held exactly) or "raw" (p_x, p_y, u_x, u_y, w).
        terms: coefficients per vector output; ignored by "dense".
        degree: largest total degree of the candidates; ignored by "adaptive".
        replacement: whether "ols" exchanges terms afterwards.
    """

    method: Method = "ols"
    basis: Basis = "invariants"
    terms: int = 40
    degree: int = 7
    replacement: bool = True


@dataclass(frozen=True)
class FitData:
    """What every polynomial fit of one set of ray pairs shares."""

    pairs: RayPairs
    encoding: Encoding
    gates: tuple[Gate, ...]

    @property
    def train(self) -> Targets:
        return targets_of(self.pairs.lens, self.encoding, self.pairs.train)

    @cached_property
    def boundary(self) -> PairSet:
        """The rays on which gates and the stop crossing are fitted."""
        return boundary_rays(self.pairs, self.gates)

    @property
    def boundary_field(self) -> LightField:
        return self.encoding(self.boundary.inputs)


def fit_polynomial(
    pairs: RayPairs, encoding: Encoding, gates: tuple[Gate, ...], settings: PolynomialSettings
) -> InvariantPolynomial | RawPolynomial:
    """Fit by one of the methods of `PolynomialSettings`.

    Raises:
        InputError: an unknown method or basis, fewer than two terms, a negative degree, or too few training rays.
    """
    for name, value, known in (
        ("method", settings.method, get_args(Method)),
        ("basis", settings.basis, get_args(Basis)),
    ):
        if value not in known:
            raise InputError("fit", name, value, f"one of {', '.join(known)}")
    if settings.terms < 2:
        raise InputError("fit", "terms", settings.terms, "at least 2 coefficients per vector output")
    if settings.degree < 0:
        raise InputError("fit", "degree", settings.degree, "a total degree of 0 or more")
    if len(pairs.train) <= settings.terms:
        raise InputError("fit", "train", len(pairs.train), f"more training rays than the {settings.terms} terms")
    data = FitData(pairs, encoding, gates)
    return _fit_invariant(data, settings) if settings.basis == "invariants" else _fit_raw(data, settings)


def _fit_invariant(data: FitData, settings: PolynomialSettings) -> InvariantPolynomial:
    train = data.train
    invariants, outputs = train.field.invariants(), film_equivalent(data.pairs.lens, data.pairs.domain, train.vectors)
    dispersive = data.encoding.w_half != 0
    exponents = invariant_exponents(settings.degree, dispersive=dispersive)
    if settings.method == "adaptive":
        exponents, chosen = grow(invariants, train.field, outputs, settings.terms, dispersive=dispersive)
    else:
        features = monomials(invariants, exponents)
        gram, moments = vector_gram(features, train.field, outputs)
        chosen = _choose(Sweep(gram, moments, _squares(outputs)), settings)
    count = len(exponents)
    kept = sorted({k % count for k in chosen})
    place = {k: i for i, k in enumerate(kept)}
    exponents = exponents[kept]
    features = monomials(invariants, exponents)
    # The chosen columns only; position and direction share them.
    columns = [place[k % count] + (k >= count) * len(kept) for k in chosen]
    coefficients = solve(vector_columns(features, train.field)[columns], train.vectors[:2].flatten(1))
    ab = torch.zeros((3, 2 * len(kept)), dtype=torch.float64)
    ab[:2, columns] = coefficients
    ab[STOP] = fit_stop(data, exponents)
    return InvariantPolynomial(exponents, ab.reshape(3, 2, -1), fit_scalars(data, exponents))


def _choose(sweep: Sweep, settings: PolynomialSettings) -> list[int]:
    if settings.method == "dense":
        return list(range(sweep.count))
    forward(sweep, settings.terms, "omp" if settings.method == "omp" else "ols")
    if settings.method == "ols" and settings.replacement:
        replace_terms(sweep)
    return sorted(sweep.chosen)


def _squares(outputs: Tensor) -> np.ndarray:
    return (outputs.flatten(1) ** 2).sum(1).numpy()


def fit_stop(data: FitData, exponents: Exponents) -> Tensor:
    """[2 M]: A and B of the stop crossing (in stop radii) on the monomials given, from rays on both sides of rims."""
    crossing, weight = _stop_crossing(data)
    field = data.boundary_field
    columns = vector_columns(monomials(field.invariants(), exponents), field)
    return solve(columns, crossing.reshape(1, -1), None if weight is None else weight.repeat(2))[0]


def _stop_crossing(data: FitData) -> tuple[Tensor, Tensor | None]:
    """[2, N] crossings of the boundary rays in stop radii, and their weights [N]: 0 for rays lost before the stop."""
    pairs, lens = data.boundary, data.pairs.lens
    crossing = torch.stack([pairs.cross_x[lens.stop_index], pairs.cross_y[lens.stop_index]]) / lens.stop_radius_mm
    arrives = gate_reach((Gate(lens.stop_index, st.RIM),), pairs)[0]
    return crossing, None if arrives.all() else arrives.to(crossing.dtype)


def fit_scalars(data: FitData, exponents: Exponents) -> Tensor:
    """[1 + G, M]: transmittance and gates on the monomials of the invariants given."""
    train = data.train
    boundary_features = monomials(data.boundary_field.invariants(), exponents)
    return _scalars(data, monomials(train.field.invariants(), exponents), train.transmittance, boundary_features)


def _scalars(data: FitData, features: Tensor, transmittance: Tensor, boundary_features: Tensor) -> Tensor:
    """Transmittance on the passing rays, each gate on the rays that get as far, most on those near its boundary."""
    rows = [solve(features, transmittance[None])]
    values, known = gate_values(data.pairs.lens, data.gates, data.boundary), gate_reach(data.gates, data.boundary)
    for value, arrives in zip(values, known, strict=True):
        weight = (1 / torch.sqrt(1 + (value / GATE_WIDTH) ** 2)).where(arrives, 0.0)
        rows.append(solve(boundary_features, value[None], weight))
    return torch.cat(rows)


def _fit_raw(data: FitData, settings: PolynomialSettings) -> RawPolynomial:
    """Every component with a support of its own, as published, half of `terms` each; one more for the scalars."""
    train = data.train
    # Supports are chosen on the rays near the rims, where every output has a value; coefficients on all boundary rays.
    rim = data.pairs.rim
    variables, rim_variables = raw_variables(train.field), raw_variables(data.encoding(rim.inputs))
    dispersive = data.encoding.w_half != 0
    half = replace(settings, terms=max(settings.terms // 2, 1))
    supports: dict[str, Exponents] = {}
    stop = data.pairs.lens.stop_index
    crossing = torch.stack([rim.cross_x[stop], rim.cross_y[stop]]) / data.pairs.lens.stop_radius_mm
    gates = gate_values(data.pairs.lens, data.gates, rim)
    wanted = {"scalars": (rim_variables, torch.cat([gates, rim.transmittance[None]]))}
    for axis in (0, 1):
        wanted[f"stop {axis}"] = (rim_variables, crossing[axis][None])
        for vector in (POSITION, DIRECTION):
            wanted[f"{vector} {axis}"] = (variables, train.vectors[vector, axis][None])
    for name, (inputs, outputs) in wanted.items():
        supports[name] = _raw_support(inputs, outputs, half, dispersive)
    place: dict[tuple[int, ...], int] = {}
    columns = {n: [place.setdefault(tuple(map(int, e)), len(place)) for e in s] for n, s in supports.items()}
    exponents = np.array(list(place), dtype=np.int64)
    features, boundary = monomials(variables, exponents), monomials(raw_variables(data.boundary_field), exponents)
    crossing, weight = _stop_crossing(data)
    components = torch.zeros((3, 2, len(place)), dtype=torch.float64)
    for axis in (0, 1):
        for vector in (POSITION, DIRECTION):
            at = columns[f"{vector} {axis}"]
            components[vector, axis, at] = solve(features[at], train.vectors[vector, axis][None])[0]
        at = columns[f"stop {axis}"]
        components[STOP, axis, at] = solve(boundary[at], crossing[axis][None], weight)[0]
    at = columns["scalars"]
    scalars = torch.zeros((1 + len(data.gates), len(place)), dtype=torch.float64)
    scalars[:, at] = _scalars(data, features[at], train.transmittance, boundary[at])
    return RawPolynomial(exponents, components, scalars)


def _raw_support(variables: Tensor, outputs: Tensor, settings: PolynomialSettings, dispersive: bool) -> Exponents:
    """Exponents [K, 5] chosen for outputs [R, N] in common."""
    # Outputs count by how much they vary: transmittance varies little about a large mean, which one term explains.
    outputs = outputs / (outputs - outputs.mean(1, keepdim=True)).norm(dim=1, keepdim=True).clamp_min(1e-300)
    if settings.method == "adaptive":
        exponents, chosen = grow(variables, None, outputs[:, None], settings.terms, dispersive=dispersive)
        return exponents[chosen]
    exponents = raw_exponents(settings.degree, dispersive=dispersive)
    features = monomials(variables, exponents)
    gram, moments = (features @ features.T).numpy(), (features @ outputs.T).numpy()
    if settings.method == "omp" and len(outputs) == 1:
        return exponents[matching_pursuit(gram, moments[:, 0], settings.terms)]
    return exponents[_choose(Sweep(gram, moments, _squares(outputs)), settings)]
