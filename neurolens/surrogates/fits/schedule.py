"""The course of a training: several starts on few rays, then the best, on as many rays as it takes not to overfit.

A smooth lens is learnt from 2000 rays as well as from 16,000, at an eighth of the cost of a step. Where the error on
rays that the fit has not seen runs ahead of that on its own, it goes on with twice as many.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from neurolens.surrogates.fits.checkpoint import Checkpoint
from neurolens.surrogates.fits.projection import Problem, Projection, activations, project
from neurolens.surrogates.fits.training import Stand, minimise

FEWEST_RAYS = 2000
# Each start gets this share of the steps before the best goes on.
_TRIAL_STEPS = 0.1
# Steps between looks at the error on rays not fitted (and between checkpoints).
_BURST = 10
# More rays, when the RMS on rays not fitted is larger than that on the fitted ones by this factor.
_GAP = 1.15
# Converged, when so many bursts in a row lower the loss by less than this share each.
_LITTLE, _IDLE = 0.01, 3


@dataclass
class _Place:
    """Where a training is, but for the weights: plain numbers.

    Attributes:
        start: the start that runs, or their number once the best goes on.
        taken: steps of the present start, or of the best.
        level: how often the rays were doubled.
        champion: the best start so far, by its loss `least`.
        previous: loss after the last burst.
        idle: bursts in a row that gained little.
        ended: whether the training is over.
    """

    start: int = 0
    taken: int = 0
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
        shape: units and layers.
        seed: of the first start's weights.
        steps, seconds: the training ends by either.
        starts: random starts.
        enough: a loss so low that the rounding of float32 evaluation is larger.
        checkpoint: what earlier runs left.
        progress: called with the share done.
    """

    problem: Problem
    shape: tuple[int, int]
    seed: int
    steps: int
    starts: int
    seconds: float
    enough: float
    checkpoint: Checkpoint
    progress: Callable[[float], None] | None = None
    _place: _Place = field(default_factory=_Place)
    _champion: list[Tensor] = field(default_factory=list)
    _highest: float = 0.0

    def run(self) -> Projection:
        """Train, from the start or from where the checkpoint was written; the last layer fits all rays."""
        halvings = max(0, (len(self.problem) // FEWEST_RAYS).bit_length() - 1)
        self._levels = [2**k for k in range(halvings, -1, -1)]
        self._stand = Stand(random_layers(self.problem.inputs, *self.shape, self.seed))
        self._resume()
        self._take_rays()
        if self.starts == 1:
            self._place.start = 1
        while not self._place.ended:
            if self._place.start < self.starts:
                self._try_start()
            else:
                self._go_on()
            self._save()
        self._save(now=True)
        return project(self.problem, self._stand.hidden)

    def _take_rays(self) -> None:
        self._rays = self.problem.every(self._levels[self._place.level])
        odd = self.problem.every(4, first=1) if self._levels[0] > 1 else None
        self._unseen = odd if self._place.level + 1 < len(self._levels) else None

    def _burst(self, steps: int, until: float) -> Projection:
        """At most `_BURST` steps, none after this share of the time."""
        place = self._place
        deadline = time.monotonic() + until * self.seconds - self.checkpoint.elapsed_s
        count = min(_BURST, steps - place.taken)
        best, self._stand = minimise(
            self._rays, self._stand, count, deadline, lambda share: self._report(place.taken + share * count)
        )
        place.taken += count
        return best

    def _try_start(self) -> None:
        """A burst of one of the starts; the end of its trial compares it with the best so far."""
        place, short = self._place, max(1, round(_TRIAL_STEPS * self.steps))
        until = 0.4 * (place.start + 1) / self.starts
        best = self._burst(short, until)
        if place.taken < short and self.checkpoint.elapsed_s < until * self.seconds and not self._stand.stuck:
            return
        if best.loss < place.least or not self._champion:
            place.least, place.champion, self._champion = best.loss, place.start, self._stand.hidden
        place.start, place.taken = place.start + 1, 0
        if place.start < self.starts:
            self._stand = Stand(random_layers(self.problem.inputs, *self.shape, self.seed + 7919 * place.start))
        else:
            self._stand = Stand(self._champion)

    def _go_on(self) -> None:
        """A burst of the best start; then more rays, or the end."""
        place = self._place
        best = self._burst(self.steps, 1.0)
        little = best.loss > (1 - _LITTLE) * place.previous
        place.idle = place.idle + 1 if little else 0
        place.previous = best.loss
        done = place.idle >= _IDLE or best.loss <= self.enough
        if self._unseen is not None and (done or place.taken % (2 * _BURST) == 0):
            outputs = activations(best.hidden, self._unseen.inputs)[-1] @ best.output.T
            if self._unseen.loss(outputs) > _GAP**2 * best.loss:
                place.level, place.previous, place.idle, done = place.level + 1, math.inf, 0, False
                self._stand = Stand(best.hidden, min(self._stand.damping, Stand.damping))
                self._take_rays()
        over = place.taken >= self.steps or self.checkpoint.elapsed_s >= self.seconds or self._stand.stuck
        place.ended = over or done

    def _report(self, taken: float) -> None:
        """Tell the share done; it never goes back."""
        if self.progress:
            short = max(1, round(_TRIAL_STEPS * self.steps)) if self.starts > 1 else 0
            done = min(self._place.start, self.starts) * short + taken
            share = max(done / (self.starts * short + self.steps), self.checkpoint.elapsed_s / self.seconds)
            self._highest = min(1.0, max(self._highest, share))
            self.progress(self._highest)

    def _save(self, *, now: bool = False) -> None:
        self._place.damping, self._place.growth = self._stand.damping, self._stand.growth
        self.checkpoint.save(asdict(self._place), [*self._stand.hidden, *self._champion], now=now)

    def _resume(self) -> None:
        known = self.checkpoint.load()
        if known is None:
            return
        state, arrays = known
        self._place = _Place(**state)
        layers = self.shape[1]
        self._stand = Stand(arrays[:layers], self._place.damping, self._place.growth)
        self._champion = arrays[layers:]


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
