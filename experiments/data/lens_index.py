"""The library's index: of each lens its row of `neurolens lens list`, with its character, which take 2 CPU s a lens,
and its section as a small picture.

Lenses whose figures have not changed keep their rows (notes may change) and pictures, unless --restart is given, as
after changes of the code. Writes lenses/index.jsonl, a line a lens, and lenses/thumbnails/NAME.svg.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from experiments import lab
from experiments.data.library_pages import section_of
from neurolens.base.files import atomic_write_text, library, sha256_of
from neurolens.base.find import INDEX, read_index
from neurolens.base.tomlfile import read_toml
from neurolens.optics.analysis.layout import thumbnail
from neurolens.optics.readers.any_format import lens_files
from neurolens.studies.describe import library_row, read_quietly

OPTIONS = (lab.count("workers", 1, "processes of a thread each (default: 1)"), lab.AGAIN, lab.QUIET)


def rounded(value: Any) -> Any:
    """Numbers with six digits, which every machine agrees on."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) and math.isfinite(value) else value


def figures_of(file: Path) -> str:
    """Hash of what a row is computed from: a lens file without its notes."""
    data = {key: value for key, value in read_toml(file).items() if key != "notes"}
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def row_of(file: Path) -> dict[str, Any]:
    """The row of a lens, with all its figures; its section is drawn beside."""
    picture = file.parent / "thumbnails" / f"{file.stem}.svg"
    picture.parent.mkdir(exist_ok=True)
    atomic_write_text(picture, thumbnail(section_of(read_quietly(file))))
    row = rounded(library_row(file, characters=True))
    return {key: value for key, value in row.items() if key not in ("lens", "file")}


def run(args: argparse.Namespace) -> None:
    """Write the index."""
    folder, files = library() / "lenses", lens_files(library() / "lenses")
    kept = {} if args.restart else read_index()
    lines: list[dict[str, Any]]
    lines = [{"file": f.name, "sha256": sha256_of(f), "figures": figures_of(f)} for f in files]
    same = [line["figures"] == kept.get(line["file"], {}).get("figures") for line in lines]
    with ProcessPoolExecutor(args.workers, mp_context=get_context("fork")) as pool:
        rows = pool.map(row_of, [file for file, known in zip(files, same, strict=True) if not known])
        for line, known in lab.counted(list(zip(lines, same, strict=True)), "lenses", args.quiet):
            line["row"] = kept[line["file"]]["row"] if known else next(rows)
    atomic_write_text(folder / INDEX, "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines))
    print(f"{folder / INDEX}: {len(lines)} lenses, {(folder / INDEX).stat().st_size / 1e3:.0f} kB")
