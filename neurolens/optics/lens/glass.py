"""Glasses: manufacturers' catalogues with dispersion and absorption, and the medium after a surface.

The table (data/glasses.json) is made by experiments/data/make_glass_table.py from the refractiveindex.info database
(CC0). A glass without an entry has Cauchy's dispersion, A + B / lambda^2 + C / lambda^4, from n_d and the Abbe number
V_d. These two figures leave the partial dispersion open: it is taken to be the mean of the catalogue's glasses of that
V_d.
"""

import difflib
import json
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.settings import LIGHT_NM
from neurolens.base.status import DOMAIN_SLACK
from neurolens.optics.lens.prescription import LINE_D_NM, Lens, Medium, MediumFields, Surface

# Fraunhofer lines, nm (helium d; hydrogen F and C; mercury g).
LINE_F_NM = 486.1327
LINE_C_NM = 656.2725
LINE_G_NM = 435.8343
# How far a stated n_d or V_d may be from the catalogue's: sources round to three decimals and one, and melts differ.
TOLERANCE_N_D = 5e-4
TOLERANCE_V_D = 0.5

# The partial dispersion P_gF of the catalogue's glasses as a polynomial in V_d, and the range of V_d where it holds.
# tests/optics/trace/test_catalogue.py repeats the fit.
P_GF = (0.7186, -0.004859, 3.169e-5)
_GLASSES_V_D = (15.0, 100.0)

# The light that media of constant index take: any wavelength that is positive and finite, in float32 too.
ANY_WAVELENGTH_NM = (1e-30, 3e38)
# Where every formula of the catalogue is finite; reading warns of a glass that its source states for less.
_FINITE_NM = (380.0, 780.0)
# Where `index_at` holds: within 0.003 of 95% of the catalogue's glasses (0.02 of all); and where within 0.034, which
# is said (tests/optics/trace/test_catalogue.py).
_BY_FIGURES_NM, _AT_MOST_NM = (365.0, 1014.0), (300.0, 2500.0)


@dataclass(frozen=True, eq=False)  # compared by identity: the catalogue has one object per glass
class Glass:
    """Describes one optical material: its dispersion and its absorption.

    Attributes:
        maker, name: as in the catalogue.
        form: "sellmeier", n^2 = 1 + sum of B L^2 / (L^2 - C), or "power", n^2 = sum of a_p L^p, with the wavelength L
            in um.
        coefficients: B, C (um^2), B, C, ... of Sellmeier's form; a_4, a_2, a_0, a_-2, a_-4, ... of the power form.
        range_um: the shortest and longest wavelength for which the source states the formula.
        absorption: pairs of a wavelength in nm and the Napierian absorption in 1/mm, wavelengths increasing; empty
            where unknown.
    """

    maker: str
    name: str
    form: str
    coefficients: tuple[float, ...]
    range_um: tuple[float, float]
    absorption: tuple[tuple[float, float], ...] = ()

    def __str__(self) -> str:
        return f"{self.maker}:{self.name}"

    def index(self, wavelength_nm: Any) -> Any:
        """Return the refractive index relative to air at a wavelength in nm.

        The wavelength may be a number, a value of a graph, or a tensor, whose dtype the result has. Outside `range_um`
        the formula is extrapolated (`check_light` says so). In every glass of the catalogue it is finite for 380-780
        nm; in the ultraviolet, beyond its poles (below 300 nm), it is meaningless or NaN.
        """
        square = (wavelength_nm * 1e-3) * (wavelength_nm * 1e-3)
        c = self.coefficients
        if self.form == "sellmeier":
            terms = [c[k] * square / (square - c[k + 1]) for k in range(0, len(c), 2)]
            return _root(sum(terms[1:], terms[0]) + 1.0)
        # Horner's scheme in 1 / L^2 serves the negative powers. Of positive ones the catalogues have none above the
        # fourth.
        inverse = 1.0 / square
        total = inverse * c[-1]
        for a in c[-2:2:-1]:
            total = (total + a) * inverse
        return _root(total + c[2] + square * (c[1] + square * c[0]))

    def absorption_per_mm(self, wavelength_nm: Any) -> Any:
        """The Napierian absorption 4 pi k / wavelength, in 1/mm, at a wavelength in nm; None where it is unknown.

        The internal transmittance of t mm is exp(-absorption t). The absorption is linear between the source's
        wavelengths and constant outside them (they span at most 350-1060 nm): beyond them in the ultraviolet, a glass
        is darker than this says.
        """
        if not self.absorption:
            return None
        if not hasattr(wavelength_nm, "new_full"):  # not a torch tensor
            value = np.interp(wavelength_nm, *np.transpose(self.absorption))
            return float(value) if np.ndim(value) == 0 else value
        total = wavelength_nm.new_full(wavelength_nm.shape, self.absorption[-1][1])
        for nm, bend in self.bends():
            total = total + bend * (nm - wavelength_nm).clamp(min=0)
        return total

    def bends(self) -> list[tuple[float, float]]:
        """Return the piecewise linear absorption as hinges: a wavelength, and by how much the derivative changes there.

        A sum of hinges is faster than a search for the piece, and a compiler can fuse it. It starts at the red end,
        where the absorption is least, so that float32 does not lose that.
        """
        points = self.absorption
        steps = [(a - b) / (right - left) for (left, a), (right, b) in zip(points[:-1], points[1:], strict=True)]
        changes = zip([0.0, *steps], [*steps, 0.0], strict=True)
        return [(nm, red - blue) for (nm, _), (red, blue) in zip(points, changes, strict=True)]

    @property
    def n_d(self) -> float:
        """The refractive index at the helium line, 587.5618 nm."""
        return self.index(LINE_D_NM)

    @property
    def V_d(self) -> float:
        """The Abbe number (n_d - 1) / (n_F - n_C), infinite without dispersion."""
        spread = self.index(LINE_F_NM) - self.index(LINE_C_NM)
        return (self.n_d - 1.0) / spread if spread else math.inf

    def covers(self, wavelength_nm: float) -> bool:
        """Test whether the source states the formula for this wavelength."""
        low, high = self.range_um
        return low - 1e-9 <= wavelength_nm * 1e-3 <= high + 1e-9  # 700 * 1e-3 is more than 0.7


