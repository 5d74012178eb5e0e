"""`neurolens find WORDS`: lenses of the library by what photographers call them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from neurolens.base.errors import one_line
from neurolens.base.files import library
from neurolens.base.find import Entry, find
from neurolens.base.report import Report
from neurolens.base.settings import setting
from neurolens.cli import arguments as cli

_SHOWN = 10
_CHECKED = {"certain": "photographs", "likely": "photographs, a likely match"}


@dataclass(frozen=True, kw_only=True)
class Find(cli.Reporting):
    """Find lenses of the library by words: product, maker, focal length, f-number, mount, year or decade, nickname,
    kind, and what a lens is known for. Kinds are zoom, prime, macro, fisheye, tilt, shift and anamorphic; lenses are
    known for swirl, bubbles, soft, flare and cat's eye, and the strongest come first. Accents and capitals do not
    matter. Where no lens has all words, the three nearest are shown. --json adds each lens's file, its drawing and its
    figures.

    Every command takes such words where it takes a lens, if one lens is meant by them."""

    epilog = """\
examples:
  neurolens find nikkor 50 1.2
  neurolens find helios 44
  neurolens find summilux 1950s
  neurolens find 85mm swirl
  neurolens find tilt 24mm
  neurolens lens "nikkor z 58" """

    words: tuple[str, ...] = setting(
        ..., "as on the lens, or as photographers say", positional=True, metavar="WORD", nargs="+"
    )

    def run(self) -> int:
        """Print the lenses; return 1 where none has all words."""
        found = find(" ".join(self.words))
        lenses = [FoundLens.of(entry) for entry in found.hits or found.near]
        chosen = found.chosen.lens if found.chosen else None
        return self.answer(FoundLenses(len(found.hits), chosen, found.notes, lenses), 0 if found.hits else 1)


@dataclass(frozen=True)
class FoundLens:
    """A lens of the library: its name in lenses/, figures of the library's index, and its files."""

    lens: str
    name: str
    maker: str | None
    year: int | None
    efl_mm: float | None
    f_number: float | None
    t_stop: float | None
    mount: str | None
    match: str | None
    verdict: str | None
    character: Any
    file: Path
    thumbnail: Path | None

    @staticmethod
    def of(entry: Entry) -> FoundLens:
        """Return the lens of an entry of the index."""
        figures: Any = {f.name: entry.row.get(f.name) for f in fields(FoundLens)[2:-2]}
        folder = library() / "lenses"
        picture = folder / "thumbnails" / f"{entry.lens}.svg"
        shown = picture if picture.is_file() else None
        return FoundLens(entry.lens, entry.name, **figures, file=folder / f"{entry.lens}.toml", thumbnail=shown)

    def cells(self) -> tuple[str, ...]:
        """Return the row of a table."""
        light = f"T{self.t_stop:.3g}" if self.t_stop else f"f/{self.f_number:.3g}" if self.f_number else "-"
        checked = _CHECKED.get(self.match or "", "no photographs") + ", doubtful" * (self.verdict == "doubtful")
        return self.lens, one_line(self.name, 50), light, str(self.year or "-"), checked


@dataclass(frozen=True)
class FoundLenses(Report):
    """The lenses that a query finds.

    Attributes:
        found: how many have all words of the query; where none has, `lenses` are the nearest.
        chosen: the lens that other commands take by these words.
        notes: sentences about nicknames in the query.
    """

    found: int
    chosen: str | None
    notes: Sequence[str]
    lenses: Sequence[FoundLens]

    def text(self) -> str:
        """Return a table of the best lenses, and what to do next."""
        header = ("lens", "name", "light", "year", "checked by")
        text = cli.table(header, [lens.cells() for lens in self.lenses[:_SHOWN]], left=len(header))
        if not self.found:
            text = (
                f"no lens has all these words; the nearest:\n{text}\nother commands scale any lens: --focal-length MM"
            )
            text = text if self.lenses else "no lens has words like these"
        elif len(self.lenses) > _SHOWN:
            text += f"\n{len(self.lenses) - _SHOWN} more: further words leave fewer, --json shows all"
        if self.chosen and len(self.lenses) > 1:
            text += f"\nother commands take {self.chosen} by these words"
        return "\n".join([*self.notes, text])
