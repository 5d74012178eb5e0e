"""Torch's arithmetic for the surface step, and the tests that rays pass on their way.

Eager torch spends its time on moving memory, and these forms make few passes over it. Comparisons that give truth
values cost several times as much as those that give 1.0 and 0.0, and so do selections by them: so tests are numbers
here.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.optics.trace.arithmetic import TINY, Arithmetic, is_number, times
from neurolens.optics.trace.surfaces import Rays, Test

# Steps that an iteration takes after the one that decides convergence. Float64 takes some more; which rays converge is
# decided alike in both precisions.
POLISH = {torch.float32: 0, torch.float64: 2}


class Tensors(Arithmetic):
    """The arithmetic of torch tensors.

    Args:
        guard: whether lost rays stay finite on the way.
        dtype: of the rays.
    """

    def __init__(self, guard: bool, dtype: torch.dtype) -> None:
        self.guard = self.finite = guard
        self.polish = POLISH[dtype]

    def fma(self, a: Any, b: Any, c: Any, k: Any = 1) -> Any:
        if is_number(b):
            b, k = k, b
        if not is_number(k) or not isinstance(c, Tensor):
            return times(a, k) * b + c
        if k == 0:
            return c
        if is_number(b):
            return torch.add(c, a, alpha=b * k)
        return torch.addcmul(c, a, b, value=k)

    def add_to(self, c: Any, a: Any, b: Any, k: Any = 1) -> Any:
        if self.guard or not is_number(k) or torch.compiler.is_compiling():
            return self.fma(a, b, c, k)
        return c.addcmul_(a, b, value=k) if k else c

    def dot(self, a: Sequence[Any], b: Sequence[Any]) -> Tensor:
        total = a[0] * b[0]
        for p, q in zip(a[1:], b[1:], strict=True):
            total.addcmul_(p, q)  # in place, which moves a third less memory
        return total

    def root(self, square: Tensor, finite: bool = False) -> Tensor:
        if self.guard:
            return torch.sqrt(torch.where(square > 0, square, 1.0))
        if torch.compiler.is_compiling():
            return torch.sqrt(square)
        # The library behind torch.sqrt takes 20 times as long for negative numbers, which lost rays have.
        return square * torch.rsqrt(square)

    def held_root(self, square: Tensor, least: float = TINY) -> Tensor:
        return torch.sqrt(square.clamp_min(least))

    def inverse_root(self, square: Tensor) -> Tensor:
        return torch.rsqrt(self.positive(square))

    def positive(self, value: Tensor) -> Tensor:
        return torch.where(value > 0, value, 1.0) if self.guard else value

    def nonzero(self, value: Tensor) -> Tensor:
        return torch.where(value * value > 0, value, 1.0) if self.guard else value

    def least(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.minimum(a, b)

    def exp(self, value: Tensor) -> Tensor:
        return value.exp()

    def abs(self, value: Tensor) -> Tensor:
        return value.abs()

    def select(self, low: Any, high: Any, then: Any, otherwise: Any) -> Tensor:
        return torch.where(low <= high, then, otherwise)

    def fixed(self, value: Any) -> Any:
        return value.detach() if isinstance(value, Tensor) else value

    def constant(self) -> AbstractContextManager[Any]:
        return torch.no_grad()

    def like(self, value: Tensor, number: Any) -> Tensor:
        return torch.full_like(value, number) if is_number(number) else torch.zeros_like(value) + number


class Survival:
    """Keeps the tests that rays pass, in the order in which they meet them; the first that fails is a ray's status.

    A ray goes on until it misses a surface or is totally reflected. A ray that a rim stops goes on too, because
    surrogates are fitted to its crossings.
    """

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        """Start with the rays that are `sound` [N], 1.0 or 0.0; the others get the status `otherwise`."""
        self.passed, self._goes_on, self._count = sound.clone(), sound.clone(), sound.clone()
        self._meanings = [otherwise]

    def require(self, tests: Sequence[Test], surface: int, reason: int) -> None:
        """Apply tests (low, high), each [N] or a number: a ray passes where low <= high, and NaN does not."""
        for test in tests:
            passed = at_most(*test)
            self.passed.mul_(passed)
            self._count.add_(self.passed)
            self._meanings.append(st.blocked(surface, reason))
            if reason != st.RIM:
                self._goes_on = self._goes_on * passed  # a new tensor, for gradients may need the old one

    def end(self, value: Tensor) -> None:
        """End rays whose `value` [N] is not finite, whatever their status."""
        self._goes_on = self._goes_on * at_most(value, torch.finfo(value.dtype).max)

    def only(self, value: Tensor, otherwise: Any) -> Tensor:
        """Return `value` [N] for the rays that go on, and `otherwise` for the others, even where `value` is NaN."""
        kept = value.nan_to_num(0.0, 0.0, 0.0) * self._goes_on
        return kept if is_number(otherwise) and otherwise == 0 else kept + (1 - self._goes_on) * otherwise

    def along_axis(self, r: Rays, sense: int, z: Any) -> Rays:
        """Return the rays, those that do not go on replaced by rays along the axis that start at z."""
        on_axis = (0.0, 0.0, z, 0.0, 0.0, float(sense))
        return Rays(*(self.only(c, a) for a, c in zip(on_axis, r, strict=True)))

    def status(self) -> Tensor:
        """Return the status of every ray, [N] int32; see `neurolens.base.status`."""
        return _table((*self._meanings, st.PASSED), self._count.device).index_select(0, self._count.int())


def at_most(low: Any, high: Any) -> Tensor:
    """Return 1.0 where low <= high, else 0.0, [N]; one of the two may be a number."""
    if isinstance(low, Tensor):
        low = low.detach()
        return torch.le(low, high.detach() if isinstance(high, Tensor) else high, out=torch.empty_like(low))
    return torch.ge(high.detach(), low, out=torch.empty_like(high))


@lru_cache(maxsize=256)
def _table(meanings: tuple[int, ...], device: torch.device) -> Tensor:
    """Cache the table on its device: to transfer it for every chunk would make the host wait for an accelerator."""
    return torch.tensor(meanings, dtype=torch.int32, device=device)
