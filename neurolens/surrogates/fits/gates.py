"""Least squares of gates that also block what lies far from every boundary, where polynomials would run away."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# A far ray that a fit lets pass is given this value of a gate, or its own where that is less than a rim radius twice
# over; first with this weight, which doubles while it still passes, up to the last.
_TARGET, _MOST_TARGET = 0.1, 1.0
_WEIGHT, _MOST_WEIGHT = 0.03, 1.0
_ROUNDS = 8
_RIDGE, _DEPENDENT = 1e-13, 1e-12  # relative


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
