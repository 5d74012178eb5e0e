"""Internal focusing: the groups move as the source's focus states say, between infinity and the nearest; film fixed.

The source lists a few states: infinity, sometimes one between, and the nearest, for every zoom position. One parameter
moves all gaps from state to state linearly (as a focus ring on straight cams would), and is solved for so that the
paraxial image of the object lies on the film.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from neurolens.base.errors import InputError
from neurolens.optics import paraxial
from neurolens.optics.interpolate import monotone
from neurolens.optics.prescription import Configuration, Lens

SAME_MM = 0.005  # gaps of two states that differ by less are the same: sources give two decimals


def at_infinity(lens: Lens) -> Lens:
    """The lens with its groups where they stand at infinity focus."""
    if not lens.infinity_mm:
        return lens
    return replace(lens.with_gaps(dict(lens.infinity_mm)), infinity_mm=())


def infinity_states(lens: Lens) -> list[Configuration]:
    """The zoom states of the source: those with the object at infinity."""
    return [c for c in lens.configurations if c.object_distance_mm is None]


def focus_states(lens: Lens) -> list[Configuration]:
    """The focus states of the source: those with an object at a distance."""
    return [c for c in lens.configurations if c.object_distance_mm is not None]


def zoom_state_of(lens: Lens, near: Configuration) -> Configuration | None:
    """The infinity state of the zoom position of a focus state; None where the file has none: its table then.

    Few gaps that differ, then small differences, tell which it is.
    """

    def unlikeness(base: Configuration) -> tuple[int, float]:
        gaps = gaps_mm(lens, base)
        differences = [abs(gaps[k] - t) for k, t in near.thickness_mm]
        return sum(d > SAME_MM for d in differences), sum(differences)

    return min(infinity_states(lens), key=unlikeness, default=None)


def gaps_mm(lens: Lens, *states: Configuration | None) -> dict[int, float]:
    """All thicknesses, by surface index, with those of the states on top of the lens's own, in that order."""
    gaps = {k: s.thickness_mm for k, s in enumerate(lens.surfaces)}
    for state in states:
        gaps.update(() if state is None else state.thickness_mm)
    return gaps


@dataclass(frozen=True)
class FocusPath:
    """How the gaps move while focusing: `steps[j]` holds what is added to each gap at the state j, 0 at infinity.

    `film` is the surface whose thickness is the distance to the film.
    """

    steps: tuple[Mapping[int, float], ...]
    film: int

    def moved(self, s: float) -> dict[int, float]:
        """What is added to the gaps at the parameter s, from 0 (infinity) to the number of states beyond."""
        j = min(int(s), len(self.steps) - 2)
        share = s - j
        low, high = self.steps[j], self.steps[j + 1]
        return {k: low[k] * (1 - share) + high[k] * share for k in low}


def focus_path(lens: Lens) -> FocusPath:
    """The path of a lens at infinity focus, at a state of its zoom or between (then interpolated in log EFL).

    Raises:
        InputError: a file without focus states.
    """
    if not focus_states(lens):
        raise InputError(lens.path, "focus", "internal", '"film" or "best": the file has no focus states')
    film = len(lens.surfaces) - 1
    moved = sorted({film, *(k for c in focus_states(lens) for k, _ in c.thickness_mm)})
    by_zoom: dict[Configuration | None, list[Configuration]] = {}
    for c in focus_states(lens):
        by_zoom.setdefault(zoom_state_of(lens, c), []).append(c)
    stages = min(len(found) for found in by_zoom.values())
    rows = []
    for base, found in by_zoom.items():
        start = gaps_mm(lens, base)
        near = sorted(found, key=lambda c: -(c.object_distance_mm or math.inf))[-stages:]
        ends = [gaps_mm(lens, base, c) for c in near]
        efl = paraxial.first_order(lens.with_gaps(start)).efl_mm
        rows.append((math.log(efl), [end[k] - start[k] for end in ends for k in moved]))
    rows.sort()
    place = math.log(paraxial.first_order(lens).efl_mm)
    place = min(max(place, rows[0][0]), rows[-1][0])
    flat = monotone([r[0] for r in rows], [r[1] for r in rows], place)
    steps = [dict.fromkeys(moved, 0.0)]
    for j in range(stages):
        steps.append(dict(zip(moved, flat[j * len(moved) :], strict=False)))
    return FocusPath(tuple(steps), film)


