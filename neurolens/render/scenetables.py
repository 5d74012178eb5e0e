"""The tables of a scene file: shapes, materials, textures, lights, the sky.

Frozen dataclasses, checked one by one; the reader (`neurolens.render.scene`) adds the file to their errors. Metres, y
up, colours linear sRGB.

An emission is a radiance: 1 is what a picture shows as white. The `intensity` of a light without size is a radiant
intensity in the same units times m^2 (as W/sr is to W/(sr m^2)): at distance d a surface that faces it receives the
irradiance intensity / d^2, as much as from a small sphere of radius r and emission L with pi r^2 L = intensity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from neurolens.base.bounds import F_NUMBER, FILM_MM, said, within
from neurolens.base.errors import InputError

Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]
Reflectance = Vector | str  # linear sRGB, or the name of a measured spectrum
BLACK: Vector = (0.0, 0.0, 0.0)
# Squares and products stay far from the limits of float32.
SMALLEST_M, FARTHEST_M = 1e-9, 1e9
BRIGHTEST = 1e18
_MOST_DEG = 36000.0
_NARROWEST_DEG = 0.01  # of the falloff of a spot: nearer, two cosines would differ by the rounding of float32


def length(vector: Vector) -> float:
    return math.sqrt(sum(x * x for x in vector))


def require(ok: bool, field: str, value: object, expected: str) -> None:
    if not ok:
        raise InputError("scene", field, value, expected)


Rule = tuple[Callable[[Any], bool], str]  # test of a value, and text of what is expected
_SIZE: Rule = (lambda v: SMALLEST_M <= v <= FARTHEST_M, f"a length from {SMALLEST_M:g} to {FARTHEST_M:g} m")
_ANGLE: Rule = (lambda v: abs(v) <= _MOST_DEG, f"degrees, at most {_MOST_DEG:g} either way")
_PLACE: Rule = (lambda v: all(abs(x) <= FARTHEST_M for x in v), f"three numbers within {FARTHEST_M:g} m")
_DIRECTION: Rule = (
    lambda v: _PLACE[0](v) and length(v) >= SMALLEST_M,
    f"a direction, between {SMALLEST_M:g} and {FARTHEST_M:g} long",
)
_EMISSION: Rule = (lambda v: all(0 <= x <= BRIGHTEST for x in v), f"three numbers from 0 to {BRIGHTEST:g}")
_REFLECTANCE: Rule = (lambda v: isinstance(v, str) or all(0 <= x <= 1 for x in v), "three numbers from 0 to 1")


def _is_regular(rows: tuple[Row, ...]) -> bool:
    """Whether a matrix is finite and keeps the volume of a cube above 1e-9 of that of its longest edges."""
    if not all(abs(x) <= FARTHEST_M for row in rows for x in row):
        return False
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rows)
    volume = abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
    return volume > 1e-9 * length((a, d, g)) * length((b, e, h)) * length((c, f, i))


def _count(most: int) -> Rule:
    return lambda v: 1 <= v <= most, f"an integer from 1 to {most}"


# By field name; a name has the same meaning in all tables.
_RULES: dict[str, Rule] = {
    **dict.fromkeys(("position_m", "look_at_m", "up", "point_m", "centre_m", "min_m", "max_m", "translate_m"), _PLACE),
    **dict.fromkeys(("corner_m", "edge_u_m", "edge_v_m"), _PLACE),
    **dict.fromkeys(("emission", "intensity", "colour", "zenith", "horizon", "ground"), _EMISSION),
    **dict.fromkeys(("reflectance", "specular"), _REFLECTANCE),
    **dict.fromkeys(("radius_m", "cell_m", "transmittance_depth_m"), _SIZE),
    **dict.fromkeys(("rotate_y_deg", "sun_azimuth_deg"), _ANGLE),
    "f_number": (lambda v: within(F_NUMBER, v), f"an f-number {said(F_NUMBER)}"),
    **dict.fromkeys(("film_width_mm", "film_height_mm"), (lambda v: within(FILM_MM, v), f"mm {said(FILM_MM)}")),
    "scale": (lambda v: all(0 < x < math.inf for x in (v if isinstance(v, tuple) else (v,))), "finite numbers above 0"),
    "matrix": (lambda v: _is_regular(v), f"three rows of four numbers within {FARTHEST_M:g}, which flatten nothing"),
    **dict.fromkeys(("width", "height"), _count(16384)),
    "samples": _count(1 << 20),
    "max_depth": _count(1000),
    "focus_m": (lambda v: v > 0, "a number above 0"),
    "wavelengths_nm": (lambda v: 380 <= v[0] <= v[1] <= 780, "low and high within 380 to 780"),
    "normal": _DIRECTION,
    "colours": (lambda v: all(map(_REFLECTANCE[0], v)), "three numbers from 0 to 1, twice"),
    "size_m": (lambda v: all(map(_SIZE[0], v)), f"width and height, each {_SIZE[1]}"),
    "roughness": (lambda v: 0.02 <= v <= 1, "a number from 0.02 to 1"),
    "n_d": (lambda v: 1 < v <= 4, "a number above 1, at most 4"),
    "V_d": (lambda v: 10 <= v < math.inf, "a number from 10"),
    "transmittance": (lambda v: all(1e-6 <= x <= 1 for x in v), "three numbers from 0.000001 to 1"),
    "outer_deg": (lambda v: 0.1 <= v <= 90, "a half angle from 0.1 to 90 degrees"),
    "sun_elevation_deg": (lambda v: 0 <= v <= 90, "a number from 0 (horizon) to 90 (zenith)"),
    "turbidity": (lambda v: 2 <= v <= 10, "a number from 2 to 10"),
    "white_kcd_per_m2": (lambda v: 1e-6 <= v <= 1e6, "a number from 1e-06 to 1e+06"),
}


class Checked:
    """A table whose values obey the rules of their field names; None is a missing field."""

    def __post_init__(self) -> None:
        for field, value in vars(self).items():
            if value is not None and field in _RULES:
                ok, expected = _RULES[field]
                require(ok(value), field, value, expected)


@dataclass(frozen=True)
class Plane(Checked):
    """An infinite plane."""

    point_m: Vector
    normal: Vector
    material: str


@dataclass(frozen=True, kw_only=True)
class Emitter(Checked):
    """A shape that reflects, emits or both.

    The emission's colour tints the light of `illuminant`: "A", "D50", "D65", "E", a black body such as "3200 K", or one
    of the scene's own; emission [1, 1, 1] of each has the luminance that it has of D65.
    """

    material: str | None = None
    emission: Vector = BLACK
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        super().__post_init__()
        there = self.material is not None or any(self.emission)
        require(there, "material", "(missing)", "the name of a material, or emission")


@dataclass(frozen=True)
class Quad(Emitter):
    """A rectangle: a corner and two perpendicular edges. `emission` is the radiance on the side of edge_u x edge_v."""

    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector

    def __post_init__(self) -> None:
        super().__post_init__()
        u, v = length(self.edge_u_m), length(self.edge_v_m)
        require(u >= SMALLEST_M, "edge_u_m", self.edge_u_m, f"an edge of at least {SMALLEST_M:g} m")
        cosine = sum(a * b for a, b in zip(self.edge_u_m, self.edge_v_m, strict=True))
        right = v >= SMALLEST_M and abs(cosine) <= 1e-5 * u * v
        require(right, "edge_v_m", self.edge_v_m, "an edge perpendicular to edge_u_m")


@dataclass(frozen=True)
class Disc(Emitter):
    """A flat disc; `emission` is the radiance on the side of `normal`."""

    centre_m: Vector
    normal: Vector
    radius_m: float


@dataclass(frozen=True)
class Sphere(Emitter):
    """A sphere; `emission` is the radiance of its outside, small ones are point-like."""

    centre_m: Vector
    radius_m: float


@dataclass(frozen=True)
class Box(Checked):
    """An axis-aligned box from one corner to the opposite one."""

    min_m: Vector
    max_m: Vector
    material: str

    def __post_init__(self) -> None:
        super().__post_init__()
        ordered = all(low < high for low, high in zip(self.min_m, self.max_m, strict=True))
        require(ordered, "max_m", self.max_m, "above min_m in x, y and z")


@dataclass(frozen=True)
class Room(Box):
    """The inside of an axis-aligned box; its walls do not exist for rays that come from outside.

    Walls not named have `material`. left and right are x- and x+, floor and ceiling y- and y+, far and near z- and z+.
    """

    left: str | None = None
    right: str | None = None
    floor: str | None = None
    ceiling: str | None = None
    far: str | None = None
    near: str | None = None

    def walls(self) -> tuple[str, ...]:
        """Materials in the order x-, x+, y-, y+, z-, z+."""
        order = (self.left, self.right, self.floor, self.ceiling, self.far, self.near)
        return tuple(wall or self.material for wall in order)


@dataclass(frozen=True)
class MeshSettings(Checked):
    """Triangles: `vertices_m` and `faces` (counted from 0), or an OBJ or PLY `file` beside the scene file.

    Without `material` an OBJ file has its own: diffuse, with the colours (linear) and pictures of its MTL files.

    Mapped by `matrix` (three rows of four: x, y, z and what is added in m), scaled (by one number, or along x, y, z),
    turned about y, then moved; triangles without area in a file are left out with a warning. `smooth` interpolates
    vertex normals, those of the file or else the mean of the triangles around; left out, those of the file where it has
    them; false leaves the triangles flat.
    """

    material: str | None = None
    file: Path | None = None
    vertices_m: tuple[Vector, ...] | None = None
    faces: tuple[tuple[int, int, int], ...] | None = None
    matrix: tuple[Row, Row, Row] | None = None
    scale: float | Vector = 1.0
    rotate_y_deg: float = 0.0
    translate_m: Vector = BLACK
    smooth: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        inline = [part is not None for part in (self.vertices_m, self.faces)]
        ok = all(inline) if self.file is None else not any(inline)
        require(ok, "file", self.file or "(missing)", "either file, or vertices_m and faces")


def _check_kind(item: Texture | Material, needed: tuple[str, ...], optional: tuple[str, ...]) -> None:
    """Check that required fields are present and no unknown ones."""
    what = f"a {item.kind} {type(item).__name__.lower()}"
    for field, value in vars(item).items():
        if field == "kind":
            continue
        require(value is not None or field not in needed, field, "(missing)", f"given for {what}")
        known = field in needed or field in optional
        require(value is None or known, field, value, f"left out: {what} has {', '.join(needed + optional)}")


@dataclass(frozen=True)
class MeasuredSpectrum:
    """A measured spectrum: `spectrum` = [[nm, value], ...], or a CSV `file` beside the scene file with such rows.

    Of a light: radiance per nm in any unit, 0 or more, one value above 0. Of a surface: reflectance from 0 to 1.
    Increasing wavelengths, which cover those of the camera; linear in between.
    """

    spectrum: tuple[tuple[float, float], ...] | None = None
    file: Path | None = None

    def __post_init__(self) -> None:
        one = (self.spectrum is None) != (self.file is None)
        require(one, "spectrum", "(missing)" if self.file is None else "(given)", "either spectrum or file")


@dataclass(frozen=True)
class Texture(Checked):
    """A pattern on flat surfaces, in metres along them, or on meshes with texture coordinates.

    kind "checker": squares of `cell_m` in two `colours`. kind "grid": lines `line_m` wide every `cell_m`, the first
    colour for the lines. kind "image": the picture `file` (beside the scene file), repeated every `size_m` (width,
    height); without `size_m` it fills the rectangle, or lies on a mesh as the mesh's texture coordinates say. OpenEXR
    and Radiance (.hdr) are read as linear sRGB, other pictures as sRGB.
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
        _check_kind(self, *self._FIELDS[self.kind])
        super().__post_init__()
        if self.cell_m is not None and self.line_m is not None:
            require(0 < self.line_m < self.cell_m, "line_m", self.line_m, "above 0 and below cell_m")


