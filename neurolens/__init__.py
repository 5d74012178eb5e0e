"""neurolens: any lens prescription as a fast camera model with a measured error."""

import os
from typing import Any

__version__ = "0.1.0"
# What pip calls this project. `neurolens` on PyPI is another one, with the same folder and command.
DISTRIBUTION = "neurolens-camera"

# onnxruntime reads this when it is imported. Otherwise 1.31 writes a device id and events into the user's cache folder
# and looks for a server to send them to; its own call to stop that comes too late.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")


def __getattr__(name: str) -> Any:
    if name != "rays":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from neurolens.hosts import rays  # loads numpy and the renderer, which the command line does not need at once

    return rays
