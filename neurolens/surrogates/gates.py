"""Gates: the rims and discriminants that a model must test, their exact values, and the rays near them.

A rim is tested at the ray's crossing with its surface. A ray that misses a surface or is totally reflected has no
crossing; there the sign of the discriminant decides (of the intersection, or of Snell's law). It is smooth across the
boundary, because it depends only on the ray that arrives.
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


def gate_reach(gates: tuple[Gate, ...], pairs: PairSet) -> Tensor:
    """[G, N] bool: rays of which the gate's value is known, because they get as far as its surface (and to its rim)."""
    arrives = reached(pairs)
    rows = [arrives[g.surface] & (pairs.meets[g.surface] > 0 if g.reason == st.RIM else True) for g in gates]
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
    """[N] a rim's gate at crossings `height` [N] mm from the axis: the height's square over the rim's, less 1.

    On a sphere whose equator lies within reach of the rays near the rim, the square turns back there and cannot be
    fitted. The gate is then the depth over the rim's depth, less 1, which agrees to first order and never turns.
    """
    if not (is_deep(surface) and RIM_REACH * rim_sine(surface) > 1):
        return height**2 / surface.semi_diameter_mm**2 - 1
    sine = height * abs(surface.curvature)
    near = sine <= 1
    cosine = torch.sqrt((1 - torch.where(near, sine, 2 - sine) ** 2).clamp_min(0.0))
    depth = 1 - torch.where(near, cosine, -cosine)
    return depth / (1 - math.sqrt(1 - rim_sine(surface) ** 2)) - 1


def boundary_weights(lens: Lens, gates: tuple[Gate, ...], pairs: PairSet) -> tuple[Tensor, Tensor]:
    """Weights of the rays of `boundary_rays` in the fits of the gates [G, N] and of the stop crossing [N].

    A gate decides where its value is near 0 and no other boundary stops the ray. The stop crossing counts wherever the
    ray passes, because the stop may be closed, and more near the middle, where an error meets smaller openings. Rays
    that are lost before a boundary weigh 0.
    """
    every = (*gates, Gate(lens.stop_index, st.RIM))
    values, arrives = gate_values(lens, every, pairs), gate_reach(every, pairs)
    beyond = values.where(arrives, 0.0).clamp_min(0.0)
    rows = []
    for i, value in enumerate(values):
        others = torch.cat([beyond[:i], beyond[i + 1 :]])
        stopped = others.amax(0) if len(others) else torch.zeros_like(value)
        distance = value if i < len(gates) else beyond[i]
        rows.append((_near(distance) * _near(stopped)).where(arrives[i], 0.0))
    opening = torch.sqrt((values[-1] + 1).clamp_min(0.0)).where(arrives[-1], 1.0)
    rows[-1] *= (1 + STOPPED_DOWN) / (opening + STOPPED_DOWN)
    return torch.stack(rows[:-1]) if gates else values[:0], rows[-1]


def _near(distance: Tensor) -> Tensor:
    return 1 / torch.sqrt(1 + (distance / BOUNDARY_WIDTH) ** 2)


def boundary_rays(pairs: RayPairs, gates: tuple[Gate, ...]) -> PairSet:
    """The rays that the gates are fitted on: those near the rims, and lost rays where a gate is about those."""
    if all(gate.reason == st.RIM for gate in gates) or not len(pairs.edge):
        return pairs.rim
    both = join_pairs([pairs.rim, pairs.edge])
    return both.select(torch.randperm(len(both), generator=torch.Generator().manual_seed(_MIXING_SEED)))


def choose_gates(lens: Lens, blocked: PairSet, drawn: int | None = None) -> tuple[Gate, ...]:
    """The boundaries that block anything in the domain: the one that explains most blocked rays, then the next.

    Rims come first, by the rays that refract all the way; then, for what the rims leave, discriminants. A gate of total
    reflection covers the rays that miss the same surface, whose discriminant is lower still.

    Args:
        blocked: rays that did not pass, of uniform ones over the domain.
        drawn: number of those uniform rays; None: of `blocked`.

    Returns the gates in the order in which camera rays meet them. The stop is no gate: it is tested on its crossing.
    """
    arrives = reached(blocked)
    radii = torch.tensor(lens.semi_diameters_mm, dtype=torch.float64)[:, None]
    outside = ((blocked.cross_x**2 + blocked.cross_y**2) > radii**2) & arrives & (blocked.meets > 0)  # [S, N]
    whole = ((blocked.meets > 0) & (blocked.refracts > 0)).all(0)
    left = outside[:, whole & ~outside[lens.stop_index]]
    rims = _greedy(left, math.floor(_UNEXPLAINED * int(whole.sum())))
    stopped = outside[[*rims, lens.stop_index]].any(0)
    # Rows: total reflection, then missed. The first of equals is taken.
    lost = torch.cat([arrives & ~(blocked.refracts > 0), arrives & ~(blocked.meets > 0)])
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
