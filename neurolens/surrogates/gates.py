"""Boundaries that block rays: which rims and discriminants a model must test, their exact values, and rays near them.

A rim is tested on the ray's crossing with it. Where rays end by missing a surface or by total reflection there is no
crossing; there the sign of what stands under the square root (of the intersection, or of Snell's law) decides. It is
smooth across the boundary, for it depends only on the ray that arrives.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.lens.prescription import Lens, Surface
from neurolens.surrogates.model import Gate
from neurolens.surrogates.pairs import RIM_REACH, PairSet, RayPairs, join_pairs, reached
from neurolens.trace.shapes import is_deep, rim_sine

# Rays of the boundary fits are mixed by this seed: networks use the first of them.
_MIXING_SEED = 1
# Gates of either kind; rims end when this share of the blocked rays, discriminants when this share of all rays is left.
_MOST_GATES, _UNEXPLAINED = 10, 1e-4

# Only the neighbourhood of a boundary decides who passes: weights fall off beyond this distance from it, in units of
# the gate (half as much of a rim's radius).
BOUNDARY_WIDTH = 0.03
# The stop crossing is wanted to the same share of the opening down to this one, in stop radii: four stops.
STOPPED_DOWN = 0.25

# A far ray that a fit lets pass is given this value of a gate, or its own where that is less than a rim radius twice
# over; first with this weight, which doubles while it still passes, up to the last.
_TARGET, _MOST_TARGET = 0.1, 1.0
_WEIGHT, _MOST_WEIGHT = 0.03, 1.0
_ROUNDS = 8
_RIDGE, _DEPENDENT = 1e-13, 1e-12  # relative


def gate_reach(gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """[G, N] bool: rays of which the gate's value is known, because they get as far as its surface (and to its rim)."""
    known = reached(pairs)
    rows = [known[g.surface] & (pairs.meets[g.surface] > 0 if g.reason == st.RIM else True) for g in gates]
    return torch.stack(rows) if rows else torch.empty((0, len(pairs)), dtype=torch.bool)


