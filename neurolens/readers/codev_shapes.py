"""Surface types of CODE V: what the lens model can hold of them, and an error by name for the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from neurolens.readers.assemble import UNKNOWN
from neurolens.readers.codev_text import Command
from neurolens.readers.source import Line

# Coefficients of an ASP surface: r^4, r^6, ... r^20.
LETTERS = {letter: 4 + 2 * k for k, letter in enumerate("ABCDEFGHJ")}
NONE_BUT_0 = ("CUF", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE")


@dataclass
class Block:
    """One surface while it is read, in the file's unit."""

    start: Line
    curvature: float = 0.0
    thickness: float = 0.0
    kind: str = "SPH"
    curvature_x: float | None = None
    conic: float = 0.0
    terms: dict[str, float] = field(default_factory=dict)
    semi_diameter: float = UNKNOWN
    medium: dict[str, Any] = field(default_factory=dict)
    stop: bool = False
    solved: bool = False  # whether the thickness is solved for the paraxial image

    def put(self, command: Command, value: float) -> None:
        """Set one figure of the surface by the name of its command."""
        match command.name:
            case "RDY" | "RDX" | "CUY" | "CUX":
                curvature = value if command.name.startswith("C") or value == 0 else 1 / value
                if command.name.endswith("Y"):
                    self.curvature = curvature
                else:
                    self.curvature_x = curvature
            case "THI":
                self.thickness = value
            case "K":
                self.conic = value
            case name if name in NONE_BUT_0:
                if value:
                    raise command.line.error(name, value, "0: Fresnel surfaces, tilts and decentres are not read")
            case letter:
                self.terms[letter] = value


def shape_of(block: Block) -> dict[str, Any]:
    """Radius, conic, asphere and cylinder of a surface, for `Surface`.

    CYL, YTO and XTO with one of their curvatures CUY and CUX zero are cylinders; a torus is an error.
    """
    terms = {LETTERS[letter]: value for letter, value in block.terms.items() if value}
    if block.kind in ("SPH", "CON") and terms:
        raise block.start.error(block.kind, f"(with coefficients {', '.join(block.terms)})", "ASP before coefficients")
    if block.kind == "SPH" and block.conic:
        raise block.start.error("K", block.conic, "CON or ASP before a conic constant")
    if block.kind in ("SPH", "CON", "ASP"):
        if block.curvature_x not in (None, block.curvature):
            raise block.start.error("CUX", block.curvature_x, "a cylinder (CYL, YTO or XTO)")
        conic = block.conic if block.curvature else 0.0
        return {"radius_mm": _radius(block.curvature), "conic": conic, "asphere": tuple(sorted(terms.items()))}
    x, y = block.curvature_x or 0.0, block.curvature
    if terms or (x and y):
        found = f"(curvatures {y:g} in y and {x:g} in x{', coefficients' if terms else ''})"
        raise block.start.error(block.kind, found, "a plain cylinder: a torus or an aspheric cylinder is not read")
    # K belongs to the curve that is turned: y of YTO and CYL, x of XTO.
    if block.conic and (block.kind == "XTO") != bool(x):
        raise block.start.error("K", block.conic, "0, as this cylinder's curve is a circle")
    return {"radius_mm": _radius(x or y), "conic": block.conic, "cylinder": "x" if x else "y" if y else None}


def _radius(curvature: float) -> float:
    return 1 / curvature if curvature else math.inf