def focused_inside(lens: Lens, focus_m: float | None, object_mm: float | None = None) -> Lens:
    """The lens focused by moving its groups.

    Args:
        lens: at infinity focus; or in a focus state of its file, which is kept where `focus_m` is None.
        focus_m: distance from object to film; None is infinity.
        object_mm: from object to front vertex, of a focus state that was chosen by its name.

    Raises:
        InputError: a file without focus states, or a distance below the nearest, which it names.
    """
    if focus_m is None and object_mm is not None:
        return replace(lens, film_z_mm=paraxial.image_z_mm(lens, -object_mm))
    lens = at_infinity(lens)
    path = focus_path(lens)
    back_mm = paraxial.first_order(lens).back_focus_mm
    wanted = 0.0 if focus_m is None else 1 / (1000 * focus_m)

    def place(s: float) -> Lens:
        return _placed(lens, path, back_mm, s)

    furthest = len(path.steps) - 1
    nearest = _vergence(place(furthest))
    if not nearest > 0:
        raise InputError(lens.path, "focus", "internal", "focus states that focus nearer than infinity")
    if wanted > nearest * (1 + 1e-9):
        limit = f"at least {_rounded_up(1 / nearest / 1000):g} m, the nearest focus of the source's states"
        raise InputError(lens.path, "focus_m", focus_m, limit)
    s = _solve(lambda s: _vergence(place(s)) - wanted, furthest) if wanted else 0.0
    return replace(place(s), infinity_mm=tuple((k, lens.surfaces[k].thickness_mm) for k in path.steps[0]))


def _rounded_up(value: float) -> float:
    """A positive number with four digits, never below itself: a distance printed as the limit must be allowed."""
    step = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.ceil(value / step - 1e-9) * step


def nearest_focus_m(lens: Lens) -> float:
    """Nearest distance from object to film that internal focusing reaches."""
    lens = at_infinity(lens)
    path = focus_path(lens)
    back_mm = paraxial.first_order(lens).back_focus_mm
    return 1 / _vergence(_placed(lens, path, back_mm, len(path.steps) - 1)) / 1000


def _placed(lens: Lens, path: FocusPath, back_mm: float, s: float) -> Lens:
    """The lens with its groups moved; the film stays where it is beside the groups that stand still."""
    added = path.moved(s)
    gaps = {k: lens.surfaces[k].thickness_mm + v for k, v in added.items() if k != path.film}
    moved = lens.with_gaps(gaps)
    return replace(moved, film_z_mm=moved.vertices_mm[path.film] + back_mm + added[path.film])


def _vergence(lens: Lens) -> float:
    """1 / distance (1/mm) from the film to the object that is in focus on it; 0 for infinity (Newton: x x' = -f^2)."""
    data = paraxial.first_order(lens)
    assert lens.film_z_mm is not None
    extension = lens.film_z_mm - data.rear_focal_z_mm
    return float(extension / (data.efl_mm**2 + extension * (lens.film_z_mm - data.front_focal_z_mm)))


def _solve(excess: Callable[[float], float], furthest: float) -> float:
    """Root between 0 (below) and `furthest` (above): regula falsi with halving (Illinois), to rounding."""
    low, high, f_low, f_high = 0.0, float(furthest), excess(0.0), excess(float(furthest))
    for _ in range(100):
        s = high - f_high * (high - low) / (f_high - f_low) if f_high != f_low else high
        f = excess(s)
        if f == 0 or abs(high - low) < 1e-14:
            return s
        if f > 0:
            high, f_high, f_low = s, f, f_low / 2
        else:
            low, f_low, f_high = s, f, f_high / 2
    return s
