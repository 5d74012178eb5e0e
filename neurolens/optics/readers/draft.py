"""The data that a reader finds in a file, and its conversion to a lens, common to all formats."""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, printable
from neurolens.base.settings import WAVELENGTH_NM, within
from neurolens.optics.lens.figures import MOST_Q_TERMS, WIDEST_Q, figure_of, qcon_powers
from neurolens.optics.lens.prescription import Configuration, Lens, Medium, Surface, same_medium
from neurolens.optics.readers.assemble import (
    UNKNOWN,
    finish,
    first_order,
    narrowed,
    pupil_of,
    qbfs_terms,
    smaller_stop,
    stop_aperture,
    with_likely_rims,
    with_rims,
    with_stop,
)
from neurolens.optics.readers.breaks import Step, Turn, placements
from neurolens.optics.readers.source import MAX_SURFACES, UNITS_MM, Line, ReadOptions, warn
from neurolens.optics.setting.rims import check_states

INFINITE = 1e9  # in any unit; programs write 1e10 or more for an object at infinity
MAX_STATES = 200
LEAST_RADIUS = 1e-3  # the least that coefficients of aspheres are normalised by, in the unit of the file


@dataclass
class Block:
    """One surface while a file is read, in the file's unit; readers add what else their formats say."""

    start: Line
    name: str = ""
    curvature: float = 0.0
    conic: float = 0.0
    thickness: float = 0.0
    semi_diameter: float = UNKNOWN
    medium: dict[str, Any] = field(default_factory=dict)
    stop: bool = False
    aperture: bool = False  # as in `Row`
    solved: bool = False  # whether the thickness follows from others, or from the paraxial image
    turn: Turn | None = None  # of the local axes, at this surface

    @property
    def radius(self) -> float:
        return 1 / self.curvature if self.curvature else math.inf

    def rotational(self, asphere: Iterable[tuple[int, float]] = ()) -> dict[str, Any]:
        """Return radius and figure of a surface of revolution, for `row`; the conic of a plane has no effect."""
        conic = self.conic if self.curvature else 0.0
        return {"radius_mm": self.radius, "conic": conic, "asphere": tuple((p, a) for p, a in asphere if a)}

    def crossed(self, curve: dict[str, Any], radius_x: float, conic_x: float | None) -> dict[str, Any]:
        """Bend a curve in y, given as by `rotational`, in x too.

        It is turned, or with a conic becomes a biconic. It is a cylinder where one of both is straight (an infinite
        radius), and round where both are the same.
        """
        bent = bool(self.curvature or curve["asphere"])
        if math.isinf(radius_x):
            return curve | ({"cylinder": "y"} if bent else {})
        if not bent:
            return {"radius_mm": radius_x, "conic": conic_x or 0.0, "cylinder": "x"}
        same = math.isclose(radius_x * self.curvature, 1.0, rel_tol=1e-12) and (conic_x or 0.0) == self.conic
        return curve if same and not curve["asphere"] else curve | {"cylinder": "y", "across": (radius_x, conic_x)}

    def q_type(self, name: str, qcon: bool, values: list[float], radius: float) -> dict[str, Any]:
        """A surface of Forbes's kind, as by `rotational`: coefficients from m = 0, and a normalisation radius."""
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
            found = f"(curvature {self.curvature:g}, rim {rim:g})"
            raise self.start.error(name, found, str(error)) from None
        return self.rotational(terms)

    def row(self, shape: dict[str, Any]) -> Row:
        """Return the row of a surface with this `radius_mm` and figure, by the keys of `figures.figure_of`."""
        lengths = shape["radius_mm"], self.thickness, 2 * self.semi_diameter
        surface = Surface(*lengths, stop=self.stop, figure=figure_of(shape), **self.medium)
        return Row(surface, self.aperture, self.name)


