"""Text files of the Optical Bench of PhotonsToPhotos: patents' tables, words parted by tabs, in sections.

[descriptive data] with the title; [constants]: AsphericalA2, AsphericalOddCount; [variable distances]: a name and a
value for each state: Focal Length, Angle of View (full, degrees), F-Number, Image Height (diameter of the image
circle), Aperture Diameter (of the stop), d0 (to the object, "Infinity"), and the gaps that the table names (d5, Bf);
[lens data]: number, radius ("Infinity"; AS the stop, FS a field stop, CG a cover glass, all plane), thickness or the
name of a gap, n_d, clear diameter, V_d, and, an extension, glass and maker; [aspherical data]: number, radius, conic
constant, and coefficients from the 4th power on, even ones: with AsphericalA2 from the 2nd on, with AsphericalOddCount
n the n odd powers from the 3rd on stand between them. Other sections are words and figures of the page.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens, Surface
from neurolens.readers.draft import INFINITE, Draft, ReadOptions, Row, State, lens_of
from neurolens.readers.glasses import same_glass
from neurolens.readers.source import MAX_SURFACES, Line, assume, read_lines, warn

SECTIONS = ("descriptive data", "constants", "variable distances", "lens data", "aspherical data")
_PLANE = ("AS", "FS", "CG", "INFINITY", "INF")
_UNKNOWN = ("", "undefined", "?", "-")
_SAME = 1e-3  # relative: a radius repeated beside its aspheric coefficients
_MAX_STATES = 200


@dataclass
class _File:
    """The content of a file by section; `gaps` holds the names that the table has in place of thicknesses."""

    draft: Draft
    constants: dict[str, str] = field(default_factory=dict)
    variables: dict[str, tuple[Line, list[str]]] = field(default_factory=dict)
    surfaces: list[Surface] = field(default_factory=list)
    ids: dict[str, int] = field(default_factory=dict)
    gaps: dict[int, tuple[Line, str]] = field(default_factory=dict)
    aspheres: list[tuple[Line, list[str]]] = field(default_factory=list)
    field_stops: set[int] = field(default_factory=set)

    def names(self) -> list[str]:
        """Return the numbers of the surfaces; a plane that was added has none."""
        return [*self.ids, *[""] * (len(self.surfaces) - len(self.ids))]

    def value(self, name: str, place: int) -> float | None:
        """Return a variable in a state, None where it is not told; "Infinity" is `math.inf`."""
        line, words = self.variables.get(name.lower(), (None, []))
        word = words[place].strip() if place < len(words) else ""
        if line is None or word.lower() in _UNKNOWN:
            return None
        return math.inf if word.lower().startswith("inf") else line.number_of(name, word)


def read_opticalbench(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a text of the Optical Bench, with a state for every column that has all gaps of the table.

    Raises:
        InputError: a section without its columns, a gap without a value, aspheric data of no surface.
    """
    found = _File(Draft(str(path), "Optical Bench", unit="mm", drawn=True, rims="estimated"))
    section = ""
    for line in read_lines(path):
        text = line.text.partition("#")[0].partition("//")[0]
        words = [word.strip() for word in text.rstrip().split("\t")]
        if text.strip().startswith("["):
            section = text.strip().strip("[]").strip().lower()
        elif text.strip():
            _read(found, section, line, words)
    if not found.surfaces:
        raise InputError(str(path), "[lens data]", "(no rows)", "the table of surfaces")
    if found.surfaces[-1].n_d != 1:
        assume(str(path), "the last medium is glass: a plane is assumed behind it, the film in the focus")
        found.surfaces.append(Surface(math.inf, 0.0, found.surfaces[-1].diameter_mm))
    for line, words in found.aspheres:
        _bend(found, line, words)
    return lens_of(_complete(found), options)


def looks_like_opticalbench(head: str) -> bool:
    """Test whether the beginning of a text names sections of the format."""
    rows = {row.strip().lower() for row in head.splitlines() if row.startswith("[")}
    return bool(rows & {"[lens data]", "[variable distances]"})


def _read(found: _File, section: str, line: Line, words: list[str]) -> None:
    match section:
        case "descriptive data" if words[0].lower() == "title":
            found.draft.name = " ".join(words[1:]).strip()
        case "descriptive data":
            found.draft.notes.append(" ".join(words))
        case "constants":
            found.constants[words[0].lower()] = words[1] if len(words) > 1 else ""
        case "variable distances":
            if len(words) > _MAX_STATES:
                raise line.error(words[0], f"({len(words)} values)", f"at most {_MAX_STATES} states")
            found.variables[words[0].lower()] = line, words[1:]
        case "lens data":
            _row(found, line, words)
        case "aspherical data":
            found.aspheres.append((line, words))


def _row(found: _File, line: Line, words: list[str]) -> None:
    if len(words) < 3 or len(words[0].split()) != 1:
        raise line.error("[lens data]", line.text, "number, radius, thickness, n_d, diameter and V_d between tabs")
    name, radius, gap, index, diameter, abbe, glass = (words + [""] * 7)[:7]
    k = len(found.surfaces)
    if name in found.ids or k >= MAX_SURFACES:
        raise line.error("number", name, f"a number of its own for each of at most {MAX_SURFACES} surfaces")
    found.ids[name] = k
    try:
        thickness = float(gap)
    except ValueError:
        found.gaps[k], thickness = (line, gap), math.nan
    if radius.upper() == "FS":
        found.field_stops.add(k)
    plane = radius.upper().lstrip("+-") in _PLANE
    medium: dict[str, Any] = {}
    if index:
        n_d, V_d = line.number_of("n_d", index), line.number_of("V_d", abbe) if abbe else None
        medium = {"n_d": n_d, "V_d": V_d, "material": glass or None, "glass": same_glass(glass or None, n_d, V_d)}
    width = math.nan if diameter.lower() in _UNKNOWN else line.number_of("diameter", diameter)
    surface = Surface(
        radius_mm=math.inf if plane else line.number_of("radius", radius) or math.inf,
        thickness_mm=thickness,
        diameter_mm=width if width > 0 else math.nan,
        stop=radius.upper() == "AS",
        **medium,
    )
    found.surfaces.append(surface)


