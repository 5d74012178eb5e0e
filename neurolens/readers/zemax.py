"""Zemax OpticStudio lens files (.zmx): sequential systems, UTF-16 or plain text.

Settings of the system, then one block "SURF n" a surface, the object first and the image last, then merit function,
tolerances and configurations. Curvatures, semi-diameters, thickness to the next surface.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.lens import catalogue
from neurolens.lens.prescription import Lens
from neurolens.readers.draft import Draft, Row, lens_of, primary_first
from neurolens.readers.glasses import named_glass
from neurolens.readers.source import Line, ReadOptions, assume, read_lines, warn
from neurolens.readers.zemax_model import (
    HARMLESS,
    Q_TYPE,
    REFUSED,
    TYPES,
    VIGNETTING,
    Block,
    Zoom,
    draft_states,
    shape_of,
    thickness,
)


@dataclass
class File(Draft):
    """A file while it is read."""

    kind: str = "Zemax"
    blocks: list[Block] = field(default_factory=list)
    zoom: Zoom = field(default_factory=Zoom)
    makers: list[str] = field(default_factory=list)
    without_film: bool = False
    working: Line | None = None  # where the f-number is the working one
    field_type: int = 0
    fields: int = 0
    heights: dict[str, list[float]] = field(default_factory=dict)
    waves_um: dict[int, float] = field(default_factory=dict)
    waves: int = 0  # how many wavelengths are used, where the file says so
    primary: int = 1
    behind: Counter[str] = field(default_factory=Counter)  # what follows a surface without indentation


def _complete(file: File) -> None:
    """Set what follows from all surfaces.

    Raises:
        InputError: a file that was cut off, a shape that the lens model cannot hold, the working f-number of a near
            object.
    """
    file.skipped["lines of the merit function"] += file.behind.total()
    *_, image = file.blocks
    for before, block in zip(file.blocks, file.blocks[1:], strict=False):
        block.semi_diameter = block.semi_diameter if block.clear is None else block.clear
        if block.kind == "COORDBRK" and block.glass is None:
            block.medium = before.medium  # it stands in the medium of the surface before it
    file.rows = tuple(Row(b.surface(shape_of(b)), b.aperture, b.name) for b in file.blocks[1:-1])
    for block in file.blocks:
        if math.isnan(block.thickness):
            raise block.start.error("DISZ", "(missing)", "the thickness behind every surface (is the file cut off?)")
    if image.thickness or image.medium or image.stop:
        raise image.start.error("SURF", "(the last in the file)", "an image surface (is the file cut off?)")
    if image.curvature:
        warn(file.file, "the image surface is curved; the film is taken as plane")
    if file.f_number is not None and file.working and math.isfinite(file.blocks[0].thickness):
        raise file.working.error("FNUM", "(the working f-number of a near object)", "ENPD, FLOA, or FNUM with flag 0")
    last = file.blocks[-2]
    file.notes = ["\n".join(file.notes).strip()]
    file.states = tuple(draft_states(file.zoom, file.blocks, file.f_number is not None))
    file.object_distance, file.object_medium = file.blocks[0].thickness, file.blocks[0].medium
    used = dict.fromkeys(um for n, um in sorted(file.waves_um.items()) if n <= (file.waves or n))
    file.wavelengths_nm = primary_first([1000 * um for um in used], 1000 * file.waves_um.get(file.primary, 0.0))
    file.film_given = not (file.without_film or (last.solve and last.solve[0] == "MAZH" and last.thickness == 0))
    file.rims = "estimated" if any(b.automatic and not b.stop for b in file.blocks[1:-1]) else "source"
    _set_field(file)


def _add_ends(file: File) -> None:
    """Add the object and the image to a file that lists the surfaces of a lens only."""
    first, last = file.blocks[0], file.blocks[-1]
    begins_in_glass = bool(first.name and first.medium and math.isfinite(first.thickness))
    # Such a list ends with a surface of the lens; any other file that ends behind glass has been cut off.
    ends_in_glass = begins_in_glass and bool(file.blocks[-2].medium)
    lists_lens = begins_in_glass and (first.curvature or last.thickness > 0 or ends_in_glass)
    if file.zoom.count > 1 and (lists_lens or not all(b.name.isdecimal() for b in file.blocks)):
        raise first.start.error("SURF", first.name, "object, surfaces numbered in order, and image, for configurations")
    if lists_lens:
        assume(file.file, f"surface {first.name} is one of glass: the object is assumed in front of it, at infinity")
        file.blocks.insert(0, Block(first.start, thickness=math.inf))
    elif not first.name:
        first.thickness = math.inf
        assume(file.file, "there is no SURF 0: the object is assumed at infinity, in air")
    elif first.curvature and math.isfinite(first.thickness):
        warn(file.file, "the object surface is curved; the object is taken as plane")
    file.without_film = ends_in_glass and last.thickness == 0
    if ends_in_glass or (last.thickness > 0 and not file.blocks[0].name):
        place = "at the paraxial focus" if file.without_film else "where its thickness ends"
        assume(file.file, f"the last surface is no image: the film is assumed {place}")
        file.blocks.append(Block(last.start, thickness=0.0))


def _set_field(file: File) -> None:
    """Half field or image radius: the field point farthest from the axis. FTYP 0 angle, 2 and 3 image height."""
    points = [(x, y) for x, y in zip(*(file.heights.get(k, [0.0] * 100) for k in ("XFLN", "YFLN")), strict=False)]
    edge = max((math.hypot(x, y) for x, y in points[: file.fields or None]), default=0.0)
    if edge > 0 and file.field_type == 0:
        file.half_field_deg = edge
    elif edge > 0 and file.field_type in (2, 3):
        file.image_radius = edge
    elif edge > 0:
        warn(file.file, f"the field is given as type {file.field_type} (not an angle, not an image height): left out")


UNITS = {"MM": "mm", "CM": "cm", "IN": "in", "INCH": "in", "METER": "m", "METERS": "m", "M": "m"}
SYSTEM = (
    *("MODE", "NAME", "NOTE", "UNIT", "ENPD", "FNUM", "FLOA", "OBNA", "ENVD", "GCAT", "FTYP", "XFLN", "YFLN", "TOL"),
    *("WAVM", "WAVL", "WAVN", "PWAV", "MNUM"),
)
SURFACE = (
    *("SURF", "TYPE", "CURV", "CONI", "DISZ", "GLAS", "DIAM", "PARM", "XDAT", "STOP", "COMM", "MAZH", "TCOM", "TOLE"),
    *("CLAP", "FLAP", "SQAP", "ELAP", "USAP", "OBDC", "IGNR"),
)


def read_zmx(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a Zemax file.

    Raises:
        InputError: see the module; also tilts, mirrors, obscurations and everything else that the lens model
            cannot hold, by name and line.
    """
    file = File(str(path))
    for line in read_lines(path):
        _read(file, line)
    if len(file.blocks) > 1:
        _add_ends(file)
    if len(file.blocks) < 3:
        raise InputError(file.file, "SURF", f"({len(file.blocks)} surfaces)", "object, at least one surface, and image")
    _complete(file)
    return lens_of(file, options)


