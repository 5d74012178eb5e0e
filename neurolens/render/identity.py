"""What makes a render the render it is: all that its picture depends on, as JSON that two renders can compare."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from neurolens import __version__
from neurolens.cameras.contract import Camera
from neurolens.render.embree import tracer
from neurolens.render.film import PixelGrid
from neurolens.render.filmsettings import FilmSettings
from neurolens.render.scenefile import Scene

# Settings of a camera that say where it was read and what was noted, not what it does.
_NO_MATTER = ("model", "notes")
NOTHING = "(nothing)"  # a place that one of two identities lacks
_PROBES, _DIGITS = 1024, 16


def identity(
    scene: Scene, camera: Camera, grid: PixelGrid, seed: int, max_depth: int, film: FilmSettings, differentials: bool
) -> dict[str, Any]:
    """All that the sums of a film depend on, but for the number of samples.

    The scene is its tables, textures and meshes; the camera its settings and what it does with some rays. What traces
    meshes counts, too, for a picture shall not be half of one rounding and half of another.
    """
    settings = scene.settings.camera
    # What is given apart, and may be other than the scene's.
    common = replace(settings, width=1, height=1, samples=1, max_depth=1, focus_m=1.0, f_number=None)
    bare = replace(scene, name="", settings=replace(scene.settings, camera=common, film=FilmSettings()))
    kept = {key: value for key, value in camera.settings.items() if key not in _NO_MATTER}
    told = {
        "neurolens": __version__,
        "scene": digest(bare),
        "camera": {"name": camera.name, **kept, "rays": _rays(camera)},
        "width": grid.width,
        "height": grid.height,
        "film_mm": list(grid.film_mm),
        "seed": seed,
        "max_depth": max_depth,
        "wavelengths": film.wavelengths,
        "wavelength_sampling": film.wavelength_sampling,
        "white_balance": film.white_balance,
        "differentials": differentials,
    }
    if scene.triangles:
        told["meshes traced by"] = tracer()
    plain: dict[str, Any] = json.loads(json.dumps(told, default=str))
    return plain


def difference(found: Any, wanted: Any) -> tuple[str, Any, Any] | None:
    """The first place where two identities differ, with what is there in each; None where they agree."""
    one, other = _leaves(found), _leaves(wanted)
    for place in [*other, *one]:
        values = [side.get(place, NOTHING) for side in (one, other)]
        if json.dumps(values[0]) != json.dumps(values[1]):  # as text: NaN equals NaN
            return (place, *values)
    return None


def _leaves(tree: Any, place: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict) or not tree:
        return {place: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _leaves(value, f"{place}.{key}" if place else str(key))
    return found


def digest(value: Any) -> str:
    """Hexadecimal digits that stand for a value made of dataclasses, mappings, sequences, arrays and plain values."""
    hasher = hashlib.sha256()
    _feed(hasher, value)
    return hasher.hexdigest()[:_DIGITS]


def _feed(hasher: Any, value: Any) -> None:
    """Every part is preceded by what it is and how long, so that no two values read alike."""
    if isinstance(value, np.ndarray):
        hasher.update(f"array {value.dtype.str} {value.shape};".encode())
        hasher.update(np.ascontiguousarray(value).data)
    elif isinstance(value, Mapping):
        hasher.update(f"mapping {len(value)};".encode())
        for key in sorted(value, key=str):
            _feed(hasher, str(key))
            _feed(hasher, value[key])
    elif isinstance(value, (tuple, list)):
        hasher.update(f"sequence {len(value)};".encode())
        for item in value:
            _feed(hasher, item)
    elif is_dataclass(value):
        _feed(hasher, type(value).__name__)
        _feed(hasher, {field.name: getattr(value, field.name) for field in fields(value)})
    elif hasattr(value, "__dict__"):
        _feed(hasher, type(value).__name__)
        _feed(hasher, vars(value))
    else:
        text = repr(value)
        hasher.update(f"{type(value).__name__} {len(text)} {text};".encode())


def _rays(camera: Camera) -> str:
    """Digest of the rays of a fixed set of samples: no two cameras that differ share it."""
    random = np.random.default_rng(0)
    film = ((random.random((2, _PROBES)) - 0.5) * np.array(camera.film_mm)[:, None]).astype(np.float32)
    low, high = camera.wavelength_nm or (400.0, 700.0)
    nm = np.linspace(low, high, _PROBES).astype(np.float32)
    rays = camera.sample(film, random.random((2, _PROBES), np.float32), nm)
    passed = rays.status == 0
    told = [rays.status, *(np.where(passed, part, 0) for part in (rays.origin_m, rays.direction, rays.weight))]
    return digest(told)
