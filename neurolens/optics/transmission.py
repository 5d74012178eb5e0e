"""Power that arrives: what surfaces reflect and glass absorbs on the way, for unpolarised light."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from neurolens.optics import polarisation, thinfilm
from neurolens.optics.media import absorption_per_mm
from neurolens.optics.polarisation import Step, Vector
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import Hit, Medium, Rays, fresnel_transmittance, times


class Passage(Protocol):
    """Power carried along while rays are traced."""

    def pass_surface(self, k: int, r: Rays, hit: Hit, bent: Rays, q: Tensor, before: Medium, after: Medium) -> None:
        """Pass surface k: rays before it (in its frame), where they meet it, rays after it, n' cos t, the media."""

    def arrived(self) -> Tensor:
        """Power of unpolarised light that arrives, [N]; nonsense for rays that do not."""


def passage(
    lens: Lens, wavelength_nm: Tensor | float, sense: int, wanted: bool | Literal["polarised"], like: Tensor
) -> Passage | None:
    """What follows the power of rays of the shape of `like`, or None where nobody asks for it."""
    if not wanted:
        return None
    return (_Polarised if wanted == "polarised" else _Averaged)(lens, wavelength_nm, sense, like)


class _Absorbed:
    """Absorption by Beer and Lambert's law; the surfaces are its children's."""

    def __init__(self, lens: Lens, wavelength_nm: Tensor | float, sense: int, like: Tensor) -> None:
        self._lens, self._wavelength_nm, self._sense = lens, wavelength_nm, sense
        self._absorption = absorption_per_mm(lens, wavelength_nm)
        self._power = torch.ones_like(like)
        self._depth: Tensor | None = None

    def _cross_medium(self, k: int, r: Rays, hit: Hit, before: Medium) -> None:
        absorbed = self._absorption[k if self._sense > 0 else k + 1]
        if absorbed is not None:
            depth = way_mm(r, hit, before) * absorbed
            self._depth = depth if self._depth is None else self._depth + depth

    def _arrived(self, power: Tensor) -> Tensor:
        return power if self._depth is None else power * torch.exp(-self._depth)


class _Averaged(_Absorbed):
    """The product over surfaces of (Ts + Tp) / 2."""

    def pass_surface(self, k: int, r: Rays, hit: Hit, bent: Rays, q: Tensor, before: Medium, after: Medium) -> None:
        self._cross_medium(k, r, hit, before)
        coating = self._lens.surfaces[k].coating
        if coating is not None and coating.layers:
            cos_i = times(hit.q, 1 / before.n)
            self._power = self._power * thinfilm.transmittance(
                cos_i, before.n, after.n, coating.layers, self._wavelength_nm, self._sense
            )
        elif before is not after:
            self._power = self._power * fresnel_transmittance(hit.q, q, before, after)

    def arrived(self) -> Tensor:
        return self._arrived(self._power)


class _Polarised(_Absorbed):
    """The polarisation that each surface gives to the light, followed to the next."""

    def __init__(self, lens: Lens, wavelength_nm: Tensor | float, sense: int, like: Tensor) -> None:
        super().__init__(lens, wavelength_nm, sense, like)
        self._field: Tensor | None = None

    def pass_surface(self, k: int, r: Rays, hit: Hit, bent: Rays, q: Tensor, before: Medium, after: Medium) -> None:
        self._cross_medium(k, r, hit, before)
        surface = self._lens.surfaces[k]
        layers = surface.coating.layers if surface.coating else ()
        if before is after and not layers:
            return
        ahead, behind = ([times(d, 1 / m.n) for d in rays[3:]] for rays, m in ((r, before), (bent, after)))
        step = Step(normal_at(surface, hit), ahead, behind, before.n, after.n, layers, self._sense)
        field = polarisation.unpolarised(ahead) if self._field is None else self._field
        self._field = polarisation.pass_surface(field, step, self._wavelength_nm)

    def arrived(self) -> Tensor:
        return self._arrived(self._power if self._field is None else polarisation.power(self._field))


def way_mm(r: Rays, hit: Hit, before: Medium) -> Any:
    """Length of the way from a ray's point to its hit, [N] mm; negative where the hit lies behind it."""
    way = (hit.x - r.x) * r.dx + (hit.y - r.y) * r.dy + (hit.z - r.z) * r.dz
    return times(way, 1 / before.n)


def normal_at(surface: Surface, hit: Hit) -> Vector:
    """Unit normal towards +z at a meeting point, x, y, z each [N]."""
    if hit.normal is not None:
        return hit.normal
    c = surface.curvature
    return -c * hit.x, -c * hit.y, 1 - c * hit.z
