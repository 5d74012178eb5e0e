"""What a scene file says: frozen dataclasses, one for each kind of table, checked one by one.

Metres, y up, colours linear sRGB. The reader is `neurolens.render.scenefile`; whoever builds scenes in Python uses these
classes directly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from neurolens.errors import InputError

Vector = tuple[float, float, float]
BLACK: Vector = (0.0, 0.0, 0.0)


def _require(ok: bool, field: str, value: object, expected: str) -> None:
    if not ok:
        raise InputError("scene", field, value, expected)


def _finite(field: str, value: tuple[float, ...]) -> None:
    _require(all(math.isfinite(x) for x in value), field, value, "finite numbers")


def _positive(field: str, value: float) -> None:
    _require(0 < value < math.inf, field, value, "a finite number above 0")


def _reflectance(field: str, value: Vector) -> None:
    _require(all(0 <= x <= 1 for x in value), field, value, "three numbers from 0 to 1")


def _emission(field: str, value: Vector) -> None:
    _require(all(0 <= x < math.inf for x in value), field, value, "three finite numbers, 0 or more")


def _length(vector: Vector) -> float:
    return math.sqrt(sum(x * x for x in vector))


@dataclass(frozen=True)
class CameraSettings:
    """Where the camera stands and what it takes; which camera it is, the caller of `render` decides.

    Attributes:
        position_m: film-plane centre. look_at_m: a point on the optical axis. up: points to the picture's top.
        focus_m: distance from film to the object in focus. f_number: None leaves it to the lens.
        film_width_mm, film_height_mm: the part of the film that is used.
        wavelengths_nm: range of light. width, height: picture in pixels. samples: a pixel.
        max_depth: number of surfaces along a path at which light is scattered.
    """

    position_m: Vector
    look_at_m: Vector
    focus_m: float
    up: Vector = (0.0, 1.0, 0.0)
    f_number: float | None = None
    film_width_mm: float = 36.0
    film_height_mm: float = 20.25
    wavelengths_nm: tuple[float, float] = (400.0, 700.0)
    width: int = 320
    height: int = 180
    samples: int = 64
    max_depth: int = 6

    def __post_init__(self) -> None:
        for field in ("position_m", "look_at_m", "up"):
            _finite(field, getattr(self, field))
        axis = tuple(b - a for a, b in zip(self.position_m, self.look_at_m, strict=True))
        _require(_length(axis) > 0, "look_at_m", self.look_at_m, "a point other than position_m")  # type: ignore[arg-type]
        across = _cross(axis, self.up)  # type: ignore[arg-type]
        parallel = _length(across) <= 1e-6 * _length(axis) * _length(self.up)  # type: ignore[arg-type]
        _require(not parallel, "up", self.up, "a direction not along the optical axis")
        _require(self.focus_m > 0, "focus_m", self.focus_m, "a number above 0")
        if self.f_number is not None:
            _positive("f_number", self.f_number)
        _positive("film_width_mm", self.film_width_mm)
        _positive("film_height_mm", self.film_height_mm)
        low, high = self.wavelengths_nm
        _require(380 <= low <= high <= 780, "wavelengths_nm", self.wavelengths_nm, "low and high within 380 to 780")
        for field, most in (("width", 16384), ("height", 16384), ("samples", 1 << 20), ("max_depth", 1000)):
            value = getattr(self, field)
            _require(1 <= value <= most, field, value, f"an integer from 1 to {most}")


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@dataclass(frozen=True)
class Environment:
    """Light from infinitely far: `colour` everywhere, or a gradient from ground over horizon to zenith by height."""

    colour: Vector | None = None
    zenith: Vector | None = None
    horizon: Vector | None = None
    ground: Vector | None = None

    def __post_init__(self) -> None:
        gradient = (self.zenith, self.horizon, self.ground)
        for field in ("colour", "zenith", "horizon", "ground"):
            if (value := getattr(self, field)) is not None:
                _emission(field, value)
        if self.colour is None:
            _require(all(gradient), "environment", "(incomplete)", "colour, or zenith, horizon and ground")
        else:
            _require(not any(gradient), "colour", self.colour, "either colour or zenith, horizon and ground")


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
        _check_fields(self, f"a {self.kind} texture", needed, optional)
        for colour in self.colours or ():
            _reflectance("colours", colour)
        if self.cell_m is not None:
            _positive("cell_m", self.cell_m)
            if self.line_m is not None:
                _require(0 < self.line_m < self.cell_m, "line_m", self.line_m, "above 0 and below cell_m")
        for size in self.size_m or ():
            _positive("size_m", size)


def _check_fields(item: object, what: str, needed: tuple[str, ...], optional: tuple[str, ...]) -> None:
    """Every needed field is there, and none that the kind does not know."""
    for field, value in vars(item).items():
        if field == "kind":
            continue
        _require(value is not None or field not in needed, field, "(missing)", f"given for {what}")
        known = field in needed or field in optional
        _require(value is None or known, field, value, f"left out: {what} has {', '.join(needed + optional)}")


@dataclass(frozen=True)
class Material:
    """How a surface scatters light.

    kind "diffuse": Lambert of `reflectance` or `texture`. kind "glossy": a rough coat (GGX, `roughness` above 0, Fresnel
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
        _check_fields(self, f"a {self.kind} material", needed, optional)
        if "texture" in optional:
            one = (self.reflectance is None) != (self.texture is None)
            _require(one, "reflectance", self.reflectance or "(missing)", "either reflectance or texture")
        for field in ("reflectance", "specular"):
            if (value := getattr(self, field)) is not None:
                _reflectance(field, value)
        if self.roughness is not None:
            _require(0.02 <= self.roughness <= 1, "roughness", self.roughness, "a number from 0.02 to 1")
        if self.n_d is not None:
            _require(1 < self.n_d <= 4, "n_d", self.n_d, "a number above 1, at most 4")
        if self.V_d is not None:
            _require(10 <= self.V_d < math.inf, "V_d", self.V_d, "a number from 10")


@dataclass(frozen=True)
class Plane:
    """An infinite plane."""

    point_m: Vector
    normal: Vector
    material: str

    def __post_init__(self) -> None:
        _finite("point_m", self.point_m)
        _finite("normal", self.normal)
        _require(_length(self.normal) > 0, "normal", self.normal, "a direction")


@dataclass(frozen=True)
class Quad:
    """A rectangle: a corner and two perpendicular edges. `emission` is the radiance on the side of edge_u x edge_v."""

    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    material: str | None = None
    emission: Vector = BLACK

    def __post_init__(self) -> None:
        for field in ("corner_m", "edge_u_m", "edge_v_m"):
            _finite(field, getattr(self, field))
        u, v = _length(self.edge_u_m), _length(self.edge_v_m)
        _require(u > 0, "edge_u_m", self.edge_u_m, "an edge longer than 0")
        cosine = sum(a * b for a, b in zip(self.edge_u_m, self.edge_v_m, strict=True))
        _require(v > 0 and abs(cosine) <= 1e-5 * u * v, "edge_v_m", self.edge_v_m, "an edge perpendicular to edge_u_m")
        _check_light(self.material, self.emission)


@dataclass(frozen=True)
class Sphere:
    """A sphere; `emission` is the radiance of its outside, so that a small one is a point-like light."""

    centre_m: Vector
    radius_m: float
    material: str | None = None
    emission: Vector = BLACK

    def __post_init__(self) -> None:
        _finite("centre_m", self.centre_m)
        _positive("radius_m", self.radius_m)
        _check_light(self.material, self.emission)


def _check_light(material: str | None, emission: Vector) -> None:
    _emission("emission", emission)
    _require(material is not None or any(emission), "material", "(missing)", "the name of a material, or emission")


@dataclass(frozen=True)
class Box:
    """An axis-aligned box from one corner to the opposite one."""

    min_m: Vector
    max_m: Vector
    material: str

    def __post_init__(self) -> None:
        _check_corners(self.min_m, self.max_m)


@dataclass(frozen=True)
class Room:
    """The inside of an axis-aligned box; its walls do not exist for rays that come from outside.

    Walls not named have `material`. left and right are x- and x+, floor and ceiling y- and y+, far and near z- and z+.
    """

    min_m: Vector
    max_m: Vector
    material: str
    left: str | None = None
    right: str | None = None
    floor: str | None = None
    ceiling: str | None = None
    far: str | None = None
    near: str | None = None

    def __post_init__(self) -> None:
        _check_corners(self.min_m, self.max_m)

    def walls(self) -> tuple[str, ...]:
        """Materials in the order x-, x+, y-, y+, z-, z+."""
        order = (self.left, self.right, self.floor, self.ceiling, self.far, self.near)
        return tuple(wall or self.material for wall in order)


def _check_corners(low: Vector, high: Vector) -> None:
    _finite("min_m", low)
    _finite("max_m", high)
    _require(all(a < b for a, b in zip(low, high, strict=True)), "max_m", high, "above min_m in x, y and z")


@dataclass(frozen=True)
class MeshSettings:
    """Triangles: `vertices_m` and `faces` (counted from 0), or an OBJ `file` beside the scene file.

    Scaled, turned about y, then moved. `smooth` interpolates vertex normals.
    """

    material: str
    file: Path | None = None
    vertices_m: tuple[Vector, ...] | None = None
    faces: tuple[tuple[int, int, int], ...] | None = None
    scale: float = 1.0
    rotate_y_deg: float = 0.0
    translate_m: Vector = BLACK
    smooth: bool = False

    def __post_init__(self) -> None:
        inline = self.vertices_m is not None and self.faces is not None
        any_inline = self.vertices_m is not None or self.faces is not None
        ok = inline if self.file is None else not any_inline
        _require(ok, "file", self.file or "(missing)", "either file, or vertices_m and faces")
        _positive("scale", self.scale)
        _finite("rotate_y_deg", (self.rotate_y_deg,))
        _finite("translate_m", self.translate_m)


@dataclass(frozen=True)
class SceneSettings:
    """A whole scene file."""

    camera: CameraSettings
    environment: Environment = Environment(colour=BLACK)
    textures: dict[str, Texture] | None = None
    materials: dict[str, Material] | None = None
    planes: tuple[Plane, ...] = ()
    quads: tuple[Quad, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    boxes: tuple[Box, ...] = ()
    rooms: tuple[Room, ...] = ()
    meshes: tuple[MeshSettings, ...] = ()
