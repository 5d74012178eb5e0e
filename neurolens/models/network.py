"""Fits small networks with the symmetry of the lens (after NeuroLens, Zheng and Zheng 2017b).

Several starts run on few rays; then the best goes on, on as many rays as it takes not to overfit: a smooth lens is
learnt from 2000 rays as well as from 16,000, at an eighth of the cost of a step. Where the error on rays that the fit
has not seen exceeds the error on its own rays, it goes on with twice as many. Steps are counted by their rays, so that
their number bounds the work and gives the share done. A killed training goes on from its file.
"""

import hashlib
import json
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.files import Kept, read_arrays
from neurolens.models.boundaries import (
    MOST_NETWORK_TERMS,
    boundary_terms,
    features_of,
    fit_stop,
    solve_scalars,
)
from neurolens.models.cores import DIRECTION, POSITION, STOP, InvariantPolynomial, LightField, Network, Residual
from neurolens.models.pairs import PairSet
from neurolens.models.projection import OptimiserState, Problem, Projection, activations, minimise, project
from neurolens.models.targets import (
    ModelSettings,
    Prepared,
    boundary_weights,
    film_equivalent_weights,
    gate_values,
    targets_of,
)
from neurolens.models.terms import pinned_threads

# What the other outputs weigh against film-equivalent micrometres: so many um for 1 mm at the stop; and, for each mm of
# the film radius, for a gate of 1 (about half a rim's radius). They only decide which features the hidden layers learn:
# the last layer is solved for each output by itself. The transmittance, which has terms of its own, weighs nothing.
_STOP_UM_PER_MM, _GATE_UM = 30.0, 10.0
# Training ends at an RMS of this share of the film radius: float32 itself, which evaluates the model, has eps 1.2e-7.
_ENOUGH = 1e-7
FEWEST_RAYS, _RAYS = 2000, 16_000
STARTS = 3  # with random weights
# Each start gets this share of the steps before the best goes on.
_TRIAL_STEPS = 0.1
# Steps between two looks at the error on rays that are not fitted (and between checkpoints).
_BURST = 10
# More rays, when the RMS on rays not fitted is larger than that on the fitted ones by this factor.
_GAP = 1.15
# Fewest rays near the boundaries for each term that may be added for them.
_RAYS_A_TERM = 4
# A training has converged when so many bursts in a row lower the loss by less than this share each.
_LITTLE, _IDLE = 0.01, 3
# A training's state is kept (`base.files`) every few seconds; another schema starts anew.
_SCHEMA, EVERY_S = 2, 3.0


