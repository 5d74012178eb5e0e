"""CODE V sequence files (.seq): commands of three letters, and S lines with radius or curvature, thickness, glass."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.lens.glass import figures_of_code
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
from neurolens.optics.readers.glasses import by_indices, named_glass
from neurolens.optics.readers.source import Line, ReadOptions, assume, by_word, read_lines, warn

UNITS = {"M": "mm", "C": "cm", "I": "in"}
ROOM = 20  # degrees Celsius, at which catalogues measure
FIELDS = ("XAN", "YAN", "XIM", "YIM", "XRI", "YRI", "XOB", "YOB")
# Settings, weights, labels, control codes of variables, tolerances: written to most files, and no ray depends on them.
HARMLESS = frozenset(
    """LEN WTW WTF WTA INI DOR PRE DER UID SLB GO END CCY CCX THC GLC KC AC BC CC DC EC FC GC HC JC DLT
    DLN DLF DLR IRR SCC KXC""".split()
)
# What changes rays and is not read, with what is expected in its place.
REFUSED = by_word(
    ("NA", "EPD, FNO or NAO to size the stop"),
    ("MOD", "a surface that is no ideal lens (a module)"),
    ("GRT DIF DOE HOE HOL", "a surface that is no grating, hologram or diffractive surface"),
    ("GRN", "a medium without a gradient index"),
    ("FRN SPL UDS NSS", "a surface that is no Fresnel surface, spline, surface of the user or non-sequential part"),
    ("INT", "a surface without a file of its deformations"),
    ("RMD", "a surface that refracts: the lens model has no mirrors"),
    ("BEN RET GLB", "tilts and decentres by XDE to CDE, DAR and REV: a bend belongs to a mirror"),
    ("REX REY ELX ELY REC ELL", "a round opening (CIR)"),
    ("INS DEL FLY SCA", "surfaces as they are: commands that edit a lens are not carried out"),
)
VIGNETTING = frozenset(["VUX", "VLX", "VUY", "VLY"])
SHAPES = ("SPH", "CON", "ASP", "CYL", "YTO", "XTO", "AAS")
# How the names of a special surface's coefficients begin, before the power of the first term.
SPECIAL = {"ODD": "AR", "QBF": "QB", "QCN": "QC"}
ALONG = ("KX", "KY", "AR", "BR", "CR", "DR", "AP", "BP", "CP", "DP")  # of AAS
# Coefficients of an ASP surface: r^4, r^6, ... r^20.
LETTERS = {letter: 4 + 2 * k for k, letter in enumerate("ABCDEFGHJ")}
NONE_BUT_0 = ("CUF", "XOD", "YOD", "ZOD", "ADX", "ADY", "ARO")
TURNS = ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE")
# Solves of a surface, with what they give.
SOLVES = {**dict.fromkeys(("UMY", "UCY", "IMY", "ICY"), "curvature"), **dict.fromkeys(("HMY", "HCY"), "thickness")}
READ = (
    *"RDY CUY RDX CUX THI GLA STO SPS SCO K CIR PIM DAR REV".split(),
    *(*SHAPES, *ALONG, *LETTERS, *NONE_BUT_0, *TURNS, *SOLVES),
)
ZOOMED = ("THI", "EPD", "FNO", "CIR", "TIT")
# Control codes, fields, vignetting factors, weights and wavelengths, which move no ray in a zoom.
NOT_ZOOMED = frozenset(
    """THC CCY GLC KC VUX VLX VUY VLY XAN YAN XIM YIM XRI YRI XOB YOB WTF WTW WTA WL REF DER""".split()
)
_THICKEST = 5.0  # of a glass, over the radius of its spheres; the library has none above 1.1
_MAX_COMMAND = 100_000  # characters of one command with all its continuation lines


@dataclass(frozen=True)
class Command:
    """One command: its word as written, the three letters of it that count, its further words, where it begins."""

    word: str
    name: str
    words: tuple[str, ...]
    line: Line

    def numbers(self, words: Sequence[str] | None = None, least: int = 1) -> list[float]:
        """Return its values as numbers."""
        return self.line.numbers(self.name, self.words if words is None else words, least)

    def first(self, words: Sequence[str] | None = None) -> float:
        """Return the first of its values."""
        return self.line.first(self.name, self.words if words is None else words)


def commands(lines: Sequence[Line]) -> Iterator[Command]:
    """Yield the commands of a file: "!" begins a comment, ";" ends a command, "&" at the end of a line continues it."""
    text, start = "", None
    for line in lines:
        bare = _outside_quotes(line.text, "!")[0]
        start = start or line
        if bare.rstrip().endswith("&"):
            text += bare.rstrip()[:-1] + " "
            if len(text) > _MAX_COMMAND:
                raise start.error("&", f"({len(text)} characters)", f"at most {_MAX_COMMAND} characters in a command")
            continue
        for part in _outside_quotes(text + bare, ";"):
            words = [m[1] or m[2] or m[0] for m in re.finditer(r"'([^']*)'|\"([^\"]*)\"|\S+", part)]
            if words:
                yield Command(words[0], words[0].upper()[:3], tuple(words[1:]), start)
        text, start = "", None
    if text.strip():
        raise lines[-1].error("&", "(the file ends)", "a line that continues the command")


def _outside_quotes(text: str, mark: str) -> list[str]:
    """Return a text split at a mark that stands outside quotes."""
    parts, quote, begin = [], "", 0
    for place, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter == mark:
            parts.append(text[begin:place])
            begin = place + 1
    return [*parts, text[begin:]]


@dataclass
class Block(draft.Block):
    """One surface, with what CODE V says about it."""

    kind: str = "SPH"
    curvature_x: float | None = None
    unsaid: bool = False  # whether its first number may be a radius or a curvature; it is kept as a curvature
    terms: dict[str, float] = field(default_factory=dict)
    special: dict[str, float] | None = None  # coefficients of a special surface
    turns: dict[str, float] = field(default_factory=dict)  # by the names of TURNS
    after: str = ""  # DAR or REV


@dataclass
class File(Draft):
    """The state of reading a file."""

    kind: str = "CODE V"
    blocks: list[Block] = field(default_factory=list)
    closed: bool = False  # whether the image has come
    zoom: Positions = field(default_factory=Positions)
    radii: bool | None = None
    fields: dict[str, list[float]] = field(default_factory=dict)
    private: dict[str, tuple[Command, list[float]]] = field(default_factory=dict)  # a row of PRV, its wavelengths in nm
    private_nm: list[float] | None = None
    waves_nm: list[float] = field(default_factory=list)
    reference: int = 1


def read_seq(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a CODE V sequence file.

    Raises:
        InputError: see the module; also for mirrors and everything else that the lens model cannot represent.
    """
    file = File(str(path))
    for command in commands(read_lines(path)):
        if file.private_nm is not None:
            _private(file, command)
        elif command.name == "ZOO":
            _zoom(file, command)
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


