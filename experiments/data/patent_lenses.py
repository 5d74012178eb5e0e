"""Write lens files of real lenses by name into lenses/, from the patent tables that LensVisualizer transcribes.

The collection (github.com/ronbuening/LensVisualizer) states no licence: what is taken are the figures of the patents,
which are facts, and no text or code. Diameters that no patent states are derived here, not copied. Clone it, and make
one JSON file of its data: npm install esbuild@0.25, then

    node experiments/data/patent_lenses.mjs CLONE/src/lens-data lenses.json
    python -m experiments patent-lenses lenses.json

A lens that lenses/ has already from the same patent is compared figure by figure instead, and its notes say whether
the two transcriptions agree. Where they differ, experiments/data/patent_lenses.toml holds the decisions. A lens that
cannot ship stands with its cause in experiments/results/patent_lenses.md. Files that are there are kept, so that the
command goes on where it was stopped; --restart writes them again.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import tomllib
import unicodedata
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from experiments import lab
from experiments.data.named_lenses import (
    NAMES,
    against_photographs,
    at_line_d,
    cemented,
    lens_id,
    rounded,
    with_beam_of_rims,
    with_whole_beam,
    with_year,
)
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.base.lensname import year_of
from neurolens.optics.lens import glass
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Configuration, Lens, Surface
from neurolens.optics.photographs.verify import DOUBTFUL_PERCENT, verify
from neurolens.optics.readers.lensfile import read_lens, write_lens
from neurolens.optics.setting.check import axial_beam, axial_blur_mm, check_lens, doubts
from neurolens.optics.setting.rims import check_states, derive_rims
from neurolens.optics.setting.states import set_lens

Row = dict[str, Any]
Double = tuple[Row, list[str]]
_LIST = lab.ROOT / "experiments" / "data" / "patent_lenses.toml"
_RIMS = {
    "source": "The rims are the patent's effective diameters.",
    "photographs": "The rims are fitted to photographs.",
    "estimated": "The rims are the patent's effective diameters, changed where they cut the axial beam.",
    "derived": "The rims are derived: the patent states none, or the collection changed them.",
}
_RECONSTRUCTED_NOTE = (
    "The near states may not be the patent's: they move the groups that it names to the product's nearest focus."
)
_UNSEEN = "There are no photographs to hold it against: nothing confirms that the product is built so."
_LATER = "It is not yet held against photographs."
_CUT = 1.03  # of the f-number, above which the check of a lens doubts it
_SMALLER = 15  # times a fiftieth by which an image circle shrinks at most
SAME_EFL = 0.01  # relative, of what the source states
_PLANE_MM = 1e9
_STATED = re.compile(
    r"(?i)effective (ray )?(aperture )?diameter|有効径|[φϕΦ]i?\s*/\s*2|patent-listed|clear aperture diameter"
)
_CHOSEN = re.compile(r"(?i)not publish|no clear ap|not patent|omits|infer|estimat|tuned|refin|reshap|render")
_CHANGED = re.compile(r"(?i)reduced|trimmed|adjust|capped|except")
_RECONSTRUCTED = re.compile(
    r"(?i)reconstruct|infer|synthe|paraxial|solved|model|not (publish|disclos|tabul)|infinity (zoom|only)|no finite"
)

OPTIONS = (
    lab.option("json", metavar="JSON", type=Path, help="what experiments/data/patent_lenses.mjs wrote"),
    lab.option("--quick", action="store_true", help="leave the photographs for a later call"),
    lab.count("workers", 1, "processes of a thread each (default: 1)"),
    lab.ONLY, lab.AGAIN, lab.out(lab.LENSES, "folder"),
)  # fmt: skip


def plain_letters(text: str) -> str:
    """The text without accents."""
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()


def product_of(name: str) -> str:
    """A product as its maker writes it: "CANON EF 11-24mm f/4 L USM" is "Canon EF 11-24mm f/4L USM"."""
    text = plain_letters(re.sub("[~–]", "-", name.replace("|", " "))).removeprefix("CARL ").removeprefix("Carl ")
    text = re.sub(r"[A-Z]{4,}", lambda word: word[0].capitalize(), text)
    text = re.sub(r"(Canon EF.* f/[\d.-]+) (?=L)|(Nikkor .*f/[\d.-]+) (?=[DEG]\b)", r"\1\2", text)
    return re.sub(r"\s+", " ", text).strip()


def maker_of(row: Row, listed: Row) -> str:
    """The maker as the library names it."""
    maker = plain_letters(row.get("maker") or row["name"].split()[0])
    return str(listed["makers"].get(maker, maker.capitalize() if maker.isupper() else maker))


def source_of(row: Row) -> str:
    """The patent with its year, and the example."""
    example = re.search(r"(?i)\b(example|embodiment|claim)s? (\d+|[IVX]+)\b", row.get("subtitle") or row["head"])
    text = f"{row['patentNumber']} ({row['patentYear']})"
    return f"{text}, {example[1].lower()} {example[2]}" if example else text


def glass_of(element: Row, index: float) -> dict[str, Any]:
    """The medium behind a surface: by n_d and V_d; of the catalogue where the three indices stated are that glass's."""
    V = element.get("vd")
    known = {"n_d": index} | ({"V_d": float(V)} if V else {})
    lines = {"nC": glass.LINE_C_NM, "nF": glass.LINE_F_NM, "ng": glass.LINE_G_NM}
    if all(element.get(key) for key in lines):
        for found in glass.same_name(re.split(r"[ (;,]", element.get("glass", "") + " ")[0]):
            if all(abs(found.index(nm) - element[key]) < 5e-5 for key, nm in lines.items()):
                if abs(found.n_d - index) < 2e-4:
                    return known | {"V_d": found.V_d, "glass": str(found)}
    return known


