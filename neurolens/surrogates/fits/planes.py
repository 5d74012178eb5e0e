"""Which two planes describe the rays best: those in which the fewest terms tell the lens.

A ray's crossings with any two planes carry the same information, and a polynomial of full degree in them spans the same
functions, because the change is linear. A sparse one does not: the variables of the fit should follow the lens's own
(its field, and where the ray crosses its stop). So the p plane and the multiple of p that is taken from u are searched,
for the least film-equivalent residual of a sparse fit. Nothing changes in the evaluator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import torch

from neurolens.surrogates.bases import invariant_exponents, monomials
from neurolens.surrogates.fits.selection import Sweep, backward, forward
from neurolens.surrogates.model import Encoding
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.surrogates.targets import targets_of, weighed_apart

# A trial fit: rays, degree of its candidates, terms before elimination over terms kept.
_RAYS, _DEGREE, _SURPLUS = 2500, 7, 1.5
# Trials start from these multiples of u in p and of p in u (scaled, see `shifted`), and go on by halved steps.
_START = tuple(product((-0.6, -0.3, 0.0, 0.3), (-0.2, 0.0, 0.2, 0.4)))
_STEPS = (0.12, 0.06, 0.03)
_FARTHEST = 1.5

Shift = tuple[float, float]


def shifted(encoding: Encoding, passing: PairSet, shift: Shift) -> Encoding:
    """The encoding with q = p - m u for p and u - k q for u, for shift (k, m), scaled by the rays of `passing`.

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
    scales = (float(v.norm(dim=0).max()) for v in (p, u - moved.chief * p))
    film_scale, pupil_scale = scales
    return replace(moved, film_scale_mm=film_scale, pupil_scale_mm=pupil_scale)


def _weights(encoding: Encoding, m: float) -> tuple[float, float]:
    """The weights of p0 and u0, the crossings in mm, in p - m u, with p = p0 / P and u = (u0 - c p0) / U."""
    from_u = m / encoding.pupil_scale_mm
    return 1 / encoding.film_scale_mm + encoding.chief * from_u, -from_u


def _proper(encoding: Encoding, shift: Shift) -> bool:
    """Whether the moved p plane is neither the u plane nor at infinity, nor far from where it was."""
    p_weight, u_weight = _weights(encoding, shift[1])
    least = 0.05 / encoding.film_scale_mm
    return max(map(abs, shift)) <= _FARTHEST and p_weight > least and abs(p_weight + u_weight) > least


def fit_planes(pairs: RayPairs, encoding: Encoding, terms: int, position_weight: float) -> Encoding:
    """Search the planes for a polynomial of `terms` coefficients per vector output. Deterministic.

    The encoding itself is among the trials; it comes back where none does better, or where there are too few rays for
    a trial to mean anything.
    """
    rays = pairs.train.select(slice(0, _RAYS))
    if encoding.mirror or len(rays) < 4 * _SURPLUS * terms:
        return encoding
    trial = _trial(pairs, encoding, rays, terms, position_weight)
    known: dict[Shift, float] = {}

    def at(shift: Shift) -> float:
        if shift not in known:
            known[shift] = trial(shift) if _proper(encoding, shift) else math.inf
        return known[shift]

    best = min(_START, key=at)
    for step in _STEPS:
        while True:
            k, m = best
            around = [(k + step, m), (k - step, m), (k, m + step), (k, m - step)]
            nearby = min(around, key=at)
            if at(nearby) >= at(best):
                break
            best = nearby
    return encoding if best == (0.0, 0.0) else shifted(encoding, pairs.train, best)


def _trial(
    pairs: RayPairs, encoding: Encoding, rays: PairSet, terms: int, position_weight: float
) -> Callable[[Shift], float]:
    targets = targets_of(pairs.lens, encoding, rays)
    outputs = weighed_apart(pairs.lens, pairs.domain, targets.vectors, position_weight)
    exponents = invariant_exponents(_DEGREE, dispersive=encoding.dispersive)

    def residual(shift: Shift) -> float:
        moved = shifted(encoding, rays, shift)
        field = moved(rays.inputs)
        if not bool(torch.isfinite(field.p).all() & torch.isfinite(field.u).all()):
            return math.inf
        sweep = Sweep.of_vectors(monomials(field.invariants(), exponents), field, outputs)
        forward(sweep, math.ceil(_SURPLUS * terms))
        backward(sweep, terms)
        return sweep.residual

    return residual
