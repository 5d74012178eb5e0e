"""Copies of a lens as a workshop makes them: each element, surface and gap a little off, drawn at random."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from neurolens.base.errors import InputError
from neurolens.base.settings import check_bounds, setting
from neurolens.optics.lens.designs import with_assumptions
from neurolens.optics.lens.placement import Placement
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.rims import check_states

_DRAWS = 50  # of one copy: neighbours that all but touch may overlap in some of them


@dataclass(frozen=True)
class Tolerances:
    """How far the figures of a copy may be from those of its lens.

    Every figure is drawn from a normal distribution, whose standard deviation is half of the limit, cut off at the
    limit. An element is the glass between two gaps of air; its cemented surfaces move together.

    Attributes:
        decentre_mm, tilt_deg: of an element, along x and along y, and about x and about y through its middle.
        gap_mm, thickness_mm: of the air between elements, and of each glass.
        radius_percent: of each radius that is not infinite.
        index: of each glass that the file states by `n_d`; glasses of the catalogue keep theirs.
    """

    decentre_mm: float = setting(
        0.02, "decentre of an element, along x and along y", within=(0, 10), unit="mm", title="tolerances"
    )
    tilt_deg: float = setting(
        0.03, "tilt of an element, about x and about y", within=(0, 10), unit="degrees", title="tolerances"
    )
    gap_mm: float = setting(0.02, "air between elements", within=(0, 10), unit="mm", title="tolerances")
    thickness_mm: float = setting(0.03, "thickness of each glass", within=(0, 10), unit="mm", title="tolerances")
    radius_percent: float = setting(
        0.1, "radius of each surface, in percent", within=(0, 20), unit="percent", title="tolerances", metavar="PERCENT"
    )
    index: float = setting(
        5e-4, "index of each glass that is stated by n_d", within=(0, 0.1), unit="a difference of indices",
        title="tolerances",
    )  # fmt: skip

    def __post_init__(self) -> None:
        check_bounds(self, "tolerances")


def elements_of(lens: Lens) -> list[range]:
    """Return the elements of a lens as ranges of surface numbers; the stop in air is none."""
    in_glass = [float(s.n_d) != 1 for s in lens.surfaces[:-1]]
    found = []
    for glass, gaps in groupby(range(len(in_glass)), lambda k: in_glass[k]):
        if glass:
            first, *rest = gaps
            found.append(range(first, (rest[-1] if rest else first) + 2))
    return found


def copies_of(lens: Lens, tolerances: Tolerances, number: int, seed: int) -> Iterator[Lens]:
    """Draw copies of a lens; a copy depends on its number and the seed alone.

    Raises:
        InputError: surfaces overlap in every draw of a copy.
    """
    for n in range(1, number + 1):
        rng = np.random.default_rng([seed, n])
        for _ in range(_DRAWS):
            copy = _drawn(lens, tolerances, rng)
            try:
                check_states(copy)
            except InputError as error:
                last = error
                continue
            said = f"Copy {n} of seed {seed}, drawn at random about the figures of its lens."
            notes = " ".join(filter(None, (lens.notes, lens.derived, said)))
            yield replace(with_assumptions(copy), name=f"{lens.name}, copy {n}", notes=notes, derived="")
            break
        else:
            raise InputError(lens.path, last.field, last.value, f"{last.expected} (in one of {_DRAWS} draws of a copy)")


def _drawn(lens: Lens, limits: Tolerances, rng: np.random.Generator) -> Lens:
    def within(limit: float) -> float:
        """Draw by how far a figure is off."""
        while abs(off := rng.normal()) > 2:
            pass
        return float(off) * limit / 2

    rows, last, changed = list(lens.surfaces), len(lens.surfaces) - 1, dict[int, float]()
    for k, s in enumerate(rows):
        glass = float(s.n_d) != 1
        if k < last:
            changed[k] = within(limits.thickness_mm if glass else limits.gap_mm)
        radius, n_d = s.radius_mm * (1 + within(limits.radius_percent) / 100), s.n_d + within(limits.index)
        stated = glass and s.glass is None
        rows[k] = replace(
            s, radius_mm=radius, thickness_mm=s.thickness_mm + changed.get(k, 0.0), n_d=n_d if stated else s.n_d
        )
    vertices = [float(z) for z in lens.vertices_mm]
    for element in elements_of(lens):
        moved = within(limits.decentre_mm), within(limits.decentre_mm), 0.0
        whole = Placement(moved, (within(limits.tilt_deg), within(limits.tilt_deg), 0.0))
        middle = (vertices[element[0]] + vertices[element[-1]]) / 2
        for k in element:
            rows[k] = replace(rows[k], placement=rows[k].placement.in_group(whole, vertices[k] - middle))
    states = (
        replace(c, thickness_mm=tuple((k, t + changed.get(k, 0.0)) for k, t in c.thickness_mm))
        for c in lens.configurations
    )
    return replace(lens, surfaces=tuple(rows), configurations=tuple(states))
