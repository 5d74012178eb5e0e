"""OSLO lens files (.len) of simple lenses: spheres, conics and aspheres of four terms, with round openings.

They have "LEN NEW name focal-length surfaces", settings, then the surfaces, object first, each ended by NXT, the image
by END. Tilts TLA and TLB are left-handed, TLC is right-handed, each about the axes that the one before has turned, and
decentres come first, by Sinclair Optics (OSLO User's Guide 5.4, "Tilted and/or decentered surfaces", 1997) and Lambda
Research ("Comparing Tilt Values in OSLO vs TracePro"). So they are as CODE V's.
"""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.lens.glass import figures_of_code
from neurolens.optics.lens.placement import Placement
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers import draft
from neurolens.optics.readers.assemble import lens_of
from neurolens.optics.readers.breaks import Turn
from neurolens.optics.readers.draft import INFINITE, UNKNOWN, Draft, Row, placed, primary_first
from neurolens.optics.readers.glasses import by_indices, named_glass
from neurolens.optics.readers.source import MAX_INDEX, UNITS_MM, Line, ReadOptions, assume, by_word, read_lines, warn

TURNS = ("DCX", "DCY", "DCZ", "TLA", "TLB", "TLC")
# From r^12 on as other programs write OSLO's files.
TERMS = {"AD": 4, "AE": 6, "AF": 8, "AG": 10, "AH": 12, "AI": 14, "AJ": 16, "AK": 18}
FIXED = {"RDF": "RD", "CVF": "CV", "THF": "TH", "APF": "AP", "GLF": "GLA", "AIF": "AIR"}  # with no solve or pickup
# Designer, weights, settings of the program, drawings.
HARMLESS = frozenset("DES WW CALLBACK GPRT DRW CBK DLRS".split())
# What changes rays and is not read, if a number other than 0 or a word follows; with what is expected in its place.
REFUSED = by_word(
    ("NA NAP PUK", "EBR, FNO or NAO to size the stop"),
    ("GC RCO", "no return of the axes: without it, what follows a tilted surface is tilted with it"),
    ("BEN", "no bend of the axes: a bend belongs to a mirror"),
    ("RFL RFH REFL", "no mirror: the lens model has none"),
    ("GRT GSP GOR DFR DOE HOE HOR", "no grating or hologram: the lens model has none"),
    ("GRD GDT NZ1 NR1 NR2 NR4", "no gradient index: the lens model has none"),
    ("PFL PFM", "no ideal lens: it is not read from OSLO's files"),
    ("CVX RDX AAD ASP ASR ASI ASX TOR CCX", "a sphere, a conic, or AD to AG: other shapes are not read"),
    (" ".join(f"AS{k}" for k in range(31)), "a sphere, a conic, or AD to AG: other shapes are not read"),
    ("TOX TOY TOZ", "0: pivots of tilts are not read"),
    ("GTO ATD CXD APD GCD RCD BED PFD TDD CSD TSD", "surfaces as they are: commands that edit are not carried out"),
    ("PK PU PI PUC PIC PYC EAC EC", "a figure: solves and pickups are not carried out"),
    ("AN AX1 AY1 APN AAC", "a round opening"),
)


@dataclass
class Block(draft.Block):
    """One surface, with what OSLO says about it."""

    values: dict[str, float] = field(default_factory=dict)
    glass: Line | None = None
    indices: list[float] = field(default_factory=list)  # at the wavelengths of the file


@dataclass
class File(Draft):
    """The state of reading a file."""

    kind: str = "OSLO"
    blocks: list[Block] = field(default_factory=list)
    ended: bool = False
    waves_um: list[float] = field(default_factory=list)


