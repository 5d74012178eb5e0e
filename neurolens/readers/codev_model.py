"""Parser state of a CODE V file: commands, media, surfaces, zoom positions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from neurolens.readers import draft
from neurolens.readers.draft import INFINITE, State
from neurolens.readers.glasses import by_indices, named_glass
from neurolens.readers.source import Line, assume

_MAX_COMMAND = 100_000  # characters of one command with all its continuation lines


@dataclass(frozen=True)
class Command:
    """One command: its name as written, three letters of it (which is all that counts), its words, where it begins."""

    word: str
    name: str
    words: tuple[str, ...]
    line: Line

    def numbers(self, words: Sequence[str] | None = None, least: int = 1) -> list[float]:
        """Its values as numbers."""
        return self.line.numbers(self.name, self.words if words is None else words, least)


def commands(lines: Sequence[Line]) -> Iterator[Command]:
    """The commands of a file: "!" begins a comment, ";" ends a command, "&" at the end of a line continues it."""
    text, start = "", None
    for line in lines:
        bare = _outside_quotes(line.text, "!")[0]
        start = start or line
        if bare.rstrip().endswith("&"):
            text += bare.rstrip()[:-1] + " "
            if len(text) > _MAX_COMMAND:
                raise start.error("&", f"({len(text)} characters)", f"at most {_MAX_COMMAND} characters in a command")
            continue
        for part in _outside_quotes(text + bare, ";"):
            words = [m[1] or m[2] or m[0] for m in re.finditer(r"'([^']*)'|\"([^\"]*)\"|\S+", part)]
            if words:
                yield Command(words[0], words[0].upper()[:3], tuple(words[1:]), start)
        text, start = "", None
    if text.strip():
        raise lines[-1].error("&", "(the file ends)", "a line that continues the command")


def _outside_quotes(text: str, mark: str) -> list[str]:
    """Return a text split at a mark that stands outside quotes."""
    parts, quote, begin = [], "", 0
    for place, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter == mark:
            parts.append(text[begin:place])
            begin = place + 1
    return [*parts, text[begin:]]


def medium(
    command: Command, words: Sequence[str], private: Mapping[str, tuple[Command, Sequence[float]]]
) -> dict[str, Any]:
    """Fields of a surface for the medium behind it: a name, "NAME_MAKER", a code, n:V, n V, or nothing for air.

    A code is the fraction of the index and the Abbe number without its point: 517.642, 517642 or 516800.641700.
    """
    if not words or words[0].upper() in ("AIR", ""):
        return {}
    word = words[0]
    if word.upper() == "REFL":
        raise command.line.error(command.name, word, "a glass: the lens model has no mirrors")
    if word in private:
        return {**_private(*private[word]), "material": word}
    pair = word.split(":")
    if len(pair) == 2:
        n_d, V_d = command.numbers(pair, 2)
        return {"n_d": n_d, "V_d": V_d}
    code = re.fullmatch(r"([0-9]{3,6})\.([0-9]{3,6})|([0-9]{3})([0-9]{3})", word)
    if code:
        index, abbe = (code[1], code[2]) if code[1] else (code[3], code[4])
        return {"n_d": 1 + int(index) / 10 ** len(index), "V_d": int(abbe) / 10 ** (len(abbe) - 2)}
    if re.fullmatch(r"[0-9.]+(e[+-]?[0-9]+)?", word, re.IGNORECASE):
        numbers = command.numbers(words[:2])
        return {"n_d": numbers[0], "V_d": numbers[1] if len(numbers) > 1 else None}
    name, _, maker = word.rpartition("_")
    makers = [maker.upper()] if name else []
    place = f"line {command.line.number}, glass"
    known = named_glass(name or word, command.line.file, place, makers, text=word if name else None)
    return {**known, "material": word}


def _private(command: Command, wavelengths_nm: Sequence[float]) -> dict[str, Any]:
    """Return the fields of a surface from a row of a PRV block: indices at the wavelengths of its PWL line."""
    if command.words and not re.match(r"[-+.0-9]", command.words[0]):
        expected = "an index at each wavelength of PWL: formulas of private glasses are not read"
        raise command.line.error(f"PRV {command.word}", command.words[0], expected)
    return by_indices(command.line, f"PRV {command.word}", command.numbers(least=len(wavelengths_nm)), wavelengths_nm)


# Of special surfaces: how the names of their coefficients begin, before the power of the first term.
SPECIAL = {"ODD": "AR", "QBF": "QB", "QCN": "QC"}
ALONG = ("KX", "KY", "AR", "BR", "CR", "DR", "AP", "BP", "CP", "DP")  # of AAS
# Coefficients of an ASP surface: r^4, r^6, ... r^20.
LETTERS = {letter: 4 + 2 * k for k, letter in enumerate("ABCDEFGHJ")}
NONE_BUT_0 = ("CUF", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE")


@dataclass
class Block(draft.Block):
    """One surface with what CODE V says of it."""

    kind: str = "SPH"
    curvature_x: float | None = None
    terms: dict[str, float] = field(default_factory=dict)
    solved: bool = False  # whether the thickness is solved for the paraxial image
    special: dict[str, float] | None = None  # coefficients of a special surface

    def put(self, command: Command, value: float) -> None:
        """Set one figure of the surface by the name of its command."""
        match command.name:
            case "RDY" | "RDX" | "CUY" | "CUX":
                curvature = value if command.name.startswith("C") or value == 0 else 1 / value
                if command.name.endswith("Y"):
                    self.curvature = curvature
                else:
                    self.curvature_x = curvature
            case "THI":
                self.thickness = value
            case "K":
                self.conic = value
            case name if name in NONE_BUT_0:
                if value:
                    raise command.line.error(name, value, "0: Fresnel surfaces, tilts and decentres are not read")
            case "KY":
                self.conic = value
            case letter:
                self.terms[letter] = value

    def put_special(self, command: Command, words: Sequence[str]) -> None:
        """SPS with a type and a normalisation radius, or SCO with the name and value of a coefficient."""
        name = words[0].upper() if words else ""
        if command.name == "SCO":
            if self.special is None:
                raise command.line.error("SCO", name, "SPS before it")
            self.special[name] = command.numbers(words[1:])[0]
        elif name in SPECIAL:
            self.kind, self.special = name, {"NRADIUS": command.numbers(words[1:2], 0)[0]} if words[1:] else {}
        else:
            expected = f"one of {', '.join(SPECIAL)}: other special surfaces are not read"
            raise command.line.error("SPS", name or "(none)", expected)


def shape_of(block: Block) -> dict[str, Any]:
    """Return the radius, conic, asphere and what bends it across of a surface, for `Surface`.

    YTO is a curve in y (curvature CUY, K, A y^4, ...) turned about an axis along y at 1 / CUX; XTO likewise in x; a
    cylinder where one of both is zero. AAS with its two conics K and KX is a biconic.
    """
    if block.special is not None:
        return _special(block)
    if block.kind == "AAS":
        return _biconic(block)
    terms = {LETTERS[letter]: value for letter, value in block.terms.items() if value}
    if block.kind in ("SPH", "CON") and terms:
        raise block.start.error(block.kind, f"(with coefficients {', '.join(block.terms)})", "ASP before coefficients")
    if block.kind == "SPH" and block.conic:
        raise block.start.error("K", block.conic, "CON or ASP before a conic constant")
    if block.kind in ("SPH", "CON", "ASP"):
        if block.curvature_x not in (None, block.curvature):
            raise block.start.error("CUX", block.curvature_x, "a cylinder (CYL, YTO or XTO)")
        return block.rotational(sorted(terms.items()))
    own, other = block.curvature, block.curvature_x or 0.0
    if block.kind == "XTO":
        own, other = other, own
    axes = ("x", "y") if block.kind == "XTO" else ("y", "x")
    if own or terms:
        curve = replace(block, curvature=own).rotational(sorted(terms.items()))
        return curve | {"cylinder": axes[0]} | ({"across": (1 / other, None)} if other else {})
    if block.conic and other:  # K belongs to the curve that is turned
        raise block.start.error("K", block.conic, "0, as this cylinder's curve is a circle")
    return {"radius_mm": 1 / other, "cylinder": axes[1]} if other else {"radius_mm": math.inf}


def _biconic(block: Block) -> dict[str, Any]:
    """AAS; its higher terms are AR to DR, whose shares in x and y are AP to DP."""
    conic_x = block.terms.get("KX", 0.0)
    for name, value in block.terms.items():
        if value and name != "KX" and not name.endswith("P"):
            raise block.start.error(f"{name} of AAS", value, "0: a biconic has no terms of higher order")
    radius_x = 1 / block.curvature_x if block.curvature_x else math.inf
    return block.crossed(block.rotational(), radius_x, conic_x)


def _special(block: Block) -> dict[str, Any]:
    """ODD: sum of ARn r^n over NRADIUS^n, which 0 leaves out; Q-types: QBn or QCn, n = 4 + 2 m, of Forbes's sums."""
    kind, values = block.kind, dict(block.special or {})
    radius, block.conic = values.pop("NRADIUS", 0.0), values.pop("K", 0.0)
    found: dict[int, float] = {}
    for name, value in values.items():
        match = re.fullmatch(SPECIAL[kind] + "([0-9]{1,2})", name)
        power = int(match[1]) if match else 0
        if not match or (kind != "ODD" and (power < 4 or power % 2)) or (power < 2 and value):
            first = "AR2, AR3, ..." if kind == "ODD" else f"{SPECIAL[kind]}4, {SPECIAL[kind]}6, ..."
            raise block.start.error(f"SCO of SPS {kind}", name, f"K, NRADIUS or {first}")
        found[power] = value
    if kind == "ODD":
        return block.rotational((n, a / (radius or 1.0) ** n) for n, a in sorted(found.items()))
    if kind == "QBF" and block.conic:
        raise block.start.error(f"conic of SPS {kind}", block.conic, "0: Qbfs departs from a sphere")
    if not radius > 0:
        raise block.start.error(f"NRADIUS of SPS {kind}", radius, "a normalisation radius above 0")
    message = f"SPS {kind}: coefficient {SPECIAL[kind]}n is taken as that of Forbes's m = (n - 4) / 2"
    assume(block.start.file, f"line {block.start.number}: {message}")
    terms = [found.get(n, 0.0) for n in range(4, max(found, default=2) + 1, 2)]
    return block.q_type(f"SPS {kind}", kind == "QCN", terms, radius)


