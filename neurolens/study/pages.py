"""The contents of pages: tables of records, settings as texts, pictures. Templates make HTML of them (`base.html`)."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from neurolens.base.html import local_url
from neurolens.base.records import noisy

Record = Mapping[str, Any]
DASH = "–"


class Table(NamedTuple):
    """Records as rows, with a name for each, and the columns of their figures."""

    names: Sequence[str]
    records: Sequence[Record]
    columns: Sequence[Column]


@dataclass(frozen=True)
class Figure:
    """A picture of a page: its address (None where the file is missing), texts, and links by their labels."""

    source: str | None
    file: str
    title: str
    caption: str
    links: Mapping[str, str]
    wide: bool
    inside: bool


def number(record: Mapping[str, Any], key: str) -> float | None:
    """Finite number at `key` of a record, or None; dots go into nested tables: "ns_per_ray.min"."""
    value: Any = record
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, the key of its figure in a record, a factor and the significant digits.

    Dots in a key go into nested tables. `about` explains the figure on hover and in the legend.
    """

    heading: str
    key: str
    factor: float = 1.0
    digits: int = 3
    about: str = ""

    def value(self, record: Record) -> float | None:
        """The figure, unscaled."""
        return number(record, self.key)

    def cell(self, record: Record, thousands: str = "") -> str:
        """The figure as text: a dash if it is missing, "~" before the minimum of a noisy timing; "never" stays."""
        if record.get(self.key) == "never":
            return "never"
        value, parent = number(record, self.key), self.key.removesuffix(".min")
        if value is None:
            return DASH
        mark = "~" if parent != self.key and noisy(record[parent]) else ""
        return mark + show(value * self.factor, self.digits, thousands)


def show(value: float, digits: int, thousands: str = "") -> str:
    """A number with significant digits. Short ones have no exponent; `thousands` separates the digits of long ones."""
    if value == 0 or 1e-4 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:{thousands}.0f}" if 1 <= abs(value) < 1e7 else f"{value:.{digits - 1}e}"


def table(names: Sequence[str], records: Sequence[Record], columns: Iterable[Column]) -> Table:
    """The table of records, without the columns for which no record has a figure."""
    return Table(names, records, [c for c in columns if any(c.value(r) is not None for r in records)])


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """A table of settings as names and texts; nested tables have dotted names."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", _plain(value)))
    return rows


def _plain(value: Any) -> str:
    if value is None or value != value:  # NaN differs from itself
        return DASH
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return " to ".join(map(_plain, value)) if len(value) == 2 else ", ".join(map(_plain, value))
    return str(value)


def figures_of(folder: Path, figures: Iterable[Mapping[str, Any]], inside: bool = False) -> list[Figure]:
    """Figures of records with "file" and maybe "title", "caption", "links" and "wide".

    A picture or link whose file is not in `folder` has no address.

    Args:
        inside: whether PNG files become part of the page, which then needs no others.
    """
    shown = []
    for figure in figures:
        url = local_url(folder, figure.get("file"))
        if url is not None and inside:
            data = base64.b64encode((folder / str(figure["file"])).read_bytes()).decode("ascii")
            url = f"data:image/png;base64,{data}"
        links = {label: local_url(folder, file) for label, file in (figure.get("links") or {}).items()}
        existing = {label: link for label, link in links.items() if link}
        file, title, caption = (str(figure.get(key) or "") for key in ("file", "title", "caption"))
        shown.append(Figure(url, file, title, caption, existing, bool(figure.get("wide")), inside))
    return shown
