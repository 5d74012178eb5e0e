"""Power that arrives: what surfaces reflect and glass absorbs on the way, averaged over polarisation or with it.

By default the transmittance of unpolarised light is the product over surfaces of (Ts + Tp) / 2: up to about 0.01
from exact polarised transmission, since one surface polarises the light that the next one meets. For that the field
is followed as a vector in the lens frame, which needs no angles between s and p directions: Yun, Crabtree and
Chipman 2011, "Three-dimensional polarization ray-tracing calculus I", Applied Optics 50(18). |E|^2 is power.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neurolens.optics.coatings import Layers, power_amplitudes, transmittance
from neurolens.optics.passing import absorption_per_mm
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import Hit, Medium, Rays, fresnel_transmittance, times

Vector = Sequence[Tensor]  # x, y, z, each [N], lens frame


class Step(NamedTuple):
    """What one surface does to N rays.

    Attributes:
        normal: x, y, z of the unit normal where the rays meet the surface, of either sign, each [N].
        before, after: unit directions, x, y, z each [N].
        n_before, n_after: indices (number or [N]) in front of the surface and beyond it as the light meets them.
        layers: coating, as in `prescription.Coating`; empty where bare.
        sense: +1 for light towards the film, -1 towards the scene: the order in which it meets the layers.
        reflected: whether the rays are reflected there (ghosts) rather than transmitted.
    """

    normal: Vector
    before: Vector
    after: Vector
    n_before: Any
    n_after: Any
    layers: Layers = ()
    sense: int = 1
    reflected: bool = False


def step_at(
    surface: Surface, hit: Hit, r: Rays, away: Rays, before: Medium, after: Medium, sense: int, reflected: bool = False
) -> Step:
    """The step of rays that meet a surface and go away from it; the media are those as the light meets them."""
    pairs = (r, before), (away, before if reflected else after)
    ahead, behind = ([times(d, 1 / m.n) for d in rays[3:]] for rays, m in pairs)
    layers = surface.coating.layers if surface.coating else ()
    return Step(normal_at(surface, hit), ahead, behind, before.n, after.n, layers, sense, reflected)


def unpolarised(direction: Vector) -> Tensor:
    """Two orthogonal fields of unit power across unit directions (x, y, z each [N]), for `pass_surface` and `power`.

    Returns [2, 2, 3, N]: real and imaginary part of the two fields, x, y, z. Pairs of reals compile, complex numbers do
    not.
    """
    k = _stacked(direction)
    s = _across(k, k)
    fields = torch.stack([s, _cross(k, s)])
    return torch.stack([fields, torch.zeros_like(fields)])


def pass_surface(field: Tensor, step: Step, wavelength_nm: Any) -> Tensor:
    """What becomes of fields [2, 2, 3, N] (see `unpolarised`) at one surface.

    They are resolved along s and p, the surface acts on each, and they are added up across the new direction.
    """
    if not step.layers and not step.reflected and step.n_before is step.n_after:
        return field
    normal, before, after = _stacked(step.normal), _stacked(step.before), _stacked(step.after)
    cos_i = (normal * before).sum(0).abs()
    media = step.n_before, step.n_after
    s_part, p_part = power_amplitudes(cos_i, *media, step.layers, wavelength_nm, step.sense, step.reflected)
    s = _across(before, normal)
    along_s, along_p = (field * s).sum(2), (field * _cross(before, s)).sum(2)
    return _times(along_s, *s_part) * s + _times(along_p, *p_part) * _cross(after, s)


def power(field: Tensor) -> Tensor:
    """Mean power [N] of the two fields of `unpolarised`, which is that of unpolarised light."""
    return 0.5 * (field * field).sum((0, 1, 2))


def _times(along: Tensor, real: Tensor, imaginary: Tensor) -> Tensor:
    """Complex product of components [2, 2, N] and an amplitude, as [2, 2, 1, N]."""
    re, im = along
    return torch.stack([re * real - im * imaginary, re * imaginary + im * real]).unsqueeze(2)


def _across(direction: Tensor, normal: Tensor) -> Tensor:
    """Unit vectors [3, N] across direction and normal; where these agree, any perpendicular ones."""
    s = _cross(direction, normal)
    length2 = (s * s).sum(0)
    aligned = ~(length2 > torch.finfo(s.dtype).eps)
    x, y, z = direction
    zero = torch.zeros_like(x)
    other = torch.where(x.abs() < 0.6, torch.stack([zero, z, -y]), torch.stack([-z, zero, x]))
    s = torch.where(aligned, other, s)
    length2 = torch.where(aligned, (other * other).sum(0), length2)
    return s / torch.sqrt(length2)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=0)


def _stacked(vector: Vector) -> Tensor:
    return torch.stack(tuple(vector))


def passage(
    lens: Lens, wavelength_nm: Tensor | float, sense: int, wanted: bool | Literal["polarised"], like: Tensor
) -> _Averaged | _Polarised | None:
    """The tracker of the power of rays of the shape of `like`, or None where it is not wanted."""
    if not wanted:
        return None
    return (_Polarised if wanted == "polarised" else _Averaged)(lens, wavelength_nm, sense, like)


class _Absorbed:
    """Power carried along while rays are traced: absorption by Beer and Lambert's law; surfaces are its children's:
    `pass_surface` for surface k (rays before it, their hit, rays after it, n' cos t, media); `arrived`, unpolarised,
    [N].
    """

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
            media = before.n, after.n
            share = transmittance(cos_i, *media, coating.layers, self._wavelength_nm, self._sense)
            self._power = self._power * share
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
        step = step_at(self._lens.surfaces[k], hit, r, bent, before, after, self._sense)
        if before is after and not step.layers:
            return
        field = unpolarised(step.before) if self._field is None else self._field
        self._field = pass_surface(field, step, self._wavelength_nm)

    def arrived(self) -> Tensor:
        return self._arrived(self._power if self._field is None else power(self._field))


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