MAX_POSITIONS = 200
ZOOMED = ("THI", "EPD", "FNO", "CIR", "TIT")
# Control codes, fields, vignetting factors, weights, wavelengths.
NOT_ZOOMED = frozenset(
    """THC CCY GLC KC VUX VLX VUY VLY XAN YAN XIM YIM XRI YRI XOB YOB WTF WTW WTA WL REF DER""".split()
)


@dataclass
class Zoom:
    """The positions while they are read; values by position (from 0)."""

    count: int = 0
    titles: dict[int, str] = field(default_factory=dict)
    thickness: dict[tuple[int, int], float] = field(default_factory=dict)  # (surface, position)
    pupil: list[float] = field(default_factory=list)
    f_number: list[float] = field(default_factory=list)
    semi_diameter: dict[int, tuple[list[float], Command]] = field(default_factory=dict)

    def read(self, command: Command, n_blocks: int) -> None:
        """One ZOO command: the count of positions, or a quantity with one value a position."""
        words, line = command.words, command.line
        if words and words[0].isdecimal():
            self.count = int(words[0])
            if not 1 <= self.count <= MAX_POSITIONS:
                raise line.error("ZOO", words[0], f"1 to {MAX_POSITIONS} positions")
            return
        name = words[0].upper()[:3] if words else ""
        if name in NOT_ZOOMED or (name == "TIT" and self.count):
            return
        if name not in ZOOMED or not self.count:
            expected = f"the count of positions first, then one of {', '.join(ZOOMED)}: other zooms are not read"
            raise line.error("ZOO", name, expected)
        surface, values = -1, words[1:]
        if name in ("THI", "CIR"):
            match = re.fullmatch(r"S([0-9]{1,4}|O)", values[0].upper()) if values else None
            if match is None or int(match[1].replace("O", "0")) >= n_blocks:
                raise line.error(f"ZOO {name}", " ".join(values[:1]), f"a surface from S0 to S{n_blocks - 1}")
            surface, values = int(match[1].replace("O", "0")), values[1:]
            if name == "THI" and not values:
                return  # the values come one by one: THI Sk Zn value
        numbers = command.numbers(values, self.count)
        if len(numbers) != self.count or (name != "THI" and min(numbers) <= 0):
            raise line.error(f"ZOO {name}", " ".join(values), f"{self.count} values, one a position")
        match name:
            case "THI":
                self.thickness.update({(surface, place): value for place, value in enumerate(numbers)})
            case "EPD":
                self.pupil = numbers
            case "FNO":
                self.f_number = numbers
            case "CIR":
                self.semi_diameter[surface] = (numbers, command)

    def title(self, command: Command) -> None:
        """TIT Zk "name"."""
        self.titles[int(command.words[0][1:]) - 1] = " ".join(command.words[1:]).strip("\"' ")

    def one_thickness(self, command: Command, n_blocks: int) -> None:
        """THI Sk Zn value."""
        surface, place = command.words[0][1:], command.words[1][1:]
        good = surface.isdecimal() and place.isdecimal() and int(surface) < n_blocks and 1 <= int(place) <= self.count
        if not good:
            raise command.line.error("THI", " ".join(command.words[:2]), f"Sk Zn with n from 1 to {self.count}")
        self.thickness[int(surface), int(place) - 1] = command.numbers(command.words[2:])[0]

    def states(self, middle: Sequence[Block], object_distance: float, defocus: float) -> Iterator[State]:
        """Return the positions of a file, by rows of the draft (surface numbers less one)."""
        for surface, (_, command) in self.semi_diameter.items():
            if not (0 < surface <= len(middle) and middle[surface - 1].stop):
                raise command.line.error("ZOO CIR", f"S{surface}", "the stop: other rims cannot change")
        for place in range(self.count if self.count > 1 else 0):
            gaps = {k: value for (k, there), value in self.thickness.items() if there == place}
            distance = gaps.pop(0, object_distance)
            last = len(middle)
            gaps.pop(last + 1, None)  # the defocus of the image surface
            opening = next((2 * values[place] for values, _ in self.semi_diameter.values()), None)
            yield State(
                name=self.titles.get(place) or f"position {place + 1}",
                thickness={k - 1: gap + (defocus if k == last else 0.0) for k, gap in gaps.items()},
                pupil=self.pupil[place] if self.pupil else None,
                f_number=self.f_number[place] if self.f_number else None,
                stop_diameter=opening,
                object_distance=math.inf if distance >= INFINITE else distance,
                film_given=not middle[-1].solved or last in gaps,
            )
