"""Fits of the stop crossing and the gates, which follow those of position and direction.

Polynomials use the terms that position and direction have anyway, networks their last hidden layer. Both get more terms
where the boundaries need them. The transmittance is fitted afterwards (`models.transmittance`).
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.models.cores import STOP, InvariantPolynomial, LightField
from neurolens.models.targets import Prepared, gate_reach, gate_values
from neurolens.models.terms import (
    Exponents,
    Sweep,
    further,
    invariant_exponents,
    monomials,
    solve,
    vector_columns,
)

# Terms are added for boundaries until each is met to this RMS: of a gate (twice the relative radius of a rim), and of
# the stop crossing in stop radii.
GATE_ERROR, STOP_ERROR = 2e-3, 5e-4
STOP_KEPT = 0.04  # least share of that squared error to which a grown polynomial may be held for the stop crossing
MOST_BOUNDARY_TERMS = 64
# Polynomials drop terms of a boundary while it errs by less than this share of those errors, or by at most `_NEARLY`
# times as much as with all terms. At a quarter hardly more rays were clipped wrongly than with all terms. Networks
# clipped more, and keep all.
NEEDED_SHARE, _NEARLY = 0.25, 1.2
# Networks, whose units follow where rays go rather than what blocks them, are held to this share of those errors.
NETWORK_SHARE, MOST_NETWORK_TERMS = 1 / 3, 96
_DEGREE = 9  # of the terms among which those for boundaries are found
_RAYS = 12_000  # on which they are found
# A far ray that passes all fitted gates is added to the fit of one gate: with its own value there, kept between these
# two, or with the first where that is not known. Its weight doubles while it still passes, from the first to the last.
_TARGET, _MOST_TARGET = 0.1, 1.0
_WEIGHT, _MOST_WEIGHT = 0.03, 1.0
_ROUNDS = 8
_RIDGE, _DEPENDENT = 1e-13, 1e-12  # relative

Features = Callable[[LightField], Tensor]  # [M, N] of N rays


def features_of(exponents: Exponents, hidden: Features | None = None) -> Features:
    """Return a function from light fields to features: a hidden layer's, if any, then monomials of invariants."""

    def features(field: LightField) -> Tensor:
        own = [] if hidden is None else [hidden(field)]
        return torch.cat([*own, monomials(field.invariants(), exponents)] if len(exponents) or not own else own)

    return features


def fit_stop(data: Prepared, features: Features) -> Tensor:
    """Fit A and B [2 M] of the stop crossing (in stop radii) on M features, to rays on both sides of rims."""
    crossing, weight = stop_crossing(data)
    field = data.boundary_field
    return solve(vector_columns(features(field), field), crossing.reshape(1, -1), weight.repeat(2))[0]


def stop_crossing(data: Prepared) -> tuple[Tensor, Tensor]:
    """Return where the boundary rays cross the stop, [2, N] in stop radii, and their weights [N]."""
    pairs, lens = data.boundary, data.pairs.lens
    crossing = torch.stack([pairs.cross_x[lens.stop_index], pairs.cross_y[lens.stop_index]]) / lens.stop_radius_mm
    return crossing, data.boundary_weights[1]


def invariant_core(
    data: Prepared, exponents: Exponents, columns: Sequence[int], coefficients: Tensor, *, sparse: bool = False
) -> InvariantPolynomial:
    """Make a polynomial on these monomials, with all that is fitted on them after position and direction.

    Args:
        columns: the chosen columns, as places among m p (the first M) and m u (M more).
        coefficients: [2, C] of those columns, for position and for direction.
        sparse: whether the other outputs have only the terms that they need.
    """
    ab, features = torch.zeros((3, 2 * len(exponents)), dtype=torch.float64), features_of(exponents)
    ab[:STOP, list(columns)] = coefficients
    rest = fit_sparse(data, features) if sparse else (fit_stop(data, features), solve_scalars(data, features))
    ab[STOP], scalars = rest
    return InvariantPolynomial(exponents, ab.reshape(3, 2, -1).numpy(), scalars.numpy())


def fit_sparse(data: Prepared, features: Features) -> tuple[Tensor, Tensor]:
    """Fit as `fit_stop` ([2 M]) and `solve_scalars` ([1 + G, M]) do, each output on the features that it needs."""
    stop, *gates = (fit.needed() for fit in _boundary_fits(data, features))
    crossing, weight = stop_crossing(data)
    rows = vector_columns(features(data.boundary_field), data.boundary_field)
    found = rows.new_zeros(len(rows))
    found[stop] = solve(rows[stop], crossing.reshape(1, -1), weight.repeat(2))[0]
    return found, solve_scalars(data, features, gates)


