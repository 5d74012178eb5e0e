"""Copies of a lens as a workshop makes them: each element, surface and gap a little off, drawn at random."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.settings import check_bounds, read_config, setting
from neurolens.optics.lens.designs import with_assumptions
from neurolens.optics.lens.placement import Placement
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.rims import check_states

Array = NDArray[np.float64]
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

    @classmethod
    def read(cls, file: Path | None) -> Tolerances:
        """Return the limits that a TOML file states; without one, or by the word default, those of this class."""
        return cls() if file is None or file == Path("default") else read_config(cls, file)


def elements_of(lens: Lens) -> list[range]:
    """Return the elements of a lens as ranges of surface numbers; the stop in air is none."""
    in_glass = [float(s.n_d) != 1 for s in lens.surfaces[:-1]]
    found = []
    for glass, gaps in groupby(range(len(in_glass)), lambda k: in_glass[k]):
        if glass:
            first, *rest = gaps
            found.append(range(first, (rest[-1] if rest else first) + 2))
    return found


@dataclass(frozen=True)
class Off:
    """By how much the figures of a copy differ from those of its lens, of E elements and S surfaces.

    Attributes:
        decentre_mm, tilt_deg: [E, 2] of each element, along x and y, and about x and y through its middle.
        thickness_mm: [S] of the glass or air behind each surface; the last, up to the film, is not used.
        radius_percent: [S] of each surface's radius.
        index: [S] of the medium behind each surface at the d line.
    """

    decentre_mm: Array
    tilt_deg: Array
    thickness_mm: Array
    radius_percent: Array
    index: Array

    @staticmethod
    def none(lens: Lens) -> Off:
        """Return no difference at all from a lens."""
        elements, surfaces = len(elements_of(lens)), len(lens.surfaces)
        return Off(*(np.zeros((elements, 2)) for _ in range(2)), *(np.zeros(surfaces) for _ in range(3)))

    @staticmethod
    def of(lens: Lens, figures: Array) -> Off:
        """Return the differences of a list of all figures, in the order of `figure_names`."""
        none = Off.none(lens)
        parts = np.split(figures, np.cumsum([v.size for v in vars(none).values()])[:-1])
        return Off(*(part.reshape(v.shape) for part, v in zip(parts, vars(none).values(), strict=True)))

    @property
    def figures(self) -> Array:
        """Return [4 E + 3 S] all figures, in the order of `figure_names`."""
        return np.concatenate([v.reshape(-1) for v in vars(self).values()])

    @property
    def vectors(self) -> Array:
        """Return [2 E, 2] vectors across the axis: the decentres (mm), then where the elements' axes lean (degrees).

        An axis leans to +y by a turn about -x, and to +x by one about +y: so it turns with the lens as decentres do.
        """
        return np.concatenate([self.decentre_mm, self.tilt_deg[:, ::-1] * [1.0, -1.0]])

    @property
    def scalars(self) -> Array:
        """Return [3 S] figures that leave the lens round: thicknesses (mm), radii (percent), indices."""
        return np.concatenate([self.thickness_mm, self.radius_percent, self.index])


def figure_names(lens: Lens) -> list[str]:
    """Return the names of `Off.figures`: `decentre_x_mm_s03` is of the element whose first surface is number 3."""
    firsts = [element[0] for element in elements_of(lens)]
    across = (
        f"{w}_{axis}_{unit}_s{k:02}"
        for w, unit in (("decentre", "mm"), ("tilt", "deg"))
        for k in firsts
        for axis in "xy"
    )
    along = (
        f"{what}_s{k:02}" for what in ("thickness_mm", "radius_percent", "index") for k in range(len(lens.surfaces))
    )
    return [*across, *along]


def copies_of(lens: Lens, tolerances: Tolerances, number: int, seed: int) -> Iterator[Lens]:
    """Draw copies of a lens; a copy depends on its number and the seed alone.

    Raises:
        InputError: surfaces overlap in every draw of a copy.
    """
    for n, (_, copy) in enumerate(draws_of(lens, tolerances, number, seed), 1):
        said = f"Copy {n} of seed {seed}, drawn at random about the figures of its lens."
        notes = " ".join(filter(None, (lens.notes, lens.derived, said)))
        yield replace(with_assumptions(copy), name=copy_name(lens, n), notes=notes, derived="")


def copy_name(lens: Lens, number: int) -> str:
    """Return the name of a copy."""
    return f"{lens.name}, copy {number}"


def draws_of(lens: Lens, tolerances: Tolerances, number: int, seed: int) -> Iterator[tuple[Off, Lens]]:
    """Draw how far the figures of copies are off, and set each copy; arguments and errors are those of `copies_of`."""
    for n in range(1, number + 1):
        rng = np.random.default_rng([seed, n])
        for _ in range(_DRAWS):
            copy = perturbed(lens, off := _drawn(lens, tolerances, rng))
            try:
                check_states(copy)
            except InputError as error:
                last = error
                continue
            yield off, copy
            break
        else:
            raise InputError(lens.path, last.field, last.value, f"{last.expected} (in one of {_DRAWS} draws of a copy)")


def _drawn(lens: Lens, limits: Tolerances, rng: np.random.Generator) -> Off:
    def within(limit: float) -> float:
        """Draw by how far a figure is off."""
        while abs(off := rng.normal()) > 2:
            pass
        return float(off) * limit / 2

    drawn, last = Off.none(lens), len(lens.surfaces) - 1
    for k, s in enumerate(lens.surfaces):
        glass = float(s.n_d) != 1
        if k < last:
            drawn.thickness_mm[k] = within(limits.thickness_mm if glass else limits.gap_mm)
        drawn.radius_percent[k], index = within(limits.radius_percent), within(limits.index)
        drawn.index[k] = index if glass and s.glass is None else 0.0
    for e in range(len(drawn.tilt_deg)):
        drawn.decentre_mm[e] = within(limits.decentre_mm), within(limits.decentre_mm)
        drawn.tilt_deg[e] = within(limits.tilt_deg), within(limits.tilt_deg)
    return drawn


def perturbed(lens: Lens, off: Off) -> Lens:
    """Return a lens whose figures are off by so much; its name and its notes stay."""
    thickness, radius, index = ([float(v) for v in row] for row in (off.thickness_mm, off.radius_percent, off.index))
    rows, last = list(lens.surfaces), len(lens.surfaces) - 1
    for k, s in enumerate(rows):
        more = thickness[k] if k < last else 0.0
        rows[k] = replace(
            s, radius_mm=s.radius_mm * (1 + radius[k] / 100), thickness_mm=s.thickness_mm + more, n_d=s.n_d + index[k]
        )
    vertices = [float(z) for z in lens.vertices_mm]
    for element, moved, turned in zip(elements_of(lens), off.decentre_mm, off.tilt_deg, strict=True):
        whole = Placement((float(moved[0]), float(moved[1]), 0.0), (float(turned[0]), float(turned[1]), 0.0))
        middle = (vertices[element[0]] + vertices[element[-1]]) / 2
        for k in element:
            rows[k] = replace(rows[k], placement=rows[k].placement.in_group(whole, vertices[k] - middle))
    states = (
        replace(c, thickness_mm=tuple((k, t + (thickness[k] if k < last else 0.0)) for k, t in c.thickness_mm))
        for c in lens.configurations
    )
    return replace(lens, surfaces=tuple(rows), configurations=tuple(states))
