"""neurolens: any lens prescription as a fast camera model with a measured error."""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurolens.front import Answer, Camera, Lens, fit, load, rays

    def _run(*given: Any, **named: Any) -> Answer: ...

    lens, camera = Lens.make, Camera.make
    analyse = bokeh = convert = copies = defocus = export = find = flare = handover = plan = \
        projection = psf = render = stmap = train = verify = _run  # fmt: skip

__version__ = "0.1.0"
# What pip calls this project. `neurolens` on PyPI is another one, with the same folder and command.
DISTRIBUTION = "neurolens-camera"
# The Python front: made by `front.of` when it is asked for.
__all__ = [
    "analyse", "bokeh", "camera", "convert", "copies", "defocus", "export", "find", "fit", "flare", "handover", "lens",
    "load", "plan", "projection", "psf", "rays", "render", "stmap", "train", "verify",
]  # fmt: skip

# onnxruntime reads this when it is imported. Otherwise 1.31 writes a device id and events into the user's cache folder
# and looks for a server to send them to; its own call to stop that comes too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


if not TYPE_CHECKING:  # to which any name would be one

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = import_module("neurolens.front").of(name)
        return globals()[name]


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})  # without what it imports
