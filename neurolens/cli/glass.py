"""`neurolens glass NAME`: what the glass catalogue knows of a name or of a six-digit code."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, ClassVar

from neurolens.base.errors import InputError
from neurolens.base.settings import setting
from neurolens.cli.arguments import Answering, Glasses
from neurolens.cli.output import number, table

_CODE = re.compile(r"[0-9]{3}[./]?[0-9]{3}")
_NEAR_N_D, _NEAR_V_D = 0.01, 2.0  # what lies farther from a code has nothing to do with it
_TRANSMITTED_NM = (400.0, 450.0, 550.0, 700.0)
_PLATE_MM = 10.0


@dataclass(frozen=True, kw_only=True)
class Glass(Glasses, Answering):
    """Look glasses up in the catalogue that ships with neurolens: index, Abbe number, the
    wavelengths that the maker states the index for, and what 10 mm transmit inside (without
    reflections). A name gives the glass of every maker that has one of that name, the one that a
    lens file gets first; a six-digit code (517642) the glasses nearest to it, up to 0.01 in
    n_d and 2 in V_d away."""

    about: ClassVar[str] = "look glasses up by name or code"
    epilog: ClassVar[str] = """\
examples:
  neurolens glass N-BK7 "F2 (CDGM)" PMMA
  neurolens glass 517642 --json"""

    name: tuple[str, ...] = setting(
        ..., '"N-BK7", "Schott:N-BK7", or a code such as 517642', positional=True, metavar="NAME", nargs="+"
    )

    def run(self) -> int:
        """Print the requested glasses."""
        from neurolens.lens import catalogue

        glasses: list[catalogue.Glass] = []
        for name in self.name:
            if _CODE.fullmatch(name):
                glasses += _near(name)
            else:
                catalogue.find(name, "argument", "NAME")
                glasses += catalogue.same_name(name)
        rows = [_record(glass) for glass in dict.fromkeys(glasses)]
        return self.answer({"glasses": rows}, lambda: _text(rows))


def _text(rows: list[dict[str, Any]]) -> str:
    header = ("glass", "n_d", "V_d", "nm from", "to", *(f"10 mm at {nm:.0f} nm" for nm in _TRANSMITTED_NM))
    lines = [
        [
            *(row["glass"], f"{row['n_d']:.6f}", f"{row['V_d']:.2f}", *(number(v) for v in row["range_nm"])),
            *(number(row["internal_transmittance_10mm"].get(f"{nm:.0f}")) for nm in _TRANSMITTED_NM),
        ]
        for row in rows
    ]
    return table(header, lines)


def _near(code: str) -> list[Any]:
    """The glasses nearest to a code, those alone that are near it.

    Raises:
        InputError: none is.
    """
    from neurolens.lens import catalogue

    digits = re.sub("[./]", "", code)
    n_d, V_d = 1 + int(digits[:3]) / 1000, int(digits[3:]) / 10
    nearest = catalogue.by_code(code, 6)
    found = [g for g in nearest if abs(g.n_d - n_d) <= _NEAR_N_D and abs(g.V_d - V_d) <= _NEAR_V_D]
    if not found:
        near = f"{nearest[0]} (n_d {nearest[0].n_d:.4f}, V_d {nearest[0].V_d:.1f})"
        expected = f"a code within {_NEAR_N_D:g} in n_d and {_NEAR_V_D:g} in V_d of a glass; the nearest is {near}"
        raise InputError("argument", "NAME", code, expected)
    return found


def _record(glass: Any) -> dict[str, Any]:
    """Figures of one glass; internal transmittance by wavelength in nm, empty where the source has none."""
    absorption = {nm: glass.absorption_per_mm(nm) for nm in _TRANSMITTED_NM if glass.absorption}
    return {
        "glass": str(glass),
        "n_d": glass.n_d,
        "V_d": glass.V_d,
        "range_nm": [1000 * v for v in glass.range_um],
        "form": glass.form,
        "coefficients": glass.coefficients,
        "internal_transmittance_10mm": {f"{nm:.0f}": math.exp(-_PLATE_MM * a) for nm, a in absorption.items()},
    }