def looks_like_zmx(head: str) -> bool:
    """Test whether the beginning of a text is that of a Zemax file."""
    first = [line.split()[0] for line in head.splitlines() if line.split()]
    return bool({"SURF", "VERS", "MODE", "UNIT"} & set(first)) and ("SURF" in first or "MODE" in first)


def _read(file: File, line: Line) -> None:
    word, rest = line.words[0].upper(), line.words[1:]
    if word.startswith("!"):
        return
    if file.zoom.begun:
        file.zoom.read(line, len(file.blocks))
    elif word == "SURF":
        _begin(file, line, rest)
    elif word in SYSTEM:
        _system(file, line, word, rest)
    elif file.blocks and word in SURFACE:
        _surface(file, file.blocks[-1], line, word, rest)
    elif file.blocks and word in REFUSED:
        if any(word not in ("0", "0.0") for word in rest) or not rest:
            raise line.error(word, " ".join(rest) or "(here)", REFUSED[word])
    elif word == "COAT" and file.blocks:
        file.skipped["coatings that are named but not given"] += 1
    elif word in VIGNETTING:
        file.skipped["vignetting factors (rims decide)"] += any(line.numbers(word, rest, 0))
    elif not file.blocks or line.text[:1].isspace():
        file.skipped[word] += word not in HARMLESS
    else:
        file.behind[word] += 1


def _begin(file: File, line: Line, rest: list[str]) -> None:
    file.skipped += file.behind  # no merit function yet
    file.behind.clear()
    if not file.blocks and rest[:1] == ["1"]:
        file.blocks.append(Block(line))
    last = next((b.name for b in reversed(file.blocks) if b.name.isdecimal()), str(len(file.blocks) - 1))
    if not rest or not re.fullmatch(f"{int(last) + 1}|{last}[A-Z]+", rest[0]):  # 5AS: a stop behind surface 5
        raise line.error("SURF", " ".join(rest), f"surface {int(last) + 1}, as they are numbered in order")
    file.blocks.append(Block(line, name=rest[0]))


