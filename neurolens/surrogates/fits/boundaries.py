"""What every model fits after position and direction: stop crossing, transmittance and gates.

Polynomials use the terms that are there anyway, networks their last hidden layer. Both get more terms where those do
not tell the boundaries or the transmittance well: absorption and coatings change with the wavelength faster than any
ray's path does, and near grazing rays faster with the ray.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.surrogates.bases import Exponents, invariant_exponents, monomials, solve, vector_columns
from neurolens.surrogates.cores import STOP, InvariantPolynomial
from neurolens.surrogates.fits.selection import Sweep
from neurolens.surrogates.gates import GateFit, gate_reach, gate_values
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.targets import Prepared

# Terms are added for boundaries until each is met to this RMS: of a gate (twice the relative radius of a rim), and of
# the stop crossing in stop radii.
GATE_ERROR, STOP_ERROR = 2e-3, 5e-4
STOP_KEPT = 0.04  # least share of that error, squared, to which growth may hold the stop crossing
MOST_BOUNDARY_TERMS = 64
# Networks, whose units learn where rays go rather than what blocks them, are held to this share of those errors.
NETWORK_SHARE, MOST_NETWORK_TERMS = 1 / 3, 96
_DEGREE = 9  # of the terms among which those for boundaries are found
_RAYS = 12_000  # on which they are found
TRANSMITTANCE_ERROR = 2.5e-4  # RMS at which no term is added
_TRANSMITTANCE_RAYS = 6000
_TRANSMITTANCE_DEGREE, _MOST_W = 7, 8  # of the candidates
_LEAST_GAIN = 0.03  # a term must take away this share of the squared error left


Features = Callable[[LightField], Tensor]  # [M, N] of N rays


def features_of(exponents: Exponents, hidden: Features | None = None) -> Features:
    """Monomials of the invariants, after the features of a hidden layer where there is one."""

    def features(field: LightField) -> Tensor:
        own = [] if hidden is None else [hidden(field)]
        return torch.cat([*own, monomials(field.invariants(), exponents)] if len(exponents) or not own else own)

    return features


def fit_stop(data: Prepared, features: Features) -> Tensor:
    """[2 M]: A and B of the stop crossing (in stop radii) on M features, from rays on both sides of rims."""
    crossing, weight = stop_crossing(data)
    field = data.boundary_field
    columns = vector_columns(features(field), field)
    return solve(columns, crossing.reshape(1, -1), weight.repeat(2))[0]


def stop_crossing(data: Prepared) -> tuple[Tensor, Tensor]:
    """[2, N] crossings of the boundary rays in stop radii, and their weights [N]."""
    pairs, lens = data.boundary, data.pairs.lens
    crossing = torch.stack([pairs.cross_x[lens.stop_index], pairs.cross_y[lens.stop_index]]) / lens.stop_radius_mm
    return crossing, data.boundary_weights[1]


def invariant_core(
    data: Prepared, exponents: Exponents, columns: Sequence[int], coefficients: Tensor
) -> InvariantPolynomial:
    """The polynomial on these monomials with all that is fitted on them after position and direction.

    Args:
        columns: places of the chosen ones among m p (first M) and m u (M more).
        coefficients: [2, C] of those, of position and direction.
    """
    ab = torch.zeros((3, 2 * len(exponents)), dtype=torch.float64)
    ab[:STOP, list(columns)] = coefficients
    ab[STOP] = fit_stop(data, features_of(exponents))
    return InvariantPolynomial(exponents, ab.reshape(3, 2, -1).numpy(), fit_scalars(data, exponents).numpy())


def fit_scalars(data: Prepared, exponents: Exponents) -> Tensor:
    """[1 + G, M]: transmittance and gates on the monomials of the invariants given."""
    return solve_scalars(data, features_of(exponents))


def solve_scalars(data: Prepared, features: Features) -> Tensor:
    """Transmittance on the passing rays, each gate on the rays that get as far, most on those that it decides.

    Raises:
        InputError: no more rays near the boundaries than terms.
    """
    pairs = data.pairs
    train, near, far = (features(data.encoding(rays.inputs)) for rays in (pairs.train, data.boundary, pairs.far))
    if len(data.boundary) <= len(train):
        raise InputError("fit", "rim", len(data.boundary), f"more rays near the rims than the {len(train)} terms")
    fit = GateFit(near, gate_values(pairs.lens, data.gates, data.boundary), data.boundary_weights[0])
    fit.block(far, gate_values(pairs.lens, data.gates, pairs.far), gate_reach(data.gates, pairs.far))
    return torch.cat([solve(train, pairs.train.transmittance[None]), fit.coefficients()])


def boundary_terms(data: Prepared, exponents: Exponents, first: Exponents, hidden: Features | None = None) -> Exponents:
    """[K, 4] further exponents, where those given [M, 4] meet the stop crossing or a gate badly; often none.

    Forward selection by the gain of all those boundaries together, in squares of the error that each may have.

    Args:
        first: the exponents before those were grown for position and direction alone, which takes nothing from the stop
            crossing: where those meet it better it is met as well.
        hidden: the features of a network's last hidden layer, which are held to a share of the errors.
    """
    every = invariant_exponents(_DEGREE, dispersive=data.encoding.dispersive)
    known = {tuple(e) for e in exponents.tolist()}
    added = np.array([e for e in every.tolist() if tuple(e) not in known], dtype=np.int64).reshape(-1, 4)
    candidates = np.concatenate([exponents, added])
    field = LightField(*(c[..., :_RAYS] for c in data.boundary_field))
    allowed, most, share = 1.0, MOST_BOUNDARY_TERMS, 1.0
    if hidden is not None:
        allowed, most = NETWORK_SHARE**2, MOST_NETWORK_TERMS
    if not np.array_equal(first, exponents[: len(first)]):
        (stop,) = _boundary_fits(data, field, features_of(first)(field), only=[0])
        share = min(max(stop.error, STOP_KEPT), 1.0)
    features = features_of(exponents, hidden)(field)
    met = _boundary_fits(data, field, features, stop_share=share)
    bad = [k for k, f in enumerate(met) if f.error > allowed]
    if not bad:
        return added[:0]
    start = len(features)
    fits = _boundary_fits(data, field, features_of(candidates, hidden)(field), start, bad, share)
    chosen: list[int] = []
    while fits and len(chosen) < min(most, len(added)):
        scores = np.sum([f.scores() for f in fits], axis=0)
        best = int(np.argmax(scores))
        if not scores[best] > 0:
            break
        chosen.append(best)
        for f in fits:
            f.add(best)
        fits = [f for f in fits if f.error > allowed]
    return added[[k - start for k in chosen]]


class _BoundaryFit:
    """One boundary's normal equations: `blocks` columns a term (A and B of a vector, or one)."""

    def __init__(self, sweep: Sweep, terms: int, scale: float) -> None:
        self.sweep, self.terms, self.scale, self.blocks = sweep, terms, scale, sweep.count // terms

    @property
    def error(self) -> float:
        """Mean squared error over the square of the one allowed."""
        return self.sweep.residual * self.scale

    def add(self, term: int) -> None:
        for column in range(term, self.sweep.count, self.terms):
            if self.sweep.scores("ols")[column] > 0:
                self.sweep.add(column)

    def scores(self) -> np.ndarray:
        return self.scale * np.maximum(self.sweep.scores("ols"), 0.0).reshape(self.blocks, self.terms).sum(0)


