"""Zemax OpticStudio lens files (.zmx): sequential systems, UTF-16 or plain text.

A file has the settings of the system, then one block "SURF n" for each surface, the object first and the image last,
then merit function, tolerances and configurations. A block has curvature, semi-diameter, and thickness to the next
surface.
"""

import math
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.placement import Placement
from neurolens.optics.lens.prescription import Lens, MediumFields
from neurolens.optics.readers import draft
from neurolens.optics.readers.assemble import lens_of
from neurolens.optics.readers.breaks import Turn
from neurolens.optics.readers.draft import (
    INFINITE,
    LEAST_RADIUS,
    Draft,
    Positions,
    ShapeFields,
    from_axis_deg,
    placed,
    primary_first,
)
from neurolens.optics.readers.glasses import named_glass
from neurolens.optics.readers.source import MAX_POWER, Line, ReadOptions, assume, by_word, read_lines, warn

UNITS = {"MM": "mm", "CM": "cm", "IN": "in", "INCH": "in", "METER": "m", "METERS": "m", "M": "m"}
TYPES = tuple("STANDARD EVENASPH ODDASPHE XASPHERE XOSPHERE TOROIDAL BICONICX PARAXIAL COORDBRK JONESMAT".split())
Q_TYPE = "Q"  # how the names of Q-type aspheres begin, and of no other type
# Settings of the program, and what its editor shows of a surface: written to most files, and no ray depends on them.
HARMLESS = frozenset(
    """VERS PFIL LANG GFAC RAIM PUSH SDMA OMMA ROPD PICB PZUP FWGN FWGT WWGT WWGN POLS GLRS GSTD NSCD COFN LUID EFFL
    HYPR DBDT HIDE MIRR SLAB POPS FIMP MEMA OEMA VDSZ VPAR PPAR GLCZ""".split()
)
# Rims and stop decide which rays pass, not the factors that a designer chose.
VIGNETTING = frozenset("VDXN VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN".split())
# What changes rays at a surface and the lens model lacks.
REFUSED = by_word(
    ("OBSC SQOB ELOB USOB SPID", "no obscuration: the lens model has none"),
    ("SCBD", "no tilt and no decentre of a surface but by coordinate breaks"),
)
# Operands of the multi-configuration editor: those that move no ray (fields, wavelengths, vignetting factors,
# comments), and those that are read.
UNMOVED = frozenset("MOFF MCOM XFIE YFIE FLWT FVDX FVDY FVCX FVCY FVAN WAVE WLWT PRWV GCRS BLNK".split())
OPERANDS = ("THIC", "APER", "SDIA", "LTTL")
MAX_EXTRAS = 240
_DEEPEST = 1000  # sag over rim of the deepest asphere
_SAME_N_D, _SAME_V_D = 0.005, 2.0  # by which the figures of one glass may differ, since melts, moulding and years do
_EVEN = 8  # terms of EVENASPH by its definition; other programs write more


@dataclass
class Block(draft.Block):
    """One SURF block. Numbers keep the line from which they come."""

    thickness: float = math.nan  # until DISZ has been read
    kind: str = "STANDARD"
    automatic: bool = True  # whether the program sized the rim by the rays
    bends: Line | None = None  # where a curvature other than 0 is given
    glass: Line | None = None  # where the medium is given
    clear: float | None = None  # semi-diameter of an aperture, which rules over the other
    parameters: dict[int, tuple[float, Line]] = field(default_factory=dict)
    extra: dict[int, tuple[float, Line]] = field(default_factory=dict)
    solve: tuple[str, list[float], Line] | None = None

    def parameter(self, n: int) -> float:
        return self.parameters.pop(n, (0.0, self.start))[0]

    def extras(self, first: int = 1) -> tuple[float, list[float]]:
        """Return normalisation radius and coefficients of a surface; their count is in the extra data at `first`.

        Raises:
            InputError: the count is not whole, or beyond `MAX_EXTRAS`; the radius is not above 0.
        """
        (count, line), (radius, _) = (self.extra.pop(first + k, (k, self.start)) for k in (0, 1))
        if not (0 <= count <= MAX_EXTRAS and count == int(count)):
            raise line.error(f"XDAT {first} of {self.kind}", count, f"how many terms there are, at most {MAX_EXTRAS}")
        if not radius >= LEAST_RADIUS:
            expected = f"a normalisation radius of at least {LEAST_RADIUS:g}"
            raise line.error(f"XDAT {first + 1} of {self.kind}", radius, expected)
        return radius, [self.extra.pop(first + 2 + k, (0.0, self.start))[0] for k in range(int(count))]


