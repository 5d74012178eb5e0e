"""Antireflection coatings by name, and what stacks of thin films do to light, vectorised over rays.

Powers and amplitudes follow from characteristic matrices. A lossless layer's has the form [[a, -i b], [-i c, d]] with
real a, b, c, d and a d + b c = 1, and so has every product of them: real arithmetic suffices, which compiles well. A p
wave is followed by its magnetic field, so that nothing is divided by a cosine that may vanish. Fields go as
exp(-i omega t). Sources: Born and Wolf, Principles of Optics, 1.6.2; Macleod, Thin-Film Optical Filters, chapters 2, 3.

Throughout: `cos_i` [N] is the cosine of incidence in [0, 1]; `n_before` and `n_after` (number or [N]) are the indices
of the media as the light meets them; `layers` are (refractive index, thickness in nm) from the scene's side, as in
`prescription.Coating`; `sense` is +1 for light towards the film and -1 for light towards the scene; `wavelength_nm`
(in vacuum) is a number or [N]. Results are [N] in the dtype of `cos_i`, differentiable, also with respect to layers
given as 0-d tensors, and never NaN: beyond the critical angle, and for a cosine that is NaN, T = 0 and R = 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Coating

Layers = Sequence[tuple[Any, Any]]

# Below this square of the phase in a layer, sine and cosine are summed as series, whose derivatives keep their digits.
SMALL_PHASE2 = 1e-2

# Below this (n cos)^2 behind the stack, light counts as totally reflected: float32 products of such cosines underflow.
FLOOR = 1e-30


class Powers(NamedTuple):
    """Power transmitted and reflected by polarisation, each [N], in [0, 1]."""

    T_s: Tensor
    T_p: Tensor
    R_s: Tensor
    R_p: Tensor


class Response(NamedTuple):
    """One polarisation: u + i v of the incident (`plus`) and the reflected (`minus`) wave that make the same wave
    behind the stack, and the admittances around it; t = 2 before fade / plus, r = minus / plus.

    `passes` tells where the wave behind is not evanescent; there `after` is its admittance, else that divided by i.
    `fade` is the factor that kept evanescent layers from overflowing.
    """

    before: Tensor
    after: Tensor
    plus: tuple[Tensor, Tensor]
    minus: tuple[Tensor, Tensor]
    passes: Tensor
    fade: Any


def transmittance(
    cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int = 1
) -> Tensor:
    """Unpolarised power transmitted, (Ts + Tp) / 2 in [0, 1], [N]. No films: Fresnel's formulas."""
    s, p = _responses(cos_i, n_before, n_after, layers, wavelength_nm, sense, phase_beyond=False)
    return 0.5 * (_transmitted(s) + _transmitted(p))


def reflectance(
    cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int = 1
) -> Tensor:
    """Unpolarised power reflected, (Rs + Rp) / 2 in [0, 1], [N]; 1 - transmittance up to rounding."""
    s, p = _responses(cos_i, n_before, n_after, layers, wavelength_nm, sense, phase_beyond=False)
    return 0.5 * (_reflected(s) + _reflected(p))


def powers(cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int = 1) -> Powers:
    """Power transmitted and reflected for each polarisation."""
    s, p = _responses(cos_i, n_before, n_after, layers, wavelength_nm, sense, phase_beyond=False)
    return Powers(_transmitted(s), _transmitted(p), _reflected(s), _reflected(p))


