"""Numbers with the units that people type."""

import math
import re
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")
# The worth of units, by dimension: a value may be typed with any unit of its option's dimension.
WORTH: tuple[dict[str, float], ...] = (
    {
        "m": 1,
        "cm": 1e-2,
        "mm": 1e-3,
        "um": 1e-6,
        "\N{MICRO SIGN}m": 1e-6,
        "\N{GREEK SMALL LETTER MU}m": 1e-6,
        "nm": 1e-9,
    }
    | {"km": 1e3, "ft": 0.3048, "'": 0.3048, "in": 0.0254, '"': 0.0254},
    {"deg": 1, "\N{DEGREE SIGN}": 1, "rad": 180 / math.pi},
    {"s": 1, "ms": 1e-3, "min": 60, "h": 3600},
    {"px": 1, "pixels": 1},
    {"stops": 1},
)
_QUANTITY = re.compile(r"([-+]?[\d.]+(?:e[-+]?\d+)?) ?([^\d\s.,]+)", re.IGNORECASE)


def as_float(text: str) -> float:
    """Return the number of a text. Raises ValueError also for digits beyond any float, which are not infinity."""
    value = float(text)
    if math.isinf(value) and re.search(r"\d", text):
        raise ValueError(f"{text[:40]} is too large")
    return value


def in_unit(unit: str, convert: Callable[[str], T]) -> Callable[[str], T]:
    """Make the type of an argument whose numbers may have a unit: in_unit("m", float)("6ft") is 1.8288.

    With `unit` "f" it takes f/2 and 1:2. Units may be typed in capitals: 2M is 2 m, for no option has a use for
    megametres.
    """
    worth = next((worth for worth in WORTH if unit in worth), {})

    def plain(word: str) -> str:
        if unit == "f":
            return re.sub(r"^(?:f/? ?|1:)(?=[\d.])", "", word, flags=re.IGNORECASE)
        found = _QUANTITY.fullmatch(word.strip())
        if found is None or (factor := worth.get(found[2].lower())) is None:
            return word
        with suppress(ValueError):  # 1.2.3
            value = as_float(found[1]) * factor / worth[unit]
            return f"{value:.12g}" if math.isfinite(value) else word
        return word

    def read(text: str) -> T:
        return convert(",".join(map(plain, text.split(","))))

    read.__name__ = getattr(convert, "__name__", "value")  # for messages of argparse
    return read
