"""Lens files of FlareSim (.lens), a simulator of flare for compositing programs.

`name: TEXT`, `focal_length: MM`, then `surfaces:` and one row a surface, from the scene to the film: radius (0 a plane,
"stop" the stop), thickness, index behind, Abbe number (0 unknown), semi-diameter of the rim, layers of coating, and
for surfaces that are not round the type: cyl_x (axis along x, bent in y), cyl_y, toric with the radius of a circle
along y, which is turned about a line along y at the radius of the first column. "#" begins a comment. The format has no
aspheres and no f-number; a collection of it states that in a comment ("f/4.1"), and its rims are diameters in the
column of radii.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from neurolens.lens.prescription import Lens, Surface
from neurolens.readers.draft import Draft, Given, Row, lens_of
from neurolens.readers.source import MAX_SURFACES, Line, assume, read_lines

_COLUMNS = ("radius", "thickness", "ior", "abbe", "semi_ap", "coating")
_BENT = {"cyl_x": "y", "cylinder_x": "y", "cyl_y": "x", "cylinder_y": "x"}
_ROUND = ("spherical", "sphere", "sph")
_STATED = re.compile(r"(\d+) surfaces,.*?(?:f/(\d+(?:\.\d+)?))?\s*$")


def read_flaresim(path: str | Path, given: Given | None = None) -> Lens:
    """The lens of a .lens file.

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
            rows.append(_surface(line, text.split()))
            if len(rows) > MAX_SURFACES:
                raise line.error("row", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
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
    return lens_of(draft, given)


def looks_like_flaresim(head: str) -> bool:
    """Whether the beginning of a text is that of a .lens file: its line "surfaces:"."""
    return any(row.partition("#")[0].strip() == "surfaces:" for row in head.splitlines())


def _surface(line: Line, words: list[str]) -> Surface:
    if len(words) < len(_COLUMNS):
        raise line.error("row", " ".join(words), f"{len(_COLUMNS)} figures: {', '.join(_COLUMNS)}")
    stop = words[0].lower() == "stop"
    thickness, index, abbe, semi = (line.number_of(n, w) for n, w in zip(_COLUMNS[1:5], words[1:5], strict=True))
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