def power_amplitudes(
    cos_i: Tensor,
    n_before: Any,
    n_after: Any,
    layers: Layers,
    wavelength_nm: Any,
    sense: int = 1,
    reflected: bool = False,
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """(real, imaginary) of the s and of the p amplitude, scaled so that its squared modulus is power, each [N].

    Of transmission, or with `reflected` of reflection, with the signs of Born and Wolf, 1.5.2: r_p = -r_s at normal
    incidence; s is perpendicular to the plane of incidence, p = k x s. Beyond the critical angle, t is 0.
    """
    s, p = _responses(cos_i, n_before, n_after, layers, wavelength_nm, sense, phase_beyond=reflected)
    if reflected:
        return _reflected_amplitude(s), _reflected_amplitude(p)
    return _transmitted_amplitude(s), _transmitted_amplitude(p)


def _transmitted(r: Response) -> Tensor:
    u, v = r.plus
    square = u * u + v * v
    # NaN (an invalid wavelength) fails the comparison.
    return torch.where(r.passes & (square > 0), 4 * r.fade * r.fade * r.before * r.after / square, 0.0)


def _reflected(r: Response) -> Tensor:
    (u, v), (x, y) = r.plus, r.minus
    square = u * u + v * v
    return torch.where(r.passes & (square > 0), (x * x + y * y) / square, 1.0)


def _over_plus(r: Response, x: Any, y: Any) -> tuple[Tensor, Tensor]:
    """(x + i y) / plus; 0 where the incident wave vanishes (exactly grazing between equal media) or is NaN."""
    u, v = r.plus
    square = u * u + v * v
    sound = square > 0
    inverse = 1.0 / torch.where(sound, square, 1.0)
    return torch.where(sound, (x * u + y * v) * inverse, 0.0), torch.where(sound, (y * u - x * v) * inverse, 0.0)


def _reflected_amplitude(r: Response) -> tuple[Tensor, Tensor]:
    x, y = _over_plus(r, *r.minus)
    u, v = r.plus
    # Undefined cases count as reflected, like grazing light.
    return torch.where(u * u + v * v > 0, x, -1.0), y


def _transmitted_amplitude(r: Response) -> tuple[Tensor, Tensor]:
    square = r.before * r.after
    lit = r.passes & (square > 0)
    x, y = _over_plus(r, 2 * torch.sqrt(torch.where(lit, square, 1.0)) * r.fade, 0.0)
    return torch.where(lit, x, 0.0), torch.where(lit, y, 0.0)


def _responses(
    cos_i: Tensor, n_before: Any, n_after: Any, layers: Layers, wavelength_nm: Any, sense: int, phase_beyond: bool
) -> tuple[Response, Response]:
    """The s and the p response of the stack; `phase_beyond`: whether to compute the phase beyond the critical angle.

    q stands for n cos of the angle in each medium (the admittance of s).
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
    s: tuple[Any, ...] = (1.0, 0.0, 0.0, 1.0)
    p = s
    fade: Any = 1.0
    for index, thickness_nm in layers if sense > 0 else reversed(layers):
        index2 = index * index
        layer_q2 = q0_2 + (index - n_before) * (index + n_before)
        if not phase_beyond and _always_propagates(index, n_before, n_after):
            c, e, f = _propagating(layer_q2, wave_number * thickness_nm)
        else:
            c, e, f, layer_fade = _propagating_or_evanescent(layer_q2, wave_number * thickness_nm)
            fade = fade * layer_fade
        s = _times(s, (c, e, f, c))
        p = _times(p, (c, index2 * e, f / index2, c))
    response_s = _response(q0, q, s, passes, fade, phase_beyond)
    q0_p, q_p = q0 / (n_before * n_before), q / (n_after * n_after)
    return response_s, _response(q0_p, q_p, p, passes, fade, phase_beyond)


def _times(m: tuple[Any, ...], k: tuple[Any, ...]) -> tuple[Any, ...]:
    """Product of two matrices [[a, -i b], [-i c, d]] given as (a, b, c, d)."""
    return (m[0] * k[0] - m[1] * k[2], m[0] * k[1] + m[1] * k[3], m[2] * k[0] + m[3] * k[2], m[3] * k[3] - m[2] * k[1])


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


def _always_propagates(index: Any, n_before: Any, n_after: Any) -> bool:
    """Whether light that gets through cannot be evanescent in a layer: its n sin is at most n of both media."""
    known = isinstance(index, float | int)
    return known and any(isinstance(n, float | int) and n < index for n in (n_before, n_after))


def _propagating(q2: Tensor, phase_per_q: Any) -> tuple[Tensor, Tensor, Tensor]:
    """cos, sin / q and q sin of the phase q phase_per_q; finite but meaningless where q2 <= 0."""
    q = torch.sqrt(torch.where(q2 > 0, q2, 1.0))
    phase = q * phase_per_q
    sine = torch.sin(phase)
    return torch.cos(phase), sine / q, sine * q


def _propagating_or_evanescent(q2: Tensor, phase_per_q: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same through q2 = 0 to evanescent waves (cosh, sinh), and the factor `fade` that all three contain.

    cos and sin / q are entire functions of q2: there is no kink at q2 = 0, and none in the derivatives. Without the
    factor exp(-phase) of evanescent waves a thick film would overflow.
    """
    x = q2 * phase_per_q**2
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


# Where a design is best over the visible by default: the triple layer falls off faster towards violet.
DESIGN_NM = 550.0
BROADBAND_NM = 510.0
MAGNESIUM_FLUORIDE = 1.38
ALUMINA = 1.63
TANTALA = 2.10  # zirconia is close

# Pairs of (outer, inner) films in the order tried: the second where the glass is too dense for the first.
V_PAIRS = ((MAGNESIUM_FLUORIDE, TANTALA), (MAGNESIUM_FLUORIDE, ALUMINA))

KNOWN = '"bare", "quarter-wave", "v-coat" or "broadband", the last three with an optional wavelength in nm (550; 510)'


def quarter_wave(at_nm: float = DESIGN_NM) -> Coating:
    """One film of magnesium fluoride a quarter of a wave thick: R = ((n0 ns - n^2) / (n0 ns + n^2))^2 at `at_nm`."""
    return Coating(f"quarter-wave {at_nm:g}", ((MAGNESIUM_FLUORIDE, at_nm / (4 * MAGNESIUM_FLUORIDE)),))


def v_coat(n_before: float, n_after: float, at_nm: float = DESIGN_NM) -> Coating:
    """Two films without any reflection at `at_nm` and normal incidence (Macleod, section 3.2: equations of tan^2).

    Magnesium fluoride over tantala (2.10), over alumina (1.63) for glass above 1.90; of the two solutions the thinner,
    which is the broader. `n_before` and `n_after` are the media on the scene's and on the film's side.

    Raises:
        InputError: no two films of these indices bring the reflection of these media to zero.
    """
    low, high = sorted((n_before, n_after))
    for pair in V_PAIRS:
        solution = _v_phases(low, high, *pair)
        if solution is not None:
            layers = tuple(_film(n, phase, at_nm) for n, phase in zip(pair, solution, strict=True))
            return Coating(f"v-coat {at_nm:g}", _oriented(layers, n_before, n_after))
    tried = " or ".join(f"{a:g} over {b:g}" for a, b in V_PAIRS)
    expected = f"media whose reflection films of {tried} can cancel"
    raise InputError("v-coat", "media", f"({n_before:g} to {n_after:g})", expected)


def broadband(n_before: float, n_after: float, at_nm: float = BROADBAND_NM) -> Coating:
    """The classic triple layer, quarter, half and quarter wave from the rarer side (Cox, Hass and Thelen 1962).

    The inner film's index, outer * sqrt(n_high / n_low), leaves no reflection at `at_nm`; mixtures of oxides have such
    indices (1.7 on crown glass).
    """
    low, high = sorted((n_before, n_after))
    inner, quarter = MAGNESIUM_FLUORIDE * math.sqrt(high / low), math.pi / 2
    films = ((MAGNESIUM_FLUORIDE, quarter), (TANTALA, 2 * quarter), (inner, quarter))
    layers = tuple(_film(index, phase, at_nm) for index, phase in films)
    return Coating(f"broadband {at_nm:g}", _oriented(layers, n_before, n_after))


def design(name: str, n_before: float, n_after: float, file: str | Path = "coating", where: str = "name") -> Coating:
    """A coating by the name that lens files use: "bare", "quarter-wave", "v-coat 500", "broadband".

    Args:
        name: the design, and after a space its wavelength in nm where that is not 550 (broadband: 510).
        n_before, n_after: indices (n_d) on the scene's and on the film's side of the surface.
        file, where: the place to name in an error.

    Raises:
        InputError: an unknown name, a wavelength that is not positive, a design that the media do not allow.
    """
    kind, _, wavelength = name.partition(" ")
    if kind not in ("bare", "quarter-wave", "v-coat", "broadband") or (kind == "bare" and name != kind):
        raise InputError(file, where, name, KNOWN)
    if kind == "bare":
        return Coating(name, ())
    usual_nm = BROADBAND_NM if kind == "broadband" else DESIGN_NM
    try:
        at_nm = float(wavelength) if name != kind else usual_nm
    except ValueError:
        at_nm = math.nan
    if not 0 < at_nm < math.inf:
        raise InputError(file, where, name, KNOWN)
    if n_before == n_after:
        raise InputError(file, where, name, f"a surface between two different media (both are {n_before:g})")
    if kind == "quarter-wave":
        return Coating(name, quarter_wave(at_nm=at_nm).layers)
    if kind == "broadband":
        return Coating(name, broadband(n_before, n_after, at_nm).layers)
    try:
        return Coating(name, v_coat(n_before, n_after, at_nm).layers)
    except InputError as error:
        raise InputError(file, where, name, f"another design: {error}") from None


def _film(index: float, phase: float, at_nm: float) -> tuple[float, float]:
    """(index, thickness in nm) of a film whose phase thickness is `phase` rad at `at_nm`."""
    return index, phase * at_nm / (2 * math.pi * index)


def _oriented(
    from_low: tuple[tuple[float, float], ...], n_before: float, n_after: float
) -> tuple[tuple[float, float], ...]:
    """Layers given from the side of the lower index, as seen from the scene's side."""
    return from_low if n_before <= n_after else from_low[::-1]


def _v_phases(n_0: float, n_s: float, n_1: float, n_2: float) -> tuple[float, float] | None:
    """Phase thicknesses (rad) of films n_1, n_2 that match medium n_0 to n_s > n_0, the thinner pair; None if none."""
    across = n_1 * n_1 * n_s - n_0 * n_2 * n_2
    below, above = n_0 * n_s - n_1 * n_1, n_2 * n_2 - n_0 * n_s
    if across == 0 or below == 0 or not (n_s - n_0) * above / (across * below) > 0:
        return None
    tangent = math.sqrt((n_s - n_0) * above / (across * below)) * n_1
    pairs = []
    for t_1 in (tangent, -tangent):
        t_2 = t_1 * below * n_2 / (above * n_1)
        pairs.append((math.atan(t_1) % math.pi, math.atan(t_2) % math.pi))
    return min(pairs, key=lambda pair: pair[0] / n_1 + pair[1] / n_2)