def _bend(found: _File, line: Line, words: list[str]) -> None:
    """Add a row of aspheric data to its surface."""
    if words[0].partition("(")[0] in found.ids and words[0].endswith(")"):
        warn(line.file, f"line {line.number}: the data of {words[0]}, another version of its surface, are left out")
        return
    if words[0] not in found.ids:
        raise line.error("[aspherical data]", words[0], f"the number of a surface: {', '.join(found.ids)}")
    k = found.ids[words[0]]
    values = [line.number_of("coefficient", w) if w else 0.0 for w in words[2:]]
    surface = found.surfaces[k]
    if len(words) > 1 and words[1].upper().lstrip("+-") not in (*_PLANE, ""):
        radius = line.number_of("radius", words[1])
        if abs(radius - surface.radius_mm) > _SAME * abs(radius):
            raise line.error("radius", radius, f"{surface.radius_mm:g}, as the table has for surface {words[0]}")
    odd = found.constants.get("asphericaloddcount", "0")
    if not odd.isdecimal():
        raise line.error("AsphericalOddCount", odd, "how many odd powers the coefficients have")
    first = [2] if "asphericala2" in found.constants else []
    powers = [*first, *(p for p in range(3, 41) if p % 2 == 0 or p <= 2 * int(odd) + 1)]
    if len(values) - 1 > len(powers):
        raise line.error("[aspherical data]", f"({len(values) - 1} coefficients)", f"at most {len(powers)}")
    asphere = tuple((p, a) for p, a in zip(powers, values[1:], strict=False) if a)
    conic = values[0] if values and not math.isinf(surface.radius_mm) else 0.0
    found.surfaces[k] = replace(surface, conic=conic, asphere=asphere)


def _complete(found: _File) -> Draft:
    """Return the draft of the first state, with all states where there are several."""
    draft, file = found.draft, found.draft.file
    columns = max((len(words) for _, words in found.variables.values()), default=1)
    states = [s for s in (_state(found, place) for place in range(columns)) if s is not None]
    if not states:
        line, name = next(iter(found.gaps.values()))
        raise line.error("thickness", name, "a number, or a gap with a value in [variable distances]")
    table = states[0]
    gaps = table.thickness
    rows = [replace(s, thickness_mm=gaps.get(k, s.thickness_mm)) for k, s in enumerate(found.surfaces)]
    opening = found.value("Aperture Diameter", 0)
    if opening is not None and opening > 0:
        rows = [replace(s, diameter_mm=opening) if s.stop else s for s in rows]
        draft.stop_given = True
    draft.object_distance = table.object_distance
    draft.rows = tuple(
        Row(s, _cuts(found, rows, k), name) for k, (s, name) in enumerate(zip(rows, found.names(), strict=True))
    )
    draft.f_number = table.f_number
    draft.film_given = table.film_given
    if math.isinf(table.object_distance):
        draft.stated_efl = _positive(found.value("Focal Length", 0))
    if (angle := _positive(found.value("Angle of View", 0))) is not None and angle < 358:
        draft.half_field_deg = angle / 2
    if (image := _positive(found.value("Image Height", 0))) is not None:
        draft.image_radius = image / 2
    if draft.f_number is None and found.value("NA", 0):
        assume(file, "an NA in the place of an f-number: the stop's diameter is taken")
    draft.states = tuple(states) if len(states) > 1 else ()
    return draft


def _cuts(found: _File, rows: list[Surface], k: int) -> bool:
    """Test whether the file sets an aperture: a rim on glass, or a field stop that does not reach into an element."""
    before = rows[k - 1].thickness_mm if k else 0.0
    if k in found.field_stops and min(before, rows[k].thickness_mm) < 0:
        assume(found.draft.file, f"field stop {k}, a ring about an element, is left out: rims are assumed to decide")
        return False
    return not rows[k].stop and not math.isnan(rows[k].diameter_mm)


def _positive(value: float | None) -> float | None:
    return value if value is not None and 0 < value < INFINITE else None


def _state(found: _File, place: int) -> State | None:
    """Return the state of a column; None where a gap that the table names has no value in it."""
    gaps: dict[int, float] = {}
    last = len(found.surfaces) - 1
    for k, (line, name) in found.gaps.items():
        value = found.value(name, place)
        if value is None and name.lower() == "bf" and k == last:
            value = 0.0  # the film is put in the focus
        if value is None:
            return None
        if not math.isfinite(value):
            raise line.error(name, value, "a finite gap")
        gaps[k] = value
    distance = found.value("d0", place)
    near = distance is not None and 0 < distance < INFINITE
    focal = _positive(found.value("Focal Length", place))
    words = [f"{focal:g} mm"] if focal is not None else [f"state {place + 1}"]
    tabled = gaps.get(last, float(found.surfaces[last].thickness_mm))
    return State(
        name=" ".join([*words, *([f"at {distance:g} mm"] if near else [])]),
        thickness=gaps,
        f_number=None if near and place else _positive(found.value("F-Number", place)),
        stop_diameter=_positive(found.value("Aperture Diameter", place)),
        object_distance=float(distance) if near and distance is not None else math.inf,
        film_given=tabled != 0,
    )
