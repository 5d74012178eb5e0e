"""Lights of any program as a camera sees them, for lists of `neurolens flare --lights`; without Blender."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np

Kind = Literal["sphere", "rectangle", "disc", "distant"]
Row = dict[str, str | float]  # of a list, by the names of its columns
FAR = 1e6  # how many units of the scene away a distant light is put
_TURN = math.pi * (3 - math.sqrt(5))  # angle of the sunflower's spiral
_PLASTIC = 1.3247179572447460  # ratio of the R2 sequence (Roberts 2018): x^3 = x + 1


class Seen(NamedTuple):
    """A light as seen from a place.

    Attributes:
        middle, sides: [3] and [2, 3], middle and half axes of the ellipse that is seen. half_rad: half angle of its
            cone.
        irradiance: that of a light of radiance 1, in sr. cos: of the angle between its axis and the way from it.
    """

    middle: Any
    sides: Any
    half_rad: float
    irradiance: float
    cos: float


def see(kind: Kind, frame: Any, size: tuple[float, ...], normalized: bool, eye: Any) -> Seen:
    """See a light that shines along -z of its frame [4, 4] from `eye`.

    Args:
        size: the radius of a sphere, both lengths of a rectangle or disc, or the angle (rad) of a distant light.
        normalized: whether its radiance is divided by its area, or for a distant light by its projected solid angle.
    """
    axes, middle = frame[:3, :3] / np.linalg.norm(frame[:3, :3], axis=0), frame[:3, 3]
    if kind == "distant":
        half, middle = size[0] / 2, eye + FAR * axes[:, 2]
        solid = 1.0 if normalized else math.pi * math.sin(half) ** 2
        return Seen(middle, FAR * math.tan(half) * axes.T[:2], half, solid, 1.0)
    far = max(float(np.linalg.norm(middle - eye)), 1e-9)
    way = (middle - eye) / far
    cos = float(axes[:, 2] @ way)
    if kind == "sphere":
        first = np.cross(way, np.eye(3)[np.argmin(np.abs(way))])
        first /= np.linalg.norm(first)
        sides = size[0] * np.stack([first, np.cross(way, first)])
        solid = (0.25 if normalized else math.pi * size[0] ** 2) / far**2
        return Seen(middle, sides, math.asin(min(size[0] / far, 1.0)), solid, cos)
    # an ellipse of the same area
    sides = frame[:3, :2].T * np.array(size)[:, None] / (2 if kind == "disc" else math.sqrt(math.pi))
    area = math.pi * float(np.linalg.norm(np.cross(*sides)))
    half = math.atan(math.sqrt(area * max(cos, 0.0) / math.pi) / far)
    return Seen(middle, sides, half, (1.0 if normalized else area) * max(cos, 0.0) / far**2, cos)


def see_faces(corners: Any, radiance: Any, eye: Any) -> tuple[Seen, Any]:
    """See triangles [N, 3, 3] of radiances [N, 3] as an ellipse of their middle and moments; also their irradiance [3].

    Each shines on both sides. A closed surface is seen by its near half: so only the triangles that turn their outer
    side to the eye count, or those that turn their inner side to it where these cover clearly more of its view.
    """
    middles, areas = corners.mean(1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    far = np.linalg.norm(middles - eye, axis=1).clip(1e-9)
    facing = ((eye - middles) * areas).sum(1) / far**3  # signed solid angles
    outer, inner = facing.clip(0), -facing.clip(None, 0)
    solid = outer if outer.sum() > 0.99 * inner.sum() else inner
    share = (solid * radiance.sum(1)) / max(float((solid * radiance.sum(1)).sum()), 1e-30)
    middle = share @ middles
    # the squares of these points have a triangle's moments
    off = np.concatenate([corners, 3 * middles[:, None] - 2 * middle], 1) - middle
    way = (middle - eye) / max(float(np.linalg.norm(middle - eye)), 1e-9)
    off -= (off @ way)[..., None] * way
    spread, axes = np.linalg.eigh(np.einsum("n,nki,nkj->ij", share, off, off) / 12)
    sides = (2 * np.sqrt(spread.clip(0)) * axes).T[1:]
    return Seen(middle, sides, math.atan(math.sqrt(solid.sum() / math.pi)), float(solid.sum()), 1.0), solid @ radiance


def ends(seen: Seen, eye: Any, pupil: Any, count: int) -> tuple[Any, Any]:
    """Return starts of rays [count, 3] on the pupil, with half axes [2, 3] about `eye`, and their ends on the light.

    The pupil is an ellipse with these half axes. An edge that passes in front of the light covers pupil and light
    little by little, so that even a light without size dims smoothly.
    """
    k = np.arange(count)
    of_light = np.sqrt((k + 0.5) / count) * np.exp(1j * _TURN * k)
    of_pupil = np.sqrt(k / _PLASTIC % 1) * np.exp(2j * math.pi * (k / _PLASTIC**2 % 1))
    start, end = (np.stack([p.real, p.imag], 1) for p in (of_pupil, of_light))
    return eye + start @ pupil, seen.middle + end @ seen.sides


def row(name: str, frame: int, seen: Seen, view: Any, unit_m: float, rgb: Any, visible: float) -> Row:
    """Return a row of a list; `view` [4, 4] is the camera's frame, which looks along -z, and `rgb` the irradiance."""
    way = (seen.middle - view[:3, 3]) @ (view[:3, :3] / np.linalg.norm(view[:3, :3], axis=0))
    far = max(float(np.linalg.norm(way)), 1e-9)
    return {
        "light": name, "frame": frame,
        "azimuth_deg": math.degrees(math.atan2(way[0], -way[2])),
        "elevation_deg": math.degrees(math.asin(max(-1.0, min(1.0, way[1] / far)))),
        **{c: float(v) for c, v in zip("rgb", rgb, strict=True)}, "visible": visible,
        "diameter_deg": min(math.degrees(2 * seen.half_rad), 90.0),
        **({"distance_m": max(far * unit_m, 1e-6)} if far < FAR / 2 else {}),
    }  # fmt: skip


def in_every_frame(rows: list[Row], frames: range) -> list[Row]:
    """Add dark rows where a light is missing: otherwise it would shine between its keys and beyond them."""
    known, found = {row["frame"]: row for row in rows}, rows[:1]
    for frame in frames:
        found.append(known.get(frame) or {**found[-1], "frame": frame, "visible": 0.0})
    return found[1:]
