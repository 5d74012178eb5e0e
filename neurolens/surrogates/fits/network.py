"""Small networks with the symmetry of the lens (after NeuroLens, Zheng and Zheng 2017b), and the course of a training.

Several starts run on few rays, then the best, on as many rays as it takes not to overfit: a smooth lens is learnt from
2000 rays as well as from 16,000, at an eighth of the cost of a step. Where the error on rays that the fit has not seen
runs ahead of that on its own, it goes on with twice as many. Steps are counted by their rays, so that their number
bounds the work and tells the share done.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.kept import Kept
from neurolens.surrogates.bases import pinned_threads
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, InvariantPolynomial, Network, Residual
from neurolens.surrogates.fits import checkpoint as kept_training
from neurolens.surrogates.fits.boundaries import (
    MOST_NETWORK_TERMS,
    boundary_terms,
    features_of,
    fit_stop,
    solve_scalars,
)
from neurolens.surrogates.fits.checkpoint import fingerprint
from neurolens.surrogates.fits.projection import Problem, Projection, Stand, activations, minimise, project
from neurolens.surrogates.gates import boundary_weights, gate_values
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.pairs import PairSet
from neurolens.surrogates.settings import ModelSettings
from neurolens.surrogates.targets import Prepared, film_equivalent_weights, targets_of

# What the other outputs weigh against film-equivalent micrometres: so many um for 1 mm at the stop; and, for each mm of
# the film radius, for a transmittance of 1 and for a gate of 1 (a rim radius twice over). They only decide which
# features the hidden layers learn: the last layer is solved for each output by itself.
_STOP_UM_PER_MM, _TRANSMITTANCE_UM, _GATE_UM = 30.0, 20.0, 10.0
# Training ends at an RMS of this share of the film radius: float32 itself, which evaluates the model, has eps 1.2e-7.
_ENOUGH = 1e-7
FEWEST_RAYS, RAYS = 2000, 16_000
STARTS = 3  # with random weights
# Each start gets this share of the steps before the best goes on.
_TRIAL_STEPS = 0.1
# Steps between looks at the error on rays not fitted (and between checkpoints).
_BURST = 10
# More rays, when the RMS on rays not fitted is larger than that on the fitted ones by this factor.
_GAP = 1.15
# Fewest rays near the boundaries for each term that may be added for them.
_RAYS_A_TERM = 4
# Converged, when so many bursts in a row lower the loss by less than this share each.
_LITTLE, _IDLE = 0.01, 3


def fit_network(
    data: Prepared,
    settings: ModelSettings,
    *,
    base: InvariantPolynomial | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Network:
    """Fit a network of `layers` tanh layers of `units` units, in float64 on one thread.

    Position and direction weigh by their film-equivalent error, the stop crossing, the transmittance and the gates
    modestly. Several random starts are tried, and the best goes on.

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
        raise InputError("mlp", "pairs.train", "(no rays)", "at least one passing ray")
    with pinned_threads():
        problem, shift, scale = _problem(data, base)
        decisive = {name: getattr(settings, name) for name in ("units", "layers", "steps", "seed")}
        key = fingerprint(problem.tensors, {**decisive, "starts": STARTS, "rays": RAYS})
        enough = (_ENOUGH * 1000 * data.pairs.domain.film_radius_mm) ** 2
        best = Training(problem, settings, enough, Kept(checkpoint, key, kept_training.EVERY_S), progress).run()
    if progress:
        progress(1.0)
    *hidden, output = ((w[:, :-1].numpy().copy(), w[:, -1].numpy().copy()) for w in (*best.hidden, best.output))
    return Network(tuple(hidden), output, shift.numpy(), scale.numpy())