def _boundary_fits(
    data: Prepared,
    field: LightField,
    features: Tensor,
    start: int | None = None,
    only: list[int] | None = None,
    stop_share: float = 1.0,
) -> list[_BoundaryFit]:
    """The fits of the stop crossing and of every gate, or `only` some of them, with the first `start` terms in.

    `stop_share`: of the squared error that the stop crossing may have otherwise.
    """
    crossing, weight = stop_crossing(data)
    values, weights = gate_values(data.pairs.lens, data.gates, data.boundary), data.boundary_weights[0]
    rays, terms, fits = features.shape[1], len(features), []
    for k in range(1 + len(values)) if only is None else only:
        w = (weights[k - 1] if k else weight)[:rays]
        if k:
            sweep = Sweep.of_columns(features * w, (values[k - 1, :rays] * w)[None])
        else:
            weighed = LightField(field.p * w, field.u * w, field.w)  # only p.p, p.u and u.u of it are used
            sweep = Sweep.of_vectors(features, weighed, (crossing[:, :rays] * w)[None])
        allowed = (GATE_ERROR**2 if k else STOP_ERROR**2 * stop_share) * max(float((w * w).sum()), 1e-300)
        fit = _BoundaryFit(sweep, terms, 1 / allowed)
        for term in range(terms if start is None else start):
            fit.add(term)
        fits.append(fit)
    return fits


def transmittance_terms(data: Prepared, exponents: Exponents, most: int) -> Exponents:
    """[K, 4] further exponents, at most `most`, by forward selection beside those given [M, 4]; often none."""
    rays = data.pairs.train.select(slice(0, _TRANSMITTANCE_RAYS))
    none = exponents[:0]
    if most == 0 or len(rays) < 2 * (len(exponents) + most):
        return none
    invariants, wanted = data.encoding(rays.inputs).invariants(), rays.transmittance[None]
    features = monomials(invariants, exponents)
    left = wanted - solve(features, wanted) @ features
    allowed = TRANSMITTANCE_ERROR**2 * len(rays)
    if not float((left**2).sum()) > allowed:
        return none
    known = {tuple(e) for e in exponents.tolist()}
    offered = [tuple(e) for e in _candidates(dispersive=data.encoding.dispersive).tolist()]
    new = np.array([e for e in offered if e not in known], dtype=np.int64).reshape(-1, 4)
    features = monomials(invariants, np.concatenate([exponents, new]))
    sweep = Sweep.of_columns(features, wanted)
    for k in range(len(exponents)):
        if sweep.scores("ols")[k] >= 0:
            sweep.add(k)
    chosen: list[int] = []
    while len(chosen) < most and sweep.residual > allowed:
        scores = sweep.scores("ols")
        best = int(scores.argmax())
        if not scores[best] > _LEAST_GAIN * sweep.residual:
            break
        sweep.add(best)
        chosen.append(best - len(exponents))
    return new[[k for k in chosen if k >= 0]]


def _candidates(*, dispersive: bool) -> Exponents:
    plain = invariant_exponents(_TRANSMITTANCE_DEGREE, dispersive=dispersive)
    if not dispersive:
        return plain
    low = [p for p in itertools.product(range(2), repeat=3) if sum(p) <= 1]
    colours = np.array([(*p, w) for w in range(1, _MOST_W + 1) for p in low], dtype=np.int64)
    return np.unique(np.concatenate([plain, colours]), axis=0)
