"""Single changes that make a doubtful table sound: wrong signs and digits, swapped glasses, missing aspheres."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.data.table_figures import Measures, measure
from neurolens.base.report import Report
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import Profile
from neurolens.optics.photographs.rims import at_focal_length

Array = NDArray[np.float64]

# What nearly all sound tables keep (experiments/results/faults.md), and half as much again: limits that just hold for
# the tables that set them would refuse twice as many others.
ALARM = Measures(*(1.5 * np.array(most) for most in (0.75, 55.0, 1.0, 0.9, 0.32, 5.5, 0.4)))
_UNITS = {10.0: "centimetres", 25.4: "inches"}
_OF_TERMS = (-1.0, "the sign"), (10.0, "the exponent (10 times)"), (0.1, "the exponent (a tenth)")
_POWERS, _ROUNDS = (4, 6, 8, 10), 6  # of an asphere that may be missing; rounds of the search for its terms
_NEAR_MM, _DAMPED = 1e-5, (1e-9, 1e-7, 1e-5, 1e-3, 1e-1)  # of sags at the rim, for slopes; shares of their squares
_LIKELY, _ALIKE = 7, 4  # surfaces that are searched to the end for a missing asphere; changes that are named at most
_NEAR_STATE = 0.06  # relative difference of focal length up to which a measured one is that of a table's state
ONE_OF = "one of these: "
VARIES = re.compile(r"(?i)f/?[\d.]+-[\d.]+")
_CLEARLY = 3.0  # times by which the score is less after a change that is told
_WORDS = {
    "distortion": ("distortion", "%"), "blur": ("blur of the axis times the f-number", " µm"),
    "focus": ("scatter of the foci over the field", "% of the focal length"),
    "colour": ("foci of F and C apart", "%"), "lateral": ("images in F and C apart", "%"),
    "focal": ("focal length off", "%"), "back": ("film off the focus", "% of the focal length"),
}  # fmt: skip


class Change(NamedTuple):
    """One change of a table: what it is, in words, and the table with it."""

    said: str
    lens: Lens


def changed(lens: Lens, k: int, **fields: Any) -> Lens:
    """The lens with other figures in one row."""
    rows = lens.surfaces
    return replace(lens, surfaces=(*rows[:k], replace(rows[k], **fields), *rows[k + 1 :]))


def transposed(value: float) -> list[float]:
    """A figure with two neighbouring digits of its first five transposed, where that changes it."""
    text = f"{value:.6g}"
    if "e" in text or not math.isfinite(value):
        return []
    places = [i for i, c in enumerate(text) if c.isdigit()]
    first = next((n for n, i in enumerate(places) if text[i] != "0"), 0)
    found = []
    for i, j in list(pairwise(places))[first : first + 4]:
        if text[i] != text[j]:
            digits = list(text)
            digits[i], digits[j] = digits[j], digits[i]
            found.append(float("".join(digits)))
    return found


def glasses(lens: Lens) -> list[int]:
    """The rows that are followed by glass."""
    return [k for k, s in enumerate(lens.surfaces) if float(s.n_d) != 1 or s.glass]


def swapped(lens: Lens, k: int, j: int) -> Lens:
    """The lens with the glasses of two rows swapped."""
    a, b = ({f: getattr(lens.surfaces[n], f) for f in ("n_d", "V_d", "glass", "material")} for n in (k, j))
    return changed(changed(lens, k, **b), j, **a)


def changes(lens: Lens) -> Iterator[Change]:
    """All single changes of a table that are tried, but for aspheres that may be missing."""
    for k, s in enumerate(lens.surfaces):
        if math.isfinite(s.radius_mm):
            yield Change(f"the sign of the radius of surface {k}", changed(lens, k, radius_mm=-s.radius_mm))
        for n, (power, a) in enumerate(s.figure.asphere):
            for factor, what in _OF_TERMS:
                asphere = (*s.figure.asphere[:n], (power, factor * a), *s.figure.asphere[n + 1 :])
                said = f"{what} of the coefficient of power {power} of surface {k}"
                yield Change(said, changed(lens, k, figure=replace(s.figure, asphere=asphere)))
        fields = ["radius_mm", "thickness_mm"] + ["n_d"] * (s.glass is None)
        for field in fields:
            old = float(getattr(s, field))
            for new in transposed(old):
                if field != "n_d" or 1.3 < new < 2.3:
                    said = f"transposed digits: {field} of surface {k} {new:g} instead of {old:.6g}"
                    yield Change(said, changed(lens, k, **{field: new}))
    for k, j in pairwise(glasses(lens)):
        yield Change(f"swapped glasses after surfaces {k} and {j}", swapped(lens, k, j))
    for factor, name in _UNITS.items():
        yield Change(f"units: the figures are {name}", lens.scaled(factor))
        yield Change(f"units: the figures were taken for {name}", lens.scaled(1 / factor))


def alarm(found: Measures) -> Array:
    """The largest figure of each table over what nearly all sound tables keep; above 1 a table is doubtful."""
    return np.asarray(np.max([m / most for m, most in zip(found, ALARM, strict=True)], axis=0))


def score(found: Measures) -> Array:
    """The figures of each table over what nearly all sound tables keep, as a root of the sum of squares."""
    return np.sqrt(np.sum([(m / most) ** 2 for m, most in zip(found, ALARM, strict=True)], axis=0))


class Tried(NamedTuple):
    """A change with the figures of the table that has it."""

    change: Change
    figures: Measures

    @property
    def score(self) -> float:
        """See `score`; less is better."""
        return float(score(self.figures)[0])

    @property
    def sound(self) -> bool:
        """Whether the table raises no alarm."""
        return bool(alarm(self.figures)[0] <= 1)


def _ranked(tried: Sequence[Change], profile: Profile, focal_mm: float) -> list[Tried]:
    """Changes with their figures, the best first."""
    figures = measure([change.lens for change in tried], profile, focal_mm).figures
    each = [Tried(change, Measures(*(v[n : n + 1] for v in figures))) for n, change in enumerate(tried)]
    return sorted(each, key=lambda one: one.score)


def _best(tried: Sequence[Change], profile: Profile, focal_mm: float) -> Tried:
    return _ranked(tried, profile, focal_mm)[0]


def missing_asphere(lens: Lens, k: int, profile: Profile, focal_mm: float, rounds: int = _ROUNDS) -> Tried:
    """The terms of powers 4 to 10 at a surface for which the figures are best, by damped least squares."""
    terms, rim = dict(lens.surfaces[k].figure.asphere), lens.surfaces[k].semi_diameter_mm

    def with_sags(sags: Array) -> Change:
        """Terms that are so many mm deep at the rim, beside those of the table."""
        more = {p: terms.get(p, 0.0) + float(sag) / rim**p for p, sag in zip(_POWERS, sags, strict=True)}
        figure = replace(lens.surfaces[k].figure, asphere=tuple(sorted((terms | more).items())))
        return Change(f"an asphere is missing at surface {k}", changed(lens, k, figure=figure))

    sags = np.zeros(len(_POWERS))
    best = _best([with_sags(sags)], profile, focal_mm)
    for _ in range(rounds):
        near = [with_sags(s).lens for s in (sags, *(sags + _NEAR_MM * np.eye(len(sags))))]
        off = measure(near, profile, focal_mm).off
        weighed = [v / most / math.sqrt(v.shape[1]) for v, most in zip(off, ALARM[:3], strict=True)]
        found = np.nan_to_num(np.concatenate(weighed, axis=1))
        slope = (found[1:] - found[0]) / _NEAR_MM
        square, pull, one = slope @ slope.T, slope @ found[0], np.eye(len(sags))
        most = np.trace(square)
        if not 0 < most < math.inf:
            break
        each = [sags - np.linalg.solve(square + damped * most * one, pull) for damped in _DAMPED]
        tried = [with_sags(s) for s in each]
        better = _best(tried, profile, focal_mm)
        if not better.score < best.score:
            break
        best, sags = better, each[[t is better.change for t in tried].index(True)]
    return best


@dataclass(frozen=True)
class Checked(Report):
    """A table by its figures, and the single change that makes it sound.

    Attributes:
        doubtful: whether any figure is beyond what nearly all sound tables keep.
        change: in words; None where none is called for or none helps. after: the figures with it.
        before: by name, see `Measures`.
        said: all of it in sentences.
    """

    doubtful: bool
    change: str | None
    before: dict[str, float]
    after: dict[str, float] | None
    said: tuple[str, ...]


def opened_at(lens: Lens, profile: Profile, focal_mm: float) -> Lens:
    """The lens at a focal length of a profile, at the widest f-number of the product there.

    The table of a zoom often states that of its widest end alone. The product's is the widest at which light was
    measured; where none was, and its name has two f-numbers, that of a stop which opens no farther than at that end.
    """
    placed = at_focal_length(lens, focal_mm)
    if lights := profile.light_at(focal_mm):
        own = min(light.f_number for light in lights)
    elif VARIES.search(profile.model):
        own = float(first_order(placed.with_stop_radius(lens.stop_radius_mm)).f_number)
    else:
        own = placed.f_number
    return replace(placed, f_number=max(placed.f_number, own))


def focal_lengths(lens: Lens, profile: Profile) -> list[float]:
    """The measured focal lengths at which a table is asked, rising: of a zoom those near to a state of its table.

    Between states its gaps are interpolated, and groups that are not where their cam would put them scatter the foci
    (Nikon 24-85 mm: 2.3% at 35 mm, 0.2% at the table's 50 mm). Where a profile has none near a state, all count.
    """
    known = sorted({r.focal_mm for r in profile.distortion} or set(profile.focal_mm))
    states = [c.efl_mm for c in lens.configurations if c.efl_mm and c.object_distance_mm is None]
    near = [mm for mm in known if any(abs(mm / efl - 1) <= _NEAR_STATE for efl in states)]
    return near or known


def check(lens: Lens, profile: Profile) -> Checked:
    """Look for figures of a lens that no sound table has, and for one change after which they are gone.

    A zoom is checked at one focal length, that in the middle of `focal_lengths`.

    Raises:
        InputError: ideal lenses, of which there is no table.
    """
    lens.require_glass("check")
    known = focal_lengths(lens, profile)
    focal = known[len(known) // 2]
    placed = opened_at(lens, profile, focal)
    now = _best([Change("", placed)], profile, focal)
    before = _named(now)
    if now.sound:
        sound = f"the table is sound, and no change is called for: {_told(before)}"
        return Checked(False, None, before, None, (sound,))
    beyond = {name: v for name, v in before.items() if not v <= getattr(ALARM, name)}
    said = f"the table is doubtful: {_told(beyond, limits=True)}"
    tried = _ranked(list(changes(placed)), profile, focal)
    if not _helps(tried[0], now):  # terms of an asphere can imitate other changes, so that they come last
        bent = [k for k, s in enumerate(placed.surfaces) if not s.stop and 0 < s.semi_diameter_mm < math.inf]
        first = {k: missing_asphere(placed, k, profile, focal, rounds=1).score for k in bent}
        likely = sorted(bent, key=first.__getitem__)[:_LIKELY]
        aspheres = [missing_asphere(placed, k, profile, focal) for k in likely]
        tried = sorted([*tried, *aspheres], key=lambda one: one.score)
    best = tried[0]
    if not _helps(best, now):
        nearest = f"no single change makes it sound; the nearest is: {best.change.said}"
        return Checked(True, None, before, None, (said, nearest))
    after = _named(best)
    moved = _told({name: after[name] for name in beyond})
    # What fits about as well cannot be told apart by these figures.
    alike = [t.change.said for t in tried[:_ALIKE] if _helps(t, now) and t.score <= 2 * best.score]
    change = alike[0] if len(alike) == 1 else f"{ONE_OF}{'; '.join(alike)}"
    told = f"one change makes it sound, {change}: {moved}"
    return Checked(True, change, before, after, (said, told))


def _helps(tried: Tried, now: Tried) -> bool:
    return tried.sound and tried.score <= now.score / _CLEARLY


def _named(tried: Tried) -> dict[str, float]:
    return {name: float(v[0]) for name, v in tried.figures._asdict().items()}


def _told(figures: dict[str, float], *, limits: bool = False) -> str:
    each = []
    for name, value in figures.items():
        text, unit = _WORDS[name]
        figure = f"{value:.2g}{unit}" if math.isfinite(value) else "not known, for rays do not get through"
        each.append(f"{text} {figure}" + (f" (sound tables: below {getattr(ALARM, name):g})" if limits else ""))
    return ", ".join(each)
