"""What the commands' arguments share: numbers with their range and unit, the state of a lens, help with examples."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """A parser whose mistakes are one line, and whose help keeps its line breaks."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        # An abbreviation that works today would break a script when an option is added.
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def positive(unit: str, *, infinite: bool = False) -> Callable[[str], float]:
    """Type of an argument that is a number above 0; "inf" only where it makes sense."""

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not value > 0 or (math.isinf(value) and not infinite):
            raise argparse.ArgumentTypeError(f"got {text!r}, expected {unit} above 0{', or inf' if infinite else ''}")
        return value

    return convert


def between(low: float, high: float, unit: str) -> Callable[[str], float]:
    """Type of an argument that is a number from `low` to `high`."""

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # false for NaN
            raise argparse.ArgumentTypeError(f"got {text!r}, expected {unit} from {low:g} to {high:g}")
        return value

    return convert


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Type of an argument that is an integer from `least` to `most`."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            span = f"from {least}" + ("" if most is None else f" to {most}")
            raise argparse.ArgumentTypeError(f"got {text!r}, expected an integer {span}")
        return value

    return convert


def add_lens_state(parser: argparse.ArgumentParser, defaults: dict[str, str]) -> None:
    """Add --efl, --configuration, --f-number and --focus; `defaults` says in words what each is when left out."""
    group = parser.add_argument_group("state of the lens")
    group.add_argument(
        "--efl", metavar="MM", type=positive("a focal length in mm"),
        help=f"scale the whole lens to this focal length in mm (default: {defaults['efl']})",
    )  # fmt: skip
    group.add_argument(
        "--configuration", metavar="NAME", help="zoom state of the lens file, by name (default: its table as it stands)"
    )
    group.add_argument(
        "--f-number", metavar="N", type=positive("an f-number"),
        help=f"focal length over entrance-pupil diameter at infinity focus (default: {defaults['f_number']})",
    )  # fmt: skip
    group.add_argument(
        "--focus", metavar="M", type=positive("a distance in metres", infinite=True),
        help=f"distance from the film to the object in focus in metres, or inf (default: {defaults['focus']})",
    )  # fmt: skip


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add --json."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout instead of the text; keys carry their unit"
    )
