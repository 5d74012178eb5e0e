"""The text of CODE V sequence files: commands with their qualifiers and values, and media as they are written there."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neurolens.optics import catalogue
from neurolens.readers.assemble import named_glass
from neurolens.readers.source import Line

_MAX_COMMAND = 100_000  # characters of one command with all its continuation lines
# Fraunhofer lines to which a private glass is reduced, nm.
_D, _F, _C, _SAME_LINE = 587.56, 486.13, 656.27, 0.1


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
            words = _words(part)
            if words:
                yield Command(words[0], words[0].upper()[:3], tuple(words[1:]), start)
        text, start = "", None
    if text.strip():
        raise lines[-1].error("&", "(the file ends)", "a line that continues the command")


def _outside_quotes(text: str, mark: str) -> list[str]:
    """A text split at a mark that stands outside quotes."""
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


def _words(text: str) -> list[str]:
    return [m[1] or m[2] or m[0] for m in re.finditer(r"'([^']*)'|\"([^\"]*)\"|\S+", text)]


def medium(command: Command, words: Sequence[str], private: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Fields of a surface for the medium behind it: a name, "NAME_MAKER", a code, n:V, n V, or nothing for air.

    A code is the fraction of the index and the Abbe number without its point: 517.642, 517642 or 516800.641700.
    """
    if not words or words[0].upper() in ("AIR", ""):
        return {}
    word = words[0]
    if word.upper() == "REFL":
        raise command.line.error(command.name, word, "a glass: the lens model has no mirrors")
    if word in private:
        return dict(private[word])
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
    qualified = f"{maker}:{name}" if name else word
    if name and not catalogue.same_name(qualified):
        # Other names of a glass ("BK7") are listed without their maker.
        alias = [g for g in catalogue.same_name(name) if g.maker.upper() == maker.upper()]
        # Glasses that their makers dropped are replaced by those with "N-" in front.
        replacing = catalogue.same_name(f"{maker}:N-{name}")
        qualified = str((*alias, *replacing)[0]) if alias or replacing else qualified
    known = named_glass(qualified, command.line.file, f"line {command.line.number}, glass", said=word if name else None)
    return {**known, "material": word}


def private_glass(command: Command, wavelengths_nm: Sequence[float]) -> dict[str, Any]:
    """Fields of a surface from a row of a PRV block: indices at the wavelengths of its PWL line.

    Raises:
        InputError: not one index a wavelength, or not the lines d, F and C among them, to which it is reduced.
    """
    indices = command.numbers(least=len(wavelengths_nm))
    found = {}
    for name, line_nm in (("d", _D), ("F", _F), ("C", _C)):
        near = [k for k, nm in enumerate(wavelengths_nm) if abs(nm - line_nm) <= _SAME_LINE]
        if not near:
            expected = f"an index at the {name} line ({line_nm} nm), to reduce the glass to n_d and V_d"
            raise command.line.error("PRV", f"(wavelengths {wavelengths_nm})", expected)
        found[name] = indices[near[0]]
    dispersion = found["F"] - found["C"]
    return {"n_d": found["d"], "V_d": (found["d"] - 1) / dispersion if dispersion > 0 else None}
