"""Newton's method for many small systems at once, limited so that no start makes it diverge.

Plain Newton iterations of a fixed count, as published for lens polynomials, run away where a step leaves the data. Here
a step is never longer than a limit, a point that is worse than the best one so far is given up for a shorter step from
that one, and what is returned is the best point seen.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

# Residuals [K, N] and their Jacobian [K, K, N] at points [K, N].
Evaluate = Callable[[Tensor], tuple[Tensor, Tensor]]

# A step that did not help is tried again at this share of its length.
SHORTER = 0.25
# The unknowns stay within this, each: scaled so that passing rays fill the unit disc.
REACH = 2.0


class Solved(NamedTuple):
    """Points [K, N], their Jacobian [K, K, N], and the length of their residual [N] (infinite where not finite)."""

    x: Tensor
    jacobian: Tensor
    residual: Tensor


def limited_newton(evaluate: Evaluate, start: Tensor, steps: int, limit: float, reach: float = REACH) -> Solved:
    """Newton's method from `start` [K, N], `steps` steps for every column.

    Args:
        limit: longest step, in units of the unknowns. reach: the unknowns stay within this, each.
    """
    x = start.clamp(-reach, reach)
    residual, jacobian = evaluate(x)
    best = Solved(x, jacobian, _length(residual))
    step = _step(jacobian, residual, limit)
    for _ in range(steps):
        x = (best.x + step).clamp(-reach, reach)
        residual, jacobian = evaluate(x)
        size = _length(residual)
        better = size < best.residual
        best = Solved(
            torch.where(better, x, best.x),
            torch.where(better, jacobian, best.jacobian),
            torch.where(better, size, best.residual),
        )
        step = torch.where(better, _step(jacobian, residual, limit), step * SHORTER)
    return best


def _length(residual: Tensor) -> Tensor:
    size = residual.norm(dim=0)
    return torch.where(torch.isfinite(size), size, torch.inf)


def _step(jacobian: Tensor, residual: Tensor, limit: float) -> Tensor:
    step = -solve_small(jacobian, residual)
    length = step.norm(dim=0)
    step = step * (limit / length.clamp_min(limit))
    # A singular Jacobian gives no direction: the point stays where it is.
    return torch.where(torch.isfinite(step).all(0), step, 0.0)


def solve_small(a: Tensor, b: Tensor) -> Tensor:
    """x [K, N] of a x = b, for a [K, K, N], b [K, N] and K of 2 or 4; not finite where a is singular.

    Four unknowns are solved in blocks of two, the last two first out: their own block must not be singular.
    """
    if len(b) == 2:
        return _cramer(a, b)
    right = inverse_2(a[2:, 2:])
    carry = _multiply(a[:2, 2:], right)  # first rows over the last block
    schur = a[:2, :2] - _multiply(carry, a[2:, :2])
    first = _cramer(schur, b[:2] - _apply(carry, b[2:]))
    return torch.cat([first, _apply(right, b[2:] - _apply(a[2:, :2], first))])


def determinant(a: Tensor) -> Tensor:
    """[N] determinants of a [K, K, N], K of 2 or 4."""
    if len(a) == 2:
        return a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return torch.linalg.det(a.permute(2, 0, 1))


def inverse_2(a: Tensor) -> Tensor:
    """Inverses of a [2, 2, N]."""
    rows = torch.stack([torch.stack([a[1, 1], -a[0, 1]]), torch.stack([-a[1, 0], a[0, 0]])])
    return rows / determinant(a)


def _cramer(a: Tensor, b: Tensor) -> Tensor:
    inverse = 1 / determinant(a)
    return torch.stack([a[1, 1] * b[0] - a[0, 1] * b[1], a[0, 0] * b[1] - a[1, 0] * b[0]]) * inverse


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    return torch.einsum("ijn,jkn->ikn", a, b)


def _apply(a: Tensor, b: Tensor) -> Tensor:
    return torch.einsum("ijn,jn->in", a, b)
