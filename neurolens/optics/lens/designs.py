"""Antireflection coatings by name, as lens files name them. Source: Macleod, Thin-Film Optical Filters, chapter 3.

"quarter-wave", "v-coat" and "broadband" are the textbook's, of films without dispersion. "single-layer", "three-layer"
and "multi-layer" are what lenses had in the 1940s to 60s, from 1970 on, and have today, of films that disperse.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.lensname import year_of
from neurolens.optics.lens.glass import index_at, nearest
from neurolens.optics.lens.prescription import Coating, Lens

# Where a design is best over the visible by default: the triple layer falls off faster towards violet.
DESIGN_NM = 550.0
BROADBAND_NM = 510.0
COATED, MULTI_COATED = 1940, 1970  # the years from which on lenses have one layer, and several
MAGNESIUM_FLUORIDE = 1.38
ALUMINA = 1.63
TANTALA = 2.10  # zirconia is close

# Pairs of (outer, inner) films in the order tried: the second where the glass is too dense for the first.
V_PAIRS = ((MAGNESIUM_FLUORIDE, TANTALA), (MAGNESIUM_FLUORIDE, ALUMINA))

# n_d and V_d of films: Dodge, Appl. Opt. 23 (1984), 1980 (the crystal's ordinary ray; evaporated films have 1.38); Gao
# et al., Opt. Express 20 (2012), 15734; Boidin et al., Ceramics International 42 (2016), 1177; Malitson, JOSA 55
# (1965), 1205.
FLUORIDE, TANTALUM_OXIDE, ALUMINIUM_OXIDE, SILICA = (1.3777, 106.2), (2.1462, 22.0), (1.6798, 55.3), (1.4585, 67.8)

# Thicknesses in nm of fluoride, tantalum oxide and silica, oxide, silica, oxide, silica, from the air, by the index of
# the glass.
MULTI_LAYER = {
    1.43: (98.5, 39.2, 6.8, 74.9, 38.2, 13.2, 17.3),
    1.52: (98.9, 38.9, 7.0, 77.3, 36.5, 16.4, 44.0),
    1.62: (99.5, 38.2, 7.6, 79.9, 33.5, 20.5, 32.7),
    1.75: (100.1, 37.2, 8.3, 83.1, 29.0, 25.9, 25.9),
    1.90: (100.6, 36.1, 9.1, 86.7, 23.8, 32.4, 20.3),
    2.05: (100.9, 35.1, 9.8, 89.9, 18.7, 39.9, 15.4),
}

KNOWN = (
    '"bare", "quarter-wave", "v-coat", "broadband", "single-layer", "three-layer" or "multi-layer", all but the first \
with an optional wavelength in nm (550; of the broad and of three layers 510)'
)


Films = tuple[tuple[float, ...], ...]  # (index, thickness in nm) of each, or (n_d, thickness, V_d), as of `Coating`


def _quarter_wave(_low: float, _high: float, at_nm: float) -> Films:
    """One film of magnesium fluoride a quarter of a wave thick: R = ((n0 ns - n^2) / (n0 ns + n^2))^2 at `at_nm`."""
    return ((MAGNESIUM_FLUORIDE, at_nm / (4 * MAGNESIUM_FLUORIDE)),)


def _v_coat(low: float, high: float, at_nm: float) -> Films:
    """Two films without any reflection at `at_nm` and normal incidence (Macleod, section 3.2: equations of tan^2).

    Magnesium fluoride over tantala (2.10), over alumina (1.63) for glass above 1.90; of two solutions the thinner one
    is taken, whose band is broader.

    Raises:
        InputError: no two films of these indices bring the reflection of these media to zero.
    """
    for pair in V_PAIRS:
        solution = _v_phases(low, high, *pair)
        if solution is not None:
            return tuple(_film(n, phase, at_nm) for n, phase in zip(pair, solution, strict=True))
    tried = " or ".join(f"{a:g} over {b:g}" for a, b in V_PAIRS)
    raise InputError("v-coat", "media", f"({low:g} to {high:g})", f"media whose reflection films of {tried} can cancel")


def _broadband(low: float, high: float, at_nm: float) -> Films:
    """The classic triple layer, quarter, half and quarter wave from the rarer side (Cox, Hass and Thelen 1962).

    The inner film's index, outer * sqrt(n_high / n_low), leaves no reflection at `at_nm`; mixtures of oxides have such
    indices (1.7 on crown glass).
    """
    inner, quarter = MAGNESIUM_FLUORIDE * math.sqrt(high / low), math.pi / 2
    films = ((MAGNESIUM_FLUORIDE, quarter), (TANTALA, 2 * quarter), (inner, quarter))
    return tuple(_film(index, phase, at_nm) for index, phase in films)


def _single_layer(_low: float, _high: float, at_nm: float) -> Films:
    """The quarter wave of a fluoride that disperses: what lenses had from the 1940s to the 60s."""
    return (_dispersive(FLUORIDE, 0.25, at_nm),)


def _three_layer(low: float, high: float, at_nm: float) -> Films:
    """The broadband coating of films that disperse: multi-coated lenses from 1970 on.

    The inner film is a mixture of oxides with the index that leaves no reflection at `at_nm`, if the media have there
    the indices given, and alumina's V_d.
    """
    outer, middle = _dispersive(FLUORIDE, 0.25, at_nm), _dispersive(TANTALUM_OXIDE, 0.5, at_nm)
    inner = index_at(*FLUORIDE, at_nm) * math.sqrt(high / low)
    V_d = ALUMINIUM_OXIDE[1]
    # index_at is linear in n_d: n_d + (n_d - 1) rise = inner.
    rise = index_at(2.0, V_d, at_nm) - 2.0
    return outer, middle, _dispersive(((inner + rise) / (1 + rise), V_d), 0.25, at_nm)


def _multi_layer(low: float, high: float, at_nm: float) -> Films:
    """Seven films on glass against air: today's broadband coatings.

    Fluoride over tantalum oxide and silica in turn; thicknesses by least squares of the reflected amplitude from 400 to
    700 nm at 0 and 30 degrees, for six glasses, linear between them, and scaled by `at_nm` / 550. Rarer and denser
    glasses have the films of the nearest of the six.

    Raises:
        InputError: a surface that has no air on either side.
    """
    if low != 1:
        raise InputError("multi-layer", "media", f"({low:g} to {high:g})", "air on one side")
    films = (FLUORIDE, *(TANTALUM_OXIDE, SILICA) * 3)
    table = zip(*MULTI_LAYER.values(), strict=True)
    thick = [float(np.interp(high, list(MULTI_LAYER), row)) * at_nm / DESIGN_NM for row in table]
    return tuple((n_d, nm, V_d) for (n_d, V_d), nm in zip(films, thick, strict=True))


# By the names of lens files: films from the side of the lower index, of both indices and a wavelength; the usual one.
_DESIGNS: dict[str, tuple[Callable[[float, float, float], Films], float]] = {
    "quarter-wave": (_quarter_wave, DESIGN_NM),
    "v-coat": (_v_coat, DESIGN_NM),
    "broadband": (_broadband, BROADBAND_NM),
    "single-layer": (_single_layer, DESIGN_NM),
    "three-layer": (_three_layer, BROADBAND_NM),
    "multi-layer": (_multi_layer, DESIGN_NM),
}


def design(name: str, n_before: float, n_after: float, file: str | Path = "coating", where: str = "name") -> Coating:
    """Return a coating by the name that lens files use: "bare", "quarter-wave", "v-coat 500", "broadband".

    Args:
        name: the design, and after a space its wavelength in nm where that is not the usual one.
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
        films = make(min(n_before, n_after), max(n_before, n_after), at_nm)
    except InputError as error:
        raise InputError(file, where, name, f"another design: {error}") from None
    return Coating(name, films if n_before < n_after else films[::-1])