def solve_scalars(data: Prepared, features: Features, kept: Sequence[list[int]] | None = None) -> Tensor:
    """Fit coefficients [1 + G, M]: the transmittance to passing rays, then each gate to the rays that reach it.

    The rays that a gate decides weigh most.

    Args:
        kept: the features that each gate may use; None: all.

    Raises:
        InputError: there are no more rays near the boundaries than terms.
    """
    pairs = data.pairs
    train, near, far = (features(data.encoding(rays.inputs)) for rays in (pairs.train, data.boundary, pairs.far))
    if len(data.boundary) <= len(train):
        raise InputError(
            "settings", "pairs.rim", len(data.boundary), f"more rays near the rims than the {len(train)} terms"
        )
    fit = GateFit(near, gate_values(pairs.lens, data.gates, data.boundary), data.boundary_weights[0], kept)
    fit.block(far, gate_values(pairs.lens, data.gates, pairs.far), gate_reach(data.gates, pairs.far))
    return torch.cat([solve(train, pairs.train.transmittance[None]), fit.coefficients()])


def boundary_terms(data: Prepared, exponents: Exponents, first: Exponents, hidden: Features | None = None) -> Exponents:
    """Choose further exponents [K, 4], where the given ones [M, 4] fit the stop crossing or a gate badly; often none.

    Terms are selected forwards by their gain over all those boundaries together. The gain of each boundary counts in
    squares of the error that it may have.

    Args:
        first: the exponents before growth, which serves position and direction alone. Where these fit the stop
            crossing better than asked, all terms together must fit it as well.
        hidden: the features of a network's last hidden layer; with them the errors asked for are smaller.
    """
    added = further(invariant_exponents(_DEGREE, dispersive=data.encoding.dispersive), exponents)
    allowed, most, share = 1.0, MOST_BOUNDARY_TERMS, 1.0
    if hidden is not None:
        allowed, most = NETWORK_SHARE**2, MOST_NETWORK_TERMS
    if not np.array_equal(first, exponents[: len(first)]):
        stop = _boundary_fits(data, features_of(first), which=[0])[0]
        share = min(max(stop.error, STOP_KEPT), 1.0)
    fits = _boundary_fits(data, features_of(exponents, hidden), stop_share=share)
    bad = [k for k, fit in enumerate(fits) if fit.error > allowed]
    if not bad:
        return added[:0]
    start, features = fits[0].terms, features_of(np.concatenate([exponents, added]), hidden)
    fits = _boundary_fits(data, features, start, bad, share)
    return added[[k - start for k in _selected(fits, min(most, len(added)), allowed)]]


class _BoundaryFit:
    """One boundary's normal equations, with `blocks` columns for each term (two for A and B of a vector, or one)."""

    def __init__(self, sweep: Sweep, terms: int, scale: float, start: int) -> None:
        """Take the first `start` of the terms in; `scale` turns the squared error that is allowed into 1."""
        self.sweep, self.terms, self.scale, self.blocks = sweep, terms, scale, sweep.count // terms
        for term in range(start):
            self.add(term)

    @property
    def error(self) -> float:
        """Return the mean squared error over the square of the one allowed."""
        return self.sweep.residual * self.scale

    def add(self, term: int) -> None:
        for column in range(term, self.sweep.count, self.terms):
            if self.sweep.scores("ols")[column] > 0:
                self.sweep.add(column)

    def needed(self) -> list[int]:
        """Return the columns left when the cheapest are dropped one by one, as long as the error allows it."""
        sweep, most = self.sweep, max(NEEDED_SHARE**2, _NEARLY * self.error)
        while len(sweep.chosen) > 1 and self.error + float((costs := sweep.costs()).min()) * self.scale <= most:
            sweep.drop(sweep.chosen[int(costs.argmin())])
        return sorted(sweep.chosen)

    def scores(self) -> np.ndarray:
        return self.scale * np.maximum(self.sweep.scores("ols"), 0.0).reshape(self.blocks, self.terms).sum(0)


def needed_for(sweep: Sweep, error: float) -> list[int]:
    """Return the smallest set of columns (A and B of a vector) whose squared residual is at most `error`.

    Where even all columns leave more than that, the set may leave hardly more than all columns do.
    """
    sweep.restart([])
    terms = sweep.count // 2
    return _BoundaryFit(sweep, terms, NEEDED_SHARE**2 / max(error, 1e-300), terms).needed()


def _selected(fits: list[_BoundaryFit], most: int, allowed: float) -> list[int]:
    """Select terms forwards until no fit errs by more than allowed, or no term helps."""
    chosen: list[int] = []
    while fits and len(chosen) < most:
        scores = np.sum([fit.scores() for fit in fits], axis=0)
        best = int(np.argmax(scores))
        if not scores[best] > 0:
            break
        chosen.append(best)
        for fit in fits:
            fit.add(best)
        fits = [fit for fit in fits if fit.error > allowed]
    return chosen


