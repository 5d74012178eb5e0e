"""What a scene file says: frozen dataclasses, one for each kind of table, checked one by one.

Metres, y up, colours linear sRGB. The reader is `neurolens.render.scenefile`. Shapes are in `neurolens.render.shapes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from neurolens.render.checks import (
    BLACK,
    Vector,
    check_fields,
    length,
    require,
    require_emission,
    require_finite,
    require_positive,
    require_reflectance,
)
from neurolens.render.filmsettings import FilmSettings
from neurolens.render.illuminants import IlluminantSettings
from neurolens.render.shapes import Box, MeshSettings, Plane, Quad, Room, Sphere


@dataclass(frozen=True)
class CameraSettings:
    """Where the camera stands and what it takes; which camera it is, the caller of `render` decides.

    Attributes:
        position_m: film-plane centre. look_at_m: a point on the optical axis. up: points to the picture's top.
        focus_m: distance from film to the object in focus. f_number: None leaves it to the lens.
        blades, blade_rotation_deg, blade_curvature, aperture_mask: shape of the stop's opening, see
            `neurolens.apertures`; the mask is a picture beside the scene. Without them the lens's own, else round.
        film_width_mm, film_height_mm: the part of the film that is used.
        wavelengths_nm: range of light. width, height: picture in pixels. samples: a pixel.
        max_depth: number of surfaces along a path at which light is scattered.
    """

    position_m: Vector
    look_at_m: Vector
    focus_m: float
    up: Vector = (0.0, 1.0, 0.0)
    f_number: float | None = None
    blades: int | None = None
    blade_rotation_deg: float | None = None
    blade_curvature: float | None = None
    aperture_mask: Path | None = None
    film_width_mm: float = 36.0
    film_height_mm: float = 20.25
    wavelengths_nm: tuple[float, float] = (400.0, 700.0)
    width: int = 320
    height: int = 180
    samples: int = 64
    max_depth: int = 6

    def __post_init__(self) -> None:
        for field in ("position_m", "look_at_m", "up"):
            require_finite(field, getattr(self, field))
        axis = tuple(b - a for a, b in zip(self.position_m, self.look_at_m, strict=True))
        require(length(axis) > 0, "look_at_m", self.look_at_m, "a point other than position_m")  # type: ignore[arg-type]
        across = _cross(axis, self.up)  # type: ignore[arg-type]
        parallel = length(across) <= 1e-6 * length(axis) * length(self.up)  # type: ignore[arg-type]
        require(not parallel, "up", self.up, "a direction not along the optical axis")
        require(self.focus_m > 0, "focus_m", self.focus_m, "a number above 0")
        if self.f_number is not None:
            require_positive("f_number", self.f_number)
        require_positive("film_width_mm", self.film_width_mm)
        require_positive("film_height_mm", self.film_height_mm)
        low, high = self.wavelengths_nm
        require(380 <= low <= high <= 780, "wavelengths_nm", self.wavelengths_nm, "low and high within 380 to 780")
        for field, most in (("width", 16384), ("height", 16384), ("samples", 1 << 20), ("max_depth", 1000)):
            value = getattr(self, field)
            require(1 <= value <= most, field, value, f"an integer from 1 to {most}")


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@dataclass(frozen=True)
class Environment:
    """Light from infinitely far: `colour` everywhere, or a gradient from ground over horizon to zenith by height.

    `illuminant`: the light that those colours tint.
    """

    colour: Vector | None = None
    zenith: Vector | None = None
    horizon: Vector | None = None
    ground: Vector | None = None
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        gradient = (self.zenith, self.horizon, self.ground)
        for field in ("colour", "zenith", "horizon", "ground"):
            if (value := getattr(self, field)) is not None:
                require_emission(field, value)
        if self.colour is None:
            require(all(gradient), "environment", "(incomplete)", "colour, or zenith, horizon and ground")
        else:
            require(not any(gradient), "colour", self.colour, "either colour or zenith, horizon and ground")


@dataclass(frozen=True)
class Texture:
    """A pattern on flat surfaces, in metres along them.

    kind "checker": squares of `cell_m` in two `colours`. kind "grid": lines `line_m` wide every `cell_m`, the first
    colour for the lines. kind "image": the picture `file` (beside the scene file), repeated every `size_m` (width,
    height); without `size_m` it fills the rectangle.
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
            require_positive("cell_m", self.cell_m)
            if self.line_m is not None:
                require(0 < self.line_m < self.cell_m, "line_m", self.line_m, "above 0 and below cell_m")
        for size in self.size_m or ():
            require_positive("size_m", size)


@dataclass(frozen=True)
class Material:
    """How a surface scatters light.

    kind "diffuse": Lambert of `reflectance` or `texture`. kind "glossy": a rough coat (GGX of `roughness`, Fresnel
    reflectance `specular` head on) over a diffuse base of `reflectance` or `texture` (black: bare metal).
    kind "mirror": `reflectance`. kind "glass": smooth, index `n_d`, Abbe number `V_d` (left out: no dispersion).
    """

    kind: Literal["diffuse", "glossy", "mirror", "glass"]
    reflectance: Vector | None = None
    texture: str | None = None
    specular: Vector | None = None
    roughness: float | None = None
    n_d: float | None = None
    V_d: float | None = None

    _FIELDS = {
        "diffuse": ((), ("reflectance", "texture")),
        "glossy": (("specular", "roughness"), ("reflectance", "texture")),
        "mirror": (("reflectance",), ()),
        "glass": (("n_d",), ("V_d",)),
    }

    def __post_init__(self) -> None:
        needed, optional = self._FIELDS[self.kind]
        check_fields(self, f"a {self.kind} material", needed, optional)
        if "texture" in optional:
            one = (self.reflectance is None) != (self.texture is None)
            require(one, "reflectance", self.reflectance or "(missing)", "either reflectance or texture")
        for field in ("reflectance", "specular"):
            if (value := getattr(self, field)) is not None:
                require_reflectance(field, value)
        if self.roughness is not None:
            require(0.02 <= self.roughness <= 1, "roughness", self.roughness, "a number from 0.02 to 1")
        if self.n_d is not None:
            require(1 < self.n_d <= 4, "n_d", self.n_d, "a number above 1, at most 4")
        if self.V_d is not None:
            require(10 <= self.V_d < math.inf, "V_d", self.V_d, "a number from 10")


@dataclass(frozen=True)
class SceneSettings:
    """A whole scene file."""

    camera: CameraSettings
    film: FilmSettings = FilmSettings()
    illuminants: dict[str, IlluminantSettings] | None = None
    environment: Environment = Environment(colour=BLACK)
    textures: dict[str, Texture] | None = None
    materials: dict[str, Material] | None = None
    planes: tuple[Plane, ...] = ()
    quads: tuple[Quad, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    boxes: tuple[Box, ...] = ()
    rooms: tuple[Room, ...] = ()
    meshes: tuple[MeshSettings, ...] = ()