def _private(file: File, command: Command) -> None:
    """Read a command inside PRV: PWL gives wavelengths, each row a glass by its name; END closes."""
    if command.name == "END":
        file.private_nm = None
    elif command.name == "PWL":
        file.private_nm = command.numbers()
    elif not file.private_nm:
        raise command.line.error("PRV", command.name, "PWL and wavelengths before the glasses")
    else:
        file.private[command.word.strip("'\"")] = command, file.private_nm


def _system(file: File, command: Command) -> bool:
    """Carry out a command of the whole system; False where it is no such command."""
    name, words, line = command.name, command.words, command.line
    match name:
        case "RDM":
            file.radii = not (words and words[0].upper() in ("N", "NO"))
        case "TIT" if words and words[0].upper().startswith("Z") and words[0][1:].isdecimal():
            file.zoom.titles[int(words[0][1:]) - 1] = " ".join(words[1:]).strip("\"' ")
        case "TIT":
            file.name = " ".join(words).strip("\"' ")
        case "DIM":
            unit = words[0].upper()[:1] if words else ""
            if unit not in UNITS:
                raise line.error("DIM", unit, "M (mm), C (cm) or I (inch)")
            file.unit = UNITS[unit]
        case "EPD" | "FNO" | "NAO":
            value = line.positive(name, words)
            file.pupil, file.f_number, file.object_na = (value if name == n else None for n in ("EPD", "FNO", "NAO"))
        case "TEM":
            if abs(command.first() - ROOM) > 5:
                warn(file.file, f"indices are those at {ROOM} degrees, not at {' '.join(words)}")
        case "WL":
            file.waves_nm = command.numbers()
        case "REF":
            file.reference = int(command.first())
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
    if words and re.fullmatch("S([0-9]+|O|I)", words[0].upper()):
        block, words = _named(file, command), words[1:]
        if words and words[0].upper().startswith("Z") and name == "THI":
            _one_gap(file, command)
            return
    if block is None:
        raise line.error(name, " ".join(words), "a surface (SO or S) before it")
    match name:
        case "STO":
            block.stop = True
        case "PIM":  # behind the image, too, it speaks of the last surface
            file.blocks[-2 if file.closed else -1].solved = not (words and words[0].upper() in ("N", "NO"))
        case "GLA":
            block.medium = medium(command, words, file.private)
        case "SPS" | "SCO":
            _special_data(block, command, words)
        case "CIR" if words and words[0].upper() == "EDG":
            pass
        case "CIR":
            if words and words[0].upper() in ("OBS", "HOL"):
                raise line.error("CIR", words[0], "a round opening without a hole")
            block.semi_diameter, block.aperture = command.first([w for w in words if w.upper() != "CLR"]), True
        case "RDY" | "RDX" | "CUY" | "CUX":
            value = command.first(words)
            curvature = value if name.startswith("C") or value == 0 else 1 / value
            setattr(block, "curvature" if name.endswith("Y") else "curvature_x", curvature)
            block.unsaid &= name.endswith("X")
        case "THI":
            block.thickness = command.first(words)
        case "K" | "KY":
            block.conic = command.first(words)
        case _ if name in SHAPES:
            block.kind = name
        case _ if name in NONE_BUT_0:
            if value := command.first(words):
                raise line.error(name, value, "0: Fresnel surfaces, pivots of tilts, decentred openings are not read")
        case _ if name in SOLVES:
            if not getattr(block, SOLVES[name]):
                raise line.error(name, " ".join(words), f"a {SOLVES[name]} beside it: solves are not carried out")
        case _ if name in TURNS:
            block.turns[name] = command.first(words)
        case "DAR" | "REV":
            block.after = name
        case _:
            block.terms[name] = command.first(words)


