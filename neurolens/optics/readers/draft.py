"""The data that a reader finds in a file, common to all formats; `assemble` makes the lens of it."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypedDict

from neurolens.base.settings import WAVELENGTH_NM, within
from neurolens.optics.lens.figures import MOST_Q_TERMS, WIDEST_Q, figure_of, qcon_powers
from neurolens.optics.lens.prescription import MediumFields, Surface
from neurolens.optics.readers.breaks import Step, Turn, placements
from neurolens.optics.readers.forbes import qbfs_terms
from neurolens.optics.readers.source import Line

# A diameter that the file does not give, until `assemble.finish` has found it.
UNKNOWN = math.nan
INFINITE = 1e9  # in any unit; programs write 1e10 or more for an object at infinity
MAX_STATES = 200
_ROWS = re.compile(r"\bsurface ([0-9]+(?:, [0-9]+(?![0-9.]| mm))*)(?! of the file)")
LEAST_RADIUS = 1e-3  # the least that coefficients of aspheres are normalised by, in the unit of the file


class ShapeFields(TypedDict, total=False):
    """What a file gives of a surface's shape: its radius, and keys of `optics.lens.figures.figure_of`."""

    radius_mm: float
    conic: float
    asphere: Sequence[tuple[int, float]]
    cylinder: str | None
    across: tuple[float, float | None]
    qcon: Sequence[float]
    norm_mm: float
    focal_mm: float


@dataclass
class Block:
    """One surface while a file is read, in the file's unit; readers add what else their formats say."""

    start: Line
    name: str = ""
    curvature: float = 0.0
    conic: float = 0.0
    thickness: float = 0.0
    semi_diameter: float = UNKNOWN
    medium: MediumFields = field(default_factory=MediumFields)
    stop: bool = False
    aperture: bool = False  # as in `Row`
    solved: bool = False  # whether the thickness follows from others, or from the paraxial image
    turn: Turn | None = None  # of the local axes, at this surface

    @property
    def radius(self) -> float:
        return 1 / self.curvature if self.curvature else math.inf

    def rotational(self, asphere: Iterable[tuple[int, float]] = ()) -> ShapeFields:
        """Return radius and figure of a surface of revolution, for `row`; the conic of a plane has no effect."""
        conic = self.conic if self.curvature else 0.0
        return {"radius_mm": self.radius, "conic": conic, "asphere": tuple((p, a) for p, a in asphere if a)}

    def crossed(self, curve: ShapeFields, radius_x: float, conic_x: float | None) -> ShapeFields:
        """Add a bend in x to a curve in y, which is given as by `rotational`.

        The curve in y is turned about an axis along y; with a conic in x, the surface is a biconic. Where one of both
        curves is straight (an infinite radius) it is a cylinder, and where both are the same it is round.
        """
        bent = bool(self.curvature or curve["asphere"])
        if math.isinf(radius_x):
            return curve | ({"cylinder": "y"} if bent else {})
        if not bent:
            return {"radius_mm": radius_x, "conic": conic_x or 0.0, "cylinder": "x"}
        same = math.isclose(radius_x * self.curvature, 1.0, rel_tol=1e-12) and (conic_x or 0.0) == self.conic
        return curve if same and not curve["asphere"] else curve | {"cylinder": "y", "across": (radius_x, conic_x)}

    def q_type(self, name: str, qcon: bool, values: list[float], radius: float) -> ShapeFields:
        """Return a surface of Forbes's kind, as by `rotational`, from coefficients (m = 0 first) and their radius."""
        rim = radius if math.isnan(self.semi_diameter) else self.semi_diameter
        if len(values) > MOST_Q_TERMS:
            raise self.start.error(name, f"({len(values)} terms)", f"at most {MOST_Q_TERMS} terms")
        if qcon and not any(values):
            return self.rotational()
        if qcon and rim > WIDEST_Q * radius:
            return self.rotational((p, float(a)) for p, a in qcon_powers(tuple(values), radius))
        if qcon:
            return self.rotational() | {"qcon": values, "norm_mm": radius}
        try:
            terms = qbfs_terms(values, radius, self.curvature, rim, self.conic)
        except ValueError as error:
            raise self.start.error(name, f"(curvature {self.curvature:g}, rim {rim:g})", str(error)) from None
        return self.rotational(terms)

    def row(self, shape: ShapeFields) -> Row:
        """Return the row of a surface with this `radius_mm` and figure, by the keys of `figures.figure_of`."""
        lengths = shape["radius_mm"], self.thickness, 2 * self.semi_diameter
        surface = Surface(*lengths, stop=self.stop, figure=figure_of(shape), **self.medium)
        return Row(surface, self.aperture, self.name)


