"""Checks that need more than one table of a scene: names that are used, and where the camera stands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import suggestion
from neurolens.render.materialsettings import Material, Texture
from neurolens.render.meshfile import TriangleSet
from neurolens.render.scene import SceneSettings

_SHAPES = ("planes", "quads", "discs", "spheres", "boxes", "rooms", "meshes")
_WALLS = ("left", "right", "floor", "ceiling", "far", "near")


def check_references(path: Path, settings: SceneSettings, triangles: Sequence[TriangleSet]) -> None:
    """Every material, texture and reflectance that is named exists, and textures lie where they can.

    Raises:
        InputError: names the field and what there is.
    """
    materials, textures = settings.materials or {}, settings.textures or {}
    for name, material in materials.items():
        if material.texture is not None:
            _known(path, f"materials.{name}.texture", material.texture, textures)
        if isinstance(material.reflectance, str):
            _known(path, f"materials.{name}.reflectance", material.reflectance, settings.reflectances or {})
    for kind in _SHAPES:
        for k, shape in enumerate(getattr(settings, kind)):
            for part in ("material", *(_WALLS if kind == "rooms" else ())):
                used = getattr(shape, part)
                if used is None:
                    continue
                field = f"{kind}[{k}].{part}"
                _known(path, field, used, materials)
                mesh = triangles[k] if kind == "meshes" else None
                _check_texture(path, field, kind, materials[used], textures, mesh)


def _known(path: Path, field: str, name: str, names: Mapping[str, Any]) -> None:
    if name not in names:
        listed = ", ".join(names) or "none is defined"
        raise InputError(path, field, name, f"one of: {listed}{suggestion(name, list(names))}")


def _check_texture(
    path: Path, field: str, kind: str, material: Material, textures: Mapping[str, Texture], mesh: TriangleSet | None
) -> None:
    texture = textures.get(material.texture or "")
    if texture is None:
        return
    if kind == "spheres":
        raise InputError(path, field, material.texture, "a material without texture on a curved shape")
    if mesh is not None:
        if texture.kind != "image" or texture.size_m is not None:
            raise InputError(path, field, material.texture, "an image texture without size_m on a mesh")
        if mesh.uv is None:
            raise InputError(path, field, material.texture, "a mesh file with texture coordinates, or no texture")
    elif kind not in ("quads", "discs") and texture.kind == "image" and texture.size_m is None:
        raise InputError(path, f"textures.{material.texture}.size_m", "(missing)", "width, height in m")


def files_named(tables: Any) -> Iterator[Path]:
    """Every file that a scene's tables name, as it is written there."""
    if isinstance(tables, Path):
        yield tables
    elif is_dataclass(tables):
        for field in fields(tables):
            yield from files_named(getattr(tables, field.name))
    elif isinstance(tables, (Mapping, tuple)):
        for item in tables.values() if isinstance(tables, Mapping) else tables:
            yield from files_named(item)


def check_camera(path: Path, settings: SceneSettings, triangles: Sequence[TriangleSet]) -> None:
    """The middle of the film is not inside something solid: a sphere, a box, or a closed mesh with its front outside.

    Raises:
        InputError: names the shape.
    """
    at = np.array(settings.camera.position_m)
    inside = None
    for k, sphere in enumerate(settings.spheres):
        if np.sum((at - sphere.centre_m) ** 2) < sphere.radius_m**2:
            inside = f"spheres[{k}]"
    for k, box in enumerate(settings.boxes):
        if np.all((at > box.min_m) & (at < box.max_m)):
            inside = f"boxes[{k}]"
    for k, mesh in enumerate(triangles):
        if encloses(mesh, at):
            inside = f"meshes[{k}]"
    if inside is not None:
        expected = f"a place outside {inside}"
        raise InputError(path, "camera.position_m", list(settings.camera.position_m), expected)


def encloses(mesh: TriangleSet, point: NDArray[np.float64]) -> bool:
    """Whether a point [3] lies inside a closed mesh whose triangles face outwards.

    By the winding number, the sum of the solid angles of the triangles over 4 pi (van Oosterom and Strackee 1983): 1
    inside, 0 outside. A room, whose triangles face inwards, has -1; for an open mesh it means nothing.
    """
    corners = mesh.vertices[mesh.faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    if not np.all((point > low) & (point < high)) or not _is_closed(corners):
        return False
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    volume = np.sum(a * np.cross(b, c), axis=1)
    ab, bc, ca = (np.sum(x * y, axis=1) for x, y in ((a, b), (b, c), (c, a)))
    solid = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return bool(solid.sum() / (4 * np.pi) > 0.5)


def _is_closed(corners: NDArray[np.float64]) -> bool:
    """Whether each edge of triangles [T, 3, 3] runs as often one way as the other, by position."""
    _, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = number.reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (np.unique(pair, axis=0, return_counts=True) for pair in (edges, edges[:, ::-1]))
    return forth[0].shape == back[0].shape and all(np.array_equal(x, y) for x, y in zip(forth, back, strict=True))
