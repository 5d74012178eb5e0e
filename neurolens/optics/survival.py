"""Which rays still travel, and what stopped the others: tests in order, the first failure rules."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from neurolens import status as st


class Survival(Protocol):
    """The tests at each surface (met, inside the rim, not totally reflected), in the order in which they are called.

    `goes_on` [N] is False for rays that missed a surface or were totally reflected. A rim alone lets a ray go on: its
    crossings are learnt from.
    """

    goes_on: Tensor

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        """Apply the next test; `passed` is boolean [N]."""

    def status(self) -> Tensor:
        """Status of every ray, [N] int32; see `neurolens.status`."""


def survival(sound: Tensor, otherwise: int) -> Survival:
    """Start with the rays that are `sound` [N]; the others have the status `otherwise`."""
    return _Labels(sound, otherwise) if torch.compiler.is_compiling() else _Counts(sound, otherwise)


class _Labels:
    """A label a ray, written at its first failure: what a compiler turns into few instructions in registers."""

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        self._status = (~sound).to(torch.int32) * otherwise
        self.goes_on = sound

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        self._status = torch.where(passed | (self._status != 0), self._status, st.blocked(surface, reason))
        if reason != st.RIM:
            self.goes_on = self.goes_on & passed

    def status(self) -> Tensor:
        return self._status


class _Counts:
    """How many tests a ray passed before its first failure: one byte a ray to read and write, where the memory traffic
    of every test counts."""

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        self._alive, self.goes_on = sound.clone(), sound
        self._meanings = [otherwise]
        self._full = sound.to(torch.uint8)  # counts up to 255, then moves to `_count`
        self._count: Tensor | None = None

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        self._alive.logical_and_(passed)
        if reason != st.RIM:
            self.goes_on = self.goes_on & passed  # not in place: gradients may keep it
        if len(self._meanings) % 255 == 0:
            self._count = self._full.int() if self._count is None else self._count + self._full
            self._full.zero_()
        # The same byte seen as a number: no conversion.
        self._full.add_(self._alive.view(torch.uint8))
        self._meanings.append(st.blocked(surface, reason))

    def status(self) -> Tensor:
        count = self._full if self._count is None else self._count + self._full
        meanings = torch.tensor([*self._meanings, st.PASSED], dtype=torch.int32, device=count.device)
        return meanings.index_select(0, count.int())
