"""Real lenses as cameras of Cycles: a panel at the camera's data. For Blender's own Python; imports no neurolens."""

from __future__ import annotations

import bpy

from .flare import CLASSES as OF_FLARE
from .panel import CLASSES, LIBRARY, CameraSettings, warn_of_black


def register() -> None:
    """Add menu, operators and panel."""
    for each in (*CLASSES, *OF_FLARE):
        bpy.utils.register_class(each)
    bpy.types.Camera.neurolens = bpy.props.PointerProperty(type=CameraSettings)
    bpy.types.Scene.neurolens_before = bpy.props.StringProperty(options={"HIDDEN"})
    LIBRARY.load()
    bpy.app.handlers.render_pre.append(warn_of_black)


def unregister() -> None:
    """Take them away; cameras keep their lenses, and render."""
    bpy.app.handlers.render_pre.remove(warn_of_black)
    LIBRARY.close()
    del bpy.types.Scene.neurolens_before
    del bpy.types.Camera.neurolens
    for each in reversed((*CLASSES, *OF_FLARE)):
        bpy.utils.unregister_class(each)
