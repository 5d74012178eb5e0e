"""Glasses of lens files by name or by their indices, and glass catalogues of Zemax (.agf).

In a catalogue a glass begins with `NM name formula MIL n_d V_d ...`; `CD` has the coefficients (wavelengths in um),
`LD` the range, and each `IT` a wavelength, a transmittance and the thickness in mm to which it belongs. Formulas are
those of Zemax's manual, "The formulas for dispersion"; read are those that can be written as n^2 = 1 + sum of B L^2 /
(L^2 - C), or as a sum of powers of L.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.glass import LINE_C_NM, LINE_D_NM, LINE_F_NM, Glass, by_figures, figures_of_code
from neurolens.optics.lens.prescription import MediumFields
from neurolens.optics.readers.source import Line, assume, read_lines, warn

_NAMES = frozenset(m.upper() for m in catalogue.MAKERS)
_SAME_LINE_NM = 0.1
_MOULDED = re.compile("([ _-]?MOLD(ED)?|M)$", re.IGNORECASE)
_MOULDING = 0.01  # the most by which moulding lowers an index
# Discontinued glasses of Schott, of which no dispersion formula is at hand: n_d and V_d (LASF14A and SF58 as in
# Elphel's optical-design-viewer, SSK4 as Laikin's "Lens Design" prints it).
_DISCONTINUED: dict[str, tuple[float, float | None]] = {
    **{"LASF14A": (1.82223, None), "SF58": (1.917613, 21.5), "SSK4": (1.6177, 55.11)},
}
SAME_INDEX, SAME_ABBE = 2e-5, 0.005  # by which printed figures may differ from those of a catalogue glass
MAX_GLASSES, MAX_NAME, MAX_SAMPLES = 5000, 64, 200
_FORMULAS = (
    *("Schott", "Sellmeier 1", "Herzberger", "Sellmeier 2", "Conrady", "Sellmeier 3", "Handbook of Optics 1"),
    *("Handbook of Optics 2", "Sellmeier 4", "Extended", "Sellmeier 5", "Extended 2", "Extended 3"),
)
# The number of terms of Sellmeier's form; for other forms the coefficients in the order of `Glass.coefficients`: L^4,
# L^2, 1, L^-2, ...
_SELLMEIER = {2: 3, 6: 4, 11: 5}
_POWERS = {
    1: (None, 1, 0, 2, 3, 4, 5),
    10: (None, 1, 0, 2, 3, 4, 5, 6, 7),
    12: (6, 1, 0, 2, 3, 4, 5),
    13: (2, 1, 0, 3, 4, 5, 6, 7, 8),
}
_SIXTH_POWER = {12: 7}  # place of the coefficient of L^6, which `Glass` cannot hold
_OFF = 1e-3  # a larger difference between n_d of the formula and of the NM line is damage
_DARKEST = 1e-6  # a transmittance of 0 says no more than that it is below this


def named_glass(
    name: str,
    file: str,
    field: str,
    makers: Sequence[str] = (),
    *,
    text: str | None = None,
    figures: tuple[float, float] | None = None,
) -> MediumFields:
    """Return the fields of a surface whose glass the file gives by name alone; warns where it is ambiguous.

    For a discontinued glass its replacement, with the prefix "N-", is taken. A moulded variant of a glass ("..._MOLD",
    "...M") has an index lower by some 0.004, which no catalogue here states; the message offers its base glass.

    Args:
        makers: the makers' catalogues that the file names; the first that has the glass is meant.
        text: the file's words, if it names the maker.
        figures: n_d and V_d that the file gives beside the name, for a glass that the catalogue does not know.

    Raises:
        InputError: the name is unknown and there are no figures; the message suggests the nearest name.
    """
    same = catalogue.same_name(name)
    stem, _, maker = name.rpartition("_")
    if not same and (code := figures_of_code(name)):
        return {"n_d": code[0], "V_d": code[1]}
    if not same and stem and maker.upper() in _NAMES:  # as CODE V writes it
        return named_glass(stem, file, field, [maker.upper()], text=name, figures=figures)
    if not same and not figures and (left := _DISCONTINUED.get(name.upper())):
        warn(file, f"{field}: glass {name} is discontinued: taken by n_d {left[0]:g} and V_d {left[1] or 'unknown'}")
        return {"n_d": left[0], "V_d": left[1], "material": name}
    base = next(iter(catalogue.same_name(_MOULDED.sub("", name))), None)
    if base and not same and not figures:
        expected = f"a glass of the catalogue: it has {base.name}, whose moulded variant this may be; or give --glass"
        raise InputError(file, field, name, expected)
    if base and not same and figures and not 0 <= base.n_d - figures[0] <= _MOULDING:
        message = f"assumed to be {base} (n_d {base.n_d:.5f}), moulded: n_d {figures[0]:g} beside it fits no such glass"
        assume(file, f"{field}: glass {name} is {message}")
        return {"n_d": base.n_d, "V_d": base.V_d, "glass": short_name(base), "material": name}
    known = next((g for m in makers for g in same if g.maker.upper() == m), None)
    replacing = next((g for m in makers for g in catalogue.same_name(f"{m}:N-{name}") if m in _NAMES), None)
    if not (same or replacing or makers):
        replacing = next(iter(catalogue.same_name(f"N-{name}")), None)
    if figures and not (same or replacing):
        return by_figures(name, *figures, f"{file}: {field}")
    taken = known or replacing or catalogue.find(name, file, field)
    if makers and taken.maker.upper() not in makers:
        why = f"no glass of that name in the catalogues that the file names ({', '.join(makers)})"
    elif not makers and text is None:
        why = "the file names no maker"
    else:
        other = _letters(taken.name) not in _letters(text or name)
        why = "its maker's catalogue has none of that very name" if other else ""
    if why:
        warn(file, f"glass {text or name} is taken as {taken} (n_d {taken.n_d:.5f}, V_d {taken.V_d:.2f}): {why}")
    return {"n_d": taken.n_d, "V_d": taken.V_d, "glass": short_name(taken), "material": name}


def by_indices(line: Line, field: str, indices: Sequence[float], wavelengths_nm: Sequence[float]) -> MediumFields:
    """Return a surface's fields from indices at wavelengths: n_d and V_d, with a warning; one index is n_d.

    Between the wavelengths the index is a polynomial of 1 / lambda^2 through the nearest four.

    Raises:
        InputError: the wavelengths of several indices do not enclose the lines d, F and C.
    """
    if len(indices) == 1:
        return {"n_d": indices[0]}
    table = {nm: n for nm, n in zip(wavelengths_nm, indices, strict=False) if nm > 0}
    lines = (LINE_D_NM, LINE_F_NM, LINE_C_NM)
    if not table or min(table) > min(lines) + _SAME_LINE_NM or max(table) < max(lines) - _SAME_LINE_NM:
        expected = "indices from the F line (486.13 nm) to the C line (656.27 nm), to reduce the glass to n_d and V_d"
        raise line.error(field, f"(wavelengths {list(wavelengths_nm)})", expected)
    found = []
    for line_nm in lines:
        near = sorted(table, key=lambda nm: abs(nm - line_nm))[:4]
        if abs(near[0] - line_nm) <= _SAME_LINE_NM:
            near = near[:1]
        shares = (math.prod((line_nm**-2 - b**-2) / (a**-2 - b**-2) for b in near if b != a) for a in near)
        found.append(sum(table[nm] * share for nm, share in zip(near, shares, strict=True)))
    n_d, n_F, n_C = found
    warn(line.file, f"line {line.number}, {field}: the glass is reduced to n_d and V_d")
    return {"n_d": n_d, "V_d": (n_d - 1) / (n_F - n_C) if n_F > n_C else None}


def _letters(name: str) -> str:
    """Return the letters and digits of a name, which alone count."""
    return "".join(filter(str.isalnum, name.upper()))


def same_glass(name: str | None, n_d: float, V_d: float | None) -> str | None:
    """Return the catalogue's glass of that name if it has the given figures, to the digits printed; else None."""
    if name is None or V_d is None:
        return None
    for known in catalogue.same_name(name):
        if abs(known.n_d - n_d) <= SAME_INDEX and abs(known.V_d - V_d) <= SAME_ABBE * V_d:
            return short_name(known)
    return None