def assumed(year: int | None) -> str:
    """Name the coating that glass against air is taken to have by the year of the design; the latest without a year.

    Carl Zeiss patented coatings in 1935, which photographic lenses had from about 1940 on; multi-coated lenses are sold
    since about 1970.
    """
    if year is None or year >= MULTI_COATED:
        return "multi-layer"
    return "bare" if year < COATED else "single-layer"


def with_assumptions(lens: Lens) -> Lens:
    """Return a lens with what its source leaves open and no product lacks: coatings, and absorption of glass.

    Its surfaces between glass and air have the coating that is `assumed` by the first year that the source names.
    Glasses without a name absorb as the catalogue glass with the nearest n_d and V_d. A lens for other than visible
    light stays as it is.
    """
    if not lens.visible:
        return lens
    name, rows, before = assumed(year_of(lens.source)), [], float(lens.object_medium.n_d)
    for s in lens.surfaces:
        n_d = float(s.n_d)
        given = s.coating is not None and s.coating.origin != "assumed"
        if not given and before != n_d and 1.0 in (before, n_d):
            s = replace(s, coating=replace(design(name, before, n_d), origin="assumed"))
        if s.glass is None and s.V_d is not None and n_d > 1 and not s.absorption_per_mm:
            s = replace(s, absorbs_as=str(nearest(n_d, s.V_d)))
        rows.append(s)
        before = n_d
    return replace(lens, surfaces=tuple(rows))