def _root(square: Any) -> Any:
    """Return the square root; a negative number gives NaN, as with tensors, where Python's power would be complex."""
    if hasattr(square, "sqrt"):
        return square.sqrt()
    return math.nan if isinstance(square, float) and square < 0 else square**0.5


# In this order: of a name that several makers use, the first maker's glass is meant.
MAKERS = ("Schott", "Ohara", "Hoya", "Hikari", "CDGM", "Sumita", "LZOS", "generic")

_BY_LETTERS = {maker.upper(): maker for maker in MAKERS}
_LONGEST = 100  # Only so many characters of a name count.

# Other names of the same dispersion: Schott publishes one set of coefficients for BK7 and N-BK7.
ALIASES = {
    **{"BK7": "Schott:N-BK7", "silica": "generic:fused silica", "SiO2": "generic:fused silica"},
    **{"F_SILICA": "generic:fused silica", "C79-80": "generic:fused silica"},  # as Zemax and Corning call it
    **{"fluorite": "generic:CaF2", "acrylic": "generic:PMMA", "PC": "generic:polycarbonate"},
    **{"POLYCARB": "generic:polycarbonate", "PS": "generic:polystyrene", "POLYSTYR": "generic:polystyrene"},
    **{"plexiglas": "generic:PMMA", "lucite": "generic:PMMA", "perspex": "generic:PMMA"},
    **{"lexan": "generic:polycarbonate", "makrolon": "generic:polycarbonate", "styron": "generic:polystyrene"},
    **{"SAN": "generic:styrene acrylonitrile", "COP": "generic:Zeonex E48R", "E48R": "generic:Zeonex E48R"},
}


# The glasses of the catalogues that a command names (`optics.readers.glasses`), by every key that finds them, and why
# others in them were not read.
_ADDED: dict[str, list[Glass]] = {}
_REFUSED: dict[str, str] = {}
# Glasses looked up so far. A plain dictionary, because torch.compile can trace through it to the coefficients.
_FOUND: dict[str, Glass] = {}


