"""Output of commands: strict JSON, and tables of aligned columns."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from neurolens.base.errors import printable
from neurolens.base.records import plain


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout."""
    print(printable(json.dumps(plain(data), indent=1, allow_nan=False, ensure_ascii=False)))


def number(value: Any, digits: int = 4) -> str:
    """A number with significant digits, "-" for None and NaN."""
    if value is None or isinstance(value, str):
        return value or "-"
    if isinstance(value, int):
        return str(value)
    if math.isnan(value):
        return "-"
    return "infinity" if math.isinf(value) else f"{value + 0.0:.{digits}g}"  # no "-0"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Columns aligned by two spaces: the first `left` to the left, the others to the right."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]

    def row(cells: Sequence[str]) -> str:
        placed = (c.ljust(w) if k < left else c.rjust(w) for k, (c, w) in enumerate(zip(cells, widths, strict=True)))
        return "  ".join(placed).rstrip()

    return "\n".join(row(line) for line in lines)