def _special_data(block: Block, command: Command, words: Sequence[str]) -> None:
    """Read SPS with a type and a normalisation radius, or SCO with the name and value of a coefficient."""
    name = words[0].upper() if words else ""
    if command.name == "SCO":
        if block.special is None:
            raise command.line.error("SCO", name, "SPS before it")
        block.special[name] = command.first(words[1:])
    elif name in SPECIAL:
        block.kind, block.special = name, {"NRADIUS": command.first(words[1:])} if words[1:] else {}
    else:
        expected = f"one of {', '.join(SPECIAL)}: other special surfaces are not read"
        raise command.line.error("SPS", name or "(none)", expected)


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
    first, thickness = command.numbers((command.words[0], str(INFINITE)) if far else command.words[:2], 2)[:2]
    curvature, unsaid = 1 / first if file.radii and first else first, file.radii is None and first != 0
    block = Block(line, str(len(file.blocks)), curvature=curvature, thickness=thickness, unsaid=unsaid)
    if name == "SO" and block.thickness >= INFINITE:
        block.thickness = math.inf
    block.medium = medium(command, command.words[2:], file.private)
    file.blocks.append(block)
    file.closed = name == "SI"


def _zoom(file: File, command: Command) -> None:
    """Read ZOO with the count of positions, or with a quantity and one value for each position."""
    words, line, zoom = command.words, command.line, file.zoom
    if words and words[0].isdecimal():
        zoom.begin(line, "ZOO", int(words[0]))
        return
    name = words[0].upper()[:3] if words else ""
    if name in NOT_ZOOMED or (name == "TIT" and zoom.count):
        return
    if name not in ZOOMED or not zoom.count:
        expected = f"the count of positions first, then one of {', '.join(ZOOMED)}: other zooms are not read"
        raise line.error("ZOO", name, expected)
    surface, values, last = -1, words[1:], len(file.blocks) - 1
    if name in ("THI", "CIR"):
        match = re.fullmatch(r"S([0-9]{1,4}|O)", values[0].upper()) if values else None
        surface = int(match[1].replace("O", "0")) if match else last + 1
        if surface > last:
            raise line.error(f"ZOO {name}", " ".join(values[:1]), f"a surface from S0 to S{last}")
        values = values[1:]
        if name == "THI" and not values:
            return  # the values come one by one: THI Sk Zn value
    numbers = command.numbers(values, zoom.count)
    if len(numbers) != zoom.count or (name != "THI" and min(numbers) <= 0):
        raise line.error(f"ZOO {name}", " ".join(values), f"{zoom.count} values, one a position")
    for place, number in enumerate(numbers):
        if name == "THI":
            zoom.gaps[surface, place] = number
        elif name == "CIR":
            zoom.rims[surface, place] = number, line
        else:
            (zoom.pupil if name == "EPD" else zoom.f_number)[place] = number


