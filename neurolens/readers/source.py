"""Reading of foreign text files with limits: bytes, text of unknown encoding, numbers; errors name the line."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neurolens.base.errors import AssumedWarning, InputError, NeurolensWarning
from neurolens.base.files import read_bytes

MAX_BYTES = 4_000_000  # the longest real lens files, with tolerances and merit function, stay below 1 MB
MAX_LINES = 100_000
MAX_LINE = 10_000
MAX_WORD, LARGEST = 60, 1e30  # characters of a number; its size, more than any program writes for infinity

# Units of length in mm.
UNITS_MM = {"mm": 1.0, "cm": 10.0, "in": 25.4, "m": 1000.0}


@dataclass(frozen=True)
class Line:
    """One line of a text file: where it stands, and its words."""

    file: str
    number: int
    text: str

    @property
    def words(self) -> list[str]:
        return self.text.split()

    def error(self, keyword: str, value: object, expected: str) -> InputError:
        """The error for something on this line."""
        return InputError(self.file, f"line {self.number}, {keyword}", value, expected)

    def number_of(self, keyword: str, word: str) -> float:
        """A finite number from one word of this line."""
        try:
            value = float(word) if "_" not in word and len(word) <= MAX_WORD else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST:
            comma = re.fullmatch("[-+]?[0-9]+,[0-9]+(e[-+]?[0-9]+)?", word, re.IGNORECASE)
            raise self.error(
                keyword, word, f"a finite number{', with a point: decimal commas are not read' * bool(comma)}"
            )
        return value

    def positive(self, keyword: str, words: Sequence[str]) -> float:
        """The first word as a number above 0."""
        value = self.numbers(keyword, words[:1])[0]
        if value <= 0:
            raise self.error(keyword, value, "a number above 0")
        return value

    def numbers(self, keyword: str, words: Sequence[str], least: int = 1) -> list[float]:
        """Finite numbers from words of this line, at least so many."""
        if len(words) < least:
            found = " ".join(words) or "(nothing)"
            raise self.error(keyword, found, f"{least} number{'s' if least > 1 else ''} after it")
        return [self.number_of(keyword, word) for word in words]


def by_word(*groups: tuple[str, str]) -> dict[str, str]:
    """What is expected in the place of each keyword, from groups of keywords that share it."""
    return {word: expected for words, expected in groups for word in words.split()}


def read_text(path: str | Path) -> str:
    """The text of a lens file of bounded size.

    Raises:
        InputError: as `files.read_bytes` and `decode`; an empty file.
    """
    raw = read_bytes(path, MAX_BYTES, "a lens file")
    if not raw.strip():
        raise InputError(path, "file", "(empty)", "a lens file with content")
    return decode(raw, path)


def decode(raw: bytes, path: str | Path) -> str:
    """Text of a file: UTF-16 by its byte-order mark (or by its zero bytes), else UTF-8, else Latin-1.

    Raises:
        InputError: bytes that are not text.
    """
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        codes = ["utf-16"]
    elif raw[1:2] == b"\0" and raw[:1] != b"\0":
        codes = ["utf-16-le"]
    else:
        codes = ["utf-8-sig", "latin-1"]
    for code in codes:
        try:
            text = raw.decode(code)
        except UnicodeDecodeError:
            continue
        control = next((c for c in text if ord(c) < 32 and c not in "\t\n\r\f\x1a"), None)
        if control is None:
            return text.replace("\x1a", "")  # the end mark of old DOS files
        break
    raise InputError(path, "file", "(bytes that are not text)", "a text file in UTF-8, UTF-16 or Latin-1")


def read_lines(path: str | Path) -> list[Line]:
    """The lines of a text file, those without content left out; refuses too many, or one too long."""
    file = str(path)
    rows = read_text(path).splitlines()
    if len(rows) > MAX_LINES:
        raise InputError(file, "file", f"({len(rows)} lines)", f"at most {MAX_LINES} lines")
    lines = [Line(file, k, row.rstrip()) for k, row in enumerate(rows, start=1) if row.strip()]
    for line in lines:
        if len(line.text) > MAX_LINE:
            raise line.error("length", f"({len(line.text)} characters)", f"at most {MAX_LINE} characters in a line")
    if not lines:
        raise InputError(file, "file", "(empty)", "a lens file with content")
    return lines


def warn(file: str, message: str) -> None:
    """Warn about something in a file that is still read."""
    warnings.warn(f"{file}: {message}", NeurolensWarning, stacklevel=3)


def assume(file: str, message: str) -> None:
    """Warn about something that was assumed in the place of what a file lacks."""
    warnings.warn(f"{file}: {message}", AssumedWarning, stacklevel=3)
