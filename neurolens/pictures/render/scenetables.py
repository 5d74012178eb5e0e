"""The tables of a scene file: shapes, materials, textures, lights, the sky.

They are frozen dataclasses, checked one by one; the reader (`pictures.render.scene`) adds the file to their errors.
Metres, y up, colours linear sRGB.

An emission is a radiance: 1 is what a picture shows as white. The `intensity` of a light without size is a radiant
intensity in the same units times m^2 (as W/sr is to W/(sr m^2)): at distance d a surface that faces it receives the
irradiance intensity / d^2, as much as from a small sphere of radius r and emission L with pi r^2 L = intensity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from neurolens.base.errors import InputError
from neurolens.base.settings import Rule, bounded, check_bounds, rules_of

Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]
BLACK: Vector = (0.0, 0.0, 0.0)
# Within these, squares and products stay far from the limits of float32.
SMALLEST_M, FARTHEST_M = 1e-9, 1e9
BRIGHTEST = 1e18
_NARROWEST_DEG = 0.01  # falloff of a spot: in a narrower one, two cosines would differ by float32's rounding alone


def require(ok: bool, field: str, value: object, expected: str) -> None:
    if not ok:
        raise InputError("scene", field, value, expected)


def each_between(low: float, high: float) -> Rule:
    """Return the rule that each of three numbers lies from `low` to `high`."""
    return Rule(lambda v: all(low <= x <= high for x in v), f"three numbers from {low:g} to {high:g}", colour=True)


def _is_regular(rows: tuple[Row, ...]) -> bool:
    """Return whether a matrix is finite and maps a cube to more than 1e-9 of the volume of its longest edges' cube."""
    if not all(abs(x) <= FARTHEST_M for row in rows for x in row):
        return False
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rows)
    volume = abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
    return volume > 1e-9 * math.hypot(a, d, g) * math.hypot(b, e, h) * math.hypot(c, f, i)


def _is_near(vector: Vector) -> bool:
    return all(abs(x) <= FARTHEST_M for x in vector)


_SIZE = bounded(SMALLEST_M, FARTHEST_M, "a length")
Size = Annotated[float, Rule(_SIZE.good, f"{_SIZE.expected} m")]
Angle = Annotated[float, bounded(-36000, 36000, "degrees")]
Place = Annotated[Vector, Rule(_is_near, f"three numbers within {FARTHEST_M:g} m")]
Direction = Annotated[
    Vector,
    Rule(
        lambda v: _is_near(v) and math.hypot(*v) >= SMALLEST_M,
        f"a direction, between {SMALLEST_M:g} and {FARTHEST_M:g} long",
    ),
]
Light = Annotated[Vector, each_between(0, BRIGHTEST)]
Share = Annotated[Vector, each_between(0, 1)]
Reflectance = Annotated[  # linear sRGB, or the name of a measured spectrum
    Vector | str, Rule(lambda v: isinstance(v, str) or all(0 <= x <= 1 for x in v), "three numbers from 0 to 1", True)
]
_SCALE = Rule(lambda v: all(0 < x < math.inf for x in (v if isinstance(v, tuple) else (v,))), "finite numbers above 0")
_BRIGHTNESS = Rule(lambda v: 0 < v <= BRIGHTEST, f"a number above 0, at most {BRIGHTEST:g}")
_SIZES = Rule(lambda v: all(map(_SIZE.good, v)), f"width and height, each {_SIZE.expected} m")
_COLOURS = Rule(lambda v: all(0 <= x <= 1 for colour in v for x in colour), "three numbers from 0 to 1, twice")
_MATRIX = Rule(_is_regular, f"three rows of four numbers within {FARTHEST_M:g}, which flatten nothing")
_ABBE = Rule(lambda v: 10 <= v < math.inf, "a number from 10")


class Checked:
    """A table whose values obey the rules of their types; None stands for a missing field."""

    @classmethod
    def keys_read(cls, data: Mapping[str, Any]) -> dict[str, Any]:
        """Read the keys of a file's table; a colour that is one number becomes three."""
        greys = {name for name, rule in rules_of(cls).items() if rule.colour}  # type: ignore[arg-type]
        return {k: [v] * 3 if k in greys and type(v) in (int, float) else v for k, v in data.items()}

    def __post_init__(self) -> None:
        check_bounds(self, "scene")