def fit_network(
    data: Prepared,
    settings: ModelSettings,
    *,
    base: InvariantPolynomial | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> Network:
    """Fit a network of `layers` tanh layers of `units` units, in float64 on one thread.

    Position and direction weigh by their film-equivalent error; the stop crossing and the gates weigh little beside
    them, and the transmittance is left to `models.transmittance`. Several random starts are tried; the best goes on.

    Args:
        data: half the rays come from `pairs.train`, half from those near the boundaries and beyond (`boundary`).
        base: a polynomial whose residual is fitted instead.
        checkpoint: file that takes the state every few seconds. Where it holds that of the very same fit, training
            goes on from there, to the very same weights; a file that is damaged or of another fit is replaced.
        progress: called with the share done, 0 to 1.

    Raises:
        InputError: no rays.
        OSError: the checkpoint cannot be written.
    """
    if not len(data.pairs.train):
        raise InputError("settings", "pairs.train", "(no rays)", "at least one passing ray")
    with pinned_threads():
        problem, shift, scale = _problem(data, base)
        decisive = {name: getattr(settings, name) for name in ("units", "layers", "steps", "seed")}
        key = _fingerprint(problem.tensors, {**decisive, "starts": STARTS, "rays": _RAYS})
        enough = (_ENOUGH * 1000 * data.pairs.domain.film_radius_mm) ** 2
        best = _Training(problem, settings, enough, Kept(checkpoint, key, EVERY_S), progress).run()
    progress(1.0)
    *hidden, output = ((w[:, :-1].numpy().copy(), w[:, -1].numpy().copy()) for w in (*best.hidden, best.output))
    return Network(tuple(hidden), output, shift.numpy(), scale.numpy())


def with_boundary_terms(data: Prepared, network: Network) -> Network | Residual:
    """Return the network, with a sparse polynomial added to its stop crossing and gates where those need it.

    The terms are chosen and their rows fitted as those of a polynomial, with the hidden units as further features. All
    other rows stay as they are. Networks of lenses with cylinders get none, for they are the better kind there.
    """
    if data.encoding.mirror or len(data.boundary) < _RAYS_A_TERM * MOST_NETWORK_TERMS:
        return network
    shift, scale = torch.from_numpy(network.shift)[:, None], torch.from_numpy(network.scale)[:, None]
    layers = [torch.from_numpy(np.concatenate([w, b[:, None]], 1)) for w, b in network.hidden]

    def hidden(field: LightField) -> Tensor:
        return activations(layers, ((field.invariants() - shift) * scale).T)[-1].T

    none = np.zeros((0, 4), np.int64)
    with pinned_threads():
        exponents = boundary_terms(data, none, none, hidden)
        if not len(exponents):
            return network
        features = features_of(exponents, hidden)
        stop, gates = fit_stop(data, features).reshape(2, -1).numpy(), solve_scalars(data, features)[1:].numpy()
    weight, bias = (a.copy() for a in network.output)
    units, rows = weight.shape[1], [*range(2 * STOP, 2 * STOP + 2), *range(network.ab_rows + 1, len(bias))]
    found = np.concatenate([stop, gates])  # of the units, their constant, then the terms
    weight[rows], bias[rows] = found[:, :units], found[:, units]
    ab, scalars = np.zeros((3, 2, len(exponents))), np.zeros((1 + len(gates), len(exponents)))
    ab[STOP], scalars[1:] = stop[:, units + 1 :], gates[:, units + 1 :]
    return Residual((InvariantPolynomial(exponents, ab, scalars), replace(network, output=(weight, bias))))


def _problem(data: Prepared, base: InvariantPolynomial | None) -> tuple[Problem, Tensor, Tensor]:
    """Set up the weighted fit, and shift and scale [4] of the invariants."""
    pairs, boundary = data.pairs, data.boundary
    train = pairs.train.select(slice(0, max(_RAYS - len(boundary), _RAYS - _RAYS // 2)))
    boundary = boundary.select(slice(0, _RAYS - len(train)))
    parts = [_part(data, s, base) for s in (train, boundary) if len(s)]
    inputs, *rest = (torch.cat(c, -1) for c in zip(*parts, strict=True))
    low, high = inputs.amin(1), inputs.amax(1)
    shift = (low + high) / 2
    scale = torch.where(high > low, 2 / torch.where(high > low, high - low, 1.0), 1.0)
    return Problem(((inputs - shift[:, None]) * scale[:, None]).T.contiguous(), *rest), shift, scale


def _part(data: Prepared, pairs: PairSet, base: InvariantPolynomial | None) -> tuple[Tensor, ...]:
    """Return the invariants [4, N] and the fields of `Problem` after the inputs, rays last."""
    lens, domain, gates = data.pairs.lens, data.pairs.domain, data.gates
    targets, gate = targets_of(lens, data.encoding, pairs), gate_values(lens, gates, pairs)
    passes = (pairs.status == st.PASSED).to(torch.float64)
    position_um, direction_um = film_equivalent_weights(lens, domain)
    weights = torch.empty((3, len(pairs)), dtype=torch.float64)
    weights[POSITION], weights[DIRECTION] = position_um * passes, direction_um * passes
    gate_weights, stop_weights = boundary_weights(lens, gates, pairs)
    weights[STOP] = _STOP_UM_PER_MM * lens.stop_radius_mm * stop_weights
    vectors, scalars = targets.vectors, torch.cat([0 * passes[None], gate])  # power is not fitted here
    size = domain.film_radius_mm
    scalar_weights = torch.cat([torch.zeros_like(passes)[None], _GATE_UM * size * gate_weights])
    field = targets.field
    if base is not None:
        fitted, fitted_scalars = base(field)
        vectors, scalars = vectors - fitted, scalars - fitted_scalars
    mirror, p, u = data.encoding.mirror, field.p[None], field.u[None]
    if mirror:  # x and y of each vector by themselves
        p, u = (torch.cat([v] * 3)[:, None] for v in (field.p, field.u))
        vectors, weights = vectors.reshape(6, 1, -1), weights.repeat_interleave(2, 0)
    return field.invariants(mirror), p, u, vectors, weights, scalars, scalar_weights


@dataclass
class _Course:
    """How far a training is, without its weights: plain numbers, which a checkpoint keeps.

    Attributes:
        start: the start that runs, or `STARTS` once the best goes on.
        taken: steps of the present start, or of the best; on twice the rays a step counts twice.
        bursts: how many the best has had. level: how often its rays were doubled.
        least: loss of the best start so far. previous: loss after the last burst.
        damping, growth: see `OptimiserState`.
        idle: bursts in a row that gained little.
    """

    start: int = 0
    taken: int = 0
    bursts: int = 0
    level: int = 0
    least: float = math.inf
    previous: float = math.inf
    damping: float = 0.0
    growth: float = 0.0
    idle: int = 0
    ended: bool = False


class _Training:
    """One training, which can be stopped after any burst and continued later."""

    def __init__(
        self,
        problem: Problem,
        settings: ModelSettings,
        enough: float,
        checkpoint: Kept,
        progress: Callable[[float], object],
    ) -> None:
        """Start, or continue from a checkpoint; `enough` is a loss below the rounding of float32 evaluation."""
        self._problem, self._settings, self._enough = problem, settings, enough
        self._checkpoint, self._progress = checkpoint, progress
        halvings = max(0, (len(problem) // FEWEST_RAYS).bit_length() - 1)
        self._levels = [2**k for k in range(halvings, -1, -1)]  # at a level a fit sees every n-th ray
        self._short = max(1, round(_TRIAL_STEPS * settings.steps))
        self._course, self._optimiser, self._champion = _Course(), self._start(0), list[Tensor]()
        if (saved := checkpoint.load()) is not None:
            state, arrays = saved[0], [torch.from_numpy(array) for array in saved[1]]
            self._course = _Course(**state)
            self._optimiser = OptimiserState(arrays[: settings.layers], self._course.damping, self._course.growth)
            self._champion = arrays[settings.layers :]
        self._take_rays()

    def run(self) -> Projection:
        """Train, and fit the last layer to all rays."""
        while not self._course.ended:
            if self._course.start < STARTS:
                self._try_start()
            else:
                self._go_on()
            self._save()
        self._save(now=True)
        return project(self._problem, self._optimiser.hidden)

    def _start(self, number: int) -> OptimiserState:
        s = self._settings
        return OptimiserState(random_layers(self._problem.inputs, s.units, s.layers, s.seed + 7919 * number))

    def _take_rays(self) -> None:
        level = self._course.level
        self._rays = self._problem.every(self._levels[level])
        self._validation = self._problem.every(4, first=1) if level + 1 < len(self._levels) else None

    def _burst(self, steps: int) -> Projection:
        """Take at most `_BURST` steps, each counted by its rays."""
        course, each = self._course, self._levels[0] // self._levels[self._course.level]
        count = min(_BURST, -(-(steps - course.taken) // each))

        def report(share: float) -> None:
            done = course.start * self._short + course.taken + share * count * each
            self._progress(min(1.0, done / (STARTS * self._short + self._settings.steps)))

        best, self._optimiser = minimise(self._rays, self._optimiser, count, report)
        course.taken += count * each
        return best

    def _try_start(self) -> None:
        """Run a burst of one of the starts; the end of its trial compares it with the best so far."""
        course, best = self._course, self._burst(self._short)
        if course.taken < self._short and not self._optimiser.stuck:
            return
        if best.loss < course.least or not self._champion:
            course.least, self._champion = best.loss, self._optimiser.hidden
        course.start, course.taken = course.start + 1, 0
        self._optimiser = self._start(course.start) if course.start < STARTS else OptimiserState(self._champion)

    def _go_on(self) -> None:
        """Run a burst of the best start; then take more rays, or end."""
        course, best = self._course, self._burst(self._settings.steps)
        course.bursts += 1
        course.idle = course.idle + 1 if best.loss > (1 - _LITTLE) * course.previous else 0
        course.previous = best.loss
        done = course.idle >= _IDLE or best.loss <= self._enough
        if self._validation is not None and (done or course.bursts % 2 == 0):
            outputs = activations(best.hidden, self._validation.inputs)[-1] @ best.output.T
            if self._validation.loss(outputs) > _GAP**2 * best.loss:
                course.level, course.previous, course.idle, done = course.level + 1, math.inf, 0, False
                self._optimiser = OptimiserState(best.hidden, min(self._optimiser.damping, OptimiserState.damping))
                self._take_rays()
        course.ended = done or course.taken >= self._settings.steps or self._optimiser.stuck

    def _save(self, *, now: bool = False) -> None:
        self._course.damping, self._course.growth = self._optimiser.damping, self._optimiser.growth
        arrays = [array.numpy() for array in (*self._optimiser.hidden, *self._champion)]
        self._checkpoint.save(asdict(self._course), arrays, now=now)


def random_layers(inputs: Tensor, units: int, layers: int, seed: int) -> list[Tensor]:
    """Draw uniform weights (Glorot and Bengio 2010), and biases that spread the bends of tanh over the data."""
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


# ---- files of a training ----


def _fingerprint(tensors: list[Tensor], settings: dict[str, Any]) -> str:
    """Hash everything that decides the weights (SHA-256): the data, the settings and the version of torch."""
    digest = hashlib.sha256(json.dumps([settings, str(torch.__version__), _SCHEMA], sort_keys=True).encode())
    for tensor in tensors:
        digest.update(str(tuple(tensor.shape)).encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def training_s(path: Path | None) -> float:
    """Return the seconds that all runs of a model's training took together; 0 where no file has them."""
    with suppress(OSError, ValueError):
        if path is not None:
            with read_arrays(path) as (about, _):
                return float(about["spent_s"])
    return 0.0
