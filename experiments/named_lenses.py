"""Write lens files of real lenses by name into lenses/, from the examples of patents.

The figures are those of OpticsDatabase (github.com/amegahed/OpticsDatabase, MIT licence): clone it, name its folder.
Which of its files are taken, experiments/named_lenses.toml says. Each is held against photographs of the product it
is believed to be (`neurolens verify`; extra "photographs"), and where their light tells, its rims are fitted to them
(`neurolens rims`). A lens that its photographs contradict is left out, and said to be.
"""

from __future__ import annotations

import argparse
import re
import tomllib
import warnings
from bisect import bisect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from experiments import lab
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.rims import fit_rims, with_fitted_rims
from neurolens.optics.photographs.verify import DOUBTFUL_PERCENT, Verified, found_for, verify
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import write_lens
from neurolens.optics.setting.check import DARK, axial_beam, corner_illumination, film_edge_mm
from neurolens.optics.setting.rims import derive_rims, narrowed_rims
from neurolens.optics.setting.states import set_lens

_LIST = lab.ROOT / "experiments" / "named_lenses.toml"
_NAMED = re.compile(r"(?P<patent>[^(]+?),?\s*(?P<example>Example\s+\w+)?(?P<master>\s+ML)?\s*\((?P<product>.+)\)$")
_US = re.compile(r"US (\d),(\d{3}),(\d{3})")

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
                raise InputError(_LIST, "makers", stem, f"a file of {folder}")
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


def source_of(patent: str, example: str | None, master: str | None, first_of_year: Mapping[str, Any]) -> str:
    """The patent with its year, and the example; the number of a United States patent tells its year."""
    patent = re.sub(r"^US00(\d)(\d{3})(\d{3})$", r"US \1,\2,\3", patent)
    number = _US.match(patent)
    if number:
        patent += f" ({first_of_year['from'] - 1 + bisect(first_of_year['numbers'], int(''.join(number.groups())))})"
    parts = [patent, example and example[0].lower() + example[1:], master and "master lens"]
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
    lens = read_any(want.file)
    parts = _NAMED.match(lens.name.strip())
    if parts is None:
        raise InputError(want.file, "NAME", lens.name, "PATENT Example N (PRODUCT)")
    product = product_of(parts["product"])
    source = source_of(parts["patent"], parts["example"], parts["master"], listed["first_us_patents"])
    path = f"{lens_id(product, want.maker)}.toml"
    lens = replace(lens, name=product, believed_to_be=product, designer=want.maker, source=source, path=path)
    lens, found = against_photographs(with_whole_beam(rounded(replace(lens, rims="estimated", wavelengths_nm=()))))
    efl = f"{float(first_order(set_lens(lens)).efl_mm):.1f} mm"
    notes = [
        f"Figures of the patent as OpticsDatabase transcribes them (MIT licence; file {want.file.name}).",
        f"Believed to be the product: the collection names it, and the example has {efl} and f/{lens.f_number:.3g}.",
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
    listed, failed, written = tomllib.loads(_LIST.read_text(encoding="utf-8")), 0, 0
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
