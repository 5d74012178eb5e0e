"""Zoom positions of CODE V: thicknesses and what sizes the stop; all else that zooms is an error by name and line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from neurolens.readers.codev_shapes import Block
from neurolens.readers.codev_text import Command
from neurolens.readers.draft import State

MAX_POSITIONS = 200
READ = ("THI", "EPD", "FNO", "CIR", "TIT")
# Control codes, fields, vignetting factors, weights, wavelengths.
IGNORED = frozenset("""THC CCY GLC KC VUX VLX VUY VLY XAN YAN XIM YIM XRI YRI XOB YOB WTF WTW WTA WL REF DER""".split())


@dataclass
class Zoom:
    """The positions while they are read; values by position (from 0)."""

    count: int = 0
    titles: dict[int, str] = field(default_factory=dict)
    thickness: dict[int, list[float]] = field(default_factory=dict)
    pupil: list[float] = field(default_factory=list)
    f_number: list[float] = field(default_factory=list)
    semi_diameter: dict[int, tuple[list[float], Command]] = field(default_factory=dict)
    waiting: dict[tuple[int, int], float] = field(default_factory=dict)

    def read(self, command: Command, n_blocks: int) -> None:
        """One ZOO command: the count of positions, or a quantity with one value a position."""
        words, line = command.words, command.line
        if words and words[0].isdecimal():
            self.count = int(words[0])
            if not 1 <= self.count <= MAX_POSITIONS:
                raise line.error("ZOO", words[0], f"1 to {MAX_POSITIONS} positions")
            return
        name = words[0].upper()[:3] if words else ""
        if name in IGNORED or (name == "TIT" and self.count):
            return
        if name not in READ or not self.count:
            expected = f"the count of positions first, then one of {', '.join(READ)}: other zooms are not read"
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
                self.thickness[surface] = numbers
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
        self.waiting[int(surface), int(place) - 1] = command.numbers(command.words[2:])[0]

    def states(self, middle: Sequence[Block], object_distance: float, defocus: float) -> Iterator[State]:
        """The positions of a file, by rows of the draft (surface numbers less one)."""
        for surface, (_, command) in self.semi_diameter.items():
            if not (0 < surface <= len(middle) and middle[surface - 1].stop):
                raise command.line.error("ZOO CIR", f"S{surface}", "the stop: other rims cannot change")
        for place in range(self.count if self.count > 1 else 0):
            gaps = {k: values[place] for k, values in self.thickness.items()}
            gaps.update({k: value for (k, there), value in self.waiting.items() if there == place})
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
                object_distance=math.inf if distance >= 1e9 else distance,
                film_given=not middle[-1].solved or last in gaps,
            )
