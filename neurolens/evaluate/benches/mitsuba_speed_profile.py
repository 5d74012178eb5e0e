"""Where the time of our renderer goes, scene by scene: a profile of one worker, summed up by what the code is for."""

from __future__ import annotations

import cProfile
import pstats
from functools import cache
from pathlib import Path
from typing import Any

import neurolens
from neurolens.cameras.contract import Camera
from neurolens.cameras.thin import ThinLens
from neurolens.render.renderer import render
from neurolens.render.scene import Scene

STAGES = ("camera", "intersection", "lights", "shading", "random numbers", "integrator", "film, set-up")
_ROOT = str(Path(neurolens.__file__).parent)
# Part of the renderer to stage; the world's functions are told apart by name.
_STAGE = {
    "primitives": "intersection",
    "spheres": "intersection",
    "mesh": "intersection",
    "embree": "intersection",
    "lights": "lights",
    "arealights": "lights",
    "pointlights": "lights",
    "environment": "lights",
    "sky": "lights",
    "scatter": "shading",
    "materials": "shading",
    "coat": "shading",
    "directions": "shading",
    "palette": "shading",
    "textures": "shading",
    "sampler": "random numbers",
    "integrator": "integrator",
}
_OF_THE_WORLD = {"nearest": "intersection", "visible": "intersection", "surfaces": "intersection"}
_FUNCTIONS = {"aim_at_lights": "lights"}
_HELPERS = {"dot", "take", "cut"}  # which count as part of those who call them

Function = tuple[str, int, str]


def thin_camera(scene: Scene) -> ThinLens:
    """A 50 mm thin lens with the scene's focus and stop, as `neurolens.render.bench` has it."""
    settings = scene.settings.camera
    film_mm = (settings.film_width_mm, settings.film_height_mm)
    return ThinLens(50.0, settings.f_number or 2.8, settings.focus_m, film_mm)


def profile(scene: Scene, camera: Camera, width: int, height: int, samples: int) -> dict[str, float]:
    """Share of the time of each of `STAGES` in a render by one worker, adding up to 1."""
    profiler = cProfile.Profile()
    profiler.enable()
    render(scene, camera, width=width, height=height, samples=samples, threads=1)
    profiler.disable()
    return shares(pstats.Stats(profiler))


def shares(stats: pstats.Stats) -> dict[str, float]:
    """Own time of every function by stage; that of numpy and of helpers belongs to those who called them."""
    table: dict[Function, Any] = stats.stats  # type: ignore[attr-defined]
    path: set[Function] = set()

    @cache
    def split(function: Function) -> tuple[float, ...]:
        own = _stage_of(function)
        if own is not None:
            return tuple(float(stage == own) for stage in STAGES)
        callers = {k: v[2] + 1e-12 for k, v in table[function][4].items() if k not in path and k != function}
        total = sum(callers.values())
        if not total:
            return tuple(float(stage == STAGES[-1]) for stage in STAGES)
        path.add(function)
        parts = [(seconds / total, split(caller)) for caller, seconds in callers.items()]
        path.discard(function)
        return tuple(sum(share * part[k] for share, part in parts) for k in range(len(STAGES)))

    spent = dict.fromkeys(STAGES, 0.0)
    for function, (_, _, own_s, _, _) in table.items():
        for stage, share in zip(STAGES, split(function), strict=True):
            spent[stage] += own_s * share
    total = sum(spent.values())
    return {stage: seconds / total for stage, seconds in spent.items()}


def _stage_of(function: Function) -> str | None:
    """Stage of a function of ours; None for helpers and for all others."""
    file, _, name = function
    if not file.startswith(_ROOT) or name in _HELPERS:
        return None
    part, module = Path(file).parent.name, Path(file).stem
    if part == "cameras" or name in ("_hero_rays", "_camera_rays"):
        return "camera"
    if part != "render":
        return STAGES[-1]
    if module == "world":
        return _OF_THE_WORLD.get(name, "shading")
    return _FUNCTIONS.get(name) or _STAGE.get(module, STAGES[-1])
