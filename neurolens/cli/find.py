"""`neurolens find WORDS`: lenses of the library by what photographers call them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from neurolens.base.errors import one_line
from neurolens.base.files import library
from neurolens.base.find import Entry, Found, find
from neurolens.base.settings import setting
from neurolens.cli import arguments as cli

_SHOWN = 10
_CHECKED = {"certain": "photographs", "likely": "photographs, a likely match"}


@dataclass(frozen=True, kw_only=True)
class Find(cli.Reporting):
    """Find lenses of the library by words: product, maker, focal length, f-number, mount, year or decade, nickname,
    and what a lens is known for (swirl, bubbles, soft, flare, cat's eye: the strongest first). Accents and
    capitals do not matter. Where no lens has all words, the three nearest are shown. --json adds each lens's file, its
    drawing and its figures.

    Every command takes such words where it takes a lens, if one lens is meant by them."""

    epilog = """\
examples:
  neurolens find nikkor 50 1.2
  neurolens find helios 44
  neurolens find summilux 1950s
  neurolens find 85mm swirl
  neurolens lens "nikkor z 58" """

    words: tuple[str, ...] = setting(
        ..., "as on the lens, or as photographers say", positional=True, metavar="WORD", nargs="+"
    )

    def run(self) -> int:
        """Print the lenses; return 1 where none has all words."""
        found = find(" ".join(self.words))
        rows = [_row(entry) for entry in found.hits or found.near]
        data = {"found": len(found.hits), "chosen": found.chosen and found.chosen.lens, "notes": list(found.notes)}
        return self.answer(data | {"lenses": rows}, lambda: _text(found, rows), 0 if found.hits else 1)


def _row(entry: Entry) -> dict[str, Any]:
    """Return what is told of a lens: its name in lenses/, its files, and figures of the index."""
    keys = ("maker", "year", "efl_mm", "f_number", "t_stop", "mount", "match", "verdict", "character")
    folder = library() / "lenses"
    picture = folder / "thumbnails" / f"{entry.lens}.svg"
    files = {"file": str(folder / f"{entry.lens}.toml"), "thumbnail": str(picture) if picture.is_file() else None}
    return {"lens": entry.lens, "name": entry.name, **{key: entry.row.get(key) for key in keys}, **files}


def _text(found: Found, rows: Sequence[Mapping[str, Any]]) -> str:
    header = ("lens", "name", "light", "year", "checked by")
    text = cli.table(header, [_cells(row) for row in rows[:_SHOWN]], left=len(header))
    if not found.hits:
        text = f"no lens has all these words; the nearest:\n{text}\nother commands scale any lens: --focal-length MM"
        text = text if rows else "no lens has words like these"
    elif len(rows) > _SHOWN:
        text += f"\n{len(rows) - _SHOWN} more: further words leave fewer, --json shows all"
    if found.chosen and len(rows) > 1:
        text += f"\nother commands take {found.chosen.lens} by these words"
    return "\n".join([*found.notes, text])


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    light = f"T{row['t_stop']:.3g}" if row["t_stop"] else f"f/{row['f_number']:.3g}" if row["f_number"] else "-"
    checked = _CHECKED.get(row["match"], "no photographs") + ", doubtful" * (row["verdict"] == "doubtful")
    return row["lens"], one_line(row["name"], 50), light, str(row["year"] or "-"), checked
