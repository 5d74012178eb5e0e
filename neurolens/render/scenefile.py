"""Reads a scene: the TOML file, then the pictures and meshes it names, with every reference checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.config import from_dict
from neurolens.base.errors import InputError
from neurolens.base.tomlfile import read_toml
from neurolens.cameras.contract import FloatArray
from neurolens.optics.apertures import Aperture
from neurolens.render.illuminants import (
    IlluminantSettings,
    Spectrum,
    check_name,
    check_spectrum,
    illuminant,
    read_spectrum,
)
from neurolens.render.masks import make_aperture
from neurolens.render.materialsettings import ReflectanceSettings
from neurolens.render.meshfile import TriangleSet, read_mesh
from neurolens.render.pictures import read_environment, read_picture
from neurolens.render.scene import CameraSettings, SceneSettings
from neurolens.render.scenechecks import check_camera, check_references


@dataclass(frozen=True)
class Scene:
    """A scene with all it needs.

    Attributes:
        name: the file's name without ending. settings: the tables of the file.
        images: linear RGB [H, W, 3] of each image texture. triangles: one a mesh.
        aperture: shape of the stop's opening, None where the scene says nothing.
        illuminants, reflectances: measured spectra by name.
        environment: linear RGB [H, W, 3] of the environment's picture, if it has one.
    """

    name: str
    settings: SceneSettings
    images: dict[str, FloatArray]
    triangles: tuple[TriangleSet, ...]
    aperture: Aperture | None = None
    illuminants: dict[str, Spectrum] = field(default_factory=dict)
    reflectances: dict[str, Spectrum] = field(default_factory=dict)
    environment: FloatArray | None = None


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
    triangles = tuple(read_mesh(path, f"meshes[{k}]", mesh) for k, mesh in enumerate(settings.meshes))
    check_references(path, settings, triangles)
    check_camera(path, settings, triangles)
    images = {
        name: read_picture(path, f"textures.{name}.file", path.parent / texture.file)
        for name, texture in (settings.textures or {}).items()
        if texture.file is not None
    }
    around, scale = settings.environment.file, settings.environment.scale
    return Scene(
        path.stem,
        settings,
        images,
        triangles,
        _aperture(path, settings.camera),
        _illuminants(path, settings),
        _reflectances(path, settings),
        None if around is None else read_environment(path, "environment.file", path.parent / around, scale),
    )


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
        measured[name] = nm, values = _spectrum(path, f"illuminants.{name}", given, settings.camera)
        if illuminant(name) is not None:
            raise InputError(path, f"illuminants.{name}", name, "a name that no illuminant has yet")
        if not np.interp(np.linspace(low, high, 4096), nm, values).any():
            raise InputError(path, f"illuminants.{name}", "(all 0)", f"light between {low:g} and {high:g} nm")
    for kind in ("quads", "discs", "spheres", "points", "spots"):
        for k, light in enumerate(getattr(settings, kind)):
            check_name(path, f"{kind}[{k}].illuminant", light.illuminant, measured)
    check_name(path, "environment.illuminant", settings.environment.illuminant, measured)
    if settings.film.white_balance is not None:
        check_name(path, "film.white_balance", settings.film.white_balance, measured)
    return measured


def _reflectances(path: Path, settings: SceneSettings) -> dict[str, Spectrum]:
    """The measured reflectances, each over all of the camera's wavelengths and at most 1."""
    return {
        name: _spectrum(path, f"reflectances.{name}", given, settings.camera)
        for name, given in (settings.reflectances or {}).items()
    }


def _spectrum(
    path: Path, field: str, given: IlluminantSettings | ReflectanceSettings, camera: CameraSettings
) -> Spectrum:
    """A spectrum that covers the camera's wavelengths: of a light, the largest value 1; of a surface as it is."""
    most = 1.0 if isinstance(given, ReflectanceSettings) else None
    if given.file is not None:
        nm, values = read_spectrum(path, f"{field}.file", path.parent / given.file, most)
    else:
        assert given.spectrum is not None
        nm, values = check_spectrum(path, f"{field}.spectrum", given.spectrum, most)
    low, high = camera.wavelengths_nm
    if nm[0] > low or nm[-1] < high:
        expected = f"the {low:g} to {high:g} nm of the camera; what is dark there is written as 0"
        raise InputError(path, field, f"({nm[0]:g} to {nm[-1]:g} nm)", expected)
    return nm, values
