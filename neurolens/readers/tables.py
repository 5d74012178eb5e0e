"""Plain tables of four columns used by renderers: pbrt's .dat and appleseed's lens files.

One row per surface from the scene to the film: radius of curvature, thickness to the next surface, refractive index
behind, aperture (full diameter); mm. "#" begins a comment. appleseed puts the count of rows in front. The stop is the
row of index 0 (appleseed) or of radius 0 (pbrt, which has no other planes). Of a last thickness of 0 the film is put in
the paraxial focus. Kolb's tables of 1995 have the separation in front of each surface instead, and some have
semi-diameters: see `Given`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens, Surface
from neurolens.readers.draft import Draft, Given, Row, lens_of
from neurolens.readers.source import MAX_SURFACES, Line, read_lines

COLUMNS = ("radius", "thickness", "index", "diameter")


def read_table(path: str | Path, given: Given | None = None) -> Lens:
    """The lens of a table.

    Raises:
        InputError: a row without four numbers, a count that is not that of the rows, no stop or several.
    """
    given = given or Given()
    file, lines = str(path), read_lines(path)
    comments = [line.text.strip().lstrip("#").strip() for line in lines if line.text.lstrip().startswith("#")]
    rows: list[tuple[Line, list[float]]] = []
    count: tuple[Line, int] | None = None
    for line in lines:
        words = line.text.partition("#")[0].split()
        if not words:
            continue
        if len(words) == 1 and words[0].isdecimal() and not rows and count is None:
            count = (line, int(words[0]))
            continue
        if len(words) != len(COLUMNS):
            raise line.error("row", " ".join(words), f"{len(COLUMNS)} numbers: {', '.join(COLUMNS)}")
        rows.append((line, [line.number_of(name, word) for name, word in zip(COLUMNS, words, strict=True)]))
        if len(rows) > MAX_SURFACES:
            raise line.error("row", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    if not rows:
        raise InputError(file, "rows", "(none)", f"rows of {len(COLUMNS)} numbers: {', '.join(COLUMNS)}")
    if count is not None and count[1] != len(rows):
        raise count[0].error("count", count[1], f"{len(rows)}, the number of rows in the file")
    surfaces = _surfaces(file, rows, 2.0 if given.semi_diameters else 1.0)
    if given.gap_before:
        gaps = [s.thickness_mm for s in surfaces[1:]] + [0.0]
        surfaces = [replace(s, thickness_mm=gap) for s, gap in zip(surfaces, gaps, strict=True)]
    draft = Draft(
        file=file,
        kind="lens table",
        rows=tuple(Row(s, aperture=True) for s in surfaces),
        name=next((c for c in comments if any(map(str.isalpha, c))), ""),
        notes=comments,
        film_given=surfaces[-1].thickness_mm != 0,
    )
    return lens_of(draft, given)


def looks_like_table(head: str) -> bool:
    """Whether the beginning of a text is that of a table: numbers in the first line that is not a comment."""
    for row in head.splitlines():
        words = row.partition("#")[0].split()
        if words:
            try:
                return len(words) in (1, len(COLUMNS)) and all(math.isfinite(float(w)) for w in words)
            except ValueError:
                return False
    return False


def _surfaces(file: str, rows: Sequence[tuple[Line, list[float]]], factor: float) -> list[Surface]:
    flat = [k for k, (_, numbers) in enumerate(rows) if numbers[0] == 0]
    stops = [k for k, (_, numbers) in enumerate(rows) if numbers[2] == 0] or flat
    if len(stops) > 1:
        found = f"(rows at line {', '.join(str(rows[k][0].number) for k in stops)})"
        raise InputError(file, "stop", found, "exactly one row of index 0, or else of radius 0: the aperture stop")
    surfaces: list[Surface] = []
    for k, (line, (radius, thickness, index, diameter)) in enumerate(rows):
        # The stop does not change the medium: pbrt and appleseed have it in air.
        n_d = 1.0 if k in stops and index == 0 else index
        if n_d < 1:
            raise line.error("index", index, "a refractive index of at least 1 (0 marks the stop)")
        if diameter <= 0:
            raise line.error("diameter", diameter, "a length above 0")
        surfaces.append(Surface(radius or math.inf, thickness, factor * diameter, n_d=n_d, stop=k in stops))
    return surfaces
