"""OBJ files with materials of their own: colours and pictures of MTL files, triangle by triangle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from render_helpers import CAMERA, diffuse, radiance

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.render.scene import Scene, scene_from_tables
from neurolens.render.spectrum import SpectralRange
from neurolens.render.world import World

# Two squares side by side, the left one red, the right one with a picture, and a triangle of the scene's own material.
OBJ = """\
mtllib my colours.mtl
v -2 0 0
v 0 0 0
v 0 2 0
v -2 2 0
v 2 0 0
v 2 2 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl red one
f 1/1 2/2 3/3 4/4
usemtl wall
f 2/1 5/2 6/3 3/4
usemtl own
f 1/1 2/2 6/3
"""
MTL = """\
# made up
newmtl red one
  Ka 1 1 1
\tKd 0.6 0.1 0.05
newmtl wall
Kd 1 1 1
map_Kd pictures\\wall.png
newmtl unused
Kd 0.5
"""


def loaded(tmp_path: Path, obj: str = OBJ, mtl: str = MTL, **mesh: Any) -> Scene:
    assets = tmp_path / "assets"
    (assets / "pictures").mkdir(parents=True, exist_ok=True)
    (assets / "room.obj").write_text(obj)
    (assets / "my colours.mtl").write_text(mtl)
    Image.fromarray(np.full((2, 2, 3), (0, 255, 0), np.uint8)).save(assets / "pictures" / "wall.png")
    tables = {"camera": CAMERA, "materials": {"own": diffuse(0.2, 0.2, 0.2)}, "environment": {"colour": [1, 1, 1]}}
    return scene_from_tables(tables | {"meshes": [{"file": "assets/room.obj", **mesh}]}, tmp_path / "scene.toml")


def test_each_triangle_has_the_colour_or_the_picture_of_its_material(tmp_path: Path) -> None:
    """Lit evenly, the left square reflects most at long wavelengths, the right one in the middle."""
    found = loaded(tmp_path)
    assert [mesh.material for mesh in found.settings.meshes] == ["room:red one", "room:wall", "own"]
    assert [len(part.faces) for part in found.triangles] == [2, 2, 1] and list(found.images) == ["room:wall"]
    materials = found.settings.materials or {}
    assert materials["room:red one"].reflectance == (0.6, 0.1, 0.05) and "room:unused" not in materials
    made = World(found, SpectralRange(400, 700))
    left, right = (radiance(made, [x, 1.5, 3], [x, 1.5, 0], samples=3000).reshape(3, -1).mean(1) for x in (-1.5, 1.5))
    assert left[2] > 3 * left[0] and right[1] > 3 * max(right[0], right[2])


def test_a_mesh_with_a_material_of_the_scene_keeps_it(tmp_path: Path) -> None:
    found = loaded(tmp_path, material="own")
    assert len(found.triangles) == 1 and set(found.settings.materials or {}) == {"own"}


@pytest.mark.parametrize(
    ("obj", "mtl", "words"),
    [
        (
            OBJ.replace("usemtl wall", "usemtl door"),
            MTL,
            "usemtl: got 'door', expected a material of the scene or of my",
        ),
        (OBJ.replace("usemtl red one\n", ""), MTL, "none before a face"),
        (OBJ.replace("my colours", "other"), MTL, r"other\.mtl: file: got .missing."),
        (OBJ.replace("my colours", "9" * 400), MTL, r"9\.mtl: file"),
        (OBJ, MTL.replace("0.6 0.1 0.05", "0.6 2 0"), "line 4, Kd: got '0.6 2 0'"),
        (OBJ, MTL.replace("map_Kd ", "map_Kd -s 2 2 2 "), "without options"),
        (OBJ, MTL.replace("wall.png", "gone.png"), r"textures\.room:wall\.file"),
        (OBJ, "Kd 1 1 1\n", "newmtl before it"),
    ],
)
def test_what_is_missing_or_broken_is_named(obj: str, mtl: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        loaded(tmp_path, obj, mtl)


def test_a_picture_without_coordinates_leaves_the_colour(tmp_path: Path) -> None:
    bare = "\n".join(" ".join(word.split("/")[0] for word in line.split(" ")) for line in OBJ.splitlines())
    with pytest.warns(NeurolensWarning, match="no texture coordinates: wall.png is left out"):
        found = loaded(tmp_path, bare)
    assert (found.settings.materials or {})["room:wall"].reflectance == (1.0, 1.0, 1.0) and not found.images


def test_other_meshes_need_a_material(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"meshes\[0\]\.material: got .missing."):
        scene_from_tables({"camera": CAMERA, "meshes": [{"file": "a.ply"}]}, tmp_path / "scene.toml")