@dataclass(frozen=True)
class Plane(Checked):
    """An infinite plane."""

    point_m: Place
    normal: Direction
    material: str


@dataclass(frozen=True, kw_only=True)
class Emitter(Checked):
    """A shape that reflects, emits or both.

    The emission's colour tints the light of `illuminant`: "A", "D50", "D65", "E", a black body such as "3200 K", or one
    of the scene's own. Emission [1, 1, 1] has the same luminance with each of them.
    """

    material: str | None = None
    emission: Light = BLACK
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        super().__post_init__()
        there = self.material is not None or any(self.emission)
        require(there, "material", "(missing)", "the name of a material, or emission")


@dataclass(frozen=True)
class Quad(Emitter):
    """A rectangle: a corner and two perpendicular edges. `emission` is the radiance on the side of edge_u x edge_v."""

    corner_m: Place
    edge_u_m: Place
    edge_v_m: Place

    def __post_init__(self) -> None:
        super().__post_init__()
        u, v = math.hypot(*self.edge_u_m), math.hypot(*self.edge_v_m)
        require(u >= SMALLEST_M, "edge_u_m", self.edge_u_m, f"an edge of at least {SMALLEST_M:g} m")
        cosine = sum(a * b for a, b in zip(self.edge_u_m, self.edge_v_m, strict=True))
        right = v >= SMALLEST_M and abs(cosine) <= 1e-5 * u * v
        require(right, "edge_v_m", self.edge_v_m, "an edge perpendicular to edge_u_m")


@dataclass(frozen=True)
class Disc(Emitter):
    """A flat disc; `emission` is the radiance on the side of `normal`."""

    centre_m: Place
    normal: Direction
    radius_m: Size


@dataclass(frozen=True)
class Sphere(Emitter):
    """A sphere; `emission` is the radiance of its outside. A small one acts as a point light."""

    centre_m: Place
    radius_m: Size


@dataclass(frozen=True)
class Box(Checked):
    """An axis-aligned box from one corner to the opposite one."""

    min_m: Place
    max_m: Place
    material: str

    def __post_init__(self) -> None:
        super().__post_init__()
        ordered = all(low < high for low, high in zip(self.min_m, self.max_m, strict=True))
        require(ordered, "max_m", self.max_m, "above min_m in x, y and z")


@dataclass(frozen=True)
class Room(Box):
    """The inside of an axis-aligned box; its walls do not exist for rays that come from outside.

    Walls that are not named have `material`. left and right are x- and x+, floor and ceiling y- and y+, far and near z-
    and z+.
    """

    left: str | None = None
    right: str | None = None
    floor: str | None = None
    ceiling: str | None = None
    far: str | None = None
    near: str | None = None

    def walls(self) -> tuple[str, ...]:
        """Return the materials in the order x-, x+, y-, y+, z-, z+."""
        order = (self.left, self.right, self.floor, self.ceiling, self.far, self.near)
        return tuple(wall or self.material for wall in order)


@dataclass(frozen=True)
class MeshSettings(Checked):
    """Triangles: `vertices_m` and `faces` (counted from 0), or an OBJ or PLY `file` beside the scene file.

    Without `material` an OBJ file has its own materials: diffuse, with the colours (linear) and pictures of its MTL
    files.

    The mesh is mapped by `matrix` (three rows of four: x, y, z and what is added in m), scaled (by one number, or along
    x, y, z), turned about y, then moved. A file's triangles without area are left out, with a warning. `smooth` true
    interpolates vertex normals: those of the file, else the mean of the triangles around. Left out, it interpolates
    where the file has normals; false leaves the triangles flat.
    """

    material: str | None = None
    file: Path | None = None
    vertices_m: tuple[Vector, ...] | None = None
    faces: tuple[tuple[int, int, int], ...] | None = None
    matrix: Annotated[tuple[Row, Row, Row] | None, _MATRIX] = None
    scale: Annotated[float | Vector, _SCALE] = 1.0
    rotate_y_deg: Angle = 0.0
    translate_m: Place = BLACK
    smooth: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        inline = [part is not None for part in (self.vertices_m, self.faces)]
        ok = all(inline) if self.file is None else not any(inline)
        require(ok, "file", self.file or "(missing)", "either file, or vertices_m and faces")


