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
from neurolens.readers.draft import INFINITE, Draft, Row, State, lens_of
from neurolens.readers.glasses import same_glass
from neurolens.readers.source import MAX_SURFACES, Line, ReadOptions, assume, read_lines, warn

_PLANE = ("AS", "FS", "CG", "INFINITY", "INF")
_UNKNOWN = ("", "undefined", "?", "-")
_SAME = 1e-3  # relative: a radius repeated beside its aspheric coefficients
_MAX_STATES = 200


@dataclass
class File(Draft):
    """A file while it is read, by section; `gaps` holds the names that the table has in place of thicknesses."""

    kind: str = "Optical Bench"
    unit: str | None = "mm"
    drawn: bool = True
    rims: str = "estimated"
    constants: dict[str, str] = field(default_factory=dict)
    variables: dict[str, tuple[Line, list[str]]] = field(default_factory=dict)
    surfaces: list[Surface] = field(default_factory=list)
    ids: dict[str, int] = field(default_factory=dict)
    gaps: dict[int, tuple[Line, str]] = field(default_factory=dict)
    aspheres: list[tuple[Line, list[str]]] = field(default_factory=list)
    field_stops: set[int] = field(default_factory=set)

    def value(self, name: str, place: int) -> float | None:
        """Return a variable in a state, None where it is not stated; "Infinity" is `math.inf`."""
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
    file = File(str(path))
    section = ""
    for line in read_lines(path):
        text = line.text.partition("#")[0].partition("//")[0]
        words = [word.strip() for word in text.rstrip().split("\t")]
        if text.strip().startswith("["):
            section = text.strip().strip("[]").strip().lower()
        elif text.strip():
            _read(file, section, line, words)
    if not file.surfaces:
        raise InputError(str(path), "[lens data]", "(no rows)", "the table of surfaces")
    if file.surfaces[-1].n_d != 1:
        assume(str(path), "the last medium is glass: a plane is assumed behind it, the film in the focus")
        file.surfaces.append(Surface(math.inf, 0.0, file.surfaces[-1].diameter_mm))
    for line, words in file.aspheres:
        _bend(file, line, words)
    _complete(file)
    return lens_of(file, options)


def looks_like_opticalbench(head: str) -> bool:
    """Test whether the beginning of a text names sections of the format."""
    rows = {row.strip().lower() for row in head.splitlines() if row.startswith("[")}
    return bool(rows & {"[lens data]", "[variable distances]"})


def _read(file: File, section: str, line: Line, words: list[str]) -> None:
    match section:
        case "descriptive data" if words[0].lower() == "title":
            file.name = " ".join(words[1:]).strip()
        case "descriptive data":
            file.notes.append(" ".join(words))
        case "constants":
            file.constants[words[0].lower()] = words[1] if len(words) > 1 else ""
        case "variable distances":
            if len(words) > _MAX_STATES:
                raise line.error(words[0], f"({len(words)} values)", f"at most {_MAX_STATES} states")
            file.variables[words[0].lower()] = line, words[1:]
        case "lens data":
            _row(file, line, words)
        case "aspherical data":
            file.aspheres.append((line, words))


def _row(file: File, line: Line, words: list[str]) -> None:
    if len(words) < 3 or len(words[0].split()) != 1:
        raise line.error("[lens data]", line.text, "number, radius, thickness, n_d, diameter and V_d between tabs")
    name, radius, gap, index, diameter, abbe, glass = (words + [""] * 7)[:7]
    k = len(file.surfaces)
    if name in file.ids or k >= MAX_SURFACES:
        raise line.error("number", name, f"a number of its own for each of at most {MAX_SURFACES} surfaces")
    file.ids[name] = k
    try:
        thickness = float(gap)
    except ValueError:
        file.gaps[k], thickness = (line, gap), math.nan
    if radius.upper() == "FS":
        file.field_stops.add(k)
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
    file.surfaces.append(surface)


