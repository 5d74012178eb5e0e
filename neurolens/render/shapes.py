"""Shapes in a scene file: flat ones, spheres, boxes, rooms and meshes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from neurolens.render.checks import (
    BLACK,
    SMALLEST_M,
    Vector,
    length,
    require,
    require_angle,
    require_direction,
    require_emission,
    require_place,
    require_positive,
    require_size,
)


@dataclass(frozen=True)
class Plane:
    """An infinite plane."""

    point_m: Vector
    normal: Vector
    material: str

    def __post_init__(self) -> None:
        require_place("point_m", self.point_m)
        require_direction("normal", self.normal)


@dataclass(frozen=True)
class Quad:
    """A rectangle: a corner and two perpendicular edges. `emission` is the radiance on the side of edge_u x edge_v.

    The emission's colour tints the light of `illuminant`: "A", "D50", "D65", "E", a black body such as "3200 K", or one
    of the scene's own; emission [1, 1, 1] of each has the luminance that it has of D65.
    """

    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    material: str | None = None
    emission: Vector = BLACK
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        for field in ("corner_m", "edge_u_m", "edge_v_m"):
            require_place(field, getattr(self, field))
        u, v = length(self.edge_u_m), length(self.edge_v_m)
        require(u >= SMALLEST_M, "edge_u_m", self.edge_u_m, f"an edge of at least {SMALLEST_M:g} m")
        cosine = sum(a * b for a, b in zip(self.edge_u_m, self.edge_v_m, strict=True))
        right = v >= SMALLEST_M and abs(cosine) <= 1e-5 * u * v
        require(right, "edge_v_m", self.edge_v_m, "an edge perpendicular to edge_u_m")
        _check_light(self.material, self.emission)


@dataclass(frozen=True)
class Disc:
    """A flat disc; `emission` is the radiance on the side of `normal`; `illuminant` as for Quad."""

    centre_m: Vector
    normal: Vector
    radius_m: float
    material: str | None = None
    emission: Vector = BLACK
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        require_place("centre_m", self.centre_m)
        require_direction("normal", self.normal)
        require_size("radius_m", self.radius_m)
        _check_light(self.material, self.emission)


@dataclass(frozen=True)
class Sphere:
    """A sphere; `emission` is the radiance of its outside, small ones are point-like; `illuminant` as for Quad."""

    centre_m: Vector
    radius_m: float
    material: str | None = None
    emission: Vector = BLACK
    illuminant: str = "D65"

    def __post_init__(self) -> None:
        require_place("centre_m", self.centre_m)
        require_size("radius_m", self.radius_m)
        _check_light(self.material, self.emission)


def _check_light(material: str | None, emission: Vector) -> None:
    require_emission("emission", emission)
    require(material is not None or any(emission), "material", "(missing)", "the name of a material, or emission")


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
    require_place("min_m", low)
    require_place("max_m", high)
    require(all(a < b for a, b in zip(low, high, strict=True)), "max_m", high, "above min_m in x, y and z")


@dataclass(frozen=True)
class MeshSettings:
    """Triangles: `vertices_m` and `faces` (counted from 0), or an OBJ or PLY `file` beside the scene file.

    Scaled, turned about y, then moved. `smooth` interpolates vertex normals, those of the file or else the mean of the
    triangles around; left out, those of the file where it has them; false leaves the triangles flat.
    """

    material: str
    file: Path | None = None
    vertices_m: tuple[Vector, ...] | None = None
    faces: tuple[tuple[int, int, int], ...] | None = None
    scale: float = 1.0
    rotate_y_deg: float = 0.0
    translate_m: Vector = BLACK
    smooth: bool | None = None

    def __post_init__(self) -> None:
        inline = self.vertices_m is not None and self.faces is not None
        any_inline = self.vertices_m is not None or self.faces is not None
        ok = inline if self.file is None else not any_inline
        require(ok, "file", self.file or "(missing)", "either file, or vertices_m and faces")
        require_positive("scale", self.scale)
        require_angle("rotate_y_deg", self.rotate_y_deg)
        require_place("translate_m", self.translate_m)
