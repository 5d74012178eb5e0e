"""Single changes that make a doubtful table sound: wrong signs and digits, swapped glasses, missing aspheres."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.analysis.fields import Result
from neurolens.lens.prescription import Lens
from neurolens.photographs.compare import at_focal_length
from neurolens.photographs.figures import Measures, measures
from neurolens.photographs.profiles import Profile

Array = NDArray[np.float64]

# What nearly all sound tables keep: experiments/results/faults.md.
ALARM = Measures(distortion=0.75, blur=55.0, focus=1.0, colour=0.9, lateral=0.32, focal=5.5, back=0.4)
_UNITS = {10.0: "centimetres", 25.4: "inches"}
_SAG_MM = (0.002, 0.005, 0.012, 0.03, 0.07, 0.16, 0.4, 1.0)  # at the rim, of an asphere that may be missing
_CLOSER, _STEPS, _GRID = 5, (0.5, 0.5, 0.25, 0.12), (-1.0, -0.5, 0.0, 0.5, 1.0)  # surfaces and steps of a closer search
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


def _with(lens: Lens, k: int, **fields: Any) -> Lens:
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
    return _with(_with(lens, k, **b), j, **a)


def changes(lens: Lens) -> Iterator[Change]:
    """All single changes of a table that are tried, but for aspheres that may be missing."""
    for k, s in enumerate(lens.surfaces):
        if math.isfinite(s.radius_mm):
            yield Change(f"the sign of the radius of surface {k}", _with(lens, k, radius_mm=-s.radius_mm))
        for n, (power, a) in enumerate(s.asphere):
            for factor, what in (
                (-1.0, "the sign"),
                (10.0, "the exponent (10 times)"),
                (0.1, "the exponent (a tenth)"),
            ):
                asphere = (*s.asphere[:n], (power, factor * a), *s.asphere[n + 1 :])
                yield Change(
                    f"{what} of the coefficient of power {power} of surface {k}", _with(lens, k, asphere=asphere)
                )
        fields = ["radius_mm", "thickness_mm"] + ["n_d"] * (s.glass is None)
        for field in fields:
            old = float(getattr(s, field))
            for new in transposed(old):
                if field != "n_d" or 1.3 < new < 2.3:
                    said = f"transposed digits: {field} of surface {k} {new:g} instead of {old:.6g}"
                    yield Change(said, _with(lens, k, **{field: new}))
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
    found: Measures

    @property
    def score(self) -> float:
        """See `score`; less is better."""
        return float(score(self.found)[0])


def _best(tried: Sequence[Change], profile: Profile, focal_mm: float) -> Tried:
    found = measures([change.lens for change in tried], profile, focal_mm)
    n = int(np.argmin(score(found)))
    return Tried(tried[n], Measures(*(v[n : n + 1] for v in found)))


def missing_asphere(lens: Lens, profile: Profile, focal_mm: float) -> list[Tried]:
    """The surfaces at which terms of powers 4 and 6 help most, best first; that of power 4 alone is tried at all."""

    def with_sags(k: int, four: float, six: float) -> Change:
        """Terms that are so many mm deep at the rim, beside those of the table."""
        rim, terms = lens.surfaces[k].semi_diameter_mm, dict(lens.surfaces[k].asphere)
        more = {p: terms.get(p, 0.0) + sag / rim**p for p, sag in ((4, four), (6, six))}
        return Change(
            f"an asphere is missing at surface {k}", _with(lens, k, asphere=tuple(sorted((terms | more).items())))
        )

    def search(k: int, pairs: Sequence[tuple[float, float]]) -> tuple[Tried, tuple[float, float]]:
        each = [with_sags(k, *pair) for pair in pairs]
        best = _best(each, profile, focal_mm)
        return best, pairs[[c is best.change for c in each].index(True)]

    bent = [k for k, s in enumerate(lens.surfaces) if not s.stop and 0 < s.semi_diameter_mm < math.inf]
    coarse = {k: search(k, [(sign * sag, 0.0) for sag in _SAG_MM for sign in (1, -1)]) for k in bent}
    found = []
    for k in sorted(coarse, key=lambda k: coarse[k][0].score)[:_CLOSER]:
        best, (four, six) = coarse[k]
        for step in _STEPS:
            reach = step * max(abs(four), abs(six))
            pairs = [(four + reach * i, six + reach * j) for i in _GRID for j in _GRID]
            best, (four, six) = search(k, pairs)
        found.append(best)
    return sorted(found, key=lambda tried: tried.score)


@dataclass(frozen=True)
class Checked(Result):
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


def check(lens: Lens, profile: Profile) -> Checked:
    """Look for figures of a lens that no sound table has, and for one change after which they are gone.

    A zoom is checked at one focal length of the profile, that in the middle.

    Raises:
        InputError: ideal lenses, of which there is no table.
    """
    lens.require_glass("check")
    known = sorted({r.focal_mm for r in profile.distortion} or set(profile.focal_mm))
    focal = known[len(known) // 2]
    placed = at_focal_length(lens, focal)
    now = _best([Change("", placed)], profile, focal)
    before = _named(now.found)
    if alarm(now.found)[0] <= 1:
        return Checked(
            False, None, before, None, (f"the table is sound, and no change is called for: {_told(before)}",)
        )
    beyond = {name: v for name, v in before.items() if not v <= getattr(ALARM, name)}
    said = [f"the table is doubtful: {_told(beyond, limits=True)}"]
    best = min(
        [_best(list(changes(placed)), profile, focal), *missing_asphere(placed, profile, focal)[:1]],
        key=lambda t: t.score,
    )
    after = _named(best.found)
    if alarm(best.found)[0] <= 1 and best.score <= now.score / _CLEARLY:
        moved = {name: v for name, v in after.items() if name in beyond}
        return Checked(
            True,
            best.change.said,
            before,
            after,
            (*said, f"one change makes it sound, {best.change.said}: {_told(moved)}"),
        )
    nearest = f"no single change makes it sound; the nearest is {best.change.said}"
    return Checked(True, None, before, None, (*said, nearest))


def _named(found: Measures) -> dict[str, float]:
    return {name: float(v[0]) for name, v in found._asdict().items()}


def _told(figures: dict[str, float], *, limits: bool = False) -> str:
    each = []
    for name, value in figures.items():
        text, unit = _WORDS[name]
        figure = f"{value:.2g}{unit}" if math.isfinite(value) else "not known, for rays do not get through"
        each.append(f"{text} {figure}" + (f" (sound tables: below {getattr(ALARM, name):g})" if limits else ""))
    return ", ".join(each)
