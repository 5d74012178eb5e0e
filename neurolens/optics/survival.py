"""Which rays still travel, and what stopped the others: tests in order, the first failure rules."""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

from neurolens.base import status as st


def positive(value: Tensor, sense: int = 1, *, spend: bool = False) -> Tensor:
    """Whether value * sense > 0, [N]; NaN is not. With `spend` as 1.0 and 0.0 in the place of `value` itself.

    Comparisons that give truth values are not vectorised on CPUs and cost five times as much as those in place; only
    for values that nobody needs afterwards, and never where gradients are wanted.
    """
    if not spend:
        return value > 0 if sense > 0 else value < 0
    return value.gt_(0) if sense > 0 else value.lt_(0)


def at_most(value: Tensor, limit: float, *, spend: bool = False) -> Tensor:
    """Whether value <= limit, [N]; NaN is not. `spend` as for `positive`."""
    return value.le_(limit) if spend else value <= limit


def also(first: Tensor, second: Tensor) -> Tensor:
    """Both tests passed, [N]; spends `first` where tests are 1.0 and 0.0."""
    return first.mul_(second) if first.is_floating_point() else first & second


def choose(test: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """`yes` where the test passed, else `no`, [N]. Of a test in numbers a mixture, for which both must be finite."""
    return torch.lerp(no, yes, test) if test.is_floating_point() else torch.where(test, yes, no)


class Survival(Protocol):
    """The tests at each surface (met, inside the rim, not totally reflected), in the order in which they are called.

    A ray goes on until it misses a surface or is totally reflected. A rim alone lets it go on: its crossings are learnt
    from.
    """

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        """Apply the next test; `passed` is [N], boolean or 1.0 and 0.0."""

    def end(self, sound: Tensor) -> None:
        """End rays that are not `sound` [N] boolean, whatever their status."""

    def only(self, value: Tensor, otherwise: float) -> Tensor:
        """`value` [N] of the rays that go on, `otherwise` for the others, even where it is NaN."""

    def status(self) -> Tensor:
        """Status of every ray, [N] int32; see `neurolens.base.status`."""


class Labels:
    """A label a ray, written at its first failure: what a compiler turns into few instructions in registers, and what
    gradients can be taken through."""

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        """Start with the rays that are `sound` [N] boolean; the others have the status `otherwise`."""
        self._status = (~sound).to(torch.int32) * otherwise
        self._goes_on = sound

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        self._status = torch.where(passed | (self._status != 0), self._status, st.blocked(surface, reason))
        if reason != st.RIM:
            self._goes_on = self._goes_on & passed

    def end(self, sound: Tensor) -> None:
        self._goes_on = self._goes_on & sound

    def only(self, value: Tensor, otherwise: float) -> Tensor:
        return torch.where(self._goes_on, value, otherwise)

    def status(self) -> Tensor:
        return self._status


class Counts:
    """How many tests a ray passed before its first failure, in numbers throughout: truth values, selections and
    conversions between them cost more than all the optics."""

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        """Start with the rays that are `sound` [N], 1.0 or 0.0; the others have the status `otherwise`."""
        self._alive, self._goes_on = sound.clone(), sound.clone()
        self._count = sound.clone()
        self._meanings = [otherwise]
        self._mask: Tensor | None = None

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        passed = passed.to(self._alive.dtype)
        self._alive.mul_(passed)
        self._count.add_(self._alive)
        self._meanings.append(st.blocked(surface, reason))
        if reason != st.RIM:
            self._goes_on.mul_(passed)
            self._mask = None

    def end(self, sound: Tensor) -> None:
        self._goes_on.mul_(sound)
        self._mask = None

    def only(self, value: Tensor, otherwise: float) -> Tensor:
        bits = torch.int32 if value.dtype == torch.float32 else torch.int64
        if self._mask is None:
            self._mask = self._goes_on.to(bits).neg_()
        # All bits or none: the only product with 0 that a NaN does not survive.
        kept = value.view(bits).bitwise_and(self._mask).view(value.dtype)
        return kept if otherwise == 0 else kept.add_(1 - self._goes_on, alpha=otherwise)

    def status(self) -> Tensor:
        return _table((*self._meanings, st.PASSED), self._count.device).index_select(0, self._count.int())


@lru_cache(maxsize=256)
def _table(meanings: tuple[int, ...], device: torch.device) -> Tensor:
    """Kept, for sending it anew with every chunk would make the host wait for an accelerator."""
    return torch.tensor(meanings, dtype=torch.int32, device=device)