def short_name(glass: Glass) -> str:
    """Return the name that finds a glass again; the maker is in it only where others have a glass of that name."""
    return glass.name if catalogue.find(glass.name) is glass else str(glass)


@dataclass
class _Entry:
    """One glass while its file is read."""

    line: Line
    name: str
    formula: int
    n_d: float
    coefficients: list[float] = field(default_factory=list)
    range_um: tuple[float, float] = (0.0, 0.0)
    samples: dict[float, float] = field(default_factory=dict)


def read_agf(path: str | Path) -> tuple[list[Glass], dict[str, str]]:
    """Return a catalogue's glasses, with its file's stem as their maker, and by name why other glasses are not read.

    Raises:
        InputError: there is no such file, it is too large, or a line lacks its numbers; names file and line.
    """
    found, refused, maker = [], {}, Path(path).stem
    for entry in _entries(read_lines(path)):
        try:
            found.append(_glass(entry, maker))
        except ValueError as reason:
            refused[entry.name] = f"{Path(path).name}, line {entry.line.number}: {reason}"
    return found, refused


@contextmanager
def more_glasses(files: Iterable[str | Path]) -> Iterator[None]:
    """Add the glasses of these catalogues inside the block; they come before shipped glasses of the same names."""
    with ExitStack() as stack:
        for found, refused in reversed([read_agf(file) for file in files]):
            stack.enter_context(catalogue.added(found, refused))
        yield