@dataclass(frozen=True)
class Material(Checked):
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
        _check_kind(self, needed, optional)
        if "texture" in optional:
            one = (self.reflectance is None) != (self.texture is None)
            require(one, "reflectance", self.reflectance or "(missing)", "either reflectance or texture")
        super().__post_init__()
        both = (self.transmittance_depth_m is None) == (self.transmittance is None)
        field = "transmittance" if self.transmittance is None else "transmittance_depth_m"
        require(both, field, "(missing)", "given: the light that is left, and after how many metres")


@dataclass(frozen=True, kw_only=True)
class PointLight(Checked):
    """A point light, equal in all directions; `illuminant` as for an `Emitter`."""

    position_m: Vector
    intensity: Vector
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(any(self.intensity), "intensity", self.intensity, "a number above 0 among the three")


@dataclass(frozen=True, kw_only=True)
class SpotLight(PointLight):
    """A point light that emits into a cone about the direction to `look_at_m`.

    Its intensity is `intensity` within the half angle `inner_deg` of the axis and 0 beyond `outer_deg`; in between it
    falls by the smoothstep t^2 (3 - 2t) of t = (cos angle - cos outer) / (cos inner - cos outer).
    """

    look_at_m: Vector
    outer_deg: float
    inner_deg: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.position_m != self.look_at_m, "look_at_m", self.look_at_m, "a point other than position_m")
        ok = 0 <= self.inner_deg <= self.outer_deg - _NARROWEST_DEG + 1e-9
        require(ok, "inner_deg", self.inner_deg, f"a half angle from 0 to {_NARROWEST_DEG:g} below outer_deg")