def _check_kind(item: Texture | Material, needed: tuple[str, ...], optional: tuple[str, ...]) -> None:
    """Check that the required fields are present, and no fields that are not known."""
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

    For a light, values are radiance per nm in any unit, 0 or more, one of them above 0. For a surface they are
    reflectance from 0 to 1. Wavelengths increase and cover those of the camera; values are linear in between.
    """

    spectrum: tuple[tuple[float, float], ...] | None = None
    file: Path | None = None

    def __post_init__(self) -> None:
        one = (self.spectrum is None) != (self.file is None)
        require(one, "spectrum", "(missing)" if self.file is None else "(given)", "either spectrum or file")


@dataclass(frozen=True)
class Texture(Checked):
    """A pattern on flat surfaces, in metres along them, or on meshes with texture coordinates.

    kind "checker": squares of `cell_m` in two `colours`. kind "grid": lines `line_m` wide every `cell_m`, drawn in the
    first colour. kind "image": the picture `file` (beside the scene file), repeated every `size_m` (width, height);
    without `size_m` it fills the rectangle, or lies on a mesh as the mesh's texture coordinates say. OpenEXR and
    Radiance (.hdr) are read as linear sRGB, other pictures as sRGB.
    """

    kind: Literal["checker", "grid", "image"]
    colours: Annotated[tuple[Vector, Vector] | None, _COLOURS] = None
    cell_m: Size | None = None
    line_m: float | None = None
    file: Path | None = None
    size_m: Annotated[tuple[float, float] | None, _SIZES] = None

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

    kind "diffuse": Lambert's law, with `reflectance` or `texture`. kind "glossy": a rough coat (GGX of `roughness`,
    Fresnel reflectance `specular` at normal incidence) over a diffuse base of `reflectance` or `texture` (black makes
    bare metal). kind "mirror": of `reflectance`. kind "glass": smooth, index `n_d`, Abbe number `V_d` (left out: no
    dispersion). Glass absorbs: `transmittance` of the light is left after `transmittance_depth_m` (Beer and Lambert),
    but what stands inside it is seen undimmed. Paths step 0.1 mm off a surface, so that thinner glass is passed over.
    """

    kind: Literal["diffuse", "glossy", "mirror", "glass"]
    reflectance: Reflectance | None = None
    texture: str | None = None
    specular: Share | None = None
    roughness: Annotated[float | None, bounded(0.02, 1)] = None
    n_d: Annotated[float | None, Rule(lambda v: 1 < v <= 4, "a number above 1, at most 4")] = None
    V_d: Annotated[float | None, _ABBE] = None
    transmittance: Annotated[Vector | None, each_between(1e-6, 1)] = None
    transmittance_depth_m: Size | None = None

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
    """A point light, equal in all directions; `illuminant` as in an `Emitter`."""

    position_m: Place
    intensity: Light
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

    look_at_m: Place
    outer_deg: Annotated[float, Rule(lambda v: 0.1 <= v <= 90, "a half angle from 0.1 to 90 degrees")]
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
    multiplied by `scale` and turned by `rotate_y_deg` about y as meshes are. `illuminant` is the light that the colours
    tint.
    """

    colour: Light | None = None
    zenith: Light | None = None
    horizon: Light | None = None
    ground: Light | None = None
    file: Path | None = None
    scale: Annotated[float, _BRIGHTNESS] = 1.0
    rotate_y_deg: Angle = 0.0
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


@dataclass(frozen=True)
class Sky(Checked):
    """A clear sky with its sun (Preetham, Shirley and Smits 1999); black below the horizon.

    Attributes:
        sun_elevation_deg: the sun's height above the horizon. sun_azimuth_deg: its angle from -z over +x.
        turbidity: haze; 2 is very clear, 3 clear, 6 hazy, 10 very hazy.
        sun: whether the sun's disc shines as well.
        white_kcd_per_m2: luminance that counts as emission 1. A white surface in the sun has some 30.
    """

    sun_elevation_deg: Annotated[float, Rule(lambda v: 0 <= v <= 90, "a number from 0 (horizon) to 90 (zenith)")]
    sun_azimuth_deg: Angle = 0.0
    turbidity: Annotated[float, bounded(2, 10)] = 3.0
    sun: bool = True
    white_kcd_per_m2: Annotated[float, bounded(1e-6, 1e6)] = 20.0
