"""Tables of a row per surface: plain ones of renderers (pbrt's .dat, appleseed's), and FlareSim's .lens files.

One row per surface from the scene to the film: radius of curvature, thickness to the next surface, refractive index
behind, aperture (full diameter); mm. "#" begins a comment. appleseed puts the count of rows in front. The stop is the
row of index 0 (appleseed) or of radius 0 (pbrt, which has no other planes). Of a last thickness of 0 the film is put in
the paraxial focus. Kolb's tables of 1995 have the separation in front of each surface instead, and some have
semi-diameters: see `ReadOptions`.

FlareSim, a simulator of flare for compositing programs, writes `name: TEXT`, `focal_length: MM`, `surfaces:` and a row
a surface, from the scene to the film: radius (0 a plane, "stop" the stop), thickness, index behind, Abbe number (0
unknown), semi-diameter of the rim, layers of coating, and for surfaces that are not round the type: cyl_x (axis along
x, bent in y), cyl_y, toric with the radius of a circle along y, which is turned about a line along y at the radius of
the first column. The format has no aspheres and no f-number; a collection of it states that in a comment ("f/4.1"), and
its rims are diameters in the column of radii.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens, Surface
from neurolens.readers.draft import Draft, Row, lens_of
from neurolens.readers.source import Line, ReadOptions, assume, read_lines

COLUMNS = ("radius", "thickness", "index", "diameter")
FIGURES = ("radius", "thickness", "ior", "abbe", "semi_ap", "coating")
_BENT = {"cyl_x": "y", "cylinder_x": "y", "cyl_y": "x", "cylinder_y": "x"}
_ROUND = ("spherical", "sphere", "sph")
_STATED = re.compile(r"(\d+) surfaces,.*?(?:f/(\d+(?:\.\d+)?))?\s*$")


def read_table(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a table.

    Raises:
        InputError: a row without four numbers, a count that is not that of the rows, no stop or several.
    """
    options = options or ReadOptions()
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
    if not rows:
        raise InputError(file, "rows", "(none)", f"rows of {len(COLUMNS)} numbers: {', '.join(COLUMNS)}")
    if count is not None and count[1] != len(rows):
        raise count[0].error("count", count[1], f"{len(rows)}, the number of rows in the file")
    surfaces = _surfaces(file, rows, 2.0 if options.semi_diameters else 1.0)
    if options.gap_before:
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
    return lens_of(draft, options)


def looks_like_table(head: str) -> bool:
    """Test whether the beginning of a text is that of a table: numbers in the first line that is not a comment."""
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


def read_flaresim(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a .lens file.

    Raises:
        InputError: a type that is not of the format, a row without its six figures, no rows.
    """
    file = str(path)
    draft, rows = Draft(file, "FlareSim", unit="mm", drawn=True, rims="estimated"), list[Surface]()
    listed, stated = False, None
    for line in read_lines(path):
        text, _, comment = line.text.partition("#")
        key, colon, value = (part.strip() for part in text.partition(":"))
        if not text.strip():
            draft.notes.append(comment.strip())
            found = _STATED.search(comment)
            if found and not listed:
                stated, draft.nominal = int(found[1]), float(found[2]) if found[2] else None
        elif listed:
            rows.append(_flaresim_surface(line, text.split()))
        elif colon and key == "surfaces":
            listed = True
        elif colon and key == "name":
            draft.name = value
        elif colon and key == "focal_length":
            focal = line.numbers(key, value.split())[0]
            draft.stated_efl = focal if focal > 0 else None
        else:
            draft.skipped[key] += 1
    if stated is not None and stated != len(rows):
        assume(file, f"a comment speaks of {stated} surfaces, the table has {len(rows)}")
    draft.notes = [note for note in draft.notes if any(map(str.isalpha, note)) and "ior" not in note]
    draft.rows = tuple(Row(s, aperture=not s.stop) for s in rows)
    draft.film_given = bool(rows) and rows[-1].thickness_mm != 0
    return lens_of(draft, options)


def looks_like_flaresim(head: str) -> bool:
    """Test whether the beginning of a text is that of a .lens file: its line "surfaces:"."""
    return any(row.partition("#")[0].strip() == "surfaces:" for row in head.splitlines())


def _flaresim_surface(line: Line, words: list[str]) -> Surface:
    if len(words) < len(FIGURES):
        raise line.error("row", " ".join(words), f"{len(FIGURES)} figures: {', '.join(FIGURES)}")
    stop = words[0].lower() == "stop"
    thickness, index, abbe, semi = (line.number_of(n, w) for n, w in zip(FIGURES[1:5], words[1:5], strict=True))
    radius = math.inf if stop else line.number_of("radius", words[0]) or math.inf
    kind: str | None = words[6].lower() if len(words) > 6 else None
    shape: dict[str, Any] = {}
    if kind == "toric" and not math.isinf(radius):
        along_y = line.number_of("type", words[7]) if len(words) > 7 else 0.0
        if along_y == 0:
            raise line.error("type", " ".join(words[6:]), "toric with a radius other than 0")
        shape = {} if along_y == radius else {"cylinder": "y", "across": (radius, None)}
        radius = along_y
    elif kind in _BENT:
        shape["cylinder"] = None if math.isinf(radius) else _BENT[kind]
    elif kind not in (None, "toric", *_ROUND):
        raise line.error("type", words[6], f"one of {', '.join((*_ROUND, *_BENT, 'toric'))}")
    glass = index != 1
    return Surface(
        radius_mm=radius,
        thickness_mm=thickness,
        diameter_mm=2 * semi if semi > 0 else math.nan,
        n_d=index,
        V_d=abbe if glass and abbe > 0 else None,
        stop=stop,
        **shape,
    )