def _one_gap(file: File, command: Command) -> None:
    """Read THI Sk Zn value."""
    surface, place = command.words[0][1:], command.words[1][1:]
    count = file.zoom.count
    if not (surface.isdecimal() and place.isdecimal() and int(surface) < len(file.blocks) and 1 <= int(place) <= count):
        raise command.line.error("THI", " ".join(command.words[:2]), f"Sk Zn with n from 1 to {count}")
    file.zoom.gaps[int(surface), int(place) - 1] = command.first(command.words[2:])


def _settle_radii(file: File) -> None:
    """Tell by pupil and glasses whether the first numbers of surfaces are radii, where no RDM says it."""
    if not (unsaid := [block for block in file.blocks if block.unsaid]):
        return
    pupil = (file.pupil or 0.0) * max(abs(block.curvature) for block in unsaid) / 2
    sides = ((a.thickness, b) for a, c in pairwise(file.blocks) if a.medium for b in (a, c) if b.unsaid)
    glass = max((thickness * abs(b.curvature) for thickness, b in sides), default=0.0) / _THICKEST
    what = "pupil" if pupil > 1 else "glass" if glass > 1 else ""
    for block in unsaid if what else ():
        block.curvature = 1 / block.curvature
    why = f"radii: a sphere of that curvature would be smaller than the {what}" if what else "curvatures, not radii"
    line = unsaid[0].start.number
    assume(file.file, f"line {line}: no RDM before it; the first numbers of surfaces are taken as {why}")


