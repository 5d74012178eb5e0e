"""A Blender of its own for these tests, which `make test-blender` has."""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from pathlib import Path


def _prepare(origin: str) -> None:
    """Give Blender as a module empty user folders, and its compiler of shaders what it asks for."""
    os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="neurolens-blender-")
    places = Path(origin).parent.glob("*/python/lib/python*/site-packages")
    sys.path += [str(p) for p in places if (p / "oslquery").is_dir()]


if (_found := importlib.util.find_spec("bpy")) is not None and _found.origin is not None:
    _prepare(_found.origin)
