"""The lights of a USD stage as a list for `neurolens flare --lights`, seen by its first camera; needs usd-core.

    python -m experiments usd-lights shot.usda --frames 1:48 -o lights.json

A light's radiance is intensity * 2^exposure * colour, over its area where it is normalised (UsdLux). Meshes that the
stage shows hide lights. Domes, cylinders, portals and lights of geometry are no lights here.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from neurolens.base.errors import InputError, warn
from neurolens.base.files import atomic_write_text
from neurolens.cli.keys import _frames as frames_of
from neurolens.pictures.render.primitives import Mesh, Rays
from neurolens.programs.blender import extension_library

OPTIONS = (
    lab.option("stage", type=Path, metavar="STAGE", help="USD file"),
    lab.option(
        "--frames",
        type=frames_of,
        default=range(1),
        metavar="FIRST:LAST",
        help="time codes, whole numbers (default: 0)",
    ),
    lab.option(
        "-o", "--output", type=Path, default=Path("lights.json"), metavar="OUT.json", help="default: lights.json"
    ),
)
_RAYS = 256  # to each light in a frame
_PIXEL = 1e-4  # of the way to a light, within which a surface is its own


def usd_rows(path: Path, frames: range) -> list[dict[str, Any]]:
    """The rows of all lights in these frames, or in a stage without time codes in its only state.

    Warns:
        NeurolensWarning: lights of kinds that are left out.

    Raises:
        InputError: usd-core is not installed, no such stage, a stage without camera or lights.
    """
    try:
        from pxr import Tf, Usd, UsdGeom
    except ImportError:
        raise InputError(path, "--lights", path.suffix, "a list; or usd-core: pip install usd-core") from None
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise InputError(path, "--lights", f"({str(error).strip().splitlines()[-1]})", "a USD stage") from None
    prims = list(stage.Traverse(Usd.TraverseInstanceProxies()))
    camera = next((prim for prim in prims if prim.IsA(UsdGeom.Camera)), None)
    if camera is None:
        raise InputError(path, "camera", "(none)", "a stage with a camera, which sees the lights")
    known: dict[str, list[dict[str, Any]]] = {}
    for frame in frames:
        for row in _rows_at(stage, prims, camera, frame):
            known.setdefault(row["light"], []).append(row)
    left = sorted({str(p.GetTypeName()) for p in prims if str(p.GetTypeName()).endswith("Light")} - _KINDS.keys())
    if left:
        warn(f"{path}: left out: {', '.join(left)}")
    if not known:
        raise InputError(path, "lights", "(none)", f"at least one of {', '.join(_KINDS)}")
    return [row for rows in known.values() for row in extension_library("lights").in_every_frame(rows, frames)]


# Kinds of lights, and the attributes of their sizes with their defaults and factors.
_KINDS: dict[str, tuple[str, list[tuple[str, float]]]] = {
    "SphereLight": ("sphere", [("radius", 1.0)]),
    "RectLight": ("rectangle", [("width", 1.0), ("height", 1.0)]),
    "DiskLight": ("disc", [("radius", 2.0), ("radius", 2.0)]),
    "DistantLight": ("distant", [("angle", np.pi / 180)]),
}


def _rows_at(stage: Any, prims: list[Any], camera: Any, frame: int) -> Iterator[dict[str, Any]]:
    from pxr import UsdGeom

    lights, cache = extension_library("lights"), UsdGeom.XformCache(frame)

    def frame_of(prim: Any) -> NDArray[np.float64]:
        return np.array(cache.GetLocalToWorldTransform(prim)).T

    def shown(prim: Any) -> bool:
        return bool(UsdGeom.Imageable(prim).ComputeVisibility(frame) != UsdGeom.Tokens.invisible)

    view, lens = frame_of(camera), UsdGeom.Camera(camera)
    eye, opened = view[:3, 3], lens.GetFStopAttr().Get(frame)
    radius = lens.GetFocalLengthAttr().Get(frame) / 20 / opened if opened else 0.0  # focal lengths are in tenths
    pupil = radius * (view[:3, :2] / np.linalg.norm(view[:3, :2], axis=0)).T
    corners = [_triangles(p, frame, frame_of(p)) for p in prims if p.IsA(UsdGeom.Mesh) and shown(p)]
    found = np.concatenate(corners) if corners else np.empty((0, 3, 3))
    walls = Mesh(0, found - eye) if len(found) else None
    for prim in prims:
        kind = _KINDS.get(str(prim.GetTypeName()))
        if kind is None or not shown(prim):
            continue

        def value(name: str, default: Any, prim: Any = prim) -> Any:
            attribute = prim.GetAttribute(f"inputs:{name}")
            got = attribute.Get(frame) if attribute else None
            return default if got is None else got

        size, matrix = tuple(factor * value(name, 1.0) for name, factor in kind[1]), frame_of(prim)
        if kind[0] == "sphere":
            size = (size[0] * float(np.cbrt(abs(np.linalg.det(matrix[:3, :3])))),)
        seen = lights.see(kind[0], matrix, size, value("normalize", False), eye)
        rgb = (
            seen.irradiance
            * value("intensity", 1.0)
            * 2.0 ** value("exposure", 0.0)
            * np.array(value("color", (1, 1, 1)))
        )
        cone = value("shaping:cone:angle", 180.0)
        rgb = rgb * _tint(value) * (cone >= 180 or seen.cos > np.cos(np.radians(cone)))
        start, end = lights.ends(seen, eye, pupil, _RAYS)
        free = 1.0 if walls is None else _free(walls, start - eye, end - start)
        yield lights.row(str(prim.GetPath()), frame, seen, view, UsdGeom.GetStageMetersPerUnit(stage), rgb, free)


def _tint(value: Any) -> NDArray[np.float64]:
    from pxr import UsdLux

    warm = value("enableColorTemperature", False)
    return np.array(UsdLux.BlackbodyTemperatureAsRgb(value("colorTemperature", 6500.0)) if warm else (1.0, 1.0, 1.0))


def _triangles(prim: Any, frame: int, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The triangles [T, 3, 3] of a mesh in the world, its polygons cut into fans."""
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    points, counts, corners = (
        np.array(attribute.Get(frame) or [], kind)
        for attribute, kind in (
            (mesh.GetPointsAttr(), np.float64),
            (mesh.GetFaceVertexCountsAttr(), np.int64),
            (mesh.GetFaceVertexIndicesAttr(), np.int64),
        )
    )
    first = np.repeat(np.cumsum(counts) - counts, np.maximum(counts - 2, 0))
    fan = np.concatenate([np.arange(1, n - 1) for n in counts]) if len(counts) else counts
    places = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    return places[np.stack([corners[first], corners[first + fan], corners[first + fan + 1]], axis=1)]


def _free(walls: Mesh, start: NDArray[np.float64], way: NDArray[np.float64]) -> float:
    """The share of rays, along `way` [N, 3] to their ends, that meet no wall."""
    length = np.linalg.norm(way, axis=1)
    rays = Rays.of(start.T.astype(np.float32), (way / length[:, None]).T.astype(np.float32))
    best, hit = (length * (1 - _PIXEL)).astype(np.float32), np.full(len(way), -1, np.int32)
    walls.nearer(rays, best, hit)
    return float((hit < 0).mean())


def run(args: argparse.Namespace) -> None:
    """Write the list."""
    rows = usd_rows(args.stage, args.frames)
    atomic_write_text(args.output, json.dumps(rows, indent=1))
    print(f"{len({row['light'] for row in rows})} lights in {args.output}")