@contextmanager
def added(glasses: Iterable[Glass], refused: Mapping[str, str]) -> Iterator[None]:
    """Put glasses before those of the table within a block; `refused` tells, by name, why others are missing."""
    before = {key: [*known] for key, known in _ADDED.items()}, dict(_REFUSED)
    for glass in glasses:
        for key in (_key(glass.name), _key(str(glass))):
            _ADDED.setdefault(key, []).insert(0, glass)
    _REFUSED.update({_key(name): reason for name, reason in refused.items()})
    _FOUND.clear()
    try:
        yield
    finally:
        _ADDED.clear()
        _REFUSED.clear()
        _FOUND.clear()
        _ADDED.update(before[0])
        _REFUSED.update(before[1])


def find(name: str, file: str | Path = "glass catalogue", where: str = "glass") -> Glass:
    """Return the glass of a name: "N-BK7", or with its maker "Schott:N-BK7", "schott N-BK7", "N-BK7 (SCHOTT)".

    Case, blanks, hyphens and brackets do not count. Where several makers have a glass of that name, the one first in
    `MAKERS` is returned (`same_name` lists them all). A name without N- does not find the glass with N-: SK16 is
    Hikari's.

    Args:
        name: the name to look up.
        file, where: the place that an error names.

    Raises:
        InputError: an unknown name; the nearest known ones are suggested.
    """
    glasses = same_name(name)
    if not glasses:
        reason = _REFUSED.get(_key(name)) or _suggestion(name)
        raise InputError(file, where, name, f"a glass of the catalogue, or of one given by --glass; {reason}")
    return glasses[0]


def same_name(name: str) -> tuple[Glass, ...]:
    """Every maker's glass of a name, in the order of `MAKERS`, or one maker's where it is named; may be empty."""
    maker, key = _split(name)
    found = (_glass(row) for row in _rows_by_key().get(key, ()))
    added = dict.fromkeys((*_ADDED.get(_key(name), ()), *_ADDED.get(key, ())))
    same = (g for g in added if maker is None or maker.upper() == g.maker.upper())
    return (*same, *(g for g in found if maker in (None, g.maker)))


def all_glasses() -> tuple[Glass, ...]:
    """Return the whole catalogue: the added glasses, then the table's by maker, in the order of `MAKERS`."""
    added = dict.fromkeys(glass for glasses in _ADDED.values() for glass in glasses)
    return (*added, *(_glass(row) for row in range(len(_table()["glasses"]))))


