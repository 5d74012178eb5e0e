"""Antireflection coatings by name, as lens files name them. Source: Macleod, Thin-Film Optical Filters, chapter 3."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Coating

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


# By the names of lens files: what makes them of the media on both sides and a wavelength, and the usual wavelength.
_DESIGNS: dict[str, tuple[Callable[[float, float, float], Coating], float]] = {
    "quarter-wave": (lambda n_before, n_after, at_nm: quarter_wave(at_nm), DESIGN_NM),
    "v-coat": (v_coat, DESIGN_NM),
    "broadband": (broadband, BROADBAND_NM),
}


def design(name: str, n_before: float, n_after: float, file: str | Path = "coating", where: str = "name") -> Coating:
    """A coating by the name that lens files use: "bare", "quarter-wave", "v-coat 500", "broadband".

    Args:
        name: the design, and after a space its wavelength in nm where that is not 550 (broadband: 510).
        n_before, n_after: indices (n_d) on the scene's and on the film's side of the surface.
        file, where: the place to name in an error.

    Raises:
        InputError: an unknown name, a wavelength that is not positive, a design that the media do not allow.
    """
    if name == "bare":
        return Coating(name, ())
    kind, _, wavelength = name.partition(" ")
    make, at_nm = _DESIGNS.get(kind, (None, math.nan))
    try:
        at_nm = float(wavelength) if name != kind else at_nm
    except ValueError:
        at_nm = math.nan
    if make is None or not 0 < at_nm < math.inf:
        raise InputError(file, where, name, KNOWN)
    if n_before == n_after:
        raise InputError(file, where, name, f"a surface between two different media (both are {n_before:g})")
    try:
        return Coating(name, make(n_before, n_after, at_nm).layers)
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
