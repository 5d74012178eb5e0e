"""Glasses by name: manufacturers' catalogues, common crystals and plastics, with their dispersion and absorption.

The table (data/glasses.json) is made by experiments/make_glass_table.py from the refractiveindex.info database (CC0).
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.lens.film_plane import LINE_D_NM

# Fraunhofer lines, nm (helium d; hydrogen F and C; mercury g).
LINE_F_NM = 486.1327
LINE_C_NM = 656.2725
LINE_G_NM = 435.8343


@dataclass(frozen=True, eq=False)  # compared by identity: the catalogue has one object per glass
class Glass:
    """Dispersion and absorption of one optical material.

    Attributes:
        maker, name: as in the catalogue.
        form: "sellmeier", n^2 = 1 + sum of B L^2 / (L^2 - C), or "power", n^2 = sum of a_p L^p; L in um.
        coefficients: B, C (um^2), B, C, ... of Sellmeier's form; a_4, a_2, a_0, a_-2, a_-4, ... of the other.
        range_um: wavelengths from and to which the source states the formula for.
        absorption: (wavelength in nm, Napierian absorption in 1/mm) at increasing wavelengths; empty where unknown.
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
        """Refractive index relative to air at a wavelength in nm (number, value of a graph, or tensor of its dtype).

        Outside `range_um` the formula is extrapolated; it is finite for 380-780 nm in every glass of the catalogue,
        and meaningless or NaN beyond the poles in the ultraviolet (below 300 nm).
        """
        square = (wavelength_nm * 1e-3) * (wavelength_nm * 1e-3)
        c = self.coefficients
        if self.form == "sellmeier":
            terms = [c[k] * square / (square - c[k + 1]) for k in range(0, len(c), 2)]
            return _root(sum(terms[1:], terms[0]) + 1.0)
        # Horner's scheme in 1 / L^2 for the negative powers; the catalogues have none above the fourth.
        inverse = 1.0 / square
        total = inverse * c[-1]
        for a in c[-2:2:-1]:
            total = (total + a) * inverse
        return _root(total + c[2] + square * (c[1] + square * c[0]))

    def absorption_per_mm(self, wavelength_nm: Any) -> Any:
        """Napierian absorption, 4 pi k / wavelength, in 1/mm, at a wavelength in nm; None where the source has none.

        Internal transmittance of t mm is exp(-absorption t). Linear between the source's wavelengths, and constant
        outside them (350-1060 nm at the most): there, on the ultraviolet side, glass is darker than this says.
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
        """Return the piecewise linear absorption as hinges: wavelength, and the change of the derivative there.

        Faster than a search, fusible, and from the red end, where absorption is least, so that float32 does not lose
        it.
        """
        points = self.absorption
        steps = [(a - b) / (right - left) for (left, a), (right, b) in zip(points[:-1], points[1:], strict=True)]
        changes = zip([0.0, *steps], [*steps, 0.0], strict=True)
        return [(nm, red - blue) for (nm, _), (red, blue) in zip(points, changes, strict=True)]

    @property
    def n_d(self) -> float:
        """Index at the helium line, 587.5618 nm."""
        return self.index(LINE_D_NM)

    @property
    def V_d(self) -> float:
        """Abbe number (n_d - 1) / (n_F - n_C)."""
        return (self.n_d - 1.0) / (self.index(LINE_F_NM) - self.index(LINE_C_NM))

    def covers(self, wavelength_nm: float) -> bool:
        """Test whether the source states the formula for this wavelength."""
        low, high = self.range_um
        return low - 1e-9 <= wavelength_nm * 1e-3 <= high + 1e-9  # 700 * 1e-3 is a digit more than 0.7


def _root(square: Any) -> Any:
    """Square root; a negative number gives NaN as a tensor's does, where Python's own power gives a complex one."""
    if hasattr(square, "sqrt"):
        return square.sqrt()
    return math.nan if isinstance(square, float) and square < 0 else square**0.5


# A name that several makers use is that of the first one here.
MAKERS = ("Schott", "Ohara", "Hoya", "Hikari", "CDGM", "Sumita", "LZOS", "generic")

_BY_LETTERS = {maker.upper(): maker for maker in MAKERS}
_LONGEST = 100  # characters of a name that count

# Other names for the same dispersion. Schott published one set of coefficients for BK7 and N-BK7.
ALIASES = {
    **{"BK7": "Schott:N-BK7", "silica": "generic:fused silica", "SiO2": "generic:fused silica"},
    **{"fluorite": "generic:CaF2", "acrylic": "generic:PMMA", "PC": "generic:polycarbonate"},
    **{"POLYCARB": "generic:polycarbonate", "PS": "generic:polystyrene", "POLYSTYR": "generic:polystyrene"},
    **{"SAN": "generic:styrene acrylonitrile", "COP": "generic:Zeonex E48R", "E48R": "generic:Zeonex E48R"},
}


# Glasses of catalogues that a command names (`readers.glasses`) by every key that finds them, and those not read.
_ADDED: dict[str, list[Glass]] = {}
_REFUSED: dict[str, str] = {}


def add(glasses: Iterable[Glass], refused: Mapping[str, str]) -> None:
    """Put glasses before those of the table until `restore`; `refused`: why others are not there, by name."""
    for glass in glasses:
        for key in (_key(glass.name), _key(str(glass))):
            _ADDED.setdefault(key, []).insert(0, glass)
    _REFUSED.update({_key(name): reason for name, reason in refused.items()})


Added = tuple[dict[str, list[Glass]], dict[str, str]]


def added() -> Added:
    """Return a copy of the glasses that `add` has put in so far."""
    return {key: [*glasses] for key, glasses in _ADDED.items()}, dict(_REFUSED)


def restore(before: Added) -> None:
    """Go back to the glasses that `added` returned."""
    _ADDED.clear()
    _REFUSED.clear()
    _ADDED.update(before[0])
    _REFUSED.update(before[1])


def find(name: str, file: str | Path = "glass catalogue", where: str = "glass") -> Glass:
    """Return the glass of a name: "N-BK7", or with its maker "Schott:N-BK7", "schott N-BK7", "N-BK7 (SCHOTT)".

    Case, blanks, hyphens and brackets do not count. Of several makers' glasses of one name it is that of the first in
    `MAKERS` (`same_name` lists them). A name without N- is not matched to the glass with it: SK16 is Hikari's.

    Raises:
        InputError: an unknown name, at the place `file`, `where`; the nearest ones are suggested.
    """
    glasses = same_name(name)
    if not glasses:
        reason = _REFUSED.get(_key(name)) or _suggestion(name)
        raise InputError(file, where, name, f"a glass of the catalogue; {reason}")
    return glasses[0]


def same_name(name: str) -> tuple[Glass, ...]:
    """Every maker's glass of a name, in the order of `MAKERS`; of one maker only if the name says so; may be empty."""
    maker, key = _split(name)
    found = (_glass(row) for row in _rows_by_key().get(key, ()))
    added = dict.fromkeys((*_ADDED.get(_key(name), ()), *_ADDED.get(key, ())))
    same = (g for g in added if maker is None or maker.upper() == g.maker.upper())
    return (*same, *(g for g in found if maker in (None, g.maker)))


