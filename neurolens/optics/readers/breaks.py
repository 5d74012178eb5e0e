"""Tilts and decentres of lens files: where each surface stands, when it is placed from the one before it.

A file walks from surface to surface in local axes: a tilt or a decentre moves and turns them, and a thickness is a step
along the turned z. The lens model has one axis instead, and a `Placement` for each surface that is away from it. That
axis is the film's: what a file turns before a lens and never turns back turns the film as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.optics.lens.placement import CENTRED, MOST_DECENTRE_MM, MOST_TILT_DEG, Placement
from neurolens.optics.readers.source import Line

_ROUNDING = 1e-9  # in degrees, and in the unit of the file: what walking there and back leaves


@dataclass(frozen=True)
class Turn:
    """A displacement and a rotation of the local axes at a surface.

    Attributes:
        placement: the move, and the right-handed turns about x, then the new y, then the new z.
        tilts_first: whether the axes are turned about z, then y, then x, before they move along their new directions.
        returns: whether the axes return behind the surface, which alone is then placed so.
        undoes: whether the surface stands in the axes as they are, and the inverse of `placement` moves and turns them
            behind it.
    """

    placement: Placement
    tilts_first: bool = False
    returns: bool = False
    undoes: bool = False


@dataclass(frozen=True)
class Step:
    """A surface of the file: the line that names it, its turn, and the thickness behind it, in the file's unit."""

    line: Line
    turn: Turn | None
    thickness: float


@dataclass(frozen=True)
class _Axes:
    """Local axes: their origin [3], and x, y and z as columns [3, 3]."""

    origin: NDArray[np.float64]
    axes: NDArray[np.float64]

    def then(self, move: NDArray[np.float64], turn: NDArray[np.float64]) -> _Axes:
        return _Axes(self.origin + self.axes @ move, self.axes @ turn)

    def seen_from(self, other: _Axes) -> _Axes:
        return _Axes(other.axes.T @ (self.origin - other.origin), other.axes.T @ self.axes)


def placements(steps: Sequence[Step]) -> list[Placement]:
    """Return where the surfaces of a file stand about the axis of its film, which is the last step.

    Raises:
        InputError: a surface is farther away, or more inclined, than lens files may say.
    """
    if not any(step.turn for step in steps):
        return [CENTRED] * (len(steps) - 1)
    here, found = _Axes(np.zeros(3), np.eye(3)), list[_Axes]()
    for step in steps:
        before, behind = _moves(step.turn)
        place = here.then(*before)
        found.append(place)
        after = here if step.turn and step.turn.returns else place.then(*behind)
        here = after.then(np.array([0.0, 0.0, step.thickness]), np.eye(3))
    film, total = found[-1], math.fsum(step.thickness for step in steps[:-1])
    centred, z = list[Placement](), 0.0
    for step, place in zip(steps[:-1], found, strict=False):
        seen = place.seen_from(film)
        centred.append(_checked(step.line, Placement.of(seen.origin - [0.0, 0.0, z - total], seen.axes)))
        z += step.thickness
    return centred


def _moves(turn: Turn | None) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
    """Return move [3] and turn [3, 3] of the axes in front of a surface, and behind it."""
    nothing = np.zeros(3), np.eye(3)
    if turn is None:
        return nothing, nothing
    move, axes = np.array(turn.placement.moved_mm), turn.placement.axes
    if turn.undoes:
        return nothing, (-(axes.T @ move), axes.T)
    if turn.tilts_first:
        x, y, z = (-t for t in turn.placement.tilt_deg)
        axes = Placement(tilt_deg=(x, y, z)).axes.T  # the inverse of the opposite turns: about z, y, then x
        move = axes @ move
    return (move, axes), nothing


def _checked(line: Line, placement: Placement) -> Placement:
    x, y, z, a, b, c = (v if abs(v) >= _ROUNDING else 0.0 for v in (*placement.moved_mm, *placement.tilt_deg))
    placement = Placement((x, y, z), (a, b, c))
    for what, values, most in (
        ("decentre", placement.moved_mm, MOST_DECENTRE_MM),
        ("tilt", placement.tilt_deg[:2], MOST_TILT_DEG),
    ):
        if not max(map(abs, values)) <= most:
            found = ", ".join(f"{v:.6g}" for v in values)
            raise line.error(f"{what} from the film's axis", f"({found})", f"at most {most:g}")
    return placement