def coated(lens: Lens, names: str) -> Lens:
    """Return a lens with the coatings that somebody chooses for its surfaces between glass and air.

    Args:
        names: a design, for all surfaces whose coating the source of the lens does not state; "bare" takes every
            coating away, "stated" all but those of the source. Designs of single surfaces follow after commas; they
            replace stated ones, too: "three-layer,s07=bare".

    Raises:
        InputError: a design or surface is unknown, or a design cannot match the media.
    """
    single = {place: name for place, is_one, name in (word.partition("=") for word in names.split(",")) if is_one}
    rest = [word for word in names.split(",") if "=" not in word]
    known = [f"s{k:02d}" for k in range(len(lens.surfaces))]
    if len(rest) > 1 or not set(single) <= set(known):
        expected = f'one design, "bare" or "stated", and others as {known[0]}=NAME to {known[-1]}=NAME'
        raise InputError(lens.path, "coating", names, expected)
    rows, before = [], float(lens.object_medium.n_d)
    for key, s in zip(known, lens.surfaces, strict=True):
        stated, n_d = s.coating is not None and s.coating.origin == "source", float(s.n_d)
        name, coating = single.get(key, rest[0] if rest else None), s.coating
        if key not in single and name in ("bare", "stated"):
            coating = s.coating if stated and name == "stated" else None
        elif name is not None and (key in single or (not stated and before != n_d and 1.0 in (before, n_d))):
            coating = replace(design(name, before, n_d, lens.path, f"surface {key[1:]}, coating"), origin="shot")
        rows.append(replace(s, coating=coating))
        before = n_d
    return replace(lens, surfaces=tuple(rows))


def is_design(coating: Coating, n_before: float, n_after: float) -> bool:
    """Test whether `design` makes this coating of its name and these media."""
    try:
        return design(coating.name, n_before, n_after).layers == coating.layers
    except InputError:
        return False


def _dispersive(film: tuple[float, float], waves: float, at_nm: float) -> tuple[float, float, float]:
    """(n_d, thickness in nm, V_d) of a film (n_d, V_d) so many waves thick at `at_nm`."""
    return film[0], waves * at_nm / index_at(*film, at_nm), film[1]


def _film(index: float, phase: float, at_nm: float) -> tuple[float, float]:
    """(index, thickness in nm) of a film whose phase thickness is `phase` rad at `at_nm`."""
    return index, phase * at_nm / (2 * math.pi * index)


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