@dataclass(frozen=True)
class Environment(Checked):
    """Light from infinitely far: one `colour`, a gradient by height from ground over horizon to zenith, or a picture.

    A picture `file` (beside the scene file) is equirectangular: its middle lies towards -z, its right half towards +x,
    its top row at the zenith. OpenEXR and Radiance (.hdr) are read as linear sRGB, other pictures as sRGB. It is
    multiplied by `scale` and turned by `rotate_y_deg` about y as meshes are. `illuminant`: the light that the colours
    tint.
    """

    colour: Vector | None = None
    zenith: Vector | None = None
    horizon: Vector | None = None
    ground: Vector | None = None
    file: Path | None = None
    scale: float = 1.0
    rotate_y_deg: float = 0.0
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        super().__post_init__()
        gradient = [band is not None for band in (self.zenith, self.horizon, self.ground)]
        kinds = [self.colour is not None, any(gradient), self.file is not None]
        expected = "one of: colour; zenith, horizon and ground; file"
        require(sum(kinds) == 1, "environment", "(several)" if any(kinds) else "(nothing)", expected)
        whole = all(gradient) or not any(gradient)
        require(whole, "environment", "(incomplete)", "colour, or zenith, horizon and ground")
        if self.file is None:
            require(self.scale == 1, "scale", self.scale, "left out: it multiplies a picture")
            require(self.rotate_y_deg == 0, "rotate_y_deg", self.rotate_y_deg, "left out: it turns a picture")
        require(self.scale <= BRIGHTEST, "scale", self.scale, f"a number above 0, at most {BRIGHTEST:g}")


@dataclass(frozen=True)
class Sky(Checked):
    """A clear sky with its sun (Preetham, Shirley and Smits 1999); black below the horizon.

    Attributes:
        sun_elevation_deg: of the sun above the horizon. sun_azimuth_deg: from -z over +x.
        turbidity: haze; 2 is very clear, 3 clear, 6 hazy, 10 very hazy.
        sun: whether the sun's disc shines as well.
        white_kcd_per_m2: luminance that counts as emission 1. A white surface in the sun has some 30.
    """

    sun_elevation_deg: float
    sun_azimuth_deg: float = 0.0
    turbidity: float = 3.0
    sun: bool = True
    white_kcd_per_m2: float = 20.0