@dataclass(frozen=True)
class Row:
    """One surface in the file's unit.

    Attributes:
        surface: its diameter may be `assemble.UNKNOWN`.
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
        pupil, f_number, object_na: if one is given, it sizes the stop, else the stop's diameter does. `object_na` is
            the numerical aperture n sin(theta) of the beam from the axis of a near object.
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
    object_medium: dict[str, Any] = field(default_factory=dict)
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


def lens_of(draft: Draft, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a draft, in mm, checked by `assemble.finish`; InputError if `options` give another unit."""
    options = options or ReadOptions()
    if +draft.skipped:
        listed = (word if count == 1 else f"{word} ({count})" for word, count in (+draft.skipped).items())
        warn(draft.file, f"left out, since no ray depends on it: {', '.join(listed)}")
    try:
        draft = with_stop(_without_negative_zeros(draft), options.stop)
        draft = _without_dummies(draft)
        if draft.states and any(row.surface.placement for row in draft.rows):
            raise InputError(draft.file, "configurations", f"({len(draft.states)} of them)", _ONE_PLACE)
        return _lens_of(draft, options)
    except InputError as error:
        value = draft.in_file(error.value) if isinstance(error.value, str) else error.value
        raise InputError(error.file, draft.in_file(error.field), value, draft.in_file(error.expected)) from None


def _lens_of(draft: Draft, options: ReadOptions) -> Lens:
    unit = options.units or draft.unit or "mm"
    if options.units and draft.unit and options.units != draft.unit:
        raise InputError(
            draft.file, "--units", options.units, f"{draft.unit!r}, as the file itself says (or no --units)"
        )
    if unit not in UNITS_MM:
        raise InputError(draft.file, "--units", unit, f"one of {', '.join(UNITS_MM)}")
    factor = UNITS_MM[unit]
    if options.f_number is not None and (draft.f_number or draft.pupil) is not None:
        warn(draft.file, f"--f-number {options.f_number:g} is not used: the file sizes the stop itself")
    f_number = draft.f_number or options.f_number or math.nan
    lens = Lens(
        name=options.name or draft.name or printable(Path(draft.file).stem),
        source=options.source or f"{draft.kind} file {printable(Path(draft.file).name)}",
        surfaces=tuple(row.surface for row in draft.rows),
        f_number=f_number,
        image_radius_mm=draft.image_radius,
        half_field_deg=options.half_field_deg or draft.half_field_deg,
        notes="\n".join(draft.notes),
        rims=draft.rims,
        path=draft.file,
        stated_efl_mm=draft.stated_efl,
        object_medium=Medium(**draft.object_medium),
        wavelengths_nm=draft.wavelengths_nm,
    )
    if draft.drawn:
        lens = with_likely_rims(lens, draft)
    if draft.f_number is not None and draft.pupil is None and not draft.stop_given:
        # The file's f-number overrides a diameter of the stop, except for an aperture set on it.
        rows = (replace(s, diameter_mm=math.nan) if s.stop else s for s in lens.surfaces)
        lens = replace(lens, surfaces=tuple(rows))
    pupil = draft.pupil if draft.object_na is None else pupil_of(lens, draft.object_na, draft.object_distance)
    lens = finish(lens, pupil_mm=pupil, film_given=draft.film_given, stop_limit_mm=stop_aperture(draft))
    if draft.stop_given and abs((by_stop := first_order(lens).f_number) / lens.f_number - 1) > _AGREES:
        message = f"a stop {lens.stop_radius_mm * 2:g} wide gives f/{by_stop:.3g}, the file says f/{lens.f_number:.3g}"
        warn(draft.file, f"{message}: the diameter is kept")
    lens = replace(lens, configurations=tuple(_configuration(lens, draft, state) for state in _states(draft)))
    lens = with_rims(lens.scaled(factor) if factor != 1 else lens, draft.in_file)
    with suppress(InputError):
        check_states(lens)
        return lens
    lens = narrowed(lens, draft)
    check_states(lens)
    return lens


_ONE_PLACE = "one configuration, where surfaces are tilted or decentred"
_ROUNDED_MM = 1e-4  # to which programs round lengths
_AGREES = 0.03  # relative, since f-numbers are printed with two digits
_ROWS = re.compile(r"\bsurface ([0-9]+(?:, [0-9]+(?![0-9.]| mm))*)(?! of the file)")


def _states(draft: Draft) -> tuple[State, ...]:
    """Return the states of the file; a table without states that is focused near becomes a focus state."""
    if not draft.states and math.isfinite(draft.object_distance):
        return (State("as filed", object_distance=draft.object_distance, film_given=draft.film_given),)
    return draft.states