def _complete(file: File) -> None:
    """Set what is known only when all surfaces are read."""
    _settle_radii(file)
    first, *middle, image = file.blocks
    if not middle:
        raise InputError(file.file, "S", "(no surface)", "at least one surface between object and image")
    if image.curvature:
        warn(file.file, "the image surface is curved; the film is taken as plane")
    last, defocus = middle[-1], image.thickness  # the thickness of SI says how far from it the image lies
    last.thickness += defocus
    for k, block in enumerate(middle[:-1], start=1):
        if block.solved:
            raise block.start.error("PIM", f"(on surface {k})", "the last surface")
    for block in (*middle, image):
        block.turn = _turn(block)
    file.rows = placed([b.row(shape_of(b)) for b in middle], [*middle, image])
    file.half_field_deg = _edge(file, ("XAN", "YAN"))
    file.image_radius = _edge(file, ("XIM", "YIM"), ("XRI", "YRI"))
    if _edge(file, ("XOB", "YOB")) and not file.half_field_deg:
        warn(file.file, "the field is given as an object height: left out")

    def solve(gaps: list[float], place: int) -> bool:
        zoomed = (len(middle), place) in file.zoom.gaps
        gaps[-2] += defocus if zoomed else 0.0
        return zoomed or not last.solved

    file.states = file.zoom.states(file.blocks, "position", "ZOO CIR", solve)
    file.object_distance, file.object_medium = first.thickness, first.medium
    if file.f_number is not None and math.isfinite(first.thickness):
        assume(file.file, f"FNO {file.f_number:g} is taken as the f-number at the image of the near object")
        file.image_f_number, file.f_number = file.f_number, None
    primary = file.waves_nm[file.reference - 1] if 0 < file.reference <= len(file.waves_nm) else 0.0
    file.wavelengths_nm = primary_first(file.waves_nm, primary)
    file.film_given = not (last.solved and last.thickness == defocus)


def _turn(block: Block) -> Turn | None:
    """Return what moves and turns the local axes: ADE and BDE are left-handed, CDE is right-handed."""
    x, y, z, a, b, c = (block.turns.get(name, 0.0) for name in TURNS)
    if not any((x, y, z, a, b, c)):
        return None
    return Turn(Placement((x, y, z), (-a, -b, c)), returns=block.after == "DAR", undoes=block.after == "REV")


def _edge(file: File, *pairs: tuple[str, str]) -> float | None:
    """Return the field point farthest from the axis; None where the file has no field of that kind."""
    far = 0.0
    for x, y in pairs:
        across, up = file.fields.get(x, []), file.fields.get(y, [])
        longest = max(len(across), len(up))
        across, up = across + [0.0] * (longest - len(across)), up + [0.0] * (longest - len(up))
        far = max([far, *map(from_axis_deg if y == "YAN" else math.hypot, across, up)])
    return far or None


def medium(
    command: Command, words: Sequence[str], private: Mapping[str, tuple[Command, Sequence[float]]]
) -> MediumFields:
    """Return the fields of a surface for the medium behind it.

    It is a name, "NAME_MAKER", a code, n:V, n V, or nothing for air.
    """
    if not words or words[0].upper() in ("AIR", ""):
        return {}
    word = words[0]
    if word.upper() == "REFL":
        raise command.line.error(command.name, word, "a glass: the lens model has no mirrors")
    if word in private:
        return {**_private_glass(*private[word]), "material": word}
    pair = word.split(":")
    if len(pair) == 2:
        n_d, V_d = command.numbers(pair, 2)
        return {"n_d": n_d, "V_d": V_d}
    if code := figures_of_code(word):
        return {"n_d": code[0], "V_d": code[1]}
    if re.fullmatch(r"[0-9.]+(e[+-]?[0-9]+)?", word, re.IGNORECASE):
        numbers = command.numbers(words[:2])
        return {"n_d": numbers[0], "V_d": numbers[1] if len(numbers) > 1 else None}
    name, _, maker = word.rpartition("_")
    makers = [maker.upper()] if name else []
    place = f"line {command.line.number}, glass"
    known = named_glass(name or word, command.line.file, place, makers, text=word if name else None)
    return {**known, "material": word}


def _private_glass(command: Command, wavelengths_nm: Sequence[float]) -> MediumFields:
    """Return the fields of a surface from a row of a PRV block: indices at the wavelengths of its PWL line."""
    if command.words and not re.match(r"[-+.0-9]", command.words[0]):
        expected = "an index at each wavelength of PWL: formulas of private glasses are not read"
        raise command.line.error(f"PRV {command.word}", command.words[0], expected)
    return by_indices(command.line, f"PRV {command.word}", command.numbers(least=len(wavelengths_nm)), wavelengths_nm)


