"""Small networks with the symmetry of the lens (after NeuroLens, Zheng and Zheng 2017b), trained by `schedule.py`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.prescription import Lens
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, InvariantPolynomial, Network
from neurolens.surrogates.domain import Domain
from neurolens.surrogates.fits.checkpoint import Checkpoint, fingerprint
from neurolens.surrogates.fits.projection import Problem
from neurolens.surrogates.fits.schedule import Training
from neurolens.surrogates.gates import boundary_rays, boundary_weights, gate_values
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import Gate
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.surrogates.targets import film_equivalent_weights, targets_of
from neurolens.surrogates.threads import pinned_threads

# What the other outputs weigh against film-equivalent micrometres: so many um for 1 mm at the stop; and, for each mm of
# the film radius, for a transmittance of 1 and for a gate of 1 (a rim radius twice over). They only decide which
# features the hidden layers learn: the last layer is solved for each output by itself.
_STOP_UM_PER_MM, _TRANSMITTANCE_UM, _GATE_UM = 30.0, 20.0, 10.0
# Training ends at an RMS of this share of the film radius: float32 itself, which evaluates the model, has eps 1.2e-7.
_ENOUGH = 1e-7


def fit_network(
    pairs: RayPairs,
    encoding: Encoding,
    gates: tuple[Gate, ...],
    *,
    units: int = 16,
    layers: int = 2,
    seed: int = 0,
    seconds: float = 60.0,
    steps: int = 300,
    starts: int = 3,
    rays: int = 16000,
    base: InvariantPolynomial | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Network:
    """Fit a network of `layers` tanh layers of `units` units, in float64 on one thread.

    Position and direction weigh by their film-equivalent error, the stop crossing, the transmittance and the gates
    modestly. Several random starts are tried, and the best goes on.

    Args:
        pairs: half the rays come from `train`, half from those near the boundaries and beyond (`gates.boundary_rays`).
        steps: most steps of the optimiser (Levenberg-Marquardt); convergence or the time limit may end it earlier.
        seconds: limit of the training. The same seed gives the same weights bit for bit where it does not bite.
        starts: random starts.
        rays: most rays used.
        base: a polynomial whose residual is fitted instead.
        checkpoint: file that takes the state every few seconds. Where it holds that of the very same fit, training
            goes on from there, to the very same weights; a file that is damaged or of another fit is replaced.
        progress: called with the share done, 0 to 1.

    Raises:
        InputError: units, layers, steps, starts or seconds that are not positive, or no rays.
        OSError: the checkpoint cannot be written.
    """
    numbers = {"units": units, "layers": layers, "steps": steps, "starts": starts, "seconds": seconds, "rays": rays}
    for name, value in numbers.items():
        if not value > 0:
            raise InputError("mlp", name, value, "a positive number")
    if not len(pairs.train):
        raise InputError("mlp", "pairs.train", "(no rays)", "at least one passing ray")
    with pinned_threads():
        problem, shift, scale = _problem(pairs, encoding, gates, rays, base)
        key = fingerprint(problem.tensors, {**numbers, "seed": seed})
        enough = (_ENOUGH * 1000 * pairs.domain.film_radius_mm) ** 2
        kept = Checkpoint(checkpoint, key)
        training = Training(problem, (units, layers), seed, steps, starts, seconds, enough, kept, progress)
        best = training.run()
    if progress:
        progress(1.0)
    *hidden, output = ((w[:, :-1].numpy().copy(), w[:, -1].numpy().copy()) for w in (*best.hidden, best.output))
    return Network(tuple(hidden), output, shift.numpy(), scale.numpy())


def _problem(
    pairs: RayPairs,
    encoding: Encoding,
    gates: tuple[Gate, ...],
    rays: int,
    base: InvariantPolynomial | None = None,
) -> tuple[Problem, Tensor, Tensor]:
    """The weighted fit, and shift and scale [4] of the invariants."""
    boundary = boundary_rays(pairs, gates)
    train = pairs.train.select(slice(0, max(rays - len(boundary), rays - rays // 2)))
    boundary = boundary.select(slice(0, rays - len(train)))
    parts = [_part(pairs.lens, pairs.domain, encoding, gates, s, base) for s in (train, boundary) if len(s)]
    inputs, *rest = (torch.cat(c, -1) for c in zip(*parts, strict=True))
    low, high = inputs.amin(1), inputs.amax(1)
    shift = (low + high) / 2
    scale = torch.where(high > low, 2 / torch.where(high > low, high - low, 1.0), 1.0)
    return Problem(((inputs - shift[:, None]) * scale[:, None]).T.contiguous(), *rest), shift, scale


def _part(
    lens: Lens,
    domain: Domain,
    encoding: Encoding,
    gates: tuple[Gate, ...],
    pairs: PairSet,
    base: InvariantPolynomial | None,
) -> tuple[Tensor, ...]:
    """Invariants [4, N] and the fields of `Problem` after the inputs, rays last."""
    targets, gate = targets_of(lens, encoding, pairs), gate_values(lens, gates, pairs)
    passes = (pairs.status == st.PASSED).to(torch.float64)
    position_um, direction_um = film_equivalent_weights(lens, domain)
    weights = torch.empty((3, len(pairs)), dtype=torch.float64)
    weights[POSITION], weights[DIRECTION] = position_um * passes, direction_um * passes
    gate_weights, stop_weights = boundary_weights(lens, gates, pairs)
    weights[STOP] = _STOP_UM_PER_MM * lens.stop_radius_mm * stop_weights
    vectors, scalars = targets.vectors, torch.cat([targets.transmittance[None], gate])
    size = domain.film_radius_mm
    scalar_weights = torch.cat([_TRANSMITTANCE_UM * size * passes[None], _GATE_UM * size * gate_weights])
    field = targets.field
    if base is not None:
        known, known_scalars = base(field)
        vectors, scalars = vectors - known, scalars - known_scalars
    if encoding.mirror:  # x and y of each vector by themselves
        p, u = (torch.cat([v] * 3)[:, None] for v in (field.p, field.u))
        vectors, weights = vectors.reshape(6, 1, -1), weights.repeat_interleave(2, 0)
        return field.mirror_invariants(), p, u, vectors, weights, scalars, scalar_weights
    return field.invariants(), field.p[None], field.u[None], vectors, weights, scalars, scalar_weights