def _entries(lines: Sequence[Line]) -> list[_Entry]:
    entries: list[_Entry] = []
    for line in lines:
        word, rest = line.words[0].upper(), line.words[1:]
        if word == "NM":
            formula, _, n_d = line.numbers("NM", [rest[1], "0", *rest[3:4]] if len(rest) > 3 else [], 3)
            if len(rest[0]) > MAX_NAME:
                raise line.error("NM", f"(a name of {len(rest[0])} characters)", f"at most {MAX_NAME}")
            entries.append(_Entry(line, rest[0], int(formula), n_d))
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


def _glass(entry: _Entry, maker: str) -> Glass:
    """Return the glass of an entry; ValueError with the reason where it cannot be read."""
    kind, (low, high) = entry.formula, entry.range_um
    name = _FORMULAS[kind - 1] if 0 < kind <= len(_FORMULAS) else "unknown"
    if not 0 < low < high:
        raise ValueError(f"its range LD is {low:g} to {high:g} um")
    form, coefficients = _form(kind, [*entry.coefficients, *[0.0] * 10], f"formula {kind} ({name})")
    absorption = tuple(sorted(entry.samples.items()))
    made = Glass(maker, entry.name, form, coefficients, (low, high), absorption if len(absorption) > 1 else ())
    if made.covers(LINE_D_NM) and not abs(made.n_d - entry.n_d) <= _OFF:
        raise ValueError(f"its formula gives n_d = {made.n_d:.6g}, its line NM says {entry.n_d:.6g}")
    return made


def _form(kind: int, c: list[float], name: str) -> tuple[str, tuple[float, ...]]:
    """Return `Glass.form` and `Glass.coefficients` of a formula's coefficients, which zeros may follow."""
    if kind in _SELLMEIER:
        terms = [tuple(c[2 * k : 2 * k + 2]) for k in range(_SELLMEIER[kind])]
        return "sellmeier", tuple(v for term in terms if term[0] for v in term) or (0.0, 0.0)
    if kind == 9:  # n^2 = A + B L^2 / (L^2 - C) + D L^2 / (L^2 - E)
        return "sellmeier", (c[0] - 1, 0.0, *c[1:5])
    if kind not in _POWERS:
        raise ValueError(f"{name} is not read")
    if c[_SIXTH_POWER.get(kind, -1)]:
        raise ValueError(f"{name} with a sixth power is not read")
    return "power", tuple(0.0 if k is None else c[k] for k in _POWERS[kind])