def mended_of(row: Row, listed: Row) -> Row:
    """The row with aspheres as decided: a number is added to conic constants, powers take the collection's place."""
    if row["key"] not in listed["aspheres"]:
        return row
    decided = listed["aspheres"][row["key"]]
    asph = {label: a | {"K": a.get("K", 0) + decided.get("conic", 0)} for label, a in row["asph"].items()}
    for label, powers in decided.get("powers", {}).items():
        asph[label] |= {f"A{n}": v for n, v in powers.items()}
    return row | {"asph": asph, "mended": decided["why"]}


def stated_at_e(row: Row) -> bool:
    """Whether the collection says that the patent's indices are those of the e line."""
    return any(e.get("indexReference") == "e" for e in row["elements"])


def surfaces_of(row: Row) -> tuple[Surface, ...]:
    """The rows of the table.

    Raises:
        InputError: a mirror or a diffractive surface, which the library does not have.
    """
    kinds = {"mirrors": row.get("opticalPath"), "a diffractive surface": None}
    for s in row["surfaces"]:
        kinds["mirrors"] = kinds["mirrors"] or s.get("interaction")
        kinds["a diffractive surface"] = kinds["a diffractive surface"] or s.get("diffractive")
    for kind in (kind for kind, has in kinds.items() if has):
        raise InputError(row["key"], "surfaces", f"({kind})", "spheres and aspheres that refract")
    elements = {e["id"]: e for e in row["elements"]}
    found = []
    for s in row["surfaces"]:
        a = (row.get("asph") or {}).get(s["label"], {})
        powers = sorted((int(key[1:]), float(v)) for key, v in a.items() if key != "K" and v)
        element = elements.get(s["elemId"], {}) if s["nd"] != 1 else {}
        found.append(
            Surface(
                math.inf if abs(s["R"]) >= _PLANE_MM else float(s["R"]),
                float(s["d"]),
                2 * float(s["sd"]),
                stop=s["label"].startswith("STO"),
                figure=Figure(conic=float(a.get("K") or 0), asphere=tuple(powers)),
                absorption_per_mm=float(element.get("absorptionCoefficientPerMm") or 0),
                **(glass_of(element, float(s["nd"])) if s["nd"] != 1 else {}),
            )
        )
    return tuple(found)


