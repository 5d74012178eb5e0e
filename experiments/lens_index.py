"""The library's index: of each lens its row of `neurolens lens list`, with its character, which take 2 CPU s a lens,
and its section as a small picture.

Lenses whose files have not changed keep their rows and pictures, unless --restart is given, as after changes of the
code. Writes lenses/index.jsonl, a line a lens, and lenses/thumbnails/NAME.svg.
"""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

from experiments import lab
from experiments.library_pages import section_of
from neurolens.base.files import atomic_write_text, library, sha256_of
from neurolens.base.find import INDEX, read_index
from neurolens.cli.lens import kept_row
from neurolens.optics.analysis.layout import thumbnail
from neurolens.optics.readers.any_format import lens_files
from neurolens.studies.describe import library_row, read_quietly

OPTIONS = (lab.AGAIN, lab.QUIET)


def rounded(value: Any) -> Any:
    """Numbers with six digits, which every machine agrees on."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) and math.isfinite(value) else value


def run(args: argparse.Namespace) -> None:
    """Write the index."""
    folder, kept = library() / "lenses", {} if args.restart else read_index()
    lines = []
    for file in lab.counted(lens_files(folder), "lenses", args.quiet):
        picture, row = folder / "thumbnails" / f"{file.stem}.svg", kept_row(file, kept)
        if row is None or not picture.is_file():
            picture.parent.mkdir(exist_ok=True)
            atomic_write_text(picture, thumbnail(section_of(read_quietly(file))))
        row = row or rounded(library_row(file, characters=True))
        row = {key: value for key, value in row.items() if key not in ("lens", "file")}
        lines.append(json.dumps({"file": file.name, "sha256": sha256_of(file), "row": row}, ensure_ascii=False))
    atomic_write_text(folder / INDEX, "\n".join(lines) + "\n")
    print(f"{folder / INDEX}: {len(lines)} lenses, {(folder / INDEX).stat().st_size / 1e3:.0f} kB")