def _system(file: File, line: Line, word: str, rest: list[str]) -> None:
    match word:
        case "MODE":
            if rest[:1] != ["SEQ"]:
                raise line.error(word, " ".join(rest), "SEQ: a sequential system")
        case "NAME":
            file.name = " ".join(rest)
        case "NOTE":
            file.notes.append(" ".join(rest[1:]))
        case "UNIT":
            if not rest or rest[0].upper() not in UNITS:
                raise line.error(word, " ".join(rest[:1]), f"one of {', '.join(UNITS)}")
            file.unit = UNITS[rest[0].upper()]
        case "ENPD":
            file.pupil = line.positive(word, rest)
        case "FNUM":
            file.f_number = line.positive(word, rest)
            file.working = line if rest[1:2] == ["1"] else None
        case "OBNA":
            raise line.error(word, " ".join(rest), "a pupil diameter (ENPD), an f-number (FNUM) or the stop (FLOA)")
        case "ENVD":
            if line.numbers(word, rest, 2)[:2] != [20.0, 1.0]:
                warn(file.file, f"indices are those at 20 degrees and 1 atmosphere, not at {' '.join(rest[:2])}")
        case "GCAT":
            file.makers = [word.upper().split("_")[0] for word in rest]  # catalogues may end in a date
        case "FTYP":
            numbers = line.numbers(word, rest, 1)
            file.field_type, file.fields, file.waves = int(numbers[0]), *map(int, (*numbers[2:4], 0, 0)[:2])
        case "WAVM":
            n, um = line.numbers(word, rest[:2], 2)
            file.waves_um[int(n)] = um
        case "WAVL" | "WAVN":
            file.waves_um |= dict(enumerate(line.numbers(word, rest), start=1))
        case "PWAV":
            file.primary = int(line.numbers(word, rest[:1])[0])
        case "XFLN" | "YFLN":
            file.heights[word] = line.numbers(word, rest, 0)
        case "MNUM":
            file.zoom.begin(line)


def _surface(file: File, block: Block, line: Line, word: str, rest: list[str]) -> None:
    match word:
        case "TYPE":
            block.kind = rest[0].upper() if rest else ""
            if block.kind not in TYPES and not block.kind.startswith(Q_TYPE):
                raise line.error(word, block.kind, f"one of {', '.join(TYPES)}, or a Q-type asphere")
        case "CURV":
            block.curvature = line.numbers(word, rest[:1])[0]
            block.bends = line if block.curvature else None
        case "CONI":
            block.conic = line.numbers(word, rest[:1])[0]
        case "DISZ":
            block.thickness = thickness(line, word, rest[:1], is_object=len(file.blocks) == 1)
        case "GLAS":
            block.medium, block.glass = _glass(line, rest, file.makers), line
        case "DIAM":
            semi = line.numbers(word, rest[:1])[0]
            if semi < 0:
                raise line.error(word, semi, "a semi-diameter above 0, or 0 where the program sizes the rim")
            block.semi_diameter = semi if semi > 0 else math.nan
            block.automatic = rest[1:2] == ["0"]
        case "PARM" | "XDAT":
            n, value = line.numbers(word, rest[:2], 2)
            (block.parameters if word == "PARM" else block.extra)[int(n)] = (value, line)
        case "STOP":
            block.stop = True
        case "COMM":
            pass
        case "MAZH" | "TCOM" | "TOLE":
            block.solve = (word, line.numbers(word, rest, 1 if word == "MAZH" else 2), line)
        case "CLAP" | "FLAP":
            inner, outer = line.numbers(word, rest[:2], 2)
            if inner != 0 or outer <= 0:
                raise line.error(word, f"{inner:g} {outer:g}", "a round opening without a hole")
            block.clear, block.aperture = outer, True
            block.automatic = word == "FLAP" and block.automatic
        case "SQAP" | "ELAP" | "USAP":
            block.aperture = True
            warn(file.file, f"line {line.number}: {word}, an opening that is not round, is taken as round by DIAM")
        case "OBDC":
            if any(line.numbers(word, rest)):
                raise line.error(word, " ".join(rest), "an opening that is centred on the axis")
        case "IGNR":
            if rest[:1] != ["0"]:
                raise line.error(word, " ".join(rest), "0: a surface that is switched off cannot be left in")


def _glass(line: Line, rest: list[str], makers: list[str]) -> dict[str, Any]:
    """GLAS name, type of solve, surface, n_d, V_d.

    Solve 1 is a model glass; others leave the glass that is named (2: a pickup, carried out; 3: one that the program
    may exchange), except 4, an offset from it.
    """
    name, kind = rest[0] if rest else "", rest[1] if len(rest) > 1 else "0"
    if name.upper() == "MIRROR" or not name:
        raise line.error("GLAS", name, "a glass: the lens model has no mirrors")
    if name.upper() in ("AIR", "VACUUM"):
        return {}
    if kind == "1" or name == "___BLANK":
        n_d, V_d, departure = (*line.numbers("GLAS", rest[3:6]), 0.0, 0.0)[:3]
        if departure:
            left_out = "a model glass's departure from normal partial dispersion is left out: colours differ a little"
            warn(line.file, f"line {line.number}, GLAS: {left_out}")
        return {"n_d": n_d, "V_d": V_d if V_d > 0 else None, "material": None if name == "___BLANK" else name}
    if kind == "4":
        raise line.error(
            "GLAS", f"{name} with solve {kind}", "a glass of the catalogue, or n_d and V_d: no offset from it"
        )
    figures = [] if catalogue.same_name(name) else [line.number_of("GLAS", word) for word in rest[3:5]]
    # 1.5 and 40 is what the program writes in the place of both.
    stated = (figures[0], figures[1]) if len(figures) == 2 and min(figures) > 1 and figures != [1.5, 40.0] else None
    return named_glass(name, line.file, f"line {line.number}, GLAS", makers, figures=stated)
