"""Tables with a row for each surface: plain ones of renderers, FlareSim's .lens files, texts of the Optical Bench.

Plain tables (pbrt's .dat, appleseed's) have one row per surface from the scene to the film: radius of curvature,
thickness to the next surface, refractive index behind, aperture (full diameter); mm. "#" begins a comment. appleseed
puts the count of rows in front. The stop is the row of index 0 (appleseed) or of radius 0 (pbrt, which has no other
planes). Where the last thickness is 0 the film is put in the paraxial focus. Kolb's tables of 1995 have the separation
in front of each surface instead, and some have semi-diameters: see `ReadOptions`.

FlareSim, a simulator of flare for compositing programs, writes `name: TEXT`, `focal_length: MM`, `surfaces:` and one
row for each surface, from the scene to the film: radius (0 is a plane, "stop" the stop), thickness, index behind, Abbe
number (0 is unknown), semi-diameter of the rim, layers of coating. Surfaces that are not round have the type behind
these: cyl_x (axis along x, bent in y), cyl_y, or toric with the radius of a circle along y, which is turned about a
line along y at the radius of the first column. The format has no aspheres and no f-number; one collection of it states
the f-number in a comment ("f/4.1"), and its rims are diameters in the column of radii.

The Optical Bench of PhotonsToPhotos holds patents' tables in sections, with tabs between words. [descriptive data] has
the title. [constants] has AsphericalA2, AsphericalOddCount. [variable distances] has a name and a value for each state:
Focal Length, Angle of View (full, degrees), F-Number, Image Height (diameter of the image circle), Aperture Diameter
(of the stop), d0 (to the object, "Infinity"), and the gaps that the table names (d5, Bf). [lens data] has number,
radius ("Infinity"; AS the stop, FS a field stop, CG a cover glass, all plane), thickness or the name of a gap, n_d,
clear diameter, V_d, and, as an extension, glass and maker. [aspherical data] has number, radius, conic constant, and
coefficients of even powers from the 4th on: with AsphericalA2 from the 2nd on; with AsphericalOddCount n, the n odd
powers from the 3rd on stand between them. Other sections are words and figures of the page.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.optics.lens.figures import Figure, figure_of
from neurolens.optics.lens.prescription import Lens, MediumFields, Surface
from neurolens.optics.readers.assemble import lens_of
from neurolens.optics.readers.draft import INFINITE, MAX_STATES, Draft, Row, ShapeFields, State
from neurolens.optics.readers.glasses import same_glass
from neurolens.optics.readers.source import MAX_SURFACES, Line, ReadOptions, assume, read_lines, warn

COLUMNS = ("radius", "thickness", "index", "diameter")
FIGURES = ("radius", "thickness", "ior", "abbe", "semi_ap", "coating")
_BENT = {"cyl_x": "y", "cylinder_x": "y", "cyl_y": "x", "cylinder_y": "x"}
_ROUND = ("spherical", "sphere", "sph")
_STATED = re.compile(r"\b(\d{1,4}) surfaces,.*?(?:f/(\d+(?:\.\d+)?))?\s*$")
_PLANE = ("AS", "FS", "CG", "INFINITY", "INF")
_UNKNOWN = ("", "undefined", "?", "-")
_SAME = 1e-3  # relative difference of a radius that is repeated beside its aspheric coefficients


def read_table(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a table.

    Raises:
        InputError: a row has not four numbers, the count is not that of the rows, there is no stop or several.
    """
    options = options or ReadOptions()
    file, lines = str(path), read_lines(path)
    comments = [line.text.strip().lstrip("#").strip() for line in lines if line.text.lstrip().startswith("#")]
    rows: list[tuple[Line, list[float]]] = []
    count: tuple[Line, int] | None = None
    for line in lines:
        words = line.text.partition("#")[0].split()
        if not words:
            continue
        if len(words) == 1 and words[0].isdecimal() and not rows and count is None:
            count = (line, int(words[0]))
            continue
        if len(words) != len(COLUMNS):
            raise line.error("row", " ".join(words), f"{len(COLUMNS)} numbers: {', '.join(COLUMNS)}")
        rows.append((line, [line.number_of(name, word) for name, word in zip(COLUMNS, words, strict=True)]))
    if not rows:
        raise InputError(file, "rows", "(none)", f"rows of {len(COLUMNS)} numbers: {', '.join(COLUMNS)}")
    if count is not None and count[1] != len(rows):
        raise count[0].error("count", count[1], f"{len(rows)}, the number of rows in the file")
    surfaces = _surfaces(file, rows, 2.0 if options.semi_diameters else 1.0)
    if options.gap_before:
        gaps = [s.thickness_mm for s in surfaces[1:]] + [0.0]
        surfaces = [replace(s, thickness_mm=gap) for s, gap in zip(surfaces, gaps, strict=True)]
    draft = Draft(
        file=file,
        kind="lens table",
        rows=tuple(Row(s, aperture=True) for s in surfaces),
        name=next((c for c in comments if any(map(str.isalpha, c))), ""),
        notes=comments,
        film_given=surfaces[-1].thickness_mm != 0,
    )
    return lens_of(draft, options)