def with_states(lens: Lens, row: Row, f_numbers: list[float]) -> Lens:
    """The lens with its zoom and focus states; of one that focuses as a whole there is none, for any lens does that."""
    labels, last = {s["label"]: k for k, s in enumerate(row["surfaces"])}, len(lens.surfaces) - 1
    moves, zooms = row.get("var") or {}, row.get("zoomPositions") or [None]
    tables = {labels[label]: pairs if row.get("zoomPositions") else [pairs] for label, pairs in moves.items()}
    states: list[Configuration] = []
    for k, zoom in enumerate(zooms):
        far, near = ({s: float(pairs[k][side]) for s, pairs in tables.items()} for side in (0, 1))
        moved = lens.with_gaps(far)
        data = first_order(moved)
        stop_mm = 2 * lens.stop_radius_mm * data.f_number / f_numbers[k]
        if zoom:
            check_efl(row, data.efl_mm, zoom)
            states.append(Configuration(f"{zoom:.3g}mm", zoom, tuple(far.items()), None, f_numbers[k], stop_mm))
        inner = {s for s in far if far[s] != near[s]} - {last}
        object_mm = object_distance_mm(moved, lens.with_gaps(near)) if inner else math.nan
        if object_mm > 0:
            film_mm = object_mm + sum(near.get(s, float(r.thickness_mm)) for s, r in enumerate(lens.surfaces))
            if not zoom:
                states.append(Configuration("infinity", data.efl_mm, tuple(far.items())))
            name = f"{zoom:.3g}mm {film_mm / 1000:.2g}m" if zoom else f"{film_mm / 1000:.2g}m"
            states.append(Configuration(name, None, tuple(near.items()), object_distance_mm=round(object_mm, 3)))
    names = [c.name for c in states]
    states = [replace(c, name=f"{c.name} {k}" if names.count(c.name) > 1 else c.name) for k, c in enumerate(states)]
    first = {s: float(pairs[0][0]) for s, pairs in tables.items()}
    lens = lens.with_gaps(first)
    opened = lens.with_stop_radius(lens.stop_radius_mm * first_order(lens).f_number / f_numbers[0])
    return replace(opened, configurations=tuple(states))


def object_distance_mm(far: Lens, near: Lens) -> float:
    """From the object to the front vertex where a near state has its focus, its film as far off as that of infinity."""
    a, b = first_order(far), first_order(near)
    behind = near.vertices_mm[-1] - b.rear_focal_z_mm - (far.vertices_mm[-1] - a.rear_focal_z_mm)
    return b.efl_mm * b.front_efl_mm / behind - b.front_focal_z_mm if behind > 1e-4 * b.efl_mm else math.nan


def check_engraved(lens: Lens) -> None:
    """Raise InputError where focal length or f-number are not what the product's name says (makers round)."""
    said = re.search(r"([\d.]+)(?:-[\d.]+)?mm(?: f/([\d.]+))?", lens.name)
    found = ((first_order(lens).efl_mm, "mm", 0.09), (lens.f_number, "f-number", 0.1)) if said else ()
    for k, (value, unit, most) in enumerate(found, 1):
        text = said[k] if said else None
        if text and abs(value / float(text) - 1) > most:
            raise InputError(lens.path, "product", f"a table of {value:.4g} {unit}", f"{text}, as it is engraved")


def check_efl(row: Row, efl_mm: float, stated_mm: float) -> None:
    """Raise InputError where a focal length is not the one that the source states."""
    if not abs(efl_mm / stated_mm - 1) < SAME_EFL:
        expected = f"{stated_mm:g} mm as stated, within {100 * SAME_EFL:g}%"
        raise InputError(row["key"], "focal length", f"{efl_mm:.5g} mm", expected)


def image_of(row: Row, listed: Row) -> dict[str, Any]:
    """Radius of the image circle and, of a fisheye, the half field."""
    seen, formats = row.get("projection") or {}, listed["image_radius_mm"]
    mounts = row.get("lensMounts") or ["none"]
    radius = listed["mount_radius_mm"].get(mounts[0]) or formats.get(row.get("imageFormat", ""))
    circle = (
        max(seen["imageCircleMm"], default=0)
        if isinstance(seen.get("imageCircleMm"), list)
        else seen.get("imageCircleMm")
    )
    found = {"image_radius_mm": circle / 2 if circle else listed["own_radius_mm"].get(row["key"], radius or 21.63)}
    if "fisheye" in seen.get("kind", ""):
        full = seen["fullFieldDeg"]
        found["half_field_deg"] = (max(full) if isinstance(full, list) else full) / 2
    return found


