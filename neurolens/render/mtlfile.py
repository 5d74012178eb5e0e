"""Materials of OBJ files: diffuse colours and pictures of the MTL files that they name (Kd, map_Kd), and nothing else.

A material of the scene with the name that `usemtl` says comes before the one of the MTL file.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import read_bytes
from neurolens.render.meshfile import LARGEST_FILE, TriangleSet, read_file, read_mesh
from neurolens.render.scenetables import Material, MeshSettings, Texture, Vector

_LARGEST, _MOST = 4_000_000, 1000  # bytes of an MTL file, materials
_GREY: Vector = (0.8, 0.8, 0.8)  # of a material that says nothing


@dataclass
class Parts:
    """Meshes of one material each, and the materials and textures that come with them."""

    meshes: list[MeshSettings] = field(default_factory=list)
    triangles: list[TriangleSet] = field(default_factory=list)
    materials: dict[str, Material] = field(default_factory=dict)
    textures: dict[str, Texture] = field(default_factory=dict)

    def add(self, scene: Path, place: str, mesh: MeshSettings, known: Mapping[str, Material]) -> None:
        """Add a mesh: as it is where it has a material, else cut by the materials of its file.

        Raises:
            InputError: as of `read_mesh`; a file without materials, or with some that are defined nowhere.
        """
        if mesh.material is not None:
            self.meshes.append(mesh)
            self.triangles.append(read_mesh(scene, place, mesh))
            return
        if mesh.file is None or mesh.file.suffix.lower() != ".obj":
            expected = "the name of a material; only an OBJ file with usemtl brings its own"
            raise InputError(scene, f"{place}.material", "(missing)", expected)
        whole = read_file(scene, f"{place}.file", scene.parent / mesh.file)
        libraries, used = _obj_materials(read_bytes(scene.parent / mesh.file, LARGEST_FILE))
        found = _library(scene, mesh.file, libraries)
        numbers = {name: k for k, name in enumerate(dict.fromkeys(used))}
        number = np.array([numbers[name] for name in used], np.int64)
        for name, k in numbers.items():
            material = name if name in known else f"{mesh.file.stem}:{name}"
            if name not in known:
                if name not in found:
                    expected = f"a material of the scene or of {', '.join(libraries) or 'an MTL file'}"
                    raise InputError(scene, f"{place}.file, usemtl", name or "(none before a face)", expected)
                self._define(material, found[name], whole.uv is not None, scene.parent / mesh.file)
            part = replace(mesh, material=material)
            self.meshes.append(part)
            self.triangles.append(read_mesh(scene, place, part, _part(whole, number == k)))

    def _define(self, name: str, given: tuple[Vector, Path | None], coordinates: bool, file: Path) -> None:
        colour, picture = given
        if picture is not None and not coordinates:
            told = f"{file}: it has no texture coordinates: {picture.name} is left out"
            warnings.warn(told, NeurolensWarning, stacklevel=2)
        if picture is None or not coordinates:
            self.materials[name] = Material("diffuse", reflectance=colour)
            return
        self.textures[name] = Texture("image", file=picture)
        self.materials[name] = Material("diffuse", texture=name)


def _part(mesh: TriangleSet, chosen: NDArray[np.bool_]) -> TriangleSet:
    """Some triangles of a mesh, with the vertices that they need."""
    rows, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    uv, normals = (None if values is None else values[rows] for values in (mesh.uv, mesh.normals))
    return TriangleSet(mesh.vertices[rows], faces.reshape(-1, 3).astype(np.int64), uv, normals)


def _obj_materials(content: bytes) -> tuple[list[str], list[str]]:
    """Names of the MTL files, and of the material of each triangle, polygons cut into fans as `read_file` does."""
    libraries, used, name = [], [], ""
    for line in content.decode("utf-8-sig", "replace").replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        word, _, rest = line.partition("#")[0].strip().partition(" ")
        if word == "mtllib":
            libraries.append(rest.strip())
        elif word == "usemtl":
            name = rest.strip()
        elif word == "f":
            used += [name] * (len(rest.split()) - 2)
    return list(dict.fromkeys(libraries)), used


def _library(scene: Path, mesh: Path, libraries: list[str]) -> dict[str, tuple[Vector, Path | None]]:
    """Colour, and picture beside the scene if there is one, of every material of the MTL files."""
    found: dict[str, tuple[Vector, Path | None]] = {}
    for listed in libraries:
        whole = (scene.parent / mesh).parent / PurePosixPath(listed)
        for name in [listed] if os.path.isfile(whole) else listed.split():  # several names, or one with blanks
            file = mesh.parent / PurePosixPath(name.replace("\\", "/"))
            found |= _read_mtl(scene.parent / file, file.parent)
            if len(found) > _MOST:
                raise InputError(file, "newmtl", f"({len(found)} materials)", f"at most {_MOST}")
    return found


def _read_mtl(path: Path, folder: Path) -> dict[str, tuple[Vector, Path | None]]:
    """Materials of an MTL file; `folder`: where it lies, seen from the scene.

    Raises:
        InputError: as of `read_bytes`; a colour or picture that is none.
    """
    content = read_bytes(path, _LARGEST, "an MTL file beside the OBJ file")
    found: dict[str, tuple[Vector, Path | None]] = {}
    name = ""
    for number, line in enumerate(content.decode("utf-8-sig", "replace").splitlines(), 1):
        word, _, rest = line.partition("#")[0].strip().partition(" ")
        rest = rest.strip()
        if word == "newmtl":
            name = rest
            found[name] = (_GREY, None)
        elif word in ("Kd", "map_Kd") and name not in found:
            raise InputError(path, f"line {number}, {word}", rest[:60], "newmtl before it")
        elif word == "Kd":
            found[name] = (_colour(path, number, rest), found[name][1])
        elif word == "map_Kd":
            if not rest or rest.startswith("-"):
                raise InputError(path, f"line {number}, map_Kd", rest[:60], "the name of a picture, without options")
            found[name] = (found[name][0], folder / PurePosixPath(rest.replace("\\", "/")))
    return found


def _colour(path: Path, number: int, text: str) -> Vector:
    """Linear RGB; one number stands for three."""
    words = text.split()
    try:
        values = [float(word) for word in words * (3 if len(words) == 1 else 1)] if len(text) < 100 else []
    except ValueError:
        values = []
    if len(values) != 3 or not all(0 <= v <= 1 for v in values):
        raise InputError(path, f"line {number}, Kd", text[:60], "three numbers from 0 to 1")
    return values[0], values[1], values[2]
