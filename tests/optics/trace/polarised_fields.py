"""Light followed as a vector in the lens frame, surface by surface: what `optics.trace.transmission` is held against.

It needs no angles between s and p directions: Yun, Crabtree and Chipman 2011, "Three-dimensional polarization
ray-tracing calculus I", Applied Optics 50(18). |E|^2 is power.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neurolens.optics.trace.films import Layers, power_amplitudes

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


class Powers(NamedTuple):
    """Power transmitted and reflected by polarisation, each [N]."""

    T_s: Tensor
    T_p: Tensor
    R_s: Tensor
    R_p: Tensor


def powers(*arguments: Any) -> Powers:
    """The powers of `power_amplitudes`, whose arguments these are."""
    pairs = [pair for reflected in (False, True) for pair in power_amplitudes(*arguments, reflected=reflected)]
    return Powers(*(a * a + b * b for a, b in pairs))


def transmittance(*arguments: Any) -> Tensor:
    """The power of unpolarised light that is transmitted."""
    p = powers(*arguments)
    return 0.5 * (p.T_s + p.T_p)


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
