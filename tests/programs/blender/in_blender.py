"""What the tests in Blender share. Where there is no Blender, the tests of a module that imports this are skipped."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

bpy: Any = pytest.importorskip("bpy", reason="Blender as a module (bpy) is not installed: make test-blender runs these")

MODULE = "bl_ext.user_default.neurolens"
FOLDER = Path(os.environ.get("NEUROLENS_BLENDER_SHOTS", ""))  # of what expect.py writes
with_shots = pytest.mark.skipif(
    not FOLDER.name, reason="no numbers of tests/programs/blender/expect.py: make test-blender"
)


def first_scene(camera: bool = True) -> Any:
    """The scene that Blender starts with, of which only the camera is left, or nothing."""
    bpy.ops.wm.read_homefile(app_template="", use_factory_startup=True)
    for thing in list(bpy.data.objects):
        if thing.type != "CAMERA" or not camera:
            bpy.data.objects.remove(thing)
    scene = bpy.context.scene
    scene.render.resolution_percentage, scene.view_settings.view_transform = 100, "Raw"
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth, scene.cycles.use_denoising = "OPEN_EXR", "32", False
    return scene


def surroundings(scene: Any, *colour: float) -> None:
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (*colour, 1)


def surface(kind: str, name: str = "surface") -> tuple[Any, Any]:
    """A new material whose surface is one node of a kind, and that node."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # to Blender 4.5
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    node, out = nodes.new(f"ShaderNode{kind}"), nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(node.outputs[0], out.inputs["Surface"])
    return material, node


def pixels_of(file: Path) -> Any:
    """The pixels [H, W, 4] of an OpenEXR file, the lowest row first, by Blender's OpenImageIO: Blender 4.5 itself
    cannot read the file of one eye of a stereo render."""
    import OpenImageIO

    return OpenImageIO.ImageInput.open(str(file)).read_image("float")[::-1].astype(float)


def rendered(scene: Any, folder: Path, frame: int = 1, eye: str = "") -> Any:
    """The pixels of a render, with stereo of an eye, "_L" or "_R"."""
    scene.frame_set(frame)
    scene.render.filepath = str(folder / "render.exr")
    bpy.ops.render.render(write_still=True)
    return pixels_of(folder / f"render{eye}.exr")


@contextmanager
def installed_pack(folder: Path, lenses: list[Any]) -> Iterator[Path]:
    """A zip of the extension with these lenses, installed as from disk and enabled."""
    from neurolens.programs.blender import write_pack

    out = folder / "neurolens.zip"
    write_pack(out, lenses)
    bpy.ops.extensions.package_install_files(filepath=str(out), repo="user_default", enable_on_install=True)
    yield out
    bpy.ops.preferences.addon_disable(module=MODULE)
