"""Reads a scene: the TOML file, then the pictures and meshes it names, with every reference checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neurolens.apertures import Aperture
from neurolens.cameras.contract import FloatArray
from neurolens.config import from_dict
from neurolens.errors import InputError
from neurolens.render.illuminants import (
    IlluminantSettings,
    Spectrum,
    check_name,
    check_spectrum,
    illuminant,
    read_spectrum,
)
from neurolens.render.masks import make_aperture
from neurolens.render.mesh import read_obj
from neurolens.render.scene import CameraSettings, Material, SceneSettings, Texture
from neurolens.render.shapes import MeshSettings
from neurolens.render.spectrum import srgb_to_linear
from neurolens.tomlfile import read_toml, suggestion

_LARGEST_PICTURE = 8192


@dataclass(frozen=True)
class TriangleSet:
    """A mesh as read: vertices [V, 3] float64 in metres, faces [T, 3] counted from 0."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


@dataclass(frozen=True)
class Scene:
    """A scene with all it needs.

    Attributes:
        name: the file's name without ending. settings: the tables of the file.
        images: linear RGB [H, W, 3] of each image texture. triangles: one a mesh.
        aperture: shape of the stop's opening, None where the scene says nothing.
        illuminants: measured spectra by name.
    """

    name: str
    settings: SceneSettings
    images: dict[str, FloatArray]
    triangles: tuple[TriangleSet, ...]
    aperture: Aperture | None = None
    illuminants: dict[str, Spectrum] = field(default_factory=dict)


def load_scene(path: str | Path) -> Scene:
    """Read a scene file; pictures and meshes lie beside it.

    Raises:
        InputError: names file, field, value and what was expected, for an unknown or missing key, a wrong type or
            value, a material or texture that is not defined, a picture or mesh that is missing or broken, a
            degenerate triangle.
    """
    return scene_from_tables(read_toml(path), path)


def scene_from_tables(tables: Mapping[str, Any], path: str | Path = "scene") -> Scene:
    """As `load_scene`, for tables already in memory; `path` is for messages and for finding files."""
    path = Path(path)
    settings = from_dict(SceneSettings, tables, path)
    materials, textures = settings.materials or {}, settings.textures or {}
    _check_references(path, settings, materials, textures)
    images = {
        name: _read_image(path, f"textures.{name}.file", path.parent / texture.file)
        for name, texture in textures.items()
        if texture.file is not None
    }
    triangles = tuple(_read_mesh(path, f"meshes[{k}]", mesh) for k, mesh in enumerate(settings.meshes))
    illuminants = _illuminants(path, settings)
    return Scene(path.stem, settings, images, triangles, _aperture(path, settings.camera), illuminants)


def _aperture(path: Path, camera: CameraSettings) -> Aperture | None:
    mask = None if camera.aperture_mask is None else path.parent / camera.aperture_mask
    try:
        return make_aperture(camera.blades, camera.blade_rotation_deg, camera.blade_curvature, mask)
    except InputError as error:
        raise InputError(path, f"camera, {error.file} {error.field}", error.value, error.expected) from None


def _illuminants(path: Path, settings: SceneSettings) -> dict[str, Spectrum]:
    """The measured spectra, each over all of the camera's wavelengths; every light's illuminant exists."""
    low, high = settings.camera.wavelengths_nm
    measured = {}
    for name, given in (settings.illuminants or {}).items():
        measured[name] = nm, values = _spectrum(path, f"illuminants.{name}", given)
        if illuminant(name) is not None:
            raise InputError(path, f"illuminants.{name}", name, "a name that no illuminant has yet")
        if nm[0] > low or nm[-1] < high:
            expected = f"the {low:g} to {high:g} nm of the camera; what is dark there is written as 0"
            raise InputError(path, f"illuminants.{name}", f"({nm[0]:g} to {nm[-1]:g} nm)", expected)
        if not np.interp(np.linspace(low, high, 4096), nm, values).any():
            raise InputError(path, f"illuminants.{name}", "(all 0)", f"light between {low:g} and {high:g} nm")
    for kind in ("quads", "spheres"):
        for k, light in enumerate(getattr(settings, kind)):
            check_name(path, f"{kind}[{k}].illuminant", light.illuminant, measured)
    check_name(path, "environment.illuminant", settings.environment.illuminant, measured)
    if settings.film.white_balance is not None:
        check_name(path, "film.white_balance", settings.film.white_balance, measured)
    return measured