def with_boundary_terms(data: Prepared, network: Network) -> Network | Residual:
    """The network, with a sparse polynomial added to its stop crossing and gates where those need it.

    The terms are chosen and the rows fitted as those of a polynomial are, with the hidden units as further features;
    all other rows stay as they are. Lenses with cylinders need none: of those the networks are the better kind.
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
    """The weighted fit, and shift and scale [4] of the invariants."""
    pairs, boundary = data.pairs, data.boundary
    train = pairs.train.select(slice(0, max(RAYS - len(boundary), RAYS - RAYS // 2)))
    boundary = boundary.select(slice(0, RAYS - len(train)))
    parts = [_part(data, s, base) for s in (train, boundary) if len(s)]
    inputs, *rest = (torch.cat(c, -1) for c in zip(*parts, strict=True))
    low, high = inputs.amin(1), inputs.amax(1)
    shift = (low + high) / 2
    scale = torch.where(high > low, 2 / torch.where(high > low, high - low, 1.0), 1.0)
    return Problem(((inputs - shift[:, None]) * scale[:, None]).T.contiguous(), *rest), shift, scale


def _part(data: Prepared, pairs: PairSet, base: InvariantPolynomial | None) -> tuple[Tensor, ...]:
    """Invariants [4, N] and the fields of `Problem` after the inputs, rays last."""
    lens, domain, gates = data.pairs.lens, data.pairs.domain, data.gates
    targets, gate = targets_of(lens, data.encoding, pairs), gate_values(lens, gates, pairs)
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
    mirror, p, u = data.encoding.mirror, field.p[None], field.u[None]
    if mirror:  # x and y of each vector by themselves
        p, u = (torch.cat([v] * 3)[:, None] for v in (field.p, field.u))
        vectors, weights = vectors.reshape(6, 1, -1), weights.repeat_interleave(2, 0)
    return field.invariants(mirror), p, u, vectors, weights, scalars, scalar_weights


@dataclass
class _Place:
    """Where a training is, but for the weights: plain numbers.

    Attributes:
        start: the start that runs, or their number once the best goes on.
        taken: steps of the present start, or of the best; of twice the rays, twice.
        bursts: of the best.
        level: how often the rays were doubled.
        champion: the best start so far, by its loss `least`.
        previous: loss after the last burst.
        idle: bursts in a row that gained little.
        ended: whether the training is over.
    """

    start: int = 0
    taken: int = 0
    bursts: int = 0
    level: int = 0
    champion: int = -1
    least: float = math.inf
    previous: float = math.inf
    damping: float = 0.0
    growth: float = 0.0
    idle: int = 0
    ended: bool = False


@dataclass
class Training:
    """One training, which can be left at any burst and taken up again.

    Attributes:
        problem: all rays.
        settings: units, layers, seed and steps are read.
        enough: a loss so low that the rounding of float32 evaluation is larger.
        checkpoint: what earlier runs left.
        progress: called with the share done.
    """

    problem: Problem
    settings: ModelSettings
    enough: float
    checkpoint: Kept
    progress: Callable[[float], None] | None = None
    _place: _Place = field(default_factory=_Place)
    _champion: list[Tensor] = field(default_factory=list)

    def run(self) -> Projection:
        """Train, from the start or from where the checkpoint was written; the last layer fits all rays."""
        halvings = max(0, (len(self.problem) // FEWEST_RAYS).bit_length() - 1)
        self._levels = [2**k for k in range(halvings, -1, -1)]
        self._stand = self._start(0)
        self._resume()
        self._take_rays()
        if STARTS == 1:
            self._place.start = 1
        while not self._place.ended:
            if self._place.start < STARTS:
                self._try_start()
            else:
                self._go_on()
            self._save()
        self._save(now=True)
        return project(self.problem, self._stand.hidden)

    def _start(self, number: int) -> Stand:
        s = self.settings
        return Stand(random_layers(self.problem.inputs, s.units, s.layers, s.seed + 7919 * number))

    def _take_rays(self) -> None:
        self._rays = self.problem.every(self._levels[self._place.level])
        odd = self.problem.every(4, first=1) if self._levels[0] > 1 else None
        self._unseen = odd if self._place.level + 1 < len(self._levels) else None

    def _burst(self, steps: int) -> Projection:
        """At most `_BURST` steps, each counted by its rays."""
        place, each = self._place, self._levels[0] // self._levels[self._place.level]
        count = min(_BURST, -(-(steps - place.taken) // each))
        best, self._stand = minimise(
            self._rays, self._stand, count, lambda share: self._report(place.taken + share * count * each)
        )
        place.taken += count * each
        return best

    def _try_start(self) -> None:
        """A burst of one of the starts; the end of its trial compares it with the best so far."""
        place, short = self._place, max(1, round(_TRIAL_STEPS * self.settings.steps))
        best = self._burst(short)
        if place.taken < short and not self._stand.stuck:
            return
        if best.loss < place.least or not self._champion:
            place.least, place.champion, self._champion = best.loss, place.start, self._stand.hidden
        place.start, place.taken = place.start + 1, 0
        self._stand = self._start(place.start) if place.start < STARTS else Stand(self._champion)

    def _go_on(self) -> None:
        """A burst of the best start; then more rays, or the end."""
        place, s = self._place, self.settings
        best = self._burst(s.steps)
        place.bursts += 1
        little = best.loss > (1 - _LITTLE) * place.previous
        place.idle = place.idle + 1 if little else 0
        place.previous = best.loss
        done = place.idle >= _IDLE or best.loss <= self.enough
        if self._unseen is not None and (done or place.bursts % 2 == 0):
            outputs = activations(best.hidden, self._unseen.inputs)[-1] @ best.output.T
            if self._unseen.loss(outputs) > _GAP**2 * best.loss:
                place.level, place.previous, place.idle, done = place.level + 1, math.inf, 0, False
                self._stand = Stand(best.hidden, min(self._stand.damping, Stand.damping))
                self._take_rays()
        place.ended = done or place.taken >= s.steps or self._stand.stuck

    def _report(self, taken: float) -> None:
        """Tell the share of the iterations done."""
        if self.progress:
            s = self.settings
            short = max(1, round(_TRIAL_STEPS * s.steps)) if STARTS > 1 else 0
            done = min(self._place.start, STARTS) * short + taken
            self.progress(min(1.0, done / (STARTS * short + s.steps)))

    def _save(self, *, now: bool = False) -> None:
        self._place.damping, self._place.growth = self._stand.damping, self._stand.growth
        arrays = [array.numpy() for array in (*self._stand.hidden, *self._champion)]
        self.checkpoint.save(asdict(self._place), arrays, now=now)

    def _resume(self) -> None:
        known = self.checkpoint.load()
        if known is None:
            return
        state, arrays = known[0], [torch.from_numpy(array) for array in known[1]]
        self._place = _Place(**state)
        self._stand = Stand(arrays[: self.settings.layers], self._place.damping, self._place.growth)
        self._champion = arrays[self.settings.layers :]


def random_layers(inputs: Tensor, units: int, layers: int, seed: int) -> list[Tensor]:
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