def from_axis_deg(x: float, y: float) -> float:
    """Return the angle from the axis of a field point whose angles in the x-z and the y-z plane are given."""
    if not (x and y) or max(abs(x), abs(y)) >= 90:
        return math.hypot(x, y)
    return math.degrees(math.atan(math.hypot(math.tan(math.radians(x)), math.tan(math.radians(y)))))


@dataclass(frozen=True)
class Row:
    """One surface in the file's unit.

    Attributes:
        surface: its diameter may be `UNKNOWN`.
        aperture: whether the file sets a clear aperture on it, so that even a plane in air cuts the beam.
        name: the number by which the file calls it; empty where that is its place in the table, from 0.
    """

    surface: Surface
    aperture: bool = False
    name: str = ""


def placed(rows: Sequence[Row], blocks: Sequence[Block]) -> tuple[Row, ...]:
    """Return the rows of blocks where tilts and decentres put them; the last block is the film."""
    found = placements([Step(block.start, block.turn, block.thickness) for block in blocks])
    surfaces = (replace(row.surface, placement=place) for row, place in zip(rows, found, strict=True))
    return tuple(replace(row, surface=surface) for row, surface in zip(rows, surfaces, strict=True))


@dataclass(frozen=True)
class State:
    """A zoom or focus state, in the file's unit. None: as in the table.

    Attributes:
        thickness: by the draft's row number.
        pupil, f_number, stop_diameter: any one of them sizes the stop.
        object_distance: from the object to the draft's first row; `inf` at infinity.
        film_given: whether the last thickness holds; else it becomes the state's paraxial back focus.
    """

    name: str
    thickness: dict[int, float] = field(default_factory=dict)
    pupil: float | None = None
    f_number: float | None = None
    stop_diameter: float | None = None
    object_distance: float = math.inf
    film_given: bool = True


@dataclass
class Positions:
    """Zoom or focus positions while a text file is read, by place from 0; gaps and rims by surface and place.

    Attributes:
        count: 0 until the file states it.
        pupil, f_number, rims: each sizes the stop; `rims` are semi-diameters, with their lines.
    """

    count: int = 0
    titles: dict[int, str] = field(default_factory=dict)
    gaps: dict[tuple[int, int], float] = field(default_factory=dict)
    pupil: dict[int, float] = field(default_factory=dict)
    f_number: dict[int, float] = field(default_factory=dict)
    rims: dict[tuple[int, int], tuple[float, Line]] = field(default_factory=dict)

    def begin(self, line: Line, keyword: str, count: int) -> None:
        """Set how many positions there are."""
        if not 1 <= count <= MAX_STATES:
            raise line.error(keyword, count, f"1 to {MAX_STATES} positions")
        self.count = count

    def states(
        self, blocks: Sequence[Block], noun: str, rim: str, solve: Callable[[list[float], int], bool]
    ) -> tuple[State, ...]:
        """Return the positions of a file as states.

        Args:
            blocks: object, surfaces and image. noun: what a position without a title is called.
            rim: the keyword of semi-diameters. solve: carries out the solves of gaps at a place, and tells whether its
                film is given.

        Raises:
            InputError: a semi-diameter changes that is not the stop's.
        """
        if self.count < 2:
            return ()
        for (surface, _), (_, line) in self.rims.items():
            if not blocks[surface].stop:
                raise line.error(rim, f"(surface {surface})", "the stop: other rims cannot change")
        openings = {place: 2 * semi for (_, place), (semi, _) in self.rims.items()}
        changing = {k for k, _ in self.gaps} | {k for k, block in enumerate(blocks) if block.solved}
        states = []
        for place in range(self.count):
            gaps = [self.gaps.get((k, place), block.thickness) for k, block in enumerate(blocks)]
            film_given = solve(gaps, place)
            state = State(
                name=self.titles.get(place) or f"{noun} {place + 1}",
                thickness={k - 1: gaps[k] for k in sorted(changing) if 0 < k < len(blocks) - 1},
                pupil=self.pupil.get(place),
                f_number=self.f_number.get(place),
                stop_diameter=openings.get(place),
                object_distance=math.inf if gaps[0] >= INFINITE else gaps[0],
                film_given=film_given,
            )
            states.append(state)
        return tuple(states)


