"""CODE V sequence files (.seq): commands of three letters, S lines with radius or curvature, thickness, glass."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens
from neurolens.readers.codev_model import (
    ALONG,
    LETTERS,
    NONE_BUT_0,
    Block,
    Command,
    Zoom,
    commands,
    medium,
    shape_of,
)
from neurolens.readers.draft import INFINITE, Draft, Row, lens_of, primary_first
from neurolens.readers.source import ReadOptions, assume, by_word, read_lines, warn


@dataclass
class File(Draft):
    """A file while it is read."""

    kind: str = "CODE V"
    blocks: list[Block] = field(default_factory=list)
    closed: bool = False  # whether the image has come
    zoom: Zoom = field(default_factory=Zoom)
    radii: bool | None = None
    fields: dict[str, list[float]] = field(default_factory=dict)
    private: dict[str, tuple[Command, list[float]]] = field(default_factory=dict)  # a row of PRV, its wavelengths in nm
    private_nm: list[float] | None = None
    waves_nm: list[float] = field(default_factory=list)
    reference: int = 1


def _complete(file: File) -> None:
    """Set what follows from all surfaces.

    Raises:
        InputError: no surface, a solve or a shape that the lens model cannot represent.
    """
    first, *middle, image = file.blocks
    if not middle:
        raise InputError(file.file, "S", "(no surface)", "at least one surface between object and image")
    if image.curvature:
        warn(file.file, "the image surface is curved; the film is taken as plane")
    # The image lies off the last thickness by the thickness of SI: a defocus.
    middle[-1].thickness += image.thickness
    for k, block in enumerate(middle[:-1]):
        if block.solved:
            raise block.start.error("PIM", f"(on surface {k + 1})", "the last surface")
    file.rows = tuple(Row(b.surface(shape_of(b)), not math.isnan(b.semi_diameter), b.name) for b in middle)
    file.half_field_deg = _edge(file, ("XAN", "YAN"))
    file.image_radius = _edge(file, ("XIM", "YIM"), ("XRI", "YRI"))
    if _edge(file, ("XOB", "YOB")) and not file.half_field_deg:
        warn(file.file, "the field is given as an object height: left out")
    file.states = tuple(file.zoom.states(middle, first.thickness, image.thickness))
    file.object_distance, file.object_medium = first.thickness, first.medium
    primary = file.waves_nm[file.reference - 1] if 0 < file.reference <= len(file.waves_nm) else 0.0
    file.wavelengths_nm = primary_first(file.waves_nm, primary)
    file.film_given = not (middle[-1].solved and middle[-1].thickness == image.thickness)


def _edge(file: File, *pairs: tuple[str, str]) -> float | None:
    """Return the field point farthest from the axis; None where the file has none of that kind."""
    far = 0.0
    for x, y in pairs:
        across, up = file.fields.get(x, []), file.fields.get(y, [])
        longest = max(len(across), len(up))
        across, up = across + [0.0] * (longest - len(across)), up + [0.0] * (longest - len(up))
        far = max([far, *(math.hypot(a, b) for a, b in zip(across, up, strict=True))])
    return far or None


UNITS = {"M": "mm", "C": "cm", "I": "in"}
ROOM = 20  # degrees, at which the catalogues measure
FIELDS = ("XAN", "YAN", "XIM", "YIM", "XRI", "YRI", "XOB", "YOB")
# Settings, weights, labels, control codes of variables, tolerances: written to most files, and no ray depends on them.
HARMLESS = frozenset(
    """LEN WTW WTF WTA INI DOR PRE DER UID SLB GO END CCY CCX THC GLC KC AC BC CC DC EC FC GC HC JC DLT
    DLN DLF DLR IRR SCC KXC""".split()
)
# What changes rays and is not read: what is expected in its place.
REFUSED = by_word(
    ("NAO NA", "EPD or FNO to size the stop"),
    ("MOD", "a surface that is no ideal lens (a module)"),
    ("GRT DIF DOE HOE HOL", "a surface that is no grating, hologram or diffractive surface"),
    ("GRN", "a medium without a gradient index"),
    ("FRN SPL UDS NSS", "a surface that is no Fresnel surface, spline, surface of the user or non-sequential part"),
    ("RMD", "a surface that refracts: the lens model has no mirrors"),
    ("REX REY ELX ELY REC ELL", "a round opening (CIR)"),
)
VIGNETTING = frozenset(["VUX", "VLX", "VUY", "VLY"])
SHAPES = ("SPH", "CON", "ASP", "CYL", "YTO", "XTO", "AAS")
READ = (
    *"RDY CUY RDX CUX THI GLA STO SPS SCO K CIR PIM".split(),
    *(*SHAPES, *ALONG, *LETTERS, *NONE_BUT_0),
)


def read_seq(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a CODE V sequence file.

    Raises:
        InputError: see the module; also tilts, mirrors and everything else that the lens model cannot represent.
    """
    file = File(str(path))
    for command in commands(read_lines(path)):
        if file.private_nm is not None:
            _private(file, command)
        elif command.name == "ZOO":
            file.zoom.read(command, len(file.blocks))
        elif command.name in HARMLESS:
            pass
        elif command.name in VIGNETTING:
            file.skipped["vignetting factors (rims decide)"] += any(command.numbers(least=0))
        elif not _system(file, command):
            _surface(file, command)
    if not file.closed:
        raise InputError(file.file, "SI", "(missing)", "an image surface at the end of the lens")
    _complete(file)
    return lens_of(file, options)


