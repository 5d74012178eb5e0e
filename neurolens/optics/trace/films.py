"""Coatings, which are stacks of thin films, as torch tensors: the power and amplitudes they transmit and reflect.

Powers and amplitudes follow from characteristic matrices. That of a lossless layer has the form [[a, -i b], [-i c, d]]
with real a, b, c, d and a d + b c = 1, and so has every product of them: real arithmetic suffices, which compiles well.
A p wave is followed by its magnetic field, so that nothing is divided by a cosine that may vanish. Fields go as exp(-i
omega t). Sources: Born and Wolf, 1.6.2; Macleod, Thin-Film Optical Filters, chapters 2 and 3.

Arguments are the same everywhere. `cos_i` [N] is the cosine of incidence, in [0, 1]. `n_before` and `n_after` (number
or [N]) are the indices of the media in the order in which light meets them. `layers` are (refractive index, thickness
in nm) from the scene's side, or (n_d, thickness in nm, V_d), as in `prescription.Coating`. `sense` is +1 for light
towards the film, -1 for light towards the scene. `wavelength_nm` (in vacuum) is a number or [N].

Results are [N] in the dtype of `cos_i` and never NaN: beyond the critical angle, and for a cosine that is NaN, T = 0
and R = 1. They are differentiable, also with respect to layers given as 0-d tensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neurolens.optics.lens.glass import index_at
from neurolens.optics.trace.arithmetic import times
from neurolens.optics.trace.surfaces import Hit, Medium
from neurolens.optics.trace.transmission import FLOOR, NO_FILM, Passage, Shares, times_film


def coated_shares(
    cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int, reflected: bool = False
) -> Shares:
    """Return the shares of power that a surface transmits, or with `reflected` reflects."""
    (a, b), (c, d) = power_amplitudes(cos_i, n_before, n_after, layers, wavelength_nm, sense, reflected)
    s, p = a * a + b * b, c * c + d * d
    return Shares((s + p) * 0.5, (s - p) * 0.5, a * c + b * d, b * c - a * d)


Layers = Sequence[tuple[Any, ...]]

# Where the squared phase in a layer is below this, sine and cosine are summed as series, whose derivatives keep their
# digits.
SMALL_PHASE2 = 1e-2


class Response(NamedTuple):
    """The response of a stack to one polarisation, for one and the same wave behind it.

    With it, t = 2 before fade / plus and r = minus / plus.

    Attributes:
        before, after: admittances around the stack; where the wave behind is evanescent, `after` is divided by i.
        plus, minus: real and imaginary part u + i v of the incident and the reflected wave.
        passes: where the wave behind is not evanescent.
        fade: the factor that has kept evanescent layers from overflowing.
    """

    before: Tensor
    after: Tensor
    plus: tuple[Tensor, Tensor]
    minus: tuple[Tensor, Tensor]
    passes: Tensor
    fade: Any


def reflectance(
    cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int = 1
) -> Tensor:
    """Return the share of unpolarised power that is reflected, (Rs + Rp) / 2 in [0, 1], [N]."""
    (a, b), (c, d) = power_amplitudes(cos_i, n_before, n_after, layers, wavelength_nm, sense, reflected=True)
    return 0.5 * (a * a + b * b + c * c + d * d)


def power_amplitudes(
    cos_i: Tensor,
    n_before: Any,
    n_after: Any,
    layers: Layers,
    wavelength_nm: Any,
    sense: int = 1,
    reflected: bool = False,
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return the s and the p amplitude, each as (real, imaginary) [N], scaled so that squared moduli are powers.

    They are of transmission, or with `reflected` of reflection. Signs are those of Born and Wolf, 1.5.2: r_p = -r_s at
    normal incidence; s is perpendicular to the plane of incidence, and p = k x s. Beyond the critical angle t is 0.
    """
    s, p = _responses(cos_i, n_before, n_after, layers, wavelength_nm, sense, phase_beyond=reflected)
    if reflected:
        return _reflected_amplitude(s), _reflected_amplitude(p)
    return _transmitted_amplitude(s), _transmitted_amplitude(p)


def _over_plus(r: Response, x: Any, y: Any) -> tuple[Tensor, Tensor]:
    """Return (x + i y) / plus; 0 where the incident wave vanishes (exactly grazing between equal media) or is NaN."""
    u, v = r.plus
    square = u * u + v * v
    sound = square > 0
    inverse = 1.0 / torch.where(sound, square, 1.0)
    return torch.where(sound, (x * u + y * v) * inverse, 0.0), torch.where(sound, (y * u - x * v) * inverse, 0.0)


def _reflected_amplitude(r: Response) -> tuple[Tensor, Tensor]:
    x, y = _over_plus(r, *r.minus)
    u, v = r.plus
    # Undefined cases count as reflected, as grazing light does.
    return torch.where(u * u + v * v > 0, x, -1.0), y


