"""Small networks with the symmetry of the lens (after NeuroLens, Zheng and Zheng 2017b), trained by `training.py`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from neurolens import status as st
from neurolens.errors import InputError
from neurolens.optics.prescription import Lens
from neurolens.surrogates.cores import Network
from neurolens.surrogates.domain import Domain
from neurolens.surrogates.gates import boundary_rays, gate_reach, gate_values
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import DIRECTION, POSITION, STOP, Gate
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.surrogates.targets import film_equivalent_weights, targets_of
from neurolens.surrogates.threads import pinned_threads
from neurolens.surrogates.training import Problem, Projection, minimise

# What the other outputs weigh against film-equivalent micrometres: so many um for 1 mm at the stop, for a transmittance
# of 1, for a gate of 1 (a rim radius twice over). They only decide which features the hidden layers learn: the last
# layer is solved for each output by itself.
_STOP_UM_PER_MM, _TRANSMITTANCE_UM, _GATE_UM = 30.0, 200.0, 200.0
# Only the neighbourhood of a boundary decides who passes: beyond this distance (in units of the gate) weights fall off.
_BOUNDARY = 0.1
# Each of several starts gets this share of the steps, on this share of the rays, before the best goes on.
_TRIAL_STEPS, _TRIAL_RAYS = 0.15, 0.25


def fit_network(
    pairs: RayPairs,
    encoding: Encoding,
    gates: tuple[Gate, ...],
    *,
    units: int = 16,
    layers: int = 2,
    seed: int = 0,
    seconds: float = 60.0,
    steps: int = 60,
    starts: int = 3,
    rays: int = 8000,
    progress: Callable[[float], None] | None = None,
) -> Network:
    """Fit a network of `layers` tanh layers of `units` units, in float64 on one thread.

    Position and direction weigh by their film-equivalent error, the stop crossing, the transmittance and the gates
    modestly. Several random starts are tried, and the best goes on.

    Args:
        pairs: half the rays come from `train`, half from those near the boundaries and beyond (`gates.boundary_rays`).
        steps: most steps of the optimiser (Levenberg-Marquardt); the time limit may end it earlier.
        seconds: wall-clock limit. The same seed gives the same weights bit for bit where it does not bite.
        starts: random starts.
        rays: most rays used.
        progress: called with the share done, 0 to 1.

    Raises:
        InputError: units, layers, steps, starts or seconds that are not positive, or no rays.
    """
    numbers = {"units": units, "layers": layers, "steps": steps, "starts": starts, "seconds": seconds, "rays": rays}
    for name, value in numbers.items():
        if not value > 0:
            raise InputError("mlp", name, value, "a positive number")
    if not len(pairs.train):
        raise InputError("mlp", "pairs.train", "(no rays)", "at least one passing ray")
    run = _Run(seconds, progress)
    with pinned_threads():
        problem, shift, scale = _problem(pairs, encoding, gates, rays)
        best = _train(problem, (units, layers), seed, steps, starts, run)
    if progress:
        progress(1.0)
    hidden = tuple((w[:, :-1].clone(), w[:, -1].clone()) for w in best.hidden)
    return Network(hidden, (best.output[:, :-1].clone(), best.output[:, -1].clone()), shift, scale)


def _train(problem: Problem, shape: tuple[int, int], seed: int, steps: int, starts: int, run: _Run) -> Projection:
    """Short trials of several starts on few rays, then the best on all of them."""
    first = [_random_layers(problem.inputs, *shape, seed + 7919 * k) for k in range(starts)]
    short = max(1, round(_TRIAL_STEPS * steps))
    run.total = steps + (starts * short * _TRIAL_RAYS if starts > 1 else 0.0)
    if starts > 1:
        few = problem.every(round(1 / _TRIAL_RAYS))
        trials = [run(few, h, short, _TRIAL_RAYS, 0.4 * (k + 1) / starts) for k, h in enumerate(first)]
        first = [min(trials, key=lambda t: t.loss).hidden]
    return run(problem, first[0], steps, 1.0, 1.0)


class _Run:
    """Runs of the optimiser within one time limit, reporting shares that never go back."""

    def __init__(self, seconds: float, progress: Callable[[float], None] | None) -> None:
        self.begin, self.seconds, self.progress = time.monotonic(), seconds, progress
        self.total, self.done, self.highest = 1.0, 0.0, 0.0

    def __call__(self, problem: Problem, hidden: list[Tensor], steps: int, cost: float, until: float) -> Projection:
        """Run `steps` steps of relative `cost`, at most until this share of the time has passed."""

        def report(share: float) -> None:
            spent = (time.monotonic() - self.begin) / self.seconds
            self.highest = min(1.0, max(self.highest, (self.done + share * steps * cost) / self.total, spent))
            if self.progress:
                self.progress(self.highest)

        best = minimise(problem, hidden, steps, self.begin + until * self.seconds, report)
        self.done += steps * cost
        return best


def _random_layers(inputs: Tensor, units: int, layers: int, seed: int) -> list[Tensor]:
    """Uniform weights (Glorot and Bengio 2010) and biases that spread the bends of tanh over the data."""
    generator = torch.Generator().manual_seed(seed)
    changes = (inputs != inputs[0]).any(0)
    hidden, width = [], inputs.shape[1]
    for k in range(layers):
        weight = (2 * torch.rand((units, width), generator=generator, dtype=torch.float64) - 1) * math.sqrt(
            6 / (width + units)
        )
        bias = torch.rand((units, 1), generator=generator, dtype=torch.float64) - 0.5
        # A constant input (the wavelength of a lens without dispersion) gets no weight.
        hidden.append(torch.cat([weight * changes if k == 0 else weight, bias], 1))
        width = units
    return hidden


def _problem(pairs: RayPairs, encoding: Encoding, gates: tuple[Gate, ...], rays: int) -> tuple[Problem, Tensor, Tensor]:
    """The weighted fit, and shift and scale [4] of the invariants."""
    boundary = boundary_rays(pairs, gates)
    train = pairs.train.select(slice(0, max(rays - len(boundary), rays - rays // 2)))
    boundary = boundary.select(slice(0, rays - len(train)))
    parts = [_part(pairs.lens, pairs.domain, encoding, gates, s) for s in (train, boundary) if len(s)]
    inputs, *rest = (torch.cat(c, -1) for c in zip(*parts, strict=True))
    low, high = inputs.amin(1), inputs.amax(1)
    shift = (low + high) / 2
    scale = torch.where(high > low, 2 / torch.where(high > low, high - low, 1.0), 1.0)
    return Problem(((inputs - shift[:, None]) * scale[:, None]).T.contiguous(), *rest), shift, scale


def _part(
    lens: Lens, domain: Domain, encoding: Encoding, gates: tuple[Gate, ...], pairs: PairSet
) -> tuple[Tensor, ...]:
    """Invariants [4, N] and the fields of `Problem` after the inputs, rays last."""
    targets, gate = targets_of(lens, encoding, pairs), gate_values(lens, gates, pairs)
    passes = (pairs.status == st.PASSED).to(torch.float64)
    stop = targets.vectors[STOP]
    position_um, direction_um = film_equivalent_weights(lens, domain)
    weights = torch.empty((3, len(pairs)), dtype=torch.float64)
    weights[POSITION], weights[DIRECTION] = position_um * passes, direction_um * passes
    near = _near((stop * stop).sum(0) - 1).where(passes == 0, 1.0)
    arrives = gate_reach(
        (Gate(lens.stop_index, st.RIM), *gates), pairs
    )  # rays lost before a boundary say nothing of it
    weights[STOP] = _STOP_UM_PER_MM * lens.stop_radius_mm * near.where(arrives[0], 0.0)
    scalars = torch.cat([targets.transmittance[None], gate])
    scalar_weights = torch.cat([_TRANSMITTANCE_UM * passes[None], (_GATE_UM * _near(gate)).where(arrives[1:], 0.0)])
    field = targets.field
    return field.invariants(), field.p, field.u, targets.vectors, weights, scalars, scalar_weights


def _near(gate: Tensor) -> Tensor:
    """Weight 1 on the boundary, falling off away from it (its square is that of the residual's square)."""
    return 1 / torch.sqrt(1 + (gate / _BOUNDARY) ** 2)