@dataclass
class Draft:
    """All data found by a reader; readers of text files fill it line by line. Lengths are in the file's unit.

    Attributes:
        kind: name of the format, for the source line.
        notes: lines of text.
        pupil, f_number, object_na, image_f_number: if one is given, it sizes the stop, else the stop's diameter does.
            `object_na` is the numerical aperture n sin(theta) of the beam from the axis of a near object,
            `image_f_number` that of the beam to its image, in place of an object at infinity.
        unit: "mm", "cm", "in", "m", or None if unknown.
        stated_efl: focal length as the file states it, to be checked.
        drawn: whether somebody measured rims in a drawing, and gave some as radii in place of diameters. These are
            halved where they are twice what they can be, and narrowed where neighbours would overlap; both give
            warnings.
        nominal: f-number that the file states with few digits, which tells radii from diameters.
        stop_given: whether the file states the stop's own diameter, which then rules over its f-number.
        skipped: what was not read because no ray depends on it, with how often it occurs; one warning lists all.
        object_medium: fields of `Medium` for the medium in front of the lens.
        wavelengths_nm: as `Lens.wavelengths_nm`.
    """

    file: str
    kind: str
    rows: tuple[Row, ...] = ()
    name: str = ""
    notes: list[str] = field(default_factory=list)
    states: tuple[State, ...] = ()
    pupil: float | None = None
    f_number: float | None = None
    object_na: float | None = None
    image_f_number: float | None = None
    image_radius: float | None = None
    half_field_deg: float | None = None
    object_distance: float = math.inf
    film_given: bool = True
    unit: str | None = None
    rims: str = "source"
    stated_efl: float | None = None
    drawn: bool = False
    nominal: float | None = None
    stop_given: bool = False
    skipped: Counter[str] = field(default_factory=Counter)
    object_medium: MediumFields = field(default_factory=MediumFields)
    wavelengths_nm: tuple[float, ...] = ()

    def in_file(self, text: str) -> str:
        """Return a message about rows in which each is called as the file calls its surface."""

        def renamed(found: re.Match[str]) -> str:
            rows = [self.rows[k].name for k in map(int, found[1].split(", ")) if k < len(self.rows)]
            return f"surface {', '.join(rows)} of the file" if rows and all(rows) else found[0]

        return _ROWS.sub(renamed, text)


def primary_first(wavelengths_nm: Iterable[float], primary_nm: float) -> tuple[float, ...]:
    """Return the wavelengths of a file in the order of `Lens`; those beyond what neurolens traces are left out."""
    sound = [round(nm, 6) for nm in wavelengths_nm if within(WAVELENGTH_NM, nm)]  # as read in micrometres
    return tuple(sorted(sound, key=lambda nm: nm != round(primary_nm, 6)))
