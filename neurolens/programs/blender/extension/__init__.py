"""Real lenses as cameras of Cycles: a panel at the camera's data. For Blender's own Python; imports no neurolens."""

from __future__ import annotations

import bpy

from .flare import CLASSES as OF_FLARE
from .panel import CLASSES, HANDLERS, LIBRARY, CameraSettings


def register() -> None:
    """Add menu, operators and panel to Blender."""
    for each in (*CLASSES, *OF_FLARE):
        bpy.utils.register_class(each)
    bpy.types.Camera.neurolens = bpy.props.PointerProperty(type=CameraSettings)
    bpy.types.Scene.neurolens_before = bpy.props.StringProperty(options={"HIDDEN"})
    LIBRARY.load()
    for when, act in HANDLERS:
        getattr(bpy.app.handlers, when).append(act)


def unregister() -> None:
    """Take menu, operators and panel away. Cameras keep their lenses, and render."""
    for when, act in HANDLERS:
        getattr(bpy.app.handlers, when).remove(act)
    LIBRARY.close()
    del bpy.types.Scene.neurolens_before
    del bpy.types.Camera.neurolens
    for each in reversed((*CLASSES, *OF_FLARE)):
        bpy.utils.unregister_class(each)