@lru_cache(maxsize=4096)
def nearest(n_d: float, V_d: float) -> Glass:
    """Return the table's glass that stands for the absorption of one of which n_d and V_d alone are known.

    Of the glasses near to it, within 0.001 of n_d and 0.5 of V_d or twice the distance of the nearest, it is the one
    with the median absorption at the g line: makers melt the same glass more and less clear.
    """
    glasses, figures, absorption = _absorbing()
    far = np.hypot((figures[0] - n_d) / 0.001, (figures[1] - V_d) / 0.5)
    near = np.flatnonzero(far <= max(1.0, 2 * far.min()))
    return glasses[near[np.argsort(absorption[near], kind="stable")[len(near) // 2]]]


@cache
def _absorbing() -> tuple[list[Glass], NDArray[np.float64], NDArray[np.float64]]:
    """Return the table's glasses of known absorption, their n_d and V_d [2, G], and their absorption at the g line."""
    glasses = [g for row in range(len(_table()["glasses"])) if (g := _glass(row)).absorption]
    figures = np.array([(g.n_d, g.V_d) for g in glasses]).T
    return glasses, figures, np.array([g.absorption_per_mm(LINE_G_NM) for g in glasses])


def figures_of_code(code: str) -> tuple[float, float] | None:
    """Return n_d and V_d of a glass code, else None: the fraction of the index, and the Abbe number without its point.

    It is written as 517642, 517.642, 517.64 or 516800.641700. No glass has an index below 1.3: 003283 stands for 2.003
    and 28.3, as 1003300.283000 does with more digits.
    """
    if not (match := re.fullmatch(r"([0-9]{3,7})\.([0-9]{2,6})|([0-9]{3})([0-9]{3})", code)):
        return None
    index, abbe = match[1] or match[3], match[2] or match[4]
    n_d = 1 + int(index) / 10 ** min(len(index), 6)
    return n_d + (n_d < 1.3), int(abbe) / 10 ** (len(abbe) - 2)


def by_code(code: str, count: int = 3) -> list[Glass]:
    """Return the `count` glasses nearest to a six-digit code.

    The code "517642", also written "517.642" or "517/642", stands for n_d = 1.517 and V_d = 64.2. Glasses that share a
    code come in the order of `MAKERS`.

    Raises:
        InputError: a code that is not six digits.
    """
    digits = re.sub(r"[./ ]", "", code)
    figures = figures_of_code(digits) if len(digits) == 6 else None
    if figures is None:
        raise InputError("glass catalogue", "code", code, 'six digits such as "517642" for n_d = 1.517, V_d = 64.2')
    n_d, V_d = figures

    def rank(g: Glass) -> float:
        # Rounded as codes are, so that all glasses of one code count as equally near.
        return round(math.hypot((round(g.n_d, 3) - n_d) / 0.001, (round(g.V_d, 1) - V_d) / 0.5), 6)

    return sorted(all_glasses(), key=rank)[:count]


def _key(name: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", name.upper())


_ALIAS_KEYS = {_key(alias): name for alias, name in ALIASES.items()}


def _split(name: str) -> tuple[str | None, str]:
    """Split a name as people write it into the maker (None where it names none) and the key of the rest."""
    text = " ".join(name[:_LONGEST].split())
    bare, bracket, inside = text.rpartition("(") if text.endswith(")") else ("", "", "")
    if bracket and (maker := _BY_LETTERS.get(inside[:-1].strip().upper())) and bare.strip():
        return maker, _key(bare)
    for letters, maker in _BY_LETTERS.items():
        rest = text[len(letters) :]
        if text.upper().startswith(letters) and rest[:1] in (" ", ":", "/", "_") and rest[1:].strip():
            return maker, _key(rest[1:])
    alias = _ALIAS_KEYS.get(_key(text))
    return _split(alias) if alias else (None, _key(text))


def _suggestion(name: str) -> str:
    table, (_, key) = _rows_by_key(), _split(name)
    keys = difflib.get_close_matches(key, [*table, *_ALIAS_KEYS], n=5, cutoff=0.5)
    found = [_glass(table[k][0]) if k in table else find(_ALIAS_KEYS[k]) for k in keys]
    names = ", ".join(dict.fromkeys(f"{g.name} ({g.maker})" for g in found))
    return f"the nearest names are {names}" if names else "it has no similar name"


@lru_cache(maxsize=1)
def _table() -> dict[str, Any]:
    """Return the rows of the table's file in the order of `MAKERS`; the file is read at the first lookup."""
    text = (resources.files("neurolens.optics.lens") / "data" / "glasses.json").read_text(encoding="utf-8")
    table = json.loads(text)
    table["glasses"].sort(key=lambda row: MAKERS.index(row[0]))
    return table


@lru_cache(maxsize=1)
def _rows_by_key() -> dict[str, list[int]]:
    """Return, by the key of a name, the places of its glasses in the table, in the order of `MAKERS`."""
    rows: dict[str, list[int]] = {}
    for place, (_, name, *_) in enumerate(_table()["glasses"]):
        rows.setdefault(_key(name), []).append(place)
    return rows


@cache
def _glass(place: int) -> Glass:
    maker, name, form, coefficients, low_um, high_um, *sampled = _table()["glasses"][place]
    grid_nm, per_m = (_table()["grids_nm"][sampled[0]], sampled[1]) if sampled else ((), ())
    absorption = tuple((float(nm), a * 1e-3) for nm, a in zip(grid_nm, per_m, strict=True))
    return Glass(maker, name, form, tuple(coefficients), (low_um, high_um), absorption)


def inverse_square_um(wavelength_nm: Any) -> Any:
    """Return 1 / lambda^2 in 1/um^2 for a wavelength in nm (number or tensor)."""
    inverse = 1000.0 / wavelength_nm
    return inverse * inverse


def cauchy(n_d: Any, V_d: float) -> tuple[Any, Any, Any]:
    """Return A, B (um^2) and C (um^4) of Cauchy's A + B / lambda^2 + C / lambda^4 for an n_d and an Abbe number.

    They follow from n(d) = n_d, n_F - n_C = (n_d - 1) / V_d, and n_g - n_F = P_gF (n_F - n_C). P_gF is a parabola in
    V_d, fitted by least squares to the catalogue's glasses up to n_d = 2.1. It leaves 0.004; a straight "normal line"
    would leave 0.011, and A + B / lambda^2 alone up to 0.09. All three coefficients are linear in n_d.
    """
    d, f, c, g = (inverse_square_um(nm) for nm in (LINE_D_NM, LINE_F_NM, LINE_C_NM, LINE_G_NM))
    within = min(max(V_d, _GLASSES_V_D[0]), _GLASSES_V_D[1])
    partial = P_GF[0] + within * (P_GF[1] + within * P_GF[2])
    # (u - f) (u - c) vanishes at both lines, so this term leaves n_F - n_C as it is.
    bend = (partial - (g - f) / (f - c)) / ((g - f) * (g - c))
    slope, spread = 1 / (f - c) - bend * (f + c), (n_d - 1.0) / V_d
    return n_d - spread * d * (slope + bend * d), spread * slope, spread * bend


def index_at(n_d: Any, V_d: float | None, wavelength_nm: Any) -> Any:
    """Return the index by `cauchy` at a wavelength in nm (number, array or tensor); n_d itself where V_d is None."""
    if V_d is None:
        return n_d
    a, b, c = cauchy(n_d, V_d)
    u = inverse_square_um(wavelength_nm)
    return a + u * (b + u * c)


def glass_of(name: str) -> Glass:
    """Return the glass of a name as `find` does, cached; torch.compile can use a glass that was looked up before."""
    found = _FOUND.get(name)
    if found is None:
        found = _FOUND[name] = find(name)
    return found


def by_figures(name: str, n_d: float, V_d: float, place: str) -> MediumFields:
    """Return the fields of a surface whose glass the catalogue lacks: its n_d and V_d, and the name for people.

    Args:
        place: the file and the field, for the warning.

    Warns:
        NeurolensWarning: always; it tells which dispersion is taken.
    """
    message = f"glass {name} is not in the catalogue: taken by n_d {n_d:g} and V_d {V_d:g}"
    message += ", and the partial dispersion of a mean glass (Cauchy), without absorption"
    warnings.warn(f"{place}: {message}", NeurolensWarning, stacklevel=3)
    return {"n_d": n_d, "V_d": V_d, "material": name}


def index_of(surface: Surface | Medium, wavelength_nm: Any) -> Any:
    """Return the refractive index of a medium, or of that after a surface, at a wavelength in nm.

    The wavelength is a number, or a tensor of any shape. A glass of the catalogue has the catalogue's index; else n_d
    and V_d give it, and where V_d is unknown it is n_d at every wavelength.

    Raises:
        InputError: a glass that the catalogue does not have, or a catalogue glass beside an n_d whose gradient is
            wanted.
    """
    if surface.glass is not None:
        if getattr(surface.n_d, "requires_grad", False):
            expected = "no catalogue glass beside an index to be optimised"
            raise InputError(f"glass {surface.glass}", "n_d", "(a tensor)", expected)
        return glass_of(surface.glass).index(wavelength_nm)
    return index_at(surface.n_d, surface.V_d, wavelength_nm)


def stated_nm(lens: Lens) -> tuple[float, float]:
    """Return the range (nm) in which at least one glass's index is known and every catalogue formula makes sense."""
    glasses = [glass_of(m.glass) if m.glass else None for m in lens.media if m.glass or m.V_d is not None]
    ends = [_AT_MOST_NM if g is None else tuple(1e3 * v for v in g.range_um) for g in glasses]
    low, high = zip(*ends, _FINITE_NM, strict=True)
    return (min(low), max(high)) if glasses else ANY_WAVELENGTH_NM


def check_light(lens: Lens, wavelength_nm: float) -> None:
    """Refuse a wavelength at which no glass of a lens has a known index, and warn where some glass has none.

    Visible light passes without a warning: reading a lens has told which of its glasses are not stated there.
    """
    if LIGHT_NM[0] <= wavelength_nm <= LIGHT_NM[1]:
        return
    low, high = stated_nm(lens)
    if not low / DOMAIN_SLACK <= wavelength_nm <= high * DOMAIN_SLACK:
        expected = f"{low:g} to {high:g} nm, where the index of its glasses is stated"
        raise InputError(lens.path, "wavelength_nm", wavelength_nm, expected)
    for medium in lens.media:
        glass = glass_of(medium.glass) if medium.glass else None
        known = ANY_WAVELENGTH_NM if medium.V_d is None else _BY_FIGURES_NM
        first, last = known if glass is None else (1e3 * v for v in glass.range_um)
        if not first / DOMAIN_SLACK <= wavelength_nm <= last * DOMAIN_SLACK:
            what = str(glass or f"a glass known by n_d {float(medium.n_d):g} and V_d {medium.V_d:g} alone")
            text = f"the index of {what} is stated for {first:g}-{last:g} nm: extrapolated at {wavelength_nm:g} nm"
            warnings.warn(f"{lens.path}: {text}", NeurolensWarning, stacklevel=2)


def absorption_of(surface: Surface, wavelength_nm: Any) -> Any:
    """Napierian absorption in 1/mm of the medium after a surface: the glass's plus the surface's own; None without any.

    Beer-Lambert: t mm transmit exp(-absorption t). An InputError for a glass that the catalogue does not have.
    """
    own = surface.absorption_per_mm or None
    name = surface.glass or surface.absorbs_as
    glass = None if name is None else glass_of(name).absorption_per_mm(wavelength_nm)
    if glass is None or own is None:
        return own if glass is None else glass
    return glass + own


def check_against_table(surface: Surface, file: str | Path, where: str) -> None:
    """Check a surface's glass against the catalogue when a lens is read; a surface without a glass passes.

    Args:
        file, where: the place that messages name, for example "surface 3, ".

    Warns:
        NeurolensWarning: the stated n_d or V_d differs from the catalogue's by more than 5e-4 or 0.5 (n_d = 1 and None
            count as not stated), or the catalogue's formula does not cover 400-700 nm and is extrapolated.

    Raises:
        InputError: a glass that the catalogue does not have.
    """
    if surface.glass is None:
        return
    _FOUND[surface.glass] = find(surface.glass, file, f"{where}glass")
    for text in table_notes(surface):
        warnings.warn(f"{file}: {where}{text}", NeurolensWarning, stacklevel=2)


def table_notes(surface: Surface) -> list[str]:
    """List the warnings of `check_against_table` without their place; empty if the stated values agree."""
    if surface.glass is None:
        return []
    glass, notes = glass_of(surface.glass), []
    stated = _contradiction(surface, glass)
    if stated:
        others = [str(g) for g in same_name(surface.glass) if not _contradiction(surface, g)]
        hint = f"; {others[0]} would agree" if others else ""
        notes.append(
            f"{stated} is stated, but {glass} has n_d = {glass.n_d:.6g}, V_d = {glass.V_d:.4g}, which rules{hint}"
        )
    if not all(glass.covers(nm) for nm in LIGHT_NM):
        low, high = (round(1000 * v) for v in glass.range_um)
        notes.append(f"the index of {glass} is stated for {low}-{high} nm and extrapolated outside")
    if len(glass.coefficients) == 2:
        # The source gives these plastics one term of Sellmeier's formula: E48R gets V_d = 51.8, where its maker says
        # 56.
        notes.append(f"the index of {glass} is a fit with one term: good to 0.002, and V_d is up to a tenth too low")
    return notes


def _contradiction(surface: Surface, glass: Glass) -> str:
    """Return the stated values that differ from this glass's, as text; empty where they agree."""
    n_d, V_d = float(surface.n_d), surface.V_d
    wrong = [f"n_d = {n_d:.6g}"] if n_d != 1 and abs(glass.n_d - n_d) > TOLERANCE_N_D else []
    if V_d is not None and abs(glass.V_d - V_d) > TOLERANCE_V_D:
        wrong.append(f"V_d = {V_d:.4g}")
    return ", ".join(wrong)
