"""How the film stands: turned about two axes, and moved in its plane.

A lens takes rays, whatever film they come from. The line from a point of a turned film through a point of the pupil
meets the plane of an upright film, in which the axis meets both films, elsewhere: `to_plane` finds the place and what
the turn does to the light, `to_film` the way back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import warn
from neurolens.graph.ir import Graph
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import POSES, Shot

_HAIR = 1e-18  # mm; added so that the axis stays finite
TURNS = "tilt_sin", "tilt_cos", "swing_sin", "swing_cos"  # inputs of a call, for a film that is turned at run time


@dataclass(frozen=True)
class FilmPose:
    """How a film stands. With all figures 0 it stands upright and centred, and `bool(pose)` is False.

    Attributes:
        tilt, swing: turns (rad) as `Shot.film_tilt_deg` and `Shot.film_swing_deg` state them.
        moved_mm: what is taken from a film point before the film is turned: shift and rise.
    """

    tilt: float = 0.0
    swing: float = 0.0
    moved_mm: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def of(shot: Shot) -> FilmPose:
        """Return how the film of a shot stands."""
        return FilmPose.in_settings(vars(shot))

    @staticmethod
    def in_settings(settings: Mapping[str, Any]) -> FilmPose:
        """Return how the film of a camera of these settings stands; ideal cameras have none of `POSES`."""
        tilt, swing, shift, rise = (settings.get(name) or 0.0 for name in POSES)
        return FilmPose(math.radians(tilt), math.radians(swing), (shift, rise))

    def __bool__(self) -> bool:
        return self.turned or any(self.moved_mm)

    @property
    def turned(self) -> bool:
        """Return whether the film is not square to the axis."""
        return bool(self.tilt or self.swing)

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """Return the film's x, its y and its normal as columns [3, 3] in the lens frame."""
        return np.array(_axes(*(part(a) for a in (self.tilt, self.swing) for part in (math.sin, math.cos))))

    def covers_mm(self, film_mm: tuple[float, float], distance_mm: float) -> tuple[float, float]:
        """Return width and height of the least upright film that hides this film as seen from the pupil's middle.

        Args:
            film_mm: width and height. distance_mm: from the pupil to the film on the axis.
        """
        if not self:
            return film_mm
        corners = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1]]) * np.array(film_mm)[:, None] / 2
        x, y, depth = self.axes[:, :2] @ (corners - np.array(self.moved_mm)[:, None])
        away = np.maximum(1 + depth / distance_mm, 0.1)  # the film of a short lens may reach its pupil
        return 2 * float(np.abs(x / away).max()), 2 * float(np.abs(y / away).max())

    def lean(self, film_mm: tuple[float, float], distance_mm: float) -> float:
        """Return the largest |lean| over the film; `to_plane` says what it is."""
        corners = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1]]) * np.array(film_mm)[:, None] / 2
        depth = self.axes[2, :2] @ (corners - np.array(self.moved_mm)[:, None]) / distance_mm
        return float(np.abs(depth / np.maximum(1 + depth, 0.1)).max())


UPRIGHT = FilmPose()


def warn_beyond(path: Path, lens: Lens, pose: FilmPose) -> None:
    """Warn of a film that stands as the product's mount cannot hold its lens, where the lens file states how far.

    Args:
        path: of the lens or the model, which the warning names.
    """
    tilt, shift = math.degrees(math.hypot(pose.tilt, pose.swing)), math.hypot(*pose.moved_mm)
    for asked, most, what in (
        (tilt, lens.most_tilt_deg, "degrees of tilt"),
        (shift, lens.most_shift_mm, "mm of shift"),
    ):
        if most is not None and asked > most * (1 + 1e-9):
            warn(f"{path}: {asked:.3g} {what} are more than the {most:g} of the product; they are taken as asked")