def looks_like_seq(head: str) -> bool:
    """Test whether the beginning of a text is that of a CODE V file."""
    first = [line.replace(";", " ").split()[0].upper() for line in head.splitlines() if line.replace(";", " ").split()]
    return bool({"RDM", "LEN"} & set(first)) and "NEW" not in head.upper().split()[:3]


def _private(file: File, command: Command) -> None:
    """Inside PRV: PWL gives wavelengths, each row a glass by its name; END closes."""
    if command.name == "END":
        file.private_nm = None
    elif command.name == "PWL":
        file.private_nm = command.numbers()
    elif not file.private_nm:
        raise command.line.error("PRV", command.name, "PWL and wavelengths before the glasses")
    else:
        file.private[command.word.strip("'\"")] = command, file.private_nm


def _system(file: File, command: Command) -> bool:
    """Carry out a command of the whole system; False where it is none."""
    name, words, line = command.name, command.words, command.line
    match name:
        case "RDM":
            file.radii = not (words and words[0].upper() in ("N", "NO"))
        case "TIT" if words and words[0].upper().startswith("Z") and words[0][1:].isdecimal():
            file.zoom.title(command)
        case "TIT":
            file.name = " ".join(words).strip("\"' ")
        case "DIM":
            unit = words[0].upper()[:1] if words else ""
            if unit not in UNITS:
                raise line.error("DIM", unit, "M (mm), C (cm) or I (inch)")
            file.unit = UNITS[unit]
        case "EPD" | "FNO":
            value = line.positive(name, words)
            file.pupil, file.f_number = (value, None) if name == "EPD" else (None, value)
        case "TEM":
            if abs(command.numbers()[0] - ROOM) > 5:
                warn(file.file, f"indices are those at {ROOM} degrees, not at {' '.join(words)}")
        case "WL":
            file.waves_nm = command.numbers()
        case "REF":
            file.reference = int(command.numbers()[0])
        case "PRV":
            file.private_nm = []
        case _ if name in FIELDS:
            file.fields[name] = command.numbers()
        case _:
            return False
    return True


def _surface(file: File, command: Command) -> None:
    name, words, line = command.name, command.words, command.line
    if name in ("S", "SO", "SI"):
        _new_surface(file, command)
        return
    if name in REFUSED:
        raise line.error(name, " ".join(words) or "(given)", REFUSED[name])
    if name not in READ:
        file.skipped[command.word] += 1
        return
    block = file.blocks[-1] if file.blocks else None
    if words and words[0].upper()[:1] == "S" and (words[0][1:].isdecimal() or words[0].upper() in ("SO", "SI")):
        block, words = _named(file, command), words[1:]
        if words and words[0].upper().startswith("Z") and name == "THI":
            file.zoom.one_thickness(command, len(file.blocks))
            return
    if block is None:
        raise line.error(name, " ".join(words), "a surface (SO or S) before it")
    match name:
        case "STO":
            block.stop = True
        case _ if name in SHAPES:
            block.kind = name
        case "SPS" | "SCO":
            block.put_special(command, words)
        case "PIM":
            block.solved = True
        case "GLA":
            block.medium = medium(command, words, file.private)
        case "CIR":
            if words[:1] and words[0].upper() == "EDG":
                return
            if words[:1] and words[0].upper() in ("OBS", "HOL"):
                raise line.error("CIR", words[0], "a round opening without a hole")
            block.semi_diameter = command.numbers(words)[0]
        case _:
            block.put(command, command.numbers(words)[0])


def _named(file: File, command: Command) -> Block:
    """Return the surface that the first word of a command names: Sk, SO or SI."""
    word = command.words[0].upper()
    place = {"SO": 0, "SI": len(file.blocks) - 1}.get(word, int(word[1:]) if word[1:].isdecimal() else -1)
    if not 0 <= place < len(file.blocks):
        raise command.line.error(command.name, word, f"a surface from S0 to S{len(file.blocks) - 1}")
    return file.blocks[place]


def _new_surface(file: File, command: Command) -> None:
    name, line = command.name, command.line
    if (name == "SO") != (not file.blocks) or file.closed:
        raise line.error(name, "(here)", "one object SO, then surfaces S, then one image SI")
    far = name == "SO" and command.words[1:2] and command.words[1].lower() in ("inf", "infinity")
    numbers = command.numbers((command.words[0], str(INFINITE)) if far else command.words[:2], 2)
    if file.radii is None and numbers[0] != 0:
        file.radii = bool(file.pupil) and abs(numbers[0]) * (file.pupil or 0.0) > 2
        why = (
            "radii: a sphere of that curvature would be smaller than the pupil"
            if file.radii
            else "curvatures, not radii"
        )
        assume(file.file, f"line {line.number}: no RDM before it; the first numbers of surfaces are taken as {why}")
    first = numbers[0]
    block = Block(
        line, str(len(file.blocks)), curvature=first if not (file.radii and first) else 1 / first, thickness=numbers[1]
    )
    if name == "SO" and block.thickness >= INFINITE:
        block.thickness = math.inf
    block.medium = medium(command, command.words[2:], file.private)
    file.blocks.append(block)
    file.closed = name == "SI"
