"""Write lens files of real lenses by name into lenses/, from the examples of patents.

The figures are those of OpticsDatabase (github.com/amegahed/OpticsDatabase, MIT licence): clone it, name its folder.
The list experiments/data/named_lenses.toml says which of its files are taken. Each is held against photographs of the
product it is believed to be (`neurolens verify`; extra "photographs"), and where their light tells, its rims are fitted
to them (`neurolens rims`). A lens that its photographs contradict is left out, and said to be.
"""

from __future__ import annotations

import argparse
import re
import tomllib
import warnings
from bisect import bisect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments import lab
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.optics.lens import glass
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.rims import fit_rims, with_fitted_rims
from neurolens.optics.photographs.verify import DOUBTFUL_PERCENT, Verified, found_for, verify
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import write_lens
from neurolens.optics.setting.check import DARK, axial_beam, corner_illumination, film_edge_mm
from neurolens.optics.setting.rims import derive_rims, narrowed_rims
from neurolens.optics.setting.states import set_lens

NAMES = lab.ROOT / "experiments" / "data" / "named_lenses.toml"
_NAMED = re.compile(r"(?P<patent>[^(]+?),?\s*(?P<example>Example\s+\w+)?(?P<master>\s+ML)?\s*\((?P<product>.+)\)$")
_US = re.compile(r"US (\d\d?),(\d{3}),(\d{3})")

_SAME_BEAM = 0.99  # share of the tabled beam above which it is not worth another f-number
_RIMS = {
    "photographs": "The rims are fitted to photographs.",
    "estimated": "The rims are the collection's, widened where they cut the axial beam.",
    "derived": "The rims are derived: those of the collection leave the corner of the film dark.",
}

OPTIONS = (
    lab.option("folder", metavar="FOLDER", type=Path, help="clone of github.com/amegahed/OpticsDatabase"),
    lab.option("names", metavar="NAME", nargs="*", help="files whose name starts so (default: all of the list)"),
    lab.out(lab.ROOT / "lenses", "folder"),
)


@dataclass(frozen=True)
class Wanted:
    """A file of the collection and the maker of the lens."""

    file: Path
    maker: str


def wanted(folder: Path, listed: Mapping[str, Any], names: list[str]) -> Iterator[Wanted]:
    """The files of the list in the collection.

    Raises:
        InputError: a file that the collection does not have.
    """
    files = {file.stem: file for file in folder.rglob("*") if file.suffix.lower() == ".zmx"}
    for maker, stems in listed["makers"].items():
        for stem in stems:
            if stem not in files:
                raise InputError(NAMES, "makers", stem, f"a file of {folder}")
            if not names or any(stem.startswith(name) for name in names):
                yield Wanted(files[stem], listed["names"].get(maker, maker.capitalize()))


def product_of(text: str) -> str:
    """The name of a product as its maker writes it: "Canon EF50mm F1.4 USM" is "Canon EF 50mm f/1.4 USM"."""
    text = re.sub(
        r"^(Konica Minolta|Ricoh|Cosina|Fujifilm) (?=.*(Hexanon|Pentax|Takumar|Voigtlander|Fujinon))", "", text
    )
    text = re.sub(r"^Konica Minolta", "Minolta", re.sub(r"^Venus ", "", text))
    text = re.sub(r"\b[fF]/?(?=\d)", "f/", text)
    text = re.sub(r"^(.*?)\b(\d+(?:\.\d)?) ?/ ?(\d+)\b", r"\1\3mm f/\2", text)
    return re.sub(r"(?<=[A-Za-z])(?=\d[\d.-]*mm)|  +", " ", text).strip()


