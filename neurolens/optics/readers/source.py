"""Limits, lines of text files, and strict tables of TOML and JSON, for all readers; errors name the line or key."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from neurolens.base.errors import AssumedWarning, InputError, NeurolensWarning
from neurolens.base.files import read_bytes
from neurolens.base.settings import positive, setting
from neurolens.base.tomlfile import reject_unknown

MAX_BYTES = 4_000_000  # the longest real lens files, with tolerances and merit function, stay below 1 MB
MAX_LINES = 100_000
MAX_LINE = 10_000
MAX_WORD = 60  # characters of a number
ENDLESS = 1e30  # more than any program writes for infinity
LARGEST = 1e15  # of any figure of a table except radii
MAX_SURFACES = 500
MAX_POWER = 42  # Forbes's aspheres of 20 terms reach it
MAX_INDEX = 4.5  # germanium, the densest lens material there is, has 4.0

# Units of length in mm.
UNITS_MM = {"mm": 1.0, "cm": 10.0, "in": 25.4, "m": 1000.0}


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Facts from the user that a file may lack."""

    name: str | None = setting(None, "name of the lens (default: the title in the file, else its file name)")
    source: str | None = setting(None, "where the figures come from (default: the file's name)", metavar="SOURCE")
    f_number: float | None = setting(
        None, "nominal f-number of a file without one (default: as the stop's diameter gives it)",
        kind=positive("an f-number"), metavar="N", common=True,
    )  # fmt: skip
    stop: str | None = setting(
        None, "number in the file of the surface that is the stop (default: the one marked, else the limiting rim)",
        metavar="N", common=True,
    )  # fmt: skip
    units: Literal["mm", "cm", "in", "m"] | None = setting(
        None, "unit of lengths (default: the file's own, mm)", common=True
    )
    half_field_deg: float | None = setting(
        None, "edge of the field from the axis, for rims that the file does not give (default: the file's own)",
        within=(1e-3, 179.0), unit="degrees", option="half-field", metavar="DEG", common=True,
    )  # fmt: skip
    gap_before: bool = setting(False, "plain table: thickness is that in front of each surface (Kolb 1995)")
    semi_diameters: bool = setting(False, "plain table: the last column holds rim radii")


@dataclass(frozen=True)
class Line:
    """One line of a text file: its place and its words."""

    file: str
    number: int
    text: str

    @property
    def words(self) -> list[str]:
        return self.text.split()

    def error(self, keyword: str, value: object, expected: str) -> InputError:
        """Return the error about something on this line."""
        return InputError(self.file, f"line {self.number}, {keyword}", value, expected)

    def number_of(self, keyword: str, word: str) -> float:
        """Return a finite number from one word of this line."""
        try:
            value = float(word) if "_" not in word and len(word) <= MAX_WORD else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) <= ENDLESS:
            comma = re.fullmatch("[-+]?[0-9]+,[0-9]+(e[-+]?[0-9]+)?", word, re.IGNORECASE)
            raise self.error(
                keyword, word, f"a finite number{', with a point: decimal commas are not read' * bool(comma)}"
            )
        return value

    def first(self, keyword: str, words: Sequence[str]) -> float:
        """Return the first word as a finite number."""
        return self.numbers(keyword, words[:1])[0]

    def positive(self, keyword: str, words: Sequence[str]) -> float:
        """Return the first word as a number above 0."""
        value = self.first(keyword, words)
        if value <= 0:
            raise self.error(keyword, value, "a number above 0")
        return value

    def numbers(self, keyword: str, words: Sequence[str], least: int = 1) -> list[float]:
        """Return the finite numbers from words of this line, at least `least` of them."""
        if len(words) < least:
            found = " ".join(words) or "(nothing)"
            raise self.error(keyword, found, f"{least} number{'s' if least > 1 else ''} after it")
        return [self.number_of(keyword, word) for word in words]


