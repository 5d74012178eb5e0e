"""`neurolens lens list`: the lenses of a folder as a table, every one checked, and as a sheet of sections."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.commands.output import number, print_json, table

WORD = "list"
HEADER = ("lens", "name", "EFL mm", "f/", "half field", "refr.", "asph.", "cyl.", "states", "rims", "verdict")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what goes with the word "list"."""
    parser.add_argument(
        "--layouts", metavar="OUT.png", type=Path, help='after "list": draw all lenses in section on one sheet'
    )


def run(args: argparse.Namespace) -> int:
    """Print the table; draw the sheet where asked."""
    from neurolens.evaluate.library import lens_files, library, sections

    if args.layouts is not None and not args.layouts.parent.is_dir():
        raise InputError(args.layouts, "--layouts", str(args.layouts.parent), "a folder that exists")
    files = lens_files(_folder(args.folder))
    rows = library(files)
    if args.layouts is not None:
        from neurolens.evaluate.plots.library import sheet

        sheet(sections([Path(r["file"]) for r in rows if "name" in r]), args.layouts)
    if args.json:
        print_json({"lenses": rows, "layouts": None if args.layouts is None else str(args.layouts)})
    else:
        print(_text(rows))
        if args.layouts is not None:
            print(f"\nSections drawn in {args.layouts}")
    return 0


def _folder(given: Path | None) -> Path:
    """The folder asked for, else that of the lenses that ship."""
    if given is not None:
        return given
    from neurolens.evaluate.project import project_root

    return project_root() / "lenses"


def _text(rows: list[dict[str, Any]]) -> str:
    """The table, and below it every doubt."""
    text = table(HEADER, [_cells(row) for row in rows], left=2)
    doubtful = [row for row in rows if row["doubts"]]
    found = f"\n\n{len(rows)} lenses, {len(doubtful)} of them doubtful"
    lines = [f"  {row['lens']}: {doubt}" for row in doubtful for doubt in row["doubts"]]
    return text + found + (":\n" + "\n".join(lines) if lines else "")


def _cells(row: dict[str, Any]) -> list[str]:
    if "name" not in row:
        return [row["lens"], *["-"] * 9, row["verdict"]]
    efl = number(row["efl_mm"]) + ("" if row["efl_x_mm"] is None else f" / {number(row['efl_x_mm'], 3)}")
    field = "-" if row["half_field_deg"] is None else f"{row['half_field_deg']:.4g}°"
    counts = [str(row[key] or "-") for key in ("refractions", "aspheres", "cylinders", "states")]
    return [row["lens"], row["name"], efl, number(row["f_number"], 3), field, *counts, row["rims"], row["verdict"]]
