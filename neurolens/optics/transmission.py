"""Power that arrives: what surfaces reflect and glass absorbs on the way, for unpolarised light."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from neurolens.optics.media import absorption_per_mm
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Hit, Medium, Rays, fresnel_transmittance


class Light(Protocol):
    """Power carried along while rays are traced."""

    def pass_surface(self, k: int, r: Rays, hit: Hit, bent: Rays, q: Tensor, before: Medium, after: Medium) -> None:
        """Pass surface k: rays before it (in its frame), where they meet it, rays after it, n' cos t, the media."""

    def arrived(self, goes_on: Tensor) -> Tensor:
        """Power of unpolarised light that arrives, [N]; 0 for rays that do not go on."""


def light(
    lens: Lens, wavelength_nm: Tensor | float, sense: int, wanted: bool | Literal["polarised"], rays: Rays
) -> Light | None:
    """What follows the power, or None where nobody asks for it."""
    return _Averaged(lens, wavelength_nm, sense, rays) if wanted else None


class _Averaged:
    """The product over surfaces of (Ts + Tp) / 2, times absorption."""

    def __init__(self, lens: Lens, wavelength_nm: Tensor | float, sense: int, rays: Rays) -> None:
        self._lens, self._wavelength_nm, self._sense = lens, wavelength_nm, sense
        self._absorption = absorption_per_mm(lens, wavelength_nm)
        self._power = torch.ones_like(rays.x)
        self._depth: Tensor | None = None

    def pass_surface(self, k: int, r: Rays, hit: Hit, bent: Rays, q: Tensor, before: Medium, after: Medium) -> None:
        absorbed = self._absorption[k if self._sense > 0 else k + 1]
        if absorbed is not None:
            depth = way_mm(r, hit, before) * absorbed
            self._depth = depth if self._depth is None else self._depth + depth
        if before is not after:
            self._power = self._power * fresnel_transmittance(hit.q, q, before, after)

    def arrived(self, goes_on: Tensor) -> Tensor:
        power = self._power if self._depth is None else self._power * torch.exp(-self._depth)
        return torch.where(goes_on, power, 0.0)


def way_mm(r: Rays, hit: Hit, before: Medium) -> Any:
    """Length of the way from a ray's point to its hit, [N] mm; negative where the hit lies behind it."""
    way = (hit.x - r.x) * r.dx + (hit.y - r.y) * r.dy + (hit.z - r.z) * r.dz
    return way / before.n