def lens_of(row: Row, listed: Row) -> Lens:
    """The lens as the patent has it, its rims as the patent states them or derived.

    Raises:
        InputError: why it cannot ship.
    """
    if not row.get("patentNumber"):
        raise InputError(row["key"], "patent", "(none)", "a design with a published table")
    product, maker = product_of(row["name"]), maker_of(row, listed)
    zooms = row.get("zoomPositions") or [None]
    stated = row.get("nominalFno") if isinstance(row.get("nominalFno"), list) else None
    f_numbers = stated or [row.get("apertureDesign") or row["nominalFno"]] * len(zooms)
    design = row.get("focalLengthDesign")
    lens = Lens(
        name=product,
        believed_to_be=product,
        designer=", ".join([*map(plain_letters, row.get("patentAuthors") or ()), maker]),
        source=source_of(row),
        surfaces=surfaces_of(row),
        f_number=float(f_numbers[0]),
        path=f"{lens_id(product, maker)}.toml",
        mount=", ".join(listed["mounts"].get(m, m) for m in row.get("lensMounts") or ()),
        aperture=Aperture(blades, curvature=1.0) if (blades := row.get("apertureBlades") or 0) > 2 else None,
        **image_of(row, listed),
    )
    lens = with_states(at_line_d(lens, stated_at_e(row)), row, [float(n) for n in f_numbers])
    if zooms == [None] and design and "fisheye" not in (row.get("projection") or {}).get("kind", ""):
        check_efl(row, first_order(lens).efl_mm, design)
        lens = replace(lens, stated_efl_mm=float(design))
    lens = rounded(lens)
    rims = about(row, r"semi-?diameter|\bSDs?\b|clear aperture|effective")
    if not _STATED.search(rims) or _CHOSEN.search(rims):
        return with_derived(lens)
    whole = with_whole_beam(replace(lens, rims="source"))
    changed = _CHANGED.search(rims) or whole.surfaces != lens.surfaces
    return replace(whole, rims="estimated") if changed and whole.rims == "source" else whole


def about(row: Row, words: str) -> str:
    """The sentences of the collection's remarks, as one line, in which one of the words stands."""
    text = re.sub(r"[\s*║]+", " ", row["head"])
    return " ".join(s for s in re.split(r"(?<=[.;])\s", text) if re.search(words, s, re.IGNORECASE))


def with_derived(lens: Lens) -> Lens:
    """The lens with derived rims; its image circle shrinks, by a fiftieth at a time, to where light reaches."""
    for _ in range(_SMALLER):
        try:
            return with_open_beam(derive_rims(lens)[0])
        except InputError as error:
            refused, lens = error, replace(lens, image_radius_mm=round(0.98 * (lens.image_radius_mm or 0), 2))
    raise refused


def with_open_beam(lens: Lens) -> Lens:
    """The lens, with the f-number that its rims let through where they, and not the stop, end the axial beam."""
    height_mm, blocker = axial_beam(lens)
    cut = blocker not in (None, lens.stop_index) and first_order(lens).efl_mm > 2 * height_mm * _CUT * lens.f_number
    return with_beam_of_rims(lens) if cut else lens


def described(row: Row, listed: Row) -> Lens:
    """The lens with its evidence, but for photographs.

    Raises:
        InputError: why it cannot ship.
    """
    lens = lens_of(row, listed)
    check_states(lens)
    check_engraved(lens)
    first, wanted = first_order(set_lens(lens)), image_of(row, listed)["image_radius_mm"]
    notes = [
        f"Figures of the patent as LensVisualizer transcribes them (github.com/ronbuening/LensVisualizer, file "
        f"{row['file']}, which states no licence).",
        f"Believed to be the product: the collection names it, and the example has {first.efl_mm:.4g} mm and "
        f"f/{lens.f_number:.3g}.",
        *filter(None, [lens.notes, row.get("mended")]),
        _LATER,
        _RIMS[lens.rims],
    ]
    if (lens.image_radius_mm or 0) < wanted:
        notes.append(f"The film's format has a radius of {wanted:g} mm, which no light of this table reaches.")
    if lens.aperture:
        notes.append("The number of blades is the product's; their shape is not known, and the stop stays round.")
    if any(c.object_distance_mm for c in lens.configurations):
        text = f"{row.get('focusDescription', '')} {about(row, 'focus')}"
        notes.append(_RECONSTRUCTED_NOTE if _RECONSTRUCTED.search(text) else "The near states are the patent's.")
    if wrong := [d for d in doubts(check_lens(lens)) if "corner" not in d]:
        raise InputError(row["key"], "checks", f"({'; '.join(wrong)})", "figures that agree with one another")
    return rounded(replace(lens, notes=" ".join(notes)))


