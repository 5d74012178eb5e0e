"""Many lenses as a table: rows that the library's index keeps, or that are made from their files; sorted, printed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neurolens.base.errors import one_line
from neurolens.base.files import library, sha256_of
from neurolens.base.progress import Progress
from neurolens.cli.output import number, table

INDEX = "index.jsonl"  # in lenses/: a line a lens, {file, sha256, row}, by `python -m experiments lens-index`
CHARACTER = {  # keys of --sort: the figure of `study.character`, and its heading; strongest first
    "cats-eye": ("cats_eye", "cat's eye"), "swirl": ("swirl", "swirl"), "bubbles": ("bubble", "bubbles"),
    "softness": ("softness_um", "soft um"), "flare": ("flare", "flare"),
}  # fmt: skip
SORTS = {"maker": "maker", "focal-length": "efl_mm", "speed": "f_number", "year": "year"}
_OF_RIMS = ("cats_eye", "swirl")
_BEGIN, _END = ("lens", "name", "maker", "year", "EFL mm", "f/"), ("rims", "verdict")
_DATA = ("half field", "film mm", "refr.", "states")


def read_index() -> dict[str, dict[str, Any]]:
    """The entries of the library's index by file; none without an index."""
    file = library() / "lenses" / INDEX
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else ()
    return {entry["file"]: entry for entry in map(json.loads, lines)}


def kept_row(file: Path, index: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """The row of a lens of the library as its index keeps it; None of another lens, or where the file has changed."""
    entry = index.get(file.name)
    if entry is None or file.resolve().parent != (library() / "lenses").resolve() or entry["sha256"] != sha256_of(file):
        return None
    return {"lens": file.stem, "file": str(file), **entry["row"]}


def list_rows(
    files: Sequence[Path], *, checked: bool, sort: str | None, kept: bool, quiet: bool
) -> list[dict[str, Any]]:
    """`study.describe.library_row` of each lens, in the order of `sort`; with `kept` the index's where it has one."""
    index = read_index() if checked and kept else {}
    rows = {file: row for file in files if (row := kept_row(file, index))}
    left = [file for file in files if file not in rows]
    if left:
        from neurolens.study.describe import library_row

        with Progress(quiet=quiet).stage(f"{len(left)} lenses") as report:
            for done, file in enumerate(left, start=1):
                rows[file] = library_row(file, checked, sort in CHARACTER)
                report(done / len(left))
    found = [rows[file] for file in files]
    return found if sort is None else sorted(found, key=lambda row: _place(row, sort))


def _place(row: dict[str, Any], sort: str) -> tuple[Any, ...]:
    """Where a row stands: those without the value last."""
    figure = CHARACTER[sort][0] if sort in CHARACTER else SORTS[sort]
    value = ((row.get("character") or {}) if sort in CHARACTER else row).get(figure)
    if value in (None, ""):
        return (True, 0.0, row["lens"])
    strongest_first = -1 if sort in CHARACTER and sort != "cats-eye" else 1
    return (False, value.casefold() if isinstance(value, str) else strongest_first * value, row.get("efl_mm", 0.0))


def list_text(rows: list[dict[str, Any]], sort: str | None) -> str:
    """The table; sorted by a character it shows these in place of other data."""
    middle = [heading for _, heading in CHARACTER.values()] if sort in CHARACTER else _DATA
    header = (*_BEGIN, *middle, *_END)
    text = table(header, [_cells(row, sort in CHARACTER, len(header)) for row in rows], left=3)
    doubtful = [row for row in rows if row["doubts"]]
    guess = "\n\n~ follows rims that the source does not state" if sort in CHARACTER and "~" in text else ""
    found = f"{guess}\n\n{len(rows)} lenses, {len(doubtful)} of them doubtful or unreadable"
    lines = [f"  {row['lens']}: {doubt}" for row in doubtful for doubt in row["doubts"]]
    return text + found + (":\n" + "\n".join(lines) if lines else "")


def _cells(row: dict[str, Any], character: bool, count: int) -> list[str]:
    if "name" not in row:
        return [row["lens"], *["-"] * (count - 2), row["verdict"]]
    efl = number(row["efl_mm"]) + ("" if row["efl_x_mm"] is None else f" / {number(row['efl_x_mm'], 3)}")
    begin = [row["lens"], one_line(row["believed_to_be"] or row["name"], 40), one_line(row["maker"] or "-", 16)]
    begin += [str(row["year"] or "-"), efl, number(row["f_number"], 3)]
    field = "-" if row["half_field_deg"] is None else f"{row['half_field_deg']:.4g}°"
    middle = [field, number(row["image_radius_mm"]), *(str(row[key] or "-") for key in ("refractions", "states"))]
    if character:
        figures, guessed = row.get("character") or {}, row["rims"] in ("derived", "estimated")
        middle = [
            ("~" if guessed and key in _OF_RIMS and figures.get(key) is not None else "") + number(figures.get(key), 3)
            for key, _ in CHARACTER.values()
        ]
    return [*begin, *middle, row["rims"], row["verdict"]]