def _configuration(lens: Lens, draft: Draft, state: State) -> Configuration:
    """Return a state for the lens file; its stop follows from the state's pupil or f-number."""
    last = len(lens.surfaces) - 1
    thickness = dict(state.thickness)
    if not state.film_given:
        thickness.pop(last, None)
    found = Configuration(state.name, None, tuple(sorted(thickness.items())))
    there = lens.with_gaps(dict(found.thickness_mm))
    data = first_order(there)
    opening, f_number = state.stop_diameter, state.f_number
    pupil = state.pupil
    if pupil is None and f_number is not None:
        pupil = abs(data.efl_mm) / f_number
    if pupil is None and opening is None:
        pupil = draft.pupil
        if pupil is None and draft.f_number is not None:
            pupil = abs(data.efl_mm) / draft.f_number
    if pupil is not None and opening is None:
        wanted = 2 * there.stop_radius_mm * pupil / data.entrance_pupil_diameter_mm
        opening = smaller_stop(draft.file, wanted, stop_aperture(draft), f'state "{state.name}": ')
        f_number = f_number if opening == wanted else None
    if f_number is None and opening is not None:
        f_number = data.f_number * 2 * there.stop_radius_mm / opening
    distance = state.object_distance if math.isfinite(state.object_distance) else None
    if not state.film_given:
        focal_z = data.rear_focal_z_mm if distance is None else data.image_z_mm(-distance)
        thickness[last] = focal_z - float(there.vertices_mm[last])
    return replace(
        found,
        efl_mm=None if distance is not None else data.efl_mm,
        thickness_mm=tuple(sorted(thickness.items())),
        f_number=f_number,
        stop_diameter_mm=opening,
        object_distance_mm=distance,
    )


def _without_negative_zeros(draft: Draft) -> Draft:
    """Return the draft with gaps closed that are negative by no more than rounding."""
    least, rows = -_ROUNDED_MM / UNITS_MM.get(draft.unit or "mm", 1.0), list(draft.rows)
    for k, row in enumerate(draft.rows):
        if least <= row.surface.thickness_mm < 0:
            rows[k] = replace(row, surface=replace(row.surface, thickness_mm=0.0))
            found = f"surface {k}: a thickness of {row.surface.thickness_mm:.3g} is taken as 0"
            warn(draft.file, draft.in_file(found))
    return replace(draft, rows=tuple(rows))


def _without_dummies(draft: Draft) -> Draft:
    """Return the draft without planes between equal media that cut no beam; gaps on both sides become one."""
    if len(draft.rows) > MAX_SURFACES:
        raise InputError(draft.file, "surfaces", f"({len(draft.rows)} of them)", f"at most {MAX_SURFACES}")
    rows, surfaces, medium = draft.rows, [row.surface for row in draft.rows], Medium(**draft.object_medium)
    flat = [math.isinf(s.radius_mm) and not s.stop and not s.figure.bends for s in surfaces]
    idle = [flat[k] and not row.aperture and same_medium(surfaces, k, medium) for k, row in enumerate(rows)]
    dropped = [k for k in range(len(rows)) if idle[k]]
    kept = [k for k in range(len(rows)) if k not in dropped]
    if not dropped or not kept:
        return draft
    # The kept row to which each row's thickness belongs; those in front of all (-1) belong to the object's distance.
    owner = [bisect_right(kept, k) - 1 for k in range(len(rows))]

    def merged(thickness: dict[int, float]) -> tuple[list[float], float]:
        sums = [0.0] * (len(kept) + 1)
        for k, row in enumerate(rows):
            sums[owner[k]] += thickness.get(k, row.surface.thickness_mm)
        return sums[:-1], sums[-1]

    table, front = merged({})
    new = tuple(
        replace(rows[k], surface=replace(rows[k].surface, thickness_mm=t)) for k, t in zip(kept, table, strict=True)
    )
    states = []
    for state in draft.states:
        sums, before = merged(state.thickness)
        gaps = {place: sums[place] for place in sorted({owner[k] for k in state.thickness if owner[k] >= 0})}
        states.append(replace(state, thickness=gaps, object_distance=state.object_distance + before))
    listed = draft.in_file(f"surface {', '.join(map(str, dropped))}")
    warn(draft.file, f"{listed} left out: a plane in one medium that cuts no beam")
    return replace(draft, rows=new, states=tuple(states), object_distance=draft.object_distance + front)