def seen(lens: Lens) -> Lens:
    """The lens with the verdict of photographs, and rims fitted to them where they tell.

    Raises:
        InputError: they contradict it.
    """
    lens, found = against_photographs(lens)
    if found is None:
        return replace(lens, notes=lens.notes.replace(_LATER, _UNSEEN))
    if found.certainty == "certain" and found.distortion_percent > DOUBTFUL_PERCENT:
        raise InputError(lens.path, "photographs", f"{found.distortion_percent:.2g}%", "a distortion as measured")
    notes = lens.notes.replace(_LATER, f"Against photographs ({found.profile}): {'; '.join(found.verdict)}.")
    for text in _RIMS.values():
        notes = notes.replace(text, _RIMS[lens.rims])
    return rounded(replace(lens, notes=notes, measured=tuple(found.measured.items())))


def differences(ours: Lens, theirs: tuple[Surface, ...]) -> list[str] | None:
    """Figures of our file and another transcription of its patent that differ, by surface; None for another table."""

    def bent(surfaces: tuple[Surface, ...]) -> list[Surface]:
        return [s for s in surfaces if math.isfinite(s.radius_mm)]

    pairs = list(zip(bent(ours.surfaces), bent(theirs), strict=False))
    if not pairs or len(bent(ours.surfaces)) != len(bent(theirs)):
        return None
    scale = sorted(abs(p.radius_mm / q.radius_mm) for p, q in pairs)[len(pairs) // 2]
    found = []
    for k, (p, q) in enumerate(pairs):
        a, b = dict(p.figure.asphere), {n: v * scale ** (1 - n) for n, v in q.figure.asphere}
        figures = [
            ("radius", p.radius_mm, q.radius_mm * scale, 2e-3 * abs(p.radius_mm)),
            ("n_d", p.n_d, q.n_d, 2e-3),
            ("V_d", p.V_d or q.V_d or 0, q.V_d or p.V_d or 0, 1.0),
            ("conic", p.figure.conic, q.figure.conic, 0.01),
            *((f"A{n}", a.get(n, 0), b.get(n, 0), 0.02 * max(abs(a.get(n, 0)), abs(b.get(n, 0)))) for n in a | b),
        ]
        if q.n_d != 1:
            figures.append(("thickness", p.thickness_mm, q.thickness_mm * scale, 0.01 * max(1, p.thickness_mm)))
        found += [f"{what} of curved surface {k} {u:.6g} or {v:.6g}" for what, u, v, by in figures if abs(u - v) > by]
    return found if sum(text.startswith("radius") for text in found) <= 1 else None


def double_of(row: Row, ours: dict[str, Lens], product: str) -> tuple[str, list[str]] | None:
    """Our file of the same table, by patent or product and radii, and what differs; None where there is none."""

    def numbers(text: str) -> set[str]:
        return {re.sub(r"\D", "", n).lstrip("0") for n in re.findall(r"\d[\d,/\-\s]{4,}\d", text)}

    wanted = numbers(row.get("patentNumber", ""))
    for name, lens in ours.items():
        if _plain(name) == _plain(product) or any(
            a == b or (len(a) > 6 < len(b) and (a.endswith(b) or b.endswith(a)))
            for a in wanted
            for b in numbers(lens.source)
        ):
            theirs = cemented(Lens("", "", surfaces_of(row), 1.0))
            found = differences(at_line_d(cemented(lens)), at_line_d(theirs, stated_at_e(row)).surfaces)
            if found is not None:
                return name, found
    return None


def _plain(name: str) -> str:
    return re.sub(r"\W|_", "", name)


def settled(name: str, lens: Lens, listed: Row, row: Row | None, found: list[str]) -> None:
    """Mend our file where its kind of mistake is known, and write into its notes whether two transcriptions agree.

    Raises:
        InputError: they differ, and no decision is listed.
    """
    decided = listed["decisions"].get(name, {})
    notes = re.sub(r" (Two transcriptions of|Another transcription|Another table) .*", "", lens.notes)
    mended = at_line_d(cemented(replace(lens, notes=notes)), decided.get("line_e", False))
    mended = mended.with_gaps({int(k): v for k, v in decided.get("thickness_mm", {}).items()})
    rows = list(mended.surfaces)
    for k, radius_mm in decided.get("radius_mm", {}).items():
        rows[int(k)] = replace(rows[int(k)], radius_mm=radius_mm)
    for k, figure in decided.get("figure", {}).items():
        powers = tuple((int(n), v) for n, v in figure["asphere"].items()) if "asphere" in figure else None
        old = rows[int(k)].figure
        rows[int(k)] = replace(rows[int(k)], figure=replace(old, conic=figure["conic"], asphere=powers or old.asphere))
    mended = replace(mended, surfaces=tuple(rows))
    if mended.surfaces != lens.surfaces:
        mended = held_again(mended)
    if row and decided:
        what = decided.get("kind", "transcription")
        said = f" Another {what} differs, LensVisualizer ({row['file']}). {decided['why']}"
    elif row and found:
        raise InputError(_LIST, f"decisions, {name}", "(missing)", f"a decision: {'; '.join(found[:6])}")
    else:
        agree = "Two transcriptions of the patent agree: OpticsDatabase and LensVisualizer"
        said = f" {agree} ({row['file']})." if row else ""
    patent, comma, example = lens.source.rpartition(", ")
    source = lens.source if year_of(lens.source) else with_year(patent, listed) + comma + example
    mended = replace(mended, notes=mended.notes + said, source=source)
    if mended != lens:
        write_lens(mended, lab.LENSES / f"{name}.toml")


def held_again(lens: Lens) -> Lens:
    """A lens whose figures have changed, with the focal length and what photographs say of it in its notes."""
    lens, found = against_photographs(lens)
    efl_mm = float(first_order(set_lens(lens)).efl_mm)
    notes = re.sub(r"(has )[\d.]+ mm and f/[\d.]*\d", rf"\g<1>{efl_mm:.1f} mm and f/{lens.f_number:.3g}", lens.notes)
    if found:
        said = f"Against photographs ({found.profile}): {'; '.join(found.verdict)}. The rims"
        notes = re.sub(r"Against photographs \(.*?\. The rims", lambda _: said, notes)
        lens = replace(lens, measured=tuple(found.measured.items()))
    return rounded(replace(lens, notes=notes))


def evidence(lens: Lens) -> str:
    """Focal length, back focus and blur of the axis at full aperture, and the distortion beside certain photographs."""
    try:
        data, blur_um = first_order(lens), 1000 * axial_blur_mm(set_lens(lens))
        text = f"{data.efl_mm:.5g} mm, {data.back_focus_mm:.5g} mm, {blur_um:.2g} um"
        found = verify(lens)
        return text + (f", {found.distortion_percent:.2g}%" if found.certainty == "certain" else "")
    except NeurolensError:
        return text


def theirs_of(row: Row, ours: Lens, listed: Row) -> Lens:
    """The collection's table as it would ship; as it stands, with our stop and names, where it could not."""
    try:
        return lens_of(row, listed)
    except NeurolensError:
        lens = at_line_d(Lens("", "", surfaces_of(row), 1.0), stated_at_e(row))
        lens = replace(ours, surfaces=lens.surfaces, configurations=())
        return lens.with_stop_radius(lens.stop_radius_mm * first_order(lens).f_number / ours.f_number)


def page(
    left_out: dict[str, str], doubles: dict[str, Double], count: int, decided: list[list[str]], listed: Row
) -> str:
    """The table of lenses that do not ship, of those of which two transcriptions exist, and what was decided."""
    agree = sorted(doubles.keys() - {row[0] for row in decided})
    return lab.page(
        "# Lenses of patents by a public collection",
        f"`python -m experiments patent-lenses`: {count} files of lenses/ are made from it, and {len(doubles)} were "
        "there from another table of the same product. Every other table has a cause here.",
        f"## Left out: {len(left_out)}",
        lab.table("lens|cause", [[key, why] for key, why in left_out.items()]),
        f"## In lenses/ already, from the same table: {len(doubles)}",
        f"{len(agree)} agree in every figure: {', '.join(agree)}.",
        "## Decided",
        "Focal length, back focus and RMS blur of the axis at full aperture of both tables, and, where the match with "
        "a profile is certain, how far the distortion is from photographs. The reasons stand in the files.",
        lab.table("file|what differs|ours now|theirs|decided", decided),
        "## Aspheres that stay as the collection has them",
        "The axis of these is sharper with conic constants larger or smaller by 1; other figures are then worse.",
        lab.table("lens|why", list(listed["aspheres_kept"].items())),
        "## Doubted",
        "Some figure of these is likely to be wrong, as no product blurs so what is off the axis; it was not found.",
        lab.table("lens|blur", list(listed["doubted"].items())),
    )


def run(args: argparse.Namespace) -> None:
    """Write the files and the table."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", NeurolensWarning)
    listed = tomllib.loads(_LIST.read_text(encoding="utf-8"))
    named = tomllib.loads(NAMES.read_text(encoding="utf-8"))
    listed |= {key: named[key] for key in ("years", "first_us_patents")}
    rows = json.loads(args.json.read_text(encoding="utf-8"))
    rows = lab.chosen([mended_of(r, listed) for r in rows], lambda r: r["key"], args.only, "patent-lenses")
    ours = {file.stem: read_lens(file) for file in lab.LENSES.glob("*.toml") if "OpticsDatabase" in file.read_text()}
    names = {_plain(name): name for name in ours}
    left_out, doubles, wanted = dict[str, str](), dict[str, Double](), dict[Path, Row]()
    for row in rows:
        name = lens_id(product_of(row["name"]), maker_of(row, listed))
        try:
            if row["key"] in listed["left_out"]:
                left_out[row["key"]] = listed["left_out"][row["key"]]
            elif double := double_of(row, ours, name):
                doubles[double[0]] = row, double[1]
            elif _plain(name) in names or args.out / f"{name}.toml" in wanted:
                left_out[row["key"]] = "the product is there from another table"
                if file := names.get(_plain(name)):
                    doubles[file] = row, ["another table"]
            else:
                wanted[args.out / f"{name}.toml"] = row
        except NeurolensError as error:
            left_out[row["key"]] = str(error).partition(": ")[2]
    with ProcessPoolExecutor(args.workers, mp_context=get_context("fork")) as pool:
        jobs = [(file, row, listed, args.restart, args.quick) for file, row in wanted.items()]
        found = pool.map(write, jobs)
        for _, row, *_ in lab.counted(jobs, "lenses", args.quiet):
            if cause := next(found):
                left_out[row["key"]] = cause
    if args.only:
        return
    decided = []
    for name, lens in sorted(ours.items()):
        row, what = doubles.get(name, (None, []))
        settled(name, lens, listed, row, what)
        if row and (decision := listed["decisions"].get(name)):
            now = read_lens(lab.LENSES / f"{name}.toml")
            beside = evidence(theirs_of(row, now, listed))
            decided.append([name, decision["differs"], evidence(now), beside, decision["decided"]])
    count = len([file for file in wanted if file.is_file()])
    text = page(left_out, doubles, count, decided, listed)
    atomic_write_text(lab.RESULTS / "patent_lenses.md", text)
    print(f"{count} lens files in {args.out}, {len(left_out)} left out, {len(doubles)} there already")


def write(job: tuple[Path, Row, Row, bool, bool]) -> str:
    """Write a lens file that is not there; the cause where that cannot be."""
    file, row, listed, again, quick = job
    torch.set_num_threads(1)
    try:
        if again or not file.is_file():
            write_lens(described(row, listed), file)
        lens = read_lens(file)
        if not quick and _LATER in lens.notes:
            write_lens(seen(lens), file)
            read_lens(file)
    except NeurolensError as error:
        file.unlink(missing_ok=True)
        return str(error).partition(": ")[2]
    return ""
