"""Surface types of Zemax: what the lens model can hold of them, and an error by name for the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from neurolens.readers.assemble import UNKNOWN
from neurolens.readers.source import Line

TYPES = ("STANDARD", "EVENASPH", "ODDASPHE", "TOROIDAL", "BICONICX", "COORDBRK")
INFINITE = 1e9  # in any unit: what programs write for an object at infinity starts at 1e10


@dataclass
class Block:
    """One SURF block while it is read, in the file's unit. Numbers stay with the line they come from."""

    start: Line
    kind: str = "STANDARD"
    curvature: float = 0.0
    conic: float = 0.0
    thickness: float = math.nan  # until DISZ has been read
    semi_diameter: float = UNKNOWN
    automatic: bool = True  # whether the program sized the rim from the rays
    medium: dict[str, Any] = field(default_factory=dict)
    bends: Line | None = None  # where a curvature other than 0 is given
    glass: Line | None = None  # where the medium is given
    stop: bool = False
    clear: float | None = None  # semi-diameter of an aperture, which rules over the former
    aperture: bool = False
    parameters: dict[int, tuple[float, Line]] = field(default_factory=dict)
    extra: dict[int, tuple[float, Line]] = field(default_factory=dict)
    solve: tuple[str, list[float], Line] | None = None

    def parameter(self, n: int) -> float:
        return self.parameters.pop(n, (0.0, self.start))[0]


def thickness(line: Line, word: str, rest: list[str], *, is_object: bool) -> float:
    """A thickness; that of the object may be infinite, in words or as a number beyond all measure."""
    if is_object and rest == ["INFINITY"]:
        return math.inf
    value = line.numbers(word, rest)[0]
    return math.inf if is_object and value >= INFINITE else value


def shape_of(block: Block) -> dict[str, Any]:
    """Radius, conic, asphere and cylinder of a surface, for `Surface`.

    Even asphere: sum of PARM i r^(2 i); odd asphere: sum of PARM i r^i. Toroidal: CURV and CONI in the y-z plane,
    turned about an axis at PARM 1 (0 is infinity: a cylinder). Biconic: CURV, CONI in y, PARM 1 (a radius, 0 is
    infinity) and PARM 2 (a conic) in x.

    Raises:
        InputError: a type, a parameter or a combination of them that the lens model cannot hold; by name and line.
    """
    match block.kind:
        case "STANDARD":
            shape = _round(block, ())
        case "EVENASPH":
            shape = _round(block, tuple((2 * i, block.parameter(i)) for i in range(1, 9)))
        case "ODDASPHE":
            shape = _round(block, tuple((i, block.parameter(i)) for i in range(1, 9)))
        case "TOROIDAL":
            shape = _toroidal(block)
        case "BICONICX":
            shape = _biconic(block)
        case "COORDBRK":
            shape = _round(block, ())  # harmless where every tilt and decentre is 0, which is checked below
    for name, table in (("PARM", block.parameters), ("XDAT", block.extra)):
        for n, (value, line) in table.items():
            # The second extra value of a toroid is a normalisation radius, with nothing to normalise.
            if value != 0 and not (block.kind == "TOROIDAL" and name == "XDAT" and n == 2):
                raise line.error(f"{name} {n} of {block.kind}", value, "0: the lens model has no such term")
    for word, given in (("CURV", block.bends), ("GLAS", block.glass)):
        if block.kind == "COORDBRK" and given is not None:
            raise given.error(f"{word} of COORDBRK", given.text.strip(), "none: a coordinate break is no surface")
    return shape


def _radius(curvature: float) -> float:
    return 1 / curvature if curvature else math.inf


def _round(block: Block, terms: tuple[tuple[int, float], ...]) -> dict[str, Any]:
    for power, value in terms:
        if power == 1 and value:
            raise block.start.error("PARM 1 of ODDASPHE", value, "0: a cone's tip has no normal")
    # The conic of a plane without other terms has no effect.
    conic = block.conic if block.curvature else 0.0
    asphere = tuple((power, value) for power, value in terms if value)
    return {"radius_mm": _radius(block.curvature), "conic": conic, "asphere": asphere}


def _toroidal(block: Block) -> dict[str, Any]:
    turn = block.parameter(1)
    if turn == 0 and block.curvature == 0:
        return {"radius_mm": math.inf}
    if turn == 0:
        return {"radius_mm": _radius(block.curvature), "conic": block.conic, "cylinder": "y"}
    if block.curvature == 0:
        return {"radius_mm": turn, "cylinder": "x"}
    if math.isclose(turn * block.curvature, 1.0, rel_tol=1e-12) and block.conic == 0:
        return {"radius_mm": turn}
    found = f"(radii {_radius(block.curvature):g} in y and {turn:g} in x)"
    raise block.start.error("TOROIDAL", found, "a cylinder: one of the two radii infinite (a torus is not read)")


def _biconic(block: Block) -> dict[str, Any]:
    radius_x, conic_x = block.parameter(1), block.parameter(2)
    if radius_x == 0 and block.curvature == 0:
        return {"radius_mm": math.inf}
    if radius_x == 0:
        return {"radius_mm": _radius(block.curvature), "conic": block.conic, "cylinder": "y"}
    if block.curvature == 0:
        return {"radius_mm": radius_x, "conic": conic_x, "cylinder": "x"}
    if math.isclose(radius_x * block.curvature, 1.0, rel_tol=1e-12) and conic_x == block.conic:
        return {"radius_mm": radius_x, "conic": conic_x}
    found = f"(radii {_radius(block.curvature):g} in y and {radius_x:g} in x)"
    raise block.start.error("BICONICX", found, "a cylinder: one of the two radii infinite")