def _bend(file: File, line: Line, words: list[str]) -> None:
    """Add a row of aspheric data to its surface."""
    if words[0].partition("(")[0] in file.ids and words[0].endswith(")"):
        warn(line.file, f"line {line.number}: the data of {words[0]}, another version of its surface, are left out")
        return
    if words[0] not in file.ids:
        raise line.error("[aspherical data]", words[0], f"the number of a surface: {', '.join(file.ids)}")
    k = file.ids[words[0]]
    values = [line.number_of("coefficient", w) if w else 0.0 for w in words[2:]]
    surface = file.surfaces[k]
    if len(words) > 1 and words[1].upper().lstrip("+-") not in (*_PLANE, ""):
        radius = line.number_of("radius", words[1])
        if abs(radius - surface.radius_mm) > _SAME * abs(radius):
            raise line.error("radius", radius, f"{surface.radius_mm:g}, as the table has for surface {words[0]}")
    odd = file.constants.get("asphericaloddcount", "0")
    if not odd.isdecimal():
        raise line.error("AsphericalOddCount", odd, "how many odd powers the coefficients have")
    first = [2] if "asphericala2" in file.constants else []
    powers = [*first, *(p for p in range(3, 41) if p % 2 == 0 or p <= 2 * int(odd) + 1)]
    if len(values) - 1 > len(powers):
        raise line.error("[aspherical data]", f"({len(values) - 1} coefficients)", f"at most {len(powers)}")
    asphere = tuple((p, a) for p, a in zip(powers, values[1:], strict=False) if a)
    conic = values[0] if values and not math.isinf(surface.radius_mm) else 0.0
    file.surfaces[k] = replace(surface, conic=conic, asphere=asphere)


def _complete(file: File) -> None:
    """Set the figures of the first state, and all states where there are several."""
    columns = max((len(words) for _, words in file.variables.values()), default=1)
    states = [s for s in (_state(file, place) for place in range(columns)) if s is not None]
    if not states:
        line, name = next(iter(file.gaps.values()))
        raise line.error("thickness", name, "a number, or a gap with a value in [variable distances]")
    table = states[0]
    gaps = table.thickness
    rows = [replace(s, thickness_mm=gaps.get(k, s.thickness_mm)) for k, s in enumerate(file.surfaces)]
    opening = file.value("Aperture Diameter", 0)
    if opening is not None and opening > 0:
        rows = [replace(s, diameter_mm=opening) if s.stop else s for s in rows]
        file.stop_given = True
    file.object_distance = table.object_distance
    names = [*file.ids, *[""] * (len(rows) - len(file.ids))]  # a plane that was added has none
    file.rows = tuple(Row(s, _cuts(file, rows, k), name) for k, (s, name) in enumerate(zip(rows, names, strict=True)))
    file.f_number = table.f_number
    file.film_given = table.film_given
    if math.isinf(table.object_distance):
        file.stated_efl = _positive(file.value("Focal Length", 0))
    if (angle := _positive(file.value("Angle of View", 0))) is not None and angle < 358:
        file.half_field_deg = angle / 2
    if (image := _positive(file.value("Image Height", 0))) is not None:
        file.image_radius = image / 2
    if file.f_number is None and file.value("NA", 0):
        assume(file.file, "an NA in the place of an f-number: the stop's diameter is taken")
    file.states = tuple(states) if len(states) > 1 else ()


def _cuts(file: File, rows: list[Surface], k: int) -> bool:
    """Test whether the file sets an aperture: a rim on glass, or a field stop that does not reach into an element."""
    before = rows[k - 1].thickness_mm if k else 0.0
    if k in file.field_stops and min(before, rows[k].thickness_mm) < 0:
        assume(file.file, f"field stop {k}, a ring about an element, is left out: rims are assumed to decide")
        return False
    return not rows[k].stop and not math.isnan(rows[k].diameter_mm)


def _positive(value: float | None) -> float | None:
    return value if value is not None and 0 < value < INFINITE else None


def _state(file: File, place: int) -> State | None:
    """Return the state of a column; None where a gap that the table names has no value in it."""
    gaps: dict[int, float] = {}
    last = len(file.surfaces) - 1
    for k, (line, name) in file.gaps.items():
        value = file.value(name, place)
        if value is None and name.lower() == "bf" and k == last:
            value = 0.0  # the film is put in the focus
        if value is None:
            return None
        if not math.isfinite(value):
            raise line.error(name, value, "a finite gap")
        gaps[k] = value
    distance = file.value("d0", place)
    near = distance is not None and 0 < distance < INFINITE
    focal = _positive(file.value("Focal Length", place))
    words = [f"{focal:g} mm"] if focal is not None else [f"state {place + 1}"]
    tabled = gaps.get(last, float(file.surfaces[last].thickness_mm))
    return State(
        name=" ".join([*words, *([f"at {distance:g} mm"] if near else [])]),
        thickness=gaps,
        f_number=None if near and place else _positive(file.value("F-Number", place)),
        stop_diameter=_positive(file.value("Aperture Diameter", place)),
        object_distance=float(distance) if near and distance is not None else math.inf,
        film_given=tabled != 0,
    )
