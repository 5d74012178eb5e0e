"""Glasses by name: manufacturers' catalogues, common crystals and plastics, from one table that ships with neurolens.

The table (data/glasses.json) is made by experiments/make_glass_table.py from the refractiveindex.info database (CC0).
"""

from __future__ import annotations

import difflib
import json
import math
import re
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.optics.dispersion import Glass

# A name that several makers use is that of the first one here.
MAKERS = ("Schott", "Ohara", "Hoya", "Hikari", "CDGM", "Sumita", "LZOS", "generic")

# Other names for the same dispersion. Schott published one set of coefficients for BK7 and N-BK7.
ALIASES = {
    **{"BK7": "Schott:N-BK7", "silica": "generic:fused silica", "SiO2": "generic:fused silica"},
    **{"fluorite": "generic:CaF2", "acrylic": "generic:PMMA", "PC": "generic:polycarbonate"},
    **{"POLYCARB": "generic:polycarbonate", "PS": "generic:polystyrene", "POLYSTYR": "generic:polystyrene"},
    **{"SAN": "generic:styrene acrylonitrile", "COP": "generic:Zeonex E48R", "E48R": "generic:Zeonex E48R"},
}


def find(name: str, file: str | Path = "glass catalogue", where: str = "glass") -> Glass:
    """The glass of a name: "N-BK7", or with its maker "Schott:N-BK7", "schott N-BK7", "N-BK7 (SCHOTT)".

    Case, blanks, hyphens and brackets do not count. Of several makers' glasses of one name it is that of the first in
    `MAKERS` (`same_name` lists them). A name without the N- of today's glass is not taken for it: SK16 is Hikari's.

    Args:
        file, where: the place to name in an error.

    Raises:
        InputError: an unknown name; it suggests the nearest ones.
    """
    glasses = same_name(name)
    if not glasses:
        raise InputError(file, where, name, f"a glass of the catalogue; {_suggestion(name)}")
    return glasses[0]


def same_name(name: str) -> tuple[Glass, ...]:
    """Every maker's glass of a name, in the order of `MAKERS`; of one maker only if the name says so; may be empty."""
    maker, key = _split(name)
    found = (_glass(row) for row in _rows_by_key().get(key, ()))
    return tuple(g for g in found if maker in (None, g.maker))


def all_glasses() -> tuple[Glass, ...]:
    """The whole catalogue, by maker in the order of `MAKERS`."""
    return tuple(_glass(row) for row in range(len(_table()["glasses"])))


def nearest(n_d: float, V_d: float, count: int = 3) -> list[Glass]:
    """The `count` glasses nearest to an index and Abbe number; 0.001 in n_d weighs as much as 0.5 in V_d."""
    return sorted(all_glasses(), key=lambda g: _distance(g.n_d - n_d, g.V_d - V_d))[:count]


def by_code(code: str, count: int = 3) -> list[Glass]:
    """The glasses nearest to a six-digit code: "517642", also written "517.642" or "517/642", is 1.517 and 64.2.

    Of those that share a code the order is that of `MAKERS`.

    Raises:
        InputError: not six digits.
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
    """Maker (None where the name does not say) and key of a name as people write it."""
    names = "|".join(MAKERS)
    match = re.fullmatch(rf"\s*({names})\s*[: /_]\s*(.+)|(.+?)\s*\(({names})\)\s*", name, re.IGNORECASE)
    if match is None:
        alias = _alias_keys().get(_key(name))
        return _split(alias) if alias else (None, _key(name))
    said, bare = match[1] or match[4], match[2] or match[3]
    maker = next(m for m in MAKERS if m.lower() == said.lower())
    return maker, _key(bare)


@lru_cache(maxsize=1)
def _alias_keys() -> dict[str, str]:
    return {_key(alias): name for alias, name in ALIASES.items()}


def _suggestion(name: str) -> str:
    """Up to five names of the table that look like this one."""
    table, (_, key) = _rows_by_key(), _split(name)
    keys = difflib.get_close_matches(key, [*table, *_alias_keys()], n=5, cutoff=0.5)
    found = [_glass(table[k][0]) if k in table else find(_alias_keys()[k]) for k in keys]
    names = ", ".join(dict.fromkeys(f"{g.name} ({g.maker})" for g in found))
    return f"the nearest names are {names}" if names else "no name there is like it"


@lru_cache(maxsize=1)
def _table() -> dict[str, Any]:
    """The table as it lies in its file, read when the first glass is asked for; its rows in the order of `MAKERS`."""
    text = (resources.files("neurolens.optics") / "data" / "glasses.json").read_text(encoding="utf-8")
    table = json.loads(text)
    table["glasses"].sort(key=lambda row: MAKERS.index(row[0]))
    return table


@lru_cache(maxsize=1)
def _rows_by_key() -> dict[str, list[int]]:
    """Places in the table by the key of a name, in the order of `MAKERS`."""
    rows: dict[str, list[int]] = {}
    for place, (_, name, *_) in enumerate(_table()["glasses"]):
        rows.setdefault(_key(name), []).append(place)
    return rows


@cache
def _glass(place: int) -> Glass:
    """The glass of one row of the table; the same object every time."""
    maker, name, form, coefficients, low_um, high_um, *sampled = _table()["glasses"][place]
    grid_nm, per_m = (_table()["grids_nm"][sampled[0]], sampled[1]) if sampled else ((), ())
    absorption = tuple((float(nm), a * 1e-3) for nm, a in zip(grid_nm, per_m, strict=True))
    return Glass(maker, name, form, tuple(coefficients), (low_um, high_um), absorption)