def lens_id(product: str, maker: str) -> str:
    """The name of the lens's file."""
    text = re.sub(r"\bf/", "f", product.lower())
    words, first = (re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") for name in (text, maker))
    return first + "_" + words.removeprefix(f"{first}_").replace(f"_{first}_", "_")


def with_year(patent: str, listed: Mapping[str, Any]) -> str:
    """The patent with its year, which the number of one of the United States tells; others are listed."""
    first, number = listed["first_us_patents"], _US.match(patent)
    if number:
        return f"{patent} ({first['from'] - 1 + bisect(first['numbers'], int(''.join(number.groups())))})"
    return f"{patent} ({listed['years'][patent]})" if patent in listed["years"] else patent


def source_of(patent: str, example: str | None, master: str | None, listed: Mapping[str, Any]) -> str:
    """The patent with its year, and the example."""
    patent = re.sub(r"^US00(\d)(\d{3})(\d{3})$", r"US \1,\2,\3", patent)
    parts = [with_year(patent, listed), example and example[0].lower() + example[1:], master and "master lens"]
    return ", ".join(part for part in parts if part)


def with_whole_beam(lens: Lens) -> Lens:
    """The lens with a stop of its f-number at most and rims that pass the axial beam; derived ones if they are dark."""
    derived, rims = derive_rims(lens)
    rows = []
    for s, rim in zip(lens.surfaces, rims, strict=True):
        beam_mm = min(1.005 * rim.axis_mm, rim.derived_mm)
        stop_mm = min(s.diameter_mm, rim.derived_mm)
        rows.append(replace(s, diameter_mm=stop_mm if s.stop else max(s.diameter_mm, beam_mm)))
    widened = narrowed_rims(replace(lens, surfaces=tuple(rows)))
    edge_mm = film_edge_mm(widened)
    dark = edge_mm is not None and corner_illumination(widened, edge_mm) < DARK
    return derived if dark else widened


def with_beam_of_rims(lens: Lens) -> Lens:
    """The lens with the stop and f-number of the axial beam that its fitted rims let through, where that is less."""
    height_mm, _ = axial_beam(lens)
    f_number = float(first_order(set_lens(lens)).efl_mm) / (2 * height_mm)
    share = lens.f_number / f_number
    if share > _SAME_BEAM:
        return lens
    states = (
        replace(
            c,
            f_number=c.f_number and c.f_number / share,
            stop_diameter_mm=c.stop_diameter_mm and c.stop_diameter_mm * share,
        )
        for c in lens.configurations
    )
    closed = lens.with_stop_radius(share * lens.stop_radius_mm)
    return replace(closed, f_number=f_number, configurations=tuple(states))


_LINE_E_NM, _LINES_E_NM = 546.0740, (479.9914, 643.8469)  # mercury, and cadmium's F' and C'
_SAME_N, _SAME_V = 3e-5, 0.1  # half of a unit of the last digit printed counts, but at least these
_SAME = 1.5  # of them together, within which printed figures are a catalogue glass's
_FEWEST, _TIMES = 3, 2  # glasses that must fit at the e line, and how many times those that fit at the d line


LINE_E = "The source states indices of the e line; n_d and V_d are computed from them."


@cache
def _catalogue() -> Any:
    """n_d, V_d, n_e and V_e of all glasses that are known at these lines: [G, 4]."""
    found = []
    for g in glass.all_glasses():
        n_e, n_F, n_C = (g.index(nm) for nm in (_LINE_E_NM, *_LINES_E_NM))
        if n_F > n_C:
            found.append((g.n_d, g.V_d, n_e, (n_e - 1) / (n_F - n_C)))
    return np.array(found)


def fitting(lens: Lens) -> tuple[int, int, int]:
    """How many glasses of a lens are the catalogue's if their figures are (n_d, V_d), (n_e, V_e) or (n_e, V_d)."""
    counts = [0, 0, 0]
    for n, V in {(float(s.n_d), float(s.V_d)) for s in lens.surfaces if s.V_d and s.glass is None}:
        units = (10.0 ** -len(repr(v).partition(".")[2]) / 2 for v in (n, V))
        by_n, by_V = (max(unit, least) for unit, least in zip(units, (_SAME_N, _SAME_V), strict=True))
        for k, (at, abbe) in enumerate(((0, 1), (2, 3), (2, 1))):
            away = np.hypot((_catalogue()[:, at] - n) / by_n, (_catalogue()[:, abbe] - V) / by_V)
            counts[k] += bool(away.min() < _SAME)
    return counts[0], counts[1], counts[2]


def at_line_d(lens: Lens, known: bool = False) -> Lens:
    """The lens with n_d and V_d where its source states n_e: far more of its glasses are the catalogue's at that line.

    `known`: whether the source is known to state n_e. The Abbe numbers beside them are V_e or V_d, which fits better.
    """
    if LINE_E in lens.notes:
        return lens
    d, e, mixed = fitting(lens)
    if not known and max(e, mixed) < max(_FEWEST, _TIMES * d + 1):
        return lens
    rows = []
    for s in lens.surfaces:
        n_d, V_d = (s.n_d, s.V_d) if s.glass or not s.V_d else _from_line_e(float(s.n_d), s.V_d, mixed > e)
        rows.append(replace(s, n_d=n_d, V_d=V_d))
    return replace(lens, surfaces=tuple(rows), notes=f"{lens.notes} {LINE_E}".strip())


def _from_line_e(n_e: float, V: float, abbe_d: bool) -> tuple[float, float]:
    """n_d and V_d by the dispersion that the library takes for a glass without a name."""
    n_d, V_d = n_e, V
    for _ in range(50):
        at, blue, red = (glass.index_at(n_d, V_d, nm) for nm in (_LINE_E_NM, *_LINES_E_NM))
        V_d *= 1 if abbe_d else V * (blue - red) / (at - 1)
        n_d += n_e - at
    return round(n_d, 6), round(V_d, 3)


def cemented(lens: Lens) -> Lens:
    """The lens without air of no thickness between equal radii, which some tables have where elements are cemented."""
    rows, places = list(lens.surfaces), list(range(len(lens.surfaces)))
    for k in range(len(rows) - 2, 0, -1):
        s, after = rows[k], rows[k + 1]
        glued = s.n_d == 1 != after.n_d and s.thickness_mm == 0 and s.radius_mm == after.radius_mm
        if glued and rows[k - 1].n_d != 1 and not s.stop and not after.stop:
            rows[k] = replace(after, diameter_mm=min(s.diameter_mm, after.diameter_mm))
            del rows[k + 1], places[k]
    at = {old: new for new, old in enumerate(places)}
    states = (replace(c, thickness_mm=tuple((at[k], t) for k, t in c.thickness_mm)) for c in lens.configurations)
    return replace(lens, surfaces=tuple(rows), configurations=tuple(states))


def with_state_names(lens: Lens) -> Lens:
    """The lens with its states named by focal length and distance: "70mm", "0.96m", "70mm 0.96m"."""
    states, names = [], list[str]()
    zooms = len({round(c.efl_mm or 0) for c in lens.configurations if c.object_distance_mm is None}) > 1
    for c in lens.configurations:
        parts = [f"{c.efl_mm:.0f}mm" if zooms and c.efl_mm else ""]
        parts += [f"{c.object_distance_mm / 1000:.2g}m" if c.object_distance_mm else "" if zooms else "infinity"]
        name = " ".join(filter(None, parts)) or c.name
        states.append(replace(c, name=f"{name} {c.name}" if name in names else name))
        names.append(name)
    return replace(lens, configurations=tuple(states))


def rounded(lens: Lens) -> Lens:
    """The lens with seven digits of its figures: a curvature of the collection is one over a radius of the patent."""
    keys = ("radius_mm", "thickness_mm", "diameter_mm")
    rows = (replace(s, **{key: _digits(getattr(s, key)) for key in keys}) for s in lens.surfaces)
    states = []
    for c in lens.configurations:
        figures = {key: _digits(getattr(c, key)) for key in ("efl_mm", "f_number", "stop_diameter_mm")}
        gaps = tuple((k, _digits(gap)) for k, gap in c.thickness_mm)
        states.append(replace(c, thickness_mm=gaps, **figures))
    return replace(lens, surfaces=tuple(rows), configurations=tuple(states), f_number=round(lens.f_number, 3))


def _digits(value: float | None) -> Any:
    return None if value is None else float(f"{value:.7g}")


def against_photographs(lens: Lens) -> tuple[Lens, Verified | None]:
    """The lens with rims from photographs where they tell, and what photographs say; None where there are none."""
    try:
        match, profiles, _ = found_for(lens)
        found = verify(lens)
    except NeurolensError:
        return lens, None
    if match.certainty == "certain" and len(profiles[0].focal_mm) == 1 and profiles[0].light:
        try:
            fitted = with_beam_of_rims(with_fitted_rims(lens, fit_rims(lens, profiles[0])))
            return fitted, verify(fitted)
        except NeurolensError as error:
            print(f"  rims stay: {error}")
    return lens, found


def described(want: Wanted, listed: Mapping[str, Any]) -> tuple[str, Lens, Verified | None]:
    """The id and the lens of a file with its names, source, evidence, and the verdict of photographs."""
    lens = cemented(at_line_d(read_any(want.file)))
    parts = _NAMED.match(lens.name.strip())
    if parts is None:
        raise InputError(want.file, "NAME", lens.name, "PATENT Example N (PRODUCT)")
    product = product_of(parts["product"])
    source = source_of(parts["patent"], parts["example"], parts["master"], listed)
    path = f"{lens_id(product, want.maker)}.toml"
    lens = replace(lens, name=product, believed_to_be=product, designer=want.maker, source=source, path=path)
    lens, found = against_photographs(with_whole_beam(rounded(replace(lens, rims="estimated", wavelengths_nm=()))))
    efl = f"{float(first_order(set_lens(lens)).efl_mm):.1f} mm"
    notes = [
        f"Figures of the patent as OpticsDatabase transcribes them (MIT licence; file {want.file.name}).",
        f"Believed to be the product: the collection names it, and the example has {efl} and f/{lens.f_number:.3g}.",
        *([LINE_E] if LINE_E in lens.notes else ()),
    ]
    if found is None:
        notes.append("There are no photographs to hold it against.")
    else:
        notes.append(f"Against photographs ({found.profile}): {'; '.join(found.verdict)}.")
        lens = replace(lens, measured=tuple(found.measured.items()))
    notes.append(_RIMS[lens.rims])
    return lens_id(product, want.maker), rounded(with_state_names(replace(lens, notes=" ".join(notes)))), found


def run(args: argparse.Namespace) -> int:
    """Write the files; 1 where one could not be read."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", NeurolensWarning)
    listed, failed, written = tomllib.loads(NAMES.read_text(encoding="utf-8")), 0, 0
    for want in wanted(args.folder, listed, args.names):
        try:
            name, lens, found = described(want, listed)
        except NeurolensError as error:
            print(f"{want.file.name}: {error}")
            failed += 1
            continue
        off = found.distortion_percent if found is not None and found.certainty == "certain" else 0.0
        if off > DOUBTFUL_PERCENT:
            print(f"{name}: left out, distortion differs from photographs by {off:.2g}%", flush=True)
            continue
        write_lens(lens, args.out / f"{name}.toml")
        written += 1
        print(f"{name}: {'no photographs' if found is None else '; '.join(found.verdict)}", flush=True)
    print(f"{written} lens files in {args.out}")
    return 1 if failed else 0
