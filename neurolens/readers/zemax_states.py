"""Multi-configuration operands of Zemax: thicknesses and what sizes the stop; all else is an error by line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from neurolens.base.errors import InputError
from neurolens.readers.draft import State
from neurolens.readers.source import Line
from neurolens.readers.zemax_shapes import Block, thickness
from neurolens.readers.zemax_words import CONFIGURATION

MAX_CONFIGURATIONS = 200
READ = ("THIC", "APER", "SDIA", "LTTL")


@dataclass
class Zoom:
    """The configurations while they are read; operand values by configuration (from 0)."""

    begun: bool = False
    count: int = 1
    titles: dict[int, str] = field(default_factory=dict)
    thickness: dict[tuple[int, int], float] = field(default_factory=dict)  # (surface, configuration)
    aperture: dict[int, float] = field(default_factory=dict)
    semi_diameter: dict[tuple[int, int], tuple[float, Line]] = field(default_factory=dict)

    def begin(self, line: Line) -> None:
        """MNUM: how many configurations, and which is the one in the table."""
        self.count, self.begun = int(line.numbers("MNUM", line.words[1:2])[0]), True
        if not 1 <= self.count <= MAX_CONFIGURATIONS:
            raise line.error("MNUM", self.count, f"1 to {MAX_CONFIGURATIONS} configurations")

    def read(self, line: Line, n_blocks: int) -> None:
        """One operand: name, surface, configuration (from 1), value."""
        word, rest = line.words[0].upper(), line.words[1:]
        if word in CONFIGURATION or word == "BLNK":
            return
        if word not in READ:
            if self.count == 1:
                raise line.unknown(word, READ)
            expected = f"one of {', '.join(READ)}: other things that change with the configuration are not read"
            raise line.error(word, "(unknown operand)", expected)
        numbers = line.numbers(word, rest[:2], 2)
        surface, place = int(numbers[0]), int(numbers[1]) - 1
        if not 0 <= place < self.count or not 0 <= surface < n_blocks:
            raise line.error(word, " ".join(rest[:2]), f"a surface below {n_blocks}, a configuration to {self.count}")
        if word == "LTTL":
            quoted = re.search('"([^"]*)"', line.text)
            self.titles[place] = (quoted[1] if quoted else " ".join(rest[2:3])).strip() or f"configuration {place + 1}"
            return
        is_object = word == "THIC" and surface == 0
        value = thickness(line, word, rest[2:3], is_object=is_object)
        if word == "THIC":
            self.thickness[surface, place] = value
        elif value <= 0:
            raise line.error(word, value, "a number above 0")
        elif word == "APER":
            self.aperture[place] = value
        else:
            self.semi_diameter[surface, place] = (value, line)


def draft_states(zoom: Zoom, blocks: Sequence[Block], aperture_is_f_number: bool) -> Iterator[State]:
    """The configurations of a file, thickness solves carried out in each.

    Raises:
        InputError: a semi-diameter that changes anywhere but at the stop.
    """
    if zoom.count == 1:
        return
    for place in range(zoom.count):
        full = [zoom.thickness.get((k, place), b.thickness) for k, b in enumerate(blocks)]
        solved = {k for k, b in enumerate(blocks) if b.solve}
        film_given = True
        for k in sorted(solved):
            word, numbers, line = blocks[k].solve or ("", [], blocks[k].start)
            if word == "MAZH":
                if k != len(blocks) - 2:
                    raise line.error(word, f"(on surface {k})", "the last surface, in a file with configurations")
                film_given = False
                continue
            reference, total = int(numbers[0]), numbers[1]
            if not 0 < reference < k:
                raise line.error(word, reference, f"a surface in front of surface {k}")
            full[k] = total - (full[reference] if word == "TCOM" else sum(full[reference:k]))
        stop_diameter = None
        for (surface, there), (value, line) in zoom.semi_diameter.items():
            if not blocks[surface].stop:
                raise line.error("SDIA", f"(surface {surface})", "the stop: other rims cannot change")
            stop_diameter = 2 * value if there == place else stop_diameter
        changing = {k for k, _ in zoom.thickness} | solved
        size = zoom.aperture.get(place)
        if not all(map(math.isfinite, full[1:])):
            raise InputError(blocks[0].start.file, "THIC", "(infinite)", "finite thicknesses behind the object")
        yield State(
            name=zoom.titles.get(place, f"configuration {place + 1}"),
            thickness={k - 1: full[k] for k in sorted(changing) if 0 < k < len(blocks) - 1},
            pupil=None if aperture_is_f_number else size,
            f_number=size if aperture_is_f_number else None,
            stop_diameter=stop_diameter,
            object_distance=full[0],
            film_given=film_given,
        )