def _spectrum(path: Path, field: str, given: IlluminantSettings) -> Spectrum:
    if given.file is not None:
        return read_spectrum(path, f"{field}.file", path.parent / given.file)
    assert given.spectrum is not None
    return check_spectrum(path, f"{field}.spectrum", given.spectrum)


def _check_references(
    path: Path, settings: SceneSettings, materials: dict[str, Material], textures: dict[str, Texture]
) -> None:
    """Every material and texture that is named exists, and textures lie on flat surfaces only."""

    def known(field: str, name: str, names: Mapping[str, Any]) -> None:
        if name not in names:
            listed = ", ".join(names) or "none is defined"
            raise InputError(path, field, name, f"one of: {listed}{suggestion(name, list(names))}")

    for name, material in materials.items():
        if material.texture is not None:
            known(f"materials.{name}.texture", material.texture, textures)
    for kind in ("planes", "quads", "spheres", "boxes", "rooms", "meshes"):
        for k, shape in enumerate(getattr(settings, kind)):
            walls = ("left", "right", "floor", "ceiling", "far", "near") if kind == "rooms" else ()
            for part in ("material", *walls):
                used = getattr(shape, part)
                if used is None:
                    continue
                known(f"{kind}[{k}].{part}", used, materials)
                texture = textures.get(materials[used].texture or "")
                if texture is None:
                    continue
                if kind in ("spheres", "meshes"):
                    raise InputError(path, f"{kind}[{k}].{part}", used, "a material without texture on a curved shape")
                if kind != "quads" and texture.kind == "image" and texture.size_m is None:
                    raise InputError(
                        path, f"textures.{materials[used].texture}.size_m", "(missing)", "width, height in m"
                    )


def _read_image(scene: Path, field: str, path: Path) -> FloatArray:
    """Linear RGB [H, W, 3] of an sRGB picture."""
    try:
        with Image.open(path) as picture:
            if max(picture.size) > _LARGEST_PICTURE:
                raise InputError(scene, field, str(path), f"a picture of at most {_LARGEST_PICTURE} pixels a side")
            return srgb_to_linear(np.asarray(picture.convert("RGB"), np.float32) / 255)
    except FileNotFoundError:
        raise InputError(scene, field, str(path), "a picture that exists") from None
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(scene, field, str(path), f"a readable picture ({error})") from None


def _read_mesh(scene: Path, field: str, mesh: MeshSettings) -> TriangleSet:
    """Triangles in scene coordinates, none degenerate."""
    if mesh.file is not None:
        vertices, faces = read_obj(scene.parent / mesh.file)
    else:
        vertices = np.array(mesh.vertices_m, np.float64).reshape(-1, 3)
        faces = np.array(mesh.faces, np.int64).reshape(-1, 3)
    if not len(faces):
        raise InputError(scene, f"{field}.faces", "(none)", "at least one triangle")
    if not np.all(np.isfinite(vertices)):
        raise InputError(scene, f"{field}.vertices_m", "(not finite)", "finite numbers")
    for k in np.flatnonzero(np.any((faces < 0) | (faces >= len(vertices)), axis=1))[:1]:
        raise InputError(scene, f"{field}.faces[{k}]", faces[k].tolist(), f"vertices from 0 to {len(vertices) - 1}")
    corners = vertices[faces]
    edges = corners[:, [1, 2, 0]] - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    # Height over the longest side: a needle this thin has no normal in float32.
    for k in np.flatnonzero(area <= 1e-6 * np.max(np.sum(edges**2, axis=2), axis=1))[:1]:
        raise InputError(
            scene, f"{field}.faces[{k}]", faces[k].tolist(), "a triangle with an area, not a degenerate one"
        )
    angle = math.radians(mesh.rotate_y_deg)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    return TriangleSet(mesh.scale * vertices @ turn.T + np.array(mesh.translate_m), faces)
