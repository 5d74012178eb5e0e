"""The layers of a picture of `neurolens flare` added in Blender's compositor; for the Python of Blender 4.5 and later.

In Blender: open this file in the text editor, write the picture's path into PICTURE, and run it. From a shell:

    blender shot.blend --background --python flare_in_blender.py -- flare.0001.exr
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import bpy

PICTURE = "//flare.0001.exr"  # // is the folder of the .blend file; of a sequence any of its pictures


def add_layers(scene: Any, path: Path) -> list[str]:
    """Add the layers of a picture of `neurolens flare`, or of its sequence, to what goes to the compositor's output.

    A group does it, whose inputs are a gain for each layer. Returns the names of the layers.

    Raises:
        ValueError: no such picture.
    """
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError:
        raise ValueError(f"{path} is no picture that Blender can read") from None
    group = bpy.data.node_groups.new(f"Flare {path.stem}", "CompositorNodeTree")
    node, numbered = group.nodes.new("CompositorNodeImage"), re.fullmatch(r"(.*\.)\d+", path.stem)
    node.image = image
    if numbered:  # a frame's picture is the one of its number
        image.source = "SEQUENCE"
        files = (re.fullmatch(rf"{re.escape(numbered[1])}(\d+)", other.stem) for other in path.parent.iterdir())
        node.frame_start, node.frame_offset = 1, 0
        node.frame_duration, node.use_auto_refresh = max(int(file[1]) for file in files if file), True
    layers = {o.name: o for o in node.outputs if o.name not in ("Combined", "Image", "Alpha")}
    if "rest" in layers:  # with the layers of single ghosts it is all ghosts
        layers.pop("ghosts", None)
    layers = layers or {"flare": node.outputs[0]}
    start, end = (group.nodes.new(f"NodeGroup{way}") for way in ("Input", "Output"))
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Image", in_out=way, socket_type="NodeSocketColor")
    last = start.outputs[0]
    for k, (name, output) in enumerate(layers.items()):
        gain = group.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        gain.default_value, gain.min_value = 1.0, 0.0
        mix = group.nodes.new("ShaderNodeMix")
        mix.data_type, mix.blend_type, mix.clamp_factor, mix.location = "RGBA", "ADD", False, (200 * k, 0)
        sockets = {socket.identifier: socket for socket in mix.inputs}
        for source, to in ((start.outputs[k + 1], "Factor_Float"), (last, "A_Color"), (output, "B_Color")):
            group.links.new(source, sockets[to])
        last = next(socket for socket in mix.outputs if socket.identifier == "Result_Color")
    group.links.new(last, end.inputs[0])
    node.location, start.location, end.location = (-300, -200), (-300, 100), (200 * len(layers), 0)
    splice(scene, group)
    return list(layers)


def splice(scene: Any, group: Any) -> None:
    """Put a group before the output of the scene's compositor, which is made where there is none."""
    if hasattr(scene, "compositing_node_group"):
        tree, kind = scene.compositing_node_group, "NodeGroupOutput"
        if tree is None:
            tree = scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
            tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    else:  # to Blender 4.5
        scene.use_nodes = True
        tree, kind = scene.node_tree, "CompositorNodeComposite"
    end = next((n for n in tree.nodes if n.bl_idname == kind), None) or tree.nodes.new(kind)
    links = end.inputs[0].links
    source = links[0].from_socket if links else tree.nodes.new("CompositorNodeRLayers").outputs["Image"]
    added = tree.nodes.new("CompositorNodeGroup")
    added.node_tree, added.label = group, group.name
    added.location, end.location = end.location, (end.location[0] + 300, end.location[1])
    tree.links.new(source, added.inputs[0])
    tree.links.new(added.outputs[0], end.inputs[0])


if __name__ == "__main__":
    named = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    print("added", ", ".join(add_layers(bpy.context.scene, Path(bpy.path.abspath((named or [PICTURE])[0])))))
    if named:
        bpy.ops.wm.save_mainfile()