def _surfaces(file: str, rows: Sequence[tuple[Line, list[float]]], factor: float) -> list[Surface]:
    flat = [k for k, (_, numbers) in enumerate(rows) if numbers[0] == 0]
    stops = [k for k, (_, numbers) in enumerate(rows) if numbers[2] == 0] or flat
    if len(stops) > 1:
        found = f"(rows at line {', '.join(str(rows[k][0].number) for k in stops)})"
        raise InputError(file, "stop", found, "exactly one row of index 0, or else of radius 0: the aperture stop")
    surfaces: list[Surface] = []
    for k, (line, (radius, thickness, index, diameter)) in enumerate(rows):
        # The stop does not change the medium: pbrt and appleseed have it in air.
        n_d = 1.0 if k in stops and index == 0 else index
        if n_d < 1:
            raise line.error("index", index, "a refractive index of at least 1 (0 marks the stop)")
        if diameter <= 0:
            raise line.error("diameter", diameter, "a length above 0")
        surfaces.append(Surface(radius or math.inf, thickness, factor * diameter, n_d=n_d, stop=k in stops))
    return surfaces


def read_flaresim(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a .lens file.

    Raises:
        InputError: a type is not of the format, a row lacks one of its six figures, there are no rows.
    """
    file = str(path)
    draft, rows = Draft(file, "FlareSim", unit="mm", drawn=True, rims="estimated"), list[Surface]()
    listed, stated = False, None
    for line in read_lines(path):
        text, _, comment = line.text.partition("#")
        key, colon, value = (part.strip() for part in text.partition(":"))
        if not text.strip():
            draft.notes.append(comment.strip())
            found = _STATED.search(comment)
            if found and not listed:
                stated, draft.nominal = int(found[1]), float(found[2]) if found[2] else None
        elif listed:
            rows.append(_flaresim_surface(line, text.split()))
        elif colon and key == "surfaces":
            listed = True
        elif colon and key == "name":
            draft.name = value
        elif colon and key == "focal_length":
            focal = line.numbers(key, value.split())[0]
            draft.stated_efl = focal if focal > 0 else None
        else:
            draft.skipped[key] += 1
    if stated is not None and stated != len(rows):
        assume(file, f"a comment speaks of {stated} surfaces, the table has {len(rows)}")
    draft.notes = [note for note in draft.notes if any(map(str.isalpha, note)) and "ior" not in note]
    draft.rows = tuple(Row(s, aperture=not s.stop) for s in rows)
    draft.film_given = bool(rows) and rows[-1].thickness_mm != 0
    return lens_of(draft, options)


def _flaresim_surface(line: Line, words: list[str]) -> Surface:
    if len(words) < len(FIGURES):
        raise line.error("row", " ".join(words), f"{len(FIGURES)} figures: {', '.join(FIGURES)}")
    stop = words[0].lower() == "stop"
    thickness, index, abbe, semi = (line.number_of(n, w) for n, w in zip(FIGURES[1:5], words[1:5], strict=True))
    radius = math.inf if stop else line.number_of("radius", words[0]) or math.inf
    kind: str | None = words[6].lower() if len(words) > 6 else None
    shape: ShapeFields = {}
    if kind == "toric" and not math.isinf(radius):
        along_y = line.number_of("type", words[7]) if len(words) > 7 else 0.0
        if along_y == 0:
            raise line.error("type", " ".join(words[6:]), "toric with a radius other than 0")
        shape = {} if along_y == radius else {"cylinder": "y", "across": (radius, None)}
        radius = along_y
    elif kind in _BENT:
        shape["cylinder"] = None if math.isinf(radius) else _BENT[kind]
    elif kind not in (None, "toric", *_ROUND):
        raise line.error("type", words[6], f"one of {', '.join((*_ROUND, *_BENT, 'toric'))}")
    glass = index != 1
    return Surface(
        radius_mm=radius,
        thickness_mm=thickness,
        diameter_mm=2 * semi if semi > 0 else math.nan,
        n_d=index,
        V_d=abbe if glass and abbe > 0 else None,
        stop=stop,
        figure=figure_of(shape),
    )


@dataclass
class Bench(Draft):
    """The state of reading a file, by section; `gaps` has the names that the table has in place of thicknesses."""

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
        """Return a variable in a state; None where it is not stated. "Infinity" is `math.inf`."""
        line, words = self.variables.get(name.lower(), (None, []))
        word = words[place].strip() if place < len(words) else ""
        if line is None or word.lower() in _UNKNOWN:
            return None
        return math.inf if word.lower().startswith("inf") else line.number_of(name, word)


def read_opticalbench(path: str | Path, options: ReadOptions | None = None) -> Lens:
    """Return the lens of a text of the Optical Bench; every column that has all gaps of the table is a state.

    Raises:
        InputError: a section lacks its columns, a gap has no value, aspheric data belong to no surface.
    """
    file = Bench(str(path))
    section = ""
    for line in read_lines(path):
        text = line.text.partition("#")[0].partition("//")[0]
        words = [word.strip() for word in text.rstrip().split("\t")]
        if text.strip().startswith("["):
            section = text.strip().strip("[]").strip().lower()
        elif text.strip():
            _read_bench(file, section, line, words)
    if not file.surfaces:
        raise InputError(str(path), "[lens data]", "(no rows)", "the table of surfaces")
    if file.surfaces[-1].n_d != 1:
        assume(str(path), "the last medium is glass: a plane is assumed behind it, the film in the focus")
        file.surfaces.append(Surface(math.inf, 0.0, file.surfaces[-1].diameter_mm))
    for line, words in file.aspheres:
        _bend(file, line, words)
    _complete(file)
    return lens_of(file, options)


def _read_bench(file: Bench, section: str, line: Line, words: list[str]) -> None:
    match section:
        case "descriptive data" if words[0].lower() == "title":
            file.name = " ".join(words[1:]).strip()
        case "descriptive data":
            file.notes.append(" ".join(words))
        case "constants":
            file.constants[words[0].lower()] = words[1] if len(words) > 1 else ""
        case "variable distances":
            if len(words) > MAX_STATES:
                raise line.error(words[0], f"({len(words)} values)", f"at most {MAX_STATES} states")
            file.variables[words[0].lower()] = line, words[1:]
        case "lens data":
            _bench_row(file, line, words)
        case "aspherical data":
            file.aspheres.append((line, words))


def _bench_row(file: Bench, line: Line, words: list[str]) -> None:
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
    medium: MediumFields = {}
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


def _bend(file: Bench, line: Line, words: list[str]) -> None:
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
    file.surfaces[k] = replace(surface, figure=Figure(conic, asphere))


def _complete(file: Bench) -> None:
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
    names = [*file.ids, *[""] * (len(rows) - len(file.ids))]  # a plane that was added has no name
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


def _cuts(file: Bench, rows: list[Surface], k: int) -> bool:
    """Return whether the file sets an aperture: a rim on glass, or a field stop that does not reach into an element."""
    before = rows[k - 1].thickness_mm if k else 0.0
    if k in file.field_stops and min(before, rows[k].thickness_mm) < 0:
        assume(file.file, f"field stop {k}, a ring about an element, is left out: rims are assumed to decide")
        return False
    return not rows[k].stop and not math.isnan(rows[k].diameter_mm)


def _positive(value: float | None) -> float | None:
    return value if value is not None and 0 < value < INFINITE else None


def _state(file: Bench, place: int) -> State | None:
    """Return the state of a column; None where a gap that the table names has no value in the column."""
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