def gate_values(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """[G, N] exact values of the gates, positive where the surface stops the ray; 0 where it never gets there."""
    rows = []
    for gate in gates:
        k = gate.surface
        if gate.reason == st.RIM:
            rows.append(_beyond_rim(lens.surfaces[k], torch.hypot(pairs.cross_x[k], pairs.cross_y[k])))
        else:
            rows.append(-(pairs.meets[k] if gate.reason == st.MISSED else pairs.refracts[k]))
    if not rows:
        return torch.empty((0, len(pairs)), dtype=pairs.transmittance.dtype)
    return torch.where(gate_reach(gates, pairs), torch.stack(rows), 0.0)


def _beyond_rim(surface: Surface, height: Tensor) -> Tensor:
    """[N] a rim's gate at crossings `height` [N] mm from the axis: squares over the rim's, less 1.

    Where the rays that tell of a rim go on to its sphere's equator the square turns there, and a fit of it tells
    nothing: there it is the depth over the rim's, which to first order is the same and never turns.
    """
    if not (is_deep(surface) and RIM_REACH * rim_sine(surface) > 1):
        return height**2 / surface.semi_diameter_mm**2 - 1
    sine = height * abs(surface.curvature)
    near = sine <= 1
    cosine = torch.sqrt((1 - torch.where(near, sine, 2 - sine) ** 2).clamp_min(0.0))
    depth = 1 - torch.where(near, cosine, -cosine)
    return depth / (1 - math.sqrt(1 - rim_sine(surface) ** 2)) - 1


def boundary_weights(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> tuple[Tensor, Tensor]:
    """What rays of `boundary_rays` count in the fits of the gates [G, N] and of the stop crossing [N].

    A gate decides where its value is near 0 and no other boundary stops the ray; the stop crossing counts wherever the
    ray passes, for the stop may be closed, and the more the nearer to the middle, for an error there is to a smaller
    opening. Rays lost before a boundary say nothing of it and weigh 0.
    """
    every = (*gates, Gate(lens.stop_index, st.RIM))
    values, known = gate_values(lens, every, pairs), gate_reach(every, pairs)
    beyond = values.where(known, 0.0).clamp_min(0.0)
    rows = []
    for i, value in enumerate(values):
        others = torch.cat([beyond[:i], beyond[i + 1 :]])
        stopped = others.amax(0) if len(others) else torch.zeros_like(value)
        distance = value if i < len(gates) else beyond[i]
        rows.append((_near(distance) * _near(stopped)).where(known[i], 0.0))
    opening = torch.sqrt((values[-1] + 1).clamp_min(0.0)).where(known[-1], 1.0)
    rows[-1] *= (1 + STOPPED_DOWN) / (opening + STOPPED_DOWN)
    return torch.stack(rows[:-1]) if gates else values[:0], rows[-1]


def _near(distance: Tensor) -> Tensor:
    return 1 / torch.sqrt(1 + (distance / BOUNDARY_WIDTH) ** 2)


def boundary_rays(pairs: RayPairs, gates: tuple[Gate, ...]) -> PairSet:
    """The rays that the gates are fitted on: those near the rims, and with them lost rays where a gate is about those.

    Fits without such a gate see no lost ray.
    """
    if all(gate.reason == st.RIM for gate in gates) or not len(pairs.edge):
        return pairs.rim
    both = join_pairs([pairs.rim, pairs.edge])
    return both.select(torch.randperm(len(both), generator=torch.Generator().manual_seed(_MIXING_SEED)))


def choose_gates(lens: Lens, blocked: PairSet, drawn: int | None = None) -> tuple[Gate, ...]:
    """The boundaries that block anything in the domain: the one that explains most blocked rays, then the next.

    Rims come first, by the rays that refract all the way; then, for what the rims leave, discriminants. A gate of total
    reflection covers the rays that miss the same surface, whose discriminant is lower still.

    Args:
        blocked: rays that did not pass, drawn uniformly over the domain.
        drawn: how many were drawn to find them; None: only they.

    Returns the gates in the order in which camera rays meet them. The stop is no gate: it is tested on its crossing.
    """
    known = reached(blocked)
    radii = torch.tensor(lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    outside = ((blocked.cross_x**2 + blocked.cross_y**2) > radii**2) & known & (blocked.meets > 0)  # [S, N]
    whole = ((blocked.meets > 0) & (blocked.refracts > 0)).all(0)
    left = outside[:, whole & ~outside[lens.stop_index]]
    rims = _greedy(left, math.floor(_UNEXPLAINED * int(whole.sum())))
    stopped = outside[[*rims, lens.stop_index]].any(0)
    # Rows: total reflection, then missed. The first of equals is taken.
    lost = torch.cat([known & ~(blocked.refracts > 0), known & ~(blocked.meets > 0)])
    edges = _greedy(lost[:, ~stopped], math.floor(_UNEXPLAINED * (drawn or len(blocked))))
    count = len(lens.surfaces)
    gates = [Gate(k, st.RIM) for k in rims]
    gates += [Gate(k % count, st.TOTAL_REFLECTION if k < count else st.MISSED) for k in edges]
    return tuple(sorted(gates, key=lambda g: (-g.surface, g.reason)))


def _greedy(stops: Tensor, enough: int) -> list[int]:
    """Rows of [K, N] bool: the one with most entries, then the one with most of the rest, until `enough` or fewer."""
    chosen: list[int] = []
    while stops.shape[1] and len(chosen) < _MOST_GATES:
        counts = stops.sum(1)
        best = int(counts.argmax())
        if int(counts[best]) <= max(0, enough):
            break
        chosen.append(best)
        stops = stops & ~stops[best]
    return chosen


def explained(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """[N] bool: rays that a gate, exact, or the stop would stop."""
    stop = Gate(lens.stop_index, st.RIM)
    return (gate_values(lens, (*gates, stop), pairs) > 0).any(0)


class GateFit:
    """Gates [G] on common features [M, N], each with weights of its own."""

    def __init__(self, features: Tensor, values: Tensor, weights: Tensor) -> None:
        """Fit values [G, N] with weights [G, N]."""
        # In orthogonal columns, so that normal equations keep their digits; what depends on others is left out.
        norms = features.norm(dim=1).clamp_min(1e-300)
        _, sizes, right = torch.linalg.svd(torch.linalg.qr((features / norms[:, None]).T)[1], full_matrices=False)
        kept = sizes > _DEPENDENT * sizes[:1]  # the largest, where there is any ray
        self._turn = (right[kept] / sizes[kept, None]).T / norms[:, None] * math.sqrt(features.shape[1])  # [M, K]
        columns = features.T @ self._turn
        self._grams, self._moments = [], []
        for value, weight in zip(values, weights, strict=True):
            rows = columns * weight[:, None]
            self._grams.append(rows.T @ rows)
            self._moments.append(rows.T @ (value * weight))
        self._found = [self._solve(g) for g in range(len(values))]

    def _solve(self, gate: int) -> Tensor:
        gram = self._grams[gate]
        ridge = _RIDGE * gram.diagonal().mean() + 1e-300
        return torch.linalg.solve(gram + ridge * torch.eye(len(gram), dtype=gram.dtype), self._moments[gate])

    def coefficients(self) -> Tensor:
        """[G, M]."""
        found = torch.stack(self._found) if self._found else torch.empty((0, self._turn.shape[1]), dtype=torch.float64)
        return found @ self._turn.T

    def block(self, features: Tensor, values: Tensor, known: Tensor) -> None:
        """Fit again until rays that do not pass are blocked by one gate at least.

        Args:
            features: [M, N] of those rays.
            values: [G, N] of the gates, where `known` [G, N]. A gate that does not block a ray is never made to; one
                whose value is not known, because the ray ends before it, may be.
        """
        blocks = (values > 0) | ~known
        if not values.numel():
            return
        columns = features.T @ self._turn
        said = torch.stack([columns @ f for f in self._found])
        weight = torch.zeros_like(values)
        for _ in range(_ROUNDS):
            passing = (said <= 0).all(0) & blocks.any(0)
            if not passing.any():
                return
            # The gate that blocks it truly, before others; of several the one that is nearest to saying so.
            rank = torch.where(blocks, said, -math.inf) + torch.where(known & (values > 0), 1e6, 0.0)
            gate = rank.argmax(0)
            for g in range(len(values)):
                at = torch.nonzero(passing & (gate == g))[:, 0]
                if not len(at):
                    continue
                heavier = (2 * weight[g, at]).clamp(_WEIGHT, _MOST_WEIGHT)
                # Rows add to what is summed already: the weight's square grows by the difference.
                more = torch.sqrt(heavier**2 - weight[g, at] ** 2)
                weight[g, at] = heavier
                target = torch.where(known[g, at], values[g, at].clamp(_TARGET, _MOST_TARGET), _TARGET)
                rows = columns[at] * more[:, None]
                self._grams[g] = self._grams[g] + rows.T @ rows
                self._moments[g] = self._moments[g] + rows.T @ (target * more)
                self._found[g] = self._solve(g)
                said[g] = columns @ self._found[g]
