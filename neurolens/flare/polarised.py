"""Ghosts whose light keeps, from surface to surface, the polarisation that each gives to it.

Places and rims are those of the compiled steps, which average each surface's reflectance over both polarisations; the
power of rays that arrive is followed once more as a vector (`optics.sequence.follow`), in float64 and torch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.status import PASSED
from neurolens.flare.ghosts import GhostRays, GhostSums, GhostTracer, Way
from neurolens.flare.stack import Floats
from neurolens.optics.sequence import follow, turning
from neurolens.optics.trace import Rays

_RANK = 8  # ghosts whose rays are held at once


class PolarisedTracer(GhostTracer):
    """A `GhostTracer` of unpolarised light whose power is followed with its polarisation, some twenty times as slow.

    Of rays that one arithmetic lets through and the other does not, at rims, the averaged power stays.
    """

    def follow(
        self,
        start: Floats,
        wavelength_nm: float,
        *,
        only: Sequence[Way] | None = None,
        direct: bool = False,
        reach: float = 1.0,
    ) -> GhostRays:
        """As of `GhostTracer`."""
        found = super().follow(start, wavelength_nm, only=only, direct=direct, reach=reach)
        ways = self.pairs if only is None else only
        for row, turns in zip(found.rows, [*(way.reflections for way in ways), *[()] * direct], strict=True):
            lit = np.flatnonzero(row[2] > 0)
            if lit.size:
                row[2, lit] = self._power(start[:, lit], turns, wavelength_nm, row[2, lit])
        return found

    def sums(
        self,
        start: Floats,
        wavelength_nm: float,
        ways: NDArray[np.int32] | None = None,
        *,
        direct: bool = False,
        least: float = 0.0,
    ) -> GhostSums:
        """As of `GhostTracer`; of given `ways` the averaged power, which is enough to choose among them."""
        if ways is not None:
            return super().sums(start, wavelength_nm, ways, direct=direct, least=least)
        parts = [self.pairs[k : k + _RANK] for k in range(0, len(self.pairs), _RANK)]
        rows = [self.follow(start, wavelength_nm, only=part).sums for part in parts]
        rows += [self.follow(start, wavelength_nm, only=(), direct=True).sums] * direct
        return GhostSums(np.concatenate([*rows, np.zeros((0, 5))]), 0.0)

    def _power(self, start: Floats, turns: Sequence[int], wavelength_nm: float, averaged: Floats) -> Floats:
        """Of rays [8, N] of `start`, which are mirrored, along one way."""
        x, y, z, *d = torch.from_numpy(start[:6].astype(np.float64))
        length = torch.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
        rays = Rays(x, y, -z, d[0] / length, d[1] / length, -d[2] / length)
        found = follow(self.lens, rays, turning(len(self.lens.surfaces), turns), wavelength_nm, polarised=True)
        return np.where((found.status == PASSED).numpy(), found.power.numpy(), averaged).astype(np.float32)
