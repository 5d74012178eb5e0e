"""Materials and textures in a scene file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from neurolens.render.checks import Vector, check_fields, require, require_reflectance, require_size

Reflectance = Vector | str  # linear sRGB, or the name of a measured spectrum


@dataclass(frozen=True)
class ReflectanceSettings:
    """A measured reflectance: `spectrum` = [[nm, value], ...], or a CSV `file` beside the scene file with such rows.

    Values from 0 to 1 at increasing wavelengths that cover those of the camera, linear in between.
    """

    spectrum: tuple[tuple[float, float], ...] | None = None
    file: Path | None = None

    def __post_init__(self) -> None:
        one = (self.spectrum is None) != (self.file is None)
        require(one, "spectrum", "(missing)" if self.file is None else "(given)", "either spectrum or file")


@dataclass(frozen=True)
class Texture:
    """A pattern on flat surfaces, in metres along them, or on meshes with texture coordinates.

    kind "checker": squares of `cell_m` in two `colours`. kind "grid": lines `line_m` wide every `cell_m`, the first
    colour for the lines. kind "image": the picture `file` (beside the scene file), repeated every `size_m` (width,
    height); without `size_m` it fills the rectangle, or lies on a mesh as the mesh's texture coordinates say.
    """

    kind: Literal["checker", "grid", "image"]
    colours: tuple[Vector, Vector] | None = None
    cell_m: float | None = None
    line_m: float | None = None
    file: Path | None = None
    size_m: tuple[float, float] | None = None

    _FIELDS = {
        "checker": (("colours", "cell_m"), ()),
        "grid": (("colours", "cell_m", "line_m"), ()),
        "image": (("file",), ("size_m",)),
    }

    def __post_init__(self) -> None:
        needed, optional = self._FIELDS[self.kind]
        check_fields(self, f"a {self.kind} texture", needed, optional)
        for colour in self.colours or ():
            require_reflectance("colours", colour)
        if self.cell_m is not None:
            require_size("cell_m", self.cell_m)
            if self.line_m is not None:
                require(0 < self.line_m < self.cell_m, "line_m", self.line_m, "above 0 and below cell_m")
        for size in self.size_m or ():
            require_size("size_m", size)


@dataclass(frozen=True)
class Material:
    """How a surface scatters light. A `reflectance` is a colour, or the name of one of the scene's `reflectances`.

    kind "diffuse": Lambert of `reflectance` or `texture`. kind "glossy": a rough coat (GGX of `roughness`, Fresnel
    reflectance `specular` head on) over a diffuse base of `reflectance` or `texture` (black: bare metal).
    kind "mirror": `reflectance`. kind "glass": smooth, index `n_d`, Abbe number `V_d` (left out: no dispersion); it
    absorbs so much that `transmittance` of the light is left after `transmittance_depth_m` (Beer and Lambert). Only
    glass dims: what stands inside it is seen undimmed. Paths step 0.1 mm off a surface: thinner glass is passed over.
    """

    kind: Literal["diffuse", "glossy", "mirror", "glass"]
    reflectance: Reflectance | None = None
    texture: str | None = None
    specular: Vector | None = None
    roughness: float | None = None
    n_d: float | None = None
    V_d: float | None = None
    transmittance: Vector | None = None
    transmittance_depth_m: float | None = None

    _FIELDS = {
        "diffuse": ((), ("reflectance", "texture")),
        "glossy": (("specular", "roughness"), ("reflectance", "texture")),
        "mirror": (("reflectance",), ()),
        "glass": (("n_d",), ("V_d", "transmittance", "transmittance_depth_m")),
    }

    def __post_init__(self) -> None:
        needed, optional = self._FIELDS[self.kind]
        check_fields(self, f"a {self.kind} material", needed, optional)
        if "texture" in optional:
            one = (self.reflectance is None) != (self.texture is None)
            require(one, "reflectance", self.reflectance or "(missing)", "either reflectance or texture")
        for field in ("reflectance", "specular"):
            value = getattr(self, field)
            if value is not None and not isinstance(value, str):
                require_reflectance(field, value)
        if self.roughness is not None:
            require(0.02 <= self.roughness <= 1, "roughness", self.roughness, "a number from 0.02 to 1")
        self._check_glass()

    def _check_glass(self) -> None:
        if self.n_d is not None:
            require(1 < self.n_d <= 4, "n_d", self.n_d, "a number above 1, at most 4")
        if self.V_d is not None:
            require(10 <= self.V_d < math.inf, "V_d", self.V_d, "a number from 10")
        depth, left = self.transmittance_depth_m, self.transmittance
        both = (depth is None) == (left is None)
        field = "transmittance" if left is None else "transmittance_depth_m"
        require(both, field, "(missing)", "given: the light that is left, and after how many metres")
        if depth is not None:
            require_size("transmittance_depth_m", depth)
        if left is not None:
            ok = all(1e-6 <= x <= 1 for x in left)
            require(ok, "transmittance", left, "three numbers from 0.000001 to 1")