def _axes(sin: Any, cos: Any, sway: Any, stay: Any) -> list[list[Any]]:
    """Return `FilmPose.axes` by sine and cosine of tilt and swing, which are floats or values of a graph."""
    return [[stay, -sway * sin, -sway * cos], [0.0, cos, -sin], [sway, stay * sin, stay * cos]]


@lru_cache(maxsize=16)
def to_plane(pose: FilmPose | None, radius_mm: float | None, derivatives: tuple[str, ...] = ()) -> Graph:
    """Write the graph from rays of a film to rays of the upright film plane.

    Args:
        pose: how the film stands; None takes a turn by `TURNS`, which are then inputs of the call.
        radius_mm: the last film radius of the outline; None leaves central points where they are.
        derivatives: names of derivatives of `scene_ray` by a point of the plane, along x and y: inputs and outputs.

    Inputs are `film_mm` [2] on the film, `pupil_mm` [2], `area_mm2` and, for a whole call, `per_distance`. Outputs are
    `plane_mm` [2], where the ray meets the plane; `area_mm2`, by which its weight on the plane is that on the film;
    `central_mm` [2], where the line through the middle of the pupil meets the plane, within the radius; and `lean`, the
    share by which the ray's place on the plane lies from there towards its pupil point: plane = central + lean pupil.
    """
    g = Graph()
    film, pupil, area = g.input("film_mm", 2), g.input("pupil_mm", 2), g.input("area_mm2")
    moved = film - list(pose.moved_mm) if pose is not None and any(pose.moved_mm) else film
    moves = [g.input(name, 6) for name in derivatives]
    if pose is not None and not pose.turned:
        g.outputs = {"central_mm": moved, "plane_mm": moved, "area_mm2": area, "lean": 0.0 * area}
        g.outputs |= dict(zip(derivatives, moves, strict=True))
        return g
    per_distance = g.input("per_distance", per_call=True)
    turns = _axes(*(g.input(name, per_call=True) for name in TURNS)) if pose is None else pose.axes.tolist()
    rows = [[g.value(cell) for cell in row] for row in turns]
    across, (x_z, y_z, facing) = [g.concat(*pair) for pair in zip(*rows[:2], strict=True)], rows[2]
    place, depth = across[0] * moved[0] + across[1] * moved[1], (x_z * moved[0] + y_z * moved[1]) * per_distance
    nearer = 1.0 / (1.0 + depth)  # distance of the plane over that of the point, from the pupil
    way, central = pupil - place, place * nearer
    if radius_mm is not None:
        central = central * (0.9999 * radius_mm / g.square(central).sqrt().maximum(_HAIR)).minimum(1.0)
    g.outputs["central_mm"] = central
    g.outputs["plane_mm"] = place + way * (depth * nearer)
    g.outputs["lean"] = depth * nearer
    g.outputs["area_mm2"] = area * nearer * nearer * (facing - g.dot(across[2], way) * per_distance * nearer)
    if moves:
        far = per_distance * nearer * nearer
        for k, name in enumerate(derivatives):
            step = way * (far * (x_z, y_z)[k]) + nearer * across[k]
            g.outputs[name] = moves[0] * step[0] + moves[1] * step[1]
    return g


@lru_cache(maxsize=16)
def to_film(pose: FilmPose) -> Graph:
    """Write the graph from `plane_mm` and `pupil_mm` [2] to the `film_mm` [2] of a film; `per_distance` as before."""
    g = Graph()
    place, pupil = g.input("plane_mm", 2), g.input("pupil_mm", 2)
    if pose.turned:
        back = np.linalg.inv(pose.axes[:2, :2])
        slope, way = pose.axes[2:, :2] @ back, pupil - place
        per_distance = g.input("per_distance", per_call=True)
        # The film is z = slope . (x, y); along the ray z falls by the distance of the pupil.
        along = g.affine(-slope, place) * per_distance / (1.0 + g.affine(slope, way) * per_distance)
        place = g.affine(back, place + way * along)
    g.outputs["film_mm"] = place + list(pose.moved_mm) if any(pose.moved_mm) else place
    return g