def read_len(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of an OSLO file.

    Raises:
        InputError: see the module; also for solves and pickups that the file does not carry out itself.
    """
    file = File(str(path))
    for line in read_lines(path):
        for part in _parts(line.text):
            _read(file, Line(line.file, line.number, part))
    if not file.ended:
        raise InputError(file.file, "END", "(missing)", "END and the number of the image surface")
    if len(file.blocks) < 3:
        raise InputError(file.file, "NXT", f"({len(file.blocks)} surfaces)", "object, at least one surface, and image")
    _complete(file)
    return lens_of(file, options)


def _parts(text: str) -> list[str]:
    """Split a line into commands: "//" begins a comment, ";" ends a command, both only outside quotes."""
    bare = re.match(r'(?:[^"/]|"[^"]*"|/(?!/))*', text)
    parts = re.findall(r'(?:[^";]|"[^"]*")+', bare[0] if bare else text)
    return [part.strip() for part in parts if part.strip()]


def _read(file: File, line: Line) -> None:
    word, rest = line.words[0].upper(), line.words[1:]
    word = FIXED.get(word, word)
    if word == "LEN":
        quoted = re.search('"([^"]*)"', line.text)
        file.name = quoted[1] if quoted else ""
        file.blocks.append(Block(line))
    elif not file.blocks:
        raise line.error(word, "(here)", "LEN NEW before everything else")
    elif file.ended and word in ("CFG", "CF", "C"):
        raise line.error(word, " ".join(rest) or "(here)", "one configuration: others are not read")
    elif file.ended:  # variables, operands and tolerances come after it, up to their own END
        file.skipped["lines behind the surfaces"] += word != "END"
    elif word in HARMLESS:
        pass
    elif re.fullmatch("SNO[0-9]*|NOT[0-9]*", word):
        file.notes.append(" ".join(rest).strip('"'))
    elif word in REFUSED:
        numbers = [n for n in rest if re.fullmatch("[-+.0-9eE]+", n)]
        if not numbers or any(line.numbers(word, numbers)):
            raise line.error(word, " ".join(rest) or "(here)", REFUSED[word])
    else:
        _keyword(file, file.blocks[-1], line, word, rest)


def _keyword(file: File, block: Block, line: Line, word: str, rest: list[str]) -> None:
    """Carry out a keyword of the system, or of the last surface."""
    match word:
        case "EBR":
            file.pupil = 2 * line.positive(word, rest)
        case "ANG":
            angle = abs(line.first(word, rest))
            file.half_field_deg = angle if 1e-3 < angle < 90 else None
        case "NAO":
            file.object_na = line.positive(word, rest)
        case "FNO":
            file.f_number = line.positive(word, rest)
        case "OBH":
            warn(file.file, "the field is given as an object height: left out")
        case "GIH":
            file.image_radius = abs(line.first(word, rest)) or None
        case "LMO" if "NSS" in line.text.upper():
            raise line.error(word, " ".join(rest), "no non-sequential part: the lens model has none")
        case "WV":
            file.waves_um = line.numbers(word, rest)
        case _ if re.fullmatch("WV[1-9][0-9]?", word):
            file.waves_um[int(word[2:]) - 1 : int(word[2:])] = line.numbers(word, rest)[:1]
        case "UNI":
            mm = line.first(word, rest)
            file.unit = next((name for name, value in UNITS_MM.items() if value == mm), None)
            if file.unit is None:
                raise line.error(word, mm, "1 (mm), 10 (cm), 25.4 (inch) or 1000 (m)")
        case "NXT":
            file.blocks.append(Block(line, str(len(file.blocks))))
        case "END":
            file.ended = True
            if rest and line.first(word, rest) != len(file.blocks) - 1:
                raise line.error(word, rest[0], f"{len(file.blocks) - 1}, the number of the image surface")
        case "AIR":
            block.medium, block.indices = {}, []
        case "GLA":
            _glass(block, line, rest)
        case "AP":
            block.aperture = rest[:1] == ["CHK"]
            semi = line.first(word, rest[block.aperture :])
            block.semi_diameter = semi if semi > 0 else UNKNOWN
        case "AST":
            block.stop = True
        case "PY":
            if line.first(word, rest) != 0:
                raise line.error(word, rest[0], "0: the film in the paraxial image")
            block.solved = True
        case "DT":
            if line.first(word, rest) != 1:
                raise line.error(word, rest[0], "1: decentres before tilts")
        case _ if word in ("RD", "CV", "TH", "CC", *TERMS, *TURNS):
            block.values[word] = line.first(word, rest)
            if TERMS.get(word, 0) > 10 and block.values[word]:
                assume(file.file, f"line {line.number}: {word} is taken as the coefficient of r^{TERMS[word]}")
        case _:
            file.skipped[word] += 1


def _glass(block: Block, line: Line, rest: list[str]) -> None:
    """Read GLA with a name of the catalogue, or with indices, of a model glass behind MOD and its name."""
    model = rest[:1] == ["MOD"]
    rest = rest[1 + (not re.match("[0-9.]", rest[1])) :] if model and rest[1:] else rest
    block.medium, block.glass, block.indices = {}, line, []
    if not rest:
        raise line.error("GLA", "(nothing)", "the name of a glass, or an index")
    if re.fullmatch(r"[0-9.]+", rest[0]) and not figures_of_code(rest[0]):
        block.indices = line.numbers("GLA", rest)
    elif rest[0].upper() in ("REFL", "RFL", "REFLECT"):
        raise line.error("GLA", rest[0], "a glass: the lens model has no mirrors")
    else:
        block.medium = named_glass(rest[0], line.file, f"line {line.number}, GLA")
    if model and len(block.indices) == 2 and block.indices[1] > MAX_INDEX:
        block.medium, block.indices = {"n_d": block.indices[0], "V_d": block.indices[1]}, []


def _complete(file: File) -> None:
    """Set what is known only when all surfaces are read."""
    waves_nm = [1000 * um for um in file.waves_um]
    for block in file.blocks:  # the indices stand at wavelengths that come after the surfaces
        if block.glass and block.indices:
            block.medium = by_indices(block.glass, "GLA", block.indices, waves_nm)
    first, *middle, image = file.blocks
    last = middle[-1]
    for block, name, plane in ((first, "object", "object"), (image, "image", "film")):
        if block.values.get("RD") or block.values.get("CV"):
            warn(file.file, f"the {name} surface is curved; the {plane} is taken as plane")
    if "TH" in last.values:  # the thickness of the image says how far behind it the film lies
        last.values["TH"] += image.values.get("TH", 0.0)
    for k, block in enumerate(middle, start=1):
        if block.solved and block is not last:
            raise block.start.error("PY", f"(on surface {k})", "the last surface")
    distance = first.values.get("TH", 0.0)
    for block in file.blocks[1:]:
        x, y, z, a, b, c = (block.values.get(name, 0.0) for name in TURNS)
        block.turn = Turn(Placement((x, y, z), (-a, -b, c))) if any((x, y, z, a, b, c)) else None
    file.rows = placed([_row(block) for block in middle], file.blocks[1:])
    file.object_medium, file.wavelengths_nm = first.medium, primary_first(waves_nm, waves_nm[0] if waves_nm else 0.0)
    file.object_distance = math.inf if distance >= INFINITE else distance
    if file.pupil is not None and 0 < distance < INFINITE:  # EBR is measured at surface 1, not at the entrance pupil
        sine = file.pupil / math.hypot(file.pupil, 2 * distance)
        file.object_na, file.pupil = sine * first.medium.get("n_d", 1.0), None
    file.film_given = not (last.solved and "TH" not in last.values)


def _row(block: Block) -> Row:
    values = block.values
    block.curvature, block.thickness, block.conic = (values.get(key, 0.0) for key in ("CV", "TH", "CC"))
    radius = values.get("RD") or block.radius
    block.curvature = 1 / radius
    terms = ((TERMS[name], value) for name, value in sorted(values.items()) if name in TERMS)
    # The radius is taken as printed, not as the inverse of its inverse.
    return block.row(block.rotational(terms) | {"radius_mm": radius})