def _boundary_fits(
    data: Prepared, features: Features, start: int | None = None, which: list[int] | None = None, stop_share: float = 1
) -> list[_BoundaryFit]:
    """Fit the stop crossing and every gate, or `which` of them, with the first `start` terms taken in.

    `stop_share`: what share of the squared error otherwise allowed the stop crossing may have.
    """
    crossing, weight = stop_crossing(data)
    values, weights = gate_values(data.pairs.lens, data.gates, data.boundary), data.boundary_weights[0]
    field = LightField(*(c[..., :_RAYS] for c in data.boundary_field))
    seen, fits = features(field), []
    terms, rays = seen.shape
    for k in range(1 + len(values)) if which is None else which:
        w = (weights[k - 1] if k else weight)[:rays]
        if k:
            sweep = Sweep.of_columns(seen * w, (values[k - 1, :rays] * w)[None])
        else:
            weighed = LightField(field.p * w, field.u * w, field.w)  # only p.p, p.u and u.u of it are used
            sweep = Sweep.of_vectors(seen, weighed, (crossing[:, :rays] * w)[None])
        allowed = (GATE_ERROR**2 if k else STOP_ERROR**2 * stop_share) * max(float((w * w).sum()), 1e-300)
        fits.append(_BoundaryFit(sweep, terms, 1 / allowed, terms if start is None else start))
    return fits


class GateFit:
    """G gates on features [M, N], each with weights of its own, and with features of its own choice."""

    def __init__(
        self, features: Tensor, values: Tensor, weights: Tensor, kept: Sequence[list[int]] | None = None
    ) -> None:
        """Fit values [G, N] with weights [G, N]; `kept`: the features that each gate may use, None for all."""
        self._terms = len(features)
        all_of_them = [_turn(features, list(range(self._terms)))] * len(values) if kept is None else []
        self._turns = all_of_them or [_turn(features, columns) for columns in kept or ()]
        self._grams, self._moments = list[Tensor](), list[Tensor]()
        for turn, value, weight in zip(self._turns, values, weights, strict=True):
            rows = features.T @ turn * weight[:, None]
            self._grams.append(rows.T @ rows)
            self._moments.append(rows.T @ (value * weight))
        self._solutions = [self._solve(g) for g in range(len(values))]

    def _solve(self, gate: int) -> Tensor:
        gram = self._grams[gate]
        ridge = _RIDGE * gram.diagonal().mean() + 1e-300
        return torch.linalg.solve(gram + ridge * torch.eye(len(gram), dtype=gram.dtype), self._moments[gate])

    def coefficients(self) -> Tensor:
        """Return the coefficients [G, M]."""
        found = [turn @ solution for turn, solution in zip(self._turns, self._solutions, strict=True)]
        return torch.stack(found) if found else torch.empty((0, self._terms), dtype=torch.float64)

    def block(self, features: Tensor, values: Tensor, reached: Tensor) -> None:
        """Fit again until at least one gate blocks each ray that does not pass.

        Args:
            features: [M, N] of those rays.
            values: [G, N] of the gates. `reached` [G, N]: whether the ray gets so far that the value is known. A gate
                is never made to block a ray that it is known to let pass; a gate that a ray does not reach may block
                it.
        """
        blocks = (values > 0) | ~reached
        if not values.numel():
            return
        columns = [features.T @ turn for turn in self._turns]
        fitted = torch.stack([c @ solution for c, solution in zip(columns, self._solutions, strict=True)])
        weight = torch.zeros_like(values)
        for _ in range(_ROUNDS):
            passing = (fitted <= 0).all(0) & blocks.any(0)
            if not passing.any():
                return
            # First a gate that truly blocks it; of several the one whose fit is nearest to blocking it.
            rank = torch.where(blocks, fitted, -math.inf) + torch.where(reached & (values > 0), 1e6, 0.0)
            gate = rank.argmax(0)
            for g in range(len(values)):
                at = torch.nonzero(passing & (gate == g))[:, 0]
                if not len(at):
                    continue
                heavier = (2 * weight[g, at]).clamp(_WEIGHT, _MOST_WEIGHT)
                # Rows add to what is summed already: the weight's square grows by the difference.
                more = torch.sqrt(heavier**2 - weight[g, at] ** 2)
                weight[g, at] = heavier
                target = torch.where(reached[g, at], values[g, at].clamp(_TARGET, _MOST_TARGET), _TARGET)
                rows = columns[g][at] * more[:, None]
                self._grams[g] = self._grams[g] + rows.T @ rows
                self._moments[g] = self._moments[g] + rows.T @ (target * more)
                self._solutions[g] = self._solve(g)
                fitted[g] = columns[g] @ self._solutions[g]


def _turn(features: Tensor, kept: list[int]) -> Tensor:
    """Return a matrix [M, K] that makes orthogonal columns of the features `kept` among [M, N].

    So normal equations keep their digits. Features that depend on others are left out.
    """
    norms = features[kept].norm(dim=1).clamp_min(1e-300)
    _, triangle = torch.linalg.qr((features[kept] / norms[:, None]).T)
    _, sizes, right = torch.linalg.svd(triangle, full_matrices=False)
    large = sizes > _DEPENDENT * sizes[:1]  # relative to the largest, where there is any ray
    found = features.new_zeros((len(features), int(large.sum())))
    found[kept] = (right[large] / sizes[large, None]).T / norms[:, None] * math.sqrt(features.shape[1])
    return found