def all_glasses() -> tuple[Glass, ...]:
    """Return the whole catalogue: what was added, then by maker in the order of `MAKERS`."""
    added = dict.fromkeys(glass for glasses in _ADDED.values() for glass in glasses)
    return (*added, *(_glass(row) for row in range(len(_table()["glasses"]))))


def by_code(code: str, count: int = 3) -> list[Glass]:
    """Return the glasses nearest to a six-digit code: "517642", also written "517.642" or "517/642", is 1.517 and 64.2.

    Of those that share a code the order is that of `MAKERS`. Anything but six digits is an InputError.
    """
    digits = re.sub(r"[./ ]", "", code)
    if not re.fullmatch(r"[0-9]{6}", digits):
        raise InputError("glass catalogue", "code", code, 'six digits such as "517642" for n_d = 1.517, V_d = 64.2')
    n_d, V_d = 1 + int(digits[:3]) / 1000, int(digits[3:]) / 10

    def rank(g: Glass) -> float:
        # Rounded as codes are, so that all glasses of one code are equally near.
        return round(_distance(round(g.n_d, 3) - n_d, round(g.V_d, 1) - V_d), 6)

    return sorted(all_glasses(), key=rank)[:count]


def _distance(n_d: float, V_d: float) -> float:
    return math.hypot(n_d / 0.001, V_d / 0.5)


def _key(name: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", name.upper())


def _split(name: str) -> tuple[str | None, str]:
    """Return the maker (None where the name does not say) and key of a name as people write it."""
    text = " ".join(name[:_LONGEST].split())
    bare, bracket, inside = text.rpartition("(") if text.endswith(")") else ("", "", "")
    if bracket and (maker := _BY_LETTERS.get(inside[:-1].strip().upper())) and bare.strip():
        return maker, _key(bare)
    for letters, maker in _BY_LETTERS.items():
        rest = text[len(letters) :]
        if text.upper().startswith(letters) and rest[:1] in (" ", ":", "/", "_") and rest[1:].strip():
            return maker, _key(rest[1:])
    alias = _alias_keys().get(_key(text))
    return _split(alias) if alias else (None, _key(text))


@lru_cache(maxsize=1)
def _alias_keys() -> dict[str, str]:
    return {_key(alias): name for alias, name in ALIASES.items()}


def _suggestion(name: str) -> str:
    table, (_, key) = _rows_by_key(), _split(name)
    keys = difflib.get_close_matches(key, [*table, *_alias_keys()], n=5, cutoff=0.5)
    found = [_glass(table[k][0]) if k in table else find(_alias_keys()[k]) for k in keys]
    names = ", ".join(dict.fromkeys(f"{g.name} ({g.maker})" for g in found))
    return f"the nearest names are {names}" if names else "it has no similar name"


@lru_cache(maxsize=1)
def _table() -> dict[str, Any]:
    """Return the rows of the table's file in the order of `MAKERS`, read at the first lookup."""
    text = (resources.files("neurolens.lens") / "data" / "glasses.json").read_text(encoding="utf-8")
    table = json.loads(text)
    table["glasses"].sort(key=lambda row: MAKERS.index(row[0]))
    return table


@lru_cache(maxsize=1)
def _rows_by_key() -> dict[str, list[int]]:
    """Return the places in the table by the key of a name, in the order of `MAKERS`."""
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
