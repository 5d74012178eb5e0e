"""Parser state of a Zemax file: surfaces, configurations, and which keywords change rays."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from neurolens.base.errors import InputError
from neurolens.readers import draft
from neurolens.readers.draft import INFINITE, State
from neurolens.readers.source import MAX_POWER, Line, assume, by_word

# Settings of the program, and what its editor shows of a surface: written to most files, and no ray depends on them.
HARMLESS = frozenset(
    """VERS PFIL LANG GFAC RAIM PUSH SDMA OMMA ROPD PICB PZUP FWGN FWGT WWGT WWGN POLS GLRS GSTD NSCD COFN LUID EFFL
    HYPR DBDT HIDE MIRR SLAB POPS FIMP MEMA OEMA VDSZ VPAR PPAR GLCZ""".split()
)
# Rims and stop decide which rays pass, not the factors that a designer chose.
VIGNETTING = frozenset("VDXN VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN".split())
# Of a surface: what changes rays, and the lens model has not.
REFUSED = by_word(
    ("OBSC SQOB ELOB USOB SPID", "no obscuration: the lens model has none"),
    ("SCBD", "no tilt and no decentre of a surface: the lens model has none"),
)
# Operands of the multi-configuration editor that move no ray: fields, wavelengths, vignetting factors, comments.
CONFIGURATION = frozenset("MOFF MCOM XFIE YFIE FLWT FVDX FVDY FVCX FVCY FVAN WAVE WLWT PRWV GCRS".split())


TYPES = tuple("STANDARD EVENASPH ODDASPHE XASPHERE XOSPHERE TOROIDAL BICONICX PARAXIAL COORDBRK".split())
MAX_EXTRAS = 240
_DEEPEST = 1000  # sag of an asphere over its rim
_EVEN = 8  # terms of EVENASPH by its definition; other programs write more
Q_TYPE = "Q"  # what the names of Q-type aspheres, and of no other type, begin with


@dataclass
class Block(draft.Block):
    """One SURF block. Numbers stay with the line they come from."""

    thickness: float = math.nan  # until DISZ has been read
    kind: str = "STANDARD"
    automatic: bool = True  # whether the program sized the rim from the rays
    bends: Line | None = None  # where a curvature other than 0 is given
    glass: Line | None = None  # where the medium is given
    clear: float | None = None  # semi-diameter of an aperture, which rules over the other
    aperture: bool = False
    parameters: dict[int, tuple[float, Line]] = field(default_factory=dict)
    extra: dict[int, tuple[float, Line]] = field(default_factory=dict)
    solve: tuple[str, list[float], Line] | None = None

    def parameter(self, n: int) -> float:
        return self.parameters.pop(n, (0.0, self.start))[0]

    def extras(self, first: int = 1) -> tuple[float, list[float]]:
        """Normalisation radius and coefficients of a surface, whose count stands in the extra data at `first`.

        Raises:
            InputError: a count that is not whole, or beyond `MAX_EXTRAS`; a radius that is not above 0.
        """
        (count, line), (radius, _) = (self.extra.pop(first + k, (k, self.start)) for k in (0, 1))
        if not (0 <= count <= MAX_EXTRAS and count == int(count)):
            raise line.error(f"XDAT {first} of {self.kind}", count, f"how many terms there are, at most {MAX_EXTRAS}")
        if not radius > 0:
            raise line.error(f"XDAT {first + 1} of {self.kind}", radius, "a normalisation radius above 0")
        return radius, [self.extra.pop(first + 2 + k, (0.0, self.start))[0] for k in range(int(count))]


def thickness(line: Line, word: str, rest: list[str], *, is_object: bool) -> float:
    """Return a thickness; that of the object may be infinite, in words or as a number from 1e9."""
    if is_object and rest == ["INFINITY"]:
        return math.inf
    value = line.numbers(word, rest)[0]
    return math.inf if is_object and value >= INFINITE else value


def shape_of(block: Block) -> dict[str, Any]:
    """Return the radius, conic, asphere and what else describes the shape of a surface, for `Surface`.

    Even asphere: sum of PARM i r^(2 i); odd asphere: sum of PARM i r^i; the extended ones have XDAT in the place of
    PARM, and powers of r over a normalisation radius. Q-type: XDAT 1 is 0 for Qbfs and 1 for Qcon. Toroidal: CURV,
    CONI and PARM i y^(2 i - 2), i from 2, in the y-z plane, turned about an axis at PARM 1 (0 is infinity: a cylinder).
    Biconic: CURV, CONI in y, PARM 1 (a radius, 0 is infinity) and PARM 2 (a conic) in x. Paraxial, an ideal lens:
    PARM 1 is its focal length; PARM 2 counts path lengths in one way or another and moves no ray.

    Raises:
        InputError: a type, a parameter or a combination of them that the lens model cannot represent; by name and line.
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
            shape = _crossed(block)
        case "PARAXIAL":
            shape = {"radius_mm": math.inf, "focal_mm": block.parameter(1)}
            block.parameters.pop(2, None)
            if not shape["focal_mm"] or block.bends:
                raise block.start.error("PARAXIAL", shape["focal_mm"], "PARM 1, a focal length other than 0, no CURV")
        case "COORDBRK":
            shape = block.rotational()  # harmless where every tilt and decentre is 0, which is checked below
    for name, table in (("PARM", block.parameters), ("XDAT", block.extra)):
        for n, (value, line) in table.items():
            # The second extra value of a toroid is a normalisation radius, with nothing to normalise.
            if value != 0 and not (block.kind == "TOROIDAL" and name == "XDAT" and n == 2):
                raise line.error(f"{name} {n} of {block.kind}", value, "0: the lens model has no such term")
    for word, given in (("CURV", block.bends), ("GLAS", block.glass)):
        if block.kind == "COORDBRK" and given is not None:
            raise given.error(f"{word} of COORDBRK", given.text.strip(), "none: a coordinate break is no surface")
    return shape