@dataclass
class File(Draft):
    """The state of reading a file."""

    kind: str = "Zemax"
    blocks: list[Block] = field(default_factory=list)
    zoom: Positions = field(default_factory=Positions)
    makers: list[str] = field(default_factory=list)
    without_film: bool = False
    working: bool = False  # whether the f-number is that at the image
    field_type: int = 0
    fields: int = 0
    heights: dict[str, list[float]] = field(default_factory=dict)
    waves_um: dict[int, float] = field(default_factory=dict)
    waves: int = 0  # how many wavelengths are used, where the file says so
    primary: int = 1
    behind: Counter[str] = field(default_factory=Counter)  # keywords that follow a surface without indentation
    # n_d and V_d that stand behind names of glasses
    figures: dict[str, list[tuple[Line, tuple[float, float]]]] = field(default_factory=dict)


def read_zmx(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a Zemax file.

    Raises:
        InputError: see the module; also for mirrors, obscurations and everything else that the lens model cannot
            hold. Names the keyword and the line.
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


def _read(file: File, line: Line) -> None:
    word, rest = line.words[0].upper(), line.words[1:]
    if word.startswith("!"):
        return
    if file.zoom.count:
        _operand(file, line, word, rest)
    elif word == "SURF":
        _begin(file, line, rest)
    elif _system(file, line, word, rest) or (file.blocks and _surface(file, file.blocks[-1], line, word, rest)):
        return
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
    file.skipped += file.behind  # so they were no merit function
    file.behind.clear()
    if not file.blocks and rest[:1] == ["1"]:
        file.blocks.append(Block(line))
    last = next((b.name for b in reversed(file.blocks) if b.name.isdecimal()), str(len(file.blocks) - 1))
    if not rest or not re.fullmatch(f"{int(last) + 1}|{last}[A-Z]+", rest[0]):  # 5AS: a stop behind surface 5
        raise line.error("SURF", " ".join(rest), f"surface {int(last) + 1}, as they are numbered in order")
    file.blocks.append(Block(line, name=rest[0]))


def _system(file: File, line: Line, word: str, rest: list[str]) -> bool:
    """Carry out a keyword of the whole system; False where it is no such keyword."""
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
            file.working = rest[1:2] == ["1"]
        case "OBNA":
            if rest[1:2] == ["1"]:
                raise line.error(word, " ".join(rest), "a numerical aperture, with flag 0: a cone's angle is not read")
            file.object_na = line.positive(word, rest[:1])
        case "ENVD":
            if line.numbers(word, rest, 2)[:2] != [20.0, 1.0]:
                warn(file.file, f"indices are those at 20 degrees and 1 atmosphere, not at {' '.join(rest[:2])}")
        case "GCAT":
            file.makers = [word.upper().split("_")[0] for word in rest]  # names of catalogues may end in a date
        case "FTYP":
            numbers = line.numbers(word, rest, 1)
            file.field_type, file.fields, file.waves = int(numbers[0]), *map(int, (*numbers[2:4], 0, 0)[:2])
        case "WAVM":
            n, um = line.numbers(word, rest[:2], 2)
            file.waves_um[int(n)] = um
        case "WAVL" | "WAVN":
            file.waves_um |= dict(enumerate(line.numbers(word, rest), start=1))
        case "PWAV":
            file.primary = int(line.first(word, rest))
        case "XFLN" | "YFLN":
            file.heights[word] = line.numbers(word, rest, 0)
        case "MNUM":
            file.zoom.begin(line, word, int(line.first(word, rest)))
        case _:
            return word in ("FLOA", "TOL")
    return True


def _surface(file: File, block: Block, line: Line, word: str, rest: list[str]) -> bool:
    """Carry out a keyword of a surface; False where it is no such keyword."""
    match word:
        case "TYPE":
            block.kind = rest[0].upper() if rest else ""
            if block.kind not in TYPES and not block.kind.startswith(Q_TYPE):
                raise line.error(word, block.kind, f"one of {', '.join(TYPES)}, or a Q-type asphere")
        case "CURV":
            block.curvature = line.first(word, rest)
            block.bends = line if block.curvature else None
        case "CONI":
            block.conic = line.first(word, rest)
        case "DISZ":
            block.thickness = _thickness(line, word, rest[:1], is_object=len(file.blocks) == 1)
        case "GLAS":
            block.medium, block.glass = _glass(file, line, rest), line
        case "DIAM":
            semi = line.first(word, rest)
            if semi < 0:
                raise line.error(word, semi, "a semi-diameter above 0, or 0 where the program sizes the rim")
            block.semi_diameter = semi if semi > 0 else math.nan
            block.automatic = rest[1:2] == ["0"]
        case "PARM" | "XDAT":
            n, value = line.numbers(word, rest[:2], 2)
            (block.parameters if word == "PARM" else block.extra)[int(n)] = (value, line)
        case "STOP":
            block.stop = True
        case "MAZH" | "TCOM" | "TOLE":
            block.solve = (word, line.numbers(word, rest, 1 if word == "MAZH" else 2), line)
            block.solved = True
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
        case _:
            return word == "COMM"
    return True


def _operand(file: File, line: Line, word: str, rest: list[str]) -> None:
    """Read an operand of the configurations: name, surface, configuration (from 1), value."""
    if word in UNMOVED or file.zoom.count == 1:  # a single configuration only repeats the table
        return
    if word not in OPERANDS:
        expected = f"one of {', '.join(OPERANDS)}: other things that change with the configuration are not read"
        raise line.error(word, "(unknown operand)", expected)
    numbers, count = line.numbers(word, rest[:2], 2), len(file.blocks)
    surface, place = int(numbers[0]), int(numbers[1]) - 1
    if not 0 <= place < file.zoom.count or not 0 <= surface < count:
        expected = f"a surface below {count}, a configuration to {file.zoom.count}"
        raise line.error(word, " ".join(rest[:2]), expected)
    if word == "LTTL":
        quoted = re.search('"([^"]*)"', line.text)
        file.zoom.titles[place] = (quoted[1] if quoted else " ".join(rest[2:3])).strip()
    elif word == "THIC":
        file.zoom.gaps[surface, place] = _thickness(line, word, rest[2:3], is_object=surface == 0)
    elif word == "APER":
        sizes = file.zoom.pupil if file.f_number is None else file.zoom.f_number
        sizes[place] = line.positive(word, rest[2:3])
    else:
        file.zoom.rims[surface, place] = line.positive(word, rest[2:3]), line


def _thickness(line: Line, word: str, rest: list[str], *, is_object: bool) -> float:
    """Return a thickness; that of the object may be infinite, in words or as a number of 1e9 or more."""
    if is_object and rest == ["INFINITY"]:
        return math.inf
    value = line.first(word, rest)
    return math.inf if is_object and value >= INFINITE else value


def _glass(file: File, line: Line, rest: list[str]) -> MediumFields:
    """Read GLAS with name, type of solve, surface, n_d, V_d.

    Solve 1 is a model glass. Others leave the glass that is named (2 is a pickup that is carried out, 3 a glass that
    the program may exchange), except 4, an offset from it.
    """
    name, kind = rest[0] if rest else "", rest[1] if len(rest) > 1 else "0"
    if name.upper() == "MIRROR" or not name:
        raise line.error("GLAS", name, "a glass: the lens model has no mirrors")
    if name.upper() in ("AIR", "VACUUM"):
        if name.upper() == "VACUUM":
            warn(line.file, f"line {line.number}, GLAS: VACUUM is taken as air, whose index is 0.0003 higher")
        return {}
    if kind == "1" or name == "___BLANK":
        n_d, V_d, departure = (*line.numbers("GLAS", rest[3:6]), 0.0, 0.0)[:3]
        if departure:
            left_out = "a model glass's departure from normal partial dispersion is left out: colours differ a little"
            warn(line.file, f"line {line.number}, GLAS: {left_out}")
        return {"n_d": n_d, "V_d": V_d if V_d > 0 else None, "material": None if name == "___BLANK" else name}
    if kind == "4":
        expected = "a glass of the catalogue, or n_d and V_d: no offset from it"
        raise line.error("GLAS", f"{name} with solve {kind}", expected)
    known, figures = catalogue.same_name(name), list[float]()
    with suppress(InputError) if known else nullcontext():
        figures = [line.number_of("GLAS", word) for word in rest[3:5]]
    # The program writes 1.5 and 40 where it knows neither.
    stated = (figures[0], figures[1]) if len(figures) == 2 and min(figures) > 1 and figures != [1.5, 40.0] else None
    if stated:
        file.figures.setdefault(name, []).append((line, stated))
    return named_glass(name, line.file, f"line {line.number}, GLAS", file.makers, figures=None if known else stated)


def _check_figures(file: File) -> None:
    """Refuse the figures of unknown glasses if any are stale: another glass's, or two sets behind one name.

    Programs that exchange glasses leave the figures of the previous glasses.
    """
    stale, unknown = "", None
    for name, given in file.figures.items():
        known = [(g.n_d, g.V_d) for g in (*catalogue.same_name(name), *catalogue.same_name(f"N-{name}"))]
        unknown = unknown or (None if known else (name, *given[0]))
        for line, (n, V) in given:
            if not any(abs(n_d - n) <= _SAME_N_D and abs(V_d - V) <= _SAME_V_D for n_d, V_d in known or [given[0][1]]):
                stale = stale or f"line {line.number} gives {name} {n:g} and {V:g}, another glass's"
    if stale and unknown:
        name, line, (n, V) = unknown
        expected = f"a glass of the catalogue, or its own by --glass: the figures behind names are stale ({stale})"
        raise line.error("GLAS", f"{name} with n_d {n:g} and V_d {V:g}", expected)


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


def _complete(file: File) -> None:
    """Set what is known only when all surfaces are read."""
    file.skipped["lines of the merit function"] += file.behind.total()
    _check_figures(file)
    first, *middle, image = file.blocks
    for before, block in zip(file.blocks, file.blocks[1:], strict=False):
        block.semi_diameter = block.semi_diameter if block.clear is None else block.clear
        if block.kind == "COORDBRK" and block.glass is None:
            block.medium = before.medium  # the block stands in the medium of the surface before it
    rows = tuple(b.row(shape_of(b)) for b in middle)
    for block in file.blocks:
        if math.isnan(block.thickness):
            raise block.start.error("DISZ", "(missing)", "the thickness behind every surface (is the file cut off?)")
    file.rows = placed(rows, file.blocks[1:])
    if image.thickness or image.stop or image.medium not in ({}, middle[-1].medium):
        raise image.start.error("SURF", "(the last in the file)", "an image surface (is the file cut off?)")
    if image.curvature or any(value for value, _ in image.parameters.values()):
        warn(file.file, "the image surface is curved; the film is taken as plane")
    if file.working and math.isfinite(first.thickness):
        file.image_f_number, file.f_number = file.f_number, None
    last = middle[-1]
    file.notes = ["\n".join(file.notes).strip()]
    file.object_distance, file.object_medium = first.thickness, first.medium
    used = dict.fromkeys(um for n, um in sorted(file.waves_um.items()) if n <= (file.waves or n))
    file.wavelengths_nm = primary_first([1000 * um for um in used], 1000 * file.waves_um.get(file.primary, 0.0))
    file.film_given = not (file.without_film or (last.solve and last.solve[0] == "MAZH" and last.thickness == 0))
    file.rims = "estimated" if any(b.automatic and not b.stop for b in middle) else "source"
    file.states = file.zoom.states(file.blocks, "configuration", "SDIA", lambda gaps, place: _solved(file.blocks, gaps))
    _set_field(file)


def _solved(blocks: Sequence[Block], gaps: list[float]) -> bool:
    """Carry out the thickness solves of a configuration; returns whether its film is given."""
    film_given = True
    for k, block in enumerate(blocks):
        if block.solve is None:
            continue
        word, numbers, line = block.solve
        if word == "MAZH":
            if k != len(gaps) - 2:
                raise line.error(word, f"(on surface {k})", "the last surface, in a file with configurations")
            film_given = False
            continue
        reference, total = int(numbers[0]), numbers[1]
        if not 0 < reference < k:
            raise line.error(word, reference, f"a surface in front of surface {k}")
        gaps[k] = total - (gaps[reference] if word == "TCOM" else sum(gaps[reference:k]))
    return film_given


def _set_field(file: File) -> None:
    """Set half field or image radius by the farthest field point. FTYP 0 is an angle, 2 and 3 are image heights."""
    points = [(x, y) for x, y in zip(*(file.heights.get(k, [0.0] * 100) for k in ("XFLN", "YFLN")), strict=False)]
    away = (from_axis_deg(*p) if file.field_type == 0 else math.hypot(*p) for p in points[: file.fields or None])
    edge = max(away, default=0.0)
    if edge > 0 and file.field_type == 0:
        file.half_field_deg = edge
    elif edge > 0 and file.field_type in (2, 3):
        file.image_radius = edge
    elif edge > 0:
        warn(file.file, f"the field is given as type {file.field_type} (not an angle, not an image height): left out")


def shape_of(block: Block) -> ShapeFields:
    """Return the radius and the figure of a surface, for `Block.row`.

    Even asphere: sum of PARM i r^(2 i). Odd asphere: sum of PARM i r^i. The extended ones have XDAT in the place of
    PARM, and powers of r over a normalisation radius. Q-type: XDAT 1 is 0 for Qbfs and 1 for Qcon. Toroidal: CURV, CONI
    and PARM i y^(2 i - 2), i from 2, in the y-z plane, turned about an axis at PARM 1 (0 is infinity: a cylinder).
    Biconic: CURV, CONI in y, PARM 1 (a radius, 0 is infinity) and PARM 2 (a conic) in x. Paraxial, an ideal lens: PARM
    1 is its focal length; PARM 2 says how path lengths count, and moves no ray.

    Raises:
        InputError: the lens model cannot represent a type, a parameter or their combination; names it and the line.
    """
    match block.kind:
        case "STANDARD":
            shape = block.rotational()
        case "XASPHERE" if any(v for v, _ in block.parameters.values()) and not any(v for v, _ in block.extra.values()):
            message = "an XASPHERE with its terms in PARM is taken as EVENASPH"
            assume(block.start.file, f"surface {block.name} of the file: {message}")
            return shape_of(replace(block, kind="EVENASPH", extra={}))
        case "EVENASPH":
            if any(n > _EVEN and value for n, (value, _) in block.parameters.items()):
                message = f"PARM {_EVEN + 1} and beyond of EVENASPH are taken as its next even powers"
                assume(block.start.file, f"surface {block.name} of the file: {message}")
            shape = block.rotational([(2 * i, block.parameter(i)) for i in range(1, MAX_POWER // 2 + 1)])
        case "ODDASPHE":
            terms = [(i, block.parameter(i)) for i in range(1, 9)]
            if terms[0][1]:
                raise block.start.error("PARM 1 of ODDASPHE", terms[0][1], "0: a cone's tip has no normal")
            shape = block.rotational(terms)
        case "XASPHERE" | "XOSPHERE":
            step = 2 if block.kind == "XASPHERE" else 1
            radius, values = block.extras()
            if step == 1 and values[:1] not in ([], [0.0]):
                raise block.start.error("XDAT 3 of XOSPHERE", values[0], "0: a cone's tip has no normal")
            shape = block.rotational((step * i, a / radius ** (step * i)) for i, a in enumerate(values, start=1))
            rim = block.semi_diameter
            if step == 2 and (depth := sum(abs(a) * rim**p for p, a in shape["asphere"])) > _DEEPEST * rim:
                expected = "terms of even powers: are these an XOSPHERE's, of odd powers too?"
                raise block.start.error("XASPHERE", f"(a sag of {depth:.3g} at a rim of {rim:g})", expected)
        case kind if kind.startswith(Q_TYPE):
            shape = _q_type(block)
        case "TOROIDAL" | "BICONICX":
            biconic, radius_x = block.kind == "BICONICX", block.parameter(1)
            conic_x = block.parameter(2) if biconic else None
            curve = block.rotational(() if biconic else [(2 * i - 2, block.parameter(i)) for i in range(2, 9)])
            shape = block.crossed(curve, radius_x or math.inf, conic_x)
        case "PARAXIAL":
            shape = {"radius_mm": math.inf, "focal_mm": block.parameter(1)}
            block.parameters.pop(2, None)
            if not shape["focal_mm"] or block.bends:
                raise block.start.error("PARAXIAL", shape["focal_mm"], "PARM 1, a focal length other than 0, no CURV")
        case "JONESMAT":
            shape = block.rotational()
            block.parameters.clear()  # a Jones matrix, which turns polarisation and no ray
            warn(block.start.file, f"surface {block.name} of the file: a JONESMAT is left out of transmittance")
        case "COORDBRK":
            shape = block.rotational()
            x, y, a, b, c = (block.parameter(n) for n in range(1, 6))
            if any((x, y, a, b, c)):
                block.turn = Turn(Placement((x, y, 0.0), (a, b, c)), tilts_first=bool(block.parameter(6)))
            block.parameters.pop(6, None)
    _refuse_rest(block)
    return shape


def _refuse_rest(block: Block) -> None:
    """Refuse what a surface still states after its shape was read."""
    for name, table in (("PARM", block.parameters), ("XDAT", block.extra)):
        for n, (value, line) in table.items():
            # The second extra value of a toroid is a normalisation radius, for no terms.
            if value != 0 and not (block.kind == "TOROIDAL" and name == "XDAT" and n == 2):
                raise line.error(f"{name} {n} of {block.kind}", value, "0: the lens model has no such term")
    for word, given in (("CURV", block.bends), ("GLAS", block.glass)):
        if block.kind == "COORDBRK" and given is not None:
            raise given.error(f"{word} of COORDBRK", given.text.strip(), "none: a coordinate break is no surface")


def _q_type(block: Block) -> ShapeFields:
    form, (radius, values) = block.extra.pop(1, (0.0, block.start))[0], block.extras(2)
    if form not in (0, 1):
        raise block.start.error(block.kind, f"(XDAT 1 {form:g})", "0 (Qbfs) or 1 (Qcon)")
    if form == 1:
        assume(block.start.file, f"line {block.start.number}: {block.kind}: 1 in XDAT 1 is taken to mean Qcon")
    return block.q_type(block.kind, form == 1, values, radius)