def _transmitted_amplitude(r: Response) -> tuple[Tensor, Tensor]:
    square = r.before * r.after
    lit = r.passes & (square > 0)
    x, y = _over_plus(r, 2 * torch.sqrt(torch.where(lit, square, 1.0)) * r.fade, 0.0)
    return torch.where(lit, x, 0.0), torch.where(lit, y, 0.0)


def _responses(
    cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int, phase_beyond: bool
) -> tuple[Response, Response]:
    """Return the s and the p response of the stack.

    In here q is the index times the cosine of the angle in a medium, which is the admittance of s.

    Args:
        phase_beyond: whether to compute the phase of the reflected wave beyond the critical angle, too.
    """
    q0 = n_before * cos_i
    q0_2 = q0 * q0
    q2 = q0_2 + (n_after - n_before) * (n_after + n_before)
    passes = q2 > FLOOR
    size = q2.abs() if phase_beyond else q2
    q = torch.sqrt(torch.where(size > FLOOR, size, 1.0))
    if phase_beyond:
        q = torch.where(size > FLOOR, q, 0.0)
    wave_number = 2 * math.pi / wavelength_nm
    s = p = NO_FILM
    fade: Any = 1.0
    for n_d, thickness_nm, *V_d in layers if sense > 0 else reversed(layers):
        index = index_at(n_d, V_d[0], wavelength_nm) if V_d else n_d
        index2 = index * index
        layer_q2 = q0_2 + (index - n_before) * (index + n_before)
        c, e, f, layer_fade = _film(layer_q2, wave_number * thickness_nm)
        fade = fade * layer_fade
        s, p = times_film(s, p, (c, e, f), index2)
    response_s = _response(q0, q, s, passes, fade, phase_beyond)
    q0_p, q_p = q0 / (n_before * n_before), q / (n_after * n_after)
    return response_s, _response(q0_p, q_p, p, passes, fade, phase_beyond)


def _response(
    before: Tensor, after: Tensor, m: tuple[Any, ...], passes: Tensor, fade: Any, phase_beyond: bool
) -> Response:
    a, b, c, d = m
    x, y, z = before * a, after * d, before * after * b
    plus, minus = (x + y, -(z + c)), (x - y, c - z)
    if phase_beyond:
        # The admittance behind is i times `after`.
        real, imaginary = x + z, y - c
        plus = torch.where(passes, plus[0], real), torch.where(passes, plus[1], imaginary)
        minus = torch.where(passes, minus[0], real), torch.where(passes, minus[1], -imaginary)
    return Response(before, after, plus, minus, passes, fade)


def _film(q2: Tensor, phase_per_q: Any) -> tuple[Tensor, Tensor, Tensor, Any]:
    """Return cos, sin / q and q sin of the phase q * `phase_per_q` of a film, and the factor `fade` in all three.

    Below q2 = 0 they turn into those of evanescent waves (cosh, sinh). Since cos and sin / q are entire functions of
    q2, neither they nor their derivatives have a kink there. The factor, exp(-phase) for evanescent waves, keeps a
    thick film from overflowing.
    """
    x = q2 * phase_per_q**2
    if x.device.type == "cpu" and not torch.compiler.is_compiling() and not (x < SMALL_PHASE2).any():
        phase = torch.sqrt(x)  # nearly always: below, each ray is computed in all three ways
        sine = torch.sin(phase) / phase * phase_per_q
        return torch.cos(phase), sine, q2 * sine, 1.0
    small = x.abs() < SMALL_PHASE2
    phase = torch.sqrt(torch.where(small, 1.0, x.abs()))
    deep = (x < 0) & ~small
    fade = torch.where(deep, torch.exp(-phase), 1.0)
    even, odd = 0.5 * (1 + fade * fade), 0.5 * (1 - fade * fade) / phase
    y = torch.where(small, x, 0.0)
    cosine = 1 - y / 2 * (1 - y / 12 * (1 - y / 30 * (1 - y / 56 * (1 - y / 90))))
    sine = 1 - y / 6 * (1 - y / 20 * (1 - y / 42 * (1 - y / 72 * (1 - y / 110))))
    cosine = torch.where(small, cosine, torch.where(deep, even, torch.cos(phase)))
    sine = torch.where(small, sine, torch.where(deep, odd, torch.sin(phase) / phase)) * phase_per_q
    return cosine, sine, q2 * sine, fade


class TensorPassage(Passage):
    """Follows the power of rays while they are traced with tensors."""

    def coated(self, k: int, met: Hit, q: Any, media: tuple[Medium, Medium], sense: int, reflected: bool) -> Shares:
        """Return the shares that the coating of surface k transmits or reflects; see `pass_surface`."""
        (before, after), coating = media, self.lens.surfaces[k].coating
        cos_i = times(met.q, 1 / before.n)
        layers = coating.layers if coating else ()
        return coated_shares(cos_i, before.n, after.n, layers, self.wavelength_nm, sense, reflected)