def _q_type(block: Block) -> dict[str, Any]:
    form, (radius, values) = block.extra.pop(1, (0.0, block.start))[0], block.extras(2)
    if form not in (0, 1):
        raise block.start.error(block.kind, f"(XDAT 1 {form:g})", "0 (Qbfs) or 1 (Qcon)")
    if form == 1:
        assume(block.start.file, f"line {block.start.number}: {block.kind}: 1 in XDAT 1 is taken to mean Qcon")
    return block.q_type(block.kind, form == 1, values, radius)


def _crossed(block: Block) -> dict[str, Any]:
    """Return a toroidal or biconic surface."""
    biconic, radius_x = block.kind == "BICONICX", block.parameter(1)
    conic_x = block.parameter(2) if biconic else None
    curve = block.rotational(() if biconic else [(2 * i - 2, block.parameter(i)) for i in range(2, 9)])
    return block.crossed(curve, radius_x or math.inf, conic_x)


MAX_CONFIGURATIONS = 200
OPERANDS = ("THIC", "APER", "SDIA", "LTTL")


@dataclass
class Zoom:
    """The configurations while they are read; operand values by configuration (from 0)."""

    begun: bool = False
    count: int = 1
    titles: dict[int, str] = field(default_factory=dict)
    thickness: dict[tuple[int, int], float] = field(default_factory=dict)  # (surface, configuration)
    aperture: dict[int, float] = field(default_factory=dict)
    semi_diameter: dict[tuple[int, int], tuple[float, Line]] = field(default_factory=dict)

    def begin(self, line: Line) -> None:
        """MNUM: how many configurations, and which is the one in the table."""
        self.count, self.begun = int(line.numbers("MNUM", line.words[1:2])[0]), True
        if not 1 <= self.count <= MAX_CONFIGURATIONS:
            raise line.error("MNUM", self.count, f"1 to {MAX_CONFIGURATIONS} configurations")

    def read(self, line: Line, n_blocks: int) -> None:
        """One operand: name, surface, configuration (from 1), value."""
        word, rest = line.words[0].upper(), line.words[1:]
        if word in CONFIGURATION or word == "BLNK":
            return
        if self.count == 1:
            return  # what one configuration sets stands in the table
        if word not in OPERANDS:
            expected = f"one of {', '.join(OPERANDS)}: other things that change with the configuration are not read"
            raise line.error(word, "(unknown operand)", expected)
        numbers = line.numbers(word, rest[:2], 2)
        surface, place = int(numbers[0]), int(numbers[1]) - 1
        if not 0 <= place < self.count or not 0 <= surface < n_blocks:
            raise line.error(word, " ".join(rest[:2]), f"a surface below {n_blocks}, a configuration to {self.count}")
        if word == "LTTL":
            quoted = re.search('"([^"]*)"', line.text)
            self.titles[place] = (quoted[1] if quoted else " ".join(rest[2:3])).strip() or f"configuration {place + 1}"
            return
        if word == "THIC":
            self.thickness[surface, place] = thickness(line, word, rest[2:3], is_object=surface == 0)
        elif word == "APER":
            self.aperture[place] = line.positive(word, rest[2:3])
        else:
            self.semi_diameter[surface, place] = (line.positive(word, rest[2:3]), line)


def draft_states(zoom: Zoom, blocks: Sequence[Block], aperture_is_f_number: bool) -> Iterator[State]:
    """Return the configurations of a file, thickness solves carried out in each.

    Raises:
        InputError: a semi-diameter that changes anywhere but at the stop.
    """
    if zoom.count == 1:
        return
    for place in range(zoom.count):
        full = [zoom.thickness.get((k, place), b.thickness) for k, b in enumerate(blocks)]
        solved = {k for k, b in enumerate(blocks) if b.solve}
        film_given = True
        for k in sorted(solved):
            word, numbers, line = blocks[k].solve or ("", [], blocks[k].start)
            if word == "MAZH":
                if k != len(blocks) - 2:
                    raise line.error(word, f"(on surface {k})", "the last surface, in a file with configurations")
                film_given = False
                continue
            reference, total = int(numbers[0]), numbers[1]
            if not 0 < reference < k:
                raise line.error(word, reference, f"a surface in front of surface {k}")
            full[k] = total - (full[reference] if word == "TCOM" else sum(full[reference:k]))
        stop_diameter = None
        for (surface, there), (value, line) in zoom.semi_diameter.items():
            if not blocks[surface].stop:
                raise line.error("SDIA", f"(surface {surface})", "the stop: other rims cannot change")
            stop_diameter = 2 * value if there == place else stop_diameter
        changing = {k for k, _ in zoom.thickness} | solved
        size = zoom.aperture.get(place)
        if not all(map(math.isfinite, full[1:])):
            raise InputError(blocks[0].start.file, "THIC", "(infinite)", "finite thicknesses behind the object")
        yield State(
            name=zoom.titles.get(place, f"configuration {place + 1}"),
            thickness={k - 1: full[k] for k in sorted(changing) if 0 < k < len(blocks) - 1},
            pupil=None if aperture_is_f_number else size,
            f_number=size if aperture_is_f_number else None,
            stop_diameter=stop_diameter,
            object_distance=full[0],
            film_given=film_given,
        )