def shape_of(block: Block) -> ShapeFields:
    """Return the radius and the figure of a surface, for `Block.row`.

    YTO is a curve in y (curvature CUY, K, A y^4, ...) turned about an axis along y at 1 / CUX; XTO is the same in x;
    where one of both curvatures is zero it is a cylinder. AAS with its two conics K and KX is a biconic.
    """
    if block.special is not None:
        return _special(block)
    if block.kind == "AAS":
        return _biconic(block)
    terms = {LETTERS[letter]: value for letter, value in block.terms.items() if value}
    if block.kind in ("SPH", "CON") and terms:
        raise block.start.error(block.kind, f"(with coefficients {', '.join(block.terms)})", "ASP before coefficients")
    if block.kind == "SPH" and block.conic:
        raise block.start.error("K", block.conic, "CON or ASP before a conic constant")
    if block.kind in ("SPH", "CON", "ASP"):
        if block.curvature_x not in (None, block.curvature):
            raise block.start.error("CUX", block.curvature_x, "a cylinder (CYL, YTO or XTO)")
        return block.rotational(sorted(terms.items()))
    own, other = block.curvature, block.curvature_x or 0.0
    if block.kind == "XTO":
        own, other = other, own
    axes = ("x", "y") if block.kind == "XTO" else ("y", "x")
    if own or terms:
        curve = replace(block, curvature=own).rotational(sorted(terms.items()))
        return curve | {"cylinder": axes[0]} | ({"across": (1 / other, None)} if other else {})
    if block.conic and other:  # K belongs to the curve that is turned
        raise block.start.error("K", block.conic, "0, as this cylinder's curve is a circle")
    return {"radius_mm": 1 / other, "cylinder": axes[1]} if other else {"radius_mm": math.inf}


def _biconic(block: Block) -> ShapeFields:
    """Read AAS; its higher terms are AR to DR, with their shares in x and y AP to DP."""
    conic_x = block.terms.get("KX", 0.0)
    for name, value in block.terms.items():
        if value and name != "KX" and not name.endswith("P"):
            raise block.start.error(f"{name} of AAS", value, "0: a biconic has no terms of higher order")
    return block.crossed(block.rotational(), 1 / block.curvature_x if block.curvature_x else math.inf, conic_x)


def _special(block: Block) -> ShapeFields:
    """Read ODD, a sum of ARn r^n over NRADIUS^n (0: none), or QBn and QCn, n = 4 + 2 m, of Forbes's sums."""
    kind, values = block.kind, dict(block.special or {})
    radius, block.conic = values.pop("NRADIUS", 0.0), values.pop("K", 0.0)
    found: dict[int, float] = {}
    for name, value in values.items():
        match = re.fullmatch(SPECIAL[kind] + "([0-9]{1,2})", name)
        power = int(match[1]) if match else 0
        if not match or (kind != "ODD" and (power < 4 or power % 2)) or (power < 2 and value):
            first = "AR2, AR3, ..." if kind == "ODD" else f"{SPECIAL[kind]}4, {SPECIAL[kind]}6, ..."
            raise block.start.error(f"SCO of SPS {kind}", name, f"K, NRADIUS or {first}")
        found[power] = value
    if not (radius == 0 or radius >= LEAST_RADIUS):
        raise block.start.error(
            f"NRADIUS of SPS {kind}", radius, f"a normalisation radius of at least {LEAST_RADIUS:g}"
        )
    if kind == "ODD":
        return block.rotational((n, a / (radius or 1.0) ** n) for n, a in sorted(found.items()))
    if kind == "QBF" and block.conic:
        raise block.start.error(f"conic of SPS {kind}", block.conic, "0: Qbfs departs from a sphere")
    if not radius > 0:
        raise block.start.error(f"NRADIUS of SPS {kind}", radius, "a normalisation radius above 0")
    message = f"SPS {kind}: coefficient {SPECIAL[kind]}n is taken as that of Forbes's m = (n - 4) / 2"
    assume(block.start.file, f"line {block.start.number}: {message}")
    terms = [found.get(n, 0.0) for n in range(4, max(found, default=2) + 1, 2)]
    return block.q_type(f"SPS {kind}", kind == "QCN", terms, radius)
