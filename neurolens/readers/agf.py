"""Glass catalogues of Zemax (.agf): names, dispersion formulas, ranges, internal transmittance.

A glass begins with `NM name formula MIL n_d V_d ...`; `CD` has the coefficients (wavelengths in um), `LD` the range,
and each `IT` a wavelength, a transmittance and the thickness in mm that it is of. Formulas as in Zemax's manual, "The
formulas for dispersion"; read are those that n^2 = 1 + sum of B L^2 / (L^2 - C) or a sum of powers of L can write.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from neurolens.lens import catalogue, glass
from neurolens.lens.catalogue import LINE_D_NM, Glass
from neurolens.readers.source import Line, read_lines

MAX_GLASSES, MAX_NAME, MAX_SAMPLES = 5000, 64, 200
_FORMULAS = (
    *("Schott", "Sellmeier 1", "Herzberger", "Sellmeier 2", "Conrady", "Sellmeier 3", "Handbook of Optics 1"),
    *("Handbook of Optics 2", "Sellmeier 4", "Extended", "Sellmeier 5", "Extended 2", "Extended 3"),
)
# Terms of Sellmeier's form; of the others the coefficients in the order of `Glass.coefficients`: L^4, L^2, 1, L^-2, ...
_SELLMEIER = {2: 3, 6: 4, 11: 5}
_POWERS = {
    1: (None, 1, 0, 2, 3, 4, 5),
    10: (None, 1, 0, 2, 3, 4, 5, 6, 7),
    12: (6, 1, 0, 2, 3, 4, 5),
    13: (2, 1, 0, 3, 4, 5, 6, 7, 8),
}
_SIXTH_POWER = {12: 7}  # the coefficient of L^6, for which there is no place
_OFF = 1e-3  # n_d of the formula and of the NM line: a larger difference is damage
_DARKEST = 1e-6  # a transmittance of 0 says no more than that


@dataclass
class _Entry:
    """One glass while the file is read."""

    line: Line
    name: str
    formula: int
    n_d: float
    coefficients: list[float] = field(default_factory=list)
    range_um: tuple[float, float] = (0.0, 0.0)
    samples: dict[float, float] = field(default_factory=dict)


def read_agf(path: str | Path) -> tuple[list[Glass], dict[str, str]]:
    """The glasses of a catalogue, its file's stem their maker; and by name why others are not read.

    Raises:
        InputError: no such file, one too large, a line without its numbers; names file and line.
    """
    found, refused, maker = [], {}, Path(path).stem
    for entry in _entries(read_lines(path)):
        try:
            found.append(_glass(entry, maker))
        except _Refused as reason:
            refused[entry.name] = f"{Path(path).name}, line {entry.line.number}: {reason}"
    return found, refused


@contextmanager
def more_glasses(files: Iterable[str | Path]) -> Iterator[None]:
    """The glasses of these catalogues within the block, before those of the same names that ship."""
    read, before = [read_agf(file) for file in files], catalogue.added()
    try:
        for found, refused in reversed(read):
            catalogue.add(found, refused)
        glass.forget()
        yield
    finally:
        if read:
            catalogue.restore(before)
            glass.forget()


class _Refused(Exception):
    """A glass that is not read."""


def _entries(lines: Sequence[Line]) -> list[_Entry]:
    entries: list[_Entry] = []
    for line in lines:
        word, rest = line.words[0].upper(), line.words[1:]
        if word == "NM":
            entries.append(_entry(line, rest))
            if len(entries) > MAX_GLASSES:
                raise line.error("NM", f"({len(entries)} glasses)", f"at most {MAX_GLASSES}")
        elif not entries:
            if word not in ("CC", "!"):
                raise line.error(word, line.text[:40], "a catalogue of glasses that begins with CC or NM")
        elif word == "CD":
            entries[-1].coefficients = line.numbers(word, rest[:10], 4)
        elif word == "LD":
            low, high = line.numbers(word, rest[:2], 2)
            entries[-1].range_um = (low, high)
        elif word == "IT" and len(rest) > 2 and len(entries[-1].samples) < MAX_SAMPLES:
            um, share, thickness = line.numbers(word, rest[:3], 3)
            if um > 0 and thickness > 0:
                entries[-1].samples[1000 * um] = -math.log(min(max(share, _DARKEST), 1.0)) / thickness
    return entries


def _entry(line: Line, rest: list[str]) -> _Entry:
    formula, _, n_d = line.numbers("NM", [rest[1], "0", *rest[3:4]] if len(rest) > 3 else [], 3)
    if len(rest[0]) > MAX_NAME:
        raise line.error("NM", f"(a name of {len(rest[0])} characters)", f"at most {MAX_NAME}")
    return _Entry(line, rest[0], int(formula), n_d)


def _glass(entry: _Entry, maker: str) -> Glass:
    kind, (low, high) = entry.formula, entry.range_um
    name = _FORMULAS[kind - 1] if 0 < kind <= len(_FORMULAS) else "unknown"
    if not 0 < low < high:
        raise _Refused(f"its range LD is {low:g} to {high:g} um")
    form, coefficients = _form(kind, [*entry.coefficients, *[0.0] * 10], f"formula {kind} ({name})")
    absorption = tuple(sorted(entry.samples.items()))
    made = Glass(maker, entry.name, form, coefficients, (low, high), absorption if len(absorption) > 1 else ())
    if made.covers(LINE_D_NM) and not abs(made.n_d - entry.n_d) <= _OFF:
        raise _Refused(f"its formula gives n_d = {made.n_d:.6g}, its line NM says {entry.n_d:.6g}")
    return made


def _form(kind: int, c: list[float], told: str) -> tuple[str, tuple[float, ...]]:
    """`Glass.form` and `Glass.coefficients` of a formula's coefficients, with zeros behind them."""
    if kind in _SELLMEIER:
        terms = [tuple(c[2 * k : 2 * k + 2]) for k in range(_SELLMEIER[kind])]
        return "sellmeier", tuple(v for term in terms if term[0] for v in term) or (0.0, 0.0)
    if kind == 9:  # n^2 = A + B L^2 / (L^2 - C) + D L^2 / (L^2 - E)
        return "sellmeier", (c[0] - 1, 0.0, *c[1:5])
    if kind not in _POWERS:
        raise _Refused(f"{told} is not read")
    if c[_SIXTH_POWER.get(kind, -1)]:
        raise _Refused(f"{told} with a sixth power is not read")
    return "power", tuple(0.0 if k is None else c[k] for k in _POWERS[kind])