@dataclass(frozen=True)
class Table:
    """One table of a file, read strictly.

    Attributes:
        where: what goes in front of the key in errors, with its separator: "surface 3, ".
    """

    data: Mapping[str, Any]
    file: str
    where: str = ""

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def error(self, key: str, value: object, expected: str) -> InputError:
        return InputError(self.file, self.where + key, value, expected)

    def only(self, known: Sequence[str]) -> None:
        """Raise InputError for a key that is not known."""
        reject_unknown(self.file, self.where, self.data, known)

    def inner(self, key: str, given: Any, known: Sequence[str], expected: str = "a table") -> Table:
        """Return what is given at a place of this table as a table that has only known keys."""
        if not isinstance(given, Mapping):
            raise self.error(key, given, expected)
        table = Table(given, self.file, f"{self.where}{key}, ")
        table.only(known)
        return table

    def number(self, key: str, *, unit: str = "", above: float | None = None, finite: bool = True) -> float:
        """Return a number: an integer or a float, never a bool, a text or NaN."""
        value = self.data.get(key, "(missing)")
        expected = "a finite number" if finite else "a number"
        expected += (f" above {above:g}" if above is not None else "") + (f" in {unit}" if unit else "")
        try:
            found = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
        except OverflowError:
            found = math.nan
        expected += f", at most {LARGEST:g}" if finite and LARGEST < abs(found) < math.inf else ""
        if math.isnan(found) or (finite and not abs(found) <= LARGEST) or (above is not None and not found > above):
            raise self.error(key, value, expected)
        return found

    def optional(self, key: str, *, above: float | None = 0.0) -> float | None:
        """Return a number, or None where it is absent or null; it must be above 0 unless `above` says otherwise."""
        return None if self.data.get(key) is None else self.number(key, above=above)

    def gaps(self, key: str, n_surfaces: int, expected: str) -> tuple[tuple[int, float], ...]:
        """Return the thicknesses in mm by surface number."""
        given = self.data.get(key, "(missing)")
        if not isinstance(given, Mapping):
            raise self.error(key, given, expected)
        found = []
        for place in given:
            if place not in map(str, range(n_surfaces)):
                raise self.error(key, place, f"a surface number from 0 to {n_surfaces - 1}")
            found.append((int(place), Table(given, self.file, f"{self.where}{key}, surface ").number(place, unit="mm")))
        return tuple(found)

    def powers(self, key: str, example: str) -> tuple[tuple[int, float], ...]:
        """Return the coefficients of powers of the height, sorted by power."""
        given = self.data[key]
        if not isinstance(given, Mapping) or not given:
            raise self.error(key, given, example)
        terms, row = [], Table(given, self.file, f"{self.where}{key}, power ")
        for power, value in given.items():
            if power not in map(str, range(2, MAX_POWER + 1)):
                raise self.error(key, power, f"a power from 2 to {MAX_POWER}")
            if isinstance(value, Mapping) and len(value) == 1:  # TOML reads 4.5 as a key in a key
                raise self.error(key, f"{power}.{next(iter(value))}", f"a whole power from 2 to {MAX_POWER}")
            terms.append((int(power), row.number(power)))
        return tuple(sorted(terms))

    def series(self, key: str, first: int) -> tuple[tuple[int, float], ...]:
        """Return the coefficients of `first`, `first` + 2, ... from an optional list, without those that are 0."""
        terms = self.data.get(key) or []
        if not isinstance(terms, list):
            raise self.error(key, terms, f"a list of coefficients of r^{first}, r^{first + 2}, ...")
        row = Table({f"{key}[{k}]": value for k, value in enumerate(terms)}, self.file, self.where)
        found = ((2 * k + first, row.number(name)) for k, name in enumerate(row.data))
        return tuple((power, value) for power, value in found if value)

    def tables(self, key: str) -> list[Mapping[str, Any]]:
        """Return the tables under [[key]], none where it is absent."""
        tables = self.data.get(key, [])
        if not isinstance(tables, list) or not all(isinstance(t, Mapping) for t in tables):
            raise self.error(key, tables, f"tables under [[{key}]]")
        return tables

    def text(self, key: str, *, required: bool = True) -> str:
        """Return a text; an empty one where a text that is not required is absent or null."""
        if self.data.get(key) is None and not required:
            return ""
        value = self.data.get(key, "(missing)")
        if key not in self.data or not isinstance(value, str) or (required and not value.strip()):
            raise self.error(key, value, "a text")
        return value

    def flag(self, key: str) -> bool:
        """Return true or false; false where it is absent."""
        value = self.data.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, value, "true or false")
        return value

    def half_field(self) -> float | None:
        """Return the optional `half_field_deg`."""
        if "half_field_deg" not in self.data:
            return None
        angle = self.number("half_field_deg", unit="degrees", above=0)
        if angle >= 180:
            raise self.error("half_field_deg", angle, "an angle from the axis, below 180 degrees")
        return angle


def by_word(*groups: tuple[str, str]) -> dict[str, str]:
    """Map each keyword to the text about what is expected in its place, from groups of keywords that share one."""
    return {word: expected for words, expected in groups for word in words.split()}


def read_text(path: str | Path) -> str:
    """Return the text of a lens file of bounded size.

    Raises:
        InputError: as `files.read_bytes` and `decode`; the file is empty.
    """
    raw = read_bytes(path, MAX_BYTES, "a lens file")
    if not raw.strip():
        raise InputError(path, "file", "(empty)", "a lens file with content")
    return decode(raw, path)


def decode(raw: bytes, path: str | Path) -> str:
    """Return the text of a file: UTF-16 by its byte-order mark (or by its zero bytes), else UTF-8, else Latin-1.

    Raises:
        InputError: the bytes are no text.
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
    zar = " (of an archive of Zemax, give the .zmx that it holds)" * str(path).lower().endswith(".zar")
    raise InputError(path, "file", "(bytes that are not text)", f"a text file in UTF-8, UTF-16 or Latin-1{zar}")


def lines_of(text: str) -> list[str]:
    """Split a text at ends of lines alone: `splitlines` does so at the ellipsis of Windows' Latin-1, too."""
    return re.split("\r\n|[\n\r\f]", text)


def read_lines(path: str | Path) -> list[Line]:
    """Return the lines of a text file that have content; refuses too many lines, or one that is too long."""
    file = str(path)
    rows = lines_of(read_text(path))
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
    """Warn about something in a file that is read nevertheless."""
    warnings.warn(f"{file}: {message}", NeurolensWarning, stacklevel=3)


def assume(file: str, message: str) -> None:
    """Warn about something that was assumed, because the file lacks it."""
    warnings.warn(f"{file}: {message}", AssumedWarning, stacklevel=3)
